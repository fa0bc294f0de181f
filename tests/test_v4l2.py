"""The driver of cameras on this computer, on any hardware, in virtual time."""

import asyncio
from contextlib import asynccontextmanager

import numpy as np
import pytest
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault
from robotd.hardware import CameraCounts, CameraMode
from robotd.plugin import Camera
from robotd.records import Frame

SMALL = CameraMode(size=(32, 24), fps=20.0)


class FakeSource:
    def __init__(self, name, mode, faults):
        self.name, self.mode, self.faults = name, mode, faults
        self.closed = False
        self.sequence = 0
        self.remarks, self.counts = (), CameraCounts()

    async def read(self):
        await asyncio.sleep(1 / self.mode.fps)
        if self.faults:
            raise DriverFault(self.faults.pop())
        width, height = self.mode.size
        self.sequence += 1
        return Frame(self.name, now(), np.full((height, width), 7, np.uint8), self.sequence)

    def close(self):
        self.closed = True


class FakeHardware:
    """Keeps every source that it opened; `given` changes the mode that is negotiated."""

    def __init__(self, given=lambda mode: mode):
        self.given = given
        self.opened = []
        self.faults = []
        self.missing = False

    async def open_camera(self, device, name, mode):
        if self.missing:
            raise DriverFault(f"no camera {device}; plug it in")
        assert all(source.closed for source in self.opened), "one stream at a time"
        self.opened.append(FakeSource(name, self.given(mode), self.faults))
        return self.opened[-1]


def a_driver(hardware, **config):
    return V4l2Driver("front", V4l2Config("/dev/video0", **config), hardware, Bus(), Calibration())


@asynccontextmanager
async def running(driver):
    await driver.open()
    task = asyncio.create_task(driver.run())
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await driver.close()


async def count(driver, seconds):
    """How many frames come in so many seconds."""
    with driver.bus.frames("front").subscribe(size=1000) as frames:
        await asyncio.sleep(seconds)
        return len(frames._items)


def test_frames_come_only_while_started_and_the_camera_is_free_otherwise():
    async def main():
        hardware = FakeHardware()
        driver = a_driver(hardware)
        assert isinstance(driver, Camera)
        async with running(driver):
            assert await count(driver, 1.0) == 0
            assert all(source.closed for source in hardware.opened)
            await driver.start(SMALL)
            assert 18 <= await count(driver, 1.0) <= 21
            assert driver.bus.frames("front").latest.camera == "front"
            await driver.stop()
            assert await count(driver, 1.0) == 0
            assert all(source.closed for source in hardware.opened)
            await driver.start(SMALL)
            assert await count(driver, 1.0) > 0
        assert all(source.closed for source in hardware.opened)

    run_virtual(main())


def test_another_mode_restarts_the_stream_and_no_old_frame_follows():
    async def main():
        hardware = FakeHardware()
        driver = a_driver(hardware)
        async with running(driver):
            await driver.start(SMALL)
            await asyncio.sleep(0.12)
            await driver.start(CameraMode(size=(64, 48), fps=20.0))
            with driver.bus.frames("front").subscribe() as frames:
                for _ in range(5):
                    assert (await frames.get()).image.shape == (48, 64)
            streams = len(hardware.opened)
            await driver.start(CameraMode(size=(64, 48), fps=20.0))
            await asyncio.sleep(0.5)
            assert len(hardware.opened) == streams, "the same mode goes on undisturbed"

    run_virtual(main())


def test_a_missing_camera_is_a_fault_at_open():
    async def main():
        hardware = FakeHardware()
        hardware.missing = True
        with pytest.raises(DriverFault, match="no camera /dev/video0"):
            await a_driver(hardware).open()

    run_virtual(main())


def test_a_camera_that_is_pulled_out_is_a_fault_and_streams_again_after_reopening():
    async def main():
        hardware = FakeHardware()
        driver = a_driver(hardware)
        async with running(driver) as task:
            await driver.start(SMALL)
            await asyncio.sleep(0.3)
            hardware.faults.append("/dev/video0 sends no frames any more")
            with pytest.raises(DriverFault, match="no frames any more"):
                await task
        assert all(source.closed for source in hardware.opened)
        async with running(driver):
            assert await count(driver, 1.0) > 0

    run_virtual(main())


def test_another_image_size_than_the_calibrated_one_is_a_fault():
    async def main():
        driver = a_driver(FakeHardware(given=lambda mode: CameraMode(size=(16, 12), fps=mode.fps)))
        async with running(driver) as task:
            await driver.start(SMALL)
            with pytest.raises(DriverFault, match="gives 16x12 pixels instead of 32x24"):
                await task

    run_virtual(main())


def test_another_rate_is_reported_and_the_stream_goes_on():
    async def main():
        driver = a_driver(FakeHardware(given=lambda mode: CameraMode(size=mode.size, fps=10.0)))
        with driver.bus.events.subscribe() as events:
            async with running(driver):
                await driver.start(SMALL)
                assert await count(driver, 1.0) >= 9
            event = await events.get()
        assert (event.level, event.source) == ("warning", "front")
        assert event.text == "/dev/video0 gives 10 frames a second instead of 20"

    run_virtual(main())


def test_the_configured_rate_replaces_the_one_asked_for():
    async def main():
        hardware = FakeHardware()
        driver = a_driver(hardware, fps=5.0)
        async with running(driver):
            await driver.start(SMALL)
            assert 4 <= await count(driver, 1.0) <= 5

    run_virtual(main())


def test_the_section_is_checked():
    assert bind(V4l2Config, {"device": "/dev/video0"}, "x") == V4l2Config("/dev/video0", None)
    with pytest.raises(ConfigError, match="fps: found 0; expected 1 to 1000"):
        bind(V4l2Config, {"device": "/dev/video0", "fps": 0}, "x")
