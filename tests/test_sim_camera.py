import dataclasses
import functools
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.geometry.transforms import pose_matrix, transform_record
from robotd.records import CameraModel
from robotd.sim import sensor
from robotd.sim.camera import RigRenderer, SensorSettings, distort, undistorted_grid
from robotd.sim.scene import NOISE_BANK, Scene
from robotd.sim.sensor import on_share
from robotd.sim.stores import (
    Blinker,
    Floor,
    LabelLayout,
    Lamp,
    LineLayout,
    Mirror,
    Shelf,
    StoreLayout,
    Walker,
    Wall,
)
from robotd.sim.walker import along_path

LENS = (-0.06, 0.012, 0.0002, 0.0002, -0.001)
QUIET = SensorSettings(read_noise=0.0, shot_noise=0.0)
SIDE = 4.0
POSE = pose_matrix(1.0, 2.0, 0.0, 0.004, -0.006)
T0 = 3.2
FLOOR = []


def camera_model(heading=0.0, size=(640, 480), lens=LENS, model="brown-conrady"):
    T = pose_matrix(0.06 * math.cos(heading), 0.06 * math.sin(heading), heading)
    T[2, 3] = 0.5
    T[:3, :3] = T[:3, :3] @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    focal = 268.5 * size[0] / 640
    matrix = (focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return CameraModel("front", size, matrix, transform_record(T), model, lens)


def layout(**parts):
    corners = [(0.0, 0.0), (SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE)]
    walls = tuple(Wall(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
    defaults = {
        "format": "robotd-store/1",
        "name": "test",
        "size": (SIDE, SIDE),
        "line": LineLayout(points=((1.0, 2.0), (3.0, 2.0)), stops=(0.0, 1.0)),
        "floor": FLOOR[0],
        "walls": walls,
        "disturbances": False,
    }
    return StoreLayout(**(defaults | parts))


def label(x, y, z, normal=(-1.0, 0.0, 0.0), name="A"):
    return LabelLayout(name, (x, y, z), normal)


def on(t0, t1):
    return np.ones(t0.shape)


def off(t0, t1):
    return np.zeros(t0.shape)


@functools.cache
def scene(**parts):
    return Scene(layout(**parts), 1, finest=0.02)


def renderer(world, setup=QUIET, **camera):
    return RigRenderer(world, camera_model(**camera), setup, 7)


@pytest.fixture(scope="module", autouse=True)
def floor_image(tmp_path_factory):
    """A small floor, because drawing carpet takes longer than all tests."""
    path = tmp_path_factory.mktemp("floor") / "floor.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(90, 130, (32, 32)).astype(np.uint8))
    FLOOR.append(Floor(image=path, metres_per_pixel=0.02))
    yield
    FLOOR.clear()
    scene.cache_clear()


def light(image):
    """Linear radiance of grey levels."""
    return (image.astype(np.float64) / 255.0) ** 2.2


def difference(camera, T=POSE, t=T0, exposure=0.010, lit=on):
    """What the labels add, in linear light."""
    return light(camera.render(T, t, exposure, lit, 1)) - light(camera.render(T, t, exposure, off, 1))


def centroid(picture, around, radius=6):
    """Centre of the light within `radius` px of (u, v), weighed as a Gaussian fit would weigh it."""
    u0, v0 = (round(float(x)) for x in around)
    rows, columns = np.mgrid[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1]
    values = picture[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1]
    centre = np.array([u0, v0], float)
    for _ in range(30):
        weight = values * np.exp(-0.5 * ((columns - centre[0]) ** 2 + (rows - centre[1]) ** 2) / 1.2**2)
        found = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        centre += 2.0 * (found - centre)  # the product of two equal Gaussians lies half way between them
    return centre


def projected(model, T, point):
    """u, v by OpenCV's own projection."""
    T_camera_store = np.linalg.inv(T @ matrix_of(model))
    k = np.array([[model.matrix[0], 0.0, model.matrix[2]], [0.0, model.matrix[1], model.matrix[3]], [0.0, 0.0, 1.0]])
    rotation, _ = cv2.Rodrigues(T_camera_store[:3, :3])
    uv, _ = cv2.projectPoints(
        np.array([point], dtype=float), rotation, T_camera_store[:3, 3], k, np.array(model.distortion)
    )
    return uv.reshape(2)


def matrix_of(model):
    T = np.eye(4)
    T[:3, :3], _ = cv2.Rodrigues(np.array(model.T_robot_camera.rotation))
    T[:3, 3] = model.T_robot_camera.translation
    return T


# ---- geometry --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "place", [(2.6, 2.3, 0.8), (2.2, 1.1, 0.3), (2.4, 2.9, 1.0), (3.0, 2.0, 0.55), (2.1, 1.3, 1.05)]
)
def test_led_centroid_is_where_opencv_projects_the_label(place):
    world = scene(labels=(dataclasses.replace(label(*place), brightness=1.3),))
    model = camera_model()
    expected = projected(model, POSE, place)
    found = centroid(difference(renderer(world)), expected)
    assert np.abs(found - expected).max() < 0.02


def test_brown_conrady_grid_inverts_the_lens_model():
    model = camera_model()
    grid = undistorted_grid(model).reshape(-1, 2).astype(np.float64)
    u, v = np.meshgrid(np.arange(641) - 0.5, np.arange(481) - 0.5)
    fx, fy, cx, cy = model.matrix
    back = distort(model, grid) * (fx, fy) + (cx, cy)
    assert np.abs(back - np.column_stack([u.ravel(), v.ravel()])).max() < 1e-4  # float32


def test_fisheye_grid_agrees_with_opencv():
    model = camera_model(size=(160, 120), lens=(0.02, -0.01, 0.003, 0.0), model="fisheye")
    grid = undistorted_grid(model).astype(np.float64)
    fx, fy, cx, cy = model.matrix
    k = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    pixels = np.array([[[10.5, 20.5]], [[79.5, 59.5]], [[150.5, 110.5]]])
    expected = cv2.fisheye.undistortPoints(pixels, k, np.array(model.distortion)).reshape(-1, 2)
    found = grid[[21, 60, 111], [11, 80, 151]]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_lens_that_folds_inside_the_image_is_refused():
    with pytest.raises(ValueError, match="folds over"):
        undistorted_grid(camera_model(lens=(-0.5, 0.0, 0.0, 0.0, 0.0)))


def test_edge_of_a_shelf_appears_where_opencv_projects_it():
    world = scene(shelves=(Shelf((2.5, 1.6, 3.0, 2.4), 0.9),))
    camera = renderer(world, size=(640, 480))
    camera.render(POSE, T0, 0.010, off, 1)
    model = camera_model()
    u, v = projected(model, POSE, (2.5, 2.4, 0.5))
    row = camera._depth[round(v)]
    assert row[math.floor(u) - 1] > 2.0
    assert row[math.ceil(u) + 1] == pytest.approx(1.44, abs=0.02)


def test_background_follows_the_robot():
    camera = renderer(scene())
    first = camera.render(POSE, T0, 0.010, off, 1)
    moved = camera.render(pose_matrix(1.1, 2.0, 0.3), T0, 0.010, off, 1)
    assert (first != moved).mean() > 0.3
    np.testing.assert_array_equal(camera.render(POSE, T0, 0.010, off, 1), first)


# ---- labels ----------------------------------------------------------------------------------------------------------


def test_shelf_hides_a_label_and_its_absence_shows_it():
    hidden = (label(3.5, 2.0, 0.5),)
    assert difference(renderer(scene(labels=hidden))).max() > 0.02
    behind = scene(labels=hidden, shelves=(Shelf((2.0, 1.5, 2.3, 2.5), 1.0),))
    assert np.abs(difference(renderer(behind))).max() == 0.0


@pytest.mark.parametrize(
    ("degrees", "seen"), [(0, True), (60, True), (72, True), (80, False), (120, False), (180, False)]
)
def test_label_is_seen_from_the_front_only_up_to_about_75_degrees(degrees, seen):
    angle = math.pi + math.radians(degrees)
    at = (3.0, 2.0, 0.5)
    view = math.atan2(0.0, 3.0 - 1.06)
    normal = (math.cos(angle + view), math.sin(angle + view), 0.0)
    assert (difference(renderer(scene(labels=(label(*at, normal=normal),)))).max() > 0.001) == seen


def test_brightness_falls_with_the_square_of_the_distance():
    sums = []
    for x in (2.06, 3.06):
        world = scene(labels=(dataclasses.replace(label(x, 2.0, 0.5), brightness=0.5),))
        sums.append(difference(renderer(world), pose_matrix(1.0, 2.0, 0.0)).sum())
    assert sums[0] / sums[1] == pytest.approx(4.0, rel=0.03)


def test_near_labels_are_strong_far_ones_weak_and_some_clip():
    peaks = {}
    for distance in (0.6, 0.9, 3.5):
        world = Scene(layout(size=(6.0, 4.0), walls=(), labels=(label(1.06 + distance, 2.0, 0.55),)), 1, finest=0.02)
        camera = renderer(world)
        image = camera.render(POSE, T0, 0.010, on, 1)
        peaks[distance] = int((image.astype(int) - camera.render(POSE, T0, 0.010, off, 1)).max()), int(image.max())
    assert peaks[0.6][1] == 255
    assert 100 <= peaks[0.9][0] <= 240
    assert 10 <= peaks[3.5][0] <= 60


def test_each_row_shows_the_share_of_its_own_exposure():
    upper, lower = label(2.6, 2.0, 1.1, name="upper"), label(2.6, 2.0, 0.2, name="lower")
    world = scene(labels=(upper, lower))
    camera = renderer(world)
    row_time = camera.settings.readout / 480
    rows = [projected(camera.camera, POSE, item.position)[1] for item in (upper, lower)]
    switch = T0 + 0.015  # lights up while the upper rows are exposed

    def lit(t0, t1):
        return np.clip((t1 - switch) / (t1 - t0), 0.0, 1.0)

    full, part = difference(camera), difference(camera, lit=lit)
    shares = []
    for row in rows:
        area = slice(round(row) - 2, round(row) + 3)
        begin = T0 + row_time * row
        expected = np.clip((begin + 0.010 - switch) / 0.010, 0.0, 1.0)
        shares.append(expected)
        assert part[area].sum() / full[area].sum() == pytest.approx(expected, abs=0.03)
    assert 0.0 < shares[0] < 0.5 < shares[1]


def test_exposure_scales_the_light_of_a_label():
    world = scene(labels=(dataclasses.replace(label(2.9, 2.0, 0.55), brightness=0.3),))
    camera = renderer(world)
    assert difference(camera, exposure=0.020).sum() / difference(camera).sum() == pytest.approx(2.0, rel=0.02)


def test_blinker_blinks_at_its_frequency():
    world = scene(blinkers=(Blinker((2.5, 2.2, 0.6), frequency=2.0, duty=0.5),))
    camera = renderer(world)
    u, v = (round(float(x)) for x in projected(camera.camera, POSE, (2.5, 2.2, 0.6)))
    bright = [int(camera.render(POSE, 0.02 + 0.1 * k, 0.010, off, 1)[v, u]) for k in range(10)]
    assert max(bright) - min(bright) > 40
    assert [level == max(bright) for level in bright] == [True, True, True, False, False] * 2


@given(st.floats(0.0, 5.0), st.floats(0.001, 2.0), st.floats(0.5, 20.0), st.floats(0.0, 1.0))
@settings(max_examples=50, deadline=None)
def test_share_of_a_blinker_is_the_mean_of_its_square_wave(t0, length, frequency, duty):
    t = t0 + (np.arange(20000) + 0.5) / 20000 * length
    expected = ((t * frequency) % 1.0 < duty).mean()
    args = (np.array([value]) for value in (t0, t0 + length, frequency, duty))
    assert on_share(*args)[0] == pytest.approx(expected, abs=0.01)


# ---- reflections -----------------------------------------------------------------------------------------------------


def test_mirror_shows_the_label_at_its_mirrored_point():
    item = dataclasses.replace(label(1.5, 3.0, 0.7, normal=(1.0, 0.0, 0.0)), brightness=4.0)
    world = scene(labels=(item,), mirrors=(Mirror((3.9, 1.5), (3.9, 3.5), 0.2, 1.4, 0.9),))
    expected = projected(camera_model(), POSE, (2 * (3.9 - 0.003) - 1.5, 3.0, 0.7))
    picture = difference(renderer(world))
    v, u = np.unravel_index(picture.argmax(), picture.shape)
    assert math.hypot(u - expected[0], v - expected[1]) < 1.0
    assert np.abs(centroid(picture, expected) - expected).max() < 0.05


def test_mirror_shows_nothing_outside_its_extent():
    item = label(1.5, 3.0, 0.7, normal=(1.0, 0.0, 0.0))
    world = scene(labels=(item,), mirrors=(Mirror((3.9, 1.5), (3.9, 2.2), 0.2, 1.4, 0.9),))
    assert np.abs(difference(renderer(world))).max() == 0.0


def test_reflection_is_weaker_by_the_reflectivity():
    item = label(1.5, 3.0, 0.7, normal=(1.0, 0.0, 0.0))
    sums = []
    for reflectivity in (0.4, 0.8):
        bright = dataclasses.replace(item, brightness=6.0)
        world = scene(labels=(bright,), mirrors=(Mirror((3.9, 1.5), (3.9, 3.5), 0.2, 1.4, reflectivity),))
        sums.append(difference(renderer(world)).sum())
    assert sums[1] / sums[0] == pytest.approx(2.0, rel=0.05)


def test_default_disturbances_hang_one_panel_per_ten_labels_that_shows_a_label():
    labels = tuple(label(3.98, 0.4 + 0.16 * k, 0.4 + 0.03 * k, name=f"L{k}") for k in range(20))
    world = Scene(layout(labels=labels, disturbances=True), 3, finest=0.02)
    panels = world.quads[world.quads[:, 14] > 0.0]
    assert len(panels) == 2
    viewers = np.array([[1.0, 2.0, 0.5], [2.0, 2.0, 0.5]])
    for panel in panels:
        _, seen = world.mirrored(viewers, np.arange(20), panel)
        assert seen.any()


# ---- people and lamps ------------------------------------------------------------------------------------------------


def test_walker_goes_to_the_end_of_the_path_and_back():
    walker = Walker(((0.0, 0.0), (2.0, 0.0), (2.0, 1.0)), speed=1.0)
    assert along_path(walker, 1.0)[:4] == pytest.approx((1.0, 0.0, 1.0, 0.0))
    assert along_path(walker, 2.5)[:4] == pytest.approx((2.0, 0.5, 0.0, 1.0))
    assert along_path(walker, 4.5)[:4] == pytest.approx((1.5, 0.0, -1.0, 0.0))
    assert along_path(walker, 6.5)[:4] == pytest.approx((0.5, 0.0, 1.0, 0.0))


def test_walker_hides_what_is_behind_and_not_what_is_before():
    far, near = label(3.5, 2.0, 0.95, name="far"), label(1.8, 2.0, 0.5, name="near")
    world = scene(labels=(far, near), walkers=(Walker(((2.6, 1.0), (2.6, 3.0)), speed=1.0),))
    camera = renderer(world)
    spots = [projected(camera.camera, POSE, item.position) for item in (far, near)]

    def sums(t):
        picture = difference(camera, t=t)
        return [picture[round(v) - 3 : round(v) + 4, round(u) - 3 : round(u) + 4].sum() for u, v in spots]

    away, between = sums(0.0), sums(0.99)
    assert away[0] > 0.05
    assert between[0] < 0.02 * away[0]
    assert between[1] == pytest.approx(away[1], rel=0.2)


def test_walker_crosses_the_picture_at_walking_speed():
    world = scene(walkers=(Walker(((2.6, 1.0), (2.6, 3.0)), speed=1.0),))
    camera = renderer(world)
    empty = renderer(scene()).render(POSE, T0, 0.010, off, 1).astype(int)
    middles = []
    for t in (0.8, 1.2):
        changed = np.abs(camera.render(POSE, t, 0.010, off, 1).astype(int) - empty) > 12
        middles.append(np.nonzero(changed)[1].mean())
    assert changed.any(axis=1).sum() > 200
    assert middles[0] - middles[1] == pytest.approx(0.4 * 268.5 / 1.54, rel=0.2)


def test_walker_stands_behind_a_nearer_shelf():
    walkers = (Walker(((3.2, 2.0), (3.2, 2.001)), speed=0.0),)
    shelves = (Shelf((2.0, 1.2, 2.4, 2.8), 2.3),)
    shown = renderer(scene(shelves=shelves, walkers=walkers)).render(POSE, T0, 0.010, off, 1)
    without = renderer(scene(shelves=shelves)).render(POSE, T0, 0.010, off, 1)
    assert np.abs(shown.astype(int) - without).max() <= 2


@pytest.mark.parametrize(("exposure", "banded"), [(0.010, False), (0.020, False), (0.013, True)])
def test_lamps_make_bands_unless_the_exposure_is_a_multiple_of_their_period(exposure, banded):
    world = scene(lamps=(Lamp((2.0, 2.0, 2.35), flicker=0.3),))
    camera = renderer(world)
    first = light(camera.render(POSE, T0, exposure, off, 1)).mean(axis=1)
    later = light(camera.render(POSE, T0 + 0.005, exposure, off, 1)).mean(axis=1)  # half a period on
    swing = np.abs(first / later - 1.0).max()
    assert (swing > 0.03) == banded
    assert banded or swing == 0.0


def test_label_in_flickering_light_keeps_its_own_brightness():
    lamps = (Lamp((2.0, 2.0, 2.35), flicker=0.3),)
    world = scene(lamps=lamps, labels=(dataclasses.replace(label(2.9, 2.0, 0.55), brightness=0.5),))
    camera = renderer(world)
    sums = [difference(camera, t=T0 + shift, exposure=0.013).sum() for shift in (0.0, 0.005)]
    assert sums[0] == pytest.approx(sums[1], rel=0.05)


# ---- noise -----------------------------------------------------------------------------------------------------------


def test_noise_is_about_two_grey_levels_and_independent_between_frames():
    camera = renderer(scene(), SensorSettings())
    frames = np.stack([camera.render(POSE, T0, 0.010, off, seed) for seed in range(6)])
    still = camera._level / sensor.DN_STEPS
    noise = frames - still
    middle = (still > 60) & (still < 180)
    assert 1.6 < noise[:, middle].std() < 2.4
    assert abs(noise.mean()) < 0.05
    flat = noise[:, middle]
    correlation = np.corrcoef(flat) - np.eye(len(flat))
    assert np.abs(correlation).max() < 0.015
    across = (noise[0][:, 1:] * noise[0][:, :-1]).mean() / noise[0].var()
    down = (noise[0][1:] * noise[0][:-1]).mean() / noise[0].var()
    assert abs(across) < 0.015
    assert abs(down) < 0.015


def test_noise_grows_with_the_light():
    settings_ = SensorSettings(read_noise=1.0, shot_noise=0.03)
    camera, quiet = renderer(scene(), settings_), renderer(scene(), QUIET)
    still = quiet.render(POSE, T0, 0.010, off, 0).astype(float)
    noise = np.stack([camera.render(POSE, T0, 0.010, off, seed) - still for seed in range(6)])
    for low, high in ((40, 60), (120, 150)):
        part = (still > low) & (still < high)
        expected = math.sqrt(1.0 + 0.03 * still[part].mean() + 1.0 / 6.0)  # both are rounded to whole grey levels
        assert noise[:, part].std() == pytest.approx(expected, rel=0.05)


def test_equal_seeds_give_equal_frames_and_others_do_not():
    parts = {"labels": (label(2.6, 2.0, 0.8),), "walkers": (Walker(((2.6, 1.0), (2.6, 3.0))),)}
    frames = [
        RigRenderer(Scene(layout(**parts), seed, finest=0.02), camera_model(), SensorSettings(), own).render(
            POSE, T0, 0.010, on, n
        )
        for seed, own, n in ((1, 7, 5), (1, 7, 5), (2, 7, 5), (1, 8, 5), (1, 7, 6))
    ]
    np.testing.assert_array_equal(frames[0], frames[1])
    for other in frames[2:]:
        assert (other != frames[0]).mean() > 0.5


def test_noise_bank_is_normal():
    bank = scene().noise[:NOISE_BANK].astype(float) / sensor.SIGMA_STEPS
    assert bank.mean() == pytest.approx(0.0, abs=0.003)
    assert bank.std() == pytest.approx(1.0, abs=0.003)
