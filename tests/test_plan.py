"""Planning: what a stop would teach, where to make it, what to ask there, and that the robot can follow."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robotd.errors import InputError, SolverError
from robotd.files import load_plan, save_plan, save_survey
from robotd.geometry.transforms import se2_compose, se2_inverse, se2_relative
from robotd.plan_records import Plan, PlannedFlash, PlannedLabel, PlannedStop
from robotd.records import Pose
from robotd.solver.belief import Belief
from robotd.solver.covariance import covariance
from robotd.solver.mapping import solve, to_map
from robotd.solver.outlook import Outlook
from robotd.solver.planning import PlanSettings, plan
from robotd.solver.problem import build_problem
from robotd.solver.robust import optimise
from robotd.solver.viewing_angles import force_field, viewing_angles
from robotd.solver.ways import along_line, over_floor
from robotd.solver_main import main
from tests.bench.stores import make_store, survey_of
from tests.campaign.plan import EVERY, compare, drive
from tests.operated import operated

NOWHERE = np.zeros((0, 3))


def test_viewing_angles_are_those_of_the_thesis():
    # equation 58: labels at 90 and 0 degrees from the origin; equation 59: from (1, -1) they were at 135 and 0 + 45
    labels = np.array([[0.0, 1.0], [2.0, 0.0]])
    here = np.array([1.0, -1.0])
    before = np.arctan2(2.0, -1.0), np.arctan2(1.0, 1.0)
    expected = np.sqrt((np.pi / 2) ** 2 + (np.pi / 2 - before[0]) ** 2 + before[1] ** 2) / np.sqrt(3.0)
    assert viewing_angles(np.zeros((1, 2)), here, labels)[0] == pytest.approx(expected)


def test_viewing_angles_wrap_and_do_not_depend_on_the_order_of_labels():
    rng = np.random.default_rng(0)
    labels, places = rng.uniform(-2.0, 2.0, (6, 2)), rng.uniform(-2.0, 2.0, (20, 2))
    angles = viewing_angles(places, np.zeros(2), labels)
    np.testing.assert_allclose(viewing_angles(places, np.zeros(2), labels[::-1]), angles)
    turned = np.array([[-1.0, 0.0], [0.0, -1.0]])  # by half a turn: bearings cross the cut at pi elsewhere
    np.testing.assert_allclose(viewing_angles(places @ turned, np.zeros(2), labels @ turned), angles)


def test_the_force_field_points_up_the_heat_map():
    labels, here = np.array([[0.0, 2.0], [1.0, 2.0], [2.5, 1.0]]), np.zeros(2)
    places = np.random.default_rng(1).uniform([-1.0, -1.0], [2.0, 1.0], (30, 2))
    ahead = viewing_angles(places + 0.005 * force_field(places, here, labels), here, labels)
    assert (ahead > viewing_angles(places, here, labels)).all()


@pytest.fixture(scope="module")
def course():
    return drive("room", 3)


@pytest.fixture(scope="module")
def begun(course):
    """The room after three of its stops."""
    return course.at(course.fixed[:3], [None] * 3)


def test_a_belief_without_new_stops_is_the_solvers_covariance(begun):
    optimum = optimise(build_problem(begun))
    belief = Belief(optimum, 1.5, 0.7, NOWHERE, 1.0)
    stated = covariance(optimum.adjustment, optimum.state).points
    # a label that only one stop saw hangs on its ray: it takes nothing from the others, and adds nothing to them
    np.testing.assert_allclose(belief.blocks(belief.P)[optimum.adjustment.labels], stated, rtol=1e-3, atol=1e-9)


def test_what_a_stop_is_expected_to_teach_is_what_solving_with_it_finds(course):
    indices = course.fixed[:4]
    with_it = course.at(indices, [None] * 4)
    optimum = optimise(build_problem(course.at(indices[:3], [None] * 3)))
    belief = Belief(optimum, 1.5, 0.7, NOWHERE, 1.0)
    found = {label.label: label for label in solve(with_it).labels if label.status == "placed"}
    pose = next(stop for stop in solve(with_it).stops if stop.stop == 4)
    here = np.array([[pose.x, pose.y, pose.heading]])
    views = belief.views(here, 0.1, 9.0)
    names = optimum.problem.labels
    seen = {(s.camera, s.label) for s in with_it.stops[3].sightings}
    cameras = [camera.name for camera in optimum.problem.cameras]
    real = [(cameras[c], names[i]) in seen for c, i in zip(views.camera, views.label, strict=True)]
    rows = np.flatnonzero(real)
    assert len(rows) == sum(label in names for _, label in seen)
    room, entry = belief.with_stop(belief.P)
    before = optimum.problem.stop_entries(optimum.state)[-1, :3]
    cov = np.array(with_it.stops[3].move.covariance)
    link = belief.move(before, belief.stop_entries(2), here[0], entry, cov)
    H = link.joined(belief.sight(views, rows, np.ones(len(rows)), entry))
    sigma = np.sqrt(belief.traces_with(H, room))
    np.testing.assert_allclose(np.sqrt(belief.traces(belief.take(room, H))), sigma, rtol=1e-6)
    both = [i for i in optimum.adjustment.labels if names[i] in found]
    solved = [np.sqrt(np.trace(np.array(found[names[i]].covariance))) for i in both]
    np.testing.assert_allclose(sigma[both], solved, rtol=0.1)


def test_taking_a_flash_back_leaves_what_is_known_without_it(course, begun):
    optimum = optimise(build_problem(begun))
    belief = Belief(optimum, 1.5, 0.7, NOWHERE, 1.0)
    pose = optimum.problem.stop_entries(optimum.state)[-1, :3]
    views = belief.views((pose + [0.3, 0.1, 0.0])[None], 0.1, 9.0)
    room, entry = belief.with_stop(belief.P)
    link = belief.move(pose, belief.stop_entries(2), pose + [0.3, 0.1, 0.0], entry, np.diag([1e-5, 1e-5, 1e-4]))

    def rows(kept):
        return link.joined(belief.sight(views, np.flatnonzero(kept), np.ones(kept.sum()), entry))

    everything = rows(np.ones(len(views.label), dtype=bool))
    owner = np.concatenate([[-1, -1, -1], np.repeat(views.label, 2)])
    told = belief.told(everything, belief.take(room, everything), owner)
    gone = views.label < 0
    for label in np.unique(views.label)[[0, 3, 5]]:
        gone |= views.label == label
        known = belief.traces_with(rows(~gone), room)
        np.testing.assert_allclose(told.without(label), known, rtol=1e-4, atol=1e-9)
        told.forget(label)
        np.testing.assert_allclose(belief.traces(told.known()), known, rtol=1e-4, atol=1e-9)


def chances(course, survey, index):
    """How likely each label is said to show at one of a course's stops, which is ahead."""
    problem = build_problem(survey)
    optimum = optimise(problem)
    poses = problem.stop_entries(optimum.state)[:, :3]
    way = along_line(course.line, poses, poses[0], False, 1.0)
    outlook = Outlook(optimum, to_map(problem, optimum), way)
    rows = outlook.views.at(int(np.abs(way.along - course.along[index]).argmin()))
    rows = rows[outlook.views.label[rows] < len(problem.labels)]
    result = np.zeros(len(problem.labels))
    np.maximum.at(result, outlook.views.label[rows], outlook.chance[rows])
    return dict(zip(problem.labels, result.tolist(), strict=True))


