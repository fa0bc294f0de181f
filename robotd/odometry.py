"""Dead reckoning from wheel travel, and how far it can be trusted.

Each wheel's true travel is taken to be its encoder's travel plus a random walk whose variance grows with the distance
rolled, independently of the other wheel. The covariance of a move is that noise carried along the driven path: an
early error of heading sweeps the whole rest of the path sideways.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from .bind import ranged
from .geometry.transforms import wrap_angle
from .oi import COUNT
from .records import Matrix3, Move, OdometryState, Pose

SPEED_WINDOW = 0.12  # s: one count in one 15 ms tick is 30 mm/s, over this window it is 4 mm/s
MAX_WHEEL_SPEED = 1.0  # m/s: twice what the base can do
MAX_GAP = 0.5  # s: after a longer silence the counts need not continue the old ones


@dataclass(frozen=True, slots=True)
class Wheels:
    """[wheels] of the calibration: what turns encoder counts into motion.

    `scale_left` and `scale_right` are true over nominal travel, `base` is the distance between the wheels in metres,
    `travel_noise` the standard deviation of a wheel's travel after one metre (metres per square root of a metre).
    """

    scale_left: float = ranged(1.0, minimum=0.5, maximum=2.0)
    scale_right: float = ranged(1.0, minimum=0.5, maximum=2.0)
    base: float = ranged(0.235, minimum=0.05, maximum=1.0)
    travel_noise: float = ranged(0.003, minimum=0.0, maximum=0.1)


def arc(left: float, right: float, base: float) -> tuple[float, float, float]:
    """Displacement (dx, dy, dheading) in the axes at the start of wheels rolling `left` and `right` metres.

    Exact for a circular arc: the chord has the direction of half the turn and the length
    s sin(a / 2) / (a / 2), with s the mean travel and a the turn (right - left) / base.
    """
    travel, half = 0.5 * (left + right), 0.5 * (right - left) / base
    chord = travel * (math.sin(half) / half if abs(half) > 1e-6 else 1.0 - half * half / 6.0)
    return chord * math.cos(half), chord * math.sin(half), 2.0 * half


class _Path:
    """Motion since some instant in the axes of that instant, heading unwrapped, with its covariance (6 entries)."""

    def __init__(self) -> None:
        self.x = self.y = self.heading = 0.0
        self.xx = self.xy = self.xh = self.yy = self.yh = self.hh = 0.0
        self.broken = False

    def add(self, left: float, right: float, wheels: Wheels) -> None:
        """Append one step of wheel travel.

        First-order propagation P' = F P F^T + G Q G^T: F is the derivative of the step by the pose before it, G by
        the two wheels' travels (evaluated at mid-angle), Q = travel_noise^2 diag(|left|, |right|).
        """
        forward, sideways, turn = arc(left, right, wheels.base)
        c, s = math.cos(self.heading), math.sin(self.heading)
        dx, dy = c * forward - s * sideways, s * forward + c * sideways
        # F: an error of heading shifts the end of the step at right angles to it
        self.xx += -2.0 * dy * self.xh + dy * dy * self.hh
        self.xy += dx * self.xh - dy * self.yh - dx * dy * self.hh
        self.yy += 2.0 * dx * self.yh + dx * dx * self.hh
        self.xh -= dy * self.hh
        self.yh += dx * self.hh
        # G: columns for the left and the right wheel
        middle = self.heading + 0.5 * turn
        along_x, along_y = 0.5 * math.cos(middle), 0.5 * math.sin(middle)
        across_x, across_y = 0.5 * dy / wheels.base, 0.5 * dx / wheels.base
        for sign, rolled in ((-1.0, abs(left)), (1.0, abs(right))):
            q = wheels.travel_noise * wheels.travel_noise * rolled
            gx, gy, gh = along_x - sign * across_x, along_y + sign * across_y, sign / wheels.base
            self.xx += q * gx * gx
            self.xy += q * gx * gy
            self.xh += q * gx * gh
            self.yy += q * gy * gy
            self.yh += q * gy * gh
            self.hh += q * gh * gh
        self.x += dx
        self.y += dy
        self.heading += turn

    def covariance(self, base: float) -> Matrix3:
        """With the encoders' quantisation at both ends, which also keeps it positive definite after no motion."""
        count = COUNT * COUNT / 6.0  # variance of the difference of two roundings to whole counts, one wheel
        position, heading = 0.5 * count, 2.0 * count / (base * base)
        return (
            (self.xx + position, self.xy, self.xh),
            (self.xy, self.yy + position, self.yh),
            (self.xh, self.yh, self.hh + heading),
        )


