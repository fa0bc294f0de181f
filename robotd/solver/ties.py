"""Stops that few labels tie to the rest of a map, and whether these could be tied in another way as well.

Three shared labels hold a stop's pose with little to spare. If one of them is a reflection or has a wrong name, the
whole part beyond may stand elsewhere and fit as well, while its covariance says that it is sure. So each label of a
weak tie is doubted in turn: without its sightings on one side the survey is adjusted anew, then all sightings are
judged again. Another optimum that explains them about as well is a rival that is reported, because to choose would be
to guess.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..records import Floats
from .bundle import Adjustment, Loss
from .placement import detach
from .problem import STOP, Bools, Ints, Problem, Sightings, State

WEAK = 4  # shared labels up to which a tie is doubted
_UNCHECKED = 2  # up to which one wrong identity goes unnoticed whatever is tried
_LEAD = 4.0  # of the cost: half of what one sighting is worth
_APART_M = 0.02  # between two optima's stops, to be two
_WINDOW = 10  # stops to either side within which a tie is doubted first
_AGAIN = (Loss("cauchy", 7.5), Loss("cauchy", 2.5, width=2.0), Loss("geman-mcclure", 0.4))
_JUDGE = Loss("geman-mcclure")


@dataclass(frozen=True, slots=True, eq=False)
class Tie:
    """Stops `side` (S,) that only `labels` join to all others: the first or last so many, or a single one."""

    side: Bools
    labels: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """A second optimum: its state, its robust cost and the chosen one's, and the tie that allows both."""

    state: State
    cost: float
    chosen_cost: float
    tie: Tie


def weak_ties(problem: Problem, sightings: Sightings, most: int = WEAK) -> Iterator[Tie]:
    """Ties by at least one and at most so many labels, according to sightings that fit."""
    stops, count = problem.stop_count, len(problem.labels)
    first, last = np.full(count, stops), np.full(count, -1)
    np.minimum.at(first, sightings.label, sightings.stop)
    np.maximum.at(last, sightings.label, sightings.stop)
    seen = last >= 0
    across = np.cumsum(
        np.bincount(first[seen] + 1, minlength=stops + 2) - np.bincount(last[seen] + 1, minlength=stops + 2)
    )
    number = np.arange(stops)
    for k in range(1, stops):
        if 0 < across[k] <= most:
            yield Tie(number < k, np.flatnonzero(seen & (first < k) & (last >= k)))
    joins = np.flatnonzero((first < last)[sightings.label])
    looks = np.bincount(sightings.stop[joins], minlength=stops)
    for k in np.flatnonzero((looks > 0) & (looks <= most * len(problem.cameras))).tolist():
        labels = np.unique(sightings.label[joins[sightings.stop[joins] == k]])
        if 0 < k < stops - 1 and len(labels) <= most:
            yield Tie(number == k, labels)


def doubted(problem: Problem, state: State, sightings: Sightings) -> tuple[State, Rival | None]:
    """The better of the optima that weak ties allow, and the other one if it is nearly as good.

    Parameters
    ----------
    problem : Problem
    state : State
        Its robust optimum.
    sightings : Sightings
        Those that fit there.
    """
    everything, rival = Adjustment(problem, problem.sightings), None
    cost: float | None = None
    for tie in weak_ties(problem, sightings):
        near = _around(tie)
        for without in _doubts(problem, tie):
            if not near.all() and not _may_rival(problem, state, near, without):
                continue
            if cost is None:
                cost = everything.solve(state, _JUDGE, iterations=30, tolerance=1e-3, damping=1e-6).cost
            other, other_cost = _without(everything, state, without)
            if other_cost > cost + _LEAD or _apart(problem, state, other) < _APART_M:
                continue
            if other_cost < cost:
                state, other, cost, other_cost = other, state, other_cost, cost
            if rival is None or other_cost < rival.cost:
                rival = Rival(other, other_cost, cost, tie)
    if rival is None or cost is None or rival.cost > cost + _LEAD:
        return state, None
    return state, replace(rival, chosen_cost=cost)


def unchecked(problem: Problem, sightings: Sightings) -> list[str]:
    """Sentences on ties so weak that a wrong identity would go unnoticed."""
    found = []
    for tie in weak_ties(problem, sightings, _UNCHECKED):
        labels = ", ".join(problem.labels[i] for i in tie.labels)
        found.append(
            f"leg/stop {side_of(problem, tie)} and the rest share only {labels}: a wrong identity there would go "
            "unnoticed; map more of the same labels from both"
        )
    return found


def side_of(problem: Problem, tie: Tie) -> str:
    """The smaller side of a tie, by leg and stop."""
    side = tie.side if 2 * np.count_nonzero(tie.side) <= len(tie.side) else ~tie.side
    stops = [problem.survey.stops[k] for k in np.flatnonzero(side)]
    names = [f"{stop.leg}/{stop.stop}" for stop in stops]
    return ", ".join(names) if len(names) <= 6 else f"{names[0]} to {names[-1]}"


def _doubts(problem: Problem, tie: Tie) -> Iterator[Bools]:
    """(N,) sightings to leave out: each label's on one side of the tie, where it has fewer, or as many, of them."""
    s = problem.sightings
    inside = tie.side[s.stop]
    for label in tie.labels:
        mine = s.label == label
        here, there = int(np.count_nonzero(mine & inside)), int(np.count_nonzero(mine & ~inside))
        if here <= there:
            yield mine & inside
        if there <= here:
            yield mine & ~inside


def _around(tie: Tie) -> Bools:
    """(S,) stops near the place where a tie is."""
    ends = np.flatnonzero(np.diff(tie.side.astype(np.int64)))
    near = np.zeros(len(tie.side), dtype=np.bool_)
    near[max(0, ends[0] + 1 - _WINDOW) : ends[-1] + 1 + _WINDOW] = True
    return near


def _may_rival(problem: Problem, state: State, near: Bools, without: Bools) -> bool:
    """Whether there is another optimum among the stops near a tie, in which case it is worth a look at all."""
    part = detach(problem, near)
    prior = part.prior_sigma.copy()
    first = int(np.argmax(near))
    prior[STOP * first : STOP * first + 3] = 0.0
    part = replace(part, prior_sigma=prior)
    everything = Adjustment(part, part.sightings)
    here = everything.solve(state, _JUDGE, iterations=30, tolerance=1e-3, damping=1e-6)
    other, cost = _without(everything, here.state, without[near[problem.sightings.stop]])
    return cost < here.cost + _LEAD and _apart(part, here.state, other) >= _APART_M


def _without(everything: Adjustment, state: State, without: Bools) -> tuple[State, float]:
    """The optimum near the one of all sightings but some, judged by all, and its robust cost."""
    problem = everything.problem
    doubtful = Adjustment(problem, problem.sightings.select(~without))
    for loss in _AGAIN:
        state = doubtful.solve(state, loss, iterations=12, tolerance=0.1).state
    solution = everything.solve(state, _JUDGE, iterations=30, tolerance=1e-3, damping=1e-6)
    return solution.state, solution.cost


def _apart(problem: Problem, one: State, other: State) -> float:
    """The farthest that any stop stands from where it stands in the other state, metres."""
    difference: Floats = problem.stop_entries(one)[:, :2] - problem.stop_entries(other)[:, :2]
    return float(np.hypot(*difference.T).max())
