"""A line of the table, and how its times are taken."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Row:
    """One line of the table: milliseconds of the part and of its yardstick."""

    part: str
    ms: float
    yardstick: str
    yardstick_ms: float


def median_ms(function: Callable[[], object], repeats: int) -> float:
    """Median time of one call in milliseconds, after a tenth of the calls as warm-up."""
    times = []
    for k in range(repeats + repeats // 10 + 1):
        begun = time.perf_counter()
        function()
        if k > repeats // 10:
            times.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(times))
