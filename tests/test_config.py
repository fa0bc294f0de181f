from pathlib import Path

import pytest

from robotd.config import Calibration, Wheels, load_calibration, load_config, save_calibration
from robotd.errors import ConfigError
from robotd.records import CameraModel, Priors, Transform


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "robotd.toml"
    path.write_text(text)
    return path


def test_every_mistake_of_a_configuration_is_named_at_once(tmp_path):
    path = write(
        tmp_path,
        """
[robot]
nmae = "x"
[mission]
stops = [0.0, 2.0, 1.0]
[safety]
max_speed = 0.5
[drivers]
loose = 3
[drivers.front]
device = "/dev/video0"
""",
    )
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    text = "\n".join(caught.value.problems)
    for expected in (
        f"{path} robot: unknown key 'nmae'; did you mean 'name'?",
        f"{path} mission: stops = [0.0, 2.0, 1.0]; expected increasing distances",
        f"{path} safety.max_speed: found 0.5; expected 0 to 0.3",
        f"{path} drivers.loose: expected a section [drivers.loose]",
        f"{path} [drivers.front]: missing key 'driver'",
    ):
        assert expected in text


def test_a_missing_file_a_wrong_syntax_and_a_wrong_encoding_name_the_file_and_place(tmp_path):
    with pytest.raises(ConfigError, match=r"absent.toml: no such file"):
        load_config(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match=r"robotd.toml: not valid TOML: .*line 2, column"):
        load_config(write(tmp_path, "[robot]\nname = = 3"))
    (tmp_path / "latin.toml").write_bytes(b'name = "caf\xe9"')
    with pytest.raises(ConfigError, match="not UTF-8 at byte 11"):
        load_config(tmp_path / "latin.toml")


def test_a_label_listed_twice_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="labels: A1 listed more than once"):
        load_config(write(tmp_path, '[mission]\nlabels = ["A1", "B2", "A1"]'))


def test_a_calibration_survives_the_file_to_the_last_bit(tmp_path):
    camera = CameraModel(
        "front", (640, 480), (268.5 + 1e-13, 268.5, 319.5, 239.5), Transform((0.1, -1 / 3, 0.0), (0.06, 0, 0.5))
    )
    calibration = Calibration(
        stamp_offsets={"front": 0.0421, "floor cam": -0.003},
        wheels=Wheels(scale_left=1.003, base=0.2351),
        cameras=(camera,),
        floor_camera=camera,
        beacons={"front": (0.1, 0.0, 0.65)},
        priors=Priors(tilt_rad=0.3 / 57),
    )
    save_calibration(calibration, tmp_path / "calibration.toml")
    assert load_calibration(tmp_path / "calibration.toml") == calibration


def test_surveys_carry_what_the_wheels_calibration_left_and_that_floors_are_not_flat():
    priors = Calibration(priors=Priors(camera_rotation_rad=0.001)).survey_priors
    assert priors.odometry_scale == pytest.approx(0.003)
    assert priors.odometry_turn == pytest.approx(0.003 * 2.0**0.5)
    assert priors.odometry_correlation == pytest.approx(0.5**0.5)
    assert (priors.odometry_drift, priors.camera_rotation_rad) == (0.0, 0.001)
    assert priors.tilt_rad == pytest.approx(0.0052, abs=1e-4)
    given = Priors(tilt_rad=0.01, odometry_scale=0.001)
    assert Calibration(priors=given).survey_priors == given


def test_cameras_must_have_different_names(tmp_path):
    camera = CameraModel("front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((0, 0, 0), (0, 0, 0)))
    save_calibration(Calibration(cameras=(camera, camera)), tmp_path / "calibration.toml")
    with pytest.raises(ConfigError, match="front defined more than once"):
        load_calibration(tmp_path / "calibration.toml")
