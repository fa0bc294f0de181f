import itertools
import struct

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from robotd import oi
from robotd.roomba import line as roomba_line
from tests.fuzz.adversary import BASE, LAYOUTS, Score, damaged, judge, tempting_frame, unbroken

WORKED = bytes((19, 5, 29, 2, 25, 13, 0, 163))  # request 148 2 29 13; Create 2 Open Interface 2016
WORKED_500 = WORKED[:-1] + bytes((182,))  # the same frame in the Roomba 500's manual, header not summed
IDS = (29, 13)
SIZE = len(WORKED)


def values_of(events):
    return [dict(event.values) for event in events if isinstance(event, oi.SensorValues)]


def skipped_of(events):
    return b"".join(event.data for event in events if isinstance(event, oi.Skipped))


def shape(events):
    return [
        (
            type(event).__name__,
            getattr(event, "values", None),
            getattr(event, "end", None),
            getattr(event, "data", None),
            getattr(event, "reason", None),
        )
        for event in events
    ]


# ---- the manuals' bytes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (("drive", -200, 500), "137 255 56 1 244"),
        (("motors", 13), "138 13"),
        (("leds", 4, 0, 128), "139 4 0 128"),
        (("query", 7, 13), "149 2 7 13"),
        (("schedule", 40, 0, 0, 0, 0, 0, 0, 15, 0, 0, 0, 10, 36, 0, 0), "167 40 0 0 0 0 0 0 15 0 0 0 10 36 0 0"),
        (("drive_direct", -200, 500), "145 255 56 1 244"),
        (("stream", 29, 13), "148 2 29 13"),
        (("start",), "128"),
    ],
)
def test_commands_are_the_bytes_of_the_manual(command, expected):
    data = bytes(map(int, expected.split()))
    assert oi.encode(*command) == data
    assert oi.CommandDecoder().feed(data) == [oi.Command(command[0], command[1:])]


@pytest.mark.parametrize(
    ("frame", "kind", "expected"),
    [
        (WORKED, "inclusive", {29: 537, 13: 0}),
        (WORKED_500, "exclusive", {29: 537, 13: 0}),
        (bytes((19, 5, 29, 9, 215, 13, 0, 222)), "inclusive", {29: 2519, 13: 0}),
    ],
)
@pytest.mark.parametrize("before", [b"", bytes((13, 0, 168)), b"\x13", b"\x13\x05", b"Roomba by iRobot!\r\n"])
def test_frames_of_the_manual_decode_whole_bytewise_and_among_other_bytes(frame, kind, expected, before):
    assert oi.encode_stream_frame(IDS, expected, kind) == frame
    data = before + frame + bytes((19, 5, 29, 4))
    whole, bytewise = oi.StreamDecoder(IDS, kind), oi.StreamDecoder(IDS, kind)
    events = whole.feed(data)
    assert values_of(events) == [expected]
    assert skipped_of(events) == before
    assert whole.pending == bytes((19, 5, 29, 4))
    assert shape(events) == shape([event for byte in data for event in bytewise.feed(bytes((byte,)))])


@pytest.mark.parametrize(
    ("dump", "expected"),
    [
        ("003f2aff732109cc0a88", {21: 0, 22: 16170, 23: -141, 24: 33, 25: 2508, 26: 2696}),
        ("003cf8ff9114076e0814", {21: 0, 22: 15608, 23: -111, 24: 20, 25: 1902, 26: 2068}),
    ],
)
def test_recorded_battery_groups_decode(dump, expected):
    assert oi.decode_values([3], bytes.fromhex(dump)) == expected
    assert oi.encode_values([3], expected).hex() == dump


def test_groups_have_the_manual_s_sizes():
    sizes = {0: 26, 1: 10, 2: 6, 3: 10, 4: 14, 5: 12, 6: 52, 100: 80, 101: 28, 106: 12, 107: 9}
    assert {group: sum(oi.PACKETS[number].size for number in oi.GROUPS[group]) for group in sizes} == sizes
    assert sorted(oi.PACKETS) == list(range(7, 59))


# ---- frames ----------------------------------------------------------------------------------------------------------

frames = st.lists(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 255)), max_size=6)
noise = st.one_of(st.binary(max_size=80), st.lists(st.sampled_from([19, 5, 29, 13]), max_size=40).map(bytes))


def frame_bytes(rows, kind="inclusive"):
    return b"".join(oi.encode_stream_frame(IDS, {29: a, 13: b}, kind) for a, b in rows)


