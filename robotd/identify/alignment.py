"""Where the robot stands among the labels that it knows: its pose, corrected by the lights that have names already.

Odometry's heading after one metre is off by a degree, which is four pixels; a wheel that slips adds several. The lights
named first tell what it is at this stop, floor tilt included, so that all others are looked for where they really are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.transforms import invert_rigid, rotation_matrix, skew, transform_points
from ..records import Floats

TILT, SHIFT_M = 0.008, 0.03  # standard deviations of roll and pitch (rad), of x and y, before lights are named
FEWEST = 6  # lights that may move the pose: two say nothing about a third
TURNS = np.arange(-0.30, 0.301, 0.01)  # rad of heading that are tried where odometry explains less than half of them
GATE = 3.0  # standard deviations beyond which a light is hardly believed
DOUBT = 12.0  # residuals that the stated noise is worth against the measured ones
SHARPEST = 0.4  # of the stated noise, which the measured one may not fall below


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Corrected pose T_world_robot (4, 4), the standard deviation `heading` (rad) that is left, and the size of the
    lights' residuals relative to what was stated (`spread`)."""

    T_world_robot: Floats
    heading: float
    spread: float


def align(
    cameras: Sequence[Camera],
    number: NDArray[np.intp],
    pixels: Floats,
    points: Floats,
    covariances: Floats,
    T_world_robot: Floats,
    heading: float,
    noise_px: float,
) -> Alignment | None:
    """Fit the robot's pose to lights whose labels are known.

    Parameters
    ----------
    cameras : sequence of Camera
        The rig.
    number, pixels : (N,) and (N, 2) arrays
        Each light's camera and where it is there.
    points, covariances : (N, 3) and (N, 3, 3) arrays
        Of the lights' labels, in the world's axes.
    T_world_robot : (4, 4) array
        As odometry has it; its `heading` is good to so many radians (1 sigma).
    noise_px : float
        Error of a prediction besides pose and the label's covariance, 1 sigma.

    Returns
    -------
    Alignment or None
        None if the lights are too few, or fewer than half of them agree on a pose.

    Notes
    -----
    Gauss-Newton over small rotations about three axes and x, y, under priors; every residual is whitened by the
    covariance of its prediction and weighted as Cauchy-distributed, because a name may be wrong and a light may be a
    mirror image. Where wheels slipped, headings on a grid are tried first.
    """
    if len(pixels) < FEWEST:
        return None
    prior = 1.0 / np.array([TILT, TILT, heading, SHIFT_M, SHIFT_M]) ** 2
    start = T_world_robot
    _, _, squares = _residuals(cameras, number, pixels, points, covariances, start, noise_px)
    if 2 * np.count_nonzero(squares < GATE**2 + (heading / TILT) ** 2) < len(pixels):
        trials = []
        for turn in TURNS:
            trial = _moved(T_world_robot, np.array([0.0, 0.0, turn, 0.0, 0.0]))
            _, _, squares = _residuals(cameras, number, pixels, points, covariances, trial, noise_px)
            trials.append((int(np.count_nonzero(squares < 2.0 * GATE**2)), -abs(float(turn)), trial))
        start = max(trials, key=lambda each: each[:2])[2]
        prior[2:] *= 0.01  # something slipped: odometry says little
    change: Floats = np.zeros(5)  # from `start`, to which the priors apply
    for _ in range(6):
        pose = _moved(start, change)
        residuals, slopes, squares = _residuals(cameras, number, pixels, points, covariances, pose, noise_px)
        weights = 1.0 / (1.0 + squares / GATE**2)
        information = np.einsum("n,nik,nil->kl", weights, slopes, slopes) + np.diag(prior)
        step = np.linalg.solve(information, np.einsum("n,nik,ni->k", weights, slopes, residuals) - prior * change)
        change = change + step
    pose = _moved(start, change)
    _, _, squares = _residuals(cameras, number, pixels, points, covariances, pose, noise_px)
    agree = squares < GATE**2
    if 2 * np.count_nonzero(agree) < len(pixels):
        return None
    freedoms = max(2.0 * np.count_nonzero(agree) - 5.0, 0.0)
    spread = np.sqrt((DOUBT + squares[agree].sum()) / (DOUBT + freedoms))
    left = float(np.sqrt(np.linalg.inv(information)[2, 2]))
    return Alignment(pose, left, float(np.clip(spread, SHARPEST, 2.0)))


def _moved(T_world_robot: Floats, change: Floats) -> Floats:
    """The pose turned by a rotation vector about the world's axes, at its own origin, and shifted on the floor."""
    moved = T_world_robot.copy()
    moved[:3, :3] = rotation_matrix(change[:3]) @ T_world_robot[:3, :3]
    moved[:2, 3] += change[3:]
    return moved


def _residuals(
    cameras: Sequence[Camera],
    number: NDArray[np.intp],
    pixels: Floats,
    points: Floats,
    covariances: Floats,
    T_world_robot: Floats,
    noise_px: float,
) -> tuple[Floats, Floats, Floats]:
    """Whitened residuals (N, 2), their slopes by rotation and shift (N, 2, 5), and squared lengths (N,)."""
    residuals, slopes = np.full((len(pixels), 2), 1e3), np.zeros((len(pixels), 2, 5))
    for index in np.unique(number):
        here = np.flatnonzero(number == index)
        T_world_camera = T_world_robot @ cameras[index].T_robot_camera
        uv, by_point, valid = cameras[index].project_jacobian(
            transform_points(invert_rigid(T_world_camera), points[here])
        )
        here, uv, by_point = here[valid], uv[valid], by_point[valid]
        by_world = by_point @ T_world_camera[:3, :3].T
        noise = by_world @ covariances[here] @ np.swapaxes(by_world, 1, 2) + noise_px**2 * np.eye(2)
        whiten = np.linalg.inv(np.linalg.cholesky(noise))
        arm = skew(points[here] - T_world_robot[:3, 3])
        by_pose = np.concatenate([by_world @ arm, -by_world[:, :, :2]], axis=2)
        residuals[here] = (whiten @ (pixels[here] - uv)[:, :, None])[:, :, 0]
        slopes[here] = whiten @ by_pose
    return residuals, slopes, (residuals**2).sum(axis=1)
