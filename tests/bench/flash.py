"""Flash detection."""

from __future__ import annotations

import time

import cv2
import numpy as np

from robotd.vision.blink import FlashConfig, FlashDetector

from .table import Row, median_ms


def rows() -> list[Row]:
    """Streaming flash detection, decisions included, against absdiff + threshold."""
    rng = np.random.default_rng(2)
    still = rng.normal(90, 30, (480, 640))
    frames = [np.clip(still + rng.normal(0, 2, still.shape), 0, 255).astype(np.uint8) for _ in range(60)]
    detector = FlashDetector(FlashConfig())
    step = iter(range(10**9))

    def ours() -> None:
        k = next(step)
        detector.update(frames[k % 60], k / 30)

    def floor() -> None:
        k = next(step)
        cv2.threshold(cv2.absdiff(frames[k % 60], frames[(k + 1) % 60]), 20, 255, cv2.THRESH_BINARY)

    begun = time.perf_counter()
    for _ in range(300):
        ours()
    mean = 1e3 * (time.perf_counter() - begun) / 300  # the mean, because decisions come only now and then
    return [Row("flash detection 640x480", mean, "absdiff + threshold", median_ms(floor, 300))]
