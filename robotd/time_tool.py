"""`robotd-solver calibrate time`: by how much cameras' stamps are late, from what `robotctl calibrate time` made."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import numpy as np

from .collected import read_collected
from .config import Calibration, load_calibration, save_stamp_offsets
from .errors import SolverError
from .recording import read_contents, read_frames
from .records import Floats
from .solver.calibrate_time import Lateness, lateness, view_turns
from .solver.time_picture import draw_lateness


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code.

    Raises
    ------
    InputError
        If the folder, the recording or the calibration file is wrong.
    SolverError
        If no camera shows its lateness; the message says what is missing.
    """
    before = Calibration()
    if arguments.calibration is not None and arguments.calibration.exists():
        before = load_calibration(arguments.calibration)
    (t, heading), recording = read_collected(arguments, "time", _turning)
    contents = read_contents(recording)
    found: dict[str, tuple[Lateness, float]] = {}
    doubts = []
    for camera in sorted(contents.frames):
        try:
            late = lateness(view_turns(read_frames(recording, camera)), t, heading, camera)
        except SolverError as error:
            doubts.append(str(error))
            continue
        about = (*contents.cameras.get(camera, ()), {})[0]
        size = next(frame.image.shape for frame in read_frames(recording, camera))
        mode = json.loads(about.get("mode", "{}"))
        rows = float(contents.about.get("row_time_s", before.row_time_s)) * size[0]
        # a stamp is that of the first row's first light; what was compared is the middle row's middle
        found[camera] = late, late.seconds + 0.5 * float(mode.get("exposure", 0.0)) + 0.5 * rows
    if not found:
        raise SolverError("; ".join(doubts) or f"{recording}: it has no camera's frames")
    offsets = {camera: before.stamp_offsets.get(camera, 0.0) + offset for camera, (_, offset) in found.items()}
    if arguments.picture is not None:
        draw_lateness(arguments.picture, {camera: late for camera, (late, _) in found.items()})
    if arguments.calibration is not None:
        each = ", ".join(f"{camera} +- {1e3 * late.sigma:.1f} ms" for camera, (late, _) in found.items())
        note = f"robotd-solver calibrate time: {each}"
        save_stamp_offsets({**before.stamp_offsets, **offsets}, arguments.calibration, note)
    if arguments.json:
        print(json.dumps({camera: _summary(late, offsets[camera]) for camera, (late, _) in found.items()}))
    else:
        for camera, (late, offset) in found.items():
            print(
                f"camera {camera}: stamps {1e3 * offset:+.1f} ms late, +- {1e3 * late.sigma:.1f} ms ({late.frames} "
                f"frames, correlation {late.correlation:.3f}, {late.rms_px:.2f} px)"
            )
    for doubt in doubts:
        _say(doubt)
    if arguments.calibration is None:
        _say("nothing was written; --calibration FILE gets the result")
    else:
        _say(f"written to {arguments.calibration}; restart robotd to use it")
    return 0


def _turning(data: dict[str, Any]) -> tuple[Floats, Floats]:
    """Stamps (F,) in seconds and headings (F,) in radians."""
    columns = data["odometry"]["columns"]
    rows = np.array(data["odometry"]["rows"], dtype=np.float64).reshape(-1, len(columns))
    t, heading = (rows[:, columns.index(name)] for name in ("t", "heading"))
    return t, heading


def _summary(late: Lateness, offset: float) -> dict[str, Any]:
    return {
        "late_s": late.seconds,
        "sigma_s": late.sigma,
        "stamp_offset_s": offset,
        "frames": late.frames,
        "correlation": late.correlation,
        "rms_px": late.rms_px,
    }


def _say(words: str) -> None:
    print(f"robotd-solver calibrate time: {words}", file=sys.stderr)
