"""Moves that are not the robot's: somebody pushed or carried it in the middle of a leg.

Odometry then leads to a wrong place, and each side of the break explains its own sightings by itself, at two places for
the same labels. The map stands by the side that saw more of a label and takes what the other one saw for outliers, so
that nothing else shows the break. It is found by labels that both sides saw near it and that hardly any sighting of
one of the sides agrees with; without the move, these labels join the sides.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..geometry.transforms import se2_relative, wrap_angle
from .problem import Bools, Ints, Problem, Sightings, State
from .wheel_errors import LOST

_CARRIED_M, _CARRIED_RAD = 0.1, 0.3  # beyond what a wheel slips
_NEAR = 3  # stops to either side of a move
_LEAST = 3  # labels that both sides saw: as many as it takes to join them
_TORN = 0.5  # of these, on which the sides agree


def torn_moves(problem: Problem, inlier: Bools) -> Ints:
    """The stop after each move across which sightings hardly agree, given which of the problem's sightings fit (N,).

    Of moves in a row only the one with the least agreement, because a break tears what is near it, too.
    """
    moves, found = problem.moves, []
    seen, fits = _looks(problem, problem.sightings), _looks(problem, problem.sightings.select(inlier))
    for before, after in zip(moves.before.tolist(), moves.after.tolist(), strict=True):
        both, agreed = (_across(problem, looks, before, after) for looks in (seen, fits))
        if both >= _LEAST and agreed <= _TORN * both:
            found.append((agreed / both, after))
    torn = {after: share for share, after in found}
    chosen = [
        after
        for after, share in torn.items()
        if share < torn.get(after - 1, np.inf) and share <= torn.get(after + 1, np.inf)
    ]
    return np.array(chosen, dtype=np.int64)


def _across(problem: Problem, looks: list[set[int]], before: int, after: int) -> int:
    """How many labels were looked at from a few stops to either side of a move, of its leg."""
    leg, sides = problem.leg, (range(before - _NEAR + 1, before + 1), range(after, after + _NEAR))
    here, there = (
        set[int]().union(*(looks[k] for k in side if 0 <= k < len(leg) and leg[k] == leg[before])) for side in sides
    )
    return len(here & there)


def _looks(problem: Problem, sightings: Sightings) -> list[set[int]]:
    """The labels that each stop saw."""
    looks: list[set[int]] = [set() for _ in range(problem.stop_count)]
    for stop, label in zip(sightings.stop.tolist(), sightings.label.tolist(), strict=True):
        looks[stop].add(label)
    return looks


def without_moves(problem: Problem, after: Ints) -> Problem:
    """The problem in which the moves to some stops say nothing."""
    moves = problem.moves
    lost = np.isin(moves.after, after)
    covariance = np.where(lost[:, None, None], LOST, moves.covariance)
    return replace(problem, moves=replace(moves, covariance=covariance, loosened=moves.loosened | lost))


def carried(problem: Problem, state: State) -> Ints:
    """Moves that were not used and lead elsewhere by more than a wheel ever slipped."""
    lost = np.flatnonzero(problem.moves.covariance[:, 2, 2] >= LOST[2, 2])
    off = np.array([_off(problem, state, m) for m in lost.tolist()]).reshape(-1, 2)
    return np.asarray(lost[(off[:, 0] > _CARRIED_M) | (off[:, 1] > _CARRIED_RAD)])


def _off(problem: Problem, state: State, m: int) -> tuple[float, float]:
    """By how far, in metres and radians, a move is wrong."""
    moves, poses = problem.moves, problem.stop_entries(state)[:, :3]
    true = se2_relative(poses[moves.before[m]], poses[moves.after[m]])
    far = float(np.hypot(*(true - moves.measured[m])[:2]))
    return far, float(abs(wrap_angle(float(true[2] - moves.measured[m][2]))))


def lost_note(problem: Problem, state: State, m: int) -> str:
    """A sentence on a move that was not used: by how much it is wrong."""
    stop = problem.survey.stops[problem.moves.after[m]]
    far, turn = _off(problem, state, m)
    why = ", more than wheels slip; it was not used (was the robot pushed or carried?)"
    if far <= _CARRIED_M and turn <= _CARRIED_RAD:
        why = ", more than its covariance says; it was not used (did a wheel slip?)"
    return (
        f"leg {stop.leg} stop {stop.stop}: the move to it is {far:.2g} m and {np.degrees(turn):.2g} degrees from what "
        f"the sightings say{why}"
    )
