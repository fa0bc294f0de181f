"""`robotd line`: pictures and JSON from images, videos and top views; what cannot be read is named."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from robotd.__main__ import main
from robotd.config import Calibration, save_calibration
from robotd.geometry.transforms import transform_matrix, transform_record
from robotd.records import CameraModel
from robotd.vision import figures
from robotd.vision.explain import explain
from robotd.vision.stroke import LineConfig, LineDetector
from robotd.vision.top_view import TopView

TAPE = "--color", "dark", "--width-px", "12,24"


def tape(at=150.0, slant=0.0, size=(240, 320), dark=40, floor=180):
    """A dark line 16 px wide, upright but for its slant, with noise."""
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(float)
    cover = np.clip(8.5 - np.abs(u - at - slant * (v - size[0] / 2)), 0.0, 1.0)
    grey = floor + (dark - floor) * cover + np.random.default_rng(1).normal(0.0, 2.0, size)
    return np.clip(np.rint(cv2.GaussianBlur(grey, (0, 0), 0.8)), 0, 255).astype(np.uint8)


def save(path, image):
    assert cv2.imwrite(str(path), image)
    return str(path)


def seen(capsys):
    return json.loads(capsys.readouterr().out)["images"]


def test_an_image_gives_its_lines_and_a_sheet_of_pictures(tmp_path, capsys):
    source = save(tmp_path / "floor.png", tape())
    assert main(["line", source, *TAPE, "--json", "--out", str(tmp_path / "out")]) == 0
    (result,) = seen(capsys)
    assert (result["source"], result["frame"], result["size"]) == (source, None, [320, 240])
    (line,) = result["lines"]
    assert line["width_px"] == pytest.approx(16.0, abs=0.3)
    assert np.abs(np.array(line["points_px"])[:, 0] - 150.0).max() < 0.3
    assert result["pictures"] == [str(tmp_path / "out" / "floor.png")]
    sheet = cv2.imread(result["pictures"][0])
    assert sheet.shape == (figures.HEAD + 2 * (figures.BAR + 420 + 8), 3 * (figures.PANEL + 8), 3)


def test_no_line_is_a_result(tmp_path, capsys):
    source = save(tmp_path / "bare.png", np.full((240, 320), 128, np.uint8))
    assert main(["line", source, *TAPE, "--json", "--compare", "--out", str(tmp_path)]) == 0
    assert seen(capsys)[0]["lines"] == []


def test_stages_and_the_comparison_are_pictures_of_their_own(tmp_path, capsys):
    source = save(tmp_path / "floor.png", tape())
    assert main(["line", source, *TAPE, "--separate", "--compare", "--out", str(tmp_path / "out")]) == 0
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    stages = ("picture", "gradient", "borders", "strokes", "width", "direction", "score", "clusters", "lines")
    assert names == sorted(
        ["floor.png", "floor.compare.png", *(f"floor.{k}_{stage}.png" for k, stage in enumerate(stages, start=1))]
    )
    assert "16.0 px wide" in capsys.readouterr().err


@pytest.mark.parametrize("dark", [40, 230])
def test_a_line_of_unknown_width_and_colour_gets_one_sheet_of_the_search_that_found_it(tmp_path, capsys, dark):
    source = save(tmp_path / "floor.png", tape(dark=dark, floor=130))
    assert main(["line", source, "--compare", "--json", "--out", str(tmp_path / "out")]) == 0
    (result,) = seen(capsys)
    assert [Path(name).name for name in result["pictures"]] == ["floor.png", "floor.compare.png"]
    assert len(result["lines"]) == 1
    detector = LineDetector(LineConfig("both"))
    every = explain(detector, tape(dark=dark, floor=130))
    assert len(every) >= 4
    best = figures.shown(every, detector.detect(tape(dark=dark, floor=130)))
    assert best.polarity == ("dark" if dark < 130 else "bright")
    assert best.width_px[0] < 16.0 < best.width_px[1]


def test_two_images_of_the_same_name_do_not_overwrite_each_other(tmp_path, capsys):
    sources = []
    for k in (1, 2):
        (tmp_path / str(k)).mkdir()
        sources.append(save(tmp_path / str(k) / "floor.png", tape(100.0 * k)))
    assert main(["line", *sources, *TAPE, "--json", "--out", str(tmp_path / "out")]) == 0
    assert len({name for result in seen(capsys) for name in result["pictures"]}) == 2


def test_frames_of_a_video_are_spread_over_it(tmp_path, capsys):
    source = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(source), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    for k in range(21):
        writer.write(cv2.cvtColor(tape(100.0 + 5.0 * k), cv2.COLOR_GRAY2BGR))
    writer.release()
    assert main(["line", str(source), *TAPE, "--frames", "3", "--json", "--out", str(tmp_path)]) == 0
    results = seen(capsys)
    assert [result["frame"] for result in results] == [0, 10, 20]
    for result in results:
        middle = np.array(result["lines"][0]["points_px"])[:, 0].mean()
        assert middle == pytest.approx(100.0 + 5.0 * result["frame"], abs=0.5)


def floor_camera(size=(320, 240)):
    """0.3 m above the floor, at the front, looking 45 degrees down."""
    s = 0.5**0.5
    pose = np.array([(0.0, -s, s, 0.15), (-1.0, 0.0, 0.0, 0.0), (0.0, -s, -s, 0.3), (0.0, 0.0, 0.0, 1.0)])
    return CameraModel("floor", size, (250.0, 250.0, 160.0, 120.0), transform_record(pose))


def calibration(path, camera):
    save_calibration(Calibration(floor_camera=camera), path)
    return str(path)


def test_with_a_calibration_lines_are_in_metres_of_the_robot(tmp_path, capsys):
    camera = floor_camera()
    file = calibration(tmp_path / "calibration.toml", camera)
    view = TopView(camera)
    # what the camera sees of a dark strip of 6 cm along y = 0.1: every pixel's ray is cut with the floor
    v, u = np.mgrid[0:240, 0:320].astype(float)
    T = transform_matrix(camera.T_robot_camera)
    rays = np.stack([(u - 160.0) / 250.0, (v - 120.0) / 250.0, np.ones_like(u)], axis=-1) @ T[:3, :3].T
    y = T[1, 3] - T[2, 3] / np.minimum(rays[..., 2], -1e-6) * rays[..., 1]
    image = np.where(np.abs(y - 0.1) < 0.03, 40, 180).astype(np.uint8)
    source = save(tmp_path / "ahead.png", image)
    asked = ["line", source, "--color", "dark", "--width-px", "12,24", "--calibration", file, "--json"]
    assert main([*asked, "--compare", "--out", str(tmp_path / "out")]) == 0
    (result,) = seen(capsys)
    assert result["size"] == [view.valid.shape[1], view.valid.shape[0]]
    points = np.array(result["lines"][0]["points_m"])
    assert np.abs(points[:, 1] - 0.1).max() < 0.005
    assert result["lines"][0]["width_px"] * view.metres_per_pixel == pytest.approx(0.06, abs=0.004)


def test_every_unusable_source_is_named_at_once(tmp_path, capsys):
    good = save(tmp_path / "floor.png", tape())
    asked = [good, str(tmp_path / "gone.jpg"), str(tmp_path), "/dev/video97", "98"]
    assert main(["line", *asked, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"{tmp_path / 'gone.jpg'}: there is no such file" in said
    assert f"{tmp_path}: is a folder; expected images or videos" in said
    assert "camera /dev/video97: there is no /dev/video97" in said
    assert "camera 98: there is no /dev/video98" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"no picture at all", b"\x89PNG\r\n\x1a\n cut short"])
def test_a_file_that_is_no_picture_is_named(tmp_path, capsys, content):
    (tmp_path / "notes.png").write_bytes(content)
    assert main(["line", str(tmp_path / "notes.png"), "--out", str(tmp_path / "out")]) == 2
    assert f"{tmp_path / 'notes.png'}: is neither an image nor a video" in capsys.readouterr().err


def test_a_device_that_is_no_camera_is_a_fault(tmp_path, capsys):
    assert main(["line", "/dev/null", "--out", str(tmp_path)]) == 1
    assert "camera /dev/null: /dev/null cannot be opened" in capsys.readouterr().err


def test_calibrations_that_do_not_fit_are_named(tmp_path, capsys):
    source = save(tmp_path / "floor.png", tape())
    without = calibration(tmp_path / "without.toml", None)
    assert main(["line", source, "--calibration", without, "--out", str(tmp_path)]) == 2
    assert "without.toml: has no [floor_camera]" in capsys.readouterr().err
    larger = calibration(tmp_path / "larger.toml", floor_camera((640, 480)))
    assert main(["line", source, "--calibration", larger, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "floor.png: does not fit" in said
    assert "640x480" in said
    assert main(["line", source, "--calibration", str(tmp_path / "gone.toml"), "--out", str(tmp_path)]) == 2
    assert "gone.toml" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["12", "30,12", "a,b", "0,5", "nan,3", "1,inf"])
def test_a_wrong_width_is_refused(text, capsys):
    with pytest.raises(SystemExit) as error:
        main(["line", "floor.png", "--width-px", text])
    assert error.value.code == 2
    assert "--width-px" in capsys.readouterr().err


# ---- what is drawn ---------------------------------------------------------------------------------------------------


def test_the_stages_agree_with_the_line():
    image = tape(150.0, slant=0.3)
    (stage,) = explain(LineDetector(LineConfig("dark", (12.0, 24.0))), image)
    away = stage.centres[:, 0] - 150.0 - 0.3 * (stage.centres[:, 1] - 120.0)
    assert len(stage.strokes) > 200
    assert np.percentile(np.abs(away), 95) < 1.0
    assert np.median(stage.widths) == pytest.approx(16.0 / np.hypot(1.0, 0.3), abs=0.5)
    assert np.mean(stage.labels == 0) > 0.9
    assert np.median(stage.score) > 0.6
    assert ((stage.score >= 0.0) & (stage.score <= 1.0)).all()
    assert stage.magnitude.max() > stage.threshold > 0.0
    ends = np.vstack([stage.strokes[:, :2], stage.strokes[:, 2:]])
    nearest = np.array([np.hypot(*(stage.edges[:, :2] - end).T).min() for end in ends])
    assert np.percentile(nearest, 95) < 1.0  # strokes end on edges


def test_an_empty_picture_can_be_explained_and_drawn():
    for size in ((240, 320), (9, 9)):
        image = np.full(size, 100, np.uint8)
        for stage in explain(LineDetector(LineConfig("both", (3.0, 6.0))), image):
            assert len(stage.strokes) == len(stage.score) == len(stage.labels) == 0
            assert len(figures.stages(image, None, stage, [], 0.5)) == 9
    assert explain(LineDetector(), np.zeros((5, 5), np.uint8)) == []


def test_pictures_hatch_what_is_out_of_sight_and_show_all_else():
    image = tape()
    valid = np.ones(image.shape, bool)
    valid[:, :80] = False
    (stage,) = explain(LineDetector(LineConfig("dark", (12.0, 24.0))), image, valid)
    pictures = figures.stages(image, valid, stage, [], 0.5)
    assert {picture.shape for picture in pictures.values()} == {(figures.BAR + 420, figures.PANEL, 3)}
    for picture in pictures.values():
        assert set(np.unique(picture[figures.BAR : -40, : figures.PANEL // 4 - 8])) <= {45, 85}


def test_the_comparison_shows_what_each_method_marks():
    image = tape()
    lines = LineDetector(LineConfig("dark", (12.0, 24.0))).detect(image)
    beside = figures.rivals(image, None, lines, 0.5, dark=True, least_length=40.0)
    assert list(beside) == ["picture", "lines", "fixed threshold", "Otsu threshold", "Canny + Hough", "LSD"]
    orange = np.array(figures.ORANGE)
    for name in ("fixed threshold", "Otsu threshold"):
        marked = (beside[name][figures.BAR :] == orange).all(axis=2).mean()
        assert marked == pytest.approx(16.0 / 320.0, abs=0.01), name
    for name in ("Canny + Hough", "LSD"):
        columns = (
            np.flatnonzero((beside[name][figures.BAR :] == orange).all(axis=2).any(axis=0)) / figures.PANEL * 320.0
        )
        assert np.abs(np.abs(columns - 150.0) - 8.0).max() < 3.0, name  # the borders
