"""Patterns learnt from a film, the thesis's detector, reflections, and a camera that shakes."""

import tomllib

import numpy as np
import pytest

from robotd.bind import bind
from robotd.errors import InputError
from robotd.vision.blink import FlashConfig, FlashDetector, FlashPattern
from robotd.vision.learn_pattern import learn_pattern, learn_trace
from robotd.vision.matching import Matcher
from robotd.vision.mirror import Lamp, reflected
from robotd.vision.pattern import Look
from robotd.vision.shake import Shake, kernels
from robotd.vision.thesis_blink import ThesisFlashConfig, ThesisFlashDetector, cost, periods_of
from robotd.workbench.score import Score, judge
from tests.flashes.film import add, frames
from tests.flashes.scenes import Light, Options, scene
from tests.flashes.world import light_of, shelves

SMALL = (192, 144)
NO_SHIFT = np.zeros((60, 2))


PATTERNS = (
    FlashPattern(),
    FlashPattern(1.0, [(0.0, 0.1), (0.2, 0.3)]),
    FlashPattern(1.2, [(0.0, 0.1), (0.2, 0.3), (0.4, 0.5), (0.6, 0.7)]),
    FlashPattern(1.0, [(0.0, 0.03), (0.2, 0.23), (0.4, 0.43)]),
    FlashPattern(2.0, [(0.0, 0.2)]),
)


def light_curve(pattern, seconds=10.0, fps=30.0, noise=0.05, seed=0, lit=(0.0, np.inf)):
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 1.0 / fps) + rng.uniform(0.0, 1.0)
    since = times - rng.uniform(0.0, pattern.period)
    share = np.where((times > lit[0]) & (times < lit[1]), pattern.coverage(since % pattern.period, 0.01, 2), 0.0)
    return times + np.clip(rng.normal(0.0, 0.001, len(times)), -0.004, 0.004), share + noise * rng.normal(
        size=len(times)
    )


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_pattern_is_learnt_from_a_light_curve_to_its_stated_uncertainty(pattern, seed):
    learnt = learn_trace(*light_curve(pattern, seed=seed))
    assert learnt.confidence > 0.99
    assert learnt.pattern.period == pytest.approx(pattern.period, abs=0.004)
    assert len(learnt.pattern.on) == len(pattern.on)
    assert learnt.edge_sigma < 0.012
    # a frame's dark gap of 23 ms hides every edge of a pattern that repeats with whole frames
    assert np.abs(np.array(learnt.pattern.on) - pattern.on).max() < 4.0 * learnt.edge_sigma


def test_flashes_that_drift_from_between_two_exposures_into_one_are_learnt_together():
    rng = np.random.default_rng(0)
    times = 0.0155 + np.arange(300) / 30.0
    share = PATTERNS[3].coverage((times - 0.3894) * 0.99956 % 1.0, 0.01, 2)
    stamps = times + np.clip(rng.normal(0.0, 0.001, len(times)), -0.004, 0.004)
    learnt = learn_trace(stamps, share + 0.05 * rng.normal(size=len(times))).pattern
    assert learnt.period == pytest.approx(1.00044, abs=0.0006)
    assert np.array(learnt.on) == pytest.approx(np.array(PATTERNS[3].on), abs=0.006)


def test_short_weak_flashes_are_learnt_though_noise_has_much_of_the_energy():
    times, light = light_curve(PATTERNS[3], noise=0.19, seed=3)
    learnt = learn_trace(times, light)
    assert learnt.pattern.period == pytest.approx(1.0, abs=0.003)
    assert np.array(learnt.pattern.on) == pytest.approx(np.array(PATTERNS[3].on), abs=0.015)


def test_the_dark_before_and_after_the_flashes_does_not_matter():
    learnt = learn_trace(*light_curve(FlashPattern(), 14.0, seed=3, lit=(4.0, 10.0)))
    assert learnt.pattern.period == pytest.approx(1.0, abs=0.01)
    assert len(learnt.pattern.on) == 3
    assert 5 <= learnt.cycles <= 7


