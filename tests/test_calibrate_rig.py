"""Rigs, beacons and odometry from ordinary stops: accuracy, what cannot be seen, refusals, files."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from robotd.config import Calibration, load_calibration, save_calibration
from robotd.errors import InputError, SolverError
from robotd.files import save_survey
from robotd.geometry.homography import apply
from robotd.geometry.transforms import rotation_matrix, rotation_vector
from robotd.odometry import Wheels
from robotd.roof.setup import RoofCalibration, load_calibrations, save_calibration as save_roof
from robotd.solver.calibrate_rig import Bounds, calibrate_rig, camera_to_camera
from robotd.solver.rig_report import report
from robotd.solver.rig_start import merge, sphere
from robotd.solver_main import main
from tests.rig_course import CIRCLE, OUT_AND_BACK, ROOF_BEACONS, STRAIGHT_ON, WORLD, rig_survey
from tests.store_surveys import load, with_sightings

FAR_OFF = (np.radians(10.0), 0.05)


@cache
def course(**how):
    return rig_survey(load("warehouse"), **how)


def rig_errors(result, cameras):
    """Largest error of a camera's turn (degrees) and place (mm) to the first camera."""
    found = camera_to_camera([camera.model for camera in result.cameras])
    true = camera_to_camera([camera.model for camera in cameras])
    turn = np.linalg.norm(rotation_vector(found[0] @ true[0].transpose(0, 2, 1)), axis=1)
    return float(np.degrees(turn.max())), float(1e3 * np.linalg.norm(found[1] - true[1], axis=1).max())


def test_cameras_without_overlap_are_found_although_nominal_is_off_by_ten_degrees_and_no_label_is_known():
    survey, cameras, _, _ = course(seed=1, nominal=FAR_OFF)
    result = calibrate_rig(survey)
    degrees, millimetres = rig_errors(result, cameras)
    assert degrees < 0.1
    assert millimetres < 2.0
    words = report(result)
    assert "whole rig, height: not observable from this survey" in words
    assert "odometry's distances: not observable from this survey; measure two labels or use roof cameras" in words
    nominal = np.mean([camera.T_robot_camera.translation[2] for camera in survey.rig.cameras])
    found = np.mean([camera.model.T_robot_camera.translation[2] for camera in result.cameras])
    assert found == pytest.approx(nominal, abs=1e-3)


def test_known_labels_show_height_and_odometry_and_the_stated_uncertainties_hold():
    survey, cameras, _, factors = course(seed=2, nominal=FAR_OFF, known=30, roofs=True)
    result = calibrate_rig(survey)
    degrees, millimetres = rig_errors(result, cameras)
    assert degrees < 0.1
    assert millimetres < 1.5
    for found, true in zip(result.cameras, cameras, strict=True):
        pose, wanted = found.model.T_robot_camera, true.model.T_robot_camera
        turn = rotation_vector(rotation_matrix(pose.rotation) @ rotation_matrix(wanted.rotation).T)
        assert np.abs(turn).max() < 4.0 * found.robot_sigma[0] < np.radians(0.5)
        assert np.abs(np.subtract(pose.translation, wanted.translation)).max() < 4.0 * found.robot_sigma[1] < 0.005
    modes = {mode.name: mode for mode in result.modes}
    assert modes["height"].is_shown
    # the Cramer-Rao bound: 20 stops on a floor that slopes by 0.3 degrees
    assert result.floor_sigma == pytest.approx(np.radians(0.3) / np.sqrt(20.0), rel=1e-3)
    for name in ("roll", "pitch"):
        assert modes[name].survey == pytest.approx(result.floor_sigma, rel=0.05)
    assert "20 stops show them to +- 0.067 degrees at best (the Cramer-Rao bound), 36 to 0.05" in report(result)
    assert result.scale.value == pytest.approx(factors[0], abs=4.0 * result.scale.sigma)
    assert result.turn.value == pytest.approx(factors[1], abs=4.0 * result.turn.sigma)
    for name, place in ROOF_BEACONS.items():
        assert np.abs(np.subtract(result.beacons[name], place)).max() < 4.0 * result.beacon_sigmas[name] < 0.005
    length, sigma = result.beacon_distance
    assert length == pytest.approx(np.hypot(0.207, 0.005), abs=4.0 * sigma)
    assert sigma < 0.001


