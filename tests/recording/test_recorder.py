"""The recorder: what is published is in the file, or is counted as lost."""

import errno
import threading
from pathlib import Path

import numpy as np
import pytest

from microdrivers.core.clock import SimulatedClock, SystemClock
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import ForceSample, Frame, Sample, WireTraffic
from microdrivers.recording import recorder as recorder_module
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import RecordingFailed


def read(file):
    return list(Recording(file).samples())


def same_all(same, found, expected):
    return len(found) == len(expected) and all(
        topic == other_topic and same(one, other)
        for (topic, one), (other_topic, other) in zip(found, expected, strict=True)
    )


def test_all_that_is_published_is_read_back_in_order(recorded, same):
    recording = Recording(recorded.file)
    assert same_all(same, list(recording.samples()), recorded.published)
    assert recording.losses == []
    assert recording.complete
    assert recording.attachments == {"rig.yaml": b"name: test\n"}
    assert (recording.header.source, recording.header.seed) == ("fake", 3)
    force, camera = recording.topics["force"], recording.topics["camera"]
    assert (force.sample_type, force.count, force.rate_hz, force.gaps) == (ForceSample, 500, 1000.0, 0)
    assert (camera.sample_type, camera.count, camera.first_t_ns) == (Frame, 10, 1_000_000)


def test_the_same_run_gives_the_same_bytes(tmp_path, stage, recorded):
    again = type(stage)(tmp_path / "again")
    (tmp_path / "again").mkdir()
    with again.recorder() as recorder:
        recorder.attach("rig.yaml", b"name: test\n", "application/yaml")
        again.run()
    assert again.file.read_bytes() == recorded.file.read_bytes()


def test_topics_that_appear_later_are_recorded_and_what_was_true_before(stage, same):
    stage.publish("truth/specimen", ForceSample(t_ns=0, device="world", force_uN=1.0, raw_uN=1.0))
    stage.force(0, topic="before")
    with stage.recorder():
        stage.force(1, topic="later")
    truth, _before, later = stage.published
    assert same_all(same, read(stage.file), [truth, later])


def test_topics_are_chosen_by_pattern_and_wires_by_name_only(stage):
    traffic = WireTraffic(t_ns=0, device="cell", direction="sent", data=b"\0?")
    with stage.recorder():
        stage.publish("cell/wire", traffic)
        assert not stage.bus.topic("cell/wire", WireTraffic).heard
    stage.file.unlink()
    with stage.recorder(topics=["*/wire", "forc*"]):
        stage.force(0)
        stage.force(0, topic="other")
        stage.publish("cell/wire", traffic)
    assert [topic for topic, _ in read(stage.file)] == ["force", "cell/wire"]
    assert [topic for topic, _ in Recording(stage.file).samples(["f*"])] == ["force"]
    stage.file.unlink()
    with stage.recorder(topics=["cell*"]):
        stage.publish("cell/wire", traffic)
    assert read(stage.file) == []


def test_frames_can_be_left_out(recorded):
    recording = Recording(recorded.file)
    assert sum(1 for _ in recording.samples(["force"])) == 500
    assert sum(1 for _ in recording.samples(["camera"])) == 10


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, ">u2"])
def test_images_are_compressed_without_loss(stage, dtype):
    with stage.recorder(compress_images=True):
        stage.frame(0, shape=(200, 300), dtype=dtype)
    [(_, frame)] = read(stage.file)
    assert np.array_equal(frame.image, stage.published[0][1].image)
    assert not frame.image.flags.writeable
    assert stage.file.stat().st_size < frame.image.nbytes


def test_a_view_of_an_image_is_recorded_as_it_looks(stage):
    wide = np.arange(48, dtype=np.uint8).reshape(6, 8)
    for image in (wide[::2, ::-1], wide.T, wide[:0]):
        stage.publish(
            "camera", Frame(t_ns=0, device="c", image=image, exposure_ms=1, frame_id=0, principal_point_px=(0.0, 0.0))
        )
    with stage.recorder() as recorder:
        for _, frame in stage.published:
            stage.bus.topic("camera", Frame).publish(frame)
    pairs = zip(read(stage.file), stage.published, strict=True)
    assert all(np.array_equal(frame.image, given.image) for (_, frame), (_, given) in pairs)
    assert recorder.counts["camera"].dropped == 0


def test_what_does_not_fit_is_counted_and_told(stage, caplog):
    with stage.recorder() as recorder:
        stage.force(2**63)
        stage.force(1)
        stage.bus.topic("any", Sample).publish(Sample(t_ns=0, device="\ud800"))
        stage.bus.topic("any", Sample).publish(ForceSample(t_ns=0, device="x", force_uN=0.0, raw_uN=0.0))
        stage.frame(0, dtype=np.float32)
    assert {topic: count.dropped for topic, count in recorder.counts.items()} == {"force": 1, "any": 2, "camera": 1}
    recording = Recording(stage.file)
    assert [sample.seq for _, sample in recording.samples()] == [1]
    assert {topic: found.dropped for topic, found in recording.topics.items()} == {"force": 1, "any": 2, "camera": 1}
    assert "4 samples were not recorded" in caplog.text


