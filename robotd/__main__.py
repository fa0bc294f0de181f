"""`robotd`: the daemon, the check of its configuration, and the simulated demonstration."""

from __future__ import annotations

import argparse
import asyncio
import logging
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
    demo.add_argument("--record", action="store_true", help="keep every frame and every serial byte (MCAP; large)")
    return top


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
        return run(arguments.config, mission=arguments.mission)
    except InputError as error:
        for problem in error.problems:
            print(f"robotd: {problem}", file=sys.stderr)
        return 2
    except RobotdError as error:
        print(f"robotd: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130


def _one_thread_each() -> None:
    """Keep numpy and OpenCV from starting threads of their own: the cameras' workers use all cores already."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    import cv2

    cv2.setNumThreads(1)


def check(path: Path) -> int:
    """Name every mistake of a configuration, a calibration or a layout; raises InputError with them."""
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
    from .daemon import assemble, read_config
    from .real import RealHardware

    config, _ = read_config(path)
    calibration = path.parent / config.robot.calibration
    if calibration.exists():
        assemble(path, RealHardware())
    print(f"{path}: no mistakes")
    if not calibration.exists():
        print(f"{path}: note: {calibration} does not exist yet; a mission needs the robot's calibration")
    return 0


def run(path: Path, *, mission: bool) -> int:
    """Run the daemon until SIGTERM or SIGINT, or until its mission has ended."""
    from .daemon import Daemon, assemble
    from .real import RealHardware

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    daemon = Daemon(assemble(path, RealHardware()))

    async def until_told() -> None:
        work = asyncio.ensure_future(daemon.run(mission=mission))
        for number in (signal.SIGTERM, signal.SIGINT):
            asyncio.get_running_loop().add_signal_handler(number, work.cancel)
        await asyncio.gather(work, return_exceptions=True)
        if not work.cancelled():
            work.result()

    asyncio.run(until_told())
    return 0 if not mission or daemon.map is not None else 1


if __name__ == "__main__":
    sys.exit(main())
