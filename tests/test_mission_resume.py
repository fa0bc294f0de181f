"""A mission that was interrupted goes on: after the process ended, in a new leg, at the stop where it was."""

import asyncio
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from robotd.clock import now, run_virtual
from robotd.config import Calibration, MissionConfig
from robotd.identify import LabelMemory
from robotd.identify.delays import DelayModel
from robotd.journal import Journal
from robotd.mission_states import NEXT, States
from robotd.observation import Observer
from robotd.records import MissionState
from tests.operated import Operated

ROOT = Path(__file__).parent.parent


# ---- the states ------------------------------------------------------------------------------------------------------


def test_the_drawing_of_the_states_is_the_table_that_is_enforced():
    drawing = re.search(r"```mermaid\nstateDiagram-v2\n(.*?)```", (ROOT / "ARCHITECTURE.md").read_text(), re.DOTALL)[1]
    drawn = {tuple(found) for found in re.findall(r"^ +(\w+) --> (\w+)", drawing, re.MULTILINE)}
    assert drawn == {(state, then) for state, next_ones in NEXT.items() for then in next_ones}
    assert set(NEXT) == set(MissionState.__args__)


@given(st.lists(st.sampled_from(sorted(NEXT)), max_size=20))
def test_no_change_is_made_that_the_table_does_not_have(wanted):
    states = States()
    for state in wanted:
        before = states.now
        if state == before or state in NEXT[before]:
            states.enter(state)
            assert states.now == state
        else:
            with pytest.raises(RuntimeError, match=f"goes from '{before}' to"):
                states.enter(state)
            assert states.now == before


# ---- across a restart ------------------------------------------------------------------------------------------------


def lives(folder, *scenarios, boots=("boot",) * 9, away=5.0, stops=(0.0, 0.4, 0.8), **how):
    """One daemon after the other on the same folder, each until its scenario ends, in virtual time that goes on."""

    async def main():
        robots = []
        for boot, scenario in zip(boots, scenarios, strict=False):
            robot = Operated(folder, stops, **how)
            robot.course.boot_id = lambda boot=boot: boot
            robots.append(robot)
            running = asyncio.create_task(robot.daemon.run(mission=False, control=robot.socket))
            await asyncio.sleep(0.5)
            try:
                async with robot.connected() as client:
                    await scenario(robot, client)
            finally:
                running.cancel()
                result = (await asyncio.gather(running, return_exceptions=True))[0]
                if isinstance(result, Exception):
                    raise result
            await asyncio.sleep(away)
        return robots

    return run_virtual(main())


def until(state, stop, seconds):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until(state, stop)
        await asyncio.sleep(seconds)

    return scenario


async def to_the_end(robot, client):
    await robot.until("done")


def stops_in(folder):
    with Journal.open(folder / "state" / "journal.sqlite") as journal:
        assert journal.unfinished() is None
        return [(stop.leg, stop.stop) for stop in journal.survey("store").stops]


@pytest.mark.parametrize(
    ("state", "stop", "seconds", "stops"),
    [
        ("observing", 1, 0.1, [(1, 1), (1, 2), (1, 3)]),  # a leg without a stop gives its number to the next one
        ("driving", 2, 2.0, [(1, 1), (2, 2), (2, 3)]),
        ("observing", 3, 0.3, [(1, 1), (1, 2), (2, 3)]),
    ],
)
def test_a_mission_goes_on_by_itself_where_it_was(tmp_path, state, stop, seconds, stops):
    _, second = lives(tmp_path, until(state, stop, seconds), to_the_end, resume="auto")
    assert stops_in(tmp_path) == stops
    assert second.said("paused: restarted: the mission was interrupted")
    made = second.daemon.mission.stops
    assert [item.stop for item in made] == [1, 2, 3]
    assert all((item.move is None) == (k == 0 or item.leg != made[k - 1].leg) for k, item in enumerate(made))


def test_a_mission_that_was_on_its_way_drives_the_rest_of_it(tmp_path):
    first, second = lives(tmp_path, until("driving", 2, 3.0), to_the_end, resume="auto", stops=(0.0, 1.0))
    assert first.course.travelled == pytest.approx(0.55, abs=0.1)
    # what it rolled in the last second before the end was not noted yet
    assert 1.0 - 0.05 <= first.course.travelled + second.course.travelled <= 1.0 + 0.35


