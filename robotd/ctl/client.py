"""A connection to a robot's control socket: straight to the Unix socket, or through the system's own ssh.

Over ssh the far end runs `robotctl dial-stdio`, which joins the socket to its standard input and output. Nothing that
was typed goes into that command. Keys, agents, jump hosts and connection sharing are what ~/.ssh/config says.
"""

from __future__ import annotations

import _socket  # because the module socket takes an eighth of the start
import contextlib
import errno
import json
import os
import select
import sys
import time
from collections import deque

from .errors import NO_CONNECTION, NO_DAEMON, NO_PERMISSION, OTHER_VERSION, REFUSED, USAGE, CtlError

TYPE_CHECKING = False  # what is imported only when it is needed would take as long as all else
if TYPE_CHECKING:
    import subprocess
    from typing import Any

SOCKET = "/run/robotd/control.sock"
PROTOCOL = 1
HELLO_S = 60.0  # for ssh to get there; a person may have to type a passphrase
ANSWER_S = 30.0
# what the far end runs: a login over ssh has no /opt/robotd/bin in its PATH
REMOTE = 'env "PATH=$PATH:/opt/robotd/bin" robotctl dial-stdio'


def socket_path(given: str | None) -> str:
    """Where the daemon listens on this computer."""
    return given or os.environ.get("ROBOTCTL_SOCKET") or SOCKET


def open_socket(path: str) -> _socket.socket:
    """Connect to a daemon on this computer; raises CtlError in words."""
    channel = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
    try:
        channel.connect(path)
    except OSError as error:
        channel.close()
        if error.errno in (errno.ENOENT, errno.ECONNREFUSED):
            mend = "start it: sudo systemctl start robotd; see why it ended: journalctl -u robotd -e"
            raise CtlError(NO_DAEMON, f"robotd is not running here (nobody listens on {path}); {mend}") from None
        if error.errno in (errno.EACCES, errno.EPERM):
            mend = "sudo usermod -aG robotd $USER, then log in again"
            raise CtlError(NO_PERMISSION, f"{path} may not be opened: you are not in its group; {mend}") from None
        raise CtlError(NO_DAEMON, f"{path}: {error.strerror}") from None
    return channel


def ssh_command(target: str, remote: str = REMOTE) -> list[str]:
    """The command that runs robotctl on a robot; raises CtlError if the target is not ssh://[user@]host[:port]."""
    import shlex

    user, host, port = parse_target(target)
    # an interrupted network is noticed; a user's own settings for the host are kept for all else
    command = [*shlex.split(os.environ.get("ROBOTCTL_SSH", "ssh")), "-T"]
    command += ["-o", "ServerAliveInterval=5", "-o", "ServerAliveCountMax=3", "-o", "ConnectTimeout=15"]
    if port is not None:
        command += ["-p", port]
    if user is not None:
        command += ["-l", user]
    return [*command, "--", host, remote]


def parse_target(target: str) -> tuple[str | None, str, str | None]:
    """User, host and port of ssh://[user@]host[:port]; raises CtlError."""
    wanted = "expected ssh://user@host or ssh://user@host:port"
    scheme, mark, rest = target.partition("://")
    if not mark:
        scheme, rest = "ssh", target
    rest = rest.rstrip("/")
    before, mark, host = rest.rpartition("@")
    user = before if mark else None
    port: str | None = None
    if host.startswith("["):
        host, _, tail = host[1:].partition("]")
        port = tail[1:] if tail.startswith(":") else None
    elif host.count(":") == 1:
        host, _, port = host.partition(":")
    for part in (user, host):
        if part is not None and (not part or part.startswith("-") or not part.isprintable() or " " in part):
            raise CtlError(USAGE, f"-H: found {target!r}; {wanted}")
    if scheme != "ssh" or "/" in host or (port is not None and not (port.isdecimal() and 0 < int(port) < 65536)):
        raise CtlError(USAGE, f"-H: found {target!r}; {wanted}")
    return user, host, port


