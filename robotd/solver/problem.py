"""A survey as arrays: what is unknown, what was measured, and how far each may be believed.

The unknowns are a frame vector and the label points. The frame vector holds, in this order,

    5 per stop      x, y, heading, roll, pitch
    10 per camera   corrections: rotation vector (3) and translation (3) in camera-to-robot, fx, fy, cx, cy
    8 per roof      homography of a roof camera, along the principal axes of its covariance, in standard deviations
    2 per beacon    shift of its x, y in robot axes
    3               errors of all odometry: scale, turns beyond what the scale's error makes expect, and drift

Entries whose prior is zero, and the first stop's planar pose when nothing outside fixes the world frame, are held
fixed: they have no column in the normal equations, so that a planar problem costs what a planar problem costs.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..errors import SolverError
from ..geometry.camera import Camera
from ..geometry.transforms import pose_array, se2_relative
from ..records import Floats, Survey
from ..survey_checks import oddities
from .consistency import Columns, camera_of, checked_columns
from .wheel_errors import EXACT, arc_by_errors, coupling, move_by_errors, odometry_sigmas

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

STOP, CAMERA, ROOF, BEACON, ODOMETRY = 5, 10, 8, 2, 3  # entries of the frame vector: see above
SIGMA_FLOOR_PX = 0.05  # to judge which sightings fit: what lenses leave, whatever a detector says of its centroid
BEACON_SPREAD_M = 0.05  # beacons nearer together than this do not show a heading
COVARIANCE_FLOOR = np.diag([1e-4, 1e-4, 1e-4]) ** 2  # keeps a move that was reported as exact invertible


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Arrays of one length, row by row."""

    def select(self, keep: Bools | Ints) -> Self:
        """Some of the rows."""
        if keep.dtype == np.bool_:
            if keep.all():
                return self
            keep = np.flatnonzero(keep)  # once, not once a column: large stores have a hundred thousand
        columns: list[Floats] = [getattr(self, field.name)[keep] for field in fields(self)]
        return type(self)(*columns)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings(Rows):
    """The usable sightings as arrays, ordered by camera; `source` is the index in the survey's own order.

    `stop`, `camera`, `label` and `source` are (N,) indices, `uv` (N, 2) px, `sigma` (N,) px, `probability` (N,).
    `rival` (N,) numbers the groups of sightings of one label by one camera at one stop: at most one of each is right.
    `origin`, `direction` (N, 3) are the viewing rays in robot axes under the calibration as given.
    """

    stop: Ints
    camera: Ints
    label: Ints
    uv: Floats
    sigma: Floats
    probability: Floats
    rival: Ints
    source: Ints
    origin: Floats
    direction: Floats

    def __len__(self) -> int:
        return len(self.stop)


@dataclass(frozen=True, slots=True, eq=False)
class Moves(Rows):
    """Odometry factors: `before`, `after` (M,) stops, `measured` (M, 3), `covariance` (M, 3, 3).

    `by_errors` (M, 3, 3) are derivatives of the measured by the three last entries of the frame vector. `stated`
    (M, 3, 3) are the covariances as the survey has them; `loosened` (M,) says which moves count as slipped or lost.
    """

    before: Ints
    after: Ints
    measured: Floats
    covariance: Floats
    by_errors: Floats
    stated: Floats
    loosened: Bools


@dataclass(frozen=True, slots=True, eq=False)
class Motions(Rows):
    """Moves by other sensors than wheels: `before`, `after` (K,) stops, `measured` (K, 3), `root` (K, 3, 3), `source`.

    The root's product R' R is the information; directions that a sensor does not show have none.
    """

    before: Ints
    after: Ints
    measured: Floats
    root: Floats
    source: NDArray[np.str_]


