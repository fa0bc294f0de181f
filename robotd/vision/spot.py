"""Sub-pixel position of a small light, from the image of its amplitude.

The camera's curve is undone first, because gamma makes the gain of the light depend on the texture under it: fitted on
raw grey levels the position keeps a bias of 0.03 to 0.06 px, however long one looks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_ITERATIONS = 15
_WIDTH_LIMITS = (0.45, 4.0)  # px: narrower than a pixel's own response is a hot pixel, wider is no label


@dataclass(frozen=True, slots=True)
class Spot:
    """A fitted light: `u`, `v` and `width` (sigma) in px, `covariance` (2, 2) in px^2, `peak` in the image's unit."""

    u: float
    v: float
    covariance: Floats
    peak: float
    width: float

    @property
    def sigma(self) -> float:
        """Standard deviation per axis in pixels."""
        return float(np.sqrt(0.5 * np.trace(self.covariance)))


def light_table(gamma: float, steps: int) -> NDArray[np.float32]:
    """Linear light for grey values in `steps` equal steps from 0 to white, scaled so that white is 255."""
    return np.asarray(255.0 * np.linspace(0.0, 1.0, steps) ** gamma, np.float32)


def grey_difference(base: float, light: float, gamma: float) -> float:
    """Grey levels by which `light` raises a place whose linear light is `base`, clipped at white."""
    dark, bright = np.clip([base, base + light], 0.0, 255.0) / 255.0
    return float(255.0 * (bright ** (1.0 / gamma) - dark ** (1.0 / gamma)))


def fit_spot(image: Floats, variance: Floats, valid: NDArray[np.bool_], pitch: int = 1) -> Spot | None:
    """Fit a round Gaussian on a constant to the image of a light's amplitude.

    Parameters
    ----------
    image, variance : (K, L) array
        Amplitude per cell and its variance.
    valid : (K, L) bool array
        False where a cell must not count, for instance because it was clipped.
    pitch : int
        Pixels per cell; a cell is the mean of pitch x pitch pixels.

    Returns
    -------
    Spot or None
        Position relative to the centre of the patch's first pixel; the covariance is the inverse Fisher information
        (the Cramer-Rao bound), scaled up where the residuals are larger than the variance says. None if nothing
        like a spot is there.

    Notes
    -----
    Levenberg-Marquardt on peak, u, v, log width and constant. The Gaussian is evaluated at pixel centres and averaged
    over the cell.
    """
    weights = np.where(valid, 1.0 / np.maximum(variance, 1e-12), 0.0)
    if np.count_nonzero(weights) < 12:
        return None
    pixels = np.arange(image.shape[1] * pitch, dtype=float), np.arange(image.shape[0] * pitch, dtype=float)
    parameters = _start(image, valid, weights, pitch)
    damping = 1e-3
    residuals, jacobian = _model(parameters, image, pixels, pitch)
    cost = float(np.sum(weights * residuals**2))
    cells = int(np.count_nonzero(weights))
    for _ in range(_ITERATIONS):
        weighted = jacobian * weights.ravel()
        normal = weighted @ jacobian.T
        step = np.linalg.solve(normal + np.diag(damping * np.diag(normal) + 1e-12), weighted @ residuals.ravel())
        step[1:3] = np.clip(step[1:3], -1.0, 1.0)
        step[3] = np.clip(step[3], -0.5, 0.5)
        trial = parameters + step
        trial[3] = np.clip(trial[3], *np.log(_WIDTH_LIMITS))
        new_residuals, new_jacobian = _model(trial, image, pixels, pitch)
        new_cost = float(np.sum(weights * new_residuals**2))
        if new_cost <= cost:
            settled = cost - new_cost < 1e-6 * cost + 1e-9
            parameters, residuals, jacobian, cost = trial, new_residuals, new_jacobian, new_cost
            damping = max(damping * 0.2, 1e-7)
            if settled:
                break
        else:
            damping *= 8.0
    peak, u, v, log_width, _ = parameters
    if peak <= 0.0 or not (0.0 < u < image.shape[1] * pitch - 1.0 and 0.0 < v < image.shape[0] * pitch - 1.0):
        return None
    normal = (jacobian * weights.ravel()) @ jacobian.T
    scale: float = max(1.0, cost / max(1, cells - 5))
    covariance = np.linalg.inv(normal + np.diag(1e-9 * np.diag(normal) + 1e-15))[1:3, 1:3] * scale
    return Spot(float(u), float(v), covariance.astype(np.float64), float(peak), float(np.exp(log_width)))


def _start(image: Floats, valid: NDArray[np.bool_], weights: Floats, pitch: int) -> Floats:
    """First guess: constant from the border, centroid of what is well above it; clipped cells count as bright."""
    border = np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])
    constant = float(np.median(border))
    raised = np.where(valid, image - constant, 0.0)
    top = max(float(raised.max()), 1e-9)
    mass = np.where(valid, np.where(raised > 0.3 * top, raised, 0.0), top)
    rows, columns = ((np.arange(size) + 0.5) * pitch - 0.5 for size in image.shape)
    total = max(float(mass.sum()), 1e-12)
    u = float((mass.sum(axis=0) * columns).sum() / total)
    v = float((mass.sum(axis=1) * rows).sum() / total)
    peak = top * (1.3 if np.all(valid) else 2.0)
    return np.array([peak, u, v, np.log(1.1), constant])


def _model(parameters: Floats, image: Floats, pixels: tuple[Floats, Floats], pitch: int) -> tuple[Floats, Floats]:
    """Residuals (K, L) and the model's derivatives (5, K * L)."""
    peak, u, v, log_width, constant = parameters
    width = np.exp(log_width)

    def profile(places: Floats, centre: float) -> tuple[Floats, Floats, Floats]:
        x = (places - centre) / width
        bell = np.exp(-0.5 * x * x)
        parts = np.stack([bell, bell * x / width, bell * x * x])
        value, shift, widen = parts.reshape(3, -1, pitch).mean(axis=2)
        return value, shift, widen

    gu, du, wu = profile(pixels[0], u)
    gv, dv, wv = profile(pixels[1], v)
    spot = np.outer(gv, gu)
    jacobian = np.stack(
        [
            spot,
            peak * np.outer(gv, du),
            peak * np.outer(dv, gu),
            peak * (np.outer(gv, wu) + np.outer(wv, gu)),
            np.ones_like(spot),
        ]
    )
    return image - peak * spot - constant, jacobian.reshape(5, -1)
