"""`robotd-solver plan` and `evaluate` on damaged files: words that name the file and the place, and no half output."""

import contextlib
import errno
import io
import json
import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from robotd.errors import InputError
from robotd.files import load_plan, map_to_json, survey_to_json
from robotd.plan_tool import load_line
from robotd.solver import solve
from robotd.solver.figure import save_picture
from robotd.solver_main import main
from tests.test_solver_main import TRUTH, a_survey
from tests.test_typed_json import damaged

SURVEY = survey_to_json(a_survey())
MAP = map_to_json(solve(a_survey()))
TABLE = "label,x,y,z\n" + "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in TRUTH.items())
LINE = "x,y\n0,0\n0,0.4\n0,0.8\n0.2,1.2\n"
ODD_CELLS = [
    "",
    "nan",
    "inf",
    "-1e308",
    "1e200",
    "1e5",
    "x",
    '"',
    '"a',
    "0x1",
    "1_0",
    "٣",
    "\0",
    "\x85",
    "1\r2",
    "A",
    " ",
]
OLD = b"what was there before"


def run(arguments):
    """Exit code, stdout and stderr of a command."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in arguments])
    return code, out.getvalue(), err.getvalue()


def refused(code, err, names):
    """Whether a command refused its files; then every line of it is a sentence, and of a wrong file with its name."""
    assert code in (0, 1, 2)
    if code:
        assert err.strip()
        assert all(line.startswith("robotd-solver: ") for line in err.splitlines())
        assert code == 1 or all(any(name in line for name in names) for line in err.splitlines())
    return code != 0


@st.composite
def damaged_tables(draw, text):
    """Bytes of a table with cells, rows, or bytes replaced."""
    rows = [line.split(",") for line in text.splitlines()]
    for _ in range(draw(st.integers(1, 3))):
        what = draw(st.sampled_from(["cell", "cell", "cell", "drop", "repeat", "longer", "swap"]))
        k = draw(st.integers(0 if what == "cell" else 1, len(rows) - 1)) if len(rows) > 1 else 0
        if what == "cell":
            rows[k][draw(st.integers(0, len(rows[k]) - 1))] = draw(st.sampled_from(ODD_CELLS) | st.text(max_size=4))
        elif what == "drop" and len(rows) > 1:
            del rows[k]
        elif what == "repeat":
            rows.append(list(rows[k]))
        elif what == "longer":
            rows[k].append("1")
        else:
            rows[k].reverse()
    data = draw(st.sampled_from(["\n", "\r\n", "\r"])).join(map(",".join, rows)).encode("utf-8", "surrogatepass")
    how = draw(st.sampled_from(["whole", "whole", "whole", "cut", "byte", "utf-16", "bom"]))
    if how == "cut":
        return data[: draw(st.integers(0, len(data)))]
    if how == "byte":
        at = draw(st.integers(0, len(data)))
        return data[:at] + draw(st.binary(min_size=1, max_size=2)) + data[at:]
    return (
        data.decode("utf-8", "replace").encode("utf-16")
        if how == "utf-16"
        else (b"\xef\xbb\xbf" * (how == "bom") + data)
    )


@st.composite
def damaged_files(draw, text):
    """Bytes of a JSON file with values replaced, removed or repeated; or cut, or with a wrong byte."""
    how = draw(st.sampled_from(["values", "values", "values", "cut", "byte"]))
    if how == "values":
        return json.dumps(damaged(json.loads(text), draw(st.data()))).encode()
    at = draw(st.integers(0, len(text)))
    return text[:at] if how == "cut" else text[:at] + draw(st.binary(min_size=1, max_size=2)) + text[at:]


def evaluated(map_bytes, table, align, as_json):
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder, name) for name in ("map.json", "truth.csv")}
        files["map.json"].write_bytes(map_bytes)
        files["truth.csv"].write_bytes(table)
        options = ["--align", align, *(["--json"] if as_json else [])]
        code, out, err = run(["evaluate", files["map.json"], "--truth", files["truth.csv"], *options])
    if refused(code, err, files):
        assert out == ""
    elif as_json:
        json.loads(out, parse_constant=pytest.fail)
    else:
        assert not {"nan", "inf"} & set(out.split())


ALIGN = st.sampled_from(["none", "se2", "se3"])


@given(damaged_tables(TABLE), ALIGN, st.booleans())
@settings(deadline=None, max_examples=150)
def test_evaluate_answers_a_damaged_truth_with_words(table, align, as_json):
    evaluated(MAP, table, align, as_json)


@given(damaged_files(MAP), ALIGN, st.booleans())
@settings(deadline=None, max_examples=100)
def test_evaluate_answers_a_damaged_map_with_words(data, align, as_json):
    evaluated(data, TABLE.encode(), align, as_json)


def planned(survey, line, old):
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder, name) for name in ("survey.json", "line.csv")}
        files["survey.json"].write_bytes(survey)
        files["line.csv"].write_bytes(line)
        out = Path(folder, "plan.json")
        if old:
            out.write_bytes(OLD)
        options = ["--line", files["line.csv"], "--stops", "2", "-o", out]
        code, printed, err = run(["plan", files["survey.json"], *options])
        assert printed == ""
        there = {path.name for path in Path(folder).iterdir()}
        if refused(code, err, files):
            assert there == {*files, *(["plan.json"] if old else [])}
            assert not old or out.read_bytes() == OLD
        else:
            assert there == {*files, "plan.json"}
            load_plan(out)


@given(damaged_files(SURVEY), st.booleans())
@settings(deadline=None, max_examples=60)
def test_plan_answers_a_damaged_survey_with_words_and_leaves_the_old_plan(data, old):
    planned(data, LINE.encode(), old)


@given(damaged_tables(LINE))
@settings(deadline=None, max_examples=100)
def test_a_damaged_line_is_read_or_named_by_line(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "line.csv")
        path.write_bytes(data)
        try:
            assert abs(load_line(path)).max() < 1e4
        except InputError as error:
            assert all((text.startswith(str(path)) and "expected" in text) or "save" in text for text in error.problems)


def test_a_line_with_a_cell_larger_than_any_reader_takes_is_no_table(tmp_path):
    (tmp_path / "line.csv").write_text('x,y\n"' + "1" * 200_000 + '",2\n')
    with pytest.raises(InputError, match=r"line.csv: not a table: .*; expected the header x,y"):
        load_line(tmp_path / "line.csv")


def test_a_picture_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "map.png"
    save_picture(path, b"old")
    write = Path.write_bytes

    def full(self, data):
        write(self, data[:2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"map\.png: cannot be written: No space left on device"):
        save_picture(path, b"new one")
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["map.png"]
