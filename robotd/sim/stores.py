"""Store layouts (`robotd-store/1`): what a store looks like, read strictly, and the tape's geometry.

Metres in store axes: x right and y up on the plan, z up, origin at a corner of the floor. A layout says where things
are; how noisy the world is, is in `robotd.sim.world.WorldSettings`. Disturbances that a file leaves out (lamps,
walkers, a blinker) are added by `robotd.sim.disturbances` unless the file says `disturbances = false`.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import math
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..bind import bind
from ..config import collect, read_toml
from ..errors import ConfigError
from ..records import Vector3
from .disturbances import with_disturbances
from .layout import (
    Blinker,
    Floor,
    LabelLayout,
    Lamp,
    LineLayout,
    MeasuredLabel,
    Mirror,
    RoofCameraLayout,
    Shelf,
    StoreLayout,
    Tape,
    Walker,
    Wall,
)
from .line import LineGeometry, distance_to_box, distance_to_segment

__all__ = [
    "Blinker",
    "Floor",
    "LabelLayout",
    "Lamp",
    "LineLayout",
    "MeasuredLabel",
    "Mirror",
    "RoofCameraLayout",
    "Shelf",
    "StoreLayout",
    "Walker",
    "Wall",
    "find_store",
    "load_store",
]

T = TypeVar("T")

LINE_CLEARANCE = 0.25  # m between the tape's centre and walls or shelves, robotd-store/1


RENAME = {"from": "start", "to": "end"}  # keys of the file that are Python keywords or read badly as attributes


def find_store(name_or_path: str) -> Path:
    """The file of a layout: a shipped one by its bare name (`room`, `warehouse`), or any path.

    Raises
    ------
    ConfigError
        No such file; the message names the shipped layouts.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or path.parent != Path("."):
        return path
    shipped = {candidate.stem: candidate for candidate in _shipped()}
    if name_or_path in shipped:
        return shipped[name_or_path]
    if path.is_file():
        return path
    names = ", ".join(sorted(shipped)) or "none"
    raise ConfigError(f"{name_or_path}: no such store; expected one of {names}, or the path of a layout file")


def _shipped() -> Iterator[Path]:
    """The layouts that come with robotd: in the installation, or in the clone that this file is part of."""
    try:
        files = importlib.metadata.files("robotd") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.parent.parts[-3:] == ("robotd", "etc", "stores") and file.suffix == ".toml":
            yield Path(str(file.locate())).resolve()
    yield from sorted((Path(__file__).resolve().parents[2] / "etc" / "stores").glob("*.toml"))


def load_store(path: Path | str) -> StoreLayout:
    """Read a layout, check all that robotd-store/1 demands and add the default disturbances.

    Normals are returned with length 1 and `floor.image` relative to the layout's own folder.

    Raises
    ------
    ConfigError
        Lists every mistake with file, table, index, key, what was found and what is expected.
    """
    path = Path(path)
    data = read_toml(path)
    problems: list[str] = []
    layout = collect(problems, lambda: bind(StoreLayout, data, str(path), rename=RENAME))
    problems.extend(_Checks(data, path).problems)
    if layout is None or problems:
        raise ConfigError(*problems)
    labels = tuple(dataclasses.replace(label, normal=_unit(label.normal)) for label in layout.labels)
    blinkers = tuple(
        dataclasses.replace(blinker, normal=blinker.normal and _unit(blinker.normal)) for blinker in layout.blinkers
    )
    floor = dataclasses.replace(layout.floor, image=layout.floor.image and path.parent / layout.floor.image)
    return with_disturbances(dataclasses.replace(layout, labels=labels, blinkers=blinkers, floor=floor))


def _unit(vector: Vector3) -> Vector3:
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length, vector[2] / length


