"""Pictures of what the line detector sees, and of what simpler methods see. Thesis figures 46 to 55.

Every function takes and returns pictures as (H, W, 3) uint8 arrays in OpenCV's order, blue, green, red. Colours are
those of Okabe and Ito, which people with any kind of colour vision can tell apart, and viridis for quantities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line
from .evidence import believed
from .explain import Explanation
from .polyline import directions, resample

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

ORANGE, SKY, GREEN = (0, 159, 230), (233, 180, 86), (115, 158, 0)
YELLOW, BLUE, RED, PURPLE = (66, 228, 240), (178, 114, 0), (0, 94, 213), (167, 121, 204)
WHITE, BLACK, GREY = (255, 255, 255), (0, 0, 0), (128, 128, 128)
CATEGORIES = (ORANGE, SKY, YELLOW, PURPLE, GREEN, RED, BLUE)
DOUBTFUL = 0.05  # confidence from which a refused line is worth showing
PANEL = 560  # width in pixels of one picture of a sheet
BAR = 30  # height of its title
HEAD = 40  # height of the title of a sheet


class Canvas:
    """A grey image, enlarged or reduced to the width of a panel, to draw on in the image's own pixels."""

    def __init__(self, gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None = None, *, dim: float = 1.0) -> None:
        self.zoom = PANEL / gray.shape[1]
        way = cv2.INTER_AREA if self.zoom < 1.0 else cv2.INTER_LINEAR
        size = (PANEL, max(round(gray.shape[0] * self.zoom), 1))
        shown = cv2.resize(gray, size, interpolation=way)
        if dim < 1.0:  # towards grey, so that dark and bright lines stay visible under colours
            shown = cv2.addWeighted(shown, dim, np.full_like(shown, 70), 1.0 - dim, 0.0)
        self.picture: Picture = np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        if valid is not None:
            outside = cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) == 0
            v, u = np.nonzero(outside)
            hatched = (u + v) % 12 < 2
            self.picture[outside] = 45
            self.picture[v[hatched], u[hatched]] = 85

    def line(self, points: Floats, colour: Colour, thick: int = 1) -> None:
        """A polyline (N, 2)."""
        at = np.rint(((points + 0.5) * self.zoom - 0.5) * 16.0).astype(np.int32)
        cv2.polylines(self.picture, [at], False, colour, thick, cv2.LINE_AA, 4)

    def segments(self, ends: Floats, colour: Colour) -> None:
        """Many short lines (K, 4)."""
        at = np.rint(((ends.reshape(-1, 2, 2) + 0.5) * self.zoom - 0.5) * 16.0).astype(np.int32)
        cv2.polylines(self.picture, list(at), False, colour, 1, cv2.LINE_AA, 4)

    def dots(self, points: Floats, colours: NDArray[np.uint8], radius: int = 1) -> None:
        """Dots at (N, 2), each of its colour (N, 3)."""
        at = np.floor((points + 0.5) * self.zoom).astype(int)
        for (u, v), colour in zip(at.tolist(), colours.tolist(), strict=True):
            cv2.circle(self.picture, (u, v), radius, colour, -1, cv2.LINE_AA)

    def text(self, at: Floats, words: str) -> None:
        """White words on a dark ground, kept inside the picture; `at` (2,) is their lower left corner."""
        u, v = ((np.asarray(at) + 0.5) * self.zoom).astype(int).tolist()
        (wide, high), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        u, v = min(max(u, 4), PANEL - wide - 4), min(max(v, high + 4), self.picture.shape[0] - 7)
        self.picture[v - high - 4 : v + 6, u - 4 : u + wide + 4] //= 4
        cv2.putText(self.picture, words, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.5, WHITE, 1, cv2.LINE_AA)

    def scale(self, words: tuple[str, str], colours: NDArray[np.uint8]) -> None:
        """A strip of colours in the lower right corner with what its two ends mean."""
        high, wide = 12, 150
        top, left = self.picture.shape[0] - high - 8, PANEL - wide - 12
        strip = cv2.resize(colours.reshape(1, -1, 3), (wide, high), interpolation=cv2.INTER_LINEAR)
        self.picture[top - 24 : top + high + 6, left - 8 : left + wide + 8] //= 3
        self.picture[top : top + high, left : left + wide] = strip
        (right, _), _ = cv2.getTextSize(words[1], cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        for text, u in ((words[0], left), (words[1], left + wide - right)):
            cv2.putText(self.picture, text, (u, top - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, WHITE, 1, cv2.LINE_AA)

    def titled(self, title: str) -> Picture:
        """The picture under a bar with its title."""
        bar = np.full((BAR, PANEL, 3), 30, np.uint8)
        _words(bar, title, (8, BAR - 9), 0.6, WHITE, PANEL - 16)
        return np.vstack([bar, self.picture])


def _map(name: int) -> NDArray[np.uint8]:
    """(256, 3) colours of one of OpenCV's maps."""
    ramp = np.arange(256, dtype=np.uint8).reshape(-1, 1)
    return np.ascontiguousarray(cv2.applyColorMap(ramp, name), dtype=np.uint8)[:, 0]


def _shades(values: Floats, low: float, high: float, name: int = cv2.COLORMAP_VIRIDIS) -> NDArray[np.uint8]:
    """(N, 3) colours of values between two bounds."""
    share = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0)
    shades: NDArray[np.uint8] = _map(name)[(255.0 * share).astype(int)]
    return shades


SHEET = ("picture", "borders", "strokes", "score", "clusters", "lines")  # the stages on the sheet of a picture


def stages(
    gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation, lines: Sequence[Line], sure: float
) -> dict[str, Picture]:
    """The stages from the picture to the lines, by name, each a titled picture of the same size.

    Parameters
    ----------
    gray, valid : (H, W) arrays
        What was given to the detector.
    seen : Explanation
    lines : sequence of Line
        Refused ones as well.
    sure : float
        Confidence from which a line counts.
    """
    return {
        "picture": Canvas(gray, valid).titled("picture" if valid is None else "top view; hatched: out of sight"),
        "gradient": _gradient(gray, valid, seen),
        "borders": _borders(gray, valid, seen),
        "strokes": _strokes(gray, valid, seen),
        "width": _widths(gray, valid, seen),
        "direction": _angles(gray, valid, seen),
        "score": _scores(gray, valid, seen),
        "clusters": _clusters(gray, valid, seen),
        "lines": found(gray, valid, lines, sure),
    }


def shown(seen: Sequence[Explanation], lines: Sequence[Line]) -> Explanation:
    """Which of all scales and colours to show: that of the best line, found or refused, else that of most strokes."""
    for line in sorted(lines, key=lambda line: -line.confidence):
        for one in seen:
            if one.polarity == line.polarity and one.width_px[0] <= line.width <= one.width_px[1]:
                return one
    return max(seen, key=lambda one: len(one.strokes))


def _gradient(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    top = max(float(np.percentile(seen.magnitude, 99.5)), seen.threshold, 1.0)
    canvas = Canvas(np.zeros_like(gray), valid)
    size = (PANEL, canvas.picture.shape[0])
    strength = cv2.resize(np.minimum(seen.magnitude / top, 1.0), size, interpolation=cv2.INTER_LINEAR)
    colours = _map(cv2.COLORMAP_VIRIDIS)
    shown = colours[(255.0 * strength).astype(int)]
    inside = canvas.picture[..., 0] == 0  # the picture is black but for the hatching outside the valid part
    canvas.picture[inside] = shown[inside]
    canvas.scale(("0", f"{top / 8.0:.0f} grey levels/px"), colours)
    return canvas.titled(f"gradient at {seen.scale:.2g} x size, threshold {seen.threshold / 8.0:.1f} grey levels/px")


def _borders(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    canvas = Canvas(gray, valid, dim=0.45)
    reach = min(max(7.0 / canvas.zoom, 2.0), 5.0 / min(seen.scale, 1.0))
    way = seen.edges[:, 2:] * (1.0 if seen.polarity == "bright" else -1.0)
    every = max(len(seen.edges) // 4000, 1)
    part = seen.edges[::every, :2]
    canvas.segments(np.hstack([part, part + reach * way[::every]]), SKY)
    canvas.dots(seen.edges[:, :2], np.tile(np.array(ORANGE, np.uint8), (len(seen.edges), 1)))
    return canvas.titled(f"borders: {len(seen.edges)} edges, seeking a partner (blue)")


def _strokes(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    canvas = Canvas(gray, valid, dim=0.45)
    canvas.segments(seen.one_sided, RED)
    canvas.segments(seen.strokes, SKY)
    return canvas.titled(f"strokes: {len(seen.strokes)} mutual (blue), {len(seen.one_sided)} one-sided (red)")


def _widths(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    canvas = Canvas(gray, valid, dim=0.35)
    widths = seen.widths
    middle = float(np.median(widths)) if len(widths) else 1.0
    low, high = np.percentile(widths, (2.0, 98.0)).tolist() if len(widths) else (1.0, 1.0)
    low, high = min(low, 0.9 * middle), max(high, 1.1 * middle)  # because colours for hundredths of pixels mislead
    canvas.dots(seen.centres, _shades(widths, low, high), 2)
    canvas.scale((f"{low:.1f}", f"{high:.1f} px"), _map(cv2.COLORMAP_VIRIDIS))
    return canvas.titled("width of each stroke, at its centre")


def _angles(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    canvas = Canvas(gray, valid, dim=0.35)
    step = seen.strokes[:, 2:] - seen.strokes[:, :2]
    along = np.degrees(np.arctan2(step[:, 0], step[:, 1])) % 180.0  # of the line, counter-clockwise from the right
    canvas.dots(seen.centres, np.full((len(along), 3), 255, np.uint8), 3)  # because upright lines are nearly black
    canvas.dots(seen.centres, _shades(along, 0.0, 180.0, cv2.COLORMAP_TWILIGHT), 2)
    canvas.scale(("0", "180 deg"), _map(cv2.COLORMAP_TWILIGHT))
    return canvas.titled("direction at each stroke, from the right, anticlockwise")


def _scores(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    canvas = Canvas(gray, valid, dim=0.35)
    order = np.argsort(seen.score)
    canvas.dots(seen.centres[order], _shades(seen.score[order], 0.0, 1.0), 2)
    canvas.scale(("0", "1"), _map(cv2.COLORMAP_VIRIDIS))
    return canvas.titled("score: share of the expected neighbours that agree")


def _clusters(gray: NDArray[np.uint8], valid: NDArray[np.bool_] | None, seen: Explanation) -> Picture:
    canvas = Canvas(gray, valid, dim=0.35)
    sizes = np.bincount(seen.labels[seen.labels >= 0]) if (seen.labels >= 0).any() else np.empty(0, np.int64)
    rank = np.empty(len(sizes), np.int64)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    palette = np.array([*CATEGORIES, GREY], np.uint8)
    shade = np.where(seen.labels >= 0, 0, len(CATEGORIES))
    shade[seen.labels >= 0] = rank[seen.labels[seen.labels >= 0]] % len(CATEGORIES)
    order = np.argsort(seen.labels >= 0, kind="stable")  # noise first, under the rest
    canvas.dots(seen.centres[order], palette[shade[order]], 2)
    for label in np.argsort(-sizes, kind="stable")[:7]:
        if sizes[label] < 0.1 * sizes.max():  # a few strokes of texture
            break
        members = seen.centres[seen.labels == label]
        canvas.text(members[int(np.argmin(((members - members.mean(axis=0)) ** 2).sum(axis=1)))], f"{rank[label] + 1}")
    return canvas.titled(f"clusters by place, width, direction: {len(sizes)}; grey: in none")


def found(
    gray: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    lines: Sequence[Line],
    sure: float,
    title: str | None = None,
) -> Picture:
    """The lines on the picture: borders, centre, normals every 2 widths, width and confidence; refused ones thin."""
    canvas = Canvas(gray, valid, dim=0.75)
    taken = believed(lines, sure)
    refused = [line for line in lines if line.confidence >= DOUBTFUL and not any(line is one for one in taken)]
    refused.sort(key=lambda line: -line.confidence)
    for k, line in enumerate(refused):
        canvas.line(line.points, GREY, 1)
        if k < 3:  # because more labels hide the picture
            canvas.text(line.points[len(line.points) // 2], f"refused {line.confidence:.2f}")
    for k, line in enumerate(taken):
        colour = CATEGORIES[k % len(CATEGORIES)]
        points = resample(line.points, max(0.25 * line.width, 1.0))
        tangent = directions(points)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        for side in (-0.5, 0.5):
            canvas.line(points + side * line.width * normal, WHITE, 1)
        canvas.segments(np.hstack([points, points + 0.9 * line.width * normal])[4::8], WHITE)
        canvas.line(points, BLACK, 4)
        canvas.line(points, colour, 2)
        at = int((0.3, 0.7, 0.5)[k % 3] * (len(points) - 1))  # because lines cross in the middle
        label = points[at] + 0.7 * line.width * normal[at]
        canvas.text(label, f"{line.width:.1f} px, confidence {line.confidence:.2f}")
    words = f"{len(taken)} line{'s' * (len(taken) > 1)}: centre, borders, normals" if taken else "no line"
    return canvas.titled(title or f"polylines: {words}")


def rivals(
    gray: NDArray[np.uint8],
    valid: NDArray[np.bool_] | None,
    lines: Sequence[Line],
    sure: float,
    *,
    dark: bool,
    least_length: float,
) -> dict[str, Picture]:
    """Our lines beside what four common methods mark, by name. Thesis figures 53 to 55.

    `dark` is the colour looked for, `least_length` (pixels) that of the shortest straight segment shown.
    """
    seen = np.ones(gray.shape, bool) if valid is None else valid
    inner = cv2.erode(seen.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    fixed = 80.0 if dark else 170.0
    otsu, _ = cv2.threshold(gray[seen].reshape(1, -1), 0.0, 255.0, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    pictures = {
        "picture": Canvas(gray, valid).titled("picture" if valid is None else "top view; hatched: out of sight"),
        "lines": found(gray, valid, believed(lines, sure), sure, "robotd"),
    }
    for name, level in (("fixed threshold", fixed), ("Otsu threshold", float(otsu))):
        marked = ((gray <= level) if dark else (gray > level)) & seen
        canvas = Canvas(gray, valid, dim=0.45)
        size = (PANEL, canvas.picture.shape[0])
        canvas.picture[cv2.resize(marked.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0] = ORANGE
        share = 100.0 * float(marked.sum()) / max(int(seen.sum()), 1)
        pictures[name] = canvas.titled(f"{name}: {'below' if dark else 'above'} {level:.0f}, {share:.0f} % of the view")
    edges = cv2.Canny(cv2.GaussianBlur(gray, (5, 5), 0), 50, 150)
    edges[~inner] = 0
    votes = max(round(least_length), 20)
    hough = cv2.HoughLinesP(edges, 1, math.pi / 180.0, votes, minLineLength=least_length, maxLineGap=0.3 * least_length)
    lsd = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(gray)[0]
    for name, segments in (("Canny + Hough", hough), ("LSD", lsd)):
        ends = np.asarray([] if segments is None else segments, dtype=np.float64).reshape(-1, 4)
        ends = ends[np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]) >= least_length]
        canvas = Canvas(gray, valid, dim=0.45)
        for row in ends:
            canvas.line(row.reshape(2, 2), ORANGE, 2)
        pictures[name] = canvas.titled(f"{name}: {len(ends)} segments of {least_length:.0f} px or more")
    return pictures


def sheet(pictures: Sequence[Picture], columns: int, title: str | None = None) -> Picture:
    """Pictures of one size side by side, in rows, in white frames, and under a title if there is one."""
    blank = np.full_like(pictures[0], 30)
    cells = [*pictures, *[blank] * (-len(pictures) % columns)]
    gap = 4
    framed = [cv2.copyMakeBorder(cell, gap, gap, gap, gap, cv2.BORDER_CONSTANT, value=WHITE) for cell in cells]
    rows = [np.hstack(framed[first : first + columns]) for first in range(0, len(framed), columns)]
    if title is not None:
        bar = np.full((HEAD, rows[0].shape[1], 3), 255, np.uint8)
        _words(bar, title, (10, HEAD - 13), 0.7, BLACK, bar.shape[1] - 20)
        rows = [bar, *rows]
    return np.asarray(np.vstack(rows), dtype=np.uint8)


def _words(picture: Picture, words: str, at: tuple[int, int], size: float, colour: Colour, room: int) -> None:
    """Words from `at` on, smaller where they would need more than `room` pixels."""
    (wide, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    size *= min(1.0, room / max(wide, 1))
    cv2.putText(picture, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
