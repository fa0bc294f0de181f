"""The tape's centre line: straight pieces and rounded corners, parametrised by arc length."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import ConfigError
from ..records import Floats

Point = tuple[float, float]

JOINT = -1.0
SAMPLE = 0.01  # m between the points of the dense polyline; a chord of a 0.2 m corner is then 0.06 mm off its arc


@dataclass(frozen=True, slots=True, eq=False)
class TapePiece:
    """A straight or evenly curved piece of the line with the corners of its bounding box.

    `ends` says what happens beyond its first and last point: None: the tape ends there; JOINT: another piece goes on
    smoothly; else a sharp corner, where the tape's end reaches so many half widths over the corner.
    """

    start: Floats
    heading: float
    curvature: float
    length: float
    ends: tuple[float | None, float | None]
    low: Floats
    high: Floats

    def edge_distance(self, x: Floats, y: Floats, half: float) -> Floats:
        """Signed distance in metres from the edge of tape `half` metres to each side; negative on it, inf where it is
        another piece's matter."""
        dx, dy = x - self.start[0], y - self.start[1]
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        along, left = cos * dx + sin * dy, cos * dy - sin * dx
        if self.curvature:
            radius = 1.0 / abs(self.curvature)
            inward = radius - math.copysign(1.0, self.curvature) * left  # towards the piece from its centre
            across = np.abs(np.hypot(along, inward) - radius)
            along = radius * np.arctan2(along, inward)
        else:
            across = np.abs(left)
        distance = across - half
        for excess, end in zip((-along, along - self.length), self.ends, strict=True):
            if end is None:
                distance = np.maximum(distance, excess)
            elif end == JOINT:
                distance = np.where(excess > 1e-9, np.inf, distance)
            else:
                distance = np.where(excess > 1e-9, np.maximum(distance, excess - end * half), distance)
        return np.asarray(distance)


