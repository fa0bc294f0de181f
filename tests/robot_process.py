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
state_directory = "state"
calibration = "calibration.toml"
guardian = "no-service.sock"
control = "control.sock"
[mission]
stops = [0.0, 1.0, 2.0]
labels = ["A1"]
[recording]
directory = "recordings"
[drivers.base]
driver = "roomba"
port = "{port}"
[drivers.eye]
driver = "trial_eye"
[drivers.follower]
driver = "trial_walker"
camera = "eye"
[drivers.labels]
driver = "trial_labels"
"""
DRIVERS = """
from dataclasses import dataclass

from tests.operated import Eye, Labels, Walker

@dataclass(frozen=True)
class Empty:
    camera: str = "eye"

for cls in (Eye, Labels, Walker):
    cls.Config = Empty
"""
ENTRY_POINTS = """
[robotd.drivers]
trial_eye = trial_drivers:Eye
trial_labels = trial_drivers:Labels
trial_walker = trial_drivers:Walker
"""


class Robot:
    """Runs while it is entered; `control` is the daemon's control socket."""

    def __init__(self, folder):
        self.folder = folder
        self.control = folder / "control.sock"
        self.port = folder / "port"

    def __enter__(self):
        folder = self.folder
        (folder / "robotd.toml").write_text(CONFIG.format(port=self.port))
        (folder / "calibration.toml").touch()
        (folder / "state").mkdir()
        (folder / "trial_drivers.py").write_text(DRIVERS)
        info = folder / "trial_drivers-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: trial-drivers\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(ENTRY_POINTS)
        with contextlib.ExitStack() as stack:
            command = [sys.executable, "-m", "robotd", "sim", "roomba", "--quiet", "--link", str(self.port)]
            sim = stack.enter_context(subprocess.Popen(command, stderr=subprocess.PIPE, text=True))
            stack.callback(sim.kill)
            assert "simulated Roomba at" in sim.stderr.readline()
            path = os.pathsep.join([str(folder), os.getcwd()])
            command = [sys.executable, "-m", "robotd", "run", "-c", str(folder / "robotd.toml")]
            log = stack.enter_context((folder / "robotd.log").open("w"))
            self.daemon = subprocess.Popen(
                command, env={**os.environ, "PYTHONPATH": path}, start_new_session=True, stderr=log
            )
            stack.enter_context(self.daemon)
            stack.callback(self._end)
            self._wait_found()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_):
        self._stack.close()

    def _end(self):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.daemon.pid, signal.SIGKILL)

    def _wait_found(self):
        for _ in range(6000):
            if "base found" in (self.folder / "robotd.log").read_text() and self.control.exists():
                return
            assert self.daemon.poll() is None, (self.folder / "robotd.log").read_text()
            select.select([], [], [], 0.01)
        raise AssertionError((self.folder / "robotd.log").read_text())

    def state(self):
        """Of the simulated robot, by its own side channel."""
        with socket.socket(socket.AF_UNIX) as line, line.makefile() as answers:
            line.connect(f"{self.port}.ctl")
            line.sendall(b'{"state": true}\n')
            return json.loads(answers.readline())

    def wait(self, condition, while_=lambda: None):
        """Until the robot is so; `while_` is done again and again, 20 times a second."""
        for k in range(3000):
            if k % 5 == 0:
                while_()
            state = self.state()
            if condition(state):
                return state
            select.select([], [], [], 0.01)
        raise AssertionError(f"it has not come to that: {state}\n{(self.folder / 'robotd.log').read_text()[-2000:]}")
