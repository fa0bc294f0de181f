"""Coverage-guided fuzzing of what parses bytes from a line, from operators, robots or files, with atheris.

    python -m tests.fuzz.fuzz_oi --seconds 30            every target, one after the other, sharing that time
    python -m tests.fuzz.fuzz_oi --target stream FILE    what a saved input does

Says so and ends well where atheris is not installed (extra `fuzz`): it has wheels for few platforms. A finding is shown
with the name of the file that holds the input, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import hashlib
import importlib.util
import json
import math
import os
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

LAYOUTS = ((29, 13), (43, 44, 35), (7, 9, 10, 11, 12, 14, 21, 22, 25, 26, 35, 43, 44), (100,), (19,), (3, 106))
KINDS = ("inclusive", "exclusive", "auto")
LONGEST = 600  # bytes of an input
SURVEY = Path(__file__).parents[1] / "bench" / "room.survey.json"
LONG_SONG = 1 + 2 * 16  # values


def stream(data: bytes) -> None:
    """Cut anyhow the decoder says the same; every byte is in one event; what it accepts encodes to those bytes."""
    from robotd import oi

    if len(data) < 3:
        return
    ids, kind, step, data = LAYOUTS[data[0] % len(LAYOUTS)], KINDS[data[1] % 3], data[2] % 64 + 1, data[3:]
    whole, cut = oi.StreamDecoder(ids, kind), oi.StreamDecoder(ids, kind)
    size = whole.layout.frame_size
    events = whole.feed(data)
    assert events == [event for at in range(0, len(data), step) for event in cut.feed(data[at : at + step])]
    place = skipped = 0
    for event in events:
        if isinstance(event, oi.SensorValues):
            frame = data[place : place + size]
            place += size
            assert event.end == place
            values = [event.values[key] for key in whole.layout.keys]
            assert frame in (whole.layout.encode(values, "inclusive"), whole.layout.encode(values, "exclusive"))
        else:
            assert data.startswith(event.data, place)
            assert len(event.data) <= whole.RUN
            place += len(event.data)
            skipped += len(event.data)
    assert data[place:] == whole.pending == cut.pending
    assert len(whole.pending) < whole.RUN + 2 * size
    counters = whole.counters
    assert counters == cut.counters
    assert counters.frames * size + counters.skipped_bytes + len(whole._buffer) == len(data) == whole.fed
    assert skipped <= counters.skipped_bytes


def framed(data: bytes) -> None:
    """Every whole frame between noise is found, unless the noise holds a header that could be one's."""
    from robotd import oi

    ids = (29, 13)
    layout = oi.StreamLayout(ids)
    decoder = oi.StreamDecoder(ids)
    count = 0
    for start in range(0, len(data) - 3, 9):
        noise = data[start + 4 : start + 9].replace(bytes((oi.HEADER,)), b"")
        frame = layout.encode([int.from_bytes(data[start : start + 2]), data[start + 2]])
        found = [event for event in decoder.feed(frame) if isinstance(event, oi.SensorValues)]
        count += 1
        assert len(found) == 1
        assert list(found[0].values.values()) == [int.from_bytes(data[start : start + 2]), data[start + 2]]
        assert not [event for event in decoder.feed(noise) if isinstance(event, oi.SensorValues)]
    assert decoder.counters.frames == count


def commands(data: bytes) -> None:
    """Cut anyhow the robot hears the same; what it heard within range encodes to the same bytes."""
    from robotd import oi

    if not data:
        return
    step, data = data[0] % 64 + 1, data[1:]
    whole, cut = oi.CommandDecoder(), oi.CommandDecoder()
    events = whole.feed(data)
    assert events == [event for at in range(0, len(data), step) for event in cut.feed(data[at : at + step])]
    assert whole.pending == cut.pending
    place = 0
    for event in events:
        if isinstance(event, oi.Skipped):
            assert data[place : place + 1] == event.data
            place += 1
            continue
        spec = oi.COMMANDS[data[place]]
        assert spec.name == event.name
        size = 1 + struct.calcsize(spec.code)
        if spec.counted:
            size += 1 + len(event.values) - len(spec.arguments)
        try:
            sent = oi.encode(event.name, *event.values)
        except ValueError:  # out of range: the robot hears it all the same
            sent = None
        if sent is not None and len(event.values) < LONG_SONG:  # of more notes the robot takes 16
            assert sent == data[place : place + size]
        place += size
    assert data[place:] == whole.pending
    assert whole.commands + whole.skipped_bytes == len(events)


