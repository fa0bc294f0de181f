"""The serial port of the guardian, and the bytes with which it halts a robot."""

import os
import pty
import termios
import tty
from pathlib import Path

import pytest

from robotd import oi, serial_port
from robotd.errors import DriverFault
from robotd.serial_port import HALT, MIN_HALTS, Port, set_rate


class Robot:
    """The base's side of the line: mode, latched wheel speeds, baud rate."""

    def __init__(self, mode=oi.SAFE, speeds=(200, 200)):
        self.parser = oi.CommandDecoder()
        self.mode, self.speeds = mode, speeds
        self.is_baud_kept, self.pressed, self.motors = True, 0, 0

    def receive(self, data):
        for command in self.parser.feed(data):
            if isinstance(command, oi.Command):
                self.obey(command.name, command.values)

    def obey(self, name, values):
        if name == "start":
            self.change(oi.PASSIVE)
        elif self.mode == oi.OFF:
            return
        elif name == "baud" and values[0] <= 11:
            self.is_baud_kept = False
        elif name == "stop":
            self.change(oi.OFF)
        elif name in ("safe", "control"):
            self.change(oi.SAFE)
        elif name == "buttons":
            self.pressed |= values[0]
        elif self.mode == oi.SAFE and name == "motors":
            self.motors |= values[0]
        elif self.mode == oi.SAFE and name.startswith("drive"):
            self.speeds = tuple(max(-500, min(500, value)) for value in values)

    def change(self, mode):
        self.mode, self.speeds = mode, (0, 0)

    @property
    def is_moving(self):
        return any(self.speeds)


# ---- the halt --------------------------------------------------------------------------------------------------------

STARTS = [
    bytes((spec.opcode,)) + bytes((fill,)) * missing
    for spec in oi.COMMANDS.values()
    for fill in (0, 1, 16, 40, 128, 254, 255)
    for missing in range(40)
]


def half_received():
    """Every command cut off after every byte, with arguments of several kinds: (bytes, decoder's pending)."""
    seen = set()
    for data in STARTS:
        parser = oi.CommandDecoder()
        parser.feed(data)
        if parser.pending == data and data not in seen:
            seen.add(data)
            yield data
    yield bytes((148, 255))
    yield bytes((149, 255)) + bytes(200)


def test_the_halt_works_in_every_state_of_the_robots_parser():
    states = list(half_received())
    assert len(states) > 300
    for data in [b"", *states]:
        robot = Robot()
        robot.receive(data + HALT)
        assert (robot.mode, robot.speeds) == (oi.OFF, (0, 0)), data.hex()
        assert robot.is_baud_kept, data.hex()
        assert robot.pressed & 0b111 == 0, data.hex()  # clean, spot, dock
        assert robot.motors & 0b111 == 0, data.hex()
        assert robot.parser.pending == b""


def test_the_halt_is_these_bytes_zero_velocity_before_passive_before_off():
    zero = bytes((145, 0, 0, 0, 0))
    assert bytes((16, 0, 0, 0)) + 4 * zero + b"\xad" + 52 * zero + b"\x80\xad" == HALT
    commands = [event for event in oi.CommandDecoder().feed(HALT) if isinstance(event, oi.Command)]
    assert commands[0] == oi.Command("drive_direct", (0, 0))
    assert [command.name for command in commands[-3:]] == ["drive_direct", "start", "stop"]


@pytest.mark.parametrize("wanted", [300, 200, 1, 0, -1, -200, -300])
@pytest.mark.parametrize("cut", range(6))
def test_a_drive_command_that_was_cut_off_moves_the_robot_for_eight_bytes_at_most(wanted, cut):
    robot = Robot(speeds=(0, 0))
    robot.receive(oi.encode("drive_direct", wanted, wanted)[:cut])
    moving = []
    for byte in HALT:
        robot.receive(bytes((byte,)))
        moving.append(robot.is_moving)
    assert sum(moving) <= (9 if cut == 5 else 8)
    assert not any(moving[9:])


@pytest.mark.parametrize("data", [b"", b"\x91\x00\xc8", b"\x94\x05\x07", b"\x8c"])
def test_any_byte_of_a_halt_may_be_lost(data):
    for lost in range(len(HALT)):
        robot = Robot()
        robot.receive(data + HALT[:lost] + HALT[lost + 1 :] + HALT * (MIN_HALTS - 1))
        assert (robot.mode, robot.speeds) == (oi.OFF, (0, 0))


# ---- ports -----------------------------------------------------------------------------------------------------------


class Line:
    """A pseudo-terminal."""

    def __init__(self):
        self.far, self.near = pty.openpty()
        tty.setraw(self.far)
        tty.setraw(self.near)
        self.port = os.ttyname(self.near)

    def unplug(self):
        for end in (self.far, self.near):
            if end >= 0:
                os.close(end)
        self.far = self.near = -1


@pytest.fixture
def line():
    line = Line()
    yield line
    line.unplug()


def remark(line):
    port = Port(line.port, 115200)
    port.close()
    return port.remark


def test_an_adapter_that_holds_bytes_back_is_remarked_with_the_mend(line, tmp_path, monkeypatch):
    monkeypatch.setattr(serial_port, "TTYS", tmp_path)
    assert remark(line) == ""  # a pseudo-terminal has no such setting and needs none
    timer = tmp_path / Path(line.port).name / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    assert "holds bytes back for 16 ms" in remark(line)
    assert "60-robotd.rules" in remark(line)
    timer.write_text("1\n")
    assert remark(line) == ""
    timer.unlink()
    monkeypatch.setattr(serial_port, "_PTY_MAJORS", range(0))
    assert "no low latency" in remark(line)


def test_a_port_keeps_the_rate_of_its_last_user_unless_asked(line):
    set_rate(line.near, 57600)
    port = Port(line.port)
    assert termios.tcgetattr(port.fd)[5] == termios.B57600
    port.close()
    with pytest.raises(ValueError, match="expected one of 9600"):
        set_rate(line.near, 12345)


def test_a_missing_port_lists_those_that_exist(tmp_path, monkeypatch):
    monkeypatch.setattr(serial_port, "BY_ID", tmp_path)
    with pytest.raises(DriverFault, match="is empty: is the adapter plugged in"):
        Port(str(tmp_path / "ttyUSB7"))
    (tmp_path / "usb-FTDI_FT232R-if00-port0").touch()
    with pytest.raises(DriverFault, match=r"no such port; there are .*usb-FTDI_FT232R-if00-port0"):
        Port(str(tmp_path / "ttyUSB7"), 115200)


def test_a_file_that_is_no_port_and_a_missing_permission_are_explained(tmp_path):
    path = tmp_path / "notes.txt"
    path.touch()
    with pytest.raises(DriverFault, match="cannot be opened as a serial port"):
        Port(str(path), 115200)
    assert "group dialout" in serial_port.explain("/dev/ttyUSB0", PermissionError(13, "Permission denied"))


def test_halting_an_unplugged_port_is_a_fault(line):
    port = Port(line.port, 115200)
    line.unplug()
    with pytest.raises(DriverFault, match=r"the halt cannot be sent .*plug the adapter in again"):
        port.halt()
    port.close()


def test_a_port_that_takes_no_bytes_does_not_count_as_halted_nor_stop_the_guardian(line, monkeypatch):
    port = Port(line.port, 115200)
    monkeypatch.setattr(serial_port, "_queued", lambda fd: 17)
    with pytest.raises(DriverFault, match="takes no bytes"):
        port.halt()
    port.close()
