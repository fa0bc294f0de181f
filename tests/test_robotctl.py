"""robotctl as people run it: on the robot, in a terminal, and over a real ssh; against a real daemon and its robot."""

import contextlib
import fcntl
import getpass
import json
import os
import pty
import re
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from tests.robot_process import Robot

SSHD = shutil.which("sshd") or "/usr/sbin/sshd"
needs_sshd = pytest.mark.skipif(
    not (os.path.exists(SSHD) and shutil.which("ssh")), reason="there is no sshd here: apt-get install openssh-server"
)
ROBOTCTL = [sys.executable, "-m", "robotd.ctl.main"]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    """A daemon that drives a simulated robot on a pseudo-terminal."""
    with Robot(tmp_path_factory.mktemp("robot")) as robot:
        yield robot


def robotctl(robot, *words, timeout=60.0, **environment):
    return subprocess.run(
        [*ROBOTCTL, *words],
        env={**os.environ, "ROBOTCTL_SOCKET": str(robot.control), **environment},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


# ---- on the robot ----------------------------------------------------------------------------------------------------


def test_status_is_one_screen_and_one_json_object(robot):
    shown = robotctl(robot, "status")
    assert shown.returncode == 0, shown.stderr
    lines = shown.stdout.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    for word in ("robot ", "pose ", "battery ", "base ", "mission ", "uploads ", "driver ", "roomba"):
        assert word in shown.stdout
    assert re.search(r"^held +no$", shown.stdout, re.M)  # nobody wants to drive, which holds nothing
    status = json.loads(robotctl(robot, "--json", "status").stdout)
    assert status["robot"] == "trial"
    assert status == {**status, "latched": None, "busy": None}
    assert json.loads(robotctl(robot, "status", "--json").stdout).keys() == status.keys()


def test_whoever_reads_only_the_first_lines_sees_no_traceback():
    command = [sys.executable, "-m", "robotd", "config", "schema"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "{\n"
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 0


def test_what_the_robot_refuses_is_said_and_has_an_exit_code(robot):
    refused = robotctl(robot, "mission", "pause")
    assert (refused.returncode, refused.stdout) == (1, "")
    assert refused.stderr == "robotctl: no mission is under way; robotctl mission start begins one\n"
    wrong = robotctl(robot, "mission", "strat")
    assert wrong.returncode == 2
    assert "invalid choice: 'strat'" in wrong.stderr
    assert robotctl(robot, "stops", "show", "x.y").returncode == 2
    both = robotctl(robot, "-H", "ssh://nobody@127.0.0.1", "--socket", "x", "status")
    assert (both.returncode, both.stdout) == (2, "")
    assert "--socket is of robotd here" in both.stderr
    assert "there is no driver 'nose'" in robotctl(robot, "drivers", "restart", "nose").stderr
    assert robotctl(robot, "estop").returncode == 0
    assert "emergency stop" in robotctl(robot, "status").stdout
    assert robotctl(robot, "release").stdout == "released\n"


def test_a_daemon_that_does_not_run_is_told_with_its_mend(tmp_path):
    for make in (lambda path: None, lambda path: bind_and_leave(path)):
        path = tmp_path / "control.sock"
        make(path)
        shown = subprocess.run(
            [*ROBOTCTL, "--socket", str(path), "status"], capture_output=True, text=True, check=False
        )
        assert shown.returncode == 3
        assert "robotd is not running here" in shown.stderr
        assert "systemctl start robotd" in shown.stderr


def bind_and_leave(path):
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))


