import asyncio
import contextlib
import errno
import logging
import os
import pty
import select
import socket
import termios
import tty
from pathlib import Path

import pytest

from robotd import link as link_module, real as real_module
from robotd.clock import run_virtual
from robotd.errors import DriverFault
from robotd.link import LentLink
from robotd.real import RealHardware
from robotd.serial_port import HALT

NOWHERE = Path("/robotd/no/such/guardian.sock")  # so every link has a guardian of its own


def open_serial(port, baud, guardian=NOWHERE):
    return link_module.open_serial(port, baud, guardian)


class Pair:
    """A pseudo-terminal: `far` is where the robot would be."""

    def __enter__(self):
        self.far, self.near = pty.openpty()
        tty.setraw(self.far)
        tty.setraw(self.near)
        self.port = os.ttyname(self.near)
        self.open = [self.far, self.near]
        return self

    def hang_up(self):
        while self.open:
            os.close(self.open.pop())

    def __exit__(self, *exc):
        self.hang_up()


@pytest.fixture
def pair():
    with Pair() as pair:
        yield pair


async def read_all(link, count):
    data = b""
    while len(data) < count:
        data += (await link.read())[1]
    return data


def test_bytes_travel_both_ways_with_their_time(pair):
    async def main():
        loop = asyncio.get_running_loop()
        link = await open_serial(pair.port, 115200)
        before = loop.time()
        os.write(pair.far, b"\x13\x00\xff\x11")  # also the bytes that flow control would eat
        t, data = await link.read()
        assert before <= t <= loop.time()
        assert data == b"\x13\x00\xff\x11"
        link.write(b"\x91\x00\x13\x11\x0d")
        assert os.read(pair.far, 100) == b"\x91\x00\x13\x11\x0d"
        link.set_baud(57600)
        assert termios.tcgetattr(pair.near)[4:6] == [termios.B57600, termios.B57600]
        link.pulse_wake(1.0)  # a pseudo-terminal has no wake line: ignored
        link.close()
        link.close()

    asyncio.run(main())


def test_what_is_queued_is_sent_in_order_when_the_port_is_slow(pair):
    async def main():
        loop = asyncio.get_running_loop()
        link = await open_serial(pair.port, 115200)
        received = bytearray()
        os.set_blocking(pair.far, False)
        sent = bytearray()

        def write_for_ever():
            for number in range(100_000):
                block = number.to_bytes(4, "big") * 16
                sent.extend(block)
                link.write(block)

        with pytest.raises(DriverFault, match="takes no more bytes"):
            write_for_ever()
        loop.add_reader(pair.far, lambda: received.extend(os.read(pair.far, 4096)))
        await asyncio.sleep(0.01)
        loop.remove_reader(pair.far)
        assert received
        assert sent.startswith(received)
        link.close()

    asyncio.run(main())


def test_a_waiting_writer_goes_on_when_the_port_drains(pair):
    async def main():
        loop = asyncio.get_running_loop()
        link = await open_serial(pair.port, 115200)
        sent = bytes(range(256)) * 24  # more than a pseudo-terminal holds, less than it and the queue
        for start in range(0, len(sent), 256):
            link.write(sent[start : start + 256])
        received = bytearray()
        done = asyncio.Event()

        def drain():
            received.extend(os.read(pair.far, 4096))
            if len(received) >= len(sent):
                done.set()

        loop.add_reader(pair.far, drain)
        await asyncio.wait_for(done.wait(), 5)
        loop.remove_reader(pair.far)
        assert received == sent
        link.close()

    asyncio.run(main())


def test_an_unplugged_adapter_is_a_driver_fault_for_reader_and_writer(pair):
    async def main():
        link = await open_serial(pair.port, 115200)
        reading = asyncio.create_task(link.read())
        await asyncio.sleep(0)
        pair.hang_up()
        with pytest.raises(DriverFault, match="unplugged"):
            await asyncio.wait_for(reading, 5)
        with pytest.raises(DriverFault, match="unplugged"):
            link.write(b"\x89")
        with pytest.raises(DriverFault, match="unplugged"):
            link.set_baud(19200)
        link.close()

    asyncio.run(main())


def test_bytes_that_came_before_the_unplugging_are_still_read(pair):
    async def main():
        link = await open_serial(pair.port, 115200)
        os.write(pair.far, b"last words")
        assert await read_all(link, 10) == b"last words"
        link.close()
        with pytest.raises(DriverFault, match="closed"):
            await link.read()

    asyncio.run(main())


