"""Show drivers' prompts on a terminal, and hand on what is typed there."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

from .bus import Bus
from .clock import now
from .records import Answer


async def converse(bus: Bus, terminal: int, show: Callable[[str], object]) -> None:
    """Until cancelled or the input ends: every prompt is shown, and the next line typed answers the latest one.

    Parameters
    ----------
    bus : Bus
    terminal : int
        File descriptor to read lines from.
    show : callable
        Takes a line of text without its end.
    """
    loop = asyncio.get_running_loop()
    typed: asyncio.Queue[bytes] = asyncio.Queue()
    loop.add_reader(terminal, lambda: typed.put_nowait(_read(terminal)))
    try:
        async with asyncio.TaskGroup() as group:
            showing = group.create_task(_show(bus, show))
            rest = b""
            while data := await typed.get():
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    prompt = bus.prompts.latest
                    if prompt is None or not prompt.text:
                        show("nothing is asked at present")
                        continue
                    text = line.decode(errors="replace").strip() or "done"
                    bus.answers.publish(Answer(now(), prompt.source, prompt.number, text))
            showing.cancel()
    finally:
        loop.remove_reader(terminal)


async def _show(bus: Bus, show: Callable[[str], object]) -> None:
    with bus.prompts.subscribe() as prompts:
        async for prompt in prompts:
            if prompt.text:
                show(f"{prompt.source}: {prompt.text}")


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:
        return b""
