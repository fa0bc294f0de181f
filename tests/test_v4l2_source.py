"""Video4Linux on recorded cameras: what is asked of them, what they refuse, and the frames that come."""

import asyncio
import ctypes
import errno
import shutil
import subprocess
from contextlib import asynccontextmanager

import cv2
import numpy as np
import pytest
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

from robotd import v4l2, v4l2_api as api
from robotd.bus import Bus
from robotd.config import Calibration
from robotd.errors import DriverFault
from robotd.hardware import CameraMode
from robotd.real import RealHardware
from tests.video_node import FakeCamera, FakeNode, fault

SMALL = CameraMode(size=(32, 24), fps=20.0)


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


DEVICE = "/dev/v4l/by-path/usb-0:1.2-video-index0"


@pytest.fixture
def camera(monkeypatch):
    """A webcam, in place of the node DEVICE."""
    camera = FakeCamera()

    def node(path):
        if path != DEVICE:
            raise fault(errno.ENOENT)
        if camera.failure is not None:
            raise fault(errno.ENOENT)
        return FakeNode(camera)

    monkeypatch.setattr(v4l2, "VideoNode", node)
    yield camera
    camera.unplug()
    camera.released.wait(5)


def jpeg(value, size=(32, 24)):
    return cv2.imencode(".jpg", np.full(size[::-1], value, np.uint8))[1].tobytes()


def on_camera(steps, mode=None):
    """Run `steps(source)` on the opened camera; returns what it returns."""

    async def main():
        source = await RealHardware().open_camera(DEVICE, "front", mode or CameraMode())
        try:
            return await steps(source)
        finally:
            source.close()
            await asyncio.to_thread(source.wait_released, 5)

    return asyncio.run(main())


async def look(source):
    return source


def small(camera, pixels="MJPG"):
    camera.formats = {pixels: {(32, 24): [20.0]}}
    return SMALL


def test_jpeg_is_taken_at_the_size_and_rate_asked_for_and_everything_is_locked(camera):
    source = on_camera(look)
    assert source.mode == CameraMode((640, 480), 30.0, 0.010, gain=64)
    assert source.remarks == ()
    assert (camera.pixels, camera.size, camera.rate) == ("MJPG", (640, 480), 30.0)
    assert camera.value(api.EXPOSURE_AUTO) == api.EXPOSURE_MANUAL
    assert camera.value(api.EXPOSURE_ABSOLUTE) == 100
    assert camera.value(api.GAIN) == 64, "its default, not what the last program left"
    assert camera.value(api.EXPOSURE_AUTO_PRIORITY) == camera.value(api.AUTO_WHITE_BALANCE) == 0
    assert (camera.opened, camera.closed, camera.streaming) == (1, 1, False)


def test_exposure_and_gain_follow_the_mode(camera):
    source = on_camera(look, CameraMode(exposure=0.020, gain=10))
    assert (camera.value(api.EXPOSURE_ABSOLUTE), camera.value(api.GAIN)) == (200, 10)
    assert (source.mode.exposure, source.mode.gain) == (pytest.approx(0.020), 10)


@pytest.mark.parametrize(
    ("control", "remark"),
    [
        (api.EXPOSURE_AUTO, "does not turn off its automatic exposure; use a camera that can be locked"),
        (api.EXPOSURE_AUTO_PRIORITY, "does not turn off its automatic frame rate; use a camera that can be locked"),
        (api.GAIN, "has a gain of 200 instead of 64; it offers 0 to 255"),
        (api.EXPOSURE_ABSOLUTE, "exposes for 33.3 ms instead of 10 ms; it offers 0.1 to 500 ms"),
    ],
)
def test_a_control_that_does_not_obey_is_named(camera, control, remark):
    camera.stuck.add(control)
    source = on_camera(look)
    assert source.remarks[0] == remark
    if control == api.EXPOSURE_ABSOLUTE:
        assert "lamps on 50 Hz mains flicker" in source.remarks[1]
        assert source.mode.exposure == pytest.approx(0.0333)


def test_a_camera_without_manual_exposure_is_named(camera):
    del camera.controls[api.EXPOSURE_ABSOLUTE], camera.controls[api.EXPOSURE_AUTO], camera.controls[api.GAIN]
    assert on_camera(look).remarks == (
        "has no manual exposure; flashes and lamps cannot be told apart well, use another camera",
    )
    assert on_camera(look, CameraMode(gain=3.0)).remarks[1] == "has no gain that can be set"


