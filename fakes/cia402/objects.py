"""The objects of a positioning drive (CiA 402-2), with the defaults of the emulated one."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from microdrivers.fakes.canopen import Entry, PdoDefaults, array
from microdrivers.fakes.canopen.data_types import I8, I16, I32, U16, U32, DataType
from microdrivers.fakes.canopen.dictionary import Access, Mapping
from microdrivers.fakes.cia402.states import SUPPORTED_MODES, Mode

UM_PER_REVOLUTION = 1000.0
NO_WINDOW = 0xFFFFFFFF

TRANSMIT_PDOS = (
    PdoDefaults([(0x6041, 0), (0x6061, 0)], inhibit_100us=50),
    PdoDefaults([(0x6064, 0), (0x606C, 0)], inhibit_100us=50),
    PdoDefaults([(0x6041, 0), (0x6064, 0)], inhibit_100us=50, valid=False),
    PdoDefaults([(0x6041, 0), (0x606C, 0)], inhibit_100us=50, valid=False),
)
RECEIVE_PDOS = (
    PdoDefaults([(0x6040, 0), (0x6060, 0)]),
    PdoDefaults([(0x607A, 0), (0x6081, 0)]),
    PdoDefaults([(0x6040, 0), (0x607A, 0)], valid=False),
    PdoDefaults([(0x6040, 0)], valid=False),
)
HOMING_METHODS = (0, 17, 18, 24, 28, 33, 34, 35, 37)
_FASTEST_RAMP = 10.0


@dataclass(frozen=True)
class DriveRatings:
    """What the motor can do, and how the drive was set up; counts, counts/s, counts/s²."""

    max_speed: int
    acceleration: int
    counts_per_um: float
    homing_method: int
    home_offset: int


class DriveObjects:
    """The entries that the drive itself looks at, and all others in `entries`."""

    def __init__(self, ratings: DriveRatings) -> None:
        speed, rate = ratings.max_speed, ratings.acceleration
        fastest_rate = round(_FASTEST_RAMP * rate)
        self._all: list[Entry] = []
        self.error_code = self._add(0x603F, U16, "ro", mapping="tpdo")
        self.control_word = self._add(0x6040, U16, mapping="rpdo")
        self.status_word = self._add(0x6041, U16, "ro", mapping="tpdo")
        self.abort_option = self._add(0x6007, I16, value=1, allowed=range(4))
        self.quick_stop_option = self._add(0x605A, I16, value=2, allowed=(0, 1, 2, 5, 6))
        self.shutdown_option = self._add(0x605B, I16, value=0, allowed=(0, 1))
        self.disable_option = self._add(0x605C, I16, value=1, allowed=(0, 1))
        self.halt_option = self._add(0x605D, I16, value=1, allowed=(1, 2))
        self.fault_option = self._add(0x605E, I16, value=2, allowed=(0, 1, 2))
        self.mode = self._add(0x6060, I8, mapping="rpdo", allowed=tuple(Mode))
        self.mode_display = self._add(0x6061, I8, "ro", mapping="tpdo")
        self.position_demand = self._add(0x6062, I32, "ro", mapping="tpdo")
        self.position = self._add(0x6064, I32, "ro", mapping="tpdo")
        self.following_window = self._add(0x6065, U32, value=round(100 * ratings.counts_per_um))
        self.following_time_ms = self._add(0x6066, U16, value=100)
        self.position_window = self._add(0x6067, U32, value=round(1.0 * ratings.counts_per_um))
        self.position_time_ms = self._add(0x6068, U16, value=5)
        self.velocity = self._add(0x606C, I32, "ro", mapping="tpdo")
        self.target = self._add(0x607A, I32, mapping="rpdo")
        self.home_offset = self._add(0x607C, I32, value=ratings.home_offset)
        self._all += (limits := array(0x607D, I32, "rw", [0, 0]))
        self.limits = (limits[1], limits[2])
        self.max_speed = self._add(0x607F, U32, value=speed, low=1, high=speed)
        self.speed = self._add(0x6081, U32, value=speed // 2, low=1, mapping="rpdo")
        self.acceleration = self._add(0x6083, U32, value=rate, low=1, high=fastest_rate, mapping="rpdo")
        self.deceleration = self._add(0x6084, U32, value=rate, low=1, high=fastest_rate, mapping="rpdo")
        self.quick_deceleration = self._add(0x6085, U32, value=4 * rate, low=1, high=fastest_rate)
        self._add(0x6086, I16, allowed=(0,))
        self.homing_method = self._add(0x6098, I8, value=ratings.homing_method, allowed=HOMING_METHODS)
        self._all += (speeds := array(0x6099, U32, "rw", [speed // 4, max(1, speed // 20)], low=1, high=speed))
        self.homing_speeds = (speeds[1], speeds[2])
        self.homing_acceleration = self._add(0x609A, U32, value=rate, low=1, high=fastest_rate)
        self.relative_to = self._add(0x60F2, U16, allowed=(0, 1, 2))
        self.following_error = self._add(0x60F4, I32, "ro", mapping="tpdo")
        self.inputs = self._add(0x60FD, U32, "ro", mapping="tpdo")
        self._add(0x6502, U32, "const", value=SUPPORTED_MODES)
        counts = round(UM_PER_REVOLUTION * ratings.counts_per_um)
        for index, values in ((0x608F, [counts, 1]), (0x6091, [1, 1]), (0x6092, [counts, 1])):
            self._all += array(index, U32, "ro", values)

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._all)

    def _add(
        self,
        index: int,
        kind: DataType,
        access: Access = "rw",
        *,
        value: int = 0,
        low: int | None = None,
        high: int | None = None,
        allowed: Collection[int] | None = None,
        mapping: Mapping = "",
    ) -> Entry:
        entry = Entry(index, 0, kind, access, value, low=low, high=high, allowed=allowed, mapping=mapping)
        self._all.append(entry)
        return entry
