"""Names that were exchanged on the way, and legs of one stop each."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.solver import solve
from tests.store_surveys import World, label_of, load, simulate, with_sightings

QUIET_NAMES = World(reflections=0.0, wrong_ids=0.0, slip=0.0)


def exchanged(survey, one, other, begin):
    """The survey in which two labels bear each other's names from some stop on."""
    names = {one: other, other: one}
    return with_sightings(
        survey,
        lambda stop: [
            replace(s, label=names.get(s.label, s.label)) if stop.stop >= begin else s for s in stop.sightings
        ],
    )


@pytest.mark.parametrize(("one", "other"), [("S01", "S02"), ("S01", "S03")])
def test_labels_whose_names_were_exchanged_half_way_are_ambiguous_with_both_places(one, other):
    survey, truth = simulate(load("room"), 1, QUIET_NAMES)
    seen = [stop.stop for stop in survey.stops if any(s.label == one for s in stop.sightings)]
    result = solve(exchanged(survey, one, other, seen[len(seen) // 2]))
    for name in (one, other):
        label = label_of(result, name)
        if label.status == "placed":
            assert np.linalg.norm(np.subtract(label.position, truth[name])) < 0.05
        else:
            assert label.status == "ambiguous"
            assert "conflicting identities" in label.reason
            assert label.candidates
    assert "ambiguous" in {label_of(result, one).status, label_of(result, other).status}


def test_legs_of_one_stop_each_are_not_mapped_and_the_note_says_why():
    survey, _ = simulate(load("room"), 1, QUIET_NAMES)
    stops = tuple(replace(stop, leg=k + 1, stop=1, move=None) for k, stop in enumerate(survey.stops))
    result = solve(replace(survey, stops=stops))
    assert {m.status for m in result.labels} == {"unplaced"}
    assert any("no leg has two stops" in note for note in result.notes), result.notes
