"""Where odometry says that beacons go in a roof camera's picture.

Dead reckoning knows the way, not the place: its axes are laid onto the world's by the last pose that the cameras saw.
The beacon's place at one time is known from the picture, so only the way from there is taken from odometry, and an
error of the axes' heading counts with the length of that way alone, some tens of centimetres.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from ..geometry.homography import apply
from ..geometry.transforms import heading_matrix, pose_array, se2_compose, se2_inverse, wrap_angle
from ..records import Floats, OdometryState, Pose, Vector3
from .pose import Lens
from .setup import RoofCalibration

KEPT_S = 12.0


class OdometryTrack:
    """The last seconds of dead reckoning, on the frames' clock."""

    def __init__(self) -> None:
        self._states: deque[tuple[float, float, float, float]] = deque()
        self._axes: Floats | None = None  # T_world_odometry

    def add(self, state: OdometryState) -> None:
        """The newest state; one that is not newer is left out."""
        if self._states and state.t <= self._states[-1][0]:
            return
        heading = state.pose.heading
        if self._states:  # without jumps at half a turn, so that it can be interpolated
            before = self._states[-1][3]
            heading = before + float(wrap_angle(heading - before))
        self._states.append((state.t, state.pose.x, state.pose.y, heading))
        while state.t - self._states[0][0] > KEPT_S:
            self._states.popleft()

    def place(self, pose: Pose, t: float) -> None:
        """The cameras saw the robot there at a time."""
        if self.covers(t):
            self._axes = se2_compose(pose_array(pose), se2_inverse(self.at(np.array([t]))[0]))

    def covers(self, t: float) -> bool:
        """Whether odometry of about that time is known."""
        return bool(self._states) and self._states[0][0] - 0.05 <= t <= self._states[-1][0] + 0.25

    def at(self, t: Floats) -> Floats:
        """(N, 3) poses in odometry axes at (N,) times; the motion at the end is carried on."""
        rows = np.array(self._states)
        poses = np.stack([np.interp(t, rows[:, 0], rows[:, k]) for k in (1, 2, 3)], axis=1)
        if len(rows) > 1:
            first = max(0, len(rows) - 8)
            span = rows[-1, 0] - rows[first, 0]
            speed = (rows[-1, 1:] - rows[first, 1:]) / max(float(span), 1e-3)
            poses += np.clip(t - rows[-1, 0], 0.0, 0.5)[:, None] * speed
        return np.asarray(poses)

    def places(
        self, calibration: RoofCalibration, lens: Lens, beacon: Vector3, t: Floats, place: Floats, t0: float
    ) -> Floats | None:
        """(N, 2) pixels of a beacon at (N,) times that is at a pixel at t0; None if odometry cannot say.

        Parameters
        ----------
        beacon : (3,) tuple
            Its place on the robot.
        place : (2,) array
            Pixel as seen.
        """
        if self._axes is None or not (self.covers(t0) and self.covers(float(t[0])) and self.covers(float(t[-1]))):
            return None
        flat = lens.undistort(place, np.eye(2))
        if flat is None:
            return None
        world = se2_compose(self._axes, self.at(np.concatenate([[t0], t])))
        arms = world[:, :2] + heading_matrix(world[:, 2]) @ np.array(beacon[:2])
        start = apply(calibration.homography.inverse, flat[0][None])[0]
        pixels = lens.distort(apply(calibration.homography.matrix, start + arms[1:] - arms[0]))
        return pixels if np.isfinite(pixels).all() else None
