"""Wrong sightings that draw the optimum to themselves.

Parts of a survey may hang together by few sightings. A wrong one among them, a name that fits by accident, turns a
whole part of the map towards itself, and its residual stays as small as any. What gives it away is that residual over
the little variance that it has then (data snooping: W. Baarda, A testing procedure for use in geodetic networks, 1968).
"""

from __future__ import annotations

import numpy as np

from .bundle import SQUARE, Adjustment
from .covariance import Covariance, covariance
from .problem import Bools, State, stops_per_label
from .weights import OUTLIER

_CHANCE = 0.05  # that a survey without any wrong sighting loses one
_MOST = 4  # rounds


def without_ties(
    adjustment: Adjustment, state: State, sure: Covariance, inlier: Bools
) -> tuple[Adjustment, State, Covariance, Bools]:
    """Leave out sightings whose studentised residuals no chance explains, the worst of each label and stop first.

    Parameters
    ----------
    adjustment : Adjustment
        Of the sightings that count as right.
    state, sure : State, Covariance
        Its optimum, and there.
    inlier : (N,) array
        Which of the problem's sightings these are.

    Returns
    -------
    adjustment, state, covariance, inlier
        Those given if there is no such sighting.
    """
    for _ in range(_MOST):
        s = adjustment.sightings
        square = sure.studentised(adjustment.residuals(state, SQUARE).residual)
        bound = max(OUTLIER, 2.0 * np.log(max(len(s), 1) / _CHANCE))
        wrong = np.zeros(len(s), dtype=np.bool_)
        worst = np.argsort(-square)[: np.count_nonzero(square > bound)]
        for k in worst.tolist():  # a wrong one drags those of its label and of its stop with it
            near = wrong & ((s.label == s.label[k]) | (s.stop == s.stop[k]))
            wrong[k] = not near.any()
        if not wrong.any():
            break
        kept = ~wrong
        stops = stops_per_label(s.label[kept], s.stop[kept], len(adjustment.problem.labels))
        stops[adjustment.problem.known.label] += 1
        kept &= stops[s.label] >= 2
        inlier = inlier.copy()
        inlier[np.flatnonzero(inlier)[~kept]] = False
        adjustment = Adjustment(adjustment.problem, s.select(kept))
        state = adjustment.solve(state, SQUARE, iterations=30, tolerance=1e-4, damping=1e-8).state
        sure = covariance(adjustment, state)
    return adjustment, state, sure, inlier
