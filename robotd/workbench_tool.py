"""`robotd-solver workbench`: play, tag, run, show, score, tune and export footage, on files, without robot or browser.

Every command prints one JSON object with --json. This module defines the command line; `workbench_commands` does the
work, and is loaded only then.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

Parser = argparse.ArgumentParser


def add(commands: argparse._SubParsersAction[Parser]) -> None:
    """Add `workbench` and its commands to a command line."""
    footage = (
        "FOOTAGE is a recording (.mcap), a folder of images or a video; marks lie beside it, in"
        " FOOTAGE.tags.toml. Times are seconds after the first frame."
    )
    bench = commands.add_parser(
        "workbench",
        help="footage of flashing labels: play, tag, run detectors, show, score, tune, export",
        description=footage,
    )
    parts = bench.add_subparsers(dest="what", required=True, metavar="COMMAND")

    def command(name: str, help_: str, several: bool = False) -> Parser:
        parser = parts.add_parser(name, help=help_, description=f"{help_.capitalize()}. {footage}")
        if several:
            parser.add_argument("footage", nargs="+", type=Path, metavar="FOOTAGE")
        else:
            parser.add_argument("footage", type=Path, metavar="FOOTAGE")
        parser.add_argument("--json", action="store_true", help="print one JSON object")
        parser.set_defaults(run=_run)
        return parser

    info = command("info", "what is in it", several=True)
    _footage(info, several=True)

    play = command("play", "in real time or frame by frame")
    _footage(play)
    _span(play)
    _detector(play, optional=True)
    play.add_argument("--speed", type=_positive, default=1.0, help="times real time (default: 1)")
    play.add_argument(
        "--step", action="store_true", help="wait before each frame: Enter: next, b: back, NUMBER: that frame, q: end"
    )
    play.add_argument("--view", type=Path, metavar="PNG", help="keep the present frame in this picture")
    play.add_argument(
        "--video", type=Path, metavar="AVI", help="write all frames with marks and findings, for a player"
    )

    tag = command("tag", "mark the true lights")
    _footage(tag)
    tag.add_argument("--add", action="append", default=[], type=_place, metavar="U,V", help="a mark at these pixels")
    tag.add_argument("--kind", choices=("label", "reflection", "ignore"), default="label", help="of what is added")
    tag.add_argument("--label", metavar="ID", help="of what is added")
    tag.add_argument("--since", type=_seconds, default=0.0, metavar="S", help="it holds from then")
    tag.add_argument("--until", type=_seconds, metavar="S", help="and until then")
    tag.add_argument("--radius", type=_positive, metavar="PX", help="findings within it belong to it (default: 2.5)")
    tag.add_argument("--remove", type=_numbers, default=[], metavar="N,N", help="marks by their numbers")
    tag.add_argument("--propose", action="store_true", help="what a detector finds that is not marked, numbered")
    tag.add_argument("--accept", type=_numbers, default=[], metavar="N,N", help="mark these proposals")
    tag.add_argument("--accept-all", action="store_true", help="mark every proposal, to be looked at afterwards")
    tag.add_argument("--picture", type=Path, metavar="PNG", help="draw the marks, over the mean of the frames")
    _detector(tag)

    run = command("run", "what a detector finds, and when", several=True)
    _footage(run, several=True)
    _span(run)
    _detector(run)
    run.add_argument("--picture", type=Path, metavar="PNG", help="draw marks and findings (of one footage)")

    show = command("show", "how a detector reacts to a frame, and the course of a place")
    _footage(show)
    _detector(show)
    when = show.add_mutually_exclusive_group()
    when.add_argument("--at", type=_seconds, metavar="S", help="the last frame until then (default: of all)")
    when.add_argument("--frame", type=_count, metavar="N", help="the frame of this number, from 0")
    show.add_argument("--since", type=_seconds, default=0.0, metavar="S", help="the detector begins then")
    show.add_argument("--place", type=_place, metavar="U,V", help="also the course of this place")
    show.add_argument("--mark", type=_count, metavar="N", help="also the course of the mark of this number")
    show.add_argument("--window", type=_positive, default=4.0, metavar="S", help="of the course (default: 4)")
    show.add_argument("-o", "--output", type=Path, required=True, metavar="PNG")

    compare = command("compare", "what a detector measures at marked labels and elsewhere", several=True)
    _footage(compare, several=True)
    _span(compare)
    _detector(compare)
    compare.add_argument("--picture", type=Path, metavar="PNG", help="draw the distributions")

    score = command("score", "recall, precision and centroid spread over tagged footage", several=True)
    _footage(score, several=True)
    _span(score)
    _detector(score)
    _clips(score)
    score.add_argument(
        "--after", type=_positive, nargs="*", default=[], metavar="S", help="also after so much of a clip"
    )

    tune = command("tune", "search settings on this footage, judge them on another", several=True)
    _footage(tune, several=True)
    _detector(tune)
    _clips(tune)
    tune.add_argument(
        "--param", action="append", required=True, metavar="NAME=LOW:HIGH[:log]|A,B,C", help="what to search"
    )
    tune.add_argument(
        "--report",
        nargs="+",
        type=Path,
        default=[],
        metavar="FOOTAGE",
        help="other footage, which tells how good it is",
    )
    tune.add_argument("--trials", type=_count, default=30, metavar="N", help="default: 30")
    tune.add_argument("--seed", type=_count, default=0)
    tune.add_argument(
        "--min-precision", type=_share, metavar="P", help="best recall with at least this precision (default: best F1)"
    )
    tune.add_argument("-o", "--output", type=Path, metavar="TOML", help="write the settings found")

    export = command("export", "frames as JPEG or PNG (calibration), or as a recording")
    _footage(export)
    _span(export)
    export.add_argument("-o", "--output", type=Path, required=True, metavar="DIR|FILE.mcap")
    export.add_argument("--format", choices=("jpg", "png"), default="jpg", help="JPEGs of a recording stay as they are")
    export.add_argument("--every", type=_count, default=1, metavar="N", help="every N-th frame (default: 1)")
    export.add_argument("--sharp", type=_count, metavar="N", help="the N sharpest frames, apart in time")

    recover = command("recover", "make a whole recording of one that was cut off")
    recover.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.mcap")


def _footage(parser: Parser, several: bool = False) -> None:
    every = " (default: each)" if several else ", if it has several"
    parser.add_argument("--camera", metavar="NAME", help=f"which of a recording's{every}")
    parser.add_argument("--fps", type=_positive, help="frames a second, instead of the times of a video or a folder")
    parser.add_argument("--times", type=Path, metavar="CSV", help="file name and seconds of a folder's images")
    parser.add_argument("--channel", choices=("gray", "red"), default="gray", help="of colour images (default: gray)")


def _span(parser: Parser) -> None:
    parser.add_argument("--from", dest="since", type=_seconds, default=0.0, metavar="S", help="begin then")
    parser.add_argument("--until", type=_seconds, default=math.inf, metavar="S", help="end then")


def _detector(parser: Parser, *, optional: bool = False) -> None:
    parser.add_argument(
        "--detector",
        default=None if optional else "robotd",
        metavar="NAME",
        help="robotd or thesis" + (" (default: none)" if optional else " (default: robotd)"),
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the detector")
    parser.add_argument("--settings", type=Path, metavar="TOML", help="settings of the detector")


def _clips(parser: Parser) -> None:
    parser.add_argument("--clip", type=_positive, metavar="S", help="judge clips of this length (default: all in one)")


def _run(arguments: argparse.Namespace) -> int:
    from . import workbench_commands

    command: Callable[[argparse.Namespace], int] = getattr(workbench_commands, arguments.what)
    return command(arguments)


def _place(text: str) -> tuple[float, float]:
    try:
        u, v = (float(part) for part in text.split(","))
    except ValueError:
        u = v = math.nan
    if not (math.isfinite(u) and math.isfinite(v)):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected pixels as U,V, such as 311.5,200")
    return u, v


def _number(text: str, least: float, wanted: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value < math.inf:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected {wanted}")
    return value


def _seconds(text: str) -> float:
    return _number(text, 0.0, "seconds, 0 or more")


def _positive(text: str) -> float:
    return _number(text, 1e-9, "a number above 0")


def _share(text: str) -> float:
    value = _number(text, 0.0, "a share from 0 to 1")
    if value > 1.0:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a share from 0 to 1")
    return value


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a whole number")
    return int(text)


def _numbers(text: str) -> list[int]:
    parts: list[Any] = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected numbers such as 1,3,4")
    return [int(part) for part in parts]
