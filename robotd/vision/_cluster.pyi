import numpy as np
from numpy.typing import NDArray

def dbscan(
    features: NDArray[np.float64],
    eps: float,
    least: int,
    packed: NDArray[np.float64],
    work: NDArray[np.int32],
    start: NDArray[np.int32],
    counts: NDArray[np.int32],
    labels: NDArray[np.int32],
    origin_u: float,
    origin_v: float,
    cell: float,
    columns: int,
    rows: int,
) -> int: ...
def features(
    stroke: NDArray[np.float32], reach: float, width_weight: float, turn_weight: float, out: NDArray[np.float64]
) -> None: ...
def sort(
    stroke: NDArray[np.float32],
    labels: NDArray[np.int32],
    counts: NDArray[np.int32],
    clusters: int,
    least: int,
    work: NDArray[np.int32],
    out: NDArray[np.float32],
    out_counts: NDArray[np.int32],
    first: NDArray[np.int32],
    axis: NDArray[np.int32],
) -> int: ...
