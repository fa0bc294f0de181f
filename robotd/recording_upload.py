"""Bring finished recordings to the server, piece by piece, going on where a cut connection ended.

The server acknowledges a piece when its disk has it, and the whole when its hash is right; only then is the recording
marked as uploaded (a file beside it), and deleted if that is wanted. Sending again what the server has costs
one question. No more than one piece is ever in memory. What the server refuses is offered again rarely: its limits may
have been raised.
"""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

from .clock import in_thread, now
from .errors import InputError, UploadError
from .files import write_atomic
from .sender import LONGEST, Report, Sender, is_final
from .web import WebServer

PIECE = 1 << 20  # bytes


class RecordingUploader(Sender):
    """Sends the finished recordings of a folder, oldest name first.

    Parameters
    ----------
    directory : Path
        Where "*.mcap" lie.
    server : WebServer
        Where they go.
    retry_s, timeout_s : float
        First pause after a failure, which doubles up to 64 times that; longest wait for an answer.
    delete : bool
        Delete what the server has.
    report : callable
        Gets a sentence and its level, once per change of state.
    """

    def __init__(
        self,
        directory: Path,
        server: WebServer,
        *,
        retry_s: float,
        timeout_s: float,
        delete: bool,
        report: Report,
    ) -> None:
        super().__init__("recordings", server.url, retry_s, report)
        self.directory = directory
        self.server = server
        self.timeout_s = timeout_s
        self.delete = delete
        self._refused: dict[str, float] = {}  # name -> loop time from which on to offer it again

    async def _send_all(self) -> float | None:
        waiting = await in_thread(self._waiting)
        self._refused = {path.stem: self._refused[path.stem] for path in waiting if path.stem in self._refused}
        due: list[float] = []
        for path in waiting:
            again = self._refused.get(path.stem, 0.0)
            if again > now():
                due.append(again)
                continue
            try:
                await self._send(path)
            except UploadError as error:
                if not error.permanent:
                    return self._failed(str(error))
                if path.stem not in self._refused:
                    self.report(f"{path.name} is refused and stays on the robot: {error}", "error")
                due.append(now() + LONGEST * self.retry_s)
                self._refused[path.stem] = due[-1]
            else:
                self._refused.pop(path.stem, None)
        return max(self.retry_s, min(due) - now()) if due else None

    def _waiting(self) -> list[Path]:
        files = sorted(self.directory.glob("*.mcap")) if self.directory.is_dir() else []
        return [path for path in files if not uploaded_mark(path).exists()]

    async def _send(self, path: Path) -> None:
        """Bring one recording to the server; raises UploadError."""
        try:
            size, digest = await in_thread(_measure, path)
        except OSError as error:
            raise UploadError(f"{path}: cannot be read: {error.strerror or error}", permanent=True) from error
        target = f"/api/recordings/{quote(path.stem, safe='')}"
        at, complete = await self._exchange("GET", f"{target}?size={size}&sha256={digest.hex()}")
        while not complete:
            before = at
            try:
                body = await in_thread(_read, path, at)
            except OSError as error:
                raise UploadError(f"{path}: cannot be read: {error.strerror or error}", permanent=True) from error
            if not body and size:
                raise UploadError(f"{path}: has become shorter while it was sent", permanent=True)
            headers = {
                "Content-Type": "application/octet-stream",
                "Content-Range": f"bytes {at}-{at + len(body) - 1}/{size}",
                "Content-Digest": _spelled(hashlib.sha256(body).digest()),
                "Repr-Digest": _spelled(digest),
            }
            at, complete = await self._exchange("PUT", target, body=body, headers=headers)
            if at <= before and not complete:
                raise UploadError(f"{self.url} has lost a part of {path.name}, it gets that again")
            self._succeeded()
        try:
            await in_thread(_settle, path, self.url, digest, delete=self.delete)
        except (InputError, OSError) as error:
            raise UploadError(f"{path.name} is on the server, which cannot be noted: {error}") from error
        self.report(f"{path.name} is on the server ({size / 1e6:.1f} MB)", "info")

    async def _exchange(self, method: str, target: str, **more: Any) -> tuple[int, bool]:
        """One request; returns the bytes that the server has, and whether it has the whole. Raises UploadError."""
        status, answer = await self.server.exchange(method, target, timeout_s=self.timeout_s, **more)
        try:
            said = json.loads(answer)
        except ValueError:
            said = None
        received = said.get("received") if isinstance(said, dict) else None
        if isinstance(received, int) and status in (200, 201, 409):
            return received, said.get("complete") is True
        problems = said.get("problems") if isinstance(said, dict) else None
        why = "; ".join(map(str, problems)) if isinstance(problems, list) else "not as a robotd-solver does"
        raise UploadError(
            f"{self.url} answers {status}: {why}",
            permanent=problems is not None and is_final(status),
        )


def _measure(path: Path) -> tuple[int, bytes]:
    """Size and SHA-256 of a file."""
    size, digest = 0, hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(PIECE):
            size += len(block)
            digest.update(block)
    return size, digest.digest()


def _read(path: Path, start: int) -> bytes:
    with path.open("rb") as file:
        file.seek(start)
        return file.read(PIECE)


def uploaded_mark(path: Path) -> Path:
    """The file whose being there says that the server has this recording."""
    return path.with_name(path.name + ".uploaded")


def _settle(path: Path, url: str, digest: bytes, *, delete: bool) -> None:
    if delete:
        path.unlink(missing_ok=True)
    else:
        write_atomic(uploaded_mark(path), json.dumps({"url": url, "sha256": digest.hex()}).encode())


def _spelled(digest: bytes) -> str:
    return f"sha-256=:{base64.b64encode(digest).decode()}:"
