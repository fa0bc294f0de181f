"""Streams made to fool the stream decoder, with the truth about them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robotd import oi

BASE = (7, 9, 10, 11, 12, 14, 21, 22, 25, 26, 35, 43, 44)  # bumps to encoders, as a driver would ask for
LAYOUTS: tuple[tuple[int, ...], ...] = (
    (43, 44, 35),  # Open Interface notes, section 5 rule 1
    BASE,
    (29, 13),
    (100,),  # groups: much data between few ids, so that a frame can be imitated whole
    (6,),
    (3, 43, 44),
    (1, 43, 44, 35),
    (46, 47, 48, 49, 50, 51, 45),
    (19, 20, 43, 44),  # ids that are headers
)
TEXTS = (
    b"bat:   min 21  sec 34  mV 16150  mA -180  deg-C 25  mAH 2412  state 5\r\n",
    b"\r\nr3_robot/tags/release-3.2.6:4975 CLEAN\r\n\r\nbootloader id: 4718 5267 ABFF FFFF\r\n",
    b"processor-sleep\r\n",
)


@dataclass(frozen=True)
class Stream:
    """Bytes of one robot, and where its frames truly begin: those cut off at the ends are not among them."""

    packet_ids: tuple[int, ...]
    checksum: oi.Checksum
    data: bytes
    frames: dict[int, bytes]


def tempting_frame(layout: oi.StreamLayout, rng: np.random.Generator, checksum: oi.Checksum) -> bytes:
    """A frame whose data look like the start of frames, as far as its own ids allow."""
    size = layout.frame_size
    plain = layout.encode([0] * len(layout.keys), checksum)
    ids = [plain[place] for place in _id_places(layout)]
    data = rng.choice(np.array([oi.HEADER, layout.length, *ids, 0, 255], np.uint8), size)
    if rng.random() < 0.8:  # another frame, moved by some bytes around the frame's end
        data = np.roll(np.frombuffer(plain, np.uint8), int(rng.integers(1, size)))
        noise = rng.random(size) < 0.1
        data = np.where(noise, rng.integers(0, 256, size), data).astype(np.uint8)
    return _with_data(layout, data.tobytes(), checksum)


def _id_places(layout: oi.StreamLayout) -> list[int]:
    place, places = 2, []
    for number in layout.packet_ids:
        places.append(place)
        place += 1 + sum(oi.PACKETS[member].size for member in oi.members(number))
    return places


def _with_data(layout: oi.StreamLayout, data: bytes, checksum: oi.Checksum) -> bytes:
    """The frame that has these bytes wherever its data are."""
    frame = bytearray(data)
    frame[:2] = oi.HEADER, layout.length
    for place, number in zip(_id_places(layout), layout.packet_ids, strict=True):
        frame[place] = number
    return layout.encode(list(layout.decode(bytes(frame)).values()), checksum)


def unbroken(rng: np.random.Generator, size: int, layouts: Sequence[tuple[int, ...]] = LAYOUTS) -> Iterator[Stream]:
    """Streams of `size` bytes in all: runs of equal frames, begun anywhere, with the robot's own text between some."""
    made = 0
    while made < size:
        ids = layouts[int(rng.integers(len(layouts)))]
        kind: oi.Checksum = "inclusive" if rng.random() < 0.7 else "exclusive"
        layout = oi.StreamLayout(ids)
        parts: list[bytes] = []
        frames: dict[int, bytes] = {}
        length = 0
        for _ in range(int(rng.integers(1, 8))):
            frame = tempting_frame(layout, rng, kind)
            count = int(rng.integers(1, 2000 if rng.random() < 0.3 else 20))
            frames.update((length + k * len(frame), frame) for k in range(count))
            parts.append(frame * count)
            length += len(parts[-1])
            if rng.random() < 0.2:
                parts.append(TEXTS[int(rng.integers(len(TEXTS)))])
                length += len(parts[-1])
        cut = int(rng.integers(layout.frame_size + 1))
        data = b"".join(parts)[cut:]
        made += len(data)
        yield Stream(ids, kind, data, {start - cut: frame for start, frame in frames.items() if start >= cut})


def damaged(stream: Stream, rng: np.random.Generator, rate: float) -> bytes:
    """The stream with that share of its bytes changed, lost, doubled, or followed by one that was never sent."""
    data = np.frombuffer(stream.data, np.uint8).copy()
    fate = rng.random(len(data))
    data[fate < 0.25 * rate] ^= rng.integers(1, 256, int((fate < 0.25 * rate).sum())).astype(np.uint8)
    times = np.ones(len(data), int)
    times[(fate >= 0.25 * rate) & (fate < 0.5 * rate)] = 0
    times[(fate >= 0.5 * rate) & (fate < rate)] = 2
    out = np.repeat(data, times)
    second = np.zeros(len(out), bool)
    second[1:] = np.repeat(np.arange(len(data)), times)[1:] == np.repeat(np.arange(len(data)), times)[:-1]
    second &= rng.random(len(out)) < 0.5
    out[second] = rng.integers(0, 256, int(second.sum()))
    return out.tobytes()


@dataclass
class Score:
    """What a decoder made of streams: frames sent whole, found, and accepted though never sent there."""

    sent: int = 0
    found: int = 0
    false: int = 0
    bytes: int = 0


def judge(stream: Stream, score: Score, checksum: oi.Checksum | None = None, chunk: int = 4096) -> oi.StreamDecoder:
    """Decode a stream as sent and compare every accepted frame with what was sent at its offset."""
    decoder = oi.StreamDecoder(stream.packet_ids, checksum or stream.checksum)
    size = decoder.layout.frame_size
    known = {frame: decoder.layout.decode(frame) for frame in set(stream.frames.values())}
    whole = sum(start + size <= len(stream.data) for start in stream.frames)
    for start in range(0, len(stream.data), chunk):
        for event in decoder.feed(stream.data[start : start + chunk]):
            if isinstance(event, oi.SensorValues):
                frame = stream.frames.get(event.end - size)
                if frame is not None and known[frame] == event.values:
                    score.found += 1
                else:
                    score.false += 1
    score.sent += whole
    score.bytes += len(stream.data)
    return decoder
