"""Secrets come from files that nobody else can read, or from the service manager's credentials; never from options."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from .errors import ConfigError, DriverFault

LIMIT = 4096  # bytes
CREDENTIALS = "CREDENTIALS_DIRECTORY"  # systemd.exec(5), LoadCredential=


def read_secret(path: Path, where: str, owner: int | None = None) -> str:
    """The first line of a file that only its owner, who is us, root or `owner`, can write, and others cannot read.

    Parameters
    ----------
    path : Path
    where : str
        The configuration's file and key: starts the message of the error.

    Raises
    ------
    ConfigError
        It is missing, no plain file, empty, too long, or open to other users; the message has the mend, not the secret.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise ConfigError(f"{where}: {path} cannot be read: {error.strerror}; write the secret into it") from error
    with os.fdopen(handle, "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"{where}: {path} is no plain file")
        if status.st_mode & 0o027:
            mode = stat.S_IMODE(status.st_mode)
            raise ConfigError(f"{where}: {path} is open to other users (mode {mode:04o}); chmod 0600 {path}")
        if status.st_uid not in (0, os.geteuid(), owner):
            raise ConfigError(f"{where}: {path} belongs to another user; chown it to the user of robotd")
        data = file.read(LIMIT + 1)
    return _checked(data, f"{where}: {path}")


def read_credential(name: str, where: str) -> str:
    """A credential that the unit loads (LoadCredential=NAME:FILE); raises ConfigError."""
    folder = os.environ.get(CREDENTIALS)
    if not folder:
        raise ConfigError(f"{where}: no credentials; put LoadCredential={name}:FILE into the unit, or use token_file")
    try:
        data = (Path(folder) / name).read_bytes()[: LIMIT + 1]
    except OSError as error:
        raise ConfigError(f"{where}: no credential '{name}'; put LoadCredential={name}:FILE into the unit") from error
    return _checked(data, f"{where}: credential '{name}'")


def driver_secret(path: Path | None, credential: str | None, where: str) -> str | None:
    """A driver's secret, from a file or from a credential; None if it has neither. Raises DriverFault."""
    try:
        if path is not None:
            return read_secret(path, where)
        return None if credential is None else read_credential(credential, where)
    except ConfigError as error:
        raise DriverFault(str(error)) from error


def _checked(data: bytes, what: str) -> str:
    text = data.decode("latin-1").split("\n")[0].strip()
    if not text or len(data) > LIMIT:
        raise ConfigError(f"{what} is empty or too long; expected a secret of one line")
    if not (text.isascii() and text.isprintable()):
        raise ConfigError(f"{what}: expected printable ASCII in its first line")
    return text