def test_an_exposure_goes_to_the_nearest_step(camera):
    camera.controls[api.EXPOSURE_ABSOLUTE] = [8, 2000, 8, 200, 200]
    assert on_camera(look).mode.exposure == pytest.approx(0.0104)
    assert camera.value(api.EXPOSURE_ABSOLUTE) == 104


def test_another_rate_is_remarked_with_those_that_the_camera_offers(camera):
    source = on_camera(look, CameraMode(fps=20.0))
    assert source.mode.fps == 25.0
    text = "gives 25 frames a second instead of 20 at 640x480 MJPG; it offers 30, 25, 15, 5"
    assert source.remarks == (text,)


def test_a_camera_that_does_not_say_its_rate_is_believed_to_obey(camera):
    camera.says_rate = False
    source = on_camera(look)
    assert source.mode.fps == 30.0
    assert source.remarks == ("does not say how many frames a second it gives; 30 were asked for",)


def test_a_full_usb_bus_lowers_the_rate_to_fifteen_and_says_so(camera):
    camera.room = 640 * 480 * 16
    source = on_camera(look)
    assert source.mode.fps == 15.0
    assert "gives 15 frames a second instead of 30, because its USB bus has no room for more" in source.remarks[-1]
    assert "put it on another USB controller, or set fps" in source.remarks[-1]


def test_a_usb_bus_without_any_room_is_a_fault_with_its_mend(camera):
    camera.room = 10
    with pytest.raises(
        DriverFault, match=r"no room \(no space left on device\): .* 30 frames a second, .*; set fps = 15"
    ):
        on_camera(look)
    assert camera.opened == camera.closed == 1


def test_twice_the_size_is_decoded_to_half(camera):
    camera.formats = {"MJPG": {(64, 48): [20.0]}}

    async def steps(source):
        camera.send(jpeg(90, (64, 48)), asyncio.get_running_loop().time())
        return source.mode, await source.read()

    mode, frame = on_camera(steps, SMALL)
    assert mode.size == (32, 24)
    assert frame.image.shape == (24, 32)
    assert abs(float(frame.image.mean()) - 90) < 2


def test_a_size_that_the_camera_cannot_give_is_a_fault_that_lists_its_sizes(camera):
    text = "cannot give 333x222 pixels, which it was calibrated for; it offers 320x240, 640x480, 1280x960"
    with pytest.raises(DriverFault, match=text):
        on_camera(look, CameraMode((333, 222)))
    assert camera.opened == camera.closed == 1


def test_a_camera_without_a_format_for_us_is_a_fault_that_lists_its_formats(camera):
    camera.formats = {"pRAA": {(640, 480): [30.0]}, "BA81": {(640, 480): [30.0]}}
    with pytest.raises(DriverFault, match="gives pRAA, BA81; expected one of MJPG, GREY, YUYV, NV12"):
        on_camera(look)


@pytest.mark.parametrize(("pixels", "padding"), [("GREY", 0), ("GREY", 16), ("YUYV", 0), ("YUYV", 8), ("NV12", 0)])
def test_raw_images_give_their_brightness(camera, pixels, padding):
    mode = small(camera, pixels)
    camera.padding = padding
    grey = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)
    lines = np.dstack([grey, np.full_like(grey, 200)]).reshape(24, 64) if pixels == "YUYV" else grey
    data = np.pad(lines, ((0, 12 if pixels == "NV12" else 0), (0, padding))).tobytes()

    async def steps(source):
        camera.send(data[:100], 0.0)  # cut off
        camera.send(data, 0.0)
        return await source.read(), source.counts.damaged

    frame, damaged = on_camera(steps, mode)
    assert np.array_equal(frame.image, grey)
    assert frame.encoded is None
    assert damaged == 1


@pytest.mark.parametrize("factor", [1, 2])
def test_a_frame_keeps_the_jpeg_as_the_camera_sent_it(camera, factor):
    size = (32 * factor, 24 * factor)
    camera.formats = {"MJPG": {size: [20.0]}}
    data = [jpeg(90 + k, size) for k in range(3)]

    async def steps(source):
        for item in data:
            camera.send(item, 0.0)
        return [await source.read() for _ in data]

    frames = on_camera(steps, SMALL)
    assert [frame.encoded for frame in frames] == data
    assert [frame.image.shape for frame in frames] == [(24, 32)] * 3


def test_frames_carry_the_kernels_time_and_count(camera):
    mode = small(camera)

    async def steps(source):
        stamp = asyncio.get_running_loop().time()
        for k, skip in enumerate([0, 0, 2, 0]):
            camera.send(jpeg(10 * k), stamp + 0.01 * k, skip=skip)
        return stamp, [await source.read() for _ in range(4)], source.counts

    stamp, frames, counts = on_camera(steps, mode)
    assert [frame.t for frame in frames] == pytest.approx([stamp, stamp + 0.01, stamp + 0.02, stamp + 0.03], abs=2e-6)
    assert [frame.sequence for frame in frames] == [0, 1, 4, 5]
    assert (counts.lost, counts.decoded, counts.damaged) == (2, 4, 0)
    assert counts.decode_s > 0.0
    assert all(not frame.image.flags.writeable for frame in frames)


