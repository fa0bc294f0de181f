import asyncio
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from robotd.drivers.gpio_beacons import BeaconConfig, BeaconDriver

from robotd.beacons import SEPARATION, BeaconRates, conflicts, good_pairs, rates, seen
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual, stall
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault
from robotd.plugin import load
from robotd.real import RealHardware
from robotd.sim.hardware import SimHardware
from robotd.sim.pins import PinStates
from robotd.sim.stores import load_store
from robotd.sim.world import World, WorldSettings

STORE = Path(__file__).parent / "stores" / "corner.toml"
FRONT, REAR = 17, 27


def config(**keys):
    return bind(BeaconConfig, {"front_pin": FRONT, "rear_pin": REAR, **keys}, "robotd.toml [drivers.beacons]")


@pytest.fixture
def world():
    """All of a world that pins need."""
    return types.SimpleNamespace(pins=PinStates())


def make(world, **keys):
    return BeaconDriver("beacons", config(**keys), SimHardware(world), Bus(), Calibration())


async def run_for(driver, seconds):
    """Open, run for so long, cancel, close (twice); returns the time at which it was opened."""
    try:
        await driver.open()
        opened = now()
        running = asyncio.create_task(driver.run())
        await asyncio.sleep(seconds)
        assert not running.done()
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
    finally:
        await driver.close()
        await driver.close()
    return opened


async def open_and_close(driver, check=lambda: None):
    try:
        await driver.open()
        await asyncio.sleep(0.01)
        check()
    finally:
        await driver.close()


def edges(world, pin, high=1.0):
    """Times at which a pin's LED was switched on, and off."""
    changes = world.pins.changes(pin)
    lit = [(t, level == high) for t, level in changes]
    on = [t for t, is_lit in lit if is_lit]
    return on, [t for t, is_lit in lit if not is_lit and on and t > on[0]]


# ---- the driver ------------------------------------------------------------------------------------------------------


def test_it_is_installed_under_its_name():
    assert load("gpio_beacons", "here") is BeaconDriver
    assert BeaconDriver.kind == "beacons"


def test_both_leds_flash_for_an_hour_without_drift_in_one_phase(world):
    """Platform notes, section 4: blinking with relative waits is 0.3 % slow; errors must stay below 0.1 %."""
    driver = make(world)

    async def main():
        await asyncio.sleep(12.345)
        return await run_for(driver, 3600.0)

    start = run_virtual(main())
    for pin, half in ((FRONT, 0.080), (REAR, 0.160)):
        on, off = edges(world, pin)
        count = round(3600.0 / (2 * half))
        assert abs(len(on) - count) <= 1
        np.testing.assert_allclose(on[:count], start + 2 * half * np.arange(count), atol=1e-6)
        np.testing.assert_allclose(off[: count - 1], start + half + 2 * half * np.arange(count - 1), atol=1e-6)
    assert driver.rates.front_hz == pytest.approx(6.25, rel=1e-9)
    assert driver.rates.rear_hz == pytest.approx(3.125, rel=1e-9)


@pytest.mark.parametrize("active_high", [True, False])
def test_both_leds_are_dark_after_every_way_out(world, active_high):
    dark = 0.0 if active_high else 1.0

    async def main():
        for seconds in np.arange(0.0, 0.7, 0.03):  # every phase
            driver = make(world, active_high=active_high)
            await run_for(driver, seconds)
            assert world.pins.changes(FRONT)[-1][1] == world.pins.changes(REAR)[-1][1] == dark
        driver = make(world, active_high=active_high)

        def fail():
            assert world.pins.changes(FRONT)[-1][1] != dark
            raise RuntimeError

        with pytest.raises(RuntimeError):
            await open_and_close(driver, fail)
        await asyncio.sleep(1.0)
        assert world.pins.changes(FRONT)[-1][1] == world.pins.changes(REAR)[-1][1] == dark

    run_virtual(main())


def test_a_pin_in_use_is_a_fault_and_the_other_led_is_released_dark(world):
    from gpiozero import LED

    async def main():
        driver = make(world)
        with (
            LED(REAR, pin_factory=driver.hardware.pins),
            pytest.raises(DriverFault, match=r"beacons: pins 17 and 27: .*in use.*; check the pin numbers"),
        ):
            await open_and_close(driver)
        assert world.pins.changes(FRONT) == [(0.0, 0.0)]
        await run_for(driver, 0.5)  # it can be opened again once the pin is free
        assert len(edges(world, FRONT)[0]) == 4

    run_virtual(main())


