"""The gate between every source of motion and the base: it lets a wish through only while nothing speaks against it.

Whatever is wrong, the output is zero at once and says why; only what is right is limited and ramped. There are four
kinds of reasons, by how they end:

* latched: a hit bumper, a cliff, a dropped wheel, repeated overcurrent, an emergency stop. They stay, even if the
  sensor has become quiet, until `release`; all but the emergency stop also until `resume`.
* an operator's stop: nobody's wish counts until the operator asks for motion anew (having let go of the stick), or
  `resume`.
* a doubt about the robot: no sensor frame, a stamp from the future, overcurrent, a late control loop. It ends by
  itself, a late loop and overcurrent some time after the last sign of it; wishes from before that do not count.
* a doubt about the wish: none, withdrawn, expired, not a number, line lost, base not in safe mode. It ends with the
  next wish that is right.

Among several sources the latest wish wins, but an operator's, as long as it is fresh, beats all others.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from .bind import ranged
from .records import OPERATOR, DriveCommand, SensorFrame

WHEEL_SPEED = 0.30  # m/s, what no wheel may exceed
FUTURE_S = 0.020  # by which a stamp may be ahead: stamps are estimates
OVERCURRENT_S = 0.5  # without overcurrent before the wheels turn again
OVERCURRENTS, OVERCURRENTS_S = 3, 10.0  # so many in so long latch, because the wheels will not get free by themselves


@dataclass(frozen=True, slots=True)
class SafetyLimits:
    """[safety]: metres, seconds and radians."""

    max_speed: float = ranged(0.30, minimum=0.0, maximum=0.30)
    max_turn_rate: float = ranged(1.5, minimum=0.0, maximum=3.0)
    max_acceleration: float = ranged(0.5, minimum=0.05, maximum=2.0)
    max_turn_acceleration: float = ranged(6.0, minimum=0.1, maximum=20.0)
    stale_s: float = ranged(0.150, minimum=0.05, maximum=0.150)
    command_s: float = ranged(0.200, minimum=0.05, maximum=0.200)
    loop_s: float = ranged(0.100, minimum=0.02, maximum=0.200)
    line_m: float = ranged(0.30, minimum=0.05, maximum=0.30)


@dataclass(frozen=True, slots=True)
class Motion:
    """What the base may do now: m/s, rad/s; `cause` says in words why it is held at zero, None if it is not.

    `arm` says that somebody wants to move and that nothing but the base's mode may speak against it.
    """

    speed: float
    turn_rate: float
    cause: str | None = None
    arm: bool = False


_LATCHING = (
    ("bump_left", "the left bumper is pressed"),
    ("bump_right", "the right bumper is pressed"),
    ("cliff", "a cliff sensor sees no floor"),
    ("wheel_drop_left", "the left wheel has dropped"),
    ("wheel_drop_right", "the right wheel has dropped"),
)


class SafetyGate:
    """Turns wishes to move into motion that is safe now.

    Parameters
    ----------
    limits : SafetyLimits
    wheel_base : float
        Metres between the wheels: decides how much turning the wheels' top speed leaves.
    blind : float
        Metres from the robot's origin to the nearest floor that the follower's camera sees: so far the robot drives on
        floor that was seen before, and only what comes after it counts as driving without seeing the line.
    """

    def __init__(self, limits: SafetyLimits, wheel_base: float = 0.235, blind: float = 0.0) -> None:
        self.limits = limits
        self._half_base = 0.5 * wheel_base
        self._frame: SensorFrame | None = None
        self._wish: DriveCommand | None = None
        self._emergency: str | None = None
        self._hazards: dict[str, None] = {}  # latched, in the order in which they came
        self._stopped: str | None = None  # by the operator
        self._let_go = False  # whether the operator has asked for no motion since
        self._operator_t = -math.inf
        self._withdrawn: dict[str | None, float] = {}  # until when a source's, or everybody's, wishes do not count
        self._withdrawal: str | None = None  # why there is no wish
        self._doubts: dict[str, tuple[float, str]] = {}  # kind: (end, words)
        self._overcurrent = False
        self._overcurrents: deque[float] = deque(maxlen=OVERCURRENTS)
        self._line = _LineWatch(limits.line_m + blind)
        self._last_t: float | None = None
        self._speed = 0.0
        self._turn_rate = 0.0

    @property
    def latched(self) -> str | None:
        """What holds the robot until `release` or `resume`, in words."""
        emergency = [] if self._emergency is None else [f"emergency stop: {self._emergency}"]
        stopped = [] if self._stopped is None else [self._stopped]
        return " and ".join([*emergency, *self._hazards, *stopped]) or None

    def sensors(self, frame: SensorFrame) -> None:
        """Take what the base reported; a hazard in it is latched, however short it was."""
        self._line.roll(frame)
        self._frame = frame
        self._overcurrent |= frame.overcurrent
        self._latch(frame)

    def command(self, command: DriveCommand) -> None:
        """Take a wish to move; it replaces the one before, unless that is an operator's and still fresh."""
        moves, withdrawn = _moves(command), self._withdrawn
        lets_go = False
        if command.source == OPERATOR:
            lets_go = not moves or command.t - self._operator_t > self.limits.command_s
            self._operator_t = command.t
        if command.t <= max(withdrawn.get(command.source, -math.inf), withdrawn.get(None, -math.inf)):
            return
        self._let_go |= lets_go
        if self._stopped is not None:
            may_end = command.source == OPERATOR and moves and _is_finite(command)
            if not (may_end and self._let_go):
                return
            self._stopped = None
        if self._is_outranked(command):
            return
        if moves:
            self._withdrawal = None
        elif self._withdrawal is not None:
            return
        self._wish = command
        if command.line_t is not None:
            self._line.see(command.line_t)

    def withdraw(self, source: str | None, cause: str, t: float) -> None:
        """Take back the wishes that a source made up to `t`; its next wish to move counts again.

        With `source` None it is an operator's stop: nobody's wishes count until the operator asks for motion anew
        (a held stick has to be let go first), or until `resume`.
        """
        self._withdrawn[source] = t
        if source is None:
            self._stopped, self._let_go = cause, False
            self._wish = None
        elif self._wish is not None and self._wish.source == source:
            self._wish, self._withdrawal = None, cause

    def emergency_stop(self, cause: str) -> None:
        """Hold the robot until `release`; the cause of the first of several is kept."""
        self._emergency = self._emergency or cause

    def release(self) -> None:
        """Forget the emergency stop, and `resume`."""
        self._emergency = None
        self.resume()

    def resume(self) -> None:
        """Forget an operator's stop and the latched hazards; those that are still present are latched again.

        A wish from before does not count any more: the robot moves only on a new one.
        """
        self._stopped = None
        self._hazards.clear()
        self._overcurrents.clear()
        self._wish = self._withdrawal = None
        if self._frame is not None:
            self._latch(self._frame)

    def output(self, t: float) -> Motion:
        """The motion that is safe at `t`; to be asked at least every `loop_s` seconds, in loop time."""
        elapsed = 0.0 if self._last_t is None else t - self._last_t
        self._last_t = t
        cause, arm = self._held(t, elapsed), False
        if cause is not None:
            self._wish = None
        else:
            cause = self._refused(t)
        wish = self._wish
        if cause is None and wish is not None:
            arm = _moves(wish)
            mode = self._frame.mode if self._frame is not None else "unknown"
            if mode != "safe" and (arm or self._speed or self._turn_rate):
                cause = f"the base is in {mode} mode, not in safe mode"
        if cause is not None or wish is None:
            self._speed = self._turn_rate = 0.0
        else:
            self._ramp(wish, elapsed)
        return Motion(self._speed, self._turn_rate, cause, arm)

    def _is_outranked(self, command: DriveCommand) -> bool:
        wish = self._wish
        if wish is None or wish.source != OPERATOR or command.source == OPERATOR:
            return False
        return 0.0 <= command.t - wish.t <= self.limits.command_s

    def _latch(self, frame: SensorFrame) -> None:
        for name, words in _LATCHING:
            if getattr(frame, name):
                self._hazards[words] = None

    # ---- reasons to stand still --------------------------------------------------------------------------------------

    def _held(self, t: float, elapsed: float) -> str | None:
        """The most serious reason to stand still that is not about the wish, or None."""
        self._note_doubts(t, elapsed)
        limits, frame = self.limits, self._frame
        if (latched := self.latched) is not None:
            return latched
        if (doubt := next((words for end, words in self._doubts.values() if t < end), None)) is not None:
            return doubt  # before the age of the sensor frame, because a late loop makes that old too
        if frame is None:
            return "no sensor frame from the base yet"
        age = t - frame.t
        if age < -FUTURE_S:
            return f"the base's sensor frame is stamped {-age:.3f} s in the future"
        if not age <= limits.stale_s:
            return f"no sensor frame from the base for more than {limits.stale_s:g} s"
        return None

    def _note_doubts(self, t: float, elapsed: float) -> None:
        """Remember signs of overcurrent and of a late loop for as long as they forbid to move."""
        limits, doubts = self.limits, self._doubts
        if elapsed < 0.0:
            doubts["loop"] = t + limits.loop_s, f"the clock went back by {-elapsed:.3f} s"
        elif elapsed > limits.loop_s:
            words = f"the control loop was late: {elapsed:.3f} s, at most {limits.loop_s:g} s"
            doubts["loop"] = t + limits.loop_s, words
        if self._overcurrent:
            self._overcurrent = self._frame is not None and self._frame.overcurrent
            if t >= doubts.get("current", (-math.inf, ""))[0]:
                self._count_overcurrent(t)
            doubts["current"] = t + OVERCURRENT_S, "a wheel or brush motor draws too much current"

    def _count_overcurrent(self, t: float) -> None:
        times = self._overcurrents
        times.append(t)
        if len(times) == OVERCURRENTS and t - times[0] <= OVERCURRENTS_S:
            self._hazards[f"a motor drew too much current {OVERCURRENTS} times within {OVERCURRENTS_S:g} s"] = None

    def _refused(self, t: float) -> str | None:
        """What is wrong with the wish, or None."""
        limits, wish = self.limits, self._wish
        if wish is None:
            return self._withdrawal or "no drive command"
        age = t - wish.t
        if age < -FUTURE_S:
            return f"the drive command of {wish.source} is stamped {-age:.3f} s in the future"
        if not age <= limits.command_s:
            return f"no drive command for more than {limits.command_s:g} s"
        if not _is_finite(wish):
            return f"{wish.source} asked for {wish.speed} m/s and {wish.turn_rate} rad/s"
        if wish.line_t is not None and wish.speed != 0.0 and self._line.is_lost:  # it may turn on the spot to search
            return f"line lost: {wish.source} has not seen it for {self._line.reach:.2f} m"
        return None

    # ---- limits ------------------------------------------------------------------------------------------------------

    def _ramp(self, wish: DriveCommand, elapsed: float) -> None:
        """Move towards the wish as fast as the limits allow.

        While the speed has still to rise the turn rate waits for it, so that a start follows the curve that is asked.
        """
        limits = self.limits
        speed, turn_rate = self._limited(wish.speed, wish.turn_rate)
        ramped = _approach(self._speed, speed, limits.max_acceleration * elapsed)
        if abs(ramped) < abs(speed) and ramped * speed >= 0.0:
            turn_rate *= ramped / speed
        turned = _approach(self._turn_rate, turn_rate, limits.max_turn_acceleration * elapsed)
        # again, because the ways of the two ramps are not straight; a slower motion is always safe
        self._speed, self._turn_rate = self._limited(ramped, turned)

    def _limited(self, speed: float, turn_rate: float) -> tuple[float, float]:
        """Slow a motion down until all limits hold; the curvature of the path stays as it was."""
        limits = self.limits
        factor = min(
            1.0,
            _share(limits.max_speed, abs(speed)),
            _share(limits.max_turn_rate, abs(turn_rate)),
            _share(WHEEL_SPEED, abs(speed) + self._half_base * abs(turn_rate)),
        )
        return speed * factor, turn_rate * factor


