"""The robot base: decoding its sensor stream."""

from __future__ import annotations

from robotd import oi

from .table import Row, median_ms


def rows() -> list[Row]:
    """Decoding one frame of the robot's sensor stream, against summing its bytes."""
    ids = (7, 9, 10, 11, 12, 14, 21, 22, 25, 26, 35, 43, 44)
    values = dict.fromkeys(ids, 0)
    frame = oi.encode_stream_frame(ids, values, "inclusive")
    decoder = oi.StreamDecoder(ids, "inclusive")
    return [
        Row(
            f"sensor stream, {len(frame)} byte frame",
            median_ms(lambda: decoder.feed(frame), 5000),
            "sum of its bytes",
            median_ms(lambda: sum(frame), 5000),
        )
    ]
