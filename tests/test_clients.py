"""Programs that others wrote for real Roombas, unmodified, on the simulated one.

They live in real time, so the robot does too: a process behind a pseudo-terminal. Every wait here ends with its
condition; limits are for machines that are busy otherwise.
"""

import itertools
import json
import math
import signal
import socket
import struct
import subprocess
import sys
import threading
import time

import pycreate2
import pytest
import serial
import yarc
from yarc.enums import OIMode

LIMIT = 10.0  # s
LIFETIME = 40.0  # s: then the robot dies, and with it a client that waits for ever
PAUSE = threading.Event()


class Robot:
    """`robotd sim roomba` and its control socket."""

    def __init__(self, folder, *options):
        self.path = folder / "roomba"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "robotd", "sim", "roomba", "--link", str(self.path), *options],
            stderr=subprocess.PIPE,
            text=True,
        )
        self._end = threading.Timer(LIFETIME, self.process.kill)
        self._end.start()
        first = self.process.stderr.readline()
        while first and "simulated Roomba at" not in first:
            first = self.process.stderr.readline()
        assert first, "the simulator ended at once"
        self.said = []
        self._reader = threading.Thread(target=lambda: self.said.extend(self.process.stderr))
        self._reader.start()

    def tell(self, **wish):
        with socket.socket(socket.AF_UNIX) as line:
            line.settimeout(LIMIT)
            line.connect(f"{self.path}.ctl")
            line.sendall(json.dumps(wish).encode() + b"\n")
            with line.makefile() as answers:
                answer = json.loads(answers.readline())
        assert "error" not in answer, answer
        return answer

    @property
    def state(self):
        return self.tell(state=True)

    def wait(self, condition):
        """Until `condition(state)`; returns that state."""
        end = time.monotonic() + LIMIT
        while not condition(state := self.state):
            assert time.monotonic() < end, state
            PAUSE.wait(0.02)
        return state

    def wait_mode(self, mode):
        return self.wait(lambda state: state["mode"] == mode)

    def wait_speeds(self, left, right):
        return self.wait(lambda state: state["speeds"] == pytest.approx([left, right], abs=0.016))

    def wait_rest(self):
        return self.wait(lambda state: state["speeds"] == [0.0, 0.0])

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(LIMIT)
        self._end.cancel()
        self._reader.join(LIMIT)
        self.process.stderr.close()
        return code


@pytest.fixture
def robot(tmp_path):
    robot = Robot(tmp_path)
    yield robot
    assert robot.stop() == 0
    assert not robot.path.is_symlink()


def test_pycreate2_starts_changes_modes_drives_plays_and_asks(robot):
    bot = pycreate2.Create2(str(robot.path))
    bot.start()
    robot.wait_mode("passive")
    bot.safe()
    robot.wait_mode("safe")
    before = bot.get_sensors()
    assert before.open_interface_mode == 2
    assert 12_000 < before.voltage < 17_000
    assert before.battery_capacity == 2696
    bot.drive_direct(200, 100)  # right, left
    robot.wait_speeds(0.1, 0.2)
    robot.wait(lambda state: state["rotations"][1] > 0.1)
    bot.drive_direct(-100, -100)
    robot.wait_speeds(-0.1, -0.1)
    bot.drive_direct(0, 0)
    stood = robot.wait_rest()
    after = bot.get_sensors()
    assert after.encoder_counts_left & 0xFFFF == stood["encoders"][0]
    assert after.encoder_counts_right & 0xFFFF == stood["encoders"][1]
    robot.tell(bump="both")  # because this client takes left for right
    end = time.monotonic() + LIMIT
    while not bot.get_sensors().bumps_wheeldrops.bump_left:
        assert time.monotonic() < end
    bot.full()
    robot.wait_mode("full")
    bot.led(4, 255, 128)
    robot.wait(lambda state: state["leds"] == [4, 255, 128])
    bot.createSong(3, [60, 64, 64, 64])
    bot.playSong(3)
    robot.wait(lambda state: state["playing"] == 3)
    del bot  # halts, leaves and closes the port
    robot.wait_mode("off")
    robot.wait_rest()


def streamed(client, sensors, count):
    """Values of `count` consecutive frames; yarc gives up when one is late, which a busy machine makes happen."""
    end = time.monotonic() + LIMIT
    while True:
        frames = []

        def take(values, frames=frames):
            frames.append(values)
            return len(frames) < count

        try:
            client.stream(take, *sensors)
        except (struct.error, ValueError):
            assert time.monotonic() < end
            continue
        return frames


def test_yarc_starts_changes_modes_drives_asks_and_streams(robot):
    wake_line = {False: "low", True: "high"}
    client = yarc.Roomba(str(robot.path), timeout=1.0, brc=lambda *arguments: robot.tell(brc=wake_line[arguments[-1]]))
    client.start()
    robot.wait_mode("passive")
    client.safe()
    robot.wait_mode("safe")
    assert client.oi_mode == OIMode.SAFE
    assert client.query_list("OI_MODE", "BATTERY_CAPACITY", "STATIS") == (OIMode.SAFE, 2696, 0)
    assert len(client.all_sensors) == 49
    client.drive(200, 500)
    robot.wait_speeds(0.153, 0.247)
    client.drive_rotate(-200)
    robot.wait_speeds(0.2, -0.2)
    client.drive_stop()
    robot.wait_rest()

    before = robot.state["pose"]
    assert client.turn_angle(60, 400) >= 60  # fast, because what is below a degree in a tick is lost
    after = robot.wait_rest()["pose"]
    assert 60 <= math.degrees(after[2] - before[2]) < 150
    assert 100 <= client.drive_distance(100, 200) < 150
    robot.wait_rest()

    client.drive_direct(150, 150)
    robot.wait_speeds(0.15, 0.15)
    frames = streamed(client, ["LEFT_ENCODER_COUNTS", "OI_MODE", "REQ_LEFT_VELOCITY"], 20)
    counts = [frame[0] & 0xFFFF for frame in frames]
    steps = [(new - old) & 0xFFFF for old, new in itertools.pairwise(counts)]
    assert all(3 <= step <= 7 for step in steps)  # 0.15 m/s for 15 ms
    assert {frame[1:] == [OIMode.SAFE, 150] for frame in map(list, frames)} == {True}

    client.full()
    robot.wait_mode("full")
    client.power()
    robot.wait(lambda state: state["asleep"])
    client.wake(0.05)
    robot.wait(lambda state: not state["asleep"])
    client.close()
    robot.wait_mode("off")
    robot.wait_rest()


def test_another_baud_rate_is_noise_for_both(robot):
    with serial.Serial(str(robot.path), 57600, timeout=0.2) as port:
        port.write(bytes([128]) * 30)
        robot.wait(lambda state: state["client_baud"] == 57600)
        assert port.read(10) == b""
        assert robot.state["mode"] == "off"
        port.baudrate = 115200
        robot.wait(lambda state: state["client_baud"] == 115200)
        port.write(bytes([128]) * 36)
        robot.wait_mode("passive")
        port.write(bytes([129, 7]))
        robot.wait(lambda state: state["baud"] == 19200)
        port.baudrate = 19200
        port.timeout = LIMIT
        PAUSE.wait(0.15)  # the robot is deaf for 100 ms, by its manual
        port.write(bytes([142, 35]))
        assert port.read(1) == b"\x01"
