"""What the robot must not forget: an SQLite file that survives kill -9, power loss and a full card.

Stops and survey headers are written on a connection with `synchronous=FULL`: when `add_stop` returns, the stop is on
the disk, as the very bytes that will be uploaded, with their hash. What only helps to understand a mission afterwards
(trail, slots, events) goes through a second connection with `synchronous=NORMAL`; the next stop makes it durable too.
The upload queue is not a table of its own: it is every header and stop that the server has not acknowledged yet.

Times are loop times (`t`); with the row of `clock` that was newest when they were written they become dates.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from datetime import datetime
from pathlib import Path

import msgspec

from .errors import InputError, MissionError
from .journal_records import (
    LoggedEvent,
    StopSummary,
    SurveySummary,
    Upload,
    date_after,
    digest,
    header_body,
    name_problem,
    read_header,
    stop_body,
)
from .records import Event, Stop, Survey

APPLICATION_ID = 0x726F626F  # "robo": tells our files from other SQLite files
VERSION = 2
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
    replaces TEXT, rejected TEXT, original BLOB, UNIQUE (survey, leg, stop));
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

FROM_1 = """
BEGIN IMMEDIATE;
ALTER TABLE stops ADD COLUMN replaces TEXT;
ALTER TABLE stops ADD COLUMN rejected TEXT;
ALTER TABLE stops ADD COLUMN original BLOB;
PRAGMA user_version = 2;
COMMIT;
"""


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
                self._renew_header(survey, read_header(row[1]), header, has_stops=last > 0)
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
            row = self._sure.execute("SELECT id, body FROM surveys WHERE id = ?", (self.survey_id(name),)).fetchone()
            bodies = self._sure.execute("SELECT body FROM stops WHERE survey = ? ORDER BY leg, stop", (row[0],))
            stops = tuple(msgspec.json.decode(body, type=Stop) for (body,) in bodies)
        return replace(read_header(row[1]), stops=stops)

    def survey_id(self, name: str) -> int:
        """The row of a survey; raises InputError naming those there are."""
        with self._lock:
            row = self._sure.execute("SELECT id FROM surveys WHERE name = ?", (name,)).fetchone()
            if row is None:
                known = [other for (other,) in self._sure.execute("SELECT name FROM surveys ORDER BY id")]
                raise InputError(f"{self.path}: no survey {name!r}; there is {', '.join(known) or 'none'}")
        return int(row[0])

    def surveys(self) -> dict[str, SurveySummary]:
        """Every survey, oldest first."""
        with self._lock:
            rows = self._sure.execute(
                "SELECT name, surveys.body, count(DISTINCT leg), count(stops.id), count(rejected), "
                "(NOT surveys.acknowledged) + coalesce(sum(NOT stops.acknowledged), 0) "
                "FROM surveys LEFT JOIN stops ON stops.survey = surveys.id GROUP BY surveys.id ORDER BY surveys.id"
            ).fetchall()
        return {name: SurveySummary(read_header(body).created, *counts) for name, body, *counts in rows}

    def stops(self, survey: str) -> list[StopSummary]:
        """Every stop of a survey, by leg and number; raises InputError naming the surveys there are."""
        self.survey_id(survey)
        with self._lock:
            rows = self._sure.execute(
                "SELECT stops.body, stops.acknowledged, rejected FROM stops JOIN surveys ON surveys.id = stops.survey "
                "WHERE name = ? ORDER BY leg, stop",
                (survey,),
            ).fetchall()
        return [StopSummary(msgspec.json.decode(body, type=Stop), bool(sent), why) for body, sent, why in rows]

    def reject(self, survey: str, leg: int, stop: int, reason: str) -> None:
        """Leave a stop's sightings out of the survey; where the robot stood stays, for the stops around it.

        Raises
        ------
        InputError
            If there is no such stop, or it is rejected already.
        MissionError
            If the disk does not take it.
        """
        body, rejected, _ = self._stop_row(survey, leg, stop)
        if rejected is not None:
            raise InputError(f"survey {survey!r}: leg {leg} stop {stop} is rejected already: {rejected}")
        bare = replace(msgspec.json.decode(body, type=Stop), sightings=(), beacon_sightings=())
        self._replace_stop(survey, leg, stop, stop_body(bare), body, reason)

    def restore(self, survey: str, leg: int, stop: int) -> None:
        """Take a rejection back; raises as `reject`."""
        _, rejected, original = self._stop_row(survey, leg, stop)
        if rejected is None or original is None:
            raise InputError(f"survey {survey!r}: leg {leg} stop {stop} is not rejected")
        self._replace_stop(survey, leg, stop, original, None, None)

    def _stop_row(self, survey: str, leg: int, stop: int) -> tuple[bytes, str | None, bytes | None]:
        with self._lock:
            row = self._sure.execute(
                "SELECT body, rejected, original FROM stops WHERE survey = ? AND leg = ? AND stop = ?",
                (self.survey_id(survey), leg, stop),
            ).fetchone()
        if row is None:
            raise InputError(f"survey {survey!r}: there is no leg {leg} stop {stop}")
        return row[0], row[1], row[2]

    def _replace_stop(
        self, survey: str, leg: int, stop: int, body: bytes, original: bytes | None, reason: str | None
    ) -> None:
        """Another content for a stop, to be uploaded in place of what the server has or will have got by then."""
        with self._transaction():
            self._sure.execute(
                "UPDATE stops SET replaces = digest, acknowledged = 0, body = ?, digest = ?, original = ?, "
                "rejected = ? WHERE survey = ? AND leg = ? AND stop = ?",
                (body, digest(body), original, reason, self.survey_id(survey), leg, stop),
            )

    # ---- upload queue ------------------------------------------------------------------------------------------------

    def waiting(self) -> int:
        """How many records the server has not acknowledged."""
        with self._lock:
            (count,) = self._sure.execute(
                "SELECT (SELECT count(*) FROM surveys WHERE NOT acknowledged) "
                "+ (SELECT count(*) FROM stops WHERE NOT acknowledged)"
            ).fetchone()
        return int(count)

    def pending(self) -> list[Upload]:
        """What the server has not acknowledged, oldest first, each header before its stops."""
        with self._lock:
            rows = self._sure.execute(
                "SELECT id, 0, 'header', name, 0, 0, body, digest, NULL FROM surveys WHERE NOT acknowledged UNION ALL "
                "SELECT surveys.id, stops.id, 'stop', name, leg, stop, stops.body, stops.digest, replaces "
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

    def events(self, count: int, *, level: str = "info", after: int = 0) -> list[LoggedEvent]:
        """The newest events of at least this level, oldest first; `after`: only those with a greater number."""
        levels = ("info", "warning", "error")
        wanted = levels[levels.index(level) :]
        with self._lock:
            rows = self._quick.execute(
                "SELECT events.id, clock.utc, events.t - clock.t, synchronised, source, level, text FROM events "
                "LEFT JOIN clock ON clock.id = events.clock WHERE events.id > ? "
                f"AND level IN ({', '.join('?' * len(wanted))}) ORDER BY events.id DESC LIMIT ?",
                (after, *wanted, count),
            ).fetchall()
        return [
            LoggedEvent(number, date_after(utc, since), bool(sure), source, level, text)
            for number, utc, since, sure, source, level, text in reversed(rows)
        ]

    def trail(self, count: int) -> list[tuple[float, float, float, float]]:
        """Where the robot drove in the current leg: its newest rows of loop time, x, y, heading, oldest first."""
        with self._lock:
            rows = self._quick.execute(
                "SELECT t, x, y, heading FROM trail WHERE leg IS ? AND clock IS ? ORDER BY id DESC LIMIT ?",
                (self._leg, self._clock, count),
            ).fetchall()
        return rows[::-1]

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


def _check(connection: sqlite3.Connection, path: Path) -> None:
    """Make sure that this is a sound journal of a version we know, creating the tables in an empty file."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
    if tables and application != APPLICATION_ID:
        raise InputError(f"{path}: an SQLite file of another program, not a journal; name another file")
    if tables and version == 1:
        connection.executescript(FROM_1)
        version = 2
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
