"""Where the robot stands, from beacons that roof cameras see. Thesis section 6.3.4, with every residual in pixels.

Minimised is the squared distance between seen and projected beacons in the pictures, over its covariance, so that a
camera far away is trusted less by itself. What the cameras' calibrations leave open is counted: as the part of each
pixel's covariance that the homography's own makes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..geometry.camera import Camera
from ..geometry.homography import Homography, apply, cross_error, jacobians
from ..geometry.transforms import heading_matrix, wrap_angle
from ..records import CameraModel, Floats, Matrix3, Pose, Vector3
from .setup import NO_POSE, RoofCalibration, matrix3

STEPS = 20
SPREAD_M = 0.05  # beacons nearer together than this do not show a heading


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A beacon in one camera: undistorted pixels (2,) with covariance (2, 2)."""

    camera: str
    beacon: str
    pixel: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class RoofPose:
    """The robot's planar pose in the world, with covariance of (x, y, heading).

    `chi2` is the whitened sum of squares, `freedom` its degrees; `cross_px` is equation 35 averaged over the beacons
    that several cameras see, None if none is. `cameras` took part.
    """

    pose: Pose
    covariance: Matrix3
    chi2: float
    freedom: int
    cross_px: float | None
    cameras: tuple[str, ...]


class Lens:
    """Undoes one roof camera's distortion."""

    def __init__(self, model: CameraModel) -> None:
        self._flat = model.model == "brown-conrady" and not any(model.distortion)
        self._camera = Camera(replace(model, T_robot_camera=NO_POSE))

    def undistort(self, pixel: Floats, covariance: Floats) -> tuple[Floats, Floats] | None:
        """Undistorted (2,) pixel and its (2, 2) covariance; None beyond where the lens model can be inverted."""
        if self._flat:
            return np.array(pixel, dtype=np.float64), np.array(covariance, dtype=np.float64)
        step = 0.5
        around = pixel + np.array([[0.0, 0.0], [step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
        rays, valid = self._camera.rays(around)
        if not valid.all() or rays[:, 2].min() < 0.05:
            return None
        flat = rays[:, :2] / rays[:, 2:] * self._camera.focal + self._camera.centre
        turn = np.stack([flat[1] - flat[2], flat[3] - flat[4]], axis=1) / (2.0 * step)
        return flat[0], turn @ covariance @ turn.T

    def distort(self, pixels: Floats) -> Floats:
        """(N, 2) pixels as seen, of undistorted ones; NaN outside the lens model."""
        if self._flat:
            return np.array(pixels, dtype=np.float64)
        ideal = (pixels - self._camera.centre) / self._camera.focal
        return self._camera.project(np.column_stack([ideal, np.ones(len(ideal))]))[0]


def solve_pose(
    seen: Sequence[Seen], homographies: Mapping[str, Homography], beacons: Mapping[str, Vector3]
) -> RoofPose | None:
    """Fit the robot's pose to what the cameras see at one time.

    Parameters
    ----------
    seen : sequence of Seen
    homographies : mapping of str to Homography
        By the cameras' names, from the beacons' plane to undistorted pixels.
    beacons : mapping of str to (3,) tuple
        Places on the robot in metres.

    Returns
    -------
    RoofPose or None
        None if fewer than two different beacons are seen.
    """
    used = [item for item in seen if item.camera in homographies and item.beacon in beacons]
    if not used:
        return None
    arms = np.array([beacons[item.beacon][:2] for item in used])
    if np.ptp(arms, axis=0).max() < SPREAD_M:
        return None
    world = np.array([apply(homographies[item.camera].inverse, item.pixel[None])[0] for item in used])
    pose = _start(arms, world)
    whiten = np.stack([_whitener(item, homographies[item.camera], at) for item, at in zip(used, world, strict=True)])
    normal, residual = np.eye(3), np.zeros(0)
    for _ in range(STEPS):
        turned = arms @ heading_matrix(pose[2]).T
        at = pose[:2] + turned
        residuals, rows = [], []
        for k, item in enumerate(used):
            H = homographies[item.camera].matrix
            by_point, _ = jacobians(H, at[k : k + 1])
            by_pose = np.column_stack([np.eye(2), np.array([-turned[k, 1], turned[k, 0]])])
            residuals.append(whiten[k] @ (item.pixel - apply(H, at[k : k + 1])[0]))
            rows.append(whiten[k] @ by_point[0] @ by_pose)
        residual, jacobian = np.concatenate(residuals), np.concatenate(rows)
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(3), jacobian.T @ residual)
        pose = pose + step
        if float(np.abs(step).max()) < 1e-10:
            break
    return RoofPose(
        pose=Pose(float(pose[0]), float(pose[1]), float(wrap_angle(float(pose[2])))),
        covariance=matrix3(np.asarray(np.linalg.pinv(normal), np.float64)),
        chi2=float(residual @ residual),
        freedom=2 * len(used) - 3,
        cross_px=_cross(used, homographies),
        cameras=tuple(sorted({item.camera for item in used})),
    )


def _start(arms: Floats, world: Floats) -> Floats:
    """Planar pose that brings places on the robot onto places in the world (least squares, without scale)."""
    a, b = arms - arms.mean(axis=0), world - world.mean(axis=0)
    heading = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    return np.array([*(world.mean(axis=0) - heading_matrix(heading) @ arms.mean(axis=0)), heading])


def _whitener(item: Seen, homography: Homography, at: Floats) -> Floats:
    spread = item.covariance + homography.pixel_spread(at[None])[0]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(spread)))


def _cross(used: Sequence[Seen], homographies: Mapping[str, Homography]) -> float | None:
    errors = []
    for beacon in sorted({item.beacon for item in used}):
        mine = {item.camera: item for item in used if item.beacon == beacon}
        if len(mine) > 1:
            pixels = np.array([item.pixel for item in mine.values()])
            errors.append(cross_error(pixels, np.array([homographies[name].inverse for name in mine])))
    return float(np.mean(errors)) if errors else None


def plausible_pair(
    calibration: RoofCalibration, lens: Lens, spacing: float, front: tuple[float, float], rear: tuple[float, float]
) -> bool:
    """Whether two places in px can be front and rear of one robot: as far apart in the world as its beacons are."""
    places = []
    for pixel in (front, rear):
        flat = lens.undistort(np.array(pixel), np.eye(2))
        if flat is None:
            return False
        places.append(flat)
    points, spread = calibration.homography.to_plane(
        np.array([flat[0] for flat in places]), np.array([flat[1] for flat in places])
    )
    # a pixel each way of the search, and what the calibration leaves open
    sigma = float(np.sqrt(max(np.trace(spread[0]), np.trace(spread[1]))))
    apart = float(np.linalg.norm(points[0] - points[1]))
    return abs(apart - spacing) < 0.25 * spacing + 3.0 * sigma
