import asyncio
import inspect
import json
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration, save_calibration
from robotd.daemon import assemble
from robotd.errors import DriverFault, InputError
from robotd.hardware import Hardware, SerialLink
from robotd.real import RealHardware
from robotd.records import CameraModel, DriveCommand, Transform, Withdrawal
from robotd.serial_log import (
    BEHIND,
    LoggedHardware,
    LoggedLink,
    Occurrence,
    SerialLog,
    read_serial_log,
)

PORT = "/dev/ttyUSB0"


class FakeLink:
    """A line on which given chunks arrive at given times, then a fault."""

    def __init__(self, chunks=()):
        self.chunks = list(chunks)
        self.done = []

    async def read(self):
        if not self.chunks:
            raise DriverFault("unplugged;\nplug it in")
        t, data = self.chunks.pop(0)
        await asyncio.sleep(t - now())
        return t, data

    def write(self, data):
        self.done.append(data)

    def set_baud(self, baud):
        self.done.append(baud)

    def pulse_wake(self, seconds):
        self.done.append(seconds)

    def close(self):
        self.done.append("close")


class FakeHardware:
    """Hands out one link; the second opening is refused."""

    def __init__(self, link):
        self.links = [link]
        self.opened = []

    async def open_serial(self, port, baud):
        self.opened.append((port, baud))
        await asyncio.sleep(0.01)
        if not self.links:
            raise DriverFault("in use")
        return self.links.pop()

    def utc(self):
        return datetime(2026, 3, 2, 7, 30, tzinfo=UTC)


def rows(recording):
    return [(item.t, item.kind, item.text) for item in recording.occurrences]


def test_a_session_is_written_as_text_and_read_back(tmp_path):
    path = tmp_path / "serial.log"
    link, bus = FakeLink([(5.5, b"\x13\x05"), (5.515, b"\x01")]), Bus()
    log = SerialLog(path, 1_000_000, {"base": {"baud": 115200}})
    hardware = LoggedHardware(FakeHardware(link), PORT, log)

    async def main():
        await asyncio.sleep(5.0)
        following = asyncio.create_task(log.follow(bus))
        line = await hardware.open_serial(PORT, 115200)
        line.write(b"\x80\x83")
        line.set_baud(19200)
        line.pulse_wake(1.0)
        assert await line.read() == (5.5, b"\x13\x05")
        bus.commands.publish(DriveCommand(now() - 0.01, 0.2, -0.123456789, "follower", 5.25))
        bus.commands.publish(DriveCommand(now(), 0.0, 0.1, "operator"))
        bus.withdrawals.publish(Withdrawal(now(), None, "stop, says the operator"))
        assert await line.read() == (5.515, b"\x01")
        with pytest.raises(DriverFault, match="unplugged"):
            await line.read()
        line.close()
        line.close()
        with pytest.raises(DriverFault, match="in use"):
            await hardware.open_serial(PORT, 115200)
        following.cancel()
        log.flush()

    run_virtual(main())
    assert link.done == [b"\x80\x83", 19200, 1.0, "close", "close"]
    recording = read_serial_log(path)
    assert recording.head == {"base": {"baud": 115200}, "date": "2026-03-02T07:30:00+00:00", "loop_time": 5.01}
    assert rows(recording) == [
        (0.0, "open", f"{PORT} 115200"),
        (0.0, ">", "8083"),
        (0.0, "baud", "19200"),
        (0.0, "wake", "1"),
        (0.49, "<", "1305"),
        (0.49, "wish", "0.2 -0.123457 0.48 0.24 follower"),
        (0.49, "wish", "0 0.1 0.49 operator"),
        (0.49, "withdraw", "0.49 operator stop, says the operator"),
        (0.505, "<", "01"),
        (0.505, "break", "unplugged; plug it in"),
        (0.505, "close", ""),
        (0.505, "refused", "in use"),
    ]
    assert recording.occurrences[1].data == b"\x80\x83"


def test_only_the_base_s_port_is_recorded_and_everything_else_is_the_hardware_s(tmp_path):
    link = FakeLink()
    fake = FakeHardware(link)
    log = SerialLog(tmp_path / "serial.log", 1_000_000, {})
    hardware = LoggedHardware(fake, PORT, log)

    async def main():
        assert await hardware.open_serial("/dev/other", 9600) is link
        log.flush()

    run_virtual(main())
    assert not log.path.exists()
    assert fake.opened == [("/dev/other", 9600)]
    for protocol, cls in ((Hardware, LoggedHardware), (SerialLink, LoggedLink)):
        names = {name for name in vars(protocol) if not name.startswith("_")}
        assert names == {name for name in vars(cls) if not name.startswith("_")}
        for name in names:
            if inspect.isfunction(vars(cls)[name]):
                assert [*inspect.signature(vars(cls)[name]).parameters] == [
                    *inspect.signature(vars(protocol)[name]).parameters
                ]


def chatter(log, seconds, size=100):
    """Note `size` bytes every 15 ms for so long."""

    async def main():
        for k in range(round(seconds / 0.015)):
            log.add(now(), "<", (k % 256).to_bytes().hex() * size)
            await asyncio.sleep(0.015)
        log.flush()

    run_virtual(main())


