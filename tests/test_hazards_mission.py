"""Hazards in the whole daemon: what the journal keeps, and what becomes of a mission."""

import asyncio
import sqlite3

import pytest

from robotd.clock import now, run_virtual, stall
from robotd.config import Calibration, Config, MissionConfig, RobotConfig
from robotd.daemon import Assembly, Daemon
from robotd.hardware import CameraMode
from robotd.plugin import Driver
from robotd.records import DriveCommand, SensorFrame
from tests.hazard_course import BRAKING, HAZARDS, REACTION, Course, straight

BY_NAME = {hazard.name: hazard for hazard in HAZARDS}


def some(*names):
    return pytest.mark.parametrize("hazard", [BY_NAME[name] for name in names], ids=names)


# ---- the journal -----------------------------------------------------------------------------------------------------


class Nothing(Driver):
    """Stands for the devices that this test does not need."""

    kind = "follower"
    blind = 0.0


@some("bump_left", "cliff", "operator_stop", "client_gone", "ladder_exhausted", "emergency", "overrun", "stale")
def test_the_cause_is_in_the_journal(tmp_path, hazard):
    async def main():
        course = Course()
        others = [Nothing(name, None, course, course.bus, Calibration()) for name in ("follower", "labels", "eye")]
        config = Config(RobotConfig("r", tmp_path), MissionConfig("s", (0.0,), ("a",)), drivers={})
        assembly = Assembly(
            *(tmp_path / "robotd.toml", config, Calibration(), course.bus, course, course.driver),
            *(others[0], others[1], {}, others[2]),
        )
        daemon = Daemon(assembly)
        course.loop = daemon.control
        tasks = [asyncio.create_task(daemon.run(mission=False)), asyncio.create_task(course.wishing())]
        await asyncio.sleep(1.0)
        await straight(course)
        assert course.is_moving
        await hazard.begin(course)
        await asyncio.sleep(1.0)
        assert not course.is_moving
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    run_virtual(main())
    with sqlite3.connect(tmp_path / "journal.sqlite") as journal:
        rows = journal.execute("SELECT source, level, text FROM events WHERE source = 'safety'").fetchall()
    assert any(hazard.words in text and text.startswith("stopped: ") for _, _, text in rows), rows


# ---- in a mission ----------------------------------------------------------------------------------------------------


class Walker(Nothing):
    """A follower without a camera: straight on."""

    mode = CameraMode()

    async def follow(self, travelled):
        with self.bus.odometry.subscribe() as odometry:
            async for state in odometry:
                rest = travelled - state.travelled
                self.bus.commands.publish(DriveCommand(now(), 0.2 if rest > 0.0 else 0.0, 0.0, self.name, now()))
                if rest <= 0.0 and state.speed == 0.0:
                    return


class Eye(Nothing):
    async def start(self, mode):
        pass

    async def stop(self):
        pass


class Silent(Nothing):
    async def flash(self, labels, strength, durations):
        return {}


def mission(tmp_path, scenario):
    """Run a mission of two stops, 2 m apart, beside `await scenario(course, daemon)`; returns course and daemon."""

    async def main():
        course = Course()
        follower, labels, eye = (
            cls(name, None, course, course.bus, Calibration())
            for cls, name in ((Walker, "follower"), (Silent, "labels"), (Eye, "eye"))
        )
        config = Config(RobotConfig("r", tmp_path), MissionConfig("s", (0.0, 2.0), ("a",)), drivers={})
        assembly = Assembly(
            *(tmp_path / "robotd.toml", config, Calibration(), course.bus, course, course.driver),
            *(follower, labels, {}, eye),
        )
        daemon = Daemon(assembly)
        course.loop = daemon.control
        running = asyncio.create_task(daemon.run(mission=True))
        await scenario(course, daemon)
        await running
        return course, daemon

    tmp_path.mkdir(exist_ok=True)
    return run_virtual(main())


async def until(course, state, *, moving=None):
    async with asyncio.timeout(300.0):
        while not (
            (status := course.bus.status.latest) is not None
            and (status.state, status.stop) == state
            and (moving is None or course.is_moving == moving)
        ):
            await asyncio.sleep(0.01)


def test_a_mission_without_hazards_makes_its_stops(tmp_path):
    async def scenario(course, daemon):
        pass

    course, daemon = mission(tmp_path, scenario)
    assert daemon.mission.ended is None
    assert len(daemon.mission.stops) == 2
    assert course.travelled == pytest.approx(2.0, abs=0.1)


@some("bump_left", "cliff", "wheel_drop_left", "operator_stop", "emergency")
def test_a_hazard_on_the_way_stops_the_robot_and_ends_the_mission_with_its_cause(tmp_path, hazard):
    async def scenario(course, daemon):
        await until(course, ("driving", 2), moving=True)
        await asyncio.sleep(1.0)
        start = await hazard.begin(course)
        await asyncio.sleep(max(0.0, start - now()) + REACTION + BRAKING)
        assert not course.is_moving

    course, daemon = mission(tmp_path, scenario)
    assert hazard.words in daemon.mission.ended
    assert len(daemon.mission.stops) == 1
    assert not course.is_moving


@pytest.mark.parametrize("state", ["settling", "observing"])
def test_a_bumper_that_was_hit_at_a_stop_keeps_the_robot_there(tmp_path, state):
    async def scenario(course, daemon):
        await until(course, (state, 1))
        course.body.bump_right = True
        await asyncio.sleep(0.1)
        course.body.bump_right = False
        course.where = course.travelled

    course, daemon = mission(tmp_path, scenario)
    assert daemon.mission.ended == "halted: the right bumper is pressed"
    assert course.travelled == course.where


def test_a_hazard_from_before_the_mission_does_not_hold_it_but_an_emergency_stop_does(tmp_path):
    async def lifted(course, daemon):
        for is_lifted in (True, False):
            daemon.control.gate.sensors(SensorFrame(now(), 0.0, 0.0, "passive", wheel_drop_left=is_lifted))
        assert daemon.control.gate.latched == "the left wheel has dropped"

    assert mission(tmp_path / "a", lifted)[1].mission.ended is None

    async def stopped(course, daemon):
        daemon.control.emergency_stop("the red button")

    course, daemon = mission(tmp_path / "b", stopped)
    assert daemon.mission.ended == "halted: emergency stop: the red button"
    assert course.travelled == 0.0


def test_arming_the_base_again_on_the_way_does_not_end_the_mission(tmp_path):
    async def scenario(course, daemon):
        await until(course, ("driving", 2), moving=True)
        await asyncio.sleep(1.0)
        course.robot.press_clean()
        await asyncio.sleep(0.3)
        stall(0.3)

    daemon = mission(tmp_path, scenario)[1]
    assert daemon.mission.ended is None
    assert len(daemon.mission.stops) == 2
