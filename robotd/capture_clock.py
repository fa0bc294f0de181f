"""When a network camera took its frames, in loop time.

What is known is when frames arrived: after the exposure by the time for encoding and for the network, which has a
smallest value and is else random, never less. Plotted against the camera's own time, arrivals lie above a line whose
slope is the rate of the two clocks and whose height is the offset plus that smallest delay. The line is found as the
edge of the lower convex hull over the middle of the last half minute, which is the line below all arrivals with the
least mean distance to them (Moon, Skelly and Towsley, Estimation and removal of clock skew from network delay
measurements, INFOCOM 1999).

Where the camera sends no stamps, frames are exposed evenly all the same, however unevenly they arrive: a phase-locked
loop of second order follows their period and the mean delay (gains as for critical damping). A frame that comes later
than frames usually do follows lost ones; where the frames after it show that it was only late, or that more were lost
than it seemed, the loop is moved by whole periods.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from datetime import datetime
from itertools import pairwise

import numpy as np

from .records import Floats

WINDOW_S = 30.0
BUCKET_S = 0.25  # of which the quickest arrival counts
RELIABLE_S = 5.0  # of arrivals before the rate is trusted to them
SKEW = 300e-6  # relative: more than two quartz clocks differ
EARLY_S = 0.2  # before the line by so much: the camera's clock was set
LATE_S = 0.5  # all of 3 s behind the line by so much: the same
LATE_BUCKETS = 12
STUCK_STAMPS = 4  # out of sixteen that do not advance: the stamps are too coarse to be used
HASTY, HASTY_FRAMES = 4, 64  # the camera's clock is set so often within so few frames: it is no clock
STEP_S = 1e-4  # at least so much between two frames
FIRST_FRAMES = 12  # without stamps: before the period is known
GAIN = 0.03  # of the loop: it averages some thirty frames
LOST_PERIODS = 0.6  # a frame so late is taken for a later one, if frames usually come sooner
SURE_FRAMES = 8  # that agree before the loop is moved by a period
LATE_FACTOR = 4.0  # times the usual deviation, for cameras whose frames usually come late
RECENT = 64  # frames: if a third of them moved the loop, the rate of the camera has changed


STAMP_HEADERS = ("x-timestamp", "x-capture-time", "x-frame-time", "x-time", "timestamp")
UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # from which value on a number counts ns, us, ms since 1970


def capture_stamp(headers: Mapping[str, str], name: str | None = None) -> float | None:
    """The time of capture that a part's headers (names in lower case) tell, in seconds; None if they tell none.

    `name` is the header to look at instead of the usual ones. Understood are numbers of seconds, and of milli-, micro-
    and nanoseconds since 1970, and dates as in RFC 3339.
    """
    for key in (name.lower(),) if name is not None else STAMP_HEADERS:
        text = headers.get(key, "").strip()
        if not text:
            continue
        try:
            value = float(text)
        except ValueError:
            try:
                value = datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp()
            except (ValueError, OverflowError):
                continue
        if np.isfinite(value):
            return value * next((unit for least, unit in UNITS if abs(value) >= least), 1.0)
    return None


class _Envelope:
    """The line below the arrivals."""

    def __init__(self) -> None:
        self.slope = 1.0
        self.height = float("inf")
        self._points: deque[tuple[float, float]] = deque()
        self._bucket: tuple[float, float] | None = None
        self._bucket_end = 0.0
        self._excess: deque[float] = deque(maxlen=LATE_BUCKETS)

    def at(self, x: float) -> float:
        return self.height + self.slope * x

    @property
    def is_left_behind(self) -> bool:
        """Nothing has come near the line for seconds."""
        return len(self._excess) == LATE_BUCKETS and min(self._excess) > LATE_S

    def add(self, x: float, y: float) -> None:
        if self._bucket is None or y >= self._bucket_end:
            self._close()
            self._bucket_end = y + BUCKET_S
        if self._bucket is None or y - self.slope * x < self._bucket[1] - self.slope * self._bucket[0]:
            self._bucket = x, y
        self.height = min(self.height, y - self.slope * x)

    def _close(self) -> None:
        if self._bucket is None:
            return
        x, y = self._bucket
        self._points.append(self._bucket)
        self._excess.append(y - self.at(x))
        self._bucket = None
        while y - self._points[0][1] > WINDOW_S:
            self._points.popleft()
        points = np.array(self._points)
        if y - points[0, 1] >= RELIABLE_S:
            self.slope = float(np.clip(_middle_slope(points), 1.0 - SKEW, 1.0 + SKEW))
        self.height = float(np.min(points[:, 1] - self.slope * points[:, 0]))


def _middle_slope(points: Floats) -> float:
    """Slope of the lower hull of (N, 2) points, increasing in x, over their mean x."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) >= 2:
            (ax, ay), (bx, by) = hull[-2:]
            if (by - ay) * (x - bx) < (y - by) * (bx - ax):
                break
            hull.pop()
        hull.append((x, y))
    middle = float(points[:, 0].mean())
    for (ax, ay), (bx, by) in pairwise(hull):
        if bx >= middle:
            return (by - ay) / (bx - ax)
    return 1.0