def test_a_port_in_use_says_so_and_one_whose_robot_is_being_halted_is_waited_for(pair):
    async def main():
        first = await open_serial(pair.port, 115200)
        with pytest.raises(DriverFault, match="in use by another program"):
            await open_serial(pair.port, 115200)
        first.close()
        (await open_serial(pair.port, 115200)).close()

    asyncio.run(main())


def test_a_missing_port_and_a_wrong_rate_are_explained():
    with pytest.raises(DriverFault, match="/dev/robotd/none: no such port; "):
        asyncio.run(open_serial("/dev/robotd/none", 115200))
    with pytest.raises(DriverFault, match="found '12345' baud; expected one of 9600"):
        asyncio.run(open_serial("/dev/robotd/none", 12345))


def test_a_rate_that_does_not_exist_is_a_fault_of_the_link(pair):
    async def main():
        link = await open_serial(pair.port, 115200)
        with pytest.raises(DriverFault, match="cannot be set to 12345 baud"):
            link.set_baud(12345)
        link.close()

    asyncio.run(main())


# ---- finding the guardian --------------------------------------------------------------------------------------------


def test_a_service_of_systemd_starts_no_guardian_of_its_own_but_says_how_to_start_the_service(pair, monkeypatch):
    monkeypatch.setenv("SYSTEMD_EXEC_PID", str(os.getpid()))
    with pytest.raises(DriverFault, match=r"no guardian at .*enable --now robotd-guardian"):
        asyncio.run(open_serial(pair.port, 115200))


def test_a_guardian_that_is_down_or_not_permitted_or_does_not_start_is_explained(pair, tmp_path, monkeypatch):
    path = tmp_path / "guardian.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(path))
    with pytest.raises(DriverFault, match="no guardian listens there; start it: sudo systemctl restart"):
        asyncio.run(open_serial(pair.port, 115200, path))
    monkeypatch.setattr(link_module.sys, "executable", "/bin/false")
    with pytest.raises(DriverFault, match=r"the guardian does not start: .*robotd.guardian --help"):
        asyncio.run(open_serial(pair.port, 115200))
    denied = link_module._explain_connection(path, PermissionError(errno.EACCES, "Permission denied"))
    assert "group robotd" in denied


@pytest.mark.parametrize(
    ("answer", "words"),
    [(b"hello", "without an answer"), (b"", "without an answer"), (b"lent ", "without an answer"), (None, "0.2 s")],
)
def test_a_guardian_that_answers_nonsense_or_nothing_is_a_fault(tmp_path, monkeypatch, answer, words):
    monkeypatch.setattr(link_module, "ANSWER_S", 0.2)

    async def main():
        loop = asyncio.get_running_loop()
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(str(tmp_path / "guardian.sock"))
            listener.listen()
            listener.setblocking(False)
            opening = asyncio.create_task(open_serial("/dev/ttyUSB0", 115200, tmp_path / "guardian.sock"))
            connection, _ = await loop.sock_accept(listener)
            with connection:
                assert await loop.sock_recv(connection, 100) == b"open 115200 /dev/ttyUSB0"
                if answer:
                    connection.send(answer)
                elif answer is not None:
                    connection.close()
                with pytest.raises(DriverFault, match=words):
                    await opening

    asyncio.run(main())


def test_a_remark_about_the_port_is_logged_once(monkeypatch, caplog):
    class Remarkable:
        remark = "/dev/ttyUSB0: no low latency"

    async def lend(port, baud, guardian):
        assert guardian == Path("/there")
        return Remarkable()

    async def main():
        hardware = RealHardware(Path("/there"))
        for _ in range(2):
            await hardware.open_serial("/dev/ttyUSB0", 115200)

    monkeypatch.setattr(real_module, "open_serial", lend)
    with caplog.at_level(logging.INFO):
        asyncio.run(main())
    assert caplog.messages == ["/dev/ttyUSB0: no low latency"]


# ---- watching the guardian, in virtual time --------------------------------------------------------------------------


