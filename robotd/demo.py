"""`robotd demo`: a whole survey in the simulator.

Three processes, as in a store: this one runs the daemon on a simulated world, `robotd-solver serve` stores the stops
and solves the map, `robotd-labels` writes flash requests into the folder that the simulated label system watches.
The daemon gets a configuration, a calibration and a `Hardware`, nothing else. When it has exited, the referee
(robotd.sim.referee) compares the map with the truth.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import re
import resource
import secrets
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TextIO
from urllib.parse import quote

from .bus import Bus
from .clock import now, run_virtual, ticks
from .config import RecordingConfig, save_calibration
from .daemon import Daemon, assemble
from .demo_roof import DemoRoof
from .errors import InputError, RobotdError
from .files import save_map, save_map_csv, save_survey, survey_from_json
from .records import LinePoints, Map, Survey
from .sim.hardware import SimHardware
from .sim.layout import StoreLayout
from .sim.referee import Referee
from .sim.roof import PINS, with_roof_cameras
from .sim.stores import find_store, load_store
from .sim.world import World, WorldSettings, load_settings
from .solver import solve
from .solver.evaluate import text_table
from .solver.line_world import line_in_world, runs, save_line_csv
from .solver.report import map_html, map_png

Trail = list[tuple[float, float]]

START_S = 30.0  # until a child process must be ready

CONFIG = """\
[robot]
name = "simulated"
state_directory = "."
calibration = "calibration.toml"

[mission]
survey = {survey}
stops = {stops}
labels = {labels}
known_labels = [{known}]

[upload]
url = {url}
token_file = "token"

[drivers.base]
driver = "roomba"
port = "/dev/robotd/base"

[drivers.front]
driver = "v4l2"
device = "/dev/robotd/front"

[drivers.left]
driver = "v4l2"
device = "/dev/robotd/left"

[drivers.rear]
driver = "v4l2"
device = "/dev/robotd/rear"

[drivers.right]
driver = "v4l2"
device = "/dev/robotd/right"

[drivers.floor]
driver = "v4l2"
device = "/dev/robotd/floor"

[drivers.follower]
driver = "line_follower"
camera = "floor"
line_width = {width}
color = {color}

