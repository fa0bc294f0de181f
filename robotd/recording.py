"""Recordings: every frame and every serial byte of a run, in one MCAP file (https://mcap.dev).

Channels and their messages:

    camera/<name>                a frame that a driver took; log time is when it took it, publish time is the stamp.
                                 Little-endian: t float64 (seconds of loop time, the camera's stamp), sequence uint32,
                                 width uint16, height uint16; then, by the channel's schema, height x width grey levels
                                 row by row (robotd.Frame/1), or the JPEG as the camera sent it, at that size or two,
                                 four or eight times that (robotd.Jpeg/1). The channel's metadata tell how it was taken.
    serial/<port>/from_robot     bytes as they arrived at, or were sent to, a serial port; log time is loop time.
    serial/<port>/to_robot

What holds for the whole recording (robot, date, pattern, calibration) is a metadata record of the name "robotd" at its
begin. Metadata are texts, JSON where they have a structure.

Times in MCAP are nanoseconds of the loop's clock. Chunks are compressed with zstd and small, so that a recording that
ends in the middle, because the machine lost power, can be read up to the last fraction of a second that the disk had;
`recover` makes a whole file of it. A recording never takes more than its limit: what comes later is counted, not kept.
"""

from __future__ import annotations

import logging
import math
import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from . import jpeg
from .errors import InputError
from .records import Frame

if TYPE_CHECKING:
    from mcap.records import Message  # loaded by those who record: it takes a Pi a tenth of a second, and 3 MB

log = logging.getLogger("robotd.recording")

FRAME = struct.Struct("<dIHH")
FRAME_SCHEMA = "robotd.Frame/1"
JPEG_SCHEMA = "robotd.Jpeg/1"
SERIAL_SCHEMA = "robotd.SerialBytes/1"
_HEAD_TEXT = b"little-endian: t float64 s, sequence uint32, width uint16, height uint16, then "
SCHEMAS = {
    FRAME_SCHEMA: _HEAD_TEXT + b"height*width uint8 grey levels",
    JPEG_SCHEMA: _HEAD_TEXT
    + b"a JPEG of width x height times 1, 2, 4 or 8; the channel's metadata may say channel: red",
    SERIAL_SCHEMA: b"raw bytes of a serial line",
}
ABOUT = "robotd"  # name of the metadata record
CHUNK = 256 << 10  # bytes before compression: what a crash can cost
TAIL = 64 << 10  # bytes kept free below the limit for the index
INDEX = 256  # bytes that a message takes beside its content, at most: it may be a chunk by itself
RECORD_LIMIT = 64 << 20  # bytes of a record: more than any of ours, so that damage cannot fill the memory


@dataclass(frozen=True, slots=True)
class SerialBytes:
    """Bytes on a serial line at loop time `t`."""

    port: str
    t: float
    to_robot: bool
    data: bytes


class FrameRecorder:
    """Writes a recording; use it as a context manager, so that the file is finished whatever happens.

    Parameters
    ----------
    path : Path
        Overwritten if it exists.
    limit : int, optional
        Bytes that the finished file may take.
    about : mapping of str to str
        What holds for the whole recording.

    Attributes
    ----------
    written, refused : int
        Messages that were taken, and those that were not because the limit was reached.
    """

    def __init__(self, path: Path, limit: int | None = None, about: Mapping[str, str] | None = None) -> None:
        self.path = path
        self.limit = limit
        self.about = dict(about or {})
        self.written = self.refused = 0
        self._pending = 0  # bytes that may not have reached the file
        self._channels: dict[tuple[str, str, tuple[tuple[str, str], ...]], int] = {}
        self._writer: Any = None

    def __enter__(self) -> FrameRecorder:
        from mcap.writer import CompressionType, Writer

        self._file = self.path.open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        self._writer.start(profile="robotd", library="robotd")
        self._schemas = {name: self._writer.register_schema(name, "text/plain", text) for name, text in SCHEMAS.items()}
        if self.about:
            self._writer.add_metadata(ABOUT, self.about)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.finish()
        finally:
            self._file.close()

    @property
    def is_full(self) -> bool:
        """Whether the limit was reached."""
        return self.refused > 0

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return int(self._file.tell()) if not self._file.closed else self.path.stat().st_size

    def sync(self) -> None:
        """Have the disk keep what was written so far; blocks."""
        self._writer.flush()  # ends the chunk
        self._pending = 0
        self._file.flush()
        os.fsync(self._file.fileno())

    def frame(self, frame: Frame, delivered: float, about: Mapping[str, str] | None = None) -> None:
        """Record a frame that was taken at loop time `delivered`: its JPEG if it has one, else its grey levels.

        `about` says how it was taken. Of a frame with a JPEG, "channel" names the one that detectors get.
        """
        height, width = frame.image.shape
        head = FRAME.pack(frame.t, frame.sequence, width, height)
        if frame.encoded is not None:
            schema, body = JPEG_SCHEMA, frame.encoded
        else:
            schema, body = FRAME_SCHEMA, frame.image.tobytes()
        self._write(f"camera/{frame.camera}", schema, about, delivered, frame.t, head + body, frame.sequence)

    def serial(self, port: str, t: float, data: bytes, *, to_robot: bool) -> None:
        """Record bytes on a serial line."""
        topic = f"serial/{port}/{'to' if to_robot else 'from'}_robot"
        self._write(topic, SERIAL_SCHEMA, None, t, t, data, 0)

    def copy(self, source: Source, message: Message) -> None:
        """Record a message of another recording."""
        log, publish = message.log_time / 1e9, message.publish_time / 1e9
        self._write(source.topic, source.schema, source.about, log, publish, message.data, message.sequence)

    def _write(
        self,
        topic: str,
        schema: str,
        about: Mapping[str, str] | None,
        log: float,
        publish: float,
        data: bytes,
        sequence: int,
    ) -> None:
        key = topic, schema, tuple(sorted((about or {}).items()))
        if self.limit is not None:
            extra = 2 * sum(len(text) + 8 for item in key[2] for text in item) if key not in self._channels else 0
            self._pending += len(data) + INDEX + extra
            if self._pending > CHUNK:
                self._pending = len(data) + INDEX + extra
            index = TAIL + INDEX * self.written
            if self.refused or self._file.tell() + self._pending + index > self.limit:
                self.refused += 1
                return
        self.written += 1
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(topic, "robotd", self._schemas[schema], dict(key[2]))
        self._writer.add_message(self._channels[key], _nanoseconds(log), data, _nanoseconds(publish), sequence)


