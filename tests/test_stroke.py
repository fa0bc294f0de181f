"""The line detector: accuracy in all directions, what it joins, what it refuses, and its kernels against numpy."""

import copy
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.records import Line
from robotd.vision import (
    cluster_reference,
    join_reference,
    measure_reference,
    polyline_reference,
    stroke_reference,
)
from robotd.vision.evidence import believed
from robotd.vision.polyline import arc_length
from robotd.vision.stroke import LineConfig, LineDetector

H, W = 240, 300


def draw(paths, width, *, dark=45, floor=170, noise=2.0, blur=1.0, seed=0, size=(H, W)):
    """Tape along polylines, drawn at four times the resolution."""
    mask = np.zeros((4 * size[0], 4 * size[1]), np.uint8)
    for path in paths:
        corners = np.round(((np.asarray(path, float) + 0.5) * 4 - 0.5) * 16).astype(np.int32)
        cv2.polylines(mask, [corners], False, 255, round(4 * width), cv2.LINE_8, 4)
    cover = cv2.GaussianBlur(cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA) / 255.0, (0, 0), blur)
    image = floor + cover * (dark - floor) + np.random.default_rng(seed).normal(0.0, noise, size)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def straight(angle, width, offset=0.0, dark=40.0, floor=200.0):
    """An ideal straight line through the middle: image, and a function from points to distances from its centre."""
    v, u = np.mgrid[0:H, 0:W].astype(float)
    normal = np.array([-np.sin(angle), np.cos(angle)])
    distance = (u - W / 2) * normal[0] + (v - H / 2) * normal[1] - offset
    image = floor + (dark - floor) * np.clip(0.5 * width - np.abs(distance) + 0.5, 0.0, 1.0)
    image = cv2.GaussianBlur(image, (0, 0), 1.0) + np.random.default_rng(1).normal(0.0, 2.0, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), lambda p: (p - [W / 2, H / 2]) @ normal - offset


def distance_to(points, path):
    """Distance of each point from a dense polyline."""
    return np.sqrt(((points[:, None] - path[None]) ** 2).sum(axis=2)).min(axis=1)


def dense(path):
    path = np.asarray(path, float)
    lengths = arc_length(path)
    s = np.arange(0.0, lengths[-1], 0.5)
    return np.column_stack([np.interp(s, lengths, path[:, 0]), np.interp(s, lengths, path[:, 1])])


@pytest.mark.parametrize("width", [9.0, 17.0, 40.0])
def test_a_clean_line_is_found_to_a_twentieth_of_a_pixel_in_every_direction(width):
    detector = LineDetector(LineConfig("dark", (0.8 * width, 1.25 * width)))
    for degrees in range(0, 180, 15):
        image, distance = straight(np.radians(degrees), width, offset=0.37 * (degrees % 7))
        lines = detector.detect(image)
        assert len(lines) == 1, degrees
        error = distance(lines[0].points)
        assert abs(error.mean()) < 0.05, degrees
        assert np.sqrt((error**2).mean()) < 0.1, degrees
        assert lines[0].width == pytest.approx(width, abs=0.3)
        assert lines[0].confidence > 0.9
        assert arc_length(lines[0].points)[-1] > 0.95 * H


def test_polarity_decides_what_is_a_line():
    dark = draw([[(150, 0), (150, 239)]], 16)
    bright = 255 - dark
    for image, other, polarity in ((dark, bright, "dark"), (bright, dark, "bright")):
        detector = LineDetector(LineConfig(polarity, (13, 20)))
        assert len(detector.detect(image)) == 1
        assert detector.detect(other) == []
    both = LineDetector(LineConfig("both", (13, 20)))
    assert len(both.detect(dark)) == len(both.detect(bright)) == 1


def test_the_width_need_not_be_known():
    for width in (6, 14, 30):
        lines = LineDetector(LineConfig("dark")).detect(draw([[(20, 30), (280, 200)]], width))
        assert len(lines) == 1
        assert lines[0].width == pytest.approx(width, rel=0.1)


def test_a_line_of_another_width_is_refused():
    assert LineDetector(LineConfig("dark", (10, 14))).detect(draw([[(20, 30), (280, 200)]], 30)) == []


def test_a_right_angle_is_one_line_through_its_corner():
    path = [(0, 60), (170, 60), (170, 239)]
    lines = LineDetector(LineConfig("dark", (13, 20))).detect(draw([path], 16))
    assert len(lines) == 1
    assert distance_to(lines[0].points, dense(path)).max() < 3.0
    assert distance_to(dense(path)[8:-8], lines[0].points).max() < 4.0


