"""Recording on the robot: the camera's own bytes, limits, power cuts, and the daemon's service."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from robotd import recorder as recorder_module
from robotd.__main__ import parser
from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration, Config, RecordingConfig
from robotd.daemon import Plan
from robotd.errors import DriverFault, InputError
from robotd.footage import open_footage
from robotd.hardware import CameraMode
from robotd.plugin import Driver
from robotd.record_tool import choose, record_cameras
from robotd.recorder import Progress, Recordings, finish_parts, list_recordings, record
from robotd.recording import FrameRecorder, read_contents, read_frames, recover
from robotd.recording_upload import uploaded_mark
from robotd.records import CameraModel, Frame, Transform, assert_record_equal
from robotd.vision.blink import FlashPattern


def picture(k, size=(64, 48)):
    rng = np.random.default_rng(k)
    return cv2.GaussianBlur(rng.integers(0, 256, size[::-1], np.uint8), (0, 0), 2.0)


def jpeg_frame(k, *, factor=1, colour=None, camera="front"):
    """A frame as a camera driver makes it of a JPEG that is `factor` times as large."""
    large = picture(k, (64 * factor, 48 * factor))
    if colour == "red":
        large = np.dstack([np.zeros_like(large), np.full_like(large, 20), large])
    encoded = cv2.imencode(".jpg", large)[1].tobytes()
    from robotd import jpeg

    return Frame(camera, k / 30, jpeg.decode(encoded, (64, 48), "red" if colour else "gray"), k, encoded)


# ---- the camera's own bytes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1, 2, 4])
@pytest.mark.parametrize("colour", [None, "red"])
def test_a_jpeg_is_kept_as_it_came_and_decoded_as_it_was(tmp_path, factor, colour):
    frames = [jpeg_frame(k, factor=factor, colour=colour) for k in range(5)]
    with FrameRecorder(tmp_path / "x.mcap") as recorder:
        for frame in frames:
            recorder.frame(frame, frame.t + 0.1, {"channel": colour or "gray"})
    for got, frame in zip(read_frames(tmp_path / "x.mcap"), frames, strict=True):
        assert_record_equal(got, frame)
    shots = list(open_footage(tmp_path / "x.mcap").play())
    assert [shot.encoded for shot in shots] == [frame.encoded for frame in frames]


def test_what_holds_for_the_recording_and_for_each_mode_of_a_camera_is_in_it_even_if_it_was_cut_off(tmp_path):
    with FrameRecorder(tmp_path / "x.mcap", about={"robot": "r2", "pattern": "{}"}) as recorder:
        for k in range(20):
            recorder.frame(jpeg_frame(k), k / 30, {"mode": "standing" if k < 10 else "driving"})
            recorder.sync()
    data = (tmp_path / "x.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: 3 * len(data) // 4])
    recover(tmp_path / "cut.mcap", tmp_path / "again.mcap")
    for name in ("x", "cut", "again"):
        contents = read_contents(tmp_path / f"{name}.mcap")
        assert contents.about == {"robot": "r2", "pattern": "{}"}
        assert contents.cameras == {"front": ({"mode": "standing"}, {"mode": "driving"})}
    assert [frame.sequence for frame in read_frames(tmp_path / "x.mcap")] == list(range(20))


def test_every_cut_of_a_recording_of_jpegs_leaves_what_was_synced_before_it(tmp_path):
    """Cut at every tenth byte and around every end of a sync; frames whose sync was complete are all there."""
    ends = []
    with FrameRecorder(tmp_path / "x.mcap", about={"robot": "r"}) as recorder:
        recorder.sync()
        start = recorder.size
        for k in range(12):
            recorder.frame(jpeg_frame(k), k / 30)
            if k % 3 == 2:
                recorder.sync()
                ends.append(recorder.size)
    data = (tmp_path / "x.mcap").read_bytes()
    cuts = {*range(start, len(data), 97), *(end + near for end in ends for near in (-1, 0, 1)), len(data) - 1}
    whole = [frame.image for frame in read_frames(tmp_path / "x.mcap")]
    for cut in sorted(cuts):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        got = list(read_frames(tmp_path / "cut.mcap"))
        assert len(got) >= 3 * sum(end <= cut for end in ends), cut
        assert all(np.array_equal(frame.image, image) for frame, image in zip(got, whole, strict=False))


def test_a_killed_recorder_loses_what_it_had_not_synced_and_no_more(tmp_path):
    script = """
