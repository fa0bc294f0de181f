import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotd.bind import bind
from robotd.errors import ConfigError
from robotd.identify import FlashRequest, Identifier, IdentifyConfig, code_words, posterior
from robotd.records import Frame
from robotd.vision.blink import FlashPattern

GAMMA = 2.2
SIZE = (120, 160)
EXPOSURE = 0.010
CONFIG = IdentifyConfig()


# ---- the code --------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 340), st.sampled_from([2, 3, 5, 7]), st.integers(0, 3))
def test_words_differ_in_more_slots_than_there_are_check_digits(number, symbols, check):
    words, planned = code_words(number, symbols, check, extra=1)
    information = next(k for k in range(1, 20) if symbols**k >= number)
    kept_checks = planned - information
    assert kept_checks == min(check, max(symbols + 1 - information, 0))
    assert words.shape[0] == number
    assert words.min() >= 0
    assert words.max() < symbols
    sent = words[:60, :planned]
    distance = (sent[:, None] != sent[None]).sum(axis=2)[~np.eye(len(sent), dtype=bool)]
    assert distance.min(initial=planned) >= kept_checks + 1


def test_any_slots_as_many_as_information_digits_tell_all_labels_apart():
    words, planned = code_words(44, 7, 2, extra=1)
    assert (planned, words.shape[1]) == (4, 5)
    for columns in itertools.combinations(range(words.shape[1]), 2):
        assert len(np.unique(words[:, columns], axis=0)) == 44


def test_few_labels_get_the_words_with_short_durations():
    words, planned = code_words(29, 7, 1)
    assert planned == 3
    assert words[:10].max() < words.max()
    assert (np.diff(words[:, :planned].max(axis=1)) >= 0).all()


def scores_of(words, slots, sure=20.0):
    return [
        np.where(np.arange(7) == words[:, [slot]], sure, sure - 10.0 * np.abs(np.arange(7) - words[:, [slot]]))
        for slot in slots
    ]


def test_all_labels_are_read_from_clear_flashes_and_one_lost_command_is_survived():
    words, planned = code_words(44, 7, 1)
    for lost in (None, 0, 2):
        scores = scores_of(words, range(planned))
        if lost is not None:
            scores[lost][:] = -10.0 * (2 + np.arange(7))
        odds = posterior(scores, list(words[:, :planned].T), CONFIG)
        np.testing.assert_allclose(odds.sum(axis=1), 1.0)
        np.testing.assert_array_equal(np.argmax(odds, axis=1), np.arange(44))
        assert odds.max(axis=1).min() > (0.999 if lost is None else 0.97)


def test_a_wrong_digit_leaves_a_light_undecided_or_right_but_never_another_label():
    words, planned = code_words(44, 7, 1)
    rng = np.random.default_rng(0)
    for slot in range(planned):
        seen = words.copy()
        seen[:, slot] = (seen[:, slot] + rng.integers(1, 7, 44)) % 7
        odds = posterior(scores_of(seen, range(planned)), list(words[:, :planned].T), CONFIG)
        best = np.argmax(odds, axis=1)
        assert not ((odds.max(axis=1) >= CONFIG.min_probability) & (best != np.arange(44)) & (best != 44)).any()


def test_a_light_that_never_flashes_is_no_label():
    words, planned = code_words(29, 7, 1)
    dark = [np.tile(-10.0 * (2 + np.arange(7)), (1, 1)) for _ in range(planned)]
    odds = posterior(dark, list(words[:, :planned].T), CONFIG)
    assert odds[0, -1] > 0.9


def test_a_label_that_was_not_asked_is_no_candidate_for_a_flash():
    digits = np.array([3, -1])
    odds = posterior([np.array([[0.0, 10.0, 20.0, 30.0, 20.0, 10.0, 0.0]])], [digits], CONFIG)
    assert odds[0, 0] > 0.9
    assert odds[0, 1] < 0.01


def test_ten_thousand_labels_are_scored_at_once():
    words, planned = code_words(10_000, 7, 2)
    assert planned == 7
    seen = words[[17, 9_999, 5_000]]
    odds = posterior(scores_of(seen, range(planned)), list(words[:, :planned].T), CONFIG)
    assert np.argmax(odds, axis=1).tolist() == [17, 9_999, 5_000]
    assert odds.max(axis=1).min() > 0.999


@pytest.mark.parametrize(
    ("settings_", "reason"),
    [
        ({"durations_s": [2, 3, 4, 5]}, "prime"),
        ({"durations_s": [2, 4, 3]}, "increase"),
        ({"durations_s": [0, 1, 2]}, "1 or more"),
        ({"poll_s": -1.0}, "expected 0 to 60"),
        ({"pattern": {"period": 1.0, "on": [[0.2, 0.1]]}}, "increase within the period"),
        ({"check_digit": 1}, "did you mean 'check_digits'"),
    ],
)
def test_wrong_settings_are_refused_in_words(settings_, reason):
    with pytest.raises(ConfigError, match=reason):
        bind(IdentifyConfig, settings_, "robotd.toml [identify]")


