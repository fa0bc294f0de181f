"""The pure parts of the Roomba driver: counts, dates, modes, text, slipping, speeds, battery."""

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from robotd import oi
from robotd.oi import COUNT, TICK
from robotd.roomba.battery import BatteryWatch
from robotd.roomba.encoders import WheelEncoders
from robotd.roomba.firmware import BannerReader, Firmware, keep_alive_s
from robotd.roomba.modes import ModeReader, cliffs, hazards
from robotd.roomba.slip import SlipDetector
from robotd.roomba.speeds import MAX_WHEEL_SPEED, WheelSpeeds, wheel_speeds
from robotd.roomba.stream_clock import WINDOW, StreamClock
from robotd.sim.wheel import Wheel

# ---- encoders --------------------------------------------------------------------------------------------------------


class Axle:
    """Two simulated wheels, and the encoders that follow them; speeds right before left."""

    def __init__(self, acceleration=0.75, order="auto", swapped=False, start=0, **how):
        self.wheels = [Wheel(start, acceleration), Wheel(start, acceleration)]
        self.rolled = [0.0, 0.0]
        self.encoders = WheelEncoders(order, **how)
        self.swapped = swapped
        self.troubles = []

    def run(self, seconds, right, left, *, known=True, every=1):
        for wheel, speed in zip(self.wheels, (right, left), strict=True):
            wheel.command(1000.0 * speed)
        sent = tuple(wheel.target for wheel in self.wheels)
        for tick in range(round(seconds / TICK)):
            for place, wheel in enumerate(self.wheels):
                self.rolled[place] += wheel.ramp(TICK) * TICK
                wheel.measure(self.rolled[place])
            if tick % every == 0:
                self.look(sent, every * TICK, known)

    def look(self, sent=(0.0, 0.0), elapsed=TICK, known=True):
        right, left = (wheel.counts for wheel in self.wheels)
        packets = (right, left) if self.swapped else (left, right)
        trouble = self.encoders.update(elapsed, *packets, sent, known=known)
        if trouble is not None:
            self.troubles.append(trouble)

    def assert_right(self, within=4 * COUNT):
        assert self.encoders.right == pytest.approx(self.rolled[0], abs=within)
        assert self.encoders.left == pytest.approx(self.rolled[1], abs=within)


speeds = st.sampled_from([-0.285, -0.2, -0.1, -0.03, 0.0, 0.03, 0.1, 0.2, 0.285])


@given(
    st.lists(st.tuples(st.floats(0.1, 1.5), speeds, speeds), min_size=1, max_size=8),
    st.sampled_from([0.4, 0.75, 2.0, 6.0]),
    st.integers(0, 65535),
)
def test_travel_follows_the_wheels_through_any_starts_stops_and_reversals(legs, acceleration, start):
    axle = Axle(acceleration, "normal", start=start)
    axle.look()
    for seconds, right, left in legs:
        axle.run(seconds, right, left)
    axle.run(1.5, 0.0, 0.0)
    axle.assert_right(within=(2 + 3 * len(legs)) * COUNT)
    assert axle.encoders.resets == 0


def test_a_reversal_at_speed_costs_less_than_a_millimetre():
    axle = Axle(order="normal")
    axle.look()
    for _ in range(10):
        axle.run(2.0, 0.2, -0.2)
        axle.run(2.0, -0.2, 0.2)
    axle.run(1.0, 0.0, 0.0)
    axle.assert_right(within=0.010)  # of twenty reversals


def test_lost_frames_lose_no_travel():
    axle = Axle(order="normal")
    axle.look()
    for speed in (0.25, 0.1):
        axle.run(3.0, speed, speed, every=3)
        axle.run(1.2, 0.0, 0.0, every=3)
    axle.assert_right()
    axle.run(3.0, -0.25, -0.25, every=3)
    axle.run(1.2, 0.0, 0.0, every=3)
    axle.assert_right(within=16 * COUNT)  # told to stop, the robot counts up: what came down before cancels in the gap


@pytest.mark.parametrize("start", [0, 65530, 32760])
def test_counts_are_modulo_65536_signed_or_not(start):
    axle = Axle(order="normal", start=start)
    axle.look()
    axle.run(2.0, 0.2, 0.2)
    axle.run(4.0, -0.2, -0.2)
    axle.run(1.0, 0.0, 0.0)
    axle.assert_right()


