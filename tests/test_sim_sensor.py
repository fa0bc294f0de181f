import functools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.geometry.transforms import pose_matrix
from robotd.records import CameraModel, Transform
from robotd.sim import sensor
from robotd.sim.camera import undistorted_grid
from robotd.sim.scene import Scene
from robotd.sim.stores import LabelLayout, Lamp, LineLayout, Mirror, Shelf, StoreLayout, Walker, Wall

kernel = pytest.importorskip("robotd.sim._sensor")

# camera axes in a store whose x axis the camera looks along, 0.5 m above the floor
T_STORE_CAMERA = pose_matrix(1.0, 2.0, 0.0, 0.004, -0.006) @ np.array(
    [[0.0, 0.0, 1.0, 0.06], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
)


def grid(width, height):
    focal = 268.5 * width / 640
    matrix = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    level = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    return undistorted_grid(
        CameraModel("front", (width, height), matrix, level, distortion=(-0.06, 0.012, 0.0002, 0.0002, -0.001))
    )


@functools.cache
def busy():
    corners = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)]
    layout = StoreLayout(
        format="robotd-store/1",
        name="busy",
        size=(4.0, 4.0),
        line=LineLayout(points=((1.0, 2.0), (3.0, 2.0)), stops=(0.0, 1.0)),
        walls=tuple(Wall(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)),
        labels=(
            LabelLayout("A", (3.5, 2.6, 0.9), (-1.0, 0.0, 0.0)),
            LabelLayout("B", (2.4, 1.7, 0.4), (-1.0, 0.0, 0.0)),
        ),
        shelves=(Shelf((2.8, 0.4, 3.4, 1.6), 1.1),),
        mirrors=(Mirror((3.9, 1.7), (3.9, 3.5), 0.2, 1.4, 0.8),),
        lamps=(Lamp((2.0, 2.0, 2.3), flicker=0.2),),
        walkers=(Walker(((2.2, 1.0), (2.2, 3.0))), Walker(((3.0, 2.4), (2.4, 2.0)), speed=0.7)),
        disturbances=False,
    )
    return Scene(layout, 1, finest=0.02)


def test_ray_casting_agrees_with_numpy():
    world = busy()
    args = (world.quads, world.textures, world.texels, world.unit, world.empty, T_STORE_CAMERA, grid(96, 72))
    pictures = [np.empty((2, 72, 96), np.float32) for _ in range(2)]
    kernel.trace(*args, *pictures[0])
    sensor.trace(*args, *pictures[1])
    same = np.abs(pictures[0] - pictures[1]) < 1e-4
    assert same.mean() > 0.999  # a ray that grazes an edge may round to either side


def test_visibility_agrees_with_numpy():
    world, rng = busy(), np.random.default_rng(3)
    origins, targets = rng.uniform(0.01, 2.2, (2, 400, 3)) * (1.8, 1.8, 1.0)
    found = np.empty((2, 400), np.uint8)
    kernel.visible(world.quads, origins, targets, found[0])
    sensor.visible(world.quads, origins, targets, found[1])
    assert 0.05 < found[0].mean() < 0.95
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.parametrize("t", [0.3, 0.9, 2.7])
def test_painting_walkers_agrees_with_numpy(t):
    world = busy()
    rays = grid(320, 240)
    depth = np.full((240, 320), 1.9, np.float32)
    depth[:, :150] = 1.3
    people, crowd = world.people(t), world.crowd
    results = []
    for module in (kernel, sensor):
        linear, boxes = np.full((240, 320), 0.1, np.float32), np.zeros((600, 4), np.int32)
        used = module.paint_walkers(
            linear,
            depth,
            sensor.reach(depth),
            rays,
            T_STORE_CAMERA,
            people,
            crowd.sprites,
            crowd.levels,
            crowd.cover,
            6e-5,
            boxes,
        )
        results.append((linear, boxes[:used]))
    assert len(results[0][1]) > 10
    np.testing.assert_allclose(results[0][0], results[1][0], atol=2e-3)
    inside = np.zeros((240, 320), bool)
    for r0, r1, c0, c1 in results[0][1]:
        inside[r0:r1, c0:c1] = True
    assert not ((results[0][0] != np.float32(0.1)) & ~inside).any()


