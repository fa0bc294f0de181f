"""The rig's cameras, the odometry factors and the beacons together: values, covariance, and what the rig does as one.

What a survey shows of a rig is where its cameras are to each other. The motion that all have in common shows only
against something else: its height and tilt against the floor and labels of known height, its heading and its place on
the robot against the wheels. So the joint covariance is split into six common motions and the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..errors import SolverError
from ..geometry.transforms import rotation_matrix, rotation_vector, skew
from ..records import Floats
from .bundle import SQUARE, Adjustment
from .problem import CAMERA, ODOMETRY, STOP, State
from .rig_roofs import RoofUnknowns
from .robust import Optimum

COMMON = ("forward", "left", "height", "roll", "pitch", "yaw")  # metres, then radians about the rig's middle
_MOST_COLUMNS = 6000  # of a dense inverse: 300 MB
_SETTLED = 1e-4  # step of beacons and homographies in their standard deviations at which they are found
_MOST_STEPS = 12
_BETTER = (
    3.0  # times: what a survey shows so much better than the tape it tells alone, as the tape would add 5 % at most
)
_CONTRADICTION = 4.0  # standard deviations between what a survey shows and where it was measured


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """An estimate of everything that is calibrated.

    Attributes
    ----------
    rotation : (C, 3, 3) array
        Camera to robot axes.
    translation : (C, 3) array
        Of the cameras' centres in robot axes, metres.
    odometry : (3,) array
        Errors of all moves: scale (dx, dy) and turn (dheading), relative, and drift in radians per metre.
    beacons : (B, 3) array
        Robot axes, metres; heights are as given.
    covariance : (6 C + 3 + 2 B,) square array
        Of each camera's rotation (radians about robot axes) and translation, then odometry, then the beacons' x, y.
    """

    rotation: Floats
    translation: Floats
    odometry: Floats
    beacons: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class Mode:
    """One motion of the whole rig: how well the nominal rig held it, how well the survey shows it, and both together.

    Standard deviations in metres or radians, infinite where the survey shows nothing; `change` is what was applied,
    `contradicts` says that the survey shows it clearly elsewhere than where it was measured, which then did not count.
    """

    name: str
    nominal: float
    survey: float
    sigma: float
    change: float
    contradicts: bool

    @property
    def is_shown(self) -> bool:
        """Whether the survey tells more of it than the tape measure did."""
        return self.contradicts or self.survey < self.nominal


def joint(optimum: Optimum, sigmas: tuple[float, float]) -> tuple[Joint, Optimum, RoofUnknowns, Floats]:
    """Estimate beacons and homographies together with all that an optimum holds.

    They are no unknowns of the adjustment: they are found by Gauss-Newton steps on the normal equations that include
    them, with the adjustment solved anew after each (variable projection; thesis equations 36 and 43).

    Parameters
    ----------
    optimum : Optimum
    sigmas : (float, float)
        Standard deviations of the beacons' given x and y, and of the roof cameras' planes, in metres.

    Returns
    -------
    Joint
    Optimum
        With state, beacons and homographies moved.
    RoofUnknowns
    (2 B + 8 R,) square array
        Their covariance.

    Raises
    ------
    SolverError
        If the survey is too large for a dense covariance, or says nothing about some camera.
    """
    unknowns = RoofUnknowns.of(optimum.problem, optimum.state, *sigmas)
    extra = len(unknowns)
    for _ in range(_MOST_STEPS):
        H, gradient = _normal(optimum, unknowns)
        if len(unknowns.beacon) == 0:
            break
        step = np.asarray(-np.linalg.solve(H, gradient)[-extra:], dtype=np.float64)
        if np.abs(step / unknowns.sigma).max() < _SETTLED:
            break
        unknowns = unknowns.moved(step)
        optimum = _moved(optimum, unknowns)
    problem, corrections = optimum.problem, optimum.problem.camera_entries(optimum.state)
    cameras, base = len(problem.cameras), STOP * problem.stop_count
    rotation = problem.R_robot_camera @ rotation_matrix(corrections[:, :3])
    column = np.full(len(problem.prior_sigma) + extra, -1)
    column[np.append(problem.free, np.ones(extra, dtype=np.bool_))] = np.arange(len(H))
    rig = (base + CAMERA * np.arange(cameras)[:, None] + np.arange(6)).ravel()
    factors = len(problem.prior_sigma) + np.arange(-ODOMETRY, 0)
    wanted = column[np.concatenate([rig, factors, len(problem.prior_sigma) + np.arange(2 * len(unknowns.given))])]
    covariance, full = np.zeros((len(wanted), len(wanted))), _inverse(H)
    there = wanted >= 0
    covariance[np.ix_(there, there)] = full[np.ix_(wanted[there], wanted[there])]
    turn = np.eye(len(wanted))  # corrections are about the camera's axes
    for c in range(cameras):
        turn[6 * c : 6 * c + 3, 6 * c : 6 * c + 3] = rotation[c]
    found = Joint(
        rotation,
        problem.t_robot_camera + corrections[:, 3:6],
        optimum.state.frame[factors],
        unknowns.beacons,
        turn @ covariance @ turn.T,
    )
    return found, optimum, unknowns, full[len(full) - extra :, len(full) - extra :]


def _moved(optimum: Optimum, unknowns: RoofUnknowns) -> Optimum:
    problem = replace(optimum.problem, roofs=unknowns.applied(optimum.problem.roofs))
    adjustment = Adjustment(problem, optimum.adjustment.sightings)
    solution = adjustment.solve(optimum.state, SQUARE, iterations=30, tolerance=1e-6, damping=1e-8)
    return replace(optimum, problem=problem, adjustment=adjustment, state=solution.state)


def _normal(optimum: Optimum, unknowns: RoofUnknowns) -> tuple[Floats, Floats]:
    """Normal matrix and gradient of the free frame entries, with the points eliminated, and of the roof's unknowns.

    The rig is taken as nominal where it is, so that its corrections are small rotations about the camera's own axes.
    """
    problem, state = optimum.problem, optimum.state
    corrections = problem.camera_entries(state)
    here = replace(
        problem,
        R_robot_camera=problem.R_robot_camera @ rotation_matrix(corrections[:, :3]),
        t_robot_camera=problem.t_robot_camera + corrections[:, 3:6],
    )
    frame = state.frame.copy()
    base = STOP * problem.stop_count
    frame[base : base + CAMERA * len(corrections)].reshape(-1, CAMERA)[:, :6] = 0.0
    state = State(frame, state.points)
    adjustment = Adjustment(here, optimum.adjustment.sightings)
    if not 0 < adjustment.size <= _MOST_COLUMNS:
        raise SolverError(f"the survey has {adjustment.size} unknowns; a rig is calibrated from at most 1000 stops")
    linear = adjustment.linearise(state, SQUARE)
    normal = adjustment.normal(linear, state, SQUARE)
    S, _, WV = adjustment.eliminate(normal)
    reduced = normal.frame_gradient - WV @ normal.point_gradient.ravel()
    n, extra = len(S), len(unknowns)
    H, gradient = np.zeros((n + extra, n + extra)), np.zeros(n + extra)
    H[:n, :n], gradient[:n] = S, reduced
    if len(unknowns.beacon):
        own = unknowns.jacobian(problem, state, linear.roof_by_stop).reshape(-1, extra)
        columns = np.repeat(adjustment.columns[STOP * problem.roofs.stop[:, None] + np.arange(STOP)], 2, axis=0)
        by_frame = np.zeros((len(own), n + 1))  # the last column takes what is held fixed
        np.put_along_axis(by_frame, np.where(columns < 0, n, columns), linear.roof_by_stop.reshape(-1, STOP), axis=1)
        H[:n, n:] = by_frame[:, :n].T @ own
        H[n:, :n] = H[:n, n:].T
        H[n:, n:] = own.T @ own
        gradient[n:] = own.T @ linear.roof.ravel()
    diagonal = np.arange(n, n + extra)
    H[diagonal, diagonal] += 1.0 / unknowns.sigma**2
    gradient[n:] += unknowns.values / unknowns.sigma**2
    return H, gradient


def _inverse(H: Floats) -> Floats:
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H), 1e-12))
    try:
        root = np.linalg.inv(np.linalg.cholesky(H * scale[:, None] * scale))
    except np.linalg.LinAlgError:
        raise SolverError("the survey says nothing about some part of the rig; make more stops, with turns") from None
    return np.asarray((root.T @ root) * scale[:, None] * scale)


def common_motions(translation: Floats) -> Floats:
    """(6 C, 6) what the motions `COMMON` of the whole rig do to each camera's rotation and translation."""
    arms = translation - translation.mean(axis=0)
    G = np.zeros((len(arms), 6, 6))
    G[:, :3, 3:] = np.eye(3)
    G[:, 3:, :3] = np.eye(3)
    G[:, 3:, 3:] = -skew(arms)  # turning by w moves an arm by w x arm
    return G.reshape(-1, 6)


