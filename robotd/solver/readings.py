"""A survey as it would be without one of the mistakes that are usually made in writing one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ..geometry.transforms import (
    heading_matrix,
    invert_rigid,
    rotation_matrix,
    se2_inverse,
    se2_relative,
    transform_matrix,
    transform_record,
    wrap_angle,
)
from ..path_error import as_matrix3
from ..records import Floats, Move, Sighting, Survey
from .robust import Optimum

_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches", 0.3048: "feet", 1e3: "kilometres"}
_POWERS = (0.1, 10.0, 100.0, 1.0 / 0.3048)
_NEARLY = (0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.25)  # wheels of another size, or gears
_ZOOMS = (1.0, 0.9, 1.1, 0.8, 1.25, 0.75, 1.33, 0.67, 1.5, 0.5, 2.0)  # pictures of another size than the lens was for
_FREE_FOCAL, _FREE_CENTRE_PX = 0.04, 40.0  # by which lenses may differ then


@dataclass(frozen=True, slots=True)
class Reading:
    """A survey without one mistake: `said` names it, `kind` is what it concerns."""

    kind: str
    said: str
    survey: Survey

    def described(self, optimum: Optimum) -> str:
        """`said`, with what the optimum of this reading found."""
        if self.kind != "lenses":
            return self.said
        cameras = optimum.problem.camera_entries(optimum.state)
        before = np.array([camera.matrix[0] for camera in self.survey.rig.cameras])
        ratio = float(np.median((before + cameras[:, 6]) / before)) * float(self.said)
        aside = float(np.median(np.hypot(cameras[:, 8], cameras[:, 9])))
        return f"focal lengths {ratio:.3g} times as long and the images' centres {aside:.0f} px aside"


MOVES, NEARLY, WAYS, CAMERAS, RIG, PICTURES, LENSES = "moves", "nearly", "ways", "cameras", "rig", "pictures", "lenses"


def lengths(survey: Survey) -> Iterator[Reading]:
    """Other units of the moves."""
    for factor, unit in _UNITS.items():
        yield Reading(MOVES, f"the moves read as {unit}", with_moves(survey, factor, factor, 1.0))
    for factor in _POWERS:
        yield Reading(MOVES, f"the moves times {factor:.3g}", with_moves(survey, factor, factor, 1.0))


def nearly(survey: Survey) -> Iterator[Reading]:
    """Moves a little longer or shorter."""
    for factor in _NEARLY:
        yield Reading(NEARLY, f"the moves times {factor:g}", with_moves(survey, factor, factor, 1.0))


def signs(survey: Survey) -> Iterator[Reading]:
    """Moves in other axes."""
    yield Reading(WAYS, "turns of the moves read as degrees", with_moves(survey, 1.0, 1.0, math.pi / 180.0))
    yield Reading(WAYS, "turns of the moves counted clockwise", with_moves(survey, 1.0, 1.0, -1.0))
    yield Reading(WAYS, "y of the moves to the right", with_moves(survey, 1.0, -1.0, 1.0))
    yield Reading(WAYS, "y of the moves to the right and turns clockwise", with_moves(survey, 1.0, -1.0, -1.0))


def orders(survey: Survey) -> Iterator[Reading]:
    """Moves of other stops, or in other axes than those of the robot before."""
    yield Reading(WAYS, "the moves one stop later", _shifted(survey, 1))
    yield Reading(WAYS, "the moves one stop earlier", _shifted(survey, -1))
    yield Reading(WAYS, "the moves read as in the axes of each leg's first stop", _with_ways(survey, _from_first))
    yield Reading(WAYS, "the moves read as in the axes of the robot after them", _with_ways(survey, _from_after))
    yield Reading(WAYS, "the moves read as back to the stop before", _with_ways(survey, _from_inverse))
    yield Reading(WAYS, "the moves read as since each leg's first stop", _with_ways(survey, _from_sums))


def _from_first(ways: Floats) -> Floats:
    heading = np.concatenate([[0.0], np.cumsum(ways[:-1, 2])])
    along = heading_matrix(heading).transpose(0, 2, 1) @ ways[:, :2, None]
    return np.column_stack([along[:, :, 0], ways[:, 2]])


def _from_after(ways: Floats) -> Floats:
    return np.column_stack([(heading_matrix(ways[:, 2]) @ ways[:, :2, None])[:, :, 0], ways[:, 2]])


def _from_inverse(ways: Floats) -> Floats:
    return se2_inverse(ways)


def _from_sums(ways: Floats) -> Floats:
    return se2_relative(np.vstack([np.zeros(3), ways[:-1]]), ways)


def _with_ways(survey: Survey, change: Callable[[Floats], Floats]) -> Survey:
    """The survey with the moves of each leg changed as (M, 3) arrays."""
    stops = list(survey.stops)
    for leg in sorted({stop.leg for stop in stops}):
        mine = [k for k, stop in enumerate(stops) if stop.leg == leg and stop.move is not None]
        moves = [move for k in mine if (move := stops[k].move) is not None]
        if not moves:
            continue
        for k, move, (x, y, turn) in zip(
            mine, moves, change(np.array([[m.dx, m.dy, m.dheading] for m in moves])).tolist(), strict=True
        ):
            stops[k] = replace(stops[k], move=Move(x, y, float(wrap_angle(turn)), move.covariance))
    return replace(survey, stops=tuple(stops))


def _shifted(survey: Survey, by: int) -> Survey:
    """The survey with each leg's moves at later or earlier stops; the one that is missing then says nothing."""
    stops = list(survey.stops)
    nothing = Move(0.0, 0.0, 0.0, ((1e4, 0.0, 0.0), (0.0, 1e4, 0.0), (0.0, 0.0, 1e4)))
    for leg in sorted({stop.leg for stop in stops}):
        mine = [k for k, stop in enumerate(stops) if stop.leg == leg and stop.move is not None]
        moves = [stops[k].move for k in mine]
        moved = [nothing, *moves[:-1]] if by > 0 else [*moves[1:], nothing]
        for k, move in zip(mine, moved, strict=True):
            stops[k] = replace(stops[k], move=move)
    return replace(survey, stops=tuple(stops))


