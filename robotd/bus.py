"""How drivers, safety and mission hear from each other: topics with a latest value and drop-oldest subscriptions."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

from .records import DriveCommand, Event, Frame, MissionStatus, OdometryState, SensorFrame

T = TypeVar("T")


class Subscription(Generic[T]):
    """A bounded queue of what a topic published since; when it is full the oldest item is dropped and counted."""

    def __init__(self, size: int) -> None:
        self._items: deque[T] = deque()
        self._size = size
        self._wake = asyncio.Event()
        self.dropped = 0

    def put(self, item: T) -> None:
        if len(self._items) >= self._size:
            self._items.popleft()
            self.dropped += 1
        self._items.append(item)
        self._wake.set()

    async def get(self) -> T:
        """Wait for the next item."""
        while not self._items:
            self._wake.clear()
            await self._wake.wait()
        return self._items.popleft()

    async def __aiter__(self) -> AsyncIterator[T]:
        while True:
            yield await self.get()


class Topic(Generic[T]):
    """One kind of message, from any number of publishers to any number of subscribers, on one event loop."""

    def __init__(self) -> None:
        self.latest: T | None = None
        self._subscriptions: list[Subscription[T]] = []

    def publish(self, item: T) -> None:
        self.latest = item
        for subscription in self._subscriptions:
            subscription.put(item)

    @contextmanager
    def subscribe(self, size: int = 64) -> Iterator[Subscription[T]]:
        """Receive what is published inside the block; at most `size` items wait."""
        subscription: Subscription[T] = Subscription(size)
        self._subscriptions.append(subscription)
        try:
            yield subscription
        finally:
            self._subscriptions.remove(subscription)


class Bus:
    """The topics of one robot."""

    def __init__(self) -> None:
        self.sensors: Topic[SensorFrame] = Topic()  # from the base driver, 66.7 Hz
        self.odometry: Topic[OdometryState] = Topic()  # from the daemon, one for each sensor frame
        self.commands: Topic[DriveCommand] = Topic()  # from followers and operators, to the safety layer
        self.events: Topic[Event] = Topic()  # for the operator and the journal
        self.status: Topic[MissionStatus] = Topic()  # from the mission, at every change
        self._frames: dict[str, Topic[Frame]] = {}

    def frames(self, camera: str) -> Topic[Frame]:
        """The frames of one camera driver instance."""
        return self._frames.setdefault(camera, Topic())
