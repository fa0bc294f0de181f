"""A Video4Linux camera: what it is asked for, what it agrees to, and the thread that takes its frames.

JPEG images are preferred, because raw frames of four cameras exceed USB 2; they are decoded to grey straight out of the
kernel's buffer, at a reduced size where the camera gives a multiple of the size that is wanted. Frames carry the
kernel's time stamp, which is on the monotonic clock as the event loop's time is, and the kernel's count, so that lost
frames show.

Exposure, gain, white balance and focus are locked and read back: a detector of flashes takes any change of them for
light. What a camera refuses, or does otherwise, is a remark in words.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from . import jpeg, v4l2_api as api, v4l2_controls
from .camera_feed import FrameQueue
from .clock import in_thread
from .errors import DriverFault
from .hardware import CameraCounts, CameraMode
from .records import Frame
from .v4l2_api import VideoNode

BUFFERS = 4
STALL_S = 2.0  # without a frame for so long a camera counts as gone
WAKE_S = 0.2  # the thread looks so often whether it shall end
RELEASE_S = 3.0  # for a closed camera to give its device back
KERNEL_STAMP_S = 1.0  # a stamp further from now than this is not on the monotonic clock
FALLBACK_FPS = 15.0
NO_ROOM = "its USB bus has no room"
MORE_ROOM = (
    "set fps = 15 in every camera's section, let the cameras look in pairs (camera_groups in [mission]), or put one on "
    "another USB controller (Pi 5); a hub adds power, but no room"
)
COMPRESSED = ("MJPG", "JPEG")
LUMINANCE_FIRST = ("GREY", "Y800", "NV12", "NV21", "YU12", "YV12")  # whole lines of grey, before any chroma
PACKED = {"YUYV": 0, "YVYU": 0, "UYVY": 1, "VYUY": 1}  # which of every two bytes is grey


@dataclass
class Negotiated:
    """An open node and what it agreed to."""

    node: VideoNode
    mode: CameraMode
    pixels: str
    given: tuple[int, int]  # size of the camera's images, of which the mode's is a fraction
    stride: int  # bytes of a line
    remarks: list[str] = field(default_factory=list)
    areas: list[memoryview] = field(default_factory=list)


class V4l2Source:
    """One running camera: a thread takes and decodes frames, the event loop reads them; see CameraSource."""

    def __init__(self, device: str, name: str, camera: Negotiated) -> None:
        self.device = device
        self.name = name
        self.mode = camera.mode
        self.remarks = tuple(camera.remarks)
        self.counts = CameraCounts()
        self.is_closed = False
        self._camera = camera
        self._loop = asyncio.get_running_loop()
        self._queue = FrameQueue(self.counts)
        self._thread = threading.Thread(target=self._stream, name=f"camera {name}", daemon=True)
        self._thread.start()

    async def read(self) -> Frame:
        """Wait for the next frame; raises DriverFault when none comes."""
        if self.is_closed:
            raise DriverFault(f"{self.device} is closed")
        try:
            async with asyncio.timeout(STALL_S):
                return await self._queue.get()
        except TimeoutError:
            raise DriverFault(
                f"{self.device} has sent no frame for {STALL_S:g} s; check the cable and the USB bandwidth"
            ) from None

    def close(self) -> None:
        """Stop streaming; the thread releases the device within 0.2 s."""
        self.is_closed = True
        self._queue.clear()
        self._queue.fail(f"{self.device} is closed")

    def wait_released(self, seconds: float) -> bool:
        """Block until the device is free; False if it still is not after so long."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    # ---- the thread -------------------------------------------------------------------------------------------------

    def _stream(self) -> None:
        buffer = _a_buffer(0)
        sequence, last = 0, None
        try:
            while not self.is_closed:
                if not self._camera.node.wait(WAKE_S):
                    continue
                try:
                    self._camera.node.ioctl(api.DQBUF, buffer)
                except BlockingIOError:
                    continue
                if last is not None:
                    step = buffer.sequence - last
                    step = step if 0 < step < 1 << 16 else 1  # because some drivers do not count
                    self.counts.lost += step - 1
                    sequence += step
                last = buffer.sequence
                self._take(buffer, sequence)
                self._camera.node.ioctl(api.QBUF, buffer)
        except (OSError, cv2.error) as error:
            self._tell(self._queue.fail, _why_it_ended(self.device, error))
        finally:
            _release(self._camera)

    def _take(self, buffer: api.Buffer, sequence: int) -> None:
        arrived = self._loop.time()
        stamp = buffer.seconds + 1e-6 * buffer.microseconds
        is_monotonic = buffer.flags & api.CLOCK_MASK == api.CLOCK_MONOTONIC
        t = stamp if is_monotonic and abs(arrived - stamp) < KERNEL_STAMP_S else arrived
        image, encoded = None, None
        if not buffer.flags & api.ERROR:
            data = self._camera.areas[buffer.index][: buffer.bytesused]
            image = decode(data, self._camera)
            encoded = bytes(data) if self._camera.pixels in COMPRESSED else None
        if image is None:
            self.counts.damaged += 1  # and a gap in the sequence
            return
        self.counts.decoded += 1
        self.counts.decode_s += self._loop.time() - arrived
        if not self.is_closed:
            self._tell(self._queue.put, Frame(self.name, t, image, sequence, encoded))

    def _tell(self, method: Any, argument: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is gone: nobody is left to be told
            self._loop.call_soon_threadsafe(method, argument)


class V4l2Cameras:
    """The Video4Linux cameras of this computer, each of which is open once."""

    def __init__(self) -> None:
        self._open: dict[str, V4l2Source] = {}

    async def open(self, device: str, name: str, mode: CameraMode) -> V4l2Source:
        """Open a camera and start it; raises DriverFault with the reason and the mend."""
        before = self._open.get(device)
        if before is not None:
            if not before.is_closed:
                raise DriverFault(
                    f"{device} is open already, as camera {before.name}; give every camera its own device"
                )
            if not await in_thread(before.wait_released, RELEASE_S):
                raise DriverFault(f"{device} does not end its last stream; unplug it and plug it in again")
        for other in self._open.values():
            if other.is_closed:  # but its thread may still hold its share of the bus
                await in_thread(other.wait_released, RELEASE_S)
        source = self._open[device] = V4l2Source(device, name, await in_thread(negotiate, device, mode))
        return source


def decode(data: memoryview, camera: Negotiated) -> NDArray[np.uint8] | None:
    """(H, W) grey image of the agreed size from what the camera sent; None if it is damaged."""
    if camera.pixels in COMPRESSED:
        return jpeg.decode(data, camera.mode.size)
    width, height = camera.mode.size
    line = width * (2 if camera.pixels in PACKED else 1)
    if len(data) < camera.stride * (height - 1) + line:
        return None
    raw = np.frombuffer(data, np.uint8, count=camera.stride * (height - 1) + line)
    lines = np.lib.stride_tricks.as_strided(raw, (height, line), (camera.stride, 1))
    if camera.pixels in PACKED:
        lines = lines[:, PACKED[camera.pixels] :: 2]
    return np.array(lines, order="C")


# ---- negotiation, all of it blocking ---------------------------------------------------------------------------------


def negotiate(device: str, mode: CameraMode) -> Negotiated:
    """Open and set up a camera, and start it; blocks for up to a second.

    Raises
    ------
    DriverFault
        The device is missing, busy, no camera, or cannot give this size; the message names the mend.
    """
    cv2.setNumThreads(1)  # because every camera has a thread of its own
    node = _open_node(device)
    try:
        pixels = _choose_pixels(node, device)
        camera = _set_format(node, device, mode, pixels)
        _set_rate(camera, mode.fps)
        camera.mode, remarks = v4l2_controls.lock(camera.node, camera.mode)
        camera.remarks += remarks
        _begin(device, camera)
    except BaseException as error:
        node.close()
        if isinstance(error, OSError):
            raise DriverFault(_why_it_ended(device, error)) from error
        raise
    return camera


def _open_node(device: str) -> VideoNode:
    try:
        node = VideoNode(device)
    except FileNotFoundError:
        raise DriverFault(f"no camera {device}; plug it in, or name another one: found {_existing()}") from None
    except PermissionError:
        raise DriverFault(f"{device} may not be opened; add the user to the group video") from None
    except OSError as error:
        raise DriverFault(f"{device} cannot be opened: {error.strerror}; end the program that uses it") from error
    capability = api.Capability()
    try:
        node.ioctl(api.QUERYCAP, capability)
        flags = capability.device_caps if capability.capabilities & api.HAS_DEVICE_CAPS else capability.capabilities
    except OSError:
        flags = 0
    if not (flags & api.CAN_CAPTURE and flags & api.CAN_STREAM):
        node.close()
        raise DriverFault(f"{device} is not the image node of a camera; name another one: found {_existing()}")
    return node


def _choose_pixels(node: VideoNode, device: str) -> str:
    offered = [api.fourcc_text(item.pixelformat) for item in _enumerate(node, api.ENUM_FMT, _a_description)]
    for pixels in (*COMPRESSED, *LUMINANCE_FIRST, *PACKED):
        if pixels in offered:
            return pixels
    raise DriverFault(
        f"{device} gives {', '.join(offered) or 'no format'}; expected one of MJPG, GREY, YUYV, NV12; a camera on the "
        "Pi's connector needs its legacy driver (camera_auto_detect=0, start_x=1 in config.txt)"
    )


def _set_format(node: VideoNode, device: str, mode: CameraMode, pixels: str) -> Negotiated:
    sizes = _offered_sizes(node, pixels)
    factors = jpeg.REDUCTIONS if pixels in COMPRESSED else (1,)
    wanted = [(mode.size[0] * factor, mode.size[1] * factor) for factor in factors]
    form = api.Format(type=api.CAPTURE)
    for size in [size for size in wanted if size in sizes] or wanted[:1]:
        form.width, form.height = size
        form.pixelformat, form.field = api.fourcc(pixels), api.ANY_FIELD
        node.ioctl(api.S_FMT, form)
        given = form.width, form.height
        if api.fourcc_text(form.pixelformat) == pixels and given in wanted:
            return Negotiated(node, mode, pixels, given, form.bytesperline or given[0] * (1 + (pixels in PACKED)))
    texts = ", ".join(f"{width}x{height}" for width, height in sorted(sizes)) or f"{form.width}x{form.height}"
    raise DriverFault(
        f"{device} cannot give {mode.size[0]}x{mode.size[1]} pixels, which it was calibrated for; it offers {texts}; "
        "connect the camera that the calibration belongs to, or calibrate this one"
    )


def _offered_sizes(node: VideoNode, pixels: str) -> set[tuple[int, int]]:
    """The sizes that a camera lists one by one."""
    return {
        (item.values[0], item.values[1])
        for item in _enumerate(
            node, api.ENUM_FRAMESIZES, lambda k: api.FrameSize(index=k, pixel_format=api.fourcc(pixels))
        )
        if item.type == 1
    }


def _offered_rates(camera: Negotiated) -> list[float]:
    """Frames a second that the camera lists for its size, fastest first."""

    def ask(index: int) -> api.FrameInterval:
        width, height = camera.given
        return api.FrameInterval(index=index, pixel_format=api.fourcc(camera.pixels), width=width, height=height)

    found = [item for item in _enumerate(camera.node, api.ENUM_FRAMEINTERVALS, ask) if item.type == 1]
    return sorted({item.values[1] / item.values[0] for item in found if item.values[0]}, reverse=True)


def _set_rate(camera: Negotiated, fps: float) -> None:
    parameters = api.StreamParameters(type=api.CAPTURE)
    given = 0.0
    with contextlib.suppress(OSError):  # a camera may have one rate only, and not say which
        camera.node.ioctl(api.G_PARM, parameters)
        if parameters.capability & api.HAS_RATE:
            parameters.numerator, parameters.denominator = 1000, round(1000 * fps)
            camera.node.ioctl(api.S_PARM, parameters)
        given = parameters.denominator / parameters.numerator if parameters.numerator else 0.0
    width, height = camera.given
    if given <= 0.0:
        camera.remarks.append(f"does not say how many frames a second it gives; {fps:g} were asked for")
        given = fps
    elif abs(given / fps - 1.0) > 0.01:
        rates = ", ".join(f"{rate:g}" for rate in _offered_rates(camera))
        camera.remarks.append(
            f"gives {given:g} frames a second instead of {fps:g} at {width}x{height} {camera.pixels}"
            + (f"; it offers {rates}" if rates else "")
        )
    camera.mode = replace(camera.mode, fps=given)


def _begin(device: str, camera: Negotiated) -> None:
    """Start the stream, at a lower rate if the USB bus has no room for more."""
    try:
        _start(camera)
        return
    except OSError as error:
        if error.errno == errno.EBUSY:
            raise DriverFault(f"{device} is in use by another program; end that one") from error
        if error.errno != errno.ENOSPC:
            raise
    rates = [rate for rate in _offered_rates(camera) if rate <= FALLBACK_FPS and rate < camera.mode.fps]
    asked = camera.mode.fps
    for rate in rates or ([FALLBACK_FPS] if asked > FALLBACK_FPS else []):
        _stop(camera)
        _set_rate(camera, rate)
        with contextlib.suppress(OSError):
            _start(camera)
            camera.remarks.append(
                f"gives {camera.mode.fps:g} frames a second instead of {asked:g}, because {NO_ROOM} for "
                "more (no space left on device); put it on another USB controller, or set fps in its section"
            )
            return
    raise DriverFault(
        f"{device} cannot stream at {camera.given[0]}x{camera.given[1]}: {NO_ROOM} (no space left on device): the "
        f"cameras on it, each asked for {asked:g} frames a second, reserve more than there is; {MORE_ROOM}"
    )


def _start(camera: Negotiated) -> None:
    request = api.RequestBuffers(count=BUFFERS, type=api.CAPTURE, memory=api.MMAP)
    camera.node.ioctl(api.REQBUFS, request)
    for index in range(request.count):
        buffer = _a_buffer(index)
        camera.node.ioctl(api.QUERYBUF, buffer)
        camera.areas.append(camera.node.map(buffer.length, buffer.offset))
        camera.node.ioctl(api.QBUF, buffer)
    camera.node.ioctl(api.STREAMON, ctypes.c_int32(api.CAPTURE))


def _stop(camera: Negotiated) -> None:
    with contextlib.suppress(OSError):  # it may have been unplugged
        camera.node.ioctl(api.STREAMOFF, ctypes.c_int32(api.CAPTURE))
    for area in camera.areas:
        area.release()
    camera.areas.clear()
    camera.node.unmap()
    with contextlib.suppress(OSError):
        camera.node.ioctl(api.REQBUFS, api.RequestBuffers(count=0, type=api.CAPTURE, memory=api.MMAP))


def _release(camera: Negotiated) -> None:
    _stop(camera)
    camera.node.close()


# ---- small ones ------------------------------------------------------------------------------------------------------


def _a_buffer(index: int) -> api.Buffer:
    return api.Buffer(index=index, type=api.CAPTURE, memory=api.MMAP)


def _a_description(index: int) -> api.FormatDescription:
    return api.FormatDescription(index=index, type=api.CAPTURE)


def _enumerate(node: VideoNode, request: int, record: Any) -> Iterator[Any]:
    """What the kernel lists, up to its EINVAL."""
    for index in range(256):
        item = record(index)
        try:
            node.ioctl(request, item)
        except OSError:
            return
        yield item


def _why_it_ended(device: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.ENODEV, errno.ENXIO):
        return f"{device} is unplugged; plug it in again"
    if number == errno.EBUSY:
        return f"{device} is in use by another program; end that one"
    if number in (errno.EIO, errno.EPROTO, errno.EPIPE, errno.EILSEQ):
        return f"{device} does not answer ({error}); check the cable, the hub and its power supply"
    return f"{device} failed: {error}"


def _existing() -> str:
    by_path = Path("/dev/v4l/by-path")
    found: Sequence[Path] = sorted(by_path.iterdir()) if by_path.is_dir() else sorted(Path("/dev").glob("video*"))
    return ", ".join(map(str, found)) or "none"
