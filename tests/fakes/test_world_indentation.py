"""A contact as a function of time: the same answer to everybody, whatever was asked before."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from microdrivers.core.units import NS_PER_MS, NS_PER_S
from microdrivers.fakes.world.approach import Approach, Coordinate, Term
from microdrivers.fakes.world.axis import Axis
from microdrivers.fakes.world.indentation import STEP_NS, Indentation
from microdrivers.fakes.world.mechanics import PRESETS, Contact

LAG_S = 0.002
RADIUS_UM, REACH_UM = 650.0, 200.0


class Bench:
    """A tool that comes with its x axis and passes aside with y, and a specimen carried by an axis of its own."""

    def __init__(self, preset: str = "single", *, clearance_um: float = 10.0) -> None:
        self.x, self.y, self.carrier = (Axis(0.0, lag_s=LAG_S) for _ in range(3))
        self.approach = Approach(
            Coordinate(-clearance_um, (Term(self.x, -1.0), Term(self.carrier, 1.0))),
            Coordinate(0.0, (Term(self.y, 1.0),)),
            Coordinate(0.0, ()),
            RADIUS_UM,
            REACH_UM,
        )
        contact = Contact(PRESETS[preset], stiffness_uN_per_um=1000.0)
        self.indentation = Indentation(contact, self.approach, origin_ns=0)

    def push(self, t_ns: int, to_um: float, speed: float = 60.0) -> int:
        return self.x.move(t_ns, to_um, speed=speed, acceleration=1e4)

    def force_uN(self, t_ns: int) -> float:
        return self.indentation.at(t_ns).force_uN


COMMANDS = [(0, -30.0), (700_123_456, -5.0), (900_000_000, -40.0), (1_600_000_001, 20.0), (2_100_000_000, -30.0)]
"""When and where to the tool goes."""


@settings(deadline=None, max_examples=6)
@given(seed=st.integers(0, 10**6), preset=st.sampled_from(sorted(PRESETS)))
def test_answers_depend_neither_on_order_nor_on_what_was_asked(seed, preset):
    chance = random.Random(seed)
    asked = sorted(chance.randrange(0, 3 * NS_PER_S) for _ in range(60))
    plain, pestered = Bench(preset), Bench(preset)
    for t_ns, to_um in COMMANDS:
        plain.push(t_ns, to_um)
        # Somebody asks ahead of the command, and gets what would be true without it.
        for _ in range(3):
            pestered.indentation.at(chance.randrange(0, t_ns + NS_PER_S))
        pestered.push(t_ns, to_um)
    answers = [plain.indentation.at(t_ns) for t_ns in asked]
    shuffled = list(zip(asked, answers, strict=True))
    chance.shuffle(shuffled)
    for t_ns, answer in shuffled:
        assert pestered.indentation.at(t_ns) == answer
    assert any(answer.in_contact for answer in answers)


def test_an_early_question_and_a_late_one_get_the_same_bits_when_commands_come_in_time():
    live, late = Bench(), Bench()
    early = []
    due = iter([*COMMANDS, (7 * NS_PER_S, 0.0)])
    command = next(due)
    for t_ns in range(0, 3 * NS_PER_S, 7 * NS_PER_MS + 11):
        while command[0] <= t_ns:
            live.push(*command)
            command = next(due)
        early.append(live.indentation.at(t_ns))
    for t_ns, to_um in COMMANDS:
        late.push(t_ns, to_um)
    for t_ns, answer in zip(range(0, 3 * NS_PER_S, 7 * NS_PER_MS + 11), early, strict=True):
        assert late.indentation.at(t_ns) == answer
        assert live.indentation.at(t_ns) == answer


def test_nothing_is_stepped_while_the_tip_is_away(monkeypatch):
    bench = Bench(clearance_um=100.0)
    steps = []
    step = Contact.step

    def counted(contact, memory, *rest):
        steps.append(memory)
        return step(contact, memory, *rest)

    monkeypatch.setattr(Contact, "step", counted)
    bench.push(0, -90.0)
    for t_ns in range(0, 20 * NS_PER_S, 10 * NS_PER_MS):
        assert bench.force_uN(t_ns) == 0.0
    assert len(steps) < 100
    bench.push(20 * NS_PER_S, -110.0)
    assert bench.force_uN(21 * NS_PER_S) > 0.0
    assert len(steps) > 1000


def test_a_hold_that_has_settled_costs_nothing(monkeypatch):
    bench = Bench()
    end_ns = bench.push(0, -60.0)
    held = bench.indentation.at(end_ns + 20 * NS_PER_S)
    steps = []
    step = Contact.step
    monkeypatch.setattr(Contact, "step", lambda self, *rest: steps.append(0) or step(self, *rest))
    for t_ns in range(end_ns + 20 * NS_PER_S, end_ns + 3600 * NS_PER_S, 60 * NS_PER_S):
        assert bench.indentation.at(t_ns) == held
    assert len(steps) < 200


def test_a_command_ends_what_was_at_rest():
    for first_um, then_um in ((-60.0, -40.0), (-9.0, -60.0)):
        asked, fresh = Bench(), Bench()
        asked.push(0, first_um)
        asked.indentation.at(7 * NS_PER_S)
        asked.indentation.at(8 * NS_PER_S)
        fresh.push(0, first_um)
        for bench in (asked, fresh):
            bench.push(9 * NS_PER_S, then_um)
        for after_ns in range(0, NS_PER_S, 13 * NS_PER_MS):
            t_ns = 9 * NS_PER_S + after_ns
            assert asked.indentation.at(t_ns) == fresh.indentation.at(t_ns)


def test_the_answer_is_continuous_between_the_steps():
    bench = Bench()
    bench.push(0, -60.0)
    begin_ns = NS_PER_S // 2
    finely = [bench.indentation.at(begin_ns + t) for t in range(0, 4 * STEP_NS, STEP_NS // 50)]
    forces = np.array([touch.force_uN for touch in finely])
    assert forces.min() > 100.0
    assert np.abs(np.diff(forces)).max() < 0.01
    assert np.abs(np.diff(forces, 2)).max() < 0.005


def test_contact_depends_on_where_the_tip_passes():
    beside, past = Bench(), Bench()
    for bench, aside_um in ((beside, 190.0), (past, 210.0)):
        bench.y.move(0, aside_um, speed=1000.0, acceleration=1e5)
        bench.push(NS_PER_S, -70.0)
    hollow_um = RADIUS_UM - math.sqrt(RADIUS_UM**2 - 190.0**2)
    touch = beside.indentation.at(5 * NS_PER_S)
    assert touch.in_contact
    assert touch.tip_um == pytest.approx(70.0 - 10.0 - hollow_um - touch.force_uN / 1000.0, abs=1e-3)
    assert not past.indentation.at(5 * NS_PER_S).in_contact
    assert past.force_uN(5 * NS_PER_S) == 0.0


def test_the_specimen_can_be_carried_against_the_tip():
    bench = Bench()
    assert not bench.indentation.at(NS_PER_S).in_contact
    bench.carrier.move(NS_PER_S, 30.0, speed=20.0, acceleration=1e4)
    assert bench.indentation.at(4 * NS_PER_S).compression_um == pytest.approx(20.0, abs=0.2)


def test_before_it_was_put_there_it_is_at_rest_and_long_ago_is_answered_too():
    bench = Bench()
    bench.push(0, -60.0, speed=5.0)
    assert not bench.indentation.at(-NS_PER_S).in_contact
    for t_ns in range(0, 20 * NS_PER_S, NS_PER_S // 10):
        bench.indentation.at(t_ns)
    recent = bench.indentation.at(15 * NS_PER_S)
    other = Bench()
    other.push(0, -60.0, speed=5.0)
    assert recent == other.indentation.at(15 * NS_PER_S)
    assert bench.indentation.at(3 * NS_PER_S).in_contact


def test_positions_at_many_instants_are_those_at_each():
    axis = Axis(3.0, lag_s=LAG_S)
    end_ns = axis.move(10, 50.0, speed=100.0, acceleration=1000.0)
    axis.move(end_ns // 2, -20.0, speed=30.0, acceleration=1000.0)
    times = np.arange(0, 3 * NS_PER_S, 1_234_567, dtype=np.int64)
    assert axis.positions_at(times) == pytest.approx([axis.position_at(int(t)) for t in times], abs=1e-11)
    still_ns = axis.still_from_ns()
    assert axis.positions_at(np.array([still_ns, still_ns + NS_PER_S])).tolist() == [-20.0, -20.0]


def test_an_axis_tells_when_it_was_commanded_and_what_changes():
    axis, changes = Axis(0.0, lag_s=LAG_S), []
    axis.on_change(changes.append)
    assert axis.commanded_ns(10**12) is None
    axis.move(100, 5.0, speed=1.0, acceleration=10.0)
    axis.move(300, 0.0, speed=1.0, acceleration=10.0)
    axis.halt(400, deceleration=10.0)
    assert changes == [100, 300, 400]
    assert [axis.commanded_ns(t) for t in (99, 100, 299, 300, 500)] == [None, 100, 100, 300, 300]
