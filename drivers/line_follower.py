"""Follow a line on the floor: frames in, drive commands out."""

from __future__ import annotations

import asyncio
import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from robotd.bind import ranged
from robotd.bus import Bus, Subscription
from robotd.clock import in_thread, now
from robotd.config import Calibration
from robotd.errors import ConfigError, DriverFault, MissionError
from robotd.follow import SLOW_AFTER, FollowConfig, PathFollower, Steering
from robotd.hardware import CameraMode, Hardware
from robotd.lost_line import BLIND_S, LostLine
from robotd.plugin import Driver, FollowEnd
from robotd.records import (
    CameraModel,
    DriveCommand,
    Frame,
    Line,
    LinePoints,
    LineState,
    LineStatus,
    OdometryState,
    Transform,
    Withdrawal,
)
from robotd.vision.line_eye import SURE_CONFIDENCE, LineEye
from robotd.vision.line_tracker import LineTracker, PoseHistory, TrackerConfig
from robotd.vision.markers import MarkFinder, MarkTracker
from robotd.vision.polyline import arc_length

FIRST_SIGHT_S = 3.0  # a standing robot waits this long for a line
OTHER_WIDTH_S = 1.0  # after so long it may also be wider or narrower than the configuration says
STANDSTILL_M_S = 0.002
STANDSTILL_S = 0.15  # longer than the window over which odometry takes its speed
SEARCH_LEAST = 0.15  # metres of remembered line in view that are worth a closer look
SEARCH_NEAR = 0.10  # metres to either side of the prediction
END_SLACK = 0.10  # metres before a stop at which the line may end: odometry's error after a long drive
# about where a floor camera is: for its pictures' size, until it is calibrated
UNCALIBRATED = CameraModel(
    "floor", (320, 240), (228.5, 228.5, 159.5, 119.5), Transform((-1.643, 1.643, -0.855), (0.12, 0.0, 0.3))
)
MARK_NEAR, MARK_FAR = 1.0, 0.30  # line widths and metres from the line's middle between which a marker is ours
SAME_MARK = 0.15  # metres behind a marker in which it is the one at which the robot stands


@dataclass(frozen=True, slots=True)
class LineFollowerConfig:
    """[drivers.<name>] of a `line_follower`; metres, seconds and radians."""

    camera: str = "floor"
    line_width: float = ranged(0.050, minimum=0.005, maximum=0.2)
    color: Literal["dark", "bright", "both"] = "dark"
    cruise: float = ranged(0.30, minimum=0.03, maximum=0.30)
    acceleration: float = ranged(0.30, minimum=0.05, maximum=0.5)
    corner_cut: float = ranged(0.0, minimum=0.0, maximum=1.0)
    corridor: float = ranged(0.050, minimum=0.0, maximum=0.2)
    coast: float = ranged(0.30, minimum=0.05, maximum=0.30)
    fork: Literal["straight", "left", "right", "heading"] = "straight"
    fork_heading: float = ranged(0.0, minimum=-math.pi, maximum=math.pi)
    marker_size: float = ranged(0.050, minimum=0.01, maximum=0.2)
    exposure: float = ranged(0.010, minimum=0.0001, maximum=0.1)
    gain: float | None = ranged(None, minimum=0.0)
    metres_per_pixel: float = ranged(0.0035, minimum=0.001, maximum=0.02)
    readout: float = ranged(0.030, minimum=0.0, maximum=0.1)
    view_near: float = ranged(0.20, minimum=0.0, maximum=2.0)
    view_far: float = ranged(1.05, minimum=0.1, maximum=5.0)
    view_side: float = ranged(0.45, minimum=0.05, maximum=3.0)

    def __post_init__(self) -> None:
        if self.view_far <= self.view_near:
            raise ValueError(f"view_far = {self.view_far:g}; expected more than view_near = {self.view_near:g}")


