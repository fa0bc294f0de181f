"""Makes the shipped recordings: the real driver and control loop on a simulated robot, one case for each trouble."""

from __future__ import annotations

import asyncio
import dataclasses
import zlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from robotd.drivers.roomba import RoombaConfig, RoombaDriver

from robotd import oi
from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration
from robotd.control import ControlLoop
from robotd.errors import DriverFault
from robotd.odometry import Odometry
from robotd.records import DriveCommand, Withdrawal
from robotd.safety import SafetyGate, SafetyLimits
from robotd.serial_log import LoggedHardware, SerialLog
from robotd.sim.hardware import SimHardware
from robotd.sim.pins import PinStates
from robotd.sim.quirks import LineFaults
from robotd.sim.roomba import RoombaQuirks, SimRoomba
from robotd.sim.roomba_link import RoombaLink
from robotd.supervisor import Supervisor

PORT = "/dev/robotd/base"
WISH_S = 0.1  # between two wishes of the same motion


class Floor:
    """An open floor: the wheels roll as they are told; what the sensors feel is set by hand."""

    def __init__(self) -> None:
        self.left_rotation = self.right_rotation = 0.0
        self.bump_left = self.bump_right = self.cliff = False
        self.wheel_drop_left = self.wheel_drop_right = False
        self._t = 0.0

    def advance(self, t: float, left_speed: float, right_speed: float) -> None:
        elapsed, self._t = t - self._t, t
        self.left_rotation += left_speed * elapsed
        self.right_rotation += right_speed * elapsed


class World:
    """A robot, its pins and its cable; what the simulated hardware needs."""

    def __init__(self, case: Case) -> None:
        self.seed = zlib.crc32(case.name.encode())
        self.pins = PinStates()
        self.floor = Floor()
        self.robot = SimRoomba(self.floor, np.random.default_rng(self.seed), case.quirks)
        self.is_plugged = True


class Hardware(SimHardware):
    """Opens the line to that robot."""

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._cable = world

    async def open_serial(self, port: str, baud: int) -> RoombaLink:
        if not self._cable.is_plugged:
            raise DriverFault(f"{port} is unplugged; plug the adapter in again")
        return RoombaLink(self._cable.robot, baud)


class Stage:
    """A running robot for a scenario to act on."""

    def __init__(self, world: World, bus: Bus, control: ControlLoop) -> None:
        self.world, self.robot, self.floor = world, world.robot, world.floor
        self.bus = bus
        self.control = control

    async def drive(self, seconds: float, speed: float, turn_rate: float = 0.0) -> None:
        """Wish for this motion again and again, as a line follower does."""
        start = now()
        async for _ in ticks(WISH_S):
            if now() - start >= seconds - 1e-6:
                return
            self.bus.commands.publish(DriveCommand(now(), speed, turn_rate, "follower"))

    def withdraw(self, cause: str) -> None:
        self.bus.withdrawals.publish(Withdrawal(now(), "follower", cause))


Scenario = Callable[[Stage], Awaitable[None]]


@dataclass(frozen=True)
class Case:
    """One recording: who the robot is, what the driver is told, and what happens."""

    name: str
    scenario: Scenario
    quirks: RoombaQuirks = field(default_factory=RoombaQuirks)
    config: dict[str, Any] = field(default_factory=dict)


