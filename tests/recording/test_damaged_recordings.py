"""Torn, damaged, empty, foreign and future files: what is delivered is what was written, the rest is told."""

import errno
import os
import random
import types
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import ForceSample
from microdrivers.recording import reader
from microdrivers.recording.codec import codec_of
from microdrivers.recording.errors import EmptyRecording, ForeignRecording, FutureRecording, RecordingError
from microdrivers.recording.header import HEADER_RECORD, PROFILE, RecordingHeader, to_metadata
from microdrivers.recording.mcap_writer import ChannelKey, McapWriter
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder
from microdrivers.recording.repair import repair
from microdrivers.recording.schemas import schema_data, schema_name

SLOW = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


def damage(data, cut, flips):
    damaged = bytearray(data if cut is None else data[: cut % (len(data) + 1)])
    for place, bit in flips:
        if damaged:
            damaged[place % len(damaged)] ^= 1 << bit
    return bytes(damaged)


FLIPS = st.lists(st.tuples(st.integers(0, 2**31), st.integers(0, 7)), max_size=3)


def check_is_part_of(same, found, published):
    """Found samples are samples that were published, in their order."""
    rest = iter(published)
    for topic, sample in found:
        assert any(topic == other_topic and same(sample, other) for other_topic, other in rest)


def test_no_damage_makes_a_sample_that_was_not_written(recorded, same, tmp_path):
    whole = recorded.file.read_bytes()
    file, out = tmp_path / "damaged.mcap", tmp_path / "repaired.mcap"

    @SLOW
    @given(st.one_of(st.none(), st.integers(0, len(whole))), FLIPS)
    def check(cut, flips):
        data = damage(whole, cut, flips)
        file.write_bytes(data)
        out.unlink(missing_ok=True)
        try:
            recording = Recording(file)
        except RecordingError:
            with pytest.raises(RecordingError):
                repair(file, out)
            assert not out.exists()
            return
        found = list(recording.samples())
        recording.check_indexes()
        check_is_part_of(same, found, recorded.published)
        assert sum(topic.count for topic in recording.topics.values()) == len(found)
        if len(found) < len(recorded.published):
            assert recording.losses
        repair(file, out)
        check_official(out)
        again = list(Recording(out).samples())
        assert len(again) == len(found)
        check_is_part_of(same, again, recorded.published)

    check()


def check_official(file):
    """The official reader takes the file, its CRCs are right, and log times run forwards in each channel."""
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        last = {}
        count = 0
        for _, channel, message in reader.iter_messages(log_time_order=False):
            assert message.log_time >= last.get(channel.id, 0)
            last[channel.id] = message.log_time
            count += 1
        statistics = reader.get_summary().statistics
        assert statistics.message_count == count
        assert sum(1 for _ in reader.iter_messages()) == count
        assert [attachment.name for attachment in reader.iter_attachments()] in ([], ["rig.yaml"])
    with file.open("rb") as stream:
        records = list(StreamReader(stream, validate_crcs=True).records)
    assert sum(isinstance(record, Message) for record in records) == count


def test_a_whole_recording_passes_the_official_reader(recorded):
    check_official(recorded.file)


def test_an_interrupted_recording_is_read_up_to_the_tear(stage, same, tmp_path):
    with stage.recorder():
        stage.run(seconds=0.56)
        torn = stage.file.read_bytes()
    stage.file.write_bytes(torn)
    recording = Recording(stage.file)
    found = list(recording.samples())
    assert not recording.complete
    assert 500 < len(found) < len(stage.published)
    assert same(found[-1][1], stage.published[len(found) - 1][1])
    told = "the recording was not ended: at most its last 0.1 s are missing if its program was killed, more if"
    assert [str(loss).removeprefix(told) for loss in recording.losses] == [" its disk was full"]
    report = repair(stage.file, tmp_path / "whole.mcap")
    assert (report.lost_bytes, report.messages["force"]) == (0, recording.topics["force"].count)
    assert stage.file.read_bytes() == torn
    check_official(report.out)


def test_what_follows_a_damaged_length_is_found_again(recorded, tmp_path):
    data = bytearray(recorded.file.read_bytes())
    scan = Recording(recorded.file)._scan
    data[scan.chunks[3].offset + 6] ^= 0x10  # the chunk's own length
    data[scan.chunks[8].offset + scan.chunks[8].length + 2] ^= 0x10  # that of an index
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    recording = Recording(damaged)
    lost = len(recorded.published) - len(list(recording.samples()))
    assert 0 < lost < 60
    assert [loss.what for loss in recording.losses] == ["something is damaged here"] * 2
    assert recording.topics["force"].gaps + recording.topics["camera"].gaps == lost


