"""A real serial line on the event loop, over a descriptor that the guardian has lent; see robotd.guardian.

The guardian halts the robot when this process dies or its loop hangs. This side watches the guardian in turn: while it
does not answer the robot would be unguarded, so it is halted from here and the loan is given up. And it fences itself
in: a process that has slept for longer than the guardian waits writes nothing any more.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import select
import socket
import struct
import subprocess
import sys
import termios
from collections import deque
from pathlib import Path

from .clock import in_thread, now, outside
from .errors import DriverFault
from .guardian import BEAT, BEAT_S, ENDED, LENT, MESSAGE_LIMIT, OPEN, REFUSED, SILENCE_S, SOCKET
from .serial_port import GONE, HALT, set_rate, set_wake_line

log = logging.getLogger(__name__)

QUEUE_LIMIT = 4096  # bytes: more than that waiting means that the device takes none
CLOSE_WAIT = 0.05  # s for what is still queued when the line is closed
ANSWER_S = 5.0  # for the guardian to lend the port; it may be halting the robot of the loan before
REST_BEAT_S = 2 * BEAT_S  # while a robot at rest is listened to in bunches: each wake-up counts then
ECHO_S = 1.0  # without an answer to a heartbeat for so long the guardian counts as gone
HALTS = 3  # because a byte may be lost


async def open_serial(port: str, baud: int, guardian: Path = SOCKET) -> LentLink:
    """Borrow a serial port, 8N1, for this process alone.

    Where nobody has a socket at `guardian`, a guardian of this process's own is started, except as a service of
    systemd, where it would be killed together with this process.

    Parameters
    ----------
    port : str
        Best one of /dev/serial/by-id/, because those names survive replugging.
    baud : int
        Bits per second; one of robotd.serial_port.RATES.
    guardian : Path
        The guardian's socket.

    Raises
    ------
    DriverFault
        No guardian (says how to start it), no such port (names those that exist), no permission (names the group), in
        use, or not a serial port.
    """
    with outside():
        connection = await _reach(guardian)
        try:
            fd, remark = await _borrow(connection, port, baud)
        except BaseException:
            connection.close()
            raise
    link = LentLink(port, fd, connection, remark)
    link.start()
    return link


async def _reach(guardian: Path) -> socket.socket:
    """A connection to the guardian."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.setblocking(False)
        connection.connect(str(guardian))
        return connection
    except FileNotFoundError:
        connection.close()
    except OSError as error:
        connection.close()
        raise DriverFault(_explain_connection(guardian, error)) from error
    if os.environ.get("SYSTEMD_EXEC_PID") == str(os.getpid()):
        raise DriverFault(
            f"no guardian at {guardian}, so nobody would halt the robot if this process died; start it: "
            "sudo systemctl enable --now robotd-guardian"
        )
    return await in_thread(_start_own)


def _explain_connection(guardian: Path, error: OSError) -> str:
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"{guardian}: permission denied; add the user to the group robotd: sudo usermod -aG robotd USER"
    if error.errno == errno.ECONNREFUSED:
        return f"{guardian}: no guardian listens there; start it: sudo systemctl restart robotd-guardian"
    return f"{guardian}: the guardian cannot be reached: {error.strerror or error}"