@pytest.mark.parametrize(("right", "left"), [(0.1, -0.1), (-0.2, 0.2), (0.2, 0.1), (-0.1, -0.2), (0.0, 0.1)])
@pytest.mark.parametrize("swapped", [False, True])
def test_swapped_encoders_show_in_the_first_turn(right, left, swapped):
    axle = Axle(swapped=swapped)
    axle.look()
    axle.run(4.0, right, left)
    assert axle.encoders.order == ("swapped" if swapped else "normal")
    assert axle.encoders.resets == (1 if swapped else 0)
    assert bool(axle.troubles) == swapped
    begun = axle.encoders.right - axle.rolled[0], axle.encoders.left - axle.rolled[1]
    axle.run(2.0, left, right)
    axle.run(1.0, 0.0, 0.0)
    assert axle.encoders.right - begun[0] == pytest.approx(axle.rolled[0], abs=0.004)
    assert axle.encoders.left - begun[1] == pytest.approx(axle.rolled[1], abs=0.004)


@pytest.mark.parametrize("blocked", [0, 1])
@pytest.mark.parametrize(("right", "left"), [(0.2, 0.15), (0.15, 0.2), (0.1, -0.1)])
def test_a_blocked_wheel_is_not_taken_for_swapped_encoders(blocked, right, left):
    axle = Axle()
    axle.look()
    axle.wheels[blocked].ramp = lambda seconds: 0.0
    axle.run(20.0, right, left)
    assert axle.encoders.order != "swapped"


def test_straight_driving_and_the_robot_s_own_programs_say_nothing_about_the_order():
    axle = Axle(swapped=True)
    axle.look()
    axle.run(5.0, 0.2, 0.2)
    axle.run(5.0, 0.2, -0.2, known=False)
    assert axle.encoders.order is None


@pytest.mark.parametrize("jump", [200, -200, 1000, 20000, -32768])
def test_counts_that_no_wheel_can_make_do_not_move_the_robot_and_are_told(jump):
    axle = Axle(order="normal", start=5)
    axle.look()
    axle.run(1.0, 0.2, 0.2)
    before = axle.encoders.left
    for wheel in axle.wheels:
        wheel.counts = (wheel.counts + jump) & 0xFFFF
    axle.run(TICK, 0.2, 0.2)
    assert axle.encoders.left == before
    assert axle.encoders.resets == 0  # it could be a damaged frame
    axle.run(TICK, 0.2, 0.2)
    assert axle.encoders.left == before
    assert axle.encoders.resets == 1
    assert "the wheel counters jumped by" in axle.troubles[0]
    axle.run(1.0, 0.2, 0.2)
    assert axle.encoders.left > before + 0.1
    assert axle.encoders.resets == 1


def test_a_single_damaged_reading_changes_nothing():
    axle = Axle(order="normal", start=5)
    axle.look()
    axle.run(1.0, 0.2, 0.2)
    axle.wheels[0].counts ^= 0x4000
    axle.look((0.2, 0.2))
    axle.wheels[0].counts ^= 0x4000
    axle.run(1.0, 0.2, 0.2)
    axle.run(1.0, 0.0, 0.0)
    axle.assert_right()
    assert axle.encoders.resets == 0
    assert axle.troubles == []


def test_readings_that_make_no_sense_at_all_are_an_interruption_after_a_while():
    axle, rng = Axle(order="normal"), np.random.default_rng(4)
    axle.look()
    for _ in range(40):
        axle.wheels[0].counts = int(rng.integers(0x10000))
        axle.look()
    assert axle.encoders.resets >= 1


def test_the_measured_speed_is_the_wheels_speed():
    axle = Axle(order="normal")
    axle.look()
    axle.run(2.0, 0.2, -0.1)
    assert axle.encoders.speeds == pytest.approx((axle.wheels[0].speed, axle.wheels[1].speed), abs=2 * COUNT / 0.12)


# ---- dates -----------------------------------------------------------------------------------------------------------


def stamped(clock, size, baud, arrivals):
    """Dates of frames k = 0, 1, ... taken at k ticks, of which those with an equal arrival come in one chunk."""
    dates, fed, place = [], 0, 0
    while place < len(arrivals):
        ends = []
        while place + len(ends) < len(arrivals) and arrivals[place + len(ends)] == arrivals[place]:
            fed += size
            ends.append(fed)
        dates += clock.stamps(arrivals[place], ends, fed)
        place += len(ends)
    return dates


@pytest.mark.parametrize(("baud", "size"), [(115200, 46), (57600, 46), (19200, 28)])
def test_frames_in_time_are_dated_to_the_tick(baud, size):
    clock = StreamClock(baud, size)
    arrivals = [k * TICK + size * 10 / baud for k in range(100)]
    assert stamped(clock, size, baud, arrivals) == pytest.approx([k * TICK for k in range(100)], abs=1e-9)
    assert (clock.missing, clock.late) == (0, 0)


