"""Recordings reach the server whole, once, over links that are cut, and it never takes more than it can."""

import asyncio
import base64
import hashlib
import http.client
import json
import socket
import threading
from contextlib import asynccontextmanager, contextmanager

import pytest
import uvicorn

from robotd.errors import InputError
from robotd.recording_upload import PIECE, RecordingUploader, uploaded_mark
from robotd.server.app import create_app
from robotd.server.recordings import OffsetError, Plan, RecordingStore, TooLargeError
from robotd.server.store import ConflictError, Store, StoreError
from robotd.web import WebServer

TOKEN = "secret"


def noise(size, seed=1):
    import random

    return random.Random(seed).randbytes(size)


def plan_of(data):
    return Plan(len(data), hashlib.sha256(data).hexdigest())


# ---- the store -------------------------------------------------------------------------------------------------------


def test_pieces_become_the_file_and_the_same_again_changes_nothing(tmp_path):
    store, data = RecordingStore(tmp_path, keep_free=0), noise(5000)
    assert store.received("a") == (0, False)
    assert store.put("a", plan_of(data), 0, data[:2000]) == (2000, False)
    assert store.received("a", plan_of(data)) == (2000, False)
    assert not list(tmp_path.glob("recordings/*.mcap"))
    assert store.put("a", plan_of(data), 2000, data[2000:]) == (5000, True)
    assert (tmp_path / "recordings" / "a.mcap").read_bytes() == data
    assert store.put("a", plan_of(data), 0, data[:2000]) == (5000, True)
    assert store.list() == {"a": plan_of(data)}
    with pytest.raises(ConflictError, match="exists here with another content"):
        store.put("a", plan_of(noise(5000, 2)), 0, b"x")


def test_a_piece_at_the_wrong_place_says_where_to_go_on(tmp_path):
    store, data = RecordingStore(tmp_path, keep_free=0), noise(5000)
    with pytest.raises(OffsetError) as caught:
        store.put("a", plan_of(data), 100, data[100:200])
    assert caught.value.received == 0
    store.put("a", plan_of(data), 0, data[:1000])
    for start in (500, 1500):
        with pytest.raises(OffsetError) as caught:
            store.put("a", plan_of(data), start, data[start : start + 100])
        assert caught.value.received == 1000
    assert store.received("a") == (1000, False)


def test_a_server_that_was_started_anew_goes_on_and_still_checks_the_whole_hash(tmp_path):
    data = noise(5000)
    RecordingStore(tmp_path, keep_free=0).put("a", plan_of(data), 0, data[:3000])
    assert RecordingStore(tmp_path, keep_free=0).put("a", plan_of(data), 3000, data[3000:]) == (5000, True)
    RecordingStore(tmp_path, keep_free=0).put("b", plan_of(data), 0, b"x" * 3000)
    with pytest.raises(InputError, match="another hash than was announced"):
        RecordingStore(tmp_path, keep_free=0).put("b", plan_of(data), 3000, data[3000:])
    assert RecordingStore(tmp_path).received("b") == (0, False), "it is forgotten, so that it can be sent again"


def test_another_recording_under_the_name_of_an_unfinished_one_begins_anew(tmp_path):
    store, data, other = RecordingStore(tmp_path, keep_free=0), noise(5000), noise(4000, 2)
    store.put("a", plan_of(data), 0, data[:3000])
    assert store.received("a", plan_of(other)) == (0, False)
    assert store.put("a", plan_of(other), 0, other) == (4000, True)


@pytest.mark.parametrize("name", ["../a", "", ".a", "a/b", "a" * 121, "a\n"])
def test_a_name_is_a_name(tmp_path, name):
    with pytest.raises(InputError, match="expected letters, digits"):
        RecordingStore(tmp_path, keep_free=0).put(name, plan_of(b"x"), 0, b"x")
    assert not list(tmp_path.iterdir())


