"""iRobot's Open Interface, both directions, without I/O: Roomba 500/600 and Create 2.

Commands go to the robot as an opcode followed by big-endian arguments; nothing marks their end, so a parser that
misses bytes swallows the next command. Sensor values come back in stream frames, one every 15 ms:

    19 | N | id data | id data | ... | checksum        N counts the bytes between N and the checksum

There is no integrity check below that checksum, and the checksum alone does not find the frames: while the robot
stands still consecutive frames are equal, and then every window of a frame's length has the right sum. A frame is
therefore accepted only if its length, the order of its ids and its checksum are all right, and the search goes on
from the byte after a rejected header, because the header may have been a data byte.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

HEADER = 19
TICK = 0.015  # s between two updates of the robot's sensor values
COUNT = 0.000444565  # m of wheel travel per encoder count (packets 43, 44): pi * 72.0 mm / 508.8
WHEEL_SPEED_MAX = 0.5  # m/s
OFF, PASSIVE, SAFE, FULL = range(4)
BAUD_CODES = (300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200)  # index = code of opcode 129
STRAIGHT, STRAIGHT_TOO, SPIN_CLOCKWISE, SPIN_COUNTER_CLOCKWISE = -0x8000, 0x7FFF, -1, 1  # radius codes of opcode 137

Checksum = Literal["inclusive", "exclusive", "auto"]


# ---- sensor packets --------------------------------------------------------------------------------------------------


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


def _struct(packet_ids: Sequence[int]) -> struct.Struct:
    return struct.Struct(">" + "".join(PACKETS[member].code for number in packet_ids for member in members(number)))


def encode_values(packet_ids: Sequence[int], values: Mapping[int, int]) -> bytes:
    """The robot's answer to a query (opcodes 142, 149): the data bytes alone, without ids and checksum."""
    flat = [values[member] for number in packet_ids for member in members(number)]
    return _struct(packet_ids).pack(*flat)


def decode_values(packet_ids: Sequence[int], data: bytes) -> dict[int, int]:
    """Values by packet id from a query's answer; raises ValueError if its length is not what was asked for."""
    layout = _struct(packet_ids)
    if len(data) != layout.size:
        raise ValueError(f"got {len(data)} bytes for the packets {list(packet_ids)}; expected {layout.size}")
    keys = [member for number in packet_ids for member in members(number)]
    return dict(zip(keys, layout.unpack(data), strict=True))


