"""From a survey full of wrong sightings and a slipping wheel to the optimum of what is right.

Several starts descend through a sequence of ever stricter robust losses; between them every label is triangulated anew,
which frees labels that a reflection had drawn to the wrong place. The lowest robust cost wins; once two starts meet in
it, no more are tried. The sightings that the winner explains are then adjusted by least squares, because the strictest
robust loss costs a few per cent of accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.transforms import se2_relative
from ..records import Floats
from .breaks import torn_moves, without_moves
from .bundle import SQUARE, Adjustment, Loss, Solution
from .components import MOST_TO_TRY, judge, remarks, rescaled_known, rescaled_moves, scatter, widened
from .covariance import Covariance, covariance
from .hypotheses import Hypotheses, behind_glass, hypotheses, in_floor, out_of_glass, support, with_shared
from .initial import epipolar_moves
from .known_labels import contradicted, difference, slipped, slips_often, undecided
from .placement import Placement, at_first_stop, detach, place, ray_tolerance, retriangulate
from .problem import STOP, Bools, Problem, State, stops_per_label
from .references import IMPOSSIBLE, POSSIBLE, agreeing, beacons_disagree, bends, chance
from .strangers import without_strangers
from .tie_sightings import without_ties
from .ties import Rival, doubted
from .weights import OUTLIER, weighed
from .wheel_errors import slip_covariance
from .wrong import with_lost_moves, without_known, without_wrong

_REFERENCE = Loss("geman-mcclure", 0.4)  # compares starts: strict enough to tell them apart, slack on the lens
_EXPLAINED = 0.25  # weight of a sighting under that loss from which it counts as explained
_ENOUGH = 20  # sightings at a stop, to begin with
_FEW_DOUBTS = 0.001  # share of sightings not explained, below which labels are not triangulated once more
_CLEAN = 0.97  # share of sightings explained at which no other start can do better
_SAME = 0.5  # difference of two starts' costs below which they found the same minimum
_SCATTERS, _LESS = 1.3, 0.7  # times a stated standard deviation, and of that, from which priors are doubted instead
_MANY_SLIPS, _FEWER_SLIPS = 3, 3  # moves from which priors are doubted instead, and the times that must be fewer then
_LITTLE, _LEAST = 20.0, 100.0  # times a prior, and a camera's, so that it holds little
_ROUNDS = 8  # of widening what the survey states too small
_BREAKS = 4  # times that moves are looked for which are not the robot's
_JOINED = 3  # sightings that must fit in addition without them
_MEDIAN = 2.0 * np.log(2.0)  # of the squared length of a standard normal vector in the plane


@dataclass(frozen=True, slots=True)
class _Schedule:
    """One way to start: which moves, how wide the first triangulation, and the losses to descend through."""

    epipolar: bool
    tolerance: float
    losses: tuple[Loss, ...]


# in order of their success on warehouse surveys with 30 % wrong sightings; they fail on different ones
_SCHEDULES = (
    _Schedule(True, 0.03, (Loss("cauchy", 2.5, width=2.0),)),
    _Schedule(False, 0.06, (Loss("cauchy", 0.5, width=2.0),)),
    _Schedule(True, 0.06, (Loss("cauchy", 7.5), Loss("geman-mcclure", 2.5))),
    _Schedule(
        False, 0.3, (Loss("cauchy", 25.0, width=2.0), Loss("cauchy", 7.5, width=2.0), Loss("cauchy", 2.5, width=2.0))
    ),
)
_TRIED = 2  # of them, where only how well a survey fits is asked
_TAIL = (Loss("geman-mcclure", 1.0), Loss("geman-mcclure", 1.0), _REFERENCE)


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """The explained sightings and the state that fits them best.

    `problem` has slipped moves, wrong known labels and unplaced stops taken out. `inlier` (N,) says which of its
    sightings take part; `adjustment` is their least-squares problem and `state` its optimum. `placed` (S,) are the
    stops that have a place in the world. `reflected` (N,) are sightings of a label's image in floor or glass.
    `hypotheses` says where else each label may be. `rival` is another optimum of the whole survey
    that explains it about as well. `base` is the problem before anything was found wrong. `stated` is this
    optimum with all standard deviations as the survey has them, if some had to be widened.
    """

    base: Problem
    problem: Problem
    state: State
    placed: Bools
    inlier: Bools
    adjustment: Adjustment
    covariance: Covariance
    reflected: Bools
    hypotheses: Hypotheses
    rival: Rival | None
    iterations: int
    converged: bool
    stated: Optimum | None = None


def optimise(
    problem: Problem,
    start: Floats | None = None,
    grown: Placement | None = None,
    thorough: bool = True,
    as_stated: bool = False,
) -> Optimum:
    """Find the poses, rig and points that explain the sightings, whatever else is among them.

    `start` (S, 3) holds x, y, heading of every stop to begin from; by default those that odometry chains. `grown` is
    tried before all starts: a state near the optimum, for instance that of the same survey without its last stop. If
    not `thorough`, breaks in legs and weak ties are not looked for: enough to say how well a survey fits.
    If `as_stated`, priors and moves are believed, however little they fit: who calibrates them judges them.
    """
    if not thorough:
        return _from_starts(problem, start, grown, thorough)
    optimum = _decided(problem, start, grown)
    fewer = without_strangers(problem, optimum.problem, optimum.inlier | optimum.reflected)
    if fewer is not None:
        optimum = _decided(fewer, start, None)
    return optimum if as_stated else _borne_out(optimum)


def _decided(problem: Problem, start: Floats | None, grown: Placement | None) -> Optimum:
    """The optimum with those outside references that agree with all else."""
    optimum = _optimise(problem, start, grown)
    if problem.frame == "first stop":
        return optimum
    impossible = chance(optimum.adjustment, optimum.state) < IMPOSSIBLE
    beacons = optimum.adjustment.residuals(optimum.state, SQUARE).roof
    some = undecided(problem, optimum.state.points) or beacons_disagree(problem, beacons)
    if not (some or impossible or contradicted(problem, optimum.problem, optimum.state.points)):
        return optimum
    # without them, where that takes the contradictions away
    other = _optimise(at_first_stop(problem, ""), start, None)
    if np.count_nonzero(other.inlier) < 0.98 * np.count_nonzero(optimum.inlier):
        return optimum
    both = np.intersect1d(optimum.adjustment.labels, other.adjustment.labels)
    impossible &= len(both) > 0 and bends(optimum.state.points[both], other.state.points[both])
    impossible &= chance(other.adjustment, other.state) > POSSIBLE
    kept = np.isin(problem.known.label, other.adjustment.labels)
    how = difference(problem.known.position[kept], other.state.points[problem.known.label[kept]])
    fewer = slipped(optimum.problem) - slipped(other.problem)
    whole = contradicted(problem, optimum.problem, optimum.state.points) and fewer >= (0 if how else 2)
    if not whole:
        if fewer < 0 or not (some or impossible):
            return optimum
        agreed = agreeing(problem, other.state, other.covariance, other.adjustment.labels, other.placed)
        if agreed is problem and not (impossible or undecided(problem, optimum.state.points)):
            return optimum
        if agreed is not None and agreed is not problem:
            better = _optimise(agreed, start, None)
            if not impossible or chance(better.adjustment, better.state) > POSSIBLE:
                return better
    note = (
        f"the {problem.frame} contradict the sightings and the moves, so the first stop fixes the world frame; "
        + (f"they would fit {how}; " if how else "")
        + ("check their positions and names" if problem.frame == "known labels" else "check their homographies")
    )
    notes = (note, *(text for text in other.problem.notes if text))
    base = replace(other.base, notes=(note, *other.base.notes))
    return replace(other, base=base, problem=replace(other.problem, notes=notes))


def _borne_out(optimum: Optimum) -> Optimum:
    """The optimum with wider standard deviations of what contradicts the stated ones, and with notes on these."""
    result = _instead_of_scatter(optimum)
    judged = judge(result.adjustment, result.state, result.covariance)
    for _ in range(_ROUNDS):
        if (wider := widened(result.problem, judged)) is None:
            break
        everything = Adjustment(wider, wider.sightings)
        everything, state, inlier, adjustment, spent, converged = _least_squares(everything, result.state)
        sure = covariance(adjustment, state)
        adjustment, state, sure, inlier = without_ties(adjustment, state, sure, inlier)
        stated = wider.columns.sigma[wider.sightings.source[inlier]]
        adjustment, state, sure = weighed(adjustment, state, sure, stated)
        judged = judge(adjustment, state, sure)
        result = replace(
            result,
            problem=everything.problem,
            state=state,
            inlier=inlier,
            adjustment=adjustment,
            covariance=sure,
            iterations=result.iterations + spent,
            converged=converged,
        )
    if result is not optimum:
        everything = Adjustment(result.problem, result.problem.sightings)
        reflected, found = _elsewhere(everything, result.state)
        shown = (in_floor(everything, result.state) | reflected) & ~result.inlier
        problem = with_lost_moves(result.problem, result.state)
        result = replace(result, problem=problem, reflected=shown, hypotheses=found, stated=optimum)
    said = remarks(optimum.problem, result.problem, judged)
    return replace(result, problem=replace(result.problem, notes=(*result.problem.notes, *said))) if said else result


def _rig_is_to_blame(problem: Problem, optimum: Optimum) -> bool:
    """Whether moves hardly slip beside a rig that may be anywhere near."""
    free = _from_starts(replace(problem, prior_sigma=_little(problem)), None, None, thorough=False)
    fits = np.count_nonzero(free.inlier) >= np.count_nonzero(optimum.inlier)
    return bool(fits and _FEWER_SLIPS * slipped(free.problem) <= slipped(optimum.problem))


def _little(problem: Problem) -> Floats:
    """(F,) priors that hold little, the cameras' least."""
    prior = _LITTLE * problem.prior_sigma
    prior[STOP * problem.stop_count : problem.roof_entry] *= _LEAST / _LITTLE
    return prior


