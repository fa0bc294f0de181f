"""Find lights that flash in a known pattern, in one camera, as the frames arrive.

A label's light is a spot of about one pixel sigma, a few grey levels to white, that follows a pattern of known period
from an unknown start and for an unknown number of periods. Three steps of rising cost find it:

1. Every frame: 2x2 cells are kept in a ring of some seconds. With D(t) the change of a 4x4 aperture over a lag of half
   a flash interval, less what the camera's own shaking explains, -D(t) D(t - lag) is added up. It is positive where
   brightness goes up and down in the pattern's own rhythm, and averages out under noise, slower or faster blinking and
   passing people.
2. Every half second: apertures in which that sum stands out from their neighbourhood (constant false alarm rate).
3. Only there: the aperture-minus-ring light curve is compared with every start and number of periods (`matching`).
   That is a sequential test: it is repeated as frames arrive and decides as soon as its likelihood ratio passes the
   bound that keeps the false alarms of noise below a stated number per hour (Wald's bound, over all tests made).

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
from .matching import Matcher, Matches
from .mirror import Lamp, reflected
from .pattern import FlashPattern
from .shake import Shake
from .spot import Spot, fit_spot, grey_difference, light_table

try:
    from . import _blink as kernels
except ImportError:  # built without extensions
    from . import blink_reference as kernels  # type: ignore[no-redef]

__all__ = ["FLOOR_PX", "FlashConfig", "FlashDetector", "FlashPattern", "Track", "kernels"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

_RING = 96  # frames kept; at 328x248 cells of 2 bytes 15.6 MB
_FEW = 4  # frames since the last decision that are not worth another one
_BLOCK = 32  # frames whose alternation fits into 16 bits: 32 * 63 * 63 / 4 < 2^15
_LOW, _HIGH = 4.0, 1500.0  # a block's alternation counts no further than so many typical ones below, and this above
_CLEAR = 1.8  # limits from which a place is clear enough to be examined at every decision
_NO_SPOT = 12.0  # refusals that a place counts which follows the pattern but is no small light: it costs most
_FORGET = 0.8  # of a place's refusals, from one decision to the next
_TILE = (24, 32)  # cells over which the false alarm rate is held constant
_BEFORE, _AFTER = 3, 5  # cells around an aperture's first one that its ring needs: 8x8 in all
_LONGER = 2.5  # a slow camera's light curves are so much longer than `window_s`, because they have fewer frames
_SHAKEN_PX = 1.5  # a picture that is further off is not compared
_STALE_PX = 0.6  # a camera that stays so far off its reference gets another one
_TESTS_APART = 4  # apertures, and starts per flash, that are about one independent test
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
    min_alternation: float = ranged(3.0, minimum=1.0, doc="step 2: standard deviations above the neighbourhood")
    false_alarms_per_hour: float = ranged(1.0, minimum=1e-6, maximum=1e6, doc="step 3: of noise alone, at most")
    min_margin: float = ranged(5.0, minimum=0.0, doc="step 3: log-likelihood ratio against steady blinking")
    max_width_px: float = ranged(2.5, minimum=0.5, doc="a light is no wider (sigma) than this")
    max_sigma_px: float = ranged(0.2, minimum=0.01, doc="nor is its position less certain")
    steady_hz: tuple[float, ...] = (1.0, 2.0, 5.0, 8.0, 10.0)
    max_candidates: int = ranged(72, minimum=1, maximum=2000, doc="apertures examined at one decision")
    max_reflection: float = ranged(0.65, minimum=0.0, maximum=1.0, doc="likelier reflections are not reported")

    def min_score(self, shape: tuple[int, int]) -> float:
        """Log-likelihood ratio from which a light is accepted in images of this shape (H, W)."""
        shortest = min(end - start for start, end in self.pattern.on)
        apertures = shape[0] * shape[1] / 4.0 / _TESTS_APART
        starts = _TESTS_APART * self.pattern.period / shortest
        decisions = 3600.0 / self.window_s
        return float(np.log(max(apertures * starts * decisions / self.false_alarms_per_hour, np.e)))


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
    looks: list[tuple[float, float, float]] = field(default_factory=list)  # time, start of the pattern, its sigma
    shift: Floats = field(default_factory=lambda: np.zeros(2))  # of the picture while the light was on, weighted
    spot: Spot | None = None
    fitted: float = -1.0


class FlashDetector:
    """Streaming detector of flashing lights in one camera that stands still, or shakes by a pixel.

    Feed frames in the order of their time stamps; stamps may be irregular and frames may be missing. Frames that come
    faster than 1.7 times the ring's rate (96 frames a window) are thinned.
    """

    def __init__(self, config: FlashConfig | None = None) -> None:
        self.config = config or FlashConfig()
        self._light = light_table(self.config.gamma, 1021)
        self._lag = self.config.pattern.lag
        self._matcher = Matcher(self.config.pattern, self.config.exposure_s, self.config.steady_hz)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.tracks: list[Track] = []
        self._ring: NDArray[np.uint16] | None = None
        self._times: deque[tuple[int, float]] = deque(maxlen=_RING)  # number of the frame, its time
        self._shifts = np.zeros((_RING, 2))
        self._shift_sum = np.zeros(2)  # places are given where they are in the mean picture
        self._shake = Shake(_BEFORE)
        self._blocks: deque[tuple[int, NDArray[np.int16], np.int16]] = deque()  # frames, sums, lower limit
        self._count = 0
        self._block_frames = 0
        self._due = -np.inf

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
        if self._total.shape != cells_shape:
            raise ValueError(f"the image size changed within a stream, to {frame.shape}; call reset() first")
        if self._times:
            if t <= self._times[-1][1]:
                raise ValueError(f"time stamps must increase: {t} came after {self._times[-1][1]}")
            if t - self._times[-1][1] < 0.6 * self.config.window_s / _RING:
                return False
        frame = np.ascontiguousarray(frame)
        self._accumulate(frame, t)
        if t < self._due and self._block_frames < _BLOCK:
            return False
        self._decide(t)
        self._due = t + self.config.decision_s - 0.5 * self._pace()  # because a frame late every time adds up
        self._keep_reference(frame)
        return True

    def detect(self, frames: Iterable[NDArray[np.uint8]], times: Sequence[float] | Floats) -> list[Flash]:
        """Reset, take a whole sequence of frames with increasing times in seconds, and return `flashes()`."""
        self.reset()
        for frame, t in zip(frames, times, strict=True):
            self.update(frame, float(t))
        return self.flashes()

    def flashes(self) -> list[Flash]:
        """Every light accepted so far, best first; what has come since the last decision is decided on."""
        if self._block_frames >= _FEW or (self._block_frames and not self.tracks):
            self._decide(self._times[-1][1])
        seen = [(track, spot) for track in self.tracks if (spot := self.spot(track)) is not None]
        lamps = [Lamp(np.array(track.looks), spot.peak, spot.width, spot.u, spot.v) for track, spot in seen]
        config = self.config
        found = []
        for (track, spot), reflection in zip(seen, reflected(lamps, config.pattern.period), strict=True):
            if reflection > config.max_reflection:
                continue
            (uu, uv), (_, vv) = spot.covariance + FLOOR_PX**2 * np.eye(2)
            found.append(
                Flash(
                    u=spot.u,
                    v=spot.v,
                    sigma=float(np.sqrt(0.5 * (uu + vv))),
                    score=track.score,
                    phase=(track.start + spot.v * config.row_time_s) % config.pattern.period,
                    amplitude=grey_difference(track.base, spot.peak, config.gamma),
                    saturated=bool(track.clipped.any()),
                    covariance=(float(uu), float(uv), float(vv)),
                    reflection=float(reflection),
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
        numbers, times = self._recent(since)
        return times, *self._curves(numbers, rows, columns)

    def _recent(self, since: float = -np.inf) -> tuple[Indices, Floats]:
        """Numbers and times of the frames after `since` within the window."""
        numbers = np.array([number for number, _ in self._times], np.intp)
        times = np.array([t for _, t in self._times])
        chosen = times > max(since, times[-1] - self._window_s())
        return numbers[chosen], times[chosen]

    def _curves(self, numbers: Indices, rows: Indices, columns: Indices) -> tuple[Singles, Singles]:
        assert self._ring is not None
        values = np.empty((len(rows), len(numbers)), np.float32)
        levels = np.empty_like(values)
        if len(rows):
            kernels.aperture_series(
                self._ring, numbers % _RING, rows + _BEFORE, columns + _BEFORE, self._light, values, levels
            )
        return values, levels

    def _window_s(self) -> float:
        """Length of the light curves in seconds: what the ring holds, within limits."""
        return float(np.clip(0.9 * _RING * self._pace(), self.config.window_s, _LONGER * self.config.window_s))

    def _pace(self) -> float:
        """Mean time between the frames in the ring."""
        return (self._times[-1][1] - self._times[0][1]) / max(len(self._times) - 1, 1)

    # ---- each frame --------------------------------------------------------------------------------------------------

    def _allocate(self, shape: tuple[int, int], t: float) -> None:
        around = _BEFORE + _AFTER
        self._ring = np.zeros((_RING, shape[0] + around, shape[1] + around), np.uint16)
        depth = int(np.ceil(1.7 * self._lag * _RING / self.config.window_s)) + 2
        self._differences = np.zeros((depth, *shape), np.int8)
        self._total = np.zeros(shape, np.int16)
        self._window = np.zeros(shape, np.int32)  # sum of the blocks
        self._clipped = np.zeros(shape, np.int32)  # the same, each limited
        self._refused = np.zeros(shape, np.float32)  # how often a place was examined in vain, of late
        self._due = t + self.config.decision_s

    def _accumulate(self, frame: NDArray[np.uint8], t: float) -> None:
        assert self._ring is not None
        now = self._count % _RING
        cells = self._ring[now]
        kernels.sum_cells(frame, cells, _BEFORE, _AFTER)
        if not self._count:
            self._shake.refer(frame, np.zeros(2))
        self._shifts[now] = self._shake.measure(cells)
        self._shift_sum += self._shifts[now]
        lagged = self._lagged(t)
        depth = len(self._differences)
        difference = self._differences[self._count % depth]
        move = np.zeros(2) if lagged is None else self._shifts[now] - self._shifts[lagged % _RING]
        if lagged is None or np.abs(move).max() > _SHAKEN_PX:
            difference[:] = 0
        else:
            right, down = np.rint(256.0 * move).astype(int)
            kernels.accumulate(
                cells,
                self._ring[lagged % _RING],
                self._shake.down,
                self._shake.right,
                down,
                right,
                difference,
                self._differences[lagged % depth],
                self._total,
                _BEFORE,
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
        # because who passes by weighs more in one block than a label in all others
        usual = float(np.median(np.abs(self._total[1::4, 1::4]))) + 1.0
        low = np.int16(-min(_LOW * usual, _HIGH))
        self._blocks.append((self._block_frames, self._total, low))
        self._window += self._total
        self._clipped += np.clip(self._total, low, np.int16(_HIGH))
        self._total = np.zeros_like(self._total)
        self._block_frames = 0
        while sum(block[0] for block in self._blocks) * self._pace() > self._window_s() + self.config.decision_s:
            _, gone, low = self._blocks.popleft()
            self._window -= gone
            self._clipped -= np.clip(gone, low, np.int16(_HIGH))
        if t - self._times[0][1] < 1.4 * self.config.pattern.period:
            return
        rows, columns = self._candidates()
        due = [track for track in self.tracks if t - track.last >= 2.0 * self.config.pattern.period]
        known = len(due)
        rows = np.concatenate([np.array([track.row for track in due], np.intp), rows])
        columns = np.concatenate([np.array([track.column for track in due], np.intp), columns])
        if not len(rows):
            return
        numbers, times = self._recent()
        values, levels = self._curves(numbers, rows, columns)
        matches = self._matcher.match(times, values, levels, self._shifts[numbers % _RING])
        least = self.config.min_score((2 * self._total.shape[0], 2 * self._total.shape[1]))
        accepted = (
            (matches.score >= least)
            & (matches.margin >= self.config.min_margin)
            & matches.regular
            & (matches.light > 0.0)
        )
        for k in range(known):
            if accepted[k]:
                self._extend(due[k], k, matches, t)
        self._refused *= _FORGET
        in_vain = np.flatnonzero(matches.score[known:] < 0.5 * least) + known
        self._refused[rows[in_vain], columns[in_vain]] += 1.0
        fresh = [k for k in np.argsort(-matches.light) if k >= known and accepted[k]]
        for k in fresh:
            self._add(int(rows[k]), int(columns[k]), int(k), matches, t)

    def _keep_reference(self, frame: NDArray[np.uint8]) -> None:
        """Refer to the latest picture if the camera has settled away from the last reference."""
        recent = self._shifts[[number % _RING for number, _ in list(self._times)[-8:]]]
        middle = np.median(recent, axis=0)
        if np.abs(middle - self._shake.offset).max() > _STALE_PX and np.ptp(recent, axis=0).max() < 0.3:
            self._shake.refer(frame, self._shifts[self._times[-1][0] % _RING])

    def _candidates(self) -> tuple[Indices, Indices]:
        """Apertures whose alternation stands out, strongest first."""
        total, clipped = self._window.astype(np.float32), self._clipped.astype(np.float32)
        over = np.maximum(total / self._limit(total), clipped / self._limit(clipped))
        over[-1] = over[:, -1] = 0.0
        for track in self.tracks:
            over[
                max(track.row - _SEPARATION, 0) : track.row + _SEPARATION + 1,
                max(track.column - _SEPARATION, 0) : track.column + _SEPARATION + 1,
            ] = 0.0
        strength = np.maximum(total, clipped)
        clear = self._peaks(
            np.where((over > _CLEAR) & (self._refused < 0.5 * _NO_SPOT), strength, np.float32(0.0)),
            2 * self.config.max_candidates // 3,
        )
        # what is weaker, or found no room among the strong, has its turn before what was examined in vain
        over *= over > 1.0
        over /= 1.0 + self._refused
        over.ravel()[clear] = 0.0
        peaks = np.concatenate([clear, self._peaks(over, self.config.max_candidates // 3)])
        rows, columns = np.divmod(peaks, total.shape[1])
        return np.ascontiguousarray(rows), np.ascontiguousarray(columns)

    @staticmethod
    def _peaks(image: Singles, most: int) -> Indices:
        """Flat indices of the highest local maxima, highest first."""
        peaks = np.flatnonzero((image > 0.0) & (image >= cv2.dilate(image, np.ones((3, 3), np.uint8))))
        return peaks[np.argsort(-image.ravel()[peaks], kind="stable")][:most]

    def _limit(self, total: Singles) -> Singles:
        """What the alternation of every aperture must pass: its tile's median and so many spreads more."""
        height, width = total.shape
        frames = sum(block[0] for block in self._blocks)
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
        limit = (middle + self.config.min_alternation * spread).astype(np.float32)
        return np.asarray(limit[of_row[:, None], of_column])

    # ---- tracks ------------------------------------------------------------------------------------------------------

    def _add(self, row: int, column: int, k: int, matches: Matches, t: float) -> None:
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
            self._refused[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = _NO_SPOT
            return
        places = np.array([(track.row, track.column) for track in self.tracks]).reshape(-1, 2)
        if not len(places) or np.min(np.hypot(places[:, 0] - row, places[:, 1] - column)) > _SEPARATION:
            self.tracks.append(track)

    def _track(self, row: int, column: int, k: int, matches: Matches, t: float) -> Track:
        start = float(matches.start[k])
        track = Track(row, column, float(matches.score[k]), start, float(matches.light[k]), float(matches.variance[k]))
        self._grow(track, start, int(matches.periods[k]), t)
        return track

    def _is_inside(self, row: int, column: int) -> bool:
        height, width = self._total.shape
        return 0 <= row < height - 1 and 0 <= column < width - 1

    def _extend(self, track: Track, k: int, matches: Matches, t: float) -> None:
        if matches.score[k] > track.score:
            track.score = float(matches.score[k])
            track.start = float(matches.start[k])
            track.light = float(matches.light[k])
            track.variance = float(matches.variance[k])
        self._grow(track, float(matches.start[k]), int(matches.periods[k]), t)

    def _grow(self, track: Track, start: float, periods: int, t: float) -> None:
        """Add the frames since `track.last` to the amplitude image: per cell the regression of light on the pattern."""
        assert self._ring is not None
        numbers, times = self._recent(track.last)
        if len(times) < 8:
            return
        values, levels = self._curves(numbers, np.array([track.row], np.intp), np.array([track.column], np.intp))
        shifts = self._shifts[numbers % _RING]
        rest = self._matcher.cleared(times, values[0], levels[0], shifts, start, periods)
        if rest.weight < 2.0:
            return
        rows = slice(track.row, track.row + _BEFORE + _AFTER)
        columns = slice(track.column, track.column + _BEFORE + _AFTER)
        cells = self._ring[numbers[rest.seen] % _RING, rows, columns]
        light = self._light[cells].astype(float)
        mean = light.mean(axis=0)
        numerator = np.tensordot(rest.wave, light, 1)
        explained = np.tensordot(rest.basis, light, 1)
        track.numerator += numerator
        track.squares += (light**2).sum(axis=0) - (explained**2).sum(axis=0) - numerator**2 / rest.weight
        track.weight += rest.weight
        track.dof += len(light) - 1 - len(rest.basis)
        track.clipped |= (cells >= 985).any(axis=0)  # four pixels of which none is far from white
        track.base = float(np.median(mean))
        track.shift += rest.weight * rest.shift
        track.last = t
        if rest.sigma < 0.25 * self.config.pattern.period:
            track.looks.append((float(times.mean()), rest.start % self.config.pattern.period, rest.sigma))

    def spot(self, track: Track) -> Spot | None:
        """Where a track's light is, in pixels; None if its image is not that of a small light, as people leave it."""
        if track.fitted != track.last:
            variance = track.squares / max(track.dof, 1) / max(track.weight, 1e-9)
            variance = np.maximum(variance, 0.1 * float(np.median(variance)) + 1e-9)
            height, width = self._total.shape
            top, left = max(0, _BEFORE - track.row), max(0, _BEFORE - track.column)
            inside = np.s_[top : height + _BEFORE - track.row, left : width + _BEFORE - track.column]
            image = track.numerator / max(track.weight, 1e-9)
            middle = 2.0 * (_BEFORE - left) + 1.5, 2.0 * (_BEFORE - top) + 1.5
            spot = fit_spot(image[inside], variance[inside], ~track.clipped[inside], pitch=2, start=middle)
            if spot is not None:
                shift = track.shift / max(track.weight, 1e-9) - self._shift_sum / max(self._count, 1)
                u = spot.u + 2.0 * (track.column - _BEFORE + left) - shift[0]
                v = spot.v + 2.0 * (track.row - _BEFORE + top) - shift[1]
                small = spot.sigma <= self.config.max_sigma_px and spot.width <= self.config.max_width_px
                spot = replace(spot, u=u, v=v) if small else None
            track.spot = spot
            track.fitted = track.last
        return track.spot
