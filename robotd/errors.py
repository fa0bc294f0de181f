"""Every error that robotd raises on purpose, one class per way to react.

    RobotdError                 catch this to print the message and stop
    ├── InputError              the caller's file, table or command is wrong: mend it and run again
    │   └── ConfigError         ... a configuration, calibration or layout; lists every mistake at once
    ├── DriverFault             a device is unplugged, silent or talks garbage: halt, report, reopen with back-off
    ├── MissionError            the mission cannot go on (line lost, stop refused): pause, keep what was finished
    │   └── StorageError        ... because the disk takes nothing more: wait for room, then do it again
    ├── UploadError             the server did not take a record: keep it and try again later
    └── SolverError             the survey cannot be solved at all; the message says which data is missing

A message says where, what was wanted, what came, and the next step; it starts in lower case and has no full stop.
"""


class RobotdError(Exception):
    """Base of every error raised on purpose."""


class InputError(RobotdError):
    """A file, table or command is wrong; the message lists where and how to mend it.

    Attributes
    ----------
    problems : tuple of str
        One sentence per mistake.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class ConfigError(InputError):
    """A configuration, calibration or layout is wrong; `problems` has one line per mistake."""


class DriverFault(RobotdError):
    """A device failed in a way that reopening it may mend."""


class MissionError(RobotdError):
    """The mission cannot go on; what was finished stays valid."""


class StorageError(MissionError):
    """The disk did not take a record; the same again will do once there is room."""


class UploadError(RobotdError):
    """The server did not accept a record; it stays in the queue.

    Attributes
    ----------
    permanent : bool
        True if sending the same bytes again cannot succeed (the server refused the content).
    """

    def __init__(self, message: str, *, permanent: bool = False) -> None:
        super().__init__(message)
        self.permanent = permanent


class SolverError(RobotdError):
    """No map can be made from this survey."""
