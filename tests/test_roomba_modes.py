"""Passive while nobody wants to move, Safe while somebody does, and what happens between."""

import asyncio
from itertools import pairwise

import pytest

from robotd import oi
from robotd.clock import now, run_virtual
from robotd.errors import DriverFault
from robotd.records import Pose
from robotd.sim.dock import Dock
from robotd.sim.quirks import RoombaQuirks
from tests.roomba_bench import Bench, bench_test


def told(bench):
    """Keep what the robot says of its modes, with times."""
    said = []
    bench.robot.listener = lambda what: said.append((round(now(), 2), what))
    return said


def modes(said):
    return [what.split(":")[0].removeprefix("mode ") for _, what in said if what.startswith("mode ")]


# ---- arming ----------------------------------------------------------------------------------------------------------


def test_nobody_wants_to_move_so_it_stays_passive_and_drive_commands_go_nowhere():
    async def main():
        bench = Bench()
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        for _ in range(30):
            bench.driver.drive(0.2, 0.0)
            await asyncio.sleep(0.03)
        assert bench.frame.mode == "passive"
        assert bench.robot.mode == oi.PASSIVE
        assert not bench.is_moving
        await bench.stop()

    run_virtual(main())


@pytest.mark.parametrize("offset", [0, 1])
@pytest.mark.parametrize("baud", [115200, 57600, 19200])
def test_a_wish_to_move_arms_it_within_50_ms(offset, baud):
    async def main():
        bench = Bench(RoombaQuirks(mode_offset=offset, baud=baud), baud=baud)
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(0.5)
        bench.driver.arm()
        await asyncio.sleep(0.05)
        assert bench.frame.mode == "safe"
        await bench.stop()

    run_virtual(main())


def test_it_stays_armed_while_the_wish_is_repeated_and_goes_passive_after_it():
    async def scenario(bench):
        for _ in range(6):
            bench.driver.arm()
            await asyncio.sleep(4.0)
            assert bench.frame.mode == "safe"
        said = told(bench)
        await asyncio.sleep(2.0)
        assert bench.frame.mode == "passive"
        assert modes(said) == ["passive"]
        bench.driver.arm()
        await asyncio.sleep(0.1)
        assert bench.frame.mode == "safe"

    bench = bench_test(scenario, disarm_s=5.0)
    assert sum("nobody wants to move" in text for text in bench.texts()) == 1
    assert bench.texts("warning") == []


# ---- dropping out ----------------------------------------------------------------------------------------------------


def cliff(bench, is_there):
    bench.body.cliff = is_there


def left_drop(bench, is_there):
    bench.body.wheel_drop_left = is_there


def right_drop(bench, is_there):
    bench.body.wheel_drop_right = is_there


def plug(bench, is_there):
    bench.robot.set_plugged(is_there)


HAZARDS = [
    (cliff, "the front left and front right cliff sensors see no floor"),
    (left_drop, "the left wheel dropped"),
    (right_drop, "the right wheel dropped"),
    (plug, "it is on the charger"),
]


@pytest.mark.parametrize(("hazard", "words"), HAZARDS)
@pytest.mark.parametrize("quirks", [RoombaQuirks(), RoombaQuirks(mode_packet_dead=True), RoombaQuirks(mode_offset=1)])
def test_a_drop_out_of_safe_mode_is_named_and_mended_when_the_hazard_is_gone(hazard, words, quirks):
    async def scenario(bench):
        await bench.drive_for(1.0, 0.2)
        hazard(bench, True)
        await bench.drive_for(0.25, 0.2)
        assert bench.robot.mode == oi.PASSIVE
        assert bench.robot.left.target == 0.0
        assert bench.frame.mode == "passive"
        await bench.drive_for(3.0, 0.2)
        assert bench.robot.mode == oi.PASSIVE  # not while the hazard is there
        hazard(bench, False)
        await bench.drive_for(0.7, 0.2)
        assert bench.frame.mode == "safe"

    bench = bench_test(scenario, quirks=quirks)
    assert f"the base left safe mode for passive mode: {words}" in bench.texts("warning")
    assert bench.texts()[-1] == "the base is in safe mode"


