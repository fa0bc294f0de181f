"""Cameras that must share: the USB bus, the lamps' mains, and the robot's time at a stop."""

import asyncio
import errno
from pathlib import Path

import numpy as np
import pytest
from robotd.drivers.v4l2 import V4l2Config, V4l2Driver

from robotd import observation as observation_module, v4l2, v4l2_api as api
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual, ticks
from robotd.config import Calibration, MissionConfig
from robotd.daemon import _check_groups
from robotd.errors import ConfigError, DriverFault
from robotd.hardware import CameraMode, flicker_free, is_flicker_free
from robotd.identify import Slot
from robotd.observation import Observer, Site
from robotd.plugin import Driver
from robotd.real import RealHardware
from robotd.records import CameraModel, Frame, Sighting, Transform
from tests.video_node import FakeCamera, FakeNode, fault

FULL = 640 * 480 * 30.0  # pixels a second of one camera
NAMES = ("front", "left", "rear", "right")


@pytest.fixture
def webcams(monkeypatch):
    """Four webcams on one USB bus, as /dev/<name>."""
    cameras = {name: FakeCamera() for name in NAMES}
    for camera in cameras.values():
        camera.bus = list(cameras.values())
        camera.controls[api.POWER_LINE_FREQUENCY] = [0, 2, 1, 1, 1]

    def node(path):
        if Path(path).name not in cameras:
            raise fault(errno.ENOENT)
        return FakeNode(cameras[Path(path).name])

    monkeypatch.setattr(v4l2, "VideoNode", node)
    return cameras


def give(webcams, room):
    for camera in webcams.values():
        camera.room = room


async def open_all(hardware, names, mode):
    return [await hardware.open_camera(f"/dev/{name}", name, mode) for name in names]


async def close_all(sources):
    for source in sources:
        source.close()
    for source in sources:
        await asyncio.to_thread(source.wait_released, 5)


# ---- mains -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "mains_hz", "taken"),
    [(0.010, 50, 0.010), (0.010, 60, 1 / 120), (0.020, 60, 2 / 120), (0.024, 50, 0.020), (0.001, 50, 0.010)],
)
def test_an_exposure_is_of_whole_flicker_periods(asked, mains_hz, taken):
    assert flicker_free(asked, mains_hz) == pytest.approx(taken)
    assert is_flicker_free(taken, mains_hz)
    assert is_flicker_free(asked, mains_hz) == (asked == pytest.approx(taken))


def test_on_60_hz_mains_a_camera_is_locked_to_8_3_ms(webcams):
    async def main(stuck):
        webcams["front"].stuck = stuck
        mode = CameraMode(exposure=flicker_free(0.010, 60), mains_hz=60)
        source = (await open_all(RealHardware(), ["front"], mode))[0]
        await close_all([source])
        return source

    source = asyncio.run(main(set()))
    assert source.mode.exposure == pytest.approx(0.0083)
    assert source.remarks == ()
    assert webcams["front"].value(api.POWER_LINE_FREQUENCY) == 2
    webcams["front"].controls[api.EXPOSURE_ABSOLUTE][4] = 100
    source = asyncio.run(main({api.EXPOSURE_ABSOLUTE}))
    assert source.remarks[1] == "exposes for no multiple of 8.33 ms: lamps on 60 Hz mains flicker in its images"


def test_driving_and_standing_are_modes_of_their_own_and_the_modes_gain_wins(webcams):
    async def main():
        driver = V4l2Driver("front", V4l2Config("/dev/front", gain=40.0), RealHardware(), Bus(), Calibration())
        await driver.open()
        task = asyncio.create_task(driver.run())
        seen = []
        for mode in (CameraMode(exposure=0.004, gain=120.0), CameraMode()):
            await driver.start(mode)
            while driver.given is None or abs(driver.given.exposure - mode.exposure) > 1e-6:
                await asyncio.sleep(0.01)
            seen.append((webcams["front"].value(api.EXPOSURE_ABSOLUTE), webcams["front"].value(api.GAIN)))
        await driver.stop()
        assert driver.wanted is None
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await driver.close()
        return seen

    assert asyncio.run(main()) == [(40, 120), (100, 40)]


