"""Kills, power cuts, full disks and bad networks on whole missions: no finished stop is lost or doubled.

    python -m pytest tests/campaign/faults.py -s      500 kills, 20 power cuts: minutes of computing, an hour of waiting

ROBOTD_KILLS sets another number of kills, ROBOTD_SEED the first robot's seed. Power cuts and full disks need root and a
loop device.
"""

import asyncio
import dataclasses
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from robotd.drivers.line_follower import LineFollowerConfig, LineFollowerDriver
from robotd.drivers.roomba import RoombaConfig, RoombaDriver
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

from robotd.bus import Bus
from robotd.clock import run_virtual
from robotd.config import Config, MissionConfig, RobotConfig
from robotd.daemon import Assembly, Daemon
from robotd.journal import Journal
from robotd.plugin import Driver
from robotd.sim.hardware import FOLDER, SimHardware
from robotd.sim.layout import Mark
from robotd.sim.settings import WorldSettings
from robotd.sim.world import World
from tests.bad_network import FAULTS, BadNetwork
from tests.killed_missions import STOPS, TOLD, Lives, ask, pauses, robot_of
from tests.line_course import store

KILLS = int(os.environ.get("ROBOTD_KILLS", "500"))
SEED = int(os.environ.get("ROBOTD_SEED", "0"))
ROBOTS = 4
SERVE = """
import sys
from pathlib import Path
from robotd.server.app import serve
serve("127.0.0.1", 0, Path(sys.argv[1]), None)
"""
needs_root = pytest.mark.skipif(
    os.geteuid() != 0 or not os.path.exists("/dev/loop-control"), reason="needs root and loop devices"
)


