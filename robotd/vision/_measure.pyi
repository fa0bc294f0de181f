import numpy as np
from numpy.typing import NDArray

def judge(
    image: NDArray[np.uint8],
    valid: NDArray[np.uint8],
    points: NDArray[np.float32],
    pieces: NDArray[np.float32],
    count: int,
    sign: float,
    strokes: int,
    scratch: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None: ...
def refine(
    image: NDArray[np.uint8],
    valid: NDArray[np.uint8],
    path: NDArray[np.float32],
    width: float,
    slope: float,
    closed: bool,
    grain: float,
    sign: float,
    scratch: NDArray[np.float32],
    out: NDArray[np.float64],
) -> tuple[int, float, float]: ...
def shape(
    points: NDArray[np.float64],
    reach: float,
    closed: bool,
    normals: NDArray[np.float64],
    heading: NDArray[np.float64],
    curvature: NDArray[np.float64],
) -> None: ...
