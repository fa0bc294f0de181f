"""The arguments of `robotd-solver calibrate roof` and `robotd-solver roof`; what they run is in roof_tool.

Apart from it, because a command line that only prints its help should not load OpenCV.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

CHECK_S = 12.0  # for which `roof check` looks


def add_calibrate_roof(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver calibrate roof`."""
    roof = kinds.add_parser(
        "roof",
        help="where a roof camera sees the plane of the robot's beacons, from measured points",
        description="POINTS.csv has a line for each point: u,v (px in the camera's picture), x,y (world metres), and if"
        " you like z (metres above the floor, default 0) and sigma (metres). Four points are the least; eight, spread"
        " over the floor, are better. Points at the beacons' height need nothing else. From points on the floor the"
        " camera itself is found, which needs its lens or its measured position.",
    )
    roof.add_argument("points", type=Path, metavar="POINTS.csv")
    roof.add_argument("--name", required=True, help="of the camera, as in roof.toml: [drivers.NAME]")
    roof.add_argument("--height", type=_height, required=True, metavar="M", help="of the beacons above the floor")
    size = roof.add_mutually_exclusive_group(required=True)
    size.add_argument("--size", type=_size, metavar="WxH", help="of the camera's picture, such as 1280x720")
    size.add_argument("--picture", type=Path, metavar="IMAGE", help="a picture of the camera, in which to draw, too")
    roof.add_argument("--lens", type=Path, metavar="FILE", help="calibration with the camera's lens: [[cameras]] NAME")
    roof.add_argument("--camera", type=_place, metavar="X,Y,Z", help="measured place of the camera in world metres")
    roof.add_argument("--camera-sigma", type=_sigma, default=0.02, metavar="M", help="how sure that is (default: 0.02)")
    roof.add_argument("--pick-sigma", type=_pixels, default=0.5, metavar="PX", help="of u, v (default: 0.5)")
    roof.add_argument("--calibration", type=Path, required=True, metavar="FILE", help="roof-calibration.toml to change")
    roof.add_argument("--residuals", type=Path, metavar="PNG", help="draw the points, their residuals and a floor grid")
    roof.add_argument("--json", action="store_true", help="print one JSON object")
    roof.set_defaults(run=_calibrate)


def add_roof(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver roof`."""
    kinds = commands.add_parser("roof", help="watch the robot through roof cameras").add_subparsers(
        dest="what", required=True, metavar="WHAT"
    )
    watch = kinds.add_parser("watch", help="until SIGTERM or Ctrl-C; `robotd-solver serve` on the same --data joins in")
    check = kinds.add_parser("check", help="name every mistake, look through each camera for some seconds, and report")
    for command in (watch, check):
        command.add_argument("-c", "--config", type=Path, required=True, metavar="roof.toml")
    check.add_argument("--seconds", type=_seconds, default=CHECK_S, metavar="S", help=f"default: {CHECK_S:g}")
    check.add_argument("--no-cameras", action="store_true", help="only the files")
    check.add_argument("--json", action="store_true", help="print one JSON object")
    watch.set_defaults(run=_watch)
    check.set_defaults(run=_check)


def _calibrate(arguments: argparse.Namespace) -> int:
    from .roof_tool import calibrate

    return calibrate(arguments)


def _watch(arguments: argparse.Namespace) -> int:
    from .roof_tool import run_watch

    return run_watch(arguments)


def _check(arguments: argparse.Namespace) -> int:
    from .roof_tool import run_check

    return run_check(arguments)


def _number(text: str, low: float, high: float, wanted: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected {wanted}")
    return value


def _height(text: str) -> float:
    return _number(text, 0.0, 3.0, "metres above the floor, 0 to 3, such as 0.65")


def _sigma(text: str) -> float:
    return _number(text, 1e-4, 1.0, "metres, 0.0001 to 1")


def _pixels(text: str) -> float:
    return _number(text, 0.01, 50.0, "pixels, 0.01 to 50")


def _seconds(text: str) -> float:
    return _number(text, 1.0, 3600.0, "seconds, 1 to 3600")


def _size(text: str) -> tuple[int, int]:
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 16 <= int(part) <= 16384 for part in parts):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(parts[0]), int(parts[1])


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not (math.isfinite(x) and math.isfinite(y) and 0.3 <= z <= 30.0):
        raise argparse.ArgumentTypeError(
            f"found {text!r}; expected X,Y,Z in metres, Z from 0.3 to 30, such as 1.2,3,2.8"
        )
    return x, y, z
