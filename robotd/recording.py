"""Recordings: every frame and every serial byte of a run, in one MCAP file (https://mcap.dev).

Channels and their messages:

    camera/<name>                a frame that a driver took; log time is when it took it, publish time is the stamp.
                                 Little-endian: t float64 (seconds of loop time, the camera's stamp), sequence uint32,
                                 width uint16, height uint16, then height x width grey levels, row by row.
    serial/<port>/from_robot     bytes as they arrived at, or were sent to, a serial port; log time is loop time.
    serial/<port>/to_robot

Times in MCAP are nanoseconds of the loop's clock. Chunks are compressed with zstd and small, so that a recording that
ends in the middle, because the machine lost power, can be read up to the last fraction of a second that the disk had;
`recover` makes a whole file of it. A recording never takes more than its limit: what comes later is counted, not kept.
"""

from __future__ import annotations

import asyncio
import math
import os
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from .bus import Bus
from .clock import in_executor, now
from .errors import InputError
from .records import Frame

FRAME = struct.Struct("<dIHH")
FRAME_SCHEMA = "robotd.Frame/1"
SERIAL_SCHEMA = "robotd.SerialBytes/1"
FRAME_TEXT = (
    b"little-endian: t float64 s, sequence uint32, width uint16, height uint16, then height*width uint8 grey levels"
)
SERIAL_TEXT = b"raw bytes of a serial line"
CHUNK = 256 << 10  # bytes before compression: what a crash can cost
TAIL = 64 << 10  # bytes kept free below the limit for the index
INDEX = 64  # bytes that the index grows by for each message, at most
RECORD_LIMIT = 64 << 20  # bytes of a record: more than any of ours, so that damage cannot fill the memory
BATCH_S = 0.5  # a power cut costs this and a chunk
WAITING = 64  # frames of a camera that wait for the disk


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

    Attributes
    ----------
    written, refused : int
        Messages that were taken, and those that were not because the limit was reached.
    """

    def __init__(self, path: Path, limit: int | None = None) -> None:
        self.path = path
        self.limit = limit
        self.written = self.refused = 0
        self._pending = 0  # bytes that may not have reached the file
        self._channels: dict[str, int] = {}
        self._writer: Any = None

    def __enter__(self) -> FrameRecorder:
        self._file = self.path.open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        self._writer.start(profile="robotd", library="robotd")
        self._schemas = {
            name: self._writer.register_schema(name, "text/plain", text)
            for name, text in ((FRAME_SCHEMA, FRAME_TEXT), (SERIAL_SCHEMA, SERIAL_TEXT))
        }
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

    def sync(self) -> None:
        """Have the disk keep what was written so far; blocks."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def frame(self, frame: Frame, delivered: float) -> None:
        """Record a frame that was taken at loop time `delivered`."""
        height, width = frame.image.shape
        head = FRAME.pack(frame.t, frame.sequence, width, height)
        self._write(
            f"camera/{frame.camera}", FRAME_SCHEMA, delivered, frame.t, head + frame.image.tobytes(), frame.sequence
        )

    def serial(self, port: str, t: float, data: bytes, *, to_robot: bool) -> None:
        """Record bytes on a serial line."""
        topic = f"serial/{port}/{'to' if to_robot else 'from'}_robot"
        self._write(topic, SERIAL_SCHEMA, t, t, data, 0)

    def copy(self, topic: str, message: Message) -> None:
        """Record a message of another recording."""
        schema = FRAME_SCHEMA if topic.startswith("camera/") else SERIAL_SCHEMA
        log, publish = message.log_time / 1e9, message.publish_time / 1e9
        self._write(topic, schema, log, publish, message.data, message.sequence)

    def _write(self, topic: str, schema: str, log: float, publish: float, data: bytes, sequence: int) -> None:
        if self.limit is not None:
            self._pending += len(data) + INDEX
            if self._pending > CHUNK:
                self._pending = len(data) + INDEX
            index = TAIL + INDEX * self.written
            if self.refused or self._file.tell() + self._pending + index > self.limit:
                self.refused += 1
                return
        self.written += 1
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "robotd", self._schemas[schema])
        self._writer.add_message(self._channels[topic], _nanoseconds(log), data, _nanoseconds(publish), sequence)


def read_frames(path: Path, camera: str | None = None) -> Iterator[Frame]:
    """The frames of one camera, or of all, in the order in which they were taken.

    Raises
    ------
    InputError
        No such file, not a recording, or no such camera in it; the message names those that are there.
    """
    cameras: set[str] = set()
    for topic, message in _Messages(path):
        kind, _, name = topic.partition("/")
        if kind != "camera":
            continue
        cameras.add(name)
        if camera is None or name == camera:
            t, sequence, width, height = FRAME.unpack_from(message.data)
            image = np.frombuffer(message.data, np.uint8, offset=FRAME.size).reshape(height, width)
            yield Frame(name, t, image, sequence)
    if camera is not None and camera not in cameras:
        raise InputError(f"{path}: no frames of camera '{camera}'; it has {', '.join(sorted(cameras)) or 'none'}")


