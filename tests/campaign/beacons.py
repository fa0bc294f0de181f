"""Minutes of real time: how late the beacons' edges are while every core is busy, by thread and by event loop."""

import asyncio
import os
import subprocess
import sys
from contextlib import ExitStack

import numpy as np
import pytest
from gpiozero.pins.mock import MockFactory, MockPin
from robotd.drivers.gpio_beacons import BeaconConfig, BeaconDriver

from robotd.bus import Bus
from robotd.clock import now, stall
from robotd.config import Calibration
from robotd.ticker import LoopTicker, ThreadTicker

SECONDS = float(os.environ.get("ROBOTD_BEACON_SECONDS", "60"))
BUSY = "while True: sum(range(10000))"
PAUSE_S, HELD_S = 0.020, 0.010  # of the event loop: it is held up for 10 ms a third of the time


class Bench:
    """A Hardware with mock pins that note when they were switched, on the loop's clock."""

    def __init__(self, kind):
        self.ticker = kind
        self.times = times = []
        loop = asyncio.get_running_loop()

        class Pin(MockPin):
            def _set_state(self, value):
                if super().state != value:
                    times.append((self.info.name, loop.time()))
                super()._set_state(value)

        self.pins = MockFactory(pin_class=Pin)


async def busy_loop(python_s):
    """Hold the loop up: for so long by Python code, for the rest by code that frees the interpreter, as vision does."""
    while True:
        await asyncio.sleep(PAUSE_S)
        end = now() + python_s
        while now() < end:
            pass
        stall(HELD_S - python_s)


def has_real_time_priority():
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


async def lateness(kind, python_s, seconds):
    """Seconds by which each edge came after its deadline, and the relative error of the front's rate."""
    bench = Bench(kind)
    driver = BeaconDriver("beacons", BeaconConfig(front_pin=17, rear_pin=27), bench, Bus(), Calibration())
    background = asyncio.create_task(busy_loop(python_s))
    try:
        await driver.open()
        start = driver._ticker._ticks.start
        await asyncio.sleep(seconds)
    finally:
        background.cancel()
        await driver.close()
    edges = np.array([t for name, t in bench.times[:-2] if name == "GPIO17"][1:])
    late = (edges - start) % 0.080
    first, last = edges[0] - start, edges[-1] - start
    return late, (last - first) / (0.080 * round((last - first) / 0.080)) - 1.0


@pytest.mark.parametrize(("kind", "python_s"), [(ThreadTicker, 0.0), (ThreadTicker, 0.002), (LoopTicker, 0.0)])
def test_edges_keep_their_time_while_every_core_is_busy(kind, python_s):
    """The second row is for comparison: a thread that holds the interpreter can itself be kept from running."""
    with ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            process = subprocess.Popen(["nice", "-n", "5", sys.executable, "-c", BUSY])  # the unit: Nice=-5
            stack.callback(process.wait)
            stack.callback(process.kill)
        late, error = asyncio.run(lateness(kind, python_s, SECONDS))
    p50, p99 = np.percentile(late, [50, 99])
    print(
        f"\n{kind.__name__}, {1e3 * python_s:g} ms of Python: {len(late)} edges in {SECONDS:g} s, late p50 "
        f"{1e3 * p50:.2f} ms, p99 {1e3 * p99:.2f} ms, most {1e3 * late.max():.2f} ms; "
        f"frequency off by {100 * abs(error):.4f} %"
    )
    if (kind, python_s) == (ThreadTicker, 0.0):
        if not has_real_time_priority():
            pytest.skip("threads may not have real-time priority here")
        assert p99 < 0.005
        assert abs(error) < 1e-3
