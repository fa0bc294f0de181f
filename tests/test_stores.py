"""Store layouts are read strictly, and the tape's geometry is exact."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import ConfigError
from robotd.sim.line import LineGeometry, distance_to_box, distance_to_segment
from robotd.sim.stores import StoreLayout, find_store, load_store

GOOD = """\
format = "robotd-store/1"
name = "small"
size = [4.0, 3.0]
[floor]
texture = "tiles"
[line]
points = [[1.0, 1.0], [3.0, 1.0], [3.0, 2.0]]
corner_radius = 0.2
stops = [0.0, 1.0]
[[walls]]
from = [0.0, 0.0]
to = [4.0, 0.0]
height = 2.0
[[shelves]]
box = [0.0, 2.5, 1.0, 3.0]
height = 1.0
[[labels]]
id = "A"
position = [1.5, 0.02, 0.5]
normal = [0.0, 2.0, 0.0]
[[labels]]
id = "B"
position = [0.5, 2.49, 0.5]
normal = [0.0, -1.0, 0.0]
"""


def _load(tmp_path: Path, text: str) -> StoreLayout:
    path = tmp_path / "store.toml"
    path.write_text(text)
    return load_store(path)


def _problems(tmp_path: Path, text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        _load(tmp_path, text)
    return [problem.removeprefix(f"{tmp_path / 'store.toml'} ") for problem in caught.value.problems]


@pytest.mark.parametrize(("name", "labels", "stops"), [("room", 29, 7), ("warehouse", 44, 12)])
def test_shipped_stores_load_with_their_disturbances(name: str, labels: int, stops: int) -> None:
    layout = load_store(find_store(name))
    assert (len(layout.labels), len(layout.line.stops)) == (labels, stops)
    assert layout.lamps
    assert 1 <= len(layout.walkers) <= 2
    assert [blinker.frequency for blinker in layout.blinkers] == [2.0]
    for walker in layout.walkers:
        a, b = np.array(walker.path)
        between = a + np.linspace(0.0, 1.0, 200)[:, None] * (b - a)
        assert layout.geometry.distance(between).min() >= 0.30 - 1e-3
        assert all(distance_to_box(between, shelf.box).min() > 0.2 for shelf in layout.shelves)
        assert all(distance_to_segment(between, wall.start, wall.end).min() > 0.2 for wall in layout.walls)


def test_disturbances_are_the_same_at_every_reading_and_can_be_forbidden(tmp_path: Path) -> None:
    assert load_store(find_store("room")) == load_store(find_store("room"))
    bare = _load(tmp_path, "disturbances = false\n" + GOOD)
    assert (bare.lamps, bare.walkers, bare.blinkers) == ((), (), ())


def test_disturbances_of_the_file_are_kept(tmp_path: Path) -> None:
    layout = _load(tmp_path, GOOD + "[[lamps]]\nposition = [1, 1, 2]\nbrightness = 0.5\n")
    assert [lamp.brightness for lamp in layout.lamps] == [0.5]
    assert layout.walkers


def test_normals_get_unit_length(tmp_path: Path) -> None:
    assert _load(tmp_path, GOOD).labels[0].normal == (0.0, 1.0, 0.0)


def test_every_mistake_is_named_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("stops = [0.0, 1.0]", "stops = [0.5, 0.2, 99.0]")
    text = text.replace("box = [0.0, 2.5, 1.0, 3.0]", "box = [1.0, 1.2, 0.0, 3.0]")
    text += """\
