"""What a store consists of: the tables of `robotd-store/1` as records, in metres and store axes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ..bind import ranged
from ..records import Vector3
from .line import LineGeometry, Point

Texture = Literal["carpet", "wood", "concrete", "tiles", "asphalt"]


@dataclass(frozen=True, slots=True)
class Floor:
    """[floor]: a procedural texture, or an image laid from the origin and repeated."""

    texture: Texture = "concrete"
    image: Path | None = None
    metres_per_pixel: float = ranged(0.002, minimum=0.0001, maximum=0.1)


@dataclass(frozen=True, slots=True)
class LineLayout:
    """[line]: the tape; `stops` are arc lengths from the first point, `gaps` (arc length, length) where it is torn."""

    points: tuple[Point, ...]
    stops: tuple[float, ...]
    width: float = ranged(0.050, minimum=0.005, maximum=0.3)
    color: Literal["dark", "bright"] = "dark"
    closed: bool = False
    corner_radius: float = ranged(0.0, minimum=0.0, maximum=10.0)
    gaps: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class Tape:
    """[[tapes]]: more tape like the line's, which is not to be followed: crossings, branches, a line beside it."""

    points: tuple[Point, ...]
    width: float = ranged(0.050, minimum=0.005, maximum=0.3)
    closed: bool = False
    corner_radius: float = ranged(0.0, minimum=0.0, maximum=10.0)


@dataclass(frozen=True, slots=True)
class Mark:
    """[[marks]]: a square or a dot of the line's tape, `size` across, turned by `heading` radians."""

    position: Point
    size: float = ranged(0.050, minimum=0.005, maximum=0.3)
    shape: Literal["square", "dot"] = "square"
    heading: float = ranged(0.0, minimum=-6.3, maximum=6.3)


@dataclass(frozen=True, slots=True)
class Wall:
    """[[walls]]: a vertical sheet from the floor to `height`; both faces are visible."""

    start: Point
    end: Point
    height: float = ranged(2.4, minimum=0.01, maximum=20.0)
    texture: str = "plaster"


@dataclass(frozen=True, slots=True)
class Shelf:
    """[[shelves]]: a solid `box` x0, y0, x1, y1 from the floor to `height`."""

    box: tuple[float, float, float, float]
    height: float = ranged(minimum=0.01, maximum=20.0)


@dataclass(frozen=True, slots=True)
class LabelLayout:
    """[[labels]]: an LED at `position` that shines along the unit vector `normal`."""

    id: str
    position: Vector3
    normal: Vector3
    brightness: float = ranged(1.0, minimum=0.0, maximum=10.0)


@dataclass(frozen=True, slots=True)
class Mirror:
    """[[mirrors]]: vertical glass between two points, from `bottom` to `top`; reflects from both sides."""

    start: Point
    end: Point
    bottom: float = ranged(minimum=0.0, maximum=20.0)
    top: float = ranged(minimum=0.0, maximum=20.0)
    reflectivity: float = ranged(minimum=0.0, maximum=1.0)


@dataclass(frozen=True, slots=True)
class Lamp:
    """[[lamps]]: a lamp whose light swings by `flicker` at `frequency` (twice the mains')."""

    position: Vector3
    brightness: float = ranged(1.0, minimum=0.0, maximum=10.0)
    frequency: float = ranged(100.0, minimum=0.0, maximum=1000.0)
    flicker: float = ranged(0.1, minimum=0.0, maximum=1.0)


@dataclass(frozen=True, slots=True)
class Walker:
    """[[walkers]]: a person, an upright cylinder, who walks along `path` and back for ever."""

    path: tuple[Point, ...]
    speed: float = ranged(1.0, minimum=0.0, maximum=5.0)
    height: float = ranged(1.75, minimum=0.1, maximum=3.0)
    radius: float = ranged(0.2, minimum=0.05, maximum=1.0)


@dataclass(frozen=True, slots=True)
class Blinker:
    """[[blinkers]]: a light that is no label; without a `normal` it shines to all sides."""

    position: Vector3
    frequency: float = ranged(2.0, minimum=0.0, maximum=100.0)
    duty: float = ranged(0.5, minimum=0.0, maximum=1.0)
    brightness: float = ranged(1.0, minimum=0.0, maximum=10.0)
    normal: Vector3 | None = None


@dataclass(frozen=True, slots=True)
class RoofCameraLayout:
    """[[roof_cameras]]: a camera under the ceiling that looks at `target`."""

    name: str
    position: Vector3
    target: Vector3
    hfov_deg: float = ranged(90.0, minimum=10.0, maximum=160.0)
    size: tuple[int, int] = (640, 480)


@dataclass(frozen=True, slots=True)
class MeasuredLabel:
    """[[known_labels]]: a label whose position the operator measured, `sigma` metres per axis."""

    id: str
    sigma: float = ranged(0.005, minimum=0.0, maximum=1.0)


@dataclass(frozen=True, slots=True)
class StoreLayout:
    """The whole file; `size` is the floor's width (x) and depth (y)."""

    format: Literal["robotd-store/1"]
    name: str
    size: tuple[float, float]
    line: LineLayout
    floor: Floor = field(default_factory=Floor)
    tapes: tuple[Tape, ...] = ()
    marks: tuple[Mark, ...] = ()
    walls: tuple[Wall, ...] = ()
    shelves: tuple[Shelf, ...] = ()
    labels: tuple[LabelLayout, ...] = ()
    mirrors: tuple[Mirror, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    walkers: tuple[Walker, ...] = ()
    blinkers: tuple[Blinker, ...] = ()
    roof_cameras: tuple[RoofCameraLayout, ...] = ()
    known_labels: tuple[MeasuredLabel, ...] = ()
    disturbances: bool = True

    @property
    def geometry(self) -> LineGeometry:
        """The tape's centre line."""
        return LineGeometry(self.line.points, closed=self.line.closed, corner_radius=self.line.corner_radius)
