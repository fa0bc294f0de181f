"""Roof cameras on the way to the map: poses, dwells, their joining to stops, and the alarm when a camera was moved."""

from datetime import UTC, datetime

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import ConfigError
from robotd.files import stop_to_json, survey_from_json, survey_to_json
from robotd.geometry.transforms import se2_relative
from robotd.records import CameraModel, Move, OdometryState, Pose, Rig, Stop, Survey, Transform
from robotd.roof.dwell import Dwell, DwellBuilder, RoofLog
from robotd.roof.guard import check_scene, median_picture
from robotd.roof.join import join, with_roof
from robotd.roof.motion import OdometryTrack
from robotd.roof.pose import Lens, Seen, plausible_pair, solve_pose
from robotd.roof.setup import load_setup
from robotd.server.store import Store
from robotd.solver import solve
from robotd.vision.beacon import BeaconFix
from tests.roof_view import BEACONS, BENT, View, beacons_at

FIRST = View()
SECOND = View("roof-2", eye=(2.6, 2.2, 2.6), target=(0.3, 0.4, 0.0), distortion=BENT)
T0 = 1_772_436_600.0


def seen_at(pose, views, sigma=0.0, rng=None):
    """What cameras see of a robot, undistorted, with noise."""
    found = []
    for view in views:
        lens = Lens(view.model)
        for name, point in beacons_at(pose).items():
            pixel = view.see(point[None])[0] + (rng.normal(0.0, sigma, 2) if sigma else 0.0)
            found.append(Seen(view.model.name, name, *lens.undistort(pixel, max(sigma, 1e-3) ** 2 * np.eye(2))))
    return found


HOMOGRAPHIES = {view.model.name: view.homography() for view in (FIRST, SECOND)}


# ---- poses -----------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(x=st.floats(-0.4, 1.2), y=st.floats(-0.4, 1.2), heading=st.floats(-3.1, 3.1), two=st.booleans())
def test_the_pose_is_exact_from_exact_pixels(x, y, heading, two):
    views = (FIRST, SECOND) if two else (FIRST,)
    found = solve_pose(seen_at((x, y, heading), views), HOMOGRAPHIES, BEACONS)
    assert (found.pose.x, found.pose.y) == pytest.approx((x, y), abs=1e-5)
    assert np.cos(found.pose.heading - heading) > 1.0 - 1e-8
    assert (found.cross_px is not None) == two
    if two:
        assert found.cross_px < 0.01


def test_the_poses_covariance_is_that_of_its_errors_and_two_cameras_are_better_than_one():
    rng = np.random.default_rng(1)
    widths = {}
    for views in ((FIRST,), (FIRST, SECOND)):
        nees, chi2 = [], []
        for _ in range(80):
            true = np.array([rng.uniform(-0.3, 1.0), rng.uniform(-0.3, 1.0), rng.uniform(-3.0, 3.0)])
            found = solve_pose(seen_at(true, views, 0.3, rng), HOMOGRAPHIES, BEACONS)
            miss = np.array([found.pose.x, found.pose.y, found.pose.heading]) - true
            miss[2] = (miss[2] + np.pi) % (2 * np.pi) - np.pi
            nees.append(miss @ np.linalg.solve(np.array(found.covariance), miss))
            chi2.append(found.chi2 / found.freedom)
        assert np.mean(nees) == pytest.approx(3.0, abs=0.8)
        assert np.mean(chi2) == pytest.approx(1.0, abs=0.25)
        widths[len(views)] = np.trace(np.array(found.covariance)[:2, :2])
    assert widths[2] < widths[1]


def test_one_beacon_is_no_pose():
    seen = [item for item in seen_at((0.3, 0.2, 0.5), (FIRST, SECOND)) if item.beacon == "front"]
    assert solve_pose(seen, HOMOGRAPHIES, BEACONS) is None
    assert solve_pose([], HOMOGRAPHIES, BEACONS) is None


def test_only_places_as_far_apart_as_the_beacons_are_a_pair():
    lens = Lens(FIRST.model)
    at = {name: tuple(FIRST.see(point[None])[0]) for name, point in beacons_at((0.3, 0.2, 1.0)).items()}
    assert plausible_pair(FIRST.calibration(), lens, 0.2, at["front"], at["rear"])
    assert not plausible_pair(FIRST.calibration(), lens, 0.4, at["front"], at["rear"])


