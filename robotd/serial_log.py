"""Recordings of the serial line to the base, as text that diffs well: what a field bug needs to become a test.

    # robotd-serial/1
    # date "2026-03-02T07:30:00+00:00"
    # base {"driver": "roomba", "baud": 115200, ...}
    0.000000 open /dev/serial/by-id/usb-FTDI... 115200
    0.000100 > 8080808080
    0.115300 < 13220700...
    0.200000 baud 19200
    1.300000 wake 1
    2.015000 wish 0.2 0.05 2.014 1.975 follower
    2.500000 withdraw 2.5 follower line lost: not seen for 0.3 m
    9.000000 break unplugged (Input/output error); plug the adapter in again
    9.000100 close

Lines that start with # are the head: a name and a JSON value each. The others are one occurrence each: seconds of loop
time since the first of them, what it was, and more: bytes that arrived (<) or were sent (>) in hexadecimal, what
DriverFault ended a read (break) or opening (refused), wishes to move (speed, turn rate, time of the wish; for one that
follows a line also when that was seen; source) and withdrawals. `lost N` stands for lines that the disk was too slow
for.

Nothing here blocks the event loop: lines are collected and written by a thread once a second. When the file has reached
half of its limit it becomes PATH.1, replacing the one before, and a new one is begun, so that a card does not fill.
"""

from __future__ import annotations

import asyncio
import json
import logging
import queue
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from .bus import Bus
from .clock import now, outside
from .errors import DriverFault, InputError
from .hardware import CameraMode, CameraSource, Hardware, SerialLink, Ticker

log = logging.getLogger(__name__)

FORMAT = "robotd-serial/1"
KINDS = ("open", "refused", "close", "break", "<", ">", "baud", "wake", "wish", "withdraw", "lost")
FLUSH_S = 1.0
WAITING = 1 << 20  # characters in a second, at most
BEHIND = 8  # seconds that wait for the disk, at most


class SerialLog:
    """Writes one recording.

    Parameters
    ----------
    path : Path
        Written from the first occurrence on; a recording that is there becomes PATH.1.
    limit : int
        Bytes that both files together may take.
    head : mapping of str to JSON values
        Whatever is needed to play it back.
    """

    def __init__(self, path: Path, limit: int, head: Mapping[str, Any]) -> None:
        self.path = path
        self.limit = limit
        self.head = dict(head)
        self.fault: str | None = None
        self._start: float | None = None
        self._lines: list[str] = []
        self._size = self._lost = 0
        self._timer: asyncio.TimerHandle | None = None
        self._texts: queue.SimpleQueue[str] = queue.SimpleQueue()  # to be written, in this order
        self._lock = threading.Lock()  # held by the thread that writes
        self._is_begun = False

    def add(self, t: float, kind: str, *fields: object) -> None:
        """Note an occurrence at loop time `t`; never blocks."""
        if self.fault is not None:
            return
        if self._start is None:
            self._start = t
            self.head["loop_time"] = round(t, 6)
        line = f"{t - self._start:.6f} {kind} {' '.join(map(str, fields))}".rstrip() + "\n"
        if self._size + len(line) > WAITING or self._texts.qsize() > BEHIND:
            self._lost += 1
            return
        if self._lost:
            line = f"{t - self._start:.6f} lost {self._lost}\n{line}"
            self._lost = 0
        self._lines.append(line)
        self._size += len(line)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(FLUSH_S, self.flush)

    async def follow(self, bus: Bus) -> None:
        """Note wishes to move and withdrawals until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._follow_wishes(bus))
            group.create_task(self._follow_withdrawals(bus))

    async def _follow_wishes(self, bus: Bus) -> None:
        with bus.commands.subscribe() as wishes:
            async for wish in wishes:
                seen = () if wish.line_t is None else (self._relative(wish.line_t),)
                self.add(
                    now(), "wish", f"{wish.speed:.6g} {wish.turn_rate:.6g}", self._relative(wish.t), *seen, wish.source
                )

    async def _follow_withdrawals(self, bus: Bus) -> None:
        with bus.withdrawals.subscribe() as withdrawals:
            async for item in withdrawals:
                self.add(now(), "withdraw", self._relative(item.t), item.source or "operator", item.cause)

    def _relative(self, t: float) -> float:
        return round(t - (t if self._start is None else self._start), 6)

    def flush(self) -> None:
        """Have what has been noted written, by a thread of the running loop."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._lines:
            self._texts.put("".join(self._lines))
            self._lines.clear()
            self._size = 0
            holding = ExitStack()
            holding.enter_context(outside())
            writing = asyncio.get_running_loop().run_in_executor(None, self._write)
            writing.add_done_callback(lambda _: holding.close())

    def _write(self) -> None:
        with self._lock:
            while not self._texts.empty() and self.fault is None:
                try:
                    self._append(self._texts.get())
                except OSError as error:
                    self.fault = f"{self.path}: {error.strerror or error}"
                    log.warning("the serial line is not recorded any more: %s", self.fault)

    def _append(self, text: str) -> None:
        if not self._is_begun or self.path.stat().st_size + len(text) > self.limit // 2:
            if self.path.exists():
                self.path.replace(self.path.with_name(self.path.name + ".1"))
            text = "".join(f"{f'# {name} {value}'.rstrip()}\n" for name, value in self._head_lines()) + text
        with self.path.open("a", encoding="utf-8") as file:
            file.write(text)
        self._is_begun = True

    def _head_lines(self) -> Iterator[tuple[str, str]]:
        yield FORMAT, ""
        for name, value in ({"continued": True} | self.head if self._is_begun else self.head).items():
            yield name, json.dumps(value)


