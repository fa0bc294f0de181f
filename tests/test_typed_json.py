"""The quick reader: it accepts what the strict one accepts, and nothing else."""

import copy
import json
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from robotd import files, typed_json
from robotd.errors import InputError
from robotd.records import Map, Survey
from robotd.solver import solve
from tests.test_files import EXAMPLE, MAP

ROOM = (Path(__file__).parent / "bench" / "room.survey.json").read_bytes()
ODD = [None, True, -1, 0, 1.0, 1e300, 10**400, "", "x", "brown-conrady", [], {}, [1.0, 2.0], {"x": 1}, [None]]


def places(value, path=()):
    """Every place in a JSON value, as the keys that lead to it."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from places(item, (*path, key))


def damaged(value, data):
    """A copy with one to three places replaced, removed, renamed or repeated."""
    value = copy.deepcopy(value)
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(list(places(value)) or [()]))
        if not path:
            return value
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        what = data.draw(st.sampled_from(["replace", "remove", "add", "repeat"]))
        if what == "remove":
            del parent[path[-1]]
        elif what == "add" and isinstance(parent, dict):
            parent[data.draw(st.sampled_from(["speed", "U", "", 'a"b', "sigma"]))] = data.draw(st.sampled_from(ODD))
        elif what == "repeat" and isinstance(parent, list):
            parent.append(parent[path[-1]])
        else:
            parent[path[-1]] = data.draw(st.sampled_from(ODD))
    return value


def outcome(read, text):
    try:
        return read(text, "file")
    except InputError as error:
        return error.problems


@pytest.mark.parametrize(
    ("read", "example"), [(files.survey_from_json, EXAMPLE), (files.map_from_json, MAP)], ids=["survey", "map"]
)
@given(data=st.data())
@settings(deadline=None, max_examples=80)
def test_both_readers_say_the_same_of_damaged_files(read, example, data):
    text = json.dumps(damaged(example, data)).encode()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "decode", lambda cls, text: None)
        strict = outcome(read, text)
    assert outcome(read, text) == strict


@given(st.data())
@settings(deadline=None, max_examples=50)
def test_damaged_bytes_are_named_and_never_a_traceback(data):
    text = bytearray(ROOM)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        if data.draw(st.booleans()):
            text[at] = data.draw(st.integers(0, 255))
        else:
            del text[at : at + data.draw(st.integers(1, 200))]
    result = outcome(files.survey_from_json, bytes(text))
    if isinstance(result, Survey):
        assert files.survey_from_json(files.survey_to_json(result), "again") == result
    else:
        assert result
        assert all(problem.startswith("file") for problem in result)


def test_a_right_file_takes_the_quick_way():
    survey = typed_json.decode(Survey, ROOM)
    assert survey is not None
    assert typed_json.decode(Map, files.map_to_json(solve(survey))) is not None


@pytest.mark.parametrize("colon", [":", " :", "\n\t:"])
def test_a_repeated_key_is_found_with_and_without_the_kernel(colon, monkeypatch):
    once = b'{"a": [{"b": 1, "c": 2}, {"b": "\\":"}], "b": ":", "c": {"a": 1}}'
    twice = b'{"a": [{"b": 1, "c": 2}, {"b": 3, "b"%s 4}]}' % colon.encode()
    for _ in range(2):
        assert typed_json.repeated_keys(once) == []
        assert len(typed_json.repeated_keys(twice)) == 1
        monkeypatch.setattr(typed_json, "kernel", None)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
    max_leaves=12,
)


@pytest.mark.skipif(typed_json.kernel is None, reason="built without extensions")
@given(json_values, st.sampled_from([None, 0, 1]), st.booleans())
@settings(deadline=None, max_examples=200)
def test_without_repeated_keys_the_kernel_finds_none_unless_a_key_has_escapes(value, indent, ascii_only):
    text = json.dumps(value, indent=indent, ensure_ascii=ascii_only).encode()
    if typed_json.kernel.repeats_keys(text):
        assert b"\\" in text
