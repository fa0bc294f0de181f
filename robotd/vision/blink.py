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
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..records import Flash
from .flash_track import AFTER, BEFORE, Track
from .matching import Matcher, Matches
from .mirror import Lamp, reflected
from .pattern import FlashPattern
from .shake import BANDS, Shake
from .spot import Spot, grey_difference, light_table

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
_LOW, _HIGH = 4.0, 1500  # a block's alternation counts no further than so many typical ones below, and this above
_CLEAR = 1.8  # limits from which a place is clear enough to be examined at every decision
_NO_SPOT = 12.0  # refusals that a place counts which follows the pattern but is no small light: it costs most
_FORGET = 0.8  # of a place's refusals, from one decision to the next
_TILE = (24, 32)  # cells over which the false alarm rate is held constant
_LONGER = 2.5  # a slow camera's light curves are so much longer than `window_s`, because they have fewer frames
_SHAKEN_PX = 1.5  # a picture that is further off is not compared
_STALE_PX = 0.6  # a camera that stays so far off its reference gets another one
_LOOK_S = 1.0  # after which a camera that shakes looks again at what its picture is made of
_TESTS_APART = 4  # apertures, and starts per flash, that are about one independent test
FLOOR_PX = 0.01  # what fits keep in bias however strong the light: sampling, texture, the camera's curve
_STEADY = 0.002  # relative change of the light below which lamps do not flicker
_CENSORED = 2.5  # a light that is partly clipped may be so much less certain in place
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
    max_reflection: float = ranged(0.8, minimum=0.0, maximum=1.0, doc="likelier reflections are not reported")

    def min_score(self, shape: tuple[int, int]) -> float:
        """Log-likelihood ratio from which a light is accepted in images of this shape (H, W)."""
        shortest = min(end - start for start, end in self.pattern.on)
        apertures = shape[0] * shape[1] / 4.0 / _TESTS_APART
        starts = _TESTS_APART * self.pattern.period / shortest
        decisions = 3600.0 / self.window_s
        return float(np.log(max(apertures * starts * decisions / self.false_alarms_per_hour, np.e)))


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
        self._lamps = np.zeros((_RING, BANDS))  # relative change of each band's light
        self._shift_sum = np.zeros(2)  # places are given where they are in the mean picture
        self._shake = Shake(BEFORE)
        self._blocks: deque[tuple[int, NDArray[np.int16], int]] = deque()  # frames, sums, lower limit
        self._count = 0
        self._block_frames = 0
        self._due = self._looked = -np.inf

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
        self._keep_reference(frame, t)
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
        lamps = [
            Lamp(track.looks, spot.peak, spot.width, spot.u, spot.v, spot.v * self.config.row_time_s)
            for track, spot in seen
        ]
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
        numbers, times = (np.array(column) for column in zip(*self._times, strict=True))
        chosen = times > max(since, times[-1] - self._window_s())
        return numbers[chosen], times[chosen]

    def _curves(self, numbers: Indices, rows: Indices, columns: Indices) -> tuple[Singles, Singles]:
        assert self._ring is not None
        values = np.empty((len(rows), len(numbers)), np.float32)
        levels = np.empty_like(values)
        if len(rows):
            kernels.aperture_series(
                self._ring, numbers % _RING, rows + BEFORE, columns + BEFORE, self._light, values, levels
            )
        return values, levels

    def _flickers(self, numbers: Indices, rows: Indices) -> Singles | None:
        """Relative change (N, F) of the light around places in so many rows; None where lamps are steady."""
        bands = self._lamps[numbers % _RING]
        bands = bands - bands.mean(axis=0)
        if 2 * np.count_nonzero((bands**2).mean(axis=0) > _STEADY**2) < BANDS:
            return None
        place = np.clip((rows + 0.5) * BANDS / self._total.shape[0] - 0.5, 0.0, BANDS - 1.0)
        return np.stack([np.interp(place, range(BANDS), band) for band in bands], axis=1).astype(np.float32)

    def _window_s(self) -> float:
        """Length of the light curves in seconds: what the ring holds, within limits."""
        return float(np.clip(0.9 * _RING * self._pace(), self.config.window_s, _LONGER * self.config.window_s))

    def _pace(self) -> float:
        """Mean time between the frames in the ring."""
        return (self._times[-1][1] - self._times[0][1]) / max(len(self._times) - 1, 1)

    # ---- each frame --------------------------------------------------------------------------------------------------

    def _allocate(self, shape: tuple[int, int], t: float) -> None:
        around = BEFORE + AFTER
        self._ring = np.zeros((_RING, shape[0] + around, shape[1] + around), np.uint16)
        depth = int(np.ceil(1.7 * self._lag * _RING / self.config.window_s)) + 2
        self._differences = np.zeros((depth, *shape), np.int8)
        self._total = np.zeros(shape, np.int16)
        self._refused = np.zeros(shape, np.float32)  # how often a place was examined in vain, of late
        self._due = t + self.config.decision_s

    def _accumulate(self, frame: NDArray[np.uint8], t: float) -> None:
        assert self._ring is not None
        now = self._count % _RING
        cells = self._ring[now]
        kernels.sum_cells(frame, cells, BEFORE, AFTER)
        if not self._count:
            self._shake.refer(frame, np.zeros(2))
        self._shifts[now] = self._shake.measure(cells)
        self._lamps[now] = self.config.gamma * self._shake.brightness
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
                BEFORE,
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
        low = -int(min(_LOW * usual, _HIGH))
        self._blocks.append((self._block_frames, self._total, low))
        self._total = np.zeros_like(self._total)
        self._block_frames = 0
        while sum(block[0] for block in self._blocks) * self._pace() > self._window_s() + self.config.decision_s:
            self._blocks.popleft()
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
        flicker = self._flickers(numbers, rows)
        matches = self._matcher.match(times, values, levels, self._shifts[numbers % _RING], flicker)
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

    def _keep_reference(self, frame: NDArray[np.uint8], t: float) -> None:
        """Refer to the latest picture if the camera has settled away from the last reference."""
        recent = self._shifts[[number % _RING for number, _ in list(self._times)[-8:]]]
        if not recent.any():
            return
        middle = np.median(recent, axis=0)
        spread = float(np.ptp(recent, axis=0).max())
        if np.abs(middle - self._shake.offset).max() > _STALE_PX and spread < 0.3:
            self._shake.refer(frame, self._shifts[self._times[-1][0] % _RING])
        elif spread > 0.0 and t >= self._looked + _LOOK_S:
            self._shake.look(frame)
            self._looked = t

    def _candidates(self) -> tuple[Indices, Indices]:
        """Apertures whose alternation stands out, strongest first."""
        total, clipped = self._alternation()
        strength = np.maximum(total, clipped)
        self._divide(total)
        self._divide(clipped)
        over = np.maximum(total, clipped, out=total)
        del clipped
        over[-1] = over[:, -1] = 0.0
        for track in self.tracks:
            over[
                max(track.row - _SEPARATION, 0) : track.row + _SEPARATION + 1,
                max(track.column - _SEPARATION, 0) : track.column + _SEPARATION + 1,
            ] = 0.0
        # because in a camera that shakes whole edges alternate, and far more strongly than a label, which is small
        np.maximum(strength, 1.0, out=strength)
        turn: Singles = np.asarray(cv2.blur(strength, (3, 3)), np.float32)
        turn /= cv2.blur(strength, (11, 11))
        del strength
        turn /= (1.0 + self._refused) ** 2
        clear = self._peaks(np.where(over > _CLEAR, turn, np.float32(0.0)), 2 * self.config.max_candidates // 3)
        # what is weaker, or found no room among the strong, has its turn before what was examined in vain
        over *= over > 1.0
        over *= turn
        over.ravel()[clear] = 0.0
        peaks = np.concatenate([clear, self._peaks(over, self.config.max_candidates - len(clear))])
        rows, columns = np.divmod(peaks, over.shape[1])
        return np.ascontiguousarray(rows), np.ascontiguousarray(columns)

    @staticmethod
    def _peaks(image: Singles, most: int) -> Indices:
        """Flat indices of the highest local maxima, highest first."""
        peaks = np.flatnonzero((image > 0.0) & (image >= cv2.dilate(image, np.ones((3, 3), np.uint8))))
        return peaks[np.argsort(-image.ravel()[peaks], kind="stable")][:most]

    def _alternation(self) -> tuple[Singles, Singles]:
        """Sum of the blocks, and the same with each limited: what has alternated of late, of every aperture."""
        total, clipped = np.zeros(self._total.shape, np.float32), np.zeros(self._total.shape, np.float32)
        for _, block, low in self._blocks:
            kernels.add_block(block, low, _HIGH, total, clipped)
        return total, clipped

    def _divide(self, total: Singles) -> None:
        """Divide the alternation of every aperture by what it must pass: its tile's median and so many spreads more."""
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
        limit = (middle + self.config.min_alternation * spread).astype(np.float32)
        of_column = np.minimum(np.arange(width) // size[1], tiles[1] - 1)
        for k, row in enumerate(limit):
            last = height if k == tiles[0] - 1 else (k + 1) * size[0]
            total[k * size[0] : last] /= row[of_column]

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
        flicker = self._flickers(numbers, np.array([track.row], np.intp))
        rest = self._matcher.cleared(times, values, levels, shifts, flicker, start, periods)
        if rest.weight < 2.0:
            return
        rows = slice(track.row, track.row + BEFORE + AFTER)
        columns = slice(track.column, track.column + BEFORE + AFTER)
        track.add(self._ring[numbers[rest.seen] % _RING, rows, columns], self._light, rest, t)

    def spot(self, track: Track) -> Spot | None:
        """Where a track's light is, in pixels; None if its image is not that of a small light, as people leave it."""
        if track.fitted != track.last:
            spot = track.fit(self._total.shape)
            if spot is not None:
                shift = self._shift_sum / max(self._count, 1)
                least = self.config.max_sigma_px * (_CENSORED if track.clipped.any() else 1.0)
                small = spot.sigma <= least and spot.width <= self.config.max_width_px
                spot = spot.moved(shift[0], shift[1]) if small else None
            track.spot = spot
            track.fitted = track.last
        return track.spot
