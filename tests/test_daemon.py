import asyncio
import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from robotd import daemon as daemon_module
from robotd.bind import bind
from robotd.bus import Bus
from robotd.clock import now, run_virtual
from robotd.config import Calibration, Config, save_calibration
from robotd.daemon import assemble, read_config
from robotd.errors import ConfigError, DriverFault
from robotd.mission_keeper import complete_map
from robotd.plugin import Driver, available
from robotd.records import CameraModel, Map, MappedLabel, SolverRun, Transform
from robotd.supervisor import Supervisor

EXAMPLE = Path(__file__).parent.parent / "etc" / "robotd.toml"


def uncommented(text):
    """The example with its commented defaults switched on; comments behind values stay."""
    return re.sub(r"^# (?=[a-z_]+ = |\[\[)", "", text, flags=re.MULTILINE)


def test_the_example_explains_every_key_and_its_comments_show_the_defaults():
    text = EXAMPLE.read_text()
    given, full = tomllib.loads(text), tomllib.loads(uncommented(text))
    config = bind(Config, full, "example")
    problems = []

    def compare(where, cls, shown, mentioned, required=()):
        for item in dataclasses.fields(cls):
            if item.name in required:
                continue
            if item.name not in mentioned:
                problems.append(f"{where}: {item.name} is not explained")
            elif item.name not in shown:
                default = item.default if item.default is not dataclasses.MISSING else item.default_factory()
                rival = "token_file" if item.name == "token_credential" else "token_credential"
                bound = bind(cls, {key: value for key, value in mentioned.items() if key != rival}, where)
                if getattr(bound, item.name) != default and item.name not in (
                    "url",
                    "token_file",
                    "token_credential",
                    "ca_file",
                    "known_labels",
                    "zones",
                    "plan",
                    "wake_pin",
                    "serial_log",
                    "gain",
                ):
                    problems.append(f"{where}.{item.name}: shows {getattr(bound, item.name)}, the default is {default}")

    for section in ("robot", "upload", "recording", "safety", "mission"):
        cls = type(getattr(config, section))
        compare(section, cls, given.get(section, {}), full[section], ("identify",))
    compare("identify", type(config.mission.identify), {}, full["mission"]["identify"])
    points = available()
    for name in ("base", "front", "follower", "labels", "beacons"):
        section = {key: value for key, value in full["drivers"][name].items() if key != "driver"}
        cls = points[full["drivers"][name]["driver"]].load().Config
        if name == "front":
            continue
        shown = {key: value for key, value in given["drivers"][name].items() if key != "driver"}
        compare(name, cls, shown, section)
    assert problems == []


# ---- assembling ------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FakeConfig:
    port: int = 1
    camera: str = "eye"


def fake(kind_):
    class Fake(Driver):
        kind = kind_
        Config = FakeConfig

    return Fake


@pytest.fixture
def fakes(monkeypatch):
    kinds = ("base", "camera", "follower", "labels")
    monkeypatch.setattr(daemon_module, "load", lambda name, where: {kind: fake(kind) for kind in kinds}[name])


FLOOR_MOUNT = Transform((-1.6433, 1.6433, -0.8554), (0.12, 0.0, 0.30))  # looks forward and down
CAMERA = CameraModel("front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((0, 0, 0), (0, 0, 0.5)))


def write_config(tmp_path, text, calibration=None):
    path = tmp_path / "robotd.toml"
    path.write_text('[robot]\ncalibration = "calibration.toml"\n' + text)
    if calibration is not None:
        save_calibration(calibration, tmp_path / "calibration.toml")
    return path


WHOLE = """
[drivers.wheels]
driver = "base"
[drivers.front]
driver = "camera"
[drivers.eye]
driver = "camera"
[drivers.follower]
driver = "follower"
[drivers.labels]
driver = "labels"
"""


def test_a_whole_configuration_becomes_drivers_in_opening_order(tmp_path, fakes):
    path = write_config(tmp_path, WHOLE, Calibration(cameras=(CAMERA,)))
    assembly = assemble(path, hardware=None)
    assert [driver.name for driver in assembly.drivers] == ["wheels", "front", "eye", "labels", "follower"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[drivers.front]", "[drivers.fornt]"), "knows the camera 'front', but there is no camera"),
        (('driver = "labels"', 'driver = "camera"'), "found none of kind 'labels'"),
        (("[drivers.eye]", "[drivers.iris]"), r"follower\] camera: there is no camera \[drivers.eye\]"),
        (
            ('driver = "base"', 'driver = "base"\nprot = 2'),
            r"\[drivers.wheels\]: unknown key 'prot'; did you mean 'port'",
        ),
    ],
)
def test_what_is_missing_is_named(tmp_path, fakes, change, message):
    path = write_config(tmp_path, WHOLE.replace(*change), Calibration(cameras=(CAMERA,)))
    with pytest.raises(ConfigError, match=message):
        assemble(path, hardware=None)


def test_mistakes_of_drivers_and_calibration_are_reported_together(tmp_path, fakes):
    (tmp_path / "calibration.toml").write_text("[wheels]\nbsae = 1.0\n")
    path = write_config(tmp_path, WHOLE.replace('driver = "base"', "driver = \"base\"\nport = 'x'"))
    with pytest.raises(ConfigError) as caught:
        assemble(path, hardware=None)
    assert len(caught.value.problems) == 2


