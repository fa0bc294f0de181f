"""The replay driver and the footage that it plays: recordings, folders, videos, and what is wrong with them."""

import asyncio
from contextlib import asynccontextmanager

import cv2
import numpy as np
import pytest
from robotd.drivers.replay import ReplayConfig, ReplayDriver

from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.errors import DriverFault, InputError
from robotd.footage import open_footage
from robotd.hardware import CameraMode
from robotd.plugin import Camera
from robotd.recording import FrameRecorder
from robotd.records import Frame

MODE = CameraMode(size=(32, 24))


def image(level):
    return np.full((24, 32), level, np.uint8)


def write_recording(path, cameras=("front",), count=10, period=0.1):
    with FrameRecorder(path) as recorder:
        for k in range(count):
            for name in cameras:
                recorder.frame(Frame(name, 500.0 + k * period, image(10 * k), k), 500.0 + k * period)
    return path


def write_folder(path, names):
    path.mkdir()
    for k, name in enumerate(names):
        assert cv2.imwrite(str(path / name), image(10 * k))
    return path


def write_video(path, count=10, fps=20.0, size=(64, 48)):
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    assert writer.isOpened()
    for k in range(count):
        writer.write(np.full((size[1], size[0], 3), (5, 5, 20 * k), np.uint8))
    writer.release()
    return path


def played(path, **options):
    return [(shot.t, round(float(shot.image.mean()))) for shot in open_footage(path, **options).play()]


# ---- footage ---------------------------------------------------------------------------------------------------------


def test_a_recording_gives_one_cameras_frames_with_their_stamps(tmp_path):
    path = write_recording(tmp_path / "x.mcap", ("front", "left"), count=3)
    assert played(path, camera="left") == [(pytest.approx(500.0 + 0.1 * k), 10 * k) for k in range(3)]
    assert open_footage(path, camera="left").count == 3
    with pytest.raises(InputError, match="holds frames of front, left; say which camera"):
        open_footage(path)
    with pytest.raises(InputError, match="no frames of camera 'rear'; it has front, left"):
        open_footage(path, camera="rear")
    with pytest.raises(InputError, match="has its own times; leave fps out"):
        open_footage(path, fps=10.0)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["a_1712345678.25.png", "a_1712345678.50.png"], [1712345678.25, 1712345678.5]),
        (["1712345678250.png", "1712345678500.png"], [1712345678.25, 1712345678.5]),
        (["cam0_1712345678250000.png", "cam0_1712345678500000.png"], [1712345678.25, 1712345678.5]),
        (["t0.5.png", "t1.5.png"], [0.5, 1.5]),
    ],
)
def test_a_folders_times_are_in_its_names(tmp_path, names, times):
    path = write_folder(tmp_path / "images", names)
    assert [t for t, _ in played(path)] == pytest.approx(times, abs=1e-3)


def test_a_rate_orders_a_folder_by_number(tmp_path):
    path = write_folder(tmp_path / "images", ["f1.png", "f2.png", "f10.png"])
    assert played(path, fps=4.0) == [(0.0, 0), (0.25, 10), (0.5, 20)]
    with pytest.raises(InputError, match=r"nothing tells when f1\.png was taken; give fps, a table times\.csv"):
        open_footage(path)


def test_a_table_dates_a_folder_and_its_mistakes_are_named_together(tmp_path):
    path = write_folder(tmp_path / "images", ["b.png", "a.png"])
    (path / "times.csv").write_text("name,seconds\nb.png,1.5\na.png, 2.5\n")
    assert played(path) == [(1.5, 0), (2.5, 10)]
    (tmp_path / "other.csv").write_text("a.png,1\nc.png,2\nb.png,soon\n")
    with pytest.raises(InputError) as caught:
        open_footage(path, times=tmp_path / "other.csv")
    assert [problem.split("other.csv ")[1] for problem in caught.value.problems] == [
        "line 2: there is no image 'c.png' in the folder",
        "line 3: found 'soon'; expected seconds",
    ]
    with pytest.raises(InputError, match=r"none\.csv: cannot be read"):
        open_footage(path, times=tmp_path / "none.csv")


