"""The part of a large survey that a plan is about: the way's next metres, what shows there, and the stops around.

The joint covariance that planning conditions is dense, so a store's ten thousand labels do not fit. What a stop teaches
it teaches about labels in view, and how sure these are against the stops around does not depend on the rest: the stops
around are solved by themselves, where the whole survey's map has them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import SolverError
from ..records import Floats, KnownLabel, Map, Pose, Stop, Survey
from .problem import STOP, build_problem
from .robust import Optimum, optimise
from .ways import Way

MOST_ENTRIES = 2000  # of a dense covariance: 32 MB, which planning updates some thousand times
_AROUND = 1.5  # times the reach, within which stops belong to a place


def nearby(optimum: Optimum, result: Map, way: Way, horizon: float, reach: float) -> tuple[Optimum, Way, str | None]:
    """Cut a survey down to what can be planned at once.

    Parameters
    ----------
    optimum : Optimum
    result : Map
        What was made of it.
    way : Way
    horizon : float
        Metres ahead that are worth planning.
    reach : float
        Metres within which labels show.

    Returns
    -------
    Optimum, Way
        As given if they are small enough.
    str or None
        What was left out, in words.

    Raises
    ------
    SolverError
        If even the next few metres have too many labels.
    """
    problem = optimum.problem
    if _entries(problem.stop_count, len(problem.labels) + 2 * len(way.floor), len(problem.cameras)) <= MOST_ENTRIES:
        return optimum, way, None
    while horizon > reach:
        ahead = _ahead(optimum, way, horizon)
        survey = _part(problem.survey, result, ahead.places[:, :2], reach)
        labels = len({s.label for stop in survey.stops for s in stop.sightings}) + 2 * len(ahead.floor)
        if _entries(len(survey.stops), labels, len(problem.cameras)) <= MOST_ENTRIES:
            note = (
                f"only the next {horizon:.0f} metres are planned, from {len(survey.stops)} stops and {labels} labels "
                "around; plan again from there"
            )
            return optimise(build_problem(survey)), ahead, note
        horizon /= 1.25
    raise SolverError(
        f"survey {problem.survey.survey}: more labels show on the next {reach:.0f} m than can be planned at once; name "
        "fewer in [mission] labels"
    )


def _entries(stops: int, labels: int, cameras: int) -> int:
    return STOP * stops + 3 * labels + 10 * cameras


def _ahead(optimum: Optimum, way: Way, horizon: float) -> Way:
    """The way's part within so many metres."""
    if np.isnan(way.along).any():
        last = optimum.problem.stop_entries(optimum.state)[-1, :2]
        kept = np.hypot(*(way.places[:, :2] - last).T) <= horizon
        return replace(way, places=way.places[kept], along=way.along[kept])
    begin = way.here if way.here is not None else float(way.along.min(initial=0.0))
    kept = way.along <= begin + horizon
    spacing = float(np.median(np.hypot(*np.diff(way.floor, axis=0).T))) if len(way.floor) > 1 else 1.0
    floor = slice(int(horizon / max(spacing, 1e-3)) + 1)
    return replace(way, places=way.places[kept], along=way.along[kept], floor=way.floor[floor], sides=way.sides[floor])


def _part(survey: Survey, result: Map, places: Floats, reach: float) -> Survey:
    """The stops around some places (C, 2) with the labels that may show there; the newest stop is always one."""
    poses = {(stop.leg, stop.stop): stop for stop in result.stops}
    here = np.full((len(survey.stops), 2), np.inf)
    for k, stop in enumerate(survey.stops):
        if (stop.leg, stop.stop) in poses:
            here[k] = poses[stop.leg, stop.stop].x, poses[stop.leg, stop.stop].y
    close = _nearest(here, places) <= _AROUND * reach
    close[-1] = True
    positions = {m.label: m.position for m in result.labels if m.position is not None}
    at = np.array(list(positions.values())).reshape(-1, 3)[:, :2]
    far = {label for label, away in zip(positions, _nearest(at, places), strict=True) if away > reach}
    stops, leg = list[Stop](), 0
    for index in np.flatnonzero(close).tolist():
        stop = survey.stops[index]
        pose = poses.get((stop.leg, stop.stop), stop.odometry)
        joined = index > 0 and bool(close[index - 1]) and survey.stops[index - 1].leg == stop.leg
        leg += not joined
        stops.append(
            replace(
                stop,
                leg=leg,
                stop=len(stops) + 1,
                odometry=Pose(pose.x, pose.y, pose.heading),
                move=stop.move if joined else None,
                motions=stop.motions if joined else (),
                sightings=tuple(s for s in stop.sightings if s.label not in far),
            )
        )
    known: tuple[KnownLabel, ...] = tuple(one for one in survey.known_labels if one.label not in far)
    return replace(survey, stops=tuple(stops), known_labels=known)


def _nearest(points: Floats, places: Floats) -> Floats:
    """(N,) distances of points (N, 2) to the nearest of the places (C, 2)."""
    away = np.full(len(points), np.inf)
    for place in places:
        np.minimum(away, np.hypot(*(points - place).T), out=away)
    return away
