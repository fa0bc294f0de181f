"""Which of the lines in view is ours, from frame to frame, and where it lies.

Each frame's lines are put where the robot was at the frame's stamp and compared with the line as remembered, which
bridges the blind zone before the wheels. A small filter estimates how the memory is displaced against odometry
(wheels slip) and by how much the stamps are off (cameras are late); then the frame's points are averaged into the
memory. Displacement along a straight line cannot be seen: the point-to-line residuals leave it to the prior, which is
odometry (thesis section 5.2.4 by point-to-line registration). Between views some way apart the line alone is also
asked how the robot moved; that is offered to whoever wants it, with what it cannot know left open.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..records import Floats, Line, LineMotion, Pose
from .line_forks import STRAIGHT_ON, Junctions, Rule, past_the_end
from .line_icp import SLIPPED, LineOdometer, Nearest, View, solve
from .line_map import LineMap, approach
from .line_sight import Motion, PoseHistory, Sight, sights, to_robot
from .polyline import end_direction
from .top_view import TopView

__all__ = ["LineTracker", "PoseHistory", "TrackerConfig"]

ENDED = 5  # frames in a row that must show the line's end
TIP = 0.10  # metres remembered beyond what is seen that are cut off after as many frames; more, if seen less often
SURE_TURN = 0.15  # rad/s: what encoders show below it is as much their steps as the robot's turning
MORE = 4  # frames in a row that must show how the line goes on behind an end that was seen
BESIDE = 0.15  # metres around an end in which any other piece of line is a doubt about it


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Metres, seconds, radians."""

    spacing: float = 0.02  # of the remembered points
    behind: float = 0.4  # of line kept behind the robot
    match: float = 0.06  # farthest that a point of our line may be off the memory
    drift: float = 0.4  # by which `match` grows with every metre driven without a sight
    search: float = 0.15  # the same, when the whole view is searched after a loss
    acquire: float = 0.25  # farthest that a new line may pass the robot
    join: float = 0.30  # longest gap between the memory's end and a piece that continues it
    clear: float = 0.32  # of bare floor seen beyond its end that make it an end
    point_sigma: float = 0.002  # of a seen point across the line
    motion_sigma: float = 0.0007  # the same, between two views of one place
    motion_whole: tuple[float, float] = (0.0005, 0.001)  # shift and turn of such a view as a whole
    tilt_sigma: float = 0.006  # of the floor against the camera: 0.3 degrees
    stamp_sigma: float = 0.03  # of the camera's constant stamp error
    jitter: float = 0.002  # of a stamp
    turn_noise: float = 0.018  # heading after one metre of odometry
    travel_noise: float = 0.003  # of each wheel after one metre
    independent: float = 8.0  # points of one frame that count as independent
    memory: float = 12.0  # frames after which a remembered point averages no more
    expected: float = 0.30  # metres of remembered line in view without which it is no loss to see none
    latency: float = 0.06  # metres driven until a frame arrives
    fork: Rule = "straight"
    fork_heading: float = 0.0  # for that rule, odometry axes


