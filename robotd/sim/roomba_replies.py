"""What the simulated robot sends: answers, stream frames and text, within the bytes that fit into one tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from .. import oi
from ..oi import TICK
from .quirks import RoombaQuirks

FRAME_PAYLOAD_MAX = 255


class Replies:
    """The robot's transmitter.

    Everything is produced on the tick: answers and text first, in the order in which they were asked for, then the
    stream's frame. Answers that do not fit go out with later ticks; of a frame that does not fit the rest is lost.

    Parameters
    ----------
    sources : mapping of int to callable
        How each sensor packet gets its value.
    quirks : RoombaQuirks
    """

    def __init__(self, sources: Mapping[int, Callable[[], int]], quirks: RoombaQuirks) -> None:
        self._sources = sources
        self._quirks = quirks
        self._streamed = dict(sources) | ({19: _zero, 20: _zero} if quirks.stream_distance_zero else {})
        self._layout: oi.StreamLayout | None = None
        self._is_paused = False
        self._asked: list[tuple[int, ...]] = []
        self._answers = bytearray()
        self._printing: list[tuple[float, bytes]] = []
        self._first_query: float | None = None
        self._late = b""  # the byte by which answers are late, once they are

    @property
    def stream_packets(self) -> int:
        """Packet 38."""
        return len(self._layout.packet_ids) if self._layout is not None else 0

    def ask(self, name: str, packet_ids: tuple[int, ...], now: float) -> None:
        """Take one of the commands `sensors`, `query` and `stream`; unknown packets are met with silence."""
        if not all(number in oi.PACKETS or number in oi.GROUPS for number in packet_ids):
            return
        if self._quirks.mode_packet_dead:
            packet_ids = tuple(number for number in packet_ids if number != 35)
        if name != "stream":
            self._asked.append(packet_ids)
            if self._first_query is None:
                self._first_query = now
            return
        sizes = [oi.PACKETS[key].size for number in packet_ids for key in oi.members(number)]
        if len(packet_ids) + sum(sizes) <= FRAME_PAYLOAD_MAX:
            self._layout = oi.StreamLayout(packet_ids) if packet_ids else None
            self._is_paused = False

    def pause(self, is_paused: bool) -> None:
        """Opcode 150; the list stays."""
        self._is_paused = is_paused

    def stop_stream(self) -> None:
        """Forget the list."""
        self._layout = None

    def restart(self) -> None:
        """Start was received: answers are in step again."""
        self._first_query, self._late = None, b""

    def forget(self) -> None:
        """The robot restarts: nothing is left to say."""
        self.restart()
        self.stop_stream()
        self._asked.clear()
        self._answers.clear()
        self._printing.clear()

    def say(self, at: float, text: bytes) -> None:
        """Print a text at a time; a robot that prints none keeps silent."""
        if self._quirks.firmware != "silent":
            self._printing.append((at, text))

    def send(self, t: float, baud: int, *, is_streaming: bool) -> bytes:
        """What leaves the robot in the tick at `t`."""
        budget = int(baud * TICK / 10.0)
        for packet_ids in self._asked:
            values = {key: self._sources[key]() for number in packet_ids for key in oi.members(number)}
            self._answers += self._in_step(oi.encode_values(packet_ids, values), t)
        self._asked.clear()
        while self._printing and self._printing[0][0] <= t:
            self._answers += self._printing.pop(0)[1]
        out = bytes(self._answers[:budget])
        del self._answers[:budget]
        layout = self._layout
        if is_streaming and layout is not None and not self._is_paused:
            out += layout.encode([self._streamed[key]() for key in layout.keys], self._quirks.checksum)
        return out[:budget]

    def _in_step(self, answer: bytes, t: float) -> bytes:
        """The answer, or with the quirk all but its last byte after the last one of the answer before."""
        after = self._quirks.answers_shift_after
        if after is None or self._first_query is None or t - self._first_query < after:
            return answer
        shifted = (self._late or b"\0") + answer
        self._late = shifted[-1:]
        return shifted[:-1]


def _zero() -> int:
    return 0
