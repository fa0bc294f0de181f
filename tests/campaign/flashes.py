"""The long run: recall, precision and centroid error of the flash detector on films that no threshold was chosen on.

    python -m tests.campaign.flashes [--sets 4] [--seed 100] [--only JPEG]

prints one row a kind of film; as a test it fails where a figure misses its bound. A set has 15 films with 31 labels,
one of which hangs where the picture is white, so that 96.8 % is the most that can be found.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import cv2

from robotd.errors import InputError
from robotd.vision.learn_pattern import learn_pattern
from robotd.vision.pattern import FlashPattern
from robotd.workbench.score import Score
from tests.flashes.__main__ import judge
from tests.flashes.film import frames
from tests.flashes.scenes import LABELS, Options, scene

SETS, SEED = 4, 100


@dataclass(frozen=True)
class Kind:
    """A kind of film and what is asked of it: (recall, precision) by the second at which it is judged."""

    name: str
    options: Options
    asked: dict[float, tuple[float, float]]
    learn: bool = False
    method: str = "robotd"


FULL = {2.0: (0.93, 0.98), 16.0: (0.96, 0.99)}
KINDS = (
    Kind("30 fps", Options(), FULL),
    Kind("30 fps, JPEG 60", Options(jpeg=60), {16.0: (0.0, 0.0)}),
    Kind("10 fps", Options(fps=10.0), {16.0: (0.95, 0.93)}),
    Kind("30 fps, a reflection of every label", Options(reflections=True), {16.0: (0.96, 0.92)}),
    Kind("learnt: 2 flashes", Options(FlashPattern(1.0, [(0.0, 0.1), (0.2, 0.3)])), FULL, learn=True),
    Kind(
        "learnt: 4 flashes in 1.2 s",
        Options(FlashPattern(1.2, [(0.0, 0.1), (0.2, 0.3), (0.4, 0.5), (0.6, 0.7)])),
        FULL,
        learn=True,
    ),
    Kind(
        "learnt: 30 ms flashes", Options(FlashPattern(1.0, [(0.0, 0.03), (0.2, 0.23), (0.4, 0.43)])), FULL, learn=True
    ),
    Kind("the thesis's detector, 10 fps", Options(fps=10.0), {16.0: (0.0, 0.0)}, method="thesis"),
    Kind("the thesis's detector, 30 fps", Options(), {16.0: (0.0, 0.0)}, method="thesis"),
)


def measure(kind: Kind, sets: int, seed: int) -> dict[float, Score]:
    """Scores of one kind of film by the second at which they were taken."""
    scores = {second: Score() for second in kind.asked}
    pattern = _learnt(kind, seed) if kind.learn else kind.options.pattern
    for number in range(sets * len(LABELS)):
        judge(kind.method, pattern, number % len(LABELS), seed + number // len(LABELS), kind.options, scores)
    return scores


def _learnt(kind: Kind, seed: int) -> FlashPattern:
    """The pattern from a recording in which somebody points at the label among the shop's other lights.

    Where that is refused, from a longer one, then from one of another label.
    """
    refused = ""
    for label in range(seed, seed + 3):
        for seconds in (10.0, 20.0):
            shown = scene(1, label, replace(kind.options, seconds=seconds, crowd=0.0))
            try:
                at = (shown.labels[0].u, shown.labels[0].v)
                return learn_pattern(*frames(shown), exposure=shown.exposure, near=at).pattern
            except InputError as error:
                refused = f"label {label}, {seconds:.0f} s: {error}"
                print(f"{kind.name}: not learnt: {refused}")
    raise AssertionError(f"{kind.name}: learnt from no recording, the last one {refused}")


def table(sets: int, seed: int, only: str = "") -> list[str]:
    """Print a row for each kind whose name contains `only`; what was missed, in words."""
    missed = []
    print(f"{'films':<36} {'s':>5} {'labels':>7} {'recall %':>9} {'precision %':>12} {'rms px':>8}")
    for kind in (kind for kind in KINDS if only in kind.name):
        for second, score in measure(kind, sets, seed).items():
            recall, precision = 100.0 * score.recall, 100.0 * score.precision
            row = f"{kind.name:<36} {second:>5.1f} {score.labels:>7} {recall:>9.1f} {precision:>12.1f}"
            print(f"{row} {score.rms_px:>8.3f}", flush=True)
            for what, got, asked in zip(("recall", "precision"), (recall, precision), kind.asked[second], strict=True):
                if got < 100.0 * asked:
                    missed.append(f"{kind.name}, {second:.0f} s: {what} {got:.1f} %, asked {100.0 * asked:.0f} %")
    return missed


def test_the_detector_finds_what_is_asked():
    assert not table(1, SEED)


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaign.flashes", description="Judge the flash detector.")
    parser.add_argument("--sets", type=int, default=SETS)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--only", default="", metavar="WORD", help="only kinds whose name contains it")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    missed = table(options.sets, options.seed, options.only)
    print("\n".join(missed))
    return int(bool(missed))


if __name__ == "__main__":
    raise SystemExit(main())
