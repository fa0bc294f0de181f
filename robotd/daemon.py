"""The daemon: binds the configuration to drivers, supervises them, runs the control loop and the mission.

`assemble` opens nothing: it names every mistake of configuration and calibration. `Daemon.run` opens the drivers,
keeps each one alive (halt, report, reopen with back-off), turns sensor frames into odometry and drive commands into
safe motion, and runs at most one mission.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter
from collections.abc import Coroutine, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, cast

from .bind import bind
from .bus import Bus
from .clock import in_thread, now, ticks
from .config import Calibration, Config, collect, load_calibration, load_config, read_toml
from .control import ControlLoop
from .control_socket import ControlSocket
from .errors import ConfigError, InputError, StorageError
from .hardware import CameraMode, Hardware, flicker_free
from .journal import Journal
from .mission import Mission
from .mission_keeper import MissionKeeper
from .notify import notify
from .odometry import Odometry
from .plugin import Base, Camera, Driver, Follower, load
from .recorder import Recordings
from .recording_upload import RecordingUploader
from .records import Event, Map
from .safety import SafetyGate
from .secret_file import read_credential, read_secret
from .serial_log import LoggedHardware, SerialLog
from .service import describe, tell_manager
from .supervisor import Supervisor
from .upload import Uploader
from .web import WebServer

log = logging.getLogger("robotd")

TRAIL_S = 0.1
WRITE_S = 1.0  # of the trail, and of where the mission is
CLOCK_S, STEP_S = 10.0, 1.0  # between two looks at the date; a change by more than so much is a step
LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


@dataclass(frozen=True)
class Assembly:
    """What a configuration describes; nothing in it has been opened."""

    path: Path
    config: Config
    calibration: Calibration
    bus: Bus
    hardware: Hardware
    base: Driver
    follower: Driver
    labels: Driver
    cameras: Mapping[str, Driver]  # the rig's, in the calibration's order
    eye: Driver  # the follower's camera
    beacons: Driver | None = None
    serial_log: SerialLog | None = None
    others: Mapping[str, Driver] = field(default_factory=dict)  # cameras to be calibrated: missions do without them

    @property
    def drivers(self) -> list[Driver]:
        """In the order in which they are opened."""
        every = [self.base, *self.cameras.values(), self.eye, self.labels, self.follower, self.beacons]
        every += self.others.values()
        return list(dict.fromkeys(driver for driver in every if driver is not None))


@dataclass(frozen=True)
class Plan:
    """One driver of a configuration: its class and its bound section."""

    name: str
    cls: type[Driver]
    config: Any


def read_config(path: Path) -> tuple[Config, dict[str, Plan]]:
    """Read robotd.toml and bind its drivers' sections; raises ConfigError listing the mistakes of both."""
    problems: list[str] = []
    config = collect(problems, lambda: load_config(path))
    sections = read_toml(path).get("drivers") if config is None else config.drivers
    plans = collect(problems, lambda: plan_drivers(path, sections if isinstance(sections, dict) else {}))
    if config is None or plans is None:
        raise ConfigError(*problems)
    return config, plans


def plan_drivers(path: Path, sections: Mapping[str, Any]) -> dict[str, Plan]:
    """Bind every driver's section; relative paths in it are relative to the configuration's folder.

    Raises
    ------
    ConfigError
        Lists every mistake of the sections, and a base, follower, labels or floor camera that is missing.
    """
    problems: list[str] = []
    plans: dict[str, Plan] = {}
    for name, section in sections.items():
        if not (isinstance(section, dict) and isinstance(section.get("driver"), str)):
            continue  # reported with the configuration
        where = f"{path} [drivers.{name}]"
        plan = collect(problems, lambda name=name, section=section, where=where: _plan(path, name, section, where))  # type: ignore[misc]
        if plan is not None:
            plans[name] = plan
    if not problems:
        for kind in ("base", "follower", "labels"):
            names = _of_kind(plans, kind)
            if len(names) != 1:
                found = " and ".join(names) or "none"
                problems.append(f"{path} [drivers]: found {found} of kind '{kind}'; expected exactly one")
        if len(names := _of_kind(plans, "beacons")) > 1:
            problems.append(f"{path} [drivers]: found {' and '.join(names)} of kind 'beacons'; expected one or none")
        for name in _of_kind(plans, "follower"):
            eye = str(plans[name].config.camera)
            if eye not in _of_kind(plans, "camera"):
                problems.append(f"{path} [drivers.{name}] camera: there is no camera [drivers.{eye}]")
    if problems:
        raise ConfigError(*problems)
    return plans