class _Evener:
    """Dates frames that carry no stamp by a phase-locked loop."""

    def __init__(self) -> None:
        self._moves: deque[int] = deque()  # at which frames the loop was moved
        self._first: list[float] = []
        self._count = 0
        self._t = self._period = self._usual = 0.0
        self._recent: deque[float] = deque(maxlen=SURE_FRAMES)

    def date(self, arrived: float) -> float:
        self._count += 1
        if self._count <= FIRST_FRAMES:
            self._first.append(arrived)
            if self._count == FIRST_FRAMES:
                numbers = np.arange(FIRST_FRAMES) - (FIRST_FRAMES - 1)
                self._period, self._t = map(float, np.polyfit(numbers, self._first, 1))
            return arrived
        period = self._period
        late = arrived - (self._t + period)
        most = max(LOST_PERIODS * period, LATE_FACTOR * self._usual)
        lost = 0
        if late > most:
            lost = int(late / period + 1.0 - LOST_PERIODS)
        elif late < -0.5 * period:  # it cannot have come before it was taken: fewer were lost than it seemed
            lost = round(late / period)
            self._moves.append(self._count)
        late -= lost * period
        self._recent.append(late)
        if len(self._recent) == SURE_FRAMES and (least := min(self._recent)) > 0.5 * period:
            lost += round(least / period)
            late -= round(least / period) * period
            self._recent.clear()
            self._moves.append(self._count)
        late = min(max(late, -most), most)
        self._usual += 0.05 * (min(abs(late), period) - self._usual)
        gain = max(GAIN, 1.5 / (self._count - FIRST_FRAMES + 3))
        self._t += (1 + lost) * period + gain * late
        self._period += gain * gain / 4.0 * late
        return min(arrived, self._t)

    @property
    def is_lost(self) -> bool:
        """It is moved again and again, because the rate has changed."""
        while self._moves and self._count - self._moves[0] > RECENT:
            self._moves.popleft()
        return len(self._moves) > RECENT // 3


class CaptureClock:
    """Dates the frames of one camera.

    Parameters
    ----------
    delay : float
        Seconds from the exposure to the arrival: of the quickest frames if the camera sends stamps, else of the mean;
        it cannot be observed.

    Attributes
    ----------
    uses_stamps : bool or None
        None before the first frame; False for good once stamps have proved useless.
    restarts : int
        How often the camera's clock or rate was seen to change.
    """

    def __init__(self, delay: float = 0.0) -> None:
        self.delay = delay
        self.uses_stamps: bool | None = None
        self.restarts = 0
        self._stuck: deque[bool] = deque(maxlen=16)
        self._last = float("-inf")
        self._frames = self._hasty = 0
        self.restart()

    def restart(self) -> None:
        """The connection is a new one: nothing is known of its delays."""
        self._line: _Envelope | None = None
        self._evener = _Evener()
        self._base = 0.0
        self._last_stamp: float | None = None

    def date(self, arrived: float, stamp: float | None = None) -> float:
        """Loop time of a frame's exposure.

        Parameters
        ----------
        arrived : float
            Loop time at which the frame began to arrive.
        stamp : float, optional
            The camera's own time of it, seconds since anything.

        Returns
        -------
        float
            Seconds, after every earlier frame's, and not after `arrived` but for frames that arrive together.
        """
        self._frames += 1
        if stamp is not None and self.uses_stamps is not False:
            self.uses_stamps = True
            self._stuck.append(self._last_stamp is not None and stamp == self._last_stamp)
            if sum(self._stuck) >= STUCK_STAMPS:
                self._change(uses_stamps=False)
        elif self.uses_stamps is not False:
            self.uses_stamps = False
            self.restart()
        if self.uses_stamps and stamp is not None:
            t = self._by_stamp(arrived, stamp)
        else:
            if self._evener.is_lost:
                self._change(uses_stamps=False)
            t = self._evener.date(arrived)
        self._last = max(t - self.delay, self._last + STEP_S)
        return self._last

    def _change(self, *, uses_stamps: bool) -> None:
        self.restarts += 1
        self._frames = 0
        self.uses_stamps = uses_stamps
        self.restart()

    def _by_stamp(self, arrived: float, stamp: float) -> float:
        if self._line is not None:
            is_back = self._last_stamp is not None and stamp < self._last_stamp
            is_early = arrived < self._line.at(stamp - self._base) - EARLY_S
            if is_back or is_early or self._line.is_left_behind:
                self._hasty = self._hasty + 1 if self._frames < HASTY_FRAMES else 0
                self._change(uses_stamps=self._hasty < HASTY)
                if not self.uses_stamps:
                    return self._evener.date(arrived)
        if self._line is None:
            self._line = _Envelope()
            self._base = stamp
        self._last_stamp = stamp
        self._line.add(stamp - self._base, arrived)
        return self._line.at(stamp - self._base)
