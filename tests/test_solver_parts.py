import numpy as np
import pytest

from robotd.geometry.transforms import invert_rigid, pose_matrix, transform_points
from robotd.records import Map, MappedLabel, SolverRun
from robotd.solver import evaluate
from robotd.solver.initial import locate, triangulate
from robotd.solver.linear import triangulate_linear


def test_triangulation_outvotes_outliers_and_refuses_points_behind_the_cameras():
    rng = np.random.default_rng(0)
    origin = np.column_stack([np.arange(6.0), np.zeros(6), np.full(6, 0.5)])
    target = np.array([2.0, 3.0, 0.9])
    direction = target - origin
    direction[4:] = rng.normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    label, stop = np.zeros(6, int), np.arange(6)
    points, found = triangulate(origin, direction, label, stop, np.ones(6), 1, 0.015)
    assert found.all()
    np.testing.assert_allclose(points[0], target, atol=1e-9)
    _, found = triangulate(origin[:2], -direction[:2], label[:2], stop[:2], np.ones(2), 1, 0.015)
    assert not found.any()


def test_rays_from_one_stop_never_make_a_point():
    origin = np.array([[0.06, 0.0, 0.5], [0.0, 0.06, 0.5]])
    direction = np.array([[0.7, 0.7, 0.1], [0.71, 0.69, 0.1]])
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    _, found = triangulate(origin, direction, np.zeros(2, int), np.zeros(2, int), np.ones(2), 1, 0.1)
    assert not found.any()


def test_locate_finds_a_pose_from_rays_to_known_points():
    rng = np.random.default_rng(2)
    target = rng.uniform([-2, -2, 0.2], [2, 2, 1.5], (12, 3))
    pose = np.array([0.4, -0.3, 2.2])
    origin = np.tile([0.0, 0.0, 0.5], (12, 1))
    direction = transform_points(invert_rigid(pose_matrix(*pose)), target) - origin
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    direction[:4] = np.roll(direction[:4], 1, axis=0)
    found = locate(origin, direction, target, np.arange(12))
    assert found is not None
    np.testing.assert_allclose(found[0], pose, atol=1e-6)
    assert found[1][4:].all()


def test_linear_triangulation_solves_the_thesis_equations():
    target = np.array([1.0, 0.3, 4.0])
    T = np.array(
        [np.eye(4)[:3], np.column_stack([np.eye(3), [-0.5, 0.1, 0.0]]), np.column_stack([np.eye(3), [0.7, 0, 1]])]
    )
    seen = T @ [*target, 1.0]
    position, scales = triangulate_linear(seen / np.linalg.norm(seen, axis=1)[:, None], T)
    np.testing.assert_allclose(position, target, atol=1e-12)
    assert (scales > 0.0).all()
    behind = triangulate_linear(-seen, T)[1]
    assert (behind < 0.0).all()
    with pytest.raises(ValueError, match="2 or more views"):
        triangulate_linear(seen[:1], T[:1])


def test_evaluation_counts_and_aligns():
    truth = {
        "a": (0.0, 0.0, 0.0),
        "b": (1.0, 0.0, 0.0),
        "c": (0.0, 2.0, 0.5),
        "d": (1.0, 1.0, 1.0),
        "lost": (9.0, 9.0, 9.0),
    }
    T = pose_matrix(1.0, 2.0, 0.3)
    labels = [
        MappedLabel(k, "placed", tuple(map(float, T[:3, :3] @ p + T[:3, 3]))) for k, p in truth.items() if k != "lost"
    ]
    labels += [MappedLabel("lost", "unplaced", reason="x"), MappedLabel("ghost", "placed", (0.0, 0.0, 0.0))]
    result = Map("t", "first stop", tuple(labels), (), (), 0.0, 0.0, SolverRun(1, True, "bundle"))
    raw = evaluate(result, truth)
    assert (raw.labels_total, raw.labels_placed, raw.labels_false) == (5, 4, 1)
    assert raw.error_mm["max"] > 1000.0
    for align in ("se2", "se3"):
        assert evaluate(result, truth, align=align).error_mm["max"] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match="align must be"):
        evaluate(result, truth, align="scale")


def test_evaluating_an_empty_map_gives_no_numbers():
    score = evaluate(Map("t", "first stop", (), (), (), 0.0, 0.0, SolverRun(0, True, "bundle")), {"a": (0.0, 0.0, 0.0)})
    assert score.labels_placed == 0
    assert score.error_mm == {"mean": None, "median": None, "p95": None, "max": None}