@pytest.mark.parametrize("t", [0.3, 0.9, 2.7])
def test_what_painting_skips_would_have_changed_nothing(t):
    world = busy()
    rays = grid(320, 240)
    depth = np.random.default_rng(1).uniform(1.0, 2.0, (15, 20)).repeat(16, 0).repeat(16, 1).astype(np.float32)
    depth[:, ::7] = 1.2
    people, crowd = world.people(t), world.crowd
    anywhere = np.broadcast_to(np.array([0.0, np.inf], np.float32), (15, 20, 2)).copy()
    results = []
    for cover, reach in ((crowd.cover, sensor.reach(depth)), (np.full_like(crowd.cover, 255), anywhere)):
        linear, boxes = np.full((240, 320), 0.1, np.float32), np.zeros((600, 4), np.int32)
        used = kernel.paint_walkers(
            linear, depth, reach, rays, T_STORE_CAMERA, people, crowd.sprites, crowd.levels, cover, 6e-5, boxes
        )
        results.append((linear, boxes[:used]))
    for found, expected in zip(*results, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_light_past_walkers_agrees_with_numpy():
    world, rng = busy(), np.random.default_rng(5)
    people, crowd = world.people(0.9), world.crowd
    origins = np.tile([1.0, 2.0, 0.5], (300, 1))
    targets = np.column_stack([np.full(300, 3.8), rng.uniform(1.0, 3.0, 300), rng.uniform(0.2, 1.8, 300)])
    spots = np.arange(300)[::-1] // 2  # two legs each
    passed = np.ones((2, 2, 150))
    for module, out in zip((kernel, sensor), passed, strict=True):
        module.transmission(origins, targets, np.zeros(300), spots, people, crowd.sprites, crowd.levels, out)
    assert passed[0].min() < 0.05 < 0.95 < passed[0].max()
    np.testing.assert_allclose(passed[0], passed[1], atol=1e-3)


@given(st.integers(0, 2**64 - 1), st.booleans())
@settings(max_examples=15, deadline=None)
def test_exposing_agrees_with_numpy(seed, banded):
    rng = np.random.default_rng(seed)
    level = rng.integers(0, 19000, (40, 70)).astype(np.int16)
    sigma = rng.integers(0, 255, (40, 70)).astype(np.uint8)
    gain = rng.integers(10000, 22000, 40).astype(np.int32) if banded else np.full(40, sensor.UNITY, np.int32)
    bank = rng.integers(-127, 128, 4096 + 128).astype(np.int8)
    out = np.empty((2, 40, 70), np.uint8)
    kernel.expose(level, sigma, gain, bank, 4095, seed, out[0])
    sensor.expose(level, sigma, gain, bank, 4095, seed, out[1])
    np.testing.assert_array_equal(out[0], out[1])


@given(st.integers(0, 2**64 - 1))
@settings(max_examples=15, deadline=None)
def test_retouching_with_lights_agrees_with_numpy(seed):
    rng = np.random.default_rng(seed)
    still = rng.uniform(0.0, 1.0, (60, 80)).astype(np.float32)
    starts = rng.integers(0, (45, 65), (6, 2))
    boxes = np.column_stack([starts[:, 0], starts[:, 0] + 13, starts[:, 1], starts[:, 1] + 13]).astype(np.int32)
    across, down = rng.uniform(0.0, 1.0, (2, 6, 32)).astype(np.float32)
    strength = rng.uniform(0.0, 0.5, (2, 6))
    strength[:, 2] = 0.0
    gain = rng.uniform(0.7, 1.3, 60).astype(np.float32)
    code_of = 256 * np.arange(16384, dtype=np.int32) + 64
    bank = rng.integers(-127, 128, 4096 + 128).astype(np.int8)
    results = []
    for module in (kernel, sensor):
        linear, out = still.copy(), np.zeros((60, 80), np.uint8)
        changed = np.zeros_like(boxes)
        assert module.add_lights(linear, boxes, across, down, strength, gain, changed) == 5
        np.testing.assert_array_equal(changed[:5], np.delete(boxes, 2, axis=0))
        lit = linear.copy()
        module.retouch(linear, still, boxes, code_of, 9000.0, gain, bank, 4095, seed, out)
        np.testing.assert_array_equal(linear, still)
        results.append((lit, out))
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=1e-6)
    assert np.abs(results[0][1].astype(int) - results[1][1]).max() <= 1


@given(st.integers(0, 2**64 - 1))
@settings(max_examples=15, deadline=None)
def test_strength_of_lights_agrees_with_numpy(seed):
    rng = np.random.default_rng(seed)
    pick = rng.integers(-1, 40, (2, 30))
    blink = np.column_stack([rng.choice([0.0, 0.7, 5.0], 30), rng.uniform(0.0, 1.0, 30)])
    args = rng.uniform(0.0, 1.0, 40), pick, blink, rng.uniform(0.0, 480.0, (30, 2)), rng.uniform(0.0, 2.0, 30)
    out, t = np.empty((2, 2, 30)), rng.uniform(0.0, 60.0)
    for module, strength in zip((kernel, sensor), out, strict=True):
        module.shine(*args, t, 0.01, 6e-5, strength)
    np.testing.assert_allclose(out[0], out[1], atol=1e-9)
