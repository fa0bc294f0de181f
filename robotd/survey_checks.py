"""What must hold in a survey or a map beyond its types: every check adds sentences, none stops at the first mistake."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from . import sighting_columns
from .bind import describe
from .errors import InputError
from .records import CameraModel, Map, MappedLabel, Matrix3, Rig, RoofCamera, Stop, Survey

T = TypeVar("T")

DISTORTION_LENGTHS = {"brown-conrady": (4, 5, 8), "fisheye": (4,)}  # the coefficient counts OpenCV takes
ROUNDING = 1e-6  # relative to the largest entry; a covariance printed with seven digits passes


# beyond these a number is of another unit: no robot is as large, no floor as steep, no store as long
FARTHEST_ON_ROBOT_M = 5.0
FARTHEST_LABEL_M = 2000.0
HIGHEST_LABEL_M = 50.0
LONGEST_MOVE_M = 500.0
WIDEST_PRIOR = {"tilt_rad": 0.5, "camera_rotation_rad": 1.0, "camera_translation_m": 2.0, "beacon_m": 1.0}
LOWEST_CAMERA_M, WIDEST_ROBOT_M, FINEST_KNOWN_M = 0.005, 1.0, 1e-4  # beyond these a map says what it was told
CAREFUL_PRIOR = {"tilt_rad": 0.1, "camera_rotation_rad": 0.2, "camera_translation_m": 0.1, "odometry_scale": 0.5}
FARTHEST_M = 1e8  # of any coordinate: maps of countries are smaller, and its square is a number still
FULL_TURN = 2.0 * np.pi + 1e-9
METRES, RADIANS = "metres; are these millimetres?", "radians; are these degrees?"
SHORTEST_FOCAL = 0.02  # of the image's width: wider than any lens


class Problems:
    """Sentences about one file, each with the path of the value in it."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.found: list[str] = []

    def add(self, path: str, text: str) -> None:
        self.found.append(f"{self.where} {path}: {text}")

    def raise_if_any(self) -> None:
        if self.found:
            raise InputError(*self.found)


def check_header(parts: Mapping[str, Any], problems: Problems) -> None:
    """Check what a survey says besides its stops; `parts` holds those fields of Survey that could be read."""
    if parts.get("survey") == "":
        problems.add("survey", "found an empty text; expected the survey's name")
    if parts.get("created") is not None:
        _date(parts["created"], "created", problems)
    if (sigmas := parts.get("sigmas")) is not None:
        _above_zero(sigmas.pixel_px, "sigmas.pixel_px", problems)
        _above_zero(sigmas.roof_px, "sigmas.roof_px", problems)
    if (priors := parts.get("priors")) is not None:
        if abs(priors.odometry_correlation) > 1:
            problems.add("priors.odometry_correlation", f"found {priors.odometry_correlation:g}; expected -1 to 1")
        for name in priors.__dataclass_fields__:
            if name != "odometry_correlation" and getattr(priors, name) < 0:
                problems.add(f"priors.{name}", f"found {getattr(priors, name):g}; expected 0 (held fixed) or more")
    if (rig := parts.get("rig")) is not None:
        if not rig.cameras:
            problems.add("rig.cameras", "found none; expected at least one camera")
        _unique([camera.name for camera in rig.cameras], "rig.cameras", "name", problems)
        for index, camera in enumerate(rig.cameras):
            _camera(camera, f"rig.cameras[{index}]", problems)
    known = [item for item in parts.get("known_labels") or () if item is not None]
    _unique([item.label for item in known], "known_labels", "label", problems)
    for index, item in enumerate(parts.get("known_labels") or ()):
        if item is not None:
            _above_zero(item.sigma_m, f"known_labels[{index}].sigma_m", problems)
    roofs = [roof for roof in parts.get("roof_cameras") or () if roof is not None]
    _unique([roof.name for roof in roofs], "roof_cameras", "name", problems)
    for index, roof in enumerate(parts.get("roof_cameras") or ()):
        if roof is not None:
            _size(roof.size, f"roof_cameras[{index}].size", problems)
            if np.linalg.matrix_rank(_scaled(roof.H_world_image)[0]) < 3:
                problems.add(f"roof_cameras[{index}].H_world_image", "is singular; expected an invertible homography")
            check_roof(roof, f"roof_cameras[{index}]", problems)


