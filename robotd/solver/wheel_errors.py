"""What is wrong with all moves of a survey alike: the wheels' scale, their base, and their difference."""

from __future__ import annotations

import numpy as np

from ..records import Floats, Move, Priors

EXACT = 1e-12  # of a prior: so little that its information would drown all other in rounding
SLIPPED = np.diag([0.05, 0.05, 0.25]) ** 2  # of a slipped move, where it ended: one wheel spun for some centimetres
LOST = np.diag([1e3, 1e3, 1e3]) ** 2  # of a move that says nothing: somebody carried or pushed the robot
_SAME_MOVE_M = 1e-3


def arc_by_errors(move: Floats) -> Floats:
    """(3, 3) derivatives of a move (3,) by errors of scale and turns, and drift, if its way was an arc.

    What turns the robot on its way bends the way, whose end then lies half of the whole turn aside.
    """
    x, y, turn = move
    way = np.hypot(x, y) / np.sinc(0.5 * turn / np.pi)
    bent = np.array([-0.5 * y, 0.5 * x, 1.0])
    return np.column_stack([[x, y, 0.0], bent * turn, bent * way])


def move_by_errors(move: Move) -> Floats:
    """(3, 3) derivatives as the survey has them; an arc's where it has none, or those of another move."""
    measured = np.array([move.dx, move.dy, move.dheading])
    if move.by_errors is None:
        return arc_by_errors(measured)
    given = np.array(move.by_errors)
    # an error of the scale does nothing but scale; else somebody changed the move alone
    if not np.allclose(given[:, 0], [move.dx, move.dy, 0.0], rtol=0.0, atol=_SAME_MOVE_M):
        return arc_by_errors(measured)
    return given


def slip_covariance(moves: Floats) -> Floats:
    """(M, 3, 3) of what a slip somewhere on the way of moves (M, 3) adds to their errors.

    A wheel that spins turns the robot, and what is left of the way then leads aside: a turn by a after a share s of the
    way shifts the end by (1 - s) a times the way, with s anywhere between 0 and 1.
    """
    result = np.tile(SLIPPED, (len(moves), 1, 1))
    aside = np.column_stack([-moves[:, 1], moves[:, 0]])
    turn = SLIPPED[2, 2]
    result[:, :2, :2] += turn / 3.0 * aside[:, :, None] * aside[:, None, :]
    result[:, :2, 2] = result[:, 2, :2] = turn / 2.0 * aside
    return result


def odometry_sigmas(priors: Priors) -> tuple[float, float, float]:
    """Prior standard deviations of scale, of turns beyond `coupling` times the scale's error, and of drift."""
    alone = 1.0 - priors.odometry_correlation**2 if priors.odometry_scale > EXACT else 1.0
    return priors.odometry_scale, priors.odometry_turn * float(np.sqrt(max(alone, 1e-6))), priors.odometry_drift


def coupling(priors: Priors) -> float:
    """Error of turns to expect per error of scale: turns show well in a survey and tell about its scale."""
    p = priors
    return p.odometry_correlation * p.odometry_turn / p.odometry_scale if p.odometry_scale > EXACT else 0.0
