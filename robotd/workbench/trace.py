"""The course of one place in time: brightness, and the score that a detector gives it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..records import Flash
from ..vision.explain_flash import FlashExplanation
from ..vision.pattern import FlashPattern

NEAR_PX = 4.0
INNER, RING_FROM, RING_TO = 2.3, 4.5, 8.0  # px: aperture, and the ring around it


@dataclass
class Trace:
    """What happens at u, v: lists over frames, and over the frames at which the detector was asked.

    `light` is the mean grey level within 2.3 px less the median of the ring from 4.5 to 8 px; `pattern` the intervals
    in which the light that was found there is on.
    """

    u: float
    v: float
    times: list[float] = field(default_factory=list)
    light: list[float] = field(default_factory=list)
    score_times: list[float] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    thresholds: list[float] = field(default_factory=list)
    pattern: list[tuple[float, float]] = field(default_factory=list)

    def add_frame(self, image: NDArray[np.uint8], t: float) -> None:
        """Measure a frame."""
        height, width = image.shape
        reach = int(RING_TO) + 1
        left, right = max(0, int(self.u) - reach), min(width, int(self.u) + reach + 2)
        top, bottom = max(0, int(self.v) - reach), min(height, int(self.v) + reach + 2)
        v, u = np.mgrid[top:bottom, left:right]
        apart = np.hypot(u - self.u, v - self.v)
        patch = image[top:bottom, left:right]
        around = patch[(apart >= RING_FROM) & (apart <= RING_TO)]
        self.times.append(t)
        self.light.append(float(patch[apart <= INNER].mean() - np.median(around)))

    def add_score(self, explained: FlashExplanation, t: float) -> None:
        """Take over what the detector makes of the place."""
        near = [
            cluster for cluster in explained.clusters if math.hypot(cluster.u - self.u, cluster.v - self.v) <= NEAR_PX
        ]
        best = max(near, key=lambda cluster: cluster.score, default=None)
        self.score_times.append(t)
        self.scores.append(best.score if best is not None else math.nan)
        self.thresholds.append(explained.threshold)

    def add_pattern(self, flashes: list[Flash], pattern: FlashPattern) -> None:
        """Shade when the light found here is on, if one was found."""
        near = [flash for flash in flashes if math.hypot(flash.u - self.u, flash.v - self.v) <= NEAR_PX]
        if not near or not self.times:
            return
        period, phase = pattern.period, near[0].phase
        first = math.floor((self.times[0] - phase) / period)
        last = math.ceil((self.times[-1] - phase) / period)
        self.pattern = [
            (phase + k * period + start, phase + k * period + end)
            for k in range(first, last + 1)
            for start, end in pattern.on
        ]

    def since(self, t: float) -> Trace:
        """The part from `t` on."""
        first = next((k for k, then in enumerate(self.times) if then >= t), len(self.times))
        second = next((k for k, then in enumerate(self.score_times) if then >= t), len(self.score_times))
        return Trace(
            self.u,
            self.v,
            self.times[first:],
            self.light[first:],
            self.score_times[second:],
            self.scores[second:],
            self.thresholds[second:],
            [item for item in self.pattern if item[1] >= t],
        )
