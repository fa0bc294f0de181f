"""The kernels of `_polyline` in numpy: their oracle in tests, and what runs when the extension was not built.

Pieces are rows of eleven numbers, see `PIECE`: where a polyline's points begin, how many they are, the width of the
line at half its length and its change per pixel, the mean deviation of the stroke widths from that, how many windows of
the trace held strokes and how many were passed, the strokes claimed, 1 if closed, the strokes' mean distance from the
polyline, and its length; all in working pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]
Integers = NDArray[np.int32]
Bytes = NDArray[np.uint8]

PIECE = ("start", "count", "width", "slope", "spread", "filled", "passed", "strokes", "closed", "ragged", "length")


def trace(
    stroke: Singles,
    counts: Integers,
    first: Integers,
    axis: Integers,
    aligned: float,
    least_length: float,
    most_spread: float,
    state: Bytes,
    place: Singles,
    forward: Singles,
    backward: Singles,
    points: Singles,
    pieces: Singles,
) -> int:
    """Follow the stroke centres of each cluster: the longest way through it, then its branches.

    From the free stroke with the most neighbours we go both ways, 0.4 widths at a time. Each new point is the mean of
    the strokes in a window round the predicted one (a step to either side along, 0.3 widths across, tangents within
    acos(`aligned`)); their mean tangent is the next direction. Where too few are in the window, windows up to two
    widths ahead are tried, each a little wider. Strokes that a polyline passes are claimed by it: the next one stops
    where it meets those.

    Parameters
    ----------
    stroke, counts, first, axis : as `cluster_reference.sort` gives them.
    least_length : in widths, of a piece that is kept.
    most_spread : share of the width that the stroke widths of a kept piece may deviate by in the mean.
    state, place, forward, backward : (N,), (N, 2), (T, 2), (T, 2) arrays of scratch; T limits a trace's points.
    points : (P, 2) array to fill with the points of all pieces.
    pieces : (M, 11) array to fill.

    Returns
    -------
    How many pieces were found.
    """
    found = used = 0
    for a, b in pairwise(first.tolist()):
        members = stroke[a:b].astype(np.float64)
        free = np.ones(b - a, dtype=np.uint8)  # 1 free, 2 claimed
        for _ in range(6):
            candidates = np.flatnonzero(free == 1)
            if found >= len(pieces) or len(candidates) < 4:
                break
            seed = int(candidates[np.argmax(counts[a:b][candidates])])
            width = members[seed, 4]
            if len(candidates) < 0.5 * width * least_length:
                break
            step, radius = (0.4 * width, 0.3 * width) if width > 5.0 else (2.0, 1.5)
            least = max(int(0.35 * step + 0.5), 2)
            at, tangent = members[seed, :2], members[seed, 2:4]
            one = _follow(members, free, at, tangent, step, radius, 2.0 * width, least, aligned, len(forward))
            two = _Way([], 0, 0, False)
            if not one.closed:
                two = _follow(members, free, at, -tangent, step, radius, 2.0 * width, least, aligned, len(backward))
            if used + len(one.points) + len(two.points) + 2 > len(points):
                break
            ends = (not one.points or not two.points) and not one.closed
            path = np.array(two.points[::-1] + [at] * ends + one.points).reshape(-1, 2)
            if one.closed:
                path = np.vstack([path, path[:1]])
            length = float(np.hypot(*np.diff(path, axis=0).T).sum())
            claimed, arc, away = _claim(members, free, path, 0.5 * width, aligned)
            free[seed] = 2
            if len(path) < 2 or len(claimed) < 4 or length < least_length * width:
                continue
            middle, slope, spread = _widths(arc - 0.5 * length, members[claimed, 4])
            if middle <= 0.0 or spread > most_spread * middle or length < least_length * middle:
                continue
            points[used : used + len(path)] = path
            pieces[found] = (
                used, len(path), middle, slope, spread, one.filled + two.filled, one.travelled + two.travelled,
                len(claimed), one.closed, away.mean(), length,
            )  # fmt: skip
            used += len(path)
            found += 1
    return found


@dataclass
class _Way:
    points: list[NDArray[np.float64]]
    filled: int
    travelled: int
    closed: bool


def _follow(
    stroke: NDArray[np.float64],
    state: Bytes,
    at: NDArray[np.float64],
    direction: NDArray[np.float64],
    step: float,
    radius: float,
    gap: float,
    least: int,
    aligned: float,
    capacity: int,
) -> _Way:
    way = _Way([], 0, 0, False)
    start, start_direction = at, direction
    while len(way.points) < capacity - 1:
        for jump in range(1, int(gap / step) + 2):
            middle = at + direction * step * jump
            wide = radius * (1.0 + 0.25 * (jump - 1))
            along, across, turn = _relative(stroke, middle, direction)
            # a little less than the step, because the stroke that it began at lies exactly there
            inside = (np.abs(along) <= 0.99 * step) & (np.abs(across) <= wide) & (np.abs(turn) >= aligned)
            if not inside.any():
                continue
            claimed = float((state[inside] == 2).mean())
            ahead = along[inside].mean() > -0.75 * step
            if inside.sum() >= least and ahead and not (jump > 1 and claimed > 0.5):
                break
        else:
            break
        if claimed > 0.6:
            break
        at = middle + along[inside].mean() * direction
        at = at + across[inside].mean() * np.array([-direction[1], direction[0]])
        tangent = (stroke[inside, 2:4] * np.where(turn[inside] > 0.0, 1.0, -1.0)[:, None]).sum(axis=0)
        direction = tangent / np.hypot(*tangent)
        way.points.append(at)
        way.filled += 1
        way.travelled += jump
        home = ((at - start) ** 2).sum() < step * step and direction @ start_direction > aligned
        if way.travelled > 6 and home:
            way.closed = True
            return way
    along, across, turn = _relative(stroke, at, direction)
    ahead = (
        (state == 1) & (along > 0.0) & (along <= 1.5 * step) & (np.abs(across) <= radius) & (np.abs(turn) >= aligned)
    )
    if ahead.any():
        way.points.append(at + along[ahead].max() * direction)
    return way


def _relative(
    stroke: NDArray[np.float64], at: NDArray[np.float64], direction: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Each stroke's place along and across a direction, and the cosine of its tangent to it."""
    ru, rv = stroke[:, 0] - at[0], stroke[:, 1] - at[1]
    along = ru * direction[0] + rv * direction[1]
    across = rv * direction[0] - ru * direction[1]
    return along, across, stroke[:, 2] * direction[0] + stroke[:, 3] * direction[1]


