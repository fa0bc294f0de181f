"""`robotd-solver calibrate camera`: lenses from drawn boards, which model, how sure, what is missing, MATLAB."""

import json
import math
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from robotd.config import Calibration, load_calibration, save_calibration
from robotd.errors import ConfigError, InputError, SolverError
from robotd.geometry.camera import Camera
from robotd.geometry.transforms import rotation_matrix
from robotd.lens_tool import _read
from robotd.records import CameraModel, Transform
from robotd.solver.board_corners import agreeing
from robotd.solver.board_shape import BoardShape
from robotd.solver.calibrate_floor import Board
from robotd.solver.calibrate_lens import Candidate, _choose, calibrate_lens
from robotd.solver.lens_fit import View, camera_model, fit_lens, lens_jacobian, pose_views, refine
from robotd.solver.matlab_lens import load_matlab
from robotd.solver_main import main
from robotd.toml_edit import replace_element

SIZE = (640, 480)
BOARD = Board(9, 6, 0.03)
POINTS = np.column_stack([BOARD.corners * [1.0, -1.0], np.zeros(54)])
BROWN = np.array([420.0, 418.0, 322.0, 238.0, -0.30, 0.10, 0.0005, -0.0004, -0.015])
FISHEYE = np.array([200.0, 201.0, 318.0, 242.0, 0.03, -0.01, 0.002, -0.0005])


def poses(kind, lens, count, seed, tilt=0.7, near=0.2, far=0.7, middle=0.0, shapes=(POINTS,)):
    """Boards that lie wholly in the picture, facing the camera but for a tilt, their middles all over it."""
    rng, camera = np.random.default_rng(seed), Camera(camera_model(kind, lens, SIZE))
    out = []
    while len(out) < count:
        at = rng.uniform(np.array(SIZE) * middle, np.array(SIZE) * (1.0 - middle))
        (ray,), (valid,) = camera.rays(at[None])
        turn = rotation_matrix(rng.uniform(-tilt, tilt, 3))
        distance = rng.uniform(near, far)
        if not valid:
            continue
        axis = np.cross([0.0, 0.0, 1.0], ray)
        sine = float(np.linalg.norm(axis))
        facing = rotation_matrix(axis / max(sine, 1e-9) * math.atan2(sine, ray[2]))
        R = (facing @ turn) if tilt > 0.1 else turn
        pixels, valid = camera.project(shapes[len(out) % len(shapes)] @ R.T + ray * distance)
        if valid.all() and camera.in_image(pixels, 12.0).all():
            out.append((R, ray * distance, pixels))
    return out


def views(kind, lens, count=20, seed=0, noise=0.1, **how):
    rng = np.random.default_rng(1000 + seed)
    return [
        View(f"picture {k}", POINTS, pixels + rng.normal(0.0, noise, pixels.shape))
        for k, (_, _, pixels) in enumerate(poses(kind, lens, count, seed, **how))
    ]


# ---- the fit ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["brown-conrady", "rational", "fisheye"])
def test_derivatives_by_the_lens_are_those_of_the_camera(kind):
    rng = np.random.default_rng(3)
    lens = {"brown-conrady": BROWN, "rational": np.array([*BROWN, 0.05, 0.02, 0.01]), "fisheye": FISHEYE}[kind]
    points = rng.uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.0], (20, 3))
    found = lens_jacobian(kind, lens, points)
    for k in range(len(lens)):
        step = np.zeros(len(lens))
        step[k] = 1e-6 * max(abs(lens[k]), 1.0)
        ends = [Camera(camera_model(kind, lens + way * step, SIZE)).project(points)[0] for way in (1.0, -1.0)]
        assert found[:, :, k] == pytest.approx((ends[0] - ends[1]) / (2.0 * step[k]), abs=1e-4)


