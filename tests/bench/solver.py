"""From survey to map, and the bundle adjustment alone against Ceres, GTSAM and scipy on the same problems.

All are timed in CPU seconds on one thread, from the same start to a cost within 1e-4 of the tight optimum, analysis of
the problem's structure included; `python -m tests.bench.solver` prints these alone, 8000 stops and memory included.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.optimize
import scipy.sparse

from robotd.files import load_survey, survey_from_json, survey_to_json
from robotd.solver import GrowingMap, solve
from robotd.solver.bundle import SQUARE, Adjustment
from robotd.solver.kernel import compiled
from robotd.solver.problem import State

from . import ceres, gtsam, stores
from .table import Row, median_ms

SURVEY = Path(__file__).parent / "room.survey.json"


def rows() -> list[Row]:
    """From survey to map, against reading the same survey's JSON; bundle adjustment against Ceres and scipy."""
    survey = load_survey(SURVEY)
    text = SURVEY.read_bytes()
    reading = median_ms(lambda: json.loads(text), 50)
    whole = [
        Row(
            f"solve the demo's room, {method}",
            median_ms(lambda method=method: solve(survey, method=method), 5),
            "json.loads",
            reading,
        )
        for method in ("bundle", "linear")
    ]
    return whole + [row for size in ("room", "100", "1000") for row in against(size, 5)] + whole_store("1000")


def against(size: str, repeats: int) -> list[Row]:
    """Bundle adjustment of one size against what is installed."""
    store = stores.make_store(*stores.SIZES[size])
    problem = stores.problem_of(store)
    start = stores.drifted(store, problem)
    adjustment = Adjustment(problem, problem.sightings)
    # by an adjustment of its own, because the memory of two is not what one needs
    tight = Adjustment(problem, problem.sightings).solve(start, SQUARE, iterations=60, tolerance=1e-6).cost
    what = f"bundle adjustment, {len(store.poses)} stops, {len(store.label)} sightings"
    result = []
    if ceres.program() is not None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "problem")
            ceres.write(path, adjustment, start)
            methods = ("sparse", "dense") if len(store.poses) <= 100 else ("sparse",)
            its, seconds = ceres.fastest(path, methods, repeats)
        if abs(its / tight - 1.0) > 1e-4:
            raise RuntimeError(f"Ceres ended at cost {its}, the product at {tight}: not the same optimum")
        result.append(Row(what, ours(adjustment, start, tight, repeats), "Ceres", 1e3 * seconds))
    if len(store.poses) <= 100 and gtsam.module() is not None:
        theirs = min(gtsam.seconds(adjustment, start, tight) for _ in range(repeats))
        result.append(Row(what, ours(adjustment, start, tight, repeats), "GTSAM", 1e3 * theirs))
    if len(store.poses) <= 100:
        result.append(
            Row(what, ours(adjustment, start, tight, repeats), "scipy", 1e3 * _scipy(adjustment, start, tight))
        )
    return result


def ours(adjustment: Adjustment, start: State, tight: float, repeats: int) -> float:
    """Least CPU milliseconds of the compiled solver, its analysis included as Ceres' is."""
    best = np.inf
    points = start.points[adjustment.labels]
    for _ in range(repeats):
        kernel = compiled(adjustment)
        if kernel is None:
            raise RuntimeError("the extensions were not built; run make build")
        begun = time.process_time()
        _, _, cost, _, _ = kernel.solve(start.frame, points, 0, 0.0, 4.0, np.inf, 60, 2e-5 * tight)
        best = min(best, time.process_time() - begun)
        if cost > tight * (1.0 + 1e-4):
            raise RuntimeError(f"ended at cost {cost}, not within 1e-4 of {tight}")
    return 1e3 * best


