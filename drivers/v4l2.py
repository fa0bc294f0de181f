"""A camera on this computer (USB or the Pi's connector), through Video4Linux."""

from __future__ import annotations

from dataclasses import dataclass, replace

from robotd.bind import ranged
from robotd.camera_driver import CameraDriver
from robotd.errors import DriverFault
from robotd.hardware import CameraMode, CameraSource


@dataclass(frozen=True, slots=True)
class V4l2Config:
    """[drivers.<camera>] with driver = "v4l2"

    `device` is best one of /dev/v4l/by-path/, because those names survive replugging. `fps` replaces what is asked for,
    e.g. where four cameras share one USB bus. `gain`, in the camera's own units, holds unless the mode has its own.
    """

    device: str
    fps: float | None = ranged(None, minimum=1.0, maximum=1000.0)
    gain: float | None = None

    def __post_init__(self) -> None:
        if not self.device:
            raise ValueError("device: found ''; expected a file such as /dev/v4l/by-path/..., see ls /dev/v4l/by-path")


class V4l2Driver(CameraDriver):
    """Publishes the frames of one camera while it is started."""

    Config = V4l2Config
    config: V4l2Config

    async def open(self) -> None:
        """See that the camera is there and gives itself to us."""
        source = await self._open_source(self._mode or CameraMode())
        source.close()

    async def _stream(self, mode: CameraMode) -> None:
        source = await self._open_source(mode)
        try:
            self._check_mode(source, self._asked(mode))
            self._begin(source.counts, source.mode.fps)
            while True:
                self._publish(await source.read(), mode)
        finally:
            source.close()

    async def _open_source(self, mode: CameraMode) -> CameraSource:
        return await self.hardware.open_camera(self.config.device, self.name, self._asked(mode))

    def _asked(self, mode: CameraMode) -> CameraMode:
        config = self.config
        return replace(
            mode,
            fps=mode.fps if config.fps is None else config.fps,
            gain=config.gain if mode.gain is None else mode.gain,
        )

    def _check_mode(self, source: CameraSource, asked: CameraMode) -> None:
        """Say what the camera does not do as asked; another size is a fault."""
        self.given = given = source.mode
        if given.size != asked.size:
            texts = (f"{width}x{height}" for width, height in (given.size, asked.size))
            raise DriverFault(
                "{} gives {} pixels instead of {}, which it was calibrated for; ".format(self.config.device, *texts)
                + "connect the camera that the calibration belongs to, or calibrate this one"
            )
        remarks = list(source.remarks)
        if not remarks and abs(given.fps / asked.fps - 1) > 0.01:
            remarks.append(f"gives {given.fps:g} frames a second instead of {asked.fps:g}")
        self.remarks = tuple(remarks)
        for remark in remarks:
            self.report(f"{self.config.device} {remark}", "warning")
