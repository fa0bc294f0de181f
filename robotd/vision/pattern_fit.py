"""The pattern that explains one light curve: its period, and the edges of its flashes.

Exposures leave gaps, and a short flash may fall into one of them or fill it, so that many patterns explain a curve as
well. Of those the mean is taken, weighted by their likelihood, and flashes are taken as alike unless the curve says
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .pattern import FlashPattern

Floats = NDArray[np.float64]

LEAST_CYCLES = 3
LEAST_CONTRAST = 4.0  # of a flash over the noise of one frame
_NO_WORSE = 1.3  # a shorter period's fold may leave so much more than the best one's
_LEAST_EXPLAINED = 0.7  # of the energy, by the fold; and by the pattern
_CLIP = 4.0  # spreads at which a residual says that somebody stood before the label
_ROUNDS = 6  # of refinement, at most
_ALLOWED = 4.0  # loss above the best one's, in squared spreads, that an edge or the period may have
_ALLOWED_FREE = 9.0  # the same of the period where every edge is free, because several periods may do almost as well
_MOVES = np.linspace(-0.5, 0.5, 9)  # of the time between frames, tried of all flashes together
_STAMPS_S = 0.002  # time stamps are off by so much
_HUGE = 1e12


@dataclass(frozen=True, slots=True)
class LearntPattern:
    """A pattern, and how sure it is.

    `confidence` is the posterior probability against rival patterns; `period_sigma` and `edge_sigma` (s) are the
    standard deviations of the period and of the least certain edge; `cycles` periods were seen, of which the pattern
    explains the share `explained` of the light curve's energy; `u`, `v` (px) is where, nan for a bare light curve.
    """

    pattern: FlashPattern
    confidence: float
    period_sigma: float
    edge_sigma: float
    explained: float
    cycles: int
    u: float = float("nan")
    v: float = float("nan")

    def toml(self) -> str:
        """The line for [mission.identify] of robotd.toml."""
        on = ", ".join(f"[{start:.4f}, {end:.4f}]" for start, end in self.pattern.on)
        return f"pattern = {{ period = {self.pattern.period:.5f}, on = [{on}] }}"


class PatternFit:
    """One light curve, its period and its edges."""

    def __init__(
        self, times: Floats, curve: Floats, exposure: float, shortest: float, longest: float, period: float = 0.0
    ) -> None:
        if len(times) < 12:
            raise InputError("the label flashes in too few frames; record longer")
        self.times, self.curve = times, curve
        self.exposure = max(exposure, 1e-4)
        self.seconds = float(times[-1] - times[0])
        self.pace = self.seconds / (len(times) - 1)
        self.period = period or self._find_period(shortest, min(longest, self.seconds / (LEAST_CYCLES - 0.8)))
        self.on = self._flashes()
        self.period_sigma = self.edge_sigma = 0.0
        self.dark = self.light = 0.0
        self.noise = float(np.std(curve))
        best = np.inf
        for _ in range(1 if period else _ROUNDS):
            self._refine()
            self._divide()
            loss = float((np.minimum(np.abs(self._residual()), self.light) ** 2).sum())
            if loss > 0.98 * best:
                break
            best = loss
        self._liken()
        if not period:
            self.period_sigma = self._period_spread()

    # ---- period ------------------------------------------------------------------------------------------------------

    def _find_period(self, shortest: float, longest: float) -> float:
        """The shortest period whose fold leaves about as little as the best one's."""
        if longest <= shortest:
            raise InputError("the label flashes for less than 3 periods; record longer")
        y = self.curve - self.curve.mean()
        step = 0.25 * self.pace / (self.seconds * shortest)  # the last fold moves by a fraction of a frame
        rates = np.arange(1.0 / longest, 1.0 / shortest, step)
        left = np.array([_left(self.times, y, 1.0 / rate, self.pace) for rate in rates])
        best = int(np.argmin(left))
        if left[best] > 1.0 - self._least_explained():
            raise InputError("its light does not repeat")
        chosen = rates[best], left[best]
        for divisor in range(12, 0, -1):
            near = np.flatnonzero(np.abs(rates - divisor * rates[best]) <= 2.0 * divisor * step)
            if len(near) and left[near].min() <= _NO_WORSE * left[best] + 0.01:
                k = near[np.argmin(left[near])]
                chosen = rates[k], left[k]
                break
        rate = float(chosen[0])
        for part in (0.3, 0.08):
            fine = rate + part * step * np.arange(-6, 7)
            scores = np.array([_left(self.times, y, 1.0 / r, self.pace) for r in fine])
            rate = float(fine[scores <= scores.min() + 0.01].mean())  # because the fold's bins make a plateau
        return 1.0 / rate

    def _least_explained(self) -> float:
        """Share of the energy that a pattern must explain: of short, weak flashes much of the energy is noise."""
        noise = float(np.quantile(np.abs(np.diff(self.curve)), 0.25)) / 0.45  # most frames change by noise alone
        energy = float(np.var(self.curve))
        return max(_LEAST_EXPLAINED * (1.0 - noise**2 / max(energy, 1e-12)), 0.5 * _LEAST_EXPLAINED)

    # ---- edges -------------------------------------------------------------------------------------------------------

    def _flashes(self) -> list[list[float]]:
        """First guess [start, end] of every flash: where the folded curve is in its upper half."""
        phase = (self.times + 0.5 * self.exposure) % self.period
        order = np.argsort(phase)
        phase, values = phase[order], self.curve[order]
        reach = 0.5 * min(self.pace, self.period / 12.0)
        folded = np.array(
            [
                np.median(values[np.abs((phase - p + 0.5 * self.period) % self.period - 0.5 * self.period) <= reach])
                for p in phase
            ]
        )
        dark, lit = np.quantile(folded, [0.1, 0.97])
        on = folded > 0.5 * (dark + lit)
        rises = np.flatnonzero(on & ~np.roll(on, 1))
        falls = np.flatnonzero(~on & np.roll(on, 1))
        if not len(rises):
            raise InputError("the label is never dark: expected flashes with dark intervals between them")
        flashes = []
        for k in rises:
            start = 0.5 * (phase[k] + phase[k - 1] - (self.period if k == 0 else 0.0))
            after = falls[np.argmin((phase[falls] - phase[k]) % self.period)]
            end = 0.5 * (phase[after] + phase[after - 1] - (self.period if after == 0 else 0.0))
            flashes.append([float(start), float(start + (end - start) % self.period)])
        return flashes

    def _shares(self, on: list[list[float]], period: float) -> tuple[Floats, Floats]:
        """Share of each exposure in which the light is on, and its standard deviation.

        Time stamps are a little off, which matters at the edges. Phases are kept at the recording's middle.
        """
        middle = 0.5 * (self.times[0] + self.times[-1])
        since = self.times - middle + (middle % period) + _STAMPS_S * np.array([[-1.0], [1.0]])
        total = np.zeros((2, len(self.times)))
        for start, end in on:
            lag = (since - start + self.exposure) % period - self.exposure
            for turn in (0.0, period):
                total += np.clip(np.minimum(lag + self.exposure, turn + end - start) - np.maximum(lag, turn), 0.0, None)
        early, late = np.minimum(total / self.exposure, 1.0)
        return 0.5 * (early + late), 0.5 * np.abs(late - early)

    def _loss(self, on: list[list[float]], period: float) -> float:
        """-2 log likelihood: squared residuals in units of their spread, each limited, with the best dark and light."""
        share, unsure = self._shares(on, period)
        weights, spread = np.ones(len(share)), np.full(len(share), self.noise)
        residual = self.curve
        for _ in range(2):
            w = weights.sum()
            mx, my = weights @ share / w, weights @ self.curve / w
            self.light = float(weights @ ((share - mx) * (self.curve - my)) / max(weights @ (share - mx) ** 2, 1e-12))
            self.dark = float(my - self.light * mx)
            residual = self.curve - self.dark - self.light * share
            spread = np.hypot(self.noise, self.light * unsure)
            weights = 1.0 / (1.0 + (residual / (_CLIP * spread)) ** 2)
        if self.light <= 0.0:
            return _HUGE
        return float(np.minimum((residual / spread) ** 2, _CLIP**2).sum() + 2.0 * np.log(spread / self.noise).sum())

    def _divide(self) -> None:
        """Take a fraction of the period if the flashes repeat within it."""
        starts = np.sort([start % self.period for start, _ in self.on])
        lengths = np.array([end - start for start, end in self.on])[np.argsort([s % self.period for s, _ in self.on])]
        tolerance = 0.6 * self.pace + self.exposure
        for divisor in range(len(starts), 1, -1):
            if len(starts) % divisor or self.period / divisor < 2.0 * self.pace:
                continue
            count = len(starts) // divisor
            later = np.roll(starts, -count) + np.where(np.arange(len(starts)) >= len(starts) - count, self.period, 0.0)
            apart = np.abs(later - starts - self.period / divisor).max()
            if apart <= tolerance and np.abs(np.roll(lengths, -count) - lengths).max() <= 2.0 * tolerance:
                middle = 0.5 * (self.times[0] + self.times[-1])
                shift = middle % (self.period / divisor) - middle % self.period
                self.period /= divisor
                chosen = sorted(self.on, key=lambda flash: flash[0] % (self.period * divisor))[:count]
                self.on = [[start + shift, end + shift] for start, end in chosen]
                self._refine()
                return

    def _refine(self) -> None:
        """Move the period and every edge to the middle of what the exposures allow."""
        residual = self._residual()
        floor = 0.01 * max(self.light, 1e-9)
        self.noise = max(1.48 * float(np.median(np.abs(residual))), floor)
        self._centre()
        worst = 0.0
        reach = 0.6 * self.pace + self.exposure
        spans = np.linspace(-1.0, 1.0, 33)
        for flash in self.on:
            for side in (0, 1):
                trials = flash[side] + reach * spans
                trials = trials[trials < flash[1] - 0.004] if side == 0 else trials[trials > flash[0] + 0.004]
                tried: list[float] = []
                for trial in trials:
                    keep, flash[side] = flash[side], float(trial)
                    tried.append(self._loss(self.on, self.period))
                    flash[side] = keep
                allowed = trials[np.array(tried) <= min(tried) + _ALLOWED]
                flash[side] = float(allowed.mean())
                worst = max(worst, float(np.hypot(allowed.std(), (trials[1] - trials[0]) / 3.5)))
        self.edge_sigma = float(np.hypot(worst, _STAMPS_S))

    def _centre(self) -> None:
        """Take the mean of all periods, moved and widened flashes, weighted by their likelihood.

        Short flashes leave much open, and periods that leave the flashes more room are the likelier ones.
        """
        step = 0.5 * self.pace / self.seconds * self.period
        periods = self.period + step * np.linspace(-1.0, 1.0, 17)
        moves = _MOVES * self.pace
        shortest = min(end - start for start, end in self.on)
        widened = moves[shortest + 2.0 * moves > 0.004]
        middle = 0.5 * (self.times[0] + self.times[-1])
        losses = np.array(
            [
                [[self._loss([[a + m - w, b + m + w] for a, b in self.on], p) for w in widened] for m in moves]
                for p in periods.tolist()
            ]
        )
        weights = np.exp(0.5 * (losses.min() - losses))
        weights /= weights.sum()
        period = float(weights.sum(axis=(1, 2)) @ periods)
        move, wider = float(weights.sum(axis=(0, 2)) @ moves), float(weights.sum(axis=(0, 1)) @ widened)
        move += middle % period - middle % self.period  # so that the middle keeps its phase
        self.on = [[start + move - wider, end + move + wider] for start, end in self.on]
        self.period = period

    def _liken(self) -> None:
        """Make flashes equally long, and equally far apart, unless the recording speaks against it.

        By Schwarz's criterion: every edge that is not chosen freely is worth log F of the loss.
        """
        on = sorted(self.on)
        count = len(on)
        if count < 2:
            return
        length = float(np.mean([end - start for start, end in on]))
        middles = np.array([0.5 * (start + end) for start, end in on])
        regular = np.polyval(np.polyfit(np.arange(count), middles, 1), np.arange(count))
        best = self._loss(self.on, self.period)
        for centres, fewer in ((regular, 2 * count - 3), (middles, count - 1)):
            alike = [[float(centre - 0.5 * length), float(centre + 0.5 * length)] for centre in centres]
            if self._loss(alike, self.period) <= best + fewer * np.log(len(self.times)):
                self.on = alike
                self._centre()
                return

    def _period_spread(self) -> float:
        """How far off the period may be: the spread about it of others that do almost as well if every edge is free."""
        trials = self.period + self.pace / self.seconds * self.period * np.linspace(-1.0, 1.0, 17)
        losses = np.array([self._freed(float(trial)) for trial in trials])
        away = trials[losses <= losses.min() + _ALLOWED_FREE] - self.period
        return float(np.sqrt(np.mean(away**2) + ((trials[1] - trials[0]) / 3.5) ** 2))

    def _freed(self, period: float) -> float:
        """Least loss of a period if every edge moves by itself."""
        best, on = self._settled(period)
        on = [list(flash) for flash in on]
        for flash in on:
            for side in (0, 1):
                chosen = flash[side]
                for trial in chosen + 0.4 * self.pace * np.linspace(-1.0, 1.0, 7):
                    flash[side] = float(trial)
                    loss = self._loss(on, period) if flash[1] - flash[0] > 0.004 else _HUGE
                    if loss < best:
                        best, chosen = loss, flash[side]
                flash[side] = chosen
        return best

    def _settled(self, period: float) -> tuple[float, list[list[float]]]:
        """Least loss of a period, and its flashes, moved all by as much and widened all by as much."""
        on, best = self.on, self._loss(self.on, period)
        shortest = min(end - start for start, end in on)
        for reach in (0.4 * self.pace, 0.1 * self.pace):
            for early, late in ((1.0, 1.0), (-0.5, 0.5)):
                trials = reach * np.linspace(-1.0, 1.0, 7)
                trials = trials[shortest + (late - early) * trials > 0.004]
                moved = [[[start + early * d, end + late * d] for start, end in on] for d in trials]
                losses = [self._loss(trial, period) for trial in moved]
                k = int(np.argmin(losses))
                if losses[k] < best:
                    best, on = losses[k], moved[k]
                    shortest = min(end - start for start, end in on)
        return best, on

    def _residual(self) -> Floats:
        self._loss(self.on, self.period)
        return self.curve - self.dark - self.light * self._shares(self.on, self.period)[0]

    # ---- doubts ------------------------------------------------------------------------------------------------------

    def learnt(self) -> LearntPattern:
        """The pattern, and the posterior probability of it among its rivals."""
        residual = self._residual()
        self.noise = max(1.48 * float(np.median(np.abs(residual))), 0.02 * max(self.light, 1e-9))
        best = self._loss(self.on, self.period)
        energy = np.minimum((self.curve - np.median(self.curve)) ** 2, (2.0 * max(self.light, 1e-9)) ** 2)
        left = np.minimum(residual**2, (2.0 * max(self.light, 1e-9)) ** 2)
        explained = 1.0 - float(left.sum() / max(energy.sum(), 1e-12))
        if self.light < LEAST_CONTRAST * self.noise or explained < self._least_explained():
            raise InputError("its light repeats, but not as flashes of one brightness")
        light, losses = self.light, [self._loss(on, self.period) for on in self._rivals()]
        self.light = light
        simpler = np.log(len(self.times))  # Schwarz's criterion, for the two edges that a rival does without
        odds = sum(np.exp(np.clip(0.5 * (best - loss) + simpler, -60.0, 60.0)) for loss in losses)
        on = sorted(self.on, key=lambda flash: flash[0] % self.period)
        gaps = [(b[0] - a[1]) % self.period for a, b in zip(on, on[1:] + on[:1], strict=True)]
        first = (int(np.argmax(gaps)) + 1) % len(on)
        on = on[first:] + on[:first]
        since = [((start - on[0][0]) % self.period, end - start) for start, end in on]
        try:
            pattern = FlashPattern(self.period, tuple((round(s, 5), round(s + length, 5)) for s, length in since))
        except ValueError as error:
            raise InputError(f"its flashes overlap: {error}") from error
        cycles = int(np.ceil(self.seconds / self.period - 0.1))
        if cycles < LEAST_CYCLES:
            raise InputError(f"the label flashes for {cycles} periods of {self.period:.2f} s; expected 3 or more")
        return LearntPattern(pattern, 1.0 / (1.0 + float(odds)), self.period_sigma, self.edge_sigma, explained, cycles)

    def _rivals(self) -> list[list[list[float]]]:
        """Patterns that are simpler by one flash: without it, or together with its neighbour."""
        on = sorted(self.on)
        if len(on) == 1:
            return []
        fewer = [on[:k] + on[k + 1 :] for k in range(len(on))]
        merged = [[*on[:k], [on[k][0], on[k + 1][1]], *on[k + 2 :]] for k in range(len(on) - 1)]
        return fewer + merged


def _left(times: Floats, y: Floats, period: float, pace: float) -> float:
    """Share of the energy of y that its mean over the phases of a period leaves, corrected for the bins' number."""
    bins = max(6, int(period / pace))
    best = 1.0
    for offset in (0.0, 0.5):  # because frames may fall on the borders of one set of bins, and scatter over them
        index = ((times % period) * (bins / period) + offset).astype(int) % bins
        count = np.bincount(index, minlength=bins)
        used = int((count > 0).sum())
        if len(y) - used >= 4:
            sums = np.bincount(index, y, bins)
            left = 1.0 - float((sums**2 / np.maximum(count, 1)).sum() / max(float(y @ y), 1e-12))
            best = min(best, left * (len(y) - 1) / (len(y) - used))
    return best