def _scipy(adjustment: Adjustment, start: State, tight: float) -> float:
    """CPU seconds of scipy's least_squares with the sparse analytic Jacobian."""
    free, labels = adjustment.problem.free, adjustment.labels
    size, m = adjustment.size, adjustment.problem.moves

    def state(x: np.ndarray) -> State:
        frame, points = start.frame.copy(), start.points.copy()
        frame[free] = x[:size]
        points[labels] = x[size:].reshape(-1, 3)
        return State(frame, points)

    def residuals(x: np.ndarray) -> np.ndarray:
        r = adjustment.residuals(state(x), SQUARE)
        return np.concatenate([r.residual.ravel(), r.move.ravel()])

    def jacobian(x: np.ndarray) -> scipy.sparse.csr_matrix:
        linear = adjustment.linearise(state(x), SQUARE)
        count = len(linear.residual)
        columns = np.concatenate(
            [adjustment.columns[adjustment.entries], size + 3 * adjustment.point[:, None] + np.arange(3)], axis=1
        )
        values = np.concatenate([linear.by_frame, linear.by_point], axis=2)
        rows_ = np.broadcast_to((2 * np.arange(count)[:, None] + [0, 1])[:, :, None], values.shape)
        at = np.broadcast_to(columns[:, None], values.shape)
        entries = np.concatenate([5 * m.before[:, None] + np.arange(3), 5 * m.after[:, None] + np.arange(3)], axis=1)
        moves = np.concatenate([linear.move_before, linear.move_after], axis=2)
        move_rows = np.broadcast_to(
            (2 * count + 3 * np.arange(len(moves))[:, None] + np.arange(3))[:, :, None], moves.shape
        )
        move_at = np.broadcast_to(adjustment.columns[entries][:, None], moves.shape)
        i, j, v = (
            np.concatenate([a.ravel(), b.ravel()]) for a, b in ((rows_, move_rows), (at, move_at), (values, moves))
        )
        kept = j >= 0
        shape = (2 * count + 3 * len(moves), size + 3 * len(labels))
        return scipy.sparse.csr_matrix((v[kept], (i[kept], j[kept])), shape=shape)

    x0 = np.concatenate([start.frame[free], start.points[labels].ravel()])
    begun = time.process_time()
    done = scipy.optimize.least_squares(residuals, x0, jacobian, method="trf", x_scale="jac", ftol=1e-5, xtol=1e-12)
    seconds = time.process_time() - begun
    if done.cost > tight * (1.0 + 1e-4):
        raise RuntimeError(f"scipy ended at cost {done.cost}, not within 1e-4 of {tight}")
    return seconds


def whole_store(size: str) -> list[Row]:
    """From a raw survey to its map, and the update after one stop more, in CPU milliseconds; against json.loads."""
    store = stores.make_store(*stores.SIZES[size])
    survey = stores.survey_of(store)
    data = survey_to_json(survey)
    reading = median_ms(lambda: json.loads(data), 5)
    spent, placed = [], 0
    for _ in range(3):
        begun = time.process_time()
        result = solve(survey_from_json(data, "bench"))
        spent.append(time.process_time() - begun)
        placed = sum(label.status == "placed" for label in result.labels)
    growing = GrowingMap(replace(survey, stops=survey.stops[:-20]))
    updates = []
    for stop in survey.stops[-20:]:
        begun = time.process_time()
        growing.add_stop(stop)
        updates.append(time.process_time() - begun)
    what = f"{len(store.poses)} stops"
    return [
        Row(f"raw survey to map, {what} ({placed} labels placed)", 1e3 * min(spent), "json.loads", reading),
        Row(f"update after one stop more, {what}", 1e3 * float(np.median(updates)), "json.loads", reading),
    ]


def main() -> None:
    """Print the rows of all sizes and the memory that the largest took."""
    sizes = sys.argv[1:] or list(stores.SIZES)
    for size in sizes:
        for row in against(size, 1 if size == "8000" else 5):
            ratio = row.yardstick_ms / row.ms
            print(f"{row.part:<52} {row.ms:>10.2f} ms   {row.yardstick} {row.yardstick_ms:>10.2f} ms   {ratio:>6.2f}x")
    print(f"most memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
