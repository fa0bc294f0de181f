"""The control socket of a simulated Roomba: what happens to a robot that is not a byte, one JSON object a line.

    {"brc": 1.0}                  the wake line is low for so long, or "low", "high"
    {"press": "clean"}            a button: clean, spot, dock, minute, hour, day, schedule, clock
    {"bump": "left"}              left, right, both or null, until the next
    {"drop": "both"}              wheels that hang: left, right, both or null
    {"lift": true}                taken off the floor: both wheels hang
    {"cliff": true}               the front cliff sensors see no floor
    {"carry": [dx, dy, turn]}     set down elsewhere, metres ahead and left, radians
    {"push": [forward, turn, s]}  pushed over the floor with its motors off, metres, radians, within s seconds
    {"slip": [left, right]}       the next metres of rim that move nothing
    {"overcurrent": 8}            packet 14
    {"dock": true}                its home base stands where the robot is; [x, y, heading]: there; false: taken away
    {"plug": true}                the mains charger in its side
    {"battery": 0.5}              charge as a share of the capacity, or "out": taken out and put back
    {"stall": 2.0}                the line is silent for so long, then all comes at once
    {"disconnect": 3.0}           the cable is pulled for so long, or true: until {"connect": true}
    {"state": true}               asks for the state

Every line is answered by one: `{"ok": true}`, the state, or `{"error": "..."}`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..records import Pose
from .battery import CAPACITY_MAH
from .dock import Dock
from .roomba import BUTTONS, MODES, SimRoomba
from .roomba_body import HandledBody

if TYPE_CHECKING:
    from .terminal import TerminalPort

SIDES = {None: (False, False), "left": (True, False), "right": (False, True), "both": (True, True)}


class SideChannel:
    """A Unix socket that works the world around one robot; an asynchronous context.

    Parameters
    ----------
    roomba : SimRoomba
    body : HandledBody
    port : TerminalPort
    path : Path
        Of the socket.
    """

    def __init__(self, roomba: SimRoomba, body: HandledBody, port: TerminalPort, path: Path) -> None:
        self.path = path
        self._roomba = roomba
        self._body = body
        self._port = port
        self._low_since: float | None = None
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.StreamWriter] = set()
        self._actions: dict[str, Callable[[Any], None]] = {
            "brc": self._brc,
            "press": self._press,
            "bump": self._bump,
            "drop": self._drop,
            "lift": self._lift,
            "cliff": self._cliff,
            "carry": lambda value: body.carry(*_numbers("carry", value, 3)),
            "push": self._push,
            "slip": lambda value: body.body.slip(*_numbers("slip", value, 2)),
            "overcurrent": self._overcurrent,
            "dock": self._dock,
            "plug": lambda value: roomba.set_plugged(_flag("plug", value)),
            "battery": self._battery,
            "stall": self._stall,
            "disconnect": self._disconnect,
            "connect": lambda value: port.connect(),
        }

    async def __aenter__(self) -> SideChannel:
        self._clear_path()
        try:
            self._server = await asyncio.start_unix_server(self._serve, self.path)
        except OSError as error:
            raise InputError(f"{self.path}: no control socket can be made: {error}; name a shorter --link") from error
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server.close()
        for writer in list(self._clients):
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
        self.path.unlink(missing_ok=True)

    def _clear_path(self) -> None:
        """Remove the socket of a simulator that is gone; raises InputError where one still answers."""
        with contextlib.suppress(FileNotFoundError):
            if not stat.S_ISSOCK(os.stat(self.path).st_mode):
                raise InputError(f"{self.path}: exists and is not a socket; name another --link or remove it")
            with socket.socket(socket.AF_UNIX) as probe, contextlib.suppress(OSError):
                probe.connect(str(self.path))
                raise InputError(f"{self.path}: another simulated robot answers there; stop it or name another --link")
            self.path.unlink()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        try:
            with contextlib.suppress(ConnectionError, ValueError):  # gone, or a line that has no end
                while line := await reader.readline():
                    writer.write(json.dumps(self.answer(line)).encode() + b"\n")
                    await writer.drain()
        finally:
            self._clients.discard(writer)
            writer.close()

    def answer(self, line: bytes) -> dict[str, Any]:
        """Do what one line says; returns the answer."""
        try:
            wishes = json.loads(line)
            if not isinstance(wishes, dict):
                raise ValueError("expected one JSON object")
            unknown = sorted(wishes.keys() - self._actions.keys() - {"state"})
            if unknown:
                known = ", ".join(sorted([*self._actions, "state"]))
                raise ValueError(f"unknown wish {', '.join(unknown)}; expected one of {known}")
            for name, value in wishes.items():
                if name != "state":
                    self._actions[name](value)
        except (ValueError, TypeError) as error:
            return {"error": str(error)}
        return self.state() if "state" in wishes else {"ok": True}

    def state(self) -> dict[str, Any]:
        """What the robot is and does now, in SI units but for what its name says."""
        roomba, pose = self._roomba, self._body.pose
        return {
            "t": roomba.now,
            "mode": MODES[roomba.mode],
            "asleep": roomba.is_asleep,
            "docked": roomba.is_docked,
            "plugged": roomba.is_plugged,
            "charging": roomba.battery.is_charging,
            "program": roomba.programs.name,
            "baud": roomba.baud,
            "client_baud": self._port.baud if self._port.link is not None else None,
            "speeds": [roomba.left.speed, roomba.right.speed],
            "requested_mm_s": [roomba.left.requested_mm_s, roomba.right.requested_mm_s],
            "encoders": [roomba.left.counts, roomba.right.counts],
            "rotations": [self._body.left_rotation, self._body.right_rotation],
            "pose": [pose.x, pose.y, pose.heading],
            "charge": roomba.battery.charge_mah / CAPACITY_MAH,
            "voltage": roomba.battery.voltage_mv / 1000.0,
            "leds": list(roomba.leds),
            "playing": roomba.song if roomba.is_playing else None,
        }

    def _brc(self, value: Any) -> None:
        seconds = _number("brc", value) if value not in ("low", "high") else 0.0
        loop = asyncio.get_running_loop()
        if value == "low":
            self._low_since = loop.time() if self._low_since is None else self._low_since
        elif value == "high":
            if self._low_since is not None:
                self._roomba.pulse_brc(loop.time() - self._low_since)
            self._low_since = None
        else:
            loop.call_later(seconds, self._roomba.pulse_brc, seconds)

    def _press(self, value: Any) -> None:
        if value not in BUTTONS:
            raise ValueError(f"press: found {value!r}; expected one of {', '.join(BUTTONS)}")
        self._roomba.press(value)

    def _bump(self, value: Any) -> None:
        self._body.held_left, self._body.held_right = _sides("bump", value)

    def _drop(self, value: Any) -> None:
        self._body.body.wheel_drop_left, self._body.body.wheel_drop_right = _sides("drop", value)

    def _lift(self, value: Any) -> None:
        if _flag("lift", value):
            self._body.body.lift()
        else:
            self._body.body.put_down()

    def _cliff(self, value: Any) -> None:
        self._body.body.cliff = _flag("cliff", value)

    def _push(self, value: Any) -> None:
        forward, turn, seconds = _numbers("push", value, 3)
        if seconds <= 0.0:
            raise ValueError(f"push: found {seconds:g} s; expected more than 0")
        self._body.push(forward, turn, seconds)

    def _overcurrent(self, value: Any) -> None:
        self._roomba.overcurrent = int(_number("overcurrent", value)) & 0xFF

    def _dock(self, value: Any) -> None:
        if value is False:
            self._roomba.dock = None
            self._roomba.set_docked(False)
            return
        pose = self._body.pose if value is True else Pose(*_numbers("dock", value, 3))
        self._roomba.dock = Dock(pose, self._body)

    def _battery(self, value: Any) -> None:
        if value == "out":
            self._roomba.pull_battery()
        else:
            self._roomba.battery.charge_mah = max(0.0, min(1.0, _number("battery", value))) * CAPACITY_MAH

    def _stall(self, value: Any) -> None:
        seconds = _number("stall", value)
        if self._port.link is not None:
            self._port.link.stall(seconds)

    def _disconnect(self, value: Any) -> None:
        self._port.disconnect(None if value is True else _number("disconnect", value))


def _flag(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{name}: found {value!r}; expected true or false")
    return value


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name}: found {value!r}; expected a number")
    return float(value)


def _numbers(name: str, value: Any, count: int) -> list[float]:
    try:
        numbers = [_number(name, item) for item in value] if isinstance(value, list) else []
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise ValueError(f"{name}: found {value!r}; expected {count} numbers")
    return numbers


def _sides(name: str, value: Any) -> tuple[bool, bool]:
    value = None if value is False else value
    if not isinstance(value, str | None) or value not in SIDES:
        raise ValueError(f"{name}: found {value!r}; expected left, right, both or null")
    return SIDES[value]
