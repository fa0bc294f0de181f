"""The services under systemd, in a container tree: whatever is killed, the robot is halted, and everything comes back.

A Debian tree is made with debootstrap and booted with systemd-nspawn; in it run the installed package, the units as
shipped, `robotd sim roomba` for a robot and a film for a roof camera. ROBOTD_TREE names a folder in which the tree is
kept for the next time.
Control groups are real in there; device rules, memory limits and address filters are not enforced.
"""

import json
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import pytest

from robotd.roof.setup import save_calibration
from tests.robot_process import PUSHING, install_drivers
from tests.roof_film import Film
from tests.test_roof_watch import a_calibration

ROOT = Path(__file__).parents[2]
PACKAGES = "python3,python3-venv,systemd,systemd-sysv,dbus,udev"
TOOLS = ("debootstrap", "systemd-nspawn")

CONFIG = """
[robot]
name = "trial"
calibration = "/etc/robotd/calibration.toml"
[drivers.base]
driver = "roomba"
port = "/run/robot/port"
[drivers.eye]
driver = "trial_camera"
[drivers.follower]
driver = "trial_follower"
[drivers.labels]
driver = "trial_labels"
"""

ROOF = """
[drivers.roof-1]
driver = "replay"
file = "/srv/film"
fps = 25.0
loop = true
"""
FILM_FRAMES, FILM_FPS = 80, 25.0  # 3.2 s: whole periods of both beacons, so that it may begin again

# the driver that pushes hangs, and the whole loop with it, when it is told to
PUSH = "            self.bus.commands.publish(DriveCommand(now(), 0.2, 0.0, self.name))\n"
HANG = """            import os
            while os.path.exists("/run/robotd/stuck"):
                pass
"""

FILES = {
    "etc/robotd/robotd.toml": CONFIG,
    "etc/robotd/calibration.toml": "",
    "etc/robotd/roof.toml": ROOF,
    # many deaths in a short time are the purpose here
    "etc/systemd/system/robotd.service.d/trial.conf": "[Unit]\nStartLimitIntervalSec=0\nAfter=robot.service\n",
    "etc/systemd/system/robotd-guardian.service.d/trial.conf": "[Unit]\nAfter=robot.service\n",
    "etc/systemd/system/robot.service": """
        [Service]
        ExecStart=/opt/robotd/bin/robotd sim roomba --quiet --link /run/robot/port
        ExecStartPost=/bin/sh -c 'while ! chmod 666 /run/robot/port; do sleep 0.1; done'
        RuntimeDirectory=robot
        [Install]
        WantedBy=multi-user.target
        """,
    "etc/systemd/system/trial.service": """
        [Unit]
        After=robotd.service robotd-guardian.service robot.service
        [Service]
        Type=oneshot
        ExecStart=/usr/bin/python3 /trial.py
        ExecStopPost=/usr/bin/systemctl poweroff
        StandardOutput=file:/trial.txt
        StandardError=file:/trial.txt
        [Install]
        WantedBy=multi-user.target
        """,
}

