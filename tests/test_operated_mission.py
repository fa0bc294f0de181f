"""A mission in an operator's hands: paused and resumed at any instant, aborted, driven by hand, lifted, continued."""

import asyncio
import sqlite3

import numpy as np
import pytest

from robotd import rpc
from robotd.clock import now
from tests.hazard_course import BRAKING
from tests.operated import operated


def stops_of(robot):
    return [(stop.leg, stop.stop) for stop in robot.daemon.mission.stops]


def test_a_mission_is_started_once_and_makes_its_stops(tmp_path):
    async def scenario(robot, client):
        assert "no survey 'store' to go on with" in (await client.call("survey.continue"))["message"]
        assert "there is no stop 4" in (await client.call("mission.start", stop=4))["message"]
        assert (await client.call("mission.start"))["leg"] == 1
        assert "a mission is under way" in (await client.call("mission.start"))["message"]
        await robot.until("done")
        assert "has 3 stops already" in (await client.call("mission.start"))["message"]
        listed = (await client.call("stops.list"))["stops"]
        assert [stop["stop"] for stop in listed] == [1, 2, 3]
        assert listed[-1]["x"] == pytest.approx(2.0, abs=0.05)
        assert [item["stops"] for item in (await client.call("survey.list"))["surveys"]] == [3]
        survey = await client.call("survey.export")
        assert (survey["format"], len(survey["stops"])) == ("robotd-survey/1", 3)
        assert (await client.call("stops.show", stop=2))["record"]["stop"] == 2
        assert "there is no stop 9" in (await client.call("stops.show", stop=9))["message"]

    robot = operated(tmp_path, scenario)
    assert robot.daemon.mission.ended is None


def test_the_trail_has_ten_points_a_second_from_the_first_move_after_a_long_rest(tmp_path):
    async def scenario(robot, client):
        await asyncio.sleep(60.0)
        await client.call("mission.start")
        await robot.until("done")

    operated(tmp_path, scenario)
    with sqlite3.connect(tmp_path / "state" / "journal.sqlite") as connection:
        rows = np.array(connection.execute("SELECT t, x FROM trail ORDER BY t").fetchall())
    connection.close()
    rows = rows[rows[:, 1] > 0.0]
    assert rows[0, 1] < 0.05
    moving = np.diff(rows[:, 1]) > 0.01
    assert moving.sum() > 80
    assert np.diff(rows[:, 0])[moving].max() < 0.15


@pytest.mark.parametrize("state", ["driving", "settling", "observing"])
def test_a_mission_that_is_paused_stands_still_and_goes_on_where_it_was(tmp_path, state):
    async def scenario(robot, client):
        assert "no mission is under way" in (await client.call("mission.pause"))["message"]
        await client.call("mission.start")
        await robot.until(state, 2)
        await asyncio.sleep(0.3)
        assert await client.call("mission.pause") == {}
        await asyncio.sleep(BRAKING + 0.1)
        status = await client.call("mission.status")
        assert (status["state"], status["stop"]) == ("paused", 2)
        assert "paused by" in status["text"]
        assert not robot.course.is_moving
        where = robot.course.travelled
        await asyncio.sleep(20.0)
        assert robot.course.travelled == where
        assert await client.call("mission.resume") == {}
        assert "not paused" in (await client.call("mission.resume"))["message"]
        await robot.until("done")

    robot = operated(tmp_path, scenario)
    assert robot.daemon.mission.ended is None
    assert stops_of(robot) == [(1, 1), (1, 2), (1, 3)]
    assert robot.course.travelled == pytest.approx(2.0, abs=0.1)


