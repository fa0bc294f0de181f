"""The robot base: an iRobot Roomba 500/600 or Create 2 over its Open Interface.

The base obeys its last command for ever. So commands expire here after 0.2 s, every way out sends zero velocity,
Passive and Stop, and only Safe mode is used, in which the base itself brakes at cliffs and dropped wheels. It leaves
that mode without saying so; packet 35 of the sensor stream tells.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from .. import oi
from ..bind import ranged
from ..bus import Bus
from ..clock import now
from ..config import Calibration
from ..errors import DriverFault
from ..hardware import Hardware, SerialLink
from ..plugin import Driver
from ..records import SensorFrame

# bumps, cliffs, overcurrent, charging, voltage, charge, capacity, mode, encoders: 34 bytes of the 172 in a tick
PACKETS = (7, 9, 10, 11, 12, 14, 21, 22, 25, 26, 35, 43, 44)
PACKETS_19200 = (7, 9, 10, 11, 12, 14, 22, 35, 43, 44)  # 26 of the 28 bytes that fit at 19200 baud
BAUDS = (115200, 19200, 57600)

MAX_WHEEL_SPEED = 0.30  # m/s
COMMAND_S = 0.2  # a drive command's life
DITHER_S = 0.05
SILENCE_S = 0.15
LATE_S = 0.02
START_S = 0.1  # after Start, before anything else
FIRST_FRAMES, FIRST_FRAMES_S = 3, 0.4
WAKE_PULSE_S, WAKE_S = 1.0, 1.0  # one long pulse, because three short ones change the baud rate
REARM_S = 0.5
AT_REST = 4  # frames without a count: slower than 7 mm/s
RECOVER, RECOVER_LONG = 36, 260  # Starts that a half-received command can swallow: a song, a list of 255 packets
CHARGING = (1, 2, 3, 4)
MODES = {oi.OFF: "off", oi.PASSIVE: "passive", oi.SAFE: "safe", oi.FULL: "full"}


@dataclass(frozen=True, slots=True)
class RoombaConfig:
    """[drivers.<instance>] of a Roomba."""

    port: str
    baud: Literal[115200, 57600, 19200] = 115200
    checksum: Literal["auto", "inclusive", "exclusive"] = "auto"
    rearm: bool = True
    speed_step: float = ranged(0.0285, minimum=0.0, maximum=0.1)


class RoombaDriver(Driver):
    """Publishes SensorFrames at 66.7 Hz and drives the wheels; see robotd.plugin.Base.

    Attributes
    ----------
    counters : robotd.oi.StreamCounters
        Good and rejected frames since the driver was opened.
    """

    kind = "base"
    Config = RoombaConfig
    config: RoombaConfig

    def __init__(self, name: str, config: RoombaConfig, hardware: Hardware, bus: Bus, calibration: Calibration) -> None:
        super().__init__(name, config, hardware, bus, calibration)
        self._link: SerialLink | None = None
        self._use_baud(config.baud)
        self._reset()

    def _reset(self) -> None:
        self._timer: asyncio.TimerHandle | None = None
        self._expiry = 0.0
        self._next_arm = 0.0
        self._mode: str | None = None
        self._mode_offset = 0
        # per wheel, right before left as on the wire
        self._wanted, self._sent = [0.0, 0.0], [0.0, 0.0]  # m/s
        self._sent_at = 0.0
        self._owed = [0.0, 0.0]  # m
        self._counts: tuple[int, int] | None = None
        self._travel = [0, 0]  # counts
        self._backward = [False, False]
        self._still = [0, 0]  # frames

    async def open(self) -> None:
        """Find the baud rate, enter Safe mode and start the sensor stream.

        Raises
        ------
        DriverFault
            No port, or nothing that looks like a sensor stream at any baud rate, also after a wake pulse.
        """
        link = await self.hardware.open_serial(self.config.port, self.config.baud)
        self._reset()
        self._link = link
        self.resources.callback(self._leave, link)
        await self._connect(link)
        link.write(oi.encode("safe") + oi.encode("drive_direct", 0, 0))
        self._next_arm = now() + REARM_S
        self.report(f"base found on {self.config.port} at {self._baud} baud, checksum {self._decoder.checksum}")

    async def run(self) -> None:
        """Decode the stream until cancelled; raises DriverFault when it falls silent or the port is gone."""
        link = self._link
        assert link is not None, "run is called after open"
        deadline = now() + SILENCE_S
        while True:
            try:
                async with asyncio.timeout_at(deadline):
                    arrived, data = await link.read()
            except TimeoutError:
                self.halt()
                if now() - deadline > LATE_S:  # this process was late, so frames may be waiting
                    deadline = now() + LATE_S
                    continue
                raise DriverFault(
                    f"{self.name}: no sensor frame on {self.config.port} for {SILENCE_S} s, halted; "
                    "check that the robot is awake and the cable is in"
                ) from None
            for event in self._decoder.feed(data):
                if isinstance(event, oi.SensorValues):
                    deadline = arrived + SILENCE_S
                    self._take(event, arrived)

    def drive(self, speed: float, turn_rate: float) -> None:
        """Set speed (m/s) and turn rate (rad/s, counter-clockwise) until the next command or for 0.2 s.

        Both are slowed down together where a wheel would exceed 0.3 m/s. Does nothing while the base is not open.
        """
        if self._link is None:
            return
        half = 0.5 * turn_rate * self.calibration.wheels.base
        right, left = speed + half, speed - half
        factor = min(1.0, MAX_WHEEL_SPEED / max(abs(right), abs(left), 1e-9))
        self._send_speeds(self._link, right * factor, left * factor)
        self._expiry = now() + COMMAND_S
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_at(self._expiry, self._expire)

    def halt(self) -> None:
        """Zero velocity at once."""
        if self._link is not None:
            self._send_speeds(self._link, 0.0, 0.0)

    @property
    def counters(self) -> oi.StreamCounters:
        return self._decoder.counters

    def _send_speeds(self, link: SerialLink, right: float, left: float) -> None:
        wanted = [right, left]
        if not (right or left):
            self._sent, self._owed = [0.0, 0.0], [0.0, 0.0]
        elif self.config.speed_step > 0.0:
            elapsed = min(now() - self._sent_at, COMMAND_S)
            for wheel in range(2):
                self._owed[wheel] += (self._wanted[wheel] - self._sent[wheel]) * elapsed
                self._sent[wheel] = self._quantised(wheel, wanted[wheel])
        else:
            self._sent = wanted
        self._wanted, self._sent_at = wanted, now()
        with contextlib.suppress(DriverFault):  # a port that is gone also fails the reader, which reports it
            link.write(oi.encode("drive_direct", *(round(1000.0 * speed) for speed in self._sent)))

    def _quantised(self, wheel: int, wanted: float) -> float:
        """One of the speeds that the base can do, chosen so that the wheel's travel stays as asked.

        The base rounds each wheel's speed to steps of about 28.5 mm/s, which is 0.12 rad/s of turning. So the travel
        that rounding still owes is made up for by now and then taking the next step; a step is changed only when
        speed and debt together ask for a whole one, because the motors take some 40 ms to follow.
        """
        step, sent = self.config.speed_step, self._sent[wheel]
        most = step * DITHER_S
        self._owed[wheel] = max(-most, min(most, self._owed[wheel]))
        due = wanted + self._owed[wheel] / DITHER_S
        if abs(due - sent) < step:
            return sent
        limit = int(MAX_WHEEL_SPEED / step)
        return max(-limit, min(limit, round(due / step))) * step

    def _expire(self) -> None:
        self._timer = None
        if now() < self._expiry:
            self._timer = asyncio.get_running_loop().call_at(self._expiry, self._expire)
        elif any(self._sent):
            self.halt()

    def _leave(self, link: SerialLink) -> None:
        """Zero velocity, Passive, Off; then release the port."""
        self._link = None
        if self._timer is not None:
            self._timer.cancel()
        with contextlib.suppress(DriverFault):
            link.write(oi.encode("drive_direct", 0, 0) + oi.encode("start") + oi.encode("stop"))
        link.close()

    # ---- connecting --------------------------------------------------------------------------------------------------

    async def _connect(self, link: SerialLink) -> None:
        bauds = (self.config.baud, *(baud for baud in BAUDS if baud != self.config.baud))
        if await self._greet(link, self.config.baud, RECOVER):
            return
        link.pulse_wake(WAKE_PULSE_S)
        await asyncio.sleep(WAKE_PULSE_S + WAKE_S)
        for baud in bauds:
            if await self._greet(link, baud, RECOVER_LONG):
                return
        raise DriverFault(
            f"{self.name}: no sensor frame on {self.config.port} at {', '.join(map(str, bauds))} baud; check that the "
            "robot is on (press Clean once), that the cable is in, and that RX and TX are not swapped"
        )

    def _use_baud(self, baud: int) -> None:
        self._baud = baud
        self._decoder = oi.StreamDecoder(PACKETS if baud > 19200 else PACKETS_19200, self.config.checksum)

    async def _greet(self, link: SerialLink, baud: int, starts: int) -> bool:
        """Try one baud rate: Passive mode, sensor stream; learn how this firmware numbers its modes."""
        self._use_baud(baud)
        link.set_baud(baud)
        link.write(oi.encode("start") * starts)
        await asyncio.sleep(START_S + starts * 10 / baud)
        link.write(oi.encode("stream", *self._decoder.layout.packet_ids))
        good = 0
        try:
            async with asyncio.timeout(FIRST_FRAMES_S):
                while True:
                    for event in self._decoder.feed((await link.read())[1]):
                        if isinstance(event, oi.SensorValues):
                            good += 1
                            # some newer 600s report every mode one too high
                            self._mode_offset = 1 if event.values[35] == oi.PASSIVE + 1 else 0
                            if good >= FIRST_FRAMES:
                                return True
        except TimeoutError:
            return False

    # ---- the stream --------------------------------------------------------------------------------------------------

    def _take(self, event: oi.SensorValues, arrived: float) -> None:
        values = event.values
        self._count(values[44], values[43])
        bits, charging = values[7], values.get(21, 0)
        behind = self._decoder.fed - event.end + self._decoder.layout.frame_size
        frame = SensorFrame(
            t=arrived - behind * 10 / self._baud,
            left=self._travel[1] * oi.COUNT,
            right=self._travel[0] * oi.COUNT,
            mode=MODES.get(values[35] - self._mode_offset, "unknown"),
            bump_left=bool(bits & 2),
            bump_right=bool(bits & 1),
            wheel_drop_left=bool(bits & 8),
            wheel_drop_right=bool(bits & 4),
            cliff=bool(values[9] or values[10] or values[11] or values[12]),
            overcurrent=bool(values[14]),
            voltage=values[22] / 1000.0,
            charge_fraction=_charge(values),
        )
        self._supervise(frame, charging in CHARGING)
        self.bus.sensors.publish(frame)

    def _count(self, right: int, left: int) -> None:
        """Follow the encoders around their 16 bits.

        The base counts one channel and takes the direction from its command: down in reverse, up when told to stand.
        A wheel that runs out after a reverse command is therefore counted the wrong way round until it rests.
        """
        new = (right, left)
        for wheel, old in enumerate(self._counts or new):
            step = (new[wheel] - old + 0x8000) % 0x10000 - 0x8000
            self._still[wheel] = 0 if step or self._sent[wheel] else self._still[wheel] + 1
            if self._sent[wheel]:
                self._backward[wheel] = self._sent[wheel] < 0
            elif self._still[wheel] >= AT_REST:
                self._backward[wheel] = False
            self._travel[wheel] += -abs(step) if self._backward[wheel] else step
        self._counts = new

    def _supervise(self, frame: SensorFrame, charging: bool) -> None:
        """Name the cause when the base leaves Safe mode, and go back to it when nothing speaks against that."""
        if frame.mode == self._mode == "safe":
            return
        hazards = [
            words
            for present, words in (
                (frame.wheel_drop_left, "the left wheel dropped"),
                (frame.wheel_drop_right, "the right wheel dropped"),
                (frame.cliff, "a cliff sensor sees no floor"),
                (charging, "it is on the charger"),
            )
            if present
        ]
        if frame.mode != self._mode:
            if self._mode == "safe":
                why = " and ".join(hazards) or "a button or another program"
                self.report(f"the base left safe mode for {frame.mode} mode: {why}", "warning")
            elif frame.mode == "safe":
                self.report("the base is in safe mode")
            elif hazards:
                self.report(f"the base stays in {frame.mode} mode: {' and '.join(hazards)}", "warning")
            self._mode = frame.mode
        if frame.mode != "safe" and self.config.rearm and not hazards and now() >= self._next_arm:
            self._next_arm = now() + REARM_S
            start = oi.encode("start") if frame.mode == "off" else b""
            link = self._link
            if link is not None:
                with contextlib.suppress(DriverFault):
                    link.write(start + oi.encode("safe") + oi.encode("drive_direct", 0, 0))


def _charge(values: Mapping[int, int]) -> float | None:
    """Charge over capacity, 0..1; the charge has been seen to run below zero and wrap."""
    capacity = values.get(26, 0)
    if not capacity:
        return None
    charge = values[25] if values[25] < 0x8000 else 0
    return min(1.0, charge / capacity)
