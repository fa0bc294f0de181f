"""The line on the floor in world axes: what the follower stitched in odometry axes, bent to the poses of the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from robotd.errors import InputError
from robotd.records import Floats, LinePoints, Map, Pose, Survey

APART = 0.10  # m between two points of the line beyond which it is drawn as interrupted


def line_in_world(pieces: Sequence[LinePoints], result: Map, survey: Survey, travelled: Sequence[float]) -> Floats:
    """Points of the line in world metres.

    Odometry drifts. At a stop the map says where the robot really stood, so there is a rigid motion from odometry axes
    to world axes; between two stops the points are blended from one to the other by the metres driven.

    Parameters
    ----------
    pieces : sequence of LinePoints
        As the follower published them during the first leg.
    result, survey : Map, Survey
        Poses of the stops as mapped and by odometry.
    travelled : sequence of float
        Metres driven at each stop of the first leg.

    Returns
    -------
    (N, 2) array
        In the order driven; empty if no stop of the first leg is in the map.
    """
    if not survey.stops or not pieces:
        return np.empty((0, 2))
    points, driven = np.concatenate([piece.points for piece in pieces]), np.concatenate([p.travelled for p in pieces])
    order = np.argsort(driven, kind="stable")
    points, driven = points[order], driven[order]
    leg = survey.stops[0].leg
    mapped = {stop.stop: Pose(stop.x, stop.y, stop.heading) for stop in result.stops if stop.leg == leg}
    stops = [(at, stop) for at, stop in zip(travelled, (s for s in survey.stops if s.leg == leg), strict=False)]
    known = [(at, _moved(points, stop.odometry, mapped[stop.stop])) for at, stop in stops if stop.stop in mapped]
    if not known:
        return np.empty((0, 2))
    at = np.array([where for where, _ in known])
    place = np.interp(driven, at, np.arange(len(at), dtype=np.float64))
    before = np.floor(place).astype(np.int64)
    share = (place - before)[:, None]
    every = np.stack([moved for _, moved in known])
    rows = np.arange(len(points))
    world: Floats = (1.0 - share) * every[before, rows] + share * every[np.minimum(before + 1, len(at) - 1), rows]
    return world


def runs(points: Floats) -> list[Floats]:
    """Cut (N, 2) points where they are far apart; pieces of at least two points."""
    cuts = np.flatnonzero(np.hypot(*np.diff(points, axis=0).T) > APART) + 1
    return [piece for piece in np.split(points, cuts) if len(piece) > 1]


def save_line_csv(path: Path, points: Floats) -> None:
    """Write the line as `x,y` in world metres, in the order driven, with that header line.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    rows = ["x,y", *(f"{x:.4f},{y:.4f}" for x, y in points)]
    try:
        path.write_text("\n".join(rows) + "\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _moved(points: Floats, odometry: Pose, mapped: Pose) -> Floats:
    """Points (N, 2) carried by the motion that takes a pose by odometry to the mapped one."""
    turn = mapped.heading - odometry.heading
    c, s = math.cos(turn), math.sin(turn)
    away = points - np.array([odometry.x, odometry.y])
    return np.column_stack([mapped.x + c * away[:, 0] - s * away[:, 1], mapped.y + s * away[:, 0] + c * away[:, 1]])
