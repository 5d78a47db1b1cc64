"""Another program writes to the file that is being recorded: the recorder notices, and counts what is lost."""

import pytest

from microdrivers.core.bus import Bus
from microdrivers.core.clock import SimulatedClock
from microdrivers.core.samples import ForceSample
from microdrivers.recording.header import RecordingHeader
from microdrivers.recording.reader import Recording
from microdrivers.recording.recorder import Recorder


def record_another(file, *, seconds):
    bus, clock = Bus(), SimulatedClock()
    with Recorder(file, bus=bus, clock=clock, header=RecordingHeader(source="fake")):
        for index in range(round(seconds * 1000)):
            clock.sleep(0.001)
            bus.topic("force", ForceSample).publish(
                ForceSample(t_ns=clock.now_ns(), device="another", seq=index, force_uN=0.0, raw_uN=0.0)
            )
    return file.read_bytes()


def truncate(file, _tmp_path, _recorder):
    file.write_bytes(b"")


def append(file, _tmp_path, _recorder):
    with file.open("ab") as stream:
        stream.write(bytes(10**6))


def copy_smaller(file, tmp_path, _recorder):
    file.write_bytes(record_another(tmp_path / "other.mcap", seconds=0.2))


def copy_larger(file, tmp_path, _recorder):
    file.write_bytes(record_another(tmp_path / "other.mcap", seconds=3))


def copy_torn(file, tmp_path, _recorder):
    whole = record_another(tmp_path / "other.mcap", seconds=0.2)
    file.write_bytes(whole[: len(whole) // 2])


def truncate_while_a_chunk_is_written(file, _tmp_path, recorder):
    """The size is then as expected."""
    output = recorder._output

    class Interfering:
        def write(self, data):
            if data.nbytes == 60 * 40:  # pixels
                file.write_bytes(b"")
            return output.write(data)

        def __getattr__(self, name):
            return getattr(output, name)

    recorder._out._writer._output = Interfering()


def overwrite(file, place):
    with file.open("r+b") as stream:
        stream.seek(place)
        stream.write(bytes(8))


def overwrite_the_head(file, _tmp_path, _recorder):
    overwrite(file, 60)


def overwrite_the_last_chunk(file, _tmp_path, recorder):
    overwrite(file, [record for record in recorder._out._writer.written if record.is_chunk][-1].offset + 20)


WHILE_RECORDING = (
    truncate, append, copy_smaller, copy_larger, copy_torn, truncate_while_a_chunk_is_written, overwrite_the_head
)  # fmt: skip


@pytest.mark.parametrize("do", [*WHILE_RECORDING, overwrite_the_last_chunk])
def test_another_writer_is_noticed_and_what_is_lost_is_counted(stage, tmp_path, do):
    with stage.recorder() as recorder:
        stage.run(seconds=0.6)
        if do in WHILE_RECORDING:
            do(stage.file, tmp_path, recorder)
            stage.run(seconds=0.4)
        else:
            finish = recorder._out.finish

            def finish_and_do(*arguments, **options):
                finish(*arguments, **options)
                do(stage.file, tmp_path, recorder)

            recorder._out.finish = finish_and_do
    assert recorder.disturbance.startswith("corrupt: another program wrote to it")
    published = len(stage.published)
    with Recording(stage.file) as recording:
        found = [topic for topic, sample in recording.samples() if sample.device != "another"]
        assert recording.losses
    counted = {topic: (count.messages, count.dropped) for topic, count in recorder.counts.items()}
    assert {topic: found.count(topic) for topic in counted} == {topic: kept for topic, (kept, _) in counted.items()}
    assert sum(kept + lost for kept, lost in counted.values()) == published
    assert (recorder.dropped > 0) == (do not in (append, overwrite_the_head))


@pytest.mark.parametrize("do", [truncate, copy_larger, truncate_while_a_chunk_is_written])
def test_a_recording_that_is_to_stop_on_a_failure_stops_if_another_program_writes_to_it(stage, tmp_path, do):
    with stage.recorder(on_failure="stop") as recorder:
        stage.run(seconds=0.3)
        assert not recorder.stopped
        do(stage.file, tmp_path, recorder)
        stage.run(seconds=0.3)
        assert recorder.stopped
