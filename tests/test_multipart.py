"""multipart/x-mixed-replace as cameras send it, whole and in pieces, right and wrong."""

import random

import pytest
from hypothesis import given, settings, strategies as st

from robotd.multipart import End, MultipartParser, Part, Skipped, boundary_of

JPEG = b"\xff\xd8" + bytes(range(256)) * 3 + b"\xff\xd9"


def stream(bodies, *, before=b"--frame", length=True, line=b"\r\n", after=b"\r\n", first=b"", headers=b""):
    out = first
    for body in bodies:
        out += before + line + b"Content-Type: image/jpeg" + line + headers
        if length:
            out += b"Content-Length: %d" % len(body) + line
        out += line + body + after
    return out


def run(data, sizes=(), boundary="frame", **limits):
    """Every event of `data` fed in chunks of these sizes, the rest at once."""
    parser = MultipartParser(boundary, **limits)
    events, at = [], 0
    for size in sizes:
        events += parser.feed(data[at : at + size])
        at += size
    events += parser.feed(data[at:])
    assert sum(event.size for event in events) + parser.pending == len(data), "every byte is accounted for"
    return events, parser


def bodies(events):
    return [event.body for event in events if isinstance(event, Part)]


def test_a_part_has_its_headers_in_lower_case_and_the_time_of_their_end():
    parser = MultipartParser("frame")
    assert parser.feed(b"--frame\r\nContent-Length: 3\r\nX-Timestamp:", 1.0) == []
    assert parser.feed(b" 12.5 \r\n\r\nab", 2.0) == []
    (part,) = parser.feed(b"c\r\n", 3.0)
    assert part == Part({"content-length": "3", "x-timestamp": "12.5"}, b"abc", 2.0, 53)


def test_a_part_with_a_length_comes_out_with_its_last_byte_and_one_without_at_the_next_delimiter():
    told = stream([JPEG], after=b"")
    assert bodies(run(told)[0]) == [JPEG]
    untold = stream([JPEG], length=False)
    assert bodies(run(untold)[0]) == []
    assert bodies(run(untold + b"--frame\r\n")[0]) == [JPEG]


@pytest.mark.parametrize(
    ("named", "sent"),
    [
        ("frame", b"--frame"),
        ("--frame", b"--frame"),
        ("--frame", b"----frame"),
        ("frame", b"frame"),
        ("--frame", b"frame"),
        (None, b"--frame"),
        ("a b:c'd", b"--a b:c'd"),
        ("x.*", b"--x.*"),
    ],
)
@pytest.mark.parametrize("length", [True, False])
def test_every_form_of_delimiter_that_cameras_use_is_learnt_from_the_first(named, sent, length):
    data = stream([JPEG, b"second", JPEG], before=sent, length=length) + sent + b"\r\n"
    assert bodies(run(data, boundary=named)[0]) == [JPEG, b"second", JPEG]


@pytest.mark.parametrize("length", [True, False])
def test_bare_line_feeds_and_a_missing_line_end_before_the_delimiter_are_understood(length):
    for line, after in ((b"\n", b"\n"), (b"\r\n", b""), (b"\n", b"")):
        data = stream([JPEG, JPEG], line=line, after=after, length=length) + b"--frame" + line
        assert bodies(run(data)[0]) == [JPEG, JPEG]


def test_a_delimiter_counts_only_at_the_start_of_a_line_or_after_a_jpeg():
    body = b"\xff\xd8 x--frame\r\n ---frame\r\n --frames\r\n--framed\r\n \xff\xd9"
    data = stream([body], length=False) + b"--frame\r\n"
    assert bodies(run(data)[0]) == [body]


def test_what_stands_before_the_first_delimiter_is_skipped():
    events, _ = run(stream([JPEG], first=b"hello, frame\r\nworld\r\n"))
    assert isinstance(events[0], Skipped)
    assert events[0].why == "no delimiter"
    assert bodies(events) == [JPEG]


def test_after_the_closing_delimiter_a_camera_may_go_on():
    events, _ = run(stream([JPEG]) + b"--frame--\r\n" + stream([b"more"]))
    assert [type(event) for event in events] == [Part, End, Part]
    assert bodies(events) == [JPEG, b"more"]


@pytest.mark.parametrize("told", [len(JPEG) + 40, len(JPEG) + 1000])
def test_a_length_that_is_too_long_loses_no_part(told):
    wrong = b"--frame\r\nContent-Length: %d\r\n\r\n" % told + JPEG + b"\r\n"
    events, parser = run(wrong * 5 + b"--frame\r\n")
    assert bodies(events) == [JPEG] * 5
    assert not parser.believes_lengths


def test_a_length_that_is_too_short_costs_one_part():
    wrong = b"--frame\r\nContent-Length: 50\r\n\r\n" + JPEG + b"\r\n"
    events, parser = run(wrong * 4 + b"--frame\r\n")
    assert bodies(events) == [JPEG[:50], JPEG, JPEG, JPEG]
    assert Skipped(len(JPEG) - 50 + 2, "not what the length said") in events
    assert not parser.believes_lengths


