"""What the robot must not forget: an SQLite file that survives kill -9, power loss and a full card.

When `add_stop` returns, the stop is on the disk, as the very bytes that will be uploaded, with their hash. What only
helps to understand a mission afterwards (trail, slots, events) is written less dearly; see `journal_file`. A mission
notes how far it has come, with each stop in the same transaction, so that a daemon that is started again can go on.
The upload queue is not a table of its own: it is every header and stop that the server has not acknowledged yet.

Times are loop times (`t`); with the row of `clock` that was newest when they were written they become dates.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import fields, replace
from datetime import datetime
from pathlib import Path

import msgspec

from .errors import InputError
from .journal_file import JournalFile
from .journal_records import (
    LoggedEvent,
    MissionNote,
    StopSummary,
    SurveySummary,
    Unfinished,
    Upload,
    date_after,
    digest,
    header_body,
    name_problem,
    read_header,
    stop_body,
)
from .records import Event, Stop, Survey


class Journal(JournalFile):
    """The robot's journal."""

    def __init__(self, path: Path, sure: sqlite3.Connection, quick: sqlite3.Connection) -> None:
        super().__init__(path, sure, quick)
        self._leg: int | None = None

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
        StorageError
            If the disk does not take it.
        """
        problem = name_problem(header.survey)
        if problem:
            raise InputError(f"survey {header.survey!r}: {problem}; choose another name")
        header = replace(header, stops=())
        with self.transaction():
            row = self.sure.execute("SELECT id, body FROM surveys WHERE name = ?", (header.survey,)).fetchone()
            if row is None:
                body = header_body(header)
                survey = self.sure.execute(
                    "INSERT INTO surveys (name, body, digest) VALUES (?, ?, ?)", (header.survey, body, digest(body))
                ).lastrowid
                last = 0
            else:
                survey = row[0]
                (last,) = self.sure.execute(
                    "SELECT coalesce(max(leg), 0) FROM stops WHERE survey = ?", (survey,)
                ).fetchone()
                self._renew_header(survey, read_header(row[1]), header, has_stops=last > 0)
            self._leg = self.sure.execute(
                "INSERT INTO legs (survey, leg, clock) VALUES (?, ?, ?)", (survey, last + 1, self.clock)
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
        self.sure.execute(
            "UPDATE surveys SET body = ?, digest = ?, acknowledged = 0 WHERE id = ?", (body, digest(body), survey)
        )

    def add_stop(self, survey: str, stop: Stop, *, flag: str | None = None, note: MissionNote | None = None) -> None:
        """Put a finished stop on the disk; the same stop again changes nothing.

        `flag` says what is doubtful about it, `note` how far the mission has come with it.

        Raises
        ------
        ValueError
            If the survey was not begun, the stop exists with another content, or a number in it is not finite.
        StorageError
            If the disk does not take it.
        """
        body = stop_body(stop)
        key = digest(body)
        with self.transaction():
            row = self.sure.execute("SELECT id FROM surveys WHERE name = ?", (survey,)).fetchone()
            if row is None:
                raise ValueError(f"survey {survey!r} was not begun")
            place = (row[0], stop.leg, stop.stop)
            old = self.sure.execute(
                "SELECT digest FROM stops WHERE survey = ? AND leg = ? AND stop = ?", place
            ).fetchone()
            if old is None:
                self.sure.execute(
                    "INSERT INTO stops (survey, leg, stop, body, digest, flag) VALUES (?, ?, ?, ?, ?, ?)",
                    (*place, body, key, flag),
                )
            elif old[0] != key:
                raise ValueError(
                    f"survey {survey!r}: leg {stop.leg} stop {stop.stop} is in the journal with another content"
                )
            if note is not None:
                self._update_mission(self.sure, note)

    def last_stop(self, survey: str) -> Stop | None:
        """The newest stop of a survey, or None."""
        with self.lock:
            row = self.sure.execute(
                "SELECT stops.body FROM stops JOIN surveys ON surveys.id = stops.survey WHERE name = ? "
                "ORDER BY leg DESC, stop DESC LIMIT 1",
                (survey,),
            ).fetchone()
        return None if row is None else msgspec.json.decode(row[0], type=Stop)

    def survey(self, name: str) -> Survey:
        """A whole survey as the journal has it; raises InputError naming those it has."""
        with self.lock:
            row = self.sure.execute("SELECT id, body FROM surveys WHERE id = ?", (self.survey_id(name),)).fetchone()
            bodies = self.sure.execute("SELECT body FROM stops WHERE survey = ? ORDER BY leg, stop", (row[0],))
            stops = tuple(msgspec.json.decode(body, type=Stop) for (body,) in bodies)
        return replace(read_header(row[1]), stops=stops)

    def survey_id(self, name: str) -> int:
        """The row of a survey; raises InputError naming those there are."""
        with self.lock:
            row = self.sure.execute("SELECT id FROM surveys WHERE name = ?", (name,)).fetchone()
            if row is None:
                known = [other for (other,) in self.sure.execute("SELECT name FROM surveys ORDER BY id")]
                raise InputError(f"{self.path}: no survey {name!r}; there is {', '.join(known) or 'none yet'}")
        return int(row[0])

    def surveys(self) -> dict[str, SurveySummary]:
        """Every survey, oldest first."""
        with self.lock:
            rows = self.sure.execute(
                "SELECT name, surveys.body, count(DISTINCT leg), count(stops.id), count(rejected), "
                "(NOT surveys.acknowledged) + coalesce(sum(NOT stops.acknowledged), 0) "
                "FROM surveys LEFT JOIN stops ON stops.survey = surveys.id GROUP BY surveys.id ORDER BY surveys.id"
            ).fetchall()
        return {name: SurveySummary(read_header(body).created, *counts) for name, body, *counts in rows}

    def stops(self, survey: str) -> list[StopSummary]:
        """Every stop of a survey, by leg and number; raises InputError naming the surveys there are."""
        self.survey_id(survey)
        with self.lock:
            rows = self.sure.execute(
                "SELECT stops.body, stops.acknowledged, rejected, flag "
                "FROM stops JOIN surveys ON surveys.id = stops.survey WHERE name = ? ORDER BY leg, stop",
                (survey,),
            ).fetchall()
        return [StopSummary(msgspec.json.decode(body, type=Stop), bool(sent), *rest) for body, sent, *rest in rows]

    def reject(self, survey: str, leg: int, stop: int, reason: str) -> None:
        """Leave a stop's sightings out of the survey; where the robot stood stays, for the stops around it.

        Raises
        ------
        InputError
            If there is no such stop, or it is rejected already.
        StorageError
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
        with self.lock:
            row = self.sure.execute(
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
        with self.transaction():
            self.sure.execute(
                "UPDATE stops SET replaces = digest, acknowledged = 0, body = ?, digest = ?, original = ?, "
                "rejected = ? WHERE survey = ? AND leg = ? AND stop = ?",
                (body, digest(body), original, reason, self.survey_id(survey), leg, stop),
            )

    # ---- missions ----------------------------------------------------------------------------------------------------

    def begin_mission(self, survey: str, leg: int, first_stop: int, plan: str, *, is_attended: bool) -> int:
        """Note that a mission begins, with what must stay the same for it to be resumed; returns its number.

        Raises StorageError if the disk does not take it.
        """
        with self.transaction():
            self.sure.execute("UPDATE missions SET ended = 'another one began' WHERE ended IS NULL")
            number = self.sure.execute(
                "INSERT INTO missions (survey, leg, first_stop, is_attended, plan, state, stop, along, t, clock) "
                "VALUES (?, ?, ?, ?, ?, 'idle', ?, 0, 0, ?)",
                (self.survey_id(survey), leg, first_stop, is_attended, plan, first_stop, self.clock),
            ).lastrowid
        assert number is not None
        return number

    def note_mission(self, note: MissionNote) -> None:
        """Note how far a mission has come; raises StorageError if the disk does not take it."""
        with self.transaction():
            self._update_mission(self.sure, note)

    def end_mission(self, number: int, why: str) -> None:
        """Note that a mission is over; raises StorageError if the disk does not take it."""
        with self.transaction():
            self.sure.execute("UPDATE missions SET ended = ? WHERE id = ?", (why, number))
            self.sure.execute("DELETE FROM memories WHERE mission = ?", (number,))

    def unfinished(self) -> Unfinished | None:
        """The mission that was under way when the last daemon ended, if there was one."""
        with self.lock:
            row = self.sure.execute(
                "SELECT name, leg, first_stop, is_attended, plan, missions.id, state, stop, along, missions.t, memory, "
                "paused, boot FROM missions JOIN surveys ON surveys.id = missions.survey "
                "LEFT JOIN clock ON clock.id = missions.clock "
                "LEFT JOIN memories ON mission = missions.id WHERE ended IS NULL ORDER BY missions.id DESC LIMIT 1"
            ).fetchone()
        if row is None:
            return None
        survey, leg, first_stop, is_attended, plan, *note, boot = row
        return Unfinished(survey, leg, first_stop, bool(is_attended), plan, MissionNote(*note), boot)

    def _update_mission(self, connection: sqlite3.Connection, note: MissionNote) -> None:
        connection.execute(
            "UPDATE missions SET state = ?, stop = ?, along = ?, t = ?, clock = ?, paused = ? WHERE id = ?",
            (note.state, note.stop, note.along, note.t, self.clock, note.paused, note.number),
        )
        if note.memory is not None:  # apart, because SQLite writes whole rows, and the other note comes every second
            connection.execute("INSERT OR REPLACE INTO memories VALUES (?, ?)", (note.number, note.memory))

    # ---- upload queue ------------------------------------------------------------------------------------------------

    def waiting(self) -> int:
        """How many records the server has not acknowledged."""
        with self.lock:
            (count,) = self.sure.execute(
                "SELECT (SELECT count(*) FROM surveys WHERE NOT acknowledged) "
                "+ (SELECT count(*) FROM stops WHERE NOT acknowledged)"
            ).fetchone()
        return int(count)

    def pending(self) -> list[Upload]:
        """What the server has not acknowledged, oldest first, each header before its stops."""
        with self.lock:
            rows = self.sure.execute(
                "SELECT id, 0, 'header', name, 0, 0, body, digest, NULL FROM surveys WHERE NOT acknowledged UNION ALL "
                "SELECT surveys.id, stops.id, 'stop', name, leg, stop, stops.body, stops.digest, replaces "
                "FROM stops JOIN surveys ON surveys.id = stops.survey WHERE NOT stops.acknowledged ORDER BY 1, 2"
            ).fetchall()
        return [Upload(*row[2:]) for row in rows]

    def acknowledge(self, upload: Upload) -> None:
        """Note that the server has this record; one that has changed since stays in the queue."""
        with self.transaction():
            if upload.kind == "header":
                self.sure.execute(
                    "UPDATE surveys SET acknowledged = 1 WHERE name = ? AND digest = ?", (upload.survey, upload.digest)
                )
            else:
                self.sure.execute(
                    "UPDATE stops SET acknowledged = 1 WHERE survey = (SELECT id FROM surveys WHERE name = ?) "
                    "AND leg = ? AND stop = ? AND digest = ?",
                    (upload.survey, upload.leg, upload.stop, upload.digest),
                )

    def send_again(self, survey: str) -> None:
        """Put a survey's header and all its stops back into the queue, because the server has lost them."""
        with self.transaction():
            self.sure.execute("UPDATE surveys SET acknowledged = 0 WHERE name = ?", (survey,))
            self.sure.execute(
                "UPDATE stops SET acknowledged = 0 WHERE survey = (SELECT id FROM surveys WHERE name = ?)", (survey,)
            )

    # ---- what helps to understand a mission --------------------------------------------------------------------------

    def note_clock(self, boot: str, t: float, utc: datetime, *, synchronised: bool) -> None:
        """Note which date a loop time was; call it at every start and whenever the date steps."""
        with self.transaction():
            self.clock = self.sure.execute(
                "INSERT INTO clock (boot, t, utc, synchronised) VALUES (?, ?, ?, ?)",
                (boot, t, utc.isoformat(), synchronised),
            ).lastrowid

    def add_slot(self, survey: str, leg: int, stop: int, slot: int, started: float, ended: float) -> None:
        """Note when a slot began and ended (loop times)."""
        row = (survey, leg, stop, slot, started, ended, self.clock)
        statement = (
            "INSERT INTO slots (leg, stop, slot, started, ended, clock) VALUES ((SELECT max(legs.id) FROM legs "
            "JOIN surveys ON surveys.id = legs.survey WHERE name = ? AND leg = ?), ?, ?, ?, ?, ?)"
        )
        self.note(lambda connection: connection.execute(statement, row))

    def add_event(self, event: Event) -> None:
        """Keep what the operator was told."""
        row = (event.t, event.source, event.level, event.text, self.clock)
        statement = "INSERT INTO events (t, source, level, text, clock) VALUES (?, ?, ?, ?, ?)"
        self.note(lambda connection: connection.execute(statement, row))

    def events(self, count: int, *, level: str = "info", after: int = 0) -> list[LoggedEvent]:
        """The newest events of at least this level, oldest first; `after`: only those with a greater number."""
        levels = ("info", "warning", "error")
        wanted = levels[levels.index(level) :]
        with self.lock:
            rows = self.quick.execute(
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
        with self.lock:
            rows = self.quick.execute(
                "SELECT t, x, y, heading FROM trail WHERE leg IS ? AND clock IS ? ORDER BY id DESC LIMIT ?",
                (self._leg, self.clock, count),
            ).fetchall()
        return rows[::-1]

    def add_trail(self, rows: Sequence[tuple[float, float, float, float]], note: MissionNote | None = None) -> None:
        """Keep where the robot drove in the current leg: rows of loop time, x, y, heading; and how far it has come."""

        def write(connection: sqlite3.Connection) -> None:
            connection.executemany(
                "INSERT INTO trail (leg, t, x, y, heading, clock) VALUES (?, ?, ?, ?, ?, ?)",
                [(self._leg, *row, self.clock) for row in rows],
            )
            if note is not None:
                self._update_mission(connection, note)

        self.note(write, len(rows))
