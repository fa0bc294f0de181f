"""Flash detection."""

from __future__ import annotations

import time

import cv2
import numpy as np

from robotd.vision.blink import FlashConfig, FlashDetector

from .table import Row, median_ms

FRAMES = 450


def rows() -> list[Row]:
    """Flash detection at 30 frames a second: a frame, and decisions included, against absdiff + threshold."""
    rng = np.random.default_rng(2)
    still = rng.normal(90, 30, (480, 640))
    dark = [np.clip(still + rng.normal(0, 2, still.shape), 0, 255).astype(np.uint8) for _ in range(30)]
    x = np.arange(-3.0, 4.0)
    bell = np.exp(-0.4 * (x[:, None] ** 2 + x**2))
    lit = [frame.copy() for frame in dark]
    for frame in lit:  # twelve labels
        for row, column in ((r, c) for r in range(40, 480, 120) for c in range(100, 640, 200)):
            part = frame[row - 3 : row + 4, column - 3 : column + 4]
            part[:] = np.minimum(part + 60.0 * bell, 255.0)
    # at random, because noise that repeats would be a pattern too
    frames = [(lit if k % 30 < 15 and k % 6 < 3 else dark)[rng.integers(30)] for k in range(FRAMES)]
    detector = FlashDetector(FlashConfig())
    streaming, used = [], time.process_time()
    for k, frame in enumerate(frames):
        begun = time.perf_counter()
        decided = detector.update(frame, k / 30)
        spent = time.perf_counter() - begun
        if not decided:
            streaming.append(spent)
    used = time.process_time() - used  # because the mean counts what other programs take away, too
    step = iter(range(10**9))

    def floor() -> None:
        k = next(step)
        cv2.threshold(cv2.absdiff(frames[k % 60], frames[(k + 1) % 60]), 20, 255, cv2.THRESH_BINARY)

    floor_ms = median_ms(floor, 300)
    return [
        Row("flash detection 640x480, a frame", 1e3 * float(np.median(streaming)), "absdiff + threshold", floor_ms),
        Row("  its decisions included, mean", 1e3 * used / FRAMES, "absdiff + threshold", floor_ms),
    ]
