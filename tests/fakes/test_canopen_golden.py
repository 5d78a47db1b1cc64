"""The emulated drive and amplifier answer as the transcripts of a reference node do, byte for byte."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from microdrivers.fakes.canopen import PROMPT
from microdrivers.fakes.cia404 import Amplifier, InputSpec
from tests.fakes.canopen_bench import NodeBench, shown
from tests.fakes.drive_bench import SPEC, DriveBench

STRINGS_AND_ABORTS = """
605 [8] 40 08 10 00 00 00 00 00
585 [8] 41 08 10 00 0E 00 00 00
605 [8] 60 00 00 00 00 00 00 00
585 [8] 00 46 41 4B 45 2D 44 52
605 [8] 70 00 00 00 00 00 00 00
585 [8] 11 49 56 45 2D 34 30 32
605 [8] 2B 41 60 00 01 00 00 00
585 [8] 80 41 60 00 02 00 01 06
605 [8] 40 FF 5F 00 00 00 00 00
585 [8] 80 FF 5F 00 00 00 02 06
"""

PDO_PARAMETERS = """
605 [8] 40 00 14 01 00 00 00 00
585 [8] 43 00 14 01 05 02 00 00
605 [8] 40 00 14 02 00 00 00 00
585 [8] 4F 00 14 02 FF 00 00 00
605 [8] 40 00 16 00 00 00 00 00
585 [8] 4F 00 16 00 02 00 00 00
605 [8] 40 00 16 01 00 00 00 00
585 [8] 43 00 16 01 10 00 40 60
605 [8] 40 00 16 02 00 00 00 00
585 [8] 43 00 16 02 08 00 60 60
605 [8] 40 01 14 01 00 00 00 00
585 [8] 43 01 14 01 05 03 00 00
605 [8] 40 01 16 01 00 00 00 00
585 [8] 43 01 16 01 20 00 7A 60
605 [8] 40 01 16 02 00 00 00 00
585 [8] 43 01 16 02 20 00 81 60
605 [8] 40 00 18 01 00 00 00 00
585 [8] 43 00 18 01 85 01 00 00
605 [8] 40 00 1A 00 00 00 00 00
585 [8] 4F 00 1A 00 02 00 00 00
605 [8] 40 00 1A 01 00 00 00 00
585 [8] 43 00 1A 01 10 00 41 60
605 [8] 40 00 1A 02 00 00 00 00
585 [8] 43 00 1A 02 08 00 61 60
605 [8] 40 01 18 01 00 00 00 00
585 [8] 43 01 18 01 85 02 00 00
605 [8] 40 01 1A 01 00 00 00 00
585 [8] 43 01 1A 01 20 00 64 60
605 [8] 40 01 1A 02 00 00 00 00
585 [8] 43 01 1A 02 20 00 6C 60
"""

ENABLE_BY_PDO = """
000 [2] 01 05
080 [0]
185 [3] 50 02 00
205 [3] 06 00 00
080 [0]
185 [3] 31 02 00
205 [3] 07 00 00
080 [0]
185 [3] 33 02 00
205 [3] 0F 00 00
080 [0]
185 [3] 37 02 00
605 [8] 40 02 65 00 00 00 00 00
585 [8] 43 02 65 00 21 00 00 00
205 [3] 0F 00 06
080 [0]
185 [3] 37 06 06
205 [3] 1F 00 06
080 [0]
185 [3] 37 02 06
"""

HOMED_THEN_POSITION = """
080 [0]
185 [3] 37 16 06
205 [3] 1F 00 06
080 [0]
185 [3] 37 16 06
205 [3] 1F 00 01
080 [0]
185 [3] 37 06 01
205 [3] 0F 00 01
080 [0]
185 [3] 37 06 01
605 [8] 23 7A 60 00 40 9C 00 00
585 [8] 60 7A 60 00 00 00 00 00
205 [3] 3F 00 01
605 [8] 40 41 60 00 00 00 00 00
585 [8] 4B 41 60 00 37 12 00 00
205 [3] 2F 00 01
605 [8] 40 41 60 00 00 00 00 00
585 [8] 4B 41 60 00 37 02 00 00
"""

ARRIVED = """
605 [8] 40 41 60 00 00 00 00 00
585 [8] 4B 41 60 00 37 06 00 00
605 [8] 40 64 60 00 00 00 00 00
585 [8] 43 64 60 00 40 9C 00 00
"""

FAULT_AND_RESET = """
080 [0]
185 [3] 18 06 01
205 [3] 00 00 01
080 [0]
185 [3] 18 06 01
205 [3] 80 00 01
085 [8] 00 00 00 00 00 00 00 00
080 [0]
185 [3] 50 06 01
205 [3] 06 00 01
080 [0]
185 [3] 31 06 01
205 [3] 07 00 01
080 [0]
185 [3] 33 06 01
205 [3] 0F 00 01
080 [0]
185 [3] 37 06 01
"""

FORCE_OBJECTS = """
607 [8] 40 00 10 00 00 00 00 00
587 [8] 43 00 10 00 94 01 02 00
607 [8] 40 31 61 01 00 00 00 00
587 [8] 43 31 61 01 00 00 21 F7
607 [8] 40 32 61 01 00 00 00 00
587 [8] 4F 32 61 01 00 00 00 00
607 [8] 40 30 91 01 00 00 00 00
587 [8] 43 30 91 01 39 30 00 00
607 [8] 23 25 61 01 7A 65 72 6F
587 [8] 60 25 61 01 00 00 00 00
607 [8] 23 25 61 01 61 62 63 64
587 [8] 80 25 61 01 30 00 09 06
"""

FORCE_AFTER_ZERO = """
607 [8] 40 30 91 01 00 00 00 00
587 [8] 43 30 91 01 00 00 00 00
607 [8] 40 00 18 01 00 00 00 00
587 [8] 43 00 18 01 87 01 00 00
607 [8] 40 00 18 02 00 00 00 00
587 [8] 4F 00 18 02 01 00 00 00
607 [8] 40 00 1A 00 00 00 00 00
587 [8] 4F 00 1A 00 02 00 00 00
607 [8] 40 00 1A 01 00 00 00 00
587 [8] 43 00 1A 01 20 01 30 91
607 [8] 40 00 1A 02 00 00 00 00
587 [8] 43 00 1A 02 08 01 50 61
000 [2] 01 07
"""


def play(bench: NodeBench, transcript: str) -> None:
    """Put the master's frames; what the node sends must be the lines that follow."""
    lines = transcript.strip().splitlines()
    sent: list[str] = []
    masters = {0x000, 0x080, *range(0x200, 0x280), *range(0x600, 0x680)}
    for line in lines:
        identifier = int(line[:3], 16)
        if identifier in masters:
            assert sent == [], f"before {line}"
            sent = [shown(frame) for frame in bench.put(identifier, line[7:])]
        else:
            assert sent, f"nothing was sent where {line} should be"
            assert sent.pop(0) == line
    assert sent == []


