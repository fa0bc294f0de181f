"""Pictures of the workbench: a frame with marks and findings, a detector's reaction, and a place's course in time.

All are (H, W, 3) uint8 arrays, blue, green, red. True labels are blue squares, findings are rings: green where they
belong to a label, red where to none; labels that were missed get a yellow square, places that are not judged a grey.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Flash
from ..vision.explain_flash import Cluster, FlashExplanation
from ..vision.figures import GREEN, GREY, ORANGE, PURPLE, RED, SKY, WHITE, YELLOW, Colour, Picture
from .score import Verdict, judge
from .tags import Tag
from .trace import Trace

Floats = NDArray[np.float64]

FONT = cv2.FONT_HERSHEY_SIMPLEX
BAR = 28
AXIS = 44  # px left of a plot and below it


@dataclass(frozen=True, slots=True)
class Seen:
    """Marks and findings at one time; `proposals` are findings that are offered as marks, by their numbers."""

    tags: Sequence[Tag]
    flashes: Sequence[Flash] | None = None  # None: no detector was asked
    proposals: Sequence[Flash] = ()

    @property
    def labels(self) -> list[Tag]:
        """Marks of lights that are to be found."""
        return [tag for tag in self.tags if tag.kind == "label"]

    @property
    def verdict(self) -> Verdict:
        """Which finding belongs to which label."""
        return judge(
            self.flashes or (),
            self.labels,
            [tag for tag in self.tags if tag.kind == "reflection"],
            [tag for tag in self.tags if tag.kind == "ignore"],
        )


class Sheet:
    """A grey picture enlarged by a whole or broken factor, to draw on in its own pixels."""

    def __init__(self, gray: NDArray[np.uint8], zoom: float, origin: tuple[float, float] = (0.0, 0.0)) -> None:
        self.zoom = zoom
        self.origin = origin
        self._written: list[tuple[int, int, int, int]] = []  # where words are
        height, width = gray.shape
        size = max(1, round(width * zoom)), max(1, round(height * zoom))
        way = cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_NEAREST
        self.picture: Picture = np.asarray(
            cv2.cvtColor(cv2.resize(gray, size, interpolation=way), cv2.COLOR_GRAY2BGR), dtype=np.uint8
        )

    def at(self, u: float, v: float) -> tuple[int, int]:
        """Where a place of the grey picture is in this one."""
        return (
            round((u - self.origin[0] + 0.5) * self.zoom - 0.5),
            round((v - self.origin[1] + 0.5) * self.zoom - 0.5),
        )

    def ring(self, u: float, v: float, radius: float, colour: Colour, thick: int = 1) -> None:
        """A circle of so many px of the grey picture."""
        cv2.circle(self.picture, self.at(u, v), max(2, round(radius * self.zoom)), colour, thick, cv2.LINE_AA)

    def square(self, u: float, v: float, radius: float, colour: Colour, thick: int = 1) -> None:
        """A square of so many px to either side."""
        x, y = self.at(u, v)
        half = max(3, round(radius * self.zoom))
        cv2.rectangle(self.picture, (x - half, y - half), (x + half, y + half), colour, thick, cv2.LINE_AA)

    def shows(self, u: float, v: float) -> bool:
        """Whether a place is in the picture."""
        x, y = self.at(u, v)
        return bool(0 <= x < self.picture.shape[1] and 0 <= y < self.picture.shape[0])

    def words(
        self, u: float, v: float, text: str, colour: Colour = WHITE, size: float = 0.38, *, always: bool = True
    ) -> None:
        """A text beside a place, on a dark ground and inside the picture; unless `always` only where there is room."""
        (wide, high), _ = cv2.getTextSize(text, FONT, size, 1)
        x, y = self.at(u, v)
        height, width = self.picture.shape[:2]
        x, y = min(max(x + 8, 2), max(2, width - wide - 2)), min(max(y - 6, high + 2), height - 4)
        box = x - 1, y - high - 1, x + wide + 1, y + 3
        if not always and any(_overlap(box, other) for other in self._written):
            return
        self._written.append(box)
        ground = self.picture[y - high - 1 : y + 3, x - 1 : x + wide + 1]
        ground //= 3
        cv2.putText(self.picture, text, (x, y), FONT, size, colour, 1, cv2.LINE_AA)

    def mark(self, seen: Seen) -> None:
        """Draw marks and findings."""
        verdict = seen.verdict
        missed = {id(seen.labels[k]) for k in verdict.missed} if seen.flashes is not None else set()
        for number, tag in enumerate(seen.tags, 1):
            if not self.shows(tag.u, tag.v):
                continue
            name = tag.label or f"#{number}"
            if tag.kind == "ignore":
                self.square(tag.u, tag.v, tag.radius, GREY)
            elif tag.kind == "reflection":
                self.square(tag.u, tag.v, tag.radius, PURPLE)
                self.words(tag.u, tag.v + 9, f"{name} reflection", PURPLE)
            else:
                colour = YELLOW if id(tag) in missed else SKY
                self.square(tag.u, tag.v, tag.radius, colour)
                self.words(tag.u, tag.v + 9, name, colour)
        for number, flash in enumerate(seen.flashes or ()):
            if not self.shows(flash.u, flash.v):
                continue
            colour = RED if number in verdict.false else GREY if number in verdict.ignored else GREEN
            self.ring(flash.u, flash.v, 4.0, colour, 2)
            self.words(flash.u, flash.v - 2, f"{flash.score:.3g}", colour)
        for number, flash in enumerate(seen.proposals, 1):
            self.ring(flash.u, flash.v, 4.0, ORANGE, 2)
            self.words(flash.u, flash.v - 2, f"proposal {number}", ORANGE)


def _overlap(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def titled(picture: Picture, title: str) -> Picture:
    """The picture under a bar with its title."""
    bar = np.full((BAR, picture.shape[1], 3), 30, np.uint8)
    cv2.putText(bar, title, (8, BAR - 9), FONT, 0.48, WHITE, 1, cv2.LINE_AA)
    return np.vstack([bar, picture])


def overlay(gray: NDArray[np.uint8], seen: Seen, title: str = "", zoom: float = 2.0, grid: bool = False) -> Picture:
    """A frame with marks and findings; with `grid` lines every 50 px carry their number, for reading places off."""
    sheet = Sheet(gray, zoom)
    if grid:
        height, width = gray.shape
        lines = sheet.picture.copy()
        for u in range(0, width, 50):
            cv2.line(lines, sheet.at(u, 0), sheet.at(u, height - 1), WHITE, 1)
        for v in range(0, height, 50):
            cv2.line(lines, sheet.at(0, v), sheet.at(width - 1, v), WHITE, 1)
        sheet.picture[:] = cv2.addWeighted(sheet.picture, 0.75, lines, 0.25, 0.0)
        for u in range(0, width, 50):
            sheet.words(u - 3, 6, str(u), size=0.4)
        for v in range(50, height, 50):
            sheet.words(-3, v + 5, str(v), size=0.4)
    sheet.mark(seen)
    return titled(sheet.picture, title) if title else sheet.picture


def reaction(gray: NDArray[np.uint8], seen: Seen, explained: FlashExplanation, title: str) -> Picture:
    """How a detector reacts to a frame: the frame, what changed with the triggers, the clusters with their scores."""
    zoom = 720.0 / gray.shape[1]
    frame = overlay(gray, seen, title, zoom)
    heat = _heat(explained.change)
    change = Sheet(np.zeros_like(gray), zoom)
    change.picture[:] = cv2.resize(heat, change.picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    for trigger in explained.triggers:
        change.ring(trigger.u, trigger.v, max(2.5, trigger.size / 2.0), ORANGE if trigger.passed else GREY)
    for trigger in sorted(explained.triggers, key=lambda one: -one.passed):
        change.words(trigger.u, trigger.v, trigger.note, ORANGE if trigger.passed else GREY, 0.33, always=False)
    passed = sum(trigger.passed for trigger in explained.triggers)
    peak = float(explained.change.max(initial=0.0))
    triggers = f"{len(explained.triggers)} triggers, {passed} pass; {explained.unit}, white = {peak:.0f}"
    account = Sheet((gray * 0.45).astype(np.uint8), zoom)
    for tag in seen.tags:
        account.square(tag.u, tag.v, tag.radius, SKY if tag.kind == "label" else GREY)
    colours = {"found": GREEN, "undecided": ORANGE, "refused": RED}
    best = sorted(explained.clusters, key=lambda one: -one.score)
    for cluster in reversed(best):
        account.ring(cluster.u, cluster.v, 4.0, colours[cluster.state], 2 if cluster.state == "found" else 1)
    for cluster in best:
        text = f"{cluster.score:.3g} {_short(cluster)}"
        account.words(cluster.u, cluster.v, text, colours[cluster.state], 0.33, always=False)
    counts = ", ".join(f"{sum(c.state == state for c in best)} {state}" for state in colours)
    clusters = f"{len(best)} clusters: {counts}; found from score {explained.threshold:.3g}"
    panels = [frame, titled(change.picture, triggers), titled(account.picture, clusters)]
    line = np.full((panels[0].shape[0], 4, 3), 255, np.uint8)
    return np.hstack([panels[0], line, panels[1], line, panels[2]])


def _short(cluster: Cluster) -> str:
    return cluster.note if len(cluster.note) <= 34 else cluster.note[:33] + "..."


def _heat(change: NDArray[np.float32]) -> Picture:
    top = max(float(change.max(initial=0.0)), 1.0)
    levels = np.clip(255.0 * np.sqrt(np.maximum(change, 0.0) / top), 0.0, 255.0).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), dtype=np.uint8)


def place(gray: NDArray[np.uint8], seen: Seen, trace: Trace, width: int = 2168) -> Picture:
    """The course of one place: its neighbourhood, its brightness with the pattern that was found, and its score."""
    u, v = trace.u, trace.v
    half = 16
    left, top = round(u) - half, round(v) - half
    padded = cv2.copyMakeBorder(gray, half, half, half, half, cv2.BORDER_REPLICATE)
    patch = padded[top + half : top + 3 * half + 1, left + half : left + 3 * half + 1]
    close = Sheet(np.asarray(patch, np.uint8), 12.0, (left, top))
    close.mark(seen)
    head = titled(close.picture, f"around {u:.1f},{v:.1f}")
    height = head.shape[0]
    room = width - head.shape[1]
    light = plot(
        (room, height // 2),
        f"brightness at {u:.1f},{v:.1f} over its surroundings, grey levels",
        trace.times,
        [(trace.light, SKY, "")],
        dots=True,
        shade=trace.pattern,
    )
    limit = trace.thresholds[-1] if trace.thresholds else math.nan
    score = plot(
        (room, height - height // 2),
        "score of the nearest cluster (within 4 px)" + (f", found from {limit:.3g}" if math.isfinite(limit) else ""),
        trace.score_times,
        [(trace.scores, ORANGE, "score"), (trace.thresholds, GREEN, "")],
        span=(trace.times[0], trace.times[-1]) if trace.times else None,
    )
    return np.hstack([head, np.vstack([light, score])])


def plot(
    size: tuple[int, int],
    title: str,
    times: Sequence[float],
    curves: Sequence[tuple[Sequence[float], Colour, str]],
    *,
    dots: bool = False,
    span: tuple[float, float] | None = None,
    shade: Sequence[tuple[float, float]] = (),
) -> Picture:
    """A plot of curves over time in seconds, `size` px (width, height); `shade` are intervals on a lighter ground."""
    width, height = size
    picture = np.full((height, width, 3), 24, np.uint8)
    cv2.putText(picture, title, (AXIS, 18), FONT, 0.45, WHITE, 1, cv2.LINE_AA)
    values = [value for curve, _, _ in curves for value in curve if math.isfinite(value)]
    if not times or not values:
        cv2.putText(picture, "nothing", (AXIS, height // 2), FONT, 0.45, GREY, 1, cv2.LINE_AA)
        return picture
    begin, end = span or (times[0], times[-1])
    low, high = min(values), max(values)
    margin = 0.06 * (high - low) or 1.0
    low, high = low - margin, high + margin
    top, bottom, left, right = 28, height - 22, AXIS, width - 10

    def at(t: float, value: float) -> tuple[int, int]:
        x = left + (right - left) * (t - begin) / max(end - begin, 1e-9)
        y = bottom - (bottom - top) * (value - low) / (high - low)
        return round(x), round(y)

    for first, last in shade:
        if last > begin and first < end:
            a, b = at(max(first, begin), low)[0], at(min(last, end), low)[0]
            picture[top:bottom, a : max(b, a + 1)] = 62
    for value in _ticks(low, high, 5):
        y = at(begin, value)[1]
        cv2.line(picture, (left, y), (right, y), (70, 70, 70), 1)
        cv2.putText(picture, f"{value:g}", (4, y + 4), FONT, 0.36, GREY, 1, cv2.LINE_AA)
    for t in _ticks(begin, end, 12):
        x = at(t, low)[0]
        cv2.line(picture, (x, bottom), (x, bottom + 4), GREY, 1)
        cv2.putText(picture, f"{t:g}", (x - 8, height - 6), FONT, 0.36, GREY, 1, cv2.LINE_AA)
    for curve, colour, name in curves:
        points = [at(t, value) for t, value in zip(times, curve, strict=True) if math.isfinite(value)]
        if points:
            cv2.polylines(picture, [np.array(points, np.int32)], False, colour, 1, cv2.LINE_AA)
            if dots:
                for point in points:
                    cv2.circle(picture, point, 2, colour, -1, cv2.LINE_AA)
            cv2.putText(picture, name, (points[-1][0] - 40, points[-1][1] - 6), FONT, 0.36, colour, 1, cv2.LINE_AA)
    return picture


def histograms(measured: Mapping[str, tuple[Sequence[float], Sequence[float]]], size: tuple[int, int]) -> Picture:
    """Of each quantity the values on labels (blue, upwards) and elsewhere (orange, downwards), one plot under another.

    Bars are shares of their own total, so that few labels can be compared with much clutter; ends are the first and
    the 99th percentile of both.
    """
    plots = []
    for name, (on_label, elsewhere) in measured.items():
        width, height = size
        picture = np.full((height, width, 3), 24, np.uint8)
        both = np.array([*on_label, *elsewhere])
        counts = f"{len(on_label)} on labels (blue), {len(elsewhere)} elsewhere (orange)"
        cv2.putText(picture, f"{name}: {counts}", (AXIS, 18), FONT, 0.45, WHITE, 1, cv2.LINE_AA)
        if len(both):
            low, high = (float(value) for value in np.percentile(both, [1.0, 99.0]))
            high = max(high, low + 1e-6)
            edges = np.linspace(low, high, 61)
            middle, reach = (28 + height - 22) // 2, (height - 50) // 2
            for values, colour, sign in ((on_label, SKY, -1), (elsewhere, ORANGE, 1)):
                if not len(values):
                    continue
                shares = np.histogram(np.clip(values, low, high), edges)[0] / len(values)
                for k, share in enumerate(shares / max(float(shares.max()), 1e-9)):
                    left, right = (AXIS + round((width - AXIS - 10) * (k + side) / 60) for side in (0, 1))
                    tip = middle + sign * round(reach * float(share))
                    cv2.rectangle(picture, (left, middle), (right - 2, tip), colour, -1)
            for value in _ticks(low, high, 10):
                x = AXIS + round((width - AXIS - 10) * (value - low) / (high - low))
                cv2.putText(picture, f"{value:g}", (x - 8, height - 6), FONT, 0.36, GREY, 1, cv2.LINE_AA)
        plots.append(picture)
    return np.vstack(plots)


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Round values between two bounds."""
    rough = (high - low) / most
    unit = 10.0 ** math.floor(math.log10(rough)) if rough > 0.0 else 1.0
    step = next(factor * unit for factor in (1.0, 2.0, 5.0, 10.0) if factor * unit >= rough * 0.999)
    first = math.ceil(low / step)
    return [float(f"{k * step:.10g}") for k in range(first, math.floor(high / step) + 1)]