@settings(deadline=None)
@given(
    pieces=st.lists(st.one_of(noise, frames.map(frame_bytes)), max_size=5),
    cuts=st.lists(st.integers(0, 300)),
    kind=st.sampled_from(["inclusive", "exclusive", "auto"]),
)
def test_any_chunking_gives_the_same_events_and_every_byte_is_accounted_for(pieces, cuts, kind):
    data = b"".join(pieces)
    whole, cut = oi.StreamDecoder(IDS, kind), oi.StreamDecoder(IDS, kind)
    events = whole.feed(data)
    edges = [0, *sorted(min(place, len(data)) for place in cuts), len(data)]
    assert shape(events) == shape([event for a, b in itertools.pairwise(edges) for event in cut.feed(data[a:b])])
    assert whole.pending == cut.pending
    rebuilt, position = b"", 0
    for event in events:  # the events tell where every byte went, in order
        if isinstance(event, oi.Skipped):
            rebuilt += event.data
        else:
            rebuilt += data[event.end - SIZE : event.end]
        position = len(rebuilt)
        if isinstance(event, oi.SensorValues):
            assert position == event.end
    assert rebuilt + whole.pending == data
    counters = whole.counters
    assert counters.frames == len(values_of(events))
    assert counters.skipped_bytes + counters.frames * SIZE <= len(data) == whole.fed
    assert len(data) - counters.skipped_bytes - counters.frames * SIZE < SIZE  # the start of a frame, at most
    rejected = [event for event in events if isinstance(event, oi.Skipped) and event.reason != "noise"]
    assert counters.bad_length + counters.bad_order + counters.bad_checksum in (len(rejected), len(rejected) + 1)


@settings(deadline=None)
@given(
    before=st.binary(max_size=60),
    rows=st.lists(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 255)), min_size=2, max_size=4),
)
def test_every_frame_after_noise_is_found_as_soon_as_it_is_complete(before, rows):
    decoder = oi.StreamDecoder(IDS)
    decoder.feed(before)
    found = values_of(decoder.feed(frame_bytes(rows)))
    assert found[-len(rows) :] == [{29: a, 13: b} for a, b in rows]


@pytest.mark.parametrize("phase", range(11))
def test_standing_still_makes_no_false_frame(phase):
    """Open Interface notes, section 5 rule 1: 0x13 0x08 inside equal frames of 11 bytes passes length and checksum."""
    ids, truth = (43, 44, 35), {43: 0x1308, 44: 7, 35: 2}
    decoder = oi.StreamDecoder(ids)
    found = values_of(decoder.feed((oi.encode_stream_frame(ids, truth) * 50)[phase:]))
    assert found == [truth] * (50 if phase == 0 else 49)
    assert decoder.counters.bad_order <= 1


def temptations(data, layout, checksum):
    """How many windows of a stream have a frame's header, length and checksum."""
    array = np.frombuffer(data, np.uint8)
    total = np.concatenate([[0], np.cumsum(array, dtype=np.int64)])
    starts = np.flatnonzero((array[:-1] == oi.HEADER) & (array[1:] == layout.length))
    starts = starts[starts + layout.frame_size <= len(array)]
    sums = total[starts + layout.frame_size] - total[starts]
    return int((sums % 256 == (oi.HEADER if checksum == "exclusive" else 0)).sum())


@pytest.mark.parametrize("checksum", [None, "auto"])
def test_no_false_frame_in_a_million_adversarial_bytes(checksum):
    """Equal frames full of headers, from any byte on: the length and the sum are right at far more places than frames.

    Where the layout cannot be imitated every whole frame is found, too.
    """
    score, tempting, clear = Score(), 0, Score()
    for stream in unbroken(np.random.default_rng(20), 1_000_000):
        layout = oi.StreamLayout(stream.packet_ids)
        tempting += temptations(stream.data, layout, stream.checksum)
        judge(stream, score, checksum)
        if not layout.lookalikes:
            judge(stream, clear, checksum)
    assert score.bytes >= 1_000_000
    assert score.false == 0
    assert tempting > score.sent + 10_000
    assert clear.found == clear.sent > 10_000


def test_damaged_streams_yield_no_more_false_frames_than_an_8_bit_sum_lets_through():
    score, rng = Score(), np.random.default_rng(21)
    for stream in unbroken(rng, 300_000, [BASE]):
        decoder = oi.StreamDecoder(stream.packet_ids, stream.checksum)
        true = set(stream.frames.values())
        contents = [decoder.layout.decode(frame) for frame in true]
        for event in decoder.feed(damaged(stream, rng, 0.003)):
            if isinstance(event, oi.SensorValues):
                score.found += 1
                score.false += event.values not in contents
        score.sent += len(stream.frames)
    hurt = score.sent - score.found
    assert hurt > 300
    assert score.false <= 2 + 3 * hurt / 256


