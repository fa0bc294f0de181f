"""When the robot took the values of a stream frame, and how many frames were lost or late.

The robot takes values every 15 ms and sends them at once. What we know is when bytes arrived: later by the time on
the line, and by any delay of adapter and computer, which is never negative. So the last frame of what arrived
together is dated back by its own bytes, those before it by a tick each, and a frame is never dated later than the
tick after the one before it allows: delays come and go, the robot's clock does not jump.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..oi import TICK

DRIFT = 0.005  # relative: more than a robot's clock is off, so that a lasting change of the delay is followed
LATE_S = 0.010
WINDOW = 32  # frames, of which at least one comes without delay


class StreamClock:
    """Dates the frames of one stream.

    Parameters
    ----------
    baud : int
        Ten bits a byte.
    frame_size : int
        Bytes of a frame, header and checksum included.

    Attributes
    ----------
    missing : int
        Ticks without a good frame: damaged or lost. Known after half a second: a lost frame shifts all that follow by
        a tick, a late one only itself, so that the least lateness of some 30 frames tells them apart.
    late : int
        Frames that arrived more than 10 ms later than their bytes, with those of damaged ones before them, and the pace
        of the others explain.
    """

    def __init__(self, baud: int, frame_size: int) -> None:
        self.missing = self.late = 0
        self._byte = 10.0 / baud
        self._size = frame_size
        self._last = 0.0
        self._end: int | None = None  # of the last frame, in bytes fed
        self.restart()

    def stamps(self, arrived: float, ends: Sequence[int], fed: int, *, begun: bool = False) -> list[float]:
        """Loop times at which the robot took the values of the frames in one chunk of bytes.

        Parameters
        ----------
        arrived : float
            When the chunk's last byte arrived.
        ends : sequence of int
            For each frame the count of bytes up to and with its last one, increasing.
        fed : int
            The count of bytes up to and with the chunk's last one.
        begun : bool
            Whether the bytes after the last frame are the beginning of the next one.

        Returns
        -------
        list of float
            Seconds; never before the frame before.
        """
        rest = (fed - ends[-1]) * self._byte
        measured = arrived - rest - self._size * self._byte
        if begun:
            measured = min(measured, arrived - rest - TICK)
        befores = [ends[0] - self._size if self._end is None else self._end, *ends]
        ticks = [max(1, round((end - before) / self._size)) for before, end in zip(befores, ends, strict=False)]
        self._end = ends[-1]
        dates = [measured]
        for passed in ticks[:0:-1]:
            dates.append(dates[-1] - passed * TICK)
        return [self._settle(date, passed) for date, passed in zip(reversed(dates), ticks, strict=True)]

    def restart(self) -> None:
        """The stream was interrupted: its pace begins anew."""
        self._estimate: float | None = None
        self._end = None
        self._due: float | None = None  # when the last frame should have come if none was lost
        self._least, self._counted = math.inf, 0  # lateness, frames of the present window

    def _count(self, measured: float) -> None:
        if self._due is None:
            self._due = measured
            return
        self._due += TICK
        self._least = min(self._least, measured - self._due)
        self._due = min(self._due, measured)
        self._counted += 1
        if self._counted >= WINDOW:
            lost = max(0, round(self._least / TICK))
            self.missing += lost
            slow = min(max(0.0, self._least - lost * TICK), WINDOW * DRIFT * TICK)  # the robot's clock, or the delay
            self._due += lost * TICK + slow
            self._least, self._counted = math.inf, 0

    def _settle(self, measured: float, ticks: int) -> float:
        """The date of a frame that was taken `ticks` after the last one, by the bytes between them."""
        self._count(measured)
        before = self._estimate
        if before is None:
            self._estimate = measured
        else:
            steps = round((measured - before) / TICK)
            self._estimate = min(measured, before + max(1, steps) * TICK * (1.0 + DRIFT))
            if measured - before - ticks * TICK > LATE_S:
                self.late += 1
        self._last = max(self._last, self._estimate)
        return self._last