@dataclass(frozen=True, slots=True)
class Source:
    """Where a message is from: topic, schema and metadata of its channel."""

    topic: str
    schema: str
    about: dict[str, str]

    @property
    def camera(self) -> str | None:
        """Whose frames these are; None if they are none."""
        kind, _, name = self.topic.partition("/")
        return name if kind == "camera" else None


def read_frames(path: Path, camera: str | None = None) -> Iterator[Frame]:
    """The frames of one camera, or of all, in the order in which they were taken.

    Raises
    ------
    InputError
        No such file, not a recording, or no such camera in it; the message names those that are there.
    """
    cameras: set[str] = set()
    for source, message in _Messages(path):
        name = source.camera
        if name is None:
            continue
        cameras.add(name)
        if camera is None or name == camera:
            frame = _frame(name, source, message.data)
            if frame is None:
                raise InputError(f"{path}: frame {message.sequence} of camera '{name}' is damaged or of another format")
            yield frame
    if camera is not None and camera not in cameras:
        raise InputError(f"{path}: no frames of camera '{camera}'; it has {', '.join(sorted(cameras)) or 'none'}")


def _frame(camera: str, source: Source, data: bytes) -> Frame | None:
    """The frame in a message; None if it cannot be read."""
    if len(data) < FRAME.size:
        return None
    t, sequence, width, height = FRAME.unpack_from(data)
    if source.schema == JPEG_SCHEMA:
        encoded = bytes(data[FRAME.size :])
        channel: jpeg.Channel = "red" if source.about.get("channel") == "red" else "gray"
        image = jpeg.decode(encoded, (width, height), channel)
        return None if image is None else Frame(camera, t, image, sequence, encoded)
    if source.schema != FRAME_SCHEMA or len(data) != FRAME.size + width * height:
        return None
    return Frame(camera, t, np.frombuffer(data, np.uint8, offset=FRAME.size).reshape(height, width), sequence)


@dataclass(frozen=True, slots=True)
class Contents:
    """What a recording holds: how many frames of each camera and pieces of each serial port, and from when to when.

    `is_whole` says whether it was finished; if not, these are what can be read of it. `about` holds for all of it;
    `cameras` tells for each camera how its frames were taken, once for each mode in which it was.
    """

    frames: dict[str, int]
    serial: dict[str, int]
    begin: float
    end: float
    is_whole: bool
    about: dict[str, str] = field(default_factory=dict)
    cameras: dict[str, tuple[dict[str, str], ...]] = field(default_factory=dict)


def read_contents(path: Path) -> Contents:
    """Look through a recording, whole or cut off; raises InputError if it is none."""
    return _summary(path) or _scan(path)


def _summary(path: Path) -> Contents | None:
    """What the index at the end of a whole recording says; None if there is none."""
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return None
            about = {
                key: text
                for item in reader.iter_metadata()
                if item.name == ABOUT
                for key, text in item.metadata.items()
            }
    except Exception:  # the file system and the reader's many; looking through the file tells which
        return None
    statistics, tally = summary.statistics, _Tally()
    for number, channel in summary.channels.items():
        source = Source(channel.topic, summary.schemas[channel.schema_id].name, dict(channel.metadata))
        tally.add(source, statistics.channel_message_counts.get(number, 0))
    return tally.contents(statistics.message_start_time / 1e9, statistics.message_end_time / 1e9, True, about)


def _scan(path: Path) -> Contents:
    begin, end = math.inf, -math.inf
    messages, tally = _Messages(path), _Tally()
    for source, message in messages:
        tally.add(source, 1)
        begin, end = min(begin, message.log_time / 1e9), max(end, message.log_time / 1e9)
    if begin > end:
        begin = end = 0.0
    return tally.contents(begin, end, messages.is_whole, messages.about)


