"""Missions whose daemon is killed (-9) again and again, over a network that fails; what must hold after each death.

Everything is real but the world: `robotd sim roomba` on a pseudo-terminal, `robotd run` with its guardian, journal,
upload and control socket, and the server. Missions are short, and observing is quick: one small camera, no light.
"""

import contextlib
import json
import os
import re
import select
import signal
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing

import msgspec

from robotd.config import Calibration, save_calibration
from robotd.journal import Journal
from robotd.records import CameraModel, Transform
from robotd.server.store import Store
from tests.robot_process import WALKING, Robot, is_halted

STOPS = 5
SPACING_M = 0.12
MISSION = """
[mission]
stops = {stops}
labels = ["A1", "A2"]
resume = "auto"
settle_s = 0.05
keep_free_mb = {keep_free_mb}
least_labels = 0
upload_wait_s = 30.0
[mission.identify]
poll_s = 0.1
delay_median_s = 0.05
delay_normal_s = 0.1
delay_tail_s = 0.1
durations_s = [1]
stop_s = 10.0
max_slots = 1
pattern = {{ period = 0.4, on = [[0.0, 0.1], [0.2, 0.25]] }}
[upload]
url = "{url}"
retry_s = 0.1
timeout_s = 5.0
"""
DRIVERS = (
    WALKING
    + """
from dataclasses import replace

class Camera(Camera):
    async def _stream(self, mode):
        await super()._stream(replace(mode, size=(64, 48), fps=10.0))

    def _publish(self, frame, mode):
        super()._publish(frame, self.wanted)
"""
)
CAMERA = CameraModel("eye", (64, 48), (32.0, 32.0, 31.5, 23.5), Transform((-1.2, 1.2, -1.2), (0.0, 0.0, 0.5)))
TOLD = re.compile(r"mission: stop (\d+) of \d+:")
POLL_S = 0.1


# imports once what every daemon needs, which takes longer than the lives of most; each daemon is a process of its own
NURSERY = """
import os, signal, sys
from robotd.__main__ import main
import robotd.control_socket, robotd.daemon, robotd.operations, robotd.prompt, robotd.real
from robotd.plugin import available
for point in available().values():
    point.load()
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
print("ready", flush=True)
for line in sys.stdin:
    config, log = line.rstrip("\\n").split("\\t")
    child = os.fork()
    if not child:
        os.setsid()
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.dup2(os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644), 2)
        sys.stdin = None
        os._exit(main(["run", "-c", config]))
    print(child, flush=True)
"""


class Child:
    """A daemon from the nursery, as far as a Robot needs it."""

    def __init__(self, pid):
        self.pid = pid

    def poll(self):
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return -signal.SIGKILL
        return None

    def wait(self):
        while self.poll() is None:
            select.select([], [], [], 0.002)


class NurseryRobot(Robot):
    """A robot whose daemons are forked from one that has imported everything."""

    @contextlib.contextmanager
    def without_daemon(self):
        path = os.pathsep.join([str(self.folder), os.getcwd()])
        command = [sys.executable, "-c", NURSERY]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        with super().without_daemon(), subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}, **pipes) as it:
            self.nursery = it
            assert it.stdout.readline() == "ready\n"
            yield self
            it.stdin.close()

    def begin(self):
        self._begun = self.log.stat().st_size if self.log.exists() else 0
        self.nursery.stdin.write(f"{self.folder / 'robotd.toml'}\t{self.log}\n")
        self.nursery.stdin.flush()
        self.daemon = Child(int(self.nursery.stdout.readline()))


def robot_of(folder, url, *, keep_free_mb=0.0, state=None):
    """A robot whose missions have a stop every SPACING_M."""
    folder.mkdir(parents=True, exist_ok=True)
    stops = [round(SPACING_M * k, 2) for k in range(STOPS)]
    config = MISSION.format(stops=stops, url=url, keep_free_mb=keep_free_mb)
    robot = NurseryRobot(folder, drivers=DRIVERS, config=config, state=state)
    save_calibration(Calibration(cameras=(CAMERA,)), folder / "calibration.toml")
    return robot


def pauses(seconds):
    """Go on for so long, with a pause after each round."""
    for _ in range(round(seconds / POLL_S)):
        yield
        select.select([], [], [], POLL_S)


def ask(path, method, **params):
    """One question to a daemon's control socket: its result or error; None while nobody answers."""
    request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
    try:
        with socket.socket(socket.AF_UNIX) as line, line.makefile() as answers:
            line.settimeout(10.0)
            line.connect(str(path))
            line.sendall(json.dumps(request).encode() + b"\n")
            for answer in answers:
                message = json.loads(answer)
                if message.get("id") == 1:
                    return message.get("result", message.get("error"))
    except OSError:
        pass
    return None


