"""Missions, their stops, and surveys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from .. import rpc
from ..bind import ranged
from ..clock import in_thread
from ..control_socket import Client
from ..journal_records import StopSummary
from ..mission import Mission
from ..rpc import RpcError
from .table import Nothing, Operations, method


@dataclass(frozen=True, slots=True)
class Start:
    """`survey`: its name, instead of the configured one; `stop`: at which stop the robot stands."""

    survey: str | None = None
    stop: int = ranged(1, minimum=1, maximum=10000)


@dataclass(frozen=True, slots=True)
class Which:
    """`survey`: its name; default: the configured one."""

    survey: str | None = None


@dataclass(frozen=True, slots=True)
class WhichStop:
    """One stop."""

    stop: int = ranged(minimum=1)
    leg: int | None = ranged(None, minimum=1)
    survey: str | None = None


@dataclass(frozen=True, slots=True)
class Rejection:
    """One stop, and why; `undo`: take the rejection back."""

    stop: int = ranged(minimum=1)
    leg: int | None = ranged(None, minimum=1)
    survey: str | None = None
    reason: str = ""
    undo: bool = False


def _running(operations: Operations) -> Mission:
    mission = operations.robot.mission
    if mission is None or mission.is_over:
        raise RpcError(rpc.REFUSED, "no mission is under way; robotctl mission start begins one")
    return mission


async def _start(operations: Operations, start: Start, *, goes_on: bool) -> Any:
    robot = operations.robot
    config = robot.assembly.config.mission
    operations.check_free()
    most = config.marker_stops if config.stop_at == "markers" else len(config.stops)
    if start.stop > most:
        raise RpcError(rpc.REFUSED, f"there is no stop {start.stop}: the mission has {most} ([mission] stops)")
    survey = start.survey or config.survey
    made = (await in_thread(robot.journal.surveys)).get(survey)
    if goes_on and made is None:
        raise RpcError(rpc.REFUSED, f"there is no survey '{survey}' to go on with; robotctl mission start begins it")
    if not goes_on and made is not None and made.stops:
        raise RpcError(
            rpc.REFUSED,
            f"survey '{survey}' has {made.stops} stops already; robotctl survey continue adds a leg to it, "
            "robotctl mission start --survey NAME begins another one",
        )
    await robot.missions.start(survey=survey, first_stop=start.stop)
    assert robot.mission is not None
    return {"survey": survey, "leg": robot.mission.leg, "stop": start.stop, "stops": most}


@method("mission.start", Start)
async def start(operations: Operations, client: Client, params: Start) -> Any:
    """Begin a new survey where the robot stands."""
    return await _start(operations, params, goes_on=False)


@method("survey.continue", Start)
async def go_on(operations: Operations, client: Client, params: Start) -> Any:
    """Begin another leg of a survey, at that stop."""
    return await _start(operations, params, goes_on=True)


@method("mission.pause")
def pause(operations: Operations, client: Client, _: Nothing) -> Any:
    """Halt, and stand still until `mission.resume`."""
    _running(operations).pause(f"paused by {client.who}")
    return {}


@method("mission.resume")
def resume(operations: Operations, client: Client, _: Nothing) -> Any:
    """Go on; the step at which it was paused is repeated."""
    mission, control = _running(operations), operations.robot.control
    if mission.paused is None:
        raise RpcError(rpc.REFUSED, "the mission is not paused; robotctl mission status says what it does")
    if operations.busy is not None:
        raise RpcError(rpc.REFUSED, f"{operations.busy} is under way; robotctl halt ends it")
    control.resume(client.who)
    if (held := control.gate.latched) is not None:
        mend = "robotctl release" if held.startswith("emergency stop") else "see to it"
        raise RpcError(rpc.REFUSED, f"the robot is held: {held}; {mend}, then resume again")
    mission.resume()
    return {}


@method("mission.abort")
def abort(operations: Operations, client: Client, _: Nothing) -> Any:
    """Halt, and end the mission; the stops that were made are kept and uploaded."""
    mission = _running(operations)
    mission.abort(f"aborted by {client.who}")
    return {"stops": len(mission.stops)}


def mission_status(operations: Operations) -> dict[str, Any]:
    """Where the mission is, for people and programs."""
    robot, status = operations.robot, operations.bus.status.latest
    mission = robot.mission
    return {
        "state": "idle" if status is None else status.state,
        "stop": 0 if status is None else status.stop,
        "stops": 0 if status is None else status.stops,
        "text": "" if status is None else status.text,
        "survey": None if mission is None else mission.config.survey,
        "leg": None if mission is None else mission.leg,
        "stops_made": 0 if mission is None else len(mission.stops),
        "paused": None if mission is None else mission.paused,
        "ended": None if mission is None else mission.ended,
        "is_under_way": mission is not None and not mission.is_over,
    }


@method("mission.status")
def status(operations: Operations, client: Client, _: Nothing) -> Any:
    """Where the mission is."""
    return mission_status(operations)


# ---- stops and surveys -----------------------------------------------------------------------------------------------


@method("survey.list")
async def surveys(operations: Operations, client: Client, _: Nothing) -> Any:
    """Every survey in the journal."""
    found = await in_thread(operations.robot.journal.surveys)
    return {"surveys": [{"survey": name, **_plain(summary)} for name, summary in found.items()]}


@method("survey.export", Which)
async def export(operations: Operations, client: Client, which: Which) -> Any:
    """A whole survey, robotd-survey/1."""
    name = which.survey or operations.robot.assembly.config.mission.survey
    return await in_thread(operations.robot.journal.survey, name)


@method("stops.list", Which)
async def stops(operations: Operations, client: Client, which: Which) -> Any:
    """The stops of a survey."""
    name = which.survey or operations.robot.assembly.config.mission.survey
    found = await in_thread(operations.robot.journal.stops, name)
    return {"survey": name, "stops": [_plain_stop(item) for item in found]}


@method("stops.show", WhichStop)
async def show(operations: Operations, client: Client, which: WhichStop) -> Any:
    """One stop with its sightings."""
    name, leg = await _find(operations, which.survey, which.leg, which.stop)
    found = await in_thread(operations.robot.journal.stops, name)
    summary = next(item for item in found if (item.stop.leg, item.stop.stop) == (leg, which.stop))
    return {"survey": name, **_plain_stop(summary), "record": summary.stop}


@method("stops.reject", Rejection)
async def reject(operations: Operations, client: Client, params: Rejection) -> Any:
    """Leave a stop's sightings out of its survey, here and on the server; its pose stays, for the stops around it."""
    robot = operations.robot
    name, leg = await _find(operations, params.survey, params.leg, params.stop)
    if params.undo:
        await in_thread(robot.journal.restore, name, leg, params.stop)
    else:
        reason = params.reason or f"by {client.who}"
        await in_thread(robot.journal.reject, name, leg, params.stop, reason)
    if robot.uploader is not None:
        robot.uploader.wake()
    return {"survey": name, "leg": leg, "stop": params.stop}


