"""How long a beacon stood where: what fixes come to while the robot stands still, and the record on disk.

A robot that was offline brings its stops hours later, so dwells are kept: `<data>/roof/dwells/<camera>.jsonl`, a line
each, appended and synced. A dwell that goes on is written again; the last line of a begin counts. A line that a power
cut left half written is passed over.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import msgspec
import numpy as np

from ..errors import InputError
from ..files import write_atomic
from ..records import Floats
from ..vision.beacon import FLOOR_PX, STILL_S, BeaconFix
from .setup import RoofCalibration

FIRST_S = 2.0  # of standing, before a dwell is worth a line
AGAIN_S = 5.0  # between two lines of a dwell that goes on
SILENT_S = 4.0  # without a fix: the dwell is over
AWAY_PX = 1.0  # from the dwell's mean: it is another one


@dataclass(frozen=True, slots=True)
class Dwell:
    """One beacon, standing still in one camera's picture.

    `begin` and `end` are dates in seconds since 1970; `u`, `v` as seen, in px, with covariance `uu`, `uv`, `vv`.
    `calibration` is the digest of the one that was valid. `is_open`: it may still go on.
    """

    camera: str
    beacon: str
    begin: float
    end: float
    u: float
    v: float
    uu: float
    uv: float
    vv: float
    fixes: int
    calibration: str
    is_open: bool


class DwellBuilder:
    """Turns one beacon's fixes in one camera into dwells.

    Parameters
    ----------
    camera, beacon, calibration : str
        As in `Dwell`.
    """

    def __init__(self, camera: str, beacon: str, calibration: str) -> None:
        self.camera = camera
        self.beacon = beacon
        self.calibration = calibration
        self._places: list[tuple[float, Floats, Floats]] = []  # fixes that share no frames
        self._latest: tuple[Floats, Floats] | None = None
        self._begin = self._end = 0.0
        self._written = float("-inf")

    def add(self, fix: BeaconFix, date: float) -> list[Dwell]:
        """Take a fix; `date` is that of its last frame. Returns the lines to write."""
        place, spread = np.array([fix.u, fix.v]), np.array(fix.covariance)
        lines: list[Dwell] = []
        if self._latest is not None:
            middle = self._mean()[0]
            gone = fix.still_since is None or float(np.hypot(*(place - middle))) > AWAY_PX
            if gone or date - self._end > SILENT_S:
                lines += self.close()
        if fix.still_since is None:
            return lines
        since = date - (fix.until - fix.still_since)
        if self._latest is None:
            self._begin = since
        self._end = max(date, self._begin)
        self._latest = place, spread
        if not self._places or date - self._places[-1][0] >= STILL_S:
            self._places.append((date, place, spread))
        if self._end - self._begin >= FIRST_S and date - self._written >= AGAIN_S:
            self._written = date
            lines.append(self._dwell(is_open=True))
        return lines

    def idle(self, date: float) -> list[Dwell]:
        """Nothing was seen lately; returns the line that ends the dwell, if that is over."""
        return self.close() if self._latest is not None and date - self._end > SILENT_S else []

    def close(self) -> list[Dwell]:
        """End the dwell, if there is one that is worth a line."""
        lines = [self._dwell(is_open=False)] if self._latest and self._end - self._begin >= FIRST_S else []
        self._places, self._latest, self._written = [], None, float("-inf")
        return lines

    def _mean(self) -> tuple[Floats, Floats]:
        """Mean place and its covariance; what compression leaves does not fall with the number of fixes."""
        assert self._latest is not None
        floor = FLOOR_PX**2 * np.eye(2)
        rows = [(place, spread) for _, place, spread in self._places[1:]] or [self._latest]
        weights = [np.linalg.inv(spread - floor + 1e-4 * np.eye(2)) for _, spread in rows]
        total = np.linalg.inv(np.sum(weights, axis=0))
        mean = total @ np.sum([weight @ place for weight, (place, _) in zip(weights, rows, strict=True)], axis=0)
        return mean, total + floor

    def _dwell(self, *, is_open: bool) -> Dwell:
        place, spread = self._mean()
        return Dwell(
            camera=self.camera,
            beacon=self.beacon,
            begin=round(self._begin, 3),
            end=round(self._end, 3),
            u=float(place[0]),
            v=float(place[1]),
            uu=float(spread[0, 0]),
            uv=float(spread[0, 1]),
            vv=float(spread[1, 1]),
            fixes=max(1, len(self._places) - 1),
            calibration=self.calibration,
            is_open=is_open,
        )


class RoofLog:
    """Dwells and the calibrations that they refer to, in a folder."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "roof"

    def exists(self) -> bool:
        """Whether a roof camera ever wrote here."""
        return (self._folder / "dwells").is_dir()

    def add(self, dwells: Iterable[Dwell]) -> None:
        """Append lines, on the disk when this returns; raises InputError if the disk does not take them."""
        for dwell in dwells:
            path = self._folder / "dwells" / f"{_spelled(dwell.camera)}.jsonl"
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                line = msgspec.json.encode(dwell) + b"\n"
                with path.open("ab") as file:
                    if file.tell() and not _ends_with_newline(path):
                        line = b"\n" + line  # a power cut left half a line
                    file.write(line)
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error

    def dwells(self) -> list[Dwell]:
        """All dwells, oldest first, each as it was written last."""
        latest: dict[tuple[str, str, float, str], Dwell] = {}
        for path in sorted((self._folder / "dwells").glob("*.jsonl")):
            for dwell in _lines(path):
                latest[dwell.camera, dwell.beacon, dwell.begin, dwell.calibration] = dwell
        return sorted(latest.values(), key=lambda dwell: dwell.begin)

    def keep(self, calibration: RoofCalibration) -> None:
        """Keep a calibration, so that dwells that refer to it can be used for ever."""
        path = self._folder / "cameras" / f"{_spelled(calibration.name)}-{calibration.digest}.json"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, msgspec.json.encode(calibration))

    def calibrations(self) -> dict[str, RoofCalibration]:
        """Every calibration that was kept, by its digest."""
        found = {}
        for path in sorted((self._folder / "cameras").glob("*.json")):
            try:
                calibration = msgspec.json.decode(path.read_bytes(), type=RoofCalibration)
            except (OSError, msgspec.MsgspecError) as error:
                raise InputError(f"{path}: cannot be read: {error}") from error
            found[calibration.digest] = calibration
        return found


def _lines(path: Path) -> Iterator[Dwell]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    for line in data.split(b"\n"):
        try:
            yield msgspec.json.decode(line, type=Dwell)
        except msgspec.MsgspecError:
            continue


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


def _spelled(name: str) -> str:
    return quote(name, safe="").replace(".", "%2E")
