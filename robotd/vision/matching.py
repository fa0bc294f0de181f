"""Which light curves follow the pattern: a generalised likelihood ratio test that people and shake do not upset.

For every start and number of periods the pattern's best amplitude is compared with darkness, with noise of unknown
strength. Frames in which somebody stands before the place, or which fit neither, count for neither; what the shift of
the picture explains is taken off first. Steady blinking at other rates is a rival hypothesis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import blink_reference
from .pattern import FlashPattern, Look, Template

try:
    from . import _blink as kernels
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    kernels = blink_reference  # type: ignore[misc]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

_LEAST = 0.01  # energy per frame below which a pattern hardly touches the window
_HIDDEN = 0.02  # relative change of the light around a place that says somebody stands before it,
_SPREADS = 5.0  # beyond so many of its usual spreads
_STEPS = 2.0  # typical steps between frames, of which its usual spread has no more
_LEAST_SEEN = 0.4  # of the frames that are known
_OUTLIER = 4.5  # spreads of the residual
_ENOUGH = 0.3  # of a period's energy that must be within the window, to count by itself
_CARRIES, _LACKS = 0.5, 0.25  # of the light that is expected in a period: it carries the pattern, or lacks it
_CLEAN, _SEVERAL = 0.08, 3  # of the energy, left by so many flashes: they need no second period
_LOOK_S, _LOOK_PITCH_S = 0.03, 0.0015  # starts so far from the best match are weighed, at this pitch
_PROMISING = 12.0  # explained energy of a place, relative to a frame's, from which its start is refined,
_BESIDE, _FINE = 0.75, 0.2  # within so many steps of the search, to such a part of a step
_PITCH = 2.0  # 1/s, times the square of a flash's length is that step: half exposed frames are much of a short flash
_LIKELY = 10.0  # score from which a place is compared with steady blinking, of so many harmonics
_HARMONICS = 3
_ALIKE = 0.7  # of the pattern's energy: steady blinking that explains so much is the pattern
_CRUDE = 0.04  # of the light, that a half exposed frame is off by
_MOST_OUTLIERS = 0.12  # of the frames that count: with more, it is not the pattern that is there
_MOST_LIT = 0.08  # of the frames between flashes


@dataclass(slots=True, eq=False)
class Matches:
    """Best match of each light curve: arrays over places.

    `score` and `margin` are log-likelihood ratios against noise and against steady blinking (as large as `score` where
    that is small); `start` in seconds,
    `light` in the curves' unit, `variance` of the curve about the match; `regular`: several periods carry the pattern
    and none lacks it; `frames` that counted.
    """

    score: Floats
    margin: Floats
    start: Floats
    periods: Indices
    light: Floats
    variance: Floats
    regular: NDArray[np.bool_]
    frames: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Cleared:
    """Frames that show a known light: `seen` (F,) of them, of which M are.

    `wave` (M,) is the pattern less what `basis` (B, M, orthonormal) explains of it, `weight` its energy; `lamps` (M,)
    is the light of the lamps, 1 on average; `shift` (2,) is the picture's while the light was on; `look` says when the
    pattern may have started, None if that is unknown.
    """

    seen: NDArray[np.bool_]
    wave: Floats
    weight: float
    basis: Floats
    lamps: Floats
    shift: Floats
    look: Look | None


class Matcher:
    """Compares light curves with one pattern."""

    def __init__(self, pattern: FlashPattern, exposure: float, steady_hz: tuple[float, float]) -> None:
        self._pattern = pattern
        self._exposure = exposure
        self._template = Template(pattern, exposure)
        self._flashes = [Template(replace(pattern, on=(flash,)), exposure) for flash in pattern.on]
        self._steady_hz = steady_hz
        self._sampled: tuple[int, float] | None = None  # number of frames and seconds for which `_is_rival` holds
        self._is_rival = np.zeros(0, bool)
        shortest = min(end - start for start, end in pattern.on)
        pitch = min(0.02, max(0.004, _PITCH * shortest**2))
        self._step = max(8, int(np.ceil(pattern.period / pitch)))

    def match(
        self,
        times: Floats,
        values: Singles,
        levels: Singles,
        shifts: Floats,
        flicker: Singles | None = None,
        known: NDArray[np.bool_] | None = None,
    ) -> Matches:
        """Match N light curves.

        Parameters
        ----------
        times : (F,) array, s
        values, levels : (N, F) arrays
            Light of each place, and of what is around it.
        shifts : (F, 2) array
            Shift of the picture in px.
        flicker : (N, F) array, optional
            Relative change of the lamps' light near each place.
        known : (N, F) bool array, optional
            False in frames of which nothing is known of the place.
        """
        if known is None:
            known = np.ones(values.shape, bool)
        values, levels, _ = _steadied(values, levels, flicker)
        seen = self._seen(levels) & known
        starts, single = self._starts(times)
        basis = _moved(shifts)
        found, residual = self._search(times, values, seen, starts, single, basis)
        spread = _spread(residual, seen)
        partial = 0.35 * found.light[:, None]  # what a frame that is half exposed to a flash may be wrong by
        inliers = seen & (np.abs(residual) <= _OUTLIER * spread[:, None] + partial)
        lost = seen.sum(axis=1) - inliers.sum(axis=1)
        # because steady blinking less the frames that contradict the pattern looks like the pattern
        better = found.margin >= 0.0
        doubtful = np.flatnonzero(lost > 0)
        if len(doubtful):
            again, _ = self._search(times, values[doubtful], inliers[doubtful], starts, single, basis)
            for name in Matches.__slots__:
                getattr(found, name)[doubtful] = getattr(again, name)
        found.regular &= better & (lost <= _MOST_OUTLIERS * seen.sum(axis=1))
        # steady blinking that somebody hid for a while may look like two periods, but for light where none should be
        since = times - found.start[:, None]
        flashing = seen & (since >= 0.0) & (since < found.periods[:, None] * self._pattern.period)
        dark = flashing & (self._template.run(since, found.periods[:, None].astype(float)) < 0.02)
        lit = dark & (residual > 0.4 * found.light[:, None] + 2.0 * spread[:, None])
        found.regular &= lit.sum(axis=1) <= 1 + _MOST_LIT * dark.sum(axis=1)
        found.regular &= found.frames >= _LEAST_SEEN * known.sum(axis=1)
        return found

    def cleared(
        self,
        times: Floats,
        values: Singles,
        levels: Singles,
        shifts: Floats,
        flicker: Singles | None,
        start: float,
        periods: int,
    ) -> Cleared:
        """Choose the frames of a known light that show it, and what its image is regressed on.

        Parameters
        ----------
        times, values, levels, shifts, flicker
            As of `match`, of one place (N = 1).
        start, periods
            Its best match.
        """
        steady, levels, lamps = _steadied(values, levels, flicker)
        values = steady[0]
        seen = self._seen(levels)[0]
        wave = self._pattern.coverage(times - start, self._exposure, periods)
        dark = float(np.median(values[seen & (wave < 0.01)])) if np.any(seen & (wave < 0.01)) else 0.0
        lit = values[seen & (wave > 0.9)] if np.any(seen & (wave > 0.9)) else values[seen & (wave > 0.4)]
        light = float(np.median(lit)) - dark if len(lit) else 0.0
        residual = values - light * wave - dark
        spread = _spread(residual[None].astype(np.float32), seen[None])[0]
        seen &= np.abs(residual) <= _OUTLIER * spread + 0.35 * abs(light)
        basis = _moved(shifts[seen]).astype(float)
        if basis.shape[1] == 1:
            basis = basis.T / np.sqrt(max(len(basis), 1))
        else:
            basis = np.linalg.qr(basis)[0].T
        wave = wave[seen]
        on = wave.sum()
        shift = wave @ shifts[seen] / on if on > 0.0 else np.zeros(2)
        wave = wave - (basis @ wave) @ basis
        look = self._look(times[seen], values[seen].astype(float), start, periods, basis, abs(light))
        return Cleared(seen, wave, float(wave @ wave), basis, lamps[0, seen].astype(float), shift, look)

    def _look(
        self, times: Floats, values: Floats, start: float, periods: int, basis: Floats, light: float
    ) -> Look | None:
        """When one run of the pattern may have started, near its best match."""
        if len(times) < 8:
            return None
        pace = (times[-1] - times[0]) / (len(times) - 1)
        # because all starts between two frames' exposures look the same
        reach = max(1.5 * self._pattern.period / self._step, _LOOK_S, 0.6 * pace)
        offsets = np.arange(-int(reach / _LOOK_PITCH_S), int(reach / _LOOK_PITCH_S) + 1) * _LOOK_PITCH_S
        waves = self._template.run(times - start - offsets[:, None], periods).astype(float)
        waves -= np.einsum("ob,bf->of", np.einsum("of,bf->ob", waves, basis), basis)
        y = values - (basis @ values) @ basis
        energy = np.maximum(np.einsum("of,of->o", waves, waves), 1e-6)
        product = np.einsum("of,f->o", waves, y)
        gain = np.where(product > 0.0, product**2 / energy, 0.0)
        variance = max(float(y @ y - gain.max()), 1e-6) / max(len(times) - 2 - len(basis), 1)
        likelihood = (gain - gain.max()) / (2.0 * (variance + (_CRUDE * light) ** 2))
        look = Look(float(times.mean()), start + float(offsets[0]), _LOOK_PITCH_S, likelihood)
        return look if look.sigma < 0.25 * self._pattern.period else None

    def _starts(self, times: Floats) -> tuple[Floats, Singles]:
        period = self._pattern.period
        pitch = period / self._step
        starts = times[0] - period + np.arange(int((times[-1] - times[0] + period) / pitch) + 1) * pitch
        return starts, self._template(times[None, :] - starts[:, None])

    @staticmethod
    def _seen(levels: Singles) -> NDArray[np.bool_]:
        """Frames in which nobody stands before a place, or is just about to."""
        usual = _middle(levels)
        away = np.abs(levels - usual)
        # by frames that follow one another, too, because who stands there for a while spreads the levels
        spread = np.minimum(1.48 * _middle(away), _STEPS * _middle(np.abs(np.diff(levels, axis=1))))
        seen = away <= _SPREADS * spread + _HIDDEN * usual + 0.15
        clear = seen.copy()
        clear[:, 1:] &= seen[:, :-1]
        clear[:, :-1] &= seen[:, 1:]
        return np.asarray(clear)

    def _search(
        self,
        times: Floats,
        values: Singles,
        seen: NDArray[np.bool_],
        starts: Floats,
        single: Singles,
        basis: Singles,
    ) -> tuple[Matches, Singles]:
        """Best match over all starts and numbers of periods, and what it leaves of every frame."""
        weights = seen.astype(np.float32)
        frames = np.maximum(weights.sum(axis=1), 1.0).astype(np.float32)
        nuisance = _orthonormal(basis, weights)
        y = _less(values * weights, nuisance)
        energy = np.einsum("nf,nf->n", y, y).astype(float) + 1e-6
        places = len(y)
        projection, squares = np.empty((2, places, len(starts)), np.float32)
        sums = np.empty((*nuisance.shape[:2], len(starts)), np.float32)
        waves = np.ascontiguousarray(single.T)
        touched = waves > 0.0
        first = np.argmax(touched, axis=1)
        last = len(starts) - np.argmax(touched[:, ::-1], axis=1)
        kernels.project_runs(y, weights, nuisance, waves, first, last, projection, sums, squares)
        gain, light = np.empty(places, np.float32), np.empty(places, np.float32)
        start, periods = np.empty(places, np.intp), np.empty(places, np.intp)
        kernels.best_runs(projection, sums, squares, self._step, frames, _LEAST, gain, start, periods, light)
        count: Floats = periods.astype(float)
        begin: Floats = starts[start]
        promising = np.flatnonzero(frames * gain > _PROMISING * energy)
        if len(promising):
            self._refine(times, y, weights, nuisance, begin, count, promising)
        parts = [
            self._template(times - (begin + k * self._pattern.period)[:, None]) * (k < periods)[:, None]
            for k in range(int(periods.max(initial=0.0)))
        ]
        wave = np.sum(parts, axis=0) if parts else np.zeros_like(y)
        wave, gain, light = _regressed(y, weights, nuisance, wave)
        left = np.maximum(energy - gain, 1e-6)
        residual = y - light[:, None] * wave
        half = 0.5 * (frames.astype(float) - basis.shape[1])
        score = half * np.log(energy / left)
        steady, regular, likely = energy.copy(), np.zeros(places, bool), np.flatnonzero(score > _LIKELY)
        if len(likely):
            curves = y[likely], weights[likely], nuisance[likely]
            steady[likely] = self._steady_residual(times, *curves[:2], energy[likely])
            since = times - begin[likely, None]
            regular[likely] = self._regular(since, count[likely], curves, wave[likely], light[likely])
        matches = Matches(
            score=score,
            margin=half * np.log(steady / left),
            start=begin,
            periods=periods.astype(np.intp),
            light=light.astype(float),
            variance=left / np.maximum(frames - 2.0, 1.0),
            regular=regular,
            frames=frames.astype(float),
        )
        return matches, residual

    def _regular(
        self, since: Floats, periods: Floats, curves: tuple[Singles, Singles, Singles], wave: Singles, light: Singles
    ) -> NDArray[np.bool_]:
        """Two periods or more must each carry their share: one burst of clutter is no pattern.

        One period of several flashes is enough if each carries its share and hardly anything else is left.
        """

        def parts(template: Template) -> list[Singles]:
            begun = range(int(periods.max()))
            return [template(since - k * self._pattern.period) * (k < periods)[:, None] for k in begun]

        steady, carrying = _is_regular(*curves, parts(self._template), wave, light)
        left = curves[0] - light[:, None] * wave
        clean = np.einsum("nf,nf->n", left, left) <= _CLEAN * np.einsum("nf,nf->n", curves[0], curves[0])
        whole = np.flatnonzero(steady & (carrying == 1) & clean & (len(self._flashes) >= _SEVERAL))
        regular = steady & (carrying >= 2)
        if len(whole):
            since, periods = since[whole], periods[whole]
            flashes = [part for template in self._flashes for part in parts(template)]
            y, weights, nuisance = (curve[whole] for curve in curves)
            each, several = _is_regular(y, weights, nuisance, flashes, wave[whole], light[whole])
            regular[whole] = each & (several >= _SEVERAL)
        return np.asarray(regular)

    def _refine(
        self,
        times: Floats,
        y: Singles,
        weights: Singles,
        nuisance: Singles,
        begin: Floats,
        periods: Floats,
        chosen: Indices,
    ) -> None:
        """Move the starts `begin` of the chosen places between the steps of the search, in place.

        Short flashes need it: within one step they may fall from one exposure into the gap before the next.
        """
        y, weights, nuisance = y[chosen], weights[chosen], nuisance[chosen]
        middle, best = begin[chosen], np.full(len(chosen), -1.0)
        pitch = self._pattern.period / self._step
        for offset in pitch * np.linspace(-_BESIDE, _BESIDE, 2 * int(np.ceil(_BESIDE / _FINE)) + 1):
            wave = self._template.run(times - (middle + offset)[:, None], periods[chosen, None])
            _, gain, light = _regressed(y, weights, nuisance, wave)
            better = (gain > best) & (light > 0.0)
            best[better] = gain[better]
            begin[chosen[better]] = middle[better] + offset

    def _steady_residual(self, times: Floats, y: Singles, weights: Singles, energy: Floats) -> Floats:
        """What the best steady blinking (three harmonics, any rate) leaves of each light curve's energy."""
        turns = self._rivals(times)
        if not len(turns):
            return energy
        return np.asarray(np.maximum(energy - _explained(y, weights, turns).max(axis=1), 1e-6))

    def _rivals(self, times: Floats) -> NDArray[np.complex64]:
        """exp(i 2 pi rate t) (H, F) for H rates of steady blinking, but for those that are as good as the pattern."""
        seconds = max(float(times[-1] - times[0]), 1e-3)
        rates = np.arange(*self._steady_hz, 0.5 / seconds)  # half a turn from one to the next, over the whole window
        turns = np.exp(2j * np.pi * rates[:, None] * (times - times[0])).astype(np.complex64)
        sampled = len(times), round(seconds, 1)
        if self._sampled != sampled:
            whole = int(seconds / self._pattern.period) + 2
            wave = self._pattern.coverage(times - times[0] + self._pattern.period, self._exposure, whole)
            wave = (wave - wave.mean())[None].astype(np.float32)
            alike = _explained(wave, np.ones_like(wave), turns)[0]
            self._sampled, self._is_rival = sampled, alike <= _ALIKE * float(wave[0] @ wave[0])
        is_rival = self._is_rival[: len(turns)]
        return np.asarray(turns[: len(is_rival)][is_rival])


