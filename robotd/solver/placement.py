"""Bringing every unbroken run of odometry into one world frame, and a first guess of all points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.transforms import heading_matrix, se2_compose, se2_inverse
from ..records import Floats
from .initial import chain, locate, triangulate, world_rays
from .problem import ODOMETRY, STOP, Bools, Ints, Known, Problem, State
from .wheel_errors import LOST

LABELS_TO_JOIN = 3  # shared labels that must agree before two runs of odometry are joined


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A start: `state`, which stops have a place in the world (S,), and which points were triangulated (L,)."""

    state: State
    placed: Bools
    found: Bools


def segments(problem: Problem) -> Ints:
    """(S,) number of the unbroken run of moves that each stop belongs to; a lost move breaks it."""
    moves, linked = problem.moves, np.zeros(problem.stop_count, dtype=np.bool_)
    linked[moves.after[moves.covariance[:, 2, 2] < LOST[2, 2]]] = True
    return np.cumsum(~linked) - 1


def place(problem: Problem, moves: Floats, tolerance: float) -> Placement:
    """Pose every run of odometry that outside references or shared labels can join; triangulate all labels.

    Parameters
    ----------
    problem : Problem
    moves : (M, 3) array
        Moves to chain, e.g. as measured.
    tolerance : float
        Angle in radians up to which rays agree.
    """
    segment = segments(problem)
    local = chain(problem, moves, segment)
    axes: dict[int, Floats] = {}
    for k in range(int(segment[-1]) + 1):
        pose = _by_roof(problem, local, segment == k)
        if pose is not None:
            axes[k] = pose
    if problem.frame == "first stop":
        axes[0] = problem.odometry[0]
        longest = int(np.argmax(np.bincount(segment)))
        if longest != 0:  # grow from there, because a short first run may triangulate nothing to join others by
            grown = {longest: np.zeros(3)}
            _grow(problem, local, segment, grown, tolerance)
            if 0 in grown:
                shift = se2_compose(problem.odometry[0], se2_inverse(grown[0]))
                axes = {k: se2_compose(shift, pose) for k, pose in grown.items()}
    state, found = _grow(problem, local, segment, axes, tolerance)
    return Placement(state, np.isin(segment, list(axes)), found)


def _grow(
    problem: Problem, local: Floats, segment: Ints, axes: dict[int, Floats], tolerance: float
) -> tuple[State, Bools]:
    """Add to `axes` every run that shared labels join to those in it; returns the state and the points found."""
    known = np.full((len(problem.labels), 3), np.nan)
    known[problem.known.label] = problem.known.position
    while True:
        state, found = _assemble(problem, local, segment, axes, tolerance)
        targets = np.where(np.isnan(known), np.where(found[:, None], state.points, np.nan), known)
        joined = [
            k for k in range(int(segment[-1]) + 1) if k not in axes and _join(problem, local, segment, k, axes, targets)
        ]
        if not joined:
            return state, found


def _assemble(
    problem: Problem, local: Floats, segment: Ints, axes: dict[int, Floats], tolerance: float
) -> tuple[State, Bools]:
    poses = problem.odometry.copy()
    for k, pose in axes.items():
        poses[segment == k] = se2_compose(pose, local[segment == k])
    frame = np.zeros(len(problem.prior_sigma))
    frame[: STOP * len(poses)].reshape(-1, STOP)[:, :3] = poses
    state = State(frame, np.zeros((len(problem.labels), 3)))
    return retriangulate(problem, state, tolerance, np.isin(segment, list(axes)))


def ray_tolerance(problem: Problem) -> float:
    """Four standard deviations of a sighting as an angle, and never less than what tilt and calibration leave."""
    if len(problem.sightings) == 0:
        return 0.015
    focal = min(float(camera.focal.min()) for camera in problem.cameras)
    return max(0.015, 4.0 * float(np.median(problem.sightings.sigma)) / focal)


