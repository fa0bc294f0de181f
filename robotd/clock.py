"""Time: the event loop is the only clock.

Everything that waits, waits on the running loop (`loop.time()`, `asyncio.sleep`, `ticks`). The simulator runs the same
code on a `VirtualLoop`, whose clock jumps to the next timer as soon as nothing is ready, so that an hour of mission
takes seconds. Whoever waits for something that lives in real time (a thread, the server, a disk) does so inside
`outside()`: while any such block is open virtual time stands still, as if the wait had taken no time at all.
On an ordinary loop `outside()` does nothing.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def now() -> float:
    """Seconds on the running loop's monotonic clock."""
    return asyncio.get_running_loop().time()


async def ticks(period: float) -> AsyncIterator[int]:
    """Yield 0, 1, 2, ... at start + k * period seconds: absolute deadlines, so there is no drift.

    A consumer that is late skips no number, it just gets the next ones at once.
    """
    loop = asyncio.get_running_loop()
    start = loop.time()
    tick = 0
    while True:
        await asyncio.sleep(max(0.0, start + tick * period - loop.time()))
        yield tick
        tick += 1


@contextmanager
def outside() -> Iterator[None]:
    """Hold virtual time while something outside the loop is awaited."""
    loop = asyncio.get_running_loop()
    if isinstance(loop, VirtualLoop):
        with loop.held():
            yield
    else:
        yield


async def in_thread(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Run a blocking function in the loop's default executor, with virtual time held."""
    return await in_executor(None, function, *args, **kwargs)


async def in_executor(executor: Executor | None, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Run a blocking function in `executor`, with virtual time held."""
    loop = asyncio.get_running_loop()
    with outside():
        return await loop.run_in_executor(executor, lambda: function(*args, **kwargs))


def stall(seconds: float) -> None:
    """Let so much virtual time pass while nothing else runs, as while a callback computes for too long.

    What was due meanwhile comes late. On an ordinary loop nothing happens: there lateness comes by itself.
    """
    loop = asyncio.get_running_loop()
    if isinstance(loop, VirtualLoop):
        loop.jump(seconds)


class _VirtualSelector(selectors.DefaultSelector):
    """Polls the real files; when none is ready it moves the loop's clock on by the time-out instead of waiting."""

    def __init__(self) -> None:
        super().__init__()
        self.time = 0.0
        self.holds = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        if ready or (timeout is not None and timeout <= 0):
            return ready
        if self.holds or timeout is None:  # something in real time must happen first
            return super().select(None)
        self.time += timeout
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop whose clock jumps from timer to timer and stands still while a hold is open."""

    def __init__(self) -> None:
        self._virtual = _VirtualSelector()
        super().__init__(self._virtual)

    def time(self) -> float:
        return self._virtual.time

    def jump(self, seconds: float) -> None:
        """Move the clock on although timers are due meanwhile."""
        self._virtual.time += seconds

    async def shutdown_default_executor(self, *args: Any, **kwargs: Any) -> None:
        """As on any loop, with time held: its time-out is about threads, which live in real time."""
        with self.held():
            await super().shutdown_default_executor(*args, **kwargs)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Time stands still inside; holds nest and overlap."""
        self._virtual.holds += 1
        try:
            yield
        finally:
            self._virtual.holds -= 1


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end in virtual time, starting at time 0."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main)
