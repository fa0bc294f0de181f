"""`robotctl drive`: the arrow keys move the robot for as long as they are held.

A terminal tells that a key is pressed and, while it is held, repeats that; it does not tell that the key was let go.
So a key counts for TAP_S, in which the repeating begins, and once it repeats for HOLD_S after the last repetition.
The robot halts by itself 0.2 s after the last wish, whatever becomes of this program and of the connection.
"""

from __future__ import annotations

import math
import time

from .commands import connect
from .errors import DONE
from .tables import battery_text, held_text, mode_text, motion_text, pose_text, wrapped
from .terminal import Screen

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace
    from typing import Any

WISH_S = 0.05
TAP_S = 0.6
HOLD_S = 0.2
REPEAT_S = 0.15  # two presses within so long are a key that is held
MOTIONS = {
    "up": (1.0, 0.0),
    "down": (-1.0, 0.0),
    "left": (0.0, 1.0),
    "right": (0.0, -1.0),
    "home": (1.0, 0.5),
    "page up": (1.0, -0.5),
}
SPEEDS, TURNS = (0.02, 0.3), (5.0, 170.0)
HELP = (
    "arrow keys: drive and turn; Home, Page Up: curves to the left and right",
    "+ -: faster, slower   space: halt   e: emergency stop   r: release   q: quit",
)


class Stick:
    """What the keys ask for at a time on the computer's own clock."""

    def __init__(self, speed: float, turn: float) -> None:
        self.speed = min(max(speed, SPEEDS[0]), SPEEDS[1])
        self.turn = min(max(turn, TURNS[0]), TURNS[1])  # degrees a second
        self._key: str | None = None
        self._pressed = self._until = -math.inf

    def press(self, key: str, t: float) -> None:
        """A key was pressed, or has repeated."""
        if key in MOTIONS:
            repeats = key == self._key and t - self._pressed < REPEAT_S
            held = key == self._key and t < self._until
            self._until = t + HOLD_S if repeats else max(self._until, t + HOLD_S) if held else t + TAP_S
            self._key, self._pressed = key, t
        elif key in "+=":
            self.speed, self.turn = min(1.25 * self.speed, SPEEDS[1]), min(1.25 * self.turn, TURNS[1])
        elif key == "-":
            self.speed, self.turn = max(0.8 * self.speed, SPEEDS[0]), max(0.8 * self.turn, TURNS[0])
        else:
            self._key, self._until = None, -math.inf

    def motion(self, t: float) -> tuple[float, float]:
        """m/s and rad/s."""
        if self._key is None or t >= self._until:
            return 0.0, 0.0
        forward, left = MOTIONS[self._key]
        return forward * self.speed, left * math.radians(self.turn)


def drive(arguments: Namespace) -> int:
    """Until q; what ends the connection halts the robot."""
    stick = Stick(arguments.speed, arguments.turn)
    with connect(arguments) as robot:
        name = robot.call("status")["robot"]
        robot.send("subscribe", {"rate": 5.0, "events": True})
        sample: dict[str, Any] | None = None
        told, due, drawn = "", time.monotonic(), 0.0
        with Screen() as screen:
            while True:
                pressed, _ = screen.keys(robot.fileno(), due - time.monotonic())
                for key in pressed:
                    stick.press(key, time.monotonic())
                    if key in ("q", "quit", "escape"):
                        robot.call("drive", {"t": time.monotonic()})
                        return DONE
                    if key in (" ", "e", "r"):
                        robot.send({" ": "halt", "e": "estop", "r": "release"}[key])
                while (message := robot.note(0.0)) is not None:
                    params = message.get("params", {})
                    if message.get("method") == "telemetry":
                        sample = params
                    elif message.get("method") == "event":
                        told = f"{params['source']}: {params['text']}"
                    elif "error" in message:
                        told = message["error"]["message"]
                t = time.monotonic()
                if t >= due:
                    speed, turn_rate = stick.motion(t)
                    robot.send("drive", {"t": t, "speed": speed, "turn_rate": turn_rate})
                    due = max(due + WISH_S, t)
                if t - drawn >= 0.2:
                    drawn = t
                    screen.show(_lines(name, stick, sample, told, screen.size[0], t))


def _lines(name: str, stick: Stick, sample: dict[str, Any] | None, told: str, width: int, t: float) -> list[str]:
    speed, turn_rate = stick.motion(t)
    lines = [f"driving {name}", "", *HELP, ""]
    lines.append(f"asked    {speed:+.2f} m/s  {math.degrees(turn_rate):+.0f} deg/s")
    lines.append(f"keys     {stick.speed:.2f} m/s  {stick.turn:.0f} deg/s")
    if sample is not None:
        lines += [
            f"robot    {motion_text(sample['pose'])}",
            f"pose     {pose_text(sample['pose'])}",
            f"base     {mode_text(sample['base'])}",
            f"battery  {battery_text(sample['base'])}",
            *(wrapped(f"held     {held}", width) if (held := held_text(sample["held"])) else [""]),
        ]
    return [*lines, "", *wrapped(told, width)]
