"""Where to stop next, and which labels to ask there: what a stop would teach, against what it costs.

The thesis steers by viewing angles (section 5.1; `viewing_angles.py`). Here a stop is worth what it takes off the
labels' uncertainty, computed by `belief.py` before the stop is made: angles, distances, the pose's and the rig's own
uncertainty all enter as they do when the survey is solved. Places are taken greedily, by what they teach per second;
then labels are taken off each stop whose flashes together would add next to nothing (thesis section 8.2.2).

A label counts with its standard deviation and with the risk of being wrong: a position on which k stops agree is wrong
with a probability that falls with k as the share of wrong sightings does.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np

from ..plan_records import Plan, PlannedFlash, PlannedLabel, PlannedStop
from ..records import Floats, Map, Pose, Survey
from ..typed_json import many_records
from .belief import Rows, Told
from .mapping import WIDEST_SIGMA_M, to_map
from .neighbourhood import nearby
from .outlook import GUESSES_M, Outlook, distances
from .problem import Ints, build_problem
from .robust import Optimum, optimise
from .ways import Way, along_line, over_floor
from .wheel_errors import SLIPPED

_WRONG_M = 0.5  # error of a position that is wrong
_APART = 0.35  # of the labels' usual distance lies between two stops: nearer ones see them from almost the same side
_LONGEST = 0.75  # of it may: what walls hide from both, as behind a doorway, hangs on nothing but one stop between them
_AHEAD = 0.4  # of the reach is looked ahead for each stop that is planned
_LEAST_AHEAD = 1.5  # times the reach is looked ahead however few they are
_AT_ONCE = 600  # rows of flashes are judged together, which takes time as their square
_JOINING = 6  # labels are asked at each stop, where so many show: one wrong name must not turn the robot's pose
_SLIP_EVERY_M = 20.0  # a wheel slips, and then a move says little
_FLOOR = np.diag([1e-4, 1e-4, 1e-4]) ** 2


@dataclass(frozen=True, slots=True)
class PlanSettings:
    """What a plan is to weigh.

    `stop_s` and `flash_s` are the seconds that a stop and a label asked there take. A stop is worth making if the
    labels are by the fraction `least` more uncertain without it. A label is worth asking there if without it all labels
    together are more uncertain by the fraction `spare` of what one of them is. A plan ends earlier after
    `most_stops`, or when every label is known to `target_m`.
    """

    most_stops: int = 30
    stop_s: float = 15.0
    flash_s: float = 0.5
    target_m: float = 0.0
    least: float = 0.004
    spare: float = 0.0045


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """A plan and what it was made from: `places` (C, 3) with the fraction `gains` (C,) of the labels' uncertainty that
    a stop at each would take away as matters stand; `ellipses` of the labels before and after are in `before` and
    `after` (L, 3, 3)."""

    plan: Plan
    map: Map
    places: Floats
    gains: Floats
    positions: Floats
    before: Floats
    after: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Choice:
    """A place taken into the plan: its entries in the state begin at `entry`, `link` is the move to it, `asked` are
    the rows of its views."""

    place: int
    entry: int
    link: Rows
    asked: Ints


def plan(
    survey: Survey,
    line: Floats | None = None,
    *,
    free: bool = False,
    again: bool = False,
    settings: PlanSettings | None = None,
) -> Study:
    """Plan the next stops of a survey.

    Parameters
    ----------
    survey : Survey
        The stops so far.
    line : (N, 2) array, optional
        The line on the floor in world metres, in the order driven. Without it the robot goes from stop to stop once
        more, in a new leg.
    free : bool
        Over free floor instead of along a line.
    again : bool
        All of the line once more, in a new leg, instead of what is ahead of the last stop.
    settings : PlanSettings

    Raises
    ------
    InputError
        If the survey contradicts itself.
    SolverError
        If there is nothing to plan from, or too much within reach.
    """
    with many_records():
        problem = build_problem(survey)
        optimum = optimise(problem)
        result, (reach, _) = to_map(problem, optimum), distances(optimum)
        way = _way(optimum, line, free, again)
        settings = settings or PlanSettings()
        horizon = max(settings.most_stops * _AHEAD, _LEAST_AHEAD) * reach
        near, way, note = nearby(optimum, result, way, horizon, reach)
        return _Planner(Outlook(near, result, way), settings, () if note is None else (note,)).study()


def _way(optimum: Optimum, line: Floats | None, free: bool, again: bool) -> Way:
    """Where the robot can go, in the map's axes."""
    problem = optimum.problem
    poses = problem.stop_entries(optimum.state)[:, :3]
    newest = poses[problem.leg == problem.leg[-1]]
    if free:
        return over_floor(newest, optimum.state.points[optimum.adjustment.labels, :2])
    if line is None:
        return along_line(poses[:, :2], newest, poses[0], True, GUESSES_M)
    return along_line(line, newest, poses[0], again, GUESSES_M)


