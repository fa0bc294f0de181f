"""The least-squares core of a lens calibration: one lens, one board, its pose in each picture, fitted to corners.

Levenberg-Marquardt on the camera model that the robot itself uses (`geometry.camera.Camera`), so that what is fitted is
what is applied later, rays at more than 90 degrees from the axis included. The poses are eliminated block by block
(Schur complement): a picture costs the same whether there are ten or a hundred.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.transforms import rotation_matrix, skew
from ..records import CameraModel, Floats, Transform
from .board_shape import BoardShape

LensKind = Literal["brown-conrady", "rational", "fisheye"]
COEFFICIENTS: dict[LensKind, int] = {"brown-conrady": 5, "rational": 8, "fisheye": 4}
FOCALS = np.geomspace(0.2, 4.0, 12)  # of the longer side of the picture, tried as starts: 130 to 14 degrees of view
LEAST_POINTS = 6  # of a board, from which its pose is started
STEPS = 50
SETTLED = 1e-7  # relative fall of the cost at which a fit ends
MOST_DAMPING = 1e6
STRAY = 6.0  # times the scatter of its picture, or of all if more: a corner that was found in the wrong place
MOST_STRAY = 0.2  # of a picture's corners: more are no accident, and the picture itself is wrong
ROUNDS = 4
EXACT = 1e-9  # px: drawn pictures may have no error at all
NOWHERE = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Corners of one board in one picture.

    Attributes
    ----------
    name : str
        Of the picture, for messages.
    points : (N, 3) array
        On the board, metres; z is 0.
    pixels : (N, 2) array
        Where they are seen, u and v.
    """

    name: str
    points: Floats
    pixels: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """A lens and the boards' poses.

    Attributes
    ----------
    kind : str
    lens : (4 + K,) array
        fx, fy, cx, cy and the distortion coefficients in OpenCV's order.
    R, t : (P, 3, 3) and (P, 3) arrays
        Board axes to camera axes, metres.
    shape : (S,) array
        How the board deviates from a plane with square squares, see `BoardShape`; empty if it is taken as flat.
    residuals : (N, 2) array
        Fitted less seen, of all pictures in order, in pixels.
    cost : float
        Sum of their squares.
    information : (P, 4 + K + S, 4 + K + S) array
        What each picture tells of the lens and the shape, its pose eliminated, for corners of 1 px; empty where both
        were held.
    scores : (P, 4 + K + S) array
        Where each picture alone would move them: the gradient of half the cost. Their sum is 0 at the optimum.
    """

    kind: LensKind
    lens: Floats
    R: Floats
    t: Floats
    shape: Floats
    residuals: Floats
    cost: float
    information: Floats
    scores: Floats


def camera_model(kind: LensKind, lens: Floats, size: tuple[int, int], name: str = "camera") -> CameraModel:
    """The record of a lens (4 + K,), its pose not set."""
    fx, fy, cx, cy, *distortion = (float(value) for value in lens)
    model: Literal["brown-conrady", "fisheye"] = "fisheye" if kind == "fisheye" else "brown-conrady"
    return CameraModel(name, size, (fx, fy, cx, cy), NOWHERE, model=model, distortion=tuple(distortion))