class Lives:
    """The lives of one robot's daemon.

    Attributes
    ----------
    kills, missions : int
        So far.
    states : dict of str to int
        What the mission did when the daemon was killed, or a moment before; "starting": nobody answered yet.
    farthest : float
        Metres that the robot rolled at most between a kill and its halt.
    """

    def __init__(self, robot):
        self.robot = robot
        self.journal = robot.state_directory / "journal.sqlite"
        self.kills = self.missions = 0
        self.states = {}
        self.farthest = 0.0
        self._told = set()  # stops of this mission that the robot said it has made

    @property
    def survey(self):
        return f"survey {self.missions}"

    def live(self, seconds, *, is_early=False, is_hasty=True, stops=0):
        """Have a daemon drive, then kill it.

        Parameters
        ----------
        seconds : float
            From when it answers; with `is_early` from its start.
        is_hasty : bool
            Somebody resumes at once what is paused.
        stops : int
            So many must have been made before the seconds count.
        """
        robot = self.robot
        robot.begin()
        for _ in () if is_early else pauses(60.0):
            if ask(robot.control, "mission.status") is not None:
                break
        state = "starting"
        for _ in pauses(60.0) if stops else ():
            state = self.look(is_hasty=is_hasty) or state
            if len(TOLD.findall(robot.told())) >= stops:
                break
        for _ in pauses(seconds):
            state = self.look(is_hasty=is_hasty) or state
            if state == "done":
                break
        before = robot.state()
        robot.kill()
        self.kills += 1
        self.states[state] = self.states.get(state, 0) + 1
        after = robot.wait(is_halted)
        rolled = max(after["rotations"]) - max(before["rotations"])
        self.farthest = max(self.farthest, rolled)
        assert rolled < 0.3
        self.check(self.journal)
        if self._is_complete():
            self.missions += 1
            self._told = set()

    def look(self, *, is_hasty=True):
        """Begin a mission or go on with one; its state, None if nobody answers."""
        status = ask(self.robot.control, "mission.status")
        if status is None:
            assert self.robot.daemon.poll() is None, self.robot.told()
            return None
        return status["state"] if self._go_on(status, is_hasty=is_hasty) else "done"

    def start_or_resume(self):
        """See that a mission is under way; begins another one when it has ended."""
        status = ask(self.robot.control, "mission.status")
        if status is not None and not self._go_on(status, is_hasty=True):
            self.check(self.journal)
            self.missions += 1
            self._told = set()
            self.robot.forget_told()

    def _go_on(self, status, *, is_hasty):
        """Returns whether there is more to drive."""
        if not status["is_under_way"]:
            answer = ask(self.robot.control, "mission.start", survey=self.survey)
            return "stops already" not in str(answer)
        if status["paused"] is not None and is_hasty:
            ask(self.robot.control, "mission.resume")
        return True

    def check(self, path):
        """The database opens and is whole, has every stop that was told, and none of them twice."""
        if not path.exists():
            return
        with closing(sqlite3.connect(path)) as connection:
            assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        self._told |= {int(number) for number in TOLD.findall(self.robot.told())}
        made = self._stops(path)
        assert len(made) == len(set(made)), f"doubled: {made}"
        assert self._told <= set(made), f"lost: told {self._told}, found {made}"

    def _stops(self, path):
        with Journal.open(path) as journal:
            if self.survey not in journal.surveys():
                return []
            return [stop.stop for stop in journal.survey(self.survey).stops]

    def _is_complete(self):
        if len(self._stops(self.journal)) < STOPS:
            return False
        with Journal.open(self.journal) as journal:
            return journal.unfinished() is None

    def bring_home(self, data):
        """Let the last daemon upload everything; what the server has in `data` is what the journal has, to the byte."""
        self.robot.begin()
        for _ in pauses(60.0):
            status = ask(self.robot.control, "status")
            if status is None:
                continue
            if status["mission"]["is_under_way"]:
                ask(self.robot.control, "mission.abort")
            elif status["uploads"]["waiting"] == 0:
                break
        self.robot.kill()
        store = Store(data)
        with Journal.open(self.journal) as journal:
            assert journal.waiting() == 0
            surveys = {name: journal.survey(name).stops for name in journal.surveys()}
        assert store.surveys() == {name: len(stops) for name, stops in surveys.items()}
        for name, stops in surveys.items():
            table = json.loads(store.survey(name)[0])
            assert table["stops"] == json.loads(msgspec.json.encode(stops))
            numbers = [stop.stop for stop in stops]
            assert len(numbers) == len(set(numbers))
