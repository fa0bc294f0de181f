"""One driven wheel of the simulated Roomba: motor and encoder."""

from __future__ import annotations

from ..oi import COUNT

SPEED_STEP_MM_S = 28.5  # the firmware's quantisation of wheel speeds


class Wheel:
    """One driven wheel: speed quantised and ramped, encoder on a single channel, signed by the command."""

    def __init__(self, counts: int, acceleration: float) -> None:
        self.requested_mm_s = 0
        self.target = 0.0  # m/s
        self.speed = 0.0
        self.counts = counts
        self._acceleration = acceleration
        self._rotation = 0.0
        self._fraction = 0.0

    def command(self, speed_mm_s: float) -> None:
        """Set the speed to reach; the firmware clamps and rounds it."""
        self.requested_mm_s = round(max(-500.0, min(500.0, speed_mm_s)))
        self.target = round(self.requested_mm_s / SPEED_STEP_MM_S) * SPEED_STEP_MM_S / 1000.0

    def ramp(self, seconds: float) -> float:
        """Move the speed towards the target; returns the mean speed meanwhile."""
        before, most = self.speed, self._acceleration * seconds
        self.speed = max(before - most, min(before + most, self.target))
        return 0.5 * (before + self.speed)

    def measure(self, rotation: float) -> None:
        """Count pulses of the wheel having rolled to `rotation` metres."""
        pulses = abs(rotation - self._rotation) / COUNT + self._fraction
        self._rotation = rotation
        whole = int(pulses)
        self._fraction = pulses - whole
        self.counts = (self.counts + (-whole if self.target < 0.0 else whole)) & 0xFFFF
