"""What the dictionary says of one PDO, and the rules by which that may be changed (CiA 301, 7.2.2 and 7.5.2.35 ff.)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from microdrivers.fakes.canopen.aborts import AbortCode, SdoAbort
from microdrivers.fakes.canopen.data_types import DUMMIES, U8, U32, DataType, Value
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary

NO_PDO = 1 << 31
MAX_MAPPED = 8
SYNCHRONOUS = range(241)
EVENT_DRIVEN = (254, 255)
TRANSMISSION_TYPES = (*SYNCHRONOUS, *EVENT_DRIVEN)

_EXTENDED = 1 << 29
_ID = 0x7FF
_MAX_BITS = 64
_RESTRICTED = (
    range(0x080), range(0x101, 0x181), range(0x581, 0x600), range(0x601, 0x680), range(0x6E0, 0x700),
    range(0x701, 0x780), range(0x780, 0x800),
)  # fmt: skip


@dataclass(frozen=True)
class PdoDefaults:
    """How a PDO is set up at the maker's: transmission type, times, and (index, sub) of what it carries."""

    mapped: Sequence[tuple[int, int]]
    valid: bool = True
    transmission: int = 255
    inhibit_100us: int = 0
    event_timer_ms: int = 0


class PdoRecord:
    """The mapping and the COB-ID of one PDO, for transmit and receive PDOs.

    Everything but type and event timer may be changed in PRE-OPERATIONAL only, and while the PDO is not valid: first
    bit 31 of the COB-ID, then 0 to sub-index 0 of the mapping, the objects, their number, and the COB-ID again.

    Args:
        communication, mapping: indices of its two records.
        direction: which of the entries' rights to be mapped it needs.
        locked: tells whether the node is OPERATIONAL.
        changed: is called after every change that concerns a valid PDO, with `t_ns`.

    Attributes:
        valid: whether it exists.
        mapped: what it carries; None stands for bytes that nobody uses.
        length: bytes.
    """

    def __init__(
        self,
        communication: int,
        mapping: int,
        direction: str,
        defaults: PdoDefaults,
        *,
        default_id: int,
        dictionary: ObjectDictionary,
        locked: Callable[[], bool],
        changed: Callable[[int], None],
    ) -> None:
        self.direction = direction
        self._dictionary = dictionary
        self._locked = locked
        self._changed = changed
        self.cob = Entry(
            communication, 1, U32, "rw", default_id | (0 if defaults.valid else NO_PDO), write=self._cob_written
        )
        self.transmission = Entry(
            communication,
            2,
            U8,
            "rw",
            defaults.transmission,
            allowed=TRANSMISSION_TYPES,
            write=lambda _value, t_ns: self.timing_changed(t_ns),
        )
        words = [_word(dictionary.find(index, sub)) for index, sub in defaults.mapped]
        self._count = Entry(mapping, 0, U8, "rw", len(words), high=MAX_MAPPED, write=self._count_written)
        self._words = [
            Entry(mapping, sub, U32, "rw", word, write=self._word_written)
            for sub, word in enumerate([*words, *[0] * (MAX_MAPPED - len(words))], 1)
        ]
        dictionary.add([self.cob, self.transmission, self._count, *self._words])
        self.reload()

    def reload(self) -> None:
        """Take what is in the dictionary."""
        self._use(self.cob.value, self._count.value)

    def timing_changed(self, t_ns: int) -> None:
        """The transmission type has been written."""
        self._changed(t_ns)

    def check_unlocked(self) -> None:
        """Whether what is fixed while the PDO exists may be written.

        Raises:
            SdoAbort: it may not.
        """
        if self.valid or self._locked():
            raise SdoAbort(AbortCode.PRESENT_STATE)

    # ------------------------------------------------------------------ writing

    def _cob_written(self, value: Value, t_ns: int) -> None:
        if self._locked() or (self.valid and not value & NO_PDO and value & _ID != self.cob_id):
            raise SdoAbort(AbortCode.PRESENT_STATE)
        if value & _EXTENDED or (not value & NO_PDO and any(value & _ID in ids for ids in _RESTRICTED)):
            raise SdoAbort(AbortCode.VALUE_RANGE)
        self._use(value, self._count.value)
        self._changed(t_ns)

    def _count_written(self, value: Value, _t_ns: int) -> None:
        self.check_unlocked()
        self._use(self.cob.value, value)

    def _word_written(self, value: Value, _t_ns: int) -> None:
        self.check_unlocked()
        if self.mapped:
            raise SdoAbort(AbortCode.PRESENT_STATE)
        if value:
            self._object(value)

    def _use(self, cob: int, count: int) -> None:
        kinds: list[DataType] = []
        mapped: list[Entry | None] = []
        for word in self._words[:count]:
            entry, kind = self._object(word.value)
            mapped.append(entry)
            kinds.append(kind)
        if 8 * sum(kind.size for kind in kinds) > _MAX_BITS:
            raise SdoAbort(AbortCode.PDO_TOO_LONG)
        self.mapped = tuple(mapped)
        self.length = sum(kind.size for kind in kinds)
        self.pack, self.unpack = codec(kinds)
        self.cob_id = cob & _ID
        self.valid = not cob & NO_PDO

    def _object(self, word: int) -> tuple[Entry | None, DataType]:
        index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
        dummy = DUMMIES.get(index) if self.direction == "rpdo" and not sub else None
        entry = None if dummy else self._dictionary.find(index, sub)
        kind = dummy or (entry.type if entry else U8)
        if entry is not None and entry.mapping not in (self.direction, "both"):
            raise SdoAbort(AbortCode.NOT_MAPPABLE)
        if bits != 8 * kind.size:
            raise SdoAbort(AbortCode.NOT_MAPPABLE)
        return entry, kind


def _word(entry: Entry) -> int:
    return entry.index << 16 | entry.sub << 8 | 8 * entry.type.size


def codec(kinds: Sequence[DataType]) -> tuple[Callable[..., bytes], Callable[[bytes], Sequence[Value]]]:
    """What turns values of these types into the bytes of a PDO, and the first bytes of one into values."""
    codes = [kind.struct_code for kind in kinds]
    size = sum(kind.size for kind in kinds)
    if all(codes):
        packer = struct.Struct("<" + "".join(codes))
        return packer.pack, lambda data: packer.unpack(data[:size])

    def pack(*values: Value) -> bytes:
        return b"".join(kind.pack(value) for kind, value in zip(kinds, values, strict=True))

    def unpack(data: bytes) -> Sequence[Value]:
        values, begin = [], 0
        for kind in kinds:
            values.append(kind.unpack(data[begin : begin + kind.size]))
            begin += kind.size
        return values

    return pack, unpack
