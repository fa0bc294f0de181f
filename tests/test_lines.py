"""How lines are judged: the scorer on hand-made cases, the scenes' truth, annotated folders, bounds on a few scenes."""

import functools
import json
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import InputError
from robotd.records import Line
from robotd.vision.polyline import resample
from tests.lines import paths
from tests.lines.__main__ import directions, main
from tests.lines.peers import METHODS, Ours, lsd_pairs, otsu
from tests.lines.photographs import photographs
from tests.lines.recipes import FAMILIES
from tests.lines.scenes import Scene, TrueLine, scene, straight_line
from tests.lines.score import score, summarise

W = 10.0


@functools.cache
def first(family):
    """The first scene of a family; several tests look at it, and drawing it is dear."""
    return scene(family, 0, (320, 240), samples=2)


def ground(*lines, family="hand", valid=None, size=(200, 100)):
    """A scene of nothing but its truth."""
    truth = tuple(TrueLine(np.array(points, float), W, optional) for points, optional in lines)
    return Scene("hand/0", family, np.zeros(size[::-1], np.uint8), truth, "dark", (7.5, 13.5), valid)


def found(*points, width=W):
    return Line(np.array(points, float), width, 1.0)


LEVEL = ([(-50.0, 50.0), (250.0, 50.0)], False)  # through the whole image


def test_the_truth_scores_one():
    result = score(ground(LEVEL), [found((0, 50), (199, 50))])
    assert (result.tight, result.loose, result.false_lines, result.pieces) == (1.0, 1.0, 0, 1.0)
    assert (result.bias, result.rms, result.width_error) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_a_line_off_by_half_a_width_is_right_at_the_loose_tolerance_only():
    result = score(ground(LEVEL), [found((0, 55), (199, 55), width=12.0)])
    assert (result.tight, result.loose) == (0.0, 1.0)
    assert result.bias == pytest.approx(5.0)
    assert result.width_error == pytest.approx(2.0)


def test_bias_has_the_sign_of_the_side_whichever_way_the_found_line_runs():
    for points in ([(0, 48), (199, 48)], [(199, 48), (0, 48)]):
        assert score(ground(LEVEL), [found(*points)]).bias == pytest.approx(-2.0)
    backwards = ([(250.0, 50.0), (-50.0, 50.0)], False)
    assert score(ground(backwards), [found((0, 48), (199, 48))]).bias == pytest.approx(2.0)


def test_half_a_line_has_half_the_recall():
    result = score(ground(LEVEL), [found((0, 50), (99, 50))])
    assert result.precision == 1.0
    assert result.recall == pytest.approx(0.5, abs=0.05)
    assert result.loose == pytest.approx(2.0 / 3.0, abs=0.05)


def test_a_false_line_of_the_same_length_halves_the_precision():
    result = score(ground(LEVEL), [found((0, 50), (199, 50)), found((0, 80), (199, 80))])
    assert result.precision == pytest.approx(0.5)
    assert result.recall == 1.0
    assert result.false_lines == 1
    assert result.bias == pytest.approx(0.0, abs=1e-9)  # the false line's distance is no bias of the true one


def test_precision_is_by_length_not_by_count():
    many = [found((0, 50), (199, 50)), *(found((k, 80), (k + 2, 80)) for k in range(0, 40, 8))]
    assert score(ground(LEVEL), many).precision > 0.85


def test_filling_a_gap_is_neither_right_nor_wrong():
    dashes = ([(-50, 50), (80, 50)], False), ([(80, 50), (120, 50)], True), ([(120, 50), (250, 50)], False)
    whole = score(ground(*dashes), [found((0, 50), (199, 50))])
    parts = score(ground(*dashes), [found((0, 50), (80, 50)), found((120, 50), (199, 50))])
    assert whole.tight == parts.tight == 1.0
    assert (whole.pieces, parts.pieces) == (1.0, 2.0)  # but joining it shows


