"""The driver against every known quirk of robots and cables: it works, or says what to do."""

import asyncio
from dataclasses import fields

import pytest

from robotd import oi
from robotd.clock import now, run_virtual
from robotd.errors import DriverFault
from robotd.sim.quirks import LineFaults, RoombaQuirks
from tests.roomba_bench import Bench, bench_test

WORKS = {
    "as in the manual": RoombaQuirks(),
    "57600 baud": RoombaQuirks(baud=57600),
    "19200 baud": RoombaQuirks(baud=19200),
    "stm32 firmware": RoombaQuirks(firmware="stm32-3.7.7"),
    "prints no text": RoombaQuirks(firmware="silent"),
    "Q1": RoombaQuirks(distance_wrong=True),
    "Q2": RoombaQuirks(angle_wrong=True),
    "Q3": RoombaQuirks(mode_offset=1),
    "Q3, 32": RoombaQuirks(mode_32_after_cliff=True),
    "Q3, both": RoombaQuirks(mode_offset=1, mode_32_after_cliff=True),
    "Q4": RoombaQuirks(mode_packet_dead=True),
    "Q4 at 19200 baud": RoombaQuirks(mode_packet_dead=True, baud=19200),
    "Q5": RoombaQuirks(stream_distance_zero=True),
    "Q6": RoombaQuirks(checksum="exclusive"),
    "Q7, sleeps in spite of pulses": RoombaQuirks(brc_keeps_awake=False),
    "Q7, wakes by its button only": RoombaQuirks(wakes_by_brc=False),
    "Q7, on the dock": RoombaQuirks(brc_works_on_dock=False),
    "no wake line": RoombaQuirks(brc_wired=False),
    "Q8": RoombaQuirks(answers_shift_after=0.1),
    "Q9": RoombaQuirks(cleans_when_lifted_off_dock=True),
    "Q10": RoombaQuirks(cliffs_on_dock=True),
    "Q11, later": RoombaQuirks(mute_after=3600.0),
    "Q12": RoombaQuirks(clock_buttons_dead=True),
    "opcode 165 dead": RoombaQuirks(buttons_command_dead=True),
    "encoders swapped": RoombaQuirks(encoders_swapped=True),
    "encoders about to wrap": RoombaQuirks(encoder_start=65530),
    "encoders at zero": RoombaQuirks(encoder_start=0),
    "freezes on the charger": RoombaQuirks(freeze=120.0),
    "gauge below zero": RoombaQuirks(gauge_error_mah=2600.0),
    "lively wheels": RoombaQuirks(acceleration=5.0),
    "lame wheels": RoombaQuirks(acceleration=0.4),
    "bytes dropped": RoombaQuirks(line=LineFaults(drop=1e-3)),
    "bits flipped": RoombaQuirks(line=LineFaults(flip=1e-3)),
    "bytes inserted": RoombaQuirks(line=LineFaults(insert=1e-3)),
    "bursts": RoombaQuirks(line=LineFaults(burst=3e-4, burst_bytes=30, direction="to_host")),
    "stalls": RoombaQuirks(line=LineFaults(stall=0.1, stall_every=2.0)),
    "all that is bad and bearable": RoombaQuirks(
        baud=57600,
        firmware="stm32-3.7.7",
        mode_offset=1,
        mode_32_after_cliff=True,
        checksum="exclusive",
        brc_wired=False,
        encoders_swapped=True,
        gauge_error_mah=2600.0,
        line=LineFaults(drop=2e-4, flip=2e-4, insert=2e-4),
    ),
}


def test_every_quirk_and_fault_of_the_simulator_is_in_the_table():
    for cls, of in ((RoombaQuirks, lambda quirks: quirks), (LineFaults, lambda quirks: quirks.line)):
        default = cls()
        for item in fields(cls):
            if item.name not in ("line", "direction", "disconnect_after"):
                changed = any(
                    getattr(of(quirks), item.name) != getattr(default, item.name) for quirks in WORKS.values()
                )
                assert changed, f"{cls.__name__}.{item.name}: no row switches it"


