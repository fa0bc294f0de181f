"""What one frame shows of a line, put where the robot was when each of its rows was exposed."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from ..records import Floats, Line, Pose
from .polyline import resample
from .top_view import TopView

LEAST_POINTS = 4
RATE_WINDOW = 0.05  # s to either side: one encoder count in one 15 ms step is 0.13 rad/s, over this window 0.02


class PoseHistory:
    """Where odometry said the robot was during the last seconds."""

    def __init__(self, duration: float = 2.0) -> None:
        self._duration = duration
        self._times: deque[float] = deque()
        self._poses: deque[Pose] = deque()

    def add(self, t: float, pose: Pose) -> None:
        """Append a pose; times must not decrease."""
        if self._times and t <= self._times[-1]:
            return
        self._times.append(t)
        self._poses.append(pose)
        while self._times[0] < t - self._duration:
            self._times.popleft()
            self._poses.popleft()

    def at(self, t: float) -> tuple[Pose, float, float] | None:
        """Pose, speed and turn rate at `t`, interpolated; None if that is older than the history or still to come."""
        if len(self._times) < 2:
            return (self._poses[0], 0.0, 0.0) if self._times and abs(t - self._times[0]) < 0.2 else None
        if t < self._times[0] - 0.2 or t > self._times[-1] + 0.1:
            return None
        first, last = max(t - RATE_WINDOW, self._times[0]), min(t + RATE_WINDOW, self._times[-1])
        if last <= first:  # before or after all that is known: the nearest step says how it goes on
            first, last = (
                (self._times[0], self._times[1]) if t <= self._times[0] else (self._times[-2], self._times[-1])
            )
        pose, a, b = self._interpolated(t), self._interpolated(first), self._interpolated(last)
        turn = math.remainder(b.heading - a.heading, 2.0 * math.pi)
        step_x, step_y = b.x - a.x, b.y - a.y
        forward = step_x * math.cos(pose.heading) + step_y * math.sin(pose.heading)
        speed = math.copysign(math.hypot(step_x, step_y), forward)
        return pose, speed / (last - first), turn / (last - first)

    def _interpolated(self, t: float) -> Pose:
        """Between two known poses, or a step beyond them."""
        i = min(max(bisect_right(self._times, t), 1), len(self._times) - 1)
        (t0, a), (t1, b) = (self._times[i - 1], self._poses[i - 1]), (self._times[i], self._poses[i])
        share = min(max((t - t0) / (t1 - t0), 0.0), 2.0)
        turn = math.remainder(b.heading - a.heading, 2.0 * math.pi)
        heading = math.remainder(a.heading + share * turn, 2.0 * math.pi)
        return Pose(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), heading)


@dataclass(frozen=True, slots=True)
class Motion:
    """The robot at a frame's stamp: pose in odometry axes, m/s, rad/s, and metres driven until now."""

    pose: Pose
    speed: float
    turn_rate: float
    travelled: float


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """One seen polyline in odometry axes, its velocity there per second of stamp error, and its standard deviations."""

    points: Floats  # (N, 2)
    velocity: Floats  # (N, 2)
    forward_sigma: Floats  # (N,) along the view
    view: Floats  # (N, 2) unit vectors from the camera to the points
    confidence: float

    def reversed(self) -> Sight:
        """The same, passed through in the other direction."""
        return Sight(self.points[::-1], self.velocity[::-1], self.forward_sigma[::-1], self.view[::-1], self.confidence)

    def across_sigma(self, normal: Floats, point_sigma: float) -> Floats:
        """Standard deviation (N,) of each point along `normal` (N, 2): of detection, and of the floor's tilt."""
        along_view = (normal * self.view).sum(axis=1) * self.forward_sigma
        return np.asarray(np.sqrt(point_sigma**2 + along_view**2))


def sights(
    line: Line, view: TopView, motion: Motion, row_time: float, spacing: float, tilt_sigma: float
) -> list[Sight]:
    """A line of a frame in odometry axes, in both directions; empty if it is too short.

    Parameters
    ----------
    line : Line
        In pixels of the top view.
    view : TopView
    motion : Motion
        At the exposure of the first row.
    row_time : float
        Seconds from one row's exposure to the next.
    spacing : float
        Metres between the points returned.
    tilt_sigma : float
        Radians by which the floor is tilted against the calibration.
    """
    points = resample(view.to_robot(line.points), spacing)
    if len(points) < LEAST_POINTS:
        return []
    sigma = view.range_sigma(points, tilt_sigma)
    away = points - np.array(view.eye[:2])
    away /= np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)[:, None]
    delay = view.image_rows(points) * row_time
    pose, speed, turn_rate = motion.pose, motion.speed, motion.turn_rate
    heading = pose.heading + turn_rate * delay
    c, s = np.cos(heading), np.sin(heading)
    x = pose.x + speed * delay * c + c * points[:, 0] - s * points[:, 1]
    y = pose.y + speed * delay * s + s * points[:, 0] + c * points[:, 1]
    velocity = np.column_stack([speed * c - turn_rate * (y - pose.y), speed * s + turn_rate * (x - pose.x)])
    looking = np.column_stack([c * away[:, 0] - s * away[:, 1], s * away[:, 0] + c * away[:, 1]])
    one = Sight(np.column_stack([x, y]), velocity, sigma, looking, line.confidence)
    return [one, one.reversed()]


def to_robot(points: Floats, pose: Pose) -> Floats:
    """Points (N, 2) of odometry axes in the axes of a robot at `pose`."""
    away = points - np.array([pose.x, pose.y])
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    return np.column_stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]])


def from_robot(points: Floats, pose: Pose) -> Floats:
    """Points (N, 2) of the axes of a robot at `pose` in odometry axes."""
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    return np.column_stack([pose.x + c * points[:, 0] - s * points[:, 1], pose.y + s * points[:, 0] + c * points[:, 1]])
