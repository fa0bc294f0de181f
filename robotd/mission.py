"""The mission: drive the line, stop, have the labels flash, record what the cameras saw, go on.

`mission_states` says which states there are. A step that a fault, a shortage (battery, disk) or an operator interrupts
halts the robot, waits, and is repeated. What cannot be mended ends the mission (`fault`); an operator who attends can
mend it, so then it pauses, until `resume` or `abort`.

Every finished stop is in the journal before the robot moves on, and with it how far the mission has come: a mission
whose process was killed goes on from there (`interrupted`), in a new leg, because its odometry is lost. A mission that
ends early keeps and uploads the stops it made.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC
from functools import partial

from .bus import Bus
from .clock import in_thread, now
from .config import Calibration, MissionConfig
from .errors import MissionError, StorageError
from .hardware import Hardware
from .journal import Journal
from .journal_records import MissionNote, Unfinished
from .mission_steps import FAULT_WAIT_S, Health, Pause, Steps
from .observation import Observer, Site
from .odometry import Odometry
from .plan_records import Plan
from .plugin import Base, Camera, FollowEnd, Follower, Labels
from .records import MissionState, Pose, Sighting, Stop, Survey


class Mission(Steps):
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
    interrupted : Unfinished, optional
        The mission that this one goes on with. It begins paused.
    doubt : str, optional
        Why it must not go on by itself then.
    advice : Plan, optional
        Where the configured stops come from, and which labels are not worth asking there.
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
        interrupted: Unfinished | None = None,
        doubt: str | None = None,
        advice: Plan | None = None,
    ) -> None:
        most = config.marker_stops if config.stop_at == "markers" else len(config.stops)
        super().__init__(bus, base, follower, health, number=first_stop, most=most, is_attended=is_attended)
        self.config = config
        self.calibration = calibration
        self.hardware = hardware
        self.eye = eye
        self.odometry = odometry
        self.journal = journal
        self.wake_upload = wake_upload
        self.leg = 1
        self.stops: list[Stop] = []
        self.ended: str | None = None  # why the mission ended early, in words
        self.is_over = False  # no step will follow
        self.interrupted = interrupted
        self.observer = Observer(
            *(config, calibration),
            bus=bus,
            cameras=cameras,
            labels=labels,
            journal=journal,
            tell=lambda text: self._tell("observing", text),
            advice=advice,
        )
        self._id = 0  # in the journal
        self._leg_stops = 0  # made in this leg
        self._standing_at = first_stop  # where the robot is at the start; 0: between two stops
        self._origin = config.stops[first_stop - 1] if self._by_distance else 0.0  # metres along the line, there
        if advice is not None and first_stop == 1:
            self._standing_at, self._origin = 0, advice.begin
        if interrupted is not None:
            self._go_on_from(interrupted, doubt)

    def _go_on_from(self, interrupted: Unfinished, doubt: str | None) -> None:
        note = interrupted.note
        self._number = note.stop
        self._origin = note.along
        if note.state not in ("settling", "observing"):
            self._standing_at = 0
            where = f"on the way to stop {note.stop}, {note.along:.2f} m along the line"
        else:
            self._standing_at = note.stop
            where = f"at stop {note.stop}"
            if self._by_distance:
                self._origin = self.config.stops[note.stop - 1]
        rest = f"{doubt}; see that the robot stands on the line there, then robotctl mission resume"
        cause = (
            f"restarted: the mission was interrupted {where}; {rest if doubt else 'it goes on when nothing is wrong'}"
        )
        self._pause = Pause(cause, None if doubt else lambda: True)

    @property
    def _by_distance(self) -> bool:
        return self.config.stop_at == "distances" and bool(self.config.stops)

    async def begin(self) -> None:
        """Begin the leg in the journal.

        Raises
        ------
        InputError
            If the survey cannot have another leg, or the interrupted mission had other stops.
        StorageError
            If the disk does not take it.
        """
        config, interrupted = self.config, self.interrupted
        self._header = Survey(
            survey=config.survey,
            rig=self.calibration.rig,
            stops=(),
            created=self._utc(),
            sigmas=self.calibration.sigmas,
            priors=self.calibration.survey_priors,
            known_labels=config.known_labels,
        )
        self.leg = await in_thread(self.journal.begin_leg, self._header)
        if interrupted is None:
            self._id = await in_thread(
                self.journal.begin_mission,
                *(config.survey, self.leg, self._number, plan(config)),
                is_attended=self.is_attended,
            )
        else:
            self._id = interrupted.note.number
            made = await in_thread(self.journal.survey, config.survey)
            self.stops = [stop for stop in made.stops if stop.leg >= interrupted.leg]
            if interrupted.note.memory is not None:
                same = interrupted.boot == self.hardware.boot_id()
                self.observer.restore(interrupted.note.memory, same_clock=same)
        self.wake_upload()

    async def run(self) -> None:
        """Make every stop that can be made; afterwards `stops` and `ended` say what came of it. After `begin`."""
        with self.observer:
            try:
                if self._number <= self._most_stops:
                    await self._step("idle", self._number, self._ready)
                for number in range(self._number, self._most_stops + 1):
                    if await self._step("driving", number, partial(self._drive, number)) == "end":
                        self._say(f"the line ended after stop {number - 1}: all its markers are made")
                        break
                    await self._step("settling", number, self._settle)
                    await self._make_stop(number)
            except MissionError as error:
                self.ended = str(error)
                self._halt(self.ended)
                self._tell("fault", self.ended)
                self._say(self.ended, "error")
            finally:
                self.is_over, self._pause = True, None
        try:
            await in_thread(self.journal.end_mission, self._id, self.ended or "done")
        except StorageError as error:
            self._say(f"{error}; until then the mission counts as interrupted", "warning")
        self._tell("uploading")

    def finish(self) -> None:
        """Nothing of it is awaited any more."""
        self._tell("done")

    # ---- how far it has come -----------------------------------------------------------------------------------------

    @property
    def along(self) -> float:
        """Metres along the line, counted as `stops` are."""
        state = self.bus.odometry.latest
        return self._origin + (0.0 if state is None else state.travelled - self._by_hand)

    def note(self) -> MissionNote | None:
        """How far it has come, while that changes."""
        if self._states.now in ("driving", "settling", "observing"):
            return MissionNote(self._id, self._states.now, self._number, self.along, now())
        return None

    async def _note(self, state: MissionState, paused: str | None = None) -> None:
        if state == "idle":  # for whoever goes on from here
            state = "settling" if self._number == self._standing_at else "driving"
        note = MissionNote(self._id, state, self._number, self.along, now(), paused=paused)
        await in_thread(self.journal.note_mission, note)

    # ---- the steps ---------------------------------------------------------------------------------------------------

    async def _ready(self) -> None:
        """Wait until every driver is open for the first time and the base talks."""
        deadline = now() + FAULT_WAIT_S
        while (fault := self.health.fault()) is not None or self.bus.odometry.latest is None:
            if now() > deadline:
                raise MissionError(fault or f"{self.base.name}: no sensor frame for {FAULT_WAIT_S:g} s")
            await asyncio.sleep(0.05)

    async def _drive(self, number: int) -> FollowEnd | None:
        """To the stop of that number; what ended the drive, or None if the robot is there already."""
        config, state = self.config, self.bus.odometry.latest
        at_marker = config.stop_at == "markers"
        if number == self._standing_at:
            return None
        target = math.inf if at_marker else config.stops[number - 1] - self._origin + self._by_hand
        if state is not None and state.travelled >= target - 0.001:
            return None
        await self.eye.start(self.follower.mode)
        try:
            return await (self.follower.follow(target, at_marker=True) if at_marker else self.follower.follow(target))
        finally:
            self.base.halt()
            await self.eye.stop()

    async def _settle(self) -> None:
        quiet = now()
        while now() - quiet < self.config.settle_s:
            await asyncio.sleep(0.05)
            if not self._stands:
                quiet = now()

    async def _make_stop(self, number: int) -> None:
        """Observe and put what was seen on the disk."""
        config = self.config
        sightings = await self._sightings(number)
        if _labels(sightings) < config.least_labels and config.if_fewer == "repeat":
            self._say(f"stop {number}: only {_labels(sightings)} labels, of {config.least_labels} at least: once more")
            sightings = max(sightings, await self._sightings(number), key=_labels)
        flag = None
        if _labels(sightings) < config.least_labels:
            flag = f"only {_labels(sightings)} labels, of {config.least_labels} at least"
            self._say(f"stop {number}: {flag}; what hides them, or is it the wrong place?", "warning")
        stop = self._stop(number, sightings)
        await self._step("observing", number, partial(self._record, stop, flag))
        text = f"stop {number} of {self._most_stops}: {_labels(sightings)} labels, {len(sightings)} sightings"
        self._say(text + (f", {self.observer.undecided} lights undecided" if self.observer.undecided else ""))

    async def _sightings(self, number: int) -> tuple[Sighting, ...]:
        seen: list[tuple[Sighting, ...]] = []  # by each group of cameras
        self.observer.undecided = 0
        await self._step("observing", number, partial(self._observe, seen))
        return tuple(sighting for group in seen for sighting in group)

    async def _observe(self, seen: list[tuple[Sighting, ...]]) -> None:
        await self._renew_leg(seen)
        state = self.bus.odometry.latest
        site = Site(self.leg, self._number, None if state is None else state.pose, self.along)
        await self.observer.observe(site, seen)

    async def _renew_leg(self, seen: list[tuple[Sighting, ...]]) -> None:
        """Begin a new leg if the way here is not known; before observing, because places are remembered in its axes."""
        if not (self._was_lifted or self.odometry.broken_since_mark):
            return
        if self._was_lifted:
            seen.clear()
        if self._leg_stops:
            self.leg = await in_thread(self.journal.begin_leg, self._header)
            self._leg_stops = 0
            text = f"odometry was interrupted before stop {self._number}: leg {self.leg} begins there"
            self._say(text, "warning")
        self.observer.memory.forget_places()
        self.odometry.mark()
        self._was_lifted = False

    def _stop(self, number: int, sightings: Sequence[Sighting]) -> Stop:
        state = self.bus.odometry.latest
        move = self.odometry.move_since_mark() if self._leg_stops else None
        self.odometry.mark()
        self._leg_stops += 1
        return Stop(
            leg=self.leg,
            stop=number,
            time=self._utc(),
            odometry=state.pose if state is not None else Pose(0.0, 0.0, 0.0),
            move=move,
            sightings=tuple(sightings),
        )

    async def _record(self, stop: Stop, flag: str | None) -> None:
        """Put the stop on the disk, and with it that the next one is due; may be repeated."""
        note = MissionNote(self._id, "driving", stop.stop + 1, self.along, now(), self.observer.state())
        await in_thread(self.journal.add_stop, self.config.survey, stop, flag=flag, note=note)
        self._noted = note.state, note.stop
        self.stops.append(stop)
        self.wake_upload()

    def _utc(self) -> str:
        return self.hardware.utc().astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def plan(config: MissionConfig) -> str:
    """What must be the same for an interrupted mission to go on: where the stops are."""
    return json.dumps([config.stop_at, config.stops if config.stop_at == "distances" else config.marker_stops])


def _labels(sightings: Sequence[Sighting]) -> int:
    return len({sighting.label for sighting in sightings})
