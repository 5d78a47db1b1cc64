"""The objects 1000h to 1200h that every node has, but for errors, heartbeats and PDOs (CiA 301, 7.5.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from microdrivers.fakes.canopen.aborts import AbortCode, SdoAbort
from microdrivers.fakes.canopen.data_types import STRING, U8, U32, Value
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary, array

SYNC_ID, EMERGENCY_ID = 0x080, 0x080
STAY, STOP = 1, 2
"""1029h: what the node does when heartbeats are missing; 0, the default, is to leave OPERATIONAL."""

_SAVE, _LOAD = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
_ON_COMMAND = 1
_GENERATE, _EXTENDED = 1 << 30, 1 << 29
_HIGHEST_ID = 0x7FF


@dataclass(frozen=True)
class Identity:
    """Who a device says that it is: 1000h, 1018h, 1008h, 1009h and 100Ah."""

    device_type: int
    product_code: int
    serial_number: int
    name: str
    vendor_id: int = 0x0000_0F4E
    revision: int = 0x0001_0002
    hardware_version: str = "1.0"
    software_version: str = "1.02"


def communication_objects(
    dictionary: ObjectDictionary, identity: Identity, node_id: int, *, on_ids_changed: Callable[[], None]
) -> tuple[Entry, Entry, Entry]:
    """Add them; returns 1005h (COB-ID of the SYNC), 1014h (of emergencies) and 1029h.1 (when heartbeats are missing).

    `on_ids_changed` is called when the SYNC's COB-ID has been written.
    """

    def store(value: Value, _t_ns: int) -> None:
        _check_signature(value, _SAVE)
        dictionary.store()

    def restore(value: Value, _t_ns: int) -> None:
        _check_signature(value, _LOAD)
        dictionary.forget_stored()

    def sync_written(value: Value, _t_ns: int) -> None:
        if value & (_GENERATE | _EXTENDED) or not value & _HIGHEST_ID:
            raise SdoAbort(AbortCode.VALUE_RANGE)
        on_ids_changed()

    sync = Entry(0x1005, 0, U32, "rw", SYNC_ID, write=sync_written)
    emergency = Entry(0x1014, 0, U32, "rw", EMERGENCY_ID + node_id)
    on_loss = Entry(0x1029, 1, U8, "rw", allowed=(0, STAY, STOP))
    dictionary.add(
        [
            Entry(0x1000, 0, U32, "const", identity.device_type),
            sync,
            Entry(0x1006, 0, U32, "rw"),
            Entry(0x1008, 0, STRING, "const", identity.name),
            Entry(0x1009, 0, STRING, "const", identity.hardware_version),
            Entry(0x100A, 0, STRING, "const", identity.software_version),
            Entry(0x1010, 0, U8, "const", 1),
            Entry(0x1010, 1, U32, "rw", read=lambda _: _ON_COMMAND, write=store),
            Entry(0x1011, 0, U8, "const", 1),
            Entry(0x1011, 1, U32, "rw", read=lambda _: _ON_COMMAND, write=restore),
            emergency,
            *array(
                0x1018,
                U32,
                "const",
                [identity.vendor_id, identity.product_code, identity.revision, identity.serial_number],
            ),
            Entry(0x1029, 0, U8, "const", 1),
            on_loss,
            *array(0x1200, U32, "ro", [0x600 + node_id, 0x580 + node_id]),
            Entry(0x2000, 0, STRING, "rw", "", high=64),
        ]
    )
    return sync, emergency, on_loss


def _check_signature(value: int, signature: int) -> None:
    if value != signature:
        raise SdoAbort(AbortCode.CANNOT_STORE)
