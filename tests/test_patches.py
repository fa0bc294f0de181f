"""Patches around lights: what is kept of a long slot."""

import numpy as np

from robotd.vision.patches import KEPT_BYTES, SIZE, PatchRecorder
from robotd.vision.pattern import FlashPattern


def test_a_long_slot_keeps_its_latest_patches_within_the_bound_and_still_refines_by_them():
    recorder = PatchRecorder(FlashPattern(), 0.010, 2.2)
    image = np.full((120, 160), 90, np.uint8)
    lights = 200
    for light in range(lights):
        recorder.add(20.0 + light % 100, 20.0 + light // 100, image.shape)
    kept = KEPT_BYTES // (lights * SIZE * SIZE)
    lit = image.copy()
    lit[18:23, 18:23] = 200
    start = (kept + 100) / 30.0
    for frame in range(kept + 250):
        t = frame / 30.0
        flashes = FlashPattern().coverage(np.array([t - start]), 0.010, 3)[0] > 0.5
        recorder.record(lit if flashes else image, t)
        assert recorder.kept_bytes <= KEPT_BYTES
    recorder.grow(0, start, 3)
    spot = recorder.spot(0)
    assert spot is not None
    assert abs(spot.u - 20.0) < 0.5
    recorder.forget()
    assert recorder.kept_bytes == 0
