"""The top view, and the memory of the line: what it bridges, corrects and refuses."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.geometry.camera import Camera
from robotd.records import CameraModel, Line, Pose, Transform
from robotd.vision.line_icp import LineOdometer, View, motion_between
from robotd.vision.line_sight import to_robot
from robotd.vision.line_tracker import LineTracker, PoseHistory, TrackerConfig
from robotd.vision.polyline import arc_length
from robotd.vision.stroke import LineConfig, LineDetector
from robotd.vision.top_view import TopView


def floor_camera(distortion=(-0.05, 0.01, 0.0002, -0.0002, 0.0)):
    """0.30 m high, 35 degrees down, looking forward."""
    c, s = math.cos(math.radians(35)), math.sin(math.radians(35))
    R = np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]])
    rotation, _ = cv2.Rodrigues(R)
    mount = Transform(tuple(float(x) for x in rotation.ravel()), (0.12, 0.0, 0.30))
    return CameraModel("floor", (320, 240), (228.5, 228.5, 159.5, 119.5), mount, distortion=distortion)


VIEW = TopView(floor_camera())


def straight_history(*, speed=0.2, turn_rate=0.0, duration=3.0):
    history = PoseHistory(duration + 1.0)
    x = y = heading = 0.0
    for k in range(int(duration / 0.015)):
        history.add(k * 0.015, Pose(x, y, heading))
        middle = heading + 0.5 * turn_rate * 0.015
        x, y, heading = x + 0.015 * speed * math.cos(middle), y + 0.015 * speed * math.sin(middle), heading
        heading += turn_rate * 0.015
    return history


def seen(path, pose, noise=0.0, seed=0):
    """The Lines that the detector would find of a path in odometry axes: one for each run of it in view."""
    away = path - np.array([pose.x, pose.y])
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    robot = np.column_stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]])
    shown = VIEW.shows(robot)
    robot = robot + np.random.default_rng(seed).normal(0.0, noise, robot.shape)
    runs = np.split(np.arange(len(robot)), np.flatnonzero(np.diff(shown.astype(int))) + 1)
    return [Line(VIEW.to_pixels(robot[run]), 14.0, 0.9) for run in runs if shown[run[0]] and len(run) > 5]


def line_along_x(y=0.0, length=4.0):
    return np.column_stack([np.arange(-0.5, length, 0.01), np.full(round((length + 0.5) / 0.01), y)])


def distance_to(points, path):
    return np.sqrt(((points[:, None] - path[None]) ** 2).sum(axis=2)).min(axis=1)


def test_pixels_and_metres_are_inverse():
    pixels = np.random.default_rng(0).uniform(0, 200, (50, 2))
    np.testing.assert_allclose(VIEW.to_pixels(VIEW.to_robot(pixels)), pixels, atol=1e-9)
    top, bottom = VIEW.to_robot(np.array([[100.0, 0.0], [100.0, 200.0]]))
    left, right = VIEW.to_robot(np.array([[0.0, 100.0], [200.0, 100.0]]))
    assert top[0] > bottom[0]
    assert left[1] > right[1]


def test_the_view_shows_what_the_camera_sees():
    robot = np.array([[0.5, 0.0], [0.5, 0.3], [0.1, 0.0], [0.32, 0.4], [-1.0, 0.0], [9.0, 0.0]])
    assert VIEW.shows(robot).tolist() == [True, True, False, False, False, False]
    rows = VIEW.image_rows(np.array([[0.3, 0.0], [0.6, 0.0], [1.0, 0.0]]))
    assert 210 < rows[0] < 240
    assert rows[0] > rows[1] > rows[2]


def test_a_tape_is_found_where_it_lies():
    """A floor drawn on a grid of 2 mm, seen through the lens: its line comes back to a millimetre."""
    model = floor_camera()
    lens = Camera(model)
    v, u = np.mgrid[0:240, 0:320]
    rays, _ = lens.rays(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    rays = rays @ lens.T_robot_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        reach = np.where(rays[:, 2] < -1e-3, -0.30 / rays[:, 2], 50.0)
    floor = np.array([0.12, 0.0]) + reach[:, None] * rays[:, :2]
    across = np.abs((floor[:, 1] - 0.02) * math.cos(0.2) - (floor[:, 0] - 0.3) * math.sin(0.2))
    image = np.where(across < 0.025, 40.0, 170.0).reshape(240, 320)
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + np.random.default_rng(0).normal(0, 2, image.shape)
    top = VIEW.apply(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    lines = LineDetector(LineConfig("dark", (11.0, 18.0))).detect(top, VIEW.valid)
    assert len(lines) == 1
    points = VIEW.to_robot(lines[0].points)
    error = (points[:, 1] - 0.02) * math.cos(0.2) - (points[:, 0] - 0.3) * math.sin(0.2)
    assert np.abs(error).max() < 0.003
    assert np.sqrt((error**2).mean()) < 0.001


def test_images_of_another_size_are_refused():
    with pytest.raises(ValueError, match="320x240"):
        VIEW.apply(np.zeros((480, 640), np.uint8))


def test_a_camera_that_sees_no_floor_is_refused():
    up = floor_camera()
    up = CameraModel("floor", up.size, up.matrix, Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.3)))
    with pytest.raises(ValueError, match="sees no floor"):
        TopView(up)


def test_poses_are_interpolated_and_unknown_times_refused():
    history = PoseHistory(1.0)
    history.add(0.0, Pose(0.0, 0.0, 3.1))
    history.add(1.0, Pose(-0.2, 0.0, -3.1))
    pose, speed, turn_rate = history.at(0.5)
    assert pose.x == pytest.approx(-0.1)
    assert abs(pose.heading) == pytest.approx(math.pi)
    assert speed == pytest.approx(0.2)
    assert turn_rate == pytest.approx(2 * math.pi - 6.2)
    assert history.at(5.0) is None
    assert history.at(-1.0) is None
    history.add(0.5, Pose(9.0, 9.0, 0.0))
    assert history.at(1.0)[0].x == pytest.approx(-0.2)


def test_the_blind_zone_is_bridged_from_the_robot_to_the_first_sight():
    tracker = LineTracker(VIEW)
    history = straight_history()
    assert tracker.observe(seen(line_along_x(), Pose(0, 0, 0)), 0.0, history, 0.0)
    assert np.abs(tracker.path[:, 1]).max() < 0.002
    assert tracker.path[0, 0] == pytest.approx(0.0, abs=0.01)
    assert tracker.path[-1, 0] > 1.0


def test_acquisition_takes_the_line_that_runs_along_with_the_robot():
    tracker = LineTracker(VIEW)
    across = [Line(VIEW.to_pixels(np.column_stack([np.full(60, 0.5), np.linspace(-0.3, 0.3, 60)])), 14.0, 0.99)]
    beside = seen(line_along_x(0.3), Pose(0, 0, 0))
    assert not tracker.observe(across + beside, 0.0, straight_history(), 0.0)
    assert tracker.observe(across + beside + seen(line_along_x(0.02), Pose(0, 0, 0)), 0.0, straight_history(), 0.0)
    assert tracker.path[-1, 1] == pytest.approx(0.02, abs=0.005)


def drive(tracker, path, history, times, *, stamp_error=0.0, lines=None, noise=0.001):
    """Show the tracker the path from where the robot truly is; returns how often it saw its line."""
    count = 0
    for k, t in enumerate(times):
        pose = history.at(t)[0]
        shown = seen(path, pose, noise, k) if lines is None else lines(pose)
        count += tracker.observe(shown, t - stamp_error, history, 0.2 * t)
    return count


def test_the_memory_follows_the_line_and_forgets_what_is_behind():
    tracker, path = LineTracker(VIEW), line_along_x(length=8.0)
    history = straight_history(duration=10.0)
    times = np.arange(0.0, 9.9, 1 / 30)
    assert drive(tracker, path, history, times) == len(times)
    assert np.abs(tracker.path[:, 1]).max() < 0.003
    assert 1.0 < tracker.path[0, 0] < 1.98
    assert tracker.path[-1, 0] > 2.9
    assert np.diff(tracker.path[:, 0]).max() < 0.04
    assert tracker.lost(0.2 * 9.9) < 0.06


def test_a_parallel_line_beside_ours_is_not_taken():
    tracker, path = LineTracker(VIEW), line_along_x(length=8.0)
    history = straight_history(duration=6.0)
    drive(tracker, path, history, np.arange(0.0, 1.0, 1 / 30))
    other = line_along_x(0.15, length=8.0)
    assert drive(tracker, path, history, np.arange(1.0, 2.0, 1 / 30), lines=lambda pose: seen(other, pose)) == 0
    assert np.abs(tracker.path[:, 1]).max() < 0.003


def test_metres_without_sight_are_counted_also_if_frames_stop():
    tracker, path = LineTracker(VIEW), line_along_x(length=8.0)
    history = straight_history(duration=6.0)
    drive(tracker, path, history, np.arange(0.0, 2.0, 1 / 30))
    drive(tracker, path, history, np.arange(2.0, 3.0, 1 / 30), lines=lambda pose: [])
    assert tracker.lost(0.6) == pytest.approx(0.2, abs=0.02)
    assert tracker.lost(0.8) == pytest.approx(0.35, abs=0.02)


def test_a_sharp_corner_is_remembered_round_its_edge():
    one = np.column_stack([np.arange(-0.5, 1.0, 0.01), np.zeros(150)])
    two = np.column_stack([np.full(100, 1.0), np.arange(0.0, 1.0, 0.01)])
    path = np.vstack([one, two])
    tracker, history = LineTracker(VIEW), straight_history(duration=4.0)
    drive(tracker, path, history, np.arange(0.0, 3.0, 1 / 30))
    assert distance_to(tracker.path, path).max() < 0.012
    assert tracker.path[-1, 1] > 0.2


@pytest.mark.parametrize("turn", [math.radians(-64.0), math.radians(90.0), math.radians(120.0)])
def test_a_corner_that_was_first_seen_up_to_the_far_border_of_its_tape_leaves_no_spike(turn):
    corner, s = np.array([1.5, 0.0]), np.arange(0.0, 1.0, 0.01)[:, None]
    one = np.column_stack([np.arange(-0.5, 1.5, 0.01), np.zeros(200)])
    path = np.vstack([one, corner + s * [math.cos(turn), math.sin(turn)]])
    too_long = np.vstack([one, corner + s[:5] * [1.0, 0.0]])
    tracker, history = LineTracker(VIEW), straight_history(duration=8.0)
    drive(tracker, too_long, history, np.arange(0.0, 3.0, 1 / 30))
    drive(tracker, path, history, np.arange(3.0, 6.0, 1 / 30))
    assert distance_to(tracker.path, path).max() < 0.02
    feet = [int(np.hypot(*(path - end).T).argmin()) for end in (tracker.path[0], tracker.path[-1])]
    assert feet[1] > 200  # round the corner
    assert arc_length(tracker.path)[-1] == pytest.approx(0.01 * np.ptp(feet), abs=0.025)  # not out and back as well


def test_a_slip_of_a_wheel_is_corrected_within_a_third_of_a_second():
    tracker, path = LineTracker(VIEW), line_along_x(length=8.0)
    history = straight_history(duration=6.0)
    drive(tracker, path, history, np.arange(0.0, 2.0, 1 / 30))
    pivot, turn = history.at(2.0)[0], 0.12
    c, s = math.cos(-turn), math.sin(-turn)
    away = path - [pivot.x, pivot.y]
    slipped = np.column_stack([c * away[:, 0] - s * away[:, 1], s * away[:, 0] + c * away[:, 1]]) + [pivot.x, pivot.y]
    drive(tracker, slipped, history, np.arange(2.0, 2.33, 1 / 30))
    near = tracker.path[(tracker.path[:, 0] > pivot.x) & (tracker.path[:, 0] < pivot.x + 0.6)]
    assert distance_to(near, slipped).max() < 0.012


@pytest.mark.parametrize("turn", [-0.13, 0.13])
def test_a_slip_out_of_sight_is_corrected_by_a_line_that_begins_where_the_memory_ends(turn):
    """Of a corner that leads out of view no remembered point may come back into it; what comes is some way off then."""
    path, history, tracker = line_along_x(length=3.0), straight_history(duration=6.0), LineTracker(VIEW)
    known = path[path[:, 0] < 1.0]
    drive(tracker, known, history, np.arange(0.0, 2.5, 1 / 30))
    drive(tracker, None, history, np.arange(2.5, 3.6, 1 / 30), lines=lambda pose: [])
    pivot = history.at(3.6)[0]
    c, s = math.cos(-turn), math.sin(-turn)
    away = path - [pivot.x, pivot.y]
    slipped = np.column_stack([c * away[:, 0] - s * away[:, 1], s * away[:, 0] + c * away[:, 1]]) + [pivot.x, pivot.y]
    drive(tracker, slipped[path[:, 0] > 1.05], history, np.arange(3.6, 3.9, 1 / 30))
    ahead = tracker.path[tracker.path[:, 0] > pivot.x]
    assert ahead[-1, 0] > 1.5
    assert distance_to(ahead, slipped).max() < 0.012


@pytest.mark.parametrize("stamp_error", [-0.04, 0.0, 0.04])
def test_the_error_of_the_stamps_is_learned_where_turns_begin_and_end(stamp_error):
    """Turning at 0.6 rad/s, stamps 40 ms off turn what is seen by 24 mrad; on a straight line they turn nothing."""
    s = np.arange(0.0, 2.4, 0.003)
    curvature = np.where((s // 0.4) % 2 == 1, np.where((s // 0.8) % 2 == 1, -3.0, 3.0), 0.0)
    heading = np.cumsum(curvature * 0.003)
    path = np.cumsum(0.003 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    history = PoseHistory(20.0)
    for k in range(len(s)):
        history.add(0.015 * k, Pose(path[k, 0], path[k, 1], heading[k]))
    tracker = LineTracker(VIEW)
    drive(tracker, path, history, np.arange(0.1, 9.0, 1 / 30), stamp_error=stamp_error)
    assert tracker.stamp_error == pytest.approx(stamp_error, abs=0.015)
    near = tracker.path[distance_to(tracker.path, path[450:620]) < 0.03]
    assert distance_to(near, path).max() < 0.008


def test_what_a_frame_showed_from_the_robot_does_not_change_with_what_it_taught_about_the_stamps(monkeypatch):
    """The memory moves by then, by 30 ms of turning at the first corner; the motion between two views must not."""
    views, observe = [], LineOdometer.observe

    def kept(self, view, *rest):
        views.append(view.points)
        return observe(self, view, *rest)

    monkeypatch.setattr(LineOdometer, "observe", kept)
    s = np.arange(0.0, 0.9, 0.003)
    heading = np.cumsum(np.where(s > 0.3, 3.0, 0.0) * 0.003)
    path = np.cumsum(0.003 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    history, tracker = PoseHistory(20.0), LineTracker(VIEW)
    for k in range(len(s)):
        history.add(0.015 * k, Pose(path[k, 0], path[k, 1], heading[k]))
    for t in np.arange(0.1, 2.5, 1 / 30):
        (line,) = seen(path, history.at(t)[0])
        assert tracker.observe([line], t - 0.05, history, 0.2 * t)
        assert distance_to(views[-1], VIEW.to_robot(line.points)).max() < 0.0055  # half their spacing
    assert abs(tracker.stamp_error) > 0.01


def test_neither_the_end_of_the_view_nor_steps_of_the_encoders_look_like_late_stamps():
    rng, history, path = np.random.default_rng(0), PoseHistory(9.0), line_along_x(length=8.0)
    for k in range(540):
        history.add(0.015 * k, Pose(0.003 * k, 0.0, 0.0019 * rng.integers(-1, 2)))  # one wheel's count came first

    def lines(pose):
        (line,) = seen(path, Pose(pose.x, 0.0, 0.0), 0.001, int(1e6 * pose.x))
        pull = np.concatenate([np.zeros(len(line.points) - 6), np.linspace(0.0, 2.0, 6)])  # px, where the view ends
        return [Line(line.points + pull[:, None] * [1.0, 0.0], line.width, line.confidence)]

    tracker = LineTracker(VIEW)
    drive(tracker, None, history, np.arange(0.1, 8.0, 1 / 30), lines=lines)
    assert abs(tracker.stamp_error) < 0.005


def test_frames_from_unknown_times_change_nothing():
    tracker, history = LineTracker(VIEW), straight_history()
    assert not tracker.observe(seen(line_along_x(), Pose(0, 0, 0)), 99.0, history, 0.0)
    assert len(tracker.path) == 0


# ---- where the line can go on in more than one way -------------------------------------------------------------------


def bent(angle, at=1.2, length=0.9):
    """A way on from (at, 0) that turns by `angle` degrees there."""
    s = np.arange(0.0, length, 0.01)[:, None]
    return np.array([at, 0.0]) + s * [math.cos(math.radians(angle)), math.sin(math.radians(angle))]


def many(*paths):
    """What is seen of several lines at once."""
    return lambda pose: [line for k, path in enumerate(paths) for line in seen(path, pose, 0.001, k)]


TRUNK = line_along_x(length=1.2)


@pytest.mark.parametrize(
    ("rule", "heading", "direction"),
    [("straight", 0.0, 0.0), ("left", 0.0, 45.0), ("right", 0.0, -60.0), ("heading", -1.2, -60.0)],
)
def test_a_fork_is_taken_as_the_rule_says(rule, heading, direction):
    tracker = LineTracker(VIEW, config=TrackerConfig(fork=rule, fork_heading=heading))
    whole = np.vstack([TRUNK, bent(0.0)])
    lines = many(whole, bent(45.0), bent(-60.0))
    drive(tracker, None, straight_history(duration=6.0), np.arange(0.0, 4.0, 1 / 30), lines=lines)
    last = tracker.path[-1] - [1.2, 0.0]
    assert math.degrees(math.atan2(last[1], last[0])) == pytest.approx(direction, abs=8.0)


@pytest.mark.parametrize(
    ("rule", "sides", "direction"),
    [("left", (45.0, -45.0), 45.0), ("right", (35.0, -60.0), -60.0), ("straight", (60.0, -60.0), 0.0)],
)
def test_the_side_ways_of_a_trident_are_two_even_if_they_are_seen_as_one_line(rule, sides, direction):
    tracker = LineTracker(VIEW, config=TrackerConfig(fork=rule))
    lines = many(np.vstack([TRUNK, bent(0.0)]), np.vstack([bent(sides[0])[::-1], bent(sides[1])]))
    drive(tracker, None, straight_history(duration=6.0), np.arange(0.0, 4.0, 1 / 30), lines=lines)
    last = tracker.path[-1] - [1.2, 0.0]
    assert math.degrees(math.atan2(last[1], last[0])) == pytest.approx(direction, abs=8.0)


def test_a_crossing_line_does_not_lead_astray():
    tracker = LineTracker(VIEW)
    across = np.column_stack([np.full(120, 1.2), np.linspace(-0.6, 0.6, 120)])
    history = straight_history(duration=8.0)
    drive(tracker, None, history, np.arange(0.0, 7.0, 1 / 30), lines=many(line_along_x(length=4.0), across))
    assert np.abs(tracker.path[:, 1]).max() < 0.005
    assert tracker.path[-1, 0] > 2.2


@pytest.mark.parametrize(
    ("angle", "behind"), [(-110.0, 0.06), (-70.0, 0.15), (-50.0, 0.15), (60.0, 0.15), (90.0, 0.06)]
)
def test_a_crossing_right_before_a_gap_is_no_corner(angle, behind):
    """One arm and then the other is taken for the trunk's own way on, until all three pieces are seen."""
    near, across = bent(angle), np.vstack([bent(angle + 180.0)[:0:-1], bent(angle)])
    beyond = line_along_x(length=4.0)
    beyond = beyond[beyond[:, 0] > 1.2 + behind]

    def lines(pose):
        if pose.x < 0.3:
            return many(np.vstack([TRUNK, near]))(pose)
        if pose.x < 0.4:
            return many(np.vstack([TRUNK, bent(angle + 180.0)]))(pose)
        return many(TRUNK, across, beyond)(pose)

    tracker = LineTracker(VIEW)
    drive(tracker, None, straight_history(duration=6.0), np.arange(0.0, 4.0, 1 / 30), lines=lines)
    assert np.abs(tracker.path[:, 1]).max() < 0.008
    assert tracker.path[-1, 0] > 1.6


