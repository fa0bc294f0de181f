"""Path following: the controller alone, and the driver in a closed loop with a floor of its own, pixels to wheels."""

import asyncio
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from robotd.drivers.line_follower import LineFollowerConfig, LineFollowerDriver

from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault, MissionError
from robotd.follow import PathFollower
from robotd.geometry.camera import Camera
from robotd.odometry import Odometry, Wheels
from robotd.records import CameraModel, Frame, Pose, Transform

TICK = 0.015
BASE = 0.235
STEP = 0.0285  # m/s: the base's wheel speeds are multiples of it


class Wheeled:
    """A unicycle with quantised wheel speeds, limited acceleration and encoders that count."""

    def __init__(self, x=0.0, y=0.0, heading=0.0, *, acceleration=0.75, noise=0.0, seed=0):
        self.x, self.y, self.heading = x, y, heading
        self.wheels = np.zeros(2)
        self.rolled = np.zeros(2)
        self.wanted = [np.zeros(2)] * 2
        self.acceleration, self.noise = acceleration, noise
        self.rng = np.random.default_rng(seed)

    def command(self, speed, turn_rate):
        wheels = np.array([speed - 0.5 * BASE * turn_rate, speed + 0.5 * BASE * turn_rate])
        self.wanted.append(np.rint(wheels / STEP) * STEP)

    def advance(self):
        wanted = self.wanted[-2]  # one tick of transport
        step = self.acceleration * TICK
        self.wheels = np.clip(wanted, self.wheels - step, self.wheels + step)
        rolled = self.wheels * TICK
        self.rolled = self.rolled + rolled
        left, right = rolled + self.noise * np.sqrt(np.abs(rolled)) * self.rng.standard_normal(2)
        turn = (right - left) / BASE
        middle = self.heading + 0.5 * turn
        self.x += 0.5 * (left + right) * math.cos(middle)
        self.y += 0.5 * (left + right) * math.sin(middle)
        self.heading += turn

    @property
    def pose(self):
        return Pose(self.x, self.y, math.remainder(self.heading, 2 * math.pi))