@settings(deadline=None)
@given(seed=st.integers(0, 2**32), ids=st.sampled_from(LAYOUTS), phase=st.integers(0, 90), step=st.integers(1, 200))
def test_equal_frames_that_look_like_others_are_found_in_step_or_not_at_all(seed, ids, phase, step):
    layout = oi.StreamLayout(ids)
    frame = tempting_frame(layout, np.random.default_rng(seed), "inclusive")
    data = (frame * 12)[phase % layout.frame_size :]
    decoder = oi.StreamDecoder(ids)
    ends = [
        event.end
        for start in range(0, len(data), step)
        for event in decoder.feed(data[start : start + step])
        if isinstance(event, oi.SensorValues)
    ]
    whole = range(12 * layout.frame_size - phase % layout.frame_size, 0, -layout.frame_size)
    assert set(ends) <= set(whole)
    if not layout.lookalikes:
        assert len(ends) == 12 - (phase % layout.frame_size > 0)


def test_a_frame_that_can_be_imitated_is_told_by_where_the_last_one_ended():
    ids = (100,)
    layout = oi.StreamLayout(ids)
    data = bytearray(layout.encode([0] * len(layout.keys)))
    data[20:23] = 19, layout.length, 100
    frame = layout.encode(list(layout.decode(bytes(data)).values()))
    plain = layout.encode([1] * len(layout.keys))
    torn = frame[:4] + b"\x07" + frame[5:]
    window = (frame * 2)[20:]
    assert layout.is_framed(window[: layout.frame_size])
    assert sum(window[: layout.frame_size]) % 256 == 0
    decoder = oi.StreamDecoder(ids)
    assert len(values_of(decoder.feed(plain + torn + frame * 3))) == 4
    assert decoder.counters.bad_checksum == 1
    assert decoder.counters.ambiguous == 1

    lost = oi.StreamDecoder(ids)
    assert values_of(lost.feed(frame[5:] + frame * 3)) == []
    assert lost.counters.ambiguous >= 3
    assert len(values_of(lost.feed(plain * 3))) >= 2


def test_the_driver_s_streams_cannot_be_imitated_by_their_own_data():
    """StreamDecoder: then no window over two frames has its ids in order, and none is ever refused as ambiguous."""
    requests = [value for name, value in vars(roomba_line).items() if name.startswith("PACKETS")]
    assert requests
    for ids in requests:
        assert oi.StreamLayout(ids).lookalikes == ()
    assert oi.StreamLayout((43, 44, 35)).lookalikes == ()
    assert 20 in oi.StreamLayout((100,)).lookalikes
    assert oi.StreamLayout((19,)).lookalikes == (2, 3, 4)


@settings(deadline=None)
@given(
    before=st.lists(st.sampled_from([19, 5, 29, 13, 34, 255]), max_size=40).map(bytes),
    rows=st.lists(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 255)), min_size=1, max_size=3),
)
def test_a_false_header_with_any_length_delays_no_frame(before, rows):
    """The length asked for is known, so another one is refused at once, and a right one waits for one frame at most."""
    decoder = oi.StreamDecoder(IDS)
    decoder.feed(before)
    found = []
    for a, b in rows:
        found = values_of(decoder.feed(oi.encode_stream_frame(IDS, {29: a, 13: b})))
        assert found[-1:] == [{29: a, 13: b}]
        assert len(decoder.pending) < SIZE


def test_answers_and_text_between_frames_cost_no_frame():
    answer = oi.encode_values([0], dict.fromkeys(oi.members(0), 19))
    data = b"".join(part + WORKED for part in (b"", answer, b"Soft reset!\r\n\xfe", bytes((19, 255)), bytes((19, 19))))
    decoder = oi.StreamDecoder(IDS)
    assert len(values_of(decoder.feed(data))) == 5
    assert decoder.counters.skipped_bytes == len(data) - 5 * SIZE
    assert decoder.pending == b""


def test_a_long_text_between_frames_does_not_fill_the_buffer():
    decoder = oi.StreamDecoder(IDS)
    text = b"bat: 14210 mV\r\n" * 1000
    events = decoder.feed(text)
    assert skipped_of(events) + decoder.pending == text
    assert len(decoder.pending) < decoder.RUN
    assert decoder.counters.skipped_bytes == len(text)


