"""Tell systemd how the service fares (sd_notify); without systemd nothing happens."""

from __future__ import annotations

import os
import select
import socket
from collections.abc import Callable


def notify(state: str) -> bool:
    """Send lines such as "READY=1", "STATUS=driving to stop 3", "WATCHDOG=1" or "STOPPING=1" to the service manager.

    Never waits: the control loop calls this, and a manager that is too busy to read must not hold it.

    Returns
    -------
    bool
        Whether it was delivered: False when nobody asked (no NOTIFY_SOCKET), nobody listens there any more, or ten
        messages wait there already (net.unix.max_dgram_qlen).
    """
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return False
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as channel:
            channel.connect("\0" + address[1:] if address.startswith("@") else address)  # @: abstract name space
            return _sender(channel)(state)
    except OSError:  # a stale address; systemd-python raises on it too
        return False


def watchdog_s() -> float | None:
    """Seconds between "WATCHDOG=1" lines that keep systemd content, or None if it does not watch this process."""
    micros, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", str(os.getpid()))
    if not micros.isdigit() or process != str(os.getpid()):
        return None
    return int(micros) / 1e6 / 3 or None


def _sender(channel: socket.socket) -> Callable[[str], bool]:
    try:
        from systemd.daemon import notify as send
    except ImportError:
        return lambda state: channel.send(state.encode()) > 0
    room = select.poll()  # systemd-python would wait for room
    room.register(channel, select.POLLOUT)
    return lambda state: bool(room.poll(0) and send(state))
