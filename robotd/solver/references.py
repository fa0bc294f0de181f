"""Known labels and roof cameras against the map that the robot makes without them: which of them agree.

Outside references fix the world frame, so that a wrong one among few turns, shifts or stretches the whole map, and
nothing else stands up to it. Held against the map in the first stop's axes, those that are right fit it by one motion
in the plane; known labels must hang as high as it says, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import gammaincc

from ..geometry.transforms import heading_matrix
from ..records import Floats
from .bundle import Adjustment
from .covariance import Covariance, frame_covariance
from .known_labels import chosen
from .problem import STOP, Bools, Ints, Problem, State

IMPOSSIBLE, POSSIBLE = 1e-8, 1e-4  # probabilities of how far the calibration is from its priors
MOST_TO_TRY = 5000  # sightings
_TOLD = 0.02  # share of a prior's variance from which the survey tells about it
_SAME_M = 0.05  # apart to which a reference may be imprecise, and is not wrong
_BEYOND = 3.0  # standard deviations, of a reference and of the map, from which they disagree
_SCATTER = 3.0  # times their standard deviations by which beacons may scatter and still be right
_MOSTLY = 0.6  # of all references must agree
_RIVAL = 0.75  # of as many, if a good part of them is others, agree otherwise
_MOST_PAIRS = 600
_WRONG_BEACON = (
    30.0  # squared whitened residual of a beacon, 2 degrees of freedom: one good one in 3 million exceeds it
)


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """References: where the map has them `here` (R, 3) and they say that they are `there` (R, 3), NaN for no height.

    `tolerance` (R,) metres; `known` (R,) says which are known labels (all others are beacons), `index` (R,) which one.
    """

    here: Floats
    there: Floats
    tolerance: Floats
    known: Bools
    index: Ints


def chance(adjustment: Adjustment, state: State) -> float:
    """Probability that the calibration is as far from its priors as the optimum has it; 1 where nothing tells.

    What is estimated of a quantity scatters about its prior by the prior's variance less the one that is left.
    """
    problem = adjustment.problem
    entries = np.arange(STOP * problem.stop_count, len(problem.prior_sigma))
    prior = problem.prior_sigma[entries]
    entries, prior = entries[prior > 0.0], prior[prior > 0.0]
    if len(entries) == 0 or len(problem.sightings) > MOST_TO_TRY:
        return 1.0
    left = frame_covariance(adjustment, state)
    if left is None:
        return 1.0
    spread = np.eye(len(entries)) - left[np.ix_(entries, entries)] / np.outer(prior, prior)
    values, vectors = np.linalg.eigh(spread)
    told = values > _TOLD
    size = float(((vectors.T @ (state.frame[entries] / prior))[told] ** 2 / values[told]).sum())
    return float(gammaincc(0.5 * np.count_nonzero(told), 0.5 * size)) if told.any() and np.isfinite(size) else 1.0


def bends(one: Floats, other: Floats) -> bool:
    """Whether points (L, 3) of two maps differ by more than a motion in the plane."""
    a, b = one[:, :2] - one[:, :2].mean(axis=0), other[:, :2] - other[:, :2].mean(axis=0)
    miss = b - a @ heading_matrix(_heading(a, b)).T
    return bool(np.sqrt((miss**2).sum(axis=1).mean()) > _SAME_M)


def _heading(a: Floats, b: Floats) -> float:
    """Heading that turns points (N, 2) onto others, both about their middle (Umeyama, 1991)."""
    return float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))


def beacons_disagree(problem: Problem, residual: Floats) -> bool:
    """Whether beacons contradict the optimum, given their whitened residuals (B, 2)."""
    return problem.frame == "roof cameras" and bool(((residual**2).sum(axis=1) > _WRONG_BEACON).any())


def agreeing(problem: Problem, state: State, sure: Covariance, labels: Ints, placed: Bools) -> Problem | None:
    """The problem with those references only that agree with a map made without any.

    Parameters
    ----------
    problem : Problem
        With its references.
    state, sure, labels, placed : State, Covariance, (l,) indices, (S,) bool
        The optimum without them: labels with a position, and stops with a place in it.

    Returns
    -------
    Problem or None
        The problem itself if all agree, one with notes on those that do not, or None if which are right is open.
    """
    places = _places(problem, state, sure, labels, placed)
    count = len(places.here)
    if count < 2:
        return None
    best, sets = np.zeros(count, dtype=np.bool_), []
    pairs = np.array(list(combinations(range(count), 2)))[:: 1 + count * count // (2 * _MOST_PAIRS)]
    apart = np.linalg.norm(places.there[pairs[:, 0], :2] - places.there[pairs[:, 1], :2], axis=1)
    for pair in pairs[apart > 0.3 * apart.max()]:
        sets.append(_agreeing(places, pair))
        if np.count_nonzero(sets[-1]) > np.count_nonzero(best):
            best = sets[-1]
    size = np.count_nonzero(best)
    others = [s for s in sets if np.count_nonzero(s) >= _RIVAL * size and np.count_nonzero(s & ~best) >= 0.25 * size]
    if size < max(2.0, _MOSTLY * count) or others:
        return None
    return problem if best.all() else _without(problem, state, places, ~best)


def _places(problem: Problem, state: State, sure: Covariance, labels: Ints, placed: Bools) -> _Places:
    known, roofs = problem.known, problem.roofs
    row = np.full(len(problem.labels), -1)
    row[labels] = np.arange(len(labels))
    k = np.flatnonzero(row[known.label] >= 0)
    spread = np.linalg.eigvalsh(sure.points[row[known.label[k]]])[:, -1] if len(k) else np.zeros(0)
    b = np.flatnonzero(placed[roofs.stop])
    poses = problem.stop_entries(state)[roofs.stop[b], :3]
    here = poses[:, :2] + (heading_matrix(poses[:, 2]) @ roofs.beacon[b, :2, None])[:, :, 0]
    inverse = np.asarray(np.linalg.inv(roofs.H_image_world[b]), dtype=np.float64)
    there, aside = _on_floor(inverse, roofs.uv[b]), _on_floor(inverse, roofs.uv[b] + 1.0)
    metres = _SCATTER * roofs.sigma[b] * np.linalg.norm(aside - there, axis=1)
    wide = np.linalg.eigvalsh(sure.stops[roofs.stop[b]][:, :2, :2])[:, -1] if len(b) else np.zeros(0)
    high = np.full((len(b), 1), np.nan)
    return _Places(
        np.vstack([state.points[known.label[k]], np.hstack([here, high])]),
        np.vstack([known.position[k], np.hstack([there, high])]),
        np.maximum(_SAME_M, _BEYOND * np.sqrt(np.concatenate([known.sigma[k] ** 2 + spread, metres**2 + wide]))),
        np.arange(len(k) + len(b)) < len(k),
        np.concatenate([k, b]),
    )


def _on_floor(H: Floats, uv: Floats) -> Floats:
    """(B, 2) world x, y of roof cameras' pixels."""
    h = (H @ np.column_stack([uv, np.ones(len(uv))])[:, :, None])[:, :, 0]
    return np.asarray(h[:, :2] / h[:, 2:])


