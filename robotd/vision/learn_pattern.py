"""Learn the pattern in which a label flashes, from a recording of one label that flashes all the time.

The label is the place whose light changes most like something that repeats: candidates are the cells that vary, each
one's light curve is folded at every possible period, and the fold that explains most of the curve's energy, at the
shortest period that does as well as its multiples, gives the period. The folded curve is then two levels, with edges
where it crosses the middle; edges are blurred by the exposure, whose length must therefore be known.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .pattern import FlashPattern
from .spot import light_table

Floats = NDArray[np.float64]

_PLACES = 24  # that vary most, examined
_APART = 3  # cells
_GRID = 1.0 / 8.0  # of the resolution that the recording's length gives: step of the periods tried
_AS_GOOD = 0.8  # share of the best fold's explained energy at which a shorter period is preferred
_LEAST_EXPLAINED = 0.7
_SHORTEST_S = 0.008  # on or off; shorter is noise in the fold


def learn_pattern(
    frames: Iterable[NDArray[np.uint8]],
    times: Sequence[float] | Floats,
    exposure: float = 0.010,
    gamma: float = 2.2,
    shortest: float = 0.2,
    longest: float = 3.0,
) -> FlashPattern:
    """The pattern of the one label that flashes in a recording.

    Parameters
    ----------
    frames : iterable of (H, W) uint8 arrays
        Grey images of a camera that stands still; a handful of periods or more, at 20 frames a second or more.
    times : (F,) sequence
        Start of each frame's exposure in seconds, increasing.
    exposure, gamma : float
        Of the camera: seconds, and grey = light^(1/gamma).
    shortest, longest : float
        Limits of the period in seconds.

    Returns
    -------
    FlashPattern
        Its first flash starts at 0, and its longest dark interval is the last.

    Raises
    ------
    InputError
        If the recording is too short, or nothing in it repeats.
    """
    stamps = np.asarray(times, float)
    if len(stamps) < 16 or stamps[-1] - stamps[0] < 3.0 * shortest:
        raise InputError(
            f"the recording has {len(stamps)} frames; expected at least 3 periods of one flashing label: record longer"
        )
    cells = np.stack([cv2.resize(f, (f.shape[1] // 2, f.shape[0] // 2), interpolation=cv2.INTER_AREA) for f in frames])
    if len(cells) != len(stamps):
        raise InputError(f"the recording has {len(cells)} frames but {len(stamps)} time stamps; expected as many")
    curves = _curves(cells, light_table(gamma, 256))
    longest = min(longest, (stamps[-1] - stamps[0]) / 3.0)
    best: tuple[float, float, Floats] | None = None
    for curve in curves:
        period, explained = _period(stamps, curve, shortest, longest)
        weight = explained * float(np.std(curve))
        if explained >= _LEAST_EXPLAINED and (best is None or weight > best[0]):
            best = weight, period, curve
    if best is None:
        raise InputError(
            "nothing in the recording flashes in a pattern that repeats: let one label flash all the time, keep people"
            " out of the picture, and hold the camera still"
        )
    return _pattern(stamps, best[2], best[1], exposure)


def _curves(cells: NDArray[Any], light: NDArray[np.float32]) -> list[Floats]:
    """Light curves of the 2x2-cell places that vary most, less the cells around."""
    change = np.zeros(cells.shape[1:], np.float32)
    means = cells.mean(axis=(1, 2))
    for k in range(1, len(cells)):  # less the flicker of the lamps
        change += (cells[k].astype(np.float32) * np.float32(means[k - 1] / max(means[k], 1.0)) - cells[k - 1]) ** 2
    sums = cv2.boxFilter(change, -1, (2, 2), normalize=False, anchor=(0, 0))
    sums[-1] = sums[:, -1] = 0.0
    curves = []
    for _ in range(_PLACES):
        row, column = divmod(int(np.argmax(sums)), sums.shape[1])
        if sums[row, column] <= 0.0:
            break
        top, left = max(row - _APART, 0), max(column - _APART, 0)
        sums[top : row + _APART + 1, left : column + _APART + 1] = 0.0
        around = light[cells[:, top : row + _APART + 2, left : column + _APART + 2]]
        place = light[cells[:, row : row + 2, column : column + 2]].mean(axis=(1, 2))
        around = np.median(around, axis=(1, 2))
        # because lamps that flicker change the place and its surroundings by the same factor
        curves.append((place - around * (np.median(place) / max(float(np.median(around)), 1e-3))).astype(float))
    return curves


def _period(times: Floats, curve: Floats, shortest: float, longest: float) -> tuple[float, float]:
    """The period whose fold explains most, and the share of the energy that it explains."""
    y = curve - curve.mean()
    seconds = float(times[-1] - times[0])
    pace = seconds / (len(times) - 1)
    # steps of the period so small that the last fold moves by a fraction of a frame
    rates = np.arange(1.0 / longest, 1.0 / shortest, _GRID * 4.0 * pace / (seconds * shortest) * 0.5)
    explained = np.array([_explained(times, y, 1.0 / rate, pace) for rate in rates])
    good = np.flatnonzero(explained >= _AS_GOOD * explained.max())
    first = good[-1]  # of the shortest period
    near = np.abs(rates - rates[first]) < 3.0 * pace / (seconds * shortest)
    peak = int(np.argmax(np.where(near, explained, -np.inf)))
    rate = rates[peak]
    for step in (0.25 * pace / (seconds * shortest), 0.05 * pace / (seconds * shortest)):
        fine = rate + step * np.arange(-6, 7)
        scores = np.array([_explained(times, y, 1.0 / r, pace) for r in fine])
        top = np.flatnonzero(scores >= scores.max() - 0.01 * abs(scores.max()))
        rate = float(fine[top].mean())  # because the fold's bins make a plateau
    return 1.0 / rate, float(_explained(times, y, 1.0 / rate, pace))


def _explained(times: Floats, y: Floats, period: float, pace: float) -> float:
    """Share of the energy of y that its mean over the phases of a period explains, less what chance gives it."""
    bins = max(6, int(period / pace))
    best = 0.0
    for offset in (0.0, 0.5):  # because frames may fall on the borders of one set of bins, and scatter over them
        index = ((times % period) * (bins / period) + offset).astype(int) % bins
        count = np.bincount(index, minlength=bins)
        sums = np.bincount(index, y, bins)
        used = int((count > 0).sum())
        if len(y) - used >= 4:
            share = float((sums**2 / np.maximum(count, 1)).sum() / max(float(y @ y), 1e-12))
            best = max(best, 1.0 - (1.0 - share) * (len(y) - 1) / (len(y) - used))
    return best


def _pattern(times: Floats, curve: Floats, period: float, exposure: float) -> FlashPattern:
    """Edges of the folded curve: rises and falls that, blurred by the exposure, fit it best."""
    phase = (times + 0.5 * exposure) % period
    order = np.argsort(phase)
    phase, values = phase[order], curve[order]
    window = max(3, len(values) // max(40, int(period / 0.02))) | 1
    wrapped = np.concatenate([values[-window:], values, values[:window]])
    smooth = np.array(
        [np.median(wrapped[k + window // 2 + 1 : k + window // 2 + 1 + window]) for k in range(len(values))]
    )
    dark, lit = np.percentile(smooth, [5, 100])
    top = smooth > 0.5 * (dark + lit)
    dark, lit = float(np.median(values[~top])), float(np.median(values[top & (smooth > 0.8 * lit + 0.2 * dark)]))
    on = smooth > 0.5 * (dark + lit)
    turns = np.flatnonzero(on != np.roll(on, 1))
    if len(turns) < 2:
        raise InputError("the label in the recording is never dark: expected flashes with dark intervals between them")
    edges = [(_crossing(phase, smooth, int(k), period, 0.5 * (dark + lit)), bool(on[k])) for k in turns]
    starts = [edge for edge, rising in edges if rising]
    ends = [edge for edge, rising in edges if not rising]
    flashes = []
    for start in starts:
        length = min((end - start) % period for end in ends)
        if length >= _SHORTEST_S:
            flashes.append((start, length))
    if not flashes:
        raise InputError("no flash in the recording is longer than 8 ms; expected a label that flashes")
    flashes.sort()
    for _ in range(2):
        flashes = [_fitted(times, curve, period, exposure, flash, dark, lit) for flash in flashes]
        period, flashes = _paced(times, (curve - dark) / (lit - dark), period, exposure, flashes)
    gaps = [
        (following[0] - start - length) % period
        for (start, length), following in zip(flashes, flashes[1:] + flashes[:1], strict=True)
    ]
    first = (int(np.argmax(gaps)) + 1) % len(flashes)
    flashes = flashes[first:] + flashes[:first]
    origin = flashes[0][0]
    return FlashPattern(
        float(period),
        tuple(((start - origin) % period, (start - origin) % period + length) for start, length in flashes),
    )


def _crossing(phase: Floats, values: Floats, k: int, period: float, middle: float) -> float:
    """Phase at which the folded curve crosses the middle between its samples k - 1 and k."""
    before = phase[k - 1] - (period if k == 0 else 0.0)
    share = np.clip((middle - values[k - 1]) / (values[k] - values[k - 1] + 1e-12), 0.0, 1.0)
    return float(before + share * (phase[k] - before))


def _paced(
    times: Floats, y: Floats, period: float, exposure: float, flashes: list[tuple[float, float]]
) -> tuple[float, list[tuple[float, float]]]:
    """Refine the period, and with it where the flashes are in it, by least absolute deviations."""
    middle, seconds = 0.5 * float(times[0] + times[-1]), float(times[-1] - times[0])
    lengths = [length for _, length in flashes]
    # the recording's middle keeps its phase, so that period and phase are found one after the other
    since = [(start - middle) % period for start, _ in flashes]
    step = 0.03 * period / seconds

    def lit(trial: float) -> Floats:
        model = np.zeros(len(times))
        for start, length in zip(since, lengths, strict=True):
            lag = (times - middle - start + 0.5 * trial) % trial - 0.5 * trial
            model += np.clip(np.minimum(lag + exposure, length) - np.maximum(lag, 0.0), 0.0, None) / exposure
        return model

    for _ in range(4):
        trials = period + step * np.arange(-4, 5)
        losses = np.array([np.abs(y - lit(float(trial))).sum() for trial in trials])
        period = float(trials[np.flatnonzero(losses <= losses.min() * 1.002)].mean())
        step *= 0.4
    return period, [((middle + start) % period, length) for start, length in zip(since, lengths, strict=True)]


def _fitted(
    times: Floats, curve: Floats, period: float, exposure: float, flash: tuple[float, float], dark: float, lit: float
) -> tuple[float, float]:
    """Start and length of one flash by least squares against the exposures near it."""
    start, length = flash
    y = (curve - dark) / (lit - dark)
    since = (times - start + 0.5 * period) % period - 0.5 * period
    reach = 1.5 * exposure + 0.02
    step = 0.25 * exposure + 0.004
    for _ in range(5):
        best = np.inf, start, length
        for first in start + step * np.arange(-2, 3):
            for last in start + length + step * np.arange(-2, 3):
                if last - first < _SHORTEST_S:
                    continue
                lag = since - (first - flash[0])
                near = (since > -reach) & (since < flash[1] + reach)
                model = np.clip(np.minimum(lag + exposure, last - first) - np.maximum(lag, 0.0), 0.0, None) / exposure
                loss = float(np.abs(y[near] - model[near]).sum())
                if loss < best[0]:
                    best = loss, float(first), float(last - first)
        _, start, length = best
        step *= 0.5
    return start, length
