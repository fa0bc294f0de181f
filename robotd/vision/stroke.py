"""Find lines of constant width in a top view of the floor by the strokes between their opposite edges.

Thesis section 5.2.3 and its paper, mended (errata B9-B16). A line is bounded by two edges at a constant distance whose
gradients oppose each other. From every thin edge pixel we walk along the gradient to an opposite edge; pairs that find
each other give a stroke, of which only the centre is kept. Centres that agree in place, width and direction are
clustered by density, traced into polylines, joined over gaps and corners, and judged (`evidence.py`). What may be a
line is followed on from its ends for as long as both borders go on, and judged again. Those accepted are measured at
full resolution, border by border. There is no split into start and end pixels, so
all orientations are equal. The image is reduced so that the line is 8 to 28 pixels wide: texture finer than that
disappears, and the cost does not grow with the line's width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line
from . import join_reference, measure_reference, polyline_reference, stroke_reference
from .cluster import dbscan, kernels as clustering
from .evidence import SUPPORTED, believed, confidence, without_doubles
from .polyline import SHARP, sharpened
from .thesis_line import detect_thesis

try:
    from . import _join as joining, _measure as measuring, _polyline as tracing, _stroke as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    kernels = stroke_reference  # type: ignore[misc]
    joining = join_reference  # type: ignore[misc]
    tracing = polyline_reference  # type: ignore[misc]
    measuring = measure_reference  # type: ignore[misc]

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]

THRESHOLD_FACTOR = 1.8  # times the mean gradient of the frame; clipped to the two below
THRESHOLD_LOW = 24.0  # Sobel units (8 per grey level a pixel): a step of 10 grey levels, blurred
THRESHOLD_HIGH = 110.0
PARALLEL = math.cos(math.radians(28.0))  # tape tapers, tight curves bend: the later steps decide
ALIGNED = math.cos(math.radians(35.0))  # strokes of one window of a trace against its direction
MUTUAL = 0.4  # widths between an edge and the return of its partner's walk
LEVEL_SPAN = 3.0  # greatest ratio of widths searched at one scale
STROKE_SPAN = 3.0  # ratio of stroke widths up to which strokes beyond the given range count: in tilted views parts of
MOST_TAPER = 1.35  # a line are wider or narrower than the line is on the whole, by up to this factor
LEAST_LENGTH = 0.8  # widths of a piece worth joining or judging
MOST_SPREAD = 0.16  # of the stroke width: beyond it no other evidence makes up for it
MOST_CLUSTERS = 32  # the largest, that are traced at one scale
MOST_PIECES = 48  # that are traced at one scale
PROMISING = 0.03  # confidence from which a piece is followed beyond its ends
# Plain weights, because Mahalanobis's (thesis 8.2.4) were no better: width and direction of neighbouring strokes are
# hardly correlated (|r| < 0.04), and at four scales F1 was 0.953 to 0.960 against 0.959 on 60 scenes.
WIDTH_WEIGHT = 4.0  # 28 % of width weighs as much as half a width of distance
TURN_WEIGHT = 0.9  # of the doubled angle
CURVATURE_REACH = 3.0  # widths of line over which the curvature is fitted
WIDTH_ERROR = 0.5  # px of the width measured last, where blur and noise are great
WIDEST = 2.5  # share of the view's shorter side that a line of unknown width may take, as a divisor
WORKING_WIDTH = 9.0  # px of the line after reduction, at least
LARGE_VIEW = 150_000  # px; above it a line may also be halved to
LARGE_WIDTH = 6.25  # px, because the cost goes with the area


@dataclass(frozen=True, slots=True)
class LineConfig:
    """What to look for.

    Attributes
    ----------
    polarity : "dark", "bright" or "both"
        Of the line against the floor.
    width_px : (least, greatest) in pixels of the given image, or None to search all plausible widths.
    min_confidence : float
        Lines below it are returned only if one above it has their width and colour (`evidence.believed`).
    variant : "robotd" or "thesis"
        Ours, or the thesis's own (`thesis_line.py`), the baseline.
    """

    polarity: Literal["dark", "bright", "both"] = "dark"
    width_px: tuple[float, float] | None = None
    min_confidence: float = 0.4
    variant: Literal["robotd", "thesis"] = "robotd"

    def __post_init__(self) -> None:
        if self.polarity not in ("dark", "bright", "both"):
            raise ValueError(f"polarity = {self.polarity!r}; expected 'dark', 'bright' or 'both'")
        if self.variant not in ("robotd", "thesis"):
            raise ValueError(f"variant = {self.variant!r}; expected 'robotd' or 'thesis'")
        if self.width_px is not None and not 1.0 <= self.width_px[0] <= self.width_px[1]:
            raise ValueError(f"width_px = {self.width_px}; expected 1 <= least <= greatest")


_NO_MASK: Bytes = np.empty((0, 0), np.uint8)


@dataclass(slots=True)
class _Workspace:
    """Buffers of one working size, so that a frame allocates nothing that grows."""

    grey: Bytes
    blurred: Bytes
    valid: Bytes
    gx: NDArray[np.int16]
    gy: NDArray[np.int16]
    level: Singles
    index: NDArray[np.int32]
    sector: Bytes
    edge: Singles
    partner: NDArray[np.int32]
    stroke: Singles
    state: Bytes
    place: Singles
    forward: Singles
    backward: Singles
    points: Singles
    pieces: Singles
    longer_points: Singles
    longer: Singles
    joined_points: Singles
    joined: Singles
    features: Floats
    sorting: NDArray[np.int32]
    sorted: Singles
    counts: NDArray[np.int32]
    first: NDArray[np.int32]
    axis: NDArray[np.int32]
    scratch: Singles
    evidence: Singles
    exact: Floats
    mask: Bytes | None = None  # the one that `valid` was made from

    @classmethod
    def of(cls, height: int, width: int) -> _Workspace:
        size = height, width
        most = max(height * width // 6, 64)  # thin edges that are kept; texture has fewer
        strokes = max(height * width // 12, 64)
        way = 4 * (height + width) + 64
        return cls(
            grey=np.empty(size, np.uint8),
            blurred=np.empty(size, np.uint8),
            valid=_NO_MASK,
            gx=np.empty(size, np.int16),
            gy=np.empty(size, np.int16),
            level=np.empty((max(height // 32, 1), 3 * max(width // 32, 1)), np.float32),
            index=np.empty(size, np.int32),
            sector=np.empty(size, np.uint8),
            edge=np.empty((most, 5), np.float32),
            partner=np.empty(most, np.int32),
            stroke=np.empty((strokes, 6), np.float32),
            state=np.empty(strokes, np.uint8),
            place=np.empty((strokes, 2), np.float32),
            forward=np.empty((way, 2), np.float32),
            backward=np.empty((way, 2), np.float32),
            points=np.empty((4 * way, 2), np.float32),
            pieces=np.empty((MOST_PIECES, 11), np.float32),
            longer_points=np.empty((6 * way, 2), np.float32),
            longer=np.empty((MOST_PIECES, 11), np.float32),
            joined_points=np.empty((6 * way + 2 * MOST_PIECES, 2), np.float32),
            joined=np.empty((MOST_PIECES, 11), np.float32),
            features=np.empty((strokes, 5)),
            sorting=np.empty((4, max(strokes, height + 2, width + 2)), np.int32),
            sorted=np.empty((strokes, 6), np.float32),
            counts=np.empty(strokes, np.int32),
            first=np.empty(MOST_CLUSTERS + 1, np.int32),
            axis=np.empty(MOST_CLUSTERS, np.int32),
            scratch=np.empty((8 * 4096, 2), np.float32),
            evidence=np.empty((MOST_PIECES, 17), np.float32),
            exact=np.empty((4096, 2)),
        )


@dataclass(frozen=True, slots=True)
class _Level:
    """One working scale and the stroke widths that are searched there, in working pixels."""

    scale: float  # working pixels per pixel: 1 / n, or more than 1 for the thinnest lines
    low: float
    high: float

    @property
    def middle(self) -> float:
        """The width in the middle of those searched."""
        return math.sqrt(self.low * self.high)

    @property
    def reach(self) -> float:
        """How far apart two strokes of equal width and direction are neighbours."""
        return max(0.5 * self.middle, 3.0)

    @property
    def least(self) -> float:
        """The narrowest stroke that may be part of a line."""
        return self.low / min(max(math.sqrt(STROKE_SPAN * self.low / self.high), 1.0), MOST_TAPER)

    @property
    def greatest(self) -> float:
        """The widest stroke that may be part of a line."""
        return self.high * self.low / self.least


class LineDetector:
    """Find lines in top views; keeps its buffers from frame to frame, so use one for a stream."""

    def __init__(self, config: LineConfig = LineConfig()) -> None:
        self.config = config
        self._workspaces: dict[tuple[int, int], _Workspace] = {}
        self._size = (0, 0)
        self._levels: list[_Level] = []
        self._mask = _NO_MASK
        self._doubt = 0.0

    def detect(self, gray: Bytes, valid: NDArray[np.bool_] | Bytes | None = None) -> list[Line]:
        """Find the lines of one image.

        Parameters
        ----------
        gray : (H, W) uint8 array
            The top view: straight down on the floor, the same scale everywhere.
        valid : (H, W) bool array, optional
            True where the image shows floor; outside it nothing is found.

        Returns
        -------
        list of Line
            Best first; empty where there is no line. Points are u, v in pixels of `gray`. At a crossing each line goes
            straight on, so two lines cross there; a branch is a line of its own that begins at the side of another.

        Raises
        ------
        ValueError
            If the shapes or types are wrong.
        """
        if gray.ndim != 2 or gray.dtype != np.uint8:
            raise ValueError(f"need a grey image (H, W) of uint8, got {gray.shape} of {gray.dtype}")
        if valid is not None and valid.shape != gray.shape:
            raise ValueError(f"need a mask of the image's shape {gray.shape}, got {valid.shape}")
        if min(gray.shape) < 8:
            return []
        if gray.shape != self._size:  # another stream: its buffers replace the old ones
            self._workspaces.clear()
            self._size = gray.shape
            self._levels = _levels(self.config, gray.shape)
            self._doubt = math.log(len(self._levels))  # because each further scale is another chance for texture
        gray = np.ascontiguousarray(gray)
        mask = None if valid is None else np.ascontiguousarray(valid).view(np.uint8)
        if self.config.variant == "thesis":
            return detect_thesis(gray, mask, self.config.polarity, self.config.width_px or _plausible(gray.shape))
        self._mask = _NO_MASK if mask is None else mask
        lines = [line for level in self._levels for line in self._found(level, gray, mask)]
        return believed(without_doubles(lines), self.config.min_confidence) if len(lines) > 1 else lines

    def _found(self, level: _Level, gray: Bytes, mask: Bytes | None) -> list[Line]:
        """What is found at one scale and is likely enough, in pixels of the given image."""
        work, edges, _ = self._edges(level, gray, mask)
        lines: list[Line] = []
        for sign in SIGNS[self.config.polarity]:
            strokes = self._strokes(work, level, edges, sign)
            pieces = _traced(work, strokes, level, sign)
            if pieces == 0:
                continue
            likely = self._likely(work, pieces, sign, strokes)
            least = self.config.min_confidence
            if max((sure for *_, sure in likely), default=0.0) >= least:
                least = min(least, SUPPORTED)
            seen = [
                _refined(work, path, row, gray, self._mask, 1.0 / level.scale, sign, sure)
                for path, row, sure in likely
                if sure >= least and level.least <= row[2] <= level.greatest
            ]
            fitting = [line for line in seen if self._fits(line.width)]
            lines += fitting
            if any(line.confidence >= self.config.min_confidence for line in fitting):
                # where a camera looks on from the side, the other arm of a corner is wider or narrower than asked for
                lines += [
                    line
                    for line in seen
                    if line.confidence >= self.config.min_confidence
                    and not self._fits(line.width)
                    and self._fits(line.width, MOST_TAPER)
                ]
        return lines

    def _fits(self, width: float, taper: float = 1.0) -> bool:
        """Whether a line measured at full resolution is as wide as was asked for, or by `taper` off at most."""
        least, greatest = self.config.width_px or (0.0, math.inf)
        return least / taper - WIDTH_ERROR <= width <= greatest * taper + WIDTH_ERROR

    def _edges(self, level: _Level, gray: Bytes, mask: Bytes | None) -> tuple[_Workspace, int, float]:
        """The thin edges of one scale, in the buffers: these, how many, and the mean threshold."""
        work = self._prepare(level, gray, mask)
        found, threshold = kernels.edges(
            work.gx, work.gy, work.valid, THRESHOLD_FACTOR, THRESHOLD_LOW, THRESHOLD_HIGH,
            work.level, work.index, work.sector, work.edge,
        )  # fmt: skip
        return work, found, threshold

    def _strokes(self, work: _Workspace, level: _Level, edges: int, sign: float) -> int:
        """Fill the buffer of strokes between the edges; returns how many."""
        return kernels.strokes(
            work.edge, edges, work.index, work.sector, level.least, level.greatest,
            sign, PARALLEL, MUTUAL, work.partner, work.stroke,
        )  # fmt: skip

    def _likely(self, work: _Workspace, pieces: int, sign: float, strokes: int) -> list[tuple[Singles, Singles, float]]:
        """Path, row and confidence of each joined piece; the promising ones once more where they can be followed on.

        What follows may be joined again, and then counts instead of its parts if it is at least as likely a line.
        """
        sure = self._judged(work, work.joined_points, work.joined, pieces, sign, strokes)
        chosen = np.flatnonzero(sure >= min(PROMISING, self.config.min_confidence))
        if len(chosen) == 0:
            return []
        rows, sure = work.joined[chosen], sure[chosen]
        added = joining.extend(
            work.blurred, work.valid, sign, work.joined_points, rows, len(rows),
            work.forward, work.longer_points, work.longer,
        )  # fmt: skip
        if added == 0:
            return [(_path(work.joined_points, row), row, float(share)) for row, share in zip(rows, sure, strict=True)]
        grown = joining.join(
            work.blurred, work.valid, sign, work.longer_points, work.longer, len(rows), work.points, work.pieces
        )
        surer = self._judged(work, work.points, work.pieces, grown, sign, strokes)
        found = [
            (_path(work.points, row), row, float(share)) for row, share in zip(work.pieces[:grown], surer, strict=True)
        ]
        least = self.config.min_confidence
        for row, share in zip(rows, sure, strict=True):
            path = _path(work.joined_points, row)
            for k, (whole, of, other) in enumerate(found):
                if other >= least and _lies_on(path, whole, 0.5 * float(of[2])):
                    found[k] = whole, of, max(other, float(share))
                    break
            else:
                found.append((path, row, float(share)))
        return found

    def _judged(
        self, work: _Workspace, points: Singles, pieces: Singles, count: int, sign: float, strokes: int
    ) -> Floats:
        """How sure each of the first `count` pieces is a line."""
        measuring.judge(work.blurred, work.valid, points, pieces, count, sign, strokes, work.scratch, work.evidence)
        return confidence(work.evidence[:count], pieces[:count, 10], self._doubt)

    def _prepare(self, level: _Level, gray: Bytes, mask: Bytes | None) -> _Workspace:
        """Reduce, blur and differentiate into the buffers."""
        reduce = round(1.0 / level.scale)
        if reduce >= 1:
            height, width = gray.shape[0] // reduce, gray.shape[1] // reduce
        else:
            height, width = (round(size * level.scale) for size in gray.shape)
        if (height, width) not in self._workspaces:
            self._workspaces[height, width] = _Workspace.of(height, width)
        work = self._workspaces[height, width]
        if reduce > 1:  # whole blocks only, which OpenCV averages fastest
            blocks = gray[: height * reduce, : width * reduce]
            scaled = cv2.resize(blocks, (width, height), dst=work.grey, interpolation=cv2.INTER_AREA)
        elif reduce < 1:
            scaled = cv2.resize(gray, (width, height), dst=work.grey, interpolation=cv2.INTER_CUBIC)
        else:
            scaled = gray
        if mask is None:
            work.valid, work.mask = _NO_MASK, None
        elif work.mask is None or not np.array_equal(mask, work.mask):
            blocks = mask[: height * reduce, : width * reduce] if reduce > 1 else mask
            shown = cv2.resize(blocks, (width, height), interpolation=cv2.INTER_NEAREST)
            # because blur and gradient reach 3 px, and one pixel of the reduced image may be half outside
            work.valid = cv2.erode(shown, _ERODE, borderType=cv2.BORDER_REPLICATE).astype(np.uint8)
            work.mask = mask.copy()
        cv2.GaussianBlur(scaled, (5, 5), 1.0, dst=work.blurred, borderType=cv2.BORDER_REPLICATE)
        cv2.spatialGradient(work.blurred, work.gx, work.gy)
        return work


SIGNS = {"dark": (-1.0,), "bright": (1.0,), "both": (-1.0, 1.0)}
_ERODE = np.ones((9, 9), np.uint8)


def _levels(config: LineConfig, shape: tuple[int, ...]) -> list[_Level]:
    """Scales such that the line is 8 to 28 px wide, or as wide as it is if that is less."""
    least, greatest = config.width_px or _plausible(shape)
    count = max(1, math.ceil(math.log(greatest / least) / math.log(LEVEL_SPAN) - 1e-9))
    ratio = (greatest / least) ** (1.0 / count)
    levels = []
    for k in range(count):
        low, high = least * ratio**k, least * ratio ** (k + 1)
        middle = math.sqrt(low * high)
        large = shape[0] * shape[1] > LARGE_VIEW and middle < 2.0 * WORKING_WIDTH
        reduce = min(int(middle / (LARGE_WIDTH if large else WORKING_WIDTH)), min(shape) // 8)
        scale = 1.0 / reduce if reduce >= 1 else (2.0 if middle < 5.0 else 1.0)
        levels.append(_Level(scale, max(0.87 * low * scale, 1.5), 1.15 * high * scale))
    return levels


def _plausible(shape: tuple[int, ...]) -> tuple[float, float]:
    """Widths that are searched if none is given."""
    return 4.0, max(min(shape) / WIDEST, 8.0)


def _clustered(work: _Workspace, strokes: int, level: _Level) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Cluster of each stroke centre, -1 for none, and how many strokes agree with it in place, width and direction."""
    reach = level.reach
    features = work.features[:strokes]
    clustering.features(work.stroke, reach, WIDTH_WEIGHT, TURN_WEIGHT, features)
    height, width = work.gx.shape
    return dbscan(features, 1.0, max(3, round(0.5 * reach)), (0.0, 0.0, width / reach, height / reach))