class Odometry:
    """Pose of the robot since construction, and the move since the last mark.

    Parameters
    ----------
    wheels : Wheels
        The calibration.

    Attributes
    ----------
    resets : int
        How often the wheel travel jumped or was silent too long, so that motion may be missing.
    """

    def __init__(self, wheels: Wheels) -> None:
        self.wheels = wheels
        self.resets = 0
        self._pose = Pose(0.0, 0.0, 0.0)
        self._travelled = 0.0
        self._move = _Path()
        self._last: tuple[float, float, float] | None = None
        self._recent: deque[tuple[float, float, float]] = deque()

    @property
    def broken_since_mark(self) -> bool:
        """Whether a reset happened since the mark: then the move lacks an unknown motion, and the leg ends here."""
        return self._move.broken

    def update(self, t: float, left: float, right: float) -> OdometryState:
        """Take the wheels' travel at time `t` and return where the robot is.

        Parameters
        ----------
        t : float
            Seconds; not before the last update.
        left, right : float
            Nominal metres rolled by each wheel since any fixed instant, forward positive, as in SensorFrame.
        """
        if self._last is not None:
            last_t, last_left, last_right = self._last
            step_left, step_right, elapsed = left - last_left, right - last_right, t - last_t
            farthest = 0.02 + MAX_WHEEL_SPEED * max(0.0, elapsed)
            if elapsed > MAX_GAP or max(abs(step_left), abs(step_right)) > farthest:
                self.resets += 1
                self._move.broken = True
                self._recent.clear()
            elif step_left or step_right:
                self._roll(step_left * self.wheels.scale_left, step_right * self.wheels.scale_right)
        self._last = (t, left, right)
        speed, turn_rate = self._rates(self._last)
        return OdometryState(t, self._pose, self._travelled, speed, turn_rate)

    def mark(self) -> None:
        """Start a new move here."""
        self._move = _Path()

    def move_since_mark(self) -> Move:
        """Motion since the mark (or construction) in the axes of the robot at the mark, with its covariance.

        The covariance is positive definite; it does not contain errors that last for a whole leg (scales, base) nor
        slips, which the solver treats on its own.
        """
        move = self._move
        return Move(move.x, move.y, wrap_angle(move.heading), move.covariance(self.wheels.base))

    def _roll(self, left: float, right: float) -> None:
        self._move.add(left, right, self.wheels)
        forward, sideways, turn = arc(left, right, self.wheels.base)
        pose = self._pose
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        self._pose = Pose(
            pose.x + c * forward - s * sideways,
            pose.y + s * forward + c * sideways,
            wrap_angle(pose.heading + turn),
        )
        self._travelled += abs(0.5 * (left + right))

    def _rates(self, latest: tuple[float, float, float]) -> tuple[float, float]:
        recent = self._recent
        recent.append(latest)
        while len(recent) > 2 and latest[0] - recent[1][0] >= SPEED_WINDOW:
            recent.popleft()
        elapsed = latest[0] - recent[0][0]
        if elapsed <= 0.0:
            return 0.0, 0.0
        left = (latest[1] - recent[0][1]) * self.wheels.scale_left / elapsed
        right = (latest[2] - recent[0][2]) * self.wheels.scale_right / elapsed
        return 0.5 * (left + right), (right - left) / self.wheels.base
