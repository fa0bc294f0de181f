"""What is known of all unknowns jointly, and how much better it would be known after stops that were not made yet.

The covariance of frame entries and label points follows from the solved survey's normal equations. A stop not yet made
adds five unknowns, its pose, and rows: what its sightings and its move would measure, linearised where they are
expected. Conditioning a Gaussian on rows H with unit noise takes P H' (I + H P H')^-1 H P from P (Mutambara 1998,
chapter 2). No measured value is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg.blas
import scipy.sparse

from ..geometry.transforms import heading_matrix, invert_rigid, pose_matrix, se2_relative, transform_points
from ..records import Floats
from .bundle import SQUARE, Adjustment
from .covariance import inverse
from .problem import CAMERA, ODOMETRY, STOP, Bools, Ints, Known, Moves, Problem, Sightings, State
from .robust import Optimum
from .wheel_errors import arc_by_errors, coupling

_POSE_SIGMA = 10.0  # metres and radians: where a stop would be, before anything there is measured
_NO_MOVES = Moves(
    np.zeros(0, np.int64),
    np.zeros(0, np.int64),
    np.zeros((0, 3)),
    *(np.zeros((0, 3, 3)),) * 3,
    np.zeros(0, np.bool_),
)
_LEAST_LEFT = 1e-9  # of a measurement's variance that nothing else tells: below is rounding
MARGIN_PX = 2.0  # a light nearer to the image's border is not found


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Sightings that stops not yet made would give: `place`, `camera`, `label` (V,) indices; ordered by place.

    `by_place` (V, 2, 5), `by_camera` (V, 2, 10) and `by_point` (V, 2, 3) are the derivatives over the standard
    deviation.
    """

    place: Ints
    camera: Ints
    label: Ints
    by_place: Floats
    by_camera: Floats
    by_point: Floats

    def at(self, place: int) -> Ints:
        """Rows of one place."""
        return np.arange(*np.searchsorted(self.place, [place, place + 1]))


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Whitened linear measurements: `values` (R, E) of the state's entries `entries` (R, E); -1 stands for none."""

    values: Floats
    entries: Ints

    def matrix(self, entries: int) -> Any:
        """H (R, N) of a state of so many entries, sparse."""
        kept = self.entries >= 0
        starts = np.concatenate([[0], np.cumsum(kept.sum(axis=1))])
        return scipy.sparse.csr_matrix((self.values[kept], self.entries[kept], starts), (len(self.values), entries))

    def joined(self, other: Rows) -> Rows:
        """These, then others."""
        count, width = len(self.values) + len(other.values), max(self.values.shape[1], other.values.shape[1])
        values, entries, begin = np.zeros((count, width)), np.full((count, width), -1, dtype=np.int64), 0
        for rows in (self, other):
            here = np.s_[begin : begin + len(rows.values), : rows.values.shape[1]]
            values[here], entries[here] = rows.values, rows.entries
            begin += len(rows.values)
        return Rows(values, entries)


