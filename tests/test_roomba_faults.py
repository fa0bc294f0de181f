"""The Roomba driver when line, robot and world misbehave: it never drives on its own account, and it comes back."""

import asyncio
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd import oi
from robotd.clock import now, run_virtual
from robotd.errors import DriverFault
from robotd.odometry import Odometry, Wheels
from robotd.sim.quirks import LineFaults, RoombaQuirks
from robotd.supervisor import Supervisor
from tests.roomba_bench import Bench, bench_test


def test_a_silent_stream_halts_at_once_and_is_started_again():
    async def scenario(bench):
        await bench.drive_for(1.0, 0.2)
        bench.robot.receive(oi.encode("resume_stream", 0))
        await asyncio.sleep(0.17)
        assert bench.robot.left.target == bench.robot.right.target == 0.0
        await asyncio.sleep(0.5)
        assert not bench.running.done()
        await bench.drive_for(1.0, 0.2)
        assert bench.frame.mode == "safe"
        assert bench.is_moving
        assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.01)

    assert bench_test(scenario).texts("warning") == ["the sensor stream had stopped and was started again"]


def test_a_robot_that_stays_silent_is_a_fault_before_the_mission_takes_the_halt_for_its_end():
    async def scenario(bench):
        await bench.drive_for(1.0, 0.2)
        begun = now()
        bench.robot.is_asleep = True  # in Safe mode a robot never sleeps; this one is mute
        with pytest.raises(DriverFault, match=r"no sensor frame on /dev/robotd/base for 0\.\d+ s, halted; check that"):
            await bench.running
        assert now() - begun < 1.0
        bench.running = None

    bench_test(scenario)


def test_a_robot_that_resets_is_found_again_and_odometry_knows_of_the_gap():
    async def main():
        bench = Bench()
        odometry = Odometry(Wheels())
        supervisor = Supervisor(bench.driver)
        task = asyncio.create_task(supervisor.run())
        await asyncio.sleep(0.5)
        await bench.drive_for(1.0, 0.2)
        bench.robot.receive(oi.encode("reset"))
        await asyncio.sleep(15.0)
        assert supervisor.fault is None
        bench.driver.arm()
        await asyncio.sleep(0.2)
        assert bench.frame.mode == "safe"
        for frame in bench.frames:
            odometry.update(frame.t, frame.left, frame.right, frame.slipping, frame.resets)
        assert odometry.resets == 1
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main())


def test_a_jump_of_the_wheel_counters_moves_nothing_and_ends_the_leg():
    async def scenario(bench):
        odometry = Odometry(Wheels())
        await bench.drive_for(1.0, 0.2)
        bench.robot.left.counts = (bench.robot.left.counts + 7000) & 0xFFFF
        await bench.drive_for(1.0, 0.2)
        await bench.settle()
        for frame in bench.frames:
            odometry.update(frame.t, frame.left, frame.right, frame.slipping, frame.resets)
        assert odometry.resets == 1
        assert odometry.broken_since_mark
        assert max(abs(b.left - a.left) for a, b in pairwise(bench.frames)) < 0.02
        assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.02)

    assert any("the wheel counters jumped by 3.1" in text for text in bench_test(scenario).texts("warning"))


@pytest.mark.parametrize("baud", [115200, 57600, 19200])
def test_frames_carry_the_time_at_which_they_were_taken_also_after_a_stall(baud):
    async def scenario(bench):
        await asyncio.sleep(1.0)
        bench.link.stall(0.12)
        await asyncio.sleep(1.0)
        times = np.array([frame.t for frame in bench.frames])
        ticks = times / 0.015
        assert np.allclose(ticks, np.round(ticks), atol=0.08)  # 1.2 ms
        assert np.allclose(np.diff(times), 0.015, atol=1.2e-3)
        assert bench.driver.counters.missing == 0

    bench_test(scenario, quirks=RoombaQuirks(baud=baud), baud=baud)


