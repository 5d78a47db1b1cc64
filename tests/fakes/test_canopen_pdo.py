"""PDOs of an emulated node: how they are mapped, what sends them, what becomes of those that arrive."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.canopen import Temper
from tests.fakes.canopen_bench import KINDS, LIMITED, READ_ONLY, TEXT, WRITE_ONLY, PlainBench, hex_of, shown

TPDO, RPDO = 0x1800, 0x1400
PRESENT_STATE, VALUE_RANGE = 0x08000022, 0x06090030
VALUE_U16, VALUE_I32 = 0x21030010, 0x21080020


def word(index: int) -> int:
    return index << 16 | 8 * KINDS[index].size


# ---------------------------------------------------------------------- mapping


@given(indices=st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=8), data=st.data())
@settings(deadline=None, max_examples=60)
def test_any_mapping_of_up_to_8_bytes_carries_values_both_ways(indices: list[int], data: st.DataObject) -> None:
    bench = PlainBench()
    size = sum(KINDS[index].size for index in indices)
    words = [word(index) for index in indices]
    codes = bench.map_pdo(TPDO, 0x189, words, kind=1)
    if size > 8:
        assert codes[-3] == 0x06040042
        return
    assert set(codes + bench.map_pdo(RPDO, 0x209, words)) == {0}
    bench.operational()
    sent = data.draw(st.binary(min_size=size, max_size=size))
    assert bench.put(0x209, sent + b"\xee" * data.draw(st.integers(0, 8 - size))) == []
    (frame,) = bench.sync()
    values: dict[int, bytes] = {}  # of an object that is mapped more than once, the last one stays
    begin = 0
    for index in indices:
        values[index] = sent[begin : begin + KINDS[index].size]
        begin += KINDS[index].size
    assert frame.data == b"".join(values[index] for index in indices)


def test_what_a_pdo_may_carry() -> None:
    bench = PlainBench()
    bench.write(0x1A00, 0, 1)
    for mapped, code in (
        (0x5FFF0008, 0x06020000),
        (0x10180920, 0x06090011),
        (TEXT << 16 | 8, 0x06040041),
        (LIMITED << 16 | 16, 0x06040041),
        (WRITE_ONLY << 16 | 8, 0x06040041),
        (0x21030008, 0x06040041),  # not so many bits
        (0x00050008, 0x06020000),  # gaps are for what arrives
        (READ_ONLY << 16 | 8, 0),
        (0x10010008, 0),
        (0, 0),
    ):
        assert bench.write(0x1A00, mapped, 4, 1) == code, hex(mapped)
    assert bench.write(0x1A00, 9, 1) == 0x06090031
    assert bench.write(0x1600, READ_ONLY << 16 | 8, 4, 1) == 0x06040041
    assert bench.write(0x1A00, 1, 1) == 0x06020000  # the entry is 0
    assert bench.read(0x1A00) == 0


def test_the_order_of_a_new_mapping_is_kept_to() -> None:
    bench = PlainBench()
    assert set(bench.map_pdo(TPDO, 0x189, [VALUE_U16])) == {0}
    assert bench.write(0x1A00, 0, 1) == PRESENT_STATE
    assert bench.write(0x1A00, VALUE_I32, 4, 1) == PRESENT_STATE
    assert bench.write(TPDO, 0x18A, 4, 1) == PRESENT_STATE
    assert bench.write(TPDO, 100, 2, 3) == PRESENT_STATE
    assert bench.write(TPDO, 0x189, 4, 1) == 0
    assert bench.write(TPDO, 0x80000189, 4, 1) == 0
    assert bench.write(0x1A00, VALUE_I32, 4, 1) == PRESENT_STATE
    assert bench.write(0x1A00, 0, 1) == 0
    assert bench.write(0x1A00, VALUE_I32, 4, 1) == 0
    bench.operational()
    assert bench.write(0x1A00, 1, 1) == PRESENT_STATE
    assert bench.write(TPDO, 0x189, 4, 1) == PRESENT_STATE


@pytest.mark.parametrize("cob_id", [0x20000189, 0x000, 0x07F, 0x101, 0x589, 0x609, 0x6E0, 0x701, 0x7FF])
def test_identifiers_that_no_pdo_may_have(cob_id: int) -> None:
    assert PlainBench().map_pdo(TPDO, cob_id, [VALUE_U16])[-1] == VALUE_RANGE


@pytest.mark.parametrize("kind", [241, 251, 252, 253])
def test_types_that_are_not_offered(kind: int) -> None:
    assert PlainBench().write(TPDO, kind, 1, 2) == VALUE_RANGE


# ---------------------------------------------------------------------- SYNC


def test_every_third_sync_in_operational_only() -> None:
    bench = PlainBench()
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=3)
    assert bench.sync() == []
    bench.operational()
    sent = [len(bench.sync()) for _ in range(7)]
    assert sent == [0, 0, 1, 0, 0, 1, 0]
    bench.nmt(0x80)
    assert [len(bench.sync()) for _ in range(4)] == [0] * 4


def test_type_0_follows_the_sync_after_a_change() -> None:
    bench = PlainBench()
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=0)
    bench.operational()
    assert bench.sync() == []
    bench.write(0x2103, 5, 2)
    assert [shown(frame) for frame in bench.sync()] == ["189 [2] 05 00"]
    assert bench.sync() == []


def test_synchronous_rpdo_waits_for_the_sync() -> None:
    bench = PlainBench()
    bench.map_pdo(RPDO, 0x209, [VALUE_U16], kind=1)
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=1)
    bench.put(0x209, "0100")
    bench.operational()
    bench.put(0x209, "0200")
    assert bench.read(0x2103) == 0
    assert [frame.data[0] for frame in bench.sync()] == [0]  # sent is what was there at the SYNC
    assert bench.read(0x2103) == 2
    bench.put(0x209, "0300")
    bench.nmt(0x80)
    bench.operational()
    bench.sync()
    assert bench.read(0x2103) == 2


def test_the_sync_may_have_another_identifier() -> None:
    bench = PlainBench()
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=1)
    assert bench.write(0x1005, 0x40000080, 4) == VALUE_RANGE
    assert bench.write(0x1005, 0x81, 4) == 0
    bench.operational()
    assert bench.sync() == []
    assert len(bench.put(0x81, "01")) == 1


# ---------------------------------------------------------------------- events


def test_a_change_is_an_event_and_repetition_is_none() -> None:
    bench = PlainBench()
    bench.map_pdo(TPDO, 0x189, [VALUE_U16])
    bench.operational()
    assert bench.wait_ms(100) == []
    frames = bench.put(0x609, "2B 03 21 00 05 00 00 00")
    assert [shown(frame) for frame in frames if frame.id == 0x189] == ["189 [2] 05 00"]
    assert [frame.id for frame in bench.put(0x609, "2B 03 21 00 05 00 00 00")] == [0x589]
    bench.node.dictionary[0x2103, 0].value = 6
    assert [shown(frame) for frame in bench.wait_ms(2)] == ["189 [2] 06 00"]


def test_the_inhibit_time_holds_changes_back() -> None:
    bench = PlainBench()
    bench.write(TPDO, 100, 2, 3)
    bench.map_pdo(TPDO, 0x189, [VALUE_U16])
    bench.operational()
    begin_ns = bench.t_ns
    for value in range(1, 31):
        bench.node.dictionary[0x2103, 0].value = value
        bench.wait_ms(1)
    bench.wait_ms(50)
    sent = [due for due in bench.sent if due.frame.id == 0x189]
    assert [due.frame.data[0] for due in sent] == [1, 11, 21, 30]
    times_ms = [(due.t_ns - begin_ns) / NS_PER_MS for due in sent]
    assert all(later - earlier >= 10 for earlier, later in itertools.pairwise(times_ms))


def test_the_event_timer_repeats_without_drift() -> None:
    bench = PlainBench(changes_are_events=False)
    bench.write(TPDO, 1, 2, 5)
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=254)
    bench.operational()
    begin_ns = bench.t_ns
    bench.write(0x2103, 5, 2)
    frames = bench.wait_ms(1000)
    assert len(frames) == 1000
    last = bench.sent[-1]
    assert last.t_ns == begin_ns + 1000 * NS_PER_MS
    assert hex_of(last.frame.data) == "05 00"
    assert bench.write(TPDO, 0, 2, 5) == 0
    assert bench.wait_ms(100) == []


def test_a_nodes_own_clock_is_a_little_off() -> None:
    bench = PlainBench(temper=Temper(), changes_are_events=False)
    bench.write(TPDO, 1, 2, 5)
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=254)
    bench.operational()
    begin_ns = bench.t_ns
    bench.wait_ms(20_000)
    due_ns = [due.t_ns - begin_ns for due in bench.sent if due.frame.id == 0x189]
    period_ns = (due_ns[-1] - due_ns[0]) / (len(due_ns) - 1)
    assert 1 < abs(period_ns - NS_PER_MS) <= 60
    assert due_ns == sorted(due_ns)


def test_timer_and_type_may_be_changed_while_it_runs() -> None:
    bench = PlainBench(changes_are_events=False)
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=1)
    bench.operational()
    assert bench.write(TPDO, 255, 1, 2) == 0
    assert bench.write(TPDO, 10, 2, 5) == 0
    assert bench.sync() == []
    assert len(bench.wait_ms(100)) == 10
    assert bench.write(TPDO, 1, 1, 2) == 0
    assert bench.wait_ms(100) == []
    assert len(bench.sync()) == 1


@pytest.mark.parametrize("timer_ms", [0, 1])
def test_a_value_that_always_changes_is_sent_as_often_as_the_node_looks(timer_ms: int) -> None:
    bench = PlainBench()
    bench.write(TPDO, timer_ms, 2, 5)
    bench.map_pdo(TPDO, 0x189, [VALUE_U16])
    numbers = itertools.count()
    bench.node.dictionary[0x2103, 0].read = lambda _t_ns: next(numbers)
    bench.operational()
    bench.wait_ms(0)
    assert len(bench.wait_ms(100)) == 100


# ---------------------------------------------------------------------- arriving


def test_a_pdo_that_is_too_short_is_told_and_not_used() -> None:
    bench = PlainBench()
    bench.map_pdo(RPDO, 0x209, [VALUE_U16])
    bench.operational()
    assert [shown(frame) for frame in bench.put(0x209, "05")] == [
        "089 [8] 10 82 11 00 00 00 00 00",
        "089 [8] 00 00 00 00 00 00 00 00",
    ]
    assert bench.read(0x2103) == 0


def test_bytes_may_be_skipped() -> None:
    bench = PlainBench()
    assert set(bench.map_pdo(RPDO, 0x209, [0x00060010, 0x00050008, VALUE_U16])) == {0}
    bench.operational()
    bench.put(0x209, "11 22 33 44 55")
    assert bench.read(0x2103) == 0x5544


def test_an_invalid_pdo_is_not_heard() -> None:
    bench = PlainBench()
    bench.map_pdo(RPDO, 0x209, [VALUE_U16])
    bench.write(RPDO, 0x80000209, 4, 1)
    bench.operational()
    bench.put(0x209, "0100")
    assert bench.read(0x2103) == 0


def test_pdos_are_as_set_up_at_the_makers_after_a_reset() -> None:
    bench = PlainBench()
    bench.map_pdo(TPDO, 0x189, [VALUE_U16], kind=1)
    bench.operational()
    bench.nmt(0x82)
    bench.wait_ms(1)
    bench.operational()
    assert bench.sync() == []
    assert bench.read(TPDO, 1) == 0x80000189
