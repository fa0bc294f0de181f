"""Dating network frames: by their stamps through a growing delay, and without stamps through jitter and losses."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.capture_clock import CaptureClock, capture_stamp


def dated(stamped, fps=25.0, jitter=0.01, lost=0.0, skew=0.0, seconds=90.0, seed=1, clock=None, step=lambda t: 0.0):
    """Errors in seconds of the frames' dates against exposure + 20 ms, the least delay, after 20 s."""
    rng = np.random.default_rng(seed)
    clock = clock or CaptureClock()
    errors, last = [], 0.0
    for k in range(int(seconds * fps)):
        t = 100.0 + k / fps
        if rng.random() < lost:
            continue
        last = max(t + 0.02 + rng.exponential(jitter), last + 1e-5)
        got = clock.date(last, 1.7e9 + t * (1.0 + skew) + step(t) if stamped else None)
        if t > 120.0:
            errors.append(got - t - 0.02)
    return np.array(errors)


@pytest.mark.parametrize("skew", [0.0, 1e-4, -1e-4])
@pytest.mark.parametrize("jitter", [0.005, 0.03, 0.1])
def test_stamps_date_frames_far_better_than_arrivals(skew, jitter):
    errors = dated(True, skew=skew, jitter=jitter, lost=0.05)
    assert np.abs(errors).max() < 0.15 * jitter + 0.003, "arrivals are late by up to 8 times jitter"
    assert np.std(errors) < 0.05 * jitter


@pytest.mark.parametrize("change", [3.0, -3.0, 0.3, 3600.0])
def test_a_camera_whose_clock_is_set_is_followed_within_seconds(change):
    clock = CaptureClock()
    errors = dated(True, clock=clock, step=lambda t: change if t > 150.0 else 0.0)
    assert clock.restarts == 1
    assert clock.uses_stamps
    late = errors[-25 * 20 :]
    assert np.abs(late).max() < 0.01


def test_stamps_in_whole_seconds_are_not_used():
    clock = CaptureClock()
    for k in range(200):
        clock.date(100.0 + k / 25.0, float(int(k / 25.0)))
    assert clock.uses_stamps is False


def test_stamps_of_a_clock_that_runs_at_another_speed_are_not_used():
    clock = CaptureClock()
    for k in range(2000):
        clock.date(100.0 + k / 25.0, k * 40.0)  # milliseconds since it was switched on
    assert clock.uses_stamps is False


@pytest.mark.parametrize(("fps", "jitter", "lost"), [(30.0, 0.004, 0.0), (30.0, 0.004, 0.01), (10.0, 0.012, 0.005)])
def test_without_stamps_frames_are_dated_evenly(fps, jitter, lost):
    errors = dated(False, fps=fps, jitter=jitter, lost=lost)
    typical = np.quantile(np.abs(errors - np.median(errors)), 0.95)
    assert typical < 1.6 * jitter, "the arrivals' own scatter has 3 times jitter there"
    assert abs(float(np.median(errors))) < 2.0 * jitter


def test_without_stamps_another_rate_is_followed():
    clock, t, errors = CaptureClock(), 0.0, []
    rng = np.random.default_rng(1)
    for k in range(1800):
        t += 1 / 15 if 600 <= k < 1200 else 1 / 30
        errors.append(clock.date(t + rng.exponential(0.003)) - t)
    for begin in (300, 900, 1500):
        assert np.quantile(np.abs(errors[begin : begin + 250]), 0.95) < 0.008


@given(st.lists(st.tuples(st.floats(0.0, 3.0), st.one_of(st.none(), st.floats(-1e9, 2e9))), max_size=120))
@settings(deadline=None, max_examples=100)
def test_dates_always_increase_and_nothing_is_raised(steps):
    clock, arrived, last = CaptureClock(), 0.0, -np.inf
    for gap, stamp in steps:
        arrived += gap
        got = clock.date(arrived, stamp)
        assert last < got < np.inf
        last = got


@pytest.mark.parametrize(
    ("headers", "stamp"),
    [
        ({"x-timestamp": "1712345678.250000"}, 1712345678.25),
        ({"x-timestamp": "1712345678250"}, 1712345678.25),
        ({"x-timestamp": "1712345678250000"}, 1712345678.25),
        ({"x-timestamp": "1712345678250000000"}, 1712345678.25),
        ({"x-timestamp": "12.5"}, 12.5),
        ({"x-capture-time": "2024-04-05T19:34:38.250Z"}, 1712345678.25),
        ({"x-timestamp": "soon", "timestamp": "7"}, 7.0),
        ({"x-timestamp": "nan"}, None),
        ({"content-length": "7"}, None),
    ],
)
def test_the_stamp_is_read_from_what_cameras_send(headers, stamp):
    assert capture_stamp(headers) == (pytest.approx(stamp, abs=1e-3) if stamp is not None else None)


def test_a_header_that_is_named_is_the_only_one_looked_at():
    assert capture_stamp({"x-timestamp": "1", "x-mine": "2"}, "X-Mine") == 2.0
    assert capture_stamp({"x-timestamp": "1"}, "X-Mine") is None
