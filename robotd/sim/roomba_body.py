"""What carries a simulated Roomba through the world, and what people do to it: touch, lift, carry, push."""

from __future__ import annotations

import math
from typing import Protocol

from ..records import Pose
from .body import Body


class RoombaBody(Protocol):
    """What carries the robot through the world: motion of the wheels in, contacts out."""

    @property
    def left_rotation(self) -> float:
        """Metres that the left wheel has rolled since the start, forward positive."""

    @property
    def right_rotation(self) -> float:
        """Metres that the right wheel has rolled."""

    @property
    def bump_left(self) -> bool:
        """The bumper is pressed on the left."""

    @property
    def bump_right(self) -> bool:
        """The bumper is pressed on the right."""

    @property
    def cliff(self) -> bool:
        """A front cliff sensor sees no floor."""

    @property
    def wheel_drop_left(self) -> bool:
        """The left wheel hangs."""

    @property
    def wheel_drop_right(self) -> bool:
        """The right wheel hangs."""

    def advance(self, t: float, left_speed: float, right_speed: float) -> None:
        """Roll the wheels at these mean speeds (m/s) from the last instant until `t`."""


class HandledBody:
    """A body whose contacts somebody also works by hand; see robotd.sim.roomba.RoombaBody.

    Parameters
    ----------
    body : Body
        What really moves.
    origin : (float, float)
        Where `pose` counts from, in store axes.

    Attributes
    ----------
    held_left, held_right : bool
        Somebody presses the bumper on that side.
    """

    def __init__(self, body: Body, origin: tuple[float, float] = (0.0, 0.0)) -> None:
        self.body = body
        self._origin = origin
        self.held_left = self.held_right = False
        self._t = 0.0
        self._pushed = (0.0, 0.0, 0.0)  # speeds of the left and right wheel in m/s, until when

    @property
    def left_rotation(self) -> float:
        return self.body.left_rotation

    @property
    def right_rotation(self) -> float:
        return self.body.right_rotation

    @property
    def bump_left(self) -> bool:
        return self.held_left or self.body.bump_left

    @property
    def bump_right(self) -> bool:
        return self.held_right or self.body.bump_right

    @property
    def cliff(self) -> bool:
        return self.body.cliff

    @property
    def wheel_drop_left(self) -> bool:
        return self.body.wheel_drop_left

    @property
    def wheel_drop_right(self) -> bool:
        return self.body.wheel_drop_right

    @property
    def pose(self) -> Pose:
        """Where the body is, from the origin."""
        pose = self.body.pose
        return Pose(pose.x - self._origin[0], pose.y - self._origin[1], pose.heading)

    def advance(self, t: float, left_speed: float, right_speed: float) -> None:
        """Roll the wheels at these speeds and at those with which somebody pushes."""
        left, right, until = self._pushed
        if self._t < until:
            left_speed, right_speed = left_speed + left, right_speed + right
        self._t = t
        self.body.advance(t, left_speed, right_speed)

    def push(self, forward: float, turn: float, seconds: float) -> None:
        """Push the robot over the floor by `forward` metres and `turn` radians, which turns its wheels."""
        half = 0.5 * turn * self.body.settings.wheel_base
        self._pushed = (forward - half) / seconds, (forward + half) / seconds, self._t + seconds

    def carry(self, dx: float, dy: float, turn: float) -> None:
        """Lift it and set it down `dx` ahead, `dy` to its left and turned: no wheel notices."""
        pose = self.body.pose
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        heading = math.remainder(pose.heading + turn, 2 * math.pi)
        self.body.place(Pose(pose.x + c * dx - s * dy, pose.y + s * dx + c * dy, heading))
