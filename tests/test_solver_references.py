"""Priors, known labels, roof cameras and several legs: what else fixes a map."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.homography import apply, fit
from robotd.geometry.transforms import (
    pose_matrix,
    se2_compose,
)
from robotd.records import (
    BeaconSighting,
    KnownLabel,
    Move,
    Pose,
    Priors,
    RoofCamera,
)
from robotd.solver import evaluate, solve
from robotd.solver.bundle import Adjustment, Loss
from robotd.solver.problem import State, build_problem
from robotd.solver.robust import optimise
from robotd.solver.wheel_errors import arc_by_errors, move_by_errors
from tests.store_surveys import (
    World,
    covariance,
    in_legs,
    label_of,
    load,
    nees,
    noisy_room,
    quiet_room,
    simulate,
    true_poses,
    with_sightings,
)


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


PLANE = np.array([[100.0, 4.0, 640.0], [-3.0, 100.0, 360.0], [0.01, 0.02, 1.0]])  # world to pixels


def from_the_roof(survey, seed, beacon_m=0.01, picked_px=0.5):
    """The survey seen by one roof camera that was calibrated from eight points, and whose beacons were taped."""
    rng = np.random.default_rng([seed, 5])
    points = rng.uniform([-2.0, -2.0], [3.0, 3.0], (8, 2))
    picked = apply(PLANE, points) + rng.normal(0.0, picked_px, (8, 2))
    believed = fit(points, picked, picked_px).homography
    H = np.linalg.inv(believed.matrix)
    roof = RoofCamera("roof-1", (1280, 720), tuple(map(tuple, H.tolist())), tuple(map(tuple, believed.covariance)))
    store = load("room")
    stops = []
    for stop, pose in zip(survey.stops, true_poses(store), strict=True):
        seen = []
        for beacon, place in survey.rig.beacons.items():
            at = (pose_matrix(*pose) @ [*place, 1.0])[:2]
            u, v = (apply(PLANE, at[None])[0] + rng.normal(0.0, 0.05, 2)).tolist()
            seen.append(BeaconSighting("roof-1", beacon, u, v, 0.05))
        stops.append(replace(stop, beacon_sightings=tuple(seen)))
    taped = {
        name: (x + rng.normal(0.0, beacon_m), y + rng.normal(0.0, beacon_m), z)
        for name, (x, y, z) in survey.rig.beacons.items()
    }
    return replace(
        survey,
        stops=tuple(stops),
        roof_cameras=(roof,),
        rig=replace(survey.rig, beacons=taped),
        priors=replace(survey.priors, beacon_m=beacon_m),
    )


def test_homographies_and_beacons_are_refined_within_their_priors():
    world = World(reflections=0.0, wrong_ids=0.0, slip=0.0, tilt=0.0)
    refined = []
    for seed in range(5):
        survey, truth = simulate(load("room"), seed, world)
        seen = from_the_roof(survey, seed)
        exact = replace(
            seen,
            priors=replace(seen.priors, beacon_m=0.0),
            roof_cameras=tuple(replace(roof, covariance=None) for roof in seen.roof_cameras),
        )
        refined += nees(solve(seen), truth)
        believed = solve(exact).notes  # who believes them is told that they do not fit
        assert any("beacons came out" in note and "homographies" in note for note in believed), believed
    assert 0.5 < np.mean(refined) < 2.0


def test_wheels_of_unequal_size_are_found_within_their_prior():
    survey, truth = simulate(load("warehouse"), 3, World(reflections=0.0, wrong_ids=0.0, slip=0.0))
    drift = 0.03

    def drifted(stop):
        if stop.move is None:
            return stop
        move = stop.move
        J = np.array(move.by_errors)
        x, y, turn = [move.dx, move.dy, move.dheading] - drift * J[:, 2]
        J[:2, 0] = x, y
        return replace(stop, move=replace(move, dx=x, dy=y, dheading=turn, by_errors=covariance(J)))

    worn = replace(survey, stops=tuple(map(drifted, survey.stops)))
    allowed = replace(worn, priors=replace(worn.priors, odometry_drift=0.03))
    as_made = evaluate(solve(survey), truth).error_mm["mean"]
    assert evaluate(solve(allowed), truth).error_mm["mean"] == pytest.approx(as_made, abs=2.0)
    problem = build_problem(allowed)
    assert optimise(problem).state.frame[-1] == pytest.approx(drift, abs=0.012)
    assert optimise(build_problem(worn)).state.frame[-1] == 0.0


def test_where_the_robot_turned_tells_about_its_wheels_and_so_about_the_maps_size():
    """The errors of eight maps, and how sure they are, with what a survey says of its moves' errors and without."""
    world = World(reflections=0.0, wrong_ids=0.0, slip=0.0)
    errors, sigmas, surprise = ([[], []] for _ in range(3))
    for seed in range(8):
        survey, truth = simulate(load("room"), seed, world)
        for k, read in enumerate((survey, replace(survey, priors=replace(survey.priors, odometry_correlation=0.0)))):
            result = solve(read)
            errors[k].append(evaluate(result, truth).error_mm["mean"])
            sigmas[k].append(np.mean([np.trace(m.covariance) for m in result.labels]) ** 0.5)
            surprise[k] += nees(result, truth)
    assert np.mean(sigmas[0]) < 0.92 * np.mean(sigmas[1])
    assert np.mean(errors[0]) < 0.95 * np.mean(errors[1])
    assert np.mean(surprise[0]) < 1.5


def test_a_move_that_was_changed_alone_counts_as_an_arc():
    move = Move(
        1.0, 0.2, 0.4, covariance(np.eye(3)), covariance(np.array([[1.0, -0.3, 0.0], [0.2, 0.1, 0.5], [0, 1, 1]]))
    )
    np.testing.assert_array_equal(move_by_errors(move), move.by_errors)
    changed = replace(move, dx=1.05)
    np.testing.assert_allclose(move_by_errors(changed), arc_by_errors(np.array([1.05, 0.2, 0.4])))
