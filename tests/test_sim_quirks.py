"""The simulated robot's deviations from the manual, and the faults of its line: what each switch does to the bytes."""

import asyncio
import dataclasses
import math

import numpy as np
import pytest

from robotd import oi
from robotd.clock import run_virtual
from robotd.errors import ConfigError, DriverFault
from robotd.sim.quirks import LineFaults, RoombaQuirks, listing, quirks_from
from robotd.sim.roomba import SimRoomba
from robotd.sim.roomba_link import RoombaLink
from tests.roomba_wire import Wheelbarrow, Wire

# ---- quirks: what each switch changes on the wire --------------------------------------------------------------------


def distance(wire):
    wire.begin("safe")
    wire.ask(19)
    wire.body.left_rotation += 0.775
    wire.body.right_rotation += 0.775
    return wire.read(19)


def radius(wire):
    return wire.begin("safe", ("drive", 100, 700)).read(40)


def angle(wire):
    wire.begin("safe")
    wire.ask(20)
    wire.body.right_rotation += 0.235 * math.radians(360.5)
    return wire.read(20)


def modes(wire):
    return [wire.begin(name).read(35) for name in ("start", "safe", "full")]


def mode_after_a_cliff(wire):
    wire.begin("safe", ("drive_direct", 100, 100))
    wire.body.cliff = True
    wire.run()
    dropped = wire.read(35)
    wire.send("start")
    return dropped, wire.read(35)


def answers_with_mode(wire):
    wire.begin()
    out = []
    for command in (("sensors", 35), ("query", 7, 35, 8), ("sensors", 5)):
        wire.send(*command)
        out.append(len(wire.run()))
    wire.send("stream", 7, 35)
    frame = wire.run()
    return (*out, frame[1], 35 in frame[2:-1:2])


def streamed_travel(wire):
    wire.begin("safe", ("drive_direct", 300, -300), ("stream", 19, 20, 43))
    wire.run(1.0)
    frames = [event.values for event in oi.StreamDecoder([19, 20, 43]).feed(wire.run(1.0))]
    wire.send("drive_direct", 300, 100)
    frames += [event.values for event in oi.StreamDecoder([19, 20, 43]).feed(wire.run(1.0))]
    wire.send("resume_stream", 0)
    wire.run()
    return sum(frame[19] for frame in frames) > 50, sum(frame[20] for frame in frames) > 20, wire.read(19) > 0


def frame_sum(wire):
    return sum(wire.begin(("stream", 7, 22)).run(0.015)) % 256


def sleeps_in_spite_of_pulses(wire):
    wire.begin()
    for _ in range(5):
        wire.run(60)
        wire.robot.pulse_brc(1.0)
    wire.run(10)
    return wire.robot.is_asleep


def woken(wire, docked=False):
    wire.begin()
    wire.robot.set_docked(docked)
    wire.send("power")
    wire.run(1)
    wire.robot.pulse_brc(1.0)
    wire.run(1)
    wire.send("start")
    by_pulse = wire.run(0.1) == b"" and not wire.robot.is_asleep
    wire.robot.press("clean")
    wire.run(1)
    return by_pulse, wire.robot.is_asleep


def woken_on_dock(wire):
    return woken(wire, docked=True)


def three_pulses(wire):
    wire.run(3)
    for _ in range(3):
        wire.robot.pulse_brc(0.1)
    return wire.robot.baud


def polled_for_three_minutes(wire):
    wire.begin()
    answers = []
    for _ in range(180):
        wire.send("start") if _ == 170 else None
        answers.append(wire.ask(3)[26])
        wire.run(1)
    return [answer == 2696 for answer in answers].count(True), answers[-1]


def lifted_off_the_dock(wire):
    wire.begin()
    wire.robot.set_docked(True)
    wire.send("power")
    wire.run(1)
    wire.robot.press("clean")
    wire.run(1)
    wire.begin()
    wire.robot.set_docked(False)
    wire.run(1)
    return wire.robot.programs.name, wire.robot.mode, wire.robot.right.speed > 0


def flags_on_the_dock(wire):
    wire.begin()
    free = [wire.read(number) for number in (9, 10, 11, 12)]
    wire.robot.set_docked(True)
    return free, [wire.read(number) for number in (9, 10, 11, 12)]


