"""The safety gate and the control loop: what a sensor frame costs after it was decoded."""

from __future__ import annotations

import asyncio
import time

import numpy as np

from robotd import oi
from robotd.bus import Bus
from robotd.control import ControlLoop
from robotd.odometry import Odometry, Wheels
from robotd.records import DriveCommand, SensorFrame
from robotd.safety import SafetyGate, SafetyLimits

from .table import Row, median_ms

FRAMES = 5000
STEP = 0.003  # m a frame


class _Base:
    """Obeys without doing anything."""

    name = "base"

    def drive(self, speed: float, turn_rate: float) -> None:
        pass

    def halt(self) -> None:
        pass

    def arm(self) -> None:
        pass

    async def dock(self) -> None:
        pass


def rows() -> list[Row]:
    """The gate alone, and the whole loop with odometry and wake-ups, against decoding the frame."""
    ids = (7, 9, 10, 11, 12, 14, 21, 22, 25, 26, 35, 43, 44)
    frame = oi.encode_stream_frame(ids, dict.fromkeys(ids, 0), "inclusive")
    decoder = oi.StreamDecoder(ids, "inclusive")
    decoding = median_ms(lambda: decoder.feed(frame), FRAMES)
    return [
        Row("safety gate, one frame and one wish", _gate_ms(), "decoding the frame", decoding),
        Row("control loop, one frame and one wish", asyncio.run(_loop_ms()), "decoding the frame", decoding),
    ]


def _gate_ms() -> float:
    gate = SafetyGate(SafetyLimits())
    gate.sensors(SensorFrame(0.0, 0.0, 0.0, "safe"))
    count = iter(range(10**9))

    def step() -> None:
        k = next(count)
        t = 1.0 + k * oi.TICK
        gate.sensors(SensorFrame(t, k * STEP, k * STEP, "safe"))
        gate.command(DriveCommand(t, 0.2, 0.1, "follower", t - 0.1))
        assert gate.output(t).cause is None

    return median_ms(step, FRAMES)


async def _loop_ms() -> float:
    """Median over the frames: the loop's tasks wake, one after the other, and sleep again."""
    bus = Bus()
    loop = ControlLoop(bus, _Base(), Odometry(Wheels()), SafetyGate(SafetyLimits()))
    running = asyncio.create_task(loop.run())
    await asyncio.sleep(0)
    now = asyncio.get_running_loop().time
    times = []
    for k in range(FRAMES):
        begun = time.perf_counter()
        bus.sensors.publish(SensorFrame(now(), k * STEP, k * STEP, "safe"))
        bus.commands.publish(DriveCommand(now(), 0.2, 0.1, "follower", now()))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        times.append(time.perf_counter() - begun)
    running.cancel()
    await asyncio.wait([running])
    return 1e3 * float(np.median(times))
