import numpy as np
from numpy.typing import NDArray

def edges(
    gx: NDArray[np.int16],
    gy: NDArray[np.int16],
    valid: NDArray[np.uint8],
    factor: float,
    low: float,
    high: float,
    level: NDArray[np.float32],
    index: NDArray[np.int32],
    sector: NDArray[np.uint8],
    out: NDArray[np.float32],
) -> tuple[int, float]: ...
def strokes(
    edge: NDArray[np.float32],
    count: int,
    index: NDArray[np.int32],
    sector: NDArray[np.uint8],
    low: float,
    high: float,
    sign: float,
    parallel: float,
    mutual: float,
    partner: NDArray[np.int32],
    out: NDArray[np.float32],
) -> int: ...