def test_a_crossing_a_little_before_a_gap_is_no_corner():
    """The line goes on for a hand's breadth behind the arm that was taken for its own way on."""
    path, across = line_along_x(length=4.0), np.vstack([bent(250.0)[:0:-1], bent(70.0)])
    near, beyond = path[path[:, 0] < 1.34], path[path[:, 0] > 1.5]

    def lines(pose):
        return many(np.vstack([TRUNK, bent(70.0)]))(pose) if pose.x < 0.35 else many(near, across, beyond)(pose)

    tracker = LineTracker(VIEW)
    drive(tracker, None, straight_history(duration=6.0), np.arange(0.0, 4.0, 1 / 30), lines=lines)
    assert np.abs(tracker.path[:, 1]).max() < 0.008
    assert tracker.path[-1, 0] > 1.6


def test_a_corner_before_another_line_is_still_a_corner():
    """Another piece of tape lies straight on behind our right angle, but nothing crosses there."""
    beyond = line_along_x(length=4.0)
    lines = many(np.vstack([TRUNK, bent(90.0)]), beyond[beyond[:, 0] > 1.35])
    tracker = LineTracker(VIEW)
    drive(tracker, None, straight_history(duration=6.0), np.arange(0.0, 4.0, 1 / 30), lines=lines)
    assert tracker.path[-1] == pytest.approx([1.2, 0.5], abs=0.25)


