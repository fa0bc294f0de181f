import asyncio
import dataclasses
import math

import numpy as np
import pytest
from robotd.drivers.roomba import RoombaConfig, RoombaDriver

from robotd import oi
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault
from robotd.odometry import Odometry, Wheels
from robotd.sim.roomba import RoombaLink, RoombaQuirks, SimRoomba

PORT = "/dev/robotd/base"


class Wheelbarrow:
    """A body without a world: the wheels roll as they are told."""

    def __init__(self):
        self.left_rotation = self.right_rotation = 0.0
        self.bump_left = self.bump_right = self.cliff = False
        self.wheel_drop_left = self.wheel_drop_right = False
        self.t = 0.0
        self.speeds = []

    def advance(self, t, left_speed, right_speed):
        elapsed, self.t = t - self.t, t
        self.left_rotation += left_speed * elapsed
        self.right_rotation += right_speed * elapsed
        self.speeds.append((t, left_speed, right_speed))


class Bench:
    """A driver on a simulated robot; the Hardware that it is given."""

    pins = None

    def __init__(self, quirks=None, seed=1, **config):
        self.body = Wheelbarrow()
        self.robot = SimRoomba(self.body, np.random.default_rng(seed), quirks)
        self.bus = Bus()
        self.driver = RoombaDriver("base", RoombaConfig(PORT, **config), self, self.bus, Calibration())
        self.events = []
        self.link = None

    async def open_serial(self, port, baud):
        assert port == PORT
        self.link = RoombaLink(self.robot, baud)
        return self.link

    @property
    def frame(self):
        return self.bus.sensors.latest

    @property
    def is_moving(self):
        return self.robot.left.speed != 0.0 or self.robot.right.speed != 0.0

    def texts(self):
        return [event.text for event in self.events]


def bench_test(scenario, **how):
    """Run `scenario(bench)` in virtual time with the driver open and running, then close; returns the bench."""

    async def main():
        bench = Bench(**how)
        publish = bench.bus.events.publish
        bench.bus.events.publish = lambda event: (bench.events.append(event), publish(event))
        try:
            await bench.driver.open()
            running = asyncio.create_task(bench.driver.run())
            await asyncio.sleep(0.2)
            bench.running = running
            await scenario(bench)
            if running.done():
                running.result()
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
        finally:
            await bench.driver.close()
            await bench.driver.close()
        await asyncio.sleep(1.0)
        return bench

    return run_virtual(main())


async def drive_for(bench, seconds, speed, turn_rate=0.0, period=0.03):
    start = now()
    async for _ in ticks(period):
        if now() - start >= seconds:
            break
        bench.driver.drive(speed, turn_rate)


async def settle(bench):
    """Halt and wait until the wheels rest and the last frame has arrived."""
    bench.driver.halt()
    await asyncio.sleep(1.0)


# ---- starting --------------------------------------------------------------------------------------------------------


def test_it_starts_in_safe_mode_and_closing_leaves_the_robot_off_with_its_motors_at_rest():
    async def scenario(bench):
        assert bench.robot.mode == oi.SAFE
        assert bench.frame.mode == "safe"
        assert 12.0 < bench.frame.voltage < 17.0
        assert 0.9 < bench.frame.charge_fraction <= 1.0
        await drive_for(bench, 1.0, 0.2)
        assert bench.is_moving

    bench = bench_test(scenario)
    assert bench.robot.mode == oi.OFF
    assert not bench.is_moving
    assert bench.robot.left.target == bench.robot.right.target == 0.0


@pytest.mark.parametrize("baud", [115200, 19200, 57600])
def test_the_baud_rate_is_found(baud):
    async def scenario(bench):
        await drive_for(bench, 1.0, 0.1)
        assert bench.frame.mode == "safe"
        assert bench.frame.left > 0.05

    bench = bench_test(scenario, quirks=RoombaQuirks(baud=baud))
    assert any(f"at {baud} baud" in text for text in bench.texts())


@pytest.mark.parametrize("checksum", ["inclusive", "exclusive"])
@pytest.mark.parametrize("offset", [0, 1])
def test_firmware_that_sums_or_numbers_differently_is_understood(checksum, offset):
    async def scenario(bench):
        await asyncio.sleep(1.0)
        assert bench.frame.mode == "safe"

    bench = bench_test(scenario, quirks=RoombaQuirks(mode_offset=offset, checksum=checksum))
    assert f"checksum {checksum}" in bench.texts()[0] or "checksum auto" in bench.texts()[0]


