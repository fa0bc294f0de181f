"""Real photographs with annotations, as scenes: a folder of images with a JSON file of the same name beside each.

`IMG_0007.jpg` is described by `IMG_0007.json`:

    {"lines": [[[12.5, 480.0], [180.0, 255.5], [402.0, 20.0]]], "width_px": 24.0, "polarity": "dark"}
    {"lines": "none", "width_px": [15.0, 30.0], "polarity": "bright"}

lines
    The centre-lines, each a list of at least two points [u, v] in pixels, in order along the line; or the word "none"
    for a floor without a line. The upper left pixel has its centre at [0, 0]. Lines end where the tape leaves the
    image; a corner is a point, a curve has a point at least every width.
width_px
    The line's width across it in pixels: a number where there is a line; or [least, greatest], for which a bare floor
    is searched. A number n means [0.75 n, 1.35 n] to the detector, as in the drawn scenes.
polarity
    "dark" or "bright", the line against the floor.
gaps (optional)
    Polylines where the line is worn away or covered: finding it there is neither right nor wrong.
valid (optional)
    Corners [u, v] of a polygon; only what is inside counts and is shown to the detector as valid. For top views of
    tilted cameras.

Images without a JSON file and JSON files without an image are mistakes, and all mistakes are named at once.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from robotd.errors import InputError

from .paths import Floats, TrueLine
from .scenes import Scene

IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
KEYS = ("lines", "width_px", "polarity", "gaps", "valid")


def photographs(folder: Path) -> list[Scene]:
    """The scenes of a folder, by name; families `photo` and, without lines, `bare/photo`.

    Raises
    ------
    InputError
        If the folder cannot be read or holds no images, or any annotation is missing or wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; expected photographs with a JSON file beside each")
    files = sorted(folder.iterdir())
    images = {path.stem: path for path in files if path.suffix.lower() in IMAGES}
    notes = {path.stem: path for path in files if path.suffix.lower() == ".json"}
    if not images:
        raise InputError(f"{folder}: holds no images; expected files ending in {', '.join(IMAGES)}")
    problems = [f"{images[stem]}: has no annotation; expected {stem}.json beside it" for stem in images.keys() - notes]
    problems += [f"{notes[stem]}: has no image of that name beside it" for stem in notes.keys() - images]
    found = []
    for stem in sorted(images.keys() & notes.keys()):
        scene = _scene(images[stem], notes[stem], problems)
        if scene is not None:
            found.append(scene)
    if problems:
        raise InputError(*sorted(problems))
    return found


def _scene(picture: Path, note: Path, problems: list[str]) -> Scene | None:
    """One scene, or None with its mistakes appended."""
    before = len(problems)
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    if image is None:
        problems.append(f"{picture}: cannot be read as an image")
        return None
    try:
        data = json.loads(note.read_text())
    except (OSError, ValueError) as error:
        problems.append(f"{note}: cannot be read as JSON: {error}")
        return None
    if not isinstance(data, dict):
        problems.append(f"{note}: found {type(data).__name__}; expected an object with {', '.join(KEYS[:3])}")
        return None
    problems += [f"{note}: unknown key {key!r}; expected {', '.join(KEYS)}" for key in data if key not in KEYS]
    lacking = [key for key in KEYS[:3] if key not in data]
    problems += [f"{note}: lacks {key!r}" for key in lacking]
    if lacking:
        return None
    if data["polarity"] not in ("dark", "bright"):
        problems.append(f"{note}: polarity = {data['polarity']!r}; expected 'dark' or 'bright'")
    bare = data["lines"] == "none"
    limits = _limits(note, data["width_px"], bare, problems)
    lines = [] if bare else _polylines(note, "lines", data["lines"], image.shape, problems)
    if not bare and data["lines"] == []:
        problems.append(f'{note}: lines is empty; expected at least one polyline, or "none" for a bare floor')
    gaps = _polylines(note, "gaps", data.get("gaps", []), image.shape, problems)
    valid = None
    if "valid" in data:
        (area,) = _polylines(note, "valid", [data["valid"]], image.shape, problems) or [np.empty((0, 2))]
        mask = np.zeros(image.shape, np.uint8)
        cv2.fillPoly(mask, [np.rint(area).astype(np.int32)], 1) if len(area) else None
        valid = mask > 0
    if len(problems) > before:
        return None
    width = math.sqrt(limits[0] * limits[1]) if isinstance(data["width_px"], list) else float(data["width_px"])
    truth = [TrueLine(points, width) for points in lines] + [TrueLine(points, width, True) for points in gaps]
    family = "bare/photo" if bare else "photo"
    return Scene(picture.name, family, np.asarray(image, np.uint8), tuple(truth), data["polarity"], limits, valid)


def _limits(note: Path, value: Any, bare: bool, problems: list[str]) -> tuple[float, float]:
    if _is_number(value) and value >= 1.0:
        return 0.75 * value, 1.35 * value
    if (
        bare
        and isinstance(value, list)
        and len(value) == 2
        and all(map(_is_number, value))
        and 1 <= value[0] <= value[1]
    ):
        return float(value[0]), float(value[1])
    wanted = "a number of at least 1" + (" or [least, greatest]" if bare else "")
    problems.append(f"{note}: width_px = {value!r}; expected {wanted}")
    return 1.0, 1.0


def _polylines(note: Path, key: str, value: Any, shape: tuple[int, ...], problems: list[str]) -> list[Floats]:
    if not isinstance(value, list):
        problems.append(f"{note}: {key} = {value!r}; expected a list of polylines" + ' or "none"' * (key == "lines"))
        return []
    lines = []
    for k, points in enumerate(value):
        good = isinstance(points, list) and len(points) >= 2
        if not (good and all(isinstance(p, list) and len(p) == 2 and all(map(_is_number, p)) for p in points)):
            problems.append(f"{note}: {key}[{k}] is not a list of two or more points [u, v]")
            continue
        line = np.array(points, dtype=np.float64)
        margin = 0.5 * max(shape)
        if (line < -margin).any() or (line > np.array(shape[1::-1]) + margin).any():
            problems.append(f"{note}: {key}[{k}] lies far outside its image of {shape[1]}x{shape[0]} pixels")
        lines.append(line)
    return lines


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
