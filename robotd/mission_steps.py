"""The steps of a mission: each runs until a fault, a shortage or an operator interrupts it, and is repeated then.

Whatever interrupts a step halts the robot at once. A device that fails is waited for; what runs out (battery, disk) is
waited for, too, and the mission goes on by itself if nobody has touched the robot meanwhile; an operator's pause, and
while one attends everything that would end the mission, waits for `resume`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from typing import Any, TypeVar

from .bus import Bus
from .clock import now
from .errors import DriverFault, MissionError, StorageError
from .mission_states import States
from .plugin import Base, Follower
from .records import Event, MissionState, MissionStatus, Withdrawal

T = TypeVar("T")

STANDSTILL_M_S, STANDSTILL_RAD_S = 0.002, 0.02
FAULT_WAIT_S = 60.0
HELD_S = 1.0  # wheels held by the safety layer for so long while driving end the mission
GO_ON_S = 3.0  # what a pause waits for must be so for so long, before the robot moves by itself
STORAGE_S = 10.0  # after a record that the disk did not take, until it is tried again
MOVED_M = 0.02  # a robot that rolled so far in a pause is somewhere else


def _nothing() -> None:
    return None


@dataclass(frozen=True, slots=True)
class Health:
    """What the mission asks of the daemon; each returns the reason in words, or None.

    `fault()`: are all devices well; `hazard()`: does anything stop the wheels; `held()`: is the robot held until
    somebody releases it; `shortage()`: does anything run out; `insist()` says that an operator goes on in spite of it.
    """

    fault: Callable[[], str | None]
    hazard: Callable[[], str | None]
    held: Callable[[], str | None] = _nothing
    shortage: Callable[[], str | None] = _nothing
    insist: Callable[[], None] = _nothing


@dataclass(frozen=True, slots=True)
class Pause:
    """Why the mission stands still; `over` says whether that has passed, None: only an operator can say."""

    cause: str
    over: Callable[[], bool] | None = None


class _Paused(Exception):
    """The mission is to stand still."""


class _Aborted(MissionError):
    """An operator has ended the mission."""


class Steps:
    """What a mission is made of; the mission itself says which steps there are, and notes where it is.

    Parameters
    ----------
    base, follower
        What moves the robot.
    number, most : int
        The stop at hand, and how many there are.
    is_attended : bool
        An operator is there, who can mend what would end the mission: it pauses instead.
    """

    def __init__(
        self, bus: Bus, base: Base, follower: Follower, health: Health, *, number: int, most: int, is_attended: bool
    ) -> None:
        self.bus = bus
        self.base = base
        self.follower = follower
        self.health = health
        self.is_attended = is_attended
        self._number = number
        self._most_stops = most
        self._states = States()
        self._noted: tuple[MissionState, int] | None = None
        self._pause: Pause | None = None
        self._aborted: str | None = None
        self._by_hand = 0.0  # metres that were not driven along the line
        self._was_lifted = False

    async def _note(self, state: MissionState, paused: str | None = None) -> None:
        """Put on the disk what the mission does, and why it is paused; raises StorageError."""
        raise NotImplementedError

    # ---- an operator's wishes ----------------------------------------------------------------------------------------

    @property
    def paused(self) -> str | None:
        """Why the mission stands still until somebody resumes it, or what it waits for is there."""
        return None if self._pause is None else self._pause.cause

    def pause(self, cause: str) -> None:
        """Halt now and stand still until `resume`, whatever it is doing; that step is repeated then."""
        self.is_attended = True
        if self._pause is None or self._pause.over is not None:  # else it stands, or is driven by hand
            self._pause = Pause(cause)
            self._halt(cause)

    def resume(self) -> None:
        """Go on, whatever the pause waits for."""
        self.is_attended = True
        self.health.insist()
        self._pause = None

    def abort(self, cause: str) -> None:
        """Halt now and end; the stops that were made stay."""
        self._aborted = cause
        self._halt(cause)

    # ---- faults and pauses -------------------------------------------------------------------------------------------

    async def _step(self, state: MissionState, stop: int, step: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """Run a step; when it is interrupted wait, and repeat it.

        Raises MissionError when the step cannot be done: line lost, wheels stopped by the safety layer, or a device
        that stays dead for FAULT_WAIT_S. If an operator attends, that is for the operator to mend.
        """
        self._number = stop
        while True:
            try:
                try:
                    if self._noted != (state, stop):
                        await self._note(state)
                        self._noted = state, stop
                    self._tell(state)
                    return await _first(step(), self._trouble(state))
                except DriverFault as fault:
                    self._halt(str(fault))
                    self._tell("paused", str(fault))
                    await self._wait_healthy(str(fault))
            except _Paused:
                await self._wait_resumed()
            except StorageError as error:
                again = now() + STORAGE_S
                self._pause = self._pause or Pause(str(error), lambda again=again: now() >= again)  # type: ignore[misc]
                await self._wait_resumed()
            except MissionError as error:
                if not self.is_attended or isinstance(error, _Aborted):
                    raise
                self._pause = self._pause or Pause(str(error))
                await self._wait_resumed()

    def _halt(self, cause: str) -> None:
        """Zero velocity at once, and the follower's wish to move no longer counts."""
        self.base.halt()
        self.bus.withdrawals.publish(Withdrawal(now(), self.follower.name, cause))

    async def _trouble(self, state: MissionState) -> Any:
        """Never returns; raises DriverFault when a device fails, MissionError when the robot is lifted or the wheels
        are held for HELD_S, and what an operator wants. What runs out matters before driving on, not at a stop.
        """
        since: float | None = None
        while True:
            self._heed_abort()
            if state == "driving" and self._pause is None and (short := self.health.shortage()) is not None:
                self._pause = Pause(short, lambda: self.health.shortage() is None)
            if self._pause is not None:
                raise _Paused
            await asyncio.sleep(0.05)
            if state == "idle":
                continue
            if (lifted := self._note_lift()) is not None:
                raise MissionError(f"halted: {lifted}")
            if (fault := self.health.fault()) is not None:
                raise DriverFault(fault)
            hazard = self.health.hazard()
            since = None if hazard is None else now() if since is None else since
            if state == "driving" and since is not None and now() - since >= HELD_S:
                raise MissionError(f"halted: {hazard}")

    async def _wait_resumed(self) -> None:
        """Stand still until an operator resumes, or what it waits for is there and nobody has moved the robot.

        What is driven by hand meanwhile is no way along the line.
        """
        before = self._travelled
        rest: float | None = None  # metres travelled when it had come to rest
        told: Pause | None = None
        fine: float | None = None
        while (pause := self._pause) is not None:
            if pause is not told:
                told = await self._begin_pause(pause, told)
            self._heed_abort()
            is_lifted = self._note_lift() is not None
            if rest is None and self._stands:
                rest = self._travelled
            if pause.over is not None:
                if is_lifted or (rest is not None and self._travelled - rest > MOVED_M):
                    self._pause = Pause(f"{pause.cause}; it was moved meanwhile: robotctl mission resume")
                is_fine = rest is not None and pause.over() and self._is_free()
                fine = None if not is_fine else now() if fine is None else fine
                if fine is not None and now() - fine >= GO_ON_S and self._pause is pause:
                    self._pause, before = None, self._travelled
            await asyncio.sleep(0.05)
        self._by_hand += self._travelled - before
        self._noted = None
        self._say("goes on")

    async def _begin_pause(self, pause: Pause, before: Pause | None) -> Pause:
        """Halt, and say why; the journal keeps what only an operator can end, for a daemon that is started again."""
        if before is None:  # else it stands, or is driven by hand or docking
            self._halt(pause.cause)
        self._tell("paused", pause.cause)
        if before is None or before.cause != pause.cause:
            self._say(f"paused: {pause.cause}", "warning")
        if pause.over is None:
            try:
                await self._note(self._noted[0] if self._noted is not None else "idle", pause.cause)
            except StorageError as error:
                self._say(str(error), "warning")
        return pause

    @property
    def _travelled(self) -> float:
        state = self.bus.odometry.latest
        return 0.0 if state is None else state.travelled

    @property
    def _stands(self) -> bool:
        state = self.bus.odometry.latest
        return state is not None and abs(state.speed) <= STANDSTILL_M_S and abs(state.turn_rate) <= STANDSTILL_RAD_S

    def _is_free(self) -> bool:
        """Whether nothing at all speaks against moving."""
        frame = self.bus.sensors.latest
        if frame is None or self.health.fault() is not None or self.health.held() is not None:
            return False
        touched = frame.bump_left or frame.bump_right or frame.cliff or frame.wheel_drop_left or frame.wheel_drop_right
        return not (touched or frame.docked or frame.charging)

    def _note_lift(self) -> str | None:
        """A lifted robot is put down somewhere else, which no wheel tells: the leg ends. Returns which wheel hangs."""
        frame = self.bus.sensors.latest
        if frame is None or not (frame.wheel_drop_left or frame.wheel_drop_right):
            return None
        self._was_lifted = True
        return f"the {'left' if frame.wheel_drop_left else 'right'} wheel has dropped"

    def _heed_abort(self) -> None:
        if self._aborted is not None:
            raise _Aborted(self._aborted)

    async def _wait_healthy(self, fault: str) -> None:
        deadline = now() + FAULT_WAIT_S
        await asyncio.sleep(0.5)
        while self.health.fault() is not None:
            self._heed_abort()
            if self._pause is not None:
                raise _Paused
            self._note_lift()
            if now() > deadline:
                raise MissionError(f"{fault}; it did not come back within {FAULT_WAIT_S:g} s")
            await asyncio.sleep(0.2)

    # ---- words -------------------------------------------------------------------------------------------------------

    def _tell(self, state: MissionState, text: str = "") -> None:
        self._states.enter(state)
        self.bus.status.publish(MissionStatus(now(), state, self._number, self._most_stops, text))

    def _say(self, text: str, level: Any = "info") -> None:
        self.bus.events.publish(Event(now(), "mission", level, text))


async def _first(work: Coroutine[Any, Any, T], guard: Awaitable[Any]) -> T:
    """The result of `work`, unless `guard` raises first; the other one is cancelled and awaited."""
    working = asyncio.ensure_future(work)
    guarding = asyncio.ensure_future(guard)
    try:
        await asyncio.wait({working, guarding}, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
        guarding.result()
        raise AssertionError("a guard ends only by raising")
    finally:
        for task in (working, guarding):
            task.cancel()
        await asyncio.gather(working, guarding, return_exceptions=True)
