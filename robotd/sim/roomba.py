"""The simulated Roomba: an Open Interface byte machine on 15 ms ticks, with motors, encoders and a battery.

`SimRoomba` does no I/O: bytes in, one tick at a time out. `RoombaLink` is the serial line to it in loop time.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .. import oi
from ..errors import DriverFault
from ..oi import FULL, OFF, PASSIVE, SAFE, TICK
from .wheel import Wheel

WHEEL_BASE_MM = 235.0  # as the firmware believes
ROBOT_RADIUS_MM = 170.0
SLEEP_AFTER = 300.0  # s in Passive without a byte received
BOOT_TIME = 4.5  # s after opcode 7
WAKE_TIME = 0.5
CAPACITY_MAH = 2696.0
BANNER = (
    b"\r\nSoft reset!\r\n\xfeRoomba by iRobot!\r\nstm32\r\n2012-03-22-1549-L\r\n"
    b"r3_robot/tags/release-3.2.6:4975 CLEAN\r\n\r\nbootloader id: 4718 5267 ABFF FFFF\r\n"
)
_ACTUATORS = {
    "drive", "motors", "leds", "play", "pwm_motors", "drive_direct", "drive_pwm", "scheduling_leds",
    "digits_raw", "digits_ascii",
}  # fmt: skip
_CLEANING = {"spot", "clean", "max", "dock", "power"}


class RoombaBody(Protocol):
    """What carries the robot through the world: motion of the wheels in, contacts out."""

    left_rotation: float  # metres rolled since the start, forward positive
    right_rotation: float
    bump_left: bool
    bump_right: bool
    cliff: bool
    wheel_drop_left: bool
    wheel_drop_right: bool

    def advance(self, t: float, left_speed: float, right_speed: float) -> None:
        """Roll the wheels at these mean speeds (m/s) from the last instant until `t`."""


@dataclass(frozen=True, slots=True)
class RoombaQuirks:
    """In which ways a robot and its cable differ from the manual.

    `mode_offset` is added to packet 35; `checksum` may leave out the header; `wakes_by_brc` False needs the Clean
    button; `baud` is the rate after power-up; `drop` and `flip` are probabilities per byte on the line, both ways;
    `acceleration` of each wheel in m/s^2.
    """

    mode_offset: int = 0
    checksum: oi.Checksum = "inclusive"
    wakes_by_brc: bool = True
    baud: int = 115200
    drop: float = 0.0
    flip: float = 0.0
    acceleration: float = 0.75


class SimRoomba:
    """The robot's side of the Open Interface.

    Parameters
    ----------
    body : RoombaBody
        Moved by the wheels; says what the bumpers, cliff sensors and wheel switches feel.
    rng : numpy Generator
        Where the encoders start, and the faults of the line.
    quirks : RoombaQuirks, optional

    Attributes
    ----------
    mode : int
        OFF, PASSIVE, SAFE or FULL of robotd.oi.
    baud : int
        What the robot's receiver and transmitter are set to now.
    is_asleep : bool
    charge_mah : float
    overcurrent : int
        Packet 14.
    link : RoombaLink or None
        Who is connected.
    power : object or None
        What ticks it; None until the first link switches it on.
    """

    def __init__(self, body: RoombaBody, rng: np.random.Generator, quirks: RoombaQuirks | None = None) -> None:
        self.body = body
        self.rng = rng
        self.quirks = quirks or RoombaQuirks()
        self.mode = OFF
        self.baud = self.quirks.baud
        self.is_asleep = False
        self.charge_mah = 0.93 * CAPACITY_MAH
        self.overcurrent = 0
        self.link: RoombaLink | None = None
        self.power: _Power | None = None
        self.right = Wheel(int(rng.integers(0x10000)), self.quirks.acceleration)
        self.left = Wheel(int(rng.integers(0x10000)), self.quirks.acceleration)
        self._t: float | None = None
        self._is_docked = False
        self._current_ma = 0.0
        self._radius_mm = 0
        self._songs: dict[int, tuple[int, ...]] = {}
        self._song, self._song_end = 0, -1.0
        self._told_mm, self._told_deg = [0.0, 0.0], [0.0, 0.0]  # wheel sums at the last request of packets 19, 20
        self._last_byte = 0.0
        self._boot_end: float | None = None
        self._banner = b""
        self._short_pulses = 0
        self._parser = oi.CommandDecoder()
        self._layout: oi.StreamLayout | None = None
        self._is_paused = False
        self._asked: tuple[int, ...] = ()
        self._answers = bytearray()
        self._sources = self._packet_sources()

    # ---- what the world does to it -----------------------------------------------------------------------------------

    def pulse_brc(self, seconds: float) -> None:
        """The wake line was low for so long; three pulses of 50 to 500 ms change the baud rate to 19200."""
        if self.is_asleep:
            if self.quirks.wakes_by_brc:
                self._wake()
            return
        if self.quirks.wakes_by_brc:
            self._last_byte = self._now
        self._short_pulses = self._short_pulses + 1 if 0.05 <= seconds <= 0.5 else 0
        if self._short_pulses == 3:
            self.baud = 19200

    def press_clean(self) -> None:
        """Somebody presses the Clean button: wakes the robot, or takes it out of Safe mode."""
        if self.is_asleep:
            self._wake()
        elif self.mode in (SAFE, FULL):
            self._set_mode(PASSIVE)

    def set_docked(self, is_docked: bool) -> None:
        """Put it on the charger, which ends Safe mode, or lift it off."""
        self._is_docked = is_docked
        if is_docked and self.mode == SAFE:
            self._set_mode(PASSIVE)

    # ---- bytes in ----------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Bytes that arrived at the robot, at its own baud rate."""
        if self.is_asleep or self._boot_end is not None:
            return
        self._last_byte = self._now
        for command in self._parser.feed(data):
            if isinstance(command, oi.Command):
                self._obey(command.name, command.values)

    @property
    def _now(self) -> float:
        return self._t if self._t is not None else 0.0

    def _obey(self, name: str, values: tuple[int, ...]) -> None:
        if self._boot_end is not None or (self.mode == OFF and name not in ("start", "reset")):
            return
        if name in _ACTUATORS and self.mode == PASSIVE:
            return
        if name == "start":
            self._set_mode(PASSIVE)
        elif name == "reset":
            self._boot(BOOT_TIME, BANNER)
        elif name in ("safe", "control", "full"):
            self._set_mode(FULL if name == "full" else SAFE)
        elif name in _CLEANING:
            self._set_mode(PASSIVE)
            if name == "power":
                self.is_asleep = True
        elif name == "stop":
            self._set_mode(OFF)
            self._layout = None
        elif name == "baud" and values[0] < len(oi.BAUD_CODES):
            self.baud = oi.BAUD_CODES[values[0]]
        elif name in ("drive", "drive_direct", "drive_pwm"):
            self._drive(name, *values)
        elif name == "song":
            self._songs[values[0]] = values[1:]
        elif name == "play" and values[0] in self._songs:
            self._song = values[0]
            self._song_end = self._now + sum(self._songs[values[0]][1::2]) / 64.0
        elif name == "resume_stream":
            self._is_paused = values[0] == 0
        elif name in ("stream", "query", "sensors"):
            self._ask(name, values)

    def _drive(self, name: str, first: int, second: int) -> None:
        right, left = float(first), float(second)
        self._radius_mm = 0
        if name == "drive_pwm":
            right, left = right * 500.0 / 255.0, left * 500.0 / 255.0
        elif name == "drive":
            right = left = max(-500.0, min(500.0, float(first)))
            self._radius_mm = second
            if second in (oi.SPIN_CLOCKWISE, oi.SPIN_COUNTER_CLOCKWISE):
                right, left = right * second, -left * second
            elif second not in (oi.STRAIGHT, oi.STRAIGHT_TOO, 0):
                radius = max(-2000, min(2000, second))
                right *= 1.0 + 0.5 * WHEEL_BASE_MM / radius
                left *= 1.0 - 0.5 * WHEEL_BASE_MM / radius
        self.right.command(right)
        self.left.command(left)

    def _ask(self, name: str, packet_ids: tuple[int, ...]) -> None:
        if not all(number in oi.PACKETS or number in oi.GROUPS for number in packet_ids):
            return  # the robot says nothing about packets that it does not know
        if name != "stream":
            self._asked += packet_ids
        elif len(packet_ids) + sum(oi.PACKETS[key].size for number in packet_ids for key in oi.members(number)) < 256:
            self._layout = oi.StreamLayout(packet_ids) if packet_ids else None
            self._is_paused = False

    def _set_mode(self, mode: int) -> None:
        """Every change of mode stops the wheels."""
        self.mode = mode
        self.right.command(0.0)
        self.left.command(0.0)

    def _boot(self, seconds: float, banner: bytes) -> None:
        self._set_mode(OFF)
        self._parser = oi.CommandDecoder()
        self._layout = None
        self._asked = ()
        self._answers.clear()
        self._banner = banner
        self._boot_end = self._now + seconds

    def _wake(self) -> None:
        self.is_asleep = False
        self._last_byte = self._now
        self._boot(WAKE_TIME, b"")

    # ---- one tick ----------------------------------------------------------------------------------------------------

    def tick(self, t: float) -> bytes:
        """Live until time `t`, one tick after the last; returns what the robot sends now, at its own baud rate."""
        elapsed = TICK if self._t is None else t - self._t
        self._t = t
        body, left, right = self.body, self.left, self.right
        body.advance(t, left.ramp(elapsed), right.ramp(elapsed))
        left.measure(body.left_rotation)
        right.measure(body.right_rotation)
        self._use_battery(elapsed)
        if self.mode == SAFE and (body.wheel_drop_left or body.wheel_drop_right or (body.cliff and self._approaches())):
            self._set_mode(PASSIVE)
        if self._boot_end is not None:
            if t < self._boot_end:
                return b""
            self._boot_end = None
            self._answers += self._banner
            if self._banner:
                self.baud = self.quirks.baud
        if self.mode == PASSIVE and t - self._last_byte > SLEEP_AFTER:
            self.is_asleep = True
        if self.is_asleep:
            return b""
        return self._send()

    def _send(self) -> bytes:
        budget = int(self.baud * TICK / 10.0)
        sources, layout = self._sources, self._layout
        if self._asked:
            keys = {key for number in self._asked for key in oi.members(number)}
            self._answers += oi.encode_values(self._asked, {key: sources[key]() for key in keys})
            self._asked = ()
        out = bytes(self._answers[:budget])
        del self._answers[:budget]
        if layout is not None and not self._is_paused and self.mode != OFF:
            out += layout.encode([sources[key]() for key in layout.keys], self.quirks.checksum)
        return out[:budget]  # what does not fit into the tick is lost, and with it the frame

    def _approaches(self) -> bool:
        """Whether the wheels carry it forward, or backward in so tight a turn that the front swings out."""
        forward = 0.5 * (self.left.target + self.right.target)
        turn = self.right.target - self.left.target
        if forward >= 0.0:
            return forward > 0.0 or turn != 0.0
        return abs(forward) * WHEEL_BASE_MM < ROBOT_RADIUS_MM * abs(turn)

    def _use_battery(self, seconds: float) -> None:
        if self.is_asleep:
            self._current_ma = -2.0
        elif self._is_docked and self.mode in (OFF, PASSIVE):
            self._current_ma = 1200.0 if self.charge_mah < CAPACITY_MAH else 0.0
        else:
            self._current_ma = -160.0 - 900.0 * (abs(self.left.speed) + abs(self.right.speed))
        charge = self.charge_mah + self._current_ma * seconds / 3600.0
        self.charge_mah = max(0.0, min(CAPACITY_MAH, charge))

    # ---- sensor packets ----------------------------------------------------------------------------------------------

    def _packet_sources(self) -> dict[int, Callable[[], int]]:
        """How every packet gets its value; those without a source in this world read zero."""
        body, left, right = self.body, self.left, self.right
        to_degrees = 180e3 / np.pi / WHEEL_BASE_MM
        return dict.fromkeys(oi.PACKETS, lambda: 0) | {
            7: lambda: body.bump_right | body.bump_left << 1 | body.wheel_drop_right << 2 | body.wheel_drop_left << 3,
            10: lambda: int(body.cliff),
            11: lambda: int(body.cliff),
            14: lambda: self.overcurrent,
            19: lambda: self._since(self._told_mm, 500.0, 500.0),
            20: lambda: self._since(self._told_deg, -to_degrees, to_degrees),
            21: lambda: 2 if self._current_ma > 0.0 else 0,
            22: lambda: round(13000.0 + 3500.0 * self.charge_mah / CAPACITY_MAH + 0.3 * self._current_ma),
            23: lambda: round(self._current_ma),
            24: lambda: 25,
            25: lambda: round(self.charge_mah),
            26: lambda: round(CAPACITY_MAH),
            28: lambda: 2800,
            29: lambda: 10 if body.cliff else 2800,
            30: lambda: 10 if body.cliff else 2800,
            31: lambda: 2800,
            34: lambda: 2 if self._is_docked else 0,
            35: lambda: self.mode + self.quirks.mode_offset,
            36: lambda: self._song,
            37: lambda: int(self._now < self._song_end),
            38: lambda: len(self._layout.packet_ids) if self._layout is not None else 0,
            39: lambda: round(0.5 * (left.requested_mm_s + right.requested_mm_s)),
            40: lambda: self._radius_mm,
            41: lambda: right.requested_mm_s,
            42: lambda: left.requested_mm_s,
            43: lambda: left.counts,
            44: lambda: right.counts,
            54: lambda: round(900.0 * abs(left.speed)),
            55: lambda: round(900.0 * abs(right.speed)),
            58: lambda: int(left.speed + right.speed > 0.0),
        }

    def _since(self, told: list[float], by_left: float, by_right: float) -> int:
        """A weighted sum of the wheels' travel since it was last asked for, cut to whole units."""
        rolled = [self.body.left_rotation, self.body.right_rotation]
        value = by_left * (rolled[0] - told[0]) + by_right * (rolled[1] - told[1])
        told[:] = rolled
        return max(-0x8000, min(0x7FFF, int(value)))


