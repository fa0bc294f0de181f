"""The daemon's control socket: a Unix socket on which operators command the robot (robotd.rpc says in which words).

Whoever may open the socket may command the robot: that is its group and its user. Nothing listens on the network;
from elsewhere `robotctl` comes over ssh. A client that vanishes takes what it was doing with it: the requests that it
had open are cancelled, which halts a robot that it drove.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
import os
import pwd
import socket
import stat
import struct
from collections.abc import AsyncIterator, Coroutine
from pathlib import Path
from typing import Any, Protocol

from . import __version__, rpc
from .errors import InputError, RobotdError
from .rpc import Request, RpcError

log = logging.getLogger(__name__)

MODE = 0o660
CLIENTS = 16
OPEN_REQUESTS = 16  # of one client
WRITE_S = 10.0  # a client that takes nothing for so long is gone
PEER = struct.Struct("3i")  # pid, uid, gid: struct ucred, unix(7)


class Commands(Protocol):
    """What operators can ask for."""

    def call(self, client: Client, request: Request) -> Any:
        """Do it, at once or in the coroutine that is returned; raises RpcError, or a RobotdError that becomes one."""

    def gone(self, client: Client) -> None:
        """This client does not come back."""


class Client:
    """One connection.

    Attributes
    ----------
    who : str
        The user at the other end, as the kernel says: over ssh the one who has logged in.
    answers : asyncio.Queue
        What the person there said to prompts.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self.who = _peer(writer.get_extra_info("socket"))
        self.answers: asyncio.Queue[Any] = asyncio.Queue(maxsize=8)
        self._tasks: set[asyncio.Task[None]] = set()

    async def tell(self, method: str, params: Any) -> None:
        """Send a notification; waits while the client is slow, and ends the connection if it takes nothing."""
        await self._send(rpc.notification(method, params))

    async def serve(self, commands: Commands) -> None:
        """Until the client hangs up; what it had open is cancelled then."""
        try:
            async with asyncio.TaskGroup() as group:
                await self.tell("hello", {"protocol": rpc.VERSION, "robotd": __version__})
                async for line in self._lines():
                    work = self._begin(commands, line)
                    if work is not None:
                        task = group.create_task(work)
                        self._tasks.add(task)
                        task.add_done_callback(self._tasks.discard)
                commands.gone(self)  # before anything is waited for
                for task in self._tasks:
                    task.cancel()
        finally:
            commands.gone(self)
            self._writer.transport.abort()

    async def _lines(self) -> AsyncIterator[bytes]:
        while True:
            try:
                line = await self._reader.readuntil(b"\n")
            except asyncio.LimitOverrunError:
                text = f"a line has more than {rpc.LINE_LIMIT} bytes"
                await self._send(rpc.failure(RpcError(rpc.INVALID_REQUEST, text)))
                return
            except (asyncio.IncompleteReadError, OSError):
                return
            if line.strip():
                yield line

    def _begin(self, commands: Commands, line: bytes) -> Coroutine[Any, Any, None] | None:
        """Do what a line asks for; returns what is still to be awaited."""
        request = Request("")
        try:
            request = rpc.parse(line)
            if len(self._tasks) >= OPEN_REQUESTS:
                raise RpcError(rpc.REFUSED, f"{OPEN_REQUESTS} requests of this client are open already")
            value = commands.call(self, request)
        except (RpcError, RobotdError) as error:
            return self._refuse(request, error)
        return self._answer(request, value) if request.id is not None or inspect.isawaitable(value) else None

    async def _answer(self, request: Request, value: Any) -> None:
        try:
            if inspect.isawaitable(value):
                value = await value
        except (RpcError, RobotdError) as error:
            await self._refuse(request, error)
            return
        if request.id is not None:
            await self._send(rpc.result(request.id, value))

    async def _refuse(self, request: Request, error: Exception) -> None:
        if isinstance(error, RpcError):
            answer = RpcError(error.code, *error.problems, id=request.id if error.id is None else error.id)
        elif isinstance(error, InputError):
            answer = RpcError(rpc.REFUSED, *error.problems, id=request.id)
        else:
            answer = RpcError(rpc.FAILED, str(error), id=request.id)
        if request.method == "" or request.id is not None:
            await self._send(rpc.failure(answer))

    async def _send(self, line: bytes) -> None:
        if self._writer.is_closing():
            return
        self._writer.write(line)
        try:
            async with asyncio.timeout(WRITE_S):
                await self._writer.drain()
        except (TimeoutError, OSError):
            self._writer.transport.abort()  # which ends `_lines`


class ControlSocket:
    """Listens, and serves every client until it hangs up.

    Parameters
    ----------
    path : Path
        Of the socket; its folder must exist. A socket that nobody answers on is replaced.
    commands : Commands
    """

    def __init__(self, path: Path, commands: Commands) -> None:
        self.path = path
        self._commands = commands
        self._clients: set[asyncio.Task[None]] = set()
        self.settled = asyncio.Event()  # it listens, or never will

    async def run(self) -> None:
        """Until cancelled.

        Raises
        ------
        InputError
            The socket cannot be made, or another robotd listens there.
        """
        try:
            listener = _listen(self.path)
        finally:
            self.settled.set()
        failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        async def admit(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            self._clients.add(task)
            try:
                if len(self._clients) > CLIENTS:
                    error = RpcError(rpc.REFUSED, f"{CLIENTS} clients are connected already; end one of them")
                    writer.write(rpc.failure(error))
                    writer.close()
                else:
                    await Client(reader, writer).serve(self._commands)
            except asyncio.CancelledError:
                pass  # the daemon ends
            except Exception as error:  # a bug: the daemon ends, as with any other of its tasks
                if not failed.done():
                    failed.set_exception(error)
            finally:
                self._clients.discard(task)

        server = await asyncio.start_unix_server(admit, sock=listener, limit=rpc.LINE_LIMIT)
        try:
            await failed
        finally:
            server.close()
            clients = list(self._clients)
            for task in clients:
                task.cancel()
            await asyncio.gather(*clients, return_exceptions=True)
            self.path.unlink(missing_ok=True)


def _listen(path: Path) -> socket.socket:
    """A listening socket which its group may open; raises InputError."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        if path.exists():
            if not stat.S_ISSOCK(path.stat().st_mode):
                raise InputError(f"{path}: exists and is no socket; name another [robot] control")
            if _is_answered(path):
                raise InputError(f"{path}: another robotd listens there; end it, or name another [robot] control")
            path.unlink()
        listener.bind(str(path))
        os.chmod(path, MODE)  # before anybody can be listened to
        listener.listen(CLIENTS)
    except OSError as error:
        listener.close()
        raise InputError(
            f"{path}: no control socket: {error.strerror or error}; as a service robotd finds its folder made by "
            "systemd, by hand name a place for it: [robot] control"
        ) from error
    except BaseException:
        listener.close()
        raise
    return listener


def _is_answered(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True


def _peer(connection: socket.socket) -> str:
    _, uid, _ = PEER.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, PEER.size))
    with contextlib.suppress(KeyError):
        return pwd.getpwuid(uid).pw_name
    return f"user {uid}"
