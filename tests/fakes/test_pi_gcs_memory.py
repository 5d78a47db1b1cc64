"""What the emulated controller remembers: volatile and non-volatile parameters, axis names, digital lines."""

from __future__ import annotations

import pytest

from microdrivers.fakes.pi_gcs.codes import ErrorCode
from tests.fakes.gcs_bench import GcsBench


@pytest.fixture
def bench() -> GcsBench:
    return GcsBench()


def reboot(bench: GcsBench) -> None:
    assert bench.error_after("RBT") == 0


# ---------------------------------------------------------------------- parameters


def test_saved_parameters_survive_a_reboot(bench: GcsBench) -> None:
    assert bench.error_after("SPA 1 0x36 9 2 0x36 8") == 0
    assert bench.error_after("VEL 1 0.25") == 0
    assert bench.line("SEP? 1 0x36") == "1 0x36=3"
    assert bench.error_after("WPA 100 1 0x36") == 0
    assert bench.line("SEP? 1 0x36 2 54") == "1 0x36=9 \n2 54=3"
    reboot(bench)
    assert bench.line("SPA? 1 0x36 2 0x36") == "1 0x36=9 \n2 0x36=3"
    assert bench.line("VEL? 1") == "1=0.7500000"
    bench.line("VEL 1 0.25")
    bench.line("WPA 100")
    reboot(bench)
    assert bench.line("VEL? 1") == "1=0.2500000"


def test_non_volatile_parameters_become_active_by_reset_or_reboot(bench: GcsBench) -> None:
    assert bench.error_after("SEP 100 1 0x32 1 1 0x14 0") == 0
    assert bench.line("LIM? 1") == "1=1"
    assert bench.error_after("RPA 1 0x32") == 0
    assert bench.line("LIM? 1") == "1=0"
    assert bench.line("TRS? 1") == "1=1"
    assert bench.error_after("RPA") == 0
    assert bench.line("TRS? 1") == "1=0"
    assert len(bench.line("SEP?").split(" \n")) == len(bench.line("SPA?").split(" \n"))


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("WPA", 26),
        ("WPA 99", 56),
        ("WPA 100 1", 26),
        ("WPA 100 1 0x99", 54),
        ("SEP 99 1 0x36 4", 56),
        ("SEP 100 1 0x36", 26),
        ("SEP 100 1 0xA 4", 60),
        ("SEP 100 7 0x36 4", 15),
        ("RPA 1 0x99", 54),
        ("SEP? 1", 26),
    ],
)
def test_what_memory_refuses(bench: GcsBench, command: str, code: int) -> None:
    assert bench.error_after(command) == code
    assert bench.line("SEP? 1 0x36") == "1 0x36=3"


def test_a_stage_is_renamed_by_its_parameter(bench: GcsBench) -> None:
    assert bench.error_after("SPA 1 0x3C TEMP") == 0
    assert bench.line("CST? 1") == "1=TEMP"
    assert bench.error_after("CST 1 M-111.1DG") == 2


# ---------------------------------------------------------------------- names of axes


def test_axes_are_renamed(bench: GcsBench) -> None:
    assert bench.error_after("SAI 1 X 2 1") == 0
    assert bench.line("SAI?") == "X \n1 \n3"
    assert bench.line("CST? 1 X") == "1=M-111.1DG \nX=M-111.1DG"
    bench.line("SVO X 1")
    assert bench.controller.events[-1][1] == "servo x on"
    assert bench.error_after("SVO 2 1") == 15
    reboot(bench)
    assert bench.line("SAI?") == "1 \n2 \n3"
    bench.line("SAI 3 theta")
    bench.line("WPA 100")
    reboot(bench)
    assert bench.line("SAI?") == "1 \n2 \ntheta"


@pytest.mark.parametrize(
    ("command", "code"),
    [("SAI 1", 26), ("SAI 4 X", 15), ("SAI 1 $", 15), ("SAI 1 NINECHARS", 15), ("SAI 1 2", 22), ("SAI 1 X 2 X", 22)],
)
def test_impossible_names_are_refused(bench: GcsBench, command: str, code: int) -> None:
    assert bench.error_after(command) == code
    assert bench.line("SAI?") == "1 \n2 \n3"


# ---------------------------------------------------------------------- digital lines


def test_digital_lines_are_there_but_nothing_is_wired_to_them(bench: GcsBench) -> None:
    assert bench.line("TIO?") == "I=4 \nO=4"
    assert bench.line("DIO?") == "1=0 \n2=0 \n3=0 \n4=0"
    assert bench.line("DIO? 3") == "3=0"
    assert bench.line("DIO? 0") == "0=0"
    assert bench.error_after("DIO 1 1 4 0") == 0
    assert bench.line("DIO? 1") == "1=0"


def test_trigger_settings_are_kept_until_a_reboot(bench: GcsBench) -> None:
    assert bench.line("CTO? 2 1 2 3") == "2 1=0.1000000 \n2 3=0"
    assert bench.error_after("CTO 2 3 8 2 10 7.25 2 2 3") == 0
    assert bench.error_after("TRO 2 1") == 0
    assert bench.line("CTO? 2 2 2 3 2 10") == "2 2=3 \n2 3=8 \n2 10=7.2500000"
    assert bench.line("TRO?") == "1=0 \n2=1 \n3=0 \n4=0"
    assert len(bench.line("CTO?").split(" \n")) == 4 * 7
    reboot(bench)
    assert bench.line("TRO? 2") == "2=0"
    assert bench.line("CTO? 2 3") == "2 3=0"


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("CTO 1 3", 26),
        ("CTO 5 3 0", 17),
        ("CTO 1 4 0", 54),
        ("CTO 1 3 1", 17),
        ("CTO 1 2 9", 15),
        ("CTO 1 7 2", 17),
        ("CTO 1 1 x", 25),
        ("CTO 1 3 8 1 4 0", 54),
        ("TRO 1 2", 17),
        ("TRO 0 1", 17),
        ("DIO 5 1", 17),
        ("DIO? 5", 17),
        ("TIO? 1", 24),
    ],
)
def test_what_digital_lines_refuse(bench: GcsBench, command: str, code: int) -> None:
    assert bench.error_after(command) == code
    assert bench.line("CTO? 1 3") == "1 3=0"


def test_no_error_number_is_negative() -> None:
    assert min(ErrorCode) == 0