def seen_at(course, index):
    return {s.label for s in course.survey.stops[index].sightings}


def test_labels_that_stops_did_not_ask_are_not_held_for_hidden(course):
    *made, following = course.fixed[:5]
    asked = [None, *(set(sorted(seen_at(course, index))[::2]) for index in made[1:])]
    shown = seen_at(course, following)
    whole, part = (chances(course, course.at(made, names), following) for names in ([None] * 4, asked))
    assert min(whole[label] for label in shown) > 0.75  # it sees all labels: none of them is turned away yet
    assert min(part[label] for label in shown) > 0.5


def test_labels_that_stops_asked_in_vain_are_held_for_hidden():
    warehouse = drive("warehouse", 0, every=EVERY)
    *made, following = warehouse.fixed[:9]
    shown = seen_at(warehouse, following)
    found = chances(warehouse, warehouse.at(made, [None] * 8), following)
    hidden = [chance for label, chance in found.items() if label not in shown]
    assert np.mean(hidden) < 0.5 * np.mean([chance for label, chance in found.items() if label in shown])


def test_what_two_rooms_hang_on_is_seen_from_more_than_one_stop():
    # labels of both rooms show at once on 1.2 m of the line only
    warehouse = drive("warehouse", 100, every=EVERY)
    made = warehouse.fixed[: 1 + int(np.searchsorted(warehouse.along[warehouse.fixed], 9.5))]
    study = plan(warehouse.at(made, [None] * len(made)), warehouse.line)
    at = np.array([warehouse.along[made[-1]], *study.plan.distances()])
    assert np.diff(at).max() < 1.35
    assert len(study.plan.stops[0].skipped) > 0