def lens_jacobian(kind: LensKind, lens: Floats, points: Floats) -> Floats:
    """Derivatives (N, 2, 4 + K) of the pixels of points (N, 3) in camera axes by the lens.

    Equations 3 to 6 of the thesis with the rational denominator, or OpenCV's fisheye polynomial.
    """
    out = np.zeros((len(points), 2, len(lens)))
    out[:, 0, 2] = out[:, 1, 3] = 1.0
    x, y, z = points.T
    if kind == "fisheye":
        rho = np.hypot(x, y)
        angle = np.arctan2(rho, z)
        unit = points[:, :2] / np.maximum(rho, 1e-12)[:, None]
        powers = angle[:, None] ** np.arange(1, 10, 2)
        image = unit * (powers @ np.array([1.0, *lens[4:]]))[:, None]
        out[:, :, 4:] = unit[:, :, None] * powers[:, None, 1:]
    else:
        x, y = x / z, y / z
        xy, s = np.column_stack([x, y]), x * x + y * y
        k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([lens[4:], np.zeros(12 - len(lens))])
        below = 1.0 + s * (k4 + s * (k5 + s * k6))
        radial = (1.0 + s * (k1 + s * (k2 + s * k3))) / below
        image = xy * radial[:, None]
        image[:, 0] += 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
        image[:, 1] += p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
        for column, power in ((4, 1), (5, 2), (8, 3)):
            out[:, :, column] = xy * (s**power / below)[:, None]
        for column, power in zip(range(9, len(lens)), (1, 2, 3), strict=False):
            out[:, :, column] = -xy * (radial * s**power / below)[:, None]
        out[:, 0, 6], out[:, 1, 6] = 2.0 * x * y, s + 2.0 * y * y
        out[:, 0, 7], out[:, 1, 7] = s + 2.0 * x * x, 2.0 * x * y
    out[:, 0, 0], out[:, 1, 1] = image[:, 0], image[:, 1]
    out[:, :, 4:] *= lens[:2, None]
    return out


def fit_lens(kind: LensKind, views: Sequence[View], size: tuple[int, int]) -> LensFit | None:
    """Fit a lens without knowing anything of it; None if no start leads to one.

    Focal lengths are tried without distortion; from the best ones all is fitted together. A plane seen nearly
    frontally has two poses that look alike (Schweighofer and Pinz, PAMI 28(12), 2006): the other one is tried as well.
    """
    starts = []
    for focal in FOCALS * max(size):
        lens = np.array([focal, focal, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1), *[0.0] * COEFFICIENTS[kind]])
        start = _posed(kind, lens, views, size)
        if start is not None:
            starts.append(start)
    starts.sort(key=lambda start: start.cost)
    best: LensFit | None = None
    for start in starts[:2]:
        fit = refine(start, views, size)
        if best is None or fit.cost < best.cost:
            best = fit
    if best is None:
        return None
    again = _posed(kind, best.lens, views, size)
    if again is not None:
        again = refine(again, views, size)
        best = again if again.cost < best.cost else best
    return best


def pose_views(
    fit: LensFit, views: Sequence[View], size: tuple[int, int], board: BoardShape | None = None
) -> LensFit | None:
    """Poses of other pictures under the lens and the shape of a fit, which are held.

    None if the lens does not reach their corners.
    """
    start = _posed(fit.kind, fit.lens, views, size)
    return None if start is None else refine(replace(start, shape=fit.shape), views, size, True, board)


def without(fit: LensFit, keep: Sequence[int]) -> LensFit:
    """The fit as the start for some of its pictures."""
    return replace(fit, R=fit.R[list(keep)], t=fit.t[list(keep)])


def without_strays(
    views: Sequence[View], fits: dict[LensKind, LensFit], size: tuple[int, int]
) -> tuple[Sequence[View], dict[LensKind, LensFit]]:
    """The views without single corners that were found in the wrong place, and the fits to what is left.

    A corner goes if it is far off, by what most corners of its picture and of all pictures are, under the model that
    fits best; a picture that is wrong as a whole is kept, to be named.
    """
    for _ in range(ROUNDS):
        best = min(fits.values(), key=lambda fit: fit.cost)
        ends = np.cumsum([len(view.points) for view in views])[:-1]
        parts = [np.linalg.norm(part, axis=1) for part in np.split(best.residuals, ends)]
        usual = float(np.median(np.concatenate(parts)))
        kept = [part <= STRAY * max(float(np.median(part)), usual, EXACT) for part in parts]
        kept = [one if np.mean(one) >= 1.0 - MOST_STRAY else np.ones_like(one) for one in kept]
        if all(one.all() for one in kept):
            break
        views = [View(view.name, view.points[one], view.pixels[one]) for view, one in zip(views, kept, strict=True)]
        fits = {kind: refine(fit, views, size) for kind, fit in fits.items()}
    return views, fits


