from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.backends.lines.serial_line import SerialLine
from microdrivers.backends.oriental_az.drive import AzDrive, Input, Output, from_words, to_words
from microdrivers.backends.oriental_az.rtu import RtuMaster, RtuRefusal, rtu_timing
from microdrivers.backends.oriental_az.settings import RtuConnection
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import DeviceFault, LinkTimeout, ProtocolError, RefusedError
from microdrivers.core.units import NS_PER_MS
from tests.backends.oriental_az_peer import Script, plug_in, with_crc

STATUS_QUERY = bytes.fromhex("0103007E0002A413")
IDLE = bytes.fromhex("01030400004020CA2B")
MOVING = bytes.fromhex("01030400002000E3F3")
MOVE_TO_8500 = bytes.fromhex(
    "01100058001020000000000000000100002134"
    "00004E20000F4240000F4240000003E800000001C3F8"
)  # fmt: skip
BLOCK_ECHO = bytes.fromhex("0110005800104016")
SLAVE_ERROR = bytes.fromhex("0190044DC3")
NO_REPLY: tuple[tuple[float, bytes], ...] = ()


def soon(data: bytes) -> tuple[tuple[float, bytes], ...]:
    return ((0.0055, data),)


def master(script: Script, *, baudrate: int = 115200, seed: int = 0, fragments: int = 3) -> RtuMaster:
    clock = SimulatedClock()
    url, _ = plug_in(script, clock, seed=seed, baudrate=baudrate, fragments=fragments)
    connection = RtuConnection.model_validate({"port": url, "baudrate": baudrate})
    line = SerialLine(connection, clock=clock, gap_s=rtu_timing(baudrate).gap_s)
    line.open()
    return RtuMaster(line, unit_id=1)


def line_of(rtu: RtuMaster) -> SerialLine:
    return rtu._line


# ---------------------------------------------------------------------- bytes of the protocol sheet


def test_status_query_and_answer() -> None:
    script = Script(soon(IDLE), soon(MOVING))
    drive = AzDrive(master(script))
    assert drive.read_status().outputs == Output.IN_POS | Output.READY
    assert drive.read_status().outputs == Output.MOVE
    assert script.requests == [STATUS_QUERY, STATUS_QUERY]


def test_direct_data_block() -> None:
    script = Script(soon(BLOCK_ECHO))
    AzDrive(master(script)).start_absolute(8500, speed_hz=20_000, rate_hz_s=1_000_000, current_permille=1000)
    assert script.requests == [MOVE_TO_8500]


def test_direct_data_block_with_a_negative_target() -> None:
    script = Script(soon(BLOCK_ECHO))
    AzDrive(master(script)).start_absolute(-2, speed_hz=1, rate_hz_s=1_000_000_000, current_permille=505)
    items = struct.unpack(">8i", script.requests[0][7:-2])
    assert items == (0, 1, -2, 1, 1_000_000_000, 1_000_000_000, 505, 1)


@pytest.mark.parametrize(
    ("word", "on"),
    [(Input.ZHOME, "0106007D0010181E"), (Input.ALM_RST, "0106007D00801872"), (Input.NONE, "0106007D000019D2")],
)
def test_input_word(word: Input, on: str) -> None:
    frame = bytes.fromhex(on)
    script = Script(soon(frame))
    AzDrive(master(script)).write_input(word)
    assert script.requests == [frame]


def test_edges_are_written_on_and_off() -> None:
    frames = [bytes.fromhex("0106007D0010181E"), bytes.fromhex("0106007D000019D2")]
    script = Script(*(soon(frame) for frame in frames))
    AzDrive(master(script)).pulse_input(Input.ZHOME)
    assert script.requests == frames


def test_present_alarm() -> None:
    script = Script(soon(bytes.fromhex("010304000000 30FA27")))
    assert AzDrive(master(script)).read_alarm() == 0x30
    assert script.requests == [bytes.fromhex("010300800002C5E3")]


def test_motion_registers() -> None:
    words = struct.pack(">4i", 8500, 60, -20_000, -7)
    script = Script(soon(with_crc(b"\x01\x03\x10" + words)))
    motion = AzDrive(master(script)).read_motion()
    assert (motion.command_position, motion.command_speed_hz, motion.feedback_position) == (8500, -20_000, -7)
    assert script.requests == [with_crc(bytes.fromhex("010300C60008"))]


