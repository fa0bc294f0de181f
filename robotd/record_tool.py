"""`robotd record`: record cameras of the configuration without a mission, and without base, labels or journal.

The daemon must not run, because a camera is open once: ask it with `robotctl record` instead.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from .bus import Bus
from .clock import in_thread, now
from .config import Calibration, Config, load_calibration
from .daemon import Plan, read_config
from .errors import DriverFault, InputError
from .hardware import CameraMode, Hardware, flicker_free
from .plugin import Camera, Driver
from .recorder import Progress, describe_camera, describe_recording, record
from .supervisor import Supervisor

OPEN_S = 10.0  # for a camera to show its first frame


def run(arguments: argparse.Namespace) -> int:
    """Run `robotd record`; returns the exit code. Raises InputError and DriverFault."""
    from .real import RealHardware

    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    config, plans = read_config(arguments.config)
    names = choose(plans, arguments.cameras, arguments.config)
    path = arguments.config.parent / config.robot.calibration
    calibration = load_calibration(path) if path.exists() else Calibration()
    done = asyncio.run(_until_told(config, plans, names, calibration, RealHardware(), arguments))
    result = {
        "file": str(done.path),
        "cameras": list(done.cameras),
        "seconds": round(done.seconds, 3),
        "bytes": done.bytes,
        "frames": dict(done.frames),
        "dropped": done.dropped,
        "ended": done.ended,
    }
    if arguments.json:
        print(json.dumps(result))
    else:
        frames = ", ".join(f"{name} {count}" for name, count in done.frames.items()) or "no"
        print(f"{done.path}: {frames} frames in {done.seconds:.1f} s, {done.bytes / 1e6:.1f} MB; {done.ended}")
    return 0 if done.frames else 1


def choose(plans: dict[str, Plan], wanted: Sequence[str], path: Path) -> tuple[str, ...]:
    """The cameras to record, by default all of the configuration; raises InputError naming those there are."""
    known = [name for name, plan in plans.items() if plan.cls.kind == "camera"]
    unknown = [name for name in wanted if name not in known]
    if unknown:
        raise InputError(f"{path}: no camera {', '.join(unknown)}; expected some of {', '.join(known) or 'none'}")
    return tuple(dict.fromkeys(wanted)) or tuple(known)


async def _until_told(
    config: Config,
    plans: dict[str, Plan],
    names: Sequence[str],
    calibration: Calibration,
    hardware: Hardware,
    arguments: argparse.Namespace,
) -> Progress:
    progress = Progress(arguments.output, tuple(names), now())
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, progress.stop.set)
    limit, keep_free = (arguments.limit_mb or config.recording.limit_mb), config.recording.keep_free_mb
    return await record_cameras(
        config,
        plans,
        calibration,
        hardware,
        progress,
        seconds=arguments.seconds or config.recording.seconds,
        limit=round(1e6 * limit),
        keep_free=round(1e6 * keep_free),
        raw=arguments.raw or config.recording.raw,
    )


async def record_cameras(
    config: Config,
    plans: dict[str, Plan],
    calibration: Calibration,
    hardware: Hardware,
    progress: Progress,
    **limits: Any,
) -> Progress:
    """Open the cameras that `progress` names, record them, and close them again.

    Raises
    ------
    DriverFault
        A camera cannot be opened, or fails before its first frame.
    InputError
        The file cannot be written.
    """
    bus = Bus()
    drivers: dict[str, Driver] = {
        name: plans[name].cls(name, plans[name].config, hardware, bus, calibration) for name in progress.cameras
    }
    mission = config.mission
    standing = CameraMode(
        exposure=flicker_free(mission.identify.exposure_s, mission.mains_hz), mains_hz=mission.mains_hz
    )
    supervisors = [Supervisor(driver) for driver in drivers.values()]
    tasks = [asyncio.ensure_future(supervisor.run()) for supervisor in supervisors]
    try:
        for name, driver in drivers.items():
            size = _size(name, calibration)
            await cast(Camera, driver).start(standing if size is None else CameraMode(size, 30.0, standing.exposure))
        await _wait_frames(bus, supervisors)
        await in_thread(progress.path.parent.mkdir, parents=True, exist_ok=True)
        progress.begun = now()
        return await record(
            bus,
            progress.cameras,
            progress.path,
            about=describe_recording(config.robot.name, hardware, calibration, mission.identify.pattern),
            describe=lambda name: describe_camera(
                name, drivers[name], getattr(drivers[name], "given", None), calibration
            ),
            progress=progress,
            **limits,
        )
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _size(name: str, calibration: Calibration) -> tuple[int, int] | None:
    """Of a calibrated camera's images."""
    known = {model.name: model.size for model in calibration.cameras}
    if calibration.floor_camera is not None:
        known.setdefault("floor", calibration.floor_camera.size)
    return known.get(name)


async def _wait_frames(bus: Bus, supervisors: Sequence[Supervisor]) -> None:
    """Until every camera has shown a frame; raises DriverFault with the first one's reason."""
    deadline = now() + OPEN_S
    for supervisor in supervisors:
        while bus.frames(supervisor.driver.name).latest is None:
            if supervisor.fault is not None and supervisor.restarts > 0:
                raise DriverFault(supervisor.fault)
            if now() > deadline:
                raise DriverFault(supervisor.fault or f"{supervisor.driver.name}: no frame for {OPEN_S:g} s")
            await asyncio.sleep(0.05)
