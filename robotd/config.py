"""The robot's configuration (`robotd.toml`) and calibration (`calibration.toml`), strict.

`etc/robotd.toml` explains every key. A driver's section is bound to that driver's own `Config` by `daemon.assemble`
before any device is opened.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from .bind import bind, ranged
from .errors import ConfigError, InputError
from .files import write_atomic
from .identify import IdentifyConfig
from .odometry import Wheels, odometry_priors
from .records import CameraModel, KnownLabel, Priors, Rig, Sigmas, Vector3
from .safety import SafetyLimits
from .toml_edit import assignments, replace_element, replace_table, toml

T = TypeVar("T")

FLOOR_TILT = math.radians(0.3)  # rad: slopes of shop floors under a robot, one sigma

_FINGERPRINT = re.compile("[0-9a-f]{64}")  # of SHA-256


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """[robot]"""

    name: str = "robot"
    state_directory: Path = Path("/var/lib/robotd")
    calibration: Path = Path("/var/lib/robotd/calibration.toml")
    guardian: Path = Path("/run/robotd-guardian/guardian.sock")
    control: Path = Path("/run/robotd/control.sock")
    serial_log: Path | None = None
    serial_log_mb: float = ranged(64.0, minimum=1.0, maximum=100000.0)


@dataclass(frozen=True, slots=True)
class Zone:
    """[[mission.zones]]: these labels can be seen only between two distances along the line, in metres."""

    labels: tuple[str, ...]
    begin: float
    end: float

    def __post_init__(self) -> None:
        if self.end < self.begin:
            raise ValueError(f"end = {self.end:g}; expected at least begin = {self.begin:g}")


@dataclass(frozen=True, slots=True)
class MissionConfig:
    """[mission]

    With `stop_at` "distances" the robot stops at `stops`, metres along the line; with "markers" where it starts, then
    at each square or dot beside the line, until the line ends or `marker_stops` stops are made. `camera_groups` are
    the rig's cameras that look at the same time, one group after the other; empty: all at once. `resume` says whether a
    mission whose process ended goes on by itself where nothing speaks against it, or waits for an operator. A `plan`
    of `robotd-solver plan` replaces `stops`, and names labels that are not asked at them.
    """

    survey: str = "store"
    stops: tuple[float, ...] = ()
    labels: tuple[str, ...] = ()
    known_labels: tuple[KnownLabel, ...] = ()
    settle_s: float = ranged(0.6, minimum=0.0, maximum=10.0)
    upload_wait_s: float = ranged(60.0, minimum=0.0)
    identify: IdentifyConfig = field(default_factory=IdentifyConfig)
    stop_at: Literal["distances", "markers"] = "distances"
    marker_stops: int = ranged(0, minimum=0, maximum=10000)
    mains_hz: Literal[50, 60] = 50
    camera_groups: tuple[tuple[str, ...], ...] = ()
    resume: Literal["ask", "auto"] = "ask"
    low_charge: float = ranged(0.10, minimum=0.0, maximum=1.0)
    enough_charge: float = ranged(0.25, minimum=0.0, maximum=1.0)
    low_voltage: float = ranged(12.5, minimum=0.0, maximum=30.0)
    enough_voltage: float = ranged(13.5, minimum=0.0, maximum=30.0)
    keep_free_mb: float = ranged(200.0, minimum=0.0, maximum=1e6)
    least_labels: int = ranged(1, minimum=0, maximum=10000)
    if_fewer: Literal["flag", "repeat"] = "flag"
    labels_from: Literal["config", "file", "server", "system"] = "config"
    labels_file: Path = Path("labels.txt")
    zones: tuple[Zone, ...] = ()
    plan: Path | None = None

    def __post_init__(self) -> None:
        if any(later <= earlier for earlier, later in zip(self.stops, self.stops[1:], strict=False)):
            raise ValueError(f"stops = {list(self.stops)}; expected increasing distances in metres")
        if self.stops and self.stops[0] < 0:
            raise ValueError(f"stops[0] = {self.stops[0]}; expected at least 0")
        for name in ("charge", "voltage"):
            low, enough = getattr(self, f"low_{name}"), getattr(self, f"enough_{name}")
            if enough < low:
                raise ValueError(f"enough_{name} = {enough:g}; expected at least low_{name} = {low:g}")
        if self.plan is not None and self.stop_at != "distances":
            raise ValueError(
                f"stop_at = '{self.stop_at}'; expected 'distances' with a plan, whose stops are along the line"
            )
        if self.stop_at == "markers" and not self.marker_stops:
            raise ValueError("marker_stops = 0; expected with stop_at = 'markers' how many stops to make at most")
        counts = Counter(self.labels)
        twice = sorted(label for label, count in counts.items() if count > 1)
        if twice:
            raise ValueError(f"labels: {', '.join(twice)} listed more than once; expected every id once")
        zoned = Counter(label for zone in self.zones for label in zone.labels)
        unknown = sorted(zoned.keys() - counts.keys())
        if self.labels_from != "config" and self.labels:
            raise ValueError(f"labels: expected none with labels_from = '{self.labels_from}'")
        if unknown and self.labels_from == "config":
            raise ValueError(f"zones: {', '.join(unknown[:5])} not among labels; expected ids that are listed there")
        if not all(self.camera_groups):
            raise ValueError("camera_groups: found an empty group; expected names of cameras in each")


@dataclass(frozen=True, slots=True)
class UploadConfig:
    """[upload]

    The server's certificate must be valid for the host in `url` and be signed by the system's authorities, or by those
    of `ca_file`; with `pins` (SHA-256 fingerprints) it must also be one of these.
    """

    url: str | None = None
    token_file: Path | None = None
    token_credential: str | None = None
    ca_file: Path | None = None
    pins: tuple[str, ...] = ()
    retry_s: float = ranged(5.0, minimum=0.1, maximum=3600.0)
    timeout_s: float = ranged(30.0, minimum=0.1, maximum=600.0)

    def __post_init__(self) -> None:
        pins = tuple(pin.replace(":", "").lower() for pin in self.pins)
        for k, pin in enumerate(pins):
            if not _FINGERPRINT.fullmatch(pin):
                raise ValueError(
                    f"pins[{k}] = '{self.pins[k]}'; expected 64 hexadecimal digits, as from "
                    "openssl x509 -in server.pem -noout -fingerprint -sha256"
                )
        object.__setattr__(self, "pins", pins)
        if (self.ca_file is not None or pins) and not (self.url or "").startswith("https:"):
            raise ValueError("ca_file, pins: there is no certificate with http; expected https in url")


@dataclass(frozen=True, slots=True)
class RecordingConfig:
    """[recording]"""

    directory: Path = Path("/var/lib/robotd/recordings")
    seconds: float = ranged(600.0, minimum=1.0, maximum=86400.0)
    limit_mb: float = ranged(2000.0, minimum=1.0, maximum=1e6)
    keep_free_mb: float = ranged(1000.0, minimum=0.0, maximum=1e6)
    raw: bool = False
    upload: bool = False
    delete_uploaded: bool = False


@dataclass(frozen=True, slots=True)
class Config:
    """The whole of robotd.toml; `drivers` holds the raw sections."""

    robot: RobotConfig = field(default_factory=RobotConfig)
    mission: MissionConfig = field(default_factory=MissionConfig)
    upload: UploadConfig = field(default_factory=UploadConfig)
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    safety: SafetyLimits = field(default_factory=SafetyLimits)
    drivers: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Calibration:
    """The whole of calibration.toml: what calibrations found, and how sure they were (`priors`).

    `stamp_offsets` is by how many seconds each camera's stamps are late.
    """

    wheels: Wheels = field(default_factory=Wheels)
    cameras: tuple[CameraModel, ...] = ()
    floor_camera: CameraModel | None = None
    beacons: dict[str, Vector3] = field(default_factory=dict)
    gamma: float = ranged(2.2, minimum=0.5, maximum=4.0)
    row_time_s: float = ranged(0.0, minimum=0.0, maximum=0.001)
    stamp_offsets: dict[str, float] = field(default_factory=dict)
    priors: Priors = field(default_factory=Priors)
    sigmas: Sigmas = field(default_factory=lambda: Sigmas(pixel_px=0.2))

    @property
    def survey_priors(self) -> Priors:
        """The priors as surveys carry them: what [priors] leaves out is what wheels and floors leave.

        A survey whose odometry were exact could not find its own size, and floors are not flat.
        """
        scale, turn, drift, correlation = odometry_priors(self.wheels)
        given = self.priors
        if not (given.odometry_scale or given.odometry_turn or given.odometry_drift):
            given = replace(
                given,
                odometry_scale=scale,
                odometry_turn=turn,
                odometry_drift=drift,
                odometry_correlation=correlation,
            )
        return given if given.tilt_rad else replace(given, tilt_rad=FLOOR_TILT)

    @property
    def rig(self) -> Rig:
        """The rig as surveys carry it."""
        return Rig(self.cameras, self.beacons)

    def camera(self, name: str) -> CameraModel:
        """One rig camera's model; raises KeyError."""
        return next(camera for camera in self.cameras if camera.name == name)


