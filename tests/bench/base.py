"""The robot base: decoding its sensor stream."""

from __future__ import annotations

from robotd import oi
from robotd.roomba.line import PACKETS

from .table import Row, median_ms


def rows() -> list[Row]:
    """Decoding one frame of the robot's sensor stream, against summing its bytes."""
    values = dict.fromkeys(PACKETS, 0)
    frame = oi.encode_stream_frame(PACKETS, values, "inclusive")
    decoder = oi.StreamDecoder(PACKETS, "inclusive")
    return [
        Row(
            f"sensor stream, {len(frame)} byte frame",
            median_ms(lambda: decoder.feed(frame), 5000),
            "sum of its bytes",
            median_ms(lambda: sum(frame), 5000),
        )
    ]
