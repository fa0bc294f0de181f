"""Tracing, joining, judging and measuring: the kernels against numpy, and what polylines mean."""

import cv2
import numpy as np
import pytest

from robotd.vision import _join, _measure, _polyline, join_reference, measure_reference, polyline_reference
from robotd.vision.polyline import arc_length, resample, sharpened
from robotd.vision.stroke import LineConfig, LineDetector

NO_MASK = np.empty((0, 0), np.uint8)


def strokes_along(paths, width, seed, slope=0.0):
    """One stroke a pixel along polylines, with noise, sorted by row or column as `cluster.sort` does."""
    rng = np.random.default_rng(seed)
    rows = []
    for path in paths:
        points = resample(np.asarray(path, float), 1.0)
        tangent = np.gradient(points, axis=0)
        angle = np.arctan2(tangent[:, 1], tangent[:, 0]) + rng.normal(0.0, 0.08, len(points))
        widths = width + slope * np.arange(len(points)) + rng.normal(0.0, 0.2, len(points))
        places = points + rng.normal(0.0, 0.25, points.shape)
        rows.append(np.column_stack([places, np.cos(angle), np.sin(angle), widths, np.full(len(points), 90.0)]))
    stroke = np.vstack(rows)
    axis = int(np.ptp(stroke[:, 1]) > np.ptp(stroke[:, 0]))
    return stroke[np.argsort(stroke[:, axis].astype(int), kind="stable")].astype(np.float32), axis


def traced(kernels, stroke, axis):
    count = len(stroke)
    points, pieces = np.zeros((3000, 2), np.float32), np.zeros((20, 11), np.float32)
    found = kernels.trace(
        stroke, np.arange(count, dtype=np.int32)[::-1].copy(), np.array([0, count], np.int32),
        np.array([axis], np.int32), 0.82, 0.8, 0.16, np.empty(count, np.uint8), np.empty((count, 2), np.float32),
        np.empty((900, 2), np.float32), np.empty((900, 2), np.float32), points, pieces,
    )  # fmt: skip
    return found, points, pieces


def floor_with(paths, width, seed, size=(160, 170), dark=60.0):
    """Dark tape along polylines, in working pixels."""
    mask = np.zeros((4 * size[0], 4 * size[1]), np.uint8)
    for path in paths:
        cv2.polylines(mask, [np.round(4 * np.asarray(path, float)).astype(np.int32)], False, 255, round(4 * width))
    cover = cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA) / 255.0
    grey = 170.0 - (170.0 - dark) * cover + np.random.default_rng(seed).normal(0.0, 3.0, size)
    return np.clip(cv2.GaussianBlur(grey, (0, 0), 0.9), 0, 255).astype(np.uint8)


def joined(kernels, image, found, points, pieces):
    out_points, out = np.zeros((3000, 2), np.float32), np.zeros((20, 11), np.float32)
    count = kernels.join(image, NO_MASK, -1.0, points, pieces, found, out_points, out)
    return count, out_points[: int(out[:count, 1].sum())], out[:count]


PATHS = {
    "straight": [[(10, 20), (150, 90)]],
    "bend": [[(10, 20), (80, 30), (130, 70), (150, 130)]],
    "crossing": [[(10, 60), (150, 62)], [(80, 5), (83, 60)], [(84, 70), (88, 130)]],
    "dashes": [[(10, 20), (40, 30)], [(55, 35), (85, 45)], [(100, 50), (130, 60)]],
    "corner": [[(10, 60), (92, 60)], [(100, 68), (100, 140)]],
}


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("seed", range(3))
def test_traces_and_joints_are_those_of_numpy(name, seed):
    stroke, axis = strokes_along(PATHS[name], 11.0, seed)
    ours, plain = traced(_polyline, stroke, axis), traced(polyline_reference, stroke, axis)
    assert ours[0] == plain[0] >= 1
    np.testing.assert_allclose(ours[1], plain[1], atol=2e-2)
    np.testing.assert_allclose(ours[2], plain[2], rtol=1e-3, atol=2e-3)
    image = floor_with(PATHS[name], 11.0, seed)
    one, two = joined(_join, image, *ours), joined(join_reference, image, *ours)
    assert one[0] == two[0]
    np.testing.assert_allclose(one[1], two[1], atol=1e-3)
    np.testing.assert_allclose(one[2], two[2], rtol=1e-3, atol=1e-3)


