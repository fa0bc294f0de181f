"""Shapes of lines: the centre-lines of each family in pixels, and tape rastered along them.

A centre-line is an (N, 2) array of u, v; corners are single vertices between long segments, so that mitres stay clean,
and curves are dense. Pixel (0, 0) has its centre at u = v = 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robotd.vision.polyline import arc_length

Floats = NDArray[np.float64]
Generator = np.random.Generator


@dataclass(frozen=True, eq=False)
class Path:
    """A centre-line (N, 2); where it is not `painted` (a gap between dashes) finding it is neither right nor wrong."""

    points: Floats
    painted: bool = True


@dataclass(frozen=True, eq=False)
class TrueLine:
    """A centre-line (N, 2) in pixels and the line's width; finding an `optional` one is neither right nor wrong."""

    points: Floats
    width: float
    optional: bool = False


Shape = Callable[[Generator, float, float], list[Path]]  # of the view's shorter side and the line's width, around 0, 0


def _sampled(along: Floats, across: Floats) -> Floats:
    return np.column_stack([along, across])


def _reach(side: float) -> float:
    return 1.6 * side  # beyond any border, as seen from the middle


def straight(rng: Generator, side: float, w: float) -> list[Path]:
    return [Path(np.array([[-_reach(side), 0.0], [_reach(side), 0.0]]))]


def curve(rng: Generator, side: float, w: float) -> list[Path]:
    """An S: its least radius of curvature is 3 widths or more."""
    wave = rng.uniform(0.7, 1.6) * side
    most = (wave / (2.0 * math.pi)) ** 2 / (3.0 * w)
    height = min(rng.uniform(0.08, 0.28) * side, most)
    along = np.arange(-_reach(side), _reach(side), 1.0)
    return [Path(_sampled(along, height * np.sin(2.0 * math.pi * along / wave + rng.uniform(0.0, 6.28))))]


def arc(rng: Generator, side: float, w: float) -> list[Path]:
    """Part of a circle, or all of it."""
    radius = max(rng.uniform(0.28, 1.0) * side, 3.0 * w)
    angle = np.arange(0.0, 2.0 * math.pi + 1.0 / radius, 1.0 / radius)
    middle = [0.0, 0.0] if radius < 0.4 * side else [0.0, radius]
    return [Path(middle + radius * np.column_stack([np.sin(angle), -np.cos(angle)]))]


def hairpin(rng: Generator, side: float, w: float) -> list[Path]:
    """Two legs joined by half a circle of 1.5 to 2.5 widths."""
    radius = rng.uniform(1.5, 2.5) * w
    angle = np.arange(-0.5 * math.pi, 0.5 * math.pi, 1.0 / radius)
    bend = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    legs = np.array([[-_reach(side), -radius]]), np.array([[-_reach(side), radius]])
    return [Path(np.vstack([legs[0], bend, legs[1]]))]


def right_angle(rng: Generator, side: float, w: float) -> list[Path]:
    reach = _reach(side)
    return [Path(np.array([[-reach, 0.0], [0.0, 0.0], [0.0, reach]]))]


def corner(rng: Generator, side: float, w: float) -> list[Path]:
    """A corner that turns by 30 to 120 degrees."""
    turn = math.radians(rng.uniform(30.0, 120.0))
    reach = _reach(side)
    return [Path(np.array([[-reach, 0.0], [0.0, 0.0], [reach * math.cos(turn), reach * math.sin(turn)]]))]


def zigzag(rng: Generator, side: float, w: float) -> list[Path]:
    """Several right angles, legs of 5 widths or more."""
    leg = max(rng.uniform(0.3, 0.5) * side, 5.0 * w)
    steps = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [1.0, 0.0]]) * leg
    knots = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    knots -= knots.mean(axis=0)
    knots[0, 0] -= _reach(side)
    knots[-1, 0] += _reach(side)
    return [Path(knots)]


def crossing(rng: Generator, side: float, w: float) -> list[Path]:
    angle = math.radians(rng.uniform(40.0, 140.0))
    other = _reach(side) * np.array([math.cos(angle), math.sin(angle)])
    return [*straight(rng, side, w), Path(np.array([-other, other]))]


def branch(rng: Generator, side: float, w: float) -> list[Path]:
    """A T: a line that ends on another."""
    angle = math.radians(rng.uniform(60.0, 120.0))
    arm = _reach(side) * np.array([math.cos(angle), math.sin(angle)])
    return [*straight(rng, side, w), Path(np.array([[0.0, 0.0], arm]))]


def fork(rng: Generator, side: float, w: float) -> list[Path]:
    """A Y: one line becomes two, which bend away to either side."""
    paths = []
    for way in (-1.0, 1.0):
        radius = rng.uniform(0.5, 1.2) * side
        turn = math.radians(rng.uniform(35.0, 60.0))
        angle = np.arange(0.0, turn, 1.0 / radius)
        bend = radius * np.column_stack([np.sin(angle), way * (1.0 - np.cos(angle))])
        out = bend[-1] + _reach(side) * np.array([[math.cos(turn), way * math.sin(turn)]])
        trunk = np.array([[-_reach(side), 0.0]]) if way < 0.0 else np.empty((0, 2))
        paths.append(Path(np.vstack([trunk, bend, out])))
    return paths


