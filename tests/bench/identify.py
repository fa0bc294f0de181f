"""Naming the lights of a stop: every label of the store against every answer, and the search for the throughput."""

from __future__ import annotations

import numpy as np

from robotd.identify.decoder import Prior, decode
from robotd.identify.delays import DelayModel
from robotd.identify.settings import IdentifyConfig
from robotd.identify.throughput import search_interval
from tests.label_bench import coded_stops

from .table import Row, median_ms

STOPS = {29: 29, 100: 29, 1000: 60, 10_000: 60}  # labels of the store, and those that a stop shows


def rows() -> list[Row]:
    """A stop's last slot, with what all slots before it told, against correlating durations with all labels' words."""
    rows = []
    for number, seen in STOPS.items():
        config = IdentifyConfig(stop_s=130.0 * max(1, number // 1000))
        inquiry = coded_stops(number, seen, config, [1])[0].inquiry
        evidence, lights = inquiry.evidence, len(inquiry.evidence[-1].scores)
        prior, delays = Prior(inquiry.candidates.weights), DelayModel(config)
        durations = len(config.durations_s)
        words = np.zeros((number, len(evidence) * durations), np.float32)
        answers = np.zeros((lights, len(evidence) * durations), np.float32)
        for k, slot in enumerate(evidence):
            words[slot.labels, k * durations + slot.symbols] = 1.0
            answers[: len(slot.scores), k * durations : (k + 1) * durations] = slot.scores
        repeats = 3 if number > 1000 else 9
        matched = median_ms(lambda a=answers, w=words: (a @ w.T).argmax(axis=1), 10 * repeats)
        yardstick = "matched filter in numpy"
        name = f"{lights} lights, {number} labels, {len(evidence)} slots"
        named = median_ms(lambda e=evidence, p=prior, n=lights, d=delays: decode(e, p, n, d), repeats)
        found = median_ms(lambda e=evidence, p=prior, d=delays: search_interval(e, p, d), repeats)
        rows += [Row(name, named, yardstick, matched), Row("  throughput, first stops", found, yardstick, matched)]
    return rows
