"""A fine stage on three CiA 402 drives."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial

from microdrivers.backends.canopen.heartbeat import Heartbeats
from microdrivers.backends.canopen.sync import SyncProducer
from microdrivers.backends.canopen.synced_pdos import SyncSet
from microdrivers.backends.cia402 import objects
from microdrivers.backends.cia402.drive import STATUS_BYTES, Drive
from microdrivers.backends.cia402.drives import Drives
from microdrivers.backends.cia402.guard import Guard
from microdrivers.backends.cia402.homing import ReferenceSearch, refuse_other_order
from microdrivers.backends.cia402.path import write_path
from microdrivers.backends.cia402.pose import pose_sample
from microdrivers.backends.cia402.power import reset_faults, rest, switch_off
from microdrivers.backends.cia402.set_up import HEARTBEATS_A_TIMEOUT, describe, identify_all, set_up
from microdrivers.backends.cia402.settings import FineStageSettings
from microdrivers.backends.cia402.states import Control
from microdrivers.backends.lines.can_line import Listening, shared_can_line
from microdrivers.backends.lines.can_load import longest_frame_bits
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import (
    DeviceFault,
    LinkError,
    LinkTimeout,
    MicrodriversError,
    ProtocolError,
)
from microdrivers.core.samples import EventKind, FineStageSample
from microdrivers.core.units import NS_PER_S, Range, check_range, seconds_to_ns
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.fine_stage import FineStage
from microdrivers.devices.shared_bus import BusFacts

_BUSY_S = 1.0
_RETRY_S = 1.0
_UNANSWERED_S = 1.0
_SLOWEST_HZ = 0.001

_log = logging.getLogger(__name__)


class Cia402FineStage(FineStage):
    """Three drives of profile CiA 402 in profile position mode, on one CAN bus that others may share.

    Status and position of all drives come as one PDO each, on one SYNC, and are stamped at the instant at which it
    reached them. A set in which one is missing is lost as a whole.

    Opening writes travel limits, PDOs and heartbeats to the drives and switches no power stage on; the first move, or
    reference search, of an axis does. Closing switches them off. An axis that has a fault, restarts or falls silent
    stops the others; a fault holds until `clear_fault()`, and until then samples carry the flag `FAULT`.
    """

    def __init__(self, name: str, settings: FineStageSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.settle_s = settings.settle_s
        self.retract_um = settings.retract_um
        self.origin_um = settings.origin_um
        self.axes_in_rig = {axis: getattr(settings.axes_in_rig, axis) for axis in self.axis_names}
        self._settings = settings
        self._line = shared_can_line(settings.connection, clock=clock, bus=bus)
        self._guard = Guard(
            order=settings.reference_order, tell=self._tell, faulted=self._note_fault, recover=self._recover_soon
        )
        timeout_s = settings.connection.timeout_s
        drives = [
            Drive(
                self._line, axis, getattr(settings.axes, axis), owner=name, timeout_s=timeout_s,
                on_heartbeat=self._guard.heartbeat, on_silence=self._guard.silence, on_emergency=self._guard.emergency,
            )
            for axis in self.axis_names
        ]  # fmt: skip
        self._drives = self._guard.drives = Drives(
            self._line, drives, timeout_s=timeout_s, on_set=self._publish_set, on_lost=self._miss_set,
            check=self._guard.refuse,
        )  # fmt: skip
        self.axes = {drive.axis: drive.map.spec for drive in drives}
        self._targets_um = dict.fromkeys(self.axis_names, math.nan)
        self._listening: list[Listening] = []
        self._setting_up = threading.Lock()
        self._moving = threading.Lock()
        self._recovered_ns = -NS_PER_S
        self._answered_ns = 0

    @property
    def reference_order(self) -> tuple[str, ...]:
        """The rig file's order, which no call may contradict."""
        return self._settings.reference_order

    @property
    def referenced(self) -> Mapping[str, bool]:
        """Whether each drive knows its reference: said by the drive when it is set up, then watched."""
        return {drive.axis: drive.referenced for drive in self._drives.all}

    @property
    def line_counters(self) -> Mapping[str, int]:
        """What has happened on the bus since it was opened, by all devices of this rig, and what this stage missed."""
        counters = self._line.counters
        return {
            "exchanges": counters.exchanges,
            "timeouts": counters.timeouts,
            "error_frames": counters.error_frames,
            "garbled": counters.garbled,
            "lost_samples": self._drives.pdos.lost,
            "skipped_samples": self._drives.pdos.skipped,
            "foreign_syncs": self._line.service(SyncProducer).foreign,
        }

    @property
    def bus_load(self) -> float:
        """Share of the bus' time that this rig's frames take, 0 to 1."""
        return self._line.load

    @property
    def bus_facts(self) -> BusFacts:
        """The bus at present, as all devices on it see it."""
        return self._line.facts

    # ------------------------------------------------------------------ life

    def _connect(self) -> None:
        self._line.open()
        try:
            for drive in self._drives.all:
                drive.node.attach()
        except MicrodriversError:
            self._disconnect()
            raise
        self._listening.append(self._line.on_loss(self._guard.lost))

    def _identify(self) -> DeviceInfo:
        self._guard.cleared()
        self.fault = None
        heartbeats = self._line.service(Heartbeats)
        interval_s = self._settings.heartbeat_ms / 1000 / HEARTBEATS_A_TIMEOUT
        self._listening.append(heartbeats.produce(interval_s))
        try:
            found = identify_all(self._drives.all, device=self.name)
            heartbeats.refuse_other_host(interval_s)
            self._be_ready()
            self._drives.pdos.begin_listening()
            self._drives.look()
            self._guard.examine()
            self._guard.explain()
            self._guard.told()
        except MicrodriversError as error:
            error.moved = "no"
            raise
        self._guard.on_duty = True
        return describe(found, driver=self._settings.driver)

    def _close(self) -> None:
        self._guard.on_duty = False
        try:
            switch_off(self._drives)
        except MicrodriversError as error:
            _log.warning("%s: the drives could not be switched off: %s", self.name, error)
        self._disconnect()

    def _disconnect(self) -> None:
        while self._listening:
            self._listening.pop().cancel()
        self._drives.pdos.end_listening()
        for drive in self._drives.all:
            drive.forget()
            drive.node.detach()
        self._line.close()

    def _stop(self) -> None:
        self._drives.stop()

    # ------------------------------------------------------------------ faults, restarts, silence

    def _tell(self, kind: EventKind, reason: str) -> None:
        """Publish an event in its turn: the thread that receives may be ahead of it on a simulated clock."""
        if kind == "link_lost":
            if self.link == "lost":  # one event, but whoever asks is told of all
                self.clock.deliver(partial(setattr, self, "_lost_reason", reason))
            if self.link != "open":
                return
            self.link = "lost"
        self.clock.deliver(lambda: self._publish_event(kind, by="driver" if kind == "stopped" else "", reason=reason))

    def _note_fault(self, fault: DeviceFault) -> None:
        self.fault = fault
        self._tell("fault", fault.what)

    def _recover_soon(self) -> None:
        """A drive is back: set it up again, not in the thread that receives, and not more than once a second."""
        now_ns = self.clock.now_ns()
        if now_ns - self._recovered_ns >= seconds_to_ns(_RETRY_S):
            self._recovered_ns = now_ns
            self.clock.call_at(now_ns, self._recover, name=f"{self.name} recovery")

    def _recover(self) -> None:
        if not self._guard.on_duty:
            return
        try:
            self._be_ready()
            self._regain_link()
        except MicrodriversError as error:
            _log.warning("%s: could not be set up again: %s", self.name, error)

    def _be_ready(self) -> None:
        """Set up what has not been since it was started.

        Raises:
            LinkLost: a drive is silent; the others have been set up.
        """
        if not self._drives.are_ready():
            with self._line.holding(self._setting_up, timeout_s=_BUSY_S, what="setting up the drives"):
                for drive in self._drives.all:
                    if drive.ready or not drive.node.alive:
                        continue
                    with self.clock.transaction():  # on a simulated clock nobody else gets in between
                        set_up(drive, heartbeat_ms=self._settings.heartbeat_ms, clock=self.clock)
                    if drive.referenced and self._guard.on_duty:
                        self._tell("reference_found", f"axis {drive.axis}: the drive still knows it")
                if self._drives.are_ready():
                    self._drives.pdos.resume()
        self._guard.require_alive()

    def _regain_link(self) -> None:
        if self.link == "lost" and self._guard.on_duty and self._drives.are_ready():
            self.link = "open"
            self._tell("link_back", "")

    def _clear_fault(self) -> None:
        self._be_ready()
        reset_faults(self._drives)
        self._guard.cleared()

    # ------------------------------------------------------------------ reading

    def _read(self) -> FineStageSample:
        self._be_ready()
        try:
            found = self._drives.look()
        except LinkTimeout:
            if self._drives.are_ready():
                raise
            self._be_ready()  # one has restarted meanwhile
            found = self._drives.look()
        if self._drives.are_braking():
            rest(self.clock)  # rest shows only in two looks
            found = self._drives.look()
        self._guard.examine()
        self._guard.explain()
        self._guard.raise_new()
        return self._sample(found)

    def _sample(self, found: SyncSet) -> FineStageSample:
        return pose_sample(
            self._drives.all, found, targets_um=self._targets_um, at_fault=self._guard.at_fault, device=self.name,
            seq=self._next_seq(),
        )  # fmt: skip

    # ------------------------------------------------------------------ streaming

    @contextmanager
    def stream(self, rate_hz: float) -> Iterator[None]:
        """Publish samples at `rate_hz` on topic `<name>` while the context is open: one SYNC each.

        Raises:
            OutOfRange: the bus cannot carry so many frames.
        """
        self._require_open()
        bits = longest_frame_bits(0) + len(self.axis_names) * longest_frame_bits(STATUS_BYTES)
        fastest_hz = math.floor(self._settings.connection.bitrate / bits)
        check_range(rate_hz, Range(_SLOWEST_HZ, fastest_hz), what="stream rate", unit="Hz", device=self.name)
        self._stream_rate_hz = rate_hz
        running = self._drives.pdos.run(rate_hz)
        try:
            yield
        finally:
            running.cancel()
            self._stream_rate_hz = 0.0

    def _publish_set(self, found: SyncSet) -> None:
        try:
            self._drives.see(found)
        except ProtocolError as error:
            _log.warning("%s: %s", self.name, error)
            self._miss_set(())
            return
        self._answered_ns = found.t_ns
        self._guard.examine()
        sample = self._sample(found)
        if self.link == "lost":
            self._regain_link()
        self.clock.deliver(partial(self.topic.publish, sample))

    def _miss_set(self, missing: Sequence[int]) -> None:
        """Heartbeats tell whether the drives are there; without answers for long the link is lost all the same."""
        if self._guard.on_duty and self.clock.now_ns() - self._answered_ns > seconds_to_ns(_UNANSWERED_S):
            names = ", ".join(drive.name for drive in self._drives.all if drive.status_id in missing)
            self._tell("link_lost", f"no answer to SYNC from {names or 'the drives'}")

    # ------------------------------------------------------------------ moving

    def reference(self, axes: Sequence[str]) -> None:
        """Find the reference of the named axes, in exactly that order. Moves the stage to its switches.

        Raises:
            UnsafeError: the rig file's `reference_order` has an axis before one of these that is not referenced.
            OutOfRange: an unknown or repeated axis. DeviceFault, NotReached: referencing failed.
        """
        with self._naming_errors():
            refuse_other_order(axes, order=self.reference_order, referenced=self.referenced)
        super().reference(axes)

    def _reference_axis(self, axis: str) -> None:
        with self._line.holding(self._moving, timeout_s=_BUSY_S, what="another move or reference search"):
            self._be_ready()
            ReferenceSearch(
                self._drives, axis, clock=self.clock, timeout_s=self._settings.reference_timeout_s,
                stop=lambda by, reason: FineStage.stop(self, by=by, reason=reason), check=self._guard.refuse,
            ).run()  # fmt: skip

    def _start_move(self, targets: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        with self._line.holding(self._moving, timeout_s=_BUSY_S, what="another move or reference search"):
            drives, stops = self._drives, self._drives.stops
            try:
                self._be_ready()
                drives.prepare(targets, objects.PROFILE_POSITION, stops)
                counts = write_path(drives.by_axis, targets, speeds)
                drives.refuse_after_stop(stops)
            except MicrodriversError as error:
                error.moved = "no"
                raise
            for axis, target in targets.items():
                self._targets_um[axis] = target
                drives.by_axis[axis].watch.commanded(counts[axis])
            try:
                drives.start(dict.fromkeys(targets, Control.NEW_SET_POINT), stops)
                drives.await_acknowledgement(tuple(targets), stops)
            except MicrodriversError as error:
                with suppress(LinkError):
                    FineStage.stop(self, by="driver", reason=f"a move could not be started: {error.what}")
                raise
