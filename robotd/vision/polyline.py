"""Polylines: arc length, resampling, directions, joining of ends, and the extension to a border."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..records import Floats


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


def bridge(first: Floats, second: Floats, width: float) -> Floats | None:
    """What joins the end of one polyline to the start of another of the same width, or None if they do not belong.

    Two ends belong together when they face each other over a gap of at most 2 widths, or when both, prolonged, meet
    in a corner at most 2 widths ahead: the outer border of a corner has no partner, so strokes end before it.

    Returns
    -------
    (K, 2) array of the points between: none for a gap, the corner's point for a corner.
    """
    gap = second[0] - first[-1]
    distance = float(np.hypot(*gap))
    if distance > 3.0 * width:
        return None
    out = end_direction(first, width)
    into = -end_direction(second[::-1], width)
    facing = float(out @ into)
    if distance < 1e-9:
        return np.empty((0, 2)) if facing > 0.5 else None
    if facing > 0.9 and min(out @ gap, into @ gap) > 0.9 * distance and distance <= 2.25 * width:
        return np.empty((0, 2))
    if abs(facing) > 0.87:  # nearly parallel: their crossing is not a corner
        return None
    ahead, behind = np.linalg.solve(np.column_stack([out, into]), gap)
    if not (-0.75 * width <= ahead <= 2.0 * width and -0.75 * width <= behind <= 2.0 * width):
        return None
    corner: Floats = first[-1] + ahead * out
    return corner[None]


def cut_back(points: Floats, corner: Floats) -> Floats:
    """The polyline without what lies beyond the foot of `corner` at its last end; at least two points remain."""
    out = end_direction(points, float(np.hypot(*(points[-1] - points[0]))) + 1e-9)
    keep = (points - corner) @ out < 0.0
    count = max(int(np.flatnonzero(keep)[-1]) + 1 if keep.any() else 2, 2)
    return points[:count]


def extend(points: Floats, valid: NDArray[np.uint8], reach: float) -> Floats:
    """Prolong the last end straight on if it meets the border of the valid area within `reach` pixels."""
    out = end_direction(points, reach)
    steps = np.arange(1.0, reach + 1.0)
    ahead = points[-1] + steps[:, None] * out
    cells = np.floor(ahead + 0.5).astype(int)
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < valid.shape[1]) & (cells[:, 1] < valid.shape[0])
    usable = np.zeros(len(steps), dtype=bool)
    usable[inside] = valid[cells[inside, 1], cells[inside, 0]] > 0
    if usable.all() or not usable[0]:
        return points
    return np.vstack([points, ahead[int(np.argmin(usable)) - 1]])
