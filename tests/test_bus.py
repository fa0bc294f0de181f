import asyncio

from robotd.bus import Topic
from robotd.clock import run_virtual


def test_subscribers_get_everything_published_inside_their_block():
    async def main():
        topic = Topic()
        topic.publish(0)
        with topic.subscribe() as subscription:
            topic.publish(1)
            topic.publish(2)
            assert [await subscription.get(), await subscription.get()] == [1, 2]
        topic.publish(3)
        assert topic.latest == 3

    run_virtual(main())


def test_a_slow_subscriber_loses_the_oldest_and_knows_it():
    async def main():
        topic = Topic()
        with topic.subscribe(size=2) as subscription:
            for item in range(5):
                topic.publish(item)
            assert subscription.dropped == 3
            assert [await subscription.get(), await subscription.get()] == [3, 4]

    run_virtual(main())


def test_a_waiting_subscriber_is_woken():
    async def main():
        topic = Topic()
        with topic.subscribe() as subscription:
            asyncio.get_running_loop().call_later(2.0, topic.publish, "late")
            return await subscription.get(), asyncio.get_running_loop().time()

    assert run_virtual(main()) == ("late", 2.0)