@given(st.integers(-(1 << 31), (1 << 31) - 1))
def test_32_bit_words(value: int) -> None:
    upper, lower = to_words(value)
    assert struct.pack(">HH", upper, lower) == struct.pack(">i", value)
    assert from_words(upper, lower) == value


# ---------------------------------------------------------------------- refusals


@pytest.mark.parametrize(("code", "meaning"), [(1, "function"), (2, "addresses"), (3, "number"), (4, "not executable")])
def test_exceptions_name_register_and_meaning(code: int, meaning: str) -> None:
    script = Script(soon(with_crc(bytes((1, 0x83, code)))))
    with pytest.raises(RtuRefusal, match=f"(?s)2 registers at 0500h.*exception 0{code}.*{meaning}") as caught:
        master(script).read(0x0500, 2)
    assert caught.value.moved == "no"
    assert len(script.requests) == 1  # an exception is an answer: nothing to repeat


def test_slave_error_with_an_alarm_names_the_alarm() -> None:
    script = Script(soon(SLAVE_ERROR), soon(bytes.fromhex("01030400000030FA27")))
    with pytest.raises(DeviceFault, match="alarm 30h is on: overload") as caught:
        AzDrive(master(script)).start_absolute(8500, speed_hz=1, rate_hz_s=1, current_permille=1)
    assert (caught.value.code, caught.value.moved) == (0x30, "no")
    assert "clear_fault" in caught.value.remedy


def test_slave_error_without_an_alarm_names_the_communication_error() -> None:
    none, out_of_range = (with_crc(b"\x01\x03\x04" + struct.pack(">i", code)) for code in (0, 0x8C))
    script = Script(soon(SLAVE_ERROR), soon(none), soon(out_of_range))
    with pytest.raises(RefusedError, match="8Ch: a setting is out of the drive's range"):
        AzDrive(master(script)).start_absolute(8500, speed_hz=1, rate_hz_s=1, current_permille=1)
    assert script.requests[1:] == [bytes.fromhex("010300800002C5E3"), with_crc(bytes.fromhex("010300AC0002"))]


# ---------------------------------------------------------------------- bad replies


def spoiled(frame: bytes, index: int = -1) -> bytes:
    data = bytearray(frame)
    data[index] ^= 0x40
    return bytes(data)


@pytest.mark.parametrize("index", range(len(IDLE)))
def test_a_garbled_reply_is_asked_for_once_more(index: int) -> None:
    script = Script(soon(spoiled(IDLE, index)), soon(MOVING))
    assert master(script, seed=index).read(0x7E, 2).values == (0, 0x2000)
    assert script.requests == [STATUS_QUERY] * 2


def test_bad_crc_twice_tells_what_was_sent_and_received() -> None:
    script = Script(soon(spoiled(IDLE)), soon(spoiled(IDLE)), soon(IDLE))
    with pytest.raises(ProtocolError, match="CRC") as caught:
        master(script).read(0x7E, 2)
    assert (caught.value.sent, caught.value.received) == (STATUS_QUERY, spoiled(IDLE))
    assert len(script.requests) == 2


@pytest.mark.parametrize("foreign", ["078304A0F2", with_crc(b"\x07" + IDLE[1:-2]).hex()])
def test_an_answer_of_another_unit(foreign: str) -> None:
    script = Script(*[soon(bytes.fromhex(foreign))] * 2)
    with pytest.raises(ProtocolError, match="an answer of unit 7") as caught:
        master(script).read(0x7E, 2)
    assert caught.value.received == bytes.fromhex(foreign)


def test_an_answer_to_another_request() -> None:
    script = Script(soon(with_crc(bytes.fromhex("0106007D0020"))))
    with pytest.raises(ProtocolError, match="an answer to another request"):
        master(script).write(0x7D, 0x10)


def test_half_a_reply_is_a_timeout() -> None:
    script = Script(soon(IDLE[:5]), soon(IDLE[:5]))
    with pytest.raises(LinkTimeout, match="only a part of the reply"):
        master(script).read(0x7E, 2)
    assert len(script.requests) == 2


def test_silence_names_unit_baud_rate_and_parity() -> None:
    script = Script()
    with pytest.raises(LinkTimeout, match=r"unit 1 on .* \(115200 baud, parity E, 1 stop bit\)") as caught:
        master(script).read(0x7E, 2)
    assert caught.value.moved == "no"
    assert len(script.requests) == 2