def until(bench: NodeBench, asked: tuple[int, str], meanwhile: set[str], reply: str) -> None:
    """Ask every millisecond until the reply comes; only certain others may come before."""
    for _ in range(5000):
        (frame,) = bench.put(*asked)
        if shown(frame) == reply:
            return
        assert shown(frame) in meanwhile, shown(frame)
        bench.wait_ms(1)
    raise AssertionError(f"{reply} never came")


@pytest.fixture
def drive() -> DriveBench:
    """As in the transcript: TPDO1 on every SYNC, TPDO2 silent; a home position within reach."""
    bench = DriveBench(spec=replace(SPEC, travel_um=(-625.0, 2500.0)), at_um=-624.0)
    play(bench, PDO_PARAMETERS)
    bench.write(0x1800, 1, 1, 2)
    bench.write(0x1801, 0x80000285, 4, 1)
    bench.write(0x6098, 17, 1)
    bench.write(0x6067, 10, 4)
    return bench


def test_strings_and_aborts() -> None:
    play(DriveBench(), STRINGS_AND_ABORTS)


def test_homing_position_fault_and_reset_by_pdo(drive: DriveBench) -> None:
    play(drive, ENABLE_BY_PDO)
    sync, status = (0x080, ""), (0x605, "40 41 60 00 00 00 00 00")
    until(drive, sync, {"185 [3] 37 02 06", "185 [3] 37 12 06"}, "185 [3] 37 16 06")
    drive.wait_ms(50)
    play(drive, HOMED_THEN_POSITION)
    until(drive, status, {"585 [8] 4B 41 60 00 37 02 00 00"}, "585 [8] 4B 41 60 00 37 06 00 00")
    drive.wait_ms(100)
    play(drive, ARRIVED)
    drive.drive.inject_fault(drive.t_ns, 0x7300, info=bytes((1, 2, 3, 4, 5)), register=0x20)
    assert [shown(frame) for frame in drive.wait_ms(1)] == ["085 [8] 00 73 20 01 02 03 04 05"]
    play(drive, FAULT_AND_RESET)


