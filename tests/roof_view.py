"""Roof cameras of known pose, for tests: what they see of points, and their exact calibration."""

import numpy as np

from robotd.geometry.camera import Camera
from robotd.geometry.homography import Homography
from robotd.geometry.transforms import transform_record
from robotd.records import CameraModel
from robotd.roof.setup import RoofCalibration, matrix3

BEACONS = {"front": (0.10, 0.0, 0.65), "rear": (-0.10, 0.0, 0.65)}
HEIGHT = 0.65
BENT = (-0.06, 0.008, 0.0005, -0.0003, 0.0)


class View:
    """A camera at `eye` that looks at `target`, world metres."""

    def __init__(self, name="roof-1", eye=(-2.0, -1.5, 2.8), target=(0.3, 0.2, 0.0), distortion=(0.0,) * 5):
        forward = np.array(target) - eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right = right / np.linalg.norm(right)
        self.pose = np.eye(4)
        self.pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
        self.pose[:3, 3] = eye
        self.model = CameraModel(
            name, (640, 480), (330.0, 330.0, 322.5, 236.5), transform_record(self.pose), distortion=distortion
        )

    def see(self, points):
        """(N, 2) pixels as seen of world points (N, 3)."""
        inside = (np.asarray(points, float) - self.pose[:3, 3]) @ self.pose[:3, :3]
        pixels, valid = Camera(self.model).project(inside)
        assert valid.all()
        return pixels

    def calibration(self, sigma=1e-9):
        """Its exact homography, with `sigma` as the standard deviation of its numbers."""
        fx, fy, cx, cy = self.model.matrix
        R = self.pose[:3, :3].T
        H = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) @ np.column_stack(
            [R[:, 0], R[:, 1], R @ (np.array([0.0, 0.0, HEIGHT]) - self.pose[:3, 3])]
        )
        H /= np.linalg.norm(H)
        covariance = tuple(tuple(row) for row in (sigma**2 * np.eye(9)).tolist())
        return RoofCalibration(
            self.model.name,
            self.model.size,
            self.model.matrix,
            matrix3(np.linalg.inv(H)),
            covariance,
            HEIGHT,
            distortion=self.model.distortion,
        )

    def homography(self):
        return Homography(self.calibration().homography.matrix, np.zeros((9, 9)))


def beacons_at(pose):
    """World (3,) of both beacons of a robot at (x, y, heading)."""
    x, y, heading = pose
    c, s = np.cos(heading), np.sin(heading)
    return {name: np.array([x + c * bx - s * by, y + s * bx + c * by, bz]) for name, (bx, by, bz) in BEACONS.items()}
