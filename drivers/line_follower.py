"""Follow a line on the floor: frames in, drive commands out."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from robotd.bind import ranged
from robotd.bus import Bus, Subscription
from robotd.clock import in_thread, now
from robotd.config import Calibration
from robotd.errors import ConfigError, MissionError
from robotd.follow import FollowConfig, PathFollower
from robotd.hardware import Hardware
from robotd.plugin import Driver
from robotd.records import DriveCommand, Frame, Line, OdometryState
from robotd.vision.line_tracker import LineTracker, PoseHistory
from robotd.vision.stroke import LineConfig, LineDetector
from robotd.vision.top_view import TopView

WIDTH_TOLERANCE = 0.25  # the tape may be that much narrower or wider in the top view than it is said to be
FIRST_SIGHT_S = 3.0  # a standing robot waits this long for a line
STANDSTILL_M_S = 0.002
STANDSTILL_S = 0.15  # longer than the window over which odometry takes its speed


@dataclass(frozen=True, slots=True)
class LineFollowerConfig:
    """[drivers.<name>] of a `line_follower`; metres and seconds."""

    camera: str = "floor"
    line_width: float = ranged(0.050, minimum=0.005, maximum=0.2)
    color: Literal["dark", "bright", "both"] = "dark"
    cruise: float = ranged(0.22, minimum=0.03, maximum=0.30)
    acceleration: float = ranged(0.30, minimum=0.05, maximum=0.5)
    coast: float = ranged(0.30, minimum=0.05, maximum=0.30)
    metres_per_pixel: float = ranged(0.0035, minimum=0.001, maximum=0.02)
    readout: float = ranged(0.030, minimum=0.0, maximum=0.1)
    view_near: float = ranged(0.20, minimum=0.0, maximum=2.0)
    view_far: float = ranged(1.05, minimum=0.1, maximum=5.0)
    view_side: float = ranged(0.45, minimum=0.05, maximum=3.0)

    def __post_init__(self) -> None:
        if self.view_far <= self.view_near:
            raise ValueError(f"view_far = {self.view_far:g}; expected more than view_near = {self.view_near:g}")


class LineFollowerDriver(Driver):
    """Finds the line in the floor camera's frames, remembers it, and steers along it.

    Attributes
    ----------
    latest_line : tuple of Line
        What the detector found in the last frame, in pixels of `view`.
    tracker : LineTracker
        Its `path` is the line as remembered.
    """

    kind: ClassVar[str] = "follower"
    Config = LineFollowerConfig
    config: LineFollowerConfig

    def __init__(
        self, name: str, config: LineFollowerConfig, hardware: Hardware, bus: Bus, calibration: Calibration
    ) -> None:
        super().__init__(name, config, hardware, bus, calibration)
        model = calibration.floor_camera
        if model is None:
            raise ConfigError(f"{name}: the calibration has no [floor_camera]; calibrate '{config.camera}' first")
        try:
            self.view = TopView(
                model,
                config.metres_per_pixel,
                (config.view_near, config.view_far),
                (-config.view_side, config.view_side),
            )
        except ValueError as error:
            raise ConfigError(f"{name}: {error}") from error
        self._rows = model.size[1]
        width = config.line_width / config.metres_per_pixel
        width_px = max(width * (1.0 - WIDTH_TOLERANCE), 1.0), max(width * (1.0 + WIDTH_TOLERANCE), 1.0)
        self._detector = LineDetector(LineConfig(config.color, width_px))
        self.latest_line: tuple[Line, ...] = ()
        self._follower = PathFollower(
            FollowConfig(cruise=config.cruise, acceleration=config.acceleration, coast=config.coast)
        )
        self._forget()

    def _forget(self) -> None:
        self.tracker = LineTracker(self.view, self.config.readout / self._rows)
        self._history = PoseHistory()
        self._fresh: Frame | None = None

    async def open(self) -> None:
        """Start without any memory; the camera belongs to a driver of its own."""
        self._forget()

    async def run(self) -> None:
        """Nothing by itself: the mission calls `follow`."""
        await asyncio.Event().wait()

    async def follow(self, travelled: float) -> None:
        """Drive along the line until odometry says `travelled` metres, then halt.

        Raises
        ------
        MissionError
            There is no line, or it was lost, or it ended; the robot has been told to halt.
        """
        self._follower.reset()
        with self.bus.frames(self.config.camera).subscribe(size=2) as frames:
            watching = asyncio.create_task(self._watch(frames))
            try:
                await self._drive(travelled, watching)
            finally:
                self._command(0.0, 0.0)
                watching.cancel()
                await asyncio.wait([watching])
        if not watching.cancelled():
            watching.result()  # a bug there must not go unseen

    async def _drive(self, travelled: float, watching: asyncio.Task[None]) -> None:
        started = before = now()
        standing: float | None = None
        with self.bus.odometry.subscribe(size=4) as odometry:
            async for state in odometry:
                if watching.done():
                    return
                self._history.add(state.t, state.pose)
                dt, before = min(max(state.t - before, 0.0), 0.1), state.t
                path = self.tracker.path
                if len(path) < 2:
                    if now() - started > FIRST_SIGHT_S:
                        raise MissionError(
                            f"no line in view of {self.config.camera} for {FIRST_SIGHT_S:g} s;"
                            " put the robot on the line, heading along it"
                        )
                    self._command(0.0, 0.0)
                    continue
                remaining = travelled - state.travelled
                lost = self.tracker.lost(state.travelled)
                steering = self._follower.steer(path, state.pose, remaining, lost=lost, dt=dt)
                self._command(steering.speed, steering.turn_rate)
                if steering.halted:
                    raise MissionError(self._lost_in_words(lost, steering.beyond))
                if remaining > 0.0 or abs(state.speed) > STANDSTILL_M_S:
                    standing = None
                elif standing is None:
                    standing = state.t
                elif state.t - standing >= STANDSTILL_S:
                    return

    def _lost_in_words(self, lost: float, beyond: float) -> str:
        if beyond > lost:
            return (
                f"the line ended {beyond:.2f} m behind the robot; shorten the mission's stops or put the robot"
                " back on the line"
            )
        return f"line lost: not seen by {self.config.camera} for {lost:.2f} m; put the robot back on the line"

    def _command(self, speed: float, turn_rate: float) -> None:
        self.bus.commands.publish(DriveCommand(now(), speed, turn_rate, self.name))

    async def _watch(self, frames: Subscription[Frame]) -> None:
        """Find the line in every frame; in a thread, because that takes milliseconds."""
        async for frame in frames:
            # because a hung camera repeats its last image, and a real one never gives the same twice
            frozen = self._fresh is not None and np.array_equal(self._fresh.image, frame.image)
            self._fresh = frame
            self.latest_line = () if frozen else tuple(await in_thread(self._detect, frame))
            state = self.bus.odometry.latest
            if state is None:
                continue
            self._reconsider(state)
            self.tracker.observe(self.latest_line, frame.t, self._history, state.travelled)

    def _detect(self, frame: Frame) -> list[Line]:
        return self._detector.detect(self.view.apply(frame.image), self.view.valid)

    def _reconsider(self, state: OdometryState) -> None:
        """Forget the memory if the robot was carried or driven away from it."""
        path = self.tracker.path
        if len(path) and np.hypot(path[:, 0] - state.pose.x, path[:, 1] - state.pose.y).min() > 0.5:
            self.tracker.reset()