def firmware(data: bytes) -> None:
    """Text from the robot, cut anyhow, names the same releases and signs; what is kept of it stays small."""
    from robotd.roomba.firmware import BannerReader

    if not data:
        return
    step, data = data[0] % 64 + 1, data[1:]
    whole, cut = BannerReader(), BannerReader()
    found = whole.feed(data)
    assert found == [item for at in range(0, len(data), step) for item in cut.feed(data[at : at + step])]
    assert whole.firmware == cut.firmware
    assert whole.is_text == cut.is_text


def guardian(data: bytes) -> None:
    """A request for a port is understood or refused in words."""
    from robotd import guardian as module
    from robotd.errors import DriverFault

    try:
        name, baud = module._parse(data)
    except DriverFault as fault:
        assert str(fault).isprintable()
    else:
        assert name
        assert baud > 0
    assert module._quote(data).isprintable()


def recording(data: bytes) -> None:
    """A recording of the serial line is read or refused line by line."""
    from robotd.errors import InputError
    from robotd.serial_log import read_serial_log

    path = Path(os.environ.get("TMPDIR", tempfile.gettempdir())) / f"fuzz-{os.getpid()}.log"
    path.write_bytes(b"# robotd-serial/1\n" + data)
    try:
        found = read_serial_log(path)
    except InputError as error:
        assert error.problems
    else:
        assert all(earlier.t <= later.t for earlier, later in pairwise(found.occurrences))
    finally:
        path.unlink()


def control(data: bytes) -> None:
    """A line at the control socket is understood or refused in words, and so are its parameters."""
    from robotd import rpc
    from robotd.bind import bind
    from robotd.errors import ConfigError
    from robotd.operations import METHODS

    try:
        request = rpc.parse(data)
    except rpc.RpcError as error:
        assert rpc.failure(error).endswith(b"\n")
        return
    assert 0 < len(request.method) <= rpc.METHOD_LIMIT
    for name in (request.method, *METHODS) if len(data) % 8 == 0 else (request.method,):
        if name in METHODS:
            try:
                bind(METHODS[name][0], request.params, name)
            except ConfigError as error:
                assert error.problems
                rpc.failure(rpc.RpcError(rpc.INVALID_PARAMS, *error.problems, id=request.id))
    if request.id is not None:
        rpc.result(request.id, dict(request.params))


def survey(data: bytes) -> None:
    """A damaged survey is refused in words that name the file, or read, kept and solved without a traceback."""
    from robotd.errors import InputError, RobotdError
    from robotd.files import survey_from_json, survey_to_json
    from robotd.solver import solve

    try:
        found = survey_from_json(data if data[:1] == b"{" else _damaged(data), "x")
    except InputError as error:
        assert error.problems
        assert all(problem.startswith("x") for problem in error.problems)
        return
    assert survey_from_json(survey_to_json(found), "x") == found
    try:
        result = solve(found)
    except RobotdError as error:
        assert str(error)
        return
    for label in result.labels:
        assert label.position is None or all(map(math.isfinite, label.position))
        assert label.position is not None or label.reason


class _Server:
    """The server's application on a folder of its own, without sockets and without maps."""

    def __init__(self) -> None:
        from robotd.server.app import create_app
        from robotd.server.recordings import RecordingStore
        from robotd.server.store import Store

        self._folder = tempfile.TemporaryDirectory()
        data = Path(self._folder.name)
        self.store = Store(data)
        self._app = create_app(self.store, None, jobs=self, recordings=RecordingStore(data, 1 << 20, keep_free=0))  # type: ignore[arg-type]
        self._loop = asyncio.new_event_loop()

    def begin(self, survey: str) -> None:
        """No map is made."""

    def put(self, path: str, headers: dict[str, bytes], body: bytes) -> tuple[int, Any]:
        """Status and JSON of the answer."""
        sent: list[dict[str, Any]] = []
        half = len(body) // 2
        pieces = [(body[:half], True), (body[half:], False)]

        async def receive() -> dict[str, Any]:
            piece, more = pieces.pop(0)
            return {"type": "http.request", "body": piece, "more_body": more}

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {
            "type": "http",
            "method": "PUT",
            "path": path,
            "raw_path": path.encode(),
            "query_string": b"",
            "scheme": "http",
            "http_version": "1.1",
            "root_path": "",
            "client": None,
            "server": ("x", 1),
            "headers": [(name.encode(), value) for name, value in headers.items()],
        }
        self._loop.run_until_complete(self._app(scope, receive, send))
        text = b"".join(message.get("body", b"") for message in sent)
        return sent[0]["status"], json.loads(text) if text else None


