"""`robotd-solver`: solve and judge surveys in files, calibrate cameras, and serve robots.

Exit codes: 0 done, 1 it could not be done, 2 the command or a file is wrong.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from . import workbench_tool
from .errors import InputError, RobotdError
from .lens_commands import add_calibrate_camera, metres
from .plan_tool import add_plan
from .rig_commands import add_calibrate_flash, add_calibrate_rig, add_calibrate_time
from .roof_commands import add_calibrate_roof, add_roof

if TYPE_CHECKING:
    from .records import Map, Survey

PORT = 8470
ALIGNMENTS = ("none", "se2", "se3")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):  # read when numpy loads; its matrices here are small
        os.environ.setdefault(name, "1")
    try:
        code: int = arguments.run(arguments)
    except InputError as error:
        return _complain(error.problems, 2)
    except RobotdError as error:
        return _complain([str(error)], 1)
    except BrokenPipeError:  # the reader of the output has seen enough
        sys.stderr.close()
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def _complain(problems: Sequence[str], code: int) -> int:
    for problem in problems:
        print(f"robotd-solver: {problem}", file=sys.stderr)
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="robotd-solver", description="Make maps of labels from surveys.")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    solve = commands.add_parser("solve", help="make a map from a survey")
    solve.add_argument("survey", type=Path, metavar="SURVEY.json")
    solve.add_argument("-o", "--output", type=Path, metavar="MAP.json", help="where the map goes (default: to stdout)")
    solve.add_argument("--method", choices=("bundle", "linear"), default="bundle", help="default: bundle")
    solve.add_argument(
        "--known", type=Path, metavar="CSV", help="labels of known position: label,x,y,z[,sigma] in metres"
    )
    for kind, text in (("csv", "a table"), ("png", "a picture from above"), ("html", "a page to turn around in")):
        solve.add_argument(f"--{kind}", type=Path, metavar="PATH", help=f"also write {text}")
    solve.add_argument(
        "--report",
        type=Path,
        metavar="TXT",
        help="also write what is observable, how sensors scatter, what is doubtful",
    )
    solve.set_defaults(run=_solve)

    evaluate = commands.add_parser("evaluate", help="compare maps with the truth")
    evaluate.add_argument("maps", nargs="+", type=Path, metavar="MAP.json")
    evaluate.add_argument("--truth", type=Path, metavar="CSV", required=True, help="label,x,y,z in metres")
    evaluate.add_argument(
        "--align",
        choices=ALIGNMENTS,
        default="none",
        help="move the map onto the truth first, in the plane or in space",
    )
    evaluate.add_argument("--json", action="store_true", help="print one JSON object; of several maps a list")
    evaluate.set_defaults(run=_evaluate)

    check = commands.add_parser("check", help="name every mistake in a survey")
    check.add_argument("survey", type=Path, metavar="SURVEY.json")
    check.set_defaults(run=_check)

    serve = commands.add_parser("serve", help="take stops from robots and solve them")
    serve.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    serve.add_argument("--port", type=_port, default=PORT, help=f"default: {PORT}; 0 takes a free one")
    serve.add_argument(
        "--data", type=Path, metavar="DIR", default=Path("/var/lib/robotd-solver"), help="where surveys are kept"
    )
    serve.add_argument("--token-file", type=Path, metavar="FILE", help="the secret that robots must send")
    serve.add_argument(
        "--recording-limit-gb", type=float, default=16.0, metavar="GB", help="largest recording (default: 16)"
    )
    serve.add_argument(
        "--certificate", type=Path, nargs=2, metavar=("CERT", "KEY"), help="serve https: certificate and its key (PEM)"
    )
    serve.set_defaults(run=_serve)
    _add_calibrate(commands)
    workbench_tool.add(commands)
    add_roof(commands)
    add_plan(commands)
    return parser


def _add_calibrate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    kinds = commands.add_parser("calibrate", help="compute a calibration from pictures or surveys").add_subparsers(
        dest="what", required=True, metavar="WHAT"
    )
    floor = kinds.add_parser(
        "floor",
        help="where the floor camera sits and looks, from chessboards on the floor",
        description="Lay a chessboard flat on the floor in view of the floor camera, once or more often, and measure"
        " where its middle lies at least once. The first --at belongs to the first IMAGE, and so on.",
    )
    floor.add_argument("images", nargs="+", type=Path, metavar="IMAGE", help="pictures with the board on the floor")
    floor.add_argument("--board", type=_board, required=True, metavar="COLSxROWS", help="inner corners, such as 9x6")
    floor.add_argument("--square", type=metres, required=True, metavar="M", help="side of a square in metres")
    floor.add_argument(
        "--at",
        action="append",
        type=_place,
        required=True,
        metavar="X,Y,DEGREES",
        help="middle of the board's inner corners from the robot's centre in metres, x ahead, y to the left; and where"
        " its long side points: 0 along x, 90 along y",
    )
    floor.add_argument("--at-sigma", type=metres, default=0.003, metavar="M", help="how sure --at is (default: 0.003)")
    floor.add_argument(
        "--held",
        nargs="+",
        type=Path,
        default=[],
        metavar="IMAGE",
        help="pictures of the board held at many tilts: the lens",
    )
    floor.add_argument(
        "--calibration",
        type=Path,
        required=True,
        metavar="FILE",
        help="gets [floor_camera]; the lens in it is used unless --held is given; all else in it stays",
    )
    floor.add_argument("--picture", type=Path, metavar="PNG", help="also draw the corners' residuals and the top view")
    floor.add_argument("--json", action="store_true", help="print one JSON object")
    floor.set_defaults(run=_calibrate_floor)
    add_calibrate_camera(kinds)
    add_calibrate_rig(kinds)
    add_calibrate_roof(kinds)
    add_calibrate_time(kinds)
    add_calibrate_flash(kinds)


def _board(text: str) -> tuple[int, int]:
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdecimal() and 3 <= int(part) <= 50 for part in parts):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected inner corners as COLUMNSxROWS, such as 9x6")
    columns, rows = sorted((int(part) for part in parts), reverse=True)
    if columns == rows:
        raise argparse.ArgumentTypeError(f"found {text!r}; a square board looks the same all four ways round")
    return columns, rows


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, degrees = (float(part) for part in text.split(","))
    except ValueError:
        x = y = degrees = math.nan
    if not (math.hypot(x, y) < 10.0 and abs(degrees) <= 360.0):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected X,Y,DEGREES in metres, such as 0.55,0,90")
    return x, y, math.radians(degrees)


def _calibrate_floor(arguments: argparse.Namespace) -> int:
    from .floor_tool import run

    return run(arguments)


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a number from 0 to 65535")
    return int(text)


def _solve(arguments: argparse.Namespace) -> int:
    from .files import load_survey, map_to_json, save_map, save_map_csv
    from .solver import solve

    survey = load_survey(arguments.survey)
    if arguments.known is not None:
        survey = _with_known(survey, arguments.known)
    _check_units(survey, arguments.survey)
    if arguments.report is not None:
        from .files import write_atomic
        from .solver.analysis import analyse, analysis_text

        if arguments.method != "bundle":
            raise InputError("--report judges a bundle adjustment; leave out --method linear")
        result, analysis = analyse(survey)
        write_atomic(arguments.report, analysis_text(analysis).encode())
    else:
        result = solve(survey, method=arguments.method)
    if arguments.output is None:
        sys.stdout.write(map_to_json(result).decode())
        sys.stdout.flush()
    else:
        save_map(result, arguments.output)
    if arguments.csv is not None:
        save_map_csv(result, arguments.csv)
    if arguments.png is not None or arguments.html is not None:
        _draw(arguments, result, survey)
    _summarise(result)
    return 0


def _check_units(survey: Survey, path: Path) -> None:
    from .survey_checks import Problems, check_units

    problems = Problems(str(path))
    check_units(survey, problems)
    problems.raise_if_any()


def _with_known(survey: Survey, path: Path) -> Survey:
    """The survey with the known labels of a table; they replace those of the same name in the survey."""
    from .files import check_survey, load_points
    from .records import KnownLabel

    known = {label.label: label for label in survey.known_labels}
    for label, (position, sigma) in load_points(path).items():
        known[label] = KnownLabel(label, position) if sigma is None else KnownLabel(label, position, sigma)
    joined = dataclasses.replace(survey, known_labels=tuple(known.values()))
    check_survey(joined, str(path))
    return joined


def _draw(arguments: argparse.Namespace, result: Map, survey: Survey) -> None:
    from .solver.report import map_html, map_png

    if arguments.png is not None:
        map_png(arguments.png, result, survey=survey)
    if arguments.html is not None:
        map_html(arguments.html, result, survey=survey)


def _summarise(result: Map) -> None:
    """Say on stderr what was made, because stdout may carry the map."""
    counts = Counter(label.status for label in result.labels)
    states = ", ".join(
        f"{counts[name]} {name}" for name in ("placed", "known", "ambiguous", "unplaced") if counts[name]
    )
    end = "converged" if result.solver.converged else "did not converge"
    print(
        f"{result.survey}: {len(result.labels)} labels ({states or 'none seen'}), {len(result.stops)} stops, "
        f"{result.rms_px:.2g} px rms, {end} after {result.solver.iterations} iterations",
        file=sys.stderr,
    )
    for label in result.labels:
        if label.status in ("ambiguous", "unplaced"):
            print(f"no position for {label.label}: {label.reason or label.status}", file=sys.stderr)
    for note in result.notes:
        print(f"note: {note}", file=sys.stderr)


def _evaluate(arguments: argparse.Namespace) -> int:
    from .config import collect
    from .files import load_points
    from .solver import evaluate
    from .solver.evaluate import text_table

    problems: list[str] = []
    results = [collect(problems, partial(_load_positions, path)) for path in arguments.maps]
    points = collect(problems, lambda: load_points(arguments.truth))
    if problems or points is None:
        raise InputError(*problems)
    truth = {label: position for label, (position, _) in points.items()}
    evaluations = [evaluate(result, truth, align=arguments.align) for result in results if result is not None]
    if arguments.json:
        rows = [
            {
                "labels_total": one.labels_total,
                "labels_placed": one.labels_placed,
                "labels_within_95": one.labels_within,
                "error_mm": one.error_mm,
                "known_points": one.known_points,
                "localisation": one.localisation,
                "method": one.method,
            }
            for one in evaluations
        ]
        print(json.dumps(rows[0] if len(rows) == 1 else rows))
    else:
        print(text_table(evaluations))
    return 0


def _load_positions(path: Path) -> Map:
    """A map whose positions can be computed with."""
    from .files import load_map
    from .survey_checks import Problems, check_positions

    result = load_map(path)
    problems = Problems(str(path))
    check_positions(result, problems)
    problems.raise_if_any()
    return result


def _check(arguments: argparse.Namespace) -> int:
    from .files import load_survey
    from .solver.analysis import observability

    survey = load_survey(arguments.survey)
    _check_units(survey, arguments.survey)
    labels = {sighting.label for stop in survey.stops for sighting in stop.sightings}
    sightings = sum(len(stop.sightings) for stop in survey.stops)
    print(f"{arguments.survey}: no mistake; {len(survey.stops)} stops, {len(labels)} labels, {sightings} sightings")
    for text in observability(survey) if survey.stops else ():
        print(text)
    return 0


def _serve(arguments: argparse.Namespace) -> int:
    token = _read_token(arguments.token_file) if arguments.token_file is not None else None
    try:
        from .server.app import serve
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in ("fastapi", "uvicorn", "starlette", "pydantic"):
            raise
        raise RobotdError(f"serving needs {error.name}, which is not installed; install robotd[solver]") from error
    limit = round(1e9 * arguments.recording_limit_gb)
    pair = None if arguments.certificate is None else tuple(arguments.certificate)
    serve(arguments.host, arguments.port, arguments.data, token, recording_limit=limit, certificate=pair)
    return 0


def _read_token(path: Path) -> str:
    from .files import read_bytes

    try:
        token = read_bytes(path).decode("ascii").strip()
    except UnicodeDecodeError:
        token = ""
    if not token or any(not character.isprintable() or character.isspace() for character in token):
        raise InputError(f"{path}: expected one line of ASCII letters and digits, the secret that robots send")
    return token


if __name__ == "__main__":
    raise SystemExit(main())
