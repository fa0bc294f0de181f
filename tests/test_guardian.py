import contextlib
import fcntl
import os
import pty
import select
import signal
import socket
import stat
import subprocess
import sys
import termios
import threading
import tty

import pytest
from hypothesis import given, strategies as st

from robotd import guardian as guardian_module, oi
from robotd.guardian import Guardian, _listen, main
from robotd.serial_port import HALT, MAX_HALTS, set_rate

LIMIT = 20.0  # s: only a broken guardian takes so long


class Robot:
    """The base's side of the line: mode and latched wheel speeds."""

    def __init__(self):
        self.parser = oi.CommandDecoder()
        self.mode, self.speeds = oi.SAFE, (0, 0)

    def receive(self, data):
        for command in self.parser.feed(data):
            if isinstance(command, oi.Command):
                self.obey(command.name, command.values)

    def obey(self, name, values):
        if name == "start":
            self.change(oi.PASSIVE)
        elif name == "stop":
            self.change(oi.OFF)
        elif name == "safe" and self.mode != oi.OFF:
            self.change(oi.SAFE)
        elif name == "drive_direct" and self.mode == oi.SAFE:
            self.speeds = values

    def change(self, mode):
        self.mode, self.speeds = mode, (0, 0)

    @property
    def is_moving(self):
        return any(self.speeds)


# ---- a guardian in this process --------------------------------------------------------------------------------------


class Line:
    """A pseudo-terminal with a robot at its far end."""

    def __init__(self, robot=None):
        self.far, self.near = pty.openpty()
        tty.setraw(self.far)
        tty.setraw(self.near)
        self.port = os.ttyname(self.near)
        self.robot = robot or Robot()
        self.received = b""

    def pump(self, until):
        """Let the robot hear what comes until the condition holds."""
        while not until():
            assert self.hears(LIMIT), "nothing more comes"

    def listen(self, seconds=0.3):
        """Let the robot hear what comes until the line is quiet."""
        while self.hears(seconds):
            pass

    def hears(self, seconds):
        ready, _, _ = select.select([self.far], [], [], seconds)
        if ready:
            data = os.read(self.far, 4096)
            self.received += data
            self.robot.receive(data)
        return bool(ready)

    def unplug(self):
        os.close(self.far)
        os.close(self.near)
        self.far = self.near = -1

    def close(self):
        if self.far >= 0:
            self.unplug()


@pytest.fixture
def line():
    line = Line()
    yield line
    line.close()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "guardian.sock"


class Clock:
    """The guardian's clock; stands still until the test moves it on."""

    t = 1000.0

    def monotonic(self):
        return self.t


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(guardian_module, "time", clock)
    return clock


@pytest.fixture
def service(path, clock):
    """A guardian in a thread; ends with the test."""
    with serving(path) as guardian:
        yield guardian


@contextlib.contextmanager
def serving(path):
    with _listen(path) as listener:
        guardian = Guardian(listener, note=path.with_suffix(".lent"))
        thread = threading.Thread(target=guardian.serve)
        thread.start()
        try:
            yield guardian
        finally:
            guardian.stop()
            thread.join(LIMIT)
            assert not thread.is_alive()
    path.unlink()


class Borrower:
    """A client that does nothing by itself."""

    def __init__(self, path):
        self.connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.connection.connect(str(path))
        self.connection.settimeout(LIMIT)
        self.fd = -1

    def say(self, message):
        self.connection.send(message)

    def hear(self):
        try:
            message, fds, _, _ = socket.recv_fds(self.connection, 4096, 1)
        except ConnectionResetError:
            return b""
        if fds:
            self.fd = fds[0]
        return message

    def borrow(self, port, baud=115200):
        self.say(f"open {baud} {port}".encode())
        answer = self.hear()
        assert answer == b"lent ", answer
        return self

    def drive(self):
        os.write(self.fd, oi.encode("drive_direct", 200, 200))

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.connection.close()
        if self.fd >= 0:
            os.close(self.fd)


def is_halted(line):
    return lambda: line.robot.mode == oi.OFF and not line.robot.is_moving


def test_the_lent_descriptor_is_the_port_and_bytes_do_not_pass_through_the_guardian(service, path, line):
    with Borrower(path).borrow(line.port) as client:
        os.write(line.far, b"\x13\x00\xff\x11")
        assert os.read(client.fd, 10) == b"\x13\x00\xff\x11"
        os.write(client.fd, b"\x00\x13\x11\x0d\x0a")
        assert os.read(line.far, 10) == b"\x00\x13\x11\x0d\x0a"
        assert fcntl.fcntl(client.fd, fcntl.F_GETFL) & os.O_RDWR


