"""What `robotctl calibrate` collected on the robot: a folder with `data.json`, and the recording that it names."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from .errors import InputError
from .files import read_bytes

FORMAT = "robotd-calibration-data/1"

T = TypeVar("T")


def read_collected(arguments: argparse.Namespace, what: str, parse: Callable[[dict[str, Any]], T]) -> tuple[T, Path]:
    """What `parse` makes of the data in `arguments.folder`, and the recording that belongs to it.

    `parse` may raise KeyError, TypeError or ValueError where something is missing. `arguments.recording` (or None) is
    where the recording is, if neither where the data say nor beside them.

    Raises
    ------
    InputError
        If these are no data for `calibrate what`, or the recording is not there.
    """
    where = arguments.folder / "data.json"
    try:
        data = json.loads(read_bytes(where))
        found = f"{data['format']} of {data['what']}"
        if found != f"{FORMAT} of {what}":
            raise InputError(f"{where}: is {found}; expected {FORMAT} of {what}")
        named = Path(str(data["recording"]["file"]))
        result = parse(data)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: is not what robotctl calibrate {what} writes: {error!r}") from error
    places = [arguments.recording] if arguments.recording is not None else [named, arguments.folder / named.name]
    for place in places:
        if place.is_file():
            return result, place
    raise InputError(f"{places[-1]}: there is no such recording; copy it from the robot ({named}), or give --recording")
