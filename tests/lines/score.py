"""How far found lines agree with the truth.

Found and true centre-lines are sampled every half width of the true line. A found sample is right if a true line passes
within the tolerance, a true one is found if a found line does; precision and recall are lengths' shares, and F1 is
their harmonic mean. Samples outside the image or its valid part do not count, nor do gaps of the truth, filled or not.
On a bare floor the score is 1 for no line and 0 for any.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotd.records import Line
from robotd.vision.polyline import arc_length, resample

from .paths import Floats, TrueLine
from .scenes import Scene

TIGHT, LOOSE = 0.25, 0.75  # tolerances in line widths


@dataclass(frozen=True)
class Score:
    """One scene's. On bare floors the errors are nan, and only `false_lines` and both F1 say something.

    Attributes
    ----------
    tight, loose : float
        F1 at 0.25 and 0.75 line widths.
    precision, recall : float
        At 0.75 line widths.
    false_lines : int
        Found lines of which less than half is within 0.75 widths of a true one.
    pieces : float
        Found lines that are not false, per true line: above 1, lines came in pieces.
    bias, rms : float
        Mean and root mean square of the distance from the true centre, in pixels, of the samples within 0.75 widths;
        bias is positive if the found line lies to the right of the true one, seen along it with v downwards.
    width_error : float
        Of the found lines that are not false, median of found minus true width in pixels.
    """

    family: str
    name: str
    tight: float
    loose: float
    precision: float
    recall: float
    false_lines: int
    pieces: float = math.nan
    bias: float = math.nan
    rms: float = math.nan
    width_error: float = math.nan


def score(scene: Scene, found: Sequence[Line]) -> Score:
    """Compare the lines found in a scene with the truth."""
    if not scene.lines:
        right = float(not found)
        return Score(scene.family, scene.name, right, right, right, right, len(found))
    width = scene.lines[0].width
    step = 0.5 * width
    required = [line for line in scene.lines if not line.optional]
    wanted = _inside(np.vstack([_sampled(line.points, step) for line in required]), scene)
    near, errors, widths, false_lines = [], [], [], 0
    for line in found:
        samples = _inside(_sampled(line.points, step), scene)
        if not len(samples):
            continue
        distance, side = _to_lines(samples, scene.lines)
        needed, _ = _to_lines(samples, required)
        # because a gap's samples are neither right nor wrong
        counts = (needed <= LOOSE * width) | (distance > LOOSE * width)
        near.append(np.column_stack([distance, counts]))
        if np.mean(distance <= LOOSE * width) < 0.5:
            false_lines += 1
        else:
            errors.append((side * distance)[distance <= LOOSE * width])
            widths.append(line.width - width)
    tight, loose, precision, recall = 0.0, 0.0, 0.0, 0.0
    if near and len(wanted):
        table = np.vstack(near)
        table = table[table[:, 1] > 0.0]
        missed, _ = _to_lines(wanted, [TrueLine(line.points, line.width) for line in found])
        tight, _, _ = _f1(table[:, 0], missed, TIGHT * width)
        loose, precision, recall = _f1(table[:, 0], missed, LOOSE * width)
    signed = np.concatenate(errors) if errors else np.full(1, math.nan)
    return Score(
        scene.family, scene.name, tight, loose, precision, recall, false_lines,
        pieces=len(widths) / _count(scene),
        bias=float(signed.mean()),
        rms=float(np.sqrt(np.mean(signed**2))),
        width_error=float(np.median(widths)) if widths else math.nan,
    )  # fmt: skip


def _f1(found: Floats, wanted: Floats, tolerance: float) -> tuple[float, float, float]:
    precision = float(np.mean(found <= tolerance)) if len(found) else 0.0
    recall = float(np.mean(wanted <= tolerance))
    return 2.0 * precision * recall / max(precision + recall, 1e-12), precision, recall


def _count(scene: Scene) -> int:
    """True lines in view; gaps join the pieces before and after them into one."""
    seen = [line for line in scene.lines if len(_inside(_sampled(line.points, line.width), scene))]
    count = 0
    for k, line in enumerate(seen):
        joined = k > 0 and (seen[k - 1].optional or line.optional)
        count += not joined
    return max(count, 1)


def _sampled(points: Floats, step: float) -> Floats:
    """Samples in the middle of equal parts of a polyline, about `step` long: each stands for the same length."""
    if len(points) < 2:
        return np.asarray(points, dtype=np.float64)
    fine = resample(points, 0.5 * step) if arc_length(points)[-1] > 0.0 else points
    return fine[1::2] if len(fine) > 2 else fine.mean(axis=0, keepdims=True)


def _inside(points: Floats, scene: Scene) -> Floats:
    height, width = scene.image.shape
    at = np.floor(points + 0.5).astype(np.int64)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < width) & (at[:, 1] < height)
    if scene.valid is not None:
        inside[inside] = scene.valid[at[inside, 1], at[inside, 0]]
    return points[inside]


def _to_lines(points: Floats, lines: Sequence[TrueLine]) -> tuple[Floats, Floats]:
    """Distance (N,) of points from the nearest segment of any line, and the side (1 right, -1 left) they are on."""
    best = np.full(len(points), math.inf)
    side = np.ones(len(points))
    for line in lines:
        start, step = line.points[:-1], np.diff(line.points, axis=0)
        square = np.maximum((step**2).sum(axis=1), 1e-12)
        for first in range(0, len(start), 512):  # in parts, because of memory
            part = slice(first, first + 512)
            away = points[:, None] - start[part]
            share = np.clip((away * step[part]).sum(axis=2) / square[part], 0.0, 1.0)
            off = away - share[..., None] * step[part]
            distance = np.hypot(off[..., 0], off[..., 1])
            nearest = distance.argmin(axis=1)
            rows = np.arange(len(points))
            better = distance[rows, nearest] < best
            cross = step[part][nearest, 0] * off[rows, nearest, 1] - step[part][nearest, 1] * off[rows, nearest, 0]
            best = np.where(better, distance[rows, nearest], best)
            side = np.where(better, np.where(cross < 0.0, -1.0, 1.0), side)
    return best, side


@dataclass(frozen=True)
class Summary:
    """Means over scenes: F1 over those with lines, `none` the share of bare floors on which nothing was found."""

    scenes: int
    tight: float
    loose: float
    precision: float
    recall: float
    none: float
    false_lines: float  # per scene
    pieces: float
    bias: float
    rms: float
    width_error: float

    @property
    def overall(self) -> float:
        """Mean of F1 at 0.25 widths on lines and of "none" on bare floors; of one of them if there is only that."""
        return float(np.nanmean([self.tight, self.none])) if self.scenes else math.nan


def summarise(scores: Sequence[Score]) -> Summary:
    """Means over the scenes; a family of bare floors starts with `bare`."""
    lines = [item for item in scores if not _is_bare(item)]
    bare = [item for item in scores if _is_bare(item)]

    def mean(name: str, items: Sequence[Score]) -> float:
        values = np.array([getattr(item, name) for item in items], dtype=np.float64)
        values = values[~np.isnan(values)]
        return float(values.mean()) if len(values) else math.nan

    return Summary(
        len(scores), mean("tight", lines), mean("loose", lines), mean("precision", lines), mean("recall", lines),
        mean("tight", bare), mean("false_lines", scores), mean("pieces", lines), mean("bias", lines),
        float(np.sqrt(mean("rms", [_squared(item) for item in lines]))), mean("width_error", lines),
    )  # fmt: skip


def _squared(item: Score) -> Score:
    return Score(item.family, item.name, 0.0, 0.0, 0.0, 0.0, 0, rms=item.rms**2)


def _is_bare(item: Score) -> bool:
    return item.family.startswith("bare")
