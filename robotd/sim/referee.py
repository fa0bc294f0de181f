"""The referee: after the daemon has exited, compare the map with the world's truth. Nothing else reads truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..files import save_truth
from ..records import Floats, Map, Vector3
from ..solver.evaluate import Evaluation, evaluate
from .world import World


class Referee:
    """Scores one finished run.

    Parameters
    ----------
    world : World
        After the run: its body remembers where the robot really went.
    """

    def __init__(self, world: World) -> None:
        self._world = world

    def truth(self) -> dict[str, Vector3]:
        """True label positions in the world frame: the robot's true x, y, heading at stop 1, z from the floor."""
        labels = self._world.layout.labels
        positions = self._world.to_world(np.array([label.position for label in labels]).reshape(-1, 3))
        return {label.id: (float(x), float(y), float(z)) for label, (x, y, z) in zip(labels, positions, strict=True)}

    def write_truth(self, path: Path) -> dict[str, Vector3]:
        """Write truth.csv; returns what it holds."""
        truth = self.truth()
        save_truth(path, truth)
        return truth

    def score(self, solved: Map) -> Evaluation:
        """Label errors without any alignment."""
        return evaluate(solved, self.truth(), align="none")

    def cross_track_mm(self) -> dict[str, float]:
        """Distance of the robot's origin from the tape's centre, over equal steps of the way driven: rms and max.

        Beyond an open line's ends it is the distance from the tape's straight prolongation: stopping a little late
        there is an error along the track.
        """
        line = self._world.line
        points = _even(self._world.body.trail()[:, :2], 0.01)
        distance, foot = line.nearest(points)
        if not line.closed:
            beyond = (foot <= 0.0) | (foot >= line.length)
            away = points[beyond] - line.point_at(foot[beyond])
            heading = line.heading_at(foot[beyond])
            distance[beyond] = away[:, 1] * np.cos(heading) - away[:, 0] * np.sin(heading)
        distance = np.abs(distance)
        rms = float(np.sqrt(np.mean(distance**2))) if len(distance) else 0.0
        return {"rms": round(1e3 * rms, 2), "max": round(1e3 * float(distance.max(initial=0.0)), 2)}

    def outline(self) -> list[Floats]:
        """Walls and shelves as (N, 2) polylines in world metres."""
        layout = self._world.layout
        corners = [[wall.start, wall.end] for wall in layout.walls]
        for x0, y0, x1, y1 in (shelf.box for shelf in layout.shelves):
            corners.append([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)])
        return [self._flat(np.array(points)) for points in corners]

    def outline3d(self) -> list[tuple[Floats, float]]:
        """The same with heights in metres."""
        layout = self._world.layout
        heights = [wall.height for wall in layout.walls] + [shelf.height for shelf in layout.shelves]
        return list(zip(self.outline(), heights, strict=True))

    def _flat(self, points: Floats) -> Floats:
        return self._world.to_world(np.column_stack([points, np.zeros(len(points))]))[:, :2]


def _even(points: Floats, step: float) -> Floats:
    """Resample a path at equal steps of arc length, so that standing still does not count."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    if length[-1] < step:
        return points[:1]
    at = np.arange(0.0, length[-1], step)
    return np.column_stack([np.interp(at, length, points[:, k]) for k in (0, 1)])
