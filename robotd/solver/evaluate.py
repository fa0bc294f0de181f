"""How far a map is from the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..records import Floats, Map, Vector3

CHI_SQUARE_95 = 7.8147  # 95 % quantile with 3 degrees of freedom


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
    labels_within : int or None
        Of the labels that were placed (not known ones), how many lie within the map's own 95 % ellipsoid around their
        position; None for a map that was moved or states no covariances.
    known_points : int
        Labels of the map that were measured by hand.
    localisation : str
        What located the robot: "roof cameras" or "dead reckoning".
    method : str
        How labels were estimated: "bundle adjustment" or "linear (SVD)".
    """

    labels_total: int
    labels_placed: int
    labels_false: int
    error_mm: dict[str, float | None]
    errors_mm: dict[str, float]
    labels_within: int | None = None
    known_points: int = 0
    localisation: str = "dead reckoning"
    method: str = "bundle adjustment"


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
    about = (
        sum(m.status == "known" for m in survey_map.labels),
        "roof cameras" if survey_map.frame == "roof cameras" else "dead reckoning",
        "linear (SVD)" if survey_map.solver.method == "linear" else "bundle adjustment",
    )
    if not both:
        return Evaluation(len(truth), 0, false, dict.fromkeys(("mean", "median", "p95", "max")), {}, None, *about)
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
    within = _within(survey_map, truth) if align == "none" else None
    each = dict(zip(both, errors.tolist(), strict=True))
    return Evaluation(len(truth), len(both), false, summary, each, within, *about)


def _within(survey_map: Map, truth: Mapping[str, Vector3]) -> int | None:
    """How many placed labels lie within their 95 % ellipsoids; None if there is none to judge."""
    inside = [
        float(error @ np.linalg.lstsq(np.array(m.covariance), error)[0]) < CHI_SQUARE_95
        for m in survey_map.labels
        if m.status == "placed" and m.position is not None and m.covariance is not None and m.label in truth
        for error in [np.subtract(m.position, truth[m.label])]
    ]
    return sum(inside) if inside else None


def text_table(evaluations: Sequence[Evaluation]) -> str:
    """A table for the terminal in the columns of thesis table 3, with labels placed and more of the errors."""
    titles = ["known points", "localisation", "estimation", "labels placed", "mean mm", "median", "95 %", "max"]
    rows = [
        [
            str(one.known_points),
            one.localisation,
            one.method,
            f"{one.labels_placed} / {one.labels_total}",
            *(_mm(one.error_mm.get(key)) for key in ("mean", "median", "p95", "max")),
        ]
        for one in evaluations
    ]
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if k in (1, 2) else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in (titles, *rows)
    )


def _mm(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.1f}"


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
