"""What the robot asks of a person, e.g. of one who triggers labels by hand, and the answers."""

from __future__ import annotations

import sys
import time

from .commands import ask, connect
from .errors import DONE
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
    with connect(arguments) as robot:
        while True:
            for prompt in robot.call("prompts.list", None)["prompts"]:
                print(f"{prompt['source']}: {prompt['text']}", flush=True)
                line = sys.stdin.readline()
                if not line:
                    return DONE
                said = {"text": line, "source": prompt["source"], "number": prompt["number"]}
                robot.call("prompts.answer", said)
            time.sleep(LOOK_S)