def _instead_of_scatter(optimum: Optimum) -> Optimum:
    """The optimum in which priors and moves give way, if sightings scatter or moves slip for their sake alone.

    Sightings that scatter and moves that were loosened make all else look right. So priors and moves are tried that
    hold little; where sightings then scatter much less, their noise is what is left, and against it the others are
    judged. Where they do not scatter, and moves slip much less beside free priors, these are judged as well.
    """
    factor, slips = scatter(optimum.problem), slipped(optimum.problem)
    scatters = factor > _SCATTERS
    slip = slips >= _MANY_SLIPS or slips_often(optimum.problem)
    if not (scatters or slip) or len(optimum.problem.sightings) > MOST_TO_TRY:
        return optimum
    base, prior = optimum.base, optimum.base.prior_sigma
    known, slipping = base.known, base.moves.covariance
    if scatters:
        slipping = slipping + slip_covariance(base.moves.measured)
    little = replace(
        base,
        prior_sigma=_little(base),
        moves=replace(base.moves, covariance=slipping),
        known=replace(known, sigma=_LITTLE * known.sigma),
    )
    free = _from_starts(little, None, None, thorough=False)
    fewer = np.count_nonzero(free.inlier) < np.count_nonzero(optimum.inlier)
    if not _better(free, factor if scatters else None, slips) or fewer or not free.placed.all():
        return optimum
    state = free.state
    if scatters:
        base = rescaled_moves(base, state, free.placed) or base
    problem = replace(free.problem, prior_sigma=prior, moves=base.moves, known=known)
    problem = without_wrong(Adjustment(problem, problem.sightings), state)
    for _ in range(_ROUNDS):
        adjustment = Adjustment(problem, free.adjustment.sightings)
        state = adjustment.solve(state, SQUARE, iterations=30, tolerance=1e-4, damping=1e-8).state
        wider = widened(problem, judge(adjustment, state, covariance(adjustment, state)))
        if wider is None:
            break
        problem = wider
    vaguer = np.median(problem.known.sigma) / np.median(known.sigma) if len(problem.known.sigma) else 1.0
    known = replace(known, sigma=known.sigma * vaguer)
    other = _from_starts(replace(base, prior_sigma=problem.prior_sigma, known=known), None, None)
    return other if _better(other, factor if scatters else None, slips) else optimum


