"""Recordings that robots send, piece by piece, into files of any size.

    <data>/recordings/<name>.mcap       a whole recording, whose hash was checked
    <data>/recordings/<name>.json       its size and hash, written before the first piece
    <data>/recordings/<name>.part       what has come of it so far

A piece is on the disk before it is acknowledged, and a sender that lost its connection asks where to go on. The hash of
the whole is computed as pieces come; after a restart of the server the file is read once more for it.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ..errors import InputError
from ..files import write_atomic
from .store import ConflictError, StoreError, sync_folder

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,119}")
BLOCK = 1 << 20
PIECE_LIMIT = 8 << 20  # bytes


class OffsetError(InputError):
    """A piece does not begin where the last one ended.

    Attributes
    ----------
    received : int
        Bytes that are here: where to go on.
    """

    def __init__(self, message: str, received: int) -> None:
        super().__init__(message)
        self.received = received


class TooLargeError(InputError):
    """More than this server takes."""


class Plan(msgspec.Struct, frozen=True):
    """What a recording is to be in the end; `sha256` in hexadecimal digits."""

    size: int
    sha256: str


@dataclass
class _Growing:
    """The hash of the first `size` bytes of a part."""

    hash: Any
    size: int


class RecordingStore:
    """Recordings in a folder, which is made when the first one comes; every method may be called from any thread.

    Parameters
    ----------
    data : Path
        The server's folder.
    limit : int
        Bytes that one recording may have.
    keep_free : int
        Bytes that the disk shall keep free.
    """

    def __init__(self, data: Path, limit: int = 16 << 30, keep_free: int = 1 << 30) -> None:
        self._folder = data / "recordings"
        self._limit = limit
        self._keep_free = keep_free
        self._growing: dict[str, _Growing] = {}
        self._lock = threading.RLock()

    def received(self, name: str, plan: Plan | None = None) -> tuple[int, bool]:
        """How many bytes of a recording are here, and whether it is complete; with a `plan`, of that content."""
        with self._lock:
            known = self._plan(name)
            if known is None or plan not in (None, known):
                return 0, False
            if self._whole(name).exists():
                return known.size, True
            return _size(self._part(name)), False

    def list(self) -> dict[str, Plan]:
        """The complete recordings."""
        files = sorted(self._folder.glob("*.mcap")) if self._folder.is_dir() else []
        return {path.stem: plan for path in files if (plan := self._plan(path.stem)) is not None}

    def put(self, name: str, plan: Plan, start: int, body: bytes) -> tuple[int, bool]:
        """Take the piece that begins at byte `start`; returns what `received` would.

        Raises
        ------
        InputError
            The name or the piece is wrong, or the whole has another hash than planned: it is forgotten then, and has to
            be sent again from its begin.
        ConflictError
            There is a complete recording of this name with another content.
        OffsetError
            The piece does not begin where the last one ended.
        TooLargeError, StoreError
            It is more than is taken, or the disk does not take it.
        """
        where = f"recording {name}"
        if not NAME.fullmatch(name):
            raise InputError(f"{name[:60]!r}: expected letters, digits, '.', '_' and '-', at most 120")
        if plan.size > self._limit:
            raise TooLargeError(f"{where}: has {plan.size} bytes; this server takes at most {self._limit}")
        if not 0 <= start <= plan.size or start + len(body) > plan.size:
            raise InputError(f"{where}: bytes {start} to {start + len(body)} of {plan.size}; expected a part of it")
        with self._lock:
            known, part = self._plan(name), self._part(name)
            if self._whole(name).exists():
                if known != plan:
                    raise ConflictError(f"{where}: exists here with another content; choose another name")
                return plan.size, True
            try:
                if known != plan:
                    if start:
                        raise OffsetError(f"{where}: nothing of this content is here yet", 0)
                    self._begin(name, plan)
                have = _size(part)
                if start != have:
                    raise OffsetError(f"{where}: {have} bytes are here, the piece begins at {start}", have)
                if shutil.disk_usage(self._folder).free - len(body) < self._keep_free:
                    raise StoreError(f"{where}: this server's disk has no more room to spare")
                self._append(name, part, start, body)
                if start + len(body) == plan.size:
                    self._complete(name, plan)
                    return plan.size, True
            except OSError as error:
                raise StoreError(f"{where}: cannot be written: {error.strerror or error}") from error
            return start + len(body), False

    def _begin(self, name: str, plan: Plan) -> None:
        if not self._folder.is_dir():
            self._folder.mkdir(parents=True)
            sync_folder(self._folder.parent)
        self._part(name).unlink(missing_ok=True)
        write_atomic(self._folder / f"{name}.json", msgspec.json.encode(plan))
        self._growing[name] = _Growing(hashlib.sha256(), 0)

    def _append(self, name: str, part: Path, start: int, body: bytes) -> None:
        with part.open("r+b" if part.exists() else "x+b") as file:
            file.seek(start)
            file.write(body)
            file.flush()
            os.fsync(file.fileno())
        growing = self._growing.get(name)
        if growing is not None and growing.size == start:
            growing.hash.update(body)
            growing.size += len(body)

    def _complete(self, name: str, plan: Plan) -> None:
        """Check the hash and give the file its name."""
        part, growing = self._part(name), self._growing.pop(name, None)
        digest = growing.hash if growing is not None and growing.size == plan.size else _hash(part)
        if digest.hexdigest() != plan.sha256:
            part.unlink()
            (self._folder / f"{name}.json").unlink()
            raise InputError(f"recording {name}: what came has another hash than was announced; send it again")
        part.replace(self._whole(name))
        sync_folder(self._folder)

    def _plan(self, name: str) -> Plan | None:
        if not NAME.fullmatch(name):
            return None
        try:
            return msgspec.json.decode((self._folder / f"{name}.json").read_bytes(), type=Plan)
        except (OSError, msgspec.MsgspecError):
            return None

    def _part(self, name: str) -> Path:
        return self._folder / f"{name}.part"

    def _whole(self, name: str) -> Path:
        return self._folder / f"{name}.mcap"


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _hash(path: Path) -> Any:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(BLOCK):
            digest.update(block)
    return digest
