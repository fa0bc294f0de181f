"""The server's surveys on disk: one folder a survey, one file a record, each written whole or not at all.

    <data>/surveys/<name>/header.json       the robot's bytes, as they came
    <data>/surveys/<name>/stop-1-3.json     leg 1, stop 3, as it came
    <data>/surveys/<name>/map-<revision>.json
    <data>/labels/<name>.txt, <data>/labels.txt   the labels to look for, if robots ask; written by the operator

A record is on the disk before it is acknowledged. The same record again is welcome; another content for a record that
exists is refused, because somebody has already acted on the first one.
"""

from __future__ import annotations

import hashlib
import os
import re
import threading
from pathlib import Path
from urllib.parse import quote, unquote

import msgspec

from .. import __version__
from ..errors import InputError, RobotdError
from ..files import header_from_json, stop_from_json, write_atomic
from .roof import join_roof

_STOP = re.compile(r"stop-(\d+)-(\d+)\.json")
_LONGEST_NAME = 200  # bytes of a folder's name, below every file system's limit


class UnknownSurveyError(InputError):
    """No such survey."""


class ConflictError(InputError):
    """The record exists with another content."""


class StoreError(RobotdError):
    """The disk did not take or give a record."""


class Store:
    """Surveys in a folder, which is made when the first record comes; every method may be called from any thread."""

    def __init__(self, data: Path) -> None:
        self._data = data
        self._folder = data / "surveys"
        self._lock = threading.RLock()

    def surveys(self) -> dict[str, int]:
        """Names of all surveys, each with its number of stops."""
        with self._lock:
            try:
                folders = sorted(self._folder.iterdir())
            except FileNotFoundError:
                return {}
            return {unquote(path.name): len(_stops(path)) for path in folders if (path / "header.json").is_file()}

    def put_header(self, name: str, body: bytes) -> bool:
        """Keep a survey's header; returns whether it is new.

        Raises
        ------
        InputError
            If it is no valid header, or belongs to another survey; lists every mistake.
        ConflictError
            If the survey has stops that came with another header.
        StoreError
            If the disk does not take it.
        """
        where = f"survey {name!r}"
        header = header_from_json(body, where)
        if header.survey != name:
            raise InputError(f"{where} survey: found {header.survey!r}; expected the name in the address")
        with self._lock:
            folder = self._of(name)
            old = _read(folder / "header.json")
            if old == body:
                return False
            if old is not None and (count := len(_stops(folder))):
                raise ConflictError(
                    f"{where}: its {count} stops came with another header (rig, priors or known labels); "
                    "choose another survey name"
                )
            self._write(folder / "header.json", body)
            return True

    def put_stop(self, name: str, leg: int, stop: int, body: bytes, replaces: str | None = None) -> bool:
        """Keep a stop; returns whether it is new.

        `replaces` is the SHA-256 of the content that this one replaces, because an operator has rejected it.

        Raises
        ------
        UnknownSurveyError
            If the survey's header has not come yet.
        InputError, ConflictError, StoreError
            As `put_header`.
        """
        where = f"survey {name!r} leg {leg} stop {stop}"
        with self._lock:
            folder = self._of(name)
            path = folder / f"stop-{leg}-{stop}.json"
            if (old := _read(path)) == body:
                return False
            record = stop_from_json(body, where, header_from_json(self._header(name), f"survey {name!r}"))
            if (record.leg, record.stop) != (leg, stop):
                raise InputError(f"{where}: found leg {record.leg} stop {record.stop}; expected those in the address")
            if old is not None and hashlib.sha256(old).hexdigest() != replaces:
                raise ConflictError(f"{where}: the server has it with another content, and keeps that")
            self._write(path, body)
            return True

    def survey(self, name: str) -> tuple[bytes, str]:
        """A whole survey as `robotd-survey/1`, and its revision, which changes with every record.

        What roof cameras saw of its stops is in it (robotd.server.roof).

        Raises
        ------
        UnknownSurveyError, StoreError
        InputError
            If a file of the roof cameras is wrong.
        """
        body, _, revision = self._whole(name)
        return body, revision

    def notes(self, name: str) -> tuple[str, ...]:
        """What the roof cameras' part of a survey gives reason to tell the operator; raises as `survey`."""
        return self._whole(name)[1]

    def labels(self, name: str) -> bytes:
        """The labels that a robot shall look for: <data>/labels/<name>.txt, or <data>/labels.txt for all surveys.

        Raises
        ------
        UnknownSurveyError
            If there is neither.
        StoreError
            If it cannot be read.
        """
        own = self._data / "labels" / f"{self._of(name).name}.txt"
        every = self._data / "labels.txt"
        found = _read(own) or _read(every)
        if found is None:
            raise UnknownSurveyError(f"survey {name!r}: no list of labels; write one id a line into {own} or {every}")
        return found

    def roof_status(self) -> bytes:
        """What `robotd-solver roof watch` said last, JSON; {} if it never ran here."""
        return _read(self._data / "roof" / "status.json") or b"{}"

    def _whole(self, name: str) -> tuple[bytes, tuple[str, ...], str]:
        with self._lock:
            header = self._header(name)
            stops = [_read(path) or b"" for _, path in sorted(_stops(self._of(name)).items())]
        table = msgspec.json.decode(header)
        table["stops"] = [msgspec.Raw(stop) for stop in stops]
        revision = hashlib.sha256(__version__.encode())  # another solver makes another map
        for part in (header, *stops):
            revision.update(hashlib.sha256(part).digest())
        plain = msgspec.json.encode(table)
        body, notes = join_roof(plain, f"survey {name!r}", self._data)
        if body is not plain or notes:
            revision.update(hashlib.sha256(body).digest())
            revision.update("\n".join(notes).encode())
        return body, notes, revision.hexdigest()[:32]

    def map(self, name: str, revision: str) -> bytes | None:
        """The map of this revision, if there is one."""
        return _read(self._of(name) / f"map-{revision}.json")

    def put_map(self, name: str, revision: str, body: bytes) -> None:
        """Keep a map and drop those of earlier revisions; raises StoreError."""
        with self._lock:
            folder = self._of(name)
            self._write(folder / f"map-{revision}.json", body)
            for path in folder.glob("map-*.json"):
                if path.name != f"map-{revision}.json":
                    path.unlink(missing_ok=True)

    def _header(self, name: str) -> bytes:
        header = _read(self._of(name) / "header.json")
        if header is None:
            raise UnknownSurveyError(f"survey {name!r}: unknown here; send its header first")
        return header

    def _of(self, name: str) -> Path:
        """The folder of a survey; the name is spelled so that it can be nothing but one folder's name."""
        spelled = quote(name, safe="").replace(".", "%2E")
        if not 0 < len(spelled) <= _LONGEST_NAME:
            raise InputError(f"survey {name[:40]!r}: a name has 1 to {_LONGEST_NAME} bytes when spelled in an address")
        return self._folder / spelled

    def _write(self, path: Path, body: bytes) -> None:
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True)
                for folder in (path.parent.parent, path.parent.parent.parent):
                    sync_folder(folder)
            write_atomic(path, body)
        except OSError as error:
            raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from error
        except InputError as error:
            raise StoreError(str(error)) from error


def _stops(folder: Path) -> dict[tuple[int, int], Path]:
    try:
        paths = list(folder.iterdir())
    except FileNotFoundError:
        return {}
    matches = ((_STOP.fullmatch(path.name), path) for path in paths)
    return {(int(match[1]), int(match[2])): path for match, path in matches if match}


def _read(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise StoreError(f"{path}: cannot be read: {error.strerror or error}") from error


def sync_folder(folder: Path) -> None:
    """Have the disk keep the names in a folder."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
