"""The emulated analogue-input module behind its wire, in a world with forces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import serial

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.drivers import WorldRequest
from microdrivers.fakes.modbus import frame
from microdrivers.fakes.wire import wire_named
from microdrivers.fakes.world import MicroscopeWorld, WorldSettings
from microdrivers.fakes.world.settings import ForceWorld
from tests.fakes.analogue_bench import NAME, SECTION, ForceOnlyWorld, attach, module_behind, port_behind

READ_FIRST = frame(1, bytes.fromhex("04 00 00 00 01"))


class Rig:
    """The emulator as a rig gets it, and a pyserial port on its wire."""

    def __init__(self, world: Any, **changes: Any) -> None:
        self.clock = SimulatedClock(5 * NS_PER_S)
        self.world = world
        self.emulation = attach(self.clock, world, **changes)
        self.port = serial.serial_for_url(self.emulation.overrides["connection"]["port"], timeout=0.1)

    def ask(self, request: bytes, size: int, pause_s: float = 0.01) -> bytes:
        with self.clock.transaction():
            self.port.write(request)
            reply = bytes(self.port.read(size))
        self.clock.sleep(pause_s)
        return reply

    def reading(self, pause_s: float = 0.03) -> int:
        return int.from_bytes(self.ask(READ_FIRST, 7, pause_s)[3:5], "big")

    def close(self) -> None:
        self.port.close()
        self.emulation.close()


@pytest.fixture
def rigs() -> Iterator[list[Rig]]:
    made: list[Rig] = []
    yield made
    for rig in made:
        rig.close()


@pytest.mark.parametrize(("force_uN", "mV"), [(0.0, 2500), (40.0, 3300), (-100.0, 500), (125.0, 5000), (900.0, 5000)])
def test_a_force_is_a_voltage(rigs: list[Rig], force_uN: float, mV: int) -> None:
    rigs.append(Rig(ForceOnlyWorld(force_uN)))
    assert rigs[0].reading() == pytest.approx(mV, abs=1)


def test_the_sensor_s_range_decides_the_module_s(rigs: list[Rig]) -> None:
    rigs.append(Rig(ForceOnlyWorld(-900.0), range_V=[1.0, 5.0], channel=4))
    assert module_behind().range_codes == [1] * 8
    words = np.frombuffer(rigs[0].ask(frame(1, bytes.fromhex("04 00 00 00 08")), 21)[3:-2], ">u2")
    assert words[3] == pytest.approx(1000, abs=1)
    assert np.all(np.delete(words, 3) < 10)
    module_behind().disconnect()
    assert rigs[0].ask(frame(1, bytes.fromhex("04 00 03 00 01")), 7)[3:5] == bytes(2)


@pytest.mark.parametrize(("range_V", "code", "word"), [([0, 5], 8, 43581), ([-5, 5], 9, 54395)])
def test_the_other_model_has_its_own_ranges(rigs: list[Rig], range_V: list[float], code: int, word: int) -> None:
    rigs.append(Rig(ForceOnlyWorld(40.0), model="adam-4117", range_V=range_V))
    assert module_behind().range_codes == [code] * 8
    assert rigs[0].reading() == word


def test_noise_of_the_world_is_in_the_readings(rigs: list[Rig]) -> None:
    noisy = ForceWorld(noise_uN_per_sqrt_Hz={NAME: 1.0}, drift_uN_per_min=0.0, zero_spread_uN=0.0)
    rigs.append(Rig(ForceOnlyWorld(force=noisy)))
    readings = np.array([rigs[0].reading() for _ in range(600)])
    assert readings.std() == pytest.approx(1000.0 * 30.0**0.5 / 50.0, rel=0.15)
    assert readings.mean() == pytest.approx(2500.0, abs=20.0)


def test_a_sensor_without_a_noise_of_its_own_has_the_usual_one(rigs: list[Rig]) -> None:
    noisy = ForceWorld(
        noise_uN_per_sqrt_Hz={"other": 5.0}, default_noise_uN_per_sqrt_Hz=0.5, drift_uN_per_min=0, zero_spread_uN=0
    )
    rigs.append(Rig(ForceOnlyWorld(force=noisy)))
    readings = np.array([rigs[0].reading() for _ in range(300)])
    assert readings.std() == pytest.approx(500.0 * 30.0**0.5 / 50.0, rel=0.2)


def test_a_world_without_settings_is_no_perfect_one(rigs: list[Rig]) -> None:
    class Bare:
        def force_uN(self, sensor: str, t_ns: int) -> float:
            return 0.0

        def close(self) -> None: ...

    rigs.append(Rig(Bare()))
    readings = np.array([rigs[0].reading() for _ in range(200)])
    assert readings.std() == pytest.approx(70.0 * 30.0**0.5 / 50.0, rel=0.3)
    assert abs(readings.mean() - 2500.0) > 3.0


def test_fast_polls_read_a_conversion_twice(rigs: list[Rig]) -> None:
    noisy = ForceWorld(noise_uN_per_sqrt_Hz={NAME: 1.0})
    rigs.append(Rig(ForceOnlyWorld(force=noisy)))
    start_ns = rigs[0].clock.now_ns()
    readings = [rigs[0].reading(0.002) for _ in range(200)]
    conversions = (rigs[0].clock.now_ns() - start_ns) / 10_000_000
    changes = np.count_nonzero(np.diff(readings))
    assert 0.85 * conversions < changes <= conversions + 1 < 150


def test_a_tip_that_is_pressed_against_the_obstacle_is_felt(rigs: list[Rig]) -> None:
    clock = SimulatedClock()
    axis = {"travel_um": [-625, 625]}
    section = {**SECTION, "axis": [0, 0, 1], "stiffness_uN_per_um": 1000.0}
    devices = {"gripper_stage": {"axes": {"x": axis, "y": axis, "z": axis}}, NAME: section}
    settings = WorldSettings(force=ForceWorld(noise_uN_per_sqrt_Hz={NAME: 0.0}, drift_uN_per_min=0, zero_spread_uN=0))
    request = WorldRequest(settings=settings, rig={"devices": devices}, seed=1, clock=clock, bus=Bus())
    world = MicroscopeWorld(request)
    rigs.append(Rig(world))
    assert rigs[0].reading() == 2500
    tip = world.fine_stage_axes["gripper_stage"]["z"]
    end_ns = tip.move(rigs[0].clock.now_ns(), -201.0, speed=1000.0, acceleration=1e5)
    rigs[0].clock.sleep((end_ns - rigs[0].clock.now_ns()) / NS_PER_S + 0.1)
    assert rigs[0].reading() == pytest.approx(2500 + 1000 / 50 / (1 / 50 + 1 / 1000), abs=1)


@pytest.mark.parametrize(("parity", "bits"), [("E", 11), ("O", 11), ("N", 10)])
def test_parity_decides_how_long_a_byte_takes(rigs: list[Rig], parity: str, bits: int) -> None:
    rigs.append(Rig(ForceOnlyWorld(), connection={"parity": parity, "baudrate": 9600}))
    assert port_behind().byte_ns == round(bits * NS_PER_S / 9600)


@pytest.mark.parametrize(("baudrate", "at_least_s", "at_most_s"), [(9600, 0.0194, 0.023), (115200, 0.0032, 0.006)])
def test_a_reading_takes_the_time_of_its_line(
    rigs: list[Rig], baudrate: int, at_least_s: float, at_most_s: float
) -> None:
    """8 bytes, 3.5 of silence (1.75 ms on fast lines), up to 0.9 ms of work, 7 bytes in pieces."""
    rigs.append(Rig(ForceOnlyWorld(), connection={"baudrate": baudrate}))
    start_ns = rigs[0].clock.now_ns()
    rigs[0].ask(READ_FIRST, 7, 0.0)
    assert at_least_s < (rigs[0].clock.now_ns() - start_ns) / NS_PER_S < at_most_s


def test_it_works_behind_a_gateway(rigs: list[Rig]) -> None:
    rigs.append(Rig(ForceOnlyWorld(40.0), connection={"framing": "tcp"}))
    request = bytes.fromhex("00 07 00 00 00 06 01 04 00 00 00 01")
    reply = rigs[0].ask(request, 11)
    assert reply[:9] == bytes.fromhex("00 07 00 00 00 05 01 04 02")
    assert int.from_bytes(reply[9:], "big") == pytest.approx(3300, abs=1)
    assert {direction for _, direction, _ in rigs[0].emulation.wire_log} == {"host", "device"}


def test_closing_forgets_the_wire_but_not_a_successor() -> None:
    clock = SimulatedClock()
    first, second = attach(clock, ForceOnlyWorld()), attach(clock, ForceOnlyWorld())
    first.close()
    assert wire_named(NAME) is not None
    second.close()
    assert wire_named(NAME) is None


def test_a_world_without_forces_is_refused() -> None:
    with pytest.raises(UnsupportedError, match="no forces"):
        attach(SimulatedClock(), object())


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"unit_id": 248}, "unit_id"),
        ({"channel": 9}, "channel"),
        ({"channel": 0}, "channel"),
        ({"model": "unknown"}, "model"),
        ({"connection": {"baudrate": 12345}}, "connection.baudrate"),
        ({"connection": {"baudrate": 256000}, "model": "adam-4117"}, "connection.baudrate"),
        ({"connection": {"framing": "ascii"}}, "connection.framing"),
        ({"range_V": [0.0, 10.0]}, "range_V"),
        ({"range_V": [-11.0, 10.0], "model": "adam-4117"}, "range_V"),
        ({"sensitivity_uN_per_V": 0.0}, "sensitivity_uN_per_V"),
        ({"bandwidth_hz": 0.0}, "bandwidth_hz"),
    ],
)
def test_what_a_module_cannot_be_set_to_is_refused(changes: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as caught:
        attach(SimulatedClock(), ForceOnlyWorld(), **changes)
    assert caught.value.key == key
    assert caught.value.remedy