@pytest.mark.parametrize("view", [FIRST, SECOND], ids=["straight", "bent"])
def test_lenses_are_undone_and_done_again(view):
    lens = Lens(view.model)
    pixel = np.array([410.0, 300.0])
    flat, spread = lens.undistort(pixel, np.eye(2))
    assert np.allclose(lens.distort(flat[None])[0], pixel, atol=1e-6)
    assert 0.8 < np.sqrt(np.linalg.det(spread)) < 1.4


def test_odometry_says_where_a_beacon_goes_in_the_picture():
    track, calibration, lens = OdometryTrack(), SECOND.calibration(), Lens(SECOND.model)
    truth = lambda t: np.array([0.2 + 0.15 * t, 0.1 + 0.05 * t, 0.3 + 0.2 * t])  # noqa: E731
    axes = np.array([5.0, -2.0, 1.0])  # odometry's own
    for t in np.arange(0.0, 3.0, 0.015):
        x, y, heading = se2_relative(axes, truth(t))
        track.add(OdometryState(t, Pose(x, y, heading), 0.0))
    start = SECOND.see(beacons_at(truth(1.0))["front"][None])[0]
    assert track.places(calibration, lens, BEACONS["front"], np.array([1.2]), start, 1.0) is None, "not placed yet"
    track.place(Pose(*truth(1.0)), 1.0)
    t = np.array([0.5, 1.0, 2.0, 2.9])
    wanted = np.array([SECOND.see(beacons_at(truth(at))["front"][None])[0] for at in t])
    found = track.places(calibration, lens, BEACONS["front"], t, start, 1.0)
    assert np.abs(found - wanted).max() < 0.1
    assert track.places(calibration, lens, BEACONS["front"], np.array([9.0]), start, 1.0) is None


# ---- dwells ----------------------------------------------------------------------------------------------------------


def a_fix(until, u=100.0, v=50.0, still_since=0.0, sigma=0.1):
    spread = ((sigma**2 + 0.0025, 0.0), (0.0, sigma**2 + 0.0025))
    return BeaconFix("front", until - 0.4, until, u, v, spread, (0.0, 0.0), still_since, 0.99, 30.0, False, 12)


def test_a_dwell_lasts_from_when_the_beacon_stood_until_it_moved():
    builder = DwellBuilder("roof-1", "front", "abc")
    lines = []
    for k in range(60):
        lines += builder.add(a_fix(1.0 + 0.25 * k), T0 + 1.0 + 0.25 * k)
    lines += builder.add(a_fix(16.2, u=130.0, still_since=None), T0 + 16.2)
    assert [line.is_open for line in lines] == [True, True, True, False]
    last = lines[-1]
    assert (last.begin, last.end) == (T0, T0 + 15.75)
    assert (last.u, last.v) == pytest.approx((100.0, 50.0))
    assert last.fixes == 3
    assert 0.0025 < last.uu < 0.0025 + 0.1**2, "more fixes are surer, but never surer than compression allows"
    assert builder.close() == []


def test_a_short_halt_is_no_dwell_and_silence_ends_one():
    builder = DwellBuilder("roof-1", "front", "abc")
    assert builder.add(a_fix(1.0, still_since=0.0), T0 + 1.0) == []
    assert builder.idle(T0 + 9.0) == []
    for k in range(12):
        builder.add(a_fix(20.0 + 0.25 * k, still_since=19.0), T0 + 20.0 + 0.25 * k)
    assert builder.idle(T0 + 23.0) == []
    (line,) = builder.idle(T0 + 30.0)
    assert not line.is_open
    assert line.end == T0 + 22.75


def test_a_beacon_that_stands_elsewhere_is_another_dwell():
    builder = DwellBuilder("roof-1", "front", "abc")
    for k in range(12):
        builder.add(a_fix(3.0 + 0.25 * k), T0 + 3.0 + 0.25 * k)
    lines = builder.add(a_fix(9.0, u=103.0, still_since=7.0), T0 + 9.0)
    assert next(line.is_open for line in lines) is False


