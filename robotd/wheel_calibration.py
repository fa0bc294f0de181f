"""Size and distance of the wheels from driven runs that a person measured.

A run is what the encoders counted between two standstills and what was measured on the floor: where a point of the
robot ended, or by how much the robot turned. Three kinds of runs tell the three unknowns apart: the length of straights
gives the mean of the two scales, spins give the base. The difference between the wheels bends straights, but a
sideways offset at the end of one only says so as far as the start was aligned. Out and back does not need that: the
robot drives straight, round a half circle and as far again. The two bends add up, and how far it ends beside its start
is nearly independent of where it first pointed. With half circles to either side the base drops out. This is the
bidirectional square of Borenstein and Feng ("Measurement and correction of systematic odometry errors in mobile
robots", IEEE Transactions on Robotics and Automation 12(6), 1996), folded to a line.

Minimised is the sum of squares of measured minus predicted over their standard deviations, exactly (every run is the
composition of its arcs), where the standard deviation is that of measuring and that of the wheels' own noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .errors import InputError
from .odometry import Wheels, arc
from .path_error import PathError, as_matrix3
from .records import Floats

KINDS = ("forward", "backward", "counter-clockwise", "clockwise", "out and back, turning left",
         "out and back, turning right")  # fmt: skip
STEP_M = 0.01  # of a wheel, to which recorded travel is thinned out
PLAUSIBLE = 0.10  # share by which a measurement may differ from what nominal wheels would do
SIDEWAYS = 0.25  # of the way driven: a robot that bends more than that has a defect
SURE = 0.9999  # probability up to which disagreement counts as chance
SCATTER = 4.0  # mean square of the residuals over their standard deviations that is still noise
ITERATIONS = 10
CONVERGED = 1e-7  # far less than any tape measure tells


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One measured run.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    travel : (N, 2) array
        Nominal metres rolled by the left and the right wheel since the start of the run, at successive instants; the
        last row is the whole run.
    offset : (x, y) in metres, optional
        Where a point of the robot ended, as seen from where a point of it had been: both on its long axis, in the
        robot's axes at the start.
    offset_sigma : (x, y) in metres
        Standard deviations of measuring `offset`.
    turn : float, optional
        Measured turn in radians, counter-clockwise, whole turns included.
    turn_sigma : float
        Standard deviation of measuring `turn`.
    reach : (start, end) in metres
        How far ahead of the axle's middle these two points are.
    """

    kind: str
    travel: Floats
    offset: tuple[float, float] | None = None
    offset_sigma: tuple[float, float] = (0.002, 0.002)
    turn: float | None = None
    turn_sigma: float = math.radians(1.0)
    reach: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind = {self.kind!r}; expected one of {', '.join(KINDS)}")
        if self.travel.ndim != 2 or self.travel.shape[1] != 2 or not len(self.travel):
            raise ValueError(f"need the travel of two wheels as (N, 2), got {self.travel.shape}")
        if self.offset is None and self.turn is None:
            raise ValueError("nothing was measured: give offset or turn")
        self.travel.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False)
class WheelCalibration:
    """What the runs say.

    `wheels` carries scales, base and their covariance; `residuals` holds for each run measured minus predicted (metres
    x, y, or radians), `sigmas` their standard deviations; `scatter` is the mean square of residuals over standard
    deviations, about 1.
    """

    wheels: Wheels
    residuals: tuple[Floats, ...]
    sigmas: tuple[Floats, ...]
    scatter: float


def thinned(travel: Floats) -> Floats:
    """(N, 2) wheel travel at every frame to rows that differ by at least 10 mm of one wheel; keeps the last row."""
    kept, last = [], np.zeros(2)
    for row in travel:
        if np.abs(row - last).max() >= STEP_M:
            kept.append(row)
            last = row
    if not kept or kept[-1] is not travel[-1]:
        kept.append(travel[-1])
    return np.array(kept, dtype=float)


def predict(run: Run, scale_left: float, scale_right: float, base: float) -> Floats:
    """What would be measured if the wheels were so: (2,) offset x, y, or (1,) turn, by composing the run's arcs."""
    steps = np.diff(run.travel, axis=0, prepend=0.0) * (scale_left, scale_right)
    half = 0.5 * (steps[:, 1] - steps[:, 0]) / base
    heading = 2.0 * np.cumsum(half)
    if run.turn is not None:
        return heading[-1:]
    chords = steps.mean(axis=1) * np.sinc(half / np.pi)
    end = (chords * np.exp(1j * (heading - half))).sum() + run.reach[1] * np.exp(1j * heading[-1]) - run.reach[0]
    return np.array([end.real, end.imag])


