"""The light of one beacon as a camera's exposures sum it up: a square wave, half of the time on.

Frames of network cameras come unevenly and their stamps err, so the wave is tabulated for the exposure and blurred by
the stamps' spread: a frame whose stamp says "just switched on" is expected to be half bright, as it is on the average.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..records import Floats

STEP_S = 0.0005  # s, of the table


class Wave:
    """Expected share of the exposure in which one LED is on.

    Parameters
    ----------
    hz : float
        Flashes a second; on for the first half of each period.
    exposure, jitter : float
        Seconds that a frame is exposed, and the standard deviation of its stamp.
    """

    def __init__(self, hz: float, exposure: float, jitter: float) -> None:
        self.hz = hz
        count = max(32, round(1.0 / (hz * STEP_S)))
        t = np.arange(count) / (count * hz)
        # mean over [t, t + e] from the integral of the wave, which is exact for any exposure
        e = max(exposure, 1e-4)
        table = (self._integral(t + e) - self._integral(t)) / e
        blur = np.exp(-0.5 * (2.0 * np.pi * np.fft.rfftfreq(count, 1.0 / (count * hz)) * jitter) ** 2)
        self._table: Floats = np.fft.irfft(np.fft.rfft(table) * blur, count)

    def _integral(self, t: Floats) -> Floats:
        """Integral of the wave from 0 to t."""
        period = 1.0 / self.hz
        whole, rest = np.divmod(t, period)
        return np.asarray(whole * 0.5 * period + np.minimum(rest, 0.5 * period))

    def __call__(self, since_on: Floats) -> Floats:
        """Shares 0..1 of exposures that begin so many seconds after the LED was switched on (any shape)."""
        at = np.mod(np.asarray(since_on) * self.hz, 1.0) * len(self._table)
        low = np.floor(at).astype(np.int64)
        part = at - low
        n = len(self._table)
        return np.asarray((1.0 - part) * self._table[low % n] + part * self._table[(low + 1) % n])


@dataclass(frozen=True, slots=True)
class Lock:
    """How well a series follows a wave.

    `start` s (modulo the period) when the LED was switched on, on the series' clock; `share` 0..1 of the variance
    that the wave explains; `amplitude` of the light in the series' unit; `log_p` the natural logarithm of the
    probability that noise explains as much at any of the starts that were tried.
    """

    start: float
    share: float
    amplitude: float
    log_p: float


def lock(series: Floats, t: Floats, wave: Wave, starts: Floats) -> Lock:
    """Fit a + b wave(t - start) to a series by least squares, over a grid of starts.

    Parameters
    ----------
    series, t : (N,) arrays
        Values, and when their exposures began, in seconds; any spacing.
    wave : Wave
    starts : (S,) array
        Seconds.

    Notes
    -----
    For a given start and white noise the explained share r has P(r > x) = (1 - x)^((N - 2) / 2), up to a factor below
    1 that counts only waves of positive sign; the S starts are joined by Bonferroni's inequality. A slow drift is
    taken out of both sides first, at the price of one more degree of freedom.
    """
    n = len(series)
    if n < 6:
        return Lock(0.0, 0.0, 0.0, 0.0)
    time = t - t.mean()
    trend = np.stack([np.full(n, n**-0.5), time / max(float(np.linalg.norm(time)), 1e-12)])

    def detrended(rows: Floats) -> Floats:
        return np.asarray(rows - (rows @ trend.T) @ trend)

    y = detrended(series)
    waves = detrended(wave(t[None, :] - starts[:, None]))
    energy = np.einsum("ij,ij->i", waves, waves)
    along = waves @ y
    total = max(float(y @ y), 1e-12)
    fits = np.where((along > 0.0) & (energy > 0.02 * n), along**2 / np.maximum(energy, 1e-12) / total, 0.0)
    best = int(np.argmax(fits))
    share = float(min(fits[best], 1.0))
    # starts closer than the wave's own correlation are no new trials
    trials = min(len(starts), 32)
    log_p = min(0.0, 0.5 * (n - 3) * float(np.log1p(-min(share, 1.0 - 1e-12))) + float(np.log(trials)))
    return Lock(float(starts[best]), share, float(along[best] / max(float(energy[best]), 1e-12)), log_p)
