"""Drivers: how they are written, found and built.

A driver is an entry point in the group `robotd.drivers`, a class with a frozen dataclass `Config`, and a section
`[drivers.<instance>]` with `driver = "<entry point>"` in the configuration. Life cycle: construct (no I/O), `open`,
`run` until cancelled, `close` in reverse order of what `open` took. A device that fails raises DriverFault; its
supervisor halts the robot and opens it again. Any other exception is a bug and ends the daemon.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack
from importlib.metadata import EntryPoint, entry_points
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

from .bus import Bus
from .clock import now
from .config import Calibration
from .errors import ConfigError
from .hardware import CameraMode, Hardware
from .records import Event

GROUP = "robotd.drivers"


class Driver:
    """Base of every driver.

    Attributes
    ----------
    name : str
        The instance's name in the configuration.
    config : an instance of the class's own frozen `Config`
    hardware, bus, calibration
        Where devices come from, where messages go, what is known about the robot.
    resources : AsyncExitStack
        What `open` takes is entered here; closed in reverse order, also after a failed `open`.
    """

    kind: ClassVar[str]  # base, camera, beacons, labels or follower
    Config: ClassVar[type[Any]]

    def __init__(self, name: str, config: Any, hardware: Hardware, bus: Bus, calibration: Calibration) -> None:
        self.name = name
        self.config = config
        self.hardware = hardware
        self.bus = bus
        self.calibration = calibration
        self.resources = AsyncExitStack()

    async def open(self) -> None:
        """Take the devices; raises DriverFault if one is missing."""

    async def run(self) -> None:
        """Work until cancelled; raises DriverFault when a device fails."""
        await asyncio.Event().wait()

    async def close(self) -> None:
        """Leave everything off and release what `open` took; safe to call twice."""
        await self.resources.aclose()

    def report(self, text: str, level: Any = "info") -> None:
        """Tell the operator."""
        self.bus.events.publish(Event(now(), self.name, level, text))


@runtime_checkable
class Base(Protocol):
    """Wheels and bumpers: publishes SensorFrames; halts by itself when drive commands stop coming for 0.2 s."""

    name: str

    def drive(self, speed: float, turn_rate: float) -> None:
        """Set speed (m/s) and turn rate (rad/s, counter-clockwise) until the next command or for 0.2 s."""

    def halt(self) -> None:
        """Zero velocity at once."""

    def arm(self) -> None:
        """Somebody wants to move: be in the mode in which the wheels obey, and stay there while this is repeated.

        Without it the base goes back, after a while, to the mode in which it can charge and sleep.
        """

    async def dock(self) -> None:
        """Drive onto the charger by the base's own means; returns when it charges.

        Raises DriverFault when it does not arrive.
        """


@runtime_checkable
class Camera(Protocol):
    """Publishes frames on `bus.frames(<instance name>)` while started."""

    name: str

    async def start(self, mode: CameraMode) -> None:
        """Stream in this mode (a running stream is restarted if the mode differs)."""

    async def stop(self) -> None:
        """Stop streaming."""


@runtime_checkable
class Labels(Protocol):
    """The label system: unknown delay, no feedback."""

    name: str

    async def flash(self, labels: Sequence[str], strength: float, durations: Sequence[int]) -> Mapping[str, str]:
        """Ask that these labels flash, in this order, each for its whole seconds of `durations`, at `strength` 0..1.

        Returns when the request was accepted for delivery, with the labels that it was not accepted for and why:
        asking for those again would not help. Raises DriverFault if the label system cannot be reached or takes no
        request at all, with what the operator can do about it.
        """


@runtime_checkable
class ListsLabels(Protocol):
    """A label system that knows which labels it has."""

    async def listed(self) -> str:
        """Its list of labels, as `label_list.read_labels` takes it; raises DriverFault."""


FollowEnd = Literal["distance", "marker", "end"]


@runtime_checkable
class Follower(Protocol):
    """Follows a line: publishes DriveCommands with the `line_t` at which it last saw the line.

    `blind` is how far before the robot, in metres from its origin, the nearest floor lies that it can see; `mode` is
    how its camera is to run while the robot drives.
    """

    name: str
    blind: float
    mode: CameraMode

    async def follow(self, travelled: float, *, at_marker: bool = False) -> FollowEnd:
        """Drive along the line until `bus.odometry` says `travelled` metres since the leg began, then halt.

        With `travelled` inf it goes on without end. With `at_marker` it halts at the next marker beside the
        line, too, and the line's end is a stop and no error. Returns why it halted.

        Raises MissionError when the line is lost or ends; the robot stands still then, because the follower has
        published a Withdrawal that says so.
        """


def available() -> dict[str, EntryPoint]:
    """Every installed driver by the name of its entry point."""
    return {point.name: point for point in entry_points(group=GROUP)}


def load(name: str, where: str) -> type[Driver]:
    """The class behind an entry point; raises ConfigError naming the installed ones."""
    points = available()
    if name not in points:
        raise ConfigError(f"{where}: unknown driver '{name}'; installed are {', '.join(sorted(points)) or 'none'}")
    cls = points[name].load()
    if not (isinstance(cls, type) and issubclass(cls, Driver)):
        raise ConfigError(f"{where}: the driver '{name}' is not a robotd.plugin.Driver ({points[name].value})")
    return cls
