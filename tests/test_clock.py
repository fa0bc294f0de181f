import asyncio
import threading
import time

import pytest

from robotd.clock import in_thread, now, outside, run_virtual, stall, ticks


def test_an_hour_of_ticks_keeps_exact_time():
    async def main():
        async for tick in ticks(0.080):
            if tick == 45_000:
                return now()

    assert run_virtual(main()) == pytest.approx(3600.0, abs=1e-6)


def test_virtual_time_stands_still_while_a_thread_works():
    async def main():
        seen = []

        async def clockwork():
            async for _ in ticks(0.010):
                seen.append(now())

        task = asyncio.create_task(clockwork())
        await asyncio.sleep(1.0)
        before, count = now(), len(seen)
        await in_thread(time.monotonic)
        assert now() == before
        assert len(seen) - count <= 1
        task.cancel()

    run_virtual(main())


def test_overlapping_holds_release_time_only_when_the_last_one_ends():
    async def main():
        loop = asyncio.get_running_loop()
        started = loop.create_future()

        async def hold(future):
            with outside():
                started.set_result(None)
                await future

        first = loop.create_future()
        task = asyncio.create_task(hold(first))
        await started
        sleeper = asyncio.create_task(asyncio.sleep(5.0))
        with outside():
            loop.call_soon(first.set_result, None)
            await task
            assert now() == 0.0
        await sleeper
        assert now() == pytest.approx(5.0)

    run_virtual(main())


def test_outside_is_harmless_on_an_ordinary_loop():
    async def main():
        with outside():
            return await in_thread(lambda: 7)

    assert asyncio.run(main()) == 7


def test_a_late_consumer_gets_every_tick():
    async def main():
        got = []
        async for tick in ticks(0.1):
            got.append((tick, round(now(), 6)))
            if tick == 1:
                await asyncio.sleep(0.35)
            if tick == 5:
                return got

    assert run_virtual(main()) == [(0, 0.0), (1, 0.1), (2, 0.45), (3, 0.45), (4, 0.45), (5, 0.5)]


def test_the_end_waits_for_threads_in_real_time():
    release = threading.Event()

    async def main():
        asyncio.get_running_loop().run_in_executor(None, release.wait, 60.0)
        threading.Timer(0.2, release.set).start()

    run_virtual(main())  # a time-out that virtual time ran into would be a warning, and warnings are errors
    assert release.is_set()


def test_a_stall_makes_everything_that_was_due_late():
    async def main():
        loop, called = asyncio.get_running_loop(), []
        for k in range(4):
            loop.call_at(1.0 + 0.1 * k, lambda k=k: called.append((k, now())))
        await asyncio.sleep(0.95)
        stall(0.2)
        assert called == []
        await asyncio.sleep(1.0)
        assert called == [(0, 1.15), (1, 1.15), (2, pytest.approx(1.2)), (3, pytest.approx(1.3))]

    run_virtual(main())


def test_on_an_ordinary_loop_a_stall_does_nothing():
    async def main():
        before = now()
        stall(1e6)
        assert now() - before < 1e6

    asyncio.run(main())
