"""Where a robot can go from a survey: on along its line, the way it came once more, or over free floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.transforms import wrap_angle
from ..records import Floats

STEP_M = 0.2  # between two places along a line
_FINE_M = 0.02
_NEAR_M = 0.15  # farther from the line than at its nearest point, a stop may also have been made
_BACK_M = 0.05  # by which odometry may put a stop behind the one before it
FREE_STEP_M, FREE_REACH_M = 0.3, 1.2  # of places beside the way, and how far from it they are looked for
CLEARANCE_M = 0.35  # from labels, because they hang on shelves


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Places (C, 3) x, y, heading at which a robot could stop.

    `along` (C,) are metres along the line, from where the first stop was made; NaN over free floor. `here` is where the
    last stop was made; None if the way begins anew, which no odometry joins to the survey. `floor` (K, 2) are points of
    the way's middle and `sides` (K, 2) unit normals: labels nobody has seen yet may be beside them.
    """

    places: Floats
    along: Floats
    here: float | None
    floor: Floats
    sides: Floats


def along_line(line: Floats, stops: Floats, first: Floats, again: bool, spacing: float) -> Way:
    """The rest of a line, or all of it once more.

    Parameters
    ----------
    line : (N, 2) array
        World metres, in the order driven.
    stops : (S, 3) array
        Poses of the stops of the newest leg; the robot stands at the last one.
    first : (3,) array
        Where distances along the line begin: pose of the survey's first stop.
    again : bool
        From the line's beginning in a new leg, also if some of it is ahead.
    spacing : float
        Metres between points of `floor`.
    """
    fine, arc = _resampled(line, _FINE_M)
    zero = arc[_nearest(fine, arc, first[:2], -np.inf)]
    at = -np.inf
    for stop in stops:
        at = arc[_nearest(fine, arc, stop[:2], at - _BACK_M)]
    end = float(arc[-1])
    if not again and end - at < STEP_M:
        again = True
    begin = float(zero) if again else float(at) + STEP_M
    where = np.arange(begin, end + 1e-9, STEP_M)
    places = np.column_stack([*(np.interp(where, arc, fine[:, k]) for k in (0, 1)), _headings(fine, arc, where)])
    floor = np.arange(zero if again else at, end + 1e-9, spacing)
    heading = _headings(fine, arc, floor)
    middle = np.column_stack([np.interp(floor, arc, fine[:, k]) for k in (0, 1)])
    here = None if again else float(at - zero)
    return Way(places, where - zero, here, middle, np.column_stack([-np.sin(heading), np.cos(heading)]))


def over_floor(stops: Floats, labels: Floats) -> Way:
    """Places on a grid that a straight drive from the way so far reaches without coming near a label.

    Parameters
    ----------
    stops : (S, 3) array
        Poses so far; the robot stands at the last one.
    labels : (L, 2) array
        On the plan.
    """
    low, high = stops[:, :2].min(axis=0) - FREE_REACH_M, stops[:, :2].max(axis=0) + FREE_REACH_M
    grid = np.stack(np.meshgrid(*(np.arange(a, b, FREE_STEP_M) for a, b in zip(low, high, strict=True))), -1)
    grid = grid.reshape(-1, 2)
    away = np.linalg.norm(grid[:, None] - stops[:, :2], axis=2)
    nearest = away.argmin(axis=1)
    start = stops[nearest, :2]
    if len(labels):
        share = np.einsum("lgk,gk->gl", labels[:, None] - start, grid - start)
        share = np.clip(share / np.maximum(away.min(axis=1) ** 2, 1e-9)[:, None], 0.0, 1.0)
        passing = start[:, None] + share[:, :, None] * (grid - start)[:, None]
        clear = np.linalg.norm(labels - passing, axis=2).min(axis=1)
    else:
        clear = np.full(len(grid), np.inf)
    kept = (away.min(axis=1) <= FREE_REACH_M) & (clear >= CLEARANCE_M)
    turn = np.arctan2(*(grid - stops[-1, :2])[kept].T[::-1])
    none = np.zeros((0, 2))
    places = np.column_stack([grid[kept], turn])
    return Way(places, np.full(len(places), np.nan), 0.0, none, none)


def _resampled(points: Floats, step: float) -> tuple[Floats, Floats]:
    """Points of a polyline at equal distances, and those distances."""
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    kept = np.concatenate([[True], np.diff(lengths) > 1e-9])
    arc = np.linspace(0.0, lengths[-1], max(2, round(lengths[-1] / step) + 1))
    return np.column_stack([np.interp(arc, lengths[kept], points[kept, k]) for k in (0, 1)]), arc


def _nearest(points: Floats, arc: Floats, place: Floats, least: float) -> int:
    """The first point, from `least` metres on, that is about as near to a place as any."""
    away = np.hypot(*(points - place).T)
    away = np.where(arc >= least, away, np.inf)
    near = np.flatnonzero(away <= away.min() + _NEAR_M)
    gap = np.flatnonzero(np.diff(near) > 1)
    first = near[: gap[0] + 1] if len(gap) else near
    return int(first[away[first].argmin()])


def _headings(points: Floats, arc: Floats, where: Floats) -> Floats:
    slope = np.gradient(points, arc, axis=0)
    turn = np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))
    return np.asarray(wrap_angle(np.interp(where, arc, turn)))
