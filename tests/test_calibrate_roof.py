"""`robotd-solver calibrate roof`: the beacons' plane from measured points, as sure as it says, or what is missing."""

import json

import cv2
import numpy as np
import pytest

from robotd.config import Calibration, save_calibration
from robotd.errors import InputError, SolverError
from robotd.roof.setup import load_calibrations
from robotd.solver.calibrate_roof import RoofPoint, calibrate_roof
from robotd.solver_main import main
from tests.roof_view import BENT, HEIGHT, View

PLACES = np.array(
    [[-0.7, -0.4], [0.4, -0.6], [1.4, -0.3], [-0.6, 0.5], [0.5, 0.4], [1.5, 0.7], [-0.3, 1.2], [0.7, 1.4]]
)


def points_of(view, places=PLACES, z=0.0, pixel=0.0, metre=0.0, seed=1):
    rng = np.random.default_rng(seed)
    world = np.column_stack([places, np.broadcast_to(z, len(places))])
    seen = view.see(world) + rng.normal(0.0, 1.0, (len(world), 2)) * pixel
    world[:, :2] += rng.normal(0.0, 1.0, (len(world), 2)) * metre
    return [RoofPoint(*uv, *xyz, max(metre, 1e-4)) for uv, xyz in zip(seen, world, strict=True)]


def error_of(view, result, at=((0.2, 0.3), (1.2, -0.2))):
    """World error of the beacons' plane in metres, and its squares over the covariance."""
    true = np.array(at)
    seen = view.see(np.column_stack([true, np.full(len(true), HEIGHT)]))
    from robotd.solver.calibrate_roof import undistorted

    points, spread = result.homography.to_plane(undistorted(seen, view.model)[0])
    miss = points - true
    return miss, [float(m @ np.linalg.solve(s + 1e-18 * np.eye(2), m)) for m, s in zip(miss, spread, strict=True)]


@pytest.mark.parametrize("distortion", [(0.0,) * 5, BENT])
def test_exact_points_on_the_floor_and_a_known_lens_give_the_plane_above_it(distortion):
    view = View(distortion=distortion)
    result = calibrate_roof(points_of(view), view.model, HEIGHT, lens_known=True, sigma_px=0.01)
    miss, _ = error_of(view, result)
    assert np.abs(miss).max() < 1e-4
    assert np.allclose(result.position, view.pose[:3, 3], atol=1e-3)


def test_floor_points_alone_would_be_off_by_the_parallax():
    view = View()
    floor = calibrate_roof(points_of(view), view.model, 0.0, lens_known=False)
    miss, _ = error_of(view, floor)
    assert np.linalg.norm(miss, axis=1).min() > 0.3, "this is what calibrating on the floor plane would cost"


def test_four_points_at_the_beacons_height_need_nothing_else():
    view = View()
    result = calibrate_roof(points_of(view, PLACES[[0, 2, 5, 6]], HEIGHT), view.model, HEIGHT, lens_known=False)
    miss, _ = error_of(view, result)
    assert np.abs(miss).max() < 1e-6
    assert result.position is None


@pytest.mark.parametrize(
    ("lens_known", "camera", "z"),
    [
        (True, False, 0.0),
        (False, True, 0.0),
        (False, False, np.array([0.0, 0.0, 0.0, 0.0, 0.65, 0.65, 0.65, 0.65])),
        (False, False, HEIGHT),
    ],
)
def test_it_is_as_wrong_as_it_says(lens_known, camera, z):
    view = View()
    squares, chi2 = [], []
    for seed in range(8):
        points = points_of(view, z=z, pixel=0.5, metre=0.004, seed=seed)
        place = tuple(view.pose[:3, 3] + np.random.default_rng(seed).normal(0.0, 0.02, 3)) if camera else None
        result = calibrate_roof(points, view.model, HEIGHT, lens_known=lens_known, camera=place)
        squares += error_of(view, result)[1]
        chi2.append(result.chi2)
    assert 0.4 < np.mean(squares) < 4.5
    assert 0.5 < np.mean(chi2) < 1.6


