"""Where to start: poses from odometry and epipolar geometry, points from robust triangulation.

Bundle adjustment descends into the nearest minimum, so the start decides. Three tools, none of which needs another's
result to be good:

`epipolar_moves` improves each move by the rays of labels seen from both of its stops, without knowing any depth.
`triangulate` finds for every label the point that most of its rays agree on, in front of the cameras, among all pairs
of rays (erratum A12: the thesis's labels "on the opposite side of the robot" are solutions behind the cameras).
`locate` finds the planar pose from which rays point at labels whose positions are known.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.transforms import heading_matrix, pose_matrix, rotation_matrix, se2_compose, wrap_angle
from ..records import Floats
from .problem import Bools, Ints, Problem, Sightings, State

kernel: Any
try:
    from . import _rays as kernel
except ImportError:  # built without extensions
    kernel = None

FARTHEST_M = 60.0  # a label's light is lost in the noise long before
FLOOR_M = -0.10  # a point lower than this is a reflection in the floor that the robot drives on
_FALLBACK_M = 1.5  # along the first ray of a label that cannot be triangulated
_MOST_PAIRS = 190  # all pairs of 20 rays; more only repeat what those say
_LEAST_PARALLAX = np.radians(0.3)
_GRID_PAIRS = 20  # of a move's ray pairs, to search its grid with
_NEGLIGIBLE = 1e-3  # decrease of a move's loss
_RAY_SIGMA = 0.01  # rad: tilt and calibration, which the epipolar step does not know


def world_rays(problem: Problem, sightings: Sightings, state: State) -> tuple[Floats, Floats]:
    """Origins and unit directions (N, 3) in the world of the sightings' rays, with the state's poses and rig."""
    poses, corrections = problem.stop_entries(state), problem.camera_entries(state)
    R = problem.R_robot_camera
    turn = R @ rotation_matrix(corrections[:, :3]) @ R.transpose(0, 2, 1)
    direction = (turn[sightings.camera] @ sightings.direction[:, :, None])[:, :, 0]
    origin = sightings.origin + corrections[sightings.camera, 3:6]
    T = pose_matrix(*poses.T)[sightings.stop]
    return (
        (T[:, :3, :3] @ origin[:, :, None])[:, :, 0] + T[:, :3, 3],
        (T[:, :3, :3] @ direction[:, :, None])[:, :, 0],
    )


def triangulate(
    origin: Floats, direction: Floats, label: Ints, stop: Ints, weight: Floats, label_count: int, tolerance: float
) -> tuple[Floats, Bools]:
    """Points that most rays of each label agree on.

    Every pair of rays from different stops proposes the midpoint of its closest approach; the proposal with the lowest
    truncated squared angle to all rays of the label wins (MSAC, Torr and Zisserman 2000).

    Parameters
    ----------
    origin, direction : (N, 3) array
        Rays in world axes; directions of unit length.
    label, stop : (N,) array
        Indices.
    weight : (N,) array
        How much each ray counts.
    label_count : int
    tolerance : float
        Angle in radians at which a ray stops counting.

    Returns
    -------
    points : (label_count, 3) array
    found : (label_count,) bool array
        False where no pair of rays meets in front of both cameras; the point is then a guess along the first ray.
    """
    points, found = np.zeros((label_count, 3)), np.zeros(label_count, dtype=np.bool_)
    order = np.argsort(label, kind="stable")
    counts = np.bincount(label, minlength=label_count)
    starts = np.cumsum(counts) - counts
    seen = counts > 0
    first = order[starts[seen]]
    points[seen] = origin[first] + _FALLBACK_M * direction[first]
    if kernel is None:
        _vote(origin, direction, stop, weight, order, starts, counts, tolerance, points, found)
        return points, found
    pairs = {n: _pairs(n) for n in np.unique(counts[counts >= 2]).tolist()}
    sizes = np.zeros(int(counts.max(initial=0)) + 2, dtype=np.int64)
    sizes[[n + 1 for n in pairs]] = [len(i) for i, _ in pairs.values()]
    nothing = np.zeros(0, dtype=np.int64)
    kernel.vote(
        np.ascontiguousarray(origin),
        np.ascontiguousarray(direction),
        np.asarray(weight, dtype=np.float64),
        stop,
        order,
        np.concatenate([starts, [len(order)]]),
        np.cumsum(sizes),
        np.concatenate([nothing, *(i for i, _ in pairs.values())]),
        np.concatenate([nothing, *(j for _, j in pairs.values())]),
        tolerance,
        np.sin(_LEAST_PARALLAX),
        FARTHEST_M,
        FLOOR_M,
        points,
        found.view(np.uint8),
    )
    return points, found


def _pairs(n: int) -> tuple[Ints, Ints]:
    """Pairs of n rays to try."""
    i, j = np.triu_indices(n, 1)
    if len(i) > _MOST_PAIRS:
        chosen = np.linspace(0, len(i) - 1, _MOST_PAIRS).astype(np.int64)
        i, j = i[chosen], j[chosen]
    return i, j


def _vote(
    origin: Floats,
    direction: Floats,
    stop: Ints,
    weight: Floats,
    order: Ints,
    starts: Ints,
    counts: Ints,
    tolerance: float,
    points: Floats,
    found: Bools,
) -> None:
    """The vote in numpy, into `points` and `found`, all labels with equally many rays at once."""
    for n in np.unique(counts[counts >= 2]):
        i, j = _pairs(int(n))
        for some in np.array_split(which := np.flatnonzero(counts == n), 1 + len(which) * len(i) * n // 1_000_000):
            rays = order[starts[some][:, None] + np.arange(n)]
            X, usable = _meet(origin[rays], direction[rays], i, j)
            usable &= stop[rays[:, i]] != stop[rays[:, j]]
            toward = X[:, :, None] - origin[rays][:, None]
            toward /= np.linalg.norm(toward, axis=3, keepdims=True) + 1e-12
            # for small angles the chord is the angle, and for large ones only its exceeding the tolerance matters
            square = ((toward - direction[rays][:, None]) ** 2).sum(axis=3) / tolerance**2
            score = (np.minimum(square, 1.0) * weight[rays][:, None]).sum(axis=2)
            score = np.where(usable, score, np.inf)
            best = np.argmin(score, axis=1)
            good = np.isfinite(score[np.arange(len(some)), best])
            points[some[good]] = X[np.arange(len(some)), best][good]
            found[some[good]] = True


def _meet(origin: Floats, direction: Floats, i: Ints, j: Ints) -> tuple[Floats, Bools]:
    """Midpoints (L, P, 3) of the closest approach of ray pairs, and whether they may be labels."""
    a, b = direction[:, i], direction[:, j]
    base = origin[:, i] - origin[:, j]
    cosine = (a * b).sum(axis=2)
    determinant = np.maximum(1.0 - cosine**2, 1e-12)
    along_a, along_b = (a * base).sum(axis=2), (b * base).sum(axis=2)
    s = (cosine * along_b - along_a) / determinant
    t = (along_b - cosine * along_a) / determinant
    X = 0.5 * (origin[:, i] + s[:, :, None] * a + origin[:, j] + t[:, :, None] * b)
    usable = (s > 0.1) & (t > 0.1) & (s < FARTHEST_M) & (t < FARTHEST_M) & (X[:, :, 2] > FLOOR_M)
    return X, usable & (determinant > np.sin(_LEAST_PARALLAX) ** 2)


def epipolar_moves(problem: Problem, sightings: Sightings, guess: Floats | None = None) -> Floats:
    """Moves (M, 3) corrected by the coplanarity of rays to labels seen from both of their stops.

    Minimised is a Cauchy loss of the angles by which the rays miss each other, plus the same of the move's odometry
    residual, first over a grid of headings and directions around `guess` (M, 3), by default the measured moves, and
    then by damped Gauss-Newton steps, all moves at once.
    """
    moves = problem.moves
    guess = moves.measured if guess is None else guess
    a, b, owner = _common_rays(moves.before, moves.after, sightings)
    if len(owner) == 0:
        return guess.copy()
    rays = _RayPairs(sightings, a, b, owner, len(moves.before))
    few = max(1, len(owner) // (_GRID_PAIRS * len(moves.before)))
    some = _RayPairs(sightings, a[::few], b[::few], owner[::few], len(moves.before)) if few > 1 else rays
    root = np.linalg.inv(np.linalg.cholesky(moves.covariance))

    def losses(move: Floats, rays: _RayPairs = rays) -> Floats:
        prior = ((root @ (move - moves.measured)[:, :, None]) ** 2).sum(axis=(1, 2))
        return np.asarray(rays.losses(move) + 9.0 * np.log1p(prior / 9.0))

    sigma = np.sqrt(np.diagonal(moves.covariance, axis1=1, axis2=2))
    distance = np.maximum(np.hypot(guess[:, 0], guess[:, 1]), 0.05)
    widest = np.maximum(3.0 * sigma[:, 2], 0.15)
    sideways = np.minimum(np.maximum(3.0 * sigma[:, 1] / distance, 0.1), 1.2)
    best, lowest = guess.copy(), losses(guess, some)
    for turn in np.linspace(-1.0, 1.0, 9):
        for side in np.linspace(-1.0, 1.0, 5):
            trial = guess.copy()
            trial[:, :2] = (heading_matrix(side * sideways) @ trial[:, :2, None])[:, :, 0]
            trial[:, 2] += turn * widest
            cost = losses(trial, some)
            best[cost < lowest] = trial[cost < lowest]
            lowest = np.minimum(cost, lowest)
    lowest = losses(best)
    damping, idle = np.full(len(moves.before), 1e-3), 0
    for _ in range(18):
        trial = best + _epipolar_step(rays, best, moves.measured, root, damping)
        cost = losses(trial)
        better = cost < lowest
        idle = 0 if (lowest - cost > _NEGLIGIBLE).any() else idle + 1
        if idle == 3:  # the first of them may have been steps too long
            break
        best[better], lowest[better] = trial[better], cost[better]
        damping = np.where(better, damping * 0.3, damping * 10.0)
    best[:, 2] = wrap_angle(best[:, 2])
    return best


def _common_rays(before: Ints, after: Ints, sightings: Sightings) -> tuple[Ints, Ints, Ints]:
    """Pairs of sightings of one label from the two stops of each move, and the move they belong to, ascending."""
    order = np.lexsort((sightings.label, sightings.stop))
    key = sightings.stop[order] * (labels := int(sightings.label.max(initial=0)) + 1) + sightings.label[order]
    begins = np.searchsorted(sightings.stop[order], before), np.searchsorted(sightings.stop[order], before + 1)
    counts = begins[1] - begins[0]
    owner = np.repeat(np.arange(len(before)), counts)
    first = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(begins[0], counts)
    wanted = after[owner] * labels + sightings.label[order[first]]
    low, high = np.searchsorted(key, wanted), np.searchsorted(key, wanted, side="right")
    matches = high - low
    nth = np.arange(int(matches.sum())) - np.repeat(np.cumsum(matches) - matches, matches)
    second = np.repeat(low, matches) + nth
    return order[np.repeat(first, matches)], order[second], np.repeat(owner, matches)


class _RayPairs:
    """Pairs of rays, by the move that leads from the stop of one to that of the other."""

    def __init__(self, sightings: Sightings, first: Ints, second: Ints, owner: Ints, moves: int) -> None:
        self.first, self.second, self.owner = np.ascontiguousarray(first), np.ascontiguousarray(second), owner
        self.begins: Ints = np.searchsorted(owner, np.arange(moves + 1))
        self.origin, self.direction = np.ascontiguousarray(sightings.origin), np.ascontiguousarray(sightings.direction)
        a, b = first, second
        self.rays = (self.origin[a], self.direction[a], self.origin[b], self.direction[b])

    def losses(self, move: Floats) -> Floats:
        """Loss (M,) of how the rays miss each other."""
        count = len(self.begins) - 1
        if kernel is not None:
            loss = np.zeros(count)
            kernel.losses(self.origin, self.direction, self.first, self.second, self.begins, move, _RAY_SIGMA, loss)
            return loss
        miss = _miss(*self.rays, move[self.owner]) / _RAY_SIGMA
        return np.asarray(np.bincount(self.owner, np.log1p(miss**2), count))

    def normal(self, move: Floats) -> tuple[Floats, Floats]:
        """Reweighted normal matrices (M, 3, 3) and gradients (M, 3)."""
        H, g = np.zeros((len(move), 3, 3)), np.zeros((len(move), 3))
        if kernel is not None:
            kernel.slopes(self.origin, self.direction, self.first, self.second, self.begins, move, _RAY_SIGMA, H, g)
            return H, g
        miss = _miss(*self.rays, move[self.owner]) / _RAY_SIGMA
        J = np.empty((len(miss), 3))
        for k in range(3):
            ahead = move.copy()
            ahead[:, k] += 1e-6
            J[:, k] = (_miss(*self.rays, ahead[self.owner]) / _RAY_SIGMA - miss) / 1e-6
        weight = 1.0 / (1.0 + miss**2)
        np.add.at(H, self.owner, weight[:, None, None] * J[:, :, None] * J[:, None])
        np.add.at(g, self.owner, (weight * miss)[:, None] * J)
        return H, g


def _miss(origin_a: Floats, a: Floats, origin_b: Floats, b: Floats, move: Floats) -> Floats:
    """Sampson distance from coplanarity, in radians, of rays in the axes of a move's two stops."""
    R = np.zeros((len(move), 3, 3))
    R[:, :2, :2], R[:, 2, 2] = heading_matrix(move[:, 2]), 1.0
    base = (R @ origin_b[:, :, None])[:, :, 0] - origin_a
    base[:, :2] += move[:, :2]
    turned = (R @ b[:, :, None])[:, :, 0]
    volume = (base * np.cross(a, turned)).sum(axis=1)
    slope = (np.cross(base, a) ** 2).sum(axis=1) + (np.cross(base, turned) ** 2).sum(axis=1)
    return np.asarray(volume / np.sqrt(slope + 1e-6))


