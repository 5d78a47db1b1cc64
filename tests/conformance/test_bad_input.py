"""What a rig says of everything that can go wrong with its tools: a typed error with device, place and remedy."""

from collections.abc import Callable
from typing import NamedTuple

import pytest
import yaml

from microdrivers.backends.canopen.aborts import SdoAbort
from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import (
    ConfigError,
    ConnectError,
    DeviceFault,
    LinkLost,
    LinkTimeout,
    MicrodriversError,
    ProtocolError,
    UnsupportedError,
)
from microdrivers.fakes.can import medium_named
from microdrivers.fakes.canopen.aborts import AbortCode
from microdrivers.fakes.canopen.aborts import SdoAbort as Refusal
from microdrivers.fakes.modbus import ModbusException
from microdrivers.rig import build_rig, load_rig_file
from tests.backends.cia402_peer import PeerDrive
from tests.backends.cia404_peer import SheetAmplifier
from tests.fakes.analogue_bench import module_behind, port_behind

STAGE, PROBE, GRIPPER = "probe_stage", "probe_force", "gripper_force"
READ_INPUTS = 4


class Case(NamedTuple):
    """What is wrong, when it shows, and what must then be said.

    `plant` makes it wrong before the rig is opened; `disturb` afterwards. `act` is what fails, opening if there is
    none.
    """

    device: str
    kind: type[MicrodriversError]
    says: tuple[str, ...]
    remedy: str
    plant: Callable = lambda rig: None
    disturb: Callable = lambda rig: None
    act: Callable | None = None


# ---------------------------------------------------------------------- ways to make something wrong


def behind(rig, device, part):
    """An emulated drive, or an amplifier."""
    return rig.simulation.emulations[device].devices[part]


def bus():
    return medium_named("socketcan:can0")


def silent(device, part):
    """A node that is not there: it hears nothing and says nothing."""

    def plant(rig):
        behind(rig, device, part).node.receive = lambda frame, t_ns: ()

    return plant


def without_segments(device, part, *, answered):
    """A node that answers so many requests for a segment, and no more."""

    def plant(rig):
        node, heard = behind(rig, device, part).node, [0]
        honest = node.receive

        def receive(frame, t_ns):
            if frame.id == 0x600 + node.node_id and frame.data[0] & 0xE0 == 0x60:
                heard[0] += 1
                if heard[0] > answered:
                    return ()
            return honest(frame, t_ns)

        node.receive = receive

    return plant


def says_of(device, part, index, value):
    """A node whose object has another value."""
    return lambda rig: setattr(entry(behind(rig, device, part), index), "value", value)


def refuses(device, part, index, code):
    """A node that refuses to have an object written."""

    def refuse(value, t_ns):
        raise Refusal(code)

    return lambda rig: setattr(entry(behind(rig, device, part), index), "write", refuse)


def entry(part, index, sub=0):
    return part.node.dictionary.find(index, sub)


def emergency_soon(axis, code):
    def disturb(rig):
        drive = behind(rig, STAGE, axis)
        rig.clock.call_at(rig.clock.now_ns() + 300_000_000, lambda: drive.inject_fault(rig.clock.now_ns(), code))

    return disturb


def garbled(rig):
    """Every reply of the module has a wrong CRC."""
    port = port_behind(GRIPPER)
    honest = port.advance
    port.advance = lambda t_ns: [reply._replace(data=spoiled(reply.data)) for reply in honest(t_ns)]


def spoiled(data):
    return data[:-1] + bytes([data[-1] ^ 0x40])


def refusing(exception):
    def refuse(*_):
        raise ModbusException(exception)

    return lambda rig: module_behind(GRIPPER).functions.update({READ_INPUTS: refuse})


def unguarded(rig):
    """The stage without the rig's rules, since its force sensor is not there; tests/rig is about these."""
    rig.devices[STAGE].rules = ()


