"""The pseudo-terminal robot, its path and its control socket; in real time, because terminals have no other."""

import asyncio
import fcntl
import json
import os
import signal
import subprocess
import sys
import termios

import numpy as np
import pytest
import serial

from robotd import oi
from robotd.__main__ import main
from robotd.errors import InputError
from robotd.records import Pose
from robotd.sim.battery import CAPACITY_MAH
from robotd.sim.quirks import LineFaults, RoombaQuirks
from robotd.sim.roomba import SimRoomba
from robotd.sim.side_channel import SideChannel
from robotd.sim.terminal import TerminalPort, _body

LIMIT = 20.0  # s


class Desk:
    """A robot behind a pseudo-terminal in this process, and the client's end of it."""

    def __init__(self, folder, quirks=None):
        self.path = folder / "roomba"
        self.body = _body(None, 1)
        self.robot = SimRoomba(self.body, np.random.default_rng(1), quirks)
        self.said = []
        self.robot.listener = self.said.append
        self.port = TerminalPort(self.robot, self.path)
        self.channel = SideChannel(self.robot, self.body, self.port, folder / "roomba.ctl")

    def tell(self, **wish):
        answer = self.channel.answer(json.dumps(wish).encode())
        assert "error" not in answer, answer
        return answer

    async def until(self, condition):
        while not condition():
            await asyncio.sleep(0.005)


def at_the_desk(folder, scenario, quirks=None):
    async def main():
        desk = Desk(folder, quirks)
        desk.port.connect()
        try:
            async with asyncio.timeout(LIMIT):
                await scenario(desk)
        finally:
            desk.port.disconnect()
            desk.robot.power.stop()
        assert not desk.path.is_symlink()

    asyncio.run(main())


class Client:
    """A program that has opened the path as a serial port, for itself alone."""

    def __init__(self, desk, baud=115200):
        self.port = serial.Serial(str(desk.path), baud, timeout=0, exclusive=True)
        fcntl.ioctl(self.port.fileno(), termios.TIOCEXCL)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.port.close()

    def send(self, *commands):
        self.port.write(b"".join(oi.encode(*command) for command in commands))

    async def read(self, count):
        data = b""
        while len(data) < count:
            await asyncio.sleep(0.002)
            data += self.port.read(count - len(data))
        return data


def test_a_serial_port_is_opened_there_and_gets_a_whole_stream(tmp_path):
    async def scenario(desk):
        with Client(desk) as client:
            client.send(["start"], ["stream", 43, 44, 35])
            decoder = oi.StreamDecoder([43, 44, 35])
            decoder.feed(await client.read(40 * 11))
            assert (decoder.counters.frames, decoder.counters.skipped_bytes) == (40, 0)

    at_the_desk(tmp_path, scenario)


def test_the_next_client_may_open_it_after_one_that_locked_it(tmp_path):
    async def scenario(desk):
        for _ in range(2):
            with Client(desk), pytest.raises(serial.SerialException, match="exclusively lock"):
                Client(desk)
            await asyncio.sleep(1.1)

    at_the_desk(tmp_path, scenario)


def test_the_client_s_speed_is_its_baud_rate(tmp_path):
    async def scenario(desk):
        with Client(desk, 19200) as client:
            client.send(*[["start"]] * 20)
            await asyncio.sleep(0.1)
            assert desk.port.baud == 19200
            assert desk.robot.mode == oi.OFF
            client.port.baudrate = 115200
            client.send(*[["start"]] * 36)
            await desk.until(lambda: desk.robot.mode == oi.PASSIVE)

    at_the_desk(tmp_path, scenario)


def test_a_pulled_cable_hangs_up_and_comes_back_under_the_same_path(tmp_path):
    async def scenario(desk):
        with Client(desk) as client:
            client.send(["start"], ["safe"], ["drive_direct", 200, 200])
            await desk.until(lambda: desk.robot.right.speed > 0.19)
            desk.tell(disconnect=0.3)
            assert not desk.path.is_symlink()
            with pytest.raises(serial.SerialException):
                await client.read(1)
        assert desk.robot.right.speed > 0.19  # nobody has stopped it
        await desk.until(desk.path.is_symlink)
        with Client(desk) as client:
            client.send(["drive_direct", 0, 0])
            await desk.until(lambda: desk.robot.right.speed == 0.0)

    at_the_desk(tmp_path, scenario)


def test_the_line_s_own_fault_pulls_the_cable_until_it_is_connected_again(tmp_path):
    async def scenario(desk):
        await desk.until(lambda: not desk.path.is_symlink())
        assert desk.port.link is None
        assert desk.tell(state=True)["client_baud"] is None
        desk.tell(connect=True)
        assert desk.path.is_symlink()

    at_the_desk(tmp_path, scenario, RoombaQuirks(line=LineFaults(disconnect_after=0.1)))


