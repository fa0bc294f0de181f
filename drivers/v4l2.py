"""A camera on this computer (USB or the Pi's connector), through Video4Linux."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from typing import Any

from robotd.bind import ranged
from robotd.errors import DriverFault
from robotd.hardware import CameraMode
from robotd.plugin import Driver


@dataclass(frozen=True, slots=True)
class V4l2Config:
    """[drivers.<camera>] with driver = "v4l2"

    `device` is best one of /dev/v4l/by-path/, because those names survive replugging; `fps`, where given, replaces the
    frame rate that is asked for, e.g. where four cameras share one USB bus.
    """

    device: str
    fps: float | None = ranged(None, minimum=1.0, maximum=1000.0)


class V4l2Driver(Driver):
    """Publishes the frames of one camera while it is started."""

    kind = "camera"
    Config = V4l2Config
    config: V4l2Config

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._mode: CameraMode | None = None  # what is wanted; None: nothing
        self._changed = asyncio.Event()

    async def open(self) -> None:
        """See that the camera is there and gives itself to us."""
        source = await self.hardware.open_camera(self.config.device, self.name, self._asked(self._mode or CameraMode()))
        source.close()

    async def start(self, mode: CameraMode) -> None:
        """Stream in this mode."""
        self._want(mode)

    async def stop(self) -> None:
        """Stop streaming."""
        self._want(None)

    async def run(self) -> None:
        """Stream whenever started; raises DriverFault when the camera fails."""
        while True:
            self._changed.clear()
            if self._mode is not None:
                await self._stream(self._mode)
            else:
                await self._changed.wait()

    def _want(self, mode: CameraMode | None) -> None:
        self._mode = mode
        self._changed.set()

    def _asked(self, mode: CameraMode) -> CameraMode:
        return mode if self.config.fps is None else replace(mode, fps=self.config.fps)

    async def _stream(self, mode: CameraMode) -> None:
        """Publish frames until another mode is wanted."""
        asked = self._asked(mode)
        source = await self.hardware.open_camera(self.config.device, self.name, asked)
        try:
            if source.mode.size != asked.size:
                wanted, given = (f"{width}x{height}" for width, height in (asked.size, source.mode.size))
                raise DriverFault(
                    f"{self.config.device} gives {given} pixels instead of {wanted}, which it was calibrated for; "
                    "connect the camera that the calibration belongs to, or calibrate this one"
                )
            if abs(source.mode.fps / asked.fps - 1) > 0.01:
                text = f"{self.config.device} gives {source.mode.fps:g} frames a second instead of {asked.fps:g}"
                self.report(text, "warning")
            topic = self.bus.frames(self.name)
            while self._mode == mode:
                frame = await source.read()
                if self._mode == mode:  # nothing of an old mode is seen once another one was asked for
                    topic.publish(frame)
        finally:
            source.close()