def test_a_start_bit_that_homing_has_left_set_starts_nothing(drive: DriveBench) -> None:
    """Transcript 3: 003Fh after 001Fh has no edge."""
    drive.write(0x1800, 255, 1, 2)
    drive.operational()
    for word in ("06 00 00", "07 00 00", "0F 00 00", "0F 00 06", "1F 00 06"):
        drive.put(0x205, word)
    drive.until(lambda: drive.status() == 0x1637)
    drive.wait_ms(50)
    frames = drive.put(0x205, "1F 00 01")
    assert [shown(frame) for frame in frames] == ["185 [3] 37 06 01"]
    drive.write(0x607A, 40000, 4)
    drive.put(0x205, "3F 00 01")
    drive.wait_ms(1000)
    assert drive.status() == 0x0637
    drive.put(0x205, "2F 00 01")
    assert abs(drive.position()) < 10


def test_amplifier() -> None:
    volts = 2.25 + 12.345 / 1000
    spec = InputSpec(zero_V=2.25, sensitivity_uN_per_V=1000.0, input_V=(0.0, 4.5), resolution_V=1e-6)
    amplifier = Amplifier(lambda _t_ns: volts, spec, node_id=7, seed=1, temper=PROMPT)
    bench = NodeBench(amplifier.node)
    play(bench, FORCE_OBJECTS)
    bench.wait_ms(20)
    play(bench, FORCE_AFTER_ZERO)
    volts += 0.655 / 1000
    bench.wait_ms(1)
    assert [shown(frame) for frame in bench.sync()] == ["187 [5] 8F 02 00 00 00"]


def test_amplifier_in_micronewton_with_three_digits() -> None:
    spec = InputSpec(zero_V=2.25, sensitivity_uN_per_V=1000.0, input_V=(0.0, 4.5), resolution_V=1e-6)
    amplifier = Amplifier(lambda _t_ns: 2.25 + 12.345 / 1000, spec, node_id=7, seed=1, temper=PROMPT)
    bench = NodeBench(amplifier.node)
    factor, offset = (int.from_bytes(struct.pack("<f", value), "little") for value in (1000.0, -2250.0))
    for index, value, size in ((0x6131, 0xFA210000, 4), (0x6132, 3, 1), (0x6126, factor, 4), (0x6127, offset, 4)):
        assert bench.write(index, value, size, 1) == 0
    assert bench.ask("40 30 91 01 00 00 00 00") == "43 30 91 01 39 30 00 00"
    assert bench.read_real(0x6130, 1) == pytest.approx(12.345, abs=1e-4)
