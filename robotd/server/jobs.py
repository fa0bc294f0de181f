"""Solving in a process of its own, so that the server goes on answering and outlives whatever happens to the solver."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

from ..errors import RobotdError
from .roof import with_notes
from .store import Store

if TYPE_CHECKING:
    from ..records import Survey
    from ..solver import GrowingMap

Solve = Callable[[bytes, str], bytes]

log = logging.getLogger("robotd.server")

_MOST_GROWING = 4  # surveys at a time; a map of 1000 stops holds about 100 MB
_growing: dict[str, GrowingMap] = {}  # in the worker process


class JobError(RobotdError):
    """The solver process ended without an answer."""


def solve_json(survey: bytes, where: str) -> bytes:
    """From `robotd-survey/1` to `robotd-map/1`; raises InputError or SolverError. Runs in the worker process.

    The maps of the last surveys are kept, so that the map of a survey with one stop more grows from the last one.
    """
    from ..files import map_to_json, survey_from_json
    from ..solver import GrowingMap

    record = survey_from_json(survey, where)
    growing = _growing.pop(record.survey, None)
    if growing is None or not _continues(record, growing.survey):
        growing = GrowingMap(record)
    else:
        for stop in record.stops[len(growing.survey.stops) :]:
            growing.add_stop(stop)
    result = map_to_json(growing.map())
    _growing[record.survey] = growing
    while len(_growing) > _MOST_GROWING:
        del _growing[next(iter(_growing))]
    return result


def _continues(survey: Survey, earlier: Survey) -> bool:
    """Whether it is the earlier survey with more stops at its end."""
    return replace(survey, stops=survey.stops[: len(earlier.stops)]) == earlier


def worker_pool() -> Executor:
    """One worker process, which starts with the first job and ends with this process, however that ends."""
    return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)


class MapJobs:
    """Maps of stored surveys, each solved once per revision; requests for the same map share one job.

    Parameters
    ----------
    store : Store
    solve : callable
        From a survey's bytes and name to a map's bytes.
    executor : callable
        Makes the executor when the first job comes, and again after its process died.
    """

    def __init__(
        self, store: Store, *, solve: Solve = solve_json, executor: Callable[[], Executor] = worker_pool
    ) -> None:
        self._store = store
        self._solve = solve
        self._make = executor
        self._executor: Executor | None = None
        self._running: dict[tuple[str, str], asyncio.Task[bytes]] = {}
        self._following: dict[str, asyncio.Task[None]] = {}
        self._stale: set[str] = set()

    async def map(self, name: str) -> bytes:
        """The map of a survey as it is now, solved if need be.

        Raises
        ------
        UnknownSurveyError, InputError, SolverError, StoreError
            As the store and the solver do.
        JobError
            If the solver process dies.
        """
        survey, revision = await asyncio.to_thread(self._store.survey, name)
        known = await asyncio.to_thread(self._store.map, name, revision)
        if known is not None:
            return known
        key = name, revision
        if key not in self._running:
            self._running[key] = asyncio.create_task(self._run(name, revision, survey))
            self._running[key].add_done_callback(lambda _: self._running.pop(key))
        return await asyncio.shield(self._running[key])  # a client that leaves does not take the others' job along

    async def _run(self, name: str, revision: str, survey: bytes) -> bytes:
        if self._executor is None:
            self._executor = self._make()
        executor = self._executor
        try:
            solved = await asyncio.get_running_loop().run_in_executor(executor, self._solve, survey, f"survey {name!r}")
        except BrokenExecutor as error:
            if self._executor is executor:
                self._executor = None
            raise JobError(f"survey {name!r}: the solver process died (out of memory?); ask again") from error
        solved = with_notes(solved, await asyncio.to_thread(self._store.notes, name))
        await asyncio.to_thread(self._store.put_map, name, revision, solved)
        return solved

    def begin(self, name: str) -> None:
        """Solve a survey as it is now in the background, so that its map is there when somebody asks for it.

        While that takes its time, stops may come as they like: one more run then takes them all in.
        """
        self._stale.add(name)
        if name not in self._following:
            self._following[name] = asyncio.create_task(self._follow(name))

    async def _follow(self, name: str) -> None:
        try:
            while name in self._stale:
                self._stale.discard(name)
                try:
                    await self.map(name)
                except RobotdError as error:  # whoever asks for the map will be told
                    log.info("no map after the last stop: %s", error)
                except Exception:
                    log.exception("no map of survey %r after its last stop", name)
        finally:
            del self._following[name]

    def close(self) -> None:
        """Drop what is running."""
        for task in (*self._running.values(), *self._following.values()):
            task.cancel()
        executor, self._executor = self._executor, None
        if executor is None:
            return
        processes = list((getattr(executor, "_processes", None) or {}).values())
        executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the server decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