def test_a_sleeping_robot_is_woken():
    async def main():
        bench = Bench()
        bench.robot.is_asleep = True
        await bench.driver.open()
        assert bench.robot.mode != oi.OFF
        await bench.driver.close()

    run_virtual(main())


def test_a_robot_that_a_dead_program_left_in_mid_command_is_found():
    async def main():
        bench = Bench()
        link = RoombaLink(bench.robot, 115200)
        link.write(oi.encode("start") + bytes((148, 255)))  # a stream list of which 255 bytes are missing
        link.close()
        await asyncio.sleep(0.1)
        await bench.driver.open()
        await bench.driver.close()

    run_virtual(main())


def test_a_robot_that_cannot_be_woken_is_a_fault_that_says_what_to_check():
    async def main():
        bench = Bench(RoombaQuirks(wakes_by_brc=False))
        bench.robot.is_asleep = True
        with pytest.raises(DriverFault, match="115200, 19200, 57600 baud; check that the robot is on"):
            await bench.driver.open()
        await bench.driver.close()
        bench.robot.press_clean()
        await asyncio.sleep(1.0)
        await bench.driver.open()  # the same driver opens again
        await bench.driver.close()

    run_virtual(main())


def test_a_bad_section_names_every_mistake():
    with pytest.raises(ConfigError) as caught:
        bind(RoombaConfig, {"prt": "x", "baud": 9600, "checksum": "crc"}, "robotd.toml [drivers.base]")
    assert len(caught.value.problems) >= 3


# ---- moving ----------------------------------------------------------------------------------------------------------


def test_it_drives_a_circle_as_asked():
    async def scenario(bench):
        odometry = Odometry(Wheels())
        with bench.bus.sensors.subscribe(size=10_000) as frames:
            await drive_for(bench, 10.0, 0.15, 0.3)
            await settle(bench)
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
        await drive_for(bench, 1.0, speed, turn_rate)
        before, start = (bench.body.left_rotation, bench.body.right_rotation), bench.body.t
        await drive_for(bench, 12.0, speed, turn_rate, period=0.06)
        seconds = bench.body.t - start
        left, right = bench.body.left_rotation - before[0], bench.body.right_rotation - before[1]
        bench.got = 0.5 * (left + right) / seconds, (right - left) / 0.235 / seconds

    got = bench_test(scenario).got
    assert got[0] == pytest.approx(speed, abs=0.004)
    assert got[1] == pytest.approx(turn_rate, abs=0.03)


def test_no_wheel_exceeds_the_speed_cap_and_the_curvature_is_kept():
    async def scenario(bench):
        await drive_for(bench, 5.0, 1.0, 2.0)
        left, right = bench.body.speeds[-1][1:]
        assert 0.25 < right <= 0.30
        assert left / right == pytest.approx((1 - 0.235) / (1 + 0.235), abs=0.1)

    bench_test(scenario)


def test_encoders_wrap_without_a_jump():
    async def scenario(bench):
        for seconds, speed in ((130.0, 0.285), (130.0, -0.285)):  # 37 m each way: more than 65536 counts
            await drive_for(bench, seconds, speed, period=0.1)
            await settle(bench)
            assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.002)
            assert bench.frame.right == pytest.approx(bench.body.right_rotation, abs=0.002)
            if speed > 0:
                assert bench.frame.left > 30.0

    bench_test(scenario)


def test_a_wheel_that_runs_out_backward_is_counted_backward():
    async def scenario(bench):
        for speed, turn_rate in ((-0.25, 0.0), (0.0, 2.0), (-0.03, 0.1), (0.02, -1.5)):
            await drive_for(bench, 2.0, speed, turn_rate)
            await settle(bench)
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
        await drive_for(bench, 1.0, 0.25)
        bench.driver.drive(0.25, 0.0)
        await asyncio.sleep(0.199)
        assert bench.robot.left.target > 0.2
        await asyncio.sleep(0.016)
        assert bench.robot.left.target == bench.robot.right.target == 0.0

    bench_test(scenario)


def test_halt_acts_within_a_tick():
    async def scenario(bench):
        await drive_for(bench, 1.0, 0.25)
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


