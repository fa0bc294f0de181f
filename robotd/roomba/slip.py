"""Signs that wheels and floor disagree, and what each of them can see.

* The stasis sensor (packet 58) watches the caster: it alone sees driven wheels that spin on a floor that does not
  move, but only forward, and not while it turns on the spot. Many casters are dirty or were taken out, so it is
  believed only after it has told a drive from a standstill.
* Overcurrent (packet 14) and wheel currents (54, 55) see a wheel that is blocked or pushes against something, not one
  that spins.
* Counts against commands see a wheel that does not turn as told, blocked or pushed; the way is then counted right,
  but something is wrong. They are blind to a wheel that turns as told and slips.
"""

from __future__ import annotations

FORWARD = 0.05  # m/s: a caster turns at that
STASIS_S = 0.5  # the sensor takes that long to notice
SETTLED_S = 0.5  # of an unchanged command until the wheels have followed, at 0.75 m/s^2
GAP_S = 0.1  # between two frames: what happened meanwhile is not known
STRAIN_MA = 1000  # several times what a wheel draws on a flat floor
STRAIN_S = 0.3
OFF_BY, OFF_SHARE, OFF_S = 0.04, 0.3, 0.3  # m/s, of the command, s
LEFT_OVERCURRENT, RIGHT_OVERCURRENT = 16, 8  # bits of packet 14
CASTER_TURNS, CASTER_DISABLED = 1, 2  # bits of packet 58


class SlipDetector:
    """Judges every frame.

    Attributes
    ----------
    trusts_stasis : bool
        Whether the stasis sensor has shown that it works.
    is_stuck : bool
        Both wheels are told to turn and neither does: the robot may not be listening.
    """

    def __init__(self) -> None:
        self._seen_turning = self._seen_resting = False
        self.is_stuck = False
        self._told: tuple[float, float] = (0.0, 0.0)
        self._told_s = 0.0
        self._still_s = self._rest_s = self._strain_s = self._off_s = 0.0

    @property
    def trusts_stasis(self) -> bool:
        return self._seen_turning and self._seen_resting

    def update(
        self,
        elapsed: float,
        told: tuple[float, float],
        speeds: tuple[float, float],
        overcurrent: int,
        currents_ma: tuple[int, int] | None = None,
        stasis: int | None = None,
    ) -> str | None:
        """Take one frame; returns the sign of slipping in words, None if there is none.

        Parameters
        ----------
        elapsed : float
            Seconds since the frame before.
        told, speeds : tuple of float
            Right and left wheel, m/s: as commanded and as counted.
        overcurrent : int
            Packet 14.
        currents_ma : tuple of int, optional
            Right and left wheel, packets 55 and 54.
        stasis : int, optional
            Packet 58.
        """
        if elapsed > GAP_S:
            self._told_s = self._still_s = self._rest_s = self._strain_s = self._off_s = elapsed = 0.0
        if max(abs(told[0] - self._told[0]), abs(told[1] - self._told[1])) > OFF_BY:
            self._told, self._told_s = told, 0.0
        self._told_s += elapsed
        if overcurrent & (LEFT_OVERCURRENT | RIGHT_OVERCURRENT):
            sides = [
                name for bit, name in ((LEFT_OVERCURRENT, "left"), (RIGHT_OVERCURRENT, "right")) if overcurrent & bit
            ]
            return f"the {' and the '.join(sides)} wheel's motor draws too much current"
        strained = currents_ma is not None and max(map(abs, currents_ma)) > STRAIN_MA
        self._strain_s = self._strain_s + elapsed if strained else 0.0
        if self._strain_s >= STRAIN_S:
            return f"a wheel's motor draws more than {STRAIN_MA} mA: it pushes against something"
        return self._wrong_speed(elapsed, told, speeds) or self._stasis(elapsed, speeds, stasis)

    def _wrong_speed(self, elapsed: float, told: tuple[float, float], speeds: tuple[float, float]) -> str | None:
        off = self._told_s >= SETTLED_S and any(
            abs(a - b) > max(OFF_BY, OFF_SHARE * abs(a)) for a, b in zip(told, speeds, strict=True)
        )
        self._off_s = self._off_s + elapsed if off else 0.0
        self.is_stuck = self._off_s >= OFF_S and all(told) and not any(speeds)
        if self._off_s < OFF_S:
            return None
        right, left = (f"{told[wheel]:.2f} m/s told and {speeds[wheel]:.2f} counted" for wheel in range(2))
        return f"the wheels do not turn as told: left {left}, right {right}"

    def _stasis(self, elapsed: float, speeds: tuple[float, float], stasis: int | None) -> str | None:
        if stasis is None or stasis & CASTER_DISABLED:
            self._still_s = 0.0
            return None
        forward = min(speeds) > FORWARD
        self._rest_s = self._rest_s + elapsed if speeds == (0.0, 0.0) else 0.0
        if stasis & CASTER_TURNS:
            self._seen_turning |= forward
            self._still_s = 0.0
            return None
        self._seen_resting |= self._rest_s >= STASIS_S
        self._still_s = self._still_s + elapsed if forward else 0.0
        if self.trusts_stasis and self._still_s >= STASIS_S:
            return "the wheels turn but the caster does not: they slip"
        return None
