"""The serial line to a simulated Roomba, in loop time: transmission times, baud rates, noise and a cable to pull."""

from __future__ import annotations

import asyncio
import math
from collections import deque

import numpy as np

from ..errors import DriverFault
from ..oi import TICK
from .quirks import LineFaults
from .roomba import SimRoomba


class Power:
    """Ticks a robot on the running loop, whether or not somebody is connected: a robot left alone moves on."""

    def __init__(self, roomba: SimRoomba) -> None:
        self._roomba = roomba
        self._loop = asyncio.get_running_loop()
        self._start = self._loop.time()
        self._ticks = 0
        self._on_tick()

    def stop(self) -> None:
        """No more ticks."""
        self._timer.cancel()

    def _on_tick(self) -> None:
        t = self._start + self._ticks * TICK
        data = self._roomba.tick(t)
        if data and self._roomba.link is not None:
            self._roomba.link.deliver(t, data)
        self._ticks += 1
        self._timer = self._loop.call_at(self._start + self._ticks * TICK, self._on_tick)


class RoombaLink:
    """A serial line to a simulated robot; see robotd.hardware.SerialLink.

    A byte takes 10 bit times each way; what was written together arrives together, with its last byte. If the two
    ends are set to different baud rates each hears noise. The faults of the line are `roomba.quirks.line`. The first
    link to a robot switches it on.

    Parameters
    ----------
    roomba : SimRoomba
    baud : int

    Raises
    ------
    DriverFault
        Another link to it is open.
    """

    def __init__(self, roomba: SimRoomba, baud: int) -> None:
        if roomba.link is not None:
            raise DriverFault("the simulated robot's port is in use by another program; stop that first")
        self._roomba = roomba
        self._baud = baud
        self._loop = asyncio.get_running_loop()
        self._chunks: deque[tuple[float, bytes]] = deque()
        self._arrived = asyncio.Event()
        self._gone: str | None = None
        self._opened = self._loop.time()
        faults = roomba.quirks.line
        self._to_robot = _Channel(faults, roomba.line_rng[0], self._opened, is_hit=faults.direction != "to_host")
        self._to_host = _Channel(faults, roomba.line_rng[1], self._opened, is_hit=faults.direction != "to_robot")
        if faults.disconnect_after is not None:
            self._loop.call_at(self._opened + faults.disconnect_after, self.unplug)
        roomba.link = self
        if roomba.power is None:
            roomba.power = Power(roomba)

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
        arrival = self._to_robot.arrival(self._loop.time(), len(data) * 10.0 / self._baud)
        self._loop.call_at(arrival, self._reach_robot, data, self._baud)

    def set_baud(self, baud: int) -> None:
        """Change the speed of both directions."""
        self._check()
        self._baud = baud

    def pulse_wake(self, seconds: float) -> None:
        """Hold the wake line low for so long, in the background."""
        self._check()
        self._loop.call_later(seconds, self._roomba.pulse_brc, seconds)

    def rest(self, seconds: float) -> None:
        """Nobody is woken here, so nothing is saved: bytes come as ever."""

    def close(self) -> None:
        """Send what is queued, then release the robot; safe to call twice."""
        self._end("closed")

    def unplug(self) -> None:
        """Pull the cable: what is under way still arrives, nothing after it."""
        self._end("unplugged; plug the adapter in again")

    def stall(self, seconds: float) -> None:
        """Let nothing arrive, in either direction, for so long from now; then everything at once."""
        until = self._loop.time() + seconds
        self._to_robot.hold(until)
        self._to_host.hold(until)

    def deliver(self, t: float, data: bytes) -> None:
        """The robot begins to send these bytes at time `t`."""
        arrival = self._to_host.arrival(t, len(data) * 10.0 / self._roomba.baud)
        self._loop.call_at(arrival, self._reach_host, data, self._roomba.baud)

    def _reach_robot(self, data: bytes, baud: int) -> None:
        self._roomba.receive(self._to_robot.heard(data, baud, self._roomba.baud))

    def _reach_host(self, data: bytes, baud: int) -> None:
        data = self._to_host.heard(data, baud, self._baud)
        if data and self._gone is None:
            self._chunks.append((self._loop.time(), data))
            self._arrived.set()

    def _end(self, reason: str) -> None:
        if self._gone is None:
            self._gone = reason
            self._roomba.link = None
            self._chunks.clear()
            self._arrived.set()

    def _check(self) -> None:
        if self._gone is not None:
            raise DriverFault(f"the simulated robot's port is {self._gone}")


class _Channel:
    """One direction of the line: when bytes arrive and what has become of them."""

    def __init__(self, faults: LineFaults, rng: np.random.Generator, opened: float, *, is_hit: bool) -> None:
        self._faults = faults
        self._rng = rng
        self._opened = opened
        self._stalls = is_hit and faults.stall > 0.0
        self._is_noisy = is_hit and max(faults.drop, faults.flip, faults.insert, faults.burst) > 0.0
        self._free = self._held_until = self._last = 0.0
        self._burst_left = 0

    def hold(self, until: float) -> None:
        """Nothing arrives before this time."""
        self._held_until = until

    def arrival(self, t: float, seconds: float) -> float:
        """When bytes arrive that take so long on the line and are ready to be sent at `t`."""
        self._free = max(self._free, t) + seconds
        arrival = max(self._free, self._held_until)
        if self._stalls:
            cycle, since = divmod(self._free - self._opened, self._faults.stall_every)
            if cycle >= 1 and since < self._faults.stall:
                arrival = max(arrival, self._opened + cycle * self._faults.stall_every + self._faults.stall)
        # a nanosecond apart, because timers of equal time fire in any order
        self._last = max(arrival, self._last + 1e-9)
        return self._last

    def heard(self, data: bytes, sent: int, heard: int) -> bytes:
        """What a receiver at `heard` baud makes of bytes sent at `sent` baud over this line."""
        if sent != heard:
            data = resampled(data, sent / heard)
        return self._noisy(data) if self._is_noisy else data

    def _noisy(self, data: bytes) -> bytes:
        faults, rng = self._faults, self._rng
        out = bytearray()
        draws = rng.random((len(data), 4))
        for byte, (burst, drop, flip, insert) in zip(data, draws, strict=True):
            if burst < faults.burst and not self._burst_left:
                self._burst_left = faults.burst_bytes
            if self._burst_left:
                self._burst_left -= 1
                out.append(int(rng.integers(256)))
            elif drop >= faults.drop:
                out.append(byte ^ 1 << int(rng.integers(8)) if flip < faults.flip else byte)
            if insert < faults.insert:
                out.append(int(rng.integers(256)))
        return bytes(out)


def resampled(data: bytes, ratio: float) -> bytes:
    """What a receiver makes of bytes sent at `ratio` times its own baud rate: it samples where it expects the bits."""
    levels = [level for byte in data for level in (0, *((byte >> bit) & 1 for bit in range(8)), 1)]
    heard, place = bytearray(), 0.0

    def level(at: float) -> int:
        return levels[int(at)] if at < len(levels) else 1

    while place < len(levels):
        if level(place):  # idle
            place = math.floor(place) + 1.0
            continue
        heard.append(sum(level(place + (1.5 + bit) * ratio) << bit for bit in range(8)))
        place += 9.5 * ratio
        while not level(place):  # no stop bit: it waits for the line to rise
            place = math.floor(place) + 1.0
    return bytes(heard)
