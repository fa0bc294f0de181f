"""The kernels of `_measure` in numpy: their oracle in tests, and what runs when the extension was not built."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .polyline import arc_length

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]

MOST_SLOPE = 0.08  # of the width along the line, that bends and tilted views explain
OUT_OF_VIEW = 1.5  # widths that an end beyond the view counts for


def judge(
    image: Bytes,
    valid: Bytes,
    points: Singles,
    pieces: Singles,
    count: int,
    sign: float,
    strokes: int,
    scratch: Singles,
    out: Singles,
) -> None:
    """What speaks for each piece being a line: see `evidence.WITNESSES` for the columns of `out` from 1 on.

    Every quarter of a width the line is cut across: three pixels in it, and three to each side of it, half a width and
    more from its border; and three more up to one and a quarter widths from it.

    Parameters
    ----------
    image : (H, W) uint8 array
        In working pixels.
    valid : (H, W) uint8 array, or no rows where all is usable.
    points, pieces, count : as `polyline_reference.join` gives them.
    sign : -1 for dark lines, +1 for bright ones.
    strokes : all that were found in the image.
    scratch : (3 M, 2) array; M limits the cuts of one piece.
    out : (P, 17) array to fill. Column 0 is 1, or 0 if the piece is out of view or of the other polarity.
    """
    total = float(pieces[:count, 10].sum())
    for p in range(count):
        start, size, width, slope, spread, _, _, claimed, closed, ragged, length = (float(x) for x in pieces[p])
        path = points[int(start) : int(start + size)].astype(np.float64)
        cut = _resampled(path, max(0.25 * width, 1.0), 5, len(scratch) // 3)
        n = len(cut)
        normal = _normals(cut, 1)
        half = 0.5 * np.maximum(width + slope * length * (np.linspace(0.0, 1.0, n) - 0.5), 0.5 * width)
        inside = np.column_stack([_at(image, valid, cut + (k * half)[:, None] * normal) for k in (-0.45, 0.0, 0.45)])
        beside: list[Floats] = []
        far_off: list[Floats] = []
        for side in (-1.0, 1.0):
            for greys_of, halves in ((beside, (0.5, 0.75, 1.0)), (far_off, (1.5, 2.0, 2.5))):
                reach = half[:, None] + np.array(halves) * np.maximum(half, 4.0)[:, None]
                greys = np.column_stack([_at(image, valid, cut + (side * r)[:, None] * normal) for r in reach.T])
                seen = (greys >= 0.0).sum(axis=1)
                total_of = np.where(greys >= 0.0, greys, 0.0).sum(axis=1)
                greys_of.append(np.where(seen > 0, total_of / np.maximum(seen, 1), -1.0))
        shown = (inside >= 0.0).all(axis=1) & (beside[0] >= 0.0) & (beside[1] >= 0.0)
        out[p] = 0.0
        if shown.sum() < 3:
            continue
        # how much of the step lies right at the borders
        reach = np.where(half > 5.0, 0.3 * half, 1.5)[shown]
        near = np.array([])
        for side in (-1.0, 1.0):
            at = [cut[shown] + (side * (half[shown] + k * reach))[:, None] * normal[shown] for k in (-1.0, 1.0)]
            within, without = _at(image, valid, at[0]), _at(image, valid, at[1])
            near = np.append(near, sign * (within - without)[(within >= 0.0) & (without >= 0.0)])
        inside = inside[shown]
        tone = inside.mean(axis=1)
        left, right = sign * (tone - beside[0][shown]), sign * (tone - beside[1][shown])
        contrast = 0.5 * float(left.mean() + right.mean())
        beyond_it = [sign * (tone - greys[shown])[greys[shown] >= 0.0] for greys in far_off]
        farther = min([contrast] + [float(of.mean()) for of in beyond_it if len(of)])
        low = float(min(left.mean(), right.mean()))
        if contrast <= 1.0 or low <= 0.0:
            continue
        scatter = 0.5 * float(np.abs(left - left.mean()).mean() + np.abs(right - right.mean()).mean())
        inner = float(np.abs(inside - tone[:, None]).mean())
        along = float(np.abs(np.diff(tone)).mean())
        normal = _normals(cut, 2)[2 : n - 2 : 4]
        turns = np.abs(normal[:-1, 0] * normal[1:, 1] - normal[:-1, 1] * normal[1:, 0])
        beyond = 2 if closed > 0.0 else 0
        if beyond == 0:
            first, last = _normals(cut, 2)[[0, -1]]
            ends = np.array([cut[0] - width * first[[1, 0]] * [1, -1], cut[-1] + width * last[[1, 0]] * [1, -1]])
            beyond = int((_at(image, valid, ends) < 0.0).sum())
        out[p] = (
            1.0,
            _log(length / width + OUT_OF_VIEW * beyond, 0.5, 15.0),
            min(max(10.0 * (abs(slope) - MOST_SLOPE), 0.0), 2.0),
            _log(float(near.mean()) / (0.7 * contrast) if len(near) else 0.0, 0.3, 1.0),
            min(max(10.0 * spread / width, 0.1), 2.0),
            min(max(10.0 * ragged / width, 0.1), 2.0),
            _log(contrast / (scatter + 1.0), 0.2, 12.0),
            _log(contrast, 1.0, 60.0),
            _log(low / (0.65 * contrast), 0.1, 1.0),
            float((np.minimum(left, right) > 0.4 * contrast).mean()),
            _log(contrast / (inner + 1.0), 0.5, 30.0),
            _log(contrast / (along + 1.0), 0.5, 30.0),
            _log(float(turns.mean()) if len(turns) else 0.3, 0.02, 1.0),
            _log(claimed / strokes, 0.01, 1.0),
            _log(length / total, 0.01, 1.0),
            _log(width / 3.0, 1.0, 4.0),
            _log(farther / (0.5 * contrast), 0.1, 1.0),
        )


def _log(value: float, low: float, high: float) -> float:
    return math.log(min(max(value, low), high))


def _resampled(path: Floats, spacing: float, least: int, most: int) -> Floats:
    """Points at equal distances of about `spacing`, at least and at most so many."""
    lengths = arc_length(path)
    count = min(max(int(lengths[-1] / spacing + 0.5) + 1, least), most)
    wanted = np.linspace(0.0, lengths[-1], count)
    return np.column_stack([np.interp(wanted, lengths, path[:, 0]), np.interp(wanted, lengths, path[:, 1])])


def _normals(path: Floats, reach: int) -> Floats:
    """Unit normals from the directions over `reach` points to either side, fewer near the ends."""
    index = np.arange(len(path))
    step = path[np.minimum(index + reach, len(path) - 1)] - path[np.maximum(index - reach, 0)]
    step /= np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)[:, None]
    return np.column_stack([-step[:, 1], step[:, 0]])


def _at(image: Bytes, valid: Bytes, places: Floats) -> Floats:
    """Grey levels of the nearest pixels, -1 outside."""
    cells = np.floor(places + 0.5).astype(int)
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < image.shape[1]) & (cells[:, 1] < image.shape[0])
    cells[~inside] = 0
    if len(valid):
        inside &= valid[cells[:, 1], cells[:, 0]] > 0
    return np.where(inside, image[cells[:, 1], cells[:, 0]].astype(np.float64), -1.0)


def refine(
    image: Bytes,
    valid: Bytes,
    path: Singles,
    width: float,
    slope: float,
    closed: bool,
    grain: float,
    sign: float,
    scratch: Singles,
    out: Floats,
) -> tuple[int, float, float]:
    """Measure a line again at full resolution, border by border.

    The line is prolonged straight to the border of the view if that is nearer than 1.2 widths, and cut across every
    0.15 widths. In each cut both borders are the steepest places (a parabola through the slope and its neighbours) near
    where they are expected; their middle, averaged over a width of line, is the centre. Cuts of less than 0.4 of the
    usual slope, or with another width, do not count.

    Parameters
    ----------
    image : (H, W) uint8 array
        Of full resolution.
    valid : (H, W) uint8 array, or no rows where all is usable.
    path : (N, 2) array of points in working pixels; `width`, `slope` and `closed` as `polyline_reference.trace` says.
    grain : pixels of the image per working pixel.
    sign : -1 for dark lines, +1 for bright ones.
    scratch : (8 M, 2) array; M limits the points.
    out : (M, 2) array to fill with points in pixels of the image.

    Returns
    -------
    How many points, the width in pixels of the image, and the sharpest turn in radians from one arm (0.8 to 2 widths
    away) to the other.
    """
    w = width * grain
    line = (path.astype(np.float64) + 0.5) * grain - 0.5
    if not closed:
        ends = [_prolonged(image.shape, valid, line[::-1], 1.2 * w), _prolonged(image.shape, valid, line, 1.2 * w)]
        line = np.vstack(
            [*([ends[0]] if ends[0] is not None else []), line, *([ends[1]] if ends[1] is not None else [])]
        )
    line = _resampled(line, 0.15 * w if w > 13.3333 else 2.0, 4, len(scratch) // 8)
    n = len(line)
    length = float(arc_length(line)[-1])
    spacing = length / (n - 1)
    window = min(max(int(w / spacing + 0.5), 2), (n - 1) // 2)
    search = min(max(0.12 * w + grain, 2.5), 24.0)
    samples = min(2 * int(search + 1.0) + 7, 63)
    normal = _normals(line, window // 2 if window > 3 else 1)
    expected = np.maximum(width + slope * (np.linspace(0.0, 1.0, n) - 0.5) * length / grain, 0.5 * width) * grain
    sides = [
        _borders(image, valid, line, normal, 0.5 * expected, side, sign, samples, min(0.12 * w, 2.0))
        for side in (-1, 1)
    ]
    shift, measured = 0.5 * (sides[1][:, 0] - sides[0][:, 0]), sides[0][:, 0] + sides[1][:, 0]
    strength = np.minimum(sides[0][:, 1], sides[1][:, 1])
    strength[np.abs(measured - expected) > 0.2 * w + 1.0] = 0.0
    if (strength > 0.0).any():
        strength[strength <= 0.4 * _median(strength[strength > 0.0])] = 0.0
        w = _median(measured[strength > 0.0])
    weights = 1.0 - (np.arange(-window, window + 1) / (window + 1)) ** 2
    index = np.arange(n)[:, None] + np.arange(-window, window + 1)
    if closed:
        index = (index + n - 1) % (n - 1)
    used = (index >= 0) & (index < n)
    index = np.clip(index, 0, n - 1)
    share = weights * (used & (strength[index] > 0.0))
    mean = (share * shift[index]).sum(axis=1) / np.maximum(share.sum(axis=1), 0.5)
    out[:n] = line + mean[:, None] * normal
    return n, w, _sharpest(out[:n], width * grain / spacing)


def _median(values: Floats) -> float:
    """The upper median."""
    return float(np.sort(values)[len(values) // 2])


def _prolonged(size: tuple[int, ...], valid: Bytes, path: Floats, reach: float) -> Floats | None:
    """The point where a line, prolonged straight beyond its last point by at most `reach`, leaves the view."""
    lengths = arc_length(path[::-1])
    back = min(int(np.searchsorted(lengths, reach)), len(path) - 1)
    step = path[-1] - path[len(path) - 1 - back]
    norm = float(np.hypot(*step))
    if norm <= 0.0:
        return None
    for far in range(int(reach) + 1):
        u, v = np.floor(path[-1] + (far + 1.0) * step / norm + 0.5).astype(int)
        inside = 0 <= u < size[1] and 0 <= v < size[0]
        if not inside or (len(valid) and valid[v, u] == 0):
            return np.asarray(path[-1] + far * step / norm) if far > 0 else None
    return None


def _borders(
    image: Bytes,
    valid: Bytes,
    line: Floats,
    normal: Floats,
    half: Floats,
    side: int,
    sign: float,
    samples: int,
    along: float,
) -> Floats:
    """Distance of the border from each point of a line along its normal, and its slope, 0 if there is none; (N, 2)."""
    start = half - 0.5 * (samples - 1)
    reach = side * (start[:, None] + np.arange(samples))
    tangent = np.column_stack([normal[:, 1], -normal[:, 0]])
    places = line[:, None] + reach[..., None] * normal[:, None]
    places = places[:, :, None] + along * np.array([-1.0, 0.0, 1.0])[:, None] * tangent[:, None, None]
    u, v = places[..., 0], places[..., 1]
    height, width = image.shape
    inside = (u >= 0.0) & (u < width - 1) & (v >= 0.0) & (v < height - 1)
    col, row = np.where(inside, u, 0.0).astype(int), np.where(inside, v, 0.0).astype(int)
    if len(valid):
        inside &= valid[row, col] > 0
    a, b = np.where(inside, u, 0.0) - col, np.where(inside, v, 0.0) - row
    near, far = np.minimum(col + 1, width - 1), np.minimum(row + 1, height - 1)
    grey = (1.0 - b) * ((1.0 - a) * image[row, col] + a * image[row, near])
    grey += b * ((1.0 - a) * image[far, col] + a * image[far, near])
    profile = grey.sum(axis=2)
    slope = -sign * (profile[:, 2:] - profile[:, :-2])
    smooth = slope[:, :-2] + 2.0 * slope[:, 1:-1] + slope[:, 2:]  # of samples 2 to samples - 3
    best = smooth.argmax(axis=1)
    rows = np.arange(len(line))
    found = inside.all(axis=(1, 2)) & (best >= 1) & (best <= samples - 6) & (smooth[rows, best] > 0.0)
    best = np.clip(best, 1, samples - 6)
    before, peak, after = smooth[rows, best - 1], smooth[rows, best], smooth[rows, best + 1]
    bend = before - 2.0 * peak + after
    found &= bend < 0.0
    at = start + best + 2 + 0.5 * (before - after) / np.where(bend < 0.0, bend, -1.0)
    return np.where(found[:, None], np.column_stack([at, peak / 24.0]), 0.0)


def _sharpest(points: Floats, width: float) -> float:
    """The sharpest turn from arm to arm of points, `width` points to a line width."""
    near, far, least = int(0.8 * width + 0.5), int(2.0 * width + 0.5), int(0.6 * width + 0.5)
    middle = np.arange(near + least, len(points) - near - least)
    if len(middle) == 0:
        return 0.0
    one = points[middle - near] - points[np.maximum(middle - far, 0)]
    two = points[np.minimum(middle + far, len(points) - 1)] - points[middle + near]
    cross = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    return float(np.arctan2(cross, (one * two).sum(axis=1)).max())


def shape(points: Floats, reach: float, closed: bool, normals: Floats, heading: Floats, curvature: Floats) -> None:
    """Normals and curvature of a polyline with points at about equal distances.

    Fills `normals` (N, 2): the directions, by central differences, turned by +90 degrees from u towards v; `heading`
    (N,): those directions in radians without jumps; and `curvature` (N,): the slope of a straight fit of the heading
    over the arc length, over `reach` pixels, because differences of two normals are noise.
    """
    n = len(points)
    index = np.arange(n)
    before, after = np.maximum(index - 1, 0), np.minimum(index + 1, n - 1)
    if closed:
        before[[0, -1]], after[[0, -1]] = n - 2, 1
    step = points[after] - points[before]
    step /= np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-12)[:, None]
    normals[:] = np.column_stack([-step[:, 1], step[:, 0]])
    heading[:] = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    total = float(arc_length(points)[-1])
    half = max(int(0.5 * reach * (n - 1) / max(total, 1e-12) + 0.5), 1)
    for i in range(n):
        near = np.arange(i - half, i + half + 1)
        if closed:
            turn = np.where(near >= n - 1, 1.0, np.where(near < 0, -1.0, 0.0)) * (heading[-1] - heading[0])
            angle = heading[(near + n - 1) % (n - 1)] + turn
        else:
            near = near[(near >= 0) & (near < n)]
            angle = heading[near]
        away = near - near.mean()
        square = float((away**2).sum())
        curvature[i] = (away @ angle) / square * (n - 1) / total if square > 0.0 and total > 0.0 else 0.0
