"""A lens calibration as one picture: residuals over the view, their scatter, each picture's share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .calibrate_lens import LensCalibration
from .figure import ARROW, INK, MUTED, RING, new_figure, plain, save_figure

MAGNIFIED = 100.0  # times, the residuals over the view


def draw_residuals(path: Path, result: LensCalibration) -> None:
    """Write a PNG.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    figure = new_figure(path, 13.0, 6.2, 120.0)
    from matplotlib.patches import Circle

    name = plain(result.camera.name)
    figure.text(0.05, 0.94, f"Lens of {name}: {result.kind}, {result.rms_px:.3f} px rms", size=15, color=INK)
    lines = (f"held out, px rms: {result.held_out_words}", *result.doubts)
    for row, line in enumerate(lines):
        figure.text(0.05, 0.915 - 0.024 * row, line, size=9, color=MUTED)

    width, height = result.camera.size
    centre = result.camera.matrix[2:]
    seen, left = np.concatenate([view.pixels for view in result.views]), np.concatenate(result.residuals)
    over = figure.add_axes((0.05, 0.08, 0.5, 0.73))
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / MAGNIFIED, "color": ARROW}
    over.quiver(*seen.T, *left.T, width=0.0012, headwidth=3, **arrows)
    over.add_patch(Circle(centre, result.reach_px, fill=False, color=RING, linewidth=1.6))
    over.plot(*centre, "+", color=RING, markersize=10)
    over.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    over.set_title(f"residuals x {MAGNIFIED:.0f}; green: the lens holds inside", size=10, color=INK)

    most = 1.1 * max(float(np.abs(left).max()), 0.1)
    scatter = figure.add_axes((0.62, 0.48, 0.2, 0.33))
    scatter.plot(*left.T, ".", color=ARROW, markersize=2.5)
    scatter.add_patch(Circle((0.0, 0.0), 2.0 * result.rms_px, fill=False, color=MUTED))
    scatter.set(xlim=(-most, most), ylim=(most, -most), aspect="equal", xlabel="du (px)", ylabel="dv (px)")
    scatter.set_title("scatter; circle: 2 rms", size=10, color=INK)

    share = figure.add_axes((0.62, 0.08, 0.35, 0.3))
    each = [float(np.sqrt(np.mean(one**2))) for one in result.residuals]
    share.bar(np.arange(1, len(each) + 1), each, color=MUTED)
    share.axhline(result.rms_px, color=ARROW, linewidth=1.0)
    share.set(xlabel="picture", ylabel="rms (px)")

    save_figure(path, figure)
