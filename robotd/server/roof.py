"""What the roof cameras of this place add to surveys: `robotd-solver roof watch` writes dwells beside them."""

from __future__ import annotations

from pathlib import Path

import msgspec

from ..files import survey_from_json, survey_to_json
from ..roof.dwell import RoofLog
from ..roof.join import Joined, join, with_roof


def join_roof(survey: bytes, where: str, data: Path) -> tuple[bytes, tuple[str, ...]]:
    """A `robotd-survey/1` with the beacons that roof cameras saw at its stops, and notes for the operator.

    Without a roof camera in `data` the bytes come back as they are.

    Raises
    ------
    InputError
        The survey or a file of the roof cameras is wrong.
    """
    log = RoofLog(data)
    if not log.exists():
        return survey, ()
    record = survey_from_json(survey, where)
    if not record.stops:
        return survey, ()
    if not record.rig.beacons:
        return survey, ("roof cameras watch here, but the robot's calibration has no [beacons], so they were not used",)
    joined: Joined = join(record.stops, log.dwells(), log.calibrations(), record.rig.beacons)
    if not joined.sightings:
        return survey, joined.notes
    return survey_to_json(with_roof(record, joined)), joined.notes


def with_notes(solved: bytes, notes: tuple[str, ...]) -> bytes:
    """A `robotd-map/1` with more notes."""
    if not notes:
        return solved
    table = msgspec.json.decode(solved)
    table["notes"] = [*table.get("notes", ()), *notes]
    return msgspec.json.encode(table)
