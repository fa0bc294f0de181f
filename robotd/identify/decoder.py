"""Which label is each light: the posterior probability over all labels, given every slot's requests and flashes.

In a slot every label that is asked has its own pair of symbols: a duration, and a moment in the queue of commands. A
light shows the duration it flashed for and when that began. Lost commands, flashes that nobody asked for, late
commands and lights that are no label of ours are part of the model, so no single slot decides. Where labels are known
well enough to say where in an image they must appear, that is one more symbol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .delays import DelayModel, Kernel, turns
from .settings import IdentifyConfig

Singles = NDArray[np.float32]
Numbers = NDArray[np.intp]

NONE_FLASHES = 0.1  # probability that a light which is no label of ours flashes in a slot after the one that found it
TWICE = 0.1  # how likely a label that has its light makes another one in the same stop, relative to one that has none
LEAST = 1e-4  # probability from which a label is on a light's list of candidates
LONGEST = 200  # labels on such a list
_AT_ONCE = 1 << 19  # light-label pairs computed at once: about 10 MB
_NAMED = 0.9  # probability from which a light may teach the delays


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What one slot asked, and what the lights answered.

    `labels` (K,) indices of the labels asked, in the order of the queue, with `symbols` (K,) indices of durations and
    `gates` (K,) seconds after the first request from which on each command may be sent. `scores` (N, Q) log-likelihood
    of a flash of each duration at each light relative to darkness, its start uniform over `window` seconds; `starts`
    (N, Q) the likeliest start, seconds after the slot began. `begun` loop time of the first request.
    """

    begun: float
    labels: Numbers
    symbols: Numbers
    gates: Floats
    window: float
    scores: Floats
    starts: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the lights before they flash.

    `weights` (L,) how many lights each label is expected to make at this stop; their scale does not matter. `near`
    (M,) labels whose image positions are predicted, and `ratios` (N, M) the log-density of each light's position under
    that prediction, relative to one that is uniform over the image.
    """

    weights: Floats
    near: Numbers = field(default_factory=lambda: np.zeros(0, np.intp))
    ratios: Floats = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Per light: its likeliest `label`, that one's `probability`, that of `none` of ours, and all `candidates`.

    `candidates` holds for every light the labels of probability LEAST or more, likeliest first, and the probabilities.
    """

    label: Numbers
    probability: Floats
    none: Floats
    candidates: list[tuple[Numbers, Floats]]

    def decided(self, threshold: float) -> NDArray[np.bool_]:
        """Lights (N,) that have a name."""
        return np.asarray(self.probability >= threshold)

    def open(self, threshold: float) -> NDArray[np.bool_]:
        """Lights (N,) that are probably labels, but nobody can say which."""
        return np.asarray((self.probability < threshold) & (self.none < 0.5))


def decode(evidence: Sequence[Evidence], prior: Prior, lights: int, delays: DelayModel) -> Posterior:
    """Name the lights.

    Parameters
    ----------
    evidence : sequence of Evidence
        One per slot; lights that were found later than a slot have no rows in it.
    prior : Prior
    lights : int
        Number N of lights.
    delays : DelayModel
        Its poll phase is refined by the lights that are named without it; `delays` itself is not changed.
    """
    fetches = [delays.fetch(slot.begun) for slot in evidence]
    posterior = _pass(evidence, prior, lights, delays, fetches)
    if not evidence:
        return posterior
    if delays.config.in_order:
        named = np.flatnonzero(posterior.probability >= _NAMED)
        late = [lateness(slot, posterior, named, delays.interval)[0] for slot in evidence]
        if sum(len(values) for values in late) >= 3:
            fetches = [
                delays.locate(slot.begun, values, np.ones(len(values)))
                for slot, values in zip(evidence, late, strict=True)
            ]
    return _pass(evidence, prior, lights, delays, fetches, posterior)


def lateness(slot: Evidence, posterior: Posterior, lights: Numbers, interval: float) -> tuple[Floats, Numbers]:
    """How late those lights were that flashed as asked, their labels' commands being sent `interval` seconds apart.

    Returns
    -------
    late : (K,) array
        Seconds from each label's turn to the flash of its light.
    turn : (K,) array
        Place of the label in the queue.
    """
    place = np.full(int(slot.labels.max(initial=-1)) + 1, -1, np.intp)
    place[slot.labels] = np.arange(len(slot.labels))
    lights = lights[lights < len(slot.scores)]
    labels = posterior.label[lights]
    inside = labels < len(place)
    lights, labels = lights[inside], labels[inside]
    turn = place[labels]
    lights, turn = lights[turn >= 0], turn[turn >= 0]
    symbols = slot.symbols[turn]
    lit = slot.scores[lights, symbols] > np.maximum(slot.scores[lights].max(axis=1, initial=-np.inf) - 1.0, 3.0)
    late = slot.starts[lights, symbols] - turns(slot.gates, interval)[turn]
    return np.asarray(late[lit]), np.asarray(turn[lit])


