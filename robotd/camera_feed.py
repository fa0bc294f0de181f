"""What every camera has in common: a bounded queue of frames, and figures that say how well it does.

Frames go stale while they wait, so a full queue gives up its oldest one: a slow reader gets fewer, not older frames.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, fields

from .errors import DriverFault
from .hardware import CameraCounts
from .records import Frame

QUEUE = 4  # frames that wait for a slow reader
RATE_S = 2.0  # over which rate and age are taken

FEW = 0.8  # of the frames asked for: worth a word
MANY_BAD = 0.02  # of the frames
OLD_S = 0.5
COSTLY = 0.5  # of the time between two frames


class FrameQueue:
    """Frames that wait for a reader, or the reason why none comes any more; for one event loop.

    Parameters
    ----------
    counts : CameraCounts
        Frames that are given up are counted there.
    size : int
        How many may wait.
    """

    def __init__(self, counts: CameraCounts, size: int = QUEUE) -> None:
        self._frames: deque[Frame] = deque()
        self._counts = counts
        self._size = size
        self._fault: str | None = None
        self._wake = asyncio.Event()

    def put(self, frame: Frame) -> None:
        """Add the newest frame."""
        if len(self._frames) >= self._size:
            self._frames.popleft()
            self._counts.dropped += 1
        self._frames.append(frame)
        self._wake.set()

    def fail(self, reason: str) -> None:
        """No frame will follow; those that wait can still be taken."""
        self._fault = reason
        self._wake.set()

    def clear(self) -> None:
        """Forget the frames that wait."""
        self._frames.clear()

    async def get(self) -> Frame:
        """Wait for the oldest frame; raises DriverFault when none will come."""
        while not self._frames:
            if self._fault is not None:
                raise DriverFault(self._fault)
            self._wake.clear()
            await self._wake.wait()
        return self._frames.popleft()


@dataclass(frozen=True, slots=True)
class CameraCounters:
    """How a camera does.

    `rate` frames a second and `age` seconds from the stamp to the publication are means over the last 2 s, `decode_s`
    the mean for one frame; the others count since the driver was built. `streams` says how often it was started.
    """

    rate: float = 0.0
    age: float = 0.0
    published: int = 0
    lost: int = 0
    damaged: int = 0
    dropped: int = 0
    decode_s: float = 0.0
    streams: int = 0


class CameraMeter:
    """Keeps the figures of one camera driver."""

    def __init__(self) -> None:
        self._past = CameraCounts()
        self._now = CameraCounts()
        self._recent: deque[tuple[float, float]] = deque()  # when published, how old
        self._published = self._streams = 0
        self._begun = 0.0
        self._told = CameraCounters()
        self._told_at = 0.0

    def begin(self, counts: CameraCounts, t: float) -> None:
        """A stream has begun, which keeps these counts."""
        for item in fields(CameraCounts):
            setattr(self._past, item.name, getattr(self._past, item.name) + getattr(self._now, item.name))
        self._now = counts
        self._streams += 1
        self._recent.clear()
        self._begun = t
        self._told, self._told_at = self.read(t), t

    def add(self, frame: Frame, t: float) -> None:
        """A frame was published at loop time `t`."""
        self._published += 1
        self._recent.append((t, t - frame.t))
        self._forget(t)

    def read(self, t: float) -> CameraCounters:
        """The figures at loop time `t`."""
        self._forget(t)
        recent = self._recent
        span = min(RATE_S, t - self._begun)
        decoded = self._past.decoded + self._now.decoded
        return CameraCounters(
            rate=len(recent) / span if span > 0.0 else 0.0,
            age=sum(age for _, age in recent) / len(recent) if recent else 0.0,
            published=self._published,
            lost=self._past.lost + self._now.lost,
            damaged=self._past.damaged + self._now.damaged,
            dropped=self._past.dropped + self._now.dropped,
            decode_s=(self._past.decode_s + self._now.decode_s) / decoded if decoded else 0.0,
            streams=self._streams,
        )

    def complaints(self, t: float, fps: float | None) -> list[str]:
        """What was bad since the last call, in words; `fps` is the rate that was agreed, None if none was."""
        counters, before, seconds = self.read(t), self._told, t - self._told_at
        self._told, self._told_at = counters, t
        frames = counters.published - before.published
        every = max(1, frames + sum(_more(counters, before)))
        return list(_complaints(counters, _more(counters, before), frames, every, seconds, fps))

    def _forget(self, t: float) -> None:
        while self._recent and t - self._recent[0][0] >= RATE_S:
            self._recent.popleft()


def _more(counters: CameraCounters, before: CameraCounters) -> tuple[int, int, int]:
    return (
        counters.lost - before.lost,
        counters.damaged - before.damaged,
        counters.dropped - before.dropped,
    )


def _complaints(
    counters: CameraCounters, more: tuple[int, int, int], frames: int, every: int, seconds: float, fps: float | None
) -> Iterator[str]:
    lost, damaged, dropped = more
    if fps is not None and frames < FEW * fps * seconds:
        yield f"only {frames / seconds:.1f} of {fps:g} frames a second"
    if lost > MANY_BAD * every:
        yield f"{lost} of {every} frames never arrived: the bus or the network is too slow"
    if damaged > MANY_BAD * every:
        yield f"{damaged} of {every} frames are damaged: check cable, hub and power supply"
    if dropped > MANY_BAD * every:
        yield f"{dropped} of {every} frames were dropped: this computer is too slow for them"
    if counters.age > OLD_S:
        yield f"frames are {counters.age:.1f} s old when they come"
    if counters.decode_s * counters.rate > COSTLY:
        yield f"decoding takes {1e3 * counters.decode_s:.0f} ms a frame, most of a core"