def test_the_end_of_the_line_is_an_end_only_once_bare_floor_is_seen_beyond_it():
    tracker, path = LineTracker(VIEW), line_along_x(length=1.5)
    history = straight_history(duration=8.0)
    drive(tracker, path, history, np.arange(0.0, 2.0, 1 / 30))
    assert not tracker.ends  # the view ends before the line does, or soon behind it
    drive(tracker, path, history, np.arange(2.0, 5.0, 1 / 30))
    assert tracker.ends
    assert tracker.path[-1, 0] == pytest.approx(1.5, abs=0.03)


def test_a_gap_is_bridged_and_is_no_end():
    tracker, path = LineTracker(VIEW), line_along_x(length=4.0)
    torn = [path[path[:, 0] < 1.2], path[path[:, 0] > 1.42]]
    ends = []

    def lines(pose):
        ends.append(tracker.ends)
        return many(*torn)(pose)

    drive(tracker, None, straight_history(duration=8.0), np.arange(0.0, 7.0, 1 / 30), lines=lines)
    assert not any(ends)
    assert np.abs(tracker.path[:, 1]).max() < 0.005
    assert tracker.path[-1, 0] > 2.2


def test_lines_found_with_relaxed_limits_keep_us_on_the_line_but_do_not_prolong_it():
    tracker, history = LineTracker(VIEW), straight_history(duration=6.0)
    drive(tracker, line_along_x(length=0.9), history, np.arange(0.0, 0.5, 1 / 30))
    end = tracker.path[-1, 0]
    assert tracker.begin(0.6, history, 0.12)
    assert tracker.see(seen(line_along_x(length=3.0), Pose(0.12, 0, 0)), relaxed=True)
    tracker.finish(True)
    assert tracker.path[-1, 0] == pytest.approx(end, abs=0.01)