def _better(optimum: Optimum, scattered: float | None, slips: int) -> bool:
    """Whether sightings scatter much less than they did, or, if they did not, moves slip much less."""
    if scattered is not None:
        return scatter(optimum.problem) < _LESS * scattered
    return _FEWER_SLIPS * slipped(optimum.problem) <= slips


def _optimise(problem: Problem, start: Floats | None, grown: Placement | None) -> Optimum:
    optimum = _from_starts(problem, start, grown)
    wider = rescaled_moves(problem, optimum.state, optimum.placed) if slips_often(optimum.problem) else None
    if wider is not None and not _rig_is_to_blame(problem, optimum):
        other = _from_starts(wider, start, None)
        steadier = 2 * slipped(other.problem) <= slipped(optimum.problem)
        if steadier and np.count_nonzero(other.inlier) > 0.98 * np.count_nonzero(optimum.inlier):
            problem, optimum = wider, other
    if (vaguer := rescaled_known(problem, optimum.problem, optimum.state)) is not None:
        other = _from_starts(vaguer, start, None)
        dropped = len(problem.known.label) - len(optimum.problem.known.label)
        if 2 * (len(problem.known.label) - len(other.problem.known.label)) <= dropped:
            problem, optimum = vaguer, other
    for _ in range(_BREAKS):
        torn = torn_moves(optimum.problem, optimum.inlier)
        if len(torn) == 0:
            break
        problem = without_moves(problem, torn)
        other = _from_starts(problem, start, None)
        if np.count_nonzero(other.inlier) < np.count_nonzero(optimum.inlier) + _JOINED:
            break
        optimum = other
    return optimum


