"""Which dwell belongs to which stop: the robot's dates and the roof cameras' come from different clocks.

A stop's date is when the robot had finished looking, just before it drove on, so it lies in the dwell during which it
stood there. A Pi has no clock of its own, and where nobody set it its dates may be off by years: then the offset is
sought at which the stops fall into dwells, and the ways between the dwells are as long as odometry says.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from ..geometry.homography import apply
from ..geometry.transforms import heading_matrix, pose_array, se2_relative, wrap_angle
from ..records import BeaconSighting, Floats, RoofCamera, Stop, Survey, Vector3
from .dwell import Dwell
from .pose import Lens, RoofPose, Seen, solve_pose
from .setup import RoofCalibration

SLACK_S = 2.5  # by which two clocks that are set may differ
OPEN_S = 15.0  # after its last line an open dwell may still go on so long
BEFORE_S = 1.0  # a dwell has begun so long before the stop's date
WAY_M, WAY_SHARE = 0.15, 0.10  # by which a way may differ from odometry's
LEAST_STOPS = 3  # whose dwells agree before a clock is believed to be wrong
LIKELY_CHI2 = 16.0  # of a move's three residuals: one in a thousand is larger
DISAGREE = 4.0  # whitened sum of squares per degree of freedom, from which cameras are said to disagree

StopKey = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Joined:
    """What roof cameras add to a survey.

    `offset_s` is what the robot's dates must be moved by; `poses` what the cameras alone say of each stop; `notes` for
    the operator.
    """

    cameras: tuple[RoofCamera, ...]
    sightings: Mapping[StopKey, tuple[BeaconSighting, ...]]
    poses: Mapping[StopKey, RoofPose]
    offset_s: float
    notes: tuple[str, ...]


def join(
    stops: Sequence[Stop],
    dwells: Sequence[Dwell],
    calibrations: Mapping[str, RoofCalibration],
    beacons: Mapping[str, Vector3],
) -> Joined:
    """Find the dwells of stops, and say where clocks or cameras cannot be right.

    Parameters
    ----------
    stops : sequence of Stop
        In the order in which they were made.
    dwells : sequence of Dwell
    calibrations : mapping of str to RoofCalibration
        By their digests.
    beacons : mapping of str to (3,) tuple
        Places on the robot.
    """
    known = [dwell for dwell in dwells if dwell.calibration in calibrations and dwell.beacon in beacons]
    if not known or not stops:
        return Joined((), {}, {}, 0.0, ())
    dates = np.array([datetime.fromisoformat(stop.time).timestamp() for stop in stops])
    world = np.array([_ground(dwell, calibrations[dwell.calibration]) for dwell in known])
    offset, notes = _offset(stops, dates, known, world)
    if offset is None:
        return Joined((), {}, {}, 0.0, notes)
    names = _names(known)
    lenses = {digest: Lens(calibrations[digest].lens) for digest in names}
    sightings: dict[StopKey, tuple[BeaconSighting, ...]] = {}
    poses: dict[StopKey, RoofPose] = {}
    for stop, date in zip(stops, dates, strict=True):
        found, seen = [], []
        for dwell in _covering(known, float(date) + offset):
            spread = np.array([[dwell.uu, dwell.uv], [dwell.uv, dwell.vv]])
            flat = lenses[dwell.calibration].undistort(np.array([dwell.u, dwell.v]), spread)
            if flat is None:
                continue
            pixel, spread = flat
            seen.append(Seen(names[dwell.calibration], dwell.beacon, pixel, spread))
            # what the calibration leaves open is the same for all of a camera's sightings, and is said with the camera
            sigma = float(np.sqrt(0.5 * np.trace(spread)))
            u, v = float(pixel[0]), float(pixel[1])
            found.append(BeaconSighting(names[dwell.calibration], dwell.beacon, u, v, sigma))
        if found:
            sightings[stop.leg, stop.stop] = tuple(found)
            homographies = {names[digest]: calibrations[digest].homography for digest in names}
            pose = solve_pose(seen, homographies, beacons)
            if pose is not None:
                poses[stop.leg, stop.stop] = pose
    used = {sighting.roof_camera for group in sightings.values() for sighting in group}
    cameras = tuple(
        RoofCamera(name, calibrations[digest].size, calibrations[digest].H_world_image, calibrations[digest].covariance)
        for digest, name in sorted(names.items(), key=lambda item: item[1])
        if name in used
    )
    return Joined(cameras, sightings, poses, offset, (*notes, *_complaints(stops, poses)))


def with_roof(survey: Survey, joined: Joined) -> Survey:
    """The survey with the roof cameras and sightings added; those that it has already stay."""
    have = {camera.name for camera in survey.roof_cameras}
    stops = tuple(
        replace(stop, beacon_sightings=(*stop.beacon_sightings, *joined.sightings.get((stop.leg, stop.stop), ())))
        for stop in survey.stops
    )
    cameras = (*survey.roof_cameras, *(camera for camera in joined.cameras if camera.name not in have))
    return replace(survey, roof_cameras=cameras, stops=stops)


def _names(dwells: Sequence[Dwell]) -> dict[str, str]:
    """A camera's name by digest of its calibration; a camera that was calibrated anew is two in a survey."""
    by_camera: dict[str, list[str]] = {}
    for dwell in dwells:
        digests = by_camera.setdefault(dwell.camera, [])
        if dwell.calibration not in digests:
            digests.append(dwell.calibration)
    return {
        digest: name if len(digests) == 1 else f"{name}@{digest[:6]}"
        for name, digests in by_camera.items()
        for digest in digests
    }