def test_what_lies_outside_the_valid_part_does_not_count():
    valid = np.zeros((100, 200), bool)
    valid[:, :100] = True
    assert score(ground(LEVEL, valid=valid), [found((0, 50), (99, 50), (99.5, 90), (199, 90))]).precision > 0.6
    assert score(ground(LEVEL, valid=valid), [found((0, 50), (99, 50))]).recall == 1.0


def test_nothing_found_scores_zero_on_a_line_and_one_on_a_bare_floor():
    assert score(ground(LEVEL), []).loose == 0.0
    assert score(ground(family="bare/hand"), []).tight == 1.0
    some = score(ground(family="bare/hand"), [found((0, 5), (50, 5)), found((0, 50), (50, 50))])
    assert (some.tight, some.false_lines) == (0.0, 2)


def test_the_overall_score_is_the_mean_of_lines_and_bare_floors_however_many_there_are():
    right = score(ground(LEVEL), [found((0, 50), (199, 50))])
    bare = [score(ground(family="bare/hand"), lines) for lines in ([], [found((0, 5), (9, 5))])]
    summary = summarise([right, right, right, *bare])
    assert (summary.tight, summary.none, summary.overall) == (1.0, 0.5, 0.75)
    assert math.isnan(summarise([right]).none)


@given(st.floats(-0.2, 0.2), st.integers(3, 60))
def test_the_score_does_not_depend_on_how_densely_a_line_is_sampled(tilt, count):
    u = np.linspace(0.0, 199.0, count)
    points = np.column_stack([u, 50.0 + tilt * (u - 100.0)])
    truth = [(-50.0, 50.0 - 150.0 * tilt), (250.0, 50.0 + 150.0 * tilt)], False
    assert score(ground(truth), [found(*points)]).tight == 1.0


# ---- scenes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0, 117.0])
def test_a_clean_line_covers_exactly_its_width(degrees):
    image = straight_line(degrees, 9.3, offset=(0.3, 0.4), blur=0.3, noise_sigma=0.0, dark=0.0, floor=250.0).image
    across = image[120].astype(float) if degrees >= 45.0 else image[:, 160].astype(float)
    slant = abs(math.sin(math.radians(degrees))) if degrees >= 45.0 else abs(math.cos(math.radians(degrees)))
    assert (250.0 - across).sum() / 250.0 * slant == pytest.approx(9.3, abs=0.03)


@settings(max_examples=40)
@given(st.floats(0.0, math.pi), st.floats(4.0, 20.0))
def test_tape_is_drawn_as_wide_as_it_is_and_on_its_centre_to_half_a_sample(angle, width):
    away = 30.0 * np.array([math.cos(angle), math.sin(angle)])
    middle = np.array([40.3, 39.8])
    cover = paths.filled(paths.outlines(np.array([middle - away, middle + away]), width), (320, 320), 4)
    v, u = np.nonzero(cover)
    assert cover.sum() / 16.0 == pytest.approx(60.0 * width, abs=60.0 * 0.25)
    assert np.column_stack([(u + 0.5) / 4 - 0.5, (v + 0.5) / 4 - 0.5]).mean(axis=0) == pytest.approx(middle, abs=0.125)


def test_the_inside_of_a_mitred_corner_is_filled_once():
    square = np.array([[20.0, 20.0], [60.0, 20.0], [60.0, 60.0]])
    cover = paths.filled(paths.outlines(square, 10.0), (320, 320), 4)
    assert cover.sum() / 16.0 == pytest.approx(2 * 40 * 10 + 25 - 25, rel=0.01)  # the corner's outer quarter, less one


def test_a_scene_is_the_same_every_time_and_numbers_differ():
    one, two, other = (scene("mixed/curve", k, (160, 120)) for k in (1, 1, 2))
    assert np.array_equal(one.image, two.image)
    assert np.array_equal(one.lines[0].points, two.lines[0].points)
    assert not np.array_equal(one.image, other.image)


