"""What all camera drivers share: streaming while started, and telling the operator when a camera does badly."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

from .camera_feed import CameraCounters, CameraMeter
from .clock import now
from .hardware import CameraCounts, CameraMode
from .plugin import Driver
from .records import Frame

CHECK_S = 10.0
REPEAT_S = 300.0  # before the same complaint is made again


class CameraDriver(Driver):
    """Publishes frames while it is started; a subclass says in `_stream` where they come from.

    Attributes
    ----------
    counters : CameraCounters
        How the camera does, at any time.
    wanted, given : CameraMode or None
        The mode that it streams in, as asked for (None: it is stopped), and as the camera agreed to (None: it has not
        streamed yet, or does not say).
    remarks : tuple of str
        What the camera does otherwise than asked, in words.
    """

    kind = "camera"

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._mode: CameraMode | None = None  # what is wanted; None: nothing
        self._late = self.calibration.stamp_offsets.get(self.name, 0.0)
        self.given: CameraMode | None = None
        self.remarks: tuple[str, ...] = ()
        self._changed = asyncio.Event()
        self._ended = asyncio.Event()  # no stream is running
        self._ended.set()
        self._meter = CameraMeter()
        self._fps: float | None = None
        self._check_at = 0.0
        self._complaint = ""
        self._complained_at = float("-inf")

    async def start(self, mode: CameraMode) -> None:
        """Stream in this mode (a running stream is restarted if the mode differs)."""
        self._want(mode)

    async def stop(self) -> None:
        """Stop streaming; returns when the stream has ended, so that another camera may have its place on the bus."""
        self._want(None)
        await self._ended.wait()

    async def run(self) -> None:
        """Stream whenever started; raises DriverFault when the camera fails."""
        while True:
            self._changed.clear()
            if self._mode is None:
                await self._changed.wait()
                continue
            self._ended.clear()
            try:
                await first_of(self._stream(self._mode), self._changed.wait())
            finally:
                self._ended.set()

    @property
    def wanted(self) -> CameraMode | None:
        """The mode that was asked for."""
        return self._mode

    @property
    def counters(self) -> CameraCounters:
        """How the camera does."""
        return self._meter.read(now())

    async def _stream(self, mode: CameraMode) -> None:
        """Publish frames until cancelled."""
        raise NotImplementedError

    def _begin(self, counts: CameraCounts, fps: float | None) -> None:
        """A stream begins: it keeps these counts, and `fps` frames a second are expected of it if that is known."""
        self._meter.begin(counts, now())
        self._fps = fps
        self._check_at = now() + CHECK_S

    def _publish(self, frame: Frame, mode: CameraMode) -> None:
        """Show a frame of this mode to whoever listens, with its stamp put right by the calibration.

        Nothing of an old mode is seen once another one is wanted.
        """
        if self._mode != mode:
            return
        if self._late:
            frame = replace(frame, t=frame.t - self._late)
        self.bus.frames(self.name).publish(frame)
        self._meter.add(frame, now())
        if now() >= self._check_at:
            self._check_at = now() + CHECK_S
            self._check()

    def _check(self) -> None:
        complaint = "; ".join(self._meter.complaints(now(), self._fps))
        kind = "".join(letter for letter in complaint if letter.isalpha())  # the same complaint with other figures
        if complaint and (kind != self._complaint or now() - self._complained_at >= REPEAT_S):
            self.report(complaint, "warning")
            self._complained_at = now()
        elif self._complaint and not complaint:
            self.report("all is well again")
        self._complaint = kind

    def _want(self, mode: CameraMode | None) -> None:
        if mode != self._mode:
            self._mode = mode
            self._changed.set()


async def first_of(*work: Coroutine[Any, Any, Any]) -> None:
    """Run until the first of these ends, and end the others; raises what ended it."""
    tasks = [asyncio.ensure_future(item) for item in work]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in tasks:
        if not task.cancelled():
            task.result()
