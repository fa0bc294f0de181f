"""Finding the beacons of a robot that stands still, anywhere in a roof camera's picture.

Every cell of 2 x 2 pixels is fitted with a constant, a drift and a sine at each beacon's rate, by least squares at the
frames' own stamps: that is a lock-in amplifier for unevenly spaced samples, without leakage from one term into another.
An F-test keeps what follows a rate better than noise would. The few places that pass are tried again at full size with
the wave itself (robotd.vision.beacon_wave), less the light around them, against the probability of a false alarm
anywhere in the picture, and against every other rate: what blinks at another rate fits that one better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats
from .beacon_track import undisturbed
from .beacon_wave import Lock, Wave, lock

Image = NDArray[np.uint8]

MOST = 24  # places that are tried at full size, for each beacon
LEAST_F = 6.0  # of the test of a cell
STRIP = 64  # rows of cells at a time, so that the sums stay in the cache
APERTURE = 2  # px around a place
RING = (5, 8)  # px, the light around it
ECHO = 20.0  # px: the side of a block of chroma at half resolution is 16
STARTS_S = 0.010  # s between the starts that are tried
RIVALS_HZ = 0.4  # between the other rates that are tried
TOO_NEAR_HZ = 0.7  # another rate that is so near cannot be told apart within seconds


@dataclass(frozen=True, slots=True)
class Place:
    """A pixel that follows a beacon's wave."""

    u: float
    v: float
    lock: Lock