def answers_after_a_while(wire):
    out = []
    wire.begin()
    for seconds in (1, 20):
        wire.run(seconds)
        wire.send("reset")
        wire.run(6)
        wire.send("start")
        wire.send("sensors", 7)
        out.append(len(wire.run()))
    wire.robot.pull_battery()
    wire.run(6)
    wire.begin()
    return (*out, wire.read(7))


def clock_buttons(wire):
    wire.begin("full")
    wire.robot.press("clock")
    wire.robot.press("schedule")
    wire.robot.press("day")
    return wire.read(18), wire.run(0.2), wire.read(18)


def buttons_by_command(wire):
    wire.begin(("buttons", 8))
    return wire.read(18)


def encoders(wire):
    wire.begin("safe")
    before = wire.ask(43)[43], wire.ask(44)[44]
    wire.body.right_rotation += 0.5
    return (wire.read(43) - before[0]) & 0xFFFF, (wire.read(44) - before[1]) & 0xFFFF


def encoders_at_start(wire):
    return wire.begin().read(43), wire.read(44)


def toggled_on_the_charger(wire):
    wire.begin()
    wire.robot.set_docked(True)
    for name in ("full", "start"):
        wire.send(name)
        wire.run(0.5)
    wire.send("sensors", 7)
    at_once = len(wire.run())
    wire.run(130)
    return at_once, wire.read(7)


def gauge(wire):
    wire.begin()
    wire.robot.battery.charge_mah = 2000.0
    return wire.read(25), wire.read(26)


def banner(wire):
    wire.begin("reset")
    text = wire.run(5)
    return b"release-3.2.6" in text, b"stm32-3.7.7" in text, len(text) > 200


def baud(wire):
    return wire.robot.baud, wire.begin("reset").run(5) and wire.robot.baud


def speed_after_a_tick(wire):
    wire.begin("safe", ("drive_direct", 200, 200))
    return round(wire.robot.left.speed, 6)


QUIRKS = [  # switch, its value, what is done, what a robot as in the manual does, what this one does
    ("distance_wrong", True, distance, 775, -100),
    ("distance_wrong", True, radius, 700, 0),
    ("angle_wrong", True, angle, 360, 116),
    ("mode_offset", 1, modes, [1, 2, 3], [2, 3, 4]),
    ("mode_32_after_cliff", True, mode_after_a_cliff, (1, 1), (32, 1)),
    ("mode_packet_dead", True, answers_with_mode, (1, 3, 12, 4, True), (0, 2, 12, 2, False)),
    ("stream_distance_zero", True, streamed_travel, (True, True, True), (False, False, True)),
    ("checksum", "exclusive", frame_sum, 0, 19),
    ("brc_keeps_awake", False, sleeps_in_spite_of_pulses, False, True),
    ("wakes_by_brc", False, woken, (True, False), (False, False)),
    ("brc_works_on_dock", False, woken_on_dock, (True, False), (False, False)),
    ("brc_wired", False, woken, (True, False), (False, False)),
    ("brc_wired", False, three_pulses, 19200, 115200),
    ("brc_wired", False, sleeps_in_spite_of_pulses, False, True),
    ("answers_shift_after", 120.0, polled_for_three_minutes, (180, 2696), (128, 2696)),
    ("cleans_when_lifted_off_dock", True, lifted_off_the_dock, (None, 1, False), ("clean", 1, True)),
    ("cliffs_on_dock", True, flags_on_the_dock, ([0] * 4, [0] * 4), ([0] * 4, [1] * 4)),
    ("mute_after", 10.0, answers_after_a_while, (1, 1, 0), (1, 0, 0)),
    ("clock_buttons_dead", True, clock_buttons, (224, b"", 0), (32, b"", 0)),
    ("buttons_command_dead", True, buttons_by_command, 8, 0),
    ("encoders_swapped", True, encoders, (0, 1124), (1124, 0)),
    ("encoder_start", 65530, encoders_at_start, (17145, 54891), (65530, 65530)),
    ("freeze", 120.0, toggled_on_the_charger, (1, 0), (0, 0)),
    ("gauge_error_mah", 2100.0, gauge, (2000, 2696), (65436, 2696)),
    ("firmware", "stm32-3.7.7", banner, (True, False, True), (False, True, True)),
    ("firmware", "silent", banner, (True, False, True), (False, False, False)),
    ("baud", 19200, baud, (115200, 115200), (19200, 19200)),
    ("acceleration", 0.3, speed_after_a_tick, 0.01125, 0.0045),
]