# ---- one bus for all -------------------------------------------------------------------------------------------------


def test_four_cameras_share_a_bus_at_15_frames_a_second(webcams):
    give(webcams, 2.0 * FULL)

    async def main():
        sources = await open_all(RealHardware(), NAMES, CameraMode(fps=15.0))
        try:
            return [source.mode.fps for source in sources], [source.remarks for source in sources]
        finally:
            await close_all(sources)

    rates, remarks = asyncio.run(main())
    assert rates == [15.0] * 4
    assert remarks == [()] * 4


def test_a_camera_that_finds_the_bus_half_full_falls_back_to_15_and_says_so(webcams):
    give(webcams, 1.5 * FULL)

    async def main():
        sources = await open_all(RealHardware(), ["front", "left"], CameraMode())
        await close_all(sources)
        return sources

    first, second = asyncio.run(main())
    assert (first.mode.fps, second.mode.fps) == (30.0, 15.0)
    assert "gives 15 frames a second instead of 30, because its USB bus has no room" in second.remarks[0]


def test_where_a_bus_carries_two_the_third_names_the_mend_and_pairs_take_turns_without_a_gap(webcams):
    give(webcams, 2.0 * FULL)
    for camera in webcams.values():
        camera.formats = {"MJPG": {(640, 480): [30.0]}}

    async def main():
        hardware = RealHardware()
        pair = await open_all(hardware, NAMES[:2], CameraMode())
        with pytest.raises(DriverFault, match=r"no room.* look in pairs .camera_groups in .mission.."):
            await open_all(hardware, NAMES[2:3], CameraMode())
        for group in (NAMES[2:], NAMES[:2], NAMES[2:]):
            for source in pair:
                source.close()  # their threads still stream
            pair = await open_all(hardware, group, CameraMode())
            assert {name for name, camera in webcams.items() if camera.streaming} == set(group)
        await close_all(pair)

    asyncio.run(main())


# ---- groups in the configuration and at a stop -----------------------------------------------------------------------


def a_camera(name):
    return CameraModel(name, (64, 48), (60.0, 60.0, 31.5, 23.5), Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("groups", "problem"),
    [
        ([], None),
        ([["front", "rear"], ["left", "right"]], None),
        ([["front"], ["left", "right"]], "found front, left, right; expected each of front, left, rear, right once"),
        ([["front", "rear", "front"], ["left", "right"]], "found front, rear, front, left, right"),
        ([["front", "rear", "roof"], ["left", "right"]], "roof"),
    ],
)
def test_every_camera_of_the_rig_belongs_to_one_group(groups, problem):
    from robotd.config import Config

    config = Config(mission=bind(MissionConfig, {"camera_groups": groups}, "x"))
    problems = _check_groups(Path("robotd.toml"), config, Calibration(cameras=tuple(map(a_camera, NAMES))))
    assert bool(problems) == bool(problem)
    assert problem is None or problem in problems[0]


def test_an_empty_group_is_named():
    with pytest.raises(ConfigError, match="camera_groups: found an empty group"):
        bind(MissionConfig, {"camera_groups": [["front"], []]}, "x")


class Films(Driver):
    """A camera that keeps in `log` when it streamed, and fails once if told to."""

    kind = "camera"
    fails = False

    def __init__(self, name, bus, log):
        super().__init__(name, None, None, bus, Calibration())
        self.log, self.task = log, None

    async def start(self, mode):
        self.mode = mode
        self.log.append((self.name, True))
        if not Films.fails:
            self.task = asyncio.create_task(self.film())

    async def stop(self):
        self.log.append((self.name, False))
        if self.task is not None:
            self.task.cancel()

    async def film(self):
        async for k in ticks(1 / 15):
            self.bus.frames(self.name).publish(Frame(self.name, now(), np.zeros((4, 4), np.uint8), k))


