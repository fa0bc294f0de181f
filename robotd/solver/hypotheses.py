"""Where else each label may be: other positions that its sightings propose, and images of it in glass.

A position is a hypothesis, supported by the sightings that it explains. The position that was adjusted has rivals: what
its other sightings agree on (a reflection, another label's light), and, where few stops agree, what some of them would
say together with one of the sightings that do not fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..records import Floats
from .bundle import SQUARE, Adjustment, Loss
from .initial import FLOOR_M, triangulate, world_rays
from .placement import ray_tolerance
from .problem import Bools, Known, Problem, State, stops_per_label
from .weights import OUTLIER

_APART_M = 0.02  # between two positions, to be two
_SAME_PLACE_M = 0.03  # two labels hang farther apart
_FLOOR_IMAGE_PX = 6.0
_UPRIGHT_M = 0.03  # a label and its image in upright glass are equally high; what tilt and calibration leave
_IMAGES = 4  # images of one label in different panes that are looked for
_CHANCE = 0.25  # share of an image's support with which the label itself stands out from chance
_TWO = 2.5  # support that three sightings have and two have not
_TIE = 0.75  # of one sighting, and of a position's support: with less of a lead, another position is as likely
_TWO_SIGHTINGS = 1.5  # support that two have and one has not
_TWICE = 0.5  # of a position's support, from which three sightings that agree elsewhere are no chance: it was moved
_EXCHANGED = 0.4  # share of a position's support from which another one is no stray wrong name
_FEW_STOPS = 3  # that agree, up to which other sightings may be right and one of these wrong


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """Support `gain` (L,) of each label's position, its best `rivals` (L, 3), NaN where none, and `rival_gain` (L,).

    The support is the sum over groups of rival sightings of probability times (1 - squared residual / threshold).
    `shared` are further rivals (L, 3) with their support (L,), which take some of the position's sightings along.
    `chance` (L,) says whose rival is the label in front of its image, unless chance made it.
    """

    gain: Floats
    rivals: Floats
    rival_gain: Floats
    shared: tuple[tuple[Floats, Floats], ...] = ()
    chance: Bools | None = None

    def tied(self, label: int) -> list[Floats]:
        """The rivals (3,) of a label that are as likely as its position, all of them apart from each other."""
        gain, result = self.gain[label], list[Floats]()
        for points, rival_gain in ((self.rivals, self.rival_gain), *self.shared):
            point, support_ = points[label], rival_gain[label]
            as_likely = gain - support_ < _TIE and support_ > _TIE * gain
            as_likely |= points is self.rivals and support_ > max(_TWO, _TWICE * gain)
            as_likely |= points is self.rivals and self.chance is not None and bool(self.chance[label])
            if np.isfinite(point[0]) and as_likely and all(np.linalg.norm(point - p) > _APART_M for p in result):
                result.append(point)
        return result


def out_of_glass(everything: Adjustment, state: State) -> tuple[State, Bools, Hypotheses]:
    """Take labels out of the mirrors in which they were found.

    A label's image in a pane is as consistent as the label, and may be seen from more stops. But the robot and the
    label are on the same side of the pane, so from every stop the image is farther away than the label: of two
    positions that are equally high, as they are with upright glass, the nearer one is the label, unless it has so
    little support that chance could have made it: any two sightings of labels as high as the cameras meet. Nor is it
    where another label hangs, whose sightings got this one's name.

    Returns
    -------
    state, reflected, hypotheses
        With the labels at the nearer positions, the sightings (N,) that the farther ones explain, and what else these
        leave to be said (see `hypotheses`). The state is the one given if no label was taken out.
    """
    problem = everything.problem
    reflected = np.zeros(len(problem.sightings), dtype=np.bool_)
    for _ in range(_IMAGES):
        found = hypotheses(everything, state, reflected)
        level = _level(problem, state, found.rivals)
        nearer = level & _nearer(problem, state, found.rivals) & (found.rival_gain > _CHANCE * found.gain)
        nearer &= ~_another_hangs_there(state, found, nearer)
        chance = nearer & (found.rival_gain < _TWO) & at_camera_height(problem, found.rivals)
        swap = nearer & ~chance
        keep = level & _farther(problem, state, found.rivals)
        if not (swap | keep).any():
            return state, reflected, replace(found, chance=chance)
        images = np.where(keep[:, None], found.rivals, state.points)
        _, shown = support(everything, replace(state, points=images))
        if swap.any():
            state = replace(state, points=np.where(swap[:, None], found.rivals, state.points))
        _, direct = support(everything, state)
        reflected |= (swap | keep)[problem.sightings.label] & shown & ~direct
    return state, reflected, hypotheses(everything, state, reflected)


def _level(problem: Problem, state: State, rivals: Floats) -> Bools:
    """(L,) labels whose rival position is as high as theirs; known labels are none: where they are was measured."""
    level = np.abs(rivals[:, 2] - state.points[:, 2]) < _UPRIGHT_M
    level[problem.known.label] = False
    return level


def _another_hangs_there(state: State, found: Hypotheses, asked: Bools) -> Bools:
    """(L,) labels, of those `asked`, whose rival position is another label's, with less support than their own."""
    result = np.zeros(len(asked), dtype=np.bool_)
    for i in np.flatnonzero(asked & (found.rival_gain < found.gain)):
        near = np.linalg.norm(state.points - found.rivals[i], axis=1) < _SAME_PLACE_M
        near[i] = False
        result[i] = near.any()
    return result


