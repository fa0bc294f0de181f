"""Collecting what calibrations need, with a person beside the robot who is prompted over the control socket.

Odometry is computed and written here, and what the rig needs is a survey. All else goes into a folder of its own in
<state>/calibration, with a file `data.json` (robotd-calibration-data/1, see ARCHITECTURE.md) that says what is in it;
`robotd-solver` computes from it.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import msgspec

from .. import rpc
from ..bind import ranged
from ..clock import in_thread, now
from ..config import save_wheels
from ..control_socket import Client
from ..errors import DriverFault, InputError, MissionError
from ..flash_recording import learn_recorded
from ..hardware import CameraMode
from ..plugin import Camera, Labels
from ..records import Frame, OdometryState, Withdrawal
from ..rpc import RpcError
from ..wheel_calibration import calibrate, summary
from ..wheel_runs import SOURCE, RunPlan, check_writable, collect
from .rig_survey import collect_rig
from .spot_moves import turn
from .table import Operations, method

FORMAT = "robotd-calibration-data/1"
FRAME_S = 5.0
ATTEMPTS = 5  # at a picture that shows no board
SWING = math.radians(40.0)  # to either side, for the time offset


@dataclass(frozen=True, slots=True)
class Calibration:
    """`what` to collect; the other parameters belong to some of them."""

    what: Literal["odometry", "camera", "floor", "rig", "flash", "time"]
    camera: str | None = None
    label: str | None = None
    places: int = ranged(5, minimum=1, maximum=50)
    headings: int | None = ranged(None, minimum=2, maximum=12)
    pictures: int = ranged(12, minimum=1, maximum=200)
    columns: int = ranged(9, minimum=3, maximum=50)
    rows: int = ranged(6, minimum=3, maximum=50)
    square: float = ranged(0.025, minimum=0.001, maximum=1.0)
    seconds: float = ranged(20.0, minimum=1.0, maximum=300.0)
    distance: float | None = ranged(None, minimum=0.5, maximum=20.0)
    turns: int | None = ranged(None, minimum=1, maximum=20)
    repeat: int | None = ranged(None, minimum=1, maximum=10)


@dataclass(frozen=True, slots=True)
class Answer:
    """What the person said: a number, or nothing but that it is done."""

    value: float | None = None


class _Person:
    """The person at the other end of a connection; see robotd.wheel_runs.Person."""

    def __init__(self, client: Client) -> None:
        self._client = client

    async def tell(self, text: str) -> None:
        await self._client.tell("prompt", {"kind": "tell", "text": text})

    async def ready(self, text: str) -> None:
        await self._ask("ready", text)

    async def measure(self, text: str) -> float:
        while True:
            value = await self._ask("measure", text)
            if isinstance(value, float) and math.isfinite(value):
                return value

    async def _ask(self, kind: str, text: str) -> Any:
        while not self._client.answers.empty():  # said before it was asked
            self._client.answers.get_nowait()
        await self._client.tell("prompt", {"kind": kind, "text": text})
        return await self._client.answers.get()


@method("answer", Answer)
def answer(operations: Operations, client: Client, given: Answer) -> Any:
    """The person has answered a prompt."""
    if client.answers.full():
        raise RpcError(rpc.REFUSED, "nothing was asked")
    client.answers.put_nowait(given.value)
    return {}


@method("calibrate", Calibration)
async def calibration(operations: Operations, client: Client, wanted: Calibration) -> Any:
    """Collect the data of one calibration; `prompt` notifications say what to do, `answer` says that it is done."""
    work: dict[str, Callable[[Operations, _Person, Calibration], Awaitable[Any]]] = {
        "odometry": _odometry,
        "camera": _camera,
        "floor": _floor,
        "rig": _rig,
        "flash": _flash,
        "time": _time,
    }
    with operations.alone(f"calibration of {wanted.what}"):
        try:
            return await work[wanted.what](operations, _Person(client), wanted)
        except (DriverFault, MissionError) as error:
            raise RpcError(rpc.FAILED, str(error)) from error
        finally:
            operations.bus.withdrawals.publish(Withdrawal(now(), SOURCE, "the calibration has ended"))


async def _odometry(operations: Operations, person: _Person, wanted: Calibration) -> Any:
    robot = operations.robot
    target = robot.assembly.path.parent / robot.assembly.config.robot.calibration
    check_writable(target)
    before = robot.assembly.calibration.wheels
    given = {name: getattr(wanted, name) for name in ("distance", "turns", "repeat")}
    plan = RunPlan(**{name: value for name, value in given.items() if value is not None})
    runs = await collect(robot.control, before, plan, person)
    result = calibrate(runs, before)
    await person.tell(summary(result, before, runs))
    await in_thread(save_wheels, result.wheels, target)
    return {"text": f"written to {target}; restart robotd to use it", "file": str(target)}


# ---- pictures --------------------------------------------------------------------------------------------------------


class _Album:
    """A folder of pictures and other files, with what is known about each."""

    def __init__(self, operations: Operations, wanted: Calibration, **about: Any) -> None:
        robot, utc = operations.robot, operations.robot.assembly.hardware.utc().astimezone(UTC)
        self.folder = robot.state / "calibration" / f"{wanted.what}-{utc:%Y%m%dT%H%M%SZ}"
        self.data: dict[str, Any] = {
            "format": FORMAT,
            "what": wanted.what,
            "robot": robot.assembly.config.robot.name,
            "created": utc.isoformat(timespec="seconds").replace("+00:00", "Z"),
            **about,
        }
        if wanted.what in ("camera", "floor"):
            self.data["board"] = {"columns": wanted.columns, "rows": wanted.rows, "square_m": wanted.square}
            self.data["pictures"] = []
        self._size = wanted.columns, wanted.rows

    async def add(self, frame: Frame, pose: OdometryState | None) -> bool:
        """Keep a picture; returns whether it shows the whole board."""
        name = f"{frame.camera}-{len(self.data['pictures']) + 1:03d}.png"
        found = await in_thread(self._save, name, frame)
        entry = {"file": name, "camera": frame.camera, "t": frame.t, "board_found": found, "odometry": None}
        if pose is not None:
            entry["odometry"] = {"x": pose.pose.x, "y": pose.pose.y, "heading": pose.pose.heading}
        self.data["pictures"].append(entry)
        return found

    async def finish(self, text: str) -> dict[str, Any]:
        """Write data.json; what was collected is whole then."""
        await in_thread(self._write)
        return {"text": text.format(folder=self.folder), "folder": str(self.folder), "data": self.data}

    def _save(self, name: str, frame: Frame) -> bool:
        self._make()
        if not cv2.imwrite(str(self.folder / name), frame.image):
            raise MissionError(f"{self.folder / name} cannot be written; make room on the disk")
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        return bool(cv2.findChessboardCorners(frame.image, self._size, flags=flags)[0])

    def _write(self) -> None:
        self._make()
        part = self.folder / "data.json.part"
        part.write_bytes(msgspec.json.format(msgspec.json.encode(self.data), indent=1))
        part.replace(self.folder / "data.json")

    def _make(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MissionError(f"{self.folder} cannot be made: {error.strerror}") from error


def _driver(operations: Operations, name: str | None) -> Camera:
    cameras = {item.driver.name: item.driver for item in operations.robot.supervisors if item.driver.kind == "camera"}
    if name not in cameras:
        raise InputError(f"there is no camera '{name}'; there is {', '.join(cameras)}")
    return cast(Camera, cameras[name])


def _mode(operations: Operations, camera: Camera) -> CameraMode:
    return operations.robot.recordings.mode(camera.name)


async def _photograph(operations: Operations, camera: Camera) -> Frame:
    """A frame that was exposed after now."""
    t = now()
    with operations.bus.frames(camera.name).subscribe(size=2) as frames:
        try:
            async with asyncio.timeout(FRAME_S):
                while (frame := await frames.get()).t < t:
                    pass
        except TimeoutError:
            raise DriverFault(f"{camera.name}: no frame for {FRAME_S:g} s; check the camera") from None
        return frame


async def _boards(operations: Operations, person: _Person, album: _Album, camera: Camera, count: int, how: str) -> int:
    """Pictures of a chessboard in the person's hands, as many as are wanted; how many show it."""
    good = 0
    await camera.start(_mode(operations, camera))
    try:
        for number in range(1, count + 1):
            for _ in range(ATTEMPTS):
                await person.ready(f"Picture {number} of {count}: {how}")
                if await album.add(await _photograph(operations, camera), operations.bus.odometry.latest):
                    good += 1
                    break
                await person.tell("The whole board was not found in it: hold it still, in good light, wholly in view.")
    finally:
        await camera.stop()
    return good


