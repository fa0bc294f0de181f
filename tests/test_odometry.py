import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotd.bind import bind
from robotd.errors import ConfigError
from robotd.odometry import Odometry, Wheels, arc
from robotd.oi import COUNT

TICK = 0.015


def drive(odometry, steps, t=0.0, left=0.0, right=0.0):
    state = odometry.update(t, left, right)
    for step_left, step_right in steps:
        t, left, right = t + TICK, left + step_left, right + step_right
        state = odometry.update(t, left, right)
    return state


@settings(deadline=None)
@given(left=st.floats(-0.5, 0.5), right=st.floats(-0.5, 0.5))
def test_an_arc_is_the_limit_of_many_small_straight_steps(left, right):
    base, n = 0.235, 4000
    heading = (right - left) / base * (np.arange(n) + 0.5) / n
    step = 0.5 * (left + right) / n
    dx, dy, turn = arc(left, right, base)
    assert dx == pytest.approx(step * np.cos(heading).sum(), abs=1e-6)
    assert dy == pytest.approx(step * np.sin(heading).sum(), abs=1e-6)
    assert turn == pytest.approx((right - left) / base)


def test_a_full_circle_returns_to_its_start():
    wheels = Wheels()
    radius, n = 0.5, 500
    inner = 2 * math.pi * (radius - wheels.base / 2) / n
    outer = 2 * math.pi * (radius + wheels.base / 2) / n
    odometry = Odometry(wheels)
    state = drive(odometry, [(inner, outer)] * n)
    assert state.pose.x == pytest.approx(0.0, abs=1e-9)
    assert state.pose.y == pytest.approx(0.0, abs=1e-9)
    assert math.remainder(state.pose.heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert state.travelled == pytest.approx(2 * math.pi * radius)
    assert state.speed == pytest.approx(2 * math.pi * radius / n / TICK)
    assert state.turn_rate == pytest.approx(2 * math.pi / n / TICK)


def test_scales_and_base_of_the_calibration_count():
    odometry = Odometry(Wheels(scale_left=0.9, scale_right=1.1, base=0.2))
    drive(odometry, [(0.005, 0.005)] * 10)
    expected = arc(0.045, 0.055, 0.2)
    move = odometry.move_since_mark()
    assert (move.dx, move.dy, move.dheading) == pytest.approx(expected, abs=1e-12)


def test_speed_is_smooth_although_counts_are_coarse():
    odometry = Odometry(Wheels(travel_noise=0.0))
    speeds = []
    for tick in range(200):
        travel = math.floor(0.1 * tick * TICK / COUNT) * COUNT
        speeds.append(odometry.update(tick * TICK, travel, travel).speed)
    assert np.max(np.abs(np.array(speeds[20:]) - 0.1)) < 0.005


def test_a_move_is_in_the_axes_of_the_robot_at_the_mark():
    odometry = Odometry(Wheels())
    drive(odometry, [(-0.0025, 0.0025)] * 50)
    odometry.mark()
    state = odometry.update(1.0, -0.125, 0.125)
    before = state.pose
    after = drive(odometry, [(0.004, 0.005)] * 60, 1.0, -0.125, 0.125).pose
    move = odometry.move_since_mark()
    c, s = math.cos(before.heading), math.sin(before.heading)
    assert before.x + c * move.dx - s * move.dy == pytest.approx(after.x)
    assert before.y + s * move.dx + c * move.dy == pytest.approx(after.y)
    assert move.dheading == pytest.approx(after.heading - before.heading)


def test_headings_are_wrapped():
    odometry = Odometry(Wheels())
    drive(odometry, [(-0.004, 0.004)] * 120)  # 4.1 rad
    assert odometry.move_since_mark().dheading == pytest.approx(0.96 / 0.235 - 2 * math.pi)


def test_covariance_is_positive_definite_even_after_no_motion():
    odometry = Odometry(Wheels(travel_noise=0.0))
    odometry.update(0.0, 0.0, 0.0)
    eigenvalues = np.linalg.eigvalsh(np.array(odometry.move_since_mark().covariance))
    assert eigenvalues.min() > 0.0
    assert math.sqrt(eigenvalues.max()) < 0.005


def test_heading_spreads_by_18_mrad_in_one_metre():
    odometry = Odometry(Wheels())
    drive(odometry, [(0.005, 0.005)] * 200)
    covariance = odometry.move_since_mark().covariance
    assert math.sqrt(covariance[2][2]) == pytest.approx(0.003 * math.sqrt(2) / 0.235, rel=0.05)
    assert math.sqrt(covariance[0][0]) == pytest.approx(0.003 / math.sqrt(2), rel=0.05)
    assert math.sqrt(covariance[1][1]) == pytest.approx(0.003 * math.sqrt(2 / 3) / 0.235, rel=0.05)


def test_errors_of_moves_are_as_large_as_their_covariance_says():
    """Normalised estimation error squared over 500 runs: 1 within three standard deviations (0.11)."""
    wheels, rng, total, runs, n = Wheels(), np.random.default_rng(5), 0.0, 500, 160
    for _ in range(runs):
        bends = np.cumsum(rng.normal(0.0, 4e-4, n)).clip(-0.004, 0.004)
        rolled = np.stack([0.005 - bends, 0.005 + bends], axis=1)
        rolled[120:] *= -1.0  # some of it backward
        true = rolled + wheels.travel_noise * np.sqrt(np.abs(rolled)) * rng.standard_normal(rolled.shape)
        start = rng.uniform(0.0, COUNT, 2)
        read = np.floor((start + np.cumsum(rolled, axis=0)) / COUNT) * COUNT
        odometry = Odometry(wheels)
        odometry.update(0.0, 0.0, 0.0)
        for tick, (left, right) in enumerate(read):
            odometry.update((tick + 1) * TICK, left, right)
        x = y = heading = 0.0
        for left, right in true:
            dx, dy, turn = arc(left, right, wheels.base)
            x, y = (
                x + dx * math.cos(heading) - dy * math.sin(heading),
                y + dx * math.sin(heading) + dy * math.cos(heading),
            )
            heading += turn
        move = odometry.move_since_mark()
        error = np.array([move.dx - x, move.dy - y, math.remainder(move.dheading - heading, 2 * math.pi)])
        total += error @ np.linalg.solve(np.array(move.covariance), error) / 3.0
    assert 0.89 < total / runs < 1.11


@pytest.mark.parametrize(
    ("t", "left", "right"),
    [(2 * TICK, 0.1, 0.0), (2 * TICK, 0.0, -0.3), (0.7, 0.001, 0.001)],
    ids=["left jumps", "right jumps", "silence"],
)
def test_a_reset_base_moves_nothing_and_is_told(t, left, right):
    odometry = Odometry(Wheels())
    drive(odometry, [(0.0, 0.0)])
    before = odometry.update(TICK, 0.0, 0.0).pose
    assert odometry.update(t, left, right).pose == before
    assert odometry.resets == 1
    assert odometry.broken_since_mark
    odometry.mark()
    assert not odometry.broken_since_mark
    assert odometry.update(t + TICK, left + 0.003, right + 0.003).pose.x == pytest.approx(before.x + 0.003)


def test_wheels_out_of_range_are_named_all_at_once():
    with pytest.raises(ConfigError) as caught:
        bind(Wheels, {"base": 5.0, "scale_left": 0.0, "bass": 1}, "calibration.toml")
    assert len(caught.value.problems) == 3
