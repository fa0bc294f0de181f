"""robotd-guardian: owns the robot's serial port, lends it to the daemon, and halts the robot when that dies or hangs.

The robot obeys its last drive command for ever, so a process that cannot be hurt by the daemon's death must end the
drive. It opens the port and passes the open descriptor over a Unix socket (SCM_RIGHTS), so that no byte between daemon
and robot goes through this process. Each message is one packet of a SOCK_SEQPACKET connection:

    client      open 115200 /dev/serial/by-id/...     first, within a second
    guardian    lent [remark]                         with the descriptor; or: refused <why>, and hangs up
    client      beat                                  every 50 ms, from the loop that drives
    guardian    beat                                  to each, so that the client knows that it is guarded
    guardian    ended <why>                           the loan is over: write nothing more; then hangs up

A loan ends when the connection closes (also in good order: halting twice harms nobody), when no heartbeat comes for
250 ms, on any other message, when the port is unplugged, and at SIGTERM. Then queued output is discarded and `HALT` is
sent until the robot falls silent. It is Off after that: whatever a client that wakes up later still writes, the robot
ignores. Such a client also keeps the port's lock until it has closed its descriptor; until then nobody else gets the
port, because two programs must never write to one robot.

One client at a time borrows; others are refused, with the name of the process that has the port. Which port is lent
stands in a file beside the socket as long as the robot is not halted for certain: a guardian that was killed halts it
when the service manager has started it again, and an adapter that was pulled out and has a lasting name
(/dev/serial/by-id) when it is back. Nothing else is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import resource
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from .errors import DriverFault
from .serial_port import BY_ID, RATES, Port

SOCKET = Path("/run/robotd-guardian/guardian.sock")
BEAT_S = 0.050
SILENCE_S = 0.250  # without a heartbeat for so long the robot is halted
OPEN, LENT, REFUSED, BEAT, ENDED = b"open", b"lent", b"refused", b"beat", b"ended"
MESSAGE_LIMIT = 4096  # bytes
FLOOD = 100  # messages in a row from one client, before others are heard
ASK_S = 1.0  # for a client to say what it wants
WAITING_LIMIT = 8  # clients that have not said it
RETRY_S = 0.2  # between attempts to halt a robot whose port is away or held by a stopped process
BUSY_S = 1.5  # for a guardian of the same user's loan before, which may still be halting the robot, to release the port


class Client:
    """A connection that does not block; `heard` is when it last said something, `port` what it has borrowed."""

    # no dataclass, because that module brings 1.5 MB

    def __init__(self, connection: socket.socket, who: str, heard: float) -> None:
        self.connection = connection
        self.who = who
        self.heard = heard
        self.port: Port | None = None

    def tell(self, *words: bytes | str, fd: int | None = None) -> None:
        """Send one message; a client that does not take it is found out by its silence."""
        message = b" ".join(word if isinstance(word, bytes) else word.encode() for word in words)
        with contextlib.suppress(OSError):
            if fd is None:
                self.connection.send(message)
            else:
                socket.send_fds(self.connection, [message], [fd])


class Guardian:
    """Serves clients until it is told to stop, or with `only` until that one client is gone and the robot is halted.

    Parameters
    ----------
    listener : socket or None
        A listening SOCK_SEQPACKET socket.
    only : socket or None
        Instead: one connected client.
    note : Path or None
        Where the name of the lent port is kept.
    """

    def __init__(
        self, listener: socket.socket | None = None, only: socket.socket | None = None, note: Path | None = None
    ) -> None:
        self._listener = listener
        self._note = note
        self._clients: dict[int, Client] = {}
        self._borrower: Client | None = None
        self._owed = _read_note(note)  # the port of a robot that is still to be halted
        self._retry = time.monotonic()
        self._stop, self._wake = socket.socketpair()
        self._poll = select.poll()
        self._is_told = False
        for channel in (self._stop, self._wake):
            channel.setblocking(False)
        self._poll.register(self._stop, select.POLLIN)
        if listener is not None:
            listener.setblocking(False)
            self._poll.register(listener, select.POLLIN)
        if only is not None:
            self._admit(only)

    def stop(self) -> None:
        """End `serve`, also from a signal handler or another thread."""
        self._is_told = True
        with contextlib.suppress(OSError):
            self._wake.send(b"\0")

    def serve(self) -> None:
        """Until told to stop; the robot is halted on every way out."""
        interval = _watchdog_s()
        fed = time.monotonic()
        _notify("READY=1\nSTATUS=nobody has the port")
        try:
            while not self._is_told and (self._listener is not None or self._clients):
                ready = dict(self._poll.poll(self._patience()))
                self._hear_borrower(ready)
                self._expire()
                for number in [number for number in ready if number in self._clients]:
                    self._hear_newcomer(self._clients[number])
                if self._listener is not None and self._listener.fileno() in ready:
                    self._accept(self._listener)
                self._halt_owed()
                if interval is not None and time.monotonic() - fed >= interval:
                    fed = time.monotonic()
                    _notify("WATCHDOG=1")
        finally:
            self._end("the guardian was stopped")
            for client in list(self._clients.values()):
                self._dismiss(client, REFUSED, "the guardian was stopped")
            self._stop.close()
            self._wake.close()

    def _patience(self) -> float:
        """Milliseconds until something is due."""
        now = time.monotonic()
        due = [now + ASK_S] + [client.heard + ASK_S for client in self._clients.values() if client.port is None]
        if self._borrower is not None:
            due.append(self._borrower.heard + SILENCE_S)
        elif self._owed is not None:
            due.append(self._retry)
        return max(0.0, 1e3 * (min(due) - now) + 1.0)

    # ---- connections -------------------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket) -> None:
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        client = self._admit(connection)
        if len(self._clients) > WAITING_LIMIT + 1:
            self._dismiss(client, REFUSED, f"more than {WAITING_LIMIT} programs ask at once; try again")

    def _admit(self, connection: socket.socket) -> Client:
        connection.setblocking(False)
        process, user, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        client = Client(connection, f"process {process} of user {user}", time.monotonic())
        self._clients[connection.fileno()] = client
        self._poll.register(connection, select.POLLIN)
        return client

    def _dismiss(self, client: Client, *words: bytes | str) -> None:
        if words:
            client.tell(*words)
        del self._clients[client.connection.fileno()]
        self._poll.unregister(client.connection)
        client.connection.close()

    def _hear_newcomer(self, client: Client) -> None:
        if client.port is not None:
            return
        message = next(_messages(client.connection), None)
        if message is None:
            return
        if not message:
            self._dismiss(client)
            return
        try:
            name, baud = _parse(message)
            self._lend(client, name, baud)
        except DriverFault as fault:
            _say(f"refused {client.who}: {fault}")
            self._dismiss(client, REFUSED, str(fault))

    def _hear_borrower(self, ready: dict[int, int]) -> None:
        """Take its heartbeats, all that wait, because this process may be late itself."""
        client = self._borrower
        if client is None or client.port is None:
            return
        if ready.get(client.port.fd, 0) & (select.POLLHUP | select.POLLERR | select.POLLNVAL):
            self._end(f"{client.port.name}: unplugged; plug the adapter in again")
            return
        for message in islice(_messages(client.connection), FLOOD):
            if message != BEAT:
                self._end(f"found {_quote(message)}, expected 'beat'" if message else "the client hung up")
                return
            client.heard = time.monotonic()
            client.tell(BEAT)

    def _expire(self) -> None:
        now = time.monotonic()
        for client in list(self._clients.values()):
            if client.port is None and now - client.heard >= ASK_S:
                self._dismiss(client, REFUSED, f"nothing was asked for {ASK_S:g} s")
            elif client.port is not None and now - client.heard >= SILENCE_S and not _has_more(client.connection):
                self._end(f"no heartbeat for {SILENCE_S:g} s, so the daemon hangs or the computer is too busy")

    # ---- the port ----------------------------------------------------------------------------------------------------

    def _lend(self, client: Client, name: str, baud: int) -> None:
        if self._borrower is not None and self._borrower.port is not None:
            raise DriverFault(f"{self._borrower.port.name}: in use by {self._borrower.who}; stop that first")
        port = Port(name, baud) if self._listener is not None else _when_free(name, baud)
        self._owe(name)
        client.port, client.heard = port, time.monotonic()
        self._borrower = client
        self._poll.register(port.fd, 0)  # hang-ups and errors alone: the client reads the bytes
        client.tell(LENT, port.remark, fd=port.fd)
        _say(f"lent {name} at {baud} baud to {client.who}")
        _notify(f"STATUS={name} is lent to {client.who}")

    def _end(self, why: str) -> None:
        """End the loan: tell the client to write no more, which costs microseconds, and halt the robot."""
        client = self._borrower
        if client is None or client.port is None:
            return
        port = client.port
        client.tell(ENDED, why)
        try:
            how = "halted the robot" if port.halt() else "sent the halt, but the robot still talks: watch it"
            self._owe(None)
        except DriverFault as fault:
            how = f"could not halt the robot: {fault}"
            if not _is_lasting(port.name):
                self._owe(None)
        self._poll.unregister(port.fd)
        port.close()
        self._borrower = None
        self._dismiss(client)
        _say(f"{how}; the loan of {port.name} to {client.who} is over: {why}")
        _notify("STATUS=nobody has the port")

    def _halt_owed(self) -> None:
        """Halt a robot that a guardian before this one left behind, or whose adapter was unplugged."""
        if self._owed is None or self._borrower is not None or time.monotonic() < self._retry:
            return
        try:
            port = Port(self._owed)
            try:
                port.halt()
            finally:
                port.close()
            _say(f"halted the robot on {self._owed}, which was left behind")
        except DriverFault as fault:
            if _is_held(fault) or _is_lasting(self._owed):
                self._retry = time.monotonic() + RETRY_S
                return
            _say(f"the robot on {self._owed} cannot be halted: {fault}")
        self._owe(None)

    def _owe(self, name: str | None) -> None:
        self._owed = name
        if self._note is not None:
            with contextlib.suppress(OSError):  # a full disk must not stop a robot from being halted
                if name is None:
                    self._note.unlink(missing_ok=True)
                else:
                    self._note.write_text(name)


def _messages(connection: socket.socket) -> Iterator[bytes]:
    """What has arrived, message by message; b"" at the end of the connection."""
    while True:
        try:
            message = connection.recv(MESSAGE_LIMIT)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            message = b""
        yield message
        if not message:
            return


def _has_more(connection: socket.socket) -> bool:
    """Whether a message waits, or the end of the connection: this process may have been held up since it looked."""
    return bool(select.select([connection], [], [], 0)[0])


def _parse(message: bytes) -> tuple[str, int]:
    """Port and baud rate of "open BAUD PORT"; raises DriverFault."""
    verb, _, rest = message.partition(b" ")
    baud, _, name = rest.partition(b" ")
    if verb != OPEN or not name:
        raise DriverFault(f"found {_quote(message)}; expected 'open BAUD PORT'")
    if baud.decode(errors="replace") not in map(str, RATES):
        raise DriverFault(f"found {_quote(baud)} baud; expected one of {', '.join(map(str, RATES))}")
    try:
        port = name.decode()
    except UnicodeDecodeError:
        raise DriverFault(f"found port {_quote(name)}; expected UTF-8") from None
    if not port.startswith("/") or not port.isprintable():
        raise DriverFault(f"found port {_quote(name)}; expected a whole path such as {BY_ID}/usb-...")
    return port, int(baud)


def _quote(message: bytes) -> str:
    text = message.decode(errors="replace")
    return repr(text if len(text) <= 60 else text[:57] + "...")


def _read_note(note: Path | None) -> str | None:
    """The port that was lent when the last guardian died."""
    try:
        name = note.read_text() if note is not None else ""
    except (OSError, UnicodeDecodeError):
        return None
    return name if name.startswith("/") and name.isprintable() else None


def _when_free(name: str, baud: int) -> Port:
    end = time.monotonic() + BUSY_S
    while True:
        try:
            return Port(name, baud)
        except DriverFault as fault:
            if not _is_held(fault) or time.monotonic() >= end:
                raise
        time.sleep(0.05)


def _is_held(fault: DriverFault) -> bool:
    """Whether a port did not open because somebody else has it."""
    return getattr(fault.__cause__, "errno", None) in (errno.EBUSY, errno.EWOULDBLOCK)


def _is_lasting(name: str) -> bool:
    """Whether the name means the same adapter after replugging; /dev/ttyUSB0 may be another device then."""
    return name.startswith("/dev/serial/")


def _say(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # whoever reads this may be gone; the robot comes first
        print(f"robotd-guardian: {text}", file=sys.stderr, flush=True)


def _notify(state: str) -> None:
    """Tell systemd (sd_notify); as robotd.notify, which this process does not load."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
        channel.setblocking(False)
        channel.connect("\0" + address[1:] if address.startswith("@") else address)
        channel.send(state.encode())


