"""Recordings: every frame and every serial byte of a run, in one MCAP file (https://mcap.dev).

Channels and their messages:

    camera/<name>                a frame that a driver took; log time is when it took it, publish time is the stamp.
                                 Little-endian: t float64 (seconds of loop time, the camera's stamp), sequence uint32,
                                 width uint16, height uint16, then height x width grey levels, row by row.
    serial/<port>/from_robot     bytes as they arrived at, or were sent to, a serial port; log time is loop time.
    serial/<port>/to_robot

Times in MCAP are nanoseconds of the loop's clock. Chunks are compressed with zstd. A recording that ends in the middle,
because the machine lost power, can be read up to its last whole chunk.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from .errors import InputError
from .records import Frame

FRAME = struct.Struct("<dIHH")
FRAME_SCHEMA = "robotd.Frame/1"
SERIAL_SCHEMA = "robotd.SerialBytes/1"
FRAME_TEXT = (
    b"little-endian: t float64 s, sequence uint32, width uint16, height uint16, then height*width uint8 grey levels"
)
SERIAL_TEXT = b"raw bytes of a serial line"
CHUNK = 4 << 20  # bytes before compression: what a crash can cost


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
    """

    def __init__(self, path: Path) -> None:
        self.path = path
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

    def _write(self, topic: str, schema: str, log: float, publish: float, data: bytes, sequence: int) -> None:
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
    for topic, message in _messages(path):
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


def read_serial(path: Path, port: str | None = None) -> Iterator[SerialBytes]:
    """The bytes of one serial port, or of all, both directions in the order of time; raises InputError."""
    for topic, message in _messages(path):
        kind, _, rest = topic.partition("/")
        name, _, direction = rest.rpartition("/")
        if kind == "serial" and (port is None or name == port):
            yield SerialBytes(name, message.log_time / 1e9, direction == "to_robot", bytes(message.data))


def _messages(path: Path) -> Iterator[tuple[str, Message]]:
    """Topic and message of every record up to the end of the file or to where it was cut off."""
    topics: dict[int, str] = {}
    try:
        file = path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    with file:
        records = StreamReader(file).records
        whole = False
        while True:
            try:
                record = next(records, None)
            except (McapError, struct.error, ValueError, EOFError) as error:
                if not whole:
                    raise InputError(f"{path}: not a recording (MCAP): {error}") from error
                return
            if record is None:
                return
            whole = True
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                yield topics[record.channel_id], record


def _nanoseconds(t: float) -> int:
    return max(0, round(t * 1e9))  # MCAP has no negative times; a frame's exact stamp is in its message
