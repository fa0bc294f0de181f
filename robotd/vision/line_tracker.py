"""Remember the line as a polyline in odometry axes, so that the blind zone before the wheels is bridged.

Each frame's line is put where the robot was at the frame's stamp and compared with what is remembered. A small filter
estimates how the memory is displaced against odometry (wheels slip) and by how much the stamps are off (cameras are
late); then the frame's points are averaged into the memory. Displacement along a straight line cannot be seen: the
point-to-line residuals leave it to the prior, which is odometry (thesis section 5.2.4 by point-to-line registration).
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line, Pose
from .polyline import arc_length, directions, end_direction, resample
from .top_view import TopView


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Metres, seconds, radians."""

    spacing: float = 0.02  # of the remembered points
    behind: float = 0.4  # of line kept behind the robot
    match: float = 0.06  # farthest that a point of our line may be off the memory
    acquire: float = 0.25  # farthest that a new line may pass the robot
    join: float = 0.20  # longest gap between the memory's end and a piece that continues it
    point_sigma: float = 0.002  # of a seen point across the line
    tilt_sigma: float = 0.006  # of the floor against the camera: 0.3 degrees
    stamp_sigma: float = 0.02  # of the camera's constant stamp error
    turn_noise: float = 0.018  # heading after one metre of odometry
    travel_noise: float = 0.003  # of each wheel after one metre
    independent: float = 8.0  # points of one frame that count as independent
    memory: float = 12.0  # frames after which a remembered point averages no more
    expected: float = 0.10  # metres of remembered line in view without which it is no loss to see none
    latency: float = 0.05  # metres driven until a frame arrives


class PoseHistory:
    """Where odometry said the robot was during the last seconds."""

    def __init__(self, duration: float = 2.0) -> None:
        self._duration = duration
        self._times: deque[float] = deque()
        self._poses: deque[Pose] = deque()

    def add(self, t: float, pose: Pose) -> None:
        """Append a pose; times must not decrease."""
        if self._times and t <= self._times[-1]:
            return
        self._times.append(t)
        self._poses.append(pose)
        while self._times[0] < t - self._duration:
            self._times.popleft()
            self._poses.popleft()

    def at(self, t: float) -> tuple[Pose, float, float] | None:
        """Pose, speed and turn rate at `t`, interpolated; None if that is older than the history or still to come."""
        if len(self._times) < 2:
            return (self._poses[0], 0.0, 0.0) if self._times and abs(t - self._times[0]) < 0.2 else None
        if t < self._times[0] - 0.2 or t > self._times[-1] + 0.1:
            return None
        i = min(max(bisect_right(self._times, t), 1), len(self._times) - 1)
        (t0, a), (t1, b) = (self._times[i - 1], self._poses[i - 1]), (self._times[i], self._poses[i])
        share = min(max((t - t0) / (t1 - t0), 0.0), 2.0)
        turn = math.remainder(b.heading - a.heading, 2.0 * math.pi)
        step_x, step_y = b.x - a.x, b.y - a.y
        speed = math.copysign(math.hypot(step_x, step_y), step_x * math.cos(a.heading) + step_y * math.sin(a.heading))
        heading = math.remainder(a.heading + share * turn, 2.0 * math.pi)
        return Pose(a.x + share * step_x, a.y + share * step_y, heading), speed / (t1 - t0), turn / (t1 - t0)


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """One seen polyline in odometry axes, its velocity there per second of stamp error, and its standard deviations."""

    points: Floats  # (N, 2)
    velocity: Floats  # (N, 2)
    forward_sigma: Floats  # (N,) along the view
    view: Floats  # (N, 2) unit vectors from the camera to the points

    def reversed(self) -> _Sight:
        return _Sight(self.points[::-1], self.velocity[::-1], self.forward_sigma[::-1], self.view[::-1])


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    """Which points of a sight lie on the memory, where on it, and how far to its left."""

    sight: _Sight
    on: NDArray[np.bool_]  # (N,)
    along: Floats  # (N,) arc length on the memory; beyond its ends negative or more than its length
    offset: Floats  # (N,)
    normal: Floats  # (N, 2) of the memory
    length: float  # metres of memory that the sight covers