class LineFollowerDriver(Driver):
    """Finds the line in a camera's frames, remembers it, and steers along it.

    The camera is the floor camera of the calibration, or, if `camera` names one of the rig's, that one.

    Attributes
    ----------
    latest_line : tuple of Line
        What the detector found in the last frame, in pixels of `view`.
    tracker : LineTracker
        Its `path` is the line as remembered.
    blind : float
        Metres from the robot's origin to the nearest floor in view.
    mode : CameraMode
        In which the camera is to run while the robot drives.
    """

    kind: ClassVar[str] = "follower"
    Config = LineFollowerConfig
    config: LineFollowerConfig

    def __init__(
        self, name: str, config: LineFollowerConfig, hardware: Hardware, bus: Bus, calibration: Calibration
    ) -> None:
        super().__init__(name, config, hardware, bus, calibration)
        rig = {camera.name: camera for camera in calibration.cameras}
        model = rig.get(config.camera, calibration.floor_camera)
        self._is_calibrated = model is not None
        model = model or UNCALIBRATED
        try:
            self._eye = LineEye(
                model,
                config.line_width,
                config.color,
                config.metres_per_pixel,
                (config.view_near, config.view_far),
                (-config.view_side, config.view_side),
            )
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from error
        self.view = self._eye.view
        self.blind = self._eye.blind
        self.mode = CameraMode(size=model.size, fps=30.0, exposure=config.exposure, gain=config.gain)
        self._row_time = config.readout / model.size[1]
        self.latest_line: tuple[Line, ...] = ()
        self._finder = MarkFinder(self.view, config.marker_size, config.color)
        self._follower = PathFollower(
            FollowConfig(
                cruise=config.cruise,
                acceleration=config.acceleration,
                coast=config.coast,
                corner_cut=config.corner_cut,
                corridor=config.corridor,
            )
        )
        self._lost = LostLine()
        self._steering: Steering | None = None
        self._forget()

    def _forget(self) -> None:
        self.tracker = LineTracker(
            self.view, self._row_time, TrackerConfig(fork=self.config.fork, fork_heading=self.config.fork_heading)
        )
        self._history = PoseHistory()
        self._marks = MarkTracker()
        self._eye.forget()
        self._eye.expect(self.config.line_width)
        self._started = -math.inf  # when `follow` was last called
        self._line_t = -math.inf  # when it was last seen
        self._doubt: tuple[float, str] | None = None  # since when pictures are useless, and why
        self._state: LineState = "standing"
        self._at_mark = -math.inf  # metres travelled at the last marker

    async def open(self) -> None:
        """Start without any memory; the camera belongs to a driver of its own.

        Raises
        ------
        DriverFault
            Nobody knows where the camera is; all else works meanwhile, so that it can be calibrated.
        """
        if not self._is_calibrated:
            raise DriverFault(
                f"the calibration has neither a camera '{self.config.camera}' in its rig nor a [floor_camera]; "
                "robotctl calibrate floor collects what it takes, then restart robotd"
            )
        self._forget()

    async def close(self) -> None:
        """Hand over what is still remembered of the line."""
        points, travelled = self.tracker.rest()
        if len(points):
            self.bus.line_points.publish(LinePoints(now(), self.name, points, travelled))
            self.tracker.reset()
        await super().close()

    async def run(self) -> None:
        """Nothing by itself: the mission calls `follow`."""
        await asyncio.Event().wait()

    async def follow(self, travelled: float, *, at_marker: bool = False) -> FollowEnd:
        """Drive along the line until odometry says `travelled` metres (inf: without end), then halt.

        Parameters
        ----------
        travelled : float
            Metres since the leg began.
        at_marker : bool
            Halt at the next marker beside the line, too, and take the line's end for a stop.

        Returns
        -------
        "distance", "marker" or "end"
            Why it halted: there, at a marker, or at the line's end.

        Raises
        ------
        MissionError
            There is no line, or it was lost, or it ended; the robot has been told to halt.
        """
        self._follower.reset()
        self._lost.start()
        self._eye.forget()
        self._doubt = None
        with self.bus.frames(self.config.camera).subscribe(size=2) as frames:
            watching = asyncio.create_task(self._watch(frames, marks=at_marker))
            try:
                reached = await self._drive(travelled, watching, at_marker=at_marker)
            finally:
                self._command(0.0, 0.0)
                watching.cancel()
                await asyncio.wait([watching])
        if not watching.cancelled():
            watching.result()  # a bug there must not go unseen
        self._enter("ended" if reached == "end" else "standing")
        return reached

    # ---- steering ----------------------------------------------------------------------------------------------------

    async def _drive(self, travelled: float, watching: asyncio.Task[None], *, at_marker: bool) -> FollowEnd:
        self._started = before = now()
        standing: float | None = None
        with self.bus.odometry.subscribe(size=4) as odometry:
            async for state in odometry:
                if watching.done():
                    watching.result()
                self._history.add(state.t, state.pose)
                dt, before = min(max(state.t - before, 0.0), 0.1), state.t
                if self._doubt is not None and now() - self._doubt[0] >= BLIND_S:
                    self._give_up(f"line lost: {self.config.camera}: {self._doubt[1]}; look at that camera")
                if len(self.tracker.path) < 2:
                    self._await_line()
                    continue
                steering, reached = self._next(state, travelled, dt, at_marker=at_marker)
                if reached is None or abs(state.speed) > STANDSTILL_M_S:
                    standing = None
                elif standing is None:
                    standing = state.t
                elif state.t - standing >= STANDSTILL_S:
                    return self._arrived(reached, travelled - state.travelled, state.travelled, at_marker=at_marker)
                self._command(steering.speed, steering.turn_rate)
        raise AssertionError("odometry does not end")

    def _next(
        self, state: OdometryState, travelled: float, dt: float, *, at_marker: bool
    ) -> tuple[Steering, FollowEnd | None]:
        """What to do in this tick, and why the robot is to stand, if it is."""
        tracker, path = self.tracker, self.tracker.path
        remaining, reason = travelled - state.travelled, "distance"
        if at_marker and (to_mark := self._to_mark(path, state)) < remaining:
            remaining, reason = to_mark, "marker"
        lost = tracker.lost(state.travelled)
        steering = self._follower.steer(path, state.pose, remaining, lost=lost, dt=dt, ends=tracker.ends)
        self._steering = steering
        if steering.halted:
            return self._searching(state, lost, steering), None
        if self._lost.is_turning:
            self._lost.forget()
        if tracker.missed(state.travelled) > SLOW_AFTER:
            self._enter("coasting")
        if steering.speed > 0.0:
            return steering, None
        return steering, "end" if remaining > 0.0 else reason  # type: ignore[return-value]

    def _searching(self, state: OdometryState, lost: float, steering: Steering) -> Steering:
        """Turn to where the line was last, or give up."""
        move = self._lost.search(self.tracker.path, state.pose, state.travelled)
        if move.reason is not None:
            self._give_up(
                f"{self._lost_in_words(lost, steering.beyond)}, {move.reason}; put the robot back on the line"
            )
        self._enter(move.state)
        return Steering(0.0, move.turn_rate, steering.offset, steering.heading_error, steering.beyond, steering.left)

    def _await_line(self) -> None:
        self._enter("acquiring")
        self._command(0.0, 0.0)
        if now() - self._started > FIRST_SIGHT_S:
            raise MissionError(
                f"no line in view of {self.config.camera} for {FIRST_SIGHT_S:g} s;"
                " put the robot on the line, heading along it"
            )

    def _arrived(self, reached: FollowEnd, left: float, travelled: float, *, at_marker: bool) -> FollowEnd:
        """The robot stands; raises MissionError if it should not stand here."""
        if reached == "marker":
            self._at_mark = travelled
        if reached != "end" or at_marker:
            return reached
        if left > END_SLACK:
            self._enter("ended")
            reason = f"the line ends {left:.2f} m before the next stop; shorten the mission's stops or prolong the line"
            self.bus.withdrawals.publish(Withdrawal(now(), self.name, reason))
            raise MissionError(reason)
        self.report(f"the line ends {left:.2f} m before the stop: stopped there")
        return "distance"

    def _to_mark(self, path: np.ndarray[tuple[int, int], np.dtype[np.float64]], state: OdometryState) -> float:
        """Metres to the next marker beside the line, inf if none is known."""
        lengths = arc_length(path)
        here = float(lengths[int(np.hypot(*(path - [state.pose.x, state.pose.y]).T).argmin())])
        places = self._marks.beside(path, lengths, (MARK_NEAR * self.config.line_width, MARK_FAR))
        done = self._at_mark + SAME_MARK - state.travelled  # so far ahead is still the marker of the last stop
        return min((place - here for place in places if place - here > max(done, -SAME_MARK)), default=math.inf)

    def _give_up(self, reason: str) -> None:
        """Withdraw every wish and end the drive."""
        self._enter("lost")
        self._command(0.0, 0.0)
        self.bus.withdrawals.publish(Withdrawal(now(), self.name, reason))
        raise MissionError(reason)

    def _lost_in_words(self, lost: float, beyond: float) -> str:
        if beyond > lost:
            return f"line lost: it was seen to go no farther than {beyond:.2f} m behind the robot"
        return f"line lost: not seen by {self.config.camera} for {lost:.2f} m"

    def _command(self, speed: float, turn_rate: float) -> None:
        self.bus.commands.publish(DriveCommand(now(), speed, turn_rate, self.name, self._line_t))

    # ---- seeing ------------------------------------------------------------------------------------------------------

    async def _watch(self, frames: Subscription[Frame], *, marks: bool) -> None:
        """Find the line in every frame; in a thread, because that takes milliseconds."""
        async for frame in frames:
            doubt = self._eye.doubt(frame.image)
            if doubt is not None:
                self.latest_line = ()
                self._doubt = (self._doubt[0] if self._doubt is not None else now()), doubt
                continue
            self._doubt = None
            self.latest_line = tuple(await in_thread(self._eye.look, frame.image))
            state = self.bus.odometry.latest
            if state is None:
                continue
            self._reconsider(state)
            if not self.tracker.begin(frame.t, self._history, state.travelled):
                continue
            seen = await self._find()
            self.tracker.finish(seen is not None)
            if seen is not None:
                self._line_t = frame.t + self.tracker.stamp_error
                self._enter(seen)
            elif self._state not in ("coasting", "turning", "acquiring"):
                self._enter("predicting")
            if marks:
                self._marks.observe(await in_thread(self._finder.find, self._eye.top), self.tracker.pose)
            self._publish()

    async def _find(self) -> LineState | None:
        """Our line in the frame at hand, looked for with growing effort; how it was found."""
        tracker = self.tracker
        if tracker.see(self.latest_line):
            return "tracking"
        if len(tracker.path) == 0:
            return await self._find_other_width()
        if tracker.expected >= SEARCH_LEAST:
            if tracker.see(await in_thread(self._eye.search, tracker.around(SEARCH_NEAR)), relaxed=True):
                return "searching near"
            # one picture without the line is not yet a reason to believe a doubtful piece that lies elsewhere
            state = self.bus.odometry.latest
            is_lost = state is not None and tracker.missed(state.travelled) > SLOW_AFTER
            if is_lost and tracker.see(await in_thread(self._eye.search), relaxed=True, everywhere=True):
                return "searching all"
        if self._lost.is_turning and tracker.acquire_anew(await in_thread(self._eye.search)):
            return "searching all"
        return None

    async def _find_other_width(self) -> LineState | None:
        """A sure line that is not as wide as it was said to be, if for a while no other came into view."""
        if now() - self._started < OTHER_WIDTH_S:
            return None
        for line in await in_thread(self._eye.search):
            if line.confidence >= SURE_CONFIDENCE and self.tracker.see([line]):
                width = line.width * self.view.metres_per_pixel
                self._eye.expect(width)
                said = f"line_width = {self.config.line_width:g}"
                self.report(f"the line looks {width:.3f} m wide instead of {said}: followed as it looks")
                return "tracking"
        return None

    def _enter(self, state: LineState) -> None:
        if state != self._state:
            self._state = state
            self._publish()

    def _publish(self) -> None:
        """Tell how it is going, and what the line has shown since."""
        tracker, state = self.tracker, self.bus.odometry.latest
        unseen = tracker.lost(state.travelled) if state is not None else 0.0
        found = self._state in ("tracking", "searching near", "searching all")
        sure = tracker.confidence * (1.0 if found else max(0.0, 1.0 - unseen / self.config.coast))
        steering = self._steering
        offset, error = (steering.offset, steering.heading_error) if steering is not None else (0.0, 0.0)
        self.bus.line_status.publish(LineStatus(now(), self.name, self._state, sure, offset, error, unseen))
        if (motion := tracker.take_motion()) is not None:
            self.bus.line_motion.publish(motion)
        points, travelled = tracker.finished()
        if len(points):
            self.bus.line_points.publish(LinePoints(now(), self.name, points, travelled))

    def _reconsider(self, state: OdometryState) -> None:
        """Forget the memory if the robot was carried or driven away from it."""
        path = self.tracker.path
        if len(path) and np.hypot(path[:, 0] - state.pose.x, path[:, 1] - state.pose.y).min() > 0.5:
            self.tracker.reset()
