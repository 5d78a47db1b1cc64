"""The shared bus: typed topics with a short history.

`publish` calls subscribers in the publisher's thread; an error in one of them is contained, counted and logged
once. Guards run before all subscribers. Who wants a thread of his own takes a bounded `Inbox`.
"""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar, cast

from msgspec.structs import force_setattr

from microdrivers.core.errors import MicrodriversError
from microdrivers.core.samples import Sample

SampleT = TypeVar("SampleT", bound=Sample)
Subscriber = Callable[[SampleT], object]

_log = logging.getLogger(__name__)

HISTORY_LENGTH = 256


class BusError(MicrodriversError):
    """A topic was used with another type of sample than its own."""


class Subscription:
    """Cancel it to stop being called. Counts the errors of its subscriber."""

    def __init__(self, topic: Topic[Any], call: Callable[[Any], object]) -> None:
        self._topic = topic
        self.call = call
        self.error_count = 0
        self.last_error: Exception | None = None

    def cancel(self) -> None:
        """No call starts after this returns."""
        self._topic._remove(self)

    def _failed(self, error: Exception) -> None:
        self.error_count += 1
        self.last_error = error
        if self.error_count == 1:
            _log.error("a subscriber of %r failed: %s (further failures are only counted)", self._topic.name, error)


class Topic(Generic[SampleT]):
    """One stream of samples of one type."""

    def __init__(self, bus: Bus, name: str, sample_type: type[SampleT], history: int) -> None:
        self.name = name
        self.sample_type = sample_type
        self.history: deque[SampleT] = deque(maxlen=history)
        self._bus = bus
        self._next_order = bus._next_order
        self._subscriptions: tuple[Subscription, ...] = ()

    @property
    def latest(self) -> SampleT | None:
        """The newest sample, if any."""
        return self.history[-1] if self.history else None

    @property
    def heard(self) -> bool:
        """Whether anybody subscribes: what is costly to make for a log need not be made for nobody."""
        return bool(self._subscriptions)

    def publish(self, sample: SampleT) -> None:
        """Stamp the bus-wide order (once in a sample's life), run the guards, then the subscribers."""
        if sample.order < 0:
            # The sample is frozen for everybody else; nobody has seen it before this line.
            force_setattr(sample, "order", self._next_order())
        for guard in self._bus._guards:
            guard(sample)
        self.history.append(sample)
        for subscription in self._subscriptions:
            try:
                subscription.call(sample)
            except Exception as error:  # noqa: BLE001 - one subscriber's fault must not reach the others or the device
                subscription._failed(error)

    def subscribe(self, call: Subscriber[SampleT]) -> Subscription:
        """Call `call` with every sample published from now on, in the publisher's thread."""
        subscription = Subscription(self, call)
        self._subscriptions = (*self._subscriptions, subscription)
        return subscription

    def _remove(self, subscription: Subscription) -> None:
        self._subscriptions = tuple(s for s in self._subscriptions if s is not subscription)

    @property
    def error_count(self) -> int:
        """Errors of the present subscribers."""
        return sum(subscription.error_count for subscription in self._subscriptions)


class Bus:
    """All topics of a rig."""

    def __init__(self) -> None:
        self._topics: dict[str, Topic[Any]] = {}
        self._guards: tuple[Callable[[Sample], object], ...] = ()
        self._watchers: tuple[Callable[[Topic[Any]], object], ...] = ()
        self._next_order: Callable[[], int] = itertools.count().__next__

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of all topics, in the order of their first use."""
        return tuple(self._topics)

    def topic(self, name: str, sample_type: type[SampleT], *, history: int = HISTORY_LENGTH) -> Topic[SampleT]:
        """The topic of that name, made at its first use.

        Raises:
            BusError: it exists with another type.
        """
        topic = self._topics.get(name)
        if topic is None:
            made: Topic[Any] = Topic(self, name, sample_type, history)
            topic = self._topics.setdefault(name, made)  # another thread may have been first
            if topic is made:
                for watcher in self._watchers:
                    watcher(topic)
        if topic.sample_type is not sample_type:
            raise BusError(
                f"topic {name!r} carries {topic.sample_type.__name__}, not {sample_type.__name__}",
                remedy="use another topic name",
            )
        return cast("Topic[SampleT]", topic)

    def guard(self, call: Callable[[Sample], object]) -> None:
        """Run `call` on every sample of every topic before its subscribers; an error in it reaches the publisher."""
        self._guards = (*self._guards, call)

    def watch(self, call: Callable[[Topic[Any]], object]) -> Callable[[], None]:
        """Call `call` with every topic that there is and, before its first sample, with each one that is made later.

        One that is made meanwhile may come twice.

        Returns:
            what ends it.
        """
        self._watchers = (*self._watchers, call)
        for topic in tuple(self._topics.values()):
            call(topic)

        def end() -> None:
            self._watchers = tuple(watcher for watcher in self._watchers if watcher is not call)

        return end
