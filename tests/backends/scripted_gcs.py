"""A GCS peer for tests: answers from a script, and from the few values that a test sets."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.lines.settings import SerialConnection
from microdrivers.backends.pi_gcs import DRIVER
from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.backends.pi_gcs.stage import GcsXYThetaStage
from microdrivers.core.bus import Bus
from microdrivers.core.clock.simulated import SimulatedClock
from microdrivers.core.samples import DeviceEvent
from microdrivers.fakes.wire import Reply, Temper, Wire, register_wire

IDENTITY = b"(c)2016 Physik Instrumente (PI) GmbH & Co. KG, C-884.4DC, 116012345, 1.2.0.5\n"

_REQUEST = re.compile(rb"[\x04\x05\x07\x18]|[^\n]*\n")

MOVING_COMMANDS = (b"MOV", b"MVR", b"SVO ", b"FRF ", b"FNL", b"FPL", b"RON ", b"POS ", b"VEL ", b"GOH", b"INI")

Answer = bytes | None | Callable[[], bytes | None]


class ScriptedPeer:
    """Answers each request with `script[request]`, after `delay_s[request]`; silent where there is nothing."""

    request_form = _REQUEST

    def __init__(self, script: Mapping[bytes, Answer] | None = None) -> None:
        self.script: dict[bytes, Answer] = dict(script or {})
        self.delay_s: dict[bytes, float] = {}
        self.requests: list[bytes] = []
        self._buffer = b""

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        self._buffer += data
        replies = []
        while match := self.request_form.match(self._buffer):
            request = match.group()
            self._buffer = self._buffer[match.end() :]
            self.requests.append(request)
            answer = self.answer(request)
            if answer:
                delay_s = self.delay_s.pop(request, 0.001)
                replies.append(Reply(end_ns + round(delay_s * 1e9), answer))
        return replies

    def answer(self, request: bytes) -> bytes | None:
        answer = self.script.get(request)
        return answer() if callable(answer) else answer

    def advance(self, t_ns: int) -> Sequence[Reply]:
        return []

    def next_event_ns(self) -> int | None:
        return None


class ScriptedController(ScriptedPeer):
    """Three axes that jump to their targets. `refuse` maps the beginning of a command to the error it gives."""

    def __init__(self, axes: Sequence[str] = ("1", "2", "3")) -> None:
        super().__init__({b"*IDN?\n": IDENTITY, b"\x07": b"\xb1\n"})
        self.servo = dict.fromkeys(axes, False)
        self.referenced = dict.fromkeys(axes, False)
        self.position = dict.fromkeys(axes, 0.0)
        self.velocity = dict.fromkeys(axes, 1.5)
        self.acceleration = dict.fromkeys(axes, 5.0)
        self.lowest = dict.fromkeys(axes, 0.0)
        self.highest = dict.fromkeys(axes, 15.0)
        self.stages = dict.fromkeys(axes, "M-111.1DG")
        self.moving = False
        self.on_target = True
        self.error_flag = False
        self.error = 0
        self.refuse: dict[bytes, int] = {}
        self.hooks: dict[bytes, Callable[[], object]] = {}

    def power_cycle(self) -> None:
        for values in (self.servo, self.referenced):
            values.update(dict.fromkeys(values, False))
        self.position.update(dict.fromkeys(self.position, 0.0))
        self.velocity.update(dict.fromkeys(self.velocity, 0.7))
        self.error = 0

    def answer(self, request: bytes) -> bytes | None:
        for beginning, hook in self.hooks.items():
            if request.startswith(beginning):
                hook()
        if request in self.script:
            return super().answer(request)
        if request == b"ERR?\n":
            code, self.error = self.error, 0
            return b"%d\n" % code
        if request == b"\x04":
            return self._status()
        if request == b"\x18":
            self.error, self.moving = 10, False
            return None
        if b"?" in request:
            return self._query(request)
        return self._command(request)

    def _query(self, request: bytes) -> bytes | None:
        if request == b"SAI?\n":
            return _lines(self.servo)
        form = {
            b"SVO?\n": ("d", self.servo), b"FRF?\n": ("d", self.referenced), b"POS?\n": (".7f", self.position),
            b"VEL?\n": (".7f", self.velocity), b"ACC?\n": (".7f", self.acceleration),
            b"TMN?\n": (".7f", self.lowest), b"TMX?\n": (".7f", self.highest), b"CST?\n": ("s", self.stages),
        }  # fmt: skip
        if request not in form:
            self.error = 2
            return None
        spec, values = form[request]
        return _lines([f"{axis}={format(value, spec)}" for axis, value in values.items()])

    def _command(self, request: bytes) -> None:
        code = next((code for start, code in self.refuse.items() if request.startswith(start)), None)
        if code is not None:
            self.error = code
            return
        mnemonic, *words = request.decode().split()
        if mnemonic in ("FRF", "FNL", "FPL"):
            self.referenced[words[0]] = True
        for axis, text in zip(words[::2], words[1::2], strict=False):
            match mnemonic:
                case "SVO":
                    self.servo[axis] = text == "1"
                case "VEL":
                    self.velocity[axis] = float(text)
                case "MOV" if not (self.servo[axis] and self.referenced[axis]):
                    self.error = 5
                case "MOV":
                    self.position[axis] = float(text)

    def _status(self) -> bytes:
        common = self.moving << 13 | self.error_flag << 8
        words = [
            common | servo << 12 | (servo and self.on_target and not self.moving) << 15 for servo in self.servo.values()
        ]
        return b"0x" + b"".join(b"%04X" % word for word in words) + b"\n"


def _lines(items: Sequence[str] | Mapping[str, Any]) -> bytes:
    return " \n".join(items).encode() + b"\n"


class Bench:
    """A peer behind an emulated line, and what stands on the other side of it."""

    def __init__(self, peer: ScriptedPeer, *, seed: int = 1, temper: Temper | None = None) -> None:
        self.peer = peer
        self.clock = SimulatedClock()
        self.bus = Bus()
        self.wire = Wire(peer, clock=self.clock, seed=seed, baudrate=115200, temper=temper)
        self.connection = SerialConnection(port=register_wire("gcs-under-test", self.wire), timeout_s=0.1)

    def line(self) -> SerialLine:
        line = SerialLine(self.connection, clock=self.clock)
        line.open()
        return line

    def stage(self, **changes: Any) -> GcsXYThetaStage:
        """A stage, closed. Changes: `x=dict(...)`, `y`, `theta` for the axes, others for the stage."""
        axes = {axis: axis_settings(axis) | changes.pop(axis, {}) for axis in ("x", "y", "theta")}
        settings = GcsStageSettings.model_validate(
            {"connection": self.connection.model_dump(), "axes": axes, "reference_timeout_s": 1.0} | changes
        )
        stage = DRIVER.create("stage", settings, self.clock, self.bus)
        assert isinstance(stage, GcsXYThetaStage)
        return stage


class Rig:
    """An open stage, its scripted controller and the events that it has published."""

    def __init__(self, *, referenced: bool = True, **changes: object) -> None:
        self.controller = ScriptedController()
        for axis in self.controller.referenced:
            self.controller.referenced[axis] = referenced
        self.bench = Bench(self.controller)
        self.stage = self.bench.stage(**changes)
        self.events: list[DeviceEvent] = []
        self.stage.events.subscribe(self.events.append)
        self.stage.open()
        self.controller.requests.clear()

    def sent(self) -> list[bytes]:
        """The host's writes since the last call."""
        writes = [data for _, who, data in self.bench.wire.log if who == "host"]
        self.bench.wire.log.clear()
        return writes

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


def axis_settings(axis: str) -> dict[str, Any]:
    if axis == "theta":
        return {
            "id": "3", "travel_deg": (0.0, 15.0), "max_speed_deg_s": 1.0, "acceleration_deg_s2": 5.0,
            "resolution_deg": 4.5e-5, "tolerance_deg": 1e-4,
        }  # fmt: skip
    return {
        "id": "1" if axis == "x" else "2", "travel_um": (0.0, 15000.0), "max_speed_um_s": 1000.0,
        "acceleration_um_s2": 4000.0, "resolution_um": 0.05, "tolerance_um": 0.2,
    }  # fmt: skip
