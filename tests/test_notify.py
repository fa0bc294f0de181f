"""systemd hears how the service fares, and nobody minds if there is no systemd."""

from __future__ import annotations

import os
import socket
import sys

import pytest

from robotd.notify import notify, watchdog_s


@pytest.fixture(params=["by hand", "systemd-python"])
def sender(request, monkeypatch):
    """Both ways: through systemd-python, which needs libsystemd to be built, and without it."""
    if request.param == "by hand":
        monkeypatch.setitem(sys.modules, "systemd", None)
        monkeypatch.setitem(sys.modules, "systemd.daemon", None)
    else:
        pytest.importorskip("systemd.daemon", reason="systemd-python is not installed: apt-get install libsystemd-dev")


@pytest.mark.usefixtures("sender")
@pytest.mark.parametrize("abstract", [False, True])
def test_the_state_arrives_as_one_datagram(tmp_path, monkeypatch, abstract):
    name = f"@robotd-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0"))
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        assert notify("READY=1\nSTATUS=fährt zu Halt 3")
        assert listener.recv(4096).decode() == "READY=1\nSTATUS=fährt zu Halt 3"


@pytest.mark.usefixtures("sender")
def test_nothing_happens_without_systemd(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("READY=1")


@pytest.mark.usefixtures("sender")
def test_a_stale_socket_is_no_reason_to_die(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    assert not notify("WATCHDOG=1")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "gone"))
    assert not notify("WATCHDOG=1")


@pytest.mark.usefixtures("sender")
def test_a_manager_that_does_not_read_holds_nobody_up(tmp_path, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        for _ in range(1000):
            if not notify("WATCHDOG=1"):
                break
        else:
            pytest.fail("a thousand messages that nobody reads were all said to be delivered")
        assert listener.recv(100) == b"WATCHDOG=1"
        assert notify("STATUS=read again")


def test_the_watchdog_is_fed_three_times_per_period(monkeypatch):
    monkeypatch.delenv("WATCHDOG_USEC", raising=False)
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    assert watchdog_s() is None
    monkeypatch.setenv("WATCHDOG_USEC", "6000000")
    assert watchdog_s() == 2.0
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert watchdog_s() == 2.0
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_s() is None
    monkeypatch.delenv("WATCHDOG_PID")
    for wrong in ("", "soon", "0"):
        monkeypatch.setenv("WATCHDOG_USEC", wrong)
        assert watchdog_s() is None
