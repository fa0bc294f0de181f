"""Polylines: arc length, resampling, directions, and corners."""

from __future__ import annotations

import numpy as np

from ..records import Floats

SHARP = 0.78  # radians, 45 degrees: below it a turn from arm to arm is no corner


def arc_length(points: Floats) -> Floats:
    """Length along a polyline (N, 2) at each of its points, from 0; shape (N,)."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resample(points: Floats, spacing: float) -> Floats:
    """Points at equal distances of about `spacing` along a polyline, both ends included; shape (M, 2), M >= 2."""
    lengths = arc_length(points)
    count = max(round(float(lengths[-1]) / spacing), 1) + 1
    wanted = np.linspace(0.0, lengths[-1], count)
    return np.column_stack([np.interp(wanted, lengths, points[:, 0]), np.interp(wanted, lengths, points[:, 1])])


def directions(points: Floats) -> Floats:
    """Unit tangents (N, 2) of a polyline, central differences inside."""
    tangents = np.empty_like(points)
    tangents[1:-1] = points[2:] - points[:-2]
    tangents[0], tangents[-1] = points[1] - points[0], points[-1] - points[-2]
    length = np.hypot(tangents[:, 0], tangents[:, 1])
    unit: Floats = tangents / np.maximum(length, 1e-12)[:, None]
    return unit


def end_direction(points: Floats, reach: float) -> Floats:
    """Unit vector (2,) out of the last point, taken over the last `reach` of length."""
    lengths = arc_length(points)
    back = max(int(np.searchsorted(lengths, lengths[-1] - reach, side="right")) - 1, 0)
    step: Floats = points[-1] - points[min(back, len(points) - 2)]
    unit: Floats = step / max(float(np.hypot(*step)), 1e-12)
    return unit


def sharpened(points: Floats, width: float) -> Floats:
    """Put back corners that were cut: two straight arms at more than 45 degrees are prolonged to their crossing.

    A curve is none: if its radius is above 3.6 widths it turns less between the arms, and if it is below, the arms
    bend by more than a twentieth of the width.
    """
    lengths = arc_length(points)
    spacing = float(lengths[-1]) / (len(points) - 1)
    near, far = max(round(0.8 * width / spacing), 1), max(round(2.0 * width / spacing), 3)
    least = max(round(0.6 * width / spacing), 2)
    done: list[int] = []
    n = len(points)
    if n < 2 * (near + least) + 1:
        return points
    middle = np.arange(near + least, n - near - least)
    start, stop = np.maximum(middle - far, 0), np.minimum(middle + far, n - 1)
    one, two = points[middle - near] - points[start], points[stop] - points[middle + near]
    dot = (one * two).sum(axis=1)
    cross = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    turn = np.abs(np.arctan2(cross, dot))
    order = np.argsort(-turn, kind="stable")
    cuts: list[tuple[int, int, Floats]] = []
    for k in order:
        if turn[k] < SHARP:
            break
        i = int(middle[k])
        if any(abs(i - other) < far for other in done):
            continue
        done.append(i)
        a, b, c, d = int(start[k]), i - near, i + near, int(stop[k])
        if _bow(points[a : b + 1]) > 0.06 * width or _bow(points[c : d + 1]) > 0.06 * width:
            continue
        matrix = np.column_stack([one[k], two[k]])
        ahead, behind = np.linalg.solve(matrix, points[c] - points[b])
        corner = points[b] + ahead * one[k]
        if ahead > 0.0 and behind > 0.0 and np.hypot(*(corner - points[i])) < 1.2 * width:
            cuts.append((b, c, corner))
    for b, c, corner in sorted(cuts, key=lambda cut: -cut[0]):
        first = int(np.hypot(*(corner - points[b])) / spacing) + 1
        second = int(np.hypot(*(points[c] - corner)) / spacing) + 1
        into = points[b] + np.linspace(0.0, 1.0, first + 1)[1:, None] * (corner - points[b])
        out = corner + np.linspace(0.0, 1.0, second + 1)[1:-1, None] * (points[c] - corner)
        points = np.vstack([points[: b + 1], into, out, points[c:]])
    return points


def _bow(points: Floats) -> float:
    """Greatest distance of points (N, 2) from the straight way from the first to the last."""
    chord = points[-1] - points[0]
    size = max(float(np.hypot(*chord)), 1e-12)
    away = points - points[0]
    return float(np.abs(away[:, 0] * chord[1] - away[:, 1] * chord[0]).max()) / size
