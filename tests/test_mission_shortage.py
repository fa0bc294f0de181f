"""What runs out pauses a mission in time: the battery, room on the disk; and stops at which little was seen."""

import asyncio
import shutil
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st

from robotd.errors import InputError, StorageError
from robotd.mission_guards import BatteryGuard, DiskGuard
from robotd.observation import Observer
from robotd.records import SensorFrame, Sighting
from robotd.sim.battery import CAPACITY_MAH
from tests.operated import operated


def frame(t, charge, voltage=14.0, **more):
    return SensorFrame(t, 0.0, 0.0, "safe", voltage=voltage, charge_fraction=charge, **more)


# ---- the bounds ------------------------------------------------------------------------------------------------------


def battery():
    return BatteryGuard(0.1, 0.25, 12.5, 13.5)


@pytest.mark.parametrize(("charge", "voltage"), [(0.05, 14.0), (0.5, 12.0), (None, 12.0), (0.05, None)])
def test_a_battery_that_is_low_for_a_while_is_short_until_it_is_well_above(charge, voltage):
    guard = battery()
    guard.update(frame(0.0, charge, voltage))
    guard.update(frame(4.9, charge, voltage))
    assert guard.cause is None
    guard.update(frame(5.0, charge, voltage))
    assert guard.cause.startswith("the battery is low: ")
    between = frame(6.0, charge and 0.2, voltage and 13.0)
    guard.update(between)
    assert guard.cause is not None
    guard.update(frame(7.0, charge and 0.3, voltage and 13.6))
    assert guard.cause is None
    guard.update(between)
    assert guard.cause is None


def test_a_sagging_voltage_and_a_base_that_tells_nothing_are_no_shortage():
    guard = battery()
    for t in range(20):
        guard.update(frame(float(t), 0.5, 12.0 if t % 4 else 14.0))
        guard.update(frame(float(t), None, None))
    assert guard.cause is None


def test_an_operator_who_insists_is_not_asked_again_before_it_was_charged():
    guard = battery()
    for t in (0.0, 6.0):
        guard.update(frame(t, 0.05))
    guard.insist()
    for t in (7.0, 20.0):
        guard.update(frame(t, 0.04))
    assert guard.cause is None
    guard.update(frame(30.0, 0.9))
    for t in (40.0, 46.0):
        guard.update(frame(t, 0.05))
    assert guard.cause is not None


@given(st.lists(st.floats(0.0, 400e6), max_size=30))
def test_the_disk_is_short_below_its_bound_and_until_a_tenth_more_is_free(free):
    guard, short = DiskGuard("/state", 200e6), False
    for value in free:
        guard.update(value)
        short = value < (220e6 if short else 200e6)
        assert (guard.cause is not None) == short


# ---- in a mission ----------------------------------------------------------------------------------------------------


def stops_of(robot):
    return [(stop.leg, stop.stop) for stop in robot.daemon.mission.stops]


async def low(robot, client):
    await client.call("mission.start")
    await robot.until("driving", 2)
    robot.course.robot.battery.charge_mah = 0.05 * CAPACITY_MAH
    await robot.until("paused")
    await asyncio.sleep(2.0)
    status = await client.call("mission.status")
    assert status["text"].startswith("the battery is low: 5 %")
    assert not robot.course.is_moving


def test_a_low_battery_pauses_and_a_charged_one_goes_on_by_itself(tmp_path):
    async def scenario(robot, client):
        await low(robot, client)
        where = robot.course.travelled
        robot.course.robot.set_plugged(True)  # by cable, in its place
        await asyncio.sleep(1.0)
        robot.course.robot.battery.charge_mah = 0.5 * CAPACITY_MAH
        await asyncio.sleep(6.0)
        assert (await client.call("mission.status"))["state"] == "paused"  # as long as the cable is in
        robot.course.robot.set_plugged(False)
        await robot.until("observing", 2)
        assert robot.course.travelled == where
        await robot.until("done")

    robot = operated(tmp_path, scenario, stops=(0.0, 1.0))
    assert stops_of(robot) == [(1, 1), (1, 2)]
    assert robot.course.travelled == pytest.approx(1.0, abs=0.05)  # as without a pause


