"""The journal keeps every finished stop, whatever happens to the process or the disk."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import InputError, MissionError, StorageError
from robotd.files import header_from_json, stop_from_json
from robotd.journal import Journal
from robotd.journal_records import MissionNote, Unfinished, digest, header_body, name_problem, stop_body
from robotd.records import CameraModel, Event, Move, Pose, Rig, Sighting, Stop, Survey, Transform

CAMERA = CameraModel(
    "front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((-1.2092, 1.2092, -1.2092), (0.06, 0.0, 0.5))
)
HEADER = Survey("room", Rig((CAMERA,), {"front": (0.1, 0.0, 0.65)}), (), created="2026-11-21T10:00:00Z")
MOVE = Move(0.75, 0.01, 0.1, ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)))


def make_stop(number: int = 1, leg: int = 1, u: float = 311.2) -> Stop:
    move = MOVE if number > 1 else None
    sighting = Sighting("front", "A17", u, 200.1, 0.1, 0.999)
    return Stop(leg, number, "2026-11-21T10:01:12.5Z", Pose(0.1, 0.2, 0.3), move, (sighting,))


@pytest.fixture
def journal(tmp_path):
    with Journal.open(tmp_path / "state" / "journal.sqlite") as journal:
        yield journal


def test_a_stop_is_kept_over_a_restart(tmp_path):
    path = tmp_path / "journal.sqlite"
    with Journal.open(path) as journal:
        assert journal.last_stop("room") is None
        assert journal.begin_leg(HEADER) == 1
        journal.add_stop("room", make_stop(1))
        journal.add_stop("room", make_stop(2))
    with Journal.open(path) as journal:
        assert journal.last_stop("room") == make_stop(2)
        assert journal.survey("room") == replace(HEADER, stops=(make_stop(1), make_stop(2)))


def test_the_queue_holds_what_will_be_sent_header_first(journal):
    journal.begin_leg(HEADER)
    journal.add_stop("room", make_stop(1))
    journal.begin_leg(replace(HEADER, survey="shop"))
    journal.add_stop("shop", make_stop(1))
    journal.add_stop("room", make_stop(2))
    queue = journal.pending()
    assert [(item.kind, item.survey, item.leg, item.stop) for item in queue] == [
        ("header", "room", 0, 0),
        ("stop", "room", 1, 1),
        ("stop", "room", 1, 2),
        ("header", "shop", 0, 0),
        ("stop", "shop", 1, 1),
    ]
    assert all(item.digest == digest(item.body) for item in queue)
    assert header_from_json(queue[0].body, "header") == HEADER
    assert stop_from_json(queue[2].body, "stop", HEADER) == make_stop(2)


def test_an_acknowledged_record_leaves_the_queue_for_good(tmp_path):
    with Journal.open(tmp_path / "j") as journal:
        journal.begin_leg(HEADER)
        journal.add_stop("room", make_stop(1))
        header, stop = journal.pending()
        journal.acknowledge(header)
        assert journal.pending() == [stop]
        journal.acknowledge(stop)
        journal.acknowledge(stop)
        journal.add_stop("room", make_stop(1))
    with Journal.open(tmp_path / "j") as journal:
        assert journal.pending() == []
        journal.send_again("room")
        assert journal.pending() == [header, stop]


def test_a_header_that_changed_on_the_way_is_not_acknowledged(journal):
    journal.begin_leg(HEADER)
    (old,) = journal.pending()
    journal.begin_leg(replace(HEADER, created="2027-01-01T00:00:00Z", sigmas=replace(HEADER.sigmas, pixel_px=0.2)))
    journal.acknowledge(old)
    (new,) = journal.pending()
    assert json.loads(new.body)["sigmas"]["pixel_px"] == 0.2
    assert json.loads(new.body)["created"] == HEADER.created


def test_the_same_stop_twice_is_one_stop_and_another_content_is_refused(journal):
    journal.begin_leg(HEADER)
    journal.add_stop("room", make_stop(1))
    journal.add_stop("room", make_stop(1))
    with pytest.raises(ValueError, match="leg 1 stop 1 is in the journal with another content"):
        journal.add_stop("room", make_stop(1, u=12.0))
    assert journal.survey("room").stops == (make_stop(1),)


def test_a_leg_gets_the_number_after_the_last_one_with_a_stop(journal):
    assert journal.begin_leg(HEADER) == 1
    assert journal.begin_leg(HEADER) == 1
    journal.add_stop("room", make_stop(1))
    assert journal.begin_leg(replace(HEADER, created="2027-01-01T00:00:00Z")) == 2
    journal.add_stop("room", make_stop(1, leg=2))
    assert journal.begin_leg(HEADER) == 3
    assert journal.last_stop("room") == make_stop(1, leg=2)


def test_a_survey_with_stops_cannot_go_on_with_another_calibration(journal):
    journal.begin_leg(HEADER)
    journal.add_stop("room", make_stop(1))
    with pytest.raises(InputError, match=r"stops were made with other priors than now; choose another survey name"):
        journal.begin_leg(replace(HEADER, priors=replace(HEADER.priors, tilt_rad=0.1)))
    assert journal.begin_leg(HEADER) == 2


@pytest.mark.parametrize("name", ["", ".", "..", "a/b", "a\\b", "a\nb", "x" * 61])
def test_names_that_no_address_can_carry_are_refused(journal, name):
    with pytest.raises(InputError, match="choose another name"):
        journal.begin_leg(replace(HEADER, survey=name))
    assert name_problem("Läden, Ost 3 %2F.") is None


def test_unknown_surveys_are_named_with_the_known_ones(journal):
    with pytest.raises(InputError, match="no survey 'x'; there is none"):
        journal.survey("x")
    journal.begin_leg(HEADER)
    with pytest.raises(InputError, match="no survey 'x'; there is room"):
        journal.survey("x")
    with pytest.raises(ValueError, match="not begun"):
        journal.add_stop("x", make_stop(1))


def test_what_json_cannot_carry_is_refused_before_it_is_stored(journal):
    journal.begin_leg(HEADER)
    with pytest.raises(ValueError, match=r"leg 1 stop 1: .*not finite"):
        journal.add_stop("room", make_stop(1, u=float("nan")))
    with pytest.raises(ValueError, match="header of survey 'room'"):
        header_body(replace(HEADER, priors=replace(HEADER.priors, tilt_rad=float("inf"))))
    assert journal.survey("room").stops == ()


def test_numpy_numbers_are_stored_as_numbers():
    assert stop_body(make_stop(1, u=np.float64(311.2))) == stop_body(make_stop(1))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="object cannot be stored"):
        stop_body(make_stop(1, u=object()))  # type: ignore[arg-type]


@settings(max_examples=200, deadline=None)
@given(
    st.builds(
        Stop,
        leg=st.integers(1, 9),
        stop=st.integers(1, 9),
        time=st.text(),
        odometry=st.builds(Pose, *[st.floats(allow_nan=False, allow_infinity=False)] * 3),
        move=st.none() | st.just(MOVE),
        sightings=st.lists(
            st.builds(Sighting, st.text(), st.text(), *[st.floats(allow_nan=False, allow_infinity=False)] * 2),
            max_size=3,
        ).map(tuple),
        beacon_sightings=st.just(()),
    )
)
def test_stops_are_stored_to_the_last_bit(stop):
    import msgspec

    assert msgspec.json.decode(stop_body(stop), type=Stop) == stop


def test_notes_of_a_mission_are_kept_with_the_clock_of_their_time(tmp_path):
    with Journal.open(tmp_path / "j") as journal:
        journal.note_clock("boot-1", 12.5, datetime(2026, 11, 21, tzinfo=UTC), synchronised=False)
        journal.begin_leg(HEADER)
        journal.add_trail([(13.0, 0.1, 0.2, 0.3), (13.1, 0.2, 0.2, 0.3)])
        journal.add_slot("room", 1, 1, 0, 13.2, 16.2)
        journal.note_clock("boot-1", 17.0, datetime(2026, 11, 22, tzinfo=UTC), synchronised=True)
        journal.add_event(Event(17.1, "mission", "info", "stop 1 of 7"))
        journal.add_trail([])
        assert journal.dropped == 0
    with sqlite3.connect(tmp_path / "j") as connection:
        assert connection.execute("SELECT utc, synchronised FROM clock").fetchall() == [
            ("2026-11-21T00:00:00+00:00", 0),
            ("2026-11-22T00:00:00+00:00", 1),
        ]
        assert connection.execute("SELECT leg, t, x, y, heading, clock FROM trail").fetchall() == [
            (1, 13.0, 0.1, 0.2, 0.3, 1),
            (1, 13.1, 0.2, 0.2, 0.3, 1),
        ]
        assert connection.execute("SELECT leg, stop, slot, started, ended, clock FROM slots").fetchall() == [
            (1, 1, 0, 13.2, 16.2, 1)
        ]
        assert connection.execute("SELECT source, level, text, clock FROM events").fetchall() == [
            ("mission", "info", "stop 1 of 7", 2)
        ]
    connection.close()


def test_many_threads_may_write_at_once(journal):
    journal.begin_leg(HEADER)

    def write(first: int) -> None:
        for number in range(first, 40, 4):
            journal.add_stop("room", make_stop(number))
            journal.add_trail([(float(number), 0.0, 0.0, 0.0)])

    threads = [threading.Thread(target=write, args=(first,)) for first in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [stop.stop for stop in journal.survey("room").stops] == list(range(1, 40))


def test_a_full_disk_refuses_a_stop_loudly_and_notes_silently(journal):
    journal.begin_leg(HEADER)
    journal.add_stop("room", make_stop(1))
    for connection in (journal.sure, journal.quick):
        connection.execute("PRAGMA max_page_count = 1")  # no page more than there are
    big = make_stop(2)
    big = replace(big, sightings=big.sightings * 2000)
    with pytest.raises(MissionError, match=r"cannot be written: database or disk is full; make room"):
        journal.add_stop("room", big)
    journal.add_event(Event(1.0, "mission", "info", "x" * 100_000))
    assert journal.dropped == 1
    for connection in (journal.sure, journal.quick):
        connection.execute("PRAGMA max_page_count = 100000")
    journal.add_stop("room", big)
    assert journal.last_stop("room") == big


def test_files_that_are_no_journal_are_left_alone(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("shopping list\n" * 100)
    with pytest.raises(InputError, match=r"notes.txt: cannot be opened as a journal: file is not a database"):
        Journal.open(path)
    assert path.read_text().startswith("shopping")

    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as connection:
        connection.execute("CREATE TABLE music (title TEXT)")
    connection.close()
    before = other.read_bytes()
    with pytest.raises(InputError, match="an SQLite file of another program"):
        Journal.open(other)
    assert other.read_bytes() == before

    with pytest.raises(InputError, match="cannot be opened"):
        Journal.open(tmp_path)
    with pytest.raises(InputError, match="the folder cannot be made"):
        Journal.open(path / "journal.sqlite")


def test_a_journal_of_a_newer_version_is_refused(tmp_path):
    Journal.open(tmp_path / "j").close()
    with sqlite3.connect(tmp_path / "j") as connection:
        connection.execute("PRAGMA user_version = 4")
    connection.close()
    with pytest.raises(InputError, match="a journal of version 4; this robotd knows version 3: update robotd"):
        Journal.open(tmp_path / "j")


def test_a_damaged_journal_is_refused(tmp_path):
    path = tmp_path / "j"
    with Journal.open(path) as journal:
        journal.begin_leg(HEADER)
        for number in range(1, 60):
            journal.add_stop("room", make_stop(number))
    data = bytearray(path.read_bytes())
    half = len(data) // 2
    data[half : half + 8192] = b"\xa5" * 8192
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"j: (the journal is damaged|cannot be opened)"):
        Journal.open(path)


WRITER = """
import itertools, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from robotd.journal import Journal
from robotd.records import Pose, Rig, Stop, Survey
journal = Journal.open(Path(sys.argv[1]))
leg = journal.begin_leg(Survey("room", Rig(()), ()))
for number in itertools.count(1):
    journal.add_stop("room", Stop(leg, number, "2026-11-21T10:01:12Z", Pose(float(number), 0.0, 0.0), None))
    journal.add_trail([(float(number), 0.0, 0.0, 0.0)] * 10)
    print(leg, number, flush=True)