def test_a_crossing_gives_two_straight_lines():
    one, two = [(0, 40), (299, 190)], [(60, 239), (220, 0)]
    lines = LineDetector(LineConfig("dark", (11, 18))).detect(draw([one, two], 14))
    assert len(lines) == 2
    for path in (one, two):
        assert min(distance_to(line.points, dense(path)).max() for line in lines) < 1.5


def test_gaps_of_two_widths_are_bridged_and_wider_ones_are_not():
    near = draw([[(150, 0), (150, 100)], [(150, 130), (150, 239)]], 16)
    assert len(LineDetector(LineConfig("dark", (13, 20))).detect(near)) == 1
    far = draw([[(150, 0), (150, 85)], [(150, 155), (150, 239)]], 16)
    assert len(LineDetector(LineConfig("dark", (13, 20))).detect(far)) == 2


def test_a_circle_closes():
    angle = np.linspace(0, 2 * np.pi, 200)
    path = np.column_stack([150 + 80 * np.cos(angle), 120 + 80 * np.sin(angle)])
    lines = LineDetector(LineConfig("dark", (11, 18))).detect(draw([path], 14))
    assert len(lines) == 1
    assert np.hypot(*(lines[0].points[0] - lines[0].points[-1])) < 1.0
    radius = np.hypot(*(lines[0].points - [150, 120]).T)
    assert np.abs(radius - 80).max() < 1.0


def test_two_lines_with_sharp_turns_share_no_points():
    angle = np.linspace(np.pi, 0.0, 40)
    bow = np.column_stack([75 + 30 * np.cos(angle), 70 - 30 * np.sin(angle)])
    paths = [[(45, 239), *bow, (105, 239)], [(190, 0), (190, 120), (299, 120)]]
    lines = LineDetector(LineConfig("dark", (9, 14))).detect(draw(paths, 12))
    assert len(lines) == 2
    for path in paths:
        assert min(distance_to(line.points, dense(path)).max() for line in lines) < 3.0


def test_a_line_is_found_in_a_deep_shadow_beside_bright_light():
    image = draw([[(60, 0), (100, 239)]], 14, dark=120, noise=2.0)
    image[:, :150] = (0.3 * image[:, :150]).astype(np.uint8)
    texture = np.random.default_rng(5).normal(0.0, 60.0, (H, W - 150))
    image[:, 150:] = np.clip(170.0 + cv2.GaussianBlur(texture, (0, 0), 1.2), 0, 255).astype(np.uint8)
    lines = LineDetector(LineConfig("dark", (11, 18))).detect(image)
    assert len(lines) == 1
    assert distance_to(lines[0].points, dense([(60, 0), (100, 239)])).max() < 2.0


def test_low_contrast_is_enough():
    image = draw([[(0, 60), (299, 180)]], 16, dark=110, floor=150, noise=3.0)
    lines = LineDetector(LineConfig("dark", (13, 20))).detect(image)
    assert len(lines) == 1
    assert distance_to(lines[0].points, dense([(-20, 52), (320, 188)])).max() < 1.0


@pytest.mark.parametrize("grain", [0.7, 1.5, 3.0, 8.0])
def test_textured_floors_have_no_line(grain):
    for seed in range(6):
        texture = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, (H, W)), (0, 0), grain)
        image = np.clip(130 + 30 * texture / texture.std(), 0, 255).astype(np.uint8)
        assert LineDetector(LineConfig("both", (12, 20))).detect(image) == []


@pytest.mark.parametrize("level", [0, 255])
def test_blank_and_saturated_frames_have_no_line(level):
    assert LineDetector(LineConfig("both")).detect(np.full((H, W), level, np.uint8)) == []


def test_one_edge_of_a_shadow_is_no_line():
    image = np.full((H, W), 180, np.uint8)
    image[:, 140:] = 90
    assert LineDetector(LineConfig("both", (12, 20))).detect(image) == []


@pytest.mark.parametrize("tilt", [0.0, 0.08, 0.2])
@pytest.mark.parametrize("gap", [14, 18, 22])
def test_the_strip_between_a_joint_and_a_shadow_is_no_line(gap, tilt):
    v, u = np.mgrid[0:H, 0:W]
    image = np.full((H, W), 150.0)
    image[u > 150 + gap + tilt * (v - H / 2)] *= 0.5
    image[:, 146:150] = 90.0
    image = cv2.GaussianBlur(image, (0, 0), 1.0) + np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    assert LineDetector(LineConfig("bright", (14, 28))).detect(image.astype(np.uint8)) == []


