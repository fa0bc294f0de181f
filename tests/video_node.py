"""Video4Linux cameras without a kernel: what a node answers to each ioctl, as UVC webcams were seen to do."""

from __future__ import annotations

import errno
import os
import queue
import threading

from robotd import v4l2_api as api


def fault(number):
    return OSError(number, os.strerror(number))


class FakeCamera:
    """A camera and its state across openings.

    `formats` lists rates by pixel format and size; `controls` gives [minimum, maximum, step, default, value] by id;
    `room` is how many pixels a second the USB bus carries, for all cameras on `bus`; `stuck` names controls that ignore
    what is set.
    """

    def __init__(self, formats=None, controls=None):
        self.formats = formats or {
            "YUYV": {(640, 480): [30.0, 15.0, 10.0], (1280, 960): [7.5]},
            "MJPG": {(320, 240): [30.0], (640, 480): [30.0, 25.0, 15.0, 5.0], (1280, 960): [30.0, 15.0]},
        }
        self.controls = controls or {
            api.EXPOSURE_AUTO: [0, 3, 1, 3, 3],
            api.EXPOSURE_AUTO_PRIORITY: [0, 1, 1, 0, 1],
            api.EXPOSURE_ABSOLUTE: [1, 5000, 1, 166, 333],
            api.GAIN: [0, 255, 1, 64, 200],
            api.AUTO_WHITE_BALANCE: [0, 1, 1, 1, 1],
            api.BACKLIGHT_COMPENSATION: [0, 2, 1, 1, 1],
        }
        self.room = float("inf")
        self.bus = [self]
        self.stuck = set()
        self.capabilities = api.CAN_CAPTURE | api.CAN_STREAM
        self.says_rate = True
        self.failure = None  # errno of everything from now on
        self.pixels, self.size, self.rate = "YUYV", (640, 480), 30.0
        self.padding = 0  # bytes that follow each line of a raw image
        self.frames = queue.Queue()
        self.sequence = 0
        self.opened = self.closed = 0
        self.streaming = False
        self.released = threading.Event()

    def send(self, data, stamp, *, flags=api.CLOCK_MONOTONIC, skip=0):
        """The next frame, after `skip` that the kernel lost."""
        self.frames.put((bytes(data), stamp, flags, skip))

    def unplug(self):
        self.failure = errno.ENODEV
        self.frames.put(None)

    @property
    def load(self):
        return self.size[0] * self.size[1] * self.rate

    def value(self, control):
        return self.controls[control][4]


class FakeNode:
    """An open node of a FakeCamera; see robotd.v4l2_api.VideoNode."""

    def __init__(self, camera):
        self.camera = camera
        self.buffers, self.queued = [], []
        self.next = None
        camera.opened += 1
        camera.released.clear()

    def ioctl(self, request, record):
        if self.camera.failure is not None:
            raise fault(self.camera.failure)
        handlers = {
            api.QUERYCAP: self.query_capability,
            api.ENUM_FMT: self.enumerate_formats,
            api.ENUM_FRAMESIZES: self.enumerate_sizes,
            api.ENUM_FRAMEINTERVALS: self.enumerate_rates,
            api.S_FMT: self.set_format,
            api.G_PARM: self.get_rate,
            api.S_PARM: self.set_rate,
            api.QUERYCTRL: self.query_control,
            api.S_CTRL: self.set_control,
            api.G_CTRL: self.get_control,
            api.REQBUFS: self.request_buffers,
            api.QUERYBUF: self.query_buffer,
            api.QBUF: lambda record: self.queued.append(record.index),
            api.DQBUF: self.dequeue,
            api.STREAMON: self.stream_on,
            api.STREAMOFF: self.stream_off,
        }
        handlers[request](record)

    def query_capability(self, record):
        record.capabilities = self.camera.capabilities

    def enumerate_formats(self, record):
        record.pixelformat = api.fourcc(self.at(list(self.camera.formats), record.index))

    def enumerate_sizes(self, record):
        sizes = list(self.camera.formats[api.fourcc_text(record.pixel_format)])
        record.type = 1
        record.values[0], record.values[1] = self.at(sizes, record.index)

    def enumerate_rates(self, record):
        rates = self.camera.formats[api.fourcc_text(record.pixel_format)][record.width, record.height]
        record.type = 1
        record.values[0], record.values[1] = 1000, round(1000 * self.at(rates, record.index))

    @staticmethod
    def at(items, index):
        if index >= len(items):
            raise fault(errno.EINVAL)
        return items[index]

    def set_format(self, record):
        if self.buffers:
            raise fault(errno.EBUSY)
        pixels = api.fourcc_text(record.pixelformat)
        sizes = self.camera.formats[pixels]
        wanted = record.width, record.height
        size = min(sizes, key=lambda size: abs(size[0] - wanted[0]) + abs(size[1] - wanted[1]))
        self.camera.pixels, self.camera.size, self.camera.rate = pixels, size, sizes[size][0]
        record.width, record.height = size
        record.bytesperline = {"YUYV": 2 * size[0], "MJPG": 0}.get(pixels, size[0]) + self.camera.padding

    def get_rate(self, record):
        if not self.camera.says_rate:
            raise fault(errno.ENOTTY)
        record.capability = api.HAS_RATE
        record.numerator, record.denominator = 1000, round(1000 * self.camera.rate)

    def set_rate(self, record):
        if self.buffers:
            raise fault(errno.EBUSY)
        wanted = record.denominator / record.numerator
        rates = self.camera.formats[self.camera.pixels][self.camera.size]
        self.camera.rate = min(rates, key=lambda rate: abs(rate - wanted))
        self.get_rate(record)

    def query_control(self, record):
        if record.id not in self.camera.controls:
            raise fault(errno.EINVAL)
        record.minimum, record.maximum, record.step, record.default_value = self.camera.controls[record.id][:4]

    def set_control(self, record):
        control = self.camera.controls[record.id]
        if not control[0] <= record.value <= control[1]:
            raise fault(errno.ERANGE)
        if record.id not in self.camera.stuck:
            control[4] = record.value

    def get_control(self, record):
        record.value = self.camera.value(record.id)

    def request_buffers(self, record):
        self.buffers = [bytearray(1 << 20) for _ in range(record.count)]
        self.queued = []

    def query_buffer(self, record):
        record.length, record.offset = len(self.buffers[record.index]), record.index << 20

    def map(self, length, offset):
        return memoryview(self.buffers[offset >> 20])[:length]

    def stream_on(self, record):
        others = [camera for camera in self.camera.bus if camera.streaming and camera is not self.camera]
        if sum(camera.load for camera in (self.camera, *others)) > self.camera.room:
            raise fault(errno.ENOSPC)
        self.camera.streaming = True

    def stream_off(self, record):
        self.camera.streaming = False

    def wait(self, seconds):
        if self.next is None:
            try:
                self.next = self.camera.frames.get(timeout=min(seconds, 0.01))
            except queue.Empty:
                return self.camera.failure is not None
        return True

    def dequeue(self, record):
        item, self.next = self.next, None
        if item is None:
            raise fault(errno.EAGAIN)
        data, stamp, flags, skip = item
        index = self.queued.pop(0)
        self.buffers[index][: len(data)] = data
        record.index, record.bytesused, record.flags = index, len(data), flags
        record.seconds, record.microseconds = divmod(round(1e6 * stamp), 1_000_000)
        self.camera.sequence += 1 + skip
        record.sequence = self.camera.sequence

    def unmap(self):
        pass

    def close(self):
        self.camera.closed += 1
        self.camera.released.set()
