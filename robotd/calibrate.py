"""`robotd calibrate odometry`: measure wheels and base with a tape measure, and write them into the calibration file.

Only the base is opened, with the control loop and its safety gate. Whatever ends the command before its end, the robot
stands still and nothing is written.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import os
import signal
import sys
from collections import deque
from pathlib import Path
from typing import Any, TextIO, cast

from .bind import bind
from .bus import Bus
from .clock import outside
from .config import Calibration, load_calibration, load_config, save_wheels
from .control import ControlLoop
from .daemon import read_config
from .errors import InputError, MissionError, RobotdError
from .hardware import Hardware
from .odometry import Odometry, Wheels
from .plugin import Base, Driver
from .safety import SafetyGate, SafetyLimits
from .wheel_calibration import KINDS, Run, calibrate, summary
from .wheel_runs import Person, RunPlan, check_writable, collect

INTRODUCTION = """\
You need: a flat piece of the floor on which the robot will work, {room:.1f} m long; a strip of tape on it, straight;
something to mark the floor with; a tape measure. The robot drives {runs} runs, slowly, and asks after each what you
measure. Stay clear of it while it moves. Ctrl-C stops it at any time, and so does its bumper: then nothing is written.
The longer the runs, the better the result: see --distance."""


def run_command(arguments: argparse.Namespace) -> int:
    """Run `robotd calibrate odometry` on the real robot; returns the exit code."""
    from .real import RealHardware

    with contextlib.ExitStack() as stack:
        source: TextIO = sys.stdin
        if arguments.answers is not None:
            try:
                source = stack.enter_context(arguments.answers.open(encoding="utf-8"))
            except OSError as error:
                raise InputError(f"--answers {arguments.answers}: cannot be read: {error.strerror}") from error
        person = Terminal(source, yes=arguments.yes or arguments.answers is not None)
        plan, hardware = _plan(arguments), RealHardware()
        hardware.guardian = arguments.config.parent / load_config(arguments.config).robot.guardian
        try:
            asyncio.run(_until_told(calibrate_odometry(arguments.config, plan, hardware, person)))
        except (KeyboardInterrupt, asyncio.CancelledError):
            print("robotd: stopped; the robot stands still, nothing was written", file=sys.stderr)
            return 130
    return 0


async def _until_told(work: Any) -> None:
    """SIGTERM as Ctrl-C: cancel, so that the robot is halted on the way out."""
    task = asyncio.ensure_future(work)
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
    await task


def _plan(arguments: argparse.Namespace) -> RunPlan:
    given = {name: getattr(arguments, name) for name in ("distance", "turns", "repeat")}
    return bind(
        RunPlan, {name: value for name, value in given.items() if value is not None}, "robotd calibrate odometry"
    )


async def calibrate_odometry(path: Path, plan: RunPlan, hardware: Hardware, person: Person) -> Wheels:
    """The whole calibration: open the base, drive, ask, compute, write.

    Parameters
    ----------
    path : Path
        robotd.toml; names the base's driver and the calibration file, which need not exist.
    plan : RunPlan
    hardware : Hardware
    person : Person

    Returns
    -------
    Wheels
        As written.

    Raises
    ------
    ConfigError
        A mistake in the configuration or the calibration file, or that file cannot be written.
    InputError
        The measurements contradict each other.
    DriverFault, MissionError
        The base failed, or something stopped the robot.
    """
    config, plans = read_config(path)
    target = path.parent / config.robot.calibration
    calibration = load_calibration(target) if target.exists() else Calibration()
    check_writable(target)
    await person.tell(INTRODUCTION.format(room=plan.distance + 0.5, runs=len(KINDS) * plan.repeat))
    bus = Bus()
    base = next(plan for plan in plans.values() if plan.cls.kind == "base")
    driver = base.cls(base.name, base.config, hardware, bus, calibration)
    runs = await _drive(driver, bus, config.safety, calibration.wheels, plan, person)
    result = calibrate(runs, calibration.wheels)
    await person.tell(summary(result, calibration.wheels, runs))
    save_wheels(result.wheels, target)
    await person.tell(f"written to {target}; restart robotd to use it")
    return result.wheels


async def _drive(
    driver: Driver, bus: Bus, limits: SafetyLimits, wheels: Wheels, plan: RunPlan, person: Person
) -> list[Run]:
    control = ControlLoop(bus, cast(Base, driver), Odometry(wheels), SafetyGate(limits, wheels.base))
    try:
        await driver.open()
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(work) for work in (driver.run(), control.run())]
            runs = await collect(control, wheels, plan, person)
            for task in tasks:
                task.cancel()
    except BaseExceptionGroup as errors:  # because the first of several faults is what the person must know
        first: BaseException = errors
        while isinstance(first, BaseExceptionGroup):
            first = first.exceptions[0]
        if isinstance(first, RobotdError):
            raise first from None
        raise
    finally:
        await driver.close()
    return runs


class Terminal:
    """A person at a terminal, or a file with that person's answers."""

    def __init__(self, source: TextIO, *, yes: bool) -> None:
        self._source = source
        self._yes = yes
        self._lines: deque[str] = deque()
        self._part = b""
        self._ended = False

    async def tell(self, text: str) -> None:
        """Print."""
        print(text, flush=True)

    async def ready(self, text: str) -> None:
        """Print, and wait for Enter unless told not to."""
        print(f"\n{text}", flush=True)
        if not self._yes:
            print("Press Enter when ready. ", end="", flush=True)
            await self._line()

    async def measure(self, text: str) -> float:
        """Ask until the answer is a number."""
        while True:
            print(f"{text} ", end="", flush=True)
            line = (await self._line()).partition("#")[0].strip().replace(",", ".")
            if not line:
                continue
            try:
                value = float(line)
            except ValueError:
                value = math.nan
            if math.isfinite(value):
                return value
            print(f"found {line!r}; expected a number", flush=True)

    async def _line(self) -> str:
        """The next line; waits without a thread, because a thread that reads a terminal cannot be cancelled."""
        fd, loop = self._source.fileno(), asyncio.get_running_loop()
        while not self._lines:
            if self._ended:
                raise MissionError("calibration: no more answers; nothing was written")
            readable = asyncio.Event()
            try:
                loop.add_reader(fd, readable.set)
            except PermissionError:  # a file: always readable
                readable.set()
            try:
                with outside():
                    await readable.wait()
            finally:
                loop.remove_reader(fd)
            data = os.read(fd, 4096)
            self._ended = not data
            *whole, self._part = (self._part + data).split(b"\n")
            if self._ended and self._part:
                whole, self._part = [self._part], b""
            self._lines.extend(line.decode(errors="replace") for line in whole)
        return self._lines.popleft()
