"""Dead reckoning and its covariance: alone, against random draws, and on a simulated robot's real bytes."""

import asyncio
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from robotd.drivers.roomba import RoombaConfig, RoombaDriver

from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration
from robotd.control import ControlLoop
from robotd.errors import ConfigError
from robotd.odometry import Odometry, Wheels, arc
from robotd.oi import COUNT
from robotd.records import DriveCommand, Pose
from robotd.safety import SafetyGate, SafetyLimits
from robotd.sim.body import Body
from robotd.sim.roomba import SimRoomba
from robotd.sim.roomba_link import RoombaLink
from robotd.sim.settings import WorldSettings
from robotd.sim.stores import LineLayout, StoreLayout

TICK = 0.015
HALL = StoreLayout(
    format="robotd-store/1",
    name="hall",
    size=(1000.0, 1000.0),
    line=LineLayout(((1.0, 1.0), (2.0, 1.0)), (0.0, 1.0)),
    disturbances=False,
)
MIDDLE = Pose(500.0, 500.0, 0.3)
NO_ERROR = ((0.0,) * 3,) * 3
SMALL = (1e-5, 5e-6, 0.0), (5e-6, 1e-5, 0.0), (0.0, 0.0, 1e-6)
NOISE = WorldSettings(slip_distance=0.0, wheel_scale_error=0.0, wheel_base_error=0.0)  # the wheels' random walk alone
QUIET = dataclasses.replace(NOISE, travel_noise=0.0)
EVERYTHING = WorldSettings()  # with slips and what a calibration leaves
BELIEVED = Wheels(covariance=NO_ERROR, slip_distance=0.0), Wheels()


class Crowd(Body):
    """One robot's wheels under many bodies, each with errors of its own: the wheels do not feel the floor."""

    def __init__(self, bodies):
        super().__init__(HALL, NOISE, np.random.default_rng(0), MIDDLE)
        self.bodies = bodies

    def advance(self, t, left_speed, right_speed):
        super().advance(t, left_speed, right_speed)
        for body in self.bodies:
            body.advance(t, left_speed, right_speed)


class Bench:
    """A robot on the floor behind its driver, the control loop and the safety gate; the Hardware of the driver."""

    pins = None

    def __init__(self, body, wheels, seed=1):
        self.body = body
        self.robot = SimRoomba(body, np.random.default_rng([seed, 1]))
        self.bus = Bus()
        calibration = Calibration(wheels=wheels)
        self.driver = RoombaDriver("base", RoombaConfig("/dev/robotd/base"), self, self.bus, calibration)
        self.odometry = Odometry(wheels)
        self.control = ControlLoop(self.bus, self.driver, self.odometry, SafetyGate(SafetyLimits(), wheels.base))

    async def open_serial(self, port, baud):
        return RoombaLink(self.robot, baud)

    async def run(self, scenario):
        await self.driver.open()
        tasks = [asyncio.create_task(work) for work in (self.driver.run(), self.control.run())]
        try:
            await scenario
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self.driver.close()

    async def drive(self, elements):
        """Drive (speed, turn rate, seconds) one after the other without stopping between, then stand still."""
        for speed, turn_rate, seconds in elements:
            async for tick in ticks(0.03):
                if tick * 0.03 >= seconds:
                    break
                self.bus.commands.publish(DriveCommand(now(), speed, turn_rate, "test"))
        for _ in range(40):
            self.bus.commands.publish(DriveCommand(now(), 0.0, 0.0, "test"))
            await asyncio.sleep(0.03)


def mixed_moves(rng, metres):
    """Moves of 1 to 3 m between stops, in all `metres` long: straights, arcs, spins on the spot, reversals."""
    driven, moves = 0.0, []
    while driven < metres:
        move, length, way = [], min(float(rng.uniform(1.0, 3.0)), max(0.5, metres - driven)), 0.0
        while way < length:
            part, speed = min(float(rng.uniform(0.3, 1.2)), length - way + 0.05), float(rng.uniform(0.10, 0.28))
            match rng.integers(6):
                case 0 | 1:
                    move.append((speed, 0.0, part / speed))
                case 2 | 3:
                    move.append((speed, float(rng.uniform(-0.6, 0.6)), part / speed))
                case 4:
                    move.append((-speed, float(rng.choice([0.0, 0.3, -0.3])), part / speed))
                case 5:
                    turn, rate = float(rng.uniform(0.3, 3.0)), float(rng.uniform(0.4, 1.2))
                    move.append((0.0, float(rng.choice([-rate, rate])), turn / rate))
                    part = 0.0
            way += part
        moves.append(move)
        driven += way
    return moves


