"""What the robot does now: once, or again and again to whoever listens; while nobody does it costs nothing."""

from __future__ import annotations

import asyncio
from dataclasses import asdict, dataclass, is_dataclass
from datetime import timedelta
from typing import Any

from .. import __version__
from ..bind import ranged
from ..clock import in_thread, now, ticks
from ..control_socket import Client
from ..plugin import Driver
from ..records import Event
from ..supervisor import Supervisor
from .missions import mission_status
from .table import Nothing, Operations, method

QUEUE = 32  # events that wait for a slow client
TRAIL_POINTS = 600


@dataclass(frozen=True, slots=True)
class Subscription:
    """Samples a second of `telemetry`, 0: none; whether every `event` is told."""

    rate: float = ranged(5.0, minimum=0.0, maximum=20.0)
    events: bool = True


@dataclass(frozen=True, slots=True)
class Logs:
    """The newest `count` events of at least `level`; with `after` only those of a greater number."""

    count: int = ranged(50, minimum=1, maximum=5000)
    level: str = "info"
    after: int = ranged(0, minimum=0)


@method("status")
async def status(operations: Operations, client: Client, _: Nothing) -> Any:
    """Everything on one screen."""
    robot = operations.robot
    config, hardware = robot.assembly.config, robot.assembly.hardware
    uploader = robot.uploader
    return {
        "robot": config.robot.name,
        "robotd": __version__,
        "utc": hardware.utc().isoformat(timespec="seconds"),
        "clock_is_synchronised": hardware.is_synchronised(),
        **telemetry(operations),
        "drivers": drivers(operations),
        "uploads": {
            "url": config.upload.url,
            "waiting": await in_thread(robot.journal.waiting),
            "trouble": None if uploader is None else uploader.trouble,
        },
        "journal_rows_dropped": robot.journal.dropped,
    }


def telemetry(operations: Operations) -> dict[str, Any]:
    """What changes from moment to moment."""
    robot, bus = operations.robot, operations.bus
    state, frame, line = bus.odometry.latest, bus.sensors.latest, bus.line_status.latest
    recording = robot.recordings.status()
    return {
        "t": now(),
        "pose": None
        if state is None
        else {
            "x": state.pose.x,
            "y": state.pose.y,
            "heading": state.pose.heading,
            "speed": state.speed,
            "turn_rate": state.turn_rate,
            "travelled": state.travelled,
        },
        "base": None
        if frame is None
        else {
            "age": now() - frame.t,
            "mode": frame.mode,
            "voltage": frame.voltage,
            "charge": frame.charge_fraction,
            "docked": frame.docked,
            "charging": frame.charging,
            "bump": frame.bump_left or frame.bump_right,
            "cliff": frame.cliff,
            "wheel_drop": frame.wheel_drop_left or frame.wheel_drop_right,
            "slipping": frame.slipping,
        },
        "line": None if line is None else {"state": line.state, "confidence": line.confidence, "offset": line.offset},
        "held": robot.control.cause,
        "latched": robot.control.gate.latched,
        "driven_by": operations.hand.driver,
        "busy": operations.busy,
        "mission": mission_status(operations),
        "recording": recording if recording["recording"] else None,
    }


@method("subscribe", Subscription)
async def subscribe(operations: Operations, client: Client, wanted: Subscription) -> Any:
    """Send `telemetry` and `event` until the client hangs up; it is never answered."""
    async with asyncio.TaskGroup() as group:
        if wanted.events:
            group.create_task(_send_events(operations, client))
        if wanted.rate > 0.0:
            group.create_task(_send_telemetry(operations, client, 1.0 / wanted.rate))
        await asyncio.Event().wait()


async def _send_telemetry(operations: Operations, client: Client, period: float) -> None:
    async for _ in ticks(period):
        await client.tell("telemetry", telemetry(operations))


async def _send_events(operations: Operations, client: Client) -> None:
    with operations.bus.events.subscribe(size=QUEUE) as events:
        async for event in events:
            await client.tell("event", _plain_event(operations, event))


def _plain_event(operations: Operations, event: Event) -> dict[str, Any]:
    utc = operations.robot.assembly.hardware.utc() - timedelta(seconds=now() - event.t)
    date = utc.isoformat(timespec="milliseconds")
    return {"utc": date, "source": event.source, "level": event.level, "text": event.text}


@method("logs", Logs)
async def logs(operations: Operations, client: Client, wanted: Logs) -> Any:
    """Events from the journal, oldest first."""
    level = wanted.level if wanted.level in ("info", "warning", "error") else "info"
    found = await in_thread(operations.robot.journal.events, wanted.count, level=level, after=wanted.after)
    return {"events": [asdict(event) for event in found]}


@method("trail")
async def trail(operations: Operations, client: Client, _: Nothing) -> Any:
    """Where the robot drove in this leg: x, y, thinned out."""
    rows = await in_thread(operations.robot.journal.trail, 36000)
    step = max(1, len(rows) // TRAIL_POINTS)
    return {"points": [(round(x, 3), round(y, 3)) for _, x, y, _ in rows[::step]]}


# ---- drivers ---------------------------------------------------------------------------------------------------------


def drivers(operations: Operations) -> list[dict[str, Any]]:
    """Every driver, and how it does."""
    sections = operations.robot.assembly.config.drivers
    return [
        {
            "name": supervisor.driver.name,
            "kind": supervisor.driver.kind,
            "driver": sections.get(supervisor.driver.name, {}).get("driver"),
            "state": "off" if supervisor.is_off else "ok" if supervisor.fault is None else "fault",
            "fault": supervisor.fault,
            "restarts": supervisor.restarts,
            "counters": counters(supervisor.driver),
        }
        for supervisor in operations.robot.supervisors
    ]


def counters(driver: Driver) -> dict[str, float]:
    """What a driver counts, if it does."""
    found = getattr(driver, "counters", None)
    return asdict(found) if is_dataclass(found) and not isinstance(found, type) else {}


def supervisor_of(operations: Operations, name: str) -> Supervisor | None:
    """The supervisor of a driver's instance, or None."""
    return next((item for item in operations.robot.supervisors if item.driver.name == name), None)