def test_the_log_keeps_the_last_line_of_each_dwell_and_outlives_a_power_cut(tmp_path):
    log = RoofLog(tmp_path)
    dwell = Dwell("roof 1/ä", "front", 1.0, 4.0, 10.0, 20.0, 0.01, 0.0, 0.01, 1, "abc", True)
    log.add([dwell])
    path = next((tmp_path / "roof" / "dwells").iterdir())
    with path.open("ab") as file:
        file.write(b'{"camera":"roof')  # the power went
    closed = Dwell("roof 1/ä", "front", 1.0, 9.0, 10.5, 20.0, 0.01, 0.0, 0.01, 2, "abc", False)
    other = Dwell("roof 1/ä", "front", 12.0, 19.0, 90.0, 20.0, 0.01, 0.0, 0.01, 2, "abc", False)
    log.add([closed, other])
    assert RoofLog(tmp_path).dwells() == [closed, other]
    log.keep(FIRST.calibration())
    assert log.calibrations() == {FIRST.calibration().digest: FIRST.calibration()}


# ---- joining ---------------------------------------------------------------------------------------------------------

STANDS = np.array([[0.0, 0.0, 0.0], [0.6, 0.1, 0.6], [0.9, 0.7, 1.6], [0.4, 1.0, 2.8], [-0.1, 0.6, -2.0]])
TAUGHT = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-3))


def a_mission(views=(FIRST, SECOND), *, clock=0.0, offset=(0.0, 0.0), every=40.0, seed=1):
    """Stops and dwells of a robot that stood at STANDS; its clock is off, and the second camera by pixels."""
    rng = np.random.default_rng(seed)
    stops, dwells = [], []
    gaps = rng.uniform(0.0, 15.0, len(STANDS))
    for k, pose in enumerate(STANDS):
        begin = T0 + every * k + float(gaps[: k + 1].sum())
        end = begin + 30.0
        date = datetime.fromtimestamp(end + clock - 0.4, UTC).isoformat()
        move = None
        if k:
            dx, dy, turn = se2_relative(STANDS[k - 1], pose) + rng.normal(0.0, 0.005, 3)
            move = Move(float(dx), float(dy), float(turn), TAUGHT)
        stops.append(Stop(1, k + 1, date, Pose(*map(float, pose)), move))
        for view in views:
            digest = view.calibration().digest
            for name, point in beacons_at(pose).items():
                u, v = view.see(point[None])[0] + rng.normal(0.0, 0.05, 2)
                if view is SECOND:
                    u, v = u + offset[0], v + offset[1]
                cut = float(rng.uniform(0.0, 3.0))
                is_last = k == len(STANDS) - 1
                dwells.append(
                    Dwell(
                        view.model.name,
                        name,
                        begin + cut,
                        end,
                        float(u),
                        float(v),
                        0.0025,
                        0.0,
                        0.0025,
                        6,
                        digest,
                        is_last,
                    )
                )
    return stops, dwells, {view.calibration().digest: view.calibration(1e-7) for view in views}


def test_each_stop_gets_what_the_cameras_saw_while_it_was_made():
    stops, dwells, calibrations = a_mission()
    joined = join(stops, dwells, calibrations, BEACONS)
    assert joined.offset_s == 0.0
    assert joined.notes == ()
    assert [camera.name for camera in joined.cameras] == ["roof-1", "roof-2"]
    assert all(len(joined.sightings[1, k]) == 4 for k in range(1, 6))
    for k, pose in enumerate(STANDS):
        found = joined.poses[1, k + 1].pose
        assert (found.x, found.y) == pytest.approx(tuple(pose[:2]), abs=0.003)
    assert all(0.04 < s.sigma_px < 0.2 for group in joined.sightings.values() for s in group)


@pytest.mark.parametrize("clock", [-3.0e8, -700.0, 95.0])
def test_a_robot_whose_clock_is_wrong_is_matched_by_its_order_and_distances(clock):
    stops, dwells, calibrations = a_mission(clock=clock)
    joined = join(stops, dwells, calibrations, BEACONS)
    assert joined.offset_s == pytest.approx(-clock, abs=3.0)
    assert len(joined.sightings) == 5
    assert "clock was" in joined.notes[0]
    for k, pose in enumerate(STANDS):
        assert joined.poses[1, k + 1].pose.x == pytest.approx(float(pose[0]), abs=0.003)


