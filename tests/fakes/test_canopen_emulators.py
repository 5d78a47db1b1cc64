"""The emulators of fine stages and force sensors on an emulated bus, as a rig builds them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import ConfigError, UnsupportedError
from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.devices.drivers import EmulationRequest
from microdrivers.fakes import cia402, cia404
from microdrivers.fakes.can import Frame, Port, medium_named
from microdrivers.fakes.canopen.attachment import NodeEmulation
from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.settings import ForceWorld

CONNECTION = {"interface": "socketcan", "channel": "can0", "bitrate": 500_000}
AXIS = {"counts_per_um": 20, "travel_um": [-625, 625], "homing_method": 17}
STAGE = {
    "driver": "cia402-fine-stage",
    "connection": CONNECTION,
    "axes": {"x": AXIS | {"node_id": 11}, "y": AXIS | {"node_id": 12}, "z": AXIS | {"node_id": 13, "direction": -1}},
    "heartbeat_ms": 100,
}
FORCE = {"driver": "cia404-force", "connection": CONNECTION, "node_id": 21, "range_uN": [-2000, 2000]}


class SmallWorld:
    """One stage; its z presses on a spring of 100 µN/µm."""

    def __init__(self) -> None:
        start = {"x": 10.0, "y": -20.0, "z": 30.0}
        self.fine_stage_axes = {"stage": {name: Axis(at, lag_s=0.002) for name, at in start.items()}}
        self.fine_stage_home_um = {"stage": dict.fromkeys(start, 0.0)}
        self.fine_stage_power_on_offset_um = {"stage": {name: -at for name, at in start.items()}}

    def force_uN(self, sensor: str, t_ns: int) -> float:
        assert sensor == "force"
        return 100.0 * max(0.0, 28.0 - self.fine_stage_axes["stage"]["z"].position_at(t_ns))

    def close(self) -> None: ...


class EmptyWorld:
    def close(self) -> None: ...


def request(name: str, settings: dict[str, Any], clock: Any, world: Any = None) -> EmulationRequest:
    return EmulationRequest(name=name, settings=settings, world=world or SmallWorld(), seed=7, clock=clock, bus=Bus())


class Rig:
    """Both devices on one bus, and a host's port."""

    def __init__(self, clock: Any) -> None:
        self.clock = clock
        self.world = SmallWorld()
        stage = cia402.EMULATOR.attach(request("stage", STAGE, clock, self.world))
        force = cia404.EMULATOR.attach(request("force", FORCE, clock, self.world))
        assert isinstance(stage, NodeEmulation)
        assert isinstance(force, NodeEmulation)
        self.stage, self.force = stage, force
        self.port: Port = stage.medium.open_port()

    def send(self, identifier: int, data: str = "") -> None:
        self.port.send(Frame(identifier, bytes.fromhex(data)))

    def listen(self, seconds: float) -> list[tuple[int, Frame]]:
        end_ns = self.clock.now_ns() + round(seconds * NS_PER_S)
        frames = []
        while (left_ns := end_ns - self.clock.now_ns()) > 0:
            arrival = self.port.receive(left_ns / NS_PER_S)
            if arrival is not None:
                frames.append((arrival.t_ns, arrival.frame))
        return frames

    def ask(self, node_id: int, data: str) -> str:
        self.send(0x600 + node_id, data)
        (_, frame), *_ = [item for item in self.listen(0.01) if item[1].id == 0x580 + node_id]
        return frame.data.hex(" ").upper()

    def write(self, node_id: int, index: int, sub: int, value: int, size: int) -> None:
        header = bytes((0x23 | (4 - size) << 2, index & 0xFF, index >> 8, sub))
        assert self.ask(node_id, (header + value.to_bytes(4, "little")).hex()).startswith("60")

    def close(self) -> None:
        self.port.close()
        self.force.close()
        self.stage.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig(SimulatedClock())
    yield made
    made.close()


def test_all_nodes_share_the_bus_and_boot(rig: Rig) -> None:
    assert rig.stage.overrides == {"connection": {"interface": "microdrivers", "channel": "socketcan:can0"}}
    assert rig.force.overrides == rig.stage.overrides
    assert rig.stage.medium is rig.force.medium is medium_named("socketcan:can0")
    assert sorted(frame.id for _, frame in rig.listen(0.01)) == [0x70B, 0x70C, 0x70D, 0x715]
    for node_id, serial in ((11, 4_020_011), (13, 4_020_013), (21, 4_040_021)):
        reply = bytes.fromhex(rig.ask(node_id, "40 18 10 04 00 00 00 00"))
        assert int.from_bytes(reply[4:], "little") == serial


