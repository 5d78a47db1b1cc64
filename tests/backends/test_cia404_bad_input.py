"""What can go wrong between the driver and an amplifier: each by its name, with a remedy."""

from __future__ import annotations

import math

import pytest

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.core.errors import (
    ConfigError,
    LinkError,
    LinkLost,
    LinkTimeout,
    MicrodriversError,
    ProtocolError,
    UnsupportedError,
)
from microdrivers.core.units import NS_PER_S
from microdrivers.devices.force_sensor import STALE, UNTARED
from microdrivers.fakes.can import Due, Frame
from tests.backends.cia404_bench import ForceBench
from tests.backends.cia404_peer import NOT_NOW, READ_ONLY, SheetAmplifier


def refused(bench: ForceBench, kind: type[MicrodriversError], match: str) -> MicrodriversError:
    with bench, pytest.raises(kind, match=match) as caught:
        bench.sensor.open()
    assert caught.value.device == "probe_force"
    assert caught.value.remedy
    assert bench.sensor.link == "closed"
    return caught.value


def with_object(index: int, sub: int, value: bytes) -> SheetAmplifier:
    amplifier = SheetAmplifier()
    amplifier.objects[index, sub] = value
    return amplifier


# ---------------------------------------------------------------------- opening


def test_a_missing_node() -> None:
    error = refused(ForceBench(node_id=22), LinkTimeout, r"node 22, reading 1000h\.0 .*no reply to 616#40")
    assert "node id" in error.remedy
    assert "termination" in error.remedy


def test_a_drive_instead_of_an_amplifier() -> None:
    amplifier = with_object(0x1000, 0, bytes.fromhex("92010200"))
    error = refused(ForceBench(amplifier), UnsupportedError, "node 21 is no measuring amplifier: its profile is 402")
    assert "00020192h" in error.what
    assert "node_id" in error.remedy


def test_an_amplifier_that_has_outputs_only() -> None:
    amplifier = with_object(0x1000, 0, bytes.fromhex("94010800"))
    refused(ForceBench(amplifier), UnsupportedError, "no analogue inputs .1000h is 00080194h")


@pytest.mark.parametrize("unit", ["00002600", "000001FA", "00002103"])
def test_another_unit_than_a_force(unit: str) -> None:
    amplifier = with_object(0x6131, 1, bytes.fromhex(unit))
    error = refused(ForceBench(amplifier), ConfigError, "not count in a unit of force: 6131h.1 is")
    assert "µN (FA210000h)" in error.remedy


def test_a_scale_that_does_not_fit_the_rig_file() -> None:
    coarse = refused(ForceBench(SheetAmplifier(unit=0xFD210000)), ConfigError, "steps of 1000 µN, not 0.01 µN")
    assert "6131h" in coarse.remedy
    narrow = SheetAmplifier(unit=0xFA210000, digits=2, value=0x7130)
    refused(ForceBench(narrow), ConfigError, "16 bits show ±327.68 µN, which does not cover -2000 to 2000 µN")


def test_a_channel_that_is_not_there() -> None:
    refused(ForceBench(channel=2), UnsupportedError, r"no process value of channel 2: neither 9130h\.2, 6130h\.2")


@pytest.mark.parametrize(
    ("entry", "code", "match"),
    [
        (
            (0x1A00, 0),
            NOT_NOW,
            r"node 21 refuses (reading|writing) 1A00h\.0: not possible in the present state .*\(08000022h\)",
        ),
        ((0x1A00, 2), READ_ONLY, r"refuses (reading|writing) 1A00h\.2: read-only object"),
        ((0x1800, 1), 0x06010001, r"refuses reading 1800h\.1: write-only"),
        ((0x6131, 1), 0x08000000, r"refuses reading 6131h\.1: general error \(08000000h\)"),
        ((0x6131, 1), 0x06020000, r"refuses reading 6131h\.1: no such object"),
        ((0x9130, 1), 0x06060000, r"refuses reading 9130h\.1: hardware error"),
    ],
)
def test_aborts_name_object_and_meaning(entry: tuple[int, int], code: int, match: str) -> None:
    amplifier = SheetAmplifier()
    amplifier.aborts[entry] = code
    error = refused(ForceBench(amplifier), SdoAbort, match)
    assert isinstance(error, SdoAbort)
    assert (error.code, error.index) == (code, entry[0])


