"""Learn the pattern in which a label flashes, from a recording of one label that flashes for some periods.

The label is where light changes most, compared with its surroundings. Its light curve is trimmed to the time in which
it flashes and folded at every possible period; the shortest period whose fold leaves no more of the curve than its
multiples' folds leave is the pattern's. Every edge of the folded curve is then the middle of the interval in which the
exposures allow it, by a robust likelihood, and half that interval is its uncertainty.

What was learnt is doubted before it is believed: rivals with a flash less, with two flashes in one, and with another
period must be unlikely, and both halves of the recording must say the same; else the answer is a refusal that says why.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .pattern_fit import LEAST_CONTRAST, LEAST_CYCLES, LearntPattern, PatternFit
from .spot import light_table

Floats = NDArray[np.float64]

_PLACES = 24  # that vary most, examined
_APART = 3  # cells
_AS_MUCH = 0.5  # of a place's change above what is usual: what is joined to it by so much belongs to it, as in a screen
_SURE = 0.95  # confidence below which the answer is a refusal
_RIVAL = 0.3  # a second place that flashes differently counts if it is so strong, relative to the first


def learn_pattern(
    frames: Iterable[NDArray[np.uint8]],
    times: Sequence[float] | Floats,
    exposure: float = 0.010,
    gamma: float = 2.2,
    shortest: float = 0.2,
    longest: float = 3.0,
    near: tuple[float, float] | None = None,
) -> LearntPattern:
    """The pattern of the one label that flashes in a recording.

    Parameters
    ----------
    frames : iterable of (H, W) uint8 arrays
        Grey images of a camera that stands still, 20 a second or more, over at least three periods of the pattern; the
        label may be dark before and after.
    times : (F,) sequence
        Start of each frame's exposure in seconds, increasing.
    exposure, gamma : float
        Of the camera: seconds, and grey = light^(1/gamma).
    shortest, longest : float
        Limits of the period in seconds.
    near : (u, v), optional
        Only what flashes within 12 px of this pixel counts, where other things blink too.

    Returns
    -------
    LearntPattern
        Its first flash starts at 0, and its longest dark interval is the last.

    Raises
    ------
    InputError
        If the recording is too short, nothing in it repeats, several things flash differently, or the pattern is in
        doubt; the message says which, and what to do.
    """
    stamps = _checked(times, shortest)
    cells = np.stack([cv2.resize(f, (f.shape[1] // 2, f.shape[0] // 2), interpolation=cv2.INTER_AREA) for f in frames])
    if len(cells) != len(stamps):
        raise InputError(f"the recording has {len(cells)} frames but {len(stamps)} time stamps; expected as many")
    found: list[tuple[float, LearntPattern]] = []
    reasons: list[str] = []
    for row, column, curve in _curves(cells, light_table(gamma, 256), near):
        try:
            learnt, light = _learn(stamps, curve, exposure, shortest, longest)
        except InputError as error:
            reasons.append(str(error))
            continue
        found.append((light, replace(learnt, u=2.0 * column + 1.5, v=2.0 * row + 1.5)))
    if not found:
        why = f" (the strongest place: {reasons[0]})" if reasons else ""
        raise InputError(
            "nothing in the recording flashes in a pattern that repeats: let one label flash all the time, keep people"
            f" out of the picture, and hold the camera still{why}"
        )
    found.sort(key=lambda item: -item[0])
    light, best = found[0]
    for other, rival in found[1:]:
        if other >= _RIVAL * light and not _same(best, rival):
            raise InputError(
                f"two things flash differently: {_said(best)} at pixel ({best.u:.0f}, {best.v:.0f}), {_said(rival)} at"
                f" ({rival.u:.0f}, {rival.v:.0f}); cover one, or say near which pixel the label is"
            )
    return best


def learn_trace(
    times: Sequence[float] | Floats,
    light: Sequence[float] | Floats,
    exposure: float = 0.010,
    shortest: float = 0.2,
    longest: float = 3.0,
) -> LearntPattern:
    """The pattern of a light curve (F,) in any linear unit of light; else as `learn_pattern`."""
    stamps = _checked(times, shortest)
    curve = np.asarray(light, float)
    if curve.shape != stamps.shape or not np.isfinite(curve).all():
        raise InputError(f"expected one finite value of light for each of {len(stamps)} times, got {curve.shape}")
    return _learn(stamps, curve, exposure, shortest, longest)[0]


def _checked(times: Sequence[float] | Floats, shortest: float) -> Floats:
    stamps = np.asarray(times, float)
    if len(stamps) < 16 or stamps[-1] - stamps[0] < LEAST_CYCLES * shortest:
        raise InputError(
            f"the recording has {len(stamps)} frames; expected at least 3 periods of one flashing label: record longer"
        )
    if np.min(np.diff(stamps)) <= 0.0:
        raise InputError("the recording's time stamps do not increase")
    return stamps


def _said(learnt: LearntPattern) -> str:
    return f"{len(learnt.pattern.on)} flashes in {learnt.pattern.period:.3f} s"


def _same(a: LearntPattern, b: LearntPattern) -> bool:
    """Whether two patterns differ by no more than their uncertainty and a few milliseconds allow."""
    if len(a.pattern.on) != len(b.pattern.on) or abs(a.pattern.period - b.pattern.period) > 0.01 * a.pattern.period:
        return False
    allowed = 0.015 + 3.0 * float(np.hypot(a.edge_sigma, b.edge_sigma))
    return bool(np.abs(np.array(a.pattern.on) - np.array(b.pattern.on)).max() <= allowed)


def _curves(
    cells: NDArray[Any], light: NDArray[np.float32], near: tuple[float, float] | None
) -> list[tuple[int, int, Floats]]:
    """Row, column and light curve, less the cells around, of the 2x2-cell places that vary most.

    A screen or a window that changes as a whole is one place: its cells would leave no room for a label's.
    """
    change = np.zeros(cells.shape[1:], np.float32)
    means = cells.mean(axis=(1, 2))
    for k in range(1, len(cells)):  # less the flicker of the lamps
        change += (cells[k].astype(np.float32) * np.float32(means[k - 1] / max(means[k], 1.0)) - cells[k - 1]) ** 2
    sums = cv2.boxFilter(change, -1, (2, 2), normalize=False, anchor=(0, 0))
    sums[-1] = sums[:, -1] = 0.0
    if near is not None:
        rows, columns = np.mgrid[: sums.shape[0], : sums.shape[1]]
        sums[np.hypot(2.0 * columns + 1.5 - near[0], 2.0 * rows + 1.5 - near[1]) > 12.0] = 0.0
    curves = []
    usual = float(np.median(sums))
    for _ in range(_PLACES):
        row, column = divmod(int(np.argmax(sums)), sums.shape[1])
        if sums[row, column] <= 0.0:
            break
        region = (sums >= usual + _AS_MUCH * (sums[row, column] - usual)).astype(np.uint8)
        cv2.floodFill(region, None, (column, row), 2)
        sums[cv2.dilate((region == 2).astype(np.uint8), np.ones((2 * _APART + 1, 2 * _APART + 1), np.uint8)) > 0] = 0.0
        top, left = max(row - _APART, 0), max(column - _APART, 0)
        around = light[cells[:, top : row + _APART + 2, left : column + _APART + 2]]
        place = light[cells[:, row : row + 2, column : column + 2]].mean(axis=(1, 2))
        around = np.median(around, axis=(1, 2))
        # because lamps that flicker change the place and its surroundings by the same factor
        curve = place - around * (np.median(place) / max(float(np.median(around)), 1e-3))
        curves.append((row, column, curve.astype(float)))
    return curves


def _learn(
    times: Floats, curve: Floats, exposure: float, shortest: float, longest: float
) -> tuple[LearntPattern, float]:
    """The pattern, and how bright it is; raises `InputError` with the reason why there is none."""
    times, curve = _active(times, curve)
    whole = PatternFit(times, curve, exposure, shortest, longest)
    learnt = whole.learnt()
    light = whole.light
    middle = len(times) // 2
    if learnt.cycles >= 2 * LEAST_CYCLES:
        for part in (slice(None, middle), slice(middle, None)):
            half = PatternFit(times[part], curve[part], exposure, shortest, longest, whole.period).learnt()
            if not _same(learnt, half):
                raise InputError(
                    f"the recording contradicts itself: {_said(learnt)} in all of it, {_said(half)} in one half; keep"
                    " people and other lights away from the label"
                )
    if learnt.confidence < _SURE:
        raise InputError(
            f"the pattern is in doubt: {_said(learnt)}, with a probability of {learnt.confidence:.0%} only; record"
            " longer, from nearer"
        )
    return learnt, light


def _active(times: Floats, curve: Floats) -> tuple[Floats, Floats]:
    """The part of a light curve in which the label flashes."""
    noise = float(np.quantile(np.abs(np.diff(curve)), 0.25)) / 0.45  # most frames change by noise alone
    dark = float(np.quantile(curve, 0.1)) + 1.28 * noise
    raised = curve - dark
    top = raised > max(LEAST_CONTRAST * noise, 0.5 * float(np.quantile(raised, 0.99)))
    lit = np.flatnonzero(top)
    if len(lit) < 2 * LEAST_CYCLES:
        raise InputError("no flashes stand out of the noise; record from nearer, in less light")
    pace = float(np.median(np.diff(times)))
    chosen = (times >= times[lit[0]] - 1.5 * pace) & (times <= times[lit[-1]] + 1.5 * pace)
    return times[chosen], curve[chosen]
