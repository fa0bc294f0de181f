"""The configuration for people and programs: with every default and without secrets, and as a JSON schema."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Union

from .config import Config
from .daemon import Plan
from .plugin import available, load
from .toml_edit import toml

MASK = "(secret)"
SECRETS = ("token", "password", "secret", "key")
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def effective(config: Config, plans: Mapping[str, Plan]) -> dict[str, Any]:
    """Every value that is in force, as plain data; secrets are masked, None is left out."""
    sections = {item.name: plain(getattr(config, item.name)) for item in dataclasses.fields(config)}
    sections["drivers"] = {
        name: {"driver": config.drivers[name]["driver"], **plain(plan.config)} for name, plan in plans.items()
    }
    found: dict[str, Any] = masked(sections)
    return found


def plain(value: Any) -> Any:
    """A bound value as TOML and JSON can hold it."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
        return {name: plain(item) for name, item in items.items() if item is not None}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items() if item is not None}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def masked(data: Any, name: str = "") -> Any:
    """The same without what a key's name says is secret; names of files that hold secrets are none."""
    if isinstance(data, dict):
        return {key: masked(value, key) for key, value in data.items()}
    if isinstance(data, list):
        return [masked(item, name) for item in data]
    parts = name.lower().split("_")
    if isinstance(data, str) and any(part in SECRETS for part in parts) and parts[-1] not in ("file", "credential"):
        return MASK
    return data


def as_toml(data: Mapping[str, Any], path: tuple[str, ...] = ()) -> str:
    """Plain data as a TOML document."""
    tables = {key: value for key, value in data.items() if isinstance(value, dict)}
    lines = [f"{key} = {_inline(value)}" for key, value in data.items() if key not in tables]
    if path and (lines or not tables):
        lines.insert(0, f"[{'.'.join(path)}]")
    text = "".join(f"{line}\n" for line in lines)
    inner = [as_toml(value, (*path, key)) for key, value in tables.items()]
    return "\n".join(part for part in (text, *inner) if part)


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_inline(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return toml(value)


# ---- schema ----------------------------------------------------------------------------------------------------------


def schema() -> dict[str, Any]:
    """JSON schema of robotd.toml, with the drivers that are installed here."""
    root = _record(Config)
    kinds = []
    for name in sorted(available()):
        cls = load(name, "schema")
        section = _record(cls.Config)
        section["title"] = f"{cls.kind}: {name}"
        section["properties"] = {"driver": {"const": name}, **section["properties"]}
        section["required"] = ["driver", *section.get("required", [])]
        kinds.append(section)
    root["properties"]["drivers"] = {"type": "object", "additionalProperties": {"oneOf": kinds}}
    return {"$schema": DIALECT, "title": "robotd.toml", **root}


def _record(cls: type[Any]) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    properties, required = {}, []
    for item in dataclasses.fields(cls):
        if not item.init:
            continue
        entry = _type(hints[item.name])
        limits = item.metadata
        for name in ("minimum", "maximum"):
            if limits.get(name) is not None:
                entry[name] = limits[name]
        if limits.get("doc"):
            entry["description"] = limits["doc"]
        if item.default is not dataclasses.MISSING:
            if item.default is not None:
                entry["default"] = plain(item.default)
        elif item.default_factory is dataclasses.MISSING:
            required.append(item.name)
        properties[item.name] = entry
    section: dict[str, Any] = {"type": "object", "properties": properties, "additionalProperties": False}
    return {**section, "required": required} if required else section


def _type(kind: Any) -> dict[str, Any]:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        return _type(next(option for option in inner if option is not type(None)))
    if origin is Literal:
        return {"enum": list(inner)}
    if origin is tuple:
        if len(inner) == 2 and inner[1] is Ellipsis:
            return {"type": "array", "items": _type(inner[0])}
        return {
            "type": "array",
            "prefixItems": [_type(item) for item in inner],
            "minItems": len(inner),
            "maxItems": len(inner),
        }
    if origin is dict:
        return {"type": "object", "additionalProperties": _type(inner[1])}
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _record(kind)
    names = {str: "string", Path: "string", int: "integer", float: "number", bool: "boolean"}
    return {"type": names[kind]} if kind in names else {}
