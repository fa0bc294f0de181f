"""Which lights are reflections of others: lights of one label start within milliseconds of each other.

Two labels start together by chance alone, most often where the period is a multiple of the time between two frames.
How surprising that would be is weighed against the fraction of reflections among the lights, with what a surface
usually does to them: it takes light away and blurs, and a floor's reflection is straight below, a wall's or a window's
rather beside. Each of these alone decides nothing; a reflection may well be the brighter one where the label is seen at
a steep angle, and hang anywhere if the mirror does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_PRIOR, _MOST = 0.1, 0.5  # fraction of lights that are reflections: at first, and at most
_WEIGHT = 8.0  # lights that the first guess of that fraction counts for
_ROUNDS = 4
_CROWDED = 1.6  # log-odds against a lamp's further reflection, for each that it has
_STAMPS_S = 0.0015  # what time stamps and rows leave uncertain between two places of a picture
_LOOK_S = 0.0005  # no look is surer
_DISPROOF = 6.0  # squared spreads beyond which a difference speaks against one lamp by itself
_COARSE_S = 0.015  # starts known no better than so tell nothing: at 10 frames a second every tenth pair would agree
_LOSS = (-1.0, 0.6)  # mean and standard deviation of log(reflected peak / direct peak)
_LABELS = 1.3  # standard deviation of log(peak) between labels, times the square root of 2
_BLUR = (0.2, 0.2)  # the same of log(width)
_WIDTHS = 0.2
_BELOW, _BESIDE = 0.25, 0.25  # of reflections, straight below and beside their lights; the others are anywhere
_ROWS = 0.1  # of pairs of labels, side by side on a shelf
_ASIDE = (4.0, 0.05)  # px, and of the distance: uneven floors, and cameras that are neither level nor upright


@dataclass(frozen=True, slots=True)
class Lamp:
    """A light as the fingerprint sees it.

    `starts` is (K, 3): time of a look, start of the pattern in seconds, and its standard deviation; `peak` is the
    brightest pixel's in any unit, `width`, `u` and `v` in px.
    """

    starts: Floats
    peak: float
    width: float
    u: float
    v: float


def reflected(lamps: Sequence[Lamp], period: float) -> Floats:
    """Probability of every light that it is the reflection of another one.

    Notes
    -----
    Expectation maximisation over the fraction of reflections, which is small in most rooms and near one half where
    the labels hang opposite a window.
    """
    count = len(lamps)
    odds = np.zeros((count, count))  # [i, j]: that i reflects j, against two labels by themselves
    for i in range(count):
        for j in range(count):
            if i != j:
                odds[i, j] = np.exp(min(_odds(lamps[i], lamps[j], period), 50.0))
    prior = _PRIOR
    probability = np.zeros(count)
    for _ in range(_ROUNDS):
        probability = np.zeros(count)
        shares = np.zeros((count, count))  # [i, j]: probability that i reflects j
        for i in np.argsort([_directness(lamp) for lamp in lamps]):
            # a reflection has no reflections, and few lamps have several: what has some is less likely to have one more
            others = shares.sum(axis=0) - shares[i]
            parts = odds[i] * (1.0 - probability) * np.exp(-_CROWDED * others)
            parts *= prior / (1.0 - prior) / max(count - 1, 1)
            # nor is one that is seen in others, which is why neither of two equals is called the reflection
            seen = odds[:, i].sum() * prior / (1.0 - prior) / max(count - 1, 1)
            shares[i] = parts / (1.0 + parts.sum() + seen)
            probability[i] = shares[i].sum()
        prior = float(np.clip((probability.sum() + _WEIGHT * _PRIOR) / (count + _WEIGHT), 0.02, _MOST))
    return probability


def _directness(lamp: Lamp) -> float:
    """The more, the rather a light is seen directly."""
    loss = np.log(max(lamp.peak, 1e-9)) * -_LOSS[0] / _LOSS[1] ** 2
    return float(loss - np.log(max(lamp.width, 1e-3)) * _BLUR[0] / _BLUR[1] ** 2)


def _odds(a: Lamp, b: Lamp, period: float) -> float:
    """Log-likelihood ratio of all that is known: a reflects b, against two labels."""
    return _together(a, b, period) + _dimmed(a, b) + _placed(a, b)


def _together(a: Lamp, b: Lamp, period: float) -> float:
    """Log-likelihood ratio of the starts: the same at every time, against any.

    The differences at all times at which both were looked at are averaged, but their uncertainty does not shrink by
    it, because starts that fall between the same two exposures look the same every time.
    """
    weight, mean, least = 0.0, 0.0, np.inf
    apart = []
    for t, start, sigma in a.starts:
        near = b.starts[np.argmin(np.abs(b.starts[:, 0] - t))]
        variance = float(sigma**2 + near[2] ** 2) + _LOOK_S**2
        if abs(near[0] - t) <= 1.5 * period and variance <= _COARSE_S**2:
            difference = float((start - near[1] + 0.5 * period) % period - 0.5 * period)
            apart.append(difference**2 / (variance + _STAMPS_S**2))
            least = min(least, variance)
            weight += 1.0 / variance
            mean += difference / variance
    if not apart:
        return -np.inf
    variance = least + _STAMPS_S**2
    spread = max(0.0, max(apart) - _DISPROOF)  # because one time far apart disproves it
    return float(-0.5 * (mean / weight) ** 2 / variance + np.log(period / np.sqrt(2.0 * np.pi * variance)) - spread)


def _dimmed(a: Lamp, b: Lamp) -> float:
    """Log-likelihood ratio of the lights' peaks and widths: a reflects b, against two labels."""
    peak = float(np.log(max(a.peak, 1e-9) / max(b.peak, 1e-9)))
    width = float(np.log(max(a.width, 1e-3) / max(b.width, 1e-3)))
    return _normal(peak, *_LOSS) - _normal(peak, 0.0, _LABELS) + _normal(width, *_BLUR) - _normal(width, 0.0, _WIDTHS)


def _placed(a: Lamp, b: Lamp) -> float:
    """Log-likelihood ratio of the direction in which a is seen from b: a reflects b, against two labels."""
    right, down = a.u - b.u, a.v - b.v
    spread = float(np.clip(np.hypot(_ASIDE[0] / max(np.hypot(right, down), 1.0), _ASIDE[1]), 0.0, 1.0))
    below = np.exp(_normal(float(np.arctan2(right, down)), 0.0, spread))
    beside = 0.5 * np.exp(_normal(float(np.arctan2(down, abs(right))), 0.0, spread))
    anywhere = np.sqrt(2.0 * np.pi) / (2.0 * np.pi)  # because `_normal` leaves this factor out
    reflection = _BELOW * below + _BESIDE * beside + (1.0 - _BELOW - _BESIDE) * anywhere
    return float(np.log(reflection / (_ROWS * beside + (1.0 - _ROWS) * anywhere)))


def _normal(x: float, mean: float, sigma: float) -> float:
    return float(-0.5 * ((x - mean) / sigma) ** 2 - np.log(sigma))
