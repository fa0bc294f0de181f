"""robotctl: from the shell's call to its answer, with a daemon that answers at once."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from .table import Row, median_ms

RUNS = 15
STATUS = {
    "robot": "bench",
    "robotd": "0",
    "utc": "2026-03-02T07:30:00+00:00",
    "clock_is_synchronised": True,
    "pose": {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 0.0, "turn_rate": 0.0, "travelled": 0.0},
    "base": None,
    "line": None,
    "held": None,
    "driven_by": None,
    "busy": None,
    "mission": {"state": "idle", "stop": 0, "stops": 0, "text": "", "survey": None, "ended": None},
    "recording": None,
    "uploads": {"url": None, "waiting": 0, "trouble": None},
    "journal_rows_dropped": 0,
    "drivers": [],
}


def rows() -> list[Row]:
    """`robotctl status` on the robot, against Python that does nothing."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
        path = str(Path(folder) / "control.sock")
        listener.bind(path)
        listener.listen()
        threading.Thread(target=_serve, args=(listener,), daemon=True).start()
        command = [str(Path(sys.executable).parent / "robotctl"), "--socket", path, "status"]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

        def ask() -> None:
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)

        def nothing() -> None:
            subprocess.run([sys.executable, "-c", "pass"], check=True, env=environment)

        return [Row("robotctl status", median_ms(ask, RUNS), "python -c pass", median_ms(nothing, RUNS))]


def _serve(listener: socket.socket) -> None:
    hello = {"jsonrpc": "2.0", "method": "hello", "params": {"protocol": 1, "robotd": "0"}}
    while True:
        try:
            connection, _ = listener.accept()
        except OSError:
            return
        with connection, connection.makefile("rb") as lines:
            connection.sendall(json.dumps(hello).encode() + b"\n")
            if line := lines.readline():
                answer = {"jsonrpc": "2.0", "id": json.loads(line)["id"], "result": STATUS}
                connection.sendall(json.dumps(answer).encode() + b"\n")