def _from_starts(problem: Problem, start: Floats | None, grown: Placement | None, thorough: bool = True) -> Optimum:
    problem, placement, solution, iterations = _best_start(problem, start, grown, thorough)
    return _finish(problem, placement.placed, solution.state, iterations, thorough)


def _best_start(
    problem: Problem, start: Floats | None, grown: Placement | None, thorough: bool
) -> tuple[Problem, Placement, Solution, int]:
    best: tuple[float, Placement, Solution] | None = None
    iterations = 0
    guess = problem.moves.measured
    if start is not None:
        guess = se2_relative(start[problem.moves.before], start[problem.moves.after])
    few = _thinned(problem)
    schedules = _SCHEDULES if thorough else _SCHEDULES[:_TRIED]
    for schedule in (None, *schedules) if grown is not None else schedules:
        if schedule is None:
            assert grown is not None
            placement = grown
        else:
            moves = epipolar_moves(problem, problem.sightings, guess) if schedule.epipolar else guess
            placement = place(few, moves, schedule.tolerance)
            if not placement.placed.any():
                # only outside references can leave every stop without a place
                problem = at_first_stop(
                    problem,
                    f"the {problem.frame} could not be matched with the sightings, so the first stop fixes the world "
                    "frame; check their positions and names",
                )
                few = _thinned(problem)
                placement = place(few, moves, schedule.tolerance)
        solution, spent, share = _descend(problem, placement, () if schedule is None else schedule.losses)
        iterations += spent
        cost = solution.cost + 1e6 * np.count_nonzero(~placement.placed)
        agreed = best is not None and abs(cost - best[0]) < max(_SAME, 1e-4 * len(problem.sightings))
        if best is None or cost < best[0]:
            best = (cost, placement, solution)
        if agreed or (placement.placed.all() and share > _CLEAN):
            break
    assert best is not None
    return problem, best[1], best[2], iterations


