"""How a label flashes as one picture: its light over the period, the learnt pattern, and what is left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..records import Floats
from ..vision.pattern_fit import LearntPattern
from .figure import ARROW, INK, MUTED, RING, new_figure, plain, save_figure

_PHASES = 400  # of the period that are tried


@dataclass(frozen=True, slots=True, eq=False)
class FlashCurve:
    """Light (F,) of a label at stamps `t` (F,) s, each the mean of `exposure` seconds from there."""

    label: str
    t: Floats
    light: Floats
    exposure: float


def fitted_phase(curve: FlashCurve, learnt: LearntPattern) -> tuple[float, Floats]:
    """When a period begins, and the light (F,) that the pattern has then, its two levels by least squares."""
    period = learnt.pattern.period
    best: tuple[float, float, Floats] | None = None
    for start in np.linspace(0.0, period, _PHASES, endpoint=False):
        share = lit_share(curve.t - start, curve.exposure, learnt)
        A = np.column_stack([share, np.ones(len(share))])
        level = np.linalg.lstsq(A, curve.light, rcond=None)[0]
        cost = float(np.sum((A @ level - curve.light) ** 2)) if level[0] > 0.0 else np.inf
        if best is None or cost < best[0]:
            best = cost, float(start), A @ level
    assert best is not None
    return best[1], best[2]


def lit_share(t: Floats, exposure: float, learnt: LearntPattern) -> Floats:
    """(F,) share of each exposure, from `t` on, in which the pattern is lit; it begins at 0."""
    period, parts = learnt.pattern.period, 9
    within = t[:, None] + exposure * (np.arange(parts) + 0.5) / parts
    phase = np.mod(within, period)
    lit = np.zeros(phase.shape, dtype=np.bool_)
    for begin, end in learnt.pattern.on:
        lit |= (phase >= begin) & (phase < end)
    return np.asarray(lit.mean(axis=1))


def draw_flash(path: Path, curve: FlashCurve, learnt: LearntPattern) -> None:
    """Write a PNG.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    figure = new_figure(path, 10.0, 6.0, 110.0)
    start, expected = fitted_phase(curve, learnt)
    period, t = learnt.pattern.period, curve.t - curve.t[0]
    phase = np.mod(curve.t - start, period)
    figure.suptitle(
        f"Label {plain(curve.label)}: period {period:.4f} +- {learnt.period_sigma:.4f} s, edges +-"
        f" {1e3 * learnt.edge_sigma:.1f} ms, {100.0 * learnt.confidence:.1f} % sure",
        size=13,
        color=INK,
    )
    folded = figure.add_subplot(2, 1, 1)
    for begin, end in learnt.pattern.on:
        folded.axvspan(begin, end, color=RING, alpha=0.15)
    folded.plot(phase, curve.light, ".", color=ARROW, markersize=4)
    folded.set(xlim=(0.0, period), xlabel="s in the period; green: lit, as learnt", ylabel="light")
    order = figure.add_subplot(2, 1, 2)
    order.plot(t, curve.light, ".", color=MUTED, markersize=3, label="seen")
    order.plot(t, expected, color=INK, linewidth=0.8, label="the pattern")
    order.plot(t, curve.light - expected, ".", color=ARROW, markersize=3, label="left")
    order.set(xlabel="s", ylabel="light")
    order.legend(loc="upper right", fontsize=8, ncols=3)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.96))
    save_figure(path, figure)
