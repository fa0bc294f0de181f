"""Sightings of one camera, or of few stops, that fit nothing where all others fit: they are left out together.

Two of them meet somewhere by chance, and where nothing else saw a label, such a meeting would be its place.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..records import Floats
from .problem import Bools, Ints, Problem, stops_per_label

LEAST_LIGHTS = 20  # of one camera, to judge it
ALONE, TOGETHER = 0.5, 0.8  # shares of a camera's sightings that fit, where those of each other camera do
_LEAST = 6  # lights of one stop, or of another camera
_STRANGE, _OTHERS = 0.35, 0.85  # the same for stops, all others together
_MOST = 0.25  # of the stops


def shares(problem: Problem, fits: Bools, owner: Ints, count: int) -> tuple[Floats, Ints]:
    """Share of the lights of each owner (count,) that fit, and their number, of labels that two stops or more saw.

    `fits`, `owner` (N,) are of the problem's sightings. Of rival sightings one is right.
    """
    s = problem.sightings
    seen = stops_per_label(s.label, s.stop, len(problem.labels))[s.label] >= 2
    groups = int(s.rival.max(initial=-1)) + 1
    light, good = np.zeros(groups, dtype=np.bool_), np.zeros(groups, dtype=np.bool_)
    whose = np.zeros(groups, dtype=np.int64)
    light[s.rival[seen]], good[s.rival[seen & fits]] = True, True
    whose[s.rival] = owner
    total = np.bincount(whose[light], minlength=count)
    return np.bincount(whose[good], minlength=count) / np.maximum(total, 1), total


def strange_camera(problem: Problem, fits: Bools) -> int | None:
    """The one camera whose sightings mostly do not fit, where those of every other one do."""
    share, total = shares(problem, fits, problem.sightings.camera, len(problem.cameras))
    strange = int(np.argmin(np.where(total >= LEAST_LIGHTS, share, 1.0)))
    others = np.delete(share, strange)[np.delete(total, strange) >= _LEAST]
    if share[strange] >= ALONE or len(others) == 0 or others.min() < TOGETHER:
        return None
    return strange


def without_strangers(asked: Problem, found: Problem, fits: Bools) -> Problem | None:
    """The problem as asked without what does not belong, given which of the sightings found fit; None if all does."""
    s = found.sightings
    camera = strange_camera(found, fits)
    if camera is not None:
        share, total = shares(found, fits, s.camera, len(found.cameras))
        others = np.delete(share, camera)[np.delete(total, camera) >= _LEAST]
        note = (
            f"of camera {found.cameras[camera].name}'s sightings only {100 * share[camera]:.0f} % fit, of the others' "
            f"{100 * others.min():.0f} % or more, so these were not used; check its lens, its "
            "pictures' size and where it looks"
        )
        kept = asked.sightings.select(asked.sightings.camera != camera)
        return replace(asked, sightings=kept, notes=(*asked.notes, note))
    share, total = shares(found, fits, s.stop, found.stop_count)
    strange = (share < _STRANGE) & (total >= _LEAST)
    rest = float((share * total)[~strange].sum() / max(float(total[~strange].sum()), 1.0))
    if not strange.any() or np.count_nonzero(strange) > _MOST * found.stop_count or rest < _OTHERS:
        return None
    named = ", ".join(f"{found.survey.stops[k].leg}/{found.survey.stops[k].stop}" for k in np.flatnonzero(strange))
    note = (
        f"hardly any sighting of leg/stop {named} fits, of all others {100 * rest:.0f} %, so these were not used; are "
        "they of other stops, or was the robot moved or another label system's light seen?"
    )
    kept = asked.sightings.select(~strange[asked.sightings.stop])
    return replace(asked, sightings=kept, notes=(*asked.notes, note))