class _Checks:
    """What types cannot say. Runs on those parts of the file that could be read, so that one run finds all mistakes."""

    def __init__(self, data: dict[str, Any], path: Path) -> None:
        self.data = data
        self.path = path
        self.problems: list[str] = []
        self.size = self._part(tuple[float, float], data.get("size"))
        self.shelves = self._parts("shelves", Shelf)
        self.walls = self._parts("walls", Wall)
        self.labels = self._parts("labels", LabelLayout)
        self.mirrors = self._parts("mirrors", Mirror)
        line = self._part(LineLayout, data.get("line"))
        self._check_areas()
        self._check_labels()
        self._check_others()
        self._check_tapes()
        if line is not None:
            self._check_line(line)

    def _part(self, cls: Any, data: Any) -> Any:
        holder = dataclasses.make_dataclass("Holder", [("part", cls)], frozen=True)
        try:
            return typing.cast(Any, bind(holder, {"part": data}, "", rename=RENAME)).part
        except ConfigError:
            return None

    def _parts(self, table: str, cls: Callable[..., T]) -> list[tuple[int, T]]:
        entries = self.data.get(table)
        parts = [
            (index, self._part(cls, entry)) for index, entry in enumerate(entries if isinstance(entries, list) else [])
        ]
        return [(index, part) for index, part in parts if part is not None]

    def _problem(self, key: str, found: Any, expected: str) -> None:
        text = list(found) if isinstance(found, tuple) else found
        self.problems.append(f"{self.path} {key}: found {text!r}; expected {expected}")

    def _check_areas(self) -> None:
        if self.size is not None and min(self.size) <= 0:
            self._problem("size", self.size, "a width and a depth above 0")
            self.size = None
        for index, shelf in self.shelves:
            x0, y0, x1, y1 = shelf.box
            if x0 >= x1 or y0 >= y1:
                self._problem(f"shelves[{index}].box", shelf.box, "[x0, y0, x1, y1] with x0 < x1 and y0 < y1")
        self.shelves = [
            (index, item) for index, item in self.shelves if item.box[0] < item.box[2] and item.box[1] < item.box[3]
        ]
        for table, items in (("walls", self.walls), ("mirrors", self.mirrors)):
            for index, item in items:
                if math.dist(item.start, item.end) < 1e-6:
                    self._problem(f"{table}[{index}].to", item.end, "another point than 'from'")
        for index, mirror in self.mirrors:
            if mirror.bottom >= mirror.top:
                self._problem(f"mirrors[{index}].top", mirror.top, f"more than bottom = {mirror.bottom:g}")

    def _check_labels(self) -> None:
        first: dict[str, int] = {}
        for index, label in self.labels:
            key = f"labels[{index}]"
            if label.id in first:
                self._problem(f"{key}.id", label.id, f"an id of its own; labels[{first[label.id]}] has it too")
            elif not label.id:
                self._problem(f"{key}.id", label.id, "a text that is not empty")
            first.setdefault(label.id, index)
            x, y, z = label.position
            if self.size is not None and not (0 <= x <= self.size[0] and 0 <= y <= self.size[1] and z >= 0):
                wanted = f"a point over the floor, x 0 to {self.size[0]:g}, y 0 to {self.size[1]:g}, z at least 0"
                self._problem(f"{key}.position", label.position, wanted)
            for shelf_index, shelf in self.shelves:
                x0, y0, x1, y1 = shelf.box
                if x0 < x < x1 and y0 < y < y1 and z < shelf.height:
                    wanted = f"a point outside every shelf; it is inside shelves[{shelf_index}]"
                    self._problem(f"{key}.position", label.position, wanted)
            if math.hypot(*label.normal) < 1e-6:
                self._problem(f"{key}.normal", label.normal, "a direction, not all zero")

    def _check_others(self) -> None:
        ids = {label.id for _, label in self.labels}
        known: set[str] = set()
        for index, label in self._parts("known_labels", MeasuredLabel):
            if label.id not in ids:
                self._problem(f"known_labels[{index}].id", label.id, "the id of a label in this file")
            elif label.id in known:
                self._problem(f"known_labels[{index}].id", label.id, "every label once")
            known.add(label.id)
        for index, walker in self._parts("walkers", Walker):
            if not walker.path:
                self._problem(f"walkers[{index}].path", walker.path, "at least one point")
        for index, blinker in self._parts("blinkers", Blinker):
            if blinker.normal is not None and math.hypot(*blinker.normal) < 1e-6:
                self._problem(f"blinkers[{index}].normal", blinker.normal, "a direction, not all zero")
        names: set[str] = set()
        for index, camera in self._parts("roof_cameras", RoofCameraLayout):
            if camera.name in names:
                self._problem(f"roof_cameras[{index}].name", camera.name, "a name of its own")
            names.add(camera.name)
            if math.dist(camera.position, camera.target) < 1e-6:
                self._problem(f"roof_cameras[{index}].target", camera.target, "another point than 'position'")
            if min(camera.size) < 16:
                self._problem(f"roof_cameras[{index}].size", camera.size, "a width and height of at least 16 pixels")
        floor = self._part(Floor, self.data.get("floor", {}))
        if floor is not None and floor.image is not None and not (self.path.parent / floor.image).is_file():
            self._problem("floor.image", str(floor.image), f"an image file in {self.path.parent} or an absolute path")

    def _check_tapes(self) -> None:
        for index, tape in self._parts("tapes", Tape):
            try:
                LineGeometry(tape.points, closed=tape.closed, corner_radius=tape.corner_radius)
            except ConfigError as error:
                self.problems.extend(f"{self.path} tapes[{index}].{problem}" for problem in error.problems)

    def _check_line(self, line: LineLayout) -> None:
        if self.size is not None:
            for index, (x, y) in enumerate(line.points):
                if not (0 <= x <= self.size[0] and 0 <= y <= self.size[1]):
                    self._problem(
                        f"line.points[{index}]",
                        (x, y),
                        f"a point on the floor, x 0 to {self.size[0]:g}, y 0 to {self.size[1]:g}",
                    )
        try:
            geometry = LineGeometry(line.points, closed=line.closed, corner_radius=line.corner_radius)
        except ConfigError as error:
            self.problems.extend(f"{self.path} line.{problem}" for problem in error.problems)
            return
        self._check_stops(line, geometry.length)
        path = geometry.points
        for index, wall in self.walls:
            self._check_clearance(f"walls[{index}]", path, distance_to_segment(path, wall.start, wall.end))
        for index, shelf in self.shelves:
            self._check_clearance(f"shelves[{index}]", path, distance_to_box(path, shelf.box))

    def _check_stops(self, line: LineLayout, length: float) -> None:
        if not line.stops:
            self._problem("line.stops", line.stops, "at least one arc length; the robot starts at the first")
        for index, (start, gap) in enumerate(line.gaps):
            if gap <= 0.0 or start < 0.0 or start + gap > length:
                self._problem(f"line.gaps[{index}]", (start, gap), f"a piece of the line, 0 to {length:.3f} m")
        for index, stop in enumerate(line.stops):
            if index and stop <= line.stops[index - 1]:
                self._problem(f"line.stops[{index}]", stop, f"more than stops[{index - 1}] = {line.stops[index - 1]:g}")
            if not (0 <= stop <= length):
                self._problem(f"line.stops[{index}]", stop, f"an arc length on the line, 0 to {length:.3f} m")

    def _check_clearance(self, what: str, path: Any, distances: Any) -> None:
        nearest = int(np.argmin(distances))
        if distances[nearest] < LINE_CLEARANCE - 1e-6:
            x, y = path[nearest]
            self._problem(
                "line.points",
                round(float(distances[nearest]), 3),
                f"at least {LINE_CLEARANCE} m between the line and {what}; the line is too near at ({x:.2f}, {y:.2f})",
            )
