"""The real world under the drivers: serial ports, Video4Linux cameras, pins and the computer's date."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from .errors import DriverFault
from .guardian import SOCKET
from .hardware import CameraMode, CameraSource, SerialLink, Ticker
from .link import open_serial
from .ticker import ThreadTicker, prompt_threads
from .v4l2 import V4l2Cameras

log = logging.getLogger(__name__)


class RealHardware:
    """Devices of this computer; see robotd.hardware.Hardware.

    Parameters
    ----------
    guardian : Path
        Socket of the guardian, which owns the serial ports; see robotd.guardian.
    """

    def __init__(self, guardian: Path = SOCKET) -> None:
        self.guardian = guardian
        self._cameras = V4l2Cameras()
        self._pins: Any = None
        self._remarks: set[str] = set()

    @property
    def pins(self) -> Any:
        """gpiozero's default pin factory: that of lgpio on a Pi."""
        if self._pins is None:
            self._pins = _open_pins()
        return self._pins

    def ticker(self, period: float, function: Callable[[int], None]) -> Ticker:
        """In a thread of its own."""
        return ThreadTicker(period, function)

    async def open_serial(self, port: str, baud: int) -> SerialLink:
        """Borrow a serial port from the guardian, for this process alone."""
        link = await open_serial(port, baud, self.guardian)
        if link.remark and link.remark not in self._remarks:
            self._remarks.add(link.remark)  # once, and not at every reconnection
            log.info("%s", link.remark)
        return link

    async def open_camera(self, device: str, name: str, mode: CameraMode) -> CameraSource:
        """Open a Video4Linux camera and start it; raises DriverFault with the reason and the mend."""
        return await self._cameras.open(device, name, mode)

    def utc(self) -> datetime:
        """The computer's date."""
        return datetime.now(UTC)

    def boot_id(self) -> str:
        """The kernel's id of this boot."""
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()

    def is_synchronised(self) -> bool:
        """Whether systemd-timesyncd has set the clock since the boot."""
        return Path("/run/systemd/timesync/synchronized").exists()


def _open_pins() -> Any:
    """gpiozero's default factory; the libraries that it tries in vain become part of the error."""
    from gpiozero import Device
    from gpiozero.exc import GPIOZeroError

    with warnings.catch_warnings(record=True) as tried:
        warnings.simplefilter("always")
        try:
            with prompt_threads():  # because lgpio starts the thread of its timed pulses here
                Device.ensure_pin_factory()
        except (GPIOZeroError, OSError) as error:
            why = "; ".join(dict.fromkeys(str(warning.message) for warning in tried))
            raise DriverFault(
                f"no pins: {error}{f' ({why})' if why else ''}; this needs a Raspberry Pi with the package "
                "python3-lgpio, /dev/gpiochip0, and the user in the group gpio"
            ) from error
    return Device.pin_factory
