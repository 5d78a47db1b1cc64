"""The emulated AZ drive answers as the transcripts of its protocol do, over RTU and behind a Modbus TCP gateway."""

from __future__ import annotations

import pytest

from tests.fakes.az_bench import HOME_END, IN_POSITION, MOVE, READY, AzBench, GatewayBench

STATUS = "01 03 00 7E 00 02 A4 13"
DIAGNOSE = "01 08 00 00 12 34 ED 7C"
MOVE_TO_8500 = (
    "01 10 00 58 00 10 20 00 00 00 00 00 00 00 01 00 00 21 34 00 00 4E 20 00 0F 42 40 00 0F 42 40"
    " 00 00 03 E8 00 00 00 01 C3 F8"
)


@pytest.fixture(params=[AzBench, GatewayBench])
def bench(request: pytest.FixtureRequest) -> AzBench:
    made = request.param()
    assert isinstance(made, AzBench)
    return made


def test_golden_direct_data_and_positions(bench: AzBench) -> None:
    assert bench.ask_hex(MOVE_TO_8500) == "01 10 00 58 00 10 40 16"
    bench.wait_ms(1000)
    for address in ("00 C6 00 02 24 36", "00 CC 00 02 04 34"):
        assert bench.ask_hex("01 03 " + address) == "01 03 04 00 00 21 34 E3 B4"


def test_golden_status_without_coordinates(bench: AzBench) -> None:
    bench.drive.lose_coordinates(bench.t_ns)
    assert bench.ask_hex(STATUS) == "01 03 04 00 00 40 20 CA 2B"
    assert bench.move(8500, kind=2) == 0
    assert bench.ask_hex(STATUS) == "01 03 04 00 00 20 00 E3 F3"
    assert bench.ask_hex("01 17 00 7E 00 02 00 7C 00 02 04 00 00 00 00 68 99") == "01 17 04 00 00 20 00 E0 E7"
    bench.wait_ms(1000)
    assert bench.ask_hex(STATUS) == "01 03 04 00 00 40 20 CA 2B"


def test_golden_status_with_coordinates(bench: AzBench) -> None:
    assert bench.ask_hex("01 03 00 7F 00 01 B5 D2") == "01 03 02 40 30 89 90"
    assert bench.outputs() == IN_POSITION | READY | HOME_END
    bench.move(8500)
    assert bench.outputs() == MOVE | HOME_END


def test_golden_incremental_block(bench: AzBench) -> None:
    block = (
        "01 10 00 58 00 10 20 00 00 00 00 00 00 00 02 00 00 21 34 00 00 07 D0 00 00 05 DC 00 00 05 DC"
        " 00 00 03 E8 00 00 00 01 1C 08"
    )
    for turn in (1, 2):
        assert bench.ask_hex(block) == "01 10 00 58 00 10 40 16"
        assert bench.read(0x66) == 0
        bench.wait_ms(8000)
        assert bench.read(0xC6) == 8500 * turn


@pytest.mark.parametrize("request_hex", ["01 06 00 7D 00 10 18 1E", "01 06 00 7D 00 00 19 D2", DIAGNOSE])
def test_golden_echoes(bench: AzBench, request_hex: str) -> None:
    assert bench.ask_hex(request_hex) == request_hex


def test_golden_alarm_and_reset(bench: AzBench) -> None:
    bench.drive.raise_alarm(bench.t_ns, 0x30)
    bench.wait_ms(10)
    assert bench.ask_hex("01 03 00 80 00 02 C5 E3") == "01 03 04 00 00 00 30 FA 27"
    for request_hex in ("01 06 00 7D 00 80 18 72", "01 06 00 7D 00 00 19 D2"):
        assert bench.ask_hex(request_hex) == request_hex
    assert bench.ask_hex("01 03 00 80 00 02 C5 E3") == "01 03 04 00 00 00 00 FA 33"


def test_golden_exceptions(bench: AzBench) -> None:
    assert bench.ask_hex("01 03 05 00 00 02 C4 C7") == "01 83 02 C0 F1"
    no_rate = MOVE_TO_8500.replace("00 0F 42 40 00 0F 42 40", "00 00 00 00 00 0F 42 40")
    assert bench.ask_hex(no_rate.replace("C3 F8", "30 7E")) == "01 90 04 4D C3"
    assert bench.read(0xAC) == 0x8C
    assert bench.drive.log == []
    assert bench.ask_hex("01 01 00 00 00 08 3D CC") == "01 81 01 81 90"