@pytest.mark.parametrize("stalled", [2, 7, 20])
@pytest.mark.parametrize("together", [True, False])
def test_frames_that_come_at_once_after_a_stall_are_dated_back(stalled, together):
    size, baud = 46, 115200
    clock = StreamClock(baud, size)
    sent = [k * TICK + size * 10 / baud for k in range(100)]
    end = sent[40 + stalled]
    arrivals = [end + (0.0 if together else 1e-6 * k) if 40 <= k < 40 + stalled + 1 else t for k, t in enumerate(sent)]
    dates = stamped(clock, size, baud, arrivals)
    if together:
        assert dates == pytest.approx([k * TICK for k in range(100)], abs=1e-3)
    assert dates == sorted(dates)
    assert dates[60:] == pytest.approx([k * TICK for k in range(60, 100)], abs=1e-3) if stalled < 20 else True
    assert clock.missing == 0


@given(st.integers(0, 2**32 - 1), st.floats(-0.001, 0.001))
def test_delays_of_the_computer_hardly_show_and_a_robot_s_slow_clock_is_followed(seed, drift):
    size, baud = 46, 115200
    delays = np.random.default_rng(seed).uniform(0.0, 0.007, 400)
    clock = StreamClock(baud, size)
    tick = TICK * (1.0 + drift)
    arrivals = [k * tick + size * 10 / baud + (delay if k % 4 else 0.0) for k, delay in enumerate(delays)]
    dates = np.array(stamped(clock, size, baud, arrivals))
    assert np.abs(dates - tick * np.arange(len(dates)))[8:].max() < 0.0006
    assert clock.missing == 0
    assert (np.diff(dates) >= 0.0).all()


@given(st.integers(0, 2**32 - 1))
def test_frames_that_are_late_by_fractions_of_a_tick_are_not_missing(seed):
    size, baud = 46, 115200
    rng = np.random.default_rng(seed)
    clock = StreamClock(baud, size)
    arrived = 0.0
    for k in range(600):
        delay = rng.exponential(0.008) if rng.random() < 0.7 else 0.0
        arrived = max(arrived, k * TICK + size * 10 / baud + delay)
        clock.stamps(arrived, [size * (k + 1)], size * (k + 1))
    assert clock.missing == 0


def test_a_late_frame_is_counted_and_dated_before_it_came():
    clock = StreamClock(115200, 46)
    dates = [
        clock.stamps(k * TICK + 0.004 + (0.012 if k == 50 else 0.0), [46 * (k + 1)], 46 * (k + 1))[0]
        for k in range(100)
    ]
    assert clock.late == 1
    assert np.abs(np.array(dates) - TICK * np.arange(100)).max() < 0.016
    assert clock.missing == 0


@given(st.sets(st.integers(1, 398), max_size=60))
def test_damaged_frames_are_missing_and_what_follows_them_is_not_late(damaged):
    size, baud = 46, 115200
    clock = StreamClock(baud, size)
    for k in range(400 + 2 * WINDOW):
        if k not in damaged:
            clock.stamps(k * TICK + size * 10 / baud, [size * (k + 1)], size * (k + 1))
    assert (clock.missing, clock.late) == (len(damaged), 0)


def test_the_begun_next_frame_dates_the_last_one():
    clock = StreamClock(115200, 46)
    byte = 10 / 115200
    # 5 bytes of the next frame, taken at 15 ms, are there as well
    (date,) = clock.stamps(TICK + 5 * byte, [46], 51, begun=True)
    assert date == pytest.approx(0.0, abs=1e-9)


# ---- text ------------------------------------------------------------------------------------------------------------

RELEASES = [
    (b"r3_robot/tags/release-3.2.6:4975 CLEAN\r\n", Firmware((3, 2, 6))),
    (b"r3-robot/tags/release-stm32-3.7.7:6913 CLEAN\r\n", Firmware((3, 7, 7), "stm32")),
    (b"r3_robot/tags/release_stm32_3.10.12 ", Firmware((3, 10, 12), "stm32")),
]


@pytest.mark.parametrize(("text", "firmware"), RELEASES)
@given(st.binary(max_size=300), st.integers(1, 50))
def test_a_release_is_read_however_the_text_is_cut_and_whatever_stands_before(text, firmware, noise, cut):
    reader, found = BannerReader(), []
    data = noise + b"\r\n" + text
    for start in range(0, len(data), cut):
        found += reader.feed(data[start : start + cut])
    assert found[-1:] == [firmware]
    assert reader.firmware == firmware


