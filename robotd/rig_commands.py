"""The arguments of `robotd-solver calibrate rig`, `odometry`, `beacons`, `time` and `flash`.

What they run is in rig_tool, time_tool and flash_tool: apart, because a command line that only prints its help should
not load scipy.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path


def add_calibrate_rig(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver calibrate rig`, `odometry` and `beacons`."""
    rig = kinds.add_parser(
        "rig",
        help="where the cameras and beacons are on the robot, from surveys with turns between stops",
        description="No two cameras need to see the same thing at the same time: what one saw another sees after a"
        " turn. Best are 20 stops as `robotctl calibrate rig` makes them: at each of five places 25 cm out and back."
        " Several surveys of one shop are calibrated together.",
    )
    _add_surveys(rig)
    rig.add_argument(
        "--each",
        type=_bounds,
        metavar="DEG,MM",
        help="how well each camera's place in the survey's rig is known (default: 10,50)",
    )
    rig.add_argument(
        "--whole",
        type=_bounds,
        metavar="DEG,MM",
        help="the same of the whole rig on the robot, as measured by tape (default: 0.5,3)",
    )
    rig.add_argument(
        "--sphere",
        type=_headings,
        metavar="NAME=DEG,...",
        help="start from which way each camera looks (0 ahead, 90 left) instead of from the survey's rig",
    )
    rig.add_argument("--radius", type=_metres, default=0.06, metavar="M", help="of --sphere (default: 0.06)")
    rig.add_argument("--height", type=_metres, default=0.5, metavar="M", help="of --sphere (default: 0.5)")
    rig.add_argument(
        "--roof-calibration", type=Path, metavar="FILE", help="gets the roof cameras' corrected homographies"
    )
    rig.add_argument("--picture", type=Path, metavar="PNG", help="also draw the residuals and the rig")
    rig.set_defaults(run=_run_rig)

    odometry = kinds.add_parser(
        "odometry",
        help="the wheels' scale and base, from surveys with known labels or roof cameras",
        description="Corrects [wheels] by how moves differ from what cameras saw; the rig stays within its priors. The"
        " surveys must have been driven with the [wheels] that the calibration file holds.",
    )
    _add_surveys(odometry)
    odometry.add_argument("--picture", type=Path, metavar="PNG", help="also draw what is left of every move")
    odometry.set_defaults(run=_run_odometry)

    beacons = kinds.add_parser(
        "beacons",
        help="where the beacons are on the robot, and how far apart, from surveys under roof cameras",
        description="Corrects [beacons] by where roof cameras saw them while the robot stood turned differently; the"
        " rig stays within its priors. Their heights stay as measured.",
    )
    _add_surveys(beacons)
    beacons.add_argument("--picture", type=Path, metavar="PNG", help="also draw the beacons and their residuals")
    beacons.set_defaults(run=_run_beacons)


def add_calibrate_time(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver calibrate time`."""
    parser = kinds.add_parser(
        "time",
        help="by how much cameras' stamps are late, from a robot that turned to and fro",
        description="FOLDER is what `robotctl calibrate time` made: its data.json names the recording.",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument(
        "--recording", type=Path, metavar="MCAP", help="if it is not where data.json says, or beside it"
    )
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="gets [stamp_offsets] (default: only report)")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also draw how views and wheels turned")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=_run_time)


def add_calibrate_flash(kinds: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver calibrate flash`."""
    parser = kinds.add_parser(
        "flash",
        help="how labels flash, from a recording of one that does",
        description="FOLDER is what `robotctl calibrate flash` made: its data.json names the recording. What comes out"
        " is a line for [mission.identify] of robotd.toml.",
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument(
        "--recording", type=Path, metavar="MCAP", help="if it is not where data.json says, or beside it"
    )
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="the camera's curve (default: gamma 2.2)")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="also draw the light over the period")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.set_defaults(run=_run_flash)


def _add_surveys(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("surveys", nargs="+", type=Path, metavar="SURVEY.json")
    parser.add_argument(
        "--known", type=Path, metavar="CSV", help="labels of known position: label,x,y,z[,sigma] in metres"
    )
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="gets the result; all else in it stays (default: only report)"
    )
    parser.add_argument("--report", type=Path, metavar="TXT", help="also write the report to a file")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def _run_rig(arguments: argparse.Namespace) -> int:
    from .rig_tool import run_rig

    return run_rig(arguments)


def _run_odometry(arguments: argparse.Namespace) -> int:
    from .rig_tool import run_odometry

    return run_odometry(arguments)


def _run_beacons(arguments: argparse.Namespace) -> int:
    from .rig_tool import run_beacons

    return run_beacons(arguments)


def _run_flash(arguments: argparse.Namespace) -> int:
    from .flash_tool import run

    return run(arguments)


def _run_time(arguments: argparse.Namespace) -> int:
    from .time_tool import run

    return run(arguments)


def _bounds(text: str) -> tuple[float, float]:
    """Radians and metres."""
    try:
        degrees, millimetres = (float(part) for part in text.split(","))
    except ValueError:
        degrees = millimetres = math.nan
    if not (0.0 < degrees <= 45.0 and 0.0 < millimetres <= 500.0):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected degrees and millimetres above 0, such as 10,50")
    return math.radians(degrees), 1e-3 * millimetres


def _headings(text: str) -> dict[str, float]:
    headings = {}
    for part in text.split(","):
        name, _, degrees = part.rpartition("=")
        try:
            headings[name] = math.radians(float(degrees))
        except ValueError:
            name = ""
        if not name or not math.isfinite(headings[name]):
            raise argparse.ArgumentTypeError(f"found {text!r}; expected NAME=DEGREES,..., such as front=0,left=90")
    return headings


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 3.0:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected metres from 0 to 3")
    return value