@pytest.mark.parametrize(("kind", "lens"), [("brown-conrady", BROWN), ("fisheye", FISHEYE)])
def test_the_stated_uncertainty_is_that_of_the_errors(kind, lens):
    """NEES of fx, fy, cx, cy over seeds: its mean is 4, its standard deviation over n seeds sqrt(8 / n)."""
    count = 40
    scenes = poses(kind, lens, 12, seed=0)
    rng = np.random.default_rng(8)
    exact = [View(str(k), POINTS, pixels) for k, (_, _, pixels) in enumerate(scenes)]
    start = fit_lens(kind, exact, SIZE)
    assert start.lens == pytest.approx(lens, abs=1e-3)
    nees = []
    for _ in range(count):
        noisy = [View(v.name, v.points, v.pixels + rng.normal(0.0, 0.2, v.pixels.shape)) for v in exact]
        fit = refine(start, noisy, SIZE)
        scatter = fit.cost / (fit.residuals.size - len(lens) - 6 * len(noisy))
        covariance = scatter * np.linalg.inv(fit.information.sum(axis=0))[:4, :4]
        error = fit.lens[:4] - lens[:4]
        nees.append(error @ np.linalg.solve(covariance, error))
    assert abs(np.mean(nees) / 4.0 - 1.0) < 3.0 * math.sqrt(8.0 / count) / 4.0


@cache
def calibrated(kind):
    lens = FISHEYE if kind == "fisheye" else BROWN
    return calibrate_lens(views(kind, lens), SIZE, "front")


@pytest.mark.parametrize(("kind", "lens"), [("brown-conrady", BROWN), ("fisheye", FISHEYE)])
def test_a_lens_is_recovered_within_its_stated_sigma_by_the_model_that_made_it(kind, lens):
    result = calibrated(kind)
    assert result.kind == kind
    assert result.camera.model == kind
    assert result.rms_px == pytest.approx(0.1, rel=0.1)
    error = np.array(result.camera.matrix) - lens[:4]
    assert (np.abs(error) < 3.5 * result.sigmas).all()
    assert result.sigmas.max() < 1.0
    wrong = "brown-conrady" if kind == "fisheye" else "fisheye"
    assert result.held_out_px[wrong] > result.held_out_px[kind]


def test_the_lens_is_called_valid_as_far_as_corners_reached():
    scene = views("brown-conrady", BROWN)
    result = calibrated("brown-conrady")
    away = np.concatenate([np.linalg.norm(v.pixels - result.camera.matrix[2:], axis=1) for v in scene])
    assert result.reach_px <= away.max()
    assert result.camera.valid_radius_px == pytest.approx(result.reach_px, abs=0.1)
    truth, found = Camera(camera_model("brown-conrady", BROWN, SIZE)), Camera(result.camera)
    angle = np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False)
    rim = np.array(BROWN[2:4]) + 0.95 * result.reach_px * np.column_stack([np.cos(angle), np.sin(angle)])
    rim = rim[truth.in_image(rim)]
    (a, _), (b, valid) = truth.rays(rim), found.rays(rim)
    assert valid.all()
    assert np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1.0, 1.0))).max() < 0.2


def test_a_gain_of_nothing_is_not_worth_more_coefficients():
    rng = np.random.default_rng(1)
    plain = rng.uniform(0.009, 0.011, 20)
    brown, rational, fisheye = (Candidate(kind, False) for kind in ("brown-conrady", "rational", "fisheye"))
    bent = Candidate("brown-conrady", True)
    assert _choose({brown: plain, rational: 0.995 * plain, bent: 0.995 * plain}) == brown
    assert _choose({brown: plain, rational: 0.8 * plain}) == rational
    assert _choose({brown: plain, rational: 0.995 * plain, bent: 0.8 * plain}) == bent
    assert _choose({brown: np.full(20, np.inf), fisheye: plain}) == fisheye
    far_off = plain + 9.0 * (np.arange(20) == 3)
    assert _choose({brown: 1.5 * far_off, fisheye: plain}) == fisheye, "one picture's error made the scatter a tie"


# ---- boards that are not flat ----------------------------------------------------------------------------------------


def bowed(height, stretch=0.0, about_x=False):
    """The board as a part of a cylinder, its middle so many metres before its ends."""
    along = POINTS[:, 1 if about_x else 0]
    z = height * (1.0 - (along / along.max()) ** 2)
    return POINTS * [1.0 + stretch, 1.0, 1.0] + np.column_stack([np.zeros((54, 2)), z])


