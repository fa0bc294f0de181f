"""How many commands a second the label system sends, from the moments at which a long queue's labels flash.

The likelihood has many maxima, one for every way in which some lights fit by accident. So it is taken on a grid over
what is held possible, with a step that moves the end of the longest queue by less than delays differ: the true
maximum is not stepped over. Every light counts, because a dozen fit a wrong throughput by accident; but of its labels
only those whose durations fit its flashes are tried: that does not depend on the throughput, and leaves an eighth of a
queue after one slot and a handful after two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .decoder import Evidence, Numbers, Prior, chances
from .delays import DelayModel, Kernel

LABELS = 1500  # tried for each light, at most
PAIRS, LIGHTS = 45_000, 12  # pairs of light and label, above which no further light is taken, but so many in any case
WORTH = 10.5  # log-likelihood below the best one, if all moments fitted, of labels that are tried: one lost command


def search_interval(evidence: Sequence[Evidence], prior: Prior, delays: DelayModel) -> float:
    """Seconds between two commands under which the lights' answers are likeliest; `delays` is not changed."""
    lights = max((len(slot.scores) for slot in evidence), default=0)
    if not lights:
        return delays.interval
    flashed = np.zeros(lights)
    for slot in evidence:
        flashed[: len(slot.scores)] += slot.scores.max(axis=1, initial=0.0) > 3.0
    chosen = np.argsort(-flashed, kind="stable")
    kernels = [delays.kernel(slot.begun, delays.fetch(slot.begun), slot.window) for slot in evidence]
    owner, labels, fixed, ends = _pairs(evidence, prior, chosen, kernels, delays)
    parts = [_Part(slot, kernel, chosen, owner, labels, delays) for slot, kernel in zip(evidence, kernels, strict=True)]
    longest = max((len(slot.labels) for slot in evidence), default=0)
    best = (-math.inf, delays.interval)
    for interval, log_prior in delays.intervals(longest):
        total = fixed.copy()
        for part in parts:
            part.add(total, interval)
        top = np.maximum.reduceat(total, ends)
        whole = np.add.reduceat(np.exp(total - np.repeat(top, np.diff(np.append(ends, len(total))))), ends)
        best = max(best, (float((top + np.log(whole)).sum()) + log_prior, interval))
    return best[1]


class _Part:
    """One slot's share in the likelihood of every pair of light and label, as a function of the interval."""

    def __init__(
        self, slot: Evidence, kernel: Kernel, chosen: Numbers, owner: Numbers, labels: Numbers, delays: DelayModel
    ) -> None:
        turn = np.full(max(int(slot.labels.max(initial=-1)), int(labels.max(initial=-1))) + 1, -1, np.intp)
        turn[slot.labels] = np.arange(len(slot.labels))
        lights = chosen[owner]
        pairs = np.flatnonzero((labels >= 0) & (lights < len(slot.scores)))
        pairs = pairs[turn[labels[pairs]] >= 0]
        self._turn = turn[labels[pairs]]
        symbols = slot.symbols[self._turn]
        right, instead, _ = chances(slot.scores, np.zeros(len(slot.scores), bool), delays.config)
        right_, instead_ = right[lights[pairs], symbols], instead[lights[pairs]]
        fits = right_ > 0.03 * instead_  # the moment of a flash of another duration does not matter
        self._fixed = np.where(fits, 0.0, np.log(np.maximum(instead_, 1e-30)))
        self._all, self._pairs, self._turn = pairs, pairs[fits], self._turn[fits]
        self._right, self._instead = right_[fits], instead_[fits]
        self._starts = slot.starts[lights[self._pairs], symbols[fits]].astype(np.float32)
        self._kernel = kernel
        self._heads = np.flatnonzero(np.diff(slot.gates, prepend=-1.0) > 0.0)  # first commands of their portions
        self._portion = np.searchsorted(self._heads, self._turn, side="right") - 1
        self._gates = slot.gates[self._heads]

    def add(self, total: Floats, interval: float) -> None:
        """Add the log-likelihoods to those of all pairs."""
        waits = np.maximum.accumulate(self._gates - self._heads * interval)  # as in `turns`
        sent = waits[self._portion] + self._turn * interval
        late = self._starts - sent.astype(np.float32)
        total[self._all] += self._fixed
        total[self._pairs] += np.log(self._right * self._kernel(late) + self._instead)


def _pairs(
    evidence: Sequence[Evidence], prior: Prior, chosen: Numbers, kernels: Sequence[Kernel], delays: DelayModel
) -> tuple[Numbers, Numbers, Floats, Numbers]:
    """Which labels are tried for the first of the `chosen` lights: per pair the light's number among them, the label
    (-1: none of ours, or any other label at any moment), the log-likelihood that does not depend on the interval; and
    where each light's pairs begin."""
    config = delays.config
    weights = prior.weights / max(float(prior.weights.sum()), 1e-30)
    ours = np.log(np.maximum((1.0 - config.none_fraction) * weights, 1e-30))
    owner, labels, fixed, ends = [], [], [], []
    begin = 0
    for number, light in enumerate(chosen):
        base = ours.copy()
        if len(prior.near):
            base[prior.near] += prior.ratios[light]
        most, usual = base.copy(), base.copy()
        nobody, found = math.log(config.none_fraction), 0
        for slot, kernel in zip(evidence, kernels, strict=True):
            if light < len(slot.scores):
                right, instead, none = chances(slot.scores[[light]], np.array([light >= found]), config)
                match = right[0, slot.symbols]
                most[slot.labels] += np.log(np.maximum(match * kernel.largest + instead, 1e-30))
                usual[slot.labels] += np.log(np.maximum(match + instead, 1e-30))
                nobody += math.log(none[0])
            found = len(slot.scores)
        kept = _best(most, LABELS)
        rest = np.ones(len(most), bool)
        rest[kept] = False
        others = float(np.logaddexp.reduce(usual[rest], initial=nobody))
        owner.append(np.full(len(kept) + 1, number, np.intp))
        labels.append(np.append(kept, -1))
        fixed.append(np.append(base[kept], others))
        ends.append(begin)
        begin += len(kept) + 1
        if begin > PAIRS and number + 1 >= LIGHTS:
            break
    return np.concatenate(owner), np.concatenate(labels), np.concatenate(fixed), np.array(ends, np.intp)


def _best(most: Floats, number: int) -> NDArray[np.intp]:
    """Indices of the largest values, so many at most."""
    kept = np.flatnonzero(most > most.max() - WORTH)
    if len(kept) > number:
        kept = kept[np.argpartition(-most[kept], number)[:number]]
    return kept