class _Planner:
    def __init__(self, outlook: Outlook, settings: PlanSettings, notes: tuple[str, ...]) -> None:
        self.outlook, self.settings, self.notes = outlook, settings, notes
        self.optimum, self.belief, self.way = outlook.optimum, outlook.belief, outlook.way
        self.views, self.chance, self.weights = outlook.views, outlook.chance, outlook.weights
        self.places = self.way.places

    # ---- what a stop is worth ------------------------------------------------------------------------------------

    def _losses(self, traces: Floats, agreeing: Floats) -> Floats:
        """(L,) what is uncertain about each label, in metres."""
        sigma = np.sqrt(np.maximum(traces, 0.0))
        excess = np.where(sigma > self.settings.target_m, sigma, 0.0)
        return np.asarray(self.weights * (excess + _WRONG_M * self.outlook.doubt ** np.maximum(agreeing - 1.0, 0.0)))

    def _agreeing_with(self, agreeing: Floats, rows: Ints) -> Floats:
        """How many stops agree when the labels of some views of one stop are seen from it, too."""
        chance = np.zeros(len(agreeing))
        np.maximum.at(chance, self.views.label[rows], self.chance[rows])
        return agreeing + chance

    def _link(self, place: int, chosen: Sequence[_Choice], entry: int) -> Rows:
        """The move that leads to a place, from the nearest stop before it; nothing, if it begins a leg."""
        belief, at = self.belief, self.way.along
        before: list[tuple[float, Floats, Ints]] = []
        if self.way.here is not None:
            last = self.optimum.problem.stop_count - 1
            pose = self.optimum.problem.stop_entries(self.optimum.state)[last, :3]
            before.append((self._apart(self.way.here, pose, place), pose, belief.stop_entries(last)))
        for other in chosen:
            if not at[other.place] > at[place]:
                pose = self.places[other.place]
                before.append((self._apart(at[other.place], pose, place), pose, other.entry + np.arange(3)))
        if not before:
            return Rows(np.zeros((0, 1)), np.zeros((0, 1), dtype=np.int64))
        metres, pose, entries = min(before, key=lambda item: item[0])
        covariance = np.diag(self.outlook.rates * metres) + SLIPPED * min(metres / _SLIP_EVERY_M, 1.0) + _FLOOR
        return belief.move(pose, entries, self.places[place], entry, covariance)

    def _apart(self, along: float, pose: Floats, place: int) -> float:
        """Metres to drive to a place."""
        x, y, _ = (self.places[place] - pose).tolist()
        further = float(self.way.along[place]) - along  # NaN over free floor
        return max(math.hypot(x, y), further)

    def _total(self, P: Floats, agreeing: Floats) -> float:
        return float(self._losses(self.belief.traces(P), agreeing).sum())

    def _worth(self, choice: _Choice, P: Floats, agreeing: Floats) -> tuple[float, Floats]:
        """The losses' sum with one more stop, and how many stops agree then; P has room for it."""
        counted = self._agreeing_with(agreeing, choice.asked)
        return float(self._losses(self.belief.traces_with(self._rows(choice), P), counted).sum()), counted

    def _seconds(self, asked: Ints) -> float:
        labels = np.unique(self.views.label[asked])
        return self.settings.stop_s + self.settings.flash_s * float(np.minimum(self.weights[labels], 1.0).sum())

    # ---- the choice ----------------------------------------------------------------------------------------------

    def study(self) -> Study:
        """Choose stops, give back those that others made needless, then leave out labels."""
        first = self.belief.P
        chosen, gains = self._grown()
        chosen = self._order(self._lean(chosen, first))
        chosen = self._sparing(chosen, first)
        return self._told(chosen, first, gains)

    def _margin(self, losses: Floats, fraction: float) -> float:
        """A fraction of what is uncertain about the labels that can be placed."""
        return float(fraction * losses[losses < WIDEST_SIGMA_M * self.weights].sum())

    def _grown(self) -> tuple[list[_Choice], Floats]:
        """Take the place that teaches most per second, again and again; and what each place teaches by itself."""
        belief, settings, agreeing = self.belief, self.settings, self.outlook.agreeing
        P, chosen, gains = belief.P, list[_Choice](), np.zeros(len(self.places))
        now = first = self._total(P, agreeing)
        bound = np.full(len(self.places), np.inf)  # of what a place can be worth per second: that of an earlier round
        while len(chosen) < settings.most_stops and not self._is_done(P, agreeing):
            room, entry = belief.with_stop(P)
            best: tuple[float, _Choice, float, Floats] | None = None
            for place in np.argsort(-bound, kind="stable").tolist():
                if best is not None and bound[place] <= best[0]:
                    break
                if self._is_near(place, chosen):
                    bound[place] = -np.inf
                    continue
                choice = _Choice(place, entry, self._link(place, chosen, entry), self.views.at(place))
                left, agreeing_ = self._worth(choice, room, agreeing)
                if not chosen:
                    gains[place] = max(1.0 - left / first, 0.0)
                bound[place] = (now - left) / self._seconds(choice.asked)
                if best is None or bound[place] > best[0]:
                    best = (float(bound[place]), choice, left, agreeing_)
            if best is None:
                break
            margin = self._margin(self._losses(belief.traces_with(self._rows(best[1]), room), best[3]), settings.least)
            if now - best[2] < margin:
                break
            _, choice, now, agreeing = best
            P = belief.take(room, self._rows(choice))
            chosen.append(choice)
        return self._bridged(chosen)[: settings.most_stops], gains

    def _bridged(self, chosen: list[_Choice]) -> list[_Choice]:
        """With further stops where two would lie too far apart to share labels."""
        chosen, along = self._order(chosen), self.way.along
        if not len(chosen) or not np.isfinite(along).all():
            return chosen
        result: list[_Choice] = []
        at = self.way.here if self.way.here is not None else float(along[chosen[0].place])
        for choice in chosen:
            pieces = math.ceil(max(float(along[choice.place]) - at, 0.0) / (_LONGEST * self.outlook.depth) - 1e-9)
            for k in range(1, pieces):
                place = int(np.abs(along - (at + k * (float(along[choice.place]) - at) / pieces)).argmin())
                result.append(replace(choice, place=place, asked=self.views.at(place)))
            result.append(choice)
            at = float(along[choice.place])
        return result

    def _lean(self, chosen: list[_Choice], first: Floats) -> list[_Choice]:
        """Without stops that the others do not need."""
        while True:
            P, agreeing, done, left = first, self.outlook.agreeing, list[_Choice](), list[tuple[float, int]]()
            for k, choice in enumerate(chosen):
                if self._may_go(k, chosen):
                    left.append((self._total(*self._with(chosen[k + 1 :], P, agreeing, done)[:2]), k))
                P, agreeing, done = self._with([choice], P, agreeing, done)
            losses = self._losses(self.belief.traces(P), agreeing)
            if not left or min(left)[0] > losses.sum() + self._margin(losses, self.settings.least):
                return chosen
            _, gone = min(left)
            chosen = [*chosen[:gone], *chosen[gone + 1 :]]

    def _may_go(self, k: int, chosen: Sequence[_Choice]) -> bool:
        """Whether its neighbours along the line are near enough to be joined without it."""
        at = self.way.along[[choice.place for choice in chosen]]
        if not np.isfinite(at).all() or k == len(chosen) - 1:
            return True
        before = at[k - 1] if k else at[0] if self.way.here is None else self.way.here
        return bool(at[k + 1] - before <= _LONGEST * self.outlook.depth)

    def _sparing(self, chosen: list[_Choice], P: Floats) -> list[_Choice]:
        """Without labels that add next to nothing, the least useful flash of the whole plan first.

        Flashes are judged by what is known at the plan's end, because what is uncertain about a pose in a doorway is
        handed on to all behind it, and what a stop leaves out of a label others may make good. Each must be worth the
        same, at whichever stop: so a plan that is made anew at the next stop leaves out the same ones.
        """
        count = len(self.optimum.problem.labels)
        P, agreeing, done = self._with(chosen, P, self.outlook.agreeing.copy())
        left_out, rows, owners = set[int](), list[Rows](), list[Ints]()
        for k, choice in enumerate(done):
            named = choice.asked[self.views.label[choice.asked] < count]
            rows.append(self.belief.sight(self.views, named, self.chance[named], choice.entry))
            owners.append(np.repeat(k * count + self.views.label[named], 2))
            if sum(map(len, owners)) >= _AT_ONCE or k == len(done) - 1:
                told = self.belief.told(reduce(Rows.joined, rows), P, np.concatenate(owners))
                left_out |= self._needless(told, agreeing, done)
                P, rows, owners = told.known(), [], []
        result = []
        for k, choice in enumerate(done):
            labels = self.views.label[choice.asked]
            kept = [k * count + label not in left_out for label in labels.tolist()]
            result.append(replace(choice, asked=choice.asked[np.array(kept, dtype=np.bool_) | (labels >= count)]))
        return result

    def _needless(self, told: Told, agreeing: Floats, chosen: Sequence[_Choice]) -> set[int]:
        """Owners of the rows that can be spared: flashes, counted by stop and label; fewer stops agree then."""
        count, result, chance = len(self.optimum.problem.labels), set[int](), dict[int, float]()
        for k, choice in enumerate(chosen):
            for label, share in zip(self.views.label[choice.asked].tolist(), self.chance[choice.asked], strict=True):
                if k * count + label in told.owners and label < count:
                    chance[k * count + label] = max(chance.get(k * count + label, 0.0), float(share))
        asked = np.bincount([owner // count for owner in chance], minlength=len(chosen))

        def rise(owner: int) -> float:
            fewer = agreeing.copy()
            fewer[owner % count] -= chance[owner]
            return float(self._losses(told.without(owner), fewer).sum()) - now

        losses = self._losses(told.traces, agreeing)
        placed = losses[(self.weights > 0.0) & (losses < WIDEST_SIGMA_M * self.weights)]
        price, now = self.settings.spare * float(np.median(placed)) if len(placed) else 0.0, float(losses.sum())
        queue = [(rise(owner), owner) for owner in chance]
        heapq.heapify(queue)
        while queue and queue[0][0] <= price:
            _, owner = heapq.heappop(queue)
            if asked[owner // count] <= _JOINING:
                continue
            worth = rise(owner)  # by what was left out since it was queued: that made it worth more
            if queue and worth > queue[0][0]:
                heapq.heappush(queue, (worth, owner))
                continue
            if worth > price:
                break
            told.forget(owner)
            result.add(owner)
            agreeing[owner % count] -= chance[owner]
            asked[owner // count] -= 1
            now += worth
        return result

    def _with(
        self, chosen: Sequence[_Choice], P: Floats, agreeing: Floats, made: Sequence[_Choice] = ()
    ) -> tuple[Floats, Floats, list[_Choice]]:
        """The joint covariance, who agrees and all stops with their entries when some are made after those of P."""
        done = list(made)
        for choice in chosen:
            P, entry = self.belief.with_stop(P)
            done.append(replace(choice, entry=entry, link=self._link(choice.place, done, entry)))
            P = self.belief.take(P, self._rows(done[-1]))
            agreeing = self._agreeing_with(agreeing, choice.asked)
        return P, agreeing, done

    def _is_near(self, place: int, chosen: Sequence[_Choice]) -> bool:
        """Whether a place is too near to where a stop is planned, or was the last one made."""
        along, others = self.way.along, [choice.place for choice in chosen]
        if np.isfinite(along[place]):
            there = [*along[others], *(() if self.way.here is None else (self.way.here,))]
            return any(abs(float(along[place]) - at) < _APART * self.outlook.depth for at in there)
        apart = np.hypot(*(np.concatenate([self.places[others, :2], self.outlook.stops]) - self.places[place, :2]).T)
        return bool((apart < _APART * self.outlook.depth).any())

    def _is_done(self, P: Floats, agreeing: Floats) -> bool:
        judged = self.weights > 0.0
        known = np.sqrt(self.belief.traces(P)[judged]) <= self.settings.target_m
        return bool(known.all() and (agreeing[judged] >= 2).all())

    def _rows(self, choice: _Choice) -> Rows:
        asked = choice.asked
        return choice.link.joined(self.belief.sight(self.views, asked, self.chance[asked], choice.entry))

    # ---- the plan --------------------------------------------------------------------------------------------------

    def _told(self, at: Sequence[_Choice], first: Floats, gains: Floats) -> Study:
        """The plan: what is expected after each stop."""
        belief, problem, way = self.belief, self.optimum.problem, self.way
        count = len(problem.labels)
        flashes, skipped = list[tuple[PlannedFlash, ...]](), list[tuple[str, ...]]()
        now = {
            label.label: None if label.covariance is None else float(np.sqrt(np.trace(np.array(label.covariance))))
            for label in self.outlook.map.labels
            if label.status in ("placed", "known")
        }
        # what the whole survey knows less well than the stops around do, as these hang on stops elsewhere
        whole = np.array([now.get(label) or 0.0 for label in problem.labels])
        elsewhere = np.maximum(whole**2 - belief.traces(first)[:count], 0.0)
        P, agreeing, done = first, self.outlook.agreeing, list[_Choice]()
        for choice in at:
            P, agreeing, done = self._with([choice], P, agreeing, done)
            sigma = np.sqrt(np.maximum(belief.traces(P)[:count], 0.0) + elsewhere)
            labels = np.unique(self.views.label[choice.asked])
            in_view = np.unique(self.views.label[self.views.at(choice.place)])
            flashes.append(tuple(PlannedFlash(problem.labels[i], float(sigma[i])) for i in labels if i < count))
            skipped.append(tuple(problem.labels[i] for i in np.setdiff1d(in_view, labels) if i < count))
        stops = tuple(
            PlannedStop(
                None if np.isnan(way.along[choice.place]) else float(way.along[choice.place]),
                Pose(*self.places[choice.place].tolist()),
                asked,
                left_out,
            )
            for choice, asked, left_out in zip(at, flashes, skipped, strict=True)
        )
        expected = np.sqrt(np.maximum(belief.traces(P)[:count], 0.0) + elsewhere)
        labels_ = [
            PlannedLabel(problem.labels[i], now.get(problem.labels[i]), float(expected[i]))
            for i in np.flatnonzero(np.isfinite(belief.points[:count, 0]))
        ]
        here = set(problem.labels)
        labels_ += [PlannedLabel(name, value, value) for name, value in now.items() if value and name not in here]
        begin = 0.0 if way.here is None else way.here
        notes = self._notes(at, self._is_done(P, agreeing))
        result = Plan(problem.survey.survey, stops, tuple(labels_), notes, begin)
        return Study(
            result,
            self.outlook.map,
            self.places,
            gains,
            belief.points[:count],
            belief.blocks(first)[:count],
            belief.blocks(P)[:count],
        )

    def _order(self, chosen: Sequence[_Choice]) -> list[_Choice]:
        """Along the line; over free floor to the nearest next."""
        if self.way.here is None or not np.isnan(self.way.along).any():
            return sorted(chosen, key=lambda choice: float(self.way.along[choice.place]))
        rest, result = list(chosen), []
        place = self.optimum.problem.stop_entries(self.optimum.state)[-1, :2]
        while rest:
            following = min(rest, key=lambda choice: float(np.hypot(*(self.places[choice.place, :2] - place))))
            rest.remove(following)
            result.append(following)
            place = self.places[following.place, :2]
        return result

    def _notes(self, chosen: Sequence[_Choice], is_done: bool) -> tuple[str, ...]:
        settings, notes = self.settings, []
        if len(chosen) >= settings.most_stops:
            notes.append(f"{settings.most_stops} stops were planned, which is the most asked for")
        elif is_done:
            notes.append(f"every label is known to {1e3 * settings.target_m:.0f} mm then")
        else:
            notes.append(f"no other stop would lower the labels' uncertainty by {100 * settings.least:g} %")
        if self.way.here is None:
            notes.append("the stops are for a new leg, from the line's beginning")
        return (*self.notes, *notes)
