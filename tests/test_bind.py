from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings, strategies as st

from robotd.bind import bind, ranged
from robotd.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    size: tuple[int, int]
    mode: Literal["fast", "slow"] = "fast"


@dataclass(frozen=True)
class Outer:
    name: str
    rate: float = ranged(10.0, minimum=1.0, maximum=20.0)
    inner: Inner | None = None
    parts: tuple[Inner, ...] = ()
    path: Path = Path("x")
    flags: dict[str, bool] = field(default_factory=dict)
    start: float | None = None

    def __post_init__(self):
        if self.name == "bad":
            raise ValueError("name = 'bad'; expected a good one")


def test_plain_data_becomes_records():
    bound = bind(Outer, {"name": "a", "rate": 2, "parts": [{"size": [1, 2]}], "flags": {"x": True}}, "f.toml")
    assert bound == Outer("a", 2.0, None, (Inner((1, 2)),), Path("x"), {"x": True})
    assert isinstance(bound.rate, float)


def test_every_mistake_is_reported_at_once_with_its_place():
    data = {
        "rate": 21,
        "inner": {"size": [1, 2, 3], "mode": "fats"},
        "parts": [{"size": [1, True]}, 5],
        "nmae": "a",
        "path": 3,
    }
    with pytest.raises(ConfigError) as caught:
        bind(Outer, data, "f.toml")
    text = "\n".join(caught.value.problems)
    for expected in (
        "f.toml rate: found 21; expected 1 to 20",
        "f.toml inner.size: found a list of 3; expected 2 values",
        "f.toml inner.mode: found 'fats'; expected one of 'fast', 'slow'",
        "f.toml parts[0].size[1]: found true; expected a whole number",
        "f.toml parts[1]: found 5; expected a table",
        "f.toml: unknown key 'nmae'; did you mean 'name'?",
        "f.toml: missing key 'name'",
        "f.toml path: found 3; expected a path in quotes",
    ):
        assert expected in text
    assert len(caught.value.problems) == 8


def test_a_record_may_refuse_what_types_cannot_say():
    with pytest.raises(ConfigError, match=r"f.toml: name = 'bad'; expected a good one"):
        bind(Outer, {"name": "bad"}, "f.toml")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_numbers_must_be_finite(value):
    with pytest.raises(ConfigError, match="finite"):
        bind(Outer, {"name": "a", "start": value}, "f.toml")


def test_keywords_can_be_keys():
    assert bind(Outer, {"name": "a", "from": 1.0}, "f.toml", rename={"from": "start"}).start == 1.0
    with pytest.raises(ConfigError, match="expected one of flags, from, inner"):
        bind(Outer, {"name": "a", "begin": 1.0}, "f.toml", rename={"from": "start"})


json_like: Any = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["name", "rate", "inner", "parts", "size", "mode", "flags", "z"]), inner, max_size=5
        )
    ),
    max_leaves=20,
)


@settings(deadline=None, max_examples=200)
@given(json_like)
def test_any_data_gives_a_record_or_a_config_error(data):
    try:
        assert isinstance(bind(Outer, data, "f"), Outer)
    except ConfigError as error:
        assert error.problems
        assert all(problem.startswith("f") for problem in error.problems)


def test_limits_hold_for_every_item_of_a_list():
    @dataclass(frozen=True)
    class Limits:
        sizes: tuple[float, ...] = ranged((1.0,), minimum=0.0)

    with pytest.raises(ConfigError, match=r"f sizes\[1\]: found -1.0; expected at least 0"):
        bind(Limits, {"sizes": [1.0, -1.0]}, "f")
