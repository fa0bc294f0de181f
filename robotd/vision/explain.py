"""What the line detector sees on its way to the lines: its intermediate results, for pictures and for people.

`LineDetector.detect` keeps none of them, because the robot has no use for them. Thesis section 7.4 shows the same
stages in its figures 46 to 52.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from . import stroke, stroke_reference
from .cluster import dbscan
from .cluster import kernels as clustering
from .stroke import Bytes, LineDetector, Singles

try:
    from . import _stroke as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    kernels = stroke_reference  # type: ignore[misc]


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """One working scale and one colour of line. All places are u, v in pixels of the given image.

    Attributes
    ----------
    scale : float
        Working pixels per pixel of the given image.
    polarity : "dark" or "bright"
    magnitude : (h, w) float32 array
        Length of the gradient at the working scale, in Sobel units (8 per grey level a pixel).
    threshold : float
        Of the magnitude, for this image.
    edges : (E, 4) array
        Thin edges: place, and unit gradient towards brighter.
    one_sided : (O, 4) array
        Walks from an edge (first point) to an opposite one that found another partner: no strokes.
    strokes : (S, 4) array
        The two ends of every stroke, which found each other.
    score : (S,) array
        Share, 0..1, of the strokes expected around each stroke that are there and agree with it.
    labels : (S,) array
        The cluster of each stroke, -1 for none.
    """

    scale: float
    polarity: Literal["dark", "bright"]
    magnitude: Singles
    threshold: float
    edges: Floats
    one_sided: Floats
    strokes: Floats
    score: Floats
    labels: NDArray[np.int64]

    @property
    def widths(self) -> Floats:
        """(S,) lengths of the strokes in pixels."""
        return np.asarray(np.hypot(*(self.strokes[:, 2:] - self.strokes[:, :2]).T))

    @property
    def centres(self) -> Floats:
        """(S, 2) middles of the strokes."""
        return np.asarray(0.5 * (self.strokes[:, :2] + self.strokes[:, 2:]))


def explain(detector: LineDetector, gray: Bytes, valid: NDArray[np.bool_] | None = None) -> list[Explanation]:
    """The stages of `detector.detect(gray, valid)`, one explanation per working scale and colour.

    Raises
    ------
    ValueError
        If the shapes or types are wrong.
    """
    detector.detect(gray, valid)  # because it checks its arguments and makes the buffers
    if min(gray.shape) < 8:
        return []
    mask = None if valid is None else np.ascontiguousarray(valid).view(np.uint8)
    polarities: tuple[Literal["dark", "bright"], ...] = ("dark", "bright")
    if detector.config.polarity != "both":
        polarities = (detector.config.polarity,)
    gray = np.ascontiguousarray(gray)
    found = []
    for level in detector._levels:
        work = detector._prepare(level, gray, mask)
        count, threshold = kernels.edges(
            work.gx, work.gy, work.valid, stroke.THRESHOLD_FACTOR, stroke.THRESHOLD_LOW, stroke.THRESHOLD_HIGH,
            work.level, work.index, work.sector, work.edge,
        )  # fmt: skip
        edge = work.edge[:count].astype(np.float64)
        edges = np.column_stack([_given(edge[:, :2], level.scale), edge[:, 2:4]])
        for polarity in polarities:
            strokes = kernels.strokes(
                work.edge, count, work.index, work.sector, level.least, level.greatest,
                -1.0 if polarity == "dark" else 1.0, stroke.PARALLEL, stroke.MUTUAL, work.partner, work.stroke,
            )  # fmt: skip
            rows = work.stroke[:strokes].astype(np.float64)
            half = 0.5 * rows[:, 4:5] * np.column_stack([-rows[:, 3], rows[:, 2]])
            ends = [_given(rows[:, :2] + side * half, level.scale) for side in (-1.0, 1.0)]
            partner = work.partner[:count]
            start = np.flatnonzero(partner >= 0)
            alone = start[partner[partner[start]] < 0]
            labels, score = _clustered(work.stroke, strokes, math.sqrt(level.low * level.high))
            found.append(
                Explanation(
                    level.scale,
                    polarity,
                    np.hypot(work.gx, work.gy, dtype=np.float32),
                    float(threshold),
                    edges,
                    np.hstack([edges[alone, :2], edges[partner[alone], :2]]),
                    np.hstack(ends),
                    score,
                    labels,
                )
            )
    return found


def _given(points: Floats, scale: float) -> Floats:
    """Points (N, 2) at the working scale in pixels of the given image."""
    return np.asarray((points + 0.5) / scale - 0.5)


def _clustered(strokes: Singles, count: int, width: float) -> tuple[NDArray[np.int64], Floats]:
    """Clusters and scores of the first `count` strokes, by the detector's own likeness; `width` is the one expected."""
    reach = max(0.5 * width, 3.0)
    features = np.empty((count, 5))
    clustering.features(strokes, reach, stroke.WIDTH_WEIGHT, stroke.TURN_WEIGHT, features)
    labels, counts = dbscan(features, 1.0, max(3, round(0.5 * reach)))
    expected = 2.0 * 2.0 * reach  # one from either border in every pixel of the circle's diameter
    return labels.astype(np.int64), np.minimum(counts / expected, 1.0)