# ---- slots -----------------------------------------------------------------------------------------------------------


def test_slots_ask_every_label_once_and_the_longest_first():
    labels = tuple(f"A{k}" for k in range(29))
    identifier = Identifier(labels, ["front"], CONFIG)
    slot = identifier.next_slot()
    assert slot.number == 0
    assert slot.requests == (FlashRequest(labels, 3),)
    assert slot.timeout > 3.0 + 2.9 + 6.0 + 3.0
    words, planned = code_words(29, 7, 1)
    for column in range(planned):
        identifier.begin(slot, 20.0 * column)
        slot = identifier.next_slot()
        asked = {label: request.duration for request in slot.requests for label in request.labels}
        assert asked == {label: int(word[column]) + 2 for label, word in zip(labels, words, strict=True)}
        durations = [request.duration for request in slot.requests]
        assert durations == sorted(durations, reverse=True)
    identifier.begin(slot, 100.0)
    assert identifier.next_slot() is None
    assert identifier.finish() == ()


def test_a_slot_with_nothing_to_see_ends_when_commands_no_longer_arrive():
    identifier = Identifier(["A", "B"], ["front"], CONFIG)
    slot = identifier.next_slot()
    assert not identifier.is_complete(1e9)
    identifier.begin(slot, 50.0)
    latest = 50.0 + 3.0 + 0.2 + 6.0 + 2.0
    assert not identifier.is_complete(latest - 0.01)
    assert identifier.is_complete(latest + 0.01)
    assert latest < 50.0 + slot.timeout


def test_beginning_another_slot_than_the_planned_one_is_refused():
    identifier = Identifier(["A"], ["front"], CONFIG)
    slot = identifier.next_slot()
    identifier.begin(slot, 0.0)
    with pytest.raises(ValueError, match="slot 0"):
        identifier.begin(slot, 1.0)


def test_repeated_and_reordered_frames_are_passed_over():
    identifier = Identifier(["a"], ["front"], CONFIG)
    slot = identifier.next_slot()
    identifier.begin(slot, 0.0)
    for t in (0.1, 0.2, 0.2, 0.15, 0.3):
        identifier.update("front", Frame("front", t, np.zeros((120, 160), np.uint8)))
    assert identifier.finish() == ()


def test_without_labels_or_cameras_nothing_is_asked_or_found():
    assert Identifier([], ["front"], CONFIG).next_slot() is None
    assert Identifier([], ["front"], CONFIG).finish() == ()
    identifier = Identifier(["A"], [], CONFIG)
    while (slot := identifier.next_slot()) is not None:
        identifier.begin(slot, 0.0)
    assert identifier.finish() == ()


# ---- from requests through pixels to names ---------------------------------------------------------------------------


