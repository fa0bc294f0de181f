"""Identification without pixels, a little of tests/campaign/identify.py; and what the robot remembers of labels."""

from dataclasses import replace

import numpy as np
import pytest

from robotd.geometry.camera import Camera
from robotd.geometry.transforms import invert_rigid, pose_matrix, transform_points
from robotd.identify import throughput
from robotd.identify.alignment import align
from robotd.identify.decoder import Prior, decode
from robotd.identify.delays import DelayModel
from robotd.identify.inquiry import Candidates, Inquiry
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
    outcomes = coded_stops(1000, 60, EIGHT, range(3))
    assert max(outcome.seconds for outcome in outcomes) <= 145.0
    assert sum(outcome.wrong for outcome in outcomes) == 0
    assert sum(outcome.right for outcome in outcomes) >= 60
    assert all(5 < outcome.unasked < 45 for outcome in outcomes)


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


def test_a_system_that_is_five_times_slower_than_configured_names_lights_too():
    outcomes = coded_stops(60, 20, EIGHT, range(4), commands_per_s=2.0)
    assert sum(outcome.wrong for outcome in outcomes) == 0
    assert sum(outcome.right for outcome in outcomes) >= 70
    assert all(0.4 < outcome.inquiry.delays.interval < 0.6 for outcome in outcomes)


def test_no_wrong_throughput_is_believed_that_a_dozen_lights_fit_by_accident():
    for outcome in coded_stops(1000, 60, ONE, [21]):
        assert outcome.right >= 35
        assert outcome.undecided <= 2
        assert 1.0 / outcome.inquiry.delays.interval == pytest.approx(10.0, rel=0.03)


def test_the_kernel_of_the_throughput_gives_what_numpy_does():
    rng = np.random.default_rng(3)
    sizes = rng.integers(1, 9, 6)
    answered = rng.integers(0, 3, sizes.sum())
    number = int(answered.sum())
    answers = throughput.Answers(
        begins=np.append(0, np.cumsum(answered)),
        slot=(slot := rng.integers(0, 2, number)),
        turn=rng.integers(0, 90, number),
        portion=3 * slot + rng.integers(0, 3, number),
        start=rng.uniform(0.0, 12.0, number).astype(np.float32),
        right=rng.uniform(0.0, 60.0, number).astype(np.float32),
        instead=rng.uniform(0.01, 0.1, number).astype(np.float32),
        portions=np.array([0, 3, 6]),
        gates=np.array([0.0, 3.0, 6.0, 0.0, 1.0, 9.0]),
        heads=np.array([0, 30, 60, 0, 30, 60]),
        table=rng.uniform(0.0, 5.0, (2, 400)).astype(np.float32),
    )
    intervals, odds = np.geomspace(0.02, 0.5, 40), rng.uniform(0.0, 1.0, sizes.sum())
    lights = np.append(0, np.cumsum(sizes))
    expected = throughput.reference_log_likelihoods(intervals, odds, lights, answers)
    found = throughput.log_likelihoods(intervals, odds, lights, answers)
    off = np.abs(found - expected)  # a flash on the border of two cells of the table may be in either
    assert np.ptp(expected) > 1.0
    assert np.median(off) < 1e-6
    assert np.mean(off < 1e-4) > 0.9


def test_few_lights_leave_the_part_of_the_grid_that_all_lights_choose():
    outcome = coded_stops(400, 40, ONE, [3], commands_per_s=14.0)[0]
    evidence, prior = outcome.inquiry.evidence, Prior(outcome.inquiry.candidates.weights)
    whole = []
    for part in (throughput.PART, 1):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(throughput, "PART", part)
            whole.append(throughput.search_interval(evidence, prior, DelayModel(ONE)))
    assert whole[0] == whole[1]
    assert 1.0 / whole[0] == pytest.approx(14.0, rel=0.05)


def test_labels_seen_before_are_named_by_their_place_in_a_short_stop():
    surveys = [store(seed, EIGHT, number=110, stops=7, given=6) for seed in (3, 4, 5)]
    for survey in surveys:
        assert len(survey.per_stop) == 1
        assert survey.wrong == 0
        assert survey.right >= 20
        assert survey.undecided <= 2
    assert np.mean([survey.per_stop[0] for survey in surveys]) <= 60.0


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