@pytest.mark.parametrize(("kind", "lens"), [("brown-conrady", BROWN), ("fisheye", FISHEYE)])
def test_a_board_bent_by_a_millimetre_is_found_and_does_not_change_the_focal_length(kind, lens):
    """Taken as flat, it makes the focal length 0.5 to 2 % wrong, which is ten standard deviations."""
    scene = views(kind, lens, 14, seed=3, shapes=(bowed(1e-3, stretch=0.004),))
    scene[::2] = [View(v.name, v.points, v.pixels[::-1]) for v in scene[::2]]  # from the board's other end
    result = calibrate_lens(scene, SIZE, "front", (kind,))
    assert result.bend.height == pytest.approx(1e-3, abs=4.0 * result.bend.height_sigma)
    assert result.bend.stretch == pytest.approx(0.004, abs=4.0 * result.bend.stretch_sigma)
    assert result.bend.height_sigma < 2e-4
    assert np.array(result.camera.matrix) == pytest.approx(lens[:4], abs=4.0 * result.sigmas.max())
    assert result.sigmas[:2].max() < 0.004 * lens[0]
    assert "not flat and square" in " ".join(result.doubts)


def test_a_flat_board_is_taken_as_flat():
    assert calibrated("brown-conrady").bend is None
    assert calibrated("brown-conrady").disagreement < 1.5
    assert calibrated("brown-conrady").doubts == ()


def test_a_board_that_bends_from_picture_to_picture_raises_the_stated_uncertainty():
    shapes = tuple(bowed(h, about_x=x) for h in (1e-3, -1e-3) for x in (False, True))
    flat = calibrated("brown-conrady")
    result = calibrate_lens(
        views("brown-conrady", BROWN, shapes=shapes, seed=5), SIZE, "front", ("brown-conrady",), False
    )
    assert result.disagreement > 1.5
    assert "pictures disagree" in " ".join(result.doubts)
    assert result.sigmas[0] > 2.0 * flat.sigmas[0]
    assert (np.abs(np.array(result.camera.matrix) - BROWN[:4]) < 4.0 * result.sigmas).all()


def test_the_modes_of_a_board_are_neither_shifts_nor_tilts_and_look_the_same_from_its_other_end():
    board = BoardShape(POINTS)
    modes = board.modes(POINTS)
    assert modes == pytest.approx(modes[::-1] * np.array([-1.0, -1.0, 1.0])[:, None], abs=1e-9)
    heights = modes[:, 2, 2:]
    assert np.abs(heights.T @ np.column_stack([np.ones(54), POINTS[:, :2]])).max() < 1e-9
    assert heights.T @ heights == pytest.approx(54.0 * np.eye(len(board) - 2), abs=1e-9)


# ---- what is missing -------------------------------------------------------------------------------------------------


def refused(scene, words, whole=True):
    with pytest.raises(SolverError, match=words):
        calibrate_lens(scene, SIZE, "front", ("brown-conrady",), whole)


def test_too_few_pictures_are_refused_and_repeated_ones_count_once():
    scene = views("brown-conrady", BROWN, 8)
    refused(scene[:5], "5 different pictures; take 8 or more")
    refused(scene[:5] * 4, r"5 different pictures \(20, but in some the board did not move\)")
    parts = [View(v.name, v.points[k:], v.pixels[k:]) for k in range(4) for v in scene[:5]]
    refused(parts, r"5 different pictures \(20, but")
    refused(parts[:1] * 9, r"1 different picture \(9, but")


def test_boards_without_tilt_are_refused():
    refused(views("brown-conrady", BROWN, 10, tilt=0.02), "tilt them by 30 to 45 degrees", whole=False)


def test_corners_that_leave_out_a_border_are_refused_and_the_border_named():
    scene = views("brown-conrady", BROWN, 25)
    left = [View(v.name, v.points, v.pixels * [0.6, 1.0]) for v in scene]
    refused(left, r"no corner lies near the right \(\d+ %\) border")
    middle = views("brown-conrady", BROWN, 20, middle=0.42, near=0.5)
    refused(middle, "border, where the lens bends most")


def test_boards_at_one_distance_are_refused():
    refused(views("brown-conrady", BROWN, near=0.38, far=0.4), "all at nearly the same distance", whole=False)


