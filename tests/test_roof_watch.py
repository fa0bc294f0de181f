"""Watching through network cameras over HTTP on loopback, in virtual time: dwells, stalls, jitter, a pushed camera."""

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.geometry.homography import fit
from robotd.roof.setup import RoofCalibration, RoofSettings, RoofSetup, matrix3
from robotd.roof_watch import RoofWatch
from robotd.sim.mjpeg_server import MjpegServer, NetworkCameraSettings
from robotd.vision.beacon import BeaconConfig
from tests.roof_film import Film, ramp

SCALE = 180.0  # px a metre: 36 px between beacons 0.2 m apart
START = datetime(2026, 3, 2, 7, 30, tzinfo=UTC)


class Clock:
    """A Hardware that knows the date."""

    def utc(self):
        return START + timedelta(seconds=now())


def a_calibration(name="roof-1", size=(320, 240)):
    """A camera straight above: v downwards is y to the right."""
    world = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    seen = np.array([160.0, 120.0]) + SCALE * world * [1.0, -1.0]
    found = fit(world, seen, 0.1).homography
    covariance = tuple(tuple(row) for row in found.covariance.tolist())
    return RoofCalibration(name, size, (300.0, 300.0, 159.5, 119.5), matrix3(found.inverse), covariance, 0.65)


def a_film(**changes):
    film = Film(2, start=(100.0, 100.0), direction=0.5, lost=0.0, uneven=0.0, row_time=0.0, **changes)
    film.phase = 0.05
    return film


@asynccontextmanager
async def watching(tmp_path, film, *, wire=None, guard_s=60.0, **settings):
    """A watch of one camera that shows a film; yields it, its events and the server."""
    served = replace(NetworkCameraSettings(fps=12.9, delay_min=0.04, delay_max=0.07), **settings)
    server = MjpegServer(lambda t: film.draw(t), served, wire=wire)
    address = await server.start()
    drivers = {"roof-1": {"driver": "mjpeg", "url": address, "delay_s": 0.055, "stall_s": 1.0}}
    setup = RoofSetup(RoofSettings(data=tmp_path, guard_s=guard_s), BeaconConfig(jitter_s=0.008), drivers)
    watch = RoofWatch(tmp_path / "roof.toml", setup, {"roof-1": a_calibration()}, Clock(), Bus())
    events = []

    async def listen():
        with watch.bus.events.subscribe(size=100) as subscription:
            async for event in subscription:
                events.append(event.text)

    tasks = [asyncio.create_task(listen()), asyncio.create_task(watch.run())]
    try:
        yield watch, events
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        await server.close()
    for result in results:
        if isinstance(result, Exception):
            raise result


def true_pose(film, t):
    front, rear = film.place("front", t), film.place("rear", t)
    middle = 0.5 * (front + rear)
    x, y = (middle - (160.0, 120.0)) / (SCALE, -SCALE)
    return x, y, np.arctan2(-(front - rear)[1], (front - rear)[0])


@pytest.mark.parametrize("stamps", ["X-Timestamp", None])
def test_a_robot_that_stands_drives_and_stands_again_leaves_two_dwells_and_is_seen_between(tmp_path, stamps):
    film = a_film(travelled=ramp(40.0, 60.0, 5.0, 8.0))

    async def main():
        errors, speeds = [], []
        async with watching(tmp_path, film, stamps=stamps) as (watch, _):
            while now() < 13.0:
                await asyncio.sleep(0.25)
                present = watch.pose()
                if present is not None and now() > 3.5:
                    t, pose = present
                    x, y, heading = true_pose(film, t)
                    miss = float(np.hypot(pose.pose.x - x, pose.pose.y - y))
                    errors.append(miss)
                    speeds.append(5.2 < t < 8.0)
                    assert np.cos(pose.pose.heading - heading) > np.cos(0.05)
            status = json.loads(json.dumps(watch.status()))
        return np.array(errors), np.array(speeds), status, watch.log.dwells()

    errors, driving, status, dwells = run_virtual(main())
    assert len(errors) > 25
    assert np.sqrt(np.mean(errors[~driving] ** 2)) < 0.004
    assert driving.sum() > 5
    assert np.sqrt(np.mean(errors[driving] ** 2)) < 0.012
    assert status["cameras"][0]["beacons"].keys() == {"front", "rear"}
    assert status["pose"] is not None
    for name in ("front", "rear"):
        first, second = [dwell for dwell in dwells if dwell.beacon == name]
        assert first.end - START.timestamp() == pytest.approx(5.2, abs=0.5)
        assert (first.u, first.v) == pytest.approx(tuple(film.place(name, 0.0)), abs=0.1)
        assert (second.u, second.v) == pytest.approx(tuple(film.place(name, 12.0)), abs=0.1)
        assert not second.is_open, "closed when the watch ends"


def test_a_camera_that_stalls_is_connected_to_again_and_the_dwell_before_is_kept(tmp_path):
    film = a_film()

    def wire(number, part):
        return (part,) if number != 60 else (part[: len(part) // 2], 7.0, None)

    async def main():
        async with watching(tmp_path, film, wire=wire) as (watch, events):
            await asyncio.sleep(14.0)
            return watch.log.dwells(), events, watch.status()

    dwells, events, status = run_virtual(main())
    assert any("connecting again" in text for text in events)
    assert {dwell.beacon for dwell in dwells} == {"front", "rear"}
    assert status["cameras"][0]["beacons"].keys() == {"front", "rear"}, "found again"
    assert all((dwell.u, dwell.v) == pytest.approx(tuple(film.place(dwell.beacon, 0.0)), abs=0.15) for dwell in dwells)


def test_a_camera_that_is_pushed_is_told_and_believed_no_more(tmp_path):
    film = a_film(lit=(False, False))
    straight = film.draw

    def pushed(t):
        image = straight(t)
        return np.roll(image, (6, -4), axis=(0, 1)) if t > 22.0 else image

    film.draw = pushed

    async def main():
        async with watching(tmp_path, film, guard_s=8.0, fps=3.0) as (watch, events):
            await asyncio.sleep(21.0)
            before = watch.cameras[0].moved
            await asyncio.sleep(30.0)
            return before, watch.cameras[0].moved, events

    before, after, events = run_virtual(main())
    assert not before
    assert after
    assert any("was moved since its calibration" in text and "px from" in text for text in events)


def test_odometry_is_laid_onto_the_world_by_what_the_cameras_see(tmp_path):
    from robotd.records import OdometryState, Pose

    film = a_film()

    async def main():
        async with watching(tmp_path, film) as (watch, _):
            while now() < 5.0:
                await asyncio.sleep(0.1)
                watch.odometry.add(OdometryState(now(), Pose(4.0, 5.0, 1.0), 0.0))
            camera = watch.cameras[0]
            here = film.place("front", 0.0)
            t = np.array([now() - 0.5, now()])
            return watch.odometry.places(camera.calibration, camera.lens, (0.1, 0.0, 0.65), t, here, now()), here

    places, here = run_virtual(main())
    assert np.abs(places - here).max() < 0.01


def test_beacons_at_another_height_than_the_calibrations_are_refused(tmp_path):
    from robotd.errors import ConfigError

    setup = RoofSetup(RoofSettings(data=tmp_path), BeaconConfig(), {"roof-1": {"driver": "mjpeg", "url": "http://h/"}})
    low = replace(a_calibration(), height=0.3)
    with pytest.raises(ConfigError, match=r"is calibrated for beacons 0\.3 m high"):
        RoofWatch(tmp_path / "roof.toml", setup, {"roof-1": low}, Clock())
