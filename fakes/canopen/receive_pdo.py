"""Receive PDOs: taken when they arrive, or with the next SYNC (CiA 301, 7.2.2.5)."""

from __future__ import annotations

from collections.abc import Callable

from microdrivers.fakes.canopen.aborts import SdoAbort
from microdrivers.fakes.canopen.data_types import U8
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary
from microdrivers.fakes.canopen.pdo_record import EVENT_DRIVEN, PdoDefaults, PdoRecord


class ReceivePdo(PdoRecord):
    """One receive PDO; `number` is from 1 on. It has no deadline."""

    def __init__(
        self,
        number: int,
        defaults: PdoDefaults,
        *,
        default_id: int,
        dictionary: ObjectDictionary,
        locked: Callable[[], bool],
        changed: Callable[[int], None],
    ) -> None:
        communication = 0x1400 + number - 1
        super().__init__(
            communication,
            0x1600 + number - 1,
            "rpdo",
            defaults,
            default_id=default_id,
            dictionary=dictionary,
            locked=locked,
            changed=changed,
        )
        dictionary.add([Entry(communication, 0, U8, "const", 2)])
        self._received: bytes | None = None

    def forget(self) -> None:
        """The node is not OPERATIONAL any more: what waits for a SYNC is void."""
        self._received = None

    def take(self, data: bytes, t_ns: int) -> bool:
        """One has arrived; False if it is too short to be used. More bytes than are mapped do not matter."""
        if len(data) < self.length:
            return False
        if self.transmission.value in EVENT_DRIVEN:
            self._apply(data, t_ns)
        else:
            self._received = data
        return True

    @property
    def waits_for_sync(self) -> bool:
        """Whether something has arrived that is used with the next SYNC."""
        return self._received is not None

    def at_sync(self, t_ns: int) -> None:
        """Use what has arrived since the last SYNC."""
        if self._received is not None:
            data, self._received = self._received, None
            self._apply(data, t_ns)

    def _apply(self, data: bytes, t_ns: int) -> None:
        for entry, value in zip(self.mapped, self.unpack(data), strict=True):
            if entry is None:
                continue
            try:
                entry.put(value, t_ns)
            except SdoAbort:
                continue  # a PDO cannot be answered: a value out of range changes nothing
