import numpy as np
from numpy.typing import NDArray

def trace(
    stroke: NDArray[np.float32],
    counts: NDArray[np.int32],
    first: NDArray[np.int32],
    axis: NDArray[np.int32],
    aligned: float,
    least_length: float,
    most_spread: float,
    state: NDArray[np.uint8],
    place: NDArray[np.float32],
    forward: NDArray[np.float32],
    backward: NDArray[np.float32],
    points: NDArray[np.float32],
    pieces: NDArray[np.float32],
) -> int: ...
