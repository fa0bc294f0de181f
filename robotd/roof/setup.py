"""`roof.toml`, which an operator writes, and `roof-calibration.toml`, which `robotd-solver calibrate roof` writes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..bind import bind, ranged
from ..config import collect, read_toml
from ..errors import ConfigError
from ..files import write_atomic
from ..geometry.homography import Homography
from ..records import CameraModel, Floats, Matrix3, Transform, Vector3
from ..toml_edit import assignments
from ..vision.beacon import BeaconConfig

NO_POSE = Transform((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class RoofSettings:
    """[roof]: where sightings and calibrations are kept, and what is known of every robot's beacons.

    `data` is the folder that `robotd-solver serve` has as --data. `beacons` are their places on the robot in metres (x
    ahead, y to the left, z up), as in the robot's calibration.
    """

    data: Path = Path("/var/lib/robotd-solver")
    calibration: Path = Path("roof-calibration.toml")
    beacons: dict[str, Vector3] = field(default_factory=lambda: {"front": (0.1, 0.0, 0.65), "rear": (-0.1, 0.0, 0.65)})
    guard_s: float = ranged(60.0, minimum=5.0, maximum=86400.0)

    def __post_init__(self) -> None:
        if set(self.beacons) != {"front", "rear"}:
            raise ValueError(f"beacons: found {', '.join(sorted(self.beacons)) or 'none'}; expected front and rear")
        front, rear = (np.array(self.beacons[name]) for name in ("front", "rear"))
        if abs(front[2] - rear[2]) > 0.01:
            raise ValueError("beacons: front and rear are at different heights; expected one plane")
        if np.linalg.norm(front - rear) < 0.05:
            raise ValueError("beacons: front and rear are less than 0.05 m apart; they would show no heading")

    @property
    def height(self) -> float:
        """Of the plane of the beacons above the floor, in metres."""
        return self.beacons["front"][2]

    @property
    def spacing(self) -> float:
        """Metres from front to rear."""
        return float(np.linalg.norm(np.subtract(self.beacons["front"], self.beacons["rear"])))


@dataclass(frozen=True, slots=True)
class RoofSetup:
    """The whole of roof.toml; `drivers` holds the raw sections, one for each camera."""

    roof: RoofSettings = field(default_factory=RoofSettings)
    detector: BeaconConfig = field(default_factory=BeaconConfig)
    drivers: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RoofCalibration:
    """[[cameras]] of roof-calibration.toml: one roof camera's view of the beacons' plane.

    `H_world_image` takes undistorted pixels to world x, y at `height` metres; `covariance` (9 x 9) is that of the
    inverse's numbers at unit norm (robotd.geometry.homography). `matrix`, `model` and `distortion` are the lens's, as
    in a survey. `position` is the camera's in the world, where that was found.
    """

    name: str
    size: tuple[int, int]
    matrix: tuple[float, float, float, float]
    H_world_image: Matrix3
    covariance: tuple[tuple[float, ...], ...]
    height: float
    model: Literal["brown-conrady", "fisheye"] = "brown-conrady"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position: Vector3 | None = None
    note: str = ""

    def __post_init__(self) -> None:
        if len(self.covariance) != 9 or any(len(row) != 9 for row in self.covariance):
            raise ValueError("covariance: expected 9 rows of 9 numbers")
        if np.linalg.matrix_rank(np.array(self.H_world_image) / np.abs(self.H_world_image).max()) < 3:
            raise ValueError("H_world_image: is singular; expected an invertible homography")

    @property
    def lens(self) -> CameraModel:
        """The lens, without a pose."""
        return CameraModel(self.name, self.size, self.matrix, NO_POSE, self.model, self.distortion)

    @property
    def homography(self) -> Homography:
        """From the plane of the beacons to undistorted pixels."""
        matrix = np.linalg.inv(np.array(self.H_world_image))
        matrix /= np.linalg.norm(matrix)
        return Homography(matrix, np.array(self.covariance))

    @property
    def digest(self) -> str:
        """Names this calibration: another one of the same camera has another digest."""
        text = repr((self.size, self.matrix, self.model, self.distortion, self.H_world_image, self.height))
        return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class _CalibrationFile:
    cameras: tuple[RoofCalibration, ...] = ()


def load_setup(path: Path) -> RoofSetup:
    """Read roof.toml; relative paths in it are relative to its folder. Raises ConfigError listing every mistake."""
    problems: list[str] = []
    data = read_toml(path)
    setup = collect(problems, lambda: bind(RoofSetup, data, str(path)))
    for name, section in (data.get("drivers") or {}).items() if isinstance(data.get("drivers"), Mapping) else ():
        if isinstance(section, Mapping) and not isinstance(section.get("driver"), str):
            problems.append(f"{path} [drivers.{name}]: missing key 'driver'; expected \"mjpeg\" or another camera's")
    if setup is not None and not setup.drivers:
        problems.append(f"{path} [drivers]: there is no roof camera; expected a section [drivers.NAME] for each")
    if problems or setup is None:
        raise ConfigError(*problems)
    roof = replace(setup.roof, data=path.parent / setup.roof.data, calibration=path.parent / setup.roof.calibration)
    return replace(setup, roof=roof)


def load_calibrations(path: Path) -> dict[str, RoofCalibration]:
    """Read roof-calibration.toml, by the cameras' names; none if there is no such file. Raises ConfigError."""
    if not path.exists():
        return {}
    cameras = bind(_CalibrationFile, read_toml(path), str(path)).cameras
    names = [camera.name for camera in cameras]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path} cameras: {', '.join(twice)} defined more than once; expected every name once")
    return {camera.name: camera for camera in cameras}


def save_calibration(calibration: RoofCalibration, path: Path) -> None:
    """Put one camera's calibration into roof-calibration.toml; the others stay. Replaces the file atomically."""
    cameras = load_calibrations(path) | {calibration.name: calibration}
    lines = ["# written by robotd-solver calibrate roof"]
    for camera in cameras.values():
        lines += ["", "[[cameras]]", *(f"{key} = {value}" for key, value in assignments(camera).items())]
    write_atomic(path, ("\n".join(lines) + "\n").encode())


def matrix3(values: Floats) -> Matrix3:
    """A (3, 3) array as a record holds it."""
    a, b, c = (tuple(float(value) for value in row) for row in values)
    return (a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2])
