"""What an operator may say about a Roomba."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..bind import ranged


@dataclass(frozen=True, slots=True)
class RoombaConfig:
    """[drivers.<instance>] of a Roomba."""

    port: str
    baud: Literal[115200, 57600, 19200] = 115200
    checksum: Literal["auto", "inclusive", "exclusive"] = "auto"
    encoders: Literal["auto", "normal", "swapped"] = "auto"
    rearm: Literal["always", "when_clear", "never"] = "when_clear"
    disarm_s: float = ranged(120.0, minimum=1.0, maximum=86400.0)
    speed_step: float = ranged(0.0285, minimum=0.0, maximum=0.1)
    wake_pin: int | None = ranged(None, minimum=0, maximum=53)
    wake_polarity: Literal["low", "high"] = "low"
    dock_s: float = ranged(120.0, minimum=5.0, maximum=3600.0)
    leave_dock: bool = False
    low_charge: float = ranged(0.15, minimum=0.0, maximum=1.0)
    low_voltage: float = ranged(13.0, minimum=0.0, maximum=20.0)
