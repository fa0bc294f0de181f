"""One mission at a time: begun by an operator or the command line, or found interrupted in the journal; run to its end.

A mission that is under way when the process ends (kill -9, power loss, `systemctl restart`) stays open in the journal.
The next start finds it and begins it paused; see `robotd.mission`.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from .clock import in_thread, now, ticks
from .config import MissionConfig
from .errors import InputError, MissionError, StorageError, UploadError
from .files import load_plan, map_to_json, write_atomic
from .hardware import flicker_free
from .journal_records import MissionNote, Unfinished
from .label_source import LabelSource
from .mission import Mission, plan
from .mission_guards import BatteryGuard, DiskGuard
from .mission_steps import Health
from .plan_records import Plan
from .plugin import Base, Camera, Follower, Labels
from .records import Event, Map, MappedLabel
from .upload import Uploader

if TYPE_CHECKING:
    from .daemon import Daemon

DISK_S = 5.0  # between two looks at the room on the disk
ALIVE_S = 10.0  # between two notes of a mission that stands at a stop
PROMPTLY_S = 60.0  # after an interruption a mission may go on by itself for so long


class MissionKeeper:
    """Starts missions of one daemon, one at a time.

    Attributes
    ----------
    mission : Mission or None
        The one that runs, or the last one.
    map : Map or None
        After a mission: the server's map, completed with the labels that were never seen.
    """

    def __init__(self, daemon: Daemon) -> None:
        self.daemon = daemon
        self.mission: Mission | None = None
        self.map: Map | None = None
        self._running: asyncio.Task[None] | None = None
        self._is_starting = True  # until the journal was asked for an interrupted one
        self._noted = 0.0

    @property
    def is_under_way(self) -> bool:
        """Whether there is a mission that has not ended; its map may still be awaited then."""
        return self._is_starting or (self.mission is not None and not self.mission.is_over)

    async def start(self, *, survey: str | None = None, first_stop: int = 1) -> None:
        """Begin a mission that an operator attends; a MissionError or InputError says why not."""
        daemon = self.daemon
        if self.is_under_way:
            raise MissionError("a mission is under way; robotctl mission abort ends it")
        if (held := daemon.control.gate.latched) is not None and held.startswith("emergency stop"):
            raise MissionError(f"the robot is held: {held}; robotctl release first")
        self._is_starting = True  # because a second start must not come in between
        try:
            follower = next(item for item in daemon.supervisors if item.driver is daemon.assembly.follower)
            follower.restart()  # because what it remembers is in the axes of the last leg
            await self._begin(survey, is_attended=True, first_stop=first_stop)
            daemon.odometry.restart()
            self._run()
        finally:
            self._is_starting = False

    async def run(self) -> None:
        """Go on with an interrupted mission, or drive the configured one; until it has ended and has its map."""
        if not self.is_under_way:
            await self._begin(None, is_attended=False)
            self._run()
        assert self._running is not None
        while not self._running.done():  # another one may take its place while its map is awaited
            await asyncio.wait({self._running})

    async def restore(self) -> None:
        """Begin again, paused, the mission that was interrupted when the last daemon ended, if one was."""
        try:
            found = await in_thread(self.daemon.journal.unfinished)
            if found is not None:
                await self._go_on(found)
        except StorageError as error:
            self._say(f"an interrupted mission cannot go on: {error}, and restart robotd", "error")
        finally:
            self._is_starting = False

    async def _go_on(self, found: Unfinished) -> None:
        try:
            if found.plan != plan(await self._planned()):
                raise InputError("its stops are others now ([mission] stops, stop_at)")
            how = {"is_attended": found.is_attended, "interrupted": found, "doubt": self._doubt(found)}
            await self._begin(found.survey, **how)
            self._run()
        except InputError as error:
            why = f"interrupted before stop {found.note.stop} and cannot go on: {error}"
            text = f"the mission of survey '{found.survey}' was {why}; robotctl survey continue begins another leg"
            self._say(text, "error")
            await in_thread(self.daemon.journal.end_mission, found.note.number, why)

    def _doubt(self, found: Unfinished) -> str | None:
        """Why an interrupted mission must not go on by itself, or None."""
        note, passed = found.note, now() - found.note.t
        if note.paused is not None:
            return f"it was paused ({note.paused.removeprefix('restarted: ')})"
        if found.boot != self.daemon.assembly.hardware.boot_id():
            return "the computer was started again since"
        if not 0.0 <= passed <= PROMPTLY_S:
            return f"{passed:.0f} s have passed since"
        if self.daemon.assembly.config.mission.resume == "ask":
            return "it waits for an operator ([mission] resume)"
        return None

    def note(self) -> MissionNote | None:
        """How far the mission has come, for the journal; None if there is nothing new to say."""
        note = None if self.mission is None else self.mission.note()
        if note is None or (note.state != "driving" and note.t - self._noted < ALIVE_S):
            return None
        self._noted = note.t
        return note

    async def config(self, survey: str, *, goes_on: bool = False, everywhere: bool = False) -> MissionConfig:
        """The configuration of a survey, with the labels that its source names and what pictures are calibrated to.

        Parameters
        ----------
        survey : str
        goes_on : bool
            With an interrupted mission.
        everywhere : bool
            Without zones, which hold for places along the line only.

        Raises
        ------
        InputError, MissionError
            See `LabelSource.labels`.
        """
        daemon, assembly = self.daemon, self.daemon.assembly
        mission = await self._planned()
        if everywhere:
            mission = replace(mission, zones=())
        identify = replace(
            mission.identify,
            gamma=assembly.calibration.gamma,
            row_time_s=assembly.calibration.row_time_s,
            exposure_s=flicker_free(mission.identify.exposure_s, mission.mains_hz),
        )
        source = LabelSource(
            *(assembly.path.parent, daemon.state, cast(Labels, assembly.labels)),
            fault=lambda: next(item.fault for item in daemon.supervisors if item.driver.name == assembly.labels.name),
            uploader=daemon.uploader,
            warn=lambda text: self._say(text, "warning"),
        )
        labels = await source.labels(mission, survey, goes_on=goes_on)
        return replace(mission, identify=identify, survey=survey, labels=labels, labels_from="config")

    async def _advice(self) -> Plan | None:
        """The plan that the configuration names; raises InputError if it cannot be read or has no stops."""
        assembly = self.daemon.assembly
        if assembly.config.mission.plan is None:
            return None
        path = assembly.path.parent / assembly.config.mission.plan
        found = await in_thread(load_plan, path)
        if not found.distances():
            raise InputError(
                f"{path} stops: found none along the line; expected stops to make, or leave out [mission] plan"
            )
        return found

    async def _planned(self) -> MissionConfig:
        """The configuration with the stops of its plan, if it names one."""
        mission, advice = self.daemon.assembly.config.mission, await self._advice()
        return mission if advice is None else replace(mission, stops=advice.distances())

    # ---- one mission -------------------------------------------------------------------------------------------------

    async def _begin(self, survey: str | None, **how: Any) -> None:
        daemon = self.daemon
        assembly, config = daemon.assembly, daemon.assembly.config
        if assembly.others and not assembly.cameras:
            raise InputError(
                f"{config.robot.calibration} knows no camera of the rig; robotctl calibrate camera "
                f"{' and '.join(assembly.others)}, and robotctl calibrate rig"
            )
        limits = config.mission
        self._battery = BatteryGuard(limits.low_charge, limits.enough_charge, limits.low_voltage, limits.enough_voltage)
        self._disk = DiskGuard(str(daemon.state), 1e6 * limits.keep_free_mb)
        await self._look_at_disk()
        survey = survey or config.mission.survey
        mission = Mission(
            await self.config(survey, goes_on="interrupted" in how),
            assembly.calibration,
            bus=assembly.bus,
            hardware=assembly.hardware,
            base=cast(Base, assembly.base),
            follower=cast(Follower, assembly.follower),
            labels=cast(Labels, assembly.labels),
            cameras={name: cast(Camera, driver) for name, driver in assembly.cameras.items()},
            eye=cast(Camera, assembly.eye),
            odometry=daemon.odometry,
            journal=daemon.journal,
            health=Health(
                daemon.fault,
                lambda: daemon.control.cause,
                held=lambda: daemon.control.gate.latched,
                shortage=lambda: self._battery.cause or self._disk.cause,
                insist=self._insist,
            ),
            wake_upload=self._wake_upload,
            advice=await self._advice(),
            **how,
        )
        await mission.begin()
        self.mission = mission

    def _run(self) -> None:
        assert self.mission is not None
        if self._running is not None:
            self._running.cancel()  # nobody waits for the map of the one before any more
        self._running = self.daemon.spawn(self._run_mission(self.mission))

    async def _run_mission(self, mission: Mission) -> None:
        self.daemon.control.resume("the mission's start")
        watching = self.daemon.spawn(self._watch())
        try:
            await mission.run()
        finally:
            watching.cancel()
        uploader = self.daemon.uploader
        if uploader is not None:
            await self._fetch_map(mission, uploader)
        mission.finish()

    # ---- what runs out -----------------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        async for second in ticks(1.0):
            frame = self.daemon.assembly.bus.sensors.latest
            if frame is not None:
                self._battery.update(frame)
            if second % DISK_S == 0:
                await self._look_at_disk()

    async def _look_at_disk(self) -> None:
        try:
            usage = await in_thread(shutil.disk_usage, self.daemon.state)
        except OSError as error:
            self._say(f"{self.daemon.state}: cannot be looked at: {error.strerror or error}", "warning")
        else:
            self._disk.update(usage.free)

    def _insist(self) -> None:
        self._battery.insist()
        self._disk.insist()

    # ---- what comes of it --------------------------------------------------------------------------------------------

    def _wake_upload(self) -> None:
        if self.daemon.uploader is not None:
            self.daemon.uploader.wake()

    async def _fetch_map(self, mission: Mission, uploader: Uploader) -> None:
        config = mission.config
        try:
            async with asyncio.timeout(config.upload_wait_s):
                await uploader.wait_empty()
            solved = await uploader.fetch_map(config.survey)
        except (TimeoutError, UploadError) as error:
            text = str(error) or f"the server did not take every stop within {config.upload_wait_s:g} s"
            self._say(f"no map yet: {text}; the stops are kept and sent at the next start", "error", "upload")
            return
        refused = mission.observer.refused
        self.map = complete_map(solved, config.labels, len(mission.stops), mission.ended, refused)
        try:
            await in_thread(write_atomic, self.daemon.state / "map.json", map_to_json(self.map))
        except (InputError, StorageError) as error:
            self._say(f"the map is not kept here: {error}", "warning")

    def _say(self, text: str, level: Any = "info", source: str = "mission") -> None:
        self.daemon.assembly.bus.events.publish(Event(now(), source, level, text))


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
