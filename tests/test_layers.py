"""The layers of ARCHITECTURE.md, read from the imports: who may know whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

LAYERS = {
    0: ["errors", "records", "survey_records"],
    1: [
        "beacons",
        "bind",
        "capture_clock",
        "geometry",
        "oi",
        "oi_packets",
        "jpeg",
        "multipart",
        "odometry",
        *("mission_states", "mission_guards"),
        "path_error",
        "wheel_calibration",
        "toml_edit",
        *("typed_json", "_json_keys"),
        "rpc",
        *("follow", "drive_path", "lost_line"),
        "identify",
        "safety",
        "vision",
        "solver",
        *("sighting_columns", "_sightings"),
        "survey_checks",
        "plan_records",
    ],
    2: [
        *("clock", "link", "real", "config", "files", "bus", "hardware", "journal", "upload", "telemetry", "recording"),
        *("recording_upload", "collected", "flash_recording", "sender", "label_list"),
        *("journal_file", "journal_records", "secret_file", "web"),
        *("serial_log", "roomba", "ticker", "guardian", "notify", "serial_port"),
        *("camera_feed", "prompt", "footage", "v4l2", "v4l2_api", "v4l2_controls"),
        "roof",
    ],
    3: ["plugin", "camera_driver", "workbench"],
    4: ["drivers"],
    5: [
        *("mission", "mission_steps", "mission_keeper", "observation", "label_source"),
        "control",
        "roof_watch",
        "wheel_runs",
        "recorder",
        *("supervisor", "service", "startup"),
        "control_socket",
        "daemon",
        "config_views",
        "operations",
    ],
    6: ["sim", "server"],
    7: [
        "__main__",
        "demo",
        "line_tool",
        "floor_tool",
        "record_tool",
        "workbench_tool",
        "workbench_commands",
        "demo_roof",
        "roof_tool",
        "plan_tool",
        "roof_commands",
        "lens_tool",
        "flash_tool",
        "rig_commands",
        "rig_tool",
        "time_tool",
        "lens_commands",
        "calibrate",
        "doctor",
        "doctor_checks",
        "solver_main",
    ],
}
APART = {"ctl": {"ctl", "__version__"}, "gateway": {"errors"}}
APART |= {"guardian": {"errors", "serial_port"}, "serial_port": {"errors"}}  # and pyserial: the guardian's process
LAYER = {name: layer for layer, names in LAYERS.items() for name in names}
MAY = {
    0: {0},
    1: {0, 1},
    2: {0, 1, 2},
    3: {0, 1, 2, 3},
    4: {0, 1, 2, 3},
    5: {0, 1, 2, 3, 5},
    6: {0, 1, 2, 3},
    7: {0, 1, 2, 3, 4, 5, 6, 7},
}
NO_SCIPY = {name for layer in range(6) for name in LAYERS[layer]} - {"solver"}


def sources():
    for path in sorted((ROOT / "robotd").rglob("*.py")):
        relative = path.relative_to(ROOT).with_suffix("")
        if "drivers" not in relative.parts:
            yield ".".join(part for part in relative.parts if part != "__init__"), path
    for path in sorted((ROOT / "drivers").glob("*.py")):
        yield f"robotd.drivers.{path.stem}" if path.stem != "__init__" else "robotd.drivers", path


def imports(module, path):
    """Absolute names of what a file imports, inside functions too, but not under TYPE_CHECKING."""
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                base = package[: len(package) - node.level + 1]
                name = ".".join([*base, *(node.module.split(".") if node.module else [])])
            else:
                name = node.module
            if name in ("robotd", "robotd.drivers"):
                yield from (f"{name}.{alias.name}" for alias in node.names)
            else:
                yield name


MODULES = dict(sources())


def top(name):
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else ""


@pytest.mark.parametrize("module", [name for name in MODULES if name != "robotd"])
def test_a_module_imports_only_layers_below_it(module):
    part = top(module)
    used = {name for name in imports(module, MODULES[module]) if name.startswith("robotd.")}
    if part in APART:
        assert {top(name) for name in used} <= APART[part], f"{module} stands apart: it may import {APART[part]} only"
        return
    assert part in LAYER, f"{module} is in no layer; add it to ARCHITECTURE.md and to this table"
    for name in used:
        other = top(name)
        if other == "__version__" or other == part:
            continue
        assert LAYER[other] in MAY[LAYER[part]], f"{module} (layer {LAYER[part]}) imports {name} (layer {LAYER[other]})"
        assert not (LAYER[part] == 6 and LAYER[other] == 6), f"{module} imports {name}: sim and server stay apart"


def test_drivers_never_import_one_another():
    for module, path in MODULES.items():
        if top(module) == "drivers":
            others = {name for name in imports(module, path) if name.startswith("robotd.drivers.")}
            assert not others, f"{module} imports {others}"


def test_only_the_programs_know_the_simulator():
    for module, path in MODULES.items():
        if top(module) not in ("sim", "demo", "demo_roof", "__main__"):
            known = {name for name in imports(module, path) if name.startswith("robotd.sim")}
            assert not known, f"{module} imports {known}"


def test_the_solver_and_scipy_stay_off_the_robot():
    for module, path in MODULES.items():
        if top(module) in NO_SCIPY:
            heavy = {name for name in imports(module, path) if name.split(".")[0] in ("scipy", "fastapi", "matplotlib")}
            heavy |= {name for name in imports(module, path) if name.startswith("robotd.solver")}
            assert not heavy, f"{module} imports {heavy}"


def test_the_daemon_loads_neither_scipy_nor_the_web_stack():
    script = """
import sys
from robotd.__main__ import main
assert main(["check", "-c", sys.argv[1]]) == 0
import robotd.daemon, robotd.mission, robotd.real
assert not {"aiohttp", "mcap"} & sys.modules.keys()  # a second of a Pi's time; network cameras and recordings need them
from robotd.plugin import available
for point in available().values():
    point.load()
banned = {"scipy", "fastapi", "uvicorn", "starlette", "matplotlib", "pydantic"}
heavy = sorted({name.split(".")[0] for name in sys.modules} & banned)
assert not heavy, heavy
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(ROOT / "etc" / "robotd.toml")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr + done.stdout


@pytest.mark.parametrize("module", [name for name in MODULES if top(name) not in ("sim",)])
def test_nobody_reads_the_wall_clock(module):
    """Time is the event loop's; dates come from `hardware.utc()`; programs may time themselves."""
    if top(module) in (
        "demo",
        "real",
        "gateway",
        "server",
        "solver_main",
        "solver",
        "guardian",
        "serial_port",
        "ctl",
        "doctor",
    ):
        return
    banned = {("time", "time"), ("time", "monotonic"), ("time", "sleep"), ("datetime", "now"), ("datetime", "utcnow")}
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            assert (node.value.id, node.attr) not in banned, f"{module}:{node.lineno} reads the wall clock"