class LineGeometry:
    """A polyline whose corners are arcs of one radius.

    Arc length 0 is at the first point. On a closed line with rounded corners, where the tape cuts that corner, it is
    where the first straight piece begins, so that a robot there heads along the first segment whatever the radius.

    Parameters
    ----------
    points : sequence of (x, y)
        Corners in metres, at least two (three if closed).
    closed : bool
        Whether the last point joins the first.
    corner_radius : float
        Of every corner in metres; 0 leaves sharp corners.

    Attributes
    ----------
    length : float
        Of the whole line in metres.
    points, arc_lengths : (N, 2) and (N,) array
        The dense polyline, at most 10 mm apart; a closed line repeats its first point at the end.

    Raises
    ------
    ConfigError
        Too few points, repeated points, or a corner that its radius does not fit; names the key.
    """

    def __init__(self, points: Sequence[Point], *, closed: bool, corner_radius: float) -> None:
        self.closed = closed
        self._pieces = _pieces(points, closed, corner_radius)  # rows of the columns below
        self.length = float(self._pieces[-1, 0] + self._pieces[-1, 5])
        knots = [
            np.linspace(0.0, length, max(2, math.ceil(length / SAMPLE) + 1))[:-1] + s
            for s, _, _, _, _, length, _, _ in self._pieces
        ]
        self.arc_lengths = np.append(np.concatenate(knots), self.length)
        last = self._pieces[-1]
        self.points = np.vstack([self.point_at(self.arc_lengths[:-1]), _along(last, last[5])])

    def _locate(self, s: Floats) -> tuple[Floats, Floats]:
        wrapped = np.mod(s, self.length) if self.closed else np.clip(s, 0.0, self.length)
        index = np.clip(np.searchsorted(self._pieces[:, 0], wrapped, side="right") - 1, 0, len(self._pieces) - 1)
        pieces = self._pieces[index]
        return pieces, wrapped - pieces[..., 0]

    def point_at(self, s: float | Floats) -> Floats:
        """(..., 2) x, y at arc length `s`: modulo the length of a closed line, held at the ends of an open one."""
        pieces, ahead = self._locate(np.asarray(s, dtype=float))
        return _along(pieces, ahead)

    def heading_at(self, s: float | Floats) -> Floats:
        """Direction of travel at arc length `s` in radians, wrapped to (-pi, pi]."""
        pieces, ahead = self._locate(np.asarray(s, dtype=float))
        angle = pieces[..., 3] + pieces[..., 4] * ahead
        return np.asarray(np.pi - np.mod(np.pi - angle, 2 * np.pi))

    def nearest(self, points: Floats) -> tuple[Floats, Floats]:
        """Project points onto the line.

        Parameters
        ----------
        points : (..., 2) array
            x, y in metres.

        Returns
        -------
        offset, arc_length : (...) arrays
            Distance from the line in metres, positive on its left, and where on it the nearest point lies.
        """
        points = np.asarray(points, dtype=float)
        start, step = self.points[:-1], np.diff(self.points, axis=0)
        square = np.einsum("ij,ij->i", step, step)
        flat = points.reshape(-1, 2)
        offsets, lengths = np.empty(len(flat)), np.empty(len(flat))
        block = max(1, 200_000 // len(start))
        for first in range(0, len(flat), block):
            rows = slice(first, first + block)
            away = flat[rows, None] - start
            share = np.clip(np.einsum("nij,ij->ni", away, step) / square, 0.0, 1.0)
            gap = np.hypot(*np.moveaxis(away - share[..., None] * step, -1, 0))
            best = np.argmin(gap, axis=1)
            k = np.arange(len(best))
            side = step[best, 0] * away[k, best, 1] - step[best, 1] * away[k, best, 0]
            offsets[rows] = np.copysign(gap[k, best], side)
            lengths[rows] = self.arc_lengths[best] + share[k, best] * np.sqrt(square[best])
        return offsets.reshape(points.shape[:-1]), lengths.reshape(points.shape[:-1])

    def tape(self) -> Iterator[TapePiece]:
        """The line in pieces of at most one metre, in order."""
        for _, x, y, heading, curvature, length, first, last in self._pieces:
            count = max(1, math.ceil(length))
            row = np.array([0.0, x, y, heading, curvature])
            for k in range(count):
                points = _along(row, length * np.linspace(k, k + 1, 9) / count)
                ends = (first if k == 0 else JOINT), (last if k == count - 1 else JOINT)
                yield TapePiece(
                    points[0],
                    heading + curvature * length * k / count,
                    curvature,
                    length / count,
                    (None if math.isnan(ends[0]) else ends[0], None if math.isnan(ends[1]) else ends[1]),
                    points.min(axis=0),
                    points.max(axis=0),
                )

    def distance(self, points: Floats) -> Floats:
        """(...) distances in metres of (..., 2) points from the line."""
        return np.abs(self.nearest(points)[0])


def _along(piece: Floats, ahead: float | Floats) -> Floats:
    """Points `ahead` metres into pieces of constant curvature."""
    x, y, heading, curvature = piece[..., 1], piece[..., 2], piece[..., 3], piece[..., 4]
    turn = curvature * ahead
    chord = ahead * np.sinc(turn / (2 * np.pi))
    middle = heading + turn / 2
    return np.stack([x + chord * np.cos(middle), y + chord * np.sin(middle)], axis=-1)


def _pieces(points: Sequence[Point], closed: bool, radius: float) -> Floats:
    """Rows of s, x, y, heading, curvature, length, and the two `ends` of TapePiece (NaN for None)."""
    corners = np.asarray(points, dtype=float).reshape(-1, 2)
    count = len(corners)
    if count < (3 if closed else 2):
        raise ConfigError(f"points: found {count} points; expected at least {'3 on a closed line' if closed else '2'}")
    steps = (np.roll(corners, -1, axis=0) if closed else np.vstack([corners[1:], corners[-1:]])) - corners
    steps = steps if closed else steps[:-1]
    lengths = np.hypot(*steps.T)
    if lengths.min() < 1e-3:
        index = (int(np.argmin(lengths)) + 1) % count
        raise ConfigError(f"points[{index}]: found the same point as before it; expected another one")
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    turns = np.zeros(count)  # at the corner before each segment
    for k in range(0 if closed else 1, len(steps)):
        turns[k] = math.remainder(headings[k] - headings[k - 1], 2 * math.pi)
    cut = np.zeros(count)  # how much of the segments on both sides a corner's arc replaces
    problems = []
    for k, turn in enumerate(turns):
        if abs(turn) > math.radians(175):
            problems.append(f"points[{k}]: found a turn back on itself; expected a turn of at most 175 degrees")
        else:
            cut[k] = radius * math.tan(abs(turn) / 2)
    for k, length in enumerate(lengths):
        if cut[k] + cut[(k + 1) % count] > length + 1e-9:
            problems.append(
                f"corner_radius: found {radius:g}; expected a radius whose arcs fit between points[{k}] and "
                f"points[{(k + 1) % count}], {length:.3f} m apart"
            )
    if problems:
        raise ConfigError(*problems)
    # how far the tape reaches over each sharp corner, in half widths: its edges meet up to a right angle
    over = np.where((cut > 1e-9) | (np.abs(turns) < 1e-6), JOINT, np.minimum(np.tan(np.abs(turns) / 2), 1.0))
    if not closed:
        over[[0, -1]] = np.nan
    rows = []
    s = 0.0
    for k, (heading, length) in enumerate(zip(headings, lengths, strict=True)):
        after = (k + 1) % count
        direction = np.array([math.cos(heading), math.sin(heading)])
        straight = length - cut[k] - cut[after]
        if straight > 1e-9:
            rows.append([s, *(corners[k] + cut[k] * direction), heading, 0.0, straight, over[k], over[after]])
            s += straight
        if cut[after] > 1e-9:
            arc = radius * abs(turns[after])
            start = corners[k] + (length - cut[after]) * direction
            rows.append([s, *start, heading, math.copysign(1 / radius, turns[after]), arc, JOINT, JOINT])
            s += arc
    return np.array(rows)


def distance_to_segment(points: Floats, start: Point, end: Point) -> Floats:
    """(N,) distances in metres of (N, 2) points from the segment between two points."""
    a, step = np.array(start), np.subtract(end, start)
    square = max(float(step @ step), 1e-12)
    share = np.clip((points - a) @ step / square, 0.0, 1.0)
    return np.asarray(np.hypot(*(points - a - share[:, None] * step).T))


def distance_to_box(points: Floats, box: tuple[float, float, float, float]) -> Floats:
    """(N,) distances in metres of (N, 2) points from the box x0, y0, x1, y1; 0 inside."""
    outside = np.maximum(np.maximum(np.array(box[:2]) - points, points - np.array(box[2:])), 0.0)
    return np.asarray(np.hypot(*outside.T))
