"""Surveys that hardly fit: which mistake of who wrote them would explain it.

With moves in feet, a camera's cable in its neighbour's socket or a rig's poses the wrong way round, some labels may
still come out, at wrong places. So where too many sightings fit no map, the survey is read as if it held one of the
usual mistakes; where that fits far better, the mistake is named and nothing is placed on the survey as it stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..errors import InputError
from ..geometry.transforms import invert_rigid, transform_matrix, transform_record
from ..records import Floats, Move, Sighting, Survey
from .problem import CAMERA, ODOMETRY, Problem, build_problem, stops_per_label
from .robust import Optimum, optimise

FITS = 0.5  # share of the survey's sightings below which its calibration or its units are doubted
FITS_NOT = 0.45  # and below which nothing is placed
_UNSURE = 0.8  # share below which the units of moves are doubted: a third of wrong sightings is possible, but rare
_LEAST_LIGHTS = 20  # to say so
_CLEARLY_BETTER = 0.25  # of that share, to blame two cameras or anything else
_RATHER_BETTER = 0.15  # to blame moves, if then nearly all fit
_NEARLY_ALL = 0.9
_MOST_TO_TRY = 5000  # sightings
_FACTORS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 0.3048: "feet", 1e3: "kilometres"}
_POWERS = (0.1, 10.0, 100.0)
_SUNKEN_M = 0.05  # below the floor, that slopes and steps explain
_MANY_SUNKEN, _SUNKEN_SHARE = 3, 0.15  # labels, and of all labels, from which heights are doubted
_STRAINED = 4.0  # standard deviations, of one value; of a root mean square over a rig half of it


@dataclass(frozen=True, slots=True)
class Misfit:
    """Why a survey hardly fits, in words; `refused`: nothing is placed, because it is not as it should be read."""

    share: float
    text: str | None
    refused: bool


def misfit(asked: Problem, optimum: Optimum) -> Misfit:
    """Judge how much of a survey its optimum explains, and look for the mistake if that is little."""
    share = explained_share(optimum)
    little = f"only {100 * share:.0f} % of the sightings fit any map, so few labels are placed"
    if share < _UNSURE and len(asked.sightings) <= _MOST_TO_TRY:
        best, said = _best_reading(asked.survey, share, everything=share < FITS, scales=asked.frame == "first stop")
        if best > share + _CLEARLY_BETTER or (best > share + _RATHER_BETTER and best > _NEARLY_ALL):
            text = f"{little}; with {said} {100 * best:.0f} % do: check {_where(said)}"
            return Misfit(share, text, "exchanged" not in said)
    labels = optimum.adjustment.labels
    heights = zip(optimum.state.points[labels, 2].tolist(), optimum.covariance.points[:, 2, 2].tolist(), strict=True)
    sunken = sum(is_below_floor(z, variance) for z, variance in heights)
    if sunken >= max(_MANY_SUNKEN, _SUNKEN_SHARE * len(labels)):
        text = f"{sunken} of {len(labels)} labels come out below the floor, so the heights of all are doubtful"
        return Misfit(share, f"{text}: check that v counts downward, and the cameras' heights and tilts", True)
    if share >= FITS:
        return Misfit(share, None, False)
    what = "the rig (which camera is which, metres, radians), the labels' ids and the moves' units"
    return Misfit(share, f"{little}; check {what}", False)


def _best_reading(survey: Survey, share: float, everything: bool, scales: bool) -> tuple[float, str]:
    """The mistake without which most sightings fit, more than `share`, and what share that is."""
    best, said = share, ""
    for hypothesis, other in _mistakes(survey, everything, scales):
        try:
            found = explained_share(optimise(build_problem(other)))
        except InputError:  # read like that it would be impossible
            continue
        if found > best:
            best, said = found, hypothesis
    return best, said


def is_below_floor(z: float, variance: float) -> bool:
    """Whether a label's height and its variance put it clearly below the floor."""
    return z < -_SUNKEN_M - 3.0 * math.sqrt(variance)


def strained(optimum: Optimum) -> list[str]:
    """Sentences on priors that the optimum had to leave far behind."""
    problem, frame = optimum.problem, optimum.state.frame
    sigma, found = problem.prior_sigma, []
    names = ("scale", "turns", "drift")
    for name, value, one in zip(names, frame[-ODOMETRY:], sigma[-ODOMETRY:], strict=True):
        if one > 0.0 and abs(value) > _STRAINED * one:
            found.append(
                f"odometry's {name} came out {value:+.3g}, {abs(value) / one:.0f} times its prior; calibrate odometry, "
                "and check the moves' units"
            )
    for number, camera in enumerate(problem.cameras):
        first = problem.roof_entry - CAMERA * (len(problem.cameras) - number)
        prior, entries = sigma[first : first + CAMERA], frame[first : first + CAMERA]
        free = prior > 0.0
        size = float(np.sqrt(np.mean((entries[free] / prior[free]) ** 2))) if free.any() else 0.0
        if size > 0.5 * _STRAINED:
            found.append(
                f"camera {camera.name} came out {size:.1f} times as far from its calibration as its priors allow; "
                "calibrate the rig"
            )
    return found