def test_half_a_segmented_transfer() -> None:
    amplifier = SheetAmplifier()
    amplifier.answers_left = 7  # 1000h, four of 1018h, the first of 1008h and one segment
    refused(ForceBench(amplifier), LinkTimeout, r"node 21, reading 1008h\.0")


def test_an_object_of_another_length() -> None:
    refused(
        ForceBench(with_object(0x6132, 1, b"\0\0")), ProtocolError, r"6132h\.1 \(decimal digits\) has 2 bytes, not 1"
    )


def test_two_nodes_of_the_same_id() -> None:
    error = refused(ForceBench(others=[SheetAmplifier()]), ConfigError, "2 nodes answer as node 21 on CAN bus")
    assert isinstance(error, ConfigError)
    assert error.key == "probe_force.node_id"
    assert "switches" in error.remedy


def test_two_devices_of_the_rig_with_the_same_id() -> None:
    with ForceBench().opened() as bench:
        other = bench.another("second_force")
        with pytest.raises(ConfigError, match=r"node 21 .* belongs to probe_force already, not to second_force"):
            other.open()
        assert bench.sensor.read().flags == {UNTARED}


def test_devices_that_want_different_bit_rates() -> None:
    with ForceBench() as bench:
        bench.connection["bitrate"] = 250_000
        with pytest.raises(ConfigError, match="bitrate 500000, this one 250000"):
            bench.another("second_force")


def test_an_amplifier_without_heartbeat_is_usable() -> None:
    amplifier = SheetAmplifier()
    amplifier.aborts[0x1017, 0] = READ_ONLY
    with ForceBench(amplifier).opened() as bench:
        bench.clock.run_for(2.0)
        assert bench.kinds == ["opened"]
        assert bench.sensor.read().flags == {UNTARED}


# ---------------------------------------------------------------------- in use


def test_an_abort_while_reading() -> None:
    with ForceBench().opened() as bench:
        bench.amplifier.aborts[0x6150, 1] = 0x06060000
        with pytest.raises(SdoAbort, match=r"probe_force: node 21 refuses reading 6150h\.1"):
            bench.sensor.read()


def test_a_silent_node_is_missed_by_its_heartbeat_and_found_again() -> None:
    with ForceBench().opened() as bench:
        bench.clock.run_for(1.0)
        bench.amplifier.silent = True
        bench.clock.run_for(0.6)
        assert bench.kinds == ["opened", "link_lost"]
        assert "heartbeat" in bench.events[-1].reason
        with pytest.raises(LinkLost, match="probe_force: the device is lost"):
            bench.sensor.read()
        bench.amplifier.silent = False
        bench.clock.run_for(0.3)
        assert bench.kinds == ["opened", "link_lost", "link_back"]
        assert bench.sensor.read().flags == {UNTARED}


@pytest.mark.parametrize("sync", [False, True])
def test_a_stream_that_stops_coming_is_stale(sync: bool) -> None:
    with ForceBench(sync=sync).opened() as bench, bench.sensor.stream(200.0):
        bench.clock.run_for(0.5)
        bench.amplifier.silent = True
        silent_s = bench.now_s()
        bench.clock.run_for(0.5)
        assert bench.kinds == ["opened", "link_lost"]
        stale = [sample for sample in bench.samples if STALE in sample.flags]
        assert len(stale) >= 6
        assert 0.0999 <= stale[0].t_ns / NS_PER_S - silent_s <= 0.16
        assert all(math.isnan(sample.force_uN) for sample in stale)
        assert bench.samples[-1] is stale[-1]
        bench.amplifier.silent = False
        bench.clock.run_for(0.2)
        assert bench.kinds == ["opened", "link_lost", "link_back"]
        assert bench.samples[-1].flags == {UNTARED}
        assert [sample.seq for sample in bench.samples] == list(range(len(bench.samples)))