@pytest.mark.parametrize("text", [b"-5", b"0", b"many", b"1e3", b"\xb2", b"99999999999999999999999"])
def test_a_length_that_is_no_length_is_ignored(text):
    data = b"--frame\r\nContent-Length: " + text + b"\r\n\r\n" + JPEG + b"\r\n--frame\r\n"
    assert bodies(run(data)[0]) == [JPEG]


@pytest.mark.parametrize("step", [1, 7, 10_000])
def test_what_is_too_long_is_skipped_and_the_next_part_is_read(step):
    limits = {"body_limit": 2000, "header_limit": 200}
    long_body = b"\xff\xd8" + b"x" * 5000 + b"\xff\xd9"
    for length in (True, False):
        data = stream([long_body, JPEG], length=length) + b"--frame\r\n"
        events, _ = run(data, [step] * (len(data) // step), **limits)
        assert bodies(events) == [JPEG]
    data = b"--frame\r\nX: " + b"y" * 300 + b"\r\n\r\n" + JPEG + b"\r\n" + stream([JPEG])
    events, _ = run(data, [step] * (len(data) // step), **limits)
    assert bodies(events) == [JPEG]
    assert any(isinstance(event, Skipped) and event.why == "headers too long" for event in events)


def test_memory_stays_within_the_limits_whatever_comes():
    rng = random.Random(5)
    parser = MultipartParser("frame", body_limit=2000, header_limit=200)
    for _ in range(3000):
        parser.feed(rng.choice([rng.randbytes(50), b"--frame\r\n", b"--frame", b"a: b\r\n", b"\r\n\r\n", b"z" * 100]))
        assert parser.pending <= 2000 + 200 + 2 * 250


PIECES = st.one_of(
    st.binary(max_size=40),
    st.sampled_from(
        [
            b"--frame",
            b"--frame--",
            b"frame",
            b"\r\n",
            b"\n",
            b"\r",
            b"\xff\xd9",
            b"Content-Length: 5\r\n",
            b"Content-Length: 60\r\n",
            b"\r\n\r\n",
            b"--frame\r\n",
            b"\r\n--frame\r\n\r\n",
            JPEG,
        ]
    ),
)


@given(st.lists(PIECES, max_size=30).map(b"".join), st.lists(st.integers(1, 50), max_size=80), st.booleans())
@settings(deadline=None, max_examples=150)
def test_any_chunking_of_any_bytes_gives_the_same_parts_and_loses_no_byte(data, sizes, named):
    limits = {"body_limit": 300, "header_limit": 100, "boundary": "frame" if named else None}
    whole, parser = run(data, **limits)
    pieces, other = run(data, sizes, **limits)
    single, third = run(data, [1] * len(data), **limits)
    assert bodies(whole) == bodies(pieces) == bodies(single)
    assert parser.believes_lengths == other.believes_lengths == third.believes_lengths


@given(
    st.lists(st.binary(min_size=1, max_size=300).filter(lambda body: b"frame" not in body), min_size=1, max_size=6),
    st.sampled_from([b"\r\n", b"\n"]),
    st.booleans(),
    st.lists(st.integers(1, 60), max_size=60),
)
@settings(deadline=None, max_examples=80)
def test_parts_come_back_as_they_were_sent(sent, line, length, sizes):
    data = stream(sent, line=line, after=b"\r\n", length=length, first=b"preamble\r\n") + b"--frame" + line
    assert bodies(run(data, sizes)[0]) == sent


@given(st.binary(max_size=200), st.lists(st.binary(max_size=100), max_size=3).map(b"\r\n".join))
@settings(deadline=None)
def test_after_noise_the_next_two_parts_are_found(noise, more):
    data = stream([JPEG]) + noise + more + b"\r\n" + stream([JPEG, b"last"], length=False) + b"--frame\r\n"
    assert bodies(run(data)[0])[-1] == b"last"


@pytest.mark.parametrize(
    ("text", "boundary"),
    [
        ("multipart/x-mixed-replace; boundary=frame", "frame"),
        ('multipart/x-mixed-replace;boundary="--my boundary"', "--my boundary"),
        ("Multipart/X-Mixed-Replace; charset=x; BOUNDARY=--myboundary", "--myboundary"),
        ("multipart/x-mixed-replace", None),
        ('multipart/x-mixed-replace; boundary=""', None),
    ],
)
def test_the_boundary_is_read_from_the_content_type(text, boundary):
    assert boundary_of(text) == boundary


@pytest.mark.parametrize("text", ["text/html; charset=utf-8", "image/jpeg", "", "multipart"])
def test_another_content_type_is_refused_by_name(text):
    with pytest.raises(ValueError, match=r"Content-Type is .*; expected multipart/x-mixed-replace"):
        boundary_of(text)
