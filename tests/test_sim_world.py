"""The simulated world is as noisy as it says, draws what cv2 projects, and gives the same pixels for the same seed."""

from __future__ import annotations

import asyncio
import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from robotd.clock import now, run_virtual
from robotd.errors import ConfigError, DriverFault
from robotd.geometry.transforms import invert_rigid, rotation_vector, transform_matrix
from robotd.hardware import CameraMode, CameraSource, Hardware, SerialLink
from robotd.records import CameraModel, Floats, Frame, Pose
from robotd.sim.body import Body
from robotd.sim.floor import FloorRenderer
from robotd.sim.hardware import CAMERAS, PORT, START, SimHardware
from robotd.sim.stores import LabelLayout, LineLayout, MeasuredLabel, Shelf, StoreLayout, Wall
from robotd.sim.world import World, WorldSettings, load_settings

TICK = 0.015
STORE = StoreLayout(
    format="robotd-store/1",
    name="test",
    size=(3.0, 2.0),
    line=LineLayout(((0.6, 0.5), (2.4, 0.5), (2.4, 1.5), (0.6, 1.5)), (0.0, 1.0), closed=True, corner_radius=0.2),
    walls=(Wall((0.0, 0.0), (3.0, 0.0), 2.0), Wall((3.0, 0.0), (3.0, 2.0), 2.0)),
    labels=(LabelLayout("A", (1.0, 0.02, 0.5), (0.0, 1.0, 0.0)), LabelLayout("B", (2.0, 0.02, 0.5), (0.0, 1.0, 0.0))),
    disturbances=False,
)
HALL = dataclasses.replace(STORE, size=(1000.0, 1000.0), walls=())
MIDDLE = Pose(500.0, 500.0, 0.3)
SETTINGS = WorldSettings()
CLEAN = dataclasses.replace(
    SETTINGS, travel_noise=0.0, slip_distance=0.0, wheel_scale_error=0.0, wheel_base_error=0.0, tilt=0.0
)


def _body(settings: WorldSettings, seed: int = 0, start: Pose = MIDDLE, layout: StoreLayout = HALL) -> Body:
    return Body(layout, settings, np.random.default_rng(seed), start)


def _drive(body: Body, left: float, right: float, seconds: float, begin: float = 0.0) -> float:
    for k in range(round(seconds / TICK)):
        body.advance(begin + (k + 1) * TICK, left, right)
    return begin + round(seconds / TICK) * TICK


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    return World(STORE, SETTINGS, 5, tmp_path_factory.mktemp("labels"))


# ---- body ------------------------------------------------------------------------------------------------------------