@dataclass(frozen=True, slots=True)
class Contents:
    """What a recording holds: how many frames of each camera and pieces of each serial port, and from when to when.

    `is_whole` says whether it was finished; if not, these are what can be read of it.
    """

    frames: dict[str, int]
    serial: dict[str, int]
    begin: float
    end: float
    is_whole: bool


def read_contents(path: Path) -> Contents:
    """Look through a recording, whole or cut off; raises InputError if it is none."""
    frames: Counter[str] = Counter()
    serial: Counter[str] = Counter()
    begin, end = math.inf, -math.inf
    messages = _Messages(path)
    for topic, message in messages:
        kind, _, rest = topic.partition("/")
        if kind == "camera":
            frames[rest] += 1
        elif kind == "serial":
            serial[rest.rpartition("/")[0]] += 1
        begin, end = min(begin, message.log_time / 1e9), max(end, message.log_time / 1e9)
    if begin > end:
        begin = end = 0.0
    return Contents(dict(frames), dict(serial), begin, end, messages.is_whole)


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
    part = out.with_name(out.name + ".part")
    try:
        with FrameRecorder(part) as recorder:
            for topic, message in _Messages(path):
                recorder.copy(topic, message)
            recorder.sync()
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        part.replace(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return read_contents(out)


async def record(
    bus: Bus, cameras: Sequence[str], path: Path, *, limit: int, seconds: float = math.inf
) -> FrameRecorder:
    """Record what cameras publish until `seconds` have passed, the limit is reached, or it is cancelled.

    Writing is done in a thread, and the disk is made to keep it every second, so that a power cut costs no more. If the
    disk is too slow the oldest waiting frames are dropped.

    Parameters
    ----------
    cameras : sequence of str
        Instances of camera drivers; somebody else starts them.
    path : Path
        Overwritten if it exists.
    limit : int
        Bytes that the file may take.

    Returns
    -------
    FrameRecorder
        Closed; `written` and `is_full` say what came of it.

    Raises
    ------
    InputError
        The file cannot be written; what was written before can be read.
    """
    recorder = FrameRecorder(path, limit)
    ending = now() + seconds
    with ExitStack() as stack:
        queues = [stack.enter_context(bus.frames(name).subscribe(size=WAITING)) for name in cameras]
        disk = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="recording"))  # one: nothing overtakes
        try:
            await in_executor(disk, recorder.__enter__)
            try:
                while now() < ending and not recorder.is_full:
                    await asyncio.sleep(min(BATCH_S, ending - now()))
                    batch = [queue.take() for queue in queues for _ in range(queue.waiting)]
                    batch.sort(key=lambda frame: frame.t)
                    await in_executor(disk, _write_batch, recorder, batch, now())
            finally:
                await in_executor(disk, recorder.__exit__, None, None, None)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return recorder


def _write_batch(recorder: FrameRecorder, batch: Sequence[Frame], t: float) -> None:
    for frame in batch:
        recorder.frame(frame, max(t, frame.t))
    recorder.sync()


def read_serial(path: Path, port: str | None = None) -> Iterator[SerialBytes]:
    """The bytes of one serial port, or of all, both directions in the order of time; raises InputError."""
    for topic, message in _Messages(path):
        kind, _, rest = topic.partition("/")
        name, _, direction = rest.rpartition("/")
        if kind == "serial" and (port is None or name == port):
            yield SerialBytes(name, message.log_time / 1e9, direction == "to_robot", bytes(message.data))


class _Messages:
    """Topic and message of every record, up to the end of the file or to where it was cut off."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.is_whole = False  # known at the end

    def __iter__(self) -> Iterator[tuple[str, Message]]:
        topics: dict[int, str] = {}
        try:
            file = self._path.open("rb")
        except OSError as error:
            raise InputError(f"{self._path}: cannot be read: {error.strerror or error}") from error
        with file:
            records = StreamReader(file, validate_crcs=True, record_size_limit=RECORD_LIMIT).records
            is_begun = False
            while True:
                try:
                    record = next(records, None)
                except Exception as error:  # the decompressor, the reader and struct each have their own
                    if not is_begun:
                        raise InputError(f"{self._path}: not a recording (MCAP): {error or 'empty'}") from error
                    return
                if record is None:
                    self.is_whole = True
                    return
                is_begun = True
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    if record.channel_id not in topics:
                        return  # damaged
                    yield topics[record.channel_id], record


def _nanoseconds(t: float) -> int:
    return max(0, round(t * 1e9))  # MCAP has no negative times; a frame's exact stamp is in its message
