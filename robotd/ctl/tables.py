"""Tables and figures for people."""

from __future__ import annotations

import json
import math
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any


def show_json(value: Any) -> None:
    """One JSON value on standard output."""
    json.dump(value, sys.stdout, indent=2, ensure_ascii=False)
    print()


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Columns as wide as they need; figures to the right, words to the left; the last column as long as it is."""
    cells = [[_text(cell) for cell in row] for row in rows]
    widths = [max(len(line[k]) for line in [list(head), *cells]) for k in range(len(head))]
    right = [bool(rows) and all(isinstance(row[k], int | float | None) for row in rows) for k in range(len(head))]
    lines = []
    for line in [list(head), *cells]:
        parts = [
            part.rjust(width) if is_right else part.ljust(width)
            for part, width, is_right in zip(line, widths, right, strict=True)
        ]
        lines.append("  ".join(parts).rstrip())
    return "\n".join(lines)


def _text(cell: object) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.3g}"
    return str(cell)


def pose_text(pose: dict[str, Any] | None) -> str:
    """x, y, heading in words."""
    if pose is None:
        return "unknown"
    return f"x {pose['x']:.2f}, y {pose['y']:.2f} m, heading {math.degrees(pose['heading']):.0f}\N{DEGREE SIGN}"


def motion_text(pose: dict[str, Any] | None) -> str:
    """Speed and way in words."""
    if pose is None:
        return "-"
    turn = math.degrees(pose["turn_rate"])
    return f"{pose['speed']:.2f} m/s, {turn:.0f}\N{DEGREE SIGN}/s, driven {pose['travelled']:.2f} m"


def battery_text(base: dict[str, Any] | None) -> str:
    """Charge and voltage in words."""
    if base is None:
        return "unknown"
    parts = [] if base["charge"] is None else [f"{100 * base['charge']:.0f} %"]
    if base["voltage"] is not None:
        parts.append(f"{base['voltage']:.1f} V")
    if base["charging"]:
        parts.append("charging")
    elif base["docked"]:
        parts.append("docked")
    return ", ".join(parts) or "unknown"


def mode_text(base: dict[str, Any] | None) -> str:
    """The base's mode, and what touches it."""
    if base is None:
        return "the base has not spoken yet"
    senses = [name.replace("_", " ") for name in ("bump", "cliff", "wheel_drop", "slipping") if base[name]]
    return ", ".join([f"{base['mode']} mode", *senses])


def held_text(cause: str | None) -> str:
    """Why the wheels are held, "" if nothing holds them but that nobody wants them to turn."""
    return "" if cause is None or cause.startswith("no drive command") else cause


def mission_text(mission: dict[str, Any]) -> str:
    """State, stop and cause in words."""
    parts = [mission["state"]]
    if mission["stops"] and mission["state"] not in ("idle", "done"):
        parts.append(f"stop {mission['stop']} of {mission['stops']}")
    if mission["survey"] is not None:
        parts.append(f"survey {mission['survey']} leg {mission['leg']}, {mission['stops_made']} made")
    return ", ".join(parts)


def wrapped(text: str, width: int) -> list[str]:
    """Text in lines of at most `width` characters."""
    lines = [""]
    for word in text.split():
        while len(word) > width:
            lines.append(word[:width])
            word = word[width:]
        if not lines[-1]:
            lines[-1] = word
        elif len(lines[-1]) + 1 + len(word) <= width:
            lines[-1] += " " + word
        else:
            lines.append(word)
    return [line for line in lines if line] or [""]
