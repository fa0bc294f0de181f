"""When a label flashes that was asked to: the label system's poll, its queue, and a delay that nobody announces.

A command waits until the system looks into its folder, then for the commands before it in the queue, then a random
time on its way. So the moment at which a light flashes says something about which command it obeys: with 10 commands a
second and delays of about a second, which thirty of them. Poll phase and delays are learnt from the lights that are
known already: phase on a grid, delays as the mean and deviation of a lognormal distribution under a prior. So is the
throughput: the time between two commands is the slope of the flashes' moments over their places in the queue.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .settings import IdentifyConfig

NORMAL_95 = 1.6448536269514722  # standard normal quantile
PHASE_STEP_S = 0.15  # grid of poll phases
PHASE_DRIFT = 0.002  # the poll is regular up to this fraction of the time since it was measured
STRAY = 0.03  # fraction of commands that are overtaken, or delayed in another way than the rest
STAMP_S = 0.15  # frame stamps and the time of a request may disagree by so much
PRIOR_DELAYS = 20.0  # how many measured delays the configured ones are worth
TABLE_STEP_S = 0.02
INTERVAL_SPREAD = 0.6  # of the configured throughput's logarithm: it may be a fifth or five times as much
KNOWN_SPREAD, RATE_DRIFT = 0.05, 0.01  # spread from which on it counts as known; what remains
Numbers = NDArray[np.intp]


def turns(gates: Floats, interval: float) -> Floats:
    """Seconds at which commands (K,) are sent one after the other, none before its gate, `interval` seconds apart."""
    queue = np.arange(len(gates)) * interval
    return np.asarray(np.maximum.accumulate(gates - queue) + queue)


class DelayModel:
    """What is known about the label system's timing; lives as long as the mission.

    Attributes
    ----------
    median, sigma : float
        Of the delay: its median in seconds, and the standard deviation of its logarithm.
    interval : float
        Seconds between two commands, of which `rate_is_known` says whether flashes have shown it.
    """

    def __init__(self, config: IdentifyConfig) -> None:
        self.config = config
        self.interval = 1.0 / config.commands_per_s
        self._usual = self.interval  # as learnt; a stop's answers may suggest another one meanwhile
        self._doubt = INTERVAL_SPREAD  # standard deviation of its logarithm
        spread = np.log(config.delay_normal_s / config.delay_median_s) / NORMAL_95
        self._prior = np.array([1.0, np.log(config.delay_median_s), np.log(config.delay_median_s) ** 2 + spread**2])
        self._moments: Floats = PRIOR_DELAYS * self._prior  # number, sum, sum of squares of the logarithms
        count = max(1, round(config.poll_s / PHASE_STEP_S))
        self._offsets = (np.arange(count) + 0.5) * config.poll_s / count
        self._phases: Floats = np.full(count, 1.0 / count)  # probability that the poll is at t = offset modulo poll_s
        self._measured: float | None = None

    @property
    def median(self) -> float:
        return float(np.exp(self._moments[1] / self._moments[0]))

    @property
    def sigma(self) -> float:
        number, total, squares = self._moments
        return float(np.sqrt(max(squares / number - (total / number) ** 2, 0.05**2)))

    def state(self) -> dict[str, Any]:
        """What was learnt, for JSON; see `restore`."""
        return {
            "moments": self._moments.tolist(),
            "phases": np.round(self._phases, 6).tolist(),
            "measured": self._measured,
            "interval": self._usual,
            "doubt": self._doubt,
        }

    def restore(self, state: Mapping[str, Any], *, same_clock: bool) -> None:
        """Take over what an earlier model had learnt; the poll's phase only if the clock has not begun anew."""
        self._moments = np.array(state["moments"])
        if "interval" in state:  # not in what an earlier release left
            self._usual = self.interval = state["interval"]
            self._doubt = state["doubt"]
        phases = np.array(state["phases"])
        if same_clock and phases.shape == self._phases.shape:
            self._phases, self._measured = phases, state["measured"]

    @property
    def rate_is_known(self) -> bool:
        return self._doubt < KNOWN_SPREAD

    def intervals(self, number: int) -> Iterator[tuple[float, float]]:
        """Intervals (s) that may be, with their log-probabilities, so dense that `number` commands tell them apart."""
        step = min(self.median * self.sigma / max(number * self._usual, 1e-9), 0.25 * self._doubt)
        most = math.ceil(2.7 * self._doubt / step)
        for k in range(-most, most + 1):
            yield self._usual * math.exp(k * step), -0.5 * (k * step / self._doubt) ** 2

    def quantile(self, deviations: float) -> float:
        """Delay that is so many standard deviations (of its logarithm) above the median, at most `delay_tail_s`."""
        return float(min(self.median * np.exp(deviations * self.sigma), self.config.delay_tail_s))

    def fetch(self, begun: float) -> Floats:
        """Probability of every poll offset (P,) for requests sent at time `begun`; offsets as in `offsets`."""
        phases = self._phases
        if self._measured is not None and len(phases) > 1:
            spread = PHASE_DRIFT * abs(begun - self._measured) / (self.config.poll_s / len(phases))
            phases = _diffuse(phases, spread)
        return np.roll(phases, -self._shift(begun))

    def _shift(self, begun: float) -> int:
        """Cells of the phase grid from the phase of time zero to that of `begun`."""
        count = len(self._phases)
        return round(begun / self.config.poll_s * count) % count if self.config.poll_s else 0

    @property
    def offsets(self) -> Floats:
        """Seconds from the sending of a request to the poll that finds it, (P,)."""
        return self._offsets

    def kernel(self, fetch: Floats, window: float) -> Kernel:
        """Density of a flash's lateness, relative to one that is uniform over `window` seconds.

        Parameters
        ----------
        fetch : (P,) array
            Probability of the offsets, e.g. of `fetch`.
        window : float
            Seconds in which flashes were looked for.
        """
        if not self.config.in_order:
            return Kernel(np.ones(1))
        grid = np.arange(-STAMP_S, self.config.poll_s + 2.0 * self.config.delay_tail_s, TABLE_STEP_S)
        density = self.density(grid[:, None] - self._offsets) @ fetch
        return Kernel((1.0 - STRAY) * window * density + STRAY)

    def density(self, delay: Floats) -> Floats:
        """Probability density (1/s) of delays in seconds, any shape; blurred by what stamps and clocks leave."""
        positive = np.maximum(delay + 0.5 * PHASE_STEP_S, 1e-3)
        sigma = np.hypot(self.sigma, 0.05)
        z = (np.log(positive) - np.log(self.median + 0.5 * PHASE_STEP_S)) / sigma
        return np.asarray(np.exp(-0.5 * z**2) / (np.sqrt(2.0 * np.pi) * sigma * positive))

    def locate(self, begun: float, lateness: Floats, weights: Floats) -> Floats:
        """Probability of the poll offsets (P,) given the lateness (K,) of lights that are known, weighted 0..1."""
        likelihood = np.log((1.0 - STRAY) * self.density(lateness[:, None] - self._offsets) + STRAY / 20.0)
        odds = np.log(np.maximum(self.fetch(begun), 1e-12)) + weights @ likelihood
        odds = np.exp(odds - odds.max())
        return np.asarray(odds / odds.sum())

    def learn(self, begun: float, lateness: Floats, turn: NDArray[np.intp]) -> None:
        """Take in the lateness (K,) of lights, named in a slot that began at time `begun`, and their `turn` (K,)."""
        if not len(lateness):
            return
        fetch = self.locate(begun, lateness, np.ones(len(lateness)))
        delays = lateness - float(fetch @ self._offsets)
        usual = (delays > 0.05 * self.median) & (delays < 2.0 * self.config.delay_tail_s)
        self._learn_interval(lateness[usual], turn[usual])
        logs = np.log(delays[usual])
        self._moments = np.minimum(1.0, 500.0 / self._moments[0]) * self._moments + [
            len(logs),
            logs.sum(),
            (logs**2).sum(),
        ]
        self._phases = np.roll(fetch, self._shift(begun))
        self._measured = begun

    def _learn_interval(self, lateness: Floats, turn: NDArray[np.intp]) -> None:
        """Weigh the slope of lateness over the place in the queue against what is known of the interval."""
        lever = turn - turn.mean() if len(turn) else turn
        leverage = float((lever * lever).sum()) * self.interval**2
        if not leverage:
            return
        noise = self.median * np.exp(0.5 * self.sigma**2) * max(self.sigma, 0.2)  # of delays, about
        measured = noise**2 / leverage  # variance of the relative slope
        gain = self._doubt**2 / (self._doubt**2 + measured)
        slope = float(lever @ lateness) * self.interval / leverage
        self._usual = self.interval = self.interval * math.exp(gain * float(np.clip(slope, -0.5, 0.5)))
        self._doubt = max(math.sqrt(gain * measured), RATE_DRIFT)


class Kernel:
    """Tabulated density of lateness, relative to a uniform one."""

    def __init__(self, table: Floats) -> None:
        self.table = table.astype(np.float32)
        self.largest = float(self.table.max())

    def __call__(self, lateness: NDArray[Any]) -> NDArray[np.float32]:
        """Ratio for lateness in seconds, any shape."""
        index = ((lateness + (STAMP_S + 0.5 * TABLE_STEP_S)) * (1.0 / TABLE_STEP_S)).astype(np.int32)
        return self.table.take(index, mode="clip")


def _diffuse(phases: Floats, spread: float) -> Floats:
    """Blur a circular distribution by a normal one of `spread` cells."""
    count = len(phases)
    distance = np.minimum(np.arange(count), count - np.arange(count))
    blur = np.exp(-0.5 * (distance / max(spread, 0.3)) ** 2)
    blurred = np.fft.irfft(np.fft.rfft(phases) * np.fft.rfft(blur / blur.sum()), count)
    return np.asarray(np.maximum(blurred, 1e-9) / np.maximum(blurred, 1e-9).sum())
