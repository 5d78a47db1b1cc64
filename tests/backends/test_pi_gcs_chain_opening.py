"""A daisy chain of GCS controllers: settings, addresses on the wire, opening."""

from __future__ import annotations

import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.pi_gcs import replies
from microdrivers.backends.pi_gcs.protocol import Gcs
from microdrivers.backends.pi_gcs.settings import GcsStageSettings
from microdrivers.core.errors import ConfigError, LinkTimeout, NotReferenced, ProtocolError
from microdrivers.core.units import Range
from microdrivers.fakes.wire import Temper
from tests.backends.scripted_gcs import MOVING_COMMANDS, Bench, axis_settings
from tests.backends.scripted_gcs_chain import STOP, AddressedPeer, ChainRig


def stage_settings(addresses: object, **changes: object) -> GcsStageSettings:
    axes = {
        axis: axis_settings(axis) | {"id": "1"} | ({} if address is None else {"address": address})
        for axis, address in zip(("x", "y", "theta"), addresses, strict=True)
    }
    for axis in axes:
        axes[axis] |= changes.pop(axis, {})
    return GcsStageSettings.model_validate({"connection": {"port": "/dev/null"}, "axes": axes} | changes)


# ---------------------------------------------------------------------- settings


def test_a_chain_needs_no_axis_ids() -> None:
    axes = stage_settings((16, 2, 1)).axes
    assert (axes.chained, axes.x.id, axes.x.address) == (True, "1", 16)
    plain = {axis: axis_settings(axis) | {"address": number} for number, axis in enumerate(("x", "y", "theta"), 1)}
    for axis in plain.values():
        del axis["id"]
    chain = GcsStageSettings.model_validate({"connection": {"port": "/dev/null"}, "axes": plain})
    assert [chain.axes.x.id, chain.axes.y.id, chain.axes.theta.id] == ["1", "1", "1"]
    assert GcsStageSettings.model_validate(chain.model_dump()) == chain


@pytest.mark.parametrize(
    ("addresses", "changes", "match"),
    [
        ((1, 2, None), {}, "give one to each axis"),
        ((None, None, 3), {}, "give one to each axis"),
        ((1, 2, 1), {}, r"different addresses, not \[1, 2, 1\]"),
        ((0, 1, 2), {}, "greater than or equal to 1"),
        ((1, 2, 17), {}, "less than or equal to 16"),
        ((1, 2, 3), {"serial_number": "0115500001"}, "give it per axis"),
        ((None, None, None), {}, "different controller axis ids"),
        (
            (None, None, None),
            {"y": {"id": "2"}, "theta": {"id": "3", "serial_number": "5"}},
            "give it for the stage",
        ),
    ],
)
def test_addresses_that_make_no_sense_are_refused(addresses: object, changes: dict[str, object], match: str) -> None:
    with pytest.raises(pydantic.ValidationError, match=match):
        stage_settings(addresses, **changes)


# ---------------------------------------------------------------------- the language with addresses


def gcs_at(address: int, script: dict[bytes, object]) -> tuple[Gcs, AddressedPeer]:
    identity = b"(c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,01155,1.2.0.0\n"
    peer = AddressedPeer({b"%d *IDN?\n" % address: b"0 %d %s" % (address, identity)} | script)
    gcs = Gcs(Bench(peer).line(), address=address)
    gcs.identify()
    peer.requests.clear()
    return gcs, peer


def test_only_the_first_line_of_a_reply_has_an_address() -> None:
    gcs, _ = gcs_at(12, {b"12 POS?\n": b"0 12 1=1.5000000 \n2=-3.0000000 \n3=+0004.5\n"})
    assert gcs.numbers("POS?") == {"1": 1.5, "2": -3.0, "3": 4.5}
    assert gcs.identity.startswith("(c)2015")


def test_single_bytes_have_an_address_and_a_line_end() -> None:
    gcs, peer = gcs_at(2, {b"2 \x07\n": b"0 2 \xb1\n", b"2 \x04\n": b"0 2 0x9005\n"})
    assert gcs.ready()
    assert gcs.status()[0].servo_on
    gcs.stop()
    assert peer.requests == [b"2 \x07\n", b"2 \x04\n", b"2 \x18\n"]


