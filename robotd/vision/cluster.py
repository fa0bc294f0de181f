"""Density clustering (DBSCAN) of stroke centres, on a grid: thesis section 5.2.4.

Ester, Kriegel, Sander, Xu, "A density-based algorithm for discovering clusters", KDD 1996. A point with at least
`least` points within `eps` of it, itself included, is a core; cores within `eps` of each other share a cluster, and so
does every point within `eps` of a core. What remains is noise. Labels are those of scikit-learn: clusters are numbered
by their first core, a border point of two clusters goes to the lower number, and noise is -1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..records import Floats

try:
    from . import _cluster
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    _cluster = None  # type: ignore[assignment]

Labels = NDArray[np.int32]


def dbscan(features: Floats, eps: float, least: int) -> tuple[Labels, Labels]:
    """Cluster points by density.

    Parameters
    ----------
    features : (N, D) float64 array, D >= 2
        The first two columns are gridded, so clustering is fast when these spread widely in units of `eps`.
    eps : float
        Greatest Euclidean distance of neighbours, over all D columns.
    least : int
        Neighbours, itself included, that make a point a core.

    Returns
    -------
    labels : (N,) int32 array
        Cluster of each point from 0, or -1 for noise.
    counts : (N,) int32 array
        Neighbours of each point within `eps`, itself included.

    Raises
    ------
    ValueError
        If the features are not (N, D >= 2) finite numbers or `eps` is not positive.
    """
    features = np.ascontiguousarray(features, dtype=np.float64)
    if features.ndim != 2 or features.shape[1] < 2:
        raise ValueError(f"need features as (points, 2 or more), got {features.shape}")
    if not eps > 0.0 or not np.isfinite(features).all():
        raise ValueError(f"need finite features and eps > 0, got eps = {eps}")
    if _cluster is None or len(features) == 0:
        return dbscan_reference(features, eps, least)
    count = len(features)
    u0, v0 = features[:, :2].min(axis=0)
    u1, v1 = features[:, :2].max(axis=0)
    # a cell may be larger than eps (just slower), so a few far points cannot make the grid outgrow the points
    cell = max(eps, (u1 - u0) / (2.0 * count + 64.0), (v1 - v0) / (2.0 * count + 64.0))
    cell = max(cell, float(np.sqrt((u1 - u0) * (v1 - v0) / (4.0 * count + 1024.0))))
    cell *= 1.0 + 1e-9  # because a distance of exactly eps, rounded, must not reach over a whole cell
    columns, rows = int((u1 - u0) / cell) + 1, int((v1 - v0) / cell) + 1
    integers = np.empty((5, count), dtype=np.int32)
    start = np.empty(columns * rows + 1, dtype=np.int32)
    labels, counts = integers[3], integers[4]
    _cluster.dbscan(
        features, eps, least, integers[0], start, integers[1], integers[2], counts, labels, u0, v0, cell, columns, rows
    )
    return labels, counts


def dbscan_reference(features: Floats, eps: float, least: int) -> tuple[Labels, Labels]:
    """The same as `dbscan`, comparing every pair."""
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