# ---- what the line says about the robot's motion ---------------------------------------------------------------------


SIGMAS = {"point_sigma": 0.001, "whole": (0.0, 0.0), "jitter": 0.0, "late": 0.0}


def views(path, first, second, *, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    found = []
    for t, pose in ((0.0, first), (0.3, second)):
        robot = to_robot(path, pose)
        robot = robot[(robot[:, 0] > 0.3) & (robot[:, 0] < 1.0) & (np.abs(robot[:, 1]) < 0.4)]
        robot = robot + rng.normal(0.0, noise, robot.shape)
        toward = robot / np.hypot(*robot.T)[:, None]
        found.append(View(t, robot, np.full(len(robot), 1e-4), toward, 0.2, 0.0))
    return found


def test_a_straight_line_shows_sideways_motion_and_turning_but_says_nothing_along_itself():
    true = Pose(0.06, 0.004, 0.02)
    one, two = views(line_along_x(length=3.0), Pose(0, 0, 0), true)
    moved, information = motion_between(one, two, Pose(0.05, 0.0, 0.0), independent=8.0, **SIGMAS)
    assert moved.x == pytest.approx(0.05, abs=0.002)  # odometry's, because the line does not know better
    assert moved.y == pytest.approx(0.004, abs=1e-3)
    assert moved.heading == pytest.approx(0.02, abs=1e-4)
    values, vectors = np.linalg.eigh(information)
    assert values[0] == pytest.approx(0.0, abs=1e-6)
    assert abs(vectors[0, 0]) > 0.99
    assert values[1] > 1e4


@given(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.05, 0.05))
@settings(deadline=None, max_examples=30)
def test_a_corner_shows_all_of_the_motion(x, y, heading):
    path = np.vstack([line_along_x(length=0.75), np.column_stack([np.full(60, 0.75), np.arange(0.0, 0.6, 0.01)])])
    true = Pose(0.06 + x, y, heading)
    one, two = views(path, Pose(0, 0, 0), true)
    moved, information = motion_between(one, two, Pose(0.06, 0.0, 0.0), independent=8.0, **SIGMAS)
    assert np.allclose([moved.x, moved.y, moved.heading], [true.x, true.y, true.heading], atol=1e-3)
    assert np.linalg.eigvalsh(information)[0] > 1e4


