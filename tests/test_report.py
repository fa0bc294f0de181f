"""The picture, the page and the table of a map."""

import json
import re
import warnings
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from robotd.errors import InputError
from robotd.records import (
    CameraModel,
    Map,
    MappedLabel,
    MappedStop,
    Pose,
    Rig,
    SolverRun,
    Stop,
    Survey,
    Transform,
)
from robotd.solver.evaluate import Evaluation, evaluate, text_table
from robotd.solver.report import map_html, map_png

NASTY = "</script><b>&\"'$x^{$\n\u2028\ud7ff"
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
WALL = np.array([[-1.0, 2.0], [3.0, 2.0]])


def covariance(sigma):
    return ((sigma**2, 0.0, 0.0), (0.0, 4 * sigma**2, 0.0), (0.0, 0.0, sigma**2))


def a_map(names=("A", "B", "C"), name="room", unplaced=("D",)):
    labels = [MappedLabel(n, "placed", (float(k), 1.5, 0.8), covariance(0.01), 4, 3) for k, n in enumerate(names)]
    labels += [MappedLabel(n, "unplaced", sightings=1, reason="seen from one stop only") for n in unplaced]
    stops = (MappedStop(1, 1, 0.0, 0.0, 0.0), MappedStop(1, 2, 1.0, 0.1, 0.2))
    return Map(name, "first stop", tuple(labels), stops, (), 3.0, 0.3, SolverRun(5, True, "bundle"), ("a note",))


