"""What `robotd doctor` looks at on the computer itself.

Every check takes the root of the file system, so that tests can build one, and yields findings that say how to mend it.
"""

from __future__ import annotations

import grp
import os
import pwd
import stat
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from .errors import ConfigError
from .secret_file import read_secret

Level = Literal["ok", "note", "warning", "error"]
RULES = (
    "sudo install -D -m 644 etc/60-robotd.rules /etc/udev/rules.d/60-robotd.rules && sudo udevadm control --reload && "
    "sudo udevadm trigger"
)
USERS = "sudo install -D -m 644 systemd/robotd-sysusers.conf /etc/sysusers.d/robotd.conf && sudo systemd-sysusers"
FREE_MB, FEW_MB = 2000, 500
OLD_DAYS = 180
# bits of the firmware's get_throttled (Raspberry Pi documentation, vcgencmd): now, and since the boot
UNDER_VOLTAGE, WAS_UNDER_VOLTAGE, TOO_HOT, WAS_TOO_HOT = 0x1, 0x10000, 0x8, 0x80000


@dataclass(frozen=True, slots=True)
class Finding:
    """`what` was looked at, how it is in `text`, and how to `mend` it ("" if nothing is to be done)."""

    level: Level
    what: str
    text: str
    mend: str = ""


class Accounts:
    """Users of this computer and their groups."""

    def groups(self, user: str) -> set[int] | None:
        """Numbers of a user's groups, None if there is no such user."""
        try:
            entry = pwd.getpwnam(user)
        except KeyError:
            return None
        return set(os.getgrouplist(user, entry.pw_gid))

    def uid(self, user: str) -> int | None:
        """A user's number."""
        try:
            return pwd.getpwnam(user).pw_uid
        except KeyError:
            return None

    def group_name(self, gid: int) -> str:
        """A group's name."""
        try:
            return grp.getgrgid(gid).gr_name
        except KeyError:
            return str(gid)


def may_use(device: Path, user: str, accounts: Accounts) -> str | None:
    """Why a user may not read and write a device, or None."""
    status = device.stat()
    groups, uid = accounts.groups(user), accounts.uid(user)
    if groups is None or uid is None:
        return f"there is no user '{user}'"
    mode = stat.S_IMODE(status.st_mode)
    bits = mode >> 6 if status.st_uid == uid else mode >> 3 if status.st_gid in groups else mode
    if uid == 0 or bits & 0o6 == 0o6:
        return None
    return f"user '{user}' may not use it: it belongs to group '{accounts.group_name(status.st_gid)}', mode {mode:04o}"


def check_serial(root: Path, port: str, accounts: Accounts, user: str = "robotd-guardian") -> Iterator[Finding]:
    """The serial adapter: there, by a lasting name, usable by the guardian, and prompt."""
    what = "serial adapter"
    path = _under(root, port)
    if not path.exists():
        by_id = _under(root, "/dev/serial/by-id")
        found = (
            ", ".join(f"/dev/serial/by-id/{entry.name}" for entry in sorted(by_id.iterdir())) if by_id.is_dir() else ""
        )
        mend = (
            f"set port in the base's section to one of: {found}"
            if found
            else "plug the adapter in; lsusb shows whether it is seen"
        )
        yield Finding("error", what, f"there is no {port}", mend)
        return
    if not port.startswith("/dev/serial/by-"):
        yield Finding(
            "warning", what, f"{port} may be another device after a restart", "name it by /dev/serial/by-id/..."
        )
    why = may_use(path, user, accounts)
    if why is not None:
        mend = USERS if "no user" in why else f"{RULES}; the rule puts serial ports into the group dialout"
        yield Finding("error", what, f"{port}: {why}", mend)
    else:
        yield Finding("ok", what, f"{port}, usable by {user}")
    name = path.resolve().name
    timer = _under(root, f"/sys/bus/usb-serial/devices/{name}/latency_timer")
    if timer.exists():
        value = timer.read_text().strip()
        if value == "1":
            yield Finding("ok", "latency timer", "1 ms")
        else:
            yield Finding(
                "error", "latency timer", f"{value} ms: longer than the robot's 15 ms between two sensor frames", RULES
            )
    else:
        yield Finding("note", "latency timer", "this adapter has none (only FTDI adapters do)")


