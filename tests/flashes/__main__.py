"""`python -m tests.flashes`: recall, precision and centroid error of a detector on films like the thesis's table 1.

python -m tests.flashes                                   30 fps, 16 s, also after the first 2 and 4 s; one set of 15
python -m tests.flashes --fps 10 --sets 4
python -m tests.flashes --reflections                     every label has a reflection in its own phase
python -m tests.flashes --period 1.2 --on 0,0.03 0.2,0.23 --learn    the pattern is learnt from a film of one label
python -m tests.flashes --method thesis --fps 10          the thesis's detector
python -m tests.flashes --jpeg 60
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import cv2
import numpy as np

from robotd.vision.blink import FlashConfig, FlashDetector
from robotd.vision.learn_pattern import learn_pattern
from robotd.vision.pattern import FlashPattern
from robotd.vision.thesis_blink import ThesisFlashConfig, ThesisFlashDetector
from robotd.workbench.score import Score

from .film import frames
from .scenes import LABELS, Options, scene


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.flashes", description="Judge flash detectors.")
    parser.add_argument("--method", choices=("robotd", "thesis"), default="robotd")
    parser.add_argument("--sets", type=int, default=1, metavar="N", help="sets of 15 films with 31 labels")
    parser.add_argument("--seed", type=int, default=0, help="of the first set")
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=16.0)
    parser.add_argument("--cuts", type=float, nargs="*", default=[2.0, 4.0], help="also after so many seconds")
    parser.add_argument("--reflections", action="store_true")
    parser.add_argument("--jpeg", type=int, metavar="QUALITY")
    parser.add_argument("--period", type=float, default=1.0)
    parser.add_argument("--on", type=_interval, nargs="+", default=list(FlashPattern().on), metavar="START,END")
    parser.add_argument("--learn", action="store_true", help="learn the pattern instead of being told")
    parser.add_argument("--misses", action="store_true", help="list what was missed and what was false")
    options = parser.parse_args(argv)
    cv2.setNumThreads(1)
    pattern = FlashPattern(options.period, tuple(options.on))
    common = Options(
        pattern=pattern,
        seconds=options.seconds,
        fps=options.fps,
        reflections=options.reflections,
        jpeg=options.jpeg,
    )
    if options.learn:
        film, stamps = frames(scene(1, 1000 + options.seed, Options(pattern=pattern, seconds=10.0, crowd=0.0)))
        learnt = learn_pattern(film, stamps)
        pattern = learnt.pattern
        sure = f"confidence {learnt.confidence:.4f}, edges to {1e3 * learnt.edge_sigma:.1f} ms"
        print(f"learnt with {sure}: {learnt.toml()}")
    cuts = [*sorted(cut for cut in options.cuts if cut < options.seconds), options.seconds]
    scores = {cut: Score() for cut in cuts}
    for seed in range(options.seed, options.seed + options.sets):
        for number in range(len(LABELS)):
            judge(options.method, pattern, number, seed, common, scores)
    print(f"{'seconds':>8} {'labels':>7} {'recall %':>9} {'precision %':>12} {'reflections':>12} {'rms px':>8}")
    for cut, score in scores.items():
        shares = f"{100.0 * score.recall:>9.1f} {100.0 * score.precision:>12.1f}"
        print(f"{cut:>8.1f} {score.labels:>7} {shares} {score.mirrored:>12} {score.rms_px:>8.3f}")
        if options.misses:
            print("\n".join(f"    {line}" for line in score.missed))
    return 0


def judge(
    method: str, pattern: FlashPattern, number: int, seed: int, options: Options, scores: dict[float, Score]
) -> None:
    """Show one film to a detector, and score what it has found at each time in `scores`."""
    shown = scene(number, seed, options)
    film, stamps = frames(shown)
    detector = (
        FlashDetector(FlashConfig(pattern=pattern, gamma=options.gamma))
        if method == "robotd"
        else ThesisFlashDetector(ThesisFlashConfig(pattern=pattern))
    )
    waiting = sorted(scores)
    for frame, t in zip(film, stamps, strict=True):
        while len(waiting) > 1 and t - stamps[0] >= waiting[0]:
            scores[waiting.pop(0)].add(detector.flashes(), shown.labels, shown.mirrored, f"{seed}/{number}")
        detector.update(frame, float(t))
    for cut in waiting:
        scores[cut].add(detector.flashes(), shown.labels, shown.mirrored, f"{seed}/{number}")


def _interval(text: str) -> tuple[float, float]:
    start, end = (float(part) for part in text.split(","))
    return start, end


if __name__ == "__main__":
    np.seterr(all="raise", under="ignore")
    raise SystemExit(main())
