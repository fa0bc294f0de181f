"""Recordings of the serial line, played to the real driver; renew what is expected with python -m tests.replay."""

import dataclasses

import pytest

from robotd import oi
from robotd.sim.quirks import RoombaQuirks
from tests.replay.maker import CASES, record
from tests.replay.player import EVERY, FOLDER, TOLERANCE, cases, differences, load, play


@pytest.mark.parametrize("case", cases())
def test_a_recorded_session_comes_out_as_expected(case):
    recording, expected = load(case)
    problems = differences(expected.read_text(encoding="utf-8"), play(recording))
    assert not problems, "\n".join([*problems, f"if that is right: python -m tests.replay --update {case}"])


def test_there_are_recordings_of_many_different_troubles():
    assert len(cases()) >= 10
    assert {case.name for case in CASES} <= set(cases())
    troubles = [load(case.name)[0].head["quirks"] for case in CASES]
    assert len({str(trouble) for trouble in troubles}) >= 10
    for path in FOLDER.glob("*.log"):
        assert path.stat().st_size < 60_000, path
        assert path.with_suffix(".expected").exists()


@pytest.mark.parametrize("case", [case.name for case in CASES])
def test_a_replayed_driver_sends_what_it_sent_when_it_was_recorded(case):
    """Simulated recordings are of this driver; others may be of an older one."""
    recording, _ = load(case)
    decoder, sent, told = oi.CommandDecoder(), [], None
    for item in recording.occurrences:
        if item.kind == "open":
            decoder = oi.CommandDecoder()
        for command in decoder.feed(item.data) if item.kind == ">" else ():
            if command.name == "drive_direct" and command == told:
                continue
            told = command if command.name == "drive_direct" else told
            sent.append(" ".join([command.name, *map(str, command.values)]))
    replayed = []
    for line in play(recording).splitlines():
        _, kind, *words = line.split(" ")
        if kind == "sent":
            count = int(words.pop()[1:]) if words[-1].startswith("x") else 1
            replayed += [" ".join(words)] * count
    assert replayed == sent


def test_making_a_recording_again_gives_the_same_bytes(tmp_path):
    case = CASES[0]
    for name in ("a", "b"):
        record(case, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_every_switch_of_the_driver_s_surroundings_is_in_the_head():
    head = load("mode-one-too-high-bump")[0].head
    assert head["quirks"] == {"mode_offset": 1}
    assert head["base"]["checksum"] == "auto"
    assert set(head["quirks"]) <= {item.name for item in dataclasses.fields(RoombaQuirks)}


EXPECTED = """\
0.10 sent start
0.20 info base: found
0.31 frame 0.100 0.100 safe
0.40 sent safe
"""


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        (EXPECTED, None),
        (EXPECTED.replace("0.10 sent", "0.12 sent"), None),
        (EXPECTED.replace("0.10 sent", "0.15 sent"), "sent 1: expected 'sent start' at 0.10 s, found"),
        (EXPECTED.replace("0.100 0.100", "0.100 0.101"), "frame 1: expected 'frame 0.100 0.100 safe' at 0.31 s"),
        (EXPECTED.replace("0.40 sent safe\n", ""), "sent 2: expected 'sent safe' at 0.40 s, found nothing more"),
        (EXPECTED + "0.50 sent stop\n", "sent 3: expected nothing more, found 'sent stop' at 0.50 s"),
        (EXPECTED + "0.50 warning base: cliff\n", "warning 1: expected nothing more"),
        (EXPECTED.replace("0.20 info", "0.20 error"), "error 1"),
    ],
)  # fmt: skip
def test_only_times_may_differ_and_only_by_two_ticks(changed, problem):
    problems = differences(EXPECTED, changed)
    if problem is None:
        assert problems == []
    else:
        assert problem in "\n".join(problems)
    assert 2 * oi.TICK < TOLERANCE < 3 * oi.TICK
    assert EVERY * oi.TICK < 0.2