def test_a_client_that_does_not_read_loses_bytes_and_stops_nobody(tmp_path):
    async def scenario(desk):
        desk.robot.receive(oi.encode("start") + oi.encode("stream", 100, 106))
        before = desk.robot.now
        for _ in range(3000):
            desk.port.link._chunks.append((0.0, bytes(172)))
        desk.port.link._arrived.set()
        await desk.until(lambda: desk.robot.now > before + 0.3)
        with Client(desk) as client:
            assert len(await client.read(500)) == 500

    at_the_desk(tmp_path, scenario)


@pytest.fixture
def refusal(capsys):
    """What the command says to wrong options."""

    def refused(path, *options):
        assert main(["sim", "roomba", "--link", str(path), *options]) == 2
        return capsys.readouterr().err

    return refused


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_anything_but_a_symbolic_link_keeps_its_place(tmp_path, kind, refusal):
    path = tmp_path / "roomba"
    path.write_text("precious") if kind == "file" else path.mkdir()
    assert f"{path}: exists and is not a symbolic link" in refusal(path)
    assert path.read_text() == "precious" if kind == "file" else path.is_dir()


def test_a_stale_link_is_replaced_a_second_robot_refused_and_all_removed_at_the_end(tmp_path, refusal):
    path = tmp_path / "roomba"
    path.symlink_to("/dev/pts/of-yesterday")
    (tmp_path / "roomba.ctl").touch()
    assert "exists and is not a socket" in refusal(path)
    (tmp_path / "roomba.ctl").unlink()
    first = subprocess.Popen(
        [sys.executable, "-m", "robotd", "sim", "roomba", "--link", str(path), "--store", "room"],
        stderr=subprocess.PIPE,
        text=True,
    )
    with first:
        while "simulated Roomba at" not in first.stderr.readline():
            assert first.poll() is None
        assert os.readlink(path).startswith("/dev/pts/")
        assert "another simulated robot answers there" in refusal(path)
        assert path.is_symlink()
        first.send_signal(signal.SIGINT)
        assert first.wait(LIMIT) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--quirk", "mode_ofset=1"], "did you mean 'mode_offset'?"),
        (["--fault", "drop=2"], "--fault drop: found 2; expected 0 to 1"),
        (["--store", "nowhere"], "nowhere: no such store"),
    ],
)
def test_wrong_options_are_named(tmp_path, options, words, refusal):
    assert words in refusal(tmp_path / "roomba", *options)


def test_quirks_are_listed_and_a_missing_folder_or_link_is_named(tmp_path, refusal, capsys):
    assert main(["sim", "roomba", "--list-quirks"]) == 0
    listed = capsys.readouterr().out
    assert "mode_offset = 0: Q3" in listed
    assert "disconnect_after = none" in listed
    assert f"{tmp_path / 'no'}: no such folder" in refusal(tmp_path / "no" / "roomba")
    assert main(["sim", "roomba"]) == 2
    assert "no --link; expected the path" in capsys.readouterr().err


# ---- the control socket's wishes -------------------------------------------------------------------------------------


class Bench(Desk):
    """A robot without a terminal, ticked by hand."""

    class Unplugged:
        link = None

    def __init__(self):
        self.body = _body(None, 1)
        self.robot = SimRoomba(self.body, np.random.default_rng(1))
        self.channel = SideChannel(self.robot, self.body, self.Unplugged(), None)
        self.ticks = 0

    def run(self, seconds):
        for _ in range(round(seconds / oi.TICK)):
            self.ticks += 1
            self.robot.tick(self.ticks * oi.TICK)

    def send(self, *command):
        self.robot.receive(oi.encode(*command))
        self.run(oi.TICK)

    @property
    def bits(self):
        self.robot.receive(oi.encode("sensors", 7))
        self.ticks += 1
        return self.robot.tick(self.ticks * oi.TICK)[0]


def test_contacts_are_worked_by_hand():
    bench = Bench()
    bench.send("start")
    for wish, bits in (
        ({"bump": "left"}, 2),
        ({"bump": "right"}, 1),
        ({"bump": None, "drop": "left"}, 8),
        ({"drop": None, "lift": True}, 12),
        ({"lift": False, "bump": "both"}, 3),
        ({"bump": None}, 0),
    ):
        bench.tell(**wish)
        assert bench.bits == bits
    bench.tell(overcurrent=8, cliff=True)
    assert (bench.robot.overcurrent, bench.robot.sees_cliff) == (8, True)


