"""What the daemon takes of a Raspberry Pi 3, measured here: `python -m tests.bench.pi` takes a minute and a half.

The whole `robotd run`, on a simulated base behind a pseudo-terminal. Memory is that of the process. Times become a Pi's
by way of instructions, because this machine's clock and caches are not a Pi's:

    seconds on the Pi = instructions / (1.2 GHz * 0.42 instructions a cycle)

1.2 GHz is the clock of a Pi 3 B (the B+ has 1.4); with 0.42 the 40 million instructions of `python3 -c pass` take
0.08 s. valgrind counts the instructions of the start, and those of a second at rest, without the kernel's. How
late the control loop is called depends on the system more than on the daemon, so it stands beside how late a process
is called that does nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from robotd.config import Calibration, save_calibration
from robotd.records import CameraModel, Transform

PI_RATE = 1.2e9 * 0.42  # instructions/s of one core of a Pi 3 in Python
CAMERAS = ("front", "left", "rear", "right")
SIZE = (640, 480)
FPS = 30.0
FILM_S = 4.0
LAMPS = 12  # that flash in each camera's view
FLOOR = Transform((-1.8, 0.0, 0.0), (0.1, 0.0, 0.3))
FLASHES = [(0.0, 0.1), (0.2, 0.3), (0.4, 0.5)]  # s, each second
START_S = 60.0  # patience
TICK = 0.015  # s, of the probe on the control loop: the base's own

CONFIG = """
[robot]
name = "bench"
state_directory = "state"
calibration = "calibration.toml"
guardian = "guardian.sock"
control = "control.sock"
[mission]
stops = [0.0]
labels = {labels}
[recording]
directory = "recordings"
[drivers.base]
driver = "roomba"
port = "{folder}/port"
[drivers.labels]
driver = "pricer"
port = {port}
[drivers.floor]
driver = "replay"
file = "floor_film"
fps = {fps}
loop = true
[drivers.follower]
driver = "line_follower"
camera = "floor"
"""
CAMERA = """
[drivers.{name}]
driver = "replay"
file = "film"
fps = {fps}
loop = true
"""
PROBE = """
[drivers.probe]
driver = "bench_probe"
file = "lateness.json"
"""
# an outsider's driver, which ticks on the daemon's loop as the control loop does, and notes how late it is called
DRIVER = """
import json
from dataclasses import dataclass
from pathlib import Path

from robotd.clock import now, ticks
from robotd.plugin import Driver


@dataclass(frozen=True)
class ProbeConfig:
    file: Path
    tick: float = 0.015


class Probe(Driver):
    kind, Config = "beacons", ProbeConfig

    async def run(self):
        late, start = [], now()
        try:
            async for k in ticks(self.config.tick):
                late.append((now(), now() - start - k * self.config.tick))
        finally:
            self.config.file.write_text(json.dumps(late))