def _ground(dwell: Dwell, calibration: RoofCalibration) -> Floats:
    """World x, y of a dwell; NaN outside the lens model."""
    flat = Lens(calibration.lens).undistort(np.array([dwell.u, dwell.v]), np.eye(2))
    return np.full(2, np.nan) if flat is None else apply(calibration.homography.inverse, flat[0][None])[0]


def _covering(dwells: Sequence[Dwell], date: float) -> list[Dwell]:
    """The dwells in which a date lies: of each camera and beacon that with the most time around it."""
    found: dict[tuple[str, str], Dwell] = {}
    for dwell in dwells:
        last = dwell.end + (OPEN_S if dwell.is_open else SLACK_S)
        if dwell.begin + BEFORE_S <= date <= last:
            other = found.get((dwell.camera, dwell.beacon))
            if other is None or dwell.end > other.end:
                found[dwell.camera, dwell.beacon] = dwell
    return list(found.values())


# ---- clocks ----------------------------------------------------------------------------------------------------------


def _offset(
    stops: Sequence[Stop], dates: Floats, dwells: Sequence[Dwell], world: Floats
) -> tuple[float | None, tuple[str, ...]]:
    """Seconds to add to the robot's dates, None if nothing fits, and what to tell the operator."""
    matched, agree, contradict = _score(stops, dates, dwells, world, 0.0)
    as_told = matched + agree if matched and not contradict else 0
    if matched == len(stops) and as_told:
        return 0.0, ()
    ends = np.array([dwell.end for dwell in dwells if not dwell.is_open])
    candidates = np.unique(np.round((ends[:, None] - dates[None, :]).ravel()))
    best: tuple[int, float] | None = None
    rival = 0
    for candidate in candidates.tolist():
        matched, agree, contradict = _score(stops, dates, dwells, world, candidate)
        if matched < LEAST_STOPS or agree < LEAST_STOPS - 1 or contradict:
            continue
        score = matched + agree
        if best is None or score > best[0]:
            if best is not None and abs(candidate - best[1]) > 2.0 * SLACK_S:
                rival = best[0]
            best = score, candidate
        elif abs(candidate - best[1]) > 2.0 * SLACK_S:
            rival = max(rival, score)
    if best is not None and best[0] > max(rival, as_told + LEAST_STOPS):
        return best[1], (
            f"the robot's clock was {abs(best[1]):.0f} s {'slow' if best[1] > 0 else 'fast'}; its stops were matched to"
            " the roof cameras' pictures by their order and distances",
        )
    if as_told:
        return 0.0, ()
    return None, (
        "no stop falls into a time at which a roof camera saw the robot stand; is the robot's clock set, and are its"
        " beacons on?",
    )