def test_a_client_that_hangs_up_leaves_the_robot_halted_and_off(service, path, line):
    with Borrower(path).borrow(line.port) as client:
        client.drive()
        line.pump(lambda: line.robot.speeds == (200, 200))
    line.pump(is_halted(line))


def test_a_client_that_falls_silent_is_told_and_what_it_writes_later_moves_nothing(service, path, line, clock):
    with Borrower(path).borrow(line.port) as client:
        client.drive()
        clock.t += 0.251
        assert client.hear() == b"ended no heartbeat for 0.25 s, so the daemon hangs or the computer is too busy"
        line.pump(is_halted(line))
        assert client.hear() == b""
        client.drive()
        line.listen()
        assert line.robot.mode == oi.OFF
        assert not line.robot.is_moving


def test_each_heartbeat_is_answered_and_keeps_the_loan(service, path, line, clock):
    with Borrower(path).borrow(line.port) as client:
        for _ in range(20):
            client.say(b"beat")
            assert client.hear() == b"beat"
            clock.t += 0.24
        assert not line.hears(0)
        clock.t += 0.02
        assert client.hear().startswith(b"ended no heartbeat")


def test_a_second_client_is_refused_with_the_name_of_the_first_until_that_is_gone(service, path, line):
    with Borrower(path).borrow(line.port) as first:
        with Borrower(path) as second:
            second.say(f"open 115200 {line.port}".encode())
            assert (
                second.hear()
                == f"refused {line.port}: in use by process {os.getpid()} of user {os.getuid()}; "
                "stop that first".encode()
            )
            assert second.hear() == b""
        first.say(b"beat")
        assert first.hear() == b"beat"
    with Borrower(path).borrow(line.port):
        pass


def test_a_hung_client_keeps_the_port_from_others_until_it_has_let_go(service, path, line, clock):
    with Borrower(path).borrow(line.port) as hung:
        clock.t += 0.251
        assert hung.hear().startswith(b"ended no heartbeat")
        line.pump(is_halted(line))
        with Borrower(path) as second:
            second.say(f"open 115200 {line.port}".encode())
            assert b"in use by another program" in second.hear()
    with Borrower(path).borrow(line.port):
        pass


def test_an_unplugged_port_ends_the_loan_and_the_guardian_serves_on(service, path, line):
    with Borrower(path).borrow(line.port) as client:
        line.unplug()
        assert client.hear() == f"ended {line.port}: unplugged; plug the adapter in again".encode()
    other = Line()
    try:
        with Borrower(path).borrow(other.port):
            pass
        other.pump(is_halted(other))
    finally:
        other.close()


def test_the_halt_goes_out_at_the_baud_rate_that_the_client_has_set(service, path, line):
    with Borrower(path).borrow(line.port) as client:
        set_rate(client.fd, 19200)
    line.pump(is_halted(line))
    assert termios.tcgetattr(line.near)[4:6] == [termios.B19200, termios.B19200]


def test_flow_control_that_a_client_has_left_on_does_not_hold_the_halt_back(service, path, line):
    with Borrower(path).borrow(line.port) as client:
        settings = termios.tcgetattr(client.fd)
        settings[0] |= termios.IXON
        settings[1] |= termios.OPOST
        termios.tcsetattr(client.fd, termios.TCSANOW, settings)
        os.write(line.far, b"\x13")  # XOFF
        select.select([client.fd], [], [], 0.1)
        with contextlib.suppress(BlockingIOError):
            client.drive()
    line.pump(is_halted(line))


