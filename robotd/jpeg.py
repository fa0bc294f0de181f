"""JPEG images from cameras, decoded no further than the detectors need.

A detector wants one channel, so the other two are never made: grey is the luminance plane of the file, without chroma
and without colour conversion. Images that are two, four or eight times as large as wanted are made small by the inverse
transform itself, which costs less than decoding them whole.

What was cut off on its way is refused, although the decoder would fill the rest with grey.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Channel = Literal["gray", "red"]
REDUCTIONS = (1, 2, 4, 8)

_FRAME_HEADERS = {0xC0, 0xC1, 0xC2}  # SOF0..2: baseline, extended, progressive; ITU-T T.81 table B.1
_SCAN = 0xDA
_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length
_FLAGS = {
    ("gray", 1): cv2.IMREAD_GRAYSCALE,
    ("gray", 2): cv2.IMREAD_REDUCED_GRAYSCALE_2,
    ("gray", 4): cv2.IMREAD_REDUCED_GRAYSCALE_4,
    ("gray", 8): cv2.IMREAD_REDUCED_GRAYSCALE_8,
    ("red", 1): cv2.IMREAD_COLOR,
    ("red", 2): cv2.IMREAD_REDUCED_COLOR_2,
    ("red", 4): cv2.IMREAD_REDUCED_COLOR_4,
    ("red", 8): cv2.IMREAD_REDUCED_COLOR_8,
}
_RED = 2  # of OpenCV's BGR


class JpegHeader(NamedTuple):
    """Size in pixels, and where the entropy-coded data begin."""

    width: int
    height: int
    scan: int


def read_header(data: bytes | memoryview) -> JpegHeader | None:
    """Walk the segments up to the first scan; None if this is no whole JPEG header.

    Notes
    -----
    ITU-T T.81 annex B: a segment is FF, a marker, and (but for a few markers) a big-endian length that counts itself.
    """
    if len(data) < 4 or data[0] != 0xFF or data[1] != 0xD8:
        return None
    at, size = 2, (0, 0)
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF or marker in _ALONE:
            at += 1 if marker == 0xFF else 2
            continue
        length = data[at + 2] << 8 | data[at + 3]
        if length < 2:
            return None
        if marker in _FRAME_HEADERS and at + 9 <= len(data):
            size = data[at + 7] << 8 | data[at + 8], data[at + 5] << 8 | data[at + 6]
        at += 2 + length
        if marker == _SCAN:
            return JpegHeader(*size, at) if min(size) > 0 else None
    return None


def reduction(given: tuple[int, int], wanted: tuple[int, int]) -> int | None:
    """By which of 1, 2, 4 and 8 an image of `given` (width, height) becomes one of `wanted`; None if by none."""
    for factor in REDUCTIONS:
        if all(-(-have // factor) == want for have, want in zip(given, wanted, strict=True)):
            return factor
    return None


def decode(
    data: bytes | memoryview, size: tuple[int, int] | None = None, channel: Channel = "gray"
) -> NDArray[np.uint8] | None:
    """One channel of a JPEG.

    Parameters
    ----------
    data : bytes-like
        The file; padding after its end is allowed.
    size : (width, height), optional
        What is wanted: the image's own size, or that divided by 2, 4 or 8.
    channel : "gray" or "red"

    Returns
    -------
    (height, width) uint8 array, or None if the file is damaged, cut off or of another size.
    """
    header = read_header(data)
    if header is None or bytes(data[header.scan :]).rfind(b"\xff\xd9") < 0:
        return None
    factor = 1 if size is None else reduction(header[:2], size)
    if factor is None:
        return None
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _FLAGS[channel, factor] | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or (size is not None and image.shape[1::-1] != size):
        return None
    if channel == "red":
        image = cv2.extractChannel(image, _RED)
    return np.asarray(image, dtype=np.uint8)
