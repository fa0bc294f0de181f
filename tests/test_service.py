"""robotd as a service: what systemd shows of it, what its journal holds, and how it starts."""

import logging
import os
import socket
import sys

import pytest

from robotd.records import MissionStatus
from robotd.service import JournalHandler, describe, log_handler


@pytest.fixture
def journald(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "journal"))
        listener.settimeout(10.0)
        yield listener


def record(text, **fields):
    made = logging.LogRecord("robotd", logging.WARNING, "x.py", 1, text, None, None)
    made.fields = fields
    return made


def test_a_journal_entry_carries_its_fields_and_lines(journald):
    handler = JournalHandler(journald.getsockname())
    before = logging.root.handlers
    logging.root.handlers = []
    logging.basicConfig(handlers=[handler])  # as robotd does
    logging.root.handlers = before
    handler.emit(record("base: unplugged\nplug it in", ROBOTD_SOURCE="base", ROBOTD_STOP="3"))
    handler.close()
    entry = journald.recv(65536)
    text = b"base: unplugged\nplug it in"
    assert entry.startswith(b"MESSAGE\n" + len(text).to_bytes(8, "little") + text + b"\n")
    assert entry.endswith(b"PRIORITY=4\nSYSLOG_IDENTIFIER=robotd\nLOGGER=robotd\nROBOTD_SOURCE=base\nROBOTD_STOP=3\n")


def test_what_no_journal_takes_goes_to_standard_error(tmp_path, capsys):
    handler = JournalHandler(str(tmp_path / "none"))
    handler.emit(record("battery low"))
    handler.close()
    assert capsys.readouterr().err == "battery low\n"


def test_the_journal_is_used_only_where_standard_error_leads_there(monkeypatch, tmp_path):
    with (tmp_path / "stderr").open("w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.delenv("JOURNAL_STREAM", raising=False)
        assert isinstance(log_handler(), logging.StreamHandler)
        monkeypatch.setenv("JOURNAL_STREAM", "1:2")
        assert isinstance(log_handler(), logging.StreamHandler)
        status = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        handler = log_handler()
        assert isinstance(handler, JournalHandler)
        handler.close()


@pytest.mark.parametrize(
    ("status", "faults", "held", "trouble", "line"),
    [
        (None, [], None, None, "idle"),
        (MissionStatus(0.0, "done", 7, 7), [], None, None, "idle"),
        (MissionStatus(0.0, "observing", 3, 7, "slot 2"), [], None, None, "observing at stop 3 of 7: slot 2"),
        (
            MissionStatus(0.0, "paused", 3, 7, "battery"),
            ["left: unplugged"],
            "the left bumper is pressed",
            "no answer",
            "paused at stop 3 of 7: battery; left: unplugged; held: the left bumper is pressed; upload: no answer",
        ),
        (None, ["a\nb" + 400 * "x"], None, None, "idle; a b" + 291 * "x"),
    ],
)
def test_the_status_line_says_what_is_done_and_what_is_wrong(status, faults, held, trouble, line):
    assert describe(status, faults, held, trouble) == line
