"""What the line detector sees on its way to the lines: its intermediate results, for pictures and for people.

`LineDetector.detect` keeps none of them, because the robot has no use for them. Thesis section 7.4 shows the same
stages in its figures 46 to 52.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .stroke import SIGNS, Bytes, LineDetector, Singles, _clustered


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """One working scale and one colour of line. All places are u, v in pixels of the given image.

    Attributes
    ----------
    scale : float
        Working pixels per pixel of the given image.
    polarity : "dark" or "bright"
    width_px : (least, greatest)
        Of the lines searched at this scale, in pixels of the given image.
    magnitude : (h, w) float32 array
        Length of the gradient at the working scale, in Sobel units (8 per grey level a pixel).
    threshold : float
        Of the magnitude, the mean over the image.
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
    width_px: tuple[float, float]
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
    found = []
    for level in detector._levels:
        work, count, threshold = detector._edges(level, np.ascontiguousarray(gray), mask)
        edge = work.edge[:count].astype(np.float64)
        edges = np.column_stack([_given(edge[:, :2], level.scale), edge[:, 2:4]])
        for sign in SIGNS[detector.config.polarity]:
            strokes = detector._strokes(work, level, count, sign)
            rows = work.stroke[:strokes].astype(np.float64)
            half = 0.5 * rows[:, 4:5] * np.column_stack([-rows[:, 3], rows[:, 2]])
            ends = [_given(rows[:, :2] + side * half, level.scale) for side in (-1.0, 1.0)]
            partner = work.partner[:count]
            start = np.flatnonzero(partner >= 0)
            alone = start[partner[partner[start]] < 0]
            labels, counts = _clustered(work, strokes, level)
            expected = 2.0 * 2.0 * level.reach  # one from either border in every pixel of the circle's diameter
            found.append(
                Explanation(
                    level.scale,
                    "dark" if sign < 0.0 else "bright",
                    (level.low / level.scale, level.high / level.scale),
                    np.hypot(work.gx, work.gy, dtype=np.float32),
                    float(threshold),
                    edges,
                    np.hstack([edges[alone, :2], edges[partner[alone], :2]]),
                    np.hstack(ends),
                    np.minimum(counts / expected, 1.0),
                    labels.astype(np.int64),
                )
            )
    return found


def _given(points: Floats, scale: float) -> Floats:
    """Points (N, 2) at the working scale in pixels of the given image."""
    return np.asarray((points + 0.5) / scale - 0.5)
