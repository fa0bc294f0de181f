"""The compiled bundle adjustment, if it was built: `compiled` hands an adjustment's arrays to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..geometry.camera import Camera
from ..records import Floats

if TYPE_CHECKING:
    from .bundle import Adjustment

try:
    from ._bundle import Bundle
except ImportError:  # built without extensions
    Bundle = None  # type: ignore[assignment, misc]

SHAPES = {"square": 0, "cauchy": 1, "geman-mcclure": 2}


def compiled(adjustment: Adjustment) -> Bundle | None:
    """The adjustment as a kernel object; None where the extensions were not built, so that numpy has to do."""
    if Bundle is None:
        return None
    problem, s = adjustment.problem, adjustment.sightings
    roofs, known = problem.roofs, problem.known
    here = adjustment.known_here
    return Bundle(
        problem.stop_count,
        len(adjustment.labels),
        adjustment.columns,
        adjustment.information,
        np.array([_lens(camera) for camera in problem.cameras]).reshape(-1, 16),
        np.ascontiguousarray(problem.R_robot_camera),
        np.ascontiguousarray(problem.t_robot_camera),
        s.stop,
        s.camera,
        adjustment.point,
        np.ascontiguousarray(s.uv),
        np.ascontiguousarray(s.sigma),
        np.ascontiguousarray(s.probability),
        adjustment.before,
        adjustment.after,
        adjustment.measured,
        adjustment.move_roots,
        np.ascontiguousarray(adjustment.by_errors),
        roofs.stop,
        roofs.camera,
        roofs.which,
        np.ascontiguousarray(problem.roof_axes),
        len(problem.survey.rig.beacons),
        np.ascontiguousarray(roofs.beacon),
        np.ascontiguousarray(roofs.uv),
        np.ascontiguousarray(roofs.sigma),
        np.ascontiguousarray(roofs.H_image_world),
        adjustment.known_point,
        known.position[here],
        known.sigma[here],
    )


def _lens(camera: Camera) -> Floats:
    """fx fy cx cy, 8 coefficients, limit, square of the valid radius, and whether fisheye or without distortion."""
    model = camera.model
    row = np.zeros(16)
    row[:4] = model.matrix
    row[4 : 4 + len(model.distortion)] = model.distortion
    row[12] = camera.limit
    row[13] = np.inf if model.valid_radius_px is None else model.valid_radius_px**2
    row[14] = model.model == "fisheye"
    row[15] = model.model != "fisheye" and not any(model.distortion)
    return row
