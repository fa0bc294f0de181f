"""`robotd-solver calibrate rig`, `odometry` and `beacons`: extrinsics, wheels and beacons from surveys."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from .config import Calibration, collect, load_calibration, save_beacons, save_rig, save_wheels
from .errors import InputError, SolverError
from .files import check_survey, load_points, load_survey, write_atomic
from .odometry import Wheels
from .records import KnownLabel, Priors, Survey
from .roof.setup import load_calibrations, save_calibration
from .solver.calibrate_rig import LEAST_SEEN, Bounds, RigCalibration, calibrate_rig
from .solver.rig_picture import draw_rig
from .solver.rig_report import report
from .solver.rig_start import merge, sphere
from .solver.survey_pictures import draw_beacons, draw_moves

LEAST_PRIOR = (2e-4, 2e-4)  # radians, metres: mounts bend by as much
APPLIED = "corrected from the moves of"


def run_rig(arguments: argparse.Namespace) -> int:
    """Run `calibrate rig`; returns the exit code.

    Raises
    ------
    InputError
        If surveys, options or the calibration file are wrong.
    SolverError
        If the surveys do not determine the rig: the message says what is missing.
    """
    survey, before = _inputs(arguments)
    if arguments.sphere is not None:
        survey = replace(survey, rig=sphere(survey.rig, arguments.sphere, arguments.radius, arguments.height))
    bounds = Bounds()
    if arguments.each is not None:
        bounds = replace(bounds, each=arguments.each)
    if arguments.whole is not None:
        bounds = replace(bounds, whole=arguments.whole)
    if arguments.roof_calibration is not None:
        _check_roofs(survey, arguments)
    result = calibrate_rig(survey, bounds)
    if arguments.picture is not None:
        draw_rig(arguments.picture, result)
    if arguments.calibration is not None:
        turn, shift = (
            max(least, *(camera.rig_sigma[k] for camera in result.cameras)) for k, least in enumerate(LEAST_PRIOR)
        )
        priors = Priors(camera_rotation_rad=float(f"{turn:.2g}"), camera_translation_m=float(f"{shift:.2g}"))
        cameras = [camera.model for camera in result.cameras]
        save_rig(cameras, arguments.calibration, priors)
        if result.beacons:
            save_beacons(result.beacons, max(result.beacon_sigmas.values()), arguments.calibration)
    if arguments.roof_calibration is not None:
        for roof in result.roofs:
            known = load_calibrations(arguments.roof_calibration)[roof.name]
            rows = tuple(tuple(row) for row in roof.covariance.tolist())
            note = f"robotd-solver calibrate rig: +- {1e3 * roof.sigma:.1f} mm where it saw beacons"
            known = replace(known, H_world_image=roof.H_world_image, covariance=rows, note=note)
            save_calibration(known, arguments.roof_calibration)
    return _tell(arguments, result, before)


def _check_roofs(survey: Survey, arguments: argparse.Namespace) -> None:
    """Raise InputError unless the roof cameras' file holds the calibrations that the survey was made with."""
    known, problems = load_calibrations(arguments.roof_calibration), []
    for roof in survey.roof_cameras:
        if roof.name not in known:
            problems.append(f"{arguments.roof_calibration}: has no camera {roof.name}; it has {', '.join(known)}")
        elif known[roof.name].H_world_image != roof.H_world_image:
            problems.append(
                f"{arguments.roof_calibration}: camera {roof.name} was calibrated anew since the survey; survey again"
            )
    if not survey.roof_cameras:
        problems.append("--roof-calibration: the survey has no roof cameras")
    if problems:
        raise InputError(*problems)


def run_odometry(arguments: argparse.Namespace) -> int:
    """Run `calibrate odometry`; returns the exit code. Raises as `run_rig`."""
    survey, before = _inputs(arguments)
    result = calibrate_rig(survey, free=False)
    if result.scale.value is None and result.turn.value is None:
        raise SolverError("the survey shows neither distances nor turns; measure two labels and turn between stops")
    if arguments.picture is not None:
        draw_moves(arguments.picture, result)
    if arguments.calibration is not None:
        made = f"{survey.survey} {survey.created or ''}".strip()
        if f"{APPLIED} {made}\n" in _words(arguments):
            raise InputError(
                f"{arguments.calibration} [wheels]: was corrected from {made} already; drive another survey with it"
            )
        save_wheels(corrected(before.wheels, result), arguments.calibration, f"{APPLIED} {made}")
    return _tell(arguments, result, before)


def run_beacons(arguments: argparse.Namespace) -> int:
    """Run `calibrate beacons`; returns the exit code. Raises as `run_rig`."""
    survey, before = _inputs(arguments)
    _check_beacons(survey)
    result = calibrate_rig(survey, free=False)
    if arguments.picture is not None:
        draw_beacons(arguments.picture, result)
    if arguments.calibration is not None:
        save_beacons(result.beacons, max(result.beacon_sigmas.values()), arguments.calibration)
    return _tell(arguments, result, before)


def _check_beacons(survey: Survey) -> None:
    """Raise SolverError that names all that is missing for beacons to be found."""
    lacks = []
    if not survey.rig.beacons:
        lacks.append("its rig has no beacons: put their places, by tape, into [beacons] of the calibration, and survey")
    if not survey.roof_cameras:
        lacks.append("it has no roof cameras: survey where `robotd-solver roof watch` sees the robot")
    stops = dict.fromkeys(survey.rig.beacons, 0)
    for stop in survey.stops:
        for name in {sighting.beacon for sighting in stop.beacon_sightings} & stops.keys():
            stops[name] += 1
    if survey.roof_cameras:
        lacks += [
            f"beacon {name} was seen at {count} stops; {LEAST_SEEN} or more are needed, turned differently"
            for name, count in stops.items()
            if count < LEAST_SEEN
        ]
    if lacks:
        raise SolverError("the survey does not show the beacons: " + "; ".join(lacks))


