"""Change one table of a TOML file, or of an array of tables, and leave every other byte as a person wrote it."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from .errors import ConfigError

_HEADER = re.compile(r"\s*\[{1,2}\s*[\w\"'.\- ]+\s*\]{1,2}\s*(#.*)?$")
_KEY = re.compile(r"\s*\"?([A-Za-z0-9_-]+)\"?\s*=")


def assignments(record: Any) -> dict[str, str]:
    """A dataclass's fields as TOML values; None is left out."""
    return {item.name: toml(value) for item in fields(record) if (value := getattr(record, item.name)) is not None}


def toml(value: Any) -> str:
    """A number, text, path, list or dataclass as a TOML value."""
    if is_dataclass(value):
        return "{ " + ", ".join(f"{key} = {text}" for key, text in assignments(value).items()) + " }"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")  # TOML has no surrogates


def replace_table(text: str, table: str, values: Mapping[str, str], where: str) -> str:
    """Set keys of the table `[table]` and keep all else: comments, order, other tables, other keys.

    Parameters
    ----------
    text : str
        A valid TOML document.
    table : str
        A bare key; the table is appended if the document has none.
    values : mapping of str to str
        TOML values by key. A comment behind a replaced value stays.
    where : str
        Starts the message of the error, e.g. the file's name.

    Raises
    ------
    ConfigError
        The table is written in a way that cannot be edited line by line (inline or with dotted keys).
    """
    lines = text.splitlines()
    starts = [index for index, line in enumerate(lines) if re.match(rf"\s*\[\s*{re.escape(table)}\s*\]", line)]
    if starts:
        begin = starts[0] + 1
        end = next((index for index in range(begin, len(lines)) if _HEADER.match(lines[index])), len(lines))
        lines[begin:end] = _set(lines[begin:end], values)
    else:
        gap = [""] if lines and lines[-1].strip() else []
        lines += [*gap, f"[{table}]", *(f"{key} = {value}" for key, value in values.items())]
    changed = "\n".join(lines) + "\n"
    expected = tomllib.loads(text)
    wanted = tomllib.loads("\n".join(f"{key} = {value}" for key, value in values.items()))
    kept = expected.get(table, {})
    expected[table] = {**kept, **wanted} if isinstance(kept, dict) else wanted
    try:
        if tomllib.loads(changed) == expected:
            return changed
    except tomllib.TOMLDecodeError:
        pass
    raise ConfigError(f"{where}: cannot change {table} where it stands; write it as a section [{table}] of its own")


def replace_element(text: str, array: str, name: str, values: Mapping[str, str], where: str) -> str:
    """Set keys of the element of `[[array]]` whose key `name` has this value and keep all else; see `replace_table`.

    The element is appended, with its name, if there is none.

    Raises
    ------
    ConfigError
        The array is written in a way that cannot be edited line by line.
    """
    lines = text.splitlines()
    expected = tomllib.loads(text)
    wanted = {"name": name, **tomllib.loads("\n".join(f"{key} = {value}" for key, value in values.items()))}
    kept = expected.setdefault(array, [])
    names = [element.get("name") for element in kept] if isinstance(kept, list) else []
    starts = [index for index, line in enumerate(lines) if re.match(rf"\s*\[\[\s*{re.escape(array)}\s*\]\]", line)]
    refusal = ConfigError(f"{where}: cannot change {array} where it stands; write each as a section [[{array}]]")
    if not isinstance(kept, list) or len(starts) != len(names):
        raise refusal
    if name in names:
        at = names.index(name)
        begin = starts[at] + 1
        end = next((index for index in range(begin, len(lines)) if _HEADER.match(lines[index])), len(lines))
        lines[begin:end] = _set(lines[begin:end], values)
        kept[at] = {**kept[at], **wanted}
    else:
        gap = [""] if lines and lines[-1].strip() else []
        lines += [*gap, f"[[{array}]]", f"name = {toml(name)}", *(f"{key} = {value}" for key, value in values.items())]
        kept.append(wanted)
    changed = "\n".join(lines) + "\n"
    try:
        if tomllib.loads(changed) == expected:
            return changed
    except tomllib.TOMLDecodeError:
        pass
    raise refusal


def _set(lines: list[str], values: Mapping[str, str]) -> list[str]:
    """The lines of one table with these values; keys that it lacks are added behind its last key."""
    out: list[str] = []
    missing, last, index = dict(values), 0, 0
    while index < len(lines):
        match = _KEY.match(lines[index])
        if match is None:
            out.append(lines[index])
            index += 1
            continue
        length = next((n for n in range(1, len(lines) - index + 1) if _is_toml(lines[index : index + n])), 1)
        value = missing.pop(match[1], None)
        if value is None:
            out += lines[index : index + length]
        else:
            comment = re.search(r"\s*#[^\"']*$", lines[index + length - 1])
            out.append(f"{match[0]} {value}{comment[0] if comment else ''}")
        index += length
        last = len(out)
    out[last:last] = [f"{key} = {value}" for key, value in missing.items()]
    return out


def _is_toml(lines: list[str]) -> bool:
    try:
        tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError:
        return False
    return True
