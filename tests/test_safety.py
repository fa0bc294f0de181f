import dataclasses
import math

import pytest
from hypothesis import given, settings, strategies as st

from robotd.records import DriveCommand, SensorFrame
from robotd.safety import SafetyGate, SafetyLimits

LIMITS = SafetyLimits()
TICK = 0.015
HALF_BASE = 0.1175


class Rig:
    """A gate, its clock, and what a healthy robot would feed it."""

    def __init__(self, limits=LIMITS):
        self.gate = SafetyGate(limits)
        self.t = 10.0
        self.speed, self.turn_rate = 0.2, 0.4

    def frame(self, **changes):
        return dataclasses.replace(SensorFrame(self.t, 0.0, 0.0, "safe"), **changes)

    def tick(self, *, sensors=True, command=True, wait=TICK, **changes):
        self.t += wait
        if sensors:
            self.gate.sensors(self.frame(**changes))
        if command:
            self.gate.command(DriveCommand(self.t, self.speed, self.turn_rate, "test"))
        return self.gate.output(self.t)

    def run(self, seconds, **how):
        motions = [self.tick(**how) for _ in range(round(seconds / TICK))]
        return motions[-1]


def standing(rig):
    rig.speed = rig.turn_rate = 0.0
    rig.run(0.3)
    rig.speed, rig.turn_rate = 0.2, 0.4


def accelerating(rig):
    rig.run(0.2)


def cruising(rig):
    assert rig.run(1.5).speed == pytest.approx(0.2)


def turning(rig):
    rig.speed = 0.0
    rig.run(1.5)


def reversing(rig):
    rig.speed = -0.2
    rig.run(1.5)


def already_held(rig):
    rig.gate.emergency_stop("first")
    rig.run(0.1)
    rig.gate.release()
    rig.tick()


STATES = [lambda rig: None, standing, accelerating, cruising, turning, reversing, already_held]
STATE_NAMES = ["fresh", "standing", "accelerating", "cruising", "turning", "reversing", "released"]


def until_stale(rig):
    rig.run(0.135, sensors=False)
    return rig.tick(sensors=False, wait=0.02)


def until_expired(rig):
    rig.run(0.195, command=False)
    return rig.tick(command=False)


def emergency(rig):
    rig.gate.emergency_stop("operator")
    return rig.tick()


# hazard, how it comes about, words that must be in the cause, whether it stays until release
HAZARDS = [
    ("bump_left", lambda rig: rig.tick(bump_left=True), "left bumper", True),
    ("bump_right", lambda rig: rig.tick(bump_right=True), "right bumper", True),
    ("cliff", lambda rig: rig.tick(cliff=True), "cliff", True),
    ("wheel_drop_left", lambda rig: rig.tick(wheel_drop_left=True), "left wheel", True),
    ("wheel_drop_right", lambda rig: rig.tick(wheel_drop_right=True), "right wheel", True),
    ("emergency", emergency, "emergency stop: operator", True),
    ("overcurrent", lambda rig: rig.tick(overcurrent=True), "current", False),
    ("passive", lambda rig: rig.tick(mode="passive"), "passive mode", False),
    ("full", lambda rig: rig.tick(mode="full"), "full mode", False),
    ("unknown", lambda rig: rig.tick(mode="unknown"), "unknown mode", False),
    ("stale", until_stale, "no sensor frame from the base for more than 0.15 s", False),
    ("expired", until_expired, "no drive command for more than 0.2 s", False),
    ("late", lambda rig: rig.tick(wait=0.12), "control loop was late: 0.120 s", False),
]


@pytest.mark.parametrize("state", STATES, ids=STATE_NAMES)
@pytest.mark.parametrize(("how", "words", "latches"), [h[1:] for h in HAZARDS], ids=[h[0] for h in HAZARDS])
def test_every_hazard_halts_from_every_state_at_once_and_is_named(state, how, words, latches):
    rig = Rig()
    rig.tick()
    state(rig)
    motion = how(rig)
    assert (motion.speed, motion.turn_rate) == (0.0, 0.0)
    assert words in motion.cause
    after = rig.run(0.6)
    if latches:
        assert (after.speed, after.turn_rate, after.cause) == (0.0, 0.0, motion.cause)
        assert rig.gate.latched == motion.cause
        rig.gate.release()
        assert rig.tick(command=False).cause == "no drive command"  # an old wish does not count after a release
        after = rig.run(0.6)
    assert after.cause is None
    assert abs(after.speed) + abs(after.turn_rate) > 0.0


