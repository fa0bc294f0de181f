"""The labels that a mission looks for: from the configuration, a file, the server or the label system.

What a source elsewhere said last is kept in the state directory, because the robot carries on without the network: a
mission begins with it when the source cannot be asked, and says so; an interrupted one goes on with it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from .clock import in_thread, now
from .config import MissionConfig
from .errors import DriverFault, InputError, MissionError, UploadError
from .files import read_bytes, write_atomic
from .label_list import read_labels
from .plugin import Labels, ListsLabels
from .upload import Uploader

KEPT = "labels.txt"
OPEN_S = 10.0  # for the label system's driver to be opened, when robotd has just been started


class LabelSource:
    """Reads the list of labels; see the head of this file.

    Parameters
    ----------
    folder : Path
        Of the configuration; `labels_file` is relative to it.
    state : Path
        Where the last list is kept.
    labels : Labels
        The label system's driver.
    fault : callable
        Why that driver does not work now, in words, or None.
    uploader : Uploader or None
        Of the server.
    warn : callable
        Gets a sentence.
    """

    def __init__(
        self,
        folder: Path,
        state: Path,
        labels: Labels,
        fault: Callable[[], str | None],
        uploader: Uploader | None,
        warn: Callable[[str], None],
    ) -> None:
        self._folder = folder
        self._kept = state / KEPT
        self._labels = labels
        self._fault = fault
        self._uploader = uploader
        self._warn = warn

    async def labels(self, config: MissionConfig, survey: str, *, goes_on: bool) -> tuple[str, ...]:
        """The labels of a survey; `goes_on`: of an interrupted mission.

        Raises
        ------
        InputError
            The list has mistakes, or lacks a label that a zone names.
        MissionError
            There is none: its source cannot be asked and never was.
        """
        labels = await self._read(config, survey, goes_on=goes_on)
        unknown = sorted({label for zone in config.zones for label in zone.labels} - set(labels))
        if unknown:
            raise InputError(f"[[mission.zones]]: {', '.join(unknown[:5])} not among the labels to look for")
        return labels

    async def _read(self, config: MissionConfig, survey: str, *, goes_on: bool) -> tuple[str, ...]:
        if config.labels_from == "config":
            return config.labels
        if config.labels_from == "file":
            path = self._folder / config.labels_file
            return _decoded(await in_thread(read_bytes, path), str(path))
        if goes_on and self._kept.exists():
            return await self._last()
        try:
            text, where = await self._ask(config, survey)
        except (UploadError, DriverFault, MissionError) as error:
            if not self._kept.exists():
                raise MissionError(f"no list of labels: {error}") from error
            self._warn(f"the list of labels is the last one: {error}")
            return await self._last()
        labels = _decoded(text, where)
        await in_thread(write_atomic, self._kept, "\n".join((*labels, "")).encode())
        return labels

    async def _last(self) -> tuple[str, ...]:
        return _decoded(await in_thread(read_bytes, self._kept), str(self._kept))

    async def _ask(self, config: MissionConfig, survey: str) -> tuple[bytes, str]:
        """The list as it comes, and whose it is."""
        if config.labels_from == "server":
            if self._uploader is None:
                raise MissionError("[mission] labels_from = 'server', but there is no server: set [upload] url")
            return await self._uploader.fetch_labels(survey), f"the labels from {self._uploader.url}"
        if not isinstance(self._labels, ListsLabels):
            raise MissionError(
                f"{self._labels.name}: this driver cannot list its labels; set [mission] labels_from to another source"
            )
        deadline = now() + OPEN_S
        while (fault := self._fault()) is not None:
            if now() > deadline:
                raise DriverFault(fault)
            await asyncio.sleep(0.1)
        return (await self._labels.listed()).encode(), f"the labels from {self._labels.name}"


def _decoded(data: bytes, where: str) -> tuple[str, ...]:
    try:
        return read_labels(data.decode(), where)
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: not UTF-8 at byte {error.start}; save the list as UTF-8") from error