def test_nothing_is_joined_where_nothing_fits():
    stops, dwells, calibrations = a_mission()
    elsewhere = list(stops[:2])
    late = [
        Stop(1, stop.stop, datetime.fromtimestamp(T0 + 9e5, UTC).isoformat(), stop.odometry, stop.move)
        for stop in elsewhere
    ]
    joined = join(late, dwells, calibrations, BEACONS)
    assert not joined.sightings
    assert "no stop falls into a time" in joined.notes[0]
    assert join(stops, [], calibrations, BEACONS).notes == ()
    assert join([], dwells, calibrations, BEACONS).sightings == {}


def test_a_camera_that_was_moved_is_told_by_the_other_one():
    stops, dwells, calibrations = a_mission(offset=(4.0, 2.0))
    (note,) = join(stops, dwells, calibrations, BEACONS).notes
    assert "roof-1 and roof-2 disagree about the robot by" in note
    assert "calibrate it again" in note


def test_the_joined_survey_is_valid_solvable_and_absolute():
    stops, dwells, calibrations = a_mission()
    camera = CameraModel("front", (640, 480), (268.0, 268.0, 319.5, 239.5), Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.5)))
    wrong = [Stop(stop.leg, stop.stop, stop.time, Pose(stop.odometry.x + 3.0, 0.0, 1.0), stop.move) for stop in stops]
    survey = Survey("s", Rig((camera,), BEACONS), tuple(wrong))
    merged = with_roof(survey, join(stops, dwells, calibrations, BEACONS))
    again = survey_from_json(survey_to_json(merged), "merged")
    assert again == merged
    solved = solve(again)
    assert solved.frame == "roof cameras"
    for stop, pose in zip(solved.stops, STANDS, strict=True):
        assert (stop.x, stop.y) == pytest.approx(tuple(pose[:2]), abs=0.005)


def test_the_server_adds_the_roof_cameras_to_surveys_and_says_what_is_wrong(tmp_path):
    stops, dwells, calibrations = a_mission(offset=(4.0, 2.0))
    camera = CameraModel("front", (640, 480), (268.0, 268.0, 319.5, 239.5), Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.5)))
    store = Store(tmp_path)
    store.put_header("s", survey_to_json(Survey("s", Rig((camera,), BEACONS), ())))
    for stop in stops:
        store.put_stop("s", 1, stop.stop, stop_to_json(stop))
    plain, revision = store.survey("s")
    assert b"roof-1" not in plain
    assert store.notes("s") == ()
    log = RoofLog(tmp_path)
    for calibration in calibrations.values():
        log.keep(calibration)
    log.add(dwells)
    merged, other = store.survey("s")
    assert other != revision, "the map must be made anew"
    survey = survey_from_json(merged, "merged")
    assert len(survey.roof_cameras) == 2
    assert all(len(stop.beacon_sightings) == 4 for stop in survey.stops)
    assert "disagree" in store.notes("s")[0]
    assert store.roof_status() == b"{}"


# ---- the alarm -------------------------------------------------------------------------------------------------------


def a_shop(seed=1):
    rng = np.random.default_rng(seed)
    image = cv2.resize(rng.random((48, 64)), (640, 480), interpolation=cv2.INTER_CUBIC) * 120 + 60
    for _ in range(60):
        u, v, w, h = rng.integers(0, 600), rng.integers(0, 440), rng.integers(8, 60), rng.integers(8, 60)
        cv2.rectangle(image, (int(u), int(v)), (int(u + w), int(v + h)), float(rng.uniform(20, 230)), -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def taken(shop, seed, turn=0.0, shift=(0.0, 0.0), light=1.0):
    rng = np.random.default_rng(seed)
    matrix = cv2.getRotationMatrix2D((320.0, 240.0), np.degrees(turn), 1.0)
    matrix[:, 2] += shift
    image = cv2.warpAffine(shop, matrix, (640, 480), borderMode=cv2.BORDER_REPLICATE)
    return np.clip(light * image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, "still"),
        ({"light": 0.6}, "still"),
        ({"shift": (0.4, -0.3)}, "still"),
        ({"shift": (2.0, 1.0)}, "moved"),
        ({"shift": (-15.0, 6.0)}, "moved"),
        ({"turn": 0.01}, "moved"),
        ({"light": 0.0}, "unknown"),
    ],
)
def test_a_camera_that_was_pushed_is_told_from_one_that_was_not(change, verdict):
    for seed in (1, 2, 3):
        shop = a_shop(seed)
        checked = check_scene(taken(shop, 1), taken(shop, 2, **change))
        assert checked.verdict == verdict, checked


