"""A map that grows stop by stop is the map of all stops."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.errors import InputError, SolverError
from robotd.records import KnownLabel
from robotd.solver import GrowingMap, evaluate, solve
from tests.store_surveys import World, in_legs, load, noisy_room, simulate


def grown(survey, first=0):
    growing = GrowingMap(replace(survey, stops=survey.stops[:first]))
    for stop in survey.stops[first:]:
        growing.add_stop(stop)
    return growing


def assert_same_map(one, other):
    assert [label.status for label in one.labels] == [label.status for label in other.labels]
    assert [s.weight for s in one.sightings] == [s.weight for s in other.sightings]
    assert one.cost == pytest.approx(other.cost, rel=1e-6)
    for a, b in zip(one.labels, other.labels, strict=True):
        if a.position is not None:
            np.testing.assert_allclose(a.position, b.position, atol=1e-5)
            np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.3])
@pytest.mark.parametrize("store", ["room", "warehouse"])
def test_growing_ends_in_the_map_of_all_stops(store, share):
    survey, _ = simulate(load(store), 5, World(), outliers=share)
    assert_same_map(grown(survey).map(), solve(survey))


def test_every_map_on_the_way_is_the_map_of_the_stops_so_far():
    survey, _ = noisy_room()
    growing = GrowingMap(replace(survey, stops=()))
    for count, stop in enumerate(survey.stops, 1):
        growing.add_stop(stop)
        assert_same_map(growing.map(), solve(replace(survey, stops=survey.stops[:count])))


def test_poses_and_positions_are_there_after_every_stop():
    survey, truth = noisy_room()
    growing = GrowingMap(replace(survey, stops=survey.stops[:3]))
    for stop in survey.stops[3:]:
        growing.add_stop(stop)
        assert list(growing.poses())[-1] == (stop.leg, stop.stop)
        errors = [np.linalg.norm(np.subtract(p, truth[n])) for n, p in growing.positions().items()]
        assert np.median(errors) < 0.02
    assert set(growing.positions()) == set(truth)


def test_a_second_leg_and_a_wheel_slip_are_taken_in():
    survey, truth = noisy_room()
    legs = in_legs(survey, 4)
    move = legs.stops[5].move
    slipped = replace(legs.stops[5], move=replace(move, dx=move.dx + 0.02, dheading=move.dheading + 0.13))
    legs = replace(legs, stops=(*legs.stops[:5], slipped, *legs.stops[6:]))
    result = grown(legs).map()
    assert_same_map(result, solve(legs))
    assert evaluate(result, truth).error_mm["max"] < 40.0


def test_known_labels_fix_the_frame_as_soon_as_they_are_seen():
    survey, truth = noisy_room()
    known = tuple(KnownLabel(label, truth[label], 0.003) for label in ("S02", "E10", "N16", "W23"))
    survey = replace(survey, known_labels=known)
    result = grown(survey).map()
    assert result.frame == "known labels"
    assert_same_map(result, solve(survey))


def test_a_stop_that_contradicts_the_survey_is_refused_and_leaves_the_map_as_it_was():
    survey, _ = noisy_room()
    growing = grown(survey)
    before = growing.map()
    with pytest.raises(InputError, match="leg 1 stop 3 is there already"):
        growing.add_stop(survey.stops[2])
    wrong = replace(survey.stops[-1].sightings[0], camera="top")
    with pytest.raises(InputError, match="unknown camera 'top'"):
        growing.add_stop(replace(survey.stops[-1], stop=8, sightings=(wrong,)))
    assert growing.map() == before


def test_a_map_of_nothing_is_refused():
    with pytest.raises(SolverError, match="no stops"):
        GrowingMap(replace(noisy_room()[0], stops=())).map()
