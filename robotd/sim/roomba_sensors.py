"""How the simulated robot's sensor packets get their values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from .. import oi
from .battery import CAPACITY_MAH

if TYPE_CHECKING:
    from .roomba import SimRoomba
    from .roomba_body import RoombaBody

WHEEL_BASE = 0.235  # m, as the firmware believes
FLOOR, VOID = 2800, 10  # cliff signals
WRONG_DISTANCE = -1.0 / 7.75  # counts per mm before firmware 3.3.0
WRONG_ANGLE = 0.324056  # counts per degree up to firmware 3.4.0
AFTER_CLIFF = 32
MOTOR_MA = 900.0  # per m/s
BRUSH_MA, SIDE_BRUSH_MA, VACUUM_MA = 400.0, 120.0, 800.0


class Trip:
    """A weighted sum of the wheels' travel since it was last asked for, cut to whole units: packets 19 and 20."""

    def __init__(self, body: RoombaBody, per_left_metre: float, per_right_metre: float) -> None:
        self._body = body
        self._weights = per_left_metre, per_right_metre
        self._told = (body.left_rotation, body.right_rotation)

    def read(self) -> int:
        """The sum, which starts again from zero; what is less than a unit is lost."""
        rolled = self._body.left_rotation, self._body.right_rotation
        value = sum(weight * (new - old) for weight, new, old in zip(self._weights, rolled, self._told, strict=True))
        self._told = rolled
        return max(-0x8000, min(0x7FFF, int(value)))


def cleaning_ma(robot: SimRoomba) -> float:
    """Current of brushes and vacuum together."""
    return sum(abs(duty) * full for duty, full in zip(robot.cleaning_motors, _CLEANING_MA, strict=True))


_CLEANING_MA = (BRUSH_MA, SIDE_BRUSH_MA, VACUUM_MA)


def packet_sources(robot: SimRoomba) -> dict[int, Callable[[], int]]:
    """How every packet gets its value; those without a source in this world read zero."""
    body, left, right, quirks, battery = robot.body, robot.left, robot.right, robot.quirks, robot.battery
    per_metre = 1000.0 * (WRONG_DISTANCE if quirks.distance_wrong else 1.0)
    per_radian = 180.0 / math.pi * (WRONG_ANGLE if quirks.angle_wrong else 1.0)
    distance = Trip(body, 0.5 * per_metre, 0.5 * per_metre)
    angle = Trip(body, -per_radian / WHEEL_BASE, per_radian / WHEEL_BASE)
    first, second = (right, left) if quirks.encoders_swapped else (left, right)

    def mode() -> int:
        return AFTER_CLIFF if quirks.mode_32_after_cliff and robot.is_after_cliff else robot.mode + quirks.mode_offset

    def side_cliff() -> int:
        return int(robot.is_docked and quirks.cliffs_on_dock)

    def front_cliff() -> int:
        return int(robot.sees_cliff)

    def front_signal() -> int:
        return VOID if body.cliff else FLOOR

    def beams() -> int:
        return robot.dock.beams() if robot.dock is not None else 0

    return dict.fromkeys(oi.PACKETS, lambda: 0) | {
        7: lambda: body.bump_right | body.bump_left << 1 | body.wheel_drop_right << 2 | body.wheel_drop_left << 3,
        9: side_cliff,
        10: front_cliff,
        11: front_cliff,
        12: side_cliff,
        14: lambda: robot.overcurrent,
        17: beams,
        18: robot.pressed_buttons,
        19: distance.read,
        20: angle.read,
        21: lambda: battery.state,
        22: lambda: battery.voltage_mv,
        23: lambda: round(battery.current_ma),
        24: lambda: battery.temperature_c,
        25: lambda: battery.gauge_mah,
        26: lambda: round(CAPACITY_MAH),
        28: lambda: FLOOR,
        29: front_signal,
        30: front_signal,
        31: lambda: FLOOR,
        34: lambda: robot.is_plugged | robot.is_docked << 1,
        35: mode,
        36: lambda: robot.song,
        37: lambda: int(robot.is_playing),
        38: lambda: robot.replies.stream_packets,
        39: lambda: round(0.5 * (left.requested_mm_s + right.requested_mm_s)),
        40: lambda: 0 if quirks.distance_wrong else robot.radius_mm,
        41: lambda: right.requested_mm_s,
        42: lambda: left.requested_mm_s,
        43: lambda: first.counts,
        44: lambda: second.counts,
        52: beams,
        53: beams,
        54: lambda: round(MOTOR_MA * abs(left.speed)),
        55: lambda: round(MOTOR_MA * abs(right.speed)),
        56: lambda: round(BRUSH_MA * robot.cleaning_motors[0]),
        57: lambda: round(SIDE_BRUSH_MA * robot.cleaning_motors[1]),
        58: lambda: int(left.speed + right.speed > 0.0),
    }