def test_a_robot_that_was_carried_to_its_charger_waits_for_the_operator(tmp_path):
    async def scenario(robot, client):
        await low(robot, client)
        robot.course.body.wheel_drop_left = True
        await asyncio.sleep(1.0)
        robot.course.body.wheel_drop_left = False
        robot.course.robot.battery.charge_mah = 0.5 * CAPACITY_MAH
        await asyncio.sleep(8.0)
        status = await client.call("mission.status")
        assert (status["state"], "it was moved meanwhile" in status["text"]) == ("paused", True)
        await client.call("mission.resume")
        await robot.until("done")

    assert stops_of(operated(tmp_path, scenario, stops=(0.0, 1.0))) == [(1, 1), (2, 2)]


def test_an_operator_may_go_on_with_a_low_battery_and_dock_in_a_pause(tmp_path):
    async def scenario(robot, client):
        await low(robot, client)
        async with robot.connected() as other:
            other.send("dock")
            await asyncio.sleep(1.0)
            assert (await client.call("status"))["busy"] == "docking"
            assert "docking is under way" in (await client.call("mission.resume"))["message"]
        await asyncio.sleep(3.0)
        await client.call("mission.resume")
        await robot.until("done")

    assert stops_of(operated(tmp_path, scenario, stops=(0.0, 1.0)))[-1][1] == 2


def test_a_disk_that_fills_up_pauses_the_mission_before_it_drives_on(tmp_path, monkeypatch):
    usage = SimpleNamespace(free=1e9)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)

    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("observing", 1)
        usage.free = 150e6
        await robot.until("paused", 2)
        assert (await client.call("mission.status"))["text"].startswith("the disk is nearly full: 150 MB free in ")
        assert len(robot.daemon.mission.stops) == 1
        usage.free = 210e6
        await asyncio.sleep(9.0)
        assert (await client.call("mission.status"))["state"] == "paused"
        usage.free = 230e6
        await robot.until("done")

    assert stops_of(operated(tmp_path, scenario, stops=(0.0, 1.0))) == [(1, 1), (1, 2)]


@pytest.mark.parametrize("when", ["observing", "settling"])
def test_a_full_disk_loses_no_stop_and_ends_no_mission(tmp_path, monkeypatch, when):
    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until(when, 2)
        journal = robot.daemon.journal
        for name in ("note_mission", "add_stop", "begin_leg", "acknowledge"):
            monkeypatch.setattr(journal, name, full)
        await robot.until("paused", 2)
        assert "cannot be written" in (await client.call("mission.status"))["text"]
        await asyncio.sleep(14.0)
        assert (await client.call("mission.status"))["state"] == "paused"
        assert len(robot.said("paused: ")) <= 3
        monkeypatch.undo()
        await robot.until("done")

    def full(*_, **__):
        raise StorageError("journal.sqlite: cannot be written: database or disk is full; make room on the disk")

    assert stops_of(operated(tmp_path, scenario, stops=(0.0, 0.3))) == [(1, 1), (1, 2)]


# ---- stops at which little was seen ----------------------------------------------------------------------------------


@pytest.mark.parametrize("if_fewer", ["flag", "repeat"])
def test_a_stop_with_few_labels_is_looked_at_again_or_flagged(tmp_path, monkeypatch, if_fewer):
    looks = {1: [2], 2: [1, 2], 3: [1, 0]}  # labels that each look sees

    async def observe(observer, site, seen):
        count = looks[site.stop].pop(0)
        seen.append(tuple(Sighting("front", f"a{k}", 1.0, 1.0) for k in range(count)))

    monkeypatch.setattr(Observer, "observe", observe)

    async def scenario(robot, client):
        await client.call("mission.start")
        await robot.until("done")
        robot.listed = (await client.call("stops.list"))["stops"]

    robot = operated(tmp_path, scenario, stops=(0.0, 0.2, 0.4), least_labels=2, if_fewer=if_fewer)
    few = "only 1 labels, of 2 at least"
    is_repeated = if_fewer == "repeat"
    assert [stop["labels"] for stop in robot.listed] == ([2, 2, 1] if is_repeated else [2, 1, 1])
    assert [stop["flag"] for stop in robot.listed] == ([None, None, few] if is_repeated else [None, few, few])
    assert sum(map(len, looks.values())) == (0 if is_repeated else 2)
    assert len(robot.said("once more")) == (2 if is_repeated else 0)


def test_bounds_that_contradict_each_other_are_refused():
    from robotd.bind import bind
    from robotd.config import MissionConfig

    with pytest.raises(InputError, match=r"enough_charge = 0.2; expected at least low_charge = 0.3"):
        bind(MissionConfig, {"low_charge": 0.3, "enough_charge": 0.2}, "[mission]")
