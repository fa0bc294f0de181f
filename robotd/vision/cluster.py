"""Density clustering (DBSCAN) of stroke centres, on a grid: thesis section 5.2.4.

Ester, Kriegel, Sander, Xu, "A density-based algorithm for discovering clusters", KDD 1996. A point with at least
`least` points within `eps` of it, itself included, is a core; cores within `eps` of each other share a cluster, and so
does every point within `eps` of a core. What remains is noise. Labels are those of scikit-learn: clusters are numbered
by their first core, a border point of two clusters goes to the lower number, and noise is -1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from . import cluster_reference

try:
    from . import _cluster as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    kernels = cluster_reference  # type: ignore[misc]

__all__ = ["dbscan", "kernels"]

Labels = NDArray[np.int32]


def dbscan(
    features: Floats, eps: float, least: int, bounds: tuple[float, float, float, float] | None = None
) -> tuple[Labels, Labels]:
    """Cluster points by density.

    Parameters
    ----------
    features : (N, D) float64 array, D >= 2
        The first two columns are gridded, so clustering is fast when these spread widely in units of `eps`.
    eps : float
        Greatest Euclidean distance of neighbours, over all D columns.
    least : int
        Neighbours, itself included, that make a point a core.
    bounds : (least u, least v, greatest u, greatest v), optional
        Of the first two columns, from a caller who knows that all features are finite and float64; saves looking.

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
    if bounds is None:
        features = np.ascontiguousarray(features, dtype=np.float64)
        if features.ndim != 2 or features.shape[1] < 2:
            raise ValueError(f"need features as (points, 2 or more), got {features.shape}")
        if not eps > 0.0 or not np.isfinite(features).all():
            raise ValueError(f"need finite features and eps > 0, got eps = {eps}")
    if kernels is cluster_reference or len(features) == 0:
        return cluster_reference.dbscan(features, eps, least)
    count = len(features)
    if bounds is None:
        (u0, v0), (u1, v1) = features[:, :2].min(axis=0), features[:, :2].max(axis=0)
    else:
        u0, v0, u1, v1 = bounds
    # a cell may be larger than eps (just slower), so a few far points cannot make the grid outgrow the points
    cell = max(eps, (u1 - u0) / (2.0 * count + 64.0), (v1 - v0) / (2.0 * count + 64.0))
    cell = max(cell, math.sqrt((u1 - u0) * (v1 - v0) / (4.0 * count + 1024.0)))
    cell *= 1.0 + 1e-9  # because a distance of exactly eps, rounded, must not reach over a whole cell
    columns, rows = int((u1 - u0) / cell) + 1, int((v1 - v0) / cell) + 1
    packed = np.empty_like(features)
    work = np.empty((6, count), dtype=np.int32)
    start = np.empty(columns * rows + 2, dtype=np.int32)
    labels, counts = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
    kernels.dbscan(features, eps, least, packed, work, start, counts, labels, u0, v0, cell, columns, rows)
    return labels, counts