def check_pins(
    root: Path, wake_pin: int | None, has_beacons: bool, accounts: Accounts, has_lgpio: bool
) -> Iterator[Finding]:
    """The wake line and the GPIO chip."""
    if wake_pin is None:
        yield Finding(
            "note",
            "wake line",
            "no wake_pin: a robot that sleeps is woken through the adapter's RTS, if its cable has the wake line (BRC)",
            "a robot that stays asleep needs Clean pressed once, or BRC wired to a pin: wake_pin in the base's section",
        )
    else:
        yield Finding("ok", "wake line", f"on GPIO {wake_pin}; robotctl wake tries it")
    if wake_pin is None and not has_beacons:
        return
    chip = _under(root, "/dev/gpiochip0")
    if not chip.exists():
        yield Finding(
            "error",
            "GPIO chip",
            "there is no /dev/gpiochip0",
            "this needs a Raspberry Pi; remove wake_pin and the beacons elsewhere",
        )
        return
    why = may_use(chip, "robotd", accounts)
    if why is not None:
        yield Finding("error", "GPIO chip", f"/dev/gpiochip0: {why}", USERS)
    elif not has_lgpio:
        yield Finding(
            "error",
            "GPIO chip",
            "the library lgpio is missing",
            "sudo apt-get install python3-lgpio, or pip install 'robotd[pi]'",
        )
    else:
        yield Finding("ok", "GPIO chip", "/dev/gpiochip0, usable by robotd")


def check_camera(
    root: Path, name: str, device: str, accounts: Accounts, look: Callable[[str], tuple[float, tuple[str, ...]]]
) -> Iterator[Finding]:
    """One V4L2 camera: there, by a lasting name, opens, and does what it is asked for.

    `look` opens it and returns frames a second and the remarks of the negotiation; it raises RobotdError.
    """
    what = f"camera {name}"
    path = _under(root, device)
    if not path.exists():
        by_path = _under(root, "/dev/v4l/by-path")
        found = ", ".join(entry.name for entry in sorted(by_path.iterdir())) if by_path.is_dir() else ""
        mend = (
            f"set device to one of /dev/v4l/by-path/: {found}"
            if found
            else "plug the camera in; lsusb shows whether it is seen"
        )
        yield Finding("error", what, f"there is no {device}", mend)
        return
    if (
        not device.startswith("/dev/v4l/by-path/")
        and "USB" not in device
        and len(list(_under(root, "/dev").glob("video*"))) > 2
    ):
        yield Finding(
            "warning", what, f"{device} may be another camera after a restart", "name it by /dev/v4l/by-path/..."
        )
    why = may_use(path.resolve(), "robotd", accounts)
    if why is not None:
        yield Finding("error", what, f"{device}: {why}", USERS)
        return
    try:
        fps, remarks = look(device)
    except Exception as error:
        text, _, mend = str(error).partition("; ")
        if "in use" in text:
            mend = "stop what uses it, or robotctl record stop"
        yield Finding("error", what, text, mend or "unplug it and plug it in again; robotctl logs tells more")
        return
    yield Finding("ok", what, f"opens, {fps:g} frames a second")
    for remark in remarks:
        locks = "expos" in remark or "gain" in remark or "white" in remark or "focus" in remark
        mend = (
            "a detector of flashes takes changes of it for light: use a camera that can be locked"
            if locks
            else ("15 frames a second are enough; set fps in its section, so that all cameras agree")
        )
        yield Finding("warning", what, remark, mend)


