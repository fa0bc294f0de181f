"""A whole robot in processes of its own: `robotd sim roomba` on a pseudo-terminal, and `robotd run` that drives it."""

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys

CONFIG = """
[robot]
name = "trial"
state_directory = "{state}"
calibration = "calibration.toml"
guardian = "no-service.sock"
control = "control.sock"
[recording]
directory = "recordings"
[drivers.base]
driver = "roomba"
port = "{port}"
[drivers.eye]
driver = "trial_camera"
[drivers.follower]
driver = "trial_follower"
camera = "eye"
[drivers.labels]
driver = "trial_labels"
"""
MISSION = """
[mission]
stops = [0.0, 1.0, 2.0]
labels = ["A1"]
"""

# two outsiders' packages of drivers: one for missions, one whose follower wants to drive straight on from the start
WALKING = """
from dataclasses import dataclass

from tests.operated import Eye as Camera, Labels, Walker as Follower

@dataclass(frozen=True)
class Empty:
    camera: str = "eye"

for cls in (Camera, Labels, Follower):
    cls.Config = Empty
"""
PUSHING = """
from dataclasses import dataclass

from robotd.clock import now, ticks
from robotd.plugin import Driver
from robotd.records import DriveCommand

@dataclass(frozen=True)
class Empty:
    camera: str = "eye"

class Camera(Driver):
    kind, Config = "camera", Empty

class Labels(Driver):
    kind, Config = "labels", Empty

class Follower(Driver):
    kind, Config, blind = "follower", Empty, 0.3

    async def run(self):
        async for _ in ticks(0.03):
            self.bus.commands.publish(DriveCommand(now(), 0.2, 0.0, self.name))
"""
ENTRY_POINTS = """
[robotd.drivers]
trial_camera = trial_drivers:Camera
trial_labels = trial_drivers:Labels
trial_follower = trial_drivers:Follower
"""


def install_drivers(folder, drivers):
    """Put a package of drivers into a folder of packages."""
    (folder / "trial_drivers.py").write_text(drivers)
    info = folder / "trial_drivers-1.0.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: trial-drivers\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)


def drives(state):
    return min(state["requested_mm_s"]) >= 150


def is_halted(state):
    return not any(state["requested_mm_s"]) and state["mode"] in ("off", "passive")


class Roomba:
    """`robotd sim roomba`, while it is entered; `port` is where clients find it."""

    def __init__(self, folder):
        self.port = folder / "port"

    def __enter__(self):
        command = [sys.executable, "-m", "robotd", "sim", "roomba", "--quiet", "--link", str(self.port)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert "simulated Roomba at" in self.process.stderr.readline()
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()

    def tell(self, **what):
        """By its own side channel, see sim/side_channel.py."""
        with socket.socket(socket.AF_UNIX) as line, line.makefile() as answers:
            line.connect(f"{self.port}.ctl")
            line.sendall(json.dumps(what).encode() + b"\n")
            return json.loads(answers.readline())

    def state(self):
        return self.tell(state=True)

    def wait(self, condition, while_=lambda: None):
        """Until the robot is so; `while_` is done again and again, 20 times a second."""
        for k in range(3000):
            if k % 5 == 0:
                while_()
            state = self.state()
            if condition(state):
                return state
            select.select([], [], [], 0.01)
        raise AssertionError(f"it has not come to that: {state}")


class Robot(Roomba):
    """A Roomba with its daemon; `control` is the daemon's control socket, `log` what all daemons have told.

    Parameters
    ----------
    drivers : str
        WALKING or PUSHING.
    config : str
        Further sections of the configuration.
    state : Path, optional
        The state directory.
    """

    def __init__(self, folder, *, drivers=WALKING, config=MISSION, state=None):
        super().__init__(folder)
        self.folder = folder
        self.control = folder / "control.sock"
        self.log = folder / "robotd.log"
        self.daemon = None
        self.state_directory = state = state or folder / "state"
        state.mkdir(exist_ok=True)
        (folder / "robotd.toml").write_text(CONFIG.format(port=self.port, state=state) + config)
        (folder / "calibration.toml").touch()
        install_drivers(folder, drivers)

    def __enter__(self):
        super().__enter__()
        try:
            self.start()
        except BaseException:
            self.__exit__()
            raise
        return self

    @contextlib.contextmanager
    def without_daemon(self):
        """The Roomba alone; whoever enters this begins daemons."""
        super().__enter__()
        try:
            yield self
        finally:
            self.__exit__()

    def __exit__(self, *_):
        if self.daemon is not None:
            self.kill()
        super().__exit__()

    def start(self):
        """Start a daemon, in a process group of its own, and wait until it has found its base."""
        self.begin()
        for _ in range(6000):
            if "base found" in self.told() and self.control.exists():
                return
            assert self.daemon.poll() is None, self.told()
            select.select([], [], [], 0.01)
        raise AssertionError(self.told())

    def begin(self):
        """Start a daemon."""
        self._begun = self.log.stat().st_size if self.log.exists() else 0
        path = os.pathsep.join([str(self.folder), os.getcwd()])
        command = [sys.executable, "-m", "robotd", "run", "-c", str(self.folder / "robotd.toml")]
        with self.log.open("a") as log:
            self.daemon = subprocess.Popen(
                command, env={**os.environ, "PYTHONPATH": path}, start_new_session=True, stderr=log
            )

    def told(self):
        """What this daemon has told."""
        with self.log.open() as log:
            log.seek(self._begun)
            return log.read()

    def forget_told(self):
        """Let `told` begin here."""
        self._begun = self.log.stat().st_size

    def kill(self):
        """kill -9 the daemon with its group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.daemon.pid, signal.SIGKILL)
        self.daemon.wait()
