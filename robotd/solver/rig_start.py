"""What a rig's calibration begins with: several surveys as one, and a nominal rig where none was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..geometry.transforms import transform_record
from ..records import Rig, Sighting, Survey


def merge(surveys: Sequence[Survey]) -> Survey:
    """Surveys of one shop by one robot as legs of one survey.

    Raises
    ------
    InputError
        If their rigs, roof cameras or known labels differ.
    """
    first, problems = surveys[0], []
    stops, known = list(first.stops), {one.label: one for one in first.known_labels}
    roofs = {roof.name: roof for roof in first.roof_cameras}
    for survey in surveys[1:]:
        if survey.rig != first.rig:
            problems.append(f"surveys {first.survey} and {survey.survey} have different rigs; calibrate them apart")
        for label in survey.known_labels:
            if known.setdefault(label.label, label) != label:
                problems.append(f"survey {survey.survey}: known label {label.label} is elsewhere in another survey")
        for roof in survey.roof_cameras:
            if roofs.setdefault(roof.name, roof) != roof:
                problems.append(f"survey {survey.survey}: roof camera {roof.name} differs in another survey")
        last = max((stop.leg for stop in stops), default=0)
        default = survey.sigmas.pixel_px
        stops += [
            replace(stop, leg=stop.leg + last, sightings=tuple(_with_sigma(s, default) for s in stop.sightings))
            for stop in survey.stops
        ]
    if problems:
        raise InputError(*problems)
    name = "+".join(survey.survey for survey in surveys)
    every = tuple(known.values()), tuple(roofs.values())
    return replace(first, survey=name, stops=tuple(stops), known_labels=every[0], roof_cameras=every[1])


def _with_sigma(sighting: Sighting, default: float) -> Sighting:
    return sighting if sighting.sigma_px is not None or default <= 0.0 else replace(sighting, sigma_px=default)


def sphere(rig: Rig, headings: Mapping[str, float], radius: float, height: float) -> Rig:
    """The thesis's sphere of cameras as a nominal rig: all look outward, level, from a circle around the robot's axis.

    Parameters
    ----------
    rig : Rig
        Its lenses and beacons are kept.
    headings : mapping of camera to radians
        Which way each looks, counter-clockwise from the robot's front.
    radius, height : float
        Metres.

    Raises
    ------
    InputError
        If a camera has no heading or a heading no camera.
    """
    names = [camera.name for camera in rig.cameras]
    problems = [f"camera {name}: no heading is given" for name in names if name not in headings]
    problems += [f"heading of '{name}': the rig has {', '.join(names)}" for name in headings if name not in names]
    if problems:
        raise InputError(*problems)
    cameras = []
    for camera in rig.cameras:
        c, s = np.cos(headings[camera.name]), np.sin(headings[camera.name])
        T = np.eye(4)
        T[:3, :3] = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])  # columns: camera's right, down, forward
        T[:3, 3] = radius * c, radius * s, height
        cameras.append(replace(camera, T_robot_camera=transform_record(T)))
    return replace(rig, cameras=tuple(cameras))
