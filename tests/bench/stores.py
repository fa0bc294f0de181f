"""Synthetic stores of any size: a planar robot with four cameras drives lanes between labels (solver benchmark)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from robotd.geometry.transforms import heading_matrix, rotation_vector, se2_compose, se2_relative, wrap_angle
from robotd.records import CameraModel, Move, Pose, Rig, Sighting, Sigmas, Stop, Survey, Transform
from robotd.solver.problem import Problem, Sightings, State, build_problem

# stops, labels, and metres within which labels are seen: 190, 9.5k, 78k and 570k sightings
SIZES = {"room": (7, 29, 2.6), "100": (100, 1000, 2.8), "1000": (1000, 10_000, 2.4), "8000": (8000, 10_000, 2.3)}
LANE_M = 2.5
FOCAL, CENTRE = 268.5, (319.5, 239.5)


@dataclass(frozen=True)
class Store:
    """Truth and measurements: poses (S, 3), points (L, 3), and per sighting stop, camera, label and pixels."""

    poses: np.ndarray
    points: np.ndarray
    stop: np.ndarray
    camera: np.ndarray
    label: np.ndarray
    uv: np.ndarray
    measured: np.ndarray
    covariance: np.ndarray


def rig() -> Rig:
    """Four cameras without distortion, outward from the robot's axis, 0.5 m above the floor."""
    cameras = []
    for name, heading in (("front", 0.0), ("left", 0.5 * np.pi), ("rear", np.pi), ("right", -0.5 * np.pi)):
        forward = np.array([np.cos(heading), np.sin(heading), 0.0])
        R = np.column_stack([[np.sin(heading), -np.cos(heading), 0.0], [0.0, 0.0, -1.0], forward])
        mount = Transform(tuple(rotation_vector(R).tolist()), tuple((0.06 * forward + [0.0, 0.0, 0.5]).tolist()))
        cameras.append(CameraModel(name, (640, 480), (FOCAL, FOCAL, *CENTRE), mount))
    return Rig(tuple(cameras), {})