def check_roof(roof: RoofCamera, path: str, problems: Problems) -> None:
    """Check the covariance of a homography."""
    rows = roof.covariance
    if rows is None:
        return
    if len(rows) != 9 or any(len(row) != 9 for row in rows):
        problems.add(f"{path}.covariance", "expected 9 rows of 9 numbers")
        return
    values = np.array(rows)
    if not np.isfinite(values).all():
        problems.add(f"{path}.covariance", "found a number that is not finite")
    elif not np.linalg.eigvalsh(values)[0] >= -1e-6 * np.abs(values).max():
        problems.add(f"{path}.covariance", "is not positive semidefinite")


def check_units(survey: Survey, problems: Problems) -> None:
    """Name what is finite but of another unit than expected: millimetres, degrees, coordinates in image widths.

    Not asked of every file, because records may be passed on as they are; a map needs them to be right.
    """
    for index, camera in enumerate(survey.rig.cameras):
        path = f"rig.cameras[{index}]"
        mount = camera.T_robot_camera
        _within(
            max(map(abs, mount.translation)),
            FARTHEST_ON_ROBOT_M,
            f"{path}.T_robot_camera.translation",
            METRES,
            problems,
        )
        turn = sum(value * value for value in mount.rotation) ** 0.5
        _within(turn, FULL_TURN, f"{path}.T_robot_camera.rotation", RADIANS, problems)
        if _is_size(camera.size) and 0.0 < camera.matrix[0] < SHORTEST_FOCAL * camera.size[0]:
            problems.add(f"{path}.matrix", f"found a focal length of {camera.matrix[0]:g}; expected pixels")
    for name, place in survey.rig.beacons.items():
        _within(max(map(abs, place)), FARTHEST_ON_ROBOT_M, f"rig.beacons.{name}", METRES, problems)
    for name, most in WIDEST_PRIOR.items():
        unit = METRES if name.endswith("_m") else RADIANS
        _within(getattr(survey.priors, name), most, f"priors.{name}", unit, problems)
    for index, known in enumerate(survey.known_labels):
        x, y, z = map(abs, known.position)
        _within(max(x, y), FARTHEST_LABEL_M, f"known_labels[{index}].position", METRES, problems)
        _within(z, HIGHEST_LABEL_M, f"known_labels[{index}].position[2]", METRES, problems)
    for index, stop in enumerate(survey.stops):
        if stop.move is not None:
            path = f"stops[{index}].move (leg {stop.leg} stop {stop.stop})"
            _within(max(abs(stop.move.dx), abs(stop.move.dy)), LONGEST_MOVE_M, f"{path}.dx, dy", METRES, problems)
            _within(abs(stop.move.dheading), FULL_TURN, f"{path}.dheading", RADIANS, problems)
            if stop.move.by_errors is not None:
                largest = max(abs(value) for row in stop.move.by_errors for value in row)
                _within(largest, LONGEST_MOVE_M, f"{path}.by_errors", METRES, problems)


def oddities(survey: Survey) -> list[str]:
    """Sentences on what is possible, and so seldom meant that a map should say it: heights, places, ids, exactness."""
    found, cameras, priors = [], survey.rig.cameras, survey.priors
    low = [c.name for c in cameras if c.T_robot_camera.translation[2] <= LOWEST_CAMERA_M]
    if low:
        found.append(
            f"camera {', '.join(low)} stands on the floor or below it (T_robot_camera.translation[2]); labels' heights "
            "count from the floor only if the cameras' do"
        )
    aside = [c.name for c in cameras if np.hypot(*c.T_robot_camera.translation[:2]) > WIDEST_ROBOT_M]
    if aside:
        found.append(
            f"camera {', '.join(aside)} stands more than {WIDEST_ROBOT_M:g} m from the robot's middle: metres?"
        )
    for name, most in CAREFUL_PRIOR.items():
        if (value := getattr(priors, name)) > most:
            found.append(f"priors.{name} is {value:g}, more than {most:g}, which hardly holds anything: another unit?")
    exact = [k.label for k in survey.known_labels if k.sigma_m < FINEST_KNOWN_M]
    if exact:
        found.append(
            f"sigma_m of known label {_some(exact)} is below {1e3 * FINEST_KNOWN_M:g} mm, which nobody measures; is it "
            "squared, or in another unit?"
        )
    alike: dict[str, set[str]] = {}
    for label in {s.label for stop in survey.stops for s in stop.sightings} | {k.label for k in survey.known_labels}:
        alike.setdefault("".join(label.split()).casefold(), set()).add(label)
    several = [names for names in alike.values() if len(names) > 1]
    # where both are seen from one stop, ids that differ in case are of different labels
    together = any(
        sum(name in seen for name in names) > 1
        for seen in ({s.label for s in stop.sightings} for stop in (survey.stops if several else ()))
        for names in several
    )
    twice = sorted(" and ".join(repr(name) for name in sorted(names)) for names in several)
    if twice and not together:
        found.append(f"labels {_some(twice)} differ only in case or spaces; if they are the same, write them alike")
    return found


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def check_positions(result: Map, problems: Problems) -> None:
    """Name positions too far away to compute with; the file may hold any number."""
    for index, label in enumerate(result.labels):
        for axis, value in enumerate(label.position or ()):
            _within(abs(value), FARTHEST_M, f"labels[{index}].position[{axis}]", METRES, problems)


