"""Known labels and roof cameras that contradict each other or what the robot saw: they must not bend the map."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.homography import apply
from robotd.geometry.transforms import pose_matrix
from robotd.records import BeaconSighting, KnownLabel, RoofCamera
from robotd.solver import evaluate, solve
from tests.store_surveys import load, noisy_room, true_poses

PLANE = np.array([[100.0, 4.0, 640.0], [-3.0, 100.0, 360.0], [0.01, 0.02, 1.0]])  # world to pixels


def known(truth, wrong=()):
    """Labels of three walls, some by 30 cm away from where they hang."""
    ids = sorted(truth)[2::11]
    return tuple(
        KnownLabel(i, tuple(np.add(truth[i], [0.3, 0.0, 0.0] if k in wrong else [0.0, 0.0, 0.0]).tolist()))
        for k, i in enumerate(ids)
    )


def watched(survey, *changes):
    """The survey seen by roof cameras whose homographies to the world were changed afterwards."""
    rng = np.random.default_rng(5)
    names = [f"roof-{k}" for k in range(1, len(changes) + 1)]
    stops = []
    for stop, pose in zip(survey.stops, true_poses(load("room")), strict=True):
        seen = []
        for name in names:
            for beacon, place in survey.rig.beacons.items():
                at = (pose_matrix(*pose) @ [*place, 1.0])[:2]
                u, v = (apply(PLANE, at[None])[0] + rng.normal(0.0, 0.5, 2)).tolist()
                seen.append(BeaconSighting(name, beacon, u, v, 0.5))
        stops.append(replace(stop, beacon_sightings=tuple(seen)))
    matrices = [change @ np.linalg.inv(PLANE) for change in changes]
    roofs = tuple(
        RoofCamera(name, (1280, 720), tuple(map(tuple, H.tolist()))) for name, H in zip(names, matrices, strict=True)
    )
    return replace(survey, stops=tuple(stops), roof_cameras=roofs)


RIGHT = np.eye(3)
SHIFTED = np.array([[1.0, 0.0, 0.4], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
LARGER = np.diag([1.1, 1.1, 1.0])
MIRRORED = np.diag([1.0, -1.0, 1.0])
TURNED = pose_matrix(0.0, 0.0, 0.3)[np.ix_([0, 1, 3], [0, 1, 3])]


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_one_wrong_known_label_of_three_is_named_or_none_is_used(wrong):
    survey, truth = noisy_room()
    result = solve(replace(survey, known_labels=known(truth, (wrong,))))
    assert any("known label" in note and "not used" in note for note in result.notes) or any(
        "the first stop fixes the world frame" in note for note in result.notes
    )
    assert evaluate(result, truth).error_mm["max"] < 60.0


def test_two_known_labels_at_a_wrong_distance_do_not_bend_the_map():
    survey, truth = noisy_room()
    one, other = known(truth)[0], known(truth)[2]
    along = np.subtract(one.position, other.position) * [1.0, 1.0, 0.0]
    far = replace(one, position=tuple(np.add(one.position, 0.3 * along / np.linalg.norm(along)).tolist()))
    result = solve(replace(survey, known_labels=(far, other)))
    assert result.frame == "first stop"
    assert any("the known labels contradict the sightings" in note for note in result.notes)
    assert evaluate(result, truth).error_mm["max"] < 60.0


@pytest.mark.parametrize("change", [SHIFTED, LARGER, MIRRORED, TURNED], ids=["shifted", "larger", "mirrored", "turned"])
def test_one_roof_camera_of_two_with_a_wrong_homography_does_not_bend_the_map(change):
    survey, truth = noisy_room()
    result = solve(watched(survey, change, RIGHT))
    assert any("check" in note and "homograph" in note for note in result.notes), result.notes
    assert evaluate(result, truth).error_mm["max"] < 60.0


@pytest.mark.parametrize("change", [SHIFTED, MIRRORED, TURNED], ids=["shifted", "mirrored", "turned"])
def test_the_wrong_one_of_three_roof_cameras_is_named(change):
    survey, truth = noisy_room()
    result = solve(watched(survey, change, RIGHT, RIGHT))
    assert result.frame == "roof cameras"
    assert any("roof camera roof-1" in note and "check its homography" in note for note in result.notes), result.notes
    assert evaluate(result, truth).error_mm["max"] < 60.0


def test_roof_cameras_that_agree_are_used_and_one_wrong_beacon_among_them_is_not():
    survey, truth = noisy_room()
    seen = watched(survey, RIGHT, RIGHT)
    assert (fine := solve(seen)).frame == "roof cameras"
    assert not any("roof" in note for note in fine.notes)
    first, *rest = seen.stops[3].beacon_sightings
    stops = list(seen.stops)
    stops[3] = replace(stops[3], beacon_sightings=(replace(first, u=first.u + 60.0), *rest))
    result = solve(replace(seen, stops=tuple(stops)))
    assert any("roof camera roof-1: 1 of its" in note for note in result.notes), result.notes
    assert evaluate(result, truth).error_mm["max"] < evaluate(fine, truth).error_mm["max"] + 5.0