def asked_first(memory, pose, travelled):
    candidates = memory.candidates(pose, travelled, [camera.name for camera in rig()])
    question = Inquiry(candidates, EIGHT, DelayModel(EIGHT)).next_question(None, 0.0)
    return {list(memory.index)[label] for label in question.labels}


def test_a_label_seen_from_one_stop_is_asked_at_all_that_follow_until_its_place_is_known():
    others = [f"L{k}" for k in range(40)]  # placed, and more than may be asked although they hardly show
    memory = LabelMemory(["once", *others], rig(), EIGHT)
    names = [camera.name for camera in rig()]
    for stop in range(2):
        memory.candidates(Pose(0.3 * stop, 0.0, 0.0), 0.3 * stop, names)
        lights = [Sighting("left", label, 20.0 + 15.0 * k - 60.0 * stop, 240.0) for k, label in enumerate(others)]
        far = [Sighting("front", "once", 330.0, 235.0)][stop:]
        memory.record(Pose(0.3 * stop, 0.0, 0.0), 0.3 * stop, [*lights, *far], np.ones(41, bool))
    for stop in range(2, 8):  # round corners, and on where it was taken to be behind the robot
        pose = Pose(0.9 * stop, 0.1 * stop, 0.8 * stop)
        assert "once" in asked_first(memory, pose, 0.9 * stop)
        memory.record(pose, 0.9 * stop, [], np.arange(41) == 0)


def test_a_place_that_shows_nothing_is_doubted_until_the_label_is_seen_from_a_third_stop():
    memory = remembered(Pose(0.0, 0.0, 0.0), Pose(0.5, 0.0, 0.1))
    names = [camera.name for camera in rig()]
    sought = []
    for travelled in (1.0, 1.1, 1.2):
        sought.append(bool(memory.candidates(Pose(1.0, 0.0, 0.0), travelled, names).sought[0]))
        memory.record(Pose(1.0, 0.0, 0.0), travelled, [], np.ones(4, bool))
    assert sought == [False, False, True]
    pose = Pose(0.8, 0.0, 0.0)
    memory.candidates(pose, 1.4, names)
    memory.record(pose, 1.4, sightings_from(pose), np.ones(4, bool))
    assert not memory.candidates(Pose(1.0, 0.0, 0.0), 1.6, names).sought[0]


def test_a_label_seen_once_may_be_at_the_far_end_of_a_hall():
    memory = LabelMemory(LABELS, rig(), EIGHT)
    names = [camera.name for camera in rig()]
    memory.candidates(Pose(0.0, 0.0, 0.0), 0.0, names)
    memory.record(Pose(0.0, 0.0, 0.0), 0.0, [Sighting("front", "near", 319.5, 239.5)], np.ones(4, bool))  # 6.5 m ahead
    candidates = memory.candidates(Pose(5.0, 1.0, 0.0), 5.2, names)
    prior = memory.prior(candidates, ["front"], np.array([[319.5 + 268.5 * 1.0 / 1.5, 239.5]]))
    assert prior.ratios[0][list(prior.near).index(0)] > -0.5


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


# ---- the pose among known labels -------------------------------------------------------------------------------------

POSE = pose_matrix(0.4, -0.2, 0.3, 0.004, -0.006)


def known_lights(number, sigma=0.5, seed=0):
    """Labels round the robot, and where cameras at POSE see them."""
    rng = np.random.default_rng(seed)
    cameras = [Camera(model) for model in rig()]
    bearing = rng.uniform(-np.pi, np.pi, number)
    points = np.column_stack([1.5 * np.cos(bearing), 1.5 * np.sin(bearing), rng.uniform(0.3, 1.2, number)])
    camera = np.argmax([np.cos(bearing - 0.3 - turn) for turn in (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)], axis=0)
    pixels = np.zeros((number, 2))
    for light, index in enumerate(camera):
        there = transform_points(invert_rigid(POSE @ cameras[index].T_robot_camera), points[light : light + 1])
        pixels[light] = cameras[index].project(there)[0][0] + sigma * rng.standard_normal(2)
    return cameras, camera, pixels, points, np.broadcast_to(1e-6 * np.eye(3), (number, 3, 3))


