"""What a Roomba prints about itself among the sensor data, and what is known about that firmware.

A reset, the end of a charge and falling asleep make the robot print text on the line of the stream. A release is
named in it as `r3_robot/tags/release-3.2.6:4975 CLEAN` or `r3-robot/tags/release-stm32-3.7.7:6913 CLEAN`; some robots
print nothing at all, so that an unknown firmware is as good as any.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

KEEP_ALIVE_S = 60.0  # Open Interface 2016, "Power saving": one wake pulse a minute
KEEP_ALIVE_SLEEPY_S = 30.0
SLEEPY = (3, 2, 6)  # Create 2 and Roomba 620: sleeps in spite of a pulse a minute
DISTANCE_FIXED = (3, 3, 0)  # packet 19, appendix B of the manual of 2016
ANGLE_BROKEN = (3, 4, 0)  # packet 20 up to this release
LOOKED_AT = 16  # bytes that tell text from noise

_RELEASE = re.compile(
    rb"tags/release[-_](?P<chip>[a-z][a-z0-9]{0,15}[-_])?(?P<version>\d{1,3}\.\d{1,3}\.\d{1,3})(?=[^0-9])"
)
_SIGNS: tuple[tuple[bytes, Literal["reset", "sleep"]], ...] = (
    (b"Soft reset!", "reset"),
    (b"processor-sleep", "sleep"),
)


@dataclass(frozen=True, slots=True)
class Firmware:
    """One release: `chip` is "" or e.g. "stm32"."""

    version: tuple[int, int, int]
    chip: str = ""

    @property
    def name(self) -> str:
        """As the robot prints it, e.g. stm32-3.7.7."""
        number = ".".join(map(str, self.version))
        return f"{self.chip}-{number}" if self.chip else number

    @property
    def traps(self) -> tuple[str, ...]:
        """What this release is known to do otherwise than its manual says, in words."""
        found = []
        if self.version == SLEEPY:
            found.append("it may fall asleep in spite of wake pulses")
        if self.version < DISTANCE_FIXED:
            found.append("its own distance (packet 19) is wrong")
        if self.version <= ANGLE_BROKEN:
            found.append("its own angle (packet 20) is wrong")
        return tuple(found)


def keep_alive_s(firmware: Firmware | None) -> float:
    """Seconds between two wake pulses that keep a robot with this firmware (None: unknown) awake."""
    return KEEP_ALIVE_SLEEPY_S if firmware is not None and firmware.version == SLEEPY else KEEP_ALIVE_S


class BannerReader:
    """Reads the robot's text out of the bytes that belong to no frame, however they are cut.

    Attributes
    ----------
    firmware : Firmware or None
        The last release that was read.
    """

    KEEP = 256  # bytes: longer than any line of the banner

    def __init__(self) -> None:
        self.firmware: Firmware | None = None
        self._text = bytearray()
        self._last = b""

    @property
    def is_text(self) -> bool:
        """Whether what was fed last is text: so it was heard at the right baud rate."""
        return len(self._last) == LOOKED_AT and all(32 <= byte < 127 or byte in b"\r\n" for byte in self._last)

    def feed(self, data: bytes) -> list[Firmware | Literal["reset", "sleep"]]:
        """Take skipped bytes; returns releases, and "reset" or "sleep" where the robot announced it, in order."""
        text = self._text
        text += data
        self._last = (self._last + data)[-LOOKED_AT:]
        found: list[tuple[int, int, Firmware | Literal["reset", "sleep"]]] = []
        for match in _RELEASE.finditer(text):
            major, minor, patch = map(int, match["version"].split(b"."))
            chip = (match["chip"] or b"").decode("ascii").rstrip("-_")
            self.firmware = Firmware((major, minor, patch), chip)
            found.append((match.start(), match.end(), self.firmware))
        for sign, meaning in _SIGNS:
            at = text.find(sign)
            while at >= 0:
                found.append((at, at + len(sign), meaning))
                at = text.find(sign, at + len(sign))
        found.sort(key=lambda item: item[0])
        if found:
            del text[: found[-1][1]]
        del text[: -self.KEEP]
        return [item for _, _, item in found]
