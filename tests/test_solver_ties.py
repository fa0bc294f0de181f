"""Parts of a survey that few labels tie together: a second way to join them is found, and reported if as good."""

from collections import Counter
from dataclasses import replace

import numpy as np

from robotd.solver import evaluate, solve
from robotd.solver.analysis import analyse
from robotd.solver.growing import GrowingMap
from robotd.solver.problem import build_problem
from robotd.solver.ties import weak_ties
from tests.store_surveys import World, load, nees, quiet_room, simulate, with_sightings

WORLD = World(reflections=0.0, wrong_ids=0.0)


def only(survey, stop, labels):
    """The survey in which a stop sees these labels alone of all that others see."""
    return with_sightings(survey, lambda s: [g for g in s.sightings if s.stop != stop or g.label in labels])


def shared_by(survey, stop):
    """Labels that a stop sees, most often seen first."""
    seen = Counter(g.label for s in survey.stops for g in s.sightings)
    return sorted({g.label for g in survey.stops[stop - 1].sightings}, key=lambda label: (-seen[label], label))


def test_ties_are_the_labels_across_every_cut_and_of_every_stop():
    survey, _ = quiet_room()
    chosen = shared_by(survey, 3)[:2]
    problem = build_problem(only(survey, 3, chosen))
    found = [
        (np.flatnonzero(tie.side).tolist(), {problem.labels[i] for i in tie.labels})
        for tie in weak_ties(problem, problem.sightings)
    ]
    assert ([2], set(chosen)) in found
    seen = [{g.label for g in stop.sightings} for stop in problem.survey.stops]
    for side, labels in found:
        inside = set().union(*(seen[k] for k in side))
        outside = set().union(*(seen[k] for k in range(len(seen)) if k not in side))
        assert labels == inside & outside
        assert 1 <= len(labels) <= 4


def test_a_wrong_optimum_behind_a_weak_tie_is_left_or_reported():
    # three labels join the first stop to the rest; at 30 % wrong sightings one of those that fit is wrong
    survey, truth = simulate(load("warehouse"), 101, WORLD, outliers=0.3)
    result = solve(survey)
    assert any("leg/stop 1/1 and the rest share only A09, A12, A18" in note for note in result.notes)
    torn = [m for m in result.labels if m.reason is not None and "in two ways" in m.reason]
    assert len(torn) > 20
    for label in torn:
        assert label.position is None
        errors = [np.linalg.norm(np.subtract(c.position, truth[label.label])) for c in label.candidates]
        assert min(errors) < 0.1
    assert evaluate(result, truth).error_mm["max"] < 100.0


def test_a_right_optimum_with_a_weak_tie_is_believed():
    survey, truth = simulate(load("room"), 4, WORLD)
    weak = only(survey, 1, shared_by(survey, 1)[:3])
    result = solve(weak)
    assert sum(label.status == "placed" for label in result.labels) == len(truth)
    assert evaluate(result, truth).error_mm["max"] < 30.0


def test_one_label_that_joins_two_parts_is_named_because_nothing_checks_it():
    survey, _ = simulate(load("room"), 4, WORLD)
    label = shared_by(survey, 1)[0]
    _, analysis = analyse(only(survey, 1, [label]))
    assert any(text.startswith(f"leg/stop 1/1 and the rest share only {label}:") for text in analysis.after)
    assert not any("share only" in text for text in analyse(survey)[1].after)


def test_a_map_that_grows_reports_the_same_tie():
    survey, _ = simulate(load("warehouse"), 101, WORLD, outliers=0.3)
    growing = GrowingMap(replace(survey, stops=survey.stops[:-1]))
    growing.add_stop(survey.stops[-1])
    assert [m.status for m in growing.map().labels] == [m.status for m in solve(survey).labels]


def test_a_wrong_name_that_ties_two_rooms_by_itself_is_left_out():
    """Its residual is as small as any: it turned a whole room towards itself."""
    survey, truth = simulate(load("warehouse"), 5047, World())
    result = solve(survey)
    values = nees(result, truth)
    assert np.mean(values) < 2.5  # 35 with it
    tie = next(s for s in result.sightings if (s.stop, s.camera, s.label) == (1, "rear", "B40"))
    assert tie.weight == 0.0
