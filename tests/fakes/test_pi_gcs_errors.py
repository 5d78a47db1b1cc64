"""The emulated controller's refusals: each error number, and that nothing of a bad line runs."""

from __future__ import annotations

import pytest

from microdrivers.fakes.pi_gcs.controller import MAX_LINE_BYTES
from tests.fakes.gcs_bench import GcsBench


@pytest.fixture
def bench() -> GcsBench:
    return GcsBench()


@pytest.fixture
def ready() -> GcsBench:
    bench = GcsBench()
    bench.reference()
    return bench


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("SAI? 1", 1),
        ("SPA? 1 0xZZ", 1),
        ("FOO 1", 2),
        ("MOV1 2", 2),
        ("POS?" + " 1" * MAX_LINE_BYTES, 3),
        ("VEL 1 1.6", 8),
        ("VEL 1 0", 8),
        ("VEL 1 -1", 8),
        ("VEL 1 1e-300", 8),
        ("HLT", 10),
        ("STP", 10),
        ("POS? $", 15),
        ("POS? ABCDEFGHIJKLMNOPQ", 15),
        ("ACC 1 20.1", 17),
        ("DEC 1 0", 17),
        ("SPA 1 0x49 1.6", 17),
        ("SPA 1 0x3F 1e300", 17),
        ("SPA 1 0x36 -1", 17),
        ("SPA 1 0x36 99999999999", 17),
        ("SVO 1 2", 17),
        ("POS? 1 1", 22),
        ("SVO 1 1 1 0", 22),
        ("MOV 4 1", 15),
        ("POS? X", 15),
        ("ERR? 1", 24),
        ("*IDN? 1", 24),
        ("STP 1", 24),
        ("SVO 1 1 2", 24),
        ("SPA 1 0x36 2 1", 24),
        ("MOV 1 abc", 25),
        ("MOV 1 nan", 25),
        ("MOV 1 inf", 25),
        ("MOV 1 1e999", 25),
        ("MOV 1 1_0", 25),
        ("SVO 1 on", 25),
        ("MOV", 26),
        ("MOV 1", 26),
        ("SPA 1 0x36", 26),
        ("SPA 1 0x15 15.1", 27),
        ("SPA 1 0x30 -0.1", 27),
        ("SPA 1 0x30 8 1 0x15 7", 27),
        ("POS 1 3", 34),
        ("SPA 1 0x99 1", 54),
        ("SPA? 1 999", 54),
        ("SPA 1 0xA 2", 60),
        ("SPA 1 0x3C " + 21 * "x", 17),
        ("MOV 1 1", 5),
        ("MVR 1 0", 5),
        ("FRF 1", 5),
    ],
)
def test_errors_at_power_on(bench: GcsBench, command: str, code: int) -> None:
    assert bench.error_after(command) == code
    assert bench.error() == 0


@pytest.mark.parametrize("command", ["MOV 1 15.1", "MOV 1 -0.1", "MVR 1 99", "MOV 2 3 1 99", "MOV 1 1e308"])
def test_out_of_limits_keeps_the_target_and_nothing_moves(ready: GcsBench, command: str) -> None:
    assert ready.error_after(command) == 7
    assert ready.line("MOV? 1 2") == "1=7.5000000 \n2=7.5000000"
    assert ready.ask(b"\x05") == b"0\n"


def test_values_rounded_to_the_protocols_decimals_are_not_out_of_limits(ready: GcsBench) -> None:
    assert ready.error_after("MOV 1 15.00002") == 0
    assert ready.error_after("MOV 1 15.00003") == 7
    assert ready.error_after("VEL 1 1.5000001") == 0
    assert ready.error_after("VEL 1 1.50001") == 8


def test_servo_on_is_not_enough_to_move(bench: GcsBench) -> None:
    bench.line("SVO 1 1")
    assert bench.error_after("MOV 1 1") == 5
    assert bench.error_after("MVR 1 0.1") == 5


def test_reference_moves_need_their_mode_and_switches(bench: GcsBench) -> None:
    bench.line("SVO 1 1 2 1")
    bench.line("RON 1 0")
    assert bench.error_after("FRF 1") == 50
    assert bench.error_after("SPA 2 0x14 0 2 0x32 1") == 0
    assert bench.line("TRS? 2") == "2=0"
    assert bench.line("LIM? 2") == "2=0"
    assert bench.error_after("FRF 2") == 31
    assert bench.error_after("FNL 2") == 32
    assert bench.error_after("FPL 2") == 32


def test_pos_declares_a_position_without_reference_mode(bench: GcsBench) -> None:
    bench.line("SVO 1 1")
    bench.line("RON 1 0")
    assert bench.error_after("POS 1 1e9") == 17
    assert bench.error_after("POS 1 2.5") == 0
    assert bench.line("FRF? 1") == "1=1"
    assert bench.line("POS? 1") == "1=2.5000000"
    bench.line("MOV 1 3.5")
    assert bench.error_after("POS 1 0") == 53
    bench.wait(3.0)
    assert bench.line("POS? 1") == "1=3.5000000"
    assert bench.true_position("x") == pytest.approx(7000.0)
    # The limits have not followed: 12 mm from here is where the stage ends.
    bench.line("MOV 1 14")
    bench.wait(20.0)
    assert bench.line("POS? 1 2") == "1=11.5000000 \n2=0.0000000"
    assert bench.line("ONT? 1") == "1=0"
    bench.line("HLT 1")
    assert bench.line("MOV? 1") == "1=11.5000000"
    assert bench.line("ONT? 1") == "1=1"


def test_the_last_error_stays_until_it_is_read(bench: GcsBench) -> None:
    bench.line("MOV 4 1")
    bench.line("FOO")
    bench.line("SVO 1 1")
    assert [bench.error(), bench.error()] == [2, 0]


@pytest.mark.parametrize(
    ("line", "query", "unchanged"),
    [
        ("SVO 1 1 2 7", "SVO? 1", "1=0"),
        ("VEL 1 1 2 99", "VEL? 1", "1=0.7500000"),
        ("RON 1 0 4 0", "RON? 1", "1=1"),
        ("SPA 1 0x36 9 1 0x99 1", "SPA? 1 0x36", "1 0x36=3"),
    ],
)
def test_nothing_of_a_bad_line_runs(bench: GcsBench, line: str, query: str, unchanged: str) -> None:
    assert bench.error_after(line) != 0
    assert bench.line(query) == unchanged


def test_nothing_of_a_bad_move_or_reference_runs(ready: GcsBench) -> None:
    ready.line("SVO 2 0")
    assert ready.error_after("MOV 1 3 2 3") == 5
    assert ready.error_after("FRF") == 5
    assert ready.ask(b"\x05") == b"0\n"
    assert ready.line("FRF? 1") == "1=1"


def test_parameters_are_what_the_other_commands_use(bench: GcsBench) -> None:
    assert bench.error_after("SPA 1 73 0.25 1 0xB 3 1 0x15 12 3 0x30 -90") == 0
    assert bench.line("VEL? 1") == "1=0.2500000"
    assert bench.line("ACC? 1") == "1=3.0000000"
    assert bench.line("TMX? 1") == "1=12.0000000"
    assert bench.line("TMN? 3") == "3=-90.0000000"
    assert bench.error_after("VEL 1 1.5000000") == 0
    assert bench.line("SPA? 1 0x49") == "1 0x49=1.5000000"
