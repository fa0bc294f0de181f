"""Identification without pixels, a little of tests/campaign/identify.py; and what the robot remembers of labels."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import invert_rigid, pose_matrix, transform_points
from robotd.identify.decoder import Prior, decode
from robotd.identify.delays import DelayModel
from robotd.identify.memory import LabelMemory
from robotd.identify.settings import IdentifyConfig
from robotd.records import Pose, Sighting
from tests.label_bench import coded_stops, rig, store, summary

EIGHT, ONE = IdentifyConfig(), IdentifyConfig(durations_s=(3,), stop_s=300.0)


@pytest.mark.parametrize(
    ("number", "seen", "config", "seconds"), [(29, 29, EIGHT, 80), (100, 29, EIGHT, 110), (29, 29, ONE, 180)]
)
def test_a_first_stop_names_nearly_all_lights_in_its_time(number, seen, config, seconds):
    result = summary(coded_stops(number, seen, config, range(6)))
    assert result["wrong %"] <= 0.6  # one of them
    assert result["undecided %"] <= 3.0
    assert result["s median"] <= seconds


def test_a_stop_of_a_thousand_labels_keeps_its_time_and_leaves_the_rest_for_the_next():
    result = summary(coded_stops(1000, 60, EIGHT, range(3)))
    assert result["s max"] <= 145.0
    assert result["wrong %"] == 0.0
    assert 10.0 < result["unasked %"] < 150.0


def test_systems_slower_and_later_than_configured_cost_names_and_not_wrong_ones():
    for system in ({"lost": 0.2}, {"median_s": 1.6, "p95_s": 5.0}, {"commands_per_s": 7.0}):
        result = summary(coded_stops(60, 29, EIGHT, range(4), **system))
        assert result["wrong %"] <= 0.9  # one of them
        assert result["undecided %"] <= 12.0


@pytest.mark.parametrize("rate", [4.0, 20.0])
def test_a_first_stop_learns_how_many_commands_a_second_the_system_sends(rate):
    outcome = coded_stops(300, 30, IdentifyConfig(stop_s=200.0), [1], commands_per_s=rate)[0]
    assert 1.0 / outcome.inquiry.delays.interval == pytest.approx(rate, rel=0.12)
    assert outcome.wrong == 0
    assert outcome.right >= 26


def test_labels_seen_before_are_named_by_their_place_in_a_short_stop():
    survey = store(3, EIGHT, number=160, stops=9, given=8)
    assert len(survey.per_stop) == 1
    assert survey.wrong == 0
    assert survey.right >= 20
    assert survey.undecided <= 2
    assert survey.per_stop[0] <= 60.0


def test_the_decoder_takes_ten_thousand_labels_in_bounded_memory():
    rng = np.random.default_rng(0)
    slot = coded_stops(400, 40, EIGHT, [1])[0].inquiry.evidence[0]
    labels = 10_000
    order = rng.permutation(labels)
    wide = replace(slot, labels=order, symbols=np.arange(labels) % 8, gates=np.zeros(labels), window=1010.0)
    found = decode([wide, wide], Prior(np.ones(labels)), len(slot.scores), DelayModel(EIGHT))
    assert len(found.label) == len(slot.scores)
    assert max(len(names) for names, _ in found.candidates) <= 200


# ---- memory ----------------------------------------------------------------------------------------------------------

LABELS = ["near", "far", "behind", "new"]
POINTS = np.array([[1.0, 1.2, 1.0], [2.0, -1.4, 0.4], [-6.5, 0.3, 0.9]])


def sightings_from(pose):
    seen = []
    for model in rig():
        camera = Camera(model)
        there = transform_points(
            invert_rigid(pose_matrix(pose.x, pose.y, pose.heading) @ camera.T_robot_camera), POINTS
        )
        pixels, valid = camera.project(there)
        inside = valid & camera.in_image(np.where(valid[:, None], pixels, -1e6))
        seen += [
            Sighting(model.name, LABELS[k], *map(float, pixels[k])) for k in np.flatnonzero(inside) if k < len(POINTS)
        ]
    return seen


def remembered(*poses):
    memory = LabelMemory(LABELS, rig(), EIGHT)
    travelled = 0.0
    for pose in poses:
        memory.candidates(pose, travelled, [camera.name for camera in rig()])
        memory.record(pose, travelled, sightings_from(pose), np.ones(4, bool))
        travelled += 0.5
    return memory


def predict(memory, pose, travelled):
    candidates = memory.candidates(pose, travelled, [camera.name for camera in rig()])
    seen = sightings_from(pose)
    prior = memory.prior(candidates, [s.camera for s in seen], np.array([(s.u, s.v) for s in seen]))
    return candidates, seen, prior


def test_labels_seen_from_two_stops_are_expected_where_they_then_are():
    memory = remembered(Pose(0.0, 0.0, 0.0), Pose(0.5, 0.0, 0.1))
    candidates, seen, prior = predict(memory, Pose(1.0, 0.1, 0.2), 1.0)
    assert memory.known == 3
    assert candidates.expected[:2].all()
    assert not candidates.expected[3]
    for light, sighting in enumerate(seen):
        if sighting.label != "behind":
            best = prior.near[np.argmax(prior.ratios[light])]
            assert LABELS[best] == sighting.label
            assert prior.ratios[light].max() > 4.0


def test_a_label_seen_once_is_expected_along_its_ray():
    memory = remembered(Pose(0.0, 0.0, 0.0))
    _, seen, prior = predict(memory, Pose(0.4, 0.0, 0.0), 0.4)
    light = next(k for k, sighting in enumerate(seen) if sighting.label == "near")
    assert prior.ratios[light][list(prior.near).index(0)] > 0.5


def test_after_an_interruption_of_odometry_no_place_is_known():
    memory = remembered(Pose(0.0, 0.0, 0.0), Pose(0.5, 0.0, 0.1))
    memory.forget("near")
    assert memory.known == 2
    memory.forget_places()
    candidates, _, prior = predict(memory, Pose(1.0, 0.1, 0.2), 1.0)
    assert not candidates.expected.any()
    assert candidates.wanted.all()
    assert not len(prior.near)


def test_zones_and_plans_and_refusals_limit_what_is_asked():
    memory = LabelMemory(LABELS, rig(), EIGHT, [(["near", "far"], 0.0, 2.0), (["behind"], 3.0, 9.0)])
    memory.refused.add("far")
    names = [camera.name for camera in rig()]
    assert memory.candidates(Pose(0.0, 0.0, 0.0), 1.0, names).wanted.tolist() == [True, False, False, True]
    memory.learnt.add("new")
    assert memory.candidates(Pose(0.0, 0.0, 0.0), 4.0, names).wanted.tolist() == [False, False, True, False]


def test_labels_that_do_not_show_are_expected_less_and_less():
    memory = remembered(Pose(0.0, 0.0, 0.0), Pose(0.5, 0.0, 0.1))
    names = [camera.name for camera in rig()]
    weights = []
    for travelled in (1.0, 1.1, 1.2):
        candidates = memory.candidates(Pose(1.0, 0.0, 0.0), travelled, names)
        weights.append(candidates.weights[0])
        memory.record(Pose(1.0, 0.0, 0.0), travelled, [], np.ones(4, bool))
    assert weights[0] > weights[1] > weights[2]
