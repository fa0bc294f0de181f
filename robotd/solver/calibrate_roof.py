"""Where a roof camera sees the plane of the beacons, from points whose places were measured. Thesis section 2.5.

Points at the beacons' own height give the homography of that plane directly (robotd.geometry.homography). Points on the
floor do not: from a camera 3 m up a beacon at 0.65 m is seen in front of floor that is a fifth of the distance farther
away. So otherwise the camera itself is found, its pose and, where its lens is not known, its focal length, and the
homography of the beacons' plane follows from it. What the points leave open (a camera straight above a flat floor may
be low with a wide lens or high with a narrow one) must then come from elsewhere: a lens calibration, the camera's
measured position, or points at another height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..errors import InputError, SolverError
from ..geometry.camera import Camera
from ..geometry.homography import Homography, apply, fit
from ..geometry.transforms import rotation_matrix, rotation_vector, transform_record
from ..records import CameraModel, Floats, Vector3

LEVEL = 0.005  # m: points within it count as one height
FOCALS = (0.45, 0.7, 1.1, 1.8)  # of the image's width: from 96 to 31 degrees across, to start from
FOCAL_SPREAD = 0.6  # of the logarithm: what is known of a lens that nobody calibrated
CALIBRATED = (1e-3, 0.3, 0.3)  # of the logarithm, and px of the centre: what calibration leaves of a lens
CENTRE_SPREAD = 0.02  # of the image's width: how far optical axes miss the middle of the picture
MOST_SIGMA = 0.05  # m, in the middle of the points: worse than odometry
MOST_CHI2 = 5.0  # per degree of freedom
REWEIGHTINGS = 3
OUTLIER = 4.5  # standard deviations by which one point may miss


@dataclass(frozen=True, slots=True)
class RoofPoint:
    """A point seen at (u, v) px and measured at (x, y, z) in world metres, `sigma_m` per axis."""

    u: float
    v: float
    x: float
    y: float
    z: float
    sigma_m: float = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class RoofFit:
    """A roof camera's view of the beacons' plane.

    Attributes
    ----------
    homography : Homography
        From world x, y at the beacons' height to undistorted pixels.
    model : CameraModel
        The lens; its pose is T_world_camera, where that was found, else unity.
    position : (3,) tuple or None
        Of the camera in the world; None where only the plane's homography was needed.
    seen, fitted : (N, 2) arrays
        Undistorted pixels of the points.
    rms_px, chi2 : float
        Of the residuals per coordinate, and their whitened sum of squares over the degrees of freedom.
    sigma_m : (N,) array
        Standard deviation (the larger axis) of the plane's points below the N points of the calibration.
    """

    homography: Homography
    model: CameraModel
    position: Vector3 | None
    seen: Floats
    fitted: Floats
    rms_px: float
    chi2: float
    sigma_m: Floats


def calibrate_roof(
    points: Sequence[RoofPoint],
    lens: CameraModel,
    height: float,
    *,
    lens_known: bool,
    camera: Vector3 | None = None,
    camera_sigma: float = 0.02,
    sigma_px: float = 0.5,
) -> RoofFit:
    """Fit one roof camera.

    Parameters
    ----------
    points : sequence of RoofPoint
    lens : CameraModel
        Name, size and lens; its pose is not used. With `lens_known` false only its size and distortion count.
    height : float
        Of the beacons above the floor in metres.
    camera : (3,) tuple, optional
        Its measured position in the world, `camera_sigma` metres per axis.
    sigma_px : float
        How well points were picked in the picture.

    Raises
    ------
    InputError
        Fewer than four points, or a point outside the picture.
    SolverError
        The points contradict each other, or leave the plane of the beacons too uncertain; the message names the point
        or says what is missing.
    """
    seen = _undistorted(points, lens)
    world = np.array([[point.x, point.y, point.z] for point in points]).reshape(-1, 3)
    sigma = np.array([point.sigma_m for point in points])
    position: Vector3 | None = None
    if np.abs(world[:, 2] - height).max() <= LEVEL:
        try:
            plane = fit(world[:, :2], seen, sigma_px, sigma)
        except ValueError as error:
            raise SolverError(f"{error}; spread them over the floor that the camera sees") from error
        homography, fitted, model = plane.homography, seen - plane.residual, lens
        chi2 = plane.chi2 / max(1, plane.freedom)
        whitened = plane.residual / sigma_px
    else:
        camera_fit = _resect(world, seen, sigma, sigma_px, lens, lens_known, camera, camera_sigma)
        model, covariance, fitted, whitened, freedom = camera_fit
        chi2 = float((whitened**2).sum()) / max(1, freedom)
        homography = _of_plane(model, covariance, height)
        position = model.T_robot_camera.translation
    _agree(points, whitened, chi2)
    _, spread = homography.to_plane(apply(homography.matrix, world[:, :2]))
    sigma_m = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, -1], 0.0))
    if not np.isfinite(sigma_m).all() or float(np.median(sigma_m)) > MOST_SIGMA:
        raise SolverError(_missing(points, float(np.median(sigma_m)), height, lens_known=lens_known, camera=camera))
    rms = float(np.sqrt(np.mean((seen - fitted) ** 2)))
    return RoofFit(homography, model, position, seen, fitted, rms, chi2, sigma_m)


def undistorted(pixels: Floats, lens: CameraModel) -> tuple[Floats, NDArray[np.bool_]]:
    """Pixels (N, 2) as a lens without distortion would show them, and which of them the lens model can tell (N,)."""
    if not any(lens.distortion) and lens.model == "brown-conrady":
        return np.array(pixels, dtype=np.float64), np.ones(len(pixels), dtype=np.bool_)
    rays, valid = Camera(replace(lens, T_robot_camera=transform_record(np.eye(4)))).rays(pixels)
    valid = valid & (rays[:, 2] > 0.05)
    with np.errstate(invalid="ignore", divide="ignore"):
        out = rays[:, :2] / rays[:, 2:] * np.array(lens.matrix[:2]) + np.array(lens.matrix[2:])
    return np.asarray(out), np.asarray(valid)


def _undistorted(points: Sequence[RoofPoint], lens: CameraModel) -> Floats:
    if len(points) < 4:
        raise InputError(f"{len(points)} points; measure 4 or more, spread over the floor that the camera sees")
    pixels = np.array([[point.u, point.v] for point in points])
    seen, valid = undistorted(pixels, lens)
    wide, high = lens.size
    bad = []
    for k, point in enumerate(points):
        where = f"point {k + 1} at ({point.u:g}, {point.v:g}) px"
        if not (-0.5 <= point.u <= wide - 0.5 and -0.5 <= point.v <= high - 0.5):
            bad.append(f"{where} is outside the picture of {wide}x{high}")
        elif not valid[k]:
            bad.append(f"{where} is beyond where the lens model can be inverted")
    if bad:
        raise InputError(*bad)
    return seen


@dataclass(frozen=True, slots=True, eq=False)
class _Resection:
    """What is fitted: rotation vector from world to camera axes (3), position (3), log of the focal length, centre (2).

    `world` (N, 3) and `sigma` (N,) in metres are the points' places, `seen` (N, 2) and `sigma_px` their pixels,
    `aspect` is fy over fx. `believed`, `spreads` (3,) are the priors of the last three values, `camera` (x, y, z) and
    `camera_sigma` that of the position, if it was measured.
    """

    world: Floats
    seen: Floats
    sigma: Floats
    sigma_px: float
    aspect: float
    believed: Floats
    spreads: Floats
    camera: Vector3 | None
    camera_sigma: float

    def project(self, values: Floats) -> tuple[Floats, Floats]:
        """Pixels (N, 2) and their derivatives (N, 2, 3) by the world points."""
        R = rotation_matrix(values[:3])
        local = (self.world - values[3:6]) @ R.T
        depth = np.where(local[:, 2] > 1e-3, local[:, 2], 1e-3)
        f = math.exp(values[6]) * np.array([1.0, self.aspect])
        image = local[:, :2] / depth[:, None]
        by_local = np.zeros((len(self.world), 2, 3))
        by_local[:, 0, 0], by_local[:, 1, 1] = f[0] / depth, f[1] / depth
        by_local[:, :, 2] = -f * image / depth[:, None]
        return image * f + values[7:9], by_local @ R

    def whitener(self, values: Floats) -> Floats:
        """(N, 2, 2) that scales pixel errors to unit variance, the measured places' errors included."""
        _, by_world = self.project(values)
        places = self.sigma[:, None, None] ** 2 * (by_world @ np.swapaxes(by_world, 1, 2))
        return np.linalg.inv(np.linalg.cholesky(self.sigma_px**2 * np.eye(2) + places))

    def residuals(self, values: Floats, whiten: Floats) -> Floats:
        """Whitened errors of the pixels (2 N), then those of the priors."""
        pixels, _ = self.project(values)
        parts = [(whiten @ (self.seen - pixels)[:, :, None]).ravel(), (values[6:9] - self.believed) / self.spreads]
        if self.camera is not None:
            parts.append((values[3:6] - np.array(self.camera)) / self.camera_sigma)
        return np.concatenate(parts)


