"""How much each sighting really counts: variance components estimated from the residuals (thesis section 3.3).

A detector states a standard deviation for every light; how well a lens is described, it cannot know, and a cautious one
states too much. Sightings are sorted into classes of like stated standard deviation, and these by camera. Each class's
variance factor is the sum of its squared whitened residuals over its redundancy, which is its count less what fitting
took (W. Foerstner, 1979); classes with little redundancy are drawn to the ones above them. As new weights change the
fit, this is repeated until they stay.

Errors that many sightings share (a lens badly described in one corner, a camera that sat askew at one stop) do not
average out as independent ones do. Where the residuals of such groups add up to more than chance allows, the variances
grow by the design effect, by which the variance of the groups' sums exceeds the one of independent residuals.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..records import Floats
from .bundle import SQUARE, Adjustment
from .covariance import Covariance, covariance
from .problem import Bools, Ints, State

OUTLIER = 20.0  # squared whitened residual, 2 degrees of freedom: one right sighting in 20 000 exceeds it
LEAST_PX = 0.003  # because no lens is described better, however well residuals agree
_PRIOR = 10.0  # redundant values that a class's parent counts for
_FEW = 20.0  # redundant values below which stated standard deviations stand
_SURE = 3.0  # standard deviations by which a variance factor must differ from 1
_SETTLED = 0.05  # relative change of standard deviations that is left
_ROUNDS = 12
_CELL_PX = 80.0  # a lens that is badly described is so over regions of this size


def weighed(
    adjustment: Adjustment, state: State, sure: Covariance, stated: Floats
) -> tuple[Adjustment, State, Covariance]:
    """The same least-squares problem with weights that fit its residuals, its optimum and covariance.

    Parameters
    ----------
    adjustment : Adjustment
    state : State
        Its optimum.
    sure : Covariance
        There.
    stated : (N,) array
        Standard deviations of the sightings as the survey has them, px.

    Returns
    -------
    adjustment, state, covariance
        Those given if the residuals do not contradict the weights.
    """
    if not _contradicted(adjustment, state, sure, stated):
        return adjustment, state, sure
    accepted = adjustment.sightings.sigma
    stray = np.zeros(len(accepted), dtype=np.bool_)
    for _ in range(_ROUNDS):
        now = adjustment.sightings.sigma
        residual = adjustment.residuals(state, SQUARE).residual * now[:, None]
        sigma = _sigmas(adjustment, residual, sure, stated, ~stray)
        # tails are no part of a class's noise: what does not fit it keeps the weight with which it was accepted
        stray = (residual**2).sum(axis=1) > OUTLIER * sigma**2
        sigma = np.where(stray, np.maximum(sigma, accepted), sigma)
        sightings = replace(adjustment.sightings, sigma=sigma)
        adjustment = Adjustment(adjustment.problem, sightings)
        state = adjustment.solve(state, SQUARE, iterations=30, tolerance=1e-4, damping=1e-8).state
        sure = covariance(adjustment, state)
        if np.abs(np.log(sigma / now)).max() < _SETTLED:
            break
    return adjustment, state, sure


def _classes(adjustment: Adjustment, stated: Floats) -> tuple[Ints, Ints]:
    """(N,) class of each sighting by octave of its stated standard deviation, and by octave and camera."""
    octave = np.floor(np.log2(stated * (1.0 + 1e-9))).astype(np.int64)
    _, octave = np.unique(octave, return_inverse=True)
    return octave.ravel(), octave.ravel() * len(adjustment.problem.cameras) + adjustment.sightings.camera


def _contradicted(adjustment: Adjustment, state: State, sure: Covariance, stated: Floats) -> bool:
    """Whether some class's residuals, or the sums of residuals that share a cause, are not what weights say."""
    spare = 2.0 - sure.leverage
    if float(spare.sum()) < _FEW:
        return False
    residual = adjustment.residuals(state, SQUARE).residual
    octave, _ = _classes(adjustment, stated)
    total, count = np.bincount(octave, (residual**2).sum(axis=1)), np.bincount(octave, spare)
    enough = count >= _FEW
    off = np.abs(total[enough] / count[enough] - 1.0) > _SURE * np.sqrt(2.0 / count[enough])
    return bool(off.any()) or _design_effect(adjustment, residual, spare) > 1.0


def _sigmas(adjustment: Adjustment, residual: Floats, sure: Covariance, stated: Floats, fits: Bools) -> Floats:
    """(N,) standard deviations that residuals (N, 2), in px, show; those that do not fit tell nothing."""
    square, spare = np.where(fits, (residual**2).sum(axis=1) / stated**2, 0.0), np.where(fits, 2.0 - sure.leverage, 0.0)
    factor = np.full(len(stated), square.sum() / max(float(spare.sum()), 1e-6))
    for key in _classes(adjustment, stated):
        above = np.zeros(key.max() + 1)
        above[key] = factor
        factor = ((_PRIOR * above + np.bincount(key, square)) / (_PRIOR + np.bincount(key, spare)))[key]
    sigma = np.maximum(stated * np.sqrt(factor), LEAST_PX)
    effect = _design_effect(adjustment, np.where(fits[:, None], residual / sigma[:, None], 0.0), spare)
    return np.asarray(sigma * np.sqrt(effect))


def _design_effect(adjustment: Adjustment, residual: Floats, spare: Floats) -> float:
    """By how much the sums of whitened residuals (N, 2) over groups vary more than if these were independent; >= 1.

    Groups are looks (one camera at one stop), regions of a camera's image, and rings around its centre, in which
    residuals along the radius add up: so a lens shows whose distortion is not as stated.
    """
    s, cameras = adjustment.sightings, adjustment.problem.cameras
    away = s.uv - np.array([camera.centre for camera in cameras])[s.camera]
    distance = np.hypot(*away.T)
    u, v = (away / np.maximum(distance, 1e-9)[:, None]).T
    radial = np.column_stack([u * residual[:, 0] + v * residual[:, 1], u * residual[:, 1] - v * residual[:, 0]])
    region = np.floor(s.uv / _CELL_PX).astype(np.int64)
    ring = np.floor(distance / _CELL_PX).astype(np.int64)
    groups = ((s.stop, residual), (region[:, 0] * 1000 + region[:, 1], residual), (ring, radial))
    return max(1.0, *(_spread(key * len(cameras) + s.camera, values, spare) for key, values in groups))


def _spread(key: Ints, residual: Floats, spare: Floats) -> float:
    """The design effect of one grouping; 1 where chance explains it."""
    _, group = np.unique(key, return_inverse=True)
    group = group.ravel()
    mixed: Bools = np.bincount(group)[group] > 1
    if not mixed.any():
        return 1.0
    expected = np.bincount(group[mixed], spare[mixed])
    sums = np.column_stack([np.bincount(group[mixed], residual[mixed, k]) for k in (0, 1)])
    found = float((sums**2).sum() / expected.sum())
    chance = float(np.sqrt((expected**2).sum()) / expected.sum())
    return found if found > 1.0 + _SURE * chance else 1.0