# ---- hazards and faults ----------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("name", "words"), [("cliff", "a cliff sensor sees no floor"), ("wheel_drop_left", "the left wheel dropped")]
)
def test_a_drop_out_of_safe_mode_is_named_and_mended_when_the_hazard_is_gone(name, words):
    async def scenario(bench):
        await drive_for(bench, 1.0, 0.2)
        setattr(bench.body, name, True)
        await asyncio.sleep(0.1)
        assert bench.robot.mode == oi.PASSIVE
        assert bench.robot.left.target == 0.0
        assert bench.frame.mode == "passive"
        await asyncio.sleep(2.0)
        assert bench.robot.mode == oi.PASSIVE  # not while the hazard is there
        setattr(bench.body, name, False)
        await asyncio.sleep(0.7)
        assert bench.frame.mode == "safe"
        assert not bench.is_moving

    bench = bench_test(scenario)
    assert f"the base left safe mode for passive mode: {words}" in bench.texts()
    assert bench.texts()[-1] == "the base is in safe mode"


def test_a_robot_lifted_from_the_start_is_opened_and_says_why_it_does_not_move():
    async def main():
        bench = Bench()
        bench.body.wheel_drop_right = True
        await bench.driver.open()
        running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(1.0)
        assert bench.bus.events.latest.text == "the base stays in passive mode: the right wheel dropped"
        bench.body.wheel_drop_right = False
        await asyncio.sleep(1.0)
        assert bench.frame.mode == "safe"
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        await bench.driver.close()

    run_virtual(main())


def test_a_robot_on_the_charger_stays_passive():
    async def scenario(bench):
        bench.robot.set_docked(True)
        await asyncio.sleep(2.0)
        assert bench.frame.mode == "passive"
        bench.robot.set_docked(False)
        await asyncio.sleep(1.0)
        assert bench.frame.mode == "safe"

    assert any("it is on the charger" in text for text in bench_test(scenario).texts())


def test_rearming_can_be_switched_off():
    async def scenario(bench):
        bench.robot.press_clean()
        await asyncio.sleep(3.0)
        assert bench.frame.mode == "passive"

    assert any("a button or another program" in text for text in bench_test(scenario, rearm=False).texts())


def test_a_silent_stream_halts_and_is_a_fault_within_its_limit():
    async def scenario(bench):
        await drive_for(bench, 1.0, 0.2)
        bench.robot.receive(oi.encode("resume_stream", 0))
        started = now()
        with pytest.raises(DriverFault, match=r"no sensor frame on /dev/robotd/base for 0\.15 s, halted; check"):
            await bench.running
        assert 0.13 < now() - started < 0.17
        await asyncio.sleep(0.002)
        assert bench.robot.left.target == bench.robot.right.target == 0.0

    with pytest.raises(DriverFault):
        bench_test(scenario)


def test_a_robot_that_resets_is_a_fault_and_is_found_again():
    async def main():
        bench = Bench()
        await bench.driver.open()
        running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(0.5)
        bench.robot.receive(oi.encode("reset"))
        with pytest.raises(DriverFault, match="no sensor frame"):
            await running
        await bench.driver.close()
        await asyncio.sleep(5.0)
        await bench.driver.open()
        running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(0.5)
        assert bench.frame.mode == "safe"
        assert abs(bench.frame.left) < 1e-9
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        await bench.driver.close()

    run_virtual(main())


def test_an_unplugged_cable_is_a_fault_and_the_robot_goes_on_as_it_must():
    async def scenario(bench):
        await drive_for(bench, 1.0, 0.2)
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
            await drive_for(bench, 20.0, 0.2)
            await settle(bench)
            frames.append(await subscription.get())
            while len(subscription._items):
                frames.append(await subscription.get())
        steps = np.diff([frame.left for frame in frames])
        assert np.abs(steps).max() < 0.06
        bench.counters = bench.driver.counters

    bench = bench_test(scenario, quirks=RoombaQuirks(drop=1e-3, flip=1e-3))
    assert bench.counters.frames > 1200
    assert bench.counters.bad_checksum > 10
    assert bench.frame.left == pytest.approx(bench.body.left_rotation, abs=0.01)


def test_ten_minutes_without_a_missed_frame():
    async def scenario(bench):
        before, start = bench.driver.counters.frames, now()
        await drive_for(bench, 600.0, 0.2, 0.1, period=0.1)
        expected = (now() - start) / 0.015
        assert abs(bench.driver.counters.frames - before - expected) <= 1
        counters = bench.driver.counters
        assert (counters.bad_length, counters.bad_order, counters.bad_checksum, counters.skipped_bytes) == (0, 0, 0, 0)

    bench_test(scenario)