def check_disk(root: Path, directory: Path) -> Iterator[Finding]:
    """Room for stops, and whether the card is wearing out."""
    place = next(path for path in (directory, *directory.parents) if path.exists())
    usage = os.statvfs(place)
    free = usage.f_bavail * usage.f_frsize / 1e6
    if usage.f_flag & os.ST_RDONLY:
        yield Finding(
            "error",
            "disk",
            f"{place} is read-only",
            "a card that fails turns read-only: copy what is on it, replace it",
        )
    elif free < FEW_MB:
        yield Finding(
            "error", "disk", f"{free:.0f} MB are free for {directory}", "delete recordings: robotctl record list"
        )
    elif free < FREE_MB:
        yield Finding(
            "warning", "disk", f"{free:.0f} MB are free for {directory}", "delete recordings: robotctl record list"
        )
    else:
        yield Finding("ok", "disk", f"{free / 1e3:.1f} GB are free for {directory}")
    for device in sorted(_under(root, "/sys/block").glob("mmcblk*/device")):
        life = device / "life_time"
        if life.exists():
            used = max(int(word, 16) for word in life.read_text().split())
            text = f"{device.parent.name}: about {10 * used} % of its life is used"
            worn = used >= 9
            yield Finding("warning" if worn else "ok", "wear", text, "replace it before it fails" if worn else "")
    for count in sorted(_under(root, "/sys/fs/ext4").glob("*/errors_count")):
        if (number := count.read_text().strip()) != "0":
            yield Finding(
                "error", "wear", f"{number} errors on {count.parent.name}", "check it (fsck) and replace the card soon"
            )


def check_clock(root: Path) -> Iterator[Finding]:
    """Whether dates are right."""
    if _under(root, "/run/systemd/timesync/synchronized").exists():
        yield Finding("ok", "clock", "set by a time server")
    elif any(_under(root, "/sys/class/rtc").glob("rtc*")):
        yield Finding("note", "clock", "not set by a time server since the boot; it has a clock of its own")
    else:
        yield Finding(
            "warning",
            "clock",
            "not set by a time server, and a Pi has no clock of its own: dates are wrong after a power cut",
            "sudo timedatectl set-ntp true; give the robot a network, or add a clock module",
        )


def check_power(root: Path) -> Iterator[Finding]:
    """What the Pi's firmware says of its power supply and temperature."""
    for path in _under(root, "/sys/devices/platform/soc").glob("soc:firmware/get_throttled"):
        bits = int(path.read_text().strip(), 16)
        if bits & (UNDER_VOLTAGE | WAS_UNDER_VOLTAGE):
            when = "is" if bits & UNDER_VOLTAGE else "was"
            yield Finding(
                "error",
                "power",
                f"the supply {when} below 4.6 V",
                "a stronger supply and a short, thick cable; a hub with its own supply for the cameras",
            )
        elif bits & (TOO_HOT | WAS_TOO_HOT):
            yield Finding("warning", "power", "the processor was too hot and slowed down", "a heat sink, or air")
        else:
            yield Finding("ok", "power", "no low voltage since the boot")


def check_token(path: Path | None, where: str, accounts: Accounts) -> Iterator[Finding]:
    """The upload token's file."""
    if path is None:
        return
    if path.exists() and not os.access(path, os.R_OK):
        yield Finding("note", "token", f"{path} is closed to you, too", "sudo robotctl doctor looks into it")
        return
    try:
        read_secret(path, where, accounts.uid("robotd"))
    except ConfigError as error:
        text, _, mend = str(error).partition("; ")
        yield Finding("error", "token", text, mend)
    else:
        yield Finding("ok", "token", f"{path}, closed to others")


def check_calibration(path: Path, now: float, cameras: Mapping[str, Any]) -> Iterator[Finding]:
    """Whether there is a calibration, and how old it is; `now` in seconds since 1970."""
    if not path.exists():
        yield Finding("error", "calibration", f"there is no {path}", "robotctl calibrate odometry, camera, rig, floor")
        return
    days = (now - path.stat().st_mtime) / 86400.0
    if days > OLD_DAYS:
        yield Finding("warning", "calibration", f"{days:.0f} days old", "wheels wear: robotctl calibrate odometry")
    else:
        yield Finding("ok", "calibration", f"{max(0.0, days):.0f} days old")
    if not cameras:
        yield Finding("error", "calibration", "it knows no camera of the rig", "robotctl calibrate camera and rig")


def _under(root: Path, path: str) -> Path:
    return root / path.lstrip("/")