def test_a_picture_that_does_not_belong_is_named_and_left_out_but_not_a_third_of_them():
    scene = views("brown-conrady", BROWN, 16)
    for k, name in ((7, "bent"), (8, "a"), (9, "b"), (10, "c"), (11, "d"), (12, "bad")):
        scene[k] = View(name, POINTS, scene[k].pixels + (2.0 + 0.2 * k) * np.sin(np.arange(108).reshape(54, 2)))
    refused(scene, "worst bad with")
    result = calibrate_lens([*scene[:8], *scene[13:]], SIZE, "front", ("brown-conrady",))
    assert len(result.strangers) == 1
    assert any(words.startswith("bent was left out: its corners are off by") for words in result.doubts)
    assert (np.abs(np.array(result.camera.matrix) - BROWN[:4]) < 3.5 * result.sigmas).all()


def test_a_picture_of_another_camera_is_named_and_left_out_though_it_fits_by_itself():
    scene = views("brown-conrady", BROWN, 16)
    longer = BROWN * np.array([1.12, 1.12, *[1.0] * 7])
    others = [
        View(f"other{k}", POINTS, view.pixels) for k, view in enumerate(views("brown-conrady", longer, 7, seed=2))
    ]
    result = calibrate_lens([*scene, *others[:3]], SIZE, "front", ("brown-conrady",))
    assert len(result.views) == 16
    told = sorted(words.split(" than ")[0] for words in result.strangers)
    assert told == [f"other{k} was left out: it shows another lens" for k in range(3)]
    assert (np.abs(np.array(result.camera.matrix) - BROWN[:4]) < 3.5 * result.sigmas).all()
    mixed = calibrate_lens([*scene, *others], SIZE, "front", ("brown-conrady",))
    assert any("pictures disagree about the lens" in words for words in mixed.doubts)


def test_corners_that_leave_out_all_borders_a_little_are_refused_or_told():
    inner = []
    for view in views("brown-conrady", BROWN, 24):
        seen = (np.abs(view.pixels - [319.5, 239.5]) < [175.0, 130.0]).all(axis=1)
        if seen.sum() > 20:
            inner.append(View(view.name, view.points[seen], view.pixels[seen]))
    refused(
        inner, r"circle around the middle \d+ % of the picture; hold the board into its corners, too; or, .*--partial"
    )
    result = calibrate_lens(inner, SIZE, "front", ("brown-conrady",), False)
    assert result.share < 0.5
    assert "nothing seen there will be used" in " ".join(result.doubts)


# ---- the command -----------------------------------------------------------------------------------------------------


def drawn(texture, scale, R, t, seed=0, kind="brown-conrady"):
    """What a camera sees of a board, texture (H, W) with `scale` pixels per metre around its middle."""
    rays, valid = rays_of(kind)
    R, t = R.astype(np.float32), t.astype(np.float32)
    normal = R[:, 2]
    far = (normal @ t) / np.where(np.abs(rays @ normal) < 1e-6, 1e-6, rays @ normal)
    on = (rays * far[:, None] - t) @ R[:, :2]
    at = on * np.float32(scale) + 0.5 * (np.array(texture.shape[::-1], np.float32) - 1.0)
    at[~valid | (far <= 0.0)] = -1e4
    at = at.reshape(960, 1280, 2)
    big = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=215)
    grey = cv2.resize(cv2.GaussianBlur(big.astype(np.float32), (0, 0), 1.4), SIZE, interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0.0, 1.5, grey.shape)
    return np.clip(grey + noise, 0, 255).astype(np.uint8)


@cache
def rays_of(kind):
    v, u = np.mgrid[0:960, 0:1280]
    camera = Camera(camera_model(kind, FISHEYE if kind == "fisheye" else BROWN, SIZE))
    rays, valid = camera.rays(np.column_stack([(u.ravel() + 0.5) / 2 - 0.5, (v.ravel() + 0.5) / 2 - 0.5]))
    return np.nan_to_num(rays, nan=1.0).astype(np.float32), valid