def test_homographies_are_corrected_with_the_rig():
    survey, cameras, _, _ = course(seed=5, nominal=FAR_OFF, known=12, roofs=True)
    H = np.array(survey.roof_cameras[0].H_world_image)
    bent = np.array([[1.003, 0.002, 0.02], [-0.001, 0.996, -0.015], [1e-4, -2e-4, 1.0]]) @ H
    wrong = replace(survey.roof_cameras[0], H_world_image=tuple(map(tuple, bent.tolist())))
    result = calibrate_rig(replace(survey, roof_cameras=(wrong,)))
    roof, pixels = result.roofs[0], np.array([[b.u, b.v] for s in survey.stops for b in s.beacon_sightings])
    off, left = (
        np.linalg.norm(apply(np.array(M), pixels) - apply(H, pixels), axis=1).mean() for M in (bent, roof.H_world_image)
    )
    assert off > 0.015
    assert left < 4.0 * roof.sigma < 0.03
    assert left < 0.4 * off
    assert rig_errors(result, cameras)[1] < 2.0


def test_the_rig_stays_where_it_was_measured_along_what_turns_on_the_spot_do_not_show():
    survey, _, _, _ = course(seed=0, pattern=CIRCLE)
    result = calibrate_rig(survey, Bounds(whole=(np.radians(0.2), 0.003)))
    hidden = {mode.name: mode for mode in result.modes if not mode.is_shown}
    assert set(hidden) == {"height", "yaw"}
    assert "whole rig, yaw: not observable from this survey" in report(result)
    assert abs(hidden["height"].change) < 1e-4
    assert abs(hidden["yaw"].change) < np.radians(0.2)


def test_a_rig_measured_amiss_as_a_whole_does_not_pull_along_what_the_survey_shows_much_better():
    survey, _, _, _ = course(seed=2, known=30)
    turn = rotation_matrix(
        [np.radians(1.5), np.radians(-1.5), np.radians(1.5)]
    )  # three sigma each, so no contradiction
    turned = tuple(
        replace(
            camera,
            T_robot_camera=replace(
                camera.T_robot_camera,
                rotation=tuple(rotation_vector(turn @ rotation_matrix(camera.T_robot_camera.rotation)).tolist()),
            ),
        )
        for camera in survey.rig.cameras
    )
    right, amiss = (calibrate_rig(one) for one in (survey, replace(survey, rig=replace(survey.rig, cameras=turned))))
    for a, b in zip(right.cameras, amiss.cameras, strict=True):
        R = [rotation_matrix(one.model.T_robot_camera.rotation) for one in (a, b)]
        assert np.degrees(np.abs(rotation_vector(R[0] @ R[1].T))).max() < 0.005
    assert not any(mode.contradicts for mode in amiss.modes)


def test_yaw_is_reported_with_the_bound_that_the_wheels_set():
    survey, _, _, _ = course(seed=2, known=30, pattern=OUT_AND_BACK)

    def rough(stop):
        if stop.move is None:
            return stop
        covariance = tuple(map(tuple, (4.0 * np.array(stop.move.covariance)).tolist()))
        return replace(stop, move=replace(stop.move, covariance=covariance))

    yaw = calibrate_rig(survey).modes[-1]
    result = calibrate_rig(replace(survey, stops=tuple(rough(stop) for stop in survey.stops)))
    assert 1.6 * yaw.survey < result.modes[-1].survey < 2.0 * yaw.survey
    words = report(result)
    assert f"better than +- {np.degrees(result.modes[-1].survey):.3f} degrees (the Cramer-Rao bound)" in words


def test_a_sphere_of_cameras_is_start_enough():
    survey, cameras, _, _ = course(seed=3, nominal=FAR_OFF)
    looks = {"front": 0.1, "left": 1.5, "rear": 3.0, "right": -1.6}
    degrees, millimetres = rig_errors(calibrate_rig(replace(survey, rig=sphere(survey.rig, looks, 0.08, 0.5))), cameras)
    assert degrees < 0.1
    assert millimetres < 2.0
    with pytest.raises(InputError, match=r"camera left: no heading[\s\S]*'top': the rig has front"):
        sphere(survey.rig, {"front": 0.0, "rear": 0.0, "right": 0.0, "top": 0.0}, 0.08, 0.5)


