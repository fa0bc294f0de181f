"""How far a map is from the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..records import Floats, Map, Vector3


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A map against the truth.

    Attributes
    ----------
    labels_total : int
        Labels in the truth.
    labels_placed : int
        Of these, how many the map places (status placed or known).
    labels_false : int
        Labels that the map places but the truth does not have.
    error_mm : dict
        `mean`, `median`, `p95` and `max` of the distances between mapped and true positions; None each if no label was
        placed.
    errors_mm : dict
        The distance of each placed label, in the map's order.
    """

    labels_total: int
    labels_placed: int
    labels_false: int
    error_mm: dict[str, float | None]
    errors_mm: dict[str, float]


def evaluate(
    survey_map: Map, truth: Mapping[str, Vector3], align: Literal["none", "se2", "se3"] = "none"
) -> Evaluation:
    """Compare a map with true label positions.

    Parameters
    ----------
    survey_map : Map
    truth : mapping of label to (x, y, z) in metres
    align : {"none", "se2", "se3"}
        Motion applied to the map first, the one that minimises the squared errors: none; x, y and heading; or a full
        rigid motion. Scale is never adjusted.

    Raises
    ------
    ValueError
        If `align` is not one of the three.
    """
    if align not in ("none", "se2", "se3"):
        raise ValueError(f"align must be none, se2 or se3, got {align!r}")
    placed = {
        m.label: m.position for m in survey_map.labels if m.status in ("placed", "known") and m.position is not None
    }
    both = [label for label in placed if label in truth]
    false = len(placed) - len(both)
    if not both:
        return Evaluation(len(truth), 0, false, dict.fromkeys(("mean", "median", "p95", "max")), {})
    mapped = np.array([placed[label] for label in both])
    true = np.array([truth[label] for label in both])
    if align != "none":
        mapped = _aligned(mapped, true, dimensions=2 if align == "se2" else 3)
    errors = 1000.0 * np.linalg.norm(mapped - true, axis=1)
    summary: dict[str, float | None] = {
        "mean": float(errors.mean()),
        "median": float(np.median(errors)),
        "p95": float(np.percentile(errors, 95)),
        "max": float(errors.max()),
    }
    return Evaluation(len(truth), len(both), false, summary, dict(zip(both, errors.tolist(), strict=True)))


def _aligned(points: Floats, target: Floats, dimensions: int) -> Floats:
    """Points moved onto targets by the best rigid motion of their first coordinates (Kabsch 1976)."""
    p, q = points[:, :dimensions], target[:, :dimensions]
    a, b = p.mean(axis=0), q.mean(axis=0)
    u, _, vt = np.linalg.svd((p - a).T @ (q - b))
    sign = np.ones(dimensions)
    sign[-1] = np.sign(np.linalg.det(u @ vt)) or 1.0
    R = vt.T @ (sign[:, None] * u.T)
    moved = points.copy()
    moved[:, :dimensions] = (p - a) @ R.T + b
    return moved