@pytest.mark.parametrize(
    ("name", "value", "scenario", "plain", "odd"), QUIRKS, ids=lambda item: getattr(item, "__name__", str(item))
)
def test_a_quirk_changes_this_and_the_manual_s_robot_does_that(name, value, scenario, plain, odd):
    assert scenario(Wire()) == plain
    assert scenario(Wire(**{name: value})) == odd


def test_every_quirk_is_in_the_table_and_in_the_listing():
    names = {field.name for field in dataclasses.fields(RoombaQuirks)} - {"line"}
    assert names == {row[0] for row in QUIRKS}
    assert all(f"  {name} = " in listing(RoombaQuirks) for name in names)


def test_quirks_compose():
    wire = Wire(mode_offset=1, checksum="exclusive", mode_32_after_cliff=True, encoders_swapped=True, baud=57600)
    wire.begin("safe", ("stream", 35, 43), ("drive_direct", 100, 100))
    wire.body.cliff = True
    frame = wire.run(0.03)[-8:]
    assert frame[:4] == bytes((19, 5, 35, 32))
    assert sum(frame) % 256 == 19


def test_switches_are_read_from_a_command_line():
    quirks = quirks_from(
        ["mode_offset=1", "wakes_by_brc", "firmware=stm32-3.7.7", "mute_after=30"], ["drop=0.01", "direction=to_host"]
    )
    assert quirks == RoombaQuirks(
        mode_offset=1,
        wakes_by_brc=False,
        firmware="stm32-3.7.7",
        mute_after=30.0,
        line=LineFaults(drop=0.01, direction="to_host"),
    )
    assert quirks_from([]) == RoombaQuirks()


def test_wrong_switches_are_named_all_at_once():
    with pytest.raises(ConfigError) as caught:
        quirks_from(["mode_ofset=1", "baud=9601", "angle_wrong=2"], ["stall=20", "dropp"])
    text = "\n".join(caught.value.problems)
    assert "--quirk: unknown key 'mode_ofset'; did you mean 'mode_offset'?" in text
    assert "--quirk angle_wrong: found 2; expected true or false" in text
    assert "--fault: unknown key 'dropp'; did you mean 'drop'?" in text
    for wrong, words in (
        (["mode_offset"], "expected mode_offset=VALUE"),
        (["baud=9601"], "baud = 9601; expected one of 300"),
        (["line=3"], "faults of the line are set with --fault"),
    ):
        with pytest.raises(ConfigError, match=words):
            quirks_from(wrong)


# ---- the line --------------------------------------------------------------------------------------------------------


def listen(seconds, faults=None, seed=1, send=(), quirks=None):
    """Stream packets 43, 44, 35 for so long over a line; returns the chunks (time, bytes) and the robot."""

    async def main():
        quirks_ = dataclasses.replace(quirks or RoombaQuirks(), line=faults or LineFaults())
        robot = SimRoomba(Wheelbarrow(), np.random.default_rng(seed), quirks_)
        link = RoombaLink(robot, 115200)
        chunks = []
        link.write(oi.encode("start") + oi.encode("stream", 43, 44, 35))
        for data in send:
            link.write(data)
        try:
            async with asyncio.timeout(seconds):
                while True:
                    chunks.append(await link.read())
        except (TimeoutError, DriverFault) as error:
            robot.fault = error
        return chunks, robot

    return run_virtual(main())


def joined(chunks):
    return b"".join(data for _, data in chunks)


CLEAN = joined(listen(60)[0])


def good(data):
    return [event for event in oi.StreamDecoder([43, 44, 35]).feed(data) if isinstance(event, oi.SensorValues)]


