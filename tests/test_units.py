"""What is installed beside the package: units, users, udev rules."""

import shutil
from pathlib import Path

import pytest

from tests.units import check

ROOT = Path(__file__).parent.parent
SYSTEMD = ROOT / "systemd"
UNITS = ["robotd.service", "robotd-guardian.service", "robotd-roof.service"]


def settings(unit):
    lines = (SYSTEMD / unit).read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed here")
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("TimeoutStopSec=", "TimeoutStopSex=", "'TimeoutStopSex'"),
        ("/opt/robotd/bin/robotd run", "/opt/robotd/bin/robott run", "robott"),
        ("RestrictNamespaces=yes\nRestrictRealtime=yes\n", "", "exposure level"),
        ("Type=notify", "Type=notifies", "Failed to parse service type"),
    ],
)
def test_make_check_finds_what_systemd_only_warns_of_and_what_opens_a_unit(tmp_path, old, new, words):
    unit = tmp_path / "robotd.service"
    unit.write_text((SYSTEMD / unit.name).read_text().replace(old, new))
    assert words in "\n".join(check(unit))


def test_the_guardian_is_the_last_to_die_and_comes_back_for_ever():
    found = settings("robotd-guardian.service")
    for wanted in (
        "OOMScoreAdjust=-1000",
        "Restart=always",
        "StartLimitIntervalSec=0",
        "RuntimeDirectoryPreserve=restart",
    ):
        assert wanted in found


def test_the_daemon_wants_the_guardian_but_does_not_go_down_with_it_and_has_no_right_to_serial_ports():
    found = settings("robotd.service")
    assert "Wants=network-online.target robotd-guardian.service" in found
    assert "After=network-online.target robotd-guardian.service" in found
    assert not [
        line for line in found if line.startswith(("Requires", "BindsTo")) or "tty" in line or "dialout" in line
    ]


def test_the_roof_watch_is_confined_like_the_daemon_and_has_no_pins():
    daemon, roof = (set(settings(unit)) for unit in ("robotd.service", "robotd-roof.service"))
    confined = {line for line in daemon if line.startswith(("Protect", "Private", "Restrict", "SystemCall", "Capab"))}
    assert len(confined) > 15
    assert confined <= roof
    assert not [line for line in roof if "gpio" in line or "media" in line]


@pytest.mark.parametrize("unit", UNITS)
def test_a_forbidden_system_call_is_refused_and_does_not_kill(unit):
    assert "SystemCallErrorNumber=EPERM" in settings(unit)  # libraries try sched_setaffinity and go on without it


def test_every_user_and_group_of_the_units_is_made():
    made = (SYSTEMD / "robotd-sysusers.conf").read_text().split()
    for unit in UNITS:
        for line in settings(unit):
            key, _, names = line.partition("=")
            if key in ("User", "Group", "SupplementaryGroups"):
                assert set(names.split()) <= set(made)


def test_every_udev_rule_is_made_of_matches_and_assignments():
    rules = [line for line in (ROOT / "etc" / "60-robotd.rules").read_text().splitlines() if line[:1] not in ("#", "")]
    assert any('ATTR{latency_timer}="1"' in rule for rule in rules)
    assert any('ATTR{../../power/control}="on"' in rule for rule in rules)
    for rule in rules:
        for part in rule.split(", "):
            assert part.endswith('"')
            assert part.count('"') == 2
