"""Wire logs: what is written is read back byte for byte, and what is no wire log is refused by line."""

import json
import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.bus import Bus
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import DeviceEvent, WireTraffic
from microdrivers.devices import wire_log_format
from microdrivers.devices.wire_log_format import bytes_text, header_line, read_header, read_wire_log, record_line
from microdrivers.devices.wire_tap import WireTap
from microdrivers.recording import wire_log
from microdrivers.recording.wire_log import WireLogWriter, describe_source

HEADER = describe_source({"name": "rig", "devices": {"zoom": {"unit_id": 1}}}, source="live", seed=None)
RECORD = '{"t_s": 0.5, "device": "zoom", "direction": "sent", "text": "a"}\n'

times = st.integers(0, 10**15)
devices = st.sampled_from(["stage", "zoom"])
traffic = st.builds(
    lambda t_ns, device, direction, data: WireTraffic(
        t_ns=t_ns, device=device, t_source="recorded", direction=direction, data=data
    ),
    times,
    devices,
    st.sampled_from(["sent", "received"]),
    st.binary(max_size=12) | st.sampled_from([b"POS?\n", b"1=0.5 \r\n", b"\x18", b"\x05MOV 1 2\n", b"\x7f"]),
)
events = st.builds(
    lambda t_ns, device, kind, by, reason: DeviceEvent(
        t_ns=t_ns, device=device, t_source="recorded", kind=kind, by=by, reason=reason
    ),
    times,
    devices,
    st.sampled_from(["opened", "fault", "link_lost"]),
    st.text(max_size=4),
    st.text(max_size=4),
)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "wire.jsonl"


def writer(file, bus, devices=("stage", "zoom"), start_ns=0):
    return WireLogWriter(file, HEADER, bus=bus, devices=devices, start_ns=start_ns)


# ---------------------------------------------------------------------- the format


@settings(deadline=None, max_examples=100)
@given(records=st.lists(traffic | events, max_size=8))
def test_what_is_written_is_read_back(tmp_path_factory, records):
    file = tmp_path_factory.mktemp("log") / "wire.jsonl"
    file.write_text(header_line(HEADER) + "".join(record_line(each, start_ns=0) for each in records), encoding="utf-8")
    log = read_wire_log(file)
    assert log.header == read_header(file) == HEADER
    assert log.records == records


def test_times_count_from_the_start_of_the_log():
    sample = WireTraffic(t_ns=12_000_000_345, device="zoom", direction="sent", data=b"x")
    assert json.loads(record_line(sample, start_ns=12_000_000_000))["t_s"] == 3.45e-7


@pytest.mark.parametrize(
    ("data", "shown"),
    [
        (b"POS? 1\n", '"POS? 1\\n"'),
        (b"\x18", '"\\u0018"'),
        (bytes.fromhex("0103007E0002A413"), "01 03 00 7E 00 02 A4 13"),
        (b"\xb1\n", "B1 0A"),
        (b"", '""'),
    ],
)
def test_bytes_are_written_for_people(data, shown):
    assert bytes_text(data) == shown


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("{", "truncated"),
        ("[1]", "Expected `object`"),
        ('{"t_s": 1, "device": "zoom"}', "needs an event, or a direction"),
        ('{"t_s": 1, "device": "zoom", "direction": "sent"}', "either text or hex"),
        ('{"t_s": 1, "device": "zoom", "direction": "sent", "text": "a", "hex": "61"}', "either text or hex"),
        ('{"t_s": 1, "device": "zoom", "direction": "up", "text": "a"}', "direction"),
        ('{"t_s": 1, "device": "zoom", "direction": "sent", "hex": "0"}', "pairs of hexadecimal digits"),
        ('{"t_s": 1, "device": "zoom", "direction": "sent", "text": "µ"}', "ASCII only"),
        ('{"t_s": 1, "device": "zoom", "direction": "sent", "txt": "a"}', "txt"),
        ('{"t_s": 1, "device": "zoom", "event": "opened", "hex": "61"}', "not both"),
        ('{"t_s": 1, "device": "zoom", "event": "lunch"}', "lunch"),
        ('{"t_s": 1e300, "device": "zoom", "event": "opened"}', "not a time"),
        ('{"t_s": 1e999, "device": "zoom", "event": "opened"}', "not a record"),
        ('{"t_s": "1", "device": "zoom", "event": "opened"}', "t_s"),
        ("[" * 100_000, "not a record"),
    ],
)
def test_a_line_that_is_no_record_is_refused_by_its_number(file, line, what):
    file.write_text(f"{header_line(HEADER)}{RECORD}\n{line}\n{RECORD}", encoding="utf-8")
    with pytest.raises(ConfigError, match="not a record of a wire log") as caught:
        read_wire_log(file)
    assert (caught.value.file, caught.value.line) == (str(file), 4)
    assert what in str(caught.value)
    assert "one JSON object a line" in caught.value.remedy


@settings(deadline=None, max_examples=150)
@given(garbage=st.binary(min_size=1, max_size=60).filter(lambda line: b"\n" not in line and line.strip()))
def test_any_garbage_is_refused_with_its_line(tmp_path_factory, garbage):
    file = tmp_path_factory.mktemp("log") / "wire.jsonl"
    file.write_bytes(header_line(HEADER).encode() + garbage + b"\n")
    with pytest.raises(ConfigError) as caught:
        read_wire_log(file)
    assert caught.value.line == 2
    file.write_bytes(garbage)
    with pytest.raises(ConfigError, match="not a wire log"):
        read_wire_log(file)


