"""The RS-485 port of an AZ drive: what it answers to, and when (Oriental Motor HP-5142E, "Modbus RTU control")."""

from __future__ import annotations

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.modbus import RtuSlave, SlaveTiming
from microdrivers.fakes.oriental_az.drive import AzDrive

_WAITING_MS = 3.0
"""Transmission waiting time, at the factory's setting."""


def _timing(silence_ms: float, pause_ms: float) -> SlaveTiming:
    """C3.5, and Tb4: what a host waits after a reply."""
    return SlaveTiming(
        silence_ns=round(silence_ms * NS_PER_MS),
        pause_after_reply_ns=round(pause_ms * NS_PER_MS),
        pause_after_broadcast_ns=5 * NS_PER_MS,
        waiting_ns=round(_WAITING_MS * NS_PER_MS),
        processing_ms=(0.3, 0.8),
        scatter_ms=0.3,
    )


_SLOW, _FAST = _timing(4.0, 5.0), _timing(2.5, 3.0)


def az_port(drive: AzDrive, *, unit_id: int, baudrate: int, bits_per_byte: int, seed: int) -> RtuSlave:
    """A drive's port, at one of its baud rates."""
    return RtuSlave(
        drive,
        unit_id=unit_id,
        timing=_SLOW if baudrate < 19200 else _FAST,
        baudrate=baudrate,
        bits_per_byte=bits_per_byte,
        seed=seed,
    )
