"""What the robot itself knows of where labels are, so that at the next stop it knows where their lights must appear.

The map is made off the robot. Here, rays to the labels seen at earlier stops are intersected by least squares in which
a ray counts less the less is known of the robot's heading since, with a broad prior on the depth along the newest one.
From a single stop that leaves a label on a stretch of its ray; so a predicted image position is a mixture of a few
points along the least known direction of the label's covariance. Once some lights of a stop have names, they tell where
the robot stands (`alignment`): the others are looked for more sharply, and the axes are odometry's less its drift.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from ..geometry.transforms import invert_rigid, pose_array, pose_matrix, se2_compose, se2_inverse, transform_points
from ..records import CameraModel, Floats, Pose, Sighting
from .alignment import align
from .decoder import Numbers, Prior
from .inquiry import FIRST_LIGHTS, Candidates
from .settings import IdentifyConfig

HEADING_NOISE = 0.018  # rad of odometry's heading after one metre, growing with the root of the distance
RAY_NOISE = 0.008  # rad of one ray: tilt of the floor, calibration
DEPTH_M, DEPTH_SIGMA_M = 1.5, 1.2  # of a label from the robot, before it was seen from a second stop
FARTHEST_M = 8.0
RAYS_KEPT = 6  # newest of each label
POINTS = np.array([-1.8, -1.2, -0.6, 0.0, 0.6, 1.2, 1.8])  # along the least known direction, in standard deviations
POINT_WEIGHTS = np.exp(-0.5 * POINTS**2) / np.exp(-0.5 * POINTS**2).sum()
DEPTHS = np.geomspace(0.5, FARTHEST_M, len(POINTS))  # m along the ray of a label that was seen from one stop only
DEPTH_WEIGHTS = np.exp(-0.5 * (np.log(DEPTHS / 1.8) / 0.8) ** 2)  # as near as shelves are, or far behind them
DEPTH_WEIGHTS /= DEPTH_WEIGHTS.sum()
SHOWS = 0.9  # probability that a label which is predicted to be in view can be seen
FORGETS = 0.6  # factor of that for each time in a row that it could not
ELSEWHERE = 0.003  # the same of a label whose place is known and out of view
HIDDEN = 0.02  # the same of one that is near and turned away or behind something
ANYWHERE = 0.05  # the same of one that is near and not placed: it may be anywhere
PLACED = 0.2  # of its distance to which a label's place must be known; and it must have been seen from two stops,
MISSED, STOPS = 2, 3  # or, if it was missed so often in a row, from so many: what was seen may have been a reflection
UNLIKELY_S = 1.5  # spent on labels that are known and probably not in view
EXPECTED = 0.3  # from which on a label is asked as one that is in view
NEW_LIGHTS = 10.0  # labels never seen before that a stop shows, unless it is the first one
REACH = 1.25  # times the distance within which 95 % of the sightings lie: further labels do not show
OBLIQUE = 1.3  # rad from its axis up to which a label shows
SPREAD_LEFT = 0.25  # rad by which its axis is not known at least, however many directions it was seen from
RARELY = 0.15  # probability that a label shows which is too far away, or is turned away
COARSE, WIDER = 0.1, 4.0  # fraction of predictions whose error is so many times larger
MISPREDICTED = 0.05  # of lights are not where they were predicted: reflections, wrong names, slips
ASTRAY = 0.3  # the same of labels that are not placed: what was seen of them may have been a reflection
GATE = 3.0  # standard deviations within which two predictions may be mistaken for one another


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """Image positions of the labels `labels` (M,): per camera, label and point, with weights that sum to the label's
    probability of being in that camera's view. `distances` (M,) in metres; `sure` where that is known to a fifth.
    `placed` labels need no further view."""

    labels: Numbers
    distances: Floats
    sure: NDArray[np.bool_]
    placed: NDArray[np.bool_]
    pixels: Floats  # (C, M, P, 2)
    weights: Floats  # (C, M, P)
    sigmas: Floats  # (C, M, P)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Labels (M,) that were seen: `points` (M, 3) with `covariances` (M, 3, 3), from how many `stops`, their newest ray
    (`origin`, `along` (M, 3)) and the heading's `doubt` there. They face `facing` (M, 3), seen from directions up to
    `around` (M,) radians about it."""

    labels: Numbers
    points: Floats
    covariances: Floats
    stops: Numbers
    origin: Floats
    along: Floats
    doubt: Floats
    facing: Floats
    around: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Stand:
    """Where the robot stands: its `pose` in odometry axes, metres `travelled`, and the corrected T_memory_robot (4, 4).
    `doubt` is the heading's variance, added up over the leg, `spread` the size of prediction errors as measured."""

    pose: Pose
    travelled: float
    T_memory_robot: Floats
    doubt: float
    spread: float = 1.0


