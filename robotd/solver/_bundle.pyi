import numpy as np
from numpy.typing import NDArray

class Bundle:
    def __init__(
        self,
        stops: int,
        labels: int,
        columns: NDArray[np.int64],
        prior: NDArray[np.float64],
        lens: NDArray[np.float64],
        R_robot_camera: NDArray[np.float64],
        t_robot_camera: NDArray[np.float64],
        stop: NDArray[np.int64],
        camera: NDArray[np.int64],
        point: NDArray[np.int64],
        uv: NDArray[np.float64],
        sigma: NDArray[np.float64],
        probability: NDArray[np.float64],
        before: NDArray[np.int64],
        after: NDArray[np.int64],
        measured: NDArray[np.float64],
        roots: NDArray[np.float64],
        by_errors: NDArray[np.float64],
        roof_stop: NDArray[np.int64],
        roof_camera: NDArray[np.int64],
        roof_beacon: NDArray[np.int64],
        roof_axes: NDArray[np.float64],
        beacons: int,
        beacon: NDArray[np.float64],
        roof_uv: NDArray[np.float64],
        roof_sigma: NDArray[np.float64],
        H_image_world: NDArray[np.float64],
        known_point: NDArray[np.int64],
        known_position: NDArray[np.float64],
        known_sigma: NDArray[np.float64],
    ) -> None: ...
    def residuals(
        self, frame: NDArray[np.float64], points: NDArray[np.float64], sigma: float
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]: ...
    def solve(
        self,
        frame: NDArray[np.float64],
        points: NDArray[np.float64],
        shape: int,
        sigma: float,
        width: float,
        move_width: float,
        iterations: int,
        tolerance: float,
        damping: float = 1e-4,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float, int, bool]: ...
    def covariance(
        self, frame: NDArray[np.float64], points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None: ...