def test_mistakes_of_the_configuration_and_of_its_drivers_are_reported_together(tmp_path):
    text = '[safty]\n[mission]\nstops = [1.0, 0.0]\n[drivers.wheels]\ndriver = "rumba"'
    with pytest.raises(ConfigError) as caught:
        read_config(write_config(tmp_path, text))
    found = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 3
    assert all(word in found for word in ("'safty'", "increasing distances", "unknown driver 'rumba'"))


def test_an_unknown_driver_names_the_installed_ones(tmp_path):
    with pytest.raises(ConfigError, match=r"drivers.wheels\]: unknown driver 'rumba'; installed are .*roomba"):
        assemble(write_config(tmp_path, '[drivers.wheels]\ndriver = "rumba"'), hardware=None)


# ---- supervising -----------------------------------------------------------------------------------------------------


def test_a_failing_driver_is_closed_reported_and_opened_again_with_growing_pauses():
    class Flaky(Driver):
        kind = "camera"
        log: list[tuple[str, float]] = []  # noqa: RUF012

        async def open(self):
            self.log.append(("open", now()))
            self.resources.callback(lambda: self.log.append(("close", now())))

        async def run(self):
            await asyncio.sleep(1.0)
            raise DriverFault("unplugged")

    async def main():
        bus = Bus()
        supervisor = Supervisor(Flaky("front", None, None, bus, Calibration()))
        task = asyncio.create_task(supervisor.run())
        await asyncio.sleep(0.5)
        assert supervisor.fault is None
        await asyncio.sleep(3.5)
        assert supervisor.fault is None  # open for the third time
        assert bus.events.latest.text == "unplugged; trying again in 1 s"
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return Flaky.log

    opened, closed = [0.0, 1.5, 3.5], [1.0, 2.5, 4.0]
    expected = [
        entry for pair in zip(opened, closed, strict=True) for entry in zip(("open", "close"), pair, strict=True)
    ]
    assert run_virtual(main()) == expected


def test_a_bug_in_a_driver_is_not_swallowed():
    class Buggy(Driver):
        kind = "camera"

        async def run(self):
            raise KeyError("bug")

    async def main():
        await Supervisor(Buggy("front", None, None, Bus(), Calibration())).run()

    with pytest.raises(KeyError):
        run_virtual(main())


# ---- the map that is brought home ------------------------------------------------------------------------------------


def test_labels_that_no_stop_saw_are_in_the_map_with_their_reason():
    solved = Map("s", "first stop", (MappedLabel("a", "placed"),), (), (), 0.0, 0.0, SolverRun(1, True, "bundle"))
    whole = complete_map(solved, ["a", "b"], 3, None)
    assert [(label.label, label.status) for label in whole.labels] == [("a", "placed"), ("b", "unplaced")]
    assert "none of the 3 stops" in whole.labels[1].reason
    ended = complete_map(solved, ["a", "b"], 1, "line lost")
    assert "line lost" in ended.labels[1].reason
    assert "line lost" in ended.notes[-1]


# ---- as a service ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_without_any_device_the_daemon_reports_retries_and_ends_cleanly(tmp_path, is_calibrated):
    text = EXAMPLE.read_text().replace("labels.example", "127.0.0.1").replace("port = 7071", "port = 9")
    camera = CameraModel("floor", (320, 240), (228.5, 228.5, 159.5, 119.5), FLOOR_MOUNT)
    rig = [replace(CAMERA, name=name) for name in ("front", "left", "rear", "right")]
    given = '[robot]\nstate_directory = "state"\ncalibration = "calibration.toml"\ncontrol = "control.sock"\n'
    text = text.replace("[robot]\n", given)
    (tmp_path / "robotd.toml").write_text(text)
    if is_calibrated:
        save_calibration(Calibration(cameras=tuple(rig), floor_camera=camera), tmp_path / "calibration.toml")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(60.0)
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "300000"}
        command = [sys.executable, "-m", "robotd", "run", "-c", str(tmp_path / "robotd.toml")]
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as process:
            try:
                assert manager.recv(1000).startswith(b"READY=1\nSTATUS=idle")
                while manager.recv(1000) != b"WATCHDOG=1":
                    pass
            except BaseException:
                process.kill()
                raise
            missing = {"base", "front", "left", "rear", "right", "floor", "labels"}
            if not is_calibrated:  # what it takes to calibrate it works
                missing |= {"follower", "WARNING there is no calibration.toml yet"}
                command = [sys.executable, "-m", "robotd.ctl.main", "--socket", str(tmp_path / "control.sock")]
                start = subprocess.run([*command, "mission", "start"], capture_output=True, text=True, check=False)
                assert start.returncode == 1
                words = "robotctl calibrate camera front and left and rear and right, and robotctl calibrate rig"
                assert words in start.stderr
            while missing:  # every device is reported, one after the other
                line = process.stderr.readline()
                assert line, f"ended before it complained of {missing}"
                missing.discard(line.removeprefix("ERROR ").split(":")[0])
            process.send_signal(signal.SIGTERM)
            _, shown = process.communicate(timeout=30)
    assert process.returncode == 0, shown
    assert (tmp_path / "state" / "journal.sqlite").exists()