def bent(fit: LensFit, board: BoardShape) -> LensFit:
    """The fit of a flat board as the start of one whose shape is fitted, too."""
    return replace(fit, shape=np.zeros(len(board)))


@np.errstate(over="ignore", invalid="ignore")  # of a trial step that leaves where the model holds: it is not taken
def refine(
    start: LensFit,
    views: Sequence[View],
    size: tuple[int, int],
    hold_lens: bool = False,
    board: BoardShape | None = None,
) -> LensFit:
    """Minimise the sum of squared reprojection errors from a start, whose cost need not be known.

    Parameters
    ----------
    start : LensFit
    views : sequence of View
        As many as the start has poses.
    size : (width, height)
    hold_lens : bool
        Fit the poses alone.
    board : BoardShape or None
        Needed if the start has a shape.
    """
    lens, R, t, shape = start.lens, start.R, start.t, start.shape
    flat, pixels = np.concatenate([v.points for v in views]), np.concatenate([v.pixels for v in views])
    counts = [len(view.points) for view in views]
    of = np.repeat(np.arange(len(views)), counts)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    modes = np.zeros((len(flat), 3, 0)) if board is None or not len(shape) else board.modes(flat)
    points = flat + modes @ shape
    free, own = (0, 0) if hold_lens else (len(lens), len(lens) + len(shape))
    residuals = _residuals(start.kind, lens, R, t, points, pixels, of, size)
    cost = float(np.sum(residuals**2))
    damping = 1e-3
    A, a = np.zeros((len(views), own, own)), np.zeros((len(views), own))
    B, C = np.zeros((len(views), own, 6)), np.zeros((len(views), 6, 6))
    for _ in range(STEPS):
        turned = (R[of] @ points[:, :, None])[:, :, 0]
        X = turned + t[of]
        _, by_point, _ = Camera(camera_model(start.kind, lens, size)).project_jacobian(X)
        by_pose = np.concatenate([-by_point @ skew(turned), by_point], axis=2)
        by_lens = lens_jacobian(start.kind, lens, X)[:, :, :free]
        if own > free:
            by_lens = np.concatenate([by_lens, by_point @ (R[of] @ modes)], axis=2)
        A = np.add.reduceat(by_lens.transpose(0, 2, 1) @ by_lens, first)
        B = np.add.reduceat(by_lens.transpose(0, 2, 1) @ by_pose, first)
        C = np.add.reduceat(by_pose.transpose(0, 2, 1) @ by_pose, first)
        a = np.add.reduceat((by_lens.transpose(0, 2, 1) @ residuals[:, :, None])[:, :, 0], first)
        c = np.add.reduceat((by_pose.transpose(0, 2, 1) @ residuals[:, :, None])[:, :, 0], first)
        before, refused = cost, False
        while damping < MOST_DAMPING:
            step, steps = _solve(A.sum(axis=0), B, C, a.sum(axis=0), c, damping)
            if not float(a.sum(axis=0) @ step) + float(np.sum(c * steps)) > SETTLED * cost:
                damping = np.inf
                break
            trial, bend = lens.copy(), shape.copy()
            trial[:free] -= step[:free]
            bend[: own - free] -= step[free:]
            new_R, new_t, at = rotation_matrix(-steps[:, :3]) @ R, t - steps[:, 3:], flat + modes @ bend
            there = _residuals(start.kind, trial, new_R, new_t, at, pixels, of, size)
            now = float(np.sum(there**2))
            if now <= cost:  # false for NaN: the trial folds the lens over a corner
                lens, R, t, residuals, cost, shape, points = trial, new_R, new_t, there, now, bend, at
                damping = damping if refused else max(0.1 * damping, 1e-6)
                break
            damping, refused = 8.0 * damping, True
        if not before - cost > SETTLED * before:
            break
    along = B @ np.linalg.pinv(C, hermitian=True)
    information = A - along @ B.transpose(0, 2, 1)
    scores = a - (along @ c[:, :, None])[:, :, 0]
    return LensFit(start.kind, lens, R, t, shape, residuals, cost, information, scores)