def explained_share(optimum: Optimum) -> float:
    """Share of the lights that the map explains, among those of labels that two stops or more saw.

    Of rival sightings one is right; what lies in glass or floor is explained too. Too few sightings say nothing.
    """
    problem, s = optimum.problem, optimum.problem.sightings
    seen = stops_per_label(s.label, s.stop, len(problem.labels))[s.label] >= 2
    lights = np.bincount(s.rival[seen]) > 0
    if np.count_nonzero(lights) < _LEAST_LIGHTS:
        return 1.0
    fits = np.bincount(s.rival[seen & (optimum.inlier | optimum.reflected)], minlength=len(lights)) > 0
    return float(np.count_nonzero(fits) / np.count_nonzero(lights))


def _where(said: str) -> str:
    if "exchanged" in said:
        return "rig.cameras and the robot's cables"
    return "the moves" if "moves" in said else "the rig and the cameras' pictures"


def _mistakes(survey: Survey, everything: bool, scales: bool) -> Iterator[tuple[str, Survey]]:
    """The survey without one of the usual mistakes, and what to call it."""
    if scales:
        for factor, unit in _FACTORS.items():
            yield f"the moves read as {unit}", _with_moves(survey, factor, factor, 1.0)
        for factor in _POWERS:
            yield f"the moves times {factor:g}", _with_moves(survey, factor, factor, 1.0)
    if not everything:
        return
    yield "turns of the moves read as degrees", _with_moves(survey, 1.0, 1.0, math.pi / 180.0)
    yield "turns of the moves counted clockwise", _with_moves(survey, 1.0, 1.0, -1.0)
    yield "y of the moves to the right", _with_moves(survey, 1.0, -1.0, 1.0)
    yield "y of the moves to the right and turns clockwise", _with_moves(survey, 1.0, -1.0, -1.0)
    for pair in combinations([camera.name for camera in survey.rig.cameras], 2):
        renamed = {pair[0]: pair[1], pair[1]: pair[0]}
        cameras = tuple(replace(c, name=renamed.get(c.name, c.name)) for c in survey.rig.cameras)
        yield f"cameras {pair[0]} and {pair[1]} exchanged", replace(survey, rig=replace(survey.rig, cameras=cameras))
    turned = tuple(
        replace(c, T_robot_camera=transform_record(invert_rigid(transform_matrix(c.T_robot_camera))))
        for c in survey.rig.cameras
    )
    yield "the cameras' poses inverted (camera from robot)", replace(survey, rig=replace(survey.rig, cameras=turned))
    sizes = {c.name: c.size for c in survey.rig.cameras}
    yield "pictures mirrored", _with_pixels(survey, lambda s: (sizes[s.camera][0] - 1.0 - s.u, s.v))
    for factor in (0.5, 2.0):
        zoomed = tuple(
            replace(c, matrix=(c.matrix[0] * factor, c.matrix[1] * factor, c.matrix[2] * factor, c.matrix[3] * factor))
            for c in survey.rig.cameras
        )
        yield f"the lenses' matrices times {factor:g}", replace(survey, rig=replace(survey.rig, cameras=zoomed))


def _with_moves(survey: Survey, x: float, y: float, turn: float) -> Survey:
    scale: Floats = np.diag([x, y, turn])

    def changed(move: Move | None) -> Move | None:
        if move is None:
            return None
        (a, b, c), (d, e, f), (g, h, i) = (scale @ np.array(move.covariance) @ scale).tolist()
        return Move(
            move.dx * x, move.dy * y, move.dheading * turn, ((a, b, c), (d, e, f), (g, h, i))
        )  # an arc's errors

    return replace(survey, stops=tuple(replace(stop, move=changed(stop.move)) for stop in survey.stops))


def _with_pixels(survey: Survey, place: Callable[[Sighting], tuple[float, float]]) -> Survey:
    def changed(sighting: Sighting) -> Sighting:
        u, v = place(sighting)
        return replace(sighting, u=u, v=v)

    return replace(survey, stops=tuple(replace(s, sightings=tuple(map(changed, s.sightings))) for s in survey.stops))
