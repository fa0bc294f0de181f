"""Recording on the robot: what cameras show, into files that never fill the card.

`record` writes one file. `Recordings` is the daemon's service around it: it starts and stops recordings for whoever
asks (the control socket), starts cameras that nobody else uses, finishes what a power cut left behind, and lists what
there is. While a recording is being made its name ends in ".part".
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from datetime import UTC
from pathlib import Path
from typing import Any

from .bus import Bus, Subscription
from .clock import in_executor, in_thread, now
from .config import Calibration, RecordingConfig
from .errors import InputError
from .hardware import CameraMode, Hardware
from .plugin import Camera
from .recording import FrameRecorder, recover
from .recording_upload import uploaded_mark
from .records import Event, Frame

BATCH_S = 0.25  # a power cut costs this and a chunk
WAITING = 24  # frames of a camera that wait for the disk
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,119}")
PART = ".part"

About = Callable[[str], Mapping[str, str]]


@dataclass
class Progress:
    """A recording that is being made, or was: `ended` says in words why it stopped, None while it goes on."""

    path: Path
    cameras: tuple[str, ...]
    begun: float
    frames: Counter[str] = field(default_factory=Counter)
    bytes: int = 0
    seconds: float = 0.0
    dropped: int = 0  # frames that the disk was too slow for
    ended: str | None = None
    stop: asyncio.Event = field(default_factory=asyncio.Event)


async def record(
    bus: Bus,
    cameras: Sequence[str],
    path: Path,
    *,
    limit: int,
    seconds: float = math.inf,
    keep_free: int = 0,
    raw: bool = False,
    about: Mapping[str, str] | None = None,
    describe: About | None = None,
    progress: Progress | None = None,
) -> Progress:
    """Record what cameras publish until `progress.stop` is set, a limit is reached, or it is cancelled.

    Writing is done in a thread, and the disk is made to keep it four times a second. If the disk is too slow the
    oldest waiting frames are dropped and counted.

    Parameters
    ----------
    cameras : sequence of str
        Instances of camera drivers; somebody else starts them.
    path : Path
        Overwritten if it exists.
    limit, keep_free : int
        Bytes that the file may take, and that the file system shall keep free.
    seconds : float
        Longest duration.
    raw : bool
        Keep grey levels also of frames that came as JPEG.
    about : mapping of str to str, optional
        Goes into the file once.
    describe : callable, optional
        How a camera's frames are being taken, by its name.
    progress : Progress, optional
        Kept up to date; a new one is made by default.

    Returns
    -------
    Progress
        Of the finished file.

    Raises
    ------
    InputError
        The file cannot be written; what was written before can be read.
    """
    done = progress or Progress(path, tuple(cameras), now())
    recorder = FrameRecorder(path, limit, about)
    ending = done.begun + seconds
    with ExitStack() as stack:
        queues = [stack.enter_context(bus.frames(name).subscribe(size=WAITING)) for name in cameras]
        disk = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="recording"))  # one: nothing overtakes
        try:
            await in_executor(disk, recorder.__enter__)
            try:
                while done.ended is None:
                    await _pause(done.stop, min(BATCH_S, ending - now()))
                    batch = _taken(queues, raw=raw)
                    is_written = await in_executor(disk, _write_batch, recorder, batch, now(), describe, keep_free)
                    done.frames.update(frame.camera for frame in batch[:is_written])
                    done.bytes, done.seconds = recorder.size, now() - done.begun
                    done.dropped = sum(queue.dropped for queue in queues)
                    done.ended = _why_ended(recorder, done, is_written < len(batch), ending)
            finally:
                await in_executor(disk, recorder.__exit__, None, None, None)
                done.bytes = recorder.size
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    return done


async def _pause(stop: asyncio.Event, seconds: float) -> None:
    try:
        async with asyncio.timeout(seconds):
            await stop.wait()
    except TimeoutError:
        pass


def _taken(queues: Sequence[Subscription[Frame]], *, raw: bool) -> list[Frame]:
    batch = [queue.take() for queue in queues for _ in range(queue.waiting)]
    if raw:
        batch = [Frame(frame.camera, frame.t, frame.image, frame.sequence) for frame in batch]
    return sorted(batch, key=lambda frame: frame.t)


def _write_batch(
    recorder: FrameRecorder, batch: Sequence[Frame], t: float, describe: About | None, keep_free: int
) -> int:
    """Write frames as long as there is room; returns how many were written."""
    state = os.statvfs(recorder.path.parent)
    room = state.f_bavail * state.f_frsize - keep_free
    written = 0
    for frame in batch:
        room -= len(frame.encoded) if frame.encoded is not None else frame.image.nbytes
        if room < 0 or recorder.is_full:
            break
        recorder.frame(frame, max(t, frame.t), describe(frame.camera) if describe is not None else None)
        written += not recorder.is_full
    recorder.sync()
    return written


def _why_ended(recorder: FrameRecorder, progress: Progress, is_cut: bool, ending: float) -> str | None:
    if recorder.is_full:
        return "it has reached its size limit"
    if is_cut:
        return "the card has no more room to spare"
    if progress.stop.is_set():
        return "stopped on request"
    return "its time is over" if now() >= ending else None


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A recording on the robot's card."""

    name: str
    bytes: int
    is_uploaded: bool