def chessboard_texture(scale=2000):
    square = round(BOARD.square * scale)
    y, x = np.mgrid[0 : 9 * square, 0 : 12 * square]
    i, j = x // square, y // square
    inside = (i > 0) & (i < 11) & (j > 0) & (j < 8)
    return np.where(inside & ((i + j) % 2 == 0), 30, 215).astype(np.uint8)


def charuco_texture(columns=10, rows=7, marker=0.0225, dictionary="DICT_4X4_50", scale=2000, legacy=False):
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard((columns, rows), 0.03, marker, known)
    board.setLegacyPattern(legacy)
    image = board.generateImage((round(0.03 * scale) * columns, round(0.03 * scale) * rows))
    return np.clip(image, 30, 215).astype(np.uint8)


@pytest.fixture(scope="module", params=["--board", "--charuco"])
def pictures(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    texture = chessboard_texture() if request.param == "--board" else charuco_texture()
    paths = []
    for k, (R, t, _) in enumerate(poses("brown-conrady", BROWN, 10, seed=4, tilt=0.6, near=0.2, far=0.5)):
        paths.append(str(folder / f"front-{k:03d}.png"))
        assert cv2.imwrite(paths[-1], drawn(texture, 2000.0, R, t, seed=k))
    asked = ["9x6", "--model", "brown-conrady"] if request.param == "--board" else ["10x7"]
    return paths, [request.param, *asked, "--square", "0.03"]


def calibration(path):
    mount = Transform((-1.2, 1.2, -1.2), (0.06, 0.0, 0.5))
    cameras = tuple(CameraModel(n, SIZE, (300.0, 300.0, 320.0, 240.0), mount) for n in ("rear", "front"))
    save_calibration(Calibration(cameras=cameras, gamma=2.0), path)
    path.write_text("# measured in the hall\n" + path.read_text())
    return mount


def test_the_command_finds_the_corners_and_writes_the_lens_alone(pictures, tmp_path, capsys):
    paths, board = pictures
    file, png = tmp_path / "calibration.toml", tmp_path / "residuals.png"
    mount = calibration(file)
    asked = ["calibrate", "camera", *paths, *board, "--camera", "front", "--calibration", str(file)]
    assert main([*asked, "--json", "--picture", str(png)]) == 0
    out = capsys.readouterr()
    numbers = json.loads(out.out)
    written = load_calibration(file)
    front = written.camera("front")
    assert numbers["matrix"] == list(front.matrix)
    assert front.T_robot_camera == mount
    assert front.valid_radius_px == numbers["valid_radius_px"]
    assert written.camera("rear").matrix == (300.0, 300.0, 320.0, 240.0)
    assert written.gamma == 2.0
    assert written.priors.focal_px == pytest.approx(max(numbers["sigma_px"][:2]), abs=1e-3)
    assert file.read_text().startswith("# measured in the hall\n")
    assert numbers["rms_px"] < 0.15
    assert front.matrix == pytest.approx(BROWN[:4], abs=1.5)
    assert "held out" in out.err
    assert cv2.imread(str(png)).shape[1] > 1000


def test_a_picture_without_the_board_is_left_out_and_told(pictures, tmp_path, capsys):
    paths, board = pictures
    blank, file = tmp_path / "blank.png", tmp_path / "calibration.toml"
    assert cv2.imwrite(str(blank), np.full((480, 640), 90, np.uint8))
    asked = [*paths, str(blank), *board, "--model", "brown-conrady", "--camera", "front", "--calibration", str(file)]
    assert main(["calibrate", "camera", *asked]) == 0
    said = capsys.readouterr().err
    assert "blank.png: the board is not seen; it is left out" in said
    assert "10 pictures" in said


def test_every_useless_picture_is_named_at_once(tmp_path, capsys):
    blank, small, text = (str(tmp_path / name) for name in ("blank.png", "small.png", "text.png"))
    assert cv2.imwrite(blank, np.full((480, 640), 90, np.uint8))
    assert cv2.imwrite(small, np.zeros((240, 320), np.uint8))
    (tmp_path / "text.png").write_text("no picture")
    file = tmp_path / "calibration.toml"
    asked = [blank, small, text, str(tmp_path / "gone.png"), "--board", "9x6", "--square", "0.03", "--camera", "front"]
    assert main(["calibrate", "camera", *asked, "--calibration", str(file)]) == 2
    said = capsys.readouterr().err
    for words in ("blank.png: the board is not seen", "small.png: is 320x240", "text.png: cannot be read", "gone.png"):
        assert words in said, words
    assert main(["calibrate", "camera", "--camera", "front", "--calibration", str(file)]) == 2
    said = capsys.readouterr().err
    assert "no pictures given" in said
    assert "give --square" in said
    assert not file.exists()


def test_a_folder_of_the_robot_says_which_board_it_was(tmp_path, capsys):
    data = {
        "format": "robotd-calibration-data/1", "what": "camera", "camera": "front", "robot": "r",
        "board": {"columns": 9, "rows": 6, "square_m": 0.03},
        "pictures": [{"file": f"{k}.png", "camera": "front", "board_found": k < 3} for k in range(5)],
    }  # fmt: skip
    for k, (R, t, _) in enumerate(poses("brown-conrady", BROWN, 3, seed=4, tilt=0.6, near=0.2, far=0.5)):
        assert cv2.imwrite(str(tmp_path / f"{k}.png"), drawn(chessboard_texture(), 2000.0, R, t))
    (tmp_path / "data.json").write_text(json.dumps(data))
    asked = ["calibrate", "camera", str(tmp_path), "--calibration", str(tmp_path / "c.toml"), "--camera"]
    assert main([*asked, "front"]) == 1
    assert "3 different pictures; take 8" in capsys.readouterr().err
    assert main([*asked, "rear"]) == 2
    assert "pictures of camera front" in capsys.readouterr().err
    (tmp_path / "data.json").write_text("{}")
    assert main([*asked, "front"]) == 2
    assert "data.json: is not what" in capsys.readouterr().err


# ---- small boards in wide lenses, other boards than asked for, odd files ---------------------------------------------


@cache
def small_boards():
    """A board of 18 by 12 cm with fine markers, as boards were printed before OpenCV 4.6, in a lens of 180 degrees."""
    texture, half = charuco_texture(6, 4, 0.019, "DICT_6X6_250", 4000, legacy=True), [0.09, 0.06, 0.0]
    box = (np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0]]) * half,)
    scenes = poses("fisheye", FISHEYE, 12, seed=6, tilt=0.6, near=0.1, far=0.22, shapes=box)
    return [drawn(texture, 4000.0, R, t, k, "fisheye") for k, (R, t, _) in enumerate(scenes)]


