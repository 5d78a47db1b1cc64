"""The emulated analogue-input module: frames in, frames out, and when a register changes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.modbus import crc16, frame
from microdrivers.fakes.modbus_analogue import MODELS, AnalogueModule, AnaloguePort

WAVESHARE, ADAM = MODELS["waveshare-8ch"], MODELS["adam-4117"]
BYTE_NS = round(10 * NS_PER_S / 9600)


class Bench:
    def __init__(
        self, model: str = "waveshare-8ch", *, signal_V: Callable[[int], float] | float = 2.5, channel: int = 1
    ) -> None:
        code = MODELS[model].default_range
        self.asked_ns: list[int] = []
        self.signal_V = signal_V
        self.module = AnalogueModule(MODELS[model], self.signal_at, unit_id=1, channel=channel, range_code=code, seed=1)
        self.port = AnaloguePort(self.module, baudrate=9600, bits_per_byte=10, seed=1)
        self.t_ns = NS_PER_S

    def signal_at(self, t_ns: int) -> float:
        self.asked_ns.append(t_ns)
        return self.signal_V(t_ns) if callable(self.signal_V) else self.signal_V

    def ask(self, request: bytes) -> bytes:
        """Send a frame; the reply, or nothing. Then wait for 60 ms."""
        end_ns = self.t_ns + len(request) * BYTE_NS
        replies = list(self.port.receive(request, self.t_ns, end_ns))
        while (due_ns := self.port.next_event_ns()) is not None:
            replies += self.port.advance(due_ns)
        assert len(replies) <= 1
        self.t_ns = end_ns + 60 * NS_PER_MS
        return replies[0].data if replies else b""

    def ask_hex(self, request: str) -> str:
        return self.ask(bytes.fromhex(request)).hex(" ").upper()

    def pdu(self, pdu: str, unit_id: int = 1) -> str:
        """A PDU's answer."""
        reply = self.ask(frame(unit_id, bytes.fromhex(pdu)))
        assert not reply or (reply[0] == unit_id and crc16(reply) == 0)
        return reply[1:-2].hex(" ")

    def words(self, address: int, count: int, function: int = 4) -> list[int]:
        reply = self.ask(frame(1, struct.pack(">BHH", function, address, count)))
        assert reply[1] == function, reply.hex(" ")
        return list(struct.unpack(f">{count}H", reply[3:-2]))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_golden_frames(bench: Bench) -> None:
    reply = bench.ask(bytes.fromhex("01 04 00 00 00 08 F1 CC"))
    assert reply[:5] == bytes.fromhex("01 04 10 09 C4")
    assert len(reply) == 21
    assert crc16(reply) == 0
    twos = "01 10 10 00 00 08 10" + 8 * " 00 02"
    bench.ask(frame(1, bytes.fromhex(twos)[1:]))
    read_back = "01 03 10 00 02 00 02 00 02 00 02 00 02 00 02 00 02 00 02 09 C3"
    assert bench.ask_hex("01 03 10 00 00 08 40 CC") == read_back
    assert bench.ask_hex("01 06 10 00 00 03 CD 0B") == "01 06 10 00 00 03 CD 0B"
    assert bench.module.range_codes == [3, 2, 2, 2, 2, 2, 2, 2]
    bench.ask_hex("01 10 10 00 00 08 10 00 03 00 03 00 03 00 03 00 03 00 03 00 03 00 03 91 2B")
    assert bench.module.range_codes == [3] * 8


def test_each_range_shows_its_own_unit(bench: Bench) -> None:
    for code, word in [(0, 2500), (1, 2500), (2, 10_000), (3, 10_000), (4, 2048)]:
        bench.pdu(f"06 10 00 00 {code:02x}")
        assert bench.words(0, 1) == [word]


def test_unused_inputs_read_noise_around_nothing() -> None:
    bench = Bench(channel=3)
    readings = [bench.words(0, 8) for _ in range(50)]
    assert {reading[2] for reading in readings} == {2500}
    unused = [word for reading in readings for word in reading[:2] + reading[3:]]
    assert 0 < max(unused) <= 6
    bench = Bench("adam-4117", channel=3)
    bench.pdu("06 00 dc 00 ff")
    unused = [bench.words(0, 1)[0] for _ in range(50)]
    assert min(unused) < 0x8000 < max(unused)
    assert all(abs(word - 0x8000) < 20 for word in unused)


def test_a_broken_wire_reads_0_mV_and_can_be_mended(bench: Bench) -> None:
    assert bench.words(0, 1) == [2500]
    bench.module.disconnect()
    assert [bench.words(0, 1) for _ in range(5)] == [[0]] * 5
    bench.pdu("06 10 00 00 01")
    assert bench.words(0, 1) == [0]
    bench.module.reconnect()
    assert bench.words(0, 1) == [2500]


