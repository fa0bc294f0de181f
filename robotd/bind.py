"""Bind plain data (from TOML or JSON) to frozen dataclasses, strictly, and report every mistake at once.

The one binder of configuration, calibrations, store layouts, surveys and maps. A field's type says what is allowed;
its metadata may narrow it: `ranged(default, minimum=..., maximum=...)`. Supported types: str, int, float, bool,
Literal, Path, X | None, tuple[X, ...], tuple[X, Y], dict[str, X], Any and dataclasses.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

from .errors import ConfigError

T = TypeVar("T")
_BAD = object()


def ranged(
    default: Any = dataclasses.MISSING, *, minimum: float | None = None, maximum: float | None = None, doc: str = ""
) -> Any:
    """Declare a dataclass field with an allowed range (limits included) and a one-line explanation."""
    metadata = {"minimum": minimum, "maximum": maximum, "doc": doc}
    if default is dataclasses.MISSING:
        return dataclasses.field(metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def bind(cls: type[T], data: Any, where: str, *, rename: Mapping[str, str] | None = None, path: str = "") -> T:
    """Make a `cls` from plain data, or raise ConfigError with one line per mistake.

    Parameters
    ----------
    cls : a frozen dataclass
    data : dict
        As tomllib or json return it.
    where : str
        Starts every message, e.g. the file's name.
    rename : mapping of str to str, optional
        Key in the data to field name, for keys that are Python keywords (`from`).
    path : str, optional
        Where `data` stands inside the file, e.g. `stops[3]`.

    Raises
    ------
    ConfigError
        Lists every unknown key (with the nearest known one), missing key, wrong type and value out of range.
    """
    binder = _Binder(where, dict(rename or {}))
    value = binder.value(cls, data, path, {})
    if binder.problems:
        raise ConfigError(*binder.problems)
    return typing.cast(T, value)


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def describe(value: Any) -> str:
    """Quote a value the way the operator wrote it, shortened."""
    if isinstance(value, Mapping):
        return "a table"
    text = (
        {True: "true", False: "false", None: "null"}.get(value)
        if value is None or value is True or value is False
        else None
    )
    text = text or repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


class _Binder:
    def __init__(self, where: str, rename: dict[str, str]) -> None:
        self.where = where
        self.rename = rename
        self.problems: list[str] = []

    def problem(self, path: str, text: str) -> Any:
        place = f"{self.where} {path}".rstrip()
        self.problems.append(f"{place}: {text}")
        return _BAD

    def value(self, kind: Any, data: Any, path: str, limits: Mapping[str, Any]) -> Any:
        if kind is Any:
            return data
        origin = typing.get_origin(kind)
        if origin in (Union, types.UnionType):
            options = [option for option in typing.get_args(kind) if option is not type(None)]
            if data is None and len(options) < len(typing.get_args(kind)):
                return None
            return self.value(options[0], data, path, limits)
        if origin is Literal:
            allowed = typing.get_args(kind)
            if data in allowed and type(data) in {type(item) for item in allowed}:
                return data
            return self.problem(path, f"found {describe(data)}; expected one of {', '.join(map(describe, allowed))}")
        if origin is tuple:
            return self.sequence(typing.get_args(kind), data, path, limits)
        if origin is dict:
            return self.table(typing.get_args(kind)[1], data, path)
        if dataclasses.is_dataclass(kind):
            return self.record(typing.cast(type, kind), data, path)
        return self.scalar(kind, data, path, limits)

    def scalar(self, kind: Any, data: Any, path: str, limits: Mapping[str, Any]) -> Any:
        if kind is float:
            if isinstance(data, bool) or not isinstance(data, int | float):
                return self.problem(path, f"found {describe(data)}; expected a number")
            try:
                number = float(data)
            except OverflowError:
                number = math.inf
            if not math.isfinite(number):
                return self.problem(path, f"found {describe(data)}; expected a finite number")
            return self.limited(number, data, path, limits)
        if kind is int:
            if isinstance(data, bool) or not isinstance(data, int):
                return self.problem(path, f"found {describe(data)}; expected a whole number")
            return self.limited(data, data, path, limits)
        if kind is bool:
            return (
                data
                if isinstance(data, bool)
                else self.problem(path, f"found {describe(data)}; expected true or false")
            )
        if kind is str:
            return (
                data
                if isinstance(data, str)
                else self.problem(path, f"found {describe(data)}; expected a text in quotes")
            )
        if kind is Path:
            if isinstance(data, str) and data:
                return Path(data)
            return self.problem(path, f"found {describe(data)}; expected a path in quotes")
        raise TypeError(f"{path}: the binder does not know the type {kind!r}")

    def limited(self, value: Any, data: Any, path: str, limits: Mapping[str, Any]) -> Any:
        low, high = limits.get("minimum"), limits.get("maximum")
        if (low is not None and value < low) or (high is not None and value > high):
            if low is not None and high is not None:
                allowed = f"{low:g} to {high:g}"
            else:
                allowed = f"at least {low:g}" if low is not None else f"at most {high:g}"
            return self.problem(path, f"found {data}; expected {allowed}")
        return value

    def sequence(self, kinds: tuple[Any, ...], data: Any, path: str, limits: Mapping[str, Any]) -> Any:
        if not isinstance(data, list | tuple):
            return self.problem(path, f"found {describe(data)}; expected a list")
        if len(kinds) == 2 and kinds[1] is Ellipsis:
            kinds = (kinds[0],) * len(data)
        elif len(kinds) != len(data):
            return self.problem(path, f"found a list of {len(data)}; expected {len(kinds)} values")
        unlimited = limits.get("minimum") is None and limits.get("maximum") is None
        if unlimited and set(kinds) == {float} and all(type(item) is float and math.isfinite(item) for item in data):
            return tuple(data)  # the common case, fast
        items = [
            self.value(kind, item, f"{path}[{index}]", limits)
            for index, (kind, item) in enumerate(zip(kinds, data, strict=True))
        ]
        return _BAD if any(item is _BAD for item in items) else tuple(items)

    def table(self, kind: Any, data: Any, path: str) -> Any:
        if not isinstance(data, Mapping):
            return self.problem(path, f"found {describe(data)}; expected a table")
        return {key: self.value(kind, item, f"{path}.{key}" if path else key, {}) for key, item in data.items()}

    def record(self, cls: type, data: Any, path: str) -> Any:
        if not isinstance(data, Mapping):
            return self.problem(path, f"found {describe(data)}; expected a table")
        hints = _hints(cls)
        fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
        spelled = {name: key for key, name in self.rename.items()}
        before = len(self.problems)
        values: dict[str, Any] = {}
        for key, item in data.items():
            name = self.rename.get(key, key)
            if name not in fields:
                known = sorted(spelled.get(field, field) for field in fields)
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"did you mean '{near[0]}'? " if near else ""
                self.problem(path, f"unknown key '{key}'; {hint}expected one of {', '.join(known)}")
                continue
            inner = f"{path}.{key}" if path else key
            values[name] = self.value(hints[name], item, inner, fields[name].metadata)
        for name, field in fields.items():
            if (
                name not in values
                and field.default is dataclasses.MISSING
                and field.default_factory is dataclasses.MISSING
            ):
                self.problem(path, f"missing key '{spelled.get(name, name)}'")
        if len(self.problems) > before:
            return _BAD
        try:
            return cls(**values)
        except ValueError as error:  # a record's own __post_init__ checks what types cannot say
            return self.problem(path, str(error))