def test_a_small_charuco_board_before_a_fisheye_is_found_and_the_lens_right(tmp_path):
    for k, image in enumerate(small_boards()):
        assert cv2.imwrite(str(tmp_path / f"{k:02d}.png"), image)
    (tmp_path / "notes.txt").write_text("taken in the hall")
    file = tmp_path / "calibration.toml"
    asked = [
        "--charuco",
        "6x4",
        "--square",
        "0.03",
        "--marker",
        "0.019",
        "--dictionary",
        "DICT_6X6_250",
        "--model",
        "fisheye",
    ]
    asked.append("--partial")
    assert main(["calibrate", "camera", str(tmp_path), *asked, "--camera", "front", "--calibration", str(file)]) == 0
    found = load_calibration(file).camera("front")
    assert found.model == "fisheye"
    assert found.matrix == pytest.approx(FISHEYE[:4], abs=0.5)
    v, u = np.mgrid[40:440:20, 100:540:20]
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    (a, _), (b, valid) = Camera(camera_model("fisheye", FISHEYE, SIZE)).rays(pixels), Camera(found).rays(pixels)
    assert valid.mean() > 0.9
    assert np.degrees(np.arccos(np.clip((a * b).sum(axis=1)[valid], -1.0, 1.0))).max() < 0.15


def test_a_board_at_the_side_of_a_lens_of_more_than_half_a_circle_has_a_pose():
    camera = Camera(camera_model("fisheye", FISHEYE, SIZE))
    side = rotation_matrix([0.0, math.radians(86.0), 0.0])
    X = POINTS[:, [1, 0, 2]] * 0.5 @ side.T + side[:, 2] * 0.3
    behind = X[:, 2] < 0.0
    assert 0 < behind.sum() < len(X)
    board = View("side", POINTS[:, [1, 0, 2]] * 0.5, camera.project(X)[0])
    start = fit_lens("fisheye", views("fisheye", FISHEYE, 8, noise=0.0), SIZE)
    assert pose_views(start, [board], SIZE).cost < 1e-6