class _Power:
    """Ticks a robot on the running loop, whether or not somebody is connected: a robot left alone moves on."""

    def __init__(self, roomba: SimRoomba) -> None:
        self._roomba = roomba
        self._loop = asyncio.get_running_loop()
        self._start = self._loop.time()
        self._ticks = 0
        self._on_tick()

    def _on_tick(self) -> None:
        t = self._start + self._ticks * TICK
        data = self._roomba.tick(t)
        if data and self._roomba.link is not None:
            self._roomba.link.deliver(t, data)
        self._ticks += 1
        self._loop.call_at(self._start + self._ticks * TICK, self._on_tick)


class RoombaLink:
    """A serial line to a simulated robot; see robotd.hardware.SerialLink.

    A byte takes 10 bit times each way; what was written together arrives together, with its last byte. If the two
    ends are set to different baud rates each hears noise. The first link to a robot switches it on.

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
        self._out_free = self._in_free = 0.0
        roomba.link = self
        if roomba.power is None:
            roomba.power = _Power(roomba)

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
        self._out_free = max(self._out_free, self._loop.time()) + len(data) * 10.0 / self._baud
        self._loop.call_at(self._out_free, self._reach_robot, data, self._baud)

    def set_baud(self, baud: int) -> None:
        """Change the speed of both directions."""
        self._check()
        self._baud = baud

    def pulse_wake(self, seconds: float) -> None:
        """Hold the wake line low for so long, in the background."""
        self._check()
        self._loop.call_later(seconds, self._roomba.pulse_brc, seconds)

    def close(self) -> None:
        """Send what is queued, then release the robot; safe to call twice."""
        self._end("closed")

    def unplug(self) -> None:
        """Pull the cable: what is under way still arrives, nothing after it."""
        self._end("unplugged; plug the adapter in again")

    def deliver(self, t: float, data: bytes) -> None:
        """The robot begins to send these bytes at time `t`."""
        self._in_free = max(self._in_free, t) + len(data) * 10.0 / self._roomba.baud
        self._loop.call_at(self._in_free, self._reach_host, data, self._roomba.baud)

    def _reach_robot(self, data: bytes, baud: int) -> None:
        self._roomba.receive(self._as_heard(data, baud, self._roomba.baud))

    def _reach_host(self, data: bytes, baud: int) -> None:
        data = self._as_heard(data, baud, self._baud)
        if data and self._gone is None:
            self._chunks.append((self._loop.time(), data))
            self._arrived.set()

    def _as_heard(self, data: bytes, sent: int, heard: int) -> bytes:
        rng, quirks = self._roomba.rng, self._roomba.quirks
        if sent != heard:
            return _resampled(data, sent / heard)
        if quirks.flip:
            flips = rng.random(len(data)) < quirks.flip
            data = bytes(
                byte ^ 1 << int(rng.integers(8)) if flip else byte for byte, flip in zip(data, flips, strict=True)
            )
        if quirks.drop:
            kept = rng.random(len(data)) >= quirks.drop
            data = bytes(byte for byte, keep in zip(data, kept, strict=True) if keep)
        return data

    def _end(self, reason: str) -> None:
        if self._gone is None:
            self._gone = reason
            self._roomba.link = None
            self._chunks.clear()
            self._arrived.set()

    def _check(self) -> None:
        if self._gone is not None:
            raise DriverFault(f"the simulated robot's port is {self._gone}")


def _resampled(data: bytes, ratio: float) -> bytes:
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
