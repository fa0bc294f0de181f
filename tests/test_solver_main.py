"""The command line robotd-solver: what it writes, prints and returns."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from robotd.errors import SolverError
from robotd.files import load_map, map_from_json, save_map, save_survey, save_truth
from robotd.records import (
    CameraModel,
    Map,
    MappedLabel,
    Move,
    Pose,
    Rig,
    Sighting,
    Sigmas,
    SolverRun,
    Stop,
    Survey,
    Transform,
)
from robotd.solver_main import main

TRUTH = {"A": (2.0, 0.8, 0.9), "B": (2.2, -0.7, 0.3), "C": (2.5, 0.1, 1.1), "D": (1.9, 0.4, 0.6)}
FRONT = CameraModel(
    "front", (640, 480), (268.5, 268.5, 319.5, 239.5), Transform((-1.2091996, 1.2091996, -1.2091996), (0.06, 0.0, 0.5))
)


def a_survey():
    """Two stops, 0.5 m of driving to the side between them; every label seen from both, without noise."""
    stops = []
    for number, y in ((1, -0.25), (2, 0.0), (3, 0.25)):
        y += 0.25
        sightings = []
        for label, (lx, ly, lz) in TRUTH.items():
            right, down, ahead = y - ly, 0.5 - lz, lx - 0.06
            u, v = 319.5 + 268.5 * right / ahead, 239.5 + 268.5 * down / ahead
            sightings.append(Sighting("front", label, u, v))
        noise = tuple(tuple(float(value) for value in row) for row in np.diag([1e-6, 1e-6, 1e-6]))
        move = None if number == 1 else Move(0.0, 0.25, 0.0, noise)
        stops.append(Stop(1, number, "2026-11-21T10:00:00Z", Pose(0.0, y, 0.0), move, tuple(sightings)))
    return Survey("room", Rig((FRONT,)), tuple(stops), sigmas=Sigmas(0.3, 1.0))


@pytest.fixture
def files(tmp_path):
    save_survey(a_survey(), tmp_path / "survey.json")
    save_truth(tmp_path / "truth.csv", TRUTH)
    labels = tuple(
        MappedLabel(name, "placed", (x, y, z + 0.01), ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4)), 3, 3)
        for name, (x, y, z) in TRUTH.items()
    )
    save_map(
        Map("room", "first stop", labels, (), (), 1.0, 0.3, SolverRun(3, True, "bundle")), tmp_path / "shifted.json"
    )
    return tmp_path


def run(*arguments):
    return main([str(argument) for argument in arguments])


@pytest.mark.parametrize("method", ["bundle", "linear"])
def test_solve_writes_the_map_and_all_its_views(files, method, capsys):
    views = ["--csv", files / "map.csv", "--png", files / "map.png", "--html", files / "map.html"]
    assert run("solve", files / "survey.json", "-o", files / "map.json", "--method", method, *views) == 0
    result = load_map(files / "map.json")
    assert result.solver.method == method
    for label in result.labels:
        np.testing.assert_allclose(label.position, TRUTH[label.label], atol=1e-3)
    assert (files / "map.csv").read_text().startswith("label,x,y,z,sx,sy,sz,status,sightings\n")
    assert (files / "map.png").read_bytes().startswith(b"\x89PNG")
    assert (files / "map.html").read_text().startswith("<!DOCTYPE html>")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "4 labels (4 placed), 3 stops" in captured.err


def test_without_an_output_file_the_map_goes_to_stdout(files, capsys):
    assert run("solve", files / "survey.json") == 0
    assert map_from_json(capsys.readouterr().out.encode(), "stdout").survey == "room"


def test_known_labels_come_from_a_table_and_replace_those_of_the_survey(files):
    (files / "known.csv").write_text("label,x,y,z,sigma\nA,2.0,0.8,0.9,0.001\nB,2.2,-0.7,0.3,\n")
    assert run("solve", files / "survey.json", "--known", files / "known.csv", "-o", files / "map.json") == 0
    statuses = {label.label: label.status for label in load_map(files / "map.json").labels}
    assert (statuses["A"], statuses["B"], statuses["C"]) == ("known", "known", "placed")


def test_evaluate_prints_the_errors_as_a_table_or_as_json(files, capsys):
    assert run("evaluate", files / "shifted.json", "--truth", files / "truth.csv") == 0
    row = ["0", "dead", "reckoning", "bundle", "adjustment", "4", "/", "4", "10.0", "10.0", "10.0", "10.0"]
    assert capsys.readouterr().out.splitlines()[1].split() == row
    assert run("evaluate", files / "shifted.json", "--truth", files / "truth.csv", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["labels_total"], printed["labels_placed"]) == (4, 4)
    assert printed["error_mm"] == pytest.approx(dict.fromkeys(("mean", "median", "p95", "max"), 10.0))


def test_evaluate_compares_maps_in_one_table(files, capsys):
    maps = [files / "shifted.json"] * 2
    assert run("evaluate", *maps, "--truth", files / "truth.csv") == 0
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert run("evaluate", *maps, "--truth", files / "truth.csv", "--json") == 0
    one, other = json.loads(capsys.readouterr().out)
    assert one == other
    assert 0 <= one["labels_within_95"] <= 4


def test_evaluate_can_align_first(files, capsys):
    assert run("evaluate", files / "shifted.json", "--truth", files / "truth.csv", "--align", "se3", "--json") == 0
    assert json.loads(capsys.readouterr().out)["error_mm"]["max"] == pytest.approx(0.0, abs=1e-6)


def test_check_counts_what_is_in_a_survey_and_names_labels_seen_once(files, capsys):
    survey = a_survey()
    stops = (replace(survey.stops[0], sightings=(*survey.stops[0].sightings, Sighting("front", "E", 1, 1))),)
    save_survey(replace(survey, stops=stops + survey.stops[1:]), files / "once.json")
    assert run("check", files / "once.json") == 0
    out = capsys.readouterr().out
    assert "no mistake; 3 stops, 5 labels, 13 sightings" in out
    assert "one stop only" in out
    assert out.endswith(": E\n")


def test_all_mistakes_of_a_file_are_printed_and_the_code_is_2(files, capsys):
    data = json.loads((files / "survey.json").read_text())
    data["stops"][0]["sightings"][0]["camera"] = "frond"
    data["stops"][1]["time"] = "noon"
    (files / "bad.json").write_text(json.dumps(data))
    for command in ("check", "solve"):
        assert run(command, files / "bad.json") == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 2
        assert all(line.startswith("robotd-solver: ") and "bad.json stops[" in line for line in lines)


def test_mistakes_of_map_and_truth_are_printed_together(files, capsys):
    (files / "bad.json").write_text("{")
    (files / "bad.csv").write_text("label,x\n")
    assert run("evaluate", files / "bad.json", "--truth", files / "bad.csv") == 2
    err = capsys.readouterr().err
    assert "bad.json: not valid JSON at line 1" in err
    assert "bad.csv line 1" in err


@pytest.mark.parametrize(
    "arguments",
    [
        ["solve", "none.json"],
        ["solve", "survey.json", "-o", "none/map.json"],
        ["solve", "survey.json", "--known", "truth.json"],
        ["evaluate", "survey.json", "--truth", "truth.csv"],
        ["serve", "--token-file", "none"],
    ],
)
def test_bad_files_end_in_a_sentence_and_code_2(files, arguments, capsys, monkeypatch):
    monkeypatch.chdir(files)
    assert run(*arguments) == 2
    err = capsys.readouterr().err
    assert err.startswith("robotd-solver: ")
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "arguments", [[], ["solve"], ["solve", "a", "--method", "magic"], ["serve", "--port", "x"], ["evaluate", "m.json"]]
)
def test_a_wrong_command_line_ends_with_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        run(*arguments)
    assert caught.value.code == 2
    assert "usage: robotd-solver" in capsys.readouterr().err


def test_a_survey_that_cannot_be_solved_ends_with_code_1(files, capsys, monkeypatch):
    def refuse(survey, method):
        raise SolverError(f"survey {survey.survey}: it has no stop; drive a mission first")

    monkeypatch.setattr("robotd.solver.solve", refuse)
    assert run("solve", files / "survey.json") == 1
    assert capsys.readouterr().err == "robotd-solver: survey room: it has no stop; drive a mission first\n"


def test_serve_hands_address_folder_and_token_to_the_server(tmp_path, monkeypatch):
    calls = []
    monkeypatch.setattr("robotd.server.app.serve", lambda *arguments, **limits: calls.append((*arguments, limits)))
    (tmp_path / "token").write_text("secret\n")
    options = ["--host", "::1", "--port", "0", "--data", tmp_path / "data", "--token-file", tmp_path / "token"]
    assert run("serve", *options, "--recording-limit-gb", "2") == 0
    assert calls == [("::1", 0, tmp_path / "data", "secret", {"recording_limit": 2_000_000_000, "certificate": None})]


@pytest.mark.parametrize("content", [b"", b"\n", b"two words\n", b"\xff\xfe"])
def test_a_token_that_cannot_be_sent_is_refused(tmp_path, content, capsys):
    (tmp_path / "token").write_bytes(content)
    assert run("serve", "--token-file", tmp_path / "token") == 2
    assert "expected one line of ASCII letters and digits" in capsys.readouterr().err


def test_serving_without_the_web_stack_says_what_to_install(capsys, monkeypatch):
    for name in [name for name in sys.modules if name.startswith("robotd.server")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "fastapi", None)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert run("serve") == 1
    assert "install robotd[solver]" in capsys.readouterr().err


def test_help_loads_nothing_heavy():
    script = (
        "import sys\nfrom robotd.solver_main import main\n"
        "try: main(['--help'])\nexcept SystemExit: pass\n"
        "heavy = {name.split('.')[0] for name in sys.modules} & {'numpy', 'cv2', 'scipy', 'fastapi', 'matplotlib'}\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
