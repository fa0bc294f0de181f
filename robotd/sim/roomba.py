"""The simulated Roomba: an Open Interface byte machine on 15 ms ticks, with motors, encoders and a battery.

`SimRoomba` does no I/O: bytes in, one tick at a time out. `RoombaLink` (robotd.sim.roomba_link) is the serial line to
it in loop time, robotd.sim.terminal a pseudo-terminal in real time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from .. import oi
from ..oi import FULL, OFF, PASSIVE, SAFE, TICK
from .battery import CAPACITY_MAH, Battery
from .dock import Dock
from .programs import Programs
from .quirks import LineFaults, RoombaQuirks
from .roomba_body import RoombaBody
from .roomba_replies import Replies
from .roomba_sensors import MOTOR_MA, cleaning_ma, packet_sources
from .roomba_text import PROCESSOR_SLEEP, READY, battery_line, boot_texts
from .wheel import Wheel

if TYPE_CHECKING:
    from .roomba_link import Power, RoombaLink

__all__ = ["CAPACITY_MAH", "LineFaults", "RoombaBody", "RoombaQuirks", "SimRoomba"]

WHEEL_BASE_MM = 235.0  # as the firmware believes
ROBOT_RADIUS_MM = 170.0
SLEEP_AFTER = 300.0  # s in Passive without a byte, a button or a pulse
WAKE_TIME = 0.5
BAUD_PAUSE = 0.1  # s of deafness after a change of the baud rate
BAUD_BACK = 0.9  # s after a reset
PRESSED = 1.0 / 6.0  # s
SHORT_PULSE = (0.05, 0.5)  # s: three of them set 19200 baud
PULSES_FROM = 2.0  # s after power-up
LEAST_PULSE = 0.01
IDLE_MA = 160.0
TOGGLE_S = 60.0  # two changes of mode within this time are a toggle
REVIVE_MAH = 5.0
CLEAN_ENDS = 0.1  # of the capacity: then it looks for its dock
MODES = ("off", "passive", "safe", "full")
BUTTONS = ("clean", "spot", "dock", "minute", "hour", "day", "schedule", "clock")  # bits of packet 18
_ACTUATORS = {
    "drive", "motors", "leds", "play", "pwm_motors", "drive_direct", "drive_pwm", "scheduling_leds",
    "digits_raw", "digits_ascii",
}  # fmt: skip
_CLEANING = {"spot", "clean", "max", "dock"}


class SimRoomba:
    """The robot's side of the Open Interface.

    Parameters
    ----------
    body : RoombaBody
        Moved by the wheels; says what the bumpers, cliff sensors and wheel switches feel.
    rng : numpy Generator
        Where the encoders start, what the robot does by chance, and the faults of the line.
    quirks : RoombaQuirks, optional

    Attributes
    ----------
    mode : int
        OFF, PASSIVE, SAFE or FULL of robotd.oi.
    baud : int
        What the robot's receiver and transmitter are set to now.
    is_asleep : bool
    battery : Battery
    left, right : Wheel
    overcurrent : int
        Packet 14; set from outside.
    dock : Dock or None
        Where its home base stands; set from outside. Without one, `set_docked` says whether it is docked.
    listener : callable or None
        Is told what happens, in words.
    link : RoombaLink or None
        Who is connected.
    power : Power or None
        What ticks it; None until the first link switches it on.
    """

    def __init__(self, body: RoombaBody, rng: np.random.Generator, quirks: RoombaQuirks | None = None) -> None:
        self.body = body
        self.quirks = quirks or RoombaQuirks()
        self.mode = OFF
        self.baud = self.quirks.baud
        self.is_asleep = False
        self.battery = Battery(self.quirks.gauge_error_mah)
        self.overcurrent = 0
        self.dock: Dock | None = None
        self.listener: Callable[[str], None] | None = None
        self.link: RoombaLink | None = None
        self.power: Power | None = None
        self.right = Wheel(int(rng.integers(0x10000)), self.quirks.acceleration)
        self.left = Wheel(int(rng.integers(0x10000)), self.quirks.acceleration)
        if self.quirks.encoder_start is not None:
            self.left.counts = self.right.counts = self.quirks.encoder_start
        own_rng, *self.line_rng = rng.spawn(3)  # its own choices, and the line's two directions
        self._t: float | None = None
        self._powered_at = 0.0
        self.is_docked = False
        self.is_plugged = False
        self.programs = Programs(own_rng, self.tell)
        self.radius_mm = 0
        self.cleaning_motors = (0.0, 0.0, 0.0)  # main brush, side brush, vacuum, -1..1
        self.leds = (0, 0, 0)  # bits, colour, intensity
        self._songs: dict[int, tuple[int, ...]] = {}
        self.song, self._song_end = 0, -1.0
        self._pressed: dict[str, float] = {}  # until when
        self._woken_by_clean = False
        self.is_after_cliff = False  # has dropped out of Safe mode at one, and was not told a mode since
        self._left_passive: float | None = None  # when, while on a charger
        self._last_active = 0.0
        self._boot_end: float | None = None
        self._baud_back: float | None = None
        self._deaf_until = self._frozen_until = -1.0
        self._is_mute, self._is_flat = False, False
        self._mute_at = self.quirks.mute_after
        self._next_line, self._lines = 0.0, 0
        self._short_pulses = 0
        self._parser = oi.CommandDecoder()
        self.replies = Replies(packet_sources(self), self.quirks)

    # ---- what the world does to it -----------------------------------------------------------------------------------

    def pulse_brc(self, seconds: float) -> None:
        """The wake line was low for so long; three pulses of 50 to 500 ms change the baud rate to 19200."""
        quirks = self.quirks
        if not quirks.brc_wired or (self.is_docked and not quirks.brc_works_on_dock) or seconds < LEAST_PULSE:
            return
        if self.is_asleep:
            if quirks.wakes_by_brc:
                self._wake("a pulse on the wake line")
            return
        if quirks.brc_keeps_awake:
            self._last_active = self.now
        if self.now - self._powered_at < PULSES_FROM:
            return
        self._short_pulses = self._short_pulses + 1 if SHORT_PULSE[0] <= seconds <= SHORT_PULSE[1] else 0
        if self._short_pulses == 3:
            self.baud, self._short_pulses = 19200, 0
            self.tell("three short pulses on the wake line: 19200 baud")

    def press(self, button: str, seconds: float = PRESSED) -> None:
        """Somebody presses one of `BUTTONS`.

        Clean wakes the robot or takes it out of Safe and Full mode. In Passive and Off, Clean, Spot and Dock start
        and pause the robot's own programs, as without an Open Interface.
        """
        if self._is_flat or self._boot_end is not None:
            return
        if self.quirks.clock_buttons_dead and button in ("clock", "schedule"):
            return
        self._pressed[button] = self.now + seconds
        self._last_active = self.now
        if self.is_asleep:
            if button == "clean":
                self._woken_by_clean = True
                self._wake("its Clean button")
        elif self.mode in (OFF, PASSIVE):
            if button in _CLEANING:
                self._toggle(button)
        elif button == "clean":
            self._set_mode(PASSIVE, "its Clean button")

    def press_clean(self) -> None:
        """Somebody presses the Clean button."""
        self.press("clean")

    def set_docked(self, is_docked: bool) -> None:
        """Put it on its home base, which ends Safe mode, or lift it off."""
        if is_docked == self.is_docked:
            return
        self.is_docked = is_docked
        self.tell("on its dock" if is_docked else "off its dock")
        if is_docked:
            self.programs.end()
            self._stop_wheels()
            self._next_line = self.now + 1.0
            if self.mode == SAFE:
                self._set_mode(PASSIVE, "it is on the charger")
        elif self.quirks.cleans_when_lifted_off_dock and self._woken_by_clean and self.mode == PASSIVE:
            self._toggle("clean")
        self._woken_by_clean = self._woken_by_clean and is_docked

    def set_plugged(self, is_plugged: bool) -> None:
        """Plug the mains charger into its side, or pull it out; while it is in, Safe mode ends at once."""
        self.is_plugged = is_plugged

    def pull_battery(self) -> None:
        """Take the battery out and put it back: everything is forgotten."""
        self._is_mute = self._is_flat = self.is_asleep = False
        self._mute_at = None
        self._powered_at = self.now
        self._songs.clear()
        self._frozen_until = -1.0
        self._boot("the battery was out", soft=False)

    # ---- bytes in ----------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Bytes that arrived at the robot, at its own baud rate."""
        if not self.is_listening:
            return
        self._last_active = self.now
        for command in self._parser.feed(data):
            if isinstance(command, oi.Command) and self.is_listening:
                self._obey(command.name, command.values)

    @property
    def charge_mah(self) -> float:
        """What is left in the battery."""
        return self.battery.charge_mah

    @property
    def is_at_charger(self) -> bool:
        """Docked or plugged in."""
        return self.is_docked or self.is_plugged

    @property
    def sees_cliff(self) -> bool:
        """Whether a front cliff sensor says that there is no floor."""
        return self.body.cliff or (self.is_docked and self.quirks.cliffs_on_dock)

    @property
    def is_playing(self) -> bool:
        """Whether a song is being played."""
        return self.now < self._song_end

    def pressed_buttons(self) -> int:
        """Packet 18."""
        return sum(self._pressed.get(button, -1.0) > self.now and 1 << bit for bit, button in enumerate(BUTTONS))

    @property
    def now(self) -> float:
        """Time of the last tick."""
        return self._t if self._t is not None else 0.0

    @property
    def is_listening(self) -> bool:
        """Whether it takes bytes at all."""
        return not (self.is_asleep or self._boot_end is not None or self._is_silent) and self.now >= self._deaf_until

    @property
    def _is_silent(self) -> bool:
        return self._is_mute or self._is_flat or self.now < self._frozen_until

    def tell(self, what: str) -> None:
        """Say to the listener what happens."""
        if self.listener is not None:
            self.listener(what)

    def _obey(self, name: str, values: tuple[int, ...]) -> None:
        if self.mode == OFF and name not in ("start", "reset"):
            return
        if name in _ACTUATORS and self.mode == PASSIVE:
            return
        if name == "start":
            self.replies.restart()
            self._set_mode(PASSIVE, "opcode 128")
        elif name == "reset":
            self._boot("opcode 7", soft=True)
        elif name in ("safe", "control", "full"):
            self._set_mode(FULL if name == "full" else SAFE, f"opcode {132 if name == 'full' else 131}")
        elif name in _CLEANING:
            running = self.programs.is_running
            self._set_mode(PASSIVE, f"command {name}")
            if not running:
                self._toggle(name)
        elif name == "power":
            self._set_mode(PASSIVE, "opcode 133")
            self._fall_asleep()
        elif name == "stop":
            self._set_mode(OFF, "opcode 173")
            self.replies.stop_stream()
        elif name == "baud" and values[0] < len(oi.BAUD_CODES):
            self.baud = oi.BAUD_CODES[values[0]]
            self._deaf_until = self.now + BAUD_PAUSE
            self._parser = oi.CommandDecoder()
            self.tell(f"{self.baud} baud")
        elif name in ("drive", "drive_direct", "drive_pwm"):
            self._drive(name, *values)
        elif name in ("motors", "pwm_motors"):
            self._run_motors(name, values)
        elif name == "leds":
            self.leds = values[0], values[1], values[2]
        elif name == "buttons" and not self.quirks.buttons_command_dead:
            for bit, button in enumerate(BUTTONS):
                if values[0] >> bit & 1:
                    self.press(button)
        elif name == "song" and values[0] <= 4:
            self._songs[values[0]] = values[1:]
        elif name == "play" and values[0] in self._songs and not self.is_playing:
            self.song = values[0]
            self._song_end = self.now + sum(self._songs[values[0]][1::2]) / 64.0
        elif name == "resume_stream":
            self.replies.pause(values[0] == 0)
        elif name in ("stream", "query", "sensors"):
            self.replies.ask(name, values, self.now)

    def _drive(self, name: str, first: int, second: int) -> None:
        right, left = float(first), float(second)
        self.radius_mm = 0
        if name == "drive_pwm":
            right, left = right * 500.0 / 255.0, left * 500.0 / 255.0
        elif name == "drive":
            right = left = max(-500.0, min(500.0, float(first)))
            self.radius_mm = second
            if second in (oi.SPIN_CLOCKWISE, oi.SPIN_COUNTER_CLOCKWISE):
                right, left = right * second, -left * second
            elif second not in (oi.STRAIGHT, oi.STRAIGHT_TOO, 0):
                radius = max(-2000, min(2000, second))
                right *= 1.0 + 0.5 * WHEEL_BASE_MM / radius
                left *= 1.0 - 0.5 * WHEEL_BASE_MM / radius
        self._command_wheels(right, left)

    def _command_wheels(self, right_mm_s: float, left_mm_s: float) -> None:
        before = self._motion
        self.right.command(right_mm_s)
        self.left.command(left_mm_s)
        if self._motion != before:
            self.tell(f"{self._motion}: left {self.left.requested_mm_s}, right {self.right.requested_mm_s} mm/s")

    @property
    def _motion(self) -> str:
        """What the wheels are told to do, in words."""
        right, left = self.right.target, self.left.target
        if not (right or left):
            return "stands"
        if right * left < 0.0:
            return "turns left" if right > left else "turns right"
        return "drives forward" if right + left > 0.0 else "drives backward"

    def _stop_wheels(self) -> None:
        self._command_wheels(0.0, 0.0)

    def _run_motors(self, name: str, values: tuple[int, ...]) -> None:
        if name == "pwm_motors":
            self.cleaning_motors = values[0] / 127.0, values[1] / 127.0, max(0, values[2]) / 127.0
            return
        bits = values[0]
        side, vacuum, brush = bits & 1, bits >> 1 & 1, bits >> 2 & 1
        self.cleaning_motors = brush * (1.0 - 2 * (bits >> 4 & 1)), side * (1.0 - 2 * (bits >> 3 & 1)), float(vacuum)

    # ---- modes, sleep, its own programs ------------------------------------------------------------------------------

    def _set_mode(self, mode: int, why: str) -> None:
        """Every command of a mode stops the wheels and the robot's own programs."""
        before, self.mode = self.mode, mode
        self.is_after_cliff = False
        self.programs.end()
        self._stop_wheels()
        if mode in (OFF, PASSIVE):
            self.cleaning_motors = 0.0, 0.0, 0.0
        elif before in (OFF, PASSIVE):
            self.leds = 0, 0, 0
        if mode == OFF:
            self._next_line = self.now + 1.0
        if mode != before:
            self.tell(f"mode {MODES[mode]}: {why}")
            self._notice_toggle(before)

    def _notice_toggle(self, before: int) -> None:
        """Freeze the line, where the firmware does so, when Safe or Full is left or entered again on the charger."""
        if not (self.quirks.freeze and self.is_at_charger):
            return
        was_passive, is_passive = before in (OFF, PASSIVE), self.mode in (OFF, PASSIVE)
        if was_passive == is_passive:
            return
        if is_passive and self._left_passive is not None and self.now - self._left_passive < TOGGLE_S:
            self._frozen_until = self.now + self.quirks.freeze
            self.tell(f"serial line frozen for {self.quirks.freeze:g} s")
        self._left_passive = None if is_passive else self.now

    def _toggle(self, name: str) -> None:
        """Start one of its own programs, or pause the one that runs."""
        if self.programs.is_running:
            self.programs.end()
            self._stop_wheels()
        else:
            self.programs.start(name, self.dock, is_docked=self.is_docked)

    def _behave(self, seconds: float) -> None:
        programs, body = self.programs, self.body
        if body.wheel_drop_left or body.wheel_drop_right:  # until it is set down
            self._stop_wheels()
            return
        if programs.name == "clean" and self.battery.charge_mah < CLEAN_ENDS * CAPACITY_MAH:
            programs.start("dock", self.dock, is_docked=False)
        speeds = programs.step(seconds, hits=body.bump_left or body.bump_right or body.cliff)
        self._command_wheels(*(speeds or (0.0, 0.0)))

    def _fall_asleep(self) -> None:
        self._stop_wheels()
        self.is_asleep = True
        self.tell("asleep")
        self.replies.say(self.now, PROCESSOR_SLEEP)

    def _wake(self, why: str) -> None:
        self.is_asleep = False
        self._last_active = self.now
        self._forget(f"woken by {why}")
        self._boot_end = self.now + WAKE_TIME

    def _boot(self, why: str, *, soft: bool) -> None:
        self._forget(f"reboots: {why}")
        self.left.counts = self.right.counts = self.quirks.encoder_start or 0
        self._boot_end = self.now + READY
        self._baud_back = self.now + (BAUD_BACK if soft else 0.0)
        for after, text in boot_texts(self.quirks.firmware, soft=soft):
            self.replies.say(self.now + after, text)

    def _forget(self, why: str) -> None:
        self._set_mode(OFF, why)
        self._parser = oi.CommandDecoder()
        self.replies.forget()
        self._deaf_until = self._song_end = -1.0

    # ---- one tick ----------------------------------------------------------------------------------------------------

    def tick(self, t: float) -> bytes:
        """Live until time `t`, one tick after the last; returns what the robot sends now, at its own baud rate."""
        if self._t is None:
            elapsed, self._powered_at = TICK, t
            self._last_active = t
        else:
            elapsed = t - self._t
        self._t = t
        body, left, right = self.body, self.left, self.right
        if self.programs.is_running:
            self._behave(elapsed)
        body.advance(t, left.ramp(elapsed), right.ramp(elapsed))
        left.measure(body.left_rotation)
        right.measure(body.right_rotation)
        if self.dock is not None:
            self.set_docked(
                self.dock.touches(is_docked=self.is_docked) and not (body.wheel_drop_left or body.wheel_drop_right)
            )
        self._use_battery(elapsed)
        if self.mode == SAFE:
            self._mind_hazards()
        self._mind_clock(t)
        if self._is_silent:
            return b""
        return self.replies.send(t, self.baud, is_streaming=self.mode != OFF and not self.is_asleep)

    def _mind_hazards(self) -> None:
        body = self.body
        if body.wheel_drop_left or body.wheel_drop_right:
            self._set_mode(PASSIVE, "a wheel dropped")
        elif self.is_plugged:
            self._set_mode(PASSIVE, "the charger is plugged in")
        elif self.sees_cliff and self._approaches():
            self._set_mode(PASSIVE, "a cliff")
            self.is_after_cliff = True

    def _mind_clock(self, t: float) -> None:
        """Boot, sleep and fall silent when it is time."""
        if self._baud_back is not None and t >= self._baud_back:
            self.baud, self._baud_back = self.quirks.baud, None
        if self._boot_end is not None and t >= self._boot_end:
            self._boot_end = None
            self._last_active = t
        idle = t - self._last_active
        if idle > SLEEP_AFTER and self.mode == PASSIVE and not self.is_asleep and not self.programs.is_running:
            self._fall_asleep()
        is_off = self.mode == OFF and not self.is_asleep and self._boot_end is None
        if is_off and self.is_at_charger and t >= self._next_line:
            self._next_line = t + 1.0
            self._lines += 1
            self.replies.say(t, battery_line(self._lines, self.battery))
        if self._mute_at is not None and t >= self._powered_at + self._mute_at:
            self._is_mute, self._mute_at = True, None
            self.tell("mute until the battery is taken out")

    def _approaches(self) -> bool:
        """Whether the wheels carry it forward, or backward in so tight a turn that the front swings out."""
        forward = 0.5 * (self.left.target + self.right.target)
        turn = self.right.target - self.left.target
        if forward >= 0.0:
            return forward > 0.0 or turn != 0.0
        return abs(forward) * WHEEL_BASE_MM < ROBOT_RADIUS_MM * abs(turn)

    def _use_battery(self, seconds: float) -> None:
        battery = self.battery
        charges = (
            self.is_at_charger and (self.is_asleep or self.mode in (OFF, PASSIVE)) and not self.programs.is_running
        )
        load = 2.0 if self.is_asleep or self._is_flat else IDLE_MA + cleaning_ma(self)
        battery.use(seconds, load + MOTOR_MA * (abs(self.left.speed) + abs(self.right.speed)), is_charging=charges)
        if battery.is_empty and not self._is_flat:
            self._forget("the battery is empty")
            self._is_flat, self.is_asleep = True, False
        elif self._is_flat and battery.charge_mah > REVIVE_MAH:
            self.pull_battery()
