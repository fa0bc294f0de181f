"""The gate between every source of motion and the base: it lets a wish through only while nothing speaks against it.

Whatever is wrong, the output is zero at once and says why; only what is right is limited and ramped. A hit bumper, a
cliff, a dropped wheel and an emergency stop stay in force until `release`, even if the sensor has become quiet; the
other causes end with their reason.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .bind import ranged
from .records import DriveCommand, SensorFrame


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


@dataclass(frozen=True, slots=True)
class Motion:
    """What the base may do now: m/s, rad/s; `cause` says in words why it is held at zero, None if it is not."""

    speed: float
    turn_rate: float
    cause: str | None = None


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
    """

    def __init__(self, limits: SafetyLimits) -> None:
        self.limits = limits
        self._frame: SensorFrame | None = None
        self._command: DriveCommand | None = None
        self._stopped: str | None = None
        self._hazards: dict[str, None] = {}  # latched, in the order in which they came
        self._last_t: float | None = None
        self._speed = 0.0
        self._turn_rate = 0.0

    @property
    def latched(self) -> str | None:
        """What holds the robot until `release`, in words."""
        if self._stopped is not None:
            return f"emergency stop: {self._stopped}"
        return " and ".join(self._hazards) or None

    def sensors(self, frame: SensorFrame) -> None:
        """Take what the base reported; a hazard in it is latched, however short it was."""
        self._frame = frame
        self._latch(frame)

    def command(self, command: DriveCommand) -> None:
        """Take a wish to move; it replaces the one before."""
        self._command = command

    def emergency_stop(self, cause: str) -> None:
        """Hold the robot until `release`."""
        self._stopped = cause

    def release(self) -> None:
        """Forget the emergency stop and the latched hazards; those that are still present are latched again.

        A wish from before the release does not count any more: the robot moves only on a new one.
        """
        self._stopped = None
        self._hazards.clear()
        self._command = None
        if self._frame is not None:
            self._latch(self._frame)

    def output(self, t: float) -> Motion:
        """The motion that is safe at `t`; to be asked at least every `loop_s` seconds, in loop time."""
        elapsed = 0.0 if self._last_t is None else max(0.0, t - self._last_t)
        self._last_t = t
        cause = self._cause(t, elapsed)
        if cause is not None or self._command is None:
            self._speed = self._turn_rate = 0.0
            return Motion(0.0, 0.0, cause)
        speed, turn_rate = self._limited(self._command)
        self._speed = _approach(self._speed, speed, self.limits.max_acceleration * elapsed)
        self._turn_rate = _approach(self._turn_rate, turn_rate, self.limits.max_turn_acceleration * elapsed)
        return Motion(self._speed, self._turn_rate)

    def _latch(self, frame: SensorFrame) -> None:
        for name, words in _LATCHING:
            if getattr(frame, name):
                self._hazards[words] = None

    def _cause(self, t: float, elapsed: float) -> str | None:
        """The most serious reason to stand still, or None."""
        limits, frame, command = self.limits, self._frame, self._command
        if self._stopped is not None or self._hazards:
            return self.latched
        if frame is None:
            return "no sensor frame from the base yet"
        if t - frame.t > limits.stale_s:
            return f"no sensor frame from the base for more than {limits.stale_s:g} s"
        if frame.overcurrent:
            return "a wheel or brush motor draws too much current"
        if frame.mode != "safe":
            return f"the base is in {frame.mode} mode, not in safe mode"
        if elapsed > limits.loop_s:
            return f"the control loop was late: {elapsed:.3f} s, at most {limits.loop_s:g} s"
        if command is None:
            return "no drive command"
        if t - command.t > limits.command_s:
            return f"no drive command for more than {limits.command_s:g} s"
        if not (math.isfinite(command.speed) and math.isfinite(command.turn_rate)):
            return f"{command.source} asked for {command.speed} m/s and {command.turn_rate} rad/s"
        return None

    def _limited(self, command: DriveCommand) -> tuple[float, float]:
        """Slow the wish down until both limits hold; the curvature of the path stays as it was."""
        limits, factor = self.limits, 1.0
        if abs(command.speed) > limits.max_speed:
            factor = limits.max_speed / abs(command.speed)
        if abs(command.turn_rate) * factor > limits.max_turn_rate:
            factor = limits.max_turn_rate / abs(command.turn_rate)
        return command.speed * factor, command.turn_rate * factor


def _approach(value: float, target: float, step: float) -> float:
    return max(value - step, min(value + step, target))
