"""The simulated label system: scans a folder of instruction files and has labels flash, late, and not always.

A flash of D seconds is D periods of the burst pattern, the first burst at its start, on the label's own clock. When a
file is fetched every command in it is given the moment at which it will arrive; from then on the light of every label
is a closed function of time. Commands always arrive after the fetch that found them, so what was said about the past
never changes, whichever snapshot a rendering thread reads.
"""

from __future__ import annotations

import asyncio
import bisect
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..bind import ranged
from ..clock import now, ticks
from ..records import Floats

PERIOD_S = 1.0
BURST = ((0.0, 0.1), (0.2, 0.3), (0.4, 0.5))  # s, on and off within a period: three flashes at 5 Hz
KNOTS = np.array([*(edge for flash in BURST for edge in flash), PERIOD_S])
LIGHT = np.array([0.0, 0.1, 0.1, 0.2, 0.2, 0.3, 0.3])  # s of light from the start of a period to each knot
NORMAL_95 = 1.6448536269514722  # standard normal quantile
KEPT_S = 2.0  # how long a flash that has ended can still be asked about
GIVE_UP_SCANS = 3  # scans after which a file without a final line break is taken for damaged
LINE = re.compile(r"FLASH;([^;]+);(\d{1,3});([\d.e-]{1,24})")


@dataclass(frozen=True, slots=True)
class LabelSystemSettings:
    """[labels] of the simulated world's settings."""

    poll_s: float = ranged(3.0, minimum=0.01, maximum=60.0, doc="time between two scans of the folder")
    commands_per_s: float = ranged(10.0, minimum=0.01, maximum=1e6, doc="commands sent out a second")
    delay_median_s: float = ranged(1.0, minimum=1e-3, maximum=60.0, doc="from sending to the first flash, median")
    delay_p95_s: float = ranged(3.0, minimum=1e-3, maximum=600.0, doc="the same, 95th percentile")
    lost_fraction: float = ranged(0.02, minimum=0.0, maximum=1.0, doc="commands that never arrive")
    weak_fraction: float = ranged(0.0, minimum=0.0, maximum=1.0, doc="labels whose batteries are nearly empty")
    weak_light: float = ranged(0.4, minimum=0.01, maximum=1.0, doc="how brightly these flash, relative to the others")
    weak_lost_fraction: float = ranged(0.2, minimum=0.0, maximum=1.0, doc="commands that these do not hear")
    feedback: bool = True  # files that were fetched vanish; false: nothing tells that they were
    clock_error: float = ranged(0.001, minimum=0.0, maximum=0.1, doc="relative rate error of a label's clock, sigma")

    def __post_init__(self) -> None:
        if self.delay_p95_s < self.delay_median_s:
            raise ValueError(f"delay_p95_s = {self.delay_p95_s:g}; expected at least delay_median_s")


@dataclass(frozen=True, slots=True)
class _Flash:
    """One command as a label received it; it ends after its periods or when the next one arrives."""

    start: float
    end: float
    strength: float


