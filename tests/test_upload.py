"""Every record reaches the server, whatever the network does, and no answer but the server's own counts."""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import subprocess
import sys
import threading
from contextlib import asynccontextmanager, contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace

import pytest

from robotd.clock import now, run_virtual
from robotd.errors import UploadError
from robotd.files import map_to_json
from robotd.journal import Journal
from robotd.journal_records import digest, stop_body
from robotd.records import CameraModel, Map, Pose, Rig, Sighting, SolverRun, Stop, Survey, Transform
from robotd.server.store import ConflictError, Store
from robotd.upload import Uploader
from robotd.web import WebServer

CAMERA = CameraModel("front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((0.0, 0.0, 0.0), (0.06, 0.0, 0.5)))
HEADER = Survey("Laden Süd 1", Rig((CAMERA,)), (), created="2026-11-21T10:00:00Z")
MAP = Map(HEADER.survey, "first stop", (), (), (), 0.0, 0.0, SolverRun(1, True, "bundle"))


def make_stop(number, leg=1):
    return Stop(leg, number, "2026-11-21T10:01:12.5Z", Pose(0.1 * number, 0.2, 0.3), None)


@pytest.fixture
def journal(tmp_path):
    with Journal.open(tmp_path / "journal.sqlite") as journal:
        journal.begin_leg(HEADER)
        yield journal


class Script:
    """A server that treats each request as the next word says: ok, a status, reset, hang up, portal, wrong."""

    def __init__(self, *words):
        self.words = list(words)
        self.requests = []

    def next_word(self):
        return self.words.pop(0) if self.words else "ok"


@contextmanager
def scripted(*words):
    script = Script(*words)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_):
            pass

        def do_GET(self):
            self.do_PUT()

        def do_PUT(self):
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            script.requests.append((self.command, self.path, dict(self.headers), body))
            word = script.next_word()
            if word == "reset":  # close with a pending linger of 0 sends RST
                self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                self.connection.close()
                self.close_connection = True
            elif word == "hang up":
                self.close_connection = True
            elif word == "silent":
                release.wait(20)
                self.close_connection = True
            elif word == "cut":
                self.wfile.write(b"HTTP/1.1 200 OK\r\nContent-Length: 500\r\n\r\n{")
                self.close_connection = True
            elif word == "garbage":
                self.wfile.write(b"SSH-2.0-OpenSSH_9.2\r\n")
                self.close_connection = True
            elif word == "portal":
                self.reply(200, b"<html>Welcome to our guest network</html>")
            elif word == "redirect":
                self.reply(302, b"", Location="http://portal.example/")
            elif word == "wrong":
                self.reply(200, json.dumps({"sha256": digest(body + b"x")}).encode())
            elif word == "map":
                self.reply(200, map_to_json(MAP))
            elif word == "ok":
                self.reply(200, json.dumps({"sha256": digest(body)}).encode())
            else:
                self.reply(int(word), json.dumps({"problems": [f"because {word}"]}).encode())

        def reply(self, status, body, **headers):
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

    release = threading.Event()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.handle_error = lambda *_: None
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    script.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield script
    finally:
        release.set()
        server.shutdown()
        server.server_close()
        thread.join()


@asynccontextmanager
async def uploading(journal, url, retry_s=5.0, timeout_s=30.0, token="secret"):
    reports = []

    def report(text, level="info"):
        reports.append((now(), level, text))

    uploader = Uploader(journal, WebServer(url, token), retry_s, timeout_s, report)
    task = asyncio.create_task(uploader.run())
    try:
        yield SimpleNamespace(uploader=uploader, reports=reports, task=task)
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def paths(script):
    return [path for _, path, _, _ in script.requests]


SURVEY = "/api/surveys/Laden%20S%C3%BCd%201"


def test_records_go_out_oldest_first_with_token_and_hash_in_no_virtual_time(journal):
    for number in (1, 2, 3):
        journal.add_stop(HEADER.survey, make_stop(number))

    async def main():
        async with uploading(journal, script.url + "/") as up:
            await up.uploader.wait_empty()
            assert now() == 0.0
            assert up.reports == []

    with scripted() as script:
        run_virtual(main())
    assert journal.pending() == []
    assert paths(script) == [SURVEY, *(f"{SURVEY}/legs/1/stops/{number}" for number in (1, 2, 3))]
    method, _, headers, body = script.requests[1]
    assert method == "PUT"
    assert headers["Authorization"] == "Bearer secret"
    assert headers["Content-Digest"].startswith("sha-256=:")
    assert json.loads(body)["odometry"]["x"] == 0.1


