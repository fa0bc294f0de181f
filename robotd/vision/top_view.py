"""The floor seen straight from above: a metric picture in robot axes from a tilted camera. Thesis section 5.2.2.

Instead of a homography after undistortion, every pixel of the top view is a point of the floor that is projected
through the whole camera model once; `cv2.remap` then does the rest per frame.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..records import CameraModel, Floats

Bytes = NDArray[np.uint8]


class TopView:
    """Tables that turn a floor camera's images into top views.

    Up in the top view is forward (x), left is left (y). Pixel (0, 0) is the farthest point on the left.

    Parameters
    ----------
    camera : CameraModel
        Calibrated, with its pose on the robot.
    metres_per_pixel : float
    x, y : (least, greatest) in metres, robot axes
        The rectangle of floor to show; it is shrunk to what the camera sees of it.

    Attributes
    ----------
    valid : (H, W) bool array, read-only
        Where the top view shows floor that the camera sees.
    metres_per_pixel : float

    Raises
    ------
    ValueError
        If the camera sees nothing of the rectangle.
    """

    def __init__(
        self,
        camera: CameraModel,
        metres_per_pixel: float = 0.0035,
        x: tuple[float, float] = (0.25, 1.05),
        y: tuple[float, float] = (-0.45, 0.45),
    ) -> None:
        self.metres_per_pixel = metres_per_pixel
        self._size = camera.size
        self._x_max, self._y_max = x[1], y[1]
        rows = max(round((x[1] - x[0]) / metres_per_pixel), 1)
        columns = max(round((y[1] - y[0]) / metres_per_pixel), 1)
        v, u = np.mgrid[0:rows, 0:columns]
        floor = self.to_robot(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
        lens = Camera(camera)
        R, origin = lens.T_robot_camera[:3, :3], lens.T_robot_camera[:3, 3]
        pixels, seen = lens.project((np.column_stack([floor, np.zeros(len(floor))]) - origin) @ R)
        seen &= lens.in_image(np.where(seen[:, None], pixels, -10.0), margin=1.0)
        if not seen.any():
            raise ValueError(
                f"camera {camera.name}: sees no floor at x {x[0]:g} to {x[1]:g} m, y {y[0]:g} to {y[1]:g} m;"
                " check its pose T_robot_camera"
            )
        shown = seen.reshape(rows, columns)
        top, bottom = np.flatnonzero(shown.any(axis=1))[[0, -1]]
        left, right = np.flatnonzero(shown.any(axis=0))[[0, -1]]
        part = (slice(top, bottom + 1), slice(left, right + 1))
        self._x_max -= float(top) * metres_per_pixel
        self._y_max -= float(left) * metres_per_pixel
        self.valid: NDArray[np.bool_] = np.ascontiguousarray(shown[part])
        self.valid.flags.writeable = False
        pixels[~seen] = -10.0
        tables = pixels.reshape(rows, columns, 2)[part].astype(np.float32)
        # float tables: measured faster than OpenCV's fixed-point ones, and exact
        self._u, self._v = np.ascontiguousarray(tables[..., 0]), np.ascontiguousarray(tables[..., 1])
        self._image: Bytes = np.empty(self.valid.shape, np.uint8)
        self.eye = (float(origin[0]), float(origin[1]), float(origin[2]))

    def apply(self, image: Bytes) -> Bytes:
        """The top view (H, W) of a grey image; the array is reused by the next call.

        Raises
        ------
        ValueError
            If the image has not the size of the calibrated camera.
        """
        if image.shape != self._size[::-1] or image.dtype != np.uint8:
            raise ValueError(
                f"need a grey image of {self._size[0]}x{self._size[1]} uint8, got {image.shape[::-1]} {image.dtype}"
            )
        cv2.remap(image, self._u, self._v, cv2.INTER_LINEAR, dst=self._image, borderMode=cv2.BORDER_REPLICATE)
        return self._image

    def to_robot(self, points: Floats) -> Floats:
        """Robot x, y in metres (N, 2) of points u, v in pixels of the top view."""
        return np.column_stack(
            [
                self._x_max - (points[:, 1] + 0.5) * self.metres_per_pixel,
                self._y_max - (points[:, 0] + 0.5) * self.metres_per_pixel,
            ]
        )

    def to_pixels(self, points: Floats) -> Floats:
        """Top-view u, v in pixels (N, 2) of points x, y in robot axes."""
        return np.column_stack(
            [
                (self._y_max - points[:, 1]) / self.metres_per_pixel - 0.5,
                (self._x_max - points[:, 0]) / self.metres_per_pixel - 0.5,
            ]
        )

    def shows(self, points: Floats) -> NDArray[np.bool_]:
        """Whether each point x, y in robot axes (N, 2) is in view; shape (N,)."""
        u, v = np.floor(self.to_pixels(points) + 0.5).astype(np.int64).T
        inside = (u >= 0) & (v >= 0) & (u < self.valid.shape[1]) & (v < self.valid.shape[0])
        result: NDArray[np.bool_] = np.zeros(len(points), dtype=bool)
        result[inside] = self.valid[v[inside], u[inside]]
        return result

    def image_rows(self, points: Floats) -> Floats:
        """Row of the camera image that shows each point x, y in robot axes (N, 2), for rolling shutters; shape (N,)."""
        u, v = np.floor(self.to_pixels(points) + 0.5).astype(np.int64).T
        u, v = np.clip(u, 0, self.valid.shape[1] - 1), np.clip(v, 0, self.valid.shape[0] - 1)
        rows: Floats = np.clip(self._v[v, u], 0, self._size[1] - 1).astype(np.float64)
        return rows

    def range_sigma(self, points: Floats, tilt: float) -> Floats:
        """Error in metres of each point's distance from the camera if that is tilted by `tilt` radians; shape (N,)."""
        square = (points[:, 0] - self.eye[0]) ** 2 + (points[:, 1] - self.eye[1]) ** 2
        height = max(self.eye[2], 0.01)
        sigma: Floats = math.fabs(tilt) * (square + height**2) / height
        return sigma