def _regressed(y: Singles, weights: Singles, nuisance: Singles, wave: Singles) -> tuple[Singles, Singles, Singles]:
    """The wave (N, F) less its nuisance, over the frames that count, the energy it explains of y, and its factor."""
    wave = _less(wave * weights, nuisance)
    product = np.einsum("nf,nf->n", y, wave)
    norm = np.maximum(np.einsum("nf,nf->n", wave, wave), _LEAST * np.maximum(weights.sum(axis=1), 1.0))
    return wave, product * product / norm, product / norm


def _is_regular(
    y: Singles, weights: Singles, nuisance: Singles, parts: list[Singles], wave: Singles, light: Singles
) -> tuple[NDArray[np.bool_], NDArray[np.intp]]:
    """Whether none of a pattern's parts lacks its share of the light, and how many carry theirs.

    Parts that the window cuts short count together, because two seconds may hold no two whole periods.
    """
    shown = [_less(part * weights, nuisance) for part in parts]
    products = np.stack([np.einsum("nf,nf->n", y, part) for part in shown], axis=1)
    expected = np.stack([np.einsum("nf,nf->n", wave, part) for part in shown], axis=1) * light[:, None]
    energies = np.stack([np.einsum("nf,nf->n", part, part) for part in shown], axis=1)
    enough = np.maximum(_ENOUGH * energies.max(axis=1, keepdims=True), 1e-6)
    counted = energies >= enough
    carrying = np.count_nonzero(counted & (products >= _CARRIES * expected), axis=1)
    missing = np.any(counted & (products < _LACKS * expected), axis=1)
    product, least = (np.where(counted, 0.0, sums).sum(axis=1) for sums in (products, _CARRIES * expected))
    carrying += (np.where(counted, 0.0, energies).sum(axis=1) >= enough[:, 0]) & (product >= least)
    return ~missing, carrying


