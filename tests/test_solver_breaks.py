"""A robot that somebody pushed or carried in the middle of a leg, so that a move leads to a wrong place."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.transforms import wrap_angle
from robotd.solver import solve
from robotd.solver.growing import GrowingMap
from tests.store_surveys import World, load, simulate

WORLD = World(reflections=0.05, slip=0.0)


def carried(survey, k, far, turn):
    """The survey in which nobody noticed how the robot came to its stop k."""
    stops = list(survey.stops)
    move = stops[k].move
    stops[k] = replace(stops[k], move=replace(move, dx=move.dx + far, dheading=wrap_angle(move.dheading + turn)))
    return replace(survey, stops=tuple(stops))


def errors(result, truth):
    return {m.label: np.linalg.norm(np.subtract(m.position, truth[m.label])) for m in result.labels if m.position}


@pytest.mark.parametrize(
    ("store", "k", "far", "turn"),
    [("room", 3, 1.0, 0.0), ("room", 4, 0.5, 2.0), ("warehouse", 4, 1.0, 0.0), ("warehouse", 9, 1.0, 1.5)],
)
def test_a_robot_that_was_carried_is_noticed_and_the_map_is_the_one_without_that_move(store, k, far, turn):
    survey, truth = simulate(load(store), 1, WORLD)
    clean = errors(solve(survey), truth)
    result = solve(carried(survey, k, far, turn))
    found = errors(result, truth)
    assert any(f"leg 1 stop {k + 1}" in note and "pushed or carried" in note for note in result.notes), result.notes
    assert len(found) >= len(clean) - 2
    assert np.mean(list(found.values())) < 2.0 * np.mean(list(clean.values())) + 0.01


def test_a_map_that_grows_notices_it_too():
    survey, truth = simulate(load("room"), 1, WORLD)
    survey = carried(survey, 3, 1.0, 0.0)
    growing = GrowingMap(replace(survey, stops=()))
    for stop in survey.stops:
        growing.add_stop(stop)
    grown, batch = errors(growing.map(), truth), errors(solve(survey), truth)
    assert grown.keys() == batch.keys()
    assert max(abs(grown[label] - batch[label]) for label in grown) < 0.002


def test_a_stop_whose_sightings_all_have_wrong_names_does_not_break_a_leg():
    survey, truth = simulate(load("room"), 1, WORLD)
    names = [s.label for s in survey.stops[3].sightings]
    wrong = tuple(replace(s, label=names[i - 5]) for i, s in enumerate(survey.stops[3].sightings))
    stops = (*survey.stops[:3], replace(survey.stops[3], sightings=wrong), *survey.stops[4:])
    result = solve(replace(survey, stops=stops))
    assert not any("carried" in note for note in result.notes), result.notes
    assert max(errors(result, truth).values()) < 0.05
