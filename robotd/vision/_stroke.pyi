import numpy as np
from numpy.typing import NDArray

def edges(
    gx: NDArray[np.int16],
    gy: NDArray[np.int16],
    valid: NDArray[np.uint8],
    factor: float,
    low: float,
    high: float,
    magnitude: NDArray[np.float32],
    index: NDArray[np.int32],
    out: NDArray[np.float32],
) -> tuple[int, float]: ...
def strokes(
    edge: NDArray[np.float32],
    count: int,
    index: NDArray[np.int32],
    low: float,
    high: float,
    sign: float,
    parallel: float,
    mutual: float,
    partner: NDArray[np.int32],
    out: NDArray[np.float32],
) -> int: ...
def trace(
    stroke: NDArray[np.float32],
    state: NDArray[np.uint8],
    u: float,
    v: float,
    du: float,
    dv: float,
    step: float,
    radius: float,
    gap: float,
    least: int,
    aligned: float,
    out: NDArray[np.float32],
) -> tuple[int, int, int, bool]: ...
def claim(
    stroke: NDArray[np.float32],
    state: NDArray[np.uint8],
    points: NDArray[np.float32],
    radius: float,
    aligned: float,
) -> int: ...
