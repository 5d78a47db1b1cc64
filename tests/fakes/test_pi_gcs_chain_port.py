"""The chain of emulated controllers behind a rig file's port: what it is built from, and replies on the clock."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydantic
import pytest
import serial
import yaml

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import EmulationRequest
from microdrivers.fakes.pi_gcs import EMULATOR
from microdrivers.fakes.pi_gcs.daisy_chain import DaisyChain
from microdrivers.fakes.pi_gcs.settings import StageSettings
from microdrivers.fakes.wire import wire_named
from tests.fakes.gcs_bench import Bench, BenchWorld, chained_settings, stage_settings

RIG_FILE = Path(__file__).parents[1] / "data/chained_workstation.yaml"


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock(start_ns=NS_PER_S)


@pytest.fixture
def port(clock: SimulatedClock) -> Iterator[serial.SerialBase]:
    emulation = EMULATOR.attach(
        EmulationRequest(name="stage", settings=chained_settings(), world=BenchWorld(), seed=3, clock=clock, bus=Bus())
    )
    with serial.serial_for_url(emulation.overrides["connection"]["port"], timeout=0.5) as port:
        yield port
    emulation.close()


def test_replies_of_different_controllers_do_not_mix(clock: SimulatedClock, port: serial.SerialBase) -> None:
    orders = set()
    for _ in range(60):
        with clock.transaction():
            port.write(b"1 POS? 1\n3 TIO?\n2 SAI?\n2 \x07")
            received = b"".join(port.read_until(b"\n") for _ in range(5))
        replies = re.fullmatch(rb"(?:(0 1 1=0\.0000000\n)|(0 3 I=4 \nO=4\n)|(0 2 1\n)|(0 2 \xb1\n)){4}", received)
        assert replies is not None, received
        assert all(replies.groups())
        orders.add(received)
        clock.sleep(0.01)
    assert len(orders) > 3
    wire = wire_named("stage")
    assert wire is not None
    assert isinstance(wire.emulator, DaisyChain)
    for (first_ns, side, _), (next_ns, next_side, data) in itertools.pairwise(wire.log):
        if side == next_side == "device":
            assert next_ns - first_ns >= len(data) * wire.byte_ns


def test_a_stop_needs_no_reply(clock: SimulatedClock, port: serial.SerialBase) -> None:
    port.write(b"2 SVO 1 1\n2 FRF 1\n")
    clock.sleep(0.5)
    port.write(b"2 \x18")
    clock.sleep(0.1)
    wire = wire_named("stage")
    assert wire is not None
    assert isinstance(wire.emulator, DaisyChain)
    assert wire.emulator.boxes["y"].events[-1][1] == "stop #24"
    assert wire.emulator.events[-1][1] == "stop #24"


# ---------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"x": {"address": None}}, "address of its own"),
        ({"x": {"address": 3}}, "address of its own"),
        ({"x": {"address": 0}}, "greater than or equal to 1"),
        ({"x": {"address": 17}}, "less than or equal to 16"),
        ({key: {"address": None} for key in ("x", "y", "theta")}, "different ids"),
    ],
)
def test_impossible_chains_are_refused(changes: dict[str, dict[str, Any]], complaint: str) -> None:
    wrong = chained_settings()
    for key, change in changes.items():
        wrong["axes"][key] |= change
    with pytest.raises(pydantic.ValidationError, match=complaint):
        StageSettings.model_validate(wrong)


def test_addresses_may_be_any_and_identifiers_differ() -> None:
    other = chained_settings()
    for key, address, name in (("x", 16, "X"), ("y", 5, "Y"), ("theta", 2, "T")):
        other["axes"][key] |= {"address": address, "id": name}
    bench = Bench(other, None, seed=1)
    assert bench.line("16 POS?") == "0 16 X=0.0000000"
    assert bench.line("5 POS? Y") == "0 5 Y=0.0000000"
    assert bench.line("2 SAI?") == "0 2 T"
    assert bench.line("CSV?") == ""


def test_without_addresses_there_is_one_controller() -> None:
    assert not StageSettings.model_validate(stage_settings()).chained


def test_the_chained_workstation_has_three_controllers() -> None:
    rig = yaml.safe_load(RIG_FILE.read_text(encoding="utf-8"))
    bench = Bench(rig["devices"]["sample_stage"], None, seed=1)
    assert isinstance(bench.emulator, DaisyChain)
    assert list(bench.emulator.boxes) == ["x", "y", "theta"]
    assert bench.line("3 *IDN?").endswith("Karlsruhe, C-863.12,0115500622,1.2.0.0")
    assert bench.line("3 SAI?") == "0 3 1"
