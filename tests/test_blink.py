import tracemalloc
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.vision import blink_reference as reference
from robotd.vision.blink import FlashConfig, FlashDetector, FlashPattern, kernels
from robotd.vision.bursts import BurstScorer
from robotd.vision.patches import PatchRecorder
from robotd.vision.pattern import Template
from robotd.vision.spot import fit_spot, grey_difference, light_table

GAMMA = 2.2
SIZE = (120, 160)
EXPOSURE = 0.010


def to_light(grey):
    return (np.clip(grey, 0, None) / 255.0) ** GAMMA


@dataclass
class Light:
    """A light of the test scene: `amplitude` in grey levels over the background; `share(t)` of an exposure it is on."""

    u: float
    v: float
    amplitude: float
    start: float = 0.0
    periods: float = np.inf
    hertz: float = 0.0
    width: float = 1.1

    def share(self, t):
        x = np.linspace(t, t + EXPOSURE, 11) - self.start
        if self.hertz:
            return np.mean((x * self.hertz) % 1.0 < 0.5)
        phase = x % 1.0
        return np.mean((x >= 0) & (x < self.periods) & (phase < 0.5) & (phase % 0.2 < 0.1))


def film(lights, times, seed=0, noise=2.0, texture=15.0, walker=None, row_time=0.0, size=SIZE):
    """Frames (F, H, W) uint8 of lights before a textured wall; `walker(t)` gives the first column of a passer-by."""
    rng = np.random.default_rng(seed)
    height, width = size
    wall = 90.0 + texture * np.sin(np.arange(width) / 5.0) * np.cos(np.arange(height)[:, None] / 7.0)
    coat = 60.0 + 50.0 * rng.random((height // 2, 24)).repeat(2, axis=0).repeat(1, axis=1)
    v, u = np.mgrid[:height, :width]
    bank = rng.normal(0.0, noise, (height, 3 * width)) if noise else np.zeros((height, 3 * width))
    spots = []
    for light in lights:
        bell = np.exp(-0.5 * ((u - light.u) ** 2 + (v - light.v) ** 2) / light.width**2)
        level = wall[round(light.v), round(light.u)]
        spots.append(bell * (to_light(level + light.amplitude) - to_light(level)))
    frames = []
    for t in times:
        radiance = to_light(wall)
        for light, spot in zip(lights, spots, strict=True):
            radiance = radiance + spot * light.share(t + light.v * row_time)
        grey = 255.0 * radiance ** (1.0 / GAMMA)
        if walker is not None:
            left = int(walker(t))
            begin, end = max(left, 0), min(left + 24, width)
            if begin < end:
                grey[height // 3 : height // 3 + len(coat), begin:end] = coat[
                    : height - height // 3, begin - left : end - left
                ]
        shift = int(rng.integers(2 * width))
        frames.append(np.clip(np.rint(grey + bank[:, shift : shift + width]), 0, 255).astype(np.uint8))
    return frames


def stamps(seconds, fps=30.0, jitter=0.002, drop=0.005, seed=0):
    rng = np.random.default_rng(seed + 99)
    times = np.arange(0.0, seconds, 1.0 / fps)
    return times[rng.random(len(times)) >= drop], jitter, rng


def shoot(lights, seconds, fps=30.0, seed=0, drop=0.005, jitter=0.002, **scene):
    times, jitter, rng = stamps(seconds, fps, jitter, drop, seed)
    measured = times + np.clip(rng.normal(0.0, jitter, len(times)), -0.3 / fps, 0.3 / fps) if jitter else times
    return film(lights, times, seed, **scene), measured


def grid_of_lights(amplitudes, seed=0, **fields):
    rng = np.random.default_rng(seed)
    places = [(u, v) for v in (20, 50, 80, 104) for u in (20, 46, 72, 98, 124)]
    return [
        Light(u + rng.uniform(-1, 1), v + rng.uniform(-1, 1), amplitude, start=-rng.uniform(0, 1), **fields)
        for (u, v), amplitude in zip(places, amplitudes, strict=False)
    ]


def matches(flashes, lights, within=2.0):
    """For each light the flashes that lie on it, and the flashes that lie on none."""
    distance = np.array([[np.hypot(f.u - light.u, f.v - light.v) for f in flashes] for light in lights])
    of_light = [[flashes[k] for k in np.flatnonzero(row < within)] for row in distance.reshape(len(lights), -1)]
    return of_light, [f for k, f in enumerate(flashes) if not (distance[:, k] < within).any()]


# ---- kernels and numerics --------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(st.integers(4, 41), st.integers(4, 53), st.integers(0, 2**32 - 1))
def test_the_accumulation_kernel_equals_its_numpy_reference(rows, columns, seed):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (2 * rows + 1, 2 * columns + 1), dtype=np.uint8)
    lagged = rng.integers(0, 256, (rows + 8, columns + 8), dtype=np.uint8)
    before = rng.integers(-16, 17, (rows, columns), dtype=np.int8)
    tiles = np.column_stack([rng.uniform(50, 90, (6, 1)), rng.uniform(-9, 9, (6, 1)), rng.uniform(50, 90, (6, 3))])
    down, right = rng.integers(-1000, 1000, (2, rows, columns), dtype=np.int16)
    usual = rng.uniform(0.1, 0.9, (3, rng.integers(1, 4), columns)).astype(np.float32)
    for move in ((0, 0), (-8000, 20000)):
        results = []
        for module in (kernels, reference):
            cells = np.zeros((rows + 8, columns + 8), np.uint8)
            difference = np.zeros((rows, columns), np.int8)
            total = np.ones((rows, columns), np.int16)
            module.sum_cells(image, cells, 3, 5)
            module.accumulate(cells, lagged, down, right, *move, difference, before, total, 3)
            moments = np.empty((2, 2, 3), np.float32)
            module.shift_moments(cells, down, right, down, 3, 2, moments)
            sums = np.ones((rows, columns), np.float32)
            rated = np.zeros((rows, columns), np.int8)
            module.rate_block(down, *usual[:2], -60, 120, rated)
            module.add_block(rated, usual[2], sums)
            far = tiles[:, 0] * move[0] + tiles[:, 1] * move[1], tiles[:, 1] * move[0] + tiles[:, 2] * move[1]
            off = np.stack([*far, np.ones(6)], axis=1) * 1e-4 + np.random.default_rng(seed).normal(0.0, 9.0, (6, 3))
            shift = np.array(module.agreed_shift(off.astype(np.float32), tiles))
            results.append((cells, difference, total, rated, sums, shift, moments))
        for left, other in zip(*results, strict=True):
            np.testing.assert_allclose(left, other, rtol=1e-5, atol=4.0 if left.shape == moments.shape else 1e-6)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_light_curves_patches_and_runs_equal_their_numpy_references(seed):
    rng = np.random.default_rng(seed)
    ring = rng.integers(0, 256, (7, 16, 18), dtype=np.uint8)
    order = rng.permutation(7)[:5].astype(np.intp)
    rows, columns = rng.integers(3, 12, 4).astype(np.intp), rng.integers(3, 14, 4).astype(np.intp)
    projection = rng.normal(size=(4, 90)).astype(np.float32)
    squares = (9 + rng.random((4, 90))).astype(np.float32)
    sums = rng.random((4, 3, 90)).astype(np.float32)
    nuisance = rng.normal(size=(4, 3, 90)).astype(np.float32)
    frames = rng.integers(60, 97, 4).astype(np.float32)
    image = rng.integers(0, 256, (30, 40), dtype=np.uint8)
    waves = rng.random((90, 20)).astype(np.float32) * (np.abs(np.arange(20) - np.arange(90)[:, None] / 5.0) < 3.0)
    first = np.argmax(waves > 0.0, axis=1)
    last = 20 - np.argmax(waves[:, ::-1] > 0.0, axis=1)
    weights = (rng.random((4, 90)) < 0.8).astype(np.float32)
    curves = weights * rng.normal(size=(4, 90)).astype(np.float32)
    results = []
    for module in (kernels, reference):
        values, levels = np.empty((2, 4, 5), np.float32)
        module.aperture_series(ring, order, rows, columns, light_table(GAMMA, 256), values, levels)
        patches = np.empty((4, 5, 5), np.uint8)
        module.cut_patches(image, rows, columns, patches)
        gain, light = np.empty((2, 4), np.float32)
        start, periods = np.empty((2, 4), np.intp)
        module.best_runs(projection, sums, squares, 25, frames, 0.01, gain, start, periods, light)
        projected, squared = np.empty((2, 4, 20), np.float32)
        taken = np.empty((4, 3, 20), np.float32)
        module.project_runs(curves, weights, nuisance * weights[:, None], waves, first, last, projected, taken, squared)
        results.append((values, levels, patches, gain, start, periods, light, projected, taken, squared))
    for left, right in zip(*results, strict=True):
        np.testing.assert_allclose(left, right, rtol=2e-5, atol=2e-3)


@settings(deadline=None, max_examples=50)
@given(st.floats(-0.5, 3.5), st.floats(0.001, 0.1), st.integers(1, 3))
def test_coverage_is_the_mean_of_the_pattern_over_the_exposure(since, exposure, periods):
    pattern = FlashPattern(1.2, [(0.0, 0.1), (0.3, 0.5)])
    x = since + exposure * (np.arange(4000) + 0.5) / 4000
    phase = x % 1.2
    on = (x >= 0) & (x < 1.2 * periods) & ((phase < 0.1) | ((phase >= 0.3) & (phase < 0.5)))
    assert pattern.coverage(np.array([since]), exposure, periods)[0] == pytest.approx(on.mean(), abs=2e-3)
    if periods == 1:
        assert Template(pattern, exposure)(np.array([since]))[0] == pytest.approx(
            on.mean(), abs=0.01 + 0.0002 / exposure
        )


@pytest.mark.parametrize("on", [[], [(0.2, 0.1)], [(0.0, 0.3), (0.2, 0.4)], [(0.9, 1.1)], [(-0.1, 0.1)]])
def test_an_impossible_pattern_is_refused_in_words(on):
    with pytest.raises(ValueError, match="increase within the period of"):
        FlashPattern(1.0, on)


@pytest.mark.parametrize("pitch", [1, 2])
def test_the_spot_fit_recovers_an_exact_gaussian_and_ignores_clipped_pixels(pitch):
    v, u = np.mgrid[: 16 // pitch * pitch, : 16 // pitch * pitch]
    image = 40.0 * np.exp(-0.5 * ((u - 7.3) ** 2 + (v - 8.1) ** 2) / 1.2**2) + 3.0
    cells = image.reshape(16 // pitch, pitch, 16 // pitch, pitch).mean(axis=(1, 3))
    valid = np.ones_like(cells, bool)
    if pitch == 1:
        valid = cells < 35.0
        cells = np.minimum(cells, 35.0)
    spot = fit_spot(cells, np.full_like(cells, 0.01), valid, pitch)
    assert spot is not None
    assert (spot.u, spot.v, spot.width, spot.peak) == pytest.approx((7.3, 8.1, 1.2, 40.0), abs=2e-3)


def test_the_spot_fit_scatters_as_its_covariance_says():
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:15, :15]
    clean = 10.0 * np.exp(-0.5 * ((u - 7.3) ** 2 + (v - 6.9) ** 2) / 1.1**2)
    spots = [
        fit_spot(clean + rng.normal(size=clean.shape), np.ones_like(clean), np.ones_like(clean, bool))
        for _ in range(200)
    ]
    errors = np.array([[spot.u - 7.3, spot.v - 6.9] for spot in spots])
    expected = np.mean([spot.sigma for spot in spots])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(expected, rel=0.12)
    assert expected == pytest.approx(np.sqrt(2.0 / np.pi) / 10.0, rel=0.15)  # the Cramer-Rao bound of a Gaussian spot


def test_a_narrow_spot_within_two_by_two_cells_has_a_place():
    places = np.arange(16.0)
    cells = np.outer(*(np.exp(-0.5 * ((places - c) / 0.7) ** 2).reshape(8, 2).mean(axis=1) for c in (7.6, 7.9))) * 30.0
    image = cells + np.random.default_rng(2).normal(0.0, 0.1, cells.shape)
    spot = fit_spot(image, np.full(cells.shape, 0.01), np.ones(cells.shape, bool), pitch=2)
    assert spot is not None
    assert (spot.u, spot.v) == pytest.approx((7.9, 7.6), abs=0.15)
    assert spot.sigma < 0.1


def test_no_spot_is_fitted_to_noise_or_to_an_edge():
    rng = np.random.default_rng(2)
    assert (
        fit_spot(-np.abs(rng.normal(size=(15, 15))) - np.eye(15), np.ones((15, 15)), np.zeros((15, 15), bool)) is None
    )
    edge = np.where(np.arange(15)[:, None] > 7, 10.0, 0.0) * np.ones((15, 15))
    spot = fit_spot(edge, np.ones((15, 15)), np.ones((15, 15), bool))
    assert spot is None or spot.width > 2.5


def test_grey_difference_undoes_the_light_table():
    table = light_table(GAMMA, 256)
    assert grey_difference(float(table[90]), float(table[130] - table[90]), GAMMA) == pytest.approx(40.0, abs=1e-3)


# ---- detection -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def busy():
    """Four seconds: 18 labels from 6 to 150 grey levels, a 2 Hz blinker, a passer-by, jitter and dropped frames."""
    labels = grid_of_lights(np.geomspace(6, 150, 18), seed=3)
    blinker = Light(124.0, 104.0, 60.0, hertz=2.0)
    frames, times = shoot([*labels, blinker], 4.0, seed=3, walker=lambda t: 40.0 * t - 20.0, drop=0.02)
    return labels, frames, times


def test_labels_are_found_and_neither_a_blinker_nor_a_passer_by_is(busy):
    labels, frames, times = busy
    flashes = FlashDetector().detect(frames, times)
    found, others = matches(flashes, labels)
    assert not others
    assert sum(map(bool, found)) >= 17
    assert all(len(candidates) <= 1 for candidates in found)
    assert [flash.score for flash in flashes] == sorted((flash.score for flash in flashes), reverse=True)


def test_detect_resets_and_streaming_gives_the_same(busy):
    _, frames, times = busy
    detector = FlashDetector()
    first = detector.detect(frames, times)
    assert detector.detect(frames, times) == first
    detector.reset()
    for frame, t in zip(frames, times, strict=True):
        detector.update(frame, float(t))
    streamed = {(round(f.u), round(f.v)) for f in detector.flashes()}
    assert streamed <= {(round(f.u), round(f.v)) for f in first}
    assert len(streamed) >= len(first) - 1
    assert detector.detect([], []) == []


def test_the_numpy_kernels_find_the_same(busy, monkeypatch):
    _, frames, times = busy
    compiled = FlashDetector().detect(frames[:75], times[:75])
    for module in ("blink", "matching", "shake"):
        monkeypatch.setattr(f"robotd.vision.{module}.kernels", reference)
    plain = FlashDetector().detect(frames[:75], times[:75])
    assert len(plain) == len(compiled)
    for left, right in zip(plain, compiled, strict=True):
        assert (left.u, left.v, left.score) == pytest.approx((right.u, right.v, right.score), abs=1e-2)


def test_positions_reach_their_stated_sigma_and_twice_the_cramer_rao_bound():
    amplitude = 12.0
    errors, sigmas = [], []
    for seed in range(2):
        labels = grid_of_lights(np.full(20, amplitude), seed=seed)
        found, _ = matches(FlashDetector().detect(*shoot(labels, 4.0, seed=seed, texture=5.0)), labels)
        for label, flashes in zip(labels, found, strict=True):
            assert len(flashes) == 1
            errors += [flashes[0].u - label.u, flashes[0].v - label.v]
            sigmas.append(flashes[0].sigma)
            assert flashes[0].amplitude == pytest.approx(amplitude, rel=0.35)
    rms = np.sqrt(np.mean(np.square(errors)))
    bound = 2.0 * np.sqrt(2.0 / np.pi) / amplitude / np.sqrt(120 * 0.21)
    assert rms < 2.0 * bound
    assert rms / np.mean(sigmas) == pytest.approx(1.0, abs=0.35)


def test_a_strong_light_that_is_steep_within_a_cell_is_placed_without_bias():
    labels = grid_of_lights(np.full(20, 102.0))
    found, _ = matches(FlashDetector().detect(*shoot(labels, 4.0, texture=5.0)), labels)
    errors = [(flash.u - label.u, flash.v - label.v) for label, (flash,) in zip(labels, found, strict=True)]
    assert np.sqrt(np.mean(np.square(errors))) <= 0.006  # the Cramer-Rao bound is 0.003


def test_a_flash_of_three_seconds_is_found_wherever_it_falls_in_the_slot():
    rng = np.random.default_rng(5)
    labels = grid_of_lights(np.full(20, 14.0), seed=5, periods=3)
    for label in labels:
        label.start = rng.uniform(0.0, 8.9)
    found, others = matches(FlashDetector().detect(*shoot(labels, 12.0, seed=5)), labels)
    assert not others
    assert all(len(flashes) == 1 for flashes in found)
    for label, flashes in zip(labels, found, strict=True):
        late = (flashes[0].phase - label.start + 0.5) % 1.0 - 0.5
        assert abs(late) < 0.025


def test_continuous_flashing_is_found_at_ten_frames_a_second_with_irregular_stamps():
    labels = grid_of_lights(np.full(15, 30.0), seed=6)
    rng = np.random.default_rng(6)
    times = np.cumsum(rng.uniform(0.06, 0.12, 170))
    found, others = matches(FlashDetector().detect(film(labels, times, seed=6), times), labels)
    assert not others
    assert sum(map(bool, found)) >= 14


def test_another_pattern_and_period_is_found_as_well():
    pattern = FlashPattern(1.2, [(0.0, 0.15), (0.4, 0.55)])
    times = np.arange(0.0, 6.0, 1 / 30)
    light = Light(70.3, 60.8, 30.0)
    light.share = lambda t: float(pattern.coverage(np.array([(t - 0.3) % 1.2]), EXPOSURE)[0])
    flashes = FlashDetector(FlashConfig(pattern=pattern)).detect(film([light], times), times)
    assert len(flashes) == 1
    assert (flashes[0].u, flashes[0].v) == pytest.approx((70.3, 60.8), abs=0.1)
    assert flashes[0].phase == pytest.approx(0.3, abs=0.03)


def test_a_rolling_shutter_is_undone_in_the_phase():
    row_time = 0.03 / SIZE[0]
    labels = [Light(40.0, 12.0, 60.0, start=-0.5), Light(100.0, 106.0, 60.0, start=-0.5)]
    frames, times = shoot(labels, 4.0, drop=0.0, jitter=0.0, row_time=row_time)
    flashes = FlashDetector(FlashConfig(row_time_s=row_time, max_reflection=1.0)).detect(frames, times)
    assert [flash.phase for flash in flashes] == pytest.approx([0.5, 0.5], abs=0.02)


def test_a_light_that_clips_the_sensor_says_so_and_keeps_its_place():
    labels = [Light(60.4, 50.3, 900.0, start=-0.3, width=1.4), Light(120.2, 70.7, 40.0, start=-0.6)]
    flashes = FlashDetector().detect(*shoot(labels, 4.0))
    found, others = matches(flashes, labels)
    assert not others
    assert found[0][0].saturated
    assert not found[1][0].saturated
    assert np.hypot(found[0][0].u - 60.4, found[0][0].v - 50.3) < 0.3


@pytest.mark.parametrize("hertz", [1.0, 2.5, 3.3])
def test_steady_blinking_at_any_rate_is_no_label_whenever_one_looks(hertz):
    blinkers = grid_of_lights(np.full(20, 60.0), seed=4)
    for light in blinkers:
        light.share = lambda t, light=light: float(((t - light.start) * hertz) % 1.0 < 0.32)
    detector, seen = FlashDetector(), []
    for frame, t in zip(*shoot(blinkers, 4.0, seed=4), strict=True):
        if detector.update(frame, float(t)):
            seen += detector.flashes()
    assert seen == []


def test_a_light_twelve_pixels_wide_is_found_once():
    label = Light(80.3, 60.4, 40.0, start=-0.4, width=3.4)
    flashes = FlashDetector().detect(*shoot([label], 3.0))
    assert len(flashes) == 1
    assert np.hypot(flashes[0].u - label.u, flashes[0].v - label.v) < 0.15


def test_a_step_of_the_exposure_loses_no_light_that_was_found():
    labels = grid_of_lights(np.full(12, 14.0), seed=8)
    frames, times = shoot(labels, 4.0, seed=8, texture=30.0)
    brighter = [
        frame if t < 2.2 else np.clip(1.1 * frame, 0, 255).astype(np.uint8)
        for frame, t in zip(frames, times, strict=True)
    ]
    before, after = FlashDetector().detect(frames[:66], times[:66]), FlashDetector().detect(brighter, times)
    found = [bool(flashes) for flashes in matches(before, labels)[0]]
    kept = [bool(flashes) for flashes in matches(after, labels)[0]]
    assert sum(found) >= 9
    assert all(late for early, late in zip(found, kept, strict=True) if early)


def test_a_detector_keeps_within_nine_megabytes():
    pytest.importorskip("robotd.vision._blink", reason="the numpy reference makes copies")
    rng = np.random.default_rng(0)
    frames = rng.integers(60, 120, (4, 480, 640), dtype=np.uint8)
    FlashDetector().detect(frames[rng.integers(4, size=60)], np.arange(60) / 30.0)  # loads what is loaded once
    order = rng.integers(4, size=110)
    tracemalloc.start()
    try:
        FlashDetector().detect((frames[k] for k in order), np.arange(110) / 30.0)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak <= 9e6


def test_a_still_noisy_wall_has_no_flashes():
    assert FlashDetector().detect(*shoot([], 5.0, noise=3.0)) == []


def test_frames_that_cannot_belong_to_the_stream_are_refused():
    detector = FlashDetector()
    with pytest.raises(ValueError, match="uint8"):
        detector.update(np.zeros((48, 64)), 0.0)
    detector.update(np.zeros((48, 64), np.uint8), 0.0)
    with pytest.raises(ValueError, match="increase"):
        detector.update(np.zeros((48, 64), np.uint8), 0.0)
    with pytest.raises(ValueError, match="reset"):
        detector.update(np.zeros((64, 64), np.uint8), 1.0)


def test_frames_faster_than_needed_are_thinned_without_loss():
    label = Light(70.0, 60.0, 25.0, start=-0.2)
    flashes = FlashDetector().detect(*shoot([label], 3.0, fps=90.0, jitter=0.0))
    assert len(flashes) == 1
    assert np.hypot(flashes[0].u - label.u, flashes[0].v - label.v) < 0.15


# ---- known lights ----------------------------------------------------------------------------------------------------


def scored(values, times, light=20.0):
    scorer = BurstScorer(FlashPattern(), EXPOSURE)
    levels = np.full(values.shape, 30.0, np.float32)
    strength, variance = np.full(len(values), light), np.full(len(values), 1.0)
    for end in range(60, len(times) + 1, 15):
        chunk = slice(max(0, end - 90), end)
        scorer.extend(times[chunk], values[:, chunk], levels[:, chunk], strength, variance)
    return scorer, strength, variance


@settings(deadline=None, max_examples=30)
@given(st.floats(2.0, 4.0), st.integers(2, 8), st.integers(0, 1000))
def test_the_number_of_periods_is_read_from_the_light_curve(start, periods, seed):
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 14.0, 1 / 30) + rng.normal(0.0, 0.002, 420)
    clean = 20.0 * FlashPattern().coverage(times - start, EXPOSURE, periods)
    values = (clean + rng.normal(size=len(times))).astype(np.float32)[None]
    scorer, light, variance = scored(values, times)
    durations = (2, 3, 4, 5, 6, 7, 8)
    runs = scorer.runs(1.0, 14.0, durations, light, variance)
    best = int(np.argmax(runs.score[0]))
    assert durations[best] == periods
    assert runs.start[0, best] == pytest.approx(start, abs=0.03)
    assert runs.score[0, best] > np.sort(runs.score[0])[-2] + 6.0
    assert -0.5 < scorer.active_first[0] - start < 0.1
    assert -0.1 < scorer.active_last[0] - (start + periods - 1) < 0.5


def test_a_late_answer_to_the_slot_before_does_not_hide_the_flash_that_was_asked_for():
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 14.0, 1 / 30)
    pattern = FlashPattern()
    clean = 20.0 * (pattern.coverage(times - 2.3, EXPOSURE, 3) + pattern.coverage(times - 9.1, EXPOSURE, 2))
    scorer, light, variance = scored((clean + rng.normal(size=len(times))).astype(np.float32)[None], times)
    runs = scorer.runs(2.0, 14.0, (2, 3, 4, 5), light, variance)
    assert np.argmax(runs.score[0]) == 0
    assert runs.start[0, 0] == pytest.approx(9.1, abs=0.03)