def _start_own() -> socket.socket:
    """Start a guardian for one loan; it outlives this process, and its terminal, until the robot is halted."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-m", "robotd.guardian", "--fd", str(its.fileno())]
    service = ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")  # which are about this process alone
    environment = {name: value for name, value in os.environ.items() if name not in service}
    try:
        with its:
            subprocess.run(
                command,
                env=environment,
                pass_fds=[its.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                check=True,
            )  # returns when it has detached itself
    except (OSError, subprocess.SubprocessError) as error:
        ours.close()
        raise DriverFault(f"the guardian does not start: {error}; try it: {' '.join(command[:3])} --help") from error
    ours.setblocking(False)
    return ours


async def _borrow(connection: socket.socket, port: str, baud: int) -> tuple[int, str]:
    """Ask for the port; returns its descriptor and the guardian's remark."""
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    loop.add_reader(connection, readable.set)
    try:
        connection.send(OPEN + f" {baud} {port}".encode())
        async with asyncio.timeout(ANSWER_S):
            await readable.wait()
        answer, extra, *_ = connection.recvmsg(MESSAGE_LIMIT, socket.CMSG_SPACE(4), socket.MSG_CMSG_CLOEXEC)
    except TimeoutError:
        raise DriverFault(
            f"the guardian has not answered for {ANSWER_S:g} s; sudo systemctl restart robotd-guardian"
        ) from None
    except OSError as error:
        raise DriverFault(f"the guardian hung up: {error.strerror or error}") from error
    finally:
        loop.remove_reader(connection)
    verb, _, text = answer.partition(b" ")
    if verb == LENT and extra:
        return struct.unpack("i", extra[0][2][:4])[0], text.decode(errors="replace")
    if verb == REFUSED:
        raise DriverFault(text.decode(errors="replace"))
    raise DriverFault("the guardian hung up without an answer; sudo journalctl -u robotd-guardian tells why")


