"""The kernels of `_stroke` in numpy: their oracle in tests, and what runs when the extension was not built.

Edges are rows (u, v, nu, nv, magnitude): a sub-pixel point, the unit gradient there (towards brighter) and its length.
Strokes are rows (u, v, tu, tv, width, strength): the midpoint between two opposite edges, the unit tangent of the line
(its sign means nothing), the distance of the edges and the weaker of their gradients.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]
Integers = NDArray[np.int32]
Bytes = NDArray[np.uint8]

BLOCK = 32  # px, side of the squares that have each a threshold of their own


def edges(
    gx: NDArray[np.int16],
    gy: NDArray[np.int16],
    valid: Bytes,
    factor: float,
    low: float,
    high: float,
    level: Singles,
    index: Integers,
    sector: Bytes,
    out: Singles,
) -> tuple[int, float]:
    """Thin edges: pixels whose gradient is a local maximum along the axis that it is nearest to.

    A parabola through the three magnitudes gives the sub-pixel position on that axis. Each square of 32 x 32 pixels
    has its own threshold, because a shadow weakens edges and a pattern makes many: `factor` times the mean magnitude of
    the valid pixels in it and the squares round it, but not more than of the whole image, clipped to [low, high].

    Parameters
    ----------
    gx, gy : (H, W) int16 arrays
        Sobel derivatives.
    valid : (H, W) uint8 array
        1 where the derivatives may be used, 0 elsewhere; no rows if all may be.
    sector : (H, W) uint8 array to fill
        0 where there is no thin edge, else 1 + which sixteenth of the circle its gradient is in, from +u towards +v.
    level : (max(H // 32, 1), 3 * max(W // 32, 1)) array to fill
        The thresholds, in the first third of the columns; the rest is scratch. What is left over on the right and
        below belongs to the last squares.
    index : (H, W) array to fill
        For each thin edge pixel its row of `out`; undefined elsewhere.
    out : (N, 5) array to fill with edges, row by row of the image; further ones are dropped.

    Returns
    -------
    How many edges were found, and the mean of the thresholds.
    """
    wide_x, wide_y = gx.astype(np.int32), gy.astype(np.int32)
    usable = np.ones(gx.shape, bool) if len(valid) == 0 else valid > 0
    strength = ((np.abs(wide_x) + np.abs(wide_y)) * usable)[::4]  # because every fourth row says enough
    rows, columns = level.shape[0], level.shape[1] // 3
    down, right = np.arange(rows) * (BLOCK // 4), np.arange(columns) * BLOCK
    sums, pixels = (
        np.add.reduceat(np.add.reduceat(part, right, axis=1), down, axis=0).astype(np.float32)
        for part in (strength, usable[::4].astype(np.int32))
    )
    # the mean over all directions of |cos| + |sin| is 4 / pi
    share = np.float32(factor) * np.float32(0.7853982)
    whole = share * (sums.sum(dtype=np.float32) / max(pixels.sum(dtype=np.float32), np.float32(1.0)))
    sums, pixels = _around(sums), _around(pixels)
    means = np.minimum(share * (sums / np.maximum(pixels, np.float32(1.0))), whole)
    level[:, :columns] = np.clip(means, np.float32(low), np.float32(high))
    of_row = np.minimum(np.arange(gx.shape[0]) // BLOCK, rows - 1)
    of_column = np.minimum(np.arange(gx.shape[1]) // BLOCK, columns - 1)
    least = (level[:, :columns] * level[:, :columns]).astype(np.int32)[of_row[:, None], of_column]
    square = wide_x * wide_x + wide_y * wide_y
    across = (wide_x * wide_x >= wide_y * wide_y)[1:-1, 1:-1]
    here = square[1:-1, 1:-1]
    before = np.where(across, square[1:-1, :-2], square[:-2, 1:-1])
    after = np.where(across, square[1:-1, 2:], square[2:, 1:-1])
    peak = (here > least[1:-1, 1:-1]) & (here >= before) & (here > after) & usable[1:-1, 1:-1]
    peak &= np.where(across, usable[1:-1, :-2] & usable[1:-1, 2:], usable[:-2, 1:-1] & usable[2:, 1:-1])
    rows, cols = np.nonzero(peak)
    rows, cols = rows[: len(out)], cols[: len(out)]
    a, b, c = (np.sqrt(part[rows, cols].astype(np.float32)) for part in (before, here, after))
    shift = np.float32(0.5) * (a - c) / (a - np.float32(2.0) * b + c)
    across = across[rows, cols]
    rows, cols, found = rows + 1, cols + 1, len(rows)
    out[:found, 0] = cols + np.where(across, shift, np.float32(0.0))
    out[:found, 1] = rows + np.where(across, np.float32(0.0), shift)
    out[:found, 2] = gx[rows, cols] / b
    out[:found, 3] = gy[rows, cols] / b
    out[:found, 4] = b
    index[rows, cols] = np.arange(found, dtype=np.int32)
    sector[:] = 0
    sector[rows, cols] = 1 + _sector(gx[rows, cols].astype(np.float32), gy[rows, cols].astype(np.float32))
    return found, float(level[:, :columns].mean())


def _around(blocks: Singles) -> Singles:
    """Sums over each block and those that touch it."""
    padded = np.pad(blocks, 1)
    rows, columns = blocks.shape
    total = np.zeros_like(blocks)
    for i in range(3):
        for j in range(3):
            total += padded[i : i + rows, j : j + columns]
    return total


def _sector(x: Singles, y: Singles) -> NDArray[np.int64]:
    """Which of 16 equal sectors directions lie in, counted from the one after +u towards +v."""
    wide, high, tangent = np.abs(x), np.abs(y), np.float32(0.41421356)
    flat = np.where(high < tangent * wide, 0, 1)
    part = np.where(high <= wide, flat, np.where(wide > tangent * high, 2, 3))
    below = y >= 0.0
    return np.where(x >= 0.0, np.where(below, part, 15 - part), np.where(below, 7 - part, 8 + part))


def strokes(
    edge: Singles,
    count: int,
    index: Integers,
    sector: Bytes,
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
    -`parallel`, at most 45 degrees) at a distance, along the mean normal, from `low` to `high`.

    Parameters
    ----------
    sign : -1 walks against the gradient (dark lines), +1 along it (bright lines).
    mutual : a pair counts if the partner's own walk ends within this share of the width (or 2 px) of the start.
    partner : (N,) array to fill with each edge's partner or -1.
    out : (M, 6) array to fill with strokes, in the order of the edges; further ones are dropped.

    Returns
    -------
    How many strokes were found; two edges that are each other's partners make one. Thesis section 5.2.3 without its
    split into start and end pixels (errata B10).
    """
    height, width = index.shape
    edge = edge[:count]
    partner[:count] = -1
    if count == 0:
        return 0
    direction = np.float32(sign) * edge[:, 2:4]
    horizontal = np.abs(direction[:, 0]) >= np.abs(direction[:, 1])
    major = np.where(horizontal, np.abs(direction[:, 0]), np.abs(direction[:, 1]))
    pace = (direction / major[:, None] * np.float32(65536.0)).astype(np.int64)  # 16 bits of fraction
    start = ((edge[:, :2] + np.float32(0.5)) * np.float32(65536.0)).astype(np.int64)
    first = np.maximum((np.float32(low) * major).astype(int) - 1, 1)
    last = (np.float32(high) * major).astype(int) + 2
    walking = np.ones(count, dtype=bool)
    for step in range(int(first.min()), int(last.max())):
        at = (start + pace * step) >> 16
        started = step >= first
        inside = (at >= 1).all(axis=1) & (at[:, 0] < width - 1) & (at[:, 1] < height - 1)
        walking &= (step < last) & (inside | ~started)
        for side in (0, 1, -1):
            active = np.flatnonzero(walking & started & (partner[:count] < 0))
            col = at[active, 0] + np.where(horizontal[active], 0, side)
            row = at[active, 1] + np.where(horizontal[active], side, 0)
            marked = sector[row, col] > 0
            active, other = active[marked], index[row[marked], col[marked]]
            opposite = (edge[active, 2:4] * edge[other, 2:4]).sum(axis=1) <= -np.float32(parallel)
            active, other = active[opposite], other[opposite]
            across = np.float32(sign) * _across(edge[active], edge[other])
            fits = (across >= np.float32(low)) & (across <= np.float32(high))
            partner[active[fits]] = other[fits]
    begin = np.flatnonzero(partner[:count] >= 0)
    begin = begin[partner[partner[begin]] >= 0]
    begin = begin[(partner[partner[begin]] != begin) | (partner[begin] >= begin)]
    end = partner[begin]
    back = partner[end]
    across = np.float32(sign) * _across(edge[begin], edge[end])
    gap = ((edge[back, :2] - edge[begin, :2]) ** 2).sum(axis=1)
    kept = (gap <= 4.0) | (gap <= (np.float32(mutual) * across) ** 2)
    begin, end, across = begin[kept][: len(out)], end[kept][: len(out)], across[kept][: len(out)]
    normal = edge[begin, 2:4] - edge[end, 2:4]
    normal /= np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    found = len(begin)
    out[:found, :2] = np.float32(0.5) * (edge[begin, :2] + edge[end, :2])
    out[:found, 2] = -normal[:, 1]
    out[:found, 3] = normal[:, 0]
    out[:found, 4] = across
    out[:found, 5] = np.minimum(edge[begin, 4], edge[end, 4])
    return found


def _across(edge: Singles, other: Singles) -> Singles:
    """Distance of two edges along the mean of their normals."""
    normal = edge[:, 2:4] - other[:, 2:4]
    normal = normal / np.sqrt((normal * normal).sum(axis=1, keepdims=True))
    along: Singles = ((other[:, :2] - edge[:, :2]) * normal).sum(axis=1)
    return along
