"""A rig's calibration in words."""

from __future__ import annotations

import math

import numpy as np

from .calibrate_rig import RigCalibration
from .rig_fit import amount

_WANTED = np.radians(0.05)


def report(result: RigCalibration, what: str = "rig") -> str:
    """The calibration for a reader, one statement a line.

    Parameters
    ----------
    result : RigCalibration
    what : str
        rig (all of it), odometry or beacons.
    """
    sightings = sum(len(camera.seen) for camera in result.cameras)
    lines = [
        f"{result.stops} stops, {result.known} known labels, {sightings} sightings used "
        f"({100 * result.explained:.0f} % of what several stops saw)"
    ]
    if what == "rig":
        lines += _rig(result)
    if what != "odometry":
        lines += _beacons(result)
    if what != "beacons":
        lines += _odometry(result)
    return "\n".join([*lines, *(f"note: {note}" for note in result.notes)]) + "\n"


def _rig(result: RigCalibration) -> list[str]:
    lines = []
    for camera in result.cameras:
        turn, place = camera.rig_sigma
        wide, far = camera.robot_sigma
        lines.append(
            f"camera {camera.model.name}: {np.degrees(camera.moved[0]):.2f} degrees and {1e3 * camera.moved[1]:.1f} mm "
            f"from nominal; in the rig +- {np.degrees(turn):.3f} degrees, +- {1e3 * place:.2f} mm; on the robot +- "
            f"{np.degrees(wide):.3f} degrees, +- {1e3 * far:.2f} mm; {len(camera.seen)} sightings of {camera.labels} "
            f"labels, {camera.rms_px:.2f} px rms"
        )
    for mode in result.modes:
        shown = "nothing" if np.isinf(mode.survey) else f"+- {amount(mode.name, mode.survey)}"
        if mode.is_shown:
            lines.append(
                f"whole rig, {mode.name}: moved by {amount(mode.name, mode.change)}, +- "
                f"{amount(mode.name, mode.sigma)} (the survey alone: {shown})"
            )
        else:
            lines.append(
                f"whole rig, {mode.name}: not observable from this survey (it shows {shown}); kept as measured by "
                f"tape, +- {amount(mode.name, mode.sigma)}"
            )
    if result.slope > 0.0:
        stops = math.ceil((result.slope / _WANTED) ** 2)
        lines.append(
            f"roll and pitch rest on the floor, whose slope differs by {np.degrees(result.slope):.2f} degrees from "
            f"stop to stop: {result.stops} stops show them to +- {np.degrees(result.floor_sigma):.3f} degrees at best "
            f"(the Cramer-Rao bound), {stops} to {np.degrees(_WANTED):.2f} (better where it stood on each spot in "
            "opposite headings, as robotctl calibrate rig drives: there the slope cancels)"
        )
    yaw = result.modes[-1]
    if yaw.is_shown and yaw.survey > _WANTED:
        lines.append(
            f"yaw shows only in how straight pieces are driven: with these wheels' noise no estimate from these moves "
            f"is better than +- {np.degrees(yaw.survey):.3f} degrees (the Cramer-Rao bound); "
            f"{math.ceil(result.stops * (yaw.survey / _WANTED) ** 2)} stops of this kind show it to "
            f"{np.degrees(_WANTED):.2f}"
        )
    return lines


def _beacons(result: RigCalibration) -> list[str]:
    lines = []
    for name, (x, y, _) in result.beacons.items():
        lines.append(f"beacon {name}: x {x:.4f}, y {y:.4f} m, +- {1e3 * result.beacon_sigmas[name]:.1f} mm")
    if result.beacon_distance is not None:
        length, sigma = result.beacon_distance
        lines.append(f"distance of the beacons: {length:.4f} m +- {1e3 * sigma:.1f} mm")
    lines += [
        f"roof camera {roof.name}: homography moved by {1e3 * roof.moved:.1f} mm, +- {1e3 * roof.sigma:.1f} mm"
        for roof in result.roofs
    ]
    return lines


def _odometry(result: RigCalibration) -> list[str]:
    lines = []
    for what, factor in (("distances", result.scale), ("turns", result.turn)):
        if factor.value is None:
            why = "measure two labels or use roof cameras" if what == "distances" else "make more turns"
            lines.append(f"odometry's {what}: not observable from this survey; {why}")
        else:
            lines.append(f"odometry's {what} must be multiplied by {factor.value:.5f} +- {factor.sigma:.5f}")
    return lines
