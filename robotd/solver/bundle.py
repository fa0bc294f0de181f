"""Bundle adjustment: poses, rig, odometry factors and points that explain all measurements best.

Minimised is half the sum of robust losses of whitened residuals: sightings (px), moves, beacons seen from the roof,
labels measured by hand, and the priors. Levenberg-Marquardt steps on iteratively reweighted normal equations; the
points are eliminated by the Schur complement, so that what is factorised has the size of the frame vector only (thesis
section 2.4.4 and equation 44, with every residual divided by its standard deviation as erratum A17 asks).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import scipy.linalg
import scipy.sparse

from ..geometry.transforms import heading_matrix, pose_matrix, rotation_matrix, skew, wrap_angle
from ..records import Floats
from .kernel import SHAPES, compiled
from .problem import BEACON, CAMERA, ODOMETRY, ROOF, STOP, Bools, Ints, Problem, Sightings, State

if TYPE_CHECKING:
    from ._bundle import Bundle

_UNSEEN = 1e4  # whitened residual given to a sighting of a point behind its camera
_NEAREST_M = 0.1  # a point at a camera's centre would explain any pixel, and no label is inside the robot
_BLOCK = STOP + CAMERA


@dataclass(frozen=True, slots=True)
class Loss:
    """How residuals count.

    `shape` of the sightings' loss, `width` in standard deviations where it turns, and a floor `sigma_px` on the
    standard deviations: large while the poses are poor, so that no sighting outweighs odometry before it can be judged.
    `move_width` is where the Cauchy loss of all other measurements turns, because wheels slip; infinite = square.
    """

    shape: Literal["square", "cauchy", "geman-mcclure"]
    sigma_px: float = 0.0
    width: float = 4.0
    move_width: float = 3.0

    def __call__(self, square: Floats) -> tuple[Floats, Floats]:
        """Loss and weight (its derivative) of squared whitened residuals."""
        if self.shape == "square":
            return square, np.ones_like(square)
        if self.shape == "cauchy":
            return _cauchy(square, self.width)
        c = self.width**2
        return square * c / (c + square), (c / (c + square)) ** 2


SQUARE = Loss("square", move_width=np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The measurements linearised at a state; every residual and derivative is divided by its standard deviation.

    Sightings: `residual` (N, 2), `by_frame` (N, 2, 15) by the stop's 5 and the camera's 10 entries, `by_point`
    (N, 2, 3), `valid` (N,). Moves, then motions: `move` (M, 3), its derivatives (M, 3, 3) by x, y, heading of the stops
    before and after, and (M, 3, 3) by the odometry factors. Beacons: `roof` (B, 2), `roof_by_stop` (B, 2, 5), and
    `roof_by_plane` (B, 2, 10) by the entries of its camera's homography and of its beacon.
    """

    residual: Floats
    by_frame: Floats
    by_point: Floats
    valid: Bools
    move: Floats
    move_before: Floats
    move_after: Floats
    move_factor: Floats
    roof: Floats
    roof_by_stop: Floats
    roof_by_plane: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """The whitened residuals of `Linear` without derivatives."""

    residual: Floats
    valid: Bools
    move: Floats
    roof: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations: frame block `H` (n, n), point blocks `V` (l, 3, 3), sparse coupling `W` (n, 3 l), gradients."""

    H: Floats
    V: Floats
    W: Any
    frame_gradient: Floats
    point_gradient: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the adjustment ended: state, robust cost, iterations, whether the predicted decrease became negligible."""

    state: State
    cost: float
    iterations: int
    converged: bool