def test_without_noise_the_body_drives_exact_arcs() -> None:
    body = _body(CLEAN)
    _drive(body, 0.1, 0.1 + 0.235 * math.pi / 15, 15.0)  # half a circle
    radius = (0.1 + 0.235 * math.pi / 30) / (math.pi / 15)
    assert math.remainder(body.pose.heading - 0.3 - math.pi, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert math.hypot(body.pose.x - 500, body.pose.y - 500) == pytest.approx(2 * radius, rel=1e-9)
    assert body.left_rotation == pytest.approx(1.5)


def test_wheel_noise_grows_with_the_root_of_the_distance_and_is_independent_between_wheels() -> None:
    settings = dataclasses.replace(CLEAN, travel_noise=0.003)
    travel, turn = [], []
    for seed in range(300):
        body = _body(settings, seed)
        _drive(body, 0.3, 0.3, 3.0)  # 0.9 m
        travel.append(math.hypot(body.pose.x - 500, body.pose.y - 500) - 0.9)
        turn.append(body.pose.heading - 0.3)
    assert np.std(turn) == pytest.approx(0.003 * math.sqrt(2 * 0.9) / 0.235, rel=0.12)
    assert np.std(travel) == pytest.approx(0.003 * math.sqrt(0.9 / 2), rel=0.12)


def test_wheels_slip_three_centimetres_about_every_twenty_metres() -> None:
    settings = dataclasses.replace(CLEAN, slip_distance=20.0)
    turns, slips = [], 0
    for seed in range(300):
        body = _body(settings, seed)
        for k in range(18):  # a metre each
            before, heading = body.slips, body.pose.heading
            for step in range(4):
                body.advance(4.0 * k + step + 1.0, 0.25, 0.25)
            turn = abs(math.remainder(body.pose.heading - heading, 2 * math.pi))
            if body.slips == before + 1 and turn > 1e-9:
                turns.append(turn)
        slips += body.slips
    assert slips == pytest.approx(300 * 18 / 20, rel=0.2)
    assert np.median(turns) == pytest.approx(0.03 / 0.235, rel=1e-6)


def test_scale_and_base_errors_stay_the_same_and_have_the_stated_spread() -> None:
    bodies = [_body(SETTINGS, seed) for seed in range(400)]
    assert np.std([body.true_scale for body in bodies]) == pytest.approx(0.003, rel=0.12)
    assert np.std([body.true_base / 0.235 for body in bodies]) == pytest.approx(0.003, rel=0.12)


def test_a_wall_stops_the_body_presses_the_bumper_and_the_wheels_turn_on() -> None:
    layout = dataclasses.replace(STORE, shelves=(Shelf((2.0, 0.0, 2.2, 2.0), 1.0),))
    body = _body(CLEAN, 0, Pose(1.0, 1.0, 0.0), layout)
    t = _drive(body, 0.3, 0.3, 4.0)
    assert body.pose.x == pytest.approx(2.0 - 0.17, abs=0.005)
    assert (body.bump_left, body.bump_right) == (True, True)
    assert body.left_rotation == pytest.approx(1.2, abs=0.01)
    _drive(body, -0.3, -0.3, 0.5, t)
    assert body.pose.x < 1.7
    assert (body.bump_left, body.bump_right) == (False, False)


def test_the_bumper_says_on_which_side() -> None:
    for heading, expected in ((0.7, (False, True)), (-0.7, (True, False))):
        body = _body(CLEAN, 0, Pose(2.5, 1.0, heading), dataclasses.replace(STORE, size=(3.0, 9.0)))
        _drive(body, 0.3, 0.3, 3.0)
        assert (body.bump_left, body.bump_right) == expected


def test_a_lifted_robot_turns_its_wheels_and_stays() -> None:
    body = _body(CLEAN)
    body.lift()
    t = _drive(body, 0.2, 0.2, 1.0)
    assert (body.pose, body.wheel_drop_left) == (MIDDLE, True)
    assert body.left_rotation > 0.19
    body.put_down()
    _drive(body, 0.2, 0.2, 1.0, t)
    assert body.pose.x > 500.1


def test_tilt_has_the_stated_spread_and_stops_are_nearly_independent() -> None:
    tilts = []
    for seed in range(40):
        body = _body(SETTINGS, seed)
        for k in range(20):
            T = body.transform(Pose(k * 0.9, 3.0, 0.37 * k))
            tilts.append((T[2, 1], -T[2, 0]))  # roll and pitch, small
            np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
            assert math.remainder(math.atan2(T[1, 0], T[0, 0]) - 0.37 * k, 2 * math.pi) == pytest.approx(0.0, abs=2e-4)
    rows = np.array(tilts)
    np.testing.assert_allclose(rows.std(axis=0), math.radians(0.3), rtol=0.1)
    here = np.array([_body(SETTINGS, seed).transform(Pose(1.0, 1.0, 0.0))[2, 0] for seed in range(400)])
    there = np.array([_body(SETTINGS, seed).transform(Pose(1.75, 1.0, 0.0))[2, 0] for seed in range(400)])
    assert abs(np.corrcoef(here, there)[0, 1]) < 0.25


def test_poses_are_remembered() -> None:
    body = _body(CLEAN)
    t = _drive(body, 0.2, 0.2, 1.5)
    t = _drive(body, 0.0, 0.0, 60.0, t)
    t = _drive(body, 0.2, 0.2, 1.5, t)
    assert math.hypot(body.pose_at(t - 0.5).x - body.pose.x, body.pose_at(t - 0.5).y - body.pose.y) == pytest.approx(
        0.1
    )
    ahead = body.pose_at(t + 0.010)
    assert math.hypot(ahead.x - body.pose.x, ahead.y - body.pose.y) == pytest.approx(0.002)
    halt = body.trail_at(30.0)
    assert math.hypot(halt.x - 500, halt.y - 500) == pytest.approx(0.3, abs=1e-6)
    steps = np.hypot(*np.diff(body.trail()[:, :2], axis=0).T)
    assert steps.max() <= 0.0131
    assert steps.sum() == pytest.approx(0.6)


# ---- floor camera ----------------------------------------------------------------------------------------------------


def test_place_in_space_is_computed_once_per_standstill_and_follows_the_wheels() -> None:
    body = _body(SETTINGS)
    end = _drive(body, 0.2, 0.3, 0.6)
    standing = _drive(body, 0.0, 0.0, 0.6, end)
    T = body.T_store_robot(standing)
    assert body.T_store_robot(standing - 0.31) is T
    for t in (end - 0.2, standing):
        np.testing.assert_array_equal(body.T_store_robot(t), body.transform(body.pose_at(t)))
    with pytest.raises(ValueError, match="read-only"):
        T[0, 3] = 0.0


def _project(points: Floats, T_store_robot: Floats, camera: CameraModel) -> Floats:
    T_camera_store = invert_rigid(T_store_robot @ transform_matrix(camera.T_robot_camera))
    fx, fy, cx, cy = camera.matrix
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rvec = rotation_vector(T_camera_store[:3, :3])
    pixels, _ = cv2.projectPoints(points, rvec, T_camera_store[:3, 3], matrix, np.array(camera.distortion))
    return np.asarray(pixels.reshape(-1, 2))


def _crossings(row: Floats, level: float) -> tuple[float, float]:
    """Where a row of grey levels falls below `level` and rises again, sub-pixel."""
    below = np.flatnonzero(row < level)
    a, b = below[0], below[-1]
    return a - (level - row[a]) / (row[a - 1] - row[a]), b + (level - row[b]) / (row[b + 1] - row[b])


@pytest.mark.parametrize("color", ["dark", "bright"])
@pytest.mark.parametrize("texture", ["carpet", "wood", "concrete", "tiles", "asphalt"])
def test_the_tape_is_where_the_camera_model_projects_it(world: World, texture: str, color: str) -> None:
    layout = dataclasses.replace(
        STORE,
        floor=dataclasses.replace(STORE.floor, texture=texture),
        line=dataclasses.replace(STORE.line, color=color),
    )
    floor = dataclasses.replace(SETTINGS.floor, dirt=0.0, blur=0.7, noise=0.5)
    renderer = FloorRenderer(layout, dataclasses.replace(SETTINGS, floor=floor), world.floor_camera, 1)
    body = _body(SETTINGS, 4, Pose(1.0, 0.5, 0.0), layout)
    errors = []
    for heading, y in ((0.0, 0.5), (0.1, 0.46), (-0.12, 0.55)):
        T = body.transform(Pose(1.0, y, heading))
        image = (renderer.render(T, T, 0.0, 0.01, 7) / 255.0) ** 2.2  # because the lens blurs light, not grey levels
        image = image if color == "dark" else 1.0 - image
        s = np.linspace(1.2, 2.1, 400)
        left = _project(np.column_stack([s, 0 * s + 0.525, 0 * s]), T, world.floor_camera)
        right = _project(np.column_stack([s, 0 * s + 0.475, 0 * s]), T, world.floor_camera)
        for v in range(110, 230, 7):
            u = [float(np.interp(v, edge[::-1, 1], edge[::-1, 0])) for edge in (left, right)]
            low, high = max(0, int(u[0]) - 9), min(320, int(u[1]) + 10)
            row = image[v, low:high]
            middle = int(0.5 * (u[0] + u[1])) - low
            level = 0.5 * (row[middle - 2 : middle + 3].mean() + np.concatenate([row[:5], row[-5:]]).mean())
            if high - low > 25 and row[0] > level < row[-1]:
                found = _crossings(row, level)
                errors.append((found[0] + low - u[0], found[1] + low - u[1]))
    assert len(errors) > 30
    rough = texture in ("wood", "asphalt")  # planks and grains beside the tape shift the half-way level
    assert np.abs(np.median(errors, axis=0)).max() < (0.7 if rough else 0.25)
    assert rough or np.std(errors, axis=0).max() < 0.4


def test_rows_are_exposed_one_after_another(world: World) -> None:
    renderer = FloorRenderer(STORE, SETTINGS, world.floor_camera, 1)
    body = _body(CLEAN, 0, Pose(1.0, 0.5, 0.0), STORE)
    first, last = body.transform(Pose(1.0, 0.5, 0.0)), body.transform(Pose(1.01, 0.5, 0.05))
    swept = renderer.render(first, last, 0.0, 0.01, 7).astype(int)
    early, late = (renderer.render(T, T, 0.0, 0.01, 7).astype(int) for T in (first, last))
    assert np.abs(swept[5:20] - early[5:20]).mean() < np.abs(swept[5:20] - late[5:20]).mean()
    assert np.abs(swept[-15:] - late[-15:]).mean() < np.abs(swept[-15:] - early[-15:]).mean()


def test_floor_frames_have_the_stated_noise_and_depend_on_the_seed_alone(world: World) -> None:
    T = _body(CLEAN, 0, Pose(1.0, 0.5, 0.0), STORE).transform(Pose(1.0, 0.5, 0.0))
    a, b = (FloorRenderer(STORE, SETTINGS, world.floor_camera, 1) for _ in range(2))
    np.testing.assert_array_equal(a.render(T, T, 0.0, 0.01, 7), b.render(T, T, 0.0, 0.01, 7))
    difference = a.render(T, T, 0.0, 0.01, 7).astype(float) - a.render(T, T, 0.0, 0.01, 8)
    assert difference.std() == pytest.approx(2.0 * math.sqrt(2), rel=0.05)
    assert a.render(T, T, 0.0, 0.02, 7).mean() > 1.2 * a.render(T, T, 0.0, 0.01, 7).mean()


# ---- what the robot is left to believe -------------------------------------------------------------------------------


def test_calibration_errors_have_the_stated_spread_and_are_the_priors(world: World) -> None:
    angles, shifts, focals, centres = [], [], [], []
    for seed in range(60):
        world_ = object.__new__(World)
        world_.__dict__.update(world.__dict__, seed=seed)
        for true, believed in zip(world.rig, world_.believed_calibration().cameras, strict=True):
            T = invert_rigid(transform_matrix(true.T_robot_camera)) @ transform_matrix(believed.T_robot_camera)
            angles.append(rotation_vector(T[:3, :3]))
            shifts.append(np.subtract(believed.T_robot_camera.translation, true.T_robot_camera.translation))
            focals.append(np.subtract(believed.matrix[:2], true.matrix[:2]))
            centres.append(np.subtract(believed.matrix[2:], true.matrix[2:]))
    priors = world.believed_calibration().priors
    assert np.std(angles) == pytest.approx(priors.camera_rotation_rad, rel=0.1)
    assert np.std(shifts) == pytest.approx(priors.camera_translation_m, rel=0.1)
    assert np.std(focals) == pytest.approx(priors.focal_px, rel=0.1)
    assert np.std(centres) == pytest.approx(priors.centre_px, rel=0.1)
    assert (priors.camera_rotation_rad, priors.tilt_rad) == (math.radians(0.05), math.radians(0.3))


def test_cameras_look_where_they_should(world: World) -> None:
    for camera, direction in zip(
        (*world.rig, world.floor_camera), ((1, 0), (0, 1), (-1, 0), (0, -1), (1, 0)), strict=True
    ):
        axis = transform_matrix(camera.T_robot_camera)[:3, 2]
        np.testing.assert_allclose(axis[:2] / np.hypot(*axis[:2]), direction, atol=1e-9)
    assert math.degrees(math.asin(-axis[2])) == pytest.approx(35.0)


def test_settings_come_from_a_world_table_and_mistakes_are_named(tmp_path: Path) -> None:
    path = tmp_path / "world.toml"
    path.write_text("[world]\ntilt = 0.0\n[world.labels]\nlost_fraction = 0.5\n")
    settings = load_settings(path)
    assert (settings.tilt, settings.labels.lost_fraction, settings.drop) == (0.0, 0.5, 0.005)
    path.write_text("[world]\ntlit = 0.0\ndrop = 2.0\n")
    with pytest.raises(ConfigError) as caught:
        load_settings(path)
    assert len(caught.value.problems) == 2
    path.write_text("drop = 0.0\n")
    with pytest.raises(ConfigError, match="missing key 'world'"):
        load_settings(path)


# ---- hardware --------------------------------------------------------------------------------------------------------


class _Tape:
    """A tap that keeps everything."""

    def __init__(self) -> None:
        self.frames: list[tuple[float, Frame]] = []
        self.bytes: list[tuple[float, bytes, bool]] = []

    def frame(self, frame: Frame, delivered: float) -> None:
        self.frames.append((delivered, frame))

    def serial(self, port: str, t: float, data: bytes, *, to_robot: bool) -> None:
        self.bytes.append((t, data, to_robot))


async def _watch(hardware: Hardware, device: str, mode: CameraMode, until: float) -> None:
    source = await hardware.open_camera(device, device.rsplit("/", 1)[1], mode)
    try:
        async with asyncio.timeout(until - now()):
            while True:
                await source.read()
    except TimeoutError:
        source.close()


async def _read_for_ever(device: CameraSource | SerialLink) -> None:
    while True:
        await device.read()


def test_frames_are_stamped_late_dropped_and_delayed_as_stated(tmp_path: Path) -> None:
    settings = dataclasses.replace(SETTINGS, drop=0.02)
    world, tape = World(STORE, settings, 5, tmp_path), _Tape()
    run_virtual(_watch(SimHardware(world, tape), "/dev/robotd/floor", CameraMode((320, 240)), 40.0))
    stamps = np.array([frame.t for _, frame in tape.frames])
    sequence = np.array([frame.sequence for _, frame in tape.frames])
    delivered = np.array([t for t, _ in tape.frames])
    missing = sequence[-1] + 1 - len(sequence)
    assert missing == pytest.approx(0.02 * 1200, abs=14)
    begin = np.median(stamps - sequence / 30)  # phase plus the constant offset
    offset = world.camera_offset("floor")
    assert 0.0 <= begin - offset + 1e-3 < 1 / 30 + 2e-3
    assert np.std(stamps - sequence / 30) == pytest.approx(0.002, rel=0.1)
    late = delivered - (begin - offset + sequence / 30)
    assert late.min() > 0.058
    assert late.max() < 0.122
    assert np.mean(late) == pytest.approx(0.090, abs=0.006)
    assert (np.diff(delivered) >= 0).all()
    assert tape.frames[0][1].image.shape == (240, 320)


def test_offsets_differ_between_cameras_and_stay_below_the_limit(world: World) -> None:
    offsets = [world.camera_offset(name) for name in CAMERAS.values()]
    assert len(set(offsets)) == 5
    assert max(map(abs, offsets)) <= 0.050


def test_same_seed_same_pixels_and_bytes(tmp_path: Path) -> None:
    def run() -> _Tape:
        tape = _Tape()

        async def main() -> None:
            hardware = SimHardware(World(STORE, SETTINGS, 9, tmp_path), tape)
            async with asyncio.TaskGroup() as group:
                group.create_task(_watch(hardware, "/dev/robotd/floor", CameraMode(), 0.4))
                group.create_task(_watch(hardware, "/dev/robotd/front", CameraMode(), 0.2))
                link = await hardware.open_serial(PORT, 115200)
                link.write(bytes([128, 131, 148, 2, 43, 44, 145, 0, 200, 0, 200]))
                while now() < 0.25:
                    await link.read()
                link.close()

        run_virtual(main())
        return tape

    first, second = run(), run()
    assert len(first.frames) > 8
    assert first.bytes == second.bytes
    assert first.bytes[0][2]
    for (t, a), (u, b) in zip(first.frames, second.frames, strict=True):
        assert (t, a.t, a.camera) == (u, b.t, b.camera)
        np.testing.assert_array_equal(a.image, b.image)


def test_a_slow_reader_gets_the_newest_frames(world: World) -> None:
    async def main() -> list[int]:
        source = await SimHardware(world).open_camera("/dev/robotd/floor", "floor", CameraMode())
        await asyncio.sleep(3.0)
        sequences = [(await source.read()).sequence for _ in range(3)]
        source.close()
        return sequences

    assert min(run_virtual(main())) > 75


def test_camera_modes_are_negotiated(world: World) -> None:
    async def main() -> CameraMode:
        source = await SimHardware(world).open_camera("/dev/robotd/left", "left", CameraMode((99, 99), 30.0, 5.0))
        source.close()
        source.close()
        return source.mode

    mode = run_virtual(main())
    assert mode.size == (640, 480)
    assert mode.exposure == pytest.approx(1 / 30)


def test_a_pulled_camera_and_a_pulled_cable_are_faults_until_they_are_back(world: World) -> None:
    async def main() -> None:
        hardware = SimHardware(world)
        camera = await hardware.open_camera("/dev/robotd/floor", "floor", CameraMode())
        link = await hardware.open_serial(PORT, 115200)
        with pytest.raises(DriverFault, match="in use"):
            await hardware.open_camera("/dev/robotd/floor", "floor", CameraMode())
        await camera.read()
        asyncio.get_running_loop().call_later(0.01, world.unplug, "/dev/robotd/floor")
        asyncio.get_running_loop().call_later(0.01, world.unplug, PORT)
        for device in (camera, link):
            with pytest.raises(DriverFault, match="unplugged"):
                await _read_for_ever(device)
        with pytest.raises(DriverFault, match="unplugged"):
            await hardware.open_camera("/dev/robotd/floor", "floor", CameraMode())
        with pytest.raises(DriverFault, match="unplugged"):
            await hardware.open_serial(PORT, 115200)
        world.plug("/dev/robotd/floor")
        world.plug(PORT)
        again = await hardware.open_camera("/dev/robotd/floor", "floor", CameraMode())
        await again.read()
        again.close()
        (await hardware.open_serial(PORT, 115200)).close()

    run_virtual(main())


def test_unknown_devices_name_the_known_ones(world: World) -> None:
    async def main() -> None:
        hardware = SimHardware(world)
        with pytest.raises(DriverFault, match="no camera /dev/video0; this robot has /dev/robotd/front, "):
            await hardware.open_camera("/dev/video0", "x", CameraMode())
        with pytest.raises(DriverFault, match="no serial port /dev/ttyUSB0; this robot has /dev/robotd/base"):
            await hardware.open_serial("/dev/ttyUSB0", 115200)

    run_virtual(main())


def test_the_date_is_fixed_and_goes_with_the_loop(world: World) -> None:
    async def main() -> float:
        await asyncio.sleep(90.0)
        return (SimHardware(world).utc() - START).total_seconds()

    assert run_virtual(main()) == 90.0


def test_hardware_shows_nothing_but_the_protocol(world: World) -> None:
    shown = {name for name in dir(SimHardware(world)) if not name.startswith("_")}
    assert shown == {name for name in (*vars(Hardware), *Hardware.__annotations__) if not name.startswith("_")}


def test_pins_are_simulated(world: World) -> None:
    from gpiozero import LED

    hardware = SimHardware(world)
    with LED(17, pin_factory=hardware.pins) as led:
        led.on()
        assert hardware.pins.pin(17).state
    hardware.pins.close()


def test_measured_labels_are_in_world_axes_with_the_stated_error(tmp_path: Path) -> None:
    labels = tuple(LabelLayout(f"L{n}", (0.1 * n, 0.5, 1.0), (0.0, 1.0, 0.0)) for n in range(10))
    known = tuple(MeasuredLabel(label.id, 0.010) for label in labels)
    layout = dataclasses.replace(STORE, labels=labels, known_labels=known)
    errors = []
    for seed in range(8):
        world = World(layout, SETTINGS, seed, tmp_path)
        truth = world.to_world(np.array([label.position for label in labels]))
        errors += [np.subtract(m.position, t) for m, t in zip(world.measured_labels(), truth, strict=True)]
        assert np.linalg.norm(truth[9] - truth[0]) == pytest.approx(0.9)
    origin = world.to_world(np.array([[world.body.start.x, world.body.start.y, 0.0]]))
    np.testing.assert_allclose(origin, 0.0, atol=1e-12)
    assert np.std(errors) == pytest.approx(0.010, rel=0.15)