class LabelSystem:
    """Polled every 3 s, 10 commands a second, lognormal delays (median 1 s, 95 % below 3 s), 2 % lost, clocks off."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.poll = self.rng.uniform(0.0, 3.0)
        self.free = 0.0
        self.runs = {}
        self.lost = 0

    def flash(self, t, requests):
        self.free = max(self.free, self.poll + np.ceil((t - self.poll) / 3.0) * 3.0)
        for request in requests:
            for label in request.labels:
                self.free += 0.1
                start = self.free + self.rng.lognormal(0.0, np.log(3.0) / 1.645)
                if self.rng.random() < 0.02:
                    self.lost += 1
                    continue
                runs = self.runs.setdefault(label, [])
                if runs and sum(runs[-1]) > start:
                    runs[-1] = (runs[-1][0], start - runs[-1][0])
                runs.append((start, request.duration))

    def share(self, label, t):
        x = np.linspace(t, t + EXPOSURE, 7)
        total = 0.0
        for start, duration in self.runs.get(label, ()):
            if start - EXPOSURE < t < start + duration + 1.0:
                since = (x - start) * (1.0 + 0.001 * np.sin(len(label) + ord(label[-1])))
                phase = since % 1.0
                total += np.mean((since >= 0) & (since < duration) & (phase < 0.5) & (phase % 0.2 < 0.1))
        return total


class Room:
    """What one camera sees: lights of labels (some twice, as reflections), noise, sometimes a passer-by."""

    def __init__(self, seed, visible, reflected):
        self.rng = rng = np.random.default_rng(seed)
        height, width = SIZE
        self.wall = 90.0 + 12.0 * np.sin(np.arange(width) / 4.0) * np.cos(np.arange(height)[:, None] / 6.0)
        places = [(u, v) for v in (20, 44, 68, 92) for u in (20, 44, 68, 92, 116, 140)]
        rng.shuffle(places)
        self.lights = []
        for label, (u, v) in zip([*visible, *reflected], places, strict=False):
            u, v = u + rng.uniform(-3, 3), v + rng.uniform(-3, 3)
            box = np.s_[round(v) - 6 : round(v) + 7, round(u) - 6 : round(u) + 7]
            rows, columns = np.mgrid[box]
            bell = np.exp(-0.5 * ((rows - v) ** 2 + (columns - u) ** 2) / 1.1**2)
            grey = self.wall[round(v), round(u)]
            light = ((grey + np.exp(rng.uniform(np.log(9), np.log(250)))) / 255.0) ** GAMMA - (grey / 255.0) ** GAMMA
            self.lights.append((label, u, v, box, bell * light))
        self.noise = rng.normal(0.0, 2.0, (height, 4 * width))

    def frame(self, t, system):
        grey = self.wall.copy()
        for label, _, v, box, light in self.lights:
            share = system.share(label, t + v * 0.03 / SIZE[0])
            if share:
                grey[box] = 255.0 * ((grey[box] / 255.0) ** GAMMA + share * light) ** (1.0 / GAMMA)
        left = int(60.0 * (t % 20.0)) - 20
        if left < SIZE[1]:
            grey[50:, max(left, 0) : max(left + 16, 0)] = 50.0
        shift = int(self.rng.integers(3 * SIZE[1]))
        return np.clip(np.rint(grey + self.noise[:, shift : shift + SIZE[1]]), 0, 255).astype(np.uint8)


def survey_one_stop(seed, labels, cameras=("left", "right"), config=CONFIG):
    rng = np.random.default_rng(seed)
    system = LabelSystem(seed)
    rooms = {}
    for k, camera in enumerate(cameras):
        visible = [str(label) for label in rng.choice(labels, 9, replace=False)]
        rooms[camera] = Room(seed + 10 * k, visible, visible[:1])
    identifier = Identifier(labels, cameras, config)
    offset = rng.uniform(-0.05, 0.05)
    t = 30.0
    lengths = []
    while (slot := identifier.next_slot()) is not None:
        system.flash(t, slot.requests)
        identifier.begin(slot, t)
        begun = t
        while t < begun + slot.timeout and not identifier.is_complete(t):
            t += 1 / 30
            taken = t - 0.1
            for camera, room in rooms.items():
                if rng.random() > 0.005:
                    stamp = taken + offset + float(np.clip(rng.normal(0.0, 0.002), -0.01, 0.01))
                    identifier.update(camera, Frame(camera, stamp, room.frame(taken, system)))
        lengths.append(t - begun)
    return identifier.finish(), rooms, lengths


def test_visible_labels_are_named_and_none_wrongly():
    labels = [f"L{k:02}" for k in range(29)]
    for seed in (1, 2):
        sightings, rooms, lengths = survey_one_stop(seed, labels)
        named = wrong = 0
        residuals = []
        for camera, room in rooms.items():
            for label, u, v, _, _ in room.lights:
                here = [s for s in sightings if s.camera == camera and np.hypot(s.u - u, s.v - v) < 4.0]
                named += [s.label for s in here] == [label]
                wrong += any(s.label != label for s in here)
                residuals += [(s.u - u) / s.sigma_px for s in here] + [(s.v - v) / s.sigma_px for s in here]
                assert all(s.probability >= CONFIG.min_probability for s in here)
            first = room.lights[0][0]
            assert sum(s.camera == camera and s.label == first for s in sightings) <= 2
        assert wrong == 0
        assert named >= 18  # of 20 lights, one pair of rivals per camera among them
        assert len(sightings) <= 20
        assert np.median(np.abs(residuals)) < 1.5
        assert 4 <= len(lengths) <= 5
        assert sum(lengths) < 80.0


def test_code_words_can_do_without_a_slot_for_finding():
    config = IdentifyConfig(find_duration_s=0, check_digits=2, max_repeats=0)
    labels = [f"L{k:02}" for k in range(20)]
    sightings, rooms, lengths = survey_one_stop(4, labels, cameras=("front",), config=config)
    lights = {(label, round(u), round(v)) for label, u, v, _, _ in rooms["front"].lights}
    assert len(lengths) == 4
    assert len(sightings) >= 8
    for s in sightings:
        assert min(np.hypot(s.u - u, s.v - v) for label, u, v in lights if label == s.label) < 4.0


def test_the_period_of_the_pattern_decides_how_many_bursts_a_duration_has():
    config = IdentifyConfig(pattern=FlashPattern(0.5, [(0.0, 0.1), (0.2, 0.3)]))
    assert config.flash_config().pattern.period == 0.5
    assert Identifier(["A"], ["front"], config).next_slot() is not None
