"""What planning starts from: labels known and assumed, where they show, and how much is doubtful.

Where the way leads past floor that no stop has looked at yet, labels are assumed at the distance and height of those
seen so far. Whether a known label shows at a place depends on the directions in which stops saw it or did not.
"""

from __future__ import annotations

import numpy as np

from ..errors import SolverError
from ..geometry.transforms import wrap_angle
from ..records import Floats, Map
from .belief import Belief, Views
from .problem import Bools
from .robust import Optimum
from .ways import Way

GUESSES_M = 1.0  # between assumed labels along the way
_LEAST_WRONG, _MOST_WRONG = 0.005, 0.2  # share of sightings
_SHOWS = 0.9  # probability that a label is seen which nothing is known to hide
_LOOKED = 0.5  # weight of assumed labels where stops looked and found none: walls and shelves hide what is behind them
_NEAR = 1.25  # times the labels' usual distance, within which nothing hides them
_AHEAD = 2.0  # times as many labels are assumed along the way as were found so far, because stops saw its sides in part
_SIMILAR = np.radians(15.0)  # directions that differ by less are probably hidden by the same things
_FIELD = np.radians(72.0)  # to either side of its normal in which a label's light shows
_REACH = 1.1  # times the distance within which 95 % of the sightings lie
_NEGLIGIBLE = 0.05  # labels that one may stand for
_WHEELS = np.array([3e-5, 3e-5, 4e-4])  # m^2, m^2, rad^2 per metre, of a survey without moves


def distances(optimum: Optimum) -> tuple[float, float]:
    """Metres within which lights are found, and the labels' usual distance; raises SolverError if there is no label."""
    problem, s = optimum.problem, optimum.problem.sightings.select(np.flatnonzero(optimum.inlier))
    if len(s) == 0:
        raise SolverError(
            f"survey {problem.survey.survey}: no label has a position yet; make two stops along the line first"
        )
    poses = problem.stop_entries(optimum.state)[:, :2]
    away = np.hypot(*(poses[s.stop] - optimum.state.points[s.label, :2]).T)
    return _REACH * float(np.quantile(away, 0.95)) + 0.05, float(np.median(away))