@pytest.mark.parametrize("pattern", PATTERNS[:4])
def test_two_seconds_hold_enough_of_a_pattern_wherever_it_starts(pattern):
    times = 0.004 + np.arange(60) / 30.0
    starts = np.arange(0.0, pattern.period, 0.02)
    light = np.array([pattern.coverage((times - start) % pattern.period, 0.01, 2) for start in starts])
    light += 0.05 * np.random.default_rng(0).normal(size=light.shape)
    found = Matcher(pattern, 0.01, (0.6, 10.0)).match(
        times, light.astype(np.float32), np.full(light.shape, 30.0, np.float32), np.zeros((len(times), 2))
    )
    assert found.regular.all()
    assert found.score.min() > 25.0


def test_what_was_learnt_is_a_setting():
    learnt = learn_trace(*light_curve(FlashPattern(), seed=1))
    settings = tomllib.loads(learnt.toml())
    assert bind(FlashPattern, settings["pattern"], "robotd.toml [mission.identify] pattern") == FlashPattern(
        round(learnt.pattern.period, 5), tuple((round(a, 4), round(b, 4)) for a, b in learnt.pattern.on)
    )


def test_a_pattern_that_changes_half_way_is_refused():
    before, after = light_curve(PATTERNS[0], 6.0), light_curve(PATTERNS[1], 6.0)
    times = np.concatenate([before[0], before[0][-1] + 1 / 30 + after[0] - after[0][0]])
    with pytest.raises(InputError, match=r"contradicts itself|does not repeat|not as flashes"):
        learn_trace(times, np.concatenate([before[1], after[1]]))


@pytest.mark.parametrize("seed", range(6))
def test_noise_has_no_pattern(seed):
    rng = np.random.default_rng(seed)
    with pytest.raises(InputError):
        learn_trace(np.arange(300) / 30.0, rng.normal(size=300))


def test_a_pattern_is_learnt_from_a_film_of_one_label():
    options = Options(PATTERNS[2], SMALL, seconds=8.0, crowd=0.0)
    shown = scene(1, 0, options)
    film, stamps = frames(shown)
    learnt = learn_pattern(film, stamps)
    assert learnt.pattern.period == pytest.approx(1.2, abs=0.004)
    assert np.allclose(learnt.pattern.on, PATTERNS[2].on, atol=4.0 * learnt.edge_sigma)
    assert np.hypot(learnt.u - shown.labels[0].u, learnt.v - shown.labels[0].v) < 3.0


def test_two_lights_that_flash_differently_are_named_and_one_can_be_chosen():
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 6.0, 1 / 30)
    film = rng.normal(90.0, 1.5, (len(times), 96, 128))
    for pattern, row, column in ((PATTERNS[0], 30, 40), (PATTERNS[1], 60, 90)):
        film[:, row : row + 3, column : column + 3] += 60.0 * pattern.coverage(times % 1.0, 0.01, 2)[:, None, None]
    film = film.astype(np.uint8)
    with pytest.raises(InputError, match=r"two things flash differently: . flashes in [01]\.\d+ s at pixel"):
        learn_pattern(film, times)
    assert len(learn_pattern(film, times, near=(91.0, 61.0)).pattern.on) == 2


def test_a_screen_that_flickers_leaves_room_for_a_dim_label():
    rng = np.random.default_rng(5)
    times = np.arange(180) / 30.0
    film = np.full((180, 144, 192), 90, np.uint8)
    film[:, 10:70, 20:150] = rng.integers(60, 200, 180)[:, None, None]  # of 300 places in it each varies more
    share = FlashPattern().coverage((times - 0.31) % 1.0, 0.01, 2)
    film[:, 120:122, 100:102] += (50.0 * share).astype(np.uint8)[:, None, None]
    noisy = np.clip(film + rng.normal(0.0, 2.0, film.shape), 0, 255).astype(np.uint8)
    learnt = learn_pattern(noisy, times)
    assert (learnt.u, learnt.v) == pytest.approx((100.5, 120.5), abs=2.0)
    assert len(learnt.pattern.on) == 3


def test_nothing_is_learnt_where_nothing_repeats():
    rng = np.random.default_rng(0)
    noise = rng.normal(90.0, 3.0, (120, 48, 64)).astype(np.uint8)
    with pytest.raises(InputError, match="nothing in the recording flashes"):
        learn_pattern(noise, np.arange(120) / 30.0)
    with pytest.raises(InputError, match="record longer"):
        learn_pattern(noise[:8], np.arange(8) / 30.0)
    with pytest.raises(InputError, match="time stamps"):
        learn_pattern(noise[:100], np.arange(120) / 30.0)


