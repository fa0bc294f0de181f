"""`robotd-solver calibrate floor`: the pose of a floor camera from drawn chessboards, its uncertainty, and refusals."""

import json
import math
import tomllib
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from robotd.config import Calibration, load_calibration, save_calibration
from robotd.errors import InputError, SolverError
from robotd.geometry.camera import Camera
from robotd.geometry.transforms import rotation_matrix, transform_matrix, transform_record
from robotd.records import CameraModel
from robotd.solver.calibrate_floor import Board, Place, calibrate_floor, estimate_lens, find_board
from robotd.solver_main import main

BOARD = Board(9, 6, 0.025)


def camera(pitch=50.0, roll=1.5, yaw=-2.0, at=(0.14, 0.01, 0.28), distortion=(-0.12, 0.03, 0.0005, -0.0004, 0.0)):
    """A camera at the front of the robot that looks `pitch` degrees down, a little askew, with a lens of 640x480."""
    p = math.radians(pitch)
    level = np.array([(0.0, -math.sin(p), math.cos(p)), (-1.0, 0.0, 0.0), (0.0, -math.cos(p), -math.sin(p))])
    T = np.eye(4)
    askew = rotation_matrix(np.radians([0.0, 0.0, yaw])) @ level @ rotation_matrix(np.radians([0.0, 0.0, roll]))
    T[:3, :3], T[:3, 3] = askew, at
    return CameraModel("floor", (640, 480), (520.0, 518.0, 323.0, 238.0), transform_record(T), distortion=distortion)


@cache
def rays_of(distortion, matrix):
    """(4 x 480 x 640, 3) rays of a camera at two samples a pixel each way."""
    v, u = np.mgrid[0:960, 0:1280]
    lens = Camera(CameraModel("floor", (640, 480), matrix, transform_record(np.eye(4)), distortion=distortion))
    return lens.rays(np.column_stack([(u.ravel() + 0.5) / 2 - 0.5, (v.ravel() + 0.5) / 2 - 0.5]))


def picture(model, place, board=BOARD, noise=1.5, seed=0):
    """What the camera sees of a board at x, y, heading on the floor."""
    rays, valid = rays_of(model.distortion, model.matrix)
    T = transform_matrix(model.T_robot_camera)
    x, y, heading = place
    turn = rotation_matrix(np.array([0.0, 0.0, heading]))
    origin, ways = turn.T @ (T[:3, 3] - [x, y, 0.0]), rays @ T[:3, :3].T @ turn
    far = -origin[2] / np.where(np.abs(ways[:, 2]) < 1e-9, 1e-9, ways[:, 2])
    a, b = origin[0] + far * ways[:, 0], origin[1] + far * ways[:, 1]
    i, j = np.floor(a / board.square + 0.5 * (board.columns + 1)), np.floor(b / board.square + 0.5 * (board.rows + 1))
    on = valid & (far > 0) & (i >= 0) & (i <= board.columns) & (j >= 0) & (j <= board.rows)
    grey = np.where(on, np.where((i + j) % 2 == 0, 30.0, 215.0), 215.0).reshape(960, 1280).astype(np.float32)
    grey = cv2.resize(cv2.GaussianBlur(grey, (0, 0), 1.4), (640, 480), interpolation=cv2.INTER_AREA)
    return np.clip(grey + np.random.default_rng(seed).normal(0.0, noise, grey.shape), 0, 255).astype(np.uint8)


PLACES = [(0.42, 0.0, math.radians(90.0)), (0.55, 0.09, math.radians(75.0)), (0.40, -0.10, math.radians(20.0))]


@pytest.fixture(scope="module")
def scene():
    model = camera()
    return model, [picture(model, place, seed=k) for k, place in enumerate(PLACES)]


def corners(images):
    found = [find_board(image, BOARD) for image in images]
    assert all(one is not None for one in found)
    return found


def test_the_pose_is_recovered_with_one_measured_board(scene):
    model, images = scene
    places = [Place(*PLACES[0]), None, None]
    result = calibrate_floor(model, corners(images), BOARD, places, ["a", "b", "c"])
    truth, got = transform_matrix(model.T_robot_camera), transform_matrix(result.camera.T_robot_camera)
    assert result.rms_px < 0.15
    assert np.abs(got[:3, 3] - truth[:3, 3]).max() < 0.002
    assert np.degrees(np.arccos((np.trace(truth[:3, :3].T @ got[:3, :3]) - 1.0) / 2.0)) < 0.2
    assert np.abs(result.boards[1:, :2] - np.array(PLACES)[1:, :2]).max() < 0.002
    assert result.camera.matrix == model.matrix


