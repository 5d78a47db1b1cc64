"""An answer too many: nobody knows any more which SYNC an answer belongs to."""

from microdrivers.fakes.can import Frame
from tests.backends.test_canopen_sync import SyncBench


def test_an_answer_too_many_loses_the_set_that_it_falls_into_and_no_other():
    with SyncBench() as bench:
        running = bench.pdos.run(100.0)
        bench.clock.sleep(0.0455)
        sound = len(bench.sets)
        assert sound == 5
        bench.answerers[1].delay_ns = 2_000_000  # so that the others' second answers come before its first
        other = bench.medium.open_port()
        bench.clock.sleep(0.0056)  # in between: two nodes have answered, one has not
        other.send(Frame(0x181, bytes(4)))
        bench.clock.sleep(0.3)
        running.cancel()
        assert bench.pdos.lost >= 1
        assert len(bench.sets) > sound
        for found in bench.sets:
            assert len(bench.numbers(found)) == 1
            assert [frame.cob_id for frame in found.frames] == [0x181, 0x182, 0x183]