def _watchdog_s() -> float | None:
    micros = os.environ.get("WATCHDOG_USEC", "")
    return int(micros) / 1e6 / 3 if micros.isdigit() else None


def _lock_memory() -> None:
    """Keep this process's pages in memory where that is allowed without a limit: it is needed when memory is short."""
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return
    import ctypes

    current, future, on_fault = 1, 2, 4  # MCL_..., asm-generic/mman.h
    ctypes.CDLL(None).mlockall(current | future | on_fault)


def _listen(path: Path) -> socket.socket:
    """The service's socket, for its group; raises OSError."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with contextlib.suppress(FileNotFoundError):
        try:
            listener.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()  # left by one that was killed
        else:
            listener.close()
            raise OSError(errno.EADDRINUSE, "another guardian listens there")
    before = os.umask(0o117)  # read and write for user and group
    try:
        listener.bind(str(path))
    finally:
        os.umask(before)
    listener.listen()
    return listener


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="robotd-guardian", description="Own the robot's port, lend it to robotd, halt the robot when that dies."
    )
    parser.add_argument("--socket", type=Path, default=SOCKET, help=f"where to listen (default: {SOCKET})")
    parser.add_argument("--fd", type=int, help="instead: serve this one inherited connection, detached, then exit")
    options = parser.parse_args(argv)
    try:
        if options.fd is not None:
            only = socket.socket(fileno=options.fd)
            if os.fork():  # so that nobody has to wait for this process, which outlives its client
                os._exit(0)
            os.chdir("/")
            guardian = Guardian(only=only)
        else:
            guardian = Guardian(_listen(options.socket), note=options.socket.with_suffix(".lent"))
    except OSError as error:
        print(f"robotd-guardian: {options.socket}: {error.strerror or error}", file=sys.stderr)
        return 1
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: guardian.stop())
    _lock_memory()
    guardian.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
