"""Observing at a stop: have labels flash, watch the cameras, and name the lights (`identify`).

What is learnt of the label system and of the labels' places stays for the stops that follow.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Any

from .bus import Bus, Subscription
from .clock import in_executor, in_thread, now
from .config import Calibration, MissionConfig
from .errors import DriverFault, MissionError
from .hardware import CameraMode
from .identify import DelayModel, FlashRequest, Identifier, LabelMemory, Slot
from .journal import Journal
from .plan_records import Plan
from .plugin import Camera, Labels
from .records import Event, Frame, Pose, Sighting

FIRST_FRAME_S = 5.0  # a camera that shows nothing for so long after its start is at fault


@dataclass(frozen=True, slots=True)
class Site:
    """Where the robot stands: stop `stop` of leg `leg`, in odometry axes, and metres along the line."""

    leg: int
    stop: int
    pose: Pose | None
    along: float


class Observer:
    """Has labels flash where the robot stands, and names the lights that the cameras see.

    Parameters
    ----------
    config, calibration
        What to look for, and with what.
    cameras : mapping of str to Camera
        The rig's, by name.
    tell : callable
        Gets what it does, in words.
    advice : Plan, optional
        Names labels that are not worth asking at a stop.

    Attributes
    ----------
    memory : LabelMemory
        What earlier stops taught about where labels are.
    undecided : int
        Lights of the present stop that got no name.
    refused : dict of str to str
        Labels that the label system does not take, with its reason.
    """

    def __init__(
        self,
        config: MissionConfig,
        calibration: Calibration,
        *,
        bus: Bus,
        cameras: Mapping[str, Camera],
        labels: Labels,
        journal: Journal,
        tell: Callable[[str], None],
        advice: Plan | None = None,
    ) -> None:
        self.config = config
        self.bus = bus
        self.cameras = dict(cameras)
        self.labels = labels
        self.journal = journal
        self.tell = tell
        self.advice = advice
        self.undecided = 0
        self.refused: dict[str, str] = {}
        zones = [(zone.labels, zone.begin, zone.end) for zone in config.zones]
        self.memory = LabelMemory(config.labels, calibration.cameras, config.identify, zones)
        self._delays = DelayModel(config.identify)
        self._groups = config.camera_groups or (tuple(cameras),)
        self._workers: ThreadPoolExecutor | None = None

    def __enter__(self) -> Observer:
        """Have a thread for every camera until the end of the block."""
        self._workers = ThreadPoolExecutor(max(1, len(self.cameras)), thread_name_prefix="blink")
        return self

    def __exit__(self, *_: object) -> None:
        if self._workers is not None:
            self._workers.shutdown()

    def state(self) -> bytes:
        """What it has learnt, JSON; see `restore`."""
        learnt = {"memory": self.memory.state(), "delays": self._delays.state(), "refused": self.refused}
        return json.dumps(learnt, separators=(",", ":")).encode()

    def restore(self, state: bytes, *, same_clock: bool) -> None:
        """Take over what an interrupted mission had learnt; `same_clock`: since the computer's same start."""
        learnt = json.loads(state)
        self.memory.restore(learnt["memory"])
        self._delays.restore(learnt["delays"], same_clock=same_clock)
        self.refused = {label: why for label, why in learnt["refused"].items() if label in self.memory.index}

    async def observe(self, site: Site, seen: list[tuple[Sighting, ...]]) -> None:
        """Add what each group of cameras sees, one group after the other; those that have looked are left out.

        Raises
        ------
        DriverFault
            A camera shows nothing, or the label system cannot be reached.
        MissionError
            The label system refuses every label.
        """
        for group in self._groups[len(seen) :]:
            seen.append(await self._look(group, site))

    async def _look(self, group: Sequence[str], site: Site) -> tuple[Sighting, ...]:
        """What these cameras see in slots of their own."""
        mode = CameraMode(exposure=self.config.identify.exposure_s, mains_hz=self.config.mains_hz)
        if self.advice is not None:
            self.memory.learnt = set(self.advice.skipped(site.along) & self.memory.index.keys())
        identifier = await in_thread(
            Identifier,
            self.config.labels,
            tuple(group),
            self.config.identify,
            delays=self._delays,
            memory=self.memory,
            pose=site.pose,
            travelled=site.along,
        )
        async with AsyncExitStack() as stack:
            for name in group:
                frames = stack.enter_context(self.bus.frames(name).subscribe(size=8))
                await self.cameras[name].start(mode)
                stack.push_async_callback(self.cameras[name].stop)
                try:
                    async with asyncio.timeout(FIRST_FRAME_S):
                        await frames.get()
                except TimeoutError:
                    raise DriverFault(f"{name}: no frame for {FIRST_FRAME_S:g} s; check the camera") from None
                watch = asyncio.create_task(self._watch(identifier, name, frames))
                stack.push_async_callback(_cancel, watch)
            while (slot := await in_thread(identifier.next_slot, now())) is not None:
                await self._slot(identifier, slot, site)
        sightings = await in_thread(identifier.finish, now())
        for label in identifier.mistaken:
            text = f"{label} was named by its place, but flashed like another label; its place is learnt anew"
            self.bus.events.publish(Event(now(), "mission", "warning", text))
        self.undecided += identifier.undecided
        return sightings

    async def _watch(self, identifier: Identifier, camera: str, frames: Subscription[Frame]) -> None:
        async for frame in frames:
            await in_executor(self._workers, identifier.update, camera, frame)

    async def _slot(self, identifier: Identifier, slot: Slot, site: Site) -> None:
        started = now()
        identifier.begin(slot, started)
        self.tell(f"slot {slot.number + 1}")
        late = 0.0  # what handing the requests over took: with a person in between, that is what the slot waits for
        for request in slot.requests:
            await asyncio.sleep(started + request.after + late - now())
            before = now()
            await self.ask(request)
            late += now() - before
        while now() < started + late + slot.timeout and not identifier.is_complete(now() - late):
            await asyncio.sleep(0.1)
        survey = self.config.survey
        await in_thread(self.journal.add_slot, survey, site.leg, site.stop, slot.number, started, now())

    async def ask(self, request: FlashRequest) -> None:
        """Pass a request on; labels that are refused are reported once and not asked again.

        Raises MissionError when every label is refused.
        """
        refused = await self.labels.flash(request.labels, self.config.identify.strength, request.durations)
        for label, reason in refused.items():
            if label not in self.refused:
                text = f"{self.labels.name}: {label} is refused and left out: {reason}"
                self.bus.events.publish(Event(now(), "mission", "warning", text))
            self.refused[label] = reason
            self.memory.refused.add(label)
        if refused and len(self.refused) == len(self.config.labels):
            self.refused.clear()  # whoever mends that wants them asked again
            self.memory.refused.clear()
            raise MissionError(f"{self.labels.name}: every label is refused, the last one: {reason}")


async def _cancel(task: asyncio.Task[Any]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    if not task.cancelled() and (error := task.exception()) is not None:
        raise error
