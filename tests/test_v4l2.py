"""The camera driver on any hardware, and the source that reads Video4Linux on the real one."""

import asyncio
import queue
import threading
from contextlib import asynccontextmanager

import cv2
import numpy as np
import pytest
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

import robotd.real
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault
from robotd.hardware import CameraMode
from robotd.plugin import Camera
from robotd.real import RealHardware
from robotd.records import Frame

SMALL = CameraMode(size=(32, 24), fps=20.0)


# ---- the driver, in virtual time -------------------------------------------------------------------------------------


class FakeSource:
    def __init__(self, name, mode, faults):
        self.name, self.mode, self.faults = name, mode, faults
        self.closed = False
        self.sequence = 0

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


# ---- RealHardware on a capture that plays back -----------------------------------------------------------------------


class FakeCapture:
    """Stands in for cv2.VideoCapture: remembers what is set, plays what the test puts into `script`."""

    opens = True
    size = None  # what is negotiated, if not what is asked for
    made = ()

    def __init__(self, device, backend):
        assert backend == cv2.CAP_V4L2
        self.device = device
        self.settings = []
        self.script = queue.Queue()
        self.released = threading.Event()
        self.raw, self.stamp = None, 0.0
        type(self).made = (*type(self).made, self)

    def isOpened(self):
        return self.opens

    def set(self, name, value):
        self.settings.append((name, value))
        return True

    def get(self, name):
        if name == cv2.CAP_PROP_POS_MSEC:
            return 1e3 * self.stamp
        if self.size and name in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            return self.size[name == cv2.CAP_PROP_FRAME_HEIGHT]
        return dict(self.settings).get(name, 0.0)

    def grab(self):
        item = self.script.get(timeout=10)
        if item is None:
            return False
        self.raw, self.stamp = item
        return True

    def retrieve(self):
        return self.raw is not None, self.raw

    def release(self):
        self.released.set()


@pytest.fixture
def captures(monkeypatch, tmp_path):
    """A class of captures, and a file that plays the device."""

    class Capture(FakeCapture):
        device_path = str(tmp_path / "video0")

    (tmp_path / "video0").touch()
    monkeypatch.setattr(robotd.real.cv2, "VideoCapture", Capture)
    yield Capture
    for capture in Capture.made:
        capture.script.put(None)


def jpeg(value, shape=(24, 32)):
    return cv2.imencode(".jpg", np.full(shape, value, np.uint8))[1].reshape(1, -1)


