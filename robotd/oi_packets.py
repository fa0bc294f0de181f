"""The sensor packets of iRobot's Open Interface: their ids, sizes and groups, and the answers to queries.

Create 2 Open Interface 2016, section "Roomba Open Interface Sensors Packets". Values are the wire's own integers; their
units are in the names.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Packet:
    """One sensor packet; `code` is the struct code of its value (B, b, H, h)."""

    id: int
    name: str
    code: str

    @property
    def size(self) -> int:
        """Bytes on the wire."""
        return struct.calcsize(self.code)


_PACKETS = (
    (7, "bumps_wheel_drops", "B"),
    (8, "wall", "B"),
    (9, "cliff_left", "B"),
    (10, "cliff_front_left", "B"),
    (11, "cliff_front_right", "B"),
    (12, "cliff_right", "B"),
    (13, "virtual_wall", "B"),
    (14, "overcurrent", "B"),
    (15, "dirt", "B"),
    (16, "unused_16", "B"),
    (17, "ir_omni", "B"),
    (18, "buttons", "B"),
    (19, "distance_mm", "h"),
    (20, "angle_deg", "h"),
    (21, "charging_state", "B"),
    (22, "voltage_mv", "H"),
    (23, "current_ma", "h"),
    (24, "temperature_c", "b"),
    (25, "charge_mah", "H"),
    (26, "capacity_mah", "H"),
    (27, "wall_signal", "H"),
    (28, "cliff_left_signal", "H"),
    (29, "cliff_front_left_signal", "H"),
    (30, "cliff_front_right_signal", "H"),
    (31, "cliff_right_signal", "H"),
    (32, "unused_32", "B"),
    (33, "unused_33", "H"),
    (34, "charging_sources", "B"),
    (35, "mode", "B"),
    (36, "song_number", "B"),
    (37, "song_playing", "B"),
    (38, "stream_packets", "B"),
    (39, "requested_velocity_mm_s", "h"),
    (40, "requested_radius_mm", "h"),
    (41, "requested_right_mm_s", "h"),
    (42, "requested_left_mm_s", "h"),
    (43, "left_encoder", "H"),  # signed in one manual, unsigned in the other: a count modulo 65536
    (44, "right_encoder", "H"),
    (45, "light_bumper", "B"),
    (46, "light_left_signal", "H"),
    (47, "light_front_left_signal", "H"),
    (48, "light_centre_left_signal", "H"),
    (49, "light_centre_right_signal", "H"),
    (50, "light_front_right_signal", "H"),
    (51, "light_right_signal", "H"),
    (52, "ir_left", "B"),
    (53, "ir_right", "B"),
    (54, "left_wheel_ma", "h"),
    (55, "right_wheel_ma", "h"),
    (56, "main_brush_ma", "h"),
    (57, "side_brush_ma", "h"),
    (58, "stasis", "B"),
)
PACKETS = {number: Packet(number, name, code) for number, name, code in _PACKETS}


def _span(first: int, last: int) -> tuple[int, ...]:
    return tuple(range(first, last + 1))


GROUPS: dict[int, tuple[int, ...]] = {
    0: _span(7, 26),
    1: _span(7, 16),
    2: _span(17, 20),
    3: _span(21, 26),
    4: _span(27, 34),
    5: _span(35, 42),
    6: _span(7, 42),
    100: _span(7, 58),
    101: _span(43, 58),
    106: _span(46, 51),
    107: _span(54, 58),
}


def members(packet_id: int) -> tuple[int, ...]:
    """The packets that an id stands for: itself, or those of a group. Raises ValueError for an unknown id."""
    if packet_id in PACKETS:
        return (packet_id,)
    if packet_id in GROUPS:
        return GROUPS[packet_id]
    raise ValueError(f"sensor packet {packet_id} does not exist; expected 7 to 58 or a group {sorted(GROUPS)}")


def packet_struct(packet_ids: Sequence[int]) -> struct.Struct:
    """The values of packets and groups, in order, as they stand on the wire."""
    return struct.Struct(">" + "".join(PACKETS[member].code for number in packet_ids for member in members(number)))


def encode_values(packet_ids: Sequence[int], values: Mapping[int, int]) -> bytes:
    """The robot's answer to a query (opcodes 142, 149): the data bytes alone, without ids and checksum."""
    flat = [values[member] for number in packet_ids for member in members(number)]
    return packet_struct(packet_ids).pack(*flat)


def decode_values(packet_ids: Sequence[int], data: bytes) -> dict[int, int]:
    """Values by packet id from a query's answer; raises ValueError if its length is not what was asked for."""
    layout = packet_struct(packet_ids)
    if len(data) != layout.size:
        raise ValueError(f"got {len(data)} bytes for the packets {list(packet_ids)}; expected {layout.size}")
    keys = [member for number in packet_ids for member in members(number)]
    return dict(zip(keys, layout.unpack(data), strict=True))
