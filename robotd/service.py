"""robotd as a service: its line in `systemctl status`, its log in the journal with fields."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import sys
from collections.abc import Callable, Sequence

from .clock import ticks
from .notify import notify
from .records import MissionStatus

JOURNAL = "/run/systemd/journal/socket"
TELL_S = 2.0
LINE_LIMIT = 300  # characters of the status line
PRIORITIES = {logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6}  # syslog(3)


def describe(status: MissionStatus | None, faults: Sequence[str], held: str | None, trouble: str | None) -> str:
    """One line about the robot: what its mission does, what is broken, what holds it, and why nothing is uploaded."""
    parts = ["idle"]
    if status is not None and status.state not in ("idle", "done"):
        parts = [status.state + (f" at stop {status.stop} of {status.stops}" if status.stops else "")]
        if status.text:
            parts[0] += f": {status.text}"
    parts += faults
    if held is not None:
        parts.append(f"held: {held}")
    if trouble is not None:
        parts.append(f"upload: {trouble}")
    return "; ".join(parts).replace("\n", " ")[:LINE_LIMIT]


async def tell_manager(line: Callable[[], str]) -> None:
    """Keep the line that `systemctl status` shows up to date, until cancelled."""
    told = ""
    async for _ in ticks(TELL_S):
        if (text := line()) != told:
            told = text
            notify(f"STATUS={text}")


class JournalHandler(logging.Handler):
    """Sends records to systemd's journal, with the fields that they carry (`extra={"fields": {...}}`).

    In journald's own protocol (https://systemd.io/JOURNAL_NATIVE_PROTOCOL); what it does not take goes to standard
    error.
    """

    def __init__(self, address: str = JOURNAL) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(message)s"))  # basicConfig gives its own to handlers that have none
        self._address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        text = self.format(record)
        fields = {
            "MESSAGE": text,
            "PRIORITY": str(PRIORITIES.get(record.levelno, 7)),
            "SYSLOG_IDENTIFIER": "robotd",
            "LOGGER": record.name,
            **getattr(record, "fields", {}),
        }
        try:
            self._socket.sendto(b"".join(_field(name, value) for name, value in fields.items()), self._address)
        except OSError:
            print(text, file=sys.stderr)

    def close(self) -> None:
        """Release the socket."""
        self._socket.close()
        super().close()


def log_handler() -> logging.Handler:
    """The journal where standard error leads there (JOURNAL_STREAM of systemd.exec(5)), elsewhere standard error."""
    with contextlib.suppress(OSError, ValueError):
        here = os.fstat(sys.stderr.fileno())
        if os.environ.get("JOURNAL_STREAM") == f"{here.st_dev}:{here.st_ino}":
            return JournalHandler()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    return handler


def _field(name: str, value: object) -> bytes:
    data = str(value).encode(errors="replace")
    if b"\n" not in data:
        return name.encode() + b"=" + data + b"\n"
    return name.encode() + b"\n" + struct.pack("<Q", len(data)) + data + b"\n"