def test_a_line_wider_than_asked_for_is_refused_to_half_a_pixel():
    image = draw([[(150, 0), (150, 239)]], 26)
    assert LineDetector(LineConfig("dark", (15, 25))).detect(image) == []
    (line,) = LineDetector(LineConfig("dark", (15, 26))).detect(image)
    assert line.width == pytest.approx(26.0, abs=0.4)


def test_a_line_between_two_others_a_width_and_a_half_off_is_found():
    image = draw([[(u, 0), (u, 239)] for u in (110, 150, 190)], 16)
    lines = LineDetector(LineConfig("dark", (12, 21))).detect(image)
    assert sorted(round(float(line.points[:, 0].mean())) for line in lines) == [110, 150, 190]


def test_nothing_is_found_where_the_view_is_not_valid():
    image = draw([[(0, 120), (299, 120)]], 16)
    valid = np.ones((H, W), bool)
    valid[:, :150] = False
    image[:, :150] = 0  # a black fill makes strong edges
    lines = LineDetector(LineConfig("dark", (13, 20))).detect(image, valid)
    assert len(lines) == 1
    assert lines[0].points[:, 0].min() > 149
    assert LineDetector(LineConfig("dark", (13, 20))).detect(image, np.zeros((H, W), bool)) == []


def test_a_reused_detector_gives_the_same_lines_and_keeps_its_buffers():
    detector = LineDetector(LineConfig("dark", (13, 20)))
    first = draw([[(0, 60), (299, 180)]], 16)
    expected = detector.detect(first)[0].points
    buffers = {id(buffer) for buffer in detector._workspaces.values()}
    detector.detect(np.full((H, W), 90, np.uint8))
    np.testing.assert_array_equal(detector.detect(first)[0].points, expected)
    assert {id(buffer) for buffer in detector._workspaces.values()} == buffers


@pytest.mark.parametrize("variant", ["robotd", "thesis"])
def test_a_kept_line_does_not_change_when_the_next_frame_is_searched(variant):
    detector = LineDetector(LineConfig("dark", (13, 20), variant=variant))
    kept = detector.detect(draw([[(0, 60), (299, 180)], [(20, 239), (60, 0)]], 16))
    assert kept
    before = copy.deepcopy(kept)
    detector.detect(draw([[(0, 180), (150, 40), (299, 200)]], 16, seed=1))
    for line, copied in zip(kept, before, strict=True):
        for name in ("points", "normals", "curvature"):
            np.testing.assert_array_equal(getattr(line, name), getattr(copied, name))


def test_a_doubtful_line_is_believed_only_beside_a_sure_one_of_its_width_and_colour():
    def line(confidence, width=10.0, polarity="dark"):
        return Line(np.zeros((2, 2)), width, confidence, polarity=polarity)

    sure, alike, weak = line(0.8), line(0.2, 11.5), line(0.1)
    wide, bright = line(0.3, 14.0), line(0.3, 10.0, "bright")
    assert believed([sure, alike, wide, bright, weak], 0.4) == [sure, alike]
    assert believed([alike, wide, bright], 0.4) == []
    assert believed([sure, alike, weak], 0.0) == [sure, alike, weak]


def test_the_other_arm_of_a_corner_seen_from_the_side_may_be_narrower_than_asked_for():
    near, far = draw([[(20, 60), (170, 60)]], 16), draw([[(190, 90), (215, 230)]], 11, seed=1)
    detector = LineDetector(LineConfig("dark", (13.5, 18.5)))
    assert detector.detect(far) == []
    widths = sorted(line.width for line in detector.detect(np.minimum(near, far)))
    assert widths == pytest.approx([11.0, 16.0], abs=0.5)


def test_frames_leave_no_memory_behind():
    detector = LineDetector(LineConfig("both", (10, 20)))
    frames = [draw([[(20 * k, 0), (100 + 20 * k, 239)]], 14, seed=k) for k in range(4)]
    for frame in frames * 3:
        detector.detect(frame)
    tracemalloc.start()
    try:
        for frame in frames:
            detector.detect(frame)
        before, _ = tracemalloc.get_traced_memory()
        for frame in frames * 10:
            detector.detect(frame)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 4096


@pytest.mark.parametrize("name", ["stroke", "cluster", "polyline", "join", "measure"])
def test_kernels_release_the_interpreter(name):
    functions = (Path(__file__).parents[1] / "cython" / f"{name}.pyx").read_text().split("\ndef ")[1:]
    assert functions
    assert all("    with nogil:\n" in function for function in functions)


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 999), st.sampled_from(["dark", "bright", "both"]))
def test_any_image_is_survived(height, width, seed, polarity):
    image = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    for widths in (None, (3.0, 30.0)):
        for line in LineDetector(LineConfig(polarity, widths, 0.0)).detect(image):
            assert np.isfinite(line.points).all()
            assert line.points.shape[1] == 2
            assert 0.0 <= line.confidence <= 1.0