def test_every_damage_around_a_chunk_is_told(recorded, tmp_path):
    whole, file = recorded.file.read_bytes(), tmp_path / "damaged.mcap"
    scan = Recording(recorded.file)._scan
    place, following = scan.chunks[4:6]
    assert not Recording(recorded.file).check_indexes()
    for byte in (*range(place.offset, place.offset + 49), *range(place.offset + place.length, following.offset, 13)):
        data = bytearray(whole)
        data[byte] ^= 1 << byte % 8
        file.write_bytes(data)
        damaged = Recording(file)
        assert damaged.losses + damaged.check_indexes(), byte - place.offset


def test_damaged_times_of_a_chunk_are_told_and_mended_by_a_repair(recorded, same, tmp_path):
    data = bytearray(recorded.file.read_bytes())
    place = Recording(recorded.file)._scan.chunks[4]
    data[place.offset + 17] ^= 4  # message_end_time
    data[place.offset + place.length + 20] ^= 4  # a time in its index
    file = tmp_path / "damaged.mcap"
    file.write_bytes(data)
    told = [f"the {part} of the chunk at byte {place.offset} is damaged; its samples are intact" for part in
            ("header", "index")]  # fmt: skip
    assert [str(loss) for loss in Recording(file).check_indexes()] == told
    report = repair(file, tmp_path / "whole.mcap")
    assert ([str(damage) for damage in report.mended], report.losses) == (told, [])
    again = Recording(report.out)
    assert again.losses + again.check_indexes() == []
    assert len(list(again.samples())) == len(recorded.published)


def test_a_damaged_copy_of_the_header_is_told(recorded, tmp_path):
    data = recorded.file.read_bytes()
    place = data.rindex(b"created_utc") + 16
    (tmp_path / "a.mcap").write_bytes(data[:place] + b"3" + data[place + 1 :])
    told = [str(loss) for loss in Recording(tmp_path / "a.mcap").losses]
    assert told == ["one of the recording's headers is damaged: another one is intact"]


@pytest.mark.parametrize("at_end", [False, True])
def test_a_damaged_record_of_the_clock_is_told(recorded, tmp_path, at_end):
    data = recorded.file.read_bytes()
    key = b"offset_ns"
    place = (data.rindex if at_end else data.index)(key) + len(key) + 4
    file = tmp_path / "damaged.mcap"
    file.write_bytes(data[:place] + b"7" + data[place + 1 :])
    damaged = Recording(file)
    assert [str(loss) for loss in damaged.losses] == [
        f"the recording's clock record{' of its end' if at_end else ''} is damaged: another one is intact"
    ]
    assert (damaged.clock.end_offset_ns is None) == at_end
    report = repair(file, tmp_path / "whole.mcap")
    assert report.losses == damaged.losses
    repaired = Recording(report.out)
    assert repaired.clock == damaged.clock
    assert [str(loss) for loss in repaired.losses] == [f"lost before the repair: {damaged.losses[0]}"]


def test_a_channel_whose_definition_is_damaged_is_known_from_the_summary(recorded, tmp_path):
    place = Recording(recorded.file)._scan.chunks[0]
    data = bytearray(recorded.file.read_bytes())
    data[place.offset + place.length - 1] ^= 1
    whole, torn = tmp_path / "whole.mcap", tmp_path / "torn.mcap"
    whole.write_bytes(data)
    torn.write_bytes(data[:-300])
    assert Recording(whole).topics["force"].count > 400
    recording = Recording(torn)
    assert "force" not in recording.topics
    assert any("definition is lost" in str(loss) for loss in recording.losses)


def test_empty_missing_and_foreign_files_are_named(recorded, tmp_path):
    file = tmp_path / "x.mcap"
    with pytest.raises(ConfigError, match="No such file"):
        Recording(file)
    file.write_bytes(b"")
    with pytest.raises(EmptyRecording, match="is empty"):
        Recording(file)
    file.write_bytes(recorded.file.read_bytes()[:50])
    with pytest.raises(EmptyRecording, match="ends before"):
        Recording(file)
    file.write_bytes(random.Random(1).randbytes(300_000))
    with pytest.raises(ForeignRecording, match="no MCAP file"):
        Recording(file)
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        writer.add_metadata("other", {"schema_version": "9"})
        writer.finish()
    with pytest.raises(ForeignRecording, match="did not write it"):
        Recording(file)


