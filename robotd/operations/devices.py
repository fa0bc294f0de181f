"""Drivers, beacons and recordings."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from .. import rpc
from ..bind import ranged
from ..control_socket import Client
from ..rpc import RpcError
from .table import Nothing, Operations, method
from .telemetry import drivers, supervisor_of


@dataclass(frozen=True, slots=True)
class Name:
    """A driver's instance."""

    name: str


@dataclass(frozen=True, slots=True)
class Switch:
    """Whether the beacons shall flash; default: as it is."""

    on: bool | None = None


@dataclass(frozen=True, slots=True)
class Wanted:
    """See robotd.recorder.Recordings.start."""

    cameras: tuple[str, ...] = ()
    name: str | None = None
    seconds: float | None = ranged(None, minimum=0.1)
    limit_mb: float | None = ranged(None, minimum=0.1)
    raw: bool | None = None


@method("drivers.list")
def listing(operations: Operations, client: Client, _: Nothing) -> Any:
    """Every driver, and how it does."""
    return {"drivers": drivers(operations)}


@method("drivers.restart", Name)
def restart(operations: Operations, client: Client, which: Name) -> Any:
    """Close a driver and open it again; a mission waits for it."""
    supervisor = supervisor_of(operations, which.name)
    if supervisor is None:
        names = ", ".join(item.driver.name for item in operations.robot.supervisors)
        raise RpcError(rpc.REFUSED, f"there is no driver '{which.name}'; there is {names}")
    supervisor.driver.report(f"restarted by {client.who}")
    supervisor.restart()
    return {}


@method("beacons", Switch)
def beacons(operations: Operations, client: Client, switch: Switch) -> Any:
    """Whether the beacons flash, and how fast; switches them on or off."""
    driver = operations.robot.assembly.beacons
    supervisor = None if driver is None else supervisor_of(operations, driver.name)
    if driver is None or supervisor is None:
        raise RpcError(rpc.REFUSED, "this robot has no beacons: no driver of kind 'beacons' is configured")
    if switch.on is not None:
        supervisor.switch(on=switch.on)
    rates = getattr(driver, "rates", None)
    return {
        "state": "off" if supervisor.is_off else "on" if supervisor.fault is None else "fault",
        "fault": supervisor.fault,
        "front_hz": getattr(rates, "front_hz", None),
        "rear_hz": getattr(rates, "rear_hz", None),
    }


@method("record.start", Wanted)
async def record_start(operations: Operations, client: Client, wanted: Wanted) -> Any:
    """Record cameras (MCAP); those that nobody uses are started for it."""
    return await operations.robot.recordings.start(
        wanted.cameras, name=wanted.name, seconds=wanted.seconds, limit_mb=wanted.limit_mb, raw=wanted.raw
    )


@method("record.stop")
async def record_stop(operations: Operations, client: Client, _: Nothing) -> Any:
    """End the recording; its file is complete when this is answered."""
    return await operations.robot.recordings.stop()


@method("record.status")
def record_status(operations: Operations, client: Client, _: Nothing) -> Any:
    """The recording that is being made, or the last one."""
    return operations.robot.recordings.status()


@method("record.list")
async def record_list(operations: Operations, client: Client, _: Nothing) -> Any:
    """The finished recordings on the card."""
    found = await operations.robot.recordings.files()
    return {"recordings": [_plain(item) for item in found]}


def _plain(item: Any) -> dict[str, Any]:
    values = {field.name: getattr(item, field.name) for field in fields(item)}
    return {name: str(value) if isinstance(value, Path) else value for name, value in values.items()}