@pytest.mark.parametrize("channel", ["gray", "red"])
def test_a_video_gives_its_channel_and_times(tmp_path, channel):
    path = write_video(tmp_path / "x.avi")
    got = played(path, channel=channel)
    assert [t for t, _ in got] == pytest.approx([k / 20 for k in range(10)], abs=1e-6)
    assert [level for _, level in got] == pytest.approx(
        [20 * k if channel == "red" else 0.299 * 20 * k + 0.701 * 5 for k in range(10)], abs=4
    )
    assert [t for t, _ in played(path, fps=5.0)] == pytest.approx([k / 5 for k in range(10)])


@pytest.mark.parametrize("name", ["x.avi", "x.mcap", "x.txt"])
def test_what_is_missing_empty_or_damaged_is_named(tmp_path, name):
    with pytest.raises(InputError, match="no such file or folder"):
        open_footage(tmp_path / name)
    for content in (b"", b"nonsense" * 100):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=r"not a recording|no recording"):
            open_footage(tmp_path / name)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no images in this folder; expected \.bmp"):
        open_footage(tmp_path / "empty")


def test_a_damaged_or_odd_image_is_named_where_it_is(tmp_path):
    path = write_folder(tmp_path / "images", ["1.png", "2.png", "3.png"])
    (path / "2.png").write_bytes(b"x")
    with pytest.raises(InputError, match=r"2\.png: is not an image, or damaged"):
        played(path, fps=1.0)
    cv2.imwrite(str(path / "2.png"), np.zeros((5, 7), np.uint8))
    with pytest.raises(InputError, match=r"2\.png has 7x5 pixels, those before it 32x24"):
        played(path, fps=1.0)
    (path / "times.csv").write_text("1.png,2\n3.png,2\n")
    with pytest.raises(InputError, match=r"3\.png is dated 2\.000000 s, not after 1\.png"):
        played(path)


# ---- the driver ------------------------------------------------------------------------------------------------------


def a_driver(path, **config):
    return ReplayDriver("front", ReplayConfig(path, **config), None, Bus(), Calibration())


@asynccontextmanager
async def running(driver, mode=MODE):
    try:
        await driver.open()
        if mode is not None:
            await driver.start(mode)
        task = asyncio.create_task(driver.run())
        try:
            yield task
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
    finally:
        await driver.close()


def levels(frames):
    return [round(float(frame.image.mean())) for frame in frames]


def test_frames_come_when_they_are_due_and_the_end_is_told(tmp_path):
    path = write_recording(tmp_path / "x.mcap")

    async def main():
        driver = a_driver(path)
        assert isinstance(driver, Camera)
        with driver.bus.frames("front").subscribe() as frames, driver.bus.events.subscribe() as events:
            await asyncio.sleep(3.0)
            async with running(driver):
                for k in range(10):
                    frame = await frames.get()
                    assert now() == pytest.approx(3.0 + 0.1 * k)
                    assert frame.t == pytest.approx(3.0 + 0.1 * k)
                    assert (frame.sequence, levels([frame])) == (k, [10 * k])
                    assert not frame.image.flags.writeable
                assert (await events.get()).text.endswith("x.mcap: the end")
                await asyncio.sleep(5.0)
                assert frames.waiting == 0

    run_virtual(main())


def test_a_stopped_footage_goes_on_where_it_was_and_opening_begins_anew(tmp_path):
    path = write_recording(tmp_path / "x.mcap")

    async def main():
        driver = a_driver(path)
        with driver.bus.frames("front").subscribe() as frames:
            async with running(driver):
                first = [await frames.get() for _ in range(3)]
                await driver.stop()
                await asyncio.sleep(10.0)
                assert frames.waiting == 0
                await driver.start(MODE)
                begun = now()
                second = [await frames.get() for _ in range(3)]
                assert second[0].t == pytest.approx(begun)
            async with running(driver):
                third = await frames.get()
        assert levels([*first, *second, third]) == [0, 10, 20, 30, 40, 50, 0]

    run_virtual(main())


