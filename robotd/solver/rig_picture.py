"""A rig calibration as one picture: the cameras from above with their uncertainty, and each camera's residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry.transforms import rotation_matrix
from .calibrate_rig import CameraFit, RigCalibration
from .figure import ARROW, INK, MUTED, RING, new_figure, plain, save_figure

MAGNIFIED = 200.0  # times, the residuals over a view
_SPREAD = 20.0  # times, the standard deviations from above
_LOOK_M = 0.04  # length of a viewing direction
_MOST_ARROWS = 2000


def draw_rig(path: Path, result: RigCalibration) -> None:
    """Write a PNG.

    Raises
    ------
    InputError
        If the file cannot be written or matplotlib is not installed.
    """
    columns = (2 if len(result.cameras) == 4 else min(len(result.cameras), 3)) + 1
    rows = -(-len(result.cameras) // (columns - 1))
    figure = new_figure(path, 4.4 * columns, 3.9 * rows + 1.0, 110.0)
    from matplotlib.patches import Circle

    figure.suptitle(
        f"Rig of {len(result.cameras)} cameras: {result.stops} stops, {result.known} known labels", size=15, color=INK
    )
    top = figure.add_subplot(1, columns, 1)
    for camera in result.cameras:
        x, y, _ = camera.model.T_robot_camera.translation
        look = rotation_matrix(camera.model.T_robot_camera.rotation)[:2, 2] * _LOOK_M
        top.annotate("", (x + look[0], y + look[1]), (x, y), arrowprops={"arrowstyle": "->", "color": INK})
        top.update_datalim([(x + look[0], y + look[1])])  # an annotation beyond the axes would not be drawn
        top.add_patch(Circle((x, y), _SPREAD * camera.rig_sigma[1], fill=False, color=RING, linewidth=1.6))
        top.annotate(plain(camera.model.name), (x, y), xytext=(4, -12), textcoords="offset points", color=INK)
    for name, (x, y, _) in result.beacons.items():
        top.plot(x, y, "*", color=ARROW)
        top.annotate(plain(name), (x, y), xytext=(4, 4), textcoords="offset points", color=ARROW)
    top.plot(0.0, 0.0, "+", color=MUTED, markersize=10)
    top.margins(0.15)
    top.autoscale_view()
    top.locator_params(nbins=5)
    top.set(aspect="equal", xlabel="x, forward (m)", ylabel="y, left (m)")
    top.set_title(f"from above; green: {_SPREAD:.0f} sigma in the rig", size=10, color=INK)
    for k, camera in enumerate(result.cameras):
        place = figure.add_subplot(rows, columns, k // (columns - 1) * columns + k % (columns - 1) + 2)
        _draw_view(place, camera)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.96))
    save_figure(path, figure)


def _draw_view(place: object, camera: CameraFit) -> None:
    from matplotlib.axes import Axes

    assert isinstance(place, Axes)
    width, height = camera.model.size
    some = np.linspace(0, len(camera.seen) - 1, min(len(camera.seen), _MOST_ARROWS)).astype(np.int64)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / MAGNIFIED, "color": ARROW}
    place.quiver(*camera.seen[some].T, *camera.left[some].T, width=0.003, headwidth=3, **arrows)
    place.plot(*camera.seen[some].T, ".", color=MUTED, markersize=2)
    place.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    turn, shift = camera.rig_sigma
    place.set_title(
        f"{plain(camera.model.name)}: residuals x {MAGNIFIED:.0f}, {camera.rms_px:.2f} px rms\n"
        f"in the rig +- {np.degrees(turn):.3f} degrees, {1e3 * shift:.2f} mm",
        size=9.5,
        color=INK,
    )