# ---- the simulated robot against the interface -----------------------------------------------------------------------


class Wire:
    """A robot without a line: bytes in, ticks, bytes out."""

    def __init__(self, quirks=None):
        self.body = Wheelbarrow()
        self.robot = SimRoomba(self.body, np.random.default_rng(2), quirks)
        self.t = 0.0

    def send(self, *command):
        self.robot.receive(oi.encode(*command))

    def run(self, seconds=0.015):
        out = b""
        for _ in range(round(seconds / 0.015)):
            self.t += 0.015
            out += self.robot.tick(self.t)
        return out

    def ask(self, packet):
        self.send("sensors", packet)
        return oi.decode_values([packet], self.run())


def test_nothing_but_start_works_in_off():
    wire = Wire()
    wire.send("safe")
    wire.send("sensors", 35)
    assert wire.run() == b""
    assert wire.robot.mode == oi.OFF
    wire.send("start")
    assert wire.ask(35) == {35: oi.PASSIVE}


def test_modes_follow_the_interface():
    wire = Wire()
    wire.send("start")
    for command, mode in (
        ("safe", 2),
        ("full", 3),
        ("safe", 2),
        ("clean", 1),
        ("control", 2),
        ("start", 1),
        ("full", 3),
        ("dock", 1),
        ("safe", 2),
        ("stop", 0),
        ("full", 0),
    ):
        wire.send(command)
        assert wire.robot.mode == mode


@pytest.mark.parametrize("mode", ["start", "safe", "full"])
@pytest.mark.parametrize("name", ["cliff", "wheel_drop_left"])
def test_reflexes_belong_to_safe_mode(mode, name):
    wire = Wire()
    wire.send("start")
    wire.send(mode)
    wire.send("drive_direct", 200, 200)
    wire.run(0.5)
    setattr(wire.body, name, True)
    wire.run(0.5)
    assert wire.robot.mode == {"start": oi.PASSIVE, "safe": oi.PASSIVE, "full": oi.FULL}[mode]
    assert (wire.robot.left.speed > 0.0) == (mode == "full")


def test_a_cliff_ends_safe_mode_only_where_the_front_could_go_over():
    for right, left, drops in (
        (100, 100, True),
        (-100, -100, False),
        (-100, 0, True),
        (100, -100, True),
        (0, 0, False),
    ):
        wire = Wire()
        wire.send("start")
        wire.send("safe")
        wire.send("drive_direct", right, left)
        wire.body.cliff = True
        wire.run(0.1)
        assert (wire.robot.mode == oi.PASSIVE) == drops


@pytest.mark.parametrize(
    ("command", "right", "left"),
    [
        (("drive_direct", 200, -100), 0.1995, -0.114),
        (("drive", 200, oi.STRAIGHT), 0.1995, 0.1995),
        (("drive", 200, oi.SPIN_COUNTER_CLOCKWISE), 0.1995, -0.1995),
        (("drive", 200, oi.SPIN_CLOCKWISE), -0.1995, 0.1995),
        (("drive", 200, 500), 0.2565, 0.1425),
        (("drive_pwm", 255, -255), 0.513, -0.513),
        (("drive_direct", 10, 14), 0.0, 0.0),
        (("drive_direct", 15, -15), 0.0285, -0.0285),
    ],
)
def test_wheel_speeds_are_quantised_per_wheel(command, right, left):
    wire = Wire()
    wire.send("start")
    wire.send(*command)
    assert wire.robot.right.target == 0.0  # ignored in Passive
    wire.send("safe")
    wire.send(*command)
    wire.run(1.5)
    assert (wire.robot.right.speed, wire.robot.left.speed) == pytest.approx((right, left))


def test_wheels_accelerate_no_faster_than_their_motors():
    wire = Wire(RoombaQuirks(acceleration=0.6))
    wire.send("start")
    wire.send("safe")
    wire.send("drive_direct", 200, 200)
    wire.run(0.15)
    assert wire.robot.left.speed == pytest.approx(0.09)