class _Tally:
    """Counts messages by where they are from."""

    def __init__(self) -> None:
        self._frames: Counter[str] = Counter()
        self._serial: Counter[str] = Counter()
        self._cameras: dict[str, list[dict[str, str]]] = {}

    def add(self, source: Source, count: int) -> None:
        kind, _, rest = source.topic.partition("/")
        if kind == "camera":
            self._frames[rest] += count
            ways = self._cameras.setdefault(rest, [])
            if source.about not in ways:
                ways.append(source.about)
        elif kind == "serial":
            self._serial[rest.rpartition("/")[0]] += count

    def contents(self, begin: float, end: float, is_whole: bool, about: dict[str, str]) -> Contents:
        cameras = {name: tuple(ways) for name, ways in self._cameras.items()}
        return Contents(dict(self._frames), dict(self._serial), begin, end, is_whole, about, cameras)


def recover(path: Path, out: Path) -> Contents:
    """Make a whole recording of one that was cut off.

    Parameters
    ----------
    path : Path
        The recording; it stays as it is.
    out : Path
        Where to write what can be read of it; appears only when it is complete.

    Returns
    -------
    Contents
        Of the new file.

    Raises
    ------
    InputError
        `path` is no recording, or `out` cannot be written.
    """
    part = out.with_name(out.name + ".new")  # not ".part": that is what a recorder has left behind
    try:
        messages = _Messages(path)
        first = next(iter(messages), None)  # after it the metadata are known
        with FrameRecorder(part, about=messages.about) as recorder:
            for source, message in messages if first is not None else ():
                recorder.copy(source, message)
            recorder.sync()
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        part.replace(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return read_contents(out)


def read_serial(path: Path, port: str | None = None) -> Iterator[SerialBytes]:
    """The bytes of one serial port, or of all, both directions in the order of time; raises InputError."""
    for source, message in _Messages(path):
        kind, _, rest = source.topic.partition("/")
        name, _, direction = rest.rpartition("/")
        if kind == "serial" and (port is None or name == port):
            yield SerialBytes(name, message.log_time / 1e9, direction == "to_robot", bytes(message.data))


class _Messages:
    """Origin and message of every record, up to the end of the file or to where it was cut off.

    A damaged piece (a chunk whose checksum is wrong: a quarter of a second at most) is left out, and told.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.about: dict[str, str] = {}  # known when the first message comes
        self.is_whole = False  # known at the end

    def __iter__(self) -> Iterator[tuple[Source, Message]]:
        from mcap.stream_reader import StreamReader

        schemas: dict[int, str] = {}
        sources: dict[int, Source] = {}
        try:
            file = self._path.open("rb")
        except OSError as error:
            raise InputError(f"{self._path}: cannot be read: {error.strerror or error}") from error
        with file:
            records = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_LIMIT).records
            is_begun, damaged = False, 0
            while True:
                try:
                    record = next(records, None)
                except Exception as error:  # the decompressor, the reader and struct each have their own
                    if not is_begun:
                        why = str(error) or "it is empty, or ends in its first bytes"
                        raise InputError(f"{self._path}: not a recording (MCAP): {why}") from error
                    break
                if record is None:
                    self.is_whole = True
                    break
                is_begun = True
                parts = _inside(record)
                damaged += parts is None
                yield from self._messages(parts or (), schemas, sources)
        if damaged:
            log.warning("%s: %d damaged pieces are left out", self._path, damaged)

    def _messages(
        self, records: Iterable[Any], schemas: dict[int, str], sources: dict[int, Source]
    ) -> Iterator[tuple[Source, Message]]:
        """Those among some records; of the others the meaning is kept."""
        from mcap.records import Channel, Message, Metadata, Schema

        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                sources[record.id] = Source(record.topic, schemas.get(record.schema_id, ""), dict(record.metadata))
            elif isinstance(record, Metadata) and record.name == ABOUT:
                self.about = dict(record.metadata)
            elif isinstance(record, Message):
                if record.channel_id not in sources:  # they were described in a piece that is damaged
                    for number, source in _described(self._path).items():
                        sources.setdefault(number, source)
                if record.channel_id in sources:
                    yield sources[record.channel_id], record


def _inside(record: Any) -> list[Any] | None:
    """The records of a chunk, or a record itself; None if it is damaged."""
    from mcap.records import Chunk
    from mcap.stream_reader import breakup_chunk

    if not isinstance(record, Chunk):
        return [record]
    try:
        return list(breakup_chunk(record, validate_crc=True))
    except Exception:  # the decompressor, the reader and struct each have their own
        return None


def _described(path: Path) -> dict[int, Source]:
    """Where messages are from, by what the end of a recording repeats; empty if it is damaged, too."""
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except Exception:  # as above
        return {}
    if summary is None:
        return {}
    return {
        number: Source(channel.topic, summary.schemas[channel.schema_id].name, dict(channel.metadata))
        for number, channel in summary.channels.items()
    }


def _nanoseconds(t: float) -> int:
    return max(0, round(t * 1e9))  # MCAP has no negative times; a frame's exact stamp is in its message
