"""The zoom motor on an AZ drive."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from microdrivers.backends.oriental_az.backlash import Backlash
from microdrivers.backends.oriental_az.communication_guard import CommunicationGuard
from microdrivers.backends.oriental_az.drive import COORDINATES_ESTABLISHED, AzDrive, Input, Motion
from microdrivers.backends.oriental_az.link import az_link
from microdrivers.backends.oriental_az.motion_watch import MotionWatch
from microdrivers.backends.oriental_az.register_order_check import check_register_order
from microdrivers.backends.oriental_az.settings import AzZoomSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import (
    DeviceFault,
    LinkError,
    MicrodriversError,
    MoveCancelled,
    Moved,
    NotReached,
    RefusedError,
)
from microdrivers.core.samples import EventKind, ZoomSample
from microdrivers.core.units import Range, seconds_to_ns
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.motion import AxisSpec
from microdrivers.devices.wire_tap import WireTap
from microdrivers.devices.zoom_motor import Approach, ZoomCurve, ZoomMotor

_POLL_S = 0.02
_ALARM_RESET_S = 1.0

_log = logging.getLogger(__name__)


class AzZoomMotor(ZoomMotor):
    """A zoom motor on an Oriental Motor AZ stepper drive, over Modbus RTU or TCP.

    A sample costs one exchange (11.3 ms at 115200 baud, 8E1, with the drive's factory waiting time), and a second one
    each 0.5 s and while the motor settles; see `motion_watch`. `on_target` is the drive's own word (IN-POS, no MOVE)
    and its command position. Flag `ALARM`: the drive reports an alarm.

    Two threads may read and move at once; `stop()` comes between any two of their exchanges.
    """

    def __init__(self, name: str, settings: AzZoomSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.curve = ZoomCurve.from_points(settings.curve)
        self.zoom_range = settings.zoom_range.intersect(Range(self.curve.zoom[0], self.curve.zoom[-1]))
        self.settle_s = settings.settle_s
        low_steps, high_steps = (self.curve.steps_at(zoom) for zoom in self.zoom_range)
        self.axis = AxisSpec(
            unit="steps",
            min_position=low_steps,
            max_position=high_steps,
            max_speed=settings.speed_steps_s,
            acceleration=settings.acceleration_steps_s2,
            resolution=1.0,
            tolerance=settings.tolerance_steps,
        )
        self._settings = settings
        self._line, self._modbus = az_link(settings, clock=clock, tap=WireTap(name, bus))
        self._drive = AzDrive(self._modbus, settings.register_order)
        self._guard = CommunicationGuard(
            self._drive,
            wanted_s=settings.communication_timeout_s,
            clock=clock,
            exchanges=lambda: self._line.counters.exchanges,
            ask=self._poll,
        )
        self._backlash = Backlash(
            play_steps=settings.backlash_steps,
            tolerance_steps=settings.tolerance_steps,
            low_steps=low_steps,
            high_steps=high_steps,
        )
        self._lock = threading.RLock()
        self._begin()

    def _begin(self) -> None:
        """What is known of a drive that nobody has asked yet."""
        self._watch = MotionWatch(tolerance_steps=self._settings.tolerance_steps, settle_s=self.settle_s)
        self._target_steps: int | None = None
        self._position_steps = 0
        self._alarm_code = 0
        self._interruption: DeviceFault | None = None
        self._under_way = False
        self._stop_is_on = True  # the input word may hold anything
        self._stop_request = object()
        self._backlash.forget()

    # ------------------------------------------------------------------ connection

    def _connect(self) -> None:
        self._line.open()
        self._begin()
        self.fault = None

    def _identify(self) -> DeviceInfo:
        """Read what an AZ drive must be able to tell; an alarm is recorded and leaves the device open."""
        check_register_order(self._modbus, self._settings.register_order, name=self.name)
        self._guard.arm()
        self._observe()
        self._note_alarm(self._drive.read_alarm())
        error = self._drive.read_communication_error()
        if error:
            _log.info("%s: the drive's latest communication error is %02Xh", self.name, error)
        self._guard.start(name=f"{self.name} keep-alive")
        return DeviceInfo(driver="oriental-az-zoom", vendor="Oriental Motor", model="AZ")

    @property
    def line_counters(self) -> Mapping[str, int]:
        """What has happened on the line since it was opened."""
        return vars(self._line.counters)

    def _close(self) -> None:
        try:
            self._guard.end()
        finally:
            self._line.close()

    def _clear_fault(self) -> None:
        with self._lock:
            if not self._drive.read_alarm():
                return
            self._write_input_over_stop(Input.ALM_RST)
            self._drive.write_input(Input.NONE)
        deadline_ns = self.clock.now_ns() + seconds_to_ns(_ALARM_RESET_S)
        while code := self._drive.read_alarm():
            if self.clock.now_ns() >= deadline_ns:
                raise self._drive.fault(code, moved="no", during="the alarm could not be reset: ")
            self.clock.sleep(_POLL_S)
        with self._lock:
            self._watch.see_status(self._drive.read_status())  # the last one still tells of the alarm
        self._alarm_code = 0

    # ------------------------------------------------------------------ reading

    @property
    def referenced(self) -> bool:
        """Whether the drive's coordinates were established when it was last asked."""
        return self._watch.referenced

    def read(self) -> ZoomSample:
        """A fresh exchange with the drive, published on the device's topic.

        Raises:
            LinkError: no connection, no answer, or an unintelligible one.
            DeviceFault: an alarm ended the motion under way; raised once, later reads succeed.
        """
        sample = super().read()
        fault, self._interruption = self._interruption, None
        if fault is not None:
            raise fault
        return sample

    def _read(self) -> ZoomSample:
        with self._lock, self.clock.transaction():
            motion = self._observe()
            target = self._target_steps
            at_target = target is None or motion.command_position == target
            return ZoomSample(
                t_ns=motion.t_ns,
                dt_ns=motion.dt_ns,
                t_source="midpoint",
                device=self.name,
                seq=self._next_seq(),
                flags=frozenset({"ALARM"}) if self._watch.alarm else frozenset(),
                zoom=self.curve.zoom_at(motion.feedback_position),
                position_steps=motion.feedback_position,
                target_zoom=float("nan") if target is None else self.curve.zoom_at(target),
                moving=self._watch.moving,
                on_target=at_target and self._watch.in_position,
                referenced=self._watch.referenced,
            )

    def _observe(self) -> Motion:
        """The output word if it is wanted, then command and feedback; what has changed is announced."""
        with self._lock, self.clock.transaction():
            was_referenced = self._watch.referenced
            try:
                if self._watch.wants_status(self.clock.now_ns()):
                    self._watch.see_status(self._drive.read_status())
                    self._guard.keep_armed(may_be_forgotten=self._watch.may_have_restarted)
                    if not self._watch.alarm:
                        self._alarm_code = 0
                    elif not self._alarm_code:
                        self._note_alarm(self._drive.read_alarm())
                motion = self._drive.read_motion()
            except LinkError:
                self._watch.link_failed()
                raise
            self._watch.see_motion(motion)
            if not self._watch.moving:
                self._under_way = False
            elif not self._under_way:
                self._backlash.forget()
            self._position_steps = motion.feedback_position
        if was_referenced and not self._watch.referenced:
            self._announce("reference_lost", "the drive reports no established coordinates")
        return motion

    def _note_alarm(self, code: int) -> None:
        if not code or code == self._alarm_code:
            return
        self._alarm_code = code
        fault = self._drive.fault(code, moved="maybe")
        fault.device = self.name
        self.fault = fault
        if self._under_way:
            self._interruption = fault
        self._announce("fault", fault.what)

    def _announce(self, kind: EventKind, reason: str) -> None:
        self.clock.deliver(lambda: self._publish_event(kind, reason=reason))

    # ------------------------------------------------------------------ moving

    def _start_move(self, position_steps: int) -> None:
        settings = self._settings
        with self._commanding(position_steps):
            previous, self._target_steps = self._target_steps, position_steps
            try:
                self._drive.start_absolute(
                    position_steps,
                    speed_hz=settings.speed_steps_s,
                    rate_hz_s=settings.acceleration_steps_s2,
                    current_permille=round(settings.current_percent * 10),
                )
            except (RefusedError, DeviceFault):
                self._target_steps = previous
                raise
            self._backlash.moved(self._position_steps, position_steps)

    def _reference(self) -> None:
        """Fast move to the home position (ZHOME).

        Raises:
            DeviceFault: an alarm, among them 4Ah: the drive has no established coordinates.
            NotReached: it did not end within `reference_timeout_s`. MoveCancelled: it was stopped.
        """
        with self._commanding() as stop_request:
            self._target_steps = None
            self._backlash.forget()
            self._drive.pulse_input(Input.ZHOME)
            if self._stop_request is not stop_request:
                self._drive.post_stop()  # ours may have overwritten the one that was asked for
        deadline_ns = self.clock.now_ns() + seconds_to_ns(self._settings.reference_timeout_s)
        while self.read().moving or COORDINATES_ESTABLISHED not in self._watch.outputs:
            self._raise_if_stopped_since(stop_request, "yes")
            if self.clock.now_ns() >= deadline_ns:
                self._stop()
                raise NotReached(
                    f"the home position was not reached within {self._settings.reference_timeout_s:g} s; stopped",
                    remedy="check that the zoom ring turns freely, and reference_timeout_s in the rig file",
                )
            self.clock.sleep(_POLL_S)
        self._raise_if_stopped_since(stop_request, "yes")

    def _approach_steps(self, start_steps: int, target_steps: int, approach: Approach) -> int | None:
        return self._backlash.via(start_steps, target_steps, approach)

    @contextmanager
    def _commanding(self, target_steps: int | None = None) -> Iterator[object]:
        """Everything before and after a command that sets the motor in motion; yields the latest stop request.

        Refuses at a fault; takes a STOP back that is still on; gives up if another one comes meanwhile. From here on
        the motor counts as moving.
        """
        with self._lock, self.clock.transaction():
            if self.fault is not None:
                raise self._drive.fault(self.fault.code, moved="no", during="the motor does not move: ")
            stop_request = self._stop_request
            if self._stop_is_on:
                self._write_input_over_stop(Input.NONE)
            self._raise_if_stopped_since(stop_request, "no")
            superseding, self._under_way = self._under_way, True
            if superseding:
                self._backlash.forget()
            self._interruption = None
            self._watch.commanded(target_steps)
            try:
                yield stop_request
            except (RefusedError, DeviceFault):
                self._under_way = superseding
                raise
            except LinkError:
                self._watch.link_failed()
                self._backlash.forget()
                raise

    # ------------------------------------------------------------------ stopping

    def _stop(self) -> None:
        self._stop_request = object()
        self._stop_is_on = True
        self._backlash.forget()
        self._drive.post_stop()

    def _write_input_over_stop(self, word: Input) -> None:
        """Write the input word; a STOP that is requested meanwhile stays noted, as it may stand in the drive."""
        self._stop_is_on = False
        try:
            self._drive.write_input(word)
        except MicrodriversError:
            self._stop_is_on = True
            raise

    def _raise_if_stopped_since(self, stop_request: object, moved: Moved) -> None:
        if self._stop_request is not stop_request:
            self._stop_is_on = True
            raise MoveCancelled(
                "stop() came while the motion was being commanded or under way",
                remedy="check why the stop was requested, then command a new move",
                moved=moved,
            )