def test_wrong_sightings_are_left_out():
    survey, cameras, _, _ = course(seed=4, nominal=FAR_OFF, outliers=0.1)
    result = calibrate_rig(survey)
    assert 0.8 < result.explained < 0.98
    assert rig_errors(result, cameras)[0] < 0.1


def blind(survey, camera, seen):
    """The survey in which a camera has seen only labels that `seen` says."""
    return with_sightings(survey, lambda stop: [s for s in stop.sightings if s.camera != camera or seen(s.label)])


def test_what_is_missing_is_named():
    survey, _, _, _ = course(seed=0, nominal=FAR_OFF)
    with pytest.raises(SolverError, match="3 stops are too few; make 4 or more"):
        calibrate_rig(replace(survey, stops=survey.stops[:3]))
    with pytest.raises(SolverError, match="camera left saw 0 labels that another stop saw, too"):
        calibrate_rig(blind(survey, "left", lambda label: False))
    mine = {s.label for stop in survey.stops for s in stop.sightings if s.camera == "left"}
    alone = with_sightings(
        survey, lambda stop: [s for s in stop.sightings if s.camera == "left" or s.label not in mine]
    )
    with pytest.raises(SolverError, match=r"groups that share fewer than 3 labels|another stop saw, too"):
        calibrate_rig(alone)
    swapped = {"front": "left", "left": "front"}
    mistaken = with_sightings(
        survey, lambda stop: [replace(s, camera=swapped.get(s.camera, s.camera)) for s in stop.sightings]
    )
    assert "camera front looks where left was said to look: are they exchanged?" in calibrate_rig(mistaken).notes
    renamed = with_sightings(
        survey,
        lambda stop: [
            replace(s, label=f"{s.label[0]}{(k * 7 + stop.stop) % 40}") for k, s in enumerate(stop.sightings)
        ],
    )
    with pytest.raises(SolverError, match="of the sightings fit any rig near the given one"):
        calibrate_rig(renamed)


def test_a_robot_that_never_turned_is_told_to():
    survey, _, _, _ = course(seed=0, places=6, pattern=STRAIGHT_ON, world=replace(WORLD, wheel=1e-4))
    ahead = [stop for stop in survey.stops if abs(stop.odometry.heading - survey.stops[0].odometry.heading) < 0.3]
    with pytest.raises(SolverError, match="turn it on the spot between stops"):
        calibrate_rig(replace(survey, stops=tuple(ahead)))


def test_surveys_of_one_shop_are_calibrated_together_and_others_refused():
    survey, _, _, _ = course(seed=1, nominal=FAR_OFF)
    both = merge([survey, survey])
    assert [stop.leg for stop in both.stops] == [1] * 20 + [2] * 20
    other, _, _, _ = course(seed=2, nominal=FAR_OFF)
    with pytest.raises(InputError, match="different rigs"):
        merge([survey, other])


