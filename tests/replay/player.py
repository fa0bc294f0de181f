"""Plays a recording of the serial line to the real driver, and says in lines of text what came of it.

The robot's bytes arrive at their times in virtual time; wishes to move go through the control loop as they did. A line
of the outcome is a time and what happened: a command that the driver sent (drive commands only where they change), an
event, a sensor frame (one in ten, and those in which more than the wheels' travel changed). Two outcomes agree if of
each kind the same happened in the same order, each at most `TOLERANCE` apart.
"""

from __future__ import annotations

import asyncio
import dataclasses
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

from robotd.drivers.roomba import RoombaConfig, RoombaDriver

from robotd import oi
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.control import ControlLoop
from robotd.errors import DriverFault
from robotd.odometry import Odometry, Wheels
from robotd.records import DriveCommand, Event, SensorFrame, Withdrawal
from robotd.safety import SafetyGate, SafetyLimits
from robotd.serial_log import Occurrence, Recording, read_serial_log
from robotd.sim.hardware import SimHardware
from robotd.sim.pins import PinStates
from robotd.supervisor import Supervisor

FOLDER = Path(__file__).parent
TOLERANCE = 0.031  # s: two ticks of the robot
EVERY = 10  # frames
PORT = "/dev/replayed"


@dataclass
class Session:
    """What went over the line between an opening and the next one."""

    start: float
    refusal: str | None = None
    occurrences: list[Occurrence] = field(default_factory=list)


def sessions(recording: Recording) -> list[Session]:
    """A recording cut at its openings."""
    found: list[Session] = []
    for item in recording.occurrences:
        if item.kind in ("open", "refused"):
            found.append(Session(item.t, item.text if item.kind == "refused" else None))
        elif found:
            found[-1].occurrences.append(item)
    return found


class World:
    """What the simulated hardware needs besides a serial line: pins."""

    def __init__(self) -> None:
        self.pins = PinStates()
        self.seed = 0


class ReplayHardware(SimHardware):
    """Hardware whose serial port replays a recording, one opening after the other."""

    def __init__(self, recording: Recording, outcome: Outcome) -> None:
        super().__init__(World())
        self._sessions = sessions(recording)
        self._outcome = outcome

    async def open_serial(self, port: str, baud: int) -> ReplayLink:
        if not self._sessions:
            raise DriverFault("the recording has no further session")
        session = self._sessions.pop(0)
        if session.refusal is not None:
            raise DriverFault(session.refusal)
        self._outcome.note(f"open {baud}")
        return ReplayLink(session, self._outcome)


class ReplayLink:
    """A serial link that gives what was recorded, shifted to when it was opened; see robotd.hardware.SerialLink."""

    def __init__(self, session: Session, outcome: Outcome) -> None:
        self._shift = now() - session.start
        self._waiting = [item for item in session.occurrences if item.kind in ("<", "break")]
        self._outcome = outcome
        self._decoder = oi.CommandDecoder()
        self._is_closed = False

    async def read(self) -> tuple[float, bytes]:
        while not self._waiting:
            await asyncio.sleep(3600.0)
        item = self._waiting[0]
        if item.t + self._shift > now():
            await asyncio.sleep(item.t + self._shift - now())
        self._waiting.pop(0)
        if item.kind == "break":
            raise DriverFault(item.text)
        return item.t + self._shift, item.data

    def write(self, data: bytes) -> None:
        for command in self._decoder.feed(data):
            assert isinstance(command, oi.Command), f"the driver sent {command.data.hex()}, which is no command"
            self._outcome.sent(command)

    def set_baud(self, baud: int) -> None:
        self._outcome.note(f"baud {baud}")

    def pulse_wake(self, seconds: float) -> None:
        self._outcome.note(f"wake {seconds:g}")

    def rest(self, seconds: float) -> None:
        pass

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._outcome.note("close")


