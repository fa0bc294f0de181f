import numpy as np
from numpy.typing import NDArray

def sum_cells(image: NDArray[np.uint8], cells: NDArray[np.uint8], before: int, after: int) -> None: ...
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
) -> None: ...
def rate_block(
    sums: NDArray[np.int16],
    middle: NDArray[np.float32],
    rate: NDArray[np.float32],
    low: int,
    high: int,
    out: NDArray[np.int8],
) -> None: ...
def add_block(rated: NDArray[np.int8], weight: NDArray[np.float32], total: NDArray[np.float32]) -> None: ...
def shift_moments(
    cells: NDArray[np.uint8],
    reference: NDArray[np.int16],
    down: NDArray[np.int16],
    right: NDArray[np.int16],
    before: int,
    step: int,
    moments: NDArray[np.float32],
) -> None: ...
def agreed_shift(moments: NDArray[np.float32], tiles: NDArray[np.float64]) -> tuple[float, float]: ...
def aperture_series(
    ring: NDArray[np.uint8],
    order: NDArray[np.intp],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    light: NDArray[np.float32],
    values: NDArray[np.float32],
    levels: NDArray[np.float32],
) -> None: ...
def cut_patches(
    image: NDArray[np.uint8], rows: NDArray[np.intp], columns: NDArray[np.intp], patches: NDArray[np.uint8]
) -> None: ...
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
) -> None: ...
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
) -> None: ...