[drivers.labels]
driver = "pricer"
host = "127.0.0.1"
port = {gateway_port}
token_file = "token"
"""

BEACONS = """
[drivers.beacons]
driver = "gpio_beacons"
front_pin = {front}
rear_pin = {rear}
"""


def demo(arguments: argparse.Namespace) -> int:
    """Run the survey that the command line asks for; returns 0 only if a map was made."""
    started = time.monotonic()
    logging.getLogger("robotd").addHandler(logging.NullHandler())  # because the progress display shows every event
    layout = load_store(find_store(arguments.store))
    settings = load_settings(arguments.world) if arguments.world is not None else WorldSettings()
    out: Path = arguments.out
    run = _fresh_folder(out / ".robotd")
    if arguments.roof:
        layout = with_roof_cameras(layout)
    world = World(layout, settings, arguments.seed, run / "labels")
    with ExitStack() as stack:
        token_file = run / "robot" / "token"
        token = _write_token(token_file)
        shared = ("--port", "0", "--token-file", token_file)
        gateway = stack.enter_context(_service("robotd.gateway", "--folder", run / "labels", *shared))
        server = stack.enter_context(_service("robotd.solver_main", "serve", "--data", run / "server", *shared))
        save_calibration(world.believed_calibration(), run / "robot" / "calibration.toml")
        path = _write_config(run / "robot", world, url=server, gateway_port=int(gateway.rsplit(":", 1)[1]))
        recorder = None
        if arguments.record:
            from .recording import FrameRecorder

            recorder = stack.enter_context(FrameRecorder(out / "recording.mcap", _room_for_recording(out)))
        daemon = Daemon(assemble(path, SimHardware(world, tap=recorder)))
        roof = DemoRoof(world, run / "roof", run / "server") if layout.roof_cameras else None
        trail: Trail = []
        line: list[LinePoints] = []
        mission_s = _run(daemon, world, trail, line, roof, realtime=arguments.realtime, progress=sys.stderr)
        survey = _download_survey(server, layout.name, token)
    if recorder is not None and recorder.is_full:
        sys.stderr.write(f"{recorder.path} is full: {recorder.refused} later frames and serial bytes are not in it\n")
    return _report(
        arguments, layout, world, daemon, survey, trail=trail, line=line, mission_s=mission_s, started=started
    )


def _fresh_folder(run: Path) -> Path:
    """What the three programs keep on disk, in a hidden folder that nobody else uses; that of the last run goes."""
    try:
        shutil.rmtree(run, ignore_errors=True)
        for folder in ("robot", "server", "labels"):
            (run / folder).mkdir(parents=True)
    except OSError as error:
        raise InputError(f"--out {run.parent}: cannot be written: {error.strerror}; name another folder") from error
    return run


def _room_for_recording(folder: Path) -> int:
    """Bytes that the demo's recording may take: [recording]'s limits, which leave room on the disk."""
    limits = RecordingConfig()
    state = os.statvfs(folder)
    spare = state.f_bavail * state.f_frsize - round(1e6 * limits.keep_free_mb)
    if spare <= 0:
        raise InputError(
            f"--record: {folder} is on a disk with {spare / 1e6 + limits.keep_free_mb:.0f} MB free, expected more than"
            f" {limits.keep_free_mb:.0f} MB; make room, or name another folder with --out"
        )
    return min(spare, round(1e6 * limits.limit_mb))


def _run(
    daemon: Daemon,
    world: World,
    trail: Trail,
    line: list[LinePoints],
    roof: DemoRoof | None,
    *,
    realtime: bool,
    progress: TextIO,
) -> float:
    """Run the daemon on the world until its mission has ended; returns seconds of mission on the loop's clock."""

    async def mission() -> float:
        async with asyncio.TaskGroup() as group:
            background = [
                group.create_task(world.run()),
                group.create_task(_show_progress(daemon.assembly.bus, progress)),
                group.create_task(_keep_trail(daemon.assembly.bus, trail)),
                group.create_task(_keep_line(daemon.assembly.bus, line)),
            ]
            begun = asyncio.get_running_loop().time()
            bus = daemon.assembly.bus
            async with AsyncExitStack() as stack:
                if roof is not None:
                    await stack.enter_async_context(roof.running(daemon.assembly.hardware, bus, bus))
                await daemon.run(mission=True)
                elapsed = asyncio.get_running_loop().time() - begun
            await asyncio.sleep(0.0)  # so that what closing published is taken too
            for task in background:
                task.cancel()
        return elapsed

    return asyncio.run(mission()) if realtime else run_virtual(mission())


async def _keep_trail(bus: Bus, trail: Trail) -> None:
    """Keep where odometry says the robot was, ten times a second, for the picture."""
    async for _ in ticks(0.1):
        state = bus.odometry.latest
        if state is not None and (not trail or trail[-1] != (state.pose.x, state.pose.y)):
            trail.append((state.pose.x, state.pose.y))


async def _keep_line(bus: Bus, line: list[LinePoints]) -> None:
    """Keep the line as the follower saw it, for the picture."""
    with bus.line_points.subscribe() as pieces:
        async for piece in pieces:
            line.append(piece)


async def _show_progress(bus: Bus, out: TextIO) -> None:
    """One line that is rewritten on a terminal; elsewhere one line per stop and event."""
    live = out.isatty()
    begun = time.monotonic()

    async def events() -> None:
        with bus.events.subscribe() as subscription:
            async for event in subscription:
                end = "\033[K\n" if live else "\n"
                out.write(f"{chr(13) if live else ''}{event.t:7.1f} s  {event.source}: {event.text}{end}")
                out.flush()

    async def status() -> None:
        async for _ in ticks(0.5):
            item = bus.status.latest
            if live and item is not None:
                filled = 30 * max(0, item.stop - 1) // max(1, item.stops)
                bar = "#" * filled + "." * (30 - filled)
                spent = f"mission {now():.0f} s, wall {time.monotonic() - begun:.0f} s"
                out.write(f"\r[{bar}] stop {item.stop}/{item.stops}  {item.state} {item.text}  {spent}\033[K")
                out.flush()

    try:
        async with asyncio.TaskGroup() as group:
            group.create_task(events())
            group.create_task(status())
    finally:
        if live:
            out.write("\r\033[K")


def _write_token(path: Path) -> str:
    token = secrets.token_hex(16)
    path.touch(mode=0o600)
    path.write_text(token + "\n")
    return token