def rigs(survey: Survey) -> Iterator[Reading]:
    """Another camera behind each name, and poses the other way round."""
    for pair in combinations([camera.name for camera in survey.rig.cameras], 2):
        renamed = {pair[0]: pair[1], pair[1]: pair[0]}
        cameras = tuple(replace(c, name=renamed.get(c.name, c.name)) for c in survey.rig.cameras)
        rig = replace(survey.rig, cameras=cameras)
        yield Reading(CAMERAS, f"cameras {pair[0]} and {pair[1]} exchanged", replace(survey, rig=rig))
    turned = tuple(
        replace(c, T_robot_camera=transform_record(invert_rigid(transform_matrix(c.T_robot_camera))))
        for c in survey.rig.cameras
    )
    rig = replace(survey.rig, cameras=turned)
    yield Reading(RIG, "the cameras' poses inverted (camera from robot)", replace(survey, rig=rig))
    for quarters in (1, 2, 3):
        T = np.eye(4)
        T[:3, :3] = rotation_matrix(np.array([0.0, 0.0, 0.5 * math.pi * quarters]))
        turned = tuple(
            replace(c, T_robot_camera=transform_record(T @ transform_matrix(c.T_robot_camera)))
            for c in survey.rig.cameras
        )
        rig = replace(survey.rig, cameras=turned)
        yield Reading(RIG, f"the whole rig turned by {90 * quarters} degrees", replace(survey, rig=rig))
    sizes = {c.name: c.size for c in survey.rig.cameras}
    mirrored = with_pixels(survey, lambda s: (sizes[s.camera][0] - 1.0 - s.u, s.v))
    yield Reading(PICTURES, "pictures mirrored", mirrored)


def lenses(survey: Survey) -> Iterator[Reading]:
    """Pictures of another size than the lenses were calibrated for, or shifted, as a crop is.

    Focal lengths and centres are free around each size that is tried.
    """
    if not survey.rig.cameras:
        return
    focal = float(np.mean([camera.matrix[0] for camera in survey.rig.cameras]))
    for factor in _ZOOMS:
        zoomed = tuple(replace(c, matrix=_times(c.matrix, factor)) for c in survey.rig.cameras)
        priors = replace(survey.priors, focal_px=_FREE_FOCAL * focal * factor, centre_px=_FREE_CENTRE_PX * factor)
        rig = replace(survey.rig, cameras=zoomed)
        yield Reading(LENSES, f"{factor:g}", replace(survey, rig=rig, priors=priors))


def _times(matrix: tuple[float, float, float, float], factor: float) -> tuple[float, float, float, float]:
    fx, fy, cx, cy = matrix
    return factor * fx, factor * fy, factor * cx, factor * cy


def with_moves(survey: Survey, x: float, y: float, turn: float) -> Survey:
    """The survey with other moves: x, y and turn times these."""
    scale: Floats = np.diag([x, y, turn])

    def changed(move: Move | None) -> Move | None:
        if move is None:
            return None
        covariance = as_matrix3(scale @ np.array(move.covariance) @ scale)
        return Move(move.dx * x, move.dy * y, move.dheading * turn, covariance)

    return replace(survey, stops=tuple(replace(stop, move=changed(stop.move)) for stop in survey.stops))


def with_pixels(survey: Survey, place: Callable[[Sighting], tuple[float, float]]) -> Survey:
    """The survey with sightings at other pixels."""

    def changed(sighting: Sighting) -> Sighting:
        u, v = place(sighting)
        return replace(sighting, u=u, v=v)

    return replace(survey, stops=tuple(replace(s, sightings=tuple(map(changed, s.sightings))) for s in survey.stops))
