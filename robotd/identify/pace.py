"""How long naming takes: the alphabet that names lights soonest, and how many labels one stop has time to ask.

A slot costs its commands' turns, the poll, the delays and the flashes' lengths. It divides the odds against a light's
label by the number of symbols that can be told apart: durations times moments in the queue. From these two follow the
best alphabet of one question, and, question after question, the time until lights have their names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .delays import DelayModel

SEEN_AFTER = 2.5  # periods from a flash's start to the decision that it is one
COVERS = (0.6, 0.7, 0.8, 0.9, 0.95, 0.99)  # parts of a light's candidates that a repeated question may put
GROUPS = 12  # parts of a queue between which there are pauses, at most
SPREAD = 2.0  # candidates that are asked again for one light, relative to the number that its doubt amounts to
FEWEST = 4  # candidates of one light that is asked about again
SILENT = 0.3  # of the lights do not answer: lost, missed, or another label than the likeliest ones
EARLY = 0.4  # of a slot's overhead has passed when most of its lights have answered
AT_EASE = 0.3  # of the doubt that a name may leave


@dataclass(frozen=True, slots=True)
class Round:
    """One question: durations in its `alphabet`, `groups` of the queue with pauses between them, its `seconds`, and how
    many symbols it has that are `told` apart."""

    alphabet: int
    groups: int
    seconds: float
    told: float


class Pace:
    """Reckons with the delays and the throughput as far as they are known."""

    def __init__(self, delays: DelayModel) -> None:
        self.config = delays.config
        self.delays = delays

    @property
    def overhead(self) -> float:
        """Seconds of a slot beyond its commands' turns and the flashes' lengths."""
        return 0.5 * self.config.poll_s + self.delays.quantile(1.645) + SEEN_AFTER * self.config.pattern.period

    @property
    def pause(self) -> float:
        """Seconds between two groups of the queue that can be told apart, in whole polls."""
        apart = 4.0 * self.delays.median * max(self.delays.sigma, 0.3)
        return self.config.poll_s * math.ceil(apart / self.config.poll_s) if self.config.poll_s else apart

    def doubt(self, number: int, doubt: float) -> Round:
        """How to ask `number` labels such that lights of such doubt (odds against their best names) are named soonest.

        Every further question of this kind divides the doubt again, until `min_probability` is reached.
        """
        config = self.config
        width = 4.13 * self.delays.median * self.delays.sigma if config.in_order else math.inf  # sqrt(2 pi e) sigma
        needed = math.log(max(doubt / self._target, 1.0))
        best, least = Round(1, 1, math.inf, 1.0), math.inf
        for groups in range(1, min(number, GROUPS) + 1) if config.in_order else (1,):
            span = max(number * self.delays.interval, (groups - 1) * self.pause)
            times = max(float(groups), span / width)
            for alphabet in range(1, min(len(config.durations_s), number) + 1):
                seconds = span + self.overhead + config.durations_s[alphabet - 1]
                told = max(alphabet * times, 1.2)
                total = seconds * max(1.0, needed / math.log(told))
                if total < least:
                    best, least = Round(alphabet, groups, seconds, told), total
        return best

    @property
    def _target(self) -> float:
        return max(AT_EASE * (1.0 - self.config.min_probability) / self.config.min_probability, 1e-6)

    def seconds(self, known: int, others: int, lights: float) -> float:
        """Time until all is named when `known` labels and `others` are asked, of which `lights` may show anywhere."""
        number = known + others
        first = self.doubt(number, float(max(others, 1)))
        total, before, doubt = first.seconds, 0.0, others / first.told
        needed = -math.expm1(-lights)  # probability that any shows: only then is anything repeated
        while doubt > self._target:
            asked = lights * (1.0 + SPREAD * doubt + SILENT * SPREAD * before)
            seconds, told = self._repeated(min(number, max(FEWEST, math.ceil(asked))), doubt)
            total += needed * seconds
            before, doubt = doubt, doubt / told
        return (
            total + needed * self._repeated(max(1, round(SILENT * lights)), 1.0)[0]
        )  # those that were silent too often

    def _repeated(self, number: int, doubt: float) -> tuple[float, float]:
        """Seconds of a repeated question, which ends when its lights have answered, and what it tells apart."""
        again = self.doubt(number, doubt)
        durations = self.config.durations_s[: again.alphabet]
        mean = sum(durations) / len(durations)
        return again.seconds - durations[-1] + mean - (1.0 - EARLY) * self.overhead, again.told

    def affordable(self, known: int, weights: Floats, seconds: float) -> int:
        """How many labels that may show, likeliest lights first (`weights`), can be asked and named in that time."""
        lights = np.concatenate([[0.0], np.cumsum(weights)])
        least, most = 0, len(weights)
        while least < most:
            middle = (least + most + 1) // 2
            if self.seconds(known, middle, float(lights[middle])) <= seconds:
                least = middle
            else:
                most = middle - 1
        return least

    def cover(self, candidates: Sequence[tuple[NDArray[np.intp], Floats]], labels: int, more: int) -> Floats:
        """Which candidates are worth a command: the value (`labels`,) of each, 0 for those that are not.

        Asking the likeliest candidates of a light, a part c of its odds, is answered with that probability, and a name
        takes about two answers: c squared per second is made greatest. So much is asked where commands cost little.

        Parameters
        ----------
        candidates : sequence of (labels, odds)
            Per light, likeliest first.
        labels, more : int
            Number of labels, and of commands that are sent in any case.
        """
        value, best = np.zeros(labels), 0.0
        ranks = [np.cumsum(odds) / max(float(odds.sum()), 1e-30) for _, odds in candidates]
        fixed = self.overhead + float(np.mean(self.config.durations_s))
        for part in COVERS:
            trial = np.zeros(labels)
            for (names, odds), rank in zip(candidates, ranks, strict=True):
                enough = names[: int(np.searchsorted(rank, part)) + 1]
                trial[enough] = np.maximum(trial[enough], odds[: len(enough)])
            gain = part / (fixed + (np.count_nonzero(trial) + more) * self.delays.interval)
            if gain > best:
                value, best = trial, gain
        return value
