"""The commands that ask the robot one thing and show the answer."""

from __future__ import annotations

import json
import math
import os
import sys

from .client import Connection
from .errors import DONE, REFUSED, USAGE, CtlError
from .tables import (
    battery_text,
    held_text,
    mission_text,
    mode_text,
    motion_text,
    pose_text,
    show_json,
    table,
    wrapped,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import Namespace
    from typing import Any


def connect(arguments: Namespace) -> Connection:
    """To the robot that the command line names."""
    return Connection(arguments.host, arguments.socket)


def ask(
    arguments: Namespace, method: str, params: dict[str, Any] | None = None, *, seconds: float | None = 30.0
) -> Any:
    """One request to that robot."""
    with connect(arguments) as robot:
        return robot.call(method, params, seconds=seconds)


def _say(arguments: Namespace, answer: Any, text: str) -> int:
    if arguments.json:
        show_json(answer)
    else:
        print(text)
    return DONE


# ---- status ----------------------------------------------------------------------------------------------------------


def status(arguments: Namespace) -> int:
    answer = ask(arguments, "status")
    return _say(arguments, answer, status_text(answer))


def status_text(answer: dict[str, Any]) -> str:
    """One screen."""
    mission, uploads, pose = answer["mission"], answer["uploads"], answer["pose"]
    clock = "" if answer["clock_is_synchronised"] else ", not set by a time server"
    rows = [
        ("robot", f"{answer['robot']}, robotd {answer['robotd']}"),
        ("clock", f"{answer['utc'].replace('T', ' ').replace('+00:00', ' UTC')}{clock}"),
        ("pose", pose_text(pose)),
        ("motion", motion_text(pose)),
        ("held", held_text(answer["held"]) or "no"),
        ("base", mode_text(answer["base"])),
        ("battery", battery_text(answer["base"])),
        ("mission", mission_text(mission)),
    ]
    if text := (mission["text"] or mission["ended"]):
        rows.append(("", text))
    if answer["line"] is not None:
        rows.append(("line", f"{answer['line']['state']}, {100 * answer['line']['confidence']:.0f} % sure"))
    if answer["driven_by"] is not None:
        rows.append(("driven by", answer["driven_by"]))
    if answer["busy"] is not None:
        rows.append(("busy", answer["busy"]))
    rows.append(("uploads", _uploads_text(uploads)))
    if (recording := answer["recording"]) is not None:
        rows.append(("recording", _recording_text(recording)))
    if answer["journal_rows_dropped"]:
        rows.append(("journal", f"{answer['journal_rows_dropped']} rows were not taken by the disk: make room on it"))
    lines = []
    for name, text in rows:
        for k, line in enumerate(wrapped(text, 68)):
            lines.append(f"{name if k == 0 else '':<10} {line}".rstrip())
    return "\n".join([*lines, "", _drivers_text(answer["drivers"])])


def _uploads_text(uploads: dict[str, Any]) -> str:
    if uploads["url"] is None:
        return f"no server is configured; {_count(uploads['waiting'], 'record')} to send"
    waiting = f"{_count(uploads['waiting'], 'record')} to send to" if uploads["waiting"] else "all at"
    text = f"{waiting} {uploads['url']}"
    return f"{text}; {uploads['trouble']}" if uploads["trouble"] else text


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _drivers_text(drivers: list[dict[str, Any]]) -> str:
    rows = [
        (item["name"], item["kind"], item["driver"], item["state"], item["restarts"], _counters_text(item["counters"]))
        for item in drivers
    ]
    text = table(("driver", "kind", "by", "state", "again", ""), rows)
    faults = [line for item in drivers if item["fault"] for line in _indented(item["fault"])]
    return "\n".join([text, *faults])


def _indented(text: str) -> list[str]:
    first, *rest = wrapped(text, 76)
    return [f"! {first}", *(f"  {line}" for line in rest)]


def _counters_text(counters: dict[str, float]) -> str:
    if "rate" in counters:
        lost = counters["lost"] + counters["damaged"] + counters["dropped"]
        return (
            f"{counters['rate']:.1f} fps, {lost:g} of {counters['published'] + lost:g} lost"
            if counters["published"]
            else ""
        )
    if "frames" in counters:
        bad = counters["bad_length"] + counters["bad_order"] + counters["bad_checksum"]
        return f"{counters['missing']:.0f} of {counters['frames']:.0f} missing, {bad:.0f} bad"
    return ""


# ---- motion ----------------------------------------------------------------------------------------------------------


def halt(arguments: Namespace) -> int:
    return _say(arguments, ask(arguments, "halt"), "halted")


def estop(arguments: Namespace) -> int:
    return _say(arguments, ask(arguments, "estop"), "emergency stop; robotctl release ends it")


def release(arguments: Namespace) -> int:
    answer = ask(arguments, "release")
    held = answer["latched"]
    _say(arguments, answer, "released" if held is None else f"still held: {held}")
    return DONE if held is None else REFUSED


def wake(arguments: Namespace) -> int:
    answer = ask(arguments, "wake")
    return _say(arguments, answer, answer["text"])


def dock(arguments: Namespace) -> int:
    if not arguments.json:
        print("seeking the dock; Ctrl-C stops the robot", flush=True)
    answer = ask(arguments, "dock", seconds=None)
    return _say(arguments, answer, answer["text"])


def beacons(arguments: Namespace) -> int:
    answer = ask(arguments, "beacons", {"on": None if arguments.switch is None else arguments.switch == "on"})
    if answer["fault"]:
        return _say(arguments, answer, f"the beacons have failed: {answer['fault']}")
    rates = f": {answer['front_hz']:.4g} Hz in front, {answer['rear_hz']:.4g} Hz behind" if answer["front_hz"] else ""
    return _say(arguments, answer, f"the beacons are {answer['state']}{rates if answer['state'] == 'on' else ''}")


# ---- mission ---------------------------------------------------------------------------------------------------------


def mission_start(arguments: Namespace) -> int:
    return _begin(arguments, "mission.start")


def survey_continue(arguments: Namespace) -> int:
    return _begin(arguments, "survey.continue")


def _begin(arguments: Namespace, method: str) -> int:
    answer = ask(arguments, method, {"survey": arguments.survey, "stop": arguments.stop})
    text = f"survey {answer['survey']} leg {answer['leg']} begins at stop {answer['stop']} of {answer['stops']}"
    return _say(arguments, answer, text)


def mission_pause(arguments: Namespace) -> int:
    return _say(arguments, ask(arguments, "mission.pause"), "paused; robotctl mission resume goes on")


def mission_resume(arguments: Namespace) -> int:
    return _say(arguments, ask(arguments, "mission.resume"), "goes on")


def mission_abort(arguments: Namespace) -> int:
    answer = ask(arguments, "mission.abort")
    return _say(arguments, answer, f"aborted; {_count(answer['stops'], 'stop')} kept")


def mission_status(arguments: Namespace) -> int:
    answer = ask(arguments, "mission.status")
    why = answer["text"] or answer["ended"]
    return _say(arguments, answer, mission_text(answer) + (f"\n{why}" if why else ""))


# ---- stops and surveys -----------------------------------------------------------------------------------------------


def stops_list(arguments: Namespace) -> int:
    answer = ask(arguments, "stops.list", {"survey": arguments.survey})
    rows = [
        (
            f"{stop['leg']}.{stop['stop']}",
            stop["time"].replace("T", " ")[:19],
            f"{stop['x']:.2f}",
            f"{stop['y']:.2f}",
            f"{math.degrees(stop['heading']):.0f}",
            stop["labels"],
            stop["sightings"],
            stop["is_uploaded"],
            stop["flag"] or "" if stop["rejected"] is None else f"rejected: {stop['rejected']}",
        )
        for stop in answer["stops"]
    ]
    head = ("stop", "UTC", "x m", "y m", "deg", "labels", "sightings", "on server", "")
    return _say(arguments, answer, f"survey {answer['survey']}\n{table(head, rows)}" if rows else "no stops yet")


def _stop_of(arguments: Namespace) -> dict[str, Any]:
    leg, mark, stop = arguments.stop.rpartition(".")
    if not stop.isdecimal() or (mark and not leg.isdecimal()):
        raise CtlError(USAGE, f"found {arguments.stop!r}; expected a stop such as 3, or leg and stop such as 2.3")
    return {"stop": int(stop), "leg": int(leg) if mark else None, "survey": arguments.survey}


def stops_show(arguments: Namespace) -> int:
    answer = ask(arguments, "stops.show", _stop_of(arguments))
    record = answer["record"]
    rows = [
        (item["label"], item["camera"], f"{item['u']:.1f}", f"{item['v']:.1f}", item["sigma_px"], item["probability"])
        for item in sorted(record["sightings"], key=lambda item: (item["label"], item["camera"]))
    ]
    place = pose_text(record["odometry"])
    head = f"survey {answer['survey']} stop {answer['leg']}.{answer['stop']}  {record['time']}  {place}"
    if answer["rejected"] is not None:
        head += f"\nrejected: {answer['rejected']}"
    sightings = table(("label", "camera", "u px", "v px", "sigma px", "probability"), rows) if rows else "no sightings"
    return _say(arguments, answer, f"{head}\n{sightings}")


def stops_reject(arguments: Namespace) -> int:
    params = {**_stop_of(arguments), "reason": arguments.reason, "undo": arguments.undo}
    answer = ask(arguments, "stops.reject", params)
    done = "is used again" if arguments.undo else "is rejected; --undo takes that back"
    return _say(arguments, answer, f"survey {answer['survey']} stop {answer['leg']}.{answer['stop']} {done}")


def survey_list(arguments: Namespace) -> int:
    answer = ask(arguments, "survey.list")
    rows = [
        (item["survey"], (item["created"] or "").replace("T", " ")[:19], item["legs"], item["stops"], item["rejected"],
         item["waiting"])
        for item in answer["surveys"]
    ]  # fmt: skip
    head = ("survey", "begun, UTC", "legs", "stops", "rejected", "to upload")
    return _say(arguments, answer, table(head, rows) if rows else "no surveys yet")


def survey_export(arguments: Namespace) -> int:
    answer = ask(arguments, "survey.export", {"survey": arguments.survey}, seconds=300.0)
    text = json.dumps(answer, indent=1, ensure_ascii=False) + "\n"
    if arguments.output is None:
        sys.stdout.write(text)
        return DONE
    part = f"{arguments.output}.part"
    try:
        with open(part, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(part, arguments.output)
    except OSError as error:
        raise CtlError(USAGE, f"{arguments.output}: cannot be written: {error.strerror}") from None
    print(f"{len(answer['stops'])} stops of survey {answer['survey']} written to {arguments.output}", file=sys.stderr)
    return DONE


# ---- devices ---------------------------------------------------------------------------------------------------------


def drivers_list(arguments: Namespace) -> int:
    answer = ask(arguments, "drivers.list")
    return _say(arguments, answer, _drivers_text(answer["drivers"]))


def drivers_restart(arguments: Namespace) -> int:
    return _say(
        arguments, ask(arguments, "drivers.restart", {"name": arguments.name}), f"{arguments.name} is restarted"
    )


def record_start(arguments: Namespace) -> int:
    params = {
        "cameras": arguments.cameras,
        "name": arguments.name,
        "seconds": arguments.seconds,
        "limit_mb": arguments.megabytes,
        "raw": arguments.raw or None,
    }
    answer = ask(arguments, "record.start", params)
    return _say(arguments, answer, f"recording {', '.join(answer['cameras'])} into {answer['file']}")


def record_stop(arguments: Namespace) -> int:
    answer = ask(arguments, "record.stop")
    return _say(arguments, answer, _recording_text(answer))


def record_status(arguments: Namespace) -> int:
    answer = ask(arguments, "record.status")
    return _say(arguments, answer, _recording_text(answer))


def record_list(arguments: Namespace) -> int:
    answer = ask(arguments, "record.list")
    rows = [tuple(item.values()) for item in answer["recordings"]]
    text = table([name.replace("_", " ") for name in answer["recordings"][0]], rows) if rows else "no recordings yet"
    return _say(arguments, answer, text)


def _recording_text(recording: dict[str, Any]) -> str:
    if "file" not in recording:
        return "no recording yet"
    text = f"{recording['file']}: {recording['seconds']:.0f} s, {recording['bytes'] / 1e6:.1f} MB"
    lost = f", {recording['dropped']} frames dropped" if recording["dropped"] else ""
    state = "recording" if recording["recording"] else f"recorded, {recording['ended']}"
    return f"{state}: {text}{lost}"


# ---- logs and configuration ------------------------------------------------------------------------------------------


def logs(arguments: Namespace) -> int:
    levels = ("info", "warning", "error")
    with connect(arguments) as robot:
        found = robot.call("logs", {"count": arguments.count, "level": arguments.level})["events"]
        if arguments.follow:
            robot.send("subscribe", {"rate": 0.0, "events": True})
        for event in found:
            _show_event(arguments, event)
        while arguments.follow:
            message = robot.note(None)
            if message is not None and message.get("method") == "event":
                event = message["params"]
                if levels.index(event["level"]) >= levels.index(arguments.level):
                    _show_event(arguments, event)
    return DONE


def _show_event(arguments: Namespace, event: dict[str, Any]) -> None:
    if arguments.json:
        print(json.dumps(event, ensure_ascii=False), flush=True)
        return
    sure = " " if event.get("is_sure", True) else "?"
    level = "" if event["level"] == "info" else f"{event['level'].upper()} "
    print(f"{event['utc'].replace('T', ' ')[:19]}{sure} {event['source']}: {level}{event['text']}", flush=True)


def config_show(arguments: Namespace) -> int:
    answer = ask(arguments, "config.show", {"effective": arguments.effective})
    if arguments.json:
        show_json(answer)
    else:
        print(f"# {answer['path']}{', with every default' if arguments.effective else ''}; secrets are masked")
        print(answer["toml"], end="")
    return DONE


def config_reload(arguments: Namespace) -> int:
    answer = ask(arguments, "config.reload")
    changed = ", ".join(answer["changed"])
    return _say(arguments, answer, f"changed: {changed}" if changed else "nothing has changed")
