"""A CAN adapter as python-can opens it: errors with remedies, and what a time stamp is worth."""

from __future__ import annotations

import contextlib
import errno
import logging
from collections.abc import Callable, Iterable
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from microdrivers.backends.lines.can_listeners import CanCounters
from microdrivers.backends.lines.ports import OPEN_REMEDIES
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.clock import Clock, utc_now
from microdrivers.core.errors import ConfigError, LinkError, LinkLost, LinkTimeout, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S

if TYPE_CHECKING:
    import can

_SEND_WAIT_S = 0.05
_MOST_GARBAGE = 100
_ID_BITS = 0x7FF
_CLOCK_STAMP_NS = 1_000
_KERNEL_STAMP_NS = 50_000
"""An interrupt's latency and the reading of two clocks."""

_BUS_OFF = 0x40
"""Class of a SocketCAN error frame (linux/can/error.h)."""

_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)

_REMEDIES = OPEN_REMEDIES | {  # an adapter may be a serial port
    errno.ENODEV: "there is no such interface: check its name (ip -brief link); without hardware use --fake",
    errno.EPERM: "you may not open it: ask for the right to use CAN interfaces",
    errno.EAFNOSUPPORT: "this computer's kernel knows no CAN: load its modules (modprobe can can_raw), or use slcan",
}
_LOST_REMEDY = "check the adapter's cable and the bus, then close and open the rig again"

_log = logging.getLogger(__name__)


class Stamp(NamedTuple):
    """When a frame had arrived on the bus, ns on the rig's clock, and the half-width of the 95 % interval of that."""

    t_ns: int
    dt_ns: int


