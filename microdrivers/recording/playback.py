"""A recording as a bus on which everything happens again, for programs of one's own."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Collection

from microdrivers.core.bus import Bus, Topic
from microdrivers.core.clock import Clock, SimulatedClock
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import Sample
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.recording.reader import Recording
from microdrivers.recording.replay import Replay

_CLOCK_STEP_NS = NS_PER_MS
_REPORT_EVERY = 500


class RecordingPlayback:
    """A recording that was opened to be published; a context manager. Subscribe to topics of `bus`, then `run`.

    Attributes:
        recording: what is published. bus: where. clock: that of whoever listens.
        counts: number of samples by topic so far.
    """

    def __init__(self, recording: Recording, *, clock: Clock, leave_out: Collection[str]) -> None:
        self.recording = recording
        self.bus = Bus()
        self.clock = clock
        self.counts: Counter[str] = Counter()
        self._leave_out = leave_out
        self._first_ns: int | None = None
        self._last_ns = 0
        self._clock_ns = 0
        self._on_progress: Callable[[int], object] = lambda _done: None
        self._done = 0
        self._ran = False
        self.bus.watch(self._found)

    @property
    def span_s(self) -> float:
        """From the earliest to the latest instant that was published, s."""
        return 0.0 if self._first_ns is None else (self._last_ns - self._first_ns) / NS_PER_S

    def run(self, speed: float | None = None, *, on_progress: Callable[[int], object] | None = None) -> int:
        """Publish the recording, once.

        Args:
            speed: × real time, > 0; None publishes as fast as possible. On a simulated clock nothing is waited for: it
                then shows the recorded times, to 1 ms, counted from the first sample.
            on_progress: told the number of samples so far, now and then.

        Returns:
            number of samples.

        Raises:
            ConfigError: a speed that is not positive, one on a simulated clock, or it ran before.
        """
        if speed is not None and not speed > 0.0:
            raise ConfigError(f"a speed of {speed} × real time is not possible", remedy="give a speed above 0")
        if speed is not None and self.clock.simulated:
            raise ConfigError(
                "a simulated clock waits for nothing", remedy="give open_replay clock=SystemClock(), or no speed"
            )
        if self._ran:
            raise ConfigError("the recording has been published already", remedy="open it again")
        self._ran = True
        self._on_progress = on_progress or self._on_progress
        replay = Replay(self.recording, self.bus, leave_out=self._leave_out, clock=self.clock, speed=speed)
        replay.up_to(None)
        self._on_progress(replay.published)
        return replay.published

    def _found(self, topic: Topic[Sample]) -> None:
        """Before any other subscriber: whoever is called for a sample finds the clock at its time."""
        simulated, name, counts = self.clock.simulated, topic.name, self.counts

        def take(sample: Sample) -> None:
            t_ns = sample.t_ns
            if self._first_ns is None:
                self._first_ns = self._last_ns = self._clock_ns = t_ns
            elif t_ns > self._last_ns:
                self._last_ns = t_ns
                if simulated and t_ns - self._clock_ns >= _CLOCK_STEP_NS:
                    self._clock_ns = t_ns
                    self.clock.sleep_until(t_ns - self._first_ns)
            counts[name] += 1
            self._done += 1
            if self._done % _REPORT_EVERY == 0:
                self._on_progress(self._done)

        topic.subscribe(take)

    def close(self) -> None:
        """Close the file."""
        self.recording.close()

    def __enter__(self) -> RecordingPlayback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_replay(
    file: str | os.PathLike[str], *, clock: Clock | None = None, leave_out: Collection[str] = ()
) -> RecordingPlayback:
    """Open a recording to publish it again, in the order in which it was published.

    Args:
        file: the recording.
        clock: a `SystemClock` to publish at the recorded pace; default: a simulated one, as fast as possible.
        leave_out: topics, or patterns, that are not published. Who runs estimators of his own also leaves out
            `microdrivers.recording.replay.ESTIMATES`, what estimators have published in the recorded run.

    Raises:
        ConfigError, EmptyRecording, ForeignRecording, FutureRecording: it cannot be read.
    """
    return RecordingPlayback(Recording(file), clock=clock or SimulatedClock(), leave_out=leave_out)