class LineTracker:
    """The line that we follow.

    One frame: `begin`, then `see` with what a first look found, and, if that says no and `expected` is enough, with
    what better looks find, then `finish`.

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
    confidence : float
        Of the last line that was ours, 0..1.
    ends : bool
        The line's end has been seen, with bare floor beyond it: it is where `path` ends.
    """

    def __init__(self, view: TopView, row_time: float = 0.0, config: TrackerConfig = TrackerConfig()) -> None:
        self.view = view
        self.config = config
        self._row_time = row_time
        self._blind = float(view.to_robot(np.array([[0.0, view.valid.shape[0] - 1.0]]))[0, 0])
        self._map = LineMap(config.spacing, config.memory, config.join)
        self._junctions = Junctions(config.fork, config.fork_heading)
        self._odometer = LineOdometer(config.motion_sigma, config.motion_whole, config.jitter, config.independent)
        self.stamp_error = 0.0
        self._covariance: Floats = np.diag([0.0, 0.0, 0.0, config.stamp_sigma**2])
        self.reset()

    @property
    def path(self) -> Floats:
        return self._map.path

    @property
    def pose(self) -> Pose:
        """Of the robot at the frame at hand, by odometry."""
        assert self._now is not None
        return self._now.pose

    def reset(self) -> None:
        """Forget the line, but not the stamp error, which is the camera's."""
        self._map.clear()
        self._junctions.forget()
        self._lost = 0.0
        self._sighted = 0.0  # metres travelled at the last sight
        self._last: Motion | None = None  # at the last frame
        self._now: Motion | None = None
        self._stamp = 0.0
        self._seen: Sight | None = None
        self._ends = self._more = self._doubts = 0
        self._odometer.reset()
        self._finished: list[tuple[Floats, Floats]] = []
        self.confidence = 0.0
        self._motion: LineMotion | None = None
        self._covariance = np.diag([1e-6, 1e-6, 1e-6, self._covariance[3, 3]])  # of x, y, heading and stamps

    @property
    def ends(self) -> bool:
        return self._ends >= ENDED

    def missed(self, travelled: float) -> float:
        """Metres driven while the line should have been in view but was not, also if frames stopped coming."""
        if self._last is None:
            return 0.0
        return self._lost + max(0.0, travelled - self._last.travelled - self.config.latency)

    def lost(self, travelled: float) -> float:
        """Metres driven on memory alone: `missed`, or all since any sight of the line but for the blind zone.

        In a tight corner the line leads out of view before it comes back, so that it is lost but not missed.
        """
        if self._last is None:
            return 0.0
        beyond = travelled - self._sighted - self._blind
        # sights are older than they were noticed: the safety layer, which counts from their stamps, must not be first
        return max(self.missed(travelled), beyond + self.config.latency if beyond > 0.0 else 0.0)

    def observe(self, lines: Sequence[Line], t: float, history: PoseHistory, travelled: float) -> bool:
        """Take a frame with one look at it: `begin`, `see` and `finish`; whether our line was among `lines`."""
        if not self.begin(t, history, travelled):
            return False
        seen = self.see(lines)
        self.finish(seen)
        return seen

    # ---- one frame ---------------------------------------------------------------------------------------------------

    def begin(self, t: float, history: PoseHistory, travelled: float) -> bool:
        """Predict where the line is in a frame with stamp `t`; False if odometry does not know that time.

        Parameters
        ----------
        t : float
            The frame's stamp.
        history : PoseHistory
            Odometry, at least from `t` on.
        travelled : float
            Metres driven until now.
        """
        at = history.at(t + self.stamp_error)
        if at is None:
            return False
        self._now = Motion(*at, travelled)
        self._stamp = t
        self._seen = None
        self._predict(self._now.pose)
        return True

    @property
    def expected(self) -> float:
        """Metres of the remembered line that should be in view in this frame."""
        if len(self._map) == 0:
            return 0.0
        return float(self._shown().sum()) * self.config.spacing

    def around(self, reach: float) -> NDArray[np.bool_]:
        """Where in the top view (H, W) the line may be by prediction: within `reach` metres of what is remembered."""
        assert self._now is not None
        band = np.zeros(self.view.valid.shape, np.uint8)
        pixels = np.rint(8.0 * self.view.to_pixels(to_robot(self.path, self._now.pose))).astype(np.int32)
        thickness = max(1, round(2.0 * reach / self.view.metres_per_pixel))
        cv2.polylines(band, [pixels.reshape(-1, 1, 2)], False, 1, thickness, cv2.LINE_8, 3)
        return self.view.valid & (band > 0)

    def see(self, lines: Sequence[Line], *, relaxed: bool = False, everywhere: bool = False) -> bool:
        """Find our line among these, best first, and learn from it.

        Parameters
        ----------
        lines : sequence of Line
            Of this frame, in pixels of the top view.
        relaxed : bool
            They were found with relaxed limits: good enough to stay on the line, not to learn where it goes.
        everywhere : bool
            It was lost: also believe what lies farther from the prediction.

        Returns
        -------
        bool
            Whether ours was among them.
        """
        assert self._now is not None
        config = self.config
        found = [
            sight
            for line in lines
            for sight in sights(line, self.view, self._now, self._row_time, config.spacing, config.tilt_sigma)
        ]
        if len(self._map) == 0:
            return self._acquire(found)
        # without a sight the prediction grows worse, by slips of the wheels above all
        unseen = max(0.0, self._now.travelled - self._sighted - config.latency)
        within = config.search if everywhere else min(config.match + config.drift * unseen, config.search)
        return self._update(found, within, relaxed=relaxed)

    def acquire_anew(self, lines: Sequence[Line]) -> bool:
        """After a loss: follow the nearest piece of line in the direction that was ours; False if there is none.

        Parameters
        ----------
        lines : sequence of Line
            Of this frame, in pixels of the top view.
        """
        assert self._now is not None
        pose, config = self._now.pose, self.config
        out = self._map.end_direction()
        best: tuple[float, Sight] | None = None
        for line in lines:
            for sight in sights(line, self.view, self._now, self._row_time, config.spacing, config.tilt_sigma):
                gap = float(np.hypot(*(sight.points[0] - [pose.x, pose.y])))
                if end_direction(sight.points, 0.2) @ out > 0.0 and (best is None or gap < best[0]):
                    best = gap, sight
        if best is None or best[1].confidence < 0.5:
            return False
        self._map.start(np.vstack([approach(pose, best[1].points), best[1].points]))
        self._junctions.forget()
        self._ends = self._more = self._doubts = 0
        self._note(best[1])
        return True

    def finish(self, seen: bool) -> None:
        """Close the frame: count what was not seen, note an end, let go what lies behind."""
        now, last = self._now, self._last
        assert now is not None
        driven = 0.0 if last is None else max(0.0, now.travelled - last.travelled)
        self._last = now
        if len(self._map) == 0:
            return
        if seen:
            self._lost, self._sighted = 0.0, now.travelled
        elif self.expected >= self.config.expected:
            self._lost += driven
        here = self._map.foot(now.pose, self.config.behind + 0.6)
        points, back = self._map.finish(here, self.config.behind)
        if len(points):
            self._finished.append((points, now.travelled - back))

    def take_motion(self) -> LineMotion | None:
        """The motion that the line has shown since the last call, once it is enough to tell."""
        motion, self._motion = self._motion, None
        return motion

    def finished(self) -> tuple[Floats, Floats]:
        """What has left the memory since the last call: points (N, 2), odometry axes, and metres driven at each."""
        points = [np.empty((0, 2)), *(piece for piece, _ in self._finished)]
        travelled = [np.empty(0), *(piece for _, piece in self._finished)]
        self._finished = []
        return np.concatenate(points), np.concatenate(travelled)

    def rest(self) -> tuple[Floats, Floats]:
        """All that is remembered, as `finished` gives it."""
        if len(self._map) == 0 or self._last is None:
            return np.empty((0, 2)), np.empty(0)
        here = self._map.foot(self._last.pose, self.config.behind + 0.6)
        return self.path.copy(), self._last.travelled - (here - self._map.lengths)

    # ---- registration ------------------------------------------------------------------------------------------------

    def _predict(self, pose: Pose) -> None:
        """Let the uncertainty of the memory against odometry grow by the way since the last frame."""
        if self._last is None:
            return
        before = self._last.pose
        dx, dy = pose.x - before.x, pose.y - before.y
        transport = np.eye(4)  # because the heading's error turns the memory about where the robot is
        transport[0, 2], transport[1, 2] = -dy, dx
        distance = math.hypot(dx, dy) + 0.1 * abs(math.remainder(pose.heading - before.heading, 2.0 * math.pi))
        travel, turn = self.config.travel_noise**2 * distance, self.config.turn_noise**2 * distance
        self._covariance = transport @ self._covariance @ transport.T + np.diag([travel, travel, turn, 0.0])

    def _acquire(self, found: Sequence[Sight]) -> bool:
        """Start the memory with the line that passes nearest to the robot and runs along with it."""
        assert self._now is not None
        pose = self._now.pose
        best: tuple[float, Sight] | None = None
        ahead = np.array([math.cos(pose.heading), math.sin(pose.heading)])
        left = np.array([-ahead[1], ahead[0]])
        for sight in found:
            out = -end_direction(sight.points[::-1], 0.1)
            start = sight.points[0] - [pose.x, pose.y]
            if out @ ahead < 0.6 or start @ ahead < 0.0:
                continue
            passing = abs(start @ left - (start @ ahead) * (out @ left) / (out @ ahead))
            if passing <= self.config.acquire and (best is None or passing < best[0]):
                best = float(passing), sight
        if best is None:
            return False
        sight = best[1]
        self._map.start(np.vstack([approach(pose, sight.points), sight.points]))
        self._lost = 0.0
        self._note(sight)
        return True

    def _update(self, found: Sequence[Sight], within: float, *, relaxed: bool) -> bool:
        """Register the sights that lie on the memory, best first, and average them into it."""
        line, config = self._map, self.config
        matches = [(match, sight) for sight in found if (match := line.match(sight, within)) is not None]
        matches.sort(key=lambda pair: -pair[0].covered)
        grows = not relaxed and self._may_grow(found)
        for match, sight in matches:
            if match.covered < 3 * config.spacing:
                break
            if self._seen is None:
                self._note(sight)
                self._register(match, sight)
            fresh = line.match(sight, config.match)
            if fresh is not None:
                self._merge(fresh, sight, grow=grows)
        if (
            self._seen is None
            and within > config.match
            and (slipped := past_the_end(line, found, within, self._join_reach()))
        ):
            self._note(slipped[1])
            self._register(*slipped)
        grown = [sight for sight in found if self._continue(sight)] if grows else []
        if self._seen is None and grown:
            self._note(grown[0])
        if self._seen is None:
            return False
        line.note_missed(self._shown())
        if not relaxed:
            self._look_ahead(found)
        return True

    def _register(self, match: Nearest, sight: Sight) -> None:
        """Move the memory to where the frame sees it, as far as the prior allows, and learn the stamp error."""
        assert self._now is not None
        config, pose = self.config, self._now.pose
        on, normal = match.on, match.normal[match.on]
        arm = sight.points[on] - np.array([pose.x, pose.y])
        lever = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        # Of a stamp's error only what turning shows counts, because along the way a view carries marks of its own with
        # it, the end of what is seen above all, and these look like a late stamp.
        turning = self._now.turn_rate
        late = -lever * (turning if abs(turning) >= SURE_TURN else 0.0)
        H = np.column_stack([normal, lever, late, late])  # the constant error of the stamps, and this one's own
        residual, noise = match.offset[on], sight.across_sigma(match.normal, config.point_sigma)[on]
        prior = np.zeros((5, 5))
        prior[:4, :4], prior[4, 4] = self._covariance, config.jitter**2
        estimate, posterior, surprise = solve(H, residual, noise, prior, config.independent)
        if surprise > SLIPPED:  # then the memory may have turned by much more than odometry's noise
            prior += np.diag([1e-4, 1e-4, 0.01, 0.0, 0.0])
            estimate, posterior, _ = solve(H, residual, noise, prior, config.independent)
        self._covariance = posterior[:4, :4]
        self.stamp_error = min(max(self.stamp_error + float(estimate[3]), -0.15), 0.15)
        self._map.shift(pose, float(estimate[0]), float(estimate[1]), float(estimate[2]))
        sight.points[:] += (estimate[3] + estimate[4]) * sight.velocity

    def _merge(self, match: Nearest, sight: Sight, *, grow: bool) -> None:
        stamp = (match.normal * sight.velocity).sum(axis=1) * math.sqrt(self._covariance[3, 3])
        weight = 1.0 / (sight.across_sigma(match.normal, self.config.point_sigma) ** 2 + stamp**2)
        end = float(self._map.lengths[-1])
        self._map.merge(match, weight)
        last = int(np.flatnonzero(match.on)[-1])
        if grow and end - match.along[last] < 1.5 * self.config.spacing:
            weakest = float(weight[match.on].min())
            self._map.append(sight.points[last + 1 :], weakest, leaves=float(match.along[last]))

    def _may_grow(self, found: Sequence[Sight]) -> bool:
        """Whether the memory's end is open: one that was seen is believed until several frames show more line."""
        if not self.ends or not any(map(self._is_more, found)):
            self._more = 0
            return True
        self._more += 1
        if self._more >= MORE:
            self._ends = self._more = self._doubts = 0
        return self._more == 0

    def _is_more(self, sight: Sight) -> bool:
        if self._join(sight) is not None:
            return True
        match = self._map.match(sight, self.config.match)
        if match is None:
            return False
        last = int(np.flatnonzero(match.on)[-1])
        reaches = float(self._map.lengths[-1]) - match.along[last] < 1.5 * self.config.spacing
        return reaches and float(np.hypot(*(sight.points[-1] - self.path[-1]))) > TIP

    def _continue(self, sight: Sight) -> bool:
        """Append a sight that goes on straight where the memory ends, across a gap."""
        join = self._join(sight)
        return join is not None and self._map.append(sight.points, 1.0 / self.config.point_sigma**2, join)

    def _join_reach(self) -> float:
        """Longest gap over which the memory's end may be prolonged."""
        # a gap that begins where nothing is seen may end where the view begins
        return self.config.join + (0.0 if self._shown()[-1] else self._blind)

    def _join(self, sight: Sight) -> float | None:
        """Longest gap over which a sight may be joined to the memory's end; None if it does not go on from there."""
        gap = sight.points[0] - self.path[-1]
        out, into = self._map.end_direction(), -end_direction(sight.points[::-1], 0.1)
        distance = float(np.hypot(*gap))
        join = self._join_reach()
        if distance > join or math.acos(np.clip(out @ into, -1.0, 1.0)) > STRAIGHT_ON:
            return None
        sideways = abs(out[0] * gap[1] - out[1] * gap[0])
        if out @ gap < -self.config.spacing or sideways > 0.02 + 0.25 * distance:
            return None
        return join

    def _look_ahead(self, found: Sequence[Sight]) -> None:
        """Take the way that the rule wants where there are several, and see whether the line ends."""
        assert self._now is not None
        line, config, pose = self._map, self.config, self._now.pose
        here = line.foot(pose, config.behind + 0.6)
        branch = self._junctions.choose(line, found, here)
        if branch is not None:
            line.append(branch.points, 1.0 / config.point_sigma**2, leaves=branch.s)
        seen = np.flatnonzero(line.missed == 0)
        last = int(seen[-1]) if len(seen) else len(line) - 1
        if last < len(line) - 1:
            missed, shown = line.missed[last + 1 :], line.shown[last + 1 :]
            is_short = line.lengths[-1] - line.lengths[last] < TIP
            if missed.min() >= ENDED and (is_short or (missed > shown).all()):
                line.cut(float(line.lengths[last]))
        end, out = line.path[-1], line.end_direction()
        beyond = end + np.arange(0.03, config.clear, 0.02)[:, None] * out
        is_seen = len(seen) > 0 and line.missed[-4:].min() == 0  # to the end, but for a point or two
        bare = is_seen and self.view.shows(to_robot(np.vstack([end, beyond]), pose)).all()
        bare = bare and not any(
            np.hypot(*(sight.points - end).T).min() < BESIDE and not self._is_ours(sight) for sight in found
        )
        if bare:
            self._ends, self._doubts = self._ends + 1, 0
        elif is_seen:  # an end that counts falls only to several frames in a row
            self._doubts += 1
            self._ends = self._ends if self.ends and self._doubts < MORE else 0

    def _is_ours(self, sight: Sight) -> bool:
        """Whether a sight shows the remembered line, of which it may show a little more than is remembered."""
        out = self._map.end_direction()
        for one in (sight, sight.reversed()):
            if (match := self._map.match(one, self.config.match)) is not None:
                beyond = one.points - self.path[-1]
                ahead, aside = beyond @ out, np.abs(beyond @ [-out[1], out[0]])
                is_tip = (ahead >= 0.0) & (ahead <= TIP) & (aside <= self.config.spacing)
                return bool((match.on | is_tip).mean() > 0.7)
        return False

    # ---- upkeep ------------------------------------------------------------------------------------------------------

    def _shown(self) -> NDArray[np.bool_]:
        """Which remembered points are in view in this frame."""
        assert self._now is not None
        return self.view.shows(to_robot(self.path, self._now.pose))

    def _note(self, sight: Sight) -> None:
        """This is ours: keep it, and report the motion since the last view that is far enough back."""
        assert self._now is not None
        now = self._now
        self._seen = sight
        self.confidence = sight.confidence
        view = View(
            self._stamp,
            to_robot(sight.points, now.pose),
            0.3 * sight.forward_sigma,  # because the floor's tilt hardly changes on the way
            to_robot(sight.view, Pose(0.0, 0.0, now.pose.heading)),
            now.speed,
            now.turn_rate,
        )
        late = math.sqrt(self._covariance[3, 3])
        self._motion = self._odometer.observe(view, now.pose, self.stamp_error, late) or self._motion
