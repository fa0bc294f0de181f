"""The kernels of `_stroke` in numpy: their oracle in tests, and what runs when the extension was not built.

Edges are rows (u, v, nu, nv, magnitude): a sub-pixel point, the unit gradient there (towards brighter) and its length.
Strokes are rows (u, v, tu, tv, width, strength): the midpoint between two opposite edges, the unit tangent of the line
(its sign means nothing), the distance of the edges and the weaker of their gradients.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]
Integers = NDArray[np.int32]
Bytes = NDArray[np.uint8]

_ONE = np.float32(1.0)


def edges(
    gx: NDArray[np.int16],
    gy: NDArray[np.int16],
    valid: Bytes,
    factor: float,
    low: float,
    high: float,
    magnitude: Singles,
    index: Integers,
    out: Singles,
) -> tuple[int, float]:
    """Thin edges: pixels whose gradient is a local maximum along the axis that it is nearest to.

    A parabola through the three magnitudes gives the sub-pixel position on that axis. The threshold is `factor` times
    the mean magnitude of the valid pixels, clipped to [low, high].

    Parameters
    ----------
    gx, gy : (H, W) int16 arrays
        Sobel derivatives.
    valid : (H, W) uint8 array
        1 where the derivatives may be used, 0 elsewhere.
    magnitude, index : (H, W) arrays to fill
        Gradient length (0 where invalid), and the row of `out` for each thin edge pixel (-1 elsewhere).
    out : (N, 5) array to fill with edges, row by row of the image; further ones are dropped.

    Returns
    -------
    How many edges were found, and the threshold.
    """
    wide_x, wide_y = gx.astype(np.int32), gy.astype(np.int32)
    magnitude[:] = np.sqrt((wide_x * wide_x + wide_y * wide_y).astype(np.float32)) * valid
    level = factor * float(magnitude.sum(dtype=np.float64)) / max(int(valid.sum(dtype=np.int64)), 1)
    level = float(np.float32(min(max(level, low), high)))
    across = (wide_x * wide_x >= wide_y * wide_y)[1:-1, 1:-1]
    here = magnitude[1:-1, 1:-1]
    before = np.where(across, magnitude[1:-1, :-2], magnitude[:-2, 1:-1])
    after = np.where(across, magnitude[1:-1, 2:], magnitude[2:, 1:-1])
    peak = (here >= np.float32(level)) & (before != 0) & (after != 0) & (here >= before) & (here > after)
    rows, cols = np.nonzero(peak)
    rows, cols = rows[: len(out)], cols[: len(out)]
    a, b, c = before[rows, cols], here[rows, cols], after[rows, cols]
    shift = np.float32(0.5) * (a - c) / (a - np.float32(2.0) * b + c)
    across = across[rows, cols]
    rows, cols, found = rows + 1, cols + 1, len(rows)
    out[:found, 0] = cols + np.where(across, shift, np.float32(0.0))
    out[:found, 1] = rows + np.where(across, np.float32(0.0), shift)
    out[:found, 2] = gx[rows, cols] / b
    out[:found, 3] = gy[rows, cols] / b
    out[:found, 4] = b
    index[:] = -1
    index[rows, cols] = np.arange(found, dtype=np.int32)
    return found, level


def strokes(
    edge: Singles,
    count: int,
    index: Integers,
    low: float,
    high: float,
    sign: float,
    parallel: float,
    mutual: float,
    partner: Integers,
    out: Singles,
) -> int:
    """Walk from every edge along its gradient to an opposite edge, and keep the pairs that find each other.

    The walk takes whole pixels along the longer axis, looks one pixel to each side of it, passes over edges that are
    not opposite (texture inside the line) and ends at the first partner whose gradient opposes (dot product below
    -`parallel`) at a distance, along the mean normal, from `low` to `high`.

    Parameters
    ----------
    sign : -1 walks against the gradient (dark lines), +1 along it (bright lines).
    mutual : a pair counts if the partner's own walk ends within this share of the width (or 2 px) of the start.
    partner : (N,) array to fill with each edge's partner or -1.
    out : (M, 6) array to fill with strokes, in the order of the edges; further ones are dropped.

    Returns
    -------
    How many strokes were found. Thesis section 5.2.3 without its split into start and end pixels (errata B10).
    """
    height, width = index.shape
    edge = edge[:count]
    partner[:count] = -1
    if count == 0:
        return 0
    direction = np.float32(sign) * edge[:, 2:4]
    horizontal = np.abs(direction[:, 0]) >= np.abs(direction[:, 1])
    major = np.where(horizontal, np.abs(direction[:, 0]), np.abs(direction[:, 1]))
    direction = direction / major[:, None]
    first = np.maximum((np.float32(low) * major).astype(int) - 1, 1)
    last = (np.float32(high) * major).astype(int) + 2
    walking = np.ones(count, dtype=bool)
    for step in range(int(first.min()), int(last.max())):
        at = np.floor(edge[:, :2] + direction * np.float32(step) + np.float32(0.5)).astype(int)
        started = step >= first
        inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
        walking &= (step < last) & (inside | ~started)
        for side in (0, 1, -1):
            active = np.flatnonzero(walking & started & (partner[:count] < 0))
            col = at[active, 0] + np.where(horizontal[active], 0, side)
            row = at[active, 1] + np.where(horizontal[active], side, 0)
            fits = (col >= 0) & (row >= 0) & (col < width) & (row < height)
            active, col, row = active[fits], col[fits], row[fits]
            other = index[row, col]
            active, other = active[other >= 0], other[other >= 0]
            opposite = (edge[active, 2:4] * edge[other, 2:4]).sum(axis=1) <= -np.float32(parallel)
            active, other = active[opposite], other[opposite]
            across = np.float32(sign) * _across(edge[active], edge[other])
            fits = (across >= np.float32(low)) & (across <= np.float32(high))
            partner[active[fits]] = other[fits]
    start = np.flatnonzero(partner[:count] >= 0)
    start = start[partner[partner[start]] >= 0]
    end = partner[start]
    back = partner[end]
    across = np.float32(sign) * _across(edge[start], edge[end])
    gap = ((edge[back, :2] - edge[start, :2]) ** 2).sum(axis=1)
    kept = (gap <= 4.0) | (gap <= (np.float32(mutual) * across) ** 2)
    start, end, across = start[kept][: len(out)], end[kept][: len(out)], across[kept][: len(out)]
    normal = edge[start, 2:4] - edge[end, 2:4]
    normal /= np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    found = len(start)
    out[:found, :2] = np.float32(0.5) * (edge[start, :2] + edge[end, :2])
    out[:found, 2] = -normal[:, 1]
    out[:found, 3] = normal[:, 0]
    out[:found, 4] = across
    out[:found, 5] = np.minimum(edge[start, 4], edge[end, 4])
    return found


def _across(edge: Singles, other: Singles) -> Singles:
    """Distance of two edges along the mean of their normals."""
    normal = edge[:, 2:4] - other[:, 2:4]
    normal = normal / np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    along: Singles = ((other[:, :2] - edge[:, :2]) * normal).sum(axis=1)
    return along


def trace(
    stroke: Singles,
    state: Bytes,
    u: float,
    v: float,
    du: float,
    dv: float,
    step: float,
    radius: float,
    gap: float,
    least: int,
    aligned: float,
    out: Singles,
) -> tuple[int, int, int, bool]:
    """Follow stroke centres from (u, v) in direction (du, dv), one `step` at a time.

    Each new point is the mean of the strokes in a window round the predicted one (`step` to either side along,
    `radius` across, tangents within acos(`aligned`)); their mean tangent is the next direction. Where fewer than
    `least` strokes are in the window, windows up to `gap` ahead are tried, each a little wider.

    Parameters
    ----------
    state : (N,) uint8 array
        0 strokes to ignore, 1 free ones, 2 ones that an earlier line claimed: the trace stops where it meets those.
    out : (M, 2) array to fill with points; the trace ends when it is full.

    Returns
    -------
    How many points, how many windows held strokes, how many were passed, and whether the trace came back to its start.
    """
    found = filled = travelled = 0
    at, direction = np.array([u, v], np.float32), np.array([du, dv], np.float32)
    start, start_direction = at, direction
    free = state > 0
    while found < len(out) - 1:
        for jump in range(1, int(gap / step) + 2):
            middle = at + direction * np.float32(step * jump)
            wide = radius * (1.0 + 0.25 * (jump - 1))
            along, across, turn = _relative(stroke, middle, direction)
            inside = free & (np.abs(along) <= step) & (np.abs(across) <= wide) & (np.abs(turn) >= aligned)
            count = int(inside.sum())
            if count == 0:
                continue
            claimed = float((state[inside] == 2).mean())
            mean_along, mean_across = along[inside].mean(), across[inside].mean()
            if count >= least and mean_along > -0.75 * step and not (jump > 1 and claimed > 0.5):
                break
        else:
            break
        if claimed > 0.6:
            break
        tangent = (stroke[inside, 2:4] * np.where(turn[inside] > 0, _ONE, -_ONE)[:, None]).mean(axis=0)
        at = middle + mean_along * direction + mean_across * np.array([-direction[1], direction[0]])
        direction = tangent / np.sqrt((tangent * tangent).sum())
        out[found] = at
        found, filled, travelled = found + 1, filled + 1, travelled + jump
        home = ((at - start) ** 2).sum() < step * step and direction @ start_direction > aligned
        if travelled > 6 and home:
            return found, filled, travelled, True
    along, across, turn = _relative(stroke, at, direction)
    ahead = (state == 1) & (along > 0) & (along <= 1.5 * step) & (np.abs(across) <= radius) & (np.abs(turn) >= aligned)
    if ahead.any():
        out[found] = at + along[ahead].max() * direction
        found += 1
    return found, filled, travelled, False


def _relative(stroke: Singles, at: Singles, direction: Singles) -> tuple[Singles, Singles, Singles]:
    """Each stroke's place along and across a direction, and the cosine of its tangent to it."""
    ru, rv = stroke[:, 0] - at[0], stroke[:, 1] - at[1]
    along = ru * direction[0] + rv * direction[1]
    across = rv * direction[0] - ru * direction[1]
    return along, across, stroke[:, 2] * direction[0] + stroke[:, 3] * direction[1]


def claim(stroke: Singles, state: Bytes, points: Singles, radius: float, aligned: float) -> int:
    """Mark the free strokes within `radius` of a polyline and along it as claimed; returns how many."""
    count = 0
    for first, second in pairwise(points):
        length = float(np.sqrt(((second - first) ** 2).sum()))
        if length <= 0.0:
            continue
        along, across, turn = _relative(stroke, first, (second - first) / np.float32(length))
        near = (along >= -radius) & (along <= length + radius) & (np.abs(across) <= radius) & (np.abs(turn) >= aligned)
        near &= state == 1
        state[near] = 2
        count += int(near.sum())
    return count
