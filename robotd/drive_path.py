"""The path that the robot drives along a line: the line itself or the shortest way beside it, as smooth as wheels need.

`corner_cut` says which: 0 follows the line exactly, 1 takes the shortest path that stays within a corridor about it,
and values between narrow the corridor (the appended paper of the thesis: "for fast navigation the path can be optimized
to be as short as possible and for exact navigation the path can be exactly followed"). The shortest path through a
corridor is a taut string: Lee and Preparata, "Euclidean shortest paths in the presence of rectilinear barriers",
Networks 14 (1984), the funnel algorithm. Whatever comes out is smoothed by a kernel that leaves lines and arcs as they
are and rounds sharp corners; its size bounds the curvature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .records import Floats

STEP = 0.01  # m between points
NARROWEST = 0.001  # m: a corridor that is narrower is none
SIGMA = 0.028  # m of the smoothing: a right angle is cut by about 7 mm and curves at 25 mm


@dataclass(frozen=True, slots=True, eq=False)
class DrivePath:
    """A smooth path by arc length.

    Attributes
    ----------
    s : (N,) array
        Arc length in metres from the path's start, evenly spaced.
    points : (N, 2) array
    heading : (N,) array
        Radians, not wrapped.
    curvature : (N,) array
        1 / m, positive to the left.
    """

    s: Floats
    points: Floats
    heading: Floats
    curvature: Floats

    @property
    def length(self) -> float:
        return float(self.s[-1])


def drive_path(line: Floats, corner_cut: float = 0.0, corridor: float = 0.05) -> DrivePath:
    """The path to drive along a line.

    Parameters
    ----------
    line : (N, 2) array, N >= 2
        In the direction of travel, metres.
    corner_cut : float
        0: exactly along the line; 1: the shortest path within the corridor.
    corridor : float
        Metres to either side of the line.
    """
    points = _even(np.asarray(line, dtype=np.float64))
    if corner_cut * corridor >= NARROWEST and len(points) > 3:
        points = _even(taut(points, corner_cut * corridor))
    points = _even(smooth(points, SIGMA / STEP))
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    course = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    middle = 0.5 * (s[1:] + s[:-1])
    heading = np.interp(s, middle, course)
    window = min(0.02, 0.25 * float(s[-1]))
    curvature = (np.interp(s + window, middle, course) - np.interp(s - window, middle, course)) / (2.0 * window)
    curvature[(s < middle[0] + window) | (s > middle[-1] - window)] = 0.0
    return DrivePath(s, points, heading, curvature)


def smooth(points: Floats, sigma: float) -> Floats:
    """Convolve evenly spaced points (N, 2) with 2 G - G * G, which keeps cubics, and keep the ends where they are.

    Parameters
    ----------
    points : (N, 2) array
    sigma : float
        Of the Gaussian G, in points.
    """
    reach = math.ceil(4.5 * sigma)
    x = np.arange(-reach, reach + 1)
    narrow, wide = np.exp(-0.5 * (x / sigma) ** 2), np.exp(-0.25 * (x / sigma) ** 2)
    kernel = 2.0 * narrow / narrow.sum() - wide / wide.sum()
    # beyond an end the path goes on point-symmetrically, so that it ends where it ended
    count = min(reach, len(points) - 1)
    before, after = 2.0 * points[0] - points[count:0:-1], 2.0 * points[-1] - points[-2 : -count - 2 : -1]
    if count < reach:
        before = np.vstack([before[0] + np.arange(count - reach, 0)[:, None] * (before[1] - before[0]), before])
        after = np.vstack([after, after[-1] + np.arange(1, reach - count + 1)[:, None] * (after[-1] - after[-2])])
    padded = np.vstack([before, points, after])
    return np.asarray(np.column_stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)]))


def taut(points: Floats, half: float) -> Floats:
    """The shortest path from the first to the last point that crosses a gate of `half` metres to each side of each.

    The funnel algorithm: walk along the gates with a cone of sight from the apex; where a side of the cone crosses the
    other, the string bends there, and that gate's end is the next apex.

    Parameters
    ----------
    points : (N, 2) array
        N >= 3, evenly spaced; bends tighter than `half` are the same as bends of that radius.
    half : float
        Metres.

    Returns
    -------
    (M, 2) array
        The bends, with both ends.
    """
    # gates turn gradually round a sharp corner, so that there too they hardly cross each other inside it
    step = float(np.hypot(*np.diff(points, axis=0).T).mean())
    tangent = np.gradient(smooth(points, 0.7 * half / step), axis=0)
    tangent /= np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-12)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    bend = np.gradient(heading) / step
    room = 0.9 / np.maximum(np.abs(bend), 1e-9)  # gates of a tight bend must not cross each other inside it
    to_left = np.where(bend > 0.0, np.minimum(half, room), half)
    to_right = np.where(bend < 0.0, np.minimum(half, room), half)
    to_left[[0, -1]] = to_right[[0, -1]] = 0.0
    lefts = [(float(x), float(y)) for x, y in points + to_left[:, None] * normal]
    rights = [(float(x), float(y)) for x, y in points - to_right[:, None] * normal]
    apex, left, right = lefts[0], lefts[0], rights[0]
    left_at = right_at = 0
    path = [apex]
    k = 1
    while k < len(lefts):
        if _area(apex, right, rights[k]) >= 0.0:
            if apex == right or _area(apex, left, rights[k]) < 0.0:
                right, right_at = rights[k], k
            else:
                apex = left
                path.append(apex)
                k = left_at
                left = right = apex
                right_at = left_at
                k += 1
                continue
        if _area(apex, left, lefts[k]) <= 0.0:
            if apex == left or _area(apex, right, lefts[k]) > 0.0:
                left, left_at = lefts[k], k
            else:
                apex = right
                path.append(apex)
                k = right_at
                left = right = apex
                left_at = right_at
                k += 1
                continue
        k += 1
    if path[-1] != lefts[-1]:
        path.append(lefts[-1])
    return np.array(path)


def _area(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    """Twice the signed area of a triangle: positive if c is to the left of the way from a to b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _even(points: Floats) -> Floats:
    steps = np.hypot(*np.diff(points, axis=0).T)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.linspace(0.0, lengths[-1], max(2, round(float(lengths[-1]) / STEP)) + 1)
    return np.column_stack([np.interp(wanted, lengths, points[:, k]) for k in (0, 1)])