[[labels]]
id = "A"
position = [9.0, 0.02, 0.5]
normal = [0.0, 0.0, 0.0]
[[shelves]]
box = [2.0, 0.5, 2.5, 0.9]
height = 1.0
[[labels]]
id = "C"
position = [2.2, 0.7, 0.5]
normal = [0.0, 1.0, 0.0]
[[walls]]
from = [0.1, 0.1]
to = [0.1, 0.1]
height = "high"
[[walls]]
from = [0.1, 0.1]
to = [0.1, 0.1]
[[known_labels]]
id = "Z"
[[mirrors]]
from = [0.0, 0.1]
to = [1.0, 0.1]
bottom = 1.0
top = 0.5
reflectivity = 2.0
[[mirrors]]
from = [0.0, 0.1]
to = [1.0, 0.1]
bottom = 1.0
top = 0.5
reflectivity = 0.5
"""
    found = _problems(tmp_path, text)
    for start in (
        "walls[1].height: found 'high'; expected a number",
        "mirrors[0].reflectivity: found 2.0; expected 0 to 1",
        "shelves[0].box: found [1.0, 1.2, 0.0, 3.0]; expected [x0, y0, x1, y1] with x0 < x1",
        "walls[2].to: found [0.1, 0.1]; expected another point",
        "mirrors[1].top: found 0.5; expected more than bottom = 1",
        "labels[2].id: found 'A'; expected an id of its own; labels[0] has it too",
        "labels[2].position: found [9.0, 0.02, 0.5]; expected a point over the floor",
        "labels[2].normal: found [0.0, 0.0, 0.0]; expected a direction",
        "labels[3].position: found [2.2, 0.7, 0.5]; expected a point outside every shelf; it is inside shelves[1]",
        "known_labels[0].id: found 'Z'; expected the id of a label",
        "line.stops[1]: found 0.2; expected more than stops[0] = 0.5",
        "line.stops[2]: found 99.0; expected an arc length on the line",
        "line.points: found 0.1; expected at least 0.25 m between the line and shelves[1]",
    ):
        assert any(problem.startswith(start) for problem in found), (start, found)
    assert len(found) == 13


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "corner_radius = 0.2",
            "corner_radius = 1.5",
            "line.corner_radius: found 1.5; expected a radius whose arcs fit",
        ),
        ("[3.0, 2.0]]", "[1.0, 1.0]]", "line.points[1]: found a turn back on itself"),
        ("[3.0, 1.0],", "[1.0, 1.0],", "line.points[1]: found the same point as before it"),
        ("[3.0, 2.0]]", "[3.0, 3.5]]", "line.points[2]: found [3.0, 3.5]; expected a point on the floor"),
        ("size = [4.0, 3.0]", "size = [4.0, -3.0]", "size: found [4.0, -3.0]; expected a width and a depth above 0"),
        ("[1.5, 0.02, 0.5]", "[1.5, 0.02]", "labels[0].position: found a list of 2; expected 3 values"),
        ("width = ", "widht = ", None),
        ('texture = "tiles"', 'texture = "lava"', "floor.texture: found 'lava'; expected one of 'carpet'"),
        ('texture = "tiles"', 'image = "no.png"', "floor.image: found 'no.png'; expected an image file"),
        ('format = "robotd-store/1"', 'format = "robotd-store/9"', "format: found 'robotd-store/9'"),
    ],
)
def test_a_mistake_names_table_index_and_key(tmp_path: Path, old: str, new: str, message: str | None) -> None:
    if message is None:
        text, message = (
            GOOD.replace("stops = [", "widht = 0.05\nstops = ["),
            "line: unknown key 'widht'; did you mean 'width'?",
        )
    else:
        text = GOOD.replace(old, new)
    assert any(problem.startswith(message) for problem in _problems(tmp_path, text))


def test_an_unknown_store_names_the_shipped_ones() -> None:
    with pytest.raises(ConfigError, match="no such store; expected one of room, warehouse"):
        find_store("attic")


def test_rounded_rectangle_has_the_length_of_its_arcs_and_begins_on_the_first_segment() -> None:
    line = LineGeometry([(1.0, 0.8), (2.6, 0.8), (2.6, 2.0), (1.0, 2.0)], closed=True, corner_radius=0.2)
    assert line.length == pytest.approx(2 * (1.6 + 1.2) - 8 * 0.2 + 2 * math.pi * 0.2)
    np.testing.assert_allclose(line.point_at(0.0), [1.2, 0.8], atol=1e-12)
    assert float(line.heading_at(0.0)) == 0.0
    assert float(line.heading_at(1.2 + 0.1 * math.pi / 2)) == pytest.approx(math.pi / 4)
    np.testing.assert_allclose(line.point_at(line.length + 0.3), line.point_at(0.3), atol=1e-12)
    np.testing.assert_allclose(line.points[0], line.points[-1], atol=1e-12)


def test_offset_is_positive_on_the_left_and_arc_length_is_where() -> None:
    line = LineGeometry([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0)], closed=False, corner_radius=0.0)
    offset, s = line.nearest(np.array([[0.5, 0.1], [0.5, -0.2], [1.7, 1.0], [2.0, 5.0]]))
    np.testing.assert_allclose(offset[:3], [0.1, -0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(s, [0.5, 0.5, 3.0, 4.0], atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(
    turns=st.lists(st.floats(-2.4, 2.4), min_size=1, max_size=5),
    radius=st.floats(0.0, 0.3),
    share=st.floats(0.0, 1.0),
)
def test_points_are_continuous_and_headings_are_their_direction(
    turns: list[float], radius: float, share: float
) -> None:
    points, heading = [(0.0, 0.0), (2.0, 0.0)], 0.0
    for turn in turns:
        heading += turn
        points.append((points[-1][0] + 2 * math.cos(heading), points[-1][1] + 2 * math.sin(heading)))
    line = LineGeometry(points, closed=False, corner_radius=radius)
    gaps = np.hypot(*np.diff(line.points, axis=0).T)
    assert gaps.max() <= 0.0101
    assert gaps.sum() == pytest.approx(line.length, rel=1e-3)
    s = share * (line.length - 2e-6)
    a, b = line.point_at(s), line.point_at(s + 1e-6)
    if radius > 0.01:
        direction = math.atan2(*(b - a)[::-1])
        assert math.remainder(direction - float(line.heading_at(s)), 2 * math.pi) == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(line.point_at(line.length), points[-1], atol=1e-9)