def test_by_default_an_operator_is_asked(tmp_path):
    async def ask(robot, client):
        await asyncio.sleep(10.0)
        status = await client.call("mission.status")
        assert (status["state"], status["stop"], status["leg"]) == ("paused", 2, 2)
        assert status["text"].startswith("restarted: the mission was interrupted on the way to stop 2, 0.")
        assert status["stops_made"] == 1
        assert robot.course.travelled == 0.0
        assert "a mission is under way" in (await client.call("mission.start"))["message"]
        await client.call("mission.resume")
        await robot.until("done")

    lives(tmp_path, until("driving", 2, 2.0), ask)
    assert stops_in(tmp_path) == [(1, 1), (2, 2), (2, 3)]


@pytest.mark.parametrize("how", ["another boot", "long ago", "paused before", "on the charger", "held"])
def test_in_doubt_it_does_not_go_on_by_itself(tmp_path, how):
    async def first(robot, client):
        await until("driving", 2, 2.0)(robot, client)
        if how == "paused before":
            await client.call("mission.pause")
            await asyncio.sleep(0.5)

    async def second(robot, client):
        if how == "on the charger":
            robot.course.robot.set_plugged(True)
        if how == "held":
            await client.call("estop")
        await asyncio.sleep(6.0)
        assert (await client.call("mission.status"))["state"] == "paused"
        assert robot.course.travelled == 0.0

    boots = ("boot", "next boot") if how == "another boot" else ("boot", "boot")
    lives(tmp_path, first, second, boots=boots, resume="auto", away=90.0 if how == "long ago" else 5.0)


def test_a_robot_that_is_lifted_before_it_goes_on_waits_for_the_operator(tmp_path):
    async def lift(robot, client):
        robot.course.body.wheel_drop_left = True
        await asyncio.sleep(1.0)
        robot.course.body.wheel_drop_left = False
        await asyncio.sleep(6.0)
        status = await client.call("mission.status")
        assert (status["state"], "it was moved meanwhile" in status["text"]) == ("paused", True)
        await client.call("mission.resume")
        await robot.until("done")

    lives(tmp_path, until("driving", 2, 2.0), lift, resume="auto")
    assert stops_in(tmp_path) == [(1, 1), (2, 2), (2, 3)]


def test_an_interrupted_mission_can_be_dropped(tmp_path):
    async def drop(robot, client):
        await client.call("mission.abort")
        await robot.until("done")
        assert (await client.call("survey.continue", stop=3))["leg"] == 2
        await robot.until("observing", 3)
        await robot.until("done")

    lives(tmp_path, until("driving", 2, 2.0), drop)
    assert stops_in(tmp_path) == [(1, 1), (2, 3)]


def test_a_mission_whose_last_stop_was_made_has_nothing_left_to_do(tmp_path):
    lives(tmp_path, until("observing", 1, 0.0), to_the_end, resume="auto", stops=(0.0,))
    with Journal.open(tmp_path / "state" / "journal.sqlite") as journal:
        journal.sure.execute("UPDATE missions SET ended = NULL")
    lives(tmp_path, to_the_end, stops=(0.0,))
    assert stops_in(tmp_path) == [(1, 1)]


def test_a_mission_whose_stops_have_changed_is_not_resumed_and_says_so(tmp_path):
    async def look(robot, client):
        await asyncio.sleep(1.0)
        assert not (await client.call("mission.status"))["is_under_way"]
        (text,) = robot.said("its stops are others now")
        assert "survey continue begins another leg" in text

    lives(tmp_path, until("driving", 2, 2.0))
    lives(tmp_path, look, stops=(0.0, 1.5))
    assert stops_in(tmp_path) == [(1, 1)]


@pytest.mark.parametrize("seed", range(1))
def test_whenever_it_is_interrupted_every_stop_is_made_once(tmp_path, seed):
    times = np.random.default_rng(seed).uniform(0.1, 9.0, 5)

    async def start(robot, client):
        await client.call("mission.start")
        await asyncio.sleep(times[0])

    def wait(seconds):
        async def scenario(robot, client):
            await asyncio.sleep(seconds)

        return scenario

    async def finish(robot, client):
        if (await client.call("mission.status"))["is_under_way"]:
            await robot.until("done")

    lives(tmp_path, start, *map(wait, times[1:]), finish, resume="auto", stops=(0.0, 0.6, 1.2))
    assert sorted(stop for _, stop in stops_in(tmp_path)) == [1, 2, 3]


