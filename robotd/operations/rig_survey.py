"""A survey from which `robotd-solver calibrate rig` finds cameras that share no view: turns on the spot at some places.

It is an ordinary survey: in the journal stop by stop, uploaded, and exported like any other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC
from typing import Any, cast

from ..clock import in_thread
from ..config import MissionConfig
from ..errors import InputError
from ..observation import Observer, Site
from ..plugin import Camera, Labels
from ..records import Pose, Sighting, Stop, Survey
from ..wheel_runs import Person
from .spot_moves import stand, straight, turn
from .table import Operations

STEP_M = 0.25  # shows best which way is ahead: on less, sightings do not tell it; on more, wheels drift
FARTHEST_M = 3.0  # that it drives between two places


class RigSurvey:
    """One such survey.

    Parameters
    ----------
    operations : Operations
    person : Person
    config : MissionConfig
        Of that survey.
    places : int
    headings : int or None
        None drives out and back at each place, with stops at both ends both ways, at every second place across: each
        point of the floor is stood on in opposite headings, so that its slope cancels, and two straight pieces show
        which way is ahead. A number instead has a full circle of so many stops on the spot, behind one straight piece.
    """

    def __init__(
        self, operations: Operations, person: Person, config: MissionConfig, places: int, headings: int | None
    ) -> None:
        robot, self.operations, self.person = operations.robot, operations, person
        self.config, self.places, self.headings = config, places, headings
        self.header = Survey(
            survey=self.config.survey,
            rig=robot.assembly.calibration.rig,
            stops=(),
            created=self._utc(),
            sigmas=robot.assembly.calibration.sigmas,
            priors=robot.assembly.calibration.survey_priors,
            known_labels=self.config.known_labels,
        )
        self.observer = Observer(
            *(self.config, robot.assembly.calibration),
            bus=robot.assembly.bus,
            cameras={name: cast(Camera, camera) for name, camera in robot.assembly.cameras.items()},
            labels=cast(Labels, robot.assembly.labels),
            journal=robot.journal,
            tell=lambda text: None,
        )
        self.leg, self.made, self._in_leg = 1, 0, 0
        self.seen: dict[str, set[str]] = {camera.name: set() for camera in self.header.rig.cameras}

    async def run(self) -> dict[str, Any]:
        """Make all stops; returns what to say."""
        with self.observer:
            for place in range(1, self.places + 1):
                await self._go(place)
                if self.headings is None:
                    await self._out_and_back(across=place % 2 == 0)
                else:
                    await self._circle(self.headings)
        name, target = self.config.survey, self.operations.robot.assembly.config.robot.calibration
        text = (
            f"{self.made} stops in survey '{name}'; {self._shares()}\n"
            f"now: robotctl survey export {name} -o {name}.json\n"
            f"then: robotd-solver calibrate rig {name}.json --calibration {target}"
        )
        labels = {camera: sorted(labels) for camera, labels in self.seen.items()}
        return {"text": text, "survey": name, "stops": self.made, "labels": labels}

    async def _out_and_back(self, across: bool) -> None:
        """Ends where and as it began."""
        if across:
            await turn(self.operations, 0.5 * math.pi)
        await self._stop()
        await straight(self.operations, STEP_M)
        await self._stop()
        await turn(self.operations, math.pi)
        await self._stop()
        await straight(self.operations, STEP_M)
        await self._stop()
        await turn(self.operations, 0.5 * math.pi if across else math.pi)

    async def _circle(self, headings: int) -> None:
        await self._stop()
        await straight(self.operations, STEP_M)
        for _ in range(headings):
            await self._stop()
            await turn(self.operations, 2.0 * math.pi / headings)

    async def _go(self, place: int) -> None:
        """To the next place: driven straight ahead, or carried, which begins a new leg."""
        where = "free floor, 0.5 m to all sides, labels 1 to 3 m away"
        if place == 1:
            does = "there and back" if self.headings is None else f"and turns on the spot in {self.headings} steps"
            await self.person.ready(
                f"Place 1 of {self.places}: put the robot on {where}. At each place it drives {100 * STEP_M:.0f} cm "
                f"{does}; stay clear of it."
            )
            self.leg = await in_thread(self.operations.robot.journal.begin_leg, self.header)
            return
        while True:
            metres = await self.person.measure(
                f"Place {place} of {self.places}: how many metres straight ahead may the robot drive to get there? "
                f"(0: you carry it to {where}, among labels that it has seen)"
            )
            if 0.0 <= metres <= FARTHEST_M:
                break
            await self.person.tell(f"found {metres:g}; expected 0 to {FARTHEST_M:g}")
        if metres > 0.0:
            await straight(self.operations, metres)
        else:
            await self.person.ready("Put it down there.")
            await self._new_leg()

    async def _new_leg(self) -> None:
        if self._in_leg:
            self.leg = await in_thread(self.operations.robot.journal.begin_leg, self.header)
            self._in_leg = 0
        self.observer.memory.forget_places()
        self.operations.robot.odometry.mark()

    async def _stop(self) -> None:
        """Observe where the robot stands and put it on the disk."""
        robot = self.operations.robot
        await stand(self.operations, self.config.settle_s)
        if robot.odometry.broken_since_mark:
            await self._new_leg()
        state = self.operations.bus.odometry.latest
        pose = Pose(0.0, 0.0, 0.0) if state is None else state.pose
        groups: list[tuple[Sighting, ...]] = []
        await self.observer.observe(Site(self.leg, self.made + 1, pose, 0.0), groups)
        sightings = tuple(sighting for group in groups for sighting in group)
        move = robot.odometry.move_since_mark() if self._in_leg else None
        robot.odometry.mark()
        self.made, self._in_leg = self.made + 1, self._in_leg + 1
        stop = Stop(self.leg, self.made, self._utc(), pose, move, sightings)
        await in_thread(robot.journal.add_stop, self.config.survey, stop)
        if robot.uploader is not None:
            robot.uploader.wake()
        for sighting in sightings:
            self.seen.setdefault(sighting.camera, set()).add(sighting.label)
        labels = len({sighting.label for sighting in sightings})
        await self.person.tell(
            f"stop {self.made} of {self.places * (4 if self.headings is None else 1 + self.headings)}: {labels} labels"
        )

    def _shares(self) -> str:
        """What cameras have in common so far, in words."""
        each = ", ".join(f"{camera} {len(labels)}" for camera, labels in self.seen.items())
        return f"labels seen by {each}; by two cameras or more {len(_shared(list(self.seen.values())))}"

    def _utc(self) -> str:
        utc = self.operations.robot.assembly.hardware.utc().astimezone(UTC)
        return utc.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _shared(sets: Sequence[set[str]]) -> set[str]:
    every = [label for labels in sets for label in labels]
    return {label for label in every if every.count(label) > 1}


async def collect_rig(operations: Operations, person: Person, places: int, headings: int | None) -> dict[str, Any]:
    """Make such a survey; raises InputError or MissionError if the robot has no rig or no labels to look for."""
    robot = operations.robot
    if not robot.assembly.cameras:
        raise InputError("the calibration names no cameras of the rig; calibrate each camera's lens first")
    utc = robot.assembly.hardware.utc().astimezone(UTC)
    config = await robot.missions.config(f"rig-{utc:%Y%m%dT%H%M%SZ}", everywhere=True)
    if not config.labels:
        raise InputError("[mission] labels: there are none to look for")
    return await RigSurvey(operations, person, config, places, headings).run()