import sys, numpy as np, pathlib
from robotd.recording import FrameRecorder
from robotd.records import Frame
recorder = FrameRecorder(pathlib.Path(sys.argv[1])).__enter__()
for k in range(10000):
    recorder.frame(Frame("front", k / 30, np.full((240, 320), k % 256, np.uint8), k), k / 30)
    if k % 5 == 4:
        recorder.sync()
        print(k + 1, flush=True)
"""
    path = tmp_path / "x.mcap.part"
    with subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True) as process:
        for _ in range(8):
            acknowledged = int(process.stdout.readline())
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert len(list(read_frames(path))) >= acknowledged
    told = finish_parts(tmp_path)
    assert "x.mcap was cut off" in told[0]
    assert read_contents(tmp_path / "x.mcap").is_whole
    assert read_contents(tmp_path / "x.mcap").frames["front"] >= acknowledged
    assert not path.exists()


def test_what_cannot_be_finished_is_told_and_kept(tmp_path):
    (tmp_path / "y.mcap.part").write_bytes(b"nothing of ours")
    assert "y.mcap.part was cut off and cannot be finished" in finish_parts(tmp_path)[0]
    with FrameRecorder(tmp_path / "z.mcap.part") as recorder:
        recorder.frame(jpeg_frame(1), 0.0)
    told = finish_parts(tmp_path, keep_free=1 << 60)
    assert any("z.mcap.part was cut off, and there is no room" in text for text in told)
    assert (tmp_path / "z.mcap.part").exists()


# ---- limits ----------------------------------------------------------------------------------------------------------


async def film(bus, names, fps=30.0, size=(64, 48)):
    """Frames of noise, which cannot be compressed."""
    rng = np.random.default_rng(1)
    async for k in ticks(1.0 / fps):
        for name in names:
            bus.frames(name).publish(Frame(name, now(), rng.integers(0, 256, size[::-1], np.uint8), k))


def record_noise(path, **options):
    async def main():
        bus = Bus()
        filming = asyncio.ensure_future(film(bus, ["front", "left"]))
        try:
            return await record(bus, ["front", "left"], path, **{"limit": 10**8, "seconds": 4.0} | options)
        finally:
            filming.cancel()

    return run_virtual(main())


@pytest.mark.parametrize("limit", [150_000, 400_000])
def test_a_recording_ends_at_its_size_limit(tmp_path, limit):
    done = record_noise(tmp_path / "x.mcap", limit=limit)
    assert done.ended == "it has reached its size limit"
    assert 0.5 * limit < done.bytes + 65536
    assert done.bytes == (tmp_path / "x.mcap").stat().st_size <= limit
    assert read_contents(tmp_path / "x.mcap").frames == done.frames


def test_a_recording_ends_when_the_card_has_no_more_room_to_spare(tmp_path, monkeypatch):
    @dataclass
    class Card:
        f_bavail: int
        f_frsize: int = 1

    size = 1_000_000

    def statvfs(path):
        return Card(size - sum(file.stat().st_size for file in tmp_path.iterdir()))

    monkeypatch.setattr(recorder_module.os, "statvfs", statvfs)
    done = record_noise(tmp_path / "x.mcap", keep_free=600_000)
    assert done.ended == "the card has no more room to spare"
    assert size - (tmp_path / "x.mcap").stat().st_size >= 590_000, "but for the index at the end"
    assert read_contents(tmp_path / "x.mcap").is_whole
    assert read_contents(tmp_path / "x.mcap").frames == done.frames


def test_memory_does_not_grow_with_a_disk_that_is_too_slow(tmp_path, monkeypatch):
    plain, waiting = recorder_module._write_batch, []

    def slow(recorder, batch, t, *rest):
        waiting.append(len(batch))
        return plain(recorder, batch, t, *rest)

    async def main():
        bus = Bus()
        filming = asyncio.ensure_future(film(bus, ["front"], fps=400.0))  # 100 frames between two looks at the queue
        try:
            return await record(bus, ["front"], tmp_path / "x.mcap", limit=10**8, seconds=2.0)
        finally:
            filming.cancel()

    monkeypatch.setattr(recorder_module, "_write_batch", slow)
    done = run_virtual(main())
    assert max(waiting) <= recorder_module.WAITING
    assert done.dropped + sum(done.frames.values()) == pytest.approx(800, abs=102)
    assert done.dropped > 400


# ---- the service -----------------------------------------------------------------------------------------------------


class Films(Driver):
    """A camera driver whose frames are noise."""

    kind = "camera"

    @dataclass(frozen=True)
    class Config:
        channel: str = "gray"
        fails: bool = False

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.wanted = self.given = None
        self.log = []

    async def open(self):
        if self.config.fails:
            raise DriverFault("it is unplugged; plug it in again")

    async def start(self, mode):
        self.wanted = self.given = mode
        self.log.append(mode.exposure)
        self.task = asyncio.create_task(film(self.bus, [] if self.config.fails else [self.name]))

    async def stop(self):
        self.wanted = None
        self.log.append(None)
        self.task.cancel()


class Clock:
    def utc(self):
        from datetime import UTC, datetime

        return datetime(2026, 11, 22, 10, 0, 0, tzinfo=UTC)

    def boot_id(self):
        return "b"


def a_model(name):
    return CameraModel(name, (64, 48), (60.0, 60.0, 31.5, 23.5), Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


def service(tmp_path, steps, *, names=("front", "left"), groups=(), busy=(), **config):
    """Run `await steps(recordings, cameras)` beside the service."""

    async def main():
        bus = Bus()
        calibration = Calibration(cameras=tuple(map(a_model, names)))
        cameras = {name: Films(name, Films.Config(), None, bus, calibration) for name in (*names, "floor")}
        recordings = Recordings(
            *(RecordingConfig(tmp_path / "recordings", **{"keep_free_mb": 0.0} | config), "robot 1"),
            bus=bus,
            hardware=Clock(),
            calibration=calibration,
            cameras=cameras,
            mode=lambda name: CameraMode(exposure=0.020),
            groups=groups,
            pattern=FlashPattern(),
            is_busy=lambda: bool(busy),
        )
        running = asyncio.create_task(recordings.run())
        try:
            return await steps(recordings, cameras)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            for camera in cameras.values():
                if camera.wanted is not None:
                    await camera.stop()

    return run_virtual(main())


def test_a_recording_is_started_and_stopped_and_says_all_about_itself(tmp_path):
    async def steps(recordings, cameras):
        assert recordings.status() == {"recording": False}
        begun = await recordings.start()
        assert begun["recording"]
        assert begun["name"] == "robot-1-20261122T100000Z"
        await asyncio.sleep(3.0)
        assert recordings.status()["frames"]["left"] > 60
        with pytest.raises(InputError, match="a recording is being made already: robot-1-2026"):
            await recordings.start()
        done = await recordings.stop()
        assert (await recordings.files())[0].name == begun["name"]
        return done, cameras

    done, cameras = service(tmp_path, steps)
    assert not done["recording"]
    assert done["ended"] == "stopped on request"
    json.dumps(done)
    contents = read_contents(tmp_path / "recordings" / "robot-1-20261122T100000Z.mcap")
    assert contents.is_whole
    assert contents.frames == done["frames"]
    assert contents.about["created"] == "2026-11-22T10:00:00.000Z"
    assert json.loads(contents.about["pattern"])["period"] == 1.0
    front = contents.cameras["front"][0]
    assert json.loads(front["mode"])["exposure"] == 0.020
    assert json.loads(front["calibration"])["matrix"] == [60.0, 60.0, 31.5, 23.5]
    assert cameras["front"].log == [0.020, None]
    assert cameras["floor"].log == []


def test_a_camera_that_somebody_uses_is_left_as_it_is(tmp_path):
    async def steps(recordings, cameras):
        await cameras["front"].start(CameraMode(exposure=0.004))
        await recordings.start(["front", "left"])
        await asyncio.sleep(1.0)
        await recordings.stop()
        return list(cameras["front"].log), list(cameras["left"].log)

    assert service(tmp_path, steps) == ([0.004], [0.020, None])


def test_a_mission_that_begins_keeps_the_cameras(tmp_path):
    busy = []

    async def steps(recordings, cameras):
        await recordings.start(["front"], seconds=2.0)
        await asyncio.sleep(1.0)
        busy.append(True)
        await asyncio.sleep(2.0)
        assert recordings.status()["ended"] == "its time is over"
        return list(cameras["front"].log)

    assert service(tmp_path, steps, busy=busy) == [0.020]


def test_every_mistake_of_a_request_is_named(tmp_path):
    async def steps(recordings, cameras):
        with pytest.raises(InputError) as caught:
            await recordings.start(["front", "roof"], name="../x", seconds=1e9, limit_mb=-1.0)
        assert len(caught.value.problems) == 4
        assert "no camera 'roof'; expected some of floor, front, left" in str(caught.value)
        await recordings.start(name="a")
        await recordings.stop()
        with pytest.raises(InputError, match="there is a recording a already"):
            await recordings.start(name="a")

    service(tmp_path, steps)


def test_cameras_that_cannot_stream_at_once_are_not_recorded_at_once(tmp_path):
    async def steps(recordings, cameras):
        with pytest.raises(InputError, match=r"left, rear cannot stream at once .* record front, rear or left, right"):
            await recordings.start(["left", "rear"])
        assert (await recordings.start(["left", "floor"]))["cameras"] == ["left", "floor"]
        await recordings.stop()
        return (await recordings.start(name="x"))["cameras"]

    names = ("front", "left", "rear", "right")
    groups = (("front", "rear"), ("left", "right"))
    assert service(tmp_path, steps, names=names, groups=groups) == ["front", "rear"]


def test_a_card_that_cannot_be_written_ends_the_recording_and_not_the_daemon(tmp_path):
    (tmp_path / "recordings").write_text("a file in the folder's place")

    async def steps(recordings, cameras):
        await recordings.start()
        await asyncio.sleep(0.5)
        assert "cannot be made" in recordings.status()["ended"]
        (tmp_path / "recordings").unlink()
        await recordings.start()
        await asyncio.sleep(0.5)
        return await recordings.stop()

    assert service(tmp_path, steps)["frames"]["front"] > 5


def test_a_card_that_fails_on_the_way_leaves_a_part_that_is_finished_at_the_next_start(tmp_path, monkeypatch):
    plain = os.fsync
    count = []

    def fsync(handle):
        count.append(1)
        if len(count) == 6:
            raise OSError(5, "Input/output error")
        plain(handle)

    async def steps(recordings, cameras):
        await recordings.start(name="a")
        await asyncio.sleep(3.0)
        return recordings.status()

    monkeypatch.setattr(os, "fsync", fsync)
    assert "cannot be written: Input/output error" in service(tmp_path, steps)["ended"]
    assert [path.name for path in (tmp_path / "recordings").iterdir()] == ["a.mcap.part"]

    async def nothing(recordings, cameras):
        await asyncio.sleep(1.0)
        return await recordings.files()

    assert [file.name for file in service(tmp_path, nothing)] == ["a"]


def test_a_daemon_that_ends_finishes_the_recording(tmp_path):
    async def steps(recordings, cameras):
        await recordings.start(name="a")
        await asyncio.sleep(1.0)

    service(tmp_path, steps)
    assert read_contents(tmp_path / "recordings" / "a.mcap").is_whole


def test_the_list_says_what_the_server_has(tmp_path):
    for name in ("b", "a"):
        with FrameRecorder(tmp_path / f"{name}.mcap") as recorder:
            recorder.frame(jpeg_frame(1), 0.0)
    uploaded_mark(tmp_path / "a.mcap").write_text("{}")
    assert [(file.name, file.is_uploaded) for file in list_recordings(tmp_path)] == [("a", True), ("b", False)]
    assert list_recordings(tmp_path / "none") == []


# ---- robotd record ---------------------------------------------------------------------------------------------------


def plans(**sections):
    return {name: Plan(name, Films, config) for name, config in sections.items()}


def test_cameras_are_recorded_without_a_mission(tmp_path):
    async def main():
        path = tmp_path / "new" / "x.mcap"
        progress = Progress(path, ("front", "left"), now())
        calibration = Calibration(cameras=(a_model("front"),))
        both = plans(front=Films.Config(), left=Films.Config())
        return await record_cameras(Config(), both, calibration, Clock(), progress, seconds=2.0, limit=10**8)

    done = run_virtual(main())
    assert done.ended == "its time is over"
    contents = read_contents(done.path)
    assert 55 <= contents.frames["front"] <= 62
    assert json.loads(contents.cameras["front"][0]["mode"])["size"] == [64, 48]
    assert json.loads(contents.cameras["left"][0]["mode"])["size"] == [640, 480]


def test_a_camera_that_cannot_be_opened_is_named(tmp_path):
    async def main():
        progress = Progress(tmp_path / "x.mcap", ("front",), now())
        broken = plans(front=Films.Config(fails=True))
        with pytest.raises(DriverFault, match="front: it is unplugged; plug it in again"):
            await record_cameras(Config(), broken, Calibration(), Clock(), progress, seconds=2.0, limit=10**8)

    run_virtual(main())
    assert not (tmp_path / "x.mcap").exists()


def test_the_command_line_names_the_cameras_there_are(tmp_path):
    both = plans(front=Films.Config(), left=Films.Config())
    assert choose(both, [], tmp_path) == ("front", "left")
    with pytest.raises(InputError, match="no camera roof; expected some of front, left"):
        choose(both, ["roof"], tmp_path)
    with pytest.raises(SystemExit):
        parser().parse_args(["record", "-o", "x.mcap", "--seconds", "0"])