def implausible(run: Run, wheels: Wheels) -> str | None:
    """What is odd about a measurement, in words and with the likely reason; None if nothing is."""
    expected = predict(run, wheels.scale_left, wheels.scale_right, wheels.base)
    if run.turn is not None:
        off = math.degrees(run.turn - float(expected[0]))
        if abs(off) > 90.0:
            return (
                f"the wheels say {math.degrees(float(expected[0])):.0f} degrees, measured were "
                f"{math.degrees(run.turn):.0f}; is the sign right (counter-clockwise is positive), and were the turns "
                "counted right?"
            )
        return None
    assert run.offset is not None, "checked when the run was made"
    way = float(np.abs(np.diff(run.travel, axis=0, prepend=0.0)).mean(axis=1).sum())
    along, sideways = run.offset
    if run.kind in ("forward", "backward"):
        if abs(along - expected[0]) > PLAUSIBLE * abs(expected[0]):
            ratio = abs(along / expected[0])
            unit = next(
                (
                    f"; was it typed in {unit}?"
                    for unit, factor in (("centimetres", 0.1), ("metres", 0.001), ("inches", 1 / 25.4))
                    if abs(ratio / factor - 1.0) < 0.2
                ),
                "; was the right mark measured, and in millimetres?",
            )
            return f"the wheels say {1e3 * abs(expected[0]):.0f} mm, measured were {1e3 * abs(along):g} mm{unit}"
    elif abs(along) > SIDEWAYS * way:
        return f"{1e3 * along:g} mm from the start after out and back is too much; is it in millimetres?"
    if abs(sideways) > SIDEWAYS * way:
        return (
            f"{1e3 * sideways:g} mm sideways after {way:.1f} m is too much; is it in millimetres, and was the robot "
            "aligned with the tape?"
        )
    return None


def calibrate(runs: Sequence[Run], wheels: Wheels) -> WheelCalibration:
    """Estimate the scales of both wheels and their distance.

    Parameters
    ----------
    runs : sequence of Run
        At least one straight each way, one spin each way and one out and back with the half turn to each side.
    wheels : Wheels
        As believed so far: where the iteration starts, and `travel_noise`, which says how much of a disagreement is the
        wheels' own.

    Returns
    -------
    WheelCalibration
        The covariance is that of weighted least squares, (J^T W J)^-1, times the scatter where that exceeds 1.

    Raises
    ------
    InputError
        Lists what is missing or implausible, or which runs disagree with the others.
    """
    problems = _missing(runs)
    problems += [
        f"run {number} ({run.kind}): {words}"
        for number, run in enumerate(runs, 1)
        if (words := implausible(run, wheels)) is not None
    ]
    if problems:
        raise InputError(*problems)
    fit = _Fit(runs, wheels)
    odd = fit.disagreeing()
    if odd:
        raise InputError(*(_disagreement(runs[index], index) for index in odd))
    if fit.scatter > SCATTER:
        raise InputError(
            f"the runs scatter {math.sqrt(fit.scatter):.1f} times as much as measuring and wheels should "
            f"(travel_noise = {wheels.travel_noise:g}); does the floor slip, or was not always the same measured?"
        )
    scale_left, scale_right, base = fit.parameters
    covariance = as_matrix3(fit.covariance * max(1.0, fit.scatter))
    new = replace(wheels, scale_left=scale_left, scale_right=scale_right, base=base, covariance=covariance)
    sigmas = tuple(np.sqrt(np.diag(noise)) for noise in fit.noise)
    return WheelCalibration(new, tuple(fit.residuals), sigmas, fit.scatter)


def disagreeing(runs: Sequence[Run], wheels: Wheels) -> list[int]:
    """Indices of runs that do not fit to all others, worst first: a wheel slipped, or a number was mistyped."""
    return _Fit(runs, wheels).disagreeing()


def _missing(runs: Sequence[Run]) -> list[str]:
    found = {run.kind for run in runs}
    problems = []
    for pair, why in (
        (KINDS[0:2], "the length of straights gives the wheels' size"),
        (KINDS[2:4], "spins give the distance between the wheels"),
        (KINDS[4:6], "these tell the left wheel's size from the right one's"),
    ):
        missing = [kind for kind in pair if kind not in found]
        if missing:
            problems.append(f"no run {' and none '.join(missing)}; need at least one of each, because {why}")
    return problems


def _disagreement(run: Run, index: int) -> str:
    return (
        f"run {index + 1} ({run.kind}) disagrees with the others; a wheel may have slipped or a number was mistyped: "
        "drive it again"
    )


