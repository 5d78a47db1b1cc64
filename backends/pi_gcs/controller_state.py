"""What is known of the controller's state, and what has changed without being commanded."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from microdrivers.backends.pi_gcs.axis_map import AxisMap, by_axis
from microdrivers.backends.pi_gcs.protocol import Gcs
from microdrivers.backends.pi_gcs.replies import AxisStatus


class Findings(NamedTuple):
    """What `ControllerState.examine` found.

    Attributes:
        lost: axes whose reference the controller has forgotten.
        dropped: axes whose servo has switched itself off although their reference is still known.
        code: the controller's error number, now cleared there.
    """

    lost: tuple[str, ...]
    dropped: tuple[str, ...]
    code: int


class ControllerState:
    """Servo, reference and speed of each of a controller's axes as last read or commanded.

    Several threads may read the stage at once: the first to see a change reports it, the others no longer do.

    Attributes:
        servo_on: whether the servo of each axis is on.
        referenced: whether the controller knows the reference of each axis (FRF?).
        dropped: axes at fault: their servo has switched itself off and nobody has cleared the fault.
        referencing: the axis under reference, whose servo and reference change by themselves.
        changes: grows whenever servo or reference of an axis changes.
    """

    def __init__(self, gcs: Gcs, axis_maps: Mapping[str, AxisMap]) -> None:
        self.servo_on = dict.fromkeys(axis_maps, False)
        self.referenced = dict.fromkeys(axis_maps, False)
        self.dropped: frozenset[str] = frozenset()
        self.referencing: str | None = None
        self.changes = 0
        self._gcs = gcs
        self._axis_maps = axis_maps
        self._error_flag = False
        self._speed_text = dict.fromkeys(axis_maps, "")
        self._accepted_speed = dict.fromkeys(axis_maps, 0.0)
        self._known_interruptions = -1
        self._lock = threading.Lock()  # comparing and noting is one step; never held during an exchange

    @property
    def doubtful(self) -> bool:
        """Whether an exchange has failed since `examine`; the controller may have been switched off meanwhile."""
        return self._gcs.interruptions != self._known_interruptions

    def contradicts(self, status: Mapping[str, AxisStatus]) -> bool:
        """Whether the status registers call for `examine`: a servo off, a new error flag, or doubt."""
        error_flag = off = False
        with self._lock:
            for axis, axis_status in status.items():
                error_flag |= axis_status.error_flag
                off |= self.servo_on[axis] and not axis_status.servo_on and axis != self.referencing
            flag_is_new = error_flag and not self._error_flag
            self._error_flag = error_flag
        return off or flag_is_new or self.doubtful

    def examine(self) -> Findings:
        """Read servo, reference, speeds and error; tell what has changed without being commanded."""
        interruptions = self._gcs.interruptions
        servo_on = by_axis(self._axis_maps, self._gcs.flags("SVO?"), command="SVO?")
        referenced = by_axis(self._axis_maps, self._gcs.flags("FRF?"), command="FRF?")
        speeds = by_axis(self._axis_maps, self._gcs.numbers("VEL?"), command="VEL?")
        code = self._gcs.error()
        with self._lock:
            steady = [axis for axis in self._axis_maps if axis != self.referencing]
            lost = [axis for axis in steady if self.referenced[axis] and not referenced[axis]]
            off = [axis for axis in steady if self.servo_on[axis] and not servo_on[axis]]
            dropped = [axis for axis in off if axis not in lost]
            self.changes += (servo_on, referenced) != (self.servo_on, self.referenced)
            self.servo_on, self.referenced = servo_on, referenced
            self.dropped = self.dropped.union(dropped)
            for axis, axis_map in self._axis_maps.items():
                self._accepted_speed[axis] = axis_map.magnitude(speeds[axis])
                self._speed_text[axis] = axis_map.speed_text(self._accepted_speed[axis])
            self._known_interruptions = interruptions
        return Findings(tuple(lost), tuple(dropped), code)

    # ------------------------------------------------------------------ what the stage has commanded

    def begin_reference(self, axis: str) -> None:
        """The reference of an axis is being searched: it is not known."""
        with self._lock:
            self.referencing = axis
            self.referenced = self.referenced | {axis: False}

    def end_reference(self) -> None:
        """Nothing changes by itself any more."""
        with self._lock:
            self.referencing = None
            self.changes += 1

    def switched_on(self, axes: Iterable[str]) -> None:
        """The servos of these axes have been switched on."""
        with self._lock:
            self.servo_on = self.servo_on | dict.fromkeys(axes, True)
            self.changes += 1

    def faster(self, speeds: Mapping[str, float]) -> dict[str, float]:
        """Those speeds that are higher than any that the controller is known to accept."""
        return {axis: speed for axis, speed in speeds.items() if speed > self._accepted_speed[axis]}

    def changed(self, speed_texts: Mapping[str, str]) -> dict[str, str]:
        """Those speeds, as they are sent, that differ from the last ones."""
        return {axis: text for axis, text in speed_texts.items() if text != self._speed_text[axis]}

    def speeds_sent(self, axes: Iterable[str]) -> None:
        """New speeds are on their way; until the reply is here the controller's are not known."""
        self._speed_text |= dict.fromkeys(axes, "")

    def speeds_taken(self, speed_texts: Mapping[str, str], speeds: Mapping[str, float]) -> None:
        """The controller has accepted these speeds."""
        self._speed_text |= speed_texts
        for axis in speed_texts:
            self._accepted_speed[axis] = max(self._accepted_speed[axis], speeds[axis])
