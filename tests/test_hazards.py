"""Every hazard from every state, bytes in to bytes out, in virtual time: simulated robot, real driver, real loop."""

import asyncio

import numpy as np
import pytest

from robotd.clock import now, stall
from robotd.records import Withdrawal
from tests.hazard_course import (
    BRAKING,
    EPSILON,
    HAZARDS,
    MOVING,
    REACTION,
    STATES,
    being_rearmed,
    braking,
    by_hand,
    drive,
    emergency_stopped,
    frame_of_the_next_tick,
    shut_down,
    straight,
)


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.__name__)
@pytest.mark.parametrize("hazard", HAZARDS, ids=lambda hazard: hazard.name)
def test_every_hazard_stops_the_robot_from_every_state(hazard, state):
    async def scenario(course):
        await state(course)
        assert course.is_moving == (state in MOVING or state is being_rearmed), "the state is what its name says"
        wished = course.wishes and bool(course.speed or course.turn_rate)
        course.causes.clear()
        begun = now()
        start = await hazard.begin(course)
        where = course.travelled
        await asyncio.sleep(max(0.0, start - now()) + REACTION + 0.3)
        drives = course.wire.drives
        late = [row for row in drives if row[0] > start + REACTION + EPSILON and (row[1] or row[2])]
        assert late == [], "no command moves the robot after the time allowed"
        if state in MOVING and state is not braking:
            zero = next(t for t, right, left in drives if t >= begun and right == left == 0)
            assert zero <= start + REACTION + EPSILON
        await asyncio.sleep(BRAKING - 0.3)
        assert not course.is_moving
        assert abs(course.travelled - where) < 0.3 * (start - begun + REACTION) + 0.07
        if wished or not hazard.needs_wish:
            words = ("emergency stop", hazard.words) if state is emergency_stopped else (hazard.words,)
            assert any(word in str(cause) for cause in course.causes for word in words)
        if state in MOVING - {braking} and hazard.begin is not shut_down:
            assert any(text.startswith("stopped: ") for text in course.said(hazard.words))

    drive(scenario)


@pytest.mark.parametrize(("speed", "turn_rate"), [(0.3, 0.0), (0.1, 0.0), (0.2, 0.8), (-0.3, 0.0)])
def test_the_robot_goes_no_farther_than_0_3_m_without_seeing_the_line(speed, turn_rate):
    async def scenario(course):
        course.wish(speed, turn_rate)
        await asyncio.sleep(1.2)
        course.sees_line = False
        since = course.travelled
        while abs(course.travelled - since) < 0.299 - 0.09 * abs(speed):
            await asyncio.sleep(0.005)
        assert course.is_moving or course.loop.cause
        reached = await frame_of_the_next_tick(course)
        await asyncio.sleep(REACTION + BRAKING)
        assert not course.is_moving
        assert [row for row in course.wire.drives if row[0] > reached + REACTION and any(row[1:])] == []
        assert 0.2 < abs(course.travelled - since) < 0.3 + abs(speed) * 0.03 + 0.5 * speed**2 / 0.75 + 0.01
        assert course.loop.cause == "line lost: follower has not seen it for 0.30 m"
        assert course.said("stopped: line lost")
        course.sees_line = True
        await asyncio.sleep(1.5)
        assert course.is_moving
        assert course.said("moving again after: line lost")

    drive(scenario)


def test_the_stop_from_0_3_m_s_takes_less_than_10_cm():
    async def scenario(course):
        await straight(course)
        course.body.cliff = True
        where = course.travelled
        await asyncio.sleep(1.0)
        assert not course.is_moving
        course.distance = course.travelled - where

    assert 0.0 < drive(scenario).distance < 0.10


# ---- coming back -----------------------------------------------------------------------------------------------------


def test_a_bumper_holds_until_it_is_released_and_then_a_new_wish_moves_the_robot():
    async def scenario(course):
        await straight(course)
        course.body.bump_left = True
        await asyncio.sleep(0.5)
        course.loop.release("the operator")
        assert "still held: the left bumper" in course.events[-1].text
        course.body.bump_left = False
        await asyncio.sleep(0.5)
        assert not course.is_moving
        course.loop.release("the operator")
        assert course.events[-1].text == "released by the operator: the left bumper is pressed"
        await asyncio.sleep(1.5)
        assert course.is_moving
        assert course.said("moving again after: the left bumper is pressed")

    drive(scenario)


def test_an_emergency_stop_outlasts_a_mission_s_start_and_new_wishes():
    async def scenario(course):
        await straight(course)
        course.loop.emergency_stop("the red button")
        await asyncio.sleep(0.5)
        course.loop.resume("the mission's start")
        await asyncio.sleep(1.0)
        assert not course.is_moving
        assert course.loop.cause == "emergency stop: the red button"
        course.loop.release("the operator")
        await asyncio.sleep(0.5)
        assert course.is_moving

    drive(scenario)


def test_an_overrun_s_stop_ends_when_the_loop_is_on_time_again_and_a_new_wish_is_there():
    async def scenario(course):
        await straight(course)
        stall(0.3)
        await asyncio.sleep(0.09)
        assert "late" in course.loop.cause
        await asyncio.sleep(0.3)
        assert course.is_moving
        assert course.loop.cause is None

    drive(scenario)


def test_the_base_is_armed_again_after_its_button_was_pressed_and_drives_on():
    async def scenario(course):
        await straight(course)
        course.robot.press_clean()
        await asyncio.sleep(1.0)
        assert course.is_moving
        assert course.said("stopped: the base is in passive mode")

    drive(scenario)


def test_after_an_operator_s_stop_a_stick_that_is_still_held_does_not_move_the_robot():
    async def scenario(course):
        await by_hand(course)
        course.bus.withdrawals.publish(Withdrawal(now(), None, "stopped by the operator"))
        await asyncio.sleep(2.0)
        assert not course.is_moving
        course.wish(0.0, 0.0)
        await asyncio.sleep(0.1)
        course.wish(0.2, 0.0)
        await asyncio.sleep(0.5)
        assert course.is_moving

    drive(scenario)


def test_nothing_is_told_while_the_robot_stands_about():
    async def scenario(course):
        course.events.clear()
        await asyncio.sleep(60.0)
        course.wish(0.0, 0.0)
        await asyncio.sleep(10.0)
        assert course.events == []

    drive(scenario)


def test_lateness_all_the_time_never_moves_the_robot_blindly():
    """A loop that hangs for 30 to 400 ms again and again: after every hang the first command is zero or on time."""

    async def scenario(course):
        rng = np.random.default_rng(5)
        course.wish(0.3, 0.0)
        for _ in range(60):
            await asyncio.sleep(rng.uniform(0.05, 0.6))
            hang = rng.uniform(0.03, 0.4)
            sent = len(course.wire.drives)
            stall(hang)
            await asyncio.sleep(0.021)
            if hang > 0.1:
                assert course.wire.drives[sent:], "a command follows at once"
                assert all(right == left == 0 for _, right, left in course.wire.drives[sent:])
        assert course.said("the control loop was late")

    drive(scenario)