_servers: list[_Server] = []


def upload(data: bytes) -> None:
    """Whatever is sent to the server is kept or refused in words, and what it kept can be read."""
    if len(data) < 4:
        return
    if not _servers:
        _servers.append(_Server())
    server = _servers[0]
    kind, size, number = data[0], data[1] % 32, data[2]
    name, rest = data[3 : 3 + size].decode(errors="replace"), data[3 + size :]
    body = rest
    if kind & 8:
        table = json.loads(_damaged(rest))
        body = json.dumps(table.get("stops", [{}])[0] if kind & 1 and table.get("stops") else table).encode()
    survey = f"/api/surveys/{name}"
    path = (survey, f"{survey}/legs/1/stops/{number}", f"/api/recordings/{name}", f"/api/{name}")[kind % 4]
    headers = {
        "content-range": b"bytes 0-%d/%d" % (len(body) - 1, len(body) + number % 3),
        "repr-digest": b"sha-256=:%s:" % base64.b64encode(hashlib.sha256(body).digest()),
    }
    if kind & 16:
        headers["content-digest"] = headers["repr-digest"] if kind & 32 else b"sha-256=:" + rest[:60] + b":"
    if kind & 64:
        headers |= {"if-match": rest[:64], "content-range": rest[:40]}
    status, answer = server.put(path, headers, body)
    assert status < 500, answer
    assert status < 300 or status == 307 or answer["problems"], (status, answer)  # 307: a slash too many
    if status < 300:
        for known in server.store.surveys():
            server.store.survey(known)


def _damaged(data: bytes) -> bytes:
    """A small survey in which every three bytes spoil one value."""
    table = json.loads(SURVEY.read_bytes())
    table["stops"] = table["stops"][:3]
    for stop in table["stops"]:
        stop["sightings"] = stop["sightings"][:12]
    places = list(_places(table))
    for at in range(0, len(data) - 2, 3):
        holder, key = places[int.from_bytes(data[at : at + 2]) % len(places)]
        other, name = places[(7 * data[at + 2]) % len(places)]
        spoilt = (None, -1, 0, 1e300, 1e-300, "", "front", [], {}, [[1]], True, 2**70, 1e6, -0.0, 57.3)
        kind = data[at + 2] % (len(spoilt) + 2)
        if kind < len(spoilt):
            holder[key] = spoilt[kind]
        elif kind == len(spoilt):
            there = name in other if isinstance(other, dict) else True
            holder[key] = json.loads(json.dumps(other[name])) if there else None
        elif isinstance(holder, dict):
            holder.pop(key, None)
    return json.dumps(table).encode()


def _places(table: Any) -> Iterator[tuple[Any, Any]]:
    """Every value of nested tables and lists, as the container and the key in it."""
    for key, value in list(table.items() if isinstance(table, dict) else enumerate(table)):
        yield table, key
        if isinstance(value, dict | list):
            yield from _places(value)


TARGETS: dict[str, Callable[[bytes], None]] = {
    "stream": stream,
    "framed": framed,
    "commands": commands,
    "firmware": firmware,
    "guardian": guardian,
    "recording": recording,
    "control": control,
    "survey": survey,
    "upload": upload,
}


