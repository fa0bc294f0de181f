"""The compiled bundle adjustment against the numpy one, which is its oracle."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import invert_rigid, pose_matrix, rotation_vector, se2_relative, transform_points
from robotd.records import (
    BeaconSighting,
    CameraModel,
    KnownLabel,
    Motion,
    Move,
    Pose,
    Priors,
    Rig,
    RoofCamera,
    Sighting,
    Sigmas,
    Stop,
    Survey,
    Transform,
)
from robotd.solver import initial, solve
from robotd.solver.bundle import SQUARE, Adjustment, Loss
from robotd.solver.covariance import covariance, covariance_reference
from robotd.solver.initial import epipolar_moves, triangulate
from robotd.solver.problem import State, build_problem
from tests.store_surveys import load, simulate

pytest.importorskip("robotd.solver._bundle", reason="built without extensions")

NONE = Priors()
TILT = Priors(tilt_rad=0.005)
ALL = Priors(0.005, 0.001, 0.001, 0.3, 0.3, 0.004, 0.004, 0.01, 0.002, 0.7)
ROOFS = ("roof", "exact", "idle")
LENSES = {
    "pinhole": ("brown-conrady", (), None),
    "brown-conrady": ("brown-conrady", (-0.06, 0.012, 0.0002, 0.0003, -0.001), None),
    "rational": ("brown-conrady", (-0.05, 0.01, 0.0002, 0.0003, -0.001, 0.01, 0.002, 0.0001), 300.0),
    "fisheye": ("fisheye", (-0.02, 0.003, -0.001, 0.0002), None),
}
LOSSES = (SQUARE, Loss("cauchy", 0.5, width=2.0), Loss("geman-mcclure", 0.4), Loss("square", 2.0, move_width=3.0))


def make_problem(priors, lens="brown-conrady", stops=9, labels=40, seed=0, world="stop", legs=1):
    """A survey of labels around a winding path, as a problem, and a state near its optimum."""
    rng = np.random.default_rng(seed)
    model, distortion, radius = LENSES[lens]
    cameras = []
    for name, heading in (("front", 0.0), ("left", 0.5 * np.pi), ("rear", np.pi), ("right", -0.5 * np.pi)):
        forward = np.array([np.cos(heading), np.sin(heading), 0.0])
        R = np.column_stack([[np.sin(heading), -np.cos(heading), 0.0], [0.0, 0.0, -1.0], forward])
        mount = Transform(tuple(rotation_vector(R)), tuple(0.06 * forward + [0.0, 0.0, 0.5]))
        matrix = (268.5, 267.5, 319.5, 239.5)
        cameras.append(
            CameraModel(name, (640, 480), matrix, mount, model=model, distortion=distortion, valid_radius_px=radius)
        )
    rig = Rig(tuple(cameras), {"front": (0.1, 0.0, 0.65), "rear": (-0.1, 0.0, 0.65)})
    k = np.arange(stops)
    poses = np.column_stack([0.5 * k, np.sin(0.5 * k), 0.4 * np.cos(0.5 * k)])
    points = rng.uniform([-2.0, -3.0, 0.2], [0.5 * stops + 2.0, 3.0, 1.5], (labels, 3))
    H = np.array([[0.01, 0.0, -2.0], [0.0, -0.01, 3.0], [0.0, 0.0001, 1.0]])
    records = []
    for s, pose in enumerate(poses):
        T = pose_matrix(*pose, *rng.normal(0.0, priors.tilt_rad, 2))
        sightings, beacons = [], []
        for camera in map(Camera, cameras):
            uv, seen = camera.project(transform_points(invert_rigid(T @ camera.T_robot_camera), points))
            seen &= camera.in_image(uv) & (np.linalg.norm(points - T[:3, 3], axis=1) < 3.0)
            for n in np.flatnonzero(seen):
                u, v = (uv[n] + rng.normal(0.0, 0.5, 2)).tolist()
                sigma, probability = float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.5, 1.0))
                sightings.append(Sighting(camera.name, f"{n:03d}", u, v, sigma, probability))
        if world == "roof":
            for name, place in rig.beacons.items():
                at = T[:3, :3] @ place + T[:3, 3]
                h = np.linalg.inv(H) @ [at[0], at[1], 1.0]
                beacons.append(BeaconSighting(ROOFS[s % 2], name, *(h[:2] / h[2]).tolist(), 1.0))
        leg = 1 + s * legs // stops
        move = None
        if s and leg == records[-1].leg:
            d = se2_relative(poses[s - 1], pose) + rng.normal(0.0, 0.01, 3)
            move = Move(*d.tolist(), ((1e-4, 0.0, 1e-5), (0.0, 1e-4, 0.0), (1e-5, 0.0, 1e-4)))
        motions = ()
        if move is not None and world == "motions":
            gyro = Motion("gyro", 0.0, 0.0, move.dheading + 0.01, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1e5)))
            line = Motion("line", move.dx, move.dy, move.dheading, ((4e3, 2e3, 0.0), (2e3, 1e3, 0.0), (0.0, 0.0, 1e4)))
            motions = (gyro, line) if s % 3 else (line,)
        at = Pose(*pose.tolist())
        records.append(Stop(leg, s + 1, "2026-11-21T10:00:00Z", at, move, tuple(sightings), tuple(beacons), motions))
    known = tuple(KnownLabel(f"{n:03d}", tuple(points[n].tolist())) for n in range(4)) if world == "known" else ()
    rows, roofs = tuple(map(tuple, H.tolist())), ()
    if world == "roof":  # of three cameras one is exact and one sees nothing
        spread = tuple(map(tuple, np.diag(rng.uniform(0.5e-8, 2e-8, 9)).tolist()))
        roofs = tuple(RoofCamera(name, (640, 480), rows, spread if name != "exact" else None) for name in ROOFS)
    survey = Survey(
        "test", rig, tuple(records), sigmas=Sigmas(0.5, 1.0), priors=priors, known_labels=known, roof_cameras=roofs
    )
    problem = build_problem(survey)
    frame = np.zeros(len(problem.prior_sigma))
    frame[: 5 * stops].reshape(-1, 5)[:, :3] = poses
    noise = np.where(np.isfinite(problem.prior_sigma), problem.prior_sigma, 0.01)
    where = points[[int(name) for name in problem.labels]]
    where = where + rng.normal(0.0, 0.03, where.shape)
    return problem, State(frame + 0.5 * noise * rng.normal(size=len(frame)), where)


@pytest.mark.parametrize("lens", LENSES)
def test_residuals_are_those_of_numpy(lens):
    problem, state = make_problem(ALL, lens)
    adjustment = Adjustment(problem, problem.sightings)
    for loss in LOSSES:
        linear, found = adjustment.linearise(state, loss), adjustment.residuals(state, loss)
        np.testing.assert_array_equal(found.valid, linear.valid)
        np.testing.assert_allclose(found.residual, linear.residual, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.move, linear.move, atol=1e-12)
        np.testing.assert_allclose(found.roof, linear.roof, atol=1e-12)


@pytest.mark.parametrize("world", ["stop", "known", "roof", "motions"])
@pytest.mark.parametrize("priors", [NONE, TILT, ALL], ids=["planar", "tilt", "all"])
@pytest.mark.parametrize("lens", ["pinhole", "rational", "fisheye"])
def test_the_descent_takes_the_steps_of_numpy(priors, world, lens):
    problem, state = make_problem(priors, lens, world=world)
    adjustment = Adjustment(problem, problem.sightings)
    for loss in LOSSES:
        ours, theirs = adjustment.solve(state, loss), adjustment.solve_reference(state, loss)
        assert (ours.iterations, ours.converged) == (theirs.iterations, theirs.converged)
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-9)
        np.testing.assert_allclose(ours.state.frame, theirs.state.frame, atol=1e-8)
        np.testing.assert_allclose(ours.state.points, theirs.state.points, atol=1e-8)


@pytest.mark.parametrize("world", ["roof", "motions"])
def test_derivatives_are_those_of_differences(world):
    problem, state = make_problem(ALL, world=world)
    adjustment = Adjustment(problem, problem.sightings)
    linear = adjustment.linearise(state, SQUARE)
    size, step = len(state.frame), 1e-6
    moves, roofs = np.zeros((size, *linear.move.shape)), np.zeros((size, *linear.roof.shape))
    for entry in range(size):
        ends = [replace(state, frame=state.frame + sign * step * np.eye(size)[entry]) for sign in (1, -1)]
        ahead, behind = (adjustment.linearise(end, SQUARE) for end in ends)
        moves[entry], roofs[entry] = (
            (getattr(ahead, name) - getattr(behind, name)) / (2.0 * step) for name in ("move", "roof")
        )
    rows = np.arange(len(linear.move))[:, None]
    for which, found in (
        (5 * adjustment.before[:, None] + np.arange(3), linear.move_before),
        (5 * adjustment.after[:, None] + np.arange(3), linear.move_after),
        (size + np.tile(np.arange(-3, 0), (len(rows), 1)), linear.move_factor),
    ):
        np.testing.assert_allclose(moves[which, rows].transpose(0, 2, 1), found, rtol=1e-5, atol=1e-4)
    rows = np.arange(len(linear.roof))[:, None]
    found = np.concatenate([linear.roof_by_stop, linear.roof_by_plane], axis=2)
    np.testing.assert_allclose(roofs[adjustment.roof_entries, rows].transpose(0, 2, 1), found, rtol=1e-5, atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    stops=st.integers(1, 14),
    labels=st.integers(1, 30),
    legs=st.integers(1, 3),
    share=st.floats(0.2, 1.0),
    priors=st.sampled_from([NONE, TILT, ALL]),
)
def test_any_selection_of_sightings_is_solved_as_by_numpy(seed, stops, labels, legs, share, priors):
    problem, state = make_problem(priors, "pinhole", stops, labels, seed, legs=legs)
    rng = np.random.default_rng(seed)
    chosen = problem.sightings.select(rng.random(len(problem.sightings)) < share)
    adjustment = Adjustment(problem, chosen)
    # one step only, because a label with a single sighting makes long descents depend on rounding
    ours, theirs = (solve(state, LOSSES[1], 1) for solve in (adjustment.solve, adjustment.solve_reference))
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-5, abs=1e-6)
    seen = np.bincount(chosen.label, minlength=len(problem.labels)) >= 4
    np.testing.assert_allclose(ours.state.points[seen], theirs.state.points[seen], atol=1e-4)


def test_what_is_held_fixed_stays_to_the_last_bit():
    problem, state = make_problem(NONE)
    solution = Adjustment(problem, problem.sightings).solve(state, SQUARE)
    fixed = ~problem.free
    np.testing.assert_array_equal(solution.state.frame[fixed], state.frame[fixed])


@pytest.mark.parametrize("world", ["stop", "known", "roof", "motions"])
@pytest.mark.parametrize("priors", [NONE, TILT, ALL], ids=["planar", "tilt", "all"])
def test_covariances_are_those_of_the_dense_inverse(priors, world):
    problem, state = make_problem(priors, world=world)
    adjustment = Adjustment(problem, problem.sightings)
    state = adjustment.solve(state, SQUARE, tolerance=1e-9).state
    ours, theirs = covariance(adjustment, state), covariance_reference(adjustment, state)
    np.testing.assert_allclose(ours.points, theirs.points, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(ours.stops, theirs.stops, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(ours.prediction, theirs.prediction, rtol=1e-5, atol=1e-6)


def test_covariances_hold_for_many_stops_in_a_loop():
    problem, state = make_problem(TILT, "pinhole", stops=60, labels=250)
    adjustment = Adjustment(problem, problem.sightings)
    solution, reference = adjustment.solve(state, SQUARE), adjustment.solve_reference(state, SQUARE)
    np.testing.assert_allclose(solution.state.points, reference.state.points, atol=1e-6)
    ours, theirs = covariance(adjustment, solution.state), covariance_reference(adjustment, solution.state)
    np.testing.assert_allclose(ours.points, theirs.points, rtol=1e-4, atol=5e-8)
    np.testing.assert_allclose(ours.leverage, theirs.leverage, rtol=1e-4, atol=1e-6)


def test_in_a_frame_that_nothing_fixes_every_position_is_uncertain():
    problem, state = make_problem(NONE)
    prior = problem.prior_sigma.copy()
    prior[:3] = np.inf
    loose = replace(problem, prior_sigma=prior)
    points = covariance(Adjustment(loose, loose.sightings), state).points
    assert np.isfinite(points).all()
    assert np.linalg.eigvalsh(points)[:, -1].min() > 10.0


def test_arrays_of_another_problem_are_refused():
    problem, state = make_problem(NONE)
    kernel = Adjustment(problem, problem.sightings).kernel
    assert kernel is not None
    with pytest.raises(ValueError, match="frame vector"):
        kernel.residuals(state.frame[:-1], state.points, 0.0)
    with pytest.raises(ValueError, match="points of shape"):
        kernel.residuals(state.frame, state.points[:-1], 0.0)


def test_triangulation_and_moves_are_those_of_numpy(monkeypatch):
    problem, _ = make_problem(ALL, stops=15, labels=60, seed=3)
    s = problem.sightings
    rng = np.random.default_rng(0)
    direction = s.direction + rng.normal(0.0, 0.002, s.direction.shape)
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    poses = pose_matrix(*problem.odometry.T)[s.stop]
    rays = (poses[:, :3, :3] @ s.origin[:, :, None])[:, :, 0] + poses[:, :3, 3]
    turned = (poses[:, :3, :3] @ direction[:, :, None])[:, :, 0]
    arguments = (rays, turned, s.label, s.stop, s.probability, len(problem.labels) + 2, 0.03)
    points, found = triangulate(*arguments)
    moves = epipolar_moves(problem, s)
    monkeypatch.setattr(initial, "kernel", None)
    expected, expected_found = triangulate(*arguments)
    np.testing.assert_array_equal(found, expected_found)
    np.testing.assert_allclose(points, expected, atol=1e-9)
    np.testing.assert_allclose(moves, epipolar_moves(problem, s), atol=1e-6)


def test_without_extensions_the_map_is_the_same(monkeypatch):
    survey, _ = simulate(load("room"), seed=4)
    compiled = solve(survey)
    monkeypatch.setattr("robotd.solver.kernel.Bundle", None)
    monkeypatch.setattr(initial, "kernel", None)
    plain = solve(survey)
    assert [label.status for label in compiled.labels] == [label.status for label in plain.labels]
    for ours, theirs in zip(compiled.labels, plain.labels, strict=True):
        if ours.position is not None:
            np.testing.assert_allclose(ours.position, theirs.position, atol=1e-7)
            np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-4, atol=1e-10)
