"""`robotd-solver calibrate time`: by how much cameras' stamps are late, from what `robotctl calibrate time` made."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from .config import Calibration, load_calibration, save_stamp_offsets
from .errors import InputError, SolverError
from .files import read_bytes
from .recording import read_contents, read_frames
from .records import Floats
from .solver.calibrate_time import Lateness, lateness, view_turns
from .solver.time_picture import draw_lateness

FORMAT = "robotd-calibration-data/1"


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
    t, heading, recording = _data(arguments)
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


def _data(arguments: argparse.Namespace) -> tuple[Floats, Floats, Path]:
    where = arguments.folder / "data.json"
    try:
        data = json.loads(read_bytes(where))
        found = f"{data['format']} of {data['what']}"
        if found != f"{FORMAT} of time":
            raise InputError(f"{where}: is {found}; expected {FORMAT} of time")
        columns = data["odometry"]["columns"]
        rows = np.array(data["odometry"]["rows"], dtype=np.float64).reshape(-1, len(columns))
        t, heading = (rows[:, columns.index(name)] for name in ("t", "heading"))
        named = Path(str(data["recording"]["file"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: is not what robotctl calibrate time writes: {error!r}") from error
    places = [arguments.recording] if arguments.recording is not None else [named, arguments.folder / named.name]
    for place in places:
        if place.is_file():
            return t, heading, place
    raise InputError(f"{places[-1]}: there is no such recording; copy it from the robot ({named}), or give --recording")


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