def test_a_robot_that_talks_on_is_told_again_and_the_log_says_so(service, path, line, capfd):
    with Borrower(path).borrow(line.port):
        pass
    with Borrower(path) as client:  # answered when the halting is over
        client.say(b"?")
        while not select.select([client.connection], [], [], 0.005)[0]:
            os.write(line.far, b"\x13" * 50)
            line.hears(0)
    assert line.received.count(HALT) == MAX_HALTS
    assert "the robot still talks" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("message", "answer"),
    [
        (b"hello", "found 'hello'; expected 'open BAUD PORT'"),
        (b"open", "found 'open'; expected 'open BAUD PORT'"),
        (b"open 12 /dev/ttyUSB0", "found '12' baud; expected one of 9600, "),
        (b"open fast /dev/ttyUSB0", "found 'fast' baud"),
        ("open ١١٥٢٠٠ /dev/ttyUSB0".encode(), "baud; expected one of"),
        (b"open 115200 ttyUSB0", "found port 'ttyUSB0'; expected a whole path"),
        (b"open 115200 /dev/tty\0USB0", "expected a whole path"),
        (b"open 115200 /dev/\xff", "expected UTF-8"),
        (b"open 115200 /dev/robotd/none", "/dev/robotd/none: no such port"),
        (b"open 115200 /dev/null", "/dev/null: cannot be opened as a serial port"),
        (b"open 115200 /", "/: cannot be opened as a serial port"),
        (b"open 115200 /" + b"x" * 4000, "cannot be opened as a serial port"),
        (b"\xff" * 4096, "expected 'open BAUD PORT'"),
    ],
)
def test_a_wrong_request_is_refused_with_what_is_expected(service, path, message, answer):
    with Borrower(path) as client:
        client.say(message)
        heard = client.hear().decode()
        assert heard.startswith("refused ")
        assert answer in heard
        assert client.hear() == b""


def test_a_borrower_that_says_something_else_than_beat_is_not_trusted_any_more(service, path, line):
    with Borrower(path).borrow(line.port) as client:
        client.drive()
        client.say(b"boat")
        assert client.hear() == b"ended found 'boat', expected 'beat'"
        line.pump(is_halted(line))


def test_whoever_says_nothing_is_sent_away_and_so_are_too_many_at_once(service, path, clock):
    clients = [Borrower(path) for _ in range(guardian_module.WAITING_LIMIT + 2)]
    assert b"programs ask at once" in clients[-1].hear()
    clock.t += 1.01
    assert clients[0].hear() == b"refused nothing was asked for 1 s"
    for client in clients:
        client.connection.close()


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    path = tmp_path_factory.mktemp("shared") / "guardian.sock"
    with serving(path):
        yield path


@given(st.lists(st.one_of(st.binary(max_size=50), st.just(b"beat"), st.just(b"open 115200 /dev/null")), max_size=5))
def test_no_message_harms_the_guardian(shared, messages):
    with Borrower(shared) as client:
        for message in messages:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                socket.send_fds(client.connection, [message], [0, 1])  # nor unasked descriptors
    with Borrower(shared) as client:
        client.say(b"open 115200 /dev/robotd/none")
        assert b"no such port" in client.hear()


def test_the_sockets_group_may_connect_and_others_may_not(service, path):
    assert stat.S_IMODE(path.stat().st_mode) == 0o660


def test_a_second_guardian_does_not_take_the_first_ones_socket(service, path, capsys):
    assert main(["--socket", str(path)]) == 1
    assert "another guardian listens there" in capsys.readouterr().err


# ---- real processes --------------------------------------------------------------------------------------------------

DRIVE = """
import asyncio, sys
from pathlib import Path
from robotd import oi
from robotd.errors import DriverFault
from robotd.real import RealHardware

async def main():
    link = await RealHardware(Path(sys.argv[2])).open_serial(sys.argv[1], 115200)
    try:
        link.write(oi.encode("start") + oi.encode("safe"))
        while True:
            link.write(oi.encode("drive_direct", 200, 200))
            await asyncio.sleep(0.015)
    except DriverFault as fault:
        link.close()
        sys.exit(f"fault: {fault}")

asyncio.run(main())
"""


