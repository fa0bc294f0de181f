"""When to tell the operator about the battery: once, in words, before it is empty."""

from __future__ import annotations

from collections.abc import Mapping

LASTING_S = 5.0  # a motor that starts pulls the voltage down for a moment


def charge_fraction(values: Mapping[int, int]) -> float | None:
    """Packet 25 over packet 26, 0..1; None if they are not streamed.

    The charge has been seen to run below zero and wrap.
    """
    capacity = values.get(26, 0)
    if not capacity:
        return None
    charge = values[25] if values[25] < 0x8000 else 0
    return min(1.0, charge / capacity)


class BatteryWatch:
    """Warns once when charge or voltage are low; a charge begins anew.

    Parameters
    ----------
    low_charge : float
        Fraction of the capacity, 0..1.
    low_voltage : float
        Volts. The robot's own gauge does not count what is wired to the battery directly; the voltage does.
    """

    def __init__(self, low_charge: float, low_voltage: float) -> None:
        self.low_charge = low_charge
        self.low_voltage = low_voltage
        self._since: float | None = None
        self._told = False

    def update(self, t: float, voltage: float | None, fraction: float | None, *, charging: bool) -> str | None:
        """Take what a frame says at time `t`; returns the warning when it is due."""
        if charging:
            self._since, self._told = None, False
            return None
        low = (fraction is not None and fraction < self.low_charge) or (
            voltage is not None and voltage < self.low_voltage
        )
        if not low or self._told:
            self._since = None
            return None
        if self._since is None:
            self._since = t
        if t - self._since < LASTING_S:
            return None
        self._told = True
        charge = f"{100 * fraction:.0f} % charge" if fraction is not None else "charge unknown"
        level = f"{voltage:.1f} V" if voltage is not None else "voltage unknown"
        return f"the robot's battery is low: {charge}, {level}; send it to its dock soon"
