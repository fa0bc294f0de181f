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
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .decoder import Evidence, Numbers, Prior, Singles, chances
from .delays import STAMP_S, TABLE_STEP_S, DelayModel, Kernel

compiled: ModuleType | None
try:
    from . import _throughput

    compiled = _throughput
except ImportError:  # built with ROBOTD_NO_EXTENSIONS=1
    compiled = None

LABELS = 1500  # tried for each light, at most
PAIRS, LIGHTS = 45_000, 12  # pairs of light and label, above which no further light is taken, but so many in any case
PART, FEWEST = 16, 12  # of all pairs the part that is tried on the whole grid, with so many lights in any case
LEFT = 0.2  # of the grid, for the other lights
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
    kernels = [delays.kernel(delays.fetch(slot.begun), slot.window) for slot in evidence]
    owner, labels, fixed, ends = _pairs(evidence, prior, chosen, kernels, delays)
    answers, decided = _answers(evidence, kernels, chosen, owner, labels, delays)
    fixed += decided
    odds = np.exp(np.maximum(fixed - np.maximum.reduceat(fixed, ends)[owner], -600.0))
    longest = max((len(slot.labels) for slot in evidence), default=0)
    intervals, scores = (np.array(column) for column in zip(*delays.intervals(longest), strict=True))
    sizes = np.diff(np.append(ends, len(odds)))
    order = np.argsort(sizes, kind="stable")
    tell_most = np.zeros(len(ends), bool)  # lights with the fewest labels; the others judge what these leave
    tell_most[order[: max(FEWEST, int(np.searchsorted(np.cumsum(sizes[order]), len(odds) / PART)))]] = True
    left = np.arange(len(intervals))
    for some, kept in ((tell_most, LEFT), (~tell_most, 0.0)):
        pairs = some[owner]
        lights_ = np.append(0, np.cumsum(sizes[some]))
        scores[left] += log_likelihoods(intervals[left], odds[pairs], lights_, answers.of(pairs))
        left = left[np.argsort(-scores[left], kind="stable")][: max(1, math.ceil(kept * len(left)))]
    return float(intervals[left[0]])


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """What lights answered (A,) to questions put to their labels, in the order of the pairs of light and label.

    `begins` (P + 1,) where each pair's answers begin. `slot`, `turn` in that slot's queue, and `portion` of the queue,
    counted over all slots; `start` of the flash, `right` and `instead` as of `chances`. `portions` (S + 1,) where each
    slot's begin in `gates` and `heads` (H,): when they are handed over, and their first turns. `table` (S, T) of the
    kernels.
    """

    begins: Numbers
    slot: Numbers
    turn: Numbers
    portion: Numbers
    start: Singles
    right: Singles
    instead: Singles
    portions: Numbers
    gates: Floats
    heads: Numbers
    table: Singles

    def of(self, pairs: NDArray[np.bool_]) -> Answers:
        """The answers of some of the pairs."""
        count = np.diff(self.begins)
        kept = np.repeat(pairs, count)
        return replace(
            self,
            begins=np.append(0, np.cumsum(count[pairs])),
            slot=self.slot[kept],
            turn=self.turn[kept],
            portion=self.portion[kept],
            start=self.start[kept],
            right=self.right[kept],
            instead=self.instead[kept],
        )


def log_likelihoods(intervals: Floats, odds: Floats, lights: Numbers, answers: Answers) -> Floats:
    """Log-likelihood (K,) of the lights' answers under each of the intervals (K,) in seconds.

    Parameters
    ----------
    intervals : (K,) array
    odds : (P,) array
        Of every pair of light and label, without what the interval decides.
    lights : (N + 1,) array
        Where each light's pairs begin.
    answers : Answers
        That the interval decides about.
    """
    if compiled is None:
        return reference_log_likelihoods(intervals, odds, lights, answers)
    a, waits, scores = answers, np.zeros(len(answers.gates)), np.zeros(len(intervals))
    compiled.log_likelihoods(
        intervals,
        odds,
        lights,
        a.begins,
        a.slot,
        a.portion,
        a.turn,
        a.start,
        a.right,
        a.instead,
        a.portions,
        a.gates,
        a.heads,
        a.table,
        -STAMP_S,
        TABLE_STEP_S,
        waits,
        scores,
    )
    return scores


