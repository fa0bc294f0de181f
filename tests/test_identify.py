import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd.bind import bind
from robotd.errors import ConfigError
from robotd.identify import IdentifyConfig
from robotd.identify.code import code_words, largest_prime, on_off_words
from robotd.identify.decoder import Evidence, Posterior, Prior, decode
from robotd.identify.delays import DelayModel, turns
from robotd.identify.inquiry import Candidates, Inquiry, requests
from robotd.identify.pace import Pace
from tests.label_bench import coded_stops

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
        delays.learn(begun, offset + 0.6 * np.exp(0.4 * rng.standard_normal(60)), np.arange(60))
    assert delays.median == pytest.approx(0.6, rel=0.15)
    assert delays.sigma == pytest.approx(0.42, abs=0.12)
    expected = (phase - 150.0) % 3.0
    assert float(delays.offsets[np.argmax(delays.fetch(150.0))]) == pytest.approx(expected, abs=0.2)
    assert delays.fetch(150.0).max() > delays.fetch(5000.0).max()


@pytest.mark.parametrize("interval", [0.095, 0.1, 0.11])
def test_the_throughput_is_learnt_from_the_slope_of_the_flashes(interval):
    rng = np.random.default_rng(4)
    delays = DelayModel(CONFIG)
    assert not delays.rate_is_known
    turn = np.arange(0, 300, 3)
    for begun in (100.0, 200.0):
        seen = 1.0 + interval * turn + np.exp(0.6 * rng.standard_normal(len(turn)))
        delays.learn(begun, seen - delays.interval * turn, turn)
    assert delays.rate_is_known
    assert delays.interval == pytest.approx(interval, rel=0.02)


def test_commands_are_sent_in_turn_and_none_before_its_gate():
    assert turns(np.zeros(4), 0.5).tolist() == [0.0, 0.5, 1.0, 1.5]
    assert turns(np.array([0.0, 0.0, 3.0, 3.0]), 0.5).tolist() == [0.0, 0.5, 3.0, 3.5]
    assert turns(np.array([0.0, 0.0, 3.0, 3.0]), 2.0).tolist() == [0.0, 2.0, 4.0, 6.0]


def test_densities_and_fetch_probabilities_sum_to_one():
    delays = DelayModel(CONFIG)
    t = np.arange(0.0, 60.0, 0.001)
    assert delays.density(t).sum() * 0.001 == pytest.approx(1.0, abs=0.01)
    assert delays.fetch(17.0).sum() == pytest.approx(1.0)
    assert DelayModel(IdentifyConfig(poll_s=0.0)).fetch(3.0).tolist() == [1.0]


# ---- questions -------------------------------------------------------------------------------------------------------


def inquire(labels, config=CONFIG, seed=0, **more):
    free = Candidates.anything(labels)
    made = Candidates(**({key: getattr(free, key) for key in free.__slots__} | more))
    return Inquiry(made, config, DelayModel(config), seed)


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


def test_a_light_that_is_probably_a_reflection_of_a_named_one_is_not_worth_a_slot():
    for odds, worth in ((0.8, False), (0.5, True)):
        inquiry = inquire(29)
        inquiry.next_question(None, 0.0)
        answer(inquiry, 0.0, lights=3)
        named = [(np.array([label]), np.array([0.9999])) for label in (3, 5)]
        third = (np.array([3, 17]), np.array([odds, 1.0 - odds]))
        probability = np.array([0.9999, 0.9999, odds])
        posterior = Posterior(np.array([3, 5, 3]), probability, np.zeros(3), [*named, third])
        assert (inquiry.next_question(posterior, 20.0) is not None) == worth


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


def test_a_twentieth_of_the_known_labels_is_asked_twice_as_an_audit():
    expected = np.ones(60, bool)
    everybody = [(np.array([label]), np.array([0.9999])) for label in range(60)]
    known = Posterior(np.arange(60), np.full(60, 0.9999), np.zeros(60), everybody)
    audited, owed = [], 0.0
    for seed in range(80):
        inquiry = inquire(60, seed=seed, expected=expected, owed=owed)
        inquiry.next_question(None, 0.0)
        answer(inquiry, 0.0, lights=60)
        again = inquiry.next_question(known, 20.0)
        assert sorted([] if again is None else again.labels) == inquiry.audited.tolist()
        audited.append(len(inquiry.audited))
        owed += 0.05 * 60 - audited[-1]
    assert 0.04 <= np.mean(audited) / 60 <= 0.06
    assert np.mean(np.array(audited) > 0) < 0.2  # most stops need no slot for it


def test_an_audit_goes_with_a_slot_that_is_needed_anyway():
    everybody = [(np.array([label]), np.array([0.9999])) for label in range(58)]
    lists = [*everybody, *[(np.array([58, 59]), np.array([0.5, 0.5]))] * 3]
    sure = np.array([0.9999] * 58 + [0.5] * 3)
    inquiry = inquire(60, expected=np.ones(60, bool), owed=4.0)
    inquiry.next_question(None, 0.0)
    answer(inquiry, 0.0, lights=61)
    again = inquiry.next_question(Posterior(np.array([*range(58), 58, 58, 58]), sure, np.zeros(61), lists), 20.0)
    assert len(inquiry.audited) == 7  # what was owed, and a twentieth of these
    assert set(again.labels) >= {58, 59, *inquiry.audited.tolist()}


def test_a_stop_too_short_for_names_asks_a_few_labels_all_the_same():
    assert 1 <= len(inquire(50, IdentifyConfig(stop_s=10.0)).next_question(None, 0.0).labels) < 50


