"""The driver `pricer` and its gateway: restarts, refusals and impostors."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from robotd.drivers.pricer import PricerConfig, PricerDriver

from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration, MissionConfig
from robotd.errors import ConfigError, DriverFault, MissionError
from robotd.identify import FlashRequest
from robotd.observation import Observer
from robotd.plugin import Labels
from robotd.records import Pose
from tests.label_gateway import TOKEN, files, program


def make_driver(folder, port, **more):
    config = bind(
        PricerConfig, {"port": port, "token_file": str(folder / "token"), **more}, "robotd.toml [drivers.labels]"
    )
    return PricerDriver("labels", config, SimpleNamespace(), Bus(), SimpleNamespace())


def test_the_driver_brings_flashes_to_the_folder_in_no_virtual_time(tmp_path):
    with program(tmp_path) as running:

        async def run():
            driver = make_driver(tmp_path, running.port)
            assert isinstance(driver, Labels)
            await driver.open()
            assert await driver.flash(["A1", "A2"], 1.0, [3, 4]) == {}
            refused = await driver.flash([*(f"L{number}" for number in range(500)), "L;1"], 0.5, [4] * 501)
            assert refused == {"L;1": 'it has ";", which separates fields in instruction files'}
            await driver.flash([], 1.0, [])
            assert now() == 0.0
            await driver.close()
            await driver.close()

        run_virtual(run())
        texts = list(files(running.watched).values())
    assert texts[0] == "FLASH;A1;3;1.0\nFLASH;A2;4;1.0\n"
    assert [text.count("\n") for text in texts] == [2, 500]


def test_the_driver_finds_a_restarted_gateway_and_repeats_nothing(tmp_path):
    async def run():
        with program(tmp_path) as first:
            driver = make_driver(tmp_path, first.port)
            await driver.open()
            await driver.flash(["A1"], 1.0, [3])
            first.process.kill()
            first.process.wait()
            with program(tmp_path, port=first.port) as second:
                await driver.flash(["A2"], 1.0, [3])
                assert [text[6:8] for text in files(second.watched).values()] == ["A1", "A2"]
        watch = asyncio.create_task(driver.run())
        with pytest.raises(DriverFault, match=r"labels: robotd-labels at 127.0.0.1:\d+ cannot be reached"):
            await driver.flash(["A3"], 1.0, [3])
        with pytest.raises(DriverFault, match="cannot be reached"):  # so that its supervisor opens it again
            await watch
        await driver.close()

    run_virtual(run())


def test_a_gateway_that_takes_nothing_is_a_fault_until_that_is_mended(tmp_path):
    with program(tmp_path) as running:

        async def run():
            driver = make_driver(tmp_path, running.port)
            await driver.open()
            watch = asyncio.create_task(driver.run())
            (running.watched / ".robotd-labels").rename(tmp_path / "aside")
            with pytest.raises(
                DriverFault, match=r"labels: robotd-labels at 127.0.0.1:\d+ refuses: .* cannot be written"
            ):
                await driver.flash(["A1"], 1.0, [3])
            with pytest.raises(DriverFault, match="cannot be written"):
                await watch
            await driver.close()
            with pytest.raises(DriverFault, match="cannot be written"):
                await driver.open()
            await driver.close()
            (tmp_path / "aside").rename(running.watched / ".robotd-labels")
            await driver.open()
            assert await driver.flash(["A1"], 1.0, [1]) == {}
            await driver.close()
            (tmp_path / "token").write_text("old")
            (tmp_path / "token").chmod(0o600)
            with pytest.raises(DriverFault, match="refuses: token: missing or wrong"):
                await driver.open()
            await driver.close()
            (tmp_path / "token").unlink()
            with pytest.raises(DriverFault, match=r"token_file: .* cannot be read"):
                await driver.open()

        run_virtual(run())
    assert len(files(running.watched)) == 1


@contextmanager
def impostor(*answers):
    """Something else that listens: gives each connection one of these answers to its first line, then hangs up."""
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    script = (
        "import socket, sys\n"
        "listener = socket.socket(fileno=int(sys.argv[1]))\n"
        "for answer in sys.argv[2:]:\n"
        "    line, _ = listener.accept()\n"
        "    line.recv(4096)\n"
        "    if answer == 'hang': line.recv(1)\n"
        "    line.sendall(answer.encode())\n"
        "    line.close()\n"
    )
    command = [sys.executable, "-c", script, str(listener.fileno()), *answers]
    with listener, subprocess.Popen(command, pass_fds=[listener.fileno()]) as process:
        try:
            yield port
        finally:
            process.kill()


def test_the_driver_does_not_trust_whoever_listens(tmp_path):
    (tmp_path / "token").write_text(TOKEN)
    (tmp_path / "token").chmod(0o600)

    async def run():
        for answer, text in (
            ("HTTP/1.1 400 Bad Request\n", "does not answer like robotd-labels"),
            ("[]\n", "does not answer like robotd-labels"),
            ('{"id": 7, "ok": true}\n', "does not answer like robotd-labels"),
            ('{"id": 1, "ok": true, "refused": ["A1"]}\n', "does not answer like robotd-labels"),
            ("", "closed the connection"),
            ('{"id": 1, "ok"', "closed the connection"),
            ("x" * 100_000 + "\n", "does not answer like robotd-labels"),
        ):
            with impostor(answer) as port:
                driver = make_driver(tmp_path, port)
                with pytest.raises(DriverFault, match=text):
                    await driver.open()
                await driver.close()

    run_virtual(run())


def test_the_driver_gives_up_on_a_gateway_that_hangs(tmp_path):
    (tmp_path / "token").write_text(TOKEN)
    (tmp_path / "token").chmod(0o600)

    async def run():
        with impostor("hang") as port:
            driver = make_driver(tmp_path, port, timeout_s=0.1)
            with pytest.raises(DriverFault, match=r"did not answer within 0.1 s"):
                await driver.open()
            await driver.close()

    asyncio.run(run())


def test_a_kept_connection_that_a_firewall_forgot_is_made_anew_under_the_same_key(tmp_path):
    (tmp_path / "token").write_text(TOKEN)
    (tmp_path / "token").chmod(0o600)
    keys, served = [], []

    async def serve(reader, writer):
        forgotten = not keys
        served.append((asyncio.current_task(), writer))
        while line := await reader.readline():
            request = json.loads(line)
            if "key" in request:
                keys.append(request["key"])
                if forgotten:
                    continue  # nothing comes back
            writer.write(json.dumps({"id": request["id"], "ok": True, "refused": {}}).encode() + b"\n")
        writer.close()

    async def run():
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        driver = make_driver(tmp_path, server.sockets[0].getsockname()[1], timeout_s=0.2)
        await driver.open()
        assert await driver.flash(["A1"], 1.0, [3]) == {}
        await driver.close()
        server.close()
        for task, writer in served:
            await task
            await writer.wait_closed()

    asyncio.run(run())
    assert len(keys) == 2
    assert len(set(keys)) == 1


class Anything:
    """In place of what a mission does not need here."""

    name = "labels"

    def __getattr__(self, name):
        return lambda *arguments, **options: None


def test_a_refused_label_is_reported_once_and_left_out_and_all_of_them_stop_the_mission():
    class Choosy(Anything):
        async def flash(self, labels, strength, durations):
            return {label: "unknown" for label in labels if label != "A2"}

    async def run():
        bus = Bus()
        observer = Observer(
            *(MissionConfig(labels=("A1", "A2")), Calibration()),
            bus=bus,
            cameras={},
            labels=Choosy(),
            journal=None,
            tell=print,
        )
        with bus.events.subscribe() as events:
            for _ in range(2):
                await observer.ask(FlashRequest(("A1", "A2"), (3, 4)))
            assert events.waiting == 1
            assert (await events.get()).text == "labels: A1 is refused and left out: unknown"
        assert observer.refused == {"A1": "unknown"}
        assert observer.memory.candidates(Pose(0.0, 0.0, 0.0), 0.0, []).wanted.tolist() == [False, True]
        observer.labels.flash = lambda *arguments: asyncio.sleep(0, {"A2": "unknown"})
        with pytest.raises(MissionError, match="labels: every label is refused, the last one: unknown"):
            await observer.ask(FlashRequest(("A2",), (3,)))
        assert observer.memory.candidates(Pose(0.0, 0.0, 0.0), 0.0, []).wanted.all()  # when it goes on

    run_virtual(run())


def test_the_drivers_section_is_checked():
    with pytest.raises(ConfigError) as caught:
        bind(PricerConfig, {"host": "", "port": 0, "tokenfile": "x"}, "robotd.toml [drivers.labels]")
    assert "found 0; expected 1 to 65535" in str(caught.value)
    assert "did you mean 'token_file'?" in str(caught.value)
    with pytest.raises(ConfigError, match="host = ''"):
        bind(PricerConfig, {"host": "", "port": 1}, "robotd.toml [drivers.labels]")