def since(start, pose):
    """Motion from one pose to another, in the axes of the first, as an array x, y, heading."""
    c, s = math.cos(start.heading), math.sin(start.heading)
    dx, dy = pose.x - start.x, pose.y - start.y
    return np.array([c * dx + s * dy, c * dy - s * dx, math.remainder(pose.heading - start.heading, 2 * math.pi)])


def squares(motion, covariance, truths):
    """Normalised error squared over 3 of each truth."""
    errors = np.array(truths) - motion
    errors[:, 2] = np.remainder(errors[:, 2] + math.pi, 2 * math.pi) - math.pi
    return (errors * np.linalg.solve(np.array(covariance), errors.T).T).sum(axis=1) / 3.0


def crowd_run(seed, metres, count):
    """Drive one random path with `count` bodies in each of two worlds: NEES of moves and of the last pose in both."""
    worlds = NOISE, EVERYTHING
    bodies = [
        [Body(HALL, world, np.random.default_rng([seed, index, which]), MIDDLE) for index in range(count)]
        for which, world in enumerate(worlds)
    ]
    moves = mixed_moves(np.random.default_rng(seed), metres)
    of_moves, of_pose = [[], []], [None, None]

    async def main():
        bench = Bench(Crowd(bodies[0] + bodies[1]), BELIEVED[0], seed)
        other = Odometry(BELIEVED[1])
        odometries = bench.odometry, other
        await bench.run(scenario(bench, odometries))

    states = [None, None]

    async def follow(bench, odometry):
        with bench.bus.sensors.subscribe() as frames:
            async for frame in frames:
                states[1] = odometry.update(frame.t, frame.left, frame.right, frame.slipping)

    async def scenario(bench, odometries):
        task = asyncio.create_task(follow(bench, odometries[1]))
        await asyncio.sleep(0.5)
        for move in moves:
            before = [[body.pose for body in group] for group in bodies]
            for odometry in odometries:
                odometry.mark()
            await bench.drive(move)
            for which, odometry in enumerate(odometries):
                done = odometry.move_since_mark(total=which == 1)
                truths = [since(a, body.pose) for a, body in zip(before[which], bodies[which], strict=True)]
                of_moves[which].append(squares((done.dx, done.dy, done.dheading), done.covariance, truths))
        states[0] = bench.bus.odometry.latest
        for which, odometry in enumerate(odometries):
            pose = states[which].pose
            truths = [since(MIDDLE, body.pose) for body in bodies[which]]
            of_pose[which] = squares((pose.x, pose.y, pose.heading), odometry.pose_covariance(), truths)
        task.cancel()
        assert not odometries[0].resets

    run_virtual(main())
    return [np.array(values) for values in of_moves], of_pose


def quiet_run(body, wheels, seed, moves):
    """Drive a path with this body; error of the last pose (x, y, heading) and metres driven."""
    bench = Bench(body, wheels, seed)
    start, rolled = body.pose, []

    async def scenario():
        await asyncio.sleep(0.5)
        for move in moves:
            await bench.drive(move)
        rolled.append(bench.bus.odometry.latest.travelled)

    run_virtual(bench.run(scenario()))
    pose = bench.bus.odometry.latest.pose
    error = np.array([pose.x, pose.y, pose.heading]) - since(start, body.pose)
    error[2] = math.remainder(error[2], 2.0 * math.pi)
    return error, rolled[0]


def drive(odometry, steps, t=0.0, left=0.0, right=0.0):
    state = odometry.update(t, left, right)
    for step_left, step_right in steps:
        t, left, right = t + TICK, left + step_left, right + step_right
        state = odometry.update(t, left, right)
    return state


