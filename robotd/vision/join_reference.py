"""The kernels of `_join` in numpy: their oracle in tests, and what runs when the extension was not built.

Pieces are rows of numbers, see `polyline_reference.PIECE`; all in working pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .polyline_reference import PIECE

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]

LEAST_STEP = 0.06  # from line to floor of a piece that is followed, as a share of the grey level
GOES_ON = 0.5  # of its usual step that both borders keep where a line goes on
ALIKE = 0.5  # ratio of the steps of pieces of one line
DARK = 8.0  # grey levels of a camera's black, with a margin
MOST_MISSED = 1.0  # widths that glare or dirt may hide


@dataclass(frozen=True)
class _View:
    image: Bytes
    valid: Bytes
    sign: float

    def at(self, u: float, v: float) -> float:
        """Grey level between pixels, or -1 outside."""
        height, width = self.image.shape
        if not (0.0 <= u < width - 1 and 0.0 <= v < height - 1):
            return -1.0
        col, row = int(u), int(v)
        if len(self.valid) and self.valid[row, col] == 0:
            return -1.0
        a, b = u - col, v - row
        (p, q), (r, s) = self.image[row : row + 2, col : col + 2].astype(np.float64).tolist()
        return float((1.0 - b) * ((1.0 - a) * p + a * q) + b * ((1.0 - a) * r + a * s))

    def border(self, at: Floats, way: Floats, back: float, half: float, side: float) -> tuple[float, float]:
        """The step from line to floor near a border: its height, or -1 out of view, and how far off it lies.

        Heights are shares of the grey level there, because a shadow takes from line and floor alike.
        """
        profile = []
        for k in range(9):
            reach = side * half * (0.4 + 0.15 * k)
            beside = at + reach * np.array([-way[1], way[0]])
            one, two = self.at(*beside), self.at(*(beside - back * way))
            if one < 0.0 or two < 0.0:
                return -1.0, 0.0
            profile.append(0.5 * (one + two))
        best, off = 0.0, 0.0
        for k in range(2, 7):
            one, two = profile[k - 2] + profile[k - 1], profile[k + 1] + profile[k + 2]
            step = 2.0 * self.sign * (one - two) / (one + two + 4.0 * DARK)
            if step > best:
                best, off = step, 0.15 * (k - 4) * half
        return best, off

    def usual(self, path: Floats, last: bool, half: float, reach: float, back: float) -> float:
        """Mean height of the weaker border over the last `reach` of a piece, 0 if it is out of view."""
        ordered = path[::-1] if last else path
        steps, gone = [], 0.0
        for before, at in pairwise(ordered):
            if gone >= reach:
                break
            size = float(np.hypot(*(before - at)))
            gone += size
            if size <= 0.0:
                continue
            way = (before - at) / size
            heights = [self.border(at, way, back, half, side)[0] for side in (-1.0, 1.0)]
            if min(heights) >= 0.0:
                steps.append(min(heights))
        return float(np.mean(steps)) if steps else 0.0


def extend(
    image: Bytes,
    valid: Bytes,
    sign: float,
    points: Singles,
    pieces: Singles,
    count: int,
    way: Singles,
    out_points: Singles,
    out_pieces: Singles,
) -> int:
    """Follow lines beyond the ends of what was traced, as far as both their borders go on.

    From each end we go 0.4 widths at a time, straight on or turned by up to 0.36 radians, to where the weaker of the
    two borders is strongest. A border is a step of the right sign within 0.3 half widths of where it is expected; the
    width must stay within a quarter, and the steps must keep half of what is usual in the last four widths of the
    piece. One width may be hidden. Where one border is out of view the other decides, with more demanded of it.

    Parameters
    ----------
    image : (H, W) uint8 array
        In working pixels.
    valid : (H, W) uint8 array, or no rows where all is usable.
    sign : -1 for dark lines, +1 for bright ones.
    points, pieces, count : as `polyline_reference.trace` or `join` gives them.
    way : (T, 2) array of scratch; T limits the points added to one end.
    out_points, out_pieces : arrays to fill likewise.

    Returns
    -------
    How many points were added in all.
    """
    view = _View(image, valid, sign)
    rows = pieces[:count].astype(np.float64)
    paths = [points[int(row[0]) : int(row[0] + row[1])].astype(np.float64) for row in rows]
    used = added = 0
    for i, (path, row) in enumerate(zip(paths, rows, strict=True)):
        ends: list[tuple[list[Floats], float]] = [([], 0.0), ([], 0.0)]
        room = len(out_points) - used - len(path)
        if row[8] == 0.0 and room > 0:
            for last in (False, True):
                ends[last] = _onwards(view, paths, rows, i, last, min(len(way), room))
                room -= len(ends[last][0])
        (before, one), (after, two) = ends
        whole = np.array([*before[::-1], *path, *after])[: len(out_points) - used]
        out_points[used : used + len(whole)] = whole
        out_pieces[i] = pieces[i]
        out_pieces[i, :3] = used, len(whole), max(row[2] + 0.5 * row[3] * (two - one), 0.5 * row[2])
        out_pieces[i, 10] = row[10] + one + two
        used += len(whole)
        added += len(before) + len(after)
    return added


def _onwards(
    view: _View, paths: list[Floats], rows: Floats, own: int, last: bool, capacity: int
) -> tuple[list[Floats], float]:
    """The points beyond an end of a piece, and their length."""
    row, path = rows[own], paths[own]
    end = _end(path, row, last)
    width, grow = end.width, row[3] if last else -row[3]
    step = 0.4 * width if width > 5.0 else 2.0
    usual = view.usual(path, last, 0.5 * width, 4.0 * width, 0.5 * step)
    if usual < LEAST_STEP:
        return [], 0.0
    others = np.vstack([np.empty((0, 2)), *(other for k, other in enumerate(paths) if k != own)])
    at, way = end.at, end.out
    found: list[Floats] = []
    far = gone = length = 0.0
    missed = False
    while len(found) < capacity:
        half = max(0.5 * (width + grow * gone), 0.25 * width)
        best: tuple[float, Floats, float] | None = None
        for fan in (0, 1, -1, 2, -2) if not missed else (0,):
            c, s = math.cos(0.18 * fan), math.sin(0.18 * fan)
            turned = np.array([way[0] * c - way[1] * s, way[0] * s + way[1] * c])
            one, two = (view.border(at + step * turned, turned, 0.5 * step, half, side) for side in (-1.0, 1.0))
            if one[0] < 0.0 and two[0] < 0.0:
                if fan == 0:
                    break  # out of view: a turn that stays in it is no better
                continue
            if one[0] < 0.0 or two[0] < 0.0:  # at the edge of the view: one border, not well enough known to move by
                height, shift = 0.7 * max(one[0], two[0]), 0.0
                if abs(one[1] + two[1]) > 0.2 * half:
                    height = 0.0
            else:
                height, shift = min(one[0], two[0]), 0.5 * (two[1] - one[1])
                if abs(one[1] + two[1]) > 0.5 * half:
                    height = 0.0
            height *= 1.0 - 0.04 * abs(fan)
            if best is None or height > best[0]:
                best = height, turned, shift
        if best is None:
            break
        height, turned, shift = best
        at = at + step * turned
        far += step
        gone += step
        if height < GOES_ON * usual:
            missed = True
            if far > MOST_MISSED * width:
                break
            continue
        across = np.array([-turned[1], turned[0]])
        centre = at + shift * across
        if view.at(*centre) < 0.0 or (((others - centre) ** 2).sum(axis=1) < (0.4 * width) ** 2).any():
            break
        at = centre
        found.append(at)
        length += far
        # half the correction, because a border is known to a few tenths of a pixel only
        way = turned + 0.5 * shift / far * across
        way = way / np.hypot(*way)
        far, missed = 0.0, False
    return found, length


@dataclass
class _End:
    at: NDArray[np.float64]
    out: NDArray[np.float64]  # unit direction out of the piece
    width: float
    mate: int = -1
    corner: NDArray[np.float64] | None = None
    step: float = -1.0  # usual height of its borders, or -1 if not yet measured


def join(
    image: Bytes,
    valid: Bytes,
    sign: float,
    points: Singles,
    pieces: Singles,
    count: int,
    out_points: Singles,
    out_pieces: Singles,
) -> int:
    """Join pieces whose ends face each other over a gap, the nearest first, then those that meet in a corner.

    Two ends belong together when their widths agree to 30 % and they face each other over a gap of at most 2.5 widths,
    or when both, prolonged, meet in a corner at most 2 widths ahead: the outer border of a corner has no partner, so
    strokes end before it. Their borders must also be about equally high, because one tape lies on one floor. Each end
    is joined once, and no rings are made.

    Parameters
    ----------
    image, valid, sign : as for `extend`.
    points, pieces, count : as `extend` or `polyline_reference.trace` gives them.
    out_points, out_pieces : arrays to fill likewise.

    Returns
    -------
    How many pieces there are afterwards.
    """
    view = _View(image, valid, sign)
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
                if not fits or (best is not None and square >= best[0]):
                    continue
                if _alike(view, paths, ends, i, j):
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


def _alike(view: _View, paths: list[Floats], ends: list[_End], i: int, j: int) -> bool:
    """Whether the borders at two ends are about equally high."""
    for k in (i, j):
        end = ends[k]
        if end.step < 0.0:
            end.step = view.usual(paths[k // 2], k % 2 == 1, 0.5 * end.width, 3.0 * end.width, 0.2 * end.width)
    return min(ends[i].step, ends[j].step) >= ALIKE * max(ends[i].step, ends[j].step)


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
