"""Footage in place of a camera: a recording, a folder of images or a video file."""

from __future__ import annotations

import asyncio
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from robotd.bind import ranged
from robotd.camera_driver import CameraDriver
from robotd.clock import in_thread, now
from robotd.errors import DriverFault, InputError
from robotd.footage import Shot, open_footage
from robotd.hardware import CameraCounts, CameraMode
from robotd.jpeg import Channel
from robotd.records import Frame

FIRST_INTERVAL_S = 1.0 / 30.0  # of footage with one image


@dataclass(frozen=True, slots=True)
class ReplayConfig:
    """[drivers.<camera>] with driver = "replay"

    `file` is a recording (.mcap), a folder of images or a video; `camera` says which one of a recording's, if it is not
    the only one. A folder's times are those of `times` (or times.csv in it): a table of file name and seconds; else
    those in the images' names; or `fps` replaces them all.

    With `pace` "recorded" frames come when they are due, and those that cannot be read in time are dropped, as from a
    camera. With "consumer" the next one comes as soon as everybody has taken the last one, and none is dropped.
    """

    file: Path
    camera: str | None = None
    fps: float | None = ranged(None, minimum=0.01, maximum=10_000.0)
    times: Path | None = None
    channel: Channel = "gray"
    pace: Literal["recorded", "consumer"] = "recorded"
    loop: bool = False


class ReplayDriver(CameraDriver):
    """Publishes the images of one footage while it is started.

    A stopped footage goes on where it was; opening begins it anew. Stamps are those of the footage, moved so that its
    first frame since the start carries the loop time of that start.
    """

    Config = ReplayConfig
    config: ReplayConfig

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._shots: Generator[Shot] | None = None
        self._ahead: asyncio.Future[Shot | None] | None = None  # the next one, being read
        self._number = 0

    async def open(self) -> None:
        """See that the footage is there and that its first image can be read; raises DriverFault."""
        config = self.config
        try:
            self._footage = await in_thread(
                open_footage,
                config.file,
                camera=config.camera,
                fps=config.fps,
                times=config.times,
                channel=config.channel,
            )
        except InputError as error:
            raise DriverFault("; ".join(error.problems)) from error
        self._number = 0
        self.resources.push_async_callback(self._rewind)
        if await self._peek() is None:
            raise DriverFault(f"{config.file}: holds no image")

    async def _stream(self, mode: CameraMode) -> None:
        counts = CameraCounts()
        self._begin(counts, None)
        shot = await self._peek()
        offset = now() - (shot.t if shot is not None else 0.0)  # from the footage's time to loop time
        t, interval = now(), FIRST_INTERVAL_S
        while True:
            if shot is None:
                if not self.config.loop:
                    break
                await self._rewind()
                shot = await self._peek()
                if shot is None:
                    raise DriverFault(f"{self.config.file}: holds no image any more")
                offset = t + interval - shot.t
            t = shot.t + offset
            if self.config.pace == "consumer":
                await self.bus.frames(self.name).wait_taken()
            else:
                await asyncio.sleep(max(0.0, t - now()))
            self._publish(self._frame(shot, t, mode), mode)
            before, shot = shot, await self._next()
            while shot is not None:
                interval = shot.t - before.t
                if self.config.pace == "consumer" or shot.t + offset >= now() - interval:
                    break
                counts.dropped += 1
                before, shot = shot, await self._next()
        self.report(f"{self.config.file}: the end")
        await asyncio.Event().wait()

    def _frame(self, shot: Shot, t: float, mode: CameraMode) -> Frame:
        size = shot.image.shape[1], shot.image.shape[0]
        if size != mode.size:
            raise DriverFault(
                f"{self.config.file} has {size[0]}x{size[1]} pixels instead of {mode.size[0]}x{mode.size[1]}; "
                "replay what this camera's calibration belongs to"
            )
        return Frame(self.name, t, shot.image, self._number, shot.encoded)

    async def _peek(self) -> Shot | None:
        """The next image; None at the end. Reading goes on in its thread if this is cancelled."""
        if self._shots is None:
            self._shots = self._footage.play()
        if self._ahead is None:
            self._ahead = asyncio.ensure_future(in_thread(next, self._shots, None))
        try:
            return await asyncio.shield(self._ahead)
        except InputError as error:
            raise DriverFault("; ".join(error.problems)) from error

    async def _next(self) -> Shot | None:
        """The image after the one that was shown or dropped."""
        self._ahead = None
        self._number += 1
        return await self._peek()

    async def _rewind(self) -> None:
        """Give the footage back; the next look begins it anew."""
        if self._ahead is not None:
            await asyncio.gather(self._ahead, return_exceptions=True)
        if self._shots is not None:
            self._shots.close()
        self._shots = self._ahead = None
