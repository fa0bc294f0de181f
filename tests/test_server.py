"""The server keeps what it acknowledged, refuses what is wrong in words, and outlives its solver."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import quote

import pytest
import uvicorn
from hypothesis import given, strategies as st

from robotd.config import Config, UploadConfig
from robotd.doctor import check_server
from robotd.errors import InputError, SolverError
from robotd.files import map_from_json, map_to_json, survey_from_json, survey_to_json
from robotd.journal_records import header_body, stop_body
from robotd.records import CameraModel, Map, Move, Pose, Rig, Sighting, SolverRun, Stop, Survey, Transform
from robotd.server import jobs
from robotd.server.app import create_app, serve
from robotd.server.jobs import JobError, MapJobs, worker_pool
from robotd.server.store import ConflictError, Store, StoreError, UnknownSurveyError
from tests.certificates import VALID, certify, fingerprint, needs_openssl
from tests.store_surveys import noisy_room

TOKEN = "secret"
CAMERA = CameraModel(
    "front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((-1.2092, 1.2092, -1.2092), (0.06, 0.0, 0.5))
)
HEADER = Survey("room", Rig((CAMERA,)), (), created="2026-11-21T10:00:00Z")
MOVE = Move(0.75, 0.01, 0.1, ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)))


def make_stop(number=1, leg=1, u=311.2, camera="front"):
    sighting = Sighting(camera, "A17", u, 200.1, 0.1, 0.999)
    return Stop(leg, number, "2026-11-21T10:01:12.5Z", Pose(0.1, 0.2, 0.3), MOVE if number > 1 else None, (sighting,))


def fake_solve(survey: bytes, where: str) -> bytes:
    """A map that only says how many stops it was made from."""
    stops = survey_from_json(survey, where).stops
    if any(sighting.label == "A17" and sighting.u < 1 for stop in stops for sighting in stop.sightings):
        raise RuntimeError("singular")
    if not stops:
        raise SolverError("the survey has no stops")
    solved = Map("room", "first stop", (), (), (), 0.0, 0.0, SolverRun(len(stops), True, "bundle"))
    return map_to_json(solved)


class Counting:
    def __init__(self):
        self.calls = 0

    def __call__(self, survey, where):
        self.calls += 1
        return fake_solve(survey, where)


@contextmanager
def running(store, token=TOKEN, solve=fake_solve):
    """The real server in a thread."""
    started = threading.Event()

    class Server(uvicorn.Server):
        async def startup(self, sockets=None):
            await super().startup(sockets=sockets)
            started.set()

    jobs = MapJobs(store, solve=solve, executor=lambda: ThreadPoolExecutor(1))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = Server(uvicorn.Config(create_app(store, token, jobs=jobs), log_level="critical", access_log=False))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        assert started.wait(20)
        port = listener.getsockname()[1]
        try:
            request = partial(ask, port)
            request.port = port
            yield request
        finally:
            server.should_exit = True
            thread.join()


def ask(port, method, path, body=None, token=TOKEN, **headers):
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    line.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
    answer = line.getresponse()
    data = json.loads(answer.read())
    line.close()
    return answer.status, data


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "data")


@pytest.fixture
def server(store):
    with running(store) as server:
        yield server


ROOM = "/api/surveys/room"


def put_survey(server, *numbers):
    assert server("PUT", ROOM, header_body(HEADER))[0] in (200, 201)
    for number in numbers:
        assert server("PUT", f"{ROOM}/legs/1/stops/{number}", stop_body(make_stop(number)))[0] in (200, 201)


def test_a_survey_comes_back_as_it_was_sent(server):
    assert server("GET", "/api/surveys") == (200, {"surveys": []})
    assert server("PUT", ROOM, header_body(HEADER))[0] == 201
    for number in (1, 2, 10):
        body = stop_body(make_stop(number))
        status, data = server("PUT", f"{ROOM}/legs/1/stops/{number}", body)
        assert (status, data) == (201, {"sha256": hashlib.sha256(body).hexdigest()})
    assert server("GET", "/api/surveys") == (200, {"surveys": [{"survey": "room", "stops": 3}]})
    status, data = server("GET", ROOM)
    assert status == 200
    stops = (make_stop(1), make_stop(2), make_stop(10))
    assert survey_from_json(json.dumps(data).encode(), "survey") == replace(HEADER, stops=stops)


def test_the_same_record_again_is_welcome_and_another_content_is_not(server):
    put_survey(server, 1)
    assert server("PUT", ROOM, header_body(HEADER))[0] == 200
    assert server("PUT", f"{ROOM}/legs/1/stops/1", stop_body(make_stop(1)))[0] == 200
    status, data = server("PUT", f"{ROOM}/legs/1/stops/1", stop_body(make_stop(1, u=12.0)))
    assert status == 409
    assert data == {"problems": ["survey 'room' leg 1 stop 1: the server has it with another content, and keeps that"]}
    status, data = server("PUT", ROOM, header_body(replace(HEADER, created=None)))
    assert status == 409
    assert "its 1 stops came with another header" in data["problems"][0]
    assert server("GET", ROOM)[1]["stops"][0]["sightings"][0]["u"] == 311.2


def test_a_header_may_change_while_there_is_no_stop(server):
    put_survey(server)
    assert server("PUT", ROOM, header_body(replace(HEADER, created=None)))[0] == 201
    assert server("GET", ROOM)[1]["created"] is None


def test_every_mistake_of_a_record_is_named(server):
    broken = json.loads(stop_body(make_stop(2, camera="frnt")))
    broken["sightings"][0]["v"] = "high"
    broken["colour"] = "green"
    put_survey(server)
    status, data = server("PUT", f"{ROOM}/legs/1/stops/2", json.dumps(broken))
    assert status == 422
    text = "\n".join(data["problems"])
    assert "survey 'room' leg 1 stop 2 sightings[0].v: found 'high'; expected a number" in text
    assert "unknown key 'colour'" in text
    status, data = server("PUT", f"{ROOM}/legs/1/stops/2", stop_body(make_stop(2, camera="frnt")))
    assert (status, len(data["problems"])) == (422, 1)
    assert "frnt" in data["problems"][0]
    for body in (b"", b"\xff", b"[]", b"{", b"[" * 100_000):
        for path in (ROOM, f"{ROOM}/legs/1/stops/2"):
            status, data = server("PUT", path, body)
            assert status == 422
            assert data["problems"]


def test_records_must_lie_under_their_own_address(server):
    put_survey(server)
    status, data = server("PUT", "/api/surveys/shop", header_body(HEADER))
    assert status == 422
    assert "found 'room'; expected the name in the address" in data["problems"][0]
    status, data = server("PUT", f"{ROOM}/legs/1/stops/3", stop_body(make_stop(2)))
    assert status == 422
    assert "found leg 1 stop 2; expected those in the address" in data["problems"][0]
    for leg, stop in ((0, 1), (1, 0), (-1, 1), (10**9, 1), ("one", 1), (1, "1.5")):
        assert server("PUT", f"{ROOM}/legs/{leg}/stops/{stop}", stop_body(make_stop()))[0] == 422


def test_a_stop_without_its_survey_is_told_to_wait_for_it(server):
    status, data = server("PUT", f"{ROOM}/legs/1/stops/1", stop_body(make_stop()))
    assert (status, data) == (404, {"problems": ["survey 'room': unknown here; send its header first"]})
    assert server("GET", ROOM)[0] == 404
    assert server("GET", f"{ROOM}/map")[0] == 404


def test_only_who_has_the_token_is_served(store, server):
    for token in (None, "wrong", "", TOKEN + "x", "geheim-ü"):
        for method, path in (("GET", "/api/surveys"), ("PUT", ROOM), ("GET", f"{ROOM}/map")):
            status, data = server(method, path, header_body(HEADER) if method == "PUT" else None, token=token)
            assert status == 401
            assert "Authorization: Bearer" in data["problems"][0]
    assert store.surveys() == {}
    assert server("GET", "/healthz", token=None) == (200, {"ok": True})


def test_without_a_token_everybody_is_served(store):
    with running(store, token=None) as server:
        assert server("GET", "/api/surveys", token=None)[0] == 200


def test_other_addresses_and_methods_are_refused_in_json(server):
    assert server("GET", "/nowhere") == (404, {"problems": ["Not Found"]})
    assert server("DELETE", ROOM)[0] == 405
    assert server("GET", "/api/surveys/a/b/c")[0] == 404
    assert server("GET", "/docs")[0] == 404


def test_a_body_that_is_too_large_is_refused_and_the_server_lives(server):
    status, data = server("PUT", ROOM, b" " * (9 << 20))
    assert status == 413
    assert "more than 8388608 bytes" in data["problems"][0]
    assert server("GET", "/healthz")[0] == 200


def test_a_body_that_was_damaged_on_the_way_is_refused(server):
    body = header_body(HEADER)

    def hashed(data):
        return f"sha-256=:{base64.b64encode(hashlib.sha256(data).digest()).decode()}:"

    assert server("PUT", ROOM, body, Content_Digest=hashed(body + b" "))[0] == 400
    assert server("GET", "/api/surveys")[1]["surveys"] == []
    assert server("PUT", ROOM, body, Content_Digest=hashed(body))[0] == 201
    assert server("PUT", ROOM, body, Content_Digest="md5=:eHh4:")[0] == 200


def test_a_client_that_leaves_in_the_middle_does_no_harm(store, server):
    port = server.port
    with socket.create_connection(("127.0.0.1", port), 10) as line:
        line.sendall(
            f"PUT {ROOM} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\nContent-Length: 999\r\n\r\n{{".encode()
        )
    assert server("GET", "/healthz")[0] == 200
    assert store.surveys() == {}


@pytest.mark.parametrize("name", ["Läden, Ost 3", "...", "..a", "a%2Fb", "C:\\temp", "NUL", "a\tb", "~", "-rf"])
def test_any_name_stays_inside_the_data_folder(store, tmp_path, name):
    store.put_header(name, header_body(replace(HEADER, survey=name)))
    store.put_stop(name, 1, 1, stop_body(make_stop()))
    assert store.surveys() == {name: 1}
    (folder,) = (tmp_path / "data" / "surveys").iterdir()
    assert sorted(path.name for path in folder.iterdir()) == ["header.json", "stop-1-1.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data"]
    assert "." not in folder.name


def test_names_that_no_folder_can_have_are_refused(store):
    for name in ("", "x" * 300):
        with pytest.raises(InputError):
            store.put_header(name, header_body(replace(HEADER, survey=name)))
    with pytest.raises(UnknownSurveyError):
        store.survey("..")


def test_quoted_names_come_through_the_address(server):
    name = "Läden, Ost 3 %2F?#&"
    assert server("PUT", f"/api/surveys/{quote(name, safe='')}", header_body(replace(HEADER, survey=name)))[0] == 201
    assert server("GET", "/api/surveys")[1]["surveys"] == [{"survey": name, "stops": 0}]


def test_what_a_crash_left_half_written_is_not_there(store, tmp_path):
    store.put_header("room", header_body(HEADER))
    folder = tmp_path / "data" / "surveys" / "room"
    (folder / ".stop-1-1.json.999.new").write_bytes(b'{"leg": 1, ')
    (tmp_path / "data" / "surveys" / "shop").mkdir()
    assert Store(tmp_path / "data").surveys() == {"room": 0}
    with pytest.raises(UnknownSurveyError):
        store.survey("shop")


def test_a_full_disk_is_the_servers_trouble_and_not_the_senders(store, server, monkeypatch):
    put_survey(server, 1)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    status, data = server("PUT", f"{ROOM}/legs/1/stops/2", stop_body(make_stop(2)))
    assert status == 507
    assert "No space left on device" in data["problems"][0]
    monkeypatch.undo()
    assert server("PUT", f"{ROOM}/legs/1/stops/2", stop_body(make_stop(2)))[0] == 201
    with pytest.raises(StoreError):
        Store(Path("/dev/null")).put_header("room", header_body(HEADER))


def test_the_store_tells_conflicts_from_mistakes(store):
    store.put_header("room", header_body(HEADER))
    assert store.put_stop("room", 1, 1, stop_body(make_stop()))
    assert not store.put_stop("room", 1, 1, stop_body(make_stop()))
    with pytest.raises(ConflictError):
        store.put_stop("room", 1, 1, stop_body(make_stop(u=1.0)))


# ---- maps ------------------------------------------------------------------------------------------------------------


def test_a_map_is_solved_once_per_revision(store):
    solve = Counting()
    with running(store, solve=solve) as server:
        put_survey(server, 1)
        maps = [server("GET", f"{ROOM}/map")[1]["solver"]["iterations"] for _ in range(3)]
        put_survey(server, 1, 2)
        maps += [server("GET", f"{ROOM}/map")[1]["solver"]["iterations"] for _ in range(2)]
    assert maps == [1, 1, 1, 2, 2]
    assert solve.calls == 2
    with running(store, solve=solve) as server:
        assert server("GET", f"{ROOM}/map")[0] == 200
    assert solve.calls == 2


def test_the_server_answers_while_it_solves_and_solves_a_map_once_for_all(store):
    begun, go_on = threading.Event(), threading.Event()
    solve = Counting()

    def slow(survey, where):
        begun.set()
        assert go_on.wait(20)
        return solve(survey, where)

    with running(store, solve=slow) as server, ThreadPoolExecutor(3) as clients:
        put_survey(server, 1)
        maps = [clients.submit(server, "GET", f"{ROOM}/map") for _ in range(3)]
        assert begun.wait(20)
        assert server("GET", "/healthz")[0] == 200
        put_survey(server, 1, 2)
        assert not any(job.done() for job in maps)
        go_on.set()
        assert [job.result()[1]["solver"]["iterations"] for job in maps] == [1, 1, 1]
        assert server("GET", f"{ROOM}/map")[1]["solver"]["iterations"] == 2
    assert solve.calls == 2


def test_a_survey_that_cannot_be_solved_says_why(server):
    put_survey(server)
    assert server("GET", f"{ROOM}/map") == (422, {"problems": ["the survey has no stops"]})
    put_survey(server, 2)  # a first stop that has a move: each record is fine, together they are not
    status, data = server("GET", f"{ROOM}/map")
    assert status == 422
    assert "stops[0].move" in data["problems"][0]


def test_a_bug_in_the_solver_is_an_answer_and_not_the_end(server):
    put_survey(server, 1)
    server("PUT", f"{ROOM}/legs/2/stops/1", stop_body(make_stop(leg=2, u=0.5)))
    status, data = server("GET", f"{ROOM}/map")
    assert (status, data) == (500, {"problems": ["the server failed: RuntimeError: singular"]})
    assert server("GET", "/healthz")[0] == 200


def test_a_solver_process_that_dies_is_replaced(store):
    store.put_header("room", header_body(HEADER))
    store.put_stop("room", 1, 1, stop_body(make_stop()))

    async def main():
        jobs = MapJobs(store, solve=die_once, executor=worker_pool)
        marker = store._folder / "died"
        os.environ["ROBOTD_TEST_MARKER"] = str(marker)
        try:
            with pytest.raises(JobError, match="the solver process died"):
                await jobs.map("room")
            assert json.loads(await jobs.map("room"))["stops"] == 1
        finally:
            jobs.close()
            del os.environ["ROBOTD_TEST_MARKER"]

    asyncio.run(main())


class DieOnce:
    """Kills its process in the first job; travels to the worker as code, because this file is no module there."""

    def __reduce__(self):
        code = (
            "lambda survey, where: (lambda os, json: b'{\"stops\": %d}' % len(json.loads(survey)['stops'])"
            " if os.path.exists(os.environ['ROBOTD_TEST_MARKER'])"
            " else (open(os.environ['ROBOTD_TEST_MARKER'], 'x').close(), os.kill(os.getpid(), 9))"
            ")(__import__('os'), __import__('json'))"
        )
        return eval, (code,)


die_once = DieOnce()


# ---- nonsense --------------------------------------------------------------------------------------------------------

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


@st.composite
def spoilt(draw, body):
    """A record as robots send it, with one value, key or stretch of bytes that no robot sends."""
    if draw(st.booleans()):
        at = draw(st.integers(0, len(body)))
        return body[:at] + draw(st.binary(max_size=8)) + body[draw(st.integers(at, len(body))) :]
    whole = json.loads(body)
    part = whole
    while isinstance(part, (dict, list)) and part:
        key = draw(st.sampled_from(sorted(part))) if isinstance(part, dict) else draw(st.integers(0, len(part) - 1))
        if draw(st.booleans()) or not isinstance(part[key], (dict, list)) or not part[key]:
            part[key] = draw(VALUES)
            break
        part = part[key]
    return json.dumps(whole).encode()


def test_no_record_however_spoilt_makes_the_server_fail_or_change_what_it_has(server):
    put_survey(server, 1, 2)
    before = server("GET", ROOM)
    places = [ROOM, f"{ROOM}/legs/1/stops/1", f"{ROOM}/legs/1/stops/2", "/api/surveys/other", f"{ROOM}/legs/0/stops/x"]

    @given(st.sampled_from(places), spoilt(header_body(HEADER)) | spoilt(stop_body(make_stop(2))))
    def put(place, body):
        status, answer = server("PUT", place, body)
        assert status < 500, answer
        assert status in (200, 201) or answer["problems"]

    put()
    assert server("GET", ROOM) == before


# ---- the program -----------------------------------------------------------------------------------------------------

SERVE = """
import sys
from pathlib import Path
from robotd.server.app import serve
certificate = tuple(map(Path, sys.argv[2:])) or None
serve("127.0.0.1", 0, Path(sys.argv[1]), "secret", certificate=certificate)
"""


@contextmanager
def program(data, *certificate):
    command = [sys.executable, "-c", SERVE, *map(str, (data, *certificate))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        line = process.stdout.readline()
        assert line.startswith(f"robotd-solver: listening on http{'s' if certificate else ''}://127.0.0.1:")
        port = int(line.rsplit(":", 1)[1])
        try:
            yield SimpleNamespace(process=process, port=port, ask=lambda *args, **kwargs: ask(port, *args, **kwargs))
        finally:
            process.kill()


def test_what_was_acknowledged_survives_kill_9(tmp_path):
    with program(tmp_path) as first:
        put_survey(first.ask, 1, 2)
    with program(tmp_path) as second:
        assert [stop["stop"] for stop in second.ask("GET", ROOM)[1]["stops"]] == [1, 2]
        second.process.send_signal(signal.SIGTERM)
        assert second.process.wait(20) in (0, -signal.SIGTERM)


@needs_openssl
def test_over_tls_a_robot_is_served_and_doctor_sees_which_server_and_token_it_is(tmp_path):
    certificate, key = certify(tmp_path, "server", "127.0.0.1", VALID)
    with program(tmp_path, certificate, key) as server:
        url = f"https://127.0.0.1:{server.port}"
        for token, pins, expected in (
            ("secret", [fingerprint(certificate)], [("ok", "server"), ("ok", "token")]),
            ("wrong", [], [("ok", "server"), ("error", "token")]),
            ("secret", ["0" * 64], [("error", "server")]),
        ):
            (tmp_path / "token").write_text(token)
            upload = UploadConfig(url=url, token_file=Path("token"), ca_file=Path("server.pem"), pins=tuple(pins))
            found = list(check_server(Config(upload=upload), tmp_path))
            assert [(item.level, item.what) for item in found] == expected, found
    with pytest.raises(InputError, match=r"certificate .*server.key with key .* cannot be used"):
        serve("127.0.0.1", 0, tmp_path, None, certificate=(key, key))


def test_addresses_that_cannot_be_had_are_explained(tmp_path):
    with pytest.raises(InputError, match=r"without a token only 127.0.0.1 may be served; give --token-file"):
        serve("0.0.0.0", 0, tmp_path, None)
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(InputError, match=r"cannot listen on 127.0.0.1"),
    ):
        serve("127.0.0.1", taken.getsockname()[1], tmp_path, None)


def test_the_solver_process_places_labels_from_stops_that_were_sent(tmp_path):
    camera = CameraModel(  # looks to the left
        "left", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((-1.5707963267948966, 0.0, 0.0), (0.0, 0.06, 0.5))
    )
    labels = {"A1": (0.0, 2.0, 0.8), "A2": (0.5, 2.1, 0.4), "A3": (1.0, 1.8, 1.2), "A4": (0.7, 2.2, 1.0)}
    exact = ((1e-6, 0.0, 0.0), (0.0, 1e-6, 0.0), (0.0, 0.0, 1e-6))
    with program(tmp_path) as server:
        header = Survey("shop", Rig((camera,)), ())
        assert server.ask("PUT", "/api/surveys/shop", header_body(header))[0] == 201
        for number in (1, 2, 3):
            x = 0.5 * (number - 1)
            sightings = tuple(
                Sighting("left", label, 319.5 + 268.5 * (at[0] - x) / depth, 239.5 - 268.5 * (at[2] - 0.5) / depth)
                for label, at in labels.items()
                for depth in (at[1] - 0.06,)
            )
            move = None if number == 1 else Move(0.5, 0.0, 0.0, exact)
            stop = Stop(1, number, "2026-11-21T10:00:00Z", Pose(x, 0.0, 0.0), move, sightings)
            assert server.ask("PUT", f"/api/surveys/shop/legs/1/stops/{number}", stop_body(stop))[0] == 201
        status, solved = server.ask("GET", "/api/surveys/shop/map")
        assert status == 200
        for entry in solved["labels"]:
            assert entry["status"] == "placed"
            assert entry["position"] == pytest.approx(labels[entry["label"]], abs=1e-3)
        assert len(solved["labels"]) == 4
        server.process.kill()
        server.process.wait()  # its worker must not outlive it
        assert server.process.stdout.read() == ""


def test_a_map_is_solved_as_soon_as_a_stop_comes(store):
    begun = threading.Event()

    def solve(survey, where):
        begun.set()
        return fake_solve(survey, where)

    with running(store, solve=solve) as server:
        put_survey(server, 1)
        assert begun.wait(20)


def test_a_survey_with_one_stop_more_grows_from_its_last_map(monkeypatch):
    survey, _ = noisy_room()
    monkeypatch.setattr(jobs, "_growing", {})
    growing = []
    for count in (4, 5, 7):
        part = replace(survey, stops=survey.stops[:count])
        result = map_from_json(jobs.solve_json(survey_to_json(part), "test"), "test")
        assert len(result.stops) == count
        growing.append(jobs._growing["test"])
    assert growing[0] is growing[1] is growing[2]
    jobs.solve_json(survey_to_json(replace(survey, created="2026-11-22T10:00:00Z")), "test")
    assert jobs._growing["test"] is not growing[0]
