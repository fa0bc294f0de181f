"""Exit codes of robotctl, and the error that carries one."""

from __future__ import annotations

DONE = 0
REFUSED = 1  # the robot did not do it, and says why; doctor: something is to be mended
USAGE = 2  # the command line or a file is wrong
NO_DAEMON = 3  # robotd does not run there
NO_PERMISSION = 4  # the user is not in the group of the socket
NO_CONNECTION = 5  # ssh did not get there, or the connection broke
OTHER_VERSION = 6  # robotctl and robotd do not understand each other
INTERRUPTED = 130  # Ctrl-C


class CtlError(Exception):
    """What ends the command: `code` is its exit code, `problems` has one sentence a line."""

    def __init__(self, code: int, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.code = code
        self.problems = problems
