"""Ceres as a yardstick: builds `native/planar.cpp` where its headers are installed, and runs it on a problem."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from robotd.records import Floats
from robotd.solver.bundle import Adjustment
from robotd.solver.problem import State

SOURCE = Path(__file__).parent / "native" / "planar.cpp"
HEADERS = ("/usr/include", "/usr/local/include")


@dataclass(frozen=True)
class Run:
    """How a solution went: cost after every iteration, and CPU seconds until then."""

    costs: Floats
    seconds: Floats


@cache
def program() -> Path | None:
    """The compiled program; None without a C++ compiler or Ceres' headers."""
    compiler = shutil.which("g++")
    if compiler is None or not any(Path(base, "ceres", "ceres.h").exists() for base in HEADERS):
        return None
    out = Path(tempfile.mkdtemp(prefix="robotd-bench-")) / "planar"
    flags = ["-O3", "-march=native", "-std=c++17", "-I/usr/include/eigen3"]
    subprocess.run([compiler, *flags, "-o", str(out), str(SOURCE), "-lceres", "-lglog"], check=True)
    return out


def write(path: Path, adjustment: Adjustment, state: State) -> None:
    """Write a planar problem whose labels all have sightings, for `run`."""
    problem, s = adjustment.problem, adjustment.sightings
    poses = problem.stop_entries(state)[:, :3]
    order = np.lexsort((s.stop, adjustment.point))
    R = problem.R_robot_camera.transpose(0, 2, 1).reshape(-1, 9)
    lens = np.array([c.model.matrix for c in problem.cameras])
    arrays = [
        np.array([len(poses), len(adjustment.labels), len(s), len(problem.moves.before), len(R)]),
        poses,
        state.points[adjustment.labels],
        s.uv[order],
        np.column_stack([problem.moves.measured, adjustment.move_roots.reshape(-1, 9)]),
        np.column_stack([R, problem.t_robot_camera, lens]),
        np.column_stack([s.stop, s.camera, adjustment.point])[order],
        np.column_stack([problem.moves.before, problem.moves.after]),
    ]
    path.write_bytes(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays))


def run(path: Path, method: str, iterations: int, tolerance: float) -> Run:
    """Solve a written problem with "sparse" or "dense" Schur elimination, on one thread."""
    built = program()
    assert built is not None
    done = subprocess.run(
        [str(built), str(path), method, str(iterations), str(tolerance)], check=True, capture_output=True, text=True
    )
    numbers = np.array(done.stdout.split(), dtype=float).reshape(-1, 2)
    return Run(numbers[:, 0], numbers[:, 1])


def fastest(path: Path, methods: tuple[str, ...], repeats: int) -> tuple[float, float]:
    """Tight cost, and least CPU seconds in which Ceres comes within 1e-4 of it."""
    runs = [run(path, method, 60, 1e-10) for method in methods for _ in range(repeats)]
    tight = min(float(r.costs.min()) for r in runs)
    return tight, min(float(r.seconds[np.argmax(r.costs <= tight * (1.0 + 1e-4))]) for r in runs)