def test_a_taper_is_measured_and_is_no_spread():
    stroke, axis = strokes_along([[(10, 20), (150, 20)]], 9.0, 1, slope=0.05)
    found, _, pieces = traced(_polyline, stroke, axis)
    assert found == 1
    assert abs(pieces[0, 3]) == pytest.approx(0.05, abs=0.005)
    assert pieces[0, 4] < 0.3


@pytest.mark.parametrize(("name", "lines"), [("dashes", 1), ("corner", 1), ("crossing", 2)])
def test_dashes_and_corners_are_joined_and_crossings_go_straight_on(name, lines):
    found = traced(_polyline, *strokes_along(PATHS[name], 11.0, 2))
    assert joined(_join, floor_with(PATHS[name], 11.0, 2), *found)[0] == lines


def test_pieces_of_other_contrast_are_not_joined():
    bold, faint = PATHS["corner"][:1], PATHS["corner"][1:]
    found = traced(_polyline, *strokes_along([*bold, *faint], 11.0, 2))
    image = np.minimum(floor_with(bold, 11.0, 2), floor_with(faint, 11.0, 2, dark=140.0))
    assert joined(_join, image, *found)[0] == 2


def extended(kernels, image, path, width, valid=NO_MASK):
    path = resample(np.asarray(path, float), 4.0).astype(np.float32)
    length = arc_length(path.astype(float))[-1]
    pieces = np.array([[0, len(path), width, 0.0, 0.5, 20, 20, 70, 0, 0.3, length]], np.float32)
    out_points, out = np.zeros((500, 2), np.float32), np.zeros((1, 11), np.float32)
    added = kernels.extend(
        image, valid, -1.0, path, pieces, 1, np.empty((200, 2), np.float32), out_points, out
    )  # fmt: skip
    return added, out_points[: int(out[0, 1])], out


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", ["straight", "bend", "crossing", "corner"])
def test_what_follows_a_piece_is_that_of_numpy(name, masked):
    valid = NO_MASK
    if masked:
        valid = np.ones((160, 170), np.uint8)
        valid[:, 120:] = 0
    image = floor_with(PATHS[name], 11.0, 4)
    known = resample(np.asarray(PATHS[name][0], float), 2.0)[12:26]
    ours, plain = extended(_join, image, known, 11.0, valid), extended(join_reference, image, known, 11.0, valid)
    assert ours[0] == plain[0] > 3
    np.testing.assert_allclose(ours[1], plain[1], atol=0.02)
    np.testing.assert_allclose(ours[2], plain[2], rtol=1e-3, atol=0.02)


def test_a_line_is_followed_round_bends_and_through_shadows_to_its_end():
    path = np.array([[20.0, 20.0], [60.0, 24.0], [100.0, 50.0], [130.0, 100.0]])
    image = floor_with([path], 10.0, 1)
    image[:, 70:] = (0.4 * image[:, 70:]).astype(np.uint8)  # a shadow with a hard edge
    _, points, _ = extended(_join, image, [(30.0, 21.0), (55.0, 23.5)], 10.0)
    assert np.hypot(*(points[0] - path[0])) < 8.0
    assert np.hypot(*(points[-1] - path[-1])) < 8.0
    truth = resample(path, 0.5)
    assert np.sqrt(((points[:, None] - truth[None]) ** 2).sum(axis=2)).min(axis=1).max() < 2.5