def test_limits(tmp_path):
    data = noise(5000)
    with pytest.raises(TooLargeError, match="has 5000 bytes; this server takes at most 4999"):
        RecordingStore(tmp_path, limit=4999, keep_free=0).put("a", plan_of(data), 0, data)
    with pytest.raises(StoreError, match="no more room to spare"):
        RecordingStore(tmp_path, keep_free=1 << 60).put("a", plan_of(data), 0, data)
    with pytest.raises(InputError, match="a part of it"):
        RecordingStore(tmp_path, keep_free=0).put("a", plan_of(data), 4000, data)


# ---- HTTP ------------------------------------------------------------------------------------------------------------


@contextmanager
def serving(data, limit=1 << 30):
    """A server in a thread; yields its port."""
    started = threading.Event()

    class Server(uvicorn.Server):
        async def startup(self, sockets=None):
            await super().startup(sockets=sockets)
            started.set()

    app = create_app(Store(data), TOKEN, recordings=RecordingStore(data, limit, keep_free=0))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = Server(uvicorn.Config(app, log_level="critical", access_log=False))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        assert started.wait(20)
        try:
            yield listener.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()


def headers(data, first, last, **more):
    digest = base64.b64encode(hashlib.sha256(data).digest()).decode()
    return {
        "Authorization": f"Bearer {TOKEN}",
        "Content-Range": f"bytes {first}-{last}/{len(data)}",
        "Repr-Digest": f"sha-256=:{digest}:",
    } | more


def test_every_refusal_says_why(tmp_path):
    data = noise(100)
    with serving(tmp_path, limit=1000) as port:

        def ask(method, path, body=None, **more):
            line = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
            line.request(method, f"/api/recordings{path}", body, headers(data, 0, 99) | more)
            answer = line.getresponse()
            said = json.loads(answer.read())
            line.close()
            return answer.status, said

        def put(body=data, **changed):
            return ask("PUT", "/a", body, **changed)

        assert put(Authorization="Bearer wrong")[0] == 401
        assert put(**{"Content-Range": "bytes */100"})[0] == 422
        assert put(**{"Repr-Digest": "sha-256=:///:"})[0] == 422
        assert put(data[:50])[0] == 400
        assert put(**{"Content-Digest": f"sha-256=:{base64.b64encode(bytes(32)).decode()}:"})[0] == 400
        assert put(**{"Content-Range": "bytes 0-99/2000"})[0] == 413
        status, said = put(data[50:], **{"Content-Range": "bytes 50-99/100"})
        assert (status, said["received"]) == (409, 0)
        assert put() == (201, {"received": 100, "complete": True})
        entry = {"name": "a", "size": 100, "sha256": hashlib.sha256(data).hexdigest()}
        assert ask("GET", "") == (200, {"recordings": [entry]})


# ---- over links that are cut -----------------------------------------------------------------------------------------


@asynccontextmanager
async def bad_link(port, cuts):
    """A relay whose k-th connection is cut after `cuts[k]` bytes to the server; later ones are good."""
    waiting, carried = list(cuts), []

    async def carry(reader, writer, allowed=None):
        total = 0
        try:
            while data := await reader.read(8192):
                total += len(data)
                if allowed is not None and total > allowed:
                    raise ConnectionResetError
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            if allowed is not None:
                carried.append(total)
            writer.transport.abort()

    async def connected(reader, writer):
        allowed = waiting.pop(0) if waiting else 1 << 60
        there = await asyncio.open_connection("127.0.0.1", port)
        back = asyncio.ensure_future(carry(there[0], writer))
        await carry(reader, there[1], allowed)
        writer.transport.abort()
        await back

    relay = await asyncio.start_server(connected, "127.0.0.1", 0)
    try:
        yield relay.sockets[0].getsockname()[1], carried
    finally:
        relay.close()
        await asyncio.sleep(0.05)


def uploader(tmp_path, port, told, **options):
    options = {"retry_s": 0.01, "timeout_s": 5.0, "delete": False} | options
    return RecordingUploader(
        tmp_path / "robot",
        WebServer(f"http://127.0.0.1:{port}", TOKEN),
        report=lambda *said: told.append(said),
        **options,
    )


async def send_all(sender):
    running = asyncio.ensure_future(sender.run())
    try:
        async with asyncio.timeout(20):
            await sender.wait_empty()
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