@pytest.mark.parametrize("cut", [1, 3, 16, 64])
def test_a_sign_that_begins_in_the_last_letter_of_another_is_not_counted_twice(cut):
    data = b"processor-sleeprocessor-sleep\r\n"
    reader = BannerReader()
    assert [item for at in range(0, len(data), cut) for item in reader.feed(data[at : at + cut])] == ["sleep"]


@given(st.lists(st.binary(max_size=400), max_size=20))
def test_noise_is_no_banner_and_takes_no_memory(chunks):
    reader = BannerReader()
    for chunk in chunks:
        reader.feed(chunk)
        assert len(reader._text) <= BannerReader.KEEP


def test_signs_of_a_restart_and_of_sleep_are_read_in_order():
    reader = BannerReader()
    assert reader.feed(b"\r\nSoft re") == []
    assert reader.feed(b"set!\n\xfeprocessor-sleep\r\n") == ["reset", "sleep"]
    assert reader.is_text
    reader.feed(b"\x80")
    assert not reader.is_text
    assert not BannerReader().is_text


def test_what_is_known_about_a_release_is_told():
    assert len(Firmware((3, 2, 6)).traps) == 3
    assert Firmware((3, 4, 0)).traps == ("its own angle (packet 20) is wrong",)
    assert Firmware((3, 7, 7), "stm32").traps == ()
    assert (keep_alive_s(None), keep_alive_s(Firmware((3, 2, 6)))) == (60.0, 30.0)


# ---- modes -----------------------------------------------------------------------------------------------------------

QUIET = dict.fromkeys((7, 9, 10, 11, 12, 14, 18, 21, 25, 26, 34, 41, 42, 43, 44), 0) | {22: 15000}


@pytest.mark.parametrize("offset", [0, 1])
def test_modes_are_read_with_the_learnt_offset(offset):
    reader = ModeReader()
    reader.learn(1 + offset)
    for mode, name in ((1, "passive"), (2, "safe"), (3, "full"), (2, "safe")):
        assert reader.update(1.0, TICK, QUIET | {35: mode + offset}, (0, 0)) == name
        assert not reader.is_odd


@pytest.mark.parametrize(("reading", "offset"), [(1, 0), (4, 1)])
def test_some_readings_tell_the_numbering(reading, offset):
    reader = ModeReader()
    reader.offset = 1 - offset
    reader.update(1.0, TICK, QUIET | {35: reading}, (0, 0))
    assert reader.offset == offset


@pytest.mark.parametrize(("reading", "name"), [(32, "passive"), (33, "passive"), (17, "unknown"), (255, "unknown")])
def test_a_reading_that_is_no_mode_is_never_safe(reading, name):
    reader = ModeReader()
    reader.learn(1)
    assert reader.update(1.0, TICK, QUIET | {35: reading}, (0, 0)) == name
    assert reader.is_odd


def test_without_the_packet_the_echo_tells_whether_the_wheels_obey():
    reader = ModeReader()
    reader.learn(None)
    assert reader.update(0.0, TICK, QUIET, (0, 0)) == "passive"
    reader.command(0.0, "safe")
    assert reader.update(0.04, TICK, QUIET, (0, 0)) == "passive"
    assert reader.update(0.06, TICK, QUIET, (0, 0)) == "safe"
    t = 0.06
    while t < 1.0:
        t += TICK
        assert reader.update(t, TICK, QUIET | {41: 200, 42: 200}, (200, 200)) == "safe"
    while reader.update(t, TICK, QUIET, (200, 200)) == "safe":
        t += TICK
    assert t < 1.25
    assert reader.update(t, TICK, QUIET, (0, 0)) == "passive"


def test_a_cliff_on_one_side_is_named_and_all_four_on_the_dock_are_none():
    assert hazards(QUIET | {12: 1}) == ["the right cliff sensor sees no floor"]
    assert hazards(QUIET | {9: 1, 10: 1}) == ["the left and front left cliff sensors see no floor"]
    all_four = QUIET | {9: 1, 10: 1, 11: 1, 12: 1}
    assert len(cliffs(all_four)) == 4
    assert cliffs(all_four | {34: 2}) == []
    assert cliffs(QUIET | {9: 1, 34: 2}) == ["left"]


# ---- slipping --------------------------------------------------------------------------------------------------------


def watch(detector, seconds, told, speeds, overcurrent=0, currents=None, stasis=None):
    return {
        detector.update(TICK, told, speeds, overcurrent, currents, stasis) for _ in range(round(seconds / TICK))
    } - {None}


