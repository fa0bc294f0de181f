"""What the solver advises the robot to do next (robotd-plan/1); read on the robot, so nothing here needs the solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from .records import Pose

SAME_PLACE_M = 0.15  # within which a stop shows what was planned for it


@dataclass(frozen=True, slots=True)
class PlannedFlash:
    """A label that is worth asking at a stop, and the standard deviation of its position in metres afterwards."""

    label: str
    sigma_m: float


@dataclass(frozen=True, slots=True)
class PlannedStop:
    """A place worth stopping at.

    `along` is metres along the line from where the first stop was made (None over free floor), `pose` where that is in
    the map. `labels` are worth asking there; `skipped` probably show, too, but their flashes would teach next to
    nothing.
    """

    along: float | None
    pose: Pose
    labels: tuple[PlannedFlash, ...] = ()
    skipped: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PlannedLabel:
    """A label that the survey has seen: standard deviation of its position now (None: it has none), and at the end."""

    label: str
    sigma_m: float | None
    expected_m: float


@dataclass(frozen=True, slots=True)
class Plan:
    """Stops worth making next, in order, and all labels that the survey has seen.

    `begin` is how far along the line the robot stands before the first of them.
    """

    survey: str
    stops: tuple[PlannedStop, ...]
    labels: tuple[PlannedLabel, ...]
    notes: tuple[str, ...] = ()
    begin: float = 0.0
    format: Literal["robotd-plan/1"] = "robotd-plan/1"

    def distances(self) -> tuple[float, ...]:
        """Metres along the line of the stops; none over free floor."""
        return tuple(stop.along for stop in self.stops if stop.along is not None)

    def skipped(self, along: float) -> frozenset[str]:
        """Labels whose flashes would teach nothing at a distance along the line; none where no stop was planned."""
        near = [stop for stop in self.stops if stop.along is not None and abs(stop.along - along) <= SAME_PLACE_M]
        best = min(near, key=lambda stop: abs((stop.along or 0.0) - along), default=None)
        return frozenset(() if best is None else best.skipped)