def test_without_power_it_is_silent(bench: Bench) -> None:
    bench.module.powered = False
    assert bench.pdu("04 00 00 00 01") == ""
    bench.module.powered = True
    assert bench.pdu("04 00 00 00 01") == "04 02 09 c4"


@pytest.mark.parametrize(
    ("model", "pdu", "code"),
    [
        ("waveshare-8ch", "08 00 00 12 34", 1),
        ("waveshare-8ch", "01 00 00 00 08", 1),
        ("waveshare-8ch", "03 00 00 00 01", 2),
        ("waveshare-8ch", "04 00 07 00 02", 2),
        ("waveshare-8ch", "04 10 00 00 01", 2),
        ("waveshare-8ch", "03 10 07 00 02", 2),
        ("waveshare-8ch", "06 00 00 00 00", 2),
        ("waveshare-8ch", "06 80 00 00 00", 2),
        ("waveshare-8ch", "06 00 dc 00 01", 2),
        ("waveshare-8ch", "10 10 07 00 02 04 00 00 00 00", 2),
        ("waveshare-8ch", "04 00 00 00 00", 3),
        ("waveshare-8ch", "04 00 00 00 7e", 3),
        ("waveshare-8ch", "06 10 00 00 05", 3),
        ("waveshare-8ch", "10 10 00 00 02 04 00 01 00 05", 3),
        ("waveshare-8ch", "06 40 00 00 00", 3),
        ("waveshare-8ch", "06 40 00 00 f8", 3),
        ("adam-4117", "06 00 c8 00 00", 3),
        ("adam-4117", "06 00 dc 01 00", 3),
        ("adam-4117", "06 40 00 00 02", 2),
        ("adam-4117", "03 00 07 00 02", 2),
    ],
)
def test_what_it_cannot_do_is_refused_and_changes_nothing(model: str, pdu: str, code: int) -> None:
    bench = Bench(model)
    before = bench.module.range_codes
    assert bench.pdu(pdu) == f"{int(pdu[:2], 16) | 0x80:02x} {code:02x}"
    assert bench.module.range_codes == before
    assert bench.module.unit_id == 1


def test_a_new_address_holds_from_the_next_frame_on(bench: Bench) -> None:
    assert bench.pdu("03 40 00 00 01") == "03 02 00 01"
    assert bench.pdu("06 40 00 00 2a") == "06 40 00 00 2a"
    assert bench.pdu("04 00 00 00 01") == ""
    assert bench.pdu("03 40 00 00 01", 42) == "03 02 00 2a"
    assert bench.pdu("06 40 00 00 05", 0) == ""
    assert bench.pdu("03 40 00 00 01", 5) == "03 02 00 05"


def test_the_adam_reads_its_inputs_with_two_functions_and_has_a_name() -> None:
    bench = Bench("adam-4117")
    assert bench.words(0, 1) == bench.words(0, 1, function=3) == [0x8000 + 0x2000]
    assert bench.words(0x00D2, 1, function=3) == [0x4117]
    assert bench.words(0x00C8, 8, function=3) == [8] * 8
    bench.pdu("06 00 c8 00 09")
    assert bench.words(0, 1) == [0x8000 + 0x4000]
    assert bench.words(0x00DC, 1, function=3) == [1]


# ---------------------------------------------------------------------- conversion


def read_every(bench: Bench, interval_ns: int, count: int) -> list[int]:
    """Behind the port, to ask at exact times."""
    read = bench.module.functions[4]
    starts = range(bench.t_ns, bench.t_ns + count * interval_ns, interval_ns)
    return [int.from_bytes(read(bytes(3) + b"\x01", t_ns)[1:], "big") for t_ns in starts]


def rising(t_ns: int) -> float:
    """1 mV each ms, so that a reading tells when it was converted."""
    return (t_ns - NS_PER_S) / NS_PER_S + 1.0


def test_a_register_holds_the_last_conversion() -> None:
    bench = Bench(signal_V=rising)
    read_every(bench, NS_PER_MS, 95)
    gaps = {later - sooner for sooner, later in pairwise(bench.asked_ns)}
    assert gaps == {10 * NS_PER_MS}
    assert len(bench.asked_ns) in (10, 11)