def test_encoders_count_up_when_a_standing_wheel_is_pushed():
    wire = Wire()
    wire.send("start")
    wire.run()
    before = wire.ask(43)[43]
    wire.body.left_rotation -= 0.1
    after = wire.ask(43)[43]
    assert (after - before) % 0x10000 == int(0.1 / oi.COUNT)


def test_distance_and_angle_count_from_the_last_request():
    wire = Wire()
    wire.send("start")
    wire.send("safe")
    wire.run()
    wire.ask(19)
    wire.ask(20)
    wire.body.right_rotation += 0.235 * math.radians(90.5)
    assert wire.ask(20) == {20: 90}
    assert wire.ask(19) == {19: int(500 * 0.235 * math.radians(90.5))}
    assert wire.ask(19) == {19: 0}


def test_every_packet_and_group_is_answered():
    wire = Wire()
    wire.send("start")
    for number in [*oi.PACKETS, *oi.GROUPS]:
        assert sorted(wire.ask(number)) == sorted(oi.members(number))
    wire.send("query", 7, 13, 100)
    assert len(wire.run()) == 82


def test_a_stream_that_exceeds_its_slot_is_corrupt():
    for baud, good in ((115200, True), (57600, False)):
        wire = Wire(RoombaQuirks(baud=baud))
        wire.send("start")
        wire.send("stream", 100, 106)  # 97 bytes a frame
        decoder = oi.StreamDecoder([100, 106])
        found = [event for event in decoder.feed(wire.run(0.3)) if isinstance(event, oi.SensorValues)]
        assert bool(found) == good


def test_a_stream_is_paused_resumed_and_cleared():
    wire = Wire()
    wire.send("start")
    wire.send("stream", 35)
    assert len(wire.run()) == 5
    wire.send("resume_stream", 0)
    assert wire.run(0.1) == b""
    wire.send("resume_stream", 1)
    assert len(wire.run()) == 5
    wire.send("stream")
    assert wire.run(0.1) == b""


def test_it_sleeps_after_five_idle_minutes_in_passive_and_wakes_on_brc():
    wire = Wire()
    wire.send("start")
    wire.run(299)
    assert not wire.robot.is_asleep
    wire.run(2)
    assert wire.robot.is_asleep
    wire.send("start")
    assert wire.run() == b""
    wire.robot.pulse_brc(1.0)
    wire.run(0.6)
    wire.send("start")
    assert wire.ask(35) == {35: oi.PASSIVE}


def test_it_never_sleeps_in_safe_mode():
    wire = Wire()
    wire.send("start")
    wire.send("safe")
    wire.run(400)
    assert not wire.robot.is_asleep


def test_reset_takes_seconds_and_prints_a_banner():
    wire = Wire()
    wire.send("start")
    wire.send("reset")
    assert wire.run(4.4) == b""
    text = wire.run(0.5)
    assert b"r3_robot/tags/release-3.2.6:4975 CLEAN" in text
    assert wire.robot.mode == oi.OFF


def test_three_short_pulses_change_the_baud_rate_and_a_long_one_does_not():
    wire = Wire()
    wire.robot.pulse_brc(1.0)
    wire.robot.pulse_brc(0.1)
    wire.robot.pulse_brc(0.1)
    assert wire.robot.baud == 115200
    wire.robot.pulse_brc(0.1)
    assert wire.robot.baud == 19200


def test_baud_changes_by_command_and_the_battery_drains():
    wire = Wire()
    wire.send("start")
    wire.send("baud", 10)
    assert wire.robot.baud == 57600
    wire.send("safe")
    wire.send("drive_direct", 300, 300)
    before = wire.robot.charge_mah
    wire.run(60)
    assert 5.0 < before - wire.robot.charge_mah < 20.0


def test_bytes_take_their_time_on_the_line():
    async def main():
        robot = SimRoomba(Wheelbarrow(), np.random.default_rng(0))
        link = RoombaLink(robot, 115200)
        with pytest.raises(DriverFault, match="in use"):
            RoombaLink(robot, 115200)
        link.write(oi.encode("start") + oi.encode("stream", 43, 44, 35))
        await asyncio.sleep(5 * 10 / 115200)
        assert robot.mode == oi.OFF
        await asyncio.sleep(1 * 10 / 115200 + 1e-9)
        assert robot.mode == oi.PASSIVE
        t, data = await link.read()
        assert len(data) == 11
        assert t == pytest.approx(0.015 + 11 * 10 / 115200)

    run_virtual(main())
