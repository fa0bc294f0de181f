"""Pictures of floors with and without a line, and the exact centre-lines in them.

A scene is made as a painter would: a floor, tape laid on it as polygons, light on both, then the camera. All is drawn
at several samples a pixel, so edges are anti-aliased by averaging; only `straight_line`, for accuracies below a tenth
of a pixel, is integrated in closed form. A scene is a function of its family, number and size alone.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from . import light, paths
from .floors import FLOORS, Generator
from .paths import Floats, Path, TrueLine
from .recipes import ANY, FAMILIES, MILD, Recipe
from .tape import Polarity, laid, mark

Bytes = NDArray[np.uint8]
SIZES = ((700, 500), (320, 240))  # (width, height): the thesis's view and a small camera's


@dataclass(frozen=True, eq=False)
class Scene:
    """A picture and what is true about it; no `lines` means that "no line" is the right answer.

    `width_px` is what a user would say about the line's width, `polarity` what about its colour.
    """

    name: str
    family: str
    image: Bytes
    lines: tuple[TrueLine, ...]
    polarity: Polarity
    width_px: tuple[float, float]
    valid: NDArray[np.bool_] | None = None


def scene(family: str, number: int, size: tuple[int, int] = SIZES[0], samples: int | None = None) -> Scene:
    """The scene of a family with a number, `size` = (width, height) pixels, `samples` per pixel each way.

    Raises
    ------
    KeyError
        If there is no such family.
    """
    recipe = FAMILIES[family]
    s = samples or (3 if min(size) >= 400 else 4)
    rng = np.random.default_rng([zlib.crc32(family.encode()), number, *size])
    width, height = size
    w = min(size) * math.exp(rng.uniform(*np.log(recipe.width)))
    polarity: Polarity = "dark" if rng.random() < 0.6 else "bright"
    kind = recipe.floor or str(rng.choice(MILD))
    if kind == "any":
        kind = str(rng.choice(list(FLOORS)))
    shape = (height * s, width * s)
    floor = FLOORS[kind](rng, shape, s, w)
    lines: list[Path] = []
    if recipe.shape is not None:
        name = str(rng.choice(ANY)) if recipe.shape == "any" else recipe.shape
        lines = _placed(rng, paths.SHAPES[name](rng, float(min(size)), w), recipe, size)
        floor = laid(rng, floor, lines, w, polarity, recipe, s)
    if recipe.markers:
        mark(rng, floor, lines, w, polarity, s)
    lamp = str(rng.choice(list(light.LIGHTS))) if recipe.light == "any" else recipe.light
    lit = light.LIGHTS[lamp](rng, floor, s, w) * np.float32(rng.uniform(*recipe.exposure))
    taper = rng.uniform(*recipe.taper)
    truth = tuple(TrueLine(path.points, w, not path.painted) for path in lines)
    valid = None
    if taper < 1.0:
        lit, truth = light.tapered(lit, truth, taper, s)
        w = truth[0].width if truth else w
    if recipe.top_view:
        image, valid = light.stretched(rng, lit, s, noise=rng.uniform(*recipe.noise))
    else:
        image = light.exposed(
            rng, lit, s,
            blur=rng.uniform(*recipe.blur), motion=rng.uniform(*recipe.motion), noise=rng.uniform(*recipe.noise),
        )  # fmt: skip
    if recipe.jpeg is not None:
        image = light.compressed(image, int(rng.integers(*recipe.jpeg)))
    return Scene(f"{family}/{number}", family, image, truth, polarity, (0.75 * w, 1.35 * w), valid)


def scenes(families: list[str], count: int, size: tuple[int, int], first: int = 0) -> Iterator[Scene]:
    """`count` scenes of every family, one after another, numbered from `first` on."""
    for family in families:
        for number in range(first, first + count):
            yield scene(family, number, size)


def _placed(rng: Generator, lines: list[Path], recipe: Recipe, size: tuple[int, int]) -> list[Path]:
    angle = rng.uniform(0.0, 2.0 * math.pi)
    if recipe.angle is not None:
        angle = math.radians(recipe.angle + rng.uniform(-2.0, 2.0)) + 0.5 * math.pi * int(rng.integers(4)) * (
            recipe.shape != "straight"
        )
    middle = (size[0] * rng.uniform(0.4, 0.6) - 0.5, size[1] * rng.uniform(0.4, 0.6) - 0.5)
    return paths.placed(lines, angle, middle)


def straight_line(
    degrees: float,
    width: float,
    *,
    size: tuple[int, int] = (320, 240),
    offset: tuple[float, float] = (0.0, 0.0),
    dark: float = 50.0,
    floor: float = 190.0,
    blur: float = 0.8,
    noise_sigma: float = 1.5,
    seed: int = 0,
) -> Scene:
    """A clean line at an angle through the middle (+ `offset`), every pixel's coverage integrated in closed form.

    Without blur a pixel's grey level is exactly the area of tape in it; Gaussian blur moves no centre.
    """
    columns, rows = size
    angle = math.radians(degrees)
    normal = np.array([-math.sin(angle), math.cos(angle)])
    middle = np.array([0.5 * (columns - 1) + offset[0], 0.5 * (rows - 1) + offset[1]])
    u, v = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)[:, None]
    far = (u - middle[0]) * normal[0] + (v - middle[1]) * normal[1]
    cover = _half_plane(far + 0.5 * width, normal) - _half_plane(far - 0.5 * width, normal)
    grey = cv2.GaussianBlur(floor + (dark - floor) * cover, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    grey += np.random.default_rng(seed).normal(0.0, noise_sigma, grey.shape)
    image = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    reach = float(columns + rows) * np.array([math.cos(angle), math.sin(angle)])
    truth = TrueLine(np.array([middle - reach, middle + reach]), width)
    polarity: Polarity = "dark" if dark < floor else "bright"
    return Scene(f"clean/{degrees:g}", "clean", image, (truth,), polarity, (0.75 * width, 1.35 * width))


def _half_plane(distance: Floats, normal: Floats) -> Floats:
    """Area of unit pixels on the positive side of a straight edge `distance` (signed) from their centres.

    The edge's profile across is the box of a pixel projected on the normal twice: a trapezium, here integrated.
    """
    long, short = np.sort(np.abs(normal))[::-1]

    def ramp(x: Floats) -> Floats:
        return 0.5 * np.square(np.maximum(x, 0.0))

    if short < 1e-9:
        return np.asarray(np.clip(distance / long + 0.5, 0.0, 1.0))
    a, b = 0.5 * (long + short), 0.5 * (long - short)
    area = ramp(distance + a) - ramp(distance + b) - ramp(distance - b) + ramp(distance - a)
    return np.asarray(area / (long * short))