def _write_config(folder: Path, world: World, *, url: str, gateway_port: int) -> Path:
    """The configuration that an owner would write for this store: ids, stops, the tape, what was measured by hand."""
    layout = world.layout
    known = [
        f"{{ label = {json.dumps(label.label)}, position = {list(label.position)}, sigma_m = {label.sigma_m} }}"
        for label in world.measured_labels()
    ]
    text = CONFIG.format(
        survey=json.dumps(layout.name),
        stops=json.dumps(list(layout.line.stops)),
        labels=json.dumps([label.id for label in layout.labels]),
        known=", ".join(known),
        url=json.dumps(url),
        width=layout.line.width,
        color=json.dumps(layout.line.color),
        gateway_port=gateway_port,
    )
    if layout.roof_cameras:
        text += BEACONS.format(**PINS)
    path = folder / "robotd.toml"
    path.write_text(text)
    return path


@contextmanager
def _service(module: str, *arguments: object) -> Iterator[str]:
    """Start a program of ours in its own process; yields the address that it prints when it is ready."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if "listening on " not in line:
                code = process.wait(START_S)
                raise RobotdError(f"{module} did not start (exit code {code}); its message is above")
            yield line.rsplit("listening on ", 1)[1].strip()
        finally:
            process.terminate()
            try:
                process.wait(START_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _peak_mb() -> float:
    """The largest resident memory that this process or one of its children ever had, in MiB.

    Our own comes from /proc, because getrusage also counts what our parent had when it started us.
    """
    own = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return max(int(own[1]) if own else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, children) / 1024


def _download_survey(server: str, name: str, token: str) -> Survey | None:
    request = urllib.request.Request(
        f"{server}/api/surveys/{quote(name, safe='')}", headers={"Authorization": f"Bearer {token}"}
    )
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return survey_from_json(answer.read(), "the server's survey")
    except OSError as error:
        print(f"robotd: the survey cannot be fetched: {error}", file=sys.stderr)
        return None


def _report(
    arguments: argparse.Namespace,
    layout: StoreLayout,
    world: World,
    daemon: Daemon,
    survey: Survey | None,
    *,
    trail: Trail,
    line: list[LinePoints],
    mission_s: float,
    started: float,
) -> int:
    out: Path = arguments.out
    solved = daemon.map
    if survey is None or solved is None:
        print("robotd: no map was made; the messages above say why", file=sys.stderr)
        return 1
    linear: Map = solve(survey, method="linear")
    referee = Referee(world)
    truth = referee.write_truth(out / "truth.csv")
    bundle_score, linear_score = referee.score(solved), referee.score(linear)
    cross_track = referee.cross_track_mm()
    save_survey(survey, out / "survey.json")
    save_map(solved, out / "map.json")
    save_map_csv(solved, out / "map.csv")
    outline = referee.outline()
    distances = [at - layout.line.stops[0] for at in layout.line.stops]
    on_floor = line_in_world(line, solved, survey, distances)
    save_line_csv(out / "line.csv", on_floor)
    pieces = runs(on_floor)
    map_png(out / "map.png", solved, survey=survey, truth=truth, outline=outline, trail=trail, line=pieces)
    map_html(out / "map.html", solved, survey=survey, truth=truth, outline3d=referee.outline3d(), line=pieces)
    wall_s = time.monotonic() - started
    peak_mb = _peak_mb()
    result = {
        "store": layout.name,
        "seed": arguments.seed,
        "labels_total": bundle_score.labels_total,
        "labels_placed": bundle_score.labels_placed,
        "error_mm": bundle_score.error_mm,
        "linear_labels_placed": linear_score.labels_placed,
        "linear_error_mm": linear_score.error_mm,
        "cross_track_mm": cross_track,
        "stops": len(survey.stops),
        "mission_s": round(mission_s, 1),
        "wall_s": round(wall_s, 1),
        "peak_mb": round(peak_mb, 1),
        "world": asdict(world.settings),
    }
    if arguments.json:
        print(json.dumps(result))
        return 0
    print(text_table([bundle_score, linear_score]))
    print(f"line: {cross_track['rms']:.1f} mm rms, {cross_track['max']:.1f} mm at most off the tape's centre")
    spent = f"wall {wall_s:.0f} s; peak memory {peak_mb:.0f} MB"
    print(f"mission {mission_s / 60:.1f} min (virtual), {len(survey.stops)} stops; {spent}")
    for label in solved.labels:
        if label.status not in ("placed", "known"):
            print(f"no position for {label.label}: {label.reason}")
    print(f"look at {out / 'map.png'} and {out / 'map.html'}")
    return 0
