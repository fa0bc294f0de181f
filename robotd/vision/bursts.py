"""When known lights flash, and for how many periods: the likelihood of a burst at every possible start.

Once a light's place is known, each of its periods is a test by itself: does one burst of the pattern begin here, or
does the light stay dark? The log-likelihood ratio of the two, on a grid of starts, adds up over the periods of a flash,
so that "began at s and lasted D periods" is a sum of D entries, one period apart. What is hidden (by a passer-by, a
dropped frame, the time before the light was found) counts as neither.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .pattern import FlashPattern, Template

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_CAP_LIT = 10.0  # no single period convinces more than e^10 that a burst was there,
_CAP_DARK = 7.0  # or than e^7 that none was: now and then somebody of the wall's own brightness stands before a light
_HIDDEN = 0.05  # relative change of the light around a place that says somebody stands before it
_LATE = 7.0  # log-odds against a second flash in one window
_PHASES = 10  # parts of a period; flashes whose starts are in the same or the next part have the same phase
_ACTIVE = 0.72  # of the full light: what coarse sampling leaves of a burst; one flash too late gives 0.5 to 0.75


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """Per place and duration: the flash's log-likelihood relative to darkness, `score`, and its likeliest `start`."""

    score: Floats
    start: Floats


class BurstScorer:
    """Scores bursts of N places in one camera on a grid of starts; places are added while it runs."""

    def __init__(self, pattern: FlashPattern, exposure: float, starts_per_period: int = 100) -> None:
        self.pattern = pattern
        self._exposure = exposure
        self._template = Template(pattern, exposure)
        self._step = starts_per_period  # grid points from one period to the next
        self._pitch = pattern.period / starts_per_period
        self._origin: float | None = None
        self._done = 0  # grid points scored so far
        self._sums = np.zeros((4, 0, 0))  # per place and start: light on pattern, pattern energy, light energy, frames
        self._reference = np.zeros(0)  # usual light around each place
        self.active_first = np.zeros(0)  # first and last start of a burst seen since `forget_activity`
        self.active_last = np.zeros(0)

    @property
    def scored_until(self) -> float:
        """Starts before this time have been scored."""
        return -np.inf if self._origin is None else self._origin + self._done * self._pitch

    @property
    def places(self) -> int:
        """Number of lights known."""
        return len(self._reference)

    def forget_activity(self) -> None:
        """Begin to look for the first and last burst anew."""
        self.active_first[:] = np.inf
        self.active_last[:] = -np.inf

    def extend(self, times: Floats, values: Singles, levels: Singles, light: Floats, variance: Floats) -> None:
        """Score the starts whose whole period has been seen.

        Parameters
        ----------
        times : (F,) array
            Recent frames, in seconds: since `scored_until`, and all there are when places are new.
        values, levels : (N, F) arrays
            As of `FlashDetector.light_curves`; levels are nan where nothing is known. Places beyond those of the call
            before are new.
        light, variance : (N,) arrays
            What `values` rises by when the light is on, and its variance.
        """
        if self._origin is None:
            self._origin = float(times[0])
        known = len(self._reference)
        end = int((times[-1] + self._exposure - self.pattern.period - self._origin) / self._pitch)
        first = max(0, int(np.ceil((times[0] - 0.02 - self._origin) / self._pitch)))
        self._reserve(len(values), max(end, 0))
        middle = np.nanmedian if np.isnan(levels).any() else np.median  # which is faster
        usual = middle(levels, axis=1).astype(float)
        self._reference = np.concatenate([self._reference, usual[known:]])
        for places, begin in ((slice(0, known), max(self._done, first)), (slice(known, None), first)):
            if end > begin and len(values[places]):
                self._score(times, values, levels, light, variance, places, begin, end)
        calm = np.abs(usual - self._reference) < _HIDDEN * self._reference + 0.5
        self._reference += np.where(calm, 0.1 * (usual - self._reference), 0.0)
        self._done = max(self._done, end)

    def runs(self, begin: float, end: float, durations: tuple[int, ...], light: Floats, variance: Floats) -> Runs:
        """How likely each place made a flash of each duration (periods) whose bursts all began in [begin, end)."""
        assert self._origin is not None
        first = int(np.clip(np.ceil((begin - self._origin) / self._pitch), 0, self._done))
        last = int(np.clip(np.ceil((end - self._origin) / self._pitch), first, self._done))
        places = len(self._reference)
        if last == first:
            return Runs(np.zeros((places, len(durations))), np.full((places, len(durations)), begin))
        raw = self._ratio(slice(first, last), light, variance)
        capped = np.clip(raw, -_CAP_DARK, _CAP_LIT)
        whole = last - first
        score = np.full((places, len(durations)), -_CAP_DARK)
        start = np.full_like(score, begin)
        sums = self._run_sums(capped, max(durations))
        exact = self._run_sums(raw, max(durations))
        earlier = self._earlier_run(sums, whole)
        for column, periods in enumerate(durations):
            if periods <= len(sums):
                total = sums[periods - 1] + earlier[:, : sums[periods - 1].shape[1]]
                top = total.max(axis=1)
                score[:, column] = top + np.log(np.exp(total - top[:, None]).sum(axis=1) / whole)
                best = np.argmax(np.where(total > top[:, None] - 2.0, exact[periods - 1], -np.inf), axis=1)
                start[:, column] = self._origin + (first + best) * self._pitch
        return Runs(score, start)

    def _run_sums(self, bursts: Floats, longest: int) -> list[Floats]:
        """Sums of 1, 2, ... consecutive bursts from every start, as long as the last begins within the window."""
        sums = [bursts]
        for k in range(1, longest):
            count = bursts.shape[1] - k * self._step
            if count <= 0:
                break
            sums.append(sums[-1][:, :count] + bursts[:, k * self._step :])
        return sums

    def _earlier_run(self, sums: list[Floats], whole: int) -> Floats:
        """What a flash explains that began late, in answer to an earlier request, and ended a period ago.

        Only if its phase is another: with the same phase it is rather one flash, seen in two parts.
        """
        places = sums[0].shape[0]
        rows = -(-whole // self._step)
        ended = np.zeros((places, rows * self._step))
        for k, total in enumerate(sums[1:], start=1):
            after = (k + 2) * self._step
            if after < whole:
                ended[:, after:whole] = np.maximum(ended[:, after:whole], total[:, : whole - after] - _LATE)
        parts = np.array_split(ended.reshape(places, rows, self._step), _PHASES, axis=2)
        best = np.maximum.accumulate(np.stack([part.max(axis=2) for part in parts], axis=2), axis=1)
        far = np.minimum(np.arange(_PHASES), _PHASES - np.arange(_PHASES)) > 1
        other = np.stack([best[:, :, np.roll(far, k)].max(axis=2) for k in range(_PHASES)], axis=2)
        widths = [part.shape[2] for part in parts]
        return np.asarray(np.repeat(other, widths, axis=2).reshape(places, -1)[:, :whole])

    def _reserve(self, places: int, grid: int) -> None:
        _, have, length = self._sums.shape
        if places > have or grid > length:
            bigger = np.zeros(
                (
                    4,
                    max(places, 2 * have if places > have else have),
                    length if grid <= length else max(grid, 2 * length, 1024),
                )
            )
            bigger[:, :have, :length] = self._sums
            self._sums = bigger
        added = places - len(self.active_last)
        self.active_first = np.concatenate([self.active_first, np.full(added, np.inf)])
        self.active_last = np.concatenate([self.active_last, np.full(added, -np.inf)])

    def _score(
        self,
        times: Floats,
        values: Singles,
        levels: Singles,
        light: Floats,
        variance: Floats,
        places: slice,
        begin: int,
        end: int,
    ) -> None:
        assert self._origin is not None
        starts = self._origin + np.arange(begin, end) * self._pitch
        since = times[None, :] - starts[:, None]
        pattern = self._template(since).astype(float)
        inside = ((since >= -self._exposure) & (since < self.pattern.period - self._exposure)).astype(float)
        y = values[places].astype(float)
        y -= np.median(y, axis=1, keepdims=True)
        reference, on, noise = self._reference[places, None], light[places, None], np.sqrt(variance[places, None])
        seen = np.abs(levels[places] - reference) <= _HIDDEN * reference + 0.6
        seen &= (y > -6.0 * noise - 0.5 * on) & (y < 1.6 * on + 6.0 * noise)
        weights = seen.astype(float)
        y *= weights
        frames = weights @ inside.T
        mean_y = (y @ inside.T) / np.maximum(frames, 1.0)
        mean_pattern = (weights @ pattern.T) / np.maximum(frames, 1.0)
        product = y @ pattern.T - frames * mean_y * mean_pattern
        energy = weights @ (pattern**2).T - frames * mean_pattern**2
        rest = (y**2) @ inside.T - frames * mean_y**2
        usable = frames >= 0.6 * inside.sum(axis=1)
        sums = np.stack([product, energy, rest, frames]) * usable
        self._sums[:, places, begin:end][:, : len(y)] = sums
        active = usable & (product >= _ACTIVE * on * energy) & (energy > 0.1 * frames)
        first = np.where(active.any(axis=1), starts[np.argmax(active, axis=1)], np.inf)
        last = np.where(active.any(axis=1), starts[-1 - np.argmax(active[:, ::-1], axis=1)], -np.inf)
        self.active_first[places] = np.minimum(self.active_first[places], first)
        self.active_last[places] = np.maximum(self.active_last[places], last)

    def _ratio(self, window: slice, light: Floats, variance: Floats) -> Floats:
        """Log-likelihood ratio of a burst against darkness; noise is what the better of the two leaves, at least."""
        product, energy, rest, frames = self._sums[:, : len(light), window]
        lit = rest - 2.0 * light[:, None] * product + light[:, None] ** 2 * energy
        noise = np.maximum(variance[:, None], np.minimum(rest, lit) / np.maximum(frames - 2.0, 1.0))
        return np.asarray(0.5 * (rest - lit) / np.maximum(noise, 1e-9))
