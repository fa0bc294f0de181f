"""Finding the robot, in whatever state it is, and saying what is wrong when it cannot be found."""

import asyncio

import numpy as np
import pytest
from gpiozero.pins.mock import MockFactory
from robotd.drivers.roomba import RoombaConfig

from robotd import oi
from robotd.bind import bind
from robotd.clock import now, run_virtual
from robotd.errors import ConfigError, DriverFault
from robotd.roomba.line import BAUDS, PACKETS, PACKETS_FEWEST, packet_sets
from robotd.sim.quirks import LineFaults, RoombaQuirks
from robotd.sim.roomba_link import RoombaLink
from tests.roomba_bench import Bench, bench_test


def opened(bench, prepare=None):
    """Open the driver, look, close; returns the seconds that opening took."""

    async def main():
        if prepare is not None:
            await prepare(bench)
        begun = now()
        try:
            await bench.driver.open()
            took = now() - begun
            assert bench.robot.mode == oi.PASSIVE
        finally:
            await bench.stop()
        await asyncio.sleep(0.1)
        assert bench.robot.mode == oi.OFF
        return took

    return run_virtual(main())


def test_it_is_found_within_half_a_second_and_stays_in_passive_mode_until_somebody_wants_to_move():
    bench = Bench()
    assert opened(bench) < 0.5
    assert bench.texts() == ["base found on /dev/robotd/base at 115200 baud"]


@pytest.mark.parametrize("baud", BAUDS)
@pytest.mark.parametrize("configured", BAUDS)
def test_the_baud_rate_is_found(baud, configured):
    bench = Bench(RoombaQuirks(baud=baud), baud=configured)
    assert opened(bench) < (0.6 if baud == configured else 8.0)
    assert f"base found on /dev/robotd/base at {baud} baud" in bench.texts()


@pytest.mark.parametrize("baud", BAUDS)
def test_the_frames_of_every_list_of_packets_fit_into_a_tick(baud):
    budget = {115200: 172, 57600: 86, 19200: 28}[baud]
    lists = packet_sets(baud)
    assert PACKETS_FEWEST in lists
    assert (PACKETS in lists) == (baud > 19200)
    for packets in lists:
        layout = oi.StreamLayout(packets)
        assert layout.frame_size <= budget
        assert layout.lookalikes == ()  # no data can ever be taken for a frame


async def asleep(bench):
    bench.robot.is_asleep = True


async def in_mid_list(bench):
    link = RoombaLink(bench.robot, 115200)
    link.write(oi.encode("start") + bytes((148, 255)))  # a stream list of which 255 bytes are missing
    link.close()
    await asyncio.sleep(0.1)


async def in_mid_song(bench):
    link = RoombaLink(bench.robot, 115200)
    link.write(oi.encode("start") + bytes((140, 0, 16, 60)))
    link.close()
    await asyncio.sleep(0.1)


async def abandoned(bench, mode="safe", *packets):
    """A dead program left it driving, and streaming."""
    link = RoombaLink(bench.robot, 115200)
    link.write(
        oi.encode("start") + oi.encode(mode) + oi.encode("stream", *packets) + oi.encode("drive_direct", 200, 200)
    )
    link.close()
    await asyncio.sleep(1.0)
    assert bench.is_moving


async def streaming_the_same(bench):
    await abandoned(bench, "safe", *PACKETS)


async def streaming_something_else(bench):
    await abandoned(bench, "full", 100)


async def just_reset(bench):
    link = RoombaLink(bench.robot, 115200)
    link.write(oi.encode("start") + oi.encode("reset"))
    link.close()
    await asyncio.sleep(0.1)


@pytest.mark.parametrize(
    "state", [asleep, in_mid_list, in_mid_song, streaming_the_same, streaming_something_else, just_reset]
)
@pytest.mark.parametrize("offset", [0, 1])
def test_it_is_found_whatever_was_left_of_a_dead_program(state, offset):
    async def main():
        bench = Bench(RoombaQuirks(mode_offset=offset))
        await state(bench)
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(0.3)
        assert bench.robot.mode == oi.PASSIVE
        assert bench.frame.mode == "passive"  # also where old frames spoke of another mode
        bench.driver.arm()
        await asyncio.sleep(0.1)
        assert bench.frame.mode == "safe"
        assert not bench.robot.left.target
        await bench.stop()
        await asyncio.sleep(0.1)
        assert bench.robot.mode == oi.OFF
        assert not bench.robot.left.target

    run_virtual(main())


def test_the_firmware_is_read_from_the_text_of_a_restart_and_its_traps_are_told():
    async def scenario(bench):
        assert bench.driver.firmware is None
        bench.robot.receive(oi.encode("reset"))
        with pytest.raises(DriverFault):
            await bench.running
        bench.running = None
        await bench.driver.close()
        await asyncio.sleep(1.0)
        await bench.start()
        assert bench.driver.firmware.version == (3, 2, 6)

    texts = bench_test(scenario).texts()
    assert any("the robot's firmware is 3.2.6; it may fall asleep in spite of wake pulses" in text for text in texts)