class _Fit:
    """Weighted least squares by Gauss-Newton; keeps every run's residual and Jacobian, so that one can be left out."""

    def __init__(self, runs: Sequence[Run], wheels: Wheels) -> None:
        self.runs = runs
        theta = np.array([wheels.scale_left, wheels.scale_right, wheels.base])
        for _ in range(ITERATIONS):
            left, right, base = theta.tolist()  # because on a bent way sideways noise is also noise along it
            bent = replace(wheels, scale_left=left, scale_right=right, base=base)
            self.noise = [_noise(run, bent) for run in runs]
            self.weights = [np.linalg.inv(noise) for noise in self.noise]
            self._linearise(theta)
            step = np.linalg.solve(self.information, self.gradient)
            theta = theta + step
            if np.abs(step).max() < CONVERGED:
                break
        self._linearise(theta)
        self.parameters: tuple[float, float, float] = (float(theta[0]), float(theta[1]), float(theta[2]))
        self.covariance = np.linalg.inv(self.information)
        squares = sum(float(r @ W @ r) for r, W in zip(self.residuals, self.weights, strict=True))
        self.scatter = squares / max(1, sum(len(r) for r in self.residuals) - 3)

    def _linearise(self, theta: Floats) -> None:
        self.residuals, self.jacobians = [], []
        for run in self.runs:
            measured = np.array([run.turn]) if run.turn is not None else np.array(run.offset)
            self.residuals.append(measured - predict(run, *theta))
            columns = []
            for parameter in range(3):
                step = np.zeros(3)
                step[parameter] = 1e-6
                columns.append((predict(run, *(theta + step)) - predict(run, *(theta - step))) / 2e-6)
            self.jacobians.append(np.stack(columns, axis=1))
        each = list(zip(self.jacobians, self.weights, self.residuals, strict=True))
        self.information = np.sum([J.T @ W @ J for J, W, _ in each], axis=0)
        self.gradient = np.sum([J.T @ W @ r for J, W, r in each], axis=0)

    def disagreeing(self) -> list[int]:
        """Runs whose residual against a fit of all others is too large, worst first."""
        odd = []
        for index, (J, W, noise, r) in enumerate(
            zip(self.jacobians, self.weights, self.noise, self.residuals, strict=True)
        ):
            information = self.information - J.T @ W @ J
            others = np.linalg.solve(information, self.gradient - J.T @ W @ r)
            left = r - J @ others
            spread = noise + J @ np.linalg.solve(information, J.T)
            square = float(left @ np.linalg.solve(spread, left))
            limit = -2.0 * math.log(1.0 - SURE) if len(r) == 2 else 15.14  # chi-square with 2 and with 1 degrees
            if square > limit:
                odd.append((square / limit, index))
        return [index for _, index in sorted(odd, reverse=True)]


def _noise(run: Run, wheels: Wheels) -> Floats:
    """Covariance of one run's measurement: of measuring, and of what the wheels' noise does on the way."""
    error, at, heading = PathError(wheels, slips=False), complex(0.0), 0.0
    for left, right in np.diff(run.travel, axis=0, prepend=0.0) * (wheels.scale_left, wheels.scale_right):
        forward, sideways, turn = arc(left, right, wheels.base)
        step = np.exp(1j * heading) * complex(forward, sideways)
        error.add(step, np.exp(1j * (heading + 0.5 * turn)), left, right)
        at, heading = at + step, heading + turn
    moment = np.array(error.second_moment())
    if run.turn is not None:
        return np.array([[moment[2, 2] + run.turn_sigma**2]])
    H = np.array([[1.0, 0.0, -run.reach[1] * math.sin(heading)], [0.0, 1.0, run.reach[1] * math.cos(heading)]])
    covariance: Floats = H @ moment @ H.T + np.diag(np.square(run.offset_sigma))
    return covariance


def summary(result: WheelCalibration, before: Wheels, runs: list[Run]) -> str:
    """What came out, old and new, with standard deviations, for a person."""
    new = result.wheels
    S = new.covariance
    left, right, base = (math.sqrt(S[i][i]) for i in range(3))
    difference = math.sqrt(max(0.0, S[0][0] + S[1][1] - 2.0 * S[0][1]))
    lines = ["", "                          before         now"]
    for name, old, value, sigma in (
        ("left wheel", before.scale_left, new.scale_left, left),
        ("right wheel", before.scale_right, new.scale_right, right),
    ):
        lines.append(f"{name:<18}{1e3 * (old - 1.0):+12.1f}{1e3 * (value - 1.0):+12.1f} +- {1e3 * sigma:.1f} mm/m")
    lines += [
        f"{'wheel base':<18}{1e3 * before.base:12.1f}{1e3 * new.base:12.1f} +- {1e3 * base:.1f} mm"
        f" (+- {360.0 * base / new.base:.1f} degrees a turn)",
        f"known so well, a straight of 100 m ends within {math.degrees(100.0 * difference / new.base):.1f} degrees "
        "of the true heading (one sigma)",
        "",
        "measured minus computed, and its standard deviation with the wheels' own noise:",
    ]
    for number, (run, residual, sigma_of) in enumerate(zip(runs, result.residuals, result.sigmas, strict=True), 1):
        factor, unit = (180.0 / math.pi, "degrees") if run.turn is not None else (1e3, "mm along, sideways")
        parts = [f"{factor * r:+.1f} +- {factor * s:.1f}" for r, s in zip(residual, sigma_of, strict=True)]
        lines.append(f"  run {number:<3}{run.kind:<29}{', '.join(parts)} {unit}")
    return "\n".join(lines)
