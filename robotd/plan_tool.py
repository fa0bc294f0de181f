"""`robotd-solver plan`: where to stop next, and which labels to ask there."""

from __future__ import annotations

import argparse
import csv
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from .records import Floats


def add_plan(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The arguments of `robotd-solver plan`."""
    plan = commands.add_parser(
        "plan",
        help="where to stop next, and which labels to ask there",
        description="Weighs what every possible next stop would take off the labels' uncertainty against the time that"
        " it takes. Copy the plan to the robot and name it in robotd.toml: [mission] plan.",
    )
    plan.add_argument("survey", type=Path, metavar="SURVEY.json", help="the stops so far")
    way = plan.add_mutually_exclusive_group()
    way.add_argument(
        "--line",
        type=Path,
        metavar="CSV",
        help="the line on the floor: x,y in world metres, in the order driven; default: from stop to stop once more",
    )
    way.add_argument("--free", action="store_true", help="over free floor around the stops, instead of along a line")
    plan.add_argument(
        "--again", action="store_true", help="plan all of the line in a new leg, not what is ahead of the last stop"
    )
    plan.add_argument("--stops", type=int, default=30, metavar="N", help="most stops to plan (default: 30)")
    plan.add_argument("--target", type=float, default=0.0, metavar="MM", help="standard deviation that is good enough")
    plan.add_argument("--stop-seconds", type=float, default=15.0, metavar="S", help="time a stop takes (default: 15)")
    plan.add_argument(
        "--flash-seconds", type=float, default=0.5, metavar="S", help="and every label asked there (default: 0.5)"
    )
    plan.add_argument(
        "--least",
        type=float,
        default=0.4,
        metavar="PERCENT",
        help="how much a stop must take off the labels' uncertainty to be worth making (default: 0.4)",
    )
    plan.add_argument("-o", "--output", type=Path, metavar="PLAN.json", help="default: stdout")
    plan.add_argument("--png", type=Path, metavar="PNG", help="also draw what each place would teach")
    plan.set_defaults(run=_plan)


def _plan(arguments: argparse.Namespace) -> int:
    from .files import load_survey, plan_to_json, save_plan
    from .solver.plan_picture import draw_plan, plan_table
    from .solver.planning import PlanSettings, plan
    from .survey_checks import Problems, check_units

    survey = load_survey(arguments.survey)
    problems = Problems(str(arguments.survey))
    check_units(survey, problems)
    problems.raise_if_any()
    for name in ("stops", "stop_seconds", "flash_seconds"):
        value = getattr(arguments, name)
        if not 0 < value < math.inf:
            raise InputError(f"--{name.replace('_', '-')}: found {value:g}; expected above 0")
    if not 0.0 <= arguments.target < math.inf:
        raise InputError(f"--target: found {arguments.target:g}; expected millimetres, 0 or more")
    if not 0.0 < arguments.least < 100.0:
        raise InputError(f"--least: found {arguments.least:g}; expected percent, between 0 and 100")
    settings = PlanSettings(
        most_stops=arguments.stops,
        stop_s=arguments.stop_seconds,
        flash_s=arguments.flash_seconds,
        target_m=1e-3 * arguments.target,
        least=1e-2 * arguments.least,
    )
    line = load_line(arguments.line) if arguments.line is not None else None
    study = plan(survey, line, free=arguments.free, again=arguments.again, settings=settings)
    if arguments.output is None:
        sys.stdout.write(plan_to_json(study.plan).decode())
        sys.stdout.flush()
    else:
        save_plan(study.plan, arguments.output)
    if arguments.png is not None:
        draw_plan(arguments.png, study)
    print(plan_table(study), file=sys.stderr)
    return 0


def load_line(path: Path) -> Floats:
    """Read the points (N, 2) of a line: header x,y, then metres; raises InputError that names every wrong row."""
    import numpy as np

    from .files import read_bytes

    try:
        rows = list(csv.reader(read_bytes(path).decode("utf-8-sig").splitlines()))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 at byte {error.start}; save the table as UTF-8") from error
    except csv.Error as error:
        raise InputError(f"{path}: not a table: {error}; expected the header x,y and two numbers a line") from error
    if not rows or [cell.strip() for cell in rows[0]] != ["x", "y"]:
        raise InputError(
            f"{path} line 1: found {','.join(rows[0])[:40]!r}; expected the header x,y"
            if rows
            else f"{path} line 1: found nothing; expected the header x,y"
        )
    points, problems = [], []
    for number, row in enumerate(rows[1:], start=2):
        try:
            x, y = (float(cell) for cell in row)
            points.append((x, y))
            good = abs(x) < 1e4 and abs(y) < 1e4
        except ValueError:
            good = False
        if row and not good:
            problems.append(f"{path} line {number}: found {','.join(row)[:40]!r}; expected x,y in metres")
    if not problems and (len(points) < 2 or float(np.ptp(points, axis=0).max()) < 0.05):
        problems.append(f"{path}: found {len(points)} points within 5 cm; expected two or more along the line")
    if problems:
        raise InputError(*problems)
    return np.array(points)