class Connection:
    """JSON-RPC over the control socket of one robot.

    Parameters
    ----------
    target : str or None
        ssh://[user@]host[:port], or None for this computer.
    path : str or None
        Of the socket on this computer.
    """

    def __init__(self, target: str | None, path: str | None = None) -> None:
        self._target = target
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: _socket.socket | None = None
        self._rest = b""
        self._notes: deque[dict[str, Any]] = deque()
        self._number = 0
        if target is None:
            self._socket = open_socket(socket_path(path))
            self._in = self._out = self._socket.fileno()
        else:
            import subprocess

            command = ssh_command(target)
            try:
                self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
            except OSError as error:
                raise CtlError(NO_CONNECTION, f"{command[0]} cannot be run: {error.strerror}; install it") from None
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            self._in, self._out = self._process.stdout.fileno(), self._process.stdin.fileno()
        self._poll = select.poll()
        self._poll.register(self._in, select.POLLIN)
        self.robotd = self._hello()

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Hang up; what the robot did for this connection ends."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            import subprocess

            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
            try:
                self._process.wait(2.0)
            except subprocess.TimeoutExpired:
                self._process.terminate()
                self._process.wait()

    def fileno(self) -> int:
        """Readable when something has come."""
        return self._in

    def call(self, method: str, params: dict[str, Any] | None = None, *, seconds: float | None = ANSWER_S) -> Any:
        """Ask, and wait for the answer; what comes in between is kept for `notes`. Raises CtlError."""
        number = self.send(method, params)
        limit = None if seconds is None else time.monotonic() + seconds
        while True:
            message = self._message(limit)
            if message is None:
                raise CtlError(NO_CONNECTION, f"the robot has not answered within {seconds:g} s")
            if message.get("id") == number and "method" not in message:
                return answer(message)
            self._notes.append(message)

    def send(self, method: str, params: dict[str, Any] | None = None) -> int:
        """Ask without waiting; returns the request's number."""
        self._number += 1
        request = {"jsonrpc": "2.0", "id": self._number, "method": method, "params": params or {}}
        data = json.dumps(request).encode() + b"\n"
        try:
            while data:
                data = data[os.write(self._out, data) :]
        except OSError:
            self._lost()
        return self._number

    def note(self, seconds: float | None) -> dict[str, Any] | None:
        """The next message that nobody has waited for; None if none comes within so long."""
        if self._notes:
            return self._notes.popleft()
        return self._message(None if seconds is None else time.monotonic() + seconds)

    def _hello(self) -> str:
        message = self._message(time.monotonic() + (ANSWER_S if self._target is None else HELLO_S))
        if message is None:
            raise CtlError(NO_CONNECTION, "the robot does not say hello; restart robotd: sudo systemctl restart robotd")
        if message.get("method") != "hello":
            answer(message)
            raise CtlError(OTHER_VERSION, "what answers there is not robotd")
        params = message["params"]
        if params.get("protocol") != PROTOCOL:
            raise CtlError(
                OTHER_VERSION,
                f"robotd {params.get('robotd')} there speaks version {params.get('protocol')} of the control protocol, "
                f"this robotctl version {PROTOCOL}; bring both to the same release",
            )
        return str(params.get("robotd"))

    def _message(self, limit: float | None) -> dict[str, Any] | None:
        """The next message, or None when the time is up."""
        while b"\n" not in self._rest:
            wait = None if limit is None else max(0.0, limit - time.monotonic())
            if not self._poll.poll(None if wait is None else 1e3 * wait):
                return None
            try:
                data = os.read(self._in, 1 << 16)
            except OSError:
                data = b""
            if not data:
                self._lost()
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise CtlError(OTHER_VERSION, f"what answers there is not robotd: {line[:80]!r}")
        return message

    def _lost(self) -> None:
        """The other end has hung up: say why."""
        if self._process is None:
            raise CtlError(NO_CONNECTION, "robotd has ended; see why: journalctl -u robotd -e")
        import subprocess

        try:
            code = self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            code = 0
        if code == 255:
            raise CtlError(NO_CONNECTION, f"no connection to {self._target}; ssh says why above")
        if code == 127:
            raise CtlError(
                NO_CONNECTION,
                f"robotctl was not found on {self._target}; install robotd there, or link it into /usr/local/bin",
            )
        if code in (NO_DAEMON, NO_PERMISSION):
            raise CtlError(code, f"on {self._target}: see above")
        raise CtlError(NO_CONNECTION, f"the connection to {self._target} is gone")


def answer(message: dict[str, Any]) -> Any:
    """The result in an answer; raises CtlError with what the robot says against it."""
    error = message.get("error")
    if error is None:
        return message.get("result")
    problems = (error.get("data") or {}).get("problems") or [error.get("message", "refused")]
    raise CtlError(USAGE if error.get("code") in (-32602, -32601) else REFUSED, *problems)


def dial_stdio(path: str | None) -> int:
    """Join the control socket to standard input and output, for `-H`; returns the exit code."""
    channel = open_socket(socket_path(path))
    poll = select.poll()
    poll.register(0, select.POLLIN)
    poll.register(channel.fileno(), select.POLLIN)
    while True:
        for fd, _ in poll.poll():
            source, target = (0, channel.fileno()) if fd == 0 else (channel.fileno(), 1)
            try:
                data = os.read(source, 1 << 16)
                if not data:
                    return 0
                while data:
                    data = data[os.write(target, data) :]
            except OSError:
                return 0


def warn(text: str) -> None:
    """A line on standard error."""
    print(f"robotctl: {text}", file=sys.stderr, flush=True)
