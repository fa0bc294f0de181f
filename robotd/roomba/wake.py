"""The robot's wake line (BRC, device detect): a low pulse wakes it and keeps it awake."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import Any, Literal

from ..clock import now
from ..errors import DriverFault
from ..hardware import Hardware, SerialLink

PULSE_S = 1.0  # one long pulse, because three short ones (50 to 500 ms) change the baud rate


class WakeLine:
    """Pulses the wake line: through the serial adapter's RTS, or through a pin if one is given to `use_pin`."""

    def __init__(self, link: SerialLink) -> None:
        self._link = link
        self._pin: Any = None
        self._pulse_end = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def use_pin(self, hardware: Hardware, pin: int, polarity: Literal["low", "high"], stack: AsyncExitStack) -> None:
        """Pulse this GPIO pin (BCM number) from now on; `stack` releases it, at its idle level.

        Parameters
        ----------
        polarity : "low" or "high"
            Level of the pin that pulls the wake line low: "high" behind a transistor, which inverts.

        Raises
        ------
        DriverFault
            There is no such pin, or no way to pins on this computer.
        """
        from gpiozero import DigitalOutputDevice  # because most robots have the line in their cable
        from gpiozero.exc import GPIOZeroError

        try:
            device = DigitalOutputDevice(pin, active_high=polarity == "high", pin_factory=hardware.pins)
        except (GPIOZeroError, OSError, RuntimeError, ImportError) as error:
            raise DriverFault(
                f"wake_pin {pin} cannot be used: {error}; name a free GPIO (BCM number) and install python3-lgpio"
            ) from error
        self._pin = device
        stack.callback(self._release)

    def pulse(self) -> None:
        """Begin one pulse of a second, in the background; nothing while one is under way."""
        t = now()
        if t < self._pulse_end:
            return
        self._pulse_end = t + PULSE_S
        if self._pin is None:
            self._link.pulse_wake(PULSE_S)
        else:
            self._pin.on()
            self._timer = asyncio.get_running_loop().call_later(PULSE_S, self._pin.off)

    def _release(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._pin.off()
        self._pin.close()
        self._pin = None