def _seeds(target: str) -> list[bytes]:
    """Inputs to begin with: whole frames, every command, the texts that robots print."""
    from robotd import oi

    if target in ("stream", "framed"):
        found = []
        for number, ids in enumerate(LAYOUTS):
            layout = oi.StreamLayout(ids)
            frame = layout.encode([0] * len(layout.keys))
            found += [bytes((number, 0, 7)) + frame * 3, bytes((number, 2, 40)) + frame[3:] + b"mV\r\n" + frame * 2]
        return found
    if target == "commands":
        songs = [oi.encode("song", 1, *(60, 8) * 16), oi.encode("stream", 43, 44), oi.encode("query", 7, 100)]
        return [
            b"\x05" + bytes((spec.opcode, *range(struct.calcsize(spec.code)))) for spec in oi.COMMANDS.values()
        ] + songs
    if target == "firmware":
        return [
            b"\x08\r\nSoft reset!\r\n\xfeRoomba by iRobot!\r\nr3_robot/tags/release-3.2.6:4975 CLEAN\r\n",
            b"\x03r3-robot/tags/release-stm32-3.7.7:6913 CLEAN\r\nprocessor-sleep\r\n",
        ]
    if target == "guardian":
        return [b"open 115200 /dev/ttyUSB0", b"beat", b"open x y"]
    if target == "upload":
        return [
            bytes((kind, 4, 1)) + b"room" + body
            for kind in (0, 1, 2, 9, 8, 24, 57, 74)
            for body in (b"", b"{}", b"\0\0\0")
        ]
    if target == "survey":
        return [b"", b"\x00\x00\x00", b'{"format": "robotd-survey/1"}', *(bytes((k, 40 * k, k)) for k in range(1, 7))]
    if target == "control":
        words = (
            ("drive", {"t": 1.5, "speed": 0.1}),
            ("mission.start", {"survey": "a", "stop": 2}),
            ("calibrate", {"what": "rig"}),
        )
        return [
            json.dumps({"jsonrpc": "2.0", "id": 1, "method": name, "params": given}).encode() for name, given in words
        ]
    return [
        b'# base {"baud": 115200}\n0.0 open /dev/x 115200\n0.1 > 80\n0.2 < 1305\n0.3 wish 0.1 0.2 0.3 me\n0.4 close\n'
    ]


def _run(target: str, seconds: float, files: list[str]) -> None:
    """Fuzz one target in this process; libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(
        include=[
            "robotd.oi",
            "robotd.oi_packets",
            "robotd.roomba.firmware",
            "robotd.serial_log",
            "robotd.rpc",
            "robotd.bind",
            "robotd.files",
            "robotd.survey_checks",
            "robotd.server",
        ]
    ):
        import robotd.bind
        import robotd.files
        import robotd.oi
        import robotd.roomba.firmware
        import robotd.rpc
        import robotd.serial_log
        import robotd.server.app  # noqa: F401
    with tempfile.TemporaryDirectory() as corpus:
        for number, seed in enumerate(_seeds(target)):
            (Path(corpus) / str(number)).write_bytes(seed)
        limits = [f"-max_total_time={max(1, round(seconds))}", f"-max_len={LONGEST}", "-timeout=20"]
        options = [*limits, "-print_final_stats=1", "-artifact_prefix=fuzz-"]
        atheris.Setup([sys.argv[0], *options, *(files or [corpus])], TARGETS[target])
        atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.fuzz_oi", description="fuzz the parsers of bytes")
    parser.add_argument("--seconds", type=float, default=30.0, help="in all (default: 30)")
    parser.add_argument("--target", choices=TARGETS, help="only this one, in this process")
    parser.add_argument("file", nargs="*", help="inputs to try instead of searching")
    arguments = parser.parse_args()
    if importlib.util.find_spec("atheris") is None:
        print("fuzz: atheris is not installed (pip install 'robotd[fuzz]'); nothing was fuzzed")
        return 0
    if arguments.target is not None:
        _run(arguments.target, arguments.seconds, arguments.file)
        return 0
    failed = False
    for target in TARGETS:
        command = [sys.executable, "-m", "tests.fuzz.fuzz_oi", "--target", target]
        done = subprocess.run(
            [*command, "--seconds", str(arguments.seconds / len(TARGETS))], capture_output=True, text=True, check=False
        )
        runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
        print(f"fuzz {target}: {runs[1] if runs else 'no'} inputs, {'FOUND' if done.returncode else 'nothing found'}")
        if done.returncode:
            failed = True
            print(done.stdout[-3000:], done.stderr[-6000:], sep="\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
