"""Where the cameras of a rig are, from ordinary stops, though no two cameras see the same thing at the same time.

Rig, labels, poses, odometry factors and beacons are adjusted together (thesis section 2.3, equations 15-17 and 43):
what one camera saw from one stop another sees from the next, so that labels, known or not, tie the cameras to each
other, and the moves and the floor tie them to the robot. The start is the nominal rig, which may be off by ten degrees,
or the thesis's sphere of cameras (equation 18) where there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import SolverError
from ..geometry.transforms import rotation_matrix, rotation_vector, transform_record
from ..records import CameraModel, Floats, Matrix3, Priors, Survey, Vector3
from ..typed_json import many_records
from .bundle import SQUARE
from .problem import ODOMETRY, Problem, build_problem, stops_per_label
from .rig_fit import Joint, Mode, amount, joint, relative_sigma, with_nominal
from .rig_roofs import RoofUnknowns
from .robust import Optimum, optimise

LEAST_STOPS = 4
LEAST_TURN = np.radians(30.0)  # of the robot between two stops, so that cameras exchange what they see
LEAST_LABELS = 4  # of a camera, each from two stops or by another camera, too: six unknowns, and a few to check them
LEAST_SEEN = 3  # stops from which roof cameras must see a beacon
LEAST_SHARED = 3  # labels that two cameras, or a camera and the tape measure, have in common
MOST_TURN = np.radians(0.5)  # standard deviation of a camera in the rig; a map wants a tenth of it
MOST_SHIFT = 0.015
_FITS = 0.5  # share of sightings explained, below which the rig is not this one
_FREE_ODOMETRY = 0.05  # relative; no worn wheel is farther off
_ODOMETRY = 0.003  # of wheels that were calibrated, where the survey does not say


@dataclass(frozen=True, slots=True)
class Bounds:
    """How far things may be from where the survey has them, as standard deviations (radians, metres).

    `each` of each camera's place on the robot, `whole` of the rig's as one, `beacons` of each beacon's x and y, and
    `roofs` of where roof cameras see beacons, as far as their homographies are wrong.
    """

    each: tuple[float, float] = (float(np.radians(10.0)), 0.05)
    whole: tuple[float, float] = (float(np.radians(0.5)), 0.003)
    beacons: float = 0.01
    roofs: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """One camera: what it used and how sure it is.

    `rig_sigma` are standard deviations (radians, metres) of its turn and place in the rig, `robot_sigma` on the robot;
    `moved` how far it is from nominal. `seen` (N, 2) and `left` (N, 2) px are its explained sightings and residuals.
    """

    model: CameraModel
    rig_sigma: tuple[float, float]
    robot_sigma: tuple[float, float]
    moved: tuple[float, float]
    labels: int
    seen: Floats
    left: Floats

    @property
    def rms_px(self) -> float:
        """Of its residuals, per coordinate."""
        return float(np.sqrt(np.mean(self.left**2)))


@dataclass(frozen=True, slots=True)
class Factor:
    """By what a measured quantity must be multiplied: `value` and its standard deviation; None if it does not show."""

    value: float | None
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class RoofFit:
    """A roof camera's homography as the survey corrects it.

    `moved` and `sigma` are metres in the plane of the beacons, rms over where it saw them; what all roof cameras and
    the world have in common is as it was given. `covariance` (9, 9) is that of the inverse's numbers at unit norm.
    """

    name: str
    H_world_image: Matrix3
    covariance: Floats
    moved: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class BeaconFit:
    """What a roof camera saw of beacons: `seen` (N, 2) and `left` (N, 2) px, the residuals; `size` of its picture."""

    name: str
    size: tuple[int, int]
    seen: Floats
    left: Floats


@dataclass(frozen=True, slots=True, eq=False)
class RigCalibration:
    """What a rig's calibration found.

    Attributes
    ----------
    cameras : tuple of CameraFit
    modes : tuple of Mode
        The motions of the whole rig on the robot, and who knows them.
    beacons : dict of name to position, and `beacon_sigmas` of name to the larger standard deviation of x and y
        Only those that roof cameras saw; heights are as given.
    beacon_distance : (metres, standard deviation) or None
    roofs : tuple of RoofFit
        Of those that saw a beacon.
    scale, turn : Factor
        Of odometry's distances and of its turns.
    stops, known : int
        Stops that took part, and known labels.
    explained : float
        Share of the sightings that fit.
    notes : tuple of str
    slope : float
        Standard deviation of the floor's slope at a stop, as the survey's priors have it, in radians.
    moves : (M, 3) array
        What is left of the moves ahead, to the left and turned, in their standard deviations.
    seen_from_above : tuple of BeaconFit
    """

    cameras: tuple[CameraFit, ...]
    modes: tuple[Mode, ...]
    beacons: dict[str, Vector3]
    beacon_sigmas: dict[str, float]
    beacon_distance: tuple[float, float] | None
    roofs: tuple[RoofFit, ...]
    scale: Factor
    turn: Factor
    stops: int
    known: int
    explained: float
    notes: tuple[str, ...]
    slope: float
    moves: Floats
    seen_from_above: tuple[BeaconFit, ...]

    @property
    def floor_sigma(self) -> float:
        """Radians to which roll and pitch of the whole rig can show at best, whatever else is known.

        Each stop shows them together with the floor's slope there, so the Cramer-Rao bound is the slope's standard
        deviation over the root of the number of stops.
        """
        return self.slope / float(np.sqrt(self.stops))


def calibrate_rig(survey: Survey, bounds: Bounds = Bounds(), *, free: bool = True) -> RigCalibration:
    """Estimate the cameras' poses on the robot, its beacons and its odometry's factors from a survey.

    Parameters
    ----------
    survey : Survey
        Its rig is the nominal one. Its priors hold for the floor and the lenses.
    bounds : Bounds
    free : bool
        False leaves each camera within the survey's own priors, for who wants odometry or beacons alone.

    Raises
    ------
    InputError
        If the survey contradicts itself.
    SolverError
        If it does not determine the rig; the message says which data is missing.
    """
    if not free:
        given = survey.priors
        bounds = replace(bounds, each=(max(given.camera_rotation_rad, 1e-5), max(given.camera_translation_m, 1e-5)))
    with many_records():
        problem = build_problem(_loosened(survey, bounds))
        nominal = problem.R_robot_camera, problem.t_robot_camera
        if lacks := _missing(problem, free):
            raise SolverError("; ".join(lacks))
        optimum = optimise(problem, as_stated=True)
        if optimum.problem.frame != problem.frame or not optimum.placed.all():
            # known labels are hard to match, and legs to join, while cameras look elsewhere than they are thought to
            found, *_ = joint(optimum, (bounds.beacons, bounds.roofs))
            optimum = optimise(build_problem(_loosened(_at(survey, found), bounds)), as_stated=True)
        explained = _explained(optimum)
        if explained < _FITS:
            raise SolverError(
                f"only {100 * explained:.0f} % of the sightings fit any rig near the given one; check which camera is "
                "which (rig.cameras, cables), the lenses and the labels' ids, or give --sphere for a start"
            )
        found, optimum, unknowns, spread = joint(optimum, (bounds.beacons, bounds.roofs))
    found, modes = with_nominal(found, nominal, bounds.each, bounds.whole)
    conflicts = tuple(
        f"the survey puts the rig's {mode.name} {amount(mode.name, abs(mode.change))} from where it was measured "
        "(the measured value was not used)"
        for mode in modes
        if mode.contradicts
    )
    result = replace(
        _result(problem, optimum, found, modes, nominal, bounds),
        roofs=tuple(_roof(unknowns, spread, r) for r in np.unique(unknowns.roof).tolist()),
    )
    if free and (vague := _vague(result)):
        raise SolverError("; ".join(vague))
    notes = (*optimum.problem.notes, *_left_out(optimum), *_exchanged(found, nominal, survey.rig.cameras), *conflicts)
    return replace(result, explained=explained, notes=notes)


def _loosened(survey: Survey, bounds: Bounds) -> Survey:
    """The survey with priors as wide as bounds say; the size of the map shows only against something measured."""
    given: Priors = survey.priors
    metric = build_problem(survey).frame != "first stop"
    priors = replace(
        given,
        camera_rotation_rad=bounds.each[0],
        camera_translation_m=bounds.each[1],
        odometry_scale=_FREE_ODOMETRY if metric else given.odometry_scale or _ODOMETRY,
        odometry_turn=_FREE_ODOMETRY,
        odometry_correlation=0.0,
        beacon_m=0.0,
    )
    exact = tuple(
        replace(roof, covariance=None) for roof in survey.roof_cameras
    )  # `joint` has its own unknowns for them
    return replace(survey, priors=priors, roof_cameras=exact)


def _at(survey: Survey, found: Joint) -> Survey:
    """The survey with another nominal rig."""
    return replace(survey, rig=replace(survey.rig, cameras=_models(survey.rig.cameras, found)))


def _models(cameras: Sequence[CameraModel], found: Joint) -> tuple[CameraModel, ...]:
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = found.rotation, found.translation
    return tuple(replace(one, T_robot_camera=transform_record(T)) for one, T in zip(cameras, poses, strict=True))


# ---- what is missing -------------------------------------------------------------------------------------------------


def _missing(problem: Problem, free: bool) -> list[str]:
    """What a survey lacks for a calibration, before it is tried."""
    lacks = []
    stops, s = problem.stop_count, problem.sightings
    if stops < LEAST_STOPS:
        lacks.append(f"{stops} stops are too few; make {LEAST_STOPS} or more, better 20")
    if len(problem.cameras) == 0:
        lacks.append("the survey's rig has no cameras")
    turned = max(
        (
            float(np.abs(_wrapped(problem.odometry[f, 2] - problem.odometry[problem.leg == problem.leg[f], 2])).max())
            for f in range(stops)
        ),
        default=0.0,
    )
    if turned < LEAST_TURN:
        lacks.append(
            f"the robot turned by {np.degrees(turned):.0f} degrees at most, so that no camera sees what another saw; "
            "turn it on the spot between stops, by 90 degrees or 120, to a full circle"
        )
    if not free:
        return lacks
    known = set(problem.known.label.tolist())
    several = stops_per_label(s.label, s.stop, len(problem.labels)) >= 2
    useful = several | np.isin(np.arange(len(problem.labels)), problem.known.label)
    labels = [set(s.label[(s.camera == c) & useful[s.label]].tolist()) for c in range(len(problem.cameras))]
    names = [camera.name for camera in problem.cameras]
    for name, mine in zip(names, labels, strict=True):
        if len(mine) < LEAST_LABELS:
            lacks.append(
                f"camera {name} saw {len(mine)} labels that another stop saw, too; it needs {LEAST_LABELS} or more: "
                "turn it towards labels at several stops"
            )
    group = list(range(len(labels)))
    for a in range(len(labels)):
        for b in range(a):
            both_known = min(len(labels[a] & known), len(labels[b] & known)) >= LEAST_SHARED
            if len(labels[a] & labels[b]) >= LEAST_SHARED or both_known:
                group = [group[b] if g == group[a] else g for g in group]
    if len(set(group)) > 1 and all(len(mine) >= LEAST_LABELS for mine in labels):
        apart = "; ".join(
            ", ".join(n for n, g in zip(names, group, strict=True) if g == one) for one in sorted({*group})
        )
        lacks.append(
            f"cameras fall into groups that share fewer than {LEAST_SHARED} labels ({apart}); turn the robot so that "
            "each sees what another one saw, or measure the positions of more labels"
        )
    return lacks


def _wrapped(angle: Floats) -> Floats:
    return np.asarray(np.angle(np.exp(1j * angle)))


def _explained(optimum: Optimum) -> float:
    problem, s = optimum.problem, optimum.problem.sightings
    several = stops_per_label(s.label, s.stop, len(problem.labels))[s.label] >= 2
    return float(optimum.inlier[several].mean()) if several.any() else 0.0


def _vague(result: RigCalibration) -> list[str]:
    """Cameras that the survey leaves too uncertain, and what would help."""
    vague = []
    for camera in result.cameras:
        turn, place = camera.rig_sigma
        if turn > MOST_TURN or place > MOST_SHIFT:
            vague.append(
                f"camera {camera.model.name} stays uncertain by {np.degrees(turn):.2f} degrees and {1e3 * place:.0f} "
                f"mm with {camera.labels} labels in {len(camera.seen)} sightings; make more stops where it sees labels "
                "that other cameras see, from 1 to 3 m and from several sides"
            )
    return vague


def _left_out(optimum: Optimum) -> list[str]:
    """Stops that could not be joined to the others."""
    lost = [f"{s.leg}/{s.stop}" for s, ok in zip(optimum.problem.survey.stops, optimum.placed, strict=True) if not ok]
    if not lost:
        return []
    return [
        f"leg/stop {', '.join(lost)} share too few labels with the rest and were not used; carry the robot only to "
        "places from which it sees labels that it has seen"
    ]


def _exchanged(found: Joint, nominal: tuple[Floats, Floats], cameras: Sequence[CameraModel]) -> list[str]:
    """Cameras that look where another one was said to look."""
    look = found.rotation[:, :, 2] @ nominal[0][:, :, 2].T
    return [
        f"camera {cameras[c].name} looks where {cameras[other].name} was said to look: are they exchanged?"
        for c, other in enumerate(np.argmax(look, axis=1).tolist())
        if c != other
    ]


# ---- result ----------------------------------------------------------------------------------------------------------


def _result(
    asked: Problem,
    optimum: Optimum,
    found: Joint,
    modes: tuple[Mode, ...],
    nominal: tuple[Floats, Floats],
    bounds: Bounds,
) -> RigCalibration:
    problem, s = optimum.problem, optimum.adjustment.sightings
    residuals = optimum.adjustment.residuals(optimum.state, SQUARE)
    residual = residuals.residual * s.sigma[:, None]
    turn, place = relative_sigma(found, bounds.each)
    variance = np.diagonal(found.covariance)
    models = _models(asked.survey.rig.cameras, found)
    turned = np.linalg.norm(rotation_vector(found.rotation @ nominal[0].transpose(0, 2, 1)), axis=1)
    shifted = np.linalg.norm(found.translation - nominal[1], axis=1)
    fits = []
    for c, model in enumerate(models):
        mine, own = s.camera == c, variance[6 * c : 6 * c + 6]
        fits.append(
            CameraFit(
                model,
                (float(turn[c]), float(place[c])),
                (float(np.sqrt(own[:3].max())), float(np.sqrt(own[3:].max()))),
                (float(turned[c]), float(shifted[c])),
                len(np.unique(s.label[mine])),
                s.uv[mine],
                residual[mine],
            )
        )
    beacons, sigmas, distance = _beacons(problem, found, 6 * len(models) + ODOMETRY)
    scale, turns = (
        _factor(found.odometry[k], variance[6 * len(models) + k], prior)
        for k, prior in enumerate((asked.survey.priors.odometry_scale, asked.survey.priors.odometry_turn))
    )
    return RigCalibration(
        tuple(fits),
        modes,
        beacons,
        sigmas,
        distance,
        (),
        scale if problem.frame != "first stop" else Factor(None, asked.survey.priors.odometry_scale),
        turns,
        int(np.count_nonzero(optimum.placed)),
        int(np.count_nonzero(np.isin(problem.known.label, s.label))),
        0.0,
        (),
        asked.survey.priors.tilt_rad,
        residuals.move,
        _from_above(problem, residuals.roof),
    )


def _from_above(problem: Problem, residuals: Floats) -> tuple[BeaconFit, ...]:
    roofs = problem.roofs
    left = residuals * roofs.sigma[:, None]
    each = [(roof, roofs.camera == r) for r, roof in enumerate(problem.survey.roof_cameras)]
    return tuple(BeaconFit(roof.name, roof.size, roofs.uv[own], left[own]) for roof, own in each if own.any())


def _factor(value: float, variance: float, prior: float) -> Factor:
    sigma = float(np.sqrt(variance))
    return Factor(1.0 + float(value) if sigma < 0.5 * prior else None, sigma)


def _roof(unknowns: RoofUnknowns, covariance: Floats, r: int) -> RoofFit:
    H = np.linalg.inv(unknowns.homographies[r])
    (a, b, c), (d, e, f), (g, h, i) = (H / H[2, 2]).tolist()
    moved, sigma = unknowns.roof_sigma(covariance, r)
    rows = (a, b, c), (d, e, f), (g, h, i)
    return RoofFit(unknowns.names[r], rows, unknowns.matrix_covariance(covariance, r), moved, sigma)


def _beacons(
    problem: Problem, found: Joint, first: int
) -> tuple[dict[str, Vector3], dict[str, float], tuple[float, float] | None]:
    """Those that roof cameras saw from three stops or more, and the distance between the first two."""
    places, sigmas, rows = {}, {}, []
    given = np.array(list(problem.survey.rig.beacons.values())).reshape(-1, 3)
    for k, name in enumerate(problem.survey.rig.beacons):
        seen = [b for stop in problem.survey.stops for b in stop.beacon_sightings if b.beacon == name]
        if len(seen) < LEAST_SEEN or len(problem.roofs.stop) == 0:
            continue
        places[name] = (float(found.beacons[k, 0]), float(found.beacons[k, 1]), float(given[k, 2]))
        own = found.covariance[first + 2 * k : first + 2 * k + 2, first + 2 * k : first + 2 * k + 2]
        sigmas[name] = float(np.sqrt(np.linalg.eigvalsh(own)[-1]))
        rows.append(k)
    if len(rows) != 2:
        return places, sigmas, None
    apart = found.beacons[rows[0], :2] - found.beacons[rows[1], :2]
    length = float(np.linalg.norm(apart))
    J = np.zeros(len(found.covariance))
    for k, sign in zip(rows, (1.0, -1.0), strict=True):
        J[first + 2 * k : first + 2 * k + 2] = sign * apart / length
    return places, sigmas, (length, float(np.sqrt(J @ found.covariance @ J)))


def camera_to_camera(cameras: Sequence[CameraModel]) -> tuple[Floats, Floats]:
    """Poses of all cameras in the axes of the first, rotations (C, 3, 3) and translations (C, 3): no common motion."""
    R = rotation_matrix([camera.T_robot_camera.rotation for camera in cameras])
    t = np.array([camera.T_robot_camera.translation for camera in cameras])
    return R[0].T @ R, (t - t[0]) @ R[0]
