"""The kernels of `cython/blink.pyx` in numpy: their oracle in tests, and what runs when they were not built."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LIMIT = 16  # of a change: 4 grey levels over an aperture; a label as weak as that still counts in full

SHIFT_ROUNDS = 5
AGREE_PX = 0.1  # a tile that is further off has somebody in it
BETTER = 0.9  # a shift must explain the tiles so much better than none
QUIET_PX = 0.03  # what noise and passers-by make of a camera that stands still


def sum_cells(image: NDArray[np.uint8], cells: NDArray[np.uint8], before: int, after: int) -> None:
    """Rounded means of 2x2 pixels of `image` (H, W), with `before` and `after` copies of the outermost cells around.

    `cells` is (H // 2 + before + after, W // 2 + before + after).
    """
    rows, columns = cells.shape[0] - before - after, cells.shape[1] - before - after
    pixels = image[: 2 * rows, : 2 * columns].astype(np.uint16).reshape(rows, 2, columns, 2)
    cells[:] = np.pad((pixels.sum(axis=(1, 3)) + 2) >> 2, (before, after), "edge")


def accumulate(
    cells: NDArray[np.uint8],
    lagged: NDArray[np.uint8],
    down: NDArray[np.int16],
    right: NDArray[np.int16],
    move_down: int,
    move_right: int,
    difference: NDArray[np.int8],
    lagged_difference: NDArray[np.int8],
    total: NDArray[np.int16],
    before: int,
) -> None:
    """Add a frame to the alternation of every aperture.

    Parameters
    ----------
    cells, lagged : uint8
        As of `sum_cells`: of the frame, and of the one a lag ago.
    down, right : (h, w) int16
        Change of each aperture's sixteen pixels per pixel that the camera's picture moves up or left.
    move_down, move_right : int
        By how much the picture moved over the lag, in 1/16384 px, less than 2 px.
    difference : (h, w) int8, out
        Change of each 2x2-cell aperture over the lag, less what the move explains, clipped to +-LIMIT; entry [i, j] is
        the aperture whose first cell is (i, j). The last row and column are left alone.
    lagged_difference : (h, w) int8
        The same, one lag ago.
    total : (h, w) int16, updated
        Loses difference * lagged_difference.
    before : int
        As of `sum_cells`.
    """
    rows, columns = total.shape
    inside = np.s_[before : before + rows, before : before + columns]
    change = cells[inside].astype(np.int32) - lagged[inside]
    change = change[:-1, :-1] + change[:-1, 1:] + change[1:, :-1] + change[1:, 1:]
    if move_down or move_right:
        for gradient, move in ((down, move_down), (right, move_right)):
            change += (gradient[:-1, :-1].astype(np.int32) * move) >> 16
        change += 1  # because both were rounded down
    difference[:-1, :-1] = np.clip(change, -LIMIT, LIMIT)
    total[:-1, :-1] -= difference[:-1, :-1].astype(np.int16) * lagged_difference[:-1, :-1]


def rate_block(
    sums: NDArray[np.int16],
    middle: NDArray[np.float32],
    rate: NDArray[np.float32],
    low: int,
    high: int,
    out: NDArray[np.int8],
) -> None:
    """Write (sums - middle) * rate, limited to [low, high] and cut to whole numbers, to `out` (h, w).

    `middle` and `rate` (tiles, w) hold for bands of rows; the last band takes the rows that remain.
    """
    band = _bands(len(sums), len(middle))
    out[:] = np.clip((sums - middle[band]) * rate[band], low, high)


def add_block(rated: NDArray[np.int8], weight: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Add `rated` (h, w), times the `weight` (tiles, w) of each band of rows, to `total`."""
    total += weight[_bands(len(rated), len(weight))] * rated


def _bands(rows: int, tiles: int) -> NDArray[np.intp]:
    return np.minimum(np.arange(rows) // (rows // tiles), tiles - 1)


def shift_moments(
    cells: NDArray[np.uint8],
    reference: NDArray[np.int16],
    down: NDArray[np.int16],
    right: NDArray[np.int16],
    before: int,
    step: int,
    moments: NDArray[np.float32],
) -> None:
    """Sums over tiles from which the shift of a picture against a reference follows.

    Parameters
    ----------
    cells : uint8
        As of `sum_cells`.
    reference, down, right : (h, w) int16
        The reference's apertures (sums of their sixteen pixels), and their gradients per pixel.
    before : int
        As of `sum_cells`.
    step : int
        Only every so many rows of a tile count.
    moments : (R, C, 3) float32, out
        Per tile the sums of right * d, down * d and d, with the change d of the apertures.
    """
    height, width = reference.shape
    rows, columns = moments.shape[:2]
    high, wide = height // rows, width // columns
    part = cells[before : before + height + 1, before : before + width + 1].astype(np.int64)
    # less 2, because the means of pixels are rounded up by an eighth of a grey level on average
    change = 4 * (part[:-1, :-1] + part[1:, :-1] + part[:-1, 1:] + part[1:, 1:]) - 2 - reference
    for a in range(rows):
        for b in range(columns):
            tile = np.s_[a * high : (a + 1) * high : step, b * wide : (b + 1) * wide]
            moments[a, b] = [(right[tile] * change[tile]).sum(), (down[tile] * change[tile]).sum(), change[tile].sum()]


def agreed_shift(moments: NDArray[np.float32], tiles: NDArray[np.float64]) -> tuple[float, float]:
    """By how much the reference has moved from a picture; zero while noise could be the cause.

    Parameters
    ----------
    moments : (T, 3) float32
        As of `shift_moments`.
    tiles : (T, 5)
        Of every tile of the reference: sums of right^2, right * down and down^2, both less their means; the means.

    Returns
    -------
    (float, float)
        u, v in px: iteratively reweighted least squares, in which a tile weighs the less, the less it agrees.
    """
    xx, xy, yy, mean_x, mean_y = tiles.T
    x, y, d = moments.T.astype(float)
    x, y = x - mean_x * d, y - mean_y * d
    scale = AGREE_PX * (xx + yy) + 1.0
    weights = np.ones(len(x))
    shift = np.zeros(2)
    miss = np.zeros(len(x))
    for _ in range(SHIFT_ROUNDS):
        a, b, c = float(weights @ xx), float(weights @ xy), float(weights @ yy)
        p, q = float(weights @ x), float(weights @ y)
        determinant = a * c - b * b
        if determinant <= 1e-3 * a * c or a * c <= 0.0:
            return 0.0, 0.0
        shift = np.array([(c * p - b * q) / determinant, (a * q - b * p) / determinant])
        if np.abs(shift).max() < QUIET_PX:
            return 0.0, 0.0
        miss = np.hypot(x - xx * shift[0] - xy * shift[1], y - xy * shift[0] - yy * shift[1]) / scale
        weights = 1.0 / (1.0 + miss**2)
    still = np.hypot(x, y) / scale
    if np.minimum(miss, 1.0).sum() > BETTER * np.minimum(still, 1.0).sum():
        return 0.0, 0.0
    return float(shift[0]), float(shift[1])


def aperture_series(
    ring: NDArray[np.uint8],
    order: NDArray[np.intp],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    light: NDArray[np.float32],
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
) -> None:
    """Light curves of N apertures over F frames.

    Parameters
    ----------
    ring : (R, h, w) uint8
        Cells of the frames.
    order : (F,) intp
        Which of them, in order of time.
    rows, columns : (N,) intp
        First cell of each aperture; at least 3 cells from the first and 5 from the last row and column.
    light : (256,) float32
        Linear light of every grey level.
    values : (N, F) float32, out
        Light of the four cells minus four times the level.
    levels : (N, F) float32, out
        Light per cell around the aperture: of the 28 border cells of its 8x8 neighbourhood, in eight groups, the mean
        of the middle four groups, because a bright neighbour touches three at most.
    """
    near, far = np.arange(-3, 1), np.arange(1, 4)
    for n, (i, j) in enumerate(zip(rows, columns, strict=True)):
        cells = light[ring[order]][:, i - 3 : i + 5, j - 3 : j + 5]
        groups = []
        for part in (near, far):
            groups += [cells[:, 0, 3 + part], cells[:, 3 + part, 7], cells[:, 7, 4 - part], cells[:, 4 - part, 0]]
        means = np.sort(np.stack([group.mean(axis=1) for group in groups]), axis=0)
        levels[n] = means[2:6].mean(axis=0)
        values[n] = cells[:, 3:5, 3:5].sum(axis=(1, 2)) - 4 * levels[n]


def cut_patches(
    image: NDArray[np.uint8], rows: NDArray[np.intp], columns: NDArray[np.intp], patches: NDArray[np.uint8]
) -> None:
    """Copy N windows of `image`, whose first pixels are (rows, columns), into `patches` (N, K, K)."""
    height, width = patches.shape[1:]
    for n, (i, j) in enumerate(zip(rows, columns, strict=True)):
        patches[n] = image[i : i + height, j : j + width]


def project_runs(
    values: NDArray[np.float32],
    weights: NDArray[np.float32],
    nuisance: NDArray[np.float32],
    waves: NDArray[np.float32],
    first: NDArray[np.intp],
    last: NDArray[np.intp],
    projection: NDArray[np.float32],
    sums: NDArray[np.float32],
    squares: NDArray[np.float32],
) -> None:
    """Correlate N light curves with the pattern's single period at S starts.

    Parameters
    ----------
    values, weights : (N, F) float32
        Light curves, zero where their weight is.
    nuisance : (N, B, F) float32
        Orthonormal curves that were taken off each light curve, zero where the weight is; at most 6.
    waves : (F, S) float32
        Share of each exposure in which a pattern that begins at each start is on.
    first, last : (F,) intp
        Starts [first, last) at which that is not zero; they save work.
    projection, sums, squares : (N, S), (N, B, S), (N, S) float32, out
        Sums over the frames of values * waves, nuisance * waves, and weights * waves^2.
    """
    projection[:] = values @ waves
    sums[:] = nuisance @ waves
    squares[:] = weights @ waves**2


def best_runs(
    projection: NDArray[np.float32],
    sums: NDArray[np.float32],
    squares: NDArray[np.float32],
    step: int,
    frames: NDArray[np.float32],
    least: float,
    gain: NDArray[np.float32],
    start: NDArray[np.intp],
    periods: NDArray[np.intp],
    light: NDArray[np.float32],
) -> None:
    """For each of N light curves, the start and number (2 or more) of periods that explain most of its energy.

    Parameters
    ----------
    projection : (N, G) float32
        Scalar product of each light curve, less its nuisance, with one period of the pattern from each start.
    sums, squares : (N, B, G), (N, G) float32
        Scalar products of that period's samples with the nuisance and with themselves, over the frames that count.
    step : int
        Starts from one period to the next.
    frames : (N,) float32
        Frames that count for each light curve.
    least : float
        Least energy per frame, of a pattern less the nuisance, that is divided by, so that patterns which hardly touch
        the window do not win.
    gain, start, periods, light : (N,), out
        Energy explained, index of the start, number of periods, and light of the source.
    """
    gain[:] = 0
    start[:] = 0
    periods[:] = 2
    light[:] = 0
    rest = projection.shape[1]
    product, total, square = projection.copy(), sums.copy(), squares.copy()
    number = 1
    while rest > step:
        rest -= step
        product = product[:, :rest] + projection[:, number * step :]
        total = total[:, :, :rest] + sums[:, :, number * step :]
        square = square[:, :rest] + squares[:, number * step :]
        number += 1
        norm = np.maximum(square - (total * total).sum(axis=1), least * frames[:, None])
        value = np.where(product > 0, product * product / norm, 0)
        top = np.argmax(value, axis=1)
        rows = np.arange(len(top))
        better = value[rows, top] > gain
        gain[better] = value[rows, top][better]
        start[better] = top[better]
        periods[better] = number
        light[better] = (product[rows, top] / norm[rows, top])[better]