def _score(
    stops: Sequence[Stop], dates: Floats, dwells: Sequence[Dwell], world: Floats, offset: float
) -> tuple[int, int, int]:
    """How many stops fall into dwells, and how many ways between such stops agree with odometry or contradict it."""
    index = {id(dwell): k for k, dwell in enumerate(dwells)}
    places: list[dict[str, Floats]] = []
    for date in dates:
        found: dict[str, list[Floats]] = {}
        for dwell in _covering(dwells, float(date) + offset):
            found.setdefault(dwell.beacon, []).append(world[index[id(dwell)]])
        places.append({beacon: np.mean(at, axis=0) for beacon, at in found.items()})
    agree = contradict = 0
    for k in range(1, len(stops)):
        move = stops[k].move
        both = sorted(set(places[k]) & set(places[k - 1]))
        if move is None or not both:
            continue
        # beacons turn around the robot's middle, so the mean of both is its way
        way = np.mean([places[k][name] - places[k - 1][name] for name in both], axis=0)
        wanted = float(np.hypot(move.dx, move.dy))
        slack = WAY_M + WAY_SHARE * wanted + (0.0 if len(both) > 1 else 0.3)
        if abs(float(np.hypot(*way)) - wanted) <= slack:
            agree += 1
        else:
            contradict += 1
    return sum(1 for place in places if place), agree, contradict


# ---- cameras ---------------------------------------------------------------------------------------------------------


def _complaints(stops: Sequence[Stop], poses: Mapping[StopKey, RoofPose]) -> tuple[str, ...]:
    """What says that a camera was moved: cameras against each other, and against odometry."""
    found = []
    several = [pose for pose in poses.values() if pose.cross_px is not None]
    if several:
        ratio = float(np.median([pose.chi2 / max(1, pose.freedom) for pose in several]))
        cross = float(np.mean([pose.cross_px for pose in several if pose.cross_px is not None]))
        names = " and ".join(sorted({name for pose in several for name in pose.cameras}))
        if ratio > DISAGREE:
            found.append(
                f"{names} disagree about the robot by {cross:.1f} px ({ratio:.0f} times what their calibrations allow):"
                " one of them was moved; calibrate it again"
            )
    alone = [pose for pose in poses.values() if pose.cross_px is None]
    ratios = [pose.chi2 / max(1, pose.freedom) for pose in alone]
    if len(ratios) >= 2 and float(np.median(ratios)) > DISAGREE:
        names = " and ".join(sorted({name for pose in alone for name in pose.cameras}))
        found.append(
            f"{names} sees the beacons too near or too far apart: it was moved, or their places on the robot are wrong"
        )
    unlikely = moves = 0
    for before, stop in itertools.pairwise(stops):
        a, b = poses.get((before.leg, before.stop)), poses.get((stop.leg, stop.stop))
        if stop.move is None or a is None or b is None:
            continue
        moves += 1
        way = se2_relative(pose_array(a.pose), pose_array(b.pose))
        miss = way - np.array([stop.move.dx, stop.move.dy, stop.move.dheading])
        miss[2] = wrap_angle(float(miss[2]))
        spread = np.array(stop.move.covariance)
        back = np.eye(3)
        back[:2, :2] = heading_matrix(-a.pose.heading)
        for pose in (a, b):
            spread = spread + back @ np.array(pose.covariance) @ back.T
        unlikely += bool(float(miss @ np.linalg.solve(spread + 1e-12 * np.eye(3), miss)) > LIKELY_CHI2)
    if moves >= 3 and unlikely > moves // 2:
        found.append(
            f"{unlikely} of {moves} ways between stops differ from odometry by more than both allow: a roof camera was"
            " moved, or the wheels' calibration is wrong"
        )
    return tuple(found)
