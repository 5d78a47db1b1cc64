"""SYNC and the sets of PDOs that answer it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from microdrivers.backends.canopen.sync import SyncProducer
from microdrivers.backends.canopen.synced_pdos import PdosMissing, SyncedPdos, SyncSet
from microdrivers.backends.lines.can_in_process import InProcessAdapter, InProcessReceiver
from microdrivers.core.clock import SimulatedClock
from microdrivers.fakes.can import Due, Frame
from tests.backends.canopen_bench import LineBench


class Answerer:
    """Sends a PDO after every SYNC, with the number of the SYNC in it; some late, or never."""

    def __init__(self, cob_id: int, *, delay_ns: int = 60_000) -> None:
        self.cob_id, self.delay_ns = cob_id, delay_ns
        self.count = 0
        self.syncs_ns: list[int] = []
        self.odd: dict[int, int | None] = {}

    def receive(self, frame: Frame, t_ns: int) -> Sequence[Due]:
        if frame.id != 0x080:
            return ()
        self.count += 1
        self.syncs_ns.append(t_ns)
        delay_ns = self.odd.get(self.count, self.delay_ns)
        if delay_ns is None:
            return ()
        return (Due(t_ns + delay_ns, Frame(self.cob_id, self.count.to_bytes(4, "little"))),)

    def advance(self, t_ns: int) -> Sequence[Due]:
        return ()

    def next_event_ns(self) -> int | None:
        return None


class SyncBench(LineBench):
    """Three nodes that answer SYNCs."""

    def __init__(self) -> None:
        super().__init__(clock=SimulatedClock())
        self.answerers = [Answerer(0x181), Answerer(0x182, delay_ns=200_000), Answerer(0x183)]
        for answerer in self.answerers:
            self.medium.attach(answerer)
        self.sets: list[SyncSet] = []
        self.lost: list[Sequence[int]] = []
        self.pdos = SyncedPdos(self.line, [0x181, 0x182, 0x183], on_set=self.sets.append, on_lost=self.lost.append)
        self.pdos.begin_listening()

    @staticmethod
    def numbers(found: SyncSet) -> set[int]:
        return {int.from_bytes(frame.data, "little") for frame in found.frames}


def test_a_set_is_of_one_sync_and_stamped_at_it():
    with SyncBench() as bench:
        for _ in range(20):
            bench.clock.sleep(0.0037)
            found = bench.pdos.take(0.1)
            assert [frame.cob_id for frame in found.frames] == [0x181, 0x182, 0x183]
            assert len(bench.numbers(found)) == 1
            assert abs(found.t_ns - bench.answerers[0].syncs_ns[-1]) <= found.dt_ns
            assert found.dt_ns < 60_000
        assert not bench.sets


def test_a_stream_loses_nothing_beside_other_traffic_and_other_questions():
    with SyncBench() as bench:
        running = bench.pdos.run(100.0)
        other = bench.medium.open_port()
        bench.line.listen(0x190, lambda received: None)
        bench.clock.every(0.001, lambda: other.send(Frame(0x190, bytes(8))))
        for _ in range(100):
            bench.clock.sleep(0.0103)
            bench.pdos.take(0.1)
            bench.sdo.upload(0x2002, 0)
        assert bench.pdos.lost == bench.pdos.skipped == 0
        assert len(bench.sets) == pytest.approx(100 * bench.clock.now_ns() / 1e9, abs=3)
        assert all(len(bench.numbers(found)) == 1 for found in bench.sets)
        numbers = [found.number for found in bench.sets]
        assert numbers == sorted(set(numbers))
        times = [found.t_ns for found in bench.sets]
        assert times == sorted(times)
        for found in bench.sets:
            (number,) = bench.numbers(found)
            assert abs(found.t_ns - bench.answerers[0].syncs_ns[number - 1]) <= found.dt_ns
        running.cancel()
        count = len(bench.sets)
        bench.clock.sleep(0.1)
        assert len(bench.sets) == count


def test_an_answer_that_is_missing_loses_the_whole_set():
    """And the turns in which it might still have come."""
    with SyncBench() as bench:
        bench.answerers[1].odd[5] = None
        running = bench.pdos.run(100.0)
        bench.clock.sleep(0.3)
        running.cancel()
        assert bench.lost[0] == (0x182,)
        assert bench.pdos.lost == 3
        assert 4 <= bench.pdos.skipped <= 8
        numbers = [number for found in bench.sets for number in bench.numbers(found)]
        assert numbers == [1, 2, 3, 4, *range(8, 8 + len(numbers) - 4)]
        assert len(numbers) + bench.pdos.lost + bench.pdos.skipped in (29, 30, 31)


def test_a_silent_node_keeps_no_other_stream_waiting():
    with SyncBench() as bench:
        others: list[SyncSet] = []
        well = SyncedPdos(bench.line, [0x181, 0x183], on_set=others.append, on_lost=lambda missing: None)
        well.begin_listening()
        bench.pdos.take(0.1)
        well.take(0.1)
        running, stream = bench.pdos.run(100.0), well.run(100.0)
        bench.answerers[1].odd = dict.fromkeys(range(50, 150), None)
        bench.clock.sleep(3.0)
        running.cancel()
        stream.cancel()
        assert well.lost == 0
        assert well.skipped <= 12  # once for the loss, once for the return
        assert bench.pdos.lost == pytest.approx(100, abs=3)
        assert set(bench.lost) <= {(0x182,), ()}
        assert all(len(bench.numbers(found)) == 1 for found in [*bench.sets, *others])
        assert bench.sets[-1].number == others[-1].number


def test_a_late_answer_is_never_mixed_with_the_next_ones():
    with SyncBench() as bench:
        bench.answerers[1].odd[5] = 12_000_000
        bench.answerers[2].odd[9] = 39_000_000
        bench.answerers[2].odd[20] = 70_000_000
        running = bench.pdos.run(100.0)
        bench.clock.sleep(0.5)
        running.cancel()
        assert all(len(bench.numbers(found)) == 1 for found in bench.sets)
        numbers = [number for found in bench.sets for number in bench.numbers(found)]
        assert numbers[:19] == list(range(1, 20))
        assert 20 not in numbers
        assert len(numbers) > 25


def test_answers_that_are_handed_over_late_belong_to_their_own_sync(monkeypatch: pytest.MonkeyPatch):
    """A busy computer reads frames milliseconds after they have passed: their stamps tell where they belong."""
    monkeypatch.setattr(SyncProducer, "_await_answers", lambda producer: None)
    with SyncBench() as bench:
        adapter, receiver = bench.line._adapter, bench.line._receiver
        assert isinstance(adapter, InProcessAdapter)
        assert isinstance(receiver, InProcessReceiver)
        running = bench.pdos.run(200.0)
        for _ in range(20):
            bench.clock.sleep(0.0437)
            adapter._bus.on_arrival(None)
            bench.clock.sleep(0.0131)
            adapter.port.deliver_to(receiver._take, receiver._fail)
        running.cancel()
        assert bench.pdos.lost == bench.pdos.skipped == 0
        assert [number for found in bench.sets for number in bench.numbers(found)] == list(
            range(1, 1 + len(bench.sets))
        )
        assert len(bench.sets) > 220
        for found in bench.sets:
            assert abs(found.t_ns - bench.answerers[0].syncs_ns[found.number - 1]) <= found.dt_ns


def test_nodes_that_take_long_are_waited_for():
    with SyncBench() as bench:
        for answerer in bench.answerers:
            answerer.delay_ns = 12_000_000
        running = bench.pdos.run(100.0)
        bench.clock.sleep(1.0)
        running.cancel()
        assert len(bench.sets) in (99, 100, 101)
        assert bench.pdos.lost == bench.pdos.skipped == 0
        assert all(len(bench.numbers(found)) == 1 for found in bench.sets)


def test_answers_to_somebody_elses_sync_are_no_answers_to_ours():
    with SyncBench() as bench:
        other = bench.medium.open_port()
        running = bench.pdos.run(100.0)
        other.send(Frame(0x080), t_ns=bench.clock.now_ns() + 19_900_000)
        other.send(Frame(0x080), t_ns=bench.clock.now_ns() + 120_100_000)
        bench.clock.sleep(3.0)
        running.cancel()
        assert all(len(bench.numbers(found)) == 1 for found in bench.sets)
        assert bench.line.service(SyncProducer).foreign == 2
        for found in bench.sets:
            (number,) = bench.numbers(found)
            assert abs(found.t_ns - bench.answerers[0].syncs_ns[number - 1]) <= found.dt_ns
        assert len(bench.sets) > 180
        assert len(bench.sets) + bench.pdos.lost + bench.pdos.skipped in (299, 300, 301)


def test_an_answer_to_no_sync_at_all_has_the_count_begin_anew():
    with SyncBench() as bench:
        bench.pdos.take(0.1)
        bench.medium.open_port().send(Frame(0x182, bytes(4)))
        bench.clock.sleep(0.01)
        start_ns = bench.clock.now_ns()
        assert bench.numbers(bench.pdos.take(0.1)) == {2}
        assert bench.clock.now_ns() - start_ns > 30_000_000


def test_a_question_is_asked_twice_then_the_missing_are_named():
    with SyncBench() as bench:
        bench.answerers[0].odd[1] = None
        found = bench.pdos.take(0.1)
        assert bench.numbers(found) == {2}
        bench.answerers[2].odd = dict.fromkeys(range(10), None)
        with pytest.raises(PdosMissing, match="no answer to SYNC from 183h within 100 ms") as caught:
            bench.pdos.take(0.1)
        assert caught.value.missing == (0x183,)


def test_whoever_waits_can_be_told_to_give_up():
    with SyncBench() as bench:
        bench.answerers[2].odd = dict.fromkeys(range(10), None)
        hearing = bench.line.listen(0x181, lambda received: bench.pdos.pause())
        start_ns = bench.clock.now_ns()
        with pytest.raises(PdosMissing):
            bench.pdos.take(0.3)
        assert bench.clock.now_ns() - start_ns < 5_000_000
        hearing.cancel()
        bench.answerers[2].odd.clear()
        bench.pdos.resume()
        bench.pdos.take(0.3)


def test_who_joins_in_leaves_the_first_answers_alone():
    """They might be answers to the SYNC before."""
    with SyncBench() as bench:
        bench.answerers[0].delay_ns = 3_000_000
        running = bench.pdos.run(200.0)
        bench.clock.sleep(0.1012)
        joined: list[SyncSet] = []
        late = SyncedPdos(bench.line, [0x181], on_set=joined.append, on_lost=lambda missing: None)
        late.begin_listening()
        stream = late.run(200.0)
        bench.clock.sleep(0.1)
        stream.cancel()
        running.cancel()
        assert len(joined) > 15
        for found in joined:
            (number,) = bench.numbers(found)
            assert abs(found.t_ns - bench.answerers[0].syncs_ns[number - 1]) <= found.dt_ns
        assert late.lost == late.skipped == bench.pdos.lost == bench.pdos.skipped == 0


def test_two_streams_share_the_faster_ones_syncs():
    with SyncBench() as bench:
        slow: list[SyncSet] = []
        others = SyncedPdos(bench.line, [0x181], on_set=slow.append, on_lost=lambda missing: None)
        others.begin_listening()
        fast, slower = bench.pdos.run(100.0), others.run(25.0)
        bench.clock.sleep(2.001)
        assert len(bench.sets) in (200, 201)
        assert len(slow) in (50, 51)
        assert bench.answerers[0].count in (200, 201)
        fast.cancel()
        count = bench.answerers[0].count
        bench.clock.sleep(2.0)
        assert bench.answerers[0].count - count in (49, 50, 51)
        slower.cancel()
        others.end_listening()


def test_who_is_answered_later_loses_nothing_by_the_questions_of_others():
    """A question ends with its own answers, on a simulated clock ahead of beats that fell due meanwhile."""
    with SyncBench() as bench:
        bench.answerers[2].delay_ns = 2_500_000
        asked = SyncedPdos(bench.line, [0x181], on_set=lambda found: None, on_lost=lambda missing: None)
        asked.begin_listening()
        running = bench.pdos.run(100.0)
        for _ in range(300):
            bench.clock.sleep(0.0017)
            with bench.clock.transaction():  # an exchange with another node goes before
                bench.clock.sleep(0.002)
                asked.take(0.1)
        running.cancel()
        assert bench.pdos.lost == bench.pdos.skipped == 0
        assert all(len(bench.numbers(found)) == 1 for found in bench.sets)


def test_a_turn_that_falls_into_a_question_waits_for_its_answers():
    """In real time a stream's beat may come while somebody else has just sent a SYNC."""
    with SyncBench() as bench:
        bench.line.service(SyncProducer).fire()
        running = bench.pdos.run(1.0)  # its first beat is now
        bench.clock.sleep(0.01)
        running.cancel()
        assert [bench.numbers(found) for found in bench.sets] == [{2}]
        assert bench.pdos.lost == bench.pdos.skipped == 0


def test_a_second_producer_is_counted():
    with SyncBench() as bench:
        bench.medium.open_port().send(Frame(0x080))
        bench.clock.sleep(0.01)
        assert bench.line.service(SyncProducer).foreign == 1
