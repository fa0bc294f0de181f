"""What a camera frame costs: decoding against a full decode to colour, and the parser against copying its bytes."""

from __future__ import annotations

import cv2
import numpy as np

from robotd.jpeg import decode
from robotd.multipart import MultipartParser

from .table import Row, median_ms

FRAMES = 30
PIECE = 16 << 10  # bytes of a read from a socket


def _scene(width: int, height: int) -> bytes:
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.integers(0, 256, (height, width, 3), dtype=np.uint8), (0, 0), 3)
    image = np.asarray(cv2.normalize(image, image, 0, 255, cv2.NORM_MINMAX), dtype=np.float64)
    noisy = (image + rng.normal(0.0, 2.0, image.shape)).clip(0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", noisy, (cv2.IMWRITE_JPEG_QUALITY, 60))[1])


def rows() -> list[Row]:
    """Decoding and parsing."""
    vga, large = _scene(640, 480), _scene(1280, 960)

    def colour(data: bytes) -> float:
        array = np.frombuffer(data, np.uint8)
        return median_ms(lambda: cv2.imdecode(array, cv2.IMREAD_COLOR), 60)

    whole, whole_large = colour(vga), colour(large)
    size = (640, 480)
    found = [
        Row("camera: JPEG 640x480 to gray", median_ms(lambda: decode(vga, size), 60), "decode to BGR", whole),
        Row("camera: JPEG 640x480 to red", median_ms(lambda: decode(vga, size, "red"), 60), "decode to BGR", whole),
        Row(
            "camera: JPEG 1280x960 to gray 640x480",
            median_ms(lambda: decode(large, size), 60),
            "decode 1280x960 to BGR",
            whole_large,
        ),
    ]
    for told in (True, False):
        length = b"Content-Length: %d\r\n" % len(vga) if told else b""
        stream = (b"--frame\r\nContent-Type: image/jpeg\r\n" + length + b"\r\n" + vga + b"\r\n") * FRAMES
        pieces = [stream[at : at + PIECE] for at in range(0, len(stream), PIECE)]

        def parse(pieces: list[bytes] = pieces) -> None:
            parser = MultipartParser("frame")
            for piece in pieces:
                parser.feed(piece)

        found.append(
            Row(
                f"camera: multipart, {FRAMES} frames {'with' if told else 'without'} length",
                median_ms(parse, 60),
                "joining the pieces",
                median_ms(lambda pieces=pieces: b"".join(pieces), 60),  # type: ignore[misc]
            )
        )
    return found
