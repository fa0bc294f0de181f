"""`robotctl watch`: the robot live, on one screen."""

from __future__ import annotations

import time
from collections import deque

from .commands import connect
from .errors import DONE
from .tables import battery_text, held_text, mission_text, mode_text, wrapped
from .terminal import Plan, Screen

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace
    from typing import Any

RATE = 5.0  # samples a second
DRAW_S = 0.2
SIDE = 30  # columns beside the map
EVENTS = 5  # lines below it
TRAIL = 4000  # points
STEP_M = 0.02  # between two of them


class View:
    """What is known, and how it looks."""

    def __init__(self, robot: str) -> None:
        self.robot = robot
        self.sample: dict[str, Any] | None = None
        self.trail: deque[tuple[float, float]] = deque(maxlen=TRAIL)
        self.stops: list[dict[str, Any]] = []
        self.events: deque[dict[str, Any]] = deque(maxlen=50)
        self._made: tuple[Any, ...] | None = None

    def take(self, message: dict[str, Any]) -> bool:
        """Take what came; returns whether the stops are to be asked for again."""
        params = message.get("params", {})
        if message.get("method") == "event":
            self.events.append(params)
        if message.get("method") != "telemetry":
            return False
        self.sample = params
        if (pose := params["pose"]) is not None:
            here = pose["x"], pose["y"]
            if not self.trail or abs(here[0] - self.trail[-1][0]) + abs(here[1] - self.trail[-1][1]) > STEP_M:
                if self.trail and abs(here[0] - self.trail[-1][0]) + abs(here[1] - self.trail[-1][1]) > 1.0:
                    self.trail.clear()  # odometry began anew
                self.trail.append(here)
        mission = params["mission"]
        made = mission["survey"], mission["leg"], mission["stops_made"]
        changed, self._made = made != self._made, made
        return changed and mission["survey"] is not None

    def lines(self, width: int, height: int, *, is_plain: bool) -> list[str]:
        """The whole screen."""
        events = self._event_lines(width, min(EVENTS, max(1, height // 4)))
        rows = height - len(events) - 2
        beside = SIDE if width >= 60 else 0
        side = self._side_lines(beside or width)
        if not beside:
            return [self.robot, *side[: height - 2 - len(events)], *events][:height]
        bar = "|" if is_plain else "\N{BOX DRAWINGS LIGHT VERTICAL}"
        plan = self._plan(width - beside - 3, rows, is_plain=is_plain)
        side += [""] * rows
        body = [f"{left} {bar} {right}" for left, right in zip(plan, side[:rows], strict=True)]
        rule = ("-" if is_plain else "\N{BOX DRAWINGS LIGHT HORIZONTAL}") * width
        return [f"{self.robot:<{width - 8}}q: quit"[:width], *body, rule, *events]

    def _plan(self, width: int, height: int, *, is_plain: bool) -> list[str]:
        pose = None if self.sample is None else self.sample["pose"]
        here = [] if pose is None else [(pose["x"], pose["y"])]
        leg = None if self.sample is None else self.sample["mission"]["leg"]
        stops = [stop for stop in self.stops if stop["leg"] == leg]  # each leg has axes of its own
        plan = Plan(width, height - 1, [*self.trail, *((s["x"], s["y"]) for s in stops), *here], is_plain=is_plain)
        plan.path([*self.trail, *here])
        for stop in stops:
            plan.mark(stop["x"], stop["y"], str(stop["stop"]))
        if pose is not None:
            plan.arrow(pose["x"], pose["y"], pose["heading"])
        metres = next(
            m for m in (100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1) if m * plan.scale <= width or m <= 0.1
        )
        cells = max(1, round(metres * plan.scale / 2))
        scale = "|" + "-" * (cells - 1) + f"| {metres:g} m"
        return [*plan.lines(), f"{scale:<{width}}"[:width]]

    def _side_lines(self, width: int) -> list[str]:
        sample = self.sample
        if sample is None:
            return ["waiting for the robot"]
        pose, base, mission = sample["pose"], sample["base"], sample["mission"]
        lines = []
        if pose is not None:
            degrees = 57.29577951308232
            lines += [
                f"x {pose['x']:7.2f} m   y {pose['y']:7.2f} m",
                f"heading  {degrees * pose['heading']:7.1f} deg",
                f"speed    {pose['speed']:7.2f} m/s",
                f"turning  {degrees * pose['turn_rate']:7.1f} deg/s",
                f"driven   {pose['travelled']:7.2f} m",
            ]
        lines += ["", *wrapped(mode_text(base), width), *wrapped(battery_text(base), width)]
        if held := held_text(sample["held"]):
            lines += wrapped(f"held: {held}", width)
        lines += ["", *wrapped(mission_text(mission), width)]
        if text := (mission["text"] or mission["ended"]):
            lines += wrapped(text, width)
        if (line := sample["line"]) is not None:
            lines += ["", f"line {line['state']}, {100 * line['confidence']:.0f} %"]
        for name, words in (("driven_by", "driven by"), ("busy", "busy:")):
            if sample[name]:
                lines += wrapped(f"{words} {sample[name]}", width)
        if sample["recording"] is not None:
            lines.append(f"recording {sample['recording']['bytes'] / 1e6:.0f} MB")
        return lines

    def _event_lines(self, width: int, count: int) -> list[str]:
        lines: list[str] = []
        for event in self.events:
            level = "" if event["level"] == "info" else f"{event['level'].upper()} "
            text = wrapped(f"{event['source']}: {level}{event['text']}", width - 9)
            lines += [f"{event['utc'][11:19]} {text[0]}", *(f"{'':8} {line}" for line in text[1:])]
        return [*lines[-count:], *[""] * (count - len(lines))]


def watch(arguments: Namespace) -> int:
    """Until q."""
    with connect(arguments) as robot:
        status = robot.call("status")
        view = View(f"{status['robot']}  robotd {status['robotd']}")
        view.trail.extend((x, y) for x, y in robot.call("trail")["points"])
        view.events.extend(robot.call("logs", {"count": EVENTS})["events"])
        robot.send("subscribe", {"rate": RATE, "events": True})
        asked: int | None = None
        drawn = 0.0
        with Screen() as screen:
            while True:
                pressed, _ = screen.keys(robot.fileno(), DRAW_S)
                if {"q", "quit", "escape"} & set(pressed):
                    return DONE
                while (message := robot.note(0.0)) is not None:
                    if asked is not None and message.get("id") == asked:
                        view.stops = (message.get("result") or {}).get("stops", [])
                        asked = None
                    elif view.take(message) and view.sample is not None:
                        asked = robot.send("stops.list", {"survey": view.sample["mission"]["survey"]})
                if time.monotonic() - drawn >= DRAW_S:
                    drawn = time.monotonic()
                    screen.show(view.lines(*screen.size, is_plain=screen.is_plain))
