"""What the robot must not forget: an SQLite file that survives kill -9, power loss and a full card.

Stops and survey headers are written on a connection with `synchronous=FULL`: when `add_stop` returns, the stop is on
the disk, as the very bytes that will be uploaded, with their hash. What only helps to understand a mission afterwards
(trail, slots, events) goes through a second connection with `synchronous=NORMAL`; the next stop makes it durable too.
The upload queue is not a table of its own: it is every header and stop that the server has not acknowledged yet.

Times are loop times (`t`); with the row of `clock` that was newest when they were written they become dates.
"""

from __future__ import annotations

import hashlib
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from .errors import InputError, MissionError
from .records import Event, Stop, Survey

APPLICATION_ID = 0x726F626F  # "robo": tells our files from other SQLite files
VERSION = 1
SCHEMA = f"""
BEGIN IMMEDIATE;
CREATE TABLE clock (id INTEGER PRIMARY KEY, boot TEXT NOT NULL, t REAL NOT NULL, utc TEXT NOT NULL,
    synchronised INTEGER NOT NULL);
CREATE TABLE surveys (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, body BLOB NOT NULL, digest TEXT NOT NULL,
    acknowledged INTEGER NOT NULL DEFAULT 0);
CREATE TABLE legs (id INTEGER PRIMARY KEY, survey INTEGER NOT NULL REFERENCES surveys, leg INTEGER NOT NULL,
    clock INTEGER REFERENCES clock);
CREATE TABLE stops (id INTEGER PRIMARY KEY, survey INTEGER NOT NULL REFERENCES surveys, leg INTEGER NOT NULL,
    stop INTEGER NOT NULL, body BLOB NOT NULL, digest TEXT NOT NULL, acknowledged INTEGER NOT NULL DEFAULT 0,
    UNIQUE (survey, leg, stop));
CREATE TABLE slots (id INTEGER PRIMARY KEY, leg INTEGER NOT NULL REFERENCES legs, stop INTEGER NOT NULL,
    slot INTEGER NOT NULL, started REAL NOT NULL, ended REAL NOT NULL, clock INTEGER REFERENCES clock);
CREATE TABLE events (id INTEGER PRIMARY KEY, t REAL NOT NULL, source TEXT NOT NULL, level TEXT NOT NULL,
    text TEXT NOT NULL, clock INTEGER REFERENCES clock);
CREATE TABLE trail (id INTEGER PRIMARY KEY, leg INTEGER REFERENCES legs, t REAL NOT NULL, x REAL NOT NULL,
    y REAL NOT NULL, heading REAL NOT NULL, clock INTEGER REFERENCES clock);
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {VERSION};
COMMIT;
"""


@dataclass(frozen=True, slots=True)
class Upload:
    """One record as the server gets it: `body` is JSON, `digest` its SHA-256 in hexadecimal.

    `leg` and `stop` are 0 for a survey's header.
    """

    kind: Literal["header", "stop"]
    survey: str
    leg: int
    stop: int
    body: bytes
    digest: str


