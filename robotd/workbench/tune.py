"""Search settings of a detector that do best on one set of footage; how good they are is told by another set."""

from __future__ import annotations

import hashlib
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from .detectors import make_detector
from .score import Score
from .sequence import Tagged, judge_clips

BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class Range:
    """Values that one setting may take: between two numbers (evenly in their logarithm if so wanted), or of a list."""

    name: str
    low: float = 0.0
    high: float = 0.0
    choices: tuple[Any, ...] = ()
    is_log: bool = False
    is_whole: bool = False

    def draw(self, rng: random.Random) -> Any:
        """One value, all equally likely."""
        if self.choices:
            return rng.choice(self.choices)
        if self.is_log:
            value = math.exp(rng.uniform(math.log(self.low), math.log(self.high)))
        else:
            value = rng.uniform(self.low, self.high)
        return round(value) if self.is_whole else float(f"{value:.4g}")

    def near(self, value: Any, rng: random.Random) -> Any:
        """One value in the neighbourhood of another: within a fifth of the range."""
        if self.choices:
            return rng.choice(self.choices)
        if self.is_log:
            step = rng.uniform(-0.2, 0.2) * math.log(self.high / self.low)
            moved = value * math.exp(step)
        else:
            moved = value + rng.uniform(-0.2, 0.2) * (self.high - self.low)
        moved = min(max(moved, self.low), self.high)
        return round(moved) if self.is_whole else float(f"{moved:.4g}")


def parse_range(text: str) -> Range:
    """NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C; raises InputError."""
    name, equals, rest = text.partition("=")
    wanted = f"parameter {text!r}: expected NAME=LOW:HIGH, NAME=LOW:HIGH:log or NAME=A,B,C"
    if not equals or not name.strip().isidentifier():
        raise InputError(wanted)
    parts = rest.split(":")
    try:
        if len(parts) == 1:
            choices = tuple(_number(item) for item in rest.split(","))
            return Range(name.strip(), choices=choices)
        low, high = (_number(part) for part in parts[:2])
    except ValueError:
        raise InputError(wanted) from None
    is_log = parts[2:] == ["log"]
    if (parts[2:] and not is_log) or not low < high or (is_log and low <= 0):
        raise InputError(wanted)
    return Range(name.strip(), low, high, is_log=is_log, is_whole=isinstance(low, int) and isinstance(high, int))


def _number(text: str) -> Any:
    text = text.strip()
    if text in ("true", "false"):
        return text == "true"
    try:
        return int(text)
    except ValueError:
        value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Settings and how they did on the tuning set."""

    settings: dict[str, Any]
    score: Score
    value: float


def score_set(
    tagged: Sequence[Tagged], detector: str, settings: Mapping[str, Any], clip_s: float | None, after: float = math.inf
) -> Score:
    """How a detector with these settings does on a set of footage."""
    scores = {after: Score()}
    for one in tagged:
        judge_clips(one, lambda one: make_detector(detector, settings, one.taken), scores, clip_s=clip_s)
    return scores[after]


def objective(score: Score, min_precision: float | None) -> float:
    """What is maximised: F1; or recall, where precision is at least so high, and precision below that."""
    if min_precision is None:
        return score.f1
    return score.recall if score.precision >= min_precision and score.found else score.precision - 1.0


def tune(
    tagged: Sequence[Tagged],
    detector: str,
    settings: Mapping[str, Any],
    ranges: Sequence[Range],
    *,
    trials: int,
    seed: int,
    clip_s: float | None = None,
    min_precision: float | None = None,
    tell: Callable[[int, Trial], None] = lambda number, trial: None,
) -> list[Trial]:
    """Try settings: those given first, then drawn ones for half of the trials, then neighbours of the best.

    Parameters
    ----------
    tagged : sequence of Tagged
        The tuning set, with marks.
    settings : mapping
        Of the detector, where they are not searched.
    tell : callable
        Gets number and result of each trial.

    Returns
    -------
    list of Trial
        Best first; of equals the one tried first.

    Raises
    ------
    InputError
        Without a label in the set there is nothing to tune for; or a value is none that the detector takes.
    """
    if not any(tag.kind == "label" for one in tagged for tag in one.tags):
        raise InputError("the tuning set has no marked label; mark some with robotd-solver workbench tag")
    rng = random.Random(seed)
    done: list[Trial] = []
    for number in range(trials):
        best = max(done, key=lambda trial: trial.value, default=None)
        if best is None:
            tried: dict[str, Any] = {}
        elif number <= trials // 2:
            tried = {one.name: one.draw(rng) for one in ranges}
        else:
            tried = {
                one.name: one.near(best.settings[one.name], rng) if one.name in best.settings else one.draw(rng)
                for one in ranges
            }
        score = score_set(tagged, detector, {**settings, **tried}, clip_s)
        trial = Trial({**settings, **tried}, score, objective(score, min_precision))
        done.append(trial)
        tell(number, trial)
    return sorted(done, key=lambda trial: -trial.value)


def shared(first: Sequence[Path], second: Sequence[Path]) -> list[Path]:
    """Footage of the second set whose content is in the first one, too, whatever it is called."""
    known = {_digest(path) for path in first}
    return [path for path in second if _digest(path) in known]


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as source:
                while block := source.read(BLOCK):
                    digest.update(block)
    return digest.hexdigest()
