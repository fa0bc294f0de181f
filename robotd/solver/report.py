"""What a person looks at: a picture of the map, a page to turn it around in, and a table of errors."""

from __future__ import annotations

import html
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotd.geometry.transforms import wrap_angle
from robotd.records import Floats, Map, MappedLabel, MappedStop, Survey, Vector3

from .figure import FAINT, INK, MUTED, new_figure, save_figure, save_picture

CHI2_95 = {2: 5.991, 3: 7.815}  # 95 % quantiles of chi squared, by degrees of freedom
GRID = 0.5  # m
MANY = 120  # labels or stops: beyond it names would only cover one another

WALL = "#c3c9d1"
LINE = "#b9b1a3"
ESTIMATE, TRUTH, ODOMETRY, ADJUSTED = "#f08a12", "#c2183a", "#4a7bd0", "#0a7d6c"

# ---- what both views show --------------------------------------------------------------------------------------------


def _errors_mm(result: Map, truth: Mapping[str, Vector3]) -> dict[str, Floats]:
    """(3,) estimate minus truth in millimetres, of every label that is placed and in the truth."""
    return {
        label.label: 1e3 * (np.array(label.position) - truth[label.label])
        for label in result.labels
        if label.position is not None and label.status in ("placed", "known") and label.label in truth
    }


def _counts(result: Map) -> str:
    placed = sum(label.position is not None and label.status in ("placed", "known") for label in result.labels)
    stops = f"{len(result.stops)} stop{'' if len(result.stops) == 1 else 's'}"
    return f"{placed} of {len(result.labels)} labels placed from {stops}"


def _legs(result: Map) -> dict[int, list[MappedStop]]:
    legs: dict[int, list[MappedStop]] = {}
    for stop in result.stops:
        legs.setdefault(stop.leg, []).append(stop)
    return legs


def _odometry_paths(result: Map, survey: Survey | None, trail: ArrayLike | None) -> list[Floats]:
    """(N, 2) path of each leg by odometry alone, laid on that leg's first stop in the map.

    Odometry starts each leg in its own frame, so only its shape can be compared. `trail`, in the odometry frame of
    the first leg, replaces that leg's straight lines from stop to stop.
    """
    if survey is None:
        return []
    first_leg = survey.stops[0].leg if survey.stops else 0
    paths = []
    for leg, mapped in _legs(result).items():
        stops = [stop for stop in survey.stops if stop.leg == leg]
        start = next((stop.odometry for stop in stops if stop.stop == mapped[0].stop), None)
        if start is None:
            continue
        path = np.array([[stop.odometry.x, stop.odometry.y] for stop in stops])
        if trail is not None and leg == first_leg and len(np.asarray(trail)) > 1:
            path = np.asarray(trail, dtype=np.float64)[:, :2]
        turn = wrap_angle(mapped[0].heading - start.heading)
        c, s = math.cos(turn), math.sin(turn)
        paths.append((path - [start.x, start.y]) @ np.array([[c, s], [-s, c]]) + [mapped[0].x, mapped[0].y])
    return paths


# ---- the picture -----------------------------------------------------------------------------------------------------


