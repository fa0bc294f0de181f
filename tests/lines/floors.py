"""Floors without a line, drawn as grey levels at several samples a pixel; every kind is one function.

Each takes a generator, the height and width in samples, `s` samples per pixel and the width `w` in pixels of the line
that may come on top: a floor may hold lines of its own (joints, ribs, wires, mortar), but none of that width.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Single = NDArray[np.float32]
Generator = np.random.Generator
Floor = Callable[[Generator, tuple[int, int], int, float], Single]


def noise(rng: Generator, size: tuple[int, int], cell: float, stretch: tuple[float, float] = (1.0, 1.0)) -> Single:
    """Smooth noise of about unit variance with bumps of `cell` samples; `stretch` is by rows and columns."""
    rows = max(round(size[0] / (cell * stretch[0])), 1) + 3
    columns = max(round(size[1] / (cell * stretch[1])), 1) + 3
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    if (rows, columns) > (size[0], size[1]):
        return coarse[: size[0], : size[1]].copy()
    ratio = (cell * stretch[1], cell * stretch[0])
    shift = np.float32([[1 / ratio[0], 0, 0.5 + rng.random()], [0, 1 / ratio[1], 0.5 + rng.random()]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    out = cv2.warpAffine(coarse, shift, size[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(out * np.float32(1.25), dtype=np.float32)


def fractal(rng: Generator, size: tuple[int, int], cell: float, octaves: int = 4, gain: float = 0.6) -> Single:
    """Noise of several sizes, each half as large and `gain` as strong as the one before; unit variance."""
    total = np.zeros(size, np.float32)
    power = 0.0
    for k in range(octaves):
        weight = gain**k
        total += np.float32(weight) * noise(rng, size, max(cell / 2**k, 1.0))
        power += weight**2
    return total / np.float32(math.sqrt(power))


def turned(rng: Generator, size: tuple[int, int], s: int, angle: float | None = None) -> tuple[Single, Single]:
    """Coordinates in pixels along two perpendicular directions at a random angle and phase."""
    if angle is None:
        angle = rng.uniform(0.0, math.pi) if rng.random() < 0.7 else rng.choice([0.0, 0.5 * math.pi])
    u = np.arange(size[1], dtype=np.float32) / s
    v = np.arange(size[0], dtype=np.float32) / s
    c, n = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    shift = rng.uniform(0.0, 1000.0, 2).astype(np.float32)
    return u * c + v[:, None] * n + shift[0], v[:, None] * c - u * n + shift[1]


def _base(rng: Generator) -> float:
    return float(rng.uniform(110.0, 185.0))


def _band(x: Single, period: float, width: float) -> Single:
    """1 inside a band of `width` that repeats every `period`, else 0; a sample is point-like."""
    return ((x % np.float32(period)) < np.float32(width)).astype(np.float32)


def _cells(rng: Generator, i: Single, j: Single, spread: float) -> Single:
    """One random value per cell (i, j): a tile's own tone."""
    table = rng.normal(0.0, spread, (64, 64)).astype(np.float32)
    return table[i.astype(np.int32) % 64, j.astype(np.int32) % 64]


def _apart(rng: Generator, w: float, low: float, high: float) -> float:
    """A width for the floor's own lines that cannot be taken for the line's: at most half as wide."""
    return float(min(rng.uniform(low, high), 0.5 * w))


