"""What hazard tests share: a simulated robot with real driver and control loop, states to be in, hazards to meet."""

import asyncio
import math
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from robotd.drivers.roomba import RoombaConfig, RoombaDriver

from robotd import oi
from robotd.bus import Bus
from robotd.clock import now, run_virtual, stall, ticks
from robotd.config import Calibration
from robotd.control import ControlLoop
from robotd.odometry import Odometry, Wheels
from robotd.records import OPERATOR, DriveCommand, Withdrawal
from robotd.safety import SafetyGate, SafetyLimits
from robotd.sim.roomba import SimRoomba
from robotd.sim.roomba_link import RoombaLink
from robotd.supervisor import Supervisor

PORT = "/dev/robotd/base"
REACTION = 0.100  # s from the last byte that carries the hazard to the first byte of zero speed
BRAKING = 0.45  # s that the wheels need from 0.3 m/s at the robot's own 0.75 m/s^2
EPSILON = 1e-9


class Trolley:
    """A body without a world: the wheels roll as they are told, contacts come from the test."""

    def __init__(self):
        self.left_rotation = self.right_rotation = 0.0
        self.bump_left = self.bump_right = self.cliff = False
        self.wheel_drop_left = self.wheel_drop_right = False
        self.t = 0.0
        self.speeds = (0.0, 0.0)

    def advance(self, t, left_speed, right_speed):
        elapsed, self.t = t - self.t, t
        self.left_rotation += left_speed * elapsed
        self.right_rotation += right_speed * elapsed
        self.speeds = (left_speed, right_speed)


class Wire:
    """The driver's serial link, with a listener: when bytes arrived, and when each drive command's first byte left."""

    def __init__(self, link, baud):
        self.link = link
        self.baud = baud
        self.is_cut = False  # to the host: the robot still hears
        self.arrivals = []
        self.drives = []  # (time of the first byte, right mm/s, left mm/s)
        self._free = 0.0
        self._decoder = oi.CommandDecoder()
        self.pulse_wake, self.rest, self.close = link.pulse_wake, link.rest, link.close

    async def read(self):
        while True:
            t, data = await self.link.read()
            if not self.is_cut:
                self.arrivals.append(t)
                return t, data

    def write(self, data):
        self.link.write(data)
        start = max(self._free, now())
        for command in self._decoder.feed(data):
            if isinstance(command, oi.Command) and command.name == "drive_direct":
                self.drives.append((start, *command.values))
        self._free = start + len(data) * 10.0 / self.baud

    def set_baud(self, baud):
        self.baud = baud
        self.link.set_baud(baud)


@dataclass
class Course:
    """One robot with its driver and control loop, and somebody who wishes to move."""

    body: Trolley = field(default_factory=Trolley)
    bus: Bus = field(default_factory=Bus)
    pins: object = None
    source: str = "follower"
    speed: float = 0.0
    turn_rate: float = 0.0
    wishes: bool = False
    line_t: float | None = None
    sees_line: bool = True

    def __post_init__(self):
        self.robot = SimRoomba(self.body, np.random.default_rng(1))
        self.driver = RoombaDriver("base", RoombaConfig(PORT), self, self.bus, Calibration())
        self.loop = ControlLoop(self.bus, self.driver, Odometry(Wheels()), SafetyGate(SafetyLimits()))
        self.wire = None
        self.causes = []
        self.events = []
        self.lowest = math.inf
        publish = self.bus.events.publish
        self.bus.events.publish = lambda event: (self.events.append(event), publish(event))

    async def open_serial(self, port, baud):
        self.wire = Wire(RoombaLink(self.robot, baud), baud)
        return self.wire

    def utc(self):
        return datetime(2026, 3, 2, tzinfo=UTC)

    def boot_id(self):
        return "boot"

    def is_synchronised(self):
        return True

    @property
    def is_moving(self):
        return any(self.body.speeds)

    @property
    def travelled(self):
        return 0.5 * (self.body.left_rotation + self.body.right_rotation)

    def wish(self, speed, turn_rate):
        self.speed, self.turn_rate, self.wishes = speed, turn_rate, True

    async def wishing(self):
        """A source that says what it wants at 50 Hz."""
        async for _ in ticks(0.020):
            if self.sees_line:
                self.line_t = now() - 0.09  # a frame is about so old when its line is known
            if self.wishes:
                line_t = self.line_t if self.source == "follower" else None
                self.bus.commands.publish(DriveCommand(now(), self.speed, self.turn_rate, self.source, line_t))

    async def watching(self):
        async for _ in ticks(0.005):
            if not self.causes or self.causes[-1] != self.loop.cause:
                self.causes.append(self.loop.cause)

    def said(self, words):
        return [event.text for event in self.events if event.source == "safety" and words in event.text]


def drive(scenario, **how):
    """Run `await scenario(course)` in virtual time on an open robot."""

    async def main():
        course = Course(**how)
        work = (Supervisor(course.driver).run(), course.loop.run(), course.wishing(), course.watching())
        tasks = [asyncio.create_task(item) for item in work]
        await asyncio.sleep(0.5)
        assert course.bus.sensors.latest is not None
        course.tasks = tasks
        try:
            await scenario(course)
        finally:
            for task in tasks:
                task.cancel()
            for result in await asyncio.gather(*tasks, return_exceptions=True):
                if isinstance(result, Exception):
                    raise result
        return course

    return run_virtual(main())