def test_a_loop_begins_again_one_interval_later(tmp_path):
    path = write_recording(tmp_path / "x.mcap", count=3)

    async def main():
        driver = a_driver(path, loop=True)
        with driver.bus.frames("front").subscribe() as frames:
            async with running(driver):
                got = [await frames.get() for _ in range(8)]
        assert levels(got) == [0, 10, 20, 0, 10, 20, 0, 10]
        assert np.allclose(np.diff([frame.t for frame in got]), 0.1)
        assert [frame.sequence for frame in got] == list(range(8))

    run_virtual(main())


@pytest.mark.parametrize("seconds", [0.0, 0.35])
def test_at_the_consumers_pace_nothing_is_dropped_however_slow_or_fast_it_is(tmp_path, seconds):
    path = write_recording(tmp_path / "x.mcap", count=20)

    async def main():
        driver = a_driver(path, pace="consumer")
        async with running(driver):
            await asyncio.sleep(5.0)  # nobody listens yet: nothing is played
            begun = now()
            with driver.bus.frames("front").subscribe(size=1) as frames:
                got = []
                for _ in range(20):
                    got.append(await frames.get())
                    await asyncio.sleep(seconds)
        assert levels(got) == [10 * k for k in range(20)]
        assert frames.dropped == 0
        assert now() - begun == pytest.approx(20 * seconds)
        assert np.allclose(np.diff([frame.t for frame in got]), 0.1), "stamps stay the footage's"

    run_virtual(main())


def test_what_cannot_be_read_in_time_is_dropped_and_counted(tmp_path, monkeypatch):
    path = write_recording(tmp_path / "x.mcap", count=25, period=0.01)

    async def slow(function, *arguments, **options):
        await asyncio.sleep(0.025)
        return function(*arguments, **options)

    async def main():
        driver = a_driver(path)
        with driver.bus.frames("front").subscribe() as frames:
            async with running(driver):
                monkeypatch.setattr("robotd.drivers.replay.in_thread", slow)
                await asyncio.sleep(2.0)
                counters = driver.counters
            assert counters.dropped + counters.published == 25
            assert counters.dropped > 5
            assert frames.waiting == counters.published

    run_virtual(main())


@pytest.mark.parametrize(
    ("config", "match"), [({}, "say which camera"), ({"camera": "rear"}, "no frames of camera 'rear'")]
)
def test_footage_that_cannot_be_played_is_a_fault(tmp_path, config, match):
    path = write_recording(tmp_path / "x.mcap", ("front", "left"))

    async def main():
        with pytest.raises(DriverFault, match=match):
            async with running(a_driver(path, **config)):
                pass
        async with running(a_driver(path, camera="left"), CameraMode((64, 48))) as task:
            with pytest.raises(DriverFault, match="has 32x24 pixels instead of 64x48"):
                await task

    run_virtual(main())


def test_an_image_that_is_damaged_on_the_way_is_a_fault_and_the_driver_opens_again(tmp_path):
    path = write_folder(tmp_path / "images", ["1.png", "2.png", "3.png"])
    (path / "3.png").write_bytes(b"x")

    async def main():
        driver = a_driver(path, fps=10.0)
        for _ in range(2):
            async with running(driver) as task:
                with pytest.raises(DriverFault, match=r"3\.png: is not an image"):
                    await task

    run_virtual(main())


def test_it_plays_in_real_time_too(tmp_path):
    path = write_video(tmp_path / "x.avi", count=8, fps=100.0)

    async def main():
        driver = a_driver(path)
        with driver.bus.frames("front").subscribe() as frames:
            async with running(driver, CameraMode((64, 48))):
                got = [await frames.get() for _ in range(3)]
                assert got[-1].t <= now()

    asyncio.run(main())
