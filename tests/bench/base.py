"""The robot base: decoding its sensor stream."""

from __future__ import annotations

import itertools

import numpy as np

from robotd import oi
from robotd.roomba.line import PACKETS

from .table import Row, median_ms


def rows() -> list[Row]:
    """Decoding one frame of the robot's sensor stream, good or damaged, and bytes that are none, against a sum."""
    values = dict.fromkeys(PACKETS, 0)
    frame = oi.encode_stream_frame(PACKETS, values, "inclusive")
    decoder = oi.StreamDecoder(PACKETS, "inclusive")
    adding = median_ms(lambda: sum(frame), 5000)
    damaged = itertools.cycle(_damaged(frame, 999))
    noise = itertools.cycle(np.random.default_rng(1).integers(0, 256, (999, len(frame)), np.uint8))
    others = (
        (f"sensor stream, {len(frame)} byte frame", lambda: decoder.feed(frame)),
        ("  a byte of it damaged", lambda: decoder.feed(next(damaged))),
        ("  noise in its place", lambda: decoder.feed(next(noise).tobytes())),
    )
    return [Row(name, median_ms(step, 5000), "sum of its bytes", adding) for name, step in others]


def _damaged(frame: bytes, count: int) -> list[bytes]:
    """Copies of a frame with one byte each changed at random."""
    rng = np.random.default_rng(0)
    copies = np.tile(np.frombuffer(frame, np.uint8), (count, 1))
    copies[np.arange(count), rng.integers(0, len(frame), count)] ^= rng.integers(1, 256, count, np.uint8)
    return [copy.tobytes() for copy in copies]
