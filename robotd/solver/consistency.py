"""Whether a survey contradicts itself, before anything is computed with it; and its sightings as columns.

A survey file was checked as it was read, but surveys are also made in memory and grow stop by stop. Here is checked
what the solver relies on: names that refer to something, numbers that are finite, matrices that are what they claim.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .. import sighting_columns
from ..errors import InputError
from ..geometry.camera import Camera
from ..records import CameraModel, Floats, Matrix3, Stop, Survey
from ..survey_checks import Problems, check_roof, check_units


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """All sightings of a survey, in its order: (N,) arrays, `camera` -1 where the rig has none of that name."""

    stop: NDArray[np.int64]
    camera: NDArray[np.int64]
    names: list[str]
    uv: Floats
    sigma: Floats
    probability: Floats

    @classmethod
    def of(cls, survey: Survey) -> Columns:
        """The columns of a survey; defaults stand in for what is not given."""
        rows = [s for stop in survey.stops for s in stop.sightings]
        cameras = {camera.name: i for i, camera in enumerate(survey.rig.cameras)}
        default = survey.sigmas.pixel_px if survey.sigmas.pixel_px > 0.0 else 1.0
        camera, names, (u, v, sigma, probability) = sighting_columns.read(rows, cameras, default)
        return cls(
            stop=np.repeat(np.arange(len(survey.stops)), [len(stop.sightings) for stop in survey.stops]),
            camera=camera,
            names=names,
            uv=np.column_stack([u, v]),
            sigma=sigma,
            probability=probability,
        )

    def suspects(self, stops: int) -> NDArray[np.bool_]:
        """(S,) which stops have sightings that cannot be used."""
        good = (self.camera >= 0) & np.isfinite(self.uv).all(axis=1) & np.isfinite(self.probability)
        good &= np.isfinite(self.sigma) & (self.sigma > 0.0)
        return np.bincount(self.stop[~good], minlength=stops) > 0


@lru_cache(maxsize=32)
def camera_of(model: CameraModel) -> Camera:
    """A camera; kept, because a survey that grows stop by stop asks for the same ones each time."""
    return Camera(model)


def checked_columns(survey: Survey) -> Columns:
    """The sightings of a survey that does not contradict itself.

    Raises
    ------
    InputError
        Names every mistake by leg, stop and label: cameras, beacons or labels that are unknown or there twice, numbers
        that are not finite, covariances that are none, units that cannot be.
    """
    where = f"survey {survey.survey}"
    doubts = Problems(where)
    check_units(survey, doubts)
    problems = [*doubts.found, *_of_header(survey, where)]
    columns = Columns.of(survey)
    suspect = columns.suspects(len(survey.stops)).tolist()
    seen: set[tuple[int, int]] = set()
    unknown: set[str] = set()  # cameras, which are told once
    for stop, is_suspect in zip(survey.stops, suspect, strict=True):
        at = f"{where}: leg {stop.leg} stop {stop.stop}"
        if (stop.leg, stop.stop) in seen:
            problems.append(f"{at} is there twice; remove one")
        seen.add((stop.leg, stop.stop))
        problems += _of_moves(stop, at)
        if is_suspect:
            problems += _of_sightings(stop, at, survey, unknown)
        problems += _of_beacons(stop, at, survey)
    if problems:
        raise InputError(*problems)
    return columns


def _of_header(survey: Survey, where: str) -> list[str]:
    """What is wrong with the rig, the roof cameras and the known labels."""
    doubts = Problems(where)
    problems = doubts.found
    names = [camera.name for camera in survey.rig.cameras]
    if len(set(names)) < len(names):
        problems.append(f"{where}: two cameras of the rig have the same name; names are {', '.join(names)}")
    for camera in survey.rig.cameras:
        try:
            camera_of(camera)
        except ValueError as error:
            problems.append(f"{where}: {error}")
    for roof in survey.roof_cameras:
        if not (np.isfinite(H := np.array(roof.H_world_image)).all() and abs(np.linalg.det(H)) > 1e-12):
            problems.append(f"{where}: roof camera {roof.name}: H_world_image is not invertible")
    for number, roof in enumerate(survey.roof_cameras):
        check_roof(roof, f"roof_cameras[{number}]", doubts)
    for known in survey.known_labels:
        if not np.isfinite([*known.position, known.sigma_m]).all():
            problems.append(f"{where}: known label {known.label}: position and sigma_m must be finite, got {known}")
    ids = [known.label for known in survey.known_labels]
    problems += [f"{where}: known label {i} is listed twice" for i in sorted({i for i in ids if ids.count(i) > 1})]
    return problems


def _of_moves(stop: Stop, at: str) -> list[str]:
    """What is wrong with how a stop was reached."""
    problems = []
    numbers = [stop.odometry.x, stop.odometry.y, stop.odometry.heading]
    if stop.move is not None:
        numbers += [stop.move.dx, stop.move.dy, stop.move.dheading, *np.ravel(stop.move.covariance)]
        numbers += [] if stop.move.by_errors is None else [*np.ravel(stop.move.by_errors)]
    for motion in stop.motions:
        if not np.isfinite([motion.dx, motion.dy, motion.dheading, *np.ravel(motion.information)]).all():
            problems.append(f"{at}: motion by {motion.source}: expected finite numbers, got {motion}")
        elif not _semidefinite(motion.information):
            problems.append(f"{at}: motion by {motion.source}: its information is not positive semidefinite")
    if not np.isfinite(numbers).all():
        problems.append(f"{at}: odometry and move must be finite numbers, got {stop.odometry} and {stop.move}")
    elif stop.move is not None and not _semidefinite(stop.move.covariance):
        problems.append(f"{at}: the move's covariance is not positive semidefinite")
    return problems


def _of_sightings(stop: Stop, at: str, survey: Survey, unknown: set[str]) -> list[str]:
    """What is wrong with a stop's sightings; cameras that the rig does not have are added to `unknown`."""
    problems = []
    names = [camera.name for camera in survey.rig.cameras]
    for s in stop.sightings:
        if s.camera not in names and s.camera not in unknown:
            unknown.add(s.camera)
            expected = ", ".join(names) or "no cameras"
            problems.append(f"{at}: sighting by unknown camera {s.camera!r}; the rig has {expected}")
        numbers = [s.u, s.v, 1.0 if s.sigma_px is None else s.sigma_px, s.probability or 0.0]
        if not (np.isfinite(numbers).all() and numbers[2] > 0.0):
            problems.append(f"{at}: label {s.label}: u, v must be finite and sigma_px positive, got {s}")
    return problems


def _of_beacons(stop: Stop, at: str, survey: Survey) -> list[str]:
    """What is wrong with how roof cameras saw the robot."""
    problems = []
    roofs = {roof.name for roof in survey.roof_cameras}
    for b in stop.beacon_sightings:
        if b.roof_camera not in roofs or b.beacon not in survey.rig.beacons:
            problems.append(f"{at}: beacon {b.beacon!r} seen by {b.roof_camera!r}: no such beacon or roof camera")
        if not np.isfinite([b.u, b.v]).all() or (b.sigma_px is not None and not b.sigma_px > 0.0):
            problems.append(f"{at}: beacon {b.beacon}: u, v must be finite and sigma_px positive, got {b}")
    return problems


def _semidefinite(rows: Matrix3) -> bool:
    """Whether a covariance is one, within rounding."""
    (a, b, c), (_, e, f), (_, _, i) = rows
    minors = a, a * e - b * b, a * (e * i - f * f) - b * (b * i - f * c) + c * (b * f - e * c)
    return min(minors) > 0.0 or bool(np.linalg.eigvalsh(np.array(rows)).min() >= -1e-9)