class Recordings:
    """The daemon's recordings, one at a time; `run` does the work, everything else asks for it.

    Parameters
    ----------
    config : RecordingConfig
        `directory` absolute.
    robot : str
        The robot's name: default names begin with it.
    cameras : mapping of str to Camera
        Those that can be recorded.
    mode : callable
        How a camera runs that nobody else has started, by its name.
    groups : sequence of sequences of str
        Cameras that can stream at the same time; empty: all can.
    pattern
        How labels flash, for whoever reads the file.
    is_busy : callable
        Whether a mission uses the cameras, which then belong to it.
    """

    def __init__(
        self,
        config: RecordingConfig,
        robot: str,
        *,
        bus: Bus,
        hardware: Hardware,
        calibration: Calibration,
        cameras: Mapping[str, Camera],
        mode: Callable[[str], CameraMode],
        groups: Sequence[Sequence[str]] = (),
        pattern: Any = None,
        is_busy: Callable[[], bool] = lambda: False,
        finished: Callable[[], None] = lambda: None,
    ) -> None:
        self.config = config
        self.robot = robot
        self.bus = bus
        self.hardware = hardware
        self.calibration = calibration
        self.cameras = dict(cameras)
        self.mode = mode
        self.groups = [tuple(group) for group in groups]
        self.pattern = pattern
        self.is_busy = is_busy
        self.finished = finished
        self._last: Progress | None = None
        self._asked: dict[str, Any] | None = None
        self._wake = asyncio.Event()
        self._is_idle = asyncio.Event()
        self._is_idle.set()
        self._described: dict[tuple[str, CameraMode | None], dict[str, str]] = {}

    # ---- for whoever asks --------------------------------------------------------------------------------------------

    async def start(
        self,
        cameras: Sequence[str] = (),
        *,
        name: str | None = None,
        seconds: float | None = None,
        limit_mb: float | None = None,
        raw: bool | None = None,
    ) -> dict[str, Any]:
        """Begin a recording; returns `status`.

        Parameters
        ----------
        cameras : sequence of str
            Default: every camera of the rig, or the first group of them; without a calibrated rig all there are.
        name : str, optional
            Of the file, without ".mcap"; default: robot and date.
        seconds, limit_mb, raw
            Default: those of the configuration, which are also the most that is allowed.

        Raises
        ------
        InputError
            Names every mistake; or a recording is being made already.
        """
        if not self._is_idle.is_set():
            raise InputError(f"a recording is being made already: {self._last and self._last.path.stem}; stop it first")
        chosen = tuple(dict.fromkeys(cameras)) or (self.groups[0] if self.groups else tuple(self._rig or self.cameras))
        name = name or f"{_plain(self.robot)}-{self.hardware.utc().astimezone(UTC):%Y%m%dT%H%M%SZ}"
        problems = [*self._check_cameras(chosen), *self._check_name(name)]
        config = self.config
        most_s, most_mb = seconds or config.seconds, limit_mb or config.limit_mb
        if not 0.0 < most_s <= config.seconds:
            problems.append(f"seconds: found {most_s:g}; expected above 0 and at most {config.seconds:g}")
        if not 0.0 < most_mb <= config.limit_mb:
            problems.append(f"limit_mb: found {most_mb:g}; expected above 0 and at most {config.limit_mb:g}")
        if problems:
            raise InputError(*problems)
        self._asked = {
            "limit": round(1e6 * most_mb),
            "seconds": most_s,
            "raw": config.raw if raw is None else raw,
        }
        self._last = Progress(config.directory / f"{name}.mcap", chosen, now())
        self._is_idle.clear()
        self._wake.set()
        return self.status()

    async def stop(self) -> dict[str, Any]:
        """End the recording that is being made, if any, wait for its file to be complete, and return `status`."""
        if self._last is not None:
            self._last.stop.set()
        await self._is_idle.wait()
        return self.status()

    def status(self) -> dict[str, Any]:
        """Of the recording that is being made, or of the last one: plain values, ready for JSON."""
        last = self._last
        if last is None:
            return {"recording": False}
        return {
            "recording": not self._is_idle.is_set(),
            "name": last.path.stem,
            "file": str(last.path),
            "cameras": list(last.cameras),
            "seconds": round(last.seconds, 3),
            "bytes": last.bytes,
            "frames": dict(last.frames),
            "dropped": last.dropped,
            "ended": last.ended,
        }

    async def files(self) -> list[RecordingFile]:
        """The finished recordings on the card."""
        return await in_thread(list_recordings, self.config.directory)

    # ---- the work ----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Until cancelled: finish what was cut off, then make the recordings that are asked for."""
        for text in await in_thread(finish_parts, self.config.directory, round(1e6 * self.config.keep_free_mb)):
            self._report(text, "warning")
        while True:
            await self._wake.wait()
            self._wake.clear()
            assert self._last is not None
            assert self._asked is not None
            try:
                await self._record(self._last, self._asked)
            except InputError as error:
                self._last.ended = str(error)
                self._report(str(error), "error")
            finally:
                self._is_idle.set()
            self.finished()

    async def _record(self, progress: Progress, asked: Mapping[str, Any]) -> None:
        path, config = progress.path, self.config
        part = path.with_name(path.name + PART)
        try:
            await in_thread(path.parent.mkdir, parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path.parent}: cannot be made: {error.strerror or error}") from error
        started = await self._start_cameras(progress.cameras)
        is_broken = False
        try:
            self._report(f"recording {', '.join(progress.cameras)} to {path.name}")
            await record(
                self.bus,
                progress.cameras,
                part,
                keep_free=round(1e6 * config.keep_free_mb),
                about=self._about(),
                describe=self._describe,
                progress=progress,
                **asked,
            )
        except InputError:
            is_broken = True  # what is in it can be read, and is finished at the next start
            raise
        finally:
            for name, mode in started.items():
                if not self.is_busy() and getattr(self.cameras[name], "wanted", mode) == mode:
                    await self.cameras[name].stop()
            if progress.bytes and not is_broken:
                await in_thread(_finish, part, path)
        megabytes = progress.bytes / 1e6
        text = f"{path.name}: {sum(progress.frames.values())} frames, {progress.seconds:.1f} s, {megabytes:.1f} MB"
        lost = f"; {progress.dropped} frames were lost because the card is too slow" if progress.dropped else ""
        self._report(f"{text}; {progress.ended}{lost}", "warning" if lost else "info")

    async def _start_cameras(self, names: Sequence[str]) -> dict[str, CameraMode]:
        """Start those that nobody uses."""
        started: dict[str, CameraMode] = {}
        if self.is_busy():
            return started
        for name in names:
            camera = self.cameras[name]
            if getattr(camera, "wanted", None) is None:
                started[name] = self.mode(name)
                await camera.start(started[name])
        return started

    def _describe(self, name: str) -> Mapping[str, str]:
        """How the frames of a camera are being taken, as texts."""
        camera = self.cameras[name]
        given: CameraMode | None = getattr(camera, "given", None)
        key = name, given
        if key not in self._described:
            self._described[key] = describe_camera(name, camera, given, self.calibration)
        return self._described[key]

    def _about(self) -> dict[str, str]:
        return describe_recording(self.robot, self.hardware, self.calibration, self.pattern)

    @property
    def _rig(self) -> list[str]:
        return [camera.name for camera in self.calibration.cameras if camera.name in self.cameras]

    def _check_cameras(self, names: Sequence[str]) -> list[str]:
        known = ", ".join(sorted(self.cameras))
        problems = [f"no camera '{name}'; expected some of {known}" for name in names if name not in self.cameras]
        rig = {name for name in names if name in self._rig}
        if self.groups and not problems and not any(rig <= set(group) for group in self.groups):
            groups = " or ".join(", ".join(group) for group in self.groups)
            problems.append(f"{', '.join(names)} cannot stream at once (mission.camera_groups); record {groups}")
        return problems

    def _check_name(self, name: str) -> list[str]:
        if not NAME.fullmatch(name):
            return [f"name: found {name[:60]!r}; expected letters, digits, '.', '_' and '-', at most 120"]
        path = self.config.directory / f"{name}.mcap"
        if path.exists() or path.with_name(path.name + PART).exists():
            return [f"name: there is a recording {name} already; choose another name"]
        return []

    def _report(self, text: str, level: Any = "info") -> None:
        self.bus.events.publish(Event(now(), "recording", level, text))


