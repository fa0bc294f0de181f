"""The two beacons: LEDs on the Pi's pins that flash at different rates, so that roof cameras can tell front from rear.

One clock switches both (robotd.beacons); gpiozero's own `blink` waits relatively and drifts. The clock is the
hardware's ticker, or with `timing = "lgpio"` the thread of the lgpio library, which goes on while Python is busy.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from dataclasses import dataclass
from typing import Any, Literal

from gpiozero import LED, GPIOZeroError

from ..beacons import BeaconRates, conflicts, describe, good_pairs, rates
from ..bind import ranged
from ..bus import Bus
from ..clock import now
from ..config import Calibration
from ..errors import DriverFault
from ..hardware import Hardware, Ticker
from ..plugin import Driver

# lgpio starts a pulse train at a multiple of its period in the running second of its clock, which may be 20 ms ahead;
# so both are started early enough in the same second
FIRST_S, LAST_S, END_S = 0.2, 0.6, 0.9


@dataclass(frozen=True, slots=True)
class BeaconConfig:
    """[drivers.<instance>] of the beacons; pins are the Broadcom chip's numbers."""

    front_pin: int = ranged(minimum=0, maximum=27)
    rear_pin: int = ranged(minimum=0, maximum=27)
    front_hz: float = ranged(6.25, minimum=0.2, maximum=25.0)
    rear_hz: float = ranged(3.125, minimum=0.2, maximum=25.0)
    active_high: bool = True
    timing: Literal["software", "lgpio"] = "software"
    camera_fps: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.front_pin == self.rear_pin:
            raise ValueError(f"front_pin and rear_pin are both {self.front_pin}; expected two pins")
        if any(not 1.0 <= fps <= 1000.0 for fps in self.camera_fps):
            raise ValueError(f"camera_fps = {list(self.camera_fps)}; expected frames a second of each roof camera")
        against = conflicts(rates(self.front_hz, self.rear_hz), self.camera_fps)
        if against:
            pairs = describe(good_pairs(self.camera_fps))
            raise ValueError(
                f"{'; '.join(against)}; {f'take {pairs}' if pairs else 'no pair of rates suits: use faster cameras'}"
            )


class BeaconDriver(Driver):
    """Flashes both LEDs while it is open, in one fixed phase; off on every way out."""

    kind = "beacons"
    Config = BeaconConfig
    config: BeaconConfig

    def __init__(self, name: str, config: BeaconConfig, hardware: Hardware, bus: Bus, calibration: Calibration) -> None:
        super().__init__(name, config, hardware, bus, calibration)
        self.rates: BeaconRates = rates(config.front_hz, config.rear_hz)
        self._ticker: Ticker | None = None

    async def open(self) -> None:
        """Take both pins and begin to flash.

        Raises
        ------
        DriverFault
            No pins here, a pin in use, or for `timing = "lgpio"` pins of another library.
        """
        self._ticker = None
        with self._faults():
            if self.config.timing == "lgpio":
                await self._start_lgpio()
            else:
                self._start_software()
        self.report(f"beacons flash at {self.rates.front_hz:.4g} Hz in front and {self.rates.rear_hz:.4g} Hz behind")

    async def run(self) -> None:
        """Until cancelled; raises DriverFault when a pin fails."""
        with self._faults():
            if self._ticker is not None:
                await self._ticker.wait()
        await asyncio.Event().wait()

    @contextlib.contextmanager
    def _faults(self) -> Any:
        try:
            yield
        except _pin_errors() as error:
            raise DriverFault(
                f"{self.name}: pins {self.config.front_pin} and {self.config.rear_pin}: {error}; "
                "check the pin numbers (Broadcom's), and that no other driver or program uses them"
            ) from error

    # ---- software ----------------------------------------------------------------------------------------------------

    def _start_software(self) -> None:
        front, rear = self._led(self.config.front_pin), self._led(self.config.rear_pin)
        levels = self.rates.levels

        def switch(tick: int) -> None:
            front.value, rear.value = levels(tick)

        self._ticker = self.hardware.ticker(self.rates.tick, switch)
        self.resources.callback(self._ticker.close)  # before the LEDs are switched off for good

    def _led(self, pin: int) -> LED:
        led = LED(pin, active_high=self.config.active_high, pin_factory=self.hardware.pins)
        self.resources.callback(led.close)
        self.resources.callback(self._quietly, led.off)  # closing only releases the pin, at its last level
        return led

    def _quietly(self, call: Any, *arguments: Any) -> None:
        with contextlib.suppress(*_pin_errors()):
            call(*arguments)

    # ---- lgpio -------------------------------------------------------------------------------------------------------

    async def _start_lgpio(self) -> None:
        chip = getattr(self.hardware.pins, "chip", None)
        if chip is None:
            raise DriverFault(
                f'{self.name}: timing = "lgpio" needs the pins of lgpio, found {type(self.hardware.pins).__name__}; '
                'install it (apt install python3-lgpio) or set timing = "software"'
            )
        import lgpio

        handle = lgpio.gpiochip_open(chip)
        self.resources.callback(self._quietly, lgpio.gpiochip_close, handle)
        off = 0 if self.config.active_high else 1
        pins = (self.config.front_pin, self.config.rear_pin)
        for pin in pins:
            lgpio.gpio_claim_output(handle, pin, off)
            self.resources.callback(self._quietly, lgpio.gpio_free, handle, pin)
            self.resources.callback(self._quietly, lgpio.gpio_write, handle, pin, off)
        tick = round(1e6 * self.rates.tick)  # microseconds; one rounding for both, so that they never drift apart
        halves = (self.rates.front_ticks * tick, self.rates.rear_ticks * tick)
        while True:
            await _wait_within_second(FIRST_S, LAST_S)
            second = now() // 1.0
            for pin, half in zip(pins, halves, strict=True):
                # a train begins with its high half; of an LED that is lit when low that is the dark one, so it begins
                # half a period later
                lgpio.tx_pulse(handle, pin, half, half, 0 if self.config.active_high else half, 0)
                self.resources.callback(self._quietly, lgpio.tx_pulse, handle, pin, 0, 0, 0, 0)
            if now() < second + END_S:
                return
            for pin in pins:  # this process was held up in between: they may be out of step
                lgpio.tx_pulse(handle, pin, 0, 0, 0, 0)


async def _wait_within_second(first: float, last: float) -> None:
    """Until the loop's clock is in that part of a second."""
    while not first <= now() % 1.0 <= last:
        await asyncio.sleep((first - now()) % 1.0 + 0.01)


def _pin_errors() -> tuple[type[Exception], ...]:
    """What pins raise when they fail, with whatever library is loaded under gpiozero."""
    lgpio = sys.modules.get("lgpio")
    return (GPIOZeroError, OSError) if lgpio is None else (GPIOZeroError, OSError, lgpio.error)
