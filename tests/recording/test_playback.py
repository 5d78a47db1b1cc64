"""A recording is published again, in its order, and whoever listens finds the clock at the sample's time."""

import pytest

from microdrivers.core.clock import SystemClock
from microdrivers.core.errors import ConfigError
from microdrivers.core.samples import ForceSample, Frame
from microdrivers.recording.playback import open_replay
from microdrivers.recording.reader import Recording


def test_all_is_published_in_order_with_the_recorded_times(recorded, same):
    with open_replay(recorded.file) as playback:
        got, late_ns = [], []
        for topic, kind in (("force", ForceSample), ("camera", Frame)):
            playback.bus.topic(topic, kind).subscribe(lambda sample, topic=topic: got.append((topic, sample)))
        first_ns = recorded.published[0][1].t_ns
        force = playback.bus.topic("force", ForceSample)
        force.subscribe(lambda s: late_ns.append(playback.clock.now_ns() + first_ns - s.t_ns))
        assert playback.run() == len(recorded.published)
        assert [topic for topic, _ in got] == [topic for topic, _ in recorded.published]
        assert all(same(one, other) for (_, one), (_, other) in zip(got, recorded.published, strict=True))
        assert set(late_ns) == {0}
        assert playback.counts == {"force": 500, "camera": 10}
        assert playback.span_s == pytest.approx(0.499)
        with pytest.raises(ConfigError, match="already"):
            playback.run()


def test_frames_that_are_left_out_are_not_published(recorded):
    with open_replay(recorded.file, leave_out=("cam*",)) as playback:
        playback.run()
        assert playback.counts == {"force": 500}


def test_a_speed_needs_a_clock_that_waits(recorded):
    with open_replay(recorded.file) as playback:
        with pytest.raises(ConfigError, match="simulated clock"):
            playback.run(1.0)
        with pytest.raises(ConfigError, match="not possible"):
            playback.run(0.0)


def test_at_a_speed_times_keep_their_distances(recorded):
    clock = SystemClock()
    with open_replay(recorded.file, clock=clock) as playback:
        begin_ns = clock.now_ns()
        playback.run(10.0)
        assert clock.now_ns() - begin_ns >= 0.0499e9
    clock.close()


def test_what_was_read_is_not_read_again_to_survey_it(stage, monkeypatch):
    with stage.recorder():
        for seq in range(6):
            stage.clock.sleep(0.05)
            stage.force(seq)
            stage.frame(seq + (seq > 3), shape=(300, 400))
    with Recording(stage.file) as whole, Recording(stage.file) as recording:
        assert len(list(recording.samples())) == 12
        read, read_chunk = [], recording._scan.read_chunk
        monkeypatch.setattr(recording._scan, "read_chunk", lambda place: read.append(place) or read_chunk(place))
        assert recording.topics == whole.topics
        assert recording.topics["camera"].gaps == 1
        assert recording.flaws == whole.flaws
        assert sum(place.length for place in read) < 2 * 300 * 400
