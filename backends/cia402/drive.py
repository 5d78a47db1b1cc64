"""One axis' drive: what it is told and asked. Nothing here waits for motion."""

from __future__ import annotations

import struct
from collections.abc import Callable

from microdrivers.backends.canopen.emergency import Emergency
from microdrivers.backends.canopen.node import CanopenNode
from microdrivers.backends.canopen.pdo import rpdo_id, tpdo_id
from microdrivers.backends.cia402 import objects
from microdrivers.backends.cia402.axis_map import AxisMap
from microdrivers.backends.cia402.axis_watch import AxisWatch, Reading
from microdrivers.backends.cia402.settings import FineAxis
from microdrivers.backends.cia402.states import Control
from microdrivers.backends.lines.can_line import CanLine
from microdrivers.core.errors import ProtocolError

STATUS_MAPPING = (objects.STATUS_WORD, objects.POSITION, objects.MODE_DISPLAY)
CONTROL_MAPPING = (objects.CONTROL_WORD,)

_STATUS = struct.Struct("<Hib")
STATUS_BYTES = _STATUS.size

_SMALL_COUNTS = 8
_SMALL_RATE = 100
"""A way of a few counts is never slower than this, in counts/s: it might outlast the move, and bends no path."""


class Drive:
    """A drive, and what is known of it.

    Args:
        line: the bus.
        axis: x, y or z.
        settings: of the axis.
        owner: the device in the rig file.
        timeout_s: of an SDO reply.
        on_heartbeat, on_silence, on_emergency: see `CanopenNode`; called with this drive first.

    Attributes:
        ready: it is set up, and its PDOs are on their way.
        watches_us: it was told to take the end of our heartbeat for a fault; so it may have been if set-up did not end.
        boots: how often it was seen to start.
        referenced: whether it knows its reference.
        fault: the emergency that it reported and nobody has cleared.
    """

    def __init__(
        self, line: CanLine, axis: str, settings: FineAxis, *, owner: str, timeout_s: float,
        on_heartbeat: Callable[[Drive, int], object], on_silence: Callable[[Drive], object],
        on_emergency: Callable[[Drive, Emergency], object],
    ) -> None:  # fmt: skip
        self.axis = axis
        self.name = f"axis {axis} (node {settings.node_id})"
        self.settings = settings
        self.map = AxisMap.from_settings(settings)
        self.watch = AxisWatch(tolerance=self.map.tolerance)
        self.ready = self.watches_us = False
        self.boots = 0
        self.referenced = False
        self.reading: Reading | None = None
        self.node = CanopenNode(
            line, settings.node_id, owner=owner, name=self.name, timeout_s=timeout_s,
            on_heartbeat=lambda state: on_heartbeat(self, state), on_silence=lambda: on_silence(self),
            on_emergency=lambda emergency: on_emergency(self, emergency),
        )  # fmt: skip
        self._line = line
        self._control_id = rpdo_id(settings.node_id)
        self._written: dict[int, int] = {}

    @property
    def status_id(self) -> int:
        """Identifier of the PDO with its status."""
        return tpdo_id(self.node.id)

    @property
    def control_id(self) -> int:
        """Identifier of the PDO with its control word."""
        return self._control_id

    def forget(self) -> None:
        """The drive has restarted, or may have: nothing that it was told holds any more."""
        self.ready = self.watches_us = False
        self._written.clear()
        self.watch.switched_off()

    # ------------------------------------------------------------------ telling

    def control(self, word: int) -> None:
        """Send a control word; no answer."""
        self._line.send(self._control_id, word.to_bytes(2, "little"))

    def quick_stop(self) -> None:
        """Have it brake now; no answer. A drive whose PDOs are not set up is told by SDO, past any exchange."""
        if self.ready:
            self.control(Control.QUICK_STOP)
        else:
            self.node.sdo.request_write(objects.CONTROL_WORD, Control.QUICK_STOP)

    def set_mode(self, mode: int) -> None:
        """Choose the mode of operation; the drive shows it in its next readings."""
        self.node.sdo.write(objects.MODE, mode)

    def write_profile(self, *, target: int, velocity: int, acceleration: int) -> None:
        """Write where to go and how, in counts; the set-point bit then starts it."""
        sdo, written = self.node.sdo, self._written
        for entry, value in (
            (objects.PROFILE_VELOCITY, velocity),
            (objects.PROFILE_ACCELERATION, acceleration),
            (objects.PROFILE_DECELERATION, acceleration),
            (objects.TARGET_POSITION, target),
        ):
            if written.get(entry.index) != value:
                written.pop(entry.index, None)
                sdo.write(entry, value)
                written[entry.index] = value

    def rates(self, *, target: int, speed_um_s: float, acceleration_um_s2: float) -> tuple[int, int]:
        """Velocity and acceleration for a move, in counts."""
        velocity, acceleration = self.map.rate(speed_um_s), self.map.rate(acceleration_um_s2)
        if self.reading is not None and abs(target - self.reading.position) <= _SMALL_COUNTS:
            return max(velocity, _SMALL_RATE), self.map.rate(self.map.spec.acceleration)
        return velocity, acceleration

    # ------------------------------------------------------------------ hearing

    def decode(self, data: bytes) -> Reading:
        """What its PDO says.

        Raises:
            ProtocolError: it has another length than was agreed.
        """
        if len(data) != _STATUS.size:
            raise ProtocolError(
                f"{self.name}: its status PDO has {len(data)} bytes, not {_STATUS.size}", received=data,
                remedy="another program has changed the drive's PDOs: close and open the rig again",
            )  # fmt: skip
        return Reading(*_STATUS.unpack(data))
