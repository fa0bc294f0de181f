"""Default disturbances of a store: lamps, passers-by and a blinking light, where its file has none."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from ..records import Floats, Vector3
from .layout import Blinker, Lamp, StoreLayout, Walker
from .line import distance_to_box, distance_to_segment

LAMP_HEIGHT = 2.4  # m
LAMP_AREA = 9.0  # m2 of floor per lamp, at most eight lamps
WALKER_CLEARANCES = (0.45, 0.37, 0.30)  # m from the line, the widest that leaves a path; the last is the least allowed
WALKER_GAP = 0.22  # m from walls and shelves
BLINKER_HEIGHT = 1.3  # m: below the upper edge of the rig's view from one metre away


def with_disturbances(layout: StoreLayout) -> StoreLayout:
    """Add the default lamps, walkers and blinker of whatever kind the file has none of, unless it forbids them."""
    if not layout.disturbances:
        return layout
    return dataclasses.replace(
        layout,
        lamps=layout.lamps or _lamps(layout),
        walkers=layout.walkers or _walkers(layout),
        blinkers=layout.blinkers or _blinkers(layout),
    )


def _lamps(layout: StoreLayout) -> tuple[Lamp, ...]:
    width, depth = layout.size
    count = min(8, max(1, round(width * depth / LAMP_AREA)))
    columns = min(count, max(1, round(math.sqrt(count * width / depth))))
    rows = max(1, round(count / columns))
    return tuple(
        Lamp(((column + 0.5) * width / columns, (row + 0.5) * depth / rows, LAMP_HEIGHT))
        for row in range(rows)
        for column in range(columns)
    )


def _obstacle_distance(layout: StoreLayout, points: Floats) -> Floats:
    """(N,) distances of (N, 2) points from the nearest wall, shelf or edge of the floor."""
    edges = np.minimum(points, np.array(layout.size) - points).min(axis=1)
    walls = [distance_to_segment(points, wall.start, wall.end) for wall in layout.walls]
    shelves = [distance_to_box(points, shelf.box) for shelf in layout.shelves]
    return np.asarray(np.minimum.reduce([edges, *walls, *shelves]))


def _walkers(layout: StoreLayout) -> tuple[Walker, ...]:
    """Two straight paths as long as the store allows, apart from each other and clear of the line."""
    geometry = layout.geometry
    rng = np.random.default_rng(len(layout.labels))  # the same paths whenever the same layout is read
    points = rng.uniform((0.0, 0.0), layout.size, (400, 2))
    points = points[_obstacle_distance(layout, points) >= WALKER_GAP]
    from_line = geometry.distance(points)
    for clearance in WALKER_CLEARANCES:
        free = points[from_line >= clearance][:40]
        found: list[tuple[float, Floats, Floats]] = []
        for a, b in itertools.combinations(free, 2):
            length = float(np.hypot(*(b - a)))
            if 0.6 <= length <= 6.0:
                found.append((length, a, b))
        found.sort(key=lambda item: -item[0])
        walkers: list[Walker] = []
        for length, a, b in found:
            between = a + np.linspace(0.0, 1.0, math.ceil(length / 0.05) + 1)[:, None] * (b - a)
            if _obstacle_distance(layout, between).min() < WALKER_GAP:
                continue
            if geometry.distance(between).min() < clearance:
                continue
            middle = (a + b) / 2
            if any(math.dist(middle, np.mean(walker.path, axis=0)) < 0.5 for walker in walkers):
                continue
            ends = ((float(a[0]), float(a[1])), (float(b[0]), float(b[1])))
            walkers.append(Walker(ends, speed=1.1 - 0.3 * len(walkers), height=1.75 - 0.1 * len(walkers)))
            if len(walkers) == 2:
                return tuple(walkers)
        if walkers:
            return tuple(walkers)
    return ()


def _blinkers(layout: StoreLayout) -> tuple[Blinker, ...]:
    """One light at 2 Hz, on a wall near the line, but not beside a label."""
    geometry = layout.geometry
    labels = np.array([label.position for label in layout.labels]).reshape(-1, 3)
    best: tuple[float, Vector3, Vector3] | None = None
    for wall in layout.walls:
        a, step = np.array(wall.start), np.subtract(wall.end, wall.start)
        length = float(np.hypot(*step))
        for share, side in itertools.product(np.linspace(0.1, 0.9, 9), (1.0, -1.0)):
            normal = side * np.array([-step[1], step[0]]) / length
            point = a + share * step + 0.02 * normal
            if not (0 <= point[0] <= layout.size[0] and 0 <= point[1] <= layout.size[1]):
                continue
            if any(distance_to_box(point[None], shelf.box)[0] < 0.1 for shelf in layout.shelves):
                continue
            position = (float(point[0]), float(point[1]), min(BLINKER_HEIGHT, 0.8 * wall.height))
            gaps = np.linalg.norm(labels - np.array(position), axis=1)
            distance = float(geometry.distance(point + 0.02 * normal))
            if (not len(gaps) or gaps.min() >= 0.3) and (best is None or distance < best[0] - 1e-6):
                best = (distance, position, (float(normal[0]), float(normal[1]), 0.0))
    if best is None:
        return ()
    return (Blinker(best[1], normal=best[2]),)