def _nearer(problem: Problem, state: State, rivals: Floats) -> Bools:
    """(L,) labels whose rival position is nearer than theirs, on the plan, from every stop that saw them."""
    return _compared(problem, state, state.points, rivals)


def _farther(problem: Problem, state: State, rivals: Floats) -> Bools:
    """(L,) the opposite: farther from every stop."""
    return _compared(problem, state, rivals, state.points)


def _compared(problem: Problem, state: State, far: Floats, near: Floats) -> Bools:
    sightings = problem.sightings
    at = problem.stop_entries(state)[sightings.stop, :2]
    to_far = np.linalg.norm(far[sightings.label, :2] - at, axis=1)
    to_near = np.linalg.norm(near[sightings.label, :2] - at, axis=1)
    result = np.ones(len(far), dtype=np.bool_)
    result[sightings.label[~(to_near < to_far)]] = False  # also where one of them is NaN: there is no rival
    return result


def at_camera_height(problem: Problem, points: Floats) -> Bools:
    """(L,) points (L, 3) as high as some camera, so that any two sightings meet there, whatever they are of."""
    return np.asarray((np.abs(points[:, 2, None] - problem.t_robot_camera[:, 2]) < _UPRIGHT_M).any(axis=1))


def behind_glass(problem: Problem, state: State, rivals: Floats) -> Bools:
    """(L,) labels whose rival position may be their image: as high as they, and farther from every stop."""
    return _level(problem, state, rivals) & _farther(problem, state, rivals)


def hypotheses(everything: Adjustment, state: State, without: Bools | None = None) -> Hypotheses:
    """Each label's position against the best one that its other sightings propose; those `without` (N,) do not."""
    gain, explained = support(everything, state)
    rest = ~explained if without is None else ~(explained | without)
    return Hypotheses(gain, *_proposed(everything, state, rest))


def with_shared(everything: Adjustment, state: State, found: Hypotheses, without: Bools) -> Hypotheses:
    """With further rivals where a label's position is supported by few stops: such that take some of them along.

    Where two stops agree and a third does not, that one may be right, and agree with either of the two: labels as high
    as the cameras are on one line for all of them, so that any two of their sightings meet.
    """
    s, count = everything.problem.sightings, len(everything.problem.labels)
    _, explained = support(everything, state)
    odd = ~(explained | without)
    stops = stops_per_label(s.label[explained], s.stop[explained], count)
    doubtful = (stops <= _FEW_STOPS) & (np.bincount(s.label[odd], minlength=count) > 0)
    agreeing = explained & doubtful[s.label]
    shared = list[tuple[Floats, Floats]]()
    last = np.full(count, -1)
    for _ in range(_FEW_STOPS):
        following = np.full(count, np.iinfo(np.int64).max)
        later = agreeing & (s.stop > last[s.label])
        if not later.any():
            break
        np.minimum.at(following, s.label[later], s.stop[later])
        rest = (odd & doubtful[s.label]) | (later & (s.stop == following[s.label]))
        shared.append(_proposed(everything, state, rest))
        last = following
    return replace(found, shared=tuple(shared))


