"""Sub-pixel position of a small light, from the image of its amplitude.

The camera's curve is undone first, because gamma makes the gain of the light depend on the texture under it: fitted on
raw grey levels the position keeps a bias of 0.03 to 0.06 px, however long one looks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_ITERATIONS = 15
_GOOD = 1.3  # mean squared residual, in units of the variance, from which another start is tried
_WIDTH = np.log(1.1), 0.35  # mean and spread of log(px): without it a spot within 2x2 cells could be anywhere in them
_WIDTH_LIMITS = (0.45, 6.0)  # px: narrower than a pixel's own response is a hot pixel, wider is no label


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

    def moved(self, right: float, down: float) -> Spot:
        """The same, so many pixels further right and down."""
        return replace(self, u=self.u + right, v=self.v + down)


def light_table(gamma: float, steps: int) -> NDArray[np.float32]:
    """Linear light for grey values in `steps` equal steps from 0 to white, scaled so that white is 255."""
    return np.asarray(255.0 * np.linspace(0.0, 1.0, steps) ** gamma, np.float32)


def grey_difference(base: float, light: float, gamma: float) -> float:
    """Grey levels by which `light` raises a place whose linear light is `base`, clipped at white."""
    dark, bright = np.clip([base, base + light], 0.0, 255.0) / 255.0
    return float(255.0 * (bright ** (1.0 / gamma) - dark ** (1.0 / gamma)))


def grey_mean_bias(spot: Spot, dark: Floats, gamma: float, pitch: int) -> Floats:
    """Light (K, L) by which cells differ whose grey levels, not their light, are averaged over pitch x pitch pixels.

    `dark` (K, L) is their light without the spot's. The steeper a spot is within a cell, the less its mean grey level.
    """
    u, v = (np.arange(size * pitch) for size in dark.shape[::-1])
    bell_u, bell_v = (np.exp(-0.5 * ((x - at) / spot.width) ** 2) for x, at in ((u, spot.u), (v, spot.v)))
    added = spot.peak * np.outer(bell_v, bell_u)
    lit = np.maximum(dark, 0.5).repeat(pitch, axis=0).repeat(pitch, axis=1) + added

    def means(pixels: Floats) -> Floats:
        rows, columns = dark.shape
        return np.asarray(pixels.reshape(rows, pitch, columns, pitch).mean(axis=(1, 3)))

    return np.asarray(means(lit ** (1.0 / gamma)) ** gamma - means(lit))


def fit_spot(
    image: Floats, variance: Floats, valid: NDArray[np.bool_], pitch: int = 1, start: tuple[float, float] | None = None
) -> Spot | None:
    """Fit a round Gaussian on a constant to the image of a light's amplitude.

    Parameters
    ----------
    image, variance : (K, L) array
        Amplitude per cell and its variance.
    valid : (K, L) bool array
        False where a cell was clipped: there the light is at least as strong as the image says.
    pitch : int
        Pixels per cell; a cell is the mean of pitch x pitch pixels.
    start : (float, float), optional
        Where u, v may be, in pixels; without it the fit starts at the centroid of what is bright.

    Returns
    -------
    Spot or None
        Position relative to the centre of the patch's first pixel; the covariance is the inverse Fisher information
        (the Cramer-Rao bound), scaled up where the residuals are larger than the variance says. None if nothing
        like a spot is there.

    Notes
    -----
    Levenberg-Marquardt on peak, u, v, log width and constant. The Gaussian is evaluated at pixel centres and averaged
    over the cell. Clipped cells are censored observations: they count where the model falls below them. The width is
    drawn to what lenses do, weakly: it matters where cells tell nothing of it, and would leave the place open too.
    """
    if np.count_nonzero(valid) < 12:
        return None
    weights = 1.0 / np.maximum(variance, 1e-12)
    first, *others = _starts(image, valid, pitch, start)
    best = _descend(first, image, weights, valid, pitch)
    for guess in others if best[0] > _GOOD * np.count_nonzero(valid) else ():
        found = _descend(guess, image, weights, valid, pitch)
        if found[0] < best[0]:
            best = found
    cost, parameters, normal = best
    peak, u, v, log_width, _ = parameters
    if peak <= 0.0 or not (0.0 < u < image.shape[1] * pitch - 1.0 and 0.0 < v < image.shape[0] * pitch - 1.0):
        return None
    scale = max(1.0, cost / max(1, int(np.count_nonzero(valid)) - 5))
    covariance = np.linalg.inv(normal + np.diag(1e-9 * np.diag(normal) + 1e-15))[1:3, 1:3] * scale
    return Spot(float(u), float(v), covariance.astype(np.float64), float(peak), float(np.exp(log_width)))


def _descend(
    parameters: Floats, image: Floats, weights: Floats, valid: NDArray[np.bool_], pitch: int
) -> tuple[float, Floats, Floats]:
    """Least squares from a first guess: cost, parameters and the normal matrix (5, 5)."""
    pixels = np.arange(image.shape[1] * pitch, dtype=float), np.arange(image.shape[0] * pitch, dtype=float)
    counted, cost = weights, np.inf
    residuals, jacobian = _model(parameters, image, pixels, pitch)

    def weigh(residuals: Floats, log_width: float) -> tuple[Floats, float]:
        counted = np.where(valid | (residuals > 0.0), weights, 0.0)
        return counted, float(np.sum(counted * residuals**2) + ((log_width - _WIDTH[0]) / _WIDTH[1]) ** 2)

    usual = np.zeros((5, 5))
    usual[3, 3] = 1.0 / _WIDTH[1] ** 2
    counted, cost = weigh(residuals, parameters[3])
    damping = 1e-3
    for _ in range(_ITERATIONS):
        weighted = jacobian * counted.ravel()
        normal = weighted @ jacobian.T + usual
        downhill = weighted @ residuals.ravel()
        downhill[3] -= (parameters[3] - _WIDTH[0]) * usual[3, 3]
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), downhill)
        step[1:3] = np.clip(step[1:3], -1.0, 1.0)
        step[3] = np.clip(step[3], -0.5, 0.5)
        trial = parameters + step
        trial[3] = np.clip(trial[3], *np.log(_WIDTH_LIMITS))
        new_residuals, new_jacobian = _model(trial, image, pixels, pitch)
        new_counted, new_cost = weigh(new_residuals, trial[3])
        if new_cost <= cost:
            settled = cost - new_cost < 1e-6 * cost + 1e-9
            parameters, residuals, jacobian, counted, cost = trial, new_residuals, new_jacobian, new_counted, new_cost
            damping = max(damping * 0.2, 1e-7)
            if settled:
                break
        else:
            damping *= 8.0
    return cost, parameters, (jacobian * counted.ravel()) @ jacobian.T + usual


def _starts(image: Floats, valid: NDArray[np.bool_], pitch: int, start: tuple[float, float] | None) -> list[Floats]:
    """First guesses: constant from the border, centroid of what is well above it; clipped cells count as bright."""
    border = np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])
    constant = float(np.median(border))
    raised = np.where(valid, image - constant, 0.0)
    top = max(float(raised.max()), 1e-9)
    mass = np.where(valid, np.where(raised > 0.3 * top, raised, 0.0), top)
    rows, columns = ((np.arange(size) + 0.5) * pitch - 0.5 for size in image.shape)
    total = max(float(mass.sum()), 1e-12)
    peak = top * (1.3 if np.all(valid) else 2.0)
    u = float((mass.sum(axis=0) * columns).sum() / total)
    v = float((mass.sum(axis=1) * rows).sum() / total)
    guesses = [np.array([peak, u, v, np.log(1.1), constant])]
    if start is not None:
        guesses.append(np.array([peak, *start, np.log(1.1), constant]))
    return guesses


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
