import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotd.records import DriveCommand, SensorFrame
from robotd.safety import SafetyGate, SafetyLimits

LIMITS = SafetyLimits()
TICK = 0.015


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
    after = rig.run(0.3)
    if latches:
        assert (after.speed, after.turn_rate, after.cause) == (0.0, 0.0, motion.cause)
        assert rig.gate.latched == motion.cause
        rig.gate.release()
        assert rig.tick(command=False).cause == "no drive command"  # an old wish does not count after a release
        after = rig.run(0.3)
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
    assert rig.run(1.0, bump_left=True).cause == "emergency stop: operator"


def test_limits_keep_the_curvature():
    rig = Rig()
    rig.speed, rig.turn_rate = 0.6, 0.9
    motion = rig.run(3.0)
    assert (motion.speed, motion.turn_rate) == pytest.approx((0.3, 0.45))
    rig.speed, rig.turn_rate = 0.2, -3.0
    motion = rig.run(3.0)
    assert (motion.speed, motion.turn_rate) == pytest.approx((0.1, -1.5))


@settings(deadline=None)
@given(wishes=st.lists(st.tuples(st.floats(allow_nan=True), st.floats(allow_nan=True)), min_size=1, max_size=40))
def test_no_wish_breaks_a_limit(wishes):
    rig = Rig()
    before = rig.tick(command=False)
    for rig.speed, rig.turn_rate in wishes:
        motion = rig.tick()
        assert abs(motion.speed) <= LIMITS.max_speed + 1e-12
        assert abs(motion.turn_rate) <= LIMITS.max_turn_rate + 1e-12
        if motion.cause is None:
            assert abs(motion.speed - before.speed) <= LIMITS.max_acceleration * TICK + 1e-9
            assert abs(motion.turn_rate - before.turn_rate) <= LIMITS.max_turn_acceleration * TICK + 1e-9
        else:
            assert (motion.speed, motion.turn_rate) == (0.0, 0.0)
            assert not (math.isfinite(rig.speed) and math.isfinite(rig.turn_rate))
        before = motion


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
