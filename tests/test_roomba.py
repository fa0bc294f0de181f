"""The Roomba driver in motion: what the wheels are told, what the sensors say, how it ends."""

import asyncio
import dataclasses
import math

import numpy as np
import pytest

from robotd import oi
from robotd.clock import now, run_virtual
from robotd.errors import DriverFault
from robotd.odometry import Odometry, Wheels
from robotd.sim.quirks import LineFaults
from robotd.sim.roomba import RoombaQuirks
from tests.roomba_bench import Bench, bench_test

# ---- moving ----------------------------------------------------------------------------------------------------------


def test_it_drives_a_circle_as_asked():
    async def scenario(bench):
        odometry = Odometry(Wheels())
        with bench.bus.sensors.subscribe(size=10_000) as frames:
            await bench.drive_for(10.0, 0.15, 0.3)
            await bench.settle()
            frames.put(dataclasses.replace(bench.frame, t=math.inf))
            async for frame in frames:
                if frame.t == math.inf:
                    break
                state = odometry.update(frame.t, frame.left, frame.right)
        bench.state = state

    state = bench_test(scenario).state
    assert state.travelled == pytest.approx(1.5, rel=0.03)
    assert state.pose.heading == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize(("speed", "turn_rate"), [(0.15, 0.05), (0.2, -0.2), (0.1, 0.33), (0.05, -0.1), (-0.1, 0.07)])
def test_the_average_motion_is_finer_than_the_base_s_speed_steps(speed, turn_rate):
    async def scenario(bench):
        await bench.drive_for(1.0, speed, turn_rate)
        before, start = (bench.body.left_rotation, bench.body.right_rotation), bench.body.t
        await bench.drive_for(12.0, speed, turn_rate, period=0.06)
        seconds = bench.body.t - start
        left, right = bench.body.left_rotation - before[0], bench.body.right_rotation - before[1]
        bench.got = 0.5 * (left + right) / seconds, (right - left) / 0.235 / seconds

    got = bench_test(scenario).got
    assert got[0] == pytest.approx(speed, abs=0.004)
    assert got[1] == pytest.approx(turn_rate, abs=0.03)


def test_no_wheel_exceeds_the_speed_cap_and_the_curvature_is_kept():
    async def scenario(bench):
        await bench.drive_for(5.0, 1.0, 2.0)
        left, right = bench.body.speeds[-1][1:]
        assert 0.25 < right <= 0.30
        assert left / right == pytest.approx((1 - 0.235) / (1 + 0.235), abs=0.1)

    bench_test(scenario)


def test_encoders_wrap_without_a_jump():
    async def scenario(bench):
        for seconds, speed in ((130.0, 0.285), (130.0, -0.285)):  # 37 m each way: more than 65536 counts
            await bench.drive_for(seconds, speed, period=0.1)
            await bench.settle()
            assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.002)
            assert bench.frame.right == pytest.approx(bench.body.right_rotation, abs=0.002)
            if speed > 0:
                assert bench.frame.left > 30.0

    bench_test(scenario)


def test_a_wheel_that_runs_out_backward_is_counted_backward():
    async def scenario(bench):
        for speed, turn_rate in ((-0.25, 0.0), (0.0, 2.0), (-0.03, 0.1), (0.02, -1.5)):
            await bench.drive_for(2.0, speed, turn_rate)
            await bench.settle()
            assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.003)
            assert bench.frame.right == pytest.approx(bench.body.right_rotation, abs=0.003)

    bench_test(scenario)


def test_frames_carry_the_time_at_which_the_robot_took_them():
    async def scenario(bench):
        with bench.bus.sensors.subscribe() as frames:
            times = [(await frames.get()).t for _ in range(10)]
        ticks_ = np.array(times) / 0.015
        assert np.allclose(ticks_, np.round(ticks_), atol=1e-6)
        assert np.allclose(np.diff(times), 0.015)

    bench_test(scenario)
    bench_test(scenario, quirks=RoombaQuirks(baud=19200))


def test_motion_ends_by_itself_when_nobody_drives_any_more():
    async def scenario(bench):
        await bench.drive_for(1.0, 0.25)
        bench.driver.drive(0.25, 0.0)
        await asyncio.sleep(0.199)
        assert bench.robot.left.target > 0.2
        await asyncio.sleep(0.016)
        assert bench.robot.left.target == bench.robot.right.target == 0.0

    bench_test(scenario)


def test_halt_acts_within_a_tick():
    async def scenario(bench):
        await bench.drive_for(1.0, 0.25)
        bench.driver.halt()
        await asyncio.sleep(0.002)
        assert bench.robot.left.target == bench.robot.right.target == 0.0

    bench_test(scenario)


def test_driving_a_closed_base_does_nothing():
    bench = Bench()
    bench.driver.drive(0.2, 0.0)
    bench.driver.halt()

    async def main():
        await bench.driver.open()
        bench.driver.drive(0.2, 0.0)
        await bench.driver.close()
        bench.driver.drive(0.2, 0.0)
        bench.driver.halt()
        await asyncio.sleep(1.0)
        assert bench.robot.mode == oi.OFF
        assert not bench.is_moving

    run_virtual(main())