def test_pauses_at_many_instants_lose_and_double_nothing(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        for k in range(40):
            await asyncio.sleep(0.37 + 0.11 * (k % 7))
            if "error" in (answer := await client.call("mission.pause")) or answer != {}:
                break
            await asyncio.sleep(0.05 * (k % 5))
            await client.call("mission.resume")
        await robot.until("done")

    robot = operated(tmp_path, scenario)
    assert robot.daemon.mission.ended is None
    assert stops_of(robot) == [(1, 1), (1, 2), (1, 3)]
    assert robot.course.travelled == pytest.approx(2.0, abs=0.1)


def test_a_mission_that_is_aborted_keeps_its_stops(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("driving", 3)
        await asyncio.sleep(1.0)
        assert (await client.call("mission.abort"))["stops"] == 2
        await asyncio.sleep(BRAKING)
        assert not robot.course.is_moving
        await robot.until("done")
        assert len((await client.call("stops.list"))["stops"]) == 2
        assert (await client.call("survey.continue", stop=3))["leg"] == 2
        await robot.until("observing", 3)
        await robot.until("done")

    robot = operated(tmp_path, scenario)
    assert stops_of(robot) == [(2, 3)]


def test_a_paused_mission_can_be_aborted(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("observing", 1)
        await client.call("mission.pause")
        await asyncio.sleep(1.0)
        await client.call("mission.abort")
        await robot.until("done")

    assert "aborted by" in operated(tmp_path, scenario).daemon.mission.ended


def test_halt_pauses_and_resume_frees_what_halt_held(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("driving", 2)
        await asyncio.sleep(1.0)
        await client.call("halt")
        await asyncio.sleep(BRAKING + 0.1)
        assert not robot.course.is_moving
        assert (await client.call("mission.status"))["state"] == "paused"
        await client.call("mission.resume")
        await robot.until("done")

    assert stops_of(operated(tmp_path, scenario)) == [(1, 1), (1, 2), (1, 3)]


def test_what_would_end_a_mission_pauses_it_while_an_operator_attends(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("driving", 2)
        await asyncio.sleep(1.0)
        robot.course.body.bump_left = True
        await robot.until("paused")
        assert "bumper is pressed" in (await client.call("mission.status"))["text"]
        refused = await client.call("mission.resume")
        assert refused["code"] == rpc.REFUSED
        assert "bumper is pressed; see to it" in refused["message"]
        robot.course.body.bump_left = False
        await asyncio.sleep(0.1)
        assert await client.call("mission.resume") == {}
        await robot.until("done")

    assert stops_of(operated(tmp_path, scenario)) == [(1, 1), (1, 2), (1, 3)]


def test_a_robot_that_is_lifted_while_it_is_paused_begins_a_new_leg(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("driving", 2)
        await asyncio.sleep(1.0)
        await client.call("mission.pause")
        robot.course.body.wheel_drop_left = robot.course.body.wheel_drop_right = True
        await asyncio.sleep(2.0)
        robot.course.body.wheel_drop_left = robot.course.body.wheel_drop_right = False
        await asyncio.sleep(1.0)
        await client.call("mission.resume")
        await robot.until("done")

    robot = operated(tmp_path, scenario)
    assert stops_of(robot) == [(1, 1), (2, 2), (2, 3)]
    assert robot.daemon.mission.stops[1].move is None
    assert robot.daemon.mission.stops[2].move is not None


def test_driving_by_hand_pauses_and_what_was_driven_so_is_no_way_along_the_line(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("driving", 2)
        await asyncio.sleep(2.0)
        before = robot.course.travelled
        for speed in (0.2, -0.2):  # forth and almost back again
            end = now() + 3.0
            while now() < end:
                await client.call("drive", t=now(), speed=speed)
                await asyncio.sleep(0.05)
        await client.call("drive", t=now())
        await asyncio.sleep(1.0)
        robot.net = robot.course.travelled - before
        assert abs(robot.net) < 0.25
        status = await client.call("mission.status")
        assert (status["state"], "drives by hand" in status["text"]) == ("paused", True)
        await client.call("mission.resume")
        await robot.until("done")

    robot = operated(tmp_path, scenario)
    assert stops_of(robot) == [(1, 1), (1, 2), (1, 3)]
    assert robot.course.travelled == pytest.approx(2.0 + robot.net, abs=0.05)


def test_a_survey_goes_on_from_any_stop_with_odometry_from_zero(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("driving", 2)
        await client.call("mission.abort")
        await robot.until("done")
        await asyncio.sleep(1.0)
        assert (await client.call("survey.continue", stop=2))["leg"] == 2
        await robot.until("observing", 3)
        await robot.until("done")

    robot = operated(tmp_path, scenario)
    assert stops_of(robot) == [(2, 2), (2, 3)]
    first, second = robot.daemon.mission.stops
    assert (first.odometry.x, first.odometry.y) == pytest.approx((0.0, 0.0), abs=0.01)
    assert second.odometry.x == pytest.approx(1.0, abs=0.1)


def test_a_rejected_stop_stays_as_a_place_without_sightings_and_can_be_taken_back(tmp_path):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("done")
        assert (await client.call("stops.reject", stop=2, reason="a person stood there"))["leg"] == 1
        assert "rejected already" in (await client.call("stops.reject", stop=2))["message"]
        stops = (await client.call("stops.list"))["stops"]
        assert [stop["rejected"] for stop in stops] == [None, "a person stood there", None]
        assert len((await client.call("survey.export"))["stops"]) == 3
        await client.call("stops.reject", stop=2, undo=True)
        assert "is not rejected" in (await client.call("stops.reject", stop=2, undo=True))["message"]

    operated(tmp_path, scenario)


def test_docking_has_the_robot_for_itself_and_ends_with_its_client(tmp_path):
    async def scenario(robot, client):
        async with robot.connected() as other:
            other.send("dock")
            await asyncio.sleep(2.0)
            assert "docking is under way" in (await client.call("mission.start"))["message"]
            assert "docking is under way" in (await client.call("drive", t=0.0, speed=0.1))["message"]
            assert (await client.call("status"))["busy"] == "docking"
        await asyncio.sleep(1.0)
        assert (await client.call("status"))["busy"] is None
        assert not robot.course.is_moving

    operated(tmp_path, scenario)


def test_a_recording_starts_the_cameras_and_ends_on_demand(tmp_path):
    async def scenario(robot, client):
        assert "nose" in (await client.call("record.start", cameras=["nose"]))["message"]
        started = await client.call("record.start", cameras=["eye"], name="trial")
        assert started["file"].endswith("trial.mcap")
        assert "being made already" in (await client.call("record.start", cameras=["eye"]))["message"]
        await asyncio.sleep(5.0)
        assert (await client.call("status"))["recording"]["name"] == "trial"
        ended = await client.call("record.stop")
        assert not ended["recording"]
        assert ended["frames"]["eye"] > 20
        assert (await client.call("status"))["recording"] is None
        assert len((await client.call("record.list"))["recordings"]) == 1

    operated(tmp_path, scenario)
