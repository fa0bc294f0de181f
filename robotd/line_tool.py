"""`robotd line`: what the line detector sees in photographs, videos and cameras, as pictures and as JSON.

Nothing of the robot is opened but the camera that is asked for.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import load_calibration
from .errors import DriverFault, InputError
from .records import Line
from .vision import figures
from .vision.evidence import believed
from .vision.explain import explain
from .vision.polyline import arc_length
from .vision.stroke import LineConfig, LineDetector
from .vision.top_view import TopView

Bytes = NDArray[np.uint8]
WARM_UP = 10  # frames of a camera that are skipped, because its exposure is still settling


@dataclass(frozen=True, eq=False)
class Frame:
    """One grey image and where it is from."""

    source: str
    number: int | None  # in a video or since a camera was opened, from 0
    image: Bytes


def run(arguments: argparse.Namespace) -> int:
    """Run `robotd line`; returns the exit code.

    Raises
    ------
    InputError
        If a source or the calibration cannot be used; every source is checked before the first is read.
    DriverFault
        If a camera cannot be opened or stops.
    """
    _quiet()
    _check_sources(arguments.sources)
    view = _top_view(arguments.calibration) if arguments.calibration is not None else None
    config = LineConfig(arguments.color, arguments.width_px)
    everything = LineDetector(dataclasses.replace(config, min_confidence=0.0))
    arguments.out.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    taken: set[str] = set()
    for source in arguments.sources:
        for frame in _frames(source, arguments.frames):
            image, valid = frame.image, None
            if view is not None:
                image, valid = _seen_from_above(view, frame, arguments.calibration)
            lines = everything.detect(image, valid)
            name = _name(frame, taken)
            written = _draw(arguments, name, everything, image, valid, lines, config.min_confidence)
            sure = believed(lines, config.min_confidence)
            results.append(_result(frame, image, sure, lines, view, written))
            _tell(results[-1])
    if arguments.json:
        print(json.dumps({"config": dataclasses.asdict(config), "images": results}))
    return 0


def _quiet() -> None:
    """Keep OpenCV from writing its own complaints about files: ours name the file."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _camera(source: str) -> str | None:
    """The device of a camera, or None if the source is a file."""
    if source.isdecimal():
        return f"/dev/video{source}"
    return source if source.startswith("/dev/") else None


def _check_sources(sources: list[str]) -> None:
    problems = []
    for source in sources:
        device = _camera(source)
        if device is not None:
            if not Path(device).exists():
                problems.append(f"camera {source}: there is no {device}; see /dev/video*, or is it unplugged?")
        elif Path(source).is_dir():
            problems.append(f"{source}: is a folder; expected images or videos, such as {Path(source) / '*.jpg'}")
        elif not Path(source).exists():
            problems.append(f"{source}: there is no such file")
    if problems:
        raise InputError(*problems)