def averaging(translation: Floats, bounds: tuple[float, float]) -> Floats:
    """(6, 6 C) which common motion is in what the cameras do, weighted by their bounds in radians and metres."""
    G = common_motions(translation)
    weight = np.tile(np.repeat(1.0 / np.square(bounds), 3), len(translation))
    return np.asarray(np.linalg.solve(G.T @ (weight[:, None] * G), G.T * weight))


def with_nominal(
    found: Joint, nominal: tuple[Floats, Floats], bounds: tuple[float, float], common: tuple[float, float]
) -> tuple[Joint, tuple[Mode, ...]]:
    """Combine the rig as a whole with where it was measured to be on the robot.

    Parameters
    ----------
    found : Joint
    nominal : rotations (C, 3, 3), translations (C, 3)
        As measured by tape.
    bounds : (radians, metres)
        Standard deviations of each camera around its nominal place, which `found` was estimated with.
    common : (radians, metres)
        The same of the rig as a whole.

    Returns
    -------
    Joint
        Along motions that the survey does not show, the rig is where its nominal cameras are on average.
    tuple of Mode
    """
    cameras = len(found.rotation)
    A, G = averaging(found.translation, bounds), common_motions(found.translation)
    offset = np.concatenate(
        [rotation_vector(found.rotation @ nominal[0].transpose(0, 2, 1)), found.translation - nominal[1]], axis=1
    ).ravel()
    P, n = found.covariance, 6 * cameras
    before = A @ P[:n, :n] @ A.T
    weak = np.linalg.inv(G.T @ (np.tile(np.repeat(1.0 / np.square(bounds), 3), cameras)[:, None] * G))
    shown = 1.0 / np.diagonal(before) - 1.0 / np.diagonal(weak)
    tape = np.repeat([common[1], common[0]], 3)
    survey = np.where(shown > 1e-3 / tape**2, 1.0 / np.sqrt(np.maximum(shown, 1e-30)), np.inf)
    wrong = (A @ offset) ** 2 > _CONTRADICTION**2 * (survey**2 + tape**2)
    told = np.where(wrong | (_BETTER * survey < tape), 1e3 * tape, tape)  # a tape read amiss would pull it along
    gain = P[:, :n] @ A.T @ np.linalg.inv(before + np.diag(told**2))
    step = -gain @ (A @ offset)
    P = P - gain @ A @ P[:n]
    P = 0.5 * (P + P.T)
    motion = A @ step[:n]
    result = _applied(found, step, motion, G)
    after = A @ P[:n, :n] @ A.T
    change = A @ offset + motion
    modes = tuple(
        Mode(name, float(tape[k]), float(survey[k]), float(np.sqrt(after[k, k])), float(change[k]), bool(wrong[k]))
        for k, name in enumerate(COMMON)
    )
    return replace(result, covariance=P), modes


