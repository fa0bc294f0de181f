"""Tell systemd how the service fares (sd_notify); without systemd nothing happens."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable


def notify(state: str) -> bool:
    """Send lines such as "READY=1", "STATUS=driving to stop 3", "WATCHDOG=1" or "STOPPING=1" to the service manager.

    Returns
    -------
    bool
        Whether it was delivered: False when nobody asked (no NOTIFY_SOCKET) or nobody listens there any more.
    """
    try:
        return _sender()(state)
    except OSError:  # a stale address; systemd-python raises on it too
        return False


def watchdog_s() -> float | None:
    """Seconds between "WATCHDOG=1" lines that keep systemd content, or None if it does not watch this process."""
    micros, process = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", str(os.getpid()))
    if not micros.isdigit() or process != str(os.getpid()):
        return None
    return int(micros) / 1e6 / 3 or None


def _sender() -> Callable[[str], bool]:
    try:
        from systemd.daemon import notify as send
    except ImportError:
        return _send
    return lambda state: bool(send(state))


def _send(state: str) -> bool:
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return False
    if address.startswith("@"):  # Linux's abstract name space
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
        channel.connect(address)
        channel.sendall(state.encode())
    return True
