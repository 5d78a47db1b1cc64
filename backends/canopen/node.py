"""One node of the network: its objects, its state, its heartbeat and its emergencies."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from microdrivers.backends.canopen import objects
from microdrivers.backends.canopen.emergency import EMERGENCY_ID, Emergency, decode_emergency
from microdrivers.backends.canopen.heartbeat import NMT_ID, Heartbeats, HeartbeatWatch, NmtCommand
from microdrivers.backends.canopen.sdo import REPLY_ID, REQUEST_ID, SdoClient
from microdrivers.backends.lines.can_line import CanLine, Listening, Received
from microdrivers.core.errors import ConfigError, LinkTimeout

_ASK_DEVICE_TYPE = bytes.fromhex("4000100000000000")
_SECOND_ANSWER_S = 0.02


class Identity(NamedTuple):
    """Who a node says it is; texts are empty where it has none, numbers 0."""

    device_type: int
    vendor: int
    product: int
    revision: int
    serial_number: int
    name: str
    software: str

    @property
    def profile(self) -> int:
        """Number of the device profile, such as 402."""
        return self.device_type & 0xFFFF


class NodeIds:
    """Who on a line uses which node id."""

    def __init__(self, line: CanLine) -> None:
        self._channel = line.connection.channel
        self._owners: dict[int, str] = {}

    def claim(self, node_id: int, owner: str) -> None:
        """Use a node id.

        Raises:
            ConfigError: another device of the rig does.
        """
        present = self._owners.setdefault(node_id, owner)
        if present != owner:
            raise ConfigError(
                f"node {node_id} on CAN bus {self._channel} belongs to {present} already, not to {owner}",
                key="node_id", remedy="give every device on a bus its own node_id, in the rig file and at its switches",
            )  # fmt: skip

    def free(self, node_id: int, owner: str) -> None:
        """Use it no longer."""
        if self._owners.get(node_id) == owner:
            del self._owners[node_id]


class CanopenNode:
    """A node as its master sees it.

    `attach` when the line is open, `detach` before it is closed. The calls come in the thread that receives, and must
    not wait for the node.

    Args:
        line: the bus.
        node_id: 1 to 126.
        owner: the device in the rig file.
        name: whom messages speak of: "axis x (node 11)".
        timeout_s: of an SDO reply.
        on_heartbeat: called with the state in each heartbeat (`NmtState`), boot-ups included.
        on_silence: called when the heartbeat that `expect_heartbeat` has asked for is missed, once.
        on_emergency: called with each emergency message.

    Attributes:
        state: what its newest heartbeat said (`NmtState`), None before.
    """

    def __init__(
        self, line: CanLine, node_id: int, *, owner: str, name: str, timeout_s: float,
        on_heartbeat: Callable[[int], object], on_silence: Callable[[], object],
        on_emergency: Callable[[Emergency], object],
    ) -> None:  # fmt: skip
        self.id = node_id
        self.name = name
        self.state: int | None = None
        self.sdo = SdoClient(line, node_id, timeout_s=timeout_s, name=name)
        self._line = line
        self._owner = owner
        self._on_heartbeat = on_heartbeat
        self._on_silence = on_silence
        self._on_emergency = on_emergency
        self._heartbeats = line.service(Heartbeats)
        self._watch: HeartbeatWatch | None = None
        self._listening: Listening | None = None

    def attach(self) -> None:
        """Listen to the node.

        Raises:
            ConfigError: another device of the rig has the same node id on this bus.
        """
        self._line.service(NodeIds).claim(self.id, self._owner)
        self._watch = self._heartbeats.watch(self.id, on_heartbeat=self._hear_heartbeat, on_silence=self._on_silence)
        self._listening = self._line.listen(
            EMERGENCY_ID + self.id, lambda received: self._on_emergency(decode_emergency(received.data))
        )

    def detach(self) -> None:
        """Listen no longer; idempotent."""
        watch, self._watch = self._watch, None
        listening, self._listening = self._listening, None
        if watch is not None:
            self._heartbeats.unwatch(watch)
            self._line.service(NodeIds).free(self.id, self._owner)
        if listening is not None:
            listening.cancel()

    @property
    def alive(self) -> bool:
        """Whether its heartbeat comes in time, as far as one is expected."""
        return self._watch is not None and self._watch.alive

    def command(self, command: NmtCommand) -> None:
        """Tell the node to change its state; it does not answer."""
        self._line.send(NMT_ID, bytes([command, self.id]))

    def produce_heartbeat(self, interval_ms: int, *, timeout_s: float) -> None:
        """Have the node send its heartbeat, and watch it; 0 ms ends both."""
        if self._watch is not None and not interval_ms:
            self._watch.expect(0.0)
        self.sdo.write(objects.PRODUCER_HEARTBEAT, interval_ms)
        if self._watch is not None and interval_ms:
            self._watch.expect(timeout_s)

    def consume_heartbeat(self, host_id: int, timeout_ms: int) -> None:
        """Have the node react if it does not hear that of `host_id` for so long; 0 ms ends it."""
        self.sdo.write(objects.CONSUMER_HEARTBEAT, host_id << 16 | timeout_ms)

    def require_alone(self, *, key: str) -> None:
        """Make sure that no two nodes have this id: both would do what one is told, and their answers would be mixed.

        Raises:
            ConfigError: two answer; `key` is that of the node's id in the rig file.
        """
        answering = self._count_answers()
        if answering > 1 and (answering := self._count_answers()) > 1:  # one of them may have been late
            raise ConfigError(
                f"{answering} nodes answer as node {self.id} on CAN bus {self._line.connection.channel}", key=key,
                remedy="give every node on the bus its own id, at its switches or with the maker's program",
            )  # fmt: skip

    def identify(self) -> Identity:
        """Ask the node who it is. A node that was stopped (NMT) does not answer and is woken once.

        Raises:
            LinkTimeout: nobody answers. ProtocolError: something else does.
        """
        try:
            device_type = self.sdo.read(objects.DEVICE_TYPE)
        except LinkTimeout:
            self.command(NmtCommand.PRE_OPERATIONAL)
            device_type = self.sdo.read(objects.DEVICE_TYPE)
        read = self.sdo.read_optional
        return Identity(
            device_type=device_type, vendor=read(objects.VENDOR_ID) or 0, product=read(objects.PRODUCT_CODE) or 0,
            revision=read(objects.REVISION) or 0, serial_number=read(objects.SERIAL_NUMBER) or 0,
            name=read(objects.DEVICE_NAME) or "", software=read(objects.SOFTWARE_VERSION) or "",
        )  # fmt: skip

    def _count_answers(self) -> int:
        """How many answer a question for the device type."""
        answers: list[Received] = []
        listening = self._line.listen(REPLY_ID + self.id, answers.append)
        try:
            self._line.send(REQUEST_ID + self.id, _ASK_DEVICE_TYPE)
            self._line.wait(self._line.clock.event(), _SECOND_ANSWER_S)
        finally:
            listening.cancel()
        return sum(answer.data[1:4] == _ASK_DEVICE_TYPE[1:4] for answer in answers)

    def _hear_heartbeat(self, state: int) -> None:
        self.state = state
        self._on_heartbeat(state)
