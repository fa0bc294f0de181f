"""Video4Linux as the kernel offers it: the records and numbers of <linux/videodev2.h>, and an open video node.

The layouts are those of 64-bit Linux (x86-64 and aarch64 agree); a test compares them with the C headers. Only what a
single-planar capture device with memory-mapped buffers needs is here.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import select
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint32
from typing import Any

CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MMAP = 1  # V4L2_MEMORY_MMAP
ANY_FIELD = 0
CAN_CAPTURE, CAN_STREAM = 0x1, 0x04000000  # V4L2_CAP_VIDEO_CAPTURE, _STREAMING
HAS_DEVICE_CAPS = 0x80000000
HAS_RATE = 0x1000  # V4L2_CAP_TIMEPERFRAME

ERROR = 0x40  # V4L2_BUF_FLAG_ERROR: the data may be damaged
CLOCK_MASK, CLOCK_MONOTONIC = 0xE000, 0x2000  # V4L2_BUF_FLAG_TIMESTAMP_*
STAMP_SOURCE_MASK, STAMP_AT_START = 0x70000, 0x10000  # V4L2_BUF_FLAG_TSTAMP_SRC_*: end or start of the exposure

DISABLED, READ_ONLY, INACTIVE = 0x1, 0x4, 0x10  # V4L2_CTRL_FLAG_*

# control ids, <linux/v4l2-controls.h>
AUTO_WHITE_BALANCE = 0x0098090C
AUTO_GAIN = 0x00980912
GAIN = 0x00980913
POWER_LINE_FREQUENCY = 0x00980918
BACKLIGHT_COMPENSATION = 0x0098091C
EXPOSURE_AUTO = 0x009A0901
EXPOSURE_ABSOLUTE = 0x009A0902
EXPOSURE_AUTO_PRIORITY = 0x009A0903
FOCUS_AUTO = 0x009A090C
EXPOSURE_MANUAL = 1
EXPOSURE_UNIT = 100e-6  # s, of EXPOSURE_ABSOLUTE


def fourcc(text: str) -> int:
    """The number of a pixel format such as "MJPG"."""
    return int.from_bytes(text.encode("ascii"), "little")


def fourcc_text(number: int) -> str:
    """The four letters of a pixel format."""
    return (number & 0x7FFFFFFF).to_bytes(4, "little").decode("latin-1").strip()


class Capability(ctypes.Structure):
    """struct v4l2_capability."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class Format(ctypes.Structure):
    """struct v4l2_format with its member pix."""

    _fields_ = (
        ("type", c_uint32),
        ("_align", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("_rest", c_uint8 * 176),
    )


class FrameSize(ctypes.Structure):
    """struct v4l2_frmsizeenum; `values` are width, height if `type` is 1, else a range."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("values", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    )


class FrameInterval(ctypes.Structure):
    """struct v4l2_frmivalenum; `values` are numerator, denominator of seconds if `type` is 1, else a range."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("values", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    )


class StreamParameters(ctypes.Structure):
    """struct v4l2_streamparm with its member capture."""

    _fields_ = (
        ("type", c_uint32),
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("numerator", c_uint32),
        ("denominator", c_uint32),
        ("_rest", c_uint8 * 184),
    )


class RequestBuffers(ctypes.Structure):
    """struct v4l2_requestbuffers."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class Buffer(ctypes.Structure):
    """struct v4l2_buffer with the member offset of its union."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("seconds", c_int64),
        ("microseconds", c_int64),
        ("timecode", c_uint8 * 16),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("offset", c_uint32),
        ("_union", c_uint32),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class QueryControl(ctypes.Structure):
    """struct v4l2_queryctrl."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class Control(ctypes.Structure):
    """struct v4l2_control."""

    _fields_ = (("id", c_uint32), ("value", c_int32))


def _number(direction: int, number: int, record: Any) -> int:
    """_IOC of <asm-generic/ioctl.h>."""
    return direction << 30 | ctypes.sizeof(record) << 16 | ord("V") << 8 | number


_WRITE, _READ = 1, 2
QUERYCAP = _number(_READ, 0, Capability)
ENUM_FMT = _number(_READ | _WRITE, 2, FormatDescription)
S_FMT = _number(_READ | _WRITE, 5, Format)
REQBUFS = _number(_READ | _WRITE, 8, RequestBuffers)
QUERYBUF = _number(_READ | _WRITE, 9, Buffer)
QBUF = _number(_READ | _WRITE, 15, Buffer)
DQBUF = _number(_READ | _WRITE, 17, Buffer)
STREAMON = _number(_WRITE, 18, c_int32)
STREAMOFF = _number(_WRITE, 19, c_int32)
G_PARM = _number(_READ | _WRITE, 21, StreamParameters)
S_PARM = _number(_READ | _WRITE, 22, StreamParameters)
G_CTRL = _number(_READ | _WRITE, 27, Control)
S_CTRL = _number(_READ | _WRITE, 28, Control)
QUERYCTRL = _number(_READ | _WRITE, 36, QueryControl)
ENUM_FRAMESIZES = _number(_READ | _WRITE, 74, FrameSize)
ENUM_FRAMEINTERVALS = _number(_READ | _WRITE, 75, FrameInterval)


class VideoNode:
    """An open /dev/video*; every method raises OSError as the kernel does.

    Parameters
    ----------
    path : str
        Opened at once, without blocking.
    """

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._maps: list[mmap.mmap] = []

    def ioctl(self, request: int, record: Any) -> None:
        """Ask the kernel; the record is changed in place."""
        fcntl.ioctl(self._fd, request, record)

    def map(self, length: int, offset: int) -> memoryview:
        """A buffer of the device, readable."""
        area = mmap.mmap(self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ, offset=offset)
        self._maps.append(area)
        return memoryview(area)

    def wait(self, seconds: float) -> bool:
        """Block until a frame can be taken, or the device has failed; False after so long."""
        poller = select.poll()
        poller.register(self._fd, select.POLLIN)
        return bool(poller.poll(1e3 * seconds))

    def unmap(self) -> None:
        """Give the buffers back, of which no view may be left."""
        for area in self._maps:
            area.close()
        self._maps.clear()

    def close(self) -> None:
        """Release the device and its buffers."""
        self.unmap()
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
