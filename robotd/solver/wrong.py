"""Measurements besides sightings that contradict all others: moves, motions, known labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .breaks import lost_note, without_moves
from .bundle import SQUARE, Adjustment
from .known_labels import chosen
from .problem import Ints, Problem, State, anchors
from .wheel_errors import LOST, slip_covariance

_SLIP = 20.0  # squared whitened residual of a move, 3 degrees of freedom: one good move in 6000 exceeds it
_WRONG_KNOWN = 25.0


def without_wrong(everything: Adjustment, state: State) -> Problem:
    """Loosen moves that disagree with everything else (wheels slip) and drop known labels that do.

    Returns the problem itself if nothing was wrong.
    """
    problem = everything.problem
    linear = everything.residuals(state, SQUARE)
    moves, known, notes = problem.moves, problem.known, list(problem.notes)
    excess = (linear.move**2).sum(axis=1)
    slipped, motions = excess[: len(moves.before)] > _SLIP, problem.motions
    wrong = excess[len(moves.before) :] > _SLIP
    if wrong.any():
        for k in np.flatnonzero(wrong):
            stop, sigmas = problem.survey.stops[motions.after[k]], np.sqrt(excess[len(moves.before) + k])
            at = f"leg {stop.leg} stop {stop.stop}: the motion by {motions.source[k]}"
            notes.append(f"{at} is {sigmas:.0f} standard deviations from what all else says; it was not used")
        problem = replace(problem, motions=motions.select(~wrong), notes=tuple(notes))
    if slipped.any():
        covariance_ = np.where(
            slipped[:, None, None], moves.covariance + slip_covariance(moves.measured), moves.covariance
        )
        moves = replace(moves, covariance=covariance_, loosened=moves.loosened | slipped)
        lost = slipped & problem.moves.loosened
        moves = without_moves(replace(problem, moves=moves), moves.after[lost]).moves
        for m in np.flatnonzero(slipped & ~lost):
            stop = problem.survey.stops[moves.after[m]]
            sigmas = float(np.sqrt((linear.move[m] ** 2).sum()))
            at = f"leg {stop.leg} stop {stop.stop}: the move to it"
            if not any(note.startswith(at) for note in notes):
                said = f"{sigmas:.0f} standard deviations from what the sightings say"
                notes.append(f"{at} is {said}; treated as a wheel slip")
        problem = replace(problem, moves=moves, notes=tuple(notes))
    excess = np.linalg.norm(state.points[known.label] - known.position, axis=1) / known.sigma
    excess[~np.isin(known.label, problem.sightings.label)] = 0.0
    worst = np.argsort(excess)[-1:]  # one at a time, because a wrong one drags others with it
    return without_known(problem, state, worst[excess[worst] ** 2 > _WRONG_KNOWN])


def with_lost_moves(problem: Problem, state: State) -> Problem:
    """With a note on each move that was not used, in the place of what was said of it as a slip."""
    notes = list(problem.notes)
    for m in np.flatnonzero(problem.moves.covariance[:, 2, 2] >= LOST[2, 2]).tolist():
        said = lost_note(problem, state, m)
        notes = [note for note in notes if not note.startswith(said[: said.index(" is ")])] + [said]
    return replace(problem, notes=tuple(notes))


def without_known(problem: Problem, state: State, wrong: Ints) -> Problem:
    """Drop wrong known labels and name them, as long as enough remain to fix the world frame."""
    for k in sorted(wrong.tolist(), reverse=True):
        known = problem.known
        miss = 1000.0 * float(np.linalg.norm(state.points[known.label[k]] - known.position[k]))
        named = f"known label {problem.labels[known.label[k]]} is"
        if any(note.startswith(named) for note in problem.notes):
            continue
        said = f"{named} {miss:.0f} mm from where the sightings put it"
        keep = np.arange(len(known.label)) != k
        rest = chosen(known, keep)
        if problem.frame == "known labels" and not anchors(rest, problem.sightings):
            note = f"{said}, but too few others fix the world frame; measure a third label"
            problem = replace(problem, notes=(*problem.notes, note))
        else:
            note = f"{said}; its measured position was not used"
            problem = replace(problem, known=rest, notes=(*problem.notes, note))
    return problem