def plan_cameras(path: Path, sections: Mapping[str, Any]) -> dict[str, Plan]:
    """Bind sections that must all be cameras; raises ConfigError listing every mistake."""
    problems: list[str] = []
    plans: dict[str, Plan] = {}
    for name, section in sections.items():
        where = f"{path} [drivers.{name}]"
        plan = collect(problems, lambda name=name, section=section, where=where: _plan(path, name, section, where))  # type: ignore[misc]
        if plan is not None and plan.cls.kind != "camera":
            problems.append(f"{where} driver: '{section['driver']}' is of kind '{plan.cls.kind}'; expected a camera")
        elif plan is not None:
            plans[name] = plan
    if problems:
        raise ConfigError(*problems)
    return plans


def _plan(path: Path, name: str, section: Mapping[str, Any], where: str) -> Plan:
    cls = load(str(section["driver"]), where)
    config = bind(cls.Config, {key: value for key, value in section.items() if key != "driver"}, where)
    resolved = {
        item.name: path.parent / value
        for item in fields(config)
        if isinstance(value := getattr(config, item.name), Path)
    }
    return Plan(name, cls, replace(config, **resolved))


def _of_kind(plans: Mapping[str, Plan], kind: str) -> list[str]:
    return [name for name, plan in plans.items() if plan.cls.kind == kind]


def assemble(path: Path, hardware: Hardware) -> Assembly:
    """Build every driver of a configuration without opening any.

    Parameters
    ----------
    path : Path
        robotd.toml; relative paths in it are relative to its folder.
    hardware : Hardware
        Handed to the drivers.

    Raises
    ------
    ConfigError
        Lists every mistake of the configuration, of its drivers' sections and of the calibration, which need not
        exist: nothing is known then.
    """
    problems: list[str] = []
    read = collect(problems, lambda: read_config(path))
    config = read[0] if read else collect([], lambda: load_config(path))
    plans = read[1] if read else {}
    calibration = Calibration()
    if config is not None:
        where = path.parent / config.robot.calibration
        if where.exists():
            calibration = collect(problems, lambda: load_calibration(where)) or calibration
    if problems or config is None:
        raise ConfigError(*problems)
    cameras = _of_kind(plans, "camera")
    problems += [
        f"{path}: the calibration knows the camera '{camera.name}', but there is no camera [drivers.{camera.name}]"
        for camera in calibration.cameras
        if camera.name not in cameras
    ]
    problems += _check_groups(path, config, calibration)
    serial_log = _serial_log(path, config, plans, calibration)
    if serial_log is not None:
        hardware = LoggedHardware(hardware, plans[_of_kind(plans, "base")[0]].config.port, serial_log)
    bus = Bus()
    drivers: dict[str, Driver] = {}
    for name, plan in plans.items() if not problems else ():
        driver = collect(
            problems,
            lambda name=name, plan=plan: plan.cls(name, plan.config, hardware, bus, calibration),  # type: ignore[misc]
        )
        if driver is not None:
            drivers[name] = driver
    if problems:
        raise ConfigError(*problems)
    base, follower, labels = (drivers[_of_kind(plans, kind)[0]] for kind in ("base", "follower", "labels"))
    rig = {camera.name: drivers[camera.name] for camera in calibration.cameras}
    eye = drivers[str(plans[follower.name].config.camera)]
    beacons = next((drivers[name] for name in _of_kind(plans, "beacons")), None)
    others = {name: drivers[name] for name in cameras if name not in rig and name != eye.name}
    return Assembly(
        *(path, config, calibration, bus, hardware, base, follower, labels, rig, eye, beacons, serial_log, others)
    )


def _check_groups(path: Path, config: Config, calibration: Calibration) -> list[str]:
    """The mistakes of mission.camera_groups: every camera of the rig belongs to one group."""
    groups = config.mission.camera_groups
    named = Counter(name for group in groups for name in group)
    rig = {camera.name for camera in calibration.cameras}
    if not (groups and rig) or (named.keys() == rig and max(named.values()) == 1):
        return []
    found = ", ".join(name for group in groups for name in group)
    return [f"{path} mission.camera_groups: found {found}; expected each of {', '.join(sorted(rig))} once"]


def _serial_log(path: Path, config: Config, plans: Mapping[str, Plan], calibration: Calibration) -> SerialLog | None:
    """The recording of the base's line that the configuration asks for, with what its replay needs."""
    file = config.robot.serial_log
    base = plans[_of_kind(plans, "base")[0]]
    if file is None or not hasattr(base.config, "port"):
        return None
    head = {
        "robot": config.robot.name,
        "base": {"driver": config.drivers[base.name]["driver"], **_plain(base.config)},
        "wheels": _plain(calibration.wheels),
        "safety": _plain(config.safety),
    }
    return SerialLog(path.parent / file, round(1e6 * config.robot.serial_log_mb), head)


def _plain(record: Any) -> dict[str, Any]:
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(record).items()}