@pytest.mark.parametrize("flags", [0, api.CLOCK_MONOTONIC])
def test_a_stamp_that_is_not_on_the_monotonic_clock_is_replaced_by_the_arrival(camera, flags):
    mode = small(camera)

    async def steps(source):
        before = asyncio.get_running_loop().time()
        camera.send(jpeg(1), 1.7e9 if flags else before + 0.001, flags=flags)
        frame = await source.read()
        assert before <= frame.t <= asyncio.get_running_loop().time()

    on_camera(steps, mode)


def test_a_damaged_frame_leaves_a_gap_in_the_sequence(camera):
    mode = small(camera)

    async def steps(source):
        whole = jpeg(1)
        camera.send(whole, 0.0)
        for data in (b"", bytes(40), whole[:-50], jpeg(1, (10, 10))):
            camera.send(data, 0.0)
        camera.send(whole, 0.0, flags=api.ERROR)
        camera.send(whole, 0.0)
        return [(await source.read()).sequence for _ in range(2)], source.counts.damaged

    assert on_camera(steps, mode) == ([0, 6], 5)


def test_a_slow_reader_gets_the_newest_four_frames(camera):
    mode = small(camera)

    async def steps(source):
        for k in range(10):
            camera.send(jpeg(k), 0.0)
        while source.counts.decoded < 10:
            await asyncio.sleep(0.001)
        await asyncio.sleep(0)
        camera.unplug()
        await asyncio.to_thread(source.wait_released, 5)
        await asyncio.sleep(0)
        assert [(await source.read()).sequence for _ in range(4)] == [6, 7, 8, 9]
        assert source.counts.dropped == 6
        with pytest.raises(DriverFault, match="is unplugged; plug it in again"):
            await source.read()

    on_camera(steps, mode)


def test_a_silent_camera_is_a_fault(camera, monkeypatch):
    monkeypatch.setattr(v4l2, "STALL_S", 0.02)

    async def steps(source):
        with pytest.raises(DriverFault, match=r"has sent no frame for 0\.02 s"):
            await source.read()

    on_camera(steps)


def test_a_camera_can_be_opened_again_only_after_it_was_closed(camera):
    async def main():
        hardware = RealHardware()
        source = await hardware.open_camera(DEVICE, "front", CameraMode())
        with pytest.raises(DriverFault, match="is open already, as camera front"):
            await hardware.open_camera(DEVICE, "left", CameraMode())
        source.close()
        source.close()
        again = await hardware.open_camera(DEVICE, "front", CameraMode())
        assert (camera.opened, camera.closed) == (2, 1)
        with pytest.raises(DriverFault, match="is closed"):
            await source.read()
        again.close()
        await asyncio.to_thread(again.wait_released, 5)

    asyncio.run(main())


def test_a_replugged_camera_streams_again_under_the_same_name(camera):
    mode = small(camera)

    async def main():
        hardware = RealHardware()
        driver = V4l2Driver("front", V4l2Config(DEVICE), hardware, Bus(), Calibration())
        await driver.start(mode)

        async def streaming(count):
            while driver.counters.streams < count:
                await asyncio.sleep(0.001)

        with driver.bus.frames("front").subscribe() as frames:
            async with running(driver) as task:
                await streaming(1)
                camera.send(jpeg(1), 0.0)
                await frames.get()
                camera.unplug()
                with pytest.raises(DriverFault, match="is unplugged"):
                    await task
            with pytest.raises(DriverFault, match=r"no camera .*usb-0:1\.2-video-index0; plug it in"):
                await driver.open()
            camera.failure = None
            async with running(driver):
                await streaming(2)
                camera.send(jpeg(2), 0.0)
                await frames.get()
        assert driver.counters.streams == 2
        assert driver.counters.published == 2
        await asyncio.to_thread(camera.released.wait, 5)

    asyncio.run(main())


