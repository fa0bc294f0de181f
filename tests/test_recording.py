"""Recordings give back what was put in, even when they were cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robotd.errors import InputError
from robotd.recording import FrameRecorder, read_frames, read_serial
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