def test_a_stop_that_is_added_later_goes_out_when_the_uploader_is_woken(journal):
    async def main():
        async with uploading(journal, script.url) as up:
            await up.uploader.wait_empty()
            for number in (1, 2):
                await asyncio.sleep(100.0)
                journal.add_stop(HEADER.survey, make_stop(number))
                up.uploader.wake()
                await up.uploader.wait_empty()
                assert now() == 100.0 * number
                assert journal.pending() == []

    with scripted() as script:
        run_virtual(main())
    assert len(script.requests) == 3


@pytest.mark.parametrize(
    ("word", "text"),
    [
        ("500", "answers 500: because 500"),
        ("503", "answers 503"),
        ("401", "answers 401"),
        ("429", "answers 429"),
        ("reset", "cannot be reached"),
        ("hang up", "cannot be reached"),
        ("cut", "cannot be reached"),
        ("garbage", "cannot be reached"),
        ("portal", "does not answer like a robotd-solver; check upload.url"),
        ("redirect", "answers 302: nothing"),
        ("wrong", "does not answer like a robotd-solver"),
    ],
)
def test_what_may_pass_is_tried_again_with_growing_pauses(journal, word, text):
    journal.add_stop(HEADER.survey, make_stop(1))

    async def main():
        async with uploading(journal, script.url) as up:
            await asyncio.sleep(12.0)
            assert len(journal.pending()) == 1
            script.words.clear()
            await up.uploader.wait_empty()
            assert now() == 5.0 + 10.0
            return up.reports

    with scripted("ok", *[word] * 100) as script:
        reports = run_virtual(main())
    assert [(t, level) for t, level, _ in reports] == [(0.0, "warning"), (15.0, "info")]
    assert text in reports[0][2]
    assert reports[1][2] == f"{script.url} takes records again"


def test_pauses_stop_growing(journal):
    async def main():
        async with uploading(journal, script.url, retry_s=1.0) as up:
            await asyncio.sleep(10_000.0)
            assert len(up.reports) == 1

    with scripted(*["500"] * 1000) as script:
        run_virtual(main())
    assert len(script.requests) == 7 + (10_000 - 127) // 64 + 1


def test_a_new_stop_is_tried_at_once_even_in_a_pause(journal):
    async def main():
        async with uploading(journal, script.url, retry_s=3600.0) as up:
            await asyncio.sleep(1.0)
            journal.add_stop(HEADER.survey, make_stop(1))
            up.uploader.wake()
            await up.uploader.wait_empty()
            assert now() == 1.0

    with scripted("500") as script:
        run_virtual(main())


def test_a_refused_stop_is_reported_once_offered_rarely_and_stops_no_other(journal):
    for number in (1, 2, 3):
        journal.add_stop(HEADER.survey, make_stop(number))

    async def main():
        async with uploading(journal, script.url) as up:
            await asyncio.sleep(1.0)
            assert [item.stop for item in journal.pending()] == [2]
            assert [(level, text) for _, level, text in up.reports] == [
                (
                    "error",
                    "survey 'Laden Süd 1' leg 1 stop 2 is refused and stays on the robot: "
                    f"{script.url} answers 422: because 422",
                )
            ]
            journal.add_stop(HEADER.survey, make_stop(4))
            up.uploader.wake()
            await asyncio.sleep(318.0)
            assert len(script.requests) == 5
            await up.uploader.wait_empty()
            assert now() == 640.0
            assert len(up.reports) == 1

    with scripted("ok", "ok", "422", "ok", "ok", "409", "ok") as script:
        run_virtual(main())
    assert paths(script).count(f"{SURVEY}/legs/1/stops/2") == 3


def test_stops_wait_behind_a_header_that_is_refused(journal):
    journal.add_stop(HEADER.survey, make_stop(1))
    other = replace(HEADER, survey="other")
    journal.begin_leg(other)
    journal.add_stop("other", make_stop(1))

    async def main():
        async with uploading(journal, script.url) as up:
            await asyncio.sleep(300.0)
            assert paths(script) == [SURVEY, "/api/surveys/other", "/api/surveys/other/legs/1/stops/1"]
            assert "survey 'Laden Süd 1' is refused" in up.reports[0][2]
            await up.uploader.wait_empty()
            assert now() == 320.0

    with scripted("409") as script:
        run_virtual(main())
    assert paths(script)[3:] == [SURVEY, f"{SURVEY}/legs/1/stops/1"]


def test_a_server_that_lost_its_data_gets_all_of_it_again(journal, tmp_path):
    journal.add_stop(HEADER.survey, make_stop(1))
    for upload in journal.pending():
        journal.acknowledge(upload)
    journal.add_stop(HEADER.survey, make_stop(2))

    async def main():
        with program(tmp_path / "data") as server:
            async with uploading(journal, server.url) as up:
                await up.uploader.wait_empty()
                assert now() == 5.0
                assert "has lost survey 'Laden Süd 1', it gets all of it again" in up.reports[0][2]

    run_virtual(main())
    assert Store(tmp_path / "data").surveys() == {HEADER.survey: 2}