def a_recording(tmp_path, size, name="a"):
    (tmp_path / "robot").mkdir(exist_ok=True)
    path = tmp_path / "robot" / f"{name}.mcap"
    path.write_bytes(noise(size, len(name)))
    return path


def test_a_recording_arrives_over_a_link_that_is_cut_again_and_again(tmp_path):
    size = 4 * PIECE + 12345
    path, told = a_recording(tmp_path, size), []

    async def main(port):
        cuts = [100, 1 << 60, 1 << 60, 300_000, 200, 1 << 60, PIECE - 100, 1 << 60, 1 << 60, PIECE + 2000]
        async with bad_link(port, cuts) as (relayed, carried):
            await send_all(uploader(tmp_path, relayed, told))
            return sum(carried)

    with serving(tmp_path / "server") as port:
        carried = asyncio.run(main(port))
    assert (tmp_path / "server" / "recordings" / "a.mcap").read_bytes() == path.read_bytes()
    assert uploaded_mark(path).exists()
    assert carried < size + 4 * PIECE, "what was acknowledged is not sent again"
    assert [level for _, level in told].count("warning") >= 1
    assert told[-1] == (f"a.mcap is on the server ({size / 1e6:.1f} MB)", "info")


def test_what_the_server_has_is_not_sent_again_and_goes_from_the_robot_if_that_is_wanted(tmp_path):
    path, told = a_recording(tmp_path, 2 * PIECE), []
    a_recording(tmp_path, 1000, "bb")

    async def main(port):
        async with bad_link(port, []) as (relayed, carried):
            await send_all(uploader(tmp_path, relayed, told))
            first = sum(carried)
            for mark in (tmp_path / "robot").glob("*.uploaded"):
                mark.unlink()
            await send_all(uploader(tmp_path, relayed, told, delete=True))
            return first, sum(carried) - first

    with serving(tmp_path / "server") as port:
        first, again = asyncio.run(main(port))
    assert first > 2 * PIECE
    assert again < 2000
    assert not path.exists()
    assert len(list((tmp_path / "server" / "recordings").glob("*.mcap"))) == 2


def test_a_refused_recording_is_told_once_holds_up_no_other_and_is_offered_again(tmp_path, monkeypatch):
    a_recording(tmp_path, 1000, "a")
    a_recording(tmp_path, 1000, "b b")
    a_recording(tmp_path, 1000, "ccc")
    told, refusals = [], []

    async def main(port):
        sender = uploader(tmp_path, port, told)
        exchange = sender.server.exchange

        async def strict(method, target, **more):
            if "b%20b" in target and len(refusals) < 2:
                refusals.append({path.stem for path in (tmp_path / "server" / "recordings").glob("*.mcap")})
                return 413, b'{"problems": ["the recording is larger than is taken here"]}'
            return await exchange(method, target.replace("b%20b", "b"), **more)

        monkeypatch.setattr(sender.server, "exchange", strict)
        await send_all(sender)

    with serving(tmp_path / "server") as port:
        asyncio.run(main(port))
    assert refusals == [{"a"}, {"a", "ccc"}]
    errors = [text for text, level in told if level == "error"]
    assert len(errors) == 1
    assert errors[0].startswith("b b.mcap is refused and stays on the robot")
    assert {path.stem for path in (tmp_path / "server" / "recordings").glob("*.mcap")} == {"a", "b", "ccc"}


def test_something_else_than_our_server_takes_nothing(tmp_path):
    path, told = a_recording(tmp_path, 1000), []

    async def portal(reader, writer):
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\nConnection: close\r\n\r\nhello")
        await writer.drain()
        writer.close()

    async def main():
        async with await asyncio.start_server(portal, "127.0.0.1", 0) as server:
            running = asyncio.ensure_future(
                uploader(tmp_path, server.sockets[0].getsockname()[1], told, retry_s=0.01).run()
            )
            while not told:
                await asyncio.sleep(0.01)
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    asyncio.run(main())
    assert "not as a robotd-solver does" in told[0][0]
    assert path.exists()
    assert not uploaded_mark(path).exists()