@pytest.mark.skipif(os.geteuid() != 0, reason="another user's rights can only be tried as root")
def test_somebody_outside_the_group_is_told_how_to_get_in(robot, tmp_path):
    script = "import os, sys; os.setgroups([]); os.setgid(65534); os.setuid(65534); sys.argv[1:] = ['status'];" + (
        "from robotd.ctl.main import main; sys.exit(main())"
    )
    shown = subprocess.run(
        [sys.executable, "-c", "import robotd.ctl.main, robotd.ctl.commands; robotd.ctl.main.parser();" + script],
        env={**os.environ, "ROBOTCTL_SOCKET": str(robot.control)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert shown.returncode == 4, shown.stderr
    assert "usermod -aG robotd" in shown.stderr


def test_another_release_or_program_at_the_socket_is_noticed(tmp_path):
    for hello, words in (
        (b'{"jsonrpc": "2.0", "method": "hello", "params": {"protocol": 99, "robotd": "9.9"}}\n', "version 99"),
        (b"220 smtp ready\n", "is not robotd"),
    ):
        path = tmp_path / f"{len(hello)}.sock"
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(str(path))
            listener.listen()
            with subprocess.Popen(
                [*ROBOTCTL, "--socket", str(path), "status"], stderr=subprocess.PIPE, text=True
            ) as tried:
                connection, _ = listener.accept()
                with connection:
                    connection.sendall(hello)
                    _, said = tried.communicate(timeout=60)
        assert tried.returncode == 6
        assert words in said


def test_robotctl_needs_nothing_but_the_standard_library():
    script = (
        "import sys; from robotd.ctl import calibrate, commands, completion, drive, local, main, watch;"
        "main.parser();"
        "print(sorted({name.split('.')[0] for name in sys.modules} - set(sys.stdlib_module_names)));"
        "print(sorted(name for name in sys.modules if name.startswith('robotd') and not name.startswith('robotd.ctl')))"
    )
    shown = subprocess.run([sys.executable, "-I", "-c", script], capture_output=True, text=True, check=True).stdout
    alien, ours = shown.splitlines()
    assert set(eval(alien)) <= {
        "robotd",
        "__main__",
        "__mp_main__",
        "_distutils_hack",
        "sitecustomize",
        "usercustomize",
    } | {name for name in eval(alien) if name.startswith("__editable__")}
    assert eval(ours) == ["robotd"]


def test_every_command_explains_itself_and_completes():
    from robotd.ctl.completion import bash, fish, zsh
    from robotd.ctl.main import COMMANDS, parser

    for name in COMMANDS:
        words = name.split()
        with pytest.raises(SystemExit) as ended, contextlib.redirect_stdout(None):
            parser(words).parse_args([*words, "--help"])
        assert ended.value.code == 0
        if COMMANDS[name][0]:
            assert all(word in text for text in (bash(), zsh(), fish()) for word in words)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (["robotctl", "mis"], ["mission"]),
        (["robotctl", "mission", ""], ["abort", "pause", "resume", "start", "status"]),
        (["robotctl", "-H", "ssh://pi@robot", "drivers", "re"], ["restart"]),
        (["robotctl", "logs", "--le"], ["--level"]),
        (["robotctl", "beacons", "o"], ["off", "on"]),
    ],
)
def test_bash_completes(line, expected):
    from robotd.ctl.completion import bash

    words = " ".join(f"'{word}'" for word in line)
    script = (
        f"{bash()}\nCOMP_WORDS=({words}); COMP_CWORD={len(line) - 1}; _robotctl; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    )
    shown = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True).stdout
    assert sorted(shown.split()) == expected


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("robotctl mis", ["mission"]),
        ("robotctl mission ", ["abort", "pause", "resume", "start", "status"]),
        ("robotctl -H ssh://pi@robot drivers re", ["restart"]),
        ("robotctl logs --le", ["--level"]),
        ("robotctl beacons o", ["off", "on"]),
    ],
)
def test_fish_completes(line, expected):
    from robotd.ctl.completion import fish

    command = ["fish", "--no-config", "-c", f"{fish()}\ncomplete -C '{line}'"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert sorted(row.split("\t")[0] for row in shown.splitlines()) == expected


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_completes(tmp_path):
    from robotd.ctl.completion import zsh

    (tmp_path / "robotctl.zsh").write_text(zsh())
    master, slave = pty.openpty()
    environment = {"PATH": os.environ["PATH"], "TERM": "dumb", "HOME": str(tmp_path), "PS1": "> "}
    files = {"stdin": slave, "stdout": slave, "stderr": slave}
    with subprocess.Popen(["zsh", "-f", "-i"], env=environment, start_new_session=True, **files) as shell:
        os.close(slave)

        def type_until(keys, words):
            os.write(master, keys.encode())
            shown = ""
            while words not in shown:
                assert select.select([master], [], [], 20.0)[0], shown
                shown += os.read(master, 65536).decode(errors="replace")

        try:
            type_until(f"source {tmp_path}/robotctl.zsh; print rea''dy\n", "ready")
            for typed, completed in (
                ("robotctl mis", "robotctl mission "),
                ("robotctl -H ssh://pi@robot drivers re", "drivers restart"),
                ("robotctl logs --le", "--level"),
            ):
                type_until(f"{typed}\t", completed)
                type_until("\x15print do''ne\n", "\ndone")
        finally:
            shell.kill()
            os.close(master)


# ---- in a terminal ---------------------------------------------------------------------------------------------------


class Terminal:
    """A command in an 80 x 24 terminal, and what stands on its screen."""

    def __init__(self, robot, *words, **environment):
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
        self.before = termios.tcgetattr(slave)
        self.slave = slave
        self.process = subprocess.Popen(
            [*ROBOTCTL, *words],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env={**os.environ, "ROBOTCTL_SOCKET": str(robot.control), "PYTHONIOENCODING": "utf-8", "COLUMNS": "80",
                 "LINES": "24", **environment},
            start_new_session=True,
        )  # fmt: skip
        self.data = b""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)

    def read(self, seconds):
        while select.select([self.master], [], [], seconds)[0]:
            self.data += os.read(self.master, 1 << 16)
            seconds = 0.0

    def press(self, key):
        os.write(self.master, key)

    @property
    def screen(self):
        """The last whole frame, line by line."""
        frames = self.data.decode(errors="replace").split("\x1b[H")
        text = next((frame for frame in reversed(frames) if frame.rstrip().endswith("\x1b[J")), "")
        return [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", line) for line in text.split("\r\n")]

    def wait(self, condition, rounds=600):
        for _ in range(rounds):
            self.read(0.05)
            if condition(self.screen):
                return self.screen
        raise AssertionError("\n".join(self.screen) + self.data[-500:].decode(errors="replace"))


def test_watch_draws_one_screen_and_leaves_the_terminal_as_it_was(robot):
    with Terminal(robot, "watch") as terminal:
        screen = terminal.wait(lambda lines: any("heading" in line for line in lines))
        assert len(screen) <= 24
        assert max(map(len, screen)) <= 80
        text = "\n".join(screen)
        assert all(word in text for word in ("trial", "driven", "passive mode", " m", "base: base found"))
        terminal.press(b"q")
        assert terminal.process.wait(20) == 0
        terminal.read(0.1)
        assert terminal.data.endswith(b"\x1b[?25h\x1b[?1049l")
        assert termios.tcgetattr(terminal.slave) == terminal.before


def drives(state):
    return min(state["requested_mm_s"]) >= 50


def is_halted(state):
    return not any(state["requested_mm_s"])


def test_an_arrow_key_drives_while_it_repeats_and_not_longer(robot):
    with Terminal(robot, "drive", "--speed", "0.1") as terminal:
        terminal.wait(lambda lines: any("battery" in line for line in lines))
        terminal.press(b"\x1b[A")
        robot.wait(drives, while_=lambda: terminal.press(b"\x1b[A"))
        robot.wait(is_halted)
        terminal.wait(lambda lines: any("asked    +0.00 m/s" in line for line in lines))
        terminal.press(b" ")
        terminal.wait(lambda lines: any("stopped by" in line for line in lines))
        terminal.press(b"q")
        assert terminal.process.wait(20) == 0
    robotctl(robot, "release")


def test_a_terminal_that_is_closed_in_the_middle_of_a_drive_halts_the_robot(robot):
    with Terminal(robot, "drive", "--speed", "0.1") as terminal:
        terminal.wait(lambda lines: any("battery" in line for line in lines))
        robot.wait(drives, while_=lambda: terminal.press(b"\x1b[A"))
    robot.wait(is_halted)


def test_without_a_terminal_watch_and_drive_say_so(robot):
    shown = robotctl(robot, "drive")
    assert shown.returncode == 2
    assert "needs a terminal" in shown.stderr


# ---- over ssh --------------------------------------------------------------------------------------------------------

SSHD_CONFIG = """
Port {port}
ListenAddress 127.0.0.1
HostKey {folder}/host
AuthorizedKeysFile {folder}/authorized
PidFile {folder}/sshd.pid
UsePAM no
StrictModes no
PasswordAuthentication no
KbdInteractiveAuthentication no
SetEnv "PATH={path}" "ROBOTCTL_SOCKET={control}"
"""
CLIENT_CONFIG = """
Host *
    UserKnownHostsFile {folder}/known
    StrictHostKeyChecking accept-new
    IdentityFile {folder}/{key}
    IdentitiesOnly yes
    IdentityAgent none
    BatchMode yes
    LogLevel ERROR
"""


class Sshd:
    """A real sshd on the loopback, with keys that nobody keeps."""

    def __init__(self, folder, control):
        self.folder = folder
        for name in ("host", "right", "wrong"):
            subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True)
        (folder / "authorized").write_bytes((folder / "right.pub").read_bytes())
        (folder / "bin").mkdir()
        program = folder / "bin" / "robotctl"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m robotd.ctl.main "$@"\n')
        program.chmod(0o755)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        with contextlib.suppress(OSError):
            Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)
        self.configure(control)
        for key in ("right", "wrong"):
            (folder / f"client-{key}").write_text(CLIENT_CONFIG.format(folder=folder, key=key))

    def configure(self, control, path=None):
        path = path or f"{self.folder}/bin:/usr/bin:/bin"
        text = SSHD_CONFIG.format(folder=self.folder, port=self.port, path=path, control=control)
        (self.folder / "sshd_config").write_text(text)

    def __enter__(self):
        command = [SSHD, "-D", "-e", "-f", str(self.folder / "sshd_config")]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        while "listening on" not in (line := self.process.stderr.readline()):
            assert line, "sshd has ended"
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()
        self.process.stderr.close()

    @property
    def target(self):
        return f"ssh://{getpass.getuser()}@127.0.0.1:{self.port}"

    def ssh(self, key="right"):
        return f"ssh -F {self.folder}/client-{key}"