def _resect(
    world: Floats,
    seen: Floats,
    sigma: Floats,
    sigma_px: float,
    lens: CameraModel,
    lens_known: bool,
    camera: Vector3 | None,
    camera_sigma: float,
) -> tuple[CameraModel, Floats, Floats, Floats, int]:
    """Pose and, under priors, focal length and centre: the model, covariance (9, 9), fitted, whitened, freedom."""
    width = lens.size[0]
    middle = (np.array(lens.size) - 1.0) / 2.0
    starts = [float(lens.matrix[0])] if lens_known else [share * width for share in FOCALS]
    centre = np.array(lens.matrix[2:]) if lens_known else middle
    aspect = lens.matrix[1] / lens.matrix[0] if lens_known else 1.0
    spreads = np.array(CALIBRATED) if lens_known else np.array([FOCAL_SPREAD, *2 * (CENTRE_SPREAD * width,)])
    believed = np.array([math.log(starts[0] if lens_known else 0.8 * width), *centre])

    fit = _Resection(world, seen, sigma, sigma_px, aspect, believed, spreads, camera, camera_sigma)
    best = None
    for focal in starts:
        K = np.array([[focal, 0.0, centre[0]], [0.0, aspect * focal, centre[1]], [0.0, 0.0, 1.0]])
        done, turn, shift = cv2.solvePnP(world, seen, K, None, flags=cv2.SOLVEPNP_SQPNP)
        if not done:
            continue
        R = rotation_matrix(np.asarray(turn, dtype=np.float64).ravel())
        at = -R.T @ np.asarray(shift, dtype=np.float64).ravel()
        start = np.concatenate([rotation_vector(R), at, [math.log(focal)], centre])
        # at first all pixels weigh the same, because weights that follow a poor start would favour it
        whiten = np.tile(np.eye(2) / sigma_px, (len(world), 1, 1))
        for _ in range(REWEIGHTINGS):
            result = least_squares(fit.residuals, start, x_scale="jac", max_nfev=200, args=(whiten,))
            start, whiten = result.x, fit.whitener(result.x)
        if np.isfinite(result.cost) and (best is None or result.cost < best[0].cost):
            best = result, whiten
    if best is None:
        raise SolverError("no camera sees the points so; are x, y and u, v in the right columns?")
    result, whiten = best
    values = np.asarray(result.x, dtype=np.float64)
    whitened = fit.residuals(values, whiten)[: 2 * len(world)].reshape(-1, 2)
    covariance = np.linalg.pinv(result.jac.T @ result.jac)
    R = rotation_matrix(values[:3])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = R.T, values[3:6]
    focal = math.exp(values[6])
    matrix = (focal, focal * aspect, float(values[7]), float(values[8]))
    model = replace(lens, matrix=matrix, T_robot_camera=transform_record(pose))
    freedom = 2 * len(world) - (6 if lens_known else 7)
    return model, covariance, fit.project(values)[0], whitened, freedom