def test_a_pin_that_fails_while_flashing_is_a_fault(world):
    async def main():
        driver = make(world)
        try:
            await driver.open()
            pin = driver.hardware.pins.pin(FRONT)
            running = asyncio.create_task(driver.run())
            await asyncio.sleep(0.5)

            def fail(_):
                raise OSError(5, "Input/output error")

            pin._set_state = fail
            with pytest.raises(DriverFault, match="Input/output error"):
                await running
        finally:
            await driver.close()

    run_virtual(main())


def test_after_a_stall_the_leds_are_in_phase_again_without_a_burst_of_edges(world):
    driver = make(world)

    async def main():
        await driver.open()
        running = asyncio.create_task(driver.run())
        await asyncio.sleep(1.001)
        before = {pin: len(world.pins.changes(pin)) for pin in (FRONT, REAR)}
        begun = now()
        stall(0.5)
        await asyncio.sleep(0.0)
        await asyncio.sleep(0.01)
        late = {pin: len(world.pins.changes(pin)) - before[pin] for pin in (FRONT, REAR)}
        await asyncio.sleep(2.0)
        running.cancel()
        await driver.close()
        return begun, late

    begun, late = run_virtual(main())
    assert max(late.values()) <= 2
    for pin, half in ((FRONT, 0.080), (REAR, 0.160)):
        on, off = edges(world, pin)
        phases = np.array([t % (2 * half) for t in on if not begun <= t <= begun + 0.51 and t < begun + 2.4])
        np.testing.assert_allclose(np.minimum(phases, 2 * half - phases), 0.0, atol=1e-6)
        assert len(off) > 5


def test_the_world_knows_how_long_each_led_was_lit_in_an_exposure(world):
    driver = make(world)
    start = run_virtual(run_for(driver, 10.0))
    t0 = start + np.array([[0.0, 0.08, 0.04], [0.16, 0.075, 3.2]])
    t1 = t0 + np.array([[0.08, 0.08, 0.08], [0.32, 0.01, 0.01]])
    np.testing.assert_allclose(world.pins.level(FRONT, t0, t1), [[1.0, 0.0, 0.5], [0.5, 0.5, 1.0]], atol=1e-6)
    np.testing.assert_allclose(world.pins.level(REAR, t0, t1), [[1.0, 1.0, 1.0], [0.5, 1.0, 1.0]], atol=1e-6)
    assert world.pins.level(5, t0, t1).tolist() == np.zeros((2, 3)).tolist()


def test_a_simulated_store_shows_its_robot_s_beacons(tmp_path):
    store = World(load_store(STORE), WorldSettings(), 1, tmp_path)
    run_virtual(run_for(make(store), 1.0))
    assert len(edges(store, FRONT)[0]) == 7


# ---- lgpio -----------------------------------------------------------------------------------------------------------


class FakeLgpio(types.ModuleType):
    """lgpio 0.2.2: a thread that keeps absolute deadlines and starts trains at multiples of their period in a second.

    src/lgPthTx.c, lgGpioCreateTxRec: next = period - (microseconds in the second of the thread's clock) mod period
    + offset; that clock is the thread's next deadline, at most 20 ms ahead.
    """

    class error(Exception):  # noqa: N801
        pass

    def __init__(self, ahead=0.015):
        super().__init__("lgpio")
        self.ahead = ahead
        self.claimed = {}
        self.is_open = False
        self.trains = {}
        self.levels = {}  # pin: changes by hand
        self.stall_once = 0.0

    def gpiochip_open(self, chip):
        assert chip == 4
        self.is_open = True
        return 7

    def gpiochip_close(self, handle):
        assert handle == 7
        self.is_open = False

    def gpio_claim_output(self, handle, gpio, level=0, lFlags=0):
        if gpio in self.claimed:
            raise self.error("GPIO busy")
        self.claimed[gpio] = level

    def gpio_free(self, handle, gpio):
        del self.claimed[gpio]

    def gpio_write(self, handle, gpio, level):
        assert gpio not in self.trains, "stopped before it is switched off"
        self.claimed[gpio] = level
        self.levels.setdefault(gpio, []).append((now(), level))

    def tx_pulse(self, handle, gpio, pulse_on, pulse_off, pulse_offset=0, pulse_cycles=0):
        assert gpio in self.claimed
        if not (pulse_on or pulse_off):
            self.trains.pop(gpio, None)
            return 9
        assert pulse_cycles == 0
        clock = now() + self.ahead
        period = pulse_on + pulse_off
        left = period - int(clock % 1.0 * 1e6) % period + pulse_offset
        self.trains[gpio] = (clock + 1e-6 * left, 1e-6 * pulse_on, 1e-6 * period)
        if self.stall_once:
            stall(self.stall_once)
            self.stall_once = 0.0
        return 9

    def level(self, gpio, t):
        start, on, period = self.trains[gpio]
        return self.claimed[gpio] if t < start else int((t - start) % period < on)