@pytest.fixture
def sshd(robot, tmp_path):
    server = Sshd(tmp_path, robot.control)
    with server:
        yield server


@needs_sshd
def test_over_ssh_everything_is_as_on_the_robot(robot, sshd):
    shown = robotctl(robot, "-H", sshd.target, "status", ROBOTCTL_SSH=sshd.ssh())
    assert shown.returncode == 0, shown.stderr
    assert "robot      trial, robotd" in shown.stdout
    shown = robotctl(robot, "--json", "drivers", "list", ROBOTCTL_SSH=sshd.ssh(), ROBOTCTL_HOST=sshd.target)
    assert len(json.loads(shown.stdout)["drivers"]) == 4


@needs_sshd
def test_a_shared_connection_serves_several_commands(robot, sshd, tmp_path):
    options = f"{sshd.ssh()} -o ControlMaster=auto -o ControlPath={tmp_path}/master -o ControlPersist=30"
    try:
        for _ in range(3):
            assert robotctl(robot, "-H", sshd.target, "mission", "status", ROBOTCTL_SSH=options).returncode == 0
        assert (tmp_path / "master").exists()
    finally:
        command = [*options.split(), "-O", "exit", "-p", str(sshd.port), "127.0.0.1"]
        subprocess.run(command, capture_output=True, check=False)


