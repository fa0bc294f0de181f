"""How far calibration, wheels and known labels are really off: standard deviations that the survey contradicts.

What weights.py does for sightings is done here for all else that the survey states: tilts, the cameras' poses and
lenses, odometry's common errors, moves, known labels, beacons. At the optimum, an estimate's distance from what was
stated scatters by the stated variance less the one that is left; as a standard normal vector, by `spread = I - left /
stated`. Along an eigenvector of the spread, with value v, its square over v is a chi-square. If the true variance is f
times the stated one, it is 1 + (f - 1) v on average, which gives f (variance components: W. Foerstner, 1979). Only what
no chance explains is widened, the least likely kind first, because one that is wrong strains all others; so nothing
changes in a survey that is as it says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincc

from ..geometry.transforms import se2_relative, wrap_angle
from ..records import Floats
from .bundle import SQUARE, Adjustment, Linear
from .covariance import Covariance, frame_covariance
from .problem import CAMERA, ODOMETRY, SIGMA_FLOOR_PX, STOP, Bools, Ints, Problem, State

MOST_TO_TRY = 5000  # sightings
_DOUBT = 1e-6  # probability of what is seen below which a stated standard deviation is not believed
_TOLD = 1e-6  # share of a stated variance that something else checks, from which the survey tells about it
_WIDEST = 1e3  # times a stated standard deviation
_CLEARLY = 1.5  # times by which moves scatter too much, to solve anew
_MEDIAN_1, _MEDIAN_2, _MEDIAN_3 = 0.455, 1.386, 2.366  # of a chi-square of one, two and three degrees of freedom
_KNOWN_M = 0.05  # by which known labels may be off, all of them, and still serve
_FEWEST_MOVES = 4
_WHEELS, _WHEELS_RAD = 0.2, 0.3  # of the way, and of heading: errors beyond are not of wheels, but of who wrote them
_SAID = 1.02  # a factor from which it is mentioned
_TOO_WIDE = 0.3  # times a stated standard deviation, below which it is too large to be meant
_ALIKE = 1.6  # a factor by which two standard deviations may differ to be taken for the same
_SQUARED = 10.0  # times a stated standard deviation, from which a square is thought of


@dataclass(frozen=True, slots=True)
class Kind:
    """Something stated of a survey, and what it is called: entries of the frame vector, or a kind of measurement.

    If `along` (entries,) is given, only the entries' common error in this direction is judged.
    """

    name: str
    entries: Ints | None = None
    along: Floats | None = None


@dataclass(frozen=True, slots=True)
class Judged:
    """A sum of squares that is a chi-square of `freedom` degrees if all is as stated, and the sum of the spreads."""

    square: float
    freedom: int
    spread: float

    @property
    def likely(self) -> float:
        """Probability of as large a sum by chance."""
        return float(gammaincc(0.5 * self.freedom, 0.5 * self.square)) if self.freedom else 1.0

    @property
    def factor(self) -> float:
        """By what the stated standard deviation should be multiplied."""
        variance = 1.0 + (self.square - self.freedom) / max(self.spread, 1e-12)
        return float(np.clip(np.sqrt(max(variance, 0.0)), 0.0, _WIDEST))


_SCALE = "odometry's scale"
MOVES, KNOWN, BEACONS = "moves", "known labels", "beacons"


def moves_left(linear: Linear, frame: Floats, problem: Problem) -> Floats:
    """(M, 3, 3) covariance of the adjusted moves, in units of the stated one."""
    m = problem.moves
    entries = np.concatenate(
        [
            STOP * m.before[:, None] + np.arange(3),
            STOP * m.after[:, None] + np.arange(3),
            np.tile(len(frame) + np.arange(-ODOMETRY, 0), (len(m.before), 1)),
        ],
        axis=1,
    )
    wheels = slice(0, len(m.before))  # the rest are motions by other sensors
    J = np.concatenate([linear.move_before, linear.move_after, linear.move_factor], axis=2)[wheels]
    return np.asarray(np.einsum("mri,mij,msj->mrs", J, frame[entries[:, :, None], entries[:, None, :]], J))


def beacons_left(linear: Linear, frame: Floats, adjustment: Adjustment) -> Floats:
    """(B, 2, 2) covariance of the adjusted beacons' pixels, in units of the stated variance."""
    entries = adjustment.roof_entries
    B = np.concatenate([linear.roof_by_stop, linear.roof_by_plane], axis=2)
    return np.asarray(np.einsum("mri,mij,msj->mrs", B, frame[entries[:, :, None], entries[:, None, :]], B))