def test_a_pressed_button_is_named():
    async def scenario(bench):
        bench.robot.press_clean()
        await asyncio.sleep(0.3)
        assert bench.frame.mode == "passive"

    texts = bench_test(scenario).texts("warning")
    assert texts == ["the base left safe mode for passive mode: the Clean button was pressed"]


def test_a_drop_without_a_visible_cause_says_so():
    async def scenario(bench):
        bench.robot.receive(oi.encode("start"))
        await asyncio.sleep(0.3)

    assert bench_test(scenario).texts("warning") == ["the base left safe mode for passive mode: for an unknown reason"]


def test_modes_are_not_toggled_more_often_than_twice_a_second():
    async def scenario(bench):
        said = told(bench)
        for _ in range(40):
            bench.driver.arm()
            bench.robot.press_clean()
            await asyncio.sleep(0.1)
        assert modes(said).count("safe") <= 8

    bench_test(scenario)


def test_rearm_never_waits_for_a_new_wish():
    async def scenario(bench):
        bench.robot.press_clean()
        await bench.drive_for(5.0, 0.2)
        assert bench.frame.mode == "passive"
        await asyncio.sleep(2.5)
        await bench.drive_for(0.3, 0.2)
        assert bench.frame.mode == "safe"

    assert any('rearm = "never"' in text for text in bench_test(scenario, rearm="never").texts("warning"))


def test_rearm_always_goes_back_although_the_hazard_is_there():
    async def scenario(bench):
        await bench.drive_for(1.0, 0.2)
        bench.body.cliff = True
        await bench.drive_for(0.3, 0.2)
        assert bench.frame.mode == "passive"
        bench.driver.halt()
        await asyncio.sleep(0.5)
        assert bench.frame.mode == "safe"  # at rest a cliff does not end it
        await bench.drive_for(1.0, -0.1)
        assert bench.robot.left.speed < 0.0

    bench_test(scenario, rearm="always")


def test_a_robot_lifted_from_the_start_says_why_it_does_not_move():
    async def main():
        bench = Bench()
        bench.body.wheel_drop_right = True
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        for _ in range(50):
            bench.driver.arm()
            await asyncio.sleep(0.02)
        assert bench.texts("warning") == ["the base stays in passive mode: the right wheel dropped"]
        bench.body.wheel_drop_right = False
        await asyncio.sleep(1.0)
        assert bench.frame.mode == "safe"
        await bench.stop()

    run_virtual(main())


# ---- readings that mislead -------------------------------------------------------------------------------------------


def test_full_mode_is_refused_in_words_and_left():
    async def scenario(bench):
        bench.robot.receive(oi.encode("full"))
        await asyncio.sleep(0.3)
        assert any(frame.mode == "full" for frame in bench.frames)
        assert bench.frame.mode == "safe"

    assert bench_test(scenario).texts("error") == [
        "the base is in full mode, in which it does not brake at cliffs: refused"
    ]


@pytest.mark.parametrize("offset", [0, 1])
def test_a_wrongly_learnt_numbering_of_modes_is_corrected(offset):
    async def main():
        bench = Bench(RoombaQuirks(mode_offset=offset))
        await bench.driver.open()
        bench.driver._modes.offset = 1 - offset
        bench.running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(0.1)
        await bench.drive_for(3.0, 0.2)
        assert bench.robot.mode == oi.SAFE
        assert bench.frame.mode == "safe"
        assert bench.is_moving
        await bench.stop()

    run_virtual(main())


def test_a_cleaning_program_that_starts_by_itself_is_stopped():
    async def scenario(bench):
        bench.robot.set_docked(True)
        await asyncio.sleep(0.1)
        bench.robot.is_asleep = True
        bench.robot.press_clean()  # wakes it; with this quirk it cleans when it is lifted off the dock
        await asyncio.sleep(5.0)
        bench.robot.set_docked(False)
        assert bench.robot.programs.is_running
        await asyncio.sleep(5.0)
        assert not bench.robot.programs.is_running
        assert not bench.is_moving

    bench = bench_test(scenario, quirks=RoombaQuirks(cleans_when_lifted_off_dock=True), disarm_s=1.0)
    assert any("the robot drove by itself" in text for text in bench.texts("warning"))


# ---- the charger -----------------------------------------------------------------------------------------------------


