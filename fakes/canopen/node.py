"""A CANopen node: what all devices have in common. The application behind it adds its own objects (CiA 301)."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import TypedDict

from microdrivers.core.units import NS_PER_S
from microdrivers.fakes.can.frame import Due, Frame
from microdrivers.fakes.canopen.application import Application
from microdrivers.fakes.canopen.communication_objects import STAY, STOP, Identity, communication_objects
from microdrivers.fakes.canopen.dictionary import Entry, ObjectDictionary
from microdrivers.fakes.canopen.emergency import HEARTBEAT_LOST, PDO_LENGTH, Emergencies
from microdrivers.fakes.canopen.heartbeats import HEARTBEAT_ID, HeartbeatConsumer, HeartbeatProducer
from microdrivers.fakes.canopen.nmt import COMMANDED_STATES, RESET_COMMUNICATION, RESET_NODE, NmtState
from microdrivers.fakes.canopen.pdo_record import PdoDefaults
from microdrivers.fakes.canopen.receive_pdo import ReceivePdo
from microdrivers.fakes.canopen.sdo_server import SdoServer, is_upload
from microdrivers.fakes.canopen.temper import PROMPT, Temper
from microdrivers.fakes.canopen.transmit_pdo import TransmitPdo, TransmitPdos

NEVER_NS = 1 << 63
_NMT_ID = 0x000
_SDO_REQUEST_ID, _SDO_REPLY_ID = 0x600, 0x580
_TPDO_IDS, _RPDO_IDS = (0x180, 0x280, 0x380, 0x480), (0x200, 0x300, 0x400, 0x500)
_ID = 0x7FF
_LONG_AGO_NS = -(1 << 62)
_CLOCK_ERROR = 50e-6
"""Largest relative error of the node's own clock."""

Handler = Callable[[Frame, int], bool]
"""Acts on a frame that ended at that time; tells whether anything that falls due by itself may have moved."""