@needs_sshd
def test_a_wrong_key_a_dead_host_and_a_missing_daemon_are_told_apart(robot, sshd, tmp_path):
    wrong = robotctl(robot, "-H", sshd.target, "status", ROBOTCTL_SSH=sshd.ssh("wrong"))
    assert wrong.returncode == 5
    assert "Permission denied (publickey)" in wrong.stderr
    assert "ssh says why above" in wrong.stderr
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        dead = robotctl(robot, "-H", f"ssh://127.0.0.1:{free.getsockname()[1]}", "status", ROBOTCTL_SSH=sshd.ssh())
    assert dead.returncode == 5
    assert "Connection refused" in dead.stderr
    sshd.configure(tmp_path / "nobody.sock")
    sshd.process.send_signal(signal.SIGHUP)
    while "listening on" not in sshd.process.stderr.readline():
        pass
    absent = robotctl(robot, "-H", sshd.target, "status", ROBOTCTL_SSH=sshd.ssh())
    assert absent.returncode == 3, absent.stderr
    assert "robotd is not running here" in absent.stderr
    sshd.configure(robot.control, path="/usr/bin:/bin")
    sshd.process.send_signal(signal.SIGHUP)
    while "listening on" not in sshd.process.stderr.readline():
        pass
    missing = robotctl(robot, "-H", sshd.target, "status", ROBOTCTL_SSH=sshd.ssh())
    assert missing.returncode == 5
    assert "robotctl was not found" in missing.stderr


@pytest.mark.parametrize("target", ["ssh://-oProxyCommand=x", "ssh://a b", "http://robot", "ssh://robot:0", "ssh://u@"])
def test_a_target_that_is_none_never_reaches_ssh(robot, target):
    shown = robotctl(robot, "-H", target, "status", ROBOTCTL_SSH="false")
    assert shown.returncode == 2
    assert "expected ssh://user@host" in shown.stderr


@needs_sshd
@pytest.mark.parametrize("how", ["client killed", "server killed"])
def test_a_link_that_drops_in_the_middle_of_a_drive_halts_the_robot(robot, sshd, how):
    with Terminal(robot, "-H", sshd.target, "drive", "--speed", "0.1", ROBOTCTL_SSH=sshd.ssh()) as terminal:
        terminal.wait(lambda lines: any("battery" in line for line in lines))
        before = robot.wait(drives, while_=lambda: terminal.press(b"\x1b[A"))
        if how == "client killed":
            os.killpg(terminal.process.pid, signal.SIGKILL)
        else:
            children = subprocess.run(
                ["ps", "-o", "pid=", "--ppid", str(sshd.process.pid)], capture_output=True, text=True, check=True
            )
            for pid in children.stdout.split():
                os.kill(int(pid), signal.SIGKILL)
        after = robot.wait(is_halted)
        assert max(after["rotations"]) - max(before["rotations"]) < 0.5
        if how == "server killed":
            assert terminal.process.wait(30) == 5
    assert "who drove, is gone" in robotctl(robot, "logs", "--level", "warning").stdout