async def _camera(operations: Operations, person: _Person, wanted: Calibration) -> Any:
    camera = _driver(operations, wanted.camera)
    album = _Album(operations, wanted, camera=camera.name)
    how = "hold the chessboard anew: near and far, tilted, and into each corner of the view."
    good = await _boards(operations, person, album, camera, wanted.pictures, how)
    return await album.finish(_boards_text(good, f"camera {{folder}}/*.png --camera {camera.name}", operations, wanted))


async def _floor(operations: Operations, person: _Person, wanted: Calibration) -> Any:
    robot = operations.robot
    camera = cast(Camera, robot.assembly.eye)
    album = _Album(operations, wanted, camera=camera.name)
    how = "lay the chessboard flat on the floor, wholly in view, anew each time; measure where the first one lies."
    good = await _boards(operations, person, album, camera, wanted.pictures, how)
    return await album.finish(_boards_text(good, "floor {folder}/*.png --at X,Y,DEG", operations, wanted))


def _boards_text(good: int, command: str, operations: Operations, wanted: Calibration) -> str:
    """What came of it, and what to do with it; raises MissionError if the board was in no picture."""
    size = f"{wanted.columns}x{wanted.rows}"
    if not good:
        raise MissionError(
            f"no picture shows a whole board of {size} inner corners; count them (--board), hold it still in good light"
        )
    file = operations.robot.assembly.config.robot.calibration
    return (
        f"{good} pictures of the board in {{folder}}\n"
        f"now: robotd-solver calibrate {command} --board {size} --square {wanted.square:g} --calibration {file}"
    )


