"""Recall, precision and centroid error of what a detector found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robotd.records import Flash

from .scenes import Light

NEAR_PX = 2.5  # a flash so near a label is its detection


@dataclass
class Score:
    """Counts over films, and the errors of what was found in px, per axis."""

    labels: int = 0
    found: int = 0
    false: int = 0
    mirrored: int = 0  # of the false ones: reflections of labels
    errors: list[float] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)

    def add(self, flashes: Sequence[Flash], labels: Sequence[Light], mirrored: Sequence[Light], name: str = "") -> None:
        """Count one film; each label accepts one flash, the nearest."""
        free = set(range(len(flashes)))
        for number, label in enumerate(labels):
            near = [(np.hypot(flashes[k].u - label.u, flashes[k].v - label.v), k) for k in free]
            distance, k = min(near, default=(np.inf, -1))
            if distance < NEAR_PX:
                free.discard(k)
                self.found += 1
                self.errors += [flashes[k].u - label.u, flashes[k].v - label.v]
            else:
                self.missed.append(f"{name}:{number}")
        self.labels += len(labels)
        self.false += len(free)
        for k in free:
            mirror = any(np.hypot(flashes[k].u - m.u, flashes[k].v - m.v) < NEAR_PX for m in mirrored)
            self.mirrored += mirror
            kind = "reflection" if mirror else "false"
            self.missed.append(f"{name} {kind} {flashes[k].u:.0f},{flashes[k].v:.0f} score {flashes[k].score:.0f}")

    @property
    def recall(self) -> float:
        """Share of the labels that were found."""
        return self.found / max(self.labels, 1)

    @property
    def precision(self) -> float:
        """Share of what was found that are labels."""
        return self.found / max(self.found + self.false, 1)

    @property
    def rms_px(self) -> float:
        """Root mean square error per axis."""
        return float(np.sqrt(np.mean(np.square(self.errors)))) if self.errors else float("nan")
