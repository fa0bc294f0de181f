"""What a mission must not run out of: the robot's battery and room on the disk. Pure: time and figures are arguments.

Both have two bounds, so that a mission does not stop and go at one: below the lower it is short, until above the upper.
An operator may insist on going on; then it is short again only after it has been above the upper bound.
"""

from __future__ import annotations

from .records import SensorFrame

LASTING_S = 5.0  # a motor that starts pulls the voltage down for a moment


class Shortage:
    """One thing that runs out.

    Attributes
    ----------
    cause : str or None
        What is short, in words.
    """

    def __init__(self) -> None:
        self.cause: str | None = None
        self._insisted = False

    def insist(self) -> None:
        """An operator wants to go on in spite of it."""
        if self.cause is not None:
            self.cause, self._insisted = None, True

    def _judge(self, words: str, *, low: bool, enough: bool) -> None:
        if enough:
            self.cause, self._insisted = None, False
        elif (low or self.cause is not None) and not self._insisted:
            self.cause = words


class BatteryGuard(Shortage):
    """The robot's battery.

    Parameters
    ----------
    low_charge, enough_charge : float
        Fractions of the capacity.
    low_voltage, enough_voltage : float
        Volts. The robot's gauge does not count what is wired to the battery directly; the voltage does.
    """

    def __init__(self, low_charge: float, enough_charge: float, low_voltage: float, enough_voltage: float) -> None:
        super().__init__()
        self._charge = low_charge, enough_charge
        self._voltage = low_voltage, enough_voltage
        self._since: float | None = None

    def update(self, frame: SensorFrame) -> None:
        """Take what the base says."""
        known = [
            (value, *bounds)
            for value, bounds in ((frame.charge_fraction, self._charge), (frame.voltage, self._voltage))
            if value is not None
        ]
        if not known:
            return
        low = any(value < least for value, least, _ in known) and not frame.charging
        if not low:
            self._since = None
        elif self._since is None:
            self._since = frame.t
        lasts = self._since is not None and frame.t - self._since >= LASTING_S
        self._judge(self._words(frame), low=lasts, enough=all(value >= enough for value, _, enough in known))

    def _words(self, frame: SensorFrame) -> str:
        level = [f"{100 * frame.charge_fraction:.0f} %"] if frame.charge_fraction is not None else []
        level += [f"{frame.voltage:.1f} V"] if frame.voltage is not None else []
        return (
            f"the battery is low: {', '.join(level)}; charge it to {100 * self._charge[1]:.0f} % and "
            f"{self._voltage[1]:g} V (robotctl dock), or robotctl mission resume"
        )


class DiskGuard(Shortage):
    """Room on the disk that holds the journal.

    Parameters
    ----------
    place : str
        The folder, for words.
    least : float
        Bytes.
    """

    ENOUGH = 1.1

    def __init__(self, place: str, least: float) -> None:
        super().__init__()
        self._place = place
        self._least = least

    def update(self, free: float) -> None:
        """Take how many bytes are free."""
        words = (
            f"the disk is nearly full: {free / 1e6:.0f} MB free in {self._place}, of {self._least / 1e6:.0f} MB to be "
            "kept; delete recordings, or robotctl mission resume"
        )
        self._judge(words, low=free < self._least, enough=free >= self.ENOUGH * self._least)