def test_a_plan_of_the_rest_of_the_line_places_what_is_ahead(course, begun):
    study = plan(begun, course.line)
    at = study.plan.distances()
    assert 1 <= len(at) <= 4
    assert study.plan.begin == pytest.approx(course.along[course.fixed[2]], abs=0.03)
    assert all(study.plan.begin < a <= course.along[-1] for a in at)
    assert list(at) == sorted(at)
    assert all(label.expected_m <= (label.sigma_m or np.inf) * (1.0 + 1e-6) for label in study.plan.labels)


def test_a_whole_survey_needs_nothing_more(course):
    whole = course.at(range(0, len(course.along), 4), [None] * len(range(0, len(course.along), 4)))
    study = plan(whole, course.line)
    assert study.plan.stops == ()
    assert "no other stop" in study.plan.notes[0]


def test_of_a_large_survey_only_the_next_metres_are_planned_and_no_label_is_told_better_than_it_is():
    store = make_store(120, 1200, 2.4)
    survey = replace(survey_of(store), stops=survey_of(store).stops[:70])
    line = se2_compose(se2_inverse(store.poses[0]), store.poses)[:, :2]
    study = plan(survey, line, settings=PlanSettings(most_stops=2))
    assert "metres are planned" in study.plan.notes[0]
    assert len(plan(survey, line, settings=PlanSettings(most_stops=1)).plan.stops) == 1
    seen = {s.label for stop in survey.stops for s in stop.sightings}
    placed = {label.label for label in study.map.labels if label.status == "placed"}
    assert placed <= {label.label for label in study.plan.labels} <= seen
    assert len(study.positions) < 0.6 * len(seen)
    here = survey.stops[-1].stop - 1
    first = min(study.plan.stops, key=lambda stop: stop.along)
    true = se2_relative(store.poses[0], store.poses[here])
    assert np.hypot(first.pose.x - true[0], first.pose.y - true[1]) < 3.0
    last = study.map.stops[-1].covariance  # what is known of the rest of the store bounds what is known here
    known = [label for label in study.plan.labels if label.sigma_m is not None]
    assert min(label.expected_m for label in known if label.expected_m < label.sigma_m) > 0.3 * np.sqrt(last[0][0])


def test_a_target_that_is_reached_ends_the_plan(course):
    mapped = course.at(course.fixed, [None] * len(course.fixed))
    study = plan(mapped, course.line, again=True, settings=PlanSettings(target_m=0.1))
    assert study.plan.stops == ()
    assert "every label is known to 100 mm" in study.plan.notes[0]
    assert "new leg" in study.plan.notes[1]
    assert study.plan.begin == 0.0


def test_over_free_floor_no_place_comes_near_a_label():
    stops = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    labels = np.array([[0.5, 0.6], [0.6, 0.6], [0.8, 0.6]])
    way = over_floor(stops, labels)
    apart = np.linalg.norm(way.places[:, None, :2] - labels, axis=2)
    assert len(way.places) > 20
    assert apart.min() >= 0.35
    behind = (np.abs(way.places[:, 0] - 0.6) < 0.15) & (way.places[:, 1] > 0.7)
    assert not behind.any()


def test_over_free_floor_the_nearest_place_comes_first(begun):
    study = plan(begun, free=True, settings=PlanSettings(most_stops=3))
    assert 1 <= len(study.plan.stops) <= 3
    assert study.plan.distances() == ()
    here = np.array([study.map.stops[-1].x, study.map.stops[-1].y])
    away = [float(np.hypot(stop.pose.x - here[0], stop.pose.y - here[1])) for stop in study.plan.stops]
    assert away[0] == min(away)


def test_without_a_line_the_way_so_far_is_planned_once_more(begun):
    study = plan(begun, settings=PlanSettings(most_stops=2))
    assert study.plan.begin == 0.0
    assert all(0.0 <= along <= 1.6 for along in study.plan.distances())


def test_on_a_line_that_crosses_itself_the_robot_is_where_it_came_to():
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    line = np.column_stack([np.sin(2.0 * turn), np.sin(turn)])  # a figure of eight through the origin
    stops = np.column_stack([line[[0, 40, 95]], np.zeros(3)])
    way = along_line(line, stops, stops[0], False, 1.0)
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    assert way.here == pytest.approx(lengths[95], abs=0.05)


def test_a_survey_without_a_placed_label_cannot_be_planned_from(course):
    with pytest.raises(SolverError, match="make two stops"):
        plan(course.at(course.fixed[:1], [None]), course.line)


def test_the_planner_saves_a_third_of_the_flashes_or_stops():
    fixed, advised = compare("room", range(2))
    assert advised[1] == fixed[1]
    assert min(advised[2] / fixed[2], advised[3] / fixed[3]) <= 0.7