def _frames(source: str, count: int) -> Iterator[Frame]:
    device = _camera(source)
    if device is not None:
        yield from _camera_frames(source, device, count)
        return
    try:
        data = np.fromfile(source, np.uint8)
    except OSError as error:
        raise InputError(f"{source}: cannot be read: {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is not None:
        yield Frame(source, None, np.asarray(image, np.uint8))
        return
    yield from _video_frames(source, count)


def _video_frames(source: str, count: int) -> Iterator[Frame]:
    """`count` frames spread evenly over a video; all of them if it has no more."""
    capture = cv2.VideoCapture(source)
    try:
        found = False
        if capture.isOpened():
            total = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
            wanted = {round(k * (total - 1) / max(count - 1, 1)) for k in range(count)} if total else set(range(count))
            number = 0
            while number <= max(wanted) and capture.grab():
                if number in wanted:
                    good, picture = capture.retrieve()
                    if good:
                        found = True
                        yield Frame(source, number, _grey(picture))
                number += 1
    finally:
        capture.release()
    if not found:
        raise InputError(f"{source}: is neither an image nor a video that can be decoded")


def _camera_frames(source: str, device: str, count: int) -> Iterator[Frame]:
    capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    try:
        if not capture.isOpened():
            raise DriverFault(f"camera {source}: {device} cannot be opened; is it a camera, and does robotd use it?")
        for number in range(WARM_UP + count):
            good, picture = capture.read()
            if not good:
                raise DriverFault(f"camera {source}: {device} gave no frame {number}; check its cable")
            if number >= WARM_UP:
                yield Frame(source, number, _grey(picture))
    finally:
        capture.release()


def _grey(picture: NDArray[Any]) -> Bytes:
    return np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _top_view(path: Path) -> TopView:
    camera = load_calibration(path).floor_camera
    if camera is None:
        raise InputError(f"{path}: has no [floor_camera]; measure it with robotd-solver calibrate floor")
    try:
        return TopView(camera)
    except ValueError as error:
        raise InputError(f"{path} [floor_camera]: {error}") from error


def _seen_from_above(view: TopView, frame: Frame, calibration: Path) -> tuple[Bytes, NDArray[np.bool_]]:
    try:
        return view.apply(frame.image).copy(), view.valid
    except ValueError as error:
        raise InputError(f"{frame.source}: does not fit {calibration} [floor_camera]: {error}") from error


def _name(frame: Frame, taken: set[str]) -> str:
    """What the pictures of a frame are called, different for each."""
    stem = Path(frame.source).stem + (f"_{frame.number:05d}" if frame.number is not None else "")
    name, k = stem, 1
    while name in taken:
        k += 1
        name = f"{stem}_{k}"
    taken.add(name)
    return name


def _draw(
    arguments: argparse.Namespace,
    name: str,
    detector: LineDetector,
    image: Bytes,
    valid: NDArray[np.bool_] | None,
    lines: list[Line],
    sure: float,
) -> list[str]:
    """Write the sheets of one frame; returns the files."""
    seen = explain(detector, image, valid)
    if not seen:  # too small for any line
        return []
    best = figures.shown(seen, lines)
    pictures = figures.stages(image, valid, best, lines, sure)
    least, greatest = best.width_px
    title = (
        f"{name}, {image.shape[1]} x {image.shape[0]} px: {best.polarity} lines {least:.1f} to {greatest:.1f} px wide"
    )
    if len(seen) > 1:
        title += f", one of {len(seen)} searches (--separate: all)"
    chosen = [pictures[stage] for stage in figures.SHEET]
    written = [_write(arguments.out / f"{name}.png", figures.sheet(chosen, 3, title))]
    if arguments.compare:
        length = 2.0 * math.sqrt(math.prod(arguments.width_px)) if arguments.width_px is not None else 40.0
        dark = best.polarity == "dark"
        beside = figures.rivals(image, valid, lines, sure, dark=dark, least_length=length)
        title = f"{name}: robotd and what common methods mark for a {best.polarity} line"
        written.append(_write(arguments.out / f"{name}.compare.png", figures.sheet(list(beside.values()), 3, title)))
    if arguments.separate:
        for one in seen:
            which = f".{one.polarity}_{one.scale:.2g}x" if len(seen) > 1 else ""
            for k, (stage, picture) in enumerate(figures.stages(image, valid, one, lines, sure).items(), start=1):
                written.append(_write(arguments.out / f"{name}{which}.{k}_{stage}.png", picture))
    return written


def _write(path: Path, picture: figures.Picture) -> str:
    if not cv2.imwrite(str(path), picture):
        raise InputError(f"{path}: cannot be written; choose another folder with --out")
    return str(path)


def _result(
    frame: Frame, image: Bytes, sure: list[Line], every: list[Line], view: TopView | None, written: list[str]
) -> dict[str, Any]:
    """What one frame's entry in the JSON output says."""
    return {
        "source": frame.source,
        "frame": frame.number,
        "size": [image.shape[1], image.shape[0]],
        "lines": [_line(line, view) for line in sure],
        "refused": [_line(line, view) for line in every if not any(line is one for one in sure)],
        "pictures": written,
    }


def _line(line: Line, view: TopView | None) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "width_px": round(line.width, 2),
        "confidence": round(line.confidence, 3),
        "length_px": round(float(arc_length(line.points)[-1]), 1),
        "points_px": np.round(line.points, 2).tolist(),
    }
    if view is not None:
        entry["points_m"] = np.round(view.to_robot(line.points), 4).tolist()
    return entry


def _tell(result: dict[str, Any]) -> None:
    where = result["source"] + (f" frame {result['frame']}" if result["frame"] is not None else "")
    found = ", ".join(
        f"{line['width_px']:.1f} px wide, {line['length_px']:.0f} px long, confidence {line['confidence']:.2f}"
        for line in result["lines"]
    )
    print(f"{where}: {found or 'no line'}; {', '.join(result['pictures'])}", file=sys.stderr)