async def _rig(operations: Operations, person: _Person, wanted: Calibration) -> Any:
    return await collect_rig(operations, person, wanted.places, wanted.headings)


# ---- recordings ------------------------------------------------------------------------------------------------------


async def _flash(operations: Operations, person: _Person, wanted: Calibration) -> Any:
    """One label that flashes, as one camera sees it."""
    robot = operations.robot
    camera = _driver(operations, wanted.camera)
    if wanted.label is None:
        raise InputError("label: missing; expected the id of a label in view of that camera")
    album = _Album(operations, wanted, camera=camera.name, label=wanted.label, asked_s=round(wanted.seconds))
    await person.ready(f"Put the robot so that camera {camera.name} sees label {wanted.label} from 0.5 to 2 m.")
    identify = robot.assembly.config.mission.identify
    longest = identify.delay_normal_s + identify.poll_s + identify.delay_tail_s
    status = await robot.recordings.start((camera.name,), name=album.folder.name)
    try:
        await asyncio.sleep(2.0)  # without any flash, to tell it from what else blinks
        album.data["asked_t"] = now()
        labels = cast(Labels, robot.assembly.labels)
        refused = await labels.flash((wanted.label,), identify.strength, (round(wanted.seconds),))
        if refused:
            raise MissionError(f"{labels.name}: {wanted.label} is refused: {refused[wanted.label]}")
        await person.tell(f"asked; recording {longest + wanted.seconds:.0f} s")
        await asyncio.sleep(longest + wanted.seconds)
    finally:
        status = await robot.recordings.stop()
    album.data["recording"] = status
    mode, gamma = _mode(operations, camera), robot.assembly.calibration.gamma
    asked = album.data["asked_t"]
    try:
        place = Path(status["file"]), camera.name
        learnt, _, _ = await in_thread(learn_recorded, *place, asked, wanted.seconds, mode.exposure, gamma)
    except InputError as error:
        return await album.finish(f"recorded {status['file']}, but no pattern was found in it: {error}")
    pattern = learnt.pattern
    album.data["pattern"] = {
        "period": pattern.period,
        "on": [list(interval) for interval in pattern.on],
        "confidence": learnt.confidence,
        "edge_sigma": learnt.edge_sigma,
    }
    line = learnt.toml().replace("{", "{{").replace("}", "}}")
    sure = f"{100.0 * learnt.confidence:.1f} % sure, edges +- {1e3 * learnt.edge_sigma:.1f} ms"
    text = (
        f"recorded {status['file']}, described in {{folder}}/data.json\nlearnt, {sure}: [mission.identify] {line}\n"
        "to look at: robotd-solver calibrate flash {folder} --picture flash.png"
    )
    return await album.finish(text)


async def _time(operations: Operations, person: _Person, wanted: Calibration) -> Any:
    """The robot swings to and fro while all cameras are recorded: but for the offset, views turn when the wheels do."""
    robot = operations.robot
    album = _Album(operations, wanted)
    await person.ready("The robot turns to and fro on the spot; stay clear of it. Its cameras need something to see.")
    names = tuple(robot.assembly.cameras) or (robot.assembly.eye.name,)
    status = await robot.recordings.start(names, name=album.folder.name)
    rows: list[OdometryState] = []

    async def follow() -> None:
        with operations.bus.odometry.subscribe(size=256) as states:
            async for state in states:
                rows.append(state)

    following = asyncio.create_task(follow())
    try:
        end = now() + wanted.seconds
        await turn(operations, 0.5 * SWING)
        side = -1.0
        while now() < end:
            await turn(operations, side * SWING)
            side = -side
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
        status = await robot.recordings.stop()
    album.data["recording"] = status
    album.data["odometry"] = {
        "columns": ["t", "heading", "turn_rate"],
        "rows": [(state.t, state.pose.heading, state.turn_rate) for state in rows],
    }
    command = f"robotd-solver calibrate time {{folder}} --calibration {robot.assembly.config.robot.calibration}"
    return await album.finish(f"recorded {status['file']}; odometry in {{folder}}/data.json\nnow: {command}")
