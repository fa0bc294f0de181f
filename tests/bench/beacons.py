"""The beacons' clock: how late its edges are, next to a thread that does nothing but sleep until a deadline."""

from __future__ import annotations

import asyncio
import threading
import time

import numpy as np

from robotd.ticker import ThreadTicker

from .table import Row

SECONDS, TICK = 4.0, 0.080


def rows() -> list[Row]:
    """Lateness of an edge while the event loop is held up for 10 ms of every 30, against a bare sleep meanwhile."""
    edges: list[float] = []
    bare: list[float] = []

    def sleeper(start: float) -> None:
        for k in range(1, int(SECONDS / TICK)):
            time.sleep(max(0.0, start + k * TICK - time.monotonic()))
            bare.append(time.monotonic() - start - k * TICK)

    async def main() -> None:
        loop = asyncio.get_running_loop()
        start = loop.time()
        ticker = ThreadTicker(TICK, lambda k: edges.append(loop.time() - start - k * TICK))
        thread = threading.Thread(target=sleeper, args=(start,))
        thread.start()
        while thread.is_alive():
            await asyncio.sleep(0.020)
            time.sleep(0.010)  # noqa: ASYNC251  # the loop is held up, as by vision code
        ticker.close()

    asyncio.run(main())
    return [
        Row(
            f"beacon edge late, {name}",
            1e3 * float(np.percentile(edges, at)),
            "bare sleep",
            1e3 * float(np.percentile(bare, at)),
        )
        for name, at in (("median", 50), ("p99", 99))
    ]
