"""Whole surveys in the simulator: the chain from bytes and pixels to the map, deterministic by seed."""

import asyncio
import contextlib
import io
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from robotd.__main__ import main
from robotd.files import load_map, load_points, load_survey
from robotd.sim.body import Body
from robotd.sim.labels import LabelSystem
from robotd.sim.referee import Referee
from robotd.sim.scene import Scene
from robotd.sim.world import World

STORES = Path(__file__).parent / "stores"
SIMULATOR = ("robotd.sim", "robotd.demo", "threading", "concurrent.futures", "tests.", "test_survey")


def run_demo(out, capsys, *more):
    code = main(["demo", "--store", str(STORES / "corner.toml"), "--seed", "3", "--out", str(out), "--json", *more])
    return code, capsys.readouterr()


@pytest.fixture(scope="module")
def first_run(tmp_path_factory):
    """One run under guard: whoever touches the simulated world's objects from outside the simulator is noted."""
    out = tmp_path_factory.mktemp("survey")
    intruders, scored_early = set(), []
    finished = []
    patch = pytest.MonkeyPatch()

    def guard(cls):
        plain = cls.__getattribute__

        def guarded(self, name):
            caller = sys._getframe(1).f_globals.get("__name__", "")
            if not caller.startswith(SIMULATOR):
                intruders.add((caller, cls.__name__, name))
            return plain(self, name)

        patch.setattr(cls, "__getattribute__", guarded)

    for cls in (World, Body, Scene, LabelSystem):
        guard(cls)
    from robotd.daemon import Daemon

    plain_run, plain_init = Daemon.run, Referee.__init__

    async def run(self, **options):
        await plain_run(self, **options)
        finished.append(True)

    def init(self, world):
        scored_early.append(not finished)
        plain_init(self, world)

    patch.setattr(Daemon, "run", run)
    patch.setattr(Referee, "__init__", init)
    printed, shown = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(shown):
        code = main(["demo", "--store", str(STORES / "corner.toml"), "--seed", "3", "--out", str(out), "--json"])
    patch.undo()
    return out, code, printed.getvalue(), shown.getvalue(), intruders, scored_early


@pytest.mark.slow
def test_a_survey_places_the_labels_that_can_be_seen(first_run):
    out, code, printed, shown, *_ = first_run
    assert code == 0, shown
    result = json.loads(printed)
    assert result["labels_total"] == 7
    assert result["labels_placed"] == 6
    assert result["stops"] == 3
    assert result["error_mm"]["mean"] <= 25.0
    assert result["cross_track_mm"]["rms"] <= 20.0
    for name in ("survey.json", "truth.csv", "map.json", "map.csv", "map.html", "map.png"):
        assert (out / name).stat().st_size > 100, name


@pytest.mark.slow
def test_the_map_says_why_a_label_has_no_position(first_run):
    out = first_run[0]
    labels = {label.label: label for label in load_map(out / "map.json").labels}
    assert labels["hidden"].status == "unplaced"
    assert "none of the 3 stops" in labels["hidden"].reason
    assert labels["W<1>"].status == "placed"
    assert "W<1>" not in (out / "map.html").read_text()


@pytest.mark.slow
def test_nobody_outside_the_simulator_reads_truth(first_run):
    *_, intruders, scored_early = first_run
    assert intruders == set()
    assert scored_early == [False]


@pytest.mark.slow
def test_the_survey_carries_moves_with_covariance_and_honest_pixels(first_run):
    survey = load_survey(first_run[0] / "survey.json")
    assert [stop.stop for stop in survey.stops] == [1, 2, 3]
    assert survey.stops[0].move is None
    for stop in survey.stops[1:]:
        assert 0.3 < (stop.move.dx**2 + stop.move.dy**2) ** 0.5 < 0.8
        assert stop.move.covariance[2][2] > 1e-6
    assert all(0.0 < sighting.sigma_px < 1.0 for stop in survey.stops for sighting in stop.sightings)
    assert load_points(first_run[0] / "truth.csv").keys() == {"S1", "S2", "E1", "E2", "N1", "W<1>", "hidden"}


@pytest.mark.slow
def test_the_same_seed_gives_the_same_survey_in_a_process_of_its_own_and_without_any_feedback(first_run, tmp_path):
    world = tmp_path / "silent.toml"
    world.write_text("[world.labels]\nfeedback = false\n")  # nothing in the mission may hang on files that vanish
    command = [sys.executable, "-m", "robotd", "demo", "--store", str(STORES / "corner.toml"), "--seed", "3", "--json"]
    command += ["--world", str(world), "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["peak_mb"] <= 500.0
    first, again = (load_survey(path / "survey.json") for path in (first_run[0], tmp_path))
    assert first == again


@pytest.mark.slow
def test_a_line_that_cannot_be_seen_gives_a_map_that_says_so(tmp_path, capsys):
    world = tmp_path / "fog.toml"
    world.write_text("[world.floor]\nnoise = 50.0\nblur = 8.0\n")
    code, printed = run_demo(tmp_path / "out", capsys, "--world", str(world))
    assert code == 0, printed.err
    result = json.loads(printed.out)
    assert result["stops"] == 1
    assert result["labels_placed"] == 0
    found = load_map(tmp_path / "out" / "map.json")
    assert {label.status for label in found.labels} == {"unplaced"}
    assert all(label.reason for label in found.labels)
    assert any("line" in note for note in found.notes)


class PulledCables(World):
    """Somebody trips over the left camera's cable at stop 1 and over the base's at stop 2."""

    async def run(self):
        async def clumsy():
            for device, near in (("/dev/robotd/left", 0.0), ("/dev/robotd/base", 0.75)):
                while (
                    math.hypot(self.body.pose.x - self.body.start.x, self.body.pose.y - self.body.start.y) < near - 0.02
                ):
                    await asyncio.sleep(0.1)
                await asyncio.sleep(12.0)
                self.unplug(device)
                await asyncio.sleep(2.0)
                self.plug(device)

        async with asyncio.TaskGroup() as group:
            group.create_task(super().run())
            group.create_task(clumsy())


@pytest.mark.slow
def test_pulled_cables_pause_the_mission_and_cost_no_stop(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("robotd.demo.World", PulledCables)
    code, printed = run_demo(tmp_path / "out", capsys)
    assert code == 0, printed.err
    assert printed.err.count("plug the camera in again") >= 1
    assert printed.err.count("plug the adapter in again") >= 1
    survey = load_survey(tmp_path / "out" / "survey.json")
    assert [(stop.leg, stop.stop) for stop in survey.stops] == [(1, 1), (2, 2), (2, 3)]
    assert [stop.move is None for stop in survey.stops] == [True, True, False]
    assert json.loads(printed.out)["labels_placed"] >= 5