"""
ENTRY_POINTS = "[robotd.drivers]\nbench_probe = bench_probe:Probe\n"


class Robot:
    """A folder with everything that `robotd run` needs, and the processes around it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.notify.bind(str(folder / "notify"))
        self.notify.settimeout(START_S)

    def configure(self, *, has_probe: bool) -> None:
        """Write configuration, calibration, footage and the probe."""
        folder = self.folder
        labels = json.dumps([f"A{k:04d}" for k in range(400)])
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        text = CONFIG.format(folder=folder, labels=labels, port=self.port, fps=FPS)
        text += "".join(CAMERA.format(name=name, fps=FPS) for name in CAMERAS)
        (folder / "robotd.toml").write_text(text + (PROBE if has_probe else ""))
        lens = (268.5, 268.5, 319.5, 239.5)
        cameras = tuple(
            CameraModel(name, SIZE, lens, Transform((-1.2092, 1.2092, -1.2092), (0.06, 0.0, 0.5))) for name in CAMERAS
        )
        floor = CameraModel("floor", (320, 240), (228.5, 228.5, 159.5, 119.5), FLOOR)
        save_calibration(Calibration(cameras=cameras, floor_camera=floor), folder / "calibration.toml")
        (folder / "state").mkdir(exist_ok=True)
        (folder / "bench_probe.py").write_text(DRIVER)
        info = folder / "bench_probe-1.0.dist-info"
        info.mkdir(exist_ok=True)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-probe\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(ENTRY_POINTS)

    @contextlib.contextmanager
    def surroundings(self) -> Iterator[None]:
        """The simulated base, and the label system's gateway, whose folder nobody reads."""
        (self.folder / "watched").mkdir(exist_ok=True)
        commands = (
            ["-m", "robotd", "sim", "roomba", "--quiet", "--link", "port"],
            ["-m", "robotd.gateway", "--folder", "watched", "--port", str(self.port)],
        )
        with contextlib.ExitStack() as stack:
            for command in commands:
                process = subprocess.Popen(
                    [sys.executable, *command], cwd=self.folder, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
                )
                stack.enter_context(process)
                stack.callback(process.kill)
            begun = time.monotonic()
            while not (self.folder / "port.ctl").exists():
                assert time.monotonic() < begun + START_S, "the simulated base does not start"
                time.sleep(0.05)
            yield

    @contextlib.contextmanager
    def daemon(self, *arguments: str, before: tuple[str, ...] = ()) -> Iterator[subprocess.Popen[bytes]]:
        """`robotd run`, with the priority that its unit gives it; ends it in the end."""
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(self.folder), os.getcwd()]),
            "PYTHONPYCACHEPREFIX": str(self.folder / "pyc"),
            "PYTHONHASHSEED": "0",
            "NOTIFY_SOCKET": str(self.folder / "notify"),
        }
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        command = [*before, sys.executable, "-m", "robotd", "run", "-c", "robotd.toml", *arguments]
        with (self.folder / "log").open("w") as log:
            process = subprocess.Popen(command, cwd=self.folder, env=environment, stderr=log, start_new_session=True)
        with process:
            try:
                with contextlib.suppress(PermissionError):
                    os.setpriority(os.PRIO_PROCESS, process.pid, -5)  # robotd.service: Nice=-5
                yield process
                process.terminate()
                process.wait(START_S)
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)

    def wait_ready(self) -> None:
        """Until the daemon says that it is ready."""
        while b"READY=1" not in self.notify.recv(4096):
            pass

    def count(self, seconds: float) -> tuple[float, float]:
        """Instructions until it is ready, and in a second at rest (without the kernel's)."""
        tool = ("valgrind", "--tool=callgrind", "--callgrind-out-file=counts", "--log-file=valgrind.log")
        with self.daemon(before=tool) as process:
            self.wait_ready()
            self._dump(process.pid)
            self.wait_log("base found")
            time.sleep(10.0)  # until the base is at rest
            self._dump(process.pid)
            time.sleep(seconds)
            self._dump(process.pid)
        parts = sorted(self.folder.glob("counts.*"), key=lambda path: int(path.suffix[1:]))
        start, _, rest = (float(re.findall(r"totals: (\d+)", path.read_text())[0]) for path in parts[:3])
        return start, rest / seconds

    def _dump(self, pid: int) -> None:
        subprocess.run(["callgrind_control", "--dump", str(pid)], check=True, capture_output=True, cwd=self.folder)

    def wait_log(self, words: str) -> None:
        """Until the daemon's log has these words."""
        begun = time.monotonic()
        while words not in (text := (self.folder / "log").read_text()):
            assert time.monotonic() < begun + START_S, text[-2000:]
            time.sleep(0.05)


def cpu_s(pid: int) -> float:
    """Processor time that a process has taken, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def switches(pid: int) -> int:
    """How often a process's threads have woken up."""
    total = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            total += int(re.findall(r"voluntary_ctxt_switches:\s+(\d+)", (task / "status").read_text())[0])
    return total