def map_png(
    path: str | Path,
    result: Map,
    *,
    survey: Survey | None = None,
    truth: Mapping[str, Vector3] | None = None,
    outline: Sequence[ArrayLike] = (),
    trail: ArrayLike | None = None,
    line: Sequence[ArrayLike] = (),
) -> None:
    """Draw the map from above, 1600x1200 pixels.

    Parameters
    ----------
    path : path
        Of the PNG file.
    result : Map
    survey : Survey, optional
        Adds the path as odometry had it.
    truth : mapping, optional
        True positions in world metres: adds them, the lines to the estimates, and the errors.
    outline : sequence of (N, 2) arrays, optional
        Walls (open polylines) and shelves (closed ones) in world metres.
    trail : (N, 2) array, optional
        Odometry of the first leg in full, in its own frame.
    line : sequence of (N, 2) arrays, optional
        The line on the floor as the robot saw it, in world metres, in pieces.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    path = Path(path)
    figure = new_figure(path, 10.0, 7.5, 160.0)
    axes = figure.add_axes((0.06, 0.065, 0.66, 0.835))
    figure.text(0.06, 0.955, f"Map of {_plain(result.survey, 40)}", size=16, weight="bold", color=INK)
    method = {"bundle": "bundle adjustment", "linear": "linear triangulation"}[result.solver.method]
    figure.text(0.06, 0.922, f"{_counts(result)} · {method} · {result.rms_px:.2g} px rms", size=9.5, color=MUTED)

    _draw_outline(axes, outline)
    for piece in (np.asarray(points, dtype=np.float64) for points in line):
        axes.plot(*piece.T, color=LINE, linewidth=3.2, solid_capstyle="butt", label="line on the floor", zorder=1.5)
    _draw_paths(axes, result, _odometry_paths(result, survey, trail))
    _draw_labels(axes, result, truth)
    span = _frame(axes, result, truth, outline)
    _draw_names(figure, axes, result, truth or {})
    _draw_scale(axes, span)
    handles, names = axes.get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    figure.legend(
        unique.values(),
        unique,
        loc="upper left",
        bbox_to_anchor=(0.735, 0.905),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )
    lowest = 0.905 - 0.027 * len(unique) - 0.03
    errors = _errors_mm(result, truth or {})
    if errors:
        lowest = _draw_errors(figure, np.array(list(errors.values())), lowest)
    _draw_unplaced(figure, [label for label in result.labels if label.status not in ("placed", "known")], lowest)
    save_figure(path, figure)


def _plain(text: str, length: int) -> str:
    """Text as it stands: matplotlib would read dollar signs as mathematics."""
    short = text if len(text) <= length else text[: length - 1] + "…"
    return "".join(c if c.isprintable() else "?" for c in short).replace("$", r"\$")


def _draw_outline(axes: Any, outline: Sequence[ArrayLike]) -> None:
    for points in (np.asarray(line, dtype=np.float64) for line in outline):
        if len(points) > 2 and np.allclose(points[0], points[-1]):
            axes.fill(points[:, 0], points[:, 1], facecolor="#eef0f3", edgecolor=WALL, linewidth=1.0, zorder=1.2)
        else:
            axes.plot(points[:, 0], points[:, 1], color=WALL, linewidth=2.4, solid_capstyle="round", zorder=1.3)


def _draw_paths(axes: Any, result: Map, odometry: list[Floats]) -> None:
    for path in odometry:
        axes.plot(*path.T, color=ODOMETRY, linewidth=1.2, linestyle=(0, (4, 2)), label="path by odometry", zorder=2)
        if len(path) <= MANY:
            axes.plot(*path.T, color=ODOMETRY, marker=".", markersize=3.5, linestyle="none", zorder=2)
    for stops in _legs(result).values():
        x, y = np.array([stop.x for stop in stops]), np.array([stop.y for stop in stops])
        heading = np.array([stop.heading for stop in stops])
        axes.plot(x, y, color=ADJUSTED, linewidth=1.4, label="path after adjustment", zorder=3)
        arrows = {"color": ADJUSTED, "zorder": 3.2, "width": 0.0042, "headwidth": 4, "headlength": 4.5}
        axes.quiver(x, y, np.cos(heading), np.sin(heading), scale=26, headaxislength=4, **arrows)
        axes.plot(
            x, y, color=ADJUSTED, marker="o", markersize=11, linestyle="none", label="stop and heading", zorder=3.4
        )
        for stop in stops if len(stops) <= MANY else ():
            text = {"color": "white", "size": 6.5, "weight": "bold", "ha": "center", "va": "center_baseline"}
            axes.text(stop.x, stop.y, str(stop.stop), zorder=3.6, clip_on=True, **text)


def _draw_labels(axes: Any, result: Map, truth: Mapping[str, Vector3] | None) -> None:
    from matplotlib.patches import Ellipse

    placed = [label for label in result.labels if label.position is not None]
    for label in placed:
        if label.covariance is None or label.position is None:
            continue
        values, vectors = np.linalg.eigh(np.array(label.covariance)[:2, :2])
        wide, high = 2 * np.sqrt(CHI2_95[2] * np.maximum(values[::-1], 0.0))
        angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        style = {"facecolor": ESTIMATE, "edgecolor": ESTIMATE, "linewidth": 0.7, "alpha": 0.28}
        axes.add_patch(Ellipse(label.position[:2], wide, high, angle=angle, label="95 % confidence", zorder=4, **style))
    by_status = {
        "placed": ("o", "estimated label"),
        "known": ("s", "label known before"),
        "ambiguous": ("D", "ambiguous"),
    }
    if truth:
        found = {label.label: label.position for label in placed if label.position is not None}
        pairs = [(found[name], at) for name, at in truth.items() if name in found]
        for estimate, true in pairs:
            line = [estimate[0], true[0]], [estimate[1], true[1]]
            axes.plot(*line, color=INK, linewidth=1.1, label="error", zorder=4.5)
        both = np.array([true[:2] for _, true in pairs]).reshape(-1, 2)
        missed = np.array([at[:2] for name, at in truth.items() if name not in found]).reshape(-1, 2)
        if len(both):
            axes.plot(*both.T, "o", color=TRUTH, ms=6.5, mfc="none", mew=1.1, label="true position", zorder=4.6)
        if len(missed):
            axes.plot(*missed.T, "x", color=INK, ms=5.5, mew=1.4, label="true position, not placed", zorder=4.6)
    for status, (marker, name) in by_status.items():
        points = np.array([at.position[:2] for at in placed if at.position and at.status == status])
        if len(points):
            style = {"color": ESTIMATE, "markersize": 4.2, "markeredgecolor": "white", "markeredgewidth": 0.4}
            axes.plot(*points.T, marker, label=name, zorder=5, **style)


def _frame(axes: Any, result: Map, truth: Mapping[str, Vector3] | None, outline: Sequence[ArrayLike]) -> float:
    """Limits, grid and ticks; returns the larger side of what is shown in metres.

    One label that was thrown far away must not shrink the store to a dot: what lies beyond five times the
    spread of all the rest is left outside the picture.
    """
    firm = [np.array([[stop.x, stop.y] for stop in result.stops]).reshape(-1, 2)]
    firm += [np.asarray(line, dtype=np.float64)[:, :2] for line in outline]
    firm.append(np.array([at[:2] for at in (truth or {}).values()]).reshape(-1, 2))
    loose = np.array([label.position[:2] for label in result.labels if label.position is not None]).reshape(-1, 2)
    points = np.concatenate(firm)
    if len(loose):
        middle = np.median(loose, axis=0)
        reach = 5 * max(float(np.median(np.abs(loose - middle))), GRID)
        points = np.concatenate([points, loose[np.all(np.abs(loose - middle) <= reach, axis=1)]])
    if not len(points):
        points = np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(0.07 * float((high - low).max()), 0.25)
    middle, size = (low + high) / 2, high - low + 2 * margin
    box = axes.get_window_extent()
    size = max(size[0] / box.width, size[1] / box.height) * np.array([box.width, box.height])
    axes.set_xlim(middle[0] - size[0] / 2, middle[0] + size[0] / 2)
    axes.set_ylim(middle[1] - size[1] / 2, middle[1] + size[1] / 2)
    span = float(size.max())
    fine = GRID * 10 ** max(0, math.ceil(math.log10(span / GRID / 60)))  # at most 60 lines
    labelled = fine * next(step for step in (1, 2, 4, 10, 20, 40) if span / fine / step <= 16)
    for set_ticks, limits in ((axes.set_xticks, axes.get_xlim()), (axes.set_yticks, axes.get_ylim())):
        set_ticks(np.arange(math.ceil(limits[0] / labelled), limits[1] / labelled) * labelled)
        set_ticks(np.arange(math.ceil(limits[0] / fine), limits[1] / fine) * fine, minor=True)
    axes.grid(which="both", color=FAINT, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", length=0, labelsize=8, labelcolor=MUTED)
    axes.set_xlabel(f"x in metres (grid {1e3 * fine:g} mm)", size=8.5, color=MUTED)
    axes.set_ylabel("y in metres", size=8.5, color=MUTED)
    for side in axes.spines.values():
        side.set_color(WALL)
    return span


def _draw_names(figure: Any, axes: Any, result: Map, truth: Mapping[str, Vector3]) -> None:
    """Write each label's id beside it (or beside its true position), on the side where it covers least."""
    found = {label.label: label.position for label in result.labels if label.position is not None}
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    named = {name: at for name, at in {**truth, **found}.items() if x0 < at[0] < x1 and y0 < at[1] < y1}
    if not named or len(named) > MANY:
        return
    points = axes.transData.transform(np.array([at[:2] for at in named.values()]))
    stops = axes.transData.transform(np.array([[stop.x, stop.y] for stop in result.stops]).reshape(-1, 2))
    pixel = figure.dpi / 72
    size = 6.0 if len(named) <= 60 else 5.0
    taken: list[Floats] = [np.array([x - 4, y - 4, x + 4, y + 4]) * 1.0 for x, y in points]
    taken += [np.array([x - 12, y - 12, x + 12, y + 12]) for x, y in stops]
    for name, (x, y) in zip(named, points, strict=True):
        wide, high = 0.62 * size * len(name[:12]) * pixel, size * pixel
        best: tuple[float, float, float, Floats] | None = None
        for rank, angle in enumerate(np.radians([90, -90, 0, 180, 45, 135, -45, -135] * 3)):
            far = (5 + 9 * (rank // 8)) * pixel
            cx = x + math.cos(angle) * (far + wide / 2)
            cy = y + math.sin(angle) * (far + high / 2)
            box = np.array([cx - wide / 2, cy - high / 2, cx + wide / 2, cy + high / 2])
            cost = sum(_overlap(box, other) for other in taken) + 2.0 * rank
            if best is None or cost < best[0]:
                best = (cost, cx, cy, box)
        assert best is not None
        taken.append(best[3])
        at = axes.transData.inverted().transform(best[1:3])
        text = {"size": size, "color": INK, "ha": "center", "va": "center", "zorder": 6, "clip_on": True}
        axes.text(*at, _plain(name, 12), **text)


def _overlap(a: Floats, b: Floats) -> float:
    """Area in square pixels that two boxes share."""
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return float(wide * high) if wide > 0 and high > 0 else 0.0


def _draw_scale(axes: Any, span: float) -> None:
    length = next((step for step in (0.5, 1, 2, 5, 10, 20, 50) if step >= 0.1 * span), 100.0)
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    x, y = x0 + 0.03 * (x1 - x0), y0 + 0.035 * (y1 - y0)
    axes.plot([x, x + length], [y, y], color=INK, linewidth=3, solid_capstyle="butt", zorder=7)
    name = f"{1e3 * length:g} mm" if length < 1 else f"{length:g} m"
    axes.text(x + length / 2, y + 0.012 * (y1 - y0), name, size=8, ha="center", va="bottom", color=INK, zorder=7)


def _draw_errors(figure: Any, errors: Floats, top: float) -> float:
    """Figures of the errors and a scatter of the horizontal ones; returns where the space below begins."""
    length = np.linalg.norm(errors, axis=1)
    figure.text(0.745, top, "Errors against the truth", size=9.5, weight="bold", color=INK, va="top")
    rows = [
        ("mean", length.mean()),
        ("median", np.median(length)),
        ("95 %", np.percentile(length, 95)),
        ("max", length.max()),
    ]
    for index, (name, value) in enumerate(rows):
        x = 0.745 + 0.058 * index
        figure.text(x, top - 0.030, name, size=7.5, color=MUTED, va="top")
        figure.text(x, top - 0.050, f"{value:.1f}" if value < 1e3 else f"{value:.0f}", size=10, color=INK, va="top")
    figure.text(0.968, top - 0.053, "mm", size=8, color=MUTED, va="top")
    inset = figure.add_axes((0.775, top - 0.315, 0.165, 0.22))
    flat = np.abs(errors[:, :2]).max(axis=1)
    reach = 1.15 * max(min(float(flat.max()), 4 * float(np.percentile(flat, 80))), 1.0)
    for radius, style in ((float(length.mean()), "-"), (float(np.percentile(length, 95)), ":")):
        turn = np.linspace(0, 2 * np.pi, 100)
        inset.plot(radius * np.cos(turn), radius * np.sin(turn), color=MUTED, linewidth=0.8, linestyle=style)
    inset.scatter(errors[:, 0], errors[:, 1], s=11, color=ESTIMATE, edgecolors=INK, linewidths=0.3, zorder=3)
    inset.set_xlim(-reach, reach)
    inset.set_ylim(-reach, reach)
    inset.axhline(0, color=FAINT, linewidth=0.8, zorder=0)
    inset.axvline(0, color=FAINT, linewidth=0.8, zorder=0)
    inset.tick_params(length=2, labelsize=7, labelcolor=MUTED, color=WALL)
    inset.set_xlabel("x and y error in mm; circles: mean, 95 %", size=7, color=MUTED, labelpad=2)
    for side in inset.spines.values():
        side.set_color(WALL)
    return top - 0.40


def _draw_unplaced(figure: Any, labels: list[MappedLabel], top: float) -> None:
    """List the labels that have no position, together where the reason is the same."""
    if not labels:
        return
    figure.text(0.745, top, f"Without a position ({len(labels)})", size=9.5, weight="bold", color=INK, va="top")
    reasons: dict[str, list[str]] = {}
    for label in labels:
        reasons.setdefault(label.reason or label.status, []).append(label.label)
    y, listed = top - 0.028, 0
    for reason, names in sorted(reasons.items(), key=lambda item: -len(item[1])):
        lines = textwrap.wrap(f"{', '.join(names)}: {reason}", 46, break_long_words=True)
        if y - 0.0165 * len(lines) < 0.045:
            text = f"{listed} of them are listed, map.json has all" if listed else "map.json has the reasons"
            figure.text(0.745, y, text, size=7, color=MUTED, va="top")
            return
        text = "\n".join(_plain(line, 60) for line in lines)
        figure.text(0.745, y, text, size=7, color=INK, va="top", linespacing=1.15)
        y -= 0.0165 * len(lines) + 0.006
        listed += len(names)


# ---- the page --------------------------------------------------------------------------------------------------------


def map_html(
    path: str | Path,
    result: Map,
    *,
    survey: Survey | None = None,
    truth: Mapping[str, Vector3] | None = None,
    outline3d: Sequence[tuple[ArrayLike, float]] = (),
    line: Sequence[ArrayLike] = (),
) -> None:
    """Write a page with the map in three dimensions and a table of the labels; it needs no network.

    Parameters
    ----------
    path : path
        Of the HTML file.
    result, survey, truth
        As `map_png`.
    outline3d : sequence of ((N, 2) array, height), optional
        Walls and shelves in world metres, standing on the floor.
    line : sequence of (N, 2) arrays, optional
        As `map_png`.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    page = resources.files("robotd.solver").joinpath("map_view.html").read_text(encoding="utf-8")
    data = json.dumps(_page_data(result, survey, truth, outline3d, line), allow_nan=False, ensure_ascii=True)
    for character in "<>&":  # so that no label can end the script element
        data = data.replace(character, f"\\u{ord(character):04x}")
    head, tail = page.split("__DATA__")
    page = head.replace("__TITLE__", html.escape(result.survey)) + data + tail
    save_picture(path, page.encode("utf-8", "replace"))


def _page_data(
    result: Map,
    survey: Survey | None,
    truth: Mapping[str, Vector3] | None,
    outline3d: Sequence[tuple[ArrayLike, float]],
    line: Sequence[ArrayLike] = (),
) -> dict[str, Any]:
    """What the page shows: metres rounded to 0.1 mm, angles in radians."""
    errors = _errors_mm(result, truth or {})
    labels = []
    for label in result.labels:
        error = errors.get(label.label)
        labels.append(
            {
                "name": label.label,
                "status": label.status,
                "at": _rounded(label.position),
                "true": _rounded((truth or {}).get(label.label)),
                "error": None if error is None else round(float(np.linalg.norm(error)), 2),
                "axes": _axes(label),
                "sightings": label.sightings,
                "inliers": label.inliers,
                "reason": label.reason,
            }
        )
    mapped = {label.label for label in result.labels}
    return {
        "survey": result.survey,
        "summary": f"{_counts(result)}, {result.rms_px:.2g} px rms",
        "frame": result.frame,
        "errors": None if not errors else _statistics([float(np.linalg.norm(error)) for error in errors.values()]),
        "labels": labels,
        "missing": [{"name": name, "true": _rounded(at)} for name, at in (truth or {}).items() if name not in mapped],
        "legs": [
            [[stop.stop, round(stop.x, 4), round(stop.y, 4), round(stop.heading, 5)] for stop in stops]
            for stops in _legs(result).values()
        ],
        "odometry": [np.round(path, 4).tolist() for path in _odometry_paths(result, survey, None)],
        "line": [np.round(np.asarray(points, dtype=np.float64), 4).tolist() for points in line],
        "solids": [
            {"points": np.round(np.asarray(points, dtype=np.float64)[:, :2], 4).tolist(), "height": round(height, 4)}
            for points, height in outline3d
        ],
        "notes": list(result.notes),
    }


def _rounded(position: Vector3 | None) -> list[float] | None:
    return None if position is None else [round(float(value), 4) for value in position]


def _statistics(errors: list[float]) -> dict[str, float]:
    values = np.array(errors)
    found = {"mean": values.mean(), "median": np.median(values), "p95": np.percentile(values, 95), "max": values.max()}
    return {name: round(float(value), 2) for name, value in found.items()}


def _axes(label: MappedLabel) -> list[list[float]] | None:
    """The half axes of the 95 % ellipsoid as three vectors in metres."""
    if label.covariance is None:
        return None
    values, vectors = np.linalg.eigh(np.array(label.covariance))
    half = vectors * np.sqrt(CHI2_95[3] * np.maximum(values, 0.0))
    return [[float(f"{value:.4g}") for value in column] for column in half.T]
