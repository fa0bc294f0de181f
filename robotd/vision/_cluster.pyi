import numpy as np
from numpy.typing import NDArray

def dbscan(
    features: NDArray[np.float64],
    eps: float,
    least: int,
    cell_of: NDArray[np.int32],
    start: NDArray[np.int32],
    order: NDArray[np.int32],
    stack: NDArray[np.int32],
    counts: NDArray[np.int32],
    labels: NDArray[np.int32],
    origin_u: float,
    origin_v: float,
    cell: float,
    columns: int,
    rows: int,
) -> int: ...
