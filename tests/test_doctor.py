"""`robotd doctor`: every finding on a file system of our own, each with its mend."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from robotd import doctor_checks
from robotd.config import Config, UploadConfig
from robotd.doctor import check_server, check_together, examine
from robotd.doctor_checks import (
    RULES,
    USERS,
    Finding,
    check_calibration,
    check_camera,
    check_clock,
    check_disk,
    check_pins,
    check_power,
    check_serial,
    check_token,
    may_use,
)
from robotd.errors import DriverFault
from robotd.v4l2 import MORE_ROOM, NO_ROOM

EXAMPLE = Path(__file__).parent.parent / "etc" / "robotd.toml"
README = EXAMPLE.parent.parent / "README.md"
PORT = "/dev/serial/by-id/usb-FTDI"


class People:
    """`robotd` and `robotd-guardian` are in the group of every file of the test; nobody else exists."""

    def __init__(self, groups=None):
        self._groups = {os.getgid()} if groups is None else groups

    def groups(self, user):
        return self._groups if user.startswith("robotd") else None

    def uid(self, user):
        return 64999 if user.startswith("robotd") else None

    def group_name(self, gid):
        return "dialout"


def put(root, path, text="", mode=0o660):
    file = root / path.lstrip("/")
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    file.chmod(mode)
    return file


def adapter(root, latency="1", mode=0o660):
    put(root, "/dev/ttyUSB0", mode=mode)
    link = root / PORT.lstrip("/")
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to("../../ttyUSB0")
    put(root, "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer", f"{latency}\n")


def levels(findings):
    found = list(findings)
    assert all(item.mend for item in found if item.level in ("warning", "error")), found
    return [(item.level, item.what) for item in found]


def test_a_good_adapter_is_well(tmp_path):
    adapter(tmp_path)
    assert levels(check_serial(tmp_path, PORT, People())) == [("ok", "serial adapter"), ("ok", "latency timer")]


@pytest.mark.parametrize(
    ("make", "people", "words", "mend"),
    [
        (lambda root: None, People(), "there is no /dev", "lsusb"),
        (lambda root: put(root, "/dev/serial/by-id/usb-OTHER"), People(), "there is no /dev", "by-id/usb-OTHER"),
        (lambda root: adapter(root, latency="16"), People(), "16 ms: longer than", "60-robotd.rules"),
        (
            lambda root: adapter(root, mode=0o600),
            People(),
            "may not use it: it belongs to group 'dialout'",
            "60-robotd",
        ),
        (adapter, People(set()), "may not use it", "dialout"),
    ],
)
def test_what_is_wrong_with_an_adapter_is_told_with_its_mend(tmp_path, make, people, words, mend):
    make(tmp_path)
    bad = [item for item in check_serial(tmp_path, PORT, people) if item.level == "error"]
    assert len(bad) == 1
    assert words in bad[0].text
    assert mend in bad[0].mend


def test_a_port_without_a_lasting_name_and_a_user_that_is_missing(tmp_path):
    put(tmp_path, "/dev/ttyUSB0")
    assert ("warning", "serial adapter") in levels(check_serial(tmp_path, "/dev/ttyUSB0", People()))
    assert may_use(tmp_path / "dev/ttyUSB0", "nobody-like-this", People()) == "there is no user 'nobody-like-this'"


def test_pins_are_looked_at_only_where_they_are_used(tmp_path):
    assert levels(check_pins(tmp_path, None, False, People(), False)) == [("note", "wake line")]
    assert levels(check_pins(tmp_path, 17, False, People(), True)) == [("ok", "wake line"), ("error", "GPIO chip")]
    put(tmp_path, "/dev/gpiochip0")
    assert levels(check_pins(tmp_path, None, True, People(), True))[1] == ("ok", "GPIO chip")
    assert levels(check_pins(tmp_path, None, True, People(), False))[1] == ("error", "GPIO chip")
    assert levels(check_pins(tmp_path, None, True, People(set()), True))[1] == ("error", "GPIO chip")


def test_a_camera_is_opened_and_what_it_does_otherwise_is_told(tmp_path):
    device = "/dev/v4l/by-path/usb-1"

    def look(_):
        return 15.0, ("gives 15 frames a second instead of 30", "its exposure cannot be locked")

    assert levels(check_camera(tmp_path, "front", device, People(), look)) == [("error", "camera front")]
    put(tmp_path, device)
    found = list(check_camera(tmp_path, "front", device, People(), look))
    assert [item.level for item in found] == ["ok", "warning", "warning"]
    assert "set fps" in found[1].mend
    assert "can be locked" in found[2].mend
    assert levels(check_camera(tmp_path, "front", device, People(set()), look)) == [("error", "camera front")]

    def busy(_):
        raise DriverFault("/dev/video0 is in use by another program; end that one")

    assert "in use" in next(iter(check_camera(tmp_path, "front", device, People(), busy))).text

    def crowded(_):
        raise DriverFault(f"/dev/video0 cannot stream at 640x480: {NO_ROOM} (no space left on device); {MORE_ROOM}")

    found = next(iter(check_camera(tmp_path, "front", device, People(), crowded)))
    assert found.text.endswith("its USB bus has no room (no space left on device)")
    assert all(words in found.mend for words in ("fps = 15", "pairs (camera_groups", "a hub adds power, but no room"))


def test_what_the_checks_tell_to_type_is_what_the_readme_tells():
    readme = README.read_text()
    for command in (*USERS.split(" && "), *RULES.split(" && ")):
        assert command in readme
    rules = (README.parent / "etc" / "60-robotd.rules").read_text()
    assert RULES in rules


def test_a_full_read_only_or_worn_disk_is_noticed(tmp_path, monkeypatch):
    assert levels(check_disk(tmp_path, tmp_path / "no" / "such"))[0][1] == "disk"
    put(tmp_path, "/sys/block/mmcblk0/device/life_time", "0x02 0x0a\n")
    put(tmp_path, "/sys/fs/ext4/mmcblk0p2/errors_count", "3\n")
    assert levels(check_disk(tmp_path, tmp_path))[1:] == [("warning", "wear"), ("error", "wear")]

    def usage(blocks, flags):
        return lambda _: os.statvfs_result((4096, 4096, blocks, blocks, blocks, 1, 1, 1, flags, 255))

    for blocks, flags, level in ((10**3, 0, "error"), (3 * 10**5, 0, "warning"), (10**7, 0, "ok"), (10**7, 1, "error")):
        monkeypatch.setattr(doctor_checks.os, "statvfs", usage(blocks, flags))
        assert next(iter(check_disk(tmp_path / "none", tmp_path))).level == level


def test_clock_power_token_and_calibration(tmp_path):
    assert levels(check_clock(tmp_path)) == [("warning", "clock")]
    (tmp_path / "sys/class/rtc/rtc0").mkdir(parents=True)
    assert levels(check_clock(tmp_path)) == [("note", "clock")]
    put(tmp_path, "/run/systemd/timesync/synchronized")
    assert levels(check_clock(tmp_path)) == [("ok", "clock")]
    assert levels(check_power(tmp_path)) == []
    for bits, level in (("0", "ok"), ("50005", "error"), ("80008", "warning")):
        put(tmp_path, "/sys/devices/platform/soc/soc:firmware/get_throttled", bits)
        assert levels(check_power(tmp_path)) == [(level, "power")]
    assert levels(check_token(None, "c", People())) == []
    token = put(tmp_path, "token", "secret\n", 0o600)
    assert levels(check_token(token, "c", People())) == [("ok", "token")]
    token.chmod(0o644)
    assert "chmod 0600" in next(iter(check_token(token, "c", People()))).mend
    age = token.stat().st_mtime
    assert levels(check_calibration(tmp_path / "none", age, {})) == [("error", "calibration")]
    assert levels(check_calibration(token, age + 86400.0, {"front": 1})) == [("ok", "calibration")]
    assert levels(check_calibration(token, age + 300 * 86400.0, {})) == [
        ("warning", "calibration"),
        ("error", "calibration"),
    ]


def test_a_server_that_is_not_there_and_a_daemon_that_is_not_there(tmp_path):
    assert levels(check_server(Config(), tmp_path)) == [("note", "server")]
    away = Config(upload=UploadConfig(url="http://127.0.0.1:9"))
    assert levels(check_server(away, tmp_path)) == [("error", "server")]
    assert levels(check_together(tmp_path / "none.sock", 1.0)) == [("warning", "robotd")]


def test_mistakes_of_the_configuration_are_findings(tmp_path):
    (tmp_path / "robotd.toml").write_text("[safty]\n[mission]\nstops = [1.0, 0.0]\n")
    found = list(examine(tmp_path / "robotd.toml", root=tmp_path))
    assert [item.what for item in found] == ["configuration"] * len(found)
    assert len(found) >= 2


def test_the_command_prints_every_finding_and_fails_while_something_is_to_be_mended(tmp_path):
    command = [sys.executable, "-m", "robotd", "doctor", "-c", str(EXAMPLE), "--quick"]
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    assert shown.returncode == 1, shown.stderr
    assert "ERROR   serial adapter: there is no /dev/serial/by-id" in shown.stdout
    assert "        -> " in shown.stdout
    data = json.loads(subprocess.run([*command, "--json"], capture_output=True, text=True, check=False).stdout)
    assert data["errors"] > 0
    assert all(Finding(**item).what for item in data["findings"])