def _claim(
    stroke: NDArray[np.float64], state: Bytes, path: NDArray[np.float64], radius: float, aligned: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Mark the free strokes on a polyline as claimed: which, and their arc lengths and distances."""
    nearest = np.full(len(stroke), np.inf)
    arc = np.zeros(len(stroke))
    passed = 0.0
    for one, two in pairwise(path):
        length = float(np.hypot(*(two - one)))
        if length <= 0.0:
            continue
        along, across, turn = _relative(stroke, one, (two - one) / length)
        on = (state == 1) & (along >= -radius) & (along <= length + radius) & (np.abs(across) <= radius)
        on &= (np.abs(turn) >= aligned) & (np.abs(across) < nearest)
        nearest[on], arc[on] = np.abs(across)[on], passed + along[on]
        passed += length
    claimed = np.flatnonzero(np.isfinite(nearest))
    state[claimed] = 2
    return claimed, arc[claimed], nearest[claimed]


def _widths(arc: NDArray[np.float64], width: NDArray[np.float64]) -> tuple[float, float, float]:
    """Robust straight fit of widths over the arc length: at its middle, per pixel, and the mean deviation."""
    kept = np.ones(len(arc), dtype=bool)
    middle = slope = spread = 0.0
    for _ in range(3):
        count = int(kept.sum())
        if count < 3:
            break
        s, w = arc[kept], width[kept]
        det = count * (s * s).sum() - s.sum() ** 2
        slope = (count * (s * w).sum() - s.sum() * w.sum()) / det if det > 1e-3 * count**2 else 0.0
        slope = min(max(slope, -0.4), 0.4)
        middle = (w.sum() - slope * s.sum()) / count
        away = np.abs(width - middle - slope * arc)
        spread = float(away.mean())
        kept = away <= 1.5 * spread
    return middle, slope, spread