def test_the_bus_is_gone_with_its_last_device(rig: Rig) -> None:
    rig.listen(0.01)
    rig.force.close()
    rig.send(0x615, "40 00 10 00 00 00 00 00")
    rig.send(0x60B, "40 00 10 00 00 00 00 00")
    assert [frame.id for _, frame in rig.listen(0.01)] == [0x58B]
    rig.stage.close()
    assert medium_named("socketcan:can0") is None


def test_drives_move_the_worlds_axes(rig: Rig) -> None:
    x, z = rig.world.fine_stage_axes["stage"]["x"], rig.world.fine_stage_axes["stage"]["z"]
    for node_id in (11, 13):
        rig.ask(node_id, "2F 60 60 00 01 00 00 00")
        for word in ("06", "07", "0F"):
            rig.ask(node_id, f"2B 40 60 00 {word} 00 00 00")
        rig.ask(node_id, "23 7A 60 00 D0 07 00 00")
        rig.ask(node_id, "2B 40 60 00 3F 00 00 00")
    rig.listen(2.0)
    now_ns = rig.clock.now_ns()
    assert x.position_at(now_ns) == pytest.approx(110.0, abs=0.1)
    assert z.position_at(now_ns) == pytest.approx(-70.0, abs=0.1)  # it counts against its axis
    assert rig.stage.devices["x"].log[-1][1] == "move 2000"
    reply = bytes.fromhex(rig.ask(21, "40 30 91 01 00 00 00 00"))
    raw_nN = int.from_bytes(reply[4:], "little", signed=True)
    assert raw_nN == pytest.approx(2_200_000, abs=10)  # 9800 µN are beyond what it can show
    assert rig.ask(21, "40 50 61 01 00 00 00 00")[-11:-9] == "03"


@pytest.mark.parametrize(("method", "direction"), [(17, 1), (17, -1), (18, 1), (24, -1), (34, 1)])
def test_after_homing_the_drives_zero_is_the_stages(method: int, direction: int) -> None:
    clock, world = SimulatedClock(), SmallWorld()
    axes = {"x": AXIS | {"node_id": 11, "homing_method": method, "direction": direction}}
    world.fine_stage_home_um["stage"]["x"] = 40.0
    emulation = cia402.EMULATOR.attach(request("stage", STAGE | {"axes": axes}, clock, world))
    assert isinstance(emulation, NodeEmulation)
    node = emulation.devices["x"].node
    dictionary = node.dictionary
    for index, value in ((0x6060, 6), (0x6040, 0x06), (0x6040, 0x0F), (0x6040, 0x1F)):
        with node.disturbing(clock.now_ns()) as t_ns:
            dictionary[index, 0].put(value, t_ns)
        clock.run_for(0.1)
    clock.run_for(30.0)
    true_um = world.fine_stage_axes["stage"]["x"].position_at(clock.now_ns())
    assert dictionary[0x6064, 0].get(clock.now_ns()) == pytest.approx(20 * direction * true_um, abs=2)
    assert emulation.devices["x"].homing.homed
    emulation.close()


def test_what_happens_to_a_device_is_heard_at_once(rig: Rig) -> None:
    rig.listen(0.5)
    t_ns = rig.clock.now_ns()
    rig.stage.devices["y"].inject_fault(t_ns, 0x2310)
    rig.force.devices["amplifier"].disconnect_sensor(t_ns)
    frames = rig.listen(0.01)
    assert {frame.id for _, frame in frames} == {0x08C, 0x095}
    assert all(0 < at_ns - t_ns < NS_PER_MS for at_ns, _ in frames)


