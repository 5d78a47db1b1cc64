from __future__ import annotations

import struct

import pytest

from microdrivers.backends.oriental_az.drive import AzDrive, Input, Output
from microdrivers.core.errors import DeviceFault, LinkTimeout, ProtocolError, RefusedError
from tests.backends.modbus_bench import IDLE, MOVING, NO_REPLY, STATUS_QUERY, ModbusBench, soon, spoiled
from tests.backends.oriental_az_peer import Script, with_crc

MOVE_TO_8500 = bytes.fromhex(
    "01100058001020000000000000000100002134"
    "00004E20000F4240000F4240000003E800000001C3F8"
)  # fmt: skip
BLOCK_ECHO = bytes.fromhex("0110005800104016")
SLAVE_ERROR = bytes.fromhex("0190044DC3")


def az(script: Script) -> AzDrive:
    return AzDrive(ModbusBench(script).master)


# ---------------------------------------------------------------------- bytes of the protocol sheet


def test_status_query_and_answer() -> None:
    script = Script(soon(IDLE), soon(MOVING))
    drive = az(script)
    assert drive.read_status().outputs == Output.IN_POS | Output.READY
    assert drive.read_status().outputs == Output.MOVE
    assert script.requests == [STATUS_QUERY, STATUS_QUERY]


def test_direct_data_block() -> None:
    script = Script(soon(BLOCK_ECHO))
    az(script).start_absolute(8500, speed_hz=20_000, rate_hz_s=1_000_000, current_permille=1000)
    assert script.requests == [MOVE_TO_8500]


def test_direct_data_block_with_a_negative_target() -> None:
    script = Script(soon(BLOCK_ECHO))
    az(script).start_absolute(-2, speed_hz=1, rate_hz_s=1_000_000_000, current_permille=505)
    items = struct.unpack(">8i", script.requests[0][7:-2])
    assert items == (0, 1, -2, 1, 1_000_000_000, 1_000_000_000, 505, 1)


@pytest.mark.parametrize(
    ("word", "on"),
    [(Input.ZHOME, "0106007D0010181E"), (Input.ALM_RST, "0106007D00801872"), (Input.NONE, "0106007D000019D2")],
)
def test_input_word(word: Input, on: str) -> None:
    frame = bytes.fromhex(on)
    script = Script(soon(frame))
    az(script).write_input(word)
    assert script.requests == [frame]


def test_edges_are_written_on_and_off() -> None:
    frames = [bytes.fromhex("0106007D0010181E"), bytes.fromhex("0106007D000019D2")]
    script = Script(*(soon(frame) for frame in frames))
    az(script).pulse_input(Input.ZHOME)
    assert script.requests == frames


def test_present_alarm() -> None:
    script = Script(soon(bytes.fromhex("010304000000 30FA27")))
    assert az(script).read_alarm() == 0x30
    assert script.requests == [bytes.fromhex("010300800002C5E3")]


def test_motion_registers() -> None:
    words = struct.pack(">4i", 8500, 60, -20_000, -7)
    script = Script(soon(with_crc(b"\x01\x03\x10" + words)))
    motion = az(script).read_motion()
    assert (motion.command_position, motion.command_speed_hz, motion.feedback_position) == (8500, -20_000, -7)
    assert script.requests == [with_crc(bytes.fromhex("010300C60008"))]


# ---------------------------------------------------------------------- refusals


def test_slave_error_with_an_alarm_names_the_alarm() -> None:
    script = Script(soon(SLAVE_ERROR), soon(bytes.fromhex("01030400000030FA27")))
    with pytest.raises(DeviceFault, match="alarm 30h is on: overload") as caught:
        az(script).start_absolute(8500, speed_hz=1, rate_hz_s=1, current_permille=1)
    assert (caught.value.code, caught.value.moved) == (0x30, "no")
    assert "clear_fault" in caught.value.remedy


def test_slave_error_without_an_alarm_names_the_communication_error() -> None:
    none, out_of_range = (with_crc(b"\x01\x03\x04" + struct.pack(">i", code)) for code in (0, 0x8C))
    script = Script(soon(SLAVE_ERROR), soon(none), soon(out_of_range))
    with pytest.raises(RefusedError, match="8Ch: a setting is out of the drive's range"):
        az(script).start_absolute(8500, speed_hz=1, rate_hz_s=1, current_permille=1)
    assert script.requests[1:] == [bytes.fromhex("010300800002C5E3"), with_crc(bytes.fromhex("010300AC0002"))]


@pytest.mark.parametrize("answer", [NO_REPLY, soon(BLOCK_ECHO[:4]), soon(spoiled(BLOCK_ECHO))])
def test_a_motion_is_never_commanded_twice(answer: tuple[tuple[float, bytes], ...]) -> None:
    script = Script(answer, soon(BLOCK_ECHO))
    with pytest.raises((LinkTimeout, ProtocolError), match="16 registers at 0058h") as caught:
        az(script).start_absolute(8500, speed_hz=20_000, rate_hz_s=1_000_000, current_permille=1000)
    assert caught.value.moved == "maybe"
    assert script.requests == [MOVE_TO_8500]


def test_an_edge_is_never_written_twice() -> None:
    script = Script(soon(spoiled(bytes.fromhex("0106007D0010181E"))))
    with pytest.raises(ProtocolError):
        az(script).pulse_input(Input.ZHOME)
    assert script.requests == [bytes.fromhex("0106007D0010181E")]