def halved(image: Image) -> Image:
    """The image in cells of 2 x 2 pixels, an odd last row or column left out."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.asarray(
        cv2.resize(image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8
    )


def search(
    frames: Sequence[Image],
    cells: Sequence[Image],
    t: Floats,
    waves: Mapping[str, Wave],
    *,
    row_time: float,
    false_alarm: float,
) -> dict[str, list[Place]]:
    """Places that follow each beacon's wave, best first.

    Parameters
    ----------
    frames, cells : sequences of N images (H, W) and (H // 2, W // 2), uint8
        As taken, and `halved`.
    t : (N,) array
        When the exposure of each first row began, seconds.
    waves : mapping of str to Wave
        By the beacons' names.
    row_time : float
        Seconds from one row to the next.
    false_alarm : float
        Probability that noise passes anywhere in the picture.
    """
    found: dict[str, list[Place]] = {name: [] for name in waves}
    if len(t) < 10:
        return found
    log_level = np.log(false_alarm / frames[0].size)
    for name, places in _candidates(cells, t, waves).items():
        for u, v in places:
            place = _tried(frames, t, waves[name], u, v, row_time, log_level)
            if place is not None:
                found[name].append(place)
        found[name] = _apart(found[name])
    return found


def _candidates(cells: Sequence[Image], t: Floats, waves: Mapping[str, Wave]) -> dict[str, list[tuple[int, int]]]:
    """The pixels (u, v) in the middle of the cells that follow each rate best."""
    n, (rows, columns) = len(t), cells[0].shape
    time = t - t.mean()
    terms = [np.ones(n), time / max(float(np.abs(time).max()), 1e-9)]
    for wave in waves.values():
        terms += [np.cos(2.0 * np.pi * wave.hz * time), np.sin(2.0 * np.pi * wave.hz * time)]
    basis = np.stack(terms)
    inverse = np.linalg.pinv(basis @ basis.T)
    solve = (inverse @ basis).astype(np.float32)
    freedom = n - len(basis)
    scores = {name: np.zeros((rows, columns), np.float32) for name in waves}
    quadratic = [np.linalg.inv(inverse[2 + 2 * k : 4 + 2 * k, 2 + 2 * k : 4 + 2 * k]) for k in range(len(waves))]
    for top in range(0, rows, STRIP):
        y = np.stack([cell[top : top + STRIP].ravel() for cell in cells]).astype(np.float32)
        y -= y.mean(axis=0)
        fit = solve @ y
        rest = np.einsum("ij,ij->j", y, y) - np.einsum("ij,ij->j", basis.astype(np.float32) @ y, fit)
        noise = np.maximum(rest, 0.0) / freedom + 0.1  # grey levels squared: what rounding alone leaves
        for k, name in enumerate(waves):
            c, s = fit[2 + 2 * k], fit[3 + 2 * k]
            q = quadratic[k]
            power = q[0, 0] * c * c + 2.0 * q[0, 1] * c * s + q[1, 1] * s * s
            scores[name][top : top + STRIP] = (0.5 * power / noise).reshape(-1, columns)
    found = {}
    for name, score in scores.items():
        peak = (score >= cv2.dilate(score, np.ones((3, 3), np.uint8))) & (score > LEAST_F)
        v, u = np.nonzero(peak)
        best = np.argsort(-score[v, u])[:MOST]
        found[name] = [(int(2 * u[k]), int(2 * v[k])) for k in best]
    return found


def _tried(
    frames: Sequence[Image], t: Floats, wave: Wave, u: int, v: int, row_time: float, log_level: float
) -> Place | None:
    """The place if it passes at full size."""
    height, width = frames[0].shape
    reach = RING[1] + 1
    if not (reach <= u < width - reach and reach <= v < height - reach):
        return None
    crops = np.stack([frame[v - reach : v + reach + 1, u - reach : u + reach + 1] for frame in frames])
    kept = undisturbed(crops)
    series = aperture_series(crops[kept].astype(np.float32), reach, reach)
    begun = t[kept] + row_time * v
    starts = np.arange(0.0, 1.0 / wave.hz, STARTS_S)
    found = lock(series, begun, wave, starts)
    if found.log_p > log_level or found.amplitude <= 0.0:
        return None
    if _fits_another_rate(series, begun, wave, found):
        return None
    return Place(float(u), float(v), found)


def aperture_series(crops: NDArray[np.float32], u: int, v: int) -> Floats:
    """(N,) mean over an aperture of (N, K, K) crops around a pixel, less the median of the ring around it."""
    yy, xx = np.mgrid[0 : crops.shape[1], 0 : crops.shape[2]]
    far = np.maximum(np.abs(yy - v), np.abs(xx - u))
    inner = crops[:, far <= APERTURE].mean(axis=1)
    ring = np.median(crops[:, (far >= RING[0]) & (far <= RING[1])], axis=1)
    return np.asarray(inner - ring, np.float64)


def _fits_another_rate(series: Floats, t: Floats, wave: Wave, found: Lock) -> bool:
    """Whether a sine at some other rate explains clearly more than a sine at the wave's own."""
    fastest = 0.5 * (len(t) - 1) / float(t[-1] - t[0])
    rates = np.arange(RIVALS_HZ, max(fastest, wave.hz + 1.0), RIVALS_HZ)
    rates = rates[np.abs(rates - wave.hz) > TOO_NEAR_HZ]
    own = _sine_share(series, t, np.array([wave.hz]))[0]
    return bool(_sine_share(series, t, rates).max(initial=0.0) > max(own, found.share))


def _sine_share(series: Floats, t: Floats, rates: Floats) -> Floats:
    """(R,) shares of the series' variance that sines at these rates explain (Lomb's periodogram)."""
    y = series - series.mean()
    total = max(float(y @ y), 1e-12)
    time = t - t.mean()
    shares = []
    for rate in rates:
        basis = np.stack([np.ones_like(time), np.cos(2.0 * np.pi * rate * time), np.sin(2.0 * np.pi * rate * time)])
        fit, *_ = np.linalg.lstsq(basis.T, y, rcond=None)
        shares.append(1.0 - float(np.sum((y - fit @ basis) ** 2)) / total)
    return np.array(shares)


def _apart(places: list[Place]) -> list[Place]:
    """The brightest of those that stand together: JPEG echoes a light all over its block of chroma, in perfect step."""
    kept: list[Place] = []
    for place in sorted(places, key=lambda place: -place.lock.amplitude):
        if all(max(abs(place.u - other.u), abs(place.v - other.v)) > ECHO for other in kept):
            kept.append(place)
    return sorted(kept, key=lambda place: place.lock.log_p)
