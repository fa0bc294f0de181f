"""Squares and dots on the floor beside the line, found by the same strokes as lines are: thesis section 7.4.3.

A mark has opposite borders at its own width in more than one direction, so the strokes across it meet in one place
and run in all directions; those of a line run in one direction along it. The thesis filters marks away by their length;
here they are what is looked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Pose
from . import stroke_reference
from .cluster import dbscan
from .line_sight import from_robot
from .stroke import MUTUAL, PARALLEL, THRESHOLD_FACTOR, THRESHOLD_HIGH, THRESHOLD_LOW
from .top_view import TopView

try:
    from . import _stroke as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    kernels = stroke_reference  # type: ignore[misc]

Bytes = NDArray[np.uint8]

WORKING = 10.0  # px of the mark in the reduced picture, about
TOLERANCE = 0.30  # of its size
COMPACT = 0.75  # of its size: farthest that a stroke's middle may be from the mark's
MOST_ALIGNED = 0.55  # length of the mean doubled direction: 1 for a line, 0 for a dot
LEAST_STROKES = 0.9  # times its size in working pixels: a whole square gives twice its side
SAME = 0.05  # m between sights of one mark
CONFIRMED = 4  # frames that must show it
MISSES = 6  # frames in a row without it that end an unconfirmed one


class MarkFinder:
    """Finds marks in top views; keeps its buffers from frame to frame.

    Parameters
    ----------
    view : TopView
    size : float
        Side of the squares, or diameter of the dots, in metres.
    color : "dark", "bright" or "both"
        Of the marks against the floor.
    """

    def __init__(self, view: TopView, size: float, color: str) -> None:
        self._view = view
        width = size / view.metres_per_pixel
        self._reduce = max(1, int(width / WORKING))
        self._width = width / self._reduce
        self._signs = {"dark": (-1.0,), "bright": (1.0,)}.get(color, (-1.0, 1.0))
        height, columns = (side // self._reduce for side in view.valid.shape)
        shape = height, columns
        part = view.valid[: height * self._reduce, : columns * self._reduce].astype(np.uint8)
        shown = cv2.resize(part, (columns, height), interpolation=cv2.INTER_NEAREST)
        # because blur and gradient reach 3 px
        eroded = cv2.erode(shown, np.ones((7, 7), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        self._valid = np.asarray(eroded, dtype=np.uint8)
        self._level = np.empty((1, 3), np.float32)  # one threshold for all
        self._index = np.empty(shape, np.int32)
        self._sector = np.empty(shape, np.uint8)
        most = max(height * columns // 4, 64)
        self._edge = np.empty((most, 5), np.float32)
        self._partner = np.empty(most, np.int32)
        self._stroke = np.empty((most, 6), np.float32)

    def find(self, top: Bytes) -> Floats:
        """Middles (N, 2) of the marks in a top view, in robot axes, metres."""
        reduce = self._reduce
        height, width = self._index.shape
        grey = top[: height * reduce, : width * reduce]
        if reduce > 1:
            grey = np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        blurred = cv2.GaussianBlur(grey, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE)
        gx, gy = (np.asarray(part, dtype=np.int16) for part in cv2.spatialGradient(blurred))
        count, _ = kernels.edges(
            gx, gy, self._valid, THRESHOLD_FACTOR, THRESHOLD_LOW, THRESHOLD_HIGH,
            self._level, self._index, self._sector, self._edge,
        )  # fmt: skip
        low, high = self._width * (1.0 - TOLERANCE), self._width * (1.0 + TOLERANCE)
        marks = [np.empty((0, 2))]
        for sign in self._signs:
            found = kernels.strokes(
                self._edge, count, self._index, self._sector, low, high, sign, PARALLEL, MUTUAL,
                self._partner, self._stroke,
            )  # fmt: skip
            marks.append(self._marks(self._stroke[:found].astype(np.float64)))
        middles = np.vstack(marks) * reduce + 0.5 * (reduce - 1)
        return self._view.to_robot(middles)

    def _marks(self, stroke: Floats) -> Floats:
        """Middles (N, 2) in working pixels of strokes that meet in one place and run in all directions."""
        if len(stroke) < LEAST_STROKES * self._width:
            return np.empty((0, 2))
        labels, _ = dbscan(np.ascontiguousarray(stroke[:, :2]), max(0.3 * self._width, 1.5), 3)
        middles = []
        for label in range(int(labels.max()) + 1):
            part = stroke[labels == label]
            low, high = part[:, :2].min(axis=0), part[:, :2].max(axis=0)
            middle = np.median(part[:, :2], axis=0)
            reach = np.hypot(*(part[:, :2] - middle).T).max()
            doubled = (part[:, 2] + 1j * part[:, 3]) ** 2
            aligned = abs(np.mean(doubled / np.maximum(np.abs(doubled), 1e-9)))
            enough = len(part) >= LEAST_STROKES * self._width
            if enough and reach <= COMPACT * self._width and aligned <= MOST_ALIGNED:
                middles.append(0.5 * (low + high))
        return np.array(middles).reshape(-1, 2)


@dataclass(slots=True, eq=False)
class Mark:
    """One mark in odometry axes."""

    position: Floats
    seen: int = 1
    missed: int = 0


class MarkTracker:
    """Remembers the marks beside the line; those confirmed by several frames count."""

    def __init__(self) -> None:
        self._marks: list[Mark] = []

    def forget(self) -> None:
        """Forget all marks."""
        self._marks = []

    def observe(self, found: Floats, pose: Pose) -> None:
        """Take the marks (N, 2) of one frame, in the axes of the robot at `pose` (odometry axes)."""
        fresh = list(from_robot(found, pose)) if len(found) else []
        for mark in self._marks:
            mark.missed += 1
        for position in fresh:
            near = min(self._marks, key=lambda mark: float(np.hypot(*(mark.position - position))), default=None)
            if near is not None and float(np.hypot(*(near.position - position))) < SAME:
                near.seen += 1
                near.missed = 0
                near.position = near.position + (position - near.position) / min(near.seen, 8)
            else:
                self._marks.append(Mark(position))
        self._marks = [mark for mark in self._marks if mark.seen >= CONFIRMED or mark.missed < MISSES][-32:]

    def beside(self, path: Floats, lengths: Floats, reach: tuple[float, float]) -> list[float]:
        """Arc lengths, in order, at which confirmed marks lie beside a path.

        Parameters
        ----------
        path, lengths : (N, 2) and (N,) arrays
            The line, odometry axes, with its arc lengths.
        reach : (least, greatest)
            Metres from the line's middle to a mark's.
        """
        places: Sequence[float] = ()
        if len(path) >= 2:
            places = sorted(
                float(lengths[best])
                for mark in self._marks
                if mark.seen >= CONFIRMED
                for away in (np.hypot(*(path - mark.position).T),)
                for best in (int(away.argmin()),)
                if reach[0] <= away[best] <= reach[1] and 0 < best < len(path) - 1
            )
        return list(places)
