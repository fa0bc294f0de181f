"""The mission: drive the line, stop, have the labels flash, record what the cameras saw, go on.

    idle -> driving -> settling -> observing -> driving -> ... -> uploading -> done
      any of them -> paused (a device failed, or an operator's wish; the step is repeated) -> the state before
      any of them -> fault (line lost, bumper, emergency stop, a device stays dead, aborted) -> uploading -> done

An operator who started the mission is there to help: then what would end it pauses it, until `resume` or `abort`.

Every finished stop is in the journal before the robot moves on. A mission that ends early keeps and uploads the
stops it made, and the map says of each label without a position why it has none.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import replace
from datetime import UTC
from functools import partial
from typing import Any, Literal, TypeVar

from .bus import Bus, Subscription
from .clock import in_executor, in_thread, now
from .config import Calibration, MissionConfig
from .errors import DriverFault, MissionError
from .hardware import CameraMode, Hardware
from .identify import DelayModel, FlashRequest, Identifier, LabelMemory, Slot
from .journal import Journal
from .odometry import Odometry
from .plugin import Base, Camera, FollowEnd, Follower, Labels
from .records import Event, Frame, Map, MappedLabel, MissionStatus, Pose, Sighting, Stop, Survey, Withdrawal

T = TypeVar("T")
State = Literal["idle", "driving", "settling", "observing", "uploading", "paused", "fault", "done"]

FIRST_FRAME_S = 5.0  # a camera that shows nothing for so long after its start is at fault
STANDSTILL_M_S = 0.002
FAULT_WAIT_S = 60.0
HELD_S = 1.0  # wheels held by the safety layer for so long while driving end the mission


class Health:
    """What the mission asks of the daemon: are all devices well, and does anything stop the wheels?

    `fault()` and `hazard()` return the reason in words, or None.
    """

    def __init__(self, fault: Callable[[], str | None], hazard: Callable[[], str | None]) -> None:
        self.fault = fault
        self.hazard = hazard


class _Paused(Exception):
    """An operator wants the mission to stand still."""


class _Aborted(MissionError):
    """An operator has ended the mission."""


class Mission:
    """One run along the line.

    Parameters
    ----------
    config, calibration
        What to map (labels, stops) and with what (rig, priors).
    base, follower, labels, cameras
        The drivers; `cameras` holds the rig's by name, `eye` is the follower's camera.
    odometry : Odometry
        Dead reckoning since the start of the leg, kept up to date by the control loop.
    wake_upload
        Called after each record that waits to be uploaded.
    first_stop : int
        The stop at which the robot stands at the start; those before it are left out.
    is_attended : bool
        An operator is there, who can mend what would end the mission: it pauses instead.
    """

    def __init__(
        self,
        config: MissionConfig,
        calibration: Calibration,
        *,
        bus: Bus,
        hardware: Hardware,
        base: Base,
        follower: Follower,
        labels: Labels,
        cameras: Mapping[str, Camera],
        eye: Camera,
        odometry: Odometry,
        journal: Journal,
        health: Health,
        wake_upload: Callable[[], None],
        first_stop: int = 1,
        is_attended: bool = False,
    ) -> None:
        self.config = config
        self.calibration = calibration
        self.bus = bus
        self.hardware = hardware
        self.base = base
        self.follower = follower
        self.labels = labels
        self.cameras = dict(cameras)
        self.eye = eye
        self.odometry = odometry
        self.journal = journal
        self.health = health
        self.wake_upload = wake_upload
        self.leg = 1
        self.stops: list[Stop] = []
        self.ended: str | None = None  # why the mission ended early, in words
        self.is_over = False  # no step will follow
        self.first_stop = first_stop
        self.is_attended = is_attended
        self.paused: str | None = None  # by an operator, or by what an operator has to mend: why
        self._aborted: str | None = None
        self._number = first_stop  # of the stop at hand
        self._by_hand = 0.0  # metres that were not driven along the line
        self._was_lifted = False  # since the last stop
        self.undecided = 0  # lights of the present stop that got no name
        self.refused: dict[str, str] = {}  # labels that the label system does not take, with its reason
        identify = config.identify
        zones = [(zone.labels, zone.begin, zone.end) for zone in config.zones]
        self.memory = LabelMemory(config.labels, calibration.cameras, identify, zones)
        self._delays = DelayModel(identify)
        self._workers: ThreadPoolExecutor | None = None
        self._groups = config.camera_groups or (tuple(cameras),)

    async def begin(self) -> None:
        """Begin the leg in the journal; raises InputError if the survey cannot have another one."""
        config = self.config
        self._header = Survey(
            survey=config.survey,
            rig=self.calibration.rig,
            stops=(),
            created=self._utc(),
            sigmas=self.calibration.sigmas,
            priors=self.calibration.priors,
            known_labels=config.known_labels,
        )
        self.leg = await in_thread(self.journal.begin_leg, self._header)
        self.wake_upload()

    async def run(self) -> None:
        """Make every stop that can be made; afterwards `stops` and `ended` say what came of it. After `begin`."""
        with ThreadPoolExecutor(max_workers=max(1, len(self.cameras)), thread_name_prefix="blink") as self._workers:
            try:
                await self._ready()
                for number in range(self.first_stop, self._most_stops + 1):
                    if await self._through_faults("driving", number, partial(self._drive, number)) == "end":
                        text = f"the line ended after stop {number - 1}: all its markers are made"
                        self.bus.events.publish(Event(now(), "mission", "info", text))
                        break
                    await self._through_faults("settling", number, self._settle)
                    seen: list[tuple[Sighting, ...]] = []  # by each group of cameras
                    await self._through_faults("observing", number, partial(self._observe, seen))
                    await self._record(number, [sighting for group in seen for sighting in group])
            except MissionError as error:
                self.ended = str(error)
                self._halt(self.ended)
                self._status("fault", self._number, self.ended)
                self.bus.events.publish(Event(now(), "mission", "error", self.ended))
            finally:
                self.is_over = True
        self._status("uploading", self._number)

    # ---- an operator's wishes ----------------------------------------------------------------------------------------

    def pause(self, cause: str) -> None:
        """Halt now and stand still until `resume`, whatever it is doing; that step is repeated then."""
        if self.paused is None:
            self.paused = cause
        self._halt(cause)

    def resume(self) -> None:
        """Go on."""
        self.paused = None

    def abort(self, cause: str) -> None:
        """Halt now and end; the stops that were made stay."""
        self._aborted = cause
        self._halt(cause)

    # ---- the steps ---------------------------------------------------------------------------------------------------

    async def _ready(self) -> None:
        """Wait until every driver is open for the first time and the base talks."""
        self._status("idle", self.first_stop)
        deadline = now() + FAULT_WAIT_S
        while (fault := self.health.fault()) is not None or self.bus.odometry.latest is None:
            self._heed_abort()
            if now() > deadline:
                raise MissionError(fault or f"{self.base.name}: no sensor frame for {FAULT_WAIT_S:g} s")
            await asyncio.sleep(0.05)

    async def _drive(self, number: int) -> FollowEnd | None:
        """To the stop of that number; what ended the drive, or None if the robot is there already."""
        config, state = self.config, self.bus.odometry.latest
        at_marker = config.stop_at == "markers"
        if at_marker:
            target = math.inf if number > self.first_stop else 0.0
        else:
            target = config.stops[number - 1] - config.stops[self.first_stop - 1]
        target += self._by_hand
        if state is not None and state.travelled >= target - 0.001:
            return None
        await self.eye.start(self.follower.mode)
        try:
            return await (self.follower.follow(target, at_marker=True) if at_marker else self.follower.follow(target))
        finally:
            self.base.halt()
            await self.eye.stop()

    @property
    def _most_stops(self) -> int:
        config = self.config
        return config.marker_stops if config.stop_at == "markers" else len(config.stops)

    async def _settle(self) -> None:
        quiet = now()
        while now() - quiet < self.config.settle_s:
            await asyncio.sleep(0.05)
            state = self.bus.odometry.latest
            if state is None or abs(state.speed) > STANDSTILL_M_S or abs(state.turn_rate) > 10 * STANDSTILL_M_S:
                quiet = now()

    async def _observe(self, seen: list[tuple[Sighting, ...]]) -> None:
        """Add what each group of cameras sees, one group after the other; those that have looked are left out."""
        for group in self._groups[len(seen) :]:
            seen.append(await self._look(group))

    async def _look(self, group: Sequence[str]) -> tuple[Sighting, ...]:
        """What these cameras see in slots of their own."""
        mode = CameraMode(exposure=self.config.identify.exposure_s, mains_hz=self.config.mains_hz)
        state = self.bus.odometry.latest
        identifier = await in_thread(
            Identifier,
            self.config.labels,
            tuple(group),
            self.config.identify,
            delays=self._delays,
            memory=self.memory,
            pose=None if state is None else state.pose,
            travelled=self._along(),
        )
        async with AsyncExitStack() as stack:
            for name in group:
                frames = stack.enter_context(self.bus.frames(name).subscribe(size=8))
                await self.cameras[name].start(mode)
                stack.push_async_callback(self.cameras[name].stop)
                try:
                    async with asyncio.timeout(FIRST_FRAME_S):
                        await frames.get()
                except TimeoutError:
                    raise DriverFault(f"{name}: no frame for {FIRST_FRAME_S:g} s; check the camera") from None
                watch = asyncio.create_task(self._watch(identifier, name, frames))
                stack.push_async_callback(_cancel, watch)
            while (slot := await in_thread(identifier.next_slot, now())) is not None:
                await self._slot(identifier, slot)
        sightings = await in_thread(identifier.finish, now())
        for label in identifier.mistaken:
            text = f"{label} was named by its place, but flashed like another label; its place is learnt anew"
            self.bus.events.publish(Event(now(), "mission", "warning", text))
        self.undecided += identifier.undecided
        return sightings

    def _along(self) -> float:
        """Metres along the line, counted as `stops` are."""
        state = self.bus.odometry.latest
        begin = (
            self.config.stops[self.first_stop - 1] if self.config.stops and self.config.stop_at == "distances" else 0.0
        )
        return begin + (0.0 if state is None else state.travelled - self._by_hand)

    async def _watch(self, identifier: Identifier, camera: str, frames: Subscription[Frame]) -> None:
        async for frame in frames:
            await in_executor(self._workers, identifier.update, camera, frame)

    async def _slot(self, identifier: Identifier, slot: Slot) -> None:
        started = now()
        identifier.begin(slot, started)
        self._status("observing", self._number, f"slot {slot.number + 1}")
        late = 0.0  # what handing the requests over took: with a person in between, that is what the slot waits for
        for request in slot.requests:
            await asyncio.sleep(started + request.after + late - now())
            before = now()
            await self._ask(request)
            late += now() - before
        while now() < started + late + slot.timeout and not identifier.is_complete(now() - late):
            await asyncio.sleep(0.1)
        await in_thread(self.journal.add_slot, self.config.survey, self.leg, self._number, slot.number, started, now())

    async def _ask(self, request: FlashRequest) -> None:
        """Pass a request on; labels that are refused are reported once and not asked again."""
        refused = await self.labels.flash(request.labels, self.config.identify.strength, request.durations)
        for label, reason in refused.items():
            if label not in self.refused:
                text = f"{self.labels.name}: {label} is refused and left out: {reason}"
                self.bus.events.publish(Event(now(), "mission", "warning", text))
            self.refused[label] = reason
            self.memory.refused.add(label)
        if refused and len(self.refused) == len(self.config.labels):
            self.refused.clear()  # whoever mends that wants them asked again
            self.memory.refused.clear()
            raise MissionError(f"{self.labels.name}: every label is refused, the last one: {reason}")

    async def _record(self, number: int, sightings: Sequence[Sighting]) -> None:
        state = self.bus.odometry.latest
        move = None
        if self.stops and (self.odometry.broken_since_mark or self._was_lifted):
            self.leg = await in_thread(self.journal.begin_leg, self._header)
            self.memory.forget_places()
            text = f"odometry was interrupted before stop {number}: leg {self.leg} begins there"
            self.bus.events.publish(Event(now(), "mission", "warning", text))
        elif self.stops:
            move = self.odometry.move_since_mark()
        self.odometry.mark()
        self._was_lifted = False
        stop = Stop(
            leg=self.leg,
            stop=number,
            time=self._utc(),
            odometry=state.pose if state is not None else Pose(0.0, 0.0, 0.0),
            move=move,
            sightings=tuple(sightings),
        )
        await in_thread(self.journal.add_stop, self.config.survey, stop)
        self.stops.append(stop)
        self.wake_upload()
        seen = len({sighting.label for sighting in sightings})
        text = f"stop {number} of {self._most_stops}: {seen} labels, {len(sightings)} sightings"
        text += f", {self.undecided} lights undecided" if self.undecided else ""
        self.undecided = 0
        self.bus.events.publish(Event(now(), "mission", "info", text))

    # ---- faults ------------------------------------------------------------------------------------------------------

    async def _through_faults(self, state: State, stop: int, step: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """Run a step; when a device fails wait for it to work again and repeat the step.

        Raises MissionError when the step cannot be done: line lost, wheels stopped by the safety layer, or a device
        that stays dead for FAULT_WAIT_S. If an operator attends, that is for the operator to mend.
        """
        self._number = stop
        while True:
            self._status(state, stop)
            try:
                try:
                    return await _first(step(), self._trouble(driving=state == "driving"))
                except DriverFault as fault:
                    self._halt(str(fault))
                    self._status("paused", stop, str(fault))
                    await self._wait_healthy(str(fault))
            except _Paused as paused:
                await self._wait_resumed(stop, str(paused))
            except MissionError as error:
                if not self.is_attended or isinstance(error, _Aborted):
                    raise
                self.pause(str(error))
                await self._wait_resumed(stop, str(error))

    def _halt(self, cause: str) -> None:
        """Zero velocity at once, and the follower's wish to move no longer counts."""
        self.base.halt()
        self.bus.withdrawals.publish(Withdrawal(now(), self.follower.name, cause))

    async def _trouble(self, *, driving: bool) -> Any:
        """Never returns; raises DriverFault when a device fails, MissionError when the wheels are held for HELD_S,
        and what an operator wants.
        """
        since: float | None = None
        while True:
            self._heed_abort()
            if self.paused is not None:
                raise _Paused(self.paused)
            await asyncio.sleep(0.05)
            self._note_lift()
            if (fault := self.health.fault()) is not None:
                raise DriverFault(fault)
            hazard = self.health.hazard()
            since = None if hazard is None else now() if since is None else since
            if driving and since is not None and now() - since >= HELD_S:
                raise MissionError(f"halted: {hazard}")

    async def _wait_resumed(self, stop: int, cause: str) -> None:
        """Stand still until an operator resumes; what is driven by hand meanwhile is no way along the line."""
        self._halt(cause)
        self._status("paused", stop, cause)
        self.bus.events.publish(Event(now(), "mission", "warning", f"paused: {cause}"))
        state = self.bus.odometry.latest
        before = 0.0 if state is None else state.travelled
        while self.paused is not None:
            self._heed_abort()
            self._note_lift()
            await asyncio.sleep(0.05)
        state = self.bus.odometry.latest
        self._by_hand += (0.0 if state is None else state.travelled) - before
        self.bus.events.publish(Event(now(), "mission", "info", "goes on"))

    def _note_lift(self) -> None:
        """A lifted robot is put down somewhere else, which no wheel tells: the leg ends."""
        frame = self.bus.sensors.latest
        self._was_lifted |= frame is not None and (frame.wheel_drop_left or frame.wheel_drop_right)

    def _heed_abort(self) -> None:
        if self._aborted is not None:
            raise _Aborted(self._aborted)

    async def _wait_healthy(self, fault: str) -> None:
        deadline = now() + FAULT_WAIT_S
        await asyncio.sleep(0.5)
        while self.health.fault() is not None:
            self._heed_abort()
            if now() > deadline:
                raise MissionError(f"{fault}; it did not come back within {FAULT_WAIT_S:g} s")
            await asyncio.sleep(0.2)

    # ---- words -------------------------------------------------------------------------------------------------------

    def _status(self, state: State, stop: int, text: str = "") -> None:
        self.bus.status.publish(MissionStatus(now(), state, stop, self._most_stops, text))

    def _utc(self) -> str:
        return self.hardware.utc().astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def complete_map(
    solved: Map, labels: Sequence[str], stops: int, ended: str | None, refused: Mapping[str, str] | None = None
) -> Map:
    """Add the labels that no stop saw, each with its reason, so that the map speaks of every label asked for.

    Parameters
    ----------
    solved : Map
        As the solver returned it: it knows only labels that were seen.
    labels : sequence of str
        Every label that the mission looked for.
    stops : int
        Stops made.
    ended : str or None
        Why the mission ended early.
    refused : mapping of str to str, optional
        Labels that the label system did not take, with its reasons.
    """
    reasons = {label: f"the label system refuses it: {why}; correct its id" for label, why in (refused or {}).items()}
    known = {entry.label for entry in solved.labels}
    if ended is None:
        reason = (
            f"its flash was seen at none of the {stops} stops: out of every camera's view, hidden, or its battery is "
            "empty; add a stop that faces it"
        )
    else:
        reason = f"not seen before the mission ended after {stops} stops ({ended})"
    missing = [
        MappedLabel(label, "unplaced", reason=reasons.get(label, reason)) for label in labels if label not in known
    ]
    notes = solved.notes if ended is None else (*solved.notes, f"the mission ended after {stops} stops: {ended}")
    return replace(solved, labels=(*solved.labels, *missing), notes=notes)


async def _cancel(task: asyncio.Task[Any]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    if not task.cancelled() and (error := task.exception()) is not None:
        raise error


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
