"""The simulator under the drivers: a `Hardware` that speaks a robot's bytes and delivers rendered pixels.

A frame is rendered in a thread while virtual time goes on: it starts when the last row has been exposed, and only a
reader who takes the frame waits for it, with virtual time held. Whatever is random is drawn in the loop's thread, in
the order of the frames, so that threads cannot change any pixel.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..clock import now, outside
from ..errors import DriverFault
from ..hardware import CameraCounts, CameraMode, CameraSource, SerialLink, Ticker
from ..records import Frame
from ..ticker import LoopTicker
from .camera import RigRenderer
from .floor import FloorRenderer
from .pins import pin_factory
from .roomba_link import RoombaLink
from .world import FLOOR, RIG, World

START = datetime(2026, 3, 2, 7, 30, tzinfo=UTC)  # the date at loop time 0
FOLDER = "/dev/robotd/"
PORT = FOLDER + "base"
CAMERAS = {FOLDER + name: name for name in (*RIG, FLOOR)}
THREADS = 2
BUFFERS = 4  # frames that wait for a reader, as in a video device
SHORTEST, LONGEST, FASTEST = 0.001, 0.040, 60.0  # exposure in seconds, frames per second

Image = NDArray[np.uint8]
Prepare = Callable[[float, float, int], Callable[[], Image]]


class Tap(Protocol):
    """Somebody who listens in: a recorder."""

    def frame(self, frame: Frame, delivered: float) -> None:
        """A frame that a driver took at loop time `delivered`."""

    def serial(self, port: str, t: float, data: bytes, *, to_robot: bool) -> None:
        """Bytes on a serial line at loop time `t`."""


class SimHardware:
    """The devices of a simulated robot; see robotd.hardware.Hardware.

    Parameters
    ----------
    world : World
        Reached by nothing but bytes, pixels and pins.
    tap : Tap, optional
        Gets every frame that a driver takes and every byte on the serial line.
    """

    def __init__(self, world: World, tap: Tap | None = None) -> None:
        self._world = world
        self._tap = tap
        self._pins: Any = None
        self._studio = _Studio(world)

    @property
    def pins(self) -> Any:
        """A gpiozero factory of simulated pins."""
        if self._pins is None:
            self._pins = pin_factory(self._world.pins)
        return self._pins

    def ticker(self, period: float, function: Callable[[int], None]) -> Ticker:
        """On the loop, whose time may be virtual."""
        return LoopTicker(period, function)

    async def open_serial(self, port: str, baud: int) -> SerialLink:
        """Open the robot's serial port, /dev/robotd/base."""
        if port != PORT:
            raise DriverFault(f"no serial port {port}; this robot has {PORT}")
        if port in self._world.unplugged:
            raise DriverFault(f"{port} is unplugged; plug the adapter in again")
        link = RoombaLink(self._world.roomba, baud)
        self._world.on_unplug(port, link.unplug)
        return link if self._tap is None else _TappedLink(link, port, self._tap)

    async def open_camera(self, device: str, name: str, mode: CameraMode) -> CameraSource:
        """Open and start one of the cameras front, left, rear, right and floor of /dev/robotd/."""
        if device not in CAMERAS:
            raise DriverFault(f"no camera {device}; this robot has {', '.join(CAMERAS)}")
        if device in self._world.unplugged:
            raise DriverFault(f"{device} is unplugged; plug the camera in again")
        source = self._studio.open(device, name, mode, self._tap)
        self._world.on_unplug(device, source.unplug)
        return source

    def utc(self) -> datetime:
        """A fixed date at loop time 0, and as much later as the loop's time says."""
        return START + timedelta(seconds=now())

    def boot_id(self) -> str:
        """One boot for each seed."""
        return f"simulated-{self._world.seed}"

    def is_synchronised(self) -> bool:
        """The simulated date is the simulated world's."""
        return True


