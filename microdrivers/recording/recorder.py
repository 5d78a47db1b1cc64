"""Records what is published on a bus, so that a killed process loses at most 0.1 s of it."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple

from microdrivers.core.bus import Bus, Subscription, Topic
from microdrivers.core.clock import Clock, Timer
from microdrivers.core.errors import MicrodriversError
from microdrivers.core.samples import Frame, Sample
from microdrivers.core.units import NS_PER_MS
from microdrivers.recording.channels import TRUTH_PREFIX, is_wanted
from microdrivers.recording.header import RecordingHeader, read_clock
from microdrivers.recording.output import create_file, not_writable
from microdrivers.recording.sample_file import SampleFile, TopicCount
from microdrivers.recording.schemas import UnsupportedType

_log = logging.getLogger(__name__)

FLUSH_NS = 100 * NS_PER_MS
_WRITE_PERIOD_S = 0.05
"""In real time: half of it, as a thread may be late."""
QUEUE_SAMPLES = 100_000
QUEUE_IMAGE_BYTES = 256 * 1024 * 1024


class RecordingFailed(MicrodriversError):
    """A recording could not be written to its end, and was asked not to go on without it."""


class _Waiting(NamedTuple):
    topic: str
    sample: Sample
    now_ns: int


class Recorder:
    """Records topics of a bus to a new file until it is closed; a context manager.

    In real time publishers only put their samples in a queue, which a thread of the clock writes to the file every
    50 ms; when the disk does not keep up, samples that find the queue full are dropped and counted. On a simulated
    clock samples are written as they are published: the same run gives the same file, but for the calendar's time.

    Close it before the rig's clock, or after it: what is waiting is written in any case.

    Args:
        file: which must not exist.
        bus: its topics are recorded, also those that appear later. `truth/*` begins with what was published before.
        clock: of the rig.
        header: where the recording comes from.
        topics: names or patterns; default: all but the bytes on wires (`*/wire`).
        on_failure: what happens when the file can no longer be written (a full disk): what is lost is counted, said
            once, and the file written again as soon as that is possible. With `stop`, `stopped` asks the main program
            to end the recording, and `close` raises `RecordingFailed`.
        compress_images: without loss (zstd); 3 to 10 ms of processor time a megapixel.

    Attributes:
        counts: by topic, what was written and what was dropped.

    Raises:
        ConfigError: the file exists, or cannot be made.
    """

    def __init__(
        self,
        file: Path,
        *,
        bus: Bus,
        clock: Clock,
        header: RecordingHeader,
        topics: Collection[str] | None = None,
        on_failure: Literal["stop", "go_on"] = "go_on",
        compress_images: bool = False,
    ) -> None:
        self.file = file
        self._clock = clock
        self._patterns = topics
        self._on_failure = on_failure
        self._counts: dict[str, TopicCount] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._queue: list[_Waiting] = []
        self._queued_image_bytes = 0
        self._queue_lock = threading.Lock()
        self._write_lock = threading.Lock()
        self._arrivals: dict[str, list[int]] = {}
        self._followed: dict[str, Sequence[int]] = {}
        self._followed_so_far: dict[str, int] = {}
        self._told: set[str] = set()
        self._failure: OSError | None = None
        self._closed = False
        start = read_clock(clock)
        output = create_file(file)
        try:
            self._out = SampleFile(
                output, header=header, clock=start, counts=self._counts, on_loss=self._lost,
                compress_images=compress_images,
            )  # fmt: skip
        except OSError as error:
            output.close()
            file.unlink(missing_ok=True)
            raise not_writable(file, error) from error
        self._output = output
        self._made = _status(file)
        self._last_flush_ns = clock.now_ns()
        self._timer: Timer | None = None
        self._unwatch = bus.watch(self._found_topic)
        if not clock.simulated:
            self._timer = clock.every(_WRITE_PERIOD_S, self._write_waiting, name="recorder")

    @property
    def counts(self) -> Mapping[str, TopicCount]:
        """By topic, what was written and what was dropped so far."""
        return dict(self._counts)

    @property
    def dropped(self) -> int:
        """How many samples of all topics were not written so far."""
        return sum(count.dropped for count in tuple(self._counts.values()))

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._out.size

    @property
    def failure(self) -> OSError | None:
        """Why the file could not be written, the last time that this happened."""
        return self._failure

    @property
    def stopped(self) -> bool:
        """Whether the main program is to end the recording: the file could not be written, and `on_failure` is `stop`.

        It is asked, not interrupted: an error out of its next wait might come while it tells a device to stop.
        """
        return self._failure is not None and self._on_failure == "stop"

    @property
    def disturbance(self) -> str:
        """What somebody else has done to the file since it was made; empty if neither its name nor its size tells."""
        now = _status(self.file)
        if now is None or self._made is None or not os.path.samestat(now, self._made):
            return "somebody has removed, renamed or replaced it, or its disk"
        return "" if now.st_size == self.size else "somebody else has written to it, too"

    def wants(self, topic: str) -> bool:
        """Whether that topic is recorded, if there is one."""
        return is_wanted(topic, self._patterns)

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Attach a file, `rig.yaml` for instance; it is written at once."""
        with self._write_lock:
            if self._closed:
                return
            try:
                self._out.attach(name, data, media_type, now_ns=self._clock.now_ns())
            except OSError as error:
                self._fail(error, f"{name} could not be attached")

    def note_arrivals(self, host: str, orders: Iterable[int]) -> None:
        """Note that an estimator's inbox has received the samples with these order numbers, in this order."""
        with self._queue_lock:
            self._arrivals.setdefault(host, []).extend(orders)

    def follow_arrivals(self, host: str, arrivals: Sequence[int]) -> None:
        """Note what is and will be appended to `arrivals`, which may be an `Inbox.arrivals`."""
        with self._queue_lock:
            self._followed[host] = arrivals

    def close(self) -> None:
        """Write what is waiting, and the file's end; idempotent.

        Raises:
            RecordingFailed: something could not be written and `on_failure` is `stop`.
        """
        if self._closed:
            return
        self._unwatch()
        for subscription in self._subscriptions.values():
            subscription.cancel()
        if self._timer is not None:
            self._timer.cancel()
        self._write_waiting()
        with self._write_lock:
            self._closed = True
            stopped = self._failure if self.stopped else None
            failure = None if stopped is None else stopped.strerror or str(stopped)
            try:
                self._out.finish(read_clock(self._clock), now_ns=self._clock.now_ns(), failure=failure)
            except OSError as error:
                self._fail(error, "its end could not be written; what it holds can be read all the same")
            self._output.close()
        dropped = {topic: count.dropped for topic, count in self._counts.items() if count.dropped}
        if dropped:
            listed = ", ".join(f"{topic} {number}" for topic, number in dropped.items())
            _log.error("%s: %d samples were not recorded: %s", self.file, self.dropped, listed)
        if self._failure is not None and self.stopped:
            raise RecordingFailed(
                f"{self.file} could not be written: {self._failure.strerror or self._failure}",
                remedy="free space on the disk, or choose another file; to go on with gaps, say so: --on-failure go-on",
            )

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RecordingFailed:
            if error is None:
                raise

    # ------------------------------------------------------------------ in the publisher's thread

    def _found_topic(self, topic: Topic[Any]) -> None:
        if topic.name in self._subscriptions or not is_wanted(topic.name, self._patterns):
            return
        try:
            self._out.add_topic(topic.name, topic.sample_type)
        except UnsupportedType as error:
            _log.error("%s: topic %r is not recorded: %s", self.file, topic.name, error)
            return
        self._counts.setdefault(topic.name, TopicCount())
        latest = topic.latest if topic.name.startswith(TRUTH_PREFIX) else None
        take = self._take_inline if self._clock.simulated else self._take
        # The name goes with the call: a sample does not know its topic.
        self._subscriptions[topic.name] = topic.subscribe(_bound(take, topic.name))
        if latest is not None:
            take(topic.name, latest)

    def _take_inline(self, topic: str, sample: Sample) -> None:
        now_ns = self._clock.now_ns()
        with self._write_lock:
            self._out.write(topic, sample, now_ns=now_ns)
        if now_ns - self._last_flush_ns >= FLUSH_NS:
            self._write_waiting()

    def _take(self, topic: str, sample: Sample) -> None:
        image_bytes = sample.image.nbytes if isinstance(sample, Frame) else 0
        with self._queue_lock:
            full = len(self._queue) >= QUEUE_SAMPLES
            if not full and (not image_bytes or self._queued_image_bytes + image_bytes <= QUEUE_IMAGE_BYTES):
                self._queue.append(_Waiting(topic, sample, self._clock.now_ns()))
                self._queued_image_bytes += image_bytes
                return
        self._lost(topic, 1, "the disk does not keep up")

    # ------------------------------------------------------------------ where the file is written

    def _write_waiting(self) -> None:
        with self._write_lock:
            if self._closed:
                return
            with self._queue_lock:
                waiting, self._queue, self._queued_image_bytes = self._queue, [], 0
                arrivals, self._arrivals = self._arrivals, {}
                for host, orders in self._followed.items():
                    before = self._followed_so_far.get(host, 0)
                    new = orders[before : len(orders)]
                    self._followed_so_far[host] = before + len(new)
                    arrivals.setdefault(host, []).extend(new)
            for topic, sample, now_ns in waiting:
                self._out.write(topic, sample, now_ns=now_ns)
            now_ns = self._clock.now_ns()
            for host, orders in arrivals.items():
                if orders:
                    self._out.write_arrivals(host, orders, now_ns=now_ns)
            self._out.flush(now_ns=now_ns)
            self._last_flush_ns = now_ns

    def _lost(self, topic: str, number: int, why: str, error: OSError | None = None) -> None:
        """Count samples that will not be in the file; each reason is said once."""
        with self._queue_lock:
            self._counts.setdefault(topic, TopicCount()).dropped += number
        if error is not None:
            self._fail(error, why)
        elif why not in self._told:
            self._told.add(why)
            _log.error("%s: samples of %r are not recorded: %s (further ones are only counted)", self.file, topic, why)

    def _fail(self, error: OSError, what: str) -> None:
        """The file could not be written: say so once."""
        first, self._failure = self._failure is None, error
        if first:
            _log.error("%s: %s: %s (further failures are only counted)", self.file, what, error.strerror or error)


def _status(file: Path) -> os.stat_result | None:
    with contextlib.suppress(OSError):
        return file.stat()
    return None


def _bound(take: Callable[[str, Sample], None], topic: str) -> Callable[[Sample], None]:
    return lambda sample: take(topic, sample)