def test_arrivals_are_kept_by_host_and_survive_a_kill(stage):
    orders = []
    with stage.recorder() as recorder:
        recorder.follow_arrivals("optics", orders)
        recorder.follow_arrivals("force", [5, 3])
        for index in range(300):
            stage.clock.sleep(0.001)
            stage.force(index)
            orders.append(index)
        torn = stage.file.read_bytes()
    assert Recording(stage.file).arrivals == {"force": [5, 3], "optics": list(range(300))}
    stage.file.write_bytes(torn)
    recording = Recording(stage.file)
    assert not recording.complete
    assert len(recording.arrivals["optics"]) >= 200
    assert len(list(recording.samples())) >= 200


def test_an_existing_file_is_never_written_over(stage):
    with stage.recorder():
        with pytest.raises(ConfigError, match="the file already exists"):
            stage.recorder()
        stage.force(0)
    with pytest.raises(ConfigError, match="the file already exists"):
        stage.recorder()
    assert len(read(stage.file)) == 1


def test_a_folder_that_is_not_there_is_told(stage, tmp_path):
    stage.file = tmp_path / "nowhere" / "run.mcap"
    with pytest.raises(ConfigError, match="cannot be written there: No such file"):
        stage.recorder()


class FullDisk:
    """A file on a disk with so much space, which may get more; a write that does not fit is done in part."""

    def __init__(self, file, space):
        self._file = file.open("w+b", buffering=0)
        self.space = space

    def write(self, data):
        room = self.space - self._file.tell()
        if room <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self._file.write(memoryview(data)[:room])

    def __getattr__(self, name):
        return getattr(self._file, name)


@pytest.fixture
def full_disk(monkeypatch):
    disks = []

    def create(file):
        disks.append(FullDisk(file, 60_000))
        return disks[-1]

    monkeypatch.setattr(recorder_module, "create_file", create)
    return disks


def test_a_full_disk_is_counted_said_once_and_left_behind_when_there_is_space(stage, full_disk, caplog, same):
    with stage.recorder() as recorder:
        stage.run(frames=False, seconds=1)
        full_disk[0].space = 1_000_000
        stage.event()
    count = recorder.counts["force"]
    recording = Recording(stage.file)
    found = list(recording.samples())
    assert count.dropped > 100
    assert len(found) == count.messages + 1 == 1001 - count.dropped
    assert recording.losses == []
    assert recording.topics["force"].dropped == count.dropped
    assert caplog.text.count("No space left") == 1
    assert all(same(sample, stage.published[sample.seq][1]) for topic, sample in found if topic == "force")


@pytest.mark.parametrize("clock", [SimulatedClock, SystemClock])
def test_a_full_disk_asks_the_program_to_stop_if_that_is_wanted_and_throws_nothing_at_it(stage, full_disk, clock):
    stage.clock = clock()
    recorder = stage.recorder(on_failure="stop")
    before = recorder.stopped
    for index in range(5000):
        stage.force(index)
    for _ in range(3):
        stage.clock.sleep(0.1)
    after = recorder.stopped
    with pytest.raises(RecordingFailed, match="No space left"):
        recorder.close()
    stage.clock.close()
    assert (before, after) == (False, True)
    assert len(read(stage.file)) > 100


def test_a_device_that_is_always_full(stage, monkeypatch):
    monkeypatch.setattr(recorder_module, "create_file", lambda _file: FullDisk(Path("/dev/full"), 10**9))
    with pytest.raises(ConfigError, match="No space left"):
        stage.recorder()


@pytest.mark.xdist_group("real_time")
def test_in_real_time_publishers_only_fill_a_queue(stage, same):
    stage.clock = SystemClock()
    with stage.recorder():

        def publish(name):
            for index in range(200):
                stage.force(index, topic=name)

        threads = [threading.Thread(target=publish, args=(name,)) for name in ("a", "b")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    stage.clock.close()
    recording = Recording(stage.file)
    assert recording.clock.kind == "system"
    assert recording.clock.offset_ns > 1_500_000_000 * 10**9
    for name in ("a", "b"):
        found = list(recording.samples([name]))
        assert same_all(same, found, [each for each in stage.published if each[0] == name])


@pytest.mark.xdist_group("real_time")
def test_a_disk_that_does_not_keep_up_blocks_nobody(stage, monkeypatch):
    monkeypatch.setattr(recorder_module, "QUEUE_SAMPLES", 10)
    monkeypatch.setattr(recorder_module, "QUEUE_IMAGE_BYTES", 5000)
    stage.clock = SystemClock()
    with stage.recorder() as recorder:
        with recorder._write_lock:  # the disk hangs
            stage.frame(0)
            stage.frame(1)
            stage.frame(2)
            for index in range(30):
                stage.force(index)
        assert recorder.counts["camera"].dropped == 1
        assert recorder.counts["force"].dropped == 22
    stage.clock.close()
    assert {topic: found.dropped for topic, found in Recording(stage.file).topics.items()} == {"camera": 1, "force": 22}


def test_it_may_be_closed_after_the_clock(stage):
    stage.clock = SystemClock()
    recorder = stage.recorder()
    stage.clock.close()
    stage.force(0)
    recorder.close()
    assert len(read(stage.file)) == 1