class LgpioPins:
    """Stands for gpiozero's LGPIOFactory of a Pi 5."""

    chip = 4


def lgpio_driver(world, monkeypatch, fake, **keys):
    monkeypatch.setitem(sys.modules, "lgpio", fake)
    hardware = SimHardware(world)
    hardware._pins = LgpioPins()
    return BeaconDriver("beacons", config(timing="lgpio", **keys), hardware, Bus(), Calibration())


@pytest.mark.parametrize("active_high", [True, False])
@pytest.mark.parametrize("begin", [0.0, 0.25, 0.59, 0.61, 0.97, 7.995])
def test_lgpio_s_pulse_trains_have_the_same_phase_whenever_they_are_started(world, monkeypatch, begin, active_high):
    fake = FakeLgpio()
    driver = lgpio_driver(world, monkeypatch, fake, active_high=active_high)

    async def main():
        await asyncio.sleep(begin)
        await driver.open()
        t = now() + 0.7 + np.arange(0.0005, 3.0, 0.001)
        lit = {pin: np.array([fake.level(pin, at) == active_high for at in t]) for pin in (FRONT, REAR)}
        task = asyncio.create_task(driver.run())
        await asyncio.sleep(0.5)
        task.cancel()
        await driver.close()
        return lit

    lit = run_virtual(main())
    rising = {pin: np.flatnonzero(~lit[pin][:-1] & lit[pin][1:]) for pin in (FRONT, REAR)}
    np.testing.assert_allclose(np.diff(rising[FRONT]), 160, atol=1)
    np.testing.assert_allclose(np.diff(rising[REAR]), 320, atol=1)
    assert all(np.abs(rising[FRONT] - edge).min() <= 1 for edge in rising[REAR]), "both are switched on together"
    assert (fake.is_open, fake.claimed, fake.trains) == (False, {}, {})
    assert [changes[-1][1] for changes in fake.levels.values()] == [0 if active_high else 1] * 2


def test_lgpio_is_started_again_when_the_process_was_held_up_between_the_two(world, monkeypatch):
    fake = FakeLgpio()
    fake.stall_once = 0.45
    driver = lgpio_driver(world, monkeypatch, fake)

    async def main():
        await asyncio.sleep(0.55)
        await driver.open()
        starts = [fake.trains[pin][0] for pin in (FRONT, REAR)]
        await driver.close()
        return starts

    front, rear = run_virtual(main())
    assert (rear - front) % 0.16 == pytest.approx(0.0, abs=1e-5) or (rear - front) % 0.16 == pytest.approx(0.16)


def test_lgpio_s_refusals_are_faults_and_everything_is_released(world, monkeypatch):
    fake = FakeLgpio()
    driver = lgpio_driver(world, monkeypatch, fake)
    fake.claimed[REAR] = 0  # by somebody else

    async def main():
        with pytest.raises(DriverFault, match="pins 17 and 27: GPIO busy"):
            await open_and_close(driver)

    run_virtual(main())
    assert list(fake.claimed) == [REAR]
    assert not fake.is_open


def test_lgpio_timing_without_lgpio_s_pins_is_a_fault_that_says_so(world):
    driver = make(world, timing="lgpio")
    with pytest.raises(DriverFault, match=r'needs the pins of lgpio, found MockFactory; install it .* "software"'):
        run_virtual(driver.open())
    assert "lgpio" not in sys.modules


# ---- rates -----------------------------------------------------------------------------------------------------------


def test_the_default_pair_is_fit_for_cameras_from_20_frames_a_second_and_not_for_the_thesis_s_12_9():
    """Errata B2: at half the frame rate the amplitude depends on the phase and can vanish."""
    pair = rates(6.25, 3.125)
    assert pair == BeaconRates(0.080, 1, 2)
    for fps in (20.0, 24.0, 25.0, 29.97, 30.0, 60.0):
        assert conflicts(pair, [fps]) == []
    for fps in (10.0, 12.5, 12.9, 15.0):
        assert any("frames a period" in words for words in conflicts(pair, [fps]))


def test_harmonics_that_fold_onto_the_other_beacon_are_found():
    """At 15.625 frames a second 3 x 3.125 = 9.375 Hz is seen at 6.25 Hz."""
    assert seen(9.375, 15.625) == pytest.approx(6.25)
    assert "at 15.625 frames a second 3 times rear_hz = 3.125 looks like 6.25 Hz, as the front beacon does" in (
        conflicts(rates(6.25, 3.125), [15.625])
    )
    assert conflicts(rates(6.0, 2.0), []) == ["3 times rear_hz = 2 is within 0.5 Hz of front_hz = 6"]
    assert conflicts(rates(5.0, 5.0), []) == ["front_hz = 5 and rear_hz = 5 are not 0.5 Hz apart"]