def test_labels_that_hardly_show_are_asked_along_with_known_ones():
    weights = np.where(np.arange(29) < 19, 0.9, 0.003)
    known = np.ones(29, bool)
    question = inquire(29, weights=weights, expected=np.arange(29) < 19, known=known).next_question(None, 0.0)
    assert sorted(question.labels) == list(range(29))  # a second's worth of commands


def test_the_more_lights_may_show_the_longer_their_names_take():
    pace = Pace(DelayModel(CONFIG))
    for weight in (0.003, 0.05, 0.5):
        seconds = [pace.seconds(5, others, weight * others) for others in (1, 5, 20, 60, 200, 1000)]
        assert (np.diff(seconds) > -0.08 * np.array(seconds[1:])).all()  # but for alphabets that fit by chance
        assert seconds[-1] > 3.0 * seconds[0]
    assert pace.seconds(25, 15, 0.05) < pace.seconds(25, 0, 0.0) + 8.0
    assert pace.affordable(25, np.full(15, 0.003), 60.0) == 15


def test_labels_that_are_sought_are_asked_again_when_they_were_silent():
    sought = np.arange(6) >= 4
    inquiry = inquire(6, expected=np.arange(6) < 3, known=np.ones(6, bool), sought=sought, weights=np.full(6, 0.4))
    inquiry.next_question(None, 0.0)
    answer(inquiry, 0.0)
    assert {4, 5} <= set(inquiry.next_question(doubt([[1, 2]]), 20.0).labels.tolist())


def test_a_light_that_may_be_foreign_is_asked_along_with_others_but_is_not_worth_a_slot():
    lists = [(np.array([3, 17]), np.array([0.5, 0.5])), (np.array([9]), np.array([0.2]))]
    for chosen, expected in ((slice(0, 2), {3, 17, 9}), (slice(1, 2), set())):
        inquiry = inquire(29, known=np.arange(29) == 0)
        inquiry.next_question(None, 0.0)
        answer(inquiry, 0.0, lights=len(lists[chosen]))
        found = Posterior(np.array([3, 9]), np.array([0.5, 0.2]), np.array([0.0, 0.8]), lists)
        found = Posterior(found.label[chosen], found.probability[chosen], found.none[chosen], lists[chosen])
        again = inquiry.next_question(found, 20.0)
        assert (set() if again is None else set(again.labels.tolist())) >= expected
        assert expected or again is None


def test_one_at_a_time_asks_one_label_a_slot():
    inquiry = inquire(3, IdentifyConfig(scheme="one at a time"))
    for label in range(3):
        assert inquiry.next_question(None, 20.0 * label).labels.tolist() == [label]
        answer(inquiry, 20.0 * label)
    assert inquiry.next_question(doubt([[2, 1], [2, 0]]), 60.0).labels.tolist() == [2]  # whose light is in doubt
    answer(inquiry, 60.0)
    named = Posterior(np.array([2]), np.array([0.9999]), np.zeros(1), [(np.array([2]), np.array([0.9999]))])
    assert inquiry.next_question(named, 80.0) is None


def test_labels_that_are_asked_one_at_a_time_get_their_names():
    outcome = coded_stops(8, 6, IdentifyConfig(scheme="one at a time"), [0])[0]
    assert (outcome.right, outcome.wrong) == (6, 0)


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
    inquiry.delays.learn(0.0, 1.0 + np.exp(0.4 * np.random.default_rng(0).standard_normal(200)), np.arange(200))
    assert inquiry.delays.rate_is_known
    portions = requests(question, names, CONFIG, inquiry.delays)
    assert [label for portion in portions for label in portion.labels] == [names[k] for k in question.labels]
    assert [portion.after for portion in portions] == [0.0, 3.0, 6.0]
    assert all(set(portion.durations) <= set(CONFIG.durations_s) for portion in portions)


def test_a_system_that_may_be_faster_gets_its_requests_earlier():
    inquiry = inquire(100)
    question = inquiry.next_question(None, 0.0)
    early = requests(question, [f"A{k}" for k in range(100)], CONFIG, inquiry.delays)
    assert [portion.after for portion in early] == [0.0]


def test_slots_in_which_nothing_was_seen_teach_nothing_about_the_system():
    inquiry = inquire(100)
    before = inquiry.delays.interval
    inquiry.next_question(None, 0.0)
    inquiry.begin(0.0)
    inquiry.answer(np.zeros((0, len(DURATIONS))), np.zeros((0, len(DURATIONS))), 15.0)
    posterior = inquiry.posterior(Prior(np.ones(100)), 0)
    assert posterior.none.shape == (0,)
    assert inquiry.delays.interval == before


def test_an_unknown_queue_is_waited_for_until_it_is_silent():
    inquiry = inquire(100)
    inquiry.next_question(None, 50.0)
    inquiry.begin(50.0)
    flashed = np.ones(10, bool)
    assert inquiry.is_over(90.0, 52.0, 72.0, flashed)
    assert not inquiry.is_over(90.0, 52.0, 85.0, flashed)  # one every 3.3 s: the next one may still come


def test_a_slot_ends_when_commands_no_longer_arrive():
    inquiry = inquire(2)
    inquiry.next_question(None, 50.0)
    inquiry.begin(50.0)
    ends = np.arange(50.0, 80.0, 0.1)
    dark = next(t for t in ends if inquiry.is_over(t, np.inf, -np.inf, np.zeros(0, bool)))
    early = next(t for t in ends if inquiry.is_over(t, 51.0, 53.0, np.ones(1, bool)))
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
