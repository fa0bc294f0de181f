"""What a survey leaves of odometry and of beacons after their calibration, as pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .calibrate_rig import RigCalibration
from .figure import ARROW, INK, MUTED, RING, new_figure, plain, save_figure

MAGNIFIED = 50.0  # times, the residuals over a roof camera's picture
_SPREAD = 20.0  # times, the beacons' standard deviations
_PARTS = ("ahead", "to the left", "turned")


def draw_moves(path: Path, result: RigCalibration) -> None:
    """Write a PNG of what is left of every move, in its standard deviations.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    figure = new_figure(path, 10.0, 6.6, 110.0)
    words = ", ".join(
        f"{what} not observable" if factor.value is None else f"{what} x {factor.value:.5f} +- {factor.sigma:.5f}"
        for what, factor in (("distances", result.scale), ("turns", result.turn))
    )
    figure.suptitle(f"Odometry of {result.stops} stops: {words}", size=13, color=INK)
    most = 1.1 * max(float(np.abs(result.moves).max(initial=0.0)), 3.0)
    for k, part in enumerate(_PARTS):
        row = figure.add_subplot(3, 1, k + 1)
        left = result.moves[:, k]
        row.axhspan(-2.0, 2.0, color=RING, alpha=0.1)
        row.axhline(0.0, color=MUTED, linewidth=0.8)
        row.bar(np.arange(1, len(left) + 1), left, color=np.where(np.abs(left) > 3.0, ARROW, MUTED))
        row.set(ylim=(-most, most), ylabel="sigma")
        row.xaxis.get_major_locator().set_params(integer=True)
        row.set_title(f"{part}: rms {np.sqrt(np.mean(left**2)) if len(left) else 0.0:.2f} sigma", size=10, color=INK)
    row.set_xlabel("move; cameras less wheels as corrected; band: 2 sigma; orange: beyond 3")
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.96))
    save_figure(path, figure)


def draw_beacons(path: Path, result: RigCalibration) -> None:
    """Write a PNG of the beacons on the robot, and of what is left of their sightings in every roof camera.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    columns = 1 + len(result.seen_from_above)
    figure = new_figure(path, 5.0 * columns, 4.6, 110.0)
    from matplotlib.patches import Circle

    title = f"Beacons from {result.stops} stops"
    if result.beacon_distance is not None:
        length, sigma = result.beacon_distance
        title += f": {1e3 * length:.1f} +- {1e3 * sigma:.1f} mm apart"
    figure.suptitle(title, size=13, color=INK)
    top = figure.add_subplot(1, columns, 1)
    top.plot(0.0, 0.0, "+", color=MUTED, markersize=10)
    for name, (x, y, _) in result.beacons.items():
        sigma = result.beacon_sigmas[name]
        top.plot(x, y, "*", color=ARROW)
        top.add_patch(Circle((x, y), _SPREAD * sigma, fill=False, color=RING))
        words = f"{plain(name)} +- {1e3 * sigma:.1f} mm"
        top.annotate(words, (x, y), xytext=(0, 8), textcoords="offset points", color=INK, ha="center", size=9)
    top.margins(0.35)
    top.set(xlabel="x, forward (m)", ylabel="y, left (m)")
    top.axis("equal")
    top.set_title(f"on the robot; green: {_SPREAD:.0f} sigma", size=10, color=INK)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / MAGNIFIED, "color": ARROW}
    for k, roof in enumerate(result.seen_from_above):
        view = figure.add_subplot(1, columns, k + 2)
        width, height = roof.size
        view.quiver(*roof.seen.T, *roof.left.T, width=0.004, headwidth=3, **arrows)
        view.plot(*roof.seen.T, ".", color=MUTED, markersize=3)
        view.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)")
        rms = float(np.sqrt(np.mean(roof.left**2)))
        view.set_title(f"{plain(roof.name)}: {rms:.2f} px rms, residuals x {MAGNIFIED:.0f}", size=10, color=INK)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.95))
    save_figure(path, figure)
