"""The robot's beacons in the pictures of a roof camera: search, then follow.

While a beacon is not known it is searched for in the whole picture (robotd.vision.beacon_search), which needs the robot
to stand still for two seconds; from then on it is followed (robotd.vision.beacon_track) in a few hundred pixels,
standing or moving. Both LEDs hang on one clock, so that one start time serves both.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..bind import ranged
from ..records import Floats
from .beacon_search import Place, halved, search
from .beacon_track import REACH, WIDE, WIDTHS, Course, Fitted, Path, fit_beacon
from .beacon_wave import Wave
from .spot import light_table

Image = NDArray[np.uint8]
Motion = Callable[[str, Floats, Floats, float], Floats | None]
Plausible = Callable[[tuple[float, float], tuple[float, float]], bool]

FRONT, REAR = "front", "rear"
SEARCH_S, SEARCH_EVERY_S = 2.0, 1.0  # what a search looks at, and how often it is made
STILL_S, MOVING_S = 4.0, 0.9  # what a fit looks at
FOLLOW_EVERY_S, STILL_EVERY_S = 0.06, 0.15  # how often fits are made of what moves, and of what stands
LOST_S = 1.6  # without a fit that passes: search anew
STILL_PX = 0.6  # within MOVING_S: more is motion
SIGMAS = 3.0  # if it is more than so many as well
FLOOR_PX = 0.05  # what compression, chroma and lens shading leave, however long one looks
LONGEST_GAP_S = 1.0  # between two frames: what came before belongs to another time
FOLLOW_TRIALS = 10.0  # places near the course at which another light may stand


@dataclass(frozen=True, slots=True)
class BeaconConfig:
    """What is known of beacons and camera; rates in Hz as the robot's gpio_beacons has them.

    `exposure_s` of the camera, `row_time_s` of its rolling shutter, `jitter_s` the stamps' standard deviation, `gamma`
    its curve. `false_alarm` is the probability that a search finds a beacon where there is none.
    """

    front_hz: float = ranged(6.25, minimum=0.2, maximum=25.0)
    rear_hz: float = ranged(3.125, minimum=0.2, maximum=25.0)
    exposure_s: float = ranged(0.010, minimum=0.0, maximum=0.2)
    row_time_s: float = ranged(0.0, minimum=0.0, maximum=0.001)
    jitter_s: float = ranged(0.005, minimum=0.0, maximum=0.05)
    gamma: float = ranged(2.2, minimum=0.5, maximum=4.0)
    false_alarm: float = ranged(0.001, minimum=1e-12, maximum=0.5)


@dataclass(frozen=True, slots=True)
class BeaconFix:
    """A beacon at time `t`, from frames `until` a time: `u`, `v` in px as seen, `covariance` in px^2, velocity in px/s.

    `still_since` is when it began to stand still, None while it moves. `share` 0..1 of the light's changes that are
    the beacon's; `clipped` says that the camera was blinded, so that the place leans on the flanks.
    """

    beacon: str
    t: float
    until: float
    u: float
    v: float
    covariance: tuple[tuple[float, float], tuple[float, float]]
    velocity: tuple[float, float]
    still_since: float | None
    share: float
    amplitude: float
    clipped: bool
    frames: int

    @property
    def sigma_px(self) -> float:
        """Standard deviation per axis."""
        return float(np.sqrt(0.5 * (self.covariance[0][0] + self.covariance[1][1])))


@dataclass(slots=True)
class _Track:
    t: float
    place: Floats
    course: Course
    still_since: float | None
    passed: float  # when a fit passed last
    beside: Floats | None = None  # px from the other beacon, when it was seen last


class BeaconDetector:
    """Follows both beacons through the frames of one camera.

    Parameters
    ----------
    config : BeaconConfig
    plausible : callable, optional
        Whether two places (u, v) in px can be front and rear of one robot; asked where several places blink alike.

    Attributes
    ----------
    motion : callable or None
        From a beacon's name, (N,) times, a place (2,) and its time t0 to its (N, 2) places at those times, as odometry
        predicts them, or None where it cannot; without it the last course is carried on.
    start : float or None
        When both LEDs were switched on together, modulo the slower one's period, on the frames' clock.
    """

    def __init__(self, config: BeaconConfig, plausible: Plausible | None = None) -> None:
        self.config = config
        self.motion: Motion | None = None
        self.start: float | None = None
        self._plausible = plausible
        exposure = config.exposure_s
        self._waves = {
            FRONT: Wave(config.front_hz, exposure, config.jitter_s),
            REAR: Wave(config.rear_hz, exposure, config.jitter_s),
        }
        self._table = light_table(config.gamma, 256)
        self._frames: deque[tuple[float, Image, Image]] = deque()
        self._tracks: dict[str, _Track] = {}
        self._searched = self._followed = float("-inf")

    @property
    def tracked(self) -> tuple[str, ...]:
        """The beacons that are followed at present."""
        return tuple(self._tracks)

    def reset(self) -> None:
        """Forget everything: the stream is a new one."""
        self._frames.clear()
        self._tracks.clear()
        self.start = None
        self._searched = self._followed = float("-inf")

    def update(self, image: Image, t: float) -> list[BeaconFix]:
        """Take a frame; returns the fixes that it made possible.

        Parameters
        ----------
        image : (H, W) uint8 array
            The red channel. It is kept for some seconds and must not change.
        t : float
            When its exposure began, in seconds; increasing.

        Raises
        ------
        ValueError
            The image is not (H, W) uint8, or its size changed.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"need a (H, W) uint8 image, got {image.shape} {image.dtype}")
        if self._frames:
            last, before, _ = self._frames[-1]
            if image.shape != before.shape:
                raise ValueError(f"image of {image.shape}, the one before had {before.shape}")
            if t <= last:
                return []
            if t - last > LONGEST_GAP_S:
                self._frames.clear()
                self._tracks.clear()
        self._frames.append((t, image, halved(image)))
        while t - self._frames[0][0] > STILL_S:
            self._frames.popleft()
        fixes = []
        all_still = all(track.still_since is not None for track in self._tracks.values())
        if t - self._followed >= (STILL_EVERY_S if all_still else FOLLOW_EVERY_S) and self._tracks:
            self._followed = t
            fixes = self._follow(t)
        if len(self._tracks) < len(self._waves) and t - self._searched >= SEARCH_EVERY_S:
            self._search(t)
        return fixes

    # ---- search ------------------------------------------------------------------------------------------------------

    def _search(self, t: float) -> None:
        used = [item for item in self._frames if t - item[0] <= SEARCH_S]
        if t - used[0][0] < 0.8 * SEARCH_S:
            return
        self._searched = t
        config = self.config
        found = search(
            [item[1] for item in used],
            [item[2] for item in used],
            np.array([item[0] for item in used]),
            self._waves,
            row_time=config.row_time_s,
            false_alarm=config.false_alarm,
        )
        for name, place in self._chosen(found).items():
            if name not in self._tracks:
                at = np.array([place.u, place.v])
                self._tracks[name] = _Track(t, at, _resting(t, at), used[0][0], t)
                self.start = place.lock.start if name == REAR or self.start is None else self.start

    def _chosen(self, found: dict[str, list[Place]]) -> dict[str, Place]:
        """One place for each beacon: the surest pair that is in step and plausible, or the surest single one."""
        known = {name: track.place for name, track in self._tracks.items()}
        pairs = [
            (front.lock.log_p + rear.lock.log_p, front, rear)
            for front in found[FRONT]
            for rear in found[REAR]
            if self._in_step(front, rear) and self._can_be((front.u, front.v), (rear.u, rear.v))
        ]
        if pairs:
            _, front, rear = min(pairs, key=lambda item: item[0])
            return {FRONT: front, REAR: rear}
        chosen = {}
        for name, places in found.items():
            other = known.get(REAR if name == FRONT else FRONT)
            for place in places:
                here = (place.u, place.v)
                there = None if other is None else (float(other[0]), float(other[1]))
                pair = None if there is None else (here, there) if name == FRONT else (there, here)
                if pair is None or self._can_be(*pair):
                    chosen[name] = place
                    break
        return chosen if len(chosen) < 2 or known else dict([min(chosen.items(), key=lambda item: item[1].lock.log_p)])

    def _in_step(self, front: Place, rear: Place) -> bool:
        """Whether both were switched on together: the front's start is the rear's, modulo the front's period."""
        apart = (front.lock.start - rear.lock.start) * self.config.front_hz
        return abs(apart - round(apart)) < 0.15

    def _can_be(self, front: tuple[float, float], rear: tuple[float, float]) -> bool:
        if max(abs(front[0] - rear[0]), abs(front[1] - rear[1])) < 3.0:
            return False
        return self._plausible is None or self._plausible(front, rear)

    # ---- follow ------------------------------------------------------------------------------------------------------

    def _follow(self, t: float) -> list[BeaconFix]:
        fixes = []
        for name, track in list(self._tracks.items()):
            fitted, still_since = self._fit(name, track, t)
            if fitted is None:
                if t - track.passed > LOST_S:
                    del self._tracks[name]
                continue
            track.t, track.place, track.course = fitted.t, fitted.place, fitted.course
            track.still_since, track.passed = still_since, t
            other = self._tracks.get(REAR if name == FRONT else FRONT)
            if other is not None and t - other.passed < LOST_S / 2:
                track.beside = track.place - other.course(np.array([track.t]))[0]
            wave = self._waves[name]
            if name == REAR or REAR not in self._tracks:
                self.start = fitted.lock.start % (1.0 / wave.hz)
            speed = fitted.velocity
            stamps = self.config.jitter_s**2 * np.outer(speed, speed) / max(1.0, 0.25 * fitted.frames)
            covariance = fitted.covariance + FLOOR_PX**2 * np.eye(2) + stamps
            fixes.append(
                BeaconFix(
                    beacon=name,
                    t=fitted.t,
                    until=t,
                    u=float(fitted.place[0]),
                    v=float(fitted.place[1]),
                    covariance=(
                        (float(covariance[0, 0]), float(covariance[0, 1])),
                        (float(covariance[1, 0]), float(covariance[1, 1])),
                    ),
                    velocity=(float(fitted.velocity[0]), float(fitted.velocity[1])),
                    still_since=still_since,
                    share=fitted.lock.share,
                    amplitude=fitted.peak,
                    clipped=fitted.clipped,
                    frames=fitted.frames,
                )
            )
        return fixes

    def _fit(self, name: str, track: _Track, t: float) -> tuple[Fitted | None, float | None]:
        """A fit over the last moments says whether the beacon moves; if it stands one over all the time it stood."""
        short = self._moving_fit(name, track, t)
        if short is None:
            return None, None
        ends = short.course(np.array([short.course.t - short.course.span, short.course.t + short.course.span]))
        drift = float(np.hypot(*(ends[1] - ends[0])))
        sigma = float(np.sqrt(np.trace(short.velocity_covariance))) * 2.0 * short.course.span
        if drift > STILL_PX and drift > SIGMAS * sigma:
            return short, None
        since = t - MOVING_S if track.still_since is None else track.still_since
        long = self._fit_over(name, lambda at: np.tile(short.place, (len(at), 1)), max(since, t - STILL_S), order=0)
        if long is None or not self._passes(long):
            return short, None
        miss = float(np.hypot(*(long.place - short.place)))
        if miss > STILL_PX + SIGMAS * float(np.sqrt(np.trace(short.covariance))):
            return short, None  # it stood, but elsewhere
        return long, since

    def _moving_fit(self, name: str, track: _Track, t: float) -> Fitted | None:
        path, order = self._predicted(name, track, t)
        # the wide cut costs more and sees more that is not the beacon
        tries: list[tuple[Path, int]] = [(path, REACH), (path, WIDE)]
        other = self._tracks.get(REAR if name == FRONT else FRONT)
        if other is not None and other.passed > track.passed and track.beside is not None:
            course, beside = other.course, track.beside
            tries.append((lambda at: course(at) + beside, WIDE))  # the other one knows where the robot went
        for way, reach in tries:
            found = self._fit_over(name, way, t - MOVING_S, order=order, reach=reach)
            if found is not None and self._passes(found):
                return found
        return None

    def _predicted(self, name: str, track: _Track, t: float) -> tuple[Path, int]:
        """The way by odometry, else the last course; and how far it may be wrong: by a speed, or by a change of it."""
        motion = self.motion
        if motion is None or motion(name, np.array([t - MOVING_S, t]), track.place, track.t) is None:
            return track.course, 2

        def path(at: Floats) -> Floats:
            places = motion(name, at, track.place, track.t)
            return track.course(at) if places is None else places

        return path, 1

    def _fit_over(self, name: str, path: Path, since: float, *, order: int, reach: int = REACH) -> Fitted | None:
        used = [item for item in self._frames if item[0] >= since]
        config, wave = self.config, self._waves[name]
        return fit_beacon(
            [item[1] for item in used],
            np.array([item[0] for item in used]),
            path,
            wave,
            self._starts(wave),
            self._table,
            exposure=config.exposure_s,
            row_time=config.row_time_s,
            order=order,
            reach=reach,
        )

    def _starts(self, wave: Wave) -> Floats:
        """Around the start that is known; the clocks of robot and camera drift by less than a millisecond a second."""
        if self.start is None:
            return np.arange(0.0, 1.0 / wave.hz, 0.010)
        return self.start + np.arange(-0.020, 0.0201, 0.005)

    def _passes(self, fitted: Fitted) -> bool:
        """Whether the light is the beacon's, and lies where it was looked for."""
        level = np.log(self.config.false_alarm / FOLLOW_TRIALS)
        low, high = WIDTHS
        return bool(
            fitted.lock.log_p < level and 1.05 * low < fitted.width < 0.95 * high and np.trace(fitted.covariance) < 1.0
        )


def _resting(t: float, place: Floats) -> Course:
    return Course(t, np.stack([place, np.zeros(2), np.zeros(2)]), STILL_S)