class CanAdapter:
    """An open adapter. `send` and `receive` raise one of `failures` once it is gone; `explain` says what that means.

    Args:
        connection: the bus.
        clock: the rig's.
        counters: to be kept.

    Attributes:
        failures: exceptions of python-can and the operating system.
        stamps_frames: whether frames are stamped as they pass, and not when they are handed over.

    Raises:
        LinkLost: there is no such adapter, or it is busy or forbidden.
        ConfigError: python-can does not know the interface or its options.
        UnsupportedError: python-can is missing, or the interface exists in real time only and the clock is simulated.
    """

    def __init__(self, connection: CanConnection, *, clock: Clock, counters: CanCounters) -> None:
        self._can = _python_can()
        self.failures: tuple[type[Exception], ...] = (self._can.CanError, OSError)
        self._connection = connection
        self._clock = clock
        self._counters = counters
        self._arrival_ns = round(connection.arrival_uncertainty_ms * NS_PER_MS)
        self._bus = self._open()
        self._notifies: Callable[[Callable[[], None] | None], None] | None = getattr(self._bus, "on_arrival", None)
        if clock.simulated and self._notifies is None:
            self.close()
            raise UnsupportedError(
                f"{_name(connection)} is a real bus and cannot run on a simulated clock",
                remedy="use --real-time, or an emulator (--fake)",
            )
        self._message = self._can.Message
        self._stamps_calendar_time = connection.interface == "socketcan"
        self.stamps_frames = self._filters_itself = self._notifies is not None or self._stamps_calendar_time

    def send(self, cob_id: int, data: bytes) -> None:
        """Hand a data frame over; waits only, and shortly, if there is no room for it."""
        self._bus.send(self._message(arbitration_id=cob_id, data=data, is_extended_id=False), timeout=_SEND_WAIT_S)

    def receive(self, timeout_s: float) -> can.Message | None:
        """The oldest frame that has arrived; waits for one, or less if there is trouble on the bus."""
        while True:
            try:
                message = self._bus.recv(timeout_s)
            except (ValueError, IndexError) as error:
                self._discard_garbage(error)
            else:
                if message is None or not message.is_error_frame:
                    return message
                self._note_error_frame(message)
            timeout_s = 0.0

    def notify(self, call: Callable[[], None] | None) -> None:
        """Have the clock call whenever a frame has arrived; only on a simulated clock."""
        if self._notifies is not None:
            self._notifies(call)

    def stamp(self, message: can.Message) -> Stamp:
        """When the frame had arrived.

        An emulated bus stamps on the rig's clock. A kernel stamps in calendar time: the age of the stamp is taken from
        now, so that it matters neither where that time began nor whether it was set meanwhile. Other interfaces stamp
        in python-can, or in time of their own: there the arrival counts.
        """
        now_ns = self._clock.now_ns()
        if self._notifies is not None:
            return Stamp(round(message.timestamp * NS_PER_S), _CLOCK_STAMP_NS)
        if self._stamps_calendar_time:
            age_ns = round((utc_now().timestamp() - message.timestamp) * NS_PER_S)
            if 0 <= age_ns <= NS_PER_S:
                return Stamp(now_ns - age_ns, _KERNEL_STAMP_NS)
        return Stamp(now_ns, self._arrival_ns)

    def accept(self, cob_ids: Iterable[int]) -> None:
        """Let through only these identifiers where the interface itself can filter; elsewhere that saves nothing."""
        if self._filters_itself:
            self._bus.set_filters(
                [{"can_id": cob_id, "can_mask": _ID_BITS, "extended": False} for cob_id in cob_ids] or None
            )

    def close(self) -> None:
        """Give the adapter up."""
        with contextlib.suppress(*self.failures):  # it may have been unplugged
            self._bus.shutdown()

    def explain(self, error: Exception) -> LinkError:
        """What a failure means: `LinkTimeout` if the adapter may recover by itself, else `LinkLost`."""
        number = _number_of(error)
        if number in _QUEUE_FULL or "buffer full" in str(error) or isinstance(error, self._can.CanTimeoutError):
            return LinkTimeout(
                f"{_name(self._connection)} takes no more frames: nobody acknowledges those that wait",
                remedy="check that the devices are switched on, the cable, bit rate and termination",
            )
        return LinkLost(f"{_name(self._connection)} failed: {error}", remedy=self._remedy(number, _LOST_REMEDY))

    def _note_error_frame(self, message: can.Message) -> None:
        self._counters.error_frames += 1
        if self._counters.error_frames == 1:
            _log.warning("%s: an error frame; look at bit rate, cable and termination", _name(self._connection))
        if message.arbitration_id & _BUS_OFF:
            raise OSError(errno.ENETDOWN, "the controller is bus-off")

    def _discard_garbage(self, error: Exception) -> None:
        """An adapter on a serial port has sent what is no frame; python-can would stumble over it for ever."""
        self._counters.garbled += 1
        flush = getattr(self._bus, "flush", None)
        if flush is not None:
            flush()
        if self._counters.garbled >= _MOST_GARBAGE:
            raise OSError(errno.EPROTO, f"the adapter sends garbage ({error})")

    def _open(self) -> can.BusABC:
        wanted = self._connection
        try:
            bus: can.BusABC = self._can.Bus(
                interface=wanted.interface, channel=wanted.channel, bitrate=wanted.bitrate, ignore_config=True,
                **wanted.options,
            )  # fmt: skip
            return bus
        except NotImplementedError as error:
            raise ConfigError(
                f"python-can cannot use the interface {wanted.interface!r}: {error}", key="connection.interface",
                remedy="name one of python-can's interfaces (socketcan, slcan, …) and install its driver",
            ) from error  # fmt: skip
        except self.failures as error:
            remedy = self._remedy(_number_of(error), "check the adapter's cable, its name and the bit rate")
            raise LinkLost(f"{_name(wanted)} cannot be opened: {error}", remedy=remedy, moved="no") from error
        except (ValueError, TypeError) as error:
            raise ConfigError(
                f"python-can refuses these settings of {_name(wanted)}: {error}", key="connection",
                remedy="correct channel, bitrate and options",
            ) from error  # fmt: skip

    def _remedy(self, number: int | None, otherwise: str) -> str:
        channel, bitrate = self._connection.channel, self._connection.bitrate
        if number == errno.ENETDOWN and self._connection.interface == "socketcan":
            return f"the interface is down: sudo ip link set {channel} up type can bitrate {bitrate}"
        if number == errno.ENETDOWN:
            return "check bit rate, termination and cable, then close and open the rig again"
        return _REMEDIES.get(number or 0, otherwise)


def _python_can() -> ModuleType:
    try:
        import can
    except ModuleNotFoundError as error:
        raise UnsupportedError(
            "CAN devices need python-can, which is not installed", remedy="install it: pip install python-can"
        ) from error
    return can


def _name(connection: CanConnection) -> str:
    return f"CAN bus {connection.channel} ({connection.interface})"


def _number_of(error: BaseException | None) -> int | None:
    """The operating system's error number, wherever in the chain of causes it stands."""
    while error is not None:
        number = getattr(error, "error_code", None) or getattr(error, "errno", None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return None
