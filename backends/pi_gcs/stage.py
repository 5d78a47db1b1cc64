"""The XYθ stage on a GCS 2.0 controller."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.pi_gcs import error_codes
from microdrivers.backends.pi_gcs.axis_map import AxisMap, by_axis
from microdrivers.backends.pi_gcs.controller_state import ControllerState
from microdrivers.backends.pi_gcs.identification import inspect
from microdrivers.backends.pi_gcs.protocol import Gcs, Pose
from microdrivers.backends.pi_gcs.replies import AxisStatus
from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.core.errors import (
    DeviceFault,
    MicrodriversError,
    MoveCancelled,
    NotReached,
    NotReferenced,
    ProtocolError,
)
from microdrivers.core.samples import TimeSource, XYThetaSample
from microdrivers.core.units import NS_PER_MS, seconds_to_ns
from microdrivers.devices.base import DeviceInfo
from microdrivers.devices.wire_tap import WireTap
from microdrivers.devices.xytheta_stage import AXES, XYThetaStage

FAULT_FLAG = "FAULT"

_REFERENCE_POLL_S = 0.05

_log = logging.getLogger(__name__)


class GcsXYThetaStage(XYThetaStage):
    """Three axes of one multi-axis GCS 2.0 controller (C-884 class).

    Positions and status of all axes come from one write and are stamped at the instant at which the controller
    samples them: the end of the request plus `latch.delay_ms`. The first move of a referenced axis switches its
    servo on. A servo that drops by itself is a fault until `clear_fault()`; until then samples carry the flag
    `FAULT`. A controller that has forgotten its reference (power cycle) gives the event `reference_lost`.
    """

    def __init__(self, name: str, settings: GcsStageSettings, *, clock: Clock, bus: Bus) -> None:
        super().__init__(name, clock=clock, bus=bus)
        self.settle_s = settings.settle_s
        self._settings = settings
        self._line = SerialLine(settings.connection, clock=clock, tap=WireTap(name, bus))
        self._gcs = Gcs(self._line)
        self._latch_delay_ns = round(settings.latch.delay_ms * NS_PER_MS)
        self._latch_dt_ns = round(settings.latch.uncertainty_ms * NS_PER_MS)
        self._rig_axes = {axis: AxisMap.from_settings(getattr(settings.axes, axis)) for axis in AXES}
        self._adopt(self._rig_axes, {})

    def _adopt(self, axis_maps: Mapping[str, AxisMap], status_index: Mapping[str, int]) -> None:
        self._axis_maps = axis_maps
        self._status_index = status_index
        self._state = ControllerState(self._gcs, axis_maps)
        self._targets = dict.fromkeys(AXES, math.nan)
        self.axes = {axis: axis_map.spec for axis, axis_map in axis_maps.items()}

    @property
    def referenced(self) -> Mapping[str, bool]:
        """Whether the reference of each axis is known, as the controller last reported (FRF?)."""
        return dict(self._state.referenced)

    # ------------------------------------------------------------------ life

    def _connect(self) -> None:
        self._line.open()

    def _identify(self) -> DeviceInfo:
        try:
            found = inspect(self._gcs, self._settings, self._rig_axes, name=self.name)
            self._adopt(found.axes, found.status_index)
            self._examine()
        except MicrodriversError as error:
            error.moved = "no"
            raise
        return found.info

    @property
    def line_counters(self) -> Mapping[str, int]:
        """What has happened on the line since it was opened."""
        return vars(self._line.counters)

    def _close(self) -> None:
        self._line.close()
        self._state = ControllerState(self._gcs, self._axis_maps)

    def _stop(self) -> None:
        self._gcs.stop()
        self._forget_targets(AXES)

    def _clear_fault(self) -> None:
        code = self._gcs.error()
        if code:
            _log.info("%s: error %d (%s) cleared", self.name, code, error_codes.meaning_of(code))
        self._examine()
        self._state.dropped = frozenset()

    # ------------------------------------------------------------------ reading

    def _read(self) -> XYThetaSample:
        pose = self._gcs.pose()
        positions = by_axis(self._axis_maps, pose.positions, command="POS?")
        status = self._status_by_axis(pose)
        if self._state.contradicts(status):
            self._examine()
        t_ns, dt_ns, source = self._stamp(pose)
        in_servo = [axis_status for axis_status in status.values() if axis_status.servo_on]
        targets = self._targets
        return XYThetaSample(
            t_ns=t_ns,
            dt_ns=dt_ns,
            t_source=source,
            device=self.name,
            seq=self._next_seq(),
            flags=frozenset({FAULT_FLAG}) if self._state.dropped else frozenset(),
            x_um=self._axis_maps["x"].position(positions["x"]),
            y_um=self._axis_maps["y"].position(positions["y"]),
            theta_deg=self._axis_maps["theta"].position(positions["theta"]),
            target_x_um=targets["x"],
            target_y_um=targets["y"],
            target_theta_deg=targets["theta"],
            moving=any(axis_status.moving or axis_status.referencing for axis_status in status.values()),
            # An axis without servo holds no target and is never "on" it; the others decide.
            on_target=bool(in_servo) and all(axis_status.on_target for axis_status in in_servo),
            referenced=all(self._state.referenced.values()),
        )

    def _status_by_axis(self, pose: Pose) -> dict[str, AxisStatus]:
        if len(pose.status) <= max(self._status_index.values()):
            raise ProtocolError(
                f"the status reply has {len(pose.status)} registers, fewer than when the stage was opened",
                remedy="close and open the stage again",
            )
        return {axis: pose.status[index] for axis, index in self._status_index.items()}

    def _stamp(self, pose: Pose) -> tuple[int, int, TimeSource]:
        """When the controller sampled the positions."""
        latched_ns = pose.asked_ns + self._latch_delay_ns
        if latched_ns < pose.first_byte_ns:
            return latched_ns, self._latch_dt_ns, "request"
        # By the baud rate the request had not ended when the reply began: a port that has none (USB, TCP).
        half_ns = (pose.first_byte_ns - pose.start_ns) // 2
        return pose.start_ns + half_ns, half_ns, "midpoint"

    def _examine(self) -> int:
        """Ask the controller what has changed without being commanded; returns its error number.

        Raises:
            DeviceFault: the controller reports a fault, or a servo has dropped by itself.
        """
        found = self._state.examine()
        self._forget_targets((*found.lost, *found.dropped))
        if found.lost:
            axes = ", ".join(found.lost)
            reason = f"the controller no longer knows the reference of axis {axes}: was it switched off?"
            _log.warning("%s: %s", self.name, reason)
            self._publish_event("reference_lost", reason=reason)
        if error_codes.is_fault(found.code):
            raise error_codes.error_from(found.code)
        if found.dropped:
            raise _servo_fault(found.dropped, found.code)
        if found.code not in (error_codes.NO_ERROR, error_codes.STOPPED):
            meaning = error_codes.meaning_of(found.code)
            _log.warning("%s: error %d (%s) was pending", self.name, found.code, meaning)
        return found.code

    def _forget_targets(self, axes: Iterable[str]) -> None:
        self._targets = self._targets | dict.fromkeys(axes, math.nan)

    # ------------------------------------------------------------------ moving

    def _start_move(self, targets: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        stops = self._gcs.stops
        self._ensure_servo(targets)
        self._ensure_accepted(self._state.faster(speeds))
        if self._gcs.stops != stops:
            raise MoveCancelled("a stop was sent while the move was being prepared", moved="no")
        changed = self._state.changed(self._speed_texts(speeds))
        positions = {axis: self._axis_maps[axis].target_text(target) for axis, target in targets.items()}
        lines = [self._line_for("VEL", changed)] if changed else []
        lines.append(self._line_for("MOV", positions))
        self._state.speeds_sent(changed)
        code = self._gcs.attempt(*lines)
        if code:
            self._raise_refusal(code, targets, lines)
        self._state.speeds_taken(changed, speeds)
        self._targets = self._targets | dict(targets)

    def _ensure_servo(self, targets: Mapping[str, float]) -> None:
        """Switch on the servos that are off.

        An unexpected "off" may mean a power cycle, so the reference is asked for first.
        """
        if self._state.doubtful or not all(self._state.servo_on[axis] for axis in targets):
            self._examine()
            self._require_referenced(targets)
        self._refuse_at_fault(targets)
        off = [axis for axis in targets if not self._state.servo_on[axis]]
        if off:
            self._gcs.command(self._line_for("SVO", dict.fromkeys(off, "1")))
            self._state.switched_on(off)

    def _ensure_accepted(self, speeds: Mapping[str, float]) -> None:
        """Send speeds that the controller may refuse ahead of the move, which would go on at the old one."""
        if speeds:
            texts = self._speed_texts(speeds)
            self._state.speeds_sent(texts)
            self._gcs.command(self._line_for("VEL", texts))
            self._state.speeds_taken(texts, speeds)

    def _raise_refusal(self, code: int, targets: Mapping[str, float], lines: Sequence[str]) -> None:
        """Raise what a refused move means."""
        refusal = error_codes.error_from(code, sent="\n".join(lines).encode())
        if code == error_codes.MOVE_NOT_ALLOWED:
            self._examine()
            self._require_referenced(targets)
            raise refusal
        if code != error_codes.POSITION_OUT_OF_LIMITS and len(lines) > 1:
            # VEL was refused, and MOV may be running at a speed that nobody asked for.
            XYThetaStage.stop(self, by="driver", reason=refusal.what)
            raise DeviceFault(
                f"{refusal.what}; stopped, for the stage may have begun to move at another speed",
                code=code, text=error_codes.meaning_of(code), remedy=refusal.remedy,
            )  # fmt: skip
        raise refusal

    def _require_referenced(self, axes: Iterable[str]) -> None:
        unknown = [axis for axis in axes if not self._state.referenced[axis]]
        if unknown:
            raise NotReferenced(
                f"the controller no longer knows the reference of axis {', '.join(unknown)}",
                remedy=f"make sure that the way is free, then reference({unknown!r})",
            )

    def _refuse_at_fault(self, axes: Iterable[str]) -> None:
        dropped = [axis for axis in axes if axis in self._state.dropped]
        if dropped:
            fault = _servo_fault(dropped)
            fault.moved = "no"
            raise fault

    def _speed_texts(self, speeds: Mapping[str, float]) -> dict[str, str]:
        return {axis: self._axis_maps[axis].speed_text(speed) for axis, speed in speeds.items()}

    def _line_for(self, mnemonic: str, texts: Mapping[str, str]) -> str:
        pairs = (f"{self._axis_maps[axis].id} {texts[axis]}" for axis in AXES if axis in texts)
        return f"{mnemonic} {' '.join(pairs)}"

    # ------------------------------------------------------------------ referencing

    def _reference_axis(self, axis: str) -> None:
        self._refuse_at_fault([axis])
        axis_map = self._axis_maps[axis]
        stops = self._gcs.stops
        self._state.begin_reference(axis)
        self._forget_targets([axis])
        try:
            self._gcs.command(f"SVO {axis_map.id} 1")
            self._gcs.command(f"RON {axis_map.id} 1")
            self._begin_reference(axis, f"{axis_map.reference} {axis_map.id}")
            self._await_ready(axis, stops)
            code = self._examine()
        finally:
            self._state.referencing = None
        if self._gcs.stops != stops or code == error_codes.STOPPED:
            raise _reference_stopped(axis)
        if not self._state.referenced[axis]:
            raise DeviceFault(
                f"axis {axis} has not found its reference ({axis_map.reference}); error {code}",
                code=code or error_codes.REFERENCING_FAILED, text="referencing failed",
                remedy="check the switches, the way, and `reference` of the axis in the rig file",
            )  # fmt: skip

    def _begin_reference(self, axis: str, line: str) -> None:
        code = self._gcs.attempt(line)
        if code == error_codes.MOVE_NOT_ALLOWED:
            raise DeviceFault(
                f"the controller does not start the reference move of axis {axis}: its servo is off",
                code=code, text=error_codes.meaning_of(code), moved="no",
                remedy="check the motor supply, the emergency stop and the stage cable",
            )  # fmt: skip
        if code:
            raise error_codes.error_from(code, sent=line.encode())

    def _await_ready(self, axis: str, stops: int) -> None:
        """Wait until the reference move has ended, well or not."""
        timeout_s = self._settings.reference_timeout_s
        deadline_ns = self.clock.now_ns() + seconds_to_ns(timeout_s)
        while not self._gcs.ready():
            if self._gcs.stops != stops:
                raise _reference_stopped(axis)
            if self.clock.now_ns() >= deadline_ns:
                XYThetaStage.stop(self, by="supervision", reason=f"axis {axis} did not find its reference")
                raise NotReached(
                    f"axis {axis} has not found its reference in {timeout_s:g} s; stopped",
                    remedy="check the switches and the way, or allow more reference_timeout_s in the rig file",
                )
            self.clock.sleep(_REFERENCE_POLL_S)


def _servo_fault(axes: Iterable[str], code: int = 0) -> DeviceFault:
    return DeviceFault(
        f"the servo of axis {', '.join(axes)} has switched itself off",
        code=code, text="servo off", remedy="check load, obstacles and cable, then clear_fault()",
    )  # fmt: skip


def _reference_stopped(axis: str) -> MoveCancelled:
    return MoveCancelled(
        f"the reference move of axis {axis} was stopped",
        remedy="check why the stop was requested, then reference the axis again",
    )
