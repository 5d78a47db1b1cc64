"""One bit of what no CRC covers is flipped, or a whole record is gone: nothing is lost without a word."""

import struct
from collections import Counter

import pytest

from microdrivers.recording.errors import RecordingError
from microdrivers.recording.reader import Recording

HEAD = struct.Struct("<BQ")
MAGIC_BYTES = 8
BETWEEN_CHUNKS, MESSAGE_INDEX, DATA_END = (0x01, 0x09, 0x0C), 0x07, 0x0F


@pytest.fixture
def small(stage):
    """A recording of two topics in three chunks, with an attachment."""
    with stage.recorder() as recorder:
        recorder.attach("rig.yaml", b"name: test\n", "application/yaml")
        recorder.follow_arrivals("optics", [0, 1, 2])
        for index in range(2):
            stage.clock.sleep(0.1)
            stage.force(index)
        stage.frame(0, shape=(2, 3))
        stage.clock.sleep(0.1)
        stage.force(2)
    return stage.file


def records(data):
    """Kind, begin and end of each record outside of chunks."""
    place = MAGIC_BYTES
    while place < len(data) - MAGIC_BYTES:
        opcode, length = HEAD.unpack_from(data, place)
        yield opcode, place, place + HEAD.size + length
        place += HEAD.size + length


def content(recording):
    samples = Counter((topic, sample.seq, sample.t_ns) for topic, sample in recording.samples())
    return samples, recording.header, recording.clock, recording.attachments, recording.arrivals


def check_is_whole_or_tells(file, data, expected):
    file.write_bytes(data)
    try:
        with Recording(file) as recording:
            return bool(recording.losses) or content(recording) == expected
    except RecordingError:
        return True


def test_no_flipped_bit_of_a_records_head_loses_anything_silently(small, tmp_path):
    whole, file = small.read_bytes(), tmp_path / "flipped.mcap"
    with Recording(small) as recording:
        expected = content(recording)
        assert (sum(expected[0].values()), len(recording._scan.chunks)) == (4, 4)
    stride = 1
    for opcode, begin, _ in records(whole):
        for bit in range(0, 8 * HEAD.size, stride):
            data = bytearray(whole)
            data[begin + bit // 8] ^= 1 << bit % 8
            assert check_is_whole_or_tells(file, data, expected), (opcode, begin, bit)
        if opcode == DATA_END:
            stride = 5  # what follows has a CRC


def test_no_record_goes_missing_silently(small, tmp_path):
    whole, file = small.read_bytes(), tmp_path / "without.mcap"
    with Recording(small) as recording:
        expected = content(recording)
    for opcode, begin, end in records(whole):
        for data in (whole[:begin] + whole[end:], whole[:begin] + bytes(end - begin) + whole[end:]):
            assert check_is_whole_or_tells(file, data, expected), (opcode, begin)
        named = whole.find(b"clock", begin, end)
        if named > 0:
            data = whole[:named] + bytes(5) + whole[named + 5 :]
            assert check_is_whole_or_tells(file, data, expected), (opcode, begin)


@pytest.mark.parametrize("end", ["as it is", "cut off", "summary damaged", "footer damaged"])
def test_an_index_that_looks_like_the_end_of_the_data_is_not(recorded, tmp_path, end):
    whole, file = bytearray(recorded.file.read_bytes()), tmp_path / "damaged.mcap"
    found = list(records(whole))
    [data_end] = [begin for opcode, begin, _ in found if opcode == DATA_END]
    if end == "cut off":
        del whole[data_end + 300 :]
    elif end == "summary damaged":
        whole[data_end + 50] ^= 1
    elif end == "footer damaged":
        whole[-20] ^= 1
    indexes = [begin for opcode, begin, _ in found if opcode == MESSAGE_INDEX]
    for begin in (indexes[0], indexes[len(indexes) // 2], indexes[-1]):
        for length in (None, 4):  # also if two bytes say so
            data = bytearray(whole)
            data[begin] = DATA_END
            if length:
                data[begin + 1 : begin + HEAD.size] = struct.pack("<Q", length)
            file.write_bytes(data)
            with Recording(file) as recording:
                assert len(list(recording.samples())) == len(recorded.published)
                assert recording.complete or end == "cut off"
                told = [loss.what for loss in recording.losses if loss.offset == begin]
                last = begin == indexes[-1]
                assert told == ["the file ends in the middle of a record" if last else "something is damaged here"]


def test_chunks_that_the_summary_does_not_list_are_not_delivered(recorded, tmp_path):
    """Another program has written a torn recording over the beginning of one."""
    whole, file = recorded.file.read_bytes(), tmp_path / "mixed.mcap"
    scan = Recording(recorded.file)._scan
    first, second = scan.chunks[:2]
    chunk = whole[first.offset : first.offset + first.length]
    gap = second.offset + second.length - (first.offset + first.length + 1)
    mixed = whole[: first.offset + 1] + chunk + bytes(gap) + whole[second.offset + second.length :]
    assert len(mixed) == len(whole)
    file.write_bytes(mixed)
    with Recording(file) as recording:
        assert len(list(recording.samples())) < len(recorded.published)
        assert "1 chunks are of another recording" in [loss.what for loss in recording.losses]


@pytest.mark.parametrize("cut_off", [False, True])
def test_a_wrong_length_between_chunks_costs_nothing(small, tmp_path, cut_off):
    data, file = small.read_bytes(), tmp_path / "flipped.mcap"
    [end] = [begin for opcode, begin, _ in records(data) if opcode == DATA_END]
    whole = data[:end] if cut_off else data
    file.write_bytes(whole)
    with Recording(file) as recording:
        expected = content(recording)
    for opcode, begin, _ in records(data[:end] + bytes(MAGIC_BYTES)):
        for bit in range(64) if opcode in BETWEEN_CHUNKS else ():
            flipped = bytearray(whole)
            flipped[begin + 1 + bit // 8] ^= 1 << bit % 8
            file.write_bytes(flipped)
            with Recording(file) as recording:
                assert content(recording) == expected, (opcode, begin, bit)
                assert any("length" in loss.what for loss in recording.losses)