@pytest.mark.parametrize(
    ("reply", "match"),
    [
        (b"0 3 1=7.5\n", "address 2 was asked, and the answer is from address 3"),
        (b"1 2 1=7.5\n", "answer is from address 2 to 1"),
        (b"1=7.5\n", "no address is in front"),
        (b"2 1=7.5\n", "no address is in front"),
        (b"0 2 1=7.5 \n0 2 2=7.5\n", "axis=value"),
    ],
)
def test_what_is_not_this_controllers_reply_is_refused(reply: bytes, match: str) -> None:
    gcs, _ = gcs_at(2, {b"2 POS?\n": reply})
    with pytest.raises(ProtocolError, match=match) as caught:
        gcs.numbers("POS?")
    assert (caught.value.sent, caught.value.received) == (b"2 POS?\n", reply)
    assert caught.value.remedy
    assert gcs.interruptions == 1


def test_errors_show_the_commands_as_they_were_sent() -> None:
    gcs, peer = gcs_at(2, {b"2 ERR?\n": b"0 2 5\n"})
    with pytest.raises(NotReferenced) as caught:
        gcs.command("VEL 1 0.5", "MOV 1 3")
    assert r"b'2 VEL 1 0.5\n2 MOV 1 3\n'" in caught.value.what
    assert peer.requests == [b"2 VEL 1 0.5\n", b"2 MOV 1 3\n", b"2 ERR?\n"]


def test_a_late_reply_of_the_same_controller_is_not_taken_for_the_next_one() -> None:
    positions = iter([b"0 2 1=111.0\n", b"0 2 1=2.0\n"])
    gcs, peer = gcs_at(2, {b"2 POS?\n": lambda: next(positions), b"2 ERR?\n": b"0 2 0\n"})
    peer.delay_s[b"2 POS?\n"] = 0.15
    assert gcs.numbers("POS?") == {"1": 2.0}
    assert b"2 *IDN?\n" in peer.requests


lines = st.lists(st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=20), min_size=1, max_size=3)


@settings(deadline=None, derandomize=True, max_examples=200)
@given(lines, st.integers(1, 16), st.integers(0, 20), st.integers(0, 2))
def test_an_address_is_taken_off_or_refused(found: list[str], wanted: int, sender: int, to: int) -> None:
    addressed = [f"{to} {sender} {found[0]}", *found[1:]]
    if (to, sender) == (0, wanted):
        assert replies.without_address(addressed, wanted) == found
    else:
        with pytest.raises(ProtocolError):
            replies.without_address(addressed, wanted)


# ---------------------------------------------------------------------- opening


def test_opening_identifies_every_controller_and_moves_nothing() -> None:
    rig = ChainRig(opened=False, y={"serial_number": "0115500002", "stage": "M-111.1DG"})
    rig.theta.script[b"*IDN?\n"] = b"(c)2016 Physik Instrumente(PI) Karlsruhe, C-863.12,0115500003,1.3.0.0\n"
    rig.stage.open()
    assert rig.stage.info.vendor == "Physik Instrumente(PI) Karlsruhe"
    assert rig.stage.info.model == "C-863.12"
    assert rig.stage.info.serial_number == "0115500001/0115500002/0115500003"
    assert rig.stage.info.firmware == "1.2.0.0/1.2.0.0/1.3.0.0"
    assert rig.chain.requests[:3] == [b"1 *IDN?\n", b"1 ERR?\n", b"1 SAI?\n"]
    for address in (1, 2, 3):
        assert not rig.chain.sent_to(address, *MOVING_COMMANDS, b"\x18")
    assert rig.stage.referenced == {"x": True, "y": True, "theta": True}
    assert list(rig.stage.limits) == ["x", "y", "theta"]
    assert rig.stage.limits["x"] == Range(0.0, 15000.0)


def test_equal_firmware_is_named_once() -> None:
    assert ChainRig().stage.info.firmware == "1.2.0.0"


def test_each_controller_has_its_own_limits() -> None:
    rig = ChainRig(opened=False)
    rig.y.highest["1"], rig.theta.acceleration["1"] = 10.0, 3.0
    rig.stage.open()
    assert [rig.stage.limits[axis].max for axis in ("x", "y", "theta")] == [15000.0, 10000.0, 15.0]
    assert rig.stage.axes["theta"].acceleration == 3.0


def test_an_error_of_earlier_use_is_cleared_in_every_controller() -> None:
    rig = ChainRig(opened=False)
    for box in rig.chain.boxes.values():
        box.error = 10
    rig.stage.open()
    assert [box.error for box in rig.chain.boxes.values()] == [0, 0, 0]