@dataclass(frozen=True, slots=True, eq=False)
class Roofs(Rows):
    """Beacons seen by roof cameras: `stop` (B,), `beacon` (B, 3) in robot axes, `uv` (B, 2) and `sigma` (B,) in px.

    `H_image_world` (B, 3, 3) takes world x, y in the beacons' plane to the roof camera's pixels. `camera` and `which`
    (B,) number the survey's roof cameras and the rig's beacons.
    """

    stop: Ints
    camera: Ints
    which: Ints
    beacon: Floats
    uv: Floats
    sigma: Floats
    H_image_world: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """Labels measured by hand: `label` (K,) indices, `position` (K, 3) and `sigma` (K,) in metres."""

    label: Ints
    position: Floats
    sigma: Floats


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all unknowns: `frame` (F,) as the module describes, `points` (L, 3) world metres."""

    frame: Floats
    points: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Everything the solver computes with; indices count stops in the survey's order and labels as in `labels`.

    `prior_sigma` (F,) holds the standard deviations of the frame entries around zero: 0 = held fixed, infinite = free.
    `leg` (S,) is the leg of each stop, `odometry` (S, 3) its dead-reckoned pose in the leg's own frame.
    `roof_axes` (R, 8, 3, 3) are the steps of each roof camera's homography, world to pixels, by its entries.
    `frame` says what fixes the world frame: "first stop", "known labels" or "roof cameras".
    """

    survey: Survey
    columns: Columns
    cameras: tuple[Camera, ...]
    R_robot_camera: Floats
    t_robot_camera: Floats
    labels: tuple[str, ...]
    sightings: Sightings
    moves: Moves
    motions: Motions
    roofs: Roofs
    roof_axes: Floats
    known: Known
    leg: Ints
    odometry: Floats
    prior_sigma: Floats
    frame: str
    notes: tuple[str, ...]

    @property
    def stop_count(self) -> int:
        return len(self.leg)

    @property
    def free(self) -> Bools:
        """(F,) entries of the frame vector that the solver may change."""
        return np.asarray(self.prior_sigma > 0.0)

    def stop_entries(self, state: State) -> Floats:
        """(S, 5) x, y, heading, roll, pitch."""
        return state.frame[: STOP * self.stop_count].reshape(-1, STOP)

    def camera_entries(self, state: State) -> Floats:
        """(C, 10) corrections of the cameras."""
        return state.frame[STOP * self.stop_count : self.roof_entry].reshape(-1, CAMERA)

    @property
    def roof_entry(self) -> int:
        """Where the roof cameras' entries begin."""
        return STOP * self.stop_count + CAMERA * len(self.cameras)

    @property
    def beacon_entry(self) -> int:
        """Where the beacons' entries begin."""
        return self.roof_entry + ROOF * len(self.roof_axes)


def build_problem(survey: Survey) -> Problem:
    """Turn a survey into arrays.

    Raises
    ------
    InputError
        If the survey contradicts itself (unknown camera, a stop twice, numbers that are not finite): all mistakes.
    SolverError
        If the survey has no stops.
    """
    if not survey.stops:
        raise SolverError(f"survey {survey.survey}: it has no stops, so there is nothing to map")
    survey = replace(survey, stops=tuple(sorted(survey.stops, key=lambda stop: (stop.leg, stop.stop))))
    columns = checked_columns(survey)
    cameras = tuple(map(camera_of, survey.rig.cameras))
    labels = sorted({*columns.names, *(known.label for known in survey.known_labels)})
    sightings, notes = _sightings(columns, cameras, labels)
    moves, gaps = _moves(survey)
    known = _known(survey, labels)
    roofs, axes = _roofs(survey)
    frame = "first stop"
    if len(roofs.stop) >= 2 and np.ptp(np.column_stack([roofs.stop, roofs.beacon]), axis=0).max() > BEACON_SPREAD_M:
        frame = "roof cameras"
    elif anchors(known, sightings):
        frame = "known labels"
    elif len(roofs.stop):
        gaps.append("one sighting of a beacon does not fix the world frame, so the roof cameras were not used")
        roofs = roofs.select(np.zeros(len(roofs.stop), dtype=np.bool_))
    return Problem(
        survey=survey,
        columns=columns,
        cameras=cameras,
        R_robot_camera=np.array([c.T_robot_camera[:3, :3] for c in cameras]).reshape(-1, 3, 3),
        t_robot_camera=np.array([c.T_robot_camera[:3, 3] for c in cameras]).reshape(-1, 3),
        labels=tuple(labels),
        sightings=sightings,
        moves=moves,
        motions=_motions(survey),
        roofs=roofs,
        roof_axes=axes,
        known=known,
        leg=np.array([stop.leg for stop in survey.stops]),
        odometry=np.array([pose_array(stop.odometry) for stop in survey.stops]),
        prior_sigma=_prior_sigma(survey, roofs, axes, fixed_first=frame == "first stop"),
        frame=frame,
        notes=(*oddities(survey), *notes, *gaps),
    )


