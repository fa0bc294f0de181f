"""Bring every record of the journal to the server: at least once, oldest first, until the server says it has it.

A request names the SHA-256 of its body, the server's answer repeats it, and only then is the record acknowledged: an
answer of something between (a captive portal, a proxy) cannot make a stop disappear. A failure that may pass is tried
again with growing pauses; a record that the server refuses for its content is reported once and offered again rarely,
while the others go on.
"""

from __future__ import annotations

import base64
import json
from typing import Any
from urllib.parse import quote

from .clock import in_thread, now
from .errors import InputError, StorageError, UploadError
from .files import map_from_json
from .journal import Journal
from .journal_records import Upload
from .records import Map
from .sender import LONGEST, Report, Sender, is_final
from .web import WebServer

SOLVING_S = 600.0  # s, a map of a large store takes minutes
LABELS_LIMIT = 4 << 20  # bytes of a list of labels
MAP_LIMIT = 32 << 20  # bytes; a map of 10 000 labels, each seen ten times, has 15 million


class Uploader(Sender):
    """Sends what waits in the journal.

    Parameters
    ----------
    journal : Journal
    server : WebServer
        Where records go.
    retry_s : float
        First pause after a failure in seconds; doubles up to 64 times that.
    timeout_s : float
        Longest wait for an answer in seconds.
    report : callable
        Gets a sentence and its level, once per change of state.
    """

    def __init__(self, journal: Journal, server: WebServer, retry_s: float, timeout_s: float, report: Report) -> None:
        super().__init__("records", server.url, retry_s, report)
        self.journal = journal
        self.server = server
        self.timeout_s = timeout_s
        self._refused: dict[str, float] = {}  # digest -> loop time from which on to offer it again

    async def fetch_map(self, survey: str) -> Map:
        """The server's map of a survey; waits while it is being solved.

        Raises
        ------
        UploadError
            If the server cannot be reached, says why there is no map, or sends something else.
        """
        target = f"{_target(survey)}/map"
        body = await self._exchange("GET", target, timeout_s=max(SOLVING_S, self.timeout_s), limit=MAP_LIMIT)
        try:
            return map_from_json(body, f"the map from {self.url}")
        except InputError as error:
            raise UploadError(str(error), permanent=True) from error

    async def fetch_labels(self, survey: str) -> bytes:
        """The server's list of labels for a survey, see `label_list`; raises UploadError."""
        return await self._exchange("GET", f"{_target(survey)}/labels", limit=LABELS_LIMIT)

    # ---- one round ---------------------------------------------------------------------------------------------------

    async def _send_all(self) -> float | None:
        due: list[float] = []
        held: set[str] = set()  # surveys whose header the server refuses: their stops wait behind it
        for upload in await in_thread(self.journal.pending):
            again = self._refused.get(upload.digest, 0.0)
            if upload.survey in held:
                continue
            if again > now():
                due.append(again)
                if upload.kind == "header":
                    held.add(upload.survey)
                continue
            try:
                await self._send(upload)
                await in_thread(self.journal.acknowledge, upload)
            except StorageError as error:  # the server has it, and says so again when there is room to note that
                return self._failed(str(error))
            except UploadError as error:
                if not error.permanent:
                    return self._failed(str(error))
                if upload.digest not in self._refused:
                    self.report(f"{_name(upload)} is refused and stays on the robot: {error}", "error")
                due.append(now() + LONGEST * self.retry_s)
                self._refused[upload.digest] = due[-1]
                if upload.kind == "header":
                    held.add(upload.survey)
            else:
                self._refused.pop(upload.digest, None)
                self._succeeded()
        return max(self.retry_s, min(due) - now()) if due else None

    async def _send(self, upload: Upload) -> None:
        target = _target(upload.survey)
        if upload.kind == "stop":
            target += f"/legs/{upload.leg}/stops/{upload.stop}"
        hashed = base64.b64encode(bytes.fromhex(upload.digest)).decode()
        headers = {"Content-Type": "application/json", "Content-Digest": f"sha-256=:{hashed}:"}  # RFC 9530
        if upload.replaces is not None:
            headers["If-Match"] = f'"{upload.replaces}"'  # RFC 9110, section 13.1.1
        try:
            answer = await self._exchange("PUT", target, body=upload.body, headers=headers)
        except _MissingError as error:
            if upload.kind == "header":
                raise
            await in_thread(self.journal.send_again, upload.survey)
            raise UploadError(f"{self.url} has lost survey {upload.survey!r}, it gets all of it again") from error
        try:
            received = json.loads(answer)["sha256"]
        except (ValueError, TypeError, KeyError):
            received = None
        if received != upload.digest:
            raise UploadError(
                f"{self.url} does not answer like a robotd-solver; check upload.url and what is in between"
            )

    async def _exchange(self, method: str, target: str, *, timeout_s: float | None = None, **more: Any) -> bytes:
        """One request; returns the answer's body. Every failure is an UploadError that names the server."""
        status, answer = await self.server.exchange(method, target, timeout_s=timeout_s or self.timeout_s, **more)
        if status < 300:
            return answer
        text = f"{self.url} answers {status}: {_reason(answer)}"
        if status == 404:
            raise _MissingError(text, permanent=True)
        raise UploadError(text, permanent=is_final(status))


class _MissingError(UploadError):
    """The server knows nothing under that address."""


def _target(survey: str) -> str:
    return f"/api/surveys/{quote(survey, safe='')}"


def _name(upload: Upload) -> str:
    if upload.kind == "header":
        return f"survey {upload.survey!r}"
    return f"survey {upload.survey!r} leg {upload.leg} stop {upload.stop}"


def _reason(answer: bytes) -> str:
    """The problems that our server lists, or the start of what another one says."""
    try:
        data: Any = json.loads(answer)
        return "; ".join(map(str, data["problems"]))
    except (ValueError, TypeError, KeyError):
        return answer[:200].decode(errors="replace").strip() or "nothing"