def test_nothing_moves_before_the_first_sensor_frame_or_command():
    rig = Rig()
    assert rig.gate.output(rig.t).cause == "no sensor frame from the base yet"
    assert rig.tick(sensors=False).cause == "no sensor frame from the base yet"
    rig = Rig()
    assert rig.tick(command=False).cause == "no drive command"


def test_a_bump_between_two_outputs_is_not_missed():
    rig = Rig()
    rig.run(1.0)
    rig.gate.sensors(rig.frame(bump_left=True, bump_right=True))
    motion = rig.tick()
    assert motion.cause == "the left bumper is pressed and the right bumper is pressed"


def test_release_while_the_hazard_is_present_does_not_move():
    rig = Rig()
    rig.tick(cliff=True)
    rig.gate.release()
    assert rig.tick(cliff=True).cause == "a cliff sensor sees no floor"
    rig.gate.release()
    rig.run(0.1)
    assert "cliff" in rig.run(0.1).cause


def test_an_emergency_stop_survives_everything_but_release():
    rig = Rig()
    rig.gate.emergency_stop("operator")
    rig.run(5.0)
    assert rig.run(1.0, bump_left=True).cause == "emergency stop: operator and the left bumper is pressed"
    rig.gate.emergency_stop("somebody else")
    rig.run(0.1)
    rig.gate.resume()
    assert rig.run(1.0).cause == "emergency stop: operator"
    rig.gate.release()
    assert rig.run(0.1).cause is None


def test_limits_keep_the_curvature():
    rig = Rig()
    rig.speed, rig.turn_rate = 0.6, 0.3
    motion = rig.run(3.0)
    assert motion.speed / motion.turn_rate == pytest.approx(2.0)
    assert motion.speed + HALF_BASE * motion.turn_rate == pytest.approx(0.3)  # the outer wheel
    rig.speed, rig.turn_rate = 0.1, -3.0
    motion = rig.run(3.0)
    assert (motion.speed, motion.turn_rate) == pytest.approx((0.05, -1.5))


def test_a_start_follows_the_curve_that_is_asked():
    rig = Rig()
    rig.speed, rig.turn_rate = 0.2, 0.6
    rig.tick(command=False)
    for _ in range(40):
        motion = rig.tick()
        assert motion.turn_rate == pytest.approx(3.0 * motion.speed)
    assert motion.speed == pytest.approx(0.2)


WISHES = st.tuples(st.floats(-1.0, 1.0), st.floats(-6.0, 6.0)) | st.tuples(
    st.floats(allow_nan=True), st.floats(allow_nan=True)
)


@settings(deadline=None)
@given(wishes=st.lists(WISHES, min_size=1, max_size=40))
def test_no_wish_breaks_a_limit(wishes):
    rig = Rig()
    before = rig.tick(command=False)
    for rig.speed, rig.turn_rate in wishes:
        for _ in range(3):
            motion = rig.tick()
            assert abs(motion.speed) <= LIMITS.max_speed + 1e-12
            assert abs(motion.turn_rate) <= LIMITS.max_turn_rate + 1e-12
            assert abs(motion.speed) + HALF_BASE * abs(motion.turn_rate) <= 0.3 + 1e-12
            if motion.cause is None:
                assert abs(motion.speed) - abs(before.speed) <= LIMITS.max_acceleration * TICK + 1e-9
                assert abs(motion.turn_rate) - abs(before.turn_rate) <= LIMITS.max_turn_acceleration * TICK + 1e-9
            else:
                assert (motion.speed, motion.turn_rate) == (0.0, 0.0)
                assert not (math.isfinite(rig.speed) and math.isfinite(rig.turn_rate))
            before = motion


def test_leaving_a_tight_turn_keeps_the_acceleration_limit():
    rig = Rig()
    rig.speed, rig.turn_rate = 0.3, 1.5
    before = rig.run(3.0)
    rig.turn_rate = 0.0
    for _ in range(60):
        motion = rig.tick()
        assert motion.speed - before.speed <= LIMITS.max_acceleration * TICK + 1e-9
        before = motion
    assert motion.speed == pytest.approx(0.3)


def test_it_starts_and_slows_down_gently_when_nothing_is_wrong():
    rig = Rig()
    rig.turn_rate = 0.0
    rig.tick(command=False)
    speeds = [rig.tick().speed for _ in range(60)]
    assert speeds[:2] == pytest.approx([0.0075, 0.015])
    assert speeds[-1] == pytest.approx(0.2)
    rig.speed = 0.0
    assert rig.tick().speed == pytest.approx(0.1925)


