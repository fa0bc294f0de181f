"""Sightings as columns: one pass over very many records, because a large survey has a hundred thousand of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .records import Floats, Sighting

kernel: Any
try:
    from . import _sightings as kernel
except ImportError:  # built without extensions
    kernel = None

T = TypeVar("T")


def read(
    rows: list[Sighting], cameras: Mapping[str, int], sigma_px: float
) -> tuple[NDArray[np.int64], list[str], Floats]:
    """What sightings hold, column by column.

    Parameters
    ----------
    rows : list of Sighting
    cameras : mapping of camera to its number
    sigma_px : float
        For those that state none.

    Returns
    -------
    camera, label, numbers
        (N,) number of the camera, -1 for one that is not in the mapping; the labels; and (4, N) u, v, sigma in px,
        and probability, 1 where none is stated.
    """
    if kernel is not None:
        found: tuple[NDArray[np.int64], list[str], Floats] = kernel.read(rows, dict(cameras), sigma_px)
        return found
    count, numbers = len(rows), np.empty((4, len(rows)))
    for k, name in enumerate(("u", "v")):
        numbers[k] = np.fromiter(map(attrgetter(name), rows), np.float64, count)
    numbers[2] = np.fromiter((sigma_px if s.sigma_px is None else s.sigma_px for s in rows), np.float64, count)
    numbers[3] = np.fromiter((1.0 if s.probability is None else s.probability for s in rows), np.float64, count)
    camera = np.fromiter((cameras.get(s.camera, -1) for s in rows), np.int64, count)
    return camera, [s.label for s in rows], numbers


def made(cls: type[T], columns: list[list[Any]]) -> tuple[T, ...]:
    """Records of a frozen dataclass with slots from a list of values for each of its fields, in their order."""
    names = tuple(field.name for field in fields(cls))  # type: ignore[arg-type]
    if len(names) != len(columns) or len({len(column) for column in columns}) != 1:
        raise ValueError(f"need {len(names)} columns of one length, got {[len(column) for column in columns]}")
    if kernel is not None:
        records: tuple[T, ...] = kernel.made(cls, names, columns)
        return records
    return tuple(map(cls, *columns))