@pytest.mark.parametrize("family", ["shape/curve", "floor/plain", "camera/taper", "light/gradient"])
def test_the_drawn_tape_lies_where_the_truth_says(family):
    """Along the true centre the picture is darker (or brighter) than a width beside it."""
    one = scene(family, 3, (320, 240))
    line = one.lines[0]
    points = resample(line.points, 1.0)
    step = np.gradient(points, axis=0)
    normal = np.column_stack([-step[:, 1], step[:, 0]]) / np.hypot(*step.T)[:, None]
    inside = (points > 20).all(axis=1) & (points < [300, 220]).all(axis=1)
    points, normal = points[inside], normal[inside]
    sign = -1.0 if one.polarity == "dark" else 1.0

    def grey(away):
        at = np.clip(np.rint(points + away * line.width * normal).astype(int), 0, [319, 239])
        return sign * float(np.median(one.image[at[:, 1], at[:, 0]]))

    assert grey(0.0) - max(grey(-1.0), grey(1.0)) > 10.0


def test_bare_families_have_no_line_and_the_others_do():
    for family in FAMILIES:
        assert bool(first(family).lines) != family.startswith("bare/"), family


# ---- photographs -----------------------------------------------------------------------------------------------------


def photo(folder, name, note, image=None):
    if image is None:
        image = np.full((60, 80), 150, np.uint8)
    if image is not False:
        cv2.imwrite(str(folder / f"{name}.png"), image)
    if note is not None:
        (folder / f"{name}.json").write_text(note if isinstance(note, str) else json.dumps(note))


def test_annotated_photographs_are_scenes(tmp_path):
    line = {"lines": [[[0, 30], [79, 30]]], "width_px": 8, "polarity": "dark", "gaps": [[[40, 30], [50, 30]]]}
    photo(tmp_path, "a", line)
    photo(
        tmp_path, "b", {"lines": "none", "width_px": [6, 12], "polarity": "bright", "valid": [[0, 0], [40, 0], [0, 59]]}
    )
    tape, bare = photographs(tmp_path)
    assert [tape.family, bare.family] == ["photo", "bare/photo"]
    assert [one.optional for one in tape.lines] == [False, True]
    assert tape.width_px == (6.0, pytest.approx(10.8))
    assert bare.width_px == (6.0, 12.0)
    assert bare.valid is not None
    assert bare.valid[5, 5]
    assert not bare.valid[50, 70]
    assert score(tape, [found((0, 30), (79, 30), width=8.0)]).tight == 1.0


def test_every_mistake_of_a_folder_is_named_at_once(tmp_path):
    good = {"lines": [[[0, 30], [79, 30]]], "width_px": 8, "polarity": "dark"}
    photo(tmp_path, "alone", None)
    photo(tmp_path, "orphan", good, image=False)
    photo(tmp_path, "colour", good | {"polarity": "red"})
    photo(tmp_path, "width", good | {"width_px": "wide"})
    photo(tmp_path, "range", good | {"width_px": [5, 9]})  # a line has one width
    photo(tmp_path, "empty", good | {"lines": []})
    photo(tmp_path, "point", good | {"lines": [[[1, 2]]]})
    photo(tmp_path, "far", good | {"lines": [[[0, 30], [900, 30]]]})
    photo(tmp_path, "key", good | {"colour": "dark"})
    photo(tmp_path, "text", "{")
    photo(tmp_path, "lacks", {"lines": "none"})
    with pytest.raises(InputError) as error:
        photographs(tmp_path)
    said = "\n".join(error.value.problems)
    for words in (
        "alone.png: has no annotation", "orphan.json: has no image", "polarity = 'red'; expected 'dark'",
        "width_px = 'wide'; expected a number", "width_px = [5, 9]; expected a number", "lines is empty",
        "point.json: lines[0] is not a list of two", "far.json: lines[0] lies far outside its image of 80x60",
        "unknown key 'colour'; expected lines", "text.json: cannot be read as JSON", "lacks 'width_px'",
    ):  # fmt: skip
        assert words in said, words


