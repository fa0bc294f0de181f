"""The simulated Roomba's battery: charge, current and voltage, and the gauge that reports them."""

from __future__ import annotations

CAPACITY_MAH = 2696.0
CHARGING_MA = 1200.0
EMPTY_MAH = 0.0
NOT_CHARGING, FULL_CHARGE, TRICKLE = 0, 2, 3  # packet 21


class Battery:
    """Charge in and out.

    Parameters
    ----------
    gauge_error_mah : float
        By so much the gauge of packet 25 reads too low; below zero it wraps.

    Attributes
    ----------
    charge_mah : float
        What is really left.
    current_ma : float
        Now; negative while discharging.
    is_charging : bool
        Connected to a charger that the robot uses in its present mode.
    """

    temperature_c = 25

    def __init__(self, gauge_error_mah: float = 0.0) -> None:
        self.charge_mah = 0.93 * CAPACITY_MAH
        self.current_ma = 0.0
        self.is_charging = False
        self._gauge_error_mah = gauge_error_mah

    def use(self, seconds: float, load_ma: float, *, is_charging: bool) -> None:
        """Draw `load_ma` for so long, or charge instead."""
        self.is_charging = is_charging
        if is_charging:
            self.current_ma = CHARGING_MA if self.charge_mah < CAPACITY_MAH else 0.0
        else:
            self.current_ma = -load_ma
        self.charge_mah = max(EMPTY_MAH, min(CAPACITY_MAH, self.charge_mah + self.current_ma * seconds / 3600.0))

    @property
    def is_empty(self) -> bool:
        """Too little is left for the processor."""
        return self.charge_mah <= EMPTY_MAH and not self.is_charging

    @property
    def state(self) -> int:
        """Packet 21."""
        if not self.is_charging:
            return NOT_CHARGING
        return FULL_CHARGE if self.charge_mah < CAPACITY_MAH else TRICKLE

    @property
    def voltage_mv(self) -> int:
        """Packet 22."""
        return round(13000.0 + 3500.0 * self.charge_mah / CAPACITY_MAH + 0.3 * self.current_ma)

    @property
    def gauge_mah(self) -> int:
        """Packet 25."""
        return round(self.charge_mah - self._gauge_error_mah) & 0xFFFF
