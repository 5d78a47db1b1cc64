"""A CiA 404 measuring amplifier: is it what the rig file means, in what does it count, and how is it made to send?

Sources: CiA 404-1 (objects 6130h to 6150h), CiA 303-2 (units). Zero and scaling of the amplifier are never changed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.backends.canopen.heartbeat import NmtCommand
from microdrivers.backends.canopen.node import CanopenNode, Identity
from microdrivers.backends.canopen.objects import DEVICE_TYPE, Entry, object_name, real32, signed, unsigned
from microdrivers.backends.canopen.pdo import (
    EVENT_DRIVEN,
    PDOS,
    SYNCHRONOUS,
    configure_tpdo,
    disable_tpdo,
    tpdo_id,
)
from microdrivers.backends.cia404.measurement_frame import (
    PROCESS_VALUES,
    STATUS,
    STATUS_FLAGS,
    MeasurementFrame,
    ProcessValue,
)
from microdrivers.backends.cia404.physical_unit import KNOWN_UNITS, uN_per_unit
from microdrivers.backends.cia404.settings import Cia404ForceSettings
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.devices.base import DeviceInfo

_PROFILE = 404
_ANALOGUE_INPUTS = 1 << 17
_ANOTHER = "check connection and node_id in the rig file, and the node id switches"
_UNIT, _DIGITS = 0x6131, 0x6132
_COARSER_THAN_STATED = 2.0

_TRANSMISSION = unsigned(0x1800, 2, 8, "transmission type of TPDO 1")
_EVENT_TIMER = unsigned(0x1800, 5, 16, "event timer of TPDO 1")
_MAPPED = unsigned(0x1A00, 0, 8, "number of mapped entries")

_log = logging.getLogger(__name__)


class Amplifier:
    """One channel of an amplifier.

    Attributes:
        frame: what its TPDO 1 carries; known after `identify`.
    """

    frame: MeasurementFrame

    def __init__(self, node: CanopenNode, settings: Cia404ForceSettings, *, name: str) -> None:
        self._node = node
        self._sdo = node.sdo
        self._settings = settings
        self._channel = settings.channel
        self._name = name

    # ------------------------------------------------------------------ who it is

    def identify(self) -> DeviceInfo:
        """Find out unit and format, and compare them with the rig file.

        Raises:
            UnsupportedError: it is no measuring amplifier. ConfigError: its unit or range do not fit the rig file.
            SdoAbort: it lacks what every such amplifier has. LinkError: no sound answer.
        """
        self._node.require_alone(key=f"{self._name}.node_id")
        identity = self._node.identify()
        self._check_profile(identity)
        value = self._process_value()
        uN_per_count = self._uN_per_unit()
        if value.has_digits:
            uN_per_count /= 10 ** (self._sdo.read_optional(self._entry(_DIGITS, 8, "decimal digits")) or 0)
        self._check_range(value, uN_per_count)
        has_status = self._sdo.read_optional(self._status) is not None
        if not has_status:
            _log.info("%s: the amplifier has no status (6150h): only the range tells what is not valid", self._name)
        self.frame = MeasurementFrame(value, channel=self._channel, has_status=has_status, uN_per_count=uN_per_count)
        return DeviceInfo(
            driver="cia404-force",
            vendor=f"CiA vendor {identity.vendor:X}h",
            model=identity.name or f"product {identity.product:X}h",
            serial_number=str(identity.serial_number or ""),
            firmware=identity.software or f"{identity.revision >> 16}.{identity.revision & 0xFFFF}",
        )

    def read(self) -> tuple[float, frozenset[str]]:
        """The present raw force, µN, and flags: one or two SDO transfers.

        Raises:
            SdoAbort, LinkError: as they come.
        """
        count = self._sdo.read(self._value_entry(self.frame.value))
        flags = STATUS_FLAGS[self._sdo.read(self._status)] if self.frame.has_status else STATUS_FLAGS[0]
        return count * self.frame.uN_per_count, flags

    # ------------------------------------------------------------------ how it sends

    def prepare(self) -> None:
        """Bring the node to PRE-OPERATIONAL, where it sends no PDO, and map value and status into TPDO 1.

        Raises:
            SdoAbort: the node cannot map them. LinkError: no sound answer.
        """
        self._node.command(NmtCommand.PRE_OPERATIONAL)
        for number in range(2, PDOS + 1):
            disable_tpdo(self._sdo, number)
        transmission = SYNCHRONOUS if self._settings.sync else EVENT_DRIVEN
        if self._is_mapped():  # some amplifiers let nobody write there
            self._sdo.write(_TRANSMISSION, transmission)
            return
        entries: Sequence[Entry[int]] = [
            unsigned(word >> 16, word >> 8 & 0xFF, word & 0xFF) for word in self.frame.mapping
        ]
        configure_tpdo(self._sdo, 1, tpdo_id(self._node.id), entries, transmission=transmission)

    def start(self, event_ms: int) -> None:
        """Have TPDO 1 sent, every `event_ms` unless SYNC asks for it."""
        if not self._settings.sync:
            self._sdo.write(_EVENT_TIMER, event_ms)
        self._node.command(NmtCommand.START)

    def end(self) -> None:
        """Have no more PDOs sent. The question behind it makes sure that the node has heard.

        Raises:
            LinkError: it may not have.
        """
        self._node.command(NmtCommand.PRE_OPERATIONAL)
        self._sdo.read(DEVICE_TYPE)

    # ------------------------------------------------------------------ inside

    @property
    def _status(self) -> Entry[int]:
        return self._entry(STATUS, 8, "status")

    def _entry(self, index: int, bits: int, name: str) -> Entry[int]:
        return unsigned(index, self._channel, bits, name)

    def _value_entry(self, value: ProcessValue) -> Entry[Any]:
        if value.code == "f":
            return real32(value.object_index, self._channel, "process value")
        return signed(value.object_index, self._channel, value.bits, "process value")

    def _check_profile(self, identity: Identity) -> None:
        device_type = identity.device_type
        if identity.profile != _PROFILE or not device_type & _ANALOGUE_INPUTS:
            what = "it has no analogue inputs" if identity.profile == _PROFILE else f"its profile is {identity.profile}"
            raise UnsupportedError(
                f"{self._node.name} is no measuring amplifier: {what} (1000h is {device_type:08X}h)", remedy=_ANOTHER
            )

    def _process_value(self) -> ProcessValue:
        for value in PROCESS_VALUES:
            if self._sdo.read_optional(self._value_entry(value)) is not None:
                return value
        tried = ", ".join(object_name(value.object_index, self._channel) for value in PROCESS_VALUES)
        raise UnsupportedError(
            f"{self._node.name} has no process value of channel {self._channel}: neither {tried}",
            remedy="check channel in the rig file",
        )

    def _uN_per_unit(self) -> float:
        code = self._sdo.read(self._entry(_UNIT, 32, "physical unit"))
        factor = uN_per_unit(code)
        if factor is None:
            raise ConfigError(
                f"the amplifier does not count in a unit of force: {object_name(_UNIT, self._channel)} is {code:08X}h",
                key=f"{self._name}.channel",
                remedy=f"set it to one of {KNOWN_UNITS} with the maker's program, and scale it accordingly",
            )
        return factor

    def _check_range(self, value: ProcessValue, uN_per_count: float) -> None:
        settings = self._settings
        remedy = "compare unit (6131h) and digits (6132h) of the amplifier with the rig file"
        if value.has_digits and uN_per_count > _COARSER_THAN_STATED * settings.resolution_uN:
            raise ConfigError(
                f"the amplifier counts in steps of {uN_per_count:g} µN, not {settings.resolution_uN:g} µN",
                key=f"{self._name}.resolution_uN",
                remedy=remedy,
            )
        most_uN = uN_per_count * (1 << value.bits - 1)
        if value.has_digits and max(-settings.range_uN.min, settings.range_uN.max) > most_uN:
            raise ConfigError(
                f"the amplifier's {value.bits} bits show ±{most_uN:g} µN, which does not cover {settings.range_uN} µN",
                key=f"{self._name}.range_uN",
                remedy=remedy,
            )

    def _is_mapped(self) -> bool:
        words = self.frame.mapping
        if self._sdo.read_optional(_MAPPED) != len(words):
            return False
        present = (self._sdo.read(unsigned(0x1A00, sub, 32, "mapping")) for sub in range(1, len(words) + 1))
        identifier = self._sdo.read(unsigned(0x1800, 1, 32, "COB-ID of TPDO 1"))
        return tuple(present) == words and identifier & ~(1 << 30) == tpdo_id(self._node.id)


def sends_heartbeat(node: CanopenNode, *, interval_ms: int, timeout_s: float) -> bool:
    """Have a node send its heartbeat, and watch it; tells whether it can."""
    try:
        node.produce_heartbeat(interval_ms, timeout_s=timeout_s)
    except SdoAbort as abort:
        _log.info("%s sends no heartbeat: %s", node.name, abort.what)
        return False
    return True
