"""A serial port to the robot: opened for nobody else, and able to halt the robot whatever was on the line before.

Blocking, and of the standard library and pyserial alone: the guardian is made of it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import struct
import termios
import time
from pathlib import Path
from typing import Any

import serial

from .errors import DriverFault

BY_ID = Path("/dev/serial/by-id")
TTYS = Path("/sys/class/tty")
RATES = (9600, 19200, 38400, 57600, 115200)  # of the Open Interface; at a lower one a halt would take seconds
GONE = (OSError, termios.error)  # what a vanished device raises; SerialException is an OSError
_CODES = {rate: getattr(termios, f"B{rate}") for rate in RATES}
_PTY_MAJORS = range(136, 144)  # Linux, Documentation/admin-guide/devices.txt

# Open Interface 2016. A client that dies leaves a command without its last arguments, and the robot takes the next
# bytes for them. So first four bytes complete every short command. They are mostly zero, because they may be taken for
# speeds (a run of Starts, 0x80, would be full speed backwards); the first is not, because as a baud code zero means
# 300 baud, after which the robot hears nothing. 16 is no baud code, no opcode, no motor that turns and no button that
# starts anything. As the high byte of a speed it asks for 500 mm/s, until the zero velocity that comes 0.8 ms later.
_FILL = bytes((16, 0, 0, 0))
_ZERO_VELOCITY = bytes((145, 0, 0, 0, 0))
_PASSIVE, _OFF = bytes((128,)), bytes((173,))
# Then as many as a song or a list of 255 packets that is incomplete can swallow. Wherever that ends within a zero
# velocity, the rest of it is zeros, which are no opcodes, and the next one counts. Passive is for robots without Stop.
_LONGEST = 1 + 255  # bytes: the count and the list
HALT = _FILL + 4 * _ZERO_VELOCITY + _OFF + (_LONGEST // 5 + 1) * _ZERO_VELOCITY + _PASSIVE + _OFF

MIN_HALTS, MAX_HALTS = 3, 6  # because a byte may be lost, and a robot that changes its baud rate is deaf for 100 ms
SETTLE_S, LISTEN_S = 0.030, 0.030  # until what was under way has arrived; two periods of the robot's stream


def explain(port: str, error: BaseException) -> str:
    """Why a port did not open, and the mend."""
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        found = sorted(str(path) for path in BY_ID.glob("*"))
        there = f"there are {', '.join(found)}" if found else f"{BY_ID} is empty: is the adapter plugged in?"
        return f"{port}: no such port; {there}"
    if number in (errno.EACCES, errno.EPERM):
        return f"{port}: permission denied; add the user to the group dialout: sudo usermod -aG dialout USER"
    if number in (errno.EBUSY, errno.EWOULDBLOCK):
        return f"{port}: in use by another program; stop that first (sudo fuser {port} names it)"
    return f"{port}: cannot be opened as a serial port: {error}"


class Port:
    """A serial port that is open for nobody else: raw, 8N1, the wake line (RTS) released.

    Parameters
    ----------
    name : str
        Path of the device.
    baud : int or None
        None leaves the rate as its last user set it.

    Attributes
    ----------
    remark : str
        What the operator should mend, or "".

    Raises
    ------
    DriverFault
        No such port, in use, not permitted, no serial port; `__cause__` is the system's error.
    """

    def __init__(self, name: str, baud: int | None = None) -> None:
        self.name = name
        try:
            if baud is None:
                baud = _rate_of(name)
            self._device = serial.Serial(timeout=0, exclusive=True, baudrate=baud)
            self._device.port = name
            self._device.rts = False  # because an asserted RTS holds the robot's wake line low
            self._device.open()
        except (ValueError, *GONE) as error:
            raise DriverFault(explain(name, error)) from error
        try:
            fcntl.ioctl(self.fd, termios.TIOCEXCL)  # because exclusive=True stops only those who also ask for it
            self.remark = self._lower_latency()
        except GONE as error:
            self.close()
            raise DriverFault(explain(name, error)) from error

    @property
    def fd(self) -> int:
        """The descriptor."""
        return int(self._device.fileno())

    def _lower_latency(self) -> str:
        """Have received bytes handed on at once; returns what to mend where that fails."""
        why = ""
        try:
            self._device.set_low_latency_mode(True)
        except (ValueError, *GONE) as error:
            why = str(error)
        timer = TTYS / Path(self.name).resolve().name / "device" / "latency_timer"  # FTDI adapters have one
        try:
            milliseconds = int(timer.read_text())
        except (OSError, ValueError):
            if not why or os.major(os.fstat(self.fd).st_rdev) in _PTY_MAJORS:
                return ""
            return f"{self.name}: no low latency ({why}); if sensor frames come late, use an FTDI adapter"
        if milliseconds <= 1:
            return ""
        return (
            f"{self.name}: the adapter holds bytes back for {milliseconds} ms, and the robot sends every 15 ms; "
            "copy 60-robotd.rules to /etc/udev/rules.d, run sudo udevadm control --reload, plug the adapter in again"
        )

    def halt(self) -> bool:
        """Halt the robot and leave it Off; takes 0.3 s at 115200 baud, of which the first pass is 1 ms.

        Returns
        -------
        bool
            Whether the robot has fallen silent. False: it sends on, so it may not have understood.

        Raises
        ------
        DriverFault
            The port takes no bytes.
        """
        try:
            baud = self._reset_line()
            for sent in range(1, MAX_HALTS + 1):
                self._send(HALT, len(HALT) * 10 / baud)
                if not self._hears_something() and sent >= MIN_HALTS:
                    return True
        except GONE as error:
            raise DriverFault(f"{self.name}: the halt cannot be sent ({error}); plug the adapter in again") from error
        return False

    def _reset_line(self) -> int:
        """Discard what is queued and undo what a client may have set, except for the baud rate, which is returned."""
        fd = self.fd
        os.set_blocking(fd, False)
        termios.tcflush(fd, termios.TCOFLUSH)
        settings = termios.tcgetattr(fd)
        settings[:4] = [0, 0, termios.CS8 | termios.CREAD | termios.CLOCAL, 0]
        termios.tcsetattr(fd, termios.TCSANOW, settings)
        termios.tcflow(fd, termios.TCOON)
        with contextlib.suppress(*GONE):  # a pseudo-terminal has no such line
            set_wake_line(fd, asserted=False)
        return _rate(settings)

    def _send(self, data: bytes, seconds: float) -> None:
        """Write all of it and wait until it is out, with a limit: a port that is stuck must not stop the guardian."""
        end = time.monotonic() + 2.0 * seconds + 0.1
        rest = memoryview(data)
        while rest and (left := end - time.monotonic()) > 0.0:
            select.select([], [self.fd], [], left)
            with contextlib.suppress(BlockingIOError):
                rest = rest[os.write(self.fd, rest) :]
        while (queued := _queued(self.fd)) and time.monotonic() < end:
            time.sleep(0.002)
        if rest or queued:
            raise OSError(errno.ETIMEDOUT, "the port takes no bytes")

    def _hears_something(self) -> bool:
        time.sleep(SETTLE_S)
        termios.tcflush(self.fd, termios.TCIFLUSH)
        return bool(select.select([self.fd], [], [], LISTEN_S)[0])

    def close(self) -> None:
        """Release the port; what has not gone out is discarded, because the kernel would wait for it for 30 s."""
        with contextlib.suppress(*GONE):
            fcntl.ioctl(self.fd, termios.TIOCNXCL)  # because a descriptor that is open elsewhere would keep it
            termios.tcflush(self.fd, termios.TCOFLUSH)
        with contextlib.suppress(*GONE):
            self._device.close()


def set_rate(fd: int, baud: int) -> None:
    """Set the speed of both directions; raises ValueError for one that is not in RATES, and what is in GONE."""
    if baud not in _CODES:
        raise ValueError(f"expected one of {', '.join(map(str, RATES))}")
    settings = termios.tcgetattr(fd)
    settings[4:6] = [_CODES[baud]] * 2
    termios.tcsetattr(fd, termios.TCSANOW, settings)


def set_wake_line(fd: int, *, asserted: bool) -> None:
    """RTS, which holds the robot's wake line low while it is asserted; raises OSError where there is no such line."""
    fcntl.ioctl(fd, termios.TIOCMBIS if asserted else termios.TIOCMBIC, struct.pack("I", termios.TIOCM_RTS))


def _rate(settings: list[Any]) -> int:
    return next((rate for rate, code in _CODES.items() if code == settings[5]), RATES[-1])


def _rate_of(name: str) -> int:
    fd = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        return _rate(termios.tcgetattr(fd))
    finally:
        os.close(fd)


def _queued(fd: int) -> int:
    """Bytes that the kernel still has to send."""
    return int(struct.unpack("i", fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)))[0])
