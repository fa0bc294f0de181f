"""Motions by other sensors than the wheels: what they add to a map, and that a wrong one does no harm."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robotd.errors import InputError
from robotd.files import survey_from_json, survey_to_json
from robotd.records import Motion
from robotd.solver import GrowingMap, solve
from tests.store_surveys import World, load, simulate, true_moves

GYRO = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1e6))  # 1 mrad
FIXED = ((1e6, 0.0, 0.0), (0.0, 1e6, 0.0), (0.0, 0.0, 1e6))  # 1 mm, 1 mrad


def with_motions(survey, make):
    """The survey with the motions (s -> tuple) of its stops after the first."""
    stops = [replace(stop, motions=make(k) if k else ()) for k, stop in enumerate(survey.stops)]
    return replace(survey, stops=tuple(stops))


@pytest.fixture(scope="module")
def room():
    """A room whose labels are seen too seldom to bridge bad wheels: survey, truth, true moves."""
    store, world = load("room"), World(reflections=0.0, wrong_ids=0.0, wheel=0.03, slip=0.0, reach=1.6)
    survey, truth = simulate(store, 4, world)
    return survey, truth, true_moves(store)


def error_mm(survey, truth):
    placed = [m for m in solve(survey).labels if m.status == "placed"]
    return 1e3 * float(np.mean([np.linalg.norm(np.subtract(m.position, truth[m.label])) for m in placed]))


def sigma_mm(survey):
    placed = [m for m in solve(survey).labels if m.status == "placed"]
    return 1e3 * float(np.mean([np.sqrt(np.trace(np.array(m.covariance))) for m in placed]))


def test_a_gyro_and_a_line_make_a_map_better_than_the_wheels_alone(room):
    survey, truth, moves = room
    gyro = with_motions(survey, lambda k: (Motion("gyro", 0.0, 0.0, float(moves[k - 1, 2]), GYRO),))
    line = with_motions(survey, lambda k: (Motion("line", *moves[k - 1].tolist(), FIXED),))
    assert sigma_mm(line) < sigma_mm(gyro) < sigma_mm(survey)
    assert error_mm(line, truth) < error_mm(survey, truth)


def test_directions_that_a_sensor_does_not_show_do_not_count(room):
    survey, _, moves = room
    turn = [float(m) for m in moves[:, 2]]
    plain = with_motions(survey, lambda k: (Motion("gyro", 0.0, 0.0, turn[k - 1], GYRO),))
    wild = with_motions(survey, lambda k: (Motion("gyro", 55.0, -7.0, turn[k - 1], GYRO),))
    for a, b in zip(solve(plain).labels, solve(wild).labels, strict=True):
        assert a.position == pytest.approx(b.position, abs=1e-9)


def test_the_wheels_scale_is_not_that_of_other_sensors(room):
    survey, truth, moves = room
    far = replace(survey, priors=replace(survey.priors, odometry_scale=0.5))
    short = [replace(s, move=s.move and replace(s.move, dx=0.8 * s.move.dx, dy=0.8 * s.move.dy)) for s in far.stops]
    line = with_motions(replace(far, stops=tuple(short)), lambda k: (Motion("line", *moves[k - 1].tolist(), FIXED),))
    assert error_mm(line, truth) < 15.0


def test_a_wrong_motion_is_named_and_not_used(room):
    survey, truth, moves = room

    def motions(k):
        wrong = 0.5 if k == 3 else 0.0
        return (Motion("line", float(moves[k - 1, 0]) + wrong, *moves[k - 1, 1:].tolist(), FIXED),)

    wrong = with_motions(survey, motions)
    notes = solve(wrong).notes
    assert any("stop 4: the motion by line is" in note for note in notes)
    assert error_mm(wrong, truth) < error_mm(survey, truth)


def test_a_map_that_grows_uses_motions_too(room):
    survey, _, moves = room
    line = with_motions(survey, lambda k: (Motion("line", *moves[k - 1].tolist(), FIXED),))
    growing = GrowingMap(replace(line, stops=line.stops[:3]))
    for stop in line.stops[3:]:
        growing.add_stop(stop)
    live = growing.positions()
    for grown, batch in zip(growing.map().labels, solve(line).labels, strict=True):
        assert grown.status == batch.status
        assert grown.position == pytest.approx(batch.position, abs=1e-5)
        assert live[grown.label] == pytest.approx(batch.position, abs=0.003)


def test_motions_survive_their_file_and_may_be_missing(room):
    survey, _, moves = room
    line = with_motions(survey, lambda k: (Motion("line", *moves[k - 1].tolist(), FIXED),))
    assert survey_from_json(survey_to_json(line), "x") == line
    table = json.loads(survey_to_json(survey))
    for stop in table["stops"]:
        del stop["motions"]
    assert survey_from_json(json.dumps(table).encode(), "x") == survey


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"source": ""}, "source: found an empty text"),
        ({"information": [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}, "negative eigenvalue"),
        ({"information": [[1.0, 2.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 1.0]]}, "not symmetric"),
        ({"covariance": 1}, "unknown key 'covariance'"),
    ],
)
def test_a_wrong_motion_in_a_file_is_named(room, change, said):
    survey, _, _ = room
    table = json.loads(survey_to_json(survey))
    good = {"source": "line", "dx": 0.1, "dy": 0.0, "dheading": 0.0, "information": FIXED}
    table["stops"][2]["motions"] = [{**good, **change}]
    with pytest.raises(InputError, match=said) as caught:
        survey_from_json(json.dumps(table).encode(), "x")
    assert "stops[2].motions[0]" in str(caught.value)


def test_the_first_stop_of_a_leg_has_no_motion(room):
    survey, _, _ = room
    first = replace(survey.stops[0], motions=(Motion("gyro", 0.0, 0.0, 0.0, GYRO),))
    with pytest.raises(InputError, match=r"stops\[0\].motions"):
        survey_from_json(survey_to_json(replace(survey, stops=(first, *survey.stops[1:]))), "x")