def test_a_read_survives_one_lost_request() -> None:
    script = Script(NO_REPLY, soon(IDLE))
    assert master(script).read(0x7E, 2).values == (0, 0x4020)


def test_a_late_reply_is_not_taken_for_the_next_one() -> None:
    script = Script([(0.21, MOVING)], soon(IDLE))
    rtu = master(script)
    assert rtu.read(0x7E, 2).values == (0, 0x4020)
    assert line_of(rtu).counters.discarded_bytes == len(MOVING)


@pytest.mark.parametrize("garbage", ["00", "FF", "01", "0103", "010300", "01030400", "8301", "01030400002000E3"])
@pytest.mark.parametrize("seed", range(3))
def test_stray_bytes_before_the_reply(garbage: str, seed: int) -> None:
    script = Script(soon(bytes.fromhex(garbage) + IDLE))
    assert master(script, seed=seed).read(0x7E, 2).values == (0, 0x4020)
    assert len(script.requests) == 1


@settings(deadline=None, max_examples=80)
@given(garbage=st.binary(max_size=12), cut=st.integers(0, len(IDLE)), seed=st.integers(0, 1000))
def test_noise_never_becomes_a_value(garbage: bytes, cut: int, seed: int) -> None:
    script = Script(*[soon(garbage + IDLE[:cut])] * 2)
    try:
        values = master(script, seed=seed).read(0x7E, 2).values
    except (LinkTimeout, ProtocolError):
        assert cut < len(IDLE) or garbage
    else:
        assert values == (0, 0x4020)


@pytest.mark.parametrize("answer", [NO_REPLY, soon(BLOCK_ECHO[:4]), soon(spoiled(BLOCK_ECHO))])
def test_a_block_write_is_never_repeated(answer: tuple[tuple[float, bytes], ...]) -> None:
    script = Script(answer, soon(BLOCK_ECHO))
    with pytest.raises((LinkTimeout, ProtocolError)) as caught:
        AzDrive(master(script)).start_absolute(8500, speed_hz=20_000, rate_hz_s=1_000_000, current_permille=1000)
    assert caught.value.moved == "maybe"
    assert script.requests == [MOVE_TO_8500]


@pytest.mark.parametrize("index", range(8))
def test_a_single_write_is_never_repeated(index: int) -> None:
    echo = bytes.fromhex("0106007D0010181E")
    script = Script(soon(spoiled(echo, index)), soon(echo))
    with pytest.raises((LinkTimeout, ProtocolError)):
        AzDrive(master(script)).write_input(Input.ZHOME)
    assert script.requests == [echo]


# ---------------------------------------------------------------------- time


@pytest.mark.parametrize(("baudrate", "gap_ms"), [(9600, 5.0), (19200, 3.0), (115200, 3.0), (230400, 3.0)])
def test_silence_is_kept_after_a_reply(baudrate: int, gap_ms: float) -> None:
    clock = SimulatedClock()
    url, wire = plug_in(Script(soon(IDLE), soon(IDLE)), clock, baudrate=baudrate)
    connection = RtuConnection.model_validate({"port": url, "baudrate": baudrate})
    line = SerialLine(connection, clock=clock, gap_s=rtu_timing(baudrate).gap_s)
    line.open()
    rtu = RtuMaster(line, unit_id=1)
    rtu.read(0x7E, 2)
    reply_end_ns = clock.now_ns()
    rtu.read(0x7E, 2)
    request_end_ns = [t_ns for t_ns, side, _ in wire.log if side == "host"][1]
    assert request_end_ns - 8 * wire.byte_ns - reply_end_ns >= gap_ms * NS_PER_MS


@pytest.mark.parametrize("fragments", [1, 3])
@pytest.mark.parametrize("late_ms", [0, 4])
def test_the_stamp_covers_when_the_drive_can_have_sampled(fragments: int, late_ms: int) -> None:
    script = Script([(0.0055 + late_ms / 1000, IDLE)])
    reply = master(script, fragments=fragments).read(0x7E, 2)
    request_end_ns = 8 * round(11e9 / 115200)
    first, last = request_end_ns + 2.5 * NS_PER_MS, request_end_ns + (5.5 + late_ms) * NS_PER_MS
    assert reply.t_ns - reply.dt_ns <= first
    assert reply.t_ns + reply.dt_ns >= last
    pauses_ms = 0 if fragments == 1 else 1.6  # a pause inside the reply may be one before it
    assert 2 * reply.dt_ns <= last - first + pauses_ms * NS_PER_MS + 2