class Adjustment:
    """The least-squares problem of a chosen set of sightings.

    Parameters
    ----------
    problem : Problem
    sightings : Sightings
        Those that take part; points without any stay where they are.
    """

    def __init__(self, problem: Problem, sightings: Sightings) -> None:
        self.problem = problem
        self.sightings = sightings
        s = sightings
        self.columns: Ints = np.where(problem.free, np.cumsum(problem.free) - 1, -1)
        self.size = int(np.count_nonzero(problem.free))
        finite = problem.free & np.isfinite(problem.prior_sigma)
        self.information = np.where(finite, 1.0 / np.where(finite, problem.prior_sigma, 1.0) ** 2, 0.0)
        seen = np.bincount(s.label, minlength=len(problem.labels)) > 0
        self.labels: Ints = np.flatnonzero(seen)
        self.point: Ints = (np.cumsum(seen) - 1)[s.label]
        self.camera_slices = [slice(*np.searchsorted(s.camera, [c, c + 1])) for c in range(len(problem.cameras))]
        moves, motions = problem.moves, problem.motions
        self.before: Ints = np.concatenate([moves.before, motions.before])
        self.after: Ints = np.concatenate([moves.after, motions.after])
        self.measured: Floats = np.concatenate([moves.measured, motions.measured])
        self.move_roots: Floats = np.concatenate([np.linalg.inv(np.linalg.cholesky(moves.covariance)), motions.root])
        self.by_errors: Floats = np.concatenate([moves.by_errors, np.zeros((len(motions.before), 3, ODOMETRY))])
        self.known_here: Ints = np.flatnonzero(seen[problem.known.label])
        self.known_point: Ints = np.searchsorted(self.labels, problem.known.label[self.known_here])

    @cached_property
    def kernel(self) -> Bundle | None:
        """The same problem compiled, if it can be; what is done here in numpy is then done there."""
        return compiled(self)

    @cached_property
    def entries(self) -> Ints:
        """(N, 15) frame entries that each sighting depends on: its stop's, then its camera's."""
        s, base = self.sightings, STOP * self.problem.stop_count
        return np.concatenate(
            [STOP * s.stop[:, None] + np.arange(STOP), base + CAMERA * s.camera[:, None] + np.arange(CAMERA)], axis=1
        )

    @cached_property
    def roof_entries(self) -> Ints:
        """(B, 15) frame entries that each roof sighting depends on: its stop's, its camera's and its beacon's."""
        problem, roofs = self.problem, self.problem.roofs
        parts = (
            STOP * roofs.stop[:, None] + np.arange(STOP),
            problem.roof_entry + ROOF * roofs.camera[:, None] + np.arange(ROOF),
            problem.beacon_entry + BEACON * roofs.which[:, None] + np.arange(BEACON),
        )
        return np.concatenate(parts, axis=1)

    @cached_property
    def _pattern(self) -> tuple[Bools, Ints, Ints]:
        """Which of the (N, 2, 15) derivatives have a column, and the CSR indices of what remains."""
        columns = np.repeat(self.columns[self.entries][:, None], 2, axis=1)
        kept = columns >= 0
        return kept, columns[kept], np.concatenate([[0], np.cumsum(kept.sum(axis=2).ravel())])

    def residuals(self, state: State, loss: Loss) -> Residuals:
        """Residuals alone, by the kernel if there is one."""
        if self.kernel is None:
            linear = self.linearise(state, loss)
            return Residuals(linear.residual, linear.valid, linear.move, linear.roof)
        poses = self.problem.stop_entries(state)
        residual, valid = self.kernel.residuals(state.frame, state.points[self.labels], loss.sigma_px)
        roofs = self.problem.roofs.stop
        R_stop = np.zeros((len(poses), 3, 3))
        R_stop[roofs] = pose_matrix(*poses[roofs].T)[:, :3, :3]
        return Residuals(
            residual, valid, self._linear_moves(poses, state)[0], self._linear_roofs(poses, R_stop, state)[0]
        )

    def linearise(self, state: State, loss: Loss) -> Linear:
        """Residuals and analytic derivatives at a state."""
        problem, s = self.problem, self.sightings
        poses, corrections = problem.stop_entries(state), problem.camera_entries(state)
        x, y, heading, roll, pitch = poses.T
        R_stop = pose_matrix(x, y, heading, roll, pitch)[:, :3, :3]
        R_robot_world = R_stop[s.stop].transpose(0, 2, 1)
        offset = state.points[s.label]
        offset[:, :2] -= poses[s.stop, :2]
        in_robot = (R_robot_world @ offset[:, :, None])[:, :, 0]
        turn = rotation_matrix(corrections[:, :3])
        R_cam_robot = (problem.R_robot_camera @ turn).transpose(0, 2, 1)
        t = problem.t_robot_camera + corrections[:, 3:6]
        R_cam = R_cam_robot[s.camera]
        in_camera = (R_cam @ (in_robot - t[s.camera])[:, :, None])[:, :, 0]

        pixels = np.empty((len(s), 2))
        by_camera_point = np.empty((len(s), 2, 3))
        by_lens = np.zeros((len(s), 2, 4))
        valid = np.empty(len(s), dtype=np.bool_)
        for c, rows in enumerate(self.camera_slices):
            model = problem.cameras[c]
            nominal, derivative, valid[rows] = model.project_jacobian(in_camera[rows])
            image = (np.where(valid[rows, None], nominal, model.centre) - model.centre) / model.focal
            focal, centre = model.focal + corrections[c, 6:8], model.centre + corrections[c, 8:10]
            pixels[rows] = focal * image + centre
            by_camera_point[rows] = derivative * (focal / model.focal)[:, None]
            by_lens[rows, 0, 0], by_lens[rows, 1, 1] = image[:, 0], image[:, 1]
            by_lens[rows, 0, 2] = by_lens[rows, 1, 3] = 1.0
        valid &= (in_camera**2).sum(axis=1) > _NEAREST_M**2
        by_camera_point[~valid] = 0.0
        sigma = np.maximum(s.sigma, loss.sigma_px)
        by_camera_point /= sigma[:, None, None]
        residual = np.where(valid[:, None], (pixels - s.uv) / sigma[:, None], _UNSEEN)

        by_robot_point = by_camera_point @ R_cam
        by_point = by_robot_point @ R_robot_world
        frame = np.empty((len(s), 2, _BLOCK))
        frame[:, :, :2] = -by_point[:, :, :2]
        # d/dheading of R' offset = -R' (z x offset); likewise roll about x and pitch about the rolled y axis
        z_cross = np.column_stack([-offset[:, 1], offset[:, 0], np.zeros(len(s))])
        frame[:, :, 2] = -(by_point @ z_cross[:, :, None])[:, :, 0]
        lever = skew(in_robot)  # -axis x p = p x axis
        pitch_axis = np.column_stack([np.zeros(len(roll)), np.cos(roll), -np.sin(roll)])[s.stop]
        moment = by_robot_point @ lever
        frame[:, :, 3] = moment[:, :, 0]
        frame[:, :, 4] = (moment @ pitch_axis[:, :, None])[:, :, 0]
        frame[:, :, 5:8] = by_camera_point @ skew(in_camera) @ _right_jacobian(corrections[:, :3])[s.camera]
        frame[:, :, 8:11] = -by_robot_point
        frame[:, :, 11:15] = np.where(valid[:, None, None], by_lens, 0.0) / sigma[:, None, None]
        return Linear(
            residual,
            frame,
            by_point,
            valid,
            *self._linear_moves(poses, state),
            *self._linear_roofs(poses, R_stop, state),
        )

    def _linear_moves(self, poses: Floats, state: State) -> tuple[Floats, Floats, Floats, Floats]:
        measured = self.measured
        if len(measured) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, ODOMETRY))
        a, b = poses[self.before, :3], poses[self.after, :3]
        R_a_world = heading_matrix(a[:, 2]).transpose(0, 2, 1)
        shift = (R_a_world @ (b - a)[:, :2, None])[:, :, 0]
        residual = np.empty((len(a), 3))
        residual[:, :2] = shift - measured[:, :2]
        residual[:, 2] = wrap_angle(b[:, 2] - a[:, 2] - measured[:, 2])
        residual -= self.by_errors @ state.frame[-ODOMETRY:]
        after = np.zeros((len(a), 3, 3))
        after[:, :2, :2], after[:, 2, 2] = R_a_world, 1.0
        before = -after
        before[:, 0, 2], before[:, 1, 2] = shift[:, 1], -shift[:, 0]
        L = self.move_roots
        return (L @ residual[:, :, None])[:, :, 0], L @ before, L @ after, L @ -self.by_errors

    def _linear_roofs(self, poses: Floats, R_stop: Floats, state: State) -> tuple[Floats, Floats, Floats]:
        problem, roofs = self.problem, self.problem.roofs
        if len(roofs.stop) == 0:
            return np.zeros((0, 2)), np.zeros((0, 2, STOP)), np.zeros((0, 2, ROOF + BEACON))
        R, own = R_stop[roofs.stop], problem.roof_axes[roofs.camera]
        planes = state.frame[problem.roof_entry : problem.beacon_entry].reshape(-1, ROOF)[roofs.camera]
        shifts = state.frame[problem.beacon_entry : -ODOMETRY].reshape(-1, BEACON)[roofs.which]
        H = roofs.H_image_world + np.einsum("bk,bkij->bij", planes, own)
        beacon = roofs.beacon + np.column_stack([shifts, np.zeros(len(shifts))])
        arm = (R @ beacon[:, :, None])[:, :, 0]
        world = poses[roofs.stop, :2] + arm[:, :2]
        at = np.column_stack([world, np.ones(len(world))])
        h = (H @ at[:, :, None])[:, :, 0]
        pixels = h[:, :2] / h[:, 2:]
        by_world = (H[:, :2, :2] - pixels[:, :, None] * H[:, 2:, :2]) / h[:, 2:, None]
        step = np.einsum("bkij,bj->bik", own, at)
        by_plane = np.empty((len(world), 2, ROOF + BEACON))
        by_plane[:, :, :ROOF] = (step[:, :2] - pixels[:, :, None] * step[:, 2:]) / h[:, 2:, None]
        by_plane[:, :, ROOF:] = by_world @ R[:, :2, :2]
        by_stop = np.zeros((len(world), 2, STOP))
        by_stop[:, :, :2] = by_world
        by_stop[:, :, 2] = by_world[:, :, 0] * -arm[:, 1:2] + by_world[:, :, 1] * arm[:, 0:1]
        roll = poses[roofs.stop, 3]
        pitch_axis = np.column_stack([np.zeros(len(roll)), np.cos(roll), -np.sin(roll)])
        by_rotation = -(R @ skew(beacon))[:, :2]
        by_stop[:, :, 3] = (by_world @ by_rotation[:, :, :1])[:, :, 0]
        by_stop[:, :, 4] = (by_world @ by_rotation @ pitch_axis[:, :, None])[:, :, 0]
        sigma = roofs.sigma[:, None]
        return (pixels - roofs.uv) / sigma, by_stop / sigma[:, None], by_plane / sigma[:, None]

    def _known_residual(self, state: State) -> Floats:
        known, here = self.problem.known, self.known_here
        return np.asarray((state.points[known.label[here]] - known.position[here]) / known.sigma[here, None])

    def cost(self, linear: Linear, state: State, loss: Loss) -> float:
        """Half the sum of all losses at a linearised state."""
        rho, _ = loss((linear.residual**2).sum(axis=1))
        moves, _ = _cauchy((linear.move**2).sum(axis=1), loss.move_width)
        roofs, _ = _cauchy((linear.roof**2).sum(axis=1), loss.move_width)
        known, _ = _cauchy((self._known_residual(state) ** 2).sum(axis=1), loss.move_width)
        prior = self.information @ state.frame**2
        return 0.5 * float(self.sightings.probability @ rho + moves.sum() + roofs.sum() + known.sum() + prior)

    def normal(self, linear: Linear, state: State, loss: Loss) -> Normal:
        """Assemble the reweighted normal equations."""
        _, weight = loss((linear.residual**2).sum(axis=1))
        root = np.sqrt(weight * self.sightings.probability * linear.valid)
        kept, indices, starts = self._pattern
        r = (linear.residual * root[:, None]).ravel()
        rows, points = len(r), len(self.labels)
        by_frame = (linear.by_frame * root[:, None, None])[kept]
        J_frame = scipy.sparse.csr_matrix((by_frame, indices, starts), shape=(rows, self.size))
        by_point = linear.by_point * root[:, None, None]
        J_point = scipy.sparse.csr_matrix(
            (by_point.ravel(), (3 * np.repeat(self.point, 2)[:, None] + np.arange(3)).ravel(), 3 * np.arange(rows + 1)),
            shape=(rows, 3 * points),
        )
        J_frame_t = J_frame.T.tocsr()
        H = (J_frame_t @ J_frame).toarray()
        W = J_frame_t @ J_point
        V = np.zeros((points, 3, 3))
        np.add.at(V, self.point, by_point.transpose(0, 2, 1) @ by_point)
        gradient = J_frame_t @ r
        point_gradient = (J_point.T @ r).reshape(-1, 3)
        if len(self.known_here):
            residual = self._known_residual(state)
            _, weight = _cauchy((residual**2).sum(axis=1), loss.move_width)
            information = weight / self.problem.known.sigma[self.known_here] ** 2
            V[self.known_point] += information[:, None, None] * np.eye(3)
            point_gradient[self.known_point] += residual * (weight / self.problem.known.sigma[self.known_here])[:, None]
        self._add_moves(H, gradient, linear, loss)
        self._add_roofs(H, gradient, linear, loss)
        free = self.problem.free
        H[np.diag_indices(self.size)] += self.information[free]
        gradient += (self.information * state.frame)[free]
        return Normal(H, V, W, gradient, point_gradient)

    def _add_moves(self, H: Floats, gradient: Floats, linear: Linear, loss: Loss) -> None:
        if len(self.before) == 0:
            return
        _, weight = _cauchy((linear.move**2).sum(axis=1), loss.move_width)
        J = np.concatenate([linear.move_before, linear.move_after, linear.move_factor], axis=2)
        odometry = np.tile(np.arange(-ODOMETRY, 0) + len(self.columns), (len(J), 1))
        entries = np.concatenate(
            [STOP * self.before[:, None] + np.arange(3), STOP * self.after[:, None] + np.arange(3), odometry], axis=1
        )
        self._add(H, gradient, entries, J * weight[:, None, None], J, linear.move)

    def _add_roofs(self, H: Floats, gradient: Floats, linear: Linear, loss: Loss) -> None:
        if len(linear.roof) == 0:
            return
        _, weight = _cauchy((linear.roof**2).sum(axis=1), loss.move_width)
        J = np.concatenate([linear.roof_by_stop, linear.roof_by_plane], axis=2)
        entries = self.roof_entries
        self._add(H, gradient, entries, J * weight[:, None, None], J, linear.roof)

    def _add(self, H: Floats, gradient: Floats, entries: Ints, weighted: Floats, J: Floats, residual: Floats) -> None:
        """Add factors with dense derivatives (K, rows, entries) to the frame block."""
        columns = self.columns[entries]
        kept = columns >= 0
        blocks = weighted.transpose(0, 2, 1) @ J
        pair = kept[:, :, None] & kept[:, None, :]
        rows, cols = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
        np.add.at(H, (rows[pair], cols[pair]), blocks[pair])
        np.add.at(gradient, columns[kept], (weighted.transpose(0, 2, 1) @ residual[:, :, None])[:, :, 0][kept])

    def eliminate(self, normal: Normal, damping: float = 0.0) -> tuple[Floats, Floats, Any]:
        """Schur complement over the points: reduced matrix (n, n), inverse point blocks (l, 3, 3), and W V^-1."""
        V = normal.V.copy()
        diagonal = np.einsum("lii->li", V)
        diagonal += damping * diagonal + 1e-9 * diagonal.max(axis=1, initial=0.0, keepdims=True) + 1e-9
        V_inverse: Floats = np.asarray(np.linalg.inv(V), dtype=np.float64)
        points = len(V)
        blocks = scipy.sparse.bsr_matrix(
            (V_inverse, np.arange(points), np.arange(points + 1)), shape=(3 * points, 3 * points)
        ).tocsr()
        WV = normal.W @ blocks
        S = normal.H - (WV @ normal.W.T).toarray()
        S[np.diag_indices(self.size)] += damping * np.diagonal(normal.H) + 1e-9
        return S, V_inverse, WV

    def solve(
        self, state: State, loss: Loss, iterations: int = 30, tolerance: float = 1e-3, damping: float = 1e-4
    ) -> Solution:
        """Descend from a state until the predicted decrease of the cost falls below `tolerance`.

        Parameters
        ----------
        state : State
        loss : Loss
        iterations : int
            Most linearisations to make.
        tolerance : float
            In units of the cost; not relative, because the weak modes of scale and heading move the cost very little.
        damping : float
            To begin with, relative to the diagonal. Little where the state is near the optimum: damping holds up the
            weak modes most.
        """
        if self.kernel is None:
            return self.solve_reference(state, loss, iterations, tolerance, damping)
        frame, moved, cost, spent, converged = self.kernel.solve(
            state.frame,
            state.points[self.labels],
            SHAPES[loss.shape],
            loss.sigma_px,
            loss.width,
            loss.move_width,
            iterations,
            tolerance,
            damping,
        )
        points = state.points.copy()
        points[self.labels] = moved
        return Solution(replace(state, frame=frame, points=points), cost, spent, converged)

    def solve_reference(
        self, state: State, loss: Loss, iterations: int = 30, tolerance: float = 1e-3, damping: float = 1e-4
    ) -> Solution:
        """`solve` in numpy, whether or not there is a kernel."""
        linear = self.linearise(state, loss)
        cost = self.cost(linear, state, loss)
        normal = self.normal(linear, state, loss)
        for iteration in range(1, iterations + 1):
            step = self._step(normal, damping)
            if step is None:
                damping *= 10.0
                continue
            frame_step, point_step = step
            predicted = 0.5 * float(
                -frame_step @ normal.frame_gradient
                - (point_step * normal.point_gradient).sum()
                + damping * (frame_step**2 @ np.diagonal(normal.H))
                + damping * (point_step**2 * np.einsum("lii->li", normal.V)).sum()
            )
            trial = self._moved(state, frame_step, point_step)
            trial_linear = self.linearise(trial, loss)
            trial_cost = self.cost(trial_linear, trial, loss)
            if trial_cost <= cost + 1e-12 * abs(cost):
                ratio = (cost - trial_cost) / max(predicted, 1e-300)
                damping = max(damping * (0.1 if ratio > 0.5 else 0.5 if ratio > 0.1 else 2.0), 1e-9)
                state, linear, cost = trial, trial_linear, trial_cost
                if predicted < tolerance:
                    return Solution(state, cost, iteration, True)
                normal = self.normal(linear, state, loss)
            else:
                if predicted < tolerance:
                    return Solution(state, cost, iteration, True)
                damping = max(damping, 1e-6) * 10.0
                if damping > 1e8:
                    break
        return Solution(state, cost, iterations, False)

    def _step(self, normal: Normal, damping: float) -> tuple[Floats, Floats] | None:
        S, V_inverse, WV = self.eliminate(normal, damping)
        reduced = -normal.frame_gradient + WV @ normal.point_gradient.ravel()
        if self.size:
            try:
                factor = scipy.linalg.cho_factor(S, lower=True, check_finite=False)
            except np.linalg.LinAlgError:
                return None
            frame_step = scipy.linalg.cho_solve(factor, reduced, check_finite=False)
        else:
            frame_step = np.zeros(0)
        point_step = -(V_inverse @ normal.point_gradient[:, :, None])[:, :, 0] - (WV.T @ frame_step).reshape(-1, 3)
        if not (np.isfinite(frame_step).all() and np.isfinite(point_step).all()):
            return None
        return np.asarray(frame_step), np.asarray(point_step)

    def _moved(self, state: State, frame_step: Floats, point_step: Floats) -> State:
        frame, points = state.frame.copy(), state.points.copy()
        frame[self.problem.free] += frame_step
        points[self.labels] += point_step
        return replace(state, frame=frame, points=points)


def _cauchy(square: Floats, width: float) -> tuple[Floats, Floats]:
    if np.isinf(width):
        return square, np.ones_like(square)
    c = width**2
    return c * np.log1p(square / c), c / (c + square)


def _right_jacobian(rotation: Floats) -> Floats:
    """How a change of small rotation vectors (C, 3) turns the rotation: to third order, ample for corrections."""
    k = skew(rotation)
    return np.asarray(np.eye(3) - 0.5 * k + (k @ k) / 6.0)