def test_normal_driving_is_no_slip():
    detector = SlipDetector()
    for _ in range(3):
        assert not watch(detector, 2.0, (0.0, 0.0), (0.0, 0.0), currents=(0, 0), stasis=0)
        assert not watch(detector, 0.4, (0.2, 0.2), (0.1, 0.1), currents=(250, 250), stasis=1)
        assert not watch(detector, 5.0, (0.2, 0.2), (0.19, 0.21), currents=(250, 250), stasis=1)
        assert not watch(detector, 5.0, (0.2, -0.2), (0.2, -0.2), currents=(250, 250), stasis=0)
        assert not watch(detector, 5.0, (-0.2, -0.2), (-0.2, -0.2), currents=(250, 250), stasis=0)


def test_a_caster_that_rests_while_the_wheels_turn_is_slip_once_it_has_shown_that_it_works():
    detector = SlipDetector()
    assert not watch(detector, 3.0, (0.2, 0.2), (0.2, 0.2), stasis=0)
    assert not detector.trusts_stasis
    watch(detector, 1.0, (0.2, 0.2), (0.2, 0.2), stasis=1)
    watch(detector, 1.0, (0.0, 0.0), (0.0, 0.0), stasis=0)
    assert detector.trusts_stasis
    assert watch(detector, 1.0, (0.2, 0.2), (0.2, 0.2), stasis=0) == {
        "the wheels turn but the caster does not: they slip"
    }
    assert not watch(detector, 1.0, (0.2, 0.2), (0.2, 0.2), stasis=2)  # disabled, says the robot


def test_blocked_and_straining_wheels_are_named():
    detector = SlipDetector()
    assert watch(detector, 0.1, (0.2, 0.2), (0.2, 0.2), overcurrent=24) == {
        "the left and the right wheel's motor draws too much current"
    }
    assert watch(detector, 0.1, (0.2, 0.2), (0.2, 0.2), overcurrent=3) == set()  # brushes
    assert len(watch(detector, 1.0, (0.2, 0.2), (0.2, 0.2), currents=(1500, 200))) == 1
    (words,) = watch(SlipDetector(), 2.0, (0.2, 0.2), (0.0, 0.2))
    assert (
        words
        == "the wheels do not turn as told: left 0.20 m/s told and 0.20 counted, right 0.20 m/s told and 0.00 counted"
    )


def test_both_wheels_that_stand_under_a_command_are_stuck():
    detector = SlipDetector()
    watch(detector, 2.0, (0.2, 0.1), (0.0, 0.0))
    assert detector.is_stuck
    watch(detector, 2.0, (0.2, 0.1), (0.2, 0.1))
    assert not detector.is_stuck


# ---- speeds and battery ----------------------------------------------------------------------------------------------


@given(st.floats(-3.0, 3.0), st.floats(-20.0, 20.0))
def test_no_wheel_is_told_more_than_the_cap_and_the_curvature_stays(speed, turn_rate):
    right, left = wheel_speeds(speed, turn_rate, 0.235)
    assert max(abs(right), abs(left)) <= MAX_WHEEL_SPEED + 1e-12
    assert (right - left) / 0.235 * speed == pytest.approx(0.5 * (right + left) * turn_rate, abs=1e-9)


@given(st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), min_size=1, max_size=60))
def test_quantised_speeds_owe_at_most_a_step_s_travel_and_zero_is_zero(wishes):
    speeds, step = WheelSpeeds(0.0285), 0.0285
    t, debt = 0.0, 0.0
    for wish in wishes:
        right, _ = speeds.command(t, *wish)
        assert abs(right) <= 285
        debt += (wish[0] - speeds.sent[0]) * 0.015
        t += 0.015
    assert speeds.command(t, 0.0, 0.0) == (0, 0)
    assert math.isfinite(debt)
    assert abs(speeds.sent[0]) < step


def test_without_steps_speeds_go_out_as_they_are():
    assert WheelSpeeds(0.0).command(0.0, 0.1234, -0.0567) == (123, -57)


def test_a_short_dip_of_the_voltage_is_no_low_battery():
    watch = BatteryWatch(0.15, 13.0)
    for k in range(1000):
        assert watch.update(k * TICK, 12.5 if k % 100 < 60 else 14.0, 0.8, charging=False) is None
    for k in range(1000, 1334):
        told = watch.update(k * TICK, 12.5, None, charging=False)
    assert watch.update(1340 * TICK, 12.5, None, charging=False) is not None or told is not None


def test_the_operator_is_told_in_numbers():
    watch = BatteryWatch(0.15, 13.0)
    told = [watch.update(k * 0.1, 12.94, 0.06, charging=False) for k in range(100)]
    assert [text for text in told if text] == [
        "the robot's battery is low: 6 % charge, 12.9 V; send it to its dock soon"
    ]
    assert oi.TICK == TICK
