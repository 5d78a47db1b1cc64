"""The force sensor on a CiA 404 amplifier."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.backends.canopen.emergency import Emergency
from microdrivers.backends.canopen.heartbeat import Heartbeats, NmtState
from microdrivers.backends.canopen.node import CanopenNode
from microdrivers.backends.cia404.amplifier import Amplifier, sends_heartbeat
from microdrivers.backends.cia404.measurement_stream import Measurement, MeasurementStream
from microdrivers.backends.cia404.settings import FASTEST_HZ, MOST_LOAD, Cia404ForceSettings
from microdrivers.backends.lines.can_line import Listening, shared_can_line
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock, ClockEvent, Timer
from microdrivers.core.errors import DeviceFault, LinkError, MicrodriversError, OutOfRange
from microdrivers.core.samples import ForceSample, TimeSource
from microdrivers.core.units import NS_PER_MS, NS_PER_S, Range, check_range, seconds_to_ns
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.force_sensor import ForceSensor
from microdrivers.devices.shared_bus import BusFacts

_RATES_HZ = Range(0.02, FASTEST_HZ)
_WATCH_S = 0.05
_STALE_AFTER_S = 0.1
_STALE_AFTER_PERIODS = 3
_ANEW_EVERY_S = 1.0
_HEARTBEAT_MS = 200
_HEARTBEATS_TIMEOUT_S = 0.45

_log = logging.getLogger(__name__)


class Cia404ForceSensor(ForceSensor):
    """A force sensor on one channel of a CiA 404 amplifier.

    While a stream is open the node is OPERATIONAL and sends value and status by itself, by its event timer or on SYNC;
    otherwise it is PRE-OPERATIONAL, sends no PDO, and is read by SDO. A stream that stops coming says STALE after 0.1 s
    (or 3 periods); each second it is then tried to set the node up again. A node that was switched on anew forgets the
    tare: its zero is another. Tare is the host's affair: the amplifier's own zero (6125h) is never touched.
    """

    def __init__(self, name: str, settings: Cia404ForceSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self._adopt(settings)
        self._settings = settings
        self._line = shared_can_line(settings.connection, clock=clock, bus=bus)
        self._node = CanopenNode(
            self._line,
            settings.node_id,
            owner=name,
            name=f"node {settings.node_id}",
            timeout_s=settings.connection.timeout_s,
            on_heartbeat=self._hear_heartbeat,
            on_silence=lambda: self._lose(f"node {settings.node_id} sends no heartbeat any more"),
            on_emergency=self._hear_emergency,
        )
        self._amplifier = Amplifier(self._node, settings, name=name)
        self._stream: MeasurementStream | None = None
        self._stream_source: TimeSource = "request" if settings.sync else "arrival"
        self._event_ms = 0
        self._stale_ns = 0
        self._anew_ns = 0
        self._watch: Timer | None = None
        self._background: list[Listening] = []
        self._has_forgotten = False
        self._newest: ForceSample | None = None
        self._waiting: tuple[ClockEvent, ...] = ()
        self._lost_frames = 0

    @property
    def lost_frames(self) -> int:
        """Frames of all streams that should have come and did not."""
        return self._lost_frames + (self._stream.lost if self._stream is not None else 0)

    @property
    def line_counters(self) -> Mapping[str, int]:
        """What this sensor missed."""
        return {"lost_frames": self.lost_frames}

    @property
    def bus_load(self) -> float:
        """Share of the bus that is taken, by all devices on it, 0 to 1."""
        return self._line.load

    @property
    def bus_facts(self) -> BusFacts:
        """The bus at present, as all devices on it see it."""
        return self._line.facts

    # ------------------------------------------------------------------ connection

    def _connect(self) -> None:
        self._line.open()
        try:
            self._node.attach()
        except MicrodriversError:
            self._line.close()
            raise
        self._background = [self._line.on_loss(lambda error: self._lose(error.what))]
        self.fault = None

    def _identify(self) -> DeviceInfo:
        heartbeats = self._line.service(Heartbeats)
        interval_s = _HEARTBEAT_MS / 1000
        self._background.append(heartbeats.produce(interval_s))
        return self._set_up(before=lambda: heartbeats.refuse_other_host(interval_s))

    def _set_up(self, before: Callable[[], object] = lambda: None) -> DeviceInfo:
        info = self._amplifier.identify()
        before()
        self._amplifier.prepare()
        sends_heartbeat(self._node, interval_ms=_HEARTBEAT_MS, timeout_s=_HEARTBEATS_TIMEOUT_S)
        self._has_forgotten = False
        return info

    def _close(self) -> None:
        self._end_stream()
        while self._background:
            self._background.pop().cancel()
        self._node.detach()
        self._line.close()

    # ------------------------------------------------------------------ reading

    def read(self) -> ForceSample:
        """One fresh value: by SDO; while a stream is open, by SYNC, or the next that is measured from now on.

        Raises:
            LinkError: no connection, no answer, or an unintelligible one. SdoAbort: the amplifier refuses.
        """
        if not self.streaming or self._settings.sync:
            return super().read()
        with self._naming_errors():
            self._require_open()
            return self._next_of_stream()

    def _read(self) -> ForceSample:
        stream = self._stream
        if stream is not None and (taken := stream.take(self._settings.connection.timeout_s)) is not None:
            return self._sample_of(taken, "request")
        with self.clock.transaction():
            start_ns = self.clock.now_ns()
            raw_uN, flags = self._amplifier.read()
            end_ns = self.clock.now_ns()
            conversion_ns = round(self._settings.conversion_ms * NS_PER_MS)
            half_ns = -(-(end_ns - start_ns + conversion_ns) // 2)
            return self._sample(raw_uN, t_ns=end_ns - half_ns, dt_ns=half_ns, t_source="midpoint", flags=flags)

    def _next_of_stream(self) -> ForceSample:
        start_ns = self.clock.now_ns()
        deadline_ns = start_ns + self._stale_ns + seconds_to_ns(self._settings.connection.timeout_s)
        flag = self.clock.event()
        self._waiting = (*self._waiting, flag)
        try:
            with self.clock.transaction():
                while (left_ns := deadline_ns - self.clock.now_ns()) > 0:
                    if not self._line.wait(flag, left_ns / NS_PER_S):
                        break
                    flag.clear()
                    newest = self._newest
                    if newest is not None and newest.t_ns >= start_ns:
                        return newest
        finally:
            self._waiting = tuple(each for each in self._waiting if each is not flag)
        raise self._line.silence(f"no TPDO of node {self._settings.node_id} came", (deadline_ns - start_ns) / NS_PER_S)

    # ------------------------------------------------------------------ streaming

    @contextmanager
    def _stream_at(self, rate_hz: float) -> Iterator[None]:
        """Have the amplifier send at `rate_hz` while the context is open; its timer takes the nearest whole period, ms.

        Raises:
            OutOfRange: faster than the amplifier or the bus can. LinkError, SdoAbort: it could not be started.
        """
        self._require_open()
        check_range(rate_hz, _RATES_HZ, what="stream rate", unit="Hz", device=self.name, in_file="")
        with self._naming_errors():
            self._begin_stream(rate_hz)
        try:
            yield
        finally:
            self._end_stream()

    def _begin_stream(self, rate_hz: float) -> None:
        load = self._settings.load_at(rate_hz)
        if load > MOST_LOAD:
            raise OutOfRange(
                f"{rate_hz:g} Hz load the bus with {load:.0%}, more than the {MOST_LOAD:.0%} that a sensor may take",
                remedy=f"ask for {rate_hz * MOST_LOAD / load:.0f} Hz or less, or raise the bit rate of all nodes",
            )
        self._event_ms = max(1, round(1000 / rate_hz))
        actual_hz = rate_hz if self._settings.sync else 1000 / self._event_ms
        self._stale_ns = max(seconds_to_ns(_STALE_AFTER_S), round(_STALE_AFTER_PERIODS * NS_PER_S / actual_hz))
        stream = MeasurementStream(self._line, self._settings, self._amplifier.frame, self._take)
        self._stream, self._stream_rate_hz = stream, actual_hz
        self._anew_ns = self.clock.now_ns() + seconds_to_ns(_ANEW_EVERY_S)
        try:
            self._amplifier.start(self._event_ms)
            stream.begin(actual_hz)
        except BaseException:
            self._end_stream()
            raise
        start_ns = self.clock.now_ns() + seconds_to_ns(_WATCH_S)
        self._watch = self.clock.every(_WATCH_S, self._look, start_ns=start_ns, name=f"{self.name} watch")

    def _end_stream(self) -> None:
        stream, self._stream = self._stream, None
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.cancel()
        if stream is None:
            return
        if self.link != "lost":
            with contextlib.suppress(LinkError, SdoAbort):  # a node that does not answer sends nothing either
                self._amplifier.end()
        stream.end()
        self._lost_frames += stream.lost
        self._stream_rate_hz = 0.0

    def _take(self, measurement: Measurement) -> None:
        if self.link == "lost":
            self._find()
        sample = self._newest = self._sample_of(measurement, self._stream_source)
        self.clock.deliver(lambda: self.topic.publish(sample))
        for flag in self._waiting:
            flag.set()

    def _sample_of(self, measurement: Measurement, t_source: TimeSource) -> ForceSample:
        raw_uN, flags, t_ns, dt_ns = measurement
        return self._sample(raw_uN, t_ns=t_ns, dt_ns=dt_ns, t_source=t_source, flags=flags)

    def _look(self) -> None:
        """Say so if nothing has come for long, and try to set the node up again."""
        stream, now_ns = self._stream, self.clock.now_ns()
        if stream is None or now_ns - stream.heard_ns <= self._stale_ns:
            self._anew_ns = now_ns + seconds_to_ns(_ANEW_EVERY_S)
            return
        self._lose(f"node {self._settings.node_id} sends no measurements any more")
        self._publish_stale()
        if now_ns >= self._anew_ns:
            self._anew_ns = now_ns + seconds_to_ns(_ANEW_EVERY_S)
            try:
                self._require_same(self._set_up())
                self._amplifier.start(self._event_ms)
            except MicrodriversError as error:
                _log.debug("%s: not back yet: %s", self.name, error)

    # ------------------------------------------------------------------ what the node and the line tell

    def _lose(self, reason: str) -> None:
        if self.link == "open":
            self.link = "lost"
            _log.warning("%s: %s", self.name, reason)
            self._publish_event("link_lost", reason=reason)

    def _find(self) -> None:
        self.link = "open"
        self._publish_event("link_back")

    def _hear_heartbeat(self, state: int) -> None:
        if state == NmtState.BOOT_UP and self.link in ("open", "lost"):
            self._has_forgotten = True
            self._lose(f"node {self._settings.node_id} was switched on anew and has forgotten its settings")
            if self.tared is not None:
                self.clear_tare()
        elif self.link == "lost" and not self.streaming and not self._has_forgotten:
            self._find()

    def _hear_emergency(self, emergency: Emergency) -> None:
        if not emergency.is_over:
            self.fault = DeviceFault(
                f"the amplifier reports {emergency}", code=emergency.code, text=str(emergency), device=self.name,
                remedy="check the sensor, its cable and the amplifier's supply",
            )  # fmt: skip
            self._publish_event("fault", reason=self.fault.what)
        elif self.fault is not None:
            self.fault = None
            self._publish_event("fault_cleared")
