"""The thesis's flash detector, as the baseline that ours is measured against: sections 4 and 6.3.1.

Every frame is blurred (11x11 Gaussian of sigma 5) and subtracted from the one before; connected pixels that changed by
a threshold (equation 66) are filtered by area, length, and length to area, and become triggers. Triggers nearer than a
distance share a position (equation 51). The times between rising edges at a position (equations 52 to 54, by time
stamps as of equation 71) are rated by triangular cost functions (55, 56), and a position whose cost is low over enough
edges is a flash (57). The errata's readings are taken: `signed` counts brightening only (B1), the binary mask (B3),
m1 = -m2 (B4), and the mean of the costs instead of their sum (B5) unless `mean_cost` is off.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..records import Flash
from .pattern import FlashPattern

Floats = NDArray[np.float64]

_KERNEL, _SIGMA = (11, 11), 5.0
_LIMIT = 1.0  # a of equation 55
_SLOPE_SPAN = 2.0  # k lambda of equation 55: figure 9 has k = 10 at 5 Hz, k = 5 would be 2.5 Hz


@dataclass(frozen=True, slots=True)
class ThesisFlashConfig:
    """The thesis's thresholds; it names them without numbers, so these are what its examples make of them."""

    pattern: FlashPattern = field(default_factory=FlashPattern)
    threshold: int = ranged(2, minimum=1, maximum=255, doc="t of equation 66, in blurred grey levels per frame")
    signed: bool = True  # brightening only; false: the absolute change as printed
    area_px: tuple[float, float] = (4.0, 400.0)
    max_length_px: float = ranged(40.0, minimum=1.0, doc="largest distance between two points of a trigger's border")
    max_length_to_area: float = ranged(2.0, minimum=0.01, doc="1/px")
    distance_px: float = ranged(4.0, minimum=0.1, doc="t_d of equation 51")
    mean_cost: bool = True
    max_cost: float = ranged(0.3, minimum=0.0, doc="t_cost of equation 57")
    min_edges: int = ranged(6, minimum=1, doc="s_min of equation 57")


@dataclass(slots=True)
class _Position:
    """One position label: its centroid, and its rising edges."""

    u: float
    v: float
    triggers: int
    frame: int
    edges: list[float]
    strength: float


def periods_of(pattern: FlashPattern) -> tuple[float, ...]:
    """Times between rising edges that a pattern makes, each once: the lambdas of equation 56."""
    starts = [start for start, _ in pattern.on]
    times = [b - a for a, b in zip(starts, [*starts[1:], starts[0] + pattern.period], strict=True)]
    return tuple(sorted({round(t, 6) for t in (*times, pattern.period)}))


def cost(times: Floats, periods: Sequence[float]) -> Floats:
    """The lowest of the triangular cost functions (equations 55 and 56) of times (N,) in seconds, 0 on a period."""
    best = np.full(len(times), _LIMIT)
    for period in periods:
        slope = _SLOPE_SPAN / period
        m = slope * period  # m1 = -m2, so that the minimum is 0 (erratum B4)
        best = np.minimum(best, np.maximum(-slope * times + m, slope * times - m))
    return best


class ThesisFlashDetector:
    """The same interface as `FlashDetector`."""

    def __init__(self, config: ThesisFlashConfig | None = None) -> None:
        self.config = config or ThesisFlashConfig()
        self._periods = periods_of(self.config.pattern)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._positions: list[_Position] = []
        self._before: NDArray[np.int16] | None = None
        self._frame = 0

    def update(self, frame: NDArray[np.uint8], t: float) -> bool:
        """Take one frame (H, W) and its time in seconds; returns True, because every frame may decide."""
        blurred = cv2.GaussianBlur(frame, _KERNEL, _SIGMA).astype(np.int16)
        before, self._before = self._before, blurred
        self._frame += 1
        if before is None:
            return True
        change = blurred - before if self.config.signed else np.abs(blurred - before)
        mask = np.asarray(change >= self.config.threshold, np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            place = self._trigger(contour)
            if place is not None:
                strength = float(
                    change[min(round(place[1]), len(change) - 1), min(round(place[0]), len(change[0]) - 1)]
                )
                self._label(*place, t, strength)
        return True

    def detect(self, frames: Iterable[NDArray[np.uint8]], times: Sequence[float] | Floats) -> list[Flash]:
        """Reset, take a whole sequence of frames with increasing times in seconds, and return `flashes()`."""
        self.reset()
        for frame, t in zip(frames, times, strict=True):
            self.update(frame, float(t))
        return self.flashes()

    def flashes(self) -> list[Flash]:
        """Positions whose edges fit (equation 57), the lowest cost first; `score` is 1 - cost, `sigma` half a pixel."""
        found = []
        for position in self._positions:
            times = np.diff(position.edges)
            if len(times) <= self.config.min_edges:
                continue
            costs = cost(times, self._periods)
            total = float(costs.mean() if self.config.mean_cost else costs.sum())
            if total < self.config.max_cost:
                found.append(
                    Flash(u=position.u, v=position.v, sigma=0.5, score=1.0 - total, amplitude=position.strength)
                )
        return sorted(found, key=lambda flash: -flash.score)

    def _trigger(self, contour: NDArray[Any]) -> tuple[float, float] | None:
        """Centroid by Green's theorem of a contour that passes the filters."""
        points = contour.reshape(-1, 2)
        moments = cv2.moments(contour)
        area = moments["m00"]
        if not self.config.area_px[0] <= area <= self.config.area_px[1]:
            return None
        hull = cv2.convexHull(points).reshape(-1, 2).astype(float)
        length = float(np.sqrt(((hull[:, None] - hull[None]) ** 2).sum(axis=2).max()))
        if length > self.config.max_length_px or length / area > self.config.max_length_to_area:
            return None
        return moments["m10"] / area, moments["m01"] / area

    def _label(self, u: float, v: float, t: float, strength: float) -> None:
        """Add a trigger to the nearest position, or begin one."""
        if self._positions:
            apart = [np.hypot(position.u - u, position.v - v) for position in self._positions]
            nearest = int(np.argmin(apart))
            if apart[nearest] <= self.config.distance_px:
                position = self._positions[nearest]
                position.triggers += 1
                position.u += (u - position.u) / position.triggers
                position.v += (v - position.v) / position.triggers
                position.strength = max(position.strength, strength)
                if position.frame < self._frame - 1:
                    position.edges.append(t)
                position.frame = self._frame
                return
        self._positions.append(_Position(u, v, 1, self._frame, [t], strength))