# ---- files and commands ----------------------------------------------------------------------------------------------

ADVICE = Plan(
    "s",
    (PlannedStop(0.5, Pose(0.5, 0.0, 0.0), (PlannedFlash("A", 0.01),), ("B",)), PlannedStop(1.5, Pose(1.5, 0.0, 0.0))),
    (PlannedLabel("A", None, 0.01), PlannedLabel("B", 0.004, 0.004)),
    begin=0.2,
)


def test_a_plan_survives_its_file(tmp_path):
    save_plan(ADVICE, tmp_path / "plan.json")
    assert load_plan(tmp_path / "plan.json") == ADVICE


def test_labels_are_skipped_only_where_that_was_planned():
    assert ADVICE.skipped(0.45) == {"B"}
    assert ADVICE.skipped(1.5) == frozenset()
    assert ADVICE.skipped(1.0) == frozenset()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"format": "robotd-plan/9"}, "format"),
        ({"stop": []}, "unknown key 'stop'"),
        ({"begin": 0.9}, "expected increasing metres"),
    ],
)
def test_a_wrong_plan_is_named(tmp_path, change, text):
    save_plan(ADVICE, tmp_path / "plan.json")
    wrong = {**json.loads((tmp_path / "plan.json").read_text()), **change}
    (tmp_path / "plan.json").write_text(json.dumps(wrong))
    with pytest.raises(InputError, match=text):
        load_plan(tmp_path / "plan.json")


def test_the_command_writes_a_plan_that_the_robot_reads_and_a_picture(course, begun, tmp_path, capsys):
    survey, line, out, png = (tmp_path / name for name in ("survey.json", "line.csv", "plan.json", "plan.png"))
    save_survey(begun, survey)
    line.write_text("x,y\n" + "\n".join(f"{x:.4f},{y:.4f}" for x, y in course.line[::5]))
    assert main(["plan", str(survey), "--line", str(line), "-o", str(out), "--png", str(png)]) == 0
    advice = load_plan(out)
    assert advice.stops
    assert png.read_bytes().startswith(b"\x89PNG")
    table = capsys.readouterr().err
    assert f"{advice.stops[0].along:.2f}" in table
    assert "expected of all" in table


@pytest.mark.parametrize(
    ("text", "said"), [("a,b\n1,2\n", "header x,y"), ("x,y\n1,2\n3,q\n", "line 3"), ("x,y\n1,2\n", "two or more")]
)
def test_a_wrong_line_is_named(begun, tmp_path, capsys, text, said):
    survey, line = tmp_path / "survey.json", tmp_path / "line.csv"
    save_survey(replace(begun, stops=begun.stops[:2]), survey)
    line.write_text(text)
    assert main(["plan", str(survey), "--line", str(line)]) == 2
    assert said in capsys.readouterr().err


# ---- the robot ------------------------------------------------------------------------------------------------------


def follow_the_plan(folder, plan_name="plan.json"):
    made = []

    async def scenario(robot, client):
        made.append(await client.call("mission.start"))
        if "code" not in (made[0] or {}):
            await robot.until("done")
            made.append((robot.daemon.missions.mission, robot.labels.asked))

    operated(folder, scenario, stops=(0.0, 3.0), plan=Path(plan_name), labels=("A", "B"))
    return made


def test_the_robot_stops_where_the_plan_says_and_asks_what_it_names(tmp_path):
    save_plan(replace(ADVICE, begin=0.0), tmp_path / "plan.json")
    _, (mission, asked) = follow_the_plan(tmp_path)
    assert [stop.odometry.x for stop in mission.stops] == pytest.approx([0.5, 1.5], abs=0.08)
    requests = [labels for labels, _ in asked]
    assert requests[0] == ("A",)  # alone at the first stop, where B would teach nothing
    assert sorted(requests[1:]) == [("A",), ("B",)]


def test_a_mission_with_an_unreadable_plan_does_not_start(tmp_path):
    (answer,) = follow_the_plan(tmp_path, "missing.json")
    assert "missing.json: no such file" in json.dumps(answer)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (["--target", "nan"], "--target: found nan"),
        (["--flash-seconds", "inf"], "--flash-seconds: found inf"),
        (["--least", "0"], "--least: found 0; expected percent"),
    ],
)
def test_numbers_that_no_plan_can_be_made_of_are_refused(option, said, begun, tmp_path, capsys):
    save_survey(begun, tmp_path / "survey.json")
    assert main(["plan", str(tmp_path / "survey.json"), *option]) == 2
    assert said in capsys.readouterr().err
