"""The kernels of `cython/blink.pyx` in numpy: their oracle in tests, and what runs when they were not built."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sum_cells(image: NDArray[np.uint8], cells: NDArray[np.uint16]) -> None:
    """Sum 2x2 pixels of `image` (H, W) into `cells` (H // 2, W // 2)."""
    rows, columns = cells.shape
    pixels = image[: 2 * rows, : 2 * columns].astype(np.uint16)
    cells[:] = pixels.reshape(rows, 2, columns, 2).sum(axis=(1, 3), dtype=np.uint16)


def accumulate(
    image: NDArray[np.uint8],
    cells: NDArray[np.uint16],
    lagged: NDArray[np.uint16],
    difference: NDArray[np.int8],
    lagged_difference: NDArray[np.int8],
    total: NDArray[np.int16],
) -> None:
    """Sum the cells of a frame and add to the alternation of every aperture.

    Parameters
    ----------
    image : (H, W) uint8
    cells : (h, w) uint16, out
        As of `sum_cells`.
    lagged : (h, w) uint16
        Cells of the frame one lag ago.
    difference : (h, w) int8, out
        Change of each 2x2-cell aperture over the lag, clipped to +-63; entry [i, j] is the aperture whose first cell
        is (i, j). The last row and column are left alone.
    lagged_difference : (h, w) int8
        The same, one lag ago.
    total : (h, w) int16, updated
        Loses floor(difference * lagged_difference / 4).
    """
    sum_cells(image, cells)
    change = cells.astype(np.int16) - lagged.astype(np.int16)
    change = change[:-1, :-1] + change[:-1, 1:] + change[1:, :-1] + change[1:, 1:]
    difference[:-1, :-1] = np.clip(change, -63, 63)
    product = difference[:-1, :-1].astype(np.int16) * lagged_difference[:-1, :-1]
    total[:-1, :-1] -= product >> 2


def aperture_series(
    ring: NDArray[np.uint16],
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
    ring : (R, h, w) uint16
        Cells of the frames.
    order : (F,) intp
        Which of them, in order of time.
    rows, columns : (N,) intp
        First cell of each aperture; at least 3 cells from the first and 5 from the last row and column.
    light : (1021,) float32
        Linear light of every cell sum.
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


def best_runs(
    projection: NDArray[np.float32],
    sums: NDArray[np.float32],
    squares: NDArray[np.float32],
    step: int,
    frames: int,
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
        Scalar product of each centred light curve with one period of the pattern from each start.
    sums, squares : (G,) float32
        Sum and sum of squares of that period's samples.
    step : int
        Starts from one period to the next.
    frames : int
        Samples of a light curve.
    least : float
        Least energy of a centred pattern that is divided by, so that patterns which hardly touch the window do not win.
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
        total = total[:rest] + sums[number * step :]
        square = square[:rest] + squares[number * step :]
        number += 1
        norm = np.maximum(square - total * total / frames, least)
        value = np.where(product > 0, product * product / norm, 0)
        top = np.argmax(value, axis=1)
        rows = np.arange(len(top))
        better = value[rows, top] > gain
        gain[better] = value[rows, top][better]
        start[better] = top[better]
        periods[better] = number
        light[better] = (product[rows, top] / norm[top])[better]
