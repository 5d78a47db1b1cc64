"""Ctrl-C, or no memory, at any moment of writing: the file stays whole, and what is not in it is counted."""

import contextlib
import dis
import functools
import itertools
import sys

import pytest
from mcap.reader import make_reader

from microdrivers.core.clock import SystemClock
from microdrivers.core.samples import ForceSample, Frame
from microdrivers.recording import mcap_records, mcap_writer, recorder, sample_file
from microdrivers.recording.channels import ARRIVALS_TOPIC
from microdrivers.recording.mcap_scan import NOT_ENDED
from microdrivers.recording.reader import Recording

WRITING = {module.__file__ for module in (mcap_records, mcap_writer, recorder, sample_file)}
STRIDE = 29
"""Of all moments, so many are looked at for one."""


@functools.cache
def moments(code):
    """Where Python raises what a signal handler does: after calls and jumps back. Function entries are as the call."""
    pairs = itertools.pairwise(dis.get_instructions(code))
    return {after.offset for before, after in pairs if before.opname.startswith(("CALL", "JUMP_BACKWARD"))}


class Interrupted:
    """Raises `error` at the given moment of the code that writes a recording, once; a context manager."""

    def __init__(self, at, error):
        self.passed = 0
        self._at = at
        self._error = error
        self._returned = set()

    def _trace(self, frame, event, _):
        if event == "call" and frame.f_code.co_name != "__init__":
            self._returned.add(frame.f_back)  # calls of Python functions end without a look at signals
        if frame.f_code.co_filename not in WRITING:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            returned = frame in self._returned
            self._returned.discard(frame)
            if frame.f_lasti in moments(frame.f_code) and not returned:
                self.passed += 1
                if self.passed == self._at:
                    raise self._error
        return self._trace

    def __enter__(self):
        self._before = sys.gettrace()
        sys.settrace(self._trace)
        return self

    def __exit__(self, *_):
        sys.settrace(self._before)


def publish(stage, arrivals, error):
    for index in range(6):
        if stage.clock.simulated:
            stage.clock.sleep(0.05)
        with contextlib.suppress(error):
            stage.force(index)
            if index % 3 == 1:
                stage.frame(index, shape=(4, 6))
        arrivals.append(index)


def check(stage, recorder, arrivals):
    """All that was published is in the file or counted, and any program reads it; returns whether it has its end."""
    assert not recorder.disturbance
    with Recording(stage.file) as recording:
        assert [str(loss) for loss in recording.losses if NOT_ENDED not in str(loss)] == []
        for topic, kind in (("force", ForceSample), ("camera", Frame)):
            found = [sample.seq for _, sample in recording.samples([topic])]
            published = [sample.seq for sample in stage.bus.topic(topic, kind).history]
            count = recorder.counts[topic]
            assert found == sorted(set(found) & set(published))
            assert (count.messages, count.dropped) == (len(found), len(published) - len(found))
            assert not recording.complete or recording.topics[topic].dropped == count.dropped
        if recording.complete:
            lost = recorder.counts.get(ARRIVALS_TOPIC)
            assert recording.arrivals.get("host", []) == arrivals or lost.dropped == 1
            with stage.file.open("rb") as stream:
                assert list(make_reader(stream, validate_crcs=True).iter_messages())
        return recording.complete


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("in_real_time", [False, True])
def test_an_interruption_leaves_a_whole_file_and_is_counted(stage, in_real_time, error):
    def run(at):
        stage.file.unlink(missing_ok=True)
        again = type(stage)(stage.file.parent)
        if in_real_time:
            again.clock = SystemClock()
            again.clock.close()  # all is left to `close`
        arrivals = []
        recorder = again.recorder()
        recorder.follow_arrivals("host", arrivals)
        interrupted = Interrupted(at, error)
        if in_real_time:
            publish(again, arrivals, error)
            with interrupted, contextlib.suppress(error):
                recorder.close()
        else:
            with interrupted:
                publish(again, arrivals, error)
            recorder.close()
        return interrupted.passed, check(again, recorder, arrivals)

    total, ended = run(0)
    assert ended
    assert total > 300
    for at in range(1, total, STRIDE):
        _, ended = run(at)
        assert ended or in_real_time
