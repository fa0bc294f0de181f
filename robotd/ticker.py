"""Calling a function at even times: `Hardware.ticker`, in a thread for real devices and on the loop for simulated ones.

The thread is there because a callback can hold the event loop for ten milliseconds, longer than a roof camera can bear.
It asks to be scheduled before ordinary threads (round robin, the lowest real-time priority), because on busy cores a
thread that wakes up may otherwise wait for the time slices of several others; it needs some microseconds each time.
Where that is not allowed (it takes LimitRTPRIO=1 and RestrictRealtime=no in the unit) it runs as others do. What
remains is Python code that holds the interpreter.

Deadlines are absolute: start + k * period, so that lateness never adds up.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
from collections.abc import Callable, Iterator

log = logging.getLogger(__name__)

PRIORITY = 1  # the lowest of real time: before every ordinary thread, after all others
CLOSE_S = 1.0  # for a call that is under way when the ticker is closed


@contextlib.contextmanager
def prompt_threads() -> Iterator[None]:
    """Threads that are started inside, also by libraries, are scheduled before ordinary ones where that is allowed."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY))
    except OSError as error:
        hint = "set LimitRTPRIO=1 and RestrictRealtime=no in the unit"
        log.debug("threads have no real-time priority: %s; %s", error, hint)
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


class _Ticks:
    """Which call is due when: function(k) at start + k * period; numbers whose time has passed whole are left out."""

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self.start = start
        self.number = 0

    @property
    def due(self) -> float:
        return self.start + self.number * self.period

    def advance(self, t: float) -> None:
        """To the tick in which `t` lies, but at least to the next."""
        self.number = max(self.number + 1, int((t - self.start) / self.period))


class ThreadTicker:
    """See robotd.hardware.Ticker; calls in a thread of its own."""

    def __init__(self, period: float, function: Callable[[int], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._function = function
        self._ticks = _Ticks(period, self._loop.time())
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="ticker", daemon=True)
        with prompt_threads():
            self._thread.start()

    async def wait(self) -> None:
        """Until the function failed: raises what it raised."""
        await asyncio.shield(self._ended)

    def close(self) -> None:
        """No call begins after this; safe to call twice."""
        self._stop.set()
        self._thread.join(CLOSE_S)
        _dispose(self._ended)

    def _work(self) -> None:
        ticks, now = self._ticks, self._loop.time
        try:
            while not self._stop.wait(max(0.0, ticks.due - now())):
                self._function(ticks.number)
                ticks.advance(now())
        except Exception as error:
            with contextlib.suppress(RuntimeError):  # the loop is gone: nobody is left to be told
                self._loop.call_soon_threadsafe(_fail, self._ended, error)


class LoopTicker:
    """See robotd.hardware.Ticker; calls on the event loop, so that virtual time drives it."""

    def __init__(self, period: float, function: Callable[[int], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[None] = self._loop.create_future()
        self._function = function
        self._ticks = _Ticks(period, self._loop.time())
        self._timer = self._loop.call_soon(self._work)

    async def wait(self) -> None:
        """Until the function failed: raises what it raised."""
        await asyncio.shield(self._ended)

    def close(self) -> None:
        """No call begins after this; safe to call twice."""
        self._timer.cancel()
        _dispose(self._ended)

    def _work(self) -> None:
        try:
            self._function(self._ticks.number)
        except Exception as error:
            _fail(self._ended, error)
            return
        self._ticks.advance(self._loop.time())
        self._timer = self._loop.call_at(self._ticks.due, self._work)


def _fail(ended: asyncio.Future[None], error: Exception) -> None:
    if not ended.done():
        ended.set_exception(error)


def _dispose(ended: asyncio.Future[None]) -> None:
    if ended.done() and not ended.cancelled():
        ended.exception()  # because an exception that nobody was waiting for is no news after closing
    ended.cancel()
