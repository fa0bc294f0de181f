"""What a survey states too small or too large is found by how the map fits it, widened, and named."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.transforms import rotation_matrix, rotation_vector
from robotd.records import KnownLabel, Transform
from robotd.solver import solve
from tests.store_surveys import World, load, simulate

WORLD = World(reflections=0.0, slip=0.0)


def survey_of(store, seed=4):
    return simulate(load(store), seed, WORLD)


def with_covariances(survey, change):
    def changed(stop):
        if stop.move is None:
            return stop
        rows = tuple(map(tuple, change(np.array(stop.move.covariance)).tolist()))
        return replace(stop, move=replace(stop.move, covariance=rows))

    return replace(survey, stops=tuple(map(changed, survey.stops)))


def with_priors(survey, factor, names):
    changed = {name: factor * getattr(survey.priors, name) for name in names}
    return replace(survey, priors=replace(survey.priors, **changed))


def nees(result, truth):
    labels = [m for m in result.labels if m.status == "placed"]
    assert len(labels) > 0.75 * len(truth)
    errors = np.array([np.subtract(m.position, truth[m.label]) for m in labels])
    covariances = np.array([m.covariance for m in labels])
    return float(np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors).mean() / 3.0)


RIG, LENS = ("camera_rotation_rad", "camera_translation_m"), ("focal_px", "centre_px")


@pytest.mark.parametrize(
    ("store", "change", "said"),
    [
        ("warehouse", lambda s: with_covariances(s, lambda c: c / 100.0), "moves scatter"),
        ("room", lambda s: with_covariances(s, lambda c: np.diag(np.diag(c) ** 2)), "moves scatter"),
        ("room", lambda s: with_covariances(s, np.zeros_like), "moves scatter"),
        ("warehouse", lambda s: with_priors(s, 0.1, RIG), "direction came out"),
        ("warehouse", lambda s: with_priors(s, 0.1, LENS), "lens came out"),
        ("room", lambda s: with_priors(s, 0.1, ["tilt_rad"]), "the floor's tilts came out"),
    ],
    ids=["covariances", "squares", "exact moves", "rig", "lens", "tilt"],
)
def test_what_is_stated_too_small_is_widened_and_named(store, change, said):
    survey, truth = survey_of(store)
    result = solve(change(survey))
    assert any(said in note and "widened" in note for note in result.notes), result.notes
    assert nees(result, truth) < max(3.0, 1.5 * nees(solve(survey), truth))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: with_covariances(s, lambda c: np.diag(np.sqrt(np.diag(c)))), "moves: the survey fits"),
        (lambda s: with_priors(s, np.degrees(1.0), ["tilt_rad"]), "the floor's tilts: the survey fits"),
        (lambda s: with_priors(s, 1000.0, ["camera_translation_m"]), "the cameras' place: the survey fits"),
    ],
    ids=["standard deviations", "degrees", "millimetres"],
)
def test_what_is_stated_far_too_large_is_named(change, said):
    survey, truth = survey_of("warehouse")
    result = solve(change(survey))
    assert any(said in note for note in result.notes), result.notes
    assert nees(result, truth) < 3.0


def test_one_camera_that_stands_elsewhere_is_found_and_bends_nothing():
    survey, truth = survey_of("warehouse")

    def moved(camera):
        mount = camera.T_robot_camera
        x, y, z = mount.translation
        return replace(camera, T_robot_camera=Transform(mount.rotation, (x + 0.05, y, z)))

    cameras = tuple(moved(c) if c.name == "front" else c for c in survey.rig.cameras)
    result = solve(replace(survey, rig=replace(survey.rig, cameras=cameras)))
    assert any("camera front's place came out" in note for note in result.notes), result.notes
    assert nees(result, truth) < max(3.0, 1.5 * nees(solve(survey), truth))


@pytest.mark.parametrize(
    ("turn", "shift", "said"),
    [(np.radians(2.0), 0.0, "the cameras' direction came out"), (0.0, 0.3, "the cameras' place came out")],
    ids=["askew", "aside"],
)
def test_a_rig_that_sits_askew_or_aside_is_found_and_moves_are_not_blamed(turn, shift, said):
    survey, truth = survey_of("room")
    R = rotation_matrix(np.array([0.0, 0.0, turn]))

    def moved(camera):
        mount = camera.T_robot_camera
        rotation = tuple(rotation_vector(R @ rotation_matrix(mount.rotation)).tolist())
        return replace(
            camera, T_robot_camera=Transform(rotation, tuple((R @ mount.translation + [0, shift, 0]).tolist()))
        )

    cameras = tuple(map(moved, survey.rig.cameras))
    result = solve(replace(survey, rig=replace(survey.rig, cameras=cameras)))
    assert any(said in note for note in result.notes), result.notes
    assert nees(result, truth) < 3.0


def test_known_labels_that_are_less_exact_than_stated_do_not_bend_the_map():
    survey, truth = survey_of("warehouse")
    rng = np.random.default_rng(1)
    known = tuple(
        KnownLabel(label, tuple((np.array(truth[label]) + rng.normal(0.0, 0.01, 3)).tolist()), 0.001)
        for label in sorted(truth)[::5]
    )
    result = solve(replace(survey, known_labels=known))
    assert any("known labels came out" in note for note in result.notes), result.notes
    assert nees(result, truth) < 3.0


@pytest.mark.parametrize("store", ["room", "warehouse"])
def test_a_survey_that_is_as_it_says_is_left_as_it_is(store):
    for seed in range(5):
        survey, _ = simulate(load(store), seed, World())
        assert not any("widened" in note or "better than stated" in note for note in solve(survey).notes)