def test_a_limit_of_zero_stands_still():
    rig = Rig(SafetyLimits(max_speed=0.0, max_turn_rate=0.0))
    motion = rig.run(1.0)
    assert (motion.speed, motion.turn_rate, motion.cause) == (0.0, 0.0, None)


# ---- stamps and clocks -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamp", [3600.0, 0.5, math.nan, math.inf])
def test_a_sensor_frame_that_is_not_from_now_never_counts_as_fresh(stamp):
    rig = Rig()
    rig.run(1.0)
    motion = rig.tick(t=rig.t + TICK + stamp)
    assert (motion.speed, motion.turn_rate) == (0.0, 0.0)
    assert "sensor frame" in motion.cause
    assert rig.run(5.0, sensors=False).cause is not None
    assert rig.run(0.1).cause is None  # good frames mend it


@pytest.mark.parametrize("stamp", [3600.0, 0.5, math.nan, math.inf])
def test_a_wish_that_is_not_from_now_does_not_live_longer(stamp):
    rig = Rig()
    rig.run(1.0)
    rig.t += TICK
    rig.gate.sensors(rig.frame())
    rig.gate.command(DriveCommand(rig.t + stamp, 0.2, 0.0, "test"))
    motion = rig.gate.output(rig.t)
    assert (motion.speed, motion.turn_rate) == (0.0, 0.0)
    assert "drive command" in motion.cause


def test_a_clock_that_goes_back_stops_the_robot_until_a_new_wish():
    rig = Rig()
    rig.run(1.0)
    rig.t -= 0.5
    motion = rig.tick()
    assert (motion.speed, motion.cause) == (0.0, "the clock went back by 0.485 s")
    assert rig.run(0.3).cause is None


def test_wishes_from_before_an_overrun_do_not_count_after_it():
    rig = Rig()
    rig.run(1.0)
    wish = DriveCommand(rig.t + 0.115, 0.2, 0.0, "test")
    rig.t += 0.12
    rig.gate.command(wish)
    rig.gate.sensors(rig.frame())
    assert "late" in rig.gate.output(rig.t).cause
    motions = [rig.tick(command=False) for _ in range(8)]
    assert motions[-1].cause == "no drive command"
    assert all(motion.speed == 0.0 for motion in motions)


def test_a_loop_that_is_late_again_and_again_never_moves():
    rig = Rig()
    rig.tick()
    for _ in range(20):
        rig.tick(wait=0.12)
        assert all(rig.tick().speed == 0.0 for _ in range(5))


# ---- overcurrent -----------------------------------------------------------------------------------------------------


def test_after_overcurrent_the_wheels_rest_for_half_a_second():
    rig = Rig()
    rig.run(1.0)
    rig.tick(overcurrent=True)
    assert "current" in rig.run(0.48).cause
    assert rig.run(0.1).cause is None


def test_an_overcurrent_between_two_outputs_is_not_missed():
    rig = Rig()
    rig.run(1.0)
    rig.gate.sensors(rig.frame(overcurrent=True))
    assert "current" in rig.tick().cause


def test_overcurrent_again_and_again_latches():
    rig = Rig()
    rig.run(1.0)
    for _ in range(3):
        rig.run(0.15, overcurrent=True)
        rig.run(0.6)
    assert rig.run(20.0).cause == "a motor drew too much current 3 times within 10 s"
    rig.gate.resume()
    assert rig.run(0.1).cause is None
    for _ in range(5):
        rig.tick(overcurrent=True)
        assert rig.run(6.0).cause is None


# ---- several sources -------------------------------------------------------------------------------------------------


def say(rig, source, speed, **more):
    rig.gate.command(DriveCommand(rig.t, speed, 0.0, source, **more))


def settled(rig, *wishes, seconds=1.0):
    """The speed after these (source, speed) were wished in every tick."""
    for _ in range(round(seconds / TICK)):
        motion = rig.tick(command=False)
        for source, speed in wishes:
            say(rig, source, speed)
    return motion


def test_an_operator_s_fresh_wish_beats_a_follower_s_in_any_order():
    for wishes in ((("follower", 0.2), ("operator", -0.1)), (("operator", -0.1), ("follower", 0.2))):
        assert settled(Rig(), *wishes).speed == pytest.approx(-0.1)


def test_an_operator_who_stands_still_holds_the_follower():
    assert settled(Rig(), ("operator", 0.0), ("follower", 0.2)).speed == 0.0


