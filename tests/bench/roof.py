"""What a roof camera's frame costs: 1280 x 720, against decoding it to grey."""

from __future__ import annotations

import cv2
import numpy as np

from robotd.jpeg import decode
from robotd.vision.beacon import BeaconConfig, BeaconDetector
from tests.roof_film import Film

from .table import Row, median_ms

FRAMES = 45


def rows() -> list[Row]:
    """A frame while both beacons stand, one while they are searched for, and the mean over a second of each."""
    film = Film(1, size=(1280, 720), start=(600.0, 350.0), quality=None)
    frames = list(film.frames(FRAMES / film.fps))
    jpeg = bytes(cv2.imencode(".jpg", frames[0][1], (cv2.IMWRITE_JPEG_QUALITY, 75))[1])
    yardstick = median_ms(lambda: decode(jpeg), 20)
    followed, searching = [], []
    detector, blind = BeaconDetector(BeaconConfig()), BeaconDetector(BeaconConfig())
    empty = np.full((720, 1280), 90, np.uint8)
    clock = cv2.getTickCount
    for t, image in frames:
        for one, picture, spent in ((detector, image, followed), (blind, empty, searching)):
            begun = clock()
            one.update(picture, t)
            spent.append(1e3 * (clock() - begun) / cv2.getTickFrequency())
    late = followed[len(followed) // 2 :]
    name = "decode 1280x720 to gray"
    return [
        Row("beacons standing, mean of a 1280x720 frame", float(np.mean(late)), name, yardstick),
        Row("beacons searched for, mean of a frame", float(np.mean(searching)), name, yardstick),
        Row("beacons searched for, the slowest frame", float(np.max(searching)), name, yardstick),
    ]
