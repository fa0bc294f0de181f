"""What the simulated robot does by itself: cleaning and seeking its dock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from .dock import Dock

Speeds = tuple[float, float]  # right and left wheel, mm/s

WHEEL_BASE = 0.235  # m
CRUISE, BACK, SPIN = 300.0, -150.0, 200.0  # mm/s
BACK_S, UNDOCK_S, ASKEW_S = 0.7, 3.0, 4.0
CLEAN_S, SPOT_S = 2700.0, 40.0


class Behaviour(Protocol):
    """One of the robot's own programs."""

    name: str

    def step(self, seconds: float, *, hits: bool) -> Speeds | None:
        """Speeds for the next `seconds`; None when it has ended. `hits`: a bumper or cliff sensor has something."""


class Bounce:
    """Straight on until something is in the way, then back and around: `clean` and `max`.

    Parameters
    ----------
    name : str
    rng : numpy Generator
        Decides how far it turns.
    seconds : float
        How long it goes on.
    back_s : float
        For so long it first drives backward: off the dock.
    """

    def __init__(self, name: str, rng: np.random.Generator, seconds: float, back_s: float = 0.0) -> None:
        self.name = name
        self._rng = rng
        self._left = seconds
        self._back = back_s
        self._turn = self._draw_turn() if back_s else 0.0

    def step(self, seconds: float, *, hits: bool) -> Speeds | None:
        self._left -= seconds
        if self._left < 0.0:
            return None
        if hits and self._back <= 0.0:
            self._back, self._turn = BACK_S, self._draw_turn()
        if self._back > 0.0:
            self._back -= seconds
            return BACK, BACK
        if self._turn > 0.0:
            self._turn -= seconds
            return SPIN, -SPIN
        return CRUISE, CRUISE

    def _draw_turn(self) -> float:
        return float(self._rng.uniform(0.6, 1.8))


class Spiral:
    """Outward in a spiral: `spot`."""

    name = "spot"

    def __init__(self) -> None:
        self._t = 0.0

    def step(self, seconds: float, *, hits: bool) -> Speeds | None:
        self._t += seconds
        if self._t > SPOT_S or hits:
            return None
        turn = 0.5 * WHEEL_BASE / (0.15 + 0.01 * self._t)  # wheel speed difference of a circle of that radius
        return 200.0 * (1.0 + turn), 200.0 * (1.0 - turn)


class SeekDock:
    """Wander until the dock's beams are seen, then drive onto it; a robot that arrives askew tries again."""

    name = "dock"

    def __init__(self, dock: Dock | None, rng: np.random.Generator) -> None:
        self._dock = dock
        self._wander = Bounce("dock", rng, CLEAN_S)
        self._away = 0.0

    def step(self, seconds: float, *, hits: bool) -> Speeds | None:
        self._away -= seconds
        motion = self._dock.approach() if self._dock is not None and self._away <= 0.0 else None
        if motion is None or self._dock is None:
            return self._wander.step(seconds, hits=hits)
        if self._dock.offset()[0] < -0.01:  # beside the contacts
            self._away = ASKEW_S
            return self._wander.step(seconds, hits=True)
        speed, turn_rate = motion
        half = 0.5 * WHEEL_BASE * turn_rate
        return 1000.0 * (speed + half), 1000.0 * (speed - half)


class Programs:
    """The robot's own programs, of which at most one runs.

    Parameters
    ----------
    rng : numpy Generator
        What they do by chance.
    tell : callable
        Is told what starts and ends.
    """

    def __init__(self, rng: np.random.Generator, tell: Callable[[str], None]) -> None:
        self._rng = rng
        self._tell = tell
        self._running: Behaviour | None = None

    @property
    def is_running(self) -> bool:
        """Whether the robot does something by itself."""
        return self._running is not None

    @property
    def name(self) -> str | None:
        """What it does: clean, max, spot or dock."""
        return self._running.name if self._running is not None else None

    def start(self, name: str, dock: Dock | None, *, is_docked: bool) -> None:
        """Begin a program in place of the one that runs; a docked robot seeks no dock."""
        self.end()
        back = UNDOCK_S if is_docked else 0.0
        if name == "dock":
            self._running = None if is_docked else SeekDock(dock, self._rng)
        elif name == "spot":
            self._running = Spiral()
        else:
            self._running = Bounce(name, self._rng, CLEAN_S if name == "clean" else math.inf, back)
        if self._running is not None:
            self._tell(f"starts by itself: {name}")

    def end(self) -> None:
        """Stop the program that runs, if any."""
        if self._running is not None:
            self._tell(f"ends by itself: {self._running.name}")
            self._running = None

    def step(self, seconds: float, *, hits: bool) -> Speeds | None:
        """Wheel speeds for the next `seconds`; None when nothing runs any more."""
        speeds = self._running.step(seconds, hits=hits) if self._running is not None else None
        if speeds is None:
            self.end()
        return speeds
