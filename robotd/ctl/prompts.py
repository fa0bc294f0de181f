"""What the robot asks of a person, e.g. of one who triggers labels by hand, and the answers."""

from __future__ import annotations

import queue
import sys
import threading
import time

from .commands import ask, connect
from .errors import DONE, REFUSED, CtlError
from .tables import show_json

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace

LOOK_S = 0.5  # between two looks whether something is asked


def prompts(arguments: Namespace) -> int:
    """Show what is asked; with --follow, until Ctrl-C, and every line typed answers it."""
    if arguments.follow:
        return _converse(arguments)
    answer = ask(arguments, "prompts.list")
    if arguments.json:
        show_json(answer)
    else:
        asked = [f"{prompt['source']}: {prompt['text']}" for prompt in answer["prompts"]]
        print("\n".join(asked) or "nothing is asked at present")
    return DONE


def answer(arguments: Namespace) -> int:
    """Answer what was asked last."""
    result = ask(arguments, "prompts.answer", {"text": " ".join(arguments.text) or "done"})
    if arguments.json:
        show_json(result)
    else:
        print(f"said to {result['source']}")
    return DONE


def _converse(arguments: Namespace) -> int:
    lines: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_type, args=(lines,), daemon=True).start()
    shown = None  # source and number of the prompt on the screen
    with connect(arguments) as robot:
        while True:
            asked = next(iter(robot.call("prompts.list", None)["prompts"]), None)
            if asked is not None and shown != (asked["source"], asked["number"]):
                print(f"{asked['source']}: {asked['text']}", flush=True)
                shown = asked["source"], asked["number"]
            if shown is None and not sys.stdin.isatty():  # a script's lines are for the prompts to come
                time.sleep(LOOK_S)
                continue
            try:
                line = lines.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            if not line:
                return DONE
            if shown is None:
                print("nothing is asked at present", flush=True)
                continue
            try:
                robot.call("prompts.answer", {"text": line, "source": shown[0], "number": shown[1]})
            except CtlError as error:
                if error.code != REFUSED:
                    raise
                print(error, flush=True)  # it was answered elsewhere, or nobody waits for it any more
            shown = None


def _type(lines: queue.Queue[str]) -> None:
    """Hand on what is typed, line by line, and "" at its end."""
    line = "begin"
    while line:
        line = sys.stdin.readline()
        lines.put(line)