def _residuals(
    kind: LensKind,
    lens: Floats,
    R: Floats,
    t: Floats,
    points: Floats,
    pixels: Floats,
    of: np.ndarray[tuple[int], np.dtype[np.int64]],
    size: tuple[int, int],
) -> Floats:
    """(N, 2) of all corners; NaN where the lens model does not hold."""
    if not (lens[:2] > 0.0).all() or not np.isfinite(lens).all():
        return np.full_like(pixels, np.nan)
    X = (R[of] @ points[:, :, None])[:, :, 0] + t[of]
    seen, _ = Camera(camera_model(kind, lens, size)).project(X)
    return np.asarray(seen - pixels)


def _solve(A: Floats, B: Floats, C: Floats, a: Floats, c: Floats, damping: float) -> tuple[Floats, Floats]:
    """The damped step of the lens (n,) and of the poses (P, 6)."""
    inverse = np.linalg.pinv(C * (1.0 + damping * np.eye(6)), hermitian=True)
    along = B @ inverse
    S = A * (1.0 + damping * np.eye(len(A))) - np.sum(along @ B.transpose(0, 2, 1), axis=0)
    right = a - np.sum(along @ c[:, :, None], axis=0)[:, 0]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))  # coefficients of r^6 are no smaller in effect than pixels
    step = scale * np.linalg.lstsq(S * np.outer(scale, scale), right * scale, rcond=1e-14)[0]
    back = c - (B.transpose(0, 2, 1) @ step[:, None])[:, :, 0]
    return step, (inverse @ back[:, :, None])[:, :, 0]


def _posed(kind: LensKind, lens: Floats, views: Sequence[View], size: tuple[int, int]) -> LensFit | None:
    """Every picture's board where this lens has it, of the two poses that look alike the better one."""
    camera = Camera(camera_model(kind, lens, size))
    pixels, ends = np.concatenate([v.pixels for v in views]), np.cumsum([len(v.points) for v in views])[:-1]
    rays, valid = camera.rays(pixels)
    ways: tuple[list[tuple[Floats, Floats]], ...] = ([], [])
    for view, ray, there in zip(views, np.split(rays, ends), np.split(valid, ends), strict=True):
        if there.sum() < LEAST_POINTS:
            return None
        facing = _facing(ray[there].mean(axis=0))  # a board at the side of a fisheye is not before the camera's plane
        ray = ray @ facing.T
        ok = there & (np.nan_to_num(ray[:, 2]) > 0.1)
        if ok.sum() < LEAST_POINTS:
            return None
        plain = ray[ok, :2] / ray[ok, 2:]
        done, turns, shifts, _ = cv2.solvePnPGeneric(
            view.points[ok], plain, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
        if not done:
            return None
        for way, k in zip(ways, (0, -1), strict=True):
            turn, shift = np.asarray(turns[k], np.float64).ravel(), np.asarray(shifts[k], np.float64).ravel()
            way.append((facing.T @ rotation_matrix(turn), facing.T @ shift))
    X = [view.points @ R.T + t for way in ways for view, (R, t) in zip(views, way, strict=True)]
    residuals = (camera.project(np.concatenate(X))[0].reshape(2, -1, 2) - pixels).transpose(1, 0, 2)
    parts = np.split(residuals, ends)
    costs = np.array([np.sum(part**2, axis=(0, 2)) for part in parts])
    costs[~np.isfinite(costs)] = np.inf
    if np.isinf(costs.min(axis=1)).any():
        return None
    better = np.argmin(costs, axis=1).tolist()
    poses = [ways[way][k] for k, way in enumerate(better)]
    together = np.concatenate([part[:, way] for part, way in zip(parts, better, strict=True)])
    R, t = np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])
    nothing = np.zeros((len(views), 0))
    cost = float(costs.min(axis=1).sum())
    return LensFit(kind, lens, R, t, np.zeros(0), together, cost, nothing[:, :, None], nothing)


def _facing(ray: Floats) -> Floats:
    """The rotation that takes a ray to the axis z by the shortest way."""
    axis = np.cross(ray, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return np.asarray(rotation_matrix(axis / sine * math.atan2(sine, float(ray[2]))))