class Belief:
    """Joint covariance of a solved survey, and of stops added to it.

    The state's entries are the free frame entries, three per label in the order of `points`, then five per added stop.

    Parameters
    ----------
    optimum : Optimum
    depth, depth_sigma : float
        Metres from the robot, on its ray, at which a label is believed that only one stop saw.
    guesses : (G, 3) array
        Where labels may be that nobody has seen; they become further labels.
    guess_sigma : float
        Metres.

    Attributes
    ----------
    points : (L + G, 3) array
        The labels, in the problem's order, then the guesses. NaN for those that cannot be placed at all.
    """

    def __init__(self, optimum: Optimum, depth: float, depth_sigma: float, guesses: Floats, guess_sigma: float) -> None:
        problem, state = optimum.problem, optimum.state
        single = _only_rays(optimum)
        sigma = problem.sightings.sigma.copy()
        sigma[optimum.inlier] = optimum.adjustment.sightings.sigma
        sightings = replace(problem.sightings, sigma=sigma).select(np.flatnonzero(optimum.inlier | single))
        sightings = replace(sightings, probability=np.ones(len(sightings)))  # as in the optimum's own adjustment
        rays = problem.sightings.select(single)
        points = state.points.copy()
        known = np.zeros(len(points), dtype=np.bool_)
        known[optimum.adjustment.labels] = known[problem.known.label] = known[rays.label] = True
        origin, direction = _world(problem, state, rays)
        points[rays.label] = origin + depth * direction
        points[~known] = np.nan
        state = replace(state, points=points)
        adjustment = Adjustment(problem, sightings)
        normal = adjustment.normal(adjustment.linearise(state, SQUARE), state, SQUARE)
        rows = np.searchsorted(adjustment.labels, rays.label)
        normal.V[rows] += direction[:, :, None] * direction[:, None, :] / depth_sigma**2
        S, V_inverse, WV = adjustment.eliminate(normal)
        frame, n, labels, total = inverse(S), adjustment.size, len(V_inverse), len(points) + len(guesses)
        self.problem, self.state = problem, state
        self.points: Floats = np.concatenate([points, guesses])
        self._columns = adjustment.columns
        self._first_point = n
        P = np.zeros((n + 3 * total, n + 3 * total))
        P[:n, :n] = frame
        at = (n + 3 * adjustment.labels[:, None] + np.arange(3)).ravel()
        WV = np.asarray(WV.toarray()) if labels else np.zeros((n, 0))
        cross = -frame @ WV
        P[:n, at], P[at, :n] = cross, cross.T
        block = -WV.T @ cross
        for k in range(labels):
            block[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += V_inverse[k]
        P[np.ix_(at, at)] = block
        unseen = problem.known.label[~np.isin(problem.known.label, adjustment.labels)]
        for label in unseen:
            P[range(e := n + 3 * label, e + 3), range(e, e + 3)] = (
                problem.known.sigma[problem.known.label == label][0] ** 2
            )
        first = n + 3 * len(points)
        P[range(first, len(P)), range(first, len(P))] = guess_sigma**2
        self.P = P

    def traces(self, P: Floats) -> Floats:
        """(L,) sum of the variances of each label's coordinates in P."""
        diagonal = np.diagonal(P)[self._first_point : self._first_point + 3 * len(self.points)]
        return np.asarray(diagonal.reshape(-1, 3).sum(axis=1))

    def traces_with(self, rows: Rows, P: Floats) -> Floats:
        """The same of P (N, N) after measuring rows."""
        labels = slice(self._first_point, self._first_point + 3 * len(self.points))
        part = _conditioned(rows, P, labels)
        return np.asarray(self.traces(P) - (part**2).sum(axis=1).reshape(-1, 3).sum(axis=1))

    def told(self, rows: Rows, P: Floats, owner: Ints) -> Told:
        """P, in which rows were measured, to be asked how much less it were without those of one `owner` (R,)."""
        H = rows.matrix(len(P))
        G, labels = H @ P, slice(self._first_point, self._first_point + 3 * len(self.points))
        K = H @ np.ascontiguousarray(G.T)
        owners = {k: np.flatnonzero(owner == k) for k in np.unique(owner).tolist()}
        return Told(self.traces(P), owners, P, labels, G, 0.5 * (K + K.T), [])

    def with_stop(self, P: Floats) -> tuple[Floats, int]:
        """P with room for one more stop, and the first of its five entries."""
        n = len(P)
        wider = np.zeros((n + STOP, n + STOP))
        wider[:n, :n] = P
        tilt = self.problem.survey.priors.tilt_rad
        variances = np.array([_POSE_SIGMA, _POSE_SIGMA, _POSE_SIGMA, tilt, tilt]) ** 2
        wider[range(n, n + STOP), range(n, n + STOP)] = variances
        return wider, n

    def take(self, P: Floats, rows: Rows) -> Floats:
        """P after measuring rows."""
        part = _conditioned(rows, P, slice(0, len(P)))
        return np.asarray(P - part @ part.T)

    def blocks(self, P: Floats) -> Floats:
        """(L, 3, 3) covariances of the labels in P."""
        at = self._first_point + 3 * np.arange(len(self.points))[:, None] + np.arange(3)
        return np.asarray(P[at[:, :, None], at[:, None, :]])

    def sight(self, views: Views, chosen: Ints, weight: Floats, entry: int) -> Rows:
        """Rows of some views (K,) of a stop whose entries begin at `entry`, each counted `weight` (K,)."""
        place = entry + np.arange(STOP)
        base = STOP * self.problem.stop_count
        camera = self._columns[base + CAMERA * views.camera[chosen, None] + np.arange(CAMERA)]
        point = self._first_point + 3 * views.label[chosen, None] + np.arange(3)
        entries = np.concatenate([np.tile(place, (len(chosen), 1)), camera, point], axis=1)
        values = np.concatenate([views.by_place[chosen], views.by_camera[chosen], views.by_point[chosen]], axis=2)
        values = values * np.sqrt(weight)[:, None, None]
        return Rows(values.reshape(-1, values.shape[2]), np.repeat(entries, 2, axis=0))

    def move(self, before: Floats, at: Ints, after: Floats, entry: int, covariance: Floats) -> Rows:
        """Rows of the move from a pose (3,) with entries `at` (3,) to another one whose entries begin at `entry`."""
        measured = se2_relative(before, after)
        R = heading_matrix(before[2]).T
        by_after = np.zeros((3, 3))
        by_after[:2, :2], by_after[2, 2] = R, 1.0
        by_before = -by_after
        by_before[0, 2], by_before[1, 2] = measured[1], -measured[0]
        factor = -arc_by_errors(measured)
        factor[:, 0] += coupling(self.problem.survey.priors) * factor[:, 1]
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        entries = np.concatenate([at, entry + np.arange(3), self._columns[-ODOMETRY:]])
        return Rows(root @ np.concatenate([by_before, by_after, factor], axis=1), np.tile(entries, (3, 1)))

    def stop_entries(self, stop: int) -> Ints:
        """State entries of x, y, heading of a stop of the survey; -1 where held fixed."""
        return np.asarray(self._columns[STOP * stop : STOP * stop + 3])

    def views(self, places: Floats, sigma_px: float, reach: float) -> Views:
        """What the rig would see from places (C, 3) if nothing hid it, of the labels that have a position.

        Parameters
        ----------
        places : (C, 3) array
            x, y, heading in the world.
        sigma_px : float
            Standard deviation of a sighting.
        reach : float
            Metres beyond which lights are not found.
        """
        problem, state = self.problem, self.state
        T = pose_matrix(*places.T) if len(places) else np.zeros((0, 4, 4))
        labels = np.flatnonzero(np.isfinite(self.points[:, 0]))
        found = []
        for c, camera in enumerate(problem.cameras):
            for k in range(len(places)):
                there = transform_points(invert_rigid(T[k] @ camera.T_robot_camera), self.points[labels])
                uv, valid = camera.project(there)
                valid &= camera.in_image(np.where(valid[:, None], uv, -1e6), margin=MARGIN_PX)
                valid &= np.linalg.norm(there, axis=1) < reach
                found.append(np.column_stack([np.full(valid.sum(), k), np.full(valid.sum(), c), labels[valid]]))
        rows = np.concatenate(found) if found else np.zeros((0, 3), dtype=np.int64)
        place, seer, label = rows.T
        count, nothing = len(rows), np.zeros((len(rows), 3))
        tilt = problem.survey.priors.tilt_rad
        there_problem = replace(
            problem,
            sightings=Sightings(
                place,
                seer,
                label,
                np.zeros((count, 2)),
                np.full(count, sigma_px),
                np.ones(count),
                np.arange(count),
                np.arange(count),
                nothing,
                nothing,
            ),
            labels=tuple(map(str, range(len(self.points)))),
            known=Known(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0)),
            moves=_NO_MOVES,
            motions=problem.motions.select(np.zeros(len(problem.motions.after), dtype=np.bool_)),
            roofs=problem.roofs.select(np.zeros(len(problem.roofs.stop), dtype=np.bool_)),
            leg=np.ones(len(places), dtype=np.int64),
            odometry=places,
            prior_sigma=np.concatenate(
                [
                    np.tile([np.inf, np.inf, np.inf, tilt, tilt], len(places)),
                    problem.prior_sigma[STOP * problem.stop_count :],
                ]
            ),
        )
        poses = np.concatenate([places, np.zeros((len(places), 2))], axis=1)
        frame = np.concatenate([poses.ravel(), state.frame[STOP * problem.stop_count :]])
        linear = Adjustment(there_problem, there_problem.sightings).linearise(State(frame, self.points), SQUARE)
        order = np.argsort(place, kind="stable")
        order = order[linear.valid[order]]
        by_place, by_camera = linear.by_frame[order, :, :STOP], linear.by_frame[order, :, STOP:]
        return Views(place[order], seer[order], label[order], by_place, by_camera, linear.by_point[order])


