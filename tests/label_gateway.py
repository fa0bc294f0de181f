"""What tests of the label gateway share: one in this process, and the program."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import robotd.gateway as gateway
from robotd.gateway import Gateway, Outbox

TOKEN = "secret"
FLASH = {"id": 1, "token": TOKEN, "method": "flash", "labels": ["A17", "B 2"], "duration": 3, "strength": 1.0}


def make_desk(folder):
    outbox = Outbox(folder)
    outbox.open()
    return Gateway(outbox, TOKEN)


def ask(desk, request):
    line = request if isinstance(request, bytes) else json.dumps(request).encode()
    return json.loads(desk.answer(line))


def files(folder):
    return {path.name: path.read_text() for path in sorted(folder.glob("*.txt"))}


@contextmanager
def program(folder, *arguments, port=0):
    (folder / "token").write_text(TOKEN + "\n")
    (folder / "token").chmod(0o600)
    watched = folder / "watched"
    watched.mkdir(exist_ok=True)
    command = [
        sys.executable,
        gateway.__file__,
        "--folder",
        watched,
        "--token-file",
        folder / "token",
        "--port",
        str(port),
    ]
    with subprocess.Popen([*map(str, command), *arguments], stdout=subprocess.PIPE, text=True) as process:
        line = process.stdout.readline()
        assert line.startswith("robotd-labels: listening on 127.0.0.1:")
        try:
            yield SimpleNamespace(process=process, port=int(line.rsplit(":", 1)[1]), watched=watched)
        finally:
            process.kill()