@pytest.mark.parametrize(("axis", "address"), [("x", 1), ("y", 2), ("theta", 3)])
def test_a_silent_address_is_named_with_its_axis_and_its_switches(axis: str, address: int) -> None:
    rig = ChainRig(opened=False)
    rig.chain.off.add(address)
    with pytest.raises(LinkTimeout, match=rf"axis {axis}, address {address}: .*{address} \*IDN\?") as caught:
        rig.stage.open()
    for hint in ("DIP switches 1-4", f"address {address}", "all controllers", "switched on", "baud", "115200"):
        assert hint in caught.value.remedy
    assert (caught.value.moved, caught.value.device, rig.stage.link) == ("no", "stage", "closed")


def test_two_controllers_at_one_address_are_told_apart_from_silence() -> None:
    rig = ChainRig(opened=False)
    rig.chain.script[b"2 *IDN?\n"] = b"0 3 (c)2015 Physik Instrumente(PI) Karlsruhe, C-863.12,0115500003,1.2.0.0\n"
    with pytest.raises(ProtocolError, match=r"axis y: .*address 2 was asked.* from address 3") as caught:
        rig.stage.open()
    assert "DIP switches 1-4" in caught.value.remedy
    assert caught.value.sent == b"2 *IDN?\n"


@pytest.mark.parametrize(
    ("identity", "changes", "match"),
    [
        (b"(c)2015 Physik Instrumente(PI) Karlsruhe, C-884.4DC,1160,1.2.0.0\n", {}, "is no C-863.12"),
        (b"Oriental Motor AZD-KD\n", {}, "another device"),
        (None, {"serial_number": "999"}, "serial number 0115500002, not 999"),
    ],
)
def test_another_controller_at_an_address_is_refused(
    identity: bytes | None, changes: dict[str, object], match: str
) -> None:
    rig = ChainRig(opened=False, y=changes)
    if identity:
        rig.y.script[b"*IDN?\n"] = identity
    with pytest.raises(ProtocolError, match=match) as caught:
        rig.stage.open()
    assert caught.value.what.startswith("axis y, address 2: ")
    assert (caught.value.sent, caught.value.moved) == (b"2 *IDN?\n", "no")


@pytest.mark.parametrize(
    ("change", "match"),
    [({"id": "B"}, r"axis y, address 2: .* no axis 'B'; it has 1"), ({"stage": "M-112"}, "axis y, address 2: .*M-112")],
)
def test_what_the_rig_file_and_one_controller_disagree_about_is_named(change: dict[str, str], match: str) -> None:
    rig = ChainRig(opened=False, y=change)
    with pytest.raises(ConfigError, match=match) as caught:
        rig.stage.open()
    assert caught.value.key == f"stage.axes.y.{next(iter(change))}"


@pytest.mark.parametrize("reply", [b"\xfe\x81\x00\n", b"\xfe\x81\x00", b"0 2 (c)2015 Phys", b"f 2 (c)\n"])
def test_garbage_mentions_the_baud_rate(reply: bytes) -> None:
    rig = ChainRig(opened=False)
    rig.chain.script[b"2 *IDN?\n"] = reply
    with pytest.raises((ProtocolError, LinkTimeout)) as caught:
        rig.stage.open()
    assert "115200" in caught.value.remedy
    assert "address 2" in caught.value.what


def test_an_unfriendly_line_does_not_matter() -> None:
    rig = ChainRig(temper=Temper(max_fragments=20, max_pause_s=0.004))
    rig.stage.move_to(x_um=10.0, y_um=20.0, theta_deg=0.1)
    assert rig.stage.line_counters["timeouts"] == 0


def test_one_controller_at_a_time_is_asked_and_one_axis_a_line() -> None:
    rig = ChainRig(opened=False)
    rig.stage.open()
    rig.stage.reference(["theta", "x", "y"])
    with rig.stage.stream(50.0):
        rig.stage.move_to(x_um=100.0, y_um=200.0, theta_deg=0.5, speed_um_s=300.0)
    rig.stage.clear_fault()
    for write in rig.sent():
        addresses = {line.split()[0] for line in write.splitlines()}
        assert len(addresses) == 1, write
        assert write.endswith(b"\n")
    rig.stage.stop()
    assert rig.sent() == [STOP]
