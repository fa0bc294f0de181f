"""Surveys, maps and tables on disk and on the wire (ARCHITECTURE.md, "Files").

Reading is strict: unknown keys, wrong types, numbers that are not finite and values that contradict each other are all
reported at once, each with file, path (`stops[3].sightings[12].u`), what was found and what is expected. Whatever is
wrong with a file, the answer is an InputError. Writing is atomic: a reader sees the old file or the new one, whole.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import json
import math
import os
import re
import shutil
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from .bind import bind
from .errors import ConfigError, InputError
from .plan_records import Plan
from .records import Map, Stop, Survey, Vector3
from .survey_checks import FARTHEST_M, Problems, check_header, check_map, check_stop, check_stops
from .typed_json import decode, repeated_keys, with_infinite

R = TypeVar("R")
Points = dict[str, tuple[Vector3, float | None]]

SURVEY_FORMATS = ("robotd-survey/1",)
MAP_FORMATS = ("robotd-map/1",)
PLAN_FORMATS = ("robotd-plan/1",)


# ---- surveys and maps ------------------------------------------------------------------------------------------------


def load_survey(path: str | Path) -> Survey:
    """Read a `robotd-survey/1` file; raises InputError listing every mistake."""
    return survey_from_json(read_bytes(path), str(path))


def save_survey(survey: Survey, path: str | Path) -> None:
    """Write a `robotd-survey/1` file, atomically."""
    write_atomic(path, survey_to_json(survey))


def load_map(path: str | Path) -> Map:
    """Read a `robotd-map/1` file; raises InputError listing every mistake."""
    return map_from_json(read_bytes(path), str(path))


def save_map(result: Map, path: str | Path) -> None:
    """Write a `robotd-map/1` file, atomically."""
    write_atomic(path, map_to_json(result))


def survey_from_json(data: bytes, where: str) -> Survey:
    """Read a survey from bytes; `where` (a file or an address) starts every message of the InputError."""
    survey = decode(Survey, data)
    if survey is not None:
        return _checked(survey, where, _check_survey_parts)
    table = _table(data, where, SURVEY_FORMATS)
    _tidy_survey(table)
    return _bound(Survey, table, where, _check_survey_parts)


def header_from_json(data: bytes, where: str) -> Survey:
    """Read a survey whose stops come one by one: `stops` must be missing or empty."""
    table = _table(data, where, SURVEY_FORMATS)
    stops = table.setdefault("stops", [])
    if stops != []:
        raise InputError(f"{where} stops: expected an empty list; send every stop by itself")
    _tidy_survey(table)
    return _bound(Survey, table, where, check_header)


def stop_from_json(data: bytes, where: str, survey: Survey | None = None) -> Stop:
    """Read one stop; with `survey` given its cameras, roof cameras and beacons must exist there."""

    def check(parts: Mapping[str, Any], problems: Problems) -> None:
        if len(parts) == len(dataclasses.fields(Stop)):
            rig, roofs = (survey.rig, survey.roof_cameras) if survey else (None, None)
            check_stop(Stop(**parts), "", rig, roofs, problems)

    stop = decode(Stop, data)
    if stop is not None:
        return _checked(stop, where, check)
    table = _table(data, where, ())
    _tidy_stop(table)
    return _bound(Stop, table, where, check)


def map_from_json(data: bytes, where: str) -> Map:
    """Read a map from bytes; `where` starts every message of the InputError."""
    result = decode(Map, data)
    if result is not None:
        return _checked(result, where, check_map)
    table = _table(data, where, MAP_FORMATS)
    _tidy_map(table)
    return _bound(Map, table, where, check_map)


def survey_to_json(survey: Survey) -> bytes:
    """The survey as a `robotd-survey/1` file: full precision, one sighting a line."""
    return _to_json(survey, f"survey {survey.survey}")


def stop_to_json(stop: Stop) -> bytes:
    """One stop as it stands in a survey."""
    return _to_json(stop, f"leg {stop.leg} stop {stop.stop}")


def map_to_json(result: Map) -> bytes:
    """The map as a `robotd-map/1` file: full precision, one label a line."""
    return _to_json(result, f"map of {result.survey}")


def check_survey(survey: Survey, where: str) -> None:
    """Check what types cannot say (a survey put together from a header and stops); raises InputError listing all."""
    _checked(survey, where, _check_survey_parts)


def _check_survey_parts(parts: Mapping[str, Any], problems: Problems) -> None:
    check_header(parts, problems)
    check_stops(parts.get("stops"), parts.get("rig"), parts.get("roof_cameras"), problems)


def load_plan(path: str | Path) -> Plan:
    """Read a `robotd-plan/1` file; raises InputError listing every mistake."""
    return _bound(Plan, _table(read_bytes(path), str(path), PLAN_FORMATS), str(path), _check_plan)


def save_plan(plan: Plan, path: str | Path) -> None:
    """Write a `robotd-plan/1` file, atomically."""
    write_atomic(path, plan_to_json(plan))


def plan_to_json(plan: Plan) -> bytes:
    """The plan as a `robotd-plan/1` file: one label a line."""
    return _to_json(plan, f"plan of {plan.survey}")


def _check_plan(parts: Mapping[str, Any], problems: Problems) -> None:
    """Stops along the line come one after the other, from where the robot stands."""
    last = parts.get("begin", 0.0)
    for index, stop in enumerate(parts.get("stops") or ()):
        if stop is None or stop.along is None:
            continue
        if stop.along < last or (index and stop.along == last):
            problems.add(f"stops[{index}].along", f"found {stop.along:g} after {last:g}; expected increasing metres")
        last = max(last, stop.along)


# ---- JSON ------------------------------------------------------------------------------------------------------------


def _table(data: bytes, where: str, formats: tuple[str, ...]) -> dict[str, Any]:
    """Decode a JSON object, refuse repeated keys and a `format` that is not in `formats` (if any)."""
    try:
        table = msgspec.json.decode(data)
        repeated = repeated_keys(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        lenient = with_infinite(data)
        if lenient is None or (formats and lenient.get("format") not in formats):
            raise InputError(f"{where}: not valid JSON{_place(data, error)}") from error
        table, repeated = lenient, []  # what reads its fields names each number with its place, and refuses it
    except (RecursionError, ValueError) as error:
        text = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise InputError(f"{where}: not valid JSON: {text}") from error
    if not isinstance(table, dict):
        raise InputError(f"{where}: found {type(table).__name__}; expected an object in braces")
    if formats:
        known = " or ".join(f'"{name}"' for name in formats)
        if "format" not in table:
            raise InputError(f"{where}: missing key 'format'; expected {known}")
        if table["format"] not in formats:
            found = json.dumps(table["format"])[:60]
            raise InputError(f"{where} format: found {found}; expected {known}, the only kind that is read here")
    if repeated:
        raise InputError(*(f"{where}: {text}" for text in repeated))
    return table


def _place(data: bytes, error: Exception) -> str:
    """Where decoding stopped (line, column, byte) and why, in words."""
    reason, at = str(error), re.search(r"\(byte (\d+)\)", str(error))
    byte = int(at[1]) if at else None
    try:
        json.loads(data.decode("utf-8"), parse_constant=_refuse_number, parse_float=_finite)
    except UnicodeDecodeError as bad:
        reason, byte = "not UTF-8; save the file as UTF-8", bad.start
    except json.JSONDecodeError as bad:
        reason, byte = bad.msg[:1].lower() + bad.msg[1:], len(bad.doc[: bad.pos].encode())
    except (ValueError, RecursionError) as bad:
        reason = str(bad)
    if byte is None:
        return f": {reason}"
    line = data.count(b"\n", 0, byte) + 1
    column = len(data[data.rfind(b"\n", 0, byte) + 1 : byte].decode("utf-8", "replace")) + 1
    return f" at line {line}, column {column} (byte {byte}): {reason}"


def _refuse_number(text: str) -> float:
    raise ValueError(f"found {text[:40]}; expected a finite number")


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse_number(text)


# a missing optional key means null, and null means missing: these bring both into the form that the records have


def _tidy_survey(table: dict[str, Any]) -> None:
    _drop_nulls(table, "sigmas", "priors", "known_labels", "roof_cameras")
    rig = table.get("rig")
    if isinstance(rig, dict):
        _drop_nulls(rig, "beacons")
        for camera in _dicts(rig.get("cameras")):
            _drop_nulls(camera, "distortion", "model")
    for stop in _dicts(table.get("stops")):
        _tidy_stop(stop)


def _tidy_stop(stop: dict[str, Any]) -> None:
    _drop_nulls(stop, "sightings", "beacon_sightings", "motions")
    stop.setdefault("move", None)


def _tidy_map(table: dict[str, Any]) -> None:
    _drop_nulls(table, "notes")
    for label in _dicts(table.get("labels")):
        _drop_nulls(label, "candidates")
    for sighting in _dicts(table.get("sightings")):
        sighting.setdefault("residual_px", None)


def _drop_nulls(table: dict[str, Any], *keys: str) -> None:
    for key in keys:
        if key in table and table[key] is None:
            del table[key]


def _dicts(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, list):
        yield from (item for item in value if isinstance(item, dict))


def _bound(cls: type[R], table: dict[str, Any], where: str, check: Callable[[Mapping[str, Any], Problems], None]) -> R:
    """Bind a decoded object and check it; if it does not bind, still check those of its parts that do."""
    try:
        record = bind(cls, table, where)
    except ConfigError as error:
        problems = Problems(where)
        problems.found.extend(error.problems)
        check(_parts(cls, table), problems)
        raise InputError(*problems.found) from None
    return _checked(record, where, check)


def _checked(record: R, where: str, check: Callable[[Mapping[str, Any], Problems], None]) -> R:
    """The record itself, if the check finds nothing."""
    problems = Problems(where)
    check({field.name: getattr(record, field.name) for field in dataclasses.fields(typing.cast(Any, record))}, problems)
    problems.raise_if_any()
    return record


def _parts(cls: type, table: dict[str, Any]) -> dict[str, Any]:
    """The fields that bind by themselves; of a list of records the items that do, the others None."""
    hints = typing.get_type_hints(cls)
    parts: dict[str, Any] = {}
    for name in hints.keys() & table.keys():
        kind, value = hints[name], table[name]
        items = typing.get_args(kind)
        try:
            if typing.get_origin(kind) is tuple and dataclasses.is_dataclass(items[0]) and isinstance(value, list):
                parts[name] = tuple(_item(items[0], item) for item in value)
            else:
                parts[name] = bind(kind, value, "")
        except ConfigError:
            continue  # reported already, when the whole did not bind
    return parts


def _item(kind: Any, value: Any) -> Any:
    try:
        return bind(kind, value, "")
    except ConfigError:
        return None


def _to_json(record: Any, where: str) -> bytes:
    try:
        return (_render(record, "") + "\n").encode()
    except (ValueError, TypeError) as error:
        raise InputError(f"{where}: cannot be written: {'; '.join(_unwritable(record, '')) or error}") from error


def _render(value: Any, pad: str) -> str:
    """JSON with one record a line; records that hold lists of records, and those lists, are broken up."""
    inner = pad + " "
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = _fields(value)
        if pad and not any(_is_list_of_records(item) for item in fields.values()):
            return _dumps(fields)
        lines = [f"{inner}{_dumps(name)}: {_render(item, inner)}" for name, item in fields.items()]
        return "{\n" + ",\n".join(lines) + f"\n{pad}}}"
    if _is_list_of_records(value):
        return "[\n" + ",\n".join(inner + _render(item, inner) for item in value) + f"\n{pad}]"
    return _dumps(value)


def _dumps(value: Any) -> str:
    return json.dumps(value, default=_fields, allow_nan=False, ensure_ascii=False)


def _fields(record: Any) -> dict[str, Any]:
    if not dataclasses.is_dataclass(record):
        raise TypeError(f"a {type(record).__name__} has no place in the file")
    kind: Any = type(record)
    return {name: getattr(record, name) for name in _names(kind)}


@functools.cache
def _names(cls: Any) -> list[str]:
    return sorted((field.name for field in dataclasses.fields(cls)), key=lambda name: name != "format")


def _is_list_of_records(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and dataclasses.is_dataclass(value[0])


def _unwritable(value: Any, path: str) -> Iterator[str]:
    if dataclasses.is_dataclass(value):
        for name, item in _fields(value).items():
            yield from _unwritable(item, f"{path}.{name}" if path else name)
    elif isinstance(value, dict):
        for name, item in value.items():
            yield from _unwritable(item, f"{path}.{name}")
    elif isinstance(value, tuple | list):
        for index, item in enumerate(value):
            yield from _unwritable(item, f"{path}[{index}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield f"{path} is {value}, expected a finite number"


# ---- tables ----------------------------------------------------------------------------------------------------------


def load_points(path: str | Path) -> Points:
    """Read `truth.csv` or `known.csv`: header label,x,y,z and perhaps sigma; metres.

    Returns
    -------
    dict
        Label to (position, sigma); sigma is None where the table gives none.

    Raises
    ------
    InputError
        Lists every mistake with its line.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 at byte {error.start}; save the table as UTF-8") from error
    try:
        rows = [(number, row) for number, row in _rows(text) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise InputError(f"{path}: not a table: {error}; expected one label a line") from error
    header = [cell.strip() for cell in rows[0][1]] if rows else []
    if sorted(header) not in (["label", "x", "y", "z"], ["label", "sigma", "x", "y", "z"]):
        found = repr(",".join(header)[:80]) if header else "nothing"
        raise InputError(f"{path} line 1: found {found}; expected the header label,x,y,z or label,x,y,z,sigma")
    points: Points = {}
    first: dict[str, int] = {}
    problems: list[str] = []
    for number, row in rows[1:]:
        where = f"{path} line {number}"
        if len(row) != len(header):
            problems.append(f"{where}: found {len(row)} cells; expected {len(header)}, as the header has")
            continue
        cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
        label = cells.pop("label")
        if not label:
            problems.append(f"{where} label: found nothing; expected the label's id")
        if label in first:
            problems.append(f"{where} label: {label[:60]!r} is on line {first[label]} already; keep one")
        first.setdefault(label, number)
        values = {name: _number(cell, f"{where} {name}", problems) for name, cell in cells.items() if name != "sigma"}
        sigma = _number(cells["sigma"], f"{where} sigma", problems) if cells.get("sigma") else None
        if sigma is not None and sigma <= 0:
            problems.append(f"{where} sigma: found {sigma:g}; expected above 0")
        points[label] = ((values["x"], values["y"], values["z"]), sigma)
    if problems:
        raise InputError(*problems)
    return points


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    for row in reader:
        yield reader.line_num, row


def _number(cell: str, where: str, problems: list[str]) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not abs(value) <= FARTHEST_M:
        problems.append(f"{where}: found {cell[:40]!r}; expected a finite number in metres, up to {FARTHEST_M:g}")
    return value


def save_truth(path: str | Path, positions: Mapping[str, Vector3]) -> None:
    """Write label,x,y,z (metres, full precision), atomically."""
    _save_table(path, "label,x,y,z", ([label, *map(_cell, position)] for label, position in positions.items()))


def save_map_csv(result: Map, path: str | Path) -> None:
    """Write label,x,y,z,sx,sy,sz,status,sightings, atomically; cells that are not known stay empty."""
    rows = []
    for label in result.labels:
        position = [""] * 3 if label.position is None else [_cell(value) for value in label.position]
        sigma = [""] * 3
        if label.covariance is not None:
            sigma = [_cell(math.sqrt(max(label.covariance[axis][axis], 0.0))) for axis in range(3)]
        rows.append([label.label, *position, *sigma, label.status, str(label.sightings)])
    _save_table(path, "label,x,y,z,sx,sy,sz,status,sightings", rows)


def _cell(value: float) -> str:
    return repr(float(value))


def _save_table(path: str | Path, header: str, rows: Iterable[list[str]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header.split(","))
    writer.writerows(rows)
    write_atomic(path, text.getvalue().encode())


# ---- bytes -----------------------------------------------------------------------------------------------------------


def read_bytes(path: str | Path) -> bytes:
    """Read a whole file; raises InputError with the reason."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; create it or name another one") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read: {reason}") from error


def write_atomic(path: str | Path, data: bytes) -> None:
    """Replace a file as a whole: written beside it, flushed to the disk, renamed; its mode and links to it stay.

    Raises InputError if it cannot be written.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # a pipe or a terminal has nothing to be replaced
            path.write_bytes(data)
            return
        target = path.resolve()  # a link stays one
        temporary = target.with_name(f".{target.name}.{os.getpid()}.new")
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            if target.exists():
                shutil.copymode(target, temporary)
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
        directory = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be written: {reason}") from error