def _within(value: float, most: float, path: str, unit: str, problems: Problems) -> None:
    if value > most:
        problems.add(path, f"found {value:g}; expected up to {most:g} {unit}")


def check_stops(
    stops: Iterable[Stop | None] | None, rig: Rig | None, roofs: Iterable[RoofCamera | None] | None, problems: Problems
) -> None:
    """Check the stops among themselves and each by itself; a stop that could not be read is None."""
    stops = tuple(stops or ())
    suspect = _suspects(stops, rig)
    last: dict[int, int] = {}
    complete = True  # until a stop could not be read: after it nobody knows which is the first of its leg
    for index, stop in enumerate(stops):
        path = f"stops[{index}]"
        if stop is None:
            complete = False
            continue
        before = last.get(stop.leg)
        if before is not None and stop.stop <= before:
            text = "twice" if stop.stop == before else f"after stop {before}"
            problems.add(f"{path}.stop", f"leg {stop.leg} has stop {stop.stop} {text}; expected increasing numbers")
        if before is None and stop.motions and complete:
            problems.add(f"{path}.motions", f"is the first stop of leg {stop.leg}; expected none")
        if before is None and stop.move is not None and complete:
            problems.add(f"{path}.move", f"is the first stop of leg {stop.leg}; expected null")
        if before is not None and stop.move is None:
            mend = "expected the move since the stop before it, or another leg"
            problems.add(f"{path}.move", f"found null at stop {stop.stop} of leg {stop.leg}; {mend}")
        last[stop.leg] = max(stop.stop, before or 0)
        check_stop(stop, f"{path}.", rig, roofs, problems, sightings=bool(suspect[index]))


def _suspects(stops: tuple[Stop | None, ...], rig: Rig | None) -> NDArray[np.bool_]:
    """(S,) stops whose sightings must be looked at one by one.

    All sightings are checked at once first, because a large survey has a hundred thousand of them.
    """
    suspect = np.ones(len(stops), dtype=np.bool_)
    if rig is None or any(stop is None or None in stop.sightings for stop in stops):
        return suspect
    everything = [s for stop in stops if stop is not None for s in stop.sightings]
    numbers = {camera.name: k for k, camera in enumerate(rig.cameras)}
    camera, labels, (u, v, sigma, probability) = sighting_columns.read(everything, numbers, 1.0)
    named = np.fromiter(map(bool, labels), np.bool_, len(labels))
    good = (camera >= 0) & named & (sigma > 0.0) & (probability >= 0.0) & (probability <= 1.0)
    limits = np.array([_limits(model) for model in rig.cameras]).reshape(-1, 4)
    if len(limits):
        low_u, high_u, low_v, high_v = limits[camera].T
        good &= (low_u <= u) & (u <= high_u) & (low_v <= v) & (v <= high_v)
    owner = np.repeat(np.arange(len(stops)), [len(stop.sightings) if stop is not None else 0 for stop in stops])
    return np.bincount(owner[~good], minlength=len(stops)) > 0