def _steadied(values: Singles, levels: Singles, flicker: Singles | None) -> tuple[Singles, Singles, Singles]:
    """Light curves and levels as under lamps that do not flicker, and what the lamps did (N, F), 1 on average.

    Lamps are not the same everywhere: how much of the flicker a place has is taken from what is around it.
    """
    if flicker is None:
        return values, levels, np.ones_like(values)
    usual = np.maximum(_middle(levels), 1e-3)
    most = 3.0 * np.abs(flicker).max(axis=1, keepdims=True)
    away = np.clip(levels / usual - 1.0, -most, most)
    energy = np.maximum(np.einsum("nf,nf->n", flicker, flicker), 1e-9)
    share = np.clip(np.einsum("nf,nf->n", flicker, away) / energy, 0.0, 2.0)[:, None]
    lamps = np.maximum(1.0 + share * flicker, 0.5).astype(np.float32)
    return values - _middle(values) * (lamps - 1.0), levels / lamps, lamps


def _middle(curves: Singles) -> Singles:
    """Upper median (N, 1) of curves (N, F), without what numpy's costs for few of them."""
    half = curves.shape[1] // 2
    return np.asarray(np.partition(curves, half, axis=1)[:, half : half + 1])


def _moved(shifts: Floats) -> Singles:
    """Basis (F, B) of what the shift of the picture does to a place: constant, and if it moved, to second order."""
    constant = np.ones((len(shifts), 1))
    if not shifts.any():
        return constant.astype(np.float32)
    centred = shifts - np.median(shifts, axis=0)
    if np.abs(centred).max(initial=0.0) < 1e-9:
        return constant.astype(np.float32)
    u, v = centred.T
    parts = np.stack([u, v, u * u, u * v, v * v], axis=1)
    scale = np.maximum(np.abs(parts).max(axis=0), 1e-6)
    return np.concatenate([constant, parts / scale], axis=1).astype(np.float32)