class LabelMemory:
    """Rays to labels in odometry axes, and what was asked at earlier stops; lives as long as the mission's leg.

    Parameters
    ----------
    labels : sequence of str
    cameras : sequence of CameraModel
        The rig; frames and sightings carry their names.
    zones : sequence of (labels, begin, end)
        Labels that can be seen only while the robot is between two distances along the line, in metres.
    """

    def __init__(
        self,
        labels: Sequence[str],
        cameras: Sequence[CameraModel],
        config: IdentifyConfig,
        zones: Iterable[tuple[Sequence[str], float, float]] = (),
    ) -> None:
        self.config = config
        self.index: Mapping[str, int] = {label: number for number, label in enumerate(labels)}
        self.asked = np.zeros(len(labels), np.intp)
        self.learnt: set[str] = set()  # labels whose further flashes would teach the map nothing: the solver's plan
        self.refused: set[str] = set()  # labels that the label system does not take
        self._cameras = [Camera(camera) for camera in cameras]
        self._height = float(np.mean([camera.T_robot_camera[2, 3] for camera in self._cameras] or [0.0]))
        self._focal = max((float(camera.focal[0]) for camera in self._cameras), default=0.0)
        self._number = {camera.name: number for number, camera in enumerate(cameras)}
        self._zones = [
            (np.array([self.index[label] for label in names if label in self.index], np.intp), begin, end)
            for names, begin, end in zones
        ]
        self._missed = np.zeros(len(labels), np.intp)
        self.owed = 0.0  # labels that the audit has not asked yet
        self._distances: list[float] = []
        self._prediction: _Prediction | None = None
        self._looking: Sequence[str] = ()  # cameras of the present stop
        self._expected = np.zeros(len(labels), bool)
        self.forget_places()

    def forget_places(self) -> None:
        """Odometry was interrupted: what was seen before is somewhere else now."""
        self._rays: dict[int, list[tuple[Floats, Floats, float]]] = {}  # origin, direction, doubt of the heading there
        self._drift: Floats = np.zeros(3)  # T_memory_odometry
        self._last = self._stand = _Stand(Pose(0.0, 0.0, 0.0), 0.0, np.eye(4), 0.0)

    def forget(self, label: str) -> None:
        """The label was taken for another one."""
        self._rays.pop(self.index[label], None)

    def state(self) -> dict[str, Any]:
        """What stays known when odometry is lost, for JSON; see `restore`."""
        names = list(self.index)
        return {
            "asked": {names[k]: int(self.asked[k]) for k in np.flatnonzero(self.asked)},
            "missed": {names[k]: int(self._missed[k]) for k in np.flatnonzero(self._missed)},
            "learnt": sorted(self.learnt),
            "refused": sorted(self.refused),
            "owed": self.owed,
            "distances": [round(distance, 2) for distance in self._distances],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over what an earlier memory knew of the labels that this one has."""
        for name, counts in (("asked", self.asked), ("missed", self._missed)):
            for label, count in state[name].items():
                if label in self.index:
                    counts[self.index[label]] = count
        self.learnt |= self.index.keys() & set(state["learnt"])
        self.refused |= self.index.keys() & set(state["refused"])
        self.owed = state.get("owed", 0.0)  # not in what an earlier release left
        self._distances = list(state["distances"])

    @property
    def known(self) -> int:
        """Number of labels that have been seen."""
        return len(self._rays)

    def candidates(self, pose: Pose, travelled: float, cameras: Sequence[str]) -> Candidates:
        """Which labels these cameras may see from a pose in odometry axes, `travelled` metres along the line."""
        total = len(self.index)
        unseen = np.ones(total, bool)
        unseen[list(self._rays)] = False
        fresh = FIRST_LIGHTS if not self._rays else NEW_LIGHTS
        weights = np.where(unseen, min(0.5, fresh / max(1, int(unseen.sum()))), ELSEWHERE)
        self._looking = cameras
        self._stand = self._arrived(pose, travelled)
        self._prediction = prediction = self._predict(self._stand)
        share = prediction.weights.sum(axis=(0, 2))
        sought = np.zeros(total, bool)
        sought[prediction.labels] = ~prediction.placed
        least = np.where(prediction.placed, HIDDEN, ANYWHERE)
        weights[prediction.labels] = np.maximum(SHOWS * FORGETS ** self._missed[prediction.labels] * share, least)
        self._expected = ~unseen & (weights >= EXPECTED * SHOWS)
        wanted = unseen | self._expected | sought
        unlikely = np.flatnonzero(~wanted)
        few = round(UNLIKELY_S * self.config.commands_per_s)
        wanted[unlikely[np.lexsort((self.asked[unlikely], -weights[unlikely]))[:few]]] = True
        for labels, begin, end in self._zones:
            if not begin <= travelled <= end:
                wanted[labels] = False
                weights[labels] = 0.0
        wanted[[self.index[label] for label in self.learnt | self.refused]] = False
        return Candidates(
            weights,
            self._expected & wanted,
            wanted,
            self.asked.copy(),
            self._rivals(),
            self.owed,
            ~unseen,
            sought & wanted,
        )

    def prior(self, candidates: Candidates, cameras: Sequence[str], pixels: Floats) -> Prior:
        """What the positions (N, 2) of lights in those cameras say about which labels they are."""
        prediction = self._prediction
        if prediction is None or not len(prediction.labels) or not len(pixels):
            return Prior(candidates.weights)
        number = np.array([self._number[camera] for camera in cameras], np.intp)
        area = np.array([float(np.prod(camera.size)) for camera in self._cameras])
        inside = np.maximum(prediction.weights.sum(axis=(0, 2)), 1e-6)
        ratios = np.empty((len(pixels), len(prediction.labels)))
        astray = np.where(prediction.placed, MISPREDICTED, ASTRAY)
        for light, camera in enumerate(number):
            sigma = prediction.sigmas[camera]
            squares = ((prediction.pixels[camera] - pixels[light]) ** 2).sum(axis=2) / sigma**2
            shape = (1.0 - COARSE) * np.exp(-0.5 * squares) + COARSE / WIDER**2 * np.exp(-0.5 * squares / WIDER**2)
            density = (prediction.weights[camera] * shape / (2.0 * np.pi * sigma**2)).sum(axis=1)
            ratios[light] = (1.0 - astray) * density / inside * area.sum() + astray
        return Prior(candidates.weights, prediction.labels, np.log(ratios))

    def align(self, cameras: Sequence[str], pixels: Floats, labels: Numbers) -> bool:
        """Correct the present stop's pose by lights at positions (N, 2) in those cameras that are known to be `labels`.

        Returns
        -------
        bool
            Whether the predictions that `prior` goes by have changed.
        """
        known = self._seen()
        row = {int(label): k for k, label in enumerate(known.labels)}
        here = np.array([k for k, label in enumerate(labels) if int(label) in row], np.intp)
        rows = np.array([row[int(labels[k])] for k in here], np.intp)
        start = self._arrived(self._stand.pose, self._stand.travelled)
        found = align(
            self._cameras,
            np.array([self._number[cameras[k]] for k in here], np.intp),
            pixels[here],
            known.points[rows],
            known.covariances[rows],
            start.T_memory_robot,
            math.sqrt(start.doubt - self._last.doubt + RAY_NOISE**2),
            math.hypot(self.config.prediction_px, RAY_NOISE * self._focal),
        )
        if found is None:
            return False
        doubt = self._last.doubt + found.heading**2
        self._stand = replace(start, T_memory_robot=found.T_world_robot, doubt=doubt, spread=found.spread)
        self._prediction = self._predict(self._stand)
        return True

    def record(
        self, pose: Pose, travelled: float, sightings: Sequence[Sighting], asked: NDArray[np.bool_], audited: int = 0
    ) -> None:
        """Take in the sightings of a stop, which labels (L,) were asked to flash there, and how many were audited."""
        if self._stand.pose != pose:
            self._stand = self._arrived(pose, travelled)
        named = [sighting for sighting in sightings if sighting.label in self.index]
        pixels = np.array([(sighting.u, sighting.v) for sighting in named]).reshape(-1, 2)
        labels = np.array([self.index[sighting.label] for sighting in named], np.intp)
        self.align([sighting.camera for sighting in named], pixels, labels)
        self._last = stand = replace(self._stand, travelled=travelled)
        x, y, heading = *stand.T_memory_robot[:2, 3], np.arctan2(*stand.T_memory_robot[1::-1, 0])
        self._drift = se2_compose((x, y, heading), se2_inverse(pose_array(pose)))
        seen: dict[int, list[tuple[Floats, Floats, float]]] = {}
        for camera in self._cameras:
            here = np.array([sighting.camera == camera.name for sighting in named], bool)
            rays, valid = camera.rays(pixels[here])
            T = stand.T_memory_robot @ camera.T_robot_camera
            for label, along in zip(labels[here][valid], rays[valid] @ T[:3, :3].T, strict=True):
                seen.setdefault(int(label), []).append((T[:3, 3], along, stand.doubt))
        self._distances = (self._distances + self._measured(seen))[-500:]
        for label, rays_ in seen.items():
            self._rays[label] = (self._rays.get(label, []) + rays_)[-RAYS_KEPT:]
        self.asked[asked] += 1
        answered = np.zeros(len(asked), bool)
        answered[list(seen)] = True
        self._missed[asked & self._expected & ~answered] += 1
        self._missed[answered] = 0
        known = float(np.count_nonzero(asked & self._expected))
        self.owed = float(np.clip(self.owed + self.config.audit_fraction * known - audited, 0.0, known))

    def _measured(self, seen: Mapping[int, list[tuple[Floats, Floats, float]]]) -> list[float]:
        """Distances of the labels that have just been seen and were predicted."""
        prediction = self._prediction
        if prediction is None:
            return []
        return [
            float(prediction.distances[row])
            for row, label in enumerate(prediction.labels)
            if label in seen and prediction.sure[row]
        ]

    # ---- geometry ----------------------------------------------------------------------------------------------------

    def _arrived(self, pose: Pose, travelled: float) -> _Stand:
        """Where the robot stands by odometry since the latest stop."""
        x, y, heading = se2_compose(self._drift, pose_array(pose))
        driven = abs(travelled - self._last.travelled)
        doubt = self._last.doubt + HEADING_NOISE**2 * driven
        return _Stand(pose, travelled, pose_matrix(x, y, heading), doubt)

    def _seen(self) -> _Seen:
        """Where the labels are that have been seen, by least squares over their rays."""
        labels = np.array(list(self._rays), np.intp)
        owner = np.repeat(np.arange(len(labels)), [len(rays) for rays in self._rays.values()])
        rays = [ray for each in self._rays.values() for ray in each]
        origin = np.array([ray[0] for ray in rays]).reshape(-1, 3)
        along = np.array([ray[1] for ray in rays]).reshape(-1, 3)
        doubt = np.array([ray[2] for ray in rays])
        newest = np.cumsum([len(each) for each in self._rays.values()]) - 1 if len(labels) else np.zeros(0, np.intp)
        noise = np.sqrt(RAY_NOISE**2 + np.maximum(self._last.doubt - doubt, 0.0))
        across = np.eye(3) - along[:, :, None] * along[:, None, :]
        start: Floats = origin[newest] + DEPTH_M * along[newest]
        points: Floats = start.copy()
        information = np.zeros((len(labels), 3, 3))
        for _ in range(4):
            offset = points[owner] - origin
            distance = np.clip(np.linalg.norm(offset, axis=1), 0.3, FARTHEST_M)
            miss = np.linalg.norm((across @ offset[:, :, None])[:, :, 0], axis=1) / distance / noise
            trust = 1.0 / (1.0 + (miss / 3.0) ** 2)
            weighted = (trust / (noise * distance) ** 2)[:, None, None] * across
            information = along[newest][:, :, None] * along[newest][:, None, :] / DEPTH_SIGMA_M**2
            right = (information @ start[:, :, None])[:, :, 0]
            np.add.at(information, owner, weighted)
            np.add.at(right, owner, (weighted @ origin[:, :, None])[:, :, 0])
            points = np.asarray(np.linalg.solve(information, right[:, :, None])[:, :, 0])
        facing = np.zeros((len(labels), 3))
        np.add.at(facing, owner, -along)
        length = np.linalg.norm(facing, axis=1)
        mean = length / np.maximum(np.bincount(owner, minlength=len(labels)), 1)  # sin(a) / a, about, if even up to a
        return _Seen(
            labels,
            points,
            np.asarray(np.linalg.inv(information)),
            np.array([len({ray[2] for ray in each}) for each in self._rays.values()], np.intp),
            origin[newest],
            along[newest],
            doubt[newest],
            facing / np.maximum(length, 1e-9)[:, None],
            np.sqrt(6.0 * np.maximum(1.0 - mean, 0.0)),
        )

    def _predict(self, stand: _Stand) -> _Prediction:
        seen = self._seen()
        x, y = stand.T_memory_robot[:2, 3]
        variances, axes = np.linalg.eigh(seen.covariances)
        long = np.sqrt(variances[:, -1])
        spread = seen.points[:, None] + POINTS[None, :, None] * (long[:, None] * axes[:, :, -1])[:, None]  # (M, P, 3)
        share = np.tile(POINT_WEIGHTS, (len(spread), 1))
        once = seen.stops < 2
        spread[once] = seen.origin[once, None] + DEPTHS[None, :, None] * seen.along[once, None]
        share[once] = DEPTH_WEIGHTS
        enough = np.where(self._missed[seen.labels] < MISSED, 2, STOPS)
        placed = (seen.stops >= enough) & (long < PLACED * np.linalg.norm(seen.points - seen.origin, axis=1))
        near = np.flatnonzero(np.hypot(spread[:, :, 0] - x, spread[:, :, 1] - y).min(axis=1) < FARTHEST_M)
        labels, spread, placed = seen.labels[near], spread[near], placed[near]
        heading = np.sqrt(RAY_NOISE**2 + np.maximum(stand.doubt - seen.doubt[near], 0.0))
        away = np.array([x, y, self._height]) - spread
        distances = np.linalg.norm(away, axis=2)
        reach = REACH * float(np.quantile(self._distances, 0.95)) if len(self._distances) >= 20 else FARTHEST_M
        cosine = (seen.facing[near, None] * away).sum(axis=2) / np.maximum(distances, 1e-9)
        left = np.maximum(OBLIQUE - seen.around[near], SPREAD_LEFT)[:, None]  # about `facing` its axis may lie so far
        turned = np.clip(0.5 + 0.5 * (OBLIQUE - np.arccos(np.clip(cosine, -1.0, 1.0))) / left, RARELY, 1.0)
        shares = np.where(distances <= reach, turned, RARELY) * share[near]
        sure = long[near] < 0.2 * distances.mean(axis=1)
        T_robot_world = invert_rigid(stand.T_memory_robot)
        shape = (len(self._cameras), len(labels), len(POINTS))
        pixels, weights, sigmas = np.full((*shape, 2), -1e6), np.zeros(shape), np.ones(shape)
        for number, camera in enumerate(self._cameras):
            if camera.name not in self._looking:
                continue
            there = transform_points(invert_rigid(camera.T_robot_camera) @ T_robot_world, spread.reshape(-1, 3))
            uv, valid = camera.project(there)
            valid &= camera.in_image(np.where(valid[:, None], uv, -1e6), margin=2.0)
            uv = np.where(valid[:, None], uv, -1e6).reshape(*shape[1:], 2)
            step = np.linalg.norm(np.gradient(uv, axis=1), axis=2)
            noise = stand.spread**2 * (self.config.prediction_px**2 + (camera.focal[0] * heading[:, None]) ** 2)
            pixels[number] = uv
            weights[number] = valid.reshape(shape[1:]) * shares
            sigmas[number] = np.sqrt(noise + np.minimum(0.5 * step, 60.0) ** 2)
        return _Prediction(labels, distances.mean(axis=1), sure, placed, pixels, weights, sigmas)

    def _rivals(self) -> dict[int, Numbers]:
        """For every expected label, those that its light could be taken for by its position."""
        prediction = self._prediction
        assert prediction is not None
        chosen = np.flatnonzero(self._expected[prediction.labels])
        labels = prediction.labels[chosen]
        weights = prediction.weights[:, chosen]
        shown = weights.sum(axis=2)
        centre = (weights[..., None] * prediction.pixels[:, chosen]).sum(axis=2) / np.maximum(shown, 1e-9)[..., None]
        reach = np.sqrt(
            (weights * (prediction.sigmas[:, chosen] ** 2)).sum(axis=2) / np.maximum(shown, 1e-9)
            + (weights * ((prediction.pixels[:, chosen] - centre[:, :, None]) ** 2).sum(axis=3)).sum(axis=2)
            / np.maximum(shown, 1e-9)
        )
        rivals = {}
        for row, label in enumerate(labels):
            apart = np.linalg.norm(centre - centre[:, row, None], axis=2)
            close = (apart < GATE * np.hypot(reach, reach[:, row, None])) & (shown > 0.1) & (shown[:, row, None] > 0.1)
            rivals[int(label)] = labels[close.any(axis=0) | (labels == label)]
        return rivals
