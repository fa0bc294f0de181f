"""The robot's body: what the wheels' rotation really does to it.

Each wheel turns as its motor tells it and rolls on the floor with an error of its own: a random walk that grows with
the square root of the distance, now and then a slip, and wheels and base that are not quite what the calibration
says. The floor is not flat. Walls and shelves stop the body while the wheels go on turning.
"""

from __future__ import annotations

import bisect
import math
from collections import deque

import numpy as np

from ..records import Floats, Pose
from .layout import StoreLayout
from .settings import WorldSettings

HISTORY = 3.0  # s of poses at every step, for cameras that look back by their exposure and delay
EXTRAPOLATION = 0.020  # s beyond the last step that `pose_at` carries the last motion on
TOUCH = 0.002  # m: nearer than this the bumper is pressed


class TiltField:
    """Roll and pitch of a floor that is not flat: a stationary Gaussian random field.

    A sum of plane waves with random phases (random Fourier features of the covariance
    sigma^2 exp(-(distance / correlation)^2); Rahimi and Recht 2007).
    """

    WAVES = 64

    def __init__(self, sigma: float, correlation: float, rng: np.random.Generator) -> None:
        self._waves = rng.normal(0.0, math.sqrt(2) / correlation, (2, self.WAVES, 2))
        self._phases = rng.uniform(0.0, 2 * math.pi, (2, self.WAVES))
        self._scale = sigma * math.sqrt(2 / self.WAVES)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Rotation of the floor about the store's x and y axes at a point, in radians."""
        about_x, about_y = self._scale * np.cos(self._waves @ np.array([x, y]) + self._phases).sum(axis=1)
        return float(about_x), float(about_y)