class LabelSystem:
    """Every label of a store, and the system that commands them.

    Parameters
    ----------
    label_ids : sequence of str
        Order of the labels in what `lit` takes and returns.
    settings : LabelSystemSettings
    folder : Path
        Where instruction files (FLASH;label;seconds;strength, a command a line, *.txt) appear.
    rng : numpy.random.Generator
        Owned by the label system from now on.
    """

    def __init__(
        self,
        label_ids: tuple[str, ...] | list[str],
        settings: LabelSystemSettings,
        folder: Path,
        rng: np.random.Generator,
    ) -> None:
        self.settings = settings
        self.folder = folder
        self.commands = self.lost = self.ignored = 0
        self._index = {label: index for index, label in enumerate(label_ids)}
        self._rng = rng
        self._rate = 1.0 + settings.clock_error * rng.standard_normal(len(label_ids))
        self._first_scan = settings.poll_s * rng.random()
        self.weak = np.zeros(len(label_ids), bool)
        if settings.weak_fraction:
            weak = rng.permutation(len(label_ids))[: round(settings.weak_fraction * len(label_ids))]
            self.weak[weak] = True
        self._spread = math.log(settings.delay_p95_s / settings.delay_median_s) / NORMAL_95
        self._free = -math.inf  # when the next command can be sent
        self._flashes: list[list[_Flash]] = [[] for _ in label_ids]
        self._unfinished: dict[str, int] = {}
        self._fetched: set[str] = set()  # names of files that stay in the folder
        self._snapshot = self._freeze()

    async def run(self) -> None:
        """Scan the folder for ever."""
        await asyncio.sleep(self._first_scan)
        async for _ in ticks(self.settings.poll_s):
            self.scan(now())

    def scan(self, t: float) -> None:
        """Fetch the instruction files that are there at time `t`, in the order of their names, and delete them."""
        found = False
        there = sorted(self.folder.glob("*.txt"))
        self._fetched &= {path.name for path in there}
        for path in there:
            if path.name not in self._fetched and (text := self._fetch(path)) is not None:
                found = True
                for line in text.splitlines():
                    self._command(t, line)
        kept = [[flash for flash in flashes if flash.end > t - KEPT_S] for flashes in self._flashes]
        if found or kept != self._flashes:
            self._flashes = kept
            self._snapshot = self._freeze()

    def lit(self, t0: Floats, t1: Floats) -> Floats:
        """How much each label shone, on average, between two times.

        Parameters
        ----------
        t0, t1 : (..., L) array
            Begin and end of each label's intervals in seconds of loop time, t0 < t1; at most 2 s before the last scan,
            and not after the present.

        Returns
        -------
        (..., L) array
            Fraction of the interval in which the label was on, times the strength of its flash; exact.
        """
        first, last, start, end, rate, strength = self._snapshot
        if not len(start) or t1.max() <= first or t0.min() >= last:
            return np.zeros(np.shape(t0))
        edges = np.minimum(np.maximum(np.stack((t0, t1))[..., None, :], start), end)  # (2, ..., flashes, L)
        periods, rest = np.divmod((edges - start) * rate, PERIOD_S)
        light = periods * LIGHT[-1] + np.interp(rest, KNOTS, LIGHT)
        result: Floats = ((light[1] - light[0]) * strength).sum(axis=-2) / (rate * (t1 - t0))
        return result

    def _fetch(self, path: Path) -> str | None:
        """The text of a finished file, which is deleted; None for one that somebody is still writing."""
        try:
            data = path.read_bytes()
            if not data.endswith(b"\n"):
                scans = self._unfinished[path.name] = self._unfinished.get(path.name, 0) + 1
                if scans < GIVE_UP_SCANS:
                    return None
            self._unfinished.pop(path.name, None)
            if self.settings.feedback:
                path.unlink()
            else:
                self._fetched.add(path.name)
        except OSError:  # a folder of that name, or somebody else was faster
            return None
        return data.decode("utf-8", "replace")

    def _command(self, t: float, line: str) -> None:
        match = LINE.fullmatch(line.strip())
        try:
            label, duration, strength = match[1], int(match[2]), float(match[3])  # type: ignore[index]
        except (TypeError, ValueError):
            duration, strength = 0, 0.0
        if not 1 <= duration <= 255 or not 0.0 < strength <= 1.0:
            self.ignored += 1
            return
        self.commands += 1
        sent = max(t, self._free)
        self._free = sent + 1.0 / self.settings.commands_per_s
        is_lost = self._rng.random() < self.settings.lost_fraction
        delay = self.settings.delay_median_s * math.exp(self._spread * self._rng.standard_normal())
        index = self._index.get(label)
        if index is not None and self.weak[index]:
            is_lost |= self._rng.random() < self.settings.weak_lost_fraction
            strength *= self.settings.weak_light
        if is_lost or index is None:  # a label of another store takes its turn all the same
            self.lost += 1
            return
        start = sent + delay
        flash = _Flash(start, start + duration * PERIOD_S / float(self._rate[index]), strength)
        self._flashes[index] = _insert(self._flashes[index], flash)

    def _freeze(self) -> tuple[float, float, Floats, Floats, Floats, Floats]:
        """Everything that `lit` needs, in arrays (flashes of a label, L) that are never written to again."""
        count = max(map(len, self._flashes), default=0)
        start, end, strength = np.zeros((3, count, len(self._flashes)))
        for index, flashes in enumerate(self._flashes):
            for row, flash in enumerate(flashes):
                start[row, index], end[row, index], strength[row, index] = flash.start, flash.end, flash.strength
        every = [flash for flashes in self._flashes for flash in flashes]
        first = min((flash.start for flash in every), default=math.inf)
        last = max((flash.end for flash in every), default=-math.inf)
        return first, last, start, end, self._rate, strength


def _insert(flashes: list[_Flash], new: _Flash) -> list[_Flash]:
    """Add a flash in the order of arrival: a label obeys the command that came last."""
    place = bisect.bisect([flash.start for flash in flashes], new.start)
    before = [_Flash(old.start, min(old.end, new.start), old.strength) for old in flashes[:place]]
    after = flashes[place:]
    if after:
        new = _Flash(new.start, min(new.end, after[0].start), new.strength)
    return [*before, new, *after]
