"""Surveys that are simulated from the store layouts, without pixels: what detectors would report."""

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import (
    invert_rigid,
    pose_matrix,
    rotation_matrix,
    rotation_vector,
    se2_compose,
    se2_inverse,
    se2_relative,
    transform_points,
    wrap_angle,
)
from robotd.records import (
    CameraModel,
    Map,
    MappedLabel,
    Move,
    Pose,
    Priors,
    Rig,
    Sighting,
    Sigmas,
    Stop,
    Survey,
    Transform,
)

STORES = Path(__file__).parents[1] / "etc" / "stores"
WHEEL_BASE = 0.235
WHEEL_NOISE = 0.003  # metres times the square root of metres


@dataclass(frozen=True)
class World:
    """What disturbs a survey; the defaults are the simulated world's."""

    tilt: float = np.radians(0.3)
    rig_rotation: float = np.radians(0.05)
    rig_translation: float = 0.001
    lens_px: float = 0.2
    wheel: float = WHEEL_NOISE
    odometry: float = 0.003
    slip: float = 0.03
    centroid_px: float = 0.1
    reflections: float = 0.1
    wrong_ids: float = 0.01
    reach: float = 3.5


QUIET = World(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def make_rig() -> Rig:
    cameras = []
    for name, heading in (("front", 0.0), ("left", 0.5 * np.pi), ("rear", np.pi), ("right", -0.5 * np.pi)):
        forward = np.array([np.cos(heading), np.sin(heading), 0.0])
        R = np.column_stack([[np.sin(heading), -np.cos(heading), 0.0], [0.0, 0.0, -1.0], forward])
        mount = Transform(tuple(rotation_vector(R)), tuple(0.06 * forward + [0.0, 0.0, 0.5]))
        distortion = (-0.06, 0.012, 0.0002, 0.0002, -0.001)
        cameras.append(CameraModel(name, (640, 480), (268.5, 268.5, 319.5, 239.5), mount, distortion=distortion))
    return Rig(tuple(cameras), {"front": (0.1, 0.0, 0.65), "rear": (-0.1, 0.0, 0.65)})


def true_cameras(rig: Rig, world: World, rng) -> list[Camera]:
    cameras = []
    for model in rig.cameras:
        R = rotation_matrix(model.T_robot_camera.rotation) @ rotation_matrix(rng.normal(0.0, world.rig_rotation, 3))
        t = np.array(model.T_robot_camera.translation) + rng.normal(0.0, world.rig_translation, 3)
        matrix = tuple(np.array(model.matrix) + rng.normal(0.0, world.lens_px, 4))
        cameras.append(
            Camera(replace(model, matrix=matrix, T_robot_camera=Transform(tuple(rotation_vector(R)), tuple(t))))
        )
    return cameras


def path_of(line):
    """Dense (N, 3) poses along a line with rounded corners, and their arc lengths."""
    points, radius, closed = np.array(line["points"]), line["corner_radius"], line["closed"]
    n = len(points)
    pieces = [] if closed else [points[:1]]
    for i in range(n) if closed else range(1, n - 1):
        a, b = points[i - 1] - points[i], points[(i + 1) % n] - points[i]
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        half = 0.5 * np.arccos(np.clip(a @ b, -1.0, 1.0))
        centre = points[i] + (a + b) / np.linalg.norm(a + b) * radius / np.sin(half)
        start, end = points[i] + a * radius / np.tan(half) - centre, points[i] + b * radius / np.tan(half) - centre
        first = np.arctan2(start[1], start[0])
        angles = first + np.linspace(0.0, 1.0, 30) * wrap_angle(np.arctan2(end[1], end[0]) - first)
        pieces.append(centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    vertices = np.concatenate([pieces[0][-1:], *pieces[1:], pieces[0]] if closed else [*pieces, points[-1:]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vertices, axis=0), axis=1))])
    s = np.arange(0.0, arc[-1], 0.01)
    xy = np.column_stack([np.interp(s, arc, vertices[:, k]) for k in (0, 1)])
    slope = np.gradient(xy, axis=0)
    return np.column_stack([xy, np.unwrap(np.arctan2(slope[:, 1], slope[:, 0]))]), s


def true_poses(store):
    """(S, 3) of the stops, in the axes of the first."""
    poses, arc = path_of(store["line"])
    poses = poses[[int(np.argmin(np.abs(arc - a))) for a in store["line"]["stops"]]]
    poses = se2_compose(se2_inverse(poses[0]), poses)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return poses


def true_moves(store):
    """(S - 1, 3) between the stops of a store's line."""
    poses, arc = path_of(store["line"])
    poses = poses[[int(np.argmin(np.abs(arc - a))) for a in store["line"]["stops"]]]
    return se2_relative(poses[:-1], poses[1:])