def test_the_uncertainty_fits_the_errors():
    """A place measured wrong by its standard deviation moves floor points by about what is reported."""
    model = camera()
    rng = np.random.default_rng(5)
    optics = Camera(replace(model, T_robot_camera=transform_record(np.eye(4))))
    truth = transform_matrix(model.T_robot_camera)
    misses, told = [], []
    for _ in range(25):
        seen = []
        for x, y, heading in PLACES:
            c, s = math.cos(heading), math.sin(heading)
            floor = BOARD.corners @ np.array([[c, s], [-s, c]]) + [x, y]
            points = (np.column_stack([floor, np.zeros(len(floor))]) - truth[:3, 3]) @ truth[:3, :3]
            seen.append(optics.project(points)[0] + rng.normal(0.0, 0.2, (len(floor), 2)))
        x, y, heading = PLACES[0]
        place = Place(x + rng.normal(0, 0.003), y + rng.normal(0, 0.003), heading + rng.normal(0, 0.01))
        result = calibrate_floor(model, seen, BOARD, [place, None, None], ["a", "b", "c"])
        got = transform_matrix(result.camera.T_robot_camera)
        pixel = (np.array([0.6, 0.0, 0.0]) - truth[:3, 3]) @ truth[:3, :3]
        ray = got[:3, :3] @ pixel
        foot = got[:3, 3] - got[2, 3] / ray[2] * ray
        misses.append(foot[:2] - [0.6, 0.0])
        told.append(result.sigma_ahead[1])
    worst = math.sqrt(float(np.linalg.eigvalsh(np.cov(np.array(misses).T))[-1]))
    assert worst == pytest.approx(np.median(told), rel=0.4)


def test_a_lens_is_estimated_from_held_boards():
    model = camera()
    rng = np.random.default_rng(2)
    optics = Camera(replace(model, T_robot_camera=transform_record(np.eye(4))))
    seen = []
    for k in range(8):
        T = np.eye(4)
        T[:3, :3] = rotation_matrix(np.array([math.pi, 0.0, 0.0])) @ rotation_matrix(rng.uniform(-0.5, 0.5, 3))
        T[:3, 3] = *rng.uniform(-0.04, 0.04, 2), 0.30 + 0.02 * k
        points = np.column_stack([BOARD.corners, np.zeros(54)]) @ T[:3, :3].T + T[:3, 3]
        seen.append(optics.project(points)[0] + rng.normal(0.0, 0.05, (54, 2)))
    lens = estimate_lens(seen, BOARD, (640, 480))
    assert lens.matrix == pytest.approx(model.matrix, abs=4.0)
    assert lens.distortion[0] == pytest.approx(-0.12, abs=0.03)
    with pytest.raises(SolverError, match="cannot be estimated from 4 pictures"):
        estimate_lens(seen[:4], BOARD, (640, 480))
    with pytest.raises(SolverError, match="tilt them by 15 degrees or more"):
        estimate_lens([seen[0]] * 6, BOARD, (640, 480))


def test_the_order_of_corners_is_never_mirrored(scene):
    _, images = scene
    for found in corners(images):
        grid = found.reshape(6, 9, 2)
        along, down = grid[0, 8] - grid[0, 0], grid[5, 0] - grid[0, 0]
        assert along[0] * down[1] - along[1] * down[0] > 0.0
    assert find_board(np.full((480, 640), 128, np.uint8), BOARD) is None


def saved(folder, images):
    paths = []
    for k, image in enumerate(images):
        paths.append(str(folder / f"floor_{k}.png"))
        assert cv2.imwrite(paths[-1], image)
    return paths


ASKED = "--board", "9x6", "--square", "0.025"


