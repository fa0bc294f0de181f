import numpy as np
from numpy.typing import NDArray

def extend(
    image: NDArray[np.uint8],
    valid: NDArray[np.uint8],
    sign: float,
    points: NDArray[np.float32],
    pieces: NDArray[np.float32],
    count: int,
    way: NDArray[np.float32],
    out_points: NDArray[np.float32],
    out_pieces: NDArray[np.float32],
) -> int: ...
def join(
    image: NDArray[np.uint8],
    valid: NDArray[np.uint8],
    sign: float,
    points: NDArray[np.float32],
    pieces: NDArray[np.float32],
    count: int,
    out_points: NDArray[np.float32],
    out_pieces: NDArray[np.float32],
) -> int: ...