@pytest.mark.parametrize("name", WORKS)
def test_it_opens_streams_drives_turns_and_closes_under(name):
    async def scenario(bench):
        await bench.drive_for(1.5, 0.0, 1.0)  # a turn, in which swapped encoders show
        await bench.settle()
        frame, body = bench.frame, bench.body
        begun = frame.left, frame.right, body.left_rotation, body.right_rotation
        await bench.drive_for(3.0, 0.2, 0.2)
        assert bench.frame.mode == "safe"
        assert bench.is_moving
        await bench.settle()
        left, right = bench.frame.left - begun[0], bench.frame.right - begun[1]
        assert left == pytest.approx(body.left_rotation - begun[2], abs=0.004)
        assert right == pytest.approx(body.right_rotation - begun[3], abs=0.004)
        assert left > 0.3
        assert not any((bench.frame.cliff, bench.frame.bump_left, bench.frame.wheel_drop_left))
        assert 12.0 < bench.frame.voltage < 17.0

    bench = bench_test(scenario, quirks=WORKS[name])
    assert bench.robot.mode == oi.OFF
    assert not bench.is_moving
    assert not bench.texts("error")
    times = [frame.t for frame in bench.frames]
    assert times == sorted(times)
    steps = [abs(b.left - a.left) for a, b in zip(bench.frames, bench.frames[1:], strict=False)]
    assert max(steps) < 0.1  # no frame that the robot did not send


@pytest.mark.parametrize("name", WORKS)
def test_it_stands_a_cliff_and_goes_on_under(name):
    async def scenario(bench):
        await bench.drive_for(1.0, 0.2)
        bench.body.cliff = True
        await bench.drive_for(0.4, 0.2)
        assert bench.robot.mode == oi.PASSIVE
        assert not bench.robot.left.target
        assert bench.frame.mode == "passive"
        bench.body.cliff = False
        await bench.drive_for(1.6, 0.2)
        assert bench.robot.mode == oi.SAFE
        assert bench.frame.mode == "safe"
        assert bench.is_moving

    bench = bench_test(scenario, quirks=WORKS[name])
    assert any("front left and front right cliff sensors see no floor" in text for text in bench.texts("warning"))
    assert bench.robot.mode == oi.OFF


@pytest.mark.parametrize("name", WORKS)
def test_it_is_still_there_after_long_idleness_under(name, monkeypatch):
    """Awake, or woken; and where it can only be woken by hand, it says so and comes back then.

    Sleep and the pulses against it come thirty times as fast as on the robot.
    """
    monkeypatch.setattr("robotd.sim.roomba.SLEEP_AFTER", 10.0)
    monkeypatch.setattr("robotd.drivers.roomba.keep_alive_s", lambda firmware: 2.0)

    async def main():
        bench = Bench(WORKS[name])
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        try:
            await asyncio.sleep(25.0)
            if bench.running.done():
                with pytest.raises(DriverFault, match="press Clean once"):
                    await bench.running
                assert not (WORKS[name].wakes_by_brc and WORKS[name].brc_wired)
                await bench.stop()
                bench.robot.press_clean()
                await asyncio.sleep(5.0)
            else:
                await bench.stop()
            await bench.start()
            assert bench.frame.mode == "safe"
        finally:
            await bench.stop()

    run_virtual(main())


MUTE = "answers again after its battery was out for a minute"


def test_a_robot_that_falls_mute_is_a_fault_that_says_to_take_out_the_battery():
    async def main():
        bench = Bench(RoombaQuirks(mute_after=3.0))
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        bench.driver.arm()
        with pytest.raises(DriverFault, match=MUTE):
            await bench.running
        assert now() < 4.2
        bench.running = None
        await bench.stop()
        with pytest.raises(DriverFault, match=MUTE):
            await bench.driver.open()
        await bench.stop()
        bench.robot.pull_battery()
        await asyncio.sleep(6.0)
        await bench.start()
        assert bench.frame.mode == "safe"
        await bench.stop()

    run_virtual(main())


def test_a_cable_that_is_pulled_is_a_fault():
    async def main():
        bench = Bench(RoombaQuirks(line=LineFaults(disconnect_after=2.0)))
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        with pytest.raises(DriverFault, match="unplugged"):
            await bench.running
        bench.running = None
        await bench.stop()

    run_virtual(main())