@contextlib.contextmanager
def driving(line, path):
    """A process that drives the robot, in a process group of its own."""
    line.robot.change(oi.OFF)
    with subprocess.Popen(
        [sys.executable, "-c", DRIVE, line.port, str(path)],
        start_new_session=True,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            line.pump(lambda: line.robot.speeds == (200, 200))
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def guarding(path):
    """A guardian as a process of its own, as the service manager starts it."""
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind("")  # a free abstract name
    manager.settimeout(LIMIT)
    address = "@" + manager.getsockname()[1:].decode()
    environment = {**os.environ, "NOTIFY_SOCKET": address, "WATCHDOG_USEC": "300000"}
    command = [sys.executable, "-m", "robotd.guardian", "--socket", str(path)]
    with manager, subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert manager.recv(100).startswith(b"READY=1")
        process.manager = manager
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("is_service", [True, False])
def test_a_killed_daemon_leaves_the_robot_halted_and_off(path, line, is_service):
    with guarding(path) if is_service else contextlib.nullcontext(), driving(line, path) as process:
        os.killpg(process.pid, signal.SIGKILL)  # also all that it has started, unless it has left the group
        line.pump(is_halted(line))


@pytest.mark.parametrize("is_service", [True, False])
def test_a_stopped_daemon_leaves_the_robot_halted_and_moves_nothing_when_it_wakes_up(path, line, is_service):
    with guarding(path) if is_service else contextlib.nullcontext(), driving(line, path) as process:
        os.killpg(process.pid, signal.SIGSTOP)
        line.pump(is_halted(line))
        line.listen()
        before = len(line.received)
        os.killpg(process.pid, signal.SIGCONT)
        _, shown = process.communicate(timeout=LIMIT)
        assert "the guardian has halted the robot" in shown
        line.listen(0.5)
        assert line.robot.mode == oi.OFF
        late = [
            event.name for event in oi.CommandDecoder().feed(line.received[before:]) if isinstance(event, oi.Command)
        ]
        assert late.count("drive_direct") <= 1  # it may have been stopped between asking the time and writing


def test_a_guardian_that_is_told_to_stop_halts_the_robot_first(path, line):
    with guarding(path) as guardian, driving(line, path) as process:
        guardian.terminate()
        line.pump(is_halted(line))
        assert guardian.wait(LIMIT) == 0
        _, shown = process.communicate(timeout=LIMIT)
        assert "the guardian has halted the robot: the guardian was stopped" in shown
    assert not path.with_suffix(".lent").exists()


def test_when_the_guardian_is_killed_the_daemon_halts_the_robot_itself(path, line):
    with guarding(path) as guardian, driving(line, path) as process:
        guardian.kill()
        line.pump(is_halted(line))
        _, shown = process.communicate(timeout=LIMIT)
        assert "the guardian is gone, so the robot was halted from here" in shown


def test_when_both_are_killed_the_next_guardian_halts_the_robot(path, line):
    with guarding(path) as guardian, driving(line, path) as process:
        os.kill(process.pid, signal.SIGSTOP)
        guardian.kill()
        guardian.wait(LIMIT)
        process.kill()
        process.wait(LIMIT)
    line.listen()
    assert line.robot.is_moving
    with guarding(path) as second:
        line.pump(is_halted(line))
        second.terminate()
        assert second.wait(LIMIT) == 0
    assert not path.with_suffix(".lent").exists()


def test_a_port_that_a_hung_daemon_holds_is_halted_as_soon_as_that_is_dead(path, line):
    with guarding(path) as guardian, driving(line, path) as process:
        os.kill(process.pid, signal.SIGSTOP)
        guardian.kill()
        guardian.wait(LIMIT)
        with guarding(path) as second:
            assert second.manager.recv(100) == b"WATCHDOG=1"
            line.listen()
            assert line.robot.is_moving
            process.kill()
            line.pump(is_halted(line))


def test_a_guardian_that_does_not_answer_is_given_up_and_the_robot_halted(path, line):
    with guarding(path) as guardian, driving(line, path) as process:
        guardian.send_signal(signal.SIGSTOP)
        line.pump(is_halted(line))
        _, shown = process.communicate(timeout=LIMIT)
        assert "the guardian has not answered for 1 s" in shown


def test_an_adapter_with_a_lasting_name_is_halted_when_it_is_plugged_in_again(path, line, tmp_path, monkeypatch):
    name = tmp_path / "usb-FTDI"
    name.symlink_to(line.port)
    monkeypatch.setattr(guardian_module, "_is_lasting", lambda port: port == str(name))
    with serving(path), Borrower(path).borrow(str(name)) as client:
        name.unlink()
        line.unplug()
        assert b"unplugged" in client.hear()
        again = Line()
        name.symlink_to(again.port)
        again.pump(is_halted(again))
        again.close()


def test_systemd_hears_that_it_is_ready_alive_and_who_has_the_port(path, line):
    with guarding(path) as guardian:
        assert guardian.manager.recv(100) == b"WATCHDOG=1"
        with Borrower(path).borrow(line.port):
            while (state := guardian.manager.recv(100)) == b"WATCHDOG=1":
                pass
            assert state == f"STATUS={line.port} is lent to process {os.getpid()} of user {os.getuid()}".encode()


def test_it_loads_nothing_but_the_standard_library_pyserial_and_errors():
    script = "import sys; import robotd.guardian; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-I", "-c", script], capture_output=True, text=True, check=True)
    foreign = {name for name in done.stdout.split() if name not in sys.stdlib_module_names}
    assert {name for name in foreign if not name.startswith(("_", "sitecustomize"))} <= {"robotd", "serial"}
