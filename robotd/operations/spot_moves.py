"""Small movements of a calibration: on the spot, or a little straight ahead."""

from __future__ import annotations

import asyncio
import math

from ..clock import now
from ..errors import DriverFault, MissionError
from ..records import DriveCommand
from ..wheel_runs import SOURCE
from .table import Operations

TURN_RATE = 0.5  # rad/s
SPEED = 0.1  # m/s
FRAME_S = 5.0
STUCK_S = 3.0
_STANDS_M_S = 0.002


async def turn(operations: Operations, angle: float) -> None:
    """Turn on the spot, by radians counter-clockwise; raises MissionError when something holds the robot."""
    await _move(operations, 0.0, math.copysign(TURN_RATE, angle), abs(angle))


async def straight(operations: Operations, distance: float) -> None:
    """Drive ahead, by metres; raises MissionError when something holds the robot."""
    await _move(operations, SPEED, 0.0, distance)


async def stand(operations: Operations, quiet_s: float) -> None:
    """Wait until the wheels have stood still for so long."""
    since = now()
    while now() - since < quiet_s:
        await asyncio.sleep(0.05)
        state = operations.bus.odometry.latest
        if state is None or abs(state.speed) > _STANDS_M_S or abs(state.turn_rate) > 10 * _STANDS_M_S:
            since = now()


async def _move(operations: Operations, speed: float, turn_rate: float, amount: float) -> None:
    control, bus = operations.robot.control, operations.bus
    done, moved = 0.0, now()
    with bus.odometry.subscribe(size=2) as states:
        try:
            async with asyncio.timeout(FRAME_S):
                before = await states.get()
        except TimeoutError:
            raise DriverFault("the base sends no sensor frames") from None
        while done < amount:
            bus.commands.publish(DriveCommand(now(), speed, turn_rate, SOURCE))
            try:
                async with asyncio.timeout(1.0):
                    state = await states.get()
            except TimeoutError:
                raise DriverFault("the base sends no sensor frames") from None
            turned = math.remainder(state.pose.heading - before.pose.heading, 2.0 * math.pi)
            step = math.copysign(1.0, turn_rate) * turned if turn_rate else state.travelled - before.travelled
            done, before = done + step, state
            moved = state.t if step else moved
            if (held := control.gate.latched) is not None or now() - moved > STUCK_S:
                raise MissionError(f"the robot was stopped: {held or control.cause or 'it does not move'}")
        bus.commands.publish(DriveCommand(now(), 0.0, 0.0, SOURCE))