def read_toml(path: Path) -> dict[str, Any]:
    """Parse a TOML file; raises ConfigError that names the file, line and column."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; create it or name another one") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 at byte {error.start}; save the file as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {str(error)[:1].lower()}{str(error)[1:]}") from error


def load_config(path: Path) -> Config:
    """Read robotd.toml; relative paths in it are relative to its folder. Raises ConfigError listing every mistake."""
    problems: list[str] = []
    data = read_toml(path)
    for section, entry in (data.get("drivers") or {}).items() if isinstance(data.get("drivers"), dict) else ():
        if not isinstance(entry, dict):
            problems.append(f"{path} drivers.{section}: expected a section [drivers.{section}]")
        elif not isinstance(entry.get("driver"), str):
            problems.append(
                f"{path} [drivers.{section}]: missing key 'driver'; expected the name of an installed driver"
            )
    config = collect(problems, lambda: bind(Config, data, str(path)))
    if config is not None and None not in (config.upload.token_file, config.upload.token_credential):
        problems.append(f"{path} upload: found token_file and token_credential; expected one of them")
    if problems or config is None:
        raise ConfigError(*problems)
    return config


def load_calibration(path: Path) -> Calibration:
    """Read calibration.toml. Raises ConfigError listing every mistake."""
    calibration = bind(Calibration, read_toml(path), str(path))
    names = [camera.name for camera in calibration.cameras]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"{path} cameras: {', '.join(twice)} defined more than once; expected every name once")
    return calibration


def collect(problems: list[str], make: Callable[[], T]) -> T | None:
    """Call `make`; if it raises InputError append its problems and return None."""
    try:
        return make()
    except InputError as error:
        problems.extend(error.problems)
        return None


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write calibration.toml so that `load_calibration` reads the same values back; replaces the file atomically."""
    lines = [f"gamma = {calibration.gamma!r}", f"row_time_s = {calibration.row_time_s!r}"]
    for section in ("wheels", "priors", "sigmas"):
        lines += ["", f"[{section}]", *_lines(getattr(calibration, section))]
    lines += ["", "[beacons]", *(f"{toml(name)} = {toml(at)}" for name, at in calibration.beacons.items())]
    lines += ["", "[stamp_offsets]", *(f"{toml(name)} = {late!r}" for name, late in calibration.stamp_offsets.items())]
    for camera in calibration.cameras:
        lines += ["", "[[cameras]]", *_lines(camera)]
    if calibration.floor_camera is not None:
        lines += ["", "[floor_camera]", *_lines(calibration.floor_camera)]
    write_atomic(path, ("\n".join(lines) + "\n").encode())


