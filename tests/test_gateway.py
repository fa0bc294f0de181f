"""Flash requests reach the watched folder once, whoever dies in between; noise never stops the gateway."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from types import SimpleNamespace

import pytest
from hypothesis import given, settings, strategies as st

import robotd.gateway as gateway
from robotd.clock import run_virtual
from robotd.gateway import Gateway, Outbox, main
from tests.label_gateway import FLASH, TOKEN, ask, files, make_desk, program


@pytest.fixture
def desk(tmp_path):
    return make_desk(tmp_path)


# ---- requests --------------------------------------------------------------------------------------------------------


def test_a_flash_becomes_one_instruction_file(desk, tmp_path):
    assert ask(desk, FLASH) == {"id": 1, "ok": True, "refused": {}}
    assert ask(desk, {**FLASH, "id": "x", "labels": ["C1"], "duration": 255, "strength": 0.5})["id"] == "x"
    assert files(tmp_path) == {
        "robotd-000000000001.txt": "FLASH;A17;3;1.0\nFLASH;B 2;3;1.0\n",
        "robotd-000000000002.txt": "FLASH;C1;255;0.5\n",
    }
    assert ask(desk, {"id": 2, "token": TOKEN, "method": "status"}) == {
        "id": 2,
        "ok": True,
        "waiting": 2,
        "trouble": None,
    }


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"token": "wrong"}, "token: missing or wrong"),
        ({"token": None}, "token: missing or wrong"),
        ({"token": "\ud800"}, "token: missing or wrong"),
        ({"method": "glow"}, 'method: found "glow"; expected flash, labels or status'),
        ({"method": None}, "method: found null"),
        ({"id": [1]}, "id: expected a number or a text"),
        ({"labels": []}, "labels: expected a list of 1 to 500"),
        ({"labels": "A1"}, "labels: expected a list"),
        ({"labels": ["A1"] * 501}, "labels: expected a list of 1 to 500"),
        ({"labels": [17]}, "labels: found 17"),
        ({"duration": 2.5}, "duration: found 2.5; expected whole seconds from 1 to 255"),
        ({"duration": 0}, "expected whole seconds from 1 to 255"),
        ({"duration": 256}, "expected whole seconds from 1 to 255"),
        ({"duration": True}, "expected whole seconds"),
        ({"duration": float("nan")}, "expected whole seconds"),
        ({"duration": float("inf")}, "expected whole seconds"),
        ({"duration": "3"}, "expected whole seconds"),
        ({"duration": [3]}, "duration: found 1 of them; expected one, or one for each label (2)"),
        ({"duration": [3, 0]}, "found 0; expected whole seconds"),
        ({"strength": 0}, "strength: found 0; expected above 0, at most 1"),
        ({"strength": 1.1}, "strength"),
        ({"strength": float("nan")}, "strength"),
        ({"key": ""}, "key: expected a text"),
        ({"key": 5}, "key: expected a text"),
        ({"colour": "green"}, 'unknown key "colour"; known are duration, key, labels, strength'),
    ],
)
def test_bad_requests_are_refused_with_the_reason(desk, tmp_path, change, text):
    reply = ask(desk, {**FLASH, **change})
    assert reply["ok"] is False
    assert text in reply["error"]
    assert files(tmp_path) == {}


def test_every_label_may_have_its_own_duration(desk, tmp_path):
    assert ask(desk, {**FLASH, "duration": [2, 9]})["ok"]
    assert list(files(tmp_path).values()) == ["FLASH;A17;2;1.0\nFLASH;B 2;9;1.0\n"]


def test_labels_that_cannot_be_asked_are_named_and_the_others_are_asked(desk, tmp_path):
    bad = {"A;1": 'it has ";"', "A\n1": "printable", "x" * 65: "1 to 64", "\ud800": "printable", "": "1 to 64"}
    reply = ask(desk, {**FLASH, "labels": ["A1", *bad, "A2"], "duration": list(range(2, 9))})
    assert reply["ok"]
    assert reply["refused"].keys() == bad.keys()
    assert all(text in reply["refused"][label] for label, text in bad.items())
    assert list(files(tmp_path).values()) == ["FLASH;A1;2;1.0\nFLASH;A2;8;1.0\n"]
    assert ask(desk, {**FLASH, "labels": ["A;1"]})["refused"]
    assert len(files(tmp_path)) == 1


def test_guard_times_hold_files_back_in_their_order_and_over_a_restart(tmp_path):
    outbox = Outbox(tmp_path, guard_s=5.0)
    outbox.open()
    desk = Gateway(outbox, None)

    def flash(label, now):
        line = json.dumps({"method": "flash", "labels": [label], "duration": 3, "key": label}).encode()
        assert json.loads(desk.answer(line, "me", now))["ok"]

    flash("A1", 100.0)
    flash("A2", 101.0)
    flash("A3", 102.0)
    assert [text[6:8] for text in files(tmp_path).values()] == ["A1"]
    assert outbox.waiting() == 3
    assert outbox.release(104.0) == 1.0
    assert outbox.release(105.0) == 5.0
    assert [text[6:8] for text in files(tmp_path).values()] == ["A1", "A2"]
    again = Outbox(tmp_path, guard_s=5.0)
    again.open()
    assert again.release(7.0) is None
    assert [text[6:8] for text in files(tmp_path).values()] == ["A1", "A2", "A3"]
    again.flash(["A3"], [3], 1.0, "A3", "me", 8.0)
    assert len(files(tmp_path)) == 3


def test_a_request_that_was_refused_may_be_made_again_under_its_key(tmp_path, monkeypatch):
    desk = make_desk(tmp_path)
    rename = os.replace

    def refuse(old, new):
        raise PermissionError(13, "in use")

    monkeypatch.setattr(gateway, "PAUSE_S", 0.0)
    monkeypatch.setattr(os, "replace", refuse)
    assert "in use" in ask(desk, {**FLASH, "key": "a"})["error"]
    monkeypatch.setattr(os, "replace", rename)
    assert ask(make_desk(tmp_path), {**FLASH, "key": "a"})["ok"]
    assert ask(make_desk(tmp_path), {**FLASH, "key": "a"})["ok"]
    assert len(files(tmp_path)) == 1


def test_status_tells_of_a_full_disk_until_there_is_room(desk, tmp_path, monkeypatch):
    plain = gateway._write

    def full(path, mode, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(gateway, "_write", full)
    assert "No space left" in ask(desk, FLASH)["error"]
    status = {"token": TOKEN, "method": "status"}
    assert ask(desk, status)["trouble"].endswith("cannot be written: No space left on device")
    monkeypatch.setattr(gateway, "_write", plain)
    assert ask(desk, status)["trouble"] is None
    assert ask(desk, FLASH)["ok"]
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["robotd-000000000001.txt"]


def test_a_file_that_windows_holds_for_a_moment_is_renamed_all_the_same(tmp_path, monkeypatch):
    desk = make_desk(tmp_path)
    rename, refusals = os.replace, iter([True, True, False])

    def sometimes(old, new):
        if next(refusals):
            raise PermissionError(13, "in use")
        rename(old, new)

    monkeypatch.setattr(gateway, "PAUSE_S", 0.0)
    monkeypatch.setattr(os, "replace", sometimes)
    assert ask(desk, FLASH)["ok"]
    assert len(files(tmp_path)) == 1


def test_missing_keys_are_named_together(desk):
    reply = ask(desk, {"token": TOKEN, "method": "flash"})
    assert reply["error"].startswith("missing key 'duration', missing key 'labels'; known are")


def test_the_queue_has_a_limit(desk, tmp_path, monkeypatch):
    monkeypatch.setattr(gateway, "WAITING_LIMIT", 2)
    assert ask(desk, FLASH)["ok"]
    assert ask(desk, FLASH)["ok"]
    assert "2 instruction files wait in" in ask(desk, FLASH)["error"]
    assert "start this program with --clear 60" in ask(desk, FLASH)["error"]
    assert "2 instruction files wait in" in ask(desk, {"token": TOKEN, "method": "status"})["trouble"]
    (tmp_path / "robotd-000000000001.txt").unlink()
    assert ask(desk, FLASH)["ok"]


def test_files_that_a_label_system_leaves_are_cleared_away_in_time_and_only_ours(tmp_path):
    outbox = Outbox(tmp_path, clear_s=60.0)
    outbox.open()
    (tmp_path / "others.txt").write_text("not ours")
    for number in range(3):
        outbox.flash(["A1"], [3], 1.0, None, "test", 10.0 * number)
        outbox.clear(10.0 * number)
    assert outbox.waiting() == 3
    outbox.clear(69.0)
    assert outbox.waiting() == 2
    again = Outbox(tmp_path, clear_s=60.0)  # a restart: how long they have lain there is not known
    again.open()
    again.clear(100.0)
    again.clear(159.0)
    assert again.waiting() == 2
    again.clear(160.0)
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["others.txt"]
    again.flash(["A1"], [3], 1.0, None, "test", 170.0)
    assert [path.name for path in tmp_path.glob("robotd-*.txt")] == ["robotd-000000000004.txt"]


def test_the_program_clears_the_folder_by_itself(tmp_path):
    async def watch():
        desk = Gateway(Outbox(tmp_path, clear_s=60.0), None)
        desk.outbox.open()
        releasing = asyncio.create_task(desk._release())
        desk.outbox.flash(["A1"], [3], 1.0, None, "test", 0.0)
        await asyncio.sleep(50.0)
        assert desk.outbox.waiting() == 1
        await asyncio.sleep(30.0)
        assert desk.outbox.waiting() == 0
        releasing.cancel()

    run_virtual(watch())


def test_a_folder_that_cannot_be_written_is_an_answer(desk, tmp_path):
    shutil.rmtree(tmp_path / ".robotd-labels")
    assert "cannot be written" in ask(desk, FLASH)["error"]
    (tmp_path / ".robotd-labels").mkdir()
    assert ask(desk, FLASH)["ok"]


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.just(TOKEN),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=80) | st.builds(lambda value: json.dumps(value).encode(), values))
def test_any_line_has_an_answer(tmp_path_factory, line):
    desk = make_desk(tmp_path_factory.mktemp("folder"))
    reply = ask(desk, line)
    assert reply["ok"] is False
    assert reply["error"]


@settings(max_examples=300, deadline=None)
@given(st.dictionaries(st.sampled_from([*FLASH, "key", "other"]), values, max_size=3))
def test_any_request_is_obeyed_or_refused_and_only_obeyed_ones_leave_a_file(tmp_path_factory, change):
    folder = tmp_path_factory.mktemp("folder")
    reply = ask(make_desk(folder), {**FLASH, **change})
    asked = reply["ok"] and "waiting" not in reply and len(reply["refused"]) < len({**FLASH, **change}["labels"])
    assert bool(files(folder)) == asked
    for text in files(folder).values():
        assert all(line.count(";") == 3 and line.startswith("FLASH;") for line in text.splitlines())


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from([b"noise", b"", b"[]", b"{}", b"\xff\x00", json.dumps(FLASH).encode()])), st.data())
def test_every_line_has_its_answer_however_the_bytes_are_cut(tmp_path_factory, lines, data):
    desk = make_desk(tmp_path_factory.mktemp("folder"))
    sent = b"".join(line + b"\n" for line in lines) + data.draw(st.sampled_from([b"", b'{"half": 1']))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(sent)), max_size=6)))

    async def run():
        reader = asyncio.StreamReader(limit=gateway.LINE_LIMIT)
        replies = []

        async def nothing():
            await asyncio.sleep(0)

        writer = SimpleNamespace(
            write=replies.append,
            drain=nothing,
            close=lambda: None,
            wait_closed=nothing,
            get_extra_info=lambda name: ("here", 1),
        )
        talk = asyncio.create_task(desk._connected(reader, writer))
        for begin, end in zip([0, *cuts], [*cuts, len(sent)], strict=True):
            reader.feed_data(sent[begin:end])
            await asyncio.sleep(0)
        reader.feed_eof()
        await talk
        return [json.loads(reply) for reply in replies]

    replies = run_virtual(run())
    asked = [line for line in lines if line.strip()]
    assert [reply["ok"] for reply in replies] == [line.startswith(b'{"id"') for line in asked]


def test_deep_nesting_and_long_numbers_are_noise_too(desk):
    for line in (b"[" * 60_000, b'{"id": ' + b"9" * 60_000 + b"}", b'{"method": ' + b"[" * 900 + b"]" * 900 + b"}"):
        assert ask(desk, line)["ok"] is False


# ---- templates -------------------------------------------------------------------------------------------------------


def test_the_instruction_file_follows_the_template(tmp_path):
    outbox = Outbox(tmp_path, "LED {label} t={duration:03d} s={strength:.0%}")
    outbox.open()
    desk = Gateway(outbox, None)
    assert ask(desk, {"method": "flash", "labels": ["A1"], "duration": 7}) == {"id": None, "ok": True, "refused": {}}
    assert files(tmp_path) == {"robotd-000000000001.txt": "LED A1 t=007 s=100%\n"}
    for label in ("A 1", "A=1"):
        assert "which separates" in ask(desk, {"method": "flash", "labels": [label], "duration": 7})["refused"][label]


@pytest.mark.parametrize(
    "template",
    [
        "FLASH",
        "{label}{duration};1",
        "{label.__class__}",
        "{}",
        "{label} {colour}",
        "{label",
        "{label:d}",
        "{label}\n{label}",
    ],
)
def test_templates_that_make_no_line_are_refused(tmp_path, capsys, template):
    with pytest.raises(SystemExit) as stop:
        main(["--folder", str(tmp_path), "--template", template])
    assert stop.value.code == 2
    assert "--template" in capsys.readouterr().err


# ---- crashes ---------------------------------------------------------------------------------------------------------


def test_numbers_go_on_after_a_restart_also_when_the_files_are_gone(tmp_path):
    ask(make_desk(tmp_path), FLASH)
    (tmp_path / "robotd-000000000001.txt").unlink()
    ask(make_desk(tmp_path), FLASH)
    assert list(files(tmp_path)) == ["robotd-000000000002.txt"]
    (tmp_path / ".robotd-labels" / "log").unlink()
    ask(make_desk(tmp_path), FLASH)
    assert list(files(tmp_path))[-1] == "robotd-000000000003.txt"


def test_a_key_is_obeyed_once_also_over_a_restart(tmp_path):
    desk = make_desk(tmp_path)
    for key in ("a", "b", "a", "b"):
        assert ask(desk, {**FLASH, "key": key})["ok"]
    assert len(files(tmp_path)) == 2
    assert ask(make_desk(tmp_path), {**FLASH, "key": "a"})["ok"]
    assert len(files(tmp_path)) == 2


class PowerCutError(BaseException):
    pass


@pytest.mark.parametrize("step", range(8))
def test_a_crash_at_any_step_neither_loses_nor_repeats_a_request(tmp_path, monkeypatch, step):
    left = step

    def cut(function):
        def run(*args, **kwargs):
            nonlocal left
            if left == 0:
                raise PowerCutError
            left -= 1
            return function(*args, **kwargs)

        return run

    monkeypatch.setattr(gateway, "_write", cut(gateway._write))
    monkeypatch.setattr(os, "replace", cut(os.replace))
    desk = make_desk(tmp_path)
    told = []
    try:
        for key in ("a", "b"):
            told.append(ask(desk, {**FLASH, "labels": [key], "key": key})["ok"])
    except PowerCutError:
        pass
    left = 1000
    desk = make_desk(tmp_path)
    for key in ("a", "b"):  # whoever got no answer asks again, under the same key
        assert ask(desk, {**FLASH, "labels": [key], "key": key})["ok"]
    assert [text.split(";")[1] for text in files(tmp_path).values()] == ["a", "b"]
    assert [path.name for path in (tmp_path / ".robotd-labels").iterdir()] == ["log"]


def test_a_log_that_was_cut_off_is_read_up_to_the_cut(tmp_path):
    ask(make_desk(tmp_path), {**FLASH, "key": "a"})
    log = tmp_path / ".robotd-labels" / "log"
    log.write_bytes(log.read_bytes() + log.read_bytes()[:30])
    ask(make_desk(tmp_path), {**FLASH, "key": "b"})
    for key in ("a", "b"):
        ask(make_desk(tmp_path), {**FLASH, "key": key})
    assert len(files(tmp_path)) == 2


def test_the_log_says_who_asked_for_what_and_is_put_aside_when_long(tmp_path, monkeypatch):
    monkeypatch.setattr(gateway, "LOG_LIMIT", 300)
    desk = make_desk(tmp_path)
    for number in range(5):
        desk.answer(json.dumps({**FLASH, "key": str(number)}).encode(), "10.0.0.7")
    work = tmp_path / ".robotd-labels"
    assert sorted(path.name for path in work.iterdir()) == ["log", "log.1"]
    entry = json.loads((work / "log").read_text().splitlines()[-1])
    assert entry.pop("date") > 1.7e9
    assert entry == {
        "file": "robotd-000000000005.txt",
        "key": "4",
        "sender": "10.0.0.7",
        "labels": ["A17", "B 2"],
        "duration": [3, 3],
        "strength": 1.0,
    }
    assert ask(make_desk(tmp_path), {**FLASH, "key": "3"})["ok"]
    assert len(files(tmp_path)) == 5


# ---- the program -----------------------------------------------------------------------------------------------------


def test_the_file_runs_by_itself_on_the_standard_library(tmp_path):
    alone = tmp_path / "robotd_labels.py"
    shutil.copy(gateway.__file__, alone)
    result = subprocess.run(
        [sys.executable, "-I", "-S", str(alone), "--help"], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert "--token-file" in result.stdout


def test_the_program_answers_through_noise_and_leaves_cleanly(tmp_path):
    with program(tmp_path) as running:
        good = json.dumps(FLASH).encode() + b"\n"
        with socket.create_connection(("127.0.0.1", running.port), 10) as line, line.makefile("rb") as replies:
            line.sendall(b"\x00\xff noise\n\n   \n" + good[:20])
            assert not json.loads(replies.readline())["ok"]
            line.sendall(good[20:] + good)
            assert [json.loads(replies.readline())["ok"] for _ in range(2)] == [True, True]
        with socket.create_connection(("127.0.0.1", running.port), 10) as line, line.makefile("rb") as replies:
            line.sendall(b"x" * 200_000)
            assert "a line of more than 65536 bytes" in json.loads(replies.readline())["error"]
        with socket.create_connection(("127.0.0.1", running.port), 10) as line:
            line.sendall(good[:-10])  # and gone
        lines = [socket.create_connection(("127.0.0.1", running.port), 10) for _ in range(32)]
        with socket.create_connection(("127.0.0.1", running.port), 10) as line, line.makefile("rb") as replies:
            assert "more than 32 connections" in json.loads(replies.readline())["error"]
        lines[0].sendall(good)
        assert json.loads(lines[0].recv(1000))["ok"]
        running.process.send_signal(signal.SIGTERM)
        assert running.process.wait(10) == 0
        for line in lines:
            line.close()
    assert len(files(running.watched)) == 3


def test_wrong_command_lines_are_explained(tmp_path, capsys):
    assert main(["--folder", str(tmp_path / "gone")]) == 1
    assert "gone is no folder; --folder is what" in capsys.readouterr().err
    for arguments in (["--token-file", str(tmp_path / "no")], ["--port", "99999"], ["--host", "0.0.0.0"]):
        with pytest.raises(SystemExit):
            main(["--folder", str(tmp_path), *arguments])
    assert "without --token-file only 127.0.0.1" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["--folder", str(tmp_path), "--port", str(taken.getsockname()[1])]) == 1
    assert "robotd-labels: 127.0.0.1 port" in capsys.readouterr().err


def test_files_that_windows_editors_save_are_read_or_refused_in_words(tmp_path, capsys):
    token, watched = tmp_path / "token", tmp_path / "watched"
    watched.mkdir()
    token.write_bytes("\ufeffsecret\r\n".encode())
    assert gateway._text(token).strip() == "secret"
    token.write_bytes("secret".encode("utf-16"))
    with pytest.raises(SystemExit):
        main(["--folder", str(watched), "--token-file", str(token)])
    assert "not UTF-8 at byte 0; save it as UTF-8" in capsys.readouterr().err
    token.write_bytes("\ufeffA1\n".encode())
    desk = Gateway(Outbox(watched), None, token)
    assert ask(desk, {"method": "labels"})["text"] == "A1\n"


def test_a_share_that_knows_no_locks_is_not_taken_for_another_gateway(tmp_path, monkeypatch, capsys):
    fcntl = pytest.importorskip("fcntl")

    def refuse(file, how):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    assert main(["--folder", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert "no file can be locked there (No locks available)" in said
    assert "another" not in said


def test_what_a_virus_scanner_holds_is_withdrawn_all_the_same(tmp_path, monkeypatch):
    def hold(self, *_, **__):
        raise PermissionError(13, "in use")

    desk = make_desk(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(gateway, "PAUSE_S", 0.0)
        patch.setattr(os, "replace", hold)
        patch.setattr(type(tmp_path), "unlink", hold)
        assert "in use" in ask(desk, {**FLASH, "key": "a"})["error"]
    again = make_desk(tmp_path)  # a restart neither obeys it nor takes it for done
    assert files(tmp_path) == {}
    assert ask(again, {**FLASH, "key": "a"})["ok"]
    assert len(files(tmp_path)) == 1


def test_a_file_that_is_quarantined_does_not_block_those_behind_it(tmp_path, monkeypatch, capsys):
    outbox = Outbox(tmp_path, guard_s=5.0)
    outbox.open()
    for number in range(3):
        outbox.flash([f"A{number}"], [3], 1.0, None, "me", 100.0 + number)
    (tmp_path / ".robotd-labels" / "robotd-000000000002.txt").unlink()
    assert outbox.release(105.0) is None
    assert [text[6:8] for text in files(tmp_path).values()] == ["A0", "A2"]
    assert "robotd-000000000002.txt was taken away" in capsys.readouterr().err
    write = gateway._write

    def scanned(path, mode, data):
        write(path, mode, data)
        for file in path.parent.glob("robotd-*.txt"):
            if path.name == "log":  # which is written after it
                file.unlink()

    monkeypatch.setattr(gateway, "_write", scanned)
    with pytest.raises(gateway.RefusedError, match="was taken away by another program"):
        outbox.flash(["A9"], [3], 1.0, "b", "me", 200.0)
    assert outbox.waiting() == 2


def test_a_file_that_is_being_read_does_not_keep_the_others_in_the_folder(tmp_path, monkeypatch):
    outbox = Outbox(tmp_path, clear_s=60.0)
    outbox.open()
    for _ in range(3):
        outbox.flash(["A1"], [3], 1.0, None, "me")
    outbox.clear(0.0)
    remove = type(tmp_path).unlink

    def one_is_held(self, missing_ok=False):
        if self.name.endswith("1.txt"):
            raise PermissionError(13, "in use")
        remove(self, missing_ok)

    monkeypatch.setattr(type(tmp_path), "unlink", one_is_held)
    with pytest.raises(PermissionError):
        outbox.clear(60.0)
    assert list(files(tmp_path)) == ["robotd-000000000001.txt"]


def test_a_log_that_somebody_looks_at_grows_on(tmp_path, monkeypatch):
    desk = make_desk(tmp_path)
    monkeypatch.setattr(gateway, "LOG_LIMIT", 10)
    rename = os.replace

    def held(old, new):
        if str(new).endswith(".1"):
            raise PermissionError(13, "in use")
        rename(old, new)

    monkeypatch.setattr(os, "replace", held)
    assert all(ask(desk, FLASH)["ok"] for _ in range(3))
    assert len((tmp_path / ".robotd-labels" / "log").read_text().splitlines()) == 3


def test_silent_connections_are_closed_because_dead_robots_would_use_them_up(tmp_path, monkeypatch):
    async def run():
        desk = make_desk(tmp_path)
        server = await asyncio.start_server(desk._connected, "127.0.0.1", 0)
        streams = await asyncio.open_connection(*server.sockets[0].getsockname())
        assert await asyncio.wait_for(streams[0].read(), 5.0) == b""
        streams[1].close()
        server.close()
        await asyncio.gather(*desk.clients)
        assert not desk.clients

    monkeypatch.setattr(gateway, "IDLE_S", 0.01)
    asyncio.run(run())


def test_two_gateways_do_not_serve_one_folder(tmp_path, capsys):
    with program(tmp_path) as running:
        assert main(["--folder", str(running.watched)]) == 1
        assert "another robotd-labels serves this folder" in capsys.readouterr().err
        running.process.kill()
        running.process.wait(10)
        with gateway._alone(running.watched / ".robotd-labels"):  # a lock dies with its process
            pass


def test_status_survives_a_folder_that_goes_away(tmp_path, monkeypatch):
    desk = make_desk(tmp_path)
    monkeypatch.setattr(desk.outbox, "trouble", lambda: None)  # it was there a moment ago
    shutil.rmtree(tmp_path)
    assert ask(desk, {"method": "status", "token": TOKEN}) == {"id": None, "ok": True, "waiting": None, "trouble": None}
