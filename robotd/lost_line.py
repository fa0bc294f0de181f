"""What to do when the line is not seen: the ladder from prediction to giving up.

Predict with odometry; search near the prediction with relaxed limits; search the whole view; coast slowly for a bounded
distance; turn on the spot to the side on which the line was last; stop and say so. The first three cost no motion and
happen within a frame; this module decides about the last three.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .records import Floats, LineState, Pose

LOOK_AHEAD = 0.5  # m before the robot, where the line's side is taken
TURN_RATE = 0.5  # rad/s
TURN_MOST = 1.3  # rad to the side of the line; a quarter turn and the view's own half are then covered
FORGIVEN = 1.0  # m of line after which an earlier search does not count any more
BLIND_S = 0.3  # s of pictures that show nothing, after which there is nothing to search


@dataclass(frozen=True, slots=True)
class Move:
    """What to do instead of following: a turn rate on the spot, or nothing more (`reason` says why)."""

    state: LineState
    turn_rate: float
    reason: str | None = None


class LostLine:
    """Decides, tick by tick, while the follower has nothing left to go by."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """A new drive begins."""
        self._turned = 0.0
        self._travelled = -math.inf
        self.forget()

    def forget(self) -> None:
        """The line is there; what was turned in vain before counts until the robot has driven on for a metre."""
        self._side = 0.0
        self._heading = 0.0

    @property
    def is_turning(self) -> bool:
        return self._side != 0.0

    def search(self, path: Floats, pose: Pose, travelled: float) -> Move:
        """Turn towards where the line was, or give up when that is done.

        Parameters
        ----------
        path : (N, 2) array
            The line as remembered.
        pose : Pose
            Of the robot in the same axes.
        travelled : float
            Metres driven.
        """
        if not self._side:
            self._side = last_side(path, pose)
            self._heading = pose.heading
            if travelled - self._travelled > FORGIVEN:
                self._turned = 0.0
            self._travelled = travelled
        self._turned += abs(math.remainder(pose.heading - self._heading, 2.0 * math.pi))
        self._heading = pose.heading
        if self._turned >= TURN_MOST:
            side = "left" if self._side > 0.0 else "right"
            return Move("lost", 0.0, f"not found by turning to the {side} either")
        return Move("turning", self._side * TURN_RATE)


def last_side(path: Floats, pose: Pose) -> float:
    """+1 if a remembered line (N, 2) was last seen to go to the left of the robot, -1 if to the right."""
    away = path - np.array([pose.x, pose.y])
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    forward, left = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
    ahead = np.flatnonzero(forward <= LOOK_AHEAD)
    k = int(ahead[-1]) if len(ahead) else len(path) - 1
    return 1.0 if left[k] >= 0.0 else -1.0