def test_on_the_charger_it_stays_passive_and_says_why_once():
    async def scenario(bench):
        bench.robot.set_docked(True)
        await asyncio.sleep(1.0)
        assert bench.frame.docked
        assert bench.frame.charging
        said = told(bench)
        await bench.drive_for(10.0, 0.2)
        assert said == []
        bench.robot.set_docked(False)
        await bench.drive_for(1.0, 0.2)
        assert bench.frame.mode == "safe"
        assert not bench.frame.docked

    texts = bench_test(scenario).texts("warning")
    assert texts == [
        "the base left safe mode for passive mode: it is on the charger",
        "the base stays in passive mode: it is on the charger (leave_dock = false)",
    ]


def test_with_leave_dock_it_drives_away_without_toggling_modes():
    async def main():
        bench = Bench(RoombaQuirks(freeze=60.0), leave_dock=True)
        bench.robot.set_docked(True)
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(1.0)
        assert bench.frame.charging
        said = told(bench)
        await bench.drive_for(2.0, -0.1)
        bench.robot.set_docked(False)
        await bench.drive_for(1.0, -0.1)
        assert bench.frame.mode == "safe"
        assert bench.is_moving
        assert modes(said) == ["safe"]
        await bench.stop()

    run_virtual(main())


def test_opening_and_closing_on_the_charger_leaves_it_charging_in_passive_mode():
    async def main():
        bench = Bench(RoombaQuirks(freeze=60.0))
        bench.robot.set_docked(True)
        said = told(bench)
        for _ in range(3):
            await bench.driver.open()
            bench.running = asyncio.create_task(bench.driver.run())
            await asyncio.sleep(1.0)
            assert bench.frame.charging
            await bench.stop()
            await asyncio.sleep(1.0)
        assert modes(said) == ["passive"]  # from Off, once
        assert not any("frozen" in what for _, what in said)

    run_virtual(main())


def test_cliff_flags_of_a_docked_robot_are_no_cliff():
    async def scenario(bench):
        await asyncio.sleep(0.1)
        bench.robot.set_docked(True)
        await asyncio.sleep(1.0)
        assert not any(frame.cliff for frame in bench.frames)

    texts = bench_test(scenario, quirks=RoombaQuirks(cliffs_on_dock=True)).texts("warning")
    assert texts[0] == "the base left safe mode for passive mode: it is on the charger"


def test_a_low_battery_is_told_once_until_it_was_charged():
    async def scenario(bench):
        for _ in range(2):
            bench.robot.battery.charge_mah = 200.0
            await asyncio.sleep(20.0)
            bench.robot.set_docked(True)
            await asyncio.sleep(1.0)
            bench.robot.set_docked(False)

    texts = bench_test(scenario).texts("warning")
    assert sum("the robot's battery is low: 7 % charge" in text for text in texts) == 2


# ---- docking ---------------------------------------------------------------------------------------------------------


class OnRails:
    """A body that really goes where its wheels carry it, straight on."""

    def __init__(self, body, start):
        self.body, self.start = body, start

    @property
    def pose(self):
        return Pose(self.start + 0.5 * (self.body.left_rotation + self.body.right_rotation), 0.0, 0.0)


def test_it_docks_and_charges():
    async def scenario(bench):
        bench.robot.dock = Dock(Pose(0.0, 0.0, 0.0), OnRails(bench.body, -1.0))
        await bench.driver.dock()
        assert bench.frame.charging
        assert bench.frame.docked
        assert any(frame.slipping for frame in bench.frames)
        said = told(bench)
        await bench.driver.dock()  # it is there
        assert said == []

    bench = bench_test(scenario)
    assert bench.texts()[-2:] == ["seeking the dock", "docked and charging"]
    assert bench.robot.mode == oi.PASSIVE  # and charging


def test_a_dock_that_is_not_found_is_a_fault_after_its_time_and_the_robot_stands():
    async def scenario(bench):
        begun = now()
        with pytest.raises(DriverFault, match="not on the charger within 20 s; put it in front of the dock"):
            await bench.driver.dock()
        assert now() - begun == pytest.approx(20.0, abs=0.1)
        await asyncio.sleep(1.0)
        assert not bench.robot.programs.is_running
        assert not bench.is_moving
        assert bench.robot.mode == oi.PASSIVE
        await bench.drive_for(0.3, 0.2)
        assert bench.frame.mode == "safe"

    bench_test(scenario, dock_s=20.0)


