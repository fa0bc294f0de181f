"""Drive the runs of `wheel_calibration` and ask a person what they were on the floor.

Who asks (a terminal, a control socket) is a `Person`; what moves the robot is the control loop with its safety gate.
"""

from __future__ import annotations

import asyncio
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from .bind import ranged
from .bus import Subscription
from .clock import now
from .control import ControlLoop
from .errors import ConfigError, DriverFault, MissionError
from .odometry import Wheels
from .records import DriveCommand, Floats, SensorFrame, Withdrawal
from .wheel_calibration import KINDS, Run, disagreeing, implausible, thinned

SOURCE = "calibration"
GRACE_S = 2.0  # in which the base gets into the mode in which its wheels obey
SILENT_S = 1.0  # without a sensor frame
REST_S = 0.5  # without a count the wheels stand still
JUMP_M = 0.05  # of a wheel between two frames: its counts began anew
SLOWEST, SLOWEST_TURN = 0.03, 0.25  # m/s, rad/s: one step of the wheels' speeds
BEND = 0.7  # wheel bases, radius of a half circle: no wheel reverses, because where it does so costs half a count
APPROACH = 1.2  # 1/s: speed per metre or radian that is left
STEER, STEER_MAX = 1.5, 0.3  # 1/s, rad/s: back to the heading at which a straight began
ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class RunPlan:
    """Which runs, how fast, and how well the person measures; metres, seconds and radians."""

    distance: float = ranged(2.0, minimum=0.5, maximum=20.0)
    turns: int = ranged(5, minimum=1, maximum=20)
    repeat: int = ranged(2, minimum=1, maximum=10)
    speed: float = ranged(0.15, minimum=0.05, maximum=0.3)
    turn_rate: float = ranged(0.6, minimum=0.3, maximum=1.5)
    length_sigma: float = ranged(0.002, minimum=1e-5, maximum=0.1, doc="of a length, with a tape measure")
    angle_sigma: float = ranged(math.radians(1.0), minimum=1e-5, maximum=0.2, doc="of an angle, by eye")
    alignment_sigma: float = ranged(0.005, minimum=0.0, maximum=0.1, doc="of the robot along the strip, by eye")
    radius: float = ranged(0.17, minimum=0.05, maximum=1.0, doc="from the middle between the wheels to the bumper")


class Person(Protocol):
    """Whoever stands beside the robot with a tape measure."""

    async def tell(self, text: str) -> None:
        """Show what happens."""

    async def ready(self, text: str) -> None:
        """Say what to do, and wait until it is done; the robot moves after that."""

    async def measure(self, text: str) -> float:
        """Ask for a number in the unit that `text` names."""


async def collect(control: ControlLoop, wheels: Wheels, plan: RunPlan, person: Person) -> list[Run]:
    """Drive all runs, with the person's help, and once more each that disagrees with the others.

    Parameters
    ----------
    control : ControlLoop
        Running, with its base.
    wheels : Wheels
        The calibration so far: how far the robot drives, and what is plausible.
    plan : RunPlan
    person : Person

    Raises
    ------
    MissionError
        The safety gate held the robot (bumper, cliff, ...) or it did not move. It stands still then.
    DriverFault
        The base sends no sensor frames any more.
    """
    runs: list[Run] = []
    kinds = [kind for _ in range(plan.repeat) for kind in KINDS]
    try:
        for number, kind in enumerate(kinds, 1):
            runs.append(await _run(control, wheels, plan, person, kind, f"Run {number} of {len(kinds)}"))
        repeated: set[int] = set()
        while odd := [index for index in disagreeing(runs, wheels) if index not in repeated]:
            worst = odd[0]
            repeated.add(worst)
            kind = runs[worst].kind
            await person.tell(
                f"Run {worst + 1} ({kind}) does not fit to the others: a wheel slipped, or a number was mistyped."
            )
            runs[worst] = await _run(control, wheels, plan, person, kind, f"Run {worst + 1} again")
    finally:
        control.bus.withdrawals.publish(Withdrawal(now(), SOURCE, "the calibration ended"))
        control.base.halt()
    return runs