def test_the_command_writes_the_camera_and_keeps_the_rest(scene, tmp_path, capsys):
    model, images = scene
    file = tmp_path / "calibration.toml"
    wrong = replace(model, T_robot_camera=transform_record(np.eye(4)))
    save_calibration(Calibration(gamma=2.0, floor_camera=wrong), file)
    file.write_text("# measured in the hall\n" + file.read_text())
    asked = ["calibrate", "floor", *saved(tmp_path, images), *ASKED, "--at", "0.42,0,90", "--calibration", str(file)]
    assert main([*asked, "--json", "--picture", str(tmp_path / "residuals.png")]) == 0
    out = capsys.readouterr()
    numbers = json.loads(out.out)
    written = load_calibration(file)
    truth = transform_matrix(model.T_robot_camera)
    assert transform_matrix(written.floor_camera.T_robot_camera)[:3, 3] == pytest.approx(truth[:3, 3], abs=0.002)
    assert written.gamma == 2.0
    assert numbers["translation_m"] == list(written.floor_camera.T_robot_camera.translation)
    assert 0.0 < numbers["sigma_ahead_m"]["0.6"] < 0.010
    assert "height +-" in out.err
    assert file.read_text().startswith("# measured in the hall\n")
    assert cv2.imread(str(tmp_path / "residuals.png")).shape[1] > 1000
    assert main(asked) == 0  # again: one note, not two
    assert file.read_text().count("# robotd-solver calibrate floor:") == 1
    tomllib.loads(file.read_text())


def test_without_a_lens_the_command_says_what_is_missing(scene, tmp_path, capsys):
    file = tmp_path / "calibration.toml"
    asked = ["calibrate", "floor", *saved(tmp_path, scene[1][:1]), *ASKED, "--at", "0.42,0,90"]
    assert main([*asked, "--calibration", str(file)]) == 1
    said = capsys.readouterr().err
    assert "the lens is not known" in said
    assert "--held" in said
    assert not file.exists()


def test_every_useless_picture_is_named_at_once(scene, tmp_path, capsys):
    model, images = scene
    file = tmp_path / "calibration.toml"
    save_calibration(Calibration(floor_camera=model), file)
    paths = saved(tmp_path, [images[0], np.full((480, 640), 90, np.uint8), np.zeros((240, 320), np.uint8)])
    (tmp_path / "text.png").write_text("no picture")
    asked = [*paths, str(tmp_path / "text.png"), str(tmp_path / "gone.png"), *ASKED, "--at", "0.42,0,90"]
    assert main(["calibrate", "floor", *asked, "--calibration", str(file)]) == 2
    said = capsys.readouterr().err
    for words in (
        "floor_1.png: no board of 9x6 inner corners seen", "floor_2.png: is 320x240, but", "text.png: cannot be read",
        "gone.png: there is no such file",
    ):  # fmt: skip
        assert words in said, words


def test_a_wrong_place_or_square_is_refused(scene):
    model, images = scene
    found = corners(images)
    with pytest.raises(SolverError, match="not on the robot"):
        calibrate_floor(model, found, BOARD, [Place(1.6, 0.0, 1.57), None, None], ["a", "b", "c"])
    contradiction = [Place(*PLACES[0]), Place(0.75, 0.09, PLACES[1][2]), None]
    with pytest.raises(SolverError, match=r"the board in [ab] lies \d+ mm"):
        calibrate_floor(model, found, BOARD, contradiction, ["a", "b", "c"])


def test_a_board_that_does_not_lie_flat_is_named(scene):
    model, images = scene
    found = corners(images)
    bent = found[1].copy()
    bent[:9, 1] += 12.0
    with pytest.raises(SolverError, match="worst second with"):
        calibrate_floor(
            model, [found[0], bent, found[2]], BOARD, [Place(*PLACES[0]), None, None], ["first", "second", "third"]
        )


def test_no_place_at_all_is_refused(scene):
    model, images = scene
    with pytest.raises(InputError, match="no board's place"):
        calibrate_floor(model, corners(images[:1]), BOARD, [None], ["a"])


@pytest.mark.parametrize(
    "wrong",
    [["--board", "9"], ["--board", "6x6"], ["--square", "0"], ["--square", "x"], ["--at", "1,2"], ["--at", "a,b,c"]],
)
def test_wrong_options_are_refused(wrong, capsys):
    good = {"--board": "9x6", "--square": "0.025", "--at": "0.4,0,0", "--calibration": "c.toml"} | dict([wrong])
    with pytest.raises(SystemExit):
        main(["calibrate", "floor", "a.png", *[text for pair in good.items() for text in pair]])
    assert wrong[0] in capsys.readouterr().err
