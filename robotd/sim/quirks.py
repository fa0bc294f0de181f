"""In which ways a robot and its cable differ from the manual: every known one is a switch, and they compose.

Q1 to Q12 number the deviations that owners have reported; the robot without any switch is what the manual of the
Roomba 600 promises. `quirks_from` and `faults_from` read switches as they stand on a command line.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from .. import oi
from ..bind import bind, ranged
from ..errors import ConfigError

T = TypeVar("T")

Firmware = Literal["3.2.6", "stm32-3.7.7", "silent"]


@dataclass(frozen=True, slots=True)
class LineFaults:
    """What the cable does to the bytes; probabilities are per byte, and the seed of the robot decides the draws.

    A byte is first hit by a burst, then lost or flipped, then followed by an inserted one.
    """

    drop: float = ranged(0.0, minimum=0.0, maximum=1.0, doc="a byte is lost")
    flip: float = ranged(0.0, minimum=0.0, maximum=1.0, doc="one bit of a byte is wrong")
    insert: float = ranged(0.0, minimum=0.0, maximum=1.0, doc="a byte of noise follows")
    burst: float = ranged(0.0, minimum=0.0, maximum=1.0, doc="a run of noise begins, which replaces what is sent")
    burst_bytes: int = ranged(20, minimum=1, maximum=10_000, doc="length of such a run")
    stall: float = ranged(0.0, minimum=0.0, maximum=3600.0, doc="s for which nothing arrives, then all of it at once")
    stall_every: float = ranged(10.0, minimum=0.001, maximum=1e6, doc="s from the start of a stall to the next one's")
    disconnect_after: float | None = ranged(
        None, minimum=0.0, maximum=1e6, doc="s after it was opened the cable is pulled"
    )
    direction: Literal["both", "to_robot", "to_host"] = ranged(
        "both", doc="which way bytes are hit: both, to_robot or to_host"
    )

    def __post_init__(self) -> None:
        if self.stall >= self.stall_every:
            raise ValueError(f"stall = {self.stall:g}; expected less than stall_every = {self.stall_every:g}")


@dataclass(frozen=True, slots=True)
class RoombaQuirks:
    """The switches; the defaults are a robot as in the manual, on a perfect line."""

    baud: int = ranged(115200, doc="rate after power-up; 57600 and 19200 have been seen")
    firmware: Literal["3.2.6", "stm32-3.7.7", "silent"] = ranged(
        "3.2.6", doc="which banner a reset prints: 3.2.6, stm32-3.7.7, or silent as some 690s, which print no text ever"
    )
    distance_wrong: bool = ranged(
        False, doc="Q1, before 3.3.0: packet 19 counts -1 for every 7.75 mm, packet 40 reads 0"
    )
    angle_wrong: bool = ranged(False, doc="Q2, up to 3.4.0: packet 20 counts 0.324056 for every degree")
    mode_offset: int = ranged(0, minimum=0, maximum=1, doc="Q3, some newer 600s: packet 35 reads one too high")
    mode_32_after_cliff: bool = ranged(
        False, doc="Q3: packet 35 reads 32 from a drop out of Safe mode at a cliff to the next command of a mode"
    )
    mode_packet_dead: bool = ranged(
        False,
        doc="Q4, an old build: packet 35 is never answered; a list or stream that names it comes without it (the frame "
        "is shorter by its id and value), groups are complete",
    )
    stream_distance_zero: bool = ranged(False, doc="Q5: packets 19 and 20 are always 0 in the stream, not in queries")
    checksum: Literal["inclusive", "exclusive"] = ranged(
        "inclusive", doc="Q6: whether a frame's checksum covers its header"
    )
    brc_keeps_awake: bool = ranged(True, doc="Q7, 3.2.6: without it the robot sleeps in spite of pulses")
    wakes_by_brc: bool = ranged(True, doc="Q7: without it a sleeping robot wakes by its Clean button only")
    brc_works_on_dock: bool = ranged(True, doc="Q7: without it the wake line does nothing while docked")
    brc_wired: bool = ranged(True, doc="without it the cable has no wake line: pulses never reach the robot")
    answers_shift_after: float | None = ranged(
        None,
        minimum=0.0,
        maximum=1e6,
        doc="Q8: s after the first query from which every answer comes one byte late, until Start or a reset",
    )
    cleans_when_lifted_off_dock: bool = ranged(
        False, doc="Q9: cleaning resumes when it is lifted off the dock in Passive mode after a wake by Clean"
    )
    cliffs_on_dock: bool = ranged(False, doc="Q10: all four cliff flags are set while docked")
    mute_after: float | None = ranged(
        None, minimum=0.0, maximum=1e6, doc="Q11: s after power-up it stops to listen and talk until the battery is out"
    )
    clock_buttons_dead: bool = ranged(False, doc="Q12: the Clock and Schedule buttons are never seen")
    buttons_command_dead: bool = ranged(False, doc="some 690s: opcode 165 presses nothing")
    encoders_swapped: bool = ranged(
        False, doc="packets 43 and 44 stand for the other wheel (signed or not is the reader's: same bits)"
    )
    encoder_start: int | None = ranged(
        None, minimum=0, maximum=65535, doc="what both encoders read at power-up; else drawn by the seed"
    )
    freeze: float = ranged(
        0.0, minimum=0.0, maximum=3600.0, doc="s for which the line is dead after a mode was toggled while charging"
    )
    gauge_error_mah: float = ranged(
        0.0, minimum=0.0, maximum=5000.0, doc="packet 25 reads so much too low and wraps below 0 to near 65535"
    )
    acceleration: float = ranged(0.75, minimum=0.01, maximum=100.0, doc="m/s^2 of each wheel")
    line: LineFaults = field(default_factory=LineFaults)

    def __post_init__(self) -> None:
        if self.baud not in oi.BAUD_CODES:
            raise ValueError(f"baud = {self.baud}; expected one of {', '.join(map(str, oi.BAUD_CODES))}")


def quirks_from(quirks: Iterable[str], faults: Iterable[str] = ()) -> RoombaQuirks:
    """Switches from texts of the form NAME or NAME=VALUE; a NAME alone turns a yes-or-no switch over.

    Raises
    ------
    ConfigError
        Lists every unknown name and every value that does not fit.
    """
    problems: list[str] = []
    found = []
    for cls, items, option in ((RoombaQuirks, quirks, "--quirk"), (LineFaults, faults, "--fault")):
        try:
            found.append(bind(cls, _table(cls, items, option), option))
        except ConfigError as error:
            problems.extend(error.problems)
    if problems:
        raise ConfigError(*problems)
    robot, line = found
    assert isinstance(robot, RoombaQuirks)
    assert isinstance(line, LineFaults)
    return dataclasses.replace(robot, line=line)


def _table(cls: type, items: Iterable[str], option: str) -> dict[str, Any]:
    defaults = {item.name: item.default for item in dataclasses.fields(cls)}
    table: dict[str, Any] = {}
    for item in items:
        name, equals, text = item.partition("=")
        if equals:
            table[name] = _value(text)
        elif isinstance(defaults.get(name), bool):
            table[name] = not defaults[name]
        elif name in defaults and name != "line":
            raise ConfigError(f"{option} {name}: no value; expected {name}=VALUE")
        else:
            table[name] = True
    if "line" in table:
        raise ConfigError(f"{option} line: not a switch; faults of the line are set with --fault")
    return table


def _value(text: str) -> Any:
    """A number or truth value as in TOML, else the text itself."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def listing(cls: type) -> str:
    """One line for every switch of `cls` (RoombaQuirks or LineFaults): name, default, meaning."""
    rows = []
    for item in dataclasses.fields(cls):
        if item.name != "line":
            default = str(item.default).lower() if isinstance(item.default, bool) else item.default
            rows.append(f"  {item.name} = {default if default is not None else 'none'}: {item.metadata['doc']}")
    return "\n".join(rows)
