"""What every device is: connected or not, readable, stoppable, and a publisher of samples."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Generic, Literal

import msgspec

from microdrivers.core.bus import Bus, Topic
from microdrivers.core.clock import Clock
from microdrivers.core.errors import (
    DeviceFault,
    LinkError,
    LinkLost,
    MicrodriversError,
    ProtocolError,
    StaleData,
)
from microdrivers.core.samples import DeviceEvent, EventKind, SampleT
from microdrivers.core.units import NS_PER_S, Range, check_range

LinkState = Literal["closed", "connected", "open", "lost"]
"""`connected`: there is a line to send a stop on, but nobody knows yet who listens."""

STREAM_RATES_HZ = Range(0.001, 100_000.0)

_log = logging.getLogger(__name__)


class DeviceInfo(msgspec.Struct, frozen=True, kw_only=True):
    """Who answered when the device was opened."""

    driver: str
    vendor: str = ""
    model: str = ""
    serial_number: str = ""
    firmware: str = ""


class Device(ABC, Generic[SampleT]):
    """Base of all devices.

    A driver supplies the raw actions (`_connect`, `_identify`, `_close`, `_stop`, `_read`); the public methods add
    state, events and checks. `open()` connects and identifies and NEVER moves or tares. `stop()` may be called from any
    thread, bus callbacks included: it takes no lock and awaits no reply.
    """

    sample_type: type[SampleT]

    def __init__(self, name: str, *, clock: Clock, bus: Bus) -> None:
        self.name = name
        self.clock = clock
        self.bus = bus
        self.topic: Topic[SampleT] = bus.topic(name, self.sample_type)
        self.events: Topic[DeviceEvent] = bus.topic(f"{name}/event", DeviceEvent)
        self.info = DeviceInfo(driver=type(self).__name__)
        self.link: LinkState = "closed"
        self.fault: DeviceFault | None = None
        self.capabilities: frozenset[str] = frozenset()
        self._seq = 0
        self._event_seq = 0
        self._stream_rate_hz = 0.0
        self._stream_errors = 0
        self._lost_reason = ""

    # ------------------------------------------------------------------ what a driver supplies

    @abstractmethod
    def _connect(self) -> None:
        """Open the line, so that a stop can be sent; ask nothing."""

    @abstractmethod
    def _identify(self) -> DeviceInfo:
        """Find out who answers and adopt its limits, without moving anything."""

    @abstractmethod
    def _close(self) -> None:
        """Release the connection."""

    @abstractmethod
    def _stop(self) -> None:
        """Send the stop command; take no lock, await no reply."""

    @abstractmethod
    def _read(self) -> SampleT:
        """One fresh exchange."""

    def _clear_fault(self) -> None:
        """Clear a fault in the device itself."""

    # ------------------------------------------------------------------ public

    def connect(self) -> None:
        """Open the line and ask nothing: from here on `stop()` works. `open()` completes it.

        Raises:
            LinkLost: there is no such port, or it is busy or forbidden.
        """
        if self.link == "lost":
            self.close()
        if self.link == "closed":
            with self._naming_errors():
                self._connect()
            self.link = "connected"

    def open(self) -> None:
        """Connect and identify; nothing moves. If it fails the connection is released.

        Raises:
            LinkError, DeviceFault, ConfigError: the device does not answer, is another one, or is at fault.
        """
        self.connect()
        if self.link == "open":
            return
        try:
            with self._naming_errors():
                found = self._identify()
                self._require_same(found)
            self.info = found
        except BaseException:
            self.link = "closed"
            self._close()
            raise
        self.link = "open"
        self._publish_event("opened")

    def close(self) -> None:
        """Release the connection; idempotent."""
        if self.link == "closed":
            return
        try:
            self._close()
        finally:
            self.link = "closed"
            self._publish_event("closed")

    def stop(self, *, by: str = "user", reason: str = "") -> None:
        """Stop all motion now. Idempotent; from any thread; awaits no reply."""
        if self.link == "closed":
            return
        with self._naming_errors():
            self._stop()
        self._publish_event("stopped", by=by, reason=reason)

    def clear_fault(self) -> None:
        """Clear the device's fault, only ever on request."""
        with self._naming_errors():
            self._clear_fault()
        self.fault = None
        self._publish_event("fault_cleared")

    def read(self) -> SampleT:
        """A fresh exchange with the device, published on its topic.

        Raises:
            LinkError: no connection, no answer, or an unintelligible one.
        """
        try:
            if self.link != "open":
                self._require_open()
            sample = self._read()
        except MicrodriversError as error:
            self._put_name_on(error)
            raise
        if self.clock.simulated:
            self.clock.deliver(partial(self.topic.publish, sample))
        else:
            self.topic.publish(sample)
        return sample

    def latest(self, *, max_age_s: float) -> SampleT:
        """The newest published sample.

        Raises:
            StaleData: there is none, or it is older than `max_age_s`.
        """
        sample = self.topic.latest
        age_s = float("inf") if sample is None else (self.clock.now_ns() - sample.t_ns) / NS_PER_S
        if sample is None or age_s > max_age_s:
            raise StaleData(
                f"the newest sample is {age_s:.3g} s old, older than {max_age_s:g} s",
                device=self.name,
                remedy="read() a fresh one, or stream() the device",
            )
        return sample

    @contextmanager
    def stream(self, rate_hz: float) -> Iterator[None]:
        """Publish samples at `rate_hz` on topic `<name>` while the context is open."""
        self._require_open()
        check_range(rate_hz, STREAM_RATES_HZ, what="stream rate", unit="Hz", device=self.name, in_file="")
        self._stream_rate_hz = rate_hz
        timer = self.clock.every(1.0 / rate_hz, self._poll, name=f"{self.name} stream")
        try:
            yield
        finally:
            timer.cancel()
            self._stream_rate_hz = 0.0

    @property
    def streaming(self) -> bool:
        """Whether a stream is open."""
        return self._stream_rate_hz > 0

    # ------------------------------------------------------------------ for drivers

    def _next_seq(self) -> int:
        seq, self._seq = self._seq, self._seq + 1
        return seq

    def _publish_event(self, kind: EventKind, *, by: str = "", reason: str = "") -> None:
        if kind == "link_lost":
            self._lost_reason = reason
        seq, self._event_seq = self._event_seq, self._event_seq + 1
        self.events.publish(
            DeviceEvent(
                t_ns=self.clock.now_ns(), device=self.name, seq=seq, kind=kind, by=by, reason=reason,
                t_source="computed",
            )
        )  # fmt: skip

    def _require_same(self, found: DeviceInfo) -> None:
        """What comes back on the same port must be what was there before: the rig was set up for that one."""
        known = self.info.serial_number
        if known and found.serial_number != known:
            raise ProtocolError(
                f"{found.model or 'a device'} with serial number {found.serial_number or 'unknown'} answers in the "
                f"place of {known}",
                remedy="connect the device that was there before, or open the rig anew",
                moved="no",
            )

    def _require_open(self) -> None:
        if self.link != "open":
            why = f": {self._lost_reason}" if self.link == "lost" and self._lost_reason else ""
            raise LinkLost(
                f"the device is {self.link}{why}",
                device=self.name,
                moved="no",
                remedy="open the rig; if the link was lost, check cable and power, then close and open it again",
            )

    def _poll(self) -> None:
        """One beat of the stream. A failing link is reported once; the stream goes on trying."""
        if self.link == "closed":
            return
        try:
            with self._naming_errors():
                sample = self._read()
        except LinkError as error:
            self._stream_errors += 1
            if self._stream_errors == 1:
                _log.warning("%s", error)
                self.link = "lost"
                self._publish_event("link_lost", reason=str(error.what))
            return
        if self._stream_errors:
            self._stream_errors = 0
            self.link = "open"
            self._publish_event("link_back")
        self.clock.deliver(lambda: self.topic.publish(sample))

    @contextmanager
    def _naming_errors(self) -> Iterator[None]:
        """Put the device's name on errors from deeper layers, and remember faults."""
        try:
            yield
        except MicrodriversError as error:
            self._put_name_on(error)
            raise

    def _put_name_on(self, error: MicrodriversError) -> None:
        error.device = error.device or self.name
        if isinstance(error, DeviceFault) and error is not self.fault:  # raised again, it is not a new one
            self.fault = error
            self._publish_event("fault", reason=error.what)
