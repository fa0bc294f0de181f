"""The long run: the line follower in closed loop over many floors, lights, tapes and shapes of line.

    python -m tests.campaign.line [--seeds 100] [--first 0] [--cruise 0.3] [--camera floor]

prints one row a seed and the sums; as a test it fails if the line is lost once or the bounds are broken.
"""

import argparse
import dataclasses
import itertools
import math
import sys

import numpy as np

from robotd.sim.layout import Lamp, Tape
from robotd.sim.settings import FloorSettings, WorldSettings
from tests.line_course import TEXTURES, drive, store

SEEDS = 100
FLOOR_BOUND = {"rms": 10.0, "max": 30.0}  # mm
FRONT_BOUND = {"rms": 20.0}


def course(seed):
    """A random line of 4 to 7 m with corners, on a random floor in random light; returns layout, settings, length."""
    rng = np.random.default_rng([seed, 0x11E])
    corners, radius = _route(rng), float(rng.choice([0.0, 0.1, 0.2, 0.3]))
    texture = TEXTURES[seed % len(TEXTURES)]
    color = "bright" if texture in ("asphalt", "wood") and rng.random() < 0.5 else "dark"
    if texture == "asphalt":
        color = "bright"  # nobody lays dark tape on dark floor
    width = float(rng.choice([0.038, 0.05, 0.06]))
    lamps = _lamps(rng, corners)
    probe, _ = store(corners, radius=radius, width=width, color=color, texture=texture, lamps=lamps)
    line = probe.geometry
    gaps = []
    for _ in range(int(rng.integers(0, 3))):
        start = _on_straight(rng, line, 0.15)
        gaps += [(start, float(rng.uniform(0.03, 0.12)))] if start is not None else []
    tapes = []
    if rng.random() < 0.5 and (at := _on_straight(rng, line, 0.6)) is not None:  # a crossing
        angle = float(line.heading_at(at)) + float(rng.uniform(0.9, 2.2))
        centre, reach = line.point_at(at), np.array([math.cos(angle), math.sin(angle)])
        tapes.append(Tape((tuple(centre - 0.7 * reach), tuple(centre + 0.7 * reach)), width))
    if rng.random() < 0.4 and (at := _on_straight(rng, line, 0.8)) is not None:  # a second line beside ours
        heading, side = float(line.heading_at(at)), float(rng.choice([-1.0, 1.0])) * float(rng.uniform(0.14, 0.25))
        along, left = (np.array([math.cos(a), math.sin(a)]) for a in (heading, heading + math.pi / 2))
        middle = line.point_at(at) + side * left
        tapes.append(Tape((tuple(middle - 0.4 * along), tuple(middle + 0.4 * along)), width))
    tapes = tuple(Tape(tuple((float(x), float(y)) for x, y in tape.points), tape.width) for tape in tapes)
    layout = dataclasses.replace(probe, line=dataclasses.replace(probe.line, gaps=tuple(gaps)), tapes=tapes)
    floor = FloorSettings(
        noise=float(rng.uniform(1.0, 4.0)),
        blur=float(rng.uniform(0.6, 1.4)),
        unevenness=float(rng.uniform(0.1, 0.5)),
        dirt=float(rng.uniform(0.0, 0.5)),
    )
    return layout, WorldSettings(floor=floor), line.length


def _route(rng):
    """Corners of an open line that does not come near itself: legs of 0.9 to 1.6 m, turns of 30 to 90 degrees."""
    while True:
        points, heading = [np.zeros(2)], 0.0
        for _ in range(int(rng.integers(4, 6))):
            points.append(points[-1] + rng.uniform(0.9, 1.6) * np.array([math.cos(heading), math.sin(heading)]))
            turn = math.pi / 2 if rng.random() < 0.5 else rng.uniform(0.5, 1.4)
            heading += turn * rng.choice([-1.0, 1.0])
        points = np.array(points)
        s = np.linspace(0.0, 1.0, 20)[:, None]
        legs = [a + s * (b - a) for a, b in itertools.pairwise(points)]
        near = [
            np.hypot(*(one[:, None] - two[None]).reshape(-1, 2).T).min()
            for k, one in enumerate(legs)
            for two in legs[k + 2 :]
        ]
        if min(near) > 0.7 and np.ptp(points, axis=0).max() < 4.5:
            return points


def _lamps(rng, corners):
    """One to three lamps somewhere above, some low, so that light falls off steeply."""
    low, high = np.asarray(corners).min(axis=0) - 1.2, np.asarray(corners).max(axis=0) + 1.2
    size = high - low
    return tuple(
        Lamp((float(x * size[0]), float(y * size[1]), float(rng.uniform(1.2, 2.5))), float(rng.uniform(0.5, 1.5)))
        for x, y in rng.random((int(rng.integers(1, 4)), 2))
    )


def _on_straight(rng, line, room):
    """An arc length with `room` metres of straight line on either side, away from the ends; None if there is none."""
    s = np.arange(0.9, line.length - 0.6, 0.05)
    straight = [at for at in s if np.ptp(np.unwrap(line.heading_at(np.linspace(at - room, at + room, 25)))) < 1e-6]
    return float(rng.choice(straight)) if straight else None


def run(seed, cruise, camera="floor"):
    """Drive one course to 5 cm before its end."""
    layout, settings, length = course(seed)
    keys = {} if camera == "floor" else {"view_side": 0.7}
    return drive(layout, [length - 0.05], settings=settings, seed=seed, cruise=cruise, camera=camera, **keys), layout


def report(seeds, cruise, camera):
    """Print a row for each seed; returns (lost, rms values, max values)."""
    lost, rms, peak = [], [], []
    for seed in seeds:
        result, layout = run(seed, cruise, camera)
        line = layout.line
        states = {state.state for state in result.states} - {"acquiring", "tracking", "predicting", "standing"}
        print(
            f"{seed:4d} {layout.floor.texture:9s}{line.color:7s}{1e3 * line.width:3.0f} mm"
            f"  radius {line.corner_radius:.1f}"
            f"  gaps {len(line.gaps)}  tapes {len(layout.tapes)}  rms {result.cross_track['rms']:5.1f}"
            f"  max {result.cross_track['max']:5.1f} mm  {result.seconds:5.1f} s  {', '.join(sorted(states))}"
            f"{'' if result.fault is None else '  ' + result.fault}",
            flush=True,
        )
        rms.append(result.cross_track["rms"])
        peak.append(result.cross_track["max"])
        if result.fault is not None:
            lost.append(seed)
    return lost, np.array(rms), np.array(peak)


def test_the_line_is_never_lost_and_the_bounds_hold():
    lost, rms, peak = report(range(SEEDS), 0.3, "floor")
    assert lost == []
    assert rms.max() <= FLOOR_BOUND["rms"]
    assert peak.max() <= FLOOR_BOUND["max"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cruise", type=float, default=0.3)
    parser.add_argument("--camera", default="floor")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    lost, rms, peak = report(seeds, arguments.cruise, arguments.camera)
    print(f"{len(seeds)} seeds at {arguments.cruise} m/s: lost {lost or 'never'}; cross-track rms {rms.mean():.1f} mm "
          f"(worst {rms.max():.1f}), max {peak.max():.1f} mm")  # fmt: skip
    sys.exit(bool(lost))