class Body:
    """True motion of the robot in store axes, advanced by whoever turns the wheels.

    Parameters
    ----------
    layout : StoreLayout
        Walls, shelves and mirrors stop the body, and so does the edge of the floor.
    settings : WorldSettings
    rng : numpy Generator
        Of the wheels and the floor alone.
    start : Pose
        Where the robot is switched on, in store axes.

    Attributes
    ----------
    left_rotation, right_rotation : float
        Metres that each wheel's rim has turned since switching on, at the wheel's nominal size: what encoders count.
    bump_left, bump_right : bool
        The bumper is pressed on that side.
    cliff, wheel_drop_left, wheel_drop_right : bool
        What the sensors under the robot say; set from outside.
    slips : int
        How often a wheel has slipped.
    start : Pose
        Where the robot was switched on, in store axes.
    """

    def __init__(self, layout: StoreLayout, settings: WorldSettings, rng: np.random.Generator, start: Pose) -> None:
        self.settings = settings
        self.start = start
        self.left_rotation = self.right_rotation = 0.0
        self.bump_left = self.bump_right = False
        self.cliff = self.wheel_drop_left = self.wheel_drop_right = False
        self.slips = 0
        self._rng = rng
        self._scale = 1.0 + settings.wheel_scale_error * rng.standard_normal()
        self._base = settings.wheel_base * (1.0 + settings.wheel_base_error * rng.standard_normal())
        self._tilt = TiltField(settings.tilt, settings.tilt_correlation, rng)
        self._obstacles = _obstacles(layout)
        self._t = 0.0
        self._pose = start
        self._rates = (0.0, 0.0, 0.0)  # dx/dt, dy/dt, dheading/dt of the last step
        self._slack = 0.0  # how far the body can still move before it could touch anything
        self._to_slip = [0.0, 0.0]  # rim metres of each wheel that still slip
        self._next_slip = self._draw_slip()
        self._moving = False
        self._stood: tuple[Pose, Floats] | None = None  # where `T_store_robot` last was, and its answer
        self._history: deque[tuple[float, float, float, float]] = deque([(0.0, start.x, start.y, start.heading)])
        self._trail = [(0.0, start.x, start.y, start.heading)]

    @property
    def true_scale(self) -> float:
        """Metres on the ground per nominal rim metre."""
        return self._scale

    @property
    def true_base(self) -> float:
        """Distance between the wheels' contact points in metres."""
        return self._base

    @property
    def pose(self) -> Pose:
        """Where the body is now, in store axes."""
        return self._pose

    def lift(self) -> None:
        """Take the robot off the floor: both wheels drop, and turning them moves nothing."""
        self.wheel_drop_left = self.wheel_drop_right = True

    def put_down(self) -> None:
        """Put the robot back where it was."""
        self.wheel_drop_left = self.wheel_drop_right = False

    def place(self, pose: Pose) -> None:
        """Carry the robot there: no wheel turns."""
        self._pose = pose
        self._slack = 0.0

    def slip(self, left: float, right: float) -> None:
        """Let each wheel's rim turn so many metres, at its next motion, without moving the robot."""
        self._to_slip[0] += left
        self._to_slip[1] += right
        self.slips += 1

    def advance(self, t: float, left_speed: float, right_speed: float) -> None:
        """Turn the wheels with these nominal rim speeds (m/s) from the time of the last call to `t` seconds."""
        dt = t - self._t
        if dt <= 0.0:
            return
        before, started = self._pose, self._t
        self._t = t
        moving = left_speed != 0.0 or right_speed != 0.0
        if moving:
            left, right = left_speed * dt, right_speed * dt
            self.left_rotation += left
            self.right_rotation += right
            self._plan_slips(abs(left + right) / 2)
            ground = self._roll(0, left), self._roll(1, right)
            if not (self.wheel_drop_left or self.wheel_drop_right):
                self._move(*ground)
        after = self._pose
        turn = math.remainder(after.heading - before.heading, 2 * math.pi)
        self._rates = ((after.x - before.x) / dt, (after.y - before.y) / dt, turn / dt)
        self._remember(started, before, moving)

    def pose_at(self, t: float) -> Pose:
        """Where the body was at `t`, at most three seconds back; a little ahead of the last step its motion goes on."""
        if t >= self._t:
            ahead = min(t - self._t, EXTRAPOLATION)
            vx, vy, turn = self._rates
            pose = self._pose
            return Pose(pose.x + vx * ahead, pose.y + vy * ahead, _wrapped(pose.heading + turn * ahead))
        return _interpolated(self._history, t)

    def trail(self) -> Floats:
        """(N, 3) x, y, heading of the whole way, at most 10 mm or 50 ms of motion apart."""
        pose = self._pose
        return np.array([row[1:] for row in self._trail] + [(pose.x, pose.y, pose.heading)])

    def trail_at(self, t: float) -> Pose:
        """Where the body was at any time since it was switched on, to the trail's resolution."""
        if t >= self._trail[-1][0]:
            return self.pose_at(t)
        return _interpolated(self._trail, t)

    def T_store_robot(self, t: float) -> Floats:
        """(4, 4) pose in space at `t`: heading about the vertical, then the floor's roll and pitch there; z is 0.

        Read-only, and the same array as long as the robot stands still.
        """
        pose = self.pose_at(t)
        if self._stood is None or pose != self._stood[0]:
            T = self.transform(pose)
            T.flags.writeable = False
            self._stood = pose, T
        return self._stood[1]

    def transform(self, pose: Pose) -> Floats:
        """(4, 4) transform from robot to store axes of a body that stands at `pose`."""
        about_x, about_y = self._tilt.at(pose.x, pose.y)
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        roll, pitch = cos * about_x + sin * about_y, cos * about_y - sin * about_x
        angle = math.hypot(roll, pitch) or 1e-12
        ax, ay = roll / angle, pitch / angle
        c, s = math.cos(angle), math.sin(angle)
        tilt = np.array(  # Rodrigues' formula for the axis (ax, ay, 0)
            [
                [c + ax * ax * (1 - c), ax * ay * (1 - c), ay * s],
                [ax * ay * (1 - c), c + ay * ay * (1 - c), -ax * s],
                [-ay * s, ax * s, c],
            ]
        )
        T = np.eye(4)
        T[:3, :3] = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ tilt
        T[:2, 3] = pose.x, pose.y
        return T

    def _draw_slip(self) -> float:
        distance = self.settings.slip_distance
        return float(self._rng.exponential(distance)) if distance > 0 else math.inf

    def _plan_slips(self, travel: float) -> None:
        self._next_slip -= travel
        if self._next_slip <= 0.0:
            self._next_slip = self._draw_slip()
            self._to_slip[int(self._rng.integers(2))] += self.settings.slip_length
            self.slips += 1

    def _roll(self, wheel: int, rotation: float) -> float:
        """Metres on the ground that a wheel makes of metres of rim."""
        slipped = math.copysign(min(self._to_slip[wheel], abs(rotation)), rotation)
        self._to_slip[wheel] -= abs(slipped)
        noise = self.settings.travel_noise * math.sqrt(abs(rotation)) * self._rng.standard_normal()
        return (rotation - slipped) * self._scale + noise

    def _move(self, left: float, right: float) -> None:
        pose = self._pose
        forward, turn = (left + right) / 2, (right - left) / self._base
        chord = forward * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
        middle = pose.heading + turn / 2
        heading = _wrapped(pose.heading + turn)
        moved = Pose(pose.x + chord * math.cos(middle), pose.y + chord * math.sin(middle), heading)
        self._slack -= abs(chord)
        if self._slack > 0.0:
            self._pose = moved
            return
        gap, bearing = self._clearance(moved)
        if gap < 0.0 and gap < self._clearance(pose)[0]:  # further in: the body stays and the wheels slip
            moved = Pose(pose.x, pose.y, heading)
        self._slack = max(0.0, gap - TOUCH)
        touches = gap <= TOUCH and abs(bearing) < math.radians(100)  # the bumper is at the front
        self.bump_left = touches and bearing > -math.radians(15)
        self.bump_right = touches and bearing < math.radians(15)
        self._pose = moved

    def _clearance(self, pose: Pose) -> tuple[float, float]:
        """Metres between the body and the nearest obstacle, and its bearing from the heading."""
        start, step, square = self._obstacles
        away = np.array([pose.x, pose.y]) - start
        share = np.clip((away * step).sum(axis=1) / square, 0.0, 1.0)
        away = away - share[:, None] * step
        gaps = np.hypot(away[:, 0], away[:, 1])
        nearest = int(np.argmin(gaps))
        bearing = math.atan2(-away[nearest, 1], -away[nearest, 0]) - pose.heading
        return float(gaps[nearest]) - self.settings.robot_radius, _wrapped(bearing)

    def _remember(self, started: float, before: Pose, moving: bool) -> None:
        pose = self._pose
        self._history.append((self._t, pose.x, pose.y, pose.heading))
        while self._history[0][0] < self._t - HISTORY:
            self._history.popleft()
        if moving != self._moving:  # a standstill begins or ends
            self._extend(started, before)
        self._moving = moving
        t, x, y, _ = self._trail[-1]
        if moving and (self._t - t >= 0.050 or math.hypot(pose.x - x, pose.y - y) >= 0.010):
            self._extend(self._t, pose)

    def _extend(self, t: float, pose: Pose) -> None:
        if t > self._trail[-1][0]:
            self._trail.append((t, pose.x, pose.y, pose.heading))


