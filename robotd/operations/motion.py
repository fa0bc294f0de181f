"""Driving by hand, stopping, waking and docking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

from .. import rpc
from ..bind import ranged
from ..clock import now
from ..control_socket import Client
from ..errors import DriverFault
from ..plugin import Base
from ..records import Withdrawal
from ..rpc import RpcError
from .table import Nothing, Operations, method


@dataclass(frozen=True, slots=True)
class Wish:
    """`t`: the client's own clock, seconds; m/s; rad/s counter-clockwise."""

    t: float
    speed: float = ranged(0.0, minimum=-0.3, maximum=0.3)
    turn_rate: float = ranged(0.0, minimum=-3.0, maximum=3.0)


@method("drive", Wish)
def drive(operations: Operations, client: Client, wish: Wish) -> Any:
    """Move so for 0.2 s; a mission pauses meanwhile. Answers whether the wish counted, and what holds the robot."""
    robot = operations.robot
    if operations.busy is not None:
        raise RpcError(rpc.REFUSED, f"{operations.busy} is under way; robotctl halt ends it")
    if wish.speed or wish.turn_rate:
        _check_mission(operations, client)
    counted = operations.hand.wish(client, wish.t, wish.speed, wish.turn_rate)
    return {"counted": counted, "held": robot.control.cause, "latched": robot.control.gate.latched}


def _check_mission(operations: Operations, client: Client) -> None:
    mission = operations.robot.mission
    if mission is not None and not mission.is_over:
        mission.pause(f"{client.who} drives by hand")


@method("halt")
def halt(operations: Operations, client: Client, _: Nothing) -> Any:
    """Stand still until somebody asks for motion anew; a mission pauses."""
    robot = operations.robot
    cause = f"stopped by {client.who}"
    operations.bus.withdrawals.publish(Withdrawal(now(), None, cause))
    if robot.mission is not None and not robot.mission.is_over:
        robot.mission.pause(cause)
    return {}


@method("estop")
def estop(operations: Operations, client: Client, _: Nothing) -> Any:
    """Stand still until `release`; a mission pauses."""
    robot = operations.robot
    robot.control.emergency_stop(f"by {client.who}")
    if robot.mission is not None and not robot.mission.is_over:
        robot.mission.pause(f"emergency stop by {client.who}")
    return {"latched": robot.control.gate.latched}


@method("release")
def release(operations: Operations, client: Client, _: Nothing) -> Any:
    """End the emergency stop, and forget the hazards that are over; nothing moves by that."""
    operations.robot.control.release(client.who)
    return {"latched": operations.robot.control.gate.latched}


@method("wake")
def wake(operations: Operations, client: Client, _: Nothing) -> Any:
    """Look for a base that does not answer, now, which includes waking it."""
    supervisor = next(item for item in operations.robot.supervisors if item.driver is operations.robot.assembly.base)
    if supervisor.fault is None:
        return {"text": "the base is awake"}
    supervisor.restart()
    return {"text": f"waking the base: {supervisor.fault}"}


@method("dock")
async def dock(operations: Operations, client: Client, _: Nothing) -> Any:
    """Drive onto the charger by the base's own means, also in a mission's pause; a client that hangs up ends that."""
    base = cast(Base, operations.robot.assembly.base)
    with operations.alone("docking", in_pause=True):
        if (held := operations.robot.control.gate.latched) is not None:
            raise RpcError(rpc.REFUSED, f"the robot is held: {held}; robotctl release first")
        try:
            await base.dock()
        except DriverFault as fault:
            raise RpcError(rpc.FAILED, str(fault)) from fault
    return {"text": "docked and charging"}
