"""How a daemon starts: soon ready, in little memory, and without long pauses afterwards.

A dataclass writes its methods as text and compiles them whenever its module is imported. The daemon has 150 of them,
and that was a third of what it took until it was ready. So their code is kept, found by its text, which is why it is
never out of date, in the folder of this module's own compiled code. Who may not write there (the service) only reads:
on the robot `sudo robotd check`, part of the installation, leaves the file. Without it everything works, more slowly.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import gc
import importlib.util
import marshal
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType
from typing import Any

SWITCH_S = 0.001
M_ARENA_MAX = -8  # mallopt(3)
LIMIT = 4 << 20  # bytes; a file that has gathered the code of many releases is begun anew


def keep_memory_together() -> None:
    """Have glibc's malloc use one arena: each thread would keep some MB of its own, which no other could use."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Load everything inside: what is there afterwards stays, so the garbage collector never looks at it again.

    A full collection of what is imported takes 10 ms here and ten times that on a Pi, with the control loop standing
    still. And from then on a thread that wants to run waits 1 ms for one that computes in Python, not 5 ms.
    """
    gc.disable()
    try:
        with kept():
            yield
    finally:
        gc.freeze()
        gc.enable()
        sys.setswitchinterval(SWITCH_S)


def place() -> Path:
    """Where the code is kept: the name has Python's version in it."""
    return Path(importlib.util.cache_from_source(__file__)).with_suffix(".kept")


@contextlib.contextmanager
def kept(path: Path | None = None) -> Iterator[None]:
    """Dataclasses that are made inside take their code from the file at `path`, and leave there what it lacks."""
    path = path or place()
    known = _read(path)
    found = len(known)

    def run(text: Any, *spaces: Any) -> None:
        code = known.get(text) if isinstance(text, str) else text
        if code is None:
            code = known[text] = compile(text, "<string>", "exec", dont_inherit=True)
        exec(code, *spaces)

    names = vars(dataclasses)
    names["exec"] = run  # because a module's own name goes before the built-in one
    try:
        yield
    finally:
        del names["exec"]
        if len(known) > found and not sys.dont_write_bytecode:
            _write(path, known)


def _read(path: Path) -> dict[str, CodeType]:
    try:
        data = path.read_bytes()
        if data.startswith(importlib.util.MAGIC_NUMBER) and len(data) < LIMIT:
            known = marshal.loads(data[len(importlib.util.MAGIC_NUMBER) :])
            return known if isinstance(known, dict) else {}
    except (OSError, EOFError, TypeError, ValueError):
        pass
    return {}


def _write(path: Path, known: dict[str, CodeType]) -> None:
    part = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(importlib.util.MAGIC_NUMBER + marshal.dumps(known))
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