@pytest.mark.parametrize("how", ["halt", "cancel", "close"])
def test_docking_ends_when_it_is_interrupted_and_the_robot_stands(how):
    async def scenario(bench):
        docking = asyncio.create_task(bench.driver.dock())
        await asyncio.sleep(3.0)
        assert bench.robot.programs.name == "dock"
        bench.driver.arm()  # does not interrupt it
        bench.driver.drive(0.0, 0.0)
        await asyncio.sleep(0.1)
        assert bench.robot.programs.name == "dock"
        if how == "halt":
            bench.driver.halt()
        elif how == "cancel":
            docking.cancel()
        else:
            await bench.stop()
        await asyncio.sleep(1.0)
        assert not bench.robot.programs.is_running
        assert not bench.is_moving
        assert bench.robot.mode == (oi.OFF if how == "close" else oi.PASSIVE)
        with pytest.raises(asyncio.CancelledError if how == "cancel" else DriverFault):
            await docking

    bench_test(scenario)


@pytest.mark.parametrize(("hazard", "words"), HAZARDS[:3])
def test_docking_is_refused_in_words(hazard, words):
    async def scenario(bench):
        hazard(bench, True)
        await asyncio.sleep(0.1)
        with pytest.raises(DriverFault, match=f"cannot dock: {words}"):
            await bench.driver.dock()
        assert not bench.robot.programs.is_running

    bench_test(scenario)


def test_a_closed_base_does_not_dock():
    async def main():
        with pytest.raises(DriverFault, match="cannot dock: the base is not open"):
            await Bench().driver.dock()

    run_virtual(main())


# ---- sleep -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("firmware", "spacing"), [("3.2.6", 30.0), ("stm32-3.7.7", 60.0), ("silent", 60.0)])
def test_in_passive_mode_the_wake_line_is_pulsed_as_the_firmware_needs_it(firmware, spacing):
    async def main():
        bench = Bench(RoombaQuirks(firmware=firmware))
        await bench.driver.open()
        bench.robot.receive(oi.encode("reset"))
        await bench.stop()
        await asyncio.sleep(0.5)
        await bench.driver.open()
        pulses = []
        bench.robot.pulse_brc = lambda seconds: pulses.append((now(), seconds))
        bench.running = asyncio.create_task(bench.driver.run())
        await asyncio.sleep(4 * spacing + 5.0)
        assert [seconds for _, seconds in pulses] == [1.0] * 4
        times = [t for t, _ in pulses]
        assert [b - a for a, b in pairwise(times)] == pytest.approx([spacing] * 3, abs=1.1)
        await bench.stop()

    run_virtual(main())


def test_a_robot_that_falls_asleep_is_woken_and_that_is_told_once():
    async def scenario(bench):
        await asyncio.sleep(3.0)
        frames = len(bench.frames)
        bench.robot.is_asleep = True
        await asyncio.sleep(4.0)
        assert not bench.robot.is_asleep
        assert len(bench.frames) > frames + 30
        assert bench.frame.mode == "passive"
        assert not bench.running.done()

    texts = bench_test(scenario, disarm_s=1.0).texts("warning")
    assert len(texts) == 1
    assert texts[0].startswith("the robot had fallen asleep and was woken after ")


@pytest.mark.parametrize(
    ("quirks", "docked", "words"),
    [
        (RoombaQuirks(wakes_by_brc=False), False, "it fell asleep and does not wake: press Clean once"),
        (RoombaQuirks(brc_wired=False), False, "not every cable has the wake line, see wake_pin"),
        (RoombaQuirks(brc_works_on_dock=False), True, "it sleeps on the charger, where the wake line may do nothing"),
    ],
)
def test_a_robot_that_does_not_wake_is_a_fault_that_says_what_to_do(quirks, docked, words):
    async def main():
        bench = Bench(quirks)
        await bench.driver.open()
        bench.running = asyncio.create_task(bench.driver.run())
        bench.robot.set_docked(docked)
        await asyncio.sleep(1.0)
        bench.robot.is_asleep = True
        with pytest.raises(DriverFault, match=words):
            await bench.running
        bench.running = None
        await bench.stop()

    run_virtual(main())