def test_the_robot_is_carried_pushed_docked_plugged_and_charged():
    bench = Bench()
    bench.send("start")
    bench.tell(carry=[1.0, 2.0, 0.5])
    assert bench.tell(state=True)["pose"] == pytest.approx([1.0, 2.0, 0.5])
    bench.tell(dock=True, battery=0.5)
    bench.run(1)
    state = bench.tell(state=True)
    assert (state["docked"], state["charging"]) == (True, True)
    assert state["charge"] == pytest.approx(0.5, abs=0.001)
    bench.tell(lift=True)
    bench.run(0.1)
    assert not bench.tell(state=True)["docked"]
    bench.tell(lift=False, carry=[-0.5, 0.0, 0.0])
    bench.run(0.1)
    assert not bench.tell(state=True)["docked"]
    bench.tell(dock=[1.0, 2.0, 0.5])
    assert bench.robot.dock.pose == Pose(1.0, 2.0, 0.5)
    bench.send("dock")
    bench.run(30)
    assert bench.tell(state=True)["docked"]
    bench.tell(dock=False, plug=True)
    bench.run(0.1)
    assert (bench.robot.is_docked, bench.robot.is_plugged) == (False, True)
    before = bench.tell(state=True)["encoders"]
    bench.tell(push=[-0.2, 0.0, 0.5], slip=[0.0, 0.0])
    bench.run(1)
    after = bench.tell(state=True)["encoders"]
    assert (after[0] - before[0]) % 65536 == pytest.approx(0.2 / oi.COUNT, abs=20)
    bench.tell(battery="out")
    assert bench.tell(state=True)["encoders"] == [0, 0]
    assert bench.robot.battery.charge_mah < CAPACITY_MAH


def test_buttons_are_pressed_and_shown_in_the_state():
    bench = Bench()
    bench.send("start")
    bench.tell(press="clean")
    bench.run(0.1)
    state = bench.tell(state=True)
    assert (state["program"], state["mode"], state["asleep"]) == ("clean", "passive", False)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"nonsense", "Expecting value"),
        (b"[1]", "expected one JSON object"),
        (b'{"pres": "clean"}', "unknown wish pres; expected one of battery, brc, bump"),
        (b'{"press": "cleen"}', "press: found 'cleen'; expected one of clean, spot, dock"),
        (b'{"bump": 3}', "bump: found 3; expected left, right, both or null"),
        (b'{"lift": 1}', "lift: found 1; expected true or false"),
        (b'{"carry": [1, 2]}', "carry: found [1, 2]; expected 3 numbers"),
        (b'{"push": [1, 0, 0]}', "push: found 0 s; expected more than 0"),
        (b'{"brc": "up"}', "brc: found 'up'; expected a number"),
        (b'{"battery": null}', "battery: found None; expected a number"),
        (b'{"dock": [1, "x", 2]}', "dock: found [1, 'x', 2]; expected 3 numbers"),
        (b'{"stall": true}', "stall: found True; expected a number"),
        (b"\xff{}", "codec can't decode"),
    ],
)
def test_a_wrong_wish_is_answered_by_what_is_wrong(line, words):
    answer = Bench().channel.answer(line)
    assert words in answer["error"]


def test_the_wake_line_is_pulsed_for_a_time_or_by_levels(tmp_path):
    async def scenario(desk):
        desk.robot.receive(oi.encode("start") + oi.encode("power"))
        for wishes in (({"brc": 0.05},), ({"brc": "low"}, {"brc": "high"})):
            assert desk.robot.is_asleep
            for wish in wishes:
                desk.tell(**wish)
                await asyncio.sleep(0.03)
            await desk.until(lambda: not desk.robot.is_asleep)
            await desk.until(lambda: desk.robot.is_listening)
            desk.robot.receive(oi.encode("start") + oi.encode("power"))

    at_the_desk(tmp_path, scenario)


def test_a_stall_on_demand_and_the_socket_itself(tmp_path):
    async def scenario(desk):
        async with desk.channel:
            reader, writer = await asyncio.open_unix_connection(str(desk.channel.path))
            started = asyncio.get_running_loop().time()
            writer.write(b'{"stall": 0.3}\n{"state": true}\n')
            assert json.loads(await reader.readline()) == {"ok": True}
            assert json.loads(await reader.readline())["mode"] == "off"
            with Client(desk) as client:
                client.send(["start"], ["sensors", 35])
                assert await client.read(1) == b"\x01"
            assert asyncio.get_running_loop().time() - started > 0.3
            writer.close()
            await writer.wait_closed()
            with pytest.raises(InputError, match="another simulated robot answers"):
                await SideChannel(desk.robot, desk.body, desk.port, desk.channel.path).__aenter__()
        assert not desk.channel.path.exists()

    at_the_desk(tmp_path, scenario)


def test_the_terminal_is_raw_so_that_no_byte_is_changed(tmp_path):
    async def scenario(desk):
        client = os.open(desk.path, os.O_RDWR | os.O_NOCTTY)
        settings = termios.tcgetattr(client)
        assert not settings[3] & (termios.ECHO | termios.ICANON)
        assert not settings[0] & (termios.ICRNL | termios.IXON)
        os.close(client)

    at_the_desk(tmp_path, scenario)
