"""The real world under the drivers: serial ports, Video4Linux cameras, pins and the computer's date."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .clock import in_thread
from .errors import DriverFault
from .hardware import CameraMode, CameraSource, SerialLink
from .link import open_serial
from .records import Frame

QUEUE = 4  # frames that wait for a slow reader; older ones are dropped
STALL_S = 2.0  # without a frame for so long a camera counts as gone
RELEASE_S = 3.0  # for a closed camera to give its device back
KERNEL_STAMP_S = 1.0  # a stamp further from now than this is not on the monotonic clock
MANUAL = 1  # V4L2_EXPOSURE_MANUAL, linux/v4l2-controls.h
EXPOSURE_UNIT = 100e-6  # s, V4L2_CID_EXPOSURE_ABSOLUTE


class RealHardware:
    """Devices of this computer; see robotd.hardware.Hardware."""

    pins: Any = None

    def __init__(self) -> None:
        self._cameras: dict[str, V4l2Source] = {}

    async def open_serial(self, port: str, baud: int) -> SerialLink:
        """Open a serial port exclusively."""
        return await open_serial(port, baud)

    async def open_camera(self, device: str, name: str, mode: CameraMode) -> CameraSource:
        """Open a Video4Linux camera and start it; raises DriverFault with the reason and the mend."""
        before = self._cameras.get(device)
        if before is not None:
            if not before.is_closed:
                raise DriverFault(
                    f"{device} is open already, as camera {before.name}; give every camera its own device"
                )
            if not await in_thread(before.wait_released, RELEASE_S):
                raise DriverFault(f"{device} does not end its last stream; unplug it and plug it in again")
        capture = await in_thread(_open_capture, device, mode)
        source = V4l2Source(device, name, mode, capture)
        self._cameras[device] = source
        source.start()
        return source

    def utc(self) -> datetime:
        """The computer's date."""
        return datetime.now(UTC)

    def boot_id(self) -> str:
        """The kernel's id of this boot."""
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()

    def is_synchronised(self) -> bool:
        """Whether systemd-timesyncd has set the clock since the boot."""
        return Path("/run/systemd/timesync/synchronized").exists()


