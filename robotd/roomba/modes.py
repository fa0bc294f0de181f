"""Which mode the robot is in: read from packet 35, or inferred where that packet never comes.

The robot leaves Safe mode by itself, at a cliff, a dropped wheel, a button or the charger, and does not say so. Some
newer 600s number the modes one too high; some show 32 after a cliff. Frames come in every mode but Off, and Full is
never asked for, so that some readings tell the numbering: 1 is Passive counted from 0, and 4 is Full counted from 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..oi import FULL, OFF, PASSIVE, SAFE

NAMES = {OFF: "off", PASSIVE: "passive", SAFE: "safe", FULL: "full"}
AFTER_CLIFF = 32
SETTLE_S = 0.050  # from a mode command to the first reading that counts
RECENT_S = 0.25  # a cause may be over when the mode is read
ECHO_S = 0.15  # a drive command is echoed (packets 41, 42) long before

BUTTONS = ("Clean", "Spot", "Dock", "Minute", "Hour", "Day", "Schedule", "Clock")  # bits 0..7 of packet 18
_CLIFFS = ((9, "left"), (10, "front left"), (11, "front right"), (12, "right"))
ON_CHARGER = "it is on the charger"
TELLING = (7, 9, 10, 11, 12, 14, 18, 21, 34, 35, 43, 44)  # packets of which every change counts, also at rest


def tells_new(values: Mapping[int, int], before: Mapping[int, int]) -> bool:
    """Whether a frame says more than the one before about what the robot does, or what is done to it."""
    return any(values.get(key) != before.get(key) for key in TELLING)


def is_charging(values: Mapping[int, int]) -> bool:
    """Whether packet 21 says that it charges, is full or waits to charge."""
    return 1 <= values.get(21, 0) <= 4


def is_docked(values: Mapping[int, int]) -> bool:
    """Whether it stands on its home base or has the charger's plug in (packet 34; 21 where that is not streamed)."""
    return bool(values.get(34, 0) & 3) or is_charging(values)


def cliffs(values: Mapping[int, int]) -> list[str]:
    """The cliff sensors that see no floor; on the dock all four may be set, which means nothing."""
    found = [name for number, name in _CLIFFS if values[number]]
    return [] if len(found) == len(_CLIFFS) and is_docked(values) else found


def hazards(values: Mapping[int, int]) -> list[str]:
    """What keeps the robot out of Safe mode now, in words."""
    found = []
    if values[7] & 8:
        found.append("the left wheel dropped")
    if values[7] & 4:
        found.append("the right wheel dropped")
    if names := cliffs(values):
        sensors = "sensor sees" if len(names) == 1 else "sensors see"
        found.append(f"the {' and '.join(names)} cliff {sensors} no floor")
    if is_docked(values):
        found.append(ON_CHARGER)
    return found


def buttons(values: Mapping[int, int]) -> list[str]:
    """The buttons that are pressed, in words."""
    bits = values.get(18, 0)
    return [f"the {name} button was pressed" for bit, name in enumerate(BUTTONS) if bits >> bit & 1]


class ModeReader:
    """Follows the robot's mode from frame to frame.

    Attributes
    ----------
    offset : int
        What this firmware adds to packet 35, 0 or 1; meaningless where the packet is not streamed.
    mode : str
        "off", "passive", "safe", "full" or "unknown".
    is_odd : bool
        The last reading was none of the four modes.
    """

    def __init__(self) -> None:
        self.offset = 0
        self.mode = "unknown"
        self.is_odd = False
        self._commanded, self._commanded_t = "unknown", 0.0
        self._mute_s = 0.0  # driven without an echo
        self._causes: dict[str, float] = {}

    def learn(self, reading: int | None) -> None:
        """Take a reading of packet 35 right after Start, which means Passive; None where it is not streamed."""
        self.offset = 1 if reading == PASSIVE + 1 else 0
        self.mode = self._commanded = "passive"

    def command(self, t: float, mode: str) -> None:
        """That mode is commanded at `t`."""
        self._commanded, self._commanded_t = mode, t
        self._mute_s = 0.0

    def update(self, t: float, elapsed: float, values: Mapping[int, int], told_mm_s: Sequence[int]) -> str:
        """Take a frame; returns the mode.

        Parameters
        ----------
        t, elapsed : float
            Seconds: now, and since the frame before.
        values : mapping
            Raw values by packet id.
        told_mm_s : sequence of int
            What the right and the left wheel were told last.
        """
        for cause in (*hazards(values), *buttons(values)):
            self._causes[cause] = t
        reading = values.get(35)
        self.mode = self._infer(t, elapsed, values, told_mm_s) if reading is None else self._read(reading)
        return self.mode

    def causes(self, t: float) -> list[str]:
        """What could have ended Safe mode lately, in words."""
        for cause in [cause for cause, seen in self._causes.items() if t - seen > RECENT_S]:
            del self._causes[cause]
        return list(self._causes)

    def _read(self, reading: int) -> str:
        if reading == PASSIVE:
            self.offset = 0
        elif reading == FULL + 1:
            self.offset = 1
        mode = reading - self.offset
        self.is_odd = mode not in NAMES
        if reading in (AFTER_CLIFF, AFTER_CLIFF + 1):
            return "passive"
        return NAMES.get(mode, "unknown")

    def _infer(self, t: float, elapsed: float, values: Mapping[int, int], told_mm_s: Sequence[int]) -> str:
        """What was commanded, unless something since then ends Safe mode or the drive commands are not echoed."""
        if self._commanded != "safe":
            return self._commanded
        if t - self._commanded_t < SETTLE_S:
            return self.mode
        moves = any(told_mm_s)
        dropped = values[7] & 12 or (moves and cliffs(values)) or buttons(values)
        if moves and not (values.get(41, 1) or values.get(42, 1)):
            self._mute_s += elapsed
        else:
            self._mute_s = 0.0
        if dropped or self._mute_s >= ECHO_S:
            self._commanded = "passive"
        return self._commanded
