"""One GCS controller and those axes of the stage that it drives: all three, or one in a daisy chain."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Literal, NamedTuple

from microdrivers.backends.lines.serial_line import Exchange
from microdrivers.backends.pi_gcs import error_codes
from microdrivers.backends.pi_gcs.axis_map import AxisMap, by_axis
from microdrivers.backends.pi_gcs.controller_state import ControllerState, Findings
from microdrivers.backends.pi_gcs.identification import inspect
from microdrivers.backends.pi_gcs.naming import NamingErrors
from microdrivers.backends.pi_gcs.protocol import Gcs, Pose
from microdrivers.backends.pi_gcs.replies import AxisStatus
from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.core.errors import DeviceFault, MicrodriversError, NotReferenced, ProtocolError
from microdrivers.core.samples import TimeSource
from microdrivers.core.units import NS_PER_MS
from microdrivers.devices.base import DeviceInfo

_log = logging.getLogger(__name__)


class Reading(NamedTuple):
    """What is known of axes at one time: from one controller in one exchange, or of all together.

    Attributes:
        t_ns: when it sampled the positions. dt_ns: half-width of the 95 % interval of that. source: of that time.
        start_ns: when the request began. end_ns: when the reply had come.
        positions: in rig units, by axis of the stage. targets: where they had been sent before the exchange.
        status: the status registers, likewise.
        before: a mark that changes with everything that makes positions jump or motion break off: a stop, a change
            of servo or reference, a failed exchange; as it was before the exchange. after: as it was after it.
        jumping: whether the position may change by itself, in a reference move.
    """

    t_ns: int
    dt_ns: int
    source: TimeSource
    start_ns: int
    end_ns: int
    positions: dict[str, float]
    targets: Mapping[str, float]
    status: dict[str, AxisStatus]
    before: tuple[int, ...]
    after: tuple[int, ...]
    jumping: bool


class Controller:
    """Moves and reads its axes, and finds out what has changed without being commanded.

    Errors name the axes that were asked for, and in a daisy chain the address.

    Args:
        name: of the stage, for messages.
        reference_lost: is told, in words, if the controller has forgotten the reference of an axis.

    Attributes:
        axes: its axes by x, y, theta, with the limits that rig file and controller allow.
        state: what is known of their servos and references.
        targets: where they were last sent, in rig units; NaN if nowhere.
    """

    def __init__(
        self,
        gcs: Gcs,
        rig_axes: Mapping[str, AxisMap],
        settings: GcsStageSettings,
        *,
        name: str,
        reference_lost: Callable[[str], None],
    ) -> None:
        self.gcs = gcs
        self.name = name
        self._naming = NamingErrors(() if gcs.address is None else rig_axes, gcs.address)
        self._rig_axes = rig_axes
        self._settings = settings
        self._reference_lost = reference_lost
        self._latched_after_ns = gcs.pose_asked_after_ns + round(settings.latch.delay_ms * NS_PER_MS)
        self._latch_dt_ns = round(settings.latch.uncertainty_ms * NS_PER_MS)
        self._adopt(rig_axes, {})

    def _adopt(self, axes: Mapping[str, AxisMap], status_index: Mapping[str, int]) -> None:
        self.axes = axes
        self.targets = dict.fromkeys(axes, math.nan)
        self._status_index = status_index
        self.forget()

    def identify(self) -> DeviceInfo:
        """Find out who answers, and adopt its limits; see `identification.inspect` for what it raises."""
        with self._naming:
            found = inspect(self.gcs, self._settings, self._rig_axes, name=self.name)
            self._adopt(found.axes, found.status_index)
            self.examine()
        return found.info

    def forget(self) -> None:
        """The connection has ended: nothing is known of servos and references."""
        self.state = ControllerState(self.gcs, self.axes)

    def forget_targets(self, axes: Iterable[str] = ()) -> None:
        """These axes (default: all) are no longer on their way to a target."""
        self.targets = self.targets | dict.fromkeys(axes or self.axes, math.nan)

    # ------------------------------------------------------------------ reading

    def read(self) -> Reading:
        """Positions and status of the axes, in one exchange."""
        before, targets = self.mark(), self.targets
        with self._naming:
            exchange = self.gcs.ask_pose()
        return self.understand(exchange, before, targets)

    def understand(self, exchange: Exchange, before: tuple[int, ...], targets: Mapping[str, float]) -> Reading:
        """What an exchange says; `before` and `targets` are the mark and the targets from before it."""
        with self._naming:
            pose = self.gcs.understand_pose(exchange)
            native = by_axis(self.axes, pose.positions, command="POS?")
            status = self._status_by_axis(pose)
        t_ns, dt_ns, source = self.stamp(exchange)
        return Reading(
            t_ns, dt_ns, source, pose.start_ns, pose.end_ns,
            positions={axis: axis_map.position(native[axis]) for axis, axis_map in self.axes.items()},
            targets=targets, status=status, before=before, after=self.mark(),
            jumping=self.state.referencing is not None or any(found.referencing for found in status.values()),
        )  # fmt: skip

    def mark(self) -> tuple[int, ...]:
        """Changes with everything that makes positions jump or motion break off; see `Reading`."""
        return self.gcs.stops, self.gcs.interruptions, self.state.changes

    def stamp(self, exchange: Exchange) -> tuple[int, int, TimeSource]:
        """When the controller sampled the positions, and how well that is known."""
        latched_ns = exchange.request_start_ns + self._latched_after_ns
        if latched_ns < exchange.first_byte_ns:
            return latched_ns, self._latch_dt_ns, "request"
        # By the baud rate the request had not ended when the reply began: a port that has none (USB, TCP).
        half_ns = (exchange.first_byte_ns - exchange.request_start_ns) // 2
        return exchange.request_start_ns + half_ns, half_ns, "midpoint"

    def contradicted_by(self, reading: Reading) -> bool:
        """Whether a reading calls for `examine`; tells a change once only."""
        return self.state.contradicts(reading.status)

    def examine(self) -> int:
        """Ask the controller what has changed without being commanded; returns its error number.

        Raises:
            DeviceFault: the controller reports a fault, or a servo has dropped by itself.
        """
        with self._naming:
            found = self.state.examine()
            changed = (*found.lost, *found.dropped)
            if changed:
                self.forget_targets(changed)
            if found.lost:
                where = "" if self.gcs.address is None else f" at address {self.gcs.address}"
                axes = ", ".join(found.lost)
                reason = f"the controller{where} no longer knows the reference of axis {axes}: was it switched off?"
                _log.warning("%s: %s", self.name, reason)
                self._reference_lost(reason)
            if error_codes.is_fault(found.code):
                raise _fault(found)
            if found.dropped:
                raise _servo_fault(found.dropped, found.code)
            if found.code not in (error_codes.NO_ERROR, error_codes.STOPPED):
                meaning = error_codes.meaning_of(found.code)
                _log.warning("%s: error %d (%s) was pending", self.name, found.code, meaning)
            return found.code

    def clear_fault(self) -> None:
        """Read the error away and find out how things stand; dropped servos may then be switched on again."""
        with self._naming:
            code = self.gcs.error()
            if code:
                _log.info("%s: error %d (%s) cleared", self.name, code, error_codes.meaning_of(code))
            self.examine()
        self.state.dropped = frozenset()

    # ------------------------------------------------------------------ moving

    def check(self, axes: Iterable[str]) -> None:
        """Refuse what must not move.

        An unexpected servo "off" may mean a power cycle, so the controller is asked before any is switched on.

        Raises:
            NotReferenced: the reference of an axis is not known. DeviceFault: an axis is at fault.
        """
        with self.naming_errors(axes):
            if self.state.doubtful or not all(self.state.servo_on[axis] for axis in axes):
                self.examine()
                self._require_referenced(axes)
            self.refuse_at_fault(axes)

    def prepare(self, speeds: Mapping[str, float]) -> None:
        """Switch on the servos that are off, and find out whether speeds are allowed that never were.

        A move whose speed is refused would go on at the old one, so these are sent ahead of it.
        """
        with self.naming_errors(speeds):
            off = [axis for axis in speeds if not self.state.servo_on[axis]]
            if off:
                self.gcs.command(self._line_for("SVO", dict.fromkeys(off, "1")))
                self.state.switched_on(off)
            faster = self.state.faster(speeds)
            if faster:
                texts = self._speed_texts(faster)
                self.state.speeds_sent(texts)
                self.gcs.command(self._line_for("VEL", texts))
                self.state.speeds_taken(texts, faster)

    def start(self, targets: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        """Send the axes to absolute targets, with new speeds where they have changed, in one write.

        Raises:
            DeviceFault: they may be moving at another speed, or their servo has dropped: stop them.
            MoveCancelled: a stop was sent meanwhile, which the move may have come after: stop them again.
            LinkError: nobody knows whether they move. RefusedError: they do not.
        """
        changed = self.state.changed(self._speed_texts(speeds))
        positions = {axis: self.axes[axis].target_text(target) for axis, target in targets.items()}
        lines = [self._line_for("VEL", changed)] if changed else []
        lines.append(self._line_for("MOV", positions))
        self.state.speeds_sent(changed)
        with self.naming_errors(targets):
            code = self.gcs.attempt(*lines)
            if code:
                self._raise_refusal(code, targets, lines)
        self.state.speeds_taken(changed, speeds)
        self.targets = self.targets | dict(targets)

    def refuse_at_fault(self, axes: Iterable[str]) -> None:
        """Raise if one of these axes is at fault."""
        dropped = [axis for axis in axes if axis in self.state.dropped]
        if dropped:
            with self._naming:
                raise _servo_fault(dropped, moved="no")

    # ------------------------------------------------------------------ inside

    def _raise_refusal(self, code: int, targets: Mapping[str, float], lines: Sequence[str]) -> None:
        """Raise what a refused move means."""
        refusal = self.gcs.refusal(code, *lines)
        if code == error_codes.MOVE_NOT_ALLOWED:
            self.examine()
            self._require_referenced(targets)
        elif code != error_codes.POSITION_OUT_OF_LIMITS and len(lines) > 1:
            # VEL was refused, and MOV may be running at a speed that nobody asked for.
            raise DeviceFault(
                f"{refusal.what}; stopped, for the stage may have begun to move at another speed",
                code=code, text=error_codes.meaning_of(code), remedy=refusal.remedy,
            )  # fmt: skip
        raise refusal

    def _require_referenced(self, axes: Iterable[str]) -> None:
        unknown = [axis for axis in axes if not self.state.referenced[axis]]
        if unknown:
            raise NotReferenced(
                f"the controller no longer knows the reference of axis {', '.join(unknown)}",
                remedy=f"make sure that the way is free, then reference({unknown!r})",
            )

    def _speed_texts(self, speeds: Mapping[str, float]) -> dict[str, str]:
        return {axis: self.axes[axis].speed_text(speed) for axis, speed in speeds.items()}

    def _line_for(self, mnemonic: str, texts: Mapping[str, str]) -> str:
        pairs = (f"{axis_map.id} {texts[axis]}" for axis, axis_map in self.axes.items() if axis in texts)
        return f"{mnemonic} {' '.join(pairs)}"

    def _status_by_axis(self, pose: Pose) -> dict[str, AxisStatus]:
        if len(pose.status) <= max(self._status_index.values()):
            raise ProtocolError(
                f"the status reply has {len(pose.status)} registers, fewer than when the stage was opened",
                remedy="close and open the stage again",
            )
        return {axis: pose.status[index] for axis, index in self._status_index.items()}

    def naming_errors(self, axes: Iterable[str]) -> NamingErrors:
        """A context that says in errors whose they are: of these axes, or in a chain of this controller's."""
        return NamingErrors(axes, None) if self.gcs.address is None else self._naming


def _fault(found: Findings) -> MicrodriversError:
    fault = error_codes.error_from(found.code)
    if found.dropped:
        fault.what += f"; the servo of axis {', '.join(found.dropped)} is off"
    return fault


def _servo_fault(axes: Iterable[str], code: int = 0, *, moved: Literal["no", "maybe"] = "maybe") -> DeviceFault:
    return DeviceFault(
        f"the servo of axis {', '.join(axes)} has switched itself off",
        code=code, text="servo off", remedy="check load, obstacles and cable, then clear_fault()", moved=moved,
    )  # fmt: skip
