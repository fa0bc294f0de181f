"""`robotd`: the daemon, the check of its configuration, calibration, and the simulated demonstration."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import math
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from . import __version__
from .errors import InputError, RobotdError

DEFAULT_CONFIG = Path("/etc/robotd/robotd.toml")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(
        prog="robotd", description="Map every electronic shelf label of a store with a small robot."
    )
    top.add_argument("--version", action="version", version=f"robotd {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run the daemon on the robot")
    run.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_CONFIG, help=f"configuration (default: {DEFAULT_CONFIG})"
    )
    run.add_argument("--mission", action="store_true", help="drive the configured mission at once, then exit")

    check = commands.add_parser("check", help="check a configuration or a store layout and name every mistake")
    check.add_argument(
        "-c",
        "--config",
        type=Path,
        default=DEFAULT_CONFIG,
        help="robotd.toml, calibration.toml or a robotd-store/1 file",
    )

    demo = commands.add_parser("demo", help="a whole survey in the simulator, from bytes and pixels to the map")
    demo.add_argument("--store", default="room", help="room, warehouse or a robotd-store/1 file (default: room)")
    demo.add_argument("--seed", type=_seed, default=1, help="seed of the world's noise (default: 1)")
    demo.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for the results (default: out/demo)")
    demo.add_argument("--world", type=Path, help="a TOML file whose [world] table changes the world's noise")
    demo.add_argument("--json", action="store_true", help="print the result as one JSON object")
    demo.add_argument("--realtime", action="store_true", help="run at wall speed instead of as fast as possible")
    demo.add_argument("--roof", action="store_true", help="with two roof cameras, in a store that has none of its own")
    demo.add_argument("--record", action="store_true", help="keep every frame and every serial byte (MCAP, up to 2 GB)")
    _add_doctor(commands)
    _add_sim(commands)
    _add_calibrate(commands)
    _add_line(commands)
    _add_record(commands)
    return top


def _add_doctor(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    doctor = commands.add_parser(
        "doctor", help="check all that a new owner gets wrong; each finding says how to mend it"
    )
    doctor.add_argument("-c", "--config", type=Path, default=DEFAULT_CONFIG, help=f"default: {DEFAULT_CONFIG}")
    doctor.add_argument("--socket", type=Path, metavar="PATH", help="of the running robotd (default: as configured)")
    doctor.add_argument("--quick", action="store_true", help="leave out running everything together for a minute")
    doctor.add_argument("--json", action="store_true", help="print the findings as one JSON object")
    config = commands.add_parser("config", help="the configuration's JSON schema").add_subparsers(
        dest="what", required=True, metavar="WHAT"
    )
    config.add_parser("schema", help="of robotd.toml, with the drivers that are installed")


def _add_sim(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    devices = commands.add_parser("sim", help="one simulated device in real time").add_subparsers(
        dest="device", required=True, metavar="DEVICE"
    )
    roomba = devices.add_parser("roomba", help="a simulated Roomba behind a pseudo-terminal, until SIGTERM or Ctrl-C")
    roomba.add_argument("--link", type=Path, metavar="PATH", help="symbolic link by which clients find its serial port")
    roomba.add_argument(
        "--quirk", action="append", default=[], metavar="NAME[=VALUE]", help="differ from the manual; see --list-quirks"
    )
    roomba.add_argument(
        "--fault", action="append", default=[], metavar="NAME=VALUE", help="fault of the line; see --list-quirks"
    )
    roomba.add_argument("--seed", type=_seed, default=1, help="seed of all noise (default: 1)")
    roomba.add_argument("--store", help="drive in this store instead of on an open floor: a name or a file")
    roomba.add_argument("--quiet", action="store_true", help="do not say what the robot does")
    roomba.add_argument("--list-quirks", action="store_true", help="list every quirk and fault, then exit")


def _add_calibrate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    calibrations = commands.add_parser("calibrate", help="measure the robot").add_subparsers(
        dest="what", required=True, metavar="WHAT"
    )
    odometry = calibrations.add_parser(
        "odometry", help="wheels and base: drive and turn, and measure on the floor how far it really was"
    )
    odometry.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_CONFIG, help=f"configuration (default: {DEFAULT_CONFIG})"
    )
    odometry.add_argument("--distance", type=float, help="metres of each straight (default: 2)")
    odometry.add_argument("--turns", type=int, help="turns of each spin (default: 5)")
    odometry.add_argument("--repeat", type=int, help="how often each kind of run (default: 2)")
    odometry.add_argument("--yes", action="store_true", help="do not wait for Enter before a run")
    odometry.add_argument(
        "--answers",
        type=Path,
        metavar="FILE",
        help="read what was measured from a file or a pipe, a number a line, '#' starts a comment; implies --yes",
    )


def _add_line(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    line = commands.add_parser(
        "line",
        help="show what the line detector sees in images, videos or a camera",
        description="Show what the line detector sees: a sheet of pictures for each image, from gradient to lines.",
    )
    line.add_argument(
        "sources", nargs="+", metavar="IMAGE|VIDEO|CAMERA", help="files, or a camera: /dev/video0, or its number"
    )
    line.add_argument(
        "--width-px",
        type=_width_range,
        metavar="MIN,MAX",
        help="the line's width in pixels (default: any; slower, less sure)",
    )
    line.add_argument(
        "--color",
        choices=("dark", "bright", "both"),
        default="both",
        help="of the line against the floor; default: both",
    )
    line.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help="look at the top view through its [floor_camera]; widths are its",
    )
    line.add_argument("--frames", type=_count, default=8, metavar="N", help="of a video or a camera (default: 8)")
    line.add_argument("--out", type=Path, default=Path("out/line"), metavar="DIR", help="default: out/line")
    line.add_argument(
        "--separate", action="store_true", help="also write each stage of each search as a picture of its own"
    )
    line.add_argument(
        "--compare", action="store_true", help="a second sheet: what thresholds, Canny + Hough and LSD find"
    )
    line.add_argument("--json", action="store_true", help="print the lines as one JSON object")


def _add_record(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    record = commands.add_parser(
        "record",
        help="record cameras without a mission, while the daemon does not run",
        description="Record cameras of the configuration to one MCAP file, until Ctrl-C or a limit is reached.",
    )
    record.add_argument(
        "cameras", nargs="*", metavar="CAMERA", help="sections of camera drivers (default: all of the configuration)"
    )
    record.add_argument(
        "-c", "--config", type=Path, default=DEFAULT_CONFIG, help=f"configuration (default: {DEFAULT_CONFIG})"
    )
    record.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.mcap", help="is overwritten")
    record.add_argument("--seconds", type=_positive, metavar="S", help="longest (default: of the configuration)")
    record.add_argument("--limit-mb", type=_positive, metavar="MB", help="largest (default: of the configuration)")
    record.add_argument("--raw", action="store_true", help="keep grey levels instead of the camera's own JPEG")
    record.add_argument("--json", action="store_true", help="print what was recorded as one JSON object")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a number above 0")
    return value


def _width_range(text: str) -> tuple[float, float]:
    parts = text.split(",")
    try:
        least, greatest = (float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected two numbers such as 12,30") from None
    if not (math.isfinite(greatest) and 1.0 <= least <= greatest):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected 1 <= MIN <= MAX")
    return least, greatest


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a whole number of 1 or more")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a whole number of 0 or more")
    return int(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 1 failed, 2 wrong input."""
    arguments = parser().parse_args(argv)
    _one_thread_each()
    try:
        if arguments.command == "check":
            return check(arguments.config)
        if arguments.command == "demo":
            from .demo import demo

            return demo(arguments)
        if arguments.command == "sim":
            from .sim.terminal import run as be_roomba

            return be_roomba(arguments)
        if arguments.command == "doctor":
            from .doctor import run as examine

            return examine(arguments)
        if arguments.command == "config":
            return show_schema()
        if arguments.command == "calibrate":
            from .calibrate import run_command

            return run_command(arguments)
        if arguments.command == "line":
            from .line_tool import run as show_lines

            return show_lines(arguments)
        if arguments.command == "record":
            from .record_tool import run as record

            return record(arguments)
        return run(arguments.config, mission=arguments.mission)
    except InputError as error:
        for problem in error.problems:
            print(f"robotd: {problem}", file=sys.stderr)
        return 2
    except RobotdError as error:
        print(f"robotd: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # whoever read our output has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except KeyboardInterrupt:
        return 130


def _one_thread_each() -> None:
    """Keep numpy and OpenCV from starting threads of their own: the cameras' workers use all cores already."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    import cv2

    cv2.setNumThreads(1)


def show_schema() -> int:
    """Print the configuration's JSON schema."""
    from .config_views import schema

    print(json.dumps(schema(), indent=2))
    return 0


def check(path: Path) -> int:
    """Name every mistake of a configuration, a calibration or a layout; raises InputError with them."""
    from .startup import kept

    with kept():
        return _check(path)


def _check(path: Path) -> int:
    from .config import load_calibration, read_toml

    data = read_toml(path)
    if "format" in data:
        from .sim.stores import load_store

        layout = load_store(path)
        print(f"{path}: a store of {len(layout.labels)} labels and {len(layout.line.stops)} stops, no mistakes")
        return 0
    if data.keys() & {"wheels", "cameras", "floor_camera", "priors"} and "drivers" not in data:
        load_calibration(path)
        print(f"{path}: a calibration without mistakes")
        return 0
    from . import operations, prompt  # noqa: F401  because the code that they generate is left for `run`, too
    from .daemon import assemble, read_config
    from .real import RealHardware

    config, _ = read_config(path)
    calibration = path.parent / config.robot.calibration
    assemble(path, RealHardware())
    print(f"{path}: no mistakes")
    if not calibration.exists():
        print(f"{path}: note: {calibration} does not exist yet; a mission needs the robot's calibration")
    return 0


def run(path: Path, *, mission: bool) -> int:
    """Run the daemon until SIGTERM or SIGINT, or until its mission has ended."""
    from .notify import notify
    from .startup import keep_memory_together, loading

    keep_memory_together()
    with loading():
        from .control_socket import ControlSocket
        from .daemon import Daemon, assemble
        from .operations import Operations
        from .prompt import converse
        from .real import RealHardware
        from .service import log_handler

        logging.basicConfig(level=logging.INFO, handlers=[log_handler()])
        hardware = RealHardware()
        assembly = assemble(path, hardware)
        hardware.guardian = path.parent / assembly.config.robot.guardian
        daemon = Daemon(assembly)

    async def until_told() -> None:
        control = ControlSocket(path.parent / assembly.config.robot.control, Operations(daemon))
        work = asyncio.ensure_future(daemon.run(mission=mission, control=control))
        talk = None
        if sys.stdin is not None and sys.stdin.isatty():
            talk = asyncio.ensure_future(converse(assembly.bus, sys.stdin.fileno(), print))

        def stop() -> None:
            notify("STOPPING=1\nSTATUS=stopping")
            work.cancel()

        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, stop)
        await asyncio.gather(work, return_exceptions=True)
        if talk is not None:
            talk.cancel()
            await asyncio.gather(talk, return_exceptions=True)
        if not work.cancelled():
            work.result()

    asyncio.run(until_told())
    return 0 if not mission or daemon.map is not None else 1


if __name__ == "__main__":
    sys.exit(main())
