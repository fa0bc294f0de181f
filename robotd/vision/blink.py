"""Find lights that flash in a known pattern, in one camera, as the frames arrive.

A label's light is a spot of about one pixel sigma, a few grey levels to white, that follows a pattern of known period
from an unknown start and for an unknown number of periods. Three steps of rising cost find it:

1. Every frame: 2x2 cells are kept in a ring of some seconds. With D(t) the change of a 4x4 aperture over a lag of half
   a flash interval, -D(t) D(t - lag) is added up. It is positive where brightness goes up and down in the pattern's
   own rhythm, and averages out under noise, slower or faster blinking and passing people.
2. Every half second: apertures in which that sum stands out from their neighbourhood (constant false alarm rate).
3. Only there: the aperture-minus-ring light curve is compared with every start and number of periods, by a generalised
   likelihood ratio against noise and against steady blinking at other rates.

What passes becomes a track, whose amplitude image grows with every further period and is fitted when asked for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..records import Flash
from .pattern import FlashPattern, Template
from .spot import Spot, fit_spot, grey_difference, light_table

try:
    from . import _blink as kernels
except ImportError:  # built without extensions
    from . import blink_reference as kernels  # type: ignore[no-redef]

__all__ = ["FLOOR_PX", "FlashConfig", "FlashDetector", "FlashPattern", "Track", "kernels"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

_RING = 96  # frames kept; at 320x240 cells of 2 bytes 14.7 MB
_BLOCK = 32  # frames whose alternation fits into 16 bits: 32 * 63 * 63 / 4 < 2^15
_TILE = (24, 32)  # cells over which the false alarm rate is held constant
_BEFORE, _AFTER = 3, 5  # cells around an aperture's first one that its ring needs: 8x8 in all
_STARTS_PER_SECOND = 50  # grid of possible starts; half a step is 10 ms of a 100 ms flash
FLOOR_PX = 0.01  # what fits keep in bias however strong the light: sampling, texture, the camera's curve
_SEPARATION = 3  # cells; nearer lights are one light


@dataclass(frozen=True, slots=True)
class FlashConfig:
    """Settings of the flash detector."""

    pattern: FlashPattern = field(default_factory=FlashPattern)
    window_s: float = ranged(3.2, minimum=1.0, maximum=30.0, doc="light curves are compared over so long")
    decision_s: float = ranged(0.5, minimum=0.1, maximum=5.0, doc="time between decisions")
    exposure_s: float = ranged(0.010, minimum=0.0, maximum=0.2, doc="exposure time of the camera")
    row_time_s: float = ranged(0.0, minimum=0.0, maximum=0.001, doc="time from one row's exposure to the next one's")
    gamma: float = ranged(2.2, minimum=0.3, maximum=4.0, doc="grey = light^(1/gamma); 1 for a linear camera")
    min_alternation: float = ranged(5.5, minimum=1.0, doc="step 2: standard deviations above the neighbourhood")
    min_score: float = ranged(20.0, minimum=1.0, doc="step 3: log-likelihood ratio against noise")
    min_margin: float = ranged(5.0, minimum=0.0, doc="step 3: log-likelihood ratio against steady blinking")
    max_width_px: float = ranged(2.5, minimum=0.5, doc="a light is no wider (sigma) than this")
    max_sigma_px: float = ranged(0.2, minimum=0.01, doc="nor is its position less certain")
    steady_hz: tuple[float, ...] = (1.0, 2.0, 5.0, 8.0, 10.0)
    max_candidates: int = ranged(96, minimum=1, maximum=2000, doc="apertures examined at one decision")


@dataclass(slots=True, eq=False)
class Track:
    """A light that was accepted: the aperture's first cell, its light curve's best match and its growing image."""

    row: int
    column: int
    score: float
    start: float  # of the best match, seconds
    light: float  # summed linear light over the aperture when on
    variance: float  # of the light curve about the match
    last: float = -np.inf  # time up to which frames are in the sums
    numerator: Floats = field(default_factory=lambda: np.zeros((8, 8)))
    squares: Floats = field(default_factory=lambda: np.zeros((8, 8)))
    weight: float = 0.0
    dof: int = 0
    clipped: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((8, 8), bool))
    base: float = 0.0
    spot: Spot | None = None
    fitted: float = -1.0


@dataclass(slots=True, eq=False)
class _Matches:
    """Best match of each light curve: arrays over candidates."""

    score: Floats
    margin: Floats
    start: Floats
    periods: Indices
    light: Floats
    variance: Floats
    regular: NDArray[np.bool_]


class FlashDetector:
    """Streaming detector of flashing lights in one camera that stands still.

    Feed frames in the order of their time stamps; stamps may be irregular and frames may be missing. Frames that come
    faster than 1.7 times the ring's rate (96 frames a window) are thinned.
    """

    def __init__(self, config: FlashConfig | None = None) -> None:
        self.config = config or FlashConfig()
        self._light = light_table(self.config.gamma, 1021)
        self._lag = self.config.pattern.lag
        self._template = Template(self.config.pattern, self.config.exposure_s)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.tracks: list[Track] = []
        self._ring: NDArray[np.uint16] | None = None
        self._times: deque[tuple[int, float]] = deque(maxlen=_RING)  # number of the frame, its time
        self._blocks: deque[tuple[int, NDArray[np.int16]]] = deque()
        self._count = 0
        self._block_frames = 0
        self._decided = -np.inf

    def update(self, frame: NDArray[np.uint8], t: float) -> bool:
        """Take one frame.

        Parameters
        ----------
        frame : (H, W) uint8 array
            Grey image; every frame of a stream has the same size.
        t : float
            Start of the first row's exposure in seconds, later than the frame before.

        Returns
        -------
        bool
            True if this frame led to a decision, so that `tracks` may have changed.
        """
        if frame.ndim != 2 or frame.dtype != np.uint8 or min(frame.shape) < 32:
            raise ValueError(f"expected a grey (H, W) uint8 image of 32x32 or more, got {frame.dtype} {frame.shape}")
        cells_shape = (frame.shape[0] // 2, frame.shape[1] // 2)
        if self._ring is None:
            self._allocate(cells_shape, t)
        assert self._ring is not None
        if self._ring.shape[1:] != cells_shape:
            raise ValueError(f"the image size changed within a stream, to {frame.shape}; call reset() first")
        if self._times:
            if t <= self._times[-1][1]:
                raise ValueError(f"time stamps must increase: {t} came after {self._times[-1][1]}")
            if t - self._times[-1][1] < 0.6 * self.config.window_s / _RING:
                return False
        self._accumulate(np.ascontiguousarray(frame), t)
        if t - self._decided < self.config.decision_s and self._block_frames < _BLOCK:
            return False
        self._decide(t)
        return True

    def detect(self, frames: Iterable[NDArray[np.uint8]], times: Sequence[float] | Floats) -> list[Flash]:
        """Reset, take a whole sequence of frames with increasing times in seconds, and return `flashes()`."""
        self.reset()
        for frame, t in zip(frames, times, strict=True):
            self.update(frame, float(t))
        if self._block_frames:
            self._decide(float(times[-1]))
        return self.flashes()

    def flashes(self) -> list[Flash]:
        """Every light accepted so far, best first."""
        found = []
        for track in self.tracks:
            spot = self.spot(track)
            if spot is None:
                continue
            found.append(
                Flash(
                    u=spot.u,
                    v=spot.v,
                    sigma=float(np.hypot(spot.sigma, FLOOR_PX)),
                    score=track.score,
                    phase=(track.start + spot.v * self.config.row_time_s) % self.config.pattern.period,
                    amplitude=grey_difference(track.base, spot.peak, self.config.gamma),
                    saturated=bool(track.clipped.any()),
                )
            )
        return sorted(found, key=lambda flash: -flash.score)

    def light_curves(self, rows: Indices, columns: Indices, since: float = -np.inf) -> tuple[Floats, Singles, Singles]:
        """Light of apertures over the frames in the ring.

        Parameters
        ----------
        rows, columns : (N,) intp arrays
            First cell of each aperture (`Track.row`, `Track.column`).
        since : float
            Leave out frames before this time.

        Returns
        -------
        times (F,), values (N, F), levels (N, F)
            Exposure starts of the first image row in seconds; linear light of the aperture minus that of the ring
            around it; linear light of the ring per cell.
        """
        assert self._ring is not None
        numbers = np.array([number for number, _ in self._times], np.intp)
        times = np.array([t for _, t in self._times])
        recent = times > max(since, times[-1] - self.config.window_s)
        numbers, times = numbers[recent], times[recent]
        values = np.empty((len(rows), len(times)), np.float32)
        levels = np.empty_like(values)
        if len(rows):
            kernels.aperture_series(self._ring, numbers % _RING, rows, columns, self._light, values, levels)
        return times, values, levels

    # ---- each frame --------------------------------------------------------------------------------------------------

    def _allocate(self, shape: tuple[int, int], t: float) -> None:
        self._ring = np.zeros((_RING, *shape), np.uint16)
        depth = int(np.ceil(1.7 * self._lag * _RING / self.config.window_s)) + 2
        self._differences = np.zeros((depth, *shape), np.int8)
        self._total = np.zeros(shape, np.int16)
        self._window = np.zeros(shape, np.int32)  # sum of the blocks
        self._decided = t

    def _accumulate(self, frame: NDArray[np.uint8], t: float) -> None:
        assert self._ring is not None
        cells = self._ring[self._count % _RING]
        lagged = self._lagged(t)
        depth = len(self._differences)
        difference = self._differences[self._count % depth]
        if lagged is None:
            kernels.sum_cells(frame, cells)
            difference[:] = 0
        else:
            kernels.accumulate(
                frame, cells, self._ring[lagged % _RING], difference, self._differences[lagged % depth], self._total
            )
        self._times.append((self._count, t))
        self._count += 1
        self._block_frames += 1

    def _lagged(self, t: float) -> int | None:
        """Number of the frame one lag ago; None if none is near enough to that time."""
        lag = self._lag
        best, error = None, 0.5 * lag
        for number, then in reversed(self._times):
            if number <= self._count - len(self._differences):
                break
            if abs(t - then - lag) < error:
                best, error = number, abs(t - then - lag)
            if t - then > 1.5 * lag:
                break
        return best

    # ---- each decision -----------------------------------------------------------------------------------------------

    def _decide(self, t: float) -> None:
        self._blocks.append((self._block_frames, self._total))
        self._window += self._total
        self._total = np.zeros_like(self._total)
        self._block_frames = 0
        self._decided = t
        while len(self._blocks) * self.config.decision_s > self.config.window_s + self.config.decision_s / 2:
            self._window -= self._blocks.popleft()[1]
        if t - self._times[0][1] < 1.4 * self.config.pattern.period:
            return
        rows, columns = self._candidates()
        known = len(self.tracks)
        rows = np.concatenate([np.array([track.row for track in self.tracks], np.intp), rows])
        columns = np.concatenate([np.array([track.column for track in self.tracks], np.intp), columns])
        if not len(rows):
            return
        times, values, _ = self.light_curves(rows, columns)
        matches = self._match(times, values)
        accepted = (
            (matches.score >= self.config.min_score)
            & (matches.margin >= self.config.min_margin)
            & matches.regular
            & (matches.light > 0.0)
        )
        for k in range(known):
            if accepted[k]:
                self._extend(self.tracks[k], k, matches, t)
        fresh = [k for k in np.argsort(-matches.light) if k >= known and accepted[k]]
        for k in fresh:
            self._add(int(rows[k]), int(columns[k]), int(k), matches, t)

    def _candidates(self) -> tuple[Indices, Indices]:
        """Apertures whose alternation stands out, strongest first."""
        frames = sum(count for count, _ in self._blocks)
        total = self._window.astype(np.float32)
        height, width = total.shape
        tiles = max(1, height // _TILE[0]), max(1, width // _TILE[1])
        size = height // tiles[0], width // tiles[1]
        blocks = total[: tiles[0] * size[0], : tiles[1] * size[1]].reshape(tiles[0], size[0], tiles[1], size[1])
        sample = blocks[:, 1::4, :, 1::4].transpose(0, 2, 1, 3).reshape(*tiles, -1)
        half = sample.shape[2] // 2
        middle = np.partition(sample, half, axis=2)[:, :, half]
        deviation = np.partition(np.abs(sample - middle[:, :, None]), half, axis=2)[:, :, half]
        spread = 1.48 * deviation + 2.0 * np.sqrt(frames)
        of_row = np.minimum(np.arange(height) // size[0], tiles[0] - 1)
        of_column = np.minimum(np.arange(width) // size[1], tiles[1] - 1)
        limit = (middle + self.config.min_alternation * spread).astype(np.float32)[of_row[:, None], of_column]
        over = np.where(total > limit, total, np.float32(0.0))
        over[:_BEFORE] = over[-_AFTER:] = 0.0
        over[:, :_BEFORE] = over[:, -_AFTER:] = 0.0
        peaks = np.flatnonzero((over > 0.0) & (over >= cv2.dilate(over, np.ones((3, 3), np.uint8))))
        flat = over.ravel()
        peaks = peaks[np.argsort(-flat[peaks], kind="stable")][: self.config.max_candidates]
        rows, columns = np.divmod(peaks, width)
        if self.tracks:
            places = np.array([(track.row, track.column) for track in self.tracks])
            apart = np.hypot(places[:, 0] - rows[:, None], places[:, 1] - columns[:, None])
            free = apart.min(axis=1) > _SEPARATION
            rows, columns = rows[free], columns[free]
        return np.ascontiguousarray(rows), np.ascontiguousarray(columns)

    def _match(self, times: Floats, values: Singles) -> _Matches:
        """Best start and number of periods of each light curve (N, F), and how much better than the alternatives."""
        period = self.config.pattern.period
        step = round(_STARTS_PER_SECOND * period)
        pitch = period / step
        starts = times[0] - period + np.arange(int((times[-1] - times[0] + period) / pitch) + 1) * pitch
        single = self._template(times[None, :] - starts[:, None])
        y = values - values.mean(axis=1, keepdims=True)
        frames, places = len(times), len(y)
        energy = np.einsum("nf,nf->n", y, y).astype(float) + 1e-6
        projection = y @ single.T
        sums = single.sum(axis=1)
        squares = np.einsum("gf,gf->g", single, single)
        gain, light = np.empty(places, np.float32), np.empty(places, np.float32)
        start, periods = np.empty(places, np.intp), np.empty(places, np.intp)
        kernels.best_runs(projection, sums, squares, step, frames, 0.01 * frames, gain, start, periods, light)
        residual = np.maximum(energy - gain, 1e-6)
        return _Matches(
            score=0.5 * frames * np.log(energy / residual),
            margin=0.5 * frames * np.log(self._steady_residual(times, y, energy) / residual),
            start=starts[start],
            periods=periods,
            light=light.astype(float),
            variance=residual / frames,
            regular=self._is_regular(projection, squares, start, periods, light, step),
        )

    def _steady_residual(self, times: Floats, y: Singles, energy: Floats) -> Floats:
        """What the best steady blinking (a sine with its third harmonic) leaves of each light curve's energy."""
        least = energy
        angle = 2.0 * np.pi * (times - times[0])
        for hertz in self.config.steady_hz:
            waves = np.stack([wave(k * hertz * angle) for k in (1, 3) for wave in (np.cos, np.sin)])
            basis, upper = np.linalg.qr((waves - waves.mean(axis=1, keepdims=True)).T)
            basis = basis[:, np.abs(np.diag(upper)) > 1e-3 * len(times)]  # aliases of one another at this frame rate
            least = np.minimum(least, energy - np.sum((y @ basis) ** 2, axis=1))
        return np.maximum(least, 1e-6)

    @staticmethod
    def _is_regular(
        projection: Singles, squares: Singles, start: Indices, periods: Indices, light: Singles, step: int
    ) -> NDArray[np.bool_]:
        """Two periods or more must each carry their share: one burst of clutter is no pattern."""
        enough = 0.3 * squares.max()
        carrying, missing = np.zeros(len(start), int), np.zeros(len(start), int)
        for k in range(int(periods.max())):
            index = np.minimum(start + k * step, len(squares) - 1)
            counted = (k < periods) & (squares[index] >= enough)
            share = projection[np.arange(len(start)), index] / np.maximum(squares[index], 1e-6)
            carrying += counted & (share >= 0.4 * light)
            missing += counted & (share < 0.2 * light)
        return np.asarray((carrying >= 2) & (missing == 0))

    # ---- tracks ------------------------------------------------------------------------------------------------------

    def _add(self, row: int, column: int, k: int, matches: _Matches, t: float) -> None:
        """Start a track on the aperture that is centred best on the light, unless it has a track already."""
        track = self._track(row, column, k, matches, t)
        image = track.numerator[1:7, 1:7]
        sums = image[:-1, :-1] + image[1:, :-1] + image[:-1, 1:] + image[1:, 1:]
        down, right = divmod(int(np.argmax(sums)), 5)
        if (down, right) != (2, 2):
            row, column = row + down - 2, column + right - 2
            if not self._is_inside(row, column):
                return
            track = self._track(row, column, k, matches, t)
        if self.spot(track) is None:
            return
        places = np.array([(track.row, track.column) for track in self.tracks]).reshape(-1, 2)
        if not len(places) or np.min(np.hypot(places[:, 0] - row, places[:, 1] - column)) > _SEPARATION:
            self.tracks.append(track)

    def _track(self, row: int, column: int, k: int, matches: _Matches, t: float) -> Track:
        start = float(matches.start[k])
        track = Track(row, column, float(matches.score[k]), start, float(matches.light[k]), float(matches.variance[k]))
        self._grow(track, start, int(matches.periods[k]), t)
        return track

    def _is_inside(self, row: int, column: int) -> bool:
        assert self._ring is not None
        height, width = map(int, self._ring.shape[1:])
        return _BEFORE <= row <= height - _AFTER and _BEFORE <= column <= width - _AFTER

    def _extend(self, track: Track, k: int, matches: _Matches, t: float) -> None:
        if matches.score[k] > track.score:
            track.score = float(matches.score[k])
            track.start = float(matches.start[k])
            track.light = float(matches.light[k])
            track.variance = float(matches.variance[k])
        if t - track.last >= 2.0 * self.config.pattern.period:
            self._grow(track, float(matches.start[k]), int(matches.periods[k]), t)

    def _grow(self, track: Track, start: float, periods: int, t: float) -> None:
        """Add the frames since `track.last` to the amplitude image: per cell the regression of light on the pattern."""
        assert self._ring is not None
        numbers = np.array([number for number, then in self._times if then > max(track.last, t - self.config.window_s)])
        times = np.array([then for _, then in self._times if then > max(track.last, t - self.config.window_s)])
        pattern = self.config.pattern.coverage(times - start, self.config.exposure_s, periods)
        wave = pattern - pattern.mean()
        weight = float(wave @ wave)
        if weight < 2.0:
            return
        rows = slice(track.row - _BEFORE, track.row + _AFTER)
        columns = slice(track.column - _BEFORE, track.column + _AFTER)
        cells = self._ring[numbers % _RING, rows, columns]
        light = self._light[cells].astype(float)
        mean = light.mean(axis=0)
        numerator = np.tensordot(wave, light, 1)
        track.numerator += numerator
        track.squares += ((light - mean) ** 2).sum(axis=0) - numerator**2 / weight
        track.weight += weight
        track.dof += len(times) - 2
        track.clipped |= (cells >= 985).any(axis=0)  # four pixels of which none is far from white
        track.base = float(np.median(mean))
        track.last = t

    def spot(self, track: Track) -> Spot | None:
        """Where a track's light is, in pixels; None if its image is not that of a small light, as people leave it."""
        if track.fitted != track.last:
            variance = track.squares / max(track.dof, 1) / max(track.weight, 1e-9)
            variance = np.maximum(variance, 0.1 * float(np.median(variance)) + 1e-9)
            spot = fit_spot(track.numerator / max(track.weight, 1e-9), variance, ~track.clipped, pitch=2)
            if spot is not None:
                u, v = spot.u + 2.0 * (track.column - _BEFORE), spot.v + 2.0 * (track.row - _BEFORE)
                small = spot.sigma <= self.config.max_sigma_px and spot.width <= self.config.max_width_px
                spot = replace(spot, u=u, v=v) if small else None
            track.spot = spot
            track.fitted = track.last
        return track.spot