def _sightings(columns: Columns, cameras: tuple[Camera, ...], labels: list[str]) -> tuple[Sightings, list[str]]:
    stop, camera, uv, sigma, probability = columns.stop, columns.camera, columns.uv, columns.sigma, columns.probability
    rows = len(stop)
    label_index = {label: i for i, label in enumerate(labels)}
    label = np.fromiter(map(label_index.__getitem__, columns.names), np.int64, rows)
    origin, direction, usable = np.zeros((rows, 3)), np.zeros((rows, 3)), np.zeros(rows, dtype=np.bool_)
    for c, model in enumerate(cameras):
        mine = camera == c
        rays, valid = model.rays(uv[mine])
        direction[mine] = rays @ model.T_robot_camera[:3, :3].T
        origin[mine] = model.T_robot_camera[:3, 3]
        usable[mine] = valid
    notes = []
    if not usable.all():
        notes.append(
            f"{np.count_nonzero(~usable)} of {rows} sightings lie where the lens model cannot be inverted "
            "(beyond its valid radius) and were not used"
        )
    _, rival = np.unique((stop * len(cameras) + camera) * (len(labels) + 1) + label, return_inverse=True)
    everything = Sightings(
        stop=stop,
        camera=camera,
        label=label,
        uv=uv,
        sigma=np.maximum(sigma, SIGMA_FLOOR_PX),
        probability=np.clip(probability, 0.01, 1.0),
        rival=rival.astype(np.int64).ravel(),
        source=np.arange(rows),
        origin=origin,
        direction=direction,
    )
    order = np.argsort(camera, kind="stable")
    return everything.select(order[usable[order]]), notes


def _moves(survey: Survey) -> tuple[Moves, list[str]]:
    after = [f for f in range(1, len(survey.stops)) if survey.stops[f - 1].leg == survey.stops[f].leg]
    measured, covariance, by_errors, notes = [], [], [], []
    for f in after:
        stop, before = survey.stops[f], survey.stops[f - 1]
        if stop.move is not None and stop.stop == before.stop + 1:
            measured.append(np.array([stop.move.dx, stop.move.dy, stop.move.dheading]))
            covariance.append(np.array(stop.move.covariance) + COVARIANCE_FLOOR)
            by_errors.append(move_by_errors(stop.move))
            continue
        # a stop between is missing, so that the move starts somewhere else; the odometry poses still say something
        move = se2_relative(pose_array(before.odometry), pose_array(stop.odometry))
        distance = float(np.hypot(move[0], move[1]))
        measured.append(move)
        by_errors.append(arc_by_errors(move))
        covariance.append(np.diag([0.02 + 0.05 * distance, 0.02 + 0.05 * distance, 0.05 + 0.05 * distance]) ** 2)
        notes.append(
            f"leg {stop.leg}: no move leads from stop {before.stop} to stop {stop.stop}; "
            "their odometry poses were used instead, with wide margins"
        )
    index, derivatives = np.array(after, dtype=np.int64), np.array(by_errors).reshape(-1, 3, 3)
    derivatives[:, :, 0] += coupling(survey.priors) * derivatives[:, :, 1]
    covariances = np.array(covariance).reshape(-1, 3, 3)
    steady = np.zeros(len(index), dtype=np.bool_)
    moved = np.array(measured).reshape(-1, 3)
    return Moves(index - 1, index, moved, covariances, derivatives, covariances, steady), notes


def _motions(survey: Survey) -> Motions:
    rows = [
        (f, motion)
        for f in range(1, len(survey.stops))
        for motion in survey.stops[f].motions
        if survey.stops[f - 1].leg == survey.stops[f].leg and survey.stops[f].stop == survey.stops[f - 1].stop + 1
    ]
    after = np.array([f for f, _ in rows], dtype=np.int64)
    information = np.array([motion.information for _, motion in rows]).reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(information)
    return Motions(
        after - 1,
        after,
        np.array([[motion.dx, motion.dy, motion.dheading] for _, motion in rows]).reshape(-1, 3),
        np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1),
        np.array([motion.source for _, motion in rows], dtype=np.str_),
    )