class _Studio:
    """Renderers of all cameras and the threads that they share while any camera is open."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._renderers: dict[str, Prepare] = {}
        self._rngs: dict[str, np.random.Generator] = {}
        self._open: set[str] = set()
        self._threads: ThreadPoolExecutor | None = None

    def open(self, device: str, name: str, mode: CameraMode, tap: Tap | None) -> SimCameraSource:
        if device in self._open:
            raise DriverFault(f"{device} is in use by another driver; configure every camera once")
        camera = CAMERAS[device]
        if device not in self._renderers:
            self._renderers[device] = self._floor(camera) if camera == FLOOR else self._rig(camera)
            self._rngs[device] = self._world.rng(f"camera/{camera}")
        self._open.add(device)
        if self._threads is None:
            self._threads = ThreadPoolExecutor(THREADS, thread_name_prefix="render")
        model = self._world.floor_camera if camera == FLOOR else self._world.rig[list(RIG).index(camera)]
        settings = self._world.settings
        source = SimCameraSource(device, name, mode, model.size)
        source.start(
            self._world,
            readout=settings.floor.readout if camera == FLOOR else settings.sensor.readout,
            offset=self._world.camera_offset(camera),
            rng=self._rngs[device],
            submit=partial(self._submit, self._renderers[device]),
            release=partial(self._release, device),
            tap=tap,
        )
        return source

    def _submit(self, prepare: Prepare, t: float, exposure: float, seed: int) -> Future[Image]:
        assert self._threads is not None
        return self._threads.submit(prepare(t, exposure, seed))

    def _release(self, device: str) -> None:
        self._open.discard(device)
        if not self._open and self._threads is not None:
            self._threads.shutdown(wait=False)
            self._threads = None

    def _rig(self, camera: str) -> Prepare:
        world = self._world
        model = world.rig[list(RIG).index(camera)]
        seed = int(world.rng(f"renderer/{camera}").integers(2**31))
        renderer = RigRenderer(world.scene, model, world.settings.sensor, seed)
        readout = world.settings.sensor.readout

        def prepare(t: float, exposure: float, seed: int) -> Callable[[], Image]:
            T = world.body.T_store_robot(t + 0.5 * (readout + exposure))
            return partial(renderer.render, T, t, exposure, world.lit, seed)

        return prepare

    def _floor(self, camera: str) -> Prepare:
        world = self._world
        seed = int(world.rng(f"renderer/{camera}").integers(2**31))
        renderer = FloorRenderer(world.layout, world.settings, world.floor_camera, seed)
        readout = world.settings.floor.readout

        def prepare(t: float, exposure: float, seed: int) -> Callable[[], Image]:
            first = world.body.T_store_robot(t + 0.5 * exposure)
            last = world.body.T_store_robot(t + readout + 0.5 * exposure)
            return partial(renderer.render, first, last, t, exposure, seed)

        return prepare


class SimCameraSource:
    """A running camera: exposes at its own rate and phase whether or not anybody reads; see CameraSource.

    A frame's stamp is the start of the exposure of its first row on the camera's own clock, which is off by a
    constant and jitters. Some frames never arrive: the gap in `sequence` shows it.

    Attributes
    ----------
    mode : CameraMode
        The camera's own size; exposure and rate within what it can do.
    """

    def __init__(self, device: str, name: str, mode: CameraMode, size: tuple[int, int]) -> None:
        fps = min(max(mode.fps, 1.0), FASTEST)
        exposure = min(max(mode.exposure, SHORTEST), LONGEST, 1.0 / fps)
        self.mode = replace(mode, size=size, fps=fps, exposure=exposure)
        self.remarks: tuple[str, ...] = ()
        self.counts = CameraCounts()
        self._device = device
        self._name = name
        self._waiting: deque[tuple[float, int, Future[Image]]] = deque()
        self._arrived = asyncio.Event()
        self._gone: str | None = None

    def start(
        self,
        world: World,
        *,
        readout: float,
        offset: float,
        rng: np.random.Generator,
        submit: Callable[[float, float, int], Future[Image]],
        release: Callable[[], None],
        tap: Tap | None,
    ) -> None:
        """Begin to expose; called once, by who opened the camera."""
        self._settings = world.settings
        self._readout, self._offset, self._rng = readout, offset, rng
        self._submit, self._release, self._tap = submit, release, tap
        self._loop = asyncio.get_running_loop()
        self._begin = self._loop.time() + rng.uniform(0.0, 1.0 / self.mode.fps)
        self._count = 0
        self._last_delivery = 0.0
        self._timer = self._loop.call_at(self._begin + self._span, self._exposed)

    @property
    def _span(self) -> float:
        """From the first light on the first row to the last light on the last, in seconds."""
        return self.mode.exposure + self._readout

    async def read(self) -> Frame:
        """Wait for the next frame; when nobody reads, the oldest waiting ones are dropped."""
        while True:
            while not self._waiting:
                self._check()
                self._arrived.clear()
                await self._arrived.wait()
            self._check()
            stamp, sequence, rendering = self._waiting.popleft()
            if not rendering.done():
                with outside():
                    await asyncio.wrap_future(rendering)
            frame = Frame(self._name, stamp, rendering.result(), sequence)
            if self._tap is not None:
                self._tap.frame(frame, now())
            return frame

    def close(self) -> None:
        """Stop streaming and release the device; safe to call twice."""
        self._end("closed")

    def unplug(self) -> None:
        """The camera is pulled out: nothing arrives any more, and reading says so."""
        self._end("unplugged; plug the camera in again")

    def _exposed(self) -> None:
        """All rows of a frame have been exposed: draw its fate, have it rendered, and set the next timer."""
        settings, rng = self._settings, self._rng
        t = self._begin + self._count / self.mode.fps
        arrives = rng.random() >= settings.drop
        stamp = t + self._offset + settings.stamp_jitter * rng.standard_normal()
        delivery = t + rng.uniform(settings.delay_min, settings.delay_max)
        seed = int(rng.integers(2**63))
        if arrives:
            rendering = self._submit(t, self.mode.exposure, seed)
            # a microsecond apart, because timers of equal time fire in any order, and frames keep theirs
            self._last_delivery = max(delivery, self._last_delivery + 1e-6, self._loop.time())
            self._loop.call_at(self._last_delivery, self._deliver, stamp, self._count, rendering)
        else:
            self.counts.lost += 1
        self._count += 1
        self._timer = self._loop.call_at(self._begin + self._count / self.mode.fps + self._span, self._exposed)

    def _deliver(self, stamp: float, sequence: int, rendering: Future[Image]) -> None:
        if self._gone is not None:
            return
        if len(self._waiting) >= BUFFERS:
            self._waiting.popleft()
            self.counts.dropped += 1
        self._waiting.append((stamp, sequence, rendering))
        self._arrived.set()

    def _end(self, reason: str) -> None:
        if self._gone is None:
            self._gone = reason
            self._timer.cancel()
            self._waiting.clear()
            self._arrived.set()
            self._release()

    def _check(self) -> None:
        if self._gone is not None:
            raise DriverFault(f"{self._device} is {self._gone}")


class _TappedLink:
    """A serial link that shows a tap every byte in both directions."""

    def __init__(self, link: RoombaLink, port: str, tap: Tap) -> None:
        self._link = link
        self._port = port
        self._tap = tap
        self.set_baud = link.set_baud
        self.pulse_wake = link.pulse_wake
        self.rest = link.rest
        self.close = link.close

    async def read(self) -> tuple[float, bytes]:
        t, data = await self._link.read()
        self._tap.serial(self._port, t, data, to_robot=False)
        return t, data

    def write(self, data: bytes) -> None:
        self._link.write(data)
        self._tap.serial(self._port, now(), data, to_robot=True)
