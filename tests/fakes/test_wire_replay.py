"""A device that answers from a wire log: which request is which, and that a rig replays what it was recorded with."""

import json
import re

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.configs import shipped_rig
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.errors import ConfigError, LinkTimeout, ProtocolError, UnsupportedError
from microdrivers.core.samples import WireTraffic
from microdrivers.devices.camera import Camera
from microdrivers.fakes.wire.replay import LoggedRequest, ReplayEmulator, logged_requests
from microdrivers.rig import open_rig

RIG = shipped_rig("microscope")

LOG = [
    LoggedRequest(b"A\n", [(10, b"1")]),
    LoggedRequest(b"STOP", []),
    LoggedRequest(b"B\n", [(20, b"2"), (25, b"3")]),
    LoggedRequest(b"A\n", [(30, b"4")]),
    LoggedRequest(b"C\n", []),
]


def answers(emulator, data, start_ns=0):
    return [(reply.t_ns, reply.data) for reply in emulator.receive(data, start_ns, start_ns)]


def counts(emulator):
    return emulator.skipped, emulator.repeated, dict(emulator.unknown)


# ---------------------------------------------------------------------- matching


def test_the_log_is_answered_in_its_order_with_its_delays():
    emulator = ReplayEmulator(LOG)
    assert answers(emulator, b"A\n", 100) == [(110, b"1")]
    assert answers(emulator, b"STOP", 200) == []
    assert answers(emulator, b"B\n", 300) == [(320, b"2"), (325, b"3")]
    assert answers(emulator, b"A\n", 400) == [(430, b"4")]
    assert answers(emulator, b"C\n", 500) == []
    assert counts(emulator) == (0, 0, {})
    assert not list(emulator.complaints())


def test_a_later_request_skips_what_lies_between():
    emulator = ReplayEmulator(LOG)
    assert answers(emulator, b"B\n") == [(20, b"2"), (25, b"3")]
    assert answers(emulator, b"A\n") == [(30, b"4")]
    assert counts(emulator) == (2, 0, {})


def test_a_poll_beyond_the_log_gets_the_latest_answer_again():
    emulator = ReplayEmulator(LOG)
    for _ in range(2):
        emulator.receive(b"A\n", 0, 0)
    assert answers(emulator, b"A\n") == [(30, b"4")]
    assert answers(emulator, b"B\n") == [(20, b"2"), (25, b"3")]
    assert answers(emulator, b"C\n") == []
    assert counts(emulator) == (2, 2, {})


def test_an_unknown_request_meets_silence_and_is_counted():
    emulator = ReplayEmulator(LOG)
    assert answers(emulator, b"X\n") == answers(emulator, b"X\n") == answers(emulator, b"\x01\x80") == []
    assert answers(emulator, b"A\n") == [(10, b"1")]
    assert counts(emulator) == (0, 0, {b"X\n": 2, b"\x01\x80": 1})
    first, second = emulator.complaints()
    assert first == 'the log has no answer to "X\\n" (2×)'
    assert "01 80" in second


def test_many_unknown_requests_are_not_all_listed():
    emulator = ReplayEmulator(LOG)
    for number in range(8):
        emulator.receive(f"X{number}\n".encode(), 0, 0)
    *_, last = emulator.complaints()
    assert last == "nor to 3 other requests"


def test_requests_may_be_cut_and_joined_otherwise_than_in_the_log():
    emulator = ReplayEmulator([LoggedRequest(b"PO", []), LoggedRequest(b"S?\n", [(5, b"1")]), *LOG])
    assert answers(emulator, b"POS?\n") == [(5, b"1")]
    assert answers(emulator, b"A") == []
    assert answers(emulator, b"\nSTO", 100) == [(110, b"1")]
    assert answers(emulator, b"P") == []
    assert counts(emulator) == (0, 0, {})