def off(pose, heading):
    """How far a pose is from POSE in heading (rad) and place (m), started from one that is `heading` off."""
    return float(np.arccos(np.clip(0.5 * (np.trace(pose[:3, :3].T @ POSE[:3, :3]) - 1.0), -1, 1))), float(
        np.linalg.norm(pose[:3, 3] - POSE[:3, 3])
    )


@pytest.mark.parametrize("heading", [0.0, 0.02, 0.15, -0.25])
def test_lights_with_names_tell_the_pose_even_after_a_slip(heading):
    found = align(*known_lights(24), pose_matrix(0.4, -0.19, 0.3 + heading), 0.02, 2.0)
    turned, moved = off(found.T_world_robot, heading)
    assert turned < 0.004
    assert moved < 0.008
    assert found.spread < 0.6  # half a pixel where two were feared


def test_wrong_names_and_mirror_images_do_not_move_the_pose():
    cameras, camera, pixels, points, covariances = known_lights(24)
    pixels = pixels.copy()
    pixels[:6] += np.random.default_rng(1).uniform(-150.0, 150.0, (6, 2))
    found = align(cameras, camera, pixels, points, covariances, pose_matrix(0.4, -0.2, 0.28), 0.02, 2.0)
    assert max(off(found.T_world_robot, 0.0)) < 0.012


def test_too_few_lights_or_such_as_contradict_each_other_leave_the_pose_alone():
    start = pose_matrix(0.4, -0.2, 0.3)
    assert align(*known_lights(5), start, 0.02, 2.0) is None
    cameras, camera, pixels, points, covariances = known_lights(24)
    points = points[np.random.default_rng(2).permutation(24)]
    assert align(cameras, camera, pixels, points, covariances, start, 0.02, 2.0) is None


def test_after_a_slip_the_lights_named_first_tell_where_the_others_are():
    rng = np.random.default_rng(4)
    bearing = rng.uniform(-np.pi, np.pi, 40)
    points = np.column_stack([1.0 + 1.8 * np.cos(bearing), 1.8 * np.sin(bearing), rng.uniform(0.3, 1.0, 40)])
    labels = [f"L{k}" for k in range(40)]
    memory = LabelMemory(labels, rig(), EIGHT)
    names = [camera.name for camera in rig()]

    def seen_from(pose):
        for model in rig():
            camera = Camera(model)
            there = transform_points(
                invert_rigid(pose_matrix(pose.x, pose.y, pose.heading) @ camera.T_robot_camera), points
            )
            pixels, valid = camera.project(there)
            inside = valid & camera.in_image(np.where(valid[:, None], pixels, -1e6))
            yield from (Sighting(model.name, labels[k], *map(float, pixels[k])) for k in np.flatnonzero(inside))

    for travelled, x, slip in ((0.0, 0.7, 0.0), (0.3, 1.0, 0.0), (0.6, 1.3, 0.12), (0.9, 1.5, 0.12)):
        memory.candidates(Pose(x, 0.0, 0.1 + slip), travelled, names)
        sightings = list(seen_from(Pose(x, 0.0, 0.1)))
        places = np.array([(s.u, s.v) for s in sightings])
        if slip and travelled == 0.6:
            index = np.array([labels.index(s.label) for s in sightings], np.intp)
            before = named_by_place(memory, sightings, places)
            assert memory.align([s.camera for s in sightings[::3]], places[::3], index[::3])
            after = named_by_place(memory, sightings, places)
            assert before < 0.5 * len(sightings)
            assert after > 0.95 * len(sightings)
        elif slip:  # the next stop: the memory's axes went with the slip
            assert named_by_place(memory, sightings, places) > 0.9 * len(sightings)
        memory.record(Pose(x, 0.0, 0.1 + slip), travelled, sightings, np.ones(40, bool))


def named_by_place(memory, sightings, places):
    """How many lights are clearly likelier under their own label than under any other."""
    prior = memory.prior(Candidates.anything(len(memory.index)), [s.camera for s in sightings], places)
    best = prior.near[np.argmax(prior.ratios, axis=1)]
    sure = prior.ratios.max(axis=1) > 3.0
    return sum(f"L{k}" == s.label and clear for k, s, clear in zip(best, sightings, sure, strict=True))
