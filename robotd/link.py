"""A real serial line on the event loop: pyserial opens and configures the port, the loop reads its descriptor."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import logging
import os
import select
import termios
from collections import deque
from pathlib import Path

import serial

from .errors import DriverFault
from .hardware import SerialLink

log = logging.getLogger(__name__)

BY_ID = Path("/dev/serial/by-id")
QUEUE_LIMIT = 4096  # bytes: more than that waiting means that the device takes none
CLOSE_WAIT = 0.05  # s for what is still queued when the line is closed
_GONE = (OSError, termios.error)  # what pyserial lets through when a device vanishes; SerialException is an OSError


async def open_serial(port: str, baud: int) -> SerialLink:
    """Open a serial port, 8N1, for this process alone.

    Parameters
    ----------
    port : str
        Best one of /dev/serial/by-id/, because those names survive replugging.
    baud : int
        Bits per second.

    Raises
    ------
    DriverFault
        No such port (names those that exist), no permission (names the group), in use, or not a serial port.
    """
    device = serial.Serial(baudrate=baud, timeout=0, exclusive=True)
    device.port = port
    device.rts = False  # because an asserted RTS holds the robot's wake line low
    try:
        device.open()
        fcntl.ioctl(device.fileno(), termios.TIOCEXCL)  # because exclusive=True stops only those who also ask for it
    except _GONE as error:
        device.close()
        raise DriverFault(_explain(port, error)) from error
    try:
        device.set_low_latency_mode(True)
    except (ValueError, *_GONE) as error:
        log.debug("%s: no low-latency mode: %s", port, error)
    link = PySerialLink(port, device)
    link.start()
    return link


def _explain(port: str, error: BaseException) -> str:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT:
        found = sorted(str(path) for path in BY_ID.glob("*"))
        there = f"there are {', '.join(found)}" if found else f"{BY_ID} is empty: is the adapter plugged in?"
        return f"{port}: no such port; {there}"
    if number in (errno.EACCES, errno.EPERM):
        return f"{port}: permission denied; add the user to the group dialout: sudo usermod -aG dialout USER"
    if number in (errno.EBUSY, errno.EWOULDBLOCK):
        return f"{port}: in use by another program; stop that first (sudo fuser {port} names it)"
    return f"{port}: cannot be opened as a serial port: {error}"


class PySerialLink:
    """An open serial port; see robotd.hardware.SerialLink. The wake line is RTS: asserted is low at TTL level."""

    def __init__(self, port: str, device: serial.Serial) -> None:
        self.port = port
        self._device = device
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._queue = bytearray()
        self._fault: str | None = None
        self._arrived = asyncio.Event()
        self._pulse: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Read from now on; needs a running loop."""
        self._loop = asyncio.get_running_loop()
        self._fd = self._device.fileno()
        os.set_blocking(self._fd, False)
        self._loop.add_reader(self._fd, self._on_readable)

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
            self._device.baudrate = baud
        except (ValueError, *_GONE) as error:
            self._fail(f"cannot be set to {baud} baud: {error}")
            self._check()

    def pulse_wake(self, seconds: float) -> None:
        """Hold the wake line low for so long, in the background; a port without modem lines ignores it."""
        self._check()
        self._end_pulse()
        try:
            self._device.rts = True
        except _GONE as error:
            log.debug("%s: no wake line: %s", self.port, error)
            return
        self._pulse = self._loop.call_later(seconds, self._end_pulse)

    def close(self) -> None:
        """Send what is queued, then release the port; safe to call twice."""
        if not self._device.is_open:
            return
        self._end_pulse()
        if self._fault is None:
            if self._queue:
                select.select([], [self._fd], [], CLOSE_WAIT)
                self._send()
            self._fail("closed")
        self._device.close()  # the kernel waits until the bytes are out, but not for ever as tcdrain would

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
        self._chunks.append((self._loop.time(), data))
        self._arrived.set()

    def _on_writable(self) -> None:
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
            self._device.rts = False
        except _GONE as error:
            log.debug("%s: the wake line is gone: %s", self.port, error)

    def _fail(self, fault: str) -> None:
        """Stop watching the descriptor, because a vanished device reads as ready for ever, and wake the reader."""
        self._fault = f"{self.port}: {fault}"
        self._queue.clear()
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._arrived.set()

    def _check(self) -> None:
        if self._fault is not None:
            raise DriverFault(self._fault)
