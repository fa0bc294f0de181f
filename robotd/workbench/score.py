"""Recall, precision, centroid error and centroid spread of what a detector found."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ..records import Flash
from .tags import NEAR_PX


class Place(Protocol):
    """Anything with a place in the picture."""

    @property
    def u(self) -> float: ...

    @property
    def v(self) -> float: ...


@dataclass(frozen=True)
class Verdict:
    """What became of one clip: which finding belongs to which label, and the rest."""

    pairs: tuple[tuple[int, int], ...]  # index of the label, of the flash
    missed: tuple[int, ...]  # labels
    false: tuple[int, ...]  # flashes
    mirrored: tuple[int, ...]  # of the false ones, those on a reflection
    ignored: tuple[int, ...]  # flashes in places that count for neither


def judge(
    flashes: Sequence[Flash],
    labels: Sequence[Place],
    mirrored: Sequence[Place] = (),
    ignored: Sequence[Place] = (),
) -> Verdict:
    """Pair findings and labels, nearest first; each label takes one finding.

    Places may have a `radius` of their own in px; the others take what is nearer than NEAR_PX.
    """
    near = sorted(
        (distance, k, j)
        for k, label in enumerate(labels)
        for j, flash in enumerate(flashes)
        if (distance := _distance(label, flash)) < _radius(label)
    )
    of_label: dict[int, int] = {}
    taken: set[int] = set()
    for _, k, j in near:
        if k not in of_label and j not in taken:
            of_label[k] = j
            taken.add(j)
    rest = [j for j in range(len(flashes)) if j not in taken]
    skipped = tuple(j for j in rest if _is_on(flashes[j], ignored))
    false = tuple(j for j in rest if j not in skipped)
    return Verdict(
        tuple(sorted(of_label.items())),
        tuple(k for k in range(len(labels)) if k not in of_label),
        false,
        tuple(j for j in false if _is_on(flashes[j], mirrored)),
        skipped,
    )


def _is_on(flash: Flash, places: Sequence[Place]) -> bool:
    return any(_distance(place, flash) < _radius(place) for place in places)


def _distance(place: Place, flash: Flash) -> float:
    return math.hypot(place.u - flash.u, place.v - flash.v)


def _radius(place: Place) -> float:
    return float(getattr(place, "radius", NEAR_PX))


@dataclass
class Score:
    """Counts over clips, and the places in px of what was found."""

    labels: int = 0
    found: int = 0
    false: int = 0
    mirrored: int = 0  # of the false ones: reflections of labels
    ignored: int = 0
    clips: int = 0
    errors: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    places: dict[Hashable, list[tuple[float, float]]] = field(default_factory=dict)

    def add(
        self,
        flashes: Sequence[Flash],
        labels: Sequence[Place],
        mirrored: Sequence[Place] = (),
        name: str = "",
        *,
        ignored: Sequence[Place] = (),
        keys: Sequence[Hashable] | None = None,
    ) -> Verdict:
        """Count one clip; `keys` name its labels, so that the same one is known again in another clip."""
        verdict = judge(flashes, labels, mirrored, ignored)
        self.clips += 1
        self.labels += len(labels)
        self.found += len(verdict.pairs)
        self.false += len(verdict.false)
        self.mirrored += len(verdict.mirrored)
        self.ignored += len(verdict.ignored)
        for k, j in verdict.pairs:
            label, flash = labels[k], flashes[j]
            self.errors += [flash.u - label.u, flash.v - label.v]
            self.places.setdefault((name, k) if keys is None else keys[k], []).append((flash.u, flash.v))
        self.missed += [f"{name}:{k}" for k in verdict.missed]
        for j in verdict.false:
            kind = "reflection" if j in verdict.mirrored else "false"
            self.missed.append(f"{name} {kind} {flashes[j].u:.0f},{flashes[j].v:.0f} score {flashes[j].score:.1f}")
        return verdict

    @property
    def recall(self) -> float:
        """Share of the labels that were found."""
        return self.found / max(self.labels, 1)

    @property
    def precision(self) -> float:
        """Share of what was found that are labels."""
        return self.found / max(self.found + self.false, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision."""
        return 2.0 * self.found / max(self.labels + self.found + self.false, 1)

    @property
    def rms_px(self) -> float:
        """Root mean square error per axis; NaN if nothing was found."""
        return float(np.sqrt(np.mean(np.square(self.errors)))) if self.errors else float("nan")

    @property
    def spread_px(self) -> float:
        """Standard deviation per axis of a label's place about its mean over clips; NaN without two clips of one."""
        groups = [np.array(found) for found in self.places.values() if len(found) > 1]
        if not groups:
            return float("nan")
        squares = sum(float(((group - group.mean(axis=0)) ** 2).sum()) for group in groups)
        return math.sqrt(squares / (2 * sum(len(group) - 1 for group in groups)))

    def table(self) -> dict[str, Any]:
        """All of it in plain values, ready for JSON; ranges are 95 % confidence."""
        return {
            "clips": self.clips,
            "labels": self.labels,
            "found": self.found,
            "false": self.false,
            "reflections": self.mirrored,
            "ignored": self.ignored,
            "recall": _plain(self.recall if self.labels else math.nan),
            "recall_range": wilson(self.found, self.labels),
            "precision": _plain(self.precision if self.found + self.false else math.nan),
            "precision_range": wilson(self.found, self.found + self.false),
            "rms_px": _plain(self.rms_px),
            "spread_px": _plain(self.spread_px),
        }


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """The 95 % confidence interval of a share (E. B. Wilson 1927)."""
    if not trials:
        return 0.0, 1.0
    z = 1.959964
    share, more = successes / trials, z * z / trials
    middle = (share + more / 2.0) / (1.0 + more)
    half = z * math.sqrt(share * (1.0 - share) / trials + more / (4.0 * trials)) / (1.0 + more)
    return round(max(0.0, middle - half), 4), round(min(1.0, middle + half), 4)


def _plain(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