def _pass(
    evidence: Sequence[Evidence],
    prior: Prior,
    lights: int,
    delays: DelayModel,
    fetches: Sequence[Floats],
    earlier: Posterior | None = None,
) -> Posterior:
    config = delays.config
    times = [turns(slot.gates, delays.interval) for slot in evidence]
    elsewhere = np.zeros(len(prior.weights))  # how many lights of this stop each label has already, probably
    claims = [] if earlier is None else earlier.candidates
    for names, odds in claims:
        elsewhere[names] += odds
    again = _again(elsewhere).astype(np.float32)
    kernels = [delays.kernel(fetch, slot.window) for slot, fetch in zip(evidence, fetches, strict=True)]
    weights = prior.weights / max(float(prior.weights.sum()), 1e-30)
    ours = np.log(np.maximum((1.0 - config.none_fraction) * weights, 1e-30)).astype(np.float32)
    label, probability = np.zeros(lights, np.intp), np.zeros(lights)
    none, candidates = np.zeros(lights), []
    step = max(1, _AT_ONCE // max(1, len(weights)))
    for first in range(0, lights, step):
        part = slice(first, min(first + step, lights))
        total = np.tile(ours, (part.stop - first, 1))
        if len(prior.near):
            total[:, prior.near] += prior.ratios[part].astype(np.float32)
        total += again
        for row, (names, odds) in zip(total, claims[part], strict=False):  # its own claim does not count
            row[names] += _again(elsewhere[names] - odds) - again[names]
        nobody = np.full(len(total), np.log(config.none_fraction))
        found = 0
        for slot, sent, kernel in zip(evidence, times, kernels, strict=True):
            _add(slot, sent, kernel, config, part, found, total, nobody)
            found = len(slot.scores)
        top = np.maximum(total.max(axis=1, initial=-np.inf), nobody)
        odds = np.exp(total - top[:, None].astype(np.float32))
        nobody = np.exp(nobody - top)
        whole = odds.sum(axis=1, dtype=float) + nobody
        none[part] = nobody / whole
        label[part] = np.argmax(odds, axis=1) if odds.shape[1] else 0
        for row, sum_ in zip(odds, whole, strict=True):
            kept = np.flatnonzero(row > LEAST * sum_)
            kept = kept[np.argsort(-row[kept], kind="stable")][:LONGEST]
            candidates.append((kept, row[kept] / sum_))
        probability[part] = odds.max(axis=1, initial=0.0) / whole
    return Posterior(label, probability, none, candidates)


def _again(lights: Floats) -> Floats:
    """Log-probability that a label which has so many lights already makes another one, relative to one without."""
    return np.asarray(np.log(1.0 - (1.0 - TWICE) * np.clip(lights, 0.0, 1.0)))


def _add(
    slot: Evidence,
    times: Floats,
    kernel: Kernel,
    config: IdentifyConfig,
    part: slice,
    found: int,
    total: Singles,
    nobody: Floats,
) -> None:
    """Add one slot's log-likelihoods, relative to that of a label that was not asked, for the lights of `part`.

    Lights from number `found` on were found in this slot, because they flashed: that tells nothing about what they are.
    """
    scores, starts = slot.scores[part], slot.starts[part]
    rows = len(scores)  # the lights after these were found later
    if not rows:
        return
    right, instead, none = chances(scores, np.arange(part.start, part.start + rows) >= found, config)
    if len(slot.labels):
        late = starts.astype(np.float32)[:, slot.symbols] - times.astype(np.float32)
        ratio = right[:, slot.symbols] * kernel(late)
        ratio += instead[:, None]
        total[:rows, slot.labels] += np.log(np.maximum(ratio, 1e-30))
    nobody[:rows] += np.log(none)


def chances(scores: Floats, new: NDArray[np.bool_], config: IdentifyConfig) -> tuple[Singles, Singles, Floats]:
    """Likelihoods of lights' answers (N, Q) to one slot, relative to that under a label which was not asked.

    Returns
    -------
    right : (N, Q) array
        Under a label that was asked for each duration and flashed for it, at a usual moment.
    instead : (N,) array
        Under a label that was asked and whose command was lost.
    none : (N,) array
        Under something that is no label of ours; those lights that are `new` flashed, or nobody would know of them.
    """
    top = np.maximum(scores.max(axis=1, initial=0.0), 0.0)[:, None]
    flash, dark = np.exp(scores - top), np.exp(-top)
    other = flash.mean(axis=1, keepdims=True)
    lost, surprise = config.lost_fraction, config.surprise
    unasked = (1.0 - surprise) * dark + surprise * other
    instead = (1.0 - lost) * surprise * other + lost * dark
    right = (1.0 - lost) * (1.0 - surprise) * flash
    flashes = np.where(new, 1.0, NONE_FLASHES)[:, None]
    none = np.maximum((flashes * other + (1.0 - flashes) * dark) / unasked, 1e-300)
    return (right / unasked).astype(np.float32), (instead / unasked).astype(np.float32)[:, 0], none[:, 0]
