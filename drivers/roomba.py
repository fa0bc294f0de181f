"""The robot base: an iRobot Roomba 500/600 or Create 2 over its Open Interface.

The base obeys its last command for ever. So commands expire here after 0.2 s, every way out sends zero velocity,
Passive and Stop, and only Safe mode is used, in which the base itself brakes at cliffs and dropped wheels. It leaves
that mode without saying so; packet 35 of the sensor stream tells. While nobody wants to move it is in Passive mode,
because only there it charges, and an abandoned robot does not drain its battery.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping

from .. import oi
from ..bus import Bus
from ..clock import now
from ..config import Calibration
from ..errors import DriverFault
from ..hardware import Hardware
from ..plugin import Driver
from ..records import SensorFrame
from ..roomba.battery import BatteryWatch, charge_fraction
from ..roomba.encoders import WheelEncoders
from ..roomba.firmware import Firmware, keep_alive_s
from ..roomba.line import START_S, LineCounters, RoombaLine
from ..roomba.modes import ON_CHARGER, SETTLE_S, ModeReader, cliffs, hazards, is_charging, is_docked, tells_new
from ..roomba.settings import RoombaConfig
from ..roomba.slip import SlipDetector
from ..roomba.speeds import WheelSpeeds, wheel_speeds
from ..roomba.wake import WakeLine

COMMAND_S = 0.2  # a drive command's life
SILENCE_S = 0.15
STALLED_S = 0.2  # a line that only stalled is waited for so much longer
LATE_S = 0.02
REARM_S = 0.5
UNDOCK_S = 5.0  # between two tries to arm on the charger, because changing modes there can freeze the robot
TRIES = 3  # to enter Safe mode, before the numbering of the modes is learnt again and the operator told
NEW_WISH_S = 2.0  # a wish to move after a pause of so long is a new one
TEND_S = 1.0
SELF_MOVED_S, SELF_MOVED = 1.0, 0.05  # s in Passive mode, m/s: nobody pushes both wheels like this for long
TRY_AGAIN_S = 5.0  # between two tries to stop what the robot does by itself, or to reach one that does not obey
REST_AFTER_S = 5.0  # in Passive mode
REST_S = 0.075  # then frames are looked at in bunches of six or seven: 66 times a second would cost a Pi 6 % of a core
AGAIN_S = 30.0  # until the same kind of trouble is told again
ZERO = oi.encode("drive_direct", 0, 0)
START, SAFE, STOP = oi.encode("start"), oi.encode("safe"), oi.encode("stop")


class RoombaDriver(Driver):
    """Publishes SensorFrames at 66.7 Hz and drives the wheels; see robotd.plugin.Base.

    Attributes
    ----------
    counters : LineCounters
        Good, damaged, missing and late frames since the robot was found.
    firmware : Firmware or None
        As the robot printed it; most never do.
    """

    kind = "base"
    Config = RoombaConfig
    config: RoombaConfig

    def __init__(self, name: str, config: RoombaConfig, hardware: Hardware, bus: Bus, calibration: Calibration) -> None:
        super().__init__(name, config, hardware, bus, calibration)
        self.firmware: Firmware | None = None
        self._counters = LineCounters()
        self._resets = 0
        self._line: RoombaLine | None = None
        self._warned: dict[str, float] = {}
        self._reset()

    def _reset(self) -> None:
        config = self.config
        self._timer: asyncio.TimerHandle | None = None
        self._expiry = 0.0
        self._modes = ModeReader()
        self._mode = "unknown"  # as last told
        self._speeds = WheelSpeeds(config.speed_step)
        self._told_mm_s = (0, 0)
        self._encoders = WheelEncoders(config.encoders)
        self._slip = SlipDetector()
        self._battery = BatteryWatch(config.low_charge, config.low_voltage)
        self._t: float | None = None  # of the last frame
        self._values: Mapping[int, int] = {}
        self._wish, self._wish_end = 0.0, 0.0  # last call of `arm`, and until when it counts
        self._dropped = False  # out of Safe mode, not by us
        self._next_arm, self._tries = 0.0, 0
        self._blocked: str | None = None  # why it is not armed, as last told
        self._is_docking = False
        self._passive_t = 0.0  # since when the robot is in Passive mode
        self._settled_t = 0.0  # from when on the mode is believed
        self._must_learn = False  # how the modes are numbered, at that time
        self._next_tend = self._next_pulse = self._next_try = 0.0

    @property
    def counters(self) -> LineCounters:
        return self._line.counters if self._line is not None else self._counters

    # ---- life cycle --------------------------------------------------------------------------------------------------

    async def open(self) -> None:
        """Find the robot and start the sensor stream; it is in Passive mode then.

        Raises
        ------
        DriverFault
            No port, or nothing that looks like a sensor stream at any baud rate, also after a wake pulse.
        """
        config = self.config
        link = await self.hardware.open_serial(config.port, config.baud)
        self._reset()
        self.resources.callback(link.close)
        wake = WakeLine(link)
        if config.wake_pin is not None:
            wake.use_pin(self.hardware, config.wake_pin, config.wake_polarity, self.resources)
        line = self._line = RoombaLine(link, wake, config.baud, config.checksum, self.report)
        self.resources.callback(self._leave, line)
        try:
            await line.connect()
        except DriverFault as fault:
            raise DriverFault(f"{self.name}: {config.port}: {fault}") from fault
        self._learn(line)
        how = "" if line.reading is not None else "; it does not tell its mode, which is inferred from what it does"
        self.report(f"base found on {config.port} at {line.baud} baud{how}")

    async def run(self) -> None:
        """Decode the stream until cancelled; raises DriverFault when it stays silent or the port is gone."""
        line = self._line
        assert line is not None, "run is called after open"
        deadline = now() + SILENCE_S
        while True:
            try:
                async with asyncio.timeout_at(deadline) as limit:
                    while True:
                        frames = await line.read()
                        if not frames:
                            continue
                        self._take_all(line, frames)
                        deadline = line.arrived + SILENCE_S
                        if self._rests:
                            line.rest(REST_S)
                            deadline += REST_S
                        limit.reschedule(deadline)
            except TimeoutError:
                self.halt()
                if now() - deadline > LATE_S:  # this process was late, so frames may be waiting
                    deadline = now() + LATE_S
                    continue
                await self._revive(line)
                deadline = now() + SILENCE_S

    def _take_all(self, line: RoombaLine, frames: list[tuple[float, Mapping[int, int]]]) -> None:
        last = len(frames) - 1
        for k, (t, values) in enumerate(frames):
            if k == last or not self._rests or tells_new(values, self._values):
                self._take(t, values)
        self._decide(line)

    @property
    def _rests(self) -> bool:
        """Whether the robot stands in Passive mode, and nobody has wanted to move it for a while."""
        t = now()
        return (
            self._modes.mode == "passive"
            and not self._is_docking
            and not self._must_learn
            and t >= max(self._wish_end, self._settled_t, self._passive_t + REST_AFTER_S)
        )

    async def _revive(self, line: RoombaLine) -> None:
        """The stream is silent: wait for a line that only stalled, ask again, wake a robot that fell asleep."""
        since = line.arrived
        try:
            async with asyncio.timeout(STALLED_S):
                while not (frames := await line.read()):
                    pass
            self._take_all(line, frames)
            self._warn("stall", f"the sensor stream stalled for {now() - since:.2f} s; the robot was halted")
            return
        except TimeoutError:
            pass
        self._note_news(line)
        may_sleep = self._modes.mode != "safe" and not self._is_docking
        docked = is_docked(self._values)
        if await line.greet_again():
            self._learn(line)
            self._warn("stop", "the sensor stream had stopped and was started again")
            return
        if may_sleep and await line.wake_up():
            self._learn(line)
            self.report(f"the robot had fallen asleep and was woken after {now() - since:.1f} s", "warning")
            return
        mend = "check that the robot is awake and the cable is in"
        if may_sleep:
            mend = "it fell asleep and does not wake: press Clean once; not every cable has the wake line, see wake_pin"
            if docked:
                mend = "it sleeps on the charger, where the wake line may do nothing: press Clean once or lift it off"
        raise DriverFault(
            f"{self.name}: no sensor frame on {self.config.port} for {now() - since:.2f} s, halted; {mend}; a robot "
            "that stays mute answers again after its battery was out for a minute"
        )

    def _learn(self, line: RoombaLine) -> None:
        """The robot has just been told Start."""
        self._modes.learn(line.reading)
        self._mode = "passive"
        self._blocked, self._tries, self._is_docking, self._must_learn = None, 0, False, False
        self._told_mm_s = self._speeds.command(now(), 0.0, 0.0)
        self._passive_t = now()
        self._note_news(line)
        self._next_pulse = now() + keep_alive_s(self.firmware)

    def _leave(self, line: RoombaLine) -> None:
        """Zero velocity, Passive, Off; on the charger Passive, because changing modes there can freeze the robot."""
        self._counters, self._line = line.counters, None
        if self._timer is not None:
            self._timer.cancel()
        stop_program = SAFE + ZERO if self._is_docking else b""
        if is_charging(self._values):
            line.send(ZERO, START, oi.encode("stream"))
        else:
            line.send(stop_program, ZERO, START, STOP)

    # ---- motion ------------------------------------------------------------------------------------------------------

    def drive(self, speed: float, turn_rate: float) -> None:
        """Set speed (m/s) and turn rate (rad/s, counter-clockwise) until the next command or for 0.2 s.

        Both are slowed down together where a wheel would exceed 0.3 m/s. Does nothing while the base is not open, is
        docking, or nobody has armed it.
        """
        if self._line is None or self._t is None or self._is_docking:
            return
        if not (self._is_armed or any(self._told_mm_s)):
            return
        self._set_wheels(self._line, *wheel_speeds(speed, turn_rate, self.calibration.wheels.base))
        self._expiry = now() + COMMAND_S
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_at(self._expiry, self._expire)

    def halt(self) -> None:
        """Zero velocity at once; also ends docking."""
        if self._line is None or self._t is None:
            return
        if self._is_docking:
            self._stop_program(self._line)
        self._set_wheels(self._line, 0.0, 0.0)

    def arm(self) -> None:
        """Be in Safe mode, in which the wheels obey, until `disarm_s` after the last call; not while docking."""
        if self._is_docking:
            return
        t = now()
        if t - self._wish > NEW_WISH_S:
            self._dropped, self._blocked = False, None
        self._wish, self._wish_end = t, t + self.config.disarm_s
        if self._line is not None:
            self._line.rest(0.0)
        if self._line is not None and self._modes.mode != "safe" and self._t is not None:
            self._try_to_arm(self._line)

    async def dock(self) -> None:
        """Have the robot seek its dock; returns when it charges.

        Raises
        ------
        DriverFault
            The base is not open or cannot drive (in words), `halt` was called, the base failed on the way, or it does
            not charge after `dock_s`.
        """
        line, values = self._line, self._values
        if line is None or self._t is None:
            raise DriverFault(f"{self.name}: cannot dock: the base is not open")
        if is_charging(values):
            return
        if self._is_docking:
            raise DriverFault(f"{self.name}: is docking already")
        against = hazards(values)
        if ON_CHARGER in against:
            raise DriverFault(f"{self.name}: it is on the charger but does not charge; clean the contacts of both")
        if against:
            raise DriverFault(f"{self.name}: cannot dock: {' and '.join(against)}")
        self._set_wheels(line, 0.0, 0.0)
        self._is_docking, self._wish_end = True, 0.0
        line.rest(0.0)
        self._go_passive(line, oi.encode("dock"))  # once, because a second one would pause it
        self.report("seeking the dock")
        try:
            async with asyncio.timeout(self.config.dock_s):
                while self._is_docking and self._line is line:
                    if is_charging(self._values):
                        self.report("docked and charging")
                        return
                    await asyncio.sleep(oi.TICK)
        except TimeoutError:
            raise DriverFault(
                f"{self.name}: not on the charger within {self.config.dock_s:g} s; put it in front of the dock, at "
                "most 2 m away, and check that the dock has power"
            ) from None
        finally:
            if self._is_docking and self._line is line and not is_charging(self._values):
                self._stop_program(line)
            self._is_docking = False
        raise DriverFault(f"{self.name}: docking was interrupted")

    @property
    def _is_armed(self) -> bool:
        return now() < self._wish_end

    def _set_wheels(self, line: RoombaLine, right: float, left: float) -> None:
        self._told_mm_s = self._speeds.command(now(), right, left)
        line.send(oi.encode("drive_direct", *self._told_mm_s))

    def _expire(self) -> None:
        self._timer = None
        if now() < self._expiry:
            self._timer = asyncio.get_running_loop().call_at(self._expiry, self._expire)
        elif any(self._told_mm_s) and self._line is not None:
            self._set_wheels(self._line, 0.0, 0.0)

    def _stop_program(self, line: RoombaLine) -> None:
        """End what the robot does by itself: only a change to Safe mode does."""
        self._is_docking = False
        self._go_passive(line, SAFE, ZERO, START)

    # ---- the stream --------------------------------------------------------------------------------------------------

    def _take(self, t: float, values: Mapping[int, int]) -> None:
        """One frame: what mode, which way, and does the floor agree?"""
        elapsed = oi.TICK if self._t is None else t - self._t
        self._t, self._values = t, values
        mode = self._modes.update(t, elapsed, values, self._told_mm_s)
        obeys = mode == "safe"
        encoders, told = self._encoders, self._speeds.sent if obeys else (0.0, 0.0)
        resets = encoders.resets
        trouble = encoders.update(elapsed, values[43], values[44], self._speeds.sent, known=obeys)
        if trouble is not None:
            self.report(trouble, "warning")
        self._resets += encoders.resets - resets
        currents = (values[55], values[54]) if 55 in values else None
        slip = self._slip.update(elapsed, told, encoders.speeds, values[14], currents, values.get(58))
        if slip is not None and obeys:
            self._warn("slip", f"odometry is doubtful: {slip}")
        bits, docked = values[7], is_docked(values)
        voltage, charge = values[22] / 1000.0, charge_fraction(values)
        warning = self._battery.update(t, voltage, charge, charging=docked)
        if warning is not None:
            self.report(warning, "warning")
        self.bus.sensors.publish(
            SensorFrame(
                t=t,
                left=encoders.left,
                right=encoders.right,
                mode=mode,
                bump_left=bool(bits & 2),
                bump_right=bool(bits & 1),
                wheel_drop_left=bool(bits & 8),
                wheel_drop_right=bool(bits & 4),
                cliff=bool(cliffs(values)),
                overcurrent=bool(values[14]),
                voltage=voltage,
                charge_fraction=charge,
                slipping=slip is not None or self._is_docking,
                docked=docked,
                charging=is_charging(values),
                resets=self._resets,
            )
        )

    # ---- modes -------------------------------------------------------------------------------------------------------

    def _decide(self, line: RoombaLine) -> None:
        """After a chunk of frames: which mode should the robot be in?"""
        t, modes = now(), self._modes
        if t >= self._next_tend:
            self._next_tend = t + TEND_S
            self._tend(line, t)
        if t < self._settled_t:
            return
        if self._must_learn:
            modes.learn(self._values.get(35))
            self._must_learn = False
        if modes.mode != self._mode:
            self._tell_mode(modes.mode)
        if modes.mode == "full":
            self._renumber(line)
        elif modes.mode == "safe" and self._slip.is_stuck and t >= self._next_try:
            self._next_try = t + TRY_AGAIN_S
            self._renumber(line)
        elif self._is_armed:
            if modes.mode != "safe":
                self._try_to_arm(line)
        elif modes.mode == "safe":
            self._go_passive(line, ZERO, START)
            self.report("nobody wants to move: in passive mode, in which the robot can charge")

    def _go_passive(self, line: RoombaLine, *commands: bytes) -> None:
        """Send commands that end in Passive mode; readings from before it do not count."""
        t = now()
        line.send(*commands)
        self._modes.command(t, "passive")
        self._mode, self._passive_t, self._settled_t = "passive", t, t + SETTLE_S

    def _renumber(self, line: RoombaLine) -> None:
        """Learn anew how this firmware numbers its modes: after Start it is in Passive mode."""
        self._go_passive(line, ZERO, START)
        self._must_learn = True
        self._next_arm = self._settled_t = now() + START_S

    def _tell_mode(self, mode: str) -> None:
        """Name the cause when the base leaves Safe mode by itself."""
        if self._mode == "safe":
            self._dropped, self._passive_t = True, now()
            self._next_arm = now() + REARM_S
            self._blocked = " and ".join(hazards(self._values)) or None
            why = " and ".join(self._modes.causes(self._t or 0.0))
            if not why:
                why = "for an unknown reason" if 18 in self._values else "perhaps a button"
            self.report(f"the base left safe mode for {mode} mode: {why}", "warning")
        elif mode == "safe":
            self.report("the base is in safe mode")
            self._tries, self._blocked = 0, None
        if mode == "full":
            self.report("the base is in full mode, in which it does not brake at cliffs: refused", "error")
        self._mode = mode

    def _try_to_arm(self, line: RoombaLine) -> None:
        """Go to Safe mode unless something speaks against it, which is told once."""
        t = now()
        if self._is_docking or t < max(self._next_arm, self._settled_t):
            return
        against = self._against_arming()
        if against is not None:
            if against != self._blocked:
                self.report(f"the base stays in {self._modes.mode} mode: {against}", "warning")
            self._blocked = against
            return
        self._tries += 1
        if self._tries == TRIES + 1:
            self.report(f"the base does not enter safe mode after {TRIES} tries; press Clean once", "warning")
        if self._tries % (TRIES + 1) == 0 or (self._modes.is_odd and self._tries % 2):
            self._renumber(line)
            return
        self._next_arm = t + (UNDOCK_S if is_docked(self._values) else REARM_S)
        self._modes.command(t, "safe")
        line.send(SAFE, ZERO)

    def _against_arming(self) -> str | None:
        values, policy = self._values, self.config.rearm
        if is_docked(values) and not self.config.leave_dock:
            return "it is on the charger (leave_dock = false)"
        if self._dropped and policy == "never":
            return f'it left safe mode and rearm = "never": stop asking for motion for {NEW_WISH_S:g} s, then ask again'
        if policy != "always":
            found = [words for words in hazards(values) if words != ON_CHARGER]
            return " and ".join(found) or None
        return None

    # ---- now and then ------------------------------------------------------------------------------------------------

    def _tend(self, line: RoombaLine, t: float) -> None:
        """Once a second: keep it awake, see that it does not drive by itself, and what it said."""
        self._note_news(line)
        if (complaint := line.complaint()) is not None:
            self.report(complaint, "warning")
        if self._modes.mode == "safe" or self._is_docking:
            self._next_pulse = t + keep_alive_s(self.firmware)
            return
        docked = is_docked(self._values)
        if t >= self._next_pulse:
            self._next_pulse = t + keep_alive_s(self.firmware)
            line.wake.pulse()
            if not docked:
                line.send(START)  # because some cables have no wake line; the mode stays as it is
        moves = min(map(abs, self._encoders.speeds)) > SELF_MOVED
        if moves and not docked and t - self._passive_t > SELF_MOVED_S and t >= self._next_try:
            self._next_try = t + TRY_AGAIN_S
            self._stop_program(line)
            self.report("the robot drove by itself (a cleaning program?) and was stopped", "warning")

    def _warn(self, kind: str, text: str) -> None:
        """Tell of a trouble that may come again and again, once in a while."""
        t = now()
        if t - self._warned.get(kind, -AGAIN_S) >= AGAIN_S:
            self._warned[kind] = t
            self.report(text, "warning")

    def _note_news(self, line: RoombaLine) -> None:
        news, line.news = line.news, []
        for item in news:
            if isinstance(item, Firmware):
                if item != self.firmware:
                    traps = "".join(f"; {trap}" for trap in item.traps)
                    self.report(f"the robot's firmware is {item.name}{traps}")
                self.firmware = item
            elif item == "reset":
                self.report("the robot restarted by itself", "warning")
            else:
                self.report("the robot says that it goes to sleep", "warning")
