"""A Modbus TCP gateway: MBAP on one side, an RS-485 line with one RTU slave on the other.

Source: Modbus Messaging on TCP/IP Implementation Guide V1.0b. Where gateways differ, this one does what is written at
the constant or the method.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.modbus.rtu import RtuSlave, frame
from microdrivers.fakes.wire import Reply

_HEADER = 6
"""Transaction, protocol and length; the length counts the unit id and the PDU that follow."""

_LENGTHS = range(2, 255)
_MODBUS = 0
_GATEWAY_TARGET_FAILED = 0x0B

_UNITS_OF_THE_ONLY_SLAVE = (0, 255)
"""The guide's values for a device that needs no address. So 0 is no broadcast here: it is answered."""

_TARGET_TIMEOUT_NS = 150 * NS_PER_MS
"""How long a slave may take before it begins to reply. A choice: shorter than a host's usual 200 ms and more."""

_REASSEMBLY_NS = 500 * NS_PER_MS
"""A pause that ends whatever was incomplete or out of step. A choice: the guide names none."""


class _Request(NamedTuple):
    arrived_ns: int
    connection: int
    transaction: bytes
    unit_id: int
    pdu: bytes


class TcpGateway:
    """Carries requests to a slave one after the other; a `NetworkEmulator`.

    Requests may come in one segment or in pieces and need not wait for one another; replies keep their order, and
    each comes after its exchange on the RS-485 line. A slave that is silent, such as a unit that does not exist, gets
    exception 0Bh once the gateway's time-out is over.

    A header with another protocol or an impossible length cannot be skipped, because nothing tells where the next one
    begins: bytes are dropped until none has come for half a second, or until the host connects anew. The rest of a
    request that does not come for as long is waited for no longer. What was complete before is carried out in either
    case; after a new connection its reply has nowhere to go.

    Args:
        slave: what is on the line, with the line's baud rate and timing.
    """

    def __init__(self, slave: RtuSlave) -> None:
        self.slave = slave
        self._received = bytearray()
        self._last_byte_ns = 0
        self._out_of_step = False
        self._connection = 0
        self._requests: deque[_Request] = deque()
        self._under_way: _Request | None = None
        self._answer_by_ns = 0
        self._line_free_ns = -(10**18)

    # ------------------------------------------------------------------ host

    def connected(self, t_ns: int) -> None:
        """A host connects: nothing is left of what it, or another, had begun to send."""
        del t_ns
        self._connection += 1
        self._forget_incomplete()

    def receive(self, data: bytes, start_ns: int, end_ns: int) -> Sequence[Reply]:
        """The next bytes of the stream; only the last one's time counts."""
        replies = self.advance(start_ns)
        if data:
            self._last_byte_ns = end_ns
            self._received += data
            self._split()
        return replies

    def advance(self, t_ns: int) -> list[Reply]:
        """Do what has fallen due by `t_ns`, one after the other."""
        replies = []
        while (due_ns := self.next_event_ns()) is not None and due_ns <= t_ns:
            replies += self._step(due_ns)
        return replies

    def next_event_ns(self) -> int | None:
        """When the line, the slave or a time-out is next."""
        times = [self.slave.next_event_ns()]
        if self._received or self._out_of_step:
            times.append(self._last_byte_ns + _REASSEMBLY_NS)
        if self._under_way is not None:
            times.append(self._answer_by_ns)
        elif self._requests:
            times.append(max(self._requests[0].arrived_ns, self._line_free_ns))
        return min((t_ns for t_ns in times if t_ns is not None), default=None)

    def _split(self) -> None:
        received = self._received
        while not self._out_of_step and len(received) >= _HEADER:
            transaction, protocol, length = struct.unpack(">2sHH", received[:_HEADER])
            if protocol != _MODBUS or length not in _LENGTHS:
                self._out_of_step = True
            elif len(received) >= _HEADER + length:
                unit_id, pdu = received[_HEADER], bytes(received[_HEADER + 1 : _HEADER + length])
                self._requests.append(_Request(self._last_byte_ns, self._connection, transaction, unit_id, pdu))
                del received[: _HEADER + length]
            else:
                return
        if self._out_of_step:
            received.clear()

    def _forget_incomplete(self) -> None:
        self._received.clear()
        self._out_of_step = False

    # ------------------------------------------------------------------ line

    def _step(self, t_ns: int) -> list[Reply]:
        if (self._received or self._out_of_step) and t_ns >= self._last_byte_ns + _REASSEMBLY_NS:
            self._forget_incomplete()
        replies = [self._carry_back(reply) for reply in self.slave.advance(t_ns)]
        if self._under_way is not None and t_ns >= self._answer_by_ns:
            replies.append(self._give_up(t_ns, self._under_way))
        if self._under_way is None and self._requests and t_ns >= max(self._requests[0].arrived_ns, self._line_free_ns):
            self._begin(t_ns, self._requests.popleft())
        return [reply for reply in replies if reply is not None]

    def _begin(self, t_ns: int, request: _Request) -> None:
        unit_id = self.slave.unit_id if request.unit_id in _UNITS_OF_THE_ONLY_SLAVE else request.unit_id
        data = frame(unit_id, request.pdu)
        end_ns = t_ns + len(data) * self.slave.byte_ns
        self._under_way = request
        self._answer_by_ns = end_ns + _TARGET_TIMEOUT_NS
        self.slave.receive(data, t_ns, end_ns)  # it has taken all earlier frames, so it has no reply yet

    def _carry_back(self, reply: Reply) -> Reply | None:
        """The gateway, too, knows the end of a frame by the silence after it."""
        assert self._under_way is not None  # a slave speaks when it is asked
        request, self._under_way = self._under_way, None
        end_ns = reply.t_ns + len(reply.data) * self.slave.byte_ns
        timing = self.slave.timing
        self._line_free_ns = end_ns + max(timing.silence_ns, timing.pause_after_reply_ns)
        return self._answer(end_ns + timing.silence_ns, request, reply.data[1:-2])

    def _give_up(self, t_ns: int, request: _Request) -> Reply | None:
        self._under_way = None
        self._line_free_ns = t_ns
        return self._answer(t_ns, request, bytes((request.pdu[0] | 0x80, _GATEWAY_TARGET_FAILED)))

    def _answer(self, t_ns: int, request: _Request, pdu: bytes) -> Reply | None:
        if request.connection != self._connection:
            return None
        header = struct.pack(">2sHHB", request.transaction, _MODBUS, len(pdu) + 1, request.unit_id)
        return Reply(t_ns, header + pdu)