def gaps(rng: Generator, side: float, w: float) -> list[Path]:
    """A line or curve with one to three gaps of half a width to two widths."""
    (whole,) = (straight if rng.random() < 0.5 else curve)(rng, side, w)
    middle = 0.5 * arc_length(whole.points)[-1]
    places = np.sort(rng.choice(np.array([-0.28, 0.0, 0.28]), int(rng.integers(1, 4)), replace=False)) * side
    return _cut(whole.points, [(middle + at, rng.uniform(0.5, 2.0) * w) for at in places])


def dashed(rng: Generator, side: float, w: float) -> list[Path]:
    """Dashes of 2 to 4 widths, 0.8 to 2 widths apart, straight or in an S."""
    (whole,) = (straight if rng.random() < 0.5 else curve)(rng, side, w)
    dash, space = rng.uniform(2.0, 4.0) * w, rng.uniform(0.8, 2.0) * w
    starts = np.arange(rng.uniform(0.0, dash), arc_length(whole.points)[-1], dash + space)
    return _cut(whole.points, [(at + 0.5 * space, space) for at in starts])


def _cut(points: Floats, spaces: list[tuple[float, float]]) -> list[Path]:
    """Pieces of a polyline between gaps (middle, length), and the gaps as unpainted pieces."""
    lengths = arc_length(points)
    bounds = [0.0]
    for middle, space in spaces:
        bounds += [middle - 0.5 * space, middle + 0.5 * space]
    bounds.append(float(lengths[-1]))
    paths = []
    for k, (start, end) in enumerate(itertools.pairwise(bounds)):
        if end - start > 1e-6:
            inner = (lengths > start) & (lengths < end)
            at = np.concatenate([[start], lengths[inner], [end]])
            piece = np.column_stack([np.interp(at, lengths, points[:, i]) for i in (0, 1)])
            paths.append(Path(piece, painted=k % 2 == 0))
    return paths


def parallel(rng: Generator, side: float, w: float) -> list[Path]:
    """Two lines 2 to 5 widths apart."""
    apart = rng.uniform(2.0, 5.0) * w
    (one,) = straight(rng, side, w)
    return [Path(one.points + [0.0, offset]) for offset in (-0.5 * apart, 0.5 * apart)]


def end(rng: Generator, side: float, w: float) -> list[Path]:
    """A line that ends in view, at one end or at both."""
    start = -_reach(side) if rng.random() < 0.6 else -rng.uniform(0.2, 0.4) * side
    return [Path(np.array([[start, 0.0], [rng.uniform(0.05, 0.35) * side, 0.0]]))]


SHAPES: dict[str, Shape] = {
    shape.__name__: shape
    for shape in (
        straight, curve, arc, hairpin, right_angle, corner, zigzag, crossing, branch, fork, gaps, dashed, parallel, end,
    )
}  # fmt: skip


def placed(paths: list[Path], angle: float, at: tuple[float, float]) -> list[Path]:
    """The paths turned by `angle` and moved so that their origin lies `at` (u, v)."""
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return [Path(path.points @ turn.T + at, path.painted) for path in paths]


def outlines(points: Floats, width: float) -> Floats:
    """Quadrilaterals (K, 4, 2) that cover tape of `width` along a polyline, mitred and all turning alike."""
    steps = np.diff(points, axis=0)
    length = np.hypot(steps[:, 0], steps[:, 1])
    points, steps = np.vstack([points[:1], points[1:][length > 1e-9]]), steps[length > 1e-9]
    unit = steps / np.hypot(steps[:, 0], steps[:, 1])[:, None]
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
    sum_ = before + after
    mitre = sum_ / np.maximum(1.0 + (before * after).sum(axis=1), 0.15)[:, None]
    left, right = points + 0.5 * width * mitre, points - 0.5 * width * mitre
    quads = np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1)
    turned = np.roll(quads, -1, axis=1)
    area = (quads[..., 0] * turned[..., 1] - quads[..., 1] * turned[..., 0]).sum(axis=1)
    quads[area < 0.0] = quads[area < 0.0, ::-1]
    return quads


def filled(polygons: Floats, size: tuple[int, int], s: int) -> NDArray[np.bool_]:
    """Which samples lie in the union of polygons (K, M, 2) that all turn the same way; `size` rows and columns.

    Exact at the samples' centres: every edge adds its sign to the winding number right of where it crosses a row.
    """
    corners = (polygons + 0.5) * s - 0.5
    start, stop = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
    sign = np.where(stop[:, 1] > start[:, 1], 1, -1)
    low, high = np.minimum(start[:, 1], stop[:, 1]), np.maximum(start[:, 1], stop[:, 1])
    first = np.clip(np.ceil(low), 0, size[0]).astype(np.int64)
    count = np.maximum(np.clip(np.ceil(high), 0, size[0]).astype(np.int64) - first, 0)
    edge = np.repeat(np.arange(len(start)), count)
    row = first[edge] + np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    share = (row - start[edge, 1]) / (stop[edge, 1] - start[edge, 1])
    column = start[edge, 0] + share * (stop[edge, 0] - start[edge, 0])
    column = np.clip(np.ceil(column), 0, size[1]).astype(np.int64)
    winding = np.zeros((size[0], size[1] + 1), np.int32)
    np.add.at(winding, (row, column), sign[edge])
    return np.asarray(np.cumsum(winding, axis=1)[:, :-1] != 0)
