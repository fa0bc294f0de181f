"""Surveys for the calibration of a rig, simulated without pixels: turns on the spot along a store's line."""

from dataclasses import replace

import numpy as np

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import (
    invert_rigid,
    pose_matrix,
    rotation_matrix,
    rotation_vector,
    se2_compose,
    transform_points,
    wrap_angle,
)
from robotd.records import (
    BeaconSighting,
    KnownLabel,
    Move,
    Pose,
    Priors,
    RoofCamera,
    Sighting,
    Sigmas,
    Stop,
    Survey,
    Transform,
)
from tests.store_surveys import (
    WHEEL_BASE,
    World,
    covariance,
    hidden,
    in_axes_of,
    make_rig,
    mirror_images,
    path_of,
    true_cameras,
)

WORLD = World(reflections=0.0, wrong_ids=0.0, slip=0.0)
ROOF_BEACONS = {"front": (0.104, 0.003, 0.65), "rear": (-0.103, -0.002, 0.65)}  # where they really are
CIRCLE = tuple((0.0, 0.5 * np.pi * k) for k in range(4))  # metres on along the line, and turned against it
STEP_AND_TURN = ((0.0, 0.0), (0.15, 0.0), (0.15, 2.0 * np.pi / 3.0), (0.15, -2.0 * np.pi / 3.0))
OUT_AND_BACK = ((0.0, 0.0), (0.25, 0.0), (0.25, np.pi), (0.0, np.pi))  # what `robotctl calibrate rig` drives
STRAIGHT_ON = ((0.0, 0.0),)


def visits(store, places, pattern, crosswise=False):
    """Stops at some places along the line, one pattern at each.

    Their (S, 3) poses, the points of the line that they lie at, and how they are turned against it; with `crosswise`
    every second place's pattern is turned by 90 degrees, across the line.
    """
    poses, arc = path_of(store["line"])
    start = np.linspace(0.02 * arc[-1], 0.93 * arc[-1], places)
    on = np.tile([on for on, _ in pattern], places)
    beside = np.repeat(crosswise & (np.arange(places) % 2 == 1), len(pattern))
    index = np.argmin(np.abs(arc - (np.repeat(start, len(pattern)) + np.where(beside, 0.0, on))[:, None]), axis=1)
    turned = np.tile([turn for _, turn in pattern], places) + 0.5 * np.pi * beside
    result = poses[index]
    across = result[:, 2] + 0.5 * np.pi
    result[:, :2] += (beside * on)[:, None] * np.column_stack([np.cos(across), np.sin(across)])
    result[:, 2] += turned
    return result, index, turned


def steps_between(before, after, turned, line):
    """Small relative steps (K, 2) of travel and turn from one stop to the next, always forward.

    Along the line, of which the direction may be against the line's own, or straight; turned by `turned` before and
    after.
    """

    def turn(angle):
        count = max(2, int(abs(angle) / 0.05))
        return np.column_stack([np.zeros(count), np.full(count, angle / count)])

    if line is not None:
        d = np.diff(line, axis=0)
        along = np.column_stack([np.hypot(d[:, 0], d[:, 1]), d[:, 2]])
        return np.concatenate([turn(wrap_angle(-turned[0])), along, turn(wrap_angle(turned[1]))])
    way = after[:2] - before[:2]
    if np.hypot(*way) < 1e-3:
        return turn(wrap_angle(after[2] - before[2]))
    course = np.arctan2(way[1], way[0])
    ahead = np.column_stack([np.full(10, np.hypot(*way) / 10.0), np.zeros(10)])
    return np.concatenate([turn(wrap_angle(course - before[2])), ahead, turn(wrap_angle(after[2] - course))])


def measured(steps, world, scale, base, rng):
    """The move that odometry makes of steps, with its covariance: noise of each wheel by its own travel."""
    pose, P, J = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    wheels = steps[:, :1] + 0.5 * WHEEL_BASE * steps[:, 1:] * [-1.0, 1.0]
    sigma = world.wheel * np.sqrt(np.abs(wheels))
    wheels = scale * wheels + sigma * rng.standard_normal(wheels.shape)
    for (left, right), (sl, sr) in zip(wheels, sigma, strict=True):
        travel, turn = 0.5 * (left + right), (right - left) / (base * WHEEL_BASE)
        c, s = np.cos(pose[2] + 0.5 * turn), np.sin(pose[2] + 0.5 * turn)
        F = np.array([[1.0, 0.0, -travel * s], [0.0, 1.0, travel * c], [0.0, 0.0, 1.0]])
        G = np.array([[0.5 * c, 0.5 * c], [0.5 * s, 0.5 * s], [-1.0 / WHEEL_BASE, 1.0 / WHEEL_BASE]])
        G[:2] += 0.5 * travel * np.outer([-s, c], [-1.0 / WHEEL_BASE, 1.0 / WHEEL_BASE])
        P = F @ P @ F.T + G @ np.diag([sl**2, sr**2]) @ G.T
        bent = np.array([-0.5 * travel * s, 0.5 * travel * c, 1.0])
        J = F @ J + np.column_stack([[travel * c, travel * s, 0.0], bent * turn, bent * travel])
        pose += [travel * c, travel * s, turn]
    return Move(float(pose[0]), float(pose[1]), float(wrap_angle(pose[2])), covariance(P), covariance(J))


def tilt_of(place, sigma, phases):
    """Slopes of the floor at a place, in world axes: smooth, the same however the robot stands there."""
    a = np.sin(place[0] / 0.5 + phases[0]) + np.sin(place[1] / 0.7 + phases[1])
    b = np.sin(place[0] / 0.6 + phases[2]) + np.sin(place[1] / 0.5 + phases[3])
    return sigma * np.array([a, b])