@pytest.mark.parametrize(
    ("fault", "longer", "frames"),
    [
        ({"drop": 0.01}, (-0.013, -0.007), (0.85, 0.93)),
        ({"flip": 0.01}, (0.0, 0.0), (0.85, 0.93)),
        ({"insert": 0.01}, (0.007, 0.013), (0.85, 0.95)),
        ({"burst": 0.001, "burst_bytes": 40}, (0.0, 0.0), (0.93, 0.97)),
        ({"burst": 0.001, "direction": "to_robot"}, (0.0, 0.0), (1.0, 1.0)),
        ({"flip": 0.5, "direction": "to_host"}, (0.0, 0.0), (0.0, 0.02)),
    ],
)
def test_bytes_are_hit_as_often_as_the_fault_says(fault, longer, frames):
    data = joined(listen(60, LineFaults(**fault), seed=3)[0])
    assert longer[0] <= len(data) / len(CLEAN) - 1.0 <= longer[1]
    assert frames[0] <= len(good(data)) / len(good(CLEAN)) <= frames[1]


def test_commands_are_hit_as_well():
    commands = [oi.encode("start"), oi.encode("safe")] * 500
    silent, robot = listen(2, LineFaults(drop=1.0, direction="to_robot"), send=commands)
    assert (silent, robot.mode) == ([], oi.OFF)
    assert listen(2, LineFaults(flip=0.3, direction="to_host"), send=commands)[1].mode == oi.SAFE


def test_a_stall_holds_everything_back_and_then_delivers_it_at_once_in_order():
    faults = LineFaults(stall=2.0, stall_every=10.0, direction="to_host")
    chunks, _ = listen(25, faults)
    gaps = np.diff([t for t, _ in chunks])
    assert sorted(np.round(gaps[gaps > 0.1], 1)) == [2.0, 2.0]
    assert np.count_nonzero(gaps < 1e-6) > 250
    assert joined(chunks) == CLEAN[: len(joined(chunks))]


def test_a_stall_on_demand_ends_when_it_was_told():
    async def main():
        link = RoombaLink(SimRoomba(Wheelbarrow(), np.random.default_rng(0)), 115200)
        link.write(oi.encode("start") + oi.encode("stream", 35))
        await asyncio.sleep(1.0)
        while link._chunks:
            await link.read()
        link.stall(3.0)
        t, _ = await link.read()
        assert t == pytest.approx(4.0, abs=1e-3)

    run_virtual(main())


def test_the_cable_is_pulled_when_it_shall_be():
    chunks, robot = listen(60, LineFaults(disconnect_after=7.0))
    assert isinstance(robot.fault, DriverFault)
    assert "unplugged" in str(robot.fault)
    assert chunks[-1][0] == pytest.approx(7.0, abs=0.02)
    assert robot.link is None


def test_every_fault_has_its_line_in_the_listing():
    assert all(f"  {field.name} = " in listing(LineFaults) for field in dataclasses.fields(LineFaults))


NOISY = LineFaults(drop=0.02, flip=0.02, insert=0.02, burst=0.002, stall=0.5, stall_every=3.0)


def test_the_same_seed_gives_the_same_bytes_and_another_one_others():
    first, again, other = (listen(20, NOISY, seed)[0] for seed in (1, 1, 2))
    assert first == again
    assert joined(first) != joined(other)


def test_faults_change_neither_where_the_encoders_start_nor_anything_else_of_the_robot():
    assert listen(1, NOISY)[1].left.counts == listen(1)[1].left.counts


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


def test_another_baud_rate_is_heard_as_noise():
    async def main():
        robot = SimRoomba(Wheelbarrow(), np.random.default_rng(0))
        link = RoombaLink(robot, 19200)
        link.write(oi.encode("start") * 20)
        await asyncio.sleep(0.1)
        assert robot.mode == oi.OFF
        link.set_baud(115200)
        link.write(oi.encode("start") * 36 + oi.encode("stream", 43, 44, 35))
        await asyncio.sleep(0.5)
        link.set_baud(57600)
        await asyncio.sleep(0.5)
        chunks = []
        while link._chunks:
            chunks.append(await link.read())
        assert len(good(joined(item for item in chunks if item[0] < 0.6))) > 30
        assert good(joined(item for item in chunks if item[0] > 0.61)) == []

    run_virtual(main())
