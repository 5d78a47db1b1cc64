"""The drive's line: silences that it needs, and what to check if it is silent itself."""

from __future__ import annotations

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.modbus.master import ModbusMaster, framing_of
from microdrivers.backends.modbus.rtu import RtuTiming
from microdrivers.backends.oriental_az.settings import AzZoomSettings
from microdrivers.core.clock import Clock
from microdrivers.devices.wire_tap import WireTap

TIMING_9600 = RtuTiming(silent_s=0.004, gap_s=0.005)
"""HP-5142E, "Communication timing": C3.5 and Tb4 at 9600 baud."""

TIMING_19200_UP = RtuTiming(silent_s=0.0025, gap_s=0.003)
"""HP-5142E, "Communication timing": C3.5 and Tb4 at 19200 baud and more."""

_SILENCE_REMEDIES = {
    "rtu": "compare unit id, baud rate and parity with the drive's switches and parameters (factory: 8E1); check that "
    "SW1-2 is on (Modbus), the wires A and B, and the drive's power",
    "tcp": "compare unit id with the drive's switches; check that the gateway's serial side has the drive's baud rate "
    "and parity (factory: 8E1), the wires A and B, and the drive's power",
}


def az_timing(baudrate: int) -> RtuTiming:
    """The silences that belong to a baud rate; with less than `gap_s` the drive drops a request and counts an error."""
    return TIMING_19200_UP if baudrate >= 19200 else TIMING_9600


def az_link(settings: AzZoomSettings, *, clock: Clock, tap: WireTap | None = None) -> tuple[SerialLine, ModbusMaster]:
    """The line to a drive, closed, and the master that speaks on it."""
    connection = settings.connection
    framing = framing_of(connection, az_timing(connection.baudrate))
    line = SerialLine(connection, clock=clock, gap_s=framing.gap_s, tap=tap)
    remedy = _SILENCE_REMEDIES[connection.framing]
    return line, ModbusMaster(line, framing, unit_id=settings.unit_id, silence_remedy=remedy)