def test_a_bad_line_is_told_in_numbers_once_a_minute():
    async def scenario(bench):
        await bench.drive_for(125.0, 0.2, 0.1, period=0.1)
        counters = bench.driver.counters
        assert counters.missing == pytest.approx(125 / 0.015 - counters.frames, abs=20)
        assert 0 < counters.bad_checksum <= counters.bad

    texts = bench_test(scenario, quirks=RoombaQuirks(line=LineFaults(flip=1e-3, direction="to_host"))).texts("warning")
    words = [text for text in texts if text.startswith("the line to the robot is bad: within 60 s ")]
    assert 1 <= len(words) <= 2
    assert "damaged" in words[0]


def test_a_good_line_is_not_worth_a_word():
    async def scenario(bench):
        await bench.drive_for(65.0, 0.2, 0.1, period=0.1)
        counters = bench.driver.counters
        assert (counters.missing, counters.late, counters.bad, counters.skipped_bytes) == (0, 0, 0, 0)

    assert bench_test(scenario).texts("warning") == []


@pytest.mark.parametrize(
    "faults",
    [
        LineFaults(drop=5e-3),
        LineFaults(flip=5e-3),
        LineFaults(insert=5e-3),
        LineFaults(burst=1e-3, burst_bytes=30),
        LineFaults(stall=0.5, stall_every=3.0),
        LineFaults(stall=2.0, stall_every=9.0),
        LineFaults(drop=2e-3, flip=2e-3, insert=2e-3, burst=2e-4, stall=0.1, stall_every=3.0),
    ],
    ids=lambda faults: ",".join(name for name in ("drop", "flip", "insert", "burst", "stall") if getattr(faults, name)),
)
def test_on_the_worst_of_lines_it_comes_back_again_and_again(faults):
    """Noise towards the robot means commands: also Reset, Stop and another baud rate."""

    async def main():
        bench = Bench(RoombaQuirks(line=faults))
        supervisor = Supervisor(bench.driver)
        task = asyncio.create_task(supervisor.run())
        await bench.drive_for(25.0, 0.15, 0.1)
        assert not task.done()
        assert len(bench.frames) > 100
        for frame in bench.frames:
            assert 12.0 < frame.voltage < 17.0
            assert not frame.bump_left
        # the line becomes good
        bench.robot.quirks = RoombaQuirks()
        if bench.link is not None:
            bench.link._to_robot._is_noisy = bench.link._to_host._is_noisy = False
            bench.link._to_robot._stalls = bench.link._to_host._stalls = False
        await bench.drive_for(45.0, 0.15, 0.1)
        assert supervisor.fault is None
        assert bench.frame.mode == "safe"
        assert bench.is_moving
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await asyncio.sleep(1.0)
        assert not bench.is_moving
        assert bench.robot.mode == oi.OFF

    run_virtual(main())


# ---- whatever happens ------------------------------------------------------------------------------------------------

HAPPENINGS = (
    *("drive", "turn", "back", "halt", "wait", "dock", "cancel docking", "docked", "lifted off", "cliff", "no cliff"),
    *("drop", "no drop", "clean button", "dock button", "noise", "reset", "sleep", "stall", "full", "off", "plug"),
    *("unplug charger", "cable", "mute"),
)


