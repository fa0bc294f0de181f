"""The journal's records as bytes, and what it says of surveys, stops and events at a glance."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from typing import Literal

import msgspec
import numpy as np

from .records import MissionState, Stop, Survey


@dataclass(frozen=True, slots=True)
class Upload:
    """One record as the server gets it: `body` is JSON, `digest` its SHA-256 in hexadecimal.

    `leg` and `stop` are 0 for a survey's header. `replaces` is the digest of the content that the server may have
    instead, and is to give up.
    """

    kind: Literal["header", "stop"]
    survey: str
    leg: int
    stop: int
    body: bytes
    digest: str
    replaces: str | None = None


@dataclass(frozen=True, slots=True)
class SurveySummary:
    """A survey at a glance: how many legs with stops, stops, rejected ones, and records the server has not got."""

    created: str | None
    legs: int
    stops: int
    rejected: int
    waiting: int


@dataclass(frozen=True, slots=True)
class StopSummary:
    """A stop, whether the server has it, why an operator rejected it (then it has no sightings), and what is doubtful
    about it."""

    stop: Stop
    is_uploaded: bool
    rejected: str | None
    flag: str | None = None


@dataclass(frozen=True, slots=True)
class MissionNote:
    """How far mission `number` has come at time `t`: its state, the stop at which it is or to which it drives, and
    metres along the line. `memory` is what it has learnt of the labels (JSON); None: what was noted before. `paused`
    is why it stands still, if it is paused."""

    number: int
    state: MissionState
    stop: int
    along: float
    t: float
    memory: bytes | None = None
    paused: str | None = None


@dataclass(frozen=True, slots=True)
class Unfinished:
    """A mission that ended without saying so: `note` is its last one, of the boot `boot`; `leg` its first leg."""

    survey: str
    leg: int
    first_stop: int
    is_attended: bool
    plan: str
    note: MissionNote
    boot: str | None


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """An event of the journal: its number, its date (ISO 8601, UTC) and whether the clock was known to be right."""

    number: int
    utc: str
    is_sure: bool
    source: str
    level: str
    text: str


def header_body(header: Survey) -> bytes:
    """A survey's header as it is sent: the JSON of `robotd-survey/1` without `stops`."""
    data = msgspec.to_builtins(header, enc_hook=_plain)
    del data["stops"]
    body = msgspec.json.encode(data)
    _check_body(body, read_header, replace(header, stops=()), f"header of survey {header.survey!r}")
    return body


def stop_body(stop: Stop) -> bytes:
    """A stop as it is sent: one entry of `stops` in `robotd-survey/1`; raises ValueError if it does not read back."""
    body = msgspec.json.encode(stop, enc_hook=_plain)
    _check_body(body, lambda data: msgspec.json.decode(data, type=Stop), stop, f"leg {stop.leg} stop {stop.stop}")
    return body


def digest(body: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(body).hexdigest()


def name_problem(name: str) -> str | None:
    """Why a survey cannot have this name, or None: it must survive in an address and fit a file name."""
    if not 1 <= len(name.encode(errors="replace")) <= 60:
        return "a name has 1 to 60 bytes"
    if name.strip(".") == "" or any(not char.isprintable() or char in "/\\" for char in name):
        return "a name has printable characters, no slashes, and not only dots"
    return None


def _plain(value: object) -> object:
    """Numpy's numbers as Python's."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def date_after(utc: str | None, seconds: float | None) -> str:
    if utc is None or seconds is None:
        return ""
    return (datetime.fromisoformat(utc) + timedelta(seconds=seconds)).isoformat(timespec="milliseconds")


def read_header(body: bytes) -> Survey:
    return msgspec.json.decode(body[:-1] + b',"stops":[]}', type=Survey)


def _check_body(body: bytes, read: object, record: object, what: str) -> None:
    """Refuse what JSON cannot carry (NaN becomes null), while the caller can still be found."""
    try:
        same = read(body) == record  # type: ignore[operator]
    except msgspec.ValidationError as error:
        raise ValueError(f"{what}: {error}; a number in it is not finite or of the wrong type") from error
    if not same:
        raise ValueError(f"{what}: does not read back as it was written")