class Journal:
    """The robot's journal; every method may be called from any thread and blocks until the disk has answered."""

    def __init__(self, path: Path, sure: sqlite3.Connection, quick: sqlite3.Connection) -> None:
        self.path = path
        self.dropped = 0  # rows of trail, slots and events that the disk did not take
        self._sure = sure
        self._quick = quick
        self._lock = threading.RLock()
        self._clock: int | None = None
        self._leg: int | None = None

    @classmethod
    def open(cls, path: Path) -> Journal:
        """Open a journal, or make a new one (and its folder).

        Raises
        ------
        InputError
            If the file is damaged, is no journal, was made by a newer robotd or cannot be opened.
        """
        sure = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            sure = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
            _check(sure, path)
            quick = sqlite3.connect(path, isolation_level=None, check_same_thread=False, timeout=10.0)
            quick.execute("PRAGMA synchronous = NORMAL")
            return cls(path, sure, quick)
        except OSError as error:
            raise InputError(f"{path}: the folder cannot be made: {error.strerror or error}") from error
        except (sqlite3.Error, InputError) as error:
            if sure is not None:
                sure.close()
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{path}: cannot be opened as a journal: {error}; move the file away to begin a new one"
            ) from error

    def close(self) -> None:
        """Release the file; safe to call twice."""
        with self._lock:
            self._quick.close()
            self._sure.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- surveys, legs, stops ----------------------------------------------------------------------------------------

    def begin_leg(self, header: Survey) -> int:
        """Begin a new leg of a survey, and the survey itself if it is new.

        Parameters
        ----------
        header : Survey
            What the survey says besides its stops; a survey that goes on keeps the `created` it has.

        Returns
        -------
        int
            Number of the leg: one more than the last leg that has a stop.

        Raises
        ------
        InputError
            If the name cannot be part of an address, or the survey has stops that were made with another header.
        MissionError
            If the disk does not take it.
        """
        problem = name_problem(header.survey)
        if problem:
            raise InputError(f"survey {header.survey!r}: {problem}; choose another name")
        header = replace(header, stops=())
        with self._transaction():
            row = self._sure.execute("SELECT id, body FROM surveys WHERE name = ?", (header.survey,)).fetchone()
            if row is None:
                body = header_body(header)
                survey = self._sure.execute(
                    "INSERT INTO surveys (name, body, digest) VALUES (?, ?, ?)", (header.survey, body, digest(body))
                ).lastrowid
                last = 0
            else:
                survey = row[0]
                (last,) = self._sure.execute(
                    "SELECT coalesce(max(leg), 0) FROM stops WHERE survey = ?", (survey,)
                ).fetchone()
                self._renew_header(survey, _header(row[1]), header, has_stops=last > 0)
            self._leg = self._sure.execute(
                "INSERT INTO legs (survey, leg, clock) VALUES (?, ?, ?)", (survey, last + 1, self._clock)
            ).lastrowid
        return int(last) + 1

    def _renew_header(self, survey: int, old: Survey, new: Survey, *, has_stops: bool) -> None:
        new = replace(new, created=old.created)
        changed = [field.name for field in fields(new) if getattr(old, field.name) != getattr(new, field.name)]
        if not changed:
            return
        if has_stops:
            raise InputError(
                f"survey {new.survey!r}: its stops were made with other {', '.join(changed)} than now; "
                "choose another survey name, or bring back the calibration it was begun with"
            )
        body = header_body(new)
        self._sure.execute(
            "UPDATE surveys SET body = ?, digest = ?, acknowledged = 0 WHERE id = ?", (body, digest(body), survey)
        )

    def add_stop(self, survey: str, stop: Stop) -> None:
        """Put a finished stop on the disk; the same stop again changes nothing.

        Raises
        ------
        ValueError
            If the survey was not begun, the stop exists with another content, or a number in it is not finite.
        MissionError
            If the disk does not take it.
        """
        body = stop_body(stop)
        key = digest(body)
        with self._transaction():
            row = self._sure.execute("SELECT id FROM surveys WHERE name = ?", (survey,)).fetchone()
            if row is None:
                raise ValueError(f"survey {survey!r} was not begun")
            place = (row[0], stop.leg, stop.stop)
            old = self._sure.execute(
                "SELECT digest FROM stops WHERE survey = ? AND leg = ? AND stop = ?", place
            ).fetchone()
            if old is None:
                self._sure.execute(
                    "INSERT INTO stops (survey, leg, stop, body, digest) VALUES (?, ?, ?, ?, ?)", (*place, body, key)
                )
            elif old[0] != key:
                raise ValueError(
                    f"survey {survey!r}: leg {stop.leg} stop {stop.stop} is in the journal with another content"
                )

    def last_stop(self, survey: str) -> Stop | None:
        """The newest stop of a survey, or None."""
        with self._lock:
            row = self._sure.execute(
                "SELECT stops.body FROM stops JOIN surveys ON surveys.id = stops.survey WHERE name = ? "
                "ORDER BY leg DESC, stop DESC LIMIT 1",
                (survey,),
            ).fetchone()
        return None if row is None else msgspec.json.decode(row[0], type=Stop)

    def survey(self, name: str) -> Survey:
        """A whole survey as the journal has it; raises InputError naming those it has."""
        with self._lock:
            row = self._sure.execute("SELECT id, body FROM surveys WHERE name = ?", (name,)).fetchone()
            if row is None:
                known = [other for (other,) in self._sure.execute("SELECT name FROM surveys ORDER BY id")]
                raise InputError(f"{self.path}: no survey {name!r}; there is {', '.join(known) or 'none'}")
            bodies = self._sure.execute("SELECT body FROM stops WHERE survey = ? ORDER BY leg, stop", (row[0],))
            stops = tuple(msgspec.json.decode(body, type=Stop) for (body,) in bodies)
        return replace(_header(row[1]), stops=stops)

    # ---- upload queue ------------------------------------------------------------------------------------------------

    def pending(self) -> list[Upload]:
        """What the server has not acknowledged, oldest first, each header before its stops."""
        with self._lock:
            rows = self._sure.execute(
                "SELECT id, 0, 'header', name, 0, 0, body, digest FROM surveys WHERE NOT acknowledged UNION ALL "
                "SELECT surveys.id, stops.id, 'stop', name, leg, stop, stops.body, stops.digest "
                "FROM stops JOIN surveys ON surveys.id = stops.survey WHERE NOT stops.acknowledged ORDER BY 1, 2"
            ).fetchall()
        return [Upload(*row[2:]) for row in rows]

    def acknowledge(self, upload: Upload) -> None:
        """Note that the server has this record; one that has changed since stays in the queue."""
        with self._transaction():
            if upload.kind == "header":
                self._sure.execute(
                    "UPDATE surveys SET acknowledged = 1 WHERE name = ? AND digest = ?", (upload.survey, upload.digest)
                )
            else:
                self._sure.execute(
                    "UPDATE stops SET acknowledged = 1 WHERE survey = (SELECT id FROM surveys WHERE name = ?) "
                    "AND leg = ? AND stop = ? AND digest = ?",
                    (upload.survey, upload.leg, upload.stop, upload.digest),
                )

    def send_again(self, survey: str) -> None:
        """Put a survey's header and all its stops back into the queue, because the server has lost them."""
        with self._transaction():
            self._sure.execute("UPDATE surveys SET acknowledged = 0 WHERE name = ?", (survey,))
            self._sure.execute(
                "UPDATE stops SET acknowledged = 0 WHERE survey = (SELECT id FROM surveys WHERE name = ?)", (survey,)
            )

    # ---- what helps to understand a mission --------------------------------------------------------------------------

    def note_clock(self, boot: str, t: float, utc: datetime, *, synchronised: bool) -> None:
        """Note which date a loop time was; call it at every start and whenever the date steps."""
        with self._transaction():
            self._clock = self._sure.execute(
                "INSERT INTO clock (boot, t, utc, synchronised) VALUES (?, ?, ?, ?)",
                (boot, t, utc.isoformat(), synchronised),
            ).lastrowid

    def add_slot(self, survey: str, leg: int, stop: int, slot: int, started: float, ended: float) -> None:
        """Note when a slot began and ended (loop times)."""
        self._note(
            "INSERT INTO slots (leg, stop, slot, started, ended, clock) VALUES ((SELECT max(legs.id) FROM legs "
            "JOIN surveys ON surveys.id = legs.survey WHERE name = ? AND leg = ?), ?, ?, ?, ?, ?)",
            [(survey, leg, stop, slot, started, ended, self._clock)],
        )

    def add_event(self, event: Event) -> None:
        """Keep what the operator was told."""
        self._note(
            "INSERT INTO events (t, source, level, text, clock) VALUES (?, ?, ?, ?, ?)",
            [(event.t, event.source, event.level, event.text, self._clock)],
        )

    def add_trail(self, rows: Sequence[tuple[float, float, float, float]]) -> None:
        """Keep where the robot drove in the current leg: rows of loop time, x, y, heading."""
        self._note(
            "INSERT INTO trail (leg, t, x, y, heading, clock) VALUES (?, ?, ?, ?, ?, ?)",
            [(self._leg, *row, self._clock) for row in rows],
        )

    def _note(self, statement: str, rows: Sequence[Iterable[object]]) -> None:
        """Write rows nobody depends on: a full card must not stop the robot over them, the next stop will tell."""
        with self._lock:
            try:
                self._quick.execute("BEGIN IMMEDIATE")
                self._quick.executemany(statement, [tuple(row) for row in rows])
                self._quick.execute("COMMIT")
            except sqlite3.OperationalError:
                self.dropped += len(rows)
                _roll_back(self._quick)
            except BaseException:
                _roll_back(self._quick)
                raise

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        with self._lock:
            try:
                self._sure.execute("BEGIN IMMEDIATE")
                yield
                self._sure.execute("COMMIT")
            except sqlite3.OperationalError as error:
                _roll_back(self._sure)
                raise MissionError(
                    f"{self.path}: cannot be written: {error}; make room on the disk, then resume"
                ) from error
            except BaseException:
                _roll_back(self._sure)
                raise


