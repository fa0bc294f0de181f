import numpy as np
from numpy.typing import NDArray

def log_likelihoods(
    intervals: NDArray[np.float64],
    odds: NDArray[np.float64],
    lights: NDArray[np.int64],
    answers: NDArray[np.int64],
    slot: NDArray[np.int64],
    portion: NDArray[np.int64],
    turn: NDArray[np.int64],
    start: NDArray[np.float32],
    right: NDArray[np.float32],
    instead: NDArray[np.float32],
    portions: NDArray[np.int64],
    gates: NDArray[np.float64],
    heads: NDArray[np.int64],
    table: NDArray[np.float32],
    first: float,
    step: float,
    waits: NDArray[np.float64],
    scores: NDArray[np.float64],
) -> None: ...