class LoggedLink:
    """A serial link whose every byte is noted; see robotd.hardware.SerialLink."""

    def __init__(self, link: SerialLink, serial_log: SerialLog) -> None:
        self._link = link
        self._log = serial_log
        self._is_closed = False

    async def read(self) -> tuple[float, bytes]:
        """Wait for bytes; they are noted at the time of their arrival."""
        try:
            t, data = await self._link.read()
        except DriverFault as fault:
            self._log.add(now(), "break", _one_line(fault))
            raise
        self._log.add(t, "<", data.hex())
        return t, data

    def write(self, data: bytes) -> None:
        """Queue bytes for sending."""
        self._log.add(now(), ">", data.hex())
        self._link.write(data)

    def set_baud(self, baud: int) -> None:
        """Change the speed of both directions."""
        self._log.add(now(), "baud", baud)
        self._link.set_baud(baud)

    def pulse_wake(self, seconds: float) -> None:
        """Hold the wake line low for so long."""
        self._log.add(now(), "wake", f"{seconds:g}")
        self._link.pulse_wake(seconds)

    def rest(self, seconds: float) -> None:
        """Let bytes gather."""
        self._link.rest(seconds)

    def close(self) -> None:
        """Release the device, and have the recording written."""
        self._link.close()
        if not self._is_closed:
            self._is_closed = True
            self._log.add(now(), "close")
            self._log.flush()


class LoggedHardware:
    """Any Hardware, with the line at one serial port recorded; see robotd.hardware.Hardware."""

    def __init__(self, hardware: Hardware, port: str, serial_log: SerialLog) -> None:
        self._hardware = hardware
        self._port = port
        self._log = serial_log

    @property
    def pins(self) -> Any:
        """Those of the hardware."""
        return self._hardware.pins

    def ticker(self, period: float, function: Callable[[int], None]) -> Ticker:
        """That of the hardware."""
        return self._hardware.ticker(period, function)

    async def open_serial(self, port: str, baud: int) -> SerialLink:
        """Open a serial port; what goes over the one is noted."""
        if port != self._port:
            return await self._hardware.open_serial(port, baud)
        begun = now()
        self._log.head.setdefault("date", self._hardware.utc().isoformat(timespec="seconds"))
        try:
            link = await self._hardware.open_serial(port, baud)
        except DriverFault as fault:
            self._log.add(begun, "refused", _one_line(fault))
            raise
        self._log.add(now(), "open", port, baud)
        return LoggedLink(link, self._log)

    async def open_camera(self, device: str, name: str, mode: CameraMode) -> CameraSource:
        """Open and start a camera."""
        return await self._hardware.open_camera(device, name, mode)

    def utc(self) -> datetime:
        """The date."""
        return self._hardware.utc()

    def boot_id(self) -> str:
        """Names this start of the computer."""
        return self._hardware.boot_id()

    def is_synchronised(self) -> bool:
        """Whether the date is known to be right."""
        return self._hardware.is_synchronised()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


# ---- reading ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Occurrence:
    """One line of a recording: seconds since its start, one of KINDS, and what follows it."""

    t: float
    kind: str
    text: str = ""

    @property
    def data(self) -> bytes:
        """Of a line with bytes."""
        return bytes.fromhex(self.text)


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole recording: the head's values, and what occurred, in the order of time."""

    head: dict[str, Any]
    occurrences: tuple[Occurrence, ...]


def read_serial_log(path: Path) -> Recording:
    """Read a recording; a last line that was cut off is left out.

    Raises
    ------
    InputError
        No such file, another format, or lines that are none of a recording: names the first ones.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    lines = text.split("\n")[:-1]
    if not lines or lines[0].rstrip() != f"# {FORMAT}":
        raise InputError(f"{path}: not a recording of a serial line; expected '# {FORMAT}' in its first line")
    head: dict[str, Any] = {}
    occurrences = []
    problems = []
    for number, line in enumerate(lines[1:], 2):
        try:
            if line.startswith("#"):
                name, _, value = line[1:].strip().partition(" ")
                head[name] = json.loads(value)
            else:
                occurrences.append(_occurrence(line))
        except ValueError as error:
            problems.append(f"{path}:{number}: {error}")
    if problems:
        raise InputError(*problems[:10])
    return Recording(head, tuple(sorted(occurrences, key=lambda item: item.t)))


def _occurrence(line: str) -> Occurrence:
    time, _, rest = line.partition(" ")
    kind, _, text = rest.partition(" ")
    if kind not in KINDS:
        raise ValueError(f"found {kind!r}; expected one of {' '.join(KINDS)}")
    found = Occurrence(float(time), kind, text)
    if kind in "<>":
        _ = found.data
    return found
