import itertools
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotd import oi

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


def test_a_long_text_between_frames_does_not_fill_the_buffer():
    decoder = oi.StreamDecoder(IDS)
    text = b"bat: 14210 mV\r\n" * 1000
    events = decoder.feed(text)
    assert skipped_of(events) + decoder.pending == text
    assert len(decoder.pending) < decoder.RUN


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
    elif spec.counted:
        values += draw(st.lists(st.sampled_from([*oi.PACKETS, *oi.GROUPS]), max_size=40))
    return oi.Command(spec.name, tuple(values))


@settings(deadline=None)
@given(sent=st.lists(commands(), max_size=6), cuts=st.lists(st.integers(0, 200)))
def test_every_command_round_trips_in_any_chunks(sent, cuts):
    data = b"".join(oi.encode(command.name, *command.values) for command in sent)
    edges = [0, *sorted(min(place, len(data)) for place in cuts), len(data)]
    decoder = oi.CommandDecoder()
    assert [event for a, b in itertools.pairwise(edges) for event in decoder.feed(data[a:b])] == sent
    assert decoder.pending == b""


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
            used += 1
        else:
            spec = next(spec for spec in oi.COMMANDS.values() if spec.name == event.name)
            assert data[used] == spec.opcode
            variable = len(event.values) - len(spec.arguments)
            used += 1 + struct.calcsize(spec.code) + (1 + variable if spec.counted else 0)
    assert data[used:] == whole.pending


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
        ("baud", 12),
        ("digits_ascii", 31, 65, 65, 65),
    ],
)
def test_commands_out_of_range_are_refused(command):
    with pytest.raises(ValueError, match="expected"):
        oi.encode(*command)