def _proposed(everything: Adjustment, state: State, rest: Bools) -> tuple[Floats, Floats]:
    """The best position (L, 3) that some sightings propose apart from the state's, and its support among all."""
    problem = everything.problem
    nothing = Known(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
    fixed = replace(problem, prior_sigma=np.zeros_like(problem.prior_sigma), known=nothing)
    chosen = problem.sightings.select(rest)
    count = len(problem.labels)
    none = np.full((count, 3), np.nan), np.zeros(count)
    if len(chosen) == 0:
        return none
    origin, direction = world_rays(fixed, chosen, state)
    points, found = triangulate(
        origin, direction, chosen.label, chosen.stop, chosen.probability, count, ray_tolerance(problem)
    )
    chosen = chosen.select(found[chosen.label])
    if len(chosen) == 0:
        return none
    trial = replace(state, points=np.where(found[:, None], points, state.points))
    adjustment = Adjustment(fixed, chosen)
    for loss in (Loss("geman-mcclure", 1.0), Loss("geman-mcclure")):
        trial = adjustment.solve(trial, loss, iterations=12, tolerance=1e-2).state
    gain, fits = support(everything, trial)
    found &= stops_per_label(problem.sightings.label[fits], problem.sightings.stop[fits], count) >= 2
    found &= (np.linalg.norm(trial.points - state.points, axis=1) > _APART_M) & (trial.points[:, 2] > FLOOR_M)
    return np.where(found[:, None], trial.points, np.nan), np.where(found, gain, 0.0)


def in_floor(everything: Adjustment, state: State) -> Bools:
    """Which sightings lie where the floor would mirror their label; its tilt and waves move images by some pixels."""
    mirrored = replace(state, points=state.points * [1.0, 1.0, -1.0])
    linear = everything.residuals(mirrored, SQUARE)
    miss = np.linalg.norm(linear.residual, axis=1) * everything.sightings.sigma
    return np.asarray(linear.valid & (miss < _FLOOR_IMAGE_PX))


def support(everything: Adjustment, state: State) -> tuple[Floats, Bools]:
    """Support (L,) of each label's position, and which sightings (N,) the state explains."""
    sightings = everything.sightings
    square = (everything.residuals(state, SQUARE).residual ** 2).sum(axis=1)
    worth = sightings.probability * np.maximum(1.0 - square / OUTLIER, 0.0)
    groups, owner = np.unique(sightings.rival, return_inverse=True)
    best, label = np.zeros(len(groups)), np.zeros(len(groups), dtype=np.int64)
    np.maximum.at(best, owner.ravel(), worth)
    label[owner.ravel()] = sightings.label
    gain = np.bincount(label, best, len(everything.problem.labels)).astype(np.float64)
    return gain, np.asarray(square < OUTLIER)


def exchanged(everything: Adjustment, state: State, found: Hypotheses, located: Bools) -> Bools:
    """(L,) labels whose names seem to have been exchanged with another's on the way.

    One of two then has a second position where the other hangs, and sightings of that one point at the first's; or both
    are in one place, and one has another.
    """
    points, result = state.points, np.zeros(len(state.points), dtype=np.bool_)
    doubtful = located & np.isfinite(found.rivals[:, 0]) & (found.rival_gain > _EXCHANGED * found.gain)
    for i in np.flatnonzero(doubtful).tolist():
        there = located & (np.linalg.norm(points - found.rivals[i], axis=1) < _SAME_PLACE_M)
        here = located & (np.linalg.norm(points - points[i], axis=1) < _SAME_PLACE_M)
        here[i] = False
        if there.any():
            gain, _ = support(everything, replace(state, points=np.where(there[:, None], points[i], points)))
            there &= gain > _TWO_SIGHTINGS
        result |= there
        result[i] |= bool(there.any() or here.any())
    return result