def check_writable(path: Path) -> None:
    """Fail before the robot moves rather than after it."""
    folder = path.resolve().parent
    if not folder.is_dir():
        raise ConfigError(f"{path}: there is no folder {folder}; create it, or change [robot] calibration")
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"{path}: cannot be written by this user; run the command as the user of robotd")


async def _run(control: ControlLoop, wheels: Wheels, plan: RunPlan, person: Person, kind: str, name: str) -> Run:
    """One run, asked again until what was measured is plausible."""
    for attempt in range(ATTEMPTS):
        await person.ready(f"{name}: {kind}. {_preparation(kind, plan)}")
        control.resume(SOURCE)  # because the robot may have been lifted onto its mark
        if control.gate.latched is None:
            break
        await person.tell(f"The robot cannot start: {control.gate.latched}.")
        if attempt == ATTEMPTS - 1:
            raise MissionError(f"calibration: the robot cannot start: {control.gate.latched}")
    travel = await _Chauffeur(control, wheels, plan).drive(kind)
    for _ in range(ATTEMPTS):
        run = await _measured(kind, travel, plan, person)
        odd = implausible(run, wheels)
        if odd is None:
            return run
        await person.tell(f"That cannot be right: {odd}")
    raise MissionError(f"calibration, {name}: {odd}")


def _preparation(kind: str, plan: RunPlan) -> str:
    room, whole = f"{plan.distance + 0.5:.1f} m", f"{plan.distance:g} m"
    mark = "Mark the floor below the middle of its front bumper."
    strip = "Put the robot on a straight strip of tape, which passes below the middle of its front and of its back."
    if kind == "forward":
        return f"{strip} {mark} Keep {room} in front of it free. It drives {whole} forward."
    if kind == "backward":
        return f"{strip} {mark} Keep {room} behind it free: it has no bumper there. It drives {whole} backward."
    if kind in KINDS[2:4]:
        return f"{mark} Keep 0.5 m around it free. It turns {plan.turns} times {kind}, seen from above."
    side = kind.rsplit(" ", 1)[1]
    return (
        f"{strip} {mark} Keep {room} in front of it free, and 0.7 m to the {side} of that. It drives {whole} forward, "
        f"round a tight half circle to the {side}, and comes back beside the strip."
    )


async def _measured(kind: str, travel: Floats, plan: RunPlan, person: Person) -> Run:
    if kind in KINDS[2:4]:
        rest = await person.measure(
            "By how many degrees does its front point past the mark? (seen from above: counter-clockwise of the mark "
            "positive, clockwise negative)"
        )
        whole = 2.0 * math.pi * (plan.turns if kind == "counter-clockwise" else -plan.turns)
        return Run(kind, travel, turn=whole + math.radians(rest), turn_sigma=plan.angle_sigma)
    side = "(left positive, right negative, as seen along the robot's direction at the start)"
    sigma = plan.length_sigma
    if kind in KINDS[:2]:
        along = await person.measure(
            "How many millimetres along the strip is the middle of the front bumper from the mark now?"
        )
        sideways = await person.measure(f"How many millimetres beside the strip is it? {side}")
        along = -abs(along) if kind == "backward" else abs(along)
        run = Run(kind, travel, (along / 1e3, sideways / 1e3), (sigma, sigma), reach=(plan.radius, plan.radius))
    else:
        along = await person.measure(
            "How many millimetres beyond the mark is the middle of its back now? (in the direction in which it first "
            "drove; positive if it did not come back far enough, negative if it came back too far)"
        )
        sideways = await person.measure(f"How many millimetres beside the strip is it? {side}")
        run = Run(kind, travel, (along / 1e3, sideways / 1e3), (sigma, sigma), reach=(plan.radius, -plan.radius))
    x, y = np.abs(np.array(run.offset))  # a robot that starts askew ends at right angles to this
    askew = plan.alignment_sigma
    return replace(run, offset_sigma=(math.hypot(sigma, askew * y), math.hypot(sigma, askew * x)))


