"""Find lights that flash in a known pattern, in one camera, as the frames arrive.

A label's light is a spot of about one pixel sigma, a few grey levels to white, that follows a pattern of known period
from an unknown start and for an unknown number of periods. Three steps of rising cost find it:

1. Every frame: cells of 2x2 pixels are kept for a second or two (`flash_memory`). With D(t) the change of a 4x4
   aperture over a lag of half a flash interval, less what the camera's own shaking explains, -D(t) D(t - lag) is added
   up (`alternation`). It is positive where brightness goes up and down in the pattern's own rhythm, and averages out
   under noise, slower or faster blinking and passing people.
2. Every half second: apertures in which that sum stands out from their neighbourhood (constant false alarm rate).
3. Only there: the aperture-minus-ring light curve of some seconds is compared with every start and number of periods
   (`matching`). That is a sequential test: it is repeated as frames arrive and decides as soon as its likelihood ratio
   passes the bound that keeps the false alarms of noise below a stated number per hour (Wald's bound, over all tests).

What passes becomes a track, whose amplitude image grows with every further period and is fitted when asked for.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..records import Flash
from .alternation import BLOCK, Alternation
from .flash_memory import BEFORE, FRAMES, PICTURES, FlashMemory
from .flash_track import Track
from .matching import Matcher, Matches
from .mirror import Lamp, reflected
from .pattern import FlashPattern
from .shake import BANDS, Shake
from .spot import Spot, grey_difference

try:
    from . import _blink as kernels
except ImportError:  # built without extensions
    from . import blink_reference as kernels  # type: ignore[no-redef]

__all__ = ["FLOOR_PX", "FlashConfig", "FlashDetector", "FlashPattern", "Track", "kernels"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Indices = NDArray[np.intp]

_FEW = 4  # frames since the last decision that are not worth another one
_DOUBT, _NEAR = 0.5, 8  # parts of the least score from which a place's neighbours are examined; so many places
_NO_SPOT = 12.0  # refusals that a place counts which follows the pattern but is no small light: it costs most
_LONGER = 2.5  # a slow camera's light curves are so much longer than `window_s`, because they have fewer frames
_SHAKEN_PX = 1.5  # a picture that is further off is not compared
_STALE_PX = 0.6  # a camera that stays so far off its reference gets another one
_LOOK_S = 1.0  # after which a camera that shakes looks again at what its picture is made of
_TESTS_APART = 4  # apertures, and starts per flash, that are about one independent test
FLOOR_PX = 0.01  # what fits keep in bias however strong the light: sampling, texture, the camera's curve
_STEADY = 0.002  # relative change of the light below which lamps do not flicker
_WIDE_PX = 2.0  # the place of a wider light may be less certain in proportion
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
    max_width_px: float = ranged(4.5, minimum=0.5, doc="a light is no wider (sigma) than this")
    max_sigma_px: float = ranged(0.2, minimum=0.01, doc="nor is its position less certain")
    steady_hz: tuple[float, float] = (0.6, 10.0)  # limits of the rates of other things that blink
    max_candidates: int = ranged(72, minimum=1, maximum=2000, doc="apertures examined at one decision")
    max_reflection: float = ranged(0.85, minimum=0.0, maximum=1.0, doc="likelier reflections are not reported")

    def min_score(self, shape: tuple[int, int]) -> float:
        """Log-likelihood ratio from which a light is accepted in images of this shape (H, W)."""
        shortest = min(end - start for start, end in self.pattern.on)
        apertures = shape[0] * shape[1] / 4.0 / _TESTS_APART
        starts = _TESTS_APART * self.pattern.period / shortest
        decisions = 3600.0 / self.window_s
        return float(np.log(max(apertures * starts * decisions / self.false_alarms_per_hour, np.e)))


@dataclass(frozen=True, slots=True, eq=False)
class _Curves:
    """Light curves of N places in F frames, as of `FlashMemory.curves`; `flicker` (N, F) is None under steady lamps."""

    rows: Indices
    columns: Indices
    numbers: Indices
    times: Floats
    values: Singles
    levels: Singles
    known: NDArray[np.bool_]
    flicker: Singles | None

    def one(self, k: int) -> _Curves:
        """Those of one place."""
        at = slice(k, k + 1)
        flicker = None if self.flicker is None else self.flicker[at]
        places = self.rows[at], self.columns[at]
        return _Curves(*places, self.numbers, self.times, self.values[at], self.levels[at], self.known[at], flicker)

    def of(self, chosen: NDArray[np.bool_]) -> _Curves:
        """Those in the chosen frames."""
        return _Curves(
            self.rows,
            self.columns,
            self.numbers[chosen],
            self.times[chosen],
            self.values[:, chosen],
            self.levels[:, chosen],
            self.known[:, chosen],
            None if self.flicker is None else self.flicker[:, chosen],
        )


class FlashDetector:
    """Streaming detector of flashing lights in one camera that stands still, or shakes by a pixel.

    Feed frames in the order of their time stamps; stamps may be irregular and frames may be missing. Frames that come
    faster than 1.7 times FRAMES a window are thinned.
    """

    def __init__(self, config: FlashConfig | None = None) -> None:
        self.config = config or FlashConfig()
        self._lag = self.config.pattern.lag
        self._matcher = Matcher(self.config.pattern, self.config.exposure_s, self.config.steady_hz)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.tracks: list[Track] = []
        self._memory: FlashMemory | None = None
        self._alternation: Alternation | None = None
        self._times: deque[tuple[int, float]] = deque(maxlen=FRAMES)  # number of the frame, its time
        self._shifts = np.zeros((FRAMES, 2))
        self._lamps = np.zeros((FRAMES, BANDS))  # relative change of each band's light
        self._shift_sum = np.zeros(2)  # places are given where they are in the mean picture
        self._shake = Shake(BEFORE)
        self._count = 0
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
        shape = (frame.shape[0] // 2, frame.shape[1] // 2)
        if self._memory is None or self._alternation is None:
            self._memory, self._alternation = self._allocated(shape)
            self._due = t + self.config.decision_s
        if self._alternation.shape != shape:
            raise ValueError(f"the image size changed within a stream, to {frame.shape}; call reset() first")
        if self._times:
            if t <= self._times[-1][1]:
                raise ValueError(f"time stamps must increase: {t} came after {self._times[-1][1]}")
            if t - self._times[-1][1] < 0.6 * self.config.window_s / FRAMES:
                return False
        frame = np.ascontiguousarray(frame)
        self._accumulate(frame, t)
        if t < self._due and self._alternation.frames < BLOCK:
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
        waiting = 0 if self._alternation is None else self._alternation.frames
        if waiting >= _FEW or (waiting and not self.tracks):
            self._decide(self._times[-1][1])
        if self._times:
            since = self._times[-1][1] - 0.9 * self.config.pattern.period
            self._extend([track for track in self.tracks if track.last <= since])
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
                    amplitude=grey_difference(float(np.median(track.base)), spot.peak, config.gamma),
                    saturated=bool(track.clipped.any()),
                    covariance=(float(uu), float(uv), float(vv)),
                    reflection=float(reflection),
                )
            )
        return sorted(found, key=lambda flash: -flash.score)

    def light_curves(self, rows: Indices, columns: Indices, since: float = -np.inf) -> tuple[Floats, Singles, Singles]:
        """Light of apertures over the latest frames.

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
            around it; linear light of the ring per cell, nan in frames before which nobody looked there.
        """
        assert self._memory is not None
        numbers, times = self._recent(since)
        values, levels, known = self._memory.curves(numbers, rows, columns)
        levels[~known] = np.nan
        return times, values, levels

    def _recent(self, since: float = -np.inf) -> tuple[Indices, Floats]:
        """Numbers and times of the frames after `since` within the window."""
        numbers, times = (np.array(column) for column in zip(*self._times, strict=True))
        chosen = times > max(since, times[-1] - self._window_s())
        return numbers[chosen], times[chosen]

    def _flickers(self, numbers: Indices, rows: Indices) -> Singles | None:
        """Relative change (N, F) of the light around places in so many rows; None where lamps are steady."""
        bands = self._lamps[numbers % FRAMES]
        bands = bands - bands.mean(axis=0)
        if 2 * np.count_nonzero((bands**2).mean(axis=0) > _STEADY**2) < BANDS:
            return None
        assert self._alternation is not None
        place = np.clip((rows + 0.5) * BANDS / self._alternation.shape[0] - 0.5, 0.0, BANDS - 1.0)
        above = np.minimum(place.astype(np.intp), BANDS - 2)
        share = (place - above)[:, None]
        bands = bands.T
        return np.asarray((1.0 - share) * bands[above] + share * bands[above + 1], np.float32)

    def _window_s(self) -> float:
        """Length of the light curves in seconds: what the memory holds, within limits."""
        return float(np.clip(0.9 * FRAMES * self._pace(), self.config.window_s, _LONGER * self.config.window_s))

    def _pace(self) -> float:
        """Mean time between the latest frames."""
        return (self._times[-1][1] - self._times[0][1]) / max(len(self._times) - 1, 1)

    # ---- each frame --------------------------------------------------------------------------------------------------

    def _allocated(self, shape: tuple[int, int]) -> tuple[FlashMemory, Alternation]:
        depth = min(int(np.ceil(1.7 * self._lag * FRAMES / self.config.window_s)) + 2, FRAMES)
        memory = FlashMemory(shape, max(PICTURES, depth), self.config.gamma)
        return memory, Alternation(shape, depth, self.config.min_alternation)

    def _accumulate(self, frame: NDArray[np.uint8], t: float) -> None:
        assert self._memory is not None
        assert self._alternation is not None
        now = self._count % FRAMES
        cells = self._memory.take(frame)
        if not self._count:
            self._shake.refer(frame, np.zeros(2))
        self._shifts[now] = self._shake.measure(cells)
        self._lamps[now] = np.maximum(1.0 + self._shake.brightness, 0.1) ** self.config.gamma - 1.0
        self._shift_sum += self._shifts[now]
        number, lagged, move = self._lagged(t), None, np.zeros(2)
        if number is not None:
            move = self._shifts[now] - self._shifts[number % FRAMES]
            if np.abs(move).max() <= _SHAKEN_PX:
                lagged = number, self._memory.cells(number)
        self._alternation.add(self._count, cells, lagged, move, self._shake)
        self._times.append((self._count, t))
        self._count += 1

    def _lagged(self, t: float) -> int | None:
        """Number of the frame one lag ago; None if none is near enough to that time."""
        assert self._alternation is not None
        lag = self._lag
        best, error = None, 0.5 * lag
        for number, then in reversed(self._times):
            if number <= self._count - self._alternation.depth:
                break
            if abs(t - then - lag) < error:
                best, error = number, abs(t - then - lag)
            if t - then > 1.5 * lag:
                break
        return best

    # ---- each decision -----------------------------------------------------------------------------------------------

    def _decide(self, t: float) -> None:
        assert self._memory is not None
        assert self._alternation is not None
        self._alternation.end_block((self._window_s() + self.config.decision_s) / max(self._pace(), 1e-9))
        places = [(track.row, track.column) for track in self.tracks]
        watched, examined = self._alternation.candidates(places, self.config.max_candidates)
        self._alternation.watch(watched)
        rows, columns = np.divmod(watched, self._alternation.shape[1])
        self._memory.watch(*self._joined(self.tracks, rows, columns))
        if t - self._times[0][1] < 1.4 * self.config.pattern.period:
            return
        self._extend([track for track in self.tracks if t - track.last >= self._patience()])
        rows, columns = rows[:examined], columns[:examined]
        if not len(rows):
            return
        scores, accepted = self._examine(rows, columns)
        in_vain = np.flatnonzero(scores < _DOUBT * self._least())
        self._alternation.refuse(rows[in_vain], columns[in_vain])
        # because a weak light may pass only where the aperture is centred on it
        near = [k for k in np.argsort(-scores) if scores[k] >= _DOUBT * self._least() and not accepted[k]][:_NEAR]
        beside = [(rows[k] + i, columns[k] + j) for k in near for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
        if around := [place for place in beside if self._is_inside(*place)]:
            self._examine(*np.array(around, np.intp).T.copy())

    def _examine(self, rows: Indices, columns: Indices) -> tuple[Floats, NDArray[np.bool_]]:
        """Match places, start a track where one follows the pattern; their scores, and which are accepted."""
        curves = self._curves(rows, columns)
        matches, accepted = self._match(curves)
        for k in np.argsort(-matches.light):
            if accepted[k]:
                self._add(int(k), matches, curves)
        return matches.score, accepted

    @staticmethod
    def _joined(tracks: Sequence[Track], rows: Indices, columns: Indices) -> tuple[Indices, Indices]:
        """Rows and columns of the tracks, then the others."""
        places = np.array([(track.row, track.column) for track in tracks], np.intp).reshape(-1, 2)
        return np.concatenate([places[:, 0], rows]), np.concatenate([places[:, 1], columns])

    def _curves(self, rows: Indices, columns: Indices) -> _Curves:
        """Light curves of places over the window."""
        assert self._memory is not None
        numbers, times = self._recent()
        values, levels, known = self._memory.curves(numbers, rows, columns)
        return _Curves(rows, columns, numbers, times, values, levels, known, self._flickers(numbers, rows))

    def _match(self, curves: _Curves) -> tuple[Matches, NDArray[np.bool_]]:
        """How well places follow the pattern, and which of them do."""
        shifts = self._shifts[curves.numbers % FRAMES]
        matches = self._matcher.match(curves.times, curves.values, curves.levels, shifts, curves.flicker, curves.known)
        sure = (matches.score >= self._least()) & (matches.margin >= self.config.min_margin)
        return matches, sure & matches.regular & (matches.light > 0.0)

    def _least(self) -> float:
        """Score from which a light is accepted."""
        assert self._alternation is not None
        return self.config.min_score((2 * self._alternation.shape[0], 2 * self._alternation.shape[1]))

    def _patience(self) -> float:
        """Time after which a track takes frames into its image: before their pictures are gone."""
        assert self._memory is not None
        gone = (self._memory.depth - 1) * self._pace() - 1.1 * self.config.decision_s
        return min(2.0 * self.config.pattern.period, max(gone, 0.0))

    def _keep_reference(self, frame: NDArray[np.uint8], t: float) -> None:
        """Refer to the latest picture if the camera has settled away from the last reference."""
        recent = self._shifts[[number % FRAMES for number, _ in list(self._times)[-8:]]]
        if not recent.any():
            return
        middle = np.median(recent, axis=0)
        spread = float(np.ptp(recent, axis=0).max())
        if np.abs(middle - self._shake.offset).max() > _STALE_PX and spread < 0.3:
            self._shake.refer(frame, self._shifts[self._times[-1][0] % FRAMES])
        elif spread > 0.0 and t >= self._looked + _LOOK_S:
            self._shake.look(frame)
            self._looked = t

    # ---- tracks ------------------------------------------------------------------------------------------------------

    def _add(self, k: int, matches: Matches, curves: _Curves) -> None:
        """Start a track on the aperture that is centred best on the light, unless it has a track already."""
        assert self._memory is not None
        assert self._alternation is not None
        track = self._track(k, matches, curves.one(k))
        image = track.numerator[1:7, 1:7]
        sums = image[:-1, :-1] + image[1:, :-1] + image[:-1, 1:] + image[1:, 1:]
        down, right = divmod(int(np.argmax(sums)), 5)
        row, column = track.row + down - 2, track.column + right - 2
        if not self._is_inside(row, column) or self._is_known(row, column):
            return
        if (down, right) != (2, 2):
            self._memory.move(track.row, track.column, row, column)
            track = self._track(k, matches, self._curves(np.array([row]), np.array([column])))
        spot = self.spot(track)
        if spot is None:
            self._alternation.refuse_around(row, column, _NO_SPOT)
        elif not self._is_known(spot.v / 2.0 - 0.75, spot.u / 2.0 - 0.75, spot.width / 2.0):
            self.tracks.append(track)

    def _is_known(self, row: float, column: float, width: float = 0.0) -> bool:
        """Whether a track is so near that this is the same light, which is so many cells wide (sigma)."""
        within = max(_SEPARATION, 2.0 * width)
        return any(np.hypot(track.row - row, track.column - column) <= within for track in self.tracks)

    def _track(self, k: int, matches: Matches, curves: _Curves) -> Track:
        track = Track(
            row=int(curves.rows[0]),
            column=int(curves.columns[0]),
            score=float(matches.score[k]),
            start=float(matches.start[k]),
            light=float(matches.light[k]),
            variance=float(matches.variance[k]),
        )
        self._grow(track, track.start, int(matches.periods[k]), curves)
        return track

    def _is_inside(self, row: int, column: int) -> bool:
        assert self._alternation is not None
        height, width = self._alternation.shape
        return 0 <= row < height - 1 and 0 <= column < width - 1

    def _extend(self, tracks: Sequence[Track]) -> None:
        """Match known lights anew, and add what came since to the images of those that flash."""
        if not tracks:
            return
        nothing = np.zeros(0, np.intp)
        curves = self._curves(*self._joined(tracks, nothing, nothing))
        matches, accepted = self._match(curves)
        for k in np.flatnonzero(accepted):
            track = tracks[int(k)]
            if matches.score[k] > track.score:
                track.score = float(matches.score[k])
                track.start = float(matches.start[k])
                track.light = float(matches.light[k])
                track.variance = float(matches.variance[k])
            self._grow(track, float(matches.start[k]), int(matches.periods[k]), curves.one(int(k)))

    def _grow(self, track: Track, start: float, periods: int, curves: _Curves) -> None:
        """Add the frames since `track.last` to the amplitude image: per cell the regression of light on the pattern."""
        assert self._memory is not None
        chosen = self._memory.has(curves.numbers) & (curves.times > track.last)
        if np.count_nonzero(chosen) < 8:
            return
        part = curves.of(chosen)
        shifts = self._shifts[part.numbers % FRAMES]
        rest = self._matcher.cleared(part.times, part.values, part.levels, shifts, part.flicker, start, periods)
        if rest.weight < 0.4:
            return
        patches = self._memory.patches(part.numbers[rest.seen], track.row, track.column)
        track.add(patches, self._memory.light, rest, float(curves.times[-1]))

    def spot(self, track: Track) -> Spot | None:
        """Where a track's light is, in pixels; None if its image is not that of a small light, as people leave it."""
        if track.fitted != track.last:
            assert self._alternation is not None
            spot = track.fit(self._alternation.shape, self.config.gamma)
            if spot is not None:
                shift = self._shift_sum / max(self._count, 1)
                least = self.config.max_sigma_px * (_CENSORED if track.clipped.any() else 1.0)
                small = spot.sigma <= least * max(1.0, spot.width / _WIDE_PX) and spot.width <= self.config.max_width_px
                spot = spot.moved(shift[0], shift[1]) if small else None
            track.spot = spot
            track.fitted = track.last
        return track.spot
