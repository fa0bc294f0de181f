"""The quick way from JSON to records, for what has no mistake: msgspec decodes straight into the types.

It says only that something is wrong, never what; `bind` then reads the same again and names every mistake. Both accept
the same files: unknown keys, repeated keys, wrong types and numbers that are not finite are refused here too.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import json
import math
import types
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, Union

import msgspec

kernel: Any
try:
    from . import _json_keys as kernel
except ImportError:  # built without extensions
    kernel = None

T = TypeVar("T")


@contextmanager
def many_records() -> Iterator[None]:
    """Hold up the garbage collector while very many records are made, because it walks all of them again and again.

    Afterwards they count as old, so that the next collection of young objects does not walk them, either.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            if gc.get_freeze_count() == 0:  # else somebody wants what was frozen to stay so
                gc.freeze()
                gc.unfreeze()
            gc.enable()


def decode(cls: type[T], data: bytes) -> T | None:
    """The record `cls` in a JSON object, or None if anything about it may be wrong.

    A missing key whose value may be null means null, as everywhere in the project's files.
    """
    with many_records():
        try:
            mirrored = _decoder(typing.cast(Any, cls)).decode(data)
            if repeated_keys(data):
                return None
            return msgspec.convert(mirrored, cls, from_attributes=True)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError):
            return None


def repeated_keys(data: bytes) -> list[str]:
    """Sentences about keys that an object of valid JSON gives twice, of which a decoder silently keeps the last."""
    if kernel is not None and not kernel.repeats_keys(data):
        return []
    found: list[str] = []

    def look(pairs: list[tuple[str, Any]]) -> None:
        keys = [key for key, _ in pairs]
        if len(set(keys)) == len(keys):
            return
        for key in sorted({key for key in keys if keys.count(key) > 1}):
            found.append(f"key '{key}' is given more than once in the object with keys {', '.join(keys)}; keep one")

    json.loads(data, object_pairs_hook=look)
    return found


@functools.cache
def _decoder(cls: Any) -> msgspec.json.Decoder[Any]:
    return msgspec.json.Decoder(_mirror(cls))


@functools.cache
def _mirror(cls: Any) -> Any:
    """A msgspec type that refuses unknown keys, which dataclasses do not, with the fields of a dataclass."""
    hints = typing.get_type_hints(cls)
    required: list[Any] = []
    optional: list[Any] = []
    for field in dataclasses.fields(typing.cast(Any, cls)):
        kind = _mirrored(hints[field.name])
        if field.name == "format":  # has a default in the records, but a file must say what it is
            required.append((field.name, kind))
        elif field.default is not dataclasses.MISSING:
            optional.append((field.name, kind, field.default))
        elif field.default_factory is not dataclasses.MISSING:
            optional.append((field.name, kind, msgspec.field(default_factory=_made(field.default_factory, kind))))
        elif type(None) in typing.get_args(hints[field.name]):
            optional.append((field.name, kind, None))
        else:
            required.append((field.name, kind))
    return msgspec.defstruct(
        cls.__name__, [*required, *optional], forbid_unknown_fields=True, frozen=True, kw_only=True, gc=False
    )


def _made(factory: Any, kind: Any) -> Any:
    """A default as the mirror has it; records with defaults only are the one kind that needs translating."""
    return kind if dataclasses.is_dataclass(factory) else factory


def _mirrored(hint: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return _mirror(typing.cast(Any, hint))
    arguments: tuple[Any, ...] = tuple(item if item is Ellipsis else _mirrored(item) for item in typing.get_args(hint))
    origin = typing.get_origin(hint)
    if origin in (Union, types.UnionType):
        return functools.reduce(lambda a, b: a | b, arguments)
    return hint if origin is None or origin is typing.Literal else origin[arguments]


def with_infinite(data: bytes) -> dict[str, Any] | None:
    """The object if all that keeps it from being JSON are numbers that are not finite, as many programs write them."""
    try:
        table = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError):
        return None
    if not isinstance(table, dict):
        return None
    left: list[Any] = [table]
    while left:
        value = left.pop()
        if isinstance(value, float) and not math.isfinite(value):
            return table
        left += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return None
