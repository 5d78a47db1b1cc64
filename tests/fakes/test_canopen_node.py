"""Network management, heartbeats, emergencies and stored parameters of an emulated node."""

from __future__ import annotations

import pytest

from microdrivers.core.units import NS_PER_MS
from microdrivers.fakes.can.frame import Frame
from microdrivers.fakes.canopen import NmtState, Temper
from tests.fakes.canopen_bench import TEXT, PlainBench, hex_of, shown

READ_TYPE = "40 00 10 00 00 00 00 00"


def test_it_boots_when_it_is_first_looked_at() -> None:
    bench = PlainBench()
    assert [shown(due.frame) for due in bench.sent] == ["709 [1] 00"]
    assert bench.node.state is NmtState.PRE_OPERATIONAL
    assert bench.wait_ms(5000) == []


def test_a_stopped_node_hears_network_management_only() -> None:
    bench = PlainBench()
    bench.write(0x1017, 100, 2)
    bench.nmt(0x02)
    assert bench.ask(READ_TYPE) == ""
    assert {shown(frame) for frame in bench.wait_ms(500)} == {"709 [1] 04"}
    bench.nmt(0x80, 0)
    assert bench.ask(READ_TYPE) != ""


def test_commands_for_others_are_not_obeyed() -> None:
    bench = PlainBench()
    bench.nmt(0x01, 10)
    bench.put(0, "01")
    bench.nmt(0x55)
    assert bench.node.state is NmtState.PRE_OPERATIONAL
    bench.nmt(0x01, 0)
    assert bench.node.state is NmtState.OPERATIONAL


@pytest.mark.parametrize(("command", "text"), [(0x81, ""), (0x82, "kept")])
def test_a_reset_takes_time_and_ends_with_a_boot_up(command: int, text: str) -> None:
    bench = PlainBench(temper=Temper((0.0, 0.0), (0.0, 0.0), (0.1, 0.1), (1.0, 1.0)))
    bench.node.dictionary[TEXT, 0].put("kept", bench.t_ns)
    bench.write(0x1017, 20, 2)
    bench.nmt(0x01)
    bench.nmt(command)
    assert bench.wait_ms(99) == []
    assert bench.ask(READ_TYPE) == ""
    assert bench.nmt(0x01) == []
    assert [shown(frame) for frame in bench.wait_ms(500)] == ["709 [1] 00"]
    assert bench.node.state is NmtState.PRE_OPERATIONAL
    assert bench.read(0x1017) == 0
    assert bench.node.dictionary[TEXT, 0].value == text
    assert bench.application.told == (["restart"] if command == 0x81 else ["lost reset"])


@pytest.mark.parametrize("command", [0x02, 0x81, 0x82])
def test_half_a_transfer_is_forgotten(command: int) -> None:
    bench = PlainBench()
    bench.ask("40 08 10 00 00 00 00 00")
    bench.nmt(command)
    bench.wait_ms(1)
    bench.nmt(0x80)
    assert bench.ask("60 00 00 00 00 00 00 00").startswith("80")
    assert bench.wait_ms(2000) == []


def test_power_cycle_is_silent_until_the_boot_up() -> None:
    bench = PlainBench(temper=Temper((0.0, 0.0), (0.0, 0.0), (0.1, 0.1), (1.0, 1.0)))
    bench.write(0x1017, 20, 2)
    bench.node.power_cycle(bench.t_ns)
    assert bench.wait_ms(999) == []
    assert [shown(frame) for frame in bench.wait_ms(2)] == ["709 [1] 00"]


def test_heartbeats_tell_the_state_with_the_period_that_was_set() -> None:
    bench = PlainBench()
    bench.write(0x1017, 50, 2)
    set_ns = bench.t_ns
    assert [shown(frame) for frame in bench.wait_ms(220)] == ["709 [1] 7F"] * 4
    assert [due.t_ns - set_ns for due in bench.sent[-4:]] == [50 * NS_PER_MS * number for number in (1, 2, 3, 4)]
    bench.nmt(0x01)
    assert {shown(frame) for frame in bench.wait_ms(100)} == {"709 [1] 05"}
    bench.write(0x1017, 0, 2)
    assert bench.wait_ms(1000) == []


def test_stored_parameters_survive_a_reset() -> None:
    bench = PlainBench()
    bench.write(0x1017, 50, 2)
    assert bench.write(0x1010, 0x12345678, 4, 1) == 0x08000020
    assert bench.write(0x1010, 0x65766173, 4, 1) == 0
    bench.write(0x1017, 70, 2)
    bench.nmt(0x81)
    bench.wait_ms(1)
    assert bench.read(0x1017) == 50
    assert bench.write(0x1011, 0x64616F6C, 4, 1) == 0
    assert bench.read(0x1017) == 50
    bench.nmt(0x81)
    bench.wait_ms(1)
    assert bench.read(0x1017) == 0


