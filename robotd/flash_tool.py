"""`robotd-solver calibrate flash`: how labels flash, from what `robotctl calibrate flash` made."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from .collected import read_collected
from .config import Calibration, load_calibration
from .flash_recording import learn_recorded
from .recording import read_contents, read_frames
from .records import Floats
from .solver.flash_picture import FlashCurve, draw_flash

_NEAR, _AROUND = 2, 6  # px: half sides of the spot that is summed and of what is its background


def run(arguments: argparse.Namespace) -> int:
    """Run the command; returns the exit code. Raises InputError if the recording is none, or shows no pattern."""
    data, recording = read_collected(arguments, "flash", _checked)
    camera = str(data["camera"])
    before = Calibration()
    if arguments.calibration is not None:
        before = load_calibration(arguments.calibration)
    contents = read_contents(recording)
    about = (*contents.cameras.get(camera, ()), {})[0]
    exposure = float(json.loads(about.get("mode", "{}")).get("exposure", 0.010))
    asked, seconds = float(data["asked_t"]), float(data["asked_s"])
    learnt, first, last = learn_recorded(recording, camera, asked, seconds, exposure, before.gamma)
    if arguments.picture is not None:
        t, light = _light(recording, camera, (learnt.u, learnt.v), first, last, before.gamma)
        draw_flash(arguments.picture, FlashCurve(str(data["label"]), t, light, exposure), learnt)
    if arguments.json:
        print(json.dumps(_summary(learnt)))
    else:
        print(f"[mission.identify] {learnt.toml()}")
    _say(
        f"{100.0 * learnt.confidence:.1f} % sure, period +- {1e3 * learnt.period_sigma:.1f} ms, edges +-"
        f" {1e3 * learnt.edge_sigma:.1f} ms, from {learnt.cycles} periods; it explains"
        f" {100.0 * learnt.explained:.0f} % of how the light at ({learnt.u:.0f}, {learnt.v:.0f}) px changes"
    )
    return 0


def _summary(learnt: Any) -> dict[str, Any]:
    return {
        "period_s": learnt.pattern.period,
        "on_s": [list(interval) for interval in learnt.pattern.on],
        "confidence": learnt.confidence,
        "period_sigma_s": learnt.period_sigma,
        "edge_sigma_s": learnt.edge_sigma,
        "explained": learnt.explained,
        "cycles": learnt.cycles,
        "u": learnt.u,
        "v": learnt.v,
    }


def _checked(data: dict[str, Any]) -> dict[str, Any]:
    float(data["asked_t"]), float(data["asked_s"]), data["camera"], data["label"]
    return data


def _light(
    recording: Path, camera: str, at: tuple[float, float], first: float, last: float, gamma: float
) -> tuple[Floats, Floats]:
    """Stamps (F,) and light (F,) of the spot above its surroundings, linear, in full scales of a pixel."""
    u, v = round(at[0]), round(at[1])
    t, light = [], []
    for frame in read_frames(recording, camera):
        if first <= frame.t < last:
            rows, columns = (slice(max(0, x - _AROUND), x + _AROUND + 1) for x in (v, u))
            part = (frame.image[rows, columns] / 255.0) ** gamma
            y, x = np.mgrid[rows.start : rows.start + part.shape[0], columns.start : columns.start + part.shape[1]]
            spot = (np.abs(y - v) <= _NEAR) & (np.abs(x - u) <= _NEAR)
            t.append(frame.t)
            light.append(float((part[spot] - np.median(part[~spot])).sum()))
    return np.array(t), np.array(light)


def _say(words: str) -> None:
    print(f"robotd-solver calibrate flash: {words}", file=sys.stderr)