def test_the_files_take_no_more_than_their_limit_and_the_newest_is_kept(tmp_path):
    path = tmp_path / "serial.log"
    chatter(SerialLog(path, 100_000, {"base": {}}), 60.0)
    old = tmp_path / "serial.log.1"
    assert path.stat().st_size + old.stat().st_size <= 110_000
    assert {item.name for item in tmp_path.iterdir()} == {"serial.log", "serial.log.1"}
    newest, before = read_serial_log(path), read_serial_log(old)
    assert newest.head["continued"] is True
    assert newest.occurrences[-1].t == pytest.approx(60.0, abs=0.02)
    assert 0.01 < newest.occurrences[0].t - before.occurrences[-1].t < 0.02


def test_a_recording_of_an_earlier_run_is_kept_once(tmp_path):
    path = tmp_path / "serial.log"
    for run in range(3):
        chatter(SerialLog(path, 1_000_000, {"run": run}), 0.1)
    assert read_serial_log(path).head["run"] == 2
    assert read_serial_log(tmp_path / "serial.log.1").head["run"] == 1


def test_what_is_noted_reaches_the_disk_within_seconds_without_being_asked_for(tmp_path):
    log = SerialLog(tmp_path / "serial.log", 1_000_000, {})

    async def main():
        log.add(now(), "<", "00")
        await asyncio.sleep(1.5)

    run_virtual(main())
    assert rows(read_serial_log(log.path)) == [(0.0, "<", "00")]


def test_a_disk_that_takes_nothing_ends_the_recording_and_nothing_else(tmp_path, caplog):
    log = SerialLog(tmp_path / "absent" / "serial.log", 1_000_000, {})
    chatter(log, 5.0)
    assert re.search("absent/serial.log: No such file", log.fault)
    assert caplog.text.count("the serial line is not recorded any more") == 1


def test_lines_that_a_slow_disk_cannot_take_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr("robotd.serial_log.FLUSH_S", 0.001)
    log = SerialLog(tmp_path / "serial.log", 1_000_000, {})

    async def main():
        with log._lock:  # the disk hangs
            while log._lost < 3:
                log.add(now(), "<", "00")
                await asyncio.sleep(0.002)
        while log._texts.qsize():
            await asyncio.sleep(0.001)
        log.add(now(), "<", "ff")
        log.flush()

    asyncio.run(main())
    found = rows(read_serial_log(log.path))
    assert [(kind, text) for _, kind, text in found[-2:]] == [("lost", "3"), ("<", "ff")]
    assert {kind for _, kind, _ in found[:-2]} == {"<"}
    assert BEHIND < len(found) < BEHIND + 10


def test_the_configuration_asks_for_a_recording_of_the_base_with_what_its_replay_needs(tmp_path):
    """The example configuration, with the key set."""
    text = (Path(__file__).parent.parent / "etc" / "robotd.toml").read_text()
    camera = CameraModel("floor", (320, 240), (228.5, 228.5, 159.5, 119.5), Transform((2.1, 0, 0), (0.12, 0, 0.3)))
    rig = tuple(replace(camera, name=name) for name in ("front", "left", "rear", "right"))
    save_calibration(Calibration(cameras=rig, floor_camera=camera), tmp_path / "calibration.toml")
    path = tmp_path / "robotd.toml"
    keys = 'calibration = "calibration.toml"\n'
    path.write_text(text.replace("[robot]\n", f"[robot]\n{keys}"))
    hardware = RealHardware()
    assert assemble(path, hardware).base.hardware is hardware
    keys += 'serial_log = "serial.log"\nserial_log_mb = 5\n'
    path.write_text(text.replace("[robot]\n", f"[robot]\n{keys}"))
    assembly = assemble(path, hardware)
    log = assembly.serial_log
    assert isinstance(assembly.base.hardware, LoggedHardware)
    assert (log.path, log.limit) == (tmp_path / "serial.log", 5_000_000)
    assert log.head["base"]["driver"] == "roomba"
    assert log.head["base"]["port"].startswith("/dev/serial/by-id/")
    assert log.head["wheels"]["base"] == 0.235
    assert "max_speed" in log.head["safety"]
    json.dumps(log.head)
    assert {item.name for item in tmp_path.iterdir()} == {"robotd.toml", "calibration.toml"}


def test_a_last_line_that_was_cut_off_is_left_out(tmp_path):
    path = tmp_path / "serial.log"
    path.write_text("# robotd-serial/1\n0.0000 < 13\n0.0150 < 14ff\n0.03")
    assert read_serial_log(path).occurrences == (Occurrence(0.0, "<", "13"), Occurrence(0.015, "<", "14ff"))


def test_a_file_that_is_no_recording_is_refused_line_by_line(tmp_path):
    path = tmp_path / "serial.log"
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_serial_log(path)
    path.write_text("0.0 < 13\n")
    with pytest.raises(InputError, match="expected '# robotd-serial/1' in its first line"):
        read_serial_log(path)
    path.write_text("# robotd-serial/1\n# base {\n0.0 < 1\n0.1 ! 13\nx < 13\n0.2 < 13\n")
    with pytest.raises(InputError) as caught:
        read_serial_log(path)
    assert [problem.split(": ")[0] for problem in caught.value.problems] == [f"{path}:{n}" for n in (2, 3, 4, 5)]
    assert "found '!'; expected one of open" in caught.value.problems[2]