class _Chauffeur:
    """Drives one run by the wheels' counts, and records them."""

    def __init__(self, control: ControlLoop, wheels: Wheels, plan: RunPlan) -> None:
        self._control = control
        self._wheels = wheels
        self._plan = plan
        self._travel: list[tuple[float, float]] = []
        self._resets = 0

    async def drive(self, kind: str) -> Floats:
        """(N, 2) nominal travel of the wheels until they rest again."""
        distance, whole = self._plan.distance, 2.0 * math.pi * self._plan.turns
        legs: Sequence[tuple[str, float]] = {
            "forward": [("straight", distance)],
            "backward": [("straight", -distance)],
            "counter-clockwise": [("spin", whole)],
            "clockwise": [("spin", -whole)],
            "out and back, turning left": [("straight", distance), ("bend", math.pi), ("straight", distance)],
            "out and back, turning right": [("straight", distance), ("bend", -math.pi), ("straight", distance)],
        }[kind]
        with self._control.bus.sensors.subscribe(size=256) as frames:
            start = await self._next(frames)  # of the run; what was before does not count
            self._travel = [(start.left, start.right)]
            for shape, target in legs:
                await self._leg(frames, shape, target)
        return thinned(np.array(self._travel[1:]) - self._travel[0])

    async def _leg(self, frames: Subscription[SensorFrame], shape: str, target: float) -> None:
        plan, wheels = self._plan, self._wheels
        begin, (left, right) = now(), self._travel[-1]
        while True:
            frame = await self._next(frames)
            rolled_left = wheels.scale_left * (frame.left - left)
            rolled_right = wheels.scale_right * (frame.right - right)
            driven, turned = 0.5 * (rolled_left + rolled_right), (rolled_right - rolled_left) / wheels.base
            rest = abs(target) - math.copysign(1.0, target) * (driven if shape == "straight" else turned)
            if rest <= 0.0:
                break
            if shape == "straight":
                speed = math.copysign(max(SLOWEST, min(plan.speed, APPROACH * rest)), target)
                self._wish(speed, max(-STEER_MAX, min(STEER_MAX, -STEER * turned)))
            else:
                rate = max(SLOWEST_TURN, min(plan.turn_rate, APPROACH * rest))
                self._wish(rate * BEND * wheels.base if shape == "bend" else 0.0, math.copysign(rate, target))
            self._check(now() - begin)
        await self._rest(frames)

    async def _rest(self, frames: Subscription[SensorFrame]) -> None:
        """Stand still; returns when the wheels do."""
        since, counts = None, self._travel[-1]
        while True:
            self._wish(0.0, 0.0)
            frame = await self._next(frames)
            if since is None or self._travel[-1] != counts:
                since, counts = frame.t, self._travel[-1]
            if frame.t - since >= REST_S:
                return

    async def _next(self, frames: Subscription[SensorFrame]) -> SensorFrame:
        try:
            async with asyncio.timeout(SILENT_S):
                frame = await frames.get()
        except TimeoutError:
            raise DriverFault(f"{self._control.base.name}: no sensor frame for {SILENT_S:g} s") from None
        if self._travel:
            left, right = self._travel[-1]
            jumped = max(abs(frame.left - left), abs(frame.right - right)) > JUMP_M
            if jumped or frame.resets != self._resets:
                raise DriverFault(f"{self._control.base.name}: the wheels' counts jumped in the middle of a run")
            self._travel.append((frame.left, frame.right))
        self._resets = frame.resets
        return frame

    def _wish(self, speed: float, turn_rate: float) -> None:
        self._control.bus.commands.publish(DriveCommand(now(), speed, turn_rate, SOURCE))

    def _check(self, elapsed: float) -> None:
        """Raise when something holds the robot."""
        held = self._control.gate.latched or (self._control.cause if elapsed > GRACE_S else None)
        if held is not None:
            raise MissionError(f"calibration: the robot was stopped: {held}")