class Daemon:
    """One robot, running.

    Attributes
    ----------
    missions : MissionKeeper
    journal : Journal
    uploader : Uploader or None
    """

    def __init__(self, assembly: Assembly) -> None:
        self.assembly = assembly
        config, bus = assembly.config, assembly.bus
        self.odometry = Odometry(assembly.calibration.wheels)
        blind = cast(Follower, assembly.follower).blind
        gate = SafetyGate(config.safety, assembly.calibration.wheels.base, blind)
        self.control = ControlLoop(bus, cast(Base, assembly.base), self.odometry, gate)
        self.supervisors = [Supervisor(driver) for driver in assembly.drivers]
        self.recordings = self._recordings()
        self.uploader: Uploader | None = None
        self._group: asyncio.TaskGroup
        self._uploading: list[asyncio.Task[None]] = []
        self.missions = MissionKeeper(self)

    @property
    def mission(self) -> Mission | None:
        """The mission that runs, or the last one."""
        return self.missions.mission

    @property
    def map(self) -> Map | None:
        """After a mission: the server's map, completed with the labels that were never seen."""
        return self.missions.map

    @property
    def state(self) -> Path:
        """The folder of all that the robot keeps."""
        return self.assembly.path.parent / self.assembly.config.robot.state_directory

    async def run(self, *, mission: bool, control: ControlSocket | None = None) -> None:
        """Until cancelled, or with `mission` until that one has ended and its stops are uploaded."""
        assembly = self.assembly
        self.journal = journal = await in_thread(Journal.open, self.state / "journal.sqlite")
        try:
            await self._note_clock()
            if not (assembly.path.parent / (name := assembly.config.robot.calibration)).exists():
                log.warning("there is no %s yet: calibrate the robot (robotctl calibrate), then restart robotd", name)
            uploader = self._uploader()
            async with asyncio.TaskGroup() as self._group:
                work = [
                    self._log_events(journal),
                    self._keep_trail(journal),
                    self._watch_clock(),
                    self.control.run(),
                    self.recordings.run(),
                    *(supervisor.run() for supervisor in self.supervisors),
                ]
                if assembly.serial_log is not None:
                    work.append(assembly.serial_log.follow(assembly.bus))
                if control is not None:
                    work.append(self._listen(control))
                work.append(tell_manager(self._line))
                tasks = [self._group.create_task(item) for item in work]
                self._upload_by(uploader)
                if control is not None:
                    await control.settled.wait()
                notify(f"READY=1\nSTATUS={self._line()}")
                await self.missions.restore()
                if mission:
                    await self.missions.run()
                    for task in (*tasks, *self._uploading):
                        task.cancel()
        finally:
            notify("STOPPING=1")
            await in_thread(journal.close)

    async def _listen(self, control: ControlSocket) -> None:
        try:
            await control.run()
        except InputError as error:  # the robot works without operators, too
            self.assembly.bus.events.publish(Event(now(), "control", "error", str(error)))

    def spawn(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run something as long as the daemon runs."""
        return self._group.create_task(work)

    # ---- the operator's part -----------------------------------------------------------------------------------------

    def reconfigure(self, config: Config, drivers: Mapping[str, Driver]) -> None:
        """Go on with another configuration, and with these drivers in place of those of the same names."""
        old = self.assembly
        self.assembly = replace(
            old,
            config=config,
            labels=drivers.get(old.labels.name, old.labels),
            beacons=drivers.get(old.beacons.name, old.beacons) if old.beacons is not None else None,
        )
        for supervisor in self.supervisors:
            if supervisor.driver.name in drivers:
                supervisor.restart(drivers[supervisor.driver.name])
        self.control.gate.limits = config.safety
        if config.upload != old.config.upload:
            self._upload_by(self._uploader())

    def _upload_by(self, uploader: Uploader | None) -> None:
        for task in self._uploading:
            task.cancel()
        self.uploader = uploader
        self._uploading = []
        if uploader is not None:
            self._uploading.append(self.spawn(uploader.run()))
            if self.assembly.config.recording.upload:
                self._uploading.append(self.spawn(self._upload_recordings(uploader).run()))

    def _recordings(self) -> Recordings:
        """The service that records cameras on request."""
        assembly, mission = self.assembly, self.assembly.config.mission
        exposure = flicker_free(mission.identify.exposure_s, mission.mains_hz)
        standing = CameraMode(exposure=exposure, mains_hz=mission.mains_hz)
        follower = cast(Follower, assembly.follower)
        cameras = {**assembly.cameras, **assembly.others, assembly.eye.name: assembly.eye}
        recording = assembly.config.recording

        def is_busy() -> bool:
            status = assembly.bus.status.latest
            return status is not None and status.state in ("driving", "settling", "observing", "paused")

        return Recordings(
            replace(recording, directory=assembly.path.parent / recording.directory),
            assembly.config.robot.name,
            bus=assembly.bus,
            hardware=assembly.hardware,
            calibration=assembly.calibration,
            cameras={name: cast(Camera, driver) for name, driver in cameras.items()},
            mode=lambda name: follower.mode if name == assembly.eye.name and name not in assembly.cameras else standing,
            groups=mission.camera_groups,
            pattern=mission.identify.pattern,
            is_busy=is_busy,
        )

    def _uploader(self) -> Uploader | None:
        upload = self.assembly.config.upload
        if upload.url is None:
            return None
        token = None
        if upload.token_file is not None:
            token = read_secret(
                self.assembly.path.parent / upload.token_file, f"{self.assembly.path} upload.token_file"
            )
        elif upload.token_credential is not None:
            token = read_credential(upload.token_credential, f"{self.assembly.path} upload.token_credential")

        ca_file = None if upload.ca_file is None else self.assembly.path.parent / upload.ca_file
        server = WebServer(upload.url, token, ca_file=ca_file, pins=upload.pins)

        def report(text: str, level: Any = "info") -> None:
            self.assembly.bus.events.publish(Event(now(), "upload", level, text))

        return Uploader(self.journal, server, upload.retry_s, upload.timeout_s, report)

    def _upload_recordings(self, uploader: Uploader) -> RecordingUploader:
        """Sends finished recordings to where the stops go."""
        recordings = RecordingUploader(
            self.recordings.config.directory,
            uploader.server,
            retry_s=uploader.retry_s,
            timeout_s=uploader.timeout_s,
            delete=self.recordings.config.delete_uploaded,
            report=uploader.report,
        )
        self.recordings.finished = recordings.wake
        return recordings

    def fault(self) -> str | None:
        """Why a device that missions need does not work now, in words."""
        needed = (item for item in self.supervisors if item.driver.name not in self.assembly.others)
        return next((item.fault for item in needed if item.fault is not None), None)

    async def _log_events(self, journal: Journal) -> None:
        with self.assembly.bus.events.subscribe(size=256) as events:
            async for event in events:
                fields = self._fields(event.source)
                log.log(LEVELS[event.level], "%s: %s", event.source, event.text, extra={"fields": fields})
                await in_thread(journal.add_event, event)

    def _line(self) -> str:
        """What `systemctl status` shows."""
        gate = self.control.gate
        faults = [item.fault for item in self.supervisors if item.fault is not None]
        return describe(
            self.assembly.bus.status.latest,
            faults,
            gate.latched,
            None if self.uploader is None else self.uploader.trouble,
        )

    def _fields(self, source: str) -> dict[str, str]:
        """What an entry of systemd's journal says besides its text."""
        fields = {"ROBOTD_ROBOT": self.assembly.config.robot.name, "ROBOTD_SOURCE": source}
        status, mission = self.assembly.bus.status.latest, self.mission
        if status is not None and mission is not None:
            fields |= {
                "ROBOTD_SURVEY": mission.config.survey,
                "ROBOTD_STATE": status.state,
                "ROBOTD_STOP": str(status.stop),
            }
        return fields

    async def _note_clock(self) -> None:
        """Note which date the loop's time is; without room for that dates are not sure, but the robot works."""
        hardware = self.assembly.hardware
        utc, synchronised = hardware.utc(), hardware.is_synchronised()
        self._clock = utc - timedelta(seconds=now()), synchronised
        try:
            await in_thread(self.journal.note_clock, hardware.boot_id(), now(), utc, synchronised=synchronised)
        except StorageError as error:
            log.warning("%s", error)

    async def _watch_clock(self) -> None:
        """Note the date anew when it steps, e.g. because a time server was reached."""
        hardware = self.assembly.hardware
        async for _ in ticks(CLOCK_S):
            start, synchronised = self._clock
            step = hardware.utc() - timedelta(seconds=now()) - start
            if abs(step.total_seconds()) > STEP_S or hardware.is_synchronised() != synchronised:
                await self._note_clock()

    async def _keep_trail(self, journal: Journal) -> None:
        """Ten points a second of the way that it rolls; at rest one look, because waking up costs a Pi's core."""
        rows: list[tuple[float, float, float, float]] = []
        last, written = None, now()
        with self.assembly.bus.commands.subscribe(size=1) as wishes:
            while True:
                state, moved = self.assembly.bus.odometry.latest, False
                if state is not None and (last is None or state.pose != last.pose):
                    rows.append((state.t, state.pose.x, state.pose.y, state.pose.heading))
                    last, moved = state, True
                if now() - written >= WRITE_S:
                    note, written = self.missions.note(), now()
                    if rows or note is not None:
                        await in_thread(journal.add_trail, rows, note)
                        rows = []
                if moved or not self.control.is_resting:
                    await asyncio.sleep(TRAIL_S)
                    continue
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(WRITE_S):
                        await wishes.get()