async def drives(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(2.5, 0.2)
    await stage.drive(1.5, 0.1, 0.8)
    stage.withdraw("at the stop")
    await asyncio.sleep(0.7)


async def drives_little(stage: Stage) -> None:
    await asyncio.sleep(1.0)
    await stage.drive(3.0, 0.15, 0.1)
    await asyncio.sleep(0.5)


async def waits_then_drives(stage: Stage) -> None:
    await asyncio.sleep(4.5)
    await stage.drive(2.0, 0.15, 0.1)
    await asyncio.sleep(0.5)


async def bumps(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.5, 0.2)
    stage.floor.bump_left = True
    await stage.drive(0.4, 0.2)
    stage.floor.bump_left = False
    await stage.drive(2.0, 0.2)


async def reaches_a_cliff(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.5, 0.2)
    stage.floor.cliff = True
    await stage.drive(1.0, 0.2)
    stage.floor.cliff = False
    await stage.drive(2.0, 0.2)


async def is_lifted(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.0, 0.2)
    stage.floor.wheel_drop_left = True
    await stage.drive(0.1, 0.2)
    stage.floor.wheel_drop_right = True
    await stage.drive(0.9, 0.2)
    stage.floor.wheel_drop_left = stage.floor.wheel_drop_right = False
    await stage.drive(2.0, 0.2)


async def loses_its_cable(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.2, 0.2)
    stage.world.is_plugged = False
    assert isinstance(stage.robot.link, RoombaLink)
    stage.robot.link.unplug()
    await stage.drive(1.2, 0.2)
    stage.world.is_plugged = True
    await stage.drive(3.5, 0.2)


async def is_reset(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.0, 0.2)
    stage.robot.receive(oi.encode("reset"))
    await stage.drive(12.5, 0.2)


async def is_woken(stage: Stage) -> None:
    await asyncio.sleep(4.5)
    await stage.drive(2.0, 0.2)


async def has_its_button_pressed(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.5, 0.2)
    stage.robot.press_clean()
    await stage.drive(3.0, 0.2)


async def is_docked(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(1.0, 0.1)
    stage.robot.set_docked(True)
    await stage.drive(2.0, 0.1)
    stage.robot.set_docked(False)
    await stage.drive(2.5, 0.1)


async def spins(stage: Stage) -> None:
    await asyncio.sleep(0.8)
    await stage.drive(2.5, 0.0, 1.2)
    await stage.drive(1.5, -0.1)
    await asyncio.sleep(0.7)


NOISE = LineFaults(drop=0.001, flip=0.001, insert=0.001)
CASES = (
    Case("start-drive-stop", drives),
    Case("checksum-without-header", drives_little, RoombaQuirks(checksum="exclusive")),
    Case("baud-19200", waits_then_drives, RoombaQuirks(baud=19200)),
    Case("baud-57600", waits_then_drives, RoombaQuirks(baud=57600, firmware="stm32-3.7.7")),
    Case("mode-one-too-high-bump", bumps, RoombaQuirks(mode_offset=1)),
    Case("mode-32-after-cliff", reaches_a_cliff, RoombaQuirks(mode_32_after_cliff=True)),
    Case("mode-never-told", drives_little, RoombaQuirks(mode_packet_dead=True)),
    Case("lifted", is_lifted),
    Case("noisy-line", drives_little, RoombaQuirks(line=NOISE)),
    Case("stalling-line", drives_little, RoombaQuirks(line=LineFaults(stall=0.25, stall_every=2.0))),
    Case("cable-pulled-and-plugged", loses_its_cable),
    Case("reset-with-banner", is_reset),
    Case("asleep-at-start", is_woken),
    Case("clean-button", has_its_button_pressed),
    Case("docked-cliffs-all-set", is_docked, RoombaQuirks(cliffs_on_dock=True)),
    Case("encoders-wrap-and-swapped", spins, RoombaQuirks(encoder_start=65500, encoders_swapped=True)),
)


def record(case: Case, path: Path) -> None:
    """Write the recording of one case."""
    run_virtual(_record(case, path))


async def _record(case: Case, path: Path) -> None:
    world, bus, calibration, limits = World(case), Bus(), Calibration(), SafetyLimits()
    if case.name.startswith("asleep"):
        world.robot.is_asleep = True
    config = RoombaConfig(PORT, **case.config)
    head = {
        "base": {"driver": "roomba", **dataclasses.asdict(config)},
        "wheels": dataclasses.asdict(calibration.wheels),
        "quirks": _changed(case.quirks),
        "about": f"{case.name}: made by python -m tests.replay --record",
    }
    log = SerialLog(path, 1 << 30, head)
    hardware = LoggedHardware(Hardware(world), PORT, log)
    driver = RoombaDriver("base", config, hardware, bus, calibration)
    control = ControlLoop(bus, driver, Odometry(calibration.wheels), SafetyGate(limits, calibration.wheels.base))
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(work) for work in (Supervisor(driver).run(), control.run(), log.follow(bus))]
        await case.scenario(Stage(world, bus, control))
        for task in tasks:
            task.cancel()
    log.flush()


def _changed(quirks: Any) -> dict[str, Any]:
    """The switches that are not as in the manual."""
    found = {}
    for item in dataclasses.fields(quirks):
        value = getattr(quirks, item.name)
        default = item.default_factory() if item.default is dataclasses.MISSING else item.default
        if value != default:
            found[item.name] = _changed(value) if dataclasses.is_dataclass(value) else value
    return found
