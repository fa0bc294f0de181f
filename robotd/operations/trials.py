"""Running all cameras and the serial line together for a while: too little USB bandwidth or power shows only then."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, cast

from ..bind import ranged
from ..control_socket import Client
from ..plugin import Camera
from ..v4l2 import MORE_ROOM, NO_ROOM
from .table import Operations, method
from .telemetry import counters

FEW = 0.8  # of the frames that were asked for
LOST = 0.02  # of the frames
WARM_UP_S = 3.0
ENOUGH_FPS = 14.0  # a flash of 100 ms is in one frame at least


@dataclass(frozen=True, slots=True)
class Trial:
    """For how long."""

    seconds: float = ranged(60.0, minimum=1.0, maximum=3600.0)


@method("test", Trial)
async def test(operations: Operations, client: Client, trial: Trial) -> Any:
    """Stream all cameras in their modes, beside the base's sensor stream; answers findings for robotctl doctor."""
    robot = operations.robot
    supervisors = {item.driver.name: item for item in robot.supervisors if item.driver.kind == "camera"}
    with operations.alone("test of all devices together"):
        names = [name for name, item in supervisors.items() if item.fault is None]
        started: list[Camera] = []
        try:
            for name in names:
                camera = cast(Camera, supervisors[name].driver)
                await camera.start(robot.recordings.mode(name))
                started.append(camera)
            await asyncio.sleep(WARM_UP_S)
            before = {name: counters(supervisors[name].driver) for name in names}
            base_before = counters(robot.assembly.base)
            await asyncio.sleep(trial.seconds)
            findings = [
                _camera(
                    name,
                    robot.recordings.mode(name).fps,
                    before[name],
                    counters(supervisors[name].driver),
                    trial.seconds,
                )
                for name in names
            ]
            findings += [_failed(name, fault) for name in names if (fault := supervisors[name].fault) is not None]
            findings.append(_base(base_before, counters(robot.assembly.base), trial.seconds))
        finally:
            for camera in started:
                await camera.stop()
    return {"findings": findings}


POWER = "a hub with a supply of its own, or fewer cameras on one USB bus"
BUS = "set fps = 15 in every camera's section, or observe in pairs: [mission] camera_groups; see the README on cameras"


def _failed(name: str, fault: str) -> dict[str, str]:
    """A camera that cannot stream beside the others: its bus is full, or the power gave way."""
    words, _, _ = fault.partition(f"; {MORE_ROOM}")
    mend = MORE_ROOM if NO_ROOM in fault else POWER
    return _finding("error", f"camera {name}", f"failed while all ran: {words}", mend)


def _camera(
    name: str, asked: float, before: dict[str, float], after: dict[str, float], seconds: float
) -> dict[str, str]:
    what = f"camera {name}, all together"
    more = {key: after.get(key, 0.0) - before.get(key, 0.0) for key in ("published", "lost", "damaged", "dropped")}
    rate = more["published"] / seconds
    every = max(1.0, sum(more.values()))
    text = f"{rate:.1f} of {asked:g} frames a second"
    if not more["published"]:
        return _finding("error", what, "no frame", f"{BUS}; {POWER}")
    if more["damaged"] > LOST * every:
        return _finding("error", what, f"{text}, {more['damaged']:.0f} damaged", POWER)
    if more["dropped"] > LOST * every:
        return _finding(
            "warning", what, f"{text}, {more['dropped']:.0f} dropped: this computer is too slow for them", BUS
        )
    if more["lost"] > LOST * every:
        return _finding("warning", what, f"{text}, {more['lost']:.0f} never arrived", BUS)
    if rate < FEW * asked:
        level = "note" if rate >= ENOUGH_FPS else "warning"
        return _finding(level, what, text, "" if level == "note" else BUS)
    return _finding("ok", what, text)


def _base(before: dict[str, float], after: dict[str, float], seconds: float) -> dict[str, str]:
    what = "serial line, all together"
    if "frames" not in after:
        return _finding("note", what, "this base does not count")
    frames, missing, late = (after[key] - before.get(key, 0.0) for key in ("frames", "missing", "late"))
    text = f"{frames / seconds:.1f} sensor frames a second, {missing:.0f} missing, {late:.0f} late"
    if frames <= 0.0 or missing > LOST * max(1.0, frames):
        return _finding("error", what, text, f"check the cable; {POWER}")
    if late > 5 * LOST * frames:
        return _finding("warning", what, text, "the computer is too busy: end other programs, lower the cameras' fps")
    return _finding("ok", what, text)


def _finding(level: str, what: str, text: str, mend: str = "") -> dict[str, str]:
    return {"level": level, "what": what, "text": text, "mend": mend}
