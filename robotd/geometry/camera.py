"""Calibrated cameras: points in camera axes to pixels, and pixels back to rays.

Lens models are OpenCV's: Brown-Conrady (k1 k2 p1 p2 k3 [k4 k5 k6]) and fisheye (k1 k2 k3 k4); thesis section 2.1,
equations 3-6 with errata A2-A4. A polynomial lens model folds over at some radius: beyond it two different directions
share a pixel, and inverting the model gives a wrong ray without any sign of it. `Camera` finds that radius once and
refuses points and pixels outside it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from ..records import CameraModel, Floats
from .transforms import transform_matrix

_MARGIN = 0.999  # of the fold radius, because the model is not invertible on the fold itself
_WIDEST = 60.0  # tan 89 degrees: a pinhole image of more has no practical use
_ITERATIONS = 60  # bisection alone would reach double precision in about this many


class Camera:
    """One camera of the rig, ready to compute.

    Parameters
    ----------
    model : CameraModel
        Calibration as stored in a survey.

    Attributes
    ----------
    name : str
    size : (width, height) in pixels
    focal, centre : (2,) array
        fx, fy and cx, cy in pixels; pixel (0, 0) is the centre of the first pixel.
    T_robot_camera : (4, 4) array
    limit : float
        Largest radius at which the lens model is one-to-one: x/z, y/z for brown-conrady, the angle from the optical
        axis in radians for fisheye.

    Raises
    ------
    ValueError
        If the model is not known, a focal length is not positive, or the number of coefficients does not fit.
    """

    def __init__(self, model: CameraModel) -> None:
        fx, fy, cx, cy = model.matrix
        counts = {"brown-conrady": (0, 4, 5, 8), "fisheye": (0, 4)}.get(model.model)
        if counts is None:
            raise ValueError(
                f"camera {model.name}: unknown lens model {model.model!r}; expected brown-conrady or fisheye"
            )
        if len(model.distortion) not in counts:
            raise ValueError(
                f"camera {model.name}: {len(model.distortion)} distortion coefficients; {model.model} has {counts[1:]}"
            )
        if not (fx > 0.0 and fy > 0.0):
            raise ValueError(f"camera {model.name}: focal lengths must be positive, got {fx} and {fy} px")
        self.model = model
        self.name = model.name
        self.size = model.size
        self.focal: Floats = np.array([fx, fy])
        self.centre: Floats = np.array([cx, cy])
        self.T_robot_camera = transform_matrix(model.T_robot_camera)
        self._fisheye = model.model == "fisheye"
        padded = np.zeros(8)
        padded[: len(model.distortion)] = model.distortion
        self._coefficients: Floats = padded
        k1, k2, p1, p2, k3, k4, k5, k6 = padded
        if self._fisheye:
            # f(angle) = angle N(angle^2), here with the four fisheye coefficients
            self._numerator, self._denominator = Polynomial([1.0, *padded[:4]]), Polynomial([1.0])
        else:
            # f(r) = r N(r^2) / D(r^2)
            self._numerator, self._denominator = Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
        self._tangential = (float(p1), float(p2)) if not self._fisheye else (0.0, 0.0)
        self.limit = self._fold() * _MARGIN
        self._image_limit = float(self._radial(np.array([self.limit]))[0])

    def __repr__(self) -> str:
        return f"Camera({self.name!r})"

    def project(self, points: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
        """Pixels of points.

        Parameters
        ----------
        points : (N, 3) array
            In camera axes, metres.

        Returns
        -------
        pixels : (N, 2) array
            u, v; NaN where not valid. They may lie outside the image: see `in_image`.
        valid : (N,) bool array
            The point is in front of the camera and inside the radius where the lens model is one-to-one.
        """
        pixels, _, valid = self._project(_rows(points, 3, "points"), derivatives=False)
        return pixels, valid

    def project_jacobian(self, points: ArrayLike) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Pixels (N, 2), their derivatives (N, 2, 3) by the points' coordinates, and validity; see `project`."""
        return self._project(_rows(points, 3, "points"), derivatives=True)

    def rays(self, pixels: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
        """Viewing rays of pixels.

        Parameters
        ----------
        pixels : (N, 2) array
            u, v as seen in the raw image.

        Returns
        -------
        rays : (N, 3) array
            Unit vectors in camera axes; NaN where not valid.
        valid : (N,) bool array
            False beyond the radius where the lens model can be inverted.
        """
        uv = _rows(pixels, 2, "pixels")
        distorted = (uv - self.centre) / self.focal
        radius = np.hypot(distorted[:, 0], distorted[:, 1])
        valid = (radius <= self._image_limit) & self._inside_valid_radius(uv)
        target = np.where(valid, radius, 0.0)
        inner = self._invert_radial(target)
        direction = np.divide(distorted, radius[:, None], out=np.zeros_like(distorted), where=radius[:, None] > 0.0)
        if self._fisheye:
            rays = np.column_stack([np.sin(inner)[:, None] * direction, np.cos(inner)])
        else:
            # the radial inverse starts Newton's method, which then accounts for the tangential terms
            xy, error = self._newton(inner[:, None] * direction, np.where(valid[:, None], distorted, 0.0))
            valid &= (error < 1e-9) & (np.hypot(xy[:, 0], xy[:, 1]) <= self.limit)
            rays = np.column_stack([xy, np.ones(len(xy))])
            rays /= np.linalg.norm(rays, axis=1)[:, None]
        rays[~valid] = np.nan
        return rays, valid

    def in_image(self, pixels: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which pixels (N, 2) lie in the image, at least `margin` pixels from its border; NaN does not."""
        uv = _rows(pixels, 2, "pixels")
        low, high = -0.5 + margin, np.array(self.size) - 0.5 - margin
        return np.asarray(((uv >= low) & (uv <= high)).all(1))

    def _project(self, points: Floats, derivatives: bool) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        image, inner, jacobian = (self._fisheye_image if self._fisheye else self._pinhole_image)(points, derivatives)
        pixels = self.focal * image + self.centre
        # a NaN coordinate compares false, so that it is refused as well
        valid = (inner <= self.limit) & self._inside_valid_radius(pixels)
        if not self._fisheye:
            valid &= points[:, 2] > 1e-9
        pixels = np.where(valid[:, None], pixels, np.nan)
        return pixels, self.focal[:, None] * jacobian, valid

    def _inside_valid_radius(self, pixels: Floats) -> NDArray[np.bool_]:
        if self.model.valid_radius_px is None:
            return np.ones(len(pixels), dtype=np.bool_)
        return np.asarray(np.linalg.norm(pixels - self.centre, axis=1) <= self.model.valid_radius_px)

    def _pinhole_image(self, points: Floats, derivatives: bool) -> tuple[Floats, Floats, Floats]:
        depth = np.where(points[:, 2] > 1e-9, points[:, 2], 1.0)
        xy = points[:, :2] / depth[:, None]
        image, by_xy = self._distort(xy, derivatives)
        jacobian = np.zeros((len(points) if derivatives else 0, 2, 3))
        if derivatives:
            jacobian[:, :, :2] = by_xy / depth[:, None, None]
            jacobian[:, :, 2] = -(jacobian[:, :, :2] @ xy[:, :, None])[:, :, 0]
        return image, np.hypot(xy[:, 0], xy[:, 1]), jacobian

    def _distort(self, xy: Floats, derivatives: bool) -> tuple[Floats, Floats]:
        """Equation 6 on normalised coordinates (N, 2), and its (N, 2, 2) derivative."""
        p1, p2 = self._tangential
        x, y = xy[:, 0], xy[:, 1]
        s = x * x + y * y
        numerator, denominator = self._numerator(s), self._denominator(s)
        radial = numerator / denominator
        image = xy * radial[:, None]
        image[:, 0] += 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x)
        image[:, 1] += p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y
        if not derivatives:
            return image, np.empty((0, 2, 2))
        slope = (self._numerator.deriv()(s) - radial * self._denominator.deriv()(s)) / denominator
        jacobian = np.empty((len(xy), 2, 2))
        cross = 2.0 * slope * x * y + 2.0 * (p1 * x + p2 * y)
        jacobian[:, 0, 0] = radial + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        jacobian[:, 0, 1] = jacobian[:, 1, 0] = cross
        jacobian[:, 1, 1] = radial + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return image, jacobian

    def _fisheye_image(self, points: Floats, derivatives: bool) -> tuple[Floats, Floats, Floats]:
        x, y, z = points.T
        rho = np.hypot(x, y)
        angle = np.arctan2(rho, z)
        distance = np.where(rho > 0.0, rho, 1.0)
        image_radius = self._radial(angle)
        near = rho < 1e-12  # on the axis the image radius grows as rho / z
        ratio = np.where(near, 1.0 / np.where(z > 0.0, z, 1.0), image_radius / distance)
        image = points[:, :2] * ratio[:, None]
        jacobian = np.zeros((len(points) if derivatives else 0, 2, 3))
        if derivatives:
            unit = points[:, :2] / distance[:, None]
            slope = self._radial_slope(angle)
            square = np.maximum(rho * rho + z * z, 1e-300)
            along = np.where(near, 0.0, slope * z / square - ratio)
            jacobian[:, :, :2] = ratio[:, None, None] * np.eye(2) + along[:, None, None] * (
                unit[:, :, None] * unit[:, None]
            )
            jacobian[:, :, 2] = -(slope * rho / square)[:, None] * unit
        return image, angle, jacobian

    def _radial(self, inner: Floats) -> Floats:
        s = inner * inner
        return np.asarray(inner * self._numerator(s) / self._denominator(s))

    def _radial_slope(self, inner: Floats) -> Floats:
        s = inner * inner
        numerator, denominator = self._numerator(s), self._denominator(s)
        turn = self._numerator.deriv()(s) * denominator - numerator * self._denominator.deriv()(s)
        return np.asarray(numerator / denominator + 2.0 * s * turn / denominator**2)

    def _fold(self) -> float:
        """First radius at which the radial function stops growing or breaks down."""
        n, d = self._numerator, self._denominator
        square = Polynomial([0.0, 2.0])
        slope = n * d + square * (n.deriv() * d - n * d.deriv())
        widest = float(np.pi) / _MARGIN if self._fisheye else _WIDEST
        roots = np.concatenate([_roots(slope), _roots(d)])
        real = roots[(np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots.real))) & (roots.real > 0.0)].real
        return min(widest, float(np.sqrt(real.min()))) if len(real) else widest

    def _invert_radial(self, target: Floats) -> Floats:
        return _invert_monotone(self._radial, self._radial_slope, target, self.limit)

    def _newton(self, xy: Floats, distorted: Floats) -> tuple[Floats, Floats]:
        """Refine (N, 2) normalised coordinates until they distort to `distorted`; also the error that remains."""
        for _ in range(10):
            image, jacobian = self._distort(xy, derivatives=True)
            error = image - distorted
            if not np.any(np.abs(error) > 1e-14):
                break
            (a, b), (c, d) = np.moveaxis(jacobian, 0, -1)
            determinant = a * d - b * c
            determinant = np.where(np.abs(determinant) > 1e-12, determinant, np.inf)
            step = np.stack([d * error[:, 0] - b * error[:, 1], a * error[:, 1] - c * error[:, 0]], -1)
            xy = xy - step / determinant[:, None]
        image, _ = self._distort(xy, derivatives=False)
        return xy, np.abs(image - distorted).max(axis=1, initial=0.0)


def _invert_monotone(
    function: Callable[[Floats], Floats], slope: Callable[[Floats], Floats], target: Floats, upper: float
) -> Floats:
    """Solve function(x) = target for x in [0, upper], function increasing; Newton's method kept inside a bracket."""
    low, high = np.zeros_like(target), np.full_like(target, upper)
    x = np.clip(target, 0.0, upper)
    for _ in range(_ITERATIONS):
        error = function(x) - target
        low, high = np.where(error <= 0.0, x, low), np.where(error >= 0.0, x, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = x - error / slope(x)
        after = np.where((step > low) & (step < high), step, 0.5 * (low + high))
        after = np.where(error == 0.0, x, after)
        if not np.any(np.abs(after - x) > 1e-15 * (1.0 + x)):
            break
        x = after
    return x


def _roots(polynomial: Polynomial) -> NDArray[np.complex128]:
    trimmed = polynomial.trim(tol=1e-15)
    return np.asarray(trimmed.roots(), dtype=np.complex128)


def _rows(values: ArrayLike, width: int, what: str) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"need {what} of shape (N, {width}), got {array.shape}")
    return array