def _roofs(survey: Survey) -> tuple[Roofs, Floats]:
    inverse = {roof.name: np.linalg.inv(np.array(roof.H_world_image)) for roof in survey.roof_cameras}
    rows = [(f, b) for f, stop in enumerate(survey.stops) for b in stop.beacon_sightings]
    default = survey.sigmas.roof_px if survey.sigmas.roof_px > 0.0 else 1.0
    cameras, beacons = list(inverse), list(survey.rig.beacons)
    axes = np.array([_roof_axes(inverse[r.name], r.covariance) for r in survey.roof_cameras]).reshape(-1, ROOF, 3, 3)
    roofs = Roofs(
        stop=np.array([f for f, _ in rows], dtype=np.int64),
        camera=np.array([cameras.index(b.roof_camera) for _, b in rows], dtype=np.int64),
        which=np.array([beacons.index(b.beacon) for _, b in rows], dtype=np.int64),
        beacon=np.array([survey.rig.beacons[b.beacon] for _, b in rows]).reshape(-1, 3),
        uv=np.array([[b.u, b.v] for _, b in rows]).reshape(-1, 2),
        sigma=np.array([default if b.sigma_px is None else b.sigma_px for _, b in rows]),
        H_image_world=np.array([inverse[b.roof_camera] for _, b in rows]).reshape(-1, 3, 3),
    )
    return roofs, axes


def _roof_axes(H: Floats, covariance: tuple[tuple[float, ...], ...] | None) -> Floats:
    """(8, 3, 3) steps of one standard deviation along a homography's principal axes; 0 where it is exact."""
    if covariance is None:
        return np.zeros((ROOF, 3, 3))
    values, vectors = np.linalg.eigh(np.array(covariance))  # the least of nine is the scale, which says nothing
    values = np.where(values > 1e-9 * values[-1], values, 0.0)[-ROOF:]
    return np.asarray((np.linalg.norm(H) * np.sqrt(values) * vectors[:, -ROOF:]).T.reshape(ROOF, 3, 3))


def _known(survey: Survey, labels: list[str]) -> Known:
    return Known(
        label=np.array([labels.index(k.label) for k in survey.known_labels], dtype=np.int64),
        position=np.array([k.position for k in survey.known_labels]).reshape(-1, 3),
        sigma=np.array([max(k.sigma_m, 1e-5) for k in survey.known_labels]),
    )


def stops_per_label(labels: Ints, stops: Ints, label_count: int) -> Ints:
    """From how many different stops each label was seen, given the label and stop (N,) of sightings."""
    pairs = np.sort(labels * (int(stops.max(initial=0)) + 1) + stops)
    first = np.ones(len(pairs), dtype=np.bool_)
    first[1:] = pairs[1:] != pairs[:-1]
    return np.bincount(pairs[first] // (int(stops.max(initial=0)) + 1), minlength=label_count)


def anchors(known: Known, sightings: Sightings) -> bool:
    """Two known labels that were seen fix the plane, unless one hangs right above the other (erratum A9)."""
    seen = known.position[np.isin(known.label, sightings.label)]
    return len(seen) >= 2 and bool(np.ptp(seen[:, :2], axis=0).max() > 0.1)


def _prior_sigma(survey: Survey, roofs: Roofs, axes: Floats, fixed_first: bool) -> Floats:
    p = survey.priors
    stops = np.tile([np.inf, np.inf, np.inf, p.tilt_rad, p.tilt_rad], (len(survey.stops), 1))
    if fixed_first:
        stops[0, :3] = 0.0
    one = [p.camera_rotation_rad] * 3 + [p.camera_translation_m] * 3 + [p.focal_px] * 2 + [p.centre_px] * 2
    cameras = np.tile(one, len(survey.rig.cameras))
    watches = np.isin(np.arange(len(axes)), roofs.camera)  # homographies and beacons that nothing shows stay exact
    seen = np.isin(np.arange(len(survey.rig.beacons)), roofs.which)
    plane = np.where(watches[:, None] & axes.any(axis=(2, 3)), 1.0, 0.0)
    beacons = np.repeat(np.where(seen, p.beacon_m, 0.0), BEACON)
    sigma = np.concatenate([stops.ravel(), cameras, plane.ravel(), beacons, odometry_sigmas(p)])
    return np.where(sigma < EXACT, 0.0, sigma)
