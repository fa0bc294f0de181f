"""The families of scenes: which shape lies on which floor, under which light, and what the camera makes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from . import light, paths
from .floors import FLOORS


@dataclass(frozen=True)
class Recipe:
    """How the scenes of a family are made; None means any of the mild ones."""

    shape: str | None = None  # in `paths.SHAPES`, or None for a bare floor
    floor: str | None = None
    light: str = "even"
    angle: float | None = None  # of the shape in degrees, to within 2
    width: tuple[float, float] = (0.025, 0.075)  # of the view's shorter side
    contrast: tuple[float, float] | None = None  # grey levels between tape and floor
    blur: tuple[float, float] = (0.4, 1.0)
    motion: tuple[float, float] = (0.0, 0.0)
    noise: tuple[float, float] = (1.0, 3.0)
    jpeg: tuple[int, int] | None = None
    exposure: tuple[float, float] = (1.0, 1.0)  # of the picture's brightness
    worn: float = 0.0  # how probable ragged edges, holes and dirt are
    pieced: float = 0.0  # how probable it is that corners are laid of pieces that overlap and stick out
    sheen: float = 0.0  # how probable it is that the tape mirrors a lamp, whatever the floor does
    markers: bool = False
    taper: tuple[float, float] = (1.0, 1.0)  # of widths, from the lower border to the upper: a tilted camera's own view
    top_view: bool = False


MILD = ("plain", "plain", "concrete", "wood", "terrazzo")
ANY = ("straight", "curve", "arc", "corner")

MIXED = Recipe(  # everything at once, as outside a laboratory
    floor="any", light="any", width=(0.025, 0.28), contrast=(35.0, 110.0), blur=(0.5, 1.8), motion=(0.0, 4.0),
    noise=(1.0, 7.0), jpeg=(30, 92), exposure=(0.45, 1.2), worn=0.25, sheen=0.2,
    pieced=0.4, taper=(0.55, 1.0),
)  # fmt: skip


def _families() -> dict[str, Recipe]:
    families = {f"shape/{name}": Recipe(name) for name in paths.SHAPES}
    families["shape/horizontal"] = Recipe("straight", angle=0.0)
    families["shape/upright_corner"] = Recipe("right_angle", angle=0.0)
    families["shape/close"] = Recipe("any", width=(0.12, 0.33))
    families["shape/thin"] = Recipe("any", width=(0.014, 0.02))
    families["shape/pieced"] = Recipe("corner", pieced=1.0, width=(0.04, 0.2))
    families["shape/markers"] = Recipe("straight", markers=True)
    families |= {f"floor/{name}": Recipe("any", floor=name) for name in FLOORS}
    families |= {f"light/{name}": Recipe("any", light=name) for name in light.LIGHTS if name != "even"}
    families["camera/blur"] = Recipe("any", blur=(1.8, 3.0))
    families["camera/motion"] = Recipe("any", motion=(4.0, 10.0))
    families["camera/noise"] = Recipe("any", noise=(8.0, 14.0))
    families["camera/jpeg"] = Recipe("any", jpeg=(12, 30))
    families["camera/contrast_40"] = Recipe("any", contrast=(40.0, 40.0))
    families["camera/contrast_25"] = Recipe("any", contrast=(25.0, 25.0))
    families["camera/worn"] = Recipe("any", worn=1.0)
    families["camera/taper"] = Recipe("any", taper=(0.5, 0.8), width=(0.04, 0.2))
    families["camera/top_view"] = Recipe("any", top_view=True)
    families["light/sheen"] = Recipe("any", sheen=1.0)
    families["camera/dark"] = Recipe("any", exposure=(0.2, 0.4))
    for name in paths.SHAPES:  # because a camera so close that the line fills a quarter of the view sees one of them
        width = MIXED.width if name in (*ANY, "right_angle", "gaps", "end") else (0.025, 0.10)
        families[f"mixed/{name}"] = replace(MIXED, shape=name, width=width)
    families |= {f"bare/mixed_{name}": replace(MIXED, floor=name) for name in FLOORS}
    families |= {f"bare/{name}": Recipe(None, floor=name) for name in FLOORS}
    families |= {f"bare/{name}": Recipe(None, light=name) for name in light.LIGHTS if name != "even"}
    families["bare/markers"] = Recipe(None, markers=True)
    families["bare/top_view"] = Recipe(None, floor="any", top_view=True)
    return families


FAMILIES: dict[str, Recipe] = _families()