def referenced(rig):
    unguarded(rig)
    rig.devices[STAGE].reference(["z", "x", "y"])


def read(device):
    return lambda rig: rig.devices[device].read()


def reference(rig):
    unguarded(rig)
    rig.devices[STAGE].reference(["z"])


def move(rig):
    rig.devices[STAGE].move_to(x_um=0.0, y_um=0.0)


CASES = {
    "missing drive": Case(
        STAGE, LinkTimeout, ("axis y (node 12)", "1000h.0", "socketcan:can0"), "node id switches",
        plant=silent(STAGE, "y"),
    ),
    "missing amplifier": Case(
        PROBE, LinkTimeout, ("node 21", "1000h.0", "socketcan:can0"), "termination", plant=silent(PROBE, "amplifier")
    ),
    "missing module": Case(
        GRIPPER, LinkTimeout, ("unit 1", "4000h"), "unit_id",
        plant=lambda rig: setattr(module_behind(), "powered", False),
    ),
    "two drives with one id": Case(
        STAGE, ConfigError, ("axes.y.node_id", "2 nodes answer as node 12", "socketcan:can0"), "its own id",
        plant=lambda rig: bus().attach(PeerDrive(12)),
    ),
    "two amplifiers with one id": Case(
        PROBE, ConfigError, ("node_id", "2 nodes answer as node 21", "socketcan:can0"), "its own id",
        plant=lambda rig: bus().attach(SheetAmplifier(node_id=21)),
    ),
    "an amplifier in the place of a drive": Case(
        STAGE, ProtocolError, ("axis x (node 11)", "00020194h", "not 402"), "node_id",
        plant=says_of(STAGE, "x", 0x1000, 0x00020194),
    ),
    "a drive in the place of an amplifier": Case(
        PROBE, UnsupportedError, ("node 21", "1000h", "00020192h"), "node_id",
        plant=says_of(PROBE, "amplifier", 0x1000, 0x00020192),
    ),
    "emergency while homing": Case(
        STAGE, DeviceFault, ("axis z (node 13)", "motor blocked", "7121h"), "clear_fault()",
        disturb=emergency_soon("z", 0x7121), act=reference,
    ),
    "abort while opening": Case(
        STAGE, SdoAbort, ("axis y (node 12)", "6098h.0", "06090030h"), "",
        plant=refuses(STAGE, "y", 0x6098, AbortCode.VALUE_RANGE),
    ),
    "abort of a target": Case(
        STAGE, SdoAbort, ("axis x (node 11)", "607Ah.0", "08000022h"), "",
        disturb=lambda rig: (referenced(rig), refuses(STAGE, "x", 0x607A, AbortCode.PRESENT_STATE)(rig)), act=move,
    ),
    "abort while reading a force": Case(
        PROBE, SdoAbort, ("node 21", "6150h.1", "06060000h"), "",
        disturb=lambda rig: setattr(entry(behind(rig, PROBE, "amplifier"), 0x6150, 1), "read", broken), act=read(PROBE),
    ),
    "half a segmented transfer from a drive": Case(
        STAGE, LinkTimeout, ("axis z (node 13)", "1008h.0"), "cable", plant=without_segments(STAGE, "z", answered=1)
    ),
    "half a segmented transfer from an amplifier": Case(
        PROBE, LinkTimeout, ("node 21", "1008h.0"), "cable", plant=without_segments(PROBE, "amplifier", answered=2)
    ),
    "bad CRC": Case(
        GRIPPER, ProtocolError, ("unit 1", "0000h", "CRC"), "parity", disturb=garbled, act=read(GRIPPER)
    ),
    "exception reply": Case(
        GRIPPER, ProtocolError, ("unit 1", "0000h", "exception 04"), "settings", disturb=refusing(4), act=read(GRIPPER)
    ),
    "bus-off under a stage": Case(
        STAGE, LinkLost, ("bus-off", "socketcan:can0"), "bit rate, termination", disturb=lambda rig: bus().bus_off(),
        act=read(STAGE),
    ),
    "bus-off under a sensor": Case(
        PROBE, LinkLost, ("bus-off", "socketcan:can0"), "bit rate, termination", disturb=lambda rig: bus().bus_off(),
        act=read(PROBE),
    ),
    "wrong bit rate of a stage": Case(
        STAGE, LinkLost, ("is the bit rate right?", "bus-off", "socketcan:can0"), "bit rate",
        plant=lambda rig: setattr(bus(), "bitrate", 250_000),
    ),
    "wrong bit rate of a sensor": Case(
        PROBE, LinkLost, ("is the bit rate right?", "bus-off", "socketcan:can0"), "bit rate",
        plant=lambda rig: setattr(bus(), "bitrate", 250_000),
    ),
}  # fmt: skip