def test_whoever_reads_seldom_reads_the_latest_conversion() -> None:
    bench = Bench(signal_V=rising)
    read_every(bench, 25 * NS_PER_MS, 4)
    ages_ns = [bench.t_ns + n * 25 * NS_PER_MS - asked_ns for n, asked_ns in enumerate(bench.asked_ns)]
    assert len(ages_ns) == 4
    assert all(0 <= age_ns < 10 * NS_PER_MS for age_ns in ages_ns)
    assert len({asked_ns % (10 * NS_PER_MS) for asked_ns in bench.asked_ns}) == 1


def test_channels_are_converted_one_after_the_other() -> None:
    phases_ns = []
    for channel in (1, 3, 8):
        bench = Bench(channel=channel)
        bench.words(0, 8)
        phases_ns.append(bench.asked_ns[0])
    first_ns = phases_ns[0]
    assert [(phase_ns - first_ns) % (10 * NS_PER_MS) for phase_ns in phases_ns] == [0, 2_500_000, 8_750_000]


@pytest.mark.parametrize(("mask", "period_ms"), [(0x01, 10), (0x0F, 40), (0xFF, 80)])
def test_channels_of_the_adam_take_turns(mask: int, period_ms: int) -> None:
    bench = Bench("adam-4117", signal_V=rising)
    bench.pdu(f"06 00 dc 00 {mask:02x}")
    read_every(bench, NS_PER_MS, 400)
    gaps = {later - sooner for sooner, later in pairwise(bench.asked_ns)}
    assert gaps == {period_ms * NS_PER_MS}


def test_a_channel_that_takes_no_turns_keeps_what_it_held() -> None:
    bench = Bench("adam-4117", signal_V=rising)
    (held,) = bench.words(0, 1)
    bench.pdu("06 00 dc 00 02")
    assert [bench.words(0, 1) for _ in range(3)] == [[held]] * 3
    bench.pdu("06 00 dc 00 03")
    assert bench.words(0, 1) > [held]


# ---------------------------------------------------------------------- scaling

RANGES = [(model, code) for model in (WAVESHARE, ADAM) for code in model.ranges]


@settings(deadline=None, max_examples=200)
@given(st.sampled_from(RANGES), st.floats(-0.2, 1.2))
def test_a_word_is_within_one_step_of_the_voltage_or_at_an_end(choice, fraction):
    model, code = choice
    (low_V, high_V), (first, last) = model.ranges[code].span_V, model.ranges[code].words
    word = model.word(low_V + fraction * (high_V - low_V), code)
    assert first <= word <= min(last, 0xFFFF)
    clipped = min(max(fraction, 0.0), 1.0)
    step = (last - first) / 2**model.resolution_bits
    assert abs(word - (first + clipped * (last - first))) <= 0.5 * step + 0.5 + 1e-6 + (word == 0xFFFF)


@settings(deadline=None, max_examples=100)
@given(st.sampled_from(RANGES), st.floats(-1, 2), st.floats(-1, 2))
def test_a_higher_voltage_never_reads_lower(choice, one, other):
    model, code = choice
    low_V, high_V = model.ranges[code].span_V
    smaller, larger = sorted((one, other))
    scale_V = high_V - low_V
    assert model.word(low_V + smaller * scale_V, code) <= model.word(low_V + larger * scale_V, code)


def test_twelve_bits_show_4097_values_and_sixteen_all():
    words = {WAVESHARE.word(5.0 * n / 20_000, 0) for n in range(20_001)}
    assert (len(words), min(words), max(words)) == (4097, 0, 5000)
    assert [ADAM.word(volts, 8) for volts in (-11, -10, 0, 10 / 32768, 10, 11)] == [0, 0, 32768, 32769, 65535, 65535]


@settings(deadline=None, max_examples=100)
@given(
    st.sampled_from(["waveshare-8ch", "adam-4117"]),
    st.sampled_from([0, 6, 0xC6, 0xD0, 0xDA, 0xFFE, 0x1005, 0x4000, 0x7FFF, 0xFFFE]),
    st.lists(st.integers(0, 12), min_size=1, max_size=4),
)
def test_a_write_is_carried_out_as_a_whole_or_not_at_all(model, address, values):
    bench = Bench(model)
    pdu = struct.pack(f">BHHB{len(values)}H", 0x10, address, len(values), 2 * len(values), *values)
    before = {each: bench.pdu(f"03 {each:04x} 00 01") for each in range(address, min(address + 4, 0x10000))}
    accepted = not bench.ask(frame(bench.module.unit_id, pdu))[1] & 0x80
    unit_id = bench.module.unit_id
    for each, old in before.items():
        offset = each - address
        wanted = f"03 02 00 {values[offset]:02x}" if accepted and offset < len(values) else old
        if address < 8:
            assert not accepted
        else:
            assert bench.pdu(f"03 {each:04x} 00 01", unit_id) == wanted
