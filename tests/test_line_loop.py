"""Following the line from pixels to bytes: pictures that show nothing, junctions, worn tape, missions by markers."""

import asyncio
import dataclasses
import math

import numpy as np
import pytest
from robotd.drivers.line_follower import LineFollowerConfig, LineFollowerDriver
from robotd.drivers.roomba import RoombaConfig, RoombaDriver
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

from robotd.bus import Bus
from robotd.clock import run_virtual
from robotd.config import Config, MissionConfig, RobotConfig
from robotd.daemon import Assembly, Daemon
from robotd.lost_line import BLIND_S
from robotd.plugin import Driver
from robotd.sim.hardware import FOLDER, SimHardware
from robotd.sim.layout import Mark, Tape
from robotd.sim.settings import WorldSettings
from robotd.sim.world import World
from tests.line_course import drive, store

# ---- pictures that show nothing --------------------------------------------------------------------------------------

SPOILT_FROM = 2.0  # s on the loop: the robot drives at 0.3 m/s by then


def _noisy(image, level):
    return np.random.default_rng(int(image.sum())).integers(level, level + 3, image.shape).astype(np.uint8)


SPOILERS = {
    "blank": lambda image, kept: _noisy(image, 4),
    "saturated": lambda image, kept: _noisy(image, 253),
    "tiny": lambda image, kept: image[:3, :4].copy(),
    "frozen": lambda image, kept: kept.setdefault("image", image),
}


@pytest.mark.parametrize("kind", SPOILERS)
def test_useless_pictures_stop_the_wheels_on_the_wire(kind):
    layout, _ = store([(0.0, 0.0), (4.0, 0.0)], texture="concrete")
    kept, where = {}, []

    def spoil(t, image):
        if t < SPOILT_FROM:
            return image
        where.append(t)
        return SPOILERS[kind](image, kept)

    result = drive(layout, [3.5], seed=1, spoil=spoil)
    assert result.fault is not None
    assert result.fault.startswith("line lost: floor: its picture")
    moving = [t for t, right, left in result.sent if right or left]
    before = [speeds for t, *speeds in result.sent if t < where[0]][-1]
    assert min(before) > 200  # mm/s
    assert moving[-1] < where[0] + BLIND_S + 0.1  # s, with a frame and a control period on the way
    assert result.sent[-1][1:] == (0, 0)
    seen_last = result.world.body.trail_at(where[0])
    assert math.hypot(result.pose.x - seen_last.x, result.pose.y - seen_last.y) < 0.3 * (BLIND_S + 0.1) + 0.08  # brakes


# ---- where there is more than one way, or less than one line ---------------------------------------------------------


def fork(rule, heading, side):
    """Drive 0.25 m past a point where the tape goes on straight and `side` degrees to the left."""
    layout, shift = store([(0.0, 0.0), (1.6, 0.0)], texture="concrete")
    at = shift + [0.55, 0.0]
    end = at + 0.9 * np.array([math.cos(math.radians(side)), math.sin(math.radians(side))])
    layout = dataclasses.replace(layout, tapes=(Tape((tuple(map(float, at)), tuple(map(float, end))), 0.05),))
    result = drive(layout, [0.8], seed=2, fork=rule, fork_heading=heading)
    pose = result.pose
    return result.fault, math.degrees(math.atan2(pose.y - at[1], pose.x - at[0]))


def test_a_fork_is_driven_as_the_rule_says():
    fault, driven = fork("heading", 0.7, 45.0)
    assert fault is None
    assert driven == pytest.approx(45.0, abs=8.0)


