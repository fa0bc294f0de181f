"""The pattern in which a label flashes, as exposures of a camera see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bind import ranged

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_TABLE_S = 0.00025  # s, resolution of tabulated patterns


@dataclass(frozen=True, slots=True)
class FlashPattern:
    """A repeating pattern: `period` seconds, and the intervals `on` (start, end) within it at which the light is on."""

    period: float = ranged(1.0, minimum=0.1, maximum=10.0)
    on: tuple[tuple[float, float], ...] = ((0.0, 0.1), (0.2, 0.3), (0.4, 0.5))

    def __post_init__(self) -> None:
        on = tuple((float(start), float(end)) for start, end in self.on)
        object.__setattr__(self, "on", on)
        edges = [edge for interval in on for edge in interval]
        if not on or edges != sorted(edges) or edges[0] < 0.0 or edges[-1] > self.period or min(np.diff(edges)) <= 0.0:
            raise ValueError(
                f"on = {list(on)}: expected one or more (start, end) that increase within the period of {self.period} s"
            )

    @property
    def lag(self) -> float:
        """Half the interval between two flashes: the time over which the light alternates."""
        if len(self.on) > 1:
            return min(b[0] - a[0] for a, b in zip(self.on, self.on[1:], strict=False)) / 2.0
        return min(self.on[0][1] - self.on[0][0], self.period / 2.0)

    def coverage(self, since_start: Floats, exposure: float, periods: int = 1) -> Floats:
        """Fraction of each exposure in which the light is on.

        Parameters
        ----------
        since_start : array
            Start of each exposure, in seconds after the start of the pattern.
        exposure : float
            Length of the exposures in seconds.
        periods : int
            The light stops after so many periods.
        """
        knots = [0.0]
        light = [0.0]
        for k in range(periods):
            for start, end in self.on:
                knots += [k * self.period + start, k * self.period + end]
                light += [light[-1], light[-1] + end - start]
        exposure = max(exposure, 1e-4)
        return np.asarray(
            (np.interp(since_start + exposure, knots, light) - np.interp(since_start, knots, light)) / exposure
        )


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """When a light's pattern may have started, as one stretch of frames around the time `t` says.

    `log_likelihood` (K,) is that of the starts `first`, `first + pitch` and so on (s); its largest is 0.
    """

    t: float
    first: float
    pitch: float
    log_likelihood: Floats

    @property
    def start(self) -> float:
        """Mean of the starts, s."""
        return self._mean_and_sigma()[0]

    @property
    def sigma(self) -> float:
        """Their standard deviation, s."""
        return self._mean_and_sigma()[1]

    def _mean_and_sigma(self) -> tuple[float, float]:
        weights = np.exp(self.log_likelihood)
        weights /= weights.sum()
        starts = self.first + self.pitch * np.arange(len(weights))
        mean = float(weights @ starts)
        return mean, float(np.sqrt(weights @ (starts - mean) ** 2 + self.pitch**2 / 12.0))


class Template:
    """`FlashPattern.coverage` of one period, tabulated because it is looked up for every start and frame."""

    def __init__(self, pattern: FlashPattern, exposure: float) -> None:
        self._period = pattern.period
        self._first = -exposure - _TABLE_S
        self._table = pattern.coverage(
            np.arange(self._first, pattern.period + 2.0 * _TABLE_S, _TABLE_S), exposure
        ).astype(np.float32)

    def __call__(self, since_start: Floats) -> Singles:
        """Fraction of light in exposures that begin so many seconds after the start of a period."""
        index = ((since_start - self._first) * (1.0 / _TABLE_S) + 0.5).astype(np.int32)
        return self._table.take(index, mode="clip")

    def run(self, since_start: Floats, periods: Floats | float) -> Singles:
        """The same, for a pattern that is repeated so many times (broadcast)."""
        number = np.floor(since_start / self._period)
        within = since_start - number * self._period
        begun = (number >= 0.0) & (number < periods)
        next_one = (number >= -1.0) & (number < periods - 1.0)  # an exposure may see the end of one and the next one
        return self(within) * begun + self(within - self._period) * next_one