@contextlib.contextmanager
def lent(pair):
    """A link whose guardian is the test: (link, guardian's end)."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    its.setblocking(False)
    os.set_blocking(pair.far, False)
    with its:
        link = LentLink(pair.port, os.dup(pair.near), ours)
        link.start()
        try:
            yield link, its
        finally:
            link.close()


def hear(connection):
    messages = []
    with contextlib.suppress(BlockingIOError):
        while message := connection.recv(100):
            messages.append(message)
    return messages


def at_far_end(pair):
    try:
        return os.read(pair.far, 10_000)
    except BlockingIOError:
        return b""


def test_heartbeats_leave_every_50_ms_and_stop_with_the_link(pair):
    async def main():
        with lent(pair) as (link, guardian):
            for _ in range(20):
                await asyncio.sleep(0.0501)
                assert hear(guardian) == [b"beat"]
                guardian.send(b"beat")
            await asyncio.sleep(0.01)
            link.close()
            await asyncio.sleep(0.2)
            assert guardian.recv(100) == b""

    run_virtual(main())


def test_at_rest_heartbeats_leave_every_100_ms(pair):
    async def main():
        with lent(pair) as (link, guardian):
            link.rest(10.0)
            await asyncio.sleep(0.051)
            hear(guardian)
            guardian.send(b"beat")
            for _ in range(10):
                await asyncio.sleep(0.1001)
                assert hear(guardian) == [b"beat"]
                guardian.send(b"beat")
            link.rest(0.0)
            await asyncio.sleep(0.3)
            assert len(hear(guardian)) == 5

    run_virtual(main())


def test_an_unanswered_heartbeat_for_a_second_halts_the_robot_from_here(pair):
    async def main():
        with lent(pair) as (link, _):
            await asyncio.sleep(0.99)
            link.write(b"\x80")
            assert at_far_end(pair) == b"\x80"
            await asyncio.sleep(0.11)
            with pytest.raises(DriverFault, match="the guardian has not answered for 1 s, so the robot was halted"):
                await link.read()
            assert at_far_end(pair) == HALT * 3
            with pytest.raises(DriverFault, match="halted from here"):
                link.write(b"\x91\x00\xc8\x00\xc8")
            assert at_far_end(pair) == b""

    run_virtual(main())


def test_a_guardian_that_vanishes_leaves_the_halt_to_the_link(pair):
    async def main():
        with lent(pair) as (link, guardian):
            guardian.close()
            with pytest.raises(DriverFault, match="the guardian is gone, so the robot was halted from here"):
                await link.read()
            assert at_far_end(pair) == HALT * 3

    run_virtual(main())


def test_after_the_guardian_has_ended_the_loan_nothing_is_written(pair):
    async def main():
        with lent(pair) as (link, guardian):
            guardian.send(b"ended no heartbeat for 0.25 s")
            guardian.close()
            with pytest.raises(DriverFault, match=r"the guardian has halted the robot: no heartbeat for 0\.25 s"):
                await link.read()
            with pytest.raises(DriverFault, match="no heartbeat"):
                link.write(b"\x91\x00\xc8\x00\xc8")
            assert at_far_end(pair) == b""

    run_virtual(main())


def test_a_process_that_hung_for_longer_than_the_guardian_waits_writes_nothing_afterwards(pair):
    async def main():
        link = await open_serial(pair.port, 115200)
        os.set_blocking(pair.far, False)
        while link.write(b"\x80" * 1000) or not link._queue:  # so that some is still queued here
            pass
        select.select([], [], [], 0.4)  # the loop hangs
        with pytest.raises(DriverFault, match=r"this process hung for 0.*, so the guardian has halted the robot"):
            link.write(b"\x91\x00\xc8\x00\xc8")
        data = at_far_end(pair)
        await asyncio.sleep(0.05)
        assert b"\x91\x00\xc8" not in data + at_far_end(pair)
        link.close()

    asyncio.run(main())


def test_at_rest_bytes_gather_and_nobody_is_woken_until_the_time_is_over_or_somebody_is_in_a_hurry(pair):
    async def main():
        link = await open_serial(pair.port, 115200)
        loop = asyncio.get_running_loop()
        try:
            for seconds, hurry_s in ((0.1, None), (30.0, 0.05)):
                begun = loop.time()
                link.rest(seconds)
                if hurry_s is not None:
                    loop.call_later(hurry_s, link.rest, 0.0)
                os.write(pair.far, b"one")
                await asyncio.sleep(0.02)
                os.write(pair.far, b"two")
                t, data = await link.read()
                assert data == b"onetwo"
                assert t - begun >= min(seconds, hurry_s or seconds) - 0.002
        finally:
            link.close()

    asyncio.run(main())
