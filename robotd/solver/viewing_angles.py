"""Where to look from next by viewing angles alone: the thesis's heat map and force field (section 5.1).

From a next place, beta are the angles between neighbouring labels as seen there, alpha those by which the directions to
each label differ from the present place's (equations 58 and 59). Their root mean square says how good a place is
(equation 60, as a mean: erratum B8); labels are taken in the order of their bearings and angles are wrapped (B7).
"""

from __future__ import annotations

import numpy as np

from ..geometry.transforms import wrap_angle
from ..records import Floats


def viewing_angles(places: Floats, here: Floats, labels: Floats) -> Floats:
    """How good places are, in radians.

    Parameters
    ----------
    places : (N, 2) array
        Next places, metres.
    here : (2,) array
        The present place.
    labels : (J, 2) array
        On the plan; at least one.

    Returns
    -------
    (N,) array
        Root mean square of the J external and J - 1 internal angles.

    Raises
    ------
    ValueError
        If there is no label.
    """
    if len(labels) < 1:
        raise ValueError("need at least one label")
    offset = labels - places[:, None]
    bearing = np.arctan2(offset[..., 1], offset[..., 0])
    before = np.arctan2(*(labels - here).T[::-1])
    alpha = np.asarray(wrap_angle(bearing - before))
    ordered = np.sort(bearing, axis=1)
    gaps = np.diff(ordered, axis=1, append=ordered[:, :1] + 2.0 * np.pi)
    beta = np.asarray(wrap_angle(np.sort(gaps, axis=1)[:, :-1]))  # a fan ends at its widest gap, which is none of them
    square = (alpha**2).sum(axis=1) + (beta**2).sum(axis=1)
    return np.asarray(np.sqrt(square / (2 * len(labels) - 1)))


def force_field(places: Floats, here: Floats, labels: Floats, step: float = 0.02) -> Floats:
    """Unit directions (N, 2) in which the sum of squared viewing angles grows fastest; zero where it does not.

    Taken by central differences over `step` metres; parameters as in `viewing_angles`.
    """
    shifts = step * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    squares = np.stack([viewing_angles(places + shift, here, labels) ** 2 for shift in shifts])
    slope = np.column_stack([squares[0] - squares[1], squares[2] - squares[3]])
    length = np.hypot(*slope.T)[:, None]
    return np.asarray(np.divide(slope, length, out=np.zeros_like(slope), where=length > 1e-12))
