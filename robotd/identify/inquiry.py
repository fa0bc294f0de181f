"""One stop's questions to the label system: what to ask next, and what the answers mean.

Every question but the first one is put only to labels that the answers so far leave in doubt, and so that the labels
between which a light is undecided answer differently: by another duration, or at another time. That is a search by
weighted colouring: labels on one light's list of candidates get different durations, and places in the queue that are
further apart than delays differ. Misses need no code of their own: a light without an answer stays undecided and is
asked again. Where one duration is all there is and the queue is short, pauses in it make times that can be told apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .code import code_words, largest_prime, on_off_words
from .decoder import Evidence, Numbers, Posterior, Prior, decode, lateness
from .delays import STAMP_S, DelayModel
from .settings import FlashRequest, IdentifyConfig

Flags = NDArray[np.bool_]

SEEN_AFTER = 2.5  # periods from a flash's start to the decision that it is one
TRIES, MORE_TRIES = 4, 12  # slots after which a light is left undecided, with many durations and with few


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """The labels that may be visible at a stop; arrays over all labels (L,).

    `weights` lights that each is expected to make here. `expected` those that must be in view because their places are
    known. `wanted` false: nobody would learn anything from its flash. `asked` how often it was asked at other stops:
    when there is no time for all, the ones least asked come first. `rivals` per expected label the labels whose
    predicted image positions are near enough to be confused with it, itself among them.
    """

    weights: Floats
    expected: Flags
    wanted: Flags
    asked: Numbers
    rivals: dict[int, Numbers] = field(default_factory=dict)

    @classmethod
    def anything(cls, labels: int) -> Candidates:
        """Nothing is known: every label may be visible."""
        flags = np.ones(labels, bool)
        return cls(np.ones(labels), ~flags, flags, np.zeros(labels, np.intp))


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """What one slot asks: `labels` (K,) in the order of the queue, their `symbols` and `times` as in Evidence."""

    labels: Numbers
    symbols: Numbers
    times: Floats


class Inquiry:
    """The questions of one stop.

    Call `next_question` with the lights' posterior (None before the first), `begin` when it was sent, `is_over` while
    waiting, `answer` with what the cameras saw, then `posterior`.
    """

    def __init__(self, candidates: Candidates, config: IdentifyConfig, delays: DelayModel, seed: int = 0) -> None:
        self.candidates = candidates
        self.config = config
        self.delays = delays
        self.evidence: list[Evidence] = []
        self.audit: Numbers = np.zeros(0, np.intp)
        self.asked: Flags = np.zeros(len(candidates.weights), bool)  # at this stop
        self._rng = np.random.default_rng(seed)
        self._question: Question | None = None
        self._begun = self._started = math.nan
        self._pending: Flags = np.zeros(0, bool)  # lights that the present question is about
        self._words = self._code() if config.scheme == "code" else None

    # ---- what to ask -------------------------------------------------------------------------------------------------

    def next_question(self, posterior: Posterior | None, t: float) -> Question | None:
        """The next question, or None when nothing is left that one more would tell.

        Parameters
        ----------
        posterior : Posterior or None
            Of the lights found so far; None before the first question.
        t : float
            Now.
        """
        number = len(self.evidence)
        if number == 0:
            self._started = t
        question = None
        if number < self._most_slots and self.candidates.wanted.any():
            if self.config.scheme == "one at a time":
                question = self._single(number)
            elif self._words is not None and number < self._words.shape[1]:
                question = self._word(self._words[:, number])
            elif number == 0 or posterior is None:
                question = self._first()
            else:
                question = self._repeat(posterior, t)
        self._pending = np.zeros(0, bool) if posterior is None else posterior.open(self.config.min_probability)
        self._question = question
        if question is not None:
            self.asked[question.labels] = True
        return question

    @property
    def _most_slots(self) -> int:
        planned = 0 if self._words is None else self._words.shape[1]
        return 1 << 30 if self.config.scheme == "one at a time" else planned + self.config.max_slots

    def _code(self) -> Numbers:
        labels, durations = len(self.candidates.weights), len(self.config.durations_s)
        if durations < 2:
            return on_off_words(labels, self.config.check_digits)
        words, planned = code_words(labels, largest_prime(durations), self.config.check_digits)
        return words[:, :planned]

    def _single(self, number: int) -> Question | None:
        here = np.flatnonzero(self._worth_asking())
        if number >= len(here):
            return None
        return Question(here[number : number + 1], np.zeros(1, np.intp), np.zeros(1))

    def _word(self, digits: Numbers) -> Question:
        labels = np.flatnonzero((digits >= 0) & self._worth_asking())
        order = labels[np.argsort(-digits[labels], kind="stable")]  # the longest are sent first
        return Question(order, digits[order], np.arange(len(order)) / self.config.commands_per_s)

    def _worth_asking(self) -> Flags:
        return np.asarray(self.candidates.wanted & (self.candidates.weights > 0.0))

    def _first(self) -> Question | None:
        """Everything that may be visible, as far as time allows; what is known to be in view goes first."""
        candidates, config = self.candidates, self.config
        known = self._rng.permutation(np.flatnonzero(candidates.wanted & candidates.expected))
        self.audit = np.sort(known[: round(config.audit_fraction * len(known) + self._rng.uniform(-0.5, 0.5))])
        others = self._rng.permutation(np.flatnonzero(self._worth_asking() & ~candidates.expected))
        others = others[np.argsort(candidates.asked[others], kind="stable")]
        most = int(self._first_share * (config.stop_s - self._overhead) * config.commands_per_s) - len(known)
        others = others[: max(most, 0)]
        if not len(known) + len(others):
            return None
        groups = [candidates.rivals.get(int(label), label[None]) for label in known]
        lists = [(group, np.full(len(group), 1.0 / len(group))) for group in groups]
        rivals = float(np.quantile([len(group) - 1.0 for group in groups], 0.9)) if groups else 0.0
        return self._compose(known, others, lists, max(float(len(others)), rivals))

    @property
    def _first_share(self) -> float:
        """How much of a stop's time the first question may take, so that what it leaves open can be asked again."""
        return 0.42 if len(self.config.durations_s) >= 4 else 0.22

    def _repeat(self, posterior: Posterior, t: float) -> Question | None:
        """Every candidate of every light that is undecided, known labels that did not answer, and the audit."""
        config, candidates = self.config, self.candidates
        number = len(self.evidence) - (TRIES if len(config.durations_s) >= 4 else MORE_TRIES)
        undecided = np.flatnonzero(
            posterior.open(config.min_probability) & (self._found(len(posterior.label)) > number)
        )
        named = np.flatnonzero(posterior.decided(config.min_probability) & (posterior.none < 0.5))
        worth = len(undecided) >= max(1.0, config.repeat_fraction * (len(named) + len(undecided)))
        silent = np.zeros(0, np.intp)
        if len(self.evidence) == 1:
            silent = np.setdiff1d(np.flatnonzero(candidates.expected & self.asked), posterior.label[named])
        audit, self.audit = (self.audit, np.zeros(0, np.intp)) if len(self.evidence) == 1 else (silent[:0], self.audit)
        left = (self._started + config.stop_s - t - self._overhead) * config.commands_per_s
        if not worth and not len(audit):
            return None
        lists = []
        value = np.zeros(len(candidates.weights))
        cover = 1.0 - min(max(2.0 / max(len(undecided), 1), 0.01), 0.08)
        for light in undecided:
            labels, odds = posterior.candidates[light]
            kept = candidates.wanted[labels] & self.asked[labels]  # others cannot have lit it
            labels, odds = labels[kept], odds[kept]
            enough = int(np.searchsorted(np.cumsum(odds), cover * odds.sum())) + 1
            value[labels[:enough]] = np.maximum(value[labels[:enough]], odds[:enough])
            lists.append((labels, odds))
        value[audit] = value[silent] = 1.0
        ask = np.flatnonzero(value)
        ask = ask[np.argsort(-value[ask], kind="stable")][: max(0, int(left))]
        if not len(ask):
            return None
        doubt = (1.0 - posterior.probability[undecided]) / np.maximum(posterior.probability[undecided], 1e-9)
        return self._compose(ask, ask[:0], lists, float(np.median(doubt)) if len(doubt) else 0.0)

    def _found(self, lights: int) -> Numbers:
        """The slot (N,), counted from 1, in which each light was found."""
        return 1 + np.searchsorted([len(slot.scores) for slot in self.evidence], np.arange(lights), side="right")

    @property
    def _overhead(self) -> float:
        """Time of a slot beyond its commands' turns and the flashes' lengths."""
        return 0.5 * self.config.poll_s + self.delays.quantile(1.645) + SEEN_AFTER * self.config.pattern.period

    # ---- symbols -----------------------------------------------------------------------------------------------------

    def _compose(
        self, listed: Numbers, others: Numbers, lists: Sequence[tuple[Numbers, Floats]], doubt: float
    ) -> Question:
        """Give every label a duration and a time: `listed` ones by what they may be confused with, then the others."""
        number = len(listed) + len(others)
        alphabet, groups = self._alphabet(number, doubt)
        cells, symbols = self._colour(listed, lists, alphabet, groups)
        turn = np.argsort(cells, kind="stable")
        order = np.concatenate([listed[turn], others])
        step = math.ceil(len(others) / max(1, groups)) if not len(listed) else number
        cell = np.concatenate([cells[turn], np.arange(len(others)) // max(1, step) + cells.max(initial=0)])
        interval = 1.0 / self.config.commands_per_s
        queue = np.arange(number) * interval
        gate = cell * self._pause if groups > 1 and number * interval < (groups - 1) * self._pause else 0.0 * cell
        times = np.maximum.accumulate(gate - queue) + queue
        symbols = np.concatenate([symbols[turn], np.arange(len(others)) % alphabet])
        durations = np.array(self.config.durations_s[:alphabet])
        middle = durations[min(3, alphabet - 1)]  # the last ones in a long queue end soon
        fits = (durations[None, :] <= np.maximum(middle, middle - 1 + times[-1] - times)[:, None]).sum(axis=1)
        return Question(order, np.where(symbols < fits, symbols, symbols % fits), times)

    def _alphabet(self, number: int, doubt: float) -> tuple[int, int]:
        """Number of durations and of groups in the queue with which lights of such doubt are named soonest.

        Each slot divides the odds against a light's label by the number of symbols that can be told apart.
        """
        config = self.config
        width = 4.13 * self.delays.median * self.delays.sigma if config.in_order else math.inf
        target = 0.3 * (1.0 - config.min_probability) / config.min_probability
        needed = math.log(max(doubt / max(target, 1e-6), 1.0))
        best = (math.inf, 1, 1)
        for groups in range(1, min(number, 12) + 1) if config.in_order else (1,):
            span = max(number / config.commands_per_s, (groups - 1) * self._pause)
            times = max(float(groups), span / width)
            for alphabet in range(1, min(len(config.durations_s), number) + 1):
                cost = span + self._overhead + config.durations_s[alphabet - 1]
                gain = math.log(max(alphabet * times, 1.2))
                best = min(best, (cost * max(1.0, needed / gain), alphabet, groups))
        return best[1], best[2]

    @property
    def _pause(self) -> float:
        """Time between two groups of the queue that can be told apart, in whole polls."""
        apart = 4.0 * self.delays.median * max(self.delays.sigma, 0.3)
        return self.config.poll_s * math.ceil(apart / self.config.poll_s) if self.config.poll_s else apart

    def _colour(
        self, labels: Numbers, lists: Sequence[tuple[Numbers, Floats]], alphabet: int, groups: int
    ) -> tuple[Numbers, Numbers]:
        """A part of the queue and a duration for every label, such that those on a common list differ; greedy.

        Labels come in the order of their importance. Neighbouring parts of the queue overlap by a quarter.
        """
        room = self.config.commands_per_s * self._pause
        parts = max(groups, math.ceil(len(labels) / room)) if self.config.in_order else 1
        room = max(room, math.ceil(len(labels) / parts))
        place = np.full(len(self.candidates.weights), -1, np.intp)
        place[labels] = np.arange(len(labels))
        member: list[list[tuple[Numbers, Floats]]] = [[] for _ in labels]
        for group, odds in lists:
            asked = place[group] >= 0
            turns = place[group][asked]
            for turn, chance in zip(turns, odds[asked], strict=True):
                member[turn].append((turns, chance * odds[asked]))
        chosen = np.full(len(labels), -1, np.intp)
        load = np.zeros(parts)
        for turn, groups_ in enumerate(member):
            cost = np.zeros((alphabet, parts))
            if groups_:
                others = np.concatenate([turns for turns, _ in groups_])
                weights = np.concatenate([weights for _, weights in groups_])
                done = chosen[others] >= 0
                taken = np.bincount(chosen[others[done]], weights[done], minlength=cost.size).reshape(cost.shape)
                cost += taken
                cost[:, 1:] += 0.25 * taken[:, :-1]
                cost[:, :-1] += 0.25 * taken[:, 1:]
            cost += 1e-6 * load + 1e-9 * ((np.arange(alphabet) - turn) % alphabet)[:, None]
            cost[:, load >= room] = math.inf
            chosen[turn] = int(np.argmin(cost))
            load[chosen[turn] % parts] += 1
        return chosen % parts, chosen // parts

    # ---- waiting and answers -----------------------------------------------------------------------------------------

    def begin(self, t: float) -> None:
        """The question is being sent, from time `t` on."""
        self._begun = t

    @property
    def longest(self) -> float:
        """Seconds after which every flash of the present question has ended, or its command counts as lost."""
        assert self._question is not None
        config = self.config
        ends = self._question.times + np.array(config.durations_s)[self._question.symbols]
        return float(ends.max()) + config.poll_s + config.delay_tail_s + SEEN_AFTER * config.pattern.period + 0.5

    def is_over(self, t: float, earliest: float, flashed: Flags) -> bool:
        """Whether waiting longer would tell little; no light may be flashing.

        Parameters
        ----------
        t : float
            Up to which the cameras' frames were looked at for flashes.
        earliest : float
            Start of the first flash since `begin`, inf if there was none.
        flashed : (N,) bool array
            Lights that have flashed since `begin`; those of the posterior first.
        """
        assert self._question is not None
        fetch = np.cumsum(self.delays.fetch(self._begun))
        offset = float(self.delays.offsets[min(int(np.searchsorted(fetch, 0.98)), len(fetch) - 1)])
        fetched = self._begun + min(offset, max(0.0, earliest - self._begun))
        seen = SEEN_AFTER * self.config.pattern.period
        pending = self._pending
        about = np.zeros(0, bool) if not len(pending) else flashed[: len(pending)][pending]
        if len(about) and about.all() and not self.candidates.expected.any():
            return True
        if self.config.scheme == "one at a time" and flashed.any():
            return True
        deviations = 1.645 if self._question.times[-1] > self.delays.quantile(1.0) else 2.1
        return t >= fetched + float(self._question.times[-1]) + self.delays.quantile(deviations) + seen

    def answer(self, scores: Floats, starts: Floats, ended: float) -> None:
        """What the cameras saw: `scores`, `starts` as in Evidence, up to loop time `ended`."""
        assert self._question is not None
        question = self._question
        window = max(ended - self._begun + STAMP_S, 1.0)
        self.evidence.append(
            Evidence(self._begun, question.labels, question.symbols, question.times, window, scores, starts)
        )
        self._question = None

    def posterior(self, prior: Prior, lights: int) -> Posterior:
        """Names of the lights after the answers so far."""
        return decode(self.evidence, prior, lights, self.delays)

    def learn(self, posterior: Posterior) -> None:
        """Let the delays be learnt from the lights that are named; at the end of a stop."""
        named = np.flatnonzero(posterior.probability >= max(0.99, self.config.min_probability))
        for slot in self.evidence:
            self.delays.learn(slot.begun, lateness(slot, posterior, named))


def requests(question: Question, names: Sequence[str], config: IdentifyConfig) -> tuple[FlashRequest, ...]:
    """The requests that put a question to the label system, in portions of what it sends between two polls.

    A portion goes out one poll before its turn, so that the queue never runs dry, unless there is a pause before it.
    """
    length = config.poll_s or 3.0
    portions = np.floor(question.times / length + 1e-9).astype(int)
    asked = []
    end = -math.inf
    for portion in np.unique(portions):
        here = np.flatnonzero(portions == portion)
        follows = question.times[here[0]] - end < 0.5 * length
        after = max(0.0, length * (portion - 1 if follows else portion))
        durations = tuple(config.durations_s[symbol] for symbol in question.symbols[here])
        asked.append(FlashRequest(tuple(names[label] for label in question.labels[here]), durations, after))
        end = float(question.times[here[-1]])
    return tuple(asked)
