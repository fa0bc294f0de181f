"""True lights in footage, marked by a person: `robotd-tags/1`, a TOML file beside the footage.

    format = "robotd-tags/1"
    [[tags]]
    camera = "front"      # of a recording; left out where there is only one
    u = 311.4             # px
    v = 200.2
    kind = "label"        # a light to be found; "reflection": of one, a finding there is false; "ignore": neither
    label = "A17"         # optional
    since = 0.0           # seconds after the first frame in which it holds; optional
    until = 12.5
    radius = 2.5          # px in which a finding belongs to it; optional

Section 6.3.2 of the thesis: blue markers are labels, grey circles are places that are hard to judge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from ..bind import bind, ranged
from ..config import read_toml
from ..errors import InputError
from ..files import write_atomic
from ..toml_edit import toml

FORMAT = "robotd-tags/1"
NEAR_PX = 2.5
Kind = Literal["label", "reflection", "ignore"]


@dataclass(frozen=True, slots=True)
class Tag:
    """One mark, see the module."""

    u: float
    v: float
    kind: Kind = "label"
    camera: str | None = None
    label: str | None = None
    since: float = 0.0
    until: float | None = None
    radius: float = ranged(NEAR_PX, minimum=0.1, maximum=1000.0)

    def __post_init__(self) -> None:
        if self.until is not None and self.until <= self.since:
            raise ValueError(f"until = {self.until:g}; expected more than since = {self.since:g}")

    def share(self, begin: float, end: float) -> float:
        """Part, 0..1, of the time from `begin` to `end` seconds in which the mark holds."""
        until = math.inf if self.until is None else self.until
        return max(0.0, min(end, until) - max(begin, self.since)) / max(end - begin, 1e-9)


@dataclass(frozen=True, slots=True)
class TagFile:
    """A whole file."""

    format: Literal["robotd-tags/1"]
    tags: tuple[Tag, ...] = ()


def tags_path(footage: Path) -> Path:
    """Where the marks of a footage are."""
    return footage.with_name(footage.name + ".tags.toml")


def load_tags(path: Path, camera: str | None = None) -> list[Tag]:
    """The marks in a file, of one camera if one is named; none if there is no file. Raises InputError."""
    if not path.exists():
        return []
    tags = bind(TagFile, read_toml(path), str(path)).tags
    return [tag for tag in tags if camera is None or tag.camera in (None, camera)]


def save_tags(tags: Sequence[Tag], path: Path) -> None:
    """Write the marks, atomically; raises InputError."""
    lines = [f"format = {toml(FORMAT)}"]
    plain = Tag(0.0, 0.0)
    for tag in tags:
        lines += ["", "[[tags]]"]
        for item in fields(Tag):
            value = getattr(tag, item.name)
            if item.name in ("u", "v", "kind") or value != getattr(plain, item.name):
                lines.append(f"{item.name} = {toml(value)}")
    write_atomic(path, ("\n".join(lines) + "\n").encode())


def is_inside(tag: Tag, size: tuple[int, int]) -> bool:
    """Whether it lies in images of `size`."""
    return -0.5 <= tag.u < size[0] - 0.5 and -0.5 <= tag.v < size[1] - 0.5


def add_tag(tags: Sequence[Tag], new: Tag, size: tuple[int, int]) -> list[Tag]:
    """The marks and a new one; raises InputError if it lies outside of images of `size` or on another of its camera."""
    if not is_inside(new, size):
        raise InputError(f"{new.u:g},{new.v:g} is outside of the image of {size[0]}x{size[1]}")
    for number, tag in enumerate(tags, 1):
        if tag.camera == new.camera and tag.kind == new.kind and math.hypot(tag.u - new.u, tag.v - new.v) < 1.0:
            raise InputError(f"{new.u:g},{new.v:g} is mark {number} already ({tag.u:g},{tag.v:g}); remove that first")
    return [*tags, new]


def remove_tags(tags: Sequence[Tag], numbers: Sequence[int]) -> list[Tag]:
    """The marks without some, numbered from 1; raises InputError."""
    unknown = [number for number in numbers if not 1 <= number <= len(tags)]
    if unknown:
        raise InputError(f"no mark {', '.join(map(str, unknown))}; there are {len(tags)}")
    return [tag for number, tag in enumerate(tags, 1) if number not in numbers]


def moved(tag: Tag, seconds: float) -> Tag:
    """The mark in footage that begins so much later."""
    until = None if tag.until is None else max(0.0, tag.until - seconds)
    return replace(tag, since=max(0.0, tag.since - seconds), until=until)