def test_a_request_that_was_only_begun_is_unknown():
    emulator = ReplayEmulator([LoggedRequest(b"POS?\n", []), *LOG])
    assert answers(emulator, b"PO") == []
    assert list(emulator.complaints()) == ['the log has no answer to "PO" (1×)']
    assert answers(emulator, b"A\n") == [(10, b"1")]
    assert counts(emulator) == (1, 0, {b"PO": 1})


lines = st.text("abc", max_size=3).map(lambda text: f"{text}\n".encode())
replies = st.lists(st.tuples(st.integers(0, 100), st.binary(min_size=1, max_size=4)), max_size=2)


@settings(deadline=None, max_examples=100)
@given(log=st.lists(st.builds(LoggedRequest, lines, replies), max_size=12), data=st.data())
def test_a_host_that_does_the_same_gets_the_same_however_it_cuts_its_bytes(log, data):
    emulator, sent = ReplayEmulator(log), b"".join(request.data for request in log)
    heard = []
    while sent:
        size = data.draw(st.integers(1, len(sent)))
        heard += [reply.data for reply in emulator.receive(sent[:size], 0, 0)]
        sent = sent[size:]
    assert heard == [reply for request in log for _, reply in request.replies]
    assert counts(emulator) == (0, 0, {})


def test_replies_belong_to_the_request_before_them():
    def record(t_ns, direction, data):
        return WireTraffic(t_ns=t_ns, device="zoom", direction=direction, data=data)

    requests = logged_requests(
        [
            record(5, "received", b"boot"),
            record(10, "sent", b"A"),
            record(30, "received", b"1"),
            record(35, "received", b"2"),
            record(40, "sent", b"B"),
            record(41, "sent", b""),
            record(39, "received", b"3"),
        ]
    )
    assert requests == [LoggedRequest(b"A", [(20, b"1"), (25, b"2")]), LoggedRequest(b"B", [(0, b"3")])]


# ---------------------------------------------------------------------- whole rigs


def readings(rig):
    """One reading of stage and zoom, without their place among all that passed on the bus."""
    samples = [rig.devices[name].read() for name in ("sample_stage", "zoom")]
    return [repr(msgspec.structs.replace(sample, order=-1)) for sample in samples]  # not equal by ==: NaN


@pytest.fixture
def recorded(tmp_path):
    """A log of opening the emulated workstation and reading its stage and its zoom once, and what they said."""
    file = tmp_path / "wire.jsonl"
    with open_rig(RIG, fake=True, seed=3, clock=SimulatedClock(), wire_log=file) as rig:
        said = readings(rig)
    return file, said


def edit(file, change):
    """Pass each record of a log through `change`; None removes it."""
    header, *lines = file.read_text(encoding="utf-8").splitlines()
    records = [change(json.loads(line)) for line in lines]
    text = "\n".join([header, *(json.dumps(record) for record in records if record is not None)])
    file.write_text(f"{text}\n", encoding="utf-8")


def last_reply(file, device):
    """The last record that was received from a device before what is sent and asked at closing."""
    records = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    own = [record for record in records if record.get("device") == device and "direction" in record]
    stop = next(n for n, record in enumerate(own) if record["direction"] == "sent" and is_stop(record))
    return [record for record in own[:stop] if record["direction"] == "received"][-1]


def is_stop(record):
    """#24 of GCS, or the input word of the AZ drive with STOP on."""
    return record.get("text") == "\x18" or record.get("hex", "").startswith("01 06 00 7D 00 20")


def test_a_rig_reads_from_its_log_what_it_read_when_the_log_was_taken(recorded, caplog):
    file, said = recorded
    with open_rig(str(RIG), wire_replay=str(file)) as rig:
        assert rig.fake
        assert rig.clock.simulated
        assert readings(rig) == said
        with pytest.raises(UnsupportedError, match="missing"):
            rig.device("camera_fine", Camera)
    assert "left out of the rig" in caplog.text
    assert "camera_fine" in caplog.text
    assert "no answer" not in caplog.text
    assert "the rig file differs" not in caplog.text