def plain(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    return _base(rng) + np.float32(rng.uniform(0.5, 3.0)) * fractal(rng, size, 40.0 * s)


def wood(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    plank = rng.uniform(3.0, 6.0) * w
    length = plank * rng.uniform(5.0, 9.0)
    row = np.floor(y / plank)
    shifted = x + _cells(rng, row, row * 0, length)
    rings = noise(rng, size, 30.0 * s) * 6.0 + _cells(rng, row, np.floor(shifted / length), 40.0)
    grain = np.sin((y + rings + 0.02 * x) * np.float32(2.0 * math.pi / rng.uniform(4.0, 9.0)))
    fine = _along(rng, x, y, 1.2, 40.0)
    tone = _cells(rng, row, np.floor(shifted / length), rng.uniform(3.0, 12.0))
    joint = np.maximum(_band(y, plank, _apart(rng, w, 1.0, 2.5)), _band(shifted, length, 1.2))
    return (
        _base(rng) + tone + rng.uniform(1.0, 5.0) * grain + rng.uniform(2.0, 7.0) * fine - rng.uniform(15, 60) * joint
    )


def _along(rng: Generator, x: Single, y: Single, fine: float, coarse: float) -> Single:
    """Noise stretched along x: grain, fibres, brushed metal."""
    table = rng.standard_normal((512, 512), dtype=np.float32)
    return cv2.remap(
        table, x / np.float32(coarse), y / np.float32(fine), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    ).astype(np.float32)


def tiles(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    side, joint = rng.uniform(3.5, 9.0) * w, _apart(rng, w, 1.5, 7.0)
    tone = _cells(rng, np.floor(x / side), np.floor(y / side), rng.uniform(1.0, 8.0))
    veins = 1.0 - np.minimum(np.abs(fractal(rng, size, 40.0 * s)) * 6.0, 1.0)
    grout = np.maximum(_band(x, side, joint), _band(y, side, joint))
    depth = rng.choice([-1.0, 1.0]) * rng.uniform(15.0, 60.0)
    bare = _base(rng) + tone + rng.uniform(0.0, 12.0) * veins + 2.0 * fractal(rng, size, 20.0 * s)
    return (bare + depth * grout).astype(np.float32)


def checkerboard(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    side = rng.uniform(2.0, 6.0) * w
    odd = (np.floor(x / side) + np.floor(y / side)) % 2
    low = rng.uniform(60.0, 130.0)
    return (low + odd * rng.uniform(40.0, 110.0) + 2.0 * fractal(rng, size, 15.0 * s)).astype(np.float32)


def mesh(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    bend = noise(rng, size, 80.0 * s) * np.float32(2.0)
    pitch = rng.uniform(5.0, 9.0) if rng.random() < 0.4 else rng.uniform(9.0, 22.0)
    wire = min(rng.uniform(0.15, 0.35) * pitch, 0.45 * w)
    net = np.maximum(_band(x + bend, pitch, wire), _band(y - bend, pitch * rng.uniform(0.8, 1.3), wire))
    depth = rng.choice([-1.0, 1.0]) * rng.uniform(30.0, 90.0)
    return (_base(rng) + depth * (net - 0.4) + 3.0 * fractal(rng, size, 8.0 * s)).astype(np.float32)


def carpet(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    loop = rng.uniform(3.0, 7.0)
    jitter = noise(rng, size, 4.0 * s)
    pile = np.sin(x * np.float32(2 * math.pi / loop) + jitter) * np.sin(y * np.float32(2 * math.pi / loop) - jitter)
    fleck = noise(rng, size, 2.5 * s)
    bare = _base(rng) + rng.uniform(4.0, 14.0) * pile + rng.uniform(6.0, 16.0) * fleck
    return bare + np.float32(rng.uniform(2.0, 7.0)) * fractal(rng, size, 60.0 * s)


def asphalt(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    grain = noise(rng, size, rng.uniform(1.5, 3.0) * s)
    stones = noise(rng, size, rng.uniform(3.0, 6.0) * s)
    bare = rng.uniform(95.0, 150.0) + rng.uniform(5.0, 14.0) * grain + 5.0 * fractal(rng, size, 50.0 * s)
    return (bare + rng.uniform(8.0, 20.0) * np.maximum(stones - 0.8, 0.0)).astype(np.float32)


def gravel(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    base, spread = _base(rng), rng.uniform(12.0, 38.0)
    ground = np.full(size, base - 1.2 * spread, np.float32)
    radius = rng.uniform(2.5, 9.0) * s
    count = int(1.3 * size[0] * size[1] / (math.pi * radius**2))
    place = rng.uniform((0.0, 0.0), (size[1], size[0]), (count, 2)).astype(int)
    axes = np.maximum(radius * rng.lognormal(0.0, 0.35, (count, 2)), 1.5).astype(int)
    angle = rng.uniform(0.0, 180.0, count)
    tone = rng.normal(base, spread, count)
    for (u, v), (a, b), turn, grey in zip(place.tolist(), axes.tolist(), angle.tolist(), tone.tolist(), strict=True):
        cv2.ellipse(ground, (u, v), (a, b), turn, 0.0, 360.0, grey - 0.5 * spread, -1)
        cv2.ellipse(ground, (u - a // 6, v - b // 6), (max(4 * a // 5, 1), max(4 * b // 5, 1)), turn, 0, 360, grey, -1)
    return ground + 4.0 * noise(rng, size, 1.5 * s)


def terrazzo(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    ground = _base(rng) + 2.0 * fractal(rng, size, 30.0 * s)
    radius = rng.uniform(2.5, 8.0) * s
    count = int(rng.uniform(0.2, 0.6) * size[0] * size[1] / (math.pi * radius**2))
    for _ in range(count):
        middle = rng.uniform((0.0, 0.0), (size[1], size[0]))
        corners = np.sort(rng.uniform(0.0, 2.0 * math.pi, rng.integers(4, 8)))
        reach = radius * rng.lognormal(0.0, 0.4) * rng.uniform(0.6, 1.0, len(corners))
        chip = middle + reach[:, None] * np.column_stack([np.cos(corners), np.sin(corners)])
        cv2.fillPoly(ground, [chip.astype(np.int32)], float(ground[0, 0] + rng.normal(0.0, 30.0)))
    return ground


def brick(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    high = rng.uniform(2.2, 4.0) * w
    long = high * rng.uniform(2.0, 3.2)
    mortar = _apart(rng, w, 3.0, 10.0)
    wobble = 0.25 * mortar * noise(rng, size, 6.0 * s)
    row = np.floor(y / high)
    across = x + 0.5 * long * (row % 2)
    tone = _cells(rng, row, np.floor(across / long), rng.uniform(5.0, 14.0))
    seam = np.maximum(_band(y + wobble, high, mortar), _band(across + wobble, long, mortar))
    rough = rng.uniform(4.0, 12.0) * fractal(rng, size, 8.0 * s)
    bare = rng.uniform(80.0, 140.0) + tone + rough
    return (bare + seam * rng.choice([-1.0, 1.0, 1.0]) * rng.uniform(25.0, 70.0)).astype(np.float32)


def concrete(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    ground = _base(rng) + rng.uniform(4.0, 10.0) * fractal(rng, size, 90.0 * s, octaves=7)
    for _ in range(rng.integers(1, 5)):
        _crack(rng, ground, s, min(rng.uniform(1.0, 3.5), 0.4 * w), rng.choice([-1.0, -1.0, 1.0]) * rng.uniform(20, 60))
    for _ in range(rng.integers(0, 60)):
        at = rng.uniform((0.0, 0.0), (size[1], size[0])).astype(int).tolist()
        cv2.circle(ground, at, int(rng.uniform(0.5, 2.0) * s), float(ground.mean() - rng.uniform(15.0, 50.0)), -1)
    return ground


def _crack(rng: Generator, ground: Single, s: int, width: float, depth: float) -> None:
    at = rng.uniform((0.0, 0.0), ground.shape[::-1])
    heading = rng.uniform(0.0, 2.0 * math.pi)
    step = 6.0 * s
    drawn = np.zeros_like(ground)
    for _ in range(int(rng.uniform(20, 140))):
        heading += rng.normal(0.0, 0.35)
        ahead = at + step * np.array([math.cos(heading), math.sin(heading)])
        thick = max(round(width * s * rng.uniform(0.4, 1.2)), 1)
        cv2.line(drawn, at.astype(int).tolist(), ahead.astype(int).tolist(), 1.0, thick)
        at = ahead
    ground += np.float32(depth) * drawn


def foil(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    """Crumpled metal: creases between tilted facets, each as bright as the part of the room that it mirrors."""
    facet = rng.uniform(12.0, 45.0) * s
    height = np.abs(noise(rng, size, facet)) + 0.4 * np.abs(noise(rng, size, 0.4 * facet))
    height = cv2.GaussianBlur(height, (0, 0), 0.5 * s)
    angle = rng.uniform(0.0, 2.0 * math.pi)
    slope = cv2.Sobel(height, cv2.CV_32F, 1, 0, scale=math.cos(angle) / 8.0)
    slope += cv2.Sobel(height, cv2.CV_32F, 0, 1, scale=math.sin(angle) / 8.0)
    slope /= slope.std()
    mirrored = 18.0 * np.sin(rng.uniform(1.0, 3.0) * slope + rng.uniform(0.0, 6.28))
    shine = np.exp(-((slope - rng.uniform(0.8, 1.6)) ** 2) / np.float32(rng.uniform(0.05, 0.3)))
    brushed = 3.0 * noise(rng, size, 1.5 * s, (1.0, 8.0))
    bare = rng.uniform(90.0, 140.0) + 14.0 * slope + mirrored + brushed
    return np.asarray(bare + rng.uniform(30.0, 110.0) * shine, dtype=np.float32)


def rubber(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    x, y = turned(rng, size, s)
    base, depth = rng.uniform(55.0, 140.0), rng.uniform(8.0, 40.0)
    if rng.random() < 0.5:  # ribs, narrower than the line
        pitch = min(rng.uniform(4.0, 12.0), 0.9 * w)
        relief = np.clip(2.0 * np.sin(x * np.float32(2 * math.pi / pitch)), -1.0, 1.0)
    else:  # studs, wider than the line or much narrower
        pitch = (rng.uniform(3.5, 6.0) if rng.random() < 0.5 else rng.uniform(0.6, 0.9)) * w
        far = np.hypot(x % np.float32(pitch) - pitch / 2, y % np.float32(pitch) - pitch / 2)
        relief = np.clip((0.3 * pitch - far) / 1.5, -1.0, 1.0)
        relief += 0.8 * np.exp(-((far - 0.3 * pitch) ** 2) / 2.0) * rng.choice([-1.0, 1.0])
    return (base + 0.5 * depth * relief + 2.5 * noise(rng, size, 2.0 * s)).astype(np.float32)


def cables(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    ground = (plain if rng.random() < 0.5 else concrete)(rng, size, s, w)
    for _ in range(rng.integers(1, 4)):
        knots = rng.uniform((-0.2, -0.2), (1.2, 1.2), (4, 2)) * size[::-1]
        t = np.linspace(0.0, 1.0, 80)[:, None]
        way = (
            (1 - t) ** 3 * knots[0] + 3 * t * (1 - t) ** 2 * knots[1] + 3 * t**2 * (1 - t) * knots[2] + t**3 * knots[3]
        )
        thick = 0.65 * _apart(rng, w, 3.0, 9.0) * s
        tone = float(rng.choice([rng.uniform(20.0, 60.0), rng.uniform(190.0, 230.0)]))
        shadow = (way + rng.uniform(-0.3, 0.3, 2) * thick).astype(np.int32)
        cv2.polylines(ground, [shadow], False, float(0.7 * ground.mean()), round(1.1 * thick))
        cv2.polylines(ground, [way.astype(np.int32)], False, tone, round(thick))
        cv2.polylines(ground, [way.astype(np.int32)], False, tone + 25.0, max(round(0.25 * thick), 1))
    return ground


@cache
def _pictures() -> tuple[Single, ...]:
    """A photograph of flowers and a terrain that come with packages the tests need anyway."""
    from matplotlib import cbook
    from sklearn.datasets import load_sample_image

    flowers = cv2.cvtColor(load_sample_image("flower.jpg"), cv2.COLOR_RGB2GRAY).astype(np.float32)
    terrain = cbook.get_sample_data("jacksboro_fault_dem.npz")["elevation"].astype(np.float32)
    light = cv2.Sobel(terrain, cv2.CV_32F, 1, 0) + cv2.Sobel(terrain, cv2.CV_32F, 0, 1)
    return flowers, np.clip(128.0 + 60.0 * light / light.std(), 0.0, 255.0)


def photograph(rng: Generator, size: tuple[int, int], s: int, w: float) -> Single:
    picture = _pictures()[rng.integers(2)]
    share = rng.uniform(0.35, 0.9)
    rows, columns = (max(int(share * side), 32) for side in picture.shape)
    v, u = (int(rng.integers(side - part + 1)) for side, part in zip(picture.shape, (rows, columns), strict=True))
    part = np.rot90(picture[v : v + rows, u : u + columns], int(rng.integers(4)))
    out = cv2.resize(np.ascontiguousarray(part), size[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(60.0 + 0.55 * out, dtype=np.float32)


FLOORS: dict[str, Floor] = {
    floor.__name__: floor
    for floor in (
        plain, wood, tiles, checkerboard, mesh, carpet, asphalt, gravel, terrazzo, brick, concrete, foil, rubber,
        cables, photograph,
    )
}  # fmt: skip
