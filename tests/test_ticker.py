import asyncio
import itertools
import threading

import pytest

from robotd.clock import now, run_virtual, stall
from robotd.ticker import LoopTicker, ThreadTicker


def test_a_late_loop_ticker_leaves_out_whole_periods():
    async def main():
        calls = []
        ticker = LoopTicker(0.1, lambda k: calls.append((k, round(now(), 6))))
        await asyncio.sleep(0.25)
        stall(0.32)
        await asyncio.sleep(0.2)
        ticker.close()
        ticker.close()
        await asyncio.sleep(1.0)
        return calls

    assert run_virtual(main()) == [(0, 0.0), (1, 0.1), (2, 0.2), (3, 0.57), (5, 0.57), (6, 0.6), (7, 0.7)]


@pytest.mark.parametrize("kind", [ThreadTicker, LoopTicker])
def test_a_ticker_tells_what_went_wrong_and_closes(kind):
    async def main():
        def fail(k):
            if k:
                raise OSError("pulled out")

        ticker = kind(0.001, fail)
        with pytest.raises(OSError, match="pulled out"):
            await ticker.wait()
        ticker.close()
        unheard = kind(0.001, fail)
        await asyncio.sleep(0.02)
        unheard.close()

    asyncio.run(main())


def test_a_thread_ticker_calls_in_order_from_its_own_thread_until_it_is_closed():
    async def main():
        calls, enough = [], asyncio.Event()
        loop = asyncio.get_running_loop()

        def note(k):
            calls.append((k, threading.current_thread() is threading.main_thread()))
            if len(calls) == 5:
                loop.call_soon_threadsafe(enough.set)

        ticker = ThreadTicker(0.002, note)
        await enough.wait()
        ticker.close()
        count = len(calls)
        await asyncio.sleep(0.02)
        assert len(calls) == count
        ticker.close()
        return calls

    calls = asyncio.run(main())
    assert calls[0][0] == 0
    assert all(later > earlier for (earlier, _), (later, _) in itertools.pairwise(calls))
    assert not any(is_main for _, is_main in calls)