def test_the_camera_is_set_to_mjpeg_grey_and_manual_exposure_in_its_own_units(captures):
    async def main():
        source = await RealHardware().open_camera(captures.device_path, "front", CameraMode((32, 24), 30.0, 0.010))
        assert source.mode == CameraMode((32, 24), 30.0, 0.010)
        source.close()

    asyncio.run(main())
    settings = dict(captures.made[0].settings)
    assert settings[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")
    assert settings[cv2.CAP_PROP_CONVERT_RGB] == 0
    assert settings[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert settings[cv2.CAP_PROP_EXPOSURE] == 100
    assert settings[cv2.CAP_PROP_GAIN] == 0.0


def test_frames_are_decoded_to_grey_and_carry_the_kernels_time(captures):
    async def main():
        stamp = asyncio.get_running_loop().time()
        source = await RealHardware().open_camera(captures.device_path, "front", SMALL)
        script = captures.made[0].script
        yuyv = np.dstack([np.full((24, 32), 90, np.uint8), np.full((24, 32), 200, np.uint8)])
        for k, raw in enumerate([jpeg(50), yuyv, np.full((24, 32), 70, np.uint8), np.full((24, 32, 3), 60, np.uint8)]):
            script.put((raw, stamp + 0.01 * k))
        frames = [await source.read() for _ in range(4)]
        source.close()
        return stamp, frames

    stamp, frames = asyncio.run(main())
    assert [round(float(frame.image.mean())) for frame in frames] == [50, 90, 70, 60]
    assert [frame.t for frame in frames] == pytest.approx([stamp, stamp + 0.01, stamp + 0.02, stamp + 0.03], abs=1e-6)
    assert [frame.sequence for frame in frames] == [0, 1, 2, 3]
    assert all(frame.image.shape == (24, 32) and not frame.image.flags.writeable for frame in frames)


def test_a_stamp_that_is_not_on_the_monotonic_clock_is_replaced_by_the_arrival(captures):
    async def main():
        before = asyncio.get_running_loop().time()
        source = await RealHardware().open_camera(captures.device_path, "front", SMALL)
        captures.made[0].script.put((jpeg(1), 1.7e9))
        frame = await source.read()
        source.close()
        assert before <= frame.t <= asyncio.get_running_loop().time()

    asyncio.run(main())


def test_a_damaged_frame_leaves_a_gap_in_the_sequence(captures):
    async def main():
        source = await RealHardware().open_camera(captures.device_path, "front", SMALL)
        for raw in (jpeg(1), np.zeros((1, 40), np.uint8), None, jpeg(1, (10, 10)), jpeg(2)):
            captures.made[0].script.put((raw, 0.0))
        assert [(await source.read()).sequence for _ in range(2)] == [0, 4]
        source.close()

    asyncio.run(main())


def test_a_slow_reader_gets_the_newest_four_frames(captures):
    async def main():
        source = await RealHardware().open_camera(captures.device_path, "front", SMALL)
        for k in range(10):
            captures.made[0].script.put((jpeg(k), 0.0))
        captures.made[0].script.put(None)
        await asyncio.to_thread(captures.made[0].released.wait, 5)
        await asyncio.sleep(0)
        assert [(await source.read()).sequence for _ in range(4)] == [6, 7, 8, 9]
        with pytest.raises(DriverFault, match="sends no frames any more"):
            await source.read()

    asyncio.run(main())


def test_a_silent_camera_is_a_fault(captures, monkeypatch):
    monkeypatch.setattr(robotd.real, "STALL_S", 0.02)

    async def main():
        source = await RealHardware().open_camera(captures.device_path, "front", SMALL)
        with pytest.raises(DriverFault, match=r"has sent no frame for 0\.02 s"):
            await source.read()
        source.close()

    asyncio.run(main())


def test_a_camera_can_be_opened_again_only_after_it_was_closed(captures):
    async def main():
        hardware = RealHardware()
        source = await hardware.open_camera(captures.device_path, "front", SMALL)
        with pytest.raises(DriverFault, match="is open already, as camera front"):
            await hardware.open_camera(captures.device_path, "left", SMALL)
        source.close()
        source.close()
        captures.made[0].script.put((jpeg(1), 0.0))
        again = await hardware.open_camera(captures.device_path, "front", SMALL)
        assert captures.made[0].released.is_set()
        with pytest.raises(DriverFault, match="is closed"):
            await source.read()
        again.close()

    asyncio.run(main())


def test_what_is_wrong_with_a_device_is_said_with_its_mend(captures, tmp_path):
    async def main():
        hardware = RealHardware()
        with pytest.raises(DriverFault, match=r"no camera .*none; plug it in, or name another one: found "):
            await hardware.open_camera(str(tmp_path / "none"), "front", SMALL)
        with pytest.raises(DriverFault, match="cannot be opened: Is a directory"):
            await hardware.open_camera(str(tmp_path), "front", SMALL)
        captures.opens = False
        with pytest.raises(DriverFault, match="does not open as a camera"):
            await hardware.open_camera(captures.device_path, "front", SMALL)
        assert captures.made[-1].released.is_set()

    asyncio.run(main())


def test_the_negotiated_mode_is_what_the_camera_says(captures):
    captures.size = (64, 48)

    async def main():
        source = await RealHardware().open_camera(captures.device_path, "front", SMALL)
        assert source.mode.size == (64, 48)
        source.close()

    asyncio.run(main())


def test_the_real_date_knows_its_zone():
    assert RealHardware().utc().utcoffset().total_seconds() == 0
    assert RealHardware().pins is None
