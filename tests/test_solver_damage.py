"""Surveys with a tenth of their fields damaged: named where they can be, and never a map that is silently wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import InputError, RobotdError
from robotd.files import survey_from_json, survey_to_json
from robotd.records import Pose
from robotd.solver import solve
from robotd.solver_main import main
from tests.store_surveys import World, load, noisy_room, simulate, with_sightings
from tests.test_typed_json import ODD, places

TEXT = survey_to_json(noisy_room()[0])


def damaged(text, share, data):
    """The JSON value with about `share` of its leaves replaced."""
    value = json.loads(text)
    leaves = [p for p in places(value) if p != ("format",) and not isinstance(at(value, p), dict | list)]
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    for k in rng.choice(len(leaves), int(share * len(leaves)), replace=False):
        *parents, last = leaves[k]
        at(value, parents)[last] = ODD[rng.integers(len(ODD))]
    return value


def at(value, path):
    for key in path:
        value = value[key]
    return value


@given(st.data())
@settings(deadline=None, max_examples=15)
def test_a_tenth_of_damaged_fields_is_named_each_with_its_place(data):
    value = damaged(TEXT, 0.1, data)
    with pytest.raises(InputError) as caught:
        survey_from_json(json.dumps(value).encode(), "room.json")
    assert len(caught.value.problems) > 20
    assert all(problem.startswith("room.json") for problem in caught.value.problems)
    assert sum("stops[" in problem for problem in caught.value.problems) > 10


@given(st.data())
@settings(deadline=None, max_examples=15)
def test_whatever_the_reader_lets_through_is_solved_or_refused_in_words(data):
    value = damaged(TEXT, data.draw(st.sampled_from([0.0005, 0.002])), data)
    try:
        survey = survey_from_json(json.dumps(value).encode(), "room.json")
        result = solve(survey)
    except RobotdError as error:
        assert str(error)
        return
    for label in result.labels:
        assert (label.position is None) == (label.status not in ("placed", "known"))
        assert label.position is not None or label.reason


@pytest.mark.parametrize("store", ["room", "warehouse"])
@pytest.mark.parametrize("seed", range(3))
def test_a_tenth_of_wrong_pixels_and_odometry_places_nothing_wrongly(store, seed):
    survey, truth = simulate(load(store), seed, World(reflections=0.0, wrong_ids=0.0))
    rng = np.random.default_rng(seed)

    def spoil(stop):
        for s in stop.sightings:
            u = float(rng.uniform(0, 640)) if rng.random() < 0.1 else s.u
            yield replace(s, u=u, v=float(rng.uniform(0, 480)) if rng.random() < 0.1 else s.v)

    spoiled = with_sightings(survey, spoil)
    stops = tuple(
        replace(s, odometry=Pose(*rng.normal(0.0, 3.0, 3))) if rng.random() < 0.1 and s.stop > 1 else s
        for s in spoiled.stops
    )
    result = solve(replace(spoiled, stops=stops))
    errors = [np.linalg.norm(np.subtract(m.position, truth[m.label])) for m in result.labels if m.position]
    # a fifth of the sightings is wrong: labels with two left at the cameras' height, where any two meet, are not placed
    assert len(errors) >= 0.75 * len(truth)
    assert max(errors) < 0.15


def test_every_command_answers_damage_with_words(tmp_path, capsys):
    for cut in (0, 1, len(TEXT) // 2, len(TEXT) - 3):
        (tmp_path / "survey.json").write_bytes(TEXT[:cut])
        for command in ("solve", "check"):
            assert main([command, str(tmp_path / "survey.json")]) == 2
            assert str(tmp_path / "survey.json") in capsys.readouterr().err


@pytest.mark.parametrize("name", ["odometry_scale", "odometry_turn", "tilt_rad", "focal_px", "camera_translation_m"])
def test_a_prior_too_small_for_numbers_counts_as_exact(name):
    survey, _ = noisy_room()
    tiny, exact = (solve(replace(survey, priors=replace(survey.priors, **{name: sigma}))) for sigma in (1e-300, 0.0))
    assert [label.position for label in tiny.labels] == [label.position for label in exact.labels]