def test_the_cost_is_zero_on_a_period_and_limited_elsewhere():
    assert periods_of(FlashPattern()) == (0.2, 0.6, 1.0)
    assert np.allclose(cost(np.array([0.2, 0.6, 1.0, 5.0, 0.1]), (0.2, 0.6, 1.0)), [0.0, 0.0, 0.0, 1.0, 1.0])


def look(start, sigma, t=1.0):
    away = 0.0015 * np.arange(-40, 41)
    return Look(t, start + away[0], 0.0015, -0.5 * (away / sigma) ** 2)


def lamps_of(*looks):
    """Lights in a slanted row."""
    return [
        Lamp([look(start, 0.003)], peak, width, 100.0 + 60.0 * k, 100.0 + 40.0 * k)
        for k, (start, peak, width) in enumerate(looks)
    ]


def test_a_dim_and_blurred_light_of_the_same_phase_is_a_reflection():
    probability = reflected(lamps_of((0.3, 100.0, 1.0), (0.301, 40.0, 1.3), (0.7, 50.0, 1.2)), 1.0)
    assert probability[1] > 0.8
    assert max(probability[0], probability[2]) < 0.2


def test_a_chance_match_far_off_is_no_reflection_and_one_straight_below_is():
    looks = [look(0.75, 0.006)], [look(0.744, 0.006)]

    def doubt(u, v):
        others = [Lamp([look(start, 0.006)], 60.0, 1.1, 300.0, 100.0) for start in (0.1, 0.4)]
        lamps = [Lamp(looks[0], 94.0, 1.0, 300.0, 60.0), Lamp(looks[1], 5.0, 1.4, u, v), *others]
        return reflected(lamps, 1.0)[1]

    assert doubt(302.0, 140.0) > 0.7
    assert doubt(30.0, 200.0) < 0.4


def test_of_two_equal_lights_of_one_phase_neither_is_called_the_reflection():
    assert max(reflected(lamps_of((0.3, 50.0, 1.1), (0.301, 50.0, 1.1)), 1.0)) < 0.5


def between_exposures(start, t):
    """A look at a light of which only is known between which two exposures it begins."""
    away = 0.0015 * np.arange(-20, 21)
    first = start - (start % 0.0333)
    return Look(
        t, start + away[0], 0.0015, np.where((start + away > first) & (start + away < first + 0.023), 0.0, -50.0)
    )


def test_lights_that_drift_apart_are_two_labels():
    times = np.arange(1.6, 16.0, 2.4)

    def doubt(drift):
        looks = [[between_exposures(0.306 + c * t, t) for t in times] for c in (0.0, drift)]
        lamps = [Lamp(looks[0], 94.0, 1.0, 300.0, 60.0), Lamp(looks[1], 30.0, 1.3, 302.0, 140.0)]
        return reflected(lamps, 1.0)[1]

    assert doubt(0.0) > 0.7
    assert doubt(-8e-4) < 0.4


def test_a_reflection_many_rows_below_is_seen_at_another_time_by_a_rolling_shutter():
    def doubt(delay):
        lamps = [
            Lamp([look(0.3, 0.002)], 94.0, 1.0, 300.0, 60.0),
            Lamp([look(0.284, 0.002)], 30.0, 1.3, 302.0, 400.0, delay),
        ]
        return reflected(lamps, 1.0)[1]

    assert doubt(0.016) > 0.7
    assert doubt(0.0) < 0.2


def test_without_a_fine_phase_nothing_is_called_a_reflection():
    coarse = [Lamp([look(0.3, 0.03)], peak, 1.0, 100.0, row) for peak, row in ((100.0, 50.0), (20.0, 90.0))]
    assert max(reflected(coarse, 1.0)) == 0.0
    assert len(reflected([], 1.0)) == 0


