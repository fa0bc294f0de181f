"""What the robot prints between its sensor data: plain text on the same line, nothing marks it."""

from __future__ import annotations

from .battery import Battery
from .quirks import Firmware

PROCESSOR_SLEEP = b"processor-sleep\r\n"
READY = 4.5  # s from opcode 7 or power-up until commands are obeyed again

# s after the reset, text; the times are those that yarc's author measured on a 3.7.1
_BOOT: dict[Firmware, tuple[tuple[float, bytes], ...]] = {
    "3.2.6": (
        (0.015, b"Soft reset!\n"),
        (1.0, b"\xfe"),
        (3.0, b"Roomba by iRobot!\r\nstr730\r\n2012-03-22-1549-L   \r\nbattery-current-zero 257\r\n"),
        (
            4.0,
            b"\r\n2012-03-22-1549-L   \r\nr3_robot/tags/release-3.2.6:4975 CLEAN\r\n\r\n"
            b"bootloader id: 4718 5267 ABFF FFFF \r\nassembly: 3.5-lite\r\nrevision: 2\r\nflash version: 10\r\n"
            b"flash info crc passed: 1\r\n\r\nbattery-current-zero 258\r\n",
        ),
    ),
    "stm32-3.7.7": (
        (0.015, b"Soft reset!\n"),
        (1.0, b"\xfe"),
        (3.0, b"Roomba by iRobot!\r\nstm32\r\n2016-04-12-1607-L   \r\nbattery-current-zero 254\r\n"),
        (
            4.0,
            b"\r\n2016-04-12-1607-L   \r\nr3-robot/tags/release-stm32-3.7.7:6913 CLEAN\r\n\r\n"
            b"bootloader id: 3115 C200 0033 5860 \r\nassembly: 3.5-lite\r\nrevision: 8\r\nflash version: 10\r\n"
            b"flash info crc passed: 1\r\n\r\nbattery-current-zero 252\r\n",
        ),
    ),
    "silent": (),
}


def boot_texts(firmware: Firmware, *, soft: bool) -> tuple[tuple[float, bytes], ...]:
    """What is printed at which second after a reset by command (`soft`) or after the battery was put in."""
    return tuple((after, text) for after, text in _BOOT[firmware] if soft or after > 0.1)


def battery_line(seconds: float, battery: Battery) -> bytes:
    """The line that a robot prints every second while it stands in its dock in mode Off."""
    minutes, rest = divmod(int(seconds), 60)
    return (
        f"bat:   min {minutes}  sec {rest}  mV {battery.voltage_mv}  mA {round(battery.current_ma)}  "
        f"tenths-deg-C {10 * battery.temperature_c}  mAH {round(battery.charge_mah)}  state {battery.state}\r\n"
    ).encode()
