"""The configuration of the running daemon: what is in force, and what can change without a restart."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from .. import rpc
from ..clock import in_thread
from ..config import Config, read_toml
from ..config_views import as_toml, effective, masked
from ..control_socket import Client
from ..daemon import Plan, read_config
from ..plugin import Driver
from ..rpc import RpcError
from .table import Nothing, Operations, method

LIVE = ("mission", "upload", "safety")  # sections that are taken over as they are
EXCHANGEABLE = ("labels", "beacons")  # kinds of drivers that are replaced; nobody keeps hold of them


@dataclass(frozen=True, slots=True)
class Shown:
    """Whether defaults are shown, too."""

    effective: bool = False


@method("config.show", Shown)
async def show(operations: Operations, client: Client, shown: Shown) -> Any:
    """The configuration in force, or with `effective` false what its file says now; without secrets."""
    assembly = operations.robot.assembly
    if shown.effective:
        plans = {
            item.driver.name: Plan(item.driver.name, type(item.driver), item.driver.config)
            for item in operations.robot.supervisors
        }
        data = effective(assembly.config, plans)
    else:
        data = masked(await in_thread(read_toml, assembly.path))
    return {"path": str(assembly.path), "config": data, "toml": as_toml(data)}


@method("config.reload")
async def reload(operations: Operations, client: Client, _: Nothing) -> Any:
    """Read the configuration's file again and take over what changed, all of it or nothing."""
    async with operations.reading:
        robot = operations.robot
        assembly = robot.assembly
        config, plans = await in_thread(read_config, assembly.path)
        changed = _changed(operations, config, plans)
        operations.check_free()
        if robot.mission is not None and not robot.mission.is_over:
            raise RpcError(rpc.REFUSED, "a mission is under way; reload after it")
        drivers: dict[str, Driver] = {}
        for name in changed:
            if name.startswith("drivers."):
                plan = plans[name.removeprefix("drivers.")]
                drivers[plan.name] = plan.cls(
                    plan.name, plan.config, assembly.hardware, assembly.bus, assembly.calibration
                )
        if changed:
            robot.reconfigure(config, drivers)
        return {"changed": changed}


def _changed(operations: Operations, config: Config, plans: dict[str, Plan]) -> list[str]:
    """Sections that differ; raises RpcError naming those that need a restart."""
    old = operations.robot.assembly.config
    sections = [item.name for item in dataclasses.fields(Config) if item.name != "drivers"]
    changed = [name for name in sections if getattr(old, name) != getattr(config, name)]
    frozen = [f"[{name}]" for name in changed if name not in LIVE]
    running = {item.driver.name: item.driver for item in operations.robot.supervisors}
    for name in sorted(old.drivers.keys() | config.drivers.keys()):
        if old.drivers.get(name) == config.drivers.get(name):
            continue
        plan = plans.get(name)
        is_same = plan is not None and name in running and type(running[name]) is plan.cls
        if is_same and plan is not None and plan.cls.kind in EXCHANGEABLE:
            changed.append(f"drivers.{name}")
        else:
            frozen.append(f"[drivers.{name}]")
    if frozen:
        raise RpcError(
            rpc.REFUSED,
            f"{', '.join(frozen)} cannot change while robotd runs, so nothing was taken over; "
            "restart it: sudo systemctl restart robotd",
        )
    return changed
