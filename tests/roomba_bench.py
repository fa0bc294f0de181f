"""A Roomba driver on a simulated robot: what the tests of the driver share."""

import asyncio
import contextlib

import numpy as np
from robotd.drivers.roomba import RoombaConfig, RoombaDriver

from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration
from robotd.sim.roomba import SimRoomba
from robotd.sim.roomba_link import RoombaLink

PORT = "/dev/robotd/base"


class Wheelbarrow:
    """A body without a world: the wheels roll as they are told."""

    def __init__(self):
        self.left_rotation = self.right_rotation = 0.0
        self.bump_left = self.bump_right = self.cliff = False
        self.wheel_drop_left = self.wheel_drop_right = False
        self.t = 0.0
        self.speeds = []

    def advance(self, t, left_speed, right_speed):
        elapsed, self.t = t - self.t, t
        self.left_rotation += left_speed * elapsed
        self.right_rotation += right_speed * elapsed
        self.speeds.append((t, left_speed, right_speed))


class Bench:
    """A driver on a simulated robot; the Hardware that it is given."""

    pins = None

    def __init__(self, quirks=None, seed=1, **config):
        self.body = Wheelbarrow()
        self.robot = SimRoomba(self.body, np.random.default_rng(seed), quirks)
        self.bus = Bus()
        self.driver = RoombaDriver("base", RoombaConfig(PORT, **config), self, self.bus, Calibration())
        self.events = []
        self.frames = []
        self.link = None
        self.running = None
        publish_event, publish_frame = self.bus.events.publish, self.bus.sensors.publish
        self.bus.events.publish = lambda event: (self.events.append(event), publish_event(event))
        self.bus.sensors.publish = lambda frame: (self.frames.append(frame), publish_frame(frame))

    async def open_serial(self, port, baud):
        assert port == PORT
        self.link = link = RoombaLink(self.robot, baud)
        link.rests = []
        link.rest = link.rests.append
        return link

    @property
    def frame(self):
        return self.bus.sensors.latest

    @property
    def is_moving(self):
        return self.robot.left.speed != 0.0 or self.robot.right.speed != 0.0

    def texts(self, level=None):
        return [event.text for event in self.events if level in (None, event.level)]

    async def start(self):
        """Open the driver, let it run and arm it."""
        await self.driver.open()
        self.running = asyncio.create_task(self.driver.run())
        self.driver.arm()
        await asyncio.sleep(0.2)

    async def stop(self):
        """End the driver as its supervisor does; raises what it failed with."""
        try:
            if self.running is not None:
                if not self.running.done():
                    self.running.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await self.running
        finally:
            self.running = None
            await self.driver.close()
            await self.driver.close()

    async def drive_for(self, seconds, speed, turn_rate=0.0, period=0.03):
        """Ask for motion again and again, as the control loop does."""
        start = now()
        async for _ in ticks(period):
            if now() - start >= seconds:
                break
            self.driver.arm()
            self.driver.drive(speed, turn_rate)

    async def settle(self):
        """Halt and wait until the wheels rest and the last frame has arrived."""
        self.driver.halt()
        await asyncio.sleep(1.0)


def bench_test(scenario, **how):
    """Run `scenario(bench)` in virtual time with the driver open, running and armed, then close; returns the bench."""

    async def main():
        bench = Bench(**how)
        try:
            await bench.start()
            await scenario(bench)
        finally:
            await bench.stop()
        await asyncio.sleep(1.0)
        return bench

    return run_virtual(main())