def _descend(problem: Problem, placement: Placement, losses: tuple[Loss, ...]) -> tuple[Solution, int, float]:
    """The optimum of the strictest loss, iterations, and the share of sightings that it explains."""
    attached = detach(problem, placement.placed)
    adjustment = Adjustment(attached, attached.sightings)
    state, iterations, count = placement.state, 0, len(attached.sightings)
    few = _thinned(attached)
    first = adjustment if few is attached else Adjustment(few, few.sightings)
    for loss in losses:
        solution = first.solve(state, loss, iterations=12, tolerance=max(1.0, 1e-4 * count))
        state, iterations = solution.state, iterations + solution.iterations
    everywhere = np.ones(problem.stop_count, dtype=np.bool_)
    for k, loss in enumerate(_TAIL):
        if k == 0:
            state, _ = retriangulate(attached, state, ray_tolerance(attached), everywhere)
        elif k == 1:
            doubtful = attached.sightings.label[_weights(adjustment, state) < _EXPLAINED]
            if len(doubtful) < _FEW_DOUBTS * count:
                continue  # the next loss will do; `_finish` looks for other places of labels once more
            state, _ = retriangulate(attached, state, ray_tolerance(attached), everywhere, np.unique(doubtful))
        last = k == len(_TAIL) - 1
        tolerance = max(1e-2, 1e-5 * count) if last else max(0.3, 1e-4 * count)
        solution = adjustment.solve(state, loss, iterations=25 if last else 12, tolerance=tolerance, damping=1e-6)
        state, iterations = solution.state, iterations + solution.iterations
    return solution, iterations, float((_weights(adjustment, state) > _EXPLAINED).mean()) if count else 1.0


def _thinned(problem: Problem) -> Problem:
    """Every so many of the labels, where stops see many: as many as it takes to straighten the path."""
    stride = len(problem.sightings) // (_ENOUGH * problem.stop_count)
    if stride < 2:
        return problem
    return replace(problem, sightings=problem.sightings.select(problem.sightings.label % stride == 0))


def _weights(adjustment: Adjustment, state: State) -> Floats:
    """(N,) how far the state explains each sighting, 0 to 1."""
    return _REFERENCE((adjustment.residuals(state, _REFERENCE).residual ** 2).sum(axis=1))[1]


def _finish(base: Problem, placed: Bools, state: State, iterations: int, thorough: bool) -> Optimum:
    problem = detach(base, placed)
    everything = Adjustment(problem, problem.sightings)
    factor = _scatter(everything, state)
    if factor != 1.0:
        problem = _rescaled(problem, factor)
        everything = Adjustment(problem, problem.sightings)
    tolerance = max(1e-2, 1e-5 * len(problem.sightings))
    solution = everything.solve(state, Loss("geman-mcclure"), iterations=30, tolerance=tolerance, damping=1e-6)
    iterations, state = iterations + solution.iterations, solution.state
    rival: Rival | None = None
    if thorough:
        state, rival = doubted(problem, state, problem.sightings.select(support(everything, state)[1]))
    state, reflected, found = out_of_glass(everything, state)
    if reflected.any():
        found = hypotheses(everything, state)
    better = (found.rival_gain > found.gain) & ~behind_glass(problem, state, found.rivals)
    if better.any():
        state = replace(state, points=np.where(better[:, None], found.rivals, state.points))
        problem = without_known(problem, state, np.flatnonzero(better[problem.known.label]))
    for attempt in range(2):
        everything, state, inlier, adjustment, spent, converged = _least_squares(everything, state)
        problem = everything.problem
        iterations += spent
        sure = covariance(adjustment, state)
        adjustment, state, sure, inlier = without_ties(adjustment, state, sure, inlier)
        factor = _excess(adjustment, state, sure) if attempt == 0 else 1.0
        if factor == 1.0:
            break
        problem = _rescaled(problem, factor)
        everything = Adjustment(problem, problem.sightings)
    adjustment, state, sure = weighed(adjustment, state, sure, problem.columns.sigma[problem.sightings.source[inlier]])
    reflected, found = _elsewhere(everything, state)
    problem = with_lost_moves(problem, state)
    if (factor := scatter(problem)) > 1.0:
        note = f"sightings scatter {factor:.1f} times as much as their sigma_px says; uncertainties were scaled"
        problem = replace(problem, notes=(*problem.notes, note))
    return Optimum(
        base,
        problem,
        state,
        placed,
        inlier,
        adjustment,
        sure,
        (in_floor(everything, state) | reflected) & ~inlier,
        found,
        rival,
        iterations,
        converged,
    )