def test_things_that_were_moved_in_the_shop_are_no_motion_of_the_camera():
    shop = a_shop(4)
    changed = shop.copy()
    changed[300:460, 40:260] = np.roll(shop[300:460, 40:260], 25, axis=1)
    assert check_scene(taken(shop, 1), taken(changed, 2)).verdict == "still"


def test_people_are_not_in_the_median_of_some_pictures():
    shop = a_shop(5)
    frames = []
    for k in range(7):
        frame = taken(shop, k)
        cv2.ellipse(frame, (60 + 85 * k, 260), (30, 110), 0, 0, 360, 30, -1)
        frames.append(frame)
    assert check_scene(taken(shop, 9), median_picture(frames)).verdict == "still"
    assert np.abs(median_picture(frames).astype(int) - shop).mean() < 3.0


# ---- files -----------------------------------------------------------------------------------------------------------


def test_roof_toml_is_read_and_every_mistake_is_named(tmp_path):
    path = tmp_path / "roof.toml"
    path.write_text(
        '[roof]\ndata = "data"\n[detector]\njitter_s = 0.006\n'
        '[drivers.roof-1]\ndriver = "mjpeg"\nurl = "http://127.0.0.1/x"\n'
    )
    setup = load_setup(path)
    assert setup.roof.data == tmp_path / "data"
    assert setup.roof.spacing == pytest.approx(0.2)
    path.write_text("[roof]\nbeacons = { front = [0.0, 0.0, 0.6] }\nfronts = 1\n[detector]\ngamma = 9\n")
    with pytest.raises(ConfigError) as caught:
        load_setup(path)
    assert len(caught.value.problems) == 2, caught.value.problems
    path.write_text("")
    with pytest.raises(ConfigError, match="there is no roof camera"):
        load_setup(path)


def test_a_watch_refuses_cameras_without_calibration_and_what_is_no_camera(tmp_path):
    from robotd.roof.setup import RoofSetup
    from robotd.roof_watch import RoofWatch

    with pytest.raises(ConfigError, match=r"has no camera 'roof-1'; run robotd-solver calibrate roof"):
        RoofWatch(
            tmp_path / "roof.toml",
            RoofSetup(drivers={"roof-1": {"driver": "mjpeg", "url": "http://127.0.0.1/x"}}),
            {},
            None,
        )
    pins = {"driver": "gpio_beacons", "front_pin": 1, "rear_pin": 2}
    with pytest.raises(ConfigError, match="is of kind 'beacons'; expected a camera"):
        RoofWatch(tmp_path / "roof.toml", RoofSetup(drivers={"roof-1": pins}), {}, None)


def test_the_example_has_every_key_with_its_default():
    import re
    import tomllib
    from dataclasses import fields
    from pathlib import Path

    from robotd.roof.setup import RoofSettings
    from robotd.vision.beacon import BeaconConfig

    path = Path(__file__).parent.parent / "etc" / "roof.toml"
    load_setup(path)
    text = path.read_text().split("\n[drivers.", 1)[0]
    shown = tomllib.loads(re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE))
    for section, cls in (("roof", RoofSettings), ("detector", BeaconConfig)):
        assert shown[section].keys() == {field.name for field in fields(cls)}
    assert shown["detector"] == {field.name: field.default for field in fields(BeaconConfig)}
    assert shown["roof"]["guard_s"] == RoofSettings().guard_s