class TwoSlots:
    """In place of the Identifier: two slots for each group of cameras, and one sighting by each camera."""

    made = []  # noqa: RUF012
    mistaken, undecided = (), 0

    def __init__(self, labels, cameras, config, **known):
        self.cameras, self.slots, self.frames = cameras, [Slot(0, (), 2.0), Slot(1, (), 2.0)], set()
        TwoSlots.made.append(self)

    def next_slot(self, t):
        return self.slots.pop(0) if self.slots else None

    def begin(self, slot, t):
        pass

    def is_complete(self, t):
        return False

    def update(self, camera, frame):
        self.frames.add(camera)

    def finish(self, t):
        return tuple(Sighting(camera, "A", 1.0, 1.0) for camera in sorted(self.frames))


class Ears:
    """In place of journal, labels and the like: takes everything."""

    def __getattr__(self, name):
        return lambda *arguments, **options: None


def look(config, trouble=None):
    """Let a mission look at one stop; returns the sightings of each group and when which camera streamed."""
    TwoSlots.made, Films.fails = [], False

    async def main():
        bus, log = Bus(), []
        cameras = {name: Films(name, bus, log) for name in NAMES}
        observer = Observer(
            *(config, Calibration()), bus=bus, cameras=cameras, labels=Ears(), journal=Ears(), tell=lambda text: None
        )
        site = Site(1, 1, None, 0.0)
        seen = []
        if trouble is not None:
            trouble()
            with pytest.raises(DriverFault, match="left: no frame for 5 s; check the camera"):
                await observer.observe(site, seen)
            Films.fails = False
        await observer.observe(site, seen)
        return seen, log, {name: camera.mode for name, camera in cameras.items() if hasattr(camera, "mode")}

    return run_virtual(main())


def test_all_cameras_look_at_once_unless_told_otherwise(monkeypatch):
    monkeypatch.setattr(observation_module, "Identifier", TwoSlots)
    seen, log, modes = look(MissionConfig(mains_hz=60))
    assert [[sighting.camera for sighting in group] for group in seen] == [sorted(NAMES)]
    assert log[:4] == [(name, True) for name in NAMES]
    assert {mode.mains_hz for mode in modes.values()} == {60}


def test_pairs_look_one_after_the_other_each_in_slots_of_its_own(monkeypatch):
    monkeypatch.setattr(observation_module, "Identifier", TwoSlots)
    config = MissionConfig(camera_groups=(("front", "rear"), ("left", "right")))
    seen, log, _ = look(config)
    assert [[sighting.camera for sighting in group] for group in seen] == [["front", "rear"], ["left", "right"]]
    assert [made.cameras for made in TwoSlots.made] == [("front", "rear"), ("left", "right")]
    streaming = set()
    for name, starts in log:
        (streaming.add if starts else streaming.discard)(name)
        assert streaming <= {"front", "rear"} or streaming <= {"left", "right"}


def test_a_pair_that_has_looked_does_not_look_again_when_the_other_failed(monkeypatch):
    monkeypatch.setattr(observation_module, "Identifier", TwoSlots)
    config = MissionConfig(camera_groups=(("front", "rear"), ("left", "right")))

    plain = TwoSlots.finish

    def finish(self, t):
        Films.fails = self.cameras == ("front", "rear") and len(TwoSlots.made) == 1
        return plain(self, t)

    monkeypatch.setattr(TwoSlots, "finish", finish)
    seen, _, _ = look(config, trouble=lambda: None)
    assert [[sighting.camera for sighting in group] for group in seen] == [["front", "rear"], ["left", "right"]]
    assert [made.cameras for made in TwoSlots.made].count(("front", "rear")) == 1
