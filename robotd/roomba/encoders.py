"""Wheel travel from the robot's encoder counts, which know no direction.

Each wheel has one channel, so the robot gives its counts the sign of what it was last told: down in reverse, up
otherwise, also while the wheel runs out or is pushed. How many counts came is right; which way the wheel turned we
say ourselves: the way of its command, and of its last motion until it rests or, told to reverse, has slowed to a halt.

Counts are modulo 65536, signed in one manual and unsigned in the other; one manual's text also swaps the two wheels.
Which is which shows in the first turn, because the wheels then differ.
"""

from __future__ import annotations

import math
from typing import Literal

from ..oi import COUNT, TICK

FASTEST = 0.6  # m/s: what no wheel of this robot can do
SPARE = 8  # counts beyond that, for stamps that are a little off
LONGEST_S = 10.0  # after which the counts may have gone round unseen
DOUBT_S = 0.3  # of impossible counts: then it does not matter what they are
AT_REST = 4  # ticks without a count: slower than 7 mm/s
SLOWEST_BRAKING = 0.3  # m/s^2: a wheel told to reverse does so before it would have come to rest with this
WINDOW_S = 0.12  # commands and counts are compared over so long, because a count in a tick is 30 mm/s
ENOUGH = 0.004  # m^2/s: the wheels were told apart by e.g. 0.2 m/s for 0.1 s
CLEARLY = 0.25  # of the other explanation's squared error

Order = Literal["normal", "swapped"]


class _Wheel:
    """Direction of one wheel."""

    def __init__(self) -> None:
        self.direction = 1
        self._still = 0  # ticks
        self._slowest = math.inf  # counts a tick since the command was reversed
        self._patience = 0.0  # ticks

    def turn(self, command: float, rate: float, ticks: int) -> int:
        """Take `rate` counts a tick over `ticks` ticks under a command in m/s; returns 1 for forward, -1."""
        if not command:
            self._slowest = math.inf
            self._still = 0 if rate else self._still + ticks
            if self._still >= AT_REST:
                self.direction = 1
            return self.direction
        wanted, rests = (1 if command > 0.0 else -1), self._still >= AT_REST
        self._still = 0
        if wanted == self.direction or rests:
            self._slowest = math.inf
            self.direction = wanted
            return wanted
        if self._slowest == math.inf:
            self._patience = AT_REST + rate * COUNT / (SLOWEST_BRAKING * TICK * TICK)
        self._patience -= ticks
        # either a tick shows the halt between, or the wheel is fast again after having been slow
        if rate < 0.5 or rate > self._slowest + 1.0 or self._patience <= 0.0:
            self._slowest = math.inf
            self.direction = wanted
        else:
            self._slowest = min(self._slowest, rate)
        return self.direction


