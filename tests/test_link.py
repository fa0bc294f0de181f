import asyncio
import os
import pty
import tty

import pytest

from robotd import link as link_module
from robotd.errors import DriverFault
from robotd.link import open_serial


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


def test_a_port_in_use_says_so(pair):
    async def main():
        first = await open_serial(pair.port, 115200)
        with pytest.raises(DriverFault, match="in use by another program"):
            await open_serial(pair.port, 115200)
        first.close()
        (await open_serial(pair.port, 115200)).close()

    asyncio.run(main())


def test_a_missing_port_lists_those_that_exist(tmp_path, monkeypatch):
    monkeypatch.setattr(link_module, "BY_ID", tmp_path)
    with pytest.raises(DriverFault, match="is empty: is the adapter plugged in"):
        asyncio.run(open_serial(str(tmp_path / "ttyUSB7"), 115200))
    (tmp_path / "usb-FTDI_FT232R-if00-port0").touch()
    with pytest.raises(DriverFault, match=r"no such port; there are .*usb-FTDI_FT232R-if00-port0"):
        asyncio.run(open_serial(str(tmp_path / "ttyUSB7"), 115200))


def test_a_file_that_is_no_port_and_a_missing_permission_are_explained(tmp_path):
    path = tmp_path / "notes.txt"
    path.touch()
    with pytest.raises(DriverFault, match="cannot be opened as a serial port"):
        asyncio.run(open_serial(str(path), 115200))
    assert "group dialout" in link_module._explain("/dev/ttyUSB0", PermissionError(13, "Permission denied"))