def widened(problem: Problem, judged: list[tuple[Kind, Judged]]) -> Problem | None:
    """The problem with a wider standard deviation of what is least likely as stated; None if all may be."""
    if not judged:
        return None
    kind, worst = min(judged, key=lambda pair: (pair[1].likely, -pair[1].square))
    if worst.likely >= _DOUBT or worst.factor <= _SAID:
        return None
    wider = _with(problem, kind, worst.factor)
    for other, tally in judged:
        # rig and wheels both tell the size: where they contradict each other, neither is believed
        if other.name == _SCALE and other is not kind and tally.likely < _DOUBT and tally.factor > _SAID:
            wider = _with(wider, other, tally.factor)
    return wider


def judge(adjustment: Adjustment, state: State, sure: Covariance) -> list[tuple[Kind, Judged]]:
    """Judge every kind of what the survey states; none if it is too large.

    Parameters
    ----------
    adjustment : Adjustment
    state, sure : State, Covariance
        Its least-squares optimum, and there.
    """
    problem = adjustment.problem
    if len(problem.sightings) > MOST_TO_TRY:
        return []
    # what hardly gives way tells by tiny changes
    state = adjustment.solve(state, SQUARE, iterations=10, tolerance=1e-12, damping=1e-12).state
    frame = frame_covariance(adjustment, state)
    if frame is None:
        return []
    result = []
    for kind in (*_priors(problem), *_of_whole_rig(problem)):
        assert kind.entries is not None
        prior = problem.prior_sigma[kind.entries]
        entries, prior = kind.entries[prior > 0.0], prior[prior > 0.0]
        if len(entries):
            left = frame[np.ix_(entries, entries)] / np.outer(prior, prior)
            z = state.frame[entries] / prior
            if kind.along is not None:
                z, left = np.array([kind.along @ z]), np.array([[kind.along @ left @ kind.along]])
            result.append((kind, _chi_square(z[None], left[None])))
    linear = adjustment.linearise(state, SQUARE)
    steady = ~problem.moves.loosened
    if steady.any():
        left = moves_left(linear, frame, problem)[steady]
        result.append((Kind(MOVES), _chi_square(linear.move[: len(steady)][steady], left)))
    if len(linear.roof):
        result.append((Kind(BEACONS), _chi_square(linear.roof, beacons_left(linear, frame, adjustment))))
    known = problem.known
    row = np.full(len(problem.labels), -1)
    row[adjustment.labels] = np.arange(len(adjustment.labels))
    here = np.flatnonzero(row[known.label] >= 0)
    if len(here):
        z = (state.points[known.label[here]] - known.position[here]) / known.sigma[here, None]
        left = sure.points[row[known.label[here]]] / known.sigma[here, None, None] ** 2
        result.append((Kind(KNOWN), _chi_square(z, left)))
    return result


def _chi_square(z: Floats, left: Floats) -> Judged:
    """Judge standardised vectors (B, k), given the covariances (B, k, k) that are left of them."""
    values, vectors = np.linalg.eigh(np.eye(z.shape[1]) - 0.5 * (left + left.transpose(0, 2, 1)))
    told = values > _TOLD
    along = np.einsum("bki,bk->bi", vectors, z)
    square = float((along[told] ** 2 / values[told]).sum())
    return Judged(square, int(np.count_nonzero(told)), float(values[told].sum()))


def _priors(problem: Problem) -> Iterator[Kind]:
    """What priors are about: all tilts, each camera's place, direction and lens and those of all, odometry's errors."""
    yield Kind("the floor's tilts", (STOP * np.arange(problem.stop_count)[:, None] + np.array([3, 4])).ravel())
    first = STOP * problem.stop_count + CAMERA * np.arange(len(problem.cameras))
    for what, entries in (("direction", [0, 1, 2]), ("place", [3, 4, 5]), ("lens", [6, 7, 8, 9])):
        if len(first) > 1:
            yield Kind(f"the cameras' {what}", (first[:, None] + entries).ravel())
        for camera, begin in zip(problem.cameras, first.tolist(), strict=True):
            yield Kind(f"camera {camera.name}'s {what}", begin + np.array(entries, dtype=np.int64))
    if len(problem.roof_axes):
        yield Kind("the roof cameras' homographies", np.arange(problem.roof_entry, problem.beacon_entry))
    last = len(problem.prior_sigma)
    if problem.survey.rig.beacons:
        yield Kind("the beacons' places", np.arange(problem.beacon_entry, last - ODOMETRY))
    for k, name in enumerate(("scale", "turns", "drift")):
        yield Kind(_SCALE if k == 0 else f"odometry's {name}", np.array([last - ODOMETRY + k]))


