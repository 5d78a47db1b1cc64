"""The object dictionary: what can be read and written, with access rights and limits (CiA 301, 7.4)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Literal

from microdrivers.fakes.canopen.aborts import AbortCode, SdoAbort
from microdrivers.fakes.canopen.data_types import U8, DataType, Value

Access = Literal["ro", "rw", "wo", "const"]
Mapping = Literal["", "tpdo", "rpdo", "both"]
Read = Callable[[int], Value]
Write = Callable[[Value, int], None]

COMMUNICATION = range(0x1000, 0x2000)


class Entry:
    """One sub-index.

    Args:
        value: at power-on, unless another one has been stored.
        low, high: smallest and largest value; of a string, `high` is the largest number of bytes.
        allowed: the only values.
        mapping: the PDOs that may carry it.
        read: computes the value at `t_ns`; without it, the value is what was written last.
        write: is told of a value that has passed the checks, with `t_ns`; if it raises `SdoAbort`, the old one stays.
    """

    __slots__ = (
        "access", "allowed", "default", "high", "index", "low", "mapping", "read", "stored", "sub", "type", "value",
        "write",
    )  # fmt: skip

    def __init__(
        self,
        index: int,
        sub: int,
        kind: DataType,
        access: Access,
        value: Value = 0,
        *,
        low: float | None = None,
        high: float | None = None,
        allowed: Collection[Value] | None = None,
        mapping: Mapping = "",
        read: Read | None = None,
        write: Write | None = None,
    ) -> None:
        self.index, self.sub, self.type, self.access = index, sub, kind, access
        self.value = self.stored = self.default = value
        self.low, self.high, self.allowed = low, high, allowed
        self.mapping = mapping
        self.read, self.write = read, write

    def get(self, t_ns: int) -> Value:
        """The value at `t_ns`."""
        return self.value if self.read is None else self.read(t_ns)

    def put(self, value: Value, t_ns: int) -> None:
        """Check limits, keep the value, tell whom it concerns.

        Raises:
            SdoAbort: it is out of range, or cannot be written now.
        """
        if self.allowed is not None and value not in self.allowed:
            raise SdoAbort(AbortCode.VALUE_RANGE)
        if self.type.size:
            if self.low is not None and not value >= self.low:
                raise SdoAbort(AbortCode.TOO_LOW)
            if self.high is not None and not value <= self.high:
                raise SdoAbort(AbortCode.TOO_HIGH)
        before, self.value = self.value, value
        if self.write is not None:
            try:
                self.write(value, t_ns)
            except SdoAbort:
                self.value = before
                raise

    def upload(self, t_ns: int) -> bytes:
        """The bytes of the value at `t_ns`.

        Raises:
            SdoAbort: it cannot be read.
        """
        if self.access == "wo":
            raise SdoAbort(AbortCode.READ_OF_WRITE_ONLY)
        return self.type.pack(self.value if self.read is None else self.read(t_ns))

    def check_download(self, size: int | None) -> None:
        """Whether so many bytes may be written; None if their number is not known yet.

        Raises:
            SdoAbort: they may not.
        """
        if self.access in ("ro", "const"):
            raise SdoAbort(AbortCode.WRITE_OF_READ_ONLY)
        if size is None:
            return
        longest = self.type.size or self.high
        if longest is not None and size > longest:
            raise SdoAbort(AbortCode.TOO_LONG)
        if size < self.type.size:
            raise SdoAbort(AbortCode.TOO_SHORT)

    def download(self, data: bytes, t_ns: int) -> None:
        """Write bytes.

        Raises:
            SdoAbort: they are too many or too few, the value is out of range, or it cannot be written.
        """
        self.check_download(len(data))
        self.put(self.type.unpack(data), t_ns)


class ObjectDictionary:
    """All entries of a device, by index and sub-index."""

    def __init__(self, entries: Iterable[Entry] = ()) -> None:
        self._entries: dict[int, Entry] = {}
        self._indices: set[int] = set()
        self.add(entries)

    def add(self, entries: Iterable[Entry]) -> None:
        """Add entries; one with the same index and sub-index is replaced."""
        for entry in entries:
            self._entries[entry.index << 8 | entry.sub] = entry
            self._indices.add(entry.index)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def __getitem__(self, index_sub: tuple[int, int]) -> Entry:
        """For what is known to exist."""
        return self._entries[index_sub[0] << 8 | index_sub[1]]

    def find(self, index: int, sub: int) -> Entry:
        """The entry.

        Raises:
            SdoAbort: there is none.
        """
        entry = self._entries.get(index << 8 | sub)
        if entry is None:
            raise SdoAbort(AbortCode.NO_SUBINDEX if index in self._indices else AbortCode.NO_OBJECT)
        return entry

    def store(self) -> None:
        """Let all present values hold after the next reset."""
        for entry in self._kept():
            entry.stored = entry.value

    def forget_stored(self) -> None:
        """Let the maker's values hold after the next reset."""
        for entry in self._kept():
            entry.stored = entry.default

    def reset(self, *, communication_only: bool) -> None:
        """Take the values of power-on again."""
        for entry in self._kept():
            if entry.index in COMMUNICATION or not communication_only:
                entry.value = entry.stored

    def _kept(self) -> Iterator[Entry]:
        return (entry for entry in self if entry.access == "rw" and entry.read is None)


def array(
    index: int,
    kind: DataType,
    access: Access,
    values: Sequence[Value],
    *,
    low: float | None = None,
    high: float | None = None,
    mapping: Mapping = "",
) -> list[Entry]:
    """Sub-index 0, which tells how many follow, and the values of one type."""
    count = Entry(index, 0, U8, "const", len(values))
    return [count] + [
        Entry(index, sub, kind, access, value, low=low, high=high, mapping=mapping)
        for sub, value in enumerate(values, 1)
    ]