class Outcome:
    """Collects the lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.frames = 0
        self._drive: oi.Command | None = None
        self._state: object = None
        self._same: tuple[str, int] = ("", 0)

    def note(self, text: str, t: float | None = None) -> None:
        self.lines.append(f"{now() if t is None else t:.2f} {text}")

    def sent(self, command: oi.Command) -> None:
        if command.name == "drive_direct":
            if command == self._drive:
                return
            self._drive = command
        self.note(" ".join(["sent", command.name, *map(str, command.values)]))

    def event(self, event: Event) -> None:
        self.note(f"{event.level} {event.source}: {event.text}")

    def frame(self, frame: SensorFrame) -> None:
        flags = [item.name for item in dataclasses.fields(frame) if item.type == "bool" and getattr(frame, item.name)]
        state = (frame.mode, flags)
        if state != self._state or self.frames % EVERY == 0:
            charge = "" if frame.charge_fraction is None else f" {100 * frame.charge_fraction:.0f} %"
            volts = "" if frame.voltage is None else f" {frame.voltage:.1f} V"
            words = " ".join([frame.mode, *flags])
            self.note(f"frame {frame.left:.3f} {frame.right:.3f}{volts}{charge} {words}", frame.t)
        self._state = state
        self.frames += 1

    def text(self) -> str:
        """All lines; a command that was sent several times in a row at once stands in one."""
        shortened: list[list[Any]] = []
        for line in self.lines:
            if shortened and shortened[-1][0] == line:
                shortened[-1][1] += 1
            else:
                shortened.append([line, 1])
        lines = [line if count == 1 else f"{line} x{count}" for line, count in shortened]
        return "\n".join([*lines, f"{now():.2f} frames {self.frames}"]) + "\n"


def play(recording: Recording) -> str:
    """The outcome of a recording."""
    return run_virtual(_play(recording))


async def _play(recording: Recording) -> str:
    head, bus, outcome = recording.head, Bus(), Outcome()
    publish_event, publish_frame = bus.events.publish, bus.sensors.publish
    bus.events.publish = lambda event: (outcome.event(event), publish_event(event))
    bus.sensors.publish = lambda frame: (outcome.frame(frame), publish_frame(frame))
    known = {item.name for item in dataclasses.fields(RoombaConfig)}
    config = bind(
        RoombaConfig, {name: value for name, value in head["base"].items() if name in known} | {"port": PORT}, "head"
    )
    wheels = bind(Wheels, head.get("wheels", {}), "head")
    limits = bind(SafetyLimits, head.get("safety", {}), "head")
    driver = RoombaDriver("base", config, ReplayHardware(recording, outcome), bus, Calibration(wheels=wheels))
    control = ControlLoop(bus, driver, Odometry(wheels), SafetyGate(limits, wheels.base))
    last = max((item.t for item in recording.occurrences), default=0.0)
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(work) for work in (Supervisor(driver).run(), _wish(recording, bus), control.run())]
        await asyncio.sleep(last)
        for task in tasks:
            task.cancel()
    return outcome.text()


async def _wish(recording: Recording, bus: Bus) -> None:
    """Publish the recorded wishes and withdrawals at their times."""
    for item in recording.occurrences:
        if item.kind not in ("wish", "withdraw"):
            continue
        await asyncio.sleep(max(0.0, item.t - now()))
        if item.kind == "withdraw":
            t, source, cause = item.text.split(" ", 2)
            bus.withdrawals.publish(Withdrawal(float(t), None if source == "operator" else source, cause))
            continue
        speed, turn_rate, t, *seen, source = item.text.split(" ")
        line_t = float(seen[0]) if seen else None
        bus.commands.publish(DriveCommand(float(t), float(speed), float(turn_rate), source, line_t))


def differences(expected: str, found: str) -> list[str]:
    """What disagrees, in words; empty if the outcomes agree."""
    problems = []
    wanted, got = _by_kind(expected), _by_kind(found)
    for kind in sorted(wanted | got):
        for number, (want, have) in enumerate(zip_longest(wanted.get(kind, []), got.get(kind, []))):
            if want is None or have is None or want[1] != have[1] or abs(want[0] - have[0]) > TOLERANCE:
                problems.append(f"{kind} {number + 1}: expected {_words(want)}, found {_words(have)}")
                break
    return problems


def _by_kind(text: str) -> dict[str, list[tuple[float, str]]]:
    kinds: dict[str, list[tuple[float, str]]] = {}
    for line in text.splitlines():
        time, _, rest = line.partition(" ")
        kinds.setdefault(rest.partition(" ")[0], []).append((float(time), rest))
    return kinds


def _words(item: tuple[float, str] | None) -> str:
    return "nothing more" if item is None else f"'{item[1]}' at {item[0]:.2f} s"


def load(case: str) -> tuple[Recording, Path]:
    """A shipped recording and where its expected outcome is."""
    return read_serial_log(FOLDER / f"{case}.log"), FOLDER / f"{case}.expected"


def cases() -> list[str]:
    """Names of the recordings that are there."""
    return sorted(path.stem for path in FOLDER.glob("*.log"))
