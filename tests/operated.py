"""What tests of operators share: a whole daemon on a simulated robot with a control socket, and clients of it."""

import asyncio
import json
from contextlib import asynccontextmanager

import numpy as np

from robotd.camera_driver import CameraDriver
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration, Config, MissionConfig, RecordingConfig, RobotConfig
from robotd.control_socket import ControlSocket
from robotd.daemon import Assembly, Daemon
from robotd.hardware import CameraCounts, CameraMode
from robotd.identify import IdentifyConfig
from robotd.operations import Operations
from robotd.plugin import Driver
from robotd.records import DriveCommand, Frame
from tests.hazard_course import Course

QUICK = IdentifyConfig(
    poll_s=0.2,
    delay_median_s=0.1,
    delay_normal_s=0.3,
    delay_tail_s=0.5,
    durations_s=(1, 2),
    check_digits=0,
    stop_s=10.0,
)


class Walker(Driver):
    """A follower without a line: straight on."""

    kind, blind, mode = "follower", 0.0, CameraMode((64, 48), 30.0)

    async def follow(self, travelled, *, at_marker=False):
        with self.bus.odometry.subscribe() as odometry:
            async for state in odometry:
                rest = travelled - state.travelled
                self.bus.commands.publish(DriveCommand(now(), 0.2 if rest > 0.0 else 0.0, 0.0, self.name, now()))
                if rest <= 0.0 and state.speed == 0.0:
                    return "distance"


class Eye(CameraDriver):
    """Sees a white bar that moves."""

    async def _stream(self, mode):
        self._begin(CameraCounts(), mode.fps)
        width, height = mode.size
        async for tick in ticks(1.0 / mode.fps):
            image = np.full((height, width), 90, np.uint8)
            image[:, tick % width] = 250
            self._publish(Frame(self.name, now(), image, tick), mode)


class Labels(Driver):
    """Nothing flashes."""

    kind = "labels"
    asked = ()

    async def flash(self, labels, strength, durations):
        self.asked = (*self.asked, (tuple(labels), tuple(durations)))
        return {}


class RpcClient:
    """One connection to the control socket."""

    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer
        self.notes = []
        self._number = 0

    async def call(self, method, **params):
        """The result, or the error's object."""
        number = self.send(method, **params)
        while True:
            message = await self.read()
            if message.get("id") == number:
                return message.get("result", message.get("error"))
            self.notes.append(message)

    def send(self, method, **params):
        self._number += 1
        request = {"jsonrpc": "2.0", "id": self._number, "method": method, "params": params}
        self.writer.write(json.dumps(request).encode() + b"\n")
        return self._number

    async def read(self):
        return json.loads(await self.reader.readline())

    def hang_up(self):
        self.writer.transport.abort()


class Operated:
    """A robot with its daemon.

    Attributes
    ----------
    course : Course
        The robot's base, with the bytes that went to it.
    daemon : Daemon
    """

    def __init__(self, folder, stops=(0.0, 1.0, 2.0), calibration=None, **mission):
        self.folder = folder
        self.course = course = Course()
        calibration = calibration or Calibration()
        make = {"follower": Walker, "labels": Labels, "eye": Eye}
        self.follower, self.labels, self.eye = (
            cls(name, None, course, course.bus, calibration) for name, cls in make.items()
        )
        config = Config(
            RobotConfig("trial", folder / "state", folder / "calibration.toml"),
            MissionConfig("store", stops, **{"labels": ("a",), "identify": QUICK, "least_labels": 0, **mission}),
            recording=RecordingConfig(folder / "recordings", keep_free_mb=0.0),
            drivers={name: {"driver": name} for name in ("base", *make)},
        )
        assembly = Assembly(
            *(folder / "robotd.toml", config, calibration, course.bus, course, course.driver),
            *(self.follower, self.labels, {}, self.eye),
        )
        self.daemon = Daemon(assembly)
        course.loop = self.daemon.control
        self.path = folder / "control.sock"
        self.socket = ControlSocket(self.path, Operations(self.daemon))

    @asynccontextmanager
    async def connected(self):
        reader, writer = await asyncio.open_unix_connection(str(self.path), limit=1 << 24)
        client = RpcClient(reader, writer)
        hello = await client.read()
        assert hello["method"] == "hello"
        try:
            yield client
        finally:
            writer.transport.abort()

    async def until(self, state, stop=None, *, seconds=200.0):
        """Wait for a state of the mission."""
        async with asyncio.timeout(seconds):
            while (
                (status := self.course.bus.status.latest) is None
                or status.state != state
                or stop
                not in (
                    None,
                    status.stop,
                )
            ):
                await asyncio.sleep(0.02)

    def said(self, words):
        return [event.text for event in self.course.events if words in event.text]


def operated(folder, scenario, **how):
    """Run `await scenario(robot, client)` in virtual time on a robot that has spoken; returns the robot."""

    async def main():
        robot = Operated(folder, **how)
        running = asyncio.create_task(robot.daemon.run(mission=False, control=robot.socket))
        await asyncio.sleep(0.5)
        assert robot.course.bus.sensors.latest is not None
        try:
            async with robot.connected() as client:
                await scenario(robot, client)
        finally:
            running.cancel()
            result = (await asyncio.gather(running, return_exceptions=True))[0]
            if isinstance(result, Exception):
                raise result
        return robot

    return run_virtual(main())
