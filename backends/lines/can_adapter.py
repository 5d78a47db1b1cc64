"""A CAN adapter as python-can opens it: errors with remedies, and what a time stamp is worth."""

from __future__ import annotations

import contextlib
import errno
import logging
from collections.abc import Iterable
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from microdrivers.backends.lines.can_listeners import CanCounters
from microdrivers.backends.lines.port_lock import PortLock
from microdrivers.backends.lines.ports import OPEN_REMEDIES
from microdrivers.backends.lines.settings import CanConnection
from microdrivers.core.clock import Clock, utc_now
from microdrivers.core.errors import ConfigError, LinkError, LinkLost, LinkTimeout, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.wire_tap import CanTap

if TYPE_CHECKING:
    import can

_SEND_WAIT_S = 0.05
_MOST_GARBAGE = 100
_ID_BITS = 0x7FF
_CLOCK_STAMP_NS = 1_000
_KERNEL_STAMP_NS = 50_000
"""An interrupt's latency and the reading of two clocks."""

_READINGS = 3

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
        tap: is told every frame.

    Attributes:
        failures: exceptions of python-can and the operating system.
        stamps_frames: whether frames are stamped as they pass, and not when they are handed over.

    Raises:
        LinkLost: there is no such adapter, or it is busy or forbidden.
        ConfigError: python-can does not know the interface or its options.
        UnsupportedError: python-can is missing, or the interface exists in real time only and the clock is simulated.
    """

    def __init__(
        self, connection: CanConnection, *, clock: Clock, counters: CanCounters, tap: CanTap | None = None
    ) -> None:
        self._can = _python_can()
        self.failures: tuple[type[Exception], ...] = (self._can.CanError, OSError)
        self._connection = connection
        self._clock = clock
        self._counters = counters
        self._tap = tap
        self._arrival_ns = round(connection.arrival_uncertainty_ms * NS_PER_MS)
        self._port_lock: PortLock | None = None
        self._bus = self._open()
        emulated = hasattr(self._bus, "deliver_to")
        if clock.simulated and not emulated:
            self.close()
            raise UnsupportedError(
                f"{_name(connection)} is a real bus and cannot run on a simulated clock",
                remedy="use --real-time, or an emulator (--fake)",
            )
        self._message = self._can.Message
        self._stamps_calendar_time = connection.interface == "socketcan"
        self._stamps_the_rigs_time = emulated
        self.stamps_frames = self._filters_itself = emulated or self._stamps_calendar_time
        self._stamped: can.Message | None = None
        self._newest = Stamp(-NS_PER_S, 0)

    def send(self, cob_id: int, data: bytes) -> None:
        """Hand a data frame over; waits only, and shortly, if there is no room for it."""
        if self._tap is not None and self._tap.heard:
            self._tap.frame(self._clock.now_ns(), "sent", cob_id, data)
        self._bus.send(self._message(arbitration_id=cob_id, data=data, is_extended_id=False), timeout=_SEND_WAIT_S)

    def receive(self, timeout_s: float) -> can.Message | None:
        """The oldest frame that has arrived; waits for one, or less if there is trouble on the bus."""
        while True:
            try:
                message = self._bus.recv(timeout_s)
            except (ValueError, IndexError) as error:
                self._discard_garbage(error)
            else:
                if self._tap is not None and self._tap.heard and message is not None:
                    self._tell(self._tap, message)
                if message is None or not message.is_error_frame:
                    return message
                self._note_error_frame(message.arbitration_id)
            timeout_s = 0.0

    def stamp(self, message: can.Message) -> Stamp:
        """When the frame had arrived: later than the one before. Ask in the order in which frames are received.

        An emulated bus stamps on the rig's clock. A kernel stamps in calendar time: the age of the stamp is taken from
        now, so that it matters neither where that time began nor whether it was set meanwhile. Other interfaces stamp
        in python-can, or in time of their own: there the arrival counts.
        """
        if message is not self._stamped:
            t_ns, dt_ns = self._measure(message)
            # The order of frames is certain, the difference of two clocks is not.
            backwards_ns = max(0, self._newest.t_ns + 1 - t_ns)
            self._stamped, self._newest = message, Stamp(t_ns + backwards_ns, dt_ns + backwards_ns)
        return self._newest

    def _measure(self, message: can.Message) -> Stamp:
        if self._stamps_the_rigs_time:
            return Stamp(round(message.timestamp * NS_PER_S), _CLOCK_STAMP_NS)
        if self._stamps_calendar_time:
            age_ns, now_ns, unsure_ns = self._age_of(message)
            if 0 <= age_ns <= NS_PER_S:
                return Stamp(now_ns - age_ns, max(_KERNEL_STAMP_NS, unsure_ns))
        return Stamp(self._clock.now_ns(), self._arrival_ns)

    def _age_of(self, message: can.Message) -> tuple[int, int, int]:
        """How old a stamp in calendar time is, at which time of the rig's clock, and how far apart both were read."""
        for _ in range(_READINGS):
            before_ns = self._clock.now_ns()
            age_ns = round((utc_now().timestamp() - message.timestamp) * NS_PER_S)
            now_ns = self._clock.now_ns()
            if now_ns - before_ns <= _KERNEL_STAMP_NS:  # else something came in between
                break
        return age_ns, now_ns, now_ns - before_ns

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
        if self._port_lock is not None:
            self._port_lock.close()

    def explain(self, error: Exception) -> LinkError:
        """What a failure means: `LinkTimeout` if the adapter may recover by itself, else `LinkLost`."""
        number = _number_of(error)
        if number in _QUEUE_FULL or "buffer full" in str(error) or isinstance(error, self._can.CanTimeoutError):
            return LinkTimeout(
                f"{_name(self._connection)} takes no more frames: nobody acknowledges those that wait",
                remedy="check that the devices are switched on, the cable, bit rate and termination",
            )
        return LinkLost(f"{_name(self._connection)} failed: {error}", remedy=self._remedy(number, _LOST_REMEDY))

    def _tell(self, tap: CanTap, message: can.Message) -> None:
        t_ns, data = self.stamp(message).t_ns, bytes(message.data)
        if message.is_error_frame:
            tap.error_frame(t_ns, message.arbitration_id, data)
            return
        remote = message.is_remote_frame
        tap.frame(
            t_ns, "received", message.arbitration_id, bytes(message.dlc) if remote else data,
            extended=message.is_extended_id, remote=remote,
        )  # fmt: skip

    def _note_error_frame(self, error_class: int) -> None:
        self._counters.error_frames += 1
        if self._counters.error_frames == 1:
            _log.warning("%s: an error frame; look at bit rate, cable and termination", _name(self._connection))
        if error_class & _BUS_OFF:
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
            lock = PortLock(wanted.channel)  # first: opening an adapter resets it under whoever uses it
            try:
                bus: can.BusABC = self._can.Bus(
                    interface=wanted.interface, channel=wanted.channel, bitrate=wanted.bitrate, ignore_config=True,
                    **wanted.options,
                )  # fmt: skip
            except BaseException:
                lock.close()
                raise
            self._port_lock = lock
            return self._read_in_bulk(bus)
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

    def _read_in_bulk(self, bus: can.BusABC) -> can.BusABC:
        if self._connection.interface != "slcan":
            return bus
        from microdrivers.backends.lines.slcan_in_bulk import in_bulk  # which imports python-can

        return in_bulk(bus, self._counters)

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