def broken(t_ns):
    raise Refusal(AbortCode.HARDWARE)


@pytest.mark.parametrize("name", CASES)
def test_it_is_said_which_device_what_and_what_to_do(name):
    case = CASES[name]
    rig = build_rig(shipped_rig(), fake=True, seed=5, clock=SimulatedClock(), devices=[case.device])
    case.plant(rig)
    try:
        if case.act is None:
            with pytest.raises(ConnectError) as opening:
                rig.open()
            (error,) = opening.value.errors
        else:
            rig.open()
            case.disturb(rig)
            with pytest.raises(MicrodriversError) as acting:
                case.act(rig)
            error = acting.value
    finally:
        rig.close()
    assert isinstance(error, case.kind), repr(error)
    text = str(error)
    for part in (case.device, *case.says):
        assert part in text, text
    assert error.remedy, text
    assert case.remedy in error.remedy


@pytest.mark.parametrize(("section", "axis", "taken"), [("gripper_stage", "y", 11), ("probe_stage", "z", 21)])
def test_a_node_id_given_twice_is_a_mistake_of_the_rig_file_that_names_both(tmp_path, section, axis, taken):
    data = yaml.safe_load(shipped_rig().read_text(encoding="utf-8"))
    data["devices"][section]["axes"][axis]["node_id"] = taken
    file = tmp_path / "lab.yaml"
    file.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_rig_file(file)
    text = str(caught.value)
    assert f"node {taken} on socketcan:can0 already belongs to" in text
    for name in {"gripper_stage": (section, STAGE), STAGE: (section, PROBE)}[section]:
        assert name in text
    assert "to do:" in text


def test_a_relative_move_whose_answer_is_lost_is_not_repeated():
    """Nobody knows whether the drive took it: the target is sent once, and the drive is not started."""
    rig = build_rig(shipped_rig(), fake=True, seed=5, clock=SimulatedClock(), devices=[STAGE])
    with rig:
        stage = rig.devices[STAGE]
        referenced(rig)
        stage.move_to(x_um=0.0)
        drive = behind(rig, STAGE, "x")
        node, honest = drive.node, drive.node.receive
        target_write = bytes.fromhex("237A6000")

        def receive(frame, t_ns):
            replies = honest(frame, t_ns)
            return () if frame.id == 0x600 + node.node_id and frame.data[:4] == target_write else replies

        node.receive = receive
        begin_ns, moves = rig.clock.now_ns(), len(drive.log)
        with pytest.raises(LinkTimeout, match=r"axis x \(node 11\), writing 607Ah\.0") as caught:
            stage.move_by(dx_um=10.0)
        assert caught.value.moved == "no"
        rig.clock.sleep(1.0)
        sent = [frame for t_ns, who, frame in bus().log if t_ns > begin_ns and who == "host"]
        assert sum(frame.id == 0x60B and frame.data[:4] == target_write for frame in sent) == 1
        assert not [text for _, text in drive.log[moves:] if text.startswith("move")]
        assert drive.motion.place_at(rig.clock.now_ns()) == pytest.approx(0.0, abs=0.2)