def route(corners, radius):
    """A dense polyline with rounded corners (radius 0 leaves them sharp), 5 mm between points."""
    corners = np.asarray(corners, float)
    points = [corners[0]]
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        a, b = (before - corner) / np.hypot(*(before - corner)), (after - corner) / np.hypot(*(after - corner))
        if radius == 0.0:
            points.append(corner)
            continue
        half = 0.5 * math.acos(np.clip(a @ b, -1, 1))
        centre = corner + radius / math.sin(half) * (a + b) / np.hypot(*(a + b))
        first, last = corner + radius / math.tan(half) * a - centre, corner + radius / math.tan(half) * b - centre
        start = math.atan2(first[1], first[0])
        sweep = math.remainder(math.atan2(last[1], last[0]) - start, 2 * math.pi)
        angle = start + np.linspace(0.0, 1.0, 60) * sweep
        points += list(centre + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    points = np.array([*points, corners[-1]])
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    s = np.arange(0.0, lengths[-1], 0.005)
    return np.column_stack([np.interp(s, lengths, points[:, 0]), np.interp(s, lengths, points[:, 1])])


def distance_to(points, path):
    return np.sqrt(((np.asarray(points)[:, None] - path[None]) ** 2).sum(axis=2)).min(axis=1)


# ---- the controller alone --------------------------------------------------------------------------------------------


def follow(path, robot, distance, lost=lambda driven: 0.0, ticks=8000):
    """Drive with a perfect memory of the path; returns the way and the last steering."""
    follower, way, steering = PathFollower(), [], None
    for _ in range(ticks):
        driven = float(robot.rolled.mean())
        steering = follower.steer(path, robot.pose, distance - driven, lost=lost(driven), dt=TICK)
        robot.command(steering.speed, steering.turn_rate)
        robot.advance()
        way.append((robot.x, robot.y, robot.wheels.mean()))
        if (driven >= distance or steering.halted) and not robot.wheels.any():
            break
    return np.array(way), steering


def test_a_straight_path_is_followed_to_a_millimetre_and_the_stop_is_exact():
    robot = Wheeled()
    way, _ = follow(route([(-0.4, 0), (5, 0)], 0), robot, 2.0)
    assert np.abs(way[:, 1]).max() < 0.002
    assert robot.rolled.mean() == pytest.approx(2.0, abs=0.005)
    assert way[:, 2].max() < 0.25


@settings(deadline=None, max_examples=6)
@given(st.floats(-0.05, 0.05), st.floats(-0.25, 0.25), st.floats(0.4, 1.2))
def test_the_robot_comes_back_to_the_path_from_beside_it(offset, heading, acceleration):
    robot = Wheeled(0.0, offset, heading, acceleration=acceleration)
    way, _ = follow(route([(-0.4, 0), (6, 0)], 0), robot, 1.5)
    assert np.abs(way[:, 1]).max() < abs(offset) + 0.05
    assert np.abs(way[way[:, 0] > 0.9, 1]).max() < 0.006


@pytest.mark.parametrize("radius", [0.2, 0.25, 0.6])
def test_rounded_corners_are_followed_to_ten_millimetres(radius):
    path = route([(-0.4, 0), (1.2, 0), (1.2, 1.2), (2.4, 1.2), (2.4, -0.4)], radius)
    robot = Wheeled()
    way, _ = follow(path, robot, 4.2)
    error = distance_to(way[:, :2], path)
    assert np.sqrt((error**2).mean()) < 0.005
    assert error.max() < 0.010


def test_right_angles_are_followed_to_thirty_millimetres():
    path = route([(-0.4, 0), (1.2, 0), (1.2, 1.2), (2.4, 1.2)], 0)
    robot = Wheeled()
    way, _ = follow(path, robot, 3.3)
    error = distance_to(way[:, :2], path)
    assert error.max() < 0.030
    assert robot.rolled.mean() == pytest.approx(3.3, abs=0.005)


@pytest.mark.parametrize(("angle", "slip"), [(60.0, -0.14), (60.0, 0.14), (90.0, -0.14), (90.0, 0.14)])
def test_a_wheel_that_slips_in_a_blind_corner_costs_hardly_more_than_the_slip_itself(angle, slip):
    """The corner is out of view when a wheel slips by 33 mm; the line is seen again after half a radian of turning."""
    out = np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
    corner = np.array([0.6, 0.0])
    path, robot, follower = route([(-0.4, 0), corner, corner + out], 0), Wheeled(), PathFollower()
    before = seen = None
    way = []
    while robot.rolled.mean() < 1.1:
        if before is None and robot.x > corner[0] - 0.07:
            before = robot.pose
            robot.x -= 0.5 * BASE * abs(slip)
            robot.heading += slip
            after = robot.pose
        pose = robot.pose
        if before is not None and seen is None:  # what odometry believes: the same way, from where it was before
            turned = pose.heading - after.heading
            c, s = math.cos(before.heading - after.heading), math.sin(before.heading - after.heading)
            dx, dy = pose.x - after.x, pose.y - after.y
            pose = Pose(before.x + c * dx - s * dy, before.y + s * dx + c * dy, before.heading + turned)
            seen = True if turned > 0.5 else None
        steering = follower.steer(path, pose, 2.0, lost=0.0 if seen or before is None else 0.03, dt=TICK)
        robot.command(steering.speed, steering.turn_rate)
        robot.advance()
        way.append((robot.x, robot.y))
    assert distance_to(way, path).max() < 0.028


def test_the_robot_slows_down_for_corners_only():
    way, _ = follow(route([(-0.4, 0), (1.5, 0), (1.5, 2.0)], 0.2), Wheeled(), 2.4)
    corner = (way[:, 0] > 1.35) & (way[:, 1] < 0.15)
    assert way[corner, 2].mean() < 0.19
    assert way[(way[:, 0] > 0.3) & (way[:, 0] < 0.8), 2].mean() > 0.2


def test_on_memory_alone_it_crawls_and_halts_after_the_coast():
    way, steering = follow(route([(-0.4, 0), (9, 0)], 0), Wheeled(), 5.0, lost=lambda driven: max(0.0, driven - 1.0))
    assert steering.halted
    assert 1.25 < way[-1, 0] < 1.32
    assert way[way[:, 0] > 1.12, 2].max() < 0.13


def test_the_end_of_the_path_is_prolonged_by_the_coast_at_most():
    way, steering = follow(route([(-0.4, 0), (1.0, 0)], 0), Wheeled(), 5.0)
    assert steering.halted
    assert steering.beyond == pytest.approx(0.3, abs=0.01)
    assert way[-1, 0] == pytest.approx(1.3, abs=0.02)
    assert np.abs(way[:, 1]).max() < 0.005


# ---- the driver in a closed loop -------------------------------------------------------------------------------------


def floor_camera():
    c, s = math.cos(math.radians(35)), math.sin(math.radians(35))
    rotation, _ = cv2.Rodrigues(np.array([[0.0, -s, c], [-1.0, 0.0, 0.0], [0.0, -c, -s]]))
    mount = Transform(tuple(float(x) for x in rotation.ravel()), (0.12, 0.0, 0.30))
    return CameraModel("floor", (320, 240), (228.5, 228.5, 159.5, 119.5), mount, distortion=(-0.05, 0.01, 0, 0, 0))


CALIBRATION = Calibration(floor_camera=floor_camera())


class Floor:
    """A textured floor with a tape, drawn on a grid of 4 mm, and the camera that looks at it."""

    PITCH = 0.004

    def __init__(self, path, width=0.05, seed=0):
        self.low = path.min(axis=0) - 1.5
        columns, rows = np.ceil((path.max(axis=0) + 1.5 - self.low) / self.PITCH).astype(int)
        tape = np.zeros((rows, columns), np.uint8)
        pixels = np.rint((path - self.low) / self.PITCH * 16).astype(np.int32)
        cv2.polylines(tape, [pixels], False, 255, round(width / self.PITCH), cv2.LINE_AA, 4)
        self.rng = np.random.default_rng(seed)
        texture = cv2.GaussianBlur(self.rng.normal(0, 1, (rows, columns)).astype(np.float32), (0, 0), 1.5)
        grey = 130 + 12 * texture / texture.std()
        self.grey = (grey + tape / 255.0 * (45 - grey)).astype(np.float32)
        lens = Camera(floor_camera())
        v, u = np.mgrid[0:240, 0:320]
        rays, _ = lens.rays(np.column_stack([u.ravel(), v.ravel()]).astype(float))
        rays = rays @ lens.T_robot_camera[:3, :3].T
        reach = np.where(rays[:, 2] < -0.02, -0.30 / np.minimum(rays[:, 2], -1e-9), 15.0)
        self.ground = np.array([0.12, 0.0]) + reach[:, None] * rays[:, :2]
        self.noise = self.rng.normal(0, 2, (300, 400)).astype(np.float32)

    def render(self, pose):
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        x = pose.x + c * self.ground[:, 0] - s * self.ground[:, 1] - self.low[0]
        y = pose.y + s * self.ground[:, 0] + c * self.ground[:, 1] - self.low[1]
        tables = [(table / self.PITCH).astype(np.float32).reshape(240, 320) for table in (x, y)]
        image = cv2.remap(self.grey, *tables, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        row, col = self.rng.integers(0, (60, 80))
        return cv2.add(
            cv2.GaussianBlur(image, (3, 3), 0.8), self.noise[row : row + 240, col : col + 320], dtype=cv2.CV_8U
        )


async def drive(path, targets, *, spoil=None, seed=0, offset=0.03):
    """Run the driver on a robot that starts at the origin; returns the true way, what was raised, and the driver.

    `spoil(t, image)` may replace a frame's image, or drop the frame by returning None. Stamps are `offset` too early,
    frames arrive 60 to 120 ms late.
    """
    bus, floor = Bus(), Floor(path, seed=seed)
    robot = Wheeled(noise=0.003, seed=seed)
    driver = LineFollowerDriver("line", LineFollowerConfig(readout=0.0), None, bus, CALIBRATION)
    odometry, way, fault = Odometry(Wheels()), [], None
    rng = np.random.default_rng(seed)

    async def wheels():
        while True:
            await asyncio.sleep(TICK)
            command = bus.commands.latest
            if command is not None and now() - command.t < 0.2:
                robot.command(command.speed, command.turn_rate)
            else:
                robot.command(0.0, 0.0)
            robot.advance()
            counts = np.floor(robot.rolled / 0.000444565) * 0.000444565
            way.append((now(), robot.x, robot.y, robot.wheels.mean()))
            bus.odometry.publish(odometry.update(now(), *counts))

    async def camera():
        sequence = 0
        while True:
            await asyncio.sleep(1 / 30)
            image = floor.render(robot.pose)
            if spoil is not None:
                image = spoil(now(), image)
            sequence += 1
            if image is not None:
                frame = Frame("floor", now() - offset, image, sequence)
                asyncio.get_running_loop().call_later(rng.uniform(0.06, 0.12), bus.frames("floor").publish, frame)

    await driver.open()
    tasks = [asyncio.create_task(task) for task in (wheels(), camera(), driver.run())]
    stops = []
    try:
        for target in targets:
            await driver.follow(target)
            stops.append(bus.odometry.latest.travelled - target)
    except MissionError as error:
        fault = str(error)
    halted = bus.commands.latest
    await asyncio.sleep(0.5)
    for task in tasks:
        assert not task.done()
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await driver.close()
    assert (halted.speed, halted.turn_rate) == (0.0, 0.0)
    assert not robot.wheels.any()
    return np.array(way), fault, stops, driver


def test_a_line_with_corners_is_followed_from_pixels_and_stops_are_exact():
    path = route([(-0.2, 0), (1.2, 0), (1.2, 1.2), (2.4, 1.2)], 0.2)
    way, fault, stops, driver = run_virtual(drive(path, [0.7, 1.6, 2.6], seed=1))
    assert fault is None
    error = distance_to(way[:, 1:3], path)
    assert np.sqrt((error**2).mean()) < 0.008
    assert error.max() < 0.020
    assert np.abs(stops).max() < 0.005
    assert driver.latest_line


def test_a_closed_line_is_followed_past_its_start():
    loop = route([(-0.2, 0), (0.5, 0), (0.5, 0.65), (-0.4, 0.65), (-0.4, 0), (0.5, 0)], 0.2)
    way, fault, _, _ = run_virtual(drive(loop, [2.9], seed=3))
    assert fault is None
    error = distance_to(way[:, 1:3], loop)
    assert np.sqrt((error**2).mean()) < 0.010


SPOILERS = {
    "noise": lambda t, image: np.random.default_rng(int(1e6 * t)).integers(0, 256, image.shape).astype(np.uint8),
    "silent": lambda t, image: None,
}


@pytest.mark.parametrize("kind", SPOILERS)
def test_useless_frames_end_as_a_lost_line_within_the_coast(kind):
    path, spoilt = route([(-0.2, 0), (2.5, 0)], 0), SPOILERS[kind]
    spoil = lambda t, image: image if t < 1.5 else spoilt(t, image)  # noqa: E731
    way, fault, _, _ = run_virtual(drive(path, [2.0], spoil=spoil))
    assert fault is not None
    assert fault.startswith("line lost")
    blind = np.interp(1.5, way[:, 0], way[:, 1])
    assert way[-1, 1] - blind < 0.42
    assert np.abs(way[:, 2]).max() < 0.02


def test_no_line_at_the_start_is_said_and_the_robot_stays():
    path = route([(-0.2, 2), (4.0, 2)], 0)
    way, fault, _, _ = run_virtual(drive(path, [1.0]))
    assert "no line in view" in fault
    assert np.abs(way[:, 1:3]).max() == 0.0


def test_the_end_of_the_line_halts_the_robot_shortly_behind_it():
    path = route([(-0.2, 0), (1.0, 0)], 0)
    way, fault, _, _ = run_virtual(drive(path, [3.0]))
    assert fault.startswith("the line ends 2.0")
    assert way[-1, 1] == pytest.approx(1.0, abs=0.02)


def test_a_cancelled_follow_commands_zero():
    async def main():
        bus = Bus()
        driver = LineFollowerDriver("line", LineFollowerConfig(), None, bus, CALIBRATION)
        await driver.open()
        task = asyncio.create_task(driver.follow(1.0))
        await asyncio.sleep(0.1)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert task.cancelled()
        assert bus.commands.latest.speed == 0.0
        assert bus.commands.latest.turn_rate == 0.0

    run_virtual(main())


def test_without_a_calibrated_floor_camera_the_follower_is_in_fault_so_that_it_can_be_calibrated():
    driver = LineFollowerDriver("line", LineFollowerConfig(), None, Bus(), Calibration())
    with pytest.raises(DriverFault, match="floor_camera"):
        asyncio.run(driver.open())


def test_a_view_without_floor_is_refused():
    with pytest.raises(ConfigError, match="sees no floor"):
        LineFollowerDriver("line", LineFollowerConfig(view_near=9.0, view_far=9.5), None, Bus(), CALIBRATION)
