"""Records what is published on a bus, so that a killed process loses at most 0.1 s of it."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

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
        self._subscriptions: dict[str, Subscription] = {}
        self._queue: list[tuple[str, Sample, int]] = []
        self._queued_image_bytes = 0
        self._queue_lock = threading.Lock()
        self._write_lock = threading.Lock()
        self._followed: dict[str, Sequence[int]] = {}
        self._told: set[str] = set()
        self._failure: OSError | None = None
        self._closed = False
        self._complete = False
        self._is_as_written = True
        start = read_clock(clock)
        output = create_file(file)
        try:
            self._out = SampleFile(
                output, header=header, clock=start, on_misfit=self._tell, on_failure=self._fail,
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
        return dict(self._out.counts)

    @property
    def dropped(self) -> int:
        """How many samples of all topics were not written so far."""
        return sum(count.dropped for count in tuple(self._out.counts.values()))

    @property
    def empty(self) -> bool:
        """Whether there was no sample so far, written or dropped."""
        return not any(count.messages or count.dropped for count in tuple(self._out.counts.values()))

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._out.size

    @property
    def complete(self) -> bool:
        """Whether the file has its end."""
        return self._complete

    @property
    def failure(self) -> OSError | None:
        """Why the file could not be written, the last time that this happened."""
        return self._failure

    @property
    def stopped(self) -> bool:
        """Whether the main program is to end the recording: the file fails, and `on_failure` is `stop`.

        That is: it could not be written, or another program writes to it.

        It is asked, not interrupted: an error out of its next wait might come while it tells a device to stop.
        """
        return (self._failure is not None or self._out.disturbed) and self._on_failure == "stop"

    @property
    def disturbance(self) -> str:
        """What has become of the file by somebody else's hand; empty if nothing tells of any."""
        if self._is_gone():
            return "gone: it, or its disk, was removed, renamed or replaced during the recording"
        now = _status(self.file)
        is_whole = self._is_as_written and not self._out.disturbed and now is not None and now.st_size == self.size
        return "" if is_whole else "corrupt: another program wrote to it during the recording"

    def _is_gone(self) -> bool:
        now = _status(self.file)
        return now is None or self._made is None or not os.path.samestat(now, self._made)

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

    def follow_arrivals(self, host: str, arrivals: Sequence[int]) -> None:
        """Note what is and will be appended to `arrivals`, which may be an `Inbox.arrivals`."""
        self._followed[host] = arrivals

    def close(self) -> None:
        """Write what is waiting, and the file's end; idempotent.

        If it is interrupted, what still waits is counted as dropped, and the end is written; a second time, it ends
        there: see `complete`.

        Raises:
            RecordingFailed: something could not be written and `on_failure` is `stop`.
        """
        if self._closed:
            return
        try:
            self._unwatch()
            for subscription in self._subscriptions.values():
                subscription.cancel()
            if self._timer is not None:
                self._timer.cancel()
            self._write_waiting()
        finally:
            self._end()
        dropped = {topic: count.dropped for topic, count in self.counts.items() if count.dropped}
        if dropped:
            listed = ", ".join(f"{topic} {number}" for topic, number in dropped.items())
            _log.error("%s: %d samples were not recorded: %s", self.file, self.dropped, listed)
        if self._failure is not None and self.stopped:
            raise RecordingFailed(
                f"{self.file} could not be written: {self._failure.strerror or self._failure}",
                remedy="free space on the disk, or choose another file; to go on with gaps, say so: --on-failure go-on",
            )

    def _end(self) -> None:
        with self._write_lock:
            try:
                self._closed = True
                for topic, *_ in self._queue:  # an interruption has left them
                    self._out.counts[topic].refused += 1
                stopped = self._failure if self.stopped else None
                failure = None if stopped is None else stopped.strerror or str(stopped)
                self._out.write_arrivals(self._followed, now_ns=self._clock.now_ns())
                try:
                    self._out.finish(read_clock(self._clock), now_ns=self._clock.now_ns(), failure=failure)
                    self._complete = True
                except OSError as error:
                    self._fail(error, "its end could not be written; what it holds can be read all the same")
            finally:
                self._output.close()
            if not self._is_gone():
                with contextlib.suppress(OSError):
                    self._is_as_written = self._out.look_back(self.file)

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
        if not is_wanted(topic.name, self._patterns):
            return
        try:
            self._subscribe(topic)
        except BaseException:  # an interruption: the bus tells of each topic once
            self._subscribe(topic)
            raise

    def _subscribe(self, topic: Topic[Any]) -> None:
        if topic.name in self._subscriptions:
            return
        try:
            self._out.add_topic(topic.name, topic.sample_type)
        except UnsupportedType as error:
            _log.error("%s: topic %r is not recorded: %s", self.file, topic.name, error)
            return
        latest = topic.latest if topic.name.startswith(TRUTH_PREFIX) else None
        take = self._take_inline if self._clock.simulated else self._take
        # The name goes with the call: a sample does not know its topic.
        self._subscriptions[topic.name] = topic.subscribe(_bound(take, topic.name))
        if latest is not None:
            take(topic.name, latest)

    def _take_inline(self, topic: str, sample: Sample) -> None:
        now_ns = self._clock.now_ns()
        with self._write_lock:
            self._out.write(((topic, sample, now_ns),))
        if now_ns - self._last_flush_ns >= FLUSH_NS:
            self._write_waiting()

    def _take(self, topic: str, sample: Sample) -> None:
        image_bytes = sample.image.nbytes if isinstance(sample, Frame) else 0
        with self._queue_lock:
            full = len(self._queue) >= QUEUE_SAMPLES
            if not full and (not image_bytes or self._queued_image_bytes + image_bytes <= QUEUE_IMAGE_BYTES):
                self._queue.append((topic, sample, self._clock.now_ns()))
                self._queued_image_bytes += image_bytes
                return
            self._out.counts[topic].refused += 1
        self._tell(topic, "the disk does not keep up")

    # ------------------------------------------------------------------ where the file is written

    def _write_waiting(self) -> None:
        with self._write_lock:
            if self._closed:
                return
            rest: Iterator[tuple[str, Sample, int]] = iter(())
            try:
                with self._queue_lock:
                    rest, self._queue, self._queued_image_bytes = iter(self._queue), [], 0
                self._out.write(rest)
            finally:  # an interruption leaves some
                with self._queue_lock:
                    self._queue[:0] = rest
            now_ns = self._clock.now_ns()
            self._out.write_arrivals(dict(self._followed), now_ns=now_ns)
            self._out.flush(now_ns=now_ns)
            self._last_flush_ns = now_ns

    def _tell(self, topic: str, why: str) -> None:
        """Samples will not be in the file; each reason is said once."""
        if why not in self._told:
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