def test_single_corners_in_the_wrong_place_are_left_out_and_counted():
    scene = [View(v.name, v.points, v.pixels.copy()) for v in views("brown-conrady", BROWN, 12)]
    for k, view in enumerate(scene[:5]):
        view.pixels[7 * k] += [6.0, -4.0]
    result = calibrate_lens(scene, SIZE, "front", ("brown-conrady",))
    assert result.left_out == 5
    assert result.rms_px == pytest.approx(0.1, rel=0.1)
    assert (np.abs(np.array(result.camera.matrix) - BROWN[:4]) < 3.5 * result.sigmas).all()
    assert calibrated("brown-conrady").left_out == 0


def test_a_corner_that_its_neighbours_expect_elsewhere_does_not_agree():
    pixels = POINTS[:, :2] @ np.array([[500.0, 80.0], [-60.0, 700.0]]) + [300.0, 200.0]
    assert agreeing(POINTS, pixels, 0.03).all()
    moved = pixels.copy()
    moved[20] += [14.0, 0.0]
    moved[21] -= [0.0, 16.0]
    assert np.flatnonzero(~agreeing(POINTS, moved, 0.03)).tolist() == [20, 21]


def hint(image, asked, tmp_path, capsys):
    assert cv2.imwrite(str(tmp_path / "one.png"), image)
    file = tmp_path / "calibration.toml"
    rest = ["--square", "0.03", "--camera", "front", "--calibration", str(file)]
    assert main(["calibrate", "camera", str(tmp_path), *asked, *rest]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("asked", ["10x7", "8x5"])
def test_a_chessboard_of_another_size_is_recognised(asked, tmp_path, capsys):
    (R, t, _) = poses("brown-conrady", BROWN, 1, seed=4, tilt=0.3, near=0.3, far=0.4)[0]
    assert "--board 9x6?" in hint(drawn(chessboard_texture(), 2000.0, R, t), ["--board", asked], tmp_path, capsys)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (["7x10"], "--charuco 10x7?"),
        (["9x6"], "--charuco 10x7?"),
        (["10x7", "--dictionary", "DICT_5X5_100"], "--dictionary DICT_4X4_50?"),
    ],
)
def test_a_charuco_board_of_another_size_or_dictionary_is_recognised(asked, words, tmp_path, capsys):
    (R, t, _) = poses("brown-conrady", BROWN, 1, seed=4, tilt=0.3, near=0.3, far=0.4)[0]
    assert words in hint(drawn(charuco_texture(), 2000.0, R, t), ["--charuco", *asked], tmp_path, capsys)


def test_a_charuco_board_is_told_from_a_chessboard(tmp_path, capsys):
    (R, t, _) = poses("brown-conrady", BROWN, 1, seed=4, tilt=0.3, near=0.3, far=0.4)[0]
    markers, plain = (drawn(one, 2000.0, R, t) for one in (charuco_texture(), chessboard_texture()))
    assert "--dictionary DICT_4X4_50?" in hint(markers, ["--board", "9x6"], tmp_path, capsys)
    assert "chessboard without markers, 9x6" in hint(plain, ["--charuco", "10x7"], tmp_path, capsys)


