"""From a wish to move to wheel speeds that the robot can do.

The robot rounds each wheel's speed to steps of about 28.5 mm/s, which is 0.12 rad/s of turning. So the travel that
rounding still owes is made up for by now and then taking the next step; a step is changed only when speed and debt
together ask for a whole one, because the motors take some 40 ms to follow.
"""

from __future__ import annotations

MAX_WHEEL_SPEED = 0.30  # m/s
LONGEST_S = 0.2  # after which a command has expired, so that no more travel is owed
DITHER_S = 0.05


def wheel_speeds(speed: float, turn_rate: float, base: float) -> tuple[float, float]:
    """Right and left wheel speed in m/s for `speed` (m/s) and `turn_rate` (rad/s, counter-clockwise).

    `base` is the distance between the wheels in metres. Both are slowed down together where a wheel would exceed
    0.3 m/s, so that the curvature of the path stays.
    """
    half = 0.5 * turn_rate * base
    right, left = speed + half, speed - half
    factor = min(1.0, MAX_WHEEL_SPEED / max(abs(right), abs(left), 1e-9))
    return right * factor, left * factor


class WheelSpeeds:
    """What was asked of the wheels and what was sent to them, right before left as on the wire.

    Parameters
    ----------
    step : float
        Steps in m/s in which the robot sets its wheel speeds; 0: it does not round.

    Attributes
    ----------
    sent : tuple of float
        Last speeds sent, m/s.
    """

    def __init__(self, step: float) -> None:
        self.step = step
        self.sent = (0.0, 0.0)
        self._wanted = (0.0, 0.0)
        self._owed = [0.0, 0.0]  # m
        self._t = 0.0

    def command(self, t: float, right: float, left: float) -> tuple[int, int]:
        """Take the speeds asked for (m/s) at time `t`; returns those to be sent, in mm/s."""
        if not (right or left):
            self.sent, self._owed = (0.0, 0.0), [0.0, 0.0]
        elif self.step > 0.0:
            elapsed = min(t - self._t, LONGEST_S)
            for wheel in range(2):
                self._owed[wheel] += (self._wanted[wheel] - self.sent[wheel]) * elapsed
            self.sent = self._quantised(0, right), self._quantised(1, left)
        else:
            self.sent = right, left
        self._wanted, self._t = (right, left), t
        return round(1000.0 * self.sent[0]), round(1000.0 * self.sent[1])

    def _quantised(self, wheel: int, wanted: float) -> float:
        step, sent = self.step, self.sent[wheel]
        most = step * DITHER_S
        self._owed[wheel] = max(-most, min(most, self._owed[wheel]))
        due = wanted + self._owed[wheel] / DITHER_S
        if abs(due - sent) < step:
            return sent
        limit = int(MAX_WHEEL_SPEED / step)
        return max(-limit, min(limit, round(due / step))) * step
