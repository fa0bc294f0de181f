import asyncio
from itertools import pairwise

import pytest

from robotd.bus import Bus
from robotd.clock import now, run_virtual, stall
from robotd.control import ControlLoop
from robotd.odometry import Odometry, Wheels
from robotd.records import DriveCommand, SensorFrame, Withdrawal
from robotd.safety import SafetyGate, SafetyLimits


class FakeBase:
    name = "base"

    def __init__(self):
        self.log = []
        self.armed = []

    def drive(self, speed, turn_rate):
        self.log.append((round(now(), 3), speed, turn_rate))

    def halt(self):
        self.log.append((round(now(), 3), "halt"))

    def arm(self):
        self.armed.append(now())


class Robot:
    """A control loop between a base that obeys at once and somebody who wishes to move."""

    def __init__(self):
        self.bus, self.base = Bus(), FakeBase()
        self.loop = ControlLoop(self.bus, self.base, Odometry(Wheels()), SafetyGate(SafetyLimits()))
        self.travelled = 0.0
        self.speed = 0.2
        self.changes = {}
        self.events = []
        publish = self.bus.events.publish
        self.bus.events.publish = lambda event: (self.events.append(event), publish(event))

    def sense(self):
        self.travelled += 0.003
        changes = {"mode": "safe", **self.changes}
        self.bus.sensors.publish(SensorFrame(now(), self.travelled, self.travelled, **changes))

    async def run(self, seconds, *, sensors=True, commands=True):
        end = now() + seconds
        while now() < end - 1e-9:
            await asyncio.sleep(0.015)
            if commands:
                self.bus.commands.publish(DriveCommand(now(), self.speed, 0.0, "test"))
            if sensors:
                self.sense()

    def texts(self):
        return [event.text for event in self.events]


def control(scenario):
    async def main():
        robot = Robot()
        task = asyncio.create_task(robot.loop.run())
        await asyncio.sleep(0)
        try:
            await scenario(robot)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        return robot

    return run_virtual(main())


def last_motion(log):
    return max((entry[0] for entry in log if entry[1] not in ("halt", 0.0)), default=0.0)


def test_commands_become_ramped_motion_and_sensor_frames_become_odometry():
    async def scenario(robot):
        await robot.run(2.0)
        assert robot.loop.cause is None

    robot = control(scenario)
    speeds = [entry[1] for entry in robot.base.log if entry[1] != "halt"]
    assert max(speeds) == pytest.approx(0.2)
    assert max(abs(b - a) for a, b in pairwise(speeds)) <= 0.5 * 0.0351
    assert robot.bus.odometry.latest.travelled == pytest.approx(0.4, abs=0.01)
    assert robot.base.log[-1][1] == "halt", "whoever ends the loop halts the base"


@pytest.mark.parametrize(
    ("trouble", "limit", "words"),
    [
        (lambda robot: robot.run(1.0, sensors=False), 0.150 + 0.025, "no sensor frame"),
        (lambda robot: robot.run(1.0, commands=False), 0.200 + 0.025, "no drive command"),
        (lambda robot: robot.changes.update(bump_left=True) or robot.run(1.0), 0.030, "left bumper"),
    ],
)
def test_any_doubt_stops_the_wheels_in_time_and_says_why(trouble, limit, words):
    async def scenario(robot):
        await robot.run(1.0)
        await trouble(robot)
        assert words in robot.loop.cause
        assert any(text.startswith("stopped: ") and words in text for text in robot.texts())

    assert 0.9 < last_motion(control(scenario).base.log) <= 1.0 + limit


def test_of_a_backlog_every_frame_is_looked_at_but_only_the_last_one_steers():
    async def scenario(robot):
        await robot.run(1.0)
        robot.base.log.clear()
        for k in range(60):
            robot.changes = {"bump_left": k == 3}  # long over when the loop gets round to it
            robot.sense()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert [entry[1] for entry in robot.base.log] == ["halt"]
        assert "left bumper" in robot.loop.cause

    control(scenario)


def test_the_base_is_armed_only_while_somebody_wants_to_move():
    async def scenario(robot):
        robot.changes = {"mode": "passive"}
        await robot.run(1.0, commands=False)
        robot.speed = 0.0
        await robot.run(1.0)
        assert robot.base.armed == []
        robot.speed = 0.2
        await robot.run(1.0)
        assert len(robot.base.armed) > 60
        assert robot.loop.cause == "the base is in passive mode, not in safe mode"
        robot.changes = {}
        await robot.run(0.5)
        assert robot.loop.cause is None

    control(scenario)


def test_two_wishes_between_two_frames_are_both_heard():
    """The operator's, because it beats the follower's that comes after it."""

    async def scenario(robot):
        for _ in range(60):
            robot.bus.commands.publish(DriveCommand(now(), -0.1, 0.0, "operator"))
            await robot.run(0.015)
        assert robot.base.log[-1][1] == pytest.approx(-0.1)

    control(scenario)


def test_an_emergency_stop_and_a_withdrawal_do_not_wait_for_the_next_frame():
    async def scenario(robot):
        await robot.run(1.0)
        robot.loop.emergency_stop("the red button")
        assert robot.base.log[-1] == (round(now(), 3), "halt")
        robot.loop.release("the operator")
        await robot.run(1.0)
        await asyncio.sleep(0.001)
        robot.bus.withdrawals.publish(Withdrawal(now(), "test", "the operator's connection is gone"))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert robot.base.log[-1] == (round(now(), 3), "halt")
        assert robot.loop.cause == "the operator's connection is gone"

    control(scenario)


def test_a_person_reads_of_stops_latches_releases_and_of_moving_on_and_of_nothing_else():
    async def scenario(robot):
        await robot.run(1.0, commands=False)
        await robot.run(1.0)
        await robot.run(1.0, commands=False)
        await robot.run(2.0)
        robot.changes = {"cliff": True}
        await robot.run(1.0)
        robot.changes = {"cliff": True, "wheel_drop_left": True}
        await robot.run(1.0)
        robot.changes = {}
        robot.loop.release("the operator")
        await robot.run(0.1)
        robot.loop.release("the operator")
        await robot.run(2.0)
        robot.speed = 0.0
        await robot.run(2.0)

    assert control(scenario).texts() == [
        "stopped: no drive command for more than 0.2 s",
        "moving again after: no drive command for more than 0.2 s",
        "stopped: a cliff sensor sees no floor; held until released",
        "held until released: a cliff sensor sees no floor and the left wheel has dropped",
        "released by the operator: a cliff sensor sees no floor and the left wheel has dropped"
        "; still held: a cliff sensor sees no floor and the left wheel has dropped",
        "released by the operator: a cliff sensor sees no floor and the left wheel has dropped",
        "moving again after: a cliff sensor sees no floor",
    ]


def test_a_loop_that_is_late_again_and_again_is_told_of_once():
    async def scenario(robot):
        for _ in range(50):
            await robot.run(0.15)
            stall(0.2)
        await robot.run(3.0)

    texts = control(scenario).texts()
    assert [text.split(":")[0] for text in texts] == ["stopped", "moving again after"]
