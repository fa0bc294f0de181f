"""A whole daemon, `robotd run`, that drives a simulated robot on a pseudo-terminal and dies in the middle of it."""

import os
import signal

import pytest

from tests.robot_process import PUSHING, Robot, drives, is_halted


@pytest.fixture
def robot(tmp_path):
    """A daemon on its way."""
    with Robot(tmp_path, drivers=PUSHING, config="") as robot:
        robot.wait(drives)
        yield robot


def test_a_daemon_that_is_killed_with_its_whole_group_leaves_the_robot_halted(robot):
    before = robot.wait(drives)
    robot.kill()
    after = robot.wait(is_halted)
    assert max(after["rotations"]) - max(before["rotations"]) < 0.5


def test_a_daemon_that_hangs_leaves_the_robot_halted_and_comes_back_when_it_goes_on(robot):
    before = robot.wait(drives)
    os.killpg(robot.daemon.pid, signal.SIGSTOP)
    after = robot.wait(is_halted)
    assert max(after["rotations"]) - max(before["rotations"]) < 0.5
    os.killpg(robot.daemon.pid, signal.SIGCONT)
    robot.wait(drives)  # connected anew; its follower still wants to
    robot.daemon.terminate()
    assert robot.daemon.wait(20) == 0
    robot.wait(is_halted)