@given(fps=st.floats(5.0, 120.0))
def test_proposed_pairs_are_told_apart_in_the_spectrum_that_such_a_camera_sees(fps):
    """Simulated frames: the strongest line of each LED is its own rate, and faint at the other's."""
    pairs = good_pairs([fps])
    assert pairs
    for pair in pairs:
        assert rates(float(f"{pair.front_hz:.6g}"), float(f"{pair.rear_hz:.6g}")).front_ticks == pair.front_ticks
        count = int(20 * fps)
        t = np.arange(count) / fps
        open_s = np.linspace(0.0, 0.004, 9)  # exposure
        lit = [
            np.mean([[pair.levels(int(at / pair.tick))[led] for at in t + shift] for shift in open_s], axis=0)
            for led in (0, 1)
        ]
        for led, own, other in ((0, pair.front_hz, pair.rear_hz), (1, pair.rear_hz, pair.front_hz)):
            wave = (lit[led] - lit[led].mean()) * np.hanning(count)
            strength = [abs(np.sum(wave * np.exp(-2j * np.pi * hz * t))) for hz in (own, other)]
            assert strength[0] > 8 * strength[1]
        break  # the first is enough for time's sake


@given(
    tick_ms=st.integers(20, 200),
    ticks=st.sampled_from([(1, 2), (2, 3), (1, 3), (3, 5), (5, 7), (4, 1), (16, 15), (1, 1)]),
)
def test_rates_written_with_six_digits_are_recognised(tick_ms, ticks):
    pair = BeaconRates(1e-3 * tick_ms, *ticks)
    found = rates(float(f"{pair.front_hz:.6g}"), float(f"{pair.rear_hz:.6g}"))
    assert (found.front_ticks, found.rear_ticks) == ticks
    assert found.front_hz == pytest.approx(pair.front_hz, rel=1e-4)
    assert found.rear_hz == pytest.approx(pair.rear_hz, rel=1e-4)
    assert [found.levels(k) for k in range(found.cycle)] == [found.levels(k + found.cycle) for k in range(found.cycle)]
    assert found.levels(0) == (True, True)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"rear_pin": FRONT}, "front_pin and rear_pin are both 17; expected two pins"),
        ({"rear_hz": 3.0}, "front_hz = 6.25, rear_hz = 3: one tick of 20 ms or more does not divide both"),
        (
            {"camera_fps": [12.9]},
            r"at 12.9 frames a second is above 5.16 .*; take front_hz = 4.54545, rear_hz = 2.27273",
        ),
        ({"camera_fps": [30.0, 15.625]}, "at 15.625 frames a second 3 times rear_hz"),
        ({"camera_fps": [1.5]}, "no pair of rates suits: use faster cameras"),
        ({"camera_fps": [0.0]}, r"camera_fps = \[0.0\]; expected frames a second"),
        ({"front_pin": 28}, "28"),
        ({"front_freq": 5.0}, "front_freq"),
        ({"timing": "hardware"}, '"software"|software'),
    ],
)
def test_mistakes_in_the_configuration_are_named_with_a_way_out(keys, message):
    with pytest.raises(ConfigError, match=message):
        config(**keys)


def test_another_pair_flashes_as_configured(world):
    driver = make(world, front_hz=4.54545, rear_hz=2.27273, camera_fps=[12.9])
    run_virtual(run_for(driver, 100.0))
    for pin, hz in ((FRONT, 4.54545), (REAR, 2.27273)):
        on, _ = edges(world, pin)
        assert (len(on) - 1) / (on[-1] - on[0]) == pytest.approx(hz, rel=1e-3)
    assert SEPARATION < 4.54545 - 2.27273


# ---- real pins -------------------------------------------------------------------------------------------------------


def test_real_pins_without_a_gpio_chip_are_a_fault_that_names_the_mend(monkeypatch):
    import gpiozero

    def none():
        raise gpiozero.BadPinFactory("unable to load any default pin factory")

    monkeypatch.setattr(gpiozero.Device, "ensure_pin_factory", staticmethod(none))
    with pytest.raises(DriverFault, match=r"no pins: .* python3-lgpio, /dev/gpiochip0, and the user in the group gpio"):
        _ = RealHardware().pins


def test_real_pins_are_gpiozero_s_and_made_once(monkeypatch):
    import gpiozero
    from gpiozero.pins.mock import MockFactory

    monkeypatch.setattr(gpiozero.Device, "pin_factory", None)
    monkeypatch.setenv("GPIOZERO_PIN_FACTORY", "mock")
    hardware = RealHardware()
    assert isinstance(hardware.pins, MockFactory)
    assert hardware.pins is hardware.pins
    hardware.pins.close()