# runs inside: for each way to die, wait until the robot drives, do it, time the halt, wait until it drives again
TRIAL = r"""
import atexit, json, os, pathlib, pwd, socket, subprocess, time

GROUP = "/sys/fs/cgroup/unified/system.slice/robotd.service/cgroup.kill"
if not os.path.exists("/sys/fs/cgroup/unified"):
    GROUP = GROUP.replace("/unified", "")

def robot():
    with socket.socket(socket.AF_UNIX) as line:
        line.connect("/run/robot/port.ctl")
        line.sendall(b'{"state": true}\n')
        return json.loads(line.makefile().readline())

def run(*command):
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()

def pid(unit):
    return run("systemctl", "show", "-P", "MainPID", unit)

def wait(condition, limit):
    start = time.monotonic()
    while time.monotonic() - start < limit:
        try:
            state = robot()
            if condition(state):
                return state, time.monotonic() - start
        except OSError:
            pass
        time.sleep(0.004)
    return None, limit

def drives(state):
    return min(state["requested_mm_s"]) >= 150 and state["mode"] == "safe"

def is_halted(state):
    return not any(state["requested_mm_s"]) and state["mode"] in ("off", "passive")

def kill_group():
    open(GROUP, "w").write("1")

def stop_and_wake():
    run("systemctl", "kill", "-s", "STOP", "robotd")
    time.sleep(1.0)
    run("systemctl", "kill", "-s", "CONT", "robotd")

def kill_both():
    os.kill(int(pid("robotd-guardian")), 9)
    kill_group()

def stick():
    open("/run/robotd/stuck", "w").close()  # systemd removes it with the folder when it ends the service

def stop():
    start = time.monotonic()
    run("systemctl", "stop", "robotd")
    taken = time.monotonic() - start
    return {"taken_s": round(taken, 2), "result": run("systemctl", "show", "-P", "Result", "robotd")}

# whether robotd-roof says now that it sees both beacons
def beacons_are_seen():
    try:
        camera, = json.loads(pathlib.Path("/var/lib/robotd-solver/roof/status.json").read_text())["cameras"]
    except OSError:
        return False
    return set(camera["beacons"]) == {"front", "rear"}

# robotd-roof: starts, sees, is killed and comes back, ends; then with a mistake in its configuration
def watch_roof():
    state = pathlib.Path("/var/lib/robotd-solver/roof")
    seen = {"start": run("systemctl", "start", "robotd-roof")}
    for name in ("first", "killed", "stopped"):
        begun = time.monotonic()
        while not beacons_are_seen() and time.monotonic() < begun + 60.0:
            time.sleep(0.1)
        process = pid("robotd-roof")
        seen[name] = {
            "sees": beacons_are_seen(),
            "active": run("systemctl", "is-active", "robotd-roof"),
            "user": pwd.getpwuid(int(run("awk", "/^Uid/ {print $2}", f"/proc/{process}/status"))).pw_name,
        }
        (state / "status.json").unlink()
        if name == "first":
            os.kill(int(process), 9)
    seen["restarts"] = run("systemctl", "show", "-P", "NRestarts", "robotd-roof")
    start = time.monotonic()
    run("systemctl", "stop", "robotd-roof")
    seen["taken_s"] = round(time.monotonic() - start, 2)
    seen["result"] = run("systemctl", "show", "-P", "Result", "robotd-roof")
    lines = [json.loads(line) for path in state.glob("dwells/*") for line in path.read_text().splitlines()]
    seen["dwells"] = sorted({line["beacon"] for line in lines})
    seen["owner"] = run("stat", "-c", "%U", str(state))
    with open("/etc/robotd/roof.toml", "a") as file:
        file.write("[roof]\nguard = 5\n")
    run("systemctl", "start", "robotd-roof")
    begun = time.monotonic()
    while (result := run("systemctl", "show", "-P", "ActiveState", "robotd-roof")) != "failed":
        if time.monotonic() > begun + 90.0:
            break
        time.sleep(0.2)
    seen["with a mistake"] = result
    seen["told"] = sorted({entry["MESSAGE"] for entry in entries("_SYSTEMD_UNIT=robotd-roof.service")})
    return seen

def entries(*matches):
    lines = run("journalctl", "-b", "-o", "json", *matches).splitlines()
    return [json.loads(line) for line in lines]

WAYS = {
    "kill -9 of the daemon": lambda: os.kill(int(pid("robotd")), 9),
    "systemctl kill -s KILL": lambda: run("systemctl", "kill", "-s", "KILL", "robotd"),
    "cgroup.kill": kill_group,
    "SIGSTOP": lambda: run("systemctl", "kill", "-s", "STOP", "robotd"),
    "SIGSTOP, later SIGCONT": stop_and_wake,
    "SIGABRT": lambda: run("systemctl", "kill", "-s", "ABRT", "robotd"),
    "kill -9 of the guardian": lambda: os.kill(int(pid("robotd-guardian")), 9),
    "kill -9 of both": kill_both,
    "a control loop that is stuck": stick,
    "systemctl restart robotd": lambda: run("systemctl", "restart", "--no-block", "robotd"),
    "systemctl restart robotd-guardian": lambda: run("systemctl", "restart", "--no-block", "robotd-guardian"),
}
UNITS = ("robot", "robotd", "robotd-guardian", "robotd-roof")
JOURNAL = ("journalctl", "-b", "--no-pager", "-o", "short-monotonic", *(f"-u{unit}" for unit in UNITS))
atexit.register(lambda: print(run(*JOURNAL)))
seen = {}
for name, way in WAYS.items():
    before, _ = wait(drives, 60.0)
    if before is None:
        seen[name] = {"drives": False}
        break
    start = time.monotonic()
    way()
    halted, _ = wait(is_halted, 10.0)
    taken = time.monotonic() - start
    again, back = wait(drives, 60.0)
    seen[name] = {
        "drives": True,
        "halted": halted is not None,
        "halted_s": round(taken, 3),
        "mode": halted and halted["mode"],
        "moved_m": halted and round(max(halted["rotations"]) - max(before["rotations"]), 3),
        "drives_again": again is not None,
        "back_s": round(back, 1),
        "units": {unit: run("systemctl", "is-active", unit) for unit in UNITS[1:3]},
    }
group = run("systemctl", "show", "-P", "ControlGroup", "robotd-guardian")
guardian = pid("robotd-guardian")
facts = {
    "group": group,
    "score": run("systemctl", "show", "-P", "OOMScoreAdjust", "robotd-guardian"),
    "memlock": run("systemctl", "show", "-P", "LimitMEMLOCK", "robotd-guardian"),
    "user": pwd.getpwuid(int(run("awk", "/^Uid/ {print $2}", f"/proc/{guardian}/status"))).pw_name,
    "socket": run("stat", "-c", "%U:%G %a", "/run/robotd-guardian/guardian.sock"),
    "rss_kb": [int(text.split()[1]) for text in open(f"/proc/{guardian}/status") if text.startswith("VmRSS")][0],
    "daemon_groups": run("sh", "-c", f"grep Groups /proc/{pid('robotd')}/status"),
    "status": run("systemctl", "show", "-P", "StatusText", "robotd-guardian"),
    "daemon_status": run("systemctl", "show", "-P", "StatusText", "robotd"),
    "watchdog": len(entries("_PID=1", "UNIT=robotd.service", "UNIT_RESULT=watchdog")),
    "told": [
        {name: text for name, text in entry.items() if name in ("MESSAGE", "PRIORITY") or name.startswith("ROBOTD_")}
        for entry in entries("ROBOTD_SOURCE=base")[:20]
    ],
    "listens": run("stat", "-c", "%U:%G %a", "/run/robotd/control.sock"),
}
stops = {"driving": stop()}
halted, taken = wait(is_halted, 10.0)
seen["systemctl stop robotd"] = {"drives": True, "halted": halted is not None, "halted_s": round(taken, 3)}
for pause in (0.2, 1.0):
    run("systemctl", "start", "--no-block", "robotd")
    time.sleep(pause)
    stops[f"{pause} s after the start"] = stop()
run("systemctl", "start", "robotd")
wait(drives, 60.0)
run("systemctl", "stop", "robot")
time.sleep(2.5)
facts["status_without_base"] = run("systemctl", "show", "-P", "StatusText", "robotd")
stops["without its base"] = stop()
run("systemctl", "start", "robot")
run("systemctl", "start", "robotd")
wait(drives, 60.0)
run("/opt/robotd/bin/robotctl", "estop")
wait(is_halted, 10.0)
stops["held by an emergency stop"] = stop()
json.dump({"seen": seen, "facts": facts, "stops": stops, "roof": watch_roof()}, open("/trial.json", "w"))
"""


