"""The home base on the floor: where it stands, how far its infrared beams reach, and when the contacts touch."""

from __future__ import annotations

import math
from typing import Protocol

from ..records import Pose

BEAM_RANGE = 2.0  # m
BEAM_HALF_ANGLE = math.radians(35)
FIELD_RANGE = 0.5  # m, of the force field around it
RED, GREEN, FIELD, BASE = 8, 4, 1, 160  # bits of the infrared character of a 600's dock, Open Interface packet 17
CONTACT = (0.02, 0.05, math.radians(15))  # m along, m aside and heading within which the contacts touch
SPRING = 2.5  # times as far the contacts hold on to a robot that runs out
LOOK_AHEAD = 0.35  # m


class Placed(Protocol):
    """Something that stands on the floor."""

    @property
    def pose(self) -> Pose:
        """Where it is, in the axes of the dock's pose."""


class Dock:
    """A home base and the robot that looks for it.

    Parameters
    ----------
    pose : Pose
        Where the robot stands, and where it looks, when it is docked.
    robot : Placed
        The robot's body.
    """

    def __init__(self, pose: Pose, robot: Placed) -> None:
        self.pose = pose
        self._robot = robot

    def offset(self) -> tuple[float, float, float]:
        """How far the robot still has to go ahead along the dock's axis, its place to the left of it, its heading."""
        pose, home = self._robot.pose, self.pose
        dx, dy = home.x - pose.x, home.y - pose.y
        c, s = math.cos(home.heading), math.sin(home.heading)
        return c * dx + s * dy, s * dx - c * dy, math.remainder(pose.heading - home.heading, 2 * math.pi)

    def touches(self, *, is_docked: bool) -> bool:
        """Whether the charging contacts meet, or still hold a robot that is docked."""
        give = SPRING if is_docked else 1.0
        return all(abs(value) <= give * most for value, most in zip(self.offset(), CONTACT, strict=True))

    def beams(self) -> int:
        """The infrared character that the robot's omnidirectional receiver gets, 0 for none."""
        ahead, aside, _ = self.offset()
        distance = math.hypot(ahead, aside)
        bits = FIELD if distance < FIELD_RANGE else 0
        bearing = math.atan2(aside, ahead + 0.1)
        if distance < BEAM_RANGE and abs(bearing) < BEAM_HALF_ANGLE:
            overlap = math.radians(5)
            bits |= (RED if bearing > -overlap else 0) | (GREEN if bearing < overlap else 0)
        return BASE + bits if bits else 0

    def approach(self) -> tuple[float, float] | None:
        """Speed (m/s) and turn rate (rad/s) towards the contacts; None where the beams are not seen.

        Pure pursuit of a point ahead on the dock's axis; a robot that arrives askew backs off.
        """
        if not self.beams() & (RED | GREEN):
            return None
        ahead, aside, heading = self.offset()
        wanted = math.atan2(-aside, min(LOOK_AHEAD, max(ahead, 0.05)))
        error = math.remainder(wanted - heading, 2 * math.pi)
        if abs(error) > 0.6:
            return 0.0, math.copysign(0.6, error)
        speed = 0.2 if ahead > 0.5 else 0.1
        return speed, max(-0.8, min(0.8, 2.0 * error))
