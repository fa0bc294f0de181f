"""The label system, reached through `robotd-labels` (robotd.gateway) on its server."""

from __future__ import annotations

import asyncio
import json
import uuid
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..bind import ranged
from ..clock import outside
from ..errors import DriverFault, MissionError
from ..plugin import Driver

AT_ONCE = 500  # labels in one request, the gateway's limit


@dataclass(frozen=True, slots=True, kw_only=True)
class PricerConfig:
    """[drivers.<instance>] of the label system."""

    host: str = "127.0.0.1"
    port: int = ranged(minimum=1, maximum=65535)
    token_file: Path | None = None
    timeout_s: float = ranged(5.0, minimum=0.1, maximum=60.0)

    def __post_init__(self) -> None:
        if not self.host:
            raise ValueError("host = ''; expected the name or address of the label system's server")


class PricerDriver(Driver):
    """Asks the label system for flashes; see robotd.plugin.Labels.

    One connection is kept and made again when it breaks. A request that was under way then is sent again under the
    same key, and the gateway obeys a key once.
    """

    kind = "labels"
    Config = PricerConfig
    config: PricerConfig

    async def open(self) -> None:
        """Connect, and check that the gateway takes our token; raises DriverFault."""
        self._token = self._read_token()
        self._number = 0
        self._turn = asyncio.Lock()
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._broken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.resources.callback(self._disconnect)
        reply = await self._ask({"method": "status"})
        if not reply.get("ok"):
            raise self._fault(f"refuses: {reply.get('error', 'without a reason')}")

    async def run(self) -> None:
        """Wait until a request fails; raises its DriverFault."""
        await self._broken

    async def flash(self, labels: Sequence[str], strength: float, duration: float) -> None:
        """Ask that `labels` flash for `duration` whole seconds at `strength` 0..1.

        Returns when the request lies in the folder that the label system watches.

        Raises
        ------
        DriverFault
            The gateway is not reached.
        MissionError
            It refuses this request; the message says why.
        """
        for start in range(0, len(labels), AT_ONCE):
            part = list(labels[start : start + AT_ONCE])
            key = uuid.uuid4().hex
            request = {"method": "flash", "labels": part, "strength": strength, "duration": duration, "key": key}
            try:
                reply = await self._ask(request)
            except DriverFault as fault:
                if not self._broken.done():
                    self._broken.set_exception(DriverFault(str(fault)))
                    self._broken.exception()  # it need not be fetched: the caller has its own
                raise
            if not reply.get("ok"):
                raise MissionError(f"{self.name}: robotd-labels refuses: {reply.get('error', 'without a reason')}")

    def _read_token(self) -> str | None:
        path = self.config.token_file
        if path is None:
            return None
        try:
            return path.read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise DriverFault(f"{self.name}: token_file {path} cannot be read: {error}") from error

    async def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        async with self._turn:
            try:
                if self._streams is not None:
                    with suppress(ConnectionError, EOFError):  # the kept connection had died
                        return await self._exchange(request)
                return await self._exchange(request)
            except TimeoutError as error:
                raise self._fault(f"did not answer within {self.config.timeout_s:g} s") from error
            except EOFError as error:
                raise self._fault("closed the connection") from error
            except OSError as error:
                raise self._fault(f"cannot be reached: {error.strerror or error}") from error

    async def _exchange(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request and read its answer; whatever goes wrong closes the connection."""
        self._number += 1
        line = json.dumps({"id": self._number, "token": self._token, **request}).encode() + b"\n"
        try:
            with outside():
                async with asyncio.timeout(self.config.timeout_s):
                    reader, writer = self._streams = self._streams or await asyncio.open_connection(
                        self.config.host, self.config.port
                    )
                    writer.write(line)
                    await writer.drain()
                    answer = await reader.readline()
            if not answer.endswith(b"\n"):
                raise EOFError
            reply = json.loads(answer)
            if not isinstance(reply, dict) or reply.get("id") != self._number:
                raise ValueError
        except ValueError as error:
            self._disconnect()
            raise self._fault("does not answer like robotd-labels; check host and port") from error
        except BaseException:  # also when cancelled: a late answer must not be taken for the next request's
            self._disconnect()
            raise
        return reply

    def _disconnect(self) -> None:
        streams, self._streams = self._streams, None
        if streams is not None:
            streams[1].close()

    def _fault(self, what: str) -> DriverFault:
        return DriverFault(f"{self.name}: robotd-labels at {self.config.host}:{self.config.port} {what}")
