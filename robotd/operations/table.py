"""The table of methods: each has a name, a frozen dataclass of parameters, and a function that does it.

Parameters come from outside: they are bound strictly, and every mistake in them is answered in words.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from .. import rpc
from ..bind import bind
from ..control_socket import Client
from ..daemon import Daemon
from ..errors import ConfigError
from ..rpc import Request, RpcError
from .hand_drive import HandDrive

Function = Callable[["Operations", Client, Any], Any]
METHODS: dict[str, tuple[type[Any], Function]] = {}


@dataclass(frozen=True, slots=True)
class Nothing:
    """No parameters."""


def method(name: str, params: type[Any] = Nothing) -> Callable[[Function], Function]:
    """Enter a function into the table; it gets the operations, the client, and its bound parameters."""

    def enter(function: Function) -> Function:
        METHODS[name] = params, function
        return function

    return enter


class Operations:
    """What the clients of one daemon do; see robotd.control_socket.Commands.

    Attributes
    ----------
    robot : Daemon
    hand : HandDrive
        Whoever drives by hand.
    """

    def __init__(self, robot: Daemon) -> None:
        self.robot = robot
        self.bus = robot.assembly.bus
        self.hand = HandDrive(self.bus)
        self.reading = asyncio.Lock()  # of the configuration: one at a time
        self._busy: str | None = None

    def call(self, client: Client, request: Request) -> Any:
        """Do what a client asks for."""
        if request.method not in METHODS:
            raise RpcError(rpc.UNKNOWN_METHOD, f"unknown method '{request.method}'; there is {', '.join(METHODS)}")
        params, function = METHODS[request.method]
        try:
            bound = bind(params, request.params, request.method)
        except ConfigError as error:
            raise RpcError(rpc.INVALID_PARAMS, *error.problems) from None
        return function(self, client, bound)

    def gone(self, client: Client) -> None:
        """A client has hung up: it does not drive any more."""
        self.hand.gone(client)

    def check_free(self, *, in_pause: bool = False) -> None:
        """Raise RpcError if the robot is not free for something that moves it; `in_pause`: a paused mission is no
        hindrance."""
        if self._busy is not None:
            raise RpcError(rpc.REFUSED, f"{self._busy} is under way; robotctl halt ends it")
        mission = self.robot.mission
        if self.robot.missions.is_under_way and not (in_pause and mission is not None and mission.paused is not None):
            raise RpcError(rpc.REFUSED, "a mission is under way; robotctl mission abort ends it")

    @property
    def busy(self) -> str | None:
        """What has the robot for itself, if anything has."""
        return self._busy

    @contextmanager
    def alone(self, what: str, *, in_pause: bool = False) -> Iterator[None]:
        """Have the robot for oneself inside."""
        self.check_free(in_pause=in_pause)
        self._busy = what
        try:
            yield
        finally:
            self._busy = None
