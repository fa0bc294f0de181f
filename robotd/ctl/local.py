"""The commands that need no running robotd: they run `robotd` itself, here or over ssh."""

from __future__ import annotations

import os
import subprocess
import sys

from .client import dial_stdio as join, ssh_command
from .errors import NO_CONNECTION, CtlError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace

REMOTE = 'env "PATH=$PATH:/opt/robotd/bin" robotctl '


def doctor(arguments: Namespace) -> int:
    words = ["doctor", *(["--quick"] if arguments.quick else []), *(["--json"] if arguments.json else [])]
    return _robotd(arguments, words, words)


def schema(arguments: Namespace) -> int:
    return _robotd(arguments, ["config", "schema"], ["config", "schema"])


def check(arguments: Namespace) -> int:
    return _robotd(arguments, ["check"], ["config", "check"])


def dial_stdio(arguments: Namespace) -> int:
    return join(arguments.socket)


def _robotd(arguments: Namespace, words: list[str], far: list[str]) -> int:
    """Run `robotd WORDS` here, or `robotctl FAR` there; its output and exit code are ours."""
    file = getattr(arguments, "config", None)
    if arguments.host is not None:
        if file is not None:
            raise CtlError(2, "-c names a file on this computer; with -H the robot's own configuration is used")
        command = ssh_command(arguments.host, REMOTE + " ".join(far))
    else:
        command = [sys.executable, "-m", "robotd", *words, *([] if file is None else ["-c", file])]
        if arguments.socket and words[0] == "doctor":
            command += ["--socket", arguments.socket]
    try:
        code = subprocess.run(command, check=False, env=os.environ).returncode
    except OSError as error:
        raise CtlError(NO_CONNECTION, f"{command[0]} cannot be run: {error.strerror}") from None
    if arguments.host is not None and code == 255:
        raise CtlError(NO_CONNECTION, f"no connection to {arguments.host}; ssh says why above")
    return code
