"""Process data objects: which entries of a node's dictionary travel in which frame (CiA 301)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from microdrivers.backends.canopen.objects import Entry, unsigned
from microdrivers.backends.canopen.sdo import SdoClient

Mapping = Sequence[Entry[Any]]

SYNCHRONOUS = 1
EVENT_DRIVEN = 255

_NOT_VALID = 1 << 31
_NO_REMOTE_REQUEST = 1 << 30
_TRANSMIT = 0x400
"""Distance between the parameters of a receive PDO and those of the transmit PDO of the same number."""

_RECEIVE_IDS, _TRANSMIT_IDS = 0x200, 0x180
PDOS = 4


def rpdo_id(node_id: int, number: int = 1) -> int:
    """The predefined identifier of a PDO that a node receives, 1 to 4."""
    return _RECEIVE_IDS + 0x100 * (number - 1) + node_id


def tpdo_id(node_id: int, number: int = 1) -> int:
    """The predefined identifier of a PDO that a node transmits, 1 to 4."""
    return _TRANSMIT_IDS + 0x100 * (number - 1) + node_id


def configure_rpdo(
    sdo: SdoClient, number: int, cob_id: int, mapping: Mapping, *, transmission: int = EVENT_DRIVEN
) -> None:
    """Have a node take these entries from a frame; in PRE-OPERATIONAL only.

    Raises:
        SdoAbort: an entry cannot be mapped, or the node is in another state. LinkError: see `SdoClient`.
    """
    _configure(sdo, number - 1, cob_id, mapping, [(2, 8, transmission)])


def configure_tpdo(
    sdo: SdoClient, number: int, cob_id: int, mapping: Mapping, *, transmission: int = SYNCHRONOUS,
    inhibit_ms: float = 0.0, event_ms: int = 0,
) -> None:  # fmt: skip
    """Have a node send these entries in a frame: on every SYNC, or by event and timer; in PRE-OPERATIONAL only.

    Args:
        sdo: of the node.
        number: of the PDO, 1 to 4.
        cob_id: identifier of the frame.
        mapping: what it carries, at most 8 bytes.
        transmission: 1 to 240 is every n-th SYNC, 254 and 255 are by event.
        inhibit_ms: least time between two frames by event.
        event_ms: greatest time between two frames by event; 0 is none.

    Raises:
        SdoAbort: an entry cannot be mapped, or the node is in another state. LinkError: see `SdoClient`.
    """
    timing = [] if transmission <= 240 else [(3, 16, round(10 * inhibit_ms)), (5, 16, event_ms)]
    _configure(sdo, _TRANSMIT + number - 1, cob_id, mapping, [(2, 8, transmission), *timing])


def disable_tpdo(sdo: SdoClient, number: int) -> None:
    """Keep a node from sending this PDO, if it has it."""
    cob_id = unsigned(0x1400 + _TRANSMIT + number - 1, 1, 32, "COB-ID of the PDO")
    present = sdo.read_optional(cob_id)
    if present is not None and not present & _NOT_VALID:
        sdo.write(cob_id, present | _NOT_VALID)


def _configure(
    sdo: SdoClient, offset: int, cob_id: int, mapping: Mapping, parameters: Sequence[tuple[int, int, int]]
) -> None:
    """Switch off, empty, fill, set the number, switch on: the one order that all nodes take."""
    communication, entries = 0x1400 + offset, 0x1600 + offset
    identifier = unsigned(communication, 1, 32, "COB-ID of the PDO")
    count = unsigned(entries, 0, 8, "number of mapped entries")
    cob_id |= sdo.read(identifier) & _NO_REMOTE_REQUEST  # the node's own matter
    sdo.write(identifier, cob_id | _NOT_VALID)
    for sub, bits, value in parameters:
        sdo.write(unsigned(communication, sub, bits, "PDO parameter"), value)
    sdo.write(count, 0)
    for place, entry in enumerate(mapping, start=1):
        sdo.write(unsigned(entries, place, 32, f"mapping of {entry}"), entry.mapping)
    sdo.write(count, len(mapping))
    sdo.write(identifier, cob_id)
