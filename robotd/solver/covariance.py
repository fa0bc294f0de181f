"""How sure the solution is: covariances from the whole normal matrix, poses, rig and odometry factors included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ..records import Floats
from .bundle import SQUARE, Adjustment
from .problem import STOP, State

_CHECKED = 1e-3  # share of a variance that others check, from which a residual says something
_MOST_COLUMNS = 6000  # of a dense inverse: 300 MB
_MOST_ENTRIES = 20_000_000  # of one dense temporary array: 160 MB


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """`points` (l, 3, 3) for the adjustment's labels, `stops` (S, 3, 3) of x, y, heading, and `prediction` (N, 3).

    The last is the covariance of every sighting's prediction in units of its variance: of u, of v, and of both.
    """

    points: Floats
    stops: Floats
    prediction: Floats

    @property
    def leverage(self) -> Floats:
        """(N,) trace h of the predictions' covariances.

        A sighting's expected squared residual is 2 - h, so that one with leverage 2 is not checked by any other.
        """
        return np.clip(self.prediction[:, 0] + self.prediction[:, 1], 0.0, 2.0)

    def studentised(self, residual: Floats) -> Floats:
        """(N,) squared whitened residuals (N, 2), each over the variance that it has of its own.

        A sighting on which much hangs draws the optimum to itself, however wrong it is: its residual stays small, but
        its variance is smaller still. Directions that no other sighting checks count for nothing.
        """
        uu, vv, uv = (1.0 - self.prediction[:, 0], 1.0 - self.prediction[:, 1], -self.prediction[:, 2])
        values, vectors = np.linalg.eigh(np.stack([uu, uv, uv, vv], axis=-1).reshape(-1, 2, 2))
        along = np.einsum("nij,ni->nj", vectors, residual)
        return np.asarray(np.where(values > _CHECKED, along**2 / np.maximum(values, _CHECKED), 0.0).sum(axis=1))


def covariance(adjustment: Adjustment, state: State) -> Covariance:
    """Covariances at the least-squares optimum, from the inverse of the normal matrix."""
    kernel = adjustment.kernel
    found = None if kernel is None else kernel.covariance(state.frame, state.points[adjustment.labels])
    if found is None:  # also where the matrix is nearly singular, because eigenvalues tell what is barely known
        return covariance_reference(adjustment, state)
    return Covariance(*found)


def covariance_reference(adjustment: Adjustment, state: State) -> Covariance:
    """`covariance` in numpy, with a dense inverse."""
    problem = adjustment.problem
    linear = adjustment.linearise(state, SQUARE)
    S, V_inverse, WV = adjustment.eliminate(adjustment.normal(linear, state, SQUARE))
    n, labels = adjustment.size, len(V_inverse)
    frame = inverse(S)
    points = np.empty((labels, 3, 3))
    coupled = np.empty((len(adjustment.sightings), 15, 3))
    # held-fixed entries get a zero row and column by way of one extra index
    padded = np.zeros((n + 1, n + 1))
    padded[:n, :n] = frame
    columns = np.where(adjustment.columns < 0, n, adjustment.columns)
    mine = columns[adjustment.entries]
    at_once = max(1, _MOST_ENTRIES // max(3 * n, 1))
    for low in range(0, labels, at_once):
        some = slice(low, min(low + at_once, labels))
        block = WV[:, 3 * some.start : 3 * some.stop].toarray()
        cross = np.zeros((n + 1, some.stop - some.start, 3))
        cross[:n] = (frame @ block).reshape(n, -1, 3)
        points[some] = V_inverse[some] + np.einsum("nli,nlj->lij", block.reshape(n, -1, 3), cross[:n])
        here = np.flatnonzero((adjustment.point >= some.start) & (adjustment.point < some.stop))
        coupled[here] = -cross[mine[here], adjustment.point[here, None] - some.start]
    stops = np.zeros((problem.stop_count, 3, 3))
    for f in range(problem.stop_count):
        entries = columns[STOP * f : STOP * f + 3]
        stops[f] = padded[np.ix_(entries, entries)]
    A, B = linear.by_frame, linear.by_point
    crossed = np.einsum("nri,nij,nsj->nrs", A, coupled, B, optimize=True)
    predicted = (
        np.einsum("nri,nij,nsj->nrs", A, padded[mine[:, :, None], mine[:, None, :]], A, optimize=True)
        + crossed
        + crossed.transpose(0, 2, 1)
        + np.einsum("nri,nij,nsj->nrs", B, points[adjustment.point], B, optimize=True)
    )
    prediction = predicted.reshape(-1, 4)[:, [0, 3, 1]]
    return Covariance(0.5 * (points + points.transpose(0, 2, 1)), stops, prediction)


def frame_covariance(adjustment: Adjustment, state: State) -> Floats | None:
    """Covariance (F, F) of all frame entries, zero for those held fixed; None if it would be too large."""
    if not 0 < adjustment.size <= _MOST_COLUMNS:
        return None
    normal = adjustment.normal(adjustment.linearise(state, SQUARE), state, SQUARE)
    S, *_ = adjustment.eliminate(normal)
    if not np.isfinite(S).all():  # of measurements stated more exactly than numbers can hold
        return None
    try:
        inner = scipy.linalg.cho_solve(scipy.linalg.cho_factor(S), np.eye(len(S)))
    except np.linalg.LinAlgError:
        return None
    free = np.flatnonzero(adjustment.problem.free)
    full = np.zeros((len(adjustment.columns), len(adjustment.columns)))
    full[np.ix_(free, free)] = inner
    return full


def inverse(S: Floats) -> Floats:
    """Inverse of a symmetric matrix; what rounding has made singular or negative counts as barely known."""
    if len(S) == 0:
        return S
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(S), 1e-12))
    values, vectors = np.linalg.eigh(S * scale[:, None] * scale)
    root = vectors * (scale[:, None] / np.sqrt(np.maximum(values, 1e-13)))
    return np.asarray(root @ root.T)
