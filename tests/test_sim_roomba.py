"""The simulated robot against the Open Interface, and whatever else may happen to it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd import oi
from robotd.records import Pose
from robotd.sim.battery import CAPACITY_MAH
from robotd.sim.body import Body
from robotd.sim.dock import Dock
from robotd.sim.layout import LineLayout, StoreLayout
from robotd.sim.roomba_body import HandledBody
from robotd.sim.settings import WorldSettings
from tests.roomba_wire import Wire


def on_the_floor(**switches):
    """A robot with a real body on a wide floor without noise, at (5, 5) of it."""
    layout = StoreLayout("robotd-store/1", "plane", (10.0, 10.0), LineLayout(((0.0, 0.0), (1.0, 0.0)), (0.0,)))
    still = WorldSettings(travel_noise=0.0, slip_distance=0.0, wheel_scale_error=0.0, wheel_base_error=0.0)
    body = HandledBody(Body(layout, still, np.random.default_rng(1), Pose(5.0, 5.0, 0.0)), (5.0, 5.0))
    return Wire(body=body, **switches)


def test_nothing_but_start_works_in_off():
    wire = Wire()
    wire.send("safe")
    wire.send("sensors", 35)
    assert wire.run() == b""
    assert wire.robot.mode == oi.OFF
    wire.send("start")
    assert wire.ask(35) == {35: oi.PASSIVE}


def test_modes_follow_the_interface():
    wire = Wire()
    wire.send("start")
    for command, mode in (
        ("safe", 2),
        ("full", 3),
        ("safe", 2),
        ("clean", 1),
        ("control", 2),
        ("start", 1),
        ("full", 3),
        ("dock", 1),
        ("safe", 2),
        ("stop", 0),
        ("full", 0),
    ):
        wire.send(command)
        assert wire.robot.mode == mode


@pytest.mark.parametrize("mode", ["start", "safe", "full"])
@pytest.mark.parametrize("name", ["cliff", "wheel_drop_left"])
def test_reflexes_belong_to_safe_mode(mode, name):
    wire = Wire()
    wire.send("start")
    wire.send(mode)
    wire.send("drive_direct", 200, 200)
    wire.run(0.5)
    setattr(wire.body, name, True)
    wire.run(0.5)
    assert wire.robot.mode == {"start": oi.PASSIVE, "safe": oi.PASSIVE, "full": oi.FULL}[mode]
    assert (wire.robot.left.speed > 0.0) == (mode == "full")


def test_a_cliff_ends_safe_mode_only_where_the_front_could_go_over():
    for right, left, drops in (
        (100, 100, True),
        (-100, -100, False),
        (-100, 0, True),
        (100, -100, True),
        (0, 0, False),
    ):
        wire = Wire()
        wire.send("start")
        wire.send("safe")
        wire.send("drive_direct", right, left)
        wire.body.cliff = True
        wire.run(0.1)
        assert (wire.robot.mode == oi.PASSIVE) == drops


@pytest.mark.parametrize(
    ("command", "right", "left"),
    [
        (("drive_direct", 200, -100), 0.1995, -0.114),
        (("drive", 200, oi.STRAIGHT), 0.1995, 0.1995),
        (("drive", 200, oi.SPIN_COUNTER_CLOCKWISE), 0.1995, -0.1995),
        (("drive", 200, oi.SPIN_CLOCKWISE), -0.1995, 0.1995),
        (("drive", 200, 500), 0.2565, 0.1425),
        (("drive_pwm", 255, -255), 0.513, -0.513),
        (("drive_direct", 10, 14), 0.0, 0.0),
        (("drive_direct", 15, -15), 0.0285, -0.0285),
    ],
)
def test_wheel_speeds_are_quantised_per_wheel(command, right, left):
    wire = Wire()
    wire.send("start")
    wire.send(*command)
    assert wire.robot.right.target == 0.0  # ignored in Passive
    wire.send("safe")
    wire.send(*command)
    wire.run(1.5)
    assert (wire.robot.right.speed, wire.robot.left.speed) == pytest.approx((right, left))


def test_wheels_accelerate_no_faster_than_their_motors():
    wire = Wire(acceleration=0.6)
    wire.send("start")
    wire.send("safe")
    wire.send("drive_direct", 200, 200)
    wire.run(0.15)
    assert wire.robot.left.speed == pytest.approx(0.09)


def test_encoders_count_up_when_a_standing_wheel_is_pushed():
    wire = Wire()
    wire.send("start")
    wire.run()
    before = wire.ask(43)[43]
    wire.body.left_rotation -= 0.1
    after = wire.ask(43)[43]
    assert (after - before) % 0x10000 == int(0.1 / oi.COUNT)


def test_distance_and_angle_count_from_the_last_request():
    wire = Wire()
    wire.send("start")
    wire.send("safe")
    wire.run()
    wire.ask(19)
    wire.ask(20)
    wire.body.right_rotation += 0.235 * math.radians(90.5)
    assert wire.ask(20) == {20: 90}
    assert wire.ask(19) == {19: int(500 * 0.235 * math.radians(90.5))}
    assert wire.ask(19) == {19: 0}


def test_every_packet_and_group_is_answered():
    wire = Wire()
    wire.send("start")
    for number in [*oi.PACKETS, *oi.GROUPS]:
        assert sorted(wire.ask(number)) == sorted(oi.members(number))
    wire.send("query", 7, 13, 100)
    assert len(wire.run()) == 82


def test_a_stream_that_exceeds_its_slot_is_corrupt():
    for baud, good in ((115200, True), (57600, False)):
        wire = Wire(baud=baud)
        wire.send("start")
        wire.send("stream", 100, 106)  # 97 bytes a frame
        decoder = oi.StreamDecoder([100, 106])
        found = [event for event in decoder.feed(wire.run(0.3)) if isinstance(event, oi.SensorValues)]
        assert bool(found) == good


def test_a_stream_is_paused_resumed_and_cleared():
    wire = Wire()
    wire.send("start")
    wire.send("stream", 35)
    assert len(wire.run()) == 5
    wire.send("resume_stream", 0)
    assert wire.run(0.1) == b""
    wire.send("resume_stream", 1)
    assert len(wire.run()) == 5
    wire.send("stream")
    assert wire.run(0.1) == b""


def test_it_sleeps_after_five_idle_minutes_in_passive_and_wakes_on_brc():
    wire = Wire()
    wire.send("start")
    wire.run(299)
    assert not wire.robot.is_asleep
    wire.run(2)
    assert wire.robot.is_asleep
    wire.send("start")
    assert wire.run() == b""
    wire.robot.pulse_brc(1.0)
    wire.run(0.6)
    wire.send("start")
    assert wire.ask(35) == {35: oi.PASSIVE}


def test_it_never_sleeps_in_safe_mode():
    wire = Wire()
    wire.send("start")
    wire.send("safe")
    wire.run(400)
    assert not wire.robot.is_asleep


def test_reset_takes_seconds_and_prints_a_banner_in_pieces():
    wire = Wire().begin()
    wire.send("reset")
    assert wire.run(0.5) == b"Soft reset!\n"
    wire.send("start")  # nobody listens
    assert wire.run(1.0) == b"\xfe"
    assert wire.run(1.0) == b""
    text = wire.run(2.0)
    assert text.startswith(b"Roomba by iRobot!\r\n")
    assert b"r3_robot/tags/release-3.2.6:4975 CLEAN" in text
    assert wire.robot.mode == oi.OFF
    assert wire.begin().read(43) == 0  # the counters start again


def test_three_short_pulses_change_the_baud_rate_and_a_long_one_does_not():
    wire = Wire()
    for _ in range(3):
        wire.robot.pulse_brc(0.1)  # too early after power-up
    wire.run(3)
    for seconds in (0.1, 0.1, 1.0, 0.1, 0.1):
        wire.robot.pulse_brc(seconds)
    assert wire.robot.baud == 115200
    wire.robot.pulse_brc(0.5)
    assert wire.robot.baud == 19200


def test_after_a_change_of_the_baud_rate_the_robot_is_deaf_for_100_ms():
    wire = Wire().begin(("baud", 10))
    assert wire.robot.baud == 57600
    wire.run(0.06)
    wire.send("safe")
    assert wire.robot.mode == oi.PASSIVE
    wire.run(0.03)
    wire.send("safe")
    assert wire.robot.mode == oi.SAFE
    wire.begin("reset").run(5)
    assert wire.robot.baud == 115200


def test_driving_drains_the_battery():
    wire = Wire().begin("safe", ("drive_direct", 300, 300))
    before = wire.robot.charge_mah
    wire.run(60)
    assert 5.0 < before - wire.robot.charge_mah < 20.0


def test_an_empty_battery_ends_everything_until_it_is_charged():
    wire = Wire(baud=57600).begin("full", ("drive_direct", 200, 200), ("baud", 11))
    wire.robot.battery.charge_mah = 0.01
    wire.run(2)
    assert (wire.robot.mode, wire.robot.right.speed) == (oi.OFF, 0.0)
    wire.send("start")
    assert wire.run(1) == b""
    wire.robot.set_docked(True)
    text = wire.run(60)
    assert b"Roomba by iRobot!" in text
    assert wire.robot.baud == 57600
    assert wire.begin().read(21) == 2


@pytest.mark.parametrize("mode", ["start", "stop", "safe", "full"])
def test_it_charges_in_passive_and_off_only(mode):
    wire = Wire().begin()
    wire.robot.set_docked(True)
    wire.begin(mode)
    before = wire.robot.charge_mah
    wire.run(60)
    charges = mode in ("start", "stop")
    assert (wire.robot.charge_mah > before) == charges
    if mode != "stop":
        assert wire.ask(3)[21] == (2 if charges else 0)
        assert wire.read(34) == 2


def test_a_full_battery_is_charged_by_a_trickle():
    wire = Wire().begin()
    wire.robot.battery.charge_mah = CAPACITY_MAH
    wire.robot.set_docked(True)
    wire.run(1)
    assert wire.read(21) == 3


def test_docking_ends_safe_mode_once_but_a_plugged_charger_for_good():
    wire = Wire().begin("safe")
    wire.robot.set_docked(True)
    assert wire.read(35) == oi.PASSIVE
    assert wire.begin("safe").read(35) == oi.SAFE  # that is how a robot leaves its dock
    wire.robot.set_plugged(True)
    assert wire.begin("safe").read(35) == oi.PASSIVE
    assert wire.begin("full").read(35) == oi.FULL
    assert wire.read(34) == 3


def test_while_docked_in_off_it_prints_a_line_every_second():
    wire = Wire()
    wire.robot.set_docked(True)
    lines = wire.run(10.1).split(b"\r\n")
    assert len(lines) == 11
    assert lines[0].startswith(b"bat:   min 0  sec 1  mV 1")
    assert Wire(firmware="silent").run(10.0) == b""
    assert wire.begin().run(10.0) == b""


def test_it_says_when_it_falls_asleep():
    assert Wire().begin("power").run(60) == b""
    wire = Wire().begin()
    wire.send("power")
    assert wire.run(60) == b"processor-sleep\r\n"
    assert wire.robot.is_asleep
    assert Wire(firmware="silent").begin("power").run(1) == b""


@pytest.mark.parametrize("name", ["clean", "max", "spot"])
def test_cleaning_commands_move_the_robot_in_passive_and_a_second_one_pauses(name):
    wire = Wire().begin("full", name)
    wire.run(5)
    assert (wire.robot.programs.name, wire.robot.mode) == (name, oi.PASSIVE)
    assert wire.body.right_rotation > 0.5
    wire.send("clean")
    wire.run(2)
    assert wire.robot.right.speed == wire.robot.left.speed == 0.0
    wire.send(name)
    wire.send("start")  # any command of a mode ends it
    wire.run(2)
    assert wire.robot.right.speed == 0.0


def test_the_buttons_work_without_an_open_interface():
    wire = Wire()
    wire.run()
    wire.robot.press("spot")
    wire.run(1)
    assert (wire.robot.mode, wire.robot.programs.name) == (oi.OFF, "spot")
    wire.robot.press("clean")
    assert wire.robot.programs.name is None
    wire.begin("safe")
    wire.robot.press("spot")
    assert (wire.robot.mode, wire.robot.programs.name) == (oi.SAFE, None)
    wire.robot.press_clean()
    assert wire.robot.mode == oi.PASSIVE


def test_cleaning_backs_off_and_turns_where_something_is_in_the_way_and_waits_while_it_is_lifted():
    wire = Wire().begin("clean")
    wire.run(2)
    wire.body.bump_left = True
    wire.run()
    wire.body.bump_left = False
    before = wire.body.right_rotation
    wire.run(0.6)
    assert wire.robot.right.speed == wire.robot.left.speed < 0.0
    wire.run(0.5)
    assert wire.robot.right.speed > 0.0 > wire.robot.left.speed
    wire.body.wheel_drop_left = True
    wire.run(1)
    assert wire.robot.right.speed == 0.0
    wire.body.wheel_drop_left = False
    wire.run(4)
    assert wire.body.right_rotation > before


@pytest.mark.parametrize(
    "where", [(1.5, 0.0, 0.0), (1.5, 0.5, 0.3), (1.0, -0.4, -2.0), (0.4, 0.15, 3.0), (3.5, 1.5, 1.5)]
)
def test_seek_dock_drives_the_robot_onto_its_dock(where):
    wire = on_the_floor()
    wire.robot.dock = Dock(Pose(*where), wire.body)
    wire.begin("dock")
    for _ in range(120):
        wire.run(1)
        if wire.robot.is_docked:
            break
    assert wire.robot.is_docked
    wire.run(1)
    assert wire.robot.right.speed == 0.0
    assert wire.ask(3)[21] == 2
    assert wire.read(34) == 2
    assert math.dist((wire.body.pose.x, wire.body.pose.y), where[:2]) < 0.06


def test_driving_off_the_dock_is_noticed_and_its_beams_are_seen_in_front_of_it():
    wire = on_the_floor()
    assert wire.begin().read(17) == 0
    wire.robot.dock = Dock(Pose(0.0, 0.0, 0.0), wire.body)
    wire.begin("safe")
    assert wire.robot.is_docked
    assert wire.read(17) == 173
    wire.begin("safe", ("drive_direct", -200, -200))
    wire.run(1)
    assert wire.read(34) == 0
    wire.run(4)
    assert wire.read(17) == 172
    wire.run(10)
    assert wire.read(17) == 0


def test_being_carried_is_not_noticed_and_being_pushed_is_counted_up():
    wire = on_the_floor().begin()
    before = wire.read(43)
    wire.body.carry(1.0, 0.5, 0.2)
    assert wire.read(43) == before
    assert (wire.body.pose.x, wire.body.pose.y) == pytest.approx((1.0, 0.5))
    wire.body.push(-0.3, 0.0, 1.0)
    wire.run(2)
    assert (wire.read(43) - before) & 0xFFFF == pytest.approx(0.3 / oi.COUNT, abs=10)
    assert wire.body.pose.x == pytest.approx(1.0 - 0.3 * math.cos(0.2), abs=0.01)


def test_a_slipping_wheel_is_counted_but_moves_nothing():
    wire = on_the_floor().begin("safe")
    wire.body.body.slip(0.2, 0.2)
    wire.send("drive_direct", 200, 200)
    wire.run(3)
    assert wire.body.left_rotation - wire.body.pose.x == pytest.approx(0.2, abs=1e-6)


def test_songs_play_in_safe_and_full_only_and_not_over_each_other():
    wire = Wire().begin(("song", 1, 60, 64, 62, 64), ("song", 2, 70, 64), ("play", 1))
    assert wire.read(37) == 0
    wire.begin("safe", ("play", 1), ("play", 2))
    assert (wire.read(36), wire.read(37)) == (1, 1)
    wire.run(2)
    assert wire.read(37) == 0
    wire.begin("safe", ("play", 3))  # none was defined
    assert wire.read(37) == 0


def test_brushes_draw_current_until_safe_mode_ends():
    wire = Wire().begin("safe", ("motors", 0b10111))
    assert (wire.read(56), wire.read(57)) == (-400, 120)
    assert wire.read(23) == -160 - 400 - 120 - 800
    wire.begin("start")
    assert (wire.read(56), wire.read(57)) == (0, 0)


def test_a_button_pressed_by_command_is_released_after_a_sixth_of_a_second():
    wire = Wire().begin(("buttons", 0b00111000))
    assert wire.read(18) == 0b00111000
    wire.run(0.18)
    assert wire.read(18) == 0


def test_answers_interleave_with_a_stream_and_too_much_of_both_spoils_the_frame():
    wire = Wire(baud=19200).begin(("stream", 43, 44, 35))
    wire.send("sensors", 7)
    assert wire.run()[:2] == bytes((0, 19))
    wire.send("sensors", 6)  # 52 bytes of 28 a tick
    assert [len(wire.run()) for _ in range(3)] == [28, 28, 11]


def test_unknown_packets_are_met_with_silence():
    wire = Wire().begin()
    for command in ((142, 59), (149, 2, 7, 200), (148, 1, 99)):
        wire.robot.receive(bytes(command))
        assert wire.run(0.1) == b""
    assert wire.read(7) == 0


def test_an_unfinished_song_swallows_what_follows_and_36_starts_recover():
    wire = Wire().begin("safe")
    wire.robot.receive(bytes((140, 0, 16)))
    wire.send("drive_direct", 100, 100)
    assert wire.robot.right.target == 0.0
    for _ in range(36):
        wire.send("start")
    assert wire.read(35) == oi.PASSIVE


def test_what_happens_is_told_in_words():
    wire = Wire().begin("safe", ("drive_direct", 100, 100), ("drive_direct", 150, 110))
    wire.body.cliff = True
    wire.run()
    assert wire.told == [
        "mode passive: opcode 128",
        "mode safe: opcode 131",
        "drives forward: left 100, right 100 mm/s",
        "stands: left 0, right 0 mm/s",
        "mode passive: a cliff",
    ]


# ---- whatever comes --------------------------------------------------------------------------------------------------

ANY_QUIRKS = st.fixed_dictionaries(
    {},
    optional={
        "mode_offset": st.integers(0, 1),
        "distance_wrong": st.booleans(),
        "angle_wrong": st.booleans(),
        "mode_32_after_cliff": st.booleans(),
        "mode_packet_dead": st.booleans(),
        "stream_distance_zero": st.booleans(),
        "checksum": st.sampled_from(["inclusive", "exclusive"]),
        "answers_shift_after": st.sampled_from([None, 0.0, 0.1]),
        "cliffs_on_dock": st.booleans(),
        "mute_after": st.sampled_from([None, 0.3]),
        "encoders_swapped": st.booleans(),
        "encoder_start": st.integers(0, 65535),
        "freeze": st.sampled_from([0.0, 0.1]),
        "gauge_error_mah": st.floats(0.0, 5000.0),
        "firmware": st.sampled_from(["3.2.6", "stm32-3.7.7", "silent"]),
        "baud": st.sampled_from([115200, 57600, 19200]),
    },
)
COMMANDS = st.sampled_from(
    [oi.encode("start"), oi.encode("safe"), oi.encode("full"), oi.encode("drive_direct", 90, -9)]
)
HAPPENINGS = st.lists(
    st.one_of(
        st.binary(max_size=30),
        COMMANDS,
        st.sampled_from(["bump_left", "cliff", "wheel_drop_right"]),
        st.sampled_from(["clean", "dock", "clock"]).map(lambda name: ("press", name)),
        st.sampled_from(["dock", "plug", "battery", "empty", "pulse"]).map(lambda name: ("do", name)),
    ),
    max_size=40,
)


def happen(wire, what):
    robot = wire.robot
    if isinstance(what, bytes):
        robot.receive(what)
    elif isinstance(what, str):
        setattr(wire.body, what, not getattr(wire.body, what))
    elif what[0] == "press":
        robot.press(what[1])
    elif what[1] == "dock":
        robot.set_docked(not robot.is_docked)
    elif what[1] == "plug":
        robot.set_plugged(not robot.is_plugged)
    elif what[1] == "battery":
        robot.pull_battery()
    elif what[1] == "empty":
        robot.battery.charge_mah = 0.0
    else:
        robot.pulse_brc(0.1)


@settings(deadline=None, max_examples=150)
@given(quirks=ANY_QUIRKS, happenings=HAPPENINGS)
def test_whatever_happens_nothing_raises_and_nothing_moves_in_passive_or_off_but_its_own_programs(quirks, happenings):
    wire = Wire(**quirks)
    robot = wire.robot
    for what in happenings:
        happen(wire, what)
        sent = wire.run(0.03)
        assert len(sent) <= 2 * int(115200 * 0.0015)
        if robot.mode in (oi.OFF, oi.PASSIVE) and not robot.programs.is_running:
            assert robot.left.target == robot.right.target == 0.0
        assert not (robot.is_asleep and robot.left.target)


@settings(deadline=None, max_examples=50)
@given(data=st.binary(max_size=200), cuts=st.lists(st.integers(0, 200), max_size=6), seed=st.integers(0, 3))
def test_the_same_bytes_at_the_same_ticks_have_the_same_answer_however_they_are_cut(data, cuts, seed):
    whole, cut = Wire(), Wire()
    for wire, places in ((whole, []), (cut, sorted(cuts))):
        wire.begin("full")
        for start, end in zip([0, *places], [*places, None], strict=True):
            wire.robot.receive(data[start:end])
    assert whole.run(0.3) == cut.run(0.3)
    assert whole.robot.mode == cut.robot.mode