def test_a_dark_light_is_unlikely_to_have_flashed_and_a_hidden_one_undecided():
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 12.0, 1 / 30)
    dark = rng.normal(size=(1, len(times))).astype(np.float32)
    scorer, light, variance = scored(dark, times)
    assert scorer.runs(1.0, 12.0, (2, 5), light, variance).score.max() < -10.0
    hidden = BurstScorer(FlashPattern(), EXPOSURE)
    levels = np.where((times > 4.0) & (times < 6.0), 60.0, 30.0).astype(np.float32)[None]
    clean = 20.0 * FlashPattern().coverage(times - 3.0, EXPOSURE, 4) * (levels[0] < 40.0)
    hidden.extend(times, (clean + dark).astype(np.float32), levels, light, variance)
    score = hidden.runs(1.0, 12.0, (2, 3, 4, 5), light, variance).score[0]
    assert np.argmax(score) == 2  # seconds 1 and 4 were seen, 2 and 3 hidden


def test_patches_refine_a_position_flash_by_flash():
    light = Light(70.37, 60.81, 8.0, start=0.5, periods=3)
    recorder = PatchRecorder(FlashPattern(), EXPOSURE, GAMMA)
    recorder.add(70.0, 61.0, SIZE)
    sigmas = []
    for seed in range(3):
        frames, times = shoot([light], 4.5, drop=0.0, seed=seed)
        for frame, t in zip(frames, times, strict=True):
            recorder.record(frame, t)
        recorder.grow(0, 0.5, 3)
        recorder.forget()
        spot = recorder.spot(0)
        sigmas.append(spot.sigma)
    assert (spot.u, spot.v) == pytest.approx((70.37, 60.81), abs=0.2)
    assert sigmas[2] == pytest.approx(sigmas[0] / np.sqrt(3.0), rel=0.25)
