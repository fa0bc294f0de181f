"""Surveys with a mistake of who wrote them: named in the map's notes, and never a map that is silently wrong."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.transforms import rotation_matrix, rotation_vector
from robotd.records import KnownLabel, Transform
from robotd.solver import solve
from robotd.solver.readings import with_moves, with_pixels
from tests.store_surveys import World, load, simulate

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
        ("room", lambda s: with_moves(s, 1.0, 1.0, -1.0), "turns of the moves counted clockwise"),
        ("room", turned, "the whole rig turned by 270 degrees"),
    ],
    ids=["smaller", "focal", "cropped", "wheels", "feet", "clockwise", "turned"],
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
