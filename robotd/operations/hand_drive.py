"""Driving by hand over a connection that may be slow, stall, or vanish.

A wish to move is valid for 0.2 s, and the operator's program repeats it. A connection that stalls delivers what it
held back all at once: such wishes are old although they have just come, so the operator's program stamps them with its
own clock. The quickest wish seen so far tells how its clock differs from ours; a wish that took much longer than that
is left out. One client drives at a time.
"""

from __future__ import annotations

import asyncio
import math

from .. import rpc
from ..bus import Bus
from ..clock import now
from ..control_socket import Client
from ..records import OPERATOR, DriveCommand, Withdrawal
from ..rpc import RpcError

LATE_S = 0.25  # slower than the quickest wish by so much: the connection had stalled
DRIFT = 3e-3  # of two computers' clocks against each other, at most
SILENT_S = 1.0  # without a wish for so long the operator has let go


class HandDrive:
    """Turns the wishes of the one client that drives into drive commands.

    Attributes
    ----------
    late : int
        Wishes that were left out because they came late.
    """

    def __init__(self, bus: Bus) -> None:
        self.late = 0
        self._bus = bus
        self._client: Client | None = None
        self._heard = -math.inf
        # our clock minus each client's, for its quickest wish, and when that was: kept while it is connected, because
        # what a stalled connection held back may come after its client was taken for silent
        self._offsets: dict[Client, tuple[float, float]] = {}
        self._timer: asyncio.TimerHandle | None = None

    @property
    def driver(self) -> str | None:
        """Who drives, if anybody does."""
        return None if self._client is None else self._client.who

    def wish(self, client: Client, t: float, speed: float, turn_rate: float) -> bool:
        """Pass on a wish that the client stamped with its own clock; False if it came too late to count.

        Raises RpcError while somebody else drives.
        """
        if self._client is not None and self._client is not client:
            raise RpcError(rpc.REFUSED, f"{self._client.who} is driving; robotctl halt stops the robot at any time")
        if self._client is None:
            self._client = client
            self._timer = asyncio.get_running_loop().call_later(SILENT_S, self._check)
        self._heard = now()
        if self._is_late(client, t):
            self.late += 1
            return False
        self._bus.commands.publish(DriveCommand(self._heard, speed, turn_rate, OPERATOR))
        return True

    def _is_late(self, client: Client, t: float) -> bool:
        here = now()
        offset, before = self._offsets.get(client, (math.inf, here))
        offset = min(offset + DRIFT * (here - before), here - t)
        self._offsets[client] = offset, here
        return here - t - offset > LATE_S

    def gone(self, client: Client) -> None:
        """The client has hung up."""
        self._offsets.pop(client, None)
        if client is self._client:
            self._let_go(f"the connection to {client.who}, who drove, is gone")

    def _check(self) -> None:
        rest = self._heard + SILENT_S - now()
        if rest > 0.0:
            self._timer = asyncio.get_running_loop().call_later(rest, self._check)
        elif self._client is not None:
            self._let_go(f"{self._client.who}, who drove, has been silent for {SILENT_S:g} s")

    def _let_go(self, cause: str) -> None:
        self._client = None
        if self._timer is not None:
            self._timer.cancel()
        self._bus.withdrawals.publish(Withdrawal(now(), OPERATOR, cause))
