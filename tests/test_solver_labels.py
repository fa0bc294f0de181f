"""Labels without a position: why, in words, and with candidates."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import (
    invert_rigid,
    pose_matrix,
    transform_points,
)
from robotd.records import (
    Sighting,
)
from robotd.solver import solve
from tests.store_surveys import (
    QUIET,
    World,
    label_of,
    load,
    noisy_room,
    quiet_room,
    simulate,
    with_sightings,
)


def test_a_label_seen_from_one_stop_is_unplaced_and_says_what_to_do():
    survey, _ = quiet_room()
    once = with_sightings(survey, lambda stop: [s for s in stop.sightings if s.label != "S01" or stop.stop == 1])
    label = label_of(solve(once), "S01")
    assert (label.status, label.position, label.covariance) == ("unplaced", None, None)
    assert label.reason == "seen from one stop only; map it from a second stop"
    assert label.sightings >= 1


def test_nearly_parallel_views_are_not_enough():
    store = load("room")
    store["labels"].append({"id": "FAR", "position": [40.0, 0.85, 0.9], "normal": [-1.0, 0.0, 0.0]})
    store["walls"], store["shelves"] = [], []
    survey, _ = simulate(store, 1, replace(World(), reach=100.0, reflections=0.0, wrong_ids=0.0))
    near = with_sightings(survey, lambda stop: [s for s in stop.sightings if s.label != "FAR" or stop.stop in (1, 2)])
    label = label_of(solve(near), "FAR")
    assert label.status == "unplaced"
    assert label.reason.startswith("views nearly parallel")


def reflected(survey, truth, name, stops, probability=None, raised=0.0, behind=0.5):
    """Rival sightings of one label: its image in a mirror behind it, from the given stops; `raised` by a tilted one."""
    x, y, z = truth[name]
    survey = with_sightings(survey, lambda stop: [s for s in stop.sightings if s.label != name or stop.stop in stops])
    return shown_at(survey, name, (x, y - 2.0 * behind, z + raised), stops, probability)


def shown_at(survey, name, position, stops, probability=None):
    """Sightings of a label as if it were elsewhere, beside its own, one from each of some stops."""
    image = np.array([position])

    def change(stop):
        sightings = list(stop.sightings)
        if stop.stop not in stops:
            return sightings
        T = pose_matrix(stop.odometry.x, stop.odometry.y, stop.odometry.heading)
        for model in survey.rig.cameras:
            camera = Camera(model)
            uv, valid = camera.project(transform_points(invert_rigid(T @ camera.T_robot_camera), image))
            if valid[0] and camera.in_image(uv)[0]:
                sightings.append(Sighting(camera.name, name, float(uv[0, 0]), float(uv[0, 1]), 0.1, probability))
                break
        return sightings

    return with_sightings(survey, change)


def test_tied_mirror_solutions_are_reported_with_both_candidates():
    survey, truth = quiet_room()
    seen = [s.stop for s in survey.stops if sum(g.label == "S04" for g in s.sightings) == 1][:3]
    label = label_of(solve(reflected(survey, truth, "S04", seen, raised=0.3)), "S04")
    assert (label.status, label.position) == ("ambiguous", None)
    assert len(label.candidates) == 2
    assert min(np.linalg.norm(np.subtract(c.position, truth["S04"])) for c in label.candidates) < 1e-3
    assert "tied" in label.reason


def test_the_probability_of_sightings_breaks_a_tie():
    survey, truth = quiet_room()
    seen = [s.stop for s in survey.stops if sum(g.label == "S04" for g in s.sightings) == 1][:3]
    label = label_of(solve(reflected(survey, truth, "S04", seen, 0.3, raised=0.3)), "S04")
    assert label.status == "placed"
    np.testing.assert_allclose(label.position, truth["S04"], atol=1e-4)


@pytest.mark.parametrize("behind", [0.02, 0.5])
@pytest.mark.parametrize("direct", [2, 3])
def test_of_a_label_and_its_image_in_upright_glass_the_nearer_one_is_the_label(direct, behind):
    survey, truth = quiet_room()
    both = reflected(survey, truth, "S04", [s.stop for s in survey.stops], behind=behind)
    seen = [s.stop for s in survey.stops if sum(g.label == "S04" for g in s.sightings) == 1]
    assert len(seen) > direct

    def mostly_the_image(stop):  # the label itself from a few stops, its image from all
        mine = [s for s in stop.sightings if s.label == "S04"]
        hidden = mine[:1] if len(mine) == 2 and stop.stop in seen[direct:] else []
        return [s for s in stop.sightings if not any(s is h for h in hidden)]

    result = solve(with_sightings(both, mostly_the_image))
    label = label_of(result, "S04")
    assert label.status == "placed"
    np.testing.assert_allclose(label.position, truth["S04"], atol=1e-4)
    assert sum(s.weight == 0.0 for s in result.sightings if s.label == "S04") > direct


def test_a_label_whose_sightings_do_not_meet_is_unplaced():
    survey, _ = quiet_room()
    rng = np.random.default_rng(0)

    def scatter(stop):
        for s in stop.sightings:
            yield s if s.label != "S05" else replace(s, u=float(rng.uniform(50, 590)), v=float(rng.uniform(300, 400)))

    label = label_of(solve(with_sightings(survey, scatter)), "S05")
    assert label.status == "unplaced"
    assert "do not meet in one point" in label.reason


def test_two_agreeing_sightings_among_as_many_others_are_not_trusted():
    survey, _ = quiet_room()
    rng = np.random.default_rng(3)

    def spoil(stop):
        for s in stop.sightings:
            if s.label != "N17" or stop.stop <= 2:
                yield s
            elif stop.stop <= 5:
                yield replace(s, u=float(rng.uniform(50, 590)), v=float(rng.uniform(300, 400)))

    label = label_of(solve(with_sightings(survey, spoil)), "N17")
    assert label.status == "unplaced"
    assert "sightings agree, which may be chance" in label.reason


def test_a_label_at_camera_height_of_which_any_two_sightings_meet_is_not_placed_by_two_against_one():
    store = load("room")
    level = next(label for label in store["labels"] if label["id"] == "N17")
    level["position"][2] = 0.5
    survey, truth = simulate(store, 1, QUIET)
    first, second, third = [s.stop for s in survey.stops if any(g.label == "N17" for g in s.sightings)][:3]
    stop = survey.stops[first - 1].odometry
    eye = np.array([stop.x, stop.y, 0.5])
    wrong = eye + 0.6 * (np.array(truth["N17"]) - eye)  # in line with it, from the first stop
    two = with_sightings(survey, lambda s: [g for g in s.sightings if g.label != "N17" or s.stop in (first, second)])
    doubtful = shown_at(two, "N17", wrong, [third])
    label = label_of(solve(doubtful), "N17")
    assert label.sightings == 3
    assert (label.status, label.position) == ("ambiguous", None)
    near = [np.linalg.norm(np.subtract(c.position, truth["N17"])) for c in label.candidates]
    assert min(near) < 0.01
    assert label_of(solve(two), "N17").status == "placed"


@pytest.mark.parametrize(("wrong", "status"), [(0.0, "placed"), (0.3, "unplaced")])
def test_two_sightings_at_camera_height_are_believed_only_where_nearly_all_others_fit(wrong, status):
    store = load("room")
    level = next(label for label in store["labels"] if label["id"] == "N17")
    level["position"][2] = 0.5
    world = replace(World(), reflections=0.0, wrong_ids=0.0)
    right, _ = simulate(store, 3, world)
    seen = [s.stop for s in right.stops if any(g.label == "N17" for g in s.sightings)][:2]
    survey, _ = simulate(store, 3, world, outliers=wrong)
    stops = []
    for stop, good in zip(survey.stops, right.stops, strict=True):
        mine = [g for g in good.sightings if g.label == "N17" and stop.stop in seen][:1]
        stops.append(replace(stop, sightings=(*(g for g in stop.sightings if g.label != "N17"), *mine)))
    label = label_of(solve(replace(survey, stops=tuple(stops))), "N17")
    assert (label.status, label.sightings) == (status, 2)
    assert status == "placed" or "whatever they are of" in label.reason


def test_a_few_sightings_of_a_neighbour_under_a_labels_name_do_not_draw_it_there():
    survey, truth = quiet_room()
    near = [s.stop for s in survey.stops if any(g.label == "H27" for g in s.sightings)]
    label = label_of(solve(shown_at(survey, "W21", truth["H27"], near[-2:])), "W21")
    assert label.status == "placed"
    np.testing.assert_allclose(label.position, truth["W21"], atol=1e-4)


def test_every_sighting_is_accounted_for():
    survey, _ = noisy_room()
    result = solve(survey)
    asked = [(stop.leg, stop.stop, s.camera, s.label) for stop in survey.stops for s in stop.sightings]
    assert [(s.leg, s.stop, s.camera, s.label) for s in result.sightings] == asked
    assert [label.label for label in result.labels] == sorted({label for *_, label in asked})
    used = [s for s in result.sightings if s.weight == 1.0]
    assert len(used) == sum(label.inliers for label in result.labels)
    assert all(np.hypot(*s.residual_px) < 0.6 for s in used)
    assert result.rms_px == pytest.approx(np.sqrt(np.mean([np.square(s.residual_px) for s in used])))


def test_an_image_is_not_placed_when_one_sighting_puts_the_label_in_front_of_the_glass():
    survey, truth = quiet_room()
    both = reflected(survey, truth, "S04", [s.stop for s in survey.stops])
    first = next(s.stop for s in survey.stops if any(g.label == "S04" for g in s.sightings))

    def the_image_and_one_look(stop):
        mine = [s for s in stop.sightings if s.label == "S04"]
        direct = mine[:-1] if stop.stop != first else []  # the image is the last one
        return [s for s in stop.sightings if not any(s is d for d in direct)]

    label = label_of(solve(with_sightings(both, the_image_and_one_look)), "S04")
    assert (label.status, label.position) == ("ambiguous", None)
    assert min(np.linalg.norm(np.subtract(c.position, truth["S04"])) for c in label.candidates) < 0.01
    assert "image in glass" in label.reason


def only_images(survey, names):
    """The sightings that `reflected` appended for `names`, without the direct ones."""

    def change(stop):
        last = {s.label: s for s in stop.sightings}
        seen = sum(s.label in names for s in stop.sightings) > len(names & last.keys())
        return [s for s in stop.sightings if s.label not in names or (s is last[s.label] and seen)]

    return with_sightings(survey, change)


def test_a_label_that_was_seen_in_glass_only_is_not_placed_behind_it():
    survey, truth = quiet_room()
    stops = [s.stop for s in survey.stops]
    names = ("S02", "S04", "S05", "S06")
    for name in names:  # their panes are one: the labels hang on one wall
        survey = reflected(survey, truth, name, stops)
    both = solve(survey)
    assert all(label_of(both, name).status == "placed" for name in names)
    label = label_of(solve(only_images(survey, {"S04"})), "S04")
    assert (label.status, label.position) == ("ambiguous", None)
    assert min(np.linalg.norm(np.subtract(c.position, truth["S04"])) for c in label.candidates) < 0.01
    assert "perhaps an image in glass" in label.reason
    assert "S02" in label.reason


@pytest.mark.parametrize(("stops", "status"), [(2, "ambiguous"), (99, "placed")])
def test_a_label_far_outside_everything_is_placed_only_if_many_stops_saw_it(stops, status):
    store = load("room")
    store["labels"].append({"id": "FAR", "position": [5.5, 0.85, 0.9], "normal": [-1.0, 0.0, 0.0]})
    store["walls"], store["shelves"] = [], []
    survey, truth = simulate(store, 1, replace(World(), reach=100.0, reflections=0.0, wrong_ids=0.0))
    seen = [stop.stop for stop in survey.stops if any(s.label == "FAR" for s in stop.sightings)]
    kept = {*seen[:1], *seen[-1:]} if stops == 2 else set(seen)
    near = with_sightings(survey, lambda stop: [s for s in stop.sightings if s.label != "FAR" or stop.stop in kept])
    label = label_of(solve(near), "FAR")
    assert label.status == status, label.reason
    if status == "ambiguous":
        assert "outside all else" in label.reason
        assert np.linalg.norm(np.subtract(label.candidates[0].position, truth["FAR"])) < 0.2
