"""A survey in, a map out: positions with covariance, and for every label without one the reason in words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..geometry.transforms import pose_array, wrap_angle
from ..records import (
    Candidate,
    Floats,
    Map,
    MappedLabel,
    MappedSighting,
    MappedStop,
    Matrix3,
    Pose,
    SolverRun,
    Survey,
    Vector3,
)
from ..sighting_columns import made
from ..typed_json import many_records
from .bundle import SQUARE, Adjustment
from .hypotheses import at_camera_height, exchanged
from .initial import world_rays
from .known_labels import on_a_line
from .linear import solve_linear
from .misfit import FITS, FITS_NOT, Misfit, is_below_floor, misfit, strained
from .panes import apart, images, outside
from .problem import Bools, Problem, Sightings, State, build_problem, stops_per_label
from .robust import Optimum, optimise
from .ties import Rival, side_of
from .weights import OUTLIER

WIDEST_SIGMA_M = 0.25  # a label less certain than this would be written to the wrong shelf
_TRUSTED_STOPS = 4  # agreement from as many is no chance, however many other sightings disagree
_OUTSIDE_M = 0.5  # a position so far outside all others may be an image in a shop window or a glossy shelf
_ALL_BUT_ALL = 0.9  # share of the survey's sightings that fit, below which two are not believed that nothing checks
_SAME_PLACE_M = 0.05
_SURPRISE = 21.1  # chi square of 3 degrees of freedom that chance exceeds once in 10 000
_CLEARLY_NEARER_M = 0.2
_UNKNOWN = np.diag([1e6, 1e6, np.pi**2])  # covariance of a stop that nothing ties to the world


def solve(
    survey: Survey,
    method: Literal["bundle", "linear"] = "bundle",
    start: Mapping[tuple[int, int], Pose] | None = None,
) -> Map:
    """Make the map of a survey.

    Parameters
    ----------
    survey : Survey
    method : {"bundle", "linear"}
        Robust bundle adjustment of everything, or the thesis's linear triangulation from odometry as a baseline.
    start : mapping of (leg, stop) to Pose, optional
        Where the bundle adjustment begins, instead of odometry; for all stops, in any world axes.

    Returns
    -------
    Map
        Every label of the survey is in it, with a position or with the reason why it has none.

    Raises
    ------
    InputError
        If the survey contradicts itself; lists every mistake.
    SolverError
        If there is nothing to solve.
    """
    if method not in ("bundle", "linear"):
        raise ValueError(f"method must be bundle or linear, got {method!r}")
    with many_records():
        problem = build_problem(survey)
        if method == "linear":
            return solve_linear(problem)
        poses = None
        if start is not None:
            poses = np.array([pose_array(start[stop.leg, stop.stop]) for stop in problem.survey.stops])
        return to_map(problem, optimise(problem, poses))


def to_map(asked: Problem, optimum: Optimum) -> Map:
    """The map that an optimum of a problem is."""
    problem, state = optimum.problem, optimum.state
    everything = Adjustment(problem, problem.sightings)
    linear = everything.residuals(state, SQUARE)
    counts = Counter(problem.columns.names)
    tally = _tally(asked, optimum)
    doubt = misfit(asked, optimum)
    labels = tuple(_label(asked, optimum, tally, i, counts[label], doubt) for i, label in enumerate(problem.labels))
    located = np.array([m.status in ("placed", "known") for m in labels], dtype=np.bool_)
    residual_px = linear.residual * problem.sightings.sigma[:, None]
    inlier = optimum.inlier
    used = residual_px[inlier]
    notes = [*((doubt.text,) if doubt.text is not None else ()), *problem.notes]
    lost = [f"{s.leg}/{s.stop}" for s, ok in zip(problem.survey.stops, optimum.placed, strict=True) if not ok]
    if lost:
        why = "share too few labels with the rest to be joined to it"
        mend = "map some of the same labels from both"
        if len(asked.moves.before) == 0:
            why, mend = (
                "cannot be joined, because no leg has two stops, so that no label has a place",
                "make longer legs",
            )
        notes.append(f"leg/stop {', '.join(lost)} {why}; their poses are in their own odometry frame; {mend}")
    if (caution := on_a_line(problem)) is not None:
        notes.append(caution)
    notes += strained(optimum)
    if optimum.rival is not None and tally.elsewhere.any():
        notes.append(_two_ways(problem, optimum.rival, tally.elsewhere, state))
    if len(problem.sightings) == 0:
        notes.append("the survey has no usable sightings, so no label has a position")
    fit = optimum.adjustment.residuals(state, SQUARE)
    cost = 0.5 * ((fit.residual**2).sum() + (fit.move**2).sum() + (fit.roof**2).sum())
    return Map(
        survey=problem.survey.survey,
        frame=problem.frame,
        labels=labels,
        stops=_stops(optimum),
        sightings=_sightings(problem, residual_px, linear.valid, inlier.astype(np.float64), located),
        cost=float(cost),
        rms_px=float(np.sqrt(np.mean(used**2))) if len(used) else 0.0,
        solver=SolverRun(optimum.iterations, optimum.converged, "bundle"),
        notes=tuple(notes),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Tally:
    """Of every label: how many stops saw it, saw it from where the map reaches, and agree; and what speaks for it.

    `row` is its place in the adjustment or -1, `known` in the problem's known labels or -1, `sigma` its largest
    standard deviation, `position` and `covariance` as in the map, the latter by row, `agreeing` and `doubting` sums of
    its sightings' probabilities, `in_front` (L, 3) see _in_front, `elsewhere` (L,) see _elsewhere, `exchanged` (L,)
    those whose names were perhaps exchanged, `in_glass` see _in_glass; `unchecked` (L,) are those whose two sightings
    meet wherever these point, because they are level.
    """

    asked_stops: list[int]
    joined_stops: list[int]
    stops: list[int]
    inliers: list[int]
    agreeing_stops: list[int]
    agreeing: list[float]
    doubting: list[float]
    row: list[int]
    known: list[int]
    sigma: list[float]
    position: list[Vector3]
    covariance: list[Matrix3]
    in_front: Floats
    image: list[bool]
    elsewhere: Bools
    exchanged: Bools
    unchecked: Bools
    in_glass: dict[int, tuple[str, Floats | None]]


def _tally(asked: Problem, optimum: Optimum) -> _Tally:
    problem, s, inlier = optimum.problem, optimum.problem.sightings, optimum.inlier
    count, odd = len(problem.labels), ~optimum.inlier & ~optimum.reflected
    row, known = np.full(count, -1), np.full(count, -1)
    row[optimum.adjustment.labels] = np.arange(len(optimum.adjustment.labels))
    known[problem.known.label[::-1]] = np.arange(len(problem.known.label))[::-1]
    sigma = np.full(count, np.inf)
    if len(points := optimum.covariance.points):
        sigma[optimum.adjustment.labels] = np.sqrt(np.linalg.eigvalsh(points)[:, -1])
    inliers = np.bincount(s.label[inlier], minlength=count)
    in_front = _in_front(optimum)
    image: list[bool] = np.isfinite(in_front[:, 0]).tolist()

    def stops(sightings: Sightings) -> list[int]:
        counts: list[int] = stops_per_label(sightings.label, sightings.stop, count).tolist()
        return counts

    return _Tally(
        asked_stops=stops(asked.sightings),
        joined_stops=stops(asked.sightings.select(optimum.placed[asked.sightings.stop])),
        stops=stops(s),
        inliers=inliers.tolist(),
        agreeing_stops=stops(s.select(inlier)),
        agreeing=np.bincount(s.label[inlier], s.probability[inlier], count).tolist(),
        doubting=np.bincount(s.label[odd], s.probability[odd], count).tolist(),
        row=row.tolist(),
        known=known.tolist(),
        sigma=sigma.tolist(),
        position=[(x, y, z) for x, y, z in optimum.state.points.tolist()],
        covariance=[
            ((a, b, c), (d, e, f), (g, h, i)) for (a, b, c), (d, e, f), (g, h, i) in optimum.covariance.points.tolist()
        ],
        in_front=in_front,
        image=image,
        elsewhere=_elsewhere(optimum),
        exchanged=exchanged(Adjustment(problem, s), optimum.state, optimum.hypotheses, row >= 0),
        unchecked=at_camera_height(problem, optimum.state.points)
        & (np.bincount(s.label[inlier], minlength=count) == 2),
        in_glass=_in_glass(optimum),
    )


def _label(asked: Problem, optimum: Optimum, tally: _Tally, i: int, count: int, doubt: Misfit) -> MappedLabel:
    problem, label = optimum.problem, asked.labels[i]
    inliers = tally.inliers[i]
    position, covariance = tally.position[i], tally.covariance[row] if (row := tally.row[i]) >= 0 else None

    def unplaced(reason: str) -> MappedLabel:
        return MappedLabel(label, "unplaced", None, None, count, inliers, reason)

    if (k := tally.known[i]) >= 0:
        if covariance is None:
            position, covariance = _vector(problem.known.position[k]), _matrix(problem.known.sigma[k] ** 2 * np.eye(3))
        return MappedLabel(label, "known", position, covariance, count, inliers)
    if count == 0:
        return unplaced("its measured position was rejected and no camera saw it; measure it again")
    if tally.asked_stops[i] == 0:
        return unplaced("every sighting lies beyond the lens model's valid radius; map it from another stop")
    if tally.asked_stops[i] == 1:
        return unplaced("seen from one stop only; map it from a second stop")
    if tally.stops[i] < 2 and tally.asked_stops[i] > tally.joined_stops[i]:
        return unplaced("seen only from stops that could not be joined to the map; map it together with mapped labels")
    if tally.stops[i] < 2:
        return unplaced("most of its sightings are of a camera or stop that fits nothing else; see the map's notes")
    if tied := optimum.hypotheses.tied(i):
        return _ambiguous(optimum, i, label, count, inliers, tied)
    if covariance is None:
        return unplaced(
            f"its {count} sightings do not meet in one point (reflections or wrong identities); flash it again, alone"
        )
    if tally.agreeing_stops[i] < _TRUSTED_STOPS and tally.doubting[i] >= tally.agreeing[i]:
        return unplaced(f"only {inliers} of its {count} sightings agree, which may be chance; flash it again, alone")
    if tally.unchecked[i] and doubt.share < _ALL_BUT_ALL:
        return unplaced(
            f"two sightings meet at the cameras' height, whatever they are of, and only {100 * doubt.share:.0f} % of "
            "the survey's sightings fit; map it from a third stop"
        )
    if doubt.refused or (doubt.share < FITS and (doubt.share < FITS_NOT or tally.agreeing_stops[i] < _TRUSTED_STOPS)):
        return unplaced(
            "the survey as a whole is doubtful; see the map's notes"
            if doubt.share >= FITS
            else f"only {100 * doubt.share:.0f} % of the survey's sightings fit together; see the map's notes"
        )
    if is_below_floor(position[2], covariance[2][2]):
        return unplaced(
            f"its sightings meet below the floor ({position[2]:.2f} m), where no label hangs; was it seen in a mirror?"
        )
    sigma = tally.sigma[i]
    if not sigma <= WIDEST_SIGMA_M:
        return unplaced(f"views nearly parallel (standard deviation {sigma:.2g} m); map it from a stop further aside")
    if tally.elsewhere[i]:
        assert optimum.rival is not None
        reason = "the stops that saw it are tied to the others in two ways that fit equally well; see the map's notes"
        ways = ((optimum.state, optimum.rival.chosen_cost), (optimum.rival.state, optimum.rival.cost))
        candidates = tuple(Candidate(_vector(way.points[i]), cost) for way, cost in ways)
        return MappedLabel(label, "ambiguous", None, None, count, inliers, reason, candidates)
    if tally.exchanged[i]:
        rival = optimum.hypotheses.rivals[i]
        reason = (
            "conflicting identities: its name and another label's were exchanged on the way; flash both again, alone"
        )
        return _ambiguous(optimum, i, label, count, inliers, [rival] if np.isfinite(rival[0]) else [], reason)
    if tally.image[i]:
        reason = "perhaps an image in glass: one sighting puts the label nearer; map it from another stop"
        return _ambiguous(optimum, i, label, count, inliers, [tally.in_front[i]], reason)
    if i in tally.in_glass:
        reason, other = tally.in_glass[i]
        return _ambiguous(optimum, i, label, count, inliers, [] if other is None else [other], reason)
    return MappedLabel(label, "placed", position, covariance, count, inliers)


def _elsewhere(optimum: Optimum) -> Bools:
    """(L,) labels that a rival optimum of the whole survey has clearly elsewhere."""
    result = np.zeros(len(optimum.problem.labels), dtype=np.bool_)
    if optimum.rival is None:
        return result
    labels = optimum.adjustment.labels
    apart = optimum.rival.state.points[labels] - optimum.state.points[labels]
    surprise = (apart * np.linalg.solve(optimum.covariance.points, apart[:, :, None])[:, :, 0]).sum(axis=1)
    result[labels] = (surprise > _SURPRISE) & (np.linalg.norm(apart, axis=1) > _SAME_PLACE_M)
    return result


def _two_ways(problem: Problem, rival: Rival, elsewhere: Bools, state: State) -> str:
    apart = float(np.linalg.norm(rival.state.points - state.points, axis=1)[elsewhere].max())
    labels = ", ".join(problem.labels[i] for i in rival.tie.labels)
    return (
        f"leg/stop {side_of(problem, rival.tie)} and the rest share only {labels}, and fit together in two ways, up to "
        f"{apart:.2f} m apart, equally well; map more of the same labels from both"
    )


def _in_front(optimum: Optimum) -> Floats:
    """(L, 3) where a label may be whose position is perhaps only its image in upright glass; NaN for all others.

    An image lies behind the pane, mostly outside everything else that was mapped. If then a sighting that does not fit
    meets the image's height nearer, and from every stop so, it may be the label itself, seen only once.
    """
    problem, state = optimum.problem, optimum.state
    result = np.full((len(problem.labels), 3), np.nan)
    odd = np.flatnonzero(~optimum.inlier & ~optimum.reflected)
    sightings = problem.sightings.select(odd)
    if len(odd) == 0:
        return result
    origin, direction = world_rays(problem, sightings, state)
    points = state.points[sightings.label]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (points[:, 2] - origin[:, 2]) / direction[:, 2]
        there = origin + reach[:, None] * direction
    gap = np.linalg.norm(points - origin, axis=1) - np.linalg.norm(there - origin, axis=1)
    for k in np.flatnonzero((reach > _CLEARLY_NEARER_M) & (gap > _CLEARLY_NEARER_M)):
        mine = problem.sightings.stop[problem.sightings.label == sightings.label[k]]
        at = problem.stop_entries(state)[mine, :2]
        nearer = np.linalg.norm(there[k, :2] - at, axis=1) < np.linalg.norm(points[k, :2] - at, axis=1)
        if nearer.all():
            result[sightings.label[k]] = there[k]
    trusted = optimum.adjustment.labels[~np.isfinite(result[optimum.adjustment.labels, 0])]
    around = np.vstack([state.points[trusted, :2], problem.stop_entries(state)[optimum.placed, :2]])
    for i in np.flatnonzero(np.isfinite(result[:, 0])):
        if outside(around, state.points[i, :2]) < _OUTSIDE_M:
            result[i] = np.nan
    return result


def _in_glass(optimum: Optimum) -> dict[int, tuple[str, Floats | None]]:
    """Labels that were perhaps seen in glass only, why, and the position (3,) that would show there."""
    problem, state = optimum.problem, optimum.state
    labels = optimum.adjustment.labels
    located = np.zeros(len(problem.labels), np.bool_)
    located[labels] = True
    result: dict[int, tuple[str, Floats | None]] = {}
    for i, (position, pane) in images(problem, state, optimum.inlier, located).items():
        shown = ", ".join(problem.labels[k] for k in pane.labels[:3])
        result[i] = (
            f"perhaps an image in glass: behind it, and {shown} are mirrored there; map it from elsewhere",
            position,
        )
    seen = stops_per_label(
        problem.sightings.label[optimum.inlier], problem.sightings.stop[optimum.inlier], len(problem.labels)
    )
    few = seen[labels] < _TRUSTED_STOPS
    stops = problem.stop_entries(state)[optimum.placed, :2]
    for row, far in apart(state.points[labels, :2], few, stops).items():
        reason = f"perhaps an image in glass: few stops saw it, {far:.1f} m outside all else; map it from another stop"
        result.setdefault(int(labels[row]), (reason, None))
    return result


def _ambiguous(
    optimum: Optimum, i: int, label: str, count: int, inliers: int, others: list[Floats], reason: str | None = None
) -> MappedLabel:
    problem, state = optimum.problem, optimum.state
    mine = Adjustment(problem, problem.sightings.select(problem.sightings.label == i))
    candidates = []
    for point in (state.points[i], *others):
        points = state.points.copy()
        points[i] = point
        linear = mine.residuals(replace(state, points=points), SQUARE)
        # a sighting of the other candidate counts as an outlier, so that the costs can be compared
        cost = 0.5 * np.minimum((linear.residual**2).sum(axis=1), OUTLIER).sum()
        candidates.append(Candidate(_vector(point), float(cost)))
    candidates.sort(key=lambda c: c.cost)
    distance = max(math.dist(a.position, b.position) for a in candidates for b in candidates)
    theirs = [name for name in (_label_at(optimum, i, c.position) for c in candidates) if name is not None]
    if theirs and reason is None:
        reason = f"conflicting identities: some of its sightings are those of {theirs[0]}; flash both again, alone"
    several = "two" if len(candidates) == 2 else str(len(candidates))
    reason = reason or (
        f"{several} positions {distance:.1f} m apart explain its sightings equally well (mirror solutions tied); "
        "map it from another stop"
    )
    return MappedLabel(label, "ambiguous", None, None, count, inliers, reason, tuple(candidates))


def _label_at(optimum: Optimum, i: int, position: Vector3) -> str | None:
    """Another label that hangs where this one's sightings point at."""
    near = np.linalg.norm(optimum.state.points - position, axis=1) < _SAME_PLACE_M
    near[i] = False
    near &= np.isin(np.arange(len(near)), optimum.adjustment.labels)
    return optimum.problem.labels[int(np.argmax(near))] if near.any() else None


