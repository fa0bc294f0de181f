"""Priors, known labels, roof cameras and several legs: what else fixes a map."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.transforms import (
    pose_matrix,
    se2_compose,
)
from robotd.records import (
    BeaconSighting,
    KnownLabel,
    Pose,
    Priors,
    RoofCamera,
)
from robotd.solver import evaluate, solve
from robotd.solver.bundle import Adjustment, Loss
from robotd.solver.problem import State, build_problem
from tests.store_surveys import in_legs, label_of, noisy_room, quiet_room, with_sightings


def test_what_has_no_prior_is_held_fixed_exactly():
    survey, _ = noisy_room()
    problem = build_problem(replace(survey, priors=Priors()))
    free = problem.free
    assert free.sum() == 3 * (len(survey.stops) - 1)
    state = State(np.zeros(len(free)), np.ones((len(problem.labels), 3)))
    after = Adjustment(problem, problem.sightings).solve(state, Loss("cauchy", 7.5), iterations=3).state
    assert (after.frame[~free] == 0.0).all()


def test_refining_rig_and_tilt_pays():
    survey, truth = noisy_room()
    planar = evaluate(solve(replace(survey, priors=Priors())), truth)
    assert evaluate(solve(survey), truth).error_mm["mean"] < 0.6 * planar.error_mm["mean"]


def test_understated_sigmas_are_noticed_and_do_not_cost_labels():
    survey, truth = noisy_room()
    bold = with_sightings(survey, lambda stop: [replace(s, sigma_px=0.05) for s in stop.sightings])
    result = solve(bold)
    assert any("scatter 2.0 times" in note or "scatter 1.9 times" in note for note in result.notes)
    assert evaluate(result, truth).labels_placed == len(truth)


MOVED = (3.0, -2.0, 2.0)


def elsewhere(truth):
    T = pose_matrix(*MOVED)
    return {label: tuple(map(float, T[:3, :3] @ p + T[:3, 3])) for label, p in truth.items()}


def test_known_labels_fix_the_world_frame():
    survey, truth = noisy_room()
    truth = elsewhere(truth)
    known = tuple(KnownLabel(label, truth[label], 0.003) for label in ("S02", "E10", "N16", "W23"))
    result = solve(replace(survey, known_labels=known))
    assert result.frame == "known labels"
    assert label_of(result, "S02").status == "known"
    score = evaluate(result, truth)
    assert score.labels_placed == len(truth)
    assert score.error_mm["max"] < 15.0
    assert np.trace(np.array(result.stops[0].covariance)) > 0.0


def test_a_wrong_known_label_is_named_and_placed_by_its_sightings():
    survey, truth = noisy_room()
    known = [KnownLabel(label, truth[label], 0.003) for label in ("S02", "E10", "N16", "W23")]
    known[2] = replace(known[2], position=(0.0, 0.0, 0.3))
    result = solve(replace(survey, known_labels=tuple(known)))
    assert any("known label N16" in note for note in result.notes)
    assert label_of(result, "N16").status == "placed"
    assert evaluate(result, truth).error_mm["max"] < 20.0


def test_roof_cameras_fix_the_world_frame_even_without_odometry():
    survey, truth = quiet_room()
    H = ((0.01, 0.0, -6.4), (0.0, 0.01, -3.6), (0.0, 0.0, 1.0))
    stops = []
    for n, stop in enumerate(survey.stops):
        pose = se2_compose(MOVED, [stop.odometry.x, stop.odometry.y, stop.odometry.heading])
        seen = []
        for beacon, place in survey.rig.beacons.items():
            x, y, *_ = pose_matrix(*pose) @ [*place, 1.0]
            seen.append(BeaconSighting("roof-1", beacon, 100.0 * (x + 6.4), 100.0 * (y + 3.6), 0.8))
        stops.append(
            replace(stop, leg=n + 1, stop=1, move=None, odometry=Pose(0.0, 0.0, 0.0), beacon_sightings=tuple(seen))
        )
    roof = RoofCamera("roof-1", (1280, 720), H)
    result = solve(replace(survey, stops=tuple(stops), roof_cameras=(roof,)))
    assert result.frame == "roof cameras"
    assert evaluate(result, elsewhere(truth)).error_mm["max"] < 0.1
    assert all(np.trace(np.array(stop.covariance)) > 0.0 for stop in result.stops)


def test_one_beacon_sighting_does_not_fix_the_world_frame():
    survey, truth = quiet_room()
    lone = replace(survey.stops[0], beacon_sightings=(BeaconSighting("roof-1", "front", 640.0, 360.0),))
    roof = RoofCamera("roof-1", (1280, 720), ((0.01, 0.0, -6.4), (0.0, 0.01, -3.6), (0.0, 0.0, 1.0)))
    result = solve(replace(survey, stops=(lone, *survey.stops[1:]), roof_cameras=(roof,)))
    assert result.frame == "first stop"
    assert any("one sighting of a beacon" in note for note in result.notes)
    assert evaluate(result, truth).error_mm["max"] < 0.01


@pytest.mark.parametrize("cut", [1, 4])
def test_a_second_leg_is_joined_through_shared_labels(cut):
    survey, truth = noisy_room()
    score = evaluate(solve(in_legs(survey, cut)), truth)
    assert score.labels_placed == len(truth)
    assert score.error_mm["max"] < 30.0


def test_a_leg_that_shares_no_label_is_reported_not_guessed():
    survey, truth = quiet_room()
    legs = in_legs(survey, 4)
    apart = with_sightings(
        legs, lambda stop: [replace(s, label=s.label + ("" if stop.leg == 1 else "x")) for s in stop.sightings]
    )
    result = solve(apart)
    assert any("leg/stop 2/1, 2/2, 2/3" in note for note in result.notes)
    assert {m.status for m in result.labels if m.label.endswith("x")} == {"unplaced"}
    assert evaluate(result, truth).error_mm["max"] < 0.01
