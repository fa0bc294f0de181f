"""A robot on a line and nothing else: the simulator's base and cameras under the daemon's own parts, scored by truth.

No rig, no labels, no server and no solver: what is left is `robotd run` between a floor camera and two wheels.
"""

import asyncio
import dataclasses
import tempfile
from pathlib import Path

import numpy as np
from robotd.drivers.line_follower import LineFollowerConfig, LineFollowerDriver
from robotd.drivers.roomba import RoombaConfig, RoombaDriver
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

from robotd import oi
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.control import ControlLoop
from robotd.errors import MissionError
from robotd.odometry import Odometry
from robotd.safety import SafetyGate, SafetyLimits
from robotd.sim.hardware import FOLDER, SimHardware
from robotd.sim.layout import Floor, Lamp, LineLayout, StoreLayout
from robotd.sim.referee import Referee
from robotd.sim.settings import WorldSettings
from robotd.sim.world import World
from robotd.supervisor import Supervisor

LONGEST_S = 90.0  # for one drive, in virtual time
TEXTURES = ("carpet", "wood", "concrete", "tiles", "asphalt")


@dataclasses.dataclass
class Drive:
    """What came of one drive; lengths in metres, `track` the signed offsets of the true way from the tape."""

    world: World
    driver: LineFollowerDriver
    fault: str | None
    travelled: float
    target: float
    seconds: float
    cross_track: dict
    states: list
    motions: list
    stops: list
    line_points: list
    sent: list  # (loop time, right, left) of each drive command on the wire, mm/s

    @property
    def pose(self):
        return self.world.body.pose


def store(points, *, closed=False, radius=0.0, width=0.05, color="dark", texture="carpet", gaps=(), lamps=None, **more):
    """A floor with a line and no labels; the points are moved so that there is room for the robot all around."""
    points = np.asarray(points, float)
    low, high = points.min(axis=0) - 1.2, points.max(axis=0) + 1.2
    shifted = tuple((float(x), float(y)) for x, y in points - low)
    size = tuple(float(side) for side in high - low)
    line = LineLayout(shifted, (0.0,), width, color, closed, radius, tuple(gaps))
    lamps = (Lamp((size[0] / 2, size[1] / 2, 2.3)),) if lamps is None else lamps
    return StoreLayout(
        "robotd-store/1", "course", size, line, Floor(texture), lamps=lamps, disturbances=False, **more
    ), -low


class _Ear:
    """Listens to what the driver sends to the base, byte by byte."""

    def __init__(self):
        self.sent = []
        self._decoder = oi.CommandDecoder()

    def frame(self, frame, delivered):
        pass

    def serial(self, port, t, data, *, to_robot):
        for command in self._decoder.feed(data) if to_robot else ():
            if isinstance(command, oi.Command) and command.name == "drive_direct":
                self.sent.append((t, *command.values))


def _halved(camera):
    """A camera with half the pixels on each side."""
    fx, fy, cx, cy = camera.matrix
    width, height = camera.size
    matrix = (fx / 2, fy / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5)
    return dataclasses.replace(camera, size=(width // 2, height // 2), matrix=matrix)


async def _drive(layout, targets, *, settings, seed, config, spoil, at_marker, camera, limits, halved):
    with tempfile.TemporaryDirectory() as folder:
        world = World(layout, settings, seed, Path(folder))
        if halved:
            world.rig = tuple(_halved(model) for model in world.rig)
        ear = _Ear()
        hardware, bus, calibration = SimHardware(world, ear), Bus(), world.believed_calibration()
        base = RoombaDriver("base", RoombaConfig(FOLDER + "base"), hardware, bus, calibration)
        eye = V4l2Driver(camera, V4l2Config(FOLDER + camera), hardware, bus, calibration)
        follower = LineFollowerDriver("follower", config, hardware, bus, calibration)
        odometry = Odometry(calibration.wheels)
        gate = SafetyGate(limits, calibration.wheels.base, follower.blind)
        control = ControlLoop(bus, base, odometry, gate)
        if spoil is not None:
            _spoil(bus, camera, spoil)
        drive = Drive(world, follower, None, 0.0, 0.0, 0.0, {}, [], [], [], [], ear.sent)
        async with asyncio.TaskGroup() as group:
            supervisors = [Supervisor(driver) for driver in (base, eye, follower)]
            tasks = [group.create_task(control.run()), *(group.create_task(item.run()) for item in supervisors)]
            tasks.append(group.create_task(_watch(bus, drive)))
            while any(item.fault for item in supervisors) or bus.odometry.latest is None:
                await asyncio.sleep(0.05)
            control.resume("the test")
            started = now()
            await eye.start(follower.mode)
            try:
                for target in targets:
                    drive.target = target
                    async with asyncio.timeout(LONGEST_S):
                        ended = await follower.follow(target, at_marker=at_marker)
                    drive.stops.append((ended, bus.odometry.latest.travelled, world.body.pose))
            except MissionError as error:
                drive.fault = str(error)
            except TimeoutError:
                drive.fault = f"not there after {LONGEST_S:g} s"
            drive.seconds = now() - started
            await eye.stop()
            await asyncio.sleep(0.6)
            drive.travelled = bus.odometry.latest.travelled
            for task in tasks:
                task.cancel()
        drive.cross_track = Referee(world).cross_track_mm()
        return drive


def _spoil(bus, camera, spoil):
    """Let `spoil(t, image)` replace the pictures on their way from the camera; None drops one."""
    topic = bus.frames(camera)
    publish = topic.publish

    def spoilt(frame):
        image = spoil(now(), frame.image)
        if image is not None:
            publish(dataclasses.replace(frame, image=image))

    topic.publish = spoilt


async def _watch(bus, drive):
    async def keep(topic, into):
        with topic.subscribe(size=4096) as items:
            async for item in items:
                into.append(item)

    async with asyncio.TaskGroup() as group:
        for topic, into in (
            (bus.line_status, drive.states),
            (bus.line_motion, drive.motions),
            (bus.line_points, drive.line_points),
        ):
            group.create_task(keep(topic, into))


def drive(
    layout,
    targets,
    *,
    settings=None,
    seed=0,
    spoil=None,
    at_marker=False,
    camera="floor",
    limits=None,
    halved=False,
    **keys,
):
    """Follow a layout's line to each target in turn (metres from its first stop); `keys` configure the follower.

    `halved` gives the rig cameras half the pixels on each side, for speed.
    """
    keys = {"camera": camera, "line_width": layout.line.width, "color": layout.line.color} | keys
    config = LineFollowerConfig(**keys)
    return run_virtual(
        _drive(
            layout,
            targets,
            settings=settings or WorldSettings(),
            seed=seed,
            config=config,
            spoil=spoil,
            at_marker=at_marker,
            camera=camera,
            limits=limits or SafetyLimits(),
            halved=halved,
        )
    )