async def _find(operations: Operations, survey: str | None, leg: int | None, stop: int) -> tuple[str, int]:
    """Survey and leg of a stop; without a leg it must be the only one of that number."""
    name = survey or operations.robot.assembly.config.mission.survey
    found = [item.stop for item in await in_thread(operations.robot.journal.stops, name)]
    legs = [item.leg for item in found if item.stop == stop and leg in (None, item.leg)]
    if len(legs) != 1:
        there = ", ".join(f"{item.leg}.{item.stop}" for item in found) or "none"
        what = (
            f"stop {stop} is in several legs"
            if legs
            else f"there is no stop {stop if leg is None else f'{leg}.{stop}'}"
        )
        raise RpcError(rpc.REFUSED, f"survey '{name}': {what}; there is (leg.stop) {there}")
    return name, legs[0]


def _plain(summary: Any) -> dict[str, Any]:
    return {name: getattr(summary, name) for name in summary.__dataclass_fields__}


def _plain_stop(item: StopSummary) -> dict[str, Any]:
    stop = item.stop
    return {
        "leg": stop.leg,
        "stop": stop.stop,
        "time": stop.time,
        "x": stop.odometry.x,
        "y": stop.odometry.y,
        "heading": stop.odometry.heading,
        "labels": len({sighting.label for sighting in stop.sightings}),
        "sightings": len(stop.sightings),
        "is_uploaded": item.is_uploaded,
        "rejected": item.rejected,
        "flag": item.flag,
    }
