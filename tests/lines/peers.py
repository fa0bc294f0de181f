"""Rival methods, each given the same as ours: the picture, where it is valid, the line's colour and its width.

Every method takes a scene, of which it must not read the truth, and returns lines. The first are the common ones that
the thesis compares with (its section 7.4.5), each with the help it needs to return centre-lines at all; pairs of LSD
segments at the line's width are the best public method that was found.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from robotd.records import Line
from robotd.vision.polyline import arc_length, directions, resample
from robotd.vision.stroke import LineConfig, LineDetector

from .paths import Floats
from .scenes import Scene

Bytes = NDArray[np.uint8]
Method = Callable[[Scene], list[Line]]

FIXED = {"dark": 80.0, "bright": 170.0}  # grey levels: best over the mild scenes


def fixed_threshold(scene: Scene) -> list[Line]:
    """Everything darker (brighter) than a fixed grey level, thinned."""
    level = FIXED[scene.polarity]
    return _thinned(scene, (scene.image < level) if scene.polarity == "dark" else (scene.image > level))


def otsu(scene: Scene) -> list[Line]:
    """The same with Otsu's threshold of this picture."""
    image = scene.image
    seen = image[scene.valid] if scene.valid is not None else image.ravel()
    level, _ = cv2.threshold(seen.reshape(1, -1), 0.0, 255.0, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return _thinned(scene, (image <= level) if scene.polarity == "dark" else (image > level))


def _thinned(scene: Scene, mask: NDArray[np.bool_]) -> list[Line]:
    """Centre-lines of the mask's components: the longest way through each one's skeleton, if the width fits."""
    low, high = scene.width_px
    w = math.sqrt(low * high)
    if scene.valid is not None:
        mask = mask & scene.valid
    scale = min(1.0, 10.0 / w)
    size = [max(round(side * scale), 1) for side in mask.shape[::-1]]
    small = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_AREA) > 127
    count, labels, stats, _ = cv2.connectedComponentsWithStats(small.astype(np.uint8), connectivity=8)
    radius = cv2.distanceTransform(np.pad(small, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    skeleton = _skeleton(small)
    lines = []
    for label in np.argsort(-stats[1:, cv2.CC_STAT_AREA])[:40] + 1 if count > 1 else []:
        v, u = np.nonzero(skeleton & (labels == label))
        if len(u) < 3.0 * w * scale:
            continue
        width = 2.0 * float(np.median(radius[v, u])) / scale
        if not low <= width <= high:
            continue
        for way in _ways(np.column_stack([u, v])):
            points = (way + 0.5) / scale - 0.5
            if len(points) > 2 and arc_length(points)[-1] >= 3.0 * w:
                smooth = np.column_stack([np.convolve(np.pad(c, 2, "edge"), np.ones(5) / 5, "valid") for c in points.T])
                lines.append(Line(smooth, width, 1.0))
    return lines


def _skeleton(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Thinning by Zhang and Suen (Communications of the ACM 27(3), 1984)."""
    image = np.pad(mask, 1).astype(np.uint8)
    changed = True
    while changed:
        changed = False
        for step in (0, 1):
            p = [np.roll(image, shift, (0, 1)) for shift in _AROUND]
            neighbours = sum(part.astype(np.int8) for part in p)
            turns = sum(((p[k] == 0) & (p[(k + 1) % 8] == 1)).astype(np.int8) for k in range(8))
            one, two = (
                (p[0] & p[2] & p[4], p[2] & p[4] & p[6]) if step == 0 else (p[0] & p[2] & p[6], p[0] & p[4] & p[6])
            )
            gone = (image == 1) & (neighbours >= 2) & (neighbours <= 6) & (turns == 1) & (one == 0) & (two == 0)
            if gone.any():
                image[gone] = 0
                changed = True
    return np.asarray(image[1:-1, 1:-1] > 0)


_AROUND = ((1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1))


def _ways(cells: NDArray[np.int64]) -> list[Floats]:
    """The longest way (N, 2) through connected cells, then the longest through what it leaves, up to three."""
    ways: list[Floats] = []
    while len(cells) > 2 and len(ways) < 3:
        number = {(int(u), int(v)): k for k, (u, v) in enumerate(cells)}
        links = [
            (k, number[u + du, v + dv], math.hypot(du, dv))
            for (u, v), k in number.items()
            for du, dv in ((1, 0), (0, 1), (1, 1), (1, -1))
            if (u + du, v + dv) in number
        ]
        if not links:
            break
        i, j, length = (np.array(column) for column in zip(*links, strict=True))
        graph = coo_array((length, (i, j)), shape=(len(cells), len(cells))).tocsr()
        far = dijkstra(graph, directed=False, indices=0)
        start = int(np.argmax(np.where(np.isinf(far), -1.0, far)))
        far, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
        at = int(np.argmax(np.where(np.isinf(far), -1.0, far)))
        way = [at]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        ways.append(cells[way].astype(np.float64))
        cells = np.delete(cells, way, axis=0)
    return ways


def canny_hough(scene: Scene) -> list[Line]:
    """Straight segments of Canny edges by the probabilistic Hough transform, as they come: borders, not centres."""
    return [Line(segment, math.sqrt(math.prod(scene.width_px)), 1.0) for segment in _hough(scene)]


def _hough(scene: Scene) -> Floats:
    w = math.sqrt(math.prod(scene.width_px))
    edges = cv2.Canny(cv2.GaussianBlur(scene.image, (5, 5), 0), 50, 150)
    if scene.valid is not None:
        edges[cv2.erode(scene.valid.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0] = 0
    threshold = max(round(2.0 * w), 20)
    found = cv2.HoughLinesP(edges, 1, math.pi / 180.0, threshold, minLineLength=2.0 * w, maxLineGap=0.5 * w)
    return np.asarray([] if found is None else found, dtype=np.float64).reshape(-1, 2, 2)


def lsd(scene: Scene) -> list[Line]:
    """Segments of OpenCV's line segment detector, as they come."""
    return [Line(segment, math.sqrt(math.prod(scene.width_px)), 1.0) for segment in _lsd(scene, 2.0)]


def _lsd(scene: Scene, least: float) -> Floats:
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(scene.image)[0]
    segments = np.asarray([] if found is None else found, dtype=np.float64).reshape(-1, 2, 2)
    w = math.sqrt(math.prod(scene.width_px))
    segments = segments[np.hypot(*(segments[:, 1] - segments[:, 0]).T) >= least * w]
    if scene.valid is not None and len(segments):
        inner = cv2.erode(scene.valid.astype(np.uint8), np.ones((9, 9), np.uint8))
        at = np.clip(np.rint(segments.mean(axis=1)).astype(int), 0, np.array(inner.shape[::-1]) - 1)
        segments = segments[inner[at[:, 1], at[:, 0]] > 0]
    return segments


def hough_pairs(scene: Scene) -> list[Line]:
    """Pairs of Hough segments that lie beside each other at the line's width."""
    return _paired(scene, _hough(scene))


def lsd_pairs(scene: Scene) -> list[Line]:
    """Pairs of LSD segments that lie beside each other at the line's width."""
    return _paired(scene, _lsd(scene, 0.7))


def _paired(scene: Scene, segments: Floats) -> list[Line]:
    """Centre-lines between parallel segments (K, 2, 2) at line width, of the right colour, in chains of 3 widths."""
    if len(segments) < 2:
        return []
    segments = segments[np.argsort(-np.hypot(*(segments[:, 1] - segments[:, 0]).T))[:600]]
    low, high = scene.width_px
    w = math.sqrt(low * high)
    step = segments[:, 1] - segments[:, 0]
    unit = step / np.hypot(step[:, 0], step[:, 1])[:, None]
    i, j = np.nonzero(np.triu(np.abs(unit @ unit.T) > math.cos(math.radians(10.0)), 1))
    axis = unit[i] + np.sign((unit[i] * unit[j]).sum(axis=1))[:, None] * unit[j]
    axis /= np.hypot(axis[:, 0], axis[:, 1])[:, None]
    normal = np.column_stack([-axis[:, 1], axis[:, 0]])
    apart = ((segments[j].mean(axis=1) - segments[i].mean(axis=1)) * normal).sum(axis=1)
    ends = [np.sort((segments[k] * axis[:, None]).sum(axis=2), axis=1) for k in (i, j)]
    start, stop = np.maximum(ends[0][:, 0], ends[1][:, 0]), np.minimum(ends[0][:, 1], ends[1][:, 1])
    shorter = np.minimum(ends[0][:, 1] - ends[0][:, 0], ends[1][:, 1] - ends[1][:, 0])
    fits = (np.abs(apart) >= low) & (np.abs(apart) <= high) & (stop - start > 0.5 * shorter) & (stop - start > 0.5 * w)
    across = 0.5 * ((segments[i].mean(axis=1) + segments[j].mean(axis=1)) * normal).sum(axis=1)
    pieces = []
    for k in np.flatnonzero(fits)[np.argsort(-(stop - start)[fits])]:
        ways = np.array([start[k], stop[k]])
        points = ways[:, None] * axis[k] + across[k] * normal[k]
        middle = points.mean(axis=0)
        if any(_distance(middle, other.points) < 0.5 * w for other in pieces):
            continue
        if _has_colour(scene, points, float(abs(apart[k]))):
            pieces.append(Line(points, float(abs(apart[k])), 1.0))
    return _long_chains(pieces, w)


def _distance(point: Floats, segment: Floats) -> float:
    step = segment[1] - segment[0]
    share = float(np.clip((point - segment[0]) @ step / (step @ step), 0.0, 1.0))
    return float(np.hypot(*(point - segment[0] - share * step)))


def _has_colour(scene: Scene, points: Floats, width: float) -> bool:
    """Whether the strip around a centre-line differs from both its sides by 15 grey levels, to the right side."""
    along = resample(points, max(0.25 * width, 1.0))
    tangent = directions(along)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    greys = []
    for across in (-0.8, 0.0, 0.8):
        at = np.rint(along + across * width * normal).astype(int)
        at = np.clip(at, 0, np.array(scene.image.shape[::-1]) - 1)
        greys.append(float(np.median(scene.image[at[:, 1], at[:, 0]])))
    sign = 1.0 if scene.polarity == "dark" else -1.0
    return min(sign * (greys[0] - greys[1]), sign * (greys[2] - greys[1])) > 15.0


def _long_chains(pieces: list[Line], w: float) -> list[Line]:
    """The pieces of chains that are at least 3 widths long in all; ends closer than 2 widths are linked."""
    if not pieces:
        return []
    ends = np.array([piece.points for piece in pieces])
    gaps = np.hypot(*(ends[:, None, :, None] - ends[None, :, None, :]).transpose(4, 0, 1, 2, 3)).min(axis=(2, 3))
    _, labels = connected_components(coo_array(gaps < 2.0 * w), directed=False)
    lengths = np.array([arc_length(piece.points)[-1] for piece in pieces])
    total = np.bincount(labels, weights=lengths)
    return [piece for piece, label in zip(pieces, labels, strict=True) if total[label] >= 3.0 * w]


class Ours:
    """`robotd.vision.stroke`, with the width as told or `any_width`; detectors are kept, as on the robot."""

    def __init__(self, *, any_width: bool = False, both: bool = False, **options: object) -> None:
        self._any_width, self._both, self._options = any_width, both, options
        self._detectors: dict[LineConfig, LineDetector] = {}

    def __call__(self, scene: Scene) -> list[Line]:
        width = None if self._any_width else tuple(round(value, 1) for value in scene.width_px)
        config = LineConfig("both" if self._both else scene.polarity, width, **self._options)  # type: ignore[arg-type]
        if config not in self._detectors:
            self._detectors[config] = LineDetector(config)
        return self._detectors[config].detect(scene.image, scene.valid)


METHODS: dict[str, Method] = {
    "robotd": Ours(),
    "robotd any width": Ours(any_width=True),
    "robotd both colours": Ours(both=True),
    "fixed threshold": fixed_threshold,
    "Otsu": otsu,
    "Canny+Hough": canny_hough,
    "Hough pairs": hough_pairs,
    "LSD": lsd,
    "LSD pairs": lsd_pairs,
}
if "variant" in {field.name for field in dataclasses.fields(LineConfig)}:
    METHODS["thesis"] = Ours(variant="thesis")