class _LineWatch:
    """How far the wheels have rolled since the line was last seen."""

    def __init__(self, reach: float) -> None:
        self.reach = reach  # m
        self._travelled = 0.0
        self._way: deque[tuple[float, float]] = deque()  # (time, metres travelled) after each step, over the reach
        self._rolled: tuple[float, float] | None = None
        self._seen_t: float | None = None
        self._seen = -math.inf  # metres travelled when the line was seen

    @property
    def is_lost(self) -> bool:
        return not self._travelled - self._seen <= self.reach

    def roll(self, frame: SensorFrame) -> None:
        """Take the wheels' travel; a jump of it counts as driven, because nobody knows better."""
        left, right = self._rolled or (frame.left, frame.right)
        step = 0.5 * abs(frame.left - left + frame.right - right)
        self._rolled = frame.left, frame.right
        if step or not self._way:
            self._travelled += step
            self._way.append((frame.t, self._travelled))
            while len(self._way) > 1 and self._way[1][1] < self._travelled - self.reach:
                self._way.popleft()

    def see(self, line_t: float) -> None:
        """The line was seen at `line_t`; farther back than the reach, it was as good as never."""
        if line_t != self._seen_t:
            self._seen_t = line_t
            self._seen = next((way for t, way in reversed(self._way) if t <= line_t), -math.inf)


def _moves(command: DriveCommand) -> bool:
    return command.speed != 0.0 or command.turn_rate != 0.0


def _is_finite(command: DriveCommand) -> bool:
    return math.isfinite(command.speed) and math.isfinite(command.turn_rate)


def _share(limit: float, value: float) -> float:
    return limit / value if value > limit else 1.0


def _approach(value: float, target: float, step: float) -> float:
    return max(value - step, min(value + step, target))