def reference_log_likelihoods(intervals: Floats, odds: Floats, lights: Numbers, answers: Answers) -> Floats:
    """The same in numpy."""
    scores = np.zeros(len(intervals))
    pair = np.repeat(np.arange(len(odds)), np.diff(answers.begins))
    slots = list(zip(answers.portions[:-1], answers.portions[1:], strict=True))
    for k, interval in enumerate(intervals if len(lights) > 1 else ()):
        waits = answers.gates - answers.heads * interval
        for begin, end in slots:
            waits[begin:end] = np.maximum.accumulate(waits[begin:end])  # as in `turns`
        late = answers.start - (waits[answers.portion] + answers.turn * interval).astype(np.float32)
        index = ((late + (STAMP_S + 0.5 * TABLE_STEP_S)) / TABLE_STEP_S).astype(np.intp)
        match = answers.table[answers.slot, np.clip(index, 0, answers.table.shape[1] - 1)]
        product = odds.copy()
        np.multiply.at(product, pair, answers.right * match + answers.instead)
        scores[k] = np.log(np.maximum(np.add.reduceat(product, lights[:-1]), 1e-300)).sum()
    return scores


def _answers(
    evidence: Sequence[Evidence],
    kernels: Sequence[Kernel],
    chosen: Numbers,
    owner: Numbers,
    labels: Numbers,
    delays: DelayModel,
) -> tuple[Answers, Floats]:
    """Answers of the pairs that the interval decides about, and the log-likelihood (P,) of the others."""
    decided = np.zeros(len(labels))
    parts: list[tuple[NDArray[Any], ...]] = []
    heads = [np.flatnonzero(np.diff(slot.gates, prepend=-1.0) > 0.0) for slot in evidence]  # of their portions
    portions = np.append(0, np.cumsum([len(each) for each in heads]))
    lights = chosen[owner]
    for number, slot in enumerate(evidence):
        place = np.full(max(int(slot.labels.max(initial=-1)), int(labels.max(initial=-1))) + 1, -1, np.intp)
        place[slot.labels] = np.arange(len(slot.labels))
        pairs = np.flatnonzero((labels >= 0) & (lights < len(slot.scores)))
        pairs = pairs[place[labels[pairs]] >= 0]
        turn = place[labels[pairs]]
        symbols = slot.symbols[turn]
        right, instead, _ = chances(slot.scores, np.zeros(len(slot.scores), bool), delays.config)
        right_, instead_ = right[lights[pairs], symbols], instead[lights[pairs]]
        fits = right_ > 0.03 * instead_  # the moment of a flash of another duration does not matter
        decided[pairs] += np.where(fits, 0.0, np.log(np.maximum(instead_, 1e-30)))
        pairs, turn, symbols = pairs[fits], turn[fits], symbols[fits]
        portion = portions[number] + np.searchsorted(heads[number], turn, side="right") - 1
        start = slot.starts[lights[pairs], symbols].astype(np.float32)
        parts.append((pairs, np.full(len(pairs), number), turn, portion, start, right_[fits], instead_[fits]))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    pair, slots, turns_, portion, start, right, instead = (column[order] for column in columns)
    begins = np.append(0, np.cumsum(np.bincount(pair, minlength=len(labels))))
    gates = np.concatenate([slot.gates[head] for slot, head in zip(evidence, heads, strict=True)]).astype(float)
    width = max(len(kernel.table) for kernel in kernels)
    table = np.array([np.pad(kernel.table, (0, width - len(kernel.table)), mode="edge") for kernel in kernels])
    return Answers(
        begins, slots, turns_, portion, start, right, instead, portions, gates, np.concatenate(heads), table
    ), decided


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
