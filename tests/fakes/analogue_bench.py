"""An emulated analogue-input module on the bench, with a probe that is pushed as a test likes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from microdrivers.core.bus import Bus
from microdrivers.core.clock import Clock
from microdrivers.devices.drivers import Emulation, EmulationRequest
from microdrivers.fakes.modbus import TcpGateway
from microdrivers.fakes.modbus_analogue import EMULATOR, AnalogueModule, AnaloguePort
from microdrivers.fakes.wire import wire_named
from microdrivers.fakes.world.settings import ForceWorld

NAME = "gripper_force"
PERFECT = ForceWorld(
    noise_uN_per_sqrt_Hz={}, default_noise_uN_per_sqrt_Hz=0.0, drift_uN_per_min=0.0, zero_spread_uN=0.0
)
SECTION: Mapping[str, Any] = {
    "connection": {"port": "/dev/ttyUSB2", "baudrate": 115200, "parity": "N", "framing": "rtu"},
    "unit_id": 1,
    "model": "waveshare-8ch",
    "channel": 1,
    "range_V": [0.0, 5.0],
    "zero_V": 2.5,
    "sensitivity_uN_per_V": 50.0,
    "range_uN": [-100.0, 100.0],
    "resolution_uN": 0.06,
    "bandwidth_hz": 30.0,
    "carried_by": "gripper_stage",
    "rate_hz": 30.0,
}


class ForceOnlyWorld:
    """A world that is nothing but a force: a number, or a function of the time in ns."""

    def __init__(self, force_uN: float | Callable[[int], float] = 0.0, *, force: ForceWorld = PERFECT) -> None:
        self.force = force_uN
        self.settings = SimpleNamespace(force=force)

    def force_uN(self, sensor: str, t_ns: int) -> float:
        assert sensor == NAME
        return self.force(t_ns) if callable(self.force) else self.force

    def close(self) -> None: ...


def attach(clock: Clock, world: Any, *, connection: Mapping[str, Any] | None = None, **settings: Any) -> Emulation:
    """The emulator as a rig gets it, with a section that differs from `SECTION` as stated."""
    section = {**SECTION, **settings, "connection": {**SECTION["connection"], **(connection or {})}}
    return EMULATOR.attach(EmulationRequest(name=NAME, settings=section, world=world, seed=1, clock=clock, bus=Bus()))


def port_behind(name: str = NAME) -> AnaloguePort:
    """The module's port at the end of `fake://NAME`, with a gateway in front of it or not."""
    wire = wire_named(name)
    assert wire is not None
    slave = wire.emulator.slave if isinstance(wire.emulator, TcpGateway) else wire.emulator
    assert isinstance(slave, AnaloguePort)
    return slave


def module_behind(name: str = NAME) -> AnalogueModule:
    return port_behind(name).module