def test_dashes_a_crossing_a_fork_a_gap_and_a_line_beside_ours_do_not_lead_astray_and_the_end_is_the_end():
    dashes = [(0.5 + 0.15 * k, 0.05) for k in range(3)]
    layout, shift = store([(0.0, 0.0), (2.2, 0.0)], texture="wood", gaps=[*dashes, (1.7, 0.12)])
    others = (
        ((1.0, -0.6), (1.2, 0.6)),
        ((1.4, 0.0), (1.85, -0.5)),
        ((1.6, 0.17), (2.1, 0.17)),
    )  # crossing, fork, beside
    tapes = tuple(Tape(tuple((float(x + shift[0]), float(y + shift[1])) for x, y in ends), 0.05) for ends in others)
    result = drive(dataclasses.replace(layout, tapes=tapes), [math.inf], seed=4, at_marker=True)
    assert result.fault is None
    assert [reason for reason, _, _ in result.stops] == ["end"]
    assert result.pose.x - shift[0] == pytest.approx(2.2, abs=layout.line.width)
    assert result.cross_track["max"] < 10.0
    assert not {state.state for state in result.states} & {"coasting", "turning", "lost"}


# ---- a whole mission -------------------------------------------------------------------------------------------------


class Silent(Driver):
    """A label system that does nothing: there is no camera to see it."""

    async def flash(self, labels, strength, duration):
        return {}  # refused none


def test_a_mission_by_markers_stops_at_squares_and_dots_and_ends_with_the_line(tmp_path):
    layout, shift = store([(0.0, 0.0), (1.2, 0.0)], texture="concrete")
    places = ((0.5, 0.14, "square"), (0.9, -0.15, "dot"))
    marks = tuple(Mark((float(x + shift[0]), float(y + shift[1])), shape=shape) for x, y, shape in places)
    world = World(dataclasses.replace(layout, marks=marks), WorldSettings(), 1, tmp_path)
    hardware, bus, calibration = SimHardware(world), Bus(), world.believed_calibration()
    rest = hardware, bus, calibration
    base = RoombaDriver("base", RoombaConfig(FOLDER + "base"), *rest)
    eye = V4l2Driver("floor", V4l2Config(FOLDER + "floor"), *rest)
    follower = LineFollowerDriver("follower", LineFollowerConfig(), *rest)
    mission = MissionConfig("markers", labels=("a",), stop_at="markers", marker_stops=9)
    assembly = Assembly(
        *(tmp_path / "robotd.toml", Config(RobotConfig("r", tmp_path), mission, drivers={}), calibration),
        *(bus, hardware, base, follower, Silent("labels", None, *rest), {}, eye),
    )
    daemon, stood, told = Daemon(assembly), {}, []

    async def watch():
        with bus.status.subscribe(size=256) as statuses:
            async for status in statuses:
                if status.state == "observing":
                    stood.setdefault(status.stop, world.body.pose.x - shift[0])

    async def listen():
        with bus.events.subscribe(size=256) as events:
            async for event in events:
                told.append(event.text)

    async def main():
        watching = [asyncio.create_task(watch()), asyncio.create_task(listen())]
        await daemon.run(mission=True)
        for task in watching:
            task.cancel()

    run_virtual(main())
    assert daemon.mission.ended is None
    assert [stop.stop for stop in daemon.mission.stops] == [1, 2, 3]
    assert stood == pytest.approx({1: 0.0, 2: 0.5, 3: 0.9}, abs=0.03)
    assert "the line ended after stop 3: all its markers are made" in told
    assert world.body.pose.x - shift[0] == pytest.approx(1.2, abs=0.03)


def test_a_robot_that_is_put_down_near_the_end_of_its_line_halts_there():
    """The last of the tape is seen a little longer than remembered, which must not make another line of it."""
    layout, shift = store([(0.0, 0.0), (1.2, 0.0)], texture="concrete")
    layout = dataclasses.replace(layout, line=dataclasses.replace(layout.line, stops=(0.7,)))
    result = drive(layout, [math.inf], seed=1, at_marker=True)
    assert result.fault is None
    assert [ended for ended, *_ in result.stops] == ["end"]
    assert result.pose.x - shift[0] == pytest.approx(1.2, abs=0.05)