def _of_whole_rig(problem: Problem) -> Iterator[Kind]:
    """What all cameras have in common if the rig sits askew or aside on the robot, where that is not held fixed.

    Such an error strains moves and cameras alike, each a little (W. Baarda, 1968: the more special alternative).
    """
    first, count = STOP * problem.stop_count + CAMERA * np.arange(len(problem.cameras)), len(problem.cameras)
    if count < 2:
        return
    direction, place = (first[:, None] + np.arange(k, k + 3) for k in (0, 3))
    if (problem.prior_sigma[direction] > 0.0).all():
        yield Kind("the cameras' direction", direction.ravel(), problem.R_robot_camera[:, 2].ravel() / np.sqrt(count))
    if (problem.prior_sigma[place] > 0.0).all():
        for axis in (0, 1):
            along = np.tile(np.eye(3)[axis], count) / np.sqrt(count)
            yield Kind("the cameras' place", place.ravel(), along)


def _with(problem: Problem, kind: Kind, factor: float) -> Problem:
    if kind.entries is not None:
        sigma = problem.prior_sigma.copy()
        sigma[kind.entries] *= factor
        return replace(problem, prior_sigma=sigma)
    if kind.name == KNOWN:
        return replace(problem, known=replace(problem.known, sigma=problem.known.sigma * factor))
    if kind.name == BEACONS:
        return replace(problem, roofs=replace(problem.roofs, sigma=problem.roofs.sigma * factor))
    steady = ~problem.moves.loosened[:, None, None]
    covariance = np.where(steady, problem.moves.covariance * factor**2, problem.moves.covariance)
    return replace(problem, moves=replace(problem.moves, covariance=covariance))


def scatter(problem: Problem) -> float:
    """By how much the sightings' standard deviations were multiplied because they scatter more."""
    s = problem.sightings
    stated = np.maximum(problem.columns.sigma[s.source], SIGMA_FLOOR_PX)
    return float(np.median(s.sigma / stated)) if len(s) else 1.0


def rescaled_moves(stated: Problem, state: State, placed: Bools) -> Problem | None:
    """The problem with wider moves, if many contradict the sightings because all are less exact than stated.

    At an optimum in which moves that do not fit were loosened, sightings alone say what they should have been; the
    medians of all moves' errors along the way and in heading then tell how they scatter. None if they do so as stated.
    `placed` (S,) are the stops that the state has a place for.
    """
    moves = stated.moves.select(placed[stated.moves.before] & placed[stated.moves.after])
    if len(moves.before) < _FEWEST_MOVES:
        return None
    poses = stated.stop_entries(state)[:, :3]
    error = se2_relative(poses[moves.before], poses[moves.after]) - moves.measured
    error -= moves.by_errors @ state.frame[-ODOMETRY:]
    variance = np.diagonal(moves.covariance, axis1=1, axis2=2)
    along = (error[:, :2] ** 2 / variance[:, :2]).sum(axis=1)
    turned = wrap_angle(error[:, 2]) ** 2 / variance[:, 2]
    factor = np.sqrt([float(np.median(along)) / _MEDIAN_2] * 2 + [float(np.median(turned)) / _MEDIAN_1])
    factor = np.clip(factor, 1.0, _WIDEST)
    way = np.hypot(*moves.measured[:, :2].T)
    off = float(np.median(np.hypot(*error[:, :2].T))) > _WHEELS * float(np.median(way))
    if factor.max() < _CLEARLY or off or float(np.median(np.abs(error[:, 2]))) > _WHEELS_RAD:
        return None
    covariance = stated.moves.covariance * factor[:, None] * factor
    return replace(stated, moves=replace(stated.moves, covariance=covariance))


def rescaled_known(stated: Problem, found: Problem, state: State) -> Problem | None:
    """The problem with less exact known labels, if several were dropped because all are less exact than stated."""
    known = stated.known
    if len(known.label) - len(found.known.label) < 2:
        return None
    seen = np.isin(known.label, found.sightings.label)
    off = np.linalg.norm(state.points[known.label[seen]] - known.position[seen], axis=1)
    factor = float(np.sqrt(np.median((off / known.sigma[seen]) ** 2) / _MEDIAN_3))
    if factor < _CLEARLY or float(np.median(off)) > _KNOWN_M:
        return None
    return replace(stated, known=replace(known, sigma=known.sigma * min(factor, _WIDEST)))