class World:
    """Things that happen to a supervised driver, with what must hold all the time."""

    def __init__(self, quirks, seed):
        self.bench = Bench(quirks, seed=seed, disarm_s=2.0, dock_s=5.0)
        self.supervisor = Supervisor(self.bench.driver)
        self.wished = -10.0
        self.docking = None
        self.is_tainted = False  # somebody else than the driver told the robot to move

    async def happen(self, what, seconds):
        bench, robot, driver = self.bench, self.bench.robot, self.bench.driver
        body, end = bench.body, now() + seconds
        motions = {"drive": (0.2, 0.1), "turn": (0.0, 1.0), "back": (-0.15, 0.0)}
        if what in motions:
            while now() < end:
                self.wished = now()
                driver.arm()
                driver.drive(*motions[what])
                await asyncio.sleep(0.03)
            return
        if what == "halt":
            driver.halt()
        elif what == "dock" and self.docking is None:
            self.docking = asyncio.create_task(driver.dock())
        elif what == "cancel docking" and self.docking is not None:
            self.docking.cancel()
        elif what in ("docked", "lifted off"):
            robot.set_docked(what == "docked")
        elif what in ("cliff", "no cliff"):
            body.cliff = what == "cliff"
        elif what in ("drop", "no drop"):
            body.wheel_drop_left = what == "drop"
        elif what in ("clean button", "dock button"):
            robot.press(what.split()[0])
        elif what in ("plug", "unplug charger"):
            robot.set_plugged(what == "plug")
        elif what == "noise":
            bench.link.deliver(now(), bytes(range(60)))
        elif what in ("reset", "full"):
            robot.receive(oi.encode(what))
        elif what == "off":
            robot.receive(oi.encode("stop"))
        elif what == "sleep" and robot.mode == oi.PASSIVE:
            robot.is_asleep = True
        elif what == "stall":
            bench.link.stall(0.4)
        elif what == "cable":
            bench.link.unplug()
        elif what == "mute":
            robot.pull_battery()
        await asyncio.sleep(seconds)

    async def watch(self):
        """The wheels are told to turn only while somebody wishes it, or by the robot's own programs."""
        robot = self.bench.robot
        while True:
            told = robot.left.target or robot.right.target
            if told and not robot.programs.is_running and robot.link is not None:
                # a command's life, a stall of the line, and what 19200 baud and a tick take
                assert now() - self.wished < 0.2 + 0.4 + 0.1, "the wheels turn although nobody wishes it"
                assert robot.mode in (oi.SAFE, oi.FULL)
                assert max(abs(robot.left.target), abs(robot.right.target)) <= 0.3
            await asyncio.sleep(0.01)


def survive(happenings, quirks, seed):
    """Let things happen, each for some seconds; the end must be good."""

    async def main():
        world = World(quirks, seed)
        bench = world.bench
        running = asyncio.create_task(world.supervisor.run())
        watching = asyncio.create_task(world.watch())
        await asyncio.sleep(0.4)
        for what, seconds in happenings:
            await world.happen(what, seconds)
            assert not running.done()
            assert not watching.done(), watching.exception()
            if world.docking is not None and world.docking.done():
                if not world.docking.cancelled():
                    assert isinstance(world.docking.exception(), DriverFault | None)
                world.docking = None
        bench.body.cliff = bench.body.wheel_drop_left = False
        bench.robot.set_docked(False)
        bench.robot.set_plugged(False)
        if world.docking is not None:
            world.docking.cancel()
            await asyncio.gather(world.docking, return_exceptions=True)
        for _ in range(60):  # until it is well again
            if world.supervisor.fault is None and bench.frame is not None and now() - bench.frame.t < 0.1:
                break
            await asyncio.sleep(1.0)
        await world.happen("drive", 3.0)
        assert bench.frame.mode == "safe"
        assert bench.is_moving
        watching.cancel()
        running.cancel()
        await asyncio.gather(running, watching, return_exceptions=True)
        await asyncio.sleep(1.0)
        assert bench.robot.mode == oi.OFF
        assert not bench.is_moving
        steps = [max(abs(b.left - a.left), abs(b.right - a.right)) for a, b in pairwise(bench.frames) if b.t > a.t]
        assert max(steps, default=0.0) < 3.0
        assert all(b.t >= a.t for a, b in pairwise(bench.frames))

    run_virtual(main())


QUIRKS = (
    RoombaQuirks(),
    RoombaQuirks(mode_offset=1, baud=57600),
    RoombaQuirks(mode_packet_dead=True),
    RoombaQuirks(mode_32_after_cliff=True, cliffs_on_dock=True, cleans_when_lifted_off_dock=True),
)


@settings(max_examples=20)
@given(
    st.lists(st.tuples(st.sampled_from(HAPPENINGS), st.floats(0.02, 3.0)), min_size=3, max_size=14),
    st.sampled_from(QUIRKS),
    st.integers(0, 5),
)
def test_whatever_happens_the_wheels_turn_by_wish_alone_and_the_end_is_a_halt(happenings, quirks, seed):
    survive(happenings, quirks, seed)