@pytest.mark.parametrize(
    ("spoil", "reason", "counter"),
    [
        (lambda f: f[:1] + bytes((6,)) + f[2:], "length", "bad_length"),
        (lambda f: f[:2] + bytes((30,)) + f[3:-1] + bytes((f[-1] - 1,)), "order", "bad_order"),
        (lambda f: f[:-1] + bytes((f[-1] ^ 1,)), "checksum", "bad_checksum"),
    ],
)
def test_a_rejected_frame_is_counted_by_its_fault(spoil, reason, counter):
    decoder = oi.StreamDecoder(IDS)
    events = decoder.feed(spoil(WORKED) + WORKED)
    assert [event.reason for event in events if isinstance(event, oi.Skipped)] == [reason]
    assert getattr(decoder.counters, counter) == 1
    assert len(values_of(events)) == 1


@pytest.mark.parametrize(("kind", "frame"), [("inclusive", WORKED), ("exclusive", WORKED_500)])
def test_auto_takes_both_checksums_until_ten_frames_agreed(kind, frame):
    other = WORKED_500 if kind == "inclusive" else WORKED
    decoder = oi.StreamDecoder(IDS, "auto")
    assert len(values_of(decoder.feed(other + frame * 9))) == 10
    assert decoder.checksum == "auto"
    assert len(values_of(decoder.feed(frame))) == 1
    assert decoder.checksum == kind
    assert not values_of(decoder.feed(other))
    assert len(values_of(decoder.feed(frame * 2))) == 2


@pytest.mark.parametrize("kind", ["inclusive", "exclusive"])
def test_a_fixed_checksum_refuses_the_other_kind(kind):
    frames_ = {"inclusive": WORKED, "exclusive": WORKED_500}
    for name, frame in frames_.items():
        assert bool(values_of(oi.StreamDecoder(IDS, kind).feed(frame))) == (name == kind)


@settings(deadline=None)
@given(data=st.data())
def test_stream_frames_round_trip(data):
    ids = data.draw(st.lists(st.sampled_from([*oi.PACKETS, 1, 2, 3, 106]), min_size=1, max_size=12, unique=True))
    keys = [key for number in ids for key in oi.members(number)]
    ranges = {"B": (0, 255), "b": (-128, 127), "H": (0, 0xFFFF), "h": (-0x8000, 0x7FFF)}
    values = {key: data.draw(st.integers(*ranges[oi.PACKETS[key].code])) for key in keys}
    kind = data.draw(st.sampled_from(["inclusive", "exclusive"]))
    frame = oi.encode_stream_frame(ids, values, kind)
    assert len(frame) == oi.StreamLayout(ids).frame_size
    assert sum(frame[kind == "exclusive" :]) % 256 == 0
    assert values_of(oi.StreamDecoder(ids, kind).feed(frame)) == [values]
    assert oi.decode_values(ids, oi.encode_values(ids, values)) == values


def test_bad_requests_are_refused_with_a_reason():
    with pytest.raises(ValueError, match="packet 59 does not exist"):
        oi.StreamDecoder([59])
    with pytest.raises(ValueError, match="expected 1 to 255"):
        oi.StreamDecoder([])
    with pytest.raises(ValueError, match="got 3 bytes"):
        oi.decode_values([3], b"abc")


# ---- commands --------------------------------------------------------------------------------------------------------


@st.composite
def commands(draw):
    spec = draw(st.sampled_from(list(oi.COMMANDS.values())))
    values = [
        draw(st.one_of(st.integers(a.low, a.high), *(st.just(extra) for extra in a.besides))) for a in spec.arguments
    ]
    if spec.name == "song":
        values += draw(
            st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), min_size=1, max_size=16).map(
                lambda notes: [value for note in notes for value in note]
            )
        )
    elif spec.name == "sensors":
        values = [draw(st.sampled_from([*oi.PACKETS, *oi.GROUPS]))]
    elif spec.counted:
        values += draw(st.lists(st.sampled_from([*oi.PACKETS, *oi.GROUPS]), max_size=255))
    return oi.Command(spec.name, tuple(values))


@settings(deadline=None)
@given(sent=st.lists(commands(), max_size=6), cuts=st.lists(st.integers(0, 200)))
def test_every_command_round_trips_in_any_chunks(sent, cuts):
    data = b"".join(oi.encode(command.name, *command.values) for command in sent)
    edges = [0, *sorted(min(place, len(data)) for place in cuts), len(data)]
    decoder = oi.CommandDecoder()
    assert [event for a, b in itertools.pairwise(edges) for event in decoder.feed(data[a:b])] == sent
    assert decoder.pending == b""
    assert (decoder.commands, decoder.skipped_bytes) == (len(sent), 0)


