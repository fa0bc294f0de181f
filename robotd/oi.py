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

from .oi_packets import (
    GROUPS as GROUPS,
    PACKETS as PACKETS,
    Packet as Packet,
    decode_values as decode_values,
    encode_values as encode_values,
    members as members,
    packet_struct,
)

HEADER = 19
TICK = 0.015  # s between two updates of the robot's sensor values
COUNT = 0.000444565  # m of wheel travel per encoder count (packets 43, 44): pi * 72.0 mm / 508.8
OFF, PASSIVE, SAFE, FULL = range(4)
BAUD_CODES = (300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200)  # index = code of opcode 129
STRAIGHT, STRAIGHT_TOO, SPIN_CLOCKWISE, SPIN_COUNTER_CLOCKWISE = -0x8000, 0x7FFF, -1, 1  # radius codes of opcode 137

Checksum = Literal["inclusive", "exclusive", "auto"]
_KINDS = ("inclusive", "exclusive")


# ---- stream frames ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SensorValues:
    """One accepted stream frame: raw values by packet id; `end` counts the bytes fed up to and with its last one."""

    values: Mapping[int, int]
    end: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes that belong to no frame or command.

    `reason` says why the first of them was not taken for a header or an opcode: "noise" (it is no header), "length",
    "order", "checksum", "ambiguous" (see StreamDecoder) or "opcode".
    """

    data: bytes
    reason: str


@dataclass(slots=True)
class StreamCounters:
    """What a decoder saw: good frames, rejected headers by reason, bytes outside accepted frames."""

    frames: int = 0
    bad_length: int = 0
    bad_order: int = 0
    bad_checksum: int = 0
    ambiguous: int = 0
    skipped_bytes: int = 0


class StreamLayout:
    """The fixed shape of a stream's frames: which packets, in which order.

    Parameters
    ----------
    packet_ids : sequence of int
        Ids as in opcode 148; groups are allowed.

    Attributes
    ----------
    keys : tuple of int
        The packets, groups taken apart.
    length, frame_size : int
        N, and N + 3: bytes of a whole frame.
    lookalikes : tuple of int
        Offsets in bytes at which a frame's data can look like the start of a frame, so that the bytes from there to
        the same place in the next frame have header, length and ids where they belong. Most layouts have none,
        because at every offset some id would have to stand where another one stands.
    """

    def __init__(self, packet_ids: Sequence[int]) -> None:
        self.packet_ids = tuple(packet_ids)
        self.keys = tuple(member for number in packet_ids for member in members(number))
        sizes = [packet_struct([number]).size for number in packet_ids]
        self.length = sum(sizes) + len(sizes)
        self.frame_size = size = self.length + 3
        if not 0 < self.length < 256:
            raise ValueError(f"a frame of {len(sizes)} packets would hold {self.length} bytes; expected 1 to 255")
        self._pieces = [(bytes([number]), packet_struct([number]), len(members(number))) for number in packet_ids]
        self._values = struct.Struct(">2x" + "".join(f"x{layout.format[1:]}" for _, layout, _ in self._pieces) + "x")
        starts = [2 + sum(sizes[:place]) + place for place in range(len(sizes))]
        fixed = {0: HEADER, 1: self.length, **dict(zip(starts, self.packet_ids, strict=True))}
        self.lookalikes = tuple(
            offset
            for offset in range(1, size)
            if all(fixed.get((place + offset) % size, value) == value for place, value in fixed.items())
        )
        self._fixed = sum(value << 8 * (size - 1 - place) for place, value in fixed.items())
        self._mask = sum(0xFF << 8 * (size - 1 - place) for place in fixed)

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

    def is_framed(self, frame: bytes) -> bool:
        """Whether header, length and ids stand where they should in `frame_size` bytes."""
        return int.from_bytes(frame) & self._mask == self._fixed

    def decode(self, frame: bytes) -> dict[int, int]:
        """Values by packet id of a whole frame."""
        return dict(zip(self.keys, self._values.unpack(frame), strict=False))  # they are as many; strict takes longer


def encode_stream_frame(
    packet_ids: Sequence[int], values: Mapping[int, int], checksum: Checksum = "inclusive"
) -> bytes:
    """One frame as the robot sends it; "auto" means inclusive."""
    layout = StreamLayout(packet_ids)
    return layout.encode([values[key] for key in layout.keys], checksum)


class StreamDecoder:
    """Finds the frames of one known stream among any bytes.

    What it guarantees: while the robot's frames follow one another unbroken, no other bytes are ever taken for a
    frame, whatever the values and wherever in the stream it began to listen. A window that is not a frame then spans
    two of them. If the layout has no `lookalikes` such a window never has its ids in order. If it has some, a
    candidate that does not stand where the last frame ended must have no rival: if one that overlaps it is as good,
    both are refused as "ambiguous" until the data changes, because in equal frames nothing tells them apart.

    What it cannot know: where bytes were lost, added or changed on the line a window may pass by chance. Its ids must
    then still be in order, and of the windows that pass that test the 8-bit sum lets through one in 256.

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
        self._agreed: tuple[str, int] = (checksum, 0)
        self._next = -1  # where the last frame, good or with a bad sum, ended, in bytes fed

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
        begin = self.fed - end
        while start < end:
            if buffer[start] != HEADER:
                header = buffer.find(HEADER, start)
                stop = header if header >= 0 else end
                self._skip(bytes(buffer[start:stop]), events)
                start = stop
                continue
            if end - start < 2:
                break
            verdict = "length"
            if buffer[start + 1] == length:
                if end - start < size:
                    break
                frame = bytes(buffer[start : start + size])
                verdict = self._verdict(frame)
                is_next = begin + start == self._next
                if verdict in _KINDS and self.layout.lookalikes and not is_next:
                    verdict = self._weighed(verdict, bytes(buffer[start : start + 2 * size]))
                    if verdict == "wait":
                        break
                if verdict in _KINDS:
                    start += size
                    self._next = begin + start
                    self.counters.frames += 1
                    if self.checksum == "auto":
                        self._count_kind(verdict)
                    if self._run:
                        self._end_run(events)
                    events.append(SensorValues(self.layout.decode(frame), begin + start))
                    continue
                if verdict == "checksum" and is_next:
                    self._next += size
            self._reject(verdict, events)
            start += 1
        del buffer[:start]
        return events

    def _verdict(self, frame: bytes) -> str:
        """The kind of checksum of a good frame, otherwise what is wrong with it."""
        if not self.layout.is_framed(frame):
            return "order"
        total = sum(frame) & 0xFF
        kind = "inclusive" if total == 0 else "exclusive" if total == HEADER else "checksum"
        return kind if self.checksum in (kind, "auto") else "checksum"

    def _weighed(self, kind: str, window: bytes) -> str:
        """What becomes of a good candidate, at the start of `window`, that could be two frames' data.

        The frames that it would overlap must have arrived before that can be said: "wait" until then.
        """
        size, head = self.layout.frame_size, bytes((HEADER, self.layout.length))
        for offset in self.layout.lookalikes:
            rival = window[offset : offset + size]
            if len(rival) < size and head.startswith(rival[:2]):
                return "wait"
            if self._verdict(rival) in _KINDS:
                return "ambiguous"
        return kind

    def _count_kind(self, kind: str) -> None:
        """Settle on the kind of checksum that enough good frames in a row had."""
        self._agreed = (kind, self._agreed[1] + 1 if self._agreed[0] == kind else 1)
        if self._agreed[1] >= self.LOCK_AFTER:
            self.checksum = "inclusive" if kind == "inclusive" else "exclusive"

    def _reject(self, reason: str, events: list[SensorValues | Skipped]) -> None:
        if reason == "length":
            self.counters.bad_length += 1
        elif reason == "order":
            self.counters.bad_order += 1
        elif reason == "checksum":
            self.counters.bad_checksum += 1
            self._agreed = (self.checksum, 0)
        else:
            self.counters.ambiguous += 1
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
_DAYS = Argument("B", 0, 127)  # bit 0 = Sunday

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
        CommandSpec(167, "schedule", (_DAYS, *(_HOUR, _MINUTE) * 7)),
        CommandSpec(168, "set_time", (_DAY, _HOUR, _MINUTE)),
        CommandSpec(173, "stop"),
    )
}
_BY_NAME = {spec.name: spec for spec in COMMANDS.values()}
_SONG, _SONG_NOTES, _SENSORS = 140, 16, 142


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
    if spec.opcode == _SENSORS:
        members(fixed[0])
    if not spec.counted:
        return head
    if spec.opcode == _SONG:
        if len(rest) % 2 or not 2 <= len(rest) <= 2 * _SONG_NOTES:
            raise ValueError(f"song: got {len(rest)} values after the number; expected 1 to 16 notes with durations")
        if not 0 <= min(rest) <= max(rest) <= 255:
            raise ValueError(f"song: got notes and durations from {min(rest)} to {max(rest)}; expected 0 to 255")
        return head + bytes((len(rest) // 2, *rest))
    if len(rest) > 255:
        raise ValueError(f"{name}: got {len(rest)} packets; expected at most 255")
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

    Attributes
    ----------
    commands, skipped_bytes : int
        How many whole commands, and how many bytes that were no opcode, it has seen.
    """

    def __init__(self) -> None:
        self.commands = self.skipped_bytes = 0
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
                self.skipped_bytes += 1
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
            self.commands += 1
            events.append(Command(spec.name, values + tuple(buffer[fixed_end + spec.counted : end])))
            start = end
        del buffer[:start]
        return events
