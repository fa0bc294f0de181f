"""The line as remembered: a polyline in odometry axes that views are averaged into, grown ahead and finished behind."""

from __future__ import annotations

import math

import numpy as np

from ..records import Floats, Pose
from .line_icp import Nearest, nearest
from .line_sight import Sight
from .polyline import arc_length, directions, end_direction, resample


class LineMap:
    """A polyline of even spacing, ordered in the direction of travel, with a weight for each point.

    Parameters
    ----------
    spacing : float
        Metres between its points.
    memory : float
        Frames after which a point averages no more, so that the line may move against odometry.
    join : float
        Metres, the longest gap that a continuation may leave.

    Attributes
    ----------
    path : (N, 2) array
    missed : (N,) int array
        Frames in a row in which each point was in view but not seen.
    shown : (N,) int array
        Frames that have shown each point.
    """

    def __init__(self, spacing: float, memory: float, join: float) -> None:
        self.spacing = spacing
        self._memory = memory
        self._join = join
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.path: Floats = np.empty((0, 2))
        self.weights: Floats = np.empty(0)
        self.missed = np.empty(0, dtype=np.int64)
        self.shown = np.empty(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self.path)

    @property
    def lengths(self) -> Floats:
        """(N,) arc lengths."""
        return arc_length(self.path)

    def start(self, points: Floats) -> None:
        """Begin anew with these points, trusted little."""
        self.path = resample(points, self.spacing)
        self.weights = np.zeros(len(self.path))
        self.missed = np.zeros(len(self.path), dtype=np.int64)
        self.shown = np.zeros(len(self.path), dtype=np.int64)

    def match(self, sight: Sight, within: float) -> Nearest | None:
        """Project a sight onto the line; None if less than three of its points are on it."""
        found = nearest(sight.points, self.path, within, self.lengths)
        return found if found.on.sum() >= 3 else None

    def direction_at(self, s: float, reach: float) -> Floats:
        """Unit vector (2,) of the chord of length `reach` that begins at arc length `s`; it may end before `s`."""
        lengths = self.lengths
        ends = np.clip([min(s, s + reach), max(s, s + reach)], 0.0, lengths[-1])
        points = np.column_stack([np.interp(ends, lengths, self.path[:, k]) for k in (0, 1)])
        step: Floats = points[1] - points[0]
        unit: Floats = step / max(float(np.hypot(*step)), 1e-9)
        return unit

    def point_at(self, s: float) -> Floats:
        """Point (2,) at arc length `s`."""
        lengths = self.lengths
        return np.array([np.interp(s, lengths, self.path[:, k]) for k in (0, 1)])

    def foot(self, pose: Pose, first: float = math.inf) -> float:
        """Arc length of the point nearest to the robot, among the first `first` metres: a closed line comes back."""
        gaps = np.hypot(*(self.path - np.array([pose.x, pose.y])).T)
        lengths = self.lengths
        return float(lengths[int(np.argmin(np.where(lengths <= first, gaps, np.inf)))])

    def shift(self, pose: Pose, x: float, y: float, turn: float) -> None:
        """Move all of it by (x, y) and turn it about the robot by a small angle."""
        away = self.path - np.array([pose.x, pose.y])
        self.path = self.path + [x, y] + turn * np.column_stack([-away[:, 1], away[:, 0]])

    def merge(self, found: Nearest, weight: Floats) -> None:
        """Average a sight into the points that it covers.

        Parameters
        ----------
        found : Nearest
            The sight's match with this line.
        weight : (N,) array
            1 / variance of the sight's points across the line.
        """
        lengths, on = self.lengths, found.on
        order = np.argsort(found.along[on], kind="stable")
        place, offset = found.along[on][order], found.offset[on][order]
        covered = (lengths >= place[0] - 0.5 * self.spacing) & (lengths <= place[-1] + 0.5 * self.spacing)
        covered &= self.missed >= 0  # once a frame: near a junction several sights pass, the fullest is merged first
        if not covered.any():
            return
        wanted = lengths[covered]
        seen = np.interp(wanted, place, weight[on][order])
        gain = seen / (self.weights[covered] + seen)
        tangent = directions(self.path)[covered]
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        self.path[covered] += (gain * np.interp(wanted, place, offset))[:, None] * normal
        self.weights[covered] = np.minimum(self.weights[covered] + seen, np.maximum(self._memory * seen, seen))
        self.missed[covered] = -1  # seen in this frame

    def note_missed(self, shown: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
        """Count, after all sights of a frame are merged, the points that were in view but not seen."""
        seen = self.missed < 0
        self.missed = np.where(seen, 0, self.missed + (shown & ~seen))
        self.shown = self.shown + seen

    def append(self, points: Floats, weight: float, join: float | None = None, leaves: float = math.inf) -> bool:
        """Prolong it by points at least half a spacing from its end, also round a sharp corner; whether it grew.

        Parameters
        ----------
        points : (N, 2) array
        weight : float
            1 / variance of the points across the line.
        join : float, optional
            The longest gap for this once.
        leaves : float
            Arc length at which the points leave it. What is remembered beyond goes: a view that ended in a corner
            showed the tape up to its outer border, and that would stay as a spike to drive round.
        """
        keep = self.lengths <= max(leaves, 0.0) + 1e-9
        away = np.hypot(*(points - self.path[keep][-1]).T)
        far = np.flatnonzero(away >= 0.5 * self.spacing)
        if len(far) == 0 or away[far[0]] > (self._join if join is None else join) or len(points) - far[0] < 2:
            return False
        self._keep(keep)
        added = resample(np.vstack([self.path[-1], points[int(far[0]) :]]), self.spacing)[1:]
        self.path = np.vstack([self.path, added])
        self.weights = np.concatenate([self.weights, np.full(len(added), weight)])
        self.missed = np.concatenate([self.missed, np.full(len(added), -1)])
        self.shown = np.concatenate([self.shown, np.zeros(len(added), dtype=np.int64)])
        return True

    def cut(self, s: float) -> None:
        """Forget what lies beyond arc length `s`."""
        self._keep(self.lengths <= s + 1e-9)

    def finish(self, here: float, behind: float) -> tuple[Floats, Floats]:
        """Drop what lies more than `behind` metres behind arc length `here`, and even out the spacing of the rest.

        Returns
        -------
        points : (N, 2) array
            What was dropped.
        back : (N,) array
            Metres along the line from each of them to `here`.
        """
        lengths = self.lengths
        old = lengths < here - behind
        dropped = self.path[old], here - lengths[old]
        if old.any():
            self._keep(~old)
            lengths = self.lengths
        steps = np.diff(lengths)
        if len(steps) and (steps.min() < 0.5 * self.spacing or steps.max() > 1.5 * self.spacing):
            even = resample(self.path, self.spacing)
            wanted = np.linspace(0.0, lengths[-1], len(even))
            self.weights = np.interp(wanted, lengths, self.weights)
            nearest_ones = np.clip(np.searchsorted(lengths, wanted), 0, len(lengths) - 1)
            self.missed, self.shown = self.missed[nearest_ones], self.shown[nearest_ones]
            self.path = even
        return dropped

    def _keep(self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
        self.path, self.weights = self.path[keep], self.weights[keep]
        self.missed, self.shown = self.missed[keep], self.shown[keep]

    def end_direction(self) -> Floats:
        """Unit vector (2,) in which it ends."""
        return end_direction(self.path, 0.1)


def approach(pose: Pose, points: Floats) -> Floats:
    """A smooth way (M, 2) from the robot to the first of the points: a cubic Hermite curve."""
    here, ahead = np.array([pose.x, pose.y]), np.array([math.cos(pose.heading), math.sin(pose.heading)])
    into = -end_direction(points[::-1], 0.1)
    size = float(np.hypot(*(points[0] - here)))
    s = np.linspace(0.0, 1.0, 20)[:-1, None]
    way: Floats = (
        (2 * s**3 - 3 * s**2 + 1) * here
        + (s**3 - 2 * s**2 + s) * size * ahead
        + (3 * s**2 - 2 * s**3) * points[0]
        + (s**3 - s**2) * size * into
    )
    return way