def test_without_an_old_build_s_mode_packet_the_mode_is_inferred_and_that_is_said():
    bench = Bench(RoombaQuirks(mode_packet_dead=True))
    opened(bench)
    assert any("it does not tell its mode" in text for text in bench.texts())


def test_a_robot_that_cannot_be_woken_is_a_fault_that_says_what_to_check():
    async def main():
        bench = Bench(RoombaQuirks(wakes_by_brc=False))
        bench.robot.is_asleep = True
        with pytest.raises(DriverFault) as caught:
            await bench.driver.open()
        for words in (
            "base: /dev/robotd/base: no sensor frame at 115200, 19200, 57600 baud",
            "press Clean once",
            "RX and TX are not swapped",
            "after its battery was out for a minute",
        ):
            assert words in str(caught.value)
        await bench.stop()
        bench.robot.press_clean()
        await asyncio.sleep(1.0)
        await bench.driver.open()  # the same driver opens again
        await bench.stop()

    run_virtual(main())


def test_a_port_that_only_makes_noise_is_told_from_a_silent_one():
    async def main():
        bench = Bench()
        link = RoombaLink(bench.robot, 115200)
        link.close()

        async def babble():
            rng = np.random.default_rng(3)
            while True:
                await asyncio.sleep(0.01)
                if bench.link is not None:
                    bench.link.deliver(now(), rng.bytes(20))

        bench.robot.power.stop()
        task = asyncio.create_task(babble())
        with pytest.raises(DriverFault, match=r"bytes came but no sensor frame .* check that this is the robot's port"):
            await bench.driver.open()
        task.cancel()
        await bench.stop()

    run_virtual(main())


def test_a_line_on_which_every_byte_is_hit_now_and_then_is_opened_all_the_same():
    found = 0
    for seed in range(12):
        bench = Bench(RoombaQuirks(line=LineFaults(drop=3e-3, flip=3e-3, insert=3e-3)), seed=seed)
        try:
            opened(bench)
            found += 1
        except DriverFault:
            pass
        except AssertionError:  # the last bytes were lost too
            found += 1
    assert found == 12


# ---- what the robot hears --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", BAUDS)
@pytest.mark.parametrize("configured", BAUDS)
@pytest.mark.parametrize("mode", ["start", "safe", "full"])
@pytest.mark.parametrize("streams", [False, True])
def test_what_is_tried_at_wrong_baud_rates_never_starts_the_robot(configured, robot, mode, streams):
    """A command misheard may be Spot, or in Safe and Full mode a motion."""

    async def main():
        bench = Bench(RoombaQuirks(baud=robot), baud=configured)
        link = RoombaLink(bench.robot, robot)
        link.write(oi.encode("start") + oi.encode(mode) + (oi.encode("stream", 100) if streams else b""))
        link.close()
        await asyncio.sleep(0.1)
        begun = []
        bench.robot.listener = lambda what: begun.append(what) if what.startswith(("starts", "wheels")) else None
        await bench.driver.open()
        await bench.stop()
        assert begun == []

    run_virtual(main())


# ---- the wake line ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("polarity", "pulled"), [("low", False), ("high", True)])
def test_a_pin_can_be_the_wake_line_with_one_long_pulse_of_its_polarity(polarity, pulled):
    async def main():
        bench = Bench(RoombaQuirks(wakes_by_brc=False), wake_pin=17, wake_polarity=polarity)
        bench.pins = MockFactory()
        pin = bench.pins.pin(17)
        bench.robot.is_asleep = True
        changes = []
        rest = not pulled

        async def watch():
            state = None
            while True:
                if pin.function == "output" and bool(pin.state) != state:
                    state = bool(pin.state)
                    changes.append((round(now(), 2), state))
                await asyncio.sleep(0.01)

        task = asyncio.create_task(watch())
        with pytest.raises(DriverFault):
            await bench.driver.open()
        task.cancel()
        assert [state for _, state in changes] == [rest, pulled, rest]
        assert changes[2][0] - changes[1][0] == pytest.approx(1.0, abs=0.03)
        await bench.stop()
        bench.pins.close()

    run_virtual(main())


def test_a_pin_that_cannot_be_used_is_a_fault_that_names_it():
    async def main():
        bench = Bench(wake_pin=17)
        bench.pins = MockFactory()
        from gpiozero import LED

        taken = LED(17, pin_factory=bench.pins)
        with pytest.raises(DriverFault, match=r"wake_pin 17 cannot be used: .*GPIO17"):
            await bench.driver.open()
        await bench.stop()
        taken.close()
        bench.pins.close()

    run_virtual(main())


def test_the_serial_adapter_pulses_once_and_long_when_nothing_answers():
    async def main():
        bench = Bench(RoombaQuirks(wakes_by_brc=False))
        bench.robot.is_asleep = True
        pulses = []
        bench.robot.pulse_brc = pulses.append
        with pytest.raises(DriverFault):
            await bench.driver.open()
        assert pulses == [1.0]
        await bench.stop()

    run_virtual(main())


def test_a_bad_section_names_every_mistake():
    with pytest.raises(ConfigError) as caught:
        bind(RoombaConfig, {"prt": "x", "baud": 9600, "checksum": "crc", "rearm": True}, "robotd.toml [drivers.base]")
    assert len(caught.value.problems) >= 4