def picture(seed, width=16.0):
    rng = np.random.default_rng(seed)
    mask = np.zeros((480, 640), np.uint8)
    path = np.array([[-20, 30], [90, 50 + 10 * seed], [180, 90]], float)
    cv2.polylines(mask, [np.round(4 * path).astype(np.int32)], False, 255, round(4 * width), cv2.LINE_AA)
    cover = cv2.resize(mask, (160, 120), interpolation=cv2.INTER_AREA) / 255.0
    grey = 170.0 - 110.0 * cover + rng.normal(0.0, 4.0, cover.shape)
    image = np.clip(cv2.GaussianBlur(grey, (0, 0), 0.8), 0, 255).astype(np.uint8)
    return image, path.astype(np.float32)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_evidence_is_that_of_numpy(seed, masked):
    image, path = picture(seed)
    valid = NO_MASK
    if masked:
        valid = np.ones(image.shape, np.uint8)
        valid[:, :40] = 0
    path = resample(path[1:].astype(float), 6.0).astype(np.float32)
    length = arc_length(path.astype(float))[-1]
    row = [0, len(path), 16.0, 0.01, 0.5, 20, 21, 70, 0, 0.3, length]
    pieces = np.array([row, row], np.float32)
    pieces[1, 1] = 4
    results = []
    for kernels in (_measure, measure_reference):
        out = np.full((2, 17), 9.0, np.float32)
        kernels.judge(image, valid, path, pieces, 2, -1.0, 100, np.empty((900, 2), np.float32), out)
        results.append(out)
    assert results[0][0, 0] == 1.0
    np.testing.assert_allclose(*results, atol=0.02)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("grain", [1.0, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_measured_borders_are_those_of_numpy(seed, grain, masked):
    image, path = picture(seed)
    valid = NO_MASK
    if masked:
        valid = np.ones(image.shape, np.uint8)
        valid[:, 130:] = 0
    path = ((resample(np.maximum(path, 3.0).astype(float), 5.0)[2:-4] + 0.5) / grain - 0.5).astype(np.float32)
    results = []
    for kernels in (_measure, measure_reference):
        out = np.empty((500, 2))
        count, *rest = kernels.refine(
            image, valid, path, 16.5 / grain, 0.0, False, grain, -1.0, np.empty((4000, 2), np.float32), out
        )
        results.append((count, *rest, out[:count]))
    assert results[0][0] == results[1][0] > 20
    assert results[0][1] == pytest.approx(16.0, abs=0.7)
    for ours, plain in zip(*results, strict=True):
        np.testing.assert_allclose(ours, plain, atol=2e-2)


@pytest.mark.parametrize("closed", [False, True])
def test_curvature_of_a_circle_is_one_over_its_radius(closed):
    angle = np.linspace(0.0, 2.0 * np.pi if closed else 4.0, 120)
    points = 50.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    results = []
    for kernels in (_measure, measure_reference):
        normals, heading, curvature = np.empty((120, 2)), np.empty(120), np.empty(120)
        kernels.shape(points, 30.0, closed, normals, heading, curvature)
        np.testing.assert_allclose(curvature[2:-2], 1.0 / 50.0, rtol=0.02)
        np.testing.assert_allclose(normals[5:-5], -points[5:-5] / 50.0, atol=0.01)  # from u towards v: inwards here
        results.append((normals, heading, curvature))
    for ours, plain in zip(*results, strict=True):
        np.testing.assert_allclose(ours, plain, atol=1e-9)


def test_cut_corners_are_put_back_and_curves_stay():
    arm = np.arange(0.0, 90.0, 2.0)
    cut = np.vstack(
        [np.column_stack([arm, 0 * arm]), [[92.0, 1.0], [95.0, 5.0]], np.column_stack([0 * arm + 97.0, arm + 8.0])]
    )
    sharp = sharpened(cut, 20.0)
    assert np.hypot(*(sharp - [97.0, 0.0]).T).min() < 0.6
    angle = np.linspace(0.0, 2.5, 80)
    for radius in (30.0, 60.0, 120.0):
        curve = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        assert sharpened(curve, 20.0) is curve or len(sharpened(curve, 20.0)) == len(curve)


def test_lines_carry_normals_curvature_and_polarity():
    image, _ = picture(1)
    (line,) = LineDetector(LineConfig("dark", (13.0, 20.0))).detect(image)
    assert line.polarity == "dark"
    assert not line.closed
    assert line.normals.shape == line.points.shape
    assert line.curvature.shape == (len(line.points),)
    step = np.diff(line.points, axis=0)
    assert np.abs((step * line.normals[1:]).sum(axis=1)).max() < 0.3 * np.hypot(*step.T).max()
    assert not line.normals.flags.writeable


def test_the_thesis_variant_needs_ten_widths_and_is_blind_to_horizontal_lines():
    image = np.full((240, 320), 190, np.uint8)
    image[:, 150:160] = 40
    thesis = LineDetector(LineConfig("dark", (8.0, 13.0), variant="thesis"))
    (line,) = thesis.detect(cv2.GaussianBlur(image, (0, 0), 0.6))
    assert np.abs(line.points[:, 0] - 154.5).max() < 1.5
    assert thesis.detect(cv2.GaussianBlur(image, (0, 0), 0.6).T[:240].copy()) == []
    wide = np.full((240, 320), 190, np.uint8)
    wide[:, 150:190] = 40
    assert LineDetector(LineConfig("dark", (30.0, 50.0), variant="thesis")).detect(wide) == []
    assert len(LineDetector(LineConfig("dark", (30.0, 50.0))).detect(wide)) == 1