def run(*command, **more):
    subprocess.run([str(part) for part in command], check=True, stdin=subprocess.DEVNULL, **more)


def inside(tree, *command):
    """Run a command in the tree, which is not booted."""
    run("systemd-nspawn", "-q", "--register=no", "--keep-unit", "-D", tree, "--pipe", *command)


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A Debian tree with both services installed."""
    if os.geteuid() != 0:
        pytest.skip("needs root: containers of systemd-nspawn")
    if missing := [tool for tool in TOOLS if shutil.which(tool) is None]:
        pytest.skip(f"needs {' and '.join(missing)}: apt-get install debootstrap systemd-container")
    tree = Path(os.environ.get("ROBOTD_TREE") or tmp_path_factory.mktemp("service") / "tree")
    if not (tree / "usr" / "bin" / "python3").exists():
        made = subprocess.run(
            ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(tree)],
            capture_output=True,
            text=True,
            check=False,
        )
        if made.returncode != 0:
            pytest.skip(f"debootstrap makes no tree here: {made.stdout[-300:]}{made.stderr[-300:]}")
    install(tree, tmp_path_factory.mktemp("wheels"))
    return tree


def install(tree, folder):
    """The package into /opt/robotd of the tree, as the README says, from wheels that are fetched outside."""
    wheels = tree / "wheels"
    wheels.mkdir(exist_ok=True)
    for old in wheels.glob("robotd-*.whl"):
        old.unlink()
    for name in ("robotd", "drivers", "cython", "etc", "systemd"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    for name in ("setup.py", "pyproject.toml", "README.md", "MANIFEST.in", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    pip = (sys.executable, "-m", "pip", "-q", "--disable-pip-version-check")
    plain = {**os.environ, "ROBOTD_NO_EXTENSIONS": "1"}
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", wheels, folder, env=plain)
    version = ("--python-version", "3.11", "--only-binary=:all:")  # the tree's Python, whatever this one is
    run(*pip, "download", *version, "-d", wheels, "--find-links", wheels, *wheels.glob("robotd-*.whl"))
    if not (tree / "opt" / "robotd" / "bin" / "pip").exists():
        inside(tree, "python3", "-m", "venv", "/opt/robotd")
    own = [f"/wheels/{path.name}" for path in wheels.glob("robotd-*.whl")]
    inside(tree, "/opt/robotd/bin/pip", "install", "-q", "--no-index", "--find-links", "/wheels", *own)
    inside(tree, "/opt/robotd/bin/pip", "install", "-q", "--no-index", "--no-deps", "--force-reinstall", *own)
    (tree / "etc" / "sysusers.d").mkdir(exist_ok=True)
    shutil.copy(ROOT / "systemd" / "robotd-sysusers.conf", tree / "etc" / "sysusers.d" / "robotd.conf")
    inside(tree, "systemd-sysusers")
    site = tree / "opt" / "robotd" / "lib" / "python3.11" / "site-packages"
    install_drivers(site, PUSHING.replace(PUSH, PUSH + HANG))
    for name, text in FILES.items():
        path = tree / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    film = tree / "srv" / "film"
    film.mkdir(exist_ok=True)
    still = Film(fps=FILM_FPS, start=(160.0, 120.0), uneven=0.0, lost=0.0)
    for k in range(FILM_FRAMES):
        cv2.imwrite(str(film / f"{k:04d}.png"), still.draw(k / FILM_FPS))
    save_calibration(a_calibration(), tree / "etc" / "robotd" / "roof-calibration.toml")
    for unit in ("robotd", "robotd-guardian", "robotd-roof"):
        shutil.copy(ROOT / "systemd" / f"{unit}.service", tree / "etc" / "systemd" / "system")
    inside(tree, "systemctl", "enable", "-q", "robotd", "robotd-guardian", "robot", "trial")
    (tree / "trial.py").write_text(TRIAL)


@pytest.fixture(scope="module")
def trial(tree):
    """What was seen in one run of the container."""
    result = tree / "trial.json"
    shown = tree / "trial.txt"
    for old in (result, shown):
        old.unlink(missing_ok=True)
    command = ["systemd-nspawn", "-q", "--register=no", "--keep-unit", "-D", str(tree), "-b", "--console=pipe"]
    booted = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, timeout=900)
    if not shown.exists():
        pytest.skip(f"systemd-nspawn does not boot here: {booted.stdout[-500:]}{booted.stderr[-500:]}")
    print(shown.read_text())
    assert result.exists(), "the trial has not ended; its output is above"
    seen = json.loads(result.read_text())
    print(json.dumps(seen, indent=1))
    return seen


WAYS = [line.split('"')[1] for line in TRIAL.split("WAYS = {")[1].split("}")[0].splitlines() if ": " in line]


@pytest.mark.parametrize("way", WAYS)
def test_whatever_dies_the_robot_is_halted_and_drives_again_when_the_services_are_back(trial, way):
    seen = trial["seen"].get(way, {"drives": False})
    assert seen["drives"], "the robot did not drive before; the journal is above"
    assert seen["halted"]
    assert seen["mode"] in ("off", "passive")
    assert seen["halted_s"] < 2.0
    assert seen["moved_m"] < 0.3
    assert seen["drives_again"]
    assert seen["units"] == {"robotd": "active", "robotd-guardian": "active"}


def test_a_stopped_service_leaves_the_robot_halted(trial):
    assert trial["seen"]["systemctl stop robotd"]["halted"]


def test_the_guardian_stands_apart_and_the_daemon_needs_no_rights_to_the_port(trial):
    facts = trial["facts"]
    assert facts["group"] == "/system.slice/robotd-guardian.service"
    assert (facts["score"], facts["memlock"]) == ("-1000", "infinity")  # which need a right that a container may lack
    assert facts["user"] not in ("root", "robotd")
    assert facts["socket"].endswith(":robotd 660")
    assert facts["status"].startswith("/run/robot/port is lent to process")


def test_a_loop_that_was_stuck_was_ended_by_the_watchdog(trial):
    assert trial["facts"]["watchdog"] >= 2  # SIGSTOP was the other way to hang


def test_every_stop_is_clean_and_takes_less_than_5_s(trial):
    assert len(trial["stops"]) == 5
    for state, stop in trial["stops"].items():
        assert stop["taken_s"] < 5.0, state
        assert stop["result"] == "success", state


def test_the_watch_of_the_roof_cameras_starts_sees_comes_back_and_keeps_what_it_saw(trial):
    roof = trial["roof"]
    for moment in ("first", "killed", "stopped"):
        assert roof[moment] == {"sees": True, "active": "active", "user": "robotd-solver"}
    assert int(roof["restarts"]) == 1
    assert roof["taken_s"] < 10.0
    assert roof["result"] == "success"
    assert roof["dwells"] == ["front", "rear"]
    assert roof["owner"] == "robotd-solver"


def test_the_watch_of_the_roof_cameras_names_a_mistake_and_gives_up(trial):
    assert trial["roof"]["with a mistake"] == "failed"
    told = "robotd-solver: /etc/robotd/roof.toml roof: unknown key 'guard'; did you mean 'guard_s'?"
    assert [line for line in trial["roof"]["told"] if line.startswith(told)]


def test_systemctl_status_and_the_journal_tell_how_the_robot_fares(trial):
    facts = trial["facts"]
    assert facts["daemon_status"].startswith("idle")
    assert "base: " in facts["status_without_base"]
    assert facts["listens"] == "robotd:robotd 660"
    assert {
        "MESSAGE": "base: base found on /run/robot/port at 115200 baud",
        "PRIORITY": "6",
        "ROBOTD_SOURCE": "base",
        "ROBOTD_ROBOT": "trial",
    } in facts["told"]
