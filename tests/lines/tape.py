"""Tape laid on a floor: strips of one tone along paths, whole or in pieces, new or worn; and markers beside them."""

from __future__ import annotations

import itertools
import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from . import paths
from .floors import Generator, Single, fractal, noise
from .paths import Floats, Path
from .recipes import Recipe

Polarity = Literal["dark", "bright"]


def laid(
    rng: Generator, floor: Single, lines: list[Path], w: float, polarity: Polarity, recipe: Recipe, s: int
) -> Single:
    """The floor with tape along the painted lines, each a strip of its own laid over the one before."""
    ground = float(np.median(floor))
    spread = min(float(floor.std()), 25.0)  # because what is no darker than the floor's own stains nobody can see
    sign = -1.0 if polarity == "dark" else 1.0
    worn, sheen = rng.random() < recipe.worn, rng.random() < recipe.sheen
    if recipe.contrast is not None:
        tone = min(max(ground + sign * (rng.uniform(*recipe.contrast) + spread), 15.0), 245.0)
    elif polarity == "dark":
        tone = min(rng.uniform(25.0, 65.0), ground - 60.0)
    else:
        floor = floor * np.float32(min(1.0, 130.0 / ground))  # because tape cannot be brighter than white
        ground = min(ground, 130.0)
        tone = max(rng.uniform(190.0, 235.0), ground + 70.0)
    relief = np.float32(rng.uniform(0.0, 0.25)) * (floor - np.float32(ground))
    skin = np.float32(rng.uniform(0.5, 2.5)) * noise(rng, floor.shape, 3.0 * s)
    strips = [path.points for path in lines if path.painted]
    if rng.random() < recipe.pieced:
        strips = [piece for points in strips for piece in _pieces(rng, points, w)]
    for points in strips:
        cover = paths.filled(paths.outlines(points, w), floor.shape, s)
        if worn:
            cover = _worn(rng, cover, w * s)
        strip = tone + rng.normal(0.0, 2.5) + relief + skin
        if worn:
            strip = strip - sign * _dirt(rng, floor.shape, w * s)
        if sheen:
            strip = strip + rng.uniform(20.0, 70.0) * np.maximum(fractal(rng, floor.shape, 8.0 * w * s) - 0.3, 0.0)
        floor = np.where(cover, strip, floor)
    return np.asarray(floor, dtype=np.float32)


def _pieces(rng: Generator, points: Floats, w: float) -> list[Floats]:
    """The segments of a path with corners, each sticking out at its corners; a smooth path stays whole."""
    if len(points) > 10:
        return [points]
    pieces = []
    for k, (start, end) in enumerate(itertools.pairwise(points)):
        along = (end - start) / np.hypot(*(end - start))
        before = rng.uniform(0.3, 0.8) * w if k > 0 else 0.0
        after = rng.uniform(0.3, 0.8) * w if k < len(points) - 2 else 0.0
        pieces.append(np.array([start - before * along, end + after * along]))
    return pieces


def _worn(rng: Generator, cover: NDArray[np.bool_], w: float) -> NDArray[np.bool_]:
    """Ragged edges, about a twentieth of the width to either side, and small holes; `w` in samples."""
    soft = cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 0.08 * w)
    ragged = soft + 0.2 * noise(rng, cover.shape, 0.2 * w) * (soft > 0.02) > 0.5
    holes = noise(rng, cover.shape, 0.15 * w) > 2.8
    return np.asarray(ragged & ~holes)


def _dirt(rng: Generator, size: tuple[int, int], w: float) -> Single:
    """Grey levels that dust, footprints and ribs take from the tape's contrast."""
    dust = np.maximum(fractal(rng, size, 0.8 * w), 0.0) * np.float32(rng.uniform(6.0, 14.0))
    ribs = np.sin(np.arange(size[1], dtype=np.float32) * np.float32(2.0 * math.pi / (0.35 * w)))
    return np.asarray(dust + rng.uniform(0.0, 7.0) * (1.0 + ribs), dtype=np.float32)


def mark(rng: Generator, floor: Single, lines: list[Path], w: float, polarity: Polarity, s: int) -> None:
    """Squares and dots about as wide as the line, beside it: markers, which are no lines."""
    tone = 40.0 if polarity == "dark" else 220.0
    spots = [np.array(floor.shape[::-1]) / s * rng.uniform(0.15, 0.85, 2) for _ in range(int(rng.integers(2, 6)))]
    if lines:
        away = lines[0].points[-1] - lines[0].points[0]
        normal = np.array([-away[1], away[0]]) / np.hypot(*away)
        offsets = [float((spot - lines[0].points[0]) @ normal) for spot in spots]
        near = [math.copysign(rng.uniform(1.8, 3.0) * w, offset) - offset for offset in offsets]
        spots = [spot + move * normal for spot, move in zip(spots, near, strict=True)]
    for spot in spots:
        half = rng.uniform(0.45, 0.65) * w
        if rng.random() < 0.5:
            corners = 0.5 * math.pi * np.arange(4) + rng.uniform(0.0, 1.57)
            half *= math.sqrt(2.0)
        else:
            corners = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
        outline = spot + half * np.column_stack([np.cos(corners), np.sin(corners)])
        floor[paths.filled(outline[None], floor.shape, s)] = tone