def test_what_is_wrong_with_a_device_is_said_with_its_mend(camera, tmp_path, monkeypatch):
    async def fails(device, match):
        with pytest.raises(DriverFault, match=match):
            await RealHardware().open_camera(device, "front", CameraMode())

    async def main():
        await fails("/dev/none", r"no camera /dev/none; plug it in, or name another one: found ")
        camera.capabilities = 0
        await fails(DEVICE, "is not the image node of a camera")
        monkeypatch.setattr(v4l2, "VideoNode", api.VideoNode)
        await fails(str(tmp_path), "cannot be opened: Is a directory")
        (tmp_path / "file").touch()
        await fails(str(tmp_path / "file"), "is not the image node of a camera")
        camera.released.set()

    asyncio.run(main())


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_records_are_those_of_the_kernels_header(tmp_path):
    records = {
        "capability": api.Capability,
        "fmtdesc": api.FormatDescription,
        "format": api.Format,
        "frmsizeenum": api.FrameSize,
        "frmivalenum": api.FrameInterval,
        "streamparm": api.StreamParameters,
        "requestbuffers": api.RequestBuffers,
        "buffer": api.Buffer,
        "queryctrl": api.QueryControl,
        "control": api.Control,
    }
    offsets = {
        "buffer, timestamp": api.Buffer.seconds,
        "buffer, sequence": api.Buffer.sequence,
        "buffer, m": api.Buffer.offset,
        "buffer, length": api.Buffer.length,
        "format, fmt.pix.pixelformat": api.Format.pixelformat,
        "format, fmt.pix.sizeimage": api.Format.sizeimage,
        "streamparm, parm.capture.timeperframe": api.StreamParameters.numerator,
        "queryctrl, flags": api.QueryControl.flags,
        "frmivalenum, discrete": api.FrameInterval.values,
    }
    requests = "QUERYCAP ENUM_FMT S_FMT REQBUFS QUERYBUF QBUF DQBUF STREAMON STREAMOFF G_PARM S_PARM G_CTRL S_CTRL"
    requests = [*requests.split(), "QUERYCTRL", "ENUM_FRAMESIZES", "ENUM_FRAMEINTERVALS"]
    constants = {
        "CAP_VIDEO_CAPTURE": api.CAN_CAPTURE,
        "CAP_STREAMING": api.CAN_STREAM,
        "CAP_DEVICE_CAPS": api.HAS_DEVICE_CAPS,
        "CAP_TIMEPERFRAME": api.HAS_RATE,
        "BUF_FLAG_ERROR": api.ERROR,
        "BUF_FLAG_TIMESTAMP_MASK": api.CLOCK_MASK,
        "BUF_FLAG_TIMESTAMP_MONOTONIC": api.CLOCK_MONOTONIC,
        "CTRL_FLAG_DISABLED": api.DISABLED,
        "CTRL_FLAG_READ_ONLY": api.READ_ONLY,
        "CID_AUTO_WHITE_BALANCE": api.AUTO_WHITE_BALANCE,
        "CID_AUTOGAIN": api.AUTO_GAIN,
        "CID_GAIN": api.GAIN,
        "CID_BACKLIGHT_COMPENSATION": api.BACKLIGHT_COMPENSATION,
        "CID_EXPOSURE_AUTO": api.EXPOSURE_AUTO,
        "CID_EXPOSURE_ABSOLUTE": api.EXPOSURE_ABSOLUTE,
        "CID_EXPOSURE_AUTO_PRIORITY": api.EXPOSURE_AUTO_PRIORITY,
        "CID_FOCUS_AUTO": api.FOCUS_AUTO,
        "EXPOSURE_MANUAL": api.EXPOSURE_MANUAL,
        "PIX_FMT_MJPEG": api.fourcc("MJPG"),
        "PIX_FMT_YUV420": api.fourcc("YU12"),
    }
    lines = [
        f'_Static_assert(sizeof(struct v4l2_{name}) == {ctypes.sizeof(cls)}, "");' for name, cls in records.items()
    ]
    lines += [f'_Static_assert(offsetof(struct v4l2_{at}) == {field.offset}, "");' for at, field in offsets.items()]
    lines += [f'_Static_assert(VIDIOC_{name} == {getattr(api, name)}ul, "");' for name in requests]
    lines += [f'_Static_assert(V4L2_{name} == {value}ul, "");' for name, value in constants.items()]
    source = "#include <stddef.h>\n#include <linux/videodev2.h>\n" + "\n".join(lines)
    (tmp_path / "layout.c").write_text(source)
    if subprocess.run(
        ["cc", "-E", "-x", "c", "-", "-o", "/dev/null"],
        input=b"#include <linux/videodev2.h>\n",
        check=False,
        capture_output=True,
    ).returncode:
        pytest.skip("needs the kernel's headers")
    done = subprocess.run(["cc", "-c", "layout.c"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_real_date_knows_its_zone():
    assert RealHardware().utc().utcoffset().total_seconds() == 0