def test_a_last_line_that_was_cut_off_is_left_out_with_a_warning(file, caplog):
    file.write_text(header_line(HEADER) + RECORD + RECORD[:30], encoding="utf-8")
    assert len(read_wire_log(file).records) == 1
    assert "line 3 was cut off" in caplog.text


def test_an_editor_may_add_byte_order_mark_and_windows_line_ends(file):
    text = (header_line(HEADER) + RECORD).replace("\n", "\r\n")
    file.write_text(text, encoding="utf-8-sig", newline="")
    assert read_wire_log(file).header == HEADER


NESTED = '{"format": "microdrivers-wire-log", "version": 1, "rig": {"a": ' + "[" * 100_000


@pytest.mark.parametrize(
    "text", ["", "\n", "rig: 1\n", "{}\n", '{"format": "another", "version": 1}\n', pytest.param(NESTED, id="nested")]
)
def test_a_foreign_file_is_not_a_wire_log(file, text):
    file.write_text(text, encoding="utf-8")
    for read in (read_wire_log, read_header):
        with pytest.raises(ConfigError, match="not a wire log") as caught:
            read(file)
        assert "--wire-log" in caught.value.remedy


def test_another_version_is_named(file):
    file.write_text('{"format": "microdrivers-wire-log", "version": 2, "new": 1}\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"wire\.jsonl:1: wire log of version 2; this microdrivers reads version 1"):
        read_wire_log(file)


def test_a_damaged_header_is_named(file):
    file.write_text(header_line(HEADER).replace('"live"', '"life"'), encoding="utf-8")
    with pytest.raises(ConfigError, match="header is damaged") as caught:
        read_wire_log(file)
    assert caught.value.line == 1


@pytest.mark.parametrize(("make", "what"), [(None, "no such file"), ("mkdir", "cannot be read")])
def test_what_cannot_be_read_is_named(file, make, what):
    if make:
        file.mkdir()
    with pytest.raises(ConfigError, match=what):
        read_wire_log(file)


# ---------------------------------------------------------------------- the writer


def test_traffic_and_events_of_all_devices_are_written(file):
    bus = Bus()
    log = writer(file, bus, start_ns=1000)
    WireTap("stage", bus).sent(1500, b"POS?\n")
    WireTap("zoom", bus).received(2000, b"\x01\x83")
    bus.topic("zoom/event", DeviceEvent).publish(DeviceEvent(t_ns=3000, device="zoom", kind="fault", reason="alarm 30"))
    log.close()
    WireTap("stage", bus).sent(4000, b"after the log has ended")
    sent, received, fault = read_wire_log(file).records
    assert (sent.t_ns, sent.device, sent.direction, sent.data) == (500, "stage", "sent", b"POS?\n")
    assert (received.device, received.direction, received.data) == ("zoom", "received", b"\x01\x83")
    assert (fault.kind, fault.reason) == ("fault", "alarm 30")
    assert not bus.topic("stage/wire", WireTraffic).heard


def test_several_devices_may_log_at_once(file):
    bus, names = Bus(), [f"device_{number}" for number in range(4)]
    log = writer(file, bus, names)

    def talk(name):
        tap = WireTap(name, bus)
        for number in range(300):
            tap.sent(number, str(number).encode())

    threads = [threading.Thread(target=talk, args=(name,)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    records = read_wire_log(file).records
    for name in names:
        assert [int(each.data) for each in records if each.device == name] == list(range(300))


def test_a_record_is_in_the_file_before_the_log_is_closed(file):
    bus = Bus()
    log = writer(file, bus)
    WireTap("stage", bus).sent(0, b"before the crash")
    for _ in range(1000):
        if "before the crash" in file.read_text(encoding="utf-8"):
            break
        time.sleep(0.005)
    assert len(read_wire_log(file).records) == 1
    log.close()


def test_an_existing_file_is_kept(file):
    file.write_text("evidence", encoding="utf-8")
    with pytest.raises(ConfigError, match="the file exists"):
        writer(file, Bus())
    assert file.read_text(encoding="utf-8") == "evidence"


def test_a_file_that_cannot_be_made_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="cannot be written") as caught:
        writer(tmp_path / "none" / "wire.jsonl", Bus())
    assert "folder" in caught.value.remedy


def test_a_log_without_a_record_is_removed(file, caplog):
    log = writer(file, Bus())
    assert file.exists()
    log.close()
    log.close()
    assert not file.exists()
    assert caplog.text.count("nothing passed on any wire") == 1


def test_a_full_disk_ends_the_log_and_not_the_run(file, caplog, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    bus = Bus()
    log = writer(file, bus)
    monkeypatch.setattr(wire_log, "record_line", full)
    tap = WireTap("stage", bus)
    for t_ns in range(3):
        tap.sent(t_ns, b"x")
    for _ in range(1000):
        if not tap.topic.heard:
            break
        time.sleep(0.005)
    assert not tap.topic.heard
    log.close()
    assert caplog.text.count("No space left on device") == 1


def test_the_header_says_where_the_log_comes_from():
    header = describe_source({"devices": {}}, source="fake", seed=7)
    assert (header.source, header.seed, header.version) == ("fake", 7, wire_log_format.VERSION)
    assert header.created_utc.endswith("+00:00")
    assert header.command