def check_stop(
    stop: Stop,
    path: str,
    rig: Rig | None,
    roofs: Iterable[RoofCamera | None] | None,
    problems: Problems,
    sightings: bool = True,
) -> None:
    """Check one stop; `path` starts the paths of its values, e.g. `stops[3].`; without `rig` names are not compared.

    `sightings` False leaves out those of labels, which are known to be right.
    """
    for name in ("leg", "stop"):
        if not 1 <= getattr(stop, name) < 2**31:
            problems.add(f"{path}{name}", f"found {describe(getattr(stop, name))}; expected a number from 1")
    _date(stop.time, f"{path}time", problems)
    if stop.move is not None:
        _covariance(stop.move.covariance, f"{path}move.covariance", problems)
    for index, motion in _bound(stop.motions):
        if not motion.source:
            problems.add(f"{path}motions[{index}].source", "found an empty text; expected the sensor's name")
        _covariance(motion.information, f"{path}motions[{index}].information", problems, "an information matrix")
    cameras = {camera.name: camera for camera in rig.cameras} if rig else None
    for index, sighting in _bound(stop.sightings if sightings else ()):
        where = f"{path}sightings[{index}]"
        if not sighting.label:
            problems.add(f"{where}.label", "found an empty text; expected the label's id")
        if sighting.sigma_px is not None:
            _above_zero(sighting.sigma_px, f"{where}.sigma_px", problems)
        if sighting.probability is not None and not 0 <= sighting.probability <= 1:
            problems.add(f"{where}.probability", f"found {sighting.probability:g}; expected 0 to 1")
        if cameras is not None and _exists(sighting.camera, cameras, f"{where}.camera", "camera of the rig", problems):
            camera = cameras[sighting.camera]
            _inside(sighting.u, sighting.v, camera.size, _slack(camera), where, problems)
    known = {roof.name: roof for roof in roofs if roof is not None} if roofs is not None else None
    for index, beacon in _bound(stop.beacon_sightings):
        where = f"{path}beacon_sightings[{index}]"
        if beacon.sigma_px is not None:
            _above_zero(beacon.sigma_px, f"{where}.sigma_px", problems)
        if rig is not None:
            _exists(beacon.beacon, rig.beacons, f"{where}.beacon", "beacon of the rig", problems)
        if known is not None and _exists(beacon.roof_camera, known, f"{where}.roof_camera", "roof camera", problems):
            _inside(beacon.u, beacon.v, known[beacon.roof_camera].size, 1.0, where, problems)


def _bound(items: Iterable[T | None]) -> Iterator[tuple[int, T]]:
    """Index and item of those that could be read; the others are reported already."""
    return ((index, item) for index, item in enumerate(items) if item is not None)


def check_map(parts: Mapping[str, Any], problems: Problems) -> None:
    """Check a map; `parts` holds those fields of Map that could be read."""
    labels = parts.get("labels") or ()
    _unique([label.label for label in labels if label is not None], "labels", "label", problems)
    for index, label in enumerate(labels):
        if label is not None:
            _mapped_label(label, f"labels[{index}]", problems)
    seen: set[tuple[int, int]] = set()
    for index, stop in enumerate(parts.get("stops") or ()):
        if stop is None:
            continue
        if (stop.leg, stop.stop) in seen:
            problems.add(f"stops[{index}]", f"leg {stop.leg} stop {stop.stop} is given more than once; keep one")
        seen.add((stop.leg, stop.stop))
        _covariance(stop.covariance, f"stops[{index}].covariance", problems)
    for index, sighting in enumerate(parts.get("sightings") or ()):
        if sighting is not None and not 0 <= sighting.weight <= 1:
            problems.add(f"sightings[{index}].weight", f"found {sighting.weight:g}; expected 0 to 1")
    for name in ("cost", "rms_px"):
        if parts.get(name, 0.0) < 0:
            problems.add(name, f"found {parts[name]:g}; expected 0 or more")


def _mapped_label(label: MappedLabel, path: str, problems: Problems) -> None:
    if label.status in ("placed", "known") and label.position is None:
        problems.add(f"{path}.position", f"found null for a label that is {label.status}; expected x, y, z in metres")
    if label.status == "unplaced" and label.position is not None:
        problems.add(f"{path}.position", "found a position for a label that is unplaced; expected null")
    if label.covariance is not None:
        _covariance(label.covariance, f"{path}.covariance", problems)
    for name in ("sightings", "inliers"):
        if getattr(label, name) < 0:
            problems.add(f"{path}.{name}", f"found {getattr(label, name)}; expected 0 or more")