def make_store(stops: int, labels: int, reach: float, seed: int = 0) -> Store:
    """Lanes to and fro over an area of 2.5 square metres for ten labels; labels are seen within `reach` metres."""
    rng = np.random.default_rng(seed)
    area = 0.25 * labels
    side = np.sqrt(area)
    lanes = max(1, round(side / LANE_M))
    side = area / (lanes * LANE_M)
    along = np.linspace(0.0, lanes * side, stops, endpoint=False)
    lane = np.minimum((along // side).astype(int), lanes - 1)
    x = along - lane * side
    back = lane % 2 == 1
    heading = np.where(back, np.pi, 0.0) + rng.normal(0.0, 0.1, stops)
    poses = np.column_stack([np.where(back, side - x, x), LANE_M * lane, heading])
    poses[:, :2] += rng.normal(0.0, 0.05, (stops, 2))
    points = rng.uniform([0.0, -0.5 * LANE_M, 0.2], [side, (lanes - 0.5) * LANE_M, 1.5], (labels, 3))
    near = np.abs((points[:, 1] + 0.5 * LANE_M) % LANE_M - 0.5 * LANE_M) < 0.5
    points[near, 1] += 0.5 * LANE_M * np.sign(rng.normal(size=np.count_nonzero(near)))
    cell: dict[tuple[int, int], list[int]] = {}
    for n, (u, v) in enumerate((points[:, :2] // reach).astype(int).tolist()):
        cell.setdefault((u, v), []).append(n)
    columns: list[list[np.ndarray]] = [[], [], [], []]
    T = np.array([[np.cos(a), np.sin(a)] for a in (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)])
    for s, (px, py, h) in enumerate(poses):
        u, v = int(px // reach), int(py // reach)
        around = [n for i in (-1, 0, 1) for j in (-1, 0, 1) for n in cell.get((u + i, v + j), [])]
        if not around:
            continue
        d = points[around] - [px, py, 0.5]
        c, k = np.cos(h), np.sin(h)
        r = np.column_stack([c * d[:, 0] + k * d[:, 1], -k * d[:, 0] + c * d[:, 1], d[:, 2]])
        distance = np.hypot(r[:, 0], r[:, 1])
        for camera, (fx, fy) in enumerate(T):
            z = r[:, 0] * fx + r[:, 1] * fy - 0.06
            right = r[:, 0] * fy - r[:, 1] * fx
            with np.errstate(divide="ignore", invalid="ignore"):
                uv = np.column_stack([CENTRE[0] + FOCAL * right / z, CENTRE[1] - FOCAL * r[:, 2] / z])
            uv += rng.normal(0.0, 1.0, uv.shape)
            seen = (z > 0.2) & (distance < reach) & ((uv > 0.0) & (uv < [639.0, 479.0])).all(axis=1)
            chosen = np.flatnonzero(seen)
            columns[0].append(np.full(len(chosen), s))
            columns[1].append(np.full(len(chosen), camera))
            columns[2].append(np.array(around, dtype=np.int64)[chosen])
            columns[3].append(uv[chosen])
    stop, camera_, label = (np.concatenate(column).astype(np.int64) for column in columns[:3])
    true = se2_relative(poses[:-1], poses[1:])
    sigma = np.column_stack(
        [np.tile(0.003 + 0.03 * np.hypot(true[:, 0], true[:, 1])[:, None], 2), np.full(len(true), 0.05)]
    )
    measured = true + rng.normal(size=true.shape) * sigma
    covariance = np.zeros((len(true), 3, 3))
    covariance[:, range(3), range(3)] = sigma**2
    return Store(poses, points, stop, camera_, label, np.concatenate(columns[3]), measured, covariance)


def survey_of(store: Store, name: str = "bench") -> Survey:
    """The survey that the robot would upload."""
    r = rig()
    stops, odometry = [], np.zeros(3)
    begins = np.searchsorted(store.stop, np.arange(len(store.poses) + 1))
    for s in range(len(store.poses)):
        move = None
        if s:
            m = store.measured[s - 1]
            odometry = se2_compose(odometry, m)
            move = Move(*m.tolist(), tuple(map(tuple, store.covariance[s - 1].tolist())))
        rows = range(begins[s], begins[s + 1])
        sightings = tuple(
            Sighting(
                r.cameras[store.camera[i]].name,
                f"{store.label[i]:05d}",
                *store.uv[i].tolist(),
                sigma_px=1.0,
                probability=1.0,
            )
            for i in rows
        )
        stops.append(Stop(1, s + 1, "2026-11-21T10:00:00Z", Pose(*odometry.tolist()), move, sightings))
    return Survey(name, r, tuple(stops), sigmas=Sigmas(1.0, 1.0))


def problem_of(store: Store) -> Problem:
    """The same as arrays, without making a record of every sighting."""
    none = np.zeros(0, dtype=np.int64)
    bare = replace(store, stop=none, camera=none, label=none, uv=np.zeros((0, 2)))
    problem = build_problem(survey_of(bare))
    order = np.argsort(store.camera, kind="stable")
    uv, camera = store.uv[order], store.camera[order]
    direction = np.concatenate([c.rays(uv[camera == k])[0] for k, c in enumerate(problem.cameras)])
    turned = (problem.R_robot_camera[camera] @ direction[:, :, None])[:, :, 0]
    count = len(order)
    sightings = Sightings(
        stop=store.stop[order],
        camera=camera,
        label=store.label[order],
        uv=uv,
        sigma=np.ones(count),
        probability=np.ones(count),
        rival=np.arange(count),
        source=order,
        origin=problem.t_robot_camera[camera],
        direction=turned,
    )
    return replace(problem, sightings=sightings, labels=tuple(f"{k:05d}" for k in range(len(store.points))))


def drifted(store: Store, problem: Problem, seed: int = 1) -> State:
    """A start as a structured one leaves it: moves nearly right, so that the poses drift, points as first seen."""
    rng = np.random.default_rng(seed)
    true = se2_relative(store.poses[:-1], store.poses[1:])
    step = np.sqrt(np.hypot(true[:, 0], true[:, 1]))[:, None]
    moves = true + rng.normal(size=true.shape) * [0.002, 0.002, 0.001] * step
    poses = np.zeros_like(store.poses)
    poses[0] = problem.odometry[0]
    for k, move in enumerate(moves):
        poses[k + 1] = se2_compose(poses[k], move)
    poses[:, 2] = wrap_angle(poses[:, 2])
    points = store.points.copy()
    seen, first = np.unique(store.label, return_index=True)
    f = store.stop[first]
    offset = points[seen, :2] - store.poses[f, :2]
    turn = heading_matrix(poses[f, 2] - store.poses[f, 2])
    points[seen, :2] = poses[f, :2] + (turn @ offset[:, :, None])[:, :, 0]
    points[seen] += rng.normal(0.0, 0.05, (len(seen), 3))
    frame = np.zeros(len(problem.prior_sigma))
    frame[: 5 * len(poses)].reshape(-1, 5)[:, :3] = poses
    return State(frame, points)
