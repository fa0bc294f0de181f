"""The pins of the simulated robot: a gpiozero factory, and what every pin was at any time.

Whoever renders what hangs on a pin (a roof camera looking at the beacons) asks `PinStates` for its level over the time
in which the shutter is open; drivers see nothing but the factory.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import numpy as np
from gpiozero.pins.mock import MockFactory, MockPWMPin

from ..records import Floats


class PinStates:
    """Every change of every output pin, in loop time; pins by the Broadcom chip's numbers."""

    def __init__(self) -> None:
        self._changes: dict[int, list[tuple[float, float]]] = {}
        self._last = 0.0

    def record(self, number: int, level: float) -> None:
        """A pin has this level, 0 to 1, from now on; outside a running loop, from the last time that was seen."""
        with contextlib.suppress(RuntimeError):
            self._last = asyncio.get_running_loop().time()
        changes = self._changes.setdefault(number, [])
        if not changes or changes[-1][1] != level:
            changes.append((self._last, level))

    def changes(self, number: int) -> list[tuple[float, float]]:
        """(time, level from then on) of one pin, oldest first; empty if nobody has used it."""
        return list(self._changes.get(number, ()))

    def level(self, number: int, t0: Floats, t1: Floats) -> Floats:
        """Mean level of a pin over intervals.

        Parameters
        ----------
        number : int
        t0, t1 : arrays of one shape
            Begin and end of each interval in seconds of loop time, t0 < t1.

        Returns
        -------
        array of that shape
            0 to 1: the share of each interval in which the pin was high. 0 before its first change.
        """
        changes = self._changes.get(number)
        if not changes:
            return np.zeros(np.broadcast(t0, t1).shape)
        t, levels = np.array(changes).T
        area: Floats = np.concatenate([[0.0], np.cumsum(levels[:-1] * np.diff(t))])  # integral from the first change on

        def integral(at: Floats) -> Floats:
            place = np.clip(np.searchsorted(t, at, side="right") - 1, 0, None)
            return np.asarray(area[place] + levels[place] * np.maximum(0.0, at - t[place]), np.float64)

        begin, end = np.asarray(t0, np.float64), np.asarray(t1, np.float64)
        return (integral(end) - integral(begin)) / (end - begin)


def pin_factory(states: PinStates) -> Any:
    """A gpiozero factory of mock pins whose levels go into `states`."""

    class RecordingPin(MockPWMPin):  # type: ignore[misc]  # gpiozero has no types
        def _set_frequency(self, value: float | None) -> None:
            if value != self.frequency:  # because the mock drives a pin low when it closes it, which real ones do not
                super()._set_frequency(value)

        def _change_state(self, value: float) -> bool:
            changed = super()._change_state(value)
            if self.function == "output":
                states.record(int(self.info.name.removeprefix("GPIO")), float(self._state))
            return bool(changed)

    return MockFactory(pin_class=RecordingPin)