def drive(poses, arc, index, world: World, rng) -> list[Move]:
    """Moves between stops as odometry reports them: noise per wheel, scale and base errors, one slip in 20 m."""
    if world.wheel == world.odometry == world.slip == 0.0:
        exact = [se2_relative(poses[i], poses[j]) for i, j in pairwise(index)]
        return [Move(*map(float, d), covariance(np.diag([1e-4, 1e-4, 1e-4]))) for d in exact]
    steps = np.diff(poses, axis=0)
    ds = np.hypot(steps[:, 0], steps[:, 1])
    turns = 0.5 * WHEEL_BASE * steps[:, 2]
    scale, base = 1.0 + rng.normal(0.0, world.odometry, 2)
    wheels = scale * np.column_stack([ds - turns, ds + turns])
    wheels += rng.normal(0.0, 1.0, wheels.shape) * world.wheel * np.sqrt(ds)[:, None]
    where, slips = rng.integers(len(ds) - 5), rng.random() < arc[-1] / 20.0
    wheels[where : where + 5, rng.integers(2)] += slips * world.slip / 5
    travel, turn = wheels.mean(axis=1), (wheels[:, 1] - wheels[:, 0]) / (base * WHEEL_BASE)
    moves = []
    for i, j in pairwise(index):
        pose, P, J = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        for k in range(i, j):
            c, s = np.cos(pose[2] + 0.5 * turn[k]), np.sin(pose[2] + 0.5 * turn[k])
            F = np.array([[1.0, 0.0, -travel[k] * s], [0.0, 1.0, travel[k] * c], [0.0, 0.0, 1.0]])
            arm = 0.5 * travel[k] / WHEEL_BASE
            G = np.array(
                [
                    [0.5 * c + arm * s, 0.5 * c - arm * s],
                    [0.5 * s - arm * c, 0.5 * s + arm * c],
                    [-1.0 / WHEEL_BASE, 1.0 / WHEEL_BASE],
                ]
            )
            P = F @ P @ F.T + G @ G.T * max(world.wheel, WHEEL_NOISE) ** 2 * ds[k]
            bent = np.array([-0.5 * travel[k] * s, 0.5 * travel[k] * c, 1.0])
            J = F @ J + np.column_stack([[travel[k] * c, travel[k] * s, 0.0], bent * turn[k], bent * travel[k]])
            pose += [travel[k] * c, travel[k] * s, turn[k]]
        moves.append(Move(pose[0], pose[1], wrap_angle(pose[2]), covariance(P), covariance(J)))
    return moves


def covariance(P):
    """A matrix as a record carries it."""
    return tuple(tuple(row) for row in P.tolist())


def hidden(store, eye, targets):
    """Which targets (N, 3) shelves or walls occlude from the eye."""
    ray = targets - eye
    ray = np.where(ray == 0.0, 1e-12, ray)
    result = np.zeros(len(targets), bool)
    for shelf in store.get("shelves", []):
        x0, y0, x1, y1 = shelf["box"]
        a, b = ([x0, y0, 0.0] - eye) / ray, ([x1, y1, shelf["height"]] - eye) / ray
        near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        result |= (near < far) & (far > 0.0) & (near < 1.0)
    for wall in store.get("walls", []):
        start, along = np.array(wall["from"]), np.array(wall["to"]) - wall["from"]
        w, cross = start - eye[:2], ray[:, 0] * along[1] - ray[:, 1] * along[0]
        s = (w[0] * along[1] - w[1] * along[0]) / np.where(cross == 0.0, 1e-12, cross)
        t = (w[0] * ray[:, 1] - w[1] * ray[:, 0]) / np.where(cross == 0.0, 1e-12, cross)
        result |= (s > 0.0) & (s < 1.0) & (t > 0.0) & (t < 1.0)
    return result


def mirror_images(store, positions, rng):
    """Each position's image in one of the four outer walls or the floor."""
    images = positions.copy()
    for image in images:
        axis = rng.integers(3)
        size = 0.0 if axis == 2 else store["size"][axis]
        plane = max(0.0, size, key=lambda p: abs(p - image[axis])) if rng.random() < 0.5 or axis == 2 else size
        image[axis] = 2.0 * plane - image[axis]
    return images


def load(name):
    return tomllib.loads((STORES / f"{name}.toml").read_text())


