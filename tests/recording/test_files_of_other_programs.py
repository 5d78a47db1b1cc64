"""Recordings that another program has rewritten are read; what is none is refused, also under our profile."""

import struct

import pytest
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from microdrivers.core.errors import ConfigError, DataError
from microdrivers.recording import replay
from microdrivers.recording.errors import ForeignRecording
from microdrivers.recording.mcap_scan import McapScan
from microdrivers.recording.playback import open_replay
from microdrivers.recording.reader import Recording
from microdrivers.recording.repair import repair


def rewrite(source, file, compression=CompressionType.NONE, arrange=list):
    """As the official library does it, its messages as `arrange` makes them of (schema, channel, message)."""
    with source.open("rb") as stream, file.open("wb") as output:
        reader = make_reader(stream)
        writer = Writer(output, chunk_size=20_000, compression=compression)
        writer.start(reader.get_header().profile, library="another program")
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channels = {}
        for schema, channel, message in arrange(reader.iter_messages(log_time_order=False)):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_recording_that_another_program_has_rewritten_is_read_and_repaired(recorded, same, tmp_path, compression):
    file = tmp_path / "rewritten.mcap"
    rewrite(recorded.file, file, compression)
    with file.open("rb") as stream:
        chunks = [record for record in StreamReader(stream, emit_chunks=True).records if isinstance(record, Chunk)]
    assert {chunk.compression for chunk in chunks} == {
        "" if compression is CompressionType.NONE else compression.name.lower()
    }
    with Recording(file) as recording:
        found = list(recording.samples())
        assert (recording.losses, recording.complete) == ([], True)
    assert len(found) == len(recorded.published)
    assert all(same(one, other) for (_, one), (_, other) in zip(found, recorded.published, strict=True))
    assert repair(file, tmp_path / "repaired.mcap").losses == []


def test_a_damaged_chunk_that_another_program_has_compressed_is_told_and_the_next_one_found(recorded, tmp_path):
    file = tmp_path / "rewritten.mcap"
    rewrite(recorded.file, file, CompressionType.LZ4)
    first, second, *_ = McapScan(file).chunks
    for place, value in ((first.offset + first.length - 9, b"\xff" * 8), (first.offset + 1, struct.pack("<Q", 77))):
        data = bytearray(file.read_bytes())
        data[place : place + len(value)] = value
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(data)
        with Recording(damaged) as recording:
            assert 0 < len(list(recording.samples())) < len(recorded.published)
            assert recording.losses[0].offset == first.offset
            assert second.offset in [place.offset for place in recording._scan.chunks]


def twice(messages):
    """Forces once more, each behind itself."""
    for entry in messages:
        yield entry
        if entry[1].topic == "force":
            yield entry


def test_samples_that_stand_there_twice_are_counted_and_published_once(recorded, tmp_path):
    file = tmp_path / "twice.mcap"
    rewrite(recorded.file, file, arrange=twice)
    with open_replay(file) as playback:
        playback.run()
        assert playback.counts == {"force": 500, "camera": 10}
        topics = playback.recording.topics
        assert {name: (topic.repeated, topic.gaps) for name, topic in topics.items()} == {
            "force": (500, 0), "camera": (0, 0)
        }  # fmt: skip
        assert playback.recording.flaws == ["repeated: 500 samples of 'force' stand in the file once more"]
    report = repair(file, tmp_path / "repaired.mcap")
    assert (report.losses, report.flaws) == ([], ["repeated: 500 samples of 'force' stand in the file once more"])


def test_a_repeated_sample_hides_none_that_is_missing(recorded, tmp_path):
    file = tmp_path / "other.mcap"
    rewrite(recorded.file, file, arrange=lambda messages: [*(all_of := list(messages))[:100], *all_of[99:]])
    with Recording(file) as recording:
        found = recording.topics["force"]
    assert (found.count, found.repeated, found.gaps) == (501, 1, 0)
    rewrite(
        recorded.file, file, arrange=lambda messages: [*(all_of := list(messages))[:99], *all_of[98:120], *all_of[121:]]
    )
    with Recording(file) as recording:
        found = recording.topics["force"]
    assert (found.count, found.repeated, found.gaps) == (500, 1, 1)


def test_topics_one_after_the_other_are_not_taken_for_the_order_of_the_run(recorded, tmp_path, monkeypatch):
    """Each channel is in order, as MCAP asks for; what is not read far enough ahead cannot be put in its place."""
    file = tmp_path / "by_topic.mcap"

    def by_topic(messages):
        return sorted(messages, key=lambda each: each[1].topic.startswith("camera"))

    rewrite(recorded.file, file, arrange=by_topic)
    with open_replay(file) as playback:
        published = []
        playback.bus.watch(lambda topic: topic.subscribe(lambda sample: published.append(sample.order)))
        playback.run()
        assert published == sorted(published)
    monkeypatch.setattr(replay, "_READ_AHEAD", 100)
    with open_replay(file) as playback, pytest.raises(DataError, match="order in which they were published"):
        playback.run()


def test_names_that_no_topic_has_are_refused_and_patterns_may_match_none(recorded):
    with Recording(recorded.file) as recording:
        for wrong in ("force", ["nowhere"], ["force", "nowhere"]):
            with pytest.raises(ConfigError):
                list(recording.samples(wrong))
        with pytest.raises(ConfigError, match="not one text"):
            recording.samples(leave_out="force")
        assert len(list(recording.samples(name for name in ("force", "camera")))) == 510
        assert list(recording.samples(["nowhere*"])) == []
        assert list(recording.samples(["nowhere"], required=False)) == []


@pytest.mark.parametrize("profile", ["microdrivers", "ros2"])
def test_what_microdrivers_did_not_write_is_refused(tmp_path, profile):
    file = tmp_path / "other.mcap"
    with file.open("wb") as output:
        writer = Writer(output)
        writer.start(profile, library="another program")
        channel = writer.register_channel("/t", "json", writer.register_schema("T", "jsonschema", b"{}"))
        for index in range(3):
            writer.add_message(channel, index, b"{}", index)
        writer.finish()
    with pytest.raises(ForeignRecording, match="did not write it"):
        Recording(file)
    with pytest.raises(ForeignRecording, match="did not write it"):
        repair(file, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_a_recording_without_its_headers_is_known_by_its_messages(recorded, tmp_path):
    data = recorded.file.read_bytes().replace(b"created_utc", b"created_xyz")
    file = tmp_path / "damaged.mcap"
    for end in (len(data), -300):  # its summary, too
        file.write_bytes(data[:end])
        with Recording(file) as recording:
            assert len(list(recording.samples())) == len(recorded.published)
            assert "header is damaged: who made it is not known" in " ".join(map(str, recording.losses))


def test_a_file_may_be_named_by_a_text(recorded):
    with Recording(str(recorded.file)) as recording, open_replay(str(recorded.file)) as playback:
        assert recording.file == recorded.file
        assert playback.run() == len(recorded.published)