def save_wheels(wheels: Wheels, path: Path, note: str | None = None) -> None:
    """Write [wheels] into calibration.toml, which need not exist; all else in it, comments too, stays as it was.

    `note` is added as a comment behind the file's other lines about wheels. Replaces the file atomically. Raises
    ConfigError if the file cannot be read, or its wheels cannot be edited.
    """
    text = _text(path)
    text = replace_table(text, "wheels", assignments(wheels), str(path))
    if note is not None:
        lines = text.splitlines()
        header = next(k for k, line in enumerate(lines) if line.replace(" ", "").startswith("[wheels]"))
        text = "\n".join([*lines[: header + 1], f"# {note}", *lines[header + 1 :]]) + "\n"
    _save(path, text)


def save_floor_camera(camera: CameraModel, path: Path, note: str) -> None:
    """Write [floor_camera] into calibration.toml, under a comment with `note`; all else in the file stays as it was.

    The file need not exist and is replaced atomically. Raises InputError if it cannot be read or edited.
    """
    text = _text(path)
    text = replace_table(text, "floor_camera", assignments(camera), str(path))
    _save(path, _noted(text, "floor_camera", note))


def save_lens(camera: CameraModel, path: Path, priors: Priors) -> None:
    """Write a camera's lens into calibration.toml; its pose and all else in the file stay as they were.

    The camera is [floor_camera] if that has its name, and otherwise one of [[cameras]], which is appended if it is new,
    with the given pose.

    Parameters
    ----------
    camera : CameraModel
    path : Path
        Need not exist; replaced atomically.
    priors : Priors
        `focal_px` and `centre_px` in the file are raised to these, because a lens that is held to better than it is
        known bends the map.

    Raises
    ------
    ConfigError
        If the file cannot be read or edited.
    """
    before = load_calibration(path) if path.exists() else Calibration()
    text = _text(path)
    values = assignments(camera)
    del values["name"]
    if camera.valid_radius_px is None:  # to the picture's farthest corner, because an older limit must not stay
        (width, height), (_, _, cx, cy) = camera.size, camera.matrix
        values["valid_radius_px"] = repr(math.ceil(math.hypot(max(cx, width - cx), max(cy, height - cy))))
    if before.floor_camera is not None and before.floor_camera.name == camera.name:
        del values["T_robot_camera"]
        text = replace_table(text, "floor_camera", values, str(path))
    else:
        if any(known.name == camera.name for known in before.cameras):
            del values["T_robot_camera"]
        text = replace_element(text, "cameras", camera.name, values, str(path))
        raised = {
            name: repr(value)
            for name in ("focal_px", "centre_px")
            if (value := getattr(priors, name)) > getattr(before.priors, name)
        }
        text = replace_table(text, "priors", raised, str(path)) if raised else text
    _save(path, text)


