"""Derivatives, the start and the linear baseline."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.transforms import (
    wrap_angle,
)
from robotd.records import (
    BeaconSighting,
    KnownLabel,
    RoofCamera,
    SolverRun,
)
from robotd.solver import evaluate, solve
from robotd.solver.bundle import Adjustment, Loss
from robotd.solver.initial import epipolar_moves
from robotd.solver.problem import State, build_problem
from tests.store_surveys import covariance, noisy_room, quiet_room


def test_derivatives_agree_with_finite_differences():
    survey, truth = noisy_room()
    survey = replace(survey, known_labels=(KnownLabel("S02", truth["S02"], 0.01),))
    beacons = (
        BeaconSighting("roof-1", "front", 300.0, 200.0, 0.8),
        BeaconSighting("roof-1", "rear", 310.0, 210.0, 0.8),
    )
    survey = replace(
        survey,
        roof_cameras=(RoofCamera("roof-1", (1280, 720), ((0.01, 0.001, -6.4), (0.0, 0.01, -3.6), (1e-5, 2e-5, 1.0))),),
        stops=tuple(replace(s, beacon_sightings=beacons) for s in survey.stops),
    )
    problem = build_problem(survey)
    rng = np.random.default_rng(0)
    frame = np.zeros(len(problem.prior_sigma))
    problem.stop_entries(State(frame, np.zeros((0, 3))))[:, :3] = problem.odometry
    frame += rng.normal(0.0, 0.02, len(frame)) * problem.free
    state = State(frame, np.array([truth[label] for label in problem.labels]) + rng.normal(0.0, 0.02, (29, 3)))
    adjustment, loss = Adjustment(problem, problem.sightings), Loss("cauchy", 1.0)
    linear = adjustment.linearise(state, loss)
    normal = adjustment.normal(linear, state, loss)

    def cost(frame, points):
        moved = State(frame, points)
        return adjustment.cost(adjustment.linearise(moved, loss), moved, loss)

    free = np.flatnonzero(problem.free)
    for entry in rng.choice(free, 25, replace=False):
        h = 1e-6 * np.eye(1, len(frame), entry)[0]
        slope = (cost(frame + h, state.points) - cost(frame - h, state.points)) / 2e-6
        assert normal.frame_gradient[adjustment.columns[entry]] == pytest.approx(slope, rel=1e-4, abs=1e-2)
    for label in (0, 1, 17):
        for axis in range(3):
            h = np.zeros_like(state.points)
            h[label, axis] = 1e-6
            slope = (cost(frame, state.points + h) - cost(frame, state.points - h)) / 2e-6
            assert normal.point_gradient[label, axis] == pytest.approx(slope, rel=1e-4, abs=1e-2)


def test_epipolar_geometry_corrects_headings_without_depth():
    survey, _ = quiet_room()
    rng = np.random.default_rng(1)
    P = covariance(np.diag([0.01, 0.01, 0.15]) ** 2)
    moves = [None if s.move is None else replace(s.move, covariance=P) for s in survey.stops]
    exact = np.array([[m.dx, m.dy, m.dheading] for m in moves[1:]])
    noisy = [m and replace(m, dheading=m.dheading + float(rng.normal(0.0, 0.15))) for m in moves]
    stops = tuple(replace(s, move=m) for s, m in zip(survey.stops, noisy, strict=True))
    problem = build_problem(replace(survey, stops=stops))
    error = wrap_angle(epipolar_moves(problem, problem.sightings)[:, 2] - exact[:, 2])
    assert np.abs(error).max() < 0.02


def test_the_linear_method_uses_odometry_as_it_is():
    survey, truth = quiet_room()
    result = solve(survey, "linear")
    assert result.solver == SolverRun(0, True, "linear")
    assert evaluate(result, truth).error_mm["max"] < 0.01
    noisy, truth = noisy_room()
    assert evaluate(solve(noisy, "linear"), truth).error_mm["mean"] > 20.0