def test_another_mission_may_begin_while_the_map_of_the_last_one_is_awaited(tmp_path):
    async def scenario(robot, client):
        never = asyncio.Event()
        robot.daemon.missions._fetch_map = lambda mission, uploader: never.wait()
        robot.daemon.uploader = SimpleNamespace(wake=lambda: None, trouble=None)
        await client.call("mission.start")
        await robot.until("uploading")
        assert "no mission is under way" in (await client.call("mission.abort"))["message"]
        assert (await client.call("mission.start", survey="next"))["leg"] == 1
        await robot.until("observing", 1)
        await robot.until("uploading")

    (robot,) = lives(tmp_path, scenario, stops=(0.0,))
    assert robot.daemon.mission.config.survey == "next"


# ---- what is remembered ----------------------------------------------------------------------------------------------


def test_what_was_learnt_of_labels_and_their_system_is_taken_over_but_no_places():
    config = MissionConfig(labels=("a", "b", "c"))

    def observer(labels):
        given = MissionConfig(labels=labels)
        return Observer(given, Calibration(), bus=None, cameras={}, labels=None, journal=None, tell=print)

    before, after = observer(("a", "b", "c")), observer(("c", "a", "d"))
    before.memory.asked[:] = 1, 2, 3
    before.memory.learnt.add("c")
    before.refused["b"] = before.refused["c"] = "unknown"
    before.memory.refused |= {"b", "c"}
    before._delays.learn(10.0, np.array([1.5, 2.0, 2.5]), np.arange(3))
    after.restore(before.state(), same_clock=True)
    assert after.memory.asked.tolist() == [3, 1, 0]
    assert (after.memory.learnt, after.memory.refused, after.refused) == ({"c"}, {"c"}, {"c": "unknown"})
    assert after._delays.median == pytest.approx(before._delays.median)
    assert after._delays.fetch(20.0) == pytest.approx(before._delays.fetch(20.0), abs=1e-4)
    later = DelayModel(config.identify)
    later.restore(before._delays.state(), same_clock=False)
    assert later.fetch(20.0) == pytest.approx(DelayModel(config.identify).fetch(20.0))
    assert LabelMemory(("a",), (), config.identify).state()["asked"] == {}


@pytest.mark.parametrize("state", ["driving", "observing"])
def test_a_lifted_robot_begins_a_new_leg_and_forgets_places_before_it_looks(tmp_path, state):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until(state, 2)
        robot.order = []
        observer = robot.daemon.mission.observer
        forget, observe = observer.memory.forget_places, observer.observe
        observer.memory.forget_places = lambda: (robot.order.append("forget"), forget())
        observer.observe = lambda *given: (robot.order.append("look"), observe(*given))[1]
        robot.course.body.wheel_drop_left = True
        await robot.until("paused")
        assert "wheel has dropped" in (await client.call("mission.status"))["text"]
        robot.course.body.wheel_drop_left = False
        await asyncio.sleep(0.5)
        await client.call("mission.resume")
        await robot.until("done")

    (robot,) = lives(tmp_path, scenario, stops=(0.0, 0.4))
    assert robot.order == ["forget", "look"]
    assert stops_in(tmp_path) == [(1, 1), (2, 2)]


# ---- dates -----------------------------------------------------------------------------------------------------------


def test_a_date_that_steps_is_noted_and_costs_no_stop(tmp_path):
    async def scenario(robot, client):
        start, jump = datetime(2026, 3, 2, tzinfo=UTC), timedelta(0)
        robot.course.utc = lambda: start + timedelta(seconds=now()) + jump
        await client.call("mission.start")
        for step in (timedelta(days=200), -timedelta(days=4000), timedelta(hours=-1)):
            await asyncio.sleep(3.0)
            jump += step
        await robot.until("done")
        await asyncio.sleep(6.0)
        robot.clocks = robot.daemon.journal.sure.execute("SELECT count(*) FROM clock").fetchone()[0]

    (robot,) = lives(tmp_path, scenario)
    assert stops_in(tmp_path) == [(1, 1), (1, 2), (1, 3)]
    assert robot.clocks >= 2  # it is looked at every 10 s
