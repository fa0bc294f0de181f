"""Surveys with a mistake of who wrote them: named in the map's notes, and never a map that is silently wrong."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.transforms import heading_matrix, rotation_matrix, rotation_vector, se2_inverse
from robotd.records import KnownLabel, Transform
from robotd.solver import solve
from robotd.solver.readings import with_moves, with_pixels
from tests.store_surveys import World, in_legs, load, simulate

WORLD = World(reflections=0.05, slip=0.0)


def survey_of(store, seed=1, world=WORLD):
    return simulate(load(store), seed, world)


def zoomed(factor):
    return lambda survey: with_pixels(survey, lambda s: (factor * s.u, factor * s.v))


def focal(factor):
    def change(survey):
        cameras = [replace(c, matrix=(*(factor * f for f in c.matrix[:2]), *c.matrix[2:])) for c in survey.rig.cameras]
        return replace(survey, rig=replace(survey.rig, cameras=tuple(cameras)))

    return change


def turned(survey):
    R = rotation_matrix(np.array([0.0, 0.0, 0.5 * np.pi]))
    cameras = []
    for c in survey.rig.cameras:
        rotation = rotation_vector(R @ rotation_matrix(c.T_robot_camera.rotation))
        cameras.append(
            replace(c, T_robot_camera=Transform(tuple(rotation), tuple(R @ np.array(c.T_robot_camera.translation))))
        )
    return replace(survey, rig=replace(survey.rig, cameras=tuple(cameras)))


@pytest.mark.parametrize(
    ("store", "change", "said"),
    [
        ("room", zoomed(0.9), "focal lengths 0.9"),
        ("room", focal(1.05), "focal lengths 0.95"),
        ("room", lambda s: with_pixels(s, lambda x: (x.u + 20.0, x.v)), "centres 20 px aside"),
        ("room", lambda s: with_moves(s, 1.1, 1.1, 1.0), "the moves times 0.9"),
        ("room", lambda s: with_moves(s, 0.3048, 0.3048, 1.0), "the moves times 3.28"),
        ("warehouse", lambda s: with_moves(s, 3.28084, 3.28084, 1.0), "the moves read as feet"),
        ("room", lambda s: with_moves(s, 1.0, 1.0, -1.0), "turns of the moves counted clockwise"),
        ("room", turned, "the whole rig turned by 270 degrees"),
    ],
    ids=["smaller", "focal", "cropped", "wheels", "feet", "long feet", "clockwise", "turned"],
)
def test_the_mistake_is_named_and_nothing_is_placed(store, change, said):
    survey, _ = survey_of(store)
    result = solve(change(survey))
    assert any(said in note for note in result.notes), result.notes
    assert not any(label.status == "placed" for label in result.labels)


def test_one_camera_with_pictures_of_another_size_is_named_and_costs_only_its_labels():
    survey, truth = survey_of("room")
    result = solve(with_pixels(survey, lambda s: (0.9 * s.u, 0.9 * s.v) if s.camera == "left" else (s.u, s.v)))
    assert any("camera left's sightings" in note for note in result.notes)
    wrong = [
        m.label for m in result.labels if m.position and np.linalg.norm(np.subtract(m.position, truth[m.label])) > 0.05
    ]
    assert not wrong


def with_ways(survey, change):
    """The survey with its moves changed as an (M, 3) array."""
    moves = [stop.move for stop in survey.stops[1:]]
    ways = change(np.array([[m.dx, m.dy, m.dheading] for m in moves]))
    moves = [
        replace(m, dx=x, dy=y, dheading=t, by_errors=None) for m, (x, y, t) in zip(moves, ways.tolist(), strict=True)
    ]
    stops = [replace(stop, move=move) for stop, move in zip(survey.stops[1:], moves, strict=True)]
    return replace(survey, stops=(survey.stops[0], *stops))


def in_first_axes(ways):
    heading = np.concatenate([[0.0], np.cumsum(ways[:-1, 2])])
    return np.column_stack([(heading_matrix(heading) @ ways[:, :2, None])[:, :, 0], ways[:, 2]])


def in_own_axes(ways):
    return np.column_stack([(heading_matrix(-ways[:, 2]) @ ways[:, :2, None])[:, :, 0], ways[:, 2]])


@pytest.mark.parametrize(
    ("store", "change", "said"),
    [
        ("warehouse", lambda w: np.roll(w, -1, axis=0), "the moves one stop later"),
        ("room", lambda w: np.roll(w, 1, axis=0), "the moves one stop earlier"),
        ("warehouse", in_first_axes, "in the axes of each leg's first stop"),
        ("room", in_own_axes, "in the axes of the robot after them"),
        ("room", se2_inverse, "back to the stop before"),
    ],
    ids=["early", "late", "world axes", "own axes", "backwards"],
)
def test_moves_of_other_stops_or_in_other_axes_are_named_and_nothing_is_placed(store, change, said):
    survey, _ = survey_of(store)
    result = solve(with_ways(survey, change))
    assert any(said in note for note in result.notes), result.notes
    assert not any(label.status == "placed" for label in result.labels)


def test_a_camera_that_stands_a_metre_from_where_it_should_costs_its_sightings_alone():
    survey, truth = survey_of("warehouse")

    def moved(camera):
        mount = camera.T_robot_camera
        return replace(camera, T_robot_camera=replace(mount, translation=(1.0, *mount.translation[1:])))

    cameras = tuple(moved(c) if c.name == "left" else c for c in survey.rig.cameras)
    result = solve(replace(survey, rig=replace(survey.rig, cameras=cameras)))
    assert any("camera left's sightings" in note and "not used" in note for note in result.notes), result.notes
    errors = [np.linalg.norm(np.subtract(m.position, truth[m.label])) for m in result.labels if m.status == "placed"]
    assert len(errors) > 0.6 * len(truth)
    assert max(errors) < 0.1


def test_sightings_of_two_stops_that_were_exchanged_are_named_and_not_used():
    survey, truth = survey_of("warehouse")
    stops = list(survey.stops)
    stops[4] = replace(stops[4], sightings=survey.stops[5].sightings)
    stops[5] = replace(stops[5], sightings=survey.stops[4].sightings)
    result = solve(replace(survey, stops=tuple(stops)))
    wrong = [
        m.label
        for m in result.labels
        if m.status == "placed" and np.linalg.norm(np.subtract(m.position, truth[m.label])) > 0.1
    ]
    assert not wrong
    assert any("leg/stop 1/5" in note or "leg 1 stop 5" in note for note in result.notes), result.notes


def test_exchanged_cameras_are_named_and_nothing_is_placed():
    survey, _ = survey_of("warehouse")
    other = {"left": "right", "right": "left"}
    stops = [
        replace(stop, sightings=tuple(replace(s, camera=other.get(s.camera, s.camera)) for s in stop.sightings))
        for stop in survey.stops
    ]
    result = solve(replace(survey, stops=tuple(stops)))
    assert any("cameras left and right exchanged" in note for note in result.notes), result.notes
    assert not any(label.status == "placed" for label in result.labels)


def measured(truth, labels, change):
    return tuple(KnownLabel(label, tuple(map(float, change(np.array(truth[label]))))) for label in labels)


@pytest.mark.parametrize(("store", "count"), [("room", 3), ("room", 8), ("warehouse", 3)])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: p * [1.0, -1.0, 1.0], "mirrored"),
        (lambda p: p[[1, 0, 2]], "mirrored"),
        (lambda p: p * [0.9, 0.9, 1.0], "times 1.1"),
    ],
    ids=["y to the right", "x and y exchanged", "another unit"],
)
def test_known_labels_that_are_all_wrong_alike_do_not_make_the_world(store, count, change, said):
    survey, truth = survey_of(store)
    labels = sorted(truth)[:: len(truth) // count][:count]
    result = solve(replace(survey, known_labels=measured(truth, labels, change)))
    assert result.frame == "first stop"
    assert any("known labels contradict" in note and said in note for note in result.notes), result.notes
    errors = [np.linalg.norm(np.subtract(m.position, truth[m.label])) for m in result.labels if m.status == "placed"]
    assert len(errors) > 0.9 * len(truth)
    assert max(errors) < 0.1


def test_known_labels_along_a_line_come_with_a_caution_because_nothing_shows_a_mirrored_axis():
    survey, truth = survey_of("room")
    row = [label for label in sorted(truth) if label.startswith("S")][:4]
    noted = solve(replace(survey, known_labels=measured(truth, row, lambda p: p))).notes
    assert any("hang along one line" in note for note in noted)
    spread = sorted(truth)[::7]
    noted = solve(replace(survey, known_labels=measured(truth, spread, lambda p: p))).notes
    assert not any("hang along one line" in note for note in noted)


@pytest.mark.parametrize("store", ["room", "warehouse"])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_wrong_sightings_slips_and_noise_are_no_mistake_of_who_wrote_the_survey(store, share):
    survey, _ = simulate(load(store), 11, World(wheel=0.006), outliers=share)
    notes = solve(survey).notes
    assert not any("check" in note for note in notes), notes


def test_legs_of_two_stores_are_told_apart_and_nothing_is_placed():
    survey, truth = survey_of("room")
    other, _ = survey_of("room", 2)
    names = sorted(truth)
    ids = dict(zip(names, [*names[11:], *names[:11]], strict=True))
    stops = [
        replace(stop, leg=2, sightings=tuple(replace(s, label=ids[s.label]) for s in stop.sightings))
        for stop in other.stops
    ]
    result = solve(replace(survey, stops=(*survey.stops, *stops)))
    assert any("each leg fits by itself" in note for note in result.notes), result.notes
    assert not any(label.status == "placed" for label in result.labels)


def test_labels_that_hung_elsewhere_for_the_second_leg_are_not_placed_in_between():
    survey, truth = survey_of("room")
    legs = in_legs(survey, len(survey.stops) // 2)
    moved = [label for label in sorted(truth) if label.startswith("S")]
    after = dict(zip(moved, [*moved[3:], *moved[:3]], strict=True))
    stops = [
        stop
        if stop.leg == 1
        else replace(stop, sightings=tuple(replace(s, label=after.get(s.label, s.label)) for s in stop.sightings))
        for stop in legs.stops
    ]
    before = {now: truth[was] for was, now in after.items()}
    for m in solve(replace(legs, stops=tuple(stops))).labels:
        if m.status == "placed":
            places = [truth[m.label], before.get(m.label, truth[m.label])]
            assert min(np.linalg.norm(np.subtract(m.position, place)) for place in places) < 0.05, m


def test_known_labels_of_which_those_along_a_line_are_left_do_not_mirror_the_world():
    survey, truth = survey_of("room")
    row = [label for label in sorted(truth) if label.startswith("S")][:3]
    aside = next(label for label in sorted(truth) if label.startswith("N"))
    result = solve(replace(survey, known_labels=measured(truth, [*row, aside], lambda p: p * [1.0, -1.0, 1.0])))
    assert any("mirrored" in note for note in result.notes), result.notes
    errors = [np.linalg.norm(np.subtract(m.position, truth[m.label])) for m in result.labels if m.status == "placed"]
    assert len(errors) > 0.9 * len(truth)
    assert max(errors) < 0.1


def with_mounts(survey, change):
    cameras = [
        replace(c, T_robot_camera=replace(c.T_robot_camera, translation=change(*c.T_robot_camera.translation)))
        for c in survey.rig.cameras
    ]
    return replace(survey, rig=replace(survey.rig, cameras=tuple(cameras)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: with_mounts(s, lambda x, y, z: (x, y, 0.0)), "stands on the floor"),
        (lambda s: with_mounts(s, lambda x, y, z: (x + 1.5, y, z)), "from the robot's middle"),
        (lambda s: replace(s, priors=replace(s.priors, camera_translation_m=1.0)), "priors.camera_translation_m is 1"),
        (lambda s: replace(s, known_labels=(KnownLabel("S02", (0.0, 0.0, 1.0), 2.5e-5),)), "which nobody measures"),
        (lambda s: replace(s, known_labels=(KnownLabel("s02 ", (0.0, 0.0, 1.0), 0.005),)), "only in case or spaces"),
    ],
    ids=["height", "aside", "prior", "exact", "names"],
)
def test_what_is_possible_and_seldom_meant_is_noted(change, said):
    survey, _ = survey_of("room")
    assert any(said in note for note in solve(change(survey)).notes)