@dataclass(slots=True, eq=False)
class Told:
    """How sure labels are after rows were measured, and how much less without those of one owner.

    Rows h taken back from a covariance P in which they were measured leave P + P h' (I - h P h')^-1 h P.

    Attributes
    ----------
    traces : (L,) array
        Sum of the variances of each label's coordinates.
    owners : dict
        Rows of each owner.
    """

    traces: Floats
    owners: dict[int, Ints]
    _P: Floats
    _labels: slice
    _G: Floats  # (R, N) covariances of the rows with the state
    _K: Floats  # (R, R) of the rows among themselves
    _lost: list[Floats]

    def without(self, owner: int) -> Floats:
        """(L,) traces if an owner's rows had not been measured."""
        part = self._root(owner) @ self._G[self.owners[owner], self._labels]
        return np.asarray(self.traces + (part**2).sum(axis=0).reshape(-1, 3).sum(axis=1))

    def forget(self, owner: int) -> None:
        """Take an owner's rows back."""
        root, mine = self._root(owner), self.owners[owner]
        self.traces = self.without(owner)
        G, K = root @ self._G[mine], root @ self._K[mine]
        self._G += K.T @ G
        self._K += K.T @ K
        self._lost.append(G)

    def known(self) -> Floats:
        """P without what was forgotten."""
        lost = np.concatenate(self._lost) if self._lost else np.zeros((0, len(self._P)))
        return np.asarray(self._P + lost.T @ lost)

    def _root(self, owner: int) -> Floats:
        """A matrix whose transpose times itself is (I - h P h')^-1."""
        mine = self.owners[owner]
        values, vectors = np.linalg.eigh(np.eye(len(mine)) - self._K[np.ix_(mine, mine)])
        return np.asarray(vectors.T / np.sqrt(np.maximum(values, _LEAST_LEFT))[:, None])