def _orthonormal(basis: Singles, weights: Singles) -> Singles:
    """Per place the basis (F, B) over the frames that count, made orthonormal: (N, B, F)."""
    if basis.shape[1] == 1:
        return np.asarray((weights / np.sqrt(np.maximum(weights.sum(axis=1), 1.0))[:, None])[:, None])
    b = basis.astype(float)
    products = (b[:, :, None] * b[:, None, :]).reshape(len(b), -1)
    # no matrix product: its library would wake threads for it, which cost more than they save
    normal = np.einsum("nf,fk->nk", weights, products).reshape(len(weights), *2 * b.shape[1:])
    lower = np.linalg.cholesky(normal + 1e-3 * np.eye(b.shape[1]))
    return np.asarray(np.linalg.solve(lower, b.T[None]) * weights[:, None], np.float32)


def _less(curves: Singles, nuisance: Singles) -> Singles:
    """Curves (N, F) less what their nuisance explains of them; both are zero in frames that do not count."""
    shares = np.einsum("nbf,nf->nb", nuisance, curves)
    return np.asarray(curves - np.einsum("nb,nbf->nf", shares, nuisance))


def _explained(y: Singles, weights: Singles, turns: NDArray[np.complex64]) -> Floats:
    """Energy (N, H) that a constant and _HARMONICS harmonics of each of H rates explain of light curves.

    Parameters
    ----------
    y, weights : (N, F)
        Light curves, zero where their weight is; weights are 0 or 1.
    turns : (H, F) complex
        exp(i 2 pi rate t).

    Notes
    -----
    Least squares in the basis of exp(i k 2 pi rate t), whose normal matrix is Toeplitz.
    """
    waves = np.empty((len(turns), 2 * _HARMONICS + 1, turns.shape[1]), np.complex64)
    waves[:, 0] = 1.0
    for k in range(2 * _HARMONICS):
        np.multiply(waves[:, k], turns, out=waves[:, k + 1])
    sums = np.einsum("nf,hkf->nhk", weights, waves)
    sums = np.concatenate([sums[:, :, :0:-1].conj(), sums], axis=2)  # of the powers -2 _HARMONICS to 2 _HARMONICS
    right = np.einsum("nf,hkf->nhk", y, waves[:, : _HARMONICS + 1].conj())
    right = np.concatenate([right[:, :, :0:-1].conj(), right], axis=2)
    orders = np.arange(-_HARMONICS, _HARMONICS + 1)
    normal = sums[:, :, (orders - orders[:, None]) + 2 * _HARMONICS]
    # because sampled waves may be aliases of one another
    normal += 1e-3 * np.maximum(weights.sum(axis=1), 1.0)[:, None, None, None] * np.eye(len(orders))
    factors = np.linalg.solve(normal, right[..., None])[..., 0]
    return np.asarray(np.einsum("nhk,nhk->nh", factors, right.conj()).real)


def _spread(residual: Singles, seen: NDArray[np.bool_]) -> Floats:
    """Robust standard deviation (N,) of what counts."""
    away = np.sort(np.where(seen, np.abs(residual), np.inf), axis=1)
    count = seen.sum(axis=1)
    middle = away[np.arange(len(away)), np.maximum(count - 1, 0) // 2]
    return np.asarray(1.48 * np.where(count > 0, middle, 0.0) + 1e-3)