class LentLink:
    """An open serial port; see robotd.hardware.SerialLink. The wake line is RTS: asserted is low at TTL level.

    Attributes
    ----------
    remark : str
        What the operator should mend about the port, or "".
    """

    def __init__(self, port: str, fd: int, guardian: socket.socket, remark: str = "") -> None:
        self.port = port
        self.remark = remark
        self._fd = fd
        self._guardian = guardian
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._queue = bytearray()
        self._fault: str | None = None
        self._is_open = True
        self._arrived = asyncio.Event()
        self._pulse: asyncio.TimerHandle | None = None
        self._rest: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Read, and send heartbeats, from now on; needs a running loop."""
        self._loop = asyncio.get_running_loop()
        os.set_blocking(self._fd, False)
        self._sent = self._heard = now()
        self._loop.add_reader(self._fd, self._on_readable)
        self._loop.add_reader(self._guardian, self._on_guardian)
        self._beat_timer = self._loop.call_later(BEAT_S, self._beat)

    async def read(self) -> tuple[float, bytes]:
        """Wait for bytes; returns (loop time at which the last of them arrived, at least one byte)."""
        while not self._chunks:
            self._check()
            self._arrived.clear()
            await self._arrived.wait()
        return self._chunks.popleft()

    def write(self, data: bytes) -> None:
        """Queue bytes for sending; never blocks."""
        self._check()
        if len(self._queue) + len(data) > QUEUE_LIMIT:
            self._fail("takes no more bytes; unplug the adapter and plug it in again")
            self._check()
        was_empty = not self._queue
        self._queue += data
        if was_empty:
            self._send()
            if self._queue:
                self._loop.add_writer(self._fd, self._on_writable)

    def set_baud(self, baud: int) -> None:
        """Change the speed of both directions."""
        self._check()
        try:
            set_rate(self._fd, baud)
        except (ValueError, *GONE) as error:
            self._fail(f"unplugged, or cannot be set to {baud} baud: {error}")
            self._check()

    def pulse_wake(self, seconds: float) -> None:
        """Hold the wake line low for so long, in the background; a port without modem lines ignores it."""
        self._check()
        self._end_pulse()
        try:
            set_wake_line(self._fd, asserted=True)
        except OSError as error:
            log.debug("%s: no wake line: %s", self.port, error)
            return
        self._pulse = self._loop.call_later(seconds, self._end_pulse)

    def rest(self, seconds: float) -> None:
        """Leave bytes with the kernel, which has room for a second of them, for so long; 0 ends that."""
        if self._fault is not None:
            return
        if self._rest is not None:
            self._rest.cancel()
            self._rest = None
        if seconds > 0.0:
            self._loop.remove_reader(self._fd)
            self._rest = self._loop.call_later(seconds, self._end_rest)
        else:
            self._loop.add_reader(self._fd, self._on_readable)

    def _end_rest(self) -> None:
        self.rest(0.0)
        self._on_readable()

    def close(self) -> None:
        """Send what is queued, then give the port back; safe to call twice."""
        if not self._is_open:
            return
        self._is_open = False
        self._end_pulse()
        if self._fault is None:
            if self._queue:
                select.select([], [self._fd], [], CLOSE_WAIT)
                self._send()
            self._fail("closed")
        os.close(self._fd)
        self._guardian.close()

    # ---- the port ----------------------------------------------------------------------------------------------------

    def _on_readable(self) -> None:
        try:
            data = os.read(self._fd, 4096)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._fail(f"unplugged ({error.strerror}); plug the adapter in again")
            return
        if not data:
            self._fail("unplugged; plug the adapter in again")
            return
        self._chunks.append((now(), data))
        self._arrived.set()

    def _on_writable(self) -> None:
        if self._is_in_time():
            self._send()
        if not self._queue:
            self._loop.remove_writer(self._fd)

    def _send(self) -> None:
        try:
            del self._queue[: os.write(self._fd, self._queue)]
        except (BlockingIOError, InterruptedError):
            pass
        except OSError as error:
            self._fail(f"unplugged ({error.strerror}); plug the adapter in again")

    def _end_pulse(self) -> None:
        if self._pulse is None:
            return
        self._pulse.cancel()
        self._pulse = None
        try:
            set_wake_line(self._fd, asserted=False)
        except OSError as error:
            log.debug("%s: the wake line is gone: %s", self.port, error)

    def _fail(self, fault: str) -> None:
        """Stop watching the descriptor, because a vanished device reads as ready for ever, and wake the reader."""
        self._fault = f"{self.port}: {fault}"
        self._queue.clear()
        self._beat_timer.cancel()
        if self._rest is not None:
            self._rest.cancel()
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._loop.remove_reader(self._guardian)
        self._arrived.set()

    def _check(self) -> None:
        if self._fault is None:
            self._is_in_time()
        if self._fault is not None:
            raise DriverFault(self._fault)

    # ---- the guardian ------------------------------------------------------------------------------------------------

    def _beat(self) -> None:
        if not self._is_in_time():
            return
        if now() - self._heard > ECHO_S:
            self._abandoned(f"has not answered for {ECHO_S:g} s")
            return
        try:
            self._guardian.send(BEAT)
        except BlockingIOError:  # it reads nothing; its missing answers tell
            pass
        except OSError:
            self._on_guardian()  # its last words may be there
            return
        self._sent = now()
        self._beat_timer = self._loop.call_later(BEAT_S if self._rest is None else REST_BEAT_S, self._beat)

    def _is_in_time(self) -> bool:
        """Whether the guardian can still take this process for alive; if not the robot is Off, and nothing is sent."""
        late = now() - self._sent
        if late < SILENCE_S:
            return True
        self._fail(
            f"this process hung for {late:.2f} s, so the guardian has halted the robot; a busy computer can be why"
        )
        return False

    def _on_guardian(self) -> None:
        while self._fault is None:
            try:
                message = self._guardian.recv(MESSAGE_LIMIT)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                message = b""
            verb, _, text = message.partition(b" ")
            if verb == BEAT:
                self._heard = now()
            elif verb == ENDED:
                self._fail(f"the guardian has halted the robot: {text.decode(errors='replace')}")
            else:
                self._abandoned("is gone")

    def _abandoned(self, what: str) -> None:
        """Nobody guards the robot any more: halt it from here."""
        self._queue.clear()
        with contextlib.suppress(*GONE):
            termios.tcflush(self._fd, termios.TCOFLUSH)
            os.write(self._fd, HALT * HALTS)
        self._fail(
            f"the guardian {what}, so the robot was halted from here; sudo journalctl -u robotd-guardian tells why"
        )