# ---------------------------------------------------------------------- the master's heartbeat


def watching(period_ms: int = 200, *, on_loss: int = 0) -> PlainBench:
    bench = PlainBench()
    assert bench.write(0x1016, 1 << 16 | period_ms, 4, 1) == 0
    assert bench.write(0x1029, on_loss, 1, 1) == 0
    bench.operational()
    return bench


def test_nobody_is_missed_before_the_first_heartbeat() -> None:
    assert watching().wait_ms(5000) == []


@pytest.mark.parametrize(
    ("on_loss", "state"), [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)]
)
def test_a_missing_heartbeat_is_noticed_in_time(on_loss: int, state: NmtState) -> None:
    bench = watching(on_loss=on_loss)
    for _ in range(5):
        bench.put(0x701, "05")
        assert bench.wait_ms(150) == []
    frames = bench.wait_ms(50)
    assert [shown(frame) for frame in frames] == ["089 [8] 30 81 11 01 00 00 00 00"]
    assert bench.node.state is state
    assert bench.application.told == (["lost stopped"] if on_loss == 2 else []) + ["lost heartbeat"]
    assert bench.wait_ms(5000) == []
    bench.put(0x701, "05")
    assert bench.application.told[-1] == "back"
    assert [frame.id for frame in bench.wait_ms(250)] == []  # the same error is told once
    assert bench.application.told[-1] == "lost heartbeat"


def test_watching_ends_when_the_entry_is_cleared() -> None:
    bench = watching()
    bench.put(0x701, "05")
    bench.write(0x1016, 0, 4, 1)
    assert bench.wait_ms(5000) == []


# ---------------------------------------------------------------------- emergencies


def test_an_error_is_told_once_and_its_end_once() -> None:
    bench = PlainBench()
    with bench.node.disturbing(bench.t_ns) as t_ns:
        bench.node.emergencies.happen(0x2310, t_ns, info=b"\x01\x02")
        bench.node.emergencies.happen(0x2310, t_ns)
        bench.node.emergencies.happen(0xFF10, t_ns)
    assert [shown(frame) for frame in bench.wait_ms(1)] == [
        "089 [8] 10 23 03 01 02 00 00 00",
        "089 [8] 10 FF 83 00 00 00 00 00",
    ]
    assert bench.read(0x1001) == 0x83
    assert [bench.read(0x1003, sub) for sub in (0, 1, 2)] == [2, 0x0000FF10, 0x02012310]
    assert bench.ask("40 03 10 03 00 00 00 00") == "80 03 10 03 24 00 00 08"
    with bench.node.disturbing(bench.t_ns) as t_ns:
        bench.node.emergencies.pass_by(t_ns, 0x2310)
        bench.node.emergencies.pass_by(t_ns)
        bench.node.emergencies.pass_by(t_ns)
    assert [hex_of(frame.data) for frame in bench.wait_ms(1)] == [
        "00 00 81 00 00 00 00 00",
        "00 00 00 00 00 00 00 00",
    ]
    assert bench.write(0x1003, 1, 1) == 0x06090030
    assert bench.write(0x1003, 0, 1) == 0
    assert bench.read(0x1003) == 0


def test_a_stopped_node_tells_of_errors_when_it_may() -> None:
    bench = PlainBench()
    bench.nmt(0x02)
    with bench.node.disturbing(bench.t_ns) as t_ns:
        bench.node.emergencies.happen(0x4210, t_ns)
    assert bench.wait_ms(100) == []
    assert [shown(frame) for frame in bench.nmt(0x80)] == ["089 [8] 10 42 09 00 00 00 00 00"]


def test_frames_of_other_kinds_are_not_for_it() -> None:
    bench = PlainBench()
    request = bench.node.receive
    data = bytes.fromhex(READ_TYPE)
    assert request(Frame(0x609, data, extended=True), bench.t_ns) == ()
    assert request(Frame(0x609, remote=True), bench.t_ns) == ()
    assert request(Frame(0x60A, data), bench.t_ns) == ()
    assert len(request(Frame(0x609, data), bench.t_ns)) == 1


def test_replies_take_their_time_and_keep_their_order() -> None:
    bench = PlainBench(temper=Temper())
    due_ns = []
    for _ in range(50):
        bench.put(0x609, READ_TYPE)
        due_ns.append(bench.sent[-1].t_ns - bench.t_ns)
    assert min(due_ns) >= 150_000
    assert len(set(due_ns)) > 40
    times = [due.t_ns for due in bench.sent[1:]]
    assert times == sorted(times)
