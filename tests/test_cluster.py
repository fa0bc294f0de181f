"""Grid DBSCAN against scikit-learn's and against the plain version."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.vision import cluster_reference
from robotd.vision.cluster import dbscan

_cluster = pytest.importorskip("robotd.vision._cluster", reason="built without extensions")


def points(count, seed, *, columns=5, spread=12.0):
    rng = np.random.default_rng(seed)
    blobs = rng.uniform(0.0, spread, (max(count // 25, 1), columns))
    return blobs[rng.integers(0, len(blobs), count)] + rng.normal(0.0, 0.4, (count, columns))


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 250), st.integers(0, 10**6), st.floats(0.1, 2.0), st.integers(1, 9), st.sampled_from([2, 3, 5]))
def test_labels_are_those_of_the_plain_version(count, seed, eps, least, columns):
    features = points(count, seed, columns=columns)
    labels, counts = dbscan(features, eps, least)
    expected, expected_counts = cluster_reference.dbscan(features, eps, least)
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
    np.testing.assert_array_equal(counts, cluster_reference.dbscan(lattice, 1.0, 3)[1])
    assert set(labels) == {0}


def test_a_few_far_points_do_not_make_the_grid_outgrow_the_points():
    features = np.vstack([points(200, 1), [[1e7, 1e7, 0, 0, 0]], [[-1e7, 1e7, 0, 0, 0]]])
    np.testing.assert_array_equal(dbscan(features, 0.5, 3)[0], cluster_reference.dbscan(features, 0.5, 3)[0])


def test_no_points_give_no_labels():
    labels, counts = dbscan(np.empty((0, 5)), 1.0, 3)
    assert labels.shape == counts.shape == (0,)


@pytest.mark.parametrize("features", [np.zeros(4), np.zeros((4, 1)), np.full((3, 2), np.nan)])
def test_features_that_cannot_be_clustered_are_refused(features):
    with pytest.raises(ValueError, match="need"):
        dbscan(features, 1.0, 3)


def test_known_bounds_give_the_same_labels():
    features = points(400, 5)
    bounds = tuple(float(x) for x in (*features[:, :2].min(axis=0), *features[:, :2].max(axis=0) + 1.0))
    for ours, plain in zip(dbscan(features, 0.6, 4, bounds), dbscan(features, 0.6, 4), strict=True):
        np.testing.assert_array_equal(ours, plain)


@pytest.mark.parametrize("seed", range(5))
def test_features_and_sorting_are_those_of_numpy(seed):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-3.0, 3.0, 300)
    stroke = np.column_stack(
        [rng.uniform(1, 90, (300, 2)), np.cos(angle), np.sin(angle), rng.uniform(5, 20, 300), rng.uniform(9, 99, 300)]
    ).astype(np.float32)
    results = []
    for kernels in (_cluster, cluster_reference):
        features = np.empty((300, 5))
        kernels.features(stroke, 4.0, 4.0, 0.9, features)
        labels, counts = dbscan(np.ascontiguousarray(features[:, :2]), 1.2, 4)
        work, out = np.empty((4, 300), np.int32), np.zeros((300, 6), np.float32)
        out_counts, first, axis = np.zeros(300, np.int32), np.zeros(9, np.int32), np.zeros(8, np.int32)
        kept = kernels.sort(stroke, labels, counts, int(labels.max()) + 1, 6, work, out, out_counts, first, axis)
        results.append((features, kept, first[: kept + 1], axis[:kept], out[: first[kept]], out_counts[: first[kept]]))
    assert results[0][1] >= 3
    for ours, plain in zip(*results, strict=True):
        np.testing.assert_allclose(ours, plain, rtol=1e-6, atol=1e-6)
