"""Steer the robot's origin along a path, and stop it where it should stop.

The path is a polyline in odometry axes. Steering is the path's curvature, anticipated by the drive's lag, plus
feedback of the distance e to the path and the heading error p at the robot's origin,

    turn rate = v (curvature cos p / (1 - curvature e) - e / L^2 - 2 sin p / L),

which makes e die out over distance, not time, like a critically damped spring of natural length L (Samson 1995,
"Control of chained systems"; Siciliano et al., "Robotics", section 11.6). Wheel speeds of the base come in steps of
about 28.5 mm/s, so turn rates come in steps of 0.12 rad/s; a small dither of the wishes makes the average linear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .records import Floats, Pose


@dataclass(frozen=True, slots=True)
class FollowConfig:
    """Metres, seconds, radians."""

    cruise: float = 0.22
    crawl: float = 0.10  # at most, while only memory is left
    acceleration: float = 0.30
    turn_rate: float = 0.75  # comfortable in corners: the speed there is this times the radius
    most_turn_rate: float = 1.4
    length: float = 0.11  # over which an error of position dies out
    curvature_reach: float = 0.05  # half the length of path over which curvature is taken
    lag: float = 0.12  # seconds from a wish to the wheels' turning
    coast: float = 0.30  # metres on memory alone, then halt
    dither: float = 0.06  # rad/s, half a step of the base's turn rate
    least: float = 0.03  # below it the base's wheels may not turn at all


@dataclass(frozen=True, slots=True)
class Steering:
    """What to do now, and why.

    `offset` is how far the robot is to the left of the path in metres, `heading_error` its heading against the
    path's, `beyond` how far it is past the path's end. `halted` says that the line is given up.
    """

    speed: float
    turn_rate: float
    offset: float
    heading_error: float
    beyond: float
    halted: bool = False


class PathFollower:
    """Follows one path that grows ahead of the robot; keeps the dither and the last speed between calls."""

    def __init__(self, config: FollowConfig = FollowConfig()) -> None:
        self.config = config
        self.reset()

    def reset(self) -> None:
        """The robot stands."""
        self._speed = 0.0
        self._tick = 0

    def steer(self, path: Floats, pose: Pose, remaining: float, *, lost: float, dt: float) -> Steering:
        """Speed (m/s) and turn rate (rad/s) to drive with until the next call.

        Parameters
        ----------
        path : (N, 2) array, N >= 2
            Ordered in the direction of travel, with some of it behind the robot.
        pose : Pose
            Of the robot, in the path's axes.
        remaining : float
            Metres to drive until standing.
        lost : float
            Metres driven since the line should have been seen: above 0 the robot slows down, beyond `coast` it halts.
        dt : float
            Seconds since the last call.
        """
        config = self.config
        lag = self._speed * config.lag
        start, tangent, ahead, beyond = _foot(path, pose)
        offset = float(np.array([-tangent[1], tangent[0]]) @ (np.array([pose.x, pose.y]) - start))
        error = math.remainder(pose.heading - math.atan2(tangent[1], tangent[0]), 2.0 * math.pi)
        reach = np.arange(0.0, config.cruise**2 / (2.0 * config.acceleration) + 0.1, 0.02)
        bends = _curvatures(ahead, np.append(reach, lag), config.curvature_reach)
        curvature = float(bends[-1])
        halted = max(lost, beyond) >= config.coast and remaining > 0.0
        if halted or remaining <= 0.0:
            self._speed = 0.0
            return Steering(0.0, 0.0, offset, error, beyond, halted)
        need = abs(error) * 2.0 / config.length + abs(offset) / config.length**2  # curvature that feedback asks for
        limit = min(
            _corner_speed(config, reach, bends[:-1]), max(config.most_turn_rate / max(need, 1e-6), config.least)
        )
        self._speed = self._next_speed(limit, remaining, max(lost, beyond), dt)
        bent = curvature * math.cos(error) / max(1.0 - curvature * offset, 0.3)
        held = min(max(offset, -0.06), 0.06)
        turn_rate = self._speed * (bent - held / config.length**2 - 2.0 * math.sin(error) / config.length)
        turn_rate = min(max(turn_rate, -config.most_turn_rate), config.most_turn_rate)
        self._tick += 1
        turn_rate += config.dither * (0.75, -0.25, 0.25, -0.75)[self._tick % 4]
        return Steering(self._speed, turn_rate, offset, error, beyond)

    def _next_speed(self, limit: float, remaining: float, lost: float, dt: float) -> float:
        """The greatest speed that path, stop, memory and acceleration allow."""
        config = self.config
        if lost > 0.02:
            limit = min(limit, config.crawl)
        room = max(remaining - 0.5 * config.lag * self._speed, 0.0)
        limit = min(limit, config.cruise, max(math.sqrt(2.0 * config.acceleration * room), config.least))
        return min(limit, self._speed + config.acceleration * dt)


def _corner_speed(config: FollowConfig, reach: Floats, bends: Floats) -> float:
    """Speed from which the robot can still brake for every bend that is `reach` metres ahead."""
    slow = np.maximum(config.turn_rate / np.maximum(np.abs(bends), 1e-6), config.least)
    return float(np.sqrt(slow**2 + 2.0 * config.acceleration * np.maximum(reach - 0.02, 0.0)).min())


def _foot(path: Floats, pose: Pose) -> tuple[Floats, Floats, Floats, float]:
    """Nearest point of the path, unit tangent there, the path from there on, and metres past its end."""
    here = np.array([pose.x, pose.y])
    start, step = path[:-1], np.diff(path, axis=0)
    size = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
    unit = step / size[:, None]
    along = ((here - start) * unit).sum(axis=1)
    share = np.clip(along, 0.0, size)
    gap = np.hypot(*(here - start - share[:, None] * unit).T)
    heading = np.array([math.cos(pose.heading), math.sin(pose.heading)])
    gap = gap + np.where(unit @ heading < 0.0, 0.2, 0.0)  # a hairpin's other leg is not where we are
    best = int(gap.argmin())
    beyond = max(0.0, float(along[-1] - size[-1])) if best == len(size) - 1 else 0.0
    foot = start[best] + (along[best] if beyond else share[best]) * unit[best]
    ahead = np.vstack([foot, path[best + 1 :]]) if not beyond else np.vstack([foot, foot + 0.01 * unit[-1]])
    lengths = np.concatenate([[0.0], np.cumsum(size)])
    place = lengths[best] + share[best]
    low, high = max(place - 0.03, 0.0), min(place + 0.03, lengths[-1])
    if high - low < 0.02:
        return foot, unit[best], ahead, beyond
    chord = np.array([np.interp(high, lengths, path[:, k]) - np.interp(low, lengths, path[:, k]) for k in (0, 1)])
    return foot, chord / max(float(np.hypot(*chord)), 1e-9), ahead, beyond


def _curvatures(ahead: Floats, s: Floats, reach: float) -> Floats:
    """Curvature of a path at arc lengths `s` (N,) by the turn between two chords of length `reach`; shape (N,)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ahead, axis=0).T))])
    if lengths[-1] < 2.0 * reach:
        return np.zeros(len(s))
    middle = np.clip(s, reach, lengths[-1] - reach)
    at = middle + np.array([-reach, 0.0, reach])[:, None]
    x, y = np.interp(at, lengths, ahead[:, 0]), np.interp(at, lengths, ahead[:, 1])
    before, after = np.arctan2(y[1] - y[0], x[1] - x[0]), np.arctan2(y[2] - y[1], x[2] - x[1])
    turn = np.pi - np.mod(np.pi - (after - before), 2.0 * np.pi)
    bends: Floats = turn / reach
    return bends