def test_the_information_is_what_the_errors_of_many_motions_say():
    path = np.vstack([line_along_x(length=0.75), np.column_stack([np.full(60, 0.75), np.arange(0.0, 0.6, 0.01)])])
    true, squares = Pose(0.06, 0.003, 0.02), []
    for seed in range(200):
        one, two = views(path, Pose(0, 0, 0), true, noise=0.001, seed=seed)
        moved, information = motion_between(one, two, Pose(0.055, 0.0, 0.015), independent=1e9, **SIGMAS)
        error = np.array([moved.x - true.x, moved.y - true.y, moved.heading - true.heading])
        squares.append(error @ information @ error / 3.0)
    assert 0.6 < np.mean(squares) < 1.4


def test_views_that_show_another_line_in_part_are_believed_less():
    one, two = views(line_along_x(length=3.0), Pose(0, 0, 0), Pose(0.06, 0.0, 0.0))
    bent = two.points + np.column_stack([np.zeros(len(two.points)), np.maximum(0.0, two.points[:, 0] - 0.8) * 0.2])
    other = View(two.t, bent, two.sigma, two.toward, two.speed, two.turn_rate)
    straight, doubtful = (
        motion_between(one, view, Pose(0.06, 0, 0), independent=8.0, **SIGMAS)[1] for view in (two, other)
    )
    assert np.trace(doubtful) < 0.3 * np.trace(straight)


