import numpy as np
from numpy.typing import NDArray

def vote(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    weight: NDArray[np.float64],
    stop: NDArray[np.int64],
    order: NDArray[np.int64],
    begins: NDArray[np.int64],
    pair_begins: NDArray[np.int64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    tolerance: float,
    least_sine: float,
    farthest: float,
    floor: float,
    points: NDArray[np.float64],
    found: NDArray[np.uint8],
) -> None: ...
def losses(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    begins: NDArray[np.int64],
    move: NDArray[np.float64],
    sigma: float,
    loss: NDArray[np.float64],
) -> None: ...
def slopes(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    begins: NDArray[np.int64],
    move: NDArray[np.float64],
    sigma: float,
    H: NDArray[np.float64],
    g: NDArray[np.float64],
) -> None: ...