# ---- stream frames ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SensorValues:
    """One accepted stream frame: raw values by packet id; `end` counts the bytes fed up to and with its last one."""

    values: Mapping[int, int]
    end: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes that belong to no frame or command; `reason` is "noise", "length", "order", "checksum" or "opcode"."""

    data: bytes
    reason: str


@dataclass(slots=True)
class StreamCounters:
    """What a decoder saw: good frames, rejected headers by reason, bytes outside accepted frames."""

    frames: int = 0
    bad_length: int = 0
    bad_order: int = 0
    bad_checksum: int = 0
    skipped_bytes: int = 0


class StreamLayout:
    """The fixed shape of a stream's frames: which packets, in which order.

    Parameters
    ----------
    packet_ids : sequence of int
        Ids as in opcode 148; groups are allowed.
    """

    def __init__(self, packet_ids: Sequence[int]) -> None:
        self.packet_ids = tuple(packet_ids)
        self.keys = tuple(member for number in packet_ids for member in members(number))
        sizes = [_struct([number]).size for number in packet_ids]
        self.length = sum(sizes) + len(sizes)  # N
        self.frame_size = self.length + 3
        if not 0 < self.length < 256:
            raise ValueError(f"a frame of {len(sizes)} packets would hold {self.length} bytes; expected 1 to 255")
        self._ids = struct.Struct(">" + "".join(f"B{size}x" for size in sizes))
        self._values = struct.Struct(">" + "".join("x" + _struct([n]).format.lstrip(">") for n in packet_ids))
        self._pieces = [(bytes([number]), _struct([number]), len(members(number))) for number in packet_ids]

    def encode(self, values: Sequence[int], checksum: Checksum = "inclusive") -> bytes:
        """One frame from the values in the order of `keys`."""
        parts = [bytes((HEADER, self.length))]
        start = 0
        for number, layout, count in self._pieces:
            parts.append(number)
            parts.append(layout.pack(*values[start : start + count]))
            start += count
        body = b"".join(parts)
        total = sum(body) - (HEADER if checksum == "exclusive" else 0)
        return body + bytes((-total & 0xFF,))

    def has_ids(self, payload: bytes) -> bool:
        """Whether the ids stand in a payload (the bytes between N and the checksum) where they should."""
        return self._ids.unpack(payload) == self.packet_ids

    def decode(self, payload: bytes) -> dict[int, int]:
        """Values by packet id."""
        return dict(zip(self.keys, self._values.unpack(payload), strict=True))


def encode_stream_frame(
    packet_ids: Sequence[int], values: Mapping[int, int], checksum: Checksum = "inclusive"
) -> bytes:
    """One frame as the robot sends it; "auto" means inclusive."""
    layout = StreamLayout(packet_ids)
    return layout.encode([values[key] for key in layout.keys], checksum)


class StreamDecoder:
    """Finds the frames of one known stream among any bytes.

    Parameters
    ----------
    packet_ids : sequence of int
        As requested with opcode 148.
    checksum : "inclusive", "exclusive" or "auto"
        Whether the header is part of the sum (Roomba 600, Create 2) or not (as the 500's manual says). "auto" takes
        both until ten good frames in a row agreed, then only that kind.

    Attributes
    ----------
    counters : StreamCounters
    fed : int
        Bytes fed so far.
    checksum : as above
        The kind that "auto" has settled on, once it has.
    """

    LOCK_AFTER = 10  # frames
    RUN = 64  # bytes: longer stretches between frames are reported in pieces, so that text cannot fill the buffer

    def __init__(self, packet_ids: Sequence[int], checksum: Checksum = "inclusive") -> None:
        self.layout = StreamLayout(packet_ids)
        self.checksum: Checksum = checksum
        self.counters = StreamCounters()
        self.fed = 0
        self._buffer = bytearray()
        self._run = bytearray()
        self._reason = "noise"
        self._agreed: tuple[Checksum, int] = (checksum, 0)

    @property
    def pending(self) -> bytes:
        """Bytes fed but not yet reported: skipped ones of a run that goes on, and the start of a frame."""
        return bytes(self._run + self._buffer)

    def feed(self, data: bytes) -> list[SensorValues | Skipped]:
        """Take received bytes; returns what they completed, the same events however the bytes are cut."""
        events: list[SensorValues | Skipped] = []
        self.fed += len(data)
        buffer = self._buffer
        buffer += data
        size, length = self.layout.frame_size, self.layout.length
        start, end = 0, len(buffer)
        while start < end:
            header = buffer.find(HEADER, start)
            if header != start:
                stop = header if header >= 0 else end
                self._skip(bytes(buffer[start:stop]), events)
                start = stop
                continue
            if end - start < 2:
                break
            reason: str | None = "length"
            if buffer[start + 1] == length:
                if end - start < size:
                    break
                frame = bytes(buffer[start : start + size])
                reason = self._fault(frame)
                if reason is None:
                    self._end_run(events)
                    start += size
                    self.counters.frames += 1
                    events.append(SensorValues(self.layout.decode(frame[2:-1]), self.fed - end + start))
                    continue
            self._reject(reason or "", events)
            start += 1
        del buffer[:start]
        return events

    def _fault(self, frame: bytes) -> str | None:
        if not self.layout.has_ids(frame[2:-1]):
            self.counters.bad_order += 1
            return "order"
        total = sum(frame) & 0xFF
        kind: Checksum = "exclusive" if total == HEADER else "inclusive"
        if total not in (0, HEADER) or self.checksum not in (kind, "auto"):
            self.counters.bad_checksum += 1
            self._agreed = (kind, 0)
            return "checksum"
        if self.checksum == "auto":
            self._agreed = (kind, self._agreed[1] + 1 if self._agreed[0] == kind else 1)
            if self._agreed[1] >= self.LOCK_AFTER:
                self.checksum = kind
        return None

    def _reject(self, reason: str, events: list[SensorValues | Skipped]) -> None:
        if reason == "length":
            self.counters.bad_length += 1
        self._end_run(events)
        self._reason = reason
        self._skip(bytes((HEADER,)), events)

    def _skip(self, data: bytes, events: list[SensorValues | Skipped]) -> None:
        self.counters.skipped_bytes += len(data)
        self._run += data
        while len(self._run) >= self.RUN:
            events.append(Skipped(bytes(self._run[: self.RUN]), self._reason))
            del self._run[: self.RUN]
            self._reason = "noise"

    def _end_run(self, events: list[SensorValues | Skipped]) -> None:
        if self._run:
            events.append(Skipped(bytes(self._run), self._reason))
            self._run.clear()
        self._reason = "noise"


# ---- commands --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument of a command: struct code, allowed range, and values allowed besides."""

    code: str
    low: int
    high: int
    besides: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class CommandSpec:
    """An opcode; `counted` commands start with a count of what follows (`song`: after the song's number)."""

    opcode: int
    name: str
    arguments: tuple[Argument, ...] = ()
    counted: bool = False

    @property
    def code(self) -> str:
        """Struct format of the fixed arguments."""
        return ">" + "".join(argument.code for argument in self.arguments)


_BYTE = Argument("B", 0, 255)
_SPEED = Argument("h", -500, 500)  # mm/s
_PWM = Argument("h", -255, 255)
_PACKET = Argument("B", 0, 107)
_CHARACTER = Argument("B", 32, 126)
_RADIUS = Argument("h", -2000, 2000, (STRAIGHT, STRAIGHT_TOO))  # mm
_DAY, _HOUR, _MINUTE = Argument("B", 0, 6), Argument("B", 0, 23), Argument("B", 0, 59)

COMMANDS: dict[int, CommandSpec] = {
    spec.opcode: spec
    for spec in (
        CommandSpec(7, "reset"),
        CommandSpec(128, "start"),
        CommandSpec(129, "baud", (Argument("B", 0, 11),)),
        CommandSpec(130, "control"),  # the old name of safe
        CommandSpec(131, "safe"),
        CommandSpec(132, "full"),
        CommandSpec(133, "power"),
        CommandSpec(134, "spot"),
        CommandSpec(135, "clean"),
        CommandSpec(136, "max"),
        CommandSpec(137, "drive", (_SPEED, _RADIUS)),
        CommandSpec(138, "motors", (Argument("B", 0, 31),)),
        CommandSpec(139, "leds", (Argument("B", 0, 15), _BYTE, _BYTE)),
        CommandSpec(140, "song", (Argument("B", 0, 4),), counted=True),  # then note, duration in 1/64 s, ...
        CommandSpec(141, "play", (Argument("B", 0, 4),)),
        CommandSpec(142, "sensors", (_PACKET,)),
        CommandSpec(143, "dock"),
        CommandSpec(144, "pwm_motors", (Argument("b", -127, 127), Argument("b", -127, 127), Argument("B", 0, 127))),
        CommandSpec(145, "drive_direct", (_SPEED, _SPEED)),  # right, left
        CommandSpec(146, "drive_pwm", (_PWM, _PWM)),  # right, left
        CommandSpec(148, "stream", counted=True),
        CommandSpec(149, "query", counted=True),
        CommandSpec(150, "resume_stream", (Argument("B", 0, 1),)),  # 0 pauses
        CommandSpec(162, "scheduling_leds", (_BYTE, _BYTE)),
        CommandSpec(163, "digits_raw", (_BYTE,) * 4),
        CommandSpec(164, "digits_ascii", (_CHARACTER,) * 4),
        CommandSpec(165, "buttons", (_BYTE,)),
        CommandSpec(167, "schedule", (_BYTE, *(_HOUR, _MINUTE) * 7)),
        CommandSpec(168, "set_time", (_DAY, _HOUR, _MINUTE)),
        CommandSpec(173, "stop"),
    )
}
_BY_NAME = {spec.name: spec for spec in COMMANDS.values()}
_SONG, _SONG_NOTES = 140, 16


def encode(name: str, *values: int) -> bytes:
    """Bytes of one command, e.g. `encode("drive_direct", right_mm_s, left_mm_s)` or `encode("stream", 7, 43, 44)`.

    The count of `stream`, `query` and `song` is filled in; `song` takes its number, then note and duration in turn.

    Raises
    ------
    ValueError
        Unknown command, wrong number of values, or a value out of range.
    """
    spec = _BY_NAME.get(name)
    if spec is None:
        raise ValueError(f"unknown command {name!r}; expected one of {', '.join(sorted(_BY_NAME))}")
    fixed, rest = values[: len(spec.arguments)], values[len(spec.arguments) :]
    if len(fixed) < len(spec.arguments) or (rest and not spec.counted):
        raise ValueError(f"{name}: got {len(values)} values; expected {len(spec.arguments)}")
    for value, argument in zip(fixed, spec.arguments, strict=True):
        if not argument.low <= value <= argument.high and value not in argument.besides:
            raise ValueError(f"{name}: got {value}; expected {argument.low} to {argument.high}")
    head = bytes((spec.opcode,)) + struct.pack(spec.code, *fixed)
    if not spec.counted:
        return head
    if spec.opcode == _SONG:
        if len(rest) % 2 or not 2 <= len(rest) <= 2 * _SONG_NOTES:
            raise ValueError(f"song: got {len(rest)} values after the number; expected 1 to 16 notes with durations")
        return head + bytes((len(rest) // 2, *rest))
    for number in rest:
        members(number)
    return head + bytes((len(rest), *rest))


@dataclass(frozen=True, slots=True)
class Command:
    """One command as `encode` takes it."""

    name: str
    values: tuple[int, ...] = ()


class CommandDecoder:
    """The robot's side: bytes in, commands out.

    Like the robot's own parser it waits for missing argument bytes for ever and takes the next command's for them;
    bytes that are no opcode are skipped. Values are not checked against their ranges: the robot clamps.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def pending(self) -> bytes:
        """The start of a command whose arguments are missing."""
        return bytes(self._buffer)

    def feed(self, data: bytes) -> list[Command | Skipped]:
        """Take received bytes; returns what they completed, the same events however the bytes are cut."""
        events: list[Command | Skipped] = []
        buffer = self._buffer
        buffer += data
        start = 0
        while start < len(buffer):
            spec = COMMANDS.get(buffer[start])
            if spec is None:
                events.append(Skipped(bytes((buffer[start],)), "opcode"))
                start += 1
                continue
            fixed_end = start + 1 + struct.calcsize(spec.code)
            end = fixed_end + spec.counted
            if len(buffer) < end:
                break
            if spec.counted:
                count = buffer[fixed_end]
                end += 2 * min(count, _SONG_NOTES) if spec.opcode == _SONG else count
                if len(buffer) < end:
                    break
            values = struct.unpack(spec.code, bytes(buffer[start + 1 : fixed_end]))
            events.append(Command(spec.name, values + tuple(buffer[fixed_end + spec.counted : end])))
            start = end
        del buffer[:start]
        return events
