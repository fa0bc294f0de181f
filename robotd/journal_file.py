"""The SQLite file behind the journal: its tables, how it is opened, and its two ways of writing.

What must not be lost goes through `transaction`, on a connection with `synchronous=FULL`: when it returns, the rows are
on the disk. What only helps to understand a mission afterwards goes through `note`, on a second connection with
`synchronous=NORMAL`; the next transaction makes it durable too.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Self

from .errors import InputError, StorageError

APPLICATION_ID = 0x726F626F  # "robo": tells our files from other SQLite files
VERSION = 3
MISSIONS = """\
CREATE TABLE missions (id INTEGER PRIMARY KEY, survey INTEGER NOT NULL REFERENCES surveys, leg INTEGER NOT NULL,
    first_stop INTEGER NOT NULL, is_attended INTEGER NOT NULL, plan TEXT NOT NULL, state TEXT NOT NULL,
    stop INTEGER NOT NULL, along REAL NOT NULL, t REAL NOT NULL, clock INTEGER REFERENCES clock,
    paused TEXT, ended TEXT);
CREATE TABLE memories (mission INTEGER PRIMARY KEY REFERENCES missions, memory BLOB NOT NULL);
"""
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
    replaces TEXT, rejected TEXT, original BLOB, flag TEXT, UNIQUE (survey, leg, stop));
CREATE TABLE slots (id INTEGER PRIMARY KEY, leg INTEGER NOT NULL REFERENCES legs, stop INTEGER NOT NULL,
    slot INTEGER NOT NULL, started REAL NOT NULL, ended REAL NOT NULL, clock INTEGER REFERENCES clock);
CREATE TABLE events (id INTEGER PRIMARY KEY, t REAL NOT NULL, source TEXT NOT NULL, level TEXT NOT NULL,
    text TEXT NOT NULL, clock INTEGER REFERENCES clock);
CREATE TABLE trail (id INTEGER PRIMARY KEY, leg INTEGER REFERENCES legs, t REAL NOT NULL, x REAL NOT NULL,
    y REAL NOT NULL, heading REAL NOT NULL, clock INTEGER REFERENCES clock);
{MISSIONS}PRAGMA application_id = {APPLICATION_ID};
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

FROM_2 = f"""
BEGIN IMMEDIATE;
ALTER TABLE stops ADD COLUMN flag TEXT;
{MISSIONS}PRAGMA user_version = 3;
COMMIT;
"""


class JournalFile:
    """An open journal; every method may be called from any thread and blocks until the disk has answered.

    Attributes
    ----------
    dropped : int
        Rows of `note` that the disk did not take.
    clock : int or None
        The newest row of `clock`: which date the loop's times are.
    """

    def __init__(self, path: Path, sure: sqlite3.Connection, quick: sqlite3.Connection) -> None:
        self.path = path
        self.dropped = 0
        self.clock: int | None = None
        self.sure = sure
        self.quick = quick
        self.lock = threading.RLock()

    @classmethod
    def open(cls, path: Path) -> Self:
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
            mend = "make room on the disk" if "full" in str(error) else "move the file away to begin a new one"
            raise InputError(f"{path}: cannot be opened as a journal: {error}; {mend}") from error

    def close(self) -> None:
        """Release the file; safe to call twice."""
        with self.lock:
            self.quick.close()
            self.sure.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def note(self, write: Callable[[sqlite3.Connection], object], rows: int = 1) -> None:
        """Write rows nobody depends on: a full card must not stop the robot over them, the next stop will tell."""
        with self.lock:
            try:
                self.quick.execute("BEGIN IMMEDIATE")
                write(self.quick)
                self.quick.execute("COMMIT")
            except sqlite3.OperationalError:
                self.dropped += rows
                _roll_back(self.quick)
            except BaseException:
                _roll_back(self.quick)
                raise

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All of it or nothing, on the disk when the block has ended; raises StorageError if it takes nothing."""
        with self.lock:
            try:
                self.sure.execute("BEGIN IMMEDIATE")
                yield self.sure
                self.sure.execute("COMMIT")
            except sqlite3.OperationalError as error:
                _roll_back(self.sure)
                raise StorageError(
                    f"{self.path}: cannot be written: {error}; make room on the disk, then resume"
                ) from error
            except BaseException:
                _roll_back(self.sure)
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
    if tables and version == 2:
        connection.executescript(FROM_2)
        version = 3
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