@settings(deadline=None)
@given(left=st.floats(-0.5, 0.5), right=st.floats(-0.5, 0.5))
def test_an_arc_is_the_limit_of_many_small_straight_steps(left, right):
    base, n = 0.235, 4000
    heading = (right - left) / base * (np.arange(n) + 0.5) / n
    step = 0.5 * (left + right) / n
    dx, dy, turn = arc(left, right, base)
    assert dx == pytest.approx(step * np.cos(heading).sum(), abs=1e-6)
    assert dy == pytest.approx(step * np.sin(heading).sum(), abs=1e-6)
    assert turn == pytest.approx((right - left) / base)


def test_a_full_circle_returns_to_its_start():
    wheels = Wheels()
    radius, n = 0.5, 500
    inner = 2 * math.pi * (radius - wheels.base / 2) / n
    outer = 2 * math.pi * (radius + wheels.base / 2) / n
    odometry = Odometry(wheels)
    state = drive(odometry, [(inner, outer)] * n)
    assert state.pose.x == pytest.approx(0.0, abs=1e-9)
    assert state.pose.y == pytest.approx(0.0, abs=1e-9)
    assert math.remainder(state.pose.heading, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert state.travelled == pytest.approx(2 * math.pi * radius)
    assert state.speed == pytest.approx(2 * math.pi * radius / n / TICK)
    assert state.turn_rate == pytest.approx(2 * math.pi / n / TICK)


def test_scales_and_base_of_the_calibration_count():
    odometry = Odometry(Wheels(scale_left=0.9, scale_right=1.1, base=0.2))
    drive(odometry, [(0.005, 0.005)] * 10)
    expected = arc(0.045, 0.055, 0.2)
    move = odometry.move_since_mark()
    assert (move.dx, move.dy, move.dheading) == pytest.approx(expected, abs=1e-12)


def test_speed_is_smooth_although_counts_are_coarse():
    odometry = Odometry(Wheels(travel_noise=0.0))
    speeds = []
    for tick in range(200):
        travel = math.floor(0.1 * tick * TICK / COUNT) * COUNT
        speeds.append(odometry.update(tick * TICK, travel, travel).speed)
    assert np.max(np.abs(np.array(speeds[20:]) - 0.1)) < 0.005


def test_a_move_is_in_the_axes_of_the_robot_at_the_mark():
    odometry = Odometry(Wheels())
    drive(odometry, [(-0.0025, 0.0025)] * 50)
    odometry.mark()
    state = odometry.update(1.0, -0.125, 0.125)
    before = state.pose
    after = drive(odometry, [(0.004, 0.005)] * 60, 1.0, -0.125, 0.125).pose
    move = odometry.move_since_mark()
    c, s = math.cos(before.heading), math.sin(before.heading)
    assert before.x + c * move.dx - s * move.dy == pytest.approx(after.x)
    assert before.y + s * move.dx + c * move.dy == pytest.approx(after.y)
    assert move.dheading == pytest.approx(after.heading - before.heading)


def test_headings_are_wrapped():
    odometry = Odometry(Wheels())
    drive(odometry, [(-0.004, 0.004)] * 120)  # 4.1 rad
    assert odometry.move_since_mark().dheading == pytest.approx(0.96 / 0.235 - 2 * math.pi)


def test_covariance_is_positive_definite_even_after_no_motion():
    odometry = Odometry(Wheels(travel_noise=0.0))
    odometry.update(0.0, 0.0, 0.0)
    eigenvalues = np.linalg.eigvalsh(np.array(odometry.move_since_mark().covariance))
    assert eigenvalues.min() > 0.0
    assert math.sqrt(eigenvalues.max()) < 0.005


def test_heading_spreads_by_18_mrad_in_one_metre():
    odometry = Odometry(Wheels())
    drive(odometry, [(0.005, 0.005)] * 200)
    covariance = odometry.move_since_mark().covariance
    assert math.sqrt(covariance[2][2]) == pytest.approx(0.003 * math.sqrt(2) / 0.235, rel=0.05)
    assert math.sqrt(covariance[0][0]) == pytest.approx(0.003 / math.sqrt(2), rel=0.05)
    assert math.sqrt(covariance[1][1]) == pytest.approx(0.003 * math.sqrt(2 / 3) / 0.235, rel=0.05)


def test_errors_of_moves_are_as_large_as_their_covariance_says():
    """Normalised estimation error squared over 200 runs: 1 within three standard deviations (0.17)."""
    wheels, rng, total, runs, n = Wheels(), np.random.default_rng(5), 0.0, 200, 160
    for _ in range(runs):
        bends = np.cumsum(rng.normal(0.0, 4e-4, n)).clip(-0.004, 0.004)
        rolled = np.stack([0.005 - bends, 0.005 + bends], axis=1)
        rolled[120:] *= -1.0  # some of it backward
        true = rolled + wheels.travel_noise * np.sqrt(np.abs(rolled)) * rng.standard_normal(rolled.shape)
        start = rng.uniform(0.0, COUNT, 2)
        read = np.floor((start + np.cumsum(rolled, axis=0)) / COUNT) * COUNT
        odometry = Odometry(wheels)
        odometry.update(0.0, 0.0, 0.0)
        for tick, (left, right) in enumerate(read):
            odometry.update((tick + 1) * TICK, left, right)
        x = y = heading = 0.0
        for left, right in true:
            dx, dy, turn = arc(left, right, wheels.base)
            x, y = (
                x + dx * math.cos(heading) - dy * math.sin(heading),
                y + dx * math.sin(heading) + dy * math.cos(heading),
            )
            heading += turn
        move = odometry.move_since_mark()
        error = np.array([move.dx - x, move.dy - y, math.remainder(move.dheading - heading, 2 * math.pi)])
        total += error @ np.linalg.solve(np.array(move.covariance), error) / 3.0
    assert 0.83 < total / runs < 1.17


@pytest.mark.parametrize(
    ("t", "left", "right"),
    [(2 * TICK, 0.1, 0.0), (2 * TICK, 0.0, -0.3), (0.7, 0.001, 0.001)],
    ids=["left jumps", "right jumps", "silence"],
)
def test_a_reset_base_moves_nothing_and_is_told(t, left, right):
    odometry = Odometry(Wheels())
    drive(odometry, [(0.0, 0.0)])
    before = odometry.update(TICK, 0.0, 0.0).pose
    assert odometry.update(t, left, right).pose == before
    assert odometry.resets == 1
    assert odometry.broken_since_mark
    odometry.mark()
    assert not odometry.broken_since_mark
    assert odometry.update(t + TICK, left + 0.003, right + 0.003).pose.x == pytest.approx(before.x + 0.003)


def test_wheels_out_of_range_are_named_all_at_once():
    with pytest.raises(ConfigError) as caught:
        bind(Wheels, {"base": 5.0, "scale_left": 0.0, "bass": 1}, "calibration.toml")
    assert len(caught.value.problems) == 3


# ---- the total covariance --------------------------------------------------------------------------------------------


def bends(n, seed, forward=0.005):
    """(n, 2) wheel steps of a path that bends at random and now and then reverses."""
    rng = np.random.default_rng(seed)
    bend = np.repeat(rng.normal(0.0, 0.1 * forward, n // 50 + 1), 50)[:n]
    way = np.repeat(rng.choice([1.0, 1.0, -1.0], n // 50 + 1), 50)[:n] * forward
    return np.stack([way - bend, way + bend], axis=1)


def drawn(wheels, steps, count, rng):
    """(count, 3) end poses of robots whose wheels are wrong as `wheels` says they may be."""
    parameters = rng.multivariate_normal([wheels.scale_left, wheels.scale_right, wheels.base], wheels.covariance, count)
    z, heading = np.zeros(count, dtype=complex), np.zeros(count)
    for pair in steps:
        rate = 0.25 * abs(pair.sum()) / wheels.slip_distance if wheels.slip_distance else 0.0
        rolled = []
        for wheel, scale in enumerate((wheels.scale_left, wheels.scale_right)):
            slid = np.sign(pair[wheel]) * wheels.slip_length * rng.poisson(rate, count)
            walk = wheels.travel_noise * math.sqrt(abs(pair[wheel])) * rng.standard_normal(count)
            rolled.append(pair[wheel] * parameters[:, wheel] / scale + walk - slid)
        half = 0.5 * (rolled[1] - rolled[0]) / parameters[:, 2]
        z += 0.5 * (rolled[0] + rolled[1]) * np.sinc(half / math.pi) * np.exp(1j * (heading + half))
        heading += 2.0 * half
    return np.stack([z.real, z.imag, heading], axis=1)


@pytest.mark.parametrize(
    ("wheels", "metres"),
    [
        (Wheels(covariance=NO_ERROR, slip_distance=0.0), 2.0),
        (Wheels(covariance=NO_ERROR, slip_distance=0.0), 100.0),
        (Wheels(covariance=NO_ERROR, travel_noise=0.0), 100.0),
        (Wheels(scale_left=1.05, scale_right=0.97, base=0.22), 2.0),
        (Wheels(), 100.0),
        (Wheels(covariance=SMALL, travel_noise=0.001, slip_distance=0.0), 3.0),
    ],
    ids=["noise", "noise 100 m", "slips 100 m", "everything", "everything 100 m", "calibration"],
)
def test_the_total_covariance_is_the_second_moment_of_random_draws(wheels, metres):
    """Whatever the spread of heading; NEES / 3 of draws, and each entry of their moment seen in its units."""
    n, count = (2000 if metres > 10.0 else 400), 3000
    steps = bends(n, 5, metres / n)
    odometry, (left, right) = Odometry(wheels), np.zeros(2)
    odometry.update(0.0, 0.0, 0.0)
    for tick, (left, right) in enumerate(np.cumsum(steps, axis=0) / (wheels.scale_left, wheels.scale_right), 1):
        odometry.update(0.3 * tick, left, right)
    move, P = odometry.move_since_mark(total=True), np.array(odometry.pose_covariance())
    turned = steps @ [-1.0, 1.0] / wheels.base  # unwrapped
    error = drawn(wheels, steps, count, np.random.default_rng(1)) - (move.dx, move.dy, turned.sum())
    whitened = np.linalg.solve(np.linalg.cholesky(P), error.T)
    moment = whitened @ whitened.T / count
    assert np.trace(moment) / 3.0 == pytest.approx(1.0, abs=0.06)
    assert moment == pytest.approx(np.eye(3), abs=0.15)


def test_what_a_covariance_contains():
    odometry = Odometry(Wheels())
    drive(odometry, [(0.005, 0.004)] * 300)
    noise, total = (np.array(odometry.move_since_mark(total=total).covariance) for total in (False, True))
    assert np.linalg.eigvalsh(total - noise).min() > 0.0
    assert np.array(odometry.pose_covariance()) == pytest.approx(total)
    bare = Odometry(Wheels(covariance=NO_ERROR, slip_distance=0.0))
    drive(bare, [(0.005, 0.004)] * 300)
    assert np.array(bare.move_since_mark(total=True).covariance) == pytest.approx(noise)
    odometry.mark()
    assert np.trace(odometry.move_since_mark(total=True).covariance) < 1e-4
    assert np.array(odometry.pose_covariance()) == pytest.approx(total)


def test_what_is_the_same_in_every_move_adds_up_over_the_whole_path():
    wheels = Wheels(travel_noise=0.0, slip_distance=0.0)
    odometry = Odometry(wheels)
    drive(odometry, [(0.005, 0.005)] * 400)
    assert math.sqrt(odometry.pose_covariance()[0][0]) == pytest.approx(0.003 * 2.0, rel=0.01)
    odometry = Odometry(wheels)
    drive(odometry, [(-0.005, 0.005)] * 400)
    turned = 4.0 / wheels.base
    assert math.sqrt(odometry.pose_covariance()[2][2]) == pytest.approx(0.003 * math.sqrt(2) * turned, rel=0.01)


def test_a_base_that_reports_slipping_widens_both_covariances_by_the_travel_in_doubt():
    wheels = Wheels(slip_distance=0.0)
    plain, doubting = Odometry(wheels), Odometry(wheels)
    for odometry, slipping in ((plain, False), (doubting, True)):
        left = right = 0.0
        for tick in range(200):
            odometry.update(tick * TICK, left, right, slipping and 100 <= tick < 108)
            left, right = left + 0.005, right + 0.005
    rolled = 8 * 0.005
    for total in (False, True):
        before, after = (np.array(o.move_since_mark(total=total).covariance) for o in (plain, doubting))
        assert after[0, 0] - before[0, 0] == pytest.approx((0.5 * rolled) ** 2 + rolled**2 / 24.0, rel=0.15)
        assert after[2, 2] - before[2, 2] == pytest.approx(2.0 * rolled**2 / 12.0 / 0.235**2, rel=0.01)


def test_where_between_two_counts_a_wheel_reverses_is_in_the_covariance():
    odometry = Odometry(Wheels(covariance=NO_ERROR, travel_noise=0.0, slip_distance=0.0))
    drive(odometry, [(0.005, 0.005), (-0.005, -0.005)] * 50)  # 99 reversals of each wheel
    before = Odometry(Wheels(covariance=NO_ERROR, travel_noise=0.0, slip_distance=0.0))
    drive(before, [(0.005, 0.005)] * 100)
    more = odometry.pose_covariance()[2][2] - before.pose_covariance()[2][2]
    assert more == pytest.approx(99 * 2 * COUNT**2 / 3.0 / 0.235**2)


def test_a_covariance_of_the_calibration_that_cannot_be_is_refused():
    for matrix in ([[1.0, 0.5, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 1.0]], [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0] * 3]):
        with pytest.raises(ConfigError, match="symmetric 3x3 matrix without negative eigenvalues"):
            bind(Wheels, {"covariance": matrix}, "calibration.toml")


# ---- on the simulated robot, byte by byte ----------------------------------------------------------------------------


def test_errors_on_the_robot_are_as_large_as_both_covariances_say():
    """NEES / 3 of the moves of 2 robots under 16 bodies each, in two worlds; bounds of 99.9 %, by chi-square.

    Slips have heavy tails: the fourth moment of the error is several times a Gaussian's.
    """
    done = [crowd_run(seed, 8.0, 16)[0] for seed in (1, 2)]
    noise, everything = (np.concatenate([moves[which].ravel() for moves in done]) for which in (0, 1))
    half = 3.3 * math.sqrt(2.0 / 3.0 / len(noise))
    assert len(noise) > 100
    assert abs(noise.mean() - 1.0) < half
    assert abs(everything.mean() - 1.0) < 3.0 * half


def test_without_noise_the_pose_stays_right_through_reversals_spins_and_stops():
    """12 m; per metre ten times what would use up 1 degree and 0.5 % in 100 m."""
    moves = mixed_moves(np.random.default_rng(3), 12.0)
    error, metres = quiet_run(Body(HALL, QUIET, np.random.default_rng(1), MIDDLE), BELIEVED[0], 3, moves)
    assert metres > 11.0
    assert math.hypot(*error[:2]) < 0.005 * metres
    assert abs(math.degrees(error[2])) < 1.0


@given(st.lists(st.tuples(st.floats(-0.002, 0.006), st.floats(-0.002, 0.006)), min_size=1, max_size=60))
@settings(deadline=None, max_examples=30)
def test_a_move_says_what_errors_of_the_calibration_do_to_it(steps):
    """Against driving the same way with wheels that have the errors."""

    def driven(scale, turn, drift):
        wheels = Wheels(base=0.235 * (1.0 + scale) / (1.0 + turn))
        left, right = (1.0 + scale + sign * 0.5 * wheels.base * drift for sign in (-1.0, 1.0))
        odometry = Odometry(dataclasses.replace(wheels, scale_left=left, scale_right=right))
        odometry.update(0.0, 0.0, 0.0)
        rolled = np.cumsum(steps, axis=0)
        for k, (a, b) in enumerate(rolled.tolist(), start=1):
            odometry.update(0.4 * k, a, b)
        return odometry.move_since_mark()

    exact = driven(0.0, 0.0, 0.0)
    for column, h in enumerate((1e-6, 1e-6, 1e-6)):
        errors = [h if k == column else 0.0 for k in range(3)]
        ahead, behind = driven(*errors), driven(*(-value for value in errors))
        change = np.array([ahead.dx - behind.dx, ahead.dy - behind.dy, ahead.dheading - behind.dheading])
        change[2] = math.remainder(change[2], 2.0 * math.pi)
        np.testing.assert_allclose(np.array(exact.by_errors)[:, column], change / (2.0 * h), atol=1e-5)
