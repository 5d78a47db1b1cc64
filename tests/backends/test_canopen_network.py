"""NMT, heartbeats, PDOs and SYNC, against a scripted node."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.backends.canopen.emergency import Emergency
from microdrivers.backends.canopen.heartbeat import Heartbeats, NmtCommand, NmtState
from microdrivers.backends.canopen.node import CanopenNode
from microdrivers.backends.canopen.objects import Entry, unsigned
from microdrivers.backends.canopen.pdo import configure_rpdo, configure_tpdo, disable_tpdo, rpdo_id, tpdo_id
from microdrivers.core.errors import ConfigError
from tests.backends.canopen_bench import NODE, OBJECTS, LineBench
from tests.backends.canopen_peer import PeerNode


class Watched:
    """A node as its master sees it, and all that it said by itself."""

    def __init__(self, bench: LineBench, *, node_id: int = NODE, owner: str = "probe_force") -> None:
        self.states: list[int] = []
        self.silences: list[int] = []
        self.emergencies: list[Emergency] = []
        self.node = CanopenNode(
            bench.line, node_id, owner=owner, name=f"node {node_id}", timeout_s=0.1,
            on_heartbeat=self.states.append, on_silence=lambda: self.silences.append(bench.clock.now_ns()),
            on_emergency=self.emergencies.append,
        )  # fmt: skip
        self.node.attach()


def test_a_node_says_who_it_is_and_is_woken_if_it_was_stopped():
    with LineBench() as bench:
        watched = Watched(bench)
        watched.node.command(NmtCommand.STOP)
        identity = watched.node.identify()
        assert (identity.profile, identity.name, identity.vendor) == (404, "MEASURING-AMPLIFIER", 0)
        assert (0x000, bytes([0x02, NODE])) in bench.host_frames
        assert (0x000, bytes([0x80, NODE])) in bench.host_frames


def test_a_node_id_belongs_to_one_device():
    with LineBench() as bench:
        first = Watched(bench)
        with pytest.raises(ConfigError, match=r"node 5 .* belongs to probe_force already, not to gripper_force"):
            Watched(bench, owner="gripper_force")
        first.node.detach()
        first.node.detach()
        Watched(bench, owner="gripper_force")


def test_emergencies_reach_the_master():
    with LineBench() as bench:
        watched = Watched(bench)
        bench.node.emergency(bench.clock.now_ns(), 0x4210, register=0x09)
        bench.medium.refresh()
        bench.node.put(0x1017, 0, 0)
        watched.node.command(NmtCommand.START)  # has the node send what it has to say
        bench.clock.sleep(0.01)
        assert watched.emergencies == [Emergency(0x4210, 0x09, bytes(5))]
        assert str(watched.emergencies[0]) == "over-temperature of the device (error code 4210h)"


def test_a_missing_heartbeat_is_noticed_within_two_intervals():
    with LineBench() as bench:
        watched = Watched(bench)
        producing = bench.line.service(Heartbeats).produce(0.05)
        watched.node.produce_heartbeat(100, timeout_s=0.15)
        bench.clock.sleep(1.0)
        assert not watched.silences
        assert watched.node.alive
        assert set(watched.states) == {NmtState.PRE_OPERATIONAL}
        gone_ns = bench.clock.now_ns()
        bench.medium.detach(bench.node)
        bench.clock.sleep(1.0)
        assert len(watched.silences) == 1
        assert watched.silences[0] - gone_ns <= 200_000_000
        assert not watched.node.alive
        bench.medium.attach(PeerNode(NODE, dict(OBJECTS)))
        bench.clock.sleep(0.01)
        assert watched.states[-1] == NmtState.BOOT_UP
        assert watched.node.alive
        producing.cancel()


def test_our_heartbeat_goes_out_in_time_whatever_we_wait_for():
    with LineBench() as bench:
        watched = Watched(bench)
        producing = bench.line.service(Heartbeats).produce(0.05)
        bench.line.service(Heartbeats).produce(0.2)
        watched.node.consume_heartbeat(127, 100)
        watched.node.produce_heartbeat(10, timeout_s=0.1)  # the bus goes on while we wait
        bench.clock.sleep(0.5)
        bench.line.wait(bench.clock.event(), 0.5)
        bench.clock.sleep(0.5)
        beats = [t_ns for t_ns, who, frame in bench.medium.log if frame.id == 0x77F]
        gaps = [(later - sooner) / 1e6 for sooner, later in pairwise(beats)]
        assert len(beats) >= 30
        assert max(gaps) < 51.0
        assert bench.node.number(0x1016, 1) == 127 << 16 | 100
        producing.cancel()
        bench.clock.sleep(0.2)
        bench.medium.log.clear()
        bench.clock.sleep(1.0)
        assert 4 <= sum(frame.id == 0x77F for _, _, frame in bench.medium.log) <= 6


# ---------------------------------------------------------------------- PDOs

STATUS, POSITION = unsigned(0x6041, 0, 16), unsigned(0x6064, 0, 32)


def _pdo_objects() -> dict[tuple[int, int], bytes]:
    objects = {(0x6041, 0): bytes(2), (0x6064, 0): bytes(4), (0x6040, 0): bytes(2)}
    for offset in range(4):
        for base, first in ((0x1400, 0x200), (0x1800, 0x180)):
            objects[base + offset, 1] = (0x40000000 | first + 0x100 * offset + NODE).to_bytes(4, "little")
            objects[base + offset, 2] = b"\xff"
        for base in (0x1600, 0x1A00):
            objects |= {(base + offset, place): bytes(1 if not place else 4) for place in range(5)}
        objects[0x1800 + offset, 3] = objects[0x1800 + offset, 5] = bytes(2)
    return objects


def test_pdos_are_mapped_in_the_one_order_that_all_nodes_take():
    with LineBench() as bench:
        bench.node.objects |= _pdo_objects()
        configure_tpdo(bench.sdo, 1, tpdo_id(NODE), [STATUS, POSITION])
        order = [(index, sub) for index, sub, _ in bench.node.written]
        assert order == [(0x1800, 1), (0x1800, 2), (0x1A00, 0), (0x1A00, 1), (0x1A00, 2), (0x1A00, 0), (0x1800, 1)]
        values = [int.from_bytes(data, "little") for _, _, data in bench.node.written]
        assert values == [0xC0000185, 1, 0, 0x60410010, 0x60640020, 2, 0x40000185]


def test_event_driven_pdos_have_times_and_others_none():
    with LineBench() as bench:
        bench.node.objects |= _pdo_objects()
        configure_tpdo(bench.sdo, 2, tpdo_id(NODE, 2), [STATUS], transmission=255, inhibit_ms=0.5, event_ms=1)
        assert (bench.node.number(0x1801, 3), bench.node.number(0x1801, 5)) == (5, 1)
        configure_rpdo(bench.sdo, 1, rpdo_id(NODE), [unsigned(0x6040, 0, 16)])
        assert bench.node.number(0x1600, 1) == 0x60400010
        disable_tpdo(bench.sdo, 3)
        disable_tpdo(bench.sdo, 3)
        assert bench.node.number(0x1802, 1) >> 31 == 1
        assert [entry[:2] for entry in bench.node.written].count((0x1802, 1)) == 1
        del bench.node.objects[0x1803, 1]
        disable_tpdo(bench.sdo, 4)  # a node without it is fine
        bench.node.aborts[0x1A00, 1] = 0x06040041
        with pytest.raises(SdoAbort, match=r"1A00h\.1: object cannot be mapped"):
            configure_tpdo(bench.sdo, 1, tpdo_id(NODE), [STATUS])


@settings(deadline=None, max_examples=50)
@given(index=st.integers(0x1000, 0xFFFF), sub=st.integers(0, 255), bits=st.sampled_from([8, 16, 24, 32]))
def test_a_mapping_word_tells_index_sub_and_bits(index: int, sub: int, bits: int):
    entry: Entry[int] = unsigned(index, sub, bits)
    assert (entry.mapping >> 16, entry.mapping >> 8 & 0xFF, entry.mapping & 0xFF) == (index, sub, bits)


def test_a_computer_that_was_too_busy_to_beat_blames_nobody_else_first():
    with LineBench() as bench:
        heartbeats = bench.line.service(Heartbeats)
        heartbeats.produce(0.05)
        bench.clock.sleep(0.2)
        in_time = bench.line.silence("no answer", 0.3)
        assert "busy" not in in_time.what
        heartbeats._last_ns -= 130_000_000  # as if it had not had its turn since
        bench.clock.sleep(0.05)
        late = bench.line.silence("no answer", 0.3)
        assert "this computer is too busy: our heartbeat was 130 ms late" in late.what
        assert "end other programs" in late.remedy
        bench.clock.sleep(3.0)
        assert bench.line.silence("no answer", 0.3).remedy == in_time.remedy
