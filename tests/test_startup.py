"""Starting quickly: the code that dataclasses generate is kept, and may be lost or spoilt."""

import dataclasses
import os
import subprocess
import sys

import pytest

from robotd import startup
from robotd.startup import kept


def made():
    """A new dataclass, and how often it had code compiled."""

    @dataclasses.dataclass(frozen=True, slots=True, order=True)
    class Point:
        x: float
        y: float = 2.0

    return Point


@pytest.fixture
def compiled(monkeypatch):
    """What is compiled, in the order in which it is."""
    texts = []

    def watched(text, *more, **options):
        texts.append(text)
        return compile(text, *more, **options)

    monkeypatch.setattr(startup, "compile", watched, raising=False)
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return texts


def test_a_second_start_compiles_nothing_and_makes_the_same_classes(tmp_path, compiled):
    path = tmp_path / "cache" / "code.kept"
    with kept(path):
        first = made()
    assert compiled
    compiled.clear()
    with kept(path):
        second = made()
    assert not compiled
    for point in (first, second):
        assert repr(point(1.0)).endswith("Point(x=1.0, y=2.0)")
        assert point(1.0) == point(1.0, 2.0) < point(3.0)
        assert hash(point(1.0)) == hash(point(1.0))
        with pytest.raises(dataclasses.FrozenInstanceError):
            point(1.0).x = 2.0


def test_a_class_that_was_changed_is_compiled_anew(tmp_path, compiled):
    path = tmp_path / "code.kept"
    with kept(path):
        dataclasses.make_dataclass("Point", [("x", float)])
    compiled.clear()
    with kept(path):
        changed = dataclasses.make_dataclass("Point", [("x", float), ("z", float)])
    assert compiled
    assert changed(1.0, 2.0).z == 2.0


@pytest.mark.parametrize("spoilt", [b"", b"nonsense", b"cut", b"number"])
def test_a_spoilt_file_is_replaced(tmp_path, compiled, spoilt):
    path = tmp_path / "code.kept"
    with kept(path):
        made()
    good = path.read_bytes()
    head = startup.importlib.util.MAGIC_NUMBER
    path.write_bytes({b"cut": good[:100], b"number": head + startup.marshal.dumps(7)}.get(spoilt, spoilt))
    with kept(path):
        assert made()(1.0).y == 2.0
    compiled.clear()
    with kept(path):
        made()
    assert not compiled


def test_where_nothing_may_be_written_everything_works(tmp_path, compiled, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    with kept(tmp_path / "file" / "code.kept"):
        assert made()(1.0).y == 2.0
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    with kept(tmp_path / "code.kept"):
        assert made()(1.0).y == 2.0
    assert [item.name for item in tmp_path.iterdir()] == ["file"]


def test_the_check_of_a_configuration_leaves_what_the_service_needs(tmp_path):
    script = """
import sys
from pathlib import Path
from robotd import startup
from robotd.__main__ import main
main(["check", "-c", sys.argv[1]])
print(startup.place().exists())
startup._write = lambda path, known: print("compiled")
with startup.loading():
    import robotd.control_socket, robotd.daemon, robotd.operations, robotd.prompt, robotd.real, robotd.service
"""
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path / "pyc")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-c", script, "etc/robotd.toml"]
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert told.endswith("\nTrue\n")