def header_body(header: Survey) -> bytes:
    """A survey's header as it is sent: the JSON of `robotd-survey/1` without `stops`."""
    data = msgspec.to_builtins(header, enc_hook=_plain)
    del data["stops"]
    body = msgspec.json.encode(data)
    _check_body(body, _header, replace(header, stops=()), f"header of survey {header.survey!r}")
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


def _header(body: bytes) -> Survey:
    return msgspec.json.decode(body[:-1] + b',"stops":[]}', type=Survey)


def _check_body(body: bytes, read: object, record: object, what: str) -> None:
    """Refuse what JSON cannot carry (NaN becomes null), while the caller can still be found."""
    try:
        same = read(body) == record  # type: ignore[operator]
    except msgspec.ValidationError as error:
        raise ValueError(f"{what}: {error}; a number in it is not finite or of the wrong type") from error
    if not same:
        raise ValueError(f"{what}: does not read back as it was written")


def _check(connection: sqlite3.Connection, path: Path) -> None:
    """Make sure that this is a sound journal of a version we know, creating the tables in an empty file."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if tables and application != APPLICATION_ID:
        raise InputError(f"{path}: an SQLite file of another program, not a journal; name another file")
    if tables and version != VERSION:
        raise InputError(f"{path}: a journal of version {version}; this robotd knows version {VERSION}: update robotd")
    (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise InputError(
            f"{path}: the journal is damaged ({verdict}); move it away, 'sqlite3 {path} .recover' may rescue its stops"
        )
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = FULL")
    connection.execute("PRAGMA foreign_keys = ON")
    if not tables:
        connection.executescript(SCHEMA)


def _roll_back(connection: sqlite3.Connection) -> None:
    if connection.in_transaction:
        connection.execute("ROLLBACK")
