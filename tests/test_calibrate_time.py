"""The lateness of cameras' stamps from a robot that turns to and fro: accuracy, uncertainty, refusals, files."""

import json

import cv2
import numpy as np
import pytest

from robotd.bus import Bus
from robotd.clock import run_virtual
from robotd.config import Calibration, load_calibration, save_calibration
from robotd.errors import SolverError
from robotd.hardware import CameraMode
from robotd.recording import FrameRecorder
from robotd.records import Frame
from robotd.solver.calibrate_time import ViewTurns, lateness, view_turns
from robotd.solver_main import main
from tests.operated import Eye

RATE, SWING, FOCAL = 0.5, np.radians(40.0), 100.0


def swings(seconds=14.0, period=0.015):
    """Odometry of turns to and fro, with ramps."""
    t = np.arange(0.0, seconds, period)
    phase = np.mod(t * RATE / (2.0 * SWING), 2.0)
    rate = RATE * np.clip(8.0 * (0.5 - np.abs(phase - 0.5)), -1.0, 1.0)
    return t, np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * period)])


def film(late, seed=0, fps=15.0, noise=2.0, axis=0):
    """Frames of a scene of blobs as a camera on that robot sees them, with stamps that are late."""
    rng = np.random.default_rng(seed)
    scene = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (200, 500)).astype(np.float32), (0, 0), 3.0)
    scene = cv2.normalize(scene, None, 20.0, 230.0, cv2.NORM_MINMAX)
    if axis:
        scene = scene.T.copy()
    t, heading = swings()
    for k, at in enumerate(np.arange(0.3, t[-1] - 0.3, 1.0 / fps)):
        shift = 150.0 + FOCAL * np.interp(at, t, heading)
        move = [-20.0, -20.0]
        move[axis] -= shift
        view = cv2.warpAffine(scene, np.array([[1.0, 0.0, move[0]], [0.0, 1.0, move[1]]]), (160, 120))
        view = np.clip(view + noise * rng.standard_normal(view.shape), 0, 255).astype(np.uint8)
        yield Frame("front", float(at + late + 0.001 * rng.standard_normal()), view, k)


@pytest.mark.parametrize(("late", "axis"), [(0.043, 0), (-0.021, 1)])
def test_lateness_is_found_to_a_millisecond_and_its_uncertainty_holds(late, axis):
    found = lateness(view_turns(film(late, axis=axis)), *swings(), "front")
    assert abs(found.seconds - late) < max(4.0 * found.sigma, 0.0005) < 0.006
    assert found.sigma < 0.002
    assert found.correlation > 0.98


def test_what_is_missing_is_named():
    t, heading = swings()
    turns = view_turns(film(0.02))
    with pytest.raises(SolverError, match="its view does not turn as the wheels do"):
        lateness(
            ViewTurns(turns.before, turns.after, np.random.default_rng(1).permutation(turns.shift)), t, heading, "front"
        )
    with pytest.raises(SolverError, match="changed its turning direction 0 times"):
        lateness(turns, t, 0.5 * t, "front")
    with pytest.raises(SolverError, match="3 frames while odometry was recorded"):
        lateness(ViewTurns(*(x[100:103] for x in (turns.before, turns.after, turns.shift))), t, heading, "front")


def test_drivers_put_stamps_right():
    async def main():
        eye = Eye("eye", None, None, Bus(), Calibration(stamp_offsets={"eye": 0.04}))
        mode = CameraMode()
        await eye.start(mode)
        eye._publish(Frame("eye", 1.0, np.zeros((4, 4), np.uint8)), mode)
        assert eye.bus.frames("eye").latest.t == pytest.approx(0.96)

    run_virtual(main())


def test_the_command_reads_the_folder_and_writes_the_calibration(tmp_path, capsys):
    t, heading = swings()
    mode = {"mode": json.dumps({"size": [160, 120], "fps": 15.0, "exposure": 0.01})}
    with FrameRecorder(tmp_path / "time.mcap") as recorder:
        for frame in film(0.03):
            recorder.frame(frame, frame.t, mode)
    data = {
        "format": "robotd-calibration-data/1",
        "what": "time",
        "recording": {"name": "time", "file": "/elsewhere/time.mcap"},
        "odometry": {"columns": ["t", "heading", "turn_rate"], "rows": np.column_stack([t, heading, 0 * t]).tolist()},
    }
    (tmp_path / "data.json").write_text(json.dumps(data))
    save_calibration(Calibration(row_time_s=1e-4, stamp_offsets={"front": 0.002}), tmp_path / "c.toml")
    drawn = ["--picture", str(tmp_path / "time.png")]
    assert main(["calibrate", "time", str(tmp_path), "--calibration", str(tmp_path / "c.toml"), "--json", *drawn]) == 0
    assert (tmp_path / "time.png").read_bytes()[:4] == b"\x89PNG"
    assert "# robotd-solver calibrate time: front +- " in (tmp_path / "c.toml").read_text()
    assert json.loads(capsys.readouterr().out)["front"]["late_s"] == pytest.approx(0.03, abs=0.0015)
    # a stamp belongs to the first row's first light: half an exposure and half a picture of rows before what was seen,
    # and what was recorded had been corrected by 2 ms
    offset = 0.03 + 0.005 + 60 * 1e-4 + 0.002
    assert load_calibration(tmp_path / "c.toml").stamp_offsets["front"] == pytest.approx(offset, abs=0.0015)
    (tmp_path / "data.json").write_text(json.dumps({**data, "what": "floor"}))
    assert main(["calibrate", "time", str(tmp_path)]) == 2
    assert "expected robotd-calibration-data/1 of time" in capsys.readouterr().err