class V4l2Source:
    """One running camera: a thread takes and decodes frames, the event loop reads them.

    Frames carry the kernel's time stamp, which is on the monotonic clock as the event loop's time is.
    """

    def __init__(self, device: str, name: str, asked: CameraMode, capture: cv2.VideoCapture) -> None:
        self.device = device
        self.name = name
        size = round(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), round(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        exposure = capture.get(cv2.CAP_PROP_EXPOSURE) * EXPOSURE_UNIT
        self.mode = CameraMode(
            size=size,
            fps=capture.get(cv2.CAP_PROP_FPS) or asked.fps,
            exposure=exposure if exposure > 0 else asked.exposure,
        )
        self.is_closed = False
        self._capture = capture
        self._loop = asyncio.get_running_loop()
        self._frames: deque[Frame] = deque(maxlen=QUEUE)
        self._fault: str | None = None
        self._wake = asyncio.Event()
        self._thread = threading.Thread(target=self._stream, name=f"camera {name}", daemon=True)

    def start(self) -> None:
        """Begin to take frames."""
        self._thread.start()

    async def read(self) -> Frame:
        """Wait for the next frame; raises DriverFault when none comes."""
        while self.is_closed or not self._frames:
            if self._fault is not None or self.is_closed:
                raise DriverFault(self._fault or f"{self.device} is closed")
            self._wake.clear()
            try:
                async with asyncio.timeout(STALL_S):
                    await self._wake.wait()
            except TimeoutError:
                raise DriverFault(
                    f"{self.device} has sent no frame for {STALL_S:g} s; check the cable and the USB bandwidth"
                ) from None
        return self._frames.popleft()

    def close(self) -> None:
        """Stop streaming; the thread releases the device after the frame that it waits for."""
        self.is_closed = True
        self._wake.set()

    def wait_released(self, seconds: float) -> bool:
        """Block until the device is free; False if it still is not after so long."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _stream(self) -> None:
        sequence = 0
        try:
            while not self.is_closed:
                if not self._capture.grab():
                    self._tell(self._fail, f"{self.device} sends no frames any more; check the cable")
                    return
                arrived = time.monotonic()
                stamp = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                if abs(arrived - stamp) > KERNEL_STAMP_S:  # because some drivers stamp with the date, or not at all
                    stamp = arrived
                ok, raw = self._capture.retrieve()
                image = _grey(raw, self.mode.size) if ok else None
                if image is not None:  # a damaged frame leaves a gap in the sequence
                    self._tell(self._deliver, Frame(self.name, stamp, image, sequence))
                sequence += 1
        except cv2.error as error:
            self._tell(self._fail, f"{self.device} failed: {error}")
        finally:
            self._capture.release()

    def _tell(self, method: Any, argument: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is gone: nobody is left to be told
            self._loop.call_soon_threadsafe(method, argument)

    def _deliver(self, frame: Frame) -> None:
        self._frames.append(frame)
        self._wake.set()

    def _fail(self, reason: str) -> None:
        self._fault = reason
        self._wake.set()


def _open_capture(device: str, mode: CameraMode) -> cv2.VideoCapture:
    """Open and set up a camera; blocks for up to a second."""
    cv2.setNumThreads(1)  # because every camera has a thread of its own
    _check_device(device)
    capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    if not capture.isOpened():
        capture.release()
        raise DriverFault(
            f"{device} does not open as a camera; is another program using it, or is it not the image node? "
            f"found {_existing()}"
        )
    settings: Sequence[tuple[int, float]] = (
        (cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG")),  # because raw frames of four cameras exceed USB 2
        (cv2.CAP_PROP_FRAME_WIDTH, mode.size[0]),
        (cv2.CAP_PROP_FRAME_HEIGHT, mode.size[1]),
        (cv2.CAP_PROP_FPS, mode.fps),
        (cv2.CAP_PROP_CONVERT_RGB, 0),
        (cv2.CAP_PROP_BUFFERSIZE, 2),
        (cv2.CAP_PROP_AUTO_WB, 0),
        (cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL),
        (cv2.CAP_PROP_EXPOSURE, max(1, round(mode.exposure / EXPOSURE_UNIT))),
        (cv2.CAP_PROP_GAIN, capture.get(cv2.CAP_PROP_GAIN)),  # because writing the gain ends its automatic control
    )
    for name, value in settings:
        capture.set(name, value)  # a camera may lack a control; `mode` says what came of it
    return capture


def _check_device(device: str) -> None:
    try:
        os.close(os.open(device, os.O_RDWR | os.O_NONBLOCK))
    except FileNotFoundError:
        raise DriverFault(f"no camera {device}; plug it in, or name another one: found {_existing()}") from None
    except PermissionError:
        raise DriverFault(f"{device} may not be opened; add the user to the group video") from None
    except OSError as error:
        raise DriverFault(f"{device} cannot be opened: {error.strerror}; end the program that uses it") from error


def _existing() -> str:
    by_path = Path("/dev/v4l/by-path")
    found = sorted(by_path.iterdir()) if by_path.is_dir() else sorted(Path("/dev").glob("video*"))
    return ", ".join(map(str, found)) or "none"


def _grey(raw: NDArray[Any], size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """(H, W) grey image from what a camera sent (JPEG, YUYV, grey, or BGR from one that converts); None if damaged."""
    shape = (size[1], size[0])
    if raw.shape == shape:
        return np.array(raw, dtype=np.uint8)
    if raw.ndim == 3 and raw.shape[:2] == shape:
        if raw.shape[2] == 3:
            return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        return np.ascontiguousarray(raw[:, :, 0], dtype=np.uint8)  # YUYV: brightness in every first byte
    if raw.size == 0:
        return None
    image = cv2.imdecode(raw.reshape(-1), cv2.IMREAD_GRAYSCALE)
    return np.asarray(image, dtype=np.uint8) if image is not None and image.shape == shape else None
