"""The beacons' detector: it finds them standing, follows them moving, to a fraction of a pixel, and nothing else."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.vision.beacon import BeaconConfig, BeaconDetector
from robotd.vision.beacon_track import Course
from robotd.vision.beacon_wave import Wave, lock
from tests.roof_film import Film, errors, ramp


def rms(rows):
    return float(np.sqrt(np.mean([[du**2, dv**2] for _, du, dv in rows])))


# ---- the wave --------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(hz=st.floats(1.0, 10.0), exposure=st.floats(0.001, 0.04), start=st.floats(-3.0, 3.0))
def test_a_wave_is_the_share_of_the_exposure_in_which_the_led_is_on(hz, exposure, start):
    wave = Wave(hz, exposure, 0.0)
    t = np.linspace(0.0, 2.0 / hz, 23)
    fine = np.linspace(0.0, exposure, 2001)[None, :] + t[:, None] - start
    shares = ((fine * hz) % 1.0 < 0.5).mean(axis=1)
    assert np.abs(wave(t - start) - shares).max() < 0.06, "the table is sampled every half millisecond"


def test_stamps_that_err_blur_the_wave_but_keep_its_mean():
    sharp, blurred = Wave(6.25, 0.01, 0.0), Wave(6.25, 0.01, 0.010)
    t = np.linspace(0.0, 0.16, 321)[:-1]
    assert sharp(t).mean() == pytest.approx(0.5, abs=1e-6)
    assert blurred(t).mean() == pytest.approx(0.5, abs=1e-6)
    assert np.ptp(np.diff(blurred(t))) < 0.5 * np.ptp(np.diff(sharp(t)))


def test_lock_finds_the_start_and_its_probability_is_that_of_noise():
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.05, 0.11, 40))
    wave, starts = Wave(3.125, 0.01, 0.004), np.arange(0.0, 0.32, 0.01)
    found = lock(7.0 + 0.3 * t + 5.0 * wave(t - 0.11) + rng.normal(0.0, 0.3, 40), t, wave, starts)
    assert found.start == pytest.approx(0.11, abs=0.011)
    assert found.amplitude == pytest.approx(5.0, rel=0.1)
    assert found.log_p < -40.0
    values = [lock(rng.normal(size=40), t, wave, starts).log_p for _ in range(2000)]
    for level in (0.1, 0.01):
        assert np.mean(np.array(values) < np.log(level)) <= level, "a false alarm is no likelier than it says"


def test_a_course_goes_on_straight_beyond_what_was_seen():
    course = Course(10.0, np.array([[5.0, 6.0], [2.0, 0.0], [1.0, -1.0]]), 0.5)
    inside, end, later = course(np.array([10.2, 10.5, 11.5]))
    assert np.allclose(inside, [5.44, 5.96])
    assert np.allclose(later - end, np.array([3.0, -1.0]))


# ---- standing --------------------------------------------------------------------------------------------------------


def test_standing_beacons_are_found_within_three_seconds_and_placed_to_a_fraction_of_a_pixel():
    rows = [
        row
        for seed in (1, 2, 3)
        for row in errors(Film(seed, start=(120.3 + seed, 110.6), direction=seed), BeaconDetector(BeaconConfig()), 4.5)
    ]
    assert {fix.beacon for fix, _, _ in rows} == {"front", "rear"}
    assert rms(rows) < 0.06
    assert all(fix.still_since is not None and fix.t < 4.5 for fix, _, _ in rows)
    assert np.median([fix.share for fix, _, _ in rows]) > 0.9


def test_the_red_channel_whose_chroma_is_coarse_is_placed_as_well_as_is_asked_and_says_how_well():
    squares, found = [], []
    for seed in (1, 2, 4):
        rows = errors(Film(seed, channel="red", quality=60, direction=seed), BeaconDetector(BeaconConfig()), 3.4)
        last = {fix.beacon: (fix, du, dv) for fix, du, dv in rows}
        assert last.keys() == {"front", "rear"}
        found += last.values()
        squares += [
            np.array([du, dv]) @ np.linalg.solve(np.array(fix.covariance), [du, dv]) for fix, du, dv in last.values()
        ]
    assert rms(found) < 0.15
    assert np.mean(squares) < 4.0


def test_a_walker_lost_frames_rolling_shutter_and_stamps_that_err_do_no_harm():
    film = Film(5, walker=True, lost=0.1, row_time=8e-5, stamp_error=0.006)
    rows = errors(film, BeaconDetector(BeaconConfig(row_time_s=8e-5, jitter_s=0.006)), 6.0)
    assert {fix.beacon for fix, _, _ in rows} == {"front", "rear"}
    assert rms(rows) < 0.12


def test_fixes_are_as_wrong_as_they_say():
    squares = []
    for seed in range(4):
        rows = errors(Film(seed, light=0.3, direction=seed), BeaconDetector(BeaconConfig()), 3.5)
        for name in ("front", "rear"):
            fix, du, dv = [row for row in rows if row[0].beacon == name][-1]
            squares.append(np.array([du, dv]) @ np.linalg.solve(np.array(fix.covariance), [du, dv]))
    assert 0.1 < np.mean(squares) < 4.0


def test_a_light_that_is_clipped_white_says_so_and_is_still_placed():
    film = Film(2, light=4.0, colour=(255, 255, 255))
    rows = errors(film, BeaconDetector(BeaconConfig()), 3.5)
    assert all(fix.clipped for fix, _, _ in rows)
    assert len(rows) > 4
    assert rms(rows) < 0.25


# ---- nothing else ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rates", [(5.0, 2.0), (4.0, 4.6), (1.0, 1.5)])
def test_lights_at_other_rates_are_no_beacons(rates):
    assert errors(Film(3, rates=rates), BeaconDetector(BeaconConfig()), 5.0) == []


def test_an_empty_floor_and_people_are_no_beacons():
    for seed in (1, 2):
        assert errors(Film(seed, lit=(False, False), walker=True), BeaconDetector(BeaconConfig()), 6.0) == []


def test_each_beacon_is_found_without_the_other_and_never_taken_for_it():
    for lit, name in (((True, False), "front"), ((False, True), "rear")):
        rows = errors(Film(4, lit=lit), BeaconDetector(BeaconConfig()), 4.0)
        assert {fix.beacon for fix, _, _ in rows} == {name}


def test_a_pair_that_cannot_be_one_robot_is_not_taken_for_it():
    rows = errors(Film(4), BeaconDetector(BeaconConfig(), plausible=lambda front, rear: False), 4.0)
    assert len({fix.beacon for fix, _, _ in rows}) < 2


# ---- moving ----------------------------------------------------------------------------------------------------------


def moving(seed, **changes):
    """Stands for three seconds, then drives at 45 px/s: 0.2 m/s where a metre has 225 px."""
    return Film(seed, start=(60.0, 60.0), direction=0.5, travelled=ramp(45.0, 60.0, 3.0, 6.4), **changes)


def test_a_moving_beacon_is_followed_to_half_a_pixel_through_start_and_stop():
    rows = [row for seed in (1,) for row in errors(moving(seed), BeaconDetector(BeaconConfig()), 8.5)]
    driving = [row for row in rows if 3.5 < row[0].t < 6.0]
    assert {fix.beacon for fix, _, _ in driving} == {"front", "rear"}
    assert len(driving) > 30
    assert rms(driving) < 0.25
    assert all(fix.still_since is None for fix, _, _ in driving if 4.0 < fix.t < 5.7)
    speeds = [np.hypot(*fix.velocity) for fix, _, _ in driving if 4.2 < fix.t < 5.4]
    assert np.median(speeds) == pytest.approx(45.0, abs=2.0)
    after = [row for row in rows if row[0].until > 7.8]
    assert after
    assert rms(after) < 0.15
    assert all(fix.still_since is not None for fix, _, _ in after)


def test_odometry_bridges_a_start_that_the_last_course_would_lose():
    film = Film(3, start=(70.0, 60.0), direction=0.5, travelled=ramp(70.0, 600.0, 3.0, 5.0))
    detector = BeaconDetector(BeaconConfig())

    def motion(beacon, t, place, t0):
        return place + np.array([film.place(beacon, at) - film.place(beacon, t0) for at in t])

    detector.motion = motion
    rows = [row for row in errors(film, detector, 6.0) if 3.4 < row[0].t < 4.9]
    assert len(rows) > 20
    assert rms(rows) < 0.3


def test_a_gap_in_the_stream_begins_anew_and_bad_frames_are_refused():
    detector = BeaconDetector(BeaconConfig())
    film = Film(1)
    errors(film, detector, 3.0)
    assert set(detector.tracked) == {"front", "rear"}
    detector.update(film.draw(9.0), 9.0)
    assert detector.tracked == ()
    assert detector.update(film.draw(8.0), 8.0) == [], "a frame out of order is passed over"
    with pytest.raises(ValueError, match="uint8 image"):
        detector.update(np.zeros((240, 320, 3), np.uint8), 10.0)
    with pytest.raises(ValueError, match="the one before had"):
        detector.update(np.zeros((24, 32), np.uint8), 10.0)
