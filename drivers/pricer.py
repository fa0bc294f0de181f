"""The label system, reached through `robotd-labels` (robotd.gateway) on its server."""

from __future__ import annotations

import asyncio
import json
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..bind import ranged
from ..clock import outside
from ..errors import DriverFault
from ..plugin import Driver
from ..secret_file import driver_secret

AT_ONCE = 500  # labels in one request, the gateway's limit


@dataclass(frozen=True, slots=True, kw_only=True)
class PricerConfig:
    """[drivers.<instance>] of the label system."""

    host: str = "127.0.0.1"
    port: int = ranged(minimum=1, maximum=65535)
    token_file: Path | None = None
    token_credential: str | None = None
    timeout_s: float = ranged(5.0, minimum=0.1, maximum=60.0)

    def __post_init__(self) -> None:
        if not self.host:
            raise ValueError("host = ''; expected the name or address of the label system's server")
        if None not in (self.token_file, self.token_credential):
            raise ValueError("found token_file and token_credential; expected one of them")


class PricerDriver(Driver):
    """Asks the label system for flashes; see robotd.plugin.Labels.

    One connection is kept and made again when it breaks. A request that was under way then is sent again under the
    same key, and the gateway obeys a key once.
    """

    kind = "labels"
    Config = PricerConfig
    config: PricerConfig

    async def open(self) -> None:
        """Connect, and check that the gateway takes our token and requests; raises DriverFault."""
        config = self.config
        self._token = driver_secret(config.token_file, config.token_credential, f"{self.name} token_file")
        self._number = 0
        self._turn = asyncio.Lock()
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._broken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.resources.callback(self._disconnect)
        reply = await self._ask({"method": "status"})
        if (cause := _cause(reply)) is not None:
            raise self._fault(f"refuses: {cause}")

    async def run(self) -> None:
        """Wait until a request fails; raises its DriverFault."""
        await self._broken

    async def flash(self, labels: Sequence[str], strength: float, durations: Sequence[int]) -> Mapping[str, str]:
        """Ask that `labels` flash, in this order, for their whole seconds of `durations`, at `strength` 0..1.

        Returns when the request lies on the disk of the label system's server: the labels that were refused, each with
        the reason.

        Raises
        ------
        DriverFault
            The gateway is not reached, or takes no request at all: its queue is full, its folder cannot be written, or
            the token is wrong. It is asked again when it says that this is mended.
        """
        refused: dict[str, str] = {}
        for start in range(0, len(labels), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            key = uuid.uuid4().hex
            request = {"method": "flash", "labels": list(labels[part]), "strength": strength, "key": key}
            try:
                reply = await self._ask({**request, "duration": [int(length) for length in durations[part]]})
                if (cause := _cause(reply)) is not None:
                    raise self._fault(f"refuses: {cause}")
            except DriverFault as fault:
                if not self._broken.done():
                    self._broken.set_exception(DriverFault(str(fault)))
                    self._broken.exception()  # it need not be fetched: the caller has its own
                raise
            refused.update(reply.get("refused", {}))
        return refused

    async def listed(self) -> str:
        """The label system's own list of its labels, as text; raises DriverFault if the gateway has none."""
        pieces: list[str] = []
        start, date = 0, None
        while True:
            reply = await self._ask({"method": "labels", "start": start})
            if (cause := _cause(reply)) is not None:
                raise self._fault(f"refuses: {cause}")
            if date not in (None, reply.get("date")):  # it was written meanwhile: from the beginning
                pieces, start, date = [], 0, None
                continue
            text, following, date = reply.get("text"), reply.get("next"), reply.get("date")
            if not isinstance(text, str) or not (following is None or (text and following == start + len(text))):
                raise self._fault("does not answer like robotd-labels; check host and port")
            pieces.append(text)
            if following is None:
                return "".join(pieces)
            start = following

    async def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        async with self._turn:
            try:
                if self._streams is not None:
                    with suppress(ConnectionError, EOFError, TimeoutError):  # it had died, or a firewall forgot it
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
            if (
                not isinstance(reply, dict)
                or reply.get("id") != self._number
                or not _is_table(reply.get("refused", {}))
            ):
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


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())


def _cause(reply: Mapping[str, Any]) -> str | None:
    """Why the gateway takes no request, or None if it does."""
    if not reply.get("ok"):
        return str(reply.get("error", "without a reason"))
    return None if reply.get("trouble") is None else str(reply["trouble"])