def test_the_follower_goes_on_when_the_operator_s_wish_has_expired():
    rig = Rig()
    settled(rig, ("operator", -0.1))
    assert settled(rig, ("follower", 0.2)).speed == pytest.approx(0.2)


def test_among_others_the_latest_wish_wins():
    assert settled(Rig(), ("follower", 0.2), ("calibration", 0.1)).speed == pytest.approx(0.1)


def test_a_withdrawn_wish_stops_at_once_with_its_reason_until_the_source_wishes_to_move_again():
    rig = Rig()
    settled(rig, ("follower", 0.2))
    late = DriveCommand(rig.t, 0.2, 0.0, "follower")
    rig.gate.withdraw("follower", "line lost: searched everywhere", rig.t)
    rig.gate.command(late)  # was under way when it was withdrawn
    motion = rig.tick(command=False)
    assert (motion.speed, motion.cause) == (0.0, "line lost: searched everywhere")
    assert settled(rig, ("follower", 0.0)).cause == "line lost: searched everywhere"
    assert settled(rig, ("follower", 0.2)).speed == pytest.approx(0.2)


def test_withdrawing_is_nobody_else_s_business():
    rig = Rig()
    settled(rig, ("follower", 0.2))
    rig.gate.withdraw("operator", "the operator's connection is gone", rig.t)
    assert settled(rig, ("follower", 0.2), seconds=0.1).speed == pytest.approx(0.2)


def test_an_operator_s_stop_holds_everybody_until_the_operator_has_let_go_and_wishes_anew():
    rig = Rig()
    settled(rig, ("follower", 0.2), ("operator", 0.1))
    rig.gate.withdraw(None, "stopped by the operator", rig.t)
    assert settled(rig, ("follower", 0.2), ("operator", 0.1)).cause == "stopped by the operator"
    assert rig.gate.latched == "stopped by the operator"
    assert settled(rig, ("operator", 0.0), seconds=0.1).cause == "stopped by the operator"
    assert settled(rig, ("operator", 0.1)).speed == pytest.approx(0.1)
    assert settled(rig, ("follower", 0.2)).speed == pytest.approx(0.2)


def test_after_an_operator_s_stop_the_operator_may_drive_who_did_not_before():
    rig = Rig()
    settled(rig, ("follower", 0.2))
    rig.gate.withdraw(None, "stopped by the operator", rig.t)
    assert settled(rig, ("follower", 0.2)).speed == 0.0
    assert settled(rig, ("operator", 0.1)).speed == pytest.approx(0.1)


def test_a_wish_that_was_under_way_does_not_end_an_operator_s_stop():
    rig = Rig()
    settled(rig, ("follower", 0.2))
    first = DriveCommand(rig.t, 0.2, 0.0, "operator")
    rig.gate.withdraw(None, "stopped by the operator", rig.t)
    rig.gate.command(first)
    assert rig.tick(command=False).cause == "stopped by the operator"
    assert settled(rig, ("operator", 0.2)).cause == "stopped by the operator"  # the stick is held since before


@pytest.mark.parametrize("speed", [math.nan, math.inf])
def test_nonsense_does_not_end_an_operator_s_stop(speed):
    rig = Rig()
    rig.gate.withdraw(None, "stopped by the operator", rig.t)
    assert settled(rig, ("operator", 0.0), ("operator", speed)).cause == "stopped by the operator"


def test_resuming_ends_an_operator_s_stop():
    rig = Rig()
    rig.gate.withdraw(None, "stopped by the operator", rig.t)
    assert settled(rig, ("follower", 0.2)).speed == 0.0
    rig.gate.resume()
    assert settled(rig, ("follower", 0.2)).speed == pytest.approx(0.2)


# ---- the base's mode -------------------------------------------------------------------------------------------------


def test_only_who_wants_to_move_arms_the_base_and_only_if_nothing_else_speaks_against_it():
    rig = Rig()
    assert not rig.tick(command=False, mode="passive").arm
    motion = rig.tick(mode="passive")
    assert motion.arm
    assert motion.cause == "the base is in passive mode, not in safe mode"
    assert rig.tick().arm
    rig.speed = rig.turn_rate = 0.0
    rig.run(1.0)
    motion = rig.tick(mode="passive")
    assert (motion.arm, motion.cause) == (False, None)  # standing still needs no mode
    rig.speed = 0.2
    assert not rig.tick(mode="passive", bump_left=True).arm
    rig.gate.release()
    rig.gate.emergency_stop("operator")
    assert not rig.tick(mode="passive").arm


