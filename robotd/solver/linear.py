"""The thesis's linear method, as the baseline: triangulation by singular value decomposition from odometry poses."""

from __future__ import annotations

import numpy as np

from ..geometry.transforms import invert_rigid, pose_matrix
from ..records import Floats, Map, MappedLabel, MappedSighting, MappedStop, SolverRun
from .problem import Bools, Ints, Problem, Sightings

_LEAST_ANGLE = np.radians(1.0)  # between the widest two rays; less leaves the depth to the noise (erratum A12)


def triangulate_linear(points: Floats, projections: Floats) -> tuple[Floats, Floats]:
    """Locate one label from its views by the null space of the stacked projection equations.

    The point minimises an algebraic error, which has no geometric meaning; that is why it is a baseline only.

    Parameters
    ----------
    points : (V, 3) array
        Homogeneous normalised image points (viewing rays in camera axes).
    projections : (V, 3, 4) array
        [R | t] of each view, from world metres to camera axes.

    Returns
    -------
    position : (3,) array
        World position in metres; infinite where the rays are parallel.
    scales : (V,) array
        The scale lambda of each view; negative = behind that camera, so that the solution is none.

    Notes
    -----
    Thesis section 2.4.3, equations 22-26 with errata A11 and A12: `A v = 0` with A of 3V rows and 4 + V columns, v the
    right singular vector of the smallest singular value. Working on normalised coordinates (K removed) conditions A.
    """
    views = len(points)
    if views < 2 or points.shape != (views, 3) or projections.shape != (views, 3, 4):
        raise ValueError(f"need 2 or more views, got points {points.shape} and projections {projections.shape}")
    A = np.zeros((views, 3, 4 + views))
    A[:, :, :4] = projections
    A[np.arange(views), :, 4 + np.arange(views)] = -points
    v = np.linalg.svd(A.reshape(3 * views, -1))[2][-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return v[:3] / v[3], v[4:] / v[3]


def solve_linear(problem: Problem) -> Map:
    """Map every label from the odometry poses as reported; of rival sightings the most probable is used."""
    sightings = _most_probable(problem.sightings)
    T_world_robot = pose_matrix(*problem.odometry.T)
    T_robot_camera = np.array([camera.T_robot_camera for camera in problem.cameras]).reshape(-1, 4, 4)
    T_camera_world = invert_rigid(T_world_robot[sightings.stop] @ T_robot_camera[sightings.camera])
    rays = (problem.R_robot_camera[sightings.camera].transpose(0, 2, 1) @ sightings.direction[:, :, None])[:, :, 0]
    labels, positions = [], {}
    for i, label in enumerate(problem.labels):
        mine = np.flatnonzero(sightings.label == i)
        mapped = _map_label(label, rays[mine], T_camera_world[mine, :3], sightings.stop[mine])
        labels.append(mapped)
        if mapped.position is not None:
            positions[i] = np.array(mapped.position)
    used = np.isin(sightings.label, list(positions))
    residual = _residuals(problem, sightings, T_camera_world, positions)
    square = (residual[used] / sightings.sigma[used, None]) ** 2
    return Map(
        survey=problem.survey.survey,
        frame="odometry",
        labels=tuple(labels),
        stops=tuple(
            MappedStop(s.leg, s.stop, s.odometry.x, s.odometry.y, s.odometry.heading) for s in problem.survey.stops
        ),
        sightings=_mapped_sightings(problem, sightings, residual, used),
        cost=0.5 * float(square.sum()),
        rms_px=float(np.sqrt(np.mean(residual[used] ** 2))) if used.any() else 0.0,
        solver=SolverRun(0, True, "linear"),
        notes=problem.notes,
    )


def _most_probable(sightings: Sightings) -> Sightings:
    order = np.lexsort((-sightings.probability, sightings.rival))
    _, first = np.unique(sightings.rival[order], return_index=True)
    return sightings.select(np.sort(order[first]))


def _map_label(label: str, rays: Floats, projections: Floats, stops: Ints) -> MappedLabel:
    def unplaced(reason: str) -> MappedLabel:
        return MappedLabel(label, "unplaced", sightings=len(rays), reason=reason)

    if len(np.unique(stops)) < 2:
        return unplaced("seen from one stop only; map it from a second stop" if len(rays) else "no camera saw it")
    in_world = (projections[:, :, :3].transpose(0, 2, 1) @ rays[:, :, None])[:, :, 0]
    if np.arccos(np.clip(in_world @ in_world.T, -1.0, 1.0)).max() < _LEAST_ANGLE:
        return unplaced("views nearly parallel; map it from a stop further aside")
    position, scales = triangulate_linear(rays, projections)
    if not (np.isfinite(position).all() and (scales > 0.0).all()):
        return unplaced("the linear solution lies behind a camera that saw the label")
    x, y, z = position.tolist()
    return MappedLabel(label, "placed", (x, y, z), None, len(rays), len(rays))


def _residuals(problem: Problem, sightings: Sightings, T_camera_world: Floats, positions: dict[int, Floats]) -> Floats:
    """(N, 2) pixels; zero for labels without a position and for points that do not project."""
    residual = np.zeros((len(sightings), 2))
    for c, camera in enumerate(problem.cameras):
        rows = np.array(
            [i for i in np.flatnonzero(sightings.camera == c) if int(sightings.label[i]) in positions], dtype=int
        )
        if len(rows) == 0:
            continue
        world = np.array([[*positions[int(sightings.label[i])], 1.0] for i in rows])
        pixels, valid = camera.project((T_camera_world[rows, :3] @ world[:, :, None])[:, :, 0])
        residual[rows] = np.where(valid[:, None], pixels - sightings.uv[rows], 0.0)
    return residual


def _mapped_sightings(
    problem: Problem, sightings: Sightings, residual: Floats, used: Bools
) -> tuple[MappedSighting, ...]:
    row_of = {int(source): row for row, source in enumerate(sightings.source)}
    result = []
    everything = ((stop, s) for stop in problem.survey.stops for s in stop.sightings)
    for number, (stop, s) in enumerate(everything):
        row = row_of.get(number)
        counts = row is not None and bool(used[row])
        pixels: tuple[float, float] | None = None
        if row is not None and counts:
            pixels = (float(residual[row, 0]), float(residual[row, 1]))
        result.append(MappedSighting(stop.leg, stop.stop, s.camera, s.label, pixels, 1.0 if counts else 0.0))
    return tuple(result)
