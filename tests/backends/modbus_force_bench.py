"""A force sensor wired to an analogue-input module as the makers' tables describe it; none of the driver's code."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Sequence
from typing import Any

from microdrivers.backends.modbus_analogue import DRIVER, ModbusForceSettings
from microdrivers.backends.modbus_analogue.sensor import ModbusForceSensor
from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import DeviceEvent, ForceSample
from microdrivers.core.units import NS_PER_MS, NS_PER_S, Range
from microdrivers.fakes.wire import Reply, Temper, Wire, register_wire
from tests.backends.oriental_az_peer import with_crc

_names = itertools.count()

MODBUS_HZ, BITS = 115200, 10
ANSWER_NS = 2 * NS_PER_MS


class SheetModule:
    """Eight inputs behind Modbus; converts at its own beat, and is silent on functions that it does not know.

    Attributes:
        volts: at the input, by time in s.
        delays_s: taken from the front, before an answer; None is no answer at all.
        spoil: taken from the front, what becomes of an answer's frame.
        refusal: exception with which all reads of inputs are answered, if any.
    """

    def __init__(self, *, family: str = "waveshare", code: int = 0, channel: int = 1, unit_id: int = 1) -> None:
        self.volts: Callable[[float], float] = lambda _t_s: 2.5
        self.conversion_ns = 20 * NS_PER_MS
        self.family = family
        self.unit_id = unit_id
        self.span = {
            ("waveshare", 0): (0.0, 5.0), ("waveshare", 1): (1.0, 5.0), ("adam", 9): (-5.0, 5.0),
        }.get((family, code), (0.0, 20.0))  # fmt: skip
        self.channel = channel
        if family == "waveshare":
            self.holding = {0x1000 + i: 2 for i in range(8)} | {0x1000 + channel - 1: code, 0x4000: unit_id}
        else:
            self.holding = {200 + i: 0x0D for i in range(8)} | {200 + channel - 1: code}
            self.holding |= {210: 0x4117, 211: 0, 212: 0xA200, 213: 0xB001, 220: 1 << channel - 1}
        self.requests: list[bytes] = []
        self.converted_ns: list[int] = []
        self.delays_s: list[float | None] = []
        self.spoil: list[Callable[[bytes], bytes]] = []
        self.refusal = 0
        self._free_ns = 0

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self.requests.append(data)
        delay_s = self.delays_s.pop(0) if self.delays_s else 0.0
        if delay_s is None or with_crc(data[:-2]) != data or data[0] != self.unit_id:
            return ()
        pdu = self._answer(data[1:-2], end_ns)
        if not pdu:
            return ()
        frame = with_crc(data[:1] + pdu)
        if self.spoil:
            frame = self.spoil.pop(0)(frame)
        self._free_ns = max(self._free_ns, end_ns + ANSWER_NS + round(delay_s * NS_PER_S))
        return [Reply(self._free_ns, frame)]

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None

    def _answer(self, pdu: bytes, t_ns: int) -> bytes:
        function, address, count = struct.unpack(">BHH", pdu)
        if function == 4 and self.refusal:
            return bytes((0x84, self.refusal))
        if function not in (3, 4):
            return b""
        registers = self.holding if function == 3 else dict(enumerate(self._inputs(t_ns)))
        if not all(address + i in registers for i in range(count)):
            return bytes((function | 0x80, 2))
        return struct.pack(f">BB{count}H", function, 2 * count, *(registers[address + i] for i in range(count)))

    def _inputs(self, t_ns: int) -> list[int]:
        converted_ns = t_ns - t_ns % self.conversion_ns
        self.converted_ns.append(converted_ns)
        low, high = self.span
        volts = min(max(self.volts(converted_ns / NS_PER_S), 0.0 if self.family == "waveshare" else low), high)
        if self.family == "waveshare":
            register = int(4095 / high * volts) * high * 1000 / 4095
        else:
            register = (volts - low) / (high - low) * 65535
        return [round(register) if i == self.channel - 1 else 7 * i for i in range(8)]


class TcpModule:
    """The same behind Modbus TCP."""

    def __init__(self, module: SheetModule) -> None:
        self._module = module

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        replies = self._module.receive(with_crc(data[6:]), start_ns, end_ns)
        return [Reply(t_ns, data[:4] + struct.pack(">H", len(frame) - 2) + frame[:-2]) for t_ns, frame in replies]

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return ()

    def next_event_ns(self) -> int | None:
        return None


RIG: dict[str, Any] = {
    "model": "waveshare-8ch", "channel": 1, "range_V": Range(0.0, 5.0), "zero_V": 2.5, "sensitivity_uN_per_V": 50.0,
    "range_uN": Range(-100.0, 100.0), "resolution_uN": 0.06, "bandwidth_hz": 30.0, "stiffness_uN_per_um": 1000.0,
    "axis": (1.0, 0.0, 0.0), "carried_by": "gripper_stage", "rate_hz": 30.0,
}  # fmt: skip


class ForceBench:
    """A sensor, the module, and all that was published."""

    def __init__(self, module: SheetModule | None = None, *, framing: str = "rtu", seed: int = 0, **rig: Any) -> None:
        self.module = SheetModule() if module is None else module
        self.clock = SimulatedClock()
        emulator = self.module if framing == "rtu" else TcpModule(self.module)
        self.wire = Wire(
            emulator,
            clock=self.clock,
            seed=seed,
            baudrate=MODBUS_HZ,
            bits_per_byte=BITS,
            temper=Temper(max_fragments=3),
        )
        url = register_wire(f"force-test-{next(_names)}", self.wire)
        connection = {"port": url, "framing": framing, "timeout_s": 0.2}
        bus = Bus()
        settings = ModbusForceSettings.model_validate({"connection": connection} | RIG | rig)
        sensor = DRIVER.create("gripper_force", settings, self.clock, bus)
        assert isinstance(sensor, ModbusForceSensor)
        self.sensor = sensor
        self.samples: list[ForceSample] = []
        self.events: list[DeviceEvent] = []
        sensor.topic.subscribe(self.samples.append)
        sensor.events.subscribe(self.events.append)

    def opened(self) -> ForceBench:
        self.sensor.open()
        return self

    @property
    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]
