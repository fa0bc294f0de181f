"""A map that grows with every stop (thesis section 3.4), and that is the map which all stops at once would give.

What a new stop changes most is near it: its pose is found first, against labels that the other stops hold, then the
labels which it shows for the first or second time. One or two steps of the whole adjustment from there reach the
optimum, because everything else is nearly there. Where that is not so (a new leg, a reference that may fix the world
frame only now, a stop that the map does not explain) the whole survey is solved anew.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TypeVar

import numpy as np

from ..errors import InputError
from ..geometry.transforms import se2_compose, wrap_angle
from ..records import Floats, Map, Pose, Stop, Survey, Vector3
from ..typed_json import many_records
from .bundle import SQUARE, Adjustment, Loss
from .mapping import to_map
from .placement import Placement, ray_tolerance, retriangulate
from .problem import STOP, Bools, Motions, Moves, Problem, Roofs, Sightings, State, build_problem
from .robust import Optimum, optimise
from .weights import OUTLIER

Arrays = TypeVar("Arrays", Moves, Motions, Roofs)

_NEAR = (Loss("cauchy", 2.5, width=2.0), Loss("geman-mcclure", 0.4))
_WHOLE = Loss("geman-mcclure")
_SETTLED = 1.0  # decrease of the cost that may be left to the next stop
_EXPLAINED = 0.5  # share of a stop's sightings below which the whole survey is solved anew
_FIRST = 3  # stops from which a map grows


class GrowingMap:
    """The map of a survey whose stops come one by one.

    Parameters
    ----------
    survey : Survey
        Its header, and the stops made so far, if any.

    Attributes
    ----------
    survey : Survey
        With all stops taken so far.

    Raises
    ------
    InputError
        If the survey contradicts itself.
    """

    def __init__(self, survey: Survey) -> None:
        self.survey = survey
        self._problem: Problem | None = None
        self._latest: tuple[Problem, Optimum] | None = None
        self._state = State(np.zeros(0), np.zeros((0, 3)))
        self._number: dict[str, int] = {}
        self._found: Bools = np.zeros(0, dtype=np.bool_)
        self._solve()

    def add_stop(self, stop: Stop) -> None:
        """Take a stop into the map.

        Raises
        ------
        InputError
            If the survey has this stop already, or the two contradict each other; the map is then as before.
        """
        stops, where = self.survey.stops, f"survey {self.survey.survey}: leg {stop.leg} stop {stop.stop}"
        if any((other.leg, other.stop) == (stop.leg, stop.stop) for other in stops):
            raise InputError(f"{where} is there already; send every stop once")
        with many_records():
            alone = build_problem(replace(self.survey, stops=(*stops[-1:], stop)))
            self.survey = replace(self.survey, stops=(*stops, stop))
            follows = bool(stops) and stops[-1].leg == stop.leg and stops[-1].stop < stop.stop
            if self._problem is None or not follows or self._may_fix_frame(alone):
                self._solve()
                return
            self._latest = None
            self._append(alone)
            self._settle()

    def poses(self) -> dict[tuple[int, int], Pose]:
        """Where the robot stood at each stop, by leg and stop; none until the stops can be joined to one path."""
        if self._problem is None:
            return {}
        poses = self._problem.stop_entries(self._state)[:, :3].tolist()
        return {
            (stop.leg, stop.stop): Pose(x, y, float(wrap_angle(heading)))
            for stop, (x, y, heading) in zip(self.survey.stops, poses, strict=True)
        }

    def positions(self) -> dict[str, Vector3]:
        """Where the labels seem to be that two or more stops saw; only `map` says which of them can be trusted."""
        if self._problem is None:
            return {}
        points, found = self._state.points.tolist(), self._found.tolist()
        return {label: (points[k][0], points[k][1], points[k][2]) for label, k in self._number.items() if found[k]}

    def map(self) -> Map:
        """The map so far, the same as `solve` makes of these stops; raises SolverError if there are none."""
        with many_records():
            if self._latest is None:
                problem = build_problem(self.survey)
                self._take(problem, optimise(problem, grown=self._grown(problem)))
            assert self._latest is not None
            return to_map(*self._latest)

    def _grown(self, problem: Problem) -> Placement | None:
        """This state as a start of another problem of the same survey."""
        if self._problem is None or self._problem.frame != problem.frame:
            return None
        order = np.array([self._number[label] for label in problem.labels], dtype=np.int64)
        state = State(self._state.frame.copy(), self._state.points[order])
        return Placement(state, np.ones(problem.stop_count, dtype=np.bool_), self._found[order])

    def _solve(self) -> None:
        """Everything anew."""
        self._problem, self._latest = None, None
        if len(self.survey.stops) >= _FIRST:
            problem = build_problem(self.survey)
            self._take(problem, optimise(problem))

    def _take(self, problem: Problem, optimum: Optimum) -> None:
        """Grow from an optimum, unless some stop has no place in it or the stops are out of order."""
        self._latest = problem, optimum
        in_order = problem.survey.stops == self.survey.stops
        if not (optimum.placed.all() and in_order and optimum.problem.frame == problem.frame):
            self._problem = None
            return
        # what the optimum loosened or dropped as wrong stays in: robust losses keep it from doing harm until `map`
        self._problem = replace(problem, sightings=_rescaled(problem.sightings, optimum))
        self._state = optimum.state
        self._number = {label: k for k, label in enumerate(problem.labels)}
        self._found = np.zeros(len(problem.labels), dtype=np.bool_)
        self._found[optimum.adjustment.labels] = True

    def _may_fix_frame(self, alone: Problem) -> bool:
        """Whether a reference outside the survey may fix the world frame with this stop, and did not before."""
        assert self._problem is not None
        return self._problem.frame == "first stop" and bool(self.survey.known_labels or len(alone.roofs.stop))

    def _append(self, alone: Problem) -> None:
        """Add the second stop of a problem of two to the arrays; its pose follows from its move."""
        problem, state = self._problem, self._state
        assert problem is not None
        count, old = problem.stop_count, problem.sightings
        for label in alone.labels:
            self._number.setdefault(label, len(self._number))
        number = np.array([self._number[label] for label in alone.labels], dtype=np.int64)
        new = alone.sightings.select(alone.sightings.stop == 1)
        new = replace(
            new,
            stop=np.full(len(new), count),
            label=number[new.label],
            rival=new.rival + int(old.rival.max(initial=-1)) + 1,
            source=new.source + int(old.source.max(initial=-1)) + 1,
        )
        roofs, motions = alone.roofs.select(alone.roofs.stop == 1), alone.motions
        reached = np.full(len(motions.after), count)
        here = se2_compose(problem.stop_entries(state)[-1, :3], alone.moves.measured[0])
        missing = len(self._number) - len(state.points)
        self._state = State(
            np.insert(state.frame, STOP * count, [*here, 0.0, 0.0]),
            np.concatenate([state.points, np.zeros((missing, 3))]),
        )
        self._found = np.append(self._found, np.zeros(missing, dtype=np.bool_))
        self._problem = replace(
            problem,
            labels=tuple(self._number),
            sightings=_merged(old, new),
            moves=_joined(problem.moves, replace(alone.moves, before=np.array([count - 1]), after=np.array([count]))),
            motions=_joined(problem.motions, replace(motions, before=reached - 1, after=reached)),
            roofs=_joined(problem.roofs, replace(roofs, stop=np.full(len(roofs.stop), count))),
            leg=np.append(problem.leg, alone.leg[1]),
            odometry=np.concatenate([problem.odometry, alone.odometry[1:]]),
            prior_sigma=np.insert(problem.prior_sigma, STOP * count, alone.prior_sigma[STOP : 2 * STOP]),
        )

    def _settle(self) -> None:
        """Find the pose of the last stop, then its labels, then let the whole map follow."""
        problem, state = self._problem, self._state
        assert problem is not None
        near = _around_last(problem)
        everywhere = np.ones(problem.stop_count, dtype=np.bool_)
        for loss in _NEAR:
            known = near.sightings.select(self._found[near.sightings.label])
            state = Adjustment(near, known).solve(state, loss, iterations=10, tolerance=1e-2).state
            doubtful = np.unique(near.sightings.label[~_explained(near, state)])
            again = doubtful[~np.isin(doubtful, problem.known.label)]
            state, found = retriangulate(near, state, ray_tolerance(near), everywhere, again)
            self._found[again] |= found[again]
        state = Adjustment(near, near.sightings.select(self._found[near.sightings.label])).solve(state, _WHOLE, 5).state
        # sightings of labels that are nowhere yet weigh nothing: to leave them out would copy all others
        weight: Floats = self._found[problem.sightings.label].astype(np.float64)
        seen = replace(problem.sightings, probability=problem.sightings.probability * weight)
        self._state = Adjustment(problem, seen).solve(state, _WHOLE, 3, _SETTLED, 1e-6).state
        mine = near.sightings.stop == problem.stop_count - 1
        if mine.any() and _explained(near, self._state)[mine].mean() < _EXPLAINED:
            self._solve()


def _rescaled(sightings: Sightings, optimum: Optimum) -> Sightings:
    """The sightings with standard deviations as the optimum found them to be."""
    if len(sightings) == 0:
        return sightings
    factor = float(np.median(optimum.problem.sightings.sigma) / np.median(sightings.sigma))
    return replace(sightings, sigma=sightings.sigma * factor)


def _around_last(problem: Problem) -> Problem:
    """Only the last stop and the labels that it saw are free; all stops that saw these take part."""
    last = problem.stop_count - 1
    prior = np.zeros_like(problem.prior_sigma)
    entries = slice(STOP * last, STOP * (last + 1))
    prior[entries] = problem.prior_sigma[entries]
    s = problem.sightings
    mine = np.zeros(len(problem.labels), dtype=np.bool_)
    mine[s.label[s.stop == last]] = True
    return replace(
        problem,
        prior_sigma=prior,
        sightings=s.select(mine[s.label]),
        moves=problem.moves.select(problem.moves.after == last),
        motions=problem.motions.select(problem.motions.after == last),
        roofs=problem.roofs.select(problem.roofs.stop == last),
    )


def _explained(problem: Problem, state: State) -> Bools:
    """(N,) which sightings fit."""
    found = Adjustment(problem, problem.sightings).residuals(state, SQUARE)
    return np.asarray(found.valid & ((found.residual**2).sum(axis=1) < OUTLIER))


def _merged(old: Sightings, new: Sightings) -> Sightings:
    """Both, ordered by camera as sightings are."""
    cameras = np.arange(1 + max(int(old.camera.max(initial=0)), int(new.camera.max(initial=0))))
    before: list[int] = np.searchsorted(old.camera, cameras).tolist()[1:]
    begins: list[int] = np.searchsorted(new.camera, cameras).tolist()[1:]

    def merged(name: str) -> Floats:
        pairs = zip(np.split(getattr(old, name), before), np.split(getattr(new, name), begins), strict=True)
        return np.concatenate([part for pair in pairs for part in pair])

    return Sightings(*(merged(f.name) for f in fields(old)))  # type: ignore[arg-type]


def _joined(old: Arrays, new: Arrays) -> Arrays:
    return type(old)(*(np.concatenate([getattr(old, f.name), getattr(new, f.name)]) for f in fields(old)))
