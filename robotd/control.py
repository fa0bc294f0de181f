"""The control loop: sensor frames in, odometry and safe motion out, in the pace of the base's sensor stream."""

from __future__ import annotations

import asyncio
from typing import Literal

from .bus import Bus
from .clock import now
from .notify import notify, watchdog_s
from .odometry import Odometry
from .plugin import Base
from .records import Event
from .safety import SafetyGate

WATCH_S = 0.020  # the loop's own tick, for when sensor frames stop coming
REST_AFTER_S = 5.0  # without a wish to move
REST_TICKS = 3  # then the loop ticks so much more seldom, because waking up 50 times a second takes a Pi 1 % of a core
BACKLOG = 512  # frames: more than come in the 5 s after which systemd ends a loop that hangs
STEADY_S = 1.0  # of motion after a stop


class ControlLoop:
    """Sensor frames in, odometry and safe motion out; ticks by itself when sensor frames stop coming.

    Attributes
    ----------
    cause : str or None
        Why the wheels are held at zero now, in words.
    """

    def __init__(self, bus: Bus, base: Base, odometry: Odometry, gate: SafetyGate) -> None:
        self.bus = bus
        self.base = base
        self.odometry = odometry
        self.gate = gate
        self.cause: str | None = "starting"
        self._last = 0.0
        self._wished = -float("inf")  # when the last wish came
        self._is_moving = False
        self._stopped: str | None = None  # why it does not move any more
        self._latched: str | None = None
        self._moving_since: float | None = None
        self._watchdog = watchdog_s()
        self._fed = -float("inf")

    async def run(self) -> None:
        """Until cancelled; the base is halted on the way out."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._follow_sensors())
                group.create_task(self._follow_wishes())
                group.create_task(self._follow_withdrawals())
                group.create_task(self._watch())
        finally:
            self.base.halt()

    def emergency_stop(self, cause: str) -> None:
        """Halt at once and hold until `release`; `cause` says who asked for it or why."""
        self.gate.emergency_stop(cause)
        self.base.halt()  # also what the base does by itself: docking
        self._steer()

    def release(self, who: str) -> None:
        """End the emergency stop, an operator's stop and the hazards that are gone; a new wish moves the robot."""
        held = self.gate.latched
        self.gate.release()
        self._tell_freed(held, f"released by {who}")

    def resume(self, who: str) -> None:
        """As `release`, but an emergency stop stays: for whoever starts or resumes a mission."""
        held = self.gate.latched
        self.gate.resume()
        self._tell_freed(held, f"resumed by {who}")

    async def _follow_sensors(self) -> None:
        with self.bus.sensors.subscribe(size=BACKLOG) as sensors:
            async for frame in sensors:
                self.gate.sensors(frame)
                state = self.odometry.update(frame.t, frame.left, frame.right, frame.slipping, frame.resets)
                self.bus.odometry.publish(state)
                if frame is self.bus.sensors.latest:  # not for each of a backlog, which would flood the line
                    self._steer()

    async def _follow_wishes(self) -> None:
        with self.bus.commands.subscribe() as wishes:
            async for wish in wishes:
                self.gate.command(wish)
                was_resting, self._wished = self.is_resting, now()
                if was_resting:  # because the next sensor frame may be a tenth of a second away
                    self._steer()

    async def _follow_withdrawals(self) -> None:
        with self.bus.withdrawals.subscribe() as withdrawals:
            async for withdrawal in withdrawals:
                self.gate.withdraw(withdrawal.source, withdrawal.cause, withdrawal.t)
                if withdrawal.source is None:
                    self.base.halt()
                self._steer()

    async def _watch(self) -> None:
        start, tick = now(), 0
        while True:
            await asyncio.sleep(max(0.0, start + tick * WATCH_S - now()))
            if now() - self._last >= WATCH_S:
                self._steer()
            tick += REST_TICKS if self.is_resting and self.gate.limits.loop_s > 1.5 * REST_TICKS * WATCH_S else 1

    @property
    def is_resting(self) -> bool:
        """Whether it stands, and nobody has wished to move it for a while."""
        return not self._is_moving and now() - self._wished > REST_AFTER_S

    def _steer(self) -> None:
        t = self._last = now()
        motion = self.gate.output(t)
        if motion.arm:
            self.base.arm()
        if motion.cause is not None and self._is_moving:
            self.base.halt()
        else:
            self.base.drive(motion.speed, motion.turn_rate)
        self.cause = motion.cause
        self._tell(motion.speed != 0.0 or motion.turn_rate != 0.0)
        if self._watchdog is not None and t - self._fed >= self._watchdog:
            self._fed = t  # fed here and nowhere else: a stuck control loop must be noticed
            notify("WATCHDOG=1")

    # ---- what a person wants to know ---------------------------------------------------------------------------------

    def _tell(self, is_moving: bool) -> None:
        """Tell of a stop from motion, of what holds the robot from now on, and of its moving on.

        It moves on when it has moved for a second; until then further stops for the same reason are not told.
        """
        latched = self.gate.latched
        if self.cause is not None and self._is_moving:
            if self._stopped is None or _kind(self._stopped) != _kind(self.cause):
                self._publish(f"stopped: {self.cause}" + ("" if latched is None else "; held until released"))
            self._stopped = self.cause
        elif latched is not None and latched != self._latched:
            self._publish(f"held until released: {latched}")
        if not is_moving:
            self._moving_since = None
        elif self._moving_since is None:
            self._moving_since = self._last
        elif self._stopped is not None and self._last - self._moving_since >= STEADY_S:
            self._publish(f"moving again after: {self._stopped}", "info")
            self._stopped = None
        self._is_moving, self._latched = is_moving, latched

    def _tell_freed(self, held: str | None, words: str) -> None:
        self._latched = self.gate.latched
        if held is not None:
            rest = "" if self._latched is None else f"; still held: {self._latched}"
            self._publish(f"{words}: {held}{rest}", "info")
        self._steer()

    def _publish(self, text: str, level: Literal["info", "warning"] = "warning") -> None:
        self.bus.events.publish(Event(now(), "safety", level, text))


def _kind(cause: str) -> str:
    return cause.split(":")[0]  # without the numbers