def _stops(optimum: Optimum) -> tuple[MappedStop, ...]:
    poses = optimum.problem.stop_entries(optimum.state)
    covariances = np.where(optimum.placed[:, None, None], optimum.covariance.stops, _UNKNOWN)
    return tuple(
        MappedStop(stop.leg, stop.stop, float(x), float(y), wrap_angle(float(heading)), _matrix(covariance))
        for stop, (x, y, heading), covariance in zip(
            optimum.problem.survey.stops, poses[:, :3], covariances, strict=True
        )
    )


def _sightings(
    problem: Problem, residual_px: Floats, valid: Bools, weight: Floats, located: Bools
) -> tuple[MappedSighting, ...]:
    """What became of every sighting of the survey, in its order."""
    s, columns, stops = problem.sightings, problem.columns, problem.survey.stops
    residuals: list[tuple[float, float] | None] = [None] * len(columns.stop)
    shown = valid & located[s.label]
    for number, u, v in zip(s.source[shown].tolist(), *residual_px[shown].T.tolist(), strict=True):
        residuals[number] = (u, v)
    weights = np.zeros(len(columns.stop))
    weights[s.source] = weight
    cameras = [camera.name for camera in problem.cameras]
    return made(
        MappedSighting,
        [
            np.array([stop.leg for stop in stops])[columns.stop].tolist(),
            np.array([stop.stop for stop in stops])[columns.stop].tolist(),
            [cameras[camera] for camera in columns.camera.tolist()],
            columns.names,
            residuals,
            weights.tolist(),
        ],
    )


def _vector(values: Floats) -> Vector3:
    x, y, z = values.tolist()
    return (x, y, z)


def _matrix(values: Floats) -> Matrix3:
    (a, b, c), (d, e, f), (g, h, i) = values.tolist()
    return ((a, b, c), (d, e, f), (g, h, i))