def test_what_is_missing_is_named():
    above = View(eye=(0.3, 0.2, 2.6), target=(0.3, 0.21, 0.0))
    points = points_of(above, pixel=0.3, metre=0.002)
    with pytest.raises(
        SolverError, match=r"only known to \d+ mm .* on a stand, or the camera's lens .* or .* --camera"
    ):
        calibrate_roof(points, above.model, HEIGHT, lens_known=False)
    calibrate_roof(points, above.model, HEIGHT, lens_known=False, camera=(0.3, 0.2, 2.6))
    with pytest.raises(InputError, match="3 points; measure 4 or more"):
        calibrate_roof(points[:3], above.model, HEIGHT, lens_known=True)
    line = [RoofPoint(100.0 + 10 * k, 100.0 + 10 * k, 0.1 * k, 0.1 * k, HEIGHT) for k in range(6)]
    with pytest.raises(SolverError, match="one line"):
        calibrate_roof(line, above.model, HEIGHT, lens_known=True)


def test_a_point_that_was_mixed_up_is_named():
    view = View()
    points = points_of(view, pixel=0.3, metre=0.002)
    points[4] = RoofPoint(points[4].u + 25.0, points[4].v, points[4].x, points[4].y, points[4].z, 0.002)
    with pytest.raises(SolverError, match=r"contradict each other .* point 5 at"):
        calibrate_roof(points, view.model, HEIGHT, lens_known=True)
    outside = RoofPoint(900.0, 10.0, 0.0, 0.0, 0.0)
    with pytest.raises(InputError, match=r"point 9 at \(900, 10\) px is outside the picture of 640x480"):
        calibrate_roof([*points, outside], view.model, HEIGHT, lens_known=True)


def write_points(path, points):
    rows = [f"{p.u},{p.v},{p.x},{p.y},{p.z},{p.sigma_m}" for p in points]
    path.write_text("u,v,x,y,z,sigma\n" + "\n".join(rows) + "\n")


def test_the_command_writes_one_camera_and_leaves_the_others(tmp_path, capsys):
    view, other = View(), View("roof-2", eye=(2.5, 2.0, 2.6))
    target = tmp_path / "roof-calibration.toml"
    lens = tmp_path / "lens.toml"
    save_calibration(Calibration(cameras=(view.model, other.model)), lens)
    for one in (view, other):
        write_points(tmp_path / "points.csv", points_of(one, pixel=0.3, metre=0.003))
        picture = tmp_path / "view.jpg"
        cv2.imwrite(str(picture), np.full((480, 640), 120, np.uint8))
        code = main(
            ["calibrate", "roof", str(tmp_path / "points.csv"), "--name", one.model.name, "--height", "0.65"]
            + ["--picture", str(picture), "--lens", str(lens), "--calibration", str(target)]
            + ["--residuals", str(tmp_path / "residuals.png"), "--json"]
        )
        assert code == 0
    found = load_calibrations(target)
    assert set(found) == {"roof-1", "roof-2"}
    said = capsys.readouterr()
    assert json.loads(said.out.splitlines()[-1])["rms_px"] < 1.0
    assert "px rms" in said.err
    assert "camera at" in said.err
    assert cv2.imread(str(tmp_path / "residuals.png")).shape[1] > 500
    true = np.array([[0.4, 0.1]])
    seen = view.see(np.column_stack([true, [HEIGHT]]))
    assert np.abs(found["roof-1"].homography.to_plane(seen)[0] - true).max() < 0.02


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("a,b\n1,2\n", "found the header 'a,b'; expected u,v,x,y"),
        ("u,v,x,y\n1,2,3\n4,5,6,x\n", "point 1: found '1,2,3'; expected 4 numbers\n.*point 2"),
        ("u,v,x,y,sigma\n1,2,3,4,0\n", "point 1 sigma: found 0; expected above 0"),
        ("u,v,x,y\n1,2,3,nan\n", "point 1: expected finite numbers"),
    ],
)
def test_every_mistake_of_the_points_is_named(tmp_path, capsys, text, what):
    import re

    (tmp_path / "points.csv").write_text(text)
    arguments = [
        "calibrate",
        "roof",
        str(tmp_path / "points.csv"),
        "--name",
        "r",
        "--height",
        "0.6",
        "--size",
        "640x480",
    ]
    assert main([*arguments, "--calibration", str(tmp_path / "c.toml")]) == 2
    assert re.search(what, capsys.readouterr().err)
    assert not (tmp_path / "c.toml").exists()