# ---- ways out --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [0.0, 0.05, 0.1, 0.11, 0.13, 0.16, 0.5, 1.5, 3.0, 5.0, 9.0])
@pytest.mark.parametrize("awake", [True, False])
def test_opening_can_be_interrupted_at_any_time_and_leaves_the_port_free_and_the_robot_at_rest(after, awake):
    async def main():
        bench = Bench(RoombaQuirks(wakes_by_brc=False))
        bench.robot.is_asleep = not awake
        opening = asyncio.create_task(bench.driver.open())
        await asyncio.sleep(after)
        opening.cancel()
        await asyncio.gather(opening, return_exceptions=True)
        await bench.stop()
        await asyncio.sleep(0.1)
        assert bench.robot.link is None
        assert bench.robot.mode == oi.OFF
        bench.robot.press_clean()
        await asyncio.sleep(1.0)
        await bench.start()
        assert bench.frame.mode == "safe"
        await bench.stop()

    run_virtual(main())


def test_a_bug_in_somebody_who_listens_ends_in_a_halt_too():
    async def main():
        bench = Bench()
        await bench.start()
        await bench.drive_for(1.0, 0.2)

        def burst(frame):
            raise ZeroDivisionError

        bench.bus.sensors.publish = burst
        with pytest.raises(ZeroDivisionError):
            await bench.running
        bench.running = None
        await bench.stop()
        await asyncio.sleep(1.0)
        assert bench.robot.mode == oi.OFF
        assert not bench.is_moving

    run_virtual(main())


# ---- the line ------------------------------------------------------------------------------------------------------


def test_contacts_are_reported_by_side():
    async def scenario(bench):
        for name in ("bump_left", "bump_right", "cliff", "wheel_drop_left", "wheel_drop_right"):
            setattr(bench.body, name, True)
            await asyncio.sleep(0.05)
            set_ = [
                other
                for other in ("bump_left", "bump_right", "cliff", "wheel_drop_left", "wheel_drop_right")
                if getattr(bench.frame, other)
            ]
            assert set_ == [name]
            setattr(bench.body, name, False)
            await asyncio.sleep(0.05)
        bench.robot.overcurrent = 8
        await asyncio.sleep(0.05)
        assert bench.frame.overcurrent

    bench_test(scenario)


def test_an_unplugged_cable_is_a_fault_and_the_robot_goes_on_as_it_must():
    async def scenario(bench):
        await bench.drive_for(1.0, 0.2)
        bench.link.unplug()
        with pytest.raises(DriverFault, match="unplugged"):
            await bench.running
        bench.driver.drive(0.2, 0.0)  # the control loop may not know yet
        before = bench.body.left_rotation
        await asyncio.sleep(5.0)
        assert bench.body.left_rotation - before == pytest.approx(1.0, abs=0.15)

    with pytest.raises(DriverFault, match="unplugged"):
        bench_test(scenario)


def test_noise_on_the_line_does_no_harm():
    async def scenario(bench):
        frames = []
        with bench.bus.sensors.subscribe(size=5000) as subscription:
            await bench.drive_for(20.0, 0.2)
            await bench.settle()
            frames.append(await subscription.get())
            while len(subscription._items):
                frames.append(await subscription.get())
        steps = np.diff([frame.left for frame in frames])
        assert np.abs(steps).max() < 0.06
        bench.counters = bench.driver.counters

    bench = bench_test(scenario, quirks=RoombaQuirks(line=LineFaults(drop=1e-3, flip=1e-3)))
    assert bench.counters.frames > 1200
    assert bench.counters.bad_checksum > 10
    assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.01)


def test_ten_minutes_without_a_missed_frame():
    async def scenario(bench):
        before, start = bench.driver.counters.frames, now()
        await bench.drive_for(600.0, 0.2, 0.1, period=0.1)
        expected = (now() - start) / 0.015
        assert abs(bench.driver.counters.frames - before - expected) <= 1
        counters = bench.driver.counters
        assert (counters.bad_length, counters.bad_order, counters.bad_checksum, counters.skipped_bytes) == (0, 0, 0, 0)

    bench_test(scenario)


def test_at_rest_frames_are_looked_at_seldom_but_every_change_counts_and_a_wish_ends_it():
    async def main():
        bench = Bench()
        try:
            await bench.driver.open()
            bench.running = asyncio.create_task(bench.driver.run())
            await asyncio.sleep(4.0)
            assert bench.link.rests == []
            await asyncio.sleep(2.0)
            before = len(bench.frames)
            await asyncio.sleep(2.0)
            assert set(bench.link.rests) == {0.075}
            assert len(bench.frames) - before < 80  # of 133: two come together, the simulated line lets none gather
            bench.body.bump_left = True
            await asyncio.sleep(0.045)
            assert bench.frame.bump_left
            bench.body.bump_left = False
            bench.driver.arm()
            assert bench.link.rests[-1] == 0.0
            await asyncio.sleep(0.5)
            before, rests = len(bench.frames), len(bench.link.rests)
            await asyncio.sleep(1.5)
            assert len(bench.frames) - before == pytest.approx(100, abs=1)
            assert len(bench.link.rests) == rests
            assert bench.driver.counters.late == bench.driver.counters.missing == 0
        finally:
            await bench.stop()

    run_virtual(main())
