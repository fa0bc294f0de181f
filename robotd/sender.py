"""Bringing what waits on the disk to a server, again and again: what the two uploaders share.

A failure that may pass is tried again with growing pauses, and told once; whoever has something new wakes the sender.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Literal

LONGEST = 64  # times retry_s: the longest pause
PASSING = (400, 401, 403, 408, 429)  # damaged on the way, a token to be mended on either side, "later"

Report = Callable[[str, Literal["info", "warning", "error"]], None]


def is_final(status: int) -> bool:
    """Whether an answer says that sending the same again cannot succeed."""
    return 400 <= status < 500 and status not in PASSING


class Sender:
    """Offers all that waits, until the server has it.

    Parameters
    ----------
    what : str
        What is sent, in the plural, for words.
    url : str
        Of the server.
    retry_s : float
        First pause after a failure in seconds; doubles up to 64 times that.
    report : callable
        Gets a sentence and its level, once per change of state.
    """

    def __init__(self, what: str, url: str, retry_s: float, report: Report) -> None:
        self.url = url
        self.retry_s = retry_s
        self.report = report
        self._what = what
        self._wake = asyncio.Event()
        self._empty = asyncio.Event()
        self._factor = 1
        self._trouble: str | None = None

    @property
    def trouble(self) -> str | None:
        """Why nothing can be sent now, in words."""
        return self._trouble

    def wake(self) -> None:
        """Say that something new waits."""
        self._empty.clear()
        self._wake.set()

    async def wait_empty(self) -> None:
        """Wait until the server has everything that waited at the last `wake`."""
        await self._empty.wait()

    async def run(self) -> None:
        """Send until cancelled."""
        while True:
            self._wake.clear()
            pause = await self._send_all()
            if pause is None and not self._wake.is_set():
                self._empty.set()
            try:
                async with asyncio.timeout(pause):
                    await self._wake.wait()
            except TimeoutError:
                pass

    async def _send_all(self) -> float | None:
        """Offer everything once; returns seconds until the next try is due, None if nothing is left."""
        raise NotImplementedError

    def _failed(self, trouble: str) -> float:
        """The pause after a failure that may pass."""
        pause = self.retry_s * self._factor
        self._factor = min(2 * self._factor, LONGEST)
        if trouble != self._trouble:
            self.report(f"{trouble}; {self._what} are kept and sent again", "warning")
        self._trouble = trouble
        return pause

    def _succeeded(self) -> None:
        if self._trouble is not None:
            self.report(f"{self.url} takes {self._what} again", "info")
        self._trouble = None
        self._factor = 1