def describe_recording(robot: str, hardware: Hardware, calibration: Calibration, pattern: Any) -> dict[str, str]:
    """What holds for a whole recording, as texts; JSON where it has a structure."""
    about = {
        "robot": robot,
        "created": hardware.utc().astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "boot_id": hardware.boot_id(),
        "loop_time": repr(now()),
        "gamma": repr(calibration.gamma),
        "row_time_s": repr(calibration.row_time_s),
    }
    if pattern is not None:
        about["pattern"] = json.dumps(asdict(pattern))
    return about


def describe_camera(name: str, camera: Any, given: CameraMode | None, calibration: Calibration) -> dict[str, str]:
    """How the frames of a camera are taken: channel, mode as the camera agreed to it, its calibration."""
    about = {"channel": str(getattr(getattr(camera, "config", None), "channel", "gray"))}
    if given is not None:
        about["mode"] = json.dumps(asdict(given))
    models = {model.name: model for model in calibration.cameras}
    model = models.get(name, calibration.floor_camera)
    if model is not None:
        about["calibration"] = json.dumps(asdict(model))
    return about


def list_recordings(directory: Path) -> list[RecordingFile]:
    """The finished recordings in a folder, by name."""
    files = sorted(directory.glob("*.mcap")) if directory.is_dir() else []
    return [RecordingFile(path.stem, path.stat().st_size, uploaded_mark(path).exists()) for path in files]


def finish_parts(directory: Path, keep_free: int = 0) -> list[str]:
    """Make whole recordings of those that were cut off by a power cut; returns what became of each, in words."""
    told = []
    for part in sorted(directory.glob("*.mcap" + PART)) if directory.is_dir() else []:
        path = part.with_name(part.name.removesuffix(PART))
        state = os.statvfs(directory)
        try:
            if state.f_bavail * state.f_frsize < part.stat().st_size + keep_free:
                told.append(f"{part.name} was cut off, and there is no room to finish it; what is in it can be read")
                continue
            contents = recover(part, path)
            part.unlink()
        except (InputError, OSError) as error:
            told.append(f"{part.name} was cut off and cannot be finished: {error}")
            continue
        told.append(f"{path.name} was cut off; {sum(contents.frames.values())} frames of it are kept")
    return told


def _finish(part: Path, path: Path) -> None:
    with part.open("rb+") as file:
        os.fsync(file.fileno())
    part.replace(path)
    handle = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-") or "robot"
