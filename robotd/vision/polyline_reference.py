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


@dataclass
class _End:
    at: NDArray[np.float64]
    out: NDArray[np.float64]  # unit direction out of the piece
    width: float
    mate: int = -1
    corner: NDArray[np.float64] | None = None


def join(points: Singles, pieces: Singles, count: int, out_points: Singles, out_pieces: Singles) -> int:
    """Join pieces whose ends face each other over a gap, the nearest first, then those that meet in a corner.

    Two ends belong together when their widths agree to 30 % and they face each other over a gap of at most 2.5 widths,
    or when both, prolonged, meet in a corner at most 2 widths ahead: the outer border of a corner has no partner, so
    strokes end before it. Each end is joined once, and no rings are made.

    Parameters
    ----------
    points, pieces, count : as `trace` gives them.
    out_points, out_pieces : arrays to fill likewise.

    Returns
    -------
    How many pieces there are afterwards.
    """
    rows = pieces[: min(count, 64)].astype(np.float64)
    paths = [points[int(row[0]) : int(row[0] + row[1])].astype(np.float64) for row in rows]
    ends = [_end(path, row, last) for path, row in zip(paths, rows, strict=True) for last in (False, True)]
    group = list(range(len(rows)))
    while True:
        best: tuple[float, int, int, NDArray[np.float64] | None] | None = None
        for i, one in enumerate(ends):
            for j in range(i + 1, len(ends)):
                two = ends[j]
                taken = one.mate >= 0 or two.mate >= 0 or rows[i // 2, 8] > 0.0 or rows[j // 2, 8] > 0.0
                if taken or group[i // 2] == group[j // 2]:
                    continue
                square = float(((one.at - two.at) ** 2).sum())
                if (best is not None and square >= best[0]) or square > 11.7 * one.width * two.width:
                    continue
                fits, corner = _belong(one, two)
                square += 1e8 * (corner is not None)  # straight on, at crossings, comes before round a corner
                if fits and (best is None or square < best[0]):
                    best = square, i, j, corner
        if best is None:
            break
        _, i, j, corner = best
        ends[i].mate, ends[j].mate = j, i
        ends[i].corner = ends[j].corner = corner
        old, new = group[j // 2], group[i // 2]
        group = [new if item == old else item for item in group]
    found = used = 0
    done: set[int] = set()
    for i in range(len(rows)):
        if i in done:
            continue
        current = 2 * i
        for _ in range(len(rows)):
            if ends[current].mate < 0:
                break
            current = ends[current].mate ^ 1
        chain, row = _chain(current, ends, paths, rows, done, len(out_points) - used)
        if len(chain) < 2:
            continue
        out_points[used : used + len(chain)] = chain
        row[:2] = used, len(chain)
        out_pieces[found] = row
        used += len(chain)
        found += 1
    return found


def _end(path: NDArray[np.float64], row: NDArray[np.float64], last: bool) -> _End:
    """Where a piece ends, and its direction there, over a width of its length."""
    ordered = path[::-1] if last else path
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ordered, axis=0).T))])
    back = min(int(np.searchsorted(lengths, row[2])), len(path) - 1)
    out = ordered[0] - ordered[back]
    width = row[2] + row[3] * (0.5 if last else -0.5) * row[10]
    return _End(ordered[0], out / max(float(np.hypot(*out)), 1e-6), max(width, 0.5 * row[2]))


def _belong(one: _End, two: _End) -> tuple[bool, NDArray[np.float64] | None]:
    """Whether two ends belong together, and the place of the corner between them if there is one."""
    gap, width = two.at - one.at, 0.5 * (one.width + two.width)
    distance, facing = float(np.hypot(*gap)), -float(one.out @ two.out)
    if distance > 3.0 * width or one.width > 1.3 * two.width or two.width > 1.3 * one.width:
        return False, None
    if distance < 0.25 * width and facing > 0.5:
        return True, None
    if facing > 0.9 and min(one.out @ gap, -two.out @ gap) > 0.92 * distance and distance <= 2.5 * width:
        return True, None
    if abs(facing) > 0.87:  # nearly parallel: their crossing is no corner
        return False, None
    det = one.out[1] * two.out[0] - one.out[0] * two.out[1]
    ahead = (gap[1] * two.out[0] - gap[0] * two.out[1]) / det
    behind = (one.out[0] * gap[1] - one.out[1] * gap[0]) / det
    fits = -0.75 * width <= ahead <= 2.0 * width and -0.75 * width <= behind <= 2.0 * width
    return fits, one.at + ahead * one.out if fits else None


def _chain(
    current: int,
    ends: list[_End],
    paths: list[NDArray[np.float64]],
    rows: NDArray[np.float64],
    done: set[int],
    room: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """All that hangs together from the first end `current` on: points, and the row of the whole."""
    parts: list[NDArray[np.float64]] = []
    row = np.zeros(len(PIECE))
    nodes: list[tuple[float, float, float]] = []
    arc = total = 0.0
    while True:
        piece = rows[current // 2]
        done.add(current // 2)
        path = paths[current // 2][:: -1 if current % 2 else 1]
        for end in (ends[current], ends[current ^ 1]):
            if end.corner is not None:  # without what lies beyond it
                path = path[(path - end.corner) @ end.out <= 0.0]
        if parts and len(path):
            gap = float(np.hypot(*(path[0] - parts[-1][-1])))
            arc += gap
            row[6] += int(gap / (0.4 * piece[2] if piece[2] > 5.0 else 2.0))
        if len(path):
            parts.append(path)
        weight = piece[7]
        nodes += [(arc, ends[current].width, weight), (arc + piece[10], ends[current ^ 1].width, weight)]
        arc += piece[10]
        row[[4, 9]] += weight * piece[[4, 9]]
        row[[5, 6, 7]] += piece[[5, 6, 7]]
        row[8] = piece[8]
        total += weight
        end = ends[current ^ 1]
        if end.mate < 0:
            break
        if end.corner is not None:
            parts.append(end.corner[None])
        current = end.mate
    chain = np.vstack(parts)[:room] if parts else np.empty((0, 2))
    at, widths, weights = np.array(nodes).T
    at = at - 0.5 * arc
    mean, tilt = weights @ at, weights @ (at * at)
    det = weights.sum() * tilt - mean**2
    slope = (weights.sum() * (weights @ (at * widths)) - mean * (weights @ widths)) / det if det > 0.0 else 0.0
    row[2], row[3] = (weights @ widths - slope * mean) / weights.sum(), slope
    row[[4, 9]] /= total
    row[10] = np.hypot(*np.diff(chain, axis=0).T).sum() if len(chain) > 1 else 0.0
    return chain, row