def test_pictures_of_twelve_bits_and_turned_ones_are_read_as_the_camera_delivered_them(tmp_path):
    grey = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (48, 1))
    assert cv2.imwrite(str(tmp_path / "deep.png"), grey.astype(np.uint16) * 16)
    read = _read(tmp_path / "deep.png")
    assert read.dtype == np.uint8
    assert np.abs(read.astype(int) - grey * (255.0 / 252.0)).max() <= 1.0
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"  # orientation 6: a quarter
    plain = cv2.imencode(".jpg", grey)[1].tobytes()
    (tmp_path / "turned.jpg").write_bytes(
        plain[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + plain[2:]
    )
    assert cv2.imread(str(tmp_path / "turned.jpg")).shape[:2] == (64, 48)
    assert _read(tmp_path / "turned.jpg").shape == (48, 64)


# ---- the file, MATLAB ------------------------------------------------------------------------------------------------


def test_an_element_of_an_array_is_changed_and_every_other_byte_stays():
    text = '# top\n[[cameras]]\nname = "a"\nf = 1 # old\n\n[[cameras]]  # 2\nname = "b"\nf = 2\n[cameras.deep]\nx = 1\n'
    changed = replace_element(text, "cameras", "b", {"f": "5", "g": "6"}, "c.toml")
    assert changed == text.replace("f = 2\n", "f = 5\ng = 6\n")
    assert replace_element(text, "cameras", "a", {"f": "3"}, "c.toml") == text.replace("f = 1", "f = 3")
    assert replace_element(text, "cameras", "c", {"f": "3"}, "c.toml").startswith(text)
    with pytest.raises(ConfigError, match=r"c.toml: cannot change cameras"):
        replace_element('cameras = [{name = "a"}]\n', "cameras", "a", {"f": "3"}, "c.toml")


MATLAB = {
    "RadialDistortion": [-0.3, 0.1, -0.015],
    "TangentialDistortion": [0.0005, -0.0004],
    "ImageSize": [480, 640],
    "IntrinsicMatrix": [[420.0, 0.0, 0.0], [0.0, 418.0, 0.0], [323.0, 239.0, 1.0]],
}


def test_matlabs_lens_is_ours_with_the_centre_one_pixel_less(tmp_path, capsys):
    fields = {name: np.array(value, dtype=float) for name, value in MATLAB.items()}
    savemat(tmp_path / "lens.mat", fields)
    savemat(tmp_path / "struct.mat", {"s": fields})
    (tmp_path / "lens.json").write_text(json.dumps(MATLAB))
    K = {**MATLAB, "K": np.array(MATLAB["IntrinsicMatrix"]).T.tolist()}
    del K["IntrinsicMatrix"]
    (tmp_path / "new.json").write_text(json.dumps({"cameraParams": K}))
    for name in ("lens.mat", "struct.mat", "lens.json", "new.json"):
        file = tmp_path / "calibration.toml"
        mount = calibration(file)
        asked = ["--matlab", str(tmp_path / name), "--camera", "front", "--calibration", str(file)]
        assert main(["calibrate", "camera", *asked]) == 0
        front = load_calibration(file).camera("front")
        assert front.matrix == pytest.approx((420.0, 418.0, 322.0, 238.0))
        assert front.distortion == pytest.approx((-0.3, 0.1, 0.0005, -0.0004, -0.015))
        assert front.size == SIZE
        assert front.T_robot_camera == mount
        assert "less one pixel" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ImageSize": []}, "give --size"),
        ({"RadialDistortion": [0.1]}, "RadialDistortion: found"),
        ({"RadialDistortion": "x"}, "RadialDistortion: found"),
        ({"IntrinsicMatrix": [[1.0]]}, "expected 3x3"),
        ({"IntrinsicMatrix": [[420.0, 0.0, 0.0], [2.0, 418.0, 0.0], [323.0, 239.0, 1.0]]}, "skew"),
        ({"IntrinsicMatrix": [[420.0, 0.0, 0.0], [0.0, 418.0, 0.0], [9e3, 239.0, 1.0]]}, "lies outside the picture"),
        ({"MappingCoefficients": [1.0, 0.0, 0.0, 0.0]}, "fisheye model"),
    ],
)
def test_what_matlab_says_and_we_cannot_is_refused(change, words):
    with pytest.raises(InputError, match=words):
        load_matlab(json.dumps({**MATLAB, **change}).encode(), "lens.json", "front")


def test_files_that_hold_no_lens_say_how_to_save_one():
    for data in (b"", b"MATLAB 5.0 MAT-file" + bytes(300), b"{", b"[1, 2]", b'{"a": 1}'):
        with pytest.raises(InputError, match=r"lens\.x"):
            load_matlab(data, "lens.x", "front")
    with pytest.raises(InputError, match="toStruct"):
        load_matlab(b'{"a": 1}', "lens.x", "front")