def test_late_stamps_count_where_the_robot_changes_its_motion():
    one, two = views(line_along_x(length=3.0), Pose(0, 0, 0), Pose(0.06, 0.0, 0.0))
    turning = View(two.t, two.points, two.sigma, two.toward, 0.2, 0.6)
    for second, sigma in ((two, 0.0), (turning, 0.03 * 0.6)):  # rad: 30 ms of 0.6 rad/s
        alike, doubtful = (
            motion_between(one, second, Pose(0.06, 0, 0), independent=8.0, **(SIGMAS | {"late": late}))[1]
            for late in (0.0, 0.03)
        )
        added = np.linalg.pinv(doubtful, hermitian=True) - np.linalg.pinv(alike, hermitian=True)
        assert math.sqrt(max(added[2, 2], 0.0)) == pytest.approx(sigma, abs=1e-4)


def test_stamps_whose_error_is_still_being_learned_are_no_better_known_than_it_moves():
    one, two = views(line_along_x(length=3.0), Pose(0, 0, 0), Pose(0.1, 0.0, 0.0))
    turning = View(two.t, two.points, two.sigma, two.toward, 0.2, 0.6)

    def information(moved, late):
        odometer = LineOdometer(0.001, (0.0, 0.0), 0.0, 8.0)
        assert odometer.observe(one, Pose(0, 0, 0), 0.01, late) is None
        return odometer.observe(turning, Pose(0.1, 0.0, 0.0), 0.01 + moved, late).information

    np.testing.assert_allclose(information(0.03, 0.0), information(0.0, 0.03))
    assert np.trace(information(0.03, 0.0)) < 0.5 * np.trace(information(0.0, 0.0))


def test_views_of_different_lines_tell_no_motion():
    one, _ = views(line_along_x(0.3), Pose(0, 0, 0), Pose(0, 0, 0))
    _, two = views(line_along_x(-0.3), Pose(0, 0, 0), Pose(0, 0, 0))
    assert motion_between(one, two, Pose(0, 0, 0), independent=8.0, **SIGMAS) is None


def test_what_leaves_the_memory_is_handed_over_once_and_in_order():
    tracker, path = LineTracker(VIEW), line_along_x(length=8.0)
    history, points, travelled = straight_history(duration=10.0), [], []
    for t in np.arange(0.0, 9.9, 1 / 30):
        drive(tracker, path, history, [t])
        piece, at = tracker.finished()
        points, travelled = [*points, *piece], [*travelled, *at]
    rest, at = tracker.rest()
    points, travelled = np.array([*points, *rest]), np.array([*travelled, *at])
    assert (np.diff(points[:, 0]) > 0.0).all()
    assert np.abs(points[:, 1]).max() < 0.004
    np.testing.assert_allclose(travelled, points[:, 0], atol=0.03)
