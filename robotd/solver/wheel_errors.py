"""What is wrong with all moves of a survey alike: the wheels' scale, their base, and their difference."""

from __future__ import annotations

import numpy as np

from ..records import Floats, Move, Priors

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


def coupling(priors: Priors) -> float:
    """Error of turns to expect per error of scale: turns show well in a survey and tell about its scale."""
    p = priors
    return p.odometry_correlation * p.odometry_turn / p.odometry_scale if p.odometry_scale > 0.0 else 0.0
