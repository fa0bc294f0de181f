"""The serial line to a Roomba: finding the robot, its sensor stream, and what can be said about the line.

Nobody knows in which state a robot is found: at another baud rate, asleep, in the middle of a command of which the
rest never came, streaming what a dead program asked for, printing text, or so old that it lacks packets. So we climb
a ladder, and every rung ends in the same proof: frames of the stream that we asked for.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

from .. import oi
from ..clock import now
from ..errors import DriverFault
from ..hardware import SerialLink
from .firmware import BannerReader, Firmware
from .stream_clock import StreamClock
from .wake import PULSE_S, WakeLine

BAUDS = (115200, 19200, 57600)
LOST = (300, 600)  # one wrong bit in a drive command makes it a change to these rates
LOST_STARTS = 6  # a drive command is at most half received
# bumps, cliffs, overcurrent, buttons, charging, battery, mode, encoders, wheel currents, stasis
PACKETS = (7, 9, 10, 11, 12, 14, 18, 21, 22, 25, 26, 34, 35, 43, 44, 54, 55, 58)
# some old builds never send packet 35; the echo of the wheels' speeds (41, 42) then tells whether they obey
PACKETS_NO_MODE = (7, 9, 10, 11, 12, 14, 18, 21, 22, 25, 26, 34, 41, 42, 43, 44, 54, 55, 58)
PACKETS_FEW = (7, 9, 10, 11, 12, 14, 21, 22, 35, 43, 44)  # just the 28 bytes that fit at 19200 baud
PACKETS_FEWEST = (7, 9, 10, 11, 12, 14, 21, 22, 43, 44)

START_S = 0.1  # after Start, before anything else
VOLTAGE, VOLTAGES = 22, range(9000, 20000)  # a packet that every robot has; mV
PROBE_S, PROBES = 0.1, 3
FIRST_FRAMES, FIRST_FRAMES_S = 3, 0.3
WAKE_S = 1.0
BOOT_S = 5.0
RECOVER, RECOVER_LONG = 36, 260  # Starts that a half-received command can swallow: a song, a list of 255 packets
STALL_S = 3 * oi.TICK  # after a longer pause frames may be waiting
PIECES_S = 0.001
REVIEW_S = 60.0
BAD_SHARE = 0.01  # of the frames, that make the line worth a word

Values = Mapping[int, int]


@dataclass(slots=True)
class LineCounters:
    """What came over the line since the robot was found.

    Good frames; rejected headers by reason (as in robotd.oi.StreamCounters); bytes outside frames; ticks of 15 ms
    without a good frame; frames that arrived more than 10 ms late.
    """

    frames: int = 0
    bad_length: int = 0
    bad_order: int = 0
    bad_checksum: int = 0
    ambiguous: int = 0
    skipped_bytes: int = 0
    missing: int = 0
    late: int = 0

    @property
    def bad(self) -> int:
        """Damaged frames, at most: a data byte that looks like a header counts too."""
        return self.bad_length + self.bad_order + self.bad_checksum


def packet_sets(baud: int) -> list[tuple[int, ...]]:
    """Lists of packets to ask for, best first, whose frames fit into a tick of 15 ms at a baud rate."""
    budget = int(baud * oi.TICK / 10)
    every = (PACKETS, PACKETS_NO_MODE, PACKETS_FEW, PACKETS_FEWEST)
    return [packets for packets in every if oi.StreamLayout(packets).frame_size <= budget]


class RoombaLine:
    """An open serial line to a robot that `connect` finds.

    Parameters
    ----------
    link : SerialLink
    wake : WakeLine
    baud : int
        Tried first.
    checksum : "auto", "inclusive" or "exclusive"
    report : callable
        Told in words what is being tried.

    Attributes
    ----------
    baud : int
        Of the robot.
    packets : tuple of int
        What the stream holds.
    reading : int or None
        Packet 35 of the last frame after Start, that is in Passive mode; None if it never comes.
    arrived : float
        Loop time at which the last bytes came.
    heard : int
        Bytes received since the line was opened.
    banner : BannerReader
        What the robot said about its firmware.
    news : list
        Releases, "reset" and "sleep" read from its text; whoever reads them removes them.
    """

    def __init__(
        self, link: SerialLink, wake: WakeLine, baud: int, checksum: oi.Checksum, report: Callable[[str], None]
    ) -> None:
        self.wake = wake
        self.reading: int | None = None
        self.arrived = 0.0
        self.heard = 0
        self.banner = BannerReader()
        self.news: list[Firmware | str] = []
        self._link = link
        self._first = baud
        self._checksum: oi.Checksum = checksum
        self._report = report
        self._is_resting = False  # bytes are gathering
        self._past = LineCounters()
        self._review: tuple[float, LineCounters] | None = None
        self._use(baud, packet_sets(baud)[0])

    @property
    def counters(self) -> LineCounters:
        """Since the robot was found."""
        seen, clock, past = self._decoder.counters, self._clock, self._past
        return LineCounters(
            past.frames + seen.frames,
            past.bad_length + seen.bad_length,
            past.bad_order + seen.bad_order,
            past.bad_checksum + seen.bad_checksum,
            past.ambiguous + seen.ambiguous,
            past.skipped_bytes + seen.skipped_bytes,
            past.missing + clock.missing,
            past.late + clock.late,
        )

    def send(self, *commands: bytes) -> None:
        """Queue commands; a port that is gone also fails the reader, which reports it."""
        with contextlib.suppress(DriverFault):
            self._link.write(b"".join(commands))

    # ---- finding the robot -------------------------------------------------------------------------------------------

    async def connect(self) -> None:
        """Find the robot, leave it in Passive mode with the sensor stream running.

        Raises
        ------
        DriverFault
            Nothing that looks like a sensor stream at any baud rate, also after a wake pulse and a restart.
        """
        bauds = (self._first, *(baud for baud in BAUDS if baud != self._first))
        if await self._greet(self._first, packet_sets(self._first), RECOVER):
            return self._found()
        self._report("the robot does not answer; waking it and trying other baud rates")
        await self._pulse()
        for baud in bauds:
            if await self._greet(baud, packet_sets(baud), RECOVER_LONG):
                return self._found()
            if self.banner.is_text:  # it restarts and does not listen yet
                await asyncio.sleep(BOOT_S)
                if await self._greet(baud, packet_sets(baud), RECOVER_LONG):
                    return self._found()
        for lost in LOST:
            self._link.set_baud(lost)
            self._link.write(oi.encode("start") * LOST_STARTS + oi.encode("baud", oi.BAUD_CODES.index(BAUDS[0])))
            await asyncio.sleep(START_S + (LOST_STARTS + 2) * 10 / lost)
        if await self._greet(BAUDS[0], packet_sets(BAUDS[0]), RECOVER_LONG):
            return self._found()
        for baud in bauds:  # it obeys a reset in every mode
            self._link.set_baud(baud)
            self._link.write(oi.encode("reset"))
            await asyncio.sleep(START_S)
        self._link.set_baud(self._first)
        await asyncio.sleep(BOOT_S)
        for baud in bauds:
            if await self._greet(baud, packet_sets(baud), RECOVER):
                self._report("the robot did not answer and was restarted")
                return self._found()
        tried = ", ".join(map(str, bauds))
        if self.heard:
            raise DriverFault(
                f"{self.heard} bytes came but no sensor frame at {tried} baud, also after a wake pulse and a restart; "
                "check that this is the robot's port and that no other program talks to the robot, and the line's "
                "levels (the robot sends 5 V)"
            )
        raise DriverFault(
            f"no sensor frame at {tried} baud, also after a wake pulse and a restart; check that the robot is on "
            "(press Clean once), that the cable is in, and that RX and TX are not swapped; a robot that is on and "
            "still mute answers again after its battery was out for a minute"
        )

    async def greet_again(self) -> bool:
        """Ask a robot that fell silent for its stream again; True if it comes. The robot is in Passive mode then."""
        return await self._greet(self.baud, [self.packets], RECOVER)

    async def wake_up(self) -> bool:
        """Wake a robot that sleeps and ask it for its stream again; True if it comes."""
        await self._pulse()
        return await self._greet(self.baud, [self.packets], RECOVER_LONG)

    async def _pulse(self) -> None:
        self.wake.pulse()
        await asyncio.sleep(PULSE_S + WAKE_S)

    def _use(self, baud: int, packets: tuple[int, ...]) -> None:
        self.baud, self.packets = baud, packets
        self._decoder = oi.StreamDecoder(packets, self._checksum)
        self._clock = StreamClock(baud, self._decoder.layout.frame_size)

    def _found(self) -> None:
        """What was heard on the way here says nothing about the line."""
        self._past = LineCounters()
        self._decoder.counters = oi.StreamCounters()
        self._clock.missing = self._clock.late = 0
        self._review = None

    async def _greet(self, baud: int, lists: Sequence[tuple[int, ...]], starts: int) -> bool:
        """Try one baud rate and lists of packets: Passive mode, an answer to a query, three frames of the stream.

        What is sent before the answer means nothing at any other of the three baud rates; a list of packets could be
        taken for Spot or Dock, and the robot would drive off.
        """
        self._past = self.counters
        self._use(baud, lists[0])
        self._link.set_baud(baud)
        self._link.write(oi.encode("start") * starts + oi.encode("stream"))
        await asyncio.sleep(START_S + starts * 10 / baud)
        if not await self._answers():
            return False
        for packets in lists:
            if packets != self.packets:
                self._use(baud, packets)
            if await self._streams():
                return True
        return False

    async def _streams(self) -> bool:
        asked = now()
        self._link.write(oi.encode("stream", *self.packets))
        good = 0
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_FRAMES_S):
                while good < FIRST_FRAMES:
                    for values in self._decode(await self._later_than(asked)):
                        good += 1
                        self.reading = values.get(35)
                return True
        return False

    async def _answers(self) -> bool:
        """Whether a robot at this baud rate answers a query, or streams already."""
        for _ in range(PROBES):
            asked, data = now(), b""
            self._link.write(oi.encode("sensors", VOLTAGE))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PROBE_S):
                    while not _is_answer(data):
                        data += await self._later_than(asked)
                    return True
            self.news += self.banner.feed(data)
        return False

    async def _later_than(self, asked: float) -> bytes:
        """Bytes that came after that time; the text among older ones is read."""
        self.arrived, data = await self._link.read()
        self.heard += len(data)
        if self.arrived >= asked:
            return data
        self.news += self.banner.feed(data)
        return b""

    # ---- the stream --------------------------------------------------------------------------------------------------

    def rest(self, seconds: float) -> None:
        """Let frames gather for so long, which saves waking up for each; 0 ends that."""
        if seconds or self._is_resting:
            self._is_resting = seconds > 0.0
            self._link.rest(seconds)

    async def read(self) -> list[tuple[float, Values]]:
        """Wait for bytes; returns the frames that they completed, each with the time at which it was taken.

        Raises DriverFault when the port is gone.
        """
        before = self.arrived
        self.arrived, data = await self._link.read()
        if self._is_resting:  # nobody knows when these came; what comes next dates them
            self._is_resting = False
            self.arrived, more = await self._link.read()
            data += more
        elif self.arrived - before > STALL_S:
            data += await self._waiting()
        self.heard += len(data)
        ends: list[int] = []
        frames = self._decode(data, ends)
        if not frames:
            return []
        decoder = self._decoder
        begun = decoder.fed > ends[-1] and decoder.pending[:1] == bytes((oi.HEADER,))
        stamps = self._clock.stamps(self.arrived, ends, decoder.fed, begun=begun)
        return list(zip(stamps, frames, strict=True))

    def complaint(self) -> str | None:
        """Once a minute: what is wrong with the line, in words, if more than 1 % of the frames are."""
        t, counters = now(), self.counters
        if self._review is None:
            self._review = t, counters
        since, before = self._review
        if t - since < REVIEW_S:
            return None
        self._review = t, counters
        new = LineCounters(
            *(getattr(counters, item.name) - getattr(before, item.name) for item in fields(LineCounters))
        )
        if new.missing + new.late <= BAD_SHARE * new.frames:
            return None
        return (
            f"the line to the robot is bad: within {t - since:.0f} s {new.frames} good frames, {new.missing} missing, "
            f"{new.bad} damaged, {new.late} late; check cable, plugs and the adapter's latency"
        )

    def _decode(self, data: bytes, ends: list[int] | None = None) -> list[Values]:
        frames: list[Values] = []
        for event in self._decoder.feed(data):
            if isinstance(event, oi.SensorValues):
                frames.append(event.values)
                if ends is not None:
                    ends.append(event.end)
            else:
                self.news += self.banner.feed(event.data)
        return frames

    async def _waiting(self) -> bytes:
        """What else has arrived already: adapters hand it over in pieces."""
        data = b""
        with contextlib.suppress(TimeoutError):
            while True:
                async with asyncio.timeout(PIECES_S):
                    self.arrived, more = await self._link.read()
                data += more
        return data


def _is_answer(data: bytes) -> bool:
    """Whether these bytes are a voltage, or hold a stream frame of any packets."""
    if 2 <= len(data) <= 4:  # one or two bytes of noise
        return any(int.from_bytes(data[place : place + 2]) in VOLTAGES for place in range(len(data) - 1))
    for place, byte in enumerate(data[:-2]):
        frame = data[place : place + data[place + 1] + 3] if byte == oi.HEADER else b""
        if len(frame) > 3 and len(frame) == frame[1] + 3 and sum(frame) & 0xFF in (0, oi.HEADER):
            return True
    return False
