"""`robotctl calibrate`: the robot asks, the person beside it does and measures."""

from __future__ import annotations

import math

from .client import answer
from .commands import connect
from .errors import DONE, USAGE, CtlError
from .tables import show_json

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace
    from typing import Any


def odometry(arguments: Namespace) -> int:
    """Wheels and base."""
    return _run(arguments, "odometry", distance=arguments.distance, turns=arguments.turns, repeat=arguments.repeat)


def camera(arguments: Namespace) -> int:
    """One camera's lens."""
    return _run(arguments, "camera", camera=arguments.camera, **_board(arguments))


def floor(arguments: Namespace) -> int:
    """Where the floor camera is."""
    return _run(arguments, "floor", **_board(arguments))


def rig(arguments: Namespace) -> int:
    """Where the cameras of the rig are."""
    return _run(arguments, "rig", places=arguments.places, headings=arguments.headings)


def flash(arguments: Namespace) -> int:
    """How labels flash."""
    return _run(arguments, "flash", camera=arguments.camera, label=arguments.label, seconds=float(arguments.seconds))


def time(arguments: Namespace) -> int:
    """The offset between cameras and odometry."""
    return _run(arguments, "time", seconds=arguments.seconds)


def _board(arguments: Namespace) -> dict[str, Any]:
    columns, _, rows = arguments.board.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise CtlError(USAGE, f"--board: found {arguments.board!r}; expected inner corners such as 9x6")
    return {"columns": int(columns), "rows": int(rows), "square": arguments.square, "pictures": arguments.pictures}


def _run(arguments: Namespace, what: str, **params: Any) -> int:
    """Talk until it is done; Ctrl-C hangs up, which halts the robot."""
    given = {name: value for name, value in params.items() if value is not None}
    with connect(arguments) as robot:
        number = robot.send("calibrate", {"what": what, **given})
        while True:
            message = robot.note(None)
            assert message is not None
            if message.get("id") == number:
                result = answer(message)
                if arguments.json:
                    show_json(result)
                else:
                    print(result["text"])
                return DONE
            if message.get("method") == "prompt":
                value = _prompt(**message["params"])
                if value is not _NOTHING:
                    robot.send("answer", {"value": value})


_NOTHING = object()


def _prompt(kind: str, text: str) -> Any:
    if kind == "tell":
        print(text, flush=True)
        return _NOTHING
    try:
        if kind == "ready":
            print(f"\n{text}", flush=True)
            input("Press Enter when ready. ")
            return None
        while True:
            words = input(f"{text} ").strip().replace(",", ".")
            try:
                value = float(words)
            except ValueError:
                value = math.nan
            if math.isfinite(value):
                return value
            print(f"found {words!r}; expected a number", flush=True)
    except EOFError:
        raise CtlError(USAGE, "no more answers; the robot stands still, nothing was written") from None
