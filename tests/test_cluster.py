"""Grid DBSCAN against scikit-learn's and against the plain version."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotd.vision.cluster import dbscan, dbscan_reference


def points(count, seed, *, columns=5, spread=12.0):
    rng = np.random.default_rng(seed)
    blobs = rng.uniform(0.0, spread, (max(count // 25, 1), columns))
    return blobs[rng.integers(0, len(blobs), count)] + rng.normal(0.0, 0.4, (count, columns))


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 250), st.integers(0, 10**6), st.floats(0.1, 2.0), st.integers(1, 9), st.sampled_from([2, 3, 5]))
def test_labels_are_those_of_the_plain_version(count, seed, eps, least, columns):
    features = points(count, seed, columns=columns)
    labels, counts = dbscan(features, eps, least)
    expected, expected_counts = dbscan_reference(features, eps, least)
    np.testing.assert_array_equal(labels, expected)
    np.testing.assert_array_equal(counts, expected_counts)


@pytest.mark.parametrize("seed", range(6))
def test_labels_are_those_of_scikit_learn(seed):
    cluster = pytest.importorskip("sklearn.cluster")
    features = points(1500, seed, spread=30.0)
    for eps, least in ((0.5, 4), (0.8, 8), (1.3, 3)):
        expected = cluster.DBSCAN(eps=eps, min_samples=least).fit(features)
        labels, counts = dbscan(features, eps, least)
        np.testing.assert_array_equal(labels, expected.labels_)
        np.testing.assert_array_equal(np.flatnonzero(counts >= least), expected.core_sample_indices_)


def test_a_border_point_goes_to_the_lower_cluster():
    line = np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0], [1.0, 0.0], [1.8, 0.0], [1.9, 0.0], [2.0, 0.0]])
    labels, _ = dbscan(line, 0.8, 4)
    assert labels.tolist() == [0, 0, 0, 0, 1, 1, 1]


def test_points_on_a_lattice_of_exactly_eps_are_neighbours():
    lattice = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), axis=-1).reshape(-1, 2)
    labels, counts = dbscan(lattice, 1.0, 3)
    np.testing.assert_array_equal(counts, dbscan_reference(lattice, 1.0, 3)[1])
    assert set(labels) == {0}


def test_a_few_far_points_do_not_make_the_grid_outgrow_the_points():
    features = np.vstack([points(200, 1), [[1e7, 1e7, 0, 0, 0]], [[-1e7, 1e7, 0, 0, 0]]])
    np.testing.assert_array_equal(dbscan(features, 0.5, 3)[0], dbscan_reference(features, 0.5, 3)[0])


def test_no_points_give_no_labels():
    labels, counts = dbscan(np.empty((0, 5)), 1.0, 3)
    assert labels.shape == counts.shape == (0,)


@pytest.mark.parametrize("features", [np.zeros(4), np.zeros((4, 1)), np.full((3, 2), np.nan)])
def test_features_that_cannot_be_clustered_are_refused(features):
    with pytest.raises(ValueError, match="need"):
        dbscan(features, 1.0, 3)
