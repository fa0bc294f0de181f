"""The kernels of `_cluster` in numpy: their oracle in tests, and what runs when the extension was not built."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..records import Floats

Singles = NDArray[np.float32]
Labels = NDArray[np.int32]


def dbscan(features: Floats, eps: float, least: int) -> tuple[Labels, Labels]:
    """The same as `cluster.dbscan`, comparing every pair."""
    count = len(features)
    squares = np.zeros((count, count))
    for column in features.T:
        squares += (column[:, None] - column[None, :]) ** 2
    near = squares <= eps * eps
    counts = near.sum(axis=1).astype(np.int32)
    core = counts >= least
    labels = np.full(count, -1, dtype=np.int32)
    label = 0
    for first in np.flatnonzero(core):
        if labels[first] != -1:
            continue
        members = np.zeros(count, dtype=bool)
        members[first] = True
        frontier = members
        while frontier.any():
            reached = near[frontier & core].any(axis=0) & (labels == -1) & ~members
            members = members | reached
            frontier = reached
        labels[members] = label
        label += 1
    return labels, counts


def features(stroke: Singles, reach: float, width_weight: float, turn_weight: float, out: Floats) -> None:
    """What makes strokes similar: the weighted vector (u, v, l, gamma) of the paper's equation 15 (errata B15).

    Place in units of `reach`, logarithm of the width (so that a share of the width counts, not pixels), and cosine and
    sine of the doubled angle (because a tangent has no sign). Fills `out` (N, 5) from the first N strokes.
    """
    used = stroke[: len(out)].astype(np.float64)
    out[:, :2] = used[:, :2] / reach
    out[:, 2] = width_weight * np.log(used[:, 4])
    out[:, 3] = turn_weight * (used[:, 2] ** 2 - used[:, 3] ** 2)
    out[:, 4] = turn_weight * 2.0 * used[:, 2] * used[:, 3]


def sort(
    stroke: Singles,
    labels: Labels,
    counts: Labels,
    clusters: int,
    least: int,
    work: NDArray[np.int32],
    out: Singles,
    out_counts: Labels,
    first: Labels,
    axis: Labels,
) -> int:
    """Sort strokes by cluster, the largest first, and within one by their pixel along its longer side.

    Parameters
    ----------
    labels, counts : (N,) arrays of `cluster.dbscan`
    least : members of a cluster that is kept.
    work : (4, M) array of scratch, M at least N and the image's sides.
    out, out_counts : arrays to fill with the kept strokes and their counts.
    first : (C + 1,) array to fill with where each cluster begins, and where the last ends; at most C are kept.
    axis : (C,) array to fill with 0 for clusters sorted by u, 1 for v.

    Returns
    -------
    How many clusters were kept.
    """
    sizes = np.bincount(labels[labels >= 0], minlength=clusters)
    rank = [c for c in np.argsort(-sizes, kind="stable") if sizes[c] >= least][: len(first) - 1]
    first[0] = 0
    for kept, label in enumerate(rank):
        members = np.flatnonzero(labels == label)
        span = np.ptp(stroke[members, :2], axis=0)
        axis[kept] = 0 if span[0] >= span[1] else 1
        members = members[np.argsort(stroke[members, axis[kept]].astype(int), kind="stable")]
        begin, end = first[kept], first[kept] + len(members)
        out[begin:end], out_counts[begin:end] = stroke[members], counts[members]
        first[kept + 1] = end
    return len(rank)
