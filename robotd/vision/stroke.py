"""Find lines of constant width in a top view of the floor by the strokes between their opposite edges.

Thesis section 5.2.3 and its paper, mended (errata B9-B16). A line is bounded by two edges at a constant distance whose
gradients oppose each other. From every thin edge pixel we walk along the gradient to an opposite edge; pairs that find
each other give a stroke, of which only the centre is kept. Centres that agree in place, width and direction are
clustered by density, traced into polylines, joined over gaps and corners, and judged: how long, how completely
supported from both borders, how constant in width and in contrast. There is no split into start and end pixels, so all
orientations are equal. The image is scaled so that the line is about a dozen pixels wide: texture finer than that
disappears, and the cost does not grow with the line's width.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line
from . import stroke_reference
from .cluster import dbscan
from .polyline import arc_length, bridge, cut_back, directions, extend, resample

try:
    from . import _stroke as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    kernels = stroke_reference  # type: ignore[misc]

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]

THRESHOLD_FACTOR = 1.3  # times the mean gradient of the frame; clipped to the two below
THRESHOLD_LOW = 24.0  # Sobel units (8 per grey level a pixel): a step of 10 grey levels, blurred
THRESHOLD_HIGH = 90.0
PARALLEL = math.cos(math.radians(28.0))  # tape tapers, tight curves bend: the later steps decide
ALIGNED = math.cos(math.radians(35.0))  # strokes of one window of a trace against its direction
MUTUAL = 0.4  # widths between an edge and the return of its partner's walk
LEVEL_SPAN = 3.0  # greatest ratio of widths searched at one scale
MOST_LINES = 16  # pieces that are traced and judged at one scale
MOST_SPREAD = 0.16  # of the stroke width: beyond it no other evidence makes up for it


@dataclass(frozen=True, slots=True)
class LineConfig:
    """What to look for.

    Attributes
    ----------
    polarity : "dark", "bright" or "both"
        Of the line against the floor.
    width_px : (least, greatest) in pixels of the given image, or None to search all plausible widths.
    min_confidence : float
        Lines below it are not returned.
    """

    polarity: Literal["dark", "bright", "both"] = "dark"
    width_px: tuple[float, float] | None = None
    min_confidence: float = 0.5

    def __post_init__(self) -> None:
        if self.polarity not in ("dark", "bright", "both"):
            raise ValueError(f"polarity = {self.polarity!r}; expected 'dark', 'bright' or 'both'")
        if self.width_px is not None and not 1.0 <= self.width_px[0] <= self.width_px[1]:
            raise ValueError(f"width_px = {self.width_px}; expected 1 <= least <= greatest")


@dataclass(slots=True)
class _Workspace:
    """Buffers of one working size, so that a frame allocates nothing that grows."""

    grey: Bytes
    blurred: Bytes
    valid: Bytes
    gx: NDArray[np.int16]
    gy: NDArray[np.int16]
    magnitude: Singles
    index: NDArray[np.int32]
    edge: Singles
    partner: NDArray[np.int32]
    stroke: Singles
    trace: Singles

    @classmethod
    def of(cls, height: int, width: int) -> _Workspace:
        size, most = (height, width), max(height * width // 4, 64)
        return cls(
            grey=np.empty(size, np.uint8),
            blurred=np.empty(size, np.uint8),
            valid=np.empty(size, np.uint8),
            gx=np.empty(size, np.int16),
            gy=np.empty(size, np.int16),
            magnitude=np.empty(size, np.float32),
            index=np.empty(size, np.int32),
            edge=np.empty((most, 5), np.float32),
            partner=np.empty(most, np.int32),
            stroke=np.empty((most, 6), np.float32),
            trace=np.empty((2048, 2), np.float32),
        )


@dataclass(slots=True, eq=False)
class _Piece:
    """A traced polyline in working pixels and the evidence for it."""

    points: Floats
    width: float
    spread: float  # of the stroke widths, relative
    filled: int  # windows of the trace that held strokes
    travelled: int  # windows that it passed
    strokes: int
    closed: bool = False


@dataclass(slots=True)
class _Level:
    """One working scale and the stroke widths that are searched there, in working pixels."""

    scale: float
    low: float
    high: float
    reference: float = field(init=False)

    def __post_init__(self) -> None:
        self.reference = math.sqrt(self.low * self.high)


class LineDetector:
    """Find lines in top views; keeps its buffers from frame to frame, so use one for a stream."""

    def __init__(self, config: LineConfig = LineConfig()) -> None:
        self.config = config
        self._workspaces: dict[tuple[int, int], _Workspace] = {}
        self._size = (0, 0)

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
            Best first; empty where there is no line. Points are u, v in pixels of `gray`.

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
        mask = None if valid is None else np.ascontiguousarray(valid).view(np.uint8)
        lines: list[Line] = []
        levels = self._levels(gray.shape)
        for level in levels:
            # because each further scale is another chance for texture to look like a line
            lines += self._detect_at(level, gray, mask, doubt=math.log(len(levels)))
        lines.sort(key=lambda line: -line.confidence)
        return _without_doubles(lines)

    def _levels(self, shape: tuple[int, ...]) -> list[_Level]:
        """Scales such that the line is 8 to 28 px wide, or as wide as it is if that is less."""
        if self.config.width_px is not None:
            least, greatest = self.config.width_px
        else:
            least, greatest = 4.0, max(min(shape) / 5.0, 8.0)
        count = max(1, math.ceil(math.log(greatest / least) / math.log(LEVEL_SPAN) - 1e-9))
        ratio = (greatest / least) ** (1.0 / count)
        levels = []
        for k in range(count):
            low, high = least * ratio**k, least * ratio ** (k + 1)
            middle = math.sqrt(low * high)
            scale = 14.0 / middle if middle > 20.0 else (8.0 / middle if middle < 5.0 else 1.0)
            scale = min(scale, 3.0)
            levels.append(_Level(scale, max(0.85 * low * scale, 1.5), 1.15 * high * scale))
        return levels

    def _detect_at(self, level: _Level, gray: Bytes, mask: Bytes | None, doubt: float) -> list[Line]:
        work = self._prepare(level, gray, mask)
        found, _ = kernels.edges(
            work.gx, work.gy, work.valid, THRESHOLD_FACTOR, THRESHOLD_LOW, THRESHOLD_HIGH,
            work.magnitude, work.index, work.edge,
        )  # fmt: skip
        signs = {"dark": (-1.0,), "bright": (1.0,), "both": (-1.0, 1.0)}[self.config.polarity]
        lines = []
        for sign in signs:
            count = kernels.strokes(
                work.edge, found, work.index, level.low, level.high, sign, PARALLEL, MUTUAL, work.partner, work.stroke
            )
            pieces = _joined(_traced(work, work.stroke[:count], level), level)
            ratio = np.array([gray.shape[1] / work.grey.shape[1], gray.shape[0] / work.grey.shape[0]])
            lines += [_judged(piece, work, ratio, sign, doubt) for piece in pieces]
        return [line for line in lines if line.confidence >= self.config.min_confidence]

    def _prepare(self, level: _Level, gray: Bytes, mask: Bytes | None) -> _Workspace:
        """Scale, blur and differentiate into the buffers."""
        height, width = (max(round(size * level.scale), 8) for size in gray.shape)
        if (height, width) not in self._workspaces:
            self._workspaces[height, width] = _Workspace.of(height, width)
        work = self._workspaces[height, width]
        scaled = gray
        if level.scale != 1.0:
            way = cv2.INTER_AREA if level.scale < 1.0 else cv2.INTER_CUBIC
            cv2.resize(gray, (width, height), dst=work.grey, interpolation=way)
            scaled = work.grey
        if mask is None:
            work.valid[:] = 1
        else:
            cv2.resize(mask, (width, height), dst=work.valid, interpolation=cv2.INTER_NEAREST)
            # because blur and Sobel reach 3 px, and one pixel of the resized image may be half outside
            cv2.erode(work.valid, _ERODE, dst=work.valid, borderType=cv2.BORDER_REPLICATE)
        cv2.GaussianBlur(scaled, (5, 5), 1.0, dst=work.blurred, borderType=cv2.BORDER_REPLICATE)
        cv2.Sobel(work.blurred, cv2.CV_16S, 1, 0, dst=work.gx, borderType=cv2.BORDER_REPLICATE)
        cv2.Sobel(work.blurred, cv2.CV_16S, 0, 1, dst=work.gy, borderType=cv2.BORDER_REPLICATE)
        return work


def _judged(piece: _Piece, work: _Workspace, ratio: Floats, sign: float, doubt: float) -> Line:
    """The line in pixels of the given image; `ratio` (2,) is its size over the working size, along u and v."""
    points = piece.points
    if not piece.closed:
        points = extend(points, work.valid, 1.2 * piece.width)
        points = extend(points[::-1], work.valid, 1.2 * piece.width)[::-1]
    points = (resample(points, max(piece.width / 10.0, 1.0)) + 0.5) * ratio - 0.5
    width = piece.width * math.sqrt(ratio[0] * ratio[1])
    return Line(np.ascontiguousarray(points), width, _confidence(piece, work, sign, doubt))


_ERODE = np.ones((9, 9), np.uint8)


def _traced(work: _Workspace, stroke: Singles, level: _Level) -> list[_Piece]:
    """Cluster the stroke centres and trace every cluster, the largest first."""
    if len(stroke) < 6:
        return []
    reach = max(0.5 * level.reference, 3.0)
    double = 2.0 * np.arctan2(stroke[:, 3], stroke[:, 2], dtype=np.float64)  # because a tangent has no sign
    features = np.empty((len(stroke), 5))
    features[:, :2] = stroke[:, :2] / reach
    features[:, 2] = np.log(stroke[:, 4]) * 4.0  # 28 % of width weighs as much as half a width of distance
    features[:, 3] = np.cos(double) * 0.9
    features[:, 4] = np.sin(double) * 0.9
    labels, counts = dbscan(features, 1.0, max(4, round(0.9 * reach)))
    state = (labels >= 0).astype(np.uint8)
    if not state.any():
        return []
    sizes = np.bincount(labels[labels >= 0])
    pieces: list[_Piece] = []
    for label in np.argsort(-sizes, kind="stable"):
        if sizes[label] < level.reference or len(pieces) >= MOST_LINES:
            break
        members = np.flatnonzero(labels == label)
        width = float(np.median(stroke[members, 4]))
        for _ in range(4):  # the longest way through a cluster, then its branches
            free = members[state[members] == 1]
            if len(free) < max(width, 6.0):
                break
            seed = free[int(np.argmax(counts[free]))]
            piece = _trace_both_ways(work, stroke, state, int(seed), width)
            if piece is None:
                break
            pieces.append(piece)
    return pieces


def _trace_both_ways(work: _Workspace, stroke: Singles, state: Bytes, seed: int, width: float) -> _Piece | None:
    """Trace from one stroke to both ends and claim the strokes on the way."""
    step = max(0.4 * width, 2.0)
    radius = max(0.3 * width, 1.5)
    least = max(3, round(0.6 * step))
    u, v, tu, tv = (float(value) for value in stroke[seed, :4])
    ends, filled, travelled, closed = [], 0, 0, False
    for turn in (1.0, -1.0):
        count, full, passed, closed = kernels.trace(
            stroke, state, u, v, turn * tu, turn * tv, step, radius, 2.0 * width, least, ALIGNED, work.trace
        )
        ends.append(work.trace[:count].copy())
        filled += full
        travelled += passed
        if closed:
            break
    forward, back = ends[0], ends[1] if len(ends) > 1 else np.empty((0, 2), np.float32)
    points = np.vstack([back[::-1], stroke[seed, :2][None], forward])
    if closed:
        points = np.vstack([points[1:], points[1:2]])
    if len(points) > 3 and len(back) and len(forward):
        points = np.delete(points, len(back), axis=0)  # because the seed itself is one noisy stroke
    before = state.copy()
    kernels.claim(stroke, state, np.ascontiguousarray(points), 0.5 * width, ALIGNED)
    claimed = np.flatnonzero(before != state)
    state[seed] = 2
    if len(points) < 3 or len(claimed) < 6:
        return None
    widths = stroke[claimed, 4]
    median = float(np.median(widths))
    spread = float(np.mean(np.abs(widths - median))) / median
    return _Piece(points.astype(np.float64), median, spread, filled, travelled, len(claimed), closed)


def _joined(pieces: list[_Piece], level: _Level) -> list[_Piece]:
    """Join pieces whose ends face each other over a gap or meet in a corner, nearest ends first."""
    pieces = [
        piece for piece in pieces if piece.spread < MOST_SPREAD and arc_length(piece.points)[-1] >= 0.8 * piece.width
    ]
    refused: set[tuple[_Piece, bool, _Piece, bool]] = set()
    while True:
        joint = _nearest_joint(pieces, level, refused)
        if joint is None:
            return pieces
        one, two, first, second, between, gap = joint
        if len(between):
            first, second = cut_back(first, between[0]), cut_back(second[::-1], between[0])[::-1]
        share = two.strokes / (one.strokes + two.strokes)
        joined = _Piece(
            np.vstack([first, between, second]),
            one.width + share * (two.width - one.width),
            one.spread + share * (two.spread - one.spread),
            one.filled + two.filled,
            one.travelled + two.travelled + round(gap / max(0.4 * one.width, 2.0)),
            one.strokes + two.strokes,
        )
        pieces = [piece for piece in pieces if piece is not one and piece is not two] + [joined]


def _nearest_joint(
    pieces: list[_Piece], level: _Level, refused: set[tuple[_Piece, bool, _Piece, bool]]
) -> tuple[_Piece, _Piece, Floats, Floats, Floats, float] | None:
    """The two pieces whose ends belong together and are nearest, both turned so that one runs into the other.

    `refused` remembers which ends were found not to belong together.
    """
    ends = [(piece, flip) for piece in pieces if not piece.closed for flip in (False, True)]
    places = np.array([piece.points[0 if flip else -1] for piece, flip in ends]).reshape(-1, 2)
    gaps = np.sqrt(((places[:, None] - places[None]) ** 2).sum(axis=2))
    rows, columns = np.nonzero(np.triu(gaps < 3.0 * level.high, 1))
    for i, j in sorted(zip(rows, columns, strict=True), key=lambda pair: gaps[pair]):
        (one, flip_one), (two, flip_two) = ends[i], ends[j]
        key = (one, flip_one, two, flip_two)
        if one is two or key in refused or abs(math.log(one.width / two.width)) > 0.25:
            continue
        first = one.points[::-1] if flip_one else one.points
        second = two.points if flip_two else two.points[::-1]
        between = bridge(first, second, one.width)
        if between is not None:
            return one, two, first, second, between, float(gaps[i, j])
        refused.add(key)
    return None


def _confidence(piece: _Piece, work: _Workspace, sign: float, doubt: float) -> float:
    """How sure a piece is a line, 0..1: a logistic sum of the evidence, see `_WEIGHTS`, less `doubt`."""
    length = float(arc_length(piece.points)[-1])
    clear, contrast = _contrast(piece, work, sign)
    coarse = resample(piece.points, piece.width)
    bent = np.hypot(*np.diff(directions(coarse), axis=0).T) if len(coarse) > 2 else np.ones(1)
    evidence = (
        1.0,
        math.log(min(max(length / piece.width, 0.5), 8.0)),
        piece.filled / max(piece.travelled, 1),
        min(piece.strokes / max(length, 1.0), 2.0),
        10.0 * min(max(piece.spread, 0.03), 0.2),
        math.log(min(max(clear, 0.2), 8.0)),
        math.log(min(max(contrast, 1.0), 25.0)),
        math.log(min(max(float(np.median(bent)), 0.02), 1.0)),
    )
    total = sum(weight * value for weight, value in zip(_WEIGHTS, evidence, strict=True)) - doubt
    return 1.0 / (1.0 + math.exp(-total))


# Logistic regression on synthetic tape over photographs of brick, grass, gravel and household scenes, against what is
# traced there without tape; the bounds of each kind of evidence keep ragged or short tape from being ruled out.
_WEIGHTS = (
    -9.1,
    1.3,  # length in widths (log): a close camera sees 3 to 6
    1.2,  # share of the trace's windows that held strokes
    0.6,  # strokes per pixel of length; a clean line has about 1.7, from both borders
    -3.0,  # mean deviation of the stroke width, in tenths of it: the best witness against texture
    0.6,  # contrast over its scatter along the line (log)
    1.6,  # contrast in grey levels (log)
    -0.4,  # turn per width of length (log)
)


def _contrast(piece: _Piece, work: _Workspace, sign: float) -> tuple[float, float]:
    """Median grey level of the floor beside the line against the line's, over its scatter, and by itself."""
    points = resample(piece.points, max(0.25 * piece.width, 1.0))
    height, width = work.blurred.shape
    tangent = directions(points)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    outer, inner = 0.5 * piece.width + max(0.3 * piece.width, 2.0), 0.2 * piece.width
    across = np.array([-outer, outer, -inner, 0.0, inner])
    at = np.floor(points + across[:, None, None] * normal + 0.5).astype(np.int64)
    inside = (at >= 0).all(axis=2) & (at[..., 0] < width) & (at[..., 1] < height)
    at[~inside] = 0
    inside &= work.valid[at[..., 1], at[..., 0]] > 0
    grey = work.blurred[at[..., 1], at[..., 0]].astype(np.float64)
    steps = sign * (grey[2:].mean(axis=0) - grey[:2])[inside[:2] & inside[2:].all(axis=0)]
    if len(steps) < 6:
        return 0.0, 0.0
    contrast = float(np.median(steps))
    return contrast / (float(np.mean(np.abs(steps - contrast))) + 1.0), contrast


def _without_doubles(lines: list[Line]) -> list[Line]:
    """Drop a line that mostly lies on a better one: the same tape found at two scales."""
    kept: list[Line] = []
    for line in lines:
        for other in kept:
            gaps = line.points[::3, None, :] - other.points[None, ::3, :]
            nearest = np.sqrt((gaps**2).sum(axis=2).min(axis=1))
            if np.mean(nearest < 0.5 * max(line.width, other.width)) > 0.5:
                break
        else:
            kept.append(line)
    return kept
