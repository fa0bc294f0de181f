"""A small share of the fault campaign (tests/campaign/faults.py): real processes, killed in the middle of a mission."""

import random

from robotd.server.store import Store
from tests.bad_network import FAULTS, BadNetwork
from tests.killed_missions import Lives, robot_of
from tests.test_server import running


def test_a_daemon_that_is_killed_on_its_mission_loses_and_doubles_no_stop(tmp_path):
    rng = random.Random(1)
    with (
        running(Store(tmp_path / "data"), token=None) as server,
        BadNetwork(server.port, lambda: rng.choice(["ok", "ok", *FAULTS])) as network,
        robot_of(tmp_path / "robot", network.url).without_daemon() as robot,
    ):
        lives = Lives(robot)
        for seconds in (0.3, 1.0):
            lives.live(seconds, stops=1)
        network.is_mended = True
        lives.bring_home(tmp_path / "data")
    assert lives.kills == 2