def _conditioned(rows: Rows, P: Floats, kept: slice) -> Floats:
    """(K, R) whose product with its transpose is what rows take from the kept part of P."""
    H = rows.matrix(len(P))
    HP = H @ P
    S = H @ np.ascontiguousarray(HP.T)
    S[np.diag_indices(len(S))] += 1.0
    L = np.linalg.cholesky(0.5 * (S + S.T))
    part = np.asfortranarray(HP[:, kept].T)
    return np.asarray(scipy.linalg.blas.dtrsm(1.0, L, part, side=1, lower=1, trans_a=1, overwrite_b=1))


def _only_rays(optimum: Optimum) -> Bools:
    """(N,) one sighting each, the most probable, of the labels that the map has no position for."""
    s = optimum.problem.sightings
    lost = np.ones(len(optimum.problem.labels), dtype=np.bool_)
    lost[optimum.adjustment.labels] = lost[optimum.problem.known.label] = False
    rows = np.flatnonzero(lost[s.label] & ~optimum.reflected & optimum.placed[s.stop])
    rows = rows[np.lexsort([-s.probability[rows], s.label[rows]])]
    result = np.zeros(len(s), dtype=np.bool_)
    result[rows[np.unique(s.label[rows], return_index=True)[1]]] = True
    return result


def _world(problem: Problem, state: State, rays: Sightings) -> tuple[Floats, Floats]:
    """Origins and unit directions (K, 3) of rays in the world."""
    T = pose_matrix(*problem.stop_entries(state)[rays.stop].T).reshape(-1, 4, 4)
    origin = (T[:, :3, :3] @ rays.origin[:, :, None])[:, :, 0] + T[:, :3, 3]
    return origin, (T[:, :3, :3] @ rays.direction[:, :, None])[:, :, 0]
