"""Homographies: exact from exact points, as uncertain as they say from noisy ones, and refused where they are open."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.geometry.homography import Homography, apply, cross_error, direct, fit, jacobians, rescaled

VIEW = np.array([[200.0, 30.0, 640.0], [20.0, -180.0, 400.0], [0.05, 0.08, 1.0]])


@st.composite
def views(draw):
    """A homography from a floor of four metres to a picture, all of it in front, and points that fix it."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    H = VIEW * rng.uniform(0.7, 1.3, (3, 3))
    H[2, :2] = rng.uniform(-0.1, 0.1, 2)
    corners = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]) + rng.uniform(-0.5, 0.5, (4, 2))
    extra = rng.uniform(-2.0, 2.0, (draw(st.integers(0, 8)), 2))
    return H, np.vstack([corners, extra])


@settings(deadline=None, max_examples=60)
@given(view=views())
def test_exact_points_give_the_exact_homography(view):
    H, points = view
    for found in (direct(points, apply(H, points)), fit(points, apply(H, points)).homography.matrix):
        assert np.abs(found - H / np.linalg.norm(H)).max() < 1e-9
    assert np.abs(apply(np.linalg.inv(H), apply(H, points)) - points).max() < 1e-9


@settings(deadline=None, max_examples=30)
@given(view=views())
def test_derivatives_are_those_of_the_function(view):
    H, points = view
    by_point, by_matrix = jacobians(H, points)
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        assert np.allclose((apply(H, points + step) - apply(H, points - step)) / 2e-6, by_point[:, :, k], rtol=1e-5)
    for k in range(9):
        step = 1e-6 * np.eye(9)[k].reshape(3, 3)
        wanted = (apply(H + step, points) - apply(H - step, points)) / 2e-6
        assert np.allclose(wanted, by_matrix[:, :, k], rtol=1e-4, atol=1e-4)


def test_the_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(1)
    nees, chi2 = [], []
    for _ in range(300):
        points = rng.uniform(-2.0, 2.0, (8, 2))
        pixels = apply(VIEW, points) + rng.normal(0.0, 0.5, (8, 2))
        found = fit(points + rng.normal(0.0, 0.003, (8, 2)), pixels, 0.5, 0.003)
        where = np.array([[0.3, 0.4]])
        at, spread = found.homography.to_plane(apply(VIEW, where))
        error = (at - where)[0]
        nees.append(error @ np.linalg.solve(spread[0], error))
        chi2.append(found.chi2 / found.freedom)
    assert np.mean(nees) == pytest.approx(2.0, abs=0.35)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.1)


def test_refinement_fits_the_pixels_better_than_the_direct_transform():
    rng = np.random.default_rng(2)
    for _ in range(60):
        points = rng.uniform(-2.0, 2.0, (10, 2))
        pixels = apply(VIEW, points) + rng.normal(0.0, 2.0, (10, 2))
        refined, start = fit(points, pixels, 2.0), direct(points, pixels)
        assert np.allclose(refined.residual, pixels - apply(refined.homography.matrix, points))
        assert np.sum(refined.residual**2) <= np.sum((pixels - apply(start, points)) ** 2) + 1e-9


def test_scaling_and_moving_axes_takes_the_covariance_along():
    rng = np.random.default_rng(3)
    points = rng.uniform(-2.0, 2.0, (9, 2))
    found = fit(points, apply(VIEW, points) + rng.normal(0.0, 0.5, (9, 2)), 0.5).homography
    right = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, -1.0], [0.0, 0.0, 1.0]])
    moved = Homography(*rescaled(found.matrix, found.covariance, np.eye(3), right))
    where = np.array([[0.2, -0.6]])
    same = apply(right, where)
    assert np.allclose(apply(moved.matrix, where), apply(found.matrix, same))
    assert np.allclose(moved.pixel_spread(where), found.pixel_spread(same), rtol=1e-6)


@pytest.mark.parametrize(
    ("points", "what"),
    [
        (np.zeros((3, 2)), "3 points; a homography needs 4"),
        (np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [4.0, 4.0]]), "lie on one line"),
        (np.zeros((4, 3)), "points \\(N, 2\\)"),
    ],
)
def test_points_that_fix_no_homography_are_refused(points, what):
    with pytest.raises(ValueError, match=what):
        fit(points, points)


def test_cameras_disagree_by_what_one_of_them_is_off():
    to_plane = np.stack([np.linalg.inv(VIEW), np.linalg.inv(VIEW @ np.diag([1.1, 0.9, 1.0]))])
    point = np.array([[0.7, -0.3]])
    pixels = np.array([apply(np.linalg.inv(H), point)[0] for H in to_plane])
    assert cross_error(pixels, to_plane) < 1e-9
    assert cross_error(pixels + [[3.0, 0.0], [0.0, 0.0]], to_plane) == pytest.approx(3.0, rel=0.2)
    with pytest.raises(ValueError, match="two or more"):
        cross_error(pixels[:1], to_plane[:1])