class WheelEncoders:
    """Follows both encoders of one robot.

    Parameters
    ----------
    order : "auto", "normal" or "swapped"
        Whether packet 43 is the left wheel's and 44 the right one's; "auto" finds out while the robot turns.

    Attributes
    ----------
    left, right : float
        Nominal metres rolled, forward positive; continuous, whatever the counts do.
    resets : int
        How often the counts cannot have continued the old ones, so that unknown motion is missing.
    order : "normal", "swapped" or None
        What is known about it.
    speeds : tuple of float
        Of the right and the left wheel in m/s over the last full window of 0.12 s, forward positive.
    """

    def __init__(self, order: Literal["auto", "normal", "swapped"] = "auto") -> None:
        self.resets = 0
        self.order: Order | None = None if order == "auto" else order
        self.speeds = (0.0, 0.0)
        self._travel = [0, 0]  # counts, right before left as on the wire of a drive command
        self._wheels = (_Wheel(), _Wheel())
        self._old: tuple[int, int] | None = None
        self._gap = 0.0  # s since `_old`
        self._suspect: tuple[int, int] | None = None
        self._window = [0.0, 0.0, 0.0, 0.0, 0.0]  # s; m told right, left; m counted right, left
        self._evidence = [0.0, 0.0, 0.0]  # m^2/s: squared difference told, errors if normal, if swapped
        self._since = (0.0, 0, 0)  # s, counts right, left: the beginning of the window of `speeds`

    @property
    def left(self) -> float:
        return self._travel[1] * COUNT

    @property
    def right(self) -> float:
        return self._travel[0] * COUNT

    def update(
        self, elapsed: float, packet_43: int, packet_44: int, command: tuple[float, float], *, known: bool
    ) -> str | None:
        """Take one frame's counts.

        Parameters
        ----------
        elapsed : float
            Seconds since the frame before.
        packet_43, packet_44 : int
            Modulo 65536.
        command : tuple of float
            What the right and the left wheel were told last, m/s.
        known : bool
            Whether the robot obeys that command and no program of its own: only then it tells the encoders apart.

        Returns
        -------
        str or None
            What went wrong, in words.
        """
        new = (packet_43, packet_44) if self.order == "swapped" else (packet_44, packet_43)
        old = self._old
        if old is None:
            self._old = new
            return None
        self._gap += elapsed
        steps = _steps(old, new)
        if not _is_possible(steps, self._gap):
            return self._doubt(new, steps, elapsed)
        elapsed, self._gap = max(self._gap, TICK), 0.0
        self._old, self._suspect = new, None
        ticks = round(elapsed / TICK)
        for wheel, step, told, place in zip(self._wheels, steps, command, (0, 1), strict=True):
            self._travel[place] += abs(step) * wheel.turn(told, abs(step) / ticks, ticks)
        self._measure(elapsed)
        return self._compare(elapsed, steps, command) if known and self.order is None else None

    def _doubt(self, new: tuple[int, int], steps: tuple[int, int], elapsed: float) -> str | None:
        """Counts that no wheel can have made: a damaged frame, unless the next one goes on from there."""
        suspect, self._suspect = self._suspect, new
        if self._gap < DOUBT_S and (suspect is None or not _is_possible(_steps(suspect, new), elapsed)):
            return None
        gap, self._gap = self._gap, 0.0
        self._old, self._suspect, self._window = new, None, [0.0] * 5
        self.resets += 1
        return (
            f"the wheel counters jumped by {max(map(abs, steps)) * COUNT:.2f} m within {gap:.2f} s, which no wheel "
            "can: the robot has restarted or is broken; the motion meanwhile is unknown"
        )

    def _measure(self, elapsed: float) -> None:
        """Speeds over windows, without a history."""
        seconds, right, left = self._since
        seconds += elapsed
        if seconds < WINDOW_S:
            self._since = seconds, right, left
            return
        scale = COUNT / seconds
        self.speeds = (self._travel[0] - right) * scale, (self._travel[1] - left) * scale
        self._since = 0.0, self._travel[0], self._travel[1]

    def _compare(self, elapsed: float, steps: tuple[int, int], command: tuple[float, float]) -> str | None:
        """Whether the counts, with the robot's own signs, fit the commands better with the wheels exchanged."""
        window = self._window
        window[0] += elapsed
        for wheel in range(2):
            window[1 + wheel] += command[wheel] * elapsed
            window[3 + wheel] += steps[wheel] * COUNT
        if window[0] < WINDOW_S:
            return None
        seconds, told_right, told_left, right, left = window
        self._window = [0.0] * 5
        evidence = self._evidence
        evidence[0] += (told_right - told_left) ** 2 / seconds
        evidence[1] += ((right - told_right) ** 2 + (left - told_left) ** 2) / seconds
        evidence[2] += ((left - told_right) ** 2 + (right - told_left) ** 2) / seconds
        told, normal, swapped = evidence
        if told < ENOUGH:
            return None
        if normal < CLEARLY * swapped:
            self.order = "normal"
        elif swapped < CLEARLY * normal:
            self.order = "swapped"
            self._old = None
            self.resets += 1
            return "the robot reports its two wheels swapped; corrected, but the way until now was reckoned wrong"
        elif told > 10.0 * ENOUGH:  # slipping, blocked or lifted: begin anew
            self._evidence = [0.0, 0.0, 0.0]
        return None


def _steps(old: tuple[int, int], new: tuple[int, int]) -> tuple[int, int]:
    """Counts from one reading to another, the shorter way round."""
    return (new[0] - old[0] + 0x8000) % 0x10000 - 0x8000, (new[1] - old[1] + 0x8000) % 0x10000 - 0x8000


def _is_possible(steps: tuple[int, int], seconds: float) -> bool:
    return max(map(abs, steps)) <= SPARE + max(seconds, TICK) * FASTEST / COUNT and seconds <= LONGEST_S
