"""Standard deviations of sightings that residuals contradict are estimated from them, so that covariances stay true."""

from dataclasses import replace

import numpy as np
import pytest

import tests.store_surveys
from robotd.geometry.camera import Camera
from robotd.solver.bundle import SQUARE
from robotd.solver.problem import build_problem
from robotd.solver.robust import optimise
from tests.store_surveys import World, load, simulate, true_cameras, with_sightings

FINE = World(reflections=0.0, wrong_ids=0.0, slip=0.0, centroid_px=0.01)


def solved(survey):
    return optimise(build_problem(survey))


def restated(survey, sigma_px):
    return with_sightings(survey, lambda stop: [replace(s, sigma_px=sigma_px) for s in stop.sightings])


def consistency(optimum, truth):
    """NEES/n of all labels jointly, everything else marginalised: 1 if covariances are true."""
    adjustment, state = optimum.adjustment, optimum.state
    normal = adjustment.normal(adjustment.linearise(state, SQUARE), state, SQUARE)
    W, points = normal.W.toarray(), len(normal.V)
    V = np.zeros((points, 3, points, 3))
    V[np.arange(points), :, np.arange(points)] = normal.V
    information = V.reshape(3 * points, -1) - W.T @ np.linalg.solve(normal.H, W)
    names = optimum.problem.labels
    error = np.concatenate([state.points[i] - truth[names[i]] for i in adjustment.labels])
    return float(error @ information @ error) / len(error)


@pytest.mark.parametrize("stated", [0.003, 0.01, 0.04, 0.2])
def test_whatever_a_detector_says_the_weights_become_those_of_its_true_noise(stated):
    found = []
    for seed in range(3):
        survey, truth = simulate(load("room"), seed, FINE)
        optimum = solved(restated(survey, stated))
        assert np.median(optimum.adjustment.sightings.sigma) == pytest.approx(0.01, rel=0.2)
        found.append(consistency(optimum, truth))
    assert 0.7 < np.mean(found) < 1.4


def test_right_standard_deviations_are_left_as_they_are():
    survey, _ = simulate(load("room"), 1, replace(FINE, centroid_px=0.1))
    assert (solved(survey).adjustment.sightings.sigma == 0.1).all()


def test_dim_lights_and_bright_ones_are_told_apart():
    survey, _ = simulate(load("room"), 2, replace(FINE, centroid_px=0.0))
    rng = np.random.default_rng(2)

    def shaken(stop):
        true = rng.choice([0.01, 0.2], len(stop.sightings), p=[0.7, 0.3])
        moved = zip(stop.sightings, true, *(true * rng.normal(size=(2, len(true)))), strict=True)
        return [replace(s, u=s.u + du, v=s.v + dv, sigma_px=0.03 if t < 0.05 else 0.07) for s, t, du, dv in moved]

    used = solved(with_sightings(survey, shaken)).adjustment.sightings
    assert np.quantile(used.sigma, 0.3) == pytest.approx(0.01, rel=0.35)
    assert np.quantile(used.sigma, 0.9) == pytest.approx(0.2, rel=0.35)


@pytest.mark.parametrize("bend", [0.001, 0.003])
def test_a_lens_whose_distortion_is_not_as_stated_makes_nobody_too_sure(bend, monkeypatch):
    def bent(rig, world, rng):
        cameras = []
        for camera in true_cameras(rig, world, rng):
            k1, *rest = camera.model.distortion
            cameras.append(Camera(replace(camera.model, distortion=(k1 + bend * rng.choice([-1, 1]), *rest))))
        return cameras

    monkeypatch.setattr(tests.store_surveys, "true_cameras", bent)
    found = []
    for seed in range(4):
        survey, truth = simulate(load("room"), seed, FINE)
        found.append(consistency(solved(survey), truth))
    assert np.mean(found) < 1.6


def test_one_light_that_fits_badly_neither_loosens_its_class_nor_goes_lost():
    survey, _ = simulate(load("room"), 4, FINE)
    first = survey.stops[2].sightings[3]
    spoiled = with_sightings(
        survey, lambda stop: [replace(s, v=s.v + 0.12) if s is first else s for s in stop.sightings]
    )
    clean, optimum = solved(survey), solved(spoiled)
    sigma, usual = optimum.adjustment.sightings.sigma, np.median(clean.adjustment.sightings.sigma)
    assert len(sigma) == len(clean.adjustment.sightings)
    assert np.median(sigma) == pytest.approx(usual, rel=0.1)
    assert np.count_nonzero(sigma > 3.0 * usual) == 1


def test_too_few_sightings_tell_nothing_of_their_noise():
    survey, _ = simulate(load("room"), 5, FINE)
    few = {label["id"] for label in load("room")["labels"][:3]}
    sparse = with_sightings(survey, lambda stop: [s for s in stop.sightings if s.label in few])
    problem = build_problem(sparse)
    assert set(optimise(problem).adjustment.sightings.sigma) <= set(problem.sightings.sigma)