def test_a_bug_report_becomes_a_test(recorded):
    file, _ = recorded
    cut = last_reply(file, "sample_stage")
    edit(file, lambda record: None if record == cut else record)
    with open_rig(RIG, wire_replay=file) as rig, pytest.raises(LinkTimeout, match="only a part"):
        rig.devices["sample_stage"].read()


def test_a_garbled_reply_is_replayed_byte_for_byte(recorded):
    file, _ = recorded
    bad = last_reply(file, "sample_stage")
    garbled = {key: value for key, value in bad.items() if key != "text"} | {"hex": "FF 00 B5 0A"}
    edit(file, lambda record: garbled if record == bad else record)
    with open_rig(RIG, wire_replay=file) as rig, pytest.raises(ProtocolError) as caught:
        rig.devices["sample_stage"].read()
    assert caught.value.received.endswith(b"\xff\x00\xb5\n")


def test_a_late_reply_comes_as_late_as_it_did(recorded):
    file, _ = recorded
    late = last_reply(file, "zoom")
    edit(file, lambda record: record | {"t_s": record["t_s"] + 0.3} if record == late else record)
    with open_rig(RIG, wire_replay=file) as rig, pytest.raises(LinkTimeout, match="zoom"):
        rig.devices["zoom"].read()


def test_what_the_log_cannot_answer_is_reported_once(recorded, caplog):
    file, _ = recorded
    with open_rig(RIG, wire_replay=file) as rig, pytest.raises(LinkTimeout):
        rig.devices["zoom"].move_to(zoom=5.0)
    rig.close()
    complaints = [record.getMessage() for record in caplog.records if "no answer" in record.getMessage()]
    assert len(complaints) == 1
    assert re.search(
        r"zoom: the log has no answer to 01 06 00 7D .*: the driver now asks something else", complaints[0]
    )


def test_a_rig_file_that_differs_from_the_logs_is_named(recorded, tmp_path, caplog):
    file, _ = recorded
    text = RIG.read_text(encoding="utf-8")
    other = tmp_path / "other.yaml"
    other.write_text(
        text.replace("backlash_steps: 20", "backlash_steps: 30").replace("ttyUSB0", "ttyUSB7"), encoding="utf-8"
    )
    with open_rig(other, wire_replay=file):
        pass
    differences = [text for text in caplog.messages if "the rig file differs" in text]
    assert len(differences) == 1
    assert "zoom.backlash_steps is 30, it was 20" in differences[0]


def test_a_log_of_other_devices_is_refused(recorded):
    file, _ = recorded
    edit(file, lambda record: record | {"device": f"other_{record['device']}"})
    with (
        pytest.raises(ConfigError, match="nothing passed on the wire") as caught,
        open_rig(RIG, wire_replay=file),
    ):
        pass
    assert "sample_stage" in caught.value.remedy


def test_a_replay_excludes_a_simulation(recorded):
    file, _ = recorded
    with (
        pytest.raises(ConfigError, match="takes the place"),
        open_rig(RIG, fake=True, wire_replay=file),
    ):
        pass


def test_a_world_file_may_name_the_log(recorded, tmp_path):
    file, said = recorded
    world = tmp_path / "replay.yaml"
    world.write_text(f"world: wire-log\nlog: {file}\n", encoding="utf-8")
    with open_rig(RIG, fake=True, clock=SimulatedClock(), world=world) as rig:
        assert readings(rig) == said


def test_a_replay_can_be_logged_again(recorded, tmp_path):
    file, said = recorded
    again = tmp_path / "again.jsonl"
    with open_rig(RIG, wire_replay=file, wire_log=again) as rig:
        assert readings(rig) == said

    def traffic(log):
        return [line for line in log.read_text(encoding="utf-8").splitlines()[1:] if '"direction"' in line]

    assert traffic(again) == traffic(file)
