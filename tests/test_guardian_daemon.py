"""A whole daemon, `robotd run`, that drives a simulated robot on a pseudo-terminal and dies in the middle of it."""

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys

import pytest

CONFIG = """
[robot]
name = "trial"
state_directory = "state"
calibration = "calibration.toml"
guardian = "no-service.sock"
[drivers.base]
driver = "roomba"
port = "{port}"
[drivers.eye]
driver = "trial_camera"
[drivers.follower]
driver = "trial_follower"
[drivers.labels]
driver = "trial_labels"
"""
DRIVERS = """
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


@pytest.fixture
def robot(tmp_path):
    """`robotd sim roomba`; asks it for its state."""
    port = tmp_path / "port"
    command = [sys.executable, "-m", "robotd", "sim", "roomba", "--quiet", "--link", str(port)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert "simulated Roomba at" in process.stderr.readline()

            def state():
                with socket.socket(socket.AF_UNIX) as line, line.makefile() as answers:
                    line.connect(f"{port}.ctl")
                    line.sendall(b'{"state": true}\n')
                    return json.loads(answers.readline())

            state.port = port
            yield state
        finally:
            process.kill()


def wait(robot, condition):
    for _ in range(3000):
        state = robot()
        if condition(state):
            return state
        select.select([], [], [], 0.01)
    raise AssertionError(f"it has not come to that: {state}")


def drives(state):
    return min(state["requested_mm_s"]) >= 150


def is_halted(state):
    return not any(state["requested_mm_s"]) and state["mode"] in ("off", "passive")


@contextlib.contextmanager
def daemon(robot, folder):
    """A daemon in a process group of its own, on its way."""
    (folder / "robotd.toml").write_text(CONFIG.format(port=robot.port))
    (folder / "calibration.toml").touch()
    (folder / "state").mkdir()
    (folder / "trial_drivers.py").write_text(DRIVERS)
    info = folder / "trial_drivers-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: trial-drivers\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    command = [sys.executable, "-m", "robotd", "run", "-c", str(folder / "robotd.toml")]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    with subprocess.Popen(command, env=environment, start_new_session=True) as process:
        try:
            wait(robot, drives)
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def test_a_daemon_that_is_killed_with_its_whole_group_leaves_the_robot_halted(robot, tmp_path):
    with daemon(robot, tmp_path) as process:
        before = wait(robot, drives)
        os.killpg(process.pid, signal.SIGKILL)
        after = wait(robot, is_halted)
        assert max(after["rotations"]) - max(before["rotations"]) < 0.5


def test_a_daemon_that_hangs_leaves_the_robot_halted_and_comes_back_when_it_goes_on(robot, tmp_path):
    with daemon(robot, tmp_path) as process:
        before = wait(robot, drives)
        os.killpg(process.pid, signal.SIGSTOP)
        after = wait(robot, is_halted)
        assert max(after["rotations"]) - max(before["rotations"]) < 0.5
        os.killpg(process.pid, signal.SIGCONT)
        wait(robot, drives)  # connected anew; its follower still wants to
        process.terminate()
        assert process.wait(20) == 0
        wait(robot, is_halted)
