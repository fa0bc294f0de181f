"""A plan for people: what every place would teach beside what viewing angles say, and a table of stops and labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..records import Floats
from .figure import FAINT, INK, MUTED, new_figure, plain, save_figure
from .planning import Study
from .report import ESTIMATE, TRUTH
from .viewing_angles import force_field, viewing_angles

_AROUND_M = 0.8  # of the stops and labels that is shown
_CELLS, _ARROWS = 120, 22  # along the longer side
_ELLIPSE = 2.447  # standard deviations of a 95 % ellipse in the plane
_ENLARGED = 10.0  # times the ellipses are drawn


def draw_plan(path: Path, study: Study) -> None:
    """Draw the plan and the thesis's heat map with its force field, 2000x1000 pixels.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    figure = new_figure(path, 12.5, 6.25, 160.0)
    figure.text(0.05, 0.94, f"Next stops of {plain(study.plan.survey[:40])}", size=14, weight="bold", color=INK)
    left, right = figure.add_axes((0.05, 0.08, 0.42, 0.78)), figure.add_axes((0.535, 0.08, 0.42, 0.78))
    stops = np.array([[stop.x, stop.y] for stop in study.map.stops]).reshape(-1, 2)
    there = np.isfinite(study.positions[:, 0])
    labels = study.positions[there]
    low, high = _extent(np.concatenate([stops, labels[:, :2], study.places[:, :2]]))
    for axes in (left, right):
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8, colors=MUTED)
        axes.plot(*stops.T, "-", color=MUTED, linewidth=1.0, zorder=2)
        axes.plot(*stops.T, "s", color=INK, markersize=4, zorder=3)
    _draw_information(left, study, labels, there)
    _draw_angles(right, stops[-1], labels[:, :2], low, high)
    save_figure(path, figure)


def plan_table(study: Study) -> str:
    """Stops with what to ask there, then labels with what is expected of them, for the terminal."""
    plan = study.plan
    lines = [f"{'stop':>4} {'along m':>8} {'x m':>7} {'y m':>7} {'ask':>5} {'skip':>5}   expected then, mm"]
    for number, stop in enumerate(plan.stops, start=1):
        along = "-" if stop.along is None else f"{stop.along:.2f}"
        flashes = ", ".join(f"{flash.label} {1e3 * flash.sigma_m:.0f}" for flash in stop.labels)
        lines.append(
            f"{number:>4} {along:>8} {stop.pose.x:>7.2f} {stop.pose.y:>7.2f} {len(stop.labels):>5} "
            f"{len(stop.skipped):>5}   {flashes}"
        )
    now = [label.sigma_m for label in plan.labels if label.sigma_m is not None]
    then = [label.expected_m for label in plan.labels]
    if now and then:
        lines.append(
            f"{len(now)} of {len(plan.labels)} labels placed, {1e3 * float(np.mean(now)):.1f} mm on average; "
            f"expected of all: {1e3 * float(np.mean(then)):.1f} mm, the worst {1e3 * max(then):.1f} mm"
        )
    return "\n".join([*lines, *plan.notes])


def _extent(points: Floats) -> tuple[Floats, Floats]:
    low, high = points.min(axis=0) - _AROUND_M, points.max(axis=0) + _AROUND_M
    middle, half = 0.5 * (low + high), 0.5 * float((high - low).max())
    return middle - half, middle + half


def _draw_information(axes: Any, study: Study, labels: Floats, there: Any) -> None:
    axes.set_title("what a stop would take off the labels' uncertainty", size=10, color=INK)
    dots = axes.scatter(*study.places[:, :2].T, c=100.0 * study.gains, s=26, cmap="viridis", zorder=2.5)
    bar = axes.figure.colorbar(dots, ax=axes, fraction=0.04, pad=0.02)
    bar.set_label("%", size=8)
    bar.ax.tick_params(labelsize=7)
    for blocks, colour in ((study.before, FAINT), (study.after, ESTIMATE)):
        for position, block in zip(labels, blocks[there], strict=True):
            axes.plot(*_ellipse(position, block), color=colour, linewidth=1.0, zorder=1.5)
    axes.plot(*labels[:, :2].T, ".", color=ESTIMATE, markersize=4, zorder=3)
    for number, stop in enumerate(study.plan.stops, start=1):
        axes.plot(stop.pose.x, stop.pose.y, "o", color="white", markeredgecolor=TRUTH, markersize=11, zorder=4)
        axes.text(stop.pose.x, stop.pose.y, str(number), size=7, ha="center", va="center", color=TRUTH, zorder=5)
    axes.set_xlabel(f"m; 95 % ellipses {_ENLARGED:.0f} times enlarged, grey now, orange after the plan", size=8)


def _ellipse(position: Floats, block: Floats) -> Floats:
    values, vectors = np.linalg.eigh(block[:2, :2])
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    axes = np.minimum(_ENLARGED * _ELLIPSE * np.sqrt(np.maximum(values, 0.0)), 2.0 * _AROUND_M)
    return np.asarray(position[:2, None] + vectors @ (axes[:, None] * np.stack([np.cos(angle), np.sin(angle)])))


def _draw_angles(axes: Any, here: Floats, labels: Floats, low: Floats, high: Floats) -> None:
    axes.set_title("viewing angles from the last stop (thesis 5.1)", size=10, color=INK)
    side = [np.linspace(a, b, _CELLS) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*side), axis=-1)
    angles = np.degrees(viewing_angles(grid.reshape(-1, 2), here, labels)).reshape(_CELLS, _CELLS)
    shown = axes.imshow(angles, origin="lower", extent=(low[0], high[0], low[1], high[1]), cmap="viridis")
    bar = axes.figure.colorbar(shown, ax=axes, fraction=0.04, pad=0.02)
    bar.set_label("degrees rms", size=8)
    bar.ax.tick_params(labelsize=7)
    coarse = np.stack(np.meshgrid(*(np.linspace(a, b, _ARROWS + 2)[1:-1] for a, b in zip(low, high, strict=True))), -1)
    places = coarse.reshape(-1, 2)
    axes.quiver(*places.T, *force_field(places, here, labels).T, color="white", alpha=0.7, width=0.0025)
    axes.plot(*labels.T, ".", color=ESTIMATE, markersize=4)
    axes.plot(*here, "o", color=TRUTH, markersize=6)
    axes.set_xlabel("m", size=8)