# ---- the states ------------------------------------------------------------------------------------------------------


async def idle(course):
    await asyncio.sleep(0.3)


async def armed_standing(course):
    course.wish(0.0, 0.0)
    await asyncio.sleep(0.3)


async def accelerating(course):
    course.wish(0.3, 0.0)
    await asyncio.sleep(0.2)


async def straight(course):
    course.wish(0.3, 0.0)
    await asyncio.sleep(0.9)


async def curving(course):
    course.wish(0.2, 0.8)
    await asyncio.sleep(0.7)


async def spinning(course):
    course.wish(0.0, -1.5)
    await asyncio.sleep(0.5)


async def reversing(course):
    course.wish(-0.3, 0.0)
    await asyncio.sleep(0.9)


async def braking(course):
    await straight(course)
    course.wish(0.0, 0.0)
    await asyncio.sleep(0.1)


async def by_hand(course):
    course.source = OPERATOR
    await straight(course)


async def being_rearmed(course):
    await straight(course)
    course.robot.press_clean()
    async with asyncio.timeout(0.1):
        while "mode" not in str(course.loop.cause):
            await asyncio.sleep(0.001)


async def emergency_stopped(course):
    await straight(course)
    course.loop.emergency_stop("the red button")
    await asyncio.sleep(0.6)


STATES = [
    *(idle, armed_standing, accelerating, straight, curving, spinning, reversing, braking, by_hand),
    *(being_rearmed, emergency_stopped),
]
MOVING = {accelerating, straight, curving, spinning, reversing, braking, by_hand}


# ---- the hazards: each begins, and returns when the clock of the reaction starts -------------------------------------


def touched(**contacts):
    async def hazard(course):
        for name, value in contacts.items():
            setattr(course.body, name, value)
        return await frame_of_the_next_tick(course)

    return hazard


async def frame_of_the_next_tick(course):
    """Wait for the frame that reports what is true now; returns when its last byte arrived."""
    before = course.body.t
    while course.body.t <= before:
        await asyncio.sleep(0.0005)
    seen = len(course.wire.arrivals)
    while len(course.wire.arrivals) == seen:
        await asyncio.sleep(0.0005)
    return course.wire.arrivals[seen]


async def overcurrent(course):
    course.robot.overcurrent = 16
    return await frame_of_the_next_tick(course)


async def stale(course):
    course.wire.is_cut = True
    return course.wire.arrivals[-1] + 0.150


async def expired(course):
    course.wishes = False
    return (course.bus.commands.latest.t if course.bus.commands.latest else now()) + 0.200


async def not_a_number(course):
    course.speed = math.nan
    await asyncio.sleep(0.021)
    return now()


async def operator_stop(course):
    course.bus.withdrawals.publish(Withdrawal(now(), None, "stopped by the operator"))
    return now()


async def client_gone(course):
    course.wishes = False
    course.bus.withdrawals.publish(Withdrawal(now(), course.source, "the operator's connection is gone"))
    return now()


async def ladder_exhausted(course):
    course.wishes = False
    course.bus.withdrawals.publish(Withdrawal(now(), course.source, "line lost: searched on both sides"))
    return now()


async def emergency(course):
    course.loop.emergency_stop("asked for by the operator")
    return now()


async def mode_lost(course):
    course.robot.set_plugged(True)  # the charger ends Safe mode, and the driver does not go back to it
    return await frame_of_the_next_tick(course)


async def overrun(course):
    stall(0.15)
    course.wishes = False  # because it is not to move on within the test
    return now()


async def long_overrun(course):
    stall(1.0)
    course.wishes = False
    return now()


async def shut_down(course):
    course.tasks[1].cancel()
    return now()


@dataclass(frozen=True)
class Hazard:
    """`begin` brings it about; `words` are in the cause that is reported.

    `needs_wish`: without a wish to move there is nothing to refuse, and another cause is named.
    """

    name: str
    begin: object
    words: str
    needs_wish: bool = False


HAZARDS = [
    Hazard("bump_left", touched(bump_left=True), "the left bumper"),
    Hazard("bump_right", touched(bump_right=True), "the right bumper"),
    Hazard("bump_both", touched(bump_left=True, bump_right=True), "left bumper is pressed and the right bumper"),
    Hazard("cliff", touched(cliff=True), "a cliff sensor"),
    Hazard("wheel_drop_left", touched(wheel_drop_left=True), "the left wheel has dropped"),
    Hazard("wheel_drop_right", touched(wheel_drop_right=True), "the right wheel has dropped"),
    Hazard("overcurrent", overcurrent, "too much current"),
    Hazard("stale", stale, "no sensor frame from the base for more than 0.15 s"),
    Hazard("expired", expired, "no drive command", needs_wish=True),
    Hazard("not_a_number", not_a_number, "asked for nan m/s", needs_wish=True),
    Hazard("operator_stop", operator_stop, "stopped by the operator"),
    Hazard("client_gone", client_gone, "the operator's connection is gone", needs_wish=True),
    Hazard("ladder_exhausted", ladder_exhausted, "line lost: searched", needs_wish=True),
    Hazard("emergency", emergency, "emergency stop: "),
    Hazard("mode_lost", mode_lost, "not in safe mode", needs_wish=True),
    Hazard("overrun", overrun, "the control loop was late"),
    Hazard("long_overrun", long_overrun, "the control loop was late"),
    Hazard("shut_down", shut_down, ""),
]