def _agreeing(places: _Places, pair: Ints) -> Bools:
    """(R,) the references that fit the motion of two of them, then of all that do."""
    level = ~(np.abs(places.here[:, 2] - places.there[:, 2]) > places.tolerance)  # no height contradicts none
    fits = np.zeros(len(level), dtype=np.bool_)
    fits[pair] = True
    for _ in range(3):
        if np.count_nonzero(fits) < 2:
            break
        a, b = places.here[fits, :2].mean(axis=0), places.there[fits, :2].mean(axis=0)
        heading = _heading(places.here[fits, :2] - a, places.there[fits, :2] - b)
        miss = places.there[:, :2] - b - (places.here[:, :2] - a) @ heading_matrix(heading).T
        fits = level & (np.linalg.norm(miss, axis=1) < places.tolerance)
    return fits


def _without(problem: Problem, state: State, places: _Places, wrong: Bools) -> Problem:
    """The problem without some references, which its notes name."""
    known, roofs, notes = problem.known, problem.roofs, list(problem.notes)
    labels, beacons = places.index[wrong & places.known], places.index[wrong & ~places.known]
    all_of, lost = np.bincount(roofs.camera), np.bincount(roofs.camera[beacons], minlength=len(roofs.camera))
    beacons = np.union1d(beacons, np.flatnonzero(2 * lost[roofs.camera] > all_of[roofs.camera]))
    notes += [
        f"known label {problem.labels[known.label[k]]} contradicts the sightings and the other references; its "
        "measured position was not used"
        for k in labels.tolist()
    ]
    for camera in np.flatnonzero(lost).tolist():
        name, share = problem.survey.roof_cameras[camera].name, f"{lost[camera]} of its {all_of[camera]} sightings"
        what = "it was not used; check its homography" if 2 * lost[camera] > all_of[camera] else "these were not used"
        notes.append(f"roof camera {name}: {share} of beacons contradict all else; {what}")
    kept, shown = np.ones(len(known.label), dtype=np.bool_), np.ones(len(roofs.stop), dtype=np.bool_)
    kept[labels], shown[beacons] = False, False
    return replace(problem, known=chosen(known, kept), roofs=roofs.select(shown), notes=tuple(notes))