def _traced(work: _Workspace, strokes: int, level: _Level, sign: float) -> int:
    """Cluster the stroke centres, trace every cluster, and join what belongs together; returns how many pieces."""
    if strokes < 6:
        return 0
    labels, counts = _clustered(work, strokes, level)
    clusters = clustering.sort(
        work.stroke, labels, counts, int(labels.max()) + 1, max(4, round(0.5 * level.middle * LEAST_LENGTH)),
        work.sorting, work.sorted, work.counts, work.first, work.axis,
    )  # fmt: skip
    if clusters == 0:
        return 0
    pieces = tracing.trace(
        work.sorted, work.counts, work.first[: clusters + 1], work.axis, ALIGNED, LEAST_LENGTH, MOST_SPREAD,
        work.state, work.place, work.forward, work.backward, work.points, work.pieces,
    )  # fmt: skip
    return joining.join(
        work.blurred, work.valid, sign, work.points, work.pieces, pieces, work.joined_points, work.joined
    )


def _path(points: Singles, row: Singles) -> Singles:
    """The points (N, 2) of a piece."""
    return points[int(row[0]) : int(row[0] + row[1])]


def _lies_on(path: Singles, other: Singles, near: float) -> bool:
    """Whether nearly all points of a path are `near` a point of another; every third says enough."""
    gaps = ((path[::3, None] - other[None, ::2]) ** 2).sum(axis=2).min(axis=1)
    return bool(np.mean(gaps < near * near) > 0.8)


def _refined(
    work: _Workspace, path: Singles, row: Singles, gray: Bytes, mask: Bytes, grain: float, sign: float, sure: float
) -> Line:
    """A piece measured again, border by border, at the resolution of the given image; `grain` pixels were one."""
    width, slope, closed = float(row[2]), float(row[3]), bool(row[8])
    found, width, turn = measuring.refine(gray, mask, path, width, slope, closed, grain, sign, work.scratch, work.exact)
    points = work.exact[:found].copy()  # because the next line uses the buffer again
    if turn > SHARP:
        points = sharpened(points, width)
    normals, curvature = np.empty_like(points), np.empty(len(points))
    measuring.shape(points, CURVATURE_REACH * width, closed, normals, np.empty(len(points)), curvature)
    return Line(points, width, sure, normals, curvature, "dark" if sign < 0.0 else "bright", closed)
