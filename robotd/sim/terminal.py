"""`robotd sim roomba`: a simulated Roomba in real time behind a pseudo-terminal that any client can open.

The client's termios speed is its baud rate: at another one than the robot's both hear noise, as on a wire. Modem lines
do not exist on a pseudo-terminal, so the wake line and everything else that is not a byte goes over the control
socket (robotd.sim.side_channel).
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fcntl
import math
import os
import pty
import signal
import struct
import sys
import termios
import tty
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..clock import ticks
from ..errors import DriverFault, InputError
from ..oi import TICK
from ..records import Pose
from .body import Body
from .layout import LineLayout, StoreLayout
from .quirks import LineFaults, RoombaQuirks, listing, quirks_from
from .roomba import SimRoomba
from .roomba_body import HandledBody
from .roomba_link import RoombaLink
from .settings import WorldSettings
from .side_channel import SideChannel
from .stores import find_store, load_store

PLANE = 1000.0  # m: side of the open floor
TCGETS2 = 0x802C542A  # _IOR('T', 0x2A, struct termios2), asm-generic/ioctls.h: the speed as a number
TERMIOS2 = struct.Struct("4I B 19s 2I")
READ_SIZE = 4096


class TerminalPort:
    """The robot's end of a pseudo-terminal, and the symbolic link by which clients find theirs.

    Parameters
    ----------
    roomba : SimRoomba
    path : Path
        Where the symbolic link is made.
    """

    def __init__(self, roomba: SimRoomba, path: Path) -> None:
        self.roomba = roomba
        self.path = path
        self.link: RoombaLink | None = None
        self._loop = asyncio.get_running_loop()
        self._master = self._slave = -1
        self._tasks: list[asyncio.Task[None]] = []
        self._reconnect: asyncio.TimerHandle | None = None

    @property
    def baud(self) -> int:
        """What the client's end is set to."""
        *_, speed = TERMIOS2.unpack(fcntl.ioctl(self._slave, TCGETS2, bytes(TERMIOS2.size)))
        return int(speed)

    def connect(self) -> None:
        """Plug the cable in: a new pseudo-terminal at the same path."""
        if self.link is not None:
            return
        self._cancel_reconnect()
        # the slave stays open here, because without any open slave the master reads EIO
        self._master, self._slave = pty.openpty()
        for end in (self._master, self._slave):
            tty.setraw(end)
        settings = termios.tcgetattr(self._slave)
        settings[4] = settings[5] = termios.B115200
        termios.tcsetattr(self._slave, termios.TCSANOW, settings)
        os.set_blocking(self._master, False)
        self.link = RoombaLink(self.roomba, self.baud)
        self._loop.add_reader(self._master, self._on_readable)
        self._tasks = [self._loop.create_task(work) for work in (self._pump(self.link), self._watch(self.link))]
        for task in self._tasks:
            task.add_done_callback(self._on_done)
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        os.symlink(os.ttyname(self._slave), fresh)
        os.replace(fresh, self.path)
        self.roomba.tell("cable plugged in")

    def disconnect(self, seconds: float | None = None) -> None:
        """Pull the cable: the client's end hangs up and the path vanishes, for so long or until `connect`."""
        self._cancel_reconnect()
        if self.link is not None:
            self.link.close()
            self.link = None
            self._loop.remove_reader(self._master)
            for task in self._tasks:
                task.cancel()
            self.path.unlink(missing_ok=True)
            self.roomba.tell("cable pulled")
            os.close(self._slave)
            os.close(self._master)
        if seconds is not None:
            self._reconnect = self._loop.call_later(seconds, self.connect)

    def _cancel_reconnect(self) -> None:
        if self._reconnect is not None:
            self._reconnect.cancel()
            self._reconnect = None

    def _on_done(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            self._loop.call_exception_handler({"message": "the line has failed", "exception": error})

    def _on_readable(self) -> None:
        link = self.link
        try:
            data = os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return
        if link is not None and data:
            link.set_baud(self.baud)
            with contextlib.suppress(DriverFault):  # pulled out a moment ago; the pump ends the port
                link.write(data)

    async def _pump(self, link: RoombaLink) -> None:
        """What the robot sends, to the client; what a client leaves unread is lost."""
        try:
            while True:
                _, data = await link.read()
                with contextlib.suppress(BlockingIOError):
                    os.write(self._master, data)
        except DriverFault:
            if self.link is link:  # the line's own fault has pulled the cable
                self._loop.call_soon(self.disconnect)

    async def _watch(self, link: RoombaLink) -> None:
        """Follow the client's baud rate, and let go of an exclusive lock that outlives its client."""
        async for tick in ticks(TICK):
            with contextlib.suppress(DriverFault):
                link.set_baud(self.baud)
            if tick % 66 == 0:
                fcntl.ioctl(self._slave, termios.TIOCNXCL)


class Console:
    """Says on stderr what the robot does, and where it is while it moves."""

    def __init__(self, roomba: SimRoomba, body: HandledBody) -> None:
        self._roomba = roomba
        self._body = body
        self._start = asyncio.get_running_loop().time()
        roomba.listener = self.say

    def say(self, what: str) -> None:
        """One line with the seconds since the start."""
        seconds = asyncio.get_running_loop().time() - self._start
        print(f"{seconds:9.3f} {what}", file=sys.stderr, flush=True)

    async def follow(self) -> None:
        """Say the pose once a second while the robot moves."""
        async for _ in ticks(1.0):
            if self._roomba.left.speed or self._roomba.right.speed:
                pose = self._body.pose
                self.say(f"at x {pose.x:.3f} y {pose.y:.3f} m, heading {math.degrees(pose.heading):.1f} degrees")


def run(arguments: argparse.Namespace) -> int:
    """`robotd sim roomba`: be a robot until SIGTERM or SIGINT; returns 0.

    Raises
    ------
    InputError
        A switch, the store or the path is wrong.
    """
    if arguments.list_quirks:
        print(f"--quirk NAME=VALUE (a NAME alone turns a yes-or-no switch over)\n{listing(RoombaQuirks)}")
        print(f"--fault NAME=VALUE\n{listing(LineFaults)}")
        return 0
    if arguments.link is None:
        raise InputError("robotd sim roomba: no --link; expected the path at which clients shall find the robot")
    quirks = quirks_from(arguments.quirk, arguments.fault)
    body = _body(arguments.store, arguments.seed)
    roomba = SimRoomba(body, _rng(arguments.seed, "roomba"), quirks)
    asyncio.run(_live(roomba, body, arguments.link.absolute(), is_quiet=arguments.quiet))
    return 0


async def _live(roomba: SimRoomba, body: HandledBody, path: Path, *, is_quiet: bool) -> None:
    """Tick, listen and talk until told to end."""
    loop = asyncio.get_running_loop()
    ended: asyncio.Future[None] = loop.create_future()

    def end() -> None:
        if not ended.done():
            ended.set_result(None)

    def fail(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if not ended.done():
            ended.set_exception(context.get("exception") or RuntimeError(context["message"]))

    loop.set_exception_handler(fail)  # because a robot that has stopped ticking must not look alive
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, end)
    port = TerminalPort(roomba, path)
    channel = SideChannel(roomba, body, port, path.with_name(f"{path.name}.ctl"))
    console = Console(roomba, body)
    if is_quiet:
        roomba.listener = None
    _check_free(path)
    async with channel:
        following = loop.create_task(console.follow()) if not is_quiet else None
        try:
            port.connect()
            print(f"simulated Roomba at {path}, control socket {channel.path}", file=sys.stderr, flush=True)
            await ended
        finally:
            if following is not None:
                following.cancel()
            port.disconnect()
            if roomba.power is not None:
                roomba.power.stop()


def _check_free(path: Path) -> None:
    """Refuse to take the place of anything but a symbolic link; the control socket knows whether that is in use."""
    if path.exists() and not path.is_symlink():
        raise InputError(f"{path}: exists and is not a symbolic link; name another path or remove it")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder; create it or name another path")


def _body(store: str | None, seed: int) -> HandledBody:
    """A robot on an open floor, or at the first stop of a store."""
    if store is None:
        layout = StoreLayout("robotd-store/1", "plane", (PLANE, PLANE), LineLayout(((0.0, 0.0), (1.0, 0.0)), (0.0,)))
        middle = (0.5 * PLANE, 0.5 * PLANE)
        return HandledBody(Body(layout, WorldSettings(), _rng(seed, "body"), Pose(*middle, 0.0)), middle)
    layout = load_store(find_store(store))
    x, y = layout.geometry.point_at(layout.line.stops[0])
    start = Pose(float(x), float(y), float(layout.geometry.heading_at(layout.line.stops[0])))
    return HandledBody(Body(layout, WorldSettings(), _rng(seed, "body"), start))


def _rng(seed: int, name: str) -> np.random.Generator:
    """The generator that a World of this seed gives to this part."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])
