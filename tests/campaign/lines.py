"""The long run: the line detector against six scenes of every family at two sizes, and in all directions."""

import functools

import pytest

from tests.lines.__main__ import directions
from tests.lines.peers import METHODS
from tests.lines.recipes import FAMILIES
from tests.lines.scenes import SIZES, scenes
from tests.lines.score import score, summarise

OURS = METHODS["robotd"]
COUNT = 6


@functools.cache
def scores(size, bare):
    families = [name for name in FAMILIES if name.startswith("bare/") == bare]
    return [score(one, OURS(one)) for one in scenes(families, COUNT, size)]


@pytest.mark.parametrize("size", SIZES)
def test_over_all_scenes_19_lines_of_20_are_found(size):
    assert summarise(scores(size, False)).loose >= 0.95


@pytest.mark.parametrize("size", SIZES)
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
def test_horizontals_corners_dashes_and_low_contrast_are_found(size, family, least):
    assert summarise([one for one in scores(size, False) if one.family == family]).loose >= least


@pytest.mark.parametrize("size", SIZES)
def test_bare_floors_have_no_line_but_for_one_in_fifty(size):
    assert summarise(scores(size, True)).none >= 0.98


@pytest.mark.parametrize("width", [6.0, 9.3, 14.6, 24.2, 40.0])
def test_centres_of_clean_lines_are_exact_in_every_direction(width):
    for degrees, result in directions(OURS, SIZES[1], width):
        assert abs(result.bias) <= 0.05, degrees
        assert result.rms <= 0.1, degrees