def _words(arguments: argparse.Namespace) -> str:
    return arguments.calibration.read_text(encoding="utf-8") if arguments.calibration.exists() else ""


def corrected(wheels: Wheels, result: RigCalibration) -> Wheels:
    """Wheels with which the surveyed moves would have been as long and as turned as the cameras saw them.

    What does not show stays. How far the two wheels differ does not show, so that part of the covariance stays, too.
    """
    scale = 1.0 if result.scale.value is None else result.scale.value
    turn = 1.0 if result.turn.value is None else result.turn.value
    P = np.array(wheels.covariance)
    mean = 0.5 * (wheels.scale_left + wheels.scale_right)
    factors = np.zeros((2, 2))  # variances of both, relative
    before = np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]) / np.array([[mean], [wheels.base]])
    factors[0, 0] = result.scale.sigma**2 if result.scale.value is not None else (before @ P @ before.T)[0, 0]
    turn_variance = result.turn.sigma**2 if result.turn.value is not None else (before @ P @ before.T)[1, 1]
    base = wheels.base * scale / turn
    left, right = wheels.scale_left * scale, wheels.scale_right * scale
    J = np.array([[left, 0.0], [right, 0.0], [base, -base]])
    factors[1, 1] = turn_variance
    apart = np.array([0.5, -0.5, 0.0])
    difference = float(np.array([1.0, -1.0, 0.0]) @ P @ np.array([1.0, -1.0, 0.0]))
    covariance = J @ factors @ J.T + difference * np.outer(apart, apart)
    (a, b, c), (d, e, f), (g, h, i) = (0.5 * (covariance + covariance.T)).tolist()
    return replace(wheels, scale_left=left, scale_right=right, base=base, covariance=((a, b, c), (d, e, f), (g, h, i)))


def _inputs(arguments: argparse.Namespace) -> tuple[Survey, Calibration]:
    """The surveys as one, with the measured labels, and the calibration as it is; all mistakes at once."""
    problems: list[str] = []
    surveys = [collect(problems, partial(load_survey, path)) for path in arguments.surveys]
    points = {} if arguments.known is None else collect(problems, lambda: load_points(arguments.known))
    before: Calibration | None = Calibration()
    if arguments.calibration is not None and arguments.calibration.exists():
        before = collect(problems, lambda: load_calibration(arguments.calibration))
    if problems or points is None or before is None:
        raise InputError(*problems)
    survey = merge([one for one in surveys if one is not None])
    known = {one.label: one for one in survey.known_labels}
    for label, (position, sigma) in points.items():
        known[label] = KnownLabel(label, position) if sigma is None else KnownLabel(label, position, sigma)
    survey = replace(survey, known_labels=tuple(known.values()))
    check_survey(survey, ", ".join(str(path) for path in arguments.surveys))
    return survey, before


def _tell(arguments: argparse.Namespace, result: RigCalibration, before: Calibration) -> int:
    words = report(result, arguments.what)
    if arguments.report is not None:
        write_atomic(arguments.report, words.encode())
    print(json.dumps(_summary(result)) if arguments.json else words, end="\n" if arguments.json else "")
    if arguments.calibration is None:
        _say("nothing was written; --calibration FILE gets the result")
    else:
        _say(f"written to {arguments.calibration}; restart robotd to use it")
        names = {camera.name for camera in before.cameras}
        new = [camera.model.name for camera in result.cameras if camera.model.name not in names]
        if arguments.what == "rig" and before.cameras and new:
            _say(f"{', '.join(new)} is new there, with the lens that the survey has")
    return 0


def _say(words: str) -> None:
    print(f"robotd-solver calibrate: {words}", file=sys.stderr)


def _summary(result: RigCalibration) -> dict[str, Any]:
    return {
        "cameras": {
            camera.model.name: {
                "T_robot_camera": {
                    "rotation": list(camera.model.T_robot_camera.rotation),
                    "translation": list(camera.model.T_robot_camera.translation),
                },
                "sigma_in_rig": {"rotation_rad": camera.rig_sigma[0], "translation_m": camera.rig_sigma[1]},
                "sigma_on_robot": {"rotation_rad": camera.robot_sigma[0], "translation_m": camera.robot_sigma[1]},
                "sightings": len(camera.seen),
                "labels": camera.labels,
                "rms_px": camera.rms_px,
            }
            for camera in result.cameras
        },
        "whole_rig": {
            mode.name: {
                "moved": mode.change,
                "sigma": mode.sigma,
                "survey_sigma": mode.survey if np.isfinite(mode.survey) else None,
                "observable": mode.is_shown,
            }
            for mode in result.modes
        },
        "beacons": {
            name: {"position": list(place), "sigma_m": result.beacon_sigmas[name]}
            for name, place in result.beacons.items()
        },
        "beacon_distance": None if result.beacon_distance is None else list(result.beacon_distance),
        "roofs": {
            roof.name: {"H_world_image": roof.H_world_image, "moved_m": roof.moved, "sigma_m": roof.sigma}
            for roof in result.roofs
        },
        "odometry": {
            "scale": {"factor": result.scale.value, "sigma": result.scale.sigma},
            "turn": {"factor": result.turn.value, "sigma": result.turn.sigma},
        },
        "stops": result.stops,
        "known_labels": result.known,
        "explained": result.explained,
        "notes": list(result.notes),
    }