def simulate(store, seed=0, world: World = World(), outliers=0.0):
    """A survey of a store, and the true position of every label in the survey's world axes.

    `outliers` is a share of the sightings that is replaced: half by mirror images, half by wrong identities.
    """
    rng, spoiler = np.random.default_rng(seed), np.random.default_rng(seed + 10_000)
    poses, arc = path_of(store["line"])
    index = [int(np.argmin(np.abs(arc - a))) for a in store["line"]["stops"]]
    moves = drive(poses, arc, index, world, rng)
    rig = make_rig()
    cameras = true_cameras(rig, world, rng)
    ids = [label["id"] for label in store["labels"]]
    where, normals = (np.array([label[key] for label in store["labels"]]) for key in ("position", "normal"))
    images = mirror_images(store, where, spoiler)
    reflected = spoiler.random(len(ids)) < world.reflections
    stops, odometry, sigma = [], np.zeros(3), max(world.centroid_px, 0.1)
    for k, pose in enumerate(poses[index]):
        T_world_robot = pose_matrix(*pose, *rng.normal(0.0, world.tilt, 2))
        sightings = []
        for camera in cameras:
            T_world_camera = T_world_robot @ camera.T_robot_camera
            eye = T_world_camera[:3, 3]
            offset = eye - where
            distance = np.linalg.norm(offset, axis=1)
            front = (offset * normals).sum(axis=1) > np.cos(np.radians(75.0)) * distance
            seen = front & ~hidden(store, eye, where) & (distance < world.reach)
            in_glass = (
                reflected & (np.linalg.norm(eye - images, axis=1) < world.reach) & (spoiler.random(len(ids)) < 0.5)
            )
            for points, wanted, genuine in ((where, seen, True), (images, in_glass, False)):
                uv, valid = camera.project(transform_points(invert_rigid(T_world_camera), points))
                uv = uv + rng.normal(0.0, world.centroid_px, uv.shape)
                for n in np.flatnonzero(wanted & valid & camera.in_image(uv, 3.0)):
                    name, place, dice = ids[n], uv[n], spoiler.random()
                    if genuine and dice < 0.5 * outliers:
                        place, there = camera.project(transform_points(invert_rigid(T_world_camera), images[n : n + 1]))
                        place = place[0]
                        if not (there[0] and camera.in_image(place[None])[0]):
                            continue
                    elif dice < outliers or spoiler.random() < world.wrong_ids:
                        name = ids[spoiler.integers(len(ids))]
                    sightings.append(Sighting(camera.name, name, float(place[0]), float(place[1]), sigma, 0.99))
        move = moves[k - 1] if k else None
        if move is not None:
            odometry = se2_compose(odometry, [move.dx, move.dy, move.dheading])
        stops.append(Stop(1, k + 1, "2026-11-21T10:00:00Z", Pose(*map(float, odometry)), move, tuple(sightings)))
    priors = Priors(
        world.tilt,
        world.rig_rotation,
        world.rig_translation,
        world.lens_px,
        world.lens_px,
        world.odometry,
        np.sqrt(2.0) * world.odometry,  # of the wheels' size and of their base
        odometry_correlation=np.sqrt(0.5) if world.odometry else 0.0,
    )
    survey = Survey("test", rig, tuple(stops), sigmas=Sigmas(sigma, 1.0), priors=priors)
    return survey, in_axes_of(poses[index[0]], dict(zip(ids, where, strict=True)))


def in_axes_of(pose, truth):
    T = invert_rigid(pose_matrix(*pose))
    return {label: tuple(map(float, T[:3, :3] @ p + T[:3, 3])) for label, p in truth.items()}


@cache
def quiet_room():
    return simulate(load("room"), world=QUIET)


@cache
def noisy_room():
    return simulate(load("room"), seed=2, world=World(reach=2.5))


def label_of(result: Map, name) -> MappedLabel:
    return next(label for label in result.labels if label.label == name)


def nees(result: Map, truth) -> list[float]:
    """Squared error of each placed label in its own covariance, over its 3 degrees of freedom."""
    values = []
    for label in result.labels:
        if label.status == "placed":
            error = np.subtract(label.position, truth[label.label])
            values.append(float(error @ np.linalg.solve(np.array(label.covariance), error)) / 3.0)
    return values


def with_sightings(survey, change):
    return replace(survey, stops=tuple(replace(s, sightings=tuple(change(s))) for s in survey.stops))


def in_legs(survey, cut):
    """The same survey after a shutdown before stop `cut`: odometry starts anew at zero."""
    stops, pose = list(survey.stops[:cut]), np.zeros(3)
    for k, stop in enumerate(survey.stops[cut:]):
        if k:
            pose = se2_compose(pose, [stop.move.dx, stop.move.dy, stop.move.dheading])
        stops.append(replace(stop, leg=2, stop=k + 1, move=stop.move if k else None, odometry=Pose(*map(float, pose))))
    return replace(survey, stops=tuple(stops))