@pytest.mark.parametrize(("make", "words"), [(False, "is not a folder"), (True, "holds no images")])
def test_a_folder_without_images_is_refused(tmp_path, make, words, capsys):
    folder = tmp_path / "photographs"
    if make:
        folder.mkdir()
    assert main(["--folder", str(folder), "--methods", "robotd"]) == 2
    assert words in capsys.readouterr().err


# ---- methods ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", METHODS)
def test_every_method_finds_a_clean_line(name):
    if name == "thesis":
        one = straight_line(70.0, 14.0, offset=(0.2, 0.4))
    else:
        one = straight_line(20.0, 14.0, offset=(0.2, 0.4))
    result = score(one, METHODS[name](one))
    assert result.loose > 0.85
    if name not in ("Canny+Hough", "LSD"):  # which return the borders
        assert result.tight > 0.85


def test_the_table_names_families_methods_and_the_worst_scenes(tmp_path, capsys):
    asked = ["--families", "bare/mesh", "floor/mesh", "--count", "1", "--methods", "robotd", "LSD pairs"]
    assert main([*asked, "--worst", str(tmp_path / "worst"), "--json", str(tmp_path / "all.json")]) == 0
    table = capsys.readouterr().out
    for words in ("robotd", "LSD pairs", "bare/mesh", "floor/mesh", "overall"):
        assert words in table
    numbers = json.loads((tmp_path / "all.json").read_text())
    assert [one["name"] for one in numbers["robotd"]] == ["floor/mesh/0", "bare/mesh/0"]
    worst = [one for one in numbers["robotd"] if one["tight"] < 0.999]
    assert len(list((tmp_path / "worst").glob("*.png"))) == len(worst)
    assert main(["--families", "nowhere"]) == 2


# ---- the detector, on a few scenes: bounds with margin against what the table shows ----------------------------------

OURS = Ours()


@functools.cache
def ours_on(family):
    return score(first(family), OURS(first(family)))


def mean_of(families):
    return summarise([ours_on(name) for name in families])


def test_our_detector_finds_every_shape_on_a_mild_floor():
    summary = mean_of([name for name in FAMILIES if name.startswith("shape/")])
    assert summary.tight > 0.95
    assert summary.loose > 0.96
    assert summary.false_lines < 0.2


@pytest.mark.parametrize(
    ("family", "least"),
    [
        ("shape/horizontal", 0.99),
        ("shape/upright_corner", 0.99),
        ("shape/right_angle", 0.99),
        ("shape/dashed", 0.8),
        ("camera/contrast_40", 0.95),
    ],
)
def test_our_detector_finds_horizontals_corners_dashes_and_low_contrast(family, least):
    found = [scene(family, number, (320, 240), samples=2) for number in range(3)]
    summary = summarise([score(one, OURS(one)) for one in found])
    assert summary.loose >= least
    assert summary.false_lines == 0.0


def test_our_detector_bears_bad_light_and_a_bad_camera():
    summary = mean_of([name for name in FAMILIES if name.startswith(("light/", "camera/"))])
    assert summary.loose > 0.92


def test_our_detector_finds_19_lines_of_20_over_all_families():
    summary = mean_of([name for name in FAMILIES if not name.startswith("bare/")])
    assert summary.loose >= 0.95
    assert summary.false_lines < 0.05


def test_our_detector_finds_nothing_on_most_bare_floors():
    bare = [name for name in FAMILIES if name.startswith("bare/") and "mesh" not in name]
    assert mean_of(bare).none > 0.88


def test_our_detector_beats_the_peers_where_everything_is_hard():
    hard = [f"mixed/{name}" for name in paths.SHAPES]
    theirs, thresholded = (
        summarise([score(first(name), method(first(name))) for name in hard]) for method in (lsd_pairs, otsu)
    )
    assert mean_of(hard).tight > max(theirs.tight, thresholded.tight)


def test_our_centres_are_exact_in_every_direction():
    for degrees, result in directions(OURS, (320, 240), 14.6, step=15.0):
        assert result.tight > 0.99, degrees
        assert abs(result.bias) < 0.05, degrees
        assert result.rms < 0.1, degrees