def shaken_film(shifts, rng):
    wall = light_of(shelves(rng, (168, 216)), 2.2)
    label = Light(60.3, 70.6, 1.1, 0.3, lambda t, _: float(t % 1.0 < 0.5 and t % 0.2 < 0.1))
    columns, rows = np.fft.fftfreq(216), np.fft.fftfreq(168)[:, None]
    spectrum = np.fft.fft2(wall)
    for k, shift in enumerate(shifts):
        moved = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * (columns * shift[0] + rows * shift[1]))).real
        light = moved[12:-12, 12:-12].astype(np.float32)
        add(light, label, shift, label.share(k / 30.0, 0.01))
        grey = 255.0 * np.clip(light, 0.0, 1.0) ** (1.0 / 2.2) + rng.normal(0.0, 1.5, light.shape)
        yield np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def test_a_shaking_camera_is_measured_and_does_not_hide_a_label():
    rng = np.random.default_rng(3)
    t = np.arange(120) / 30.0
    shifts = 0.4 * np.stack([np.sin(2 * np.pi * 3.1 * t), np.cos(2 * np.pi * 4.3 * t) - 1.0], axis=1)
    film = list(shaken_film(shifts, rng))
    shake = Shake(3)
    shake.refer(film[0], np.zeros(2))
    cells = np.zeros((film[0].shape[0] // 2 + 8, film[0].shape[1] // 2 + 8), np.uint8)
    found = []
    for frame in film:
        kernels.sum_cells(frame, cells, 3, 5)
        found.append(shake.measure(cells))
    assert np.sqrt(np.mean((np.array(found) - shifts) ** 2)) < 0.05
    flashes = FlashDetector().detect(film, t)
    assert len(flashes) == 1
    assert np.hypot(flashes[0].u - 60.3 - shifts[:, 0].mean(), flashes[0].v - 70.6 - shifts[:, 1].mean()) < 0.15


def test_lamps_that_flicker_are_measured_and_taken_off():
    rng = np.random.default_rng(4)
    wall = shelves(rng, (144, 192))
    shake = Shake(3)
    cells = np.zeros((80, 104), np.uint8)
    first = np.rint(wall).astype(np.uint8)
    shake.refer(first, np.zeros(2))
    kernels.sum_cells(np.rint(1.03 * wall).astype(np.uint8), cells, 3, 5)
    assert not shake.measure(cells).any()
    assert shake.brightness == pytest.approx(0.03, abs=0.002)

    pattern, times = PATTERNS[3], 0.004 + np.arange(90) / 30.0
    flicker = 0.05 * np.cos(2.0 * np.pi * 10.02 * times)[None].astype(np.float32)  # 50 Hz mains, at 30 fps
    label = 10.0 * pattern.coverage((times - 0.3) % 1.0, 0.01, 2) + 0.5 * rng.normal(size=len(times))
    curve = (label - 150.0 * (1.0 + 0.8 * flicker)).astype(np.float32)  # a dark place in bright surroundings
    levels = (50.0 * (1.0 + 0.8 * flicker) + 0.1 * rng.normal(size=flicker.shape)).astype(np.float32)
    matcher, still = Matcher(pattern, 0.01, (0.6, 10.0)), np.zeros((len(times), 2))
    steadied = matcher.match(times, curve, levels, still, flicker)
    assert steadied.score[0] > 2.0 * matcher.match(times, curve, levels, still).score[0]
    assert steadied.regular.all()


def test_people_who_were_in_the_first_picture_are_not_taken_for_edges_for_ever():
    rng = np.random.default_rng(5)
    wall = shelves(rng, (144, 192))
    crowded = wall.copy()
    crowded[40:140, 60:100] = 30.0
    shake, empty = Shake(3), Shake(3)
    shake.refer(np.rint(crowded).astype(np.uint8), np.zeros(2))
    empty.refer(np.rint(wall).astype(np.uint8), np.zeros(2))
    assert np.any(shake.right != empty.right)
    shake.look(np.rint(wall).astype(np.uint8))
    assert np.array_equal(shake.right, empty.right)
    assert np.array_equal(shake.down, empty.down)


@pytest.mark.parametrize("place", [(2.2, 70.4), (189.3, 70.4), (90.4, 2.3), (90.4, 141.2)])
def test_a_label_at_the_border_is_found(place):
    rng = np.random.default_rng(1)
    label = Light(*place, 1.1, 0.2, lambda t, _: float(t % 1.0 < 0.5 and t % 0.2 < 0.1))
    wall = light_of(shelves(rng, (144, 192)), 2.2)
    film = []
    for k in range(100):
        light = wall.copy()
        add(light, label, np.zeros(2), label.share(k / 30.0, 0.01))
        grey = 255.0 * light ** (1.0 / 2.2) + rng.normal(0.0, 1.5, light.shape)
        film.append(np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    flashes = FlashDetector().detect(film, np.arange(100) / 30.0)
    assert len(flashes) == 1
    assert np.hypot(flashes[0].u - place[0], flashes[0].v - place[1]) < 0.3
    (uu, uv, vv) = flashes[0].covariance
    assert uu * vv > uv**2
    assert flashes[0].sigma == pytest.approx(np.sqrt(0.5 * (uu + vv)))


def test_a_stricter_false_alarm_rate_asks_for_more():
    loose, strict = (FlashConfig(false_alarms_per_hour=rate).min_score((480, 640)) for rate in (10.0, 0.01))
    assert strict - loose == pytest.approx(np.log(1000.0))


def test_ours_finds_more_than_the_thesis_and_less_that_is_not_there():
    options = Options(size=(320, 240), seconds=4.0, crowd=0.0)
    ours, theirs = Score(), Score()
    for number in (5, 10):
        shown = scene(number, 1, options)
        film, stamps = frames(shown)
        film = list(film)
        ours.add(FlashDetector().detect(film, stamps), shown.labels, shown.mirrored)
        found = ThesisFlashDetector(ThesisFlashConfig(min_edges=4)).detect(film, stamps)
        theirs.add(found, shown.labels, shown.mirrored)
    assert ours.found >= 7
    assert ours.found > theirs.found > 0
    assert ours.precision >= theirs.precision


@pytest.mark.parametrize(("reflections", "seconds"), [(False, 2.1), (True, 4.0)])
def test_labels_of_the_thesis_s_table_are_found_in_two_seconds_and_their_reflections_are_not(reflections, seconds):
    score = Score()
    for number in (10, 13):
        shown = scene(number, 1, Options(seconds=seconds, reflections=reflections))
        film, stamps = frames(shown)
        score.add(FlashDetector().detect(film, stamps), shown.labels, shown.mirrored)
    swapped = 1 if reflections else 0  # a reflection may look like the lamp, and the lamp like its reflection
    assert score.labels == 8
    assert score.found >= 8 - swapped
    assert score.false <= swapped
    assert score.rms_px <= 0.06


def missed(number, seed, pattern):
    """Labels that two seconds of a film do not show to the detector, and the number of false ones."""
    shown = scene(number, seed, Options(pattern=pattern, seconds=2.0))
    flashes = FlashDetector(FlashConfig(pattern=pattern)).detect(*frames(shown))
    verdict = judge(flashes, shown.labels, shown.mirrored)
    return verdict.missed, len(verdict.false)


def test_short_flashes_are_found_while_two_people_walk_past():
    assert missed(11, 304, PATTERNS[3]) == ((), 0)


def test_one_whole_period_is_enough_where_people_hide_the_others():
    assert missed(13, 302, PATTERNS[0]) == ((), 0)


def test_one_burst_of_light_is_no_period_of_three_flashes():
    times = np.arange(60) / 30.0
    values = 2.0 * np.random.default_rng(0).normal(size=(2, 60)).astype(np.float32)
    values[0] += 60.0 * PATTERNS[0].coverage(times - 0.7, 0.01)
    values[1, [21, 27, 33]] += (20.0, 90.0, 20.0)
    matches = Matcher(PATTERNS[3], 0.01, (0.6, 10.0)).match(times, values[1:], np.ones((1, 60), np.float32), NO_SHIFT)
    assert not matches.regular[0]
    matches = Matcher(PATTERNS[0], 0.01, (0.6, 10.0)).match(times, values[:1], np.ones((1, 60), np.float32), NO_SHIFT)
    assert matches.regular[0]
    assert matches.start[0] % 1.0 == pytest.approx(0.7, abs=0.025)


def test_short_flashes_that_leave_much_open_are_taken_as_alike():
    options = Options(PATTERNS[3], seconds=10.0, crowd=0.0)
    shown = scene(1, 259, options)
    near = shown.labels[0].u, shown.labels[0].v
    learnt = learn_pattern(*frames(shown), exposure=shown.exposure, near=near).pattern
    assert learnt.period == pytest.approx(1.0, abs=1e-3)
    assert np.ptp([end - start for start, end in learnt.on]) <= 1e-3
    assert [start for start, _ in learnt.on] == pytest.approx([0.0, 0.2, 0.4], abs=5e-3)