def test_sync_at_100_hz_and_a_thousand_forces_a_second(rig: Rig) -> None:
    """Nothing is lost, doubled or out of order, and poses belong to their SYNC."""
    for node_id in (11, 12, 13):
        rig.write(node_id, 0x1802, 2, 1, 1)
        for number, cob_id in enumerate((0x80000180, 0x80000280, 0x380)):
            rig.write(node_id, 0x1800 + number, 1, cob_id + node_id, 4)
    rig.write(21, 0x1800, 2, 254, 1)
    rig.write(21, 0x1800, 5, 1, 2)
    rig.send(0x000, "01 00")
    beat = rig.clock.every(0.01, lambda: rig.send(0x080))
    frames = rig.listen(2.0)
    beat.cancel()
    counts = Counter(frame.id for _, frame in frames)
    assert counts[0x38B] == counts[0x38C] == counts[0x38D] == 200
    assert 1995 <= counts[0x195] <= 2001
    assert set(counts) == {0x38B, 0x38C, 0x38D, 0x195}
    times_ns = [at_ns for at_ns, _ in frames]
    assert times_ns == sorted(times_ns)
    assert 0.2 < rig.stage.medium.load(1.0) < 0.4


class RisingForce(EmptyWorld):
    """A force that rises by 0.1 µN a microsecond, and a perfect probe."""

    settings = SimpleNamespace(
        force=ForceWorld(noise_uN_per_sqrt_Hz={"force": 0.0}, drift_uN_per_min=0.0, zero_spread_uN=0.0)
    )

    def force_uN(self, sensor: str, t_ns: int) -> float:
        return t_ns / 10_000


def test_a_sensor_with_little_bandwidth_lags_behind() -> None:
    clock = SimulatedClock()
    for bandwidth_hz, lag_us in ((500.0, 318.0), (100.0, 1592.0)):
        settings = FORCE | {"bandwidth_hz": bandwidth_hz}
        emulation = cia404.EMULATOR.attach(request("force", settings, clock, RisingForce()))
        assert isinstance(emulation, NodeEmulation)
        node = emulation.devices["amplifier"].node
        value_nN = node.dictionary[0x9130, 1].get(10_000_000)
        assert value_nN == pytest.approx(100 * (10_000 - lag_us), abs=100 * 101)  # samples are up to 100 µs old
        assert node.dictionary[0x6126, 1].value == 1e6  # nN/V: 2 V are the range
        emulation.close()


@pytest.mark.parametrize(
    ("emulator", "settings"), [(cia402.EMULATOR, STAGE), (cia404.EMULATOR, FORCE)], ids=["stage", "force"]
)
def test_a_world_without_such_things(emulator: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(UnsupportedError, match="EmptyWorld has no"):
        emulator.attach(request("stage", settings, SimulatedClock(), EmptyWorld()))


@pytest.mark.parametrize(
    ("emulator", "settings", "key"),
    [
        (cia402.EMULATOR, STAGE | {"axes": {"x": AXIS | {"node_id": 128}}}, "axes.x.node_id"),
        (cia402.EMULATOR, STAGE | {"axes": {"x": AXIS | {"node_id": 1, "direction": 2}}}, "axes.x.direction"),
        (cia402.EMULATOR, STAGE | {"connection": {"interface": "socketcan"}}, "connection.channel"),
        (cia404.EMULATOR, FORCE | {"range_uN": [5, 5]}, "range_uN"),
        (cia404.EMULATOR, FORCE | {"bandwidth_hz": 0}, "bandwidth_hz"),
    ],
)
def test_settings_that_no_device_can_have(emulator: Any, settings: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as refused:
        emulator.attach(request("stage", settings, SimulatedClock()))
    assert refused.value.key == key


def test_two_drives_with_one_node_id_both_answer() -> None:
    clock = SimulatedClock()
    axes = {"x": AXIS | {"node_id": 11}, "y": AXIS | {"node_id": 11}}
    emulation = cia402.EMULATOR.attach(request("stage", STAGE | {"axes": axes}, clock))
    assert isinstance(emulation, NodeEmulation)
    port = emulation.medium.open_port()
    port.send(Frame(0x60B, bytes.fromhex("40 00 10 00 00 00 00 00")))
    ids = []
    while (arrival := port.receive(0.01)) is not None:
        ids.append(arrival.frame.id)
    assert ids.count(0x70B) == 2
    assert ids.count(0x58B) == 2
    emulation.close()


@pytest.mark.xdist_group("real_time")
def test_in_real_time_a_fault_is_heard() -> None:
    clock = SystemClock()
    rig = Rig(clock)
    try:
        rig.stage.devices["x"].inject_fault(clock.now_ns(), 0x2310)
        assert 0x08B in [frame.id for _, frame in rig.listen(0.3)]
    finally:
        rig.close()
        clock.close()