SERVE = """
import sys
from pathlib import Path
from robotd.server.app import serve
serve("127.0.0.1", int(sys.argv[2]), Path(sys.argv[1]), "secret")
"""


@contextmanager
def program(data, port=0):
    command = [sys.executable, "-c", SERVE, str(data), str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        url = process.stdout.readline().rsplit(" ", 1)[1].strip()
        try:
            yield SimpleNamespace(process=process, url=url, port=int(url.rsplit(":", 1)[1]))
        finally:
            process.kill()


def test_no_stop_is_lost_when_the_server_is_killed(journal, tmp_path, monkeypatch):
    for number in range(1, 31):
        journal.add_stop(HEADER.survey, make_stop(number))

    async def main():
        with program(tmp_path / "data") as server:
            acknowledge = journal.acknowledge

            def kill_in_the_middle(upload):
                acknowledge(upload)
                if upload.stop == 12:
                    server.process.kill()
                    server.process.wait()

            monkeypatch.setattr(journal, "acknowledge", kill_in_the_middle)
            async with uploading(journal, server.url) as up:
                await asyncio.sleep(60.0)
                assert up.reports[0][1] == "warning"
                assert len(journal.pending()) == 18
                monkeypatch.undo()
                with program(tmp_path / "data", server.port):
                    await up.uploader.wait_empty()

    run_virtual(main())
    stored = json.loads(Store(tmp_path / "data").survey(HEADER.survey)[0])
    assert [stop["stop"] for stop in stored["stops"]] == list(range(1, 31))


def test_a_server_that_hangs_is_left_after_the_time_limit(journal):
    async def main():
        async with uploading(journal, script.url, retry_s=0.01, timeout_s=0.05) as up:
            await up.uploader.wait_empty()
            assert f"{script.url} did not answer within 0.05 s" in up.reports[0][2]

    with scripted("silent", "silent") as script:
        asyncio.run(main())
    assert len(script.requests) == 3


def test_nobody_listening_is_said_in_words(journal):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))

        async def main():
            async with uploading(journal, f"http://127.0.0.1:{unused.getsockname()[1]}") as up:
                await asyncio.sleep(1.0)
                assert "cannot be reached: " in up.reports[0][2]
                assert "Connection refused" in up.reports[0][2]

        run_virtual(main())


def test_the_map_is_fetched_in_no_virtual_time(journal):
    async def main():
        uploader = Uploader(journal, WebServer(script.url, None), 5.0, 30.0, print)
        assert await uploader.fetch_map(HEADER.survey) == MAP
        with pytest.raises(UploadError, match="answers 422: because 422") as caught:
            await uploader.fetch_map(HEADER.survey)
        assert caught.value.permanent
        with pytest.raises(UploadError, match="answers 500"):
            await uploader.fetch_map(HEADER.survey)
        with pytest.raises(UploadError, match="the map from http"):
            await uploader.fetch_map(HEADER.survey)
        assert now() == 0.0

    with scripted("map", "422", "500", "portal") as script:
        run_virtual(main())
    assert [path for _, path, _, _ in script.requests] == [f"{SURVEY}/map"] * 4
    assert "Authorization" not in script.requests[0][2]


def test_a_rejected_stop_replaces_what_the_server_has_and_nothing_else_does(tmp_path, journal):
    sighted = replace(make_stop(1), sightings=(Sighting("front", "A1", 1.0, 2.0),))
    journal.add_stop(HEADER.survey, sighted)
    journal.reject(HEADER.survey, 1, 1, "x")

    async def main():
        async with uploading(journal, script.url) as up:
            await up.uploader.wait_empty()

    with scripted() as script:
        run_virtual(main())
    _, _, headers, body = script.requests[1]
    old = stop_body(sighted)
    assert headers["If-Match"] == f'"{digest(old)}"'
    store = Store(tmp_path / "server")
    store.put_header(HEADER.survey, script.requests[0][3])
    assert store.put_stop(HEADER.survey, 1, 1, old)
    with pytest.raises(ConflictError):
        store.put_stop(HEADER.survey, 1, 1, body)
    with pytest.raises(ConflictError):
        store.put_stop(HEADER.survey, 1, 1, body, "0" * 64)
    assert store.put_stop(HEADER.survey, 1, 1, body, digest(old))
    assert not store.put_stop(HEADER.survey, 1, 1, body, digest(old))  # the same once more, after a lost answer