def _wrapped(angle: float) -> float:
    return math.pi - (math.pi - angle) % (2 * math.pi)


def _interpolated(
    rows: deque[tuple[float, float, float, float]] | list[tuple[float, float, float, float]], t: float
) -> Pose:
    after = min(bisect.bisect_right(rows, t, key=lambda row: row[0]), len(rows) - 1)
    t0, x0, y0, heading0 = rows[max(after - 1, 0)]
    t1, x1, y1, heading1 = rows[after]
    share = min(1.0, max(0.0, (t - t0) / (t1 - t0))) if t1 > t0 else 0.0
    turn = math.remainder(heading1 - heading0, 2 * math.pi)
    return Pose(x0 + share * (x1 - x0), y0 + share * (y1 - y0), _wrapped(heading0 + share * turn))


def _obstacles(layout: StoreLayout) -> tuple[Floats, Floats, Floats]:
    """Start, step and squared length of every edge that stops the robot, (N, 2), (N, 2) and (N,)."""
    width, depth = layout.size
    outlines = [(0.0, 0.0, width, depth), *(shelf.box for shelf in layout.shelves)]
    edges = [(wall.start, wall.end) for wall in layout.walls]
    edges += [(mirror.start, mirror.end) for mirror in layout.mirrors if mirror.bottom < 0.1]
    for x0, y0, x1, y1 in outlines:
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        edges += list(zip(corners, corners[1:] + corners[:1], strict=True))
    start, end = np.array([edge[0] for edge in edges]), np.array([edge[1] for edge in edges])
    return start, end - start, ((end - start) ** 2).sum(axis=1)
