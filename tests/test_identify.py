import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotd.bind import bind
from robotd.errors import ConfigError
from robotd.identify import Identifier, IdentifyConfig
from robotd.identify.code import code_words, largest_prime, on_off_words
from robotd.identify.decoder import Evidence, Posterior, Prior, decode
from robotd.identify.delays import DelayModel
from robotd.identify.inquiry import Candidates, Inquiry, requests
from robotd.records import Frame
from robotd.vision.blink import FlashPattern

GAMMA = 2.2
SIZE = (120, 160)
EXPOSURE = 0.010
CONFIG = IdentifyConfig()
DURATIONS = np.array(CONFIG.durations_s)


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


@pytest.mark.parametrize("number", [2, 29, 100, 1000])
def test_on_off_words_have_one_weight_and_differ_in_four_slots(number):
    words = on_off_words(number, 2)
    lit = words == 0
    assert words.shape[0] == number
    assert set(np.unique(words)) == {-1, 0}
    assert len(np.unique(lit.sum(axis=1))) == 1
    sample = lit[:: max(1, number // 200)]
    distance = (sample[:, None] != sample[None]).sum(axis=2)[~np.eye(len(sample), dtype=bool)]
    assert distance.min() >= (4 if number > 2 else 2)
    np.testing.assert_array_equal(words, on_off_words(number, 2))


def test_the_largest_prime_alphabet_is_found():
    assert [largest_prime(number) for number in (2, 4, 7, 8, 30)] == [2, 3, 7, 7, 29]


# ---- decoding --------------------------------------------------------------------------------------------------------


def flashes(*seen, lights=None):
    """Scores and starts of lights that flashed: (duration or None, start) each."""
    scores = np.tile(-7.0 * DURATIONS, (lights or len(seen), 1))
    starts = np.zeros((len(scores), len(DURATIONS)))
    for light, (duration, start) in enumerate(seen):
        if duration is not None:
            scores[light] = 25.0 - 7.0 * np.abs(DURATIONS - duration)
            starts[light] = start
    return scores, starts


def ask(labels, durations, times, *seen, begun=0.0, window=20.0):
    symbols = np.array([list(CONFIG.durations_s).index(duration) for duration in durations])
    return Evidence(begun, np.array(labels), symbols, np.array(times, float), window, *flashes(*seen))


def name(*evidence, labels, lights=1, config=CONFIG, prior=None):
    return decode(evidence, prior or Prior(np.ones(labels)), lights, DelayModel(config))


def test_two_matching_durations_name_a_light_and_one_does_not():
    first = ask([0, 1, 2], [2, 3, 4], [0.0, 0.1, 0.2], (3, 3.0))
    second = ask([0, 1, 2], [5, 6, 7], [0.0, 0.1, 0.2], (6, 3.0), begun=30.0)
    once, twice = name(first, labels=3), name(first, second, labels=3)
    assert once.label[0] == twice.label[0] == 1
    assert once.probability[0] < CONFIG.min_probability < twice.probability[0]
    assert once.candidates[0][0][0] == 1


def test_a_lost_command_leaves_a_light_undecided_and_a_further_slot_names_it():
    lost = ask([0, 1], [2, 3], [0.0, 0.1], (None, 0.0))
    good = [ask([0, 1], [2 + k, 5 + k], [0.0, 0.1], (5 + k, 3.0), begun=30.0 * k) for k in (1, 2)]
    assert name(good[0], lost, labels=2).open(CONFIG.min_probability)[0]
    assert name(good[0], lost, good[1], labels=2).decided(CONFIG.min_probability)[0]


def test_the_moment_of_a_flash_tells_labels_of_equal_duration_apart():
    labels, turns = [0, 1, 2], [0.0, 20.0, 40.0]
    asked = [ask(labels, [4, 4, 4], turns, (4, 22.0), begun=60.0 * k, window=60.0) for k in range(2)]
    found = name(*asked, labels=3)
    assert (found.label[0], found.decided(0.9)[0]) == (1, True)
    unordered = IdentifyConfig(in_order=False)
    assert name(*asked, labels=3, config=unordered).probability[0] < 0.5


def test_a_light_that_flashed_once_and_never_again_is_no_label():
    first = ask([0, 1], [2, 3], [0.0, 0.1], (3, 3.0))
    dark = [ask([0, 1], [2, 3], [0.0, 0.1], (None, 0.0), begun=30.0 * k) for k in (1, 2, 3)]
    assert name(first, *dark, labels=2).none[0] > 0.8


def test_where_a_light_must_appear_names_it_with_one_flash():
    asked = ask([0, 1], [3, 3], [0.0, 0.1], (3, 2.0), (3, 2.0))
    near = Prior(np.ones(2), np.array([0, 1]), np.log(np.array([[1000.0, 0.05], [0.05, 1000.0]])))
    found = name(asked, labels=2, lights=2, prior=near)
    assert found.label.tolist() == [0, 1]
    assert found.probability.min() > 0.998


def test_a_label_that_has_its_light_is_the_less_likely_name_of_another():
    first = ask([0, 1], [2, 2], [0.0, 0.1], (2, 3.0), (2, 3.0))
    second = ask([0], [5], [0.0], (5, 3.0), (None, 0.0), begun=30.0)
    third = ask([0], [4], [0.0], (4, 3.0), (None, 0.0), begun=60.0)
    found = name(first, second, third, labels=2, lights=2)
    assert found.label.tolist() == [0, 1]
    assert found.probability[1] > 0.9


def test_lights_found_later_have_no_part_in_earlier_slots():
    first = ask([0, 1], [2, 5], [0.0, 0.1], (2, 3.0))
    second = ask([0, 1], [4, 3], [0.0, 0.1], (4, 3.0), (3, 3.0), begun=30.0)
    found = name(first, second, labels=2, lights=2)
    assert found.label.tolist() == [0, 1]
    assert found.probability[0] > found.probability[1]


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_probabilities_are_ones_whatever_flashes(data):
    count = data.draw(st.integers(1, 6))
    lights = data.draw(st.integers(0, 5))
    moment = st.tuples(st.none() | st.integers(2, 9), st.floats(-1e3, 1e3))
    evidence = []
    for slot in range(data.draw(st.integers(0, 3))):
        labels = data.draw(st.permutations(range(count)))[: data.draw(st.integers(1, count))]
        durations = data.draw(st.lists(st.integers(2, 9), min_size=len(labels), max_size=len(labels)))
        seen = data.draw(st.lists(moment, min_size=lights, max_size=lights))
        evidence.append(ask(labels, durations, np.arange(len(labels)), *seen, begun=50.0 * slot))
    found = name(*evidence, labels=count, lights=lights)
    assert np.isfinite(found.probability).all()
    for light in range(lights):
        assert 0.0 <= found.probability[light] <= 1.0 + 1e-6
        assert found.candidates[light][1].sum() + found.none[light] <= 1.0 + 1e-3
        assert found.candidates[light][1].sum() + found.none[light] >= 0.98


# ---- delays ----------------------------------------------------------------------------------------------------------


def test_poll_phase_and_delays_are_learnt_and_the_phase_is_kept_between_slots():
    rng = np.random.default_rng(3)
    delays = DelayModel(CONFIG)
    assert delays.median == pytest.approx(1.0)
    phase = 1.3
    for begun in np.arange(100.0, 150.0, 5.5):
        offset = (phase - begun) % 3.0
        delays.learn(begun, offset + 0.6 * np.exp(0.4 * rng.standard_normal(60)))
    assert delays.median == pytest.approx(0.6, rel=0.15)
    assert delays.sigma == pytest.approx(0.42, abs=0.12)
    expected = (phase - 150.0) % 3.0
    assert float(delays.offsets[np.argmax(delays.fetch(150.0))]) == pytest.approx(expected, abs=0.2)
    assert delays.fetch(150.0).max() > delays.fetch(5000.0).max()


def test_densities_and_fetch_probabilities_sum_to_one():
    delays = DelayModel(CONFIG)
    t = np.arange(0.0, 60.0, 0.001)
    assert delays.density(t).sum() * 0.001 == pytest.approx(1.0, abs=0.01)
    assert delays.fetch(17.0).sum() == pytest.approx(1.0)
    assert DelayModel(IdentifyConfig(poll_s=0.0)).fetch(3.0).tolist() == [1.0]


# ---- questions -------------------------------------------------------------------------------------------------------


def inquire(labels, config=CONFIG, **more):
    free = Candidates.anything(labels)
    made = Candidates(**({key: getattr(free, key) for key in free.__slots__} | more))
    return Inquiry(made, config, DelayModel(config))


def doubt(lists):
    """Lights between whose candidates nothing decides."""
    each = [(np.array(labels), np.full(len(labels), 1.0 / len(labels))) for labels in lists]
    first = np.array([labels[0] for labels in lists])
    return Posterior(first, np.array([odds[0] for _, odds in each]), np.zeros(len(lists)), each)


def answer(inquiry, t, lights=1):
    inquiry.begin(t)
    inquiry.answer(*flashes(*[(3, 2.0)] * lights), t + 15.0)


def test_the_first_question_asks_everybody_and_later_ones_only_those_in_doubt():
    inquiry = inquire(29)
    question = inquiry.next_question(None, 0.0)
    assert sorted(question.labels) == list(range(29))
    assert len(set(question.symbols.tolist())) > 3
    answer(inquiry, 0.0)
    again = inquiry.next_question(doubt([[3, 17, 5]]), 20.0)
    assert sorted(again.labels) == [3, 5, 17]
    assert len({(symbol, round(at / 3.0)) for symbol, at in zip(again.symbols, again.times, strict=True)}) == 3
    answer(inquiry, 20.0)
    sure = Posterior(np.array([3]), np.array([0.9999]), np.zeros(1), [(np.array([3]), np.array([0.9999]))])
    assert inquiry.next_question(sure, 40.0) is None


def test_labels_on_a_common_list_get_different_answers():
    inquiry = inquire(200)
    inquiry.next_question(None, 0.0)
    answer(inquiry, 0.0, lights=40)
    rng = np.random.default_rng(1)
    lists = [rng.choice(200, 6, replace=False) for _ in range(40)]
    question = inquiry.next_question(doubt(lists), 30.0)
    symbol = dict(zip(question.labels.tolist(), question.symbols.tolist(), strict=True))
    at = dict(zip(question.labels.tolist(), question.times.tolist(), strict=True))
    alike = [
        sum(symbol[a] == symbol[b] and abs(at[a] - at[b]) < 2.0 for a, b in itertools.combinations(labels, 2))
        for labels in lists
        if all(int(label) in at for label in labels)
    ]
    assert len(alike) > 20
    assert sum(alike) <= 0.1 * 15 * len(alike)  # at random an eighth of the pairs and more


def test_a_long_queue_is_cut_where_the_stop_has_no_time_for_more_and_the_others_come_first_at_the_next():
    config = IdentifyConfig(stop_s=60.0)
    first = inquire(1000, config).next_question(None, 0.0)
    assert 100 < len(first.labels) < 600
    assert float(first.times[-1]) < 60.0
    asked = np.zeros(1000, np.intp)
    asked[first.labels] = 1
    second = inquire(1000, config, asked=asked).next_question(None, 0.0)
    assert not set(first.labels) & set(second.labels) or len(second.labels) > 1000 - len(first.labels)


def test_unwanted_labels_are_not_asked_and_expected_ones_come_first():
    wanted = np.ones(40, bool)
    wanted[:10] = False
    expected = np.zeros(40, bool)
    expected[20:25] = True
    question = inquire(40, wanted=wanted, expected=expected).next_question(None, 0.0)
    assert set(question.labels) == set(range(10, 40))
    assert set(question.labels[:5]) == set(range(20, 25))


def test_some_known_labels_are_asked_twice_as_an_audit():
    expected = np.ones(60, bool)
    inquiry = inquire(60, expected=expected)
    inquiry.next_question(None, 0.0)
    audit = inquiry.audit
    assert 2 <= len(audit) <= 4
    answer(inquiry, 0.0, lights=60)
    everybody = [(np.array([label]), np.array([0.9999])) for label in range(60)]
    known = Posterior(np.arange(60), np.full(60, 0.9999), np.zeros(60), everybody)
    assert sorted(inquiry.next_question(known, 20.0).labels) == audit.tolist()


def test_one_at_a_time_asks_one_label_a_slot():
    inquiry = inquire(3, IdentifyConfig(scheme="one at a time"))
    for label in range(3):
        assert inquiry.next_question(None, 20.0 * label).labels.tolist() == [label]
        answer(inquiry, 20.0 * label)
    assert inquiry.next_question(doubt([[0, 1]]), 60.0) is None


def test_the_scheme_of_fixed_words_sends_the_words():
    words, planned = code_words(29, 7, 2)
    inquiry = inquire(29, IdentifyConfig(scheme="code"))
    for column in range(planned):
        question = inquiry.next_question(None, 20.0 * column)
        assert dict(zip(question.labels, question.symbols, strict=True)) == dict(enumerate(words[:, column]))
        assert (np.diff(question.symbols) <= 0).all()  # the longest are sent first
        answer(inquiry, 20.0 * column)


def test_requests_go_out_in_portions_before_their_turn():
    inquiry = inquire(100)
    question = inquiry.next_question(None, 0.0)
    names = [f"A{k}" for k in range(100)]
    portions = requests(question, names, CONFIG)
    assert [label for portion in portions for label in portion.labels] == [names[k] for k in question.labels]
    assert [portion.after for portion in portions] == [0.0, 0.0, 3.0, 6.0]
    assert all(set(portion.durations) <= set(CONFIG.durations_s) for portion in portions)


def test_a_slot_ends_when_commands_no_longer_arrive():
    inquiry = inquire(2)
    inquiry.next_question(None, 50.0)
    inquiry.begin(50.0)
    ends = np.arange(50.0, 80.0, 0.1)
    dark = next(t for t in ends if inquiry.is_over(t, np.inf, np.zeros(0, bool)))
    early = next(t for t in ends if inquiry.is_over(t, 51.0, np.ones(1, bool)))
    assert 50.0 + 3.0 + 3.0 < dark < 50.0 + inquiry.longest
    assert early < dark


@pytest.mark.parametrize(
    ("settings_", "reason"),
    [
        ({"durations_s": []}, "increase"),
        ({"durations_s": [2, 4, 3]}, "increase"),
        ({"durations_s": [0, 1, 2]}, "from 1 to 255"),
        ({"delay_median_s": 4.0}, "expected that the first is smaller"),
        ({"poll_s": -1.0}, "expected 0 to 60"),
        ({"pattern": {"period": 1.0, "on": [[0.2, 0.1]]}}, "increase within the period"),
        ({"check_digit": 1}, "did you mean 'check_digits'"),
        ({"scheme": "guess"}, "expected one of 'adaptive'"),
    ],
)
def test_wrong_settings_are_refused_in_words(settings_, reason):
    with pytest.raises(ConfigError, match=reason):
        bind(IdentifyConfig, settings_, "robotd.toml [identify]")


# ---- one stop --------------------------------------------------------------------------------------------------------


def test_beginning_another_slot_than_the_planned_one_is_refused():
    identifier = Identifier(["A"], ["front"], CONFIG)
    slot = identifier.next_slot(0.0)
    identifier.begin(slot, 0.0)
    with pytest.raises(ValueError, match="slot 0"):
        identifier.begin(slot, 1.0)


def test_repeated_and_reordered_frames_are_passed_over():
    identifier = Identifier(["a"], ["front"], CONFIG)
    slot = identifier.next_slot(0.0)
    identifier.begin(slot, 0.0)
    for t in (0.1, 0.2, 0.2, 0.15, 0.3):
        identifier.update("front", Frame("front", t, np.zeros((120, 160), np.uint8)))
    assert identifier.finish(20.0) == ()


def test_without_labels_or_cameras_nothing_is_asked_or_found():
    assert Identifier([], ["front"], CONFIG).next_slot(0.0) is None
    assert Identifier([], ["front"], CONFIG).finish(0.0) == ()
    identifier = Identifier(["A"], [], CONFIG)
    t = 0.0
    while (slot := identifier.next_slot(t)) is not None:
        identifier.begin(slot, t)
        t += 20.0
    assert identifier.finish(t) == ()


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
        for request in requests:
            self.free = max(self.free, self.poll + np.ceil((t + request.after - self.poll) / 3.0) * 3.0)
            for label, duration in zip(request.labels, request.durations, strict=True):
                self.free += 0.1
                start = self.free + self.rng.lognormal(0.0, np.log(3.0) / 1.645)
                if self.rng.random() < 0.02:
                    self.lost += 1
                    continue
                runs = self.runs.setdefault(label, [])
                if runs and sum(runs[-1]) > start:
                    runs[-1] = (runs[-1][0], start - runs[-1][0])
                runs.append((start, duration))

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
    while (slot := identifier.next_slot(t)) is not None:
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
    return identifier.finish(t), rooms, lengths


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
        assert sum(lengths) < 80.0


def test_the_period_of_the_pattern_decides_how_many_bursts_a_duration_has():
    config = IdentifyConfig(pattern=FlashPattern(0.5, [(0.0, 0.1), (0.2, 0.3)]))
    assert config.flash_config().pattern.period == 0.5
    assert Identifier(["A"], ["front"], config).next_slot(0.0) is not None
