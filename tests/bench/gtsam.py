"""GTSAM as a yardstick, where its package is installed (`pip install gtsam`, 4.3 or later): its own planar factors."""

from __future__ import annotations

import importlib
import importlib.util
import time
from typing import Any

from robotd.solver.bundle import Adjustment
from robotd.solver.problem import State


def module() -> Any | None:
    """The package, if it is there and has the factor for a planar robot's camera."""
    if importlib.util.find_spec("gtsam") is None:
        return None
    gtsam = importlib.import_module("gtsam")
    return gtsam if hasattr(gtsam, "PlanarProjectionFactor2") else None


def seconds(adjustment: Adjustment, start: State, tight: float) -> float:
    """CPU seconds until Levenberg-Marquardt in C++ comes within 1e-4 of the tight cost; the graph is built before.

    Poses are Pose2, points Point3, moves BetweenFactorPose2; the first pose is fixed by an equality. At 1000 stops the
    start has points behind cameras, at which these factors raise an exception instead of going on.
    """
    gtsam = module()
    assert gtsam is not None
    problem, s = adjustment.problem, adjustment.sightings
    calibrations = [
        gtsam.Cal3DS2(*(c.model.matrix[0], c.model.matrix[1], 0.0, *c.model.matrix[2:], 0, 0, 0, 0))
        for c in problem.cameras
    ]
    mounts = [
        gtsam.Pose3(gtsam.Rot3(R), t) for R, t in zip(problem.R_robot_camera, problem.t_robot_camera, strict=True)
    ]
    pose, point = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (x, y, heading) in enumerate(problem.stop_entries(start)[:, :3].tolist()):
        values.insert(pose(k), gtsam.Pose2(x, y, heading))
    for k in adjustment.labels.tolist():
        values.insert(point(k), start.points[k])
    graph.add(gtsam.NonlinearEqualityPose2(pose(0), values.atPose2(pose(0))))
    for stop, camera, label, uv in zip(s.stop.tolist(), s.camera.tolist(), s.label.tolist(), s.uv, strict=True):
        graph.add(
            gtsam.PlanarProjectionFactor2(pose(stop), point(label), uv, mounts[camera], calibrations[camera], pixel)
        )
    m = problem.moves
    for a, b, z, covariance in zip(m.before.tolist(), m.after.tolist(), m.measured, m.covariance, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.BetweenFactorPose2(pose(a), pose(b), gtsam.Pose2(*z.tolist()), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrderingType("METIS" if problem.stop_count > 1000 else "COLAMD")
    begun = time.process_time()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    for _ in range(200):
        optimizer.iterate()
        if optimizer.error() <= tight * (1.0 + 1e-4):
            return time.process_time() - begun
    raise RuntimeError(f"GTSAM ended at cost {optimizer.error()}, not within 1e-4 of {tight}")