def _applied(found: Joint, step: Floats, motion: Floats, G: Floats) -> Joint:
    """Move everything by a step of which `motion` (6,) is common; that part is turned exactly, however large it is."""
    cameras = len(found.rotation)
    rest = (step[: 6 * cameras] - G @ motion).reshape(-1, 6)
    middle = found.translation.mean(axis=0)
    turn = rotation_matrix(motion[3:])
    beacons = found.beacons.copy()
    arms = np.column_stack([beacons[:, :2] - middle[:2], np.zeros(len(beacons))])
    linear = motion[:3] + np.cross(motion[3:], arms)
    beacons[:, :2] += (step[6 * cameras + ODOMETRY :].reshape(-1, 2) - linear[:, :2]) + (
        arms @ turn.T - arms + motion[:3]
    )[:, :2]
    return Joint(
        turn @ rotation_matrix(rest[:, :3]) @ found.rotation,
        (found.translation - middle) @ turn.T + middle + motion[:3] + rest[:, 3:],
        found.odometry + step[6 * cameras : 6 * cameras + ODOMETRY],
        beacons,
        found.covariance,
    )


def relative_sigma(found: Joint, bounds: tuple[float, float]) -> tuple[Floats, Floats]:
    """Standard deviations (C,) of each camera's turn (radians) and place (metres) in the rig, whatever the rig does.

    The largest of all directions.
    """
    n = 6 * len(found.rotation)
    kept = np.eye(n) - common_motions(found.translation) @ averaging(found.translation, bounds)
    P = (kept @ found.covariance[:n, :n] @ kept.T).reshape(-1, 6, n // 6, 6)
    own = np.array([P[c, :, c] for c in range(n // 6)])
    turn, place = own[:, :3, :3], own[:, 3:, 3:]
    return (
        np.sqrt(np.maximum(np.linalg.eigvalsh(turn)[:, -1], 0.0)),
        np.sqrt(np.maximum(np.linalg.eigvalsh(place)[:, -1], 0.0)),
    )


def amount(name: str, value: float) -> str:
    """How far the rig moves along one of `COMMON`, in words."""
    return f"{np.degrees(value):.2f} degrees" if name in COMMON[3:] else f"{1e3 * value:.1f} mm"
