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

import cv2
import numpy as np
from numpy.typing import NDArray

from .pattern import Look

Floats = NDArray[np.float64]

_PRIOR, _MOST = 0.1, 0.5  # fraction of lights that are reflections: at first, and at most
_WEIGHT = 8.0  # lights that the first guess of that fraction counts for
_ROUNDS = 4
_CROWDED = 1.6  # log-odds against a lamp's further reflection, for each that it has
_STAMPS_S = 0.0015  # what time stamps and rows leave uncertain between two places of a picture
_WRONG = 12.0  # no look speaks more than e^12 against a start: somebody may have walked by
_COARSE_S = 0.015  # starts known no better than so tell nothing: at 10 frames a second every tenth pair would agree
_GRID_S, _REACH = 0.001, 60  # starts that are weighed: so many steps to both sides
_CLOCKS = 1e-4 * np.array([-24, -16, -11, -7.5, -5, -3.5, -2, -1, 0, 1, 2, 3.5, 5, 7.5, 11, 16, 24])
_CLOCK = 3e-4  # by which the period of a label may be off, typically
_CLOCK_SHARES = np.gradient(_CLOCKS) / (1.0 + (_CLOCKS / _CLOCK) ** 2)
_CLOCK_SHARES /= _CLOCK_SHARES.sum()
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

    `looks` say when its pattern started, seen `delay` seconds after the frame's time stamp; `peak` is the brightest
    pixel's in any unit, `width`, `u` and `v` in px.
    """

    looks: Sequence[Look]
    peak: float
    width: float
    u: float
    v: float
    delay: float = 0.0


def reflected(lamps: Sequence[Lamp], period: float) -> Floats:
    """Probability of every light that it is the reflection of another one.

    Notes
    -----
    Expectation maximisation over the fraction of reflections, which is small in most rooms and near one half where
    the labels hang opposite a window.
    """
    count = len(lamps)
    odds = np.zeros((count, count))  # [i, j]: that i reflects j, against two labels by themselves
    together = _together(lamps, period)
    for i, j in np.argwhere(together > -np.inf):
        known = together[i, j] + _dimmed(lamps[i], lamps[j]) + _placed(lamps[i], lamps[j])
        odds[i, j] = np.exp(min(known, 50.0))
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


def _together(lamps: Sequence[Lamp], period: float) -> Floats:
    """Log-likelihood ratio (N, N) of the starts: one label's, against two labels'; -inf where they tell nothing.

    One label has one start and one clock, which is a little fast or slow. Two labels that start together, between the
    same two exposures, drift apart, unless their clocks happen to agree too.
    """
    count = len(lamps)
    ratio = np.full((count, count), -np.inf)
    stamps = [look.t for lamp in lamps for look in lamp.looks]
    middle = 0.5 * (min(stamps) + max(stamps)) if stamps else 0.0
    starts = [_start(lamp, middle, period) for lamp in lamps]
    for i, a in enumerate(starts):
        for j, b in enumerate(starts[:i]):
            if a is None or b is None:
                continue
            apart = round(((a.start - b.start + 0.5 * period) % period - 0.5 * period) / _GRID_S)
            if abs(apart) <= _REACH:
                size = 2 * _REACH + 1
                ours = a.likelihood[max(-apart, 0) : size - max(apart, 0)]
                theirs = b.likelihood[max(apart, 0) : size - max(-apart, 0)]
                same = float(np.einsum("sc,sc,c->", ours, theirs, _CLOCK_SHARES))
                ratio[i, j] = ratio[j, i] = np.log(max(same, 1e-30) / (a.total * b.total) * period / _GRID_S)
    return ratio


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Likelihood (starts, clocks) of a lamp, on a grid with `start` in its middle; `total` is its weighted sum."""

    start: float
    likelihood: Floats
    total: float


def _start(lamp: Lamp, middle: float, period: float) -> _Start | None:
    """What a lamp's looks say together; the starts are those at the time `middle`."""
    if not lamp.looks:
        return None
    surest = min(lamp.looks, key=lambda look: look.sigma)
    if surest.sigma > _COARSE_S:
        return None
    since = surest.start + lamp.delay
    grid = since + _GRID_S * np.arange(-_REACH, _REACH + 1)
    total = np.zeros((len(grid), len(_CLOCKS)))
    for look in lamp.looks:
        centre = look.first + 0.5 * look.pitch * (len(look.log_likelihood) - 1)
        then = grid[:, None] - lamp.delay + _CLOCKS * (look.t - middle)
        off = (then - centre + 0.5 * period) % period - 0.5 * period
        index = (off + centre - look.first) / look.pitch
        known = np.maximum(look.log_likelihood, -_WRONG)
        total += np.interp(index, np.arange(len(known)), known, -_WRONG, -_WRONG)
    likelihood = np.exp(total - total.max())
    away = _GRID_S * np.arange(-4, 5)
    blur = np.exp(-((away / _STAMPS_S) ** 2))  # half the variance, because both have it
    likelihood = cv2.filter2D(likelihood, -1, (blur / blur.sum())[:, None], borderType=cv2.BORDER_REPLICATE)
    return _Start(since, likelihood, float(np.einsum("sc,c->", likelihood, _CLOCK_SHARES)))


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
