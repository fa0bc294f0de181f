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
from .delays import STAMP_S, DelayModel, turns
from .pace import EARLY, SEEN_AFTER, Pace
from .settings import FlashRequest, IdentifyConfig
from .throughput import search_interval

Flags = NDArray[np.bool_]

TRIES, MORE_TRIES = 9, 20  # slots after which a light is left undecided, with many durations and with few
FIRST_LIGHTS = 60.0  # labels that a stop shows of which nothing is known
SLOWEST = 6.0  # times longer than supposed a queue may be while the throughput is not known,
SILENCE = 4.0  # and no longer than until so many usual pauses between two flashes have passed without one
HURRY = 0.5  # of the time until their turn after which commands are handed over, while the throughput is not known
RECKONED = 0.96  # of a stop's time is reckoned with at first: the rest is for what goes wrong
FEW_LIGHTS = 3.0  # that a stop may name; where it has no time for more, it asks what it can
SINGLES = 3  # slots for each label when they are asked one at a time
ENOUGH_OWED = 0.4  # of the known labels: when the audit owes so many, it gets a slot of its own
REFLECTED = 0.3  # probability of labels without a light here, below which a light is a reflection not worth a slot
STILL_THERE = 0.1  # probability from which a label that did not answer is asked again
FOREIGN = 0.95  # probability from which a light is no label of ours, and nothing is asked for it
RIDES = 0.01  # probability from which a label is asked for a light that is probably none of ours
STILL_SOUGHT = 0.02  # the same of one that was never seen, or whose place is not known


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """The labels that may be visible at a stop; arrays over all labels (L,).

    `weights` lights that each is expected to make here. `expected` those that must be in view because their places are
    known. `wanted` false: nobody would learn anything from its flash. `asked` how often it was asked at other stops:
    when there is no time for all, the ones least asked come first. `rivals` per expected label the labels whose
    predicted image positions are near enough to be confused with it, itself among them. `owed` labels that the audit
    should have asked at earlier stops. `known` those that have been seen, `sought` those of them whose places need
    another view: they are asked wherever they may show.
    """

    weights: Floats
    expected: Flags
    wanted: Flags
    asked: Numbers
    rivals: dict[int, Numbers] = field(default_factory=dict)
    owed: float = 0.0
    known: Flags = field(default_factory=lambda: np.zeros(0, bool))
    sought: Flags = field(default_factory=lambda: np.zeros(0, bool))

    @classmethod
    def anything(cls, labels: int) -> Candidates:
        """Nothing is known: every label may be visible."""
        flags = np.ones(labels, bool)
        weights = np.full(labels, min(1.0, FIRST_LIGHTS / max(labels, 1)))
        return cls(weights, ~flags, flags, np.zeros(labels, np.intp), known=~flags, sought=~flags)


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """What one slot asks: `labels` (K,) in the order of the queue, their `symbols` as in Evidence, and the
    `times` (K,), seconds after the first command, at which they are sent if the throughput is as supposed."""

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
        self.pace = Pace(delays)
        self.evidence: list[Evidence] = []
        self.audited: Numbers = np.zeros(0, np.intp)  # labels known by their place that were asked again as a check
        self.asked: Flags = np.zeros(len(candidates.weights), bool)  # at this stop
        self._rng = np.random.default_rng(seed)
        self._question: Question | None = None
        self._begun = self._started = math.nan
        self._gates: Floats = np.zeros(0)
        self._pending: Flags = np.zeros(0, bool)  # lights that the present question is about
        self._besides = False  # it is also about labels whose lights have not been seen, or are checked
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
                question = self._single(number, posterior)
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

    def _single(self, number: int, posterior: Posterior | None) -> Question | None:
        """Every label by itself; then the likeliest ones of the lights that one flash does not name."""
        here = np.flatnonzero(self._worth_asking())
        if number < len(here):
            return Question(here[number : number + 1], np.zeros(1, np.intp), np.zeros(1))
        if posterior is None or number >= SINGLES * len(here):
            return None
        value = np.zeros(len(self.candidates.weights))
        for light in np.flatnonzero(posterior.open(self.config.min_probability)):
            labels, odds = posterior.candidates[light]
            value[labels] += odds
        value[~self._worth_asking()] = 0.0
        likeliest = np.array([np.argmax(value)], np.intp)
        return Question(likeliest, np.zeros(1, np.intp), np.zeros(1)) if value.any() else None

    def _word(self, digits: Numbers) -> Question:
        labels = np.flatnonzero((digits >= 0) & self._worth_asking())
        order = labels[np.argsort(-digits[labels], kind="stable")]  # the longest are sent first
        return Question(order, digits[order], turns(np.zeros(len(order)), self.delays.interval))

    def _worth_asking(self) -> Flags:
        return np.asarray(self.candidates.wanted & (self.candidates.weights > 0.0))

    def _first(self) -> Question | None:
        """Everything that may be visible, as far as time allows; what is known to be in view goes first."""
        candidates, config = self.candidates, self.config
        first = candidates.expected | candidates.sought
        known = self._rng.permutation(np.flatnonzero(candidates.wanted & first))
        others = self._rng.permutation(np.flatnonzero(self._worth_asking() & ~first))
        others = others[np.argsort(candidates.asked[others], kind="stable")]
        most = self.pace.affordable(len(known), candidates.weights[others], RECKONED * config.stop_s)
        few = float(candidates.weights[others[:most]].sum()) < FEW_LIGHTS
        if few and not len(known):  # too short a time for names; what can be asked at all may be named later
            most = max(most, 1, int(0.5 * (config.stop_s - self.pace.overhead) / self.delays.interval))
        others = others[:most]
        if not len(known) + len(others):
            return None
        groups = [candidates.rivals.get(int(label), label[None]) for label in known]
        lists = [(group, np.full(len(group), 1.0 / len(group))) for group in groups]
        rivals = float(np.quantile([len(group) - 1.0 for group in groups], 0.9)) if groups else 0.0
        new = float(candidates.weights[others].sum())  # lights of which nothing is known
        many = new > 0.1 * (new + float(candidates.weights[known].sum()))
        return self._compose(known, others, lists, max(float(len(others)) if many else 0.0, rivals))

    def _repeat(self, posterior: Posterior, t: float) -> Question | None:
        """Every candidate of every light that is undecided, known labels that did not answer, and the audit."""
        config, candidates = self.config, self.candidates
        number = len(self.evidence) - (TRIES if len(config.durations_s) >= 4 else MORE_TRIES)
        foreign = (
            FOREIGN if candidates.known.any() else 0.5
        )  # at a first stop there are many lights, and they come again
        doubted = (posterior.probability < config.min_probability) & (posterior.none < foreign)
        undecided = np.flatnonzero(doubted & (self._found(len(posterior.label)) > number))
        named = np.flatnonzero(posterior.decided(config.min_probability) & (posterior.none < 0.5))
        seen = np.zeros(len(candidates.weights), bool)
        seen[posterior.label[named]] = True
        unseen = [_share(posterior.candidates[light], ~seen) for light in undecided]
        missing = np.count_nonzero(np.array(unseen) > REFLECTED)
        worth = missing >= max(1.0, config.repeat_fraction * (len(named) + len(undecided)))
        worth |= any(_share(posterior.candidates[light], ~seen & ~candidates.known) > 0.5 for light in undecided)
        audit = silent = np.zeros(0, np.intp)
        if len(self.evidence) == 1:
            known = np.flatnonzero(candidates.expected & self.asked)
            owed = candidates.owed + config.audit_fraction * len(known)
            if worth or owed >= ENOUGH_OWED * len(known) > 0.0:
                self.audited = audit = np.sort(self._rng.permutation(known)[: int(owed)])
            silent = self._still_there(seen)
        left = self._started + config.stop_s - t - EARLY * self.pace.overhead - float(np.mean(config.durations_s))
        if not worth and not len(audit):
            return None
        lists = []
        for light in undecided:
            labels, odds = posterior.candidates[light]
            kept = candidates.wanted[labels] & self.asked[labels]  # others cannot have lit it
            if posterior.none[light] >= 0.5:
                kept &= odds >= RIDES
            lists.append((labels[kept], odds[kept]))
        value = self.pace.cover(lists, len(candidates.weights), len(audit) + len(silent))
        value[audit] = value[silent] = 1.0
        self._besides = bool(len(audit) + len(silent))
        ask = np.flatnonzero(value)
        ask = ask[np.argsort(-value[ask], kind="stable")][: max(0, int(left / self.delays.interval))]
        if not len(ask):
            return None
        doubt = (1.0 - posterior.probability[undecided]) / np.maximum(posterior.probability[undecided], 1e-9)
        question = self._compose(ask, ask[:0], lists, float(np.median(doubt)) if len(doubt) else 0.0)
        return question if float(question.times[-1]) <= left else None  # pauses in the queue may take longer

    def _still_there(self, seen: Flags) -> Numbers:
        """Labels without an answer that may be in view rather than hidden, though their flashes were lost.

        Of those without a place so many show as answered at once; each further view of them is worth more.
        """
        candidates = self.candidates
        lacking = self.asked & (~candidates.known | candidates.sought)
        shows = np.clip(candidates.weights, 0.0, 0.95)
        new = self.asked & ~candidates.known
        shows[new] = min(0.95, float((seen & new).sum()) / max(1.0, float(new.sum())))
        lost = self.config.lost_fraction * shows
        least = np.where(lacking, STILL_SOUGHT, STILL_THERE)
        return np.flatnonzero(
            self.asked & (candidates.expected | lacking) & ~seen & (lost >= least * (lost + 1.0 - shows))
        )

    def _found(self, lights: int) -> Numbers:
        """The slot (N,), counted from 1, in which each light was found."""
        return 1 + np.searchsorted([len(slot.scores) for slot in self.evidence], np.arange(lights), side="right")

    # ---- symbols -----------------------------------------------------------------------------------------------------

    def _compose(
        self, listed: Numbers, others: Numbers, lists: Sequence[tuple[Numbers, Floats]], doubt: float
    ) -> Question:
        """Give every label a duration and a time: `listed` ones by what they may be confused with, then the others."""
        number = len(listed) + len(others)
        plan = self.pace.doubt(number, doubt)
        alphabet, groups, pause = plan.alphabet, plan.groups, self.pace.pause
        cells, symbols = self._colour(listed, lists, alphabet, groups)
        turn = np.argsort(cells, kind="stable")
        order = np.concatenate([listed[turn], others])
        step = math.ceil(len(others) / max(1, groups)) if not len(listed) else number
        cell = np.concatenate([cells[turn], np.arange(len(others)) // max(1, step) + cells.max(initial=0)])
        paused = groups > 1 and number * self.delays.interval < (groups - 1) * pause
        times = turns(cell * pause if paused else 0.0 * cell, self.delays.interval)
        symbols = np.concatenate([symbols[turn], np.arange(len(others)) % alphabet])
        durations = np.array(self.config.durations_s[:alphabet])
        middle = durations[min(2, alphabet - 1)]  # the last ones in a long queue end soon
        fits = (durations[None, :] <= np.maximum(middle, middle - 1 + times[-1] - times)[:, None]).sum(axis=1)
        return Question(order, np.where(symbols < fits, symbols, symbols % fits), times)

    def _colour(
        self, labels: Numbers, lists: Sequence[tuple[Numbers, Floats]], alphabet: int, groups: int
    ) -> tuple[Numbers, Numbers]:
        """A part of the queue and a duration for every label, such that those on a common list differ; greedy.

        Labels come in the order of their importance. Neighbouring parts of the queue overlap by a quarter.
        """
        room = self.pace.pause / self.delays.interval
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
        assert self._question is not None
        self._begun = t
        self._gates = releases(self._question.times, self.delays)

    @property
    def longest(self) -> float:
        """Seconds after which every flash of the present question has ended, or its command counts as lost."""
        assert self._question is not None
        config = self.config
        late = 1.0 if self.delays.rate_is_known or self.evidence else SLOWEST
        ends = late * self._question.times + np.array(config.durations_s)[self._question.symbols]
        return float(ends.max()) + config.poll_s + config.delay_tail_s + SEEN_AFTER * config.pattern.period + 0.5

    def is_over(self, t: float, earliest: float, latest: float, flashed: Flags) -> bool:
        """Whether waiting longer would tell little; no light may be flashing.

        Parameters
        ----------
        t : float
            Up to which the cameras' frames were looked at for flashes.
        earliest : float
            Start of the first flash since `begin`, inf if there was none.
        latest : float
            Last moment since `begin` at which any light flashed, -inf if none did.
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
        sent = t >= fetched + float(self._question.times[-1])  # what still waits would delay the next question
        if sent and len(about) and about.all() and not self._besides:
            return True
        if self.config.scheme == "one at a time" and flashed.any():
            return True
        if (
            not self.delays.rate_is_known and not self.evidence and flashed.any()
        ):  # the queue may be slower than thought
            gap = (latest - earliest) / int(flashed.sum())
            if t < latest + SILENCE * gap:
                return False
        deviations = 1.645 if self._question.times[-1] > self.delays.quantile(1.0) else 2.1
        return t >= fetched + float(self._question.times[-1]) + self.delays.quantile(deviations) + seen

    def answer(self, scores: Floats, starts: Floats, ended: float) -> None:
        """What the cameras saw: `scores`, `starts` as in Evidence, up to loop time `ended`."""
        assert self._question is not None
        question = self._question
        window = max(ended - self._begun + STAMP_S, 1.0)
        self.evidence.append(
            Evidence(self._begun, question.labels, question.symbols, self._gates, window, scores, starts)
        )
        self._question = None

    def posterior(self, prior: Prior, lights: int) -> Posterior:
        """Names of the lights after the answers so far, and the throughput that explains these best."""
        if not self.delays.rate_is_known and self._is_long and self.config.in_order:
            self.delays.interval = search_interval(self.evidence, prior, self.delays)
        return decode(self.evidence, prior, lights, self.delays)

    def learn(self, posterior: Posterior) -> None:
        """Let the delays be learnt from the lights that are named; at the end of a stop."""
        named = np.flatnonzero(posterior.probability >= max(0.99, self.config.min_probability))
        for slot in self.evidence:
            self.delays.learn(slot.begun, *lateness(slot, posterior, named, self.delays.interval))

    @property
    def _is_long(self) -> bool:
        """Whether a queue took so long that the throughput shows."""
        number = max((len(slot.labels) for slot in self.evidence), default=0)
        return number * self.delays.interval > 4.0 * self.delays.median * self.delays.sigma


def _share(candidates: tuple[Numbers, Floats], labels: Flags) -> float:
    """Probability of these labels (L,) among a light's candidates."""
    names, odds = candidates
    return float(odds[labels[names]].sum())


def releases(times: Floats, delays: DelayModel) -> Floats:
    """When each command (K,) is handed to the label system, which sends them at `times`: seconds after the first one.

    A portion of what is sent between two polls goes out one poll before its turn, so that the queue never runs dry, and
    earlier while the system may be faster than supposed, unless there is a pause before it.
    """
    length = delays.config.poll_s or 3.0
    pauses = np.diff(times, prepend=0.0) > 0.5 * length + delays.interval
    hurry = 1.0 if pauses.any() or delays.rate_is_known else HURRY
    portions = np.floor(times * hurry / length + 1e-9)
    first = pauses | (np.diff(portions, prepend=0.0) > 0.0)
    first[:1] = True
    follows = ~pauses[first]
    after = np.maximum(0.0, length * (portions[first] - follows))
    return np.asarray(after[np.cumsum(first) - 1])


def requests(
    question: Question, names: Sequence[str], config: IdentifyConfig, delays: DelayModel
) -> tuple[FlashRequest, ...]:
    """The requests that put a question to the label system, each to be sent at its time of `releases`."""
    after = releases(question.times, delays)
    asked = []
    for moment in np.unique(after):
        here = np.flatnonzero(after == moment)
        durations = tuple(config.durations_s[symbol] for symbol in question.symbols[here])
        asked.append(FlashRequest(tuple(names[label] for label in question.labels[here]), durations, float(moment)))
    return tuple(asked)