@settings(deadline=None)
@given(command=commands(), data=st.data())
def test_every_question_s_answer_round_trips_by_the_command_that_the_robot_heard(command, data):
    """Both ends agree on the answer's length from the question alone, because the answer carries no ids."""
    ids = command.values if command.name in ("sensors", "query") else ()
    (heard,) = oi.CommandDecoder().feed(oi.encode(command.name, *command.values))
    ranges = {"B": (0, 255), "b": (-128, 127), "H": (0, 0xFFFF), "h": (-0x8000, 0x7FFF)}
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    keys = sorted({key for number in ids for key in oi.members(number)})
    values = {key: int(rng.integers(*ranges[oi.PACKETS[key].code])) for key in keys}
    answer = oi.encode_values(heard.values if ids else (), values)
    assert len(answer) == sum(oi.PACKETS[key].size for number in ids for key in oi.members(number))
    assert oi.decode_values(ids, answer) == values


def test_every_opcode_of_the_manual_is_known_with_its_number_of_arguments():
    """Open Interface notes, section 3; counted commands are listed with their fixed arguments."""
    arguments = {7: 0, 128: 0, 129: 1, 130: 0, 131: 0, 132: 0, 133: 0, 134: 0, 135: 0, 136: 0, 137: 4, 138: 1}
    arguments |= {139: 3, 140: 1, 141: 1, 142: 1, 143: 0, 144: 3, 145: 4, 146: 4, 148: 0, 149: 0, 150: 1, 162: 2}
    arguments |= {163: 4, 164: 4, 165: 1, 167: 15, 168: 3, 173: 0}
    assert {opcode: struct.calcsize(spec.code) for opcode, spec in oi.COMMANDS.items()} == arguments
    assert [opcode for opcode, spec in oi.COMMANDS.items() if spec.counted] == [140, 148, 149]
    assert len({spec.name for spec in oi.COMMANDS.values()}) == len(oi.COMMANDS)


@settings(deadline=None)
@given(data=st.binary(max_size=200), cuts=st.lists(st.integers(0, 200)))
def test_noise_at_the_robot_never_raises_and_is_accounted_for(data, cuts):
    whole, cut = oi.CommandDecoder(), oi.CommandDecoder()
    events = whole.feed(data)
    edges = [0, *sorted(min(place, len(data)) for place in cuts), len(data)]
    assert events == [event for a, b in itertools.pairwise(edges) for event in cut.feed(data[a:b])]
    used = 0
    for event in events:
        if isinstance(event, oi.Skipped):
            assert event.data == data[used : used + 1]
            assert event.reason == "opcode"
            used += 1
        else:
            spec = next(spec for spec in oi.COMMANDS.values() if spec.name == event.name)
            assert data[used] == spec.opcode
            variable = len(event.values) - len(spec.arguments)
            used += 1 + struct.calcsize(spec.code) + (1 + variable if spec.counted else 0)
    assert data[used:] == whole.pending
    assert whole.skipped_bytes == sum(isinstance(event, oi.Skipped) for event in events)
    assert whole.commands == len(events) - whole.skipped_bytes


def test_a_missing_argument_swallows_the_next_command_and_repeated_starts_recover():
    decoder = oi.CommandDecoder()
    assert decoder.feed(bytes((145, 0, 100, 0)) + oi.encode("start") + oi.encode("safe")) == [
        oi.Command("drive_direct", (100, 128)),
        oi.Command("safe"),
    ]
    decoder.feed(bytes((140, 1, 16)))  # a full song eats 32 more bytes
    events = decoder.feed(oi.encode("start") * 36)
    assert events[1:] == [oi.Command("start")] * 4


@pytest.mark.parametrize(
    "command",
    [
        ("fly",),
        ("drive_direct", 1),
        ("drive_direct", 501, 0),
        ("drive", 0, 2001),
        ("start", 1),
        ("stream", 200),
        ("song", 0, 60),
        ("song", 0, 60, 256),
        ("sensors", 59),
        ("sensors", 99),
        ("schedule", 128, *[0] * 14),
        ("query", *[7] * 256),
        ("baud", 12),
        ("digits_ascii", 31, 65, 65, 65),
    ],
)
def test_commands_out_of_range_are_refused(command):
    with pytest.raises(ValueError, match="expected"):
        oi.encode(*command)