def test_a_future_version_is_refused(stage):
    recorder = stage.recorder()
    recorder.close()
    assert Recording(stage.file).topics == {}
    stage.file.unlink()
    header = RecordingHeader(schema_version=2, microdrivers="9.1", source="live")

    Recorder(stage.file, bus=stage.bus, clock=stage.clock, header=header).close()
    with pytest.raises(FutureRecording, match="schema version 2; this microdrivers reads up to 1"):
        Recording(stage.file)


def test_times_that_run_backwards_are_counted(stage):
    with stage.recorder():
        for t_ns in (5, 9, 7, 8, 20):
            stage.publish("force", ForceSample(t_ns=t_ns, device="x", force_uN=0.0, raw_uN=0.0))
    found = Recording(stage.file).topics["force"]
    assert (found.unsorted, found.first_t_ns, found.last_t_ns) == (1, 5, 20)


PAGE = 4096


@pytest.fixture
def bad_disk(monkeypatch):
    """Makes pages of a file unreadable: a read ends before one, and fails at one, as it does on Linux."""
    pages = set()

    def pread(descriptor, size, offset, pread=os.pread):
        bad = [page for page in range(offset // PAGE, (offset + size - 1) // PAGE + 1) if page in pages]
        if bad and bad[0] * PAGE <= offset:
            raise OSError(errno.EIO, "Input/output error")
        return pread(descriptor, bad[0] * PAGE - offset if bad else size, offset)

    monkeypatch.setattr(os, "pread", pread)
    return pages


def test_what_a_failing_disk_does_not_give_is_told_and_the_rest_is_repaired(recorded, same, tmp_path, bad_disk):
    last = recorded.file.stat().st_size // PAGE
    for page in range(1, last + 1):
        bad_disk.add(page)
        told = f"{PAGE} bytes at byte {page * PAGE} cannot be read: Input/output error"
        with Recording(recorded.file) as recording:
            found = list(recording.samples())
            assert told in [str(loss) for loss in recording.losses]
        assert len(recorded.published) - 150 < len(found)
        check_is_part_of(same, found, recorded.published)
        report = repair(recorded.file, tmp_path / f"{page}.mcap")
        bad_disk.clear()
        assert str(report.losses[0]) == told
        check_official(report.out)
        assert len(list(Recording(report.out).samples())) == len(found)
    bad_disk |= {3, 4, 7}
    told = [f"{2 * PAGE} bytes at byte {3 * PAGE}", f"{PAGE} bytes at byte {7 * PAGE}"]
    with Recording(recorded.file) as recording:
        assert [str(loss).partition(" cannot be read")[0] for loss in recording.losses[:2]] == told
    bad_disk.add(0)
    with pytest.raises(ConfigError, match="cannot be read: Input/output error"):
        Recording(recorded.file)


def test_damage_is_found_also_where_asserts_are_left_out(recorded, tmp_path):
    data = bytearray(recorded.file.read_bytes())
    place = Recording(recorded.file)._scan.chunks[4]
    data[place.offset + place.length - 1] ^= 1
    (tmp_path / "damaged.mcap").write_bytes(data)
    optimised = types.ModuleType(reader.__name__)
    exec(compile(Path(reader.__file__).read_text(), reader.__file__, "exec", optimize=1), vars(optimised))
    [loss] = optimised.Recording(tmp_path / "damaged.mcap").losses
    assert "its CRC does not match" in loss.what


def test_log_times_that_run_backwards_are_told_by_a_repair(tmp_path):
    file = tmp_path / "rewritten.mcap"
    with file.open("x+b", buffering=0) as output:
        writer = McapWriter(output, profile=PROFILE, library="another program")
        writer.add_metadata(HEADER_RECORD, to_metadata(RecordingHeader(source="fake")))
        key = ChannelKey("force", schema_name(ForceSample), schema_data(ForceSample))
        for t_ns in (5, 9, 7, 8, 20):
            data = codec_of(ForceSample).encode(ForceSample(t_ns=t_ns, device="x", force_uN=0.0, raw_uN=0.0))
            writer.add_message(writer.channel(key), data, sequence=0, log_ns=t_ns, publish_ns=t_ns)
            writer.flush()
        writer.finish()
    report = repair(file, tmp_path / "out.mcap")
    assert (report.backwards, report.messages, report.losses) == ({"force": 1}, {"force": 5}, [])


def test_repair_never_writes_over_anything(recorded, tmp_path):
    with pytest.raises(ConfigError, match="the file already exists"):
        repair(recorded.file, recorded.file)
    report = repair(recorded.file, tmp_path / "out.mcap")
    assert (report.losses, report.messages["force"], report.messages["camera"]) == ([], 500, 10)
    assert report.backwards == {}
    assert Recording(report.out).attachments == Recording(recorded.file).attachments