def a_survey():
    camera = CameraModel("front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((0, 0, 0), (0, 0, 0)))
    first = Stop(1, 1, "2026-11-21T10:00:00Z", Pose(5.0, 5.0, np.pi / 2), None)
    second = Stop(1, 2, "2026-11-21T10:01:00Z", Pose(5.0, 6.0, np.pi / 2), None)
    return Survey("room", Rig((camera,)), (first, second))


def picture(path):
    image = cv2.imread(str(path))
    assert image is not None
    return image


def has_colour(image, red, green, blue, least=20):
    near = np.abs(image.astype(int) - [blue, green, red]).max(axis=2) < 12
    return int(near.sum()) >= least


def test_the_picture_shows_labels_truth_and_both_paths(tmp_path):
    truth = {"A": (0.05, 1.5, 0.8), "B": (1.0, 1.45, 0.8), "C": (2.0, 1.5, 0.85), "D": (0.5, -0.5, 0.3)}
    map_png(tmp_path / "map.png", a_map(), survey=a_survey(), truth=truth, outline=[SQUARE, WALL])
    image = picture(tmp_path / "map.png")
    assert image.shape == (1200, 1600, 3)
    assert has_colour(image, 0xF0, 0x8A, 0x12), "estimates"
    assert has_colour(image, 0xC2, 0x18, 0x3A), "truth"
    assert has_colour(image, 0x4A, 0x7B, 0xD0), "odometry"
    assert has_colour(image, 0x0A, 0x7D, 0x6C), "adjusted path"


def test_without_truth_or_survey_the_picture_shows_neither(tmp_path):
    map_png(tmp_path / "map.png", a_map())
    image = picture(tmp_path / "map.png")
    assert not has_colour(image, 0xC2, 0x18, 0x3A)
    assert not has_colour(image, 0x4A, 0x7B, 0xD0)


@pytest.mark.parametrize(
    "result",
    [
        a_map(names=(), unplaced=()),
        Map("s", "first stop", (), (), (), 0.0, 0.0, SolverRun(0, False, "linear")),
        a_map(names=("A",), unplaced=[f"U{k}" for k in range(200)]),
        a_map(names=[f"L{k}" for k in range(150)]),
        a_map(names=(NASTY, "B" * 300), name=NASTY, unplaced=("$" + NASTY,)),
    ],
    ids=["no labels", "nothing", "many unplaced", "many labels", "nasty names"],
)
def test_every_map_can_be_drawn_without_a_warning(tmp_path, result):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # whatever fonts there are
        map_png(tmp_path / "map.png", result, survey=a_survey(), truth={"A": (0.0, 0.0, 0.0)})
    assert picture(tmp_path / "map.png").shape == (1200, 1600, 3)
    map_html(tmp_path / "map.html", result, survey=a_survey(), truth={"A": (0.0, 0.0, 0.0)})


def test_one_label_thrown_far_away_does_not_shrink_the_store(tmp_path):
    near = a_map(names=[f"L{k}" for k in range(5)], unplaced=())
    far = MappedLabel("far", "placed", (1e5, 0.0, 0.0), covariance(0.01), 2, 2)
    thrown = Map("room", "f", (*near.labels, far), near.stops, (), 1.0, 0.1, SolverRun(1, True, "bundle"))
    map_png(tmp_path / "map.png", thrown, outline=[WALL])
    assert has_colour(picture(tmp_path / "map.png")[:, :1100], 0x0A, 0x7D, 0x6C, least=1500)


class Page(HTMLParser):
    """Collects what a browser would run, show or fetch."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.urls, self.data, self._json = [], [], "", False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.urls += [value for name, value in attrs if name in ("src", "href", "srcset", "action", "data")]
        self._json = dict(attrs).get("type") == "application/json"

    def handle_data(self, data):
        if self._json:
            self.data += data
            self._json = False


def test_the_page_carries_all_its_data_and_fetches_nothing(tmp_path):
    truth = {"A": (0.0, 1.5, 0.9), "Z": (1.0, 1.0, 1.0)}
    map_html(tmp_path / "map.html", a_map(), survey=a_survey(), truth=truth, outline3d=[(SQUARE, 1.5), (WALL, 2.4)])
    text = (tmp_path / "map.html").read_text(encoding="utf-8")
    page = Page(text)
    assert not page.urls
    assert not re.search(r"https?:|url\(|@import|import\(|fetch\(|XMLHttp", text)
    assert "default-src 'none'" in text
    data = json.loads(page.data)
    first, last = data["labels"][0], data["labels"][-1]
    assert (first["name"], first["at"], first["true"], first["error"]) == ("A", [0.0, 1.5, 0.8], [0.0, 1.5, 0.9], 100.0)
    assert (last["status"], last["at"], last["reason"]) == ("unplaced", None, "seen from one stop only")
    assert data["missing"] == [{"name": "Z", "true": [1.0, 1.0, 1.0]}]
    assert [solid["height"] for solid in data["solids"]] == [1.5, 2.4]
    assert data["notes"] == ["a note"]
    half_axes = sorted(np.linalg.norm(first["axes"], axis=1))
    np.testing.assert_allclose(half_axes, np.sqrt(7.815) * np.array([0.01, 0.01, 0.02]), rtol=1e-3)


def test_odometry_is_laid_on_the_first_stop_of_its_leg(tmp_path):
    map_html(tmp_path / "map.html", a_map(), survey=a_survey())
    (leg,) = json.loads(Page((tmp_path / "map.html").read_text(encoding="utf-8")).data)["odometry"]
    np.testing.assert_allclose(leg, [[0.0, 0.0], [1.0, 0.0]], atol=1e-4)


def test_no_name_can_break_out_of_the_page(tmp_path):
    truth = {NASTY: (0.0, 0.0, 0.0)}
    map_html(
        tmp_path / "map.html", a_map(names=(NASTY,), name=NASTY + "__DATA__", unplaced=(NASTY + "2",)), truth=truth
    )
    map_html(tmp_path / "plain.html", a_map(names=("A",), name="room", unplaced=("B",)))
    nasty = Page((tmp_path / "map.html").read_text(encoding="utf-8"))
    plain = Page((tmp_path / "plain.html").read_text(encoding="utf-8"))
    assert nasty.tags == plain.tags
    assert json.loads(nasty.data)["labels"][0]["name"] == NASTY
    assert "</script><b>" not in (tmp_path / "map.html").read_text(encoding="utf-8")


def test_the_table_has_one_row_per_method():
    some = evaluate(a_map(), {"A": (0.0, 1.5, 0.81), "B": (1.0, 1.53, 0.8), "D": (0.0, 0.0, 0.0)})
    none = Evaluation(
        3, 0, 0, dict.fromkeys(("mean", "median", "p95", "max")), {}, None, 4, "roof cameras", "linear (SVD)"
    )
    lines = text_table([some, none]).splitlines()
    assert lines[0].split("  ")[0] == "known points"
    assert lines[1].split() == [
        *("0", "dead", "reckoning", "bundle", "adjustment", "2", "/", "3", "20.0", "20.0", "29.0", "30.0")
    ]
    assert lines[2].split() == ["4", "roof", "cameras", "linear", "(SVD)", "0", "/", "3", "-", "-", "-", "-"]
    assert len({len(line) for line in lines}) == 1


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    for draw, name in ((map_png, "map.png"), (map_html, "map.html")):
        with pytest.raises(InputError, match=rf"none/{name}: cannot be written: No such file"):
            draw(tmp_path / "none" / name, a_map())
