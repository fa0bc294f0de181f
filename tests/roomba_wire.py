"""A simulated robot by itself: neither line nor world."""

import numpy as np

from robotd import oi
from robotd.sim.quirks import RoombaQuirks
from robotd.sim.roomba import SimRoomba


class Wheelbarrow:
    """A body without a world: the wheels roll as they are told."""

    def __init__(self):
        self.left_rotation = self.right_rotation = 0.0
        self.bump_left = self.bump_right = self.cliff = False
        self.wheel_drop_left = self.wheel_drop_right = False
        self.t = 0.0

    def advance(self, t, left_speed, right_speed):
        elapsed, self.t = t - self.t, t
        self.left_rotation += left_speed * elapsed
        self.right_rotation += right_speed * elapsed


class Wire:
    """A robot without a line: bytes in, ticks, bytes out."""

    def __init__(self, body=None, **switches):
        self.body = body or Wheelbarrow()
        self.robot = SimRoomba(self.body, np.random.default_rng(2), RoombaQuirks(**switches))
        self.told = []
        self.robot.listener = self.told.append
        self.ticks = 0

    def send(self, *command):
        self.robot.receive(oi.encode(*command))

    def run(self, seconds=0.015):
        out = b""
        for _ in range(round(seconds / 0.015)):
            self.ticks += 1
            out += self.robot.tick(self.ticks * 0.015)
        return out

    def ask(self, packet):
        self.send("sensors", packet)
        return oi.decode_values([packet], self.run())

    def read(self, packet):
        return self.ask(packet)[packet]

    def begin(self, *commands):
        """Start, then these commands, a tick each; returns the wire."""
        for command in ("start", *commands):
            self.send(*([command] if isinstance(command, str) else command))
            self.run()
        return self