def test_a_wish_to_stand_still_in_the_wrong_mode_does_not_roll_out():
    rig = Rig()
    rig.run(1.0)
    rig.speed = rig.turn_rate = 0.0
    assert rig.tick(mode="passive").speed == 0.0
    assert rig.tick().speed == 0.0


# ---- the line --------------------------------------------------------------------------------------------------------


def roll(rig, metres, *, line_t, speed=0.2, step=0.005, way=(1.0, 1.0)):
    """Drive so far by the wheels' counts with a wish that follows a line; the last motion."""
    motion = None
    for _ in range(round(metres / step)):
        rig.t += TICK
        rig.way = getattr(rig, "way", 0.0) + step
        rig.gate.sensors(SensorFrame(rig.t, rig.way * way[0], rig.way * way[1], "safe"))
        rig.gate.command(DriveCommand(rig.t, speed, 0.0, "follower", rig.t - 0.1 if line_t is None else line_t))
        motion = rig.gate.output(rig.t)
    return motion


def test_the_robot_stops_0_3_m_after_the_line_was_last_seen():
    rig = Rig()
    assert roll(rig, 1.0, line_t=None).cause is None
    seen = rig.t
    assert roll(rig, 0.295, line_t=seen).cause is None
    motion = roll(rig, 0.015, line_t=seen)
    assert (motion.speed, motion.cause) == (0.0, "line lost: follower has not seen it for 0.30 m")
    assert roll(rig, 1.0, line_t=seen).cause is not None
    assert roll(rig, 0.1, line_t=None).cause is None


def test_the_stamp_and_not_the_wish_says_where_the_line_was_seen():
    rig = Rig()
    roll(rig, 1.0, line_t=None)
    assert roll(rig, 0.005, line_t=rig.t - 40 * TICK).cause is None  # 0.2 m ago
    assert "line lost" in roll(rig, 0.005, line_t=rig.t - 70 * TICK).cause  # 0.35 m ago
    assert "line lost" in roll(rig, 0.005, line_t=-math.inf).cause
    assert "line lost" in roll(rig, 0.005, line_t=math.nan).cause


def test_a_stamp_from_the_future_does_not_prolong_the_way():
    rig = Rig()
    roll(rig, 1.0, line_t=None)
    assert roll(rig, 0.295, line_t=1e9).cause is None
    assert "line lost" in roll(rig, 0.015, line_t=1e9).cause


def test_backwards_counts_as_driven_and_turning_on_the_spot_does_not():
    rig = Rig()
    roll(rig, 1.0, line_t=None)
    seen = rig.t
    assert "line lost" in roll(rig, 0.31, line_t=seen, way=(-1.0, -1.0), speed=-0.2).cause
    rig = Rig()
    roll(rig, 0.5, line_t=None, way=(1.0, -1.0))
    assert roll(rig, 1.0, line_t=rig.t, way=(1.0, -1.0)).cause is None


def test_standing_and_driving_without_a_line_need_none():
    rig = Rig()
    roll(rig, 1.0, line_t=None)
    assert roll(rig, 1.0, line_t=0.0, speed=0.0).cause is None
    rig.gate.command(DriveCommand(rig.t, 0.2, 0.0, "operator"))
    assert rig.gate.output(rig.t).cause is None


def test_a_robot_that_lost_the_line_may_turn_on_the_spot_to_search_it():
    rig = Rig()
    roll(rig, 1.0, line_t=None)
    seen = rig.t
    assert "line lost" in roll(rig, 0.31, line_t=seen).cause
    rig.gate.command(DriveCommand(rig.t, 0.0, 0.5, "follower", seen))
    assert rig.gate.output(rig.t).cause is None
    rig.gate.command(DriveCommand(rig.t, 0.01, 0.5, "follower", seen))
    assert "line lost" in rig.gate.output(rig.t).cause


def test_what_the_camera_cannot_see_is_added_to_the_way():
    rig = Rig()
    rig.gate = SafetyGate(LIMITS, blind=0.25)
    roll(rig, 1.0, line_t=None)
    seen = rig.t
    assert roll(rig, 0.545, line_t=seen).cause is None
    assert "line lost: follower has not seen it for 0.55 m" in roll(rig, 0.015, line_t=seen).cause


def test_a_long_drive_needs_no_more_memory():
    rig = Rig()
    roll(rig, 5.0, line_t=None)
    rows = len(rig.gate._line._way)
    roll(rig, 20.0, line_t=None)
    assert len(rig.gate._line._way) <= rows + 1
