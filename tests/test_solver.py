"""The solver on surveys that are simulated from the store layouts: whole maps, and broken surveys."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from robotd.errors import InputError, SolverError
from robotd.geometry.transforms import (
    se2_relative,
)
from robotd.records import (
    Move,
    Pose,
    Sighting,
)
from robotd.solver import evaluate, solve
from tests.store_surveys import (
    QUIET,
    WHEEL_BASE,
    World,
    covariance,
    load,
    nees,
    noisy_room,
    quiet_room,
    simulate,
    with_sightings,
)


@pytest.mark.parametrize("store", ["room", "warehouse"])
def test_without_noise_every_label_is_recovered_exactly(store):
    survey, truth = simulate(load(store), world=QUIET)
    result = solve(survey)
    assert {label.status for label in result.labels} == {"placed"}
    score = evaluate(result, truth)
    assert score.labels_placed == len(truth)
    assert score.error_mm["max"] < 0.01
    assert result.cost < 1e-3
    assert result.solver.converged


@pytest.mark.parametrize(
    ("store", "reach", "mean_mm", "least"), [("room", 2.5, 25.0, 29), ("warehouse", 3.5, 70.0, 42)]
)
def test_the_simulated_world_is_mapped_within_the_promised_error(store, reach, mean_mm, least):
    consistency = []
    for seed in range(4):
        survey, truth = simulate(load(store), seed, World(reach=reach))
        result = solve(survey)
        score = evaluate(result, truth)
        assert score.labels_placed >= least
        assert score.error_mm["mean"] < 0.5 * mean_mm
        assert score.error_mm["max"] < 2.0 * mean_mm
        assert score.error_mm["mean"] < 0.5 * evaluate(solve(survey, "linear"), truth).error_mm["mean"]
        consistency += nees(result, truth)
    assert 0.2 < np.mean(consistency) < 2.5


@pytest.mark.parametrize("store", ["room", "warehouse"])
@pytest.mark.parametrize("share", [0.1, 0.3])
def test_reflections_and_wrong_identities_do_not_move_the_map(store, share):
    world = World(reflections=0.0, wrong_ids=0.0)
    survey, truth = simulate(load(store), 1, world, outliers=share)
    score = evaluate(solve(survey), truth)
    errors = np.array(list(score.errors_mm.values()))
    # with a third of the sightings wrong, many labels keep one or two, which nothing confirms
    assert score.labels_placed >= (0.95 if share < 0.2 else 0.55) * len(truth)
    assert np.median(errors) < 30.0
    assert (errors > 100.0).mean() <= 0.03


def test_odometry_poses_as_poor_as_the_thesis_start_do_not_matter():
    survey, truth = noisy_room()
    rng = np.random.default_rng(5)

    def moved(stop):
        x, y, heading = rng.normal([stop.odometry.x, stop.odometry.y, stop.odometry.heading], [0.2, 0.2, np.pi / 20])
        return stop if stop.stop == 1 else replace(stop, odometry=Pose(x, y, heading))

    poor = replace(survey, stops=tuple(moved(stop) for stop in survey.stops))
    assert evaluate(solve(poor), truth).errors_mm == pytest.approx(evaluate(solve(survey), truth).errors_mm, abs=0.1)


def test_even_moves_as_poor_as_the_thesis_start_find_the_shape():
    survey, truth = simulate(load("room"), 4, World(slip=0.0))
    rng = np.random.default_rng(4)
    poses = np.array([[s.odometry.x, s.odometry.y, s.odometry.heading] for s in survey.stops])
    poses[1:] += rng.normal(0.0, [0.2, 0.2, np.pi / 20], (len(poses) - 1, 3))
    P = covariance(np.diag([0.08, 0.08, 2.0 * (np.pi / 20) ** 2]))
    moves = [None, *(Move(*map(float, se2_relative(a, b)), P) for a, b in pairwise(poses))]
    stops = tuple(
        replace(s, move=m, odometry=Pose(*map(float, p))) for s, m, p in zip(survey.stops, moves, poses, strict=True)
    )
    result = solve(replace(survey, stops=stops))
    mapped = np.array([label.position for label in result.labels])
    true = np.array([truth[label.label] for label in result.labels])
    # the guesses leave the scale nearly free: compare after undoing it
    scale = np.linalg.norm(true - true.mean(axis=0)) / np.linalg.norm(mapped - mapped.mean(axis=0))
    scaled = replace(
        result, labels=tuple(replace(m, position=tuple(scale * np.array(m.position))) for m in result.labels)
    )
    assert evaluate(scaled, truth, align="se3").error_mm["max"] < 15.0


def test_a_wheel_slip_is_named_and_does_not_bias_the_map():
    survey, truth = simulate(load("room"), 3, World(reach=2.5, slip=0.0))
    clean = evaluate(solve(survey), truth).error_mm["mean"]
    slipped = list(survey.stops)
    move = slipped[3].move
    slipped[3] = replace(slipped[3], move=replace(move, dx=move.dx + 0.015, dheading=move.dheading + 0.03 / WHEEL_BASE))
    result = solve(replace(survey, stops=tuple(slipped)))
    assert any("leg 1 stop 4" in note and "wheel slip" in note for note in result.notes)
    assert evaluate(result, truth).error_mm["mean"] < clean + 3.0


def test_solving_is_deterministic():
    survey, _ = noisy_room()
    assert solve(survey) == solve(survey)


def test_a_survey_without_sightings_still_gives_the_path():
    survey, _ = quiet_room()
    result = solve(with_sightings(survey, lambda stop: []))
    assert result.labels == ()
    assert any("no usable sightings" in note for note in result.notes)
    for stop, asked in zip(result.stops, survey.stops, strict=True):
        np.testing.assert_allclose([stop.x, stop.y], [asked.odometry.x, asked.odometry.y], atol=1e-6)


def test_a_missing_stop_costs_a_note_not_the_map():
    survey, truth = noisy_room()
    result = solve(replace(survey, stops=(*survey.stops[3:], *survey.stops[:2])))
    assert any("no move leads from stop 2 to stop 4" in note for note in result.notes)
    assert [stop.stop for stop in result.stops] == [1, 2, 4, 5, 6, 7]
    assert evaluate(result, truth).error_mm["max"] < 30.0


def test_a_single_stop_places_nothing():
    survey, _ = quiet_room()
    result = solve(replace(survey, stops=survey.stops[:1]))
    assert {label.status for label in result.labels} == {"unplaced"}


def test_a_survey_without_stops_cannot_be_solved():
    with pytest.raises(SolverError, match="no stops"):
        solve(replace(quiet_room()[0], stops=()))


def test_all_contradictions_of_a_survey_are_named_at_once():
    survey, _ = quiet_room()
    broken = replace(survey.stops[0], sightings=(Sighting("top", "A", 1.0, 2.0), Sighting("front", "A", np.nan, 2.0)))
    with pytest.raises(InputError) as caught:
        solve(replace(survey, stops=(broken, *survey.stops)))
    message = str(caught.value)
    assert "unknown camera 'top'; the rig has front, left, rear, right" in message
    assert "u, v must be finite" in message
    assert "leg 1 stop 1 is there twice" in message


def test_pixels_beyond_the_valid_radius_are_left_out_and_counted():
    survey, truth = quiet_room()
    cameras = tuple(replace(c, valid_radius_px=250.0) for c in survey.rig.cameras)
    result = solve(replace(survey, rig=replace(survey.rig, cameras=cameras)))
    assert any("valid radius" in note for note in result.notes)
    assert evaluate(result, truth).error_mm["max"] < 0.01


def test_maps_hold_finite_numbers_whatever_the_sightings_are():
    survey, _ = quiet_room()
    for seed, share in enumerate((0.1, 0.5, 1.0)):
        rng = np.random.default_rng(seed)

        def scramble(stop, rng=rng, share=share):
            for s in stop.sightings:
                wild = rng.random() < share
                yield replace(s, u=float(rng.uniform(0, 640)), v=float(rng.uniform(0, 480))) if wild else s

        result = solve(with_sightings(survey, scramble))
        numbers = [result.cost, result.rms_px]
        for label in result.labels:
            numbers += [*(label.position or ()), *np.ravel(label.covariance or ())]
        for stop in result.stops:
            numbers += [stop.x, stop.y, stop.heading, *np.ravel(stop.covariance)]
        for sighting in result.sightings:
            numbers += [*(sighting.residual_px or ())]
        assert np.isfinite(numbers).all()
