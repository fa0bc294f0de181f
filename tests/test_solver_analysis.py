"""What is said about a survey before solving and about a map afterwards; surveys that fit nothing."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.errors import InputError
from robotd.files import save_survey
from robotd.records import KnownLabel
from robotd.solver import solve
from robotd.solver.analysis import analyse, analysis_text, ellipsoid, observability
from robotd.solver_main import main
from tests.store_surveys import World, in_legs, label_of, load, noisy_room, quiet_room, simulate, with_sightings


def test_the_ellipsoid_holds_its_share():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(3, 3))
    drawn = rng.normal(size=(40_000, 3)) @ A.T
    found = ellipsoid(A @ A.T)
    assert found.axes_m == tuple(sorted(found.axes_m, reverse=True))
    inside = (((drawn @ np.array(found.directions).T) / found.axes_m) ** 2).sum(axis=1) < 1.0
    assert inside.mean() == pytest.approx(0.95, abs=0.005)
    with pytest.raises(ValueError, match="covariance"):
        ellipsoid(np.eye(2))


def test_a_good_survey_has_nothing_to_complain_of():
    survey, truth = noisy_room()
    assert observability(survey) == ()
    result, analysis = analyse(survey)
    assert result == solve(survey)
    assert analysis.after == ()
    assert 0.001 < analysis.probability < 0.999
    assert set(analysis.ellipsoids) == set(truth)
    assert 0.001 < analysis.scale < 0.005  # wheels and their calibration: 0.3 % each
    text = analysis_text(analysis)
    assert "camera front: stated 0.1 px" in text
    assert "odometry" in text


def test_standard_deviations_are_estimated_per_sensor():
    world = World(reflections=0.0, wrong_ids=0.0, slip=0.0)
    factors = {}
    for seed in range(6):
        survey, _ = simulate(load("room"), seed, world)
        survey = replace(survey, priors=replace(survey.priors, tilt_rad=world.tilt / 3.0))
        moves = [
            s.move and replace(s.move, covariance=tuple(tuple(16.0 * v for v in row) for row in s.move.covariance))
            for s in survey.stops
        ]
        survey = replace(survey, stops=tuple(replace(s, move=m) for s, m in zip(survey.stops, moves, strict=True)))
        for sensor in analyse(survey)[1].sensors:
            if sensor.factor is not None:
                factors.setdefault(sensor.sensor, []).append(sensor.factor)
    middle = {name: float(np.median(values)) for name, values in factors.items()}
    assert middle["tilt of the floor"] == pytest.approx(3.0, rel=0.25)
    assert middle["odometry (heading)"] == pytest.approx(0.25, rel=0.25)
    assert middle["camera left"] == pytest.approx(1.0, rel=0.15)


def test_a_sensor_that_is_worse_than_stated_is_named():
    survey, _ = simulate(load("room"), 3, World(slip=0.0))
    bold = replace(survey, priors=replace(survey.priors, tilt_rad=World.tilt / 3.0))
    _, analysis = analyse(bold)
    assert any(text.startswith("tilt of the floor: residuals show") for text in analysis.after)


def test_parts_that_nothing_joins_are_named_before_solving():
    survey, _ = quiet_room()
    apart = with_sightings(
        in_legs(survey, 4), lambda stop: [replace(s, label=f"{s.label}-{stop.leg}") for s in stop.sightings]
    )
    assert any("falls into 2 parts" in text and "2/1, 2/2, 2/3" in text for text in observability(apart))
    assert observability(in_legs(survey, 4)) == ()


def test_a_free_scale_is_named():
    survey, _ = quiet_room()
    still = tuple(replace(s, leg=s.stop, stop=1, move=None) for s in survey.stops)
    assert any("nothing shows the size" in text for text in observability(replace(survey, stops=still)))
    coarse, _ = simulate(load("room"), 2, World(reflections=0.0, reach=2.5, centroid_px=2.0))
    _, analysis = analyse(replace(coarse, priors=replace(coarse.priors, odometry_scale=0.2)))
    assert analysis.scale > 0.015
    assert any("size of the map is known to" in text for text in analysis.after)


def test_known_labels_that_hold_nothing_are_named():
    survey, truth = quiet_room()
    one = (KnownLabel("S02", truth["S02"]),)
    assert any("do not fix the world frame" in text for text in observability(replace(survey, known_labels=one)))
    level = tuple(KnownLabel(label, (*truth[label][:2], 0.5)) for label in ("S02", "E10"))
    assert any("camera height" in text for text in observability(replace(survey, known_labels=level)))


def test_a_label_far_outside_is_pointed_out_because_it_may_be_an_image():
    survey, _ = simulate(load("room"), 2, World(reflections=0.0, wrong_ids=0.0, reach=2.5))
    store = load("room")
    store["labels"].append({"id": "OUT", "position": [1.5, -1.2, 0.9], "normal": [0.0, 1.0, 0.0]})
    store["walls"], store["shelves"] = [], []
    survey, _ = simulate(store, 2, World(reflections=0.0, wrong_ids=0.0, reach=6.0))
    result, analysis = analyse(survey)
    assert label_of(result, "OUT").status == "placed"
    assert any("OUT by" in text and "glass" in text for text in analysis.after)


@pytest.mark.parametrize(("one", "other"), [("front", "left"), ("left", "right"), ("front", "rear")])
def test_exchanged_cameras_are_named_and_place_nothing_wrongly(one, other):
    survey, truth = simulate(load("warehouse"), 3)
    names = {one: other, other: one}
    wrong = with_sightings(
        survey, lambda stop: [replace(s, camera=names.get(s.camera, s.camera)) for s in stop.sightings]
    )
    result = solve(wrong)
    assert any(f"with cameras {one} and {other} exchanged" in note for note in result.notes)
    for label in result.labels:
        if label.position is not None:
            assert np.linalg.norm(np.subtract(label.position, truth[label.label])) < 0.1


def test_sightings_that_fit_nothing_place_nothing():
    survey, _ = simulate(load("warehouse"), 3)
    result = solve(with_sightings(survey, lambda stop: [replace(s, u=s.v, v=s.u) for s in stop.sightings]))
    assert any("sightings fit any map" in note for note in result.notes)
    assert not any(label.status == "placed" for label in result.labels)


def test_moves_in_feet_are_named_and_nothing_is_placed():
    survey, _ = simulate(load("warehouse"), 3, World(slip=0.0))
    feet = 1.0 / 0.3048
    stops = [
        replace(s, move=s.move and replace(s.move, dx=feet * s.move.dx, dy=feet * s.move.dy)) for s in survey.stops
    ]
    result = solve(replace(survey, stops=tuple(stops)))
    assert any("the moves read as feet" in note for note in result.notes)
    assert not any(label.status == "placed" for label in result.labels)


def test_pictures_that_stand_on_their_head_put_labels_below_the_floor():
    survey, _ = simulate(load("warehouse"), 3, World(slip=0.0))
    result = solve(with_sightings(survey, lambda stop: [replace(s, v=479.0 - s.v) for s in stop.sightings]))
    assert any("come out below the floor" in note for note in result.notes)
    assert not any(label.status == "placed" for label in result.labels)


def test_two_labels_with_exchanged_ids_at_some_stops_are_in_conflict():
    survey, _ = quiet_room()
    names = {"S04": "S05", "S05": "S04"}
    stops = [s.stop for s in survey.stops if {g.label for g in s.sightings} >= {"S04", "S05"}][:4]
    assert len(stops) == 4

    def change(stop):
        first = {s.label: s for s in reversed(stop.sightings)}
        kept = [s for s in stop.sightings if s.label not in names or (stop.stop in stops and first[s.label] is s)]
        return [replace(s, label=names.get(s.label, s.label)) if stop.stop in stops[2:] else s for s in kept]

    result = solve(with_sightings(survey, change))
    reasons = [label_of(result, label).reason for label in names]
    assert all(reason is not None and reason.startswith("conflicting identities") for reason in reasons), reasons


def in_millimetres(survey):
    move = survey.stops[2].move
    return replace(
        survey, stops=(*survey.stops[:2], replace(survey.stops[2], move=replace(move, dx=1e3)), *survey.stops[3:])
    )


def mounted_in_degrees(survey):
    first, *rest = survey.rig.cameras
    mount = replace(first.T_robot_camera, rotation=(-69.3, 69.3, -69.3))
    return replace(survey, rig=replace(survey.rig, cameras=(replace(first, T_robot_camera=mount), *rest)))


def normalised(survey):
    first, *rest = survey.rig.cameras
    return replace(survey, rig=replace(survey.rig, cameras=(replace(first, matrix=(0.42, 0.56, 0.5, 0.5)), *rest)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (in_millimetres, r"stops\[2\].move \(leg 1 stop 3\).dx, dy: found 1000; .* metres; are these millimetres"),
        (mounted_in_degrees, r"rig.cameras\[0\].T_robot_camera.rotation: found 120.* radians; are these degrees"),
        (normalised, r"rig.cameras\[0\].matrix: found a focal length of 0.42; expected pixels"),
        (
            lambda survey: replace(survey, known_labels=(KnownLabel("S02", (1200.0, 3400.0, 800.0)),)),
            r"known_labels\[0\].position\[2\]: found 800; .* are these millimetres",
        ),
        (
            lambda survey: replace(survey, priors=replace(survey.priors, tilt_rad=1.5)),
            r"priors.tilt_rad: found 1.5; .* are these degrees",
        ),
    ],
)
def test_other_units_are_named_with_file_and_field(change, said, tmp_path, capsys):
    survey = change(quiet_room()[0])
    with pytest.raises(InputError, match=said):
        solve(survey)
    save_survey(survey, tmp_path / "survey.json")
    assert main(["solve", str(tmp_path / "survey.json")]) == 2
    assert capsys.readouterr().err.startswith(f"robotd-solver: {tmp_path / 'survey.json'} ")


def test_the_report_is_written_beside_the_map(tmp_path):
    save_survey(noisy_room()[0], tmp_path / "survey.json")
    arguments = ["solve", str(tmp_path / "survey.json"), "-o", str(tmp_path / "map.json")]
    assert main([*arguments, "--report", str(tmp_path / "report.txt")]) == 0
    assert "chi-square" in (tmp_path / "report.txt").read_text()
    assert main([*arguments, "--report", str(tmp_path / "report.txt"), "--method", "linear"]) == 2
