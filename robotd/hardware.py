"""The world under the drivers: serial links, cameras, pins and the date.

Drivers get everything they touch from a `Hardware`. `RealHardware` opens devices; the simulator's `SimHardware`
(robotd.sim.hardware) speaks the same bytes and renders the same pixels, and nothing above this module can tell.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Protocol

from .records import Frame


class SerialLink(Protocol):
    """An open serial line, 8N1. Every method raises DriverFault when the device is gone."""

    async def read(self) -> tuple[float, bytes]:
        """Wait for bytes; returns (loop time at which the last of them arrived, at least one byte)."""

    def write(self, data: bytes) -> None:
        """Queue bytes for sending; never blocks."""

    def set_baud(self, baud: int) -> None:
        """Change the speed of both directions."""

    def pulse_wake(self, seconds: float) -> None:
        """Hold the wake line (BRC) low for so long, in the background; a link without that line ignores it."""

    def rest(self, seconds: float) -> None:
        """Bytes may gather for so long before `read` returns them, which saves waking up; 0 ends that."""

    def close(self) -> None:
        """Send what is queued, then release the device; safe to call twice."""


@dataclass(frozen=True, slots=True)
class CameraMode:
    """What a camera is asked for: size in pixels (width, height), frames per second, exposure in seconds.

    `gain` is in the camera's own units; None: its default. Lamps flicker at twice `mains_hz`.
    """

    size: tuple[int, int] = (640, 480)
    fps: float = 30.0
    exposure: float = 0.010
    gain: float | None = None
    mains_hz: float = 50.0


def flicker_free(exposure: float, mains_hz: float) -> float:
    """The exposure in seconds, at least one period of the lamps' flicker, that is nearest and of whole periods."""
    period = 0.5 / mains_hz
    return max(1, round(exposure / period)) * period


def is_flicker_free(exposure: float, mains_hz: float) -> bool:
    """Whether an exposure of so many seconds has whole periods of the lamps' flicker, within 3 %."""
    return math.isclose(exposure, flicker_free(exposure, mains_hz), rel_tol=0.03)


@dataclass(slots=True)
class CameraCounts:
    """What became of a camera's frames since it was opened; `decode_s` is the sum over those that were decoded."""

    decoded: int = 0
    decode_s: float = 0.0
    damaged: int = 0  # arrived, but not as a whole image of the right size
    lost: int = 0  # never arrived
    dropped: int = 0  # were replaced by newer ones before anybody took them


class CameraSource(Protocol):
    """An open, running camera. Every method raises DriverFault when the device is gone."""

    mode: CameraMode  # as negotiated, which may differ from what was asked for
    remarks: tuple[str, ...]  # in words, what the camera does not do as it was asked
    counts: CameraCounts

    async def read(self) -> Frame:
        """Wait for the next frame; when nobody reads, the oldest waiting ones are dropped."""

    def close(self) -> None:
        """Stop streaming and release the device; safe to call twice."""


class Ticker(Protocol):
    """Calls a function at even times until it is closed."""

    async def wait(self) -> None:
        """Until the function failed: raises what it raised."""

    def close(self) -> None:
        """No call begins after this; safe to call twice."""


class Hardware(Protocol):
    """Where drivers get their devices from."""

    @property
    def pins(self) -> Any:
        """A gpiozero pin factory; raises DriverFault where there are no pins."""

    def ticker(self, period: float, function: Callable[[int], None]) -> Ticker:
        """Call function(k) at start + k * period for k = 0, 1, ...: absolute deadlines, so there is no drift.

        What is late by whole periods is left out, and the number says so. The function may be called in another
        thread, because the loop can be busy: it must be short and touch nothing but its pins.
        """

    async def open_serial(self, port: str, baud: int) -> SerialLink:
        """Open a serial port exclusively; raises DriverFault with the reason and the mend."""

    async def open_camera(self, device: str, name: str, mode: CameraMode) -> CameraSource:
        """Open a camera and start it; `name` goes into its frames. Raises DriverFault with the reason and the mend."""

    def utc(self) -> datetime:
        """The date, time-zone aware: the only source of dates in the daemon."""

    def boot_id(self) -> str:
        """Names this start of the computer: loop times of different boots cannot be compared."""

    def is_synchronised(self) -> bool:
        """Whether `utc` is known to be right (a Pi has no clock of its own)."""
