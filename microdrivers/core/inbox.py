"""A bounded queue between the bus and one consumer, which remembers the order of arrival."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Literal, Protocol

from microdrivers.core.bus import Subscription, Topic
from microdrivers.core.clock import Clock, Timer
from microdrivers.core.samples import Sample

OverflowPolicy = Literal["block", "drop_oldest"]


class Consumer(Protocol):
    """An estimator as a host sees it: samples in, estimates out."""

    def update(self, sample: Sample) -> Iterable[Sample]:
        """Take one sample, return the estimates it gave rise to."""


class Inbox:
    """Samples of several topics in one line, in order of arrival.

    Args:
        capacity: how many samples may wait.
        policy: what happens when it is full: `block` makes the publisher wait for the consumer, `drop_oldest`
            forgets the oldest sample and counts it in `dropped`.
    """

    def __init__(self, *, capacity: int = 1024, policy: OverflowPolicy = "block") -> None:
        self.capacity = capacity
        self.policy = policy
        self.dropped = 0
        self.arrivals: list[int] = []
        """Bus-wide order numbers in the order of arrival: what a replay must reproduce."""
        self._waiting: deque[Sample] = deque()
        self._changed = threading.Condition()
        self._closed = False

    def put(self, sample: Sample) -> None:
        """Append a sample; the policy says what happens when there is no room."""
        with self._changed:
            while len(self._waiting) >= self.capacity and not self._closed:
                if self.policy == "drop_oldest":
                    self._waiting.popleft()
                    self.dropped += 1
                else:
                    self._changed.wait()
            self._waiting.append(sample)
            self.arrivals.append(sample.order)
            self._changed.notify_all()

    def take(self, *, wait: bool = False) -> Sample | None:
        """The oldest waiting sample; None if there is none, or with `wait` once the inbox is closed and empty."""
        with self._changed:
            while wait and not self._waiting and not self._closed:
                self._changed.wait()
            if not self._waiting:
                return None
            sample = self._waiting.popleft()
            self._changed.notify_all()
            return sample

    def close(self) -> None:
        """Release whoever waits: a publisher for room, the consumer for samples."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        return len(self._waiting)


class EstimatorHost:
    """Runs one estimator behind one inbox and publishes what it returns.

    On a simulated clock the estimator runs as the samples arrive; in real time it has a thread of its own. Either
    way it sees the samples in `inbox.arrivals` order, so that feeding a recording in that order gives the same bits.

    Args:
        clock: decides between the two.
        consumer: the estimator.
        inputs: topics to listen to.
        publish: takes the estimates.
        capacity: of the inbox.
        history: samples from before that the estimator sees first.
        keep_samples: keep all samples in `recorded`, in the order of `inbox.arrivals`.
    """

    def __init__(
        self,
        clock: Clock,
        consumer: Consumer,
        inputs: Iterable[Topic[Any]],
        publish: Callable[[Sample], object],
        *,
        capacity: int = 1024,
        history: Iterable[Sample] = (),
        keep_samples: bool = False,
    ) -> None:
        self.inbox = Inbox(capacity=capacity)
        self.recorded: list[Sample] = []
        self._keep_samples = keep_samples
        self._consumer = consumer
        self._publish = publish
        self._failure: Exception | None = None
        self._at_work = threading.RLock()  # one at a time: who closes must not overtake a slow estimator's thread
        arrived = self._arrived_inline if clock.simulated else self.inbox.put
        for sample in history:
            self._arrived_inline(sample)
        self._subscriptions: list[Subscription] = [topic.subscribe(arrived) for topic in inputs]
        self._timer: Timer | None = None
        if not clock.simulated:
            self._timer = clock.call_at(clock.now_ns(), self._serve, name="estimator")

    def _serve(self) -> None:
        """The thread's life: consume until the inbox is closed and empty."""
        self._work(wait=True)

    def _work(self, *, wait: bool = False) -> None:
        with self._at_work:
            while (sample := self.inbox.take(wait=wait)) is not None:
                if self._keep_samples:
                    self.recorded.append(sample)
                try:
                    estimates = self._consumer.update(sample)
                except Exception as error:
                    self._failure = error
                    self.inbox.close()  # nobody consumes any more: no publisher may wait for room
                    raise
                for estimate in estimates:
                    self._publish(estimate)

    def close(self) -> None:
        """Consume what is left and stop listening.

        Raises:
            Exception: what the estimator raised, if it failed; the bus alone would have contained it.
        """
        for subscription in self._subscriptions:
            subscription.cancel()
        self.inbox.close()
        if self._timer is not None:
            self._timer.cancel()
        if self._failure is None:
            self._work()
        if self._failure is not None:
            raise self._failure

    def _arrived_inline(self, sample: Sample) -> None:
        self.inbox.put(sample)
        self._work()
