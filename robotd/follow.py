"""Steer the robot's origin along a path, as fast as its bends allow, and stop it where it should stop.

Steering is the path's curvature plus feedback of the distance e to the path and the heading error p,

    turn rate = v (curvature cos p / max(1 - curvature e, 1) - e / L^2 - 2 sin p / L),

which makes e die out over distance, not time, like a critically damped spring of natural length L (Samson 1995,
"Control of chained systems"; Siciliano et al., "Robotics", section 11.6). Samson's divisor is taken on the outer side
of bends only: inside a tight one the nearest point of the path runs ahead, and turning after it leads farther inside.
All three are taken where the robot will be when the wheels obey: the wishes still on their way are known. The speed is
the greatest from which the robot can still brake for every bend, for the stop and for the end of what is known (Bobrow
et al. 1985, along a path by one backward pass). Wheel speeds of the base come in steps of about 28.5 mm/s, so turn
rates come in steps of 0.12 rad/s; a small dither of the wishes makes the average linear.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from .drive_path import DrivePath, drive_path
from .records import Floats, Pose

SLOW_AFTER = 0.04  # m without seeing the line: one or two frames that miss it are nothing


@dataclass(frozen=True, slots=True)
class FollowConfig:
    """Metres, seconds, radians."""

    cruise: float = 0.22
    crawl: float = 0.10  # at most, while only memory is left
    acceleration: float = 0.30
    turn_rate: float = 0.9  # comfortable in corners: the speed there is this times the radius
    turn_acceleration: float = 3.0  # rad/s^2, comfortable where the curvature changes
    most_turn_rate: float = 1.4
    wheel_speed: float = 0.29  # of the faster wheel
    half_base: float = 0.1175  # half the distance between the wheels
    length: float = 0.07  # over which an error of position dies out, at least
    length_time: float = 0.45  # the same, in seconds of driving
    lag: float = 0.12  # seconds from a wish to the wheels' turning
    coast: float = 0.30  # metres on memory alone, then halt
    dither: float = 0.06  # rad/s, half a step of the base's turn rate
    least: float = 0.03  # below it the base's wheels may not turn at all
    corner_cut: float = 0.0  # 0: exactly along the line; 1: the shortest path within the corridor
    corridor: float = 0.05  # metres to either side of the line


@dataclass(frozen=True, slots=True)
class Steering:
    """What to do now, and why.

    `offset` is how far the robot is to the left of the path in metres, `heading_error` its heading against the
    path's, `beyond` how far it is past the path's end, `left` how much path is before it. `halted` says that there is
    nothing more to go by.
    """

    speed: float
    turn_rate: float
    offset: float
    heading_error: float
    beyond: float
    left: float
    halted: bool = False


class PathFollower:
    """Follows one path that grows ahead of the robot; remembers its last wishes."""

    def __init__(self, config: FollowConfig = FollowConfig()) -> None:
        self.config = config
        self._line: Floats | None = None
        self._path: DrivePath | None = None
        self.reset()

    def reset(self) -> None:
        """The robot stands."""
        self._speed = 0.0
        self._tick = 0
        self._wishes: deque[tuple[float, float, float]] = deque()  # seconds, m/s, rad/s, not yet obeyed

    def steer(
        self, line: Floats, pose: Pose, remaining: float, *, lost: float, dt: float, ends: bool = False
    ) -> Steering:
        """Speed (m/s) and turn rate (rad/s) to drive with until the next call.

        Parameters
        ----------
        line : (N, 2) array, N >= 2
            Ordered in the direction of travel, with some of it behind the robot; a new array when it changes.
        pose : Pose
            Of the robot, in the line's axes.
        remaining : float
            Metres to drive until standing.
        lost : float
            Metres driven since the line should have been seen: above 0 the robot slows down, beyond `coast` it halts.
        dt : float
            Seconds since the last call.
        ends : bool
            Whether the line is known to end where it ends; else it may go on beyond what is known.
        """
        config = self.config
        if line is not self._line or self._path is None:
            self._line, self._path = line, drive_path(line, config.corner_cut, config.corridor)
        path = self._path
        at, tangent, offset, beyond = _foot(path, pose)
        error = math.remainder(pose.heading - tangent, 2.0 * math.pi)
        left = path.length - at
        if ends:
            remaining = min(remaining, left - beyond)
        halted = max(lost, beyond) >= config.coast and remaining > 0.0
        if halted or remaining <= 0.0:
            self._speed = 0.0
            self._wish(dt, 0.0, 0.0)
            return Steering(0.0, 0.0, offset, error, beyond, left, halted)
        ahead = self._ahead(pose)
        there, course, e, _ = _foot(path, ahead, near=at)
        p = math.remainder(ahead.heading - course, 2.0 * math.pi)
        curvature = float(np.interp(there, path.s, path.curvature))
        length = max(config.length, config.length_time * self._speed)
        need = abs(p) * 2.0 / length + abs(e) / length**2  # curvature that feedback asks for
        limit = min(
            self._bend_speed(path, there),
            max(config.most_turn_rate / max(need, 1e-6), config.least),
            config.crawl if max(lost, beyond) > SLOW_AFTER else config.cruise,
        )
        room = max(remaining - 0.5 * config.lag * self._speed, 0.0)
        limit = min(limit, max(math.sqrt(2.0 * config.acceleration * room), config.least))
        self._speed = min(limit, self._speed + config.acceleration * dt)
        bent = curvature * math.cos(p) / max(1.0 - curvature * e, 1.0)
        held = min(max(e, -0.5 * length), 0.5 * length)
        turn_rate = self._speed * (bent - held / length**2 - 2.0 * math.sin(p) / length)
        turn_rate = min(max(turn_rate, -config.most_turn_rate), config.most_turn_rate)
        self._wish(dt, self._speed, turn_rate)
        self._tick += 1
        turn_rate += config.dither * (0.75, -0.25, 0.25, -0.75)[self._tick % 4]
        return Steering(self._speed, turn_rate, offset, error, beyond, left)

    def _wish(self, dt: float, speed: float, turn_rate: float) -> None:
        self._wishes.append((dt, speed, turn_rate))
        waiting = sum(wish[0] for wish in self._wishes)
        while self._wishes and waiting - self._wishes[0][0] >= self.config.lag:
            waiting -= self._wishes.popleft()[0]

    def _ahead(self, pose: Pose) -> Pose:
        """Where the robot will be when it begins to obey the next wish."""
        x, y, heading = pose.x, pose.y, pose.heading
        for dt, speed, turn_rate in self._wishes:
            heading += 0.5 * dt * turn_rate
            x, y = x + dt * speed * math.cos(heading), y + dt * speed * math.sin(heading)
            heading += 0.5 * dt * turn_rate
        return Pose(x, y, heading)

    def _bend_speed(self, path: DrivePath, at: float) -> float:
        """Speed at arc length `at` from which the robot can still brake for every bend ahead."""
        config = self.config
        near = (path.s >= at - 0.02) & (path.s <= at + config.cruise**2 / (2.0 * config.acceleration) + 0.1)
        if near.sum() < 3:
            return config.cruise
        s, bend = path.s[near], np.abs(path.curvature[near])
        change = np.abs(np.gradient(path.curvature[near], s))
        slow = np.minimum(
            config.turn_rate / np.maximum(bend, 1e-6), config.wheel_speed / (1.0 + config.half_base * bend)
        )
        slow = np.minimum(slow, np.sqrt(config.turn_acceleration / np.maximum(change, 1e-6)))
        slow = np.maximum(slow, config.least)
        return float(np.sqrt(slow**2 + 2.0 * config.acceleration * np.maximum(s - at, 0.0)).min())


def _foot(path: DrivePath, pose: Pose, near: float | None = None) -> tuple[float, float, float, float]:
    """Arc length of the nearest point of the path, heading there, offset to its left, and metres past its end.

    `near` narrows the search to where the foot was, because lines come by again.
    """
    away = np.array([pose.x, pose.y]) - path.points
    gap = np.hypot(away[:, 0], away[:, 1])
    turned = np.cos(path.heading - pose.heading) < -0.2
    gap = gap + np.where(turned, 0.2, 0.0)  # a hairpin's other leg is not where we are
    if near is not None:
        gap = gap + np.where(np.abs(path.s - near) > 0.15, 0.2, 0.0)
    best = int(gap.argmin())
    course = float(path.heading[best])
    forward = float(away[best] @ [math.cos(course), math.sin(course)])
    offset = float(away[best] @ [-math.sin(course), math.cos(course)])
    step = path.s[1] - path.s[0]
    beyond = max(0.0, forward) if best == len(path.s) - 1 else 0.0
    at = float(path.s[best] + np.clip(forward, -step, step))
    at = min(max(at, 0.0), path.length)
    return at, float(np.interp(at, path.s, path.heading)), offset, beyond