def memory_mb(pid: int) -> dict[str, float]:
    """Rss and Pss of a process now, MB."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return {name: int(re.findall(rf"^{name}:\s+(\d+)", text, re.M)[0]) * 1024 / 1e6 for name in ("Rss", "Pss")}


def film(folder: Path) -> None:
    """Footage of a shelf in which lamps flash: 640x480 for the rig, 320x240 for the floor; JPEG quality 60."""
    rng = np.random.default_rng(1)
    size = (SIZE[1], SIZE[0])
    scene = sum(cv2.GaussianBlur(rng.normal(0.0, s * 40.0, size), (0, 0), s) for s in (1.0, 4.0, 16.0))
    scene = 110.0 + 30.0 * scene / np.std(scene)
    rows, columns = np.mgrid[: size[0], : size[1]]
    places = rng.uniform((20.0, 20.0), (size[0] - 20.0, size[1] - 20.0), (LAMPS, 2))
    phases = rng.uniform(0.0, 1.0, LAMPS)
    spots = [80.0 * np.exp(-((rows - v) ** 2 + (columns - u) ** 2) / 3.4) for v, u in places]
    for name, shape in (("film", SIZE), ("floor_film", (320, 240))):
        (folder / name).mkdir()
        for k in range(round(FILM_S * FPS)):
            lit = [spot for spot, phase in zip(spots, phases, strict=True) if is_lit(k / FPS + phase)]
            image = np.clip(scene + sum(lit) + rng.normal(0.0, 2.0, size), 0, 255).astype(np.uint8)
            image = cv2.resize(image, shape, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / name / f"{k:04d}.jpg"), image, (cv2.IMWRITE_JPEG_QUALITY, 60))


def is_lit(t: float) -> bool:
    """Whether a label is lit at this time of its second."""
    return any(start <= t % 1.0 < end for start, end in FLASHES)


IDLER = """
import asyncio, json, os, sys
from robotd.clock import now, ticks
async def main():
    late, start = [], now()
    async for k in ticks(0.015):
        late.append(now() - start - k * 0.015)
        if k * 0.015 > float(sys.argv[1]):
            print(json.dumps(late))
            return
try:
    os.nice(-5)
except PermissionError:
    pass
asyncio.run(main())
"""


def measure(folder: Path, *, seconds: float) -> None:
    """Print the table."""
    film(folder)
    robot = Robot(folder)
    robot.configure(has_probe=False)
    with robot.surroundings():
        with robot.daemon():  # compiles what it imports
            robot.wait_ready()
        if shutil.which("callgrind_control") is not None:
            start, rest = robot.count(seconds)
            print(f"start to ready: {start / 1e9:.2f}e9 instructions, {start / PI_RATE:.2f} s of a Pi 3 (at most 3)")
            print(f"idle: {rest / 1e6:.1f}e6 instructions/s, {100 * rest / PI_RATE:.2f} % of a Pi 3's core (at most 3)")
        else:
            print("valgrind is not installed: no instructions are counted")
        with robot.daemon() as process:
            robot.wait_ready()
            print(f"start to ready: {cpu_s(process.pid):.2f} s here")
            robot.wait_log("base found")
            time.sleep(7.0)
            begun, woken = cpu_s(process.pid), switches(process.pid)
            time.sleep(seconds)
            idle, wakes = (cpu_s(process.pid) - begun) / seconds, (switches(process.pid) - woken) / seconds
            print(f"idle: {100 * idle:.2f} % of a core here, woken {wakes:.0f} times a second")
            idle_mb = memory_mb(process.pid)
    robot.configure(has_probe=True)
    with robot.surroundings(), robot.daemon("--mission") as process:
        robot.wait_ready()
        robot.wait_log("base found")
        time.sleep(5.0)  # the detectors' memory of some seconds fills
        since = time.monotonic()
        done = subprocess.run([sys.executable, "-c", IDLER, str(seconds)], capture_output=True, text=True, check=True)
        until = time.monotonic()
        busy_mb = memory_mb(process.pid)
    probed = np.array(json.loads((folder / "lateness.json").read_text()))
    late = probed[(probed[:, 0] > since) & (probed[:, 0] < until), 1]
    nothing = np.array(json.loads(done.stdout))
    print(f"memory idle: {idle_mb['Rss']:.0f} MB resident, {idle_mb['Pss']:.0f} MB its own share")
    print(
        f"memory searching four cameras: {busy_mb['Rss']:.0f} MB resident (at most 150), {busy_mb['Pss']:.0f} MB share"
    )
    for name, values in (("searching four cameras", late), ("a process that does nothing", nothing)):
        middle, most, worst = 1e3 * np.percentile(values, [50, 99, 100])
        print(f"lateness, {name}: median {middle:.2f}, p99 {most:.2f} (at most 5), worst {worst:.2f} ms")


def main() -> None:
    """Measure in a folder of its own."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.pi", description="The budget of a Raspberry Pi 3.")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement (default: 20)")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory(prefix="robotd-pi-") as folder:
        measure(Path(folder), seconds=seconds)


if __name__ == "__main__":
    main()
