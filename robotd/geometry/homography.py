"""Homographies between an image and a plane, with their uncertainty. Thesis section 2.5, equations 30-35.

A homography has nine numbers and eight degrees of freedom. Here it is scaled to unit norm, and its covariance is the
(9, 9) matrix of rank eight of its numbers, row by row, in that scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..records import Floats

LEAST_POINTS = 4  # equation 33
DEGENERATE = 1e-7  # of the design matrix's singular values: below, three of four points lie on one line
STEPS = 30


@dataclass(frozen=True, slots=True, eq=False)
class Homography:
    """`matrix` (3, 3) takes points of the plane to pixels; `covariance` (9, 9) of its numbers."""

    matrix: Floats
    covariance: Floats

    @property
    def inverse(self) -> Floats:
        """(3, 3) from pixels to points of the plane."""
        return np.asarray(np.linalg.inv(self.matrix))

    def to_plane(self, pixels: ArrayLike, covariance: ArrayLike | None = None) -> tuple[Floats, Floats]:
        """Points of the plane (N, 2) and their covariances (N, 2, 2).

        Parameters
        ----------
        pixels : (N, 2) array
        covariance : (N, 2, 2) array, optional
            Of the pixels; default: they are exact, and what is left is the homography's own uncertainty.

        Notes
        -----
        The point x solves project(H x) = p, so that dx = (d project / dx)^-1 (dp - (d project / dH) dH).
        """
        p = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
        points = apply(self.inverse, p)
        by_point, by_matrix = jacobians(self.matrix, points)
        spread = by_matrix @ self.covariance @ np.swapaxes(by_matrix, 1, 2)
        if covariance is not None:
            spread = spread + np.asarray(covariance, dtype=np.float64)
        back = np.linalg.inv(by_point)
        return points, back @ spread @ np.swapaxes(back, 1, 2)

    def pixel_spread(self, points: ArrayLike) -> Floats:
        """(N, 2, 2) covariances of the pixels of points (N, 2) of the plane, by the homography's own uncertainty."""
        _, by_matrix = jacobians(self.matrix, np.asarray(points, dtype=np.float64).reshape(-1, 2))
        return by_matrix @ self.covariance @ np.swapaxes(by_matrix, 1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class HomographyFit:
    """A fitted homography, its residuals (N, 2) in px (seen less fitted) and their whitened sum of squares."""

    homography: Homography
    residual: Floats
    chi2: float
    freedom: int


def apply(H: ArrayLike, points: ArrayLike) -> Floats:
    """Points (N, 2) taken through a (3, 3) homography."""
    matrix, p = np.asarray(H, dtype=np.float64), np.asarray(points, dtype=np.float64).reshape(-1, 2)
    out = p @ matrix[:, :2].T + matrix[:, 2]
    return np.asarray(out[:, :2] / out[:, 2:])


def jacobians(H: ArrayLike, points: ArrayLike) -> tuple[Floats, Floats]:
    """Derivatives of `apply`: by the points (N, 2, 2), and by the nine numbers (N, 2, 9)."""
    matrix, p = np.asarray(H, dtype=np.float64), np.asarray(points, dtype=np.float64).reshape(-1, 2)
    whole = np.column_stack([p, np.ones(len(p))])
    out = whole @ matrix.T
    image, w = out[:, :2] / out[:, 2:], out[:, 2]
    by_point = (matrix[None, :2, :2] - image[:, :, None] * matrix[None, 2:, :2]) / w[:, None, None]
    by_matrix = np.zeros((len(p), 2, 9))
    by_matrix[:, 0, 0:3] = by_matrix[:, 1, 3:6] = whole / w[:, None]
    by_matrix[:, :, 6:9] = -image[:, :, None] * (whole / w[:, None])[:, None, :]
    return by_point, by_matrix


def direct(source: ArrayLike, target: ArrayLike) -> Floats:
    """The (3, 3) homography from (N, 2) to (N, 2) points by the direct linear transform, scaled to unit norm.

    It minimises an algebraic error, in coordinates normalised to centroid 0 and mean distance sqrt(2): a start for
    `fit`. Thesis equations 31-33; Hartley, In defense of the eight-point algorithm, PAMI 19(6), 1997.

    Raises
    ------
    ValueError
        Fewer than four points, or too many of them on one line.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.ndim != 2 or a.shape[1] != 2 or a.shape != b.shape:
        raise ValueError(f"need two arrays of points (N, 2), got {a.shape} and {b.shape}")
    if len(a) < LEAST_POINTS:
        raise ValueError(f"{len(a)} points; a homography needs {LEAST_POINTS} or more")
    A, B = _normaliser(a), _normaliser(b)
    p, q = apply(A, a), apply(B, b)
    rows = np.zeros((len(p), 2, 9))
    whole = np.column_stack([p, np.ones(len(p))])
    rows[:, 0, 0:3] = rows[:, 1, 3:6] = -whole
    rows[:, :, 6:9] = q[:, :, None] * whole[:, None, :]
    _, singular, vt = np.linalg.svd(rows.reshape(-1, 9))
    if singular[7] < DEGENERATE * singular[0]:
        raise ValueError("the points do not fix a homography: all but one of them lie on one line")
    H = np.linalg.inv(B) @ vt[-1].reshape(3, 3) @ A
    return _unit(H, a)


def fit(plane: ArrayLike, image: ArrayLike, sigma_px: ArrayLike = 1.0, sigma_plane: ArrayLike = 0.0) -> HomographyFit:
    """The homography from a plane to an image that fits best, with covariance.

    Minimised are the squared distances between seen and projected pixels over their variances, in which the plane
    points' uncertainty counts as the pixels that it makes.

    Parameters
    ----------
    plane, image : (N, 2) arrays
        Points of the plane, and undistorted pixels.
    sigma_px, sigma_plane : float or (N,) arrays
        Standard deviations per axis.

    Raises
    ------
    ValueError
        As `direct`.
    """
    x, p = np.asarray(plane, dtype=np.float64), np.asarray(image, dtype=np.float64)
    H = direct(x, p)
    # normalised on both sides, because the numbers of a homography differ by powers of ten
    X, P = _normaliser(x), _normaliser(p)
    a, b = apply(X, x), apply(P, p)
    H = _unit(P @ H @ np.linalg.inv(X), a)
    spread_px = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64) * P[0, 0], (len(a),)) ** 2
    spread_plane = np.broadcast_to(np.asarray(sigma_plane, dtype=np.float64) * X[0, 0], (len(a),)) ** 2
    normal, tangent, cost = np.eye(8), np.zeros((9, 8)), 0.0
    for _ in range(STEPS):
        by_point, by_matrix = jacobians(H, a)
        spread = spread_px[:, None, None] * np.eye(2) + spread_plane[:, None, None] * (
            by_point @ np.swapaxes(by_point, 1, 2)
        )
        whiten = np.linalg.inv(np.linalg.cholesky(spread))
        residual = (whiten @ (b - apply(H, a))[:, :, None]).ravel()
        *_, vt = np.linalg.svd(H.reshape(1, 9))
        tangent = vt[1:].T
        jacobian = (whiten @ by_matrix).reshape(-1, 9) @ tangent
        normal, cost = jacobian.T @ jacobian, float(residual @ residual)
        step = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(8), jacobian.T @ residual)
        H = _unit((H.ravel() + tangent @ step).reshape(3, 3), a)
        if float(np.abs(step).max()) < 1e-13:
            break
    spread9 = np.asarray(tangent @ np.linalg.pinv(normal) @ tangent.T, np.float64)
    matrix, covariance = rescaled(H, spread9, np.asarray(np.linalg.inv(P), np.float64), X)
    matrix = _unit(matrix, x)  # the covariance does not change with the sign
    return HomographyFit(Homography(matrix, covariance), p - apply(matrix, x), cost, max(0, 2 * len(x) - 8))


def rescaled(H: Floats, covariance: Floats, left: Floats, right: Floats) -> tuple[Floats, Floats]:
    """The homography left H right scaled to unit norm, and its covariance."""
    turn = np.kron(left, right.T)
    h = turn @ H.ravel()
    norm = float(np.linalg.norm(h))
    unit = h / norm
    scale = (np.eye(9) - np.outer(unit, unit)) / norm @ turn
    return unit.reshape(3, 3), scale @ covariance @ scale.T


def cross_error(pixels: ArrayLike, to_plane: ArrayLike) -> float:
    """How far cameras that see one point disagree: equation 35, in pixels, averaged over the ordered pairs.

    Parameters
    ----------
    pixels : (I, 2) array
        Where each of I >= 2 cameras sees the point.
    to_plane : (I, 3, 3) array
        Their homographies from undistorted pixels to the plane.
    """
    p, H = np.asarray(pixels, dtype=np.float64), np.asarray(to_plane, dtype=np.float64)
    count = len(p)
    if count < 2:
        raise ValueError(f"{count} cameras; a cross-camera error needs two or more")
    total = 0.0
    for i in range(count):
        for j in range(count):
            if i != j:
                total += float(np.linalg.norm(p[i] - apply(np.linalg.inv(H[i]) @ H[j], p[j : j + 1])[0]))
    return total / (count * (count - 1))


def _normaliser(points: Floats) -> Floats:
    """(3, 3) that moves (N, 2) points to centroid 0 and mean distance sqrt(2)."""
    centre = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.linalg.norm(points - centre, axis=1).mean()), 1e-12)
    return np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])


def _unit(H: Floats, points: Floats) -> Floats:
    """Unit norm, and the sign for which the points lie in front (w > 0)."""
    H = H / np.linalg.norm(H)
    return H if float(np.sum(points @ H[2, :2] + H[2, 2])) > 0.0 else -H