class LineTracker:
    """The line that we follow.

    Parameters
    ----------
    view : TopView
        In whose pixels the lines come.
    row_time : float
        Seconds from one image row's exposure to the next.

    Attributes
    ----------
    path : (N, 2) array
        What is remembered, odometry axes in metres, ordered in the direction of travel; empty before acquisition.
    stamp_error : float
        Seconds to add to the frames' stamps, as far as is known.
    """

    def __init__(self, view: TopView, row_time: float = 0.0, config: TrackerConfig = TrackerConfig()) -> None:
        self.view = view
        self.config = config
        self._row_time = row_time
        self.stamp_error = 0.0
        self._covariance: Floats = np.diag([0.0, 0.0, 0.0, config.stamp_sigma**2])
        self.reset()

    def reset(self) -> None:
        """Forget the line, but not the stamp error, which is the camera's."""
        self.path: Floats = np.empty((0, 2))
        self._weights: Floats = np.empty(0)
        self._lost = 0.0
        self._last: tuple[Pose, float] | None = None  # pose and metres travelled at the last frame
        self._conflicts = 0
        self._covariance = np.diag([1e-6, 1e-6, 1e-6, self._covariance[3, 3]])  # of x, y, heading and stamps

    def lost(self, travelled: float) -> float:
        """Metres driven while the line should have been in view but was not, also if frames stopped coming."""
        if self._last is None:
            return 0.0
        return self._lost + max(0.0, travelled - self._last[1] - self.config.latency)

    def observe(self, lines: Sequence[Line], t: float, history: PoseHistory, travelled: float) -> bool:
        """Take the lines of one frame.

        Parameters
        ----------
        lines : sequence of Line
            What the detector found in the top view, best first.
        t : float
            The frame's stamp.
        history : PoseHistory
            Odometry, at least from `t` on.
        travelled : float
            Metres driven until now.

        Returns
        -------
        bool
            Whether our line was among them.
        """
        at = history.at(t + self.stamp_error)
        if at is None:
            return False
        pose, speed, turn_rate = at
        sights = [sight for line in lines for sight in self._sights(line, pose, speed, turn_rate)]
        driven = 0.0 if self._last is None else max(0.0, travelled - self._last[1])
        self._predict(pose)
        self._last = pose, travelled
        if len(self.path) == 0:
            return self._acquire(sights, pose)
        seen = self._update(sights, pose)
        if seen:
            self._lost = 0.0
        elif self._expected(pose) >= self.config.expected:
            self._lost += driven
        self._forget(pose)
        return seen

    # ---- one frame's points ------------------------------------------------------------------------------------------

    def _sights(self, line: Line, pose: Pose, speed: float, turn_rate: float) -> list[_Sight]:
        """A line in odometry axes, in both directions."""
        points = resample(self.view.to_robot(line.points), self.config.spacing)
        if len(points) < 4:
            return []
        sigma = self.view.range_sigma(points, self.config.tilt_sigma)
        sight = points - np.array(self.view.eye[:2])
        sight /= np.maximum(np.hypot(sight[:, 0], sight[:, 1]), 1e-9)[:, None]
        delay = self.view.image_rows(points) * self._row_time
        heading = pose.heading + turn_rate * delay
        c, s = np.cos(heading), np.sin(heading)
        x = pose.x + speed * delay * c + c * points[:, 0] - s * points[:, 1]
        y = pose.y + speed * delay * s + s * points[:, 0] + c * points[:, 1]
        velocity = np.column_stack([speed * c - turn_rate * (y - pose.y), speed * s + turn_rate * (x - pose.x)])
        view = np.column_stack([c * sight[:, 0] - s * sight[:, 1], s * sight[:, 0] + c * sight[:, 1]])
        one = _Sight(np.column_stack([x, y]), velocity, sigma, view)
        return [one, one.reversed()]

    def _acquire(self, sights: Sequence[_Sight], pose: Pose) -> bool:
        """Start the memory with the line that passes nearest to the robot and runs along with it."""
        best: tuple[float, Floats] | None = None
        ahead = np.array([math.cos(pose.heading), math.sin(pose.heading)])
        left = np.array([-ahead[1], ahead[0]])
        here = np.array([pose.x, pose.y])
        for sight in sights:
            out = -end_direction(sight.points[::-1], 0.1)
            start = sight.points[0] - here
            if out @ ahead < 0.6 or start @ ahead < 0.0:
                continue
            passing = abs(start @ left - (start @ ahead) * (out @ left) / (out @ ahead))
            if passing <= self.config.acquire and (best is None or passing < best[0]):
                best = passing, sight.points
        if best is None:
            return False
        points = best[1]
        self.path = resample(np.vstack([_approach(here, ahead, points), points]), self.config.spacing)
        self._weights = np.zeros(len(self.path))
        self._lost = 0.0
        return True

    # ---- registration ------------------------------------------------------------------------------------------------

    def _predict(self, pose: Pose) -> None:
        """Let the uncertainty of the memory against odometry grow by the way since the last frame."""
        if self._last is None:
            return
        before = self._last[0]
        dx, dy = pose.x - before.x, pose.y - before.y
        transport = np.eye(4)  # because the heading's error turns the memory about where the robot is
        transport[0, 2], transport[1, 2] = -dy, dx
        distance = math.hypot(dx, dy) + 0.1 * abs(math.remainder(pose.heading - before.heading, 2.0 * math.pi))
        travel, turn = self.config.travel_noise**2 * distance, self.config.turn_noise**2 * distance
        self._covariance = transport @ self._covariance @ transport.T + np.diag([travel, travel, turn, 0.0])

    def _update(self, sights: Sequence[_Sight], pose: Pose) -> bool:
        """Register the sights that lie on the memory, best first, and average them into it."""
        matches = [match for sight in sights if (match := self._match(sight)) is not None]
        matches.sort(key=lambda match: -match.length)
        seen = False
        for match in matches:
            if match.length < 3 * self.config.spacing:
                break
            if not seen:
                self._register(match, pose)
            fresh = self._match(match.sight)
            if fresh is not None:
                self._merge(fresh)
                seen = True
        if not seen:
            return any(self._continue(sight) for sight in sights)
        return True

    def _match(self, sight: _Sight) -> _Match | None:
        """Project a sight onto the memory."""
        start, step = self.path[:-1], np.diff(self.path, axis=0)
        size = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        unit = step / size[:, None]
        points, start = sight.points - start[0], start - start[0]
        along = points @ unit.T - (start * unit).sum(axis=1)
        share = np.clip(along, 0.0, size)
        # |p - start - share unit|^2, multiplied out so that only (points, segments) arrays are made
        square = (points**2).sum(axis=1)[:, None] + (start**2).sum(axis=1) - 2.0 * points @ start.T
        square += share * (share - 2.0 * along)
        heading = directions(sight.points)
        turned = heading @ unit.T < 0.7
        square = np.where(turned, square + 1.0, square)  # a hairpin's other leg is not this one
        best = square.argmin(axis=1)
        rows = np.arange(len(best))
        lengths = np.concatenate([[0.0], np.cumsum(size)])
        place = lengths[best] + share[rows, best]
        ends = ((best == 0) & (along[rows, best] < 0.0)) | ((best == len(size) - 1) & (along[rows, best] > size[-1]))
        normal = np.column_stack([-unit[best, 1], unit[best, 0]])
        offset = ((points - start[best]) * normal).sum(axis=1)
        on = (square[rows, best] < self.config.match**2) & ~ends
        if on.sum() < 3:
            return None
        return _Match(sight, on, place, offset, normal, float(np.ptp(place[on])))

    def _sigma(self, match: _Match) -> Floats:
        """Standard deviation of each point across the memory, without what the filter estimates."""
        sight = match.sight
        along_view = (match.normal * sight.view).sum(axis=1) * sight.forward_sigma
        return np.asarray(np.sqrt(self.config.point_sigma**2 + along_view**2))

    def _register(self, match: _Match, pose: Pose) -> None:
        """Move the memory to where the frame sees it, as far as the prior allows, and learn the stamp error."""
        on, normal = match.on, match.normal[match.on]
        arm = match.sight.points[on] - np.array([pose.x, pose.y])
        lever = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        H = np.column_stack([normal, lever, -(normal * match.sight.velocity[on]).sum(axis=1)])
        residual = match.offset[on]
        noise = self._sigma(match)[on]
        few = min(1.0, self.config.independent / len(residual))
        estimate = np.zeros(4)
        prior = self._covariance
        for _ in range(3):
            whitened = np.abs(residual - H @ estimate) / noise
            weight = few * np.minimum(1.0, 2.0 / np.maximum(whitened, 1e-9)) / noise**2
            information = np.linalg.inv(prior) + (H.T * weight) @ H
            posterior = np.linalg.inv(information)
            estimate = posterior @ (H.T @ (weight * residual))
        surprise = float(estimate @ np.linalg.solve(prior, estimate))
        if surprise > 16.0:  # a wheel slipped: then the memory may have turned by much more than odometry's noise
            prior = prior + np.diag([1e-4, 1e-4, 0.01, 0.0])
            information = np.linalg.inv(prior) + (H.T * weight) @ H
            posterior = np.linalg.inv(information)
            estimate = posterior @ (H.T @ (weight * residual))
        self._covariance = 0.5 * (posterior + posterior.T)
        self.stamp_error = min(max(self.stamp_error + estimate[3], -0.15), 0.15)
        away = self.path - np.array([pose.x, pose.y])
        self.path = self.path + estimate[:2] + estimate[2] * np.column_stack([-away[:, 1], away[:, 0]])
        match.sight.points[:] += estimate[3] * match.sight.velocity

    def _merge(self, match: _Match) -> None:
        """Average the sight into the remembered points that it covers, and append what it sees beyond the end."""
        config = self.config
        lengths = arc_length(self.path)
        on = match.on
        order = np.argsort(match.along[on], kind="stable")
        place, offset = match.along[on][order], match.offset[on][order]
        stamp = (match.normal * match.sight.velocity).sum(axis=1) * math.sqrt(self._covariance[3, 3])
        weight = 1.0 / (self._sigma(match) ** 2 + stamp**2)
        covered = (lengths >= place[0] - 0.5 * config.spacing) & (lengths <= place[-1] + 0.5 * config.spacing)
        wanted = lengths[covered]
        seen_weight = np.interp(wanted, place, weight[on][order])
        gain = seen_weight / (self._weights[covered] + seen_weight)
        tangent = directions(self.path)[covered]
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        self.path[covered] += (gain * np.interp(wanted, place, offset))[:, None] * normal
        most = config.memory * seen_weight
        self._weights[covered] = np.minimum(self._weights[covered] + seen_weight, np.maximum(most, seen_weight))
        last = int(np.flatnonzero(on)[-1])
        rest = match.sight.points[last + 1 :]
        left = lengths[-1] - match.along[last]
        if left < 1.5 * config.spacing:
            self._append(rest, float(weight[on].min()))
            self._conflicts = 0
        elif len(rest) >= 6 and match.length > 0.1:
            self._conflicts += 1  # the line goes on elsewhere than remembered
            if self._conflicts >= 4:
                keep = lengths <= match.along[last]
                self.path, self._weights = self.path[keep], self._weights[keep]
                self._append(rest, float(weight[on].min()))
                self._conflicts = 0
        else:
            self._conflicts = 0

    def _continue(self, sight: _Sight) -> bool:
        """Append a sight that starts where the memory ends."""
        gap = sight.points[0] - self.path[-1]
        out = end_direction(self.path, 0.1)
        into = -end_direction(sight.points[::-1], 0.1)
        distance = float(np.hypot(*gap))
        if distance > self.config.join or min(out @ into, (out @ gap) / max(distance, 1e-9)) < 0.8:
            return False
        self._append(sight.points, 1.0 / self.config.point_sigma**2)
        return True

    def _append(self, points: Floats, weight: float) -> None:
        """Prolong the memory by points that are at least half a spacing from its end, also round a sharp corner."""
        away = np.hypot(*(points - self.path[-1]).T)
        far = np.flatnonzero(away >= 0.5 * self.config.spacing)
        if len(far) == 0 or away[far[0]] > self.config.join or len(points) - far[0] < 2:
            return
        first = int(far[0])
        added = resample(np.vstack([self.path[-1], points[first:]]), self.config.spacing)[1:]
        self.path = np.vstack([self.path, added])
        self._weights = np.concatenate([self._weights, np.full(len(added), weight)])

    # ---- upkeep ------------------------------------------------------------------------------------------------------

    def _expected(self, pose: Pose) -> float:
        """Metres of the remembered line that should be in view from `pose`."""
        away = self.path - np.array([pose.x, pose.y])
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        robot = np.column_stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]])
        return float(self.view.shows(robot).sum()) * self.config.spacing

    def _forget(self, pose: Pose) -> None:
        """Drop what lies far behind, and keep the points at even distances."""
        gaps = np.hypot(*(self.path - np.array([pose.x, pose.y])).T)
        lengths = arc_length(self.path)
        window = lengths <= lengths[0] + self.config.behind + 0.6  # because a closed line comes by here again
        here = int(np.argmin(np.where(window, gaps, np.inf)))
        keep = lengths >= lengths[here] - self.config.behind
        self.path, self._weights = self.path[keep], self._weights[keep]
        lengths = arc_length(self.path)
        steps = np.diff(lengths)
        if len(steps) and (steps.min() < 0.5 * self.config.spacing or steps.max() > 1.5 * self.config.spacing):
            even = resample(self.path, self.config.spacing)
            wanted = np.linspace(0.0, lengths[-1], len(even))
            self._weights = np.interp(wanted, lengths, self._weights)
            self.path = even


def _approach(here: Floats, ahead: Floats, points: Floats) -> Floats:
    """A smooth way (M, 2) from the robot to the first of the points: a cubic Hermite curve."""
    into = -end_direction(points[::-1], 0.1)
    size = float(np.hypot(*(points[0] - here)))
    s = np.linspace(0.0, 1.0, 20)[:-1, None]
    way: Floats = (
        (2 * s**3 - 3 * s**2 + 1) * here
        + (s**3 - 2 * s**2 + s) * size * ahead
        + (3 * s**2 - 2 * s**3) * points[0]
        + (s**3 - s**2) * size * into
    )
    return way
