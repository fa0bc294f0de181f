"""What every camera driver does: opens, streams while started, cancels, closes, frees, opens again."""

import asyncio
import gc
import threading
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotd.bus import Bus
from robotd.camera_driver import CameraDriver
from robotd.camera_feed import CameraCounters
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.errors import DriverFault
from robotd.hardware import CameraMode
from robotd.plugin import Camera, available
from robotd.recording import FrameRecorder
from robotd.records import Frame
from robotd.sim.hardware import SimHardware
from robotd.sim.mjpeg_server import MjpegServer, NetworkCameraSettings
from robotd.sim.settings import WorldSettings
from robotd.sim.stores import find_store, load_store
from robotd.sim.world import World


@dataclass
class Rig:
    """A driver's class, the configuration of one instance, and the world under it."""

    config: Any
    hardware: Any
    mode: CameraMode
    broken: Any  # the configuration of one whose device is missing


@asynccontextmanager
async def rig(name, tmp_path):
    cls = available()[name].load()
    small = CameraMode(size=(64, 48))
    async with AsyncExitStack() as stack:
        if name == "v4l2":
            world = World(load_store(find_store("room")), WorldSettings(), 1, tmp_path / "labels")
            hardware = SimHardware(world)
            device = "/dev/robotd/floor"
            yield cls, Rig(cls.Config(device), hardware, CameraMode((320, 240)), cls.Config("/dev/video9"))
        elif name == "mjpeg":
            server = MjpegServer(lambda t: np.full((48, 64), 90, np.uint8), NetworkCameraSettings())
            url = await server.start()
            stack.push_async_callback(server.close)
            yield cls, Rig(cls.Config(url), None, small, cls.Config("http://127.0.0.1:9/"))
        else:
            with FrameRecorder(tmp_path / "x.mcap") as recorder:
                for k in range(50):
                    recorder.frame(Frame("a", k / 25, np.full((48, 64), k, np.uint8), k), k / 25)
            yield cls, Rig(cls.Config(tmp_path / "x.mcap", loop=True), None, small, cls.Config(tmp_path / "none.mcap"))


def cameras():
    names = [name for name, point in available().items() if point.load().kind == "camera"]
    assert {"v4l2", "mjpeg", "replay"} <= set(names)
    return sorted(names)


@asynccontextmanager
async def running(driver):
    try:
        await driver.open()
        task = asyncio.create_task(driver.run())
        try:
            yield task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    finally:
        await driver.close()


@pytest.mark.parametrize("name", cameras())
def test_a_camera_opens_streams_stops_cancels_closes_and_opens_again(name, tmp_path):
    async def main():
        async with rig(name, tmp_path) as (cls, parts):
            before = set(asyncio.all_tasks())
            driver = cls("eye", parts.config, parts.hardware, Bus(), Calibration())
            assert isinstance(driver, Camera)
            assert isinstance(driver, CameraDriver)
            assert driver.counters == CameraCounters()
            with driver.bus.frames("eye").subscribe(size=1000) as frames:
                for turn in range(2):
                    async with running(driver) as task:
                        await asyncio.sleep(1.0)
                        assert (frames.waiting > 20) == (turn > 0), "nothing before start, and at once if opened again"
                        await driver.stop()
                        await asyncio.sleep(1.0)
                        while frames.waiting:
                            frames.take()
                        await driver.start(parts.mode)
                        await asyncio.sleep(2.0)
                        got = [frames.take() for _ in range(frames.waiting)]
                        assert 40 <= len(got) <= 62
                        assert driver.counters.rate == pytest.approx(len(got) / 2, rel=0.2)
                        assert all(frame.camera == "eye" for frame in got)
                        assert all(frame.image.shape == parts.mode.size[::-1] for frame in got)
                        assert all(frame.image.dtype == np.uint8 and not frame.image.flags.writeable for frame in got)
                        assert np.all(np.diff([frame.t for frame in got]) > 0)
                        assert np.all(np.diff([frame.sequence for frame in got]) > 0)
                        assert all(frame.t <= now() for frame in got)
                        await driver.stop()
                        await asyncio.sleep(0.5)
                        frames.take() if frames.waiting else None
                        await asyncio.sleep(1.0)
                        assert frames.waiting == 0, "nothing after stop"
                        await driver.start(parts.mode)
                        await asyncio.sleep(0.5)
                        assert frames.waiting > 5
                        assert not task.done()
                    await driver.close()
                    while frames.waiting:
                        frames.take()
            assert driver.counters.streams >= 4
            await asyncio.sleep(1.0)
            assert {task for task in asyncio.all_tasks() if "driver" in repr(task.get_coro())} <= before

    threads = set(threading.enumerate())
    run_virtual(main())
    gc.collect()  # what was left open warns, and warnings are errors
    for thread in set(threading.enumerate()) - threads:
        thread.join(5.0)
        assert not thread.is_alive(), "no thread outlives its driver"


@pytest.mark.parametrize("name", cameras())
def test_a_device_that_is_missing_is_a_fault_at_open_and_closing_is_safe(name, tmp_path):
    async def main():
        async with rig(name, tmp_path) as (cls, parts):
            driver = cls("eye", parts.broken, parts.hardware, Bus(), Calibration())
            for _ in range(2):
                with pytest.raises(DriverFault):
                    await driver.open()
                await driver.close()
                await driver.close()

    run_virtual(main())


@pytest.mark.parametrize("name", cameras())
def test_another_size_than_the_calibrated_one_is_a_fault(name, tmp_path):
    async def main():
        async with rig(name, tmp_path) as (cls, parts):
            driver = cls("eye", parts.config, parts.hardware, Bus(), Calibration())
            async with running(driver) as task:
                await driver.start(CameraMode((333, 222)))
                with pytest.raises(DriverFault, match="pixels"):
                    await task

    run_virtual(main())


@pytest.mark.parametrize("name", cameras())
def test_every_key_of_a_camera_is_in_the_example(name):
    text = (Path(__file__).parent.parent / "etc" / "robotd.toml").read_text()
    section = text[text.index(f'driver = "{name}"') :]
    following = [line.lstrip("# ").split(" = ")[0] for line in section.splitlines()[1:16]]
    assert {field.name for field in fields(available()[name].load().Config)} <= set(following)
