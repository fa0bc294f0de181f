"""`python -m tests.lines`: the table of methods against families of scenes or a folder of photographs.

python -m tests.lines                                   ours and the peers on 4 scenes of each family, 320x240
python -m tests.lines --size 700x500 --count 10 --methods robotd
python -m tests.lines --families bare floor/mesh        only families that start so
python -m tests.lines --folder PHOTOGRAPHS              annotated photographs: format in `photographs`
python -m tests.lines --directions                      centre bias and rms of clean lines every 5 degrees
python -m tests.lines --worst DIR                       also draw the 40 worst scenes of the first method
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from robotd.errors import InputError
from robotd.records import Line

from .peers import METHODS, Method
from .photographs import photographs
from .recipes import FAMILIES
from .scenes import SIZES, Scene, scenes, straight_line
from .score import Score, Summary, score, summarise

ORANGE, BLUE, GREY = (0, 159, 230), (178, 114, 0), (150, 150, 150)  # BGR; Okabe and Ito's colours
GROUPS = ("shape", "floor", "light", "camera", "mixed", "photo", "bare")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = _parser().parse_args(argv)
    cv2.setNumThreads(1)  # because methods are timed against each other, and ours has one thread
    methods = {name: METHODS[name] for name in options.methods}
    try:
        if options.directions:
            return _print_directions(methods, options.size[0])
        return _print_table(methods, options)
    except InputError as error:
        for problem in error.problems:
            print(f"lines: {problem}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.lines", description="Judge line detectors.")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="NAME")
    parser.add_argument("--families", nargs="+", default=[""], metavar="PREFIX")
    parser.add_argument("--count", type=int, default=4, metavar="N", help="scenes of each family (default: 4)")
    parser.add_argument(
        "--first", type=int, default=0, metavar="N", help="their first number: others than were tuned on"
    )
    parser.add_argument("--size", nargs="+", type=_size, default=[SIZES[1]], metavar="WxH", help="default: 320x240")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="annotated photographs instead of drawn scenes")
    parser.add_argument("--directions", action="store_true", help="accuracy of clean lines every 5 degrees")
    parser.add_argument("--worst", type=Path, metavar="DIR", help="draw the worst scenes of the first method")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all numbers")
    return parser


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 64):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected WIDTHxHEIGHT, 64 or more each, such as 320x240")
    return int(width), int(height)


def _print_table(methods: dict[str, Method], options: argparse.Namespace) -> int:
    material: Iterable[Scene]
    if options.folder is not None:
        material = photographs(options.folder)
    else:
        families = [name for name in FAMILIES if name.startswith(tuple(options.families))]
        material = (scene for size in options.size for scene in scenes(families, options.count, size, options.first))
    scores: dict[str, list[Score]] = {name: [] for name in methods}
    seconds = dict.fromkeys(methods, 0.0)
    worst: list[tuple[float, Scene, list[Line]]] = []
    for scene in material:
        for k, (name, method) in enumerate(methods.items()):
            begun = time.perf_counter()
            found = method(scene)
            seconds[name] += time.perf_counter() - begun
            scores[name].append(score(scene, found))
            if k == 0 and options.worst is not None:
                worst.append((scores[name][-1].tight, scene, found))
                worst = sorted(worst, key=lambda item: item[0])[:40]
    if not any(scores.values()):
        raise InputError(f"no family starts with {' or '.join(options.families)}; families are {', '.join(FAMILIES)}")
    _print_families(scores)
    _print_overall(scores, seconds)
    if options.worst is not None:
        options.worst.mkdir(parents=True, exist_ok=True)
        for value, scene, found in worst:
            if value < 0.999:
                path = options.worst / f"{value:.2f}_{scene.name.replace('/', '_')}_{scene.image.shape[1]}.png"
                cv2.imwrite(str(path), drawn(scene, found))
    if options.json is not None:
        options.json.write_text(json.dumps({name: [asdict(one) for one in of] for name, of in scores.items()}))
    return 0


def _print_families(scores: dict[str, list[Score]]) -> None:
    """F1 at 0.25 and 0.75 widths of each family, or the share of bare floors found bare, for every method."""
    names = list(scores)
    print(f"{'family':22s}" + "".join(f"{name[:19]:>20s}" for name in names))
    for family in dict.fromkeys(one.family for one in scores[names[0]]):
        row = ""
        for name in names:
            of = summarise([one for one in scores[name] if one.family == family])
            text = f"{of.tight:.2f} {of.loose:.2f}" if math.isnan(of.none) else f"none {of.none:.2f}"
            row += f"{text + (f' +{of.false_lines:.1f}' if of.false_lines else ''):>20s}"
        print(f"{family:22s}{row}")


def _print_overall(scores: dict[str, list[Score]], seconds: dict[str, float]) -> None:
    header = ("method", "overall", "F1 .25w", "F1 .75w", "precision", "recall", "none", "false/scene", "pieces")
    header += ("bias px", "rms px", "width px", "ms")
    print("\n" + f"{header[0]:22s}" + "".join(f"{title:>12s}" for title in header[1:]))
    for name, of in scores.items():
        _print_row(name, summarise(of), 1e3 * seconds[name] / len(of))
        groups = [group for group in GROUPS if any(one.family.startswith(group) for one in of)]
        for group in groups if len(groups) > 1 else []:
            _print_row(f"  {group}", summarise([one for one in of if one.family.startswith(group)]), None)
    print("\nF1 at 0.25 and 0.75 line widths over scenes with lines; none: share of bare floors without a found line;")
    print("overall: mean of F1 .25w and none; +n: false lines per scene; pieces: found lines per true line")


def _print_row(name: str, of: Summary, ms: float | None) -> None:
    values = (of.overall, of.tight, of.loose, of.precision, of.recall, of.none, of.false_lines, of.pieces)
    text = "".join(f"{'' if math.isnan(value) else f'{value:.3f}':>12s}" for value in values)
    text += "".join(f"{'' if math.isnan(value) else f'{value:+.3f}':>12s}" for value in (of.bias,))
    text += "".join(f"{'' if math.isnan(value) else f'{value:.3f}':>12s}" for value in (of.rms, of.width_error))
    print(f"{name:22s}{text}" + (f"{ms:12.1f}" if ms is not None else ""))


def directions(method: Method, size: tuple[int, int], width: float, step: float = 5.0) -> list[tuple[float, Score]]:
    """(degrees, score) of clean lines all around, at several places within a pixel; worst of the places."""
    rows = []
    for degrees in np.arange(0.0, 180.0, step):
        tries = []
        for k in range(4):
            scene = straight_line(degrees, width, size=size, offset=(0.31 * k, 0.17 * k), seed=k)
            tries.append(score(scene, method(scene)))
        rows.append((float(degrees), max(tries, key=lambda one: abs(one.bias) if not math.isnan(one.bias) else 1e9)))
    return rows


def _print_directions(methods: dict[str, Method], size: tuple[int, int]) -> int:
    widths = (6.0, 9.3, 14.6, 24.2, 40.0)
    print("worst of 4 places: bias and rms in px and F1 at 0.25 widths, for widths " + ", ".join(map(str, widths)))
    for name, method in methods.items():
        tables = [directions(method, size, width) for width in widths]
        print(f"\n{name}")
        for k, (degrees, _) in enumerate(tables[0]):
            cells = [f"{table[k][1].bias:+.3f} {table[k][1].rms:.3f} {table[k][1].tight:.2f}" for table in tables]
            print(f"{degrees:5.0f}   " + "   ".join(cells))
        print("worst   " + "   ".join(_extreme(table) for table in tables))
    return 0


def _extreme(table: list[tuple[float, Score]]) -> str:
    bias = max((one.bias for _, one in table), key=lambda value: math.inf if math.isnan(value) else abs(value))
    return f"{bias:+.3f} {max(one.rms for _, one in table):.3f} {min(one.tight for _, one in table):.2f}"


def drawn(scene: Scene, found: Sequence[Line]) -> np.ndarray:
    """The scene with the truth (blue, gaps grey) under what was found (orange, with its width)."""
    zoom = 2 if max(scene.image.shape) < 500 else 1
    picture = cv2.cvtColor(cv2.resize(scene.image, None, fx=zoom, fy=zoom), cv2.COLOR_GRAY2BGR)
    if scene.valid is not None:
        picture[
            cv2.resize(scene.valid.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST) == 0
        ] //= 2

    def stroke(points: np.ndarray, colour: tuple[int, int, int], thick: int) -> None:
        at = np.rint(((points + 0.5) * zoom - 0.5) * 16).astype(np.int32)
        cv2.polylines(picture, [at], False, colour, thick, cv2.LINE_AA, 4)

    for line in scene.lines:
        stroke(line.points, GREY if line.optional else BLUE, 5)
    for line in found:
        stroke(line.points, ORANGE, 2)
        at = np.rint((line.points[len(line.points) // 2] + 0.5) * zoom).astype(int).tolist()
        label = f"{line.width:.1f} px {line.confidence:.2f}"
        cv2.putText(picture, label, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    title = f"{scene.name} {scene.polarity}, searched {scene.width_px[0]:.1f} to {scene.width_px[1]:.1f} px"
    picture[:24] //= 3
    cv2.putText(picture, title, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


if __name__ == "__main__":
    sys.exit(main())
