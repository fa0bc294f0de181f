"""Where a beacon is, to a fraction of a pixel, while it stands or moves.

The frames of the last moments are cut out along the beacon's predicted path, so that in the cuts it stands still and
the floor moves. The model of a cut is background(x) + a s G(x - c), s the wave, G a round spot and c what the
prediction misses, a polynomial of time. The background, a constant and a drift for every pixel, is projected out, and
a, the spot's width and the polynomial are fitted to what remains of all pixels of all cuts (Golub and Pereyra, The
differentiation of pseudo-inverses and nonlinear least squares problems whose variables separate, SIAM J. Numer. Anal.
10, 1973). The camera's curve is undone first, because it makes the light's gain depend on the floor under it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .beacon_wave import Lock, Wave, lock
from .spot import fit_spot

Image = NDArray[np.uint8]
Path = Callable[[Floats], Floats]

REACH = 7  # px, half the side of a cut
WIDE = 13  # where the prediction is poor
AROUND = 5  # px from the beacon: what is beyond is not its light
DISTURBED = 3.0  # as much change around a beacon as usual is somebody who walks there
WHITE = 252  # grey levels, from which a pixel may be clipped
CUTS = 3  # times that cuts are made along a better path
SETTLED_PX = 0.3  # between what was cut and what was fitted: interpolation no longer matters
STEPS = 8
LEAST_FRAMES = 8
LEAST_LIT = 2.0  # frames' worth of light, and of darkness
FIRST_ERROR, LEAST_ERROR = 0.06, 0.02  # of the peak: by how much a compressed light differs from a spot
ERROR_PX = 4.0  # they are much alike over so many pixels (chroma: two, smoothed), so that fewer of them average out
WIDTHS = (0.45, 4.0)  # px: narrower is a hot pixel, wider is no LED


@dataclass(frozen=True, slots=True)
class Cuts:
    """(N, K, K) pieces of linear light along a path, and which of their pixels were not clipped."""

    light: NDArray[np.float32]
    valid: NDArray[np.bool_]

    def where(self, kept: NDArray[np.bool_]) -> Cuts:
        """The cuts of some of the frames, by an (N,) mask."""
        return Cuts(self.light[kept], self.valid[kept])


@dataclass(frozen=True, slots=True)
class Course:
    """A beacon's way through the picture: `coefficients` (3, 2) of 1, tau and tau^2, tau seconds after `t`, in px.

    Beyond `span` seconds from `t` it goes on in a straight line.
    """

    t: float
    coefficients: Floats
    span: float

    def __call__(self, times: Floats) -> Floats:
        """(N, 2) places at (N,) times."""
        tau = np.asarray(times) - self.t
        inside = np.clip(tau, -self.span, self.span)
        powers = np.stack([np.ones_like(tau), inside, inside**2], axis=1)
        slope = self.coefficients[1] + 2.0 * inside[:, None] * self.coefficients[2]
        return np.asarray(powers @ self.coefficients + (tau - inside)[:, None] * slope)


@dataclass(frozen=True, slots=True)
class Fitted:
    """A beacon's course around the time `t`.

    `place` (2,) px and `covariance` (2, 2) at `t`; `velocity` (2,) px/s and its covariance, both zero where it was not
    fitted; `lock` says how well the light follows the wave; `peak` (linear light, white is 255) and `width` (px) what
    it looks like; `clipped` that some of it was white.
    """

    t: float
    place: Floats
    covariance: Floats
    velocity: Floats
    velocity_covariance: Floats
    course: Course
    lock: Lock
    peak: float
    width: float
    clipped: bool
    frames: int


def cut(frames: Sequence[Image], path: Floats, table: NDArray[np.float32], reach: int = REACH) -> Cuts | None:
    """Cut squares of 2 reach + 1 pixels around (N, 2) places, bilinear; None if a place is too near the border.

    `table` (256,) gives the linear light of each grey level.
    """
    height, width = frames[0].shape
    if not np.isfinite(path).all():
        return None
    base = np.floor(path).astype(np.int64)
    part = (path - base).astype(np.float32)
    low = base.min(axis=0) - reach
    high = base.max(axis=0) + reach + 2
    if low.min() < 0 or high[0] > width or high[1] > height:
        return None
    size = 2 * reach + 2
    raw = np.stack(
        [
            frame[v - reach : v - reach + size, u - reach : u - reach + size]
            for frame, (u, v) in zip(frames, base.tolist(), strict=True)
        ]
    )
    light = table[raw]
    x, y = part[:, 0, None, None], part[:, 1, None, None]
    light = (1.0 - x) * light[:, :, :-1] + x * light[:, :, 1:]
    light = (1.0 - y) * light[:, :-1] + y * light[:, 1:]
    white = raw >= WHITE
    return Cuts(light, ~(white[:, :-1, :-1] | white[:, 1:, :-1] | white[:, :-1, 1:] | white[:, 1:, 1:]))


def undisturbed(light: NDArray[np.float32] | Image) -> NDArray[np.bool_]:
    """(N,) which of (N, K, K) cuts show the surroundings that most of them show: nobody walks over the beacon.

    All of them, if too few would be left to say what is usual.
    """
    around = light[:, _away(light.shape[1]) >= AROUND]
    change = np.abs(around - np.median(around, axis=0)).mean(axis=1)
    kept = np.asarray(change < DISTURBED * np.median(change) + 1.0)
    return kept if np.count_nonzero(kept) >= max(LEAST_FRAMES, 0.5 * len(kept)) else np.ones(len(kept), np.bool_)


def fit_beacon(
    frames: Sequence[Image],
    t: Floats,
    path: Path,
    wave: Wave,
    starts: Floats,
    table: NDArray[np.float32],
    *,
    exposure: float,
    row_time: float,
    order: int,
    reach: int = REACH,
) -> Fitted | None:
    """Fit one beacon's course to a few frames.

    Parameters
    ----------
    frames : sequence of N (H, W) uint8 images
    t : (N,) array
        When their exposures began (first row), seconds.
    path : callable
        From (M,) times to (M, 2) predicted places in px.
    wave : Wave
    starts : (S,) array
        Seconds at which the LED may have been switched on.
    table : (256,) array
        Linear light of the grey levels.
    exposure, row_time : float
        Seconds.
    order : int
        Of the polynomial by which the path may be wrong: 0 (it stands), 1 or 2.
    reach : int
        Half the side of the cuts in px.

    Returns
    -------
    Fitted or None
        None if there are too few frames, too little light or darkness among them, the path leaves the picture, or
        nothing like a spot is there.
    """
    if len(frames) < LEAST_FRAMES:
        return None
    places = path(t)
    begun = t + row_time * places[:, 1]
    lit = begun + 0.5 * exposure
    middle = float(lit.mean())
    correction = np.zeros((3, 2))
    found: _Fit | None = None
    tau = lit - middle
    for _ in range(CUTS):
        cuts = cut(frames, places + np.stack([tau**0, tau, tau**2], axis=1) @ correction, table, reach)
        if cuts is None:
            return None
        kept = undisturbed(cuts.light)
        cuts = cuts.where(kept)
        locked = lock(_series(cuts.light), begun[kept], wave, starts)
        s = wave(begun[kept] - locked.start)
        if locked.amplitude <= 0.0 or not LEAST_LIT <= s.sum() <= len(s) - LEAST_LIT:
            return None
        found = _fit_cuts(cuts, s, tau[kept], order, found)
        if found is None:
            return None
        moved = np.stack([tau**0, tau, tau**2], axis=1) @ found.miss
        correction = correction + found.miss
        if float(np.abs(moved).max()) < SETTLED_PX:
            break
        starts = locked.start + np.array([-0.01, -0.005, 0.0, 0.005, 0.01])
        reach = REACH
    assert found is not None
    assert cuts is not None
    shift = 0.5 * exposure + row_time * float(places[:, 1].mean())
    whole = _course(path, middle, float(np.abs(tau).max()), shift, correction)
    # the place is known best in the middle of the light, not of the window
    at = float(np.clip(found.best, tau[0], tau[-1]))
    powers = np.zeros((2, 6))
    powers[0, :3] = powers[1, 3:] = (1.0, at, at * at)
    slopes = np.zeros((2, 6))
    slopes[0, :3] = slopes[1, 3:] = (0.0, 1.0, 2.0 * at)
    moving = order > 0
    return Fitted(
        t=middle + at,
        place=_places(path, middle, np.array([at]), shift, correction)[0],
        covariance=powers @ found.covariance @ powers.T,
        velocity=(whole.coefficients[1] + 2.0 * at * whole.coefficients[2]) if moving else np.zeros(2),
        velocity_covariance=slopes @ found.covariance @ slopes.T,
        course=whole,
        lock=locked,
        peak=found.peak,
        width=found.width,
        clipped=not bool(cuts.valid.all()),
        frames=len(cuts.light),
    )


def _places(path: Path, middle: float, tau: Floats, shift: float, correction: Floats) -> Floats:
    """(N, 2) corrected places, tau after the middle; the light falls `shift` after the begin of a frame."""
    powers = np.stack([np.ones_like(tau), tau, tau**2], axis=1)
    return np.asarray(path(middle + tau - shift) + powers @ correction)


def _course(path: Path, middle: float, half: float, shift: float, correction: Floats) -> Course:
    """The corrected path over the window as one polynomial."""
    tau = np.linspace(-half, half, 7)
    powers = np.stack([np.ones(7), tau, tau**2], axis=1)
    fit, *_ = np.linalg.lstsq(powers, _places(path, middle, tau, shift, correction), rcond=None)
    return Course(middle, np.asarray(fit), half)


@dataclass(frozen=True, slots=True)
class _Fit:
    """`miss` (3, 2) polynomial, covariance (6, 6) of its u then v coefficients, and the time where it is smallest."""

    miss: Floats
    covariance: Floats
    best: float
    peak: float
    width: float


def _fit_cuts(cuts: Cuts, s: Floats, tau: Floats, order: int, before: _Fit | None) -> _Fit | None:
    """Fit peak, log width and the polynomial; background projected out.

    However long one looks, a compressed light is no Gaussian spot: what JPEG makes of it, in chroma above all, stays
    the same as long as it stands. That error is the same share of the light everywhere, so that it is added to the
    noise of every pixel; else the quietest pixels, which are at the spot's foot and blocky, would place it.
    """
    n, size, _ = cuts.light.shape
    reach = (size - 1) // 2
    back = np.stack([np.ones(n), tau], axis=1)
    back, _ = np.linalg.qr(back)

    def projected(rows: Floats) -> Floats:
        return rows - back @ (back.T @ rows)

    y = projected(cuts.light.reshape(n, -1).astype(np.float64))
    lit = s - back @ (back.T @ s)
    energy = float(lit @ lit)
    image = (lit @ y / energy).reshape(size, size)
    noise = np.maximum((y**2).sum(axis=0) - energy * image.ravel() ** 2, 0.0) / max(1, n - 3)
    noise = np.maximum(noise, 0.25 * np.median(noise)) + 1e-3
    valid = np.asarray(cuts.valid.all(axis=0), np.bool_)
    if before is None:
        spot = fit_spot(image, (noise / energy).reshape(size, size), valid)
        if spot is None or spot.peak <= 0.0:
            return None
        start = np.array([spot.peak, np.log(spot.width), spot.u - reach, spot.v - reach])
    else:
        start = np.array([before.peak, np.log(before.width), 0.0, 0.0])
    powers = np.stack([tau**k for k in range(order + 1)])
    parameters = np.zeros(2 + 2 * (order + 1))
    parameters[:2], parameters[2], parameters[3 + order] = start[:2], start[2], start[3]
    pixels = np.arange(-reach, reach + 1, dtype=np.float64)

    def model(values: Floats) -> tuple[Floats, Floats]:
        """Residuals (N, K^2) and Jacobian (P, N, K^2)."""
        peak, width = values[0], float(np.exp(values[1]))
        u, v = values[2 : 3 + order] @ powers, values[3 + order :] @ powers
        du, dv = pixels[None, None, :] - u[:, None, None], pixels[None, :, None] - v[:, None, None]
        bell = s[:, None, None] * np.exp(-0.5 * (du**2 + dv**2) / width**2)
        by_u, by_v = peak * bell * du / width**2, peak * bell * dv / width**2
        columns = [bell, peak * bell * (du**2 + dv**2) / width**2]
        columns += [by_u * power[:, None, None] for power in powers] + [by_v * power[:, None, None] for power in powers]
        flat = np.stack([projected(column.reshape(n, -1)) for column in columns])
        return y - peak * flat[0], flat

    error = FIRST_ERROR * parameters[0]
    for last in (False, True):
        weight = np.where(valid.ravel(), 1.0 / np.sqrt(noise + energy * error**2), 0.0)
        parameters, residual, jacobian = _descend(parameters, model, weight)
        if not last:  # how far the image of the light is from a spot, beyond what noise explains
            beyond = ((lit @ residual / energy) ** 2 - noise / energy)[valid.ravel()].mean()
            error = max(LEAST_ERROR * parameters[0], ERROR_PX * np.sqrt(max(float(beyond), 0.0)))
    jacobian = (jacobian * weight).reshape(len(parameters), -1)
    cost = float(((residual * weight) ** 2).sum())
    miss = np.zeros((3, 2))
    miss[: order + 1, 0], miss[: order + 1, 1] = parameters[2 : 3 + order], parameters[3 + order :]
    if parameters[0] <= 0.0 or float(np.abs(powers.T @ miss[: order + 1]).max()) > reach:
        return None
    spread = np.linalg.pinv(jacobian @ jacobian.T)[2:, 2:] * max(1.0, cost / max(1, residual.size - size * size))
    covariance = np.zeros((6, 6))
    kept = [k for k in range(6) if k % 3 <= order]
    covariance[np.ix_(kept, kept)] = spread
    best = 0.0 if order == 0 else -float(spread[0, 1] / spread[1, 1])
    return _Fit(miss, covariance, best, float(parameters[0]), float(np.exp(parameters[1])))


def _descend(
    parameters: Floats, model: Callable[[Floats], tuple[Floats, Floats]], weight: Floats
) -> tuple[Floats, Floats, Floats]:
    """Levenberg-Marquardt from a first guess: parameters, residuals and Jacobian, these two not weighted."""
    damping = 1e-3
    residual, jacobian = model(parameters)
    cost = float(((residual * weight) ** 2).sum())
    for _ in range(STEPS):
        weighted = (jacobian * weight).reshape(len(parameters), -1)
        normal = weighted @ weighted.T
        step = np.linalg.solve(
            normal + np.diag(damping * np.diag(normal) + 1e-12), weighted @ (residual * weight).ravel()
        )
        step[1] = np.clip(step[1], -0.4, 0.4)
        trial = parameters + step
        trial[1] = np.clip(trial[1], *np.log(WIDTHS))
        new_residual, new_jacobian = model(trial)
        new_cost = float(((new_residual * weight) ** 2).sum())
        if new_cost <= cost:
            settled = cost - new_cost < 1e-4 * cost / residual.size + 1e-9
            parameters, residual, jacobian, cost = trial, new_residual, new_jacobian, new_cost
            damping = max(0.2 * damping, 1e-9)
            if settled:
                break
        else:
            damping *= 10.0
    return parameters, residual, jacobian


def _series(light: NDArray[np.float32]) -> Floats:
    """(N,) light in the middle of the cuts, less that around it."""
    size = light.shape[1]
    reach = (size - 1) // 2
    far = _away(size)
    inner, outer = far <= reach - 5, far >= reach - 1
    return np.asarray(light[:, inner].mean(axis=1) - np.median(light[:, outer], axis=1), np.float64)


def _away(size: int) -> NDArray[np.int64]:
    """(size, size) steps of a king from the middle of a square."""
    steps = np.abs(np.arange(size) - (size - 1) // 2)
    return np.maximum(steps[:, None], steps[None, :])