def save_rig(cameras: Sequence[CameraModel], path: Path, priors: Priors) -> None:
    """Write the cameras' poses into calibration.toml; their lenses and all else in the file stay as they were.

    Parameters
    ----------
    cameras : sequence of CameraModel
        One that the file lacks is added, with its lens.
    path : Path
        Need not exist; replaced atomically.
    priors : Priors
        `camera_rotation_rad` and `camera_translation_m` are set to these.

    Raises
    ------
    ConfigError
        If the file cannot be read or edited.
    """
    before = load_calibration(path) if path.exists() else Calibration()
    text = _text(path)
    known = {camera.name for camera in before.cameras}
    for camera in cameras:
        values = assignments(camera)
        del values["name"]
        kept = {"T_robot_camera": values["T_robot_camera"]} if camera.name in known else values
        text = replace_element(text, "cameras", camera.name, kept, str(path))
    names = ("camera_rotation_rad", "camera_translation_m")
    text = replace_table(text, "priors", {name: repr(getattr(priors, name)) for name in names}, str(path))
    _save(path, text)


def save_beacons(beacons: Mapping[str, Vector3], sigma: float, path: Path) -> None:
    """Write beacons' places (x, y, z) into calibration.toml, and their standard deviation into `[priors] beacon_m`.

    Those that are not given, and all else in the file, stay as they were. The file need not exist and is replaced
    atomically. Raises ConfigError if it cannot be read or edited.
    """
    text = replace_table(_text(path), "beacons", {name: toml(place) for name, place in beacons.items()}, str(path))
    text = replace_table(text, "priors", {"beacon_m": repr(float(f"{sigma:.2g}"))}, str(path))
    _save(path, text)


def save_stamp_offsets(offsets: Mapping[str, float], path: Path, note: str) -> None:
    """Write [stamp_offsets] into calibration.toml, which need not exist; all else in the file stays as it was.

    `note` becomes a comment in place of an earlier one of the same maker, which stands before its first colon. Replaces
    the file atomically. Raises ConfigError if the file cannot be read or edited.
    """
    text = _text(path)
    text = replace_table(
        text, "stamp_offsets", {name: repr(round(late, 5)) for name, late in offsets.items()}, str(path)
    )
    _save(path, _noted(text, "stamp_offsets", note))


def _noted(text: str, table: str, note: str) -> str:
    """The file with a note under a table's header, in place of an earlier one of the same maker."""
    maker = note.split(":")[0]
    lines = [line for line in text.splitlines() if not line.startswith(f"# {maker}:")]
    header = next(k for k, line in enumerate(lines) if line.replace(" ", "").startswith(f"[{table}]"))
    return "\n".join([*lines[: header + 1], f"# {note}", *lines[header + 1 :]]) + "\n"


def _lines(record: Any) -> list[str]:
    return [f"{key} = {value}" for key, value in assignments(record).items()]


def _text(path: Path) -> str:
    """What is in a file, "" if there is none; raises ConfigError if it is no TOML."""
    if not path.exists():
        return ""
    read_toml(path)
    return path.read_text(encoding="utf-8")


def _save(path: Path, text: str) -> None:
    """Put a calibration in place of the file, atomically; raises ConfigError if it would have mistakes."""
    bind(Calibration, tomllib.loads(text), str(path))
    write_atomic(path, text.encode())
