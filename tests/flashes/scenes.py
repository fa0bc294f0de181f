"""Scenes in the spirit of the thesis's table 1: 15 films with 31 labels, one of them where the picture is white.

A scene is a function of its number, its seed and the options alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from robotd.vision.pattern import FlashPattern

from .world import MARGIN, Singles, Walker, light_of, shelves, walker

LABELS = (0, 1, 0, 0, 5, 2, 1, 0, 2, 3, 6, 4, 2, 2, 3)  # of each film in table 1
WALKERS = (2, 0, 1, 0, 1, 0, 1, 2, 0, 1, 0, 2, 0, 1, 2)
SUN = {4, 8, 13}  # films with a patch of sun; the first one's last label hangs in it
LAMP = {3, 6, 10, 12}  # with a lamp, half hidden by a walker or a shelf
SHAKEN = {5, 9, 14}
BLINKING = {0, 2, 5, 7, 8, 11}


@dataclass(frozen=True)
class Light:
    """A light: place in px, `gain` in linear light at its peak, `share(t, exposure)` of an exposure it is on."""

    u: float
    v: float
    width: float
    gain: float
    share: Callable[[float, float], float]


@dataclass(frozen=True)
class Options:
    """What is common to the films of a set."""

    pattern: FlashPattern = field(default_factory=FlashPattern)
    size: tuple[int, int] = (640, 480)
    seconds: float = 16.0
    fps: float = 30.0
    gamma: float = 2.2
    reflections: bool = False  # of every label, in its own phase
    crowd: float = 1.0  # walkers, relative to the table's
    jpeg: int | None = None
    clock_error: float = 3e-4  # standard deviation of the labels' clocks


@dataclass(frozen=True, eq=False)
class Scene:
    """A film: `labels` are to be found, `mirrored` and `distractors` are not."""

    number: int
    options: Options
    wall: Singles  # linear light, with a margin of MARGIN px
    lamps: Singles  # share of the light that flickers
    labels: tuple[Light, ...]
    mirrored: tuple[Light, ...]
    distractors: tuple[Light, ...]
    walkers: tuple[Walker, ...]
    screen: tuple[int, int, int, int] | None  # row, column, height, width of a television
    shaken: bool
    mains_hz: float
    exposure: float
    noise: float
    rng: np.random.Generator


def scene(number: int, seed: int, options: Options) -> Scene:
    """Film `number` (0 to 14) of the table, drawn with `seed`."""
    rng = np.random.default_rng([number, seed])
    width, height = options.size
    grey = shelves(rng, (height + 2 * MARGIN, width + 2 * MARGIN))
    sun = _patch(rng, grey.shape) if number in SUN else np.zeros_like(grey)
    grey = np.minimum(grey * (1.0 + 0.35 * (rng.random() < 0.3)) + 260.0 * sun, 300.0)
    lamps = np.full_like(grey, rng.uniform(0.4, 0.8))
    if number in LAMP:
        row, column = int(rng.uniform(0.03, 0.2) * height), int(rng.uniform(0.1, 0.7) * width)
        grey[row : row + 14, column : column + int(0.2 * width)] = 290.0
        lamps[row : row + 14, column : column + int(0.2 * width)] = 1.0
        grey = cv2.GaussianBlur(grey, (0, 0), 0.8)
    bright = np.maximum(sun, (grey > 250.0).astype(np.float32))
    wall = np.asarray((np.maximum(grey, 0.0) / 255.0) ** options.gamma, np.float32)
    people = rng.poisson(max(0.0, options.crowd - 1.0) * 2.0) + (WALKERS[number] if options.crowd > 0 else 0)
    places = _places(rng, LABELS[number], bright, options, in_sun=number == min(SUN))
    labels, mirrored = [], []
    for u, v in places:
        label = _label(rng, u, v, grey, options)
        labels.append(label)
        if options.reflections:
            mirrored.append(_reflection(rng, label, options))
    if not options.reflections and labels and number % 5 == 0:
        mirrored.append(_reflection(rng, labels[0], options))
    distractors = [_blinker(rng, grey, options) for _ in range(int(rng.integers(1, 4)) if number in BLINKING else 0)]
    screen = None
    if number in BLINKING and rng.random() < 0.5:
        screen = (int(rng.uniform(0, 0.7) * height), int(rng.uniform(0, 0.7) * width), height // 8, width // 7)
    flickers = rng.random() < 0.3
    return Scene(
        number,
        options,
        wall,
        lamps,
        tuple(labels),
        tuple(mirrored),
        tuple(distractors),
        tuple(walker(rng, (height, width), options.seconds, options.gamma) for _ in range(people)),
        screen,
        number in SHAKEN,
        mains_hz=60.0 if rng.random() < 0.3 else 50.0,
        exposure=0.008 if flickers else 0.010,
        noise=rng.uniform(1.2, 2.2),
        rng=rng,
    )


def _patch(rng: np.random.Generator, shape: tuple[int, ...]) -> Singles:
    """Sun on the wall: 1 in a slanted quadrilateral, with soft borders."""
    height, width = shape
    x, y = rng.uniform(0.25, 0.65) * width, rng.uniform(0.25, 0.6) * height
    wide, tall, slant = 0.22 * width, 0.28 * height, 0.1 * width * rng.uniform(-1, 1)
    corners = np.array([[x, y], [x + wide, y], [x + wide + slant, y + tall], [x + slant, y + tall]])
    mask = np.zeros(shape, np.float32)
    cv2.fillConvexPoly(mask, np.rint(corners).astype(np.int32), 1.0)
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), 3.0), np.float32)


def _places(
    rng: np.random.Generator, count: int, white: Singles, options: Options, in_sun: bool
) -> list[tuple[float, float]]:
    """Places of labels at least 14 px apart and 5 px from the border, outside of what is white but for one."""
    width, height = options.size
    places: list[tuple[float, float]] = []
    while len(places) < count:
        u, v = rng.uniform(5.0, width - 6.0), rng.uniform(5.0, height - 6.0)
        inside = white[int(v) + MARGIN - 4 : int(v) + MARGIN + 5, int(u) + MARGIN - 4 : int(u) + MARGIN + 5]
        wanted = inside.min() > 0.95 if in_sun and len(places) == count - 1 else inside.max() < 0.05
        if wanted and all(np.hypot(u - x, v - y) > 14.0 for x, y in places):
            places.append((float(u), float(v)))
    return places


def _gain(grey: Singles, u: float, v: float, rise: float, gamma: float) -> float:
    """Linear light that raises the wall at a place by so many grey levels."""
    under = float(min(grey[round(v) + MARGIN, round(u) + MARGIN], 250.0))
    return float(light_of(under, gamma) * ((1.0 + rise / max(under, 1.0)) ** gamma - 1.0))


def _label(rng: np.random.Generator, u: float, v: float, grey: Singles, options: Options) -> Light:
    start, clock = rng.uniform(0.0, options.pattern.period), 1.0 + options.clock_error * rng.standard_normal()
    pattern = options.pattern

    def share(t: float, exposure: float) -> float:
        since = (t - start) * clock % pattern.period
        return float(pattern.coverage(np.array([since]), exposure, 2)[0])

    gain = _gain(grey, u, v, float(np.exp(rng.uniform(np.log(9.0), np.log(160.0)))), options.gamma)
    return Light(u, v, rng.uniform(0.85, 1.45), gain, share)


def _reflection(rng: np.random.Generator, label: Light, options: Options) -> Light:
    """In the floor or a window: some way off, dimmer as a rule, and blurred by the surface."""
    width, height = options.size
    while True:
        far, aside = rng.uniform(18.0, 110.0), rng.normal(0.0, 4.0)
        du, dv = (aside, far) if rng.random() < 0.5 else (far * rng.choice([-1.0, 1.0]), aside)
        u, v = label.u + du, label.v + dv
        if 5.0 < u < width - 6.0 and 5.0 < v < height - 6.0:
            break
        if rng.random() < 0.05:
            u, v = min(max(label.u - du, 6.0), width - 7.0), min(max(label.v - dv, 6.0), height - 7.0)
            break
    gain = label.gain * float(np.exp(rng.normal(-1.0, 0.5)))
    return Light(float(u), float(v), label.width * rng.uniform(1.0, 1.7), gain, label.share)


def _blinker(rng: np.random.Generator, grey: Singles, options: Options) -> Light:
    """Status lamps and clocks: steady rates, also the pattern's own, and some that come on at random."""
    width, height = options.size
    u, v = rng.uniform(8.0, width - 9.0), rng.uniform(8.0, height - 9.0)
    hertz, start = float(rng.choice([0.5, 1.0, 2.0, 2.5, 4.0, 5.0, 8.0])), rng.uniform(0.0, 2.0)
    duty, at_random = rng.uniform(0.2, 0.7), rng.random() < 0.25
    random = rng.random(4096) < 0.5

    def share(t: float, exposure: float) -> float:
        x = np.linspace(t, t + exposure, 8) - start
        if at_random:
            return float(random[int(t * 7.0) % 4096])
        return float(np.mean(x * hertz % 1.0 < duty))

    gain = _gain(grey, u, v, float(np.exp(rng.uniform(np.log(15.0), np.log(150.0)))), options.gamma)
    return Light(float(u), float(v), rng.uniform(0.9, 2.0), gain, share)


def stamps(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """True times of the frames, and what the camera says; 0.5 % of the frames are dropped."""
    options, rng = scene.options, np.random.default_rng([scene.number, int(1e6 * scene.noise)])
    times = np.arange(0.0, options.seconds, 1.0 / options.fps) + rng.uniform(0.0, 1.0)
    times = times[rng.random(len(times)) >= 0.005]
    jitter = np.clip(rng.normal(0.0, 0.001, len(times)), -0.004, 0.004)
    return times, times + jitter