def _elsewhere(everything: Adjustment, state: State) -> tuple[Bools, Hypotheses]:
    """Which sightings (N,) are of images in glass, and where else labels may be, given the adjusted state."""
    other, reflected, found = out_of_glass(everything, state)
    if other is not state:  # a label that only now seems to be its image stays where it was adjusted
        found = hypotheses(everything, state, reflected)
    return reflected, with_shared(everything, state, found, reflected)


def _least_squares(everything: Adjustment, state: State) -> tuple[Adjustment, State, Bools, Adjustment, int, bool]:
    """Alternate between choosing the explained measurements and fitting them, until the choice stays.

    Returns the adjustment of everything without what is wrong, the optimum of what is explained, which sightings these
    are, their adjustment, iterations, and whether it converged.
    """
    inlier: Bools | None = None
    iterations = 0
    for _ in range(8):
        problem = without_wrong(everything, state)
        same = problem is everything.problem
        if not same:
            everything = Adjustment(problem, problem.sightings)
        chosen = explained(everything, state)
        if inlier is not None and same and (chosen == inlier).all():
            break
        inlier = chosen
        # explained sightings count in full, however doubtful their identity looked to the robot
        certain = replace(problem.sightings.select(inlier), probability=np.ones(np.count_nonzero(inlier)))
        adjustment = Adjustment(problem, certain)
        solution = adjustment.solve(state, SQUARE, iterations=30, tolerance=1e-4, damping=1e-8)
        state, iterations = solution.state, iterations + solution.iterations
    assert inlier is not None
    return everything, state, inlier, adjustment, iterations, solution.converged


def explained(everything: Adjustment, state: State) -> Bools:
    """Which sightings the state explains: at most one of each group of rivals, labels only from two stops or more."""
    problem, sightings = everything.problem, everything.sightings
    linear = everything.residuals(state, SQUARE)
    square = (linear.residual**2).sum(axis=1)
    good = linear.valid & (square < OUTLIER)
    best = np.full(int(sightings.rival.max(initial=-1)) + 1, np.inf)
    np.minimum.at(best, sightings.rival, square)
    good &= square <= best[sightings.rival]
    stops = stops_per_label(sightings.label[good], sightings.stop[good], len(problem.labels))
    stops[problem.known.label] += 1
    return np.asarray(good & (stops[sightings.label] >= 2))


def _scatter(everything: Adjustment, state: State) -> float:
    """By how much explained sightings scatter more than their sigma says, from the median; at least 1."""
    slack = (everything.residuals(state, _REFERENCE).residual ** 2).sum(axis=1)
    near = slack < _REFERENCE.width**2
    square = (everything.residuals(state, SQUARE).residual[near] ** 2).sum(axis=1)
    seen = np.zeros(len(everything.problem.labels), dtype=np.bool_)
    seen[everything.sightings.label[near]] = True
    unknowns = 3 * int(np.count_nonzero(seen))
    spare = 2 * len(square) - unknowns
    if spare < 20:
        return 1.0
    factor = float(np.sqrt(np.median(square) / _MEDIAN * 2 * len(square) / spare))
    return factor if factor > 1.3 else 1.0


def _excess(adjustment: Adjustment, state: State, sure: Covariance) -> float:
    """The same for the least-squares optimum, where the expected residuals are known exactly; at least 1."""
    expected = float((2.0 - sure.leverage).sum())
    if expected < 20.0:
        return 1.0
    found = float((adjustment.residuals(state, SQUARE).residual ** 2).sum())
    ratio = found / expected
    return float(np.sqrt(ratio)) if ratio > 1.0 + 3.0 * np.sqrt(2.0 / expected) else 1.0


def _rescaled(problem: Problem, factor: float) -> Problem:
    return replace(problem, sightings=replace(problem.sightings, sigma=problem.sightings.sigma * factor))
