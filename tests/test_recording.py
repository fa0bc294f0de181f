"""Recordings give back what was put in, even when they were cut off."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.demo import _room_for_recording
from robotd.errors import InputError
from robotd.recorder import Progress, record
from robotd.recording import FrameRecorder, read_contents, read_frames, read_serial, recover
from robotd.records import Frame, assert_record_equal


def _frames(count: int) -> list[Frame]:
    rng = np.random.default_rng(3)
    return [
        Frame(("front", "floor")[k % 2], k / 30 - 0.05, rng.integers(0, 256, (24, 32), dtype=np.uint8), k)
        for k in range(count)
    ]


def test_frames_and_bytes_come_back_exactly(tmp_path: Path) -> None:
    frames = _frames(10)
    with FrameRecorder(tmp_path / "run.mcap") as recorder:
        for frame in frames:
            recorder.frame(frame, frame.t + 0.1)
        recorder.serial("/dev/robotd/base", 0.5, b"\x13\x05", to_robot=False)
        recorder.serial("/dev/robotd/base", 0.6, b"\x80", to_robot=True)
    for got, frame in zip(read_frames(tmp_path / "run.mcap"), frames, strict=True):
        assert_record_equal(got, frame)
    assert [frame.sequence for frame in read_frames(tmp_path / "run.mcap", "floor")] == [1, 3, 5, 7, 9]
    heard = [(item.port, item.t, item.to_robot, item.data) for item in read_serial(tmp_path / "run.mcap")]
    assert heard == [("/dev/robotd/base", 0.5, False, b"\x13\x05"), ("/dev/robotd/base", 0.6, True, b"\x80")]


def test_a_recording_is_finished_when_the_run_fails(tmp_path: Path) -> None:
    def run() -> None:
        with FrameRecorder(tmp_path / "run.mcap") as recorder:
            recorder.frame(_frames(1)[0], 0.0)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run()
    assert len(list(read_frames(tmp_path / "run.mcap"))) == 1


def test_a_recording_that_was_cut_off_is_read_up_to_the_cut(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    with FrameRecorder(tmp_path / "run.mcap") as recorder:
        for k in range(40):
            recorder.frame(Frame("front", k / 30, rng.integers(0, 256, (480, 640), dtype=np.uint8), k), k / 30)
    data = (tmp_path / "run.mcap").read_bytes()
    for cut in (len(data) // 2, len(data) - 200, len(data) // 2 + 12345):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        got = [frame.sequence for frame in read_frames(tmp_path / "cut.mcap")]
        assert got == list(range(len(got)))
        assert len(got) >= 40 * cut / len(data) - 16


def test_a_damaged_piece_is_left_out_and_told_and_what_follows_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(1)
    with FrameRecorder(tmp_path / "run.mcap") as recorder:
        for k in range(60):
            recorder.frame(Frame("front", k / 30, rng.integers(0, 256, (240, 320), dtype=np.uint8), k), k / 30)
    data = (tmp_path / "run.mcap").read_bytes()
    for at in (len(data) // 2, 2000):  # the second piece also says what the others' messages are
        broken = bytearray(data)
        broken[at : at + 400] = bytes(400)
        (tmp_path / "broken.mcap").write_bytes(broken)
        got = [frame.sequence for frame in read_frames(tmp_path / "broken.mcap")]
        assert got == sorted(set(got))
        assert 60 - 16 <= len(got) < 60
        assert got[-1] == 59
        assert "1 damaged pieces" in caplog.text
        caplog.clear()
    assert sum(recover(tmp_path / "broken.mcap", tmp_path / "whole.mcap").frames.values()) == len(got)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        next(read_frames(tmp_path / "none.mcap"))
    (tmp_path / "text.mcap").write_text("hello, this is not a recording of anything")
    with pytest.raises(InputError, match="not a recording"):
        next(read_frames(tmp_path / "text.mcap"))


def test_an_unknown_camera_names_those_recorded(tmp_path: Path) -> None:
    with FrameRecorder(tmp_path / "run.mcap") as recorder:
        recorder.frame(_frames(1)[0], 0.0)
    with pytest.raises(InputError, match="no frames of camera 'back'; it has front"):
        list(read_frames(tmp_path / "run.mcap", "back"))


# ---- crash-safe, bounded ---------------------------------------------------------------------------------------------


def _write(path: Path, count: int, limit: int | None = None) -> FrameRecorder:
    rng = np.random.default_rng(1)
    with FrameRecorder(path, limit) as recorder:
        for k in range(count):
            recorder.frame(Frame("front", k / 30, rng.integers(0, 256, (120, 160), dtype=np.uint8), k), k / 30)
    return recorder


def test_every_cut_can_be_read_up_to_it_and_recovered(tmp_path: Path) -> None:
    _write(tmp_path / "run.mcap", 100)
    data = (tmp_path / "run.mcap").read_bytes()
    rng = np.random.default_rng(2)
    for cut in [9, *rng.integers(10, len(data), 25).tolist()]:
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        if cut < 60:
            continue
        got = [frame.sequence for frame in read_frames(tmp_path / "cut.mcap")]
        assert got == list(range(len(got)))
        assert len(got) >= 100 * cut / len(data) - 16, "a chunk at most is lost"
        contents = recover(tmp_path / "cut.mcap", tmp_path / "whole.mcap")
        assert contents.is_whole
        assert contents.frames.get("front", 0) == len(got)
        assert not (tmp_path / "whole.mcap.new").exists()
        for frame, again in zip(read_frames(tmp_path / "cut.mcap"), read_frames(tmp_path / "whole.mcap"), strict=True):
            assert_record_equal(frame, again)


def test_damage_in_the_middle_costs_a_piece_and_never_raises(tmp_path: Path) -> None:
    _write(tmp_path / "run.mcap", 60)
    data = (tmp_path / "run.mcap").read_bytes()
    rng = np.random.default_rng(3)
    for _ in range(25):
        broken = bytearray(data)
        at = int(rng.integers(200, len(data)))
        broken[at : at + 50] = rng.bytes(50)
        (tmp_path / "bad.mcap").write_bytes(broken)
        got = [frame.sequence for frame in read_frames(tmp_path / "bad.mcap")]
        assert got == sorted(set(got))
        assert set(got) <= set(range(60))


def test_contents_say_what_there_is_and_whether_it_was_finished(tmp_path: Path) -> None:
    with FrameRecorder(tmp_path / "run.mcap") as recorder:
        for frame in _frames(10):
            recorder.frame(frame, frame.t + 1.0)
        recorder.serial("/dev/x", 0.5, b"\x13", to_robot=False)
    contents = read_contents(tmp_path / "run.mcap")
    assert (contents.frames, contents.serial) == ({"front": 5, "floor": 5}, {"/dev/x": 1})
    assert contents.is_whole
    assert contents.begin == pytest.approx(0.5)
    assert contents.end == pytest.approx(9 / 30 + 0.95)
    data = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-9])
    assert not read_contents(tmp_path / "cut.mcap").is_whole


@pytest.mark.parametrize("limit", [200_000, 1_000_000])
def test_a_recording_stays_within_its_limit_and_is_whole(tmp_path: Path, limit: int) -> None:
    recorder = _write(tmp_path / "run.mcap", 100, limit)
    assert recorder.is_full
    assert recorder.written + recorder.refused == 100
    assert (tmp_path / "run.mcap").stat().st_size <= limit
    assert read_contents(tmp_path / "run.mcap").is_whole
    assert [frame.sequence for frame in read_frames(tmp_path / "run.mcap")] == list(range(recorder.written))
    if limit == 1_000_000:
        assert (tmp_path / "run.mcap").stat().st_size > 0.5 * limit


@pytest.mark.parametrize("content", [b"", b"something else", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(50)])
def test_what_is_no_recording_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(content)
    for look in (read_contents, lambda path: recover(path, tmp_path / "out.mcap")):
        with pytest.raises(InputError, match=r"x\.mcap: not a recording \(MCAP\)"):
            look(tmp_path / "x.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_a_disk_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    async def main() -> None:
        with pytest.raises(InputError, match="cannot be written: No such file"):
            await record(Bus(), ["front"], tmp_path / "none" / "x.mcap", limit=1_000_000, seconds=1.0)

    run_virtual(main())


def test_cameras_are_recorded_until_the_time_is_over(tmp_path: Path) -> None:
    async def main() -> Progress:
        bus = Bus()

        async def film() -> None:
            async for k in ticks(0.05):
                for name in ("front", "left", "rear"):
                    bus.frames(name).publish(Frame(name, now(), np.full((24, 32), k, np.uint8), k))

        filming = asyncio.ensure_future(film())
        try:
            return await record(bus, ["front", "left"], tmp_path / "x.mcap", limit=10_000_000, seconds=5.0)
        finally:
            filming.cancel()

    progress = run_virtual(main())
    contents = read_contents(tmp_path / "x.mcap")
    assert contents.is_whole
    assert set(contents.frames) == {"front", "left"}
    assert contents.frames == progress.frames
    assert progress.ended == "its time is over"
    assert 99 <= contents.frames["front"] <= 101
    stamps = [frame.t for frame in read_frames(tmp_path / "x.mcap", "front")]
    assert np.allclose(np.diff(stamps), 0.05)


def test_a_recording_that_is_cancelled_is_whole_and_a_killed_one_readable(tmp_path: Path) -> None:
    async def main() -> None:
        bus = Bus()
        recording = asyncio.ensure_future(record(bus, ["front"], tmp_path / "x.mcap", limit=100_000_000))
        rng = np.random.default_rng(1)
        for k in range(200):
            await asyncio.sleep(0.05)
            bus.frames("front").publish(Frame("front", now(), rng.integers(0, 256, (240, 320), dtype=np.uint8), k))
        await asyncio.sleep(1.0)
        on_disk = (tmp_path / "x.mcap").read_bytes()  # what a power cut would leave
        (tmp_path / "cut.mcap").write_bytes(on_disk)
        recording.cancel()
        await asyncio.gather(recording, return_exceptions=True)

    run_virtual(main())
    assert read_contents(tmp_path / "x.mcap").frames == {"front": 200}
    assert read_contents(tmp_path / "x.mcap").is_whole
    left = read_contents(tmp_path / "cut.mcap")
    assert not left.is_whole
    assert left.frames["front"] >= 200 - 4, "a chunk of 256 kB"


def test_the_demo_s_recording_has_the_robot_s_limits_and_leaves_room_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def room(free_mb: int) -> int:
        monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=free_mb, f_frsize=10**6))
        return _room_for_recording(tmp_path)

    assert room(50_000) == 2_000_000_000
    assert room(1_500) == 500_000_000
    with pytest.raises(InputError, match=r"800 MB free, expected more than 1000 MB; make room, or name another folder"):
        room(800)
