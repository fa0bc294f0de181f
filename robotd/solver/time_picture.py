"""Cameras' lateness as one picture: how far views and wheels turned from frame to frame, and what is left."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .calibrate_time import Lateness
from .figure import ARROW, INK, MUTED, new_figure, plain, save_figure


def draw_lateness(path: Path, found: Mapping[str, Lateness]) -> None:
    """Write a PNG with a row for each camera.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    figure = new_figure(path, 11.0, 0.6 + 2.8 * len(found), 110.0)
    for k, (camera, late) in enumerate(found.items()):
        t, left = late.at - late.at[0], late.seen - late.expected
        place = figure.add_subplot(len(found), 1, k + 1)
        place.plot(t, late.seen, ".", color=MUTED, markersize=4, label="the view moved")
        place.plot(t, late.expected, color=INK, linewidth=1.0, label=f"the wheels turned, {1e3 * late.seconds:+.1f} ms")
        place.plot(t, left, ".", color=ARROW, markersize=3, label="left")
        inner = 1.3 * float(np.abs(late.expected).max())
        place.set(xlabel="s", ylabel="px a frame", ylim=(-inner, inner))
        place.set_title(
            f"{plain(camera)}: views are {1e3 * late.seconds:+.1f} +- {1e3 * late.sigma:.1f} ms late,"
            f" {late.rms_px:.2f} px left",
            size=10,
            color=INK,
        )
        place.legend(loc="upper right", fontsize=8, ncols=3)
    figure.tight_layout()
    save_figure(path, figure)