class CanOpenNode:
    """A `CanNode`: it boots when it is first advanced, as a device does that was on before anybody looked.

    Args:
        entries: the application's objects.
        transmit, receive: defaults of the PDOs, from the first on; up to four of each.
        changes_are_events: whether a changed value sends an event-driven PDO.

    Attributes:
        listens_to: what the node does with which frames in its present state, by identifier.
        emergencies: what is wrong; the application tells it.
    """

    def __init__(
        self,
        node_id: int,
        identity: Identity,
        entries: Iterable[Entry],
        application: Application,
        *,
        transmit: Sequence[PdoDefaults],
        receive: Sequence[PdoDefaults],
        seed: int,
        temper: Temper | None = None,
        changes_are_events: bool = True,
    ) -> None:
        self.node_id = node_id
        self.state = NmtState.INITIALISING
        self.emergencies = Emergencies(self._send_emergency)
        self._application = application
        self._temper = temper or Temper()
        numbers = random.Random(seed)
        self._draw = numbers.random
        self._lock: AbstractContextManager[object] = threading.RLock()
        self._on_disturbed: Callable[[], None] = lambda: None
        self.listens_to: Mapping[int, Handler] = {}
        self._due: list[Due] = []
        self._withheld: list[bytes] = []
        self._next_ns = self._now_ns = self._sdo_free_ns = self._free_ns = _LONG_AGO_NS
        self._boot_ns: int | None = None
        self._set_points_wait = False
        self._producer = HeartbeatProducer()
        self._consumer = HeartbeatConsumer(
            on_missed=self._heartbeat_missed, on_back=self._heartbeat_back, on_changed=self._listen
        )
        self.dictionary = ObjectDictionary(entries)
        self._sync_id, self._emergency_id, self._on_loss = communication_objects(
            self.dictionary, identity, node_id, on_ids_changed=self._listen
        )
        self.dictionary.add([*self.emergencies.entries(), *self._consumer.entries(), self._producer.period])
        self._sdo = SdoServer(self.dictionary)
        clock_error = 0.0 if self._temper == PROMPT else numbers.uniform(-_CLOCK_ERROR, _CLOCK_ERROR)
        self._all_transmit = [
            TransmitPdo(number, defaults, timer_scale=1.0 + clock_error, **self._pdo_context(_TPDO_IDS[number - 1]))
            for number, defaults in enumerate(transmit, 1)
        ]
        self._transmit = TransmitPdos(self._all_transmit, send=self._send, changes_are_events=changes_are_events)
        self._receive = [
            ReceivePdo(number, defaults, **self._pdo_context(_RPDO_IDS[number - 1]))
            for number, defaults in enumerate(receive, 1)
        ]

    # ------------------------------------------------------------------ on the bus

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        """See `CanNode`."""
        if self._next_ns <= t_ns:
            self._catch_up(t_ns)
        handler = self.listens_to.get(frame.id)
        if handler is not None and not frame.extended and not frame.remote:
            self._now_ns = t_ns
            moved = handler(frame, t_ns)
            if self._transmit.cycle_ns is not None:
                self._transmit.look(t_ns)
                moved = True
            if moved:
                self._plan()
        return self._take_due() if self._due else ()

    def advance(self, t_ns: int) -> Sequence[Due]:
        """See `CanNode`."""
        self._catch_up(t_ns)
        self._plan()
        return self._take_due()

    def next_event_ns(self) -> int | None:
        """See `CanNode`."""
        return None if self._next_ns == NEVER_NS else self._next_ns

    # ------------------------------------------------------------------ from outside

    def settle_in(self, lock: AbstractContextManager[object], on_disturbed: Callable[[], None]) -> None:
        """The node is on a bus: the lock that `disturbing` needs there, and whom it tells."""
        self._lock, self._on_disturbed = lock, on_disturbed

    @contextmanager
    def disturbing(self, t_ns: int) -> Iterator[int]:
        """Something happens to the device other than over the bus; gives the time at which it does."""
        with self._lock:
            t_ns = max(t_ns, self._now_ns)
            self._catch_up(t_ns)
            yield t_ns
            self._plan()
            if self._due:
                self._next_ns = min(self._next_ns, t_ns)
        self._on_disturbed()

    def excuse_hosts(self, late_ns: int, until_ns: int) -> None:
        """Their heartbeats are due `late_ns` later, and not before `until_ns`: see `BusTimeline`."""
        self._consumer.postpone(late_ns, until_ns)
        self._plan()

    def power_cycle(self, t_ns: int) -> None:
        """Off and on again."""
        with self.disturbing(t_ns) as now_ns:
            self._restart(now_ns, self._temper.power_on_s)

    # ------------------------------------------------------------------ time

    def _catch_up(self, t_ns: int) -> None:
        """Do what is due, in the order of its times."""
        if self._now_ns == _LONG_AGO_NS:
            self._boot_ns = self._next_ns = t_ns
        while self._next_ns <= t_ns:
            due_ns = self._next_ns
            if self._boot_ns is not None:
                self._boot(due_ns)
            else:
                self._do_what_is_due(due_ns)
            self._plan()
        self._now_ns = t_ns

    def _do_what_is_due(self, t_ns: int) -> None:
        self._application.advance(t_ns)
        self._consumer.advance(t_ns)
        if self._producer.due_ns is not None and self._producer.due_ns <= t_ns:
            self._producer.beat()
            self._send(HEARTBEAT_ID + self.node_id, bytes((self.state,)), t_ns)
        self._transmit.advance(t_ns)
        if self._sdo.deadline_ns is not None and self._sdo.deadline_ns <= t_ns:
            self._reply(self._sdo.time_out(), t_ns)

    def _take_due(self) -> Sequence[Due]:
        due, self._due = self._due, []
        return due

    def _plan(self) -> None:
        if self._boot_ns is not None:
            self._next_ns = self._boot_ns
            return
        next_ns = NEVER_NS
        for due_ns in (
            self._application.next_event_ns(),
            self._transmit.due_ns,
            self._producer.due_ns,
            self._consumer.due_ns,
            self._sdo.deadline_ns,
        ):
            if due_ns is not None and due_ns < next_ns:
                next_ns = due_ns
        self._next_ns = next_ns

    # ------------------------------------------------------------------ network management

    def _boot(self, t_ns: int) -> None:
        self._boot_ns = None
        self.state = NmtState.PRE_OPERATIONAL
        self._consumer.start()
        self._send(HEARTBEAT_ID + self.node_id, b"\0", t_ns)
        self._producer.start(t_ns)
        self._tell_withheld(t_ns)
        self._listen()

    def _restart(self, t_ns: int, duration_s: tuple[float, float], *, communication_only: bool = False) -> None:
        if communication_only:
            self._application.communication_lost("reset", t_ns)
        self.state = NmtState.INITIALISING
        self._boot_ns = t_ns + self._draw_ns(duration_s)
        self._transmit.stop()
        self._sdo.cancel()
        self._withheld.clear()
        self.dictionary.reset(communication_only=communication_only)
        for pdo in (*self._all_transmit, *self._receive):
            pdo.reload()
        if not communication_only:
            self.emergencies.forget()
            self._application.restart(t_ns)
        self._listen()

    def _network_management(self, frame: Frame, t_ns: int) -> bool:
        if len(frame.data) < 2 or frame.data[1] not in (0, self.node_id):
            return False
        command = frame.data[0]
        if command in COMMANDED_STATES:
            self._enter(COMMANDED_STATES[command], t_ns)
        elif command in (RESET_NODE, RESET_COMMUNICATION):
            self._restart(t_ns, self._temper.reset_s, communication_only=command == RESET_COMMUNICATION)
        return True

    def _enter(self, state: NmtState, t_ns: int) -> None:
        if state is self.state:
            return
        self.state = state
        self._transmit.stop()
        self._listen()
        if state is NmtState.STOPPED:
            self._sdo.cancel()
            self._application.communication_lost("stopped", t_ns)
            return
        self._tell_withheld(t_ns)
        if state is NmtState.OPERATIONAL:
            self._transmit.start(t_ns)

    def _listen(self) -> None:
        """Which frames concern the node in its present state."""
        handlers: dict[int, Handler] = {}
        if self.state is not NmtState.INITIALISING:
            handlers |= {HEARTBEAT_ID + node_id: self._heartbeat for node_id in self._consumer.node_ids}
            handlers[_NMT_ID] = self._network_management
        if self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL):
            handlers[_SDO_REQUEST_ID + self.node_id] = self._sdo_request
        if self.state is NmtState.OPERATIONAL:
            handlers |= {pdo.cob_id: self._taker(pdo) for pdo in self._receive if pdo.valid}
            handlers[self._sync_id.value & _ID] = self._sync
        else:
            for pdo in self._receive:
                pdo.forget()
        self.listens_to = handlers

    # ------------------------------------------------------------------ heartbeats

    def _heartbeat(self, frame: Frame, t_ns: int) -> bool:
        self._consumer.heard(frame.id - HEARTBEAT_ID, t_ns)
        return True

    def _heartbeat_missed(self, node_id: int, t_ns: int) -> None:
        self.emergencies.happen(HEARTBEAT_LOST, t_ns, info=bytes((node_id,)))
        if self._on_loss.value == STOP or (self.state is NmtState.OPERATIONAL and self._on_loss.value != STAY):
            self._enter(NmtState.STOPPED if self._on_loss.value == STOP else NmtState.PRE_OPERATIONAL, t_ns)
        self._application.communication_lost("heartbeat", t_ns)

    def _heartbeat_back(self, _node_id: int, t_ns: int) -> None:
        self._application.communication_back(t_ns)

    # ------------------------------------------------------------------ data

    def _sdo_request(self, frame: Frame, t_ns: int) -> bool:
        server, request = self._sdo, frame.data
        reply = server.request(request, t_ns)
        if reply is not None:
            self._reply(reply, t_ns)
        return server.transfer is not None or not is_upload(request)

    def _sync(self, _frame: Frame, t_ns: int) -> bool:
        for sent in self._transmit.synchronous:
            data = sent.at_sync(t_ns)
            if data is not None:
                self._send(sent.cob_id, data, t_ns)
        if not self._set_points_wait:
            return False
        self._set_points_wait = False
        for taken in self._receive:
            taken.at_sync(t_ns)
        return True

    def _taker(self, pdo: ReceivePdo) -> Handler:
        def take(frame: Frame, t_ns: int) -> bool:
            if not pdo.take(frame.data, t_ns):
                self.emergencies.happen(PDO_LENGTH, t_ns)
                self.emergencies.pass_by(t_ns, PDO_LENGTH)
            self._set_points_wait = self._set_points_wait or pdo.waits_for_sync
            return True

        return take

    def _pdo_context(self, base_id: int) -> _PdoContext:
        return {
            "default_id": base_id + self.node_id,
            "dictionary": self.dictionary,
            "locked": lambda: self.state is NmtState.OPERATIONAL,
            "changed": lambda t_ns: self._transmit.sort(t_ns),
        }

    def _send(self, identifier: int, data: bytes, t_ns: int) -> None:
        ready_ns = t_ns + self._draw_ns(self._temper.pdo_s)
        if ready_ns > self._free_ns:
            self._free_ns = ready_ns
        self._due.append(Due(self._free_ns, Frame(identifier, data)))

    def _reply(self, data: bytes, t_ns: int) -> None:
        self._sdo_free_ns = max(t_ns + self._draw_ns(self._temper.sdo_s), self._sdo_free_ns)
        self._due.append(Due(self._sdo_free_ns, Frame(_SDO_REPLY_ID + self.node_id, data)))

    def _send_emergency(self, data: bytes, t_ns: int) -> None:
        if self.state in (NmtState.STOPPED, NmtState.INITIALISING):
            self._withheld.append(data)
        else:
            self._send(self._emergency_id.value & _ID, data, t_ns)

    def _tell_withheld(self, t_ns: int) -> None:
        withheld, self._withheld = self._withheld, []
        for data in withheld:
            self._send_emergency(data, t_ns)

    def _draw_ns(self, between_s: tuple[float, float]) -> int:
        low, high = between_s
        return int((low + (high - low) * self._draw()) * NS_PER_S)


class _PdoContext(TypedDict):
    default_id: int
    dictionary: ObjectDictionary
    locked: Callable[[], bool]
    changed: Callable[[int], None]