class Outlook:
    """A solved survey and where its robot could stop next.

    Parameters
    ----------
    optimum : Optimum
        Of the survey, or of a part of it.
    result : Map
        Of the whole survey.
    way : Way

    Attributes
    ----------
    reach, depth : float
        Metres within which lights are found, and the labels' usual distance.
    stops : (S, 2) array
        Where the robot stood.
    belief : Belief
    views : Views
        Of the labels, from the way's places.
    weights, agreeing : (L,) arrays
        How many labels each stands for, and how many stops agree on its position.
    chance : (V,) array
        Probability that each view shows its label.
    rates : (3,) array
        Variance that a move gains per metre.
    doubt : float
        Share of sightings that are wrong.

    Raises
    ------
    SolverError
        If there is nothing to plan from.
    """

    def __init__(self, optimum: Optimum, result: Map, way: Way) -> None:
        self.optimum, self.map, self.way = optimum, result, way
        problem = optimum.problem
        poses = problem.stop_entries(optimum.state)[:, :3]
        self.reach, self.depth = distances(optimum)
        self.stops, depth = poses[:, :2], self.depth
        guesses, weights, facing = self._guesses(poses, depth)
        self.belief = Belief(optimum, depth, 0.5 * depth, guesses, max(depth, 0.5))
        sigma = float(np.median(problem.sightings.sigma))
        self._directions(poses, facing)
        past = self.belief.views(poses, sigma, self.reach)
        self.weights, self.agreeing = self._judged(poses, weights, past)
        self.belief.points[self.weights == 0.0] = np.nan
        self.views = self.belief.views(self.way.places, sigma, self.reach)
        self.chance = self._chances(poses, past)
        self.rates = self._wheels()
        self.doubt = self._wrong()

    def _guesses(self, poses: Floats, depth: float) -> tuple[Floats, Floats, Floats]:
        """Where labels may be that no stop has seen: positions (G, 3), how many each stands for, directions (G, 2)."""
        points = self.optimum.state.points[self.optimum.adjustment.labels]
        ahead, normals = self.way.floor, self.way.sides
        passed = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        weight = 0.5 * _AHEAD * GUESSES_M * len(points) / (passed + 2.0 * depth)
        where = np.concatenate([ahead + depth * normals, ahead - depth * normals])
        facing = np.concatenate([-normals, normals])
        height = float(np.median(points[:, 2]))
        guesses = np.column_stack([where, np.full(len(where), height)])
        return guesses, np.full(len(guesses), weight), facing

    def _directions(self, poses: Floats, facing: Floats) -> None:
        """Unit directions (L, 2) on the plan in which labels seem to look."""
        s = self.optimum.problem.sightings
        s = s.select(~self.optimum.reflected)
        points = self.belief.points
        away = poses[s.stop, :2] - points[s.label, :2]
        away /= np.maximum(np.hypot(*away.T), 1e-9)[:, None]
        total = np.zeros((len(points), 2))
        np.add.at(total, s.label[np.isfinite(away[:, 0])], away[np.isfinite(away[:, 0])])
        total[len(points) - len(facing) :] = facing
        self.facing = total / np.maximum(np.hypot(*total.T), 1e-9)[:, None]
        turn = _turned(self.facing[s.label], away)
        first, last = np.full(len(points), np.inf), np.full(len(points), -np.inf)
        np.minimum.at(first, s.label, turn)
        np.maximum.at(last, s.label, turn)
        first[len(points) - len(facing) :], last[len(points) - len(facing) :] = -_FIELD, _FIELD
        self.seen_from = np.column_stack([first, last])

    def _shows(self, views: Views, places: Floats) -> Floats:
        """(V,) probability that a place is on the side to which a label looks.

        It shows within `_FIELD` to either side of its normal. Of the normal this is known, that all places from which
        the label was seen lie within that; and it is rather turned away from them, because a robot that comes along a
        shelf sees a label from the edge of its field first. So its density grows linearly from that edge.
        """
        away = places[views.place, :2] - self.belief.points[views.label, :2]
        turn = _turned(self.facing[views.label], away)
        first, last = self.seen_from[views.label].T
        beyond = np.maximum(np.maximum(first - turn, turn - last), 0.0)
        left = np.maximum(2.0 * _FIELD - (last - first), _FIELD / 10.0)
        return np.asarray(np.maximum(1.0 - (beyond / left) ** 2, 0.0))

    def _judged(self, poses: Floats, guessed: Floats, past: Views) -> tuple[Floats, Floats]:
        """How many labels each stands for, and how many stops agree on its position (L,)."""
        optimum = self.optimum
        problem = optimum.problem
        s = problem.sightings.select(np.flatnonzero(optimum.inlier))
        pairs = np.unique(s.stop * len(problem.labels) + s.label)
        agreeing = np.bincount(pairs % len(problem.labels), minlength=len(problem.labels)).astype(np.float64)
        status = {label.label: label.status for label in self.map.labels}
        sure = np.array([status.get(label) in ("placed", "known") for label in problem.labels], dtype=np.bool_)
        agreeing[~sure] = np.minimum(agreeing[~sure], 1.0)
        agreeing[problem.known.label] = 10.0
        there = np.isfinite(self.belief.points[:, 0])
        looked = np.bincount(past.label, minlength=len(there))[len(problem.labels) :]
        apart = np.hypot(*(poses[past.place, :2] - self.belief.points[past.label, :2]).T)
        near = np.bincount(past.label[apart < _NEAR * self.depth], minlength=len(there))[len(problem.labels) :]
        missed = np.where(looked > 0, _LOOKED, 1.0) * (1.0 - _SHOWS) ** near
        weights = np.concatenate([np.ones(len(problem.labels)), guessed * missed])
        weights[weights < _NEGLIGIBLE] = 0.0
        return weights * there, np.concatenate([agreeing, np.zeros(len(guessed))])

    def _chances(self, poses: Floats, past: Views) -> Floats:
        """(V,) probability that each view shows its label, as far as earlier stops in like directions saw it."""
        problem, s = self.optimum.problem, self.optimum.problem.sightings
        seen = np.zeros((problem.stop_count, len(self.belief.points)), dtype=np.bool_)
        seen[s.stop, s.label] = True
        expected = np.zeros_like(seen)
        expected[past.place, past.label] = True
        expected |= seen
        points = self.belief.points[:, :2]
        with np.errstate(invalid="ignore"):
            bearing = np.arctan2(*(poses[:, None, :2] - points).transpose(2, 0, 1)[::-1])
            here = np.arctan2(*(self.way.places[self.views.place, :2] - points[self.views.label]).T[::-1])
            like = np.exp(-((wrap_angle(bearing[:, self.views.label] - here) / _SIMILAR) ** 2))
        told = np.where(seen, 1.0, self._asked(seen, poses, past)[:, None])
        like = np.where(expected[:, self.views.label], like * told[:, self.views.label], 0.0)
        likely = _SHOWS * self._shows(self.views, self.way.places)
        hits = (like * seen[:, self.views.label]).sum(axis=0)
        exists = np.minimum(self.weights, 1.0)[self.views.label]
        return np.asarray(exists * (likely + _SHOWS * hits) / (1.0 + like.sum(axis=0)))

    def _asked(self, seen: Bools, poses: Floats, past: Views) -> Floats:
        """(S,) how much it says at each stop that a label was not seen, 1 where all were asked.

        A survey does not tell which labels a stop asked, and one that followed a plan asked few. So the share of those
        that should have shown which did is taken for the share that was asked.
        """
        count = len(self.optimum.problem.labels)
        likely = np.where(seen, _SHOWS, 0.0)
        np.maximum.at(likely, (past.place, past.label), _SHOWS * self._shows(past, poses))
        share = seen[:, :count].sum(axis=1) / np.maximum(likely[:, :count].sum(axis=1), 1.0)
        return np.asarray(np.log(1.0 - _SHOWS * np.minimum(share, 1.0)) / np.log(1.0 - _SHOWS))

    def _wheels(self) -> Floats:
        """(3,) variance that a move gains per metre."""
        moves = self.optimum.problem.moves
        driven = float(np.hypot(*moves.measured[:, :2].T).sum()) if len(moves.measured) else 0.0
        if driven < 0.1:
            return _WHEELS
        return np.asarray(np.diagonal(moves.covariance, axis1=1, axis2=2).sum(axis=0) / driven)

    def _wrong(self) -> float:
        """Share of sightings that are wrong."""
        optimum = self.optimum
        s = optimum.problem.sightings
        counted = np.isin(s.label, optimum.adjustment.labels) & ~optimum.reflected
        wrong = (np.count_nonzero(counted & ~optimum.inlier) + 0.5) / (np.count_nonzero(counted) + 1.0)
        return float(np.clip(wrong, _LEAST_WRONG, _MOST_WRONG))


def _turned(directions: Floats, vectors: Floats) -> Floats:
    """(K,) angles from unit directions (K, 2) to vectors (K, 2), counter-clockwise."""
    (a, b), (x, y) = directions.T, vectors.T
    return np.asarray(np.arctan2(a * y - b * x, a * x + b * y))
