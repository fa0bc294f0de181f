"""Dead reckoning from wheel travel, and how far it can be trusted.

Each wheel's true travel is taken to be its encoder's travel plus a random walk whose variance grows with the distance
rolled, independently of the other wheel. An early error of heading sweeps the whole rest of the path sideways:
`path_error` carries that along. Two statements come of it.

* A move's covariance in a survey holds what is new in each move: the random walk, the encoders' quantisation, and the
  stretches in which the base itself reports slipping. The solver treats the rest on its own: it estimates scale and
  turn factors of a whole leg under priors, and gives moves a robust loss because wheels slip.
* The total covariance, of a move or of the pose since the start, holds that and all else that makes the reckoned pose
  wrong: the uncertainty of the calibration, which is the same error in every move, and slips that nobody notices.

Both are second moments of the error about the reckoned pose; slips always shorten the way, so its mean is not zero.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from .bind import ranged
from .geometry.transforms import wrap_angle
from .oi import COUNT
from .path_error import CalibrationError, PathError, as_matrix3
from .records import Matrix3, Move, OdometryState, Pose

SPEED_WINDOW = 0.12  # s: one count in one 15 ms tick is 30 mm/s, over this window it is 4 mm/s
MAX_WHEEL_SPEED = 1.0  # m/s: twice what the base can do
MAX_GAP = 0.5  # s: after a longer silence the counts need not continue the old ones


WHEEL_BASE = 0.235  # m, Create 2 Open Interface 2016, packet 20


def calibration_covariance(scale_sigma: float, base_sigma: float) -> Matrix3:
    """Covariance of scale_left, scale_right and base: one error common to both scales, and one of the base in metres.

    For wheels that are alike. `robotd calibrate odometry` writes the covariance of what it measured instead.
    """
    scale, base = scale_sigma * scale_sigma, base_sigma * base_sigma
    return (scale, scale, 0.0), (scale, scale, 0.0), (0.0, 0.0, base)


CALIBRATED = calibration_covariance(0.003, 0.003 * WHEEL_BASE)


@dataclass(frozen=True, slots=True)
class Wheels:
    """[wheels] of the calibration: what turns encoder counts into motion, and how well it is known.

    `scale_left` and `scale_right` are true over nominal travel, `base` is the distance between the wheels in metres,
    `travel_noise` the standard deviation of a wheel's travel after one metre (metres per square root of a metre).
    `covariance` is that of (scale_left, scale_right, base in metres), by default 0.3 % of the size of both wheels and
    of the base. A wheel slips once in `slip_distance` metres (0: never) and then turns for `slip_length` metres in
    vain.
    """

    scale_left: float = ranged(1.0, minimum=0.5, maximum=2.0)
    scale_right: float = ranged(1.0, minimum=0.5, maximum=2.0)
    base: float = ranged(WHEEL_BASE, minimum=0.05, maximum=1.0)
    travel_noise: float = ranged(0.003, minimum=0.0, maximum=0.1)
    covariance: Matrix3 = CALIBRATED
    slip_length: float = ranged(0.03, minimum=0.0, maximum=1.0)
    slip_distance: float = ranged(20.0, minimum=0.0, maximum=1e6)

    def __post_init__(self) -> None:
        S = np.array(self.covariance)
        if not np.allclose(S, S.T, rtol=1e-6, atol=0.0) or np.linalg.eigvalsh(S)[0] < -1e-9 * np.trace(S):
            raise ValueError(
                "covariance: expected a symmetric 3x3 matrix without negative eigenvalues: the covariance of "
                "scale_left, scale_right and base"
            )


def odometry_priors(wheels: Wheels) -> tuple[float, float, float, float]:
    """Standard deviations of what is the same error in all moves, and the correlation of its first two.

    Of scale (relative), turns (relative) and drift (radians per metre), as the covariance of `wheels` has them: a turn
    is a difference of travels over the base, so that wheels larger than believed lengthen ways and turns alike.
    """
    half = 0.5 / (0.5 * (wheels.scale_left + wheels.scale_right))
    A = np.array([[half, half, 0.0], [half, half, -1.0 / wheels.base], [-1.0 / wheels.base, 1.0 / wheels.base, 0.0]])
    P = A @ np.array(wheels.covariance) @ A.T
    scale, turn, drift = np.sqrt(np.maximum(np.diagonal(P), 0.0)).tolist()
    drift = drift if drift > 1e-9 else 0.0  # of wheels that are alike only rounding is left
    correlation = float(np.clip(P[0, 1] / (scale * turn), -1.0, 1.0)) if scale > 0.0 and turn > 0.0 else 0.0
    return scale, turn, drift, correlation


def arc(left: float, right: float, base: float) -> tuple[float, float, float]:
    """Displacement (dx, dy, dheading) in the axes at the start of wheels rolling `left` and `right` metres.

    Exact for a circular arc: the chord has the direction of half the turn and the length
    s sin(a / 2) / (a / 2), with s the mean travel and a the turn (right - left) / base.
    """
    travel, half = 0.5 * (left + right), 0.5 * (right - left) / base
    chord = travel * (math.sin(half) / half if abs(half) > 1e-6 else 1.0 - half * half / 6.0)
    return chord * math.cos(half), chord * math.sin(half), 2.0 * half


class _Path:
    """Motion since some instant in the axes of that instant, heading unwrapped, with the moments of its error.

    `noise` says whether those without calibration and slips are wanted too.
    """

    def __init__(self, wheels: Wheels, *, noise: bool) -> None:
        self.wheels = wheels
        self.at = complex(0.0)
        self.heading = 0.0
        self.broken = False
        self._noise = PathError(wheels, slips=False) if noise else None
        self._all = PathError(wheels, slips=True)
        self._calibration = CalibrationError(wheels)

    def add(self, left: float, right: float, slipping: bool) -> None:
        """Append one step of wheel travel."""
        forward, sideways, turn = arc(left, right, self.wheels.base)
        step = cmath.rect(1.0, self.heading) * complex(forward, sideways)
        along = cmath.rect(1.0, self.heading + 0.5 * turn)
        if self._noise is not None:
            self._noise.add(step, along, left, right, slipping)
        self._all.add(step, along, left, right, slipping)
        self._calibration.add(step, along, left, right)
        self.at += step
        self.heading += turn

    def by_errors(self) -> Matrix3:
        """How it depends on the calibration; see `Move`."""
        return self._calibration.by_errors()

    def covariance(self, *, total: bool) -> Matrix3:
        """With the encoders' quantisation at both ends, which also keeps it positive definite after no motion."""
        count = COUNT * COUNT / 6.0  # variance of the difference of two roundings to whole counts, one wheel
        moment = np.diag([0.5 * count, 0.5 * count, 2.0 * count / (self.wheels.base * self.wheels.base)])
        if total or self._noise is None:
            moment += self._all.second_moment()
            moment += self._calibration.second_moment()
        else:
            moment += self._noise.second_moment()
        return as_matrix3(moment)


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
        self._base_resets: int | None = None
        self._pose = Pose(0.0, 0.0, 0.0)
        self._travelled = 0.0
        self._whole = _Path(wheels, noise=False)
        self._move = _Path(wheels, noise=True)
        self._last: tuple[float, float, float] | None = None
        self._recent: deque[tuple[float, float, float]] = deque()

    def restart(self) -> None:
        """Begin anew: the robot stands at (0, 0, 0), and has not been driven."""
        self._pose = Pose(0.0, 0.0, 0.0)
        self._travelled = 0.0
        self._whole = _Path(self.wheels, noise=False)
        self.mark()

    @property
    def broken_since_mark(self) -> bool:
        """Whether a reset happened since the mark: then the move lacks an unknown motion, and the leg ends here."""
        return self._move.broken

    def update(
        self, t: float, left: float, right: float, slipping: bool = False, resets: int | None = None
    ) -> OdometryState:
        """Take the wheels' travel at time `t` and return where the robot is.

        Parameters
        ----------
        t : float
            Seconds; not before the last update.
        left, right : float
            Nominal metres rolled by each wheel since any fixed instant, forward positive, as in SensorFrame.
        slipping : bool, optional
            The base reports that wheels and floor disagree: an unknown share of the travel moves nothing.
        resets : int, optional
            How often the base says that its wheel travel was interrupted, as in SensorFrame.
        """
        if self._last is not None:
            last_t, last_left, last_right = self._last
            step_left, step_right, elapsed = left - last_left, right - last_right, t - last_t
            farthest = 0.02 + MAX_WHEEL_SPEED * max(0.0, elapsed)
            interrupted = resets != self._base_resets
            if interrupted or elapsed > MAX_GAP or max(abs(step_left), abs(step_right)) > farthest:
                self.resets += 1
                self._move.broken = True
                self._recent.clear()
            elif step_left or step_right:
                self._roll(step_left * self.wheels.scale_left, step_right * self.wheels.scale_right, slipping)
        self._last = (t, left, right)
        self._base_resets = resets
        speed, turn_rate = self._rates(self._last)
        return OdometryState(t, self._pose, self._travelled, speed, turn_rate)

    def mark(self) -> None:
        """Start a new move here."""
        self._move = _Path(self.wheels, noise=True)

    def move_since_mark(self, *, total: bool = False) -> Move:
        """Motion since the mark (or construction) in the axes of the robot at the mark, with its covariance.

        By default the covariance is the one for a survey: it contains neither errors that last for a whole leg (scales,
        base) nor slips that nobody notices, which the solver treats on its own. With `total` it contains these too;
        the calibration's part is then the same error in every move. Either is positive definite.
        """
        move = self._move
        covariance = move.covariance(total=total)
        return Move(move.at.real, move.at.imag, wrap_angle(move.heading), covariance, move.by_errors())

    def pose_covariance(self) -> Matrix3:
        """Total covariance of the pose (x, y, heading) since construction; what resets hide is not in it."""
        return self._whole.covariance(total=True)

    def _roll(self, left: float, right: float, slipping: bool) -> None:
        self._whole.add(left, right, slipping)
        self._move.add(left, right, slipping)
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