def _camera(camera: CameraModel, path: str, problems: Problems) -> None:
    _size(camera.size, f"{path}.size", problems)
    for index in range(2):
        _above_zero(camera.matrix[index], f"{path}.matrix[{index}]", problems)
    lengths = DISTORTION_LENGTHS[camera.model]
    if len(camera.distortion) not in lengths:
        expected = ", ".join(map(str, lengths[:-1])) + (" or " if lengths[1:] else "") + str(lengths[-1])
        found = len(camera.distortion)
        problems.add(f"{path}.distortion", f"found {found} coefficients; expected {expected} for {camera.model}")
    if camera.valid_radius_px is not None:
        _above_zero(camera.valid_radius_px, f"{path}.valid_radius_px", problems)


def _size(size: tuple[int, int], path: str, problems: Problems) -> None:
    if not _is_size(size):
        problems.add(path, f"found {describe(list(size))}; expected width and height, 1 to 65535 pixels")


def _is_size(size: tuple[int, int]) -> bool:
    return all(1 <= length <= 65535 for length in size)


def _above_zero(value: float, path: str, problems: Problems) -> None:
    if value <= 0:
        problems.add(path, f"found {value:g}; expected above 0")


def _unique(names: list[str], path: str, key: str, problems: Problems) -> None:
    seen: set[str] = set()
    twice = {name for name in names if name in seen or seen.add(name)}  # type: ignore[func-returns-value]
    for name in sorted(twice):
        problems.add(path, f"{key} '{name}' is given {names.count(name)} times; keep one")
    if "" in names:
        problems.add(path, f"found an empty {key}; expected a text")


def _exists(name: str, known: Mapping[str, Any], path: str, what: str, problems: Problems) -> bool:
    if name in known:
        return True
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    expected = f"expected one of {', '.join(sorted(known))}" if known else "there is none in this survey"
    problems.add(path, f"'{name[:60]}' is no {what}; {hint}{expected}")
    return False


def _slack(camera: CameraModel) -> float:
    """By what share of the image a pixel may lie outside of it: undistorted pixels of a wide lens do by far."""
    return 0.25 if any(camera.distortion) else 1.0


def _limits(camera: CameraModel) -> tuple[float, float, float, float]:
    """Lowest and highest u, then v; none for a camera whose size was refused already."""
    if not _is_size(camera.size):
        return (-np.inf, np.inf, -np.inf, np.inf)
    (low_u, high_u), (low_v, high_v) = (_range(length, _slack(camera)) for length in camera.size)
    return (low_u, high_u, low_v, high_v)


def _range(length: int, slack: float) -> tuple[float, float]:
    return -0.5 - slack * length, length - 0.5 + slack * length


def _inside(u: float, v: float, size: tuple[int, int], slack: float, path: str, problems: Problems) -> None:
    if not _is_size(size):
        return  # named already
    for name, value, length, extent in (("u", u, size[0], "wide"), ("v", v, size[1], "high")):
        low, high = _range(length, slack)
        if not low <= value <= high:
            expected = f"{low:g} to {high:g}, as the image is {length} px {extent}"
            problems.add(f"{path}.{name}", f"found {value:g}; expected {expected}")


def _date(text: str, path: str, problems: Problems) -> None:
    try:
        datetime.fromisoformat(text)
    except ValueError:
        problems.add(path, f"found '{text[:60]}'; expected a date such as 2026-11-21T10:01:12Z")


def _scaled(rows: Matrix3) -> tuple[NDArray[np.float64], float]:
    """The matrix divided by its largest entry, and that entry (1 for zeros)."""
    matrix = np.array(rows, dtype=np.float64)
    scale = float(np.abs(matrix).max()) or 1.0
    return matrix / scale, scale


def _covariance(rows: Matrix3, path: str, problems: Problems, what: str = "a covariance") -> None:
    """Symmetric and positive semi-definite, within rounding."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    if b == d and c == g and f == h and a > 0.0 and a * e > b * b:
        determinant = a * (e * i - f * f) - b * (b * i - f * c) + c * (b * f - e * c)
        if determinant > 1e-9 * a * e * i > 0.0:
            return  # positive definite by its leading minors (Sylvester), clearly enough for rounding not to matter
    matrix, scale = _scaled(rows)
    if np.abs(matrix - matrix.T).max() > ROUNDING:
        problems.add(path, f"is not symmetric; expected {what}")
    elif (smallest := np.linalg.eigvalsh(matrix)[0]) < -ROUNDING:
        problems.add(path, f"has the negative eigenvalue {smallest * scale:g}; expected {what}")