def _of_plane(model: CameraModel, covariance: Floats, height: float) -> Homography:
    """The homography of the horizontal plane at a height, with the covariance that the camera's (9, 9) leaves it."""
    pose = model.T_robot_camera
    R = rotation_matrix(pose.rotation).T
    aspect = model.matrix[1] / model.matrix[0]
    values = np.concatenate(
        [rotation_vector(R), pose.translation, [math.log(model.matrix[0])], np.array(model.matrix[2:])]
    )

    def unit(at: Floats) -> Floats:
        turn = rotation_matrix(at[:3])
        focal = math.exp(at[6])
        K = np.array([[focal, 0.0, at[7]], [0.0, aspect * focal, at[8]], [0.0, 0.0, 1.0]])
        lifted = np.column_stack([turn[:, 0], turn[:, 1], turn @ (np.array([0.0, 0.0, height]) - at[3:6])])
        H = K @ lifted
        return np.asarray(H / np.linalg.norm(H))

    H = unit(values)
    steps = np.maximum(1e-6, 1e-7 * np.abs(values))
    jacobian = np.stack(
        [
            (unit(values + step * row) - unit(values - step * row)).ravel() / (2.0 * step)
            for step, row in zip(steps, np.eye(9), strict=True)
        ],
        axis=1,
    )
    return Homography(H, jacobian @ covariance @ jacobian.T)


def _agree(points: Sequence[RoofPoint], whitened: Floats, chi2: float) -> None:
    """Raise SolverError if the points do not fit one camera."""
    if chi2 <= MOST_CHI2:
        return
    size = np.linalg.norm(whitened, axis=1)
    worst = int(np.argmax(size))
    point = points[worst]
    stands_out = size[worst] > OUTLIER and (len(points) < 6 or size[worst] > 2.0 * np.sort(size)[-2])
    which = (
        f"point {worst + 1} at ({point.u:g}, {point.v:g}) px, ({point.x:g}, {point.y:g}, {point.z:g}) m does not fit"
        " the others; measure and pick it again"
        if stands_out
        else "check the places, and the lens: straight edges must look straight in the picture, or give --lens"
    )
    raise SolverError(f"the points contradict each other ({math.sqrt(chi2):.1f} times their uncertainty): {which}")


def _missing(
    points: Sequence[RoofPoint], sigma: float, height: float, *, lens_known: bool, camera: Vector3 | None
) -> str:
    heights = {round(point.z / LEVEL) for point in points}
    mends = []
    if len(heights) == 1:
        mends.append(f"points at the beacons' height of {height:g} m, e.g. on a stand")
    if not lens_known:
        mends.append("the camera's lens with --lens")
    if camera is None:
        mends.append("the camera's measured position with --camera X,Y,Z")
    if len(points) < 8:
        mends.append(f"more points than {len(points)}")
    return (
        f"the plane of the beacons is only known to {1e3 * sigma:.0f} mm from these points; add"
        f" {', or '.join(mends) or 'points that were measured better'}"
    )
