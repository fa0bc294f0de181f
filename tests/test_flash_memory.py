import numpy as np
import pytest

from robotd.vision.alternation import Alternation
from robotd.vision.flash_memory import FRAMES, FlashMemory
from robotd.vision.shake import Shake

SHAPE = 40, 50  # cells


def film(frames, seed=0):
    """A wall on which the light at row 30, column 40 of pixels flashes, and noise."""
    rng = np.random.default_rng(seed)
    wall = rng.integers(60, 120, (2 * SHAPE[0], 2 * SHAPE[1])).astype(float)
    v, u = np.mgrid[: wall.shape[0], : wall.shape[1]]
    spot = 60.0 * np.exp(-0.5 * ((u - 40.5) ** 2 + (v - 30.5) ** 2) / 1.2**2)
    pictures = (wall + spot * (k % 6 < 3) + rng.normal(0.0, 2.0, wall.shape) for k in range(frames))
    return [np.clip(np.rint(picture), 0, 255).astype(np.uint8) for picture in pictures]


def places(*pairs):
    rows, columns = np.array(pairs, np.intp).T
    return rows, columns


def test_a_watched_place_keeps_its_whole_light_curve_and_another_one_what_the_pictures_show():
    watched, other = places((14, 19), (0, 0), (38, 48)), places((5, 7))
    memory, whole = FlashMemory(SHAPE, 20, 2.2), FlashMemory(SHAPE, FRAMES, 2.2)
    for k, picture in enumerate(film(70)):
        memory.take(picture)
        whole.take(picture)
        if k % 11 == 2:
            memory.watch(*watched)
    numbers = np.arange(70)
    values, levels, known = memory.curves(numbers, *watched)
    expected = whole.curves(numbers, *watched)
    assert known.all()
    np.testing.assert_array_equal(values, expected[0])
    np.testing.assert_array_equal(levels, expected[1])
    values, levels, known = memory.curves(numbers, *other)
    expected = whole.curves(numbers, *other)
    np.testing.assert_array_equal(known[0], numbers >= 50)
    np.testing.assert_array_equal(values[known], expected[0][known])
    assert np.isin(levels[~known], levels[known]).all()  # copies, because a median must not know the difference


def test_a_place_that_is_no_longer_watched_is_forgotten_but_for_the_pictures():
    memory = FlashMemory(SHAPE, 20, 2.2)
    for k, picture in enumerate(film(60)):
        memory.take(picture)
        if k in (5, 30):
            memory.watch(*(places((14, 19), (3, 3)) if k == 5 else places((3, 3))))
    _, _, known = memory.curves(np.arange(60), *places((14, 19), (3, 3)))
    assert known[:, :40].any(axis=1).tolist() == [False, True]


def test_moving_to_the_middle_of_a_light_keeps_when_it_flashed():
    memory, whole = FlashMemory(SHAPE, 24, 2.2), FlashMemory(SHAPE, FRAMES, 2.2)
    for k, picture in enumerate(film(80)):
        memory.take(picture)
        whole.take(picture)
        if k == 3:
            memory.watch(*places((14, 20)))
    memory.move(14, 20, 14, 19)
    numbers = np.arange(80)
    values, _, known = memory.curves(numbers, *places((14, 19)))
    expected = whole.curves(numbers, *places((14, 19)))[0]
    assert known.all()
    on = numbers % 6 < 3
    contrast = expected[0, on].mean() - expected[0, ~on].mean()
    assert values[0, :50][on[:50]].mean() - values[0, :50][~on[:50]].mean() == pytest.approx(contrast, rel=0.1)
    assert np.corrcoef(values[0, :50], expected[0, :50])[0, 1] > 0.98


def test_what_alternates_in_the_rhythm_is_examined_first_and_known_lights_are_not():
    memory, alternation, shake = FlashMemory(SHAPE, 24, 2.2), Alternation(SHAPE, 8, 3.0), Shake(3)
    pictures = film(45)
    shake.refer(pictures[0], np.zeros(2))
    for k, picture in enumerate(pictures):
        cells = memory.take(picture)
        alternation.add(k, cells, (k - 3, memory.cells(k - 3)) if k >= 3 else None, np.zeros(2), shake)
        if k % 15 == 14:
            alternation.end_block(100.0)
    found, examined = alternation.candidates([], 72)
    row, column = divmod(int(found[0]), SHAPE[1])
    assert examined >= 1
    assert (abs(row - 14), abs(column - 19)) <= (1, 1)
    again, _ = alternation.candidates([(row, column)], 72)
    assert not {divmod(int(place), SHAPE[1]) for place in again} & {(14, 19), (15, 20), (14, 20), (15, 19)}