"""


def test_kill_9_loses_no_stop_that_was_reported(tmp_path):
    path = tmp_path / "journal.sqlite"
    root = str(Path(__file__).resolve().parent.parent)
    for leg in (1, 2, 3):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path), root], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            for _ in range(40 * leg):
                process.stdout.readline()
            process.kill()
            reported = [line for line in process.stdout.read().splitlines(True) if line.endswith("\n")]
        last = int(reported[-1].split()[1]) if reported else 40 * leg
        with Journal.open(path) as journal:
            stops = [stop for stop in journal.survey("room").stops if stop.leg == leg]
        assert len(stops) >= last
        assert [stop.odometry.x for stop in stops] == [float(number) for number in range(1, len(stops) + 1)]


# ---- missions --------------------------------------------------------------------------------------------------------


def test_a_mission_that_nobody_ended_is_found_as_it_was_noted_last(tmp_path):
    with Journal.open(tmp_path / "j") as journal:
        journal.note_clock("boot-1", 1.0, datetime(2026, 11, 21, tzinfo=UTC), synchronised=True)
        leg = journal.begin_leg(HEADER)
        assert journal.unfinished() is None
        number = journal.begin_mission(HEADER.survey, leg, 1, "plan", is_attended=True)
        stop = MissionNote(number, "driving", 2, 0.1, 5.0, b"{}")
        journal.add_stop(HEADER.survey, make_stop(1), flag="few", note=stop)
        assert journal.stops(HEADER.survey)[0].flag == "few"
        journal.add_trail([], MissionNote(number, "driving", 2, 0.6, 7.5))
    with Journal.open(tmp_path / "j") as journal:
        found = journal.unfinished()
        assert found == Unfinished(
            *(HEADER.survey, 1, 1, True, "plan"), MissionNote(number, "driving", 2, 0.6, 7.5, b"{}"), "boot-1"
        )
        journal.end_mission(number, "done")
        assert journal.unfinished() is None


def test_a_stop_and_how_far_the_mission_has_come_are_written_together_or_not_at_all(journal):
    journal.begin_leg(HEADER)
    number = journal.begin_mission(HEADER.survey, 1, 1, "", is_attended=False)
    for connection in (journal.sure, journal.quick):
        connection.execute("PRAGMA max_page_count = 1")
    stop = make_stop(1)
    big = replace(stop, sightings=stop.sightings * 2000)
    with pytest.raises(StorageError, match="make room on the disk, then resume"):
        journal.add_stop(HEADER.survey, big, note=MissionNote(number, "driving", 2, 1.0, 2.0))
    found = journal.unfinished()
    assert (found.note.stop, journal.stops(HEADER.survey)) == (1, [])


# ---- rejected stops --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [1, 2])
def test_a_journal_of_a_version_before_is_taken_over_with_its_stops(tmp_path, version):
    with Journal.open(tmp_path / "j") as journal:
        journal.begin_leg(HEADER)
        journal.add_stop(HEADER.survey, make_stop(1))
    with sqlite3.connect(tmp_path / "j") as connection:
        for table in ("memories", "missions"):
            connection.execute(f"DROP TABLE {table}")
        for column in ("flag", "replaces", "rejected", "original")[: 1 if version == 2 else 4]:
            connection.execute(f"ALTER TABLE stops DROP COLUMN {column}")
        connection.execute(f"PRAGMA user_version = {version}")
    connection.close()
    with Journal.open(tmp_path / "j") as journal:
        assert journal.survey(HEADER.survey).stops == (make_stop(1),)
        assert journal.unfinished() is None
        journal.begin_mission(HEADER.survey, 1, 1, "{}", is_attended=True)
        journal.reject(HEADER.survey, 1, 1, "a person stood there")
        assert journal.stops(HEADER.survey)[0].rejected == "a person stood there"


def test_a_rejected_stop_waits_for_the_server_again_and_names_what_it_replaces(tmp_path):
    with Journal.open(tmp_path / "j") as journal:
        journal.begin_leg(HEADER)
        journal.add_stop(HEADER.survey, make_stop(1))
        for upload in journal.pending():
            journal.acknowledge(upload)
        assert journal.waiting() == 0
        before = digest(stop_body(make_stop(1)))
        journal.reject(HEADER.survey, 1, 1, "x")
        (rejected,) = journal.pending()
        assert rejected.replaces == before
        assert journal.survey(HEADER.survey).stops[0].sightings == ()
        journal.restore(HEADER.survey, 1, 1)
        (restored,) = journal.pending()
        assert (restored.digest, restored.replaces) == (before, rejected.digest)
        summary = journal.surveys()[HEADER.survey]
        assert (summary.legs, summary.stops, summary.rejected, summary.waiting) == (1, 1, 0, 1)
        journal.acknowledge(rejected)  # of before: it says nothing about what waits now
        assert journal.waiting() == 1