def remarks(stated: Problem, problem: Problem, judged: list[tuple[Kind, Judged]]) -> list[str]:
    """Sentences on what was widened since the problem as stated, and on what is stated too large to be meant."""
    found = list[str]()
    said = set[int]()
    for kind in _priors(problem):
        assert kind.entries is not None
        before, after = stated.prior_sigma[kind.entries], problem.prior_sigma[kind.entries]
        free = (before > 0.0) & np.isfinite(before)
        if not free.any() or said.issuperset(kind.entries.tolist()):
            continue
        factor = after[free] / before[free]
        if factor.min() > _SAID:  # of all cameras alike, or of one
            said.update(kind.entries.tolist())
            found.append(_remark(kind, float(np.median(factor)), float(np.median(before[free]))))
    moves, steady = problem.moves, ~problem.moves.loosened
    if steady.any():
        was, now = (np.diagonal(c[steady], axis1=1, axis2=2) for c in (moves.stated, moves.covariance))
        wider = np.sqrt(np.median(now / was, axis=0))
        if wider.max() > _SAID:
            typical = float(np.sqrt(np.median(was[:, np.argmax(wider)])))
            found.append(_remark(Kind(MOVES), float(wider.max()), typical))
    for name, was, now in (
        (KNOWN, stated.known.sigma, problem.known.sigma),
        (BEACONS, stated.roofs.sigma, problem.roofs.sigma),
    ):
        if len(now) and len(was) and (times := float(np.median(now) / np.median(was))) > _SAID:
            found.append(_remark(Kind(name), times, float(np.median(was))))
    for kind, tally in judged:
        if kind.along is not None:
            continue
        small = tally.factor < _TOO_WIDE and 1.0 - tally.likely < _DOUBT
        if small and (kind.entries is None or not said & set(kind.entries.tolist())):
            said.update(() if kind.entries is None else kind.entries.tolist())
            found.append(_too_wide(kind, np.sqrt(tally.square / tally.freedom), _typical(problem, kind)))
    return found


def _typical(problem: Problem, kind: Kind) -> float:
    if kind.entries is not None:
        return float(np.median(problem.prior_sigma[kind.entries]))
    if kind.name == MOVES:
        return float(np.sqrt(np.median(problem.moves.covariance[:, 2, 2])))
    return float(np.median(problem.known.sigma if kind.name == KNOWN else problem.roofs.sigma))


_MEND = {
    "tilts": "is the floor steeper than priors.tilt_rad says, or do the cameras look up or down?",
    "lens": "calibrate the lenses",
    "place": "check T_robot_camera, or calibrate the rig",
    "direction": "check T_robot_camera, or calibrate the rig",
    "scale": "calibrate odometry, and check the moves' units",
    "turns": "calibrate odometry, and check the moves' units",
    "drift": "calibrate odometry",
    MOVES: "do the wheels slip, or are the covariances too small?",
    KNOWN: "check known_labels, their positions and sigma_m",
    BEACONS: "check sigma_px and the roof cameras' homographies",
    "homographies": "calibrate the roof cameras",
    "places": "measure the beacons",
}


def _remark(kind: Kind, factor: float, stated: float) -> str:
    what = f"{kind.name} scatter" if kind.name == MOVES else f"{kind.name} came out"
    how = "as much as their covariances say" if kind.name == MOVES else "as far from the survey's as it allows"
    several = kind.name in (MOVES, KNOWN) or kind.name.startswith("the ")
    squared = several and factor > _SQUARED and stated < 1.0 and _alike(factor * stated, stated**0.5)
    mend = next(text for end, text in _MEND.items() if kind.name.endswith(end))
    if squared:
        mend = f"is what is stated squared once too often? else: {mend}"
    return f"{what} {factor:.2g} times {how}; uncertainties were widened; {mend}"


def _too_wide(kind: Kind, factor: float, stated: float) -> str:
    rooted = stated < 1.0 and _alike(factor * stated, stated**2)
    why = "; is a standard deviation given where its square is expected?" if rooted and kind.name == MOVES else ""
    why = why or ("; is its square root stated?" if rooted else "; is it of another unit?")
    better = 1.0 / max(factor, 1.0 / _WIDEST)
    return f"{kind.name}: the survey fits {better:.2g} times better than stated{why} Uncertainties are larger for it"


def _alike(one: float, other: float) -> bool:
    return bool(other / _ALIKE < one < other * _ALIKE)
