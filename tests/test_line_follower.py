"""The line follower on the simulator's base and camera: bounds, markers, ends, other cameras; and its parts alone."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.drive_path import drive_path, taut
from robotd.geometry.transforms import rotation_vector
from robotd.lost_line import TURN_MOST, LostLine, last_side
from robotd.records import CameraModel, Pose, Transform
from robotd.sim.world import looking
from robotd.vision.line_eye import LineEye
from robotd.vision.line_sight import to_robot
from robotd.vision.markers import MarkFinder, MarkTracker
from tests.line_course import drive, store

# ---- in a closed loop ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corner():
    """Once round a right angle at 0.3 m/s on concrete."""
    layout, _ = store([(0.0, 0.0), (1.0, 0.0), (1.0, 0.9)], texture="concrete")
    return drive(layout, [1.7], seed=3), layout


def test_a_right_angle_is_followed_within_the_bounds_at_full_speed(corner):
    result, _ = corner
    assert result.fault is None
    assert result.cross_track["rms"] < 10.0
    assert result.cross_track["max"] < 30.0
    assert result.travelled == pytest.approx(1.7, abs=0.01)


def test_the_stamps_error_is_learned_in_one_corner(corner):
    result, _ = corner
    true = 0.005 - result.world.camera_offset("floor")  # the middle of the exposure counts
    assert result.driver.tracker.stamp_error == pytest.approx(true, abs=0.012)


def test_motion_by_the_line_is_as_wrong_as_its_information_says(corner):
    result, _ = corner
    body = result.world.body
    squares, dimensions = 0.0, 0
    for motion in result.motions:
        one, two = body.trail_at(motion.t0), body.trail_at(motion.t1)
        (dx, dy), turn = (
            to_robot(np.array([[two.x, two.y]]), one)[0],
            math.remainder(two.heading - one.heading, math.tau),
        )
        error = np.array([motion.dx - dx, motion.dy - dy, math.remainder(motion.dheading - turn, math.tau)])
        information = np.array(motion.information)
        squares += error @ information @ error
        dimensions += np.linalg.matrix_rank(information, tol=1e-3, hermitian=True)
    assert dimensions > 20
    assert 0.4 < squares / dimensions < 2.5


def test_the_stitched_line_is_where_the_tape_is(corner):
    result, layout = corner
    points = np.concatenate([piece.points for piece in result.line_points])
    assert len(points) > 40
    offset = layout.geometry.nearest(points @ np.eye(2) + layout.geometry.point_at(0.0))[0]
    assert np.sqrt((offset**2).mean()) < 0.03  # odometry drifts meanwhile


def test_states_tell_of_the_blind_corner_and_of_standing_at_the_end(corner):
    result, _ = corner
    states = [status.state for status in result.states]
    assert states[0] == "acquiring"
    assert states[-1] == "standing"
    assert states.count("tracking") > 0.5 * len(states)
    assert all(0.0 <= status.confidence <= 1.0 for status in result.states)


def test_the_front_camera_of_the_rig_does_instead_of_a_floor_camera():
    layout, _ = store([(0.0, 0.0), (0.9, 0.0), (0.9, 1.6)], radius=0.3, texture="concrete")
    result = drive(layout, [1.1], seed=0, camera="front", halved=True)
    assert result.fault is None
    assert result.driver.blind > 0.55
    assert result.driver.mode.size == result.world.rig[0].size
    assert result.cross_track["rms"] < 20.0


def test_a_line_that_is_wider_than_was_said_is_followed_as_it_looks():
    layout, _ = store([(0.0, 0.0), (1.2, 0.0)], texture="concrete", width=0.05)
    result = drive(layout, [0.5], line_width=0.036)
    assert result.fault is None
    assert [reason for reason, _, _ in result.stops] == ["distance"]
    assert result.cross_track["rms"] < 10.0


# ---- the path to drive -----------------------------------------------------------------------------------------------

RIGHT_ANGLE = np.array([(-0.5, 0.0), (0.6, 0.0), (0.6, 0.9)])


def deviation(points, line):
    a, b = line[:-1], line[1:]
    step = b - a
    share = np.clip(((points[:, None] - a) * step).sum(axis=2) / (step**2).sum(axis=1), 0.0, 1.0)
    return np.hypot(*np.moveaxis(points[:, None] - a - share[..., None] * step, -1, 0)).min(axis=1)


def test_exact_following_cuts_a_right_angle_by_millimetres_and_keeps_curves():
    path = drive_path(RIGHT_ANGLE)
    assert deviation(path.points, RIGHT_ANGLE).max() < 0.008
    angle = np.linspace(0.0, math.pi / 2, 60)
    arc = 0.2 * np.column_stack([np.cos(angle), np.sin(angle)])
    smooth = drive_path(arc)
    assert np.abs(np.hypot(*smooth.points.T) - 0.2).max() < 0.001
    assert smooth.curvature[len(smooth.s) // 2] == pytest.approx(5.0, rel=0.03)


@settings(deadline=None, max_examples=30)
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(-1.5, 1.5))
def test_more_corner_cutting_never_makes_the_path_longer_nor_leaves_the_corridor(one, two, turn):
    line = np.array([(-0.5, 0.0), (0.6, 0.0), (0.6 + 0.9 * math.cos(turn), 0.9 * math.sin(turn))])
    low, high = sorted((one, two))
    paths = [drive_path(line, cut, 0.06) for cut in (low, high)]
    assert paths[1].length <= paths[0].length + 0.002
    for cut, path in zip((low, high), paths, strict=True):
        assert deviation(path.points, line).max() <= 0.06 * cut + 0.012  # the smoothing's own


def test_a_string_through_a_corridor_bends_only_at_its_inner_side():
    x = np.arange(0.0, 2.0, 0.01)
    wave = np.column_stack([x, 0.04 * np.sin(2 * np.pi * x)])
    string = taut(wave, 0.06)
    assert len(string) == 2  # a corridor that wide lets a straight line through
    assert len(taut(np.column_stack([x, 0.3 * np.sin(2 * np.pi * x)]), 0.06)) > 5


# ---- losing the line -------------------------------------------------------------------------------------------------


def test_the_search_turns_to_the_side_where_the_line_was_and_ends():
    path = np.column_stack([np.linspace(0.0, 1.0, 50), np.linspace(0.0, 0.2, 50)])
    assert last_side(path, Pose(0.0, 0.0, 0.0)) == 1.0
    assert last_side(path, Pose(0.0, 0.0, 1.0)) == -1.0
    search, heading = LostLine(), 0.0
    for _ in range(1000):
        move = search.search(path, Pose(0.0, 0.0, heading), 2.0)
        if move.reason is not None:
            break
        assert move.turn_rate > 0.0
        heading += 0.015 * move.turn_rate
    assert move.state == "lost"
    assert heading == pytest.approx(TURN_MOST, abs=0.02)


def test_searching_again_and_again_at_one_place_is_bounded():
    path, search, turned = np.array([(0.0, 0.0), (1.0, 0.1)]), LostLine(), 0.0
    for attempt in range(100):
        search.forget()
        for k in range(20):
            move = search.search(path, Pose(0.0, 0.0, 0.01 * k), 2.0 + 0.001 * attempt)
            if move.reason is not None:
                assert turned < 2.0 * TURN_MOST
                return
            turned += 0.01
    raise AssertionError("it never gave up")


# ---- pictures --------------------------------------------------------------------------------------------------------


def eye(pitch=35.0, size=(320, 240)):
    mount = Transform(tuple(float(x) for x in rotation_vector(looking(0.0, math.radians(pitch)))), (0.12, 0.0, 0.30))
    camera = CameraModel("floor", size, (228.5, 228.5, 159.5, 119.5), mount)
    return LineEye(camera, 0.05, "dark", 0.0035, (0.2, 1.05), (-0.45, 0.45))


def test_pictures_that_show_nothing_are_named():
    look, rng = eye(), np.random.default_rng(0)
    good = [rng.normal(120, 20, (240, 320)).clip(0, 255).astype(np.uint8) for _ in range(2)]
    assert look.doubt(good[0]) is None
    assert look.doubt(good[1]) is None
    assert look.doubt(good[1].copy()) == "its picture is frozen"
    blank = (rng.normal(3, 1, (240, 320))).clip(0, 255).astype(np.uint8)
    assert "blank" in look.doubt(blank)
    assert look.doubt(rng.integers(252, 256, (240, 320)).astype(np.uint8)) == "its picture is saturated"
    assert look.doubt(np.zeros((2, 3), np.uint8)) == "its pictures are 3x2 pixels instead of 320x240"
    assert "instead of 320x240" in look.doubt(np.zeros((240, 320, 3), np.uint8))
    assert look.doubt(good[0]) is None


def test_a_dim_picture_with_the_last_of_a_tape_is_not_blank():
    dim = np.random.default_rng(1).normal(51, 2, (480, 640))
    dim[455:, 310:330] -= 25.0
    assert eye(size=(640, 480)).doubt(dim.clip(0, 255).astype(np.uint8)) is None


def drawn(view, marks, lines=()):
    """A top view with squares, dots and tape, from robot axes."""
    picture = np.full(view.valid.shape, 150, np.uint8)
    scale = 1.0 / view.metres_per_pixel
    for x, y, shape in marks:
        u, v = view.to_pixels(np.array([[x, y]]))[0]
        half = 0.025 * scale
        if shape == "dot":
            cv2.circle(picture, (round(16 * u), round(16 * v)), round(16 * half), 45, -1, cv2.LINE_AA, 4)
        else:
            box = cv2.boxPoints(((u, v), (2 * half, 2 * half), 20.0))
            cv2.fillPoly(picture, [np.rint(16 * box).astype(np.int32)], 45, cv2.LINE_AA, 4)
    for line in lines:
        pixels = np.rint(16 * view.to_pixels(np.asarray(line, float))).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [pixels], False, 45, round(0.05 * scale), cv2.LINE_AA, 4)
    noise = np.random.default_rng(0).normal(0.0, 2.0, picture.shape)
    return cv2.GaussianBlur(picture, (0, 0), 1.0).astype(float) + noise


@pytest.mark.parametrize("shape", ["square", "dot"])
def test_marks_are_found_where_they_lie_and_lines_are_none(shape):
    view = eye().view
    line = [(0.2, 0.0), (0.7, 0.0), (0.7, -0.4)]
    marks = [(0.6, 0.16, shape), (0.45, -0.15, shape)]
    top = drawn(view, marks, [line]).clip(0, 255).astype(np.uint8)
    found = MarkFinder(view, 0.05, "dark").find(top)
    assert len(found) == 2
    for x, y, _ in marks:
        assert np.hypot(*(found - [x, y]).T).min() < 0.006
    assert len(MarkFinder(view, 0.05, "dark").find(drawn(view, [], [line]).clip(0, 255).astype(np.uint8))) == 0


def test_a_mark_counts_after_several_frames_and_only_beside_the_line():
    tracker, path = MarkTracker(), np.column_stack([np.linspace(0.0, 2.0, 101), np.zeros(101)])
    lengths = path[:, 0]
    for k in range(3):
        tracker.observe(np.array([[1.0 - 0.01 * k, 0.15], [0.9 - 0.01 * k, 0.01]]), Pose(0.01 * k, 0.0, 0.0))
        assert tracker.beside(path, lengths, (0.05, 0.3)) == []
    tracker.observe(np.array([[0.97, 0.15], [0.87, 0.01]]), Pose(0.03, 0.0, 0.0))
    assert tracker.beside(path, lengths, (0.05, 0.3)) == pytest.approx([1.0], abs=0.011)