@contextmanager
def solver(folder):
    """`robotd-solver serve`; yields its port."""
    with subprocess.Popen([sys.executable, "-c", SERVE, str(folder)], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield int(process.stdout.readline().rsplit(":", 1)[1])
        finally:
            process.kill()


@pytest.mark.parametrize("seed", range(SEED, SEED + ROBOTS))
def test_a_daemon_may_be_killed_at_any_moment(tmp_path, seed):
    rng, faults = random.Random(seed), random.Random(100 + seed)
    with (
        solver(tmp_path / "data") as port,
        BadNetwork(port, lambda: faults.choice(["ok"] * 3 + list(FAULTS))) as network,
        robot_of(tmp_path / "robot", network.url).without_daemon() as robot,
    ):
        lives = Lives(robot)
        while lives.kills < KILLS // ROBOTS:
            is_early = rng.random() < 0.2
            lives.live(rng.uniform(0.0, 3.0 if is_early else 7.0), is_early=is_early, is_hasty=rng.random() < 0.8)
        network.is_mended = True
        lives.bring_home(tmp_path / "data")
    print(
        f"\nseed {seed}: {lives.kills} kills in {lives.missions} missions of {STOPS} stops, while {lives.states}; "
        f"rolled {1000 * lives.farthest:.0f} mm at most after a kill; connections {network.counts}"
    )


def test_a_mission_writes_little_more_than_its_stops_and_its_trail(tmp_path):
    with robot_of(tmp_path / "robot", "http://127.0.0.1:9").without_daemon() as robot:
        lives = Lives(robot)
        robot.begin()
        while ask(robot.control, "mission.status") is None:
            pass
        before = written(robot.daemon.pid)
        for _ in pauses(120.0):
            if lives.look() == "uploading":
                break
        after = written(robot.daemon.pid)
        robot.kill()
    print(f"\n{(after - before) / 1e6:.2f} MB were written in a mission of {STOPS} stops")
    assert after - before < 1.5e6


def written(pid):
    """Bytes that a process has had written to disks."""
    fields = dict(line.split(": ") for line in Path(f"/proc/{pid}/io").read_text().splitlines())
    return int(fields["write_bytes"])


# ---- on the line -----------------------------------------------------------------------------------------------------


class Silent(Driver):
    """A label system that does nothing: there is no camera to see it."""

    async def flash(self, labels, strength, duration):
        return {}


@pytest.mark.parametrize(
    ("interrupted", "stop_at"),
    [
        (("driving", 2), "markers"),
        (("observing", 2), "markers"),
        (("driving", 3), "distances"),
        (("settling", 1), "distances"),
    ],
)
def test_a_mission_that_is_interrupted_on_its_line_stops_where_it_would_have(tmp_path, interrupted, stop_at):
    layout, shift = store([(0.0, 0.0), (1.2, 0.0)], texture="concrete")
    places = ((0.5, 0.14, "square"), (0.9, -0.15, "dot"))
    marks = tuple(Mark((float(x + shift[0]), float(y + shift[1])), shape=shape) for x, y, shape in places)
    world = World(dataclasses.replace(layout, marks=marks), WorldSettings(), 1, tmp_path)
    hardware, calibration = SimHardware(world), world.believed_calibration()
    count = {"marker_stops": 3} if stop_at == "markers" else {"stops": (0.0, 0.5, 0.9)}
    mission = MissionConfig("line", labels=("a",), stop_at=stop_at, resume="auto", least_labels=0, **count)
    stood, daemons = {}, []

    async def life(until):
        bus = Bus()
        rest = hardware, bus, calibration
        base = RoombaDriver("base", RoombaConfig(FOLDER + "base"), *rest)
        eye = V4l2Driver("floor", V4l2Config(FOLDER + "floor"), *rest)
        follower = LineFollowerDriver("follower", LineFollowerConfig(), *rest)
        assembly = Assembly(
            *(tmp_path / "robotd.toml", Config(RobotConfig("r", tmp_path), mission, drivers={}), calibration),
            *(bus, hardware, base, follower, Silent("labels", None, *rest), {}, eye),
        )
        daemons.append(Daemon(assembly))
        with bus.status.subscribe(size=256) as statuses:
            running = asyncio.create_task(daemons[-1].run(mission=True))
            async for status in statuses:
                if status.state == "observing":
                    stood[status.stop] = world.body.pose.x - shift[0]
                if (status.state, status.stop) == until or status.state == "done":
                    break
            await asyncio.sleep(0.7)
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    async def main():
        await life(interrupted)
        await asyncio.sleep(3.0)
        await life(None)

    run_virtual(main())
    assert daemons[-1].mission.ended is None
    made = [(stop.leg, stop.stop) for stop in daemons[-1].mission.stops]
    assert [stop for _, stop in made] == [1, 2, 3]
    assert made[-1][0] == (1 if interrupted == ("settling", 1) else 2)
    # by distances, what it rolled in the last second before the interruption is not known
    assert stood == pytest.approx({1: 0.0, 2: 0.5, 3: 0.9}, abs=0.03 if stop_at == "markers" else 0.3)
    print(f"\n{stop_at}, {interrupted}: stood at {stood}")


# ---- disks -----------------------------------------------------------------------------------------------------------


def run(*command):
    subprocess.run([str(part) for part in command], check=True, capture_output=True)


@contextmanager
def mounted(image, folder):
    folder.mkdir(exist_ok=True)
    made = subprocess.run(["mount", "-o", "loop", image, folder], capture_output=True, text=True, check=False)
    if made.returncode != 0:
        pytest.skip(f"no loop device here: {made.stderr.strip()}")
    try:
        yield folder
    finally:
        run("umount", "-l", folder)


def disk(path, megabytes):
    with path.open("wb") as file:
        file.truncate(megabytes << 20)
    run("mkfs.ext4", "-qF", path)
    return path


@needs_root
def test_a_power_cut_loses_no_stop_that_was_told(tmp_path):
    rng, cuts = random.Random(7 + SEED), 0
    image, copy = disk(tmp_path / "a.img", 48), tmp_path / "b.img"
    with mounted(image, tmp_path / "a") as state, BadNetwork(9, lambda: "gone") as network:
        robot = robot_of(tmp_path / "robot", network.url, state=state)
        with robot.without_daemon():
            robot.begin()
            survey, told, begun = 0, 0, 0
            while cuts < 20:
                due = rng.uniform(0.5, 6.0)
                for _ in pauses(due):
                    status = ask(robot.control, "mission.status")
                    if status is not None and not status["is_under_way"]:
                        answer = ask(robot.control, "mission.start", survey=f"survey {begun}")
                        if "leg" in answer:
                            survey, told, begun = begun, len(robot.told()), begun + 1
                    elif status is not None and status["paused"] is not None:
                        ask(robot.control, "mission.resume")
                os.kill(robot.daemon.pid, signal.SIGSTOP)
                said = {int(number) for number in TOLD.findall(robot.told()[told:])}
                run("cp", "--sparse=always", image, copy)
                os.kill(robot.daemon.pid, signal.SIGCONT)
                cuts += 1
                with mounted(copy, tmp_path / "b") as folder:
                    path = folder / "journal.sqlite"
                    if not path.exists():
                        assert not said
                        continue
                    with Journal.open(path) as journal:
                        assert journal.sure.execute("PRAGMA integrity_check").fetchone() == ("ok",)
                        name = f"survey {survey}"
                        made = [stop.stop for stop in journal.survey(name).stops] if name in journal.surveys() else []
                        found = journal.unfinished()
                    assert len(made) == len(set(made))
                    assert said <= set(made), f"lost: told {said}, found {made}"
                    if made and len(made) < STOPS:
                        assert found.note.stop == max(made) + 1
    print(f"\n{cuts} power cuts in {begun} missions")


@needs_root
def test_a_disk_that_is_full_pauses_the_mission_and_loses_nothing(tmp_path):
    image = disk(tmp_path / "a.img", 24)
    with mounted(image, tmp_path / "a") as state, solver(tmp_path / "data") as port:
        robot = robot_of(tmp_path / "robot", f"http://127.0.0.1:{port}", keep_free_mb=1.0, state=state)
        with robot.without_daemon():
            lives = Lives(robot)
            robot.begin()
            seen = set()
            for round_ in range(4):
                for _ in pauses(4.0):  # on its way
                    lives.start_or_resume()
                ballast = state / "ballast"
                fill(ballast, leave=(600 << 10) if round_ % 2 else 0)  # nearly full, and quite
                for _ in pauses(12.0):
                    status = ask(robot.control, "mission.status")
                    if status is not None and status["paused"] is not None:
                        seen.add(re.split(r"[:,;]", status["paused"])[0])
                assert robot.daemon.poll() is None, robot.told()[-3000:]
                ballast.unlink()
                for _ in pauses(10.0):
                    lives.start_or_resume()
                lives.check(lives.journal)
            robot.kill()
            lives.check(lives.journal)
            lives.bring_home(tmp_path / "data")
    assert any("disk is nearly full" in text or "cannot be written" in text for text in seen), seen
    print(f"\nfull disks paused with {sorted(seen)}")


def fill(path, leave):
    """Take all room of a disk but so many bytes."""
    with path.open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12):
            try:
                while shutil.disk_usage(path.parent).free > leave:
                    file.write(bytes(size))
            except OSError:
                pass
