"""What a flash detector makes of the frames so far: triggers, clusters and scores, for pictures and for people.

The detectors keep none of it, because the robot has no use for it. Thesis section 6.3.2 and figures 24 and 25.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from . import thesis_blink
from .blink import FlashDetector, Track
from .matching import Matches
from .thesis_blink import ThesisFlashDetector

Singles = NDArray[np.float32]
Indices = NDArray[np.intp]
State = Literal["found", "undecided", "refused"]


@dataclass(frozen=True, slots=True)
class Trigger:
    """A place that caught the detector's eye; `passed` its filters, `values` are what it measured there, by name."""

    u: float
    v: float
    size: float  # px across
    passed: bool
    values: dict[str, float]

    @property
    def note(self) -> str:
        """The values in words."""
        return ", ".join(f"{name} {value:.3g}" for name, value in self.values.items())


@dataclass(frozen=True, slots=True)
class Cluster:
    """A place of which the detector keeps account: its score, what became of it, and why."""

    u: float
    v: float
    score: float
    state: State
    note: str


@dataclass(frozen=True, slots=True, eq=False)
class FlashExplanation:
    """State of a detector after a frame.

    `change` (H, W) float32 is what triggers are taken from, in the words of `unit`; a cluster is found from a score of
    `threshold` on.
    """

    change: Singles
    unit: str
    triggers: tuple[Trigger, ...]
    clusters: tuple[Cluster, ...]
    threshold: float


# ---- ours ------------------------------------------------------------------------------------------------------------


def explain_blink(detector: FlashDetector, shape: tuple[int, int]) -> FlashExplanation:
    """The state of `FlashDetector` in images of this shape (H, W)."""
    threshold = detector.config.min_score(shape)
    unit = "alternation in the pattern's rhythm, in limits"
    if detector._alternation is None or not detector._alternation.is_ready:
        return FlashExplanation(np.zeros(shape, np.float32), unit, (), (), threshold)
    over = np.maximum(detector._alternation.standing_out(), 0.0)
    change = cv2.resize(over, shape[::-1], interpolation=cv2.INTER_NEAREST)
    clusters = [_track(detector, track) for track in detector.tracks]
    triggers = []
    known = len(detector.tracks)
    places = [(track.row, track.column) for track in detector.tracks]
    watched, examined = detector._alternation.candidates(places, detector.config.max_candidates)
    rows, columns = np.divmod(watched[:examined], detector._alternation.shape[1])
    rows, columns = detector._joined(detector.tracks, rows, columns)
    if len(rows) and detector._times[-1][1] - detector._times[0][1] >= 1.4 * detector.config.pattern.period:
        matches, _ = detector._match(detector._curves(rows, columns))
        for k, (row, column) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
            u, v = _centre(row, column)
            why = _why_not(detector, matches, k, threshold)
            measured = {
                "alternation": float(change[int(v), int(u)]),
                "score": float(matches.score[k]),
                "margin": float(matches.margin[k]),
            }
            triggers.append(Trigger(u, v, 4.0, not why, measured))
            if k >= known:
                state: State = "undecided" if matches.score[k] < threshold else "refused"
                clusters.append(Cluster(u, v, float(matches.score[k]), state, why or "will be a track"))
    return FlashExplanation(np.asarray(change, np.float32), unit, tuple(triggers), tuple(clusters), threshold)


def _centre(row: int, column: int) -> tuple[float, float]:
    """Middle in pixels of the aperture that begins at a cell: two by two cells of two by two pixels."""
    return 2.0 * column + 1.5, 2.0 * row + 1.5


def _track(detector: FlashDetector, track: Track) -> Cluster:
    spot = detector.spot(track)
    if spot is None:
        return Cluster(*_centre(track.row, track.column), track.score, "refused", "its image is no small light")
    near = [flash for flash in detector.flashes() if np.hypot(flash.u - spot.u, flash.v - spot.v) < 0.5]
    if not near:
        return Cluster(spot.u, spot.v, track.score, "refused", "looks like a reflection of another light")
    saturated = ", saturated" if near[0].saturated else ""
    note = f"{near[0].amplitude:.0f} grey levels, +-{spot.sigma:.3f} px{saturated}"
    return Cluster(spot.u, spot.v, track.score, "found", note)


def _why_not(detector: FlashDetector, matches: Matches, k: int, threshold: float) -> str:
    """Why a candidate is no track; empty if it would be one."""
    config, why = detector.config, []
    if matches.score[k] < threshold:
        why.append("score too low")
    elif matches.margin[k] < config.min_margin:
        why.append(f"steady blinking: margin {matches.margin[k]:.1f}")
    if not matches.regular[k]:
        why.append("a period lacks the pattern")
    if matches.light[k] <= 0.0:
        why.append("darkens")
    return "; ".join(why)


# ---- the thesis's ----------------------------------------------------------------------------------------------------


def explain_thesis(
    detector: ThesisFlashDetector, frame: NDArray[np.uint8], before: NDArray[np.int16] | None
) -> FlashExplanation:
    """The state of `ThesisFlashDetector` after `frame`, which came after the blurred image `before`."""
    config = detector.config
    found = {(flash.u, flash.v) for flash in detector.flashes()}
    clusters = []
    for position in detector._positions:
        times = np.diff(position.edges)
        costs = thesis_blink.cost(times, detector._periods)
        total = (float(costs.mean() if config.mean_cost else costs.sum())) if len(times) else 1.0
        state: State = "refused" if len(times) > config.min_edges else "undecided"
        if (position.u, position.v) in found:
            state = "found"
        note = f"cost {total:.2f}, {len(position.edges)} edges"
        clusters.append(Cluster(position.u, position.v, 1.0 - total, state, note))
    unit = "change of the blurred picture since the last frame, grey levels"
    if before is None:
        return FlashExplanation(np.zeros(frame.shape, np.float32), unit, (), tuple(clusters), 1.0 - config.max_cost)
    blurred = cv2.GaussianBlur(frame, thesis_blink._KERNEL, thesis_blink._SIGMA).astype(np.int16)
    change = blurred - before if config.signed else np.abs(blurred - before)
    mask = np.asarray(change >= config.threshold, np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    triggers = []
    for contour in contours:
        middle, radius = cv2.minEnclosingCircle(contour)
        area = cv2.contourArea(contour)
        place = detector._trigger(contour)
        u, v = place if place is not None else middle
        length = 2.0 * float(radius)
        measured = {"area": float(area), "length": length, "change": float(change[int(v), int(u)])}
        triggers.append(Trigger(float(u), float(v), length, place is not None, measured))
    return FlashExplanation(
        np.maximum(change, 0).astype(np.float32), unit, tuple(triggers), tuple(clusters), 1.0 - config.max_cost
    )
