"""How far a survey and its map can be trusted: what is observable, how sensors really scatter, what is consistent.

Before solving, `observability` says in words what a survey can show at all. After solving, `analyse` says how well the
map's shape, size and heading are held, whether measurements scatter as they were said to (thesis section 3.3, in the
form of variance components: W. Foerstner, 1979), and which positions deserve a look on site.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.special

from ..records import Floats, Map, Survey, Vector3
from ..typed_json import many_records
from .bundle import SQUARE
from .components import beacons_left, moves_left
from .covariance import frame_covariance
from .mapping import to_map
from .panes import outside
from .placement import LABELS_TO_JOIN, segments
from .problem import BEACON, CAMERA, ROOF, STOP, Ints, Problem, anchors, build_problem, stops_per_label
from .robust import Optimum, optimise
from .ties import unchecked

_LEVEL_M = 0.05  # a label is at camera height within this
_OUTSIDE_M = 0.5
_FREE_SCALE = 0.01  # relative standard deviation from which the size of the map counts as free
_DOUBT = 1e-3  # probability of a larger chi-square by chance
_CAMERA = "camera "  # how the name of a camera's sightings begins


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """Where a label is with a given probability: semi-axes in metres, longest first, and their unit directions."""

    axes_m: Vector3
    directions: tuple[Vector3, Vector3, Vector3]


@dataclass(frozen=True, slots=True)
class Scatter:
    """How one kind of measurement scatters, against its stated standard deviation (its root mean square) in `unit`.

    `chi_square` is the sum of its squared whitened residuals, `redundancy` the number of its values less what fitting
    took of them.
    """

    sensor: str
    stated: float
    unit: str
    chi_square: float
    redundancy: float

    @property
    def factor(self) -> float | None:
        """By what the stated standard deviation should be multiplied; None where too few values are left to tell.

        Eight tell it to a quarter.
        """
        return float(np.sqrt(self.chi_square / self.redundancy)) if self.redundancy >= 8.0 else None


@dataclass(frozen=True, slots=True)
class Analysis:
    """What can be said about a map besides the map.

    Attributes
    ----------
    before : tuple of str
        What the survey cannot show, whatever is measured in it (see `observability`).
    after : tuple of str
        What the map does not hold well.
    scale, heading : float or None
        Standard deviation of the size of the driven path, relative, and of its heading, in radians, against the world
        frame; None where the path is too long for a dense inverse or there is none.
    sensors : tuple of Scatter
    chi_square, redundancy : float
        Sum of squared whitened residuals, and what it should be on average.
    probability : float
        Of a larger chi-square if all is as stated.
    ellipsoids : dict
        The 95 % ellipsoid of each placed label.
    """

    before: tuple[str, ...]
    after: tuple[str, ...]
    scale: float | None
    heading: float | None
    sensors: tuple[Scatter, ...]
    chi_square: float
    redundancy: float
    probability: float
    ellipsoids: dict[str, Ellipsoid]


def ellipsoid(covariance: Floats, share: float = 0.95) -> Ellipsoid:
    """The ellipsoid that holds a normal vector with covariance (3, 3) with probability `share`."""
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (3, 3) or not 0.0 < share < 1.0:
        raise ValueError(f"need a (3, 3) covariance and a share between 0 and 1, got {covariance.shape} and {share}")
    values, vectors = np.linalg.eigh(covariance)
    radius = np.sqrt(2.0 * scipy.special.gammaincinv(1.5, share))  # chi-square quantile with 3 degrees of freedom
    a, b, c = (radius * np.sqrt(np.maximum(values[::-1], 0.0))).tolist()
    (p, q, r), (s, t, u), (v, w, x) = vectors.T[::-1].tolist()
    return Ellipsoid((a, b, c), ((p, q, r), (s, t, u), (v, w, x)))


def observability(survey: Survey) -> tuple[str, ...]:
    """Sentences on what a survey cannot show, before it is solved; none if there is nothing to complain of.

    Raises
    ------
    InputError, SolverError
        As `solve`.
    """
    return _before(build_problem(survey))


def analyse(survey: Survey) -> tuple[Map, Analysis]:
    """Solve a survey and judge the result.

    Raises
    ------
    InputError, SolverError
        As `solve`.
    """
    with many_records():
        problem = build_problem(survey)
        optimum = optimise(problem)
        result = to_map(problem, optimum)
    before = _before(problem)
    state, adjustment = optimum.state, optimum.adjustment
    frame = frame_covariance(adjustment, state)
    sensors = _sensors(problem, optimum, frame)
    scale, heading = _shape(optimum, frame)
    # stated sigmas of sightings were replaced by estimates where residuals contradict them: only the rest is a test
    others = sum(s.chi_square for s in sensors if not s.sensor.startswith(_CAMERA))
    chi_square = others + float((adjustment.residuals(state, SQUARE).residual ** 2).sum())
    redundancy = sum(s.redundancy for s in sensors)
    probability = float(scipy.special.gammaincc(0.5 * redundancy, 0.5 * chi_square)) if redundancy > 1.0 else 1.0
    after = [*_after(optimum, result, scale), *_doubts(sensors)]
    if probability < _DOUBT:
        after.append(
            f"residuals are larger than stated standard deviations allow (chi-square {chi_square:.0f} where "
            f"{redundancy:.0f} is expected): some sigma or prior is too small, or something moved"
        )
    ellipsoids = {
        m.label: ellipsoid(np.array(m.covariance)) for m in result.labels if m.position is not None and m.covariance
    }
    return result, Analysis(
        before, tuple(after), scale, heading, sensors, chi_square, redundancy, probability, ellipsoids
    )


def _before(problem: Problem) -> tuple[str, ...]:
    found = [*_parts(problem), *_frame(problem)]
    counts = stops_per_label(problem.sightings.label, problem.sightings.stop, len(problem.labels))
    once = [label for label, count in zip(problem.labels, counts.tolist(), strict=True) if count == 1]
    if once:
        found.append(f"seen from one stop only, so that they may get no position: {_listed(once)}")
    return tuple(found)


def _parts(problem: Problem) -> list[str]:
    """Parts of the survey that nothing joins."""
    part = segments(problem)
    roots = np.arange(int(part[-1]) + 1)
    labels = [set(problem.sightings.label[part[problem.sightings.stop] == k].tolist()) for k in roots]
    anchored = {int(part[stop]) for stop in problem.roofs.stop} if problem.frame == "roof cameras" else set()
    known = set(problem.known.label.tolist())
    for a in roots.tolist():
        for b in range(a):
            shared = labels[a] & labels[b]
            enough = len(shared) >= LABELS_TO_JOIN or len(shared & known) >= 2 or {a, b} <= anchored
            if enough and roots[a] != roots[b]:
                roots[roots == roots[a]] = roots[b]
    if len(set(roots.tolist())) == 1:
        return []
    names = []
    for root in sorted(set(roots.tolist())):
        stops = [problem.survey.stops[f] for f in np.flatnonzero(roots[part] == root)]
        names.append(_listed([f"{stop.leg}/{stop.stop}" for stop in stops]))
    return [
        f"the survey falls into {len(names)} parts that share fewer than {LABELS_TO_JOIN} labels (leg/stop "
        f"{'; '.join(names)}): only the part that fixes the world frame is mapped; map some labels from both"
    ]


def _frame(problem: Problem) -> list[str]:
    found = []
    listed = {known.label for known in problem.survey.known_labels}
    seen = [problem.labels[i] for i in problem.known.label if i in set(problem.sightings.label.tolist())]
    if problem.frame == "first stop" and listed:
        why = "hang one above the other" if len(seen) >= 2 else "was seen" if len(seen) == 1 else "were seen"
        amount = "those seen" if len(seen) >= 2 else "only one" if len(seen) == 1 else "none"
        found.append(
            f"known labels do not fix the world frame ({amount} {why}), so the first stop does; measure two that hang "
            "apart and are seen"
        )
    travelled = np.hypot(problem.moves.measured[:, 0], problem.moves.measured[:, 1])
    if problem.frame == "first stop" and (len(travelled) == 0 or travelled.max() < 0.05):
        found.append("nothing shows the size of the map: there is no move of length, and no known label or roof camera")
    if problem.frame == "known labels":
        heights = problem.t_robot_camera[:, 2]
        level = np.abs(problem.known.position[:, 2][:, None] - heights).min(axis=1) < _LEVEL_M
        used = np.isin(problem.known.label, problem.sightings.label)
        if anchors(problem.known, problem.sightings) and level[used].all():
            found.append(
                "all known labels hang at camera height, where they say little about distance and tilt (erratum A9); "
                "measure one that hangs higher or lower"
            )
    return found


def _after(optimum: Optimum, result: Map, scale: float | None) -> list[str]:
    problem, state = optimum.problem, optimum.state
    found = []
    if scale is not None and scale > _FREE_SCALE:
        found.append(
            f"the size of the map is known to {100 * scale:.1f} % only; measure two labels far apart, or calibrate "
            "odometry"
        )
    placed = [i for i, m in enumerate(result.labels) if m.status == "placed"]
    stops = problem.stop_entries(state)[optimum.placed, :2]
    far = []
    for i in placed:
        others = np.vstack([state.points[[j for j in placed if j != i], :2], stops])
        distance = outside(others, state.points[i, :2]) if len(placed) <= 500 else 0.0
        if distance > _OUTSIDE_M:
            far.append(f"{problem.labels[i]} by {distance:.1f} m")
    found += unchecked(problem, problem.sightings.select(optimum.inlier))
    if far:
        found.append(
            f"outside everything else that was mapped: {_listed(far)}; a label that was seen in glass only looks like "
            "that, and no sighting can tell: check on site whether something shiny hangs before it"
        )
    return found


def _doubts(sensors: tuple[Scatter, ...]) -> list[str]:
    found = []
    for s in sensors:
        if s.factor is None:
            continue
        tail = scipy.special.gammaincc(0.5 * s.redundancy, 0.5 * s.chi_square)
        if min(tail, 1.0 - tail) < _DOUBT:
            found.append(
                f"{s.sensor}: residuals show {s.stated * s.factor:.3g} {s.unit} where {s.stated:.3g} {s.unit} is stated"
            )
    return found


def _sensors(asked: Problem, optimum: Optimum, frame: Floats | None) -> tuple[Scatter, ...]:
    """Standard deviations of every kind of measurement, from its residuals and what fitting left of them."""
    problem, state, adjustment = optimum.problem, optimum.state, optimum.adjustment
    used = adjustment.sightings
    said = problem.columns.sigma[used.source]
    square = (adjustment.residuals(state, SQUARE).residual ** 2).sum(axis=1) * (used.sigma / said) ** 2
    spare = 2.0 - optimum.covariance.leverage
    result = []
    for c, camera in enumerate(problem.cameras):
        mine = used.camera == c
        if mine.any():
            stated = float(np.sqrt(np.mean(said[mine] ** 2)))
            result.append(
                Scatter(f"{_CAMERA}{camera.name}", stated, "px", float(square[mine].sum()), float(spare[mine].sum()))
            )
    if frame is None:
        return tuple(result)
    linear = adjustment.linearise(state, SQUARE)
    m = problem.moves
    good = ~m.loosened
    if good.any():
        fitted = np.trace(moves_left(linear, frame, problem), axis1=1, axis2=2)
        stated = float(np.sqrt(np.mean(m.stated[good, 2, 2])))
        squares = float((linear.move[: len(good)][good] ** 2).sum())
        squares *= float(np.mean(m.covariance[good, 2, 2])) / stated**2
        result.append(Scatter("odometry (heading)", stated, "rad", squares, float((3.0 - fitted[good]).sum())))
    if len(linear.roof):
        fitted = np.trace(beacons_left(linear, frame, adjustment), axis1=1, axis2=2)
        stated = float(np.sqrt(np.mean(problem.roofs.sigma**2)))
        left = float((2.0 - fitted).sum())
        result.append(Scatter("roof cameras", stated, "px", float((linear.roof**2).sum()), left))
    variance = np.diagonal(frame)
    for name, unit, chosen in _priors(problem):
        prior = asked.prior_sigma[chosen]
        chosen, prior = chosen[prior > 0.0], prior[prior > 0.0]
        if len(chosen):
            left = float((1.0 - variance[chosen] / problem.prior_sigma[chosen] ** 2).sum())
            squares = float(((state.frame[chosen] / prior) ** 2).sum())
            result.append(Scatter(name, float(np.sqrt(np.mean(prior**2))), unit, squares, left))
    return tuple(result)


def _priors(problem: Problem) -> list[tuple[str, str, Ints]]:
    """Kinds of priors: name, unit and frame entries."""
    stops = STOP * np.arange(problem.stop_count)[:, None]
    cameras = STOP * problem.stop_count + CAMERA * np.arange(len(problem.cameras))[:, None]
    planes = problem.roof_entry + ROOF * np.arange(len(problem.roof_axes))[:, None]
    beacons = problem.beacon_entry + BEACON * np.arange(len(problem.survey.rig.beacons))[:, None]
    kinds: list[tuple[str, str, Ints, list[int]]] = [
        ("tilt of the floor", "rad", stops, [3, 4]),
        ("mounting of the cameras, rotation", "rad", cameras, [0, 1, 2]),
        ("mounting of the cameras, position", "m", cameras, [3, 4, 5]),
        ("lens", "px", cameras, [6, 7, 8, 9]),
        ("homographies of the roof cameras", "sigma", planes, [*range(ROOF)]),
        ("places of the beacons", "m", beacons, [*range(BEACON)]),
    ]
    return [(name, unit, (first + np.array(which, dtype=np.int64)).ravel()) for name, unit, first, which in kinds]


def _shape(optimum: Optimum, frame: Floats | None) -> tuple[float | None, float | None]:
    """Standard deviations of the path's size (relative) and heading: least-squares scale and turn of all stops."""
    if frame is None:
        return None, None
    poses = optimum.problem.stop_entries(optimum.state)[:, :2]
    stops = np.flatnonzero(optimum.placed)
    arms = poses[stops] - poses[stops].mean(axis=0)
    moment = float((arms**2).sum())
    if moment < 1e-3:
        return None, None
    entries = (STOP * stops[:, None] + [0, 1]).ravel()
    block = frame[np.ix_(entries, entries)]
    grow = arms.ravel() / moment
    turn = np.column_stack([-arms[:, 1], arms[:, 0]]).ravel() / moment
    return float(np.sqrt(max(grow @ block @ grow, 0.0))), float(np.sqrt(max(turn @ block @ turn, 0.0)))


def _listed(names: list[str]) -> str:
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def analysis_text(analysis: Analysis) -> str:
    """The analysis for a reader, one statement a line."""
    lines = [*(f"before solving: {text}" for text in analysis.before), *(f"after solving: {t}" for t in analysis.after)]
    if analysis.scale is not None and analysis.heading is not None:
        lines.append(
            f"the path's size is known to {100 * analysis.scale:.2g} %, its heading to "
            f"{np.degrees(analysis.heading):.2g} degrees"
        )
    lines.append(
        f"chi-square {analysis.chi_square:.1f}, expected {analysis.redundancy:.1f} "
        f"(a larger one by chance: {100 * analysis.probability:.2g} %)"
    )
    for s in analysis.sensors:
        found = "too few values to tell" if s.factor is None else f"found {s.stated * s.factor:.3g} {s.unit}"
        lines.append(f"{s.sensor}: stated {s.stated:.3g} {s.unit}, {found} ({s.redundancy:.0f} spare values)")
    longest = sorted(analysis.ellipsoids.items(), key=lambda item: -item[1].axes_m[0])[:5]
    lines += [f"{label}: within {1e3 * e.axes_m[0]:.0f} mm (95 %)" for label, e in longest]
    return "\n".join(lines) + "\n"
