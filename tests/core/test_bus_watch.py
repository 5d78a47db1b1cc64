"""Who watches a bus hears of every topic before its first sample."""

from microdrivers.core.bus import Bus
from microdrivers.core.samples import ForceSample, Sample


def test_a_watcher_hears_of_topics_that_are_there_and_of_those_that_come():
    bus, heard, samples = Bus(), [], []
    bus.topic("old", Sample)

    def watch(topic):
        heard.append(topic.name)
        topic.subscribe(samples.append)

    end = bus.watch(watch)
    sample = ForceSample(t_ns=0, device="cell", force_uN=0.0, raw_uN=0.0)
    bus.topic("new", ForceSample).publish(sample)
    bus.topic("new", ForceSample)
    end()
    bus.topic("later", Sample)
    assert heard == ["old", "new"]
    assert samples == [sample]
