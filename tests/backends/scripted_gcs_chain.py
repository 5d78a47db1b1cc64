"""Three scripted GCS controllers of one axis each, in a daisy chain on one line."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from microdrivers.core.samples import DeviceEvent
from microdrivers.fakes.wire import Reply, Temper
from tests.backends.scripted_gcs import Bench, ScriptedController, ScriptedPeer

STOP = b"1 \x18\n2 \x18\n3 \x18\n"

_LINE = re.compile(rb"[^\n]*\n")
_ADDRESSED = re.compile(rb"(\d+) (.*)\n", re.DOTALL)
_SINGLE_BYTES = (b"\x04", b"\x07", b"\x18")
_ADDRESS_OF = {"x": 1, "y": 2, "theta": 3}


class ScriptedBox(ScriptedController):
    """A C-863.12. `trajectory` gives its position (mm, deg) at a time; it takes one axis a line."""

    def __init__(self, address: int) -> None:
        super().__init__(("1",))
        serial_number = b"01155%05d" % address
        self.script[b"*IDN?\n"] = b"(c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,%s,1.2.0.0\n" % serial_number
        self.trajectory: Callable[[int], float] | None = None

    def answer_at(self, request: bytes, t_ns: int) -> bytes | None:
        self.requests.append(request)
        if self.trajectory is not None:
            self.position["1"] = self.trajectory(t_ns)
        return self.answer(request)

    def _command(self, request: bytes) -> None:
        if len(request.split()) > 3:
            self.error = 24
            return
        super()._command(request)


class AddressedPeer(ScriptedPeer):
    """A scripted peer in a chain, where single bytes stand in lines, too."""

    request_form = _LINE


class ScriptedChain(AddressedPeer):
    """The boxes by address. `script` answers for the whole chain; a box in `off` hears and says nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.boxes = {address: ScriptedBox(address) for address in _ADDRESS_OF.values()}
        self.off: set[int] = set()

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        byte_ns = (end_ns - start_ns) / len(data)
        pending = len(self._buffer)
        self._buffer += data
        replies = []
        taken = 0
        while match := _LINE.match(self._buffer):
            request = match.group()
            self._buffer = self._buffer[match.end() :]
            taken += len(request)
            heard_ns = start_ns + round((taken - pending) * byte_ns)
            self.requests.append(request)
            answer = super().answer(request) if request in self.script else self._answer_of_box(request, heard_ns)
            if answer:
                replies.append(Reply(heard_ns + round(self.delay_s.pop(request, 0.001) * 1e9), answer))
        return replies

    def _answer_of_box(self, request: bytes, t_ns: int) -> bytes | None:
        match = _ADDRESSED.fullmatch(request)
        assert match is not None, f"{request!r} is for nobody"
        address, command = int(match[1]), match[2]
        if address in self.off:
            return None
        answer = self.boxes[address].answer_at(command if command in _SINGLE_BYTES else command + b"\n", t_ns)
        return b"0 %d %s" % (address, answer) if answer else None

    def sent_to(self, address: int, *beginnings: bytes) -> list[bytes]:
        """What a box was sent that begins so."""
        return [request for request in self.boxes[address].requests if request.startswith(beginnings)]


class ChainRig:
    """An open stage on a chain of boxes at the addresses 1 (x), 2 (y) and 3 (theta)."""

    def __init__(
        self, *, referenced: bool = True, opened: bool = True, temper: Temper | None = None, **changes: object
    ) -> None:
        self.chain = ScriptedChain()
        self.x, self.y, self.theta = self.chain.boxes.values()
        for box in self.chain.boxes.values():
            box.referenced["1"] = referenced
        self.bench = Bench(self.chain, temper=temper)
        for axis, address in _ADDRESS_OF.items():
            changes[axis] = {"id": "1", "address": address} | changes.get(axis, {})  # type: ignore[operator]
        self.stage = self.bench.stage(**({"controller": "C-863.12"} | changes))
        self.events: list[DeviceEvent] = []
        self.stage.events.subscribe(self.events.append)
        if opened:
            self.stage.open()
            self.forget()

    @classmethod
    def ready(cls) -> ChainRig:
        """Servos on, poses recent, nothing recorded yet."""
        rig = cls()
        rig.stage.move_to(x_um=1.0, y_um=1.0, theta_deg=0.1)
        rig.forget()
        return rig

    def forget(self) -> None:
        """Begin to record anew."""
        self.chain.requests.clear()
        for box in self.chain.boxes.values():
            box.requests.clear()
        self.bench.wire.log.clear()

    def sent(self) -> list[bytes]:
        """The host's writes since the last call."""
        writes = [data for _, who, data in self.bench.wire.log if who == "host"]
        self.bench.wire.log.clear()
        return writes

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]
