"""Keeping a driver open: what fails is closed, reported, and opened again."""

from __future__ import annotations

import asyncio
import contextlib

from .camera_driver import first_of
from .clock import now
from .errors import DriverFault
from .plugin import Driver

FIRST_RETRY_S, LAST_RETRY_S = 0.5, 30.0


class Supervisor:
    """Keeps one driver open: a DriverFault closes it, is reported, and it is opened again with growing back-off.

    Attributes
    ----------
    fault : str or None
        Why the driver does not work now, in words.
    is_off : bool
        An operator has switched it off; see `switch`.
    """

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.fault: str | None = f"{driver.name}: not opened yet"
        self.restarts = 0
        self.is_off = False
        self._again = asyncio.Event()
        self._next: Driver | None = None

    def restart(self, driver: Driver | None = None) -> None:
        """Close the driver and open it again now, or this one in its place."""
        self._next = driver
        self._again.set()

    def switch(self, *, on: bool) -> None:
        """Close the driver, or open it again."""
        if self.is_off == on:
            self.is_off = not on
            self.restart()

    async def run(self) -> None:
        """Until cancelled."""
        delay = FIRST_RETRY_S
        while True:
            opened: float | None = None
            if self._again.is_set():
                self._again.clear()
                self.driver, self._next = self._next or self.driver, None
                delay = FIRST_RETRY_S
            if self.is_off:
                self.fault = None
                await self._again.wait()
                continue
            try:
                await self.driver.open()
                self.fault = None
                opened = now()
                await first_of(self.driver.run(), self._again.wait())
                if self._again.is_set():
                    self.fault = f"{self.driver.name}: is being restarted"
                    self.restarts += 1
                    continue
                raise DriverFault(f"{self.driver.name}: stopped by itself")
            except DriverFault as fault:
                text = str(fault).removeprefix(f"{self.driver.name}: ")
                self.fault = f"{self.driver.name}: {text}"
                self.driver.report(f"{text}; trying again in {delay:g} s", "error")
            finally:
                await self.driver.close()
            if opened is not None and now() - opened > 10 * LAST_RETRY_S:
                delay = FIRST_RETRY_S
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(delay):
                    await self._again.wait()
            delay = min(2 * delay, LAST_RETRY_S)
            self.restarts += 1