def _epipolar_step(rays: _RayPairs, move: Floats, measured: Floats, root: Floats, damping: Floats) -> Floats:
    H, g = rays.normal(move)
    residual = (root @ (move - measured)[:, :, None])[:, :, 0]
    prior_weight = 9.0 / (9.0 + (residual**2).sum(axis=1))
    root_t = root.transpose(0, 2, 1) * prior_weight[:, None, None]
    H += root_t @ root
    g += (root_t @ residual[:, :, None])[:, :, 0]
    diagonal = np.einsum("mii->mi", H)
    diagonal *= 1.0 + damping[:, None]
    return np.asarray(-np.linalg.solve(H, g[:, :, None])[:, :, 0])


def chain(problem: Problem, moves: Floats, segment: Ints) -> Floats:
    """Poses (S, 3) of every stop in the axes of its segment's first stop, by composing moves."""
    poses = np.zeros((len(segment), 3))
    for m, (before, after) in enumerate(zip(problem.moves.before, problem.moves.after, strict=True)):
        if segment[before] == segment[after]:
            poses[after] = se2_compose(poses[before], moves[m])
    return poses


def locate(
    origin: Floats, direction: Floats, target: Floats, label: Ints, tolerance: float = 0.06
) -> tuple[Floats, Bools] | None:
    """Planar pose (3,) of axes in which rays are given, such that they point at known positions.

    For every heading of a grid, pairs of rays to different labels give the position linearly; the pose with the most
    agreement in angle wins and is polished by Gauss-Newton steps on the agreeing rays.

    Parameters
    ----------
    origin, direction : (N, 3) array
        Rays in the axes to be located.
    target : (N, 3) array
        World position of what each ray points at.
    label : (N,) array
        Which label that is.
    tolerance : float
        Angle in radians up to which a ray agrees.

    Returns
    -------
    pose : (3,) array
        x, y, heading in the world.
    agree : (N,) bool array

    None if fewer than two labels agree.
    """
    i, j = np.nonzero(np.triu(label[:, None] != label[None], 1))
    if len(i) == 0:
        return None
    if len(i) > _MOST_PAIRS:
        chosen = np.linspace(0, len(i) - 1, _MOST_PAIRS).astype(np.int64)
        i, j = i[chosen], j[chosen]
    best, lowest = np.zeros(3), np.inf
    for heading in np.arange(-np.pi, np.pi, 0.5 * tolerance):
        R = np.eye(3)
        R[:2, :2] = heading_matrix(heading)
        d, offset = direction @ R.T, target - origin @ R.T
        # the horizontal normal of each ray is perpendicular to what remains of the offset: n . (offset - t) = 0
        normal = np.column_stack([-d[:, 1], d[:, 0]])
        value = (normal * offset[:, :2]).sum(axis=1)
        determinant = normal[i, 0] * normal[j, 1] - normal[i, 1] * normal[j, 0]
        good = np.abs(determinant) > 0.02
        if not good.any():
            continue
        p, q, determinant = i[good], j[good], determinant[good]
        x = (value[p] * normal[q, 1] - value[q] * normal[p, 1]) / determinant
        y = (normal[p, 0] * value[q] - normal[q, 0] * value[p]) / determinant
        toward = offset[None] - np.column_stack([x, y, np.zeros(len(x))])[:, None]
        toward /= np.linalg.norm(toward, axis=2, keepdims=True) + 1e-12
        score = np.minimum(((toward - d) ** 2).sum(axis=2) / tolerance**2, 1.0).sum(axis=1)
        k = int(np.argmin(score))
        if score[k] < lowest:
            best, lowest = np.array([x[k], y[k], heading]), float(score[k])
    pose = _polish(best, origin, direction, target, tolerance)
    agree = (_chords(pose, origin, direction, target) ** 2).sum(axis=1) < tolerance**2
    return (pose, agree) if len(np.unique(label[agree])) >= 2 else None


def _chords(pose: Floats, origin: Floats, direction: Floats, target: Floats) -> Floats:
    T = pose_matrix(*pose)
    toward = target - origin @ T[:3, :3].T - T[:3, 3]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True) + 1e-12
    return np.asarray(toward - direction @ T[:3, :3].T)


def _polish(pose: Floats, origin: Floats, direction: Floats, target: Floats, tolerance: float) -> Floats:
    for _ in range(10):
        chords = _chords(pose, origin, direction, target)
        weight = 1.0 / (1.0 + (chords**2).sum(axis=1) / (0.3 * tolerance) ** 2) ** 2
        J = np.stack([(_chords(pose + 1e-6 * e, origin, direction, target) - chords) / 1e-6 for e in np.eye(3)], axis=2)
        H = np.einsum("n,nri,nrj->ij", weight, J, J) + 1e-9 * np.eye(3)
        pose = pose - np.linalg.solve(H, np.einsum("n,nri,nr->i", weight, J, chords))
    pose[2] = wrap_angle(float(pose[2]))
    return pose