@pytest.mark.parametrize("image", [np.zeros((8, 8, 3), np.uint8), np.zeros((8, 8)), np.zeros(8, np.uint8)])
def test_images_of_another_kind_are_refused(image):
    with pytest.raises(ValueError, match="grey image"):
        LineDetector().detect(image)


@pytest.mark.parametrize("config", [dict(polarity="grey"), dict(width_px=(0.0, 5.0)), dict(width_px=(9.0, 5.0))])
def test_configurations_that_mean_nothing_are_refused(config):
    with pytest.raises(ValueError, match="expected"):
        LineConfig(**config)


# ---- kernels ---------------------------------------------------------------------------------------------------------


def scene(seed):
    rng = np.random.default_rng(seed)
    path = rng.uniform([0, 0], [120, 90], (3, 2))
    image = draw([path], 11, seed=seed, noise=12.0, size=(90, 120))
    valid = np.ones(image.shape, np.uint8)
    valid[:, : int(rng.integers(0, 30))] = 0
    blurred = cv2.GaussianBlur(image, (5, 5), 1.0)
    return cv2.Sobel(blurred, cv2.CV_16S, 1, 0), cv2.Sobel(blurred, cv2.CV_16S, 0, 1), valid


def run(kernels, seed, sign=-1.0, most=2700, masked=True):
    gx, gy, valid = scene(seed)
    if not masked:
        valid = np.empty((0, 0), np.uint8)
    index, sector = np.full(gx.shape, -1, np.int32), np.empty(gx.shape, np.uint8)
    edge, partner, stroke = np.empty((most, 5), np.float32), np.empty(most, np.int32), np.empty((most, 6), np.float32)
    levels = np.empty((gx.shape[0] // 32, 3 * (gx.shape[1] // 32)), np.float32)
    found, level = kernels.edges(gx, gy, valid, 1.3, 24.0, 90.0, levels, index, sector, edge)
    count = kernels.strokes(edge, found, index, sector, 8.0, 15.0, sign, 0.88, 0.4, partner, stroke)
    return found, level, sector, np.where(sector > 0, index, -1), edge[:found], partner[:found], stroke[:count]


@pytest.mark.parametrize("masked", [True, False])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("seed", range(8))
def test_edges_and_strokes_are_those_of_numpy(seed, sign, masked):
    _stroke = pytest.importorskip("robotd.vision._stroke", reason="built without extensions")
    ours, plain = run(_stroke, seed, sign, masked=masked), run(stroke_reference, seed, sign, masked=masked)
    assert ours[0] == plain[0] > 100
    assert ours[1] == pytest.approx(plain[1], rel=1e-5)
    for k in (2, 3, 5):
        np.testing.assert_array_equal(ours[k], plain[k])
    for k in (4, 6):
        np.testing.assert_allclose(ours[k], plain[k], rtol=1e-5, atol=1e-4)


def test_kernels_drop_what_does_not_fit_their_buffers():
    _stroke = pytest.importorskip("robotd.vision._stroke", reason="built without extensions")
    ours, plain = run(_stroke, 3, most=50), run(stroke_reference, 3, most=50)
    assert ours[0] == plain[0] == 50
    np.testing.assert_array_equal(ours[3], plain[3])
    np.testing.assert_allclose(ours[4], plain[4], rtol=1e-5, atol=1e-4)


def test_the_plain_kernels_find_the_same_lines(monkeypatch):
    image = draw([[(0, 60), (170, 60), (170, 239)]], 16)
    expected = LineDetector(LineConfig("dark", (13, 20))).detect(image)
    plain = dict(
        kernels=stroke_reference,
        clustering=cluster_reference,
        tracing=polyline_reference,
        joining=join_reference,
        measuring=measure_reference,
    )
    for name, module in plain.items():
        monkeypatch.setattr(f"robotd.vision.stroke.{name}", module)
    monkeypatch.setattr("robotd.vision.cluster.kernels", cluster_reference)
    lines = LineDetector(LineConfig("dark", (13, 20))).detect(image)
    assert len(lines) == len(expected) == 1
    np.testing.assert_allclose(lines[0].points, expected[0].points, atol=0.02)
    np.testing.assert_allclose(lines[0].curvature, expected[0].curvature, atol=1e-3)