def rig_survey(
    store,
    seed=0,
    places=5,
    pattern=STEP_AND_TURN,
    crosswise=False,
    world=WORLD,
    known=0,
    sigma=0.003,
    nominal=(0.0, 0.0),
    roofs=False,
    outliers=0.0,
):
    """A survey of turns along the line, the true cameras, the labels' positions, and what corrects odometry.

    The last are the factors of all moves' distances and turns.

    `nominal` is the standard deviation (radians, metres) by which the survey's idea of the rig is off; `outliers` the
    share of sightings that are wrong, half of them images in glass or floor, half under another label's name.
    """
    rng, spoiler = np.random.default_rng([seed, 77]), np.random.default_rng([seed, 78])
    poses, index, turned = visits(store, places, pattern, crosswise)
    dense, _ = path_of(store["line"])
    truth_rig = make_rig()
    cameras = true_cameras(truth_rig, world, rng)
    scale, base = 1.0 + rng.normal(0.0, world.odometry, 2)
    ids = [label["id"] for label in store["labels"]]
    spots, normals = (np.array([label[key] for label in store["labels"]]) for key in ("position", "normal"))
    images = mirror_images(store, spots, spoiler)
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    truth = in_axes_of(poses[0], dict(zip(ids, spots, strict=True)))
    to_survey = invert_rigid(pose_matrix(*poses[0]))
    H = np.array([[0.004, 0.0003, -2.0], [-0.0002, -0.0041, 3.0], [1e-6, 2e-6, 1.0]])
    stops, odometry = [], np.zeros(3)
    for k, pose in enumerate(poses):
        slope = tilt_of(pose, world.tilt, phases)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        roll, pitch = c * slope[0] + s * slope[1], -s * slope[0] + c * slope[1]
        T_world_robot = pose_matrix(*pose, roll, pitch)
        sightings = []
        for camera in cameras:
            T_world_camera = T_world_robot @ camera.T_robot_camera
            eye = T_world_camera[:3, 3]
            offset = eye - spots
            distance = np.linalg.norm(offset, axis=1)
            seen = (offset * normals).sum(axis=1) > np.cos(np.radians(75.0)) * distance
            seen &= ~hidden(store, eye, spots) & (distance < world.reach)
            uv, valid = camera.project(transform_points(invert_rigid(T_world_camera), spots))
            uv = uv + rng.normal(0.0, world.centroid_px, uv.shape)
            for n in np.flatnonzero(seen & valid & camera.in_image(uv, 3.0)):
                name, place, dice = ids[n], uv[n], spoiler.random()
                if dice < 0.5 * outliers:
                    image, there = camera.project(transform_points(invert_rigid(T_world_camera), images[n : n + 1]))
                    if not (there[0] and camera.in_image(image, 3.0)[0]):
                        continue
                    place = image[0]
                elif dice < outliers:
                    name = ids[spoiler.integers(len(ids))]
                sightings.append(Sighting(camera.name, name, *map(float, place), max(world.centroid_px, 0.1), 0.99))
        move = None
        if k:
            line, against = dense[index[k - 1] : index[k] + 1] if index[k] > index[k - 1] else None, 0.0
            if index[k] < index[k - 1]:
                line, against = dense[index[k] : index[k - 1] + 1][::-1], np.pi
            steps = steps_between(poses[k - 1], pose, turned[k - 1 : k + 1] - against, line)
            move = measured(steps, world, scale, base, rng)
            odometry = se2_compose(odometry, [move.dx, move.dy, move.dheading])
        beacons = []
        for name, at in ROOF_BEACONS.items() if roofs else ():
            there = (to_survey @ T_world_robot @ [*at, 1.0])[:2]
            h = np.linalg.solve(H, [*there, 1.0])
            u, v = h[:2] / h[2] + rng.normal(0.0, 0.3, 2)
            beacons.append(BeaconSighting("roof-1", name, float(u), float(v), 0.3))
        o = Pose(*map(float, odometry))
        stops.append(Stop(1, k + 1, "2026-11-21T10:00:00Z", o, move, tuple(sightings), tuple(beacons)))
    names = [i for i in ids if any(s.label == i for stop in stops for s in stop.sightings)]
    chosen = rng.permutation(len(names))[:known]
    labels = tuple(
        KnownLabel(names[i], tuple((np.array(truth[names[i]]) + rng.normal(0.0, sigma, 3)).tolist()), sigma)
        for i in sorted(chosen)
    )
    believed = []
    for camera in cameras:
        R = camera.T_robot_camera[:3, :3] @ rotation_matrix(rng.normal(0.0, nominal[0], 3))
        t = camera.T_robot_camera[:3, 3] + rng.normal(0.0, nominal[1], 3)
        mount = Transform(tuple(rotation_vector(R).tolist()), tuple(t.tolist()))
        matrix = next(c.matrix for c in truth_rig.cameras if c.name == camera.model.name)
        believed.append(replace(camera.model, matrix=matrix, T_robot_camera=mount))
    lens, odo = world.lens_px, world.odometry
    priors = Priors(world.tilt, 0.001, 0.001, lens, lens, odo, odo)
    survey = Survey(
        "rig",
        replace(truth_rig, cameras=tuple(believed)),
        tuple(stops),
        sigmas=Sigmas(max(world.centroid_px, 0.1), 0.3),
        priors=priors,
        known_labels=labels,
        roof_cameras=(RoofCamera("roof-1", (1280, 960), tuple(map(tuple, H.tolist()))),) if roofs else (),
    )
    return survey, [Camera(c.model) for c in cameras], truth, (1.0 / scale, base / scale)