def retriangulate(
    problem: Problem, state: State, tolerance: float, placed: Bools, labels: Ints | None = None
) -> tuple[State, Bools]:
    """Triangulate labels again, all or some, from the state's poses; points that cannot be found stay as they were."""
    chosen = placed[problem.sightings.stop]
    if labels is not None:
        chosen &= np.isin(problem.sightings.label, labels)
    sightings = problem.sightings.select(chosen)
    origin, direction = world_rays(problem, sightings, state)
    points, found = triangulate(
        origin, direction, sightings.label, sightings.stop, sightings.probability, len(problem.labels), tolerance
    )
    fresh = found | ~np.any(state.points, axis=1)
    points = np.where(fresh[:, None], points, state.points)
    points[problem.known.label] = problem.known.position
    return replace(state, points=points), found


def _join(problem: Problem, local: Floats, segment: Ints, k: int, axes: dict[int, Floats], targets: Floats) -> bool:
    """Try to place run k by the labels whose positions are known by now."""
    sightings = problem.sightings
    mine = (segment[sightings.stop] == k) & np.isfinite(targets[sightings.label, 0])
    if not mine.any():
        return False
    sightings = sightings.select(mine)
    poses = np.zeros((len(segment), STOP))
    poses[:, :3] = local
    inside = State(np.concatenate([poses.ravel(), np.zeros(len(problem.prior_sigma) - poses.size)]), targets)
    origin, direction = world_rays(problem, sightings, inside)
    located = locate(origin, direction, targets[sightings.label], sightings.label)
    if located is None:
        return False
    pose, agree = located
    agreeing = np.unique(sightings.label[agree])
    needed = 2 if np.isin(agreeing, problem.known.label).sum() >= 2 else LABELS_TO_JOIN
    if len(agreeing) < needed:
        return False
    axes[k] = pose
    return True


def _by_roof(problem: Problem, local: Floats, mine: Bools) -> Floats | None:
    """Planar pose of a run's axes from its beacons seen by roof cameras (least squares, Umeyama without scale)."""
    roofs = problem.roofs
    use = mine[roofs.stop]
    if np.count_nonzero(use) < 2:
        return None
    stop, beacon = roofs.stop[use], roofs.beacon[use]
    inside = local[stop, :2] + (heading_matrix(local[stop, 2]) @ beacon[:, :2, None])[:, :, 0]
    h = (np.linalg.inv(roofs.H_image_world[use]) @ np.column_stack([roofs.uv[use], np.ones(len(stop))])[:, :, None])[
        :, :, 0
    ]
    world = h[:, :2] / h[:, 2:]
    weight = np.ones(len(stop))
    pose = np.zeros(3)
    for _ in range(10):
        a, b = np.average(inside, axis=0, weights=weight), np.average(world, axis=0, weights=weight)
        p, q = inside - a, world - b
        if (p**2).sum() < 1e-4:
            return None
        heading = np.arctan2(weight @ (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), weight @ (p * q).sum(axis=1))
        pose = np.array([*(b - heading_matrix(heading) @ a), heading])
        miss = ((q - p @ heading_matrix(heading).T) ** 2).sum(axis=1)
        weight = 1.0 / (1.0 + miss / 0.1**2)
    return pose


def detach(problem: Problem, placed: Bools) -> Problem:
    """The problem without the stops that have no place in the world: they are held fixed and measure nothing."""
    if placed.all():
        return problem
    prior = problem.prior_sigma.copy()
    prior[: STOP * problem.stop_count].reshape(-1, STOP)[~placed] = 0.0
    moves = problem.moves
    keep, seen = placed[moves.after], placed[problem.roofs.stop]
    return replace(
        problem,
        prior_sigma=prior,
        sightings=problem.sightings.select(placed[problem.sightings.stop]),
        moves=moves.select(keep),
        motions=problem.motions.select(placed[problem.motions.after]),
        roofs=problem.roofs.select(seen),
    )


def at_first_stop(problem: Problem, note: str) -> Problem:
    """The problem with its world frame fixed by the first stop, after its outside references proved useless."""
    prior = problem.prior_sigma.copy()
    prior[:3] = prior[problem.roof_entry : -ODOMETRY] = 0.0
    nothing = Known(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
    roofs = problem.roofs.select(np.zeros(len(problem.roofs.stop), dtype=np.bool_))
    return replace(
        problem, prior_sigma=prior, known=nothing, roofs=roofs, frame="first stop", notes=(*problem.notes, note)
    )
