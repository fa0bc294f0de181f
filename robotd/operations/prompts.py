"""What drivers ask of a person, and the person's answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .. import rpc
from ..bind import ranged
from ..clock import now
from ..control_socket import Client
from ..records import Answer
from ..rpc import RpcError
from .table import Nothing, Operations, method


@dataclass(frozen=True, slots=True)
class Said:
    """Words for the prompt of a driver; default: for the latest one."""

    text: str
    source: str | None = None
    number: int | None = ranged(None, minimum=0)


@method("prompts.list")
def listing(operations: Operations, client: Client, _: Nothing) -> Any:
    """What is asked at present: nothing, or the latest prompt that nobody has answered."""
    prompt, answer = operations.bus.prompts.latest, operations.bus.answers.latest
    answered = (
        answer is not None and prompt is not None and (answer.source, answer.number) == (prompt.source, prompt.number)
    )
    if prompt is None or not prompt.text or answered:
        return {"prompts": []}
    asked = {"source": prompt.source, "number": prompt.number, "text": prompt.text, "age_s": now() - prompt.t}
    return {"prompts": [asked]}


@method("prompts.answer", Said)
def answer(operations: Operations, client: Client, said: Said) -> Any:
    """Hand the words to the driver that asked; it warns if it does not understand them, and they may be said anew."""
    prompt = operations.bus.prompts.latest
    if prompt is None or not prompt.text:
        raise RpcError(rpc.REFUSED, "nothing is asked at present")
    if said.source not in (None, prompt.source) or said.number not in (None, prompt.number):
        raise RpcError(rpc.REFUSED, f"that is not asked any more; at present {prompt.source} asks: {prompt.text}")
    operations.bus.answers.publish(Answer(now(), prompt.source, prompt.number, said.text.strip() or "done"))
    return {"source": prompt.source, "number": prompt.number}