def test_the_commands_write_the_calibration_that_the_robot_reads(tmp_path, capsys):
    survey, _, _, factors = course(seed=2, nominal=FAR_OFF, known=30, roofs=True)
    save_survey(survey, tmp_path / "s.json")
    before = Calibration(cameras=survey.rig.cameras, beacons=dict(survey.rig.beacons), gamma=2.1)
    save_calibration(before, tmp_path / "c.toml")
    roof, cov = survey.roof_cameras[0], tuple(tuple(row) for row in (1e-12 * np.eye(9)).tolist())
    lens = (900.0, 900.0, 639.5, 479.5)
    save_roof(RoofCalibration(roof.name, roof.size, lens, roof.H_world_image, cov, 0.65), tmp_path / "roof.toml")
    common = [str(tmp_path / "s.json"), "--calibration", str(tmp_path / "c.toml"), "--json"]
    extra = ["--picture", str(tmp_path / "rig.png"), "--roof-calibration", str(tmp_path / "roof.toml")]
    assert main(["calibrate", "rig", *common, *extra]) == 0
    found = json.loads(capsys.readouterr().out)
    after = load_calibration(tmp_path / "c.toml")
    assert after.gamma == 2.1
    assert after.cameras[0].matrix == before.cameras[0].matrix
    assert list(after.cameras[1].T_robot_camera.rotation) == found["cameras"]["left"]["T_robot_camera"]["rotation"]
    assert after.priors.camera_rotation_rad == pytest.approx(
        max(one["sigma_in_rig"]["rotation_rad"] for one in found["cameras"].values()), rel=0.1
    )
    assert after.beacons["front"][0] == pytest.approx(ROOF_BEACONS["front"][0], abs=0.003)
    seen = load_calibrations(tmp_path / "roof.toml")[roof.name]
    assert seen.H_world_image == tuple(map(tuple, found["roofs"][roof.name]["H_world_image"]))
    centre = np.array([[b.u, b.v] for b in survey.stops[8].beacon_sightings])
    assert 0.0 < np.sqrt(seen.homography.to_plane(centre)[1][0, 0, 0]) < 0.02
    assert main(["calibrate", "rig", *common, *extra]) == 2  # the survey is of before
    assert "was calibrated anew since the survey" in capsys.readouterr().err
    assert (tmp_path / "rig.png").read_bytes()[:4] == b"\x89PNG"
    save_survey(replace(survey, rig=after.rig, priors=after.priors), tmp_path / "s.json")
    assert main(["calibrate", "odometry", *common, "--picture", str(tmp_path / "moves.png")]) == 0
    assert (tmp_path / "moves.png").read_bytes()[:4] == b"\x89PNG"
    odometry = json.loads(capsys.readouterr().out)["odometry"]
    wheels = load_calibration(tmp_path / "c.toml").wheels
    assert wheels.scale_left == wheels.scale_right == pytest.approx(factors[0], abs=0.008)
    base = Wheels().base * odometry["scale"]["factor"] / odometry["turn"]["factor"]
    assert wheels.base == pytest.approx(base, abs=1e-6)
    sigma = Wheels().base * np.hypot(odometry["scale"]["sigma"], odometry["turn"]["sigma"])
    assert wheels.base == pytest.approx(Wheels().base * factors[0] / factors[1], abs=4.0 * sigma)
    assert main(["calibrate", "odometry", *common]) == 2
    assert "was corrected from rig" in capsys.readouterr().err


def test_beacons_have_a_command_of_their_own_that_keeps_their_uncertainty(tmp_path, capsys):
    survey, _, _, _ = course(seed=2, known=30, roofs=True)
    save_survey(survey, tmp_path / "s.json")
    save_calibration(Calibration(cameras=survey.rig.cameras, beacons=dict(survey.rig.beacons)), tmp_path / "c.toml")
    asked = ["calibrate", "beacons", str(tmp_path / "s.json"), "--calibration", str(tmp_path / "c.toml")]
    assert main([*asked, "--picture", str(tmp_path / "b.png")]) == 0
    said, after = capsys.readouterr().out, load_calibration(tmp_path / "c.toml")
    assert "distance of the beacons: 0.20" in said
    assert "scale_left" not in (tmp_path / "c.toml").read_text() or after.wheels == Calibration().wheels
    for name, place in ROOF_BEACONS.items():
        assert after.beacons[name] == pytest.approx(place, abs=4.0 * after.priors.beacon_m)
    assert 0.0 < after.priors.beacon_m < 0.003
    assert (tmp_path / "b.png").read_bytes()[:4] == b"\x89PNG"


def test_a_survey_that_does_not_show_the_beacons_is_told_what_it_lacks(tmp_path, capsys):
    survey, _, _, _ = course(seed=2, known=30, roofs=True)
    unseen = tuple(replace(stop, beacon_sightings=()) for stop in survey.stops)
    for lacking, words in (
        (replace(survey, stops=unseen, roof_cameras=()), "it has no roof cameras"),
        (replace(survey, stops=unseen, rig=replace(survey.rig, beacons={})), "its rig has no beacons"),
        (replace(survey, stops=survey.stops[:2] + unseen[2:]), "beacon front was seen at 2 stops; 3 or more"),
    ):
        save_survey(lacking, tmp_path / "s.json")
        assert main(["calibrate", "beacons", str(tmp_path / "s.json")]) == 1
        assert words in capsys.readouterr().err
