"""How drivers, safety and mission hear from each other: topics with a latest value and drop-oldest subscriptions."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

from .records import (
    Answer,
    DriveCommand,
    Event,
    Frame,
    LineMotion,
    LinePoints,
    LineStatus,
    MissionStatus,
    OdometryState,
    Prompt,
    SensorFrame,
    Withdrawal,
)

T = TypeVar("T")


class Subscription(Generic[T]):
    """A bounded queue of what a topic published since; when it is full the oldest item is dropped and counted."""

    def __init__(self, size: int, taken: asyncio.Event | None = None) -> None:
        self._items: deque[T] = deque()
        self._size = size
        self._wake = asyncio.Event()
        self._taken = taken or asyncio.Event()
        self.dropped = 0

    @property
    def waiting(self) -> int:
        """How many items have not been taken."""
        return len(self._items)

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
        return self.take()

    def take(self) -> T:
        """The next item; there must be one `waiting`."""
        self._taken.set()
        return self._items.popleft()

    async def __aiter__(self) -> AsyncIterator[T]:
        while True:
            yield await self.get()


class Topic(Generic[T]):
    """One kind of message, from any number of publishers to any number of subscribers, on one event loop."""

    def __init__(self) -> None:
        self.latest: T | None = None
        self._subscriptions: list[Subscription[T]] = []
        self._taken = asyncio.Event()  # somebody took something, came or went

    def publish(self, item: T) -> None:
        self.latest = item
        for subscription in self._subscriptions:
            subscription.put(item)

    @contextmanager
    def subscribe(self, size: int = 64) -> Iterator[Subscription[T]]:
        """Receive what is published inside the block; at most `size` items wait."""
        subscription: Subscription[T] = Subscription(size, self._taken)
        self._subscriptions.append(subscription)
        self._taken.set()
        try:
            yield subscription
        finally:
            self._subscriptions.remove(subscription)
            self._taken.set()

    async def wait_taken(self) -> None:
        """Until there is a subscriber and every one has taken all that was published: nothing is dropped after it."""
        while not self._subscriptions or any(subscription.waiting for subscription in self._subscriptions):
            self._taken.clear()
            await self._taken.wait()


class Bus:
    """The topics of one robot."""

    def __init__(self) -> None:
        self.sensors: Topic[SensorFrame] = Topic()  # from the base driver, 66.7 Hz
        self.odometry: Topic[OdometryState] = Topic()  # from the daemon, one for each sensor frame
        self.commands: Topic[DriveCommand] = Topic()  # from followers and operators, to the safety layer
        self.withdrawals: Topic[Withdrawal] = Topic()  # the same ones taking it back
        self.events: Topic[Event] = Topic()  # for the operator and the journal
        self.prompts: Topic[Prompt] = Topic()  # from drivers that need a person, to whoever can show them
        self.answers: Topic[Answer] = Topic()  # what the person says
        self.status: Topic[MissionStatus] = Topic()  # from the mission, at every change
        self.line_status: Topic[LineStatus] = Topic()  # from the follower
        self.line_motion: Topic[LineMotion] = Topic()  # the same, measured by the line alone
        self.line_points: Topic[LinePoints] = Topic()  # the same: the line as it leaves the robot's memory
        self._frames: dict[str, Topic[Frame]] = {}

    def frames(self, camera: str) -> Topic[Frame]:
        """The frames of one camera driver instance."""
        return self._frames.setdefault(camera, Topic())