def test_a_node_that_was_switched_on_anew_is_set_up_again_and_forgets_the_tare() -> None:
    with ForceBench().opened() as bench:
        bench.sensor.tare(0.2)
        with bench.sensor.stream(200.0):
            bench.clock.run_for(0.2)
            reboot(bench)
            bench.clock.run_for(0.02)
            assert bench.kinds == ["opened", "tared", "link_lost", "tared"]
            assert "switched on anew" in bench.events[2].reason
            bench.clock.run_for(2.0)
            assert bench.kinds[4:] == ["link_back"]
            assert bench.samples[-1].flags == {UNTARED}
            assert bench.clock.now_ns() - bench.samples[-1].t_ns < 0.01 * NS_PER_S


def test_a_node_that_was_switched_on_anew_between_streams() -> None:
    with ForceBench().opened() as bench:
        bench.clock.run_for(0.1)
        reboot(bench)
        bench.clock.run_for(1.0)
        send(bench, Frame(0x700 + 21, b"\x7f"))  # its heartbeat alone does not tell that it has been set up
        assert bench.kinds == ["opened", "link_lost"]
        bench.sensor.open()
        with bench.sensor.stream(100.0):
            bench.clock.run_for(0.1)
        assert bench.samples[-1].flags == {UNTARED}


def reboot(bench: ForceBench) -> None:
    """Off and on within a moment: the node forgets everything, and says its boot-up."""
    bench.medium.detach(bench.amplifier)
    bench.amplifier.forget()
    bench.medium.attach(bench.amplifier)


def test_emergencies_are_faults_until_they_are_over() -> None:
    with ForceBench().opened() as bench:
        send(bench, Frame(0x80 + 21, bytes.fromhex("1050010000000000")))
        assert bench.kinds == ["opened", "fault"]
        assert bench.sensor.fault is not None
        assert bench.sensor.fault.code == 0x5010
        assert "5010h" in str(bench.sensor.fault)
        send(bench, Frame(0x80 + 21, bytes(8)))
        assert bench.kinds == ["opened", "fault", "fault_cleared"]
        assert bench.sensor.fault is None


def test_a_frame_of_another_length_is_nobodys_measurement() -> None:
    with ForceBench().opened() as bench, bench.sensor.stream(100.0):
        bench.clock.run_for(0.1)
        count = len(bench.samples)
        send(bench, Frame(0x180 + 21, bytes(8)), run_s=0.001)
        assert len(bench.samples) - count <= 1
        assert {sample.raw_uN for sample in bench.samples} == {0.0}


def send(bench: ForceBench, frame: Frame, *, run_s: float = 0.01) -> None:
    """Somebody on the bus sends a frame."""
    node = _Once(frame, bench.clock.now_ns())
    bench.medium.attach(node)
    bench.clock.run_for(run_s)
    bench.medium.detach(node)


class _Once:
    def __init__(self, frame: Frame, due_ns: int) -> None:
        self._frame = frame
        self._due_ns: int | None = due_ns

    def receive(self, frame: Frame, t_ns: int) -> list[Due]:
        return []

    def advance(self, t_ns: int) -> list[Due]:
        if self._due_ns is None:
            return []
        self._due_ns = None
        return [Due(t_ns, self._frame)]

    def next_event_ns(self) -> int | None:
        return self._due_ns


@pytest.mark.parametrize("how", ["unplug", "bus_off"])
def test_a_lost_bus(how: str) -> None:
    with ForceBench().opened() as bench:
        with bench.sensor.stream(200.0):
            bench.clock.run_for(0.3)
            getattr(bench.medium, how)()
            bench.clock.run_for(1.5)
            assert bench.kinds == ["opened", "link_lost"]
            assert STALE in bench.samples[-1].flags
        with pytest.raises(LinkError, match="probe_force"):
            bench.sensor.read()
        bench.medium.plug_in()
        bench.sensor.open()
        assert bench.sensor.read().flags == {UNTARED}


def test_stop_is_harmless() -> None:
    with ForceBench().opened() as bench:
        before = len(bench.host_frames)
        bench.sensor.stop()
        assert len(bench.host_frames) == before
